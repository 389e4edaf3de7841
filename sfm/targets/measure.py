"""Measurement of targets: least squares fit of a blurred ellipse, all targets of a photograph at once.

Model of the intensity at pixel (x, y), with d the signed distance from the edge of the ellipse (negative
inside), s the blur of the edge, B the background, A the step to the target, g the gradient of the gain:

    I = (B + A Phi(-d / s)) (1 + gx (x - x0) / L + gy (y - y0) / L)

The ellipse is |S (x - x0, y - y0)| = 1 with a symmetric S = (p q; q r), which is regular for circles too, and
rho = |S dx|, d = rho (rho - 1) / |S S dx|. The box of the pixel is part of s: it adds 1/12 to s^2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from sfm.conventions import AnyArray, FloatArray, IntArray
from sfm.targets.flags import Flag

RAYS = 32
MAX_STEPS = 30
PARAMETERS = 10
# Number of unknowns of the fit: x0, y0, p, q, r, B, A, s, gx, gy.
GAIN_SIGMA = 0.3
"""A priori sigma of the change of gain over the length L: far above shading, it only keeps the fit regular"""


@dataclass(frozen=True)
class EllipseFit:
    """Blurred ellipses fitted to the targets of one photograph."""

    xy: FloatArray
    """centres, px, shape (k, 2)"""
    covariance: FloatArray
    """covariance of the centres from the fit and its own residuals, px^2, shape (k, 2, 2)"""
    shape: FloatArray
    """(p, q, r) of S, which turns image vectors into radii, 1/px, shape (k, 3)"""
    background: FloatArray
    """intensity B around the target, shape (k,)"""
    contrast: FloatArray
    """step of intensity A from background to target, positive for bright targets, shape (k,)"""
    blur: FloatArray
    """standard deviation s of the edge, pixel box included, px, shape (k,)"""
    gain: FloatArray
    """relative change of the intensity per px in x and y, shape (k, 2)"""
    noise: FloatArray
    """standard deviation of the intensities about the fit, shape (k,)"""
    unevenness: FloatArray
    """largest mean residual over one eighth of the edge, relative to the contrast, shape (k,)"""
    pixels: IntArray
    """number of intensities in the fit, shape (k,)"""
    iterations: IntArray
    """number of steps, shape (k,)"""
    flag: IntArray
    """remarks and reasons of failure, see Flag, shape (k,)"""


def fit_ellipse_model(
    photograph: AnyArray,
    xy: FloatArray,
    shape: FloatArray,
    sign: IntArray,
    *,
    noise: float = 1.0,
    saturation: float | None = None,
) -> EllipseFit:
    """Fit the model of a blurred ellipse to every target, starting from roughly known outlines.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16 or float.
        xy: approximate centres, px, shape (k, 2).
        shape: approximate (p, q, r) of S, 1/px, shape (k, 3).
        sign: +1 for a target brighter than its surroundings, -1 for a darker one, shape (k,).
        noise: approximate standard deviation of the intensities; decides what counts as a disturbance.
        saturation: intensities from here on are censored; default is the end of the integer scale.

    Returns:
        The fits; where `flag` says NO_CONVERGENCE or CUT_BY_BORDER the values are the last ones reached.

    Source: Gauss-Markov model with Levenberg-Marquardt steps; Ahn, Rauh, Kim, "Circular coded target for
    automation of optical 3D-measurement" (1997), for the least squares template of an ellipse.
    """
    if saturation is None:
        saturation = float(np.iinfo(photograph.dtype).max) if photograph.dtype.kind == "u" else math.inf
    k = len(xy)
    start = np.column_stack([np.asarray(xy, float).reshape(k, 2), np.asarray(shape, float).reshape(k, 3)])
    theta, normal, statistics, flag = _fit_all(
        photograph, start, np.asarray(sign, np.int64), float(noise), float(saturation)
    )
    pixels = statistics[:, 0]
    redundancy = np.maximum(pixels - PARAMETERS, 1)
    quantisation = 1 / 12 if photograph.dtype.kind == "u" else 0.0
    variance = statistics[:, 1] / redundancy
    covariance = np.full((k, 2, 2), np.nan)
    good = (flag & (Flag.NO_CONVERGENCE | Flag.CUT_BY_BORDER | Flag.NOT_ELLIPTIC)) == 0
    if good.any():
        prior = np.zeros((int(good.sum()), PARAMETERS))
        prior[:, 8:] = (variance[good] / GAIN_SIGMA**2)[:, None]
        cofactor = np.linalg.inv(normal[good] + prior[:, :, None] * np.eye(PARAMETERS))
        covariance[good] = np.maximum(variance[good], quantisation)[:, None, None] * cofactor[:, :2, :2]
    length = statistics[:, 3]
    return EllipseFit(
        xy=theta[:, :2],
        covariance=covariance,
        shape=theta[:, 2:5],
        background=theta[:, 5],
        contrast=theta[:, 6],
        blur=theta[:, 7],
        gain=theta[:, 8:] / length[:, None],
        noise=np.sqrt(variance),
        unevenness=statistics[:, 2],
        pixels=pixels.astype(np.int64),
        iterations=statistics[:, 4].astype(np.int64),
        flag=flag,
    )


def axes_from_shape(shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return semi-axes (major, minor), px, shape (k, 2), and the angle of the major axis, rad, shape (k,).

    The angle runs from x (right) to y (down), from -pi/2 to pi/2.
    """
    p, q, r = np.asarray(shape, dtype=float).T
    mean, half = (p + r) / 2, np.hypot((p - r) / 2, q)
    angle = 0.5 * np.arctan2(2 * q, p - r) + math.pi / 2  # the small eigenvalue of S belongs to the long axis
    angle = (angle + math.pi / 2) % math.pi - math.pi / 2
    return np.column_stack([1 / (mean - half), 1 / (mean + half)]), angle


