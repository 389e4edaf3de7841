"""The scene of a survey's result, with what was measured and rejected in its photographs."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from sfm.conventions import FloatArray, IntArray
from sfm.report.findings.findings import Findings
from sfm.report.viewer.scene import Bar, Marks, Rays, ViewerScene, distance_sigmas
from sfm.result import PhotographTargets, in_words
from sfm.targets.flags import Flag

SAME_PX = 0.5  # between a target and the image point made of it: re-measuring may move it
UNUSED = "measured, not part of the result"


def scene_of_result(findings: Findings) -> ViewerScene:
    """Return what the viewer shows of a survey."""
    result = findings.result
    a, geometry = result.adjustment, findings.geometry
    network, estimate = a.network, a.estimate
    seen = network.image_points
    order = np.lexsort((seen.image, seen.point))
    ellipse, marks = _targets(findings, seen.image, seen.xy)
    rays = Rays(
        seen.point[order],
        seen.image[order],
        seen.xy[order],
        a.residuals[order],
        _or_nan(a.standardised, len(seen))[order],
        a.rejected[order],
        ellipse[order],
    )
    joint = result.with_covariance
    bars = network.scale_bars
    length = np.linalg.norm(estimate.points[bars.end] - estimate.points[bars.start], axis=1)
    return ViewerScene(
        result.survey,
        result.length_unit,
        estimate.cameras,
        network.points,
        estimate.points,
        a.covariance.points,
        geometry.rays,
        geometry.angle_deg,
        geometry.point_rms_px,
        network.images,
        network.camera,
        estimate.position,
        estimate.rotation,
        np.hstack([findings.precision.exterior[:, :3], np.degrees(findings.precision.exterior[:, 3:])]),
        geometry.image_rms_px,
        geometry.image_points,
        rays,
        marks,
        tuple(
            Bar(int(i), int(j), float(given), float(sigma), float(now - given))
            for i, j, given, sigma, now in zip(
                bars.start, bars.end, bars.length, bars.sigma, length, strict=True
            )
        ),
        tuple(map(int, network.control.point)) or _checked(findings),
        None
        if joint.covariance is None or joint.covariance_points is not None
        else distance_sigmas(estimate.points, joint.covariance),
        a.rms_px,
    )


def _checked(findings: Findings) -> tuple[int, ...]:
    """Return the control that took no part and was checked afterwards."""
    check, names = findings.result.control_check, findings.result.adjustment.network.points
    return () if check is None else tuple(names.index(name) for name in check.points if name in names)


def _or_nan(values: FloatArray, count: int) -> FloatArray:
    """Return values of image points (k, 2), NaN where the adjustment has none."""
    return values if len(values) == count else np.full((count, 2), np.nan)


def _targets(findings: Findings, image: IntArray, xy: FloatArray) -> tuple[FloatArray, Marks]:
    """Return the ellipse of each image point, (k, 3), and what else was seen in the photographs."""
    result = findings.result
    ellipse = np.full((len(xy), 3), np.nan)
    index = {name: i for i, name in enumerate(result.adjustment.network.images)}
    reasons: dict[str, int] = {}
    found: list[tuple[int, FloatArray, IntArray]] = []
    for one in result.photographs:
        i = index.get(one.image)
        if i is None:
            continue
        rows = np.flatnonzero(image == i)
        used = _join(one, xy[rows])
        ellipse[rows[used[used >= 0]]] = np.column_stack([one.semi_axes, one.angle])[used >= 0]
        words = [UNUSED] * int((used < 0).sum()) + [_reason(int(flag)) for flag in one.rejected_flag]
        numbers = np.array([reasons.setdefault(word, len(reasons)) for word in words], dtype=np.int64)
        found.append((i, np.vstack([one.xy[used < 0], one.rejected_xy.reshape(-1, 2)]), numbers))
    if not found:
        return ellipse, Marks.none()
    found.sort(key=lambda one: one[0])
    photo = np.concatenate([np.full(len(numbers), i) for i, _, numbers in found])
    where = np.concatenate([places for _, places, _ in found])
    return ellipse, Marks(photo, where, np.concatenate([n for _, _, n in found]), tuple(reasons))


def _join(photograph: PhotographTargets, xy: FloatArray) -> IntArray:
    """Return for each target of a photograph the image point that was made of it, -1 for none, (k,)."""
    if not len(photograph.xy) or not len(xy):
        return np.full(len(photograph.xy), -1, dtype=np.int64)
    distance, nearest = cKDTree(xy).query(photograph.xy, distance_upper_bound=SAME_PX)
    return np.where(np.isfinite(distance), nearest, -1)


@cache
def _reason(flag: int) -> str:
    """Return in words why a candidate was not measured."""
    names = [in_words(str(one.name).lower()) for one in Flag if one.value and flag & one.value]
    return ", ".join(names) or "no reason kept"
