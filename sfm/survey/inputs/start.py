"""The network that a survey starts from: points, photographs, cameras, and everything given beside them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.model.camera import Camera
from sfm.model.conventions import IntArray
from sfm.model.errors import SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ExteriorObservations, ImagePoints, Network, ObjectPoints, ScaleBars
from sfm.model.observations.pose import MountObservations
from sfm.survey.inputs.cameras import refuse_unknown_cameras
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given_values import KnownPoints, ScaleBar
from sfm.survey.inputs.sources import given_tables, reads_photographs
from sfm.survey.inputs.survey import Survey
from sfm.survey.observation_tables import with_tables
from sfm.survey.rigs import with_moments


def refuse_unknown_photographs(survey: Survey, images: Sequence[str]) -> None:
    """Raise SurveyFileError if given orientations or start values refer to unknown photographs or cameras.

    Args:
        survey: may give observed and approximate exterior orientations, and start values of cameras.
        images: all photographs of the survey, including unreadable ones; given image points may name more.
    """
    refuse_unknown_cameras(survey.cameras, survey.start_cameras)
    known = {*images, *(name for given in given_tables(survey) for name in given.image)}
    lacks = "is no photograph of the survey" if reads_photographs(survey) else "has no observations"
    for given, what in ((survey.exterior, "column image:"), (survey.start_orientations, "image")):
        for k, name in enumerate(given.names if given is not None else ()):
            if given is not None and name not in known:
                raise SurveyFileError(
                    f"{given.table.place(k)}: {what} '{name}' {lacks}; correct the name or remove it"
                )
    if survey.pairs is not None:
        for k, pair in enumerate(survey.pairs.names):
            for column, name in zip(survey.pairs.table.names, pair, strict=True):
                if name not in known:
                    raise SurveyFileError(
                        f"{survey.pairs.table.place(k)}: column {column}: '{name}' {lacks}; correct the name "
                        "or remove it"
                    )


def start_values(survey: Survey, network: Network, cameras: tuple[Camera, ...]) -> Estimate:
    """Return start values from [approximate] and the control, NaN where none is given.

    Args:
        survey: gives the values, and states whether the control is the datum.
        network: its photographs and points get their values by name.
        cameras: cameras with their start values.
    """
    estimate = given_values(survey, network, cameras)
    if survey.datum.kind == "control":
        control = network.control.complete
        estimate.points[control.point] = control.xyz
    return estimate


def given_values(survey: Survey, network: Network, cameras: tuple[Camera, ...] = ()) -> Estimate:
    """Return the values of [approximate] for photographs and points, NaN for all others.

    Args:
        survey: gives the values.
        network: its photographs and points get their values by name.
        cameras: cameras with their start values.
    """
    m, n = len(network.images), len(network.points)
    position, rotation = np.full((m, 3), np.nan), np.full((m, 3, 3), np.nan)
    points = np.full((n, 3), np.nan)
    orientations, places = survey.start_orientations, survey.start_points
    if orientations is not None:
        row = {name: k for k, name in enumerate(orientations.names)}
        for i, name in enumerate(network.images):
            if name in row:
                position[i] = orientations.position[row[name]]
                rotation[i] = orientations.rotation[row[name]]
    if places is not None:
        row = {name: k for k, name in enumerate(places.names)}
        for j, name in enumerate(network.points):
            if name in row:
                points[j] = places.xyz[row[name]]
    return Estimate(cameras, position, rotation, points)


def network_of(
    survey: Survey,
    images: tuple[str, ...],
    camera: IntArray,
    points: tuple[str, ...],
    image_points: ImagePoints,
    *,
    bars: ScaleBars | None = None,
) -> Network:
    """Return the network of image points and all other observations of the survey.

    Args:
        survey: gives control, exterior orientation, scale bars, tables of observations and rigs.
        images: names of the photographs, (m,).
        camera: index into the cameras of the survey for each photograph, (m,).
        points: names of the object points, as used in the survey, (n,).
        image_points: measured image points.
        bars: scale bars in place of those of the survey.

    Raises:
        SurveyFileError: the moments of photographs of a rig are unknown, or contradict one another.
    """
    network = Network(
        images,
        camera,
        points,
        image_points,
        observations=(
            control_points(survey.control, points),
            scale_bars(survey.scale_bars, points) if bars is None else bars,
        ),
    )
    if survey.exterior is not None and survey.datum.kind == "control":
        network = network.with_given(exterior_observations(survey.exterior, images))
    return with_given_mounts(survey.given_mounts, with_moments(survey, with_tables(survey.tables, network)))


def with_given_mounts(mounts: MountObservations, network: Network) -> Network:
    """Return the network with given mounts as observations, except for mounts that are held fixed."""
    loose = mounts.select(np.flatnonzero(np.trace(mounts.covariance, axis1=1, axis2=2) > 0))
    return network.with_given(further=(*network.further, loose)) if len(loose) else network


def exterior_observations(table: ObservedExterior, images: Sequence[str]) -> ExteriorObservations:
    """Return the observed exterior orientation of photographs of a network, by their names."""
    index = {name: i for i, name in enumerate(images)}
    rows = np.array([k for k, name in enumerate(table.names) if name in index], dtype=np.int64)
    image = np.array([index[table.names[k]] for k in rows], dtype=np.int64)
    # a value that was not observed has no weight, and may be any number
    value = np.nan_to_num(table.value[rows])
    covariance = np.zeros((len(rows), 6, 6))
    covariance[:, range(6), range(6)] = table.sigma[rows] ** 2
    return ExteriorObservations(image, value[:, :3], value[:, 3:], covariance)


def control_points(control: KnownPoints | None, points: Sequence[str]) -> ObjectPoints:
    """Return the control among the points of a network, by their names."""
    if control is None:
        return ObjectPoints()
    index = {name: k for k, name in enumerate(points)}
    given, covariance = np.isfinite(control.xyz), control.covariance
    if control.check is not None:  # check coordinates are treated as unknown
        given = given & ~control.check
        covariance = np.where(control.check[:, :, None] | control.check[:, None, :], 0.0, covariance)
        point, axis = np.nonzero(control.check)
        covariance[point, axis, axis] = np.inf
    known = np.array([name in index for name in control.names], dtype=bool) & given.any(axis=1)
    # an unknown coordinate has no weight and any finite value, here the mean of the others
    count = np.maximum(given.sum(axis=0), 1)
    mean = np.where(given, control.xyz, 0.0).sum(axis=0) / count
    return ObjectPoints(
        np.array([index[control.names[k]] for k in np.flatnonzero(known)], dtype=np.int64),
        np.where(given, control.xyz, mean)[known],
        covariance[known],
    )


def scale_bars(bars: Sequence[ScaleBar], points: Sequence[str]) -> ScaleBars:
    """Return the scale bars with both ends among the points of a network, by their names."""
    index = {name: k for k, name in enumerate(points)}
    bars = [bar for bar in bars if bar.start in index and bar.end in index]
    return ScaleBars(
        np.array([index[bar.start] for bar in bars], dtype=np.int64),
        np.array([index[bar.end] for bar in bars], dtype=np.int64),
        np.array([bar.length for bar in bars], dtype=float),
        np.array([bar.sigma for bar in bars], dtype=float),
        np.array([bar.table for bar in bars], dtype=np.int64),
    )
