"""The network of a survey: its image points, and all that was given of points, photographs and cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sfm.conventions import IntArray
from sfm.network import ExteriorObservations, ImagePoints, Network, ObjectPoints, ScaleBars
from sfm.observations.mounts import MountObservations
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given import KnownPoints, ScaleBar
from sfm.survey.inputs.survey import Survey
from sfm.survey.observation_tables import with_tables
from sfm.survey.rigs import with_moments


def network_of(
    survey: Survey,
    images: tuple[str, ...],
    camera: IntArray,
    points: tuple[str, ...],
    image_points: ImagePoints,
    *,
    bars: ScaleBars | None = None,
) -> Network:
    """Return the network of image points, with all that the survey gives beside them.

    Args:
        survey: with control, exterior orientation, scale bars, tables of observations and rigs.
        images: names of the photographs, (m,).
        camera: index into the cameras of the survey of each photograph, (m,).
        points: names of the object points, (n,), by which the survey means them.
        image_points: measured.
        bars: scale bars in place of those that the survey gives.

    Raises:
        SurveyFileError: the moments of photographs of a rig are not known, or contradict one another.
    """
    network = Network(
        images,
        camera,
        points,
        image_points,
        control=control_points(survey.control, points),
        scale_bars=scale_bars(survey.scale_bars, points) if bars is None else bars,
    )
    if survey.exterior is not None and survey.datum.kind == "control":
        network = replace(network, exterior=exterior_observations(survey.exterior, images))
    return with_given_mounts(survey.given_mounts, with_moments(survey, with_tables(survey.tables, network)))


def with_given_mounts(mounts: MountObservations, network: Network) -> Network:
    """Return the network with given mounts as observations, unless they are held fixed."""
    loose = mounts.select(np.flatnonzero(np.trace(mounts.covariance, axis1=1, axis2=2) > 0))
    return replace(network, observations=(*network.observations, loose)) if len(loose) else network


def exterior_observations(table: ObservedExterior, images: Sequence[str]) -> ExteriorObservations:
    """Return the observed exterior orientation of photographs of a network, by their names."""
    index = {name: i for i, name in enumerate(images)}
    rows = np.array([k for k, name in enumerate(table.names) if name in index], dtype=np.int64)
    image = np.array([index[table.names[k]] for k in rows], dtype=np.int64)
    # what was not observed has no weight, and any number may be in its place
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
    if control.check is not None:  # as if it were not known
        given = given & ~control.check
        covariance = np.where(control.check[:, :, None] | control.check[:, None, :], 0.0, covariance)
        point, axis = np.nonzero(control.check)
        covariance[point, axis, axis] = np.inf
    known = np.array([name in index for name in control.names], dtype=bool) & given.any(axis=1)
    # an unknown coordinate has any finite value, here the mean of the others, and no weight
    count = np.maximum(given.sum(axis=0), 1)
    mean = np.where(given, control.xyz, 0.0).sum(axis=0) / count
    return ObjectPoints(
        np.array([index[control.names[k]] for k in np.flatnonzero(known)], dtype=np.int64),
        np.where(given, control.xyz, mean)[known],
        covariance[known],
    )


def scale_bars(bars: Sequence[ScaleBar], points: Sequence[str]) -> ScaleBars:
    """Return the scale bars of which both ends are among the points of a network, by their names."""
    index = {name: k for k, name in enumerate(points)}
    bars = [bar for bar in bars if bar.start in index and bar.end in index]
    return ScaleBars(
        np.array([index[bar.start] for bar in bars], dtype=np.int64),
        np.array([index[bar.end] for bar in bars], dtype=np.int64),
        np.array([bar.length for bar in bars], dtype=float),
        np.array([bar.sigma for bar in bars], dtype=float),
    )