def shape_from_axes(semi_axes: FloatArray, angle: FloatArray) -> FloatArray:
    """Return (p, q, r) of S, shape (k, 3), of ellipses with semi-axes (k, 2) in px and angle (k,) in rad."""
    a, b = 1 / np.asarray(semi_axes, dtype=float).reshape(-1, 2).T
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c])


@njit(cache=True, nogil=True, error_model="numpy")
def _bilinear(image: AnyArray, x: float, y: float) -> float:
    i, j = int(y), int(x)
    fy, fx = y - i, x - j
    top = image[i, j] * (1 - fx) + image[i, j + 1] * fx
    bottom = image[i + 1, j] * (1 - fx) + image[i + 1, j + 1] * fx
    return top * (1 - fy) + bottom * fy


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(N: FloatArray, g: FloatArray) -> bool:
    """Solve N x = g by Cholesky in place, x replaces g; False if N is not positive definite."""
    n = len(g)
    for i in range(n):
        for j in range(i + 1):
            t = N[i, j]
            for k in range(j):
                t -= N[i, k] * N[j, k]
            if i == j:
                if t <= 0:
                    return False
                N[i, i] = math.sqrt(t)
            else:
                N[i, j] = t / N[j, j]
        t = g[i]
        for k in range(i):
            t -= N[i, k] * g[k]
        g[i] = t / N[i, i]
    for i in range(n - 1, -1, -1):
        t = g[i]
        for k in range(i + 1, n):
            t -= N[k, i] * g[k]
        g[i] = t / N[i, i]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_rays(
    image: AnyArray,
    theta: FloatArray,
    sign: int,
    noise: float,
    margin: float,
    edge: FloatArray,
    limit: FloatArray,
) -> float:
    """Find the steepest edge on rays from the centre and how far out the background reaches.

    Writes the normalised radius of the edge (nan: none) and the reach beyond it in px for each ray; returns
    the median step of intensity.
    """
    h, w = image.shape
    x0, y0, p, q, r = theta[0], theta[1], theta[2], theta[3], theta[4]
    det = p * r - q * q
    step = 0.5
    profile = np.empty(4096)
    steps = np.empty(RAYS)
    for k in range(RAYS):
        phi = 2 * math.pi * k / RAYS
        c, s = math.cos(phi), math.sin(phi)
        ex, ey = (r * c - q * s) / det, (p * s - q * c) / det
        R = math.sqrt(ex * ex + ey * ey)
        ex, ey = ex / R, ey / R
        reach = max(2.5, 0.3 * R)
        first = max(0.0, R - reach - 1.0)
        n = min(4096, int((R + reach + margin + 1.0 - first) / step) + 1)
        m = 0
        for i in range(n):
            x, y = x0 + (first + i * step) * ex, y0 + (first + i * step) * ey
            if x < 0 or y < 0 or x >= w - 1 or y >= h - 1:
                break
            profile[i] = sign * _bilinear(image, x, y)
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
        if at > 2 and at < m - 3:
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
            if (i - at) * step > margin:
                break
            level = min(level, profile[i])
            if profile[i] - level > max(0.3 * (inside - level), 5 * noise):
                limit[k] = max(0.0, (i - at) * step - 1.0)
                break
        if (m - at) * step < 3.0:  # the photograph ends here
            limit[k] = -1.0
        steps[k] = inside - level
    return np.median(steps)


