"""Given image points of a survey, of another program or measured by hand, in photographs or in their place.

Image points outside their photograph mean that a value or a setting is wrong. A few are gross errors and are
left out. If there are more, the survey is refused, and the message states what would bring them inside: x and
y exchanged, another unit, or a larger photograph.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from sfm.judgement.survey_result import FailedImage, LeftOutPoint, PhotographTargets
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray, IntArray, pixel_from_image, pixel_from_longer_side
from sfm.model.display import listed
from sfm.model.errors import SurveyFileError
from sfm.model.network import ImagePoints, Network, Source, rows_of
from sfm.model.remarks.remark import Remark, remark
from sfm.photographs.masks import Masks
from sfm.survey.inputs.cameras import camera_of_images, refuse_ungrouped, start_cameras
from sfm.survey.inputs.checks.copies import same_photographs
from sfm.survey.inputs.given_values import Observations
from sfm.survey.inputs.measurements import (
    NO_PHOTOGRAPHS,
    Measurements,
    PhotographList,
    readable_photographs,
    refuse_many,
)
from sfm.survey.inputs.sources import tables_of
from sfm.survey.inputs.start import network_of, refuse_unknown_photographs
from sfm.survey.inputs.survey import Survey
from sfm.survey.sources.repeated import MergedImagePoints, merge_repeated, without_repeated
from sfm.survey.sources.source import SurveySource, complete_as_measured

MARGIN_PX = 1.0  # difference to programs that count pixels from 1 or from corners
MAX_OUTSIDE = 0.05  # of the image points; measuring never makes more gross errors
MIN_RAYS = 2  # photographs that a point with a name needs
DRAWN_PX = 8.0  # radius of the circles around given image points in the report


def measure_given(survey: Survey, files: PhotographList = NO_PHOTOGRAPHS, **_: object) -> Measurements:
    """Return the network of the image points that a survey gives.

    Args:
        survey: a survey with given image points.
        files: its photographs; none if the image points stand in their place.

    Raises:
        SurveyFileError: as in `read_tables`, or there are no observations.
        PhotographError: photographs of different sizes have the same camera.
    """
    tables: tuple[Observations, ...] = tables_of(survey.observations)
    if not tables:
        raise SurveyFileError(f"{survey.source}: [observations] with a file of image points is needed")
    return read_tables(survey, tables, files)


def read_tables(survey: Survey, tables: tuple[Observations, ...], files: PhotographList) -> Measurements:
    """Return the network of tables of image points.

    Photographs and points are numbered in the order in which the tables first name them; photographs that
    all have start orientations in the order of these, since what moved during a survey is sought in the order
    of its photographs. The control is part of the network in every datum. The adjustment uses it only if the
    datum is `control`.

    Args:
        survey: gives cameras, and masks.
        tables: the image points.
        files: photographs; none if the image points stand in their place. A table may name others.

    Raises:
        SurveyFileError: image points are outside their photographs, or the start values of a camera are
            incomplete.
        PhotographError: photographs of different sizes have the same camera.
    """
    readable, metadata = readable_photographs(files)
    cameras = start_cameras(
        survey.cameras,
        survey.source,
        metadata,
        files.camera[readable],
        tuple(files.names[k] for k in readable),
        survey.start_cameras,
    )
    names = [name for table in tables for name in table.image]
    started = () if survey.start_orientations is None else survey.start_orientations.names
    images, image = _numbered(names, order=started)
    refuse_many(str(tables[0].table.path), images)
    points, point = _numbered([name for table in tables for name in table.point])
    owner = _cameras_of(survey, files, images)
    refuse_ungrouped(survey.cameras, images, owner, survey.source)
    parts, outside_parts, first = [], [], 0
    for number, table in enumerate(tables):
        rows = slice(first, first + len(table))
        first = rows.stop
        camera = owner[image[rows]]
        xy, covariance = in_pixels(table, cameras, camera, table.sigma_px or survey.adjust.sigma_px)
        outside_parts.append(refuse_outside(table, xy, cameras, camera))
        sigma = np.full(xy.shape, np.nan) if table.sigma is None else table.sigma
        stated = np.asarray(np.isfinite(sigma).all(axis=1)) | (table.sigma_px is not None)
        source = np.full(len(table), number)
        parts.append(ImagePoints(image[rows], point[rows], xy, covariance, stated, source))
    seen, outside = ImagePoints.joined(parts), np.concatenate(outside_parts)
    gross = [f"{points[seen.point[k]]} in {images[seen.image[k]]}" for k in np.flatnonzero(outside)]
    refuse_unknown_photographs(survey, (*files.names, *images))
    # of photographs that are here, copies are found by their pictures
    copies = {} if len(files) else same_photographs(seen.image, seen.point, seen.xy, owner)
    every, used = images, _used_photographs(images, files, copies)
    number_of = np.cumsum(used) - 1
    failed = tuple(
        FailedImage(every[i], remark("copies", original=every[j], same="image points"))
        for i, j in copies.items()
    )
    sizes = [cameras[camera].size_px for camera in owner.tolist()]
    kept = used[seen.image] & ~outside
    kept &= Masks(survey.masks).visible_points(images, sizes, seen.image, seen.xy)
    images, owner = tuple(name for name, keep in zip(images, used, strict=True) if keep), owner[used]
    seen = replace(seen.select(kept), image=number_of[seen.image[kept]])
    merged, offsets = _merge_tables(seen, tables)
    if len(files):  # what the survey gives besides is part of the network of all sources
        network = Network(images, owner, points, merged.image_points)
    else:
        network = network_of(survey, images, owner, points, merged.image_points)
    times = Counter(zip(seen.image.tolist(), seen.point.tolist(), strict=True))
    left_out = []
    for i, j in merged.dropped:
        name = f"{points[j]} in {images[i]}"
        reason = remark("image_points_contradicting", image_points=name)
        left_out.append(LeftOutPoint(name, times[i, j], reason))
    left_out += [LeftOutPoint(name, 1, remark("image_points_outside", image_points=name)) for name in gross]
    outside_remark = (remark("image_points_outside", image_points=gross),) if gross else ()
    return Measurements(
        network,
        cameras,
        every,
        np.full(len(points), MIN_RAYS),
        failed,
        _overlays(network, files, readable),
        remarks=(*offsets, *merged.remarks(images, points), *outside_remark),
        left_out=tuple(left_out),
    )


def _used_photographs(images: Sequence[str], files: PhotographList, copies: Collection[int]) -> BoolArray:
    """Return which photographs take part, (m,): no copies, and no files that were left out for their size."""
    known = set(files.names)
    left_out = [name not in known and bool(known) and (files.folder / name).is_file() for name in images]
    distinct = np.isin(np.arange(len(images)), list(copies), invert=True)
    return np.asarray(distinct & ~np.array(left_out, dtype=bool))


def _merge_tables(
    seen: ImagePoints, tables: Sequence[Observations]
) -> tuple[MergedImagePoints, tuple[Remark, ...]]:
    """Merge what a table has several times, and use the first of tables that have the same image point.

    Of matches, which are numbered anew in each run, nobody is told.
    """
    if len(tables) == 1:
        merged_table = merge_repeated(replace(seen, source=None))
        told = tables[0].names_last
        return (merged_table if told else replace(merged_table, same=(), averaged=())), ()
    of_table = np.zeros(len(seen), dtype=np.int64) if seen.source is None else seen.source
    merged = [merge_repeated(seen.select(np.asarray(of_table == k))) for k in range(len(tables))]
    every = ImagePoints.joined([part.image_points for part in merged])
    once = without_repeated(every, tuple(Source(table.table.path.name) for table in tables))
    same, averaged, dropped = (
        tuple(pair for part in merged for pair in getattr(part, name))
        for name in ("same", "averaged", "dropped")
    )
    return (
        MergedImagePoints(
            replace(once.image_points, source=None),
            same,
            averaged,
            (*dropped, *once.contradicting),
            sum(part.dropped_rows for part in merged) + 2 * len(once.contradicting),
        ),
        once.remarks,
    )


def _cameras_of(survey: Survey, files: PhotographList, images: Sequence[str]) -> IntArray:
    """Return the camera of each photograph: that of its file, or by its name, (m,)."""
    camera_of = dict(zip(files.names, files.camera.tolist(), strict=True))
    without_file = [name for name in images if name not in camera_of]
    others = camera_of_images(survey.cameras, without_file, survey.source)
    camera_of |= dict(zip(without_file, others, strict=True))
    return np.array([camera_of[name] for name in images], dtype=np.int64)


def _numbered(names: Sequence[str], *, order: Sequence[str] = ()) -> tuple[tuple[str, ...], IntArray]:
    """Return the unique names and the index of each entry; in order of `order`, if all of them are in it."""
    known = set(names)
    number: dict[str, int] = {}
    if known <= set(order):
        number = {name: k for k, name in enumerate(name for name in order if name in known)}
    index = np.array([number.setdefault(name, len(number)) for name in names], dtype=np.int64)
    return tuple(number), index


def _overlays(network: Network, files: PhotographList, readable: IntArray) -> tuple[PhotographTargets, ...]:
    """Return circles around the given image points of each photograph that can be read."""
    index = {name: i for i, name in enumerate(network.images)}
    of_image = rows_of(network.image_points.image, len(network.images))
    drawn = []
    for k in readable.tolist():
        if files.names[k] in index:
            xy = network.image_points.xy[of_image[index[files.names[k]]]]
            circles = np.full((len(xy), 2), DRAWN_PX), np.zeros(len(xy))
            none = np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
            drawn.append(PhotographTargets(files.names[k], files.paths[k], xy, *circles, *none))
    return tuple(drawn)


def in_pixels(
    given: Observations, cameras: tuple[Camera, ...], camera: IntArray, sigma_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return positions, px, (k, 2), and their covariance, px^2, (k, 2, 2), of rows in px or mm."""
    xy, sigma = given.xy, given.sigma
    between = np.zeros(len(xy)) if given.covariance is None else given.covariance.copy()
    xy_px = xy.copy()
    s = np.full(xy.shape, sigma_px) if sigma is None else sigma.copy()
    if given.unit == "of the longer side":
        size = np.array([lens.size_px for lens in cameras], dtype=float)[camera]
        xy_px = pixel_from_longer_side(xy, size)
    if given.unit == "mm":
        for lens, rows in zip(cameras, rows_of(camera, len(cameras)), strict=True):
            xy_px[rows] = pixel_from_image(xy[rows], lens.size_px, lens.pixel_mm)
            if sigma is not None:
                s[rows] = sigma[rows] / lens.pixel_mm
                between[rows] /= -lens.pixel_mm.prod()  # y is up in the image frame, down in px
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
    size = np.array([lens.size_px for lens in cameras], dtype=float)[camera]
    outside = outside_photograph(xy, size)
    count, allowed = int(outside.sum()), MAX_OUTSIDE * len(xy)
    if not count:
        return outside
    # possible mistakes, with image points and sizes of photographs without them, px
    mistakes = [(EXCHANGED, xy, size[:, ::-1])]
    if given.unit == "mm":
        mistakes.append(("read as px in place of mm they are inside", given.xy, size))
    else:
        read = xy.copy()
        for lens, rows in zip(cameras, rows_of(camera, len(cameras)), strict=True):
            read[rows] = pixel_from_image(xy[rows], lens.size_px, lens.pixel_mm)
        mistakes.append(("read as mm in place of px they are inside", read, size))
    reasons = [
        words
        for words, other, other_size in mistakes
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


SOURCE = SurveySource(measure_given, complete_as_measured)
