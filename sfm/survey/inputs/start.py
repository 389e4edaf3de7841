"""The network that a survey starts from: given observations, control, scale bars, and start values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from sfm.camera import Camera
from sfm.conventions import FloatArray, IntArray, pixel_from_image
from sfm.errors import SurveyFileError
from sfm.network import Estimate, ImagePoints, Network, ObjectPoints, ScaleBars, rows_of
from sfm.remarks.remark import remark
from sfm.result import FailedImage, LeftOutPoint
from sfm.survey.inputs.cameras import camera_of_image, refuse_unknown_cameras, start_cameras
from sfm.survey.inputs.checks.outside import refuse_outside
from sfm.survey.inputs.checks.repeated_image_points import merge_repeated
from sfm.survey.inputs.checks.same_photographs import same_photographs
from sfm.survey.inputs.given import KnownPoints, Observations, ScaleBar
from sfm.survey.inputs.interior import refuse_ungrouped
from sfm.survey.inputs.measurements import Measurements
from sfm.survey.inputs.photograph_list import refuse_many
from sfm.survey.inputs.survey import Survey

MIN_RAYS = 2  # photographs that a point with a name needs


def measurements_from_observations(survey: Survey) -> Measurements:
    """Return the network of a survey that gives image points in place of photographs.

    Photographs and points are counted in the order in which the observations name them first. The control
    is part of the network in every datum; the adjustment uses it only where the datum is `control`.

    Args:
        survey: a survey with observations.

    Raises:
        SurveyFileError: there are none, image points are outside of their photographs, or the cameras'
            start values are incomplete.
    """
    given = survey.observations
    if given is None:
        raise SurveyFileError(f"{survey.source}: [observations] with a file of image points is needed")
    cameras = start_cameras(survey.cameras, survey.source, given=survey.start_cameras)
    images, image = _numbered(given.image)
    refuse_many(str(given.table.path), images)
    points, point = _numbered(given.point)
    owner = np.array(
        [camera_of_image(survey.cameras, name, survey.source) for name in images], dtype=np.int64
    )
    refuse_ungrouped(survey.cameras, images, owner, survey.source)
    xy, covariance = _in_pixels(given, cameras, owner[image], survey.adjust.sigma_px)
    outside = refuse_outside(given, xy, cameras, owner[image])
    gross = [f"{points[point[k]]} in {images[image[k]]}" for k in np.flatnonzero(outside)]
    refuse_unknown_photographs(survey, images)
    sigma = np.full(xy.shape, np.nan) if given.sigma is None else given.sigma
    stated = np.asarray(np.isfinite(sigma).all(axis=1))
    every = images
    copies = same_photographs(image, point, xy, owner)
    own = np.isin(np.arange(len(images)), list(copies), invert=True)
    rows = own[image] & ~outside
    number = np.cumsum(own) - 1
    failed = tuple(
        FailedImage(every[i], remark("copy_of_image_points", original=every[j])) for i, j in copies.items()
    )
    images, owner = tuple(name for name, keep in zip(images, own, strict=True) if keep), owner[own]
    image, point = number[image[rows]], point[rows]
    merged = merge_repeated(ImagePoints(image, point, xy[rows], covariance[rows], stated[rows]))
    network = Network(
        images,
        owner,
        points,
        merged.image_points,
        control=control_points(survey.control, points),
        scale_bars=scale_bars(survey.scale_bars, points),
    )
    times = Counter(zip(image.tolist(), point.tolist(), strict=True)) if merged.dropped else Counter()
    contradicting = tuple(
        LeftOutPoint(name, times[i, j], remark("image_points_contradicting", image_points=name))
        for i, j in merged.dropped
        for name in [f"{points[j]} in {images[i]}"]
    )
    told = (remark("image_points_outside", image_points=gross),) if gross else ()
    return Measurements(
        network,
        cameras,
        every,
        np.full(len(points), MIN_RAYS),
        failed,
        remarks=(*merged.remarks(images, points), *told),
        left_out=(
            *contradicting,
            *(LeftOutPoint(name, 1, remark("image_points_outside", image_points=name)) for name in gross),
        ),
    )


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


def refuse_unknown_photographs(survey: Survey, images: Sequence[str]) -> None:
    """Raise SurveyFileError if given orientations or cameras are none of the survey's.

    Args:
        survey: with observed and approximate exterior orientations, or none.
        images: all photographs of the survey, also those that cannot be read.
    """
    refuse_unknown_cameras(survey.cameras, survey.start_cameras)
    known = set(images)
    lacks = "has no observations" if survey.observations else "is no photograph of the survey"
    for given, what in ((survey.exterior, "column image:"), (survey.start_orientations, "image")):
        for k, name in enumerate(given.names if given is not None else ()):
            if given is not None and name not in known:
                raise SurveyFileError(
                    f"{given.table.place(k)}: {what} '{name}' {lacks}; correct the name or remove it"
                )


def start_values(survey: Survey, network: Network, cameras: tuple[Camera, ...]) -> Estimate:
    """Return start values from [approximate] and the control; NaN for what nothing is said about.

    Args:
        survey: gives them, and says whether the control holds.
        network: photographs and points that get their values by name.
        cameras: with their start values.
    """
    found = given_values(survey, network, cameras)
    if survey.datum.kind == "control":
        control = network.control.complete
        found.points[control.point] = control.xyz
    return found


def given_values(survey: Survey, network: Network, cameras: tuple[Camera, ...] = ()) -> Estimate:
    """Return what [approximate] says of photographs and points; NaN for all others.

    Args:
        survey: gives them.
        network: photographs and points that get their values by name.
        cameras: with their start values.
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


def _numbered(names: tuple[str, ...]) -> tuple[tuple[str, ...], IntArray]:
    """Return the different names in order of first appearance and the number of each entry."""
    number: dict[str, int] = {}
    index = np.array([number.setdefault(name, len(number)) for name in names], dtype=np.int64)
    return tuple(number), index


def _in_pixels(
    given: Observations, cameras: tuple[Camera, ...], camera: IntArray, sigma_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return positions (k, 2) in px and their covariance (k, 2, 2) in px^2 of rows in px or mm."""
    xy, sigma = given.xy, given.sigma
    between = np.zeros(len(xy)) if given.covariance is None else given.covariance.copy()
    xy_px = xy.copy()
    s = np.full(xy.shape, sigma_px) if sigma is None else sigma.copy()
    if given.unit == "mm":
        for own, rows in zip(cameras, rows_of(camera, len(cameras)), strict=True):
            xy_px[rows] = pixel_from_image(xy[rows], own.size_px, own.pixel_mm)
            if sigma is not None:
                s[rows] = sigma[rows] / own.pixel_mm
                between[rows] /= -own.pixel_mm.prod()  # y is up in the image frame, down in px
    s = np.where(np.isnan(s), sigma_px, s)
    covariance = np.zeros((len(xy), 2, 2))
    covariance[:, range(2), range(2)] = s**2
    covariance[:, 0, 1] = covariance[:, 1, 0] = between
    return xy_px, covariance