@njit(cache=True, nogil=True, error_model="numpy")
def _improve_outline(theta: FloatArray, edge: FloatArray) -> float:
    """Move and reshape the ellipse to the edges on the rays; return the part of the rays that agree.

    The edges are expanded as rho(phi) = c0 + c1 cos phi + c2 sin phi + c3 cos 2 phi + c4 sin 2 phi: size,
    centre and shape of the ellipse to first order.
    """
    sound = edge[np.isfinite(edge)]
    if len(sound) < RAYS // 2:
        return 0.0
    middle = np.median(sound)
    tolerance = 0.25
    used = 0
    c = np.zeros(5)
    for _ in range(2):
        N, g = np.zeros((5, 5)), np.zeros(5)
        a = np.empty(5)
        used = 0
        for k in range(RAYS):
            phi = 2 * math.pi * k / RAYS
            a[0], a[1], a[2] = 1.0, math.cos(phi), math.sin(phi)
            a[3], a[4] = math.cos(2 * phi), math.sin(2 * phi)
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
        if used < RAYS // 2 or not _solve(N, g):
            return 0.0
        c = g
        tolerance = 0.15
    p, q, r = theta[2], theta[3], theta[4]
    det = p * r - q * q
    theta[0] += (r * c[1] - q * c[2]) / det
    theta[1] += (p * c[2] - q * c[1]) / det
    # new unit circle T^-1 S with T = c0 I + (c3 c4; c4 -c3); S is the square root of S T^-2 S
    t_det = c[0] * c[0] - c[3] * c[3] - c[4] * c[4]
    if t_det < 0.1:
        return 0.0
    a, b, d = (c[0] - c[3]) / t_det, -c[4] / t_det, (c[0] + c[3]) / t_det
    m00, m01, m10, m11 = a * p + b * q, a * q + b * r, b * p + d * q, b * q + d * r
    e, f, g2 = m00 * m00 + m10 * m10, m00 * m01 + m10 * m11, m01 * m01 + m11 * m11
    root = math.sqrt(e * g2 - f * f)
    scale = math.sqrt(e + g2 + 2 * root)
    theta[2], theta[3], theta[4] = (e + root) / scale, f / scale, (g2 + root) / scale
    return used / RAYS


