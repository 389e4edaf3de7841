"""Conjugate points: from points of one photograph to the same points in another, and how well.

Correlation finds the place to a pixel in a search window, least squares matching takes it from there. With
`equalise` the histograms of both photographs are equalised in between, which is the order of document 002;
it helps the eye more than the matching, which has a gain and an offset of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.matching.flags import LsmFlag, NccFlag, in_words
from sfm.matching.lsm import match_lsm
from sfm.matching.ncc import match_ncc
from sfm.matching.radiometry import equalise_histogram

METHODS = {"ncc": "", "lsm": "affine", "lsm8": "projective", "shift": "shift"}


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
    min_correlation: float = 0.5,
) -> ConjugatePoints:
    """Find points of the left photograph in the right one.

    Args:
        left, right: photographs, (H, W), 8 or 16 bit, grey or colour.
        xy_left: points in the left photograph, px, (k, 2).
        xy_right: centres of the search windows, px, (k, 2); the same places as in the left if not given.
        method: ncc, or ncc and then shift (2), lsm (6) or lsm8 (8 geometric parameters).
        template_px, search_px: odd sides of template and search window; document 002 has 19 and 21.
        equalise: equalise the histograms of both photographs before least squares matching.
        interpolation: six_tap, bicubic or bilinear; see `sfm.matching.lsm.match_lsm`.
        min_correlation: smallest r of a match, of correlation and of least squares matching.

    Returns:
        One result for each point.

    Raises:
        GeometryError: unknown method, even windows, or points that do not go in pairs.

    Source: document 002, sec. 2 (equations 2.1 to 2.20).
    """
    if method not in METHODS:
        raise GeometryError(f"matching: method '{method}' is none of {', '.join(METHODS)}")
    a = np.asarray(xy_left, dtype=float).reshape(-1, 2)
    b = a if xy_right is None else np.asarray(xy_right, dtype=float).reshape(-1, 2)
    found = match_ncc(
        left, right, a, b, template_px=template_px, search_px=search_px, min_correlation=min_correlation
    )
    ncc_reason = tuple(in_words(NccFlag, flag) for flag in found.flag)
    if method == "ncc":
        warp = np.tile(np.eye(3), (len(a), 1, 1))
        warp[:, :2, 2] = found.xy
        lost = ~found.good[:, None, None]
        return ConjugatePoints(
            method, a, found.xy, np.where(lost, np.nan, found.covariance), warp, found.correlation,
            found.second, found.gain, found.offset, np.zeros(len(a), dtype=np.int64), ncc_reason,
        )  # fmt: skip
    if equalise:
        left, right = equalise_histogram(left), equalise_histogram(right)
    # A peak at the border of the search window is a start like any other: least squares may walk out of it.
    started = found.good | (found.flag == int(NccFlag.AT_BORDER))
    start = np.where(started[:, None], np.where(found.good[:, None], found.xy, found.peak), -1.0)
    lsm = match_lsm(
        left,
        right,
        a,
        start,
        model=METHODS[method],
        window_px=template_px,
        interpolation=interpolation,
        min_correlation=min_correlation,
    )
    reason = tuple(
        in_words(LsmFlag, flag) if ok else ncc
        for ok, ncc, flag in zip(started, ncc_reason, lsm.flag, strict=True)
    )
    correlation = np.where(started, lsm.correlation, found.correlation)
    return ConjugatePoints(
        method, a, lsm.xy, lsm.covariance, lsm.warp, correlation, found.second, lsm.gain, lsm.offset,
        np.where(started, lsm.steps, 0), reason,
    )  # fmt: skip
