"""The network that a survey starts from: given image points, points, photographs and cameras.

Image points outside their photograph mean that a value or a setting is wrong. A few are gross errors and are
left out. If there are more, the survey is refused, and the message states what would bring them inside: x and
y exchanged, another unit, or a larger photograph.

If a table has an image point more than once, it was measured several times in one photograph. Agreeing
measurements are averaged, and contradicting ones are left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray, IntArray, pixel_from_image
from sfm.display import listed
from sfm.distributions import LEVEL, chi2_ppf
from sfm.errors import SurveyFileError
from sfm.network import Estimate, ExteriorObservations, ImagePoints, Network, ObjectPoints, ScaleBars, rows_of
from sfm.observations.pose import MountObservations
from sfm.remarks.remark import Remark, remark
from sfm.result import FailedImage, LeftOutPoint
from sfm.survey.inputs.cameras import camera_of_image, refuse_ungrouped, refuse_unknown_cameras, start_cameras
from sfm.survey.inputs.checks.copies import same_photographs
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given import KnownPoints, Observations, ScaleBar
from sfm.survey.inputs.measurements import Measurements, refuse_many
from sfm.survey.inputs.survey import Survey
from sfm.survey.observation_tables import with_tables
from sfm.survey.rigs import with_moments

MARGIN_PX = 1.0  # difference to programs that count pixels from 1 or from corners
MAX_OUTSIDE = 0.05  # of the image points; measuring never makes more gross errors
MIN_RAYS = 2  # photographs that a point with a name needs


def measurements_from_observations(survey: Survey) -> Measurements:
    """Return the network of a survey that gives image points in place of photographs.

    Photographs and points are numbered in the order in which the observations first name them. The control is
    part of the network in every datum. The adjustment uses it only if the datum is `control`.

    Args:
        survey: a survey with observations.

    Raises:
        SurveyFileError: there are no observations, image points are outside their photographs, or the start
            values of a camera are incomplete.
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
    distinct = np.isin(np.arange(len(images)), list(copies), invert=True)
    rows = distinct[image] & ~outside
    number = np.cumsum(distinct) - 1
    failed = tuple(
        FailedImage(every[i], remark("copies", original=every[j], same="image points"))
        for i, j in copies.items()
    )
    images, owner = tuple(name for name, keep in zip(images, distinct, strict=True) if keep), owner[distinct]
    image, point = number[image[rows]], point[rows]
    merged = merge_repeated(ImagePoints(image, point, xy[rows], covariance[rows], stated[rows]))
    network = network_of(survey, images, owner, points, merged.image_points)
    times = Counter(zip(image.tolist(), point.tolist(), strict=True)) if merged.dropped else Counter()
    contradicting = tuple(
        LeftOutPoint(name, times[i, j], remark("image_points_contradicting", image_points=name))
        for i, j in merged.dropped
        for name in [f"{points[j]} in {images[i]}"]
    )
    outside_remark = (remark("image_points_outside", image_points=gross),) if gross else ()
    return Measurements(
        network,
        cameras,
        every,
        np.full(len(points), MIN_RAYS),
        failed,
        remarks=(*merged.remarks(images, points), *outside_remark),
        left_out=(
            *contradicting,
            *(LeftOutPoint(name, 1, remark("image_points_outside", image_points=name)) for name in gross),
        ),
    )