@njit(cache=True, nogil=True, error_model="numpy")
def _collect(
    image: AnyArray, theta: FloatArray, limit: FloatArray, margin: float, inner: float, out: FloatArray
) -> int:
    """Collect the pixels of the target and of its undisturbed background; return their number."""
    h, w = image.shape
    x0, y0, p, q, r = theta[0], theta[1], theta[2], theta[3], theta[4]
    det = p * r - q * q
    half_x = math.sqrt(r * r + q * q) / det + margin + 1
    half_y = math.sqrt(p * p + q * q) / det + margin + 1
    n = 0
    for i in range(max(0, int(y0 - half_y)), min(h, int(y0 + half_y) + 2)):
        dy = i - y0
        for j in range(max(0, int(x0 - half_x)), min(w, int(x0 + half_x) + 2)):
            dx = j - x0
            u, v = p * dx + q * dy, q * dx + r * dy
            rho2 = u * u + v * v
            if rho2 > 1.0:
                rho = math.sqrt(rho2)
                d = rho * (rho - 1) / math.sqrt((p * u + q * v) ** 2 + (q * u + r * v) ** 2)
                if d > margin:
                    continue
                k = int(math.atan2(v, u) * (RAYS / (2 * math.pi)) + RAYS)
                if d > limit[k % RAYS] or d > limit[(k + 1) % RAYS]:
                    continue
            elif inner < 1e6 and rho2 > 1e-6:
                rho = math.sqrt(rho2)
                d = rho * (rho - 1) / math.sqrt((p * u + q * v) ** 2 + (q * u + r * v) ** 2)
                if d < -inner:
                    continue
            if n == len(out):
                return n
            out[n, 0], out[n, 1], out[n, 2] = j, i, image[i, j]
            n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _normal_equations(
    data: FloatArray,
    n: int,
    theta: FloatArray,
    length: float,
    saturation: float,
    N: FloatArray,
    g: FloatArray,
) -> tuple[float, int]:
    """Sum up N = J'J and g = J'v of one target; return the sum of squares and the number of pixels used."""
    x0, y0, p, q, r = theta[0], theta[1], theta[2], theta[3], theta[4]
    B, A, s, gx, gy = theta[5], theta[6], theta[7], theta[8], theta[9]
    N[:] = 0.0
    g[:] = 0.0
    a = np.zeros(10)
    total = 0.0
    used = 0
    for i in range(n):
        dx, dy, value = data[i, 0] - x0, data[i, 1] - y0, data[i, 2]
        u, v = p * dx + q * dy, q * dx + r * dy
        rho = math.sqrt(u * u + v * v) + 1e-12
        wx, wy = p * u + q * v, q * u + r * v
        nw = math.sqrt(wx * wx + wy * wy) + 1e-12
        d = rho * (rho - 1) / nw
        t = -d / s
        gain = 1 + (gx * dx + gy * dy) / length
        z = abs(t) * 0.7071067811865476
        if z < 4.0:
            e = math.exp(-z * z)
            # erfc by Abramowitz and Stegun (1964), 7.1.26, error below 1.5e-7
            k = 1 / (1 + 0.3275911 * z)
            tail = (
                0.5
                * e
                * k
                * (
                    0.254829592
                    + k * (-0.284496736 + k * (1.421413741 + k * (-1.453152027 + k * 1.061405429)))
                )
            )
            phi = 1 - tail if t > 0 else tail
        else:
            e = 0.0
            phi = 1.0 if t > 0 else 0.0
        level = B + A * phi
        model = level * gain
        if (value >= saturation and model >= saturation) or (value <= 0 and model <= 0):
            continue  # censored: all that is known is that the model lies beyond the scale, and it does
        used += 1
        residual = value - model
        total += residual * residual
        a[5] = gain
        a[6] = phi * gain
        a[8] = level * dx / length
        a[9] = level * dy / length
        if e > 0.0:
            slope = A * 0.3989422804014327 * e * gain / s  # dI / d(-d)
            a[7] = -slope * t
            f1 = -slope * (2 * rho - 1) / nw / rho
            f2 = slope * d / (nw * nw)
            # derivatives of rho by u . u', of |w| by w . w' with w' = S u' + S' u
            ax, ay = p * wx + q * wy, q * wx + r * wy  # S w
            a[0] = f1 * -(u * p + v * q) + f2 * -(ax * p + ay * q)
            a[1] = f1 * -(u * q + v * r) + f2 * -(ax * q + ay * r)
            a[2] = f1 * (u * dx) + f2 * (ax * dx + wx * u)
            a[3] = f1 * (u * dy + v * dx) + f2 * (ax * dy + ay * dx + wx * v + wy * u)
            a[4] = f1 * (v * dy) + f2 * (ay * dy + wy * v)
            a[0] -= level * gx / length
            a[1] -= level * gy / length
            for j in range(10):
                aj = a[j]
                g[j] += aj * residual
                for m in range(j + 1):
                    N[j, m] += aj * a[m]
        else:
            a[0] = -level * gx / length
            a[1] = -level * gy / length
            for j in (0, 1, 5, 6, 8, 9):
                aj = a[j]
                g[j] += aj * residual
                for m in (0, 1, 5, 6, 8, 9):
                    if m <= j:
                        N[j, m] += aj * a[m]
    return total, used


