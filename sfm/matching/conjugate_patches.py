"""Match points in two photographs from approximate positions: correlation, then least squares matching.

Correlation finds the position to one pixel, and least squares matching refines it. With `equalise` the
histograms of both photographs are equalised between the two steps, which is the order in document 002. This
helps the eye more than the matching, which estimates gain and offset itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from sfm.matching.correlation import (
    MIN_CORRELATION,
    START_CORRELATION,
    LsmFlag,
    NccFlag,
    NccLimits,
    NccMatches,
    ambiguous,
    independent_pixels,
    match_ncc,
    match_ncc_warped,
)
from sfm.matching.lsm.patch_equations import MARGIN, linear_part
from sfm.matching.lsm.surface_planes import MAX_SQUARED_RATIO, match_where_plane, squares_over_covariance
from sfm.matching.lsm.two_photo import LsmSettings, match_lsm
from sfm.matching.radiometry import equalise_histogram, grey_of
from sfm.model.arguments import checked_fields
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.display import in_words
from sfm.runtime.sampling import AFTER, BEFORE

METHODS = {"ncc": "", "lsm": "affine", "lsm8": "projective", "shift": "shift"}
BACK_PX = 1.0  # a match whose way back ends farther than this from its start is another point
MAX_BIAS_PX = 1.0  # of a match whose surface is curved
NOT_PLANE = "surface not plane over the template"


@dataclass(frozen=True)
class ConjugatePoints:
    """Points of the left photograph and their positions in the right one; NaN where a reason is given."""

    method: str  # ncc | lsm | lsm8 | shift
    left: FloatArray  # px, (k, 2)
    right: FloatArray  # px, (k, 2)
    covariance: FloatArray  # of `right`, px^2, (k, 2, 2)
    warp: FloatArray  # right px from left px relative to the left point, homogeneous, (k, 3, 3)
    correlation: FloatArray  # r of the template and the matched patch, (k,)
    second: FloatArray  # r of the second-best position in the search window, (k,)
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

    def rows(self, rows: BoolArray) -> ConjugatePoints:
        """Return only the points where `rows` is True, (k,)."""
        return self._changed(lambda column: column[rows])

    def with_rows(self, rows: IntArray, others: ConjugatePoints) -> ConjugatePoints:
        """Return the points with the given rows replaced by those of `others`, in order."""

        def put(column: AnyArray, new: AnyArray) -> AnyArray:
            column[rows] = new
            return column

        return self._changed(put, others)

    def _changed(self, change: Callable[..., AnyArray], *others: ConjugatePoints) -> ConjugatePoints:
        """Return the points with each column changed by a function of its copy and of the others' columns."""
        columns: dict[str, Any] = {"method": self.method}
        for field in fields(self):
            parts = [getattr(points, field.name) for points in (self, *others)]
            if field.name == "reason":
                words = [np.array(column, dtype=object) for column in parts]
                columns["reason"] = tuple(change(*words).tolist())
            elif field.name != "method":
                columns[field.name] = change(parts[0].copy(), *parts[1:])
        return ConjugatePoints(**columns)


@checked_fields
@dataclass(frozen=True)
class MatchSettings:
    """Settings of `sfm.matching.conjugate.match_points`."""

    method: str = "lsm"  # ncc, or ncc and then shift (2), lsm (6) or lsm8 (8 geometric parameters)
    template_px: int = 21  # odd side of the template; document 002 uses 19
    search_px: int = 121  # odd side of the search window; document 002 uses 21
    equalise: bool = False  # equalise the histograms of both photographs before least squares matching
    interpolation: str = "six_tap"  # or bicubic or bilinear; see `sfm.matching.lsm.two_photo.LsmSettings`
    min_correlation: float = MIN_CORRELATION
    """smallest r of a match. Least squares matching starts from r = 0.5 or more, since the warp makes the
    patches more similar."""
    back_px: float | None = BACK_PX
    """matching back must end within this distance of the start, px; None: no matching back"""
    wide: bool = True
    """search again for points that are not found. Without it the photographs must be rotated by less than 5
    degrees and have the same scale within 10 %."""

    @property
    def reach_px(self) -> int:
        """Distance that the template moves in the search window along rows and columns, px."""
        return (self.search_px - self.template_px) // 2

    @property
    def start_correlation(self) -> float:
        """Smallest r of a match, or of a start for least squares matching."""
        if self.method == "ncc":
            return self.min_correlation
        return min(self.min_correlation, START_CORRELATION)


