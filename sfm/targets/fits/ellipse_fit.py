"""Least squares fit of the model of a blurred ellipse (see blurred_ellipse) to circular targets, compiled."""

from __future__ import annotations

import math

import numpy as np

from sfm.conventions import AnyArray, FloatArray, IntArray
from sfm.kernels.cholesky import invert_symmetric, solve_symmetric
from sfm.kernels.options import compiled
from sfm.targets.edge_rays import RAYS, improve_outline, trace_rays
from sfm.targets.fits.blurred_ellipse import BLOCK, PARAMETERS, normal_equations
from sfm.targets.fits.goodness import STATISTICS, judge_background, judge_glow, judge_residuals
from sfm.targets.flags import Flag

# A priori sigma of the change of gain over L: far above shading, it only keeps the fit regular.
GAIN_SIGMA = 0.3
MAX_STEPS = 30
# A step below this is the last one; as Gauss-Newton steps shrink by a factor of ten or more, what is left is
# far below the precision of any target.
LAST_STEP_PX = 5e-3
# Background taken into the fit: so many px and this share of the mean semi-axis, at most.
MARGIN_PX, MARGIN_SHARE, MARGIN_MAX_PX = 4.0, 0.25, 10.0
# Of targets larger than this (mean semi-axis) only a band inside the edge is used: the rest tells nothing.
LARGE_PX, BAND_PX = 25.0, 15.0
# Blur of the edge at the start and its limits.
BLUR_START, BLUR_LEAST = 0.9, 0.25
# The outline is traced again if it changed by more than this share of the radius; so many rays must agree.
MAX_TRACES, SMALL_CHANGE, LEAST_AGREEMENT = 2, 0.08, 0.7
_NONE = int(Flag.NONE)
_SATURATED = int(Flag.SATURATED)
_CLOSE_NEIGHBOUR = int(Flag.CLOSE_NEIGHBOUR)
_CUT_BY_BORDER = int(Flag.CUT_BY_BORDER)
_NOT_ELLIPTIC = int(Flag.NOT_ELLIPTIC)
_NO_CONVERGENCE = int(Flag.NO_CONVERGENCE)


