"""Edges of a target along rays from its centre: a better outline, and the extent of its background."""

from __future__ import annotations

import math

import numpy as np

from sfm.model.conventions import AnyArray, FloatArray
from sfm.runtime.compiling import compiled
from sfm.runtime.sampling import bilinear
from sfm.runtime.small_algebra import solve_symmetric

RAYS = 32
# Spacing of the samples along a ray.
STEP_PX = 0.5
# A rise behind the edge by this part of the step, and by this many sigmas of the noise, ends the background.
_DISTURBANCE, _DISTURBANCE_SIGMAS = 0.3, 5.0
_PHI = 2 * math.pi * np.arange(RAYS) / RAYS
HARMONICS = np.column_stack([np.ones(RAYS), np.cos(_PHI), np.sin(_PHI), np.cos(2 * _PHI), np.sin(2 * _PHI)])


@compiled
def trace_rays(
    image: AnyArray,
    theta: FloatArray,
    sign: int,
    noise: float,
    margin: float,
    skirt: float,
    edge: FloatArray,
    limit: FloatArray,
    window: int = 0,
) -> float:
    """Find the steepest edge on rays from the centre, and how far the background extends beyond it.

    The background ends one skirt before the rise to a neighbour, and at the margin at the latest.

    The edge is the vertex of a parabola through the slopes at the steepest point. If the caller considers the
    surroundings clean, it is the mean position of the slope over a window of samples on both sides. For each
    ray the function writes the normalised radius of the edge (nan: none) and the reach beyond it in px. It
    returns the median step of intensity.
    """
    h, w = image.shape
    x0, y0, p, q, r = theta[0], theta[1], theta[2], theta[3], theta[4]
    det = p * r - q * q
    step = STEP_PX
    profile = np.empty(4096)
    steps = np.empty(RAYS)
    for k in range(RAYS):
        c, s = HARMONICS[k, 1], HARMONICS[k, 2]
        ex, ey = (r * c - q * s) / det, (p * s - q * c) / det
        R = math.sqrt(ex * ex + ey * ey)
        ex, ey = ex / R, ey / R
        reach = max(2.5, 0.3 * R)
        first = max(0.0, R - reach - 1.0)
        n = min(4096, int((R + reach + margin + skirt + 1.0 - first) / step) + 1)
        m = 0
        for i in range(n):
            x, y = x0 + (first + i * step) * ex, y0 + (first + i * step) * ey
            if x < 0 or y < 0 or x >= w - 1 or y >= h - 1:
                break
            profile[i] = sign * bilinear(image, x, y)
            m += 1
        best, at = 0.0, -1
        for i in range(2, m - 2):  # bright target: the profile falls outwards
            if first + i * step > R + reach:
                break
            fall = profile[i - 2] - profile[i + 2]
            if fall > best:
                best, at = fall, i
        if at < 0:
            edge[k], limit[k], steps[k] = math.nan, 0.0, 0.0
            continue
        offset = 0.0
        if 0 < window <= min(at, m - 1 - at):
            ends = profile[at - window] + profile[at + window]
            area = 0.5 * ends
            for i in range(at - window + 1, at + window):
                area += profile[i]
            fall = profile[at - window] - profile[at + window]
            if fall > 0:  # integral of t dI over that of dI, by parts
                offset = (area - window * ends) / fall
        elif at > 2 and at < m - 3:
            before, after = profile[at - 3] - profile[at + 1], profile[at - 1] - profile[at + 3]
            curvature = before - 2 * best + after
            if curvature < 0:
                offset = 0.5 * (before - after) / curvature
        edge[k] = (first + (at + offset) * step) / R
        level = profile[at + 2]
        inside = profile[at - 2]
        for i in range(max(0, at - 6), at - 2):
            inside = max(inside, profile[i])
        limit[k] = margin
        for i in range(at + 2, m):
            if (i - at) * step > margin + skirt:
                break
            level = min(level, profile[i])
            if profile[i] - level > max(_DISTURBANCE * (inside - level), _DISTURBANCE_SIGMAS * noise):
                limit[k] = min(margin, max(0.0, (i - at) * step - skirt))
                break
        if (m - at) * step < 3.0:  # the photograph ends here
            limit[k] = -1.0
        steps[k] = inside - level
    return np.median(steps)


@compiled
def improve_outline(theta: FloatArray, edge: FloatArray) -> tuple[float, float]:
    """Move and reshape the ellipse to the edges on the rays.

    The edges are expanded as rho(phi) = c0 + c1 cos phi + c2 sin phi + c3 cos 2 phi + c4 sin 2 phi: size,
    centre and shape of the ellipse to first order.

    Returns:
        The part of the rays that agree with an ellipse, and the largest change in radii.
    """
    sound = edge[np.isfinite(edge)]
    if len(sound) < RAYS // 2:
        return 0.0, 1.0
    middle = np.median(sound)
    tolerance = 0.25
    used = 0
    c = np.zeros(5)
    for _ in range(2):
        N, g = np.zeros((5, 5)), np.zeros(5)
        used = 0
        for k in range(RAYS):
            a = HARMONICS[k]
            predicted = (
                middle if c[0] == 0.0 else c[0] + c[1] * a[1] + c[2] * a[2] + c[3] * a[3] + c[4] * a[4]
            )
            if not abs(edge[k] - predicted) < tolerance:
                continue
            used += 1
            for i in range(5):
                g[i] += a[i] * edge[k]
                for j in range(5):
                    N[i, j] += a[i] * a[j]
        if used < RAYS // 2 or not solve_symmetric(N, g):
            return 0.0, 1.0
        c = g
        tolerance = 0.15
    if not reshape(theta, c):
        return 0.0, 1.0
    return used / RAYS, abs(c[0] - 1) + abs(c[1]) + abs(c[2]) + abs(c[3]) + abs(c[4])


@compiled
def reshape(theta: FloatArray, c: FloatArray) -> bool:
    """Move and reshape an ellipse so that its outline is at these radii, to first order.

    Args:
        theta: x0, y0, p, q, r, which are changed, (>= 5,).
        c: radius of the outline over that of the ellipse as c0 + c1 cos phi + c2 sin phi + c3 cos 2 phi +
            c4 sin 2 phi, (5,).

    Returns:
        Whether the radii are those of an ellipse; it is moved in any case.
    """
    p, q, r = theta[2], theta[3], theta[4]
    det = p * r - q * q
    theta[0] += (r * c[1] - q * c[2]) / det
    theta[1] += (p * c[2] - q * c[1]) / det
    # new unit circle T^-1 S with T = c0 I + (c3 c4; c4 -c3); S is the square root of S T^-2 S
    t_det = c[0] * c[0] - c[3] * c[3] - c[4] * c[4]
    if t_det < 0.1:
        return False
    a, b, d = (c[0] - c[3]) / t_det, -c[4] / t_det, (c[0] + c[3]) / t_det
    m00, m01, m10, m11 = a * p + b * q, a * q + b * r, b * p + d * q, b * q + d * r
    e, f, g2 = m00 * m00 + m10 * m10, m00 * m01 + m10 * m11, m01 * m01 + m11 * m11
    root = math.sqrt(e * g2 - f * f)
    scale = math.sqrt(e + g2 + 2 * root)
    theta[2], theta[3], theta[4] = (e + root) / scale, f / scale, (g2 + root) / scale
    return True