@dataclass(frozen=True)
class Starts:
    """Predicted positions of points in the right photograph, and their shape there."""

    xy: FloatArray  # px, NaN where unknown, (k, 2)
    linear: FloatArray  # right px per left px, (k, 2, 2)
    reach_px: IntArray  # largest distance from the prediction along a row and a column, left px, (k,)


def match_upright(
    left: AnyArray, right: AnyArray, xy_left: FloatArray, xy_right: FloatArray, by: MatchSettings
) -> ConjugatePoints:
    """Match points, px, (k, 2), whose templates are neither rotated nor scaled on the right."""
    correlated = match_ncc(
        left,
        right,
        xy_left,
        xy_right,
        template_px=by.template_px,
        search_px=by.search_px,
        limits=NccLimits(by.start_correlation),
    )
    return _refined(left, right, xy_left, correlated, np.tile(np.eye(2), (len(xy_left), 1, 1)), by)


def match_warped(
    left: AnyArray, right: AnyArray, xy_left: FloatArray, start: Starts, by: MatchSettings
) -> ConjugatePoints:
    """Match points, px, (k, 2), whose templates are rotated, scaled and sheared in the right photograph."""
    correlated = match_ncc_warped(
        left,
        right,
        xy_left,
        start.xy,
        start.linear,
        reach_px=start.reach_px,
        template_px=by.template_px,
        limits=NccLimits(by.start_correlation),
    )
    return _refined(left, right, xy_left, correlated, start.linear, by)


def flag_unconfirmed(
    left: AnyArray,
    right: AnyArray,
    matched: ConjugatePoints,
    by: MatchSettings,
    reach_px: IntArray | None = None,
) -> ConjugatePoints:
    """Return the matches, with a flag on those that do not lead back to within `back_px`.

    If an unflagged match leads back to a position that differs by more than noise, the difference is added to
    its covariance. Where one photograph sees a surface obliquely, the windows of the other show less of the
    surface.

    Args:
        left: the left photograph.
        right: the right photograph.
        matched: points of the left photograph found in the right one.
        by: matching settings.
        reach_px: how far from the left point the way back may end, left px, (k,). The template is then warped
            with the inverse of the warp found. By default templates are upright and use the whole search
            window.
    """
    good = np.flatnonzero(matched.good)
    if by.back_px is None or not len(good):
        return matched
    target = matched.left[good]
    if reach_px is None:
        back = match_upright(right, left, matched.right[good], target, by)
    else:
        linear = linear_part(matched.warp[good])
        there = np.linalg.norm(linear, axis=(1, 2)) / np.sqrt(2)
        reach = np.maximum(np.ceil(reach_px[good] * there), 1).astype(np.int64)
        back = match_warped(
            right,
            left,
            matched.right[good],
            Starts(target, np.asarray(np.linalg.inv(linear), dtype=float), reach),
            by,
        )
    off = back.right - target
    lost = good[~(np.linalg.norm(off, axis=1) <= by.back_px)]
    d, C = np.einsum("kij,kj->ki", linear_part(matched.warp[good]), off), matched.covariance[good]
    real = squares_over_covariance(d, C) > MAX_SQUARED_RATIO  # False for NaN
    covariance = matched.covariance.copy()
    covariance[good[real]] += d[real, :, None] * d[real, None, :]
    why = np.array(matched.reason, dtype=object)
    why[lost] = in_words(NccFlag, NccFlag.NOT_CONFIRMED)
    return replace(matched, covariance=covariance, reason=tuple(why.tolist()))


