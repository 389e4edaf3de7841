"""Conjugate points: from points of one photograph to the same points in another, and how well.

Correlation finds the place to a pixel in a search window, least squares matching takes it from there. With
`equalise` the histograms of both photographs are equalised in between, which is the order of document 002;
it helps the eye more than the matching, which has a gain and an offset of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.kernels.sampling import AFTER, BEFORE
from sfm.matching.correlation.ambiguity import ambiguous, independent_pixels
from sfm.matching.correlation.ncc import match_ncc
from sfm.matching.lsm.patch_equations import MARGIN
from sfm.matching.lsm.two_photo import match_lsm
from sfm.matching.match_flags import LsmFlag, NccFlag, in_words
from sfm.matching.radiometry import equalise_histogram, grey_of

METHODS = {"ncc": "", "lsm": "affine", "lsm8": "projective", "shift": "shift"}
MIN_CORRELATION = 0.7  # half of the variance of one patch is then explained by the other
BACK_PX = 1.0  # a point that leads back farther than this from where it came is another one
START_CORRELATION = 0.5  # smallest r of a start, which the warp has yet to make alike


@dataclass(frozen=True)
class ConjugatePoints:
    """Points of the left photograph and where they are in the right one; NaN where the reason says why."""

    method: str  # ncc | lsm | lsm8 | shift
    left: FloatArray  # px, (k, 2)
    right: FloatArray  # px, (k, 2)
    covariance: FloatArray  # of `right`, px^2, (k, 2, 2)
    warp: FloatArray  # right px from left px relative to the left point, homogeneous, (k, 3, 3)
    correlation: FloatArray  # r of the template and the matched patch, (k,)
    second: FloatArray  # r of the second-best place of the search window, (k,)
    gain: FloatArray  # right intensities per left one, (k,)
    offset: FloatArray  # right intensity units, (k,)
    steps: IntArray  # Gauss-Newton steps, 0 for correlation, (k,)
    reason: tuple[str, ...]  # empty where matched, else flags in words, (k,)

    def __len__(self) -> int:
        return len(self.left)

    @property
    def good(self) -> BoolArray:
        """Which points were matched, (k,)."""
        return np.array([not reason for reason in self.reason], dtype=bool)

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the right coordinates, px, (k, 2)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)))


def match_points(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    *,
    xy_right: FloatArray | None = None,
    method: str = "lsm",
    template_px: int = 21,
    search_px: int = 121,
    equalise: bool = False,
    interpolation: str = "six_tap",
    min_correlation: float = MIN_CORRELATION,
    back_px: float | None = BACK_PX,
) -> ConjugatePoints:
    """Find points of the left photograph in the right one.

    Args:
        left: photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: the other photograph.
        xy_left: points in the left photograph, px, (k, 2).
        xy_right: centres of the search windows, px, (k, 2); the same places as in the left if not given.
        method: ncc, or ncc and then shift (2), lsm (6) or lsm8 (8 geometric parameters).
        template_px: odd side of the template; document 002 has 19.
        search_px: odd side of the search window; document 002 has 21.
        equalise: equalise the histograms of both photographs before least squares matching.
        interpolation: six_tap, bicubic or bilinear; see `sfm.matching.lsm.two_photo.match_lsm`.
        min_correlation: smallest r of a match. Least squares matching is started from 0.5 on, as the warp
            makes patches more alike.
        back_px: a point must lead back to within this of where it came from, px; None: it need not.

    Returns:
        One result for each point.

    Raises:
        GeometryError: unknown method, even windows, or points that do not go in pairs.

    Source: document 002, sec. 2 (equations 2.1 to 2.20).
    """
    if method not in METHODS:
        raise GeometryError(f"matching: method '{method}', expected one of {', '.join(METHODS)}")
    a = np.asarray(xy_left, dtype=float).reshape(-1, 2)
    b = a if xy_right is None else np.asarray(xy_right, dtype=float).reshape(-1, 2)
    least = min_correlation if method == "ncc" else min(min_correlation, START_CORRELATION)
    found = match_ncc(left, right, a, b, template_px=template_px, search_px=search_px, min_correlation=least)
    # A peak at the border of the search window is a start like any other: least squares may walk out of it.
    started = found.good | (found.flag == int(NccFlag.AT_BORDER))
    pixels = independent_pixels(grey_of(left), a, template_px)
    doubt = started & ambiguous(found.correlation, found.second, pixels)
    flag = np.where(doubt, int(NccFlag.AMBIGUOUS), found.flag)
    outside = _what_is_outside(left, a, template_px // 2)
    ncc_reason = tuple(
        where or "outside: the search window in the right photograph"
        if one == int(NccFlag.OUTSIDE)
        else in_words(NccFlag, one)
        for one, where in zip(flag.tolist(), outside, strict=True)
    )
    if method == "ncc":
        warp = np.tile(np.eye(3), (len(a), 1, 1))
        warp[:, :2, 2] = found.xy
        matched = ConjugatePoints(
            method, a, found.xy, found.covariance, warp, found.correlation,
            found.second, found.gain, found.offset, np.zeros(len(a), dtype=np.int64), ncc_reason,
        )  # fmt: skip
    else:
        started &= ~doubt
        seen = (equalise_histogram(left), equalise_histogram(right)) if equalise else (left, right)
        start = np.where(started[:, None], np.where(found.good[:, None], found.xy, found.peak), -1.0)
        lsm = match_lsm(
            *seen,
            a,
            start,
            model=METHODS[method],
            window_px=template_px,
            interpolation=interpolation,
            min_correlation=min_correlation,
        )
        outside = _what_is_outside(left, a, template_px // 2, kernel=True)
        lsm_reason = tuple(
            where or "outside: the patch in the right photograph"
            if one == int(LsmFlag.OUTSIDE)
            else in_words(LsmFlag, one)
            for one, where in zip(lsm.flag.tolist(), outside, strict=True)
        )
        reason = tuple(
            one if ok else ncc for ok, one, ncc in zip(started, lsm_reason, ncc_reason, strict=True)
        )
        correlation = np.where(started & np.isfinite(lsm.correlation), lsm.correlation, found.correlation)
        matched = ConjugatePoints(
            method, a, lsm.xy, lsm.covariance, lsm.warp, correlation, found.second, lsm.gain, lsm.offset,
            np.where(started, lsm.steps, 0), reason,
        )  # fmt: skip
    if back_px is not None and matched.good.any():
        good = np.flatnonzero(matched.good)
        back = match_points(
            right,
            left,
            matched.right[good],
            xy_right=a[good],
            method=method,
            template_px=template_px,
            search_px=search_px,
            equalise=equalise,
            interpolation=interpolation,
            min_correlation=min_correlation,
            back_px=None,
        )
        lost = good[~(np.linalg.norm(back.right - a[good], axis=1) <= back_px)]
        why = np.array(matched.reason, dtype=object)
        why[lost] = in_words(NccFlag, NccFlag.NOT_CONFIRMED)
        matched = replace(matched, reason=tuple(why.tolist()))
    bad = ~matched.good
    return replace(
        matched,
        right=np.where(bad[:, None], np.nan, matched.right),
        covariance=np.where(bad[:, None, None], np.nan, matched.covariance),
    )


def _what_is_outside(
    photograph: AnyArray, xy: FloatArray, half: int, *, kernel: bool = False
) -> tuple[str, ...]:
    """Return in words what of the left points is outside their photograph, empty where nothing is.

    Args:
        photograph: the left photograph.
        xy: the points, px, (k, 2).
        half: half the side of the template, px.
        kernel: whether the margin counts that least squares matching needs around the template.
    """
    size = np.array(photograph.shape[1::-1])
    reach = half + MARGIN if kernel else half
    at = np.floor(xy) if kernel else np.rint(xy)
    resampled = (xy != at).any(axis=1, keepdims=True) & kernel
    before, after = BEFORE * resampled, AFTER * resampled
    off = np.asarray(~((xy >= 0) & (xy <= size - 1)).all(axis=1))
    cut = np.asarray(((at - reach - before < 0) | (at + reach + after > size - 1)).any(axis=1))
    what = "the template with the margin of its kernel" if kernel else "the template"
    return tuple(
        "outside: the point in the left photograph"
        if o
        else (f"outside: {what} in the left photograph" if c else "")
        for o, c in zip(off.tolist(), cut.tolist(), strict=True)
    )
