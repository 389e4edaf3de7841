"""Corner of a square tag measured by a least squares fit of two blurred edges, compiled.

Let d1, d2 be the signed distances of pixel (x, y) from two lines through the corner (x0, y0), negative on the
side of the tag, s the blur of the edges, B the intensity around the tag, A the step to its border, and g the
change of the gain over L. The intensity is

    I = (B + A ((1 + a) P(s) - a P(t))) (1 + gx (x - x0) / L + gy (y - y0) / L)
    P(s) = Phi(-d1 / s) Phi(-d2 / s) - C(s),    t^2 = s^2 + h^2

a is the sharpening of the camera (unsharp masking). Without it, its halo would be mistaken for a change of
the gain and shift the edge. C is the contribution of the clear modules behind the border, modelled as blurred
rectangles at their positions in the tag; it is recomputed with the estimated blur and corners. The tip, where
both edges act and other print may touch the tag, is left out: the corner is the intersection of the two
edges. The fit stays so near to the corner that distortion does not bend the edges.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled
from sfm.runtime.small_algebra import invert_symmetric, solve_symmetric
from sfm.targets.fits.blurred_ellipse import edge_profile
from sfm.targets.outlines import Flag

# Unknowns of the fit in their order: x0, y0, directions of the two normals, B, A, s, gx, gy, a.
UNKNOWNS = 10
X0, Y0, NORMAL_1, NORMAL_2, BACKGROUND, CONTRAST, BLUR, GAIN_X, GAIN_Y, SHARPENING = range(UNKNOWNS)
# Distance from both edges within which the tip is left out, shorter for small tags (as a part of a side).
TIP_PX, TIP_SHARE, MIN_TIP_PX = 4.0, 0.1, 2.5
# Pixels farther from an edge than this are not used. In the first round the code is avoided: its blur is
# unknown.
BAND_PX, MIN_BAND_PX, CODE_PX = 4.0, 1.5, 2.5
# Part of a side along which edges are used, and its maximum: distortion bends them by less than 0.01 px.
REACH_SHARE, REACH_PX = 0.45, 20.0
CODE_SIGMAS = 3.5  # blurs beyond which a module has no effect
ROUNDS = 3
# A priori sigma of the change of gain over L, as for circular targets; it only keeps the fit regular.
GAIN_SIGMA = 0.3
# A priori sigma of the sharpening, and the width h of its mask, px; cameras use 0.5 to 2 px.
SHARPENING_SIGMA, MASK_PX = 0.5, 1.5
# Initial blur and its limits; the last step; the maximum distance of a corner from its expected position.
BLUR_START, MIN_BLUR, MAX_BLUR, LAST_STEP_PX, MAX_STEPS, FARTHEST_PX = 0.9, 0.25, 4.0, 1e-3, 30, 4.0
_DENSITY_0 = 1 / math.sqrt(2 * math.pi)
_CUT_BY_BORDER = int(Flag.CUT_BY_BORDER)
_NO_CONVERGENCE = int(Flag.NO_CONVERGENCE)
_SATURATED = int(Flag.SATURATED)


class CornerFits(NamedTuple):
    """Fits of the model to the four corners of k tags."""

    theta: FloatArray
    """unknowns, shape (k, 4, 10)"""
    covariance: FloatArray
    """covariance of the unknowns, nan if the fit failed, shape (k, 4, 10, 10)"""
    noise: FloatArray
    """standard deviation of the intensities about the fit, shape (k, 4)"""
    flag: IntArray
    """remarks and reasons for failure, see Flag, shape (k, 4)"""


@compiled
def fit_corners(
    image: AnyArray, quads: FloatArray, tag_from_pixel: FloatArray, clear: BoolArray, saturation: float
) -> CornerFits:
    """Fit the four corners of every tag.

    Args:
        image: intensities, shape (H, W).
        quads: approximate corners of the black squares in order, px, shape (k, 4, 2).
        tag_from_pixel: homographies from pixels to modules, from the first corner along the first two
            sides, shape (k, 3, 3).
        clear: modules of each tag that do not have the colour of its border, row by row, (k, m, m).
        saturation: intensities from this value on are censored.
    """
    k = len(quads)
    theta = np.zeros((k, 4, UNKNOWNS))
    covariance = np.full((k, 4, UNKNOWNS, UNKNOWNS), math.nan)
    noise = np.full((k, 4), math.nan)
    flag = np.zeros((k, 4), np.int64)
    for i in range(k):
        for j in range(4):
            quad = quads[i]
            flag[i, j], noise[i, j] = _fit_one(
                image, quad[j], quad[(j + 1) % 4], quad[(j + 2) % 4], quad[(j + 3) % 4],
                tag_from_pixel[i], clear[i], saturation, theta[i, j], covariance[i, j],
            )  # fmt: skip
    return CornerFits(theta, covariance, noise, flag)


@compiled
def _fit_one(
    image: AnyArray,
    corner: FloatArray,
    following: FloatArray,
    opposite: FloatArray,
    previous: FloatArray,
    tag_from_pixel: FloatArray,
    clear: BoolArray,
    saturation: float,
    theta: FloatArray,
    covariance: FloatArray,
) -> tuple[int, float]:
    """Fit one corner; fill theta and covariance, and return flag and noise."""
    theta[X0], theta[Y0] = corner[0], corner[1]
    depth = math.inf
    for k, (end, other) in enumerate(((following, previous), (previous, following))):
        dx, dy = end[0] - corner[0], end[1] - corner[1]
        nx, ny = -dy, dx
        length = math.sqrt(nx * nx + ny * ny) + 1e-12
        inside = nx * (other[0] - corner[0]) + ny * (other[1] - corner[1])
        if inside > 0:  # the normal points away from the tag
            nx, ny = -nx, -ny
        theta[NORMAL_1 + k] = math.atan2(ny, nx)
        depth = min(depth, abs(inside) / length)
        depth = min(depth, abs(nx * (opposite[0] - corner[0]) + ny * (opposite[1] - corner[1])) / length)
    reach = min(REACH_PX, REACH_SHARE * depth)
    tip = min(TIP_PX, max(MIN_TIP_PX, TIP_SHARE * depth))
    pixels = np.empty((5, int((2 * FARTHEST_PX + 2 * (reach + BAND_PX) * 4) ** 2) + 16))
    flag, noise = 0, math.nan
    theta[BLUR] = BLUR_START
    for round_ in range(ROUNDS):  # each round chooses the pixels around the corner found before
        band = min(BAND_PX, max(MIN_BAND_PX, depth / len(clear) - CODE_PX)) if round_ == 0 else BAND_PX
        n, censored = _collect(image, theta, band, reach, tip, saturation, pixels)
        if n < 0:
            return _CUT_BY_BORDER, noise
        if censored:
            flag |= _SATURATED
        if n < 3 * UNKNOWNS:
            return flag | _NO_CONVERGENCE, noise
        if round_ == 0:
            _start_levels(pixels, n, theta)
        _add_code(pixels, n, tag_from_pixel, clear, theta[BLUR], pixels[3])
        _add_code(pixels, n, tag_from_pixel, clear, math.hypot(theta[BLUR], MASK_PX), pixels[4])
        squares, used = _iterate(pixels, n, theta, saturation, reach, covariance)
        if used <= UNKNOWNS or math.hypot(theta[X0] - corner[0], theta[Y0] - corner[1]) > FARTHEST_PX:
            covariance[:] = math.nan
            return flag | _NO_CONVERGENCE, noise
        variance = max(squares / (used - UNKNOWNS), 1 / 12)  # at least that of rounding
        noise = math.sqrt(variance)
        covariance *= variance
    return flag, noise


@compiled
def _collect(
    image: AnyArray,
    theta: FloatArray,
    band: float,
    reach: float,
    tip: float,
    saturation: float,
    pixels: FloatArray,
) -> tuple[int, bool]:
    """Collect x, y and intensity along the two edges, and return their number, -1 if the border cuts them."""
    h, w = image.shape
    x0, y0 = theta[X0], theta[Y0]
    c1, s1, c2, s2 = (
        math.cos(theta[NORMAL_1]),
        math.sin(theta[NORMAL_1]),
        math.cos(theta[NORMAL_2]),
        math.sin(theta[NORMAL_2]),
    )
    sine = abs(c1 * s2 - s1 * c2)
    half = min((reach + band) / max(sine, 0.2) + 1, 2 * (reach + band))
    if x0 < band or y0 < band or x0 > w - 1 - band or y0 > h - 1 - band:
        return -1, False
    n, censored = 0, False
    for i in range(max(0, int(y0 - half)), min(h, int(y0 + half) + 2)):
        for j in range(max(0, int(x0 - half)), min(w, int(x0 + half) + 2)):
            d1, d2 = c1 * (j - x0) + s1 * (i - y0), c2 * (j - x0) + s2 * (i - y0)
            if max(d1, d2) > band or min(d1, d2) < -reach or min(abs(d1), abs(d2)) > band:
                continue
            if min(d1, d2) > -tip:
                continue
            if n == pixels.shape[1]:
                return n, censored
            pixels[0, n], pixels[1, n], pixels[2, n] = j, i, image[i, j]
            censored = censored or image[i, j] >= saturation
            n += 1
    return n, censored


@compiled
def _add_code(
    pixels: FloatArray, n: int, H: FloatArray, clear: BoolArray, blur: float, parts: FloatArray
) -> None:
    """Set the part of the clear modules in each pixel, 0 to 1."""
    modules = len(clear)
    for k in range(n):
        x, y = pixels[0, k], pixels[1, k]
        w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
        u = (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w
        v = (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w
        su = blur * math.hypot(H[0, 0] - u * H[2, 0], H[0, 1] - u * H[2, 1]) / abs(w)
        sv = blur * math.hypot(H[1, 0] - v * H[2, 0], H[1, 1] - v * H[2, 1]) / abs(w)
        part = 0.0
        for i in range(max(0, int(v - CODE_SIGMAS * sv)), min(modules, int(v + CODE_SIGMAS * sv) + 1)):
            for j in range(max(0, int(u - CODE_SIGMAS * su)), min(modules, int(u + CODE_SIGMAS * su) + 1)):
                if clear[i, j]:
                    across = edge_profile((u - j) / su)[0] - edge_profile((u - j - 1) / su)[0]
                    down = edge_profile((v - i) / sv)[0] - edge_profile((v - i - 1) / sv)[0]
                    part += across * down
        parts[k] = part


@compiled
def _start_levels(pixels: FloatArray, n: int, theta: FloatArray) -> None:
    """Set B and A to the mean intensities beside the tag and on its border; set s and g to start values."""
    c1, s1, c2, s2 = (
        math.cos(theta[NORMAL_1]),
        math.sin(theta[NORMAL_1]),
        math.cos(theta[NORMAL_2]),
        math.sin(theta[NORMAL_2]),
    )
    sums, counts = np.zeros(2), np.zeros(2)
    for i in range(n):
        dx, dy = pixels[0, i] - theta[X0], pixels[1, i] - theta[Y0]
        side = 1 if c1 * dx + s1 * dy < 0 and c2 * dx + s2 * dy < 0 else 0
        sums[side] += pixels[2, i]
        counts[side] += 1
    theta[BACKGROUND] = sums[0] / max(counts[0], 1)
    theta[CONTRAST] = sums[1] / max(counts[1], 1) - theta[BACKGROUND]
    theta[BLUR], theta[GAIN_X], theta[GAIN_Y], theta[SHARPENING] = BLUR_START, 0.0, 0.0, 0.0


@compiled
def _iterate(
    pixels: FloatArray, n: int, theta: FloatArray, saturation: float, length: float, cofactor: FloatArray
) -> tuple[float, int]:
    """Improve theta by Levenberg-Marquardt steps and set the cofactors.

    Returns:
        Sum of squared residuals, and the number of pixels used, 0 without convergence.
    """
    N, g = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    N_trial, g_trial = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    L, trial = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS)
    total, used = _normal_equations(pixels, n, theta, saturation, length, N, g)
    damping = 1e-3
    for _ in range(MAX_STEPS):
        L[:], trial[:] = N, g
        for i in range(UNKNOWNS):
            L[i, i] *= 1 + damping
        if not solve_symmetric(L, trial):
            return total, 0
        shift = max(abs(trial[X0]), abs(trial[Y0]))
        trial += theta
        trial[BLUR] = min(max(trial[BLUR], MIN_BLUR), MAX_BLUR)
        squares, used_trial = _normal_equations(pixels, n, trial, saturation, length, N_trial, g_trial)
        if squares > total * (1 + 1e-9) and used_trial == used:
            damping = max(damping, 1e-3) * 10
            if damping > 1e6:
                return total, 0
            continue
        theta[:], N[:], g[:] = trial, N_trial, g_trial
        total, used = squares, used_trial
        damping *= 0.1
        if shift < LAST_STEP_PX:
            if not invert_symmetric(N):
                return total, 0
            cofactor[:] = N
            return total, used
    return total, 0


@compiled
def _normal_equations(
    pixels: FloatArray,
    n: int,
    theta: FloatArray,
    saturation: float,
    length: float,
    N: FloatArray,
    g: FloatArray,
) -> tuple[float, int]:
    """Sum up N = J'J and g = J'v with the prior of the gain; return v'v and the number of pixels used."""
    x0, y0, B, A, s = theta[X0], theta[Y0], theta[BACKGROUND], theta[CONTRAST], theta[BLUR]
    gx, gy, a = theta[GAIN_X] / length, theta[GAIN_Y] / length, theta[SHARPENING]
    t = math.hypot(s, MASK_PX)
    c1, s1, c2, s2 = (
        math.cos(theta[NORMAL_1]),
        math.sin(theta[NORMAL_1]),
        math.cos(theta[NORMAL_2]),
        math.sin(theta[NORMAL_2]),
    )
    N[:], g[:] = 0.0, 0.0
    squares, used = 0.0, 0
    J = np.empty(UNKNOWNS)
    for i in range(n):
        dx, dy, value = pixels[0, i] - x0, pixels[1, i] - y0, pixels[2, i]
        d1, d2 = c1 * dx + s1 * dy, c2 * dx + s2 * dy
        phi1, e1 = edge_profile(-d1 / s)
        phi2, e2 = edge_profile(-d2 / s)
        wide1, h1 = edge_profile(-d1 / t)
        wide2, h2 = edge_profile(-d2 / t)
        gain = 1 + gx * dx + gy * dy
        share, mask = phi1 * phi2 - pixels[3, i], wide1 * wide2 - pixels[4, i]
        profile = (1 + a) * share - a * mask
        level = B + A * profile
        model = level * gain
        if (value >= saturation and model >= saturation) or (value <= 0 and model <= 0):
            continue  # nothing more is known of it (censored observation)
        # dI / d d1 and d2, by the edges and by the mask
        scale = -A * _DENSITY_0 * gain
        f1, f2 = scale * (1 + a) * e1 * phi2 / s, scale * (1 + a) * e2 * phi1 / s
        m1, m2 = -scale * a * h1 * wide2 / t, -scale * a * h2 * wide1 / t
        J[BLUR] = -(f1 * d1 + f2 * d2) / s - (m1 * d1 + m2 * d2) * s / (t * t)
        J[SHARPENING] = A * (share - mask) * gain
        f1, f2 = f1 + m1, f2 + m2
        J[X0] = -f1 * c1 - f2 * c2 - level * gx
        J[Y0] = -f1 * s1 - f2 * s2 - level * gy
        J[NORMAL_1] = f1 * (c1 * dy - s1 * dx)
        J[NORMAL_2] = f2 * (c2 * dy - s2 * dx)
        J[BACKGROUND] = gain
        J[CONTRAST] = profile * gain
        J[GAIN_X] = level * dx / length
        J[GAIN_Y] = level * dy / length
        v = value - model
        squares += v * v
        used += 1
        for j in range(UNKNOWNS):
            g[j] += J[j] * v
            for k in range(j + 1):
                N[j, k] += J[j] * J[k]
    variance = squares / max(used - UNKNOWNS, 1) + 1 / 12
    for j in (GAIN_X, GAIN_Y, SHARPENING):
        prior = variance / (SHARPENING_SIGMA if j == SHARPENING else GAIN_SIGMA) ** 2
        N[j, j] += prior
        g[j] -= prior * theta[j]
    return squares, used
