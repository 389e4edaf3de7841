"""Goodness of fit of a blurred ellipse: what it leaves unexplained, and the width of its background."""

from __future__ import annotations

import math

import numpy as np

from sfm.model.conventions import AnyArray, FloatArray
from sfm.runtime.compiling import compiled
from sfm.runtime.sampling import bilinear
from sfm.targets.edge_rays import HARMONICS, RAYS, STEP_PX
from sfm.targets.fits import blurred_ellipse as model

# Columns of the statistics of a fit: pixels used, sum of squared residuals, unevenness, L in px, steps, part
# of the circumference with strokes, halo and its sigma, saturated part of the background, part of the
# circumference with glare behind it, the largest sum of adjacent residuals, inside and anywhere, over the
# root of their number (see `judge_coherence`), and the robust standard deviation of residuals.
STATISTICS = 13
PIXELS, SQUARES, UNEVENNESS, LENGTH, STEPS = range(5)
STROKES, HALO, HALO_SIGMA, SATURATED, GLARING, INSIDE, TOGETHER, SPREAD = range(5, STATISTICS)
# A background narrower than this, in radii, is a stroke: the rings of codes begin one radius from the edge.
STROKE = 0.75
# Distance that is examined behind a stroke, and the level, in contrasts from the background, that is glare.
_BEHIND_PX, _GLARE = 2.5, 1.5
# The background begins this many blurs from the edge, where 0.6 % of the step remains. A halo is searched in
# this width of it.
EDGE_ENDS_BLURS, HALO_PX = 2.5, 2.0
# Harmonics 3 to 6 of the outline, cosine and sine of each.
SHAPES = 8
# Standard deviation of rounding intensities.
ROUNDING = 12**-0.5
# Residuals of the edge are used within this many blurs of it, plus this many px.
_BAND_BLURS, _BAND_PX = 1.5, 1.0


@compiled
def _beside_outline(theta: FloatArray, x: float, y: float) -> tuple[float, float, float, float]:
    """Return the position of a pixel relative to the unit circle, u, v and rho, and the slope of rho^2 / 2.

    Its distance from the outline is rho (rho - 1) over that slope, px, to first order.
    """
    p, q, r = theta[model.P], theta[model.Q], theta[model.R]
    dx, dy = x - theta[model.X0], y - theta[model.Y0]
    u, v = p * dx + q * dy, q * dx + r * dy
    slope = math.sqrt((p * u + q * v) ** 2 + (q * u + r * v) ** 2) + 1e-12
    return u, v, math.sqrt(u * u + v * v), slope


@compiled
def judge_residuals(
    pixels: FloatArray,
    n: int,
    theta: FloatArray,
    length: float,
    saturation: float,
    J: FloatArray,
    statistics: FloatArray,
    without_damage: bool,
) -> None:
    """Set the number of pixels, the sum of squared residuals and the unevenness of the edge.

    The unevenness is the largest mean residual of an eighth of the edge, inside or outside, over the
    contrast. An eighth without any background is uneven, unless damage was left out there.
    """
    A, band = theta[model.CONTRAST], _BAND_PX + _BAND_BLURS * theta[model.BLUR]
    mean, count = np.zeros(16), np.zeros(16)
    squares, used = 0.0, 0.0
    for first in range(0, n, model.BLOCK):
        m = min(model.BLOCK, n - first)
        model.linearise(pixels, first, m, theta, length, saturation, J)
        for i in range(m):
            residual = J[model.RESIDUAL + i]
            squares += residual * residual
            used += J[model.WEIGHT + i]
            u, v, rho, nw = _beside_outline(theta, pixels[0, first + i], pixels[1, first + i])
            d = rho * (rho - 1) / nw
            if abs(d) >= band:
                continue
            side, right, down = (8 if d > 0 else 0), (4 if u > 0 else 0), (2 if v > 0 else 0)
            k = side + right + down + (1 if abs(u) > abs(v) else 0)
            mean[k] += residual
            count[k] += 1
    worst = 0.0
    for k in range(16):
        if count[k] > 0:
            worst = max(worst, abs(mean[k]) / count[k])
        elif k >= 8 and not without_damage:
            worst = abs(A)  # no background at all on this side
    statistics[PIXELS], statistics[SQUARES], statistics[UNEVENNESS] = used, squares, worst / abs(A)


