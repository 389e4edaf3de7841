"""Ellipses through the sub-pixel edges of targets."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import AnyArray, FloatArray, IntArray
from sfm.kernels.options import compiled
from sfm.kernels.sampling import as_grey
from sfm.targets.edge_rays import RAYS, STEP_PX, improve_outline, trace_rays

# The edges are traced from the ellipse found last; three times do from a start that is half a radius off.
TRACES = 3
# Unknowns of an ellipse.
UNKNOWNS = 5
# Share of the rays that must agree with the ellipse.
MIN_AGREEMENT = 0.7
MARGIN_PX = 3.0
# Edges farther from the ellipse than this, in radii, do not count.
TOLERANCE = 0.15
# Harmonics of the edge that follow those of the ellipse (0, 1, 2).
NEXT_HARMONICS = slice(3, 6)
# Samples to both sides of the edge over which its position is averaged.
WINDOW = 5


class EdgeEllipses(NamedTuple):
    """Ellipses through the edges of k targets; nan where fewer than 70 % of the edges lie on one."""

    xy: FloatArray
    """centres, px, shape (k, 2)"""
    covariance: FloatArray
    """from the residuals of the edges and the correlation of neighbouring rays, px^2, shape (k, 2, 2)"""
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
    # Neighbouring rays share pixels, so the errors have more power at low harmonics, where the centre is,
    # than on average; it is taken from the harmonics next to those of the ellipse, over all targets.
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
            trace_rays(image, theta[t], sign[t], noise, MARGIN_PX, 0.0, edge, limit, window)
            agree, _change = improve_outline(theta[t], edge)
            if agree < MIN_AGREEMENT:
                break
        if agree < MIN_AGREEMENT:
            theta[t] = math.nan
            continue
        trace_rays(image, theta[t], sign[t], noise, MARGIN_PX, 0.0, edge, limit, window)
        for k in range(RAYS):
            if abs(edge[k] - 1) < TOLERANCE:
                residual[t, k] = edge[k] - 1
    return theta, residual