@compiled
def fit_templates(
    image: AnyArray, start: FloatArray, sign: IntArray, noise: float, saturation: float
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Fit the template to every target.

    Args:
        image: intensities, shape (H, W).
        start: x0, y0, p, q, r, shape (k, 5).
        sign: +1 bright, -1 dark target, shape (k,).
        noise: approximate standard deviation of the intensities.
        saturation: intensities from here on are censored.

    Returns:
        Unknowns, shape (k, 10); their cofactor matrices, shape (k, 10, 10), nan where the fit failed;
        statistics of the fit in the order of goodness, L in px and steps, shape (k, STATISTICS);
        flags, shape (k,).
    """
    k = len(start)
    theta = np.zeros((k, PARAMETERS))
    cofactor = np.full((k, PARAMETERS, PARAMETERS), math.nan)
    statistics = np.ones((k, STATISTICS))
    flag = np.zeros(k, np.int64)
    J = np.zeros((PARAMETERS + 2) * BLOCK)
    for i in range(k):
        theta[i, :5] = start[i]
        flag[i] = _fit_one(image, theta[i], sign[i], noise, saturation, J, cofactor[i], statistics[i])
    return theta, cofactor, statistics, flag


@compiled
def _fit_one(
    image: AnyArray,
    theta: FloatArray,
    sign: int,
    noise: float,
    saturation: float,
    J: FloatArray,
    cofactor: FloatArray,
    statistics: FloatArray,
) -> int:
    """Fit one target; theta, cofactor and statistics are filled, the flag is returned."""
    flag = _NONE
    edge, limit = np.empty(RAYS), np.empty(RAYS)
    mean, margin = 0.0, 0.0
    for _ in range(MAX_TRACES):
        mean = 1 / math.sqrt(max(theta[2] * theta[4] - theta[3] ** 2, 1e-12))
        margin = min(MARGIN_MAX_PX, MARGIN_PX + MARGIN_SHARE * mean)
        step = trace_rays(image, theta, sign, noise, margin, edge, limit)
        agree, change = improve_outline(theta, edge)
        if agree < LEAST_AGREEMENT or step <= 0:
            return _NOT_ELLIPTIC
        if change < SMALL_CHANGE:
            break
    if limit.min() < 0:
        return _CUT_BY_BORDER
    if limit.min() < margin:
        flag |= _CLOSE_NEIGHBOUR
    det = theta[2] * theta[4] - theta[3] ** 2
    mean = 1 / math.sqrt(det)
    length = mean + margin
    statistics[3] = length
    half_x = math.sqrt(theta[4] ** 2 + theta[3] ** 2) / det + margin + 1
    half_y = math.sqrt(theta[2] ** 2 + theta[3] ** 2) / det + margin + 1
    data = np.empty((3, int((2 * half_x + 3) * (2 * half_y + 3))))
    n = _collect(image, theta, limit, margin, half_x, half_y, mean < LARGE_PX, data)
    flag |= _start_levels(data, n, theta, saturation)
    if theta[6] * sign <= 0 or n < 2 * PARAMETERS:
        return flag | _NO_CONVERGENCE
    prior = (noise / GAIN_SIGMA) ** 2
    N, N_trial = np.empty((PARAMETERS, PARAMETERS)), np.empty((PARAMETERS, PARAMETERS))
    L = np.empty((PARAMETERS, PARAMETERS))
    g, g_trial, trial = np.empty(PARAMETERS), np.empty(PARAMETERS), np.empty(PARAMETERS)
    total, used = normal_equations(data, n, theta, length, saturation, J, N, g)
    damping = 1e-3
    done = False
    steps = 0
    while steps < MAX_STEPS and damping < 1e6 and not done:
        steps += 1
        for i in range(PARAMETERS):
            for j in range(i + 1):
                L[i, j] = N[i, j]
            if i >= 8:
                L[i, i] += prior
            L[i, i] *= 1 + damping
            trial[i] = g[i] - (prior * theta[i] if i >= 8 else 0.0)
        if not solve_symmetric(L, trial):
            return flag | _NO_CONVERGENCE
        shift = max(abs(trial[0]), abs(trial[1]))
        for i in range(PARAMETERS):
            trial[i] += theta[i]
        trial[7] = min(max(trial[7], BLUR_LEAST), 2 * mean)
        if trial[2] * trial[4] - trial[3] ** 2 <= 0 or trial[2] <= 0 or shift > mean + 2:
            damping = max(damping, 1e-3) * 10
            continue
        if shift < LAST_STEP_PX and damping < 1e-3:
            theta[:] = trial
            done = True
            break
        squares, used_trial = normal_equations(data, n, trial, length, saturation, J, N_trial, g_trial)
        before = total + prior * (theta[8] ** 2 + theta[9] ** 2)
        after = squares + prior * (trial[8] ** 2 + trial[9] ** 2)
        if after <= before * (1 + 1e-9) or used_trial != used:
            theta[:], N[:], g[:] = trial, N_trial, g_trial
            total, used = squares, used_trial
            damping *= 0.1
        else:
            damping = max(damping, 1e-3) * 10
    judge_residuals(data, n, theta, length, saturation, J, statistics)
    judge_background(image, theta, length, statistics)
    judge_glow(data, n, theta, saturation, statistics)
    statistics[4] = steps
    N[8, 8] += prior
    N[9, 9] += prior
    if not done or theta[6] * sign <= 0 or statistics[0] <= PARAMETERS or not invert_symmetric(N):
        return flag | _NO_CONVERGENCE
    cofactor[:] = N
    return flag


@compiled
def _collect(
    image: AnyArray,
    theta: FloatArray,
    limit: FloatArray,
    margin: float,
    half_x: float,
    half_y: float,
    whole: bool,
    data: FloatArray,
) -> int:
    """Collect x, y and intensity of the target and its undisturbed background; return how many."""
    h, w = image.shape
    x0, y0, p, q, r = theta[0], theta[1], theta[2], theta[3], theta[4]
    disturbed = limit.min() < margin
    n = 0
    for i in range(max(0, int(y0 - half_y)), min(h, int(y0 + half_y) + 2)):
        dy = i - y0
        for j in range(max(0, int(x0 - half_x)), min(w, int(x0 + half_x) + 2)):
            dx = j - x0
            u, v = p * dx + q * dy, q * dx + r * dy
            rho = math.sqrt(u * u + v * v)
            if rho > 1 or not whole:
                d = rho * (rho - 1) / (math.sqrt((p * u + q * v) ** 2 + (q * u + r * v) ** 2) + 1e-12)
                if d > margin or d < -BAND_PX:
                    continue
            if disturbed and rho > 1:
                k = int(math.atan2(v, u) * (RAYS / (2 * math.pi)) + RAYS)
                if d > limit[k % RAYS] or d > limit[(k + 1) % RAYS]:
                    continue
            if n == data.shape[1]:
                return n
            data[0, n], data[1, n], data[2, n] = j, i, image[i, j]
            n += 1
    return n


@compiled
def _start_levels(data: FloatArray, n: int, theta: FloatArray, saturation: float) -> int:
    """Set B and A to the mean intensities out- and inside the outline, s and g to their start values."""
    outside, inside, n_out, n_in = 0.0, 0.0, 0, 0
    flag = _NONE
    for i in range(n):
        dx, dy = data[0, i] - theta[0], data[1, i] - theta[1]
        u, v = theta[2] * dx + theta[3] * dy, theta[3] * dx + theta[4] * dy
        if u * u + v * v > 1:
            outside += data[2, i]
            n_out += 1
        else:
            inside += data[2, i]
            n_in += 1
        if data[2, i] >= saturation:
            flag |= _SATURATED
    theta[5], theta[6] = 0.0, 0.0
    if n_out > 0 and n_in > 0:
        theta[5], theta[6] = outside / n_out, inside / n_in - outside / n_out
    theta[7], theta[8], theta[9] = BLUR_START, 0.0, 0.0
    return flag