@compiled
def _edge_slope(A: float, s: float, d: float, px: float) -> float:
    """Return the derivative of A Phi(-d / s) by a radius that moves the edge by `px` px."""
    return A / s * math.exp(-0.5 * (d / s) ** 2) / math.sqrt(2 * math.pi) * px


@compiled
def sum_sectors(
    pixels: FloatArray,
    n: int,
    theta: FloatArray,
    length: float,
    saturation: float,
    J: FloatArray,
    sectors: FloatArray,
) -> None:
    """Sum up v H and H^2 in each sector of the edge into (2, RAYS), with H the derivative by the radius."""
    A, s = theta[model.CONTRAST], theta[model.BLUR]
    band = _BAND_PX + _BAND_BLURS * s
    sectors[:] = 0.0
    for first in range(0, n, model.BLOCK):
        m = min(model.BLOCK, n - first)
        model.linearise(pixels, first, m, theta, length, saturation, J)
        for i in range(m):
            u, v, rho, nw = _beside_outline(theta, pixels[0, first + i], pixels[1, first + i])
            d = rho * (rho - 1) / nw
            if abs(d) < band:
                slope = J[model.WEIGHT + i] * _edge_slope(A, s, d, rho / nw)
                k = int(math.atan2(v, u) * (RAYS / (2 * math.pi)) + RAYS) % RAYS
                sectors[0, k] += J[model.RESIDUAL + i] * slope
                sectors[1, k] += slope * slope


@compiled
def judge_coherence(
    pixels: FloatArray,
    n: int,
    theta: FloatArray,
    length: float,
    saturation: float,
    noise: float,
    J: FloatArray,
    statistics: FloatArray,
) -> None:
    """Set the largest sums of adjacent residuals, inside and anywhere, and the robust standard deviation.

    A sum is over a square with a side of two blurs, because a photograph shows nothing smaller. At least half
    of the square must be in the fit, and not so far outside that neighbours begin. Inside means deep enough
    to be left out of the fit. The largest residual of a square counts at most as much as the others together,
    since a hot pixel is isolated.
    """
    statistics[INSIDE], statistics[TOGETHER], statistics[SPREAD] = 0.0, 0.0, max(noise, ROUNDING)
    if n == 0:
        return
    band, deep = _BAND_PX + _BAND_BLURS * theta[model.BLUR], HALO_PX + EDGE_ENDS_BLURS * theta[model.BLUR]
    side = max(2, round(2 * theta[model.BLUR]))
    left, top = int(pixels[0, :n].min()), int(pixels[1, :n].min())
    right, bottom = int(pixels[0, :n].max()), int(pixels[1, :n].max())
    # Sums over all rows and columns before, of residuals, of weights, and of pixels that are not deep inside.
    sums, size = np.zeros((3, bottom - top + 2, right - left + 2)), np.empty(n)
    residuals = np.zeros((bottom - top + 1, right - left + 1))
    for first in range(0, n, model.BLOCK):
        m = min(model.BLOCK, n - first)
        model.linearise(pixels, first, m, theta, length, saturation, J)
        for i in range(m):
            x, y, residual = pixels[0, first + i], pixels[1, first + i], J[model.RESIDUAL + i]
            _, _, rho, nw = _beside_outline(theta, x, y)
            d, row, column = rho * (rho - 1) / nw, int(y) - top + 1, int(x) - left + 1
            size[first + i] = abs(residual)
            if d < band:
                sums[0, row, column] = residuals[row - 1, column - 1] = residual
                sums[1, row, column] = J[model.WEIGHT + i]
                sums[2, row, column] = d > -deep
    for k in range(3):
        for i in range(1, sums.shape[1]):
            along = 0.0
            for j in range(1, sums.shape[2]):
                along += sums[k, i, j]
                sums[k, i, j] = sums[k, i - 1, j] + along
    inside, anywhere = 0.0, 0.0
    for i in range(side, sums.shape[1]):
        for j in range(side, sums.shape[2]):
            weight = _within(sums[1], i, j, side)
            if weight < 0.5 * side * side:
                continue
            deep_inside = _within(sums[2], i, j, side) < 0.5
            total, root = _within(sums[0], i, j, side), math.sqrt(weight)
            if abs(total) > root * (min(inside, anywhere) if deep_inside else anywhere):
                sign, largest = math.copysign(1.0, total), 0.0
                for y in range(i - side, i):
                    for x in range(j - side, j):
                        largest = max(largest, sign * residuals[y, x])
                together = min(abs(total), 2 * (abs(total) - largest)) / root
                anywhere = max(anywhere, together)
                if deep_inside:
                    inside = max(inside, together)
    statistics[INSIDE], statistics[TOGETHER] = inside, anywhere
    statistics[SPREAD] = max(1.4826 * np.median(size), noise, ROUNDING)


