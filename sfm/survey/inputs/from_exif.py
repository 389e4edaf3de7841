"""Projection centres and moments of rigs from the EXIF data of a survey's photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np

from sfm.files.csv_tables import array_table
from sfm.model.conventions import METRES
from sfm.model.display import counted
from sfm.model.errors import SurveyFileError
from sfm.model.remarks.remark import Remark, remark
from sfm.photographs.exif import LocalSystem, SatellitePosition, local_coordinates
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given_values import AXES
from sfm.survey.inputs.measurements import PhotographList
from sfm.survey.inputs.survey import Survey

# Largest distance of a photograph from the median position: mountains are not seen from farther away.
MAX_DISTANCE_M = 100_000.0


def exterior_from_exif(survey: Survey, files: PhotographList) -> tuple[Survey, tuple[Remark, ...]]:
    """Return the survey with EXIF positions as observed exterior orientation, if it asks for them.

    Args:
        survey: states `exif_sigma_m`; otherwise it is returned unchanged, without remarks.
        files: photographs of the survey; unreadable ones and those without a position are not observed.

    Raises:
        SurveyFileError: no photograph states a position, or no place contains most of the positions.
    """
    if survey.exif_sigma_m is None:
        return survey, ()
    positions: dict[str, SatellitePosition] = {}
    for k, name in enumerate(files.names):
        metadata = files.metadata_of(k)
        if metadata is not None and metadata.position is not None:
            positions[name] = metadata.position
    if not positions:
        raise SurveyFileError(
            f"{survey.source}: [exterior] exif_sigma_m asks for positions in EXIF data, and none of "
            f"{counted(len(files), 'photograph')} has one; leave it out, or give a file"
        )
    near = plausible_positions(positions)
    if not near:
        names, (_, places) = list(positions), local_coordinates(tuple(positions.values()))
        farthest = names[int(np.linalg.norm(places[:, :2] - places[0, :2], axis=1).argmax())]
        raise SurveyFileError(
            f"{survey.source}: [exterior] exif_sigma_m: the positions in EXIF data of "
            f"{counted(len(positions), 'photograph')} are in places more than {MAX_DISTANCE_M / 1000:g} km "
            f"apart, as {names[0]} and {farthest}, and none has most of them; remove the "
            "wrong ones, or give a file"
        )
    origin, exterior = observed_positions(near, survey.exif_sigma_m, survey.unit)
    observed = remark(
        "exif_positions",
        positions=len(near),
        photographs=len(files),
        latitude=(origin.latitude_deg, "deg"),
        longitude=(origin.longitude_deg, "deg"),
    )
    far = tuple(name for name in positions if name not in near)
    limit = (MAX_DISTANCE_M / METRES[survey.unit], survey.unit)
    remarks = (observed, remark("exif_positions_far", far=far, limit=limit)) if far else (observed,)
    return replace(survey, exterior=exterior, exif_sigma_m=None), remarks


def moments_from_exif(survey: Survey, files: PhotographList) -> tuple[Survey, tuple[Remark, ...]]:
    """Return the survey with the moments of rigs from EXIF times, for rigs that ask for them.

    A new moment begins with a photograph taken later than the start of the previous moment by more than the
    tolerance of the rig. Its name is its time. A clock that differs from that of the reference camera is
    corrected by the offset at which most photographs have a partner.

    Args:
        survey: has rigs.
        files: photographs of the survey.

    Returns:
        The survey, and a remark on each clock that differs.

    Raises:
        SurveyFileError: a photograph of such a rig states no time, or several offsets of a clock are
            possible.
    """
    moments, remarks = dict(survey.moments), []
    other_moments = dict(survey.moments)
    unsure = False
    for rig in survey.rigs:
        if rig.moment != "exif":
            continue
        number = {camera.name: k for k, camera in enumerate(survey.cameras)}
        of_rig = [_times(number[name], files, f"{survey.source}: rig {rig.name}") for name in rig.cameras]
        corrected, otherwise = dict(of_rig[0]), dict(of_rig[0])
        for camera, times in zip(rig.cameras[1:], of_rig[1:], strict=True):
            ahead, *others = clock_offsets(list(of_rig[0].values()), list(times.values()), rig.tolerance_s)
            if others and ahead:
                raise SurveyFileError(
                    f"{survey.source}: rig {rig.name}: the clock of camera {camera} is ahead of that of "
                    f"{rig.cameras[0]} by {ahead:g} s or {others[0]:g} s, and as many photographs agree; set "
                    "the times, or name the moments by an expression, 'order' or a table"
                )
            second = min(others, key=abs, default=ahead)
            corrected |= {name: taken - timedelta(seconds=ahead) for name, taken in times.items()}
            otherwise |= {name: taken - timedelta(seconds=second) for name, taken in times.items()}
            unsure = unsure or bool(others)
            if ahead or others:
                differs = remark(
                    "clock_differs",
                    camera=camera,
                    reference=rig.cameras[0],
                    ahead=(second, "s"),
                    unsure="as they are" if others else None,
                )
                remarks.append(differs)
        moments |= named_moments(corrected, rig.tolerance_s)
        other_moments |= named_moments(otherwise, rig.tolerance_s)
    if not moments:
        return survey, tuple(remarks)
    return replace(survey, moments=moments, other_moments=other_moments if unsure else {}), tuple(remarks)


def named_moments(times: Mapping[str, datetime], tolerance_s: float) -> dict[str, str]:
    """Return the moment of each photograph, named by the time of its first photograph.

    Args:
        times: time of each photograph, by its name, by one clock.
        tolerance_s: photographs later than the first of a moment by more are of the next, s.
    """
    moments, start = {}, datetime.min
    for name, taken in sorted(times.items(), key=lambda named: named[1]):
        if taken - start > timedelta(seconds=tolerance_s):
            start = taken
        moments[name] = start.isoformat(sep=" ")
    return moments


def _times(camera: int, files: PhotographList, where: str) -> dict[str, datetime]:
    """Return the times of the photographs of a camera by its clock, by name."""
    times: dict[str, datetime] = {}
    for k in np.flatnonzero(files.camera == camera).tolist():
        name, metadata = files.names[k], files.metadata_of(k)
        if metadata is None:
            continue
        if metadata.taken is None:
            raise SurveyFileError(
                f"{where}: moment = 'exif', and photograph '{name}' states no time in its EXIF data; "
                "needed a table or an expression that names the moments, or 'order'"
            )
        times[name] = metadata.taken
    return times


def clock_offsets(reference: list[datetime], times: list[datetime], tolerance_s: float) -> list[float]:
    """Return the possible offsets of a clock from the reference camera's, s; 0 first if that fits as well.

    Most pairs of photographs agree at the correct offset. With photographs at regular intervals several
    offsets are possible, and nothing shows which is correct.

    Args:
        reference: times of the photographs of the reference camera.
        times: times of the photographs of another camera, by its own clock.
        tolerance_s: largest difference of the times of one moment, s.
    """
    if not reference or not times:
        return [0.0]
    start = reference[0]
    a, b = (np.array([(taken - start).total_seconds() for taken in series]) for series in (reference, times))
    ahead = np.sort((b[:, None] - a).ravel())
    last = np.searchsorted(ahead, ahead + 2 * tolerance_s, side="right")
    count = last - np.arange(len(ahead))
    offsets: list[float] = []
    for k in np.flatnonzero(count == count.max()):
        middle = float(ahead[k] + ahead[last[k] - 1]) / 2
        if not offsets or middle - offsets[-1] > tolerance_s:
            offsets.append(middle)
    if count.max() > (np.abs(ahead) <= tolerance_s).sum():
        return offsets
    if len(reference) == len(times) == count.max():  # every photograph has its partner
        return [0.0]
    return [0.0, *(offset for offset in offsets if abs(offset) > 2 * tolerance_s)]


def plausible_positions(positions: Mapping[str, SatellitePosition]) -> dict[str, SatellitePosition]:
    """Return the positions of photographs, by name, without those that are too far from the others.

    The tests of the adjustment find errors smaller than MAX_DISTANCE_M. If no place has most of the
    positions, none is plausible.
    """
    _, places = local_coordinates(tuple(positions.values()))
    distance = np.linalg.norm(places[:, :2] - np.median(places[:, :2], axis=0), axis=1)
    near = distance <= MAX_DISTANCE_M
    if 2 * near.sum() <= len(near):
        return {}
    return {name: position for (name, position), keep in zip(positions.items(), near, strict=True) if keep}


def observed_positions(
    positions: Mapping[str, SatellitePosition], sigma_m: tuple[float, float], unit: str
) -> tuple[LocalSystem, ObservedExterior]:
    """Return positions as observed exterior orientation in a local system: X east, Y north, Z up.

    Args:
        positions: positions of at least one photograph, by name.
        sigma_m: standard deviations in the plane and of the height, for photographs that state none, m.
        unit: object unit.
    """
    origin, places = local_coordinates(tuple(positions.values()))
    stated = np.array([position.sigma_m for position in positions.values()])
    plane, height = sigma_m
    sigma = np.where(np.isnan(stated), (plane, plane, height), stated)
    nothing = np.full_like(places, np.nan)
    value = np.hstack([places / METRES[unit], nothing])
    sigma = np.hstack([sigma / METRES[unit], nothing])
    columns = dict(zip(AXES, value[:, :3].T, strict=True))
    table = array_table("positions in EXIF data", {"image": tuple(positions)}, columns, blank=AXES)
    sigma = np.where(np.isnan(value), np.inf, sigma)
    return origin, ObservedExterior(tuple(positions), value, sigma, table)
