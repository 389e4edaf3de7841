"""The network of a survey from the targets of its photographs: which target is which object point.

Coded targets are named by their codes. Uncoded targets are named by matching them over all oriented
photographs. Known distances on plates and tags become scale bars.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.matching.tracks.correspondence import match_targets
from sfm.model.camera import in_field, project
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ScaleBars, rows_of
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.diagnosis.codes_found import missing_plates, sides_not_found, small_codes
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.measurements import MeasuredPhotographs, Measurements, Naming, PhotographList
from sfm.survey.inputs.settings import MAX_LENGTH_PER_SIGMA, TargetSettings
from sfm.survey.inputs.start import network_of, scale_bars
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.measuring.targets import image_point_covariance, measure_photographs
from sfm.targets.codes.plates import plates_of
from sfm.targets.codes.tags import CORNERS, corner_name
from sfm.targets.outlines import Flag

UNNAMED = -1
# Relative standard deviation of the size of tags where the survey states none. Prints of desktop printers,
# and those made by mistake with the setting "fit to page", differ by this much once checked with a ruler.
TAG_SIGMA = 0.002
MAX_SEMI_AXES = 4.0  # a target nearer to its point than this many of its semi-axes is not another target
MIN_RAYS = 3  # photographs that must agree on an uncoded point; two rays cannot contradict each other


def measure_targets(
    survey: Survey,
    files: PhotographList,
    *,
    jobs: int = 1,
    store: MeasuredStore | None = None,
    progress: Progress = SILENT,
) -> Measurements:
    """Measure a survey's targets and return the network of the coded ones; the others are unnamed.

    Args, Raises: as in `measure_photographs`.
    """
    photographs = measure_photographs(survey, files, jobs=jobs, store=store, progress=progress)
    naming = name_coded(photographs)
    return Measurements(
        build_network(survey, photographs, naming),
        photographs.cameras,
        files.names,
        min_rays(naming),
        photographs.failed,
        photographs.overlays(),
        files,
        photographs,
        naming,
        (
            *small_codes(photographs.targets),
            *missing_plates(survey.family, photographs),
            *sides_not_found(survey.family, photographs),
        ),
    )


def min_rays(naming: Naming) -> IntArray:
    """Return how many photographs each point needs, (n,): codes confirm themselves, uncoded points do not."""
    return np.where(naming.code >= 0, 2, MIN_RAYS)


def name_coded(photographs: MeasuredPhotographs) -> Naming:
    """Name the coded targets by their code; a code read twice in one photograph names nothing there."""
    codes = [targets.code for targets in photographs.targets]
    numbers = np.unique(np.concatenate([code[code >= 0] for code in codes]))
    point = []
    for code in codes:
        values, first, count = np.unique(code, return_index=True, return_counts=True)
        once = first[(values >= 0) & (count == 1)]
        named = np.full(len(code), UNNAMED)
        named[once] = np.searchsorted(numbers, code[once])
        point.append(named)
    corners = any(bool((targets.flag & Flag.CORNER).any()) for targets in photographs.targets)
    names = tuple(corner_name(int(n)) if corners else str(n) for n in numbers)
    return Naming(names, numbers.astype(np.int64), tuple(point), corners)


def build_network(survey: Survey, photographs: MeasuredPhotographs, naming: Naming) -> Network:
    """Return the network of all named targets, with its control and scale bars."""
    named = [np.flatnonzero(point != UNNAMED) for point in naming.point]
    image = np.repeat(np.arange(len(named)), [len(rows) for rows in named])
    targets = list(zip(photographs.targets, named, strict=True))
    covariance = [
        image_point_covariance(of_photograph, survey.adjust.sigma_px)[rows] for of_photograph, rows in targets
    ]
    image_points = ImagePoints(
        image,
        np.concatenate([point[rows] for point, rows in zip(naming.point, named, strict=True)]),
        np.concatenate([of_photograph.xy[rows] for of_photograph, rows in targets]),
        np.concatenate(covariance),
    )
    bars = scale_bars((*survey.scale_bars, *plate_bars(survey, naming)), naming.names)
    if not survey.scale_bars and survey.control is None:
        bars = tag_bars(survey.targets, naming)
    return network_of(survey, photographs.names, photographs.camera, naming.names, image_points, bars=bars)


def plate_bars(survey: Survey, naming: Naming) -> list[ScaleBar]:
    """Return two diagonals of the seen part of each plate but the first, which is control."""
    bars = []
    for settings, plate in zip(survey.plates, plates_of(survey.family)[1:], strict=True):
        seen = naming.code[(naming.code >= plate.first_point) & (naming.code <= plate.last_point)]
        if not len(seen) or settings.pitch is None:
            continue
        xyz = plate.plane(settings.pitch)[seen - plate.first_point]
        for along in (xyz[:, 0] + xyz[:, 1], xyz[:, 0] - xyz[:, 1]):
            ends = along.argmin(), along.argmax()
            if along[ends[0]] == along[ends[1]]:
                continue  # two points at right angles to the diagonal
            length = float(np.linalg.norm(xyz[ends[1]] - xyz[ends[0]]))
            sigma = np.sqrt(2) * (settings.plate_sigma or 0.0)
            start, end = (str(seen[k]) for k in ends)
            bars.append(ScaleBar(start, end, length, max(sigma, length / MAX_LENGTH_PER_SIGMA)))
    return bars


def tag_bars(targets: TargetSettings, naming: Naming) -> ScaleBars:
    """Return the diagonals of all tags as scale bars; none if the size of the tags is unknown.

    All tags of a print have the same scale error, so together they give the scale no better than one tag
    does. Therefore each of n bars has the standard deviation of one bar times the square root of n.
    """
    size, sigma = targets.tag_size, targets.tag_sigma
    if size is None or not naming.corners:
        return ScaleBars()
    row = dict(zip(naming.code.tolist(), range(len(naming.code)), strict=True))
    ends = [
        (row[first], row[first + 2])
        for first in row
        if first >= 0 and first % len(CORNERS) < 2 and first + 2 in row  # a to c and b to d
    ]
    start, end = np.array(ends, dtype=np.int64).reshape(-1, 2).T
    size_sigma = sigma if sigma is not None else TAG_SIGMA * size
    n = len(start)
    return ScaleBars(start, end, np.full(n, np.sqrt(2) * size), np.full(n, np.sqrt(2 * n) * size_sigma))


def match_uncoded(
    photographs: MeasuredPhotographs, naming: Naming, estimate: Estimate, *, tolerance_px: float
) -> tuple[Naming, Estimate]:
    """Rename the uncoded targets by matching them over all oriented photographs.

    A coded target keeps its name if it lies within the tolerance of its point. Other coded targets, and
    targets whose code was not read, take the name of the coded point they coincide with. Without one they
    join the uncoded targets.

    Args:
        photographs: m photographs with their targets.
        naming: names so far; its uncoded points are dropped.
        estimate: orientation, and the points of `naming`.
        tolerance_px: largest distance of a target from its projected point, px.

    Returns:
        The naming with uncoded points after the coded ones, and the estimate with their coordinates.
    """
    coded = np.flatnonzero(naming.code >= 0)
    known = estimate.points[coded]
    oriented = estimate.oriented
    point = []
    for i, targets in enumerate(photographs.targets):
        named = np.full(len(targets), UNNAMED)
        if oriented[i]:
            camera = estimate.cameras[photographs.camera[i]]
            far_px = MAX_SEMI_AXES * targets.semi_axes[:, 0]
            pose, reach_px = (estimate.position[i], estimate.rotation[i]), float(max([tolerance_px, *far_px]))
            near = np.flatnonzero(in_field(camera, *pose, known, reach_px))
            of_near = _coinciding_points(
                targets.xy,
                project(camera, *pose, known[near]),
                targets.code,
                naming.code[coded[near]],
                tolerance_px,
                far_px,
            )
            named[of_near >= 0] = near[of_near[of_near >= 0]]
        point.append(named)
    free = [np.flatnonzero(named == UNNAMED) for named in point]
    matches = match_targets(
        estimate,
        photographs.camera,
        [targets.xy[rows] for targets, rows in zip(photographs.targets, free, strict=True)],
        tolerance_px=tolerance_px,
        min_rays=MIN_RAYS,
        diameters_px=[
            2 * targets.semi_axes[rows, 0] for targets, rows in zip(photographs.targets, free, strict=True)
        ],
    )
    for i, (rows, of_image) in enumerate(zip(free, rows_of(matches.image, len(free)), strict=True)):
        point[i][rows[matches.target[of_image]]] = len(coded) + matches.point[of_image]
    uncoded = len(matches.points)
    return (
        replace(
            naming,
            names=tuple(naming.names[j] for j in coded) + tuple(f"u{k + 1:03d}" for k in range(uncoded)),
            code=np.concatenate([naming.code[coded], np.full(uncoded, -1)]),
            point=tuple(point),
        ),
        replace(estimate, points=np.vstack([known, matches.points])),
    )


def _coinciding_points(
    xy: FloatArray,
    projected: FloatArray,
    code: IntArray,
    point_code: IntArray,
    tolerance_px: float,
    far_px: FloatArray,
) -> IntArray:
    """Return the coded point that each target coincides with, or UNNAMED; at most one target per point.

    A target with another code is never given the name of the point, since one of the two is wrong. A target
    with the code of the point keeps its name even beyond the tolerance, and the adjustment judges it. If it
    is farther than `far_px`, it is another target.
    """
    named = np.full(len(xy), UNNAMED)
    if not len(xy):
        return named
    for j in np.flatnonzero(np.isfinite(projected).all(axis=1)):
        distance = np.hypot(*(xy - projected[j]).T)
        distance[(code >= 0) & (code != point_code[j])] = np.inf
        of_code = np.flatnonzero((code == point_code[j]) & (distance <= far_px))
        k = int(of_code[np.argmin(distance[of_code])]) if len(of_code) else int(np.argmin(distance))
        if (len(of_code) or distance[k] <= tolerance_px) and named[k] == UNNAMED:
            named[k] = j
    return named
