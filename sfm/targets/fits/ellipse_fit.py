"""Least squares fit of the model in `blurred_ellipse` to circular targets, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled
from sfm.runtime.small_algebra import invert_symmetric, solve_symmetric
from sfm.targets.edge_rays import RAYS, STEP_PX, improve_outline, trace_rays
from sfm.targets.fits import blurred_ellipse as model
from sfm.targets.fits import goodness
from sfm.targets.outlines import Flag

# A priori sigma of the change of gain over L: far above shading, it only keeps the fit regular.
GAIN_SIGMA = 0.3
MAX_STEPS = 30
# The iteration ends with a step below this. Gauss-Newton steps shrink by a factor of ten or more, so the
# remaining error is far below the precision of any target.
LAST_STEP_PX = 5e-3
# Background used in the fit: this many px plus this part of the mean semi-axis, up to the maximum.
MARGIN_PX, MARGIN_SHARE, MARGIN_MAX_PX = 4.0, 0.25, 10.0
# For targets larger than this (mean semi-axis) only a band inside the edge is used; the rest adds nothing.
LARGE_PX, BAND_PX = 25.0, 15.0
# Initial blur of the edge, and its minimum.
BLUR_START, MIN_BLUR = 0.9, 0.25
# A rise to a neighbour is detected at three tenths of its step, half a blur before its edge.
RISE_BLURS = 0.5
# The outline is traced again if it changed by more than this part of the radius; this many rays must agree.
MAX_TRACES, SMALL_CHANGE, MIN_AGREEMENT = 2, 0.08, 0.7
_NONE = int(Flag.NONE)
_SATURATED = int(Flag.SATURATED)
_CLOSE_NEIGHBOUR = int(Flag.CLOSE_NEIGHBOUR)
_CUT_BY_BORDER = int(Flag.CUT_BY_BORDER)
_NOT_ELLIPTIC = int(Flag.NOT_ELLIPTIC)
_NO_CONVERGENCE = int(Flag.NO_CONVERGENCE)


class EllipseFits(NamedTuple):
    """Fits of the model to k targets."""

    theta: FloatArray
    """unknowns in the order of `blurred_ellipse`, shape (k, 10)"""
    cofactor: FloatArray
    """cofactor matrices of the unknowns, nan if the fit failed, shape (k, 10, 10)"""
    statistics: FloatArray
    """in the columns of `goodness`, shape (k, STATISTICS)"""
    flag: IntArray
    """remarks and reasons for failure, see Flag, shape (k,)"""
    sectors: FloatArray
    """sums of v J and of J^2 in each sector of the edge, with J the derivative of an intensity by the radius
    of the outline, in radii, shape (k, 2, RAYS)"""
    shape: FloatArray
    """equations of the harmonics of the outline, see `goodness.shape_equations`,
    shape (k, SHAPES + 3, SHAPES)"""


@compiled
def fit_ellipses(
    image: AnyArray,
    start: FloatArray,
    sign: IntArray,
    noise: float,
    saturation: float,
    keep: BoolArray,
    depth: FloatArray,
) -> EllipseFits:
    """Fit the model to every target.

    Args:
        image: intensities, shape (H, W).
        start: x0, y0, p, q, r, shape (k, 5).
        sign: +1 bright, -1 dark target, shape (k,).
        noise: approximate standard deviation of the intensities.
        saturation: intensities from this value on are censored.
        keep: sectors of each target, from one ray to the next, that take part, shape (k, RAYS).
        depth: distance inside the edge up to which intensities are used, px, shape (k,).
    """
    k = len(start)
    theta = np.zeros((k, model.UNKNOWNS))
    cofactor = np.full((k, model.UNKNOWNS, model.UNKNOWNS), math.nan)
    statistics = np.ones((k, goodness.STATISTICS))
    flag = np.zeros(k, np.int64)
    sectors = np.zeros((k, 2, RAYS))
    shape = np.zeros((k, goodness.SHAPES + 3, goodness.SHAPES))
    J = np.zeros(model.BLOCK_SIZE)
    for i in range(k):
        theta[i, :5] = start[i]
        flag[i] = _fit_one(
            image,
            theta[i],
            sign[i],
            noise,
            saturation,
            keep[i],
            depth[i],
            J,
            cofactor[i],
            statistics[i],
            sectors[i],
            shape[i],
        )
    return EllipseFits(theta, cofactor, statistics, flag, sectors, shape)


@compiled
def _fit_one(
    image: AnyArray,
    theta: FloatArray,
    sign: int,
    noise: float,
    saturation: float,
    keep: BoolArray,
    depth: float,
    J: FloatArray,
    cofactor: FloatArray,
    statistics: FloatArray,
    sectors: FloatArray,
    shape: FloatArray,
) -> int:
    """Fit one target; fill theta, cofactor, statistics, sectors and shape, and return the flag."""
    flag = _NONE
    edge, limit = np.empty(RAYS), np.empty(RAYS)
    mean, margin = 0.0, 0.0
    for _ in range(MAX_TRACES):
        mean = 1 / math.sqrt(max(theta[model.P] * theta[model.R] - theta[model.Q] ** 2, 1e-12))
        margin = min(MARGIN_MAX_PX, MARGIN_PX + MARGIN_SHARE * mean)
        step = trace_rays(image, theta, sign, noise, margin, _skirt(MIN_BLUR), edge, limit)
        agree, change = improve_outline(theta, edge)
        if agree < MIN_AGREEMENT or step <= 0:
            return _NOT_ELLIPTIC
        if change < SMALL_CHANGE:
            break
    if limit.min() < 0:
        return _CUT_BY_BORDER
    if limit.min() < margin:
        flag |= _CLOSE_NEIGHBOUR
    det = theta[model.P] * theta[model.R] - theta[model.Q] ** 2
    mean = 1 / math.sqrt(det)
    length = mean + margin
    statistics[goodness.LENGTH] = length
    if mean >= LARGE_PX:
        depth = min(depth, BAND_PX)
    half_x = math.sqrt(theta[model.R] ** 2 + theta[model.Q] ** 2) / det + margin + 1
    half_y = math.sqrt(theta[model.P] ** 2 + theta[model.Q] ** 2) / det + margin + 1
    pixels = np.empty((3, int((2 * half_x + 3) * (2 * half_y + 3))))
    n = _collect(image, theta, limit, margin, half_x, half_y, depth, keep, pixels)
    flag |= _start_levels(pixels, n, theta, saturation)
    if theta[model.CONTRAST] * sign <= 0 or n < 2 * model.UNKNOWNS:
        return flag | _NO_CONVERGENCE
    prior = (noise / GAIN_SIGMA) ** 2
    N = np.empty((model.UNKNOWNS, model.UNKNOWNS))
    steps = _iterate(pixels, n, theta, length, saturation, prior, J, N)
    if steps > 0 and theta[model.CONTRAST] * sign > 0:
        # The edges of neighbours are as soft: their skirts begin farther from them than the rays first
        # showed.
        wide = np.empty(RAYS)
        trace_rays(image, theta, sign, noise, margin, _skirt(theta[model.BLUR]), edge, wide)
        nearer = False
        for k in range(RAYS):
            if 0 <= wide[k] < limit[k]:
                limit[k], nearer = wide[k], True
        if nearer:
            flag |= _CLOSE_NEIGHBOUR
            n = _collect(image, theta, limit, margin, half_x, half_y, depth, keep, pixels)
            steps = (
                _iterate(pixels, n, theta, length, saturation, prior, J, N) if n > 2 * model.UNKNOWNS else 0
            )
    done = steps > 0
    goodness.judge_residuals(pixels, n, theta, length, saturation, J, statistics, not keep.all())
    goodness.judge_coherence(pixels, n, theta, length, saturation, noise, J, statistics)
    goodness.judge_background(image, theta, length, statistics)
    goodness.judge_glow(pixels, n, theta, saturation, statistics)
    statistics[goodness.STEPS] = abs(steps)
    N[model.GAIN_X, model.GAIN_X] += prior
    N[model.GAIN_Y, model.GAIN_Y] += prior
    if (
        not done
        or theta[model.CONTRAST] * sign <= 0
        or statistics[goodness.PIXELS] <= model.UNKNOWNS
        or not invert_symmetric(N)
    ):
        return flag | _NO_CONVERGENCE
    cofactor[:] = N
    goodness.shape_equations(pixels, n, theta, length, saturation, cofactor, J, shape)
    n = _collect(image, theta, limit, margin, half_x, half_y, depth, np.ones(RAYS, np.bool_), pixels)
    goodness.sum_sectors(pixels, n, theta, length, saturation, J, sectors)
    return flag


@compiled
def _skirt(blur: float) -> float:
    """Return the distance before the rise to a neighbour at which the background is undisturbed, px.

    As beside the edge of the target, a few thousandths of the step remain there. Rays find a rise up to a
    step late.
    """
    return (goodness.EDGE_ENDS_BLURS - RISE_BLURS) * blur + STEP_PX


@compiled
def _iterate(
    pixels: FloatArray,
    n: int,
    theta: FloatArray,
    length: float,
    saturation: float,
    prior: float,
    J: FloatArray,
    N: FloatArray,
) -> int:
    """Improve theta by Levenberg-Marquardt steps; N receives its normal equations, without the prior.

    Returns:
        The number of steps, negative or 0 without convergence.
    """
    mean = (theta[model.P] * theta[model.R] - theta[model.Q] ** 2) ** -0.5
    N_trial = np.empty((model.UNKNOWNS, model.UNKNOWNS))
    L = np.empty((model.UNKNOWNS, model.UNKNOWNS))
    g, g_trial, trial = np.empty(model.UNKNOWNS), np.empty(model.UNKNOWNS), np.empty(model.UNKNOWNS)
    total, used = model.normal_equations(pixels, n, theta, length, saturation, J, N, g)
    damping = 1e-3
    steps = 0
    while steps < MAX_STEPS and damping < 1e6:
        steps += 1
        for i in range(model.UNKNOWNS):
            for j in range(i + 1):
                L[i, j] = N[i, j]
            if i >= model.GAIN_X:
                L[i, i] += prior
            L[i, i] *= 1 + damping
            trial[i] = g[i] - (prior * theta[i] if i >= model.GAIN_X else 0.0)
        if not solve_symmetric(L, trial):
            return -steps
        shift = max(abs(trial[model.X0]), abs(trial[model.Y0]))
        for i in range(model.UNKNOWNS):
            trial[i] += theta[i]
        trial[model.BLUR] = min(max(trial[model.BLUR], MIN_BLUR), 2 * mean)
        if (
            trial[model.P] * trial[model.R] - trial[model.Q] ** 2 <= 0
            or trial[model.P] <= 0
            or shift > mean + 2
        ):
            damping = max(damping, 1e-3) * 10
            continue
        if shift < LAST_STEP_PX and damping < 1e-3:
            theta[:] = trial
            return steps
        squares, used_trial = model.normal_equations(
            pixels, n, trial, length, saturation, J, N_trial, g_trial
        )
        before = total + prior * (theta[model.GAIN_X] ** 2 + theta[model.GAIN_Y] ** 2)
        after = squares + prior * (trial[model.GAIN_X] ** 2 + trial[model.GAIN_Y] ** 2)
        if after <= before * (1 + 1e-9) or used_trial != used:
            theta[:], N[:], g[:] = trial, N_trial, g_trial
            total, used = squares, used_trial
            damping *= 0.1
        else:
            damping = max(damping, 1e-3) * 10
    return -steps


@compiled
def _collect(
    image: AnyArray,
    theta: FloatArray,
    limit: FloatArray,
    margin: float,
    half_x: float,
    half_y: float,
    depth: float,
    keep: BoolArray,
    pixels: FloatArray,
) -> int:
    """Collect x, y and intensity of the target and its undisturbed background, and return their number."""
    h, w = image.shape
    x0, y0, p, q, r = theta[model.X0], theta[model.Y0], theta[model.P], theta[model.Q], theta[model.R]
    disturbed, cut = limit.min() < margin, not keep.all()
    n = 0
    for i in range(max(0, int(y0 - half_y)), min(h, int(y0 + half_y) + 2)):
        dy = i - y0
        for j in range(max(0, int(x0 - half_x)), min(w, int(x0 + half_x) + 2)):
            dx = j - x0
            u, v = p * dx + q * dy, q * dx + r * dy
            rho = math.sqrt(u * u + v * v)
            if rho > 1 or depth < math.inf:
                d = rho * (rho - 1) / (math.sqrt((p * u + q * v) ** 2 + (q * u + r * v) ** 2) + 1e-12)
                if d > margin or d < -depth:
                    continue
            if cut or (disturbed and rho > 1):
                k = int(math.atan2(v, u) * (RAYS / (2 * math.pi)) + RAYS)
                if not keep[k % RAYS] or (rho > 1 and (d > limit[k % RAYS] or d > limit[(k + 1) % RAYS])):
                    continue
            if n == pixels.shape[1]:
                return n
            pixels[0, n], pixels[1, n], pixels[2, n] = j, i, image[i, j]
            n += 1
    return n


@compiled
def _start_levels(pixels: FloatArray, n: int, theta: FloatArray, saturation: float) -> int:
    """Set B and A to the mean intensities outside and inside the outline; set s and g to start values."""
    outside, inside, n_out, n_in = 0.0, 0.0, 0, 0
    flag = _NONE
    for i in range(n):
        dx, dy = pixels[0, i] - theta[model.X0], pixels[1, i] - theta[model.Y0]
        u, v = theta[model.P] * dx + theta[model.Q] * dy, theta[model.Q] * dx + theta[model.R] * dy
        if u * u + v * v > 1:
            outside += pixels[2, i]
            n_out += 1
        else:
            inside += pixels[2, i]
            n_in += 1
        if pixels[2, i] >= saturation:
            flag |= _SATURATED
    theta[model.BACKGROUND], theta[model.CONTRAST] = 0.0, 0.0
    if n_out > 0 and n_in > 0:
        theta[model.BACKGROUND], theta[model.CONTRAST] = outside / n_out, inside / n_in - outside / n_out
    theta[model.BLUR], theta[model.GAIN_X], theta[model.GAIN_Y] = BLUR_START, 0.0, 0.0
    return flag