def _refined(
    left: AnyArray,
    right: AnyArray,
    a: FloatArray,
    correlated: NccMatches,
    linear: FloatArray,
    by: MatchSettings,
) -> ConjugatePoints:
    """Return the positions found by correlation, or refine them by least squares matching."""
    # A peak at the border of the search window is a valid start: least squares matching may leave the window.
    started = correlated.good | (correlated.flag == int(NccFlag.AT_BORDER))
    pixels = independent_pixels(grey_of(left), a, by.template_px)
    doubt = started & ambiguous(correlated.correlation, correlated.second, pixels)
    flag = np.where(doubt, int(NccFlag.AMBIGUOUS), correlated.flag)
    outside = _what_is_outside(left, a, by.template_px // 2)
    ncc_reason = tuple(
        where or "outside: the search window in the right photograph"
        if bits == int(NccFlag.OUTSIDE)
        else in_words(NccFlag, bits)
        for bits, where in zip(flag.tolist(), outside, strict=True)
    )
    if by.method == "ncc":
        warp = np.tile(np.eye(3), (len(a), 1, 1))
        warp[:, :2, :2], warp[:, :2, 2] = linear, correlated.xy
        return ConjugatePoints(
            by.method, a, correlated.xy, correlated.covariance, warp, correlated.correlation,
            correlated.second, correlated.gain, correlated.offset, np.zeros(len(a), dtype=np.int64),
            ncc_reason,
        )  # fmt: skip
    started &= ~doubt
    seen = (equalise_histogram(left), equalise_histogram(right)) if by.equalise else (left, right)
    start = np.where(
        started[:, None], np.where(correlated.good[:, None], correlated.xy, correlated.peak), -1.0
    )
    settings = LsmSettings(
        model=METHODS[by.method],
        window_px=by.template_px,
        interpolation=by.interpolation,
        min_correlation=by.min_correlation,
    )
    lsm = match_lsm(
        *seen,
        a,
        start,
        settings,
        start=np.where(started[:, None, None], linear, np.eye(2)),
    )
    outside = _what_is_outside(left, a, by.template_px // 2, kernel=True)
    lsm_reason = tuple(
        where or "outside: the patch in the right photograph"
        if bits == int(LsmFlag.OUTSIDE)
        else in_words(LsmFlag, bits)
        for bits, where in zip(lsm.flag.tolist(), outside, strict=True)
    )
    bias = np.zeros((len(a), 2))
    if by.method != "shift":
        lsm, bias = match_where_plane(*seen, a, lsm, window_px=by.template_px, interpolation=by.interpolation)
    covariance = lsm.covariance + bias[:, :, None] * bias[:, None, :]
    bent = np.linalg.norm(bias, axis=1) > MAX_BIAS_PX
    reason = tuple(
        ncc if not ok else refused or (NOT_PLANE if curved else "")
        for ok, refused, ncc, curved in zip(started, lsm_reason, ncc_reason, bent, strict=True)
    )
    correlation = np.where(started & np.isfinite(lsm.correlation), lsm.correlation, correlated.correlation)
    return ConjugatePoints(
        by.method, a, lsm.xy, covariance, lsm.warp, correlation, correlated.second, lsm.gain, lsm.offset,
        np.where(started, lsm.steps, 0), reason,
    )  # fmt: skip


def _what_is_outside(
    photograph: AnyArray, xy: FloatArray, half: int, *, kernel: bool = False
) -> tuple[str, ...]:
    """Return in words what part of each left point lies outside its photograph, empty where none does.

    Args:
        photograph: the left photograph.
        xy: the points, px, (k, 2).
        half: half the side of the template, px.
        kernel: whether to include the margin around the template that least squares matching needs.
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