@compiled
def _within(sums: FloatArray, i: int, j: int, side: int) -> float:
    """Return the sum over a square that ends before row i and column j, from cumulative sums."""
    return float(sums[i, j] - sums[i - side, j] - sums[i, j - side] + sums[i - side, j - side])


@compiled
def shape_equations(
    pixels: FloatArray,
    n: int,
    theta: FloatArray,
    length: float,
    saturation: float,
    cofactor: FloatArray,
    J: FloatArray,
    shape: FloatArray,
) -> None:
    """Set the reduced normal equations of the harmonics of an outline that no ellipse can follow.

    Args:
        pixels: x, y and intensity of the pixels in the fit, shape (3, >= n).
        n: number of pixels.
        theta: unknowns of the model, shape (10,).
        length: L, px.
        saturation: intensities from this value on are censored.
        cofactor: cofactor matrix of the unknowns, shape (10, 10).
        J: work space of size BLOCK_SIZE.
        shape: receives the normal equations of the harmonics, their right-hand side, and the change of the
            centre by each harmonic, px per radius, shape (SHAPES + 3, SHAPES).
    """
    A, s = theta[model.CONTRAST], theta[model.BLUR]
    band = _BAND_PX + 2 * _BAND_BLURS * s
    mixed, column = np.zeros((model.UNKNOWNS, SHAPES)), np.empty(SHAPES)
    shape[:] = 0.0
    for first in range(0, n, model.BLOCK):
        m = min(model.BLOCK, n - first)
        model.linearise(pixels, first, m, theta, length, saturation, J)
        for i in range(m):
            u, v, rho, nw = _beside_outline(theta, pixels[0, first + i], pixels[1, first + i])
            d = rho * (rho - 1) / nw
            if abs(d) >= band:
                continue
            slope = J[model.WEIGHT + i] * _edge_slope(A, s, d, rho / nw)
            c, z = u / (rho + 1e-12), v / (rho + 1e-12)
            ck, zk = c * c - z * z, 2 * c * z
            for k in range(0, SHAPES, 2):
                ck, zk = ck * c - zk * z, zk * c + ck * z
                column[k], column[k + 1] = slope * ck, slope * zk
            for k in range(SHAPES):
                for j in range(k + 1):
                    shape[k, j] += column[k] * column[j]
                shape[SHAPES, k] += column[k] * J[model.RESIDUAL + i]
                for j in range(model.UNKNOWNS):
                    mixed[j, k] += J[j * model.BLOCK + i] * column[k]
    for k in range(SHAPES):
        for j in range(k):
            shape[j, k] = shape[k, j]
    effect = cofactor @ mixed
    shape[:SHAPES] -= mixed.T @ effect
    shape[SHAPES + 1 :] = effect[:2]


