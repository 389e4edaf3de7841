"""Robust space resection from many points with gross errors and unknown noise.

The model has two kinds of points. Correct points share one unknown standard deviation. Wrong points lie
anywhere in the photograph with equal probability. The points that count as correct are those that make the
measurements most likely. Least squares adjusts them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import gammaln

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.orientation.resection.least_squares import UNKNOWNS, pose_normals, resect_least_squares
from sfm.orientation.resection.ransac import SAMPLE, RobustResection, resect_robust

# Tolerances to try, tangents: from a tenth of the principal distance to below the precision of any camera.
TOLERANCES = 0.1 * 0.5 ** np.arange(17)
# Lower bound of a residual, tangents: the rounding error of typical input.
LEAST_RESIDUAL = 1e-9
ROUNDS = 20  # rounds of least squares and a new selection of correct points


@checked_arguments(tangents="k 2", points="n 3")
def resect_unknown_noise(tangents: FloatArray, points: FloatArray, *, seed: int = 0) -> RobustResection:
    """Return the exterior orientation that makes the measured points most likely, whatever their noise.

    Args:
        tangents: u = -U/W, v = -V/W of the measured rays, shape (n, 2).
        points: object points, shape (n, 3), object unit.
        seed: seed for sampling triples; the same seed gives the same result.

    Returns:
        The orientation by least squares over the correct points, or the reason why there is none.

    Source: Torr and Zisserman (2000), MLESAC, CVIU 78, for the mixture; the standard deviation is integrated
    out, Box and Tiao (1973), Bayesian Inference in Statistical Analysis, sec. 2.7.
    """
    uv = np.ascontiguousarray(tangents, dtype=float).reshape(-1, 2)
    xyz = np.ascontiguousarray(points, dtype=float).reshape(-1, 3)
    field = max(float(np.prod(np.ptp(uv, axis=0))), LEAST_RESIDUAL) if len(uv) else 1.0
    best, best_likelihood = None, -(len(uv) - SAMPLE) * np.log(field)  # three points always fit
    failure = None
    for tolerance in TOLERANCES:
        if best is not None and tolerance < best.sigma0:  # tighter tolerances reject correct points
            break
        start = resect_robust(uv, xyz, tolerance=float(tolerance), seed=seed)
        failure = failure or start
        if not start.found:
            continue
        refined, likelihood = _refine(uv, xyz, start, field)
        if likelihood > best_likelihood:
            best, best_likelihood = refined, likelihood
    assert failure is not None
    if best is not None:
        return best
    return replace(failure, reason=failure.reason or "its points fit no better than random ones")


def _refine(
    uv: FloatArray, xyz: FloatArray, start: RobustResection, field: float
) -> tuple[RobustResection, float]:
    """Return the orientation by least squares over the correct points, and ln of its likelihood."""
    residuals = start.residuals
    used, likelihood = _select_points(residuals, field)
    weights = np.ascontiguousarray(np.broadcast_to(np.eye(2), (len(uv), 2, 2)))
    X0, R, fitted = start.position, start.rotation, None
    for _ in range(ROUNDS):
        try:
            trial = resect_least_squares(uv[used], xyz[used], X0, R)
        except GeometryError:
            break
        # v: residuals of all points, tangents, NaN behind the camera; N of the used points
        trial_N, g, v = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS), np.empty((len(uv), 2))
        pose_normals(uv, xyz, weights, used, trial.position, trial.rotation, trial_N, g, v)
        selected, trial_likelihood = _select_points(v, field)
        if fitted is not None and trial_likelihood <= likelihood:
            break
        fitted, residuals, likelihood, N = trial, v, trial_likelihood, trial_N
        X0, R = trial.position, trial.rotation
        inliers, used = used, selected
        if (inliers == selected).all():
            break
    if fitted is None:
        return start, -np.inf
    return (
        replace(
            start,
            position=fitted.position,
            rotation=fitted.rotation,
            inliers=inliers,
            residuals=residuals,
            rms=fitted.rms,
            sigma0=fitted.sigma0,
            sigma=fitted.sigma0,
            normal_matrix=N,
        ),
        likelihood,
    )


def _select_points(residuals: FloatArray, field: float) -> tuple[BoolArray, float]:
    """Return which points are correct, (n,), and ln of the likelihood.

    Args:
        residuals: residuals of all points, tangents, NaN behind the camera, shape (n, 2).
        field: area over which wrong points spread, squared tangents.
    """
    n = len(residuals)
    squares = np.sum(residuals**2, axis=1)
    squares = np.maximum(np.where(np.isfinite(squares), squares, np.inf), LEAST_RESIDUAL**2)
    order = np.argsort(squares, kind="stable")
    k = np.arange(SAMPLE + 1, n + 1)
    half = k - UNKNOWNS / 2  # half the redundancy
    right = gammaln(half) - half * np.log(np.pi * np.cumsum(squares[order])[k - 1])
    choice = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
    likelihood = right - (n - k) * np.log(field) - choice
    at = int(np.argmax(likelihood))
    used = np.zeros(n, dtype=bool)
    used[order[: k[at]]] = True
    return used, float(likelihood[at])
