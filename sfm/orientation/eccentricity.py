"""Eccentricity: the difference between the centre of a circle's image and the image of the circle's centre.

A circle has radius r, unit vectors e1, e2 across its normal n, and d from the projection centre to its
centre, all in image axes. Its points have the rays G (cos t, sin t, 1)' in the coordinates (u, v, 1), with G
= diag(1, 1, -1) (r e1, r e2, d). The dual conic of its image is D = G diag(1, 1, -1) G'. Scaled to D33 = -1
it is (S - m m', -m; -m', -1), with the centre m and the shape S of the ellipse. Radius and normal of a target
are fitted to its ellipses in all photographs. The shift m - (image of the centre) follows from them.

Source: Ahn, Warnecke and Kotowski (1999), Photogrammetric Record 16(93); Hartley and Zisserman (2003),
Multiple View Geometry, sec. 2.2.3 (dual conics) and 2.3.1 (their transformation).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sfm.model.conventions import MAD_TO_SIGMA, FloatArray, IntArray
from sfm.model.network import sum_rows

STEPS = 30  # largest number of Gauss-Newton steps; six to ten are usual
SETTLED = 1e-8  # last change of the normal, rad, and relative change of the radius
DIFFERENCE = 1e-6  # step of the difference quotients, rad and relative
LONGEST_STEP = 0.3  # rad and relative; beyond it, ellipses turn into other conics
HUBER = 2.0  # robust sigmas beyond which residuals lose weight; Huber (1981), Robust Statistics, ch. 4


@dataclass(frozen=True)
class Circles:
    """Circular targets in space, and the eccentricity of their images."""

    radius: FloatArray  # object unit, (n,)
    normal: FloatArray  # unit vectors towards the cameras, object axes, (n, 3)
    covariance: FloatArray  # covariance of two tilts of the normal (rad) and ln radius, (n, 3, 3)
    misfit: FloatArray  # root mean square relative difference of the semi-axes from the predicted ones, (n,)
    shift: FloatArray  # centre of the ellipse minus image of the circle's centre, px, (k, 2)
    shift_covariance: FloatArray  # px^2, (k, 2, 2)


@dataclass(frozen=True)
class CircleViews:
    """Views of circular targets in the photographs, one row for each image point."""

    point: IntArray  # index of the target, (k,)
    shape: FloatArray  # measured ellipses, S in (x - m)' S^-1 (x - m) = 1, px^2, (k, 2, 2)
    rays: FloatArray  # from the projection centre to the target, image axes, object unit, (k, 3)
    rotation: FloatArray  # R of the photograph, image to object axes, (k, 3, 3)
    pixel_jacobian: FloatArray  # d pixel / d (u, v) at the target, px, (k, 2, 2)
    pixel_curvature: FloatArray  # d^2 pixel / d (u, v)^2 at the target, px, (k, 2, 2, 2)


def fit_circles(views: CircleViews, n_points: int, *, radius: FloatArray | None = None) -> Circles:
    """Fit circles to the measured ellipses, and return their eccentricity in each photograph.

    Args:
        views: views in at least two photographs of each target.
        n_points: number of targets.
        radius: known radius of each target, NaN where unknown, object unit, (n,).
    """
    point = views.point
    known = np.full(n_points, np.nan) if radius is None else radius
    # start with normals towards the mean of the cameras, and radii from the major axes
    towards = -np.einsum("kij,kj->ki", views.rotation, views.rays)
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    normal = sum_rows(views.point, towards, n_points)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    scale = np.sqrt(np.abs(np.linalg.det(views.pixel_jacobian)))
    major = np.sqrt(np.linalg.eigvalsh(views.shape)[:, 1]) / scale * np.abs(views.rays[:, 2])
    count = np.bincount(views.point, minlength=n_points)
    log_radius = np.bincount(views.point, np.log(major), minlength=n_points) / count
    log_radius = np.where(np.isfinite(known), np.log(np.where(np.isfinite(known), known, 1.0)), log_radius)
    whitening = np.linalg.inv(np.linalg.cholesky(views.shape))
    weight = np.ones(len(point))
    for _ in range(STEPS):
        v = _misfit(views, whitening, normal, log_radius)
        axes = _across(normal)
        A = _derivatives(lambda n, r: _misfit(views, whitening, n, r), normal, axes, log_radius)
        A[np.isfinite(known)[point], :, 2] = 0.0
        N = sum_rows(point, np.einsum("k,kia,kib->kab", weight, A, A), n_points)
        b = sum_rows(point, -np.einsum("k,kia,ki->ka", weight, A, v), n_points)
        step = np.einsum("nab,nb->na", np.linalg.pinv(N, hermitian=True), b)
        step *= np.minimum(1.0, LONGEST_STEP / np.maximum(np.abs(step).max(axis=1), LONGEST_STEP))[:, None]
        normal, log_radius = _tilted(normal, axes, step), log_radius + step[:, 2]
        length = np.linalg.norm(v, axis=1)
        limit = HUBER * MAD_TO_SIGMA * np.median(length)
        weight = np.minimum(1.0, limit / np.maximum(length, np.finfo(float).tiny))
        if np.abs(step).max() < SETTLED:
            break
    redundancy = max(3 * len(point) - 3 * n_points, 1)
    variance = float(weight @ np.sum(v * v, axis=1)) / redundancy
    covariance = np.asarray(variance * np.linalg.pinv(N, hermitian=True), dtype=np.float64)
    B = _derivatives(lambda n, r: _shift(views, n, r), normal, _across(normal), log_radius)
    square = np.bincount(point, np.sum(v * v, axis=1), minlength=n_points)
    return Circles(
        np.exp(log_radius),
        normal,
        covariance,
        np.asarray(np.sqrt(square / (3 * np.bincount(point, minlength=n_points)))),
        _shift(views, normal, log_radius),
        B @ covariance[point] @ np.swapaxes(B, 1, 2),
    )


def ellipse_shape(semi_axes: FloatArray, angle: FloatArray) -> FloatArray:
    """Return the matrices S in (x - m)' S^-1 (x - m) = 1, px^2, shape (k, 2, 2).

    Args:
        semi_axes: major and minor semi-axis, px, shape (k, 2).
        angle: direction of the major axis from x towards y, rad, shape (k,).
    """
    c, s = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    return np.asarray(turn * (semi_axes**2)[:, None, :] @ np.swapaxes(turn, 1, 2))


def _ellipses(
    views: CircleViews, normal: FloatArray, log_radius: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return centres (k, 2) and shapes (k, 2, 2) of the images, and images of the centres, in tangents."""
    axes = np.einsum("kji,kaj->kai", views.rotation, _across(normal)[views.point])
    G = np.concatenate([axes * np.exp(log_radius)[views.point, None, None], views.rays[:, None]], axis=1)
    G = np.swapaxes(G, 1, 2) * np.array([1.0, 1.0, -1.0])[:, None]
    D = (G * np.array([1.0, 1.0, -1.0])) @ np.swapaxes(G, 1, 2)
    D = D / -D[:, 2:, 2:]
    m = -D[:, :2, 2]
    return m, D[:, :2, :2] + m[:, :, None] * m[:, None, :], G[:, :2, 2] / G[:, 2:, 2]