def refuse_unknown_photographs(survey: Survey, images: Sequence[str]) -> None:
    """Raise SurveyFileError if given orientations or start values refer to unknown photographs or cameras.

    Args:
        survey: may give observed and approximate exterior orientations, and start values of cameras.
        images: all photographs of the survey, including unreadable ones.
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
    """Return start values from [approximate] and the control, NaN where none is given.

    Args:
        survey: gives the values, and states whether the control is the datum.
        network: its photographs and points get their values by name.
        cameras: cameras with their start values.
    """
    found = given_values(survey, network, cameras)
    if survey.datum.kind == "control":
        control = network.control.complete
        found.points[control.point] = control.xyz
    return found


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


def _numbered(names: tuple[str, ...]) -> tuple[tuple[str, ...], IntArray]:
    """Return the unique names in order of first appearance, and the index of each entry."""
    number: dict[str, int] = {}
    index = np.array([number.setdefault(name, len(number)) for name in names], dtype=np.int64)
    return tuple(number), index


def _in_pixels(
    given: Observations, cameras: tuple[Camera, ...], camera: IntArray, sigma_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return positions, px, (k, 2), and their covariance, px^2, (k, 2, 2), of rows in px or mm."""
    xy, sigma = given.xy, given.sigma
    between = np.zeros(len(xy)) if given.covariance is None else given.covariance.copy()
    xy_px = xy.copy()
    s = np.full(xy.shape, sigma_px) if sigma is None else sigma.copy()
    if given.unit == "mm":
        for one, rows in zip(cameras, rows_of(camera, len(cameras)), strict=True):
            xy_px[rows] = pixel_from_image(xy[rows], one.size_px, one.pixel_mm)
            if sigma is not None:
                s[rows] = sigma[rows] / one.pixel_mm
                between[rows] /= -one.pixel_mm.prod()  # y is up in the image frame, down in px
    s = np.where(np.isnan(s), sigma_px, s)
    covariance = np.zeros((len(xy), 2, 2))
    covariance[:, range(2), range(2)] = s**2
    covariance[:, 0, 1] = covariance[:, 1, 0] = between
    return xy_px, covariance


def outside_photograph(xy: FloatArray, size: FloatArray) -> BoolArray:
    """Return whether image points are outside their photographs, (k,).

    Args:
        xy: image points, px, (k, 2).
        size: width and height of each image point's photograph, px, (k, 2).
    """
    return np.asarray(((xy < -0.5 - MARGIN_PX) | (xy > size - 0.5 + MARGIN_PX)).any(axis=1))


def refuse_outside(
    given: Observations, xy: FloatArray, cameras: Sequence[Camera], camera: IntArray
) -> BoolArray:
    """Return which image points are outside their photographs, (k,).

    Args:
        given: image points as given.
        xy: image points, px, (k, 2).
        cameras: cameras of the survey.
        camera: camera index of each image point, (k,).

    Raises:
        SurveyFileError: so many are outside that a setting is wrong, or all are inside with x and y
            exchanged.
    """
    size = np.array([one.size_px for one in cameras], dtype=float)[camera]
    outside = outside_photograph(xy, size)
    count, allowed = int(outside.sum()), MAX_OUTSIDE * len(xy)
    if not count:
        return outside
    reasons = [
        words
        for words, other, other_size in _alternatives(given, xy, size, cameras, camera)
        if outside_photograph(other, other_size).sum() <= (allowed if count > allowed else 0)
    ]
    if count <= allowed and not (reasons and reasons[0] == EXCHANGED):
        return outside
    k = int(np.argmax(outside))
    names = listed(dict.fromkeys(cameras[a].name for a in camera[outside].tolist()))
    width, height = size[k].astype(int)
    x, y = given.xy[k]
    needed = np.ceil(xy[outside].max(axis=0)).astype(int)
    larger = f"size_px must be {needed[0]} x {needed[1]} or more, or the unit is another"
    raise SurveyFileError(
        f"{given.table.place(k)}: image point {x:g}, {y:g} {given.unit} is outside its photograph of {width} "
        f"x {height} px (camera {names}), as are {count} of {len(xy)}: {reasons[0] if reasons else larger}"
    )


EXCHANGED = "with x and y exchanged, or width and height in size_px, they are inside"


