"""Least squares matching: the position of a patch of one photograph in another, and its precision.

The patch T around a point of the left photograph is related to the right photograph S by

    S(H x) = alpha + beta T(x) + noise

for x in the window, with a geometric model H (shift, affine or projective) and two radiometric ones.
Gauss-Newton is written in its inverse form. The change dH of a step is applied to the template, whose
gradients and normal equations then stay the same in all steps, and H is updated by H <- H dH^-1. The right
photograph is resampled in every step. The gradients are symmetric differences of the resampled template. At
convergence the result is the least squares solution of the forward equations, up to the noise of the
gradients.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from sfm.matching.correlation import (
    DIVERGED,
    FLAT_TEXTURE,
    LOW_CORRELATION,
    MATCHED,
    OUTSIDE,
    TOO_FAR,
    LsmFlag,
)
from sfm.matching.lsm.patch_equations import (
    BLUR,
    BLUR_NOISE,
    LINEAR,
    MODELS,
    RADIOMETRIC,
    SHIFT,
    SLOPE_NOISE,
    Workspace,
    area_ratio,
    dot,
    new_workspace,
    prepare_template,
    put_step,
    resample_patch,
)
from sfm.matching.radiometry import Grey, grey_of, odd_window
from sfm.model.arguments import checked_arguments, checked_fields
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.runtime.compiling import compiled, compiled_fast
from sfm.runtime.sampling import BILINEAR, TAPS, interpolation_index, kernel_weights
from sfm.runtime.small_algebra import factorise, solve_factorised

# Texture is flat in a direction in which the gradients of the window have no more energy than noise has by
# chance: its mean plus this many standard deviations.
TEXTURE_SIGMAS = 3.0
# Variance of this energy over n pixels, times n, for a mean of 1: twice the sum of squared autocorrelations
# of white noise seen through the difference formula, and through the mask that estimates its variance.
ENERGY_VARIANCE = 2.0 * 1.576 + 2.0 * (35.0 / 18.0) ** 2
# Columns of the result for a patch: position with its covariances, gain, offset, r, sigma0, steps, and in
# left units the variance of a difference of intensities and that of white noise.
OUTPUTS = 13
FLAG, X, Y, CXX, CXY, CYY, GAIN, OFFSET, R, SIGMA0, STEPS, VARIANCE, WHITE = range(OUTPUTS)
# Columns of the linear part of a warp: score, its derivative and its spread, and the derivative of the shift.
OF_LINEAR = (LINEAR, LINEAR * LINEAR, LINEAR * LINEAR, SHIFT * LINEAR)
COARSE_STEP = 0.5  # bilinear interpolation is good enough while steps are longer than this, px
CONTRACTION = 0.04  # largest ratio of a step to the previous one; 0.01 to 0.03 on texture with noise
# Next step after the last one allowed, up to which a match is accepted; along edges, steps shrink slowly.
LAST_PX = 0.002
MIN_ALONG = 0.1  # of the square of a shift: Gauss-Newton's shift must shrink by so much along it
CHUNK = 256  # patches that a thread processes at a time


class Limits(NamedTuple):
    """Criteria for the end of the steps of a patch, and for a result to be accepted."""

    stop_px: float  # the shift of the next step would be shorter
    max_steps: int
    max_shift_px: float  # from the start
    min_correlation: float


@dataclass(frozen=True)
class LinearParts:
    """What the residuals of shifted windows say of the linear parts of their warps, which were kept.

    A linear part is d = (xx, xy, yx, yy) in the left photograph: H (1 + d) fits better than H. Its score is
    the product of the residuals and their derivatives by d, after elimination of all that was estimated.
    """

    score: FloatArray  # in squares of left units, (k, 4)
    derivative: FloatArray  # of the expected score by d, (k, 4, 4)
    spread: FloatArray  # covariance of the score if a difference of intensities has the variance 1, (k, 4, 4)
    variance: FloatArray  # of a difference of intensities, squares of left units, (k,)
    shift: FloatArray  # change of the match by d put into the warp, px in the left photograph, (k, 2, 4)

    def select(self, rows: BoolArray) -> LinearParts:
        """Return those of the selected matches."""
        return LinearParts(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True)
class LsmMatches:
    """Positions in the right photograph found by least squares matching; NaN with the reason in the flag."""

    xy: FloatArray  # position of the left point in the right photograph, px, (k, 2)
    covariance: FloatArray  # of xy, px^2, (k, 2, 2)
    warp: FloatArray  # H: right px from left px relative to the left point, homogeneous, (k, 3, 3)
    gain: FloatArray  # beta: right intensities per left one, (k,)
    offset: FloatArray  # alpha, right intensity units, (k,)
    correlation: FloatArray  # r of template and resampled patch, (k,)
    sigma0: FloatArray  # standard deviation of an intensity difference, right units, (k,)
    steps: IntArray  # Gauss-Newton steps, (k,)
    flag: IntArray  # see LsmFlag, 0 = matched, (k,)
    linear: LinearParts | None = None  # where the settings ask for them

    def __len__(self) -> int:
        return len(self.xy)

    @property
    def good(self) -> BoolArray:
        """Which points were matched, (k,)."""
        return np.asarray(self.flag == 0)


@checked_fields
@dataclass(frozen=True)
class LsmSettings:
    """Settings of least squares matching."""

    model: str = "affine"
    """shift (2), affine (6) or projective (8 parameters), each with gain and offset."""
    window_px: int = 21  # odd side of the template
    interpolation: str = "six_tap"
    """kernel for the right photograph. On fine texture the standard deviation is 1.25 times that of six_tap
    with bilinear, and 1.06 times with bicubic. If the whole patch is shifted by the same 0.1 to 0.4 px, both
    are off by up to 0.013 px, six_tap by 0.002 px."""
    stop_px: float = 0.0002
    """the steps end when the next shift would be shorter than this. The remaining shift has the direction of
    the start, which neighbouring points share: 0.002 px would rotate photographs."""
    max_steps: int = 30  # a patch that needs more steps counts as diverged
    max_shift_px: float = 5.0  # largest distance from the start
    min_correlation: float = 0.5  # smallest r of a match
    blur: bool = False
    """whether three more unknowns describe the difference of blur between the photographs. On an oblique
    surface the blur always differs, since a pixel covers more of it. Without these unknowns, windows move by
    0.01 px, in the same way in all matches of a template."""
    linear: bool = False
    """whether the matches of a shift have the score of the linear part of their warp."""


@checked_arguments(xy_left="k 2", xy_right="n 2")
def match_lsm(
    left: AnyArray | Grey,
    right: AnyArray | Grey,
    xy_left: FloatArray,
    xy_right: FloatArray,
    settings: LsmSettings = LsmSettings(),
    *,
    start: FloatArray | None = None,
    threads: int = 1,
) -> LsmMatches:
    """Match points of the left photograph in the right one, from positions known to a pixel or two.

    Args:
        left: photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: the other photograph.
        xy_left: points in the left photograph, px, any fraction, (k, 2).
        xy_right: approximate positions of these points in the right photograph, px, (k, 2).
        settings: geometric model, window, interpolation, end of the steps, and limits of a match.
        start: linear part of the warp, right px per left px, (k, 2, 2), or its homography relative to both
            points, (k, 3, 3), whose perspective an affine model keeps; by default the unit matrix.
        threads: number of threads that share the patches.

    Returns:
        One match per point; the covariance assumes the same noise in both photographs, after the gain.

    Raises:
        GeometryError: an unknown model or kernel, an even window, different numbers of points, or the score
            of a linear part that is estimated, or of too few pixels.

    Source: Gruen (1985), S. Afr. J. Photogrammetry 14(3), and Foerstner (1993) in Haralick and Shapiro,
    Computer and Robot Vision II, ch. 16; the inverse form is Baker and Matthews (2004), IJCV 56(3).
    """
    model = settings.model
    if model not in MODELS:
        raise GeometryError(f"LSM: model '{model}', expected one of {', '.join(MODELS)}")
    kind = interpolation_index(settings.interpolation)
    if kind < BILINEAR:
        raise GeometryError(
            "LSM: interpolation 'nearest' has no gradient, expected one of bilinear, bicubic, six_tap"
        )
    half = odd_window("LSM", settings.window_px) // 2
    a = np.ascontiguousarray(xy_left, dtype=float).reshape(-1, 2)
    b = np.ascontiguousarray(xy_right, dtype=float).reshape(-1, 2)
    k = len(a)
    if len(b) != k:
        raise GeometryError(
            f"LSM: {counted(k, 'point')} in the left photograph, {len(b)} in the right, needed in pairs"
        )
    given = np.broadcast_to(np.eye(2), (k, 2, 2)) if start is None else start
    if given.shape not in ((k, 2, 2), (k, 3, 3)):
        raise GeometryError(f"LSM: start has shape {given.shape}, needed ({k}, 2, 2) or ({k}, 3, 3)")
    if settings.linear and model != "shift":
        raise GeometryError(f"LSM: score of a linear part with model '{model}', needed model 'shift'")
    unknowns = MODELS[model] + RADIOMETRIC + (BLUR if settings.blur else 0) + LINEAR
    if settings.linear and settings.window_px**2 <= unknowns:
        raise GeometryError(
            f"LSM: window of {settings.window_px} px with a linear part, expected more than {unknowns} pixels"
        )
    warp = np.zeros((k, 3, 3))
    warp[:, : given.shape[1], : given.shape[1]] = given
    warp[:, 2, 2] = 1.0
    warp[:, :2] += b[:, :, None] * warp[:, 2, None]
    out, linear = np.zeros((k, OUTPUTS)), np.zeros((k, sum(OF_LINEAR) if settings.linear else 0))
    grey_left, grey_right, blurred = grey_of(left), grey_of(right), BLUR if settings.blur else 0
    limits = Limits(
        float(settings.stop_px),
        int(settings.max_steps),
        float(settings.max_shift_px),
        float(settings.min_correlation),
    )

    def work(part: slice) -> None:
        _match_all(
            grey_left,
            grey_right,
            half,
            kind,
            MODELS[model],
            blurred,
            limits,
            a[part],
            warp[part],
            out[part],
            linear[part],
        )

    if threads > 1:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, (slice(first, first + CHUNK) for first in range(0, k, CHUNK))))
    else:
        work(slice(0, k))
    flag = out[:, FLAG].astype(np.int64)
    out[(flag & ~int(LsmFlag.LOW_CORRELATION)) != 0, X : R + 1] = np.nan
    xy = np.where((flag == 0)[:, None], out[:, [X, Y]], np.nan)
    covariance = out[:, [CXX, CXY, CXY, CYY]].reshape(k, 2, 2)
    covariance[flag != 0] = np.nan
    linear[flag != 0] = np.nan
    steps = out[:, STEPS].astype(np.int64)
    return LsmMatches(
        xy,
        covariance,
        warp,
        out[:, GAIN],
        out[:, OFFSET],
        out[:, R],
        out[:, SIGMA0],
        steps,
        flag,
        _linear_parts(linear, out[:, VARIANCE]) if settings.linear else None,
    )


def _linear_parts(columns: FloatArray, variance: FloatArray) -> LinearParts:
    """Return the columns of the linear parts of k patches with their names."""
    k = len(columns)
    score, derivative, spread, shift = np.split(columns, np.cumsum(OF_LINEAR)[:-1], axis=1)
    square = (k, LINEAR, LINEAR)
    return LinearParts(
        score, derivative.reshape(square), spread.reshape(square), variance, shift.reshape(k, SHIFT, LINEAR)
    )


@compiled
def _match_all(
    left: AnyArray,
    right: AnyArray,
    half: int,
    kind: int,
    geometric: int,
    blurred: int,
    limits: Limits,
    xy: FloatArray,
    warp: FloatArray,
    out: FloatArray,
    linear: FloatArray,
) -> None:
    """Match the patches one by one; `warp` changes from start to solution, `out` and `linear` are filled."""
    work = new_workspace(half, kind, geometric, blurred)
    for i in range(len(xy)):
        out[i, FLAG] = prepare_template(left, xy[i, 0], xy[i, 1], work)
        if out[i, FLAG] == MATCHED:
            out[i, FLAG] = _iterate(right, work, limits, warp[i], out[i])
        if out[i, FLAG] == MATCHED:
            out[i, FLAG] = judge(work, limits.min_correlation, warp[i], out[i])
        if out[i, FLAG] == MATCHED and linear.shape[1] > 0:
            fill_linear_part(work, out[i], linear[i])


@compiled
def _iterate(right: AnyArray, work: Workspace, limits: Limits, H: FloatArray, out: FloatArray) -> int:
    """Improve H by Gauss-Newton steps; return the flag, keep J^T S and the solution in the workspace.

    The steps have the derivatives of the template, with its noise and its blur: alone they would come nearer
    by a constant ratio. How the steps of a shift change says what the derivatives really are.
    """
    half, q, rhs = work.half, work.q, work.rhs
    x0, y0 = H[0, 2], H[1, 2]
    coarse = work.kind > BILINEAR
    secant, shift = np.eye(SHIFT), np.zeros((2, SHIFT))
    previous, following, ratio = np.inf, np.inf, 0.0
    for step in range(1, limits.max_steps + 1):
        out[STEPS] = step
        kind = BILINEAR if coarse else work.kind
        if not resample_patch(right, H, half, kind, work.wx, work.wy, work.patch):
            return OUTSIDE
        for a in range(len(q)):
            rhs[a] = q[a] = dot(work.J[a], work.patch)
        solve_factorised(work.L, q)
        if work.geometric == SHIFT and not coarse:
            length = _put_secant_step(H, q, half, secant, shift, previous < np.inf)
        else:
            length = put_step(H, q, half, work.geometric)
        if not length < np.inf:
            return DIVERGED
        if np.hypot(H[0, 2] - x0, H[1, 2] - y0) > limits.max_shift_px:
            return TOO_FAR
        if not coarse:
            before, ratio = ratio, length / previous
            following = length * max(CONTRACTION, ratio, before)  # a secant may shorten one step by chance
            if following < limits.stop_px:
                return MATCHED
            previous = length
        coarse = coarse and length > COARSE_STEP
    return MATCHED if following < LAST_PX else DIVERGED


@compiled
def _put_secant_step(
    H: FloatArray, q: FloatArray, half: int, secant: FloatArray, shift: FloatArray, follows: bool
) -> float:
    """Apply a shift by Broyden's method, H <- H dH^-1; return it in px, inf if the gain becomes degenerate.

    Args:
        H: warp.
        q: solution of the normal equations, in which the shift is that of Gauss-Newton.
        half: half the side of the window, px.
        secant: shifts to apply per shift of Gauss-Newton, changed, (2, 2).
        shift: last shift of Gauss-Newton, and as applied, changed, (2, 2).
        follows: whether there is a last one.

    Source: Broyden (1965), Mathematics of Computation 19(92), with the first of his updates.
    """
    x, y = q[0] / q[SHIFT + 1], q[1] / q[SHIFT + 1]
    if follows:
        dx, dy = shift[0, 0] - x, shift[0, 1] - y
        sx, sy = shift[1, 0], shift[1, 1]
        mx, my = secant[0, 0] * dx + secant[0, 1] * dy, secant[1, 0] * dx + secant[1, 1] * dy
        tx, ty = sx * secant[0, 0] + sy * secant[1, 0], sx * secant[0, 1] + sy * secant[1, 1]
        along = tx * dx + ty * dy
        if along > MIN_ALONG * (sx * sx + sy * sy):
            rx, ry = (sx - mx) / along, (sy - my) / along
            secant[0, 0] += rx * tx
            secant[0, 1] += rx * ty
            secant[1, 0] += ry * tx
            secant[1, 1] += ry * ty
    shift[0, 0], shift[0, 1] = x, y
    shift[1, 0] = secant[0, 0] * x + secant[0, 1] * y
    shift[1, 1] = secant[1, 0] * x + secant[1, 1] * y
    own_x, own_y = q[0], q[1]
    q[0], q[1] = shift[1, 0] * q[SHIFT + 1], shift[1, 1] * q[SHIFT + 1]
    length = put_step(H, q, half, SHIFT)
    q[0], q[1] = own_x, own_y
    return length


@compiled
def judge(work: Workspace, min_r: float, H: FloatArray, out: FloatArray) -> int:
    """Compute the covariance of the shift, radiometry and correlation of the last step; return the flag.

    A resampled intensity has the noise of a pixel times the sum of the squared weights, and neighbours share
    noise. For texture that passes the kernel, this is as harmful as the noise of the pixels themselves. It is
    more harmful if the right patch is smaller, so that its pixels are used more than once.
    """
    half, geometric, N, q, rhs, patch = work.half, work.geometric, work.N, work.q, work.rhs, work.patch
    n = len(patch)
    alpha, beta = q[geometric], q[geometric + 1]
    square, total, cross = dot(patch, patch), rhs[geometric], rhs[geometric + 1]
    T, TT = N[geometric, geometric + 1], N[geometric + 1, geometric + 1]
    spread = (square - total * total / n) * (TT - T * T / n)
    r = (cross - total * T / n) / np.sqrt(spread) if spread > 0.0 else 0.0
    subtract(patch, q, work.J)
    residual = dot(patch, patch)
    gain = kernel_noise(H, half, work.kind, work.wx, work.wy)
    if work.blurred:
        residual = residual_as_sharp(work, square)
    variance = residual / (n - len(q)) / (1.0 + gain)  # of one intensity, right units
    white = min(variance, white_noise(patch, 2 * half + 1) / (1.0 + gain))
    out[X], out[Y] = H[0, 2], H[1, 2]
    out[GAIN], out[OFFSET], out[R], out[SIGMA0] = beta, alpha, r, np.sqrt(residual / (n - len(q)))
    variance *= 1.0 + max(1.0, 1.0 / area_ratio(H))  # of the difference of two, as it affects texture
    out[VARIANCE], out[WHITE] = variance / (beta * beta), white / (beta * beta)
    variance *= (half / beta) ** 2
    # The solution obeys J'^T (S - ...) = 0 with noisy J': its covariance is (J'^T J)^-1 J'^T J' (J^T J')^-1,
    # where J'^T J' = N, and J'^T J is N minus the contribution of noise.
    least = 1.0 + TEXTURE_SIGMAS * np.sqrt(ENERGY_VARIANCE / n)
    clean = without_noise(N, least * out[WHITE], half, geometric)
    flat = not factorise(clean, clean, 0.0)
    clean = N.copy() if flat else without_noise(N, out[WHITE], half, geometric)
    factorise(clean, clean, 0.0)
    column, middle = np.empty(len(q)), np.empty(len(q))
    for k in range(2):
        column[:] = 0.0
        column[k] = 1.0
        solve_factorised(clean, column)
        for i in range(len(q)):
            middle[i] = 0.0
            for j in range(len(q)):
                middle[i] += N[i, j] * column[j]
        solve_factorised(clean, middle)
        if k == 0:
            cxx = middle[0]
        cxy, cyy = middle[0], middle[1]
    for k in range(3):
        i, j = k // 2, (k + 1) // 2
        ix, iy = H[i, 0] - H[i, 2] * H[2, 0], H[i, 1] - H[i, 2] * H[2, 1]
        jx, jy = H[j, 0] - H[j, 2] * H[2, 0], H[j, 1] - H[j, 2] * H[2, 1]
        out[CXX + k] = variance * (ix * (cxx * jx + cxy * jy) + iy * (cxy * jx + cyy * jy))
    if flat:
        return FLAT_TEXTURE
    return LOW_CORRELATION if r < min_r else MATCHED


@compiled
def fill_linear_part(work: Workspace, out: FloatArray, linear: FloatArray) -> None:
    """Fill the columns of the linear part of a warp at the solution of its shift.

    The residuals obey J'^T v = 0 with the noisy gradients J' of what was estimated. A linear part d that was
    not estimated moves this solution by -(J'^T J)^-1 J'^T J_d d.
    """
    half, N, J, v = work.half, work.N, work.J, work.patch  # which holds residuals
    side, u = 2 * half + 1, len(work.q)
    rows = np.empty((LINEAR, side * side), np.float32)
    for i in range(side):
        y = np.float32((i - half) / half)
        for j in range(side):
            p = i * side + j
            x = np.float32((j - half) / half)
            rows[0, p], rows[1, p] = J[0, p] * x, J[0, p] * y
            rows[2, p], rows[3, p] = J[1, p] * x, J[1, p] * y
    clean = without_noise(N, out[WHITE], half, SHIFT)
    factorise(clean, clean, 0.0)
    cross, solved, weighted = np.empty((LINEAR, u)), np.empty((LINEAR, u)), np.zeros((LINEAR, u))
    products = np.empty((LINEAR, LINEAR))
    for a in range(LINEAR):
        for k in range(u):
            cross[a, k] = solved[a, k] = dot(rows[a], J[k])
        solve_factorised(clean, solved[a])
        for k in range(u):
            for m in range(u):
                weighted[a, k] += N[k, m] * solved[a, m]
    derivative, spread = LINEAR, LINEAR + LINEAR * LINEAR
    shift = spread + LINEAR * LINEAR
    noise = side * side * out[WHITE] * SLOPE_NOISE * half * half * mean_square(half)
    for a in range(LINEAR):
        linear[a] = -dot(rows[a], v) / out[GAIN]
        for b in range(a + 1):
            whole = products[a, b] = products[b, a] = dot(rows[a], rows[b])
            expected = whole - noise if a == b else whole
            for k in range(u):
                expected -= cross[a, k] * solved[b, k]
                whole += (weighted[a, k] - cross[a, k]) * solved[b, k] - solved[a, k] * cross[b, k]
            linear[derivative + LINEAR * a + b] = linear[derivative + LINEAR * b + a] = expected
            linear[spread + LINEAR * a + b] = linear[spread + LINEAR * b + a] = whole
        for k in range(SHIFT):
            linear[shift + LINEAR * k + a] = -half * solved[a, k]
    out[VARIANCE] *= noise_left(N, cross, products, linear[:LINEAR] * out[GAIN], dot(v, v), side * side)


@compiled
def noise_left(
    N: FloatArray, cross: FloatArray, products: FloatArray, score: FloatArray, square: float, n: int
) -> float:
    """Return the variance of intensities with the linear part estimated, over that without it.

    What a wrong plane adds to the residuals does not count as noise then.

    Args:
        N: normal matrix of what was estimated, (u, u).
        cross: its products with the rows of the linear part, (4, u).
        products: products of these rows, (4, 4); changed.
        score: of the linear part, (4,).
        square: sum of squared residuals.
        n: number of intensities.
    """
    u = len(N)
    factor, solved = np.empty((u, u)), np.empty(u)
    factorise(N, factor, 0.0)
    for a in range(LINEAR):
        solved[:] = cross[a]
        solve_factorised(factor, solved)
        for b in range(LINEAR):
            for k in range(u):
                products[a, b] -= solved[k] * cross[b, k]
    step = score.copy()
    if not (square > 0.0 and factorise(products, products, 0.0)):
        return 1.0
    solve_factorised(products, step)
    left = square
    for a in range(LINEAR):
        left -= step[a] * score[a]
    return max(left / square, 0.0) * (n - u) / (n - u - LINEAR)


@compiled
def mean_square(half: int) -> float:
    """Return the mean square of the coordinates of a window along one axis, in half windows."""
    return (half + 1.0) / (3.0 * half)


@compiled
def without_noise(N: FloatArray, white: float, half: int, geometric: int) -> FloatArray:
    """Return a normal matrix without the mean contribution of white noise in the template.

    Args:
        N: normal matrix of `patch_equations.gradients`, (u, u).
        white: variance of the noise of an intensity of the template.
        half: half the side of the window, px.
        geometric: number of geometric parameters.
    """
    clean = N.copy()
    n = (2 * half + 1) ** 2
    noise = n * white * SLOPE_NOISE * half * half  # of gradients along x and y, which share no noise
    second = mean_square(half)
    fourth = second * (3.0 * half * half + 3.0 * half - 1.0) / (5.0 * half * half)
    for a in range(geometric):
        if a < SHIFT:
            clean[a, a] -= noise
        elif a < 6:
            clean[a, a] -= noise * second
        else:
            clean[a, a] -= noise * (fourth + second * second)
            clean[a, a - 6] += noise * second
            clean[a - 6, a] += noise * second
    clean[geometric + 1, geometric + 1] -= n * white
    first = geometric + RADIOMETRIC
    if len(N) > first:
        same, other, mixed, intensity = BLUR_NOISE
        clean[first + 1, first + 1] -= n * white * mixed
        for a, b in ((first, first + 2), (first + 2, first)):
            clean[a, a] -= n * white * same
            clean[a, b] -= n * white * other
            clean[a, geometric + 1] -= n * white * intensity
            clean[geometric + 1, a] -= n * white * intensity
    return clean


@compiled
def residual_as_sharp(work: Workspace, square: float) -> float:
    """Return the sum of squared residuals of a fit without blur.

    A blur that makes the template less noisy fits better than the true one, so its residuals are too small.

    Args:
        work: normal equations with blur in the last rows.
        square: sum of squared intensities of the patch.
    """
    size = work.geometric + RADIOMETRIC
    factor = np.empty((size, size))
    q = work.rhs[:size].copy()
    factorise(work.N[:size, :size], factor, 0.0)
    solve_factorised(factor, q)
    for a in range(size):
        square -= q[a] * work.rhs[a]
    return max(square, 0.0)  # negative only by rounding


@compiled_fast
def subtract(patch: AnyArray, q: FloatArray, J: AnyArray) -> None:
    """Replace the patch by its residuals."""
    for a in range(len(q)):
        factor, row = np.float32(q[a]), J[a]
        for p in range(len(patch)):
            patch[p] -= factor * row[p]


@compiled_fast
def white_noise(residual: AnyArray, side: int) -> float:
    """Return the variance of the part of the residuals that is independent from pixel to pixel.

    Source: Immerkaer (1996), CVIU 64(2): the mask (1 -2 1)^T (1 -2 1), whose squares add up to 36.
    """
    total = 0.0
    for i in range(1, side - 1):
        for j in range(1, side - 1):
            p = i * side + j
            up = residual[p - side - 1] - 2 * residual[p - side] + residual[p - side + 1]
            mid = residual[p - 1] - 2 * residual[p] + residual[p + 1]
            low = residual[p + side - 1] - 2 * residual[p + side] + residual[p + side + 1]
            d = up - 2 * mid + low
            total += d * d
    return total / (36.0 * (side - 2) ** 2)


@compiled
def kernel_noise(H: FloatArray, half: int, kind: int, wx: AnyArray, wy: AnyArray) -> float:
    """Return the mean sum of squared weights over the window: the variance factor of resampled noise."""
    stride = max(1, half // 2)  # 25 positions give the mean
    total, count = 0.0, 0
    for b in range(-half, half + 1, stride):
        for a in range(-half, half + 1, stride):
            w = H[2, 0] * a + H[2, 1] * b + H[2, 2]
            x = (H[0, 0] * a + H[0, 1] * b + H[0, 2]) / w
            y = (H[1, 0] * a + H[1, 1] * b + H[1, 2]) / w
            kernel_weights(kind, np.float32(x - np.floor(x)), wx)
            kernel_weights(kind, np.float32(y - np.floor(y)), wy)
            along, down = 0.0, 0.0
            for k in range(TAPS):
                along += wx[k] * wx[k]
                down += wy[k] * wy[k]
            total += along * down
            count += 1
    return total / count