@njit(cache=True, nogil=True, error_model="numpy")
def _unevenness(data: FloatArray, n: int, theta: FloatArray, length: float) -> float:
    """Return the largest mean residual of an eighth of the edge, in- or outside, over the contrast."""
    p, q, r = theta[2], theta[3], theta[4]
    B, A, s = theta[5], theta[6], theta[7]
    band = 1.0 + 1.5 * s
    total = np.zeros((2, 8))
    count = np.zeros((2, 8))
    for i in range(n):
        dx, dy = data[i, 0] - theta[0], data[i, 1] - theta[1]
        u, v = p * dx + q * dy, q * dx + r * dy
        rho = math.sqrt(u * u + v * v) + 1e-12
        d = rho * (rho - 1) / (math.sqrt((p * u + q * v) ** 2 + (q * u + r * v) ** 2) + 1e-12)
        if abs(d) > band:
            continue
        gain = 1 + (theta[8] * dx + theta[9] * dy) / length
        model = (B + A * 0.5 * math.erfc(d / s * 0.7071067811865476)) * gain
        k = int(math.atan2(v, u) * (8 / (2 * math.pi)) + 8) % 8
        side = 1 if d > 0 else 0
        total[side, k] += data[i, 2] - model
        count[side, k] += 1
    worst = 0.0
    for side in range(2):
        for k in range(8):
            if count[side, k] > 0:
                worst = max(worst, abs(total[side, k]) / count[side, k])
            elif side == 1:
                worst = max(worst, abs(A))  # no background at all on this side
    return worst / abs(A)


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_one(
    image: AnyArray,
    theta: FloatArray,
    sign: int,
    noise: float,
    saturation: float,
    N: FloatArray,
    statistics: FloatArray,
) -> int:
    """Fit one target; theta, N and statistics (pixels, squares, unevenness, L, steps) are filled."""
    flag = 0
    edge, limit = np.empty(RAYS), np.empty(RAYS)
    for _ in range(2):
        mean = 1 / math.sqrt(max(theta[2] * theta[4] - theta[3] ** 2, 1e-12))
        margin = min(10.0, 3.5 + 0.25 * mean)
        step = _trace_rays(image, theta, sign, noise, margin, edge, limit)
        agree = _improve_outline(theta, edge)
        if agree < 0.7 or step <= 0:
            return Flag.NOT_ELLIPTIC.value
    if limit.min() < 0:
        return Flag.CUT_BY_BORDER.value
    if limit.min() < margin:
        flag |= Flag.CLOSE_NEIGHBOUR.value
    mean = 1 / math.sqrt(theta[2] * theta[4] - theta[3] ** 2)
    length = mean + margin
    statistics[3] = length
    det = theta[2] * theta[4] - theta[3] ** 2
    box_x = math.sqrt(theta[4] ** 2 + theta[3] ** 2) / det + margin + 3
    box_y = math.sqrt(theta[2] ** 2 + theta[3] ** 2) / det + margin + 3
    data = np.empty((int(4 * box_x * box_y), 3))
    inner = 1e9 if mean < 25 else 15.0
    n = _collect(image, theta, limit, margin, inner, data)
    if n < 2 * PARAMETERS:
        return flag | Flag.NO_CONVERGENCE.value
    # levels of background and target: means of the pixels out- and inside
    outside, inside, n_out, n_in = 0.0, 0.0, 0, 0
    for i in range(n):
        dx, dy = data[i, 0] - theta[0], data[i, 1] - theta[1]
        u, v = theta[2] * dx + theta[3] * dy, theta[3] * dx + theta[4] * dy
        if u * u + v * v > 1:
            outside += data[i, 2]
            n_out += 1
        else:
            inside += data[i, 2]
            n_in += 1
        if data[i, 2] >= saturation:
            flag |= Flag.SATURATED.value
    if n_out == 0 or n_in == 0:
        return flag | Flag.NO_CONVERGENCE.value
    theta[5], theta[6], theta[7] = outside / n_out, inside / n_in - outside / n_out, 0.9
    theta[8], theta[9] = 0.0, 0.0
    if theta[6] * sign <= 0:
        return flag | Flag.NO_CONVERGENCE.value
    prior = (noise / GAIN_SIGMA) ** 2
    g = np.empty(PARAMETERS)
    trial, N_trial, g_trial = theta.copy(), np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    total, used = _normal_equations(data, n, theta, length, saturation, N, g)
    damping = 1e-3
    done = False
    steps = 0
    L = np.empty((PARAMETERS, PARAMETERS))
    while steps < MAX_STEPS:
        steps += 1
        for i in range(PARAMETERS):
            for j in range(i + 1):
                L[i, j] = N[i, j]
            if i >= 8:
                L[i, i] += prior
            L[i, i] *= 1 + damping
            trial[i] = g[i] - (prior * theta[i] if i >= 8 else 0.0)
        if not _solve(L, trial):
            return flag | Flag.NO_CONVERGENCE.value
        shift = max(abs(trial[0]), abs(trial[1]))
        for i in range(PARAMETERS):
            trial[i] += theta[i]
        trial[7] = min(max(trial[7], 0.25), 2 * mean)
        if trial[2] * trial[4] - trial[3] ** 2 <= 0 or trial[2] <= 0 or shift > mean + 2:
            damping = max(damping, 1e-3) * 10
            if damping > 1e6:
                break
            continue
        squares, used_trial = _normal_equations(data, n, trial, length, saturation, N_trial, g_trial)
        before = total + prior * (theta[8] ** 2 + theta[9] ** 2)
        after = squares + prior * (trial[8] ** 2 + trial[9] ** 2)
        if after <= before * (1 + 1e-12) or used_trial != used:
            theta[:] = trial
            N[:] = N_trial
            g[:] = g_trial
            total, used = squares, used_trial
            damping *= 0.1
            if shift < 1e-4 and before - after <= 1e-4 * before:
                done = True
                break
        else:
            damping = max(damping, 1e-3) * 10
            if damping > 1e6:
                break
    for i in range(PARAMETERS):
        for j in range(i):
            N[j, i] = N[i, j]
    statistics[0], statistics[1], statistics[4] = used, total, steps
    statistics[2] = _unevenness(data, n, theta, length)
    if not done or theta[6] * sign <= 0 or used <= PARAMETERS:
        flag |= Flag.NO_CONVERGENCE.value
    return flag


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_all(
    image: AnyArray, start: FloatArray, sign: IntArray, noise: float, saturation: float
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    k = len(start)
    theta = np.zeros((k, PARAMETERS))
    normal = np.zeros((k, PARAMETERS, PARAMETERS))
    statistics = np.ones((k, 5))
    flag = np.zeros(k, np.int64)
    for i in range(k):
        theta[i, :5] = start[i]
        flag[i] = _fit_one(image, theta[i], sign[i], noise, saturation, normal[i], statistics[i])
    return theta, normal, statistics, flag
