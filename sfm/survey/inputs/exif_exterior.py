"""Observed projection centres of a survey from the positions in the EXIF data of its photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sfm.conventions import METRES
from sfm.display import counted
from sfm.errors import PhotographError, SurveyFileError
from sfm.files.csv_tables import array_table
from sfm.photographs.exif import read_metadata
from sfm.photographs.satellite_positions import LocalSystem, SatellitePosition, local_coordinates
from sfm.remarks.remark import Remark, remark
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given import AXES
from sfm.survey.inputs.photograph_list import PhotographList
from sfm.survey.inputs.survey import Survey

MAX_DISTANCE_M = (
    100_000.0  # from the middle, of a photograph of the same object: farther than mountains are seen
)


def exterior_from_exif(survey: Survey, files: PhotographList) -> tuple[Survey, tuple[Remark, ...]]:
    """Return the survey with positions in EXIF data as observed exterior orientation, where it asks for it.

    Args:
        survey: as it was, with no remark, without `exif_sigma_m`.
        files: its photographs; those that cannot be read, or state no position, are not observed.

    Raises:
        SurveyFileError: no photograph states a position, or most positions are not of one place.
    """
    if survey.exif_sigma_m is None:
        return survey, ()
    positions: dict[str, SatellitePosition] = {}
    for name, path in zip(files.names, files.paths, strict=True):
        try:
            position = read_metadata(path).position
        except PhotographError:
            continue  # whoever measures in it names it
        if position is not None:
            positions[name] = position
    if not positions:
        raise SurveyFileError(
            f"{survey.source}: [exterior] exif_sigma_m asks for positions in EXIF data, and none of "
            f"{counted(len(files), 'photograph')} has one; leave it out, or give a file"
        )
    near = plausible_positions(positions)
    if not near:
        raise SurveyFileError(
            f"{survey.source}: [exterior] exif_sigma_m: the positions in EXIF data of "
            f"{counted(len(positions), 'photograph')} are in places more than {MAX_DISTANCE_M / 1000:g} km "
            f"apart, as {' and '.join(_farthest(positions))}, and none has most of them; remove the "
            "wrong ones, or give a file"
        )
    origin, exterior = observed_positions(near, survey.exif_sigma_m, survey.unit)
    found = remark(
        "exif_positions",
        positions=len(near),
        photographs=len(files),
        latitude=(origin.latitude_deg, "deg"),
        longitude=(origin.longitude_deg, "deg"),
    )
    far = tuple(name for name in positions if name not in near)
    limit = (MAX_DISTANCE_M / METRES[survey.unit], survey.unit)
    remarks = (found, remark("exif_positions_far", far=far, limit=limit)) if far else (found,)
    return replace(survey, exterior=exterior, exif_sigma_m=None), remarks


def plausible_positions(positions: Mapping[str, SatellitePosition]) -> dict[str, SatellitePosition]:
    """Return the positions of photographs, by name, without those that are not of one survey with the others.

    Errors of less than MAX_DISTANCE_M are left to the tests of the adjustment. Where most are of no one
    place, none is plausible.
    """
    _, places = local_coordinates(tuple(positions.values()))
    distance = np.linalg.norm(places[:, :2] - np.median(places[:, :2], axis=0), axis=1)
    near = distance <= MAX_DISTANCE_M
    if 2 * near.sum() <= len(near):
        return {}
    return {name: position for (name, position), keep in zip(positions.items(), near, strict=True) if keep}


def _farthest(positions: Mapping[str, SatellitePosition]) -> tuple[str, str]:
    """Return the names of the first photograph and the one that is farthest from it."""
    names, (_, places) = list(positions), local_coordinates(tuple(positions.values()))
    return names[0], names[int(np.linalg.norm(places[:, :2] - places[0, :2], axis=1).argmax())]


def observed_positions(
    positions: Mapping[str, SatellitePosition], sigma_m: tuple[float, float], unit: str
) -> tuple[LocalSystem, ObservedExterior]:
    """Return positions as observed exterior orientation in a local system: X east, Y north, Z up.

    Args:
        positions: of photographs by name, at least one.
        sigma_m: standard deviations in the plane and of the height, of those that state none, m.
        unit: object unit.
    """
    origin, places = local_coordinates(tuple(positions.values()))
    stated = np.array([one.sigma_m for one in positions.values()])
    plane, height = sigma_m
    sigma = np.where(np.isnan(stated), (plane, plane, height), stated)
    nothing = np.full_like(places, np.nan)
    value = np.hstack([places / METRES[unit], nothing])
    sigma = np.hstack([sigma / METRES[unit], nothing])
    columns = dict(zip(AXES, value[:, :3].T, strict=True))
    table = array_table("positions in EXIF data", {"image": tuple(positions)}, columns, blank=AXES)
    sigma = np.where(np.isnan(value), np.inf, sigma)
    return origin, ObservedExterior(tuple(positions), value, sigma, table)