def _misfit(
    views: CircleViews, whitening: FloatArray, normal: FloatArray, log_radius: FloatArray
) -> FloatArray:
    """Return the relative difference between predicted and measured ellipses, zero if equal, (k, 3)."""
    _, S, _ = _ellipses(views, normal, log_radius)
    F = whitening @ views.pixel_jacobian
    E = F @ S @ np.swapaxes(F, 1, 2) - np.eye(2)
    return np.stack([E[:, 0, 0], E[:, 1, 1], np.sqrt(2) * E[:, 0, 1]], axis=1) / 2


def _shift(views: CircleViews, normal: FloatArray, log_radius: FloatArray) -> FloatArray:
    """Return the eccentricity, px, (k, 2): of the ellipse in tangents, plus the effect of distortion."""
    m, S, centre = _ellipses(views, normal, log_radius)
    J, H = views.pixel_jacobian, views.pixel_curvature
    shift = np.einsum("kab,kb->ka", J, m - centre)
    t = np.einsum("kai,kiac->kc", np.linalg.inv(J), H)
    bent = np.einsum("kiab,kab->ki", H, S) / 8 + np.einsum("kia,kab,kb->ki", J, S, t) / 4
    return np.asarray(shift + bent)


def _derivatives(
    function: Callable[[FloatArray, FloatArray], FloatArray],
    normal: FloatArray,
    axes: FloatArray,
    log_radius: FloatArray,
) -> FloatArray:
    """Return d function / d (two tilts, ln radius) from central differences, (k, rows, 3)."""
    columns = []
    for j in range(3):
        step = np.zeros((len(normal), 3))
        step[:, j] = DIFFERENCE
        ahead = function(_tilted(normal, axes, step), log_radius + step[:, 2])
        behind = function(_tilted(normal, axes, -step), log_radius - step[:, 2])
        columns.append((ahead - behind) / (2 * DIFFERENCE))
    return np.stack(columns, axis=-1)


def _across(normal: FloatArray) -> FloatArray:
    """Return two unit vectors across each normal, (n, 2, 3)."""
    least = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, least)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(normal, first)], axis=1)


def _tilted(normal: FloatArray, axes: FloatArray, step: FloatArray) -> FloatArray:
    """Return the unit normals tilted along their two axes, (n, 3)."""
    moved = normal + np.einsum("na,nac->nc", step[:, :2], axes)
    return np.asarray(moved / np.linalg.norm(moved, axis=1)[:, None])
