"""Rays of single object points: what each adds to the normal equations of its point, cameras as adjusted.

By these the tests of single points try other explanations of a point's residuals, without adjusting again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.camera import pixel_jacobian, project
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.network import Estimate, rows_of


@dataclass(frozen=True)
class PointNormals:
    """Contribution of each image point to the normal equations of its object point, over their sigma0^2."""

    N: FloatArray  # (k, 3, 3)
    b: FloatArray  # A'Pv, (k, 3)
    q: FloatArray  # v'Pv, (k,)

    def misfit(self, rows: IntArray) -> float:
        """Return v'Pv after a fit of the point to these rows alone."""
        N, b = self.N[rows].sum(axis=0), self.b[rows].sum(axis=0)
        return float(self.q[rows].sum() - b @ np.linalg.lstsq(N, b, rcond=None)[0])

    def misfits(self, groups: BoolArray, rows: IntArray) -> FloatArray:
        """Return v'Pv after a fit of the point to each of some groups of rows alone, (g,).

        Args:
            groups: which of the rows are in each group, (g, m).
            rows: image points of one object point, (m,).
        """
        some = groups.astype(float)
        N, b = np.tensordot(some, self.N[rows], 1), some @ self.b[rows]
        fitted = np.einsum("gi,gij,gj->g", b, np.linalg.pinv(N, hermitian=True), b)
        return np.asarray(some @ self.q[rows] - fitted)

    def step(self, rows: IntArray) -> FloatArray:
        """Return how a fit to these rows alone moves the point, (3,)."""
        N, b = self.N[rows].sum(axis=0), self.b[rows].sum(axis=0)
        return np.asarray(-np.linalg.lstsq(N, b, rcond=None)[0])

    def rows_of_points(self, adjustment: Adjustment) -> list[IntArray]:
        """Return the usable image points of each object point, in order of photographs."""
        seen = adjustment.network.image_points
        usable = np.isfinite(self.q) & np.isfinite(self.b).all(axis=1)
        order = np.lexsort((seen.image, seen.point))
        order = order[usable[order]]
        bounds = np.searchsorted(seen.point[order], np.arange(1, len(adjustment.network.points)))
        return np.split(order, bounds)


MAX_STEPS = 10  # of an intersection that begins at the adjusted point
LAST_STEP_SIGMAS = 1e-3  # standard deviations


def intersected(adjustment: Adjustment, rows: IntArray) -> tuple[FloatArray, FloatArray, float]:
    """Return position (3,), cofactors (3, 3) and v'Pv over sigma0^2 of a point from some of its rays alone.

    Where it lies far from the adjusted point, as where two points have one name, a single step would not do.
    """
    network = adjustment.network
    j = int(network.image_points.point[rows[0]])
    alone = replace(
        adjustment,
        network=replace(network, image_points=network.image_points.select(rows)),
        image_sigma_factor=adjustment.image_sigma_factor[rows],
        residuals=adjustment.residuals[rows],
    )
    X, every = adjustment.estimate.points[j], np.arange(len(rows))
    for _ in range(MAX_STEPS):
        parts = point_normals(alone, adjustment.image_sigma0)
        if not np.isfinite(parts.q).all():
            return X, np.full((3, 3), np.nan), np.inf
        Q = np.linalg.pinv(parts.N.sum(axis=0))
        step = -Q @ parts.b.sum(axis=0)
        if step @ parts.N.sum(axis=0) @ step < LAST_STEP_SIGMAS**2:
            break
        X = X + step
        alone = replace(alone, residuals=_residuals(alone, X), estimate=_moved(alone.estimate, j, X))
    return X, Q, parts.misfit(every)


def _moved(estimate: Estimate, point: int, X: FloatArray) -> Estimate:
    points = estimate.points.copy()
    points[point] = X
    return replace(estimate, points=points)


def _residuals(alone: Adjustment, X: FloatArray) -> FloatArray:
    """Return v = computed - measured of the image points of one point at X, px, (k, 2)."""
    seen, estimate = alone.network.image_points, alone.estimate
    computed = [
        project(
            estimate.cameras[alone.network.camera[i]], estimate.position[i], estimate.rotation[i], X[None]
        )
        for i in seen.image
    ]
    return np.asarray(np.concatenate(computed) - seen.xy)


def point_normals(adjustment: Adjustment, sigma0: float | None = None) -> PointNormals:
    """Return the normal equations of every image point, rejected ones included, (k,).

    Args:
        adjustment: finished, or with some of its image points.
        sigma0: of the image points, that of the adjustment if not given.
    """
    network, estimate = adjustment.network, adjustment.estimate
    seen = network.image_points
    R, X = estimate.rotation[seen.image], estimate.points[seen.point] - estimate.position[seen.image]
    UVW = np.einsum("kji,kj->ki", R, X)
    W = UVW[:, 2]
    uv = -UVW[:, :2] / W[:, None]
    A = -(np.swapaxes(R, 1, 2)[:, :2] + uv[:, :, None] * R[:, None, :, 2]) / W[:, None, None]
    of_camera = rows_of(network.camera[seen.image], len(estimate.cameras))
    for camera, rows_of_camera in zip(estimate.cameras, of_camera, strict=True):
        if len(rows_of_camera):
            A[rows_of_camera] = pixel_jacobian(camera, seen.xy[rows_of_camera]) @ A[rows_of_camera]
    P = (
        np.linalg.inv(adjustment.image_covariance)
        / (adjustment.image_sigma0 if sigma0 is None else sigma0) ** 2
    )
    v = adjustment.residuals
    AP = np.einsum("kai,kab->kib", A, P)
    return PointNormals(AP @ A, np.einsum("kib,kb->ki", AP, v), np.einsum("ka,kab,kb->k", v, P, v))
