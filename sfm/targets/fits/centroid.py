"""Centres of targets by centroids, and by ellipses through sub-pixel edges."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.model.errors import KolinearError
from sfm.runtime.compiling import compiled
from sfm.runtime.sampling import as_grey
from sfm.targets.edge_rays import RAYS, STEP_PX, improve_outline, trace_rays

WEIGHTS = ("binary", "intensity", "squared")
# The window extends this far beyond the outline, px. The background is the mean outside the second distance,
# where the blur of the edge has died away.
MARGIN_PX, BLURRED_PX = 4.0, 2.5
# Intensities that differ from the background by fewer sigma than this are background.
THRESHOLD_SIGMAS = 3.0
# The edges are traced this often, each time from the last ellipse; three suffice from a start half a radius
# off.
TRACES = 3
# Unknowns of an ellipse.
UNKNOWNS = 5
# Part of the rays that must agree with the ellipse.
MIN_AGREEMENT = 0.7
# Edges are searched this far beyond the ellipse, px.
EDGE_MARGIN_PX = 3.0
# Edges farther from the ellipse than this, in radii, do not count.
TOLERANCE = 0.15
# Harmonics of the edge next to those of the ellipse (0, 1, 2).
NEXT_HARMONICS = slice(3, 6)
# Samples on each side of the edge over which its position is averaged.
WINDOW = 5
# Variance of the position of an edge within its pixel, px^2: a uniform distribution.
EDGE_VARIANCE = 1 / 12


class Centroids(NamedTuple):
    """Centroids of k targets; nan if the window is cut or nothing rises above the background."""

    xy: FloatArray
    """px, shape (k, 2)"""
    covariance: FloatArray
    """covariance from noise (for binary weights, from the pixel grid), px^2, shape (k, 2, 2)"""


def measure_centroids(
    photograph: AnyArray,
    xy: FloatArray,
    shape: FloatArray,
    sign: IntArray,
    *,
    noise: float,
    weights: str = "intensity",
) -> Centroids:
    """Measure the centroid of each target.

    With g the intensity above the background (below it for dark targets), the weights are 1 where g exceeds
    half of the step to the target (binary), or g - 3 sigma or its square where that is positive. A shaded
    background, a neighbour in the window, or a start off by more than 2 px shifts a centroid. The fit of an
    ellipse tolerates all of them.

    Args:
        photograph: intensities, shape (H, W).
        xy: approximate centres, px, shape (k, 2).
        shape: approximate (p, q, r) of the outlines, 1/px, shape (k, 3).
        sign: +1 bright, -1 dark target, shape (k,).
        noise: standard deviation of the intensities.
        weights: binary, intensity or squared.

    Raises:
        KolinearError: unknown weights.

    Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2014), sec. 5.4.2.
    """
    if weights not in WEIGHTS:
        raise KolinearError(f"weights {weights!r}, expected one of {', '.join(WEIGHTS)}")
    outline = np.column_stack([np.asarray(xy, float).reshape(-1, 2), np.asarray(shape, float).reshape(-1, 3)])
    result = _centroids(
        as_grey(photograph), outline, np.asarray(sign, np.int64), float(noise), WEIGHTS.index(weights)
    )
    return Centroids(result[:, :2], result[:, [2, 3, 3, 4]].reshape(-1, 2, 2))


@compiled
def _centroids(image: AnyArray, outline: FloatArray, sign: IntArray, noise: float, power: int) -> FloatArray:
    """Return x, y and their variances and covariance (xx, xy, yy) for each target, shape (k, 5)."""
    h, w = image.shape
    out = np.full((len(outline), 5), math.nan)
    for t in range(len(outline)):
        x0, y0, p, q, r = outline[t]
        det = p * r - q * q
        half_x = math.sqrt(r * r + q * q) / det + MARGIN_PX
        half_y = math.sqrt(p * p + q * q) / det + MARGIN_PX
        left, right = math.ceil(x0 - half_x), math.floor(x0 + half_x)
        top, bottom = math.ceil(y0 - half_y), math.floor(y0 + half_y)
        if left < 0 or top < 0 or right >= w or bottom >= h:
            continue
        n = (right - left + 1) * (bottom - top + 1)
        X, Y, G = np.empty(n), np.empty(n), np.empty(n)
        background, outside, target, inside, m = 0.0, 0, 0.0, 0, 0
        for i in range(top, bottom + 1):
            for j in range(left, right + 1):
                dx, dy = j - x0, i - y0
                u, v = p * dx + q * dy, q * dx + r * dy
                rho = math.sqrt(u * u + v * v) + 1e-12
                d = rho * (rho - 1) / (math.sqrt((p * u + q * v) ** 2 + (q * u + r * v) ** 2) + 1e-12)
                if d > MARGIN_PX:
                    continue
                value = sign[t] * float(image[i, j])
                if d > BLURRED_PX:
                    background += value
                    outside += 1
                elif rho < 0.5:
                    target += value
                    inside += 1
                X[m], Y[m], G[m] = j, i, value
                m += 1
        if outside == 0 or inside == 0:
            continue
        background /= outside
        half = (target / inside - background) / 2
        threshold = half if power == 0 else THRESHOLD_SIGMAS * noise
        total, sx, sy = 0.0, 0.0, 0.0
        for i in range(m):
            g = G[i] - background
            if g > threshold:
                weight = 1.0 if power == 0 else (g - threshold) ** power
                total += weight
                sx += weight * X[i]
                sy += weight * Y[i]
        if total <= 0:
            continue
        x, y = sx / total, sy / total
        xx, xy, yy = 0.0, 0.0, 0.0
        slope = half / 2  # intensity changes by half of the step within about 2 px of the edge
        for i in range(m):
            g = G[i] - background
            if power == 0:
                variance = EDGE_VARIANCE if abs(g - threshold) < slope else 0.0
            elif g > threshold:
                variance = (power * (g - threshold) ** (power - 1) * noise) ** 2
            else:
                continue
            xx += variance * (X[i] - x) ** 2
            xy += variance * (X[i] - x) * (Y[i] - y)
            yy += variance * (Y[i] - y) ** 2
        out[t, 0], out[t, 1] = x, y
        out[t, 2], out[t, 3], out[t, 4] = xx / total**2, xy / total**2, yy / total**2
    return out


class EdgeEllipses(NamedTuple):
    """Ellipses through the edges of k targets; nan if fewer than 70 % of the edges lie on one."""

    xy: FloatArray
    """centres, px, shape (k, 2)"""
    covariance: FloatArray
    """covariance from the edge residuals and the correlation of neighbouring rays, px^2, shape (k, 2, 2)"""
    shape: FloatArray
    """(p, q, r) of S, 1/px, shape (k, 3)"""


@checked_arguments(photograph="h w", xy="k 2", shape="k 3", sign="k")
def measure_edge_ellipses(
    photograph: AnyArray, xy: FloatArray, shape: FloatArray, sign: IntArray, *, noise: float
) -> EdgeEllipses:
    """Fit an ellipse to the mean positions of the edges on rays from the centre of each target.

    Args:
        photograph: intensities, shape (H, W).
        xy: approximate centres, px, shape (k, 2).
        shape: approximate (p, q, r) of the outlines, 1/px, shape (k, 3).
        sign: +1 bright, -1 dark target, shape (k,).
        noise: standard deviation of the intensities.

    Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2014), sec. 5.4.2.5, star operator.
    """
    outline = np.column_stack([np.asarray(xy, float).reshape(-1, 2), np.asarray(shape, float).reshape(-1, 3)])
    theta, residual = _fit_edges(as_grey(photograph), outline, np.asarray(sign, np.int64), float(noise))
    used = np.isfinite(residual).sum(axis=1)
    v = np.nan_to_num(residual)
    squares = (v**2).sum(axis=1)
    # Neighbouring rays share pixels, so the errors have more power at low harmonics, which affect the centre,
    # than on average. This power is estimated from the harmonics next to those of the ellipse, over all
    # targets.
    low = (np.abs(np.fft.rfft(v, axis=1)[:, NEXT_HARMONICS]) ** 2).mean(axis=1) / RAYS
    white = squares / (RAYS - UNKNOWNS)
    inflation = max(1.0, low.sum() / white.sum()) if white.sum() > 0 else 1.0
    # The centre is the first harmonic: each coordinate has the weight of half of the rays.
    variance = inflation * squares / np.maximum(used - UNKNOWNS, 1) / np.maximum(used / 2, 1)
    p, q, r = theta[:, 2:].T
    det = p * r - q * q
    inverse = np.array([[r, -q], [-q, p]]).transpose(2, 0, 1) / det[:, None, None]
    return EdgeEllipses(theta[:, :2], variance[:, None, None] * (inverse @ inverse), theta[:, 2:])


@compiled
def _fit_edges(
    image: AnyArray, outline: FloatArray, sign: IntArray, noise: float
) -> tuple[FloatArray, FloatArray]:
    """Return the ellipses, shape (k, 5), and the residuals of the edges, radii, nan if unused, (k, rays)."""
    theta = outline.copy()
    residual = np.full((len(outline), RAYS), math.nan)
    edge, limit = np.empty(RAYS), np.empty(RAYS)
    for t in range(len(outline)):
        p, q, r = outline[t, 2:]
        minor_px = 1 / ((p + r) / 2 + math.hypot((p - r) / 2, q))
        window = min(WINDOW, int(minor_px / STEP_PX))
        agree = 0.0
        for _ in range(TRACES):
            trace_rays(image, theta[t], sign[t], noise, EDGE_MARGIN_PX, 0.0, edge, limit, window)
            agree, _change = improve_outline(theta[t], edge)
            if agree < MIN_AGREEMENT:
                break
        if agree < MIN_AGREEMENT:
            theta[t] = math.nan
            continue
        trace_rays(image, theta[t], sign[t], noise, EDGE_MARGIN_PX, 0.0, edge, limit, window)
        for k in range(RAYS):
            if abs(edge[k] - 1) < TOLERANCE:
                residual[t, k] = edge[k] - 1
    return theta, residual