def _alternatives(
    given: Observations, xy: FloatArray, size: FloatArray, cameras: Sequence[Camera], camera: IntArray
) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Yield (possible mistake, image points and photograph sizes without it, px)."""
    yield EXCHANGED, xy, size[:, ::-1]
    if given.unit == "mm":
        yield "read as px in place of mm they are inside", given.xy, size
        return
    read = xy.copy()
    for one, rows in zip(cameras, rows_of(camera, len(cameras)), strict=True):
        read[rows] = pixel_from_image(xy[rows], one.size_px, one.pixel_mm)
    yield "read as mm in place of px they are inside", read, size


@dataclass(frozen=True)
class MergedImagePoints:
    """Image points without repetitions."""

    image_points: ImagePoints
    same: tuple[tuple[int, int], ...]  # (photograph, point) of identical image points, merged
    averaged: tuple[tuple[int, int], ...]  # of those that differ by no more than chance, averaged
    dropped: tuple[tuple[int, int], ...]  # of those that contradict one another, left out
    dropped_rows: int  # number of image points that are left out

    def remarks(self, images: tuple[str, ...], points: tuple[str, ...]) -> tuple[Remark, ...]:
        """Return the remarks on repeated image points."""
        kinds = {
            "image_points_averaged": self.averaged,
            "image_points_contradicting": self.dropped,
        }
        same = [f"{points[j]} in {images[i]}" for i, j in self.same]
        return (
            *((remark("rows_identical", rows=same),) if same else ()),
            *(
                remark(kind, image_points=[f"{points[j]} in {images[i]}" for i, j in pairs])
                for kind, pairs in kinds.items()
                if pairs
            ),
        )


def merge_repeated(seen: ImagePoints) -> MergedImagePoints:
    """Merge repeated image points, at the position of their first row.

    Identical positions are one measurement that was written several times. Different positions are several
    measurements. If a chi-square test of their differences passes, their weighted mean is used. Otherwise it
    is unknown which is correct, and all are left out.
    """
    key = seen.image * (int(seen.point.max(initial=0)) + 1) + seen.point
    _, first, group, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    if (count == 1).all():
        return MergedImagePoints(seen, (), (), (), 0)
    xy, covariance = seen.xy.copy(), seen.covariance.copy()
    keep: BoolArray = np.zeros(len(seen), dtype=bool)
    keep[first] = True
    kinds: tuple[list[tuple[int, int]], ...] = ([], [], [])
    dropped = 0
    of_group = rows_of(group, len(count))
    for g in np.flatnonzero(count > 1):
        rows = of_group[g]
        one = rows[0]
        different = np.unique(seen.xy[rows], axis=0, return_index=True)[1]
        kind = 0
        if len(different) > 1:
            P = np.linalg.inv(seen.covariance[rows[different]])
            Q = np.linalg.inv(P.sum(axis=0))
            mean = Q @ np.einsum("nab,nb->a", P, seen.xy[rows[different]])
            d = seen.xy[rows[different]] - mean
            chi2 = float(np.einsum("na,nab,nb->", d, P, d))
            kind = 1 if chi2 <= chi2_ppf(1 - LEVEL, 2 * (len(different) - 1)) else 2
            xy[one], covariance[one] = mean, Q
        if kind == 2:
            keep[one] = False
            dropped += len(rows)
        kinds[kind].append((int(seen.image[one]), int(seen.point[one])))
    merged = ImagePoints(seen.image, seen.point, xy, covariance, seen.stated).select(keep)
    same, averaged, contradicting = (tuple(pairs) for pairs in kinds)
    return MergedImagePoints(merged, same, averaged, contradicting, dropped)


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
        control=control_points(survey.control, points),
        scale_bars=scale_bars(survey.scale_bars, points) if bars is None else bars,
    )
    if survey.exterior is not None and survey.datum.kind == "control":
        network = replace(network, exterior=exterior_observations(survey.exterior, images))
    return with_given_mounts(survey.given_mounts, with_moments(survey, with_tables(survey.tables, network)))


def with_given_mounts(mounts: MountObservations, network: Network) -> Network:
    """Return the network with given mounts as observations, except for mounts that are held fixed."""
    loose = mounts.select(np.flatnonzero(np.trace(mounts.covariance, axis1=1, axis2=2) > 0))
    return replace(network, observations=(*network.observations, loose)) if len(loose) else network


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