@compiled
def judge_background(image: AnyArray, theta: FloatArray, length: float, statistics: FloatArray) -> None:
    """Set the parts of the circumference where the background is only a thin stroke, and where glare is.

    The stroke of a letter "o" is an example: the intensity returns to that of the target nearer to the edge
    than any ring of a code. Intensities much farther from the background than the target's are glare around
    the rim of a retro-reflective target.
    """
    h, w = image.shape
    x0, y0, p, q, r = theta[model.X0], theta[model.Y0], theta[model.P], theta[model.Q], theta[model.R]
    B, A, gx, gy = (
        theta[model.BACKGROUND],
        theta[model.CONTRAST],
        theta[model.GAIN_X] / length,
        theta[model.GAIN_Y] / length,
    )
    det = p * r - q * q
    strokes, glaring = 0, 0
    for k in range(RAYS):
        c, s = HARMONICS[k, 1], HARMONICS[k, 2]
        ex, ey = (r * c - q * s) / det, (p * s - q * c) / det
        R = math.sqrt(ex * ex + ey * ey)
        ex, ey = ex / R, ey / R
        left, back, highest, t = False, math.inf, 0.0, 0.0
        while t <= min(STROKE * R, back) + (_BEHIND_PX if back < math.inf else 0.0):
            x, y = x0 + (R + t) * ex, y0 + (R + t) * ey
            if x < 0 or y < 0 or x >= w - 1 or y >= h - 1:
                break
            level = (bilinear(image, x, y) / (1 + gx * (x - x0) + gy * (y - y0)) - B) / A
            if back < math.inf:
                highest = max(highest, level)
            elif not left:
                left = level < 0.5
            elif level > 0.5:
                back = t
            t += 0.5 * STEP_PX
        if back < math.inf:
            strokes += highest < _GLARE
            glaring += highest >= _GLARE
    statistics[STROKES], statistics[GLARING] = strokes / RAYS, glaring / RAYS


@compiled
def judge_glow(
    pixels: FloatArray, n: int, theta: FloatArray, saturation: float, statistics: FloatArray
) -> None:
    """Set the halo: how much nearer to the target the background beside the edge is than farther away.

    It is set in contrasts, with its standard deviation, and with the saturated part of the background.
    """
    x0, y0, p, q, r = theta[model.X0], theta[model.Y0], theta[model.P], theta[model.Q], theta[model.R]
    B, A, s = theta[model.BACKGROUND], theta[model.CONTRAST], theta[model.BLUR]
    begin = EDGE_ENDS_BLURS * s
    total, count, saturated = np.zeros(2), np.zeros(2), 0.0
    for i in range(n):
        dx, dy = pixels[0, i] - x0, pixels[1, i] - y0
        u, v = p * dx + q * dy, q * dx + r * dy
        rho = math.sqrt(u * u + v * v)
        d = rho * (rho - 1) / (math.sqrt((p * u + q * v) ** 2 + (q * u + r * v) ** 2) + 1e-12)
        if d < begin:
            continue
        far = 1 if d > begin + HALO_PX else 0
        total[far] += pixels[2, i] - B
        count[far] += 1
        saturated += pixels[2, i] >= saturation
    statistics[HALO], statistics[HALO_SIGMA], statistics[SATURATED] = 0.0, math.inf, 0.0
    if count[0] + count[1] > 0:
        statistics[SATURATED] = saturated / (count[0] + count[1])
    if count[0] > 0 and count[1] > 0:
        variance = statistics[SQUARES] / max(statistics[PIXELS] - len(theta), 1.0)
        statistics[HALO] = (total[0] / count[0] - total[1] / count[1]) / A
        statistics[HALO_SIGMA] = math.sqrt(variance * (1 / count[0] + 1 / count[1])) / abs(A)
