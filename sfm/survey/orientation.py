"""The orientation of a survey, and what is told where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.camera import tangents_from_pixel
from sfm.conventions import BoolArray
from sfm.errors import GeometryError
from sfm.network import Estimate, Network, rows_of
from sfm.orientation.intersection import intersect
from sfm.orientation.sequence import MIN_POINTS, Judge, Orientation, orient
from sfm.photographs.reading import read_photograph
from sfm.reduced_network import reduce_network
from sfm.survey.circles import circle_misfit
from sfm.survey.inputs.measurements import MeasuredPhotographs, Measurements
from sfm.survey.inputs.start import start_values
from sfm.survey.inputs.survey import Survey
from sfm.survey.solution import refine
from sfm.targets.codes.rings import RINGS
from sfm.targets.detect import find_targets

ORIENTATION_POINTS = (
    400  # of natural texture that take part in the orientation, those with the most rays, and
)
CONTROL_OF_CAMERA = 6  # control points in the datum with which two photographs determine their camera
MAX_NAMES = 10  # photographs in a message
POINTS_PER_PHOTOGRAPH = 100  # of every photograph at least so many


def orient_survey(survey: Survey, measured: Measurements) -> Orientation:
    """Return approximate values of a survey's network.

    Args:
        survey: gives start values, if any; a failure names its settings.
        measured: all image points that have a name.

    Raises:
        GeometryError: no two photographs could be oriented.
    """
    network = measured.network
    estimate = start_values(survey, network, measured.cameras)
    try:
        if survey.tie_points:
            found = _orient_strongest(network, estimate)
        else:  # given image points are adjusted as they are, and judged by the adjustment
            found = _orient(
                network, estimate, contradicting=survey.observations is not None, judge=_judge(measured)
            )
    except GeometryError as error:
        if measured.photographs is not None and _most_in_common(network) < MIN_POINTS:
            raise GeometryError(_codes_found(survey, measured.photographs)) from error
        given = survey.start_orientations is not None or survey.start_points is not None
        hint = " (correct or complete [approximate], or leave it out)" if given else ""
        raise GeometryError(f"{error}{hint}") from error
    warnings = tuple(f"[approximate]: {line}" for line in found.warnings)
    found, held = _hold_cameras_of_two(survey, network, found)
    return replace(found, warnings=warnings + found.remarks + held)


def _orient(
    network: Network, estimate: Estimate, *, contradicting: bool = False, judge: Judge | None = None
) -> Orientation:
    """Orient all photographs on all points."""
    return orient(network, estimate, refine=refine, contradicting=contradicting, judge=judge)


def _hold_cameras_of_two(
    survey: Survey, network: Network, found: Orientation
) -> tuple[Orientation, tuple[str, ...]]:
    """Hold the free parameters of interior orientation where two photographs are all there is, and say so.

    The image points of a pair determine seven parameters, five of them the relative orientation (Hartley and
    Zisserman 2003, sec. 11.1): hardly c, and neither principal point nor distortion, which bend the object
    instead. A control field in the datum determines them, and observed parameters have their own precision.
    """
    estimate = found.estimate
    fixed = len(network.control) if survey.datum.kind == "control" else 0
    if estimate.oriented.sum() != 2 or fixed >= CONTROL_OF_CAMERA:
        return found, ()
    used = np.unique(network.camera[estimate.oriented])
    lines = []
    cameras = list(estimate.cameras)
    for index in used.tolist():
        camera = cameras[index]
        names = [name for name, free in zip(camera.names, camera.free, strict=True) if free]
        if names:
            cameras[index] = replace(camera, free=np.zeros_like(camera.free))
            lines.append(
                f"camera {camera.name}: {', '.join(names)} held at the start values: two photographs do not "
                "determine them; an error of c scales the depth, one of the distortion bends the object"
            )
    return replace(found, estimate=replace(estimate, cameras=tuple(cameras))), tuple(lines)


def _judge(measured: Measurements) -> Judge | None:
    """Return how little the outlines of the targets are images of circles; None without such targets."""
    photographs, naming = measured.photographs, measured.naming
    if photographs is None or naming is None or naming.corners:
        return None

    def misfit(estimate: Estimate) -> float:
        return circle_misfit(photographs, naming, measured.network, estimate)

    return misfit


def _orient_strongest(network: Network, estimate: Estimate) -> Orientation:
    """Orient the photographs on the points with the most rays, then intersect all the others.

    Thousands of points orient a survey no better than hundreds, and take their time in every trial.
    """
    images = np.ones(len(network.images), dtype=bool)
    image_points = np.ones(len(network.image_points), dtype=bool)
    found = _orient(*reduce_network(network, estimate, images, _strongest(network), image_points))
    seen, estimate = network.image_points, found.estimate
    uv = np.full((len(seen), 2), np.nan)
    of_camera = rows_of(network.camera[seen.image], len(estimate.cameras))
    for camera, own in zip(estimate.cameras, of_camera, strict=True):
        uv[own] = tangents_from_pixel(camera, seen.xy[own])
    c = min(camera.c_px for camera in estimate.cameras)
    rays = intersect(
        uv,
        seen.image,
        seen.point,
        estimate.position,
        estimate.rotation,
        n_points=len(network.points),
        tolerance=float(found.tolerance_px.max()) / c,
    )
    return replace(found, estimate=replace(estimate, points=rays.points), point_failures=())


def _strongest(network: Network) -> BoolArray:
    """Choose the points with the most rays, and in every photograph at least some, (n,)."""
    seen = network.image_points
    order = np.argsort(-network.rays(), kind="stable")
    chosen = np.zeros(len(network.points), dtype=bool)
    chosen[order[:ORIENTATION_POINTS]] = True
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    for rows in rows_of(seen.image, len(network.images)):
        own = seen.point[rows]
        chosen[own[np.argsort(rank[own], kind="stable")][:POINTS_PER_PHOTOGRAPH]] = True
    return chosen


def _most_in_common(network: Network) -> int:
    """Return how many points the two photographs with most in common share."""
    common = network.common_points(np.ones(len(network.image_points), dtype=bool))[2]
    return int(common.max(initial=0))


def _codes_found(survey: Survey, photographs: MeasuredPhotographs) -> str:
    """Say how many targets and codes were found where more codes were needed, and what decides on that."""
    targets = [len(found) for found in photographs.targets]
    codes = [int((found.code >= 0).sum()) for found in photographs.targets]
    with_codes = sum(count > 0 for count in codes)
    settings = survey.targets
    other = _other_family(survey, photographs)
    return (
        f"no two photographs have {MIN_POINTS} coded targets in common, which their orientation needs: "
        f"{sum(targets)} targets were found in {len(targets)} photographs, {sum(codes)} codes were read in "
        f"{with_codes} of them{_by_photograph(photographs, codes)}; check in [targets] "
        f"codes = '{settings.codes}', "
        f"polarity = '{settings.polarity}' and min_diameter_px = {settings.min_diameter_px:g}{other}"
    )


def _by_photograph(photographs: MeasuredPhotographs, codes: list[int]) -> str:
    """Say how many codes were read in each of the first photographs, if any were."""
    if not any(codes):
        return ""
    shown = zip(photographs.names[:MAX_NAMES], codes, strict=False)
    more = " ..." if len(codes) > MAX_NAMES else ""
    return f" ({', '.join(f'{name}: {count}' for name, count in shown)}{more})"


def _other_family(survey: Survey, photographs: MeasuredPhotographs) -> str:
    """Say which other rings or arcs read more in the photograph with most targets, if any do."""
    settings = survey.targets
    if settings.codes not in (*RINGS, "none"):
        return ""
    fullest = int(np.argmax([len(found) for found in photographs.targets]))
    photograph = read_photograph(photographs.paths[fullest], channel=settings.channel)
    counts = []
    for family in RINGS:
        if family == settings.codes:
            continue
        found = find_targets(
            photograph,
            polarity=settings.polarity,
            codes=family,
            min_diameter_px=settings.min_diameter_px,
        )
        counts.append((len(np.unique(found.code[found.code >= 0])), family))
    most, best = max(counts)
    own = photographs.targets[fullest].code
    if most < MIN_POINTS or most <= len(np.unique(own[own >= 0])):
        return ""
    return f"; in {photographs.names[fullest]} codes = '{best}' reads {most} codes"
