"""The scene of a survey's result, with what was measured and rejected in its photographs."""

from __future__ import annotations

import numpy as np

from sfm.conventions import FloatArray
from sfm.report.findings.findings import Findings
from sfm.report.viewer.scene import Bar, Rays, ViewerScene, distance_sigmas
from sfm.report.viewer.seen_targets import joined_targets


def scene_of_result(findings: Findings) -> ViewerScene:
    """Return what the viewer shows of a survey."""
    result = findings.result
    a, geometry = result.adjustment, findings.geometry
    network, estimate = a.network, a.estimate
    seen = network.image_points
    order = np.lexsort((seen.image, seen.point))
    ellipse, marks = joined_targets(result.seen_targets, seen.image, seen.xy)
    rays = Rays(
        seen.point[order],
        seen.image[order],
        seen.xy[order],
        a.residuals[order],
        _or_nan(a.standardised, len(seen))[order],
        a.rejected[order],
        ellipse[order],
    )
    joint = result.solution.with_joint_covariance
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
