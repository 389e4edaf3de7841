"""Least squares matching: where the patch of one photograph is in another, to a hundredth of a pixel.

The patch T around a point of the left photograph and the right photograph S are tied by

    S(H x) = alpha + beta T(x) + noise

with x in the window, a geometric model H (shift, affine or projective) and the two radiometric parameters.
Gauss-Newton is written the inverse way: the change dH of a step is applied to the template, whose gradients
and normal equations then stay the same from step to step, and is put on H as H <- H dH^-1. The right
photograph is resampled in every step, the gradients are symmetric differences of the resampled template.
At convergence it is the least squares solution of the forward equations, up to the noise of the gradients.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.kernels.compiling import compiled
from sfm.kernels.sampling import BILINEAR, interpolation_index
from sfm.kernels.small_algebra import solve_factorised
from sfm.matching.lsm.patch_equations import (
    BLUR,
    MODELS,
    Workspace,
    dot,
    new_workspace,
    prepare_template,
    put_step,
    resample_patch,
)
from sfm.matching.lsm.patch_precision import (
    CXX,
    CXY,
    CYY,
    FLAG,
    GAIN,
    OFFSET,
    OUTPUTS,
    SIGMA0,
    STEPS,
    R,
    X,
    Y,
    judge,
)
from sfm.matching.match_flags import DIVERGED, MATCHED, OUTSIDE, TOO_FAR, LsmFlag
from sfm.matching.radiometry import Grey, grey_of, odd_window

COARSE_STEP = 0.5  # bilinear interpolation is good enough while steps are longer than this, px
CONTRACTION = 0.04  # a step is at most this part of the one before; 0.01 to 0.03 on texture with noise
LAST_PX = 0.002  # the next step after the last one that is allowed, of a match; along edges it hardly shrinks
CHUNK = 256  # patches that a thread takes at a time


class Limits(NamedTuple):
    """When the steps of a patch end, and which results are believed."""

    stop_px: float  # the shift of the step that would come next is shorter
    max_steps: int
    max_shift_px: float  # from the start
    min_correlation: float


@dataclass(frozen=True)
class LsmMatches:
    """Positions in the right photograph found by least squares matching; NaN with the reason in the flag."""

    xy: FloatArray  # place of the left point in the right photograph, px, (k, 2)
    covariance: FloatArray  # of xy, px^2, (k, 2, 2)
    warp: FloatArray  # H: right px from left px relative to the left point, homogeneous, (k, 3, 3)
    gain: FloatArray  # beta: right intensities per left one, (k,)
    offset: FloatArray  # alpha, right intensity units, (k,)
    correlation: FloatArray  # r of template and resampled patch, (k,)
    sigma0: FloatArray  # standard deviation of an intensity difference, right units, (k,)
    steps: IntArray  # Gauss-Newton steps, (k,)
    flag: IntArray  # see LsmFlag, 0 = matched, (k,)

    def __len__(self) -> int:
        return len(self.xy)

    @property
    def good(self) -> BoolArray:
        """Which points were matched, (k,)."""
        return np.asarray(self.flag == 0)


@checked_arguments(xy_left="k 2", xy_right="n 2")
def match_lsm(
    left: AnyArray | Grey,
    right: AnyArray | Grey,
    xy_left: FloatArray,
    xy_right: FloatArray,
    *,
    model: str = "affine",
    window_px: int = 21,
    interpolation: str = "six_tap",
    stop_px: float = 0.0002,
    max_steps: int = 30,
    max_shift_px: float = 5.0,
    min_correlation: float = 0.5,
    blur: bool = False,
    start: FloatArray | None = None,
    threads: int = 1,
) -> LsmMatches:
    """Match points of the left photograph in the right one, from places known to a pixel or two.

    Args:
        left: photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: the other photograph.
        xy_left: points in the left photograph, px, any fraction, (k, 2).
        xy_right: where they are in the right photograph, approximately, px, (k, 2).
        model: shift (2), affine (6) or projective (8 parameters), each with gain and offset.
        window_px: odd side of the template.
        interpolation: kernel for the right photograph; on fine texture bilinear costs 1.25 times and bicubic
            1.06 times the standard deviation of six_tap, and both are off by up to 0.013 px where all of the
            patch is shifted by the same 0.1 to 0.4 px, six_tap by 0.002 px.
        stop_px: the shift of the step that would come next is shorter than this. The remaining shift has the
            direction of the start, which neighbouring points have in common: 0.002 px turn photographs.
        max_steps: after so many a patch counts as diverged.
        max_shift_px: farther from the start is too far.
        min_correlation: below it the places are not alike.
        blur: whether three more unknowns describe how differently both are blurred. Of an oblique surface
            they always are, since a pixel is longer on it: without them windows move by 0.01 px, in all
            matches of a template alike.
        start: linear part of the warp, right px per left px, (k, 2, 2), or its homography relative to both
            points, (k, 3, 3), whose perspective an affine model leaves as it is; the unit matrix if none.
        threads: patches are shared among so many.

    Returns:
        One match for each point; the covariance assumes the same noise in both photographs, after the gain.

    Raises:
        GeometryError: an unknown model or kernel, an even window, or points that do not go in pairs.

    Source: Gruen (1985), S. Afr. J. Photogrammetry 14(3), and Foerstner (1993) in Haralick and Shapiro,
    Computer and Robot Vision II, ch. 16; the inverse way is Baker and Matthews (2004), IJCV 56(3).
    """
    if model not in MODELS:
        raise GeometryError(f"LSM: model '{model}', expected one of {', '.join(MODELS)}")
    kind = interpolation_index(interpolation)
    if kind < BILINEAR:
        raise GeometryError(
            "LSM: interpolation 'nearest' has no gradient, expected one of bilinear, bicubic, six_tap"
        )
    half = odd_window("LSM", window_px) // 2
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
    warp = np.zeros((k, 3, 3))
    warp[:, : given.shape[1], : given.shape[1]] = given
    warp[:, 2, 2] = 1.0
    warp[:, :2] += b[:, :, None] * warp[:, 2, None]
    out = np.zeros((k, OUTPUTS))
    fixed = (grey_of(left), grey_of(right), half, kind, MODELS[model], BLUR if blur else 0)
    limits = Limits(float(stop_px), int(max_steps), float(max_shift_px), float(min_correlation))

    def work(part: slice) -> None:
        _match_all(*fixed, limits, a[part], warp[part], out[part])

    if threads > 1:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, _chunks(k)))
    else:
        work(slice(0, k))
    flag = out[:, FLAG].astype(np.int64)
    out[(flag & ~int(LsmFlag.LOW_CORRELATION)) != 0, X : R + 1] = np.nan
    xy = np.where((flag == 0)[:, None], out[:, [X, Y]], np.nan)
    covariance = out[:, [CXX, CXY, CXY, CYY]].reshape(k, 2, 2)
    covariance[flag != 0] = np.nan
    steps = out[:, STEPS].astype(np.int64)
    return LsmMatches(
        xy, covariance, warp, out[:, GAIN], out[:, OFFSET], out[:, R], out[:, SIGMA0], steps, flag
    )


def _chunks(k: int) -> Iterator[slice]:
    return (slice(first, first + CHUNK) for first in range(0, k, CHUNK))


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
) -> None:
    """Match patch after patch; `warp` goes from start to solution, `out` receives the columns."""
    work = new_workspace(half, kind, geometric, blurred)
    for i in range(len(xy)):
        out[i, FLAG] = prepare_template(left, xy[i, 0], xy[i, 1], work)
        if out[i, FLAG] == MATCHED:
            out[i, FLAG] = _iterate(right, work, limits, warp[i], out[i])
        if out[i, FLAG] == MATCHED:
            out[i, FLAG] = judge(work, limits.min_correlation, warp[i], out[i])


@compiled
def _iterate(right: AnyArray, work: Workspace, limits: Limits, H: FloatArray, out: FloatArray) -> int:
    """Improve H by Gauss-Newton steps; return the flag, leave J^T S and the solution in the workspace."""
    half, q, rhs = work.half, work.q, work.rhs
    x0, y0 = H[0, 2], H[1, 2]
    coarse = work.kind > BILINEAR
    previous, following = np.inf, np.inf
    for step in range(1, limits.max_steps + 1):
        out[STEPS] = step
        kind = BILINEAR if coarse else work.kind
        if not resample_patch(right, H, half, kind, work.wx, work.wy, work.patch):
            return OUTSIDE
        for a in range(len(q)):
            rhs[a] = q[a] = dot(work.J[a], work.patch)
        solve_factorised(work.L, q)
        length = put_step(H, q, half, work.geometric)
        if not length < np.inf:
            return DIVERGED
        if np.hypot(H[0, 2] - x0, H[1, 2] - y0) > limits.max_shift_px:
            return TOO_FAR
        if not coarse:
            following = length * max(CONTRACTION, length / previous)
            if following < limits.stop_px:
                return MATCHED
            previous = length
        coarse = coarse and length > COARSE_STEP
    return MATCHED if following < LAST_PX else DIVERGED
