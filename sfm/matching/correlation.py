"""Normalised cross-correlation: the best position of a template, its precision and its rivals.

The coefficient r is equation (2.6) of document 002; cv2.matchTemplate computes the sums. A parabola refines
the peak to a tenth of a pixel if the patches differ only by a shift. The standard deviation includes the
misfit of the parabola. On the textures tried, errors were 0.5 to 1.9 times the standard deviation. They were
2.6 times as large at whole pixels of a smooth texture without noise, because nine values do not show the
third-order terms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntFlag

import cv2
import numpy as np

from sfm.matching.radiometry import full_scale, grey_of, odd_window
from sfm.model.arguments import checked_arguments, checked_fields
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.runtime.compiling import compiled, compiled_fast


class NccFlag(IntFlag):
    """Reasons why correlation gives no position, one bit each."""

    NONE = 0
    FLAT_TEXTURE = 1 << 0  # template or search window without contrast
    OUTSIDE = 1 << 2  # the template or the search window reaches beyond its photograph
    AT_BORDER = 1 << 3  # the best position is at the border of the search window; the true one may be outside
    LOW_CORRELATION = 1 << 4  # nothing similar in the search window
    AMBIGUOUS = 1 << 5  # the second-best position is nearly as good
    NOT_CONFIRMED = 1 << 6  # matching back leads elsewhere


# The same flags as numbers, because compiled code cannot use enumerations.
MATCHED, FLAT_TEXTURE, DIVERGED, OUTSIDE, TOO_FAR, LOW_CORRELATION = (int(f) for f in (0, 1, 2, 4, 8, 16))
# Smallest coefficient r of a match, unless stated: one patch then explains half of the variance of the other.
MIN_CORRELATION = 0.7
START_CORRELATION = 0.5  # smallest r at the start, before the warp makes the patches similar
PEAK_ZONE = 2  # a second peak is farther than this from the first in a row or column, px
# Columns of the values read from a surface: x and y in it with their covariances, r, second r, gain, offset.
OUTPUTS = 10
FLAG, X, Y, CXX, CXY, CYY, R, SECOND, GAIN, OFFSET = range(OUTPUTS)
NOT_COMPARED = np.array([int(NccFlag.OUTSIDE)] + [np.nan] * (OUTPUTS - 1))
FLAT, BORDER, LOW, DOUBT = (
    int(f) for f in (NccFlag.FLAT_TEXTURE, NccFlag.AT_BORDER, NccFlag.LOW_CORRELATION, NccFlag.AMBIGUOUS)
)
QUANTILE = 1.645  # of the normal distribution, one-sided, 5 %
MAX_R = 1.0 - 1e-12  # above it Fisher's z is infinite
# Standard deviation below which a template is flat, as a fraction of the full scale (8 and 16 bit).
MIN_CONTRAST = 1.0 / 255.0


@dataclass(frozen=True)
class NccMatches:
    """Best positions of templates in their search windows; `xy` is NaN where the flag gives the reason."""

    xy: FloatArray  # position in the right photograph, px, (k, 2)
    peak: FloatArray  # best position to a whole pixel, for any flag, px, (k, 2)
    covariance: FloatArray  # of xy, from r, its curvature and the misfit of the parabola, px^2, (k, 2, 2)
    correlation: FloatArray  # r at the best whole pixel, (k,)
    second: FloatArray  # r of the second-best peak, -1 if there is none, (k,)
    gain: FloatArray  # beta of right = alpha + beta left, (k,)
    offset: FloatArray  # alpha, right intensity units, (k,)
    flag: IntArray  # see NccFlag, 0 = matched, (k,)

    def __len__(self) -> int:
        return len(self.xy)

    @property
    def good(self) -> BoolArray:
        """Which templates were found, (k,)."""
        return np.asarray(self.flag == 0)


@checked_fields
@dataclass(frozen=True)
class NccLimits:
    """What a match of normalised cross-correlation must reach."""

    min_correlation: float = 0.5  # smallest r of a match
    max_second: float = 1.0  # largest ratio of the second-best r to the best


@checked_arguments(xy_left="k 2", xy_right="n 2")
def match_ncc(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    xy_right: FloatArray,
    *,
    template_px: int = 19,
    search_px: int = 121,
    limits: NccLimits = NccLimits(),
    back_px: float | None = None,
) -> NccMatches:
    """Search windows of the right photograph for the patches around points of the left one.

    Args:
        left: photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: the other photograph.
        xy_left: points in the left photograph, px, (k, 2). The template is centred on the nearest pixel, and
            the fraction is added to the result.
        xy_right: centres of the search windows, px, (k, 2).
        template_px: odd side of the template.
        search_px: odd side of the window within which the whole template moves. It is clipped at the border
            of the photograph.
        limits: what a match must reach.
        back_px: if given, matching back must end within this distance of the left point, px.

    Returns:
        One result per point.

    Raises:
        GeometryError: even windows, a search window not larger than the template, or unpaired points.

    Source: document 002, sec. 2.2, eq. 2.6; Foerstner (1993), in Haralick and Shapiro, Computer and Robot
    Vision II, sec. 16.3, for the precision.
    """
    side = odd_window("NCC template", template_px)
    if odd_window("NCC search", search_px) <= side:
        raise GeometryError(
            f"NCC: a search window of {search_px} px for a template of {side} px, needed a larger window"
        )
    a = np.asarray(xy_left, dtype=float).reshape(-1, 2)
    b = np.asarray(xy_right, dtype=float).reshape(-1, 2)
    if len(a) != len(b):
        raise GeometryError(
            f"NCC: {counted(len(a), 'point')} in the left photograph, {len(b)} windows in the right"
        )
    grey_left, grey_right = grey_of(left), grey_of(right)
    least = least_deviations(left, right)
    out = np.zeros((len(a), OUTPUTS))
    half, reach = side // 2, search_px // 2
    # the corner of each template (-1: outside), and both corners of each search window
    to, size_right = np.nan_to_num(np.rint(b), nan=-1e6), np.array(grey_right.shape[1::-1])
    low = np.clip(to - reach, 0, size_right)
    high = np.clip(to + reach + 1, 0, size_right)
    corners = np.column_stack([template_corners(a, half, grey_left.shape), low, high]).astype(np.int64)
    for k, (x, y, x0, y0, x1, y1) in enumerate(corners.tolist()):
        if x < 0 or x1 - x0 < side or y1 - y0 < side:
            out[k] = NOT_COMPARED
            continue
        template = np.ascontiguousarray(grey_left[y : y + side, x : x + side])
        window = np.ascontiguousarray(grey_right[y0:y1, x0:x1])
        surface = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
        read_peak(
            template, window, surface, surface, least, limits.min_correlation, limits.max_second, out[k]
        )
    out[~np.isfinite(a).all(axis=1) | ~np.isfinite(b).all(axis=1)] = NOT_COMPARED
    matches = matches_of(out, corners[:, 2:4], a, half)
    if back_px is None:
        return matches
    good = np.flatnonzero(matches.good)
    back = match_ncc(right, left, matches.xy[good], a[good], template_px=side, search_px=search_px)
    lost = good[~(np.linalg.norm(back.xy - a[good], axis=1) <= back_px)]
    flag, xy = matches.flag.copy(), matches.xy.copy()
    flag[lost] |= int(NccFlag.NOT_CONFIRMED)
    xy[lost] = np.nan
    return replace(matches, flag=flag, xy=xy)


def matches_of(out: FloatArray, origin: FloatArray | IntArray, xy_left: FloatArray, half: int) -> NccMatches:
    """Return the matches from values read from surfaces of r, (k, OUTPUTS); windows begin at `origin`, px."""
    fraction = xy_left - np.rint(xy_left)
    xy = origin + out[:, [X, Y]] + half + fraction
    peak = np.rint(xy - fraction) + fraction
    flag = out[:, FLAG].astype(np.int64)
    return NccMatches(
        np.where((flag == 0)[:, None], xy, np.nan), peak,
        out[:, [CXX, CXY, CXY, CYY]].reshape(-1, 2, 2),
        out[:, R], out[:, SECOND], out[:, GAIN], out[:, OFFSET], flag,
    )  # fmt: skip


def least_deviations(left: AnyArray, right: AnyArray) -> tuple[float, float]:
    """Return the standard deviations of intensities below which a template and a window are flat."""
    return MIN_CONTRAST * full_scale(left), MIN_CONTRAST * full_scale(right)


def template_corners(a: FloatArray, half: int, shape: tuple[int, ...]) -> IntArray:
    """Return first column and row of the template at each point, -1 if it reaches outside, (k, 2)."""
    at = np.nan_to_num(np.rint(a), nan=-1e6)
    outside = np.asarray(((at < half) | (at > np.array(shape[1::-1]) - 1 - half)).any(axis=1))
    return np.asarray(np.where(outside[:, None], -1, at - half), dtype=np.int64)


def ambiguous(
    best: FloatArray, second: FloatArray, pixels: FloatArray, quantile: float = QUANTILE
) -> BoolArray:
    """Return whether the second-best position may be as good as the best.

    The difference of their Fisher's z is compared with its standard error. This is the standard error for
    independent coefficients from that number of pixels. With 3 independent pixels or fewer nothing can be
    concluded, and any second position makes the match ambiguous.

    Args:
        best: coefficients r of the best positions, (k,).
        second: coefficients r of the second-best positions, -1 if there is none, (k,).
        pixels: number of independent pixels in the template, (k,).
        quantile: of the normal distribution, one-sided, that the difference must exceed.

    Source: Fisher (1921), Metron 1, pp. 3-32.
    """
    z = np.arctanh(np.clip([best, second], -MAX_R, MAX_R))
    deviates = (z[0] - z[1]) * np.sqrt(np.maximum(pixels - 3.0, 0.0) / 2.0)
    return np.asarray((second > -1.0) & ~(deviates >= quantile))


def independent_pixels(grey: AnyArray, xy: FloatArray, template_px: int) -> FloatArray:
    """Return the number of independent pixels equivalent to a template with correlated neighbours, (k,).

    Args:
        grey: photograph, one channel, (H, W).
        xy: centres of the templates, px, (k, 2); NaN is returned for those that reach outside or are flat.
        template_px: odd side of the templates.

    Source: Clifford, Richardson and Hemon (1989), Biometrics 45, pp. 123-134: 1 + n over the sum of the
    squared autocorrelations. Autocorrelations estimated from one template are noisy. If neighbouring pixels
    are uncorrelated, the number is therefore up to a half too small, and the test is more cautious.
    """
    wide = 2 * template_px  # of the transform, so that the template does not overlap itself across the border
    out = np.full(len(xy), np.nan)
    for k, (x, y) in enumerate(template_corners(xy, template_px // 2, grey.shape).tolist()):
        if x < 0:
            continue
        d = grey[y : y + template_px, x : x + template_px].astype(float)
        d -= d.mean()
        if not d.any():
            continue
        rho = np.fft.irfft2(np.abs(np.fft.rfft2(d, (wide, wide))) ** 2, (wide, wide))
        out[k] = 1.0 + d.size / ((rho / rho[0, 0]) ** 2).sum()
    return out


@compiled
def read_peak(
    template: AnyArray,
    window: AnyArray,
    surface: AnyArray,
    around: AnyArray,
    least: tuple[float, float],
    min_r: float,
    max_second: float,
    out: FloatArray,
) -> None:
    """Find best and second-best peak of a surface of r, fit the parabola and the regression of intensities.

    Args:
        template: intensities, float32, (s, s). All arrays are contiguous: only one form is compiled.
        window: intensities of the search window, float32, (H, W).
        surface: r where a match is allowed, else -1, float32, (H - s + 1, W - s + 1).
        around: r everywhere, for the parabola; same shape.
        least: standard deviations below which a template, and a window, are flat.
        min_r: smallest r of a match.
        max_second: largest ratio of the second-best r to the best.
        out: receives the columns FLAG to OFFSET.
    """
    rows, cols = surface.shape
    side = template.shape[0]
    n = side * side
    highest = np.empty(rows, np.float32)  # of each row, so that most rows are not searched for a second peak
    bi, bj = 0, 0
    for i in range(rows):
        highest[i] = _largest(surface[i])
        if highest[i] > highest[bi]:
            bi = i
    while bj < cols - 1 and surface[bi, bj] < highest[bi]:
        bj += 1
    # cv2 sums in float32: compute r at the best position again in double precision
    tm, wm = 0.0, 0.0
    for i in range(side):
        for j in range(side):
            tm += template[i, j]
            wm += window[bi + i, bj + j]
    tm, wm = tm / n, wm / n
    tt, ww, tw = 0.0, 0.0, 0.0
    for i in range(side):
        for j in range(side):
            t, w = template[i, j] - tm, window[bi + i, bj + j] - wm
            tt += t * t
            ww += w * w
            tw += t * w
    out[X], out[Y] = bj, bi
    if tt < n * least[0] ** 2 or ww < n * least[1] ** 2:
        out[FLAG] = FLAT
        return
    r = tw / np.sqrt(tt * ww)
    out[R], out[GAIN], out[OFFSET] = r, tw / tt, wm - tw / tt * tm
    second = _second_peak(surface, highest, bi, bj)
    out[SECOND] = second
    if r < min_r:
        out[FLAG] = LOW
    elif bi == 0 or bj == 0 or bi == rows - 1 or bj == cols - 1:
        out[FLAG] = BORDER
    elif second > max_second * r:
        out[FLAG] = DOUBT
    if out[FLAG] == 0:
        _fit_parabola(around, bi, bj, r, n, out)


@compiled
def _second_peak(surface: AnyArray, highest: AnyArray, bi: int, bj: int) -> np.float32:
    """Return the highest r of a surface at a peak away from the best one, -1 if there is none.

    Args:
        surface: r of each position of the template in the window, float32.
        highest: largest r of each row, float32, so that most rows are not searched.
        bi: row of the best position.
        bj: its column.
    """
    rows, cols = surface.shape
    second = np.float32(-1.0)
    for i in range(rows):
        if highest[i] <= second:
            continue
        for j in range(cols):
            r2 = surface[i, j]
            if r2 <= second or (abs(i - bi) <= PEAK_ZONE and abs(j - bj) <= PEAK_ZONE):
                continue
            top = True  # a peak is higher than its neighbours, unlike a slope
            for u in range(max(0, i - 1), min(rows, i + 2)):
                for v in range(max(0, j - 1), min(cols, j + 2)):
                    top = top and surface[u, v] <= r2
            if top:
                second = r2
    return second


@compiled
def _fit_parabola(around: AnyArray, bi: int, bj: int, r: float, n: int, out: FloatArray) -> None:
    """Fit a parabola around the best position; add the position of its top to `out`, with its covariance.

    Args:
        around: r everywhere.
        bi: row of the best position.
        bj: its column.
        r: correlation there.
        n: number of pixels of the template.
        out: the row of the result.
    """
    # least squares parabola through the nine coefficients around the peak (weights in closed form)
    gx, gy, hxx, hyy, hxy = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(-1, 2):
        for j in range(-1, 2):
            s = around[bi + i, bj + j]
            gx += j * s / 6.0
            gy += i * s / 6.0
            hxy += i * j * s / 4.0
            hxx += (j * j - 2.0 / 3.0) * s
            hyy += (i * i - 2.0 / 3.0) * s
    det = hxx * hyy - hxy * hxy
    if not (hxx < 0.0 and det > 0.0):
        out[FLAG] = DOUBT
        return
    dx, dy = (hxy * gy - hyy * gx) / det, (hxy * gx - hxx * gy) / det
    out[X] += min(1.0, max(-1.0, dx))
    out[Y] += min(1.0, max(-1.0, dy))
    # least squares of the shift has N = sum g g^T = -r'' sum f^2 / r, sigma^2 = (1 - r^2) sum f^2 / (n - 4)
    c = (1.0 - r * r) * r / (n - 4) / det
    # r is not a parabola: the misfit of the nine coefficients, with 9 - 6 degrees of freedom, adds to the
    # gradient
    mean = 0.0
    for i in range(-1, 2):
        for j in range(-1, 2):
            mean += around[bi + i, bj + j] / 9.0
    misfit = 0.0
    for i in range(-1, 2):
        for j in range(-1, 2):
            bend = hxx * (j * j - 2.0 / 3.0) / 2.0 + hyy * (i * i - 2.0 / 3.0) / 2.0 + hxy * i * j
            misfit += (around[bi + i, bj + j] - mean - gx * j - gy * i - bend) ** 2
    m = misfit / 3.0 / 6.0 / (det * det)
    out[CXX] = -hyy * c + m * (hyy * hyy + hxy * hxy)
    out[CXY] = hxy * c - m * hxy * (hxx + hyy)
    out[CYY] = -hxx * c + m * (hxx * hxx + hxy * hxy)


@compiled_fast
def _largest(row: AnyArray) -> float:
    """Return the largest of some numbers."""
    largest: float = row[0]
    for value in row:
        largest = max(largest, value)
    return largest


def match_ncc_warped(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    xy_right: FloatArray,
    linear: FloatArray,
    *,
    reach_px: IntArray,
    template_px: int = 19,
    limits: NccLimits = NccLimits(),
) -> NccMatches:
    """Search windows of the right photograph, each resampled by an affine map, for templates.

    Args:
        left: photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: the other photograph.
        xy_left: points in the left photograph, px, (k, 2).
        xy_right: their predicted positions in the right photograph, px, (k, 2).
        linear: right px per left px around each point, (k, 2, 2).
        reach_px: largest distance from the prediction along a row and a column, left px, (k,).
        template_px: odd side of the template.
        limits: what a match must reach.

    Returns:
        One result per point, with positions and covariances in the right photograph.

    Raises:
        GeometryError: an even template, no reach, or different numbers of points, positions and maps.

    Source: as `match_ncc`; the window is resampled by bilinear interpolation.
    """
    side = odd_window("NCC template", template_px)
    a, b = np.asarray(xy_left, dtype=float).reshape(-1, 2), np.asarray(xy_right, dtype=float).reshape(-1, 2)
    A = np.asarray(linear, dtype=float)
    if (reach_px < 1).any():
        raise GeometryError(f"NCC: a reach of {reach_px.min()} px, needed at least 1 px")
    if len(a) != len(b) or A.shape != (len(a), 2, 2):
        raise GeometryError(
            f"NCC: {counted(len(a), 'point')} in the left photograph, {counted(len(b), 'position')} in the "
            f"right one and maps of shape {A.shape}, needed one position and one map for each point"
        )
    grey_left, grey_right = grey_of(left), grey_of(right)
    least = least_deviations(left, right)
    half = side // 2
    out = np.zeros((len(a), OUTPUTS))
    corners = template_corners(a, half, grey_left.shape)
    usable = (corners[:, 0] >= 0) & np.isfinite(b).all(axis=1) & np.isfinite(A).all(axis=(1, 2))
    fraction = a - np.rint(a)
    for k in range(len(a)):
        reach = int(reach_px[k])
        inside = _inside_right(A[k], b[k], fraction[k], half, reach, grey_right.shape) if usable[k] else None
        if inside is None or not inside.any():
            out[k] = NOT_COMPARED
            continue
        x, y = corners[k].tolist()
        first = b[k] - A[k] @ (fraction[k] + half + reach)  # position of the window's first pixel
        window = cv2.warpAffine(
            grey_right,
            np.column_stack([A[k], first]),
            (side + 2 * reach, side + 2 * reach),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        template = np.ascontiguousarray(grey_left[y : y + side, x : x + side])  # like the windows
        surface = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
        allowed = np.where(inside, surface, np.float32(-1.0))
        read_peak(
            template, window, allowed, surface, least, limits.min_correlation, limits.max_second, out[k]
        )
    around = np.repeat(-(half + reach_px)[:, None], 2, axis=1)  # window corners, from their centres
    matches = matches_of(out, around, np.zeros_like(a), half)
    return replace(
        matches,
        xy=b + np.einsum("kij,kj->ki", A, matches.xy),
        peak=b + np.einsum("kij,kj->ki", A, matches.peak),
        covariance=A @ matches.covariance @ A.transpose(0, 2, 1),
    )


def _inside_right(
    A: FloatArray, b: FloatArray, fraction: FloatArray, half: int, reach: int, shape: tuple[int, ...]
) -> BoolArray:
    """Return at which positions in the window the whole template is inside the right photograph, (n, n)."""
    at = np.arange(-reach, reach + 1.0)
    inside = np.ones((len(at), len(at)), dtype=bool)
    for axis in range(2):
        along_x = A[axis, 0] * (at - fraction[0]) + b[axis]
        along_y = A[axis, 1] * (at - fraction[1])
        margin = half * (abs(A[axis, 0]) + abs(A[axis, 1]))  # of the template's corners
        first, last = margin, shape[1 - axis] - 1 - margin
        if along_x.min() + along_y.min() < first or along_x.max() + along_y.max() > last:
            middle = along_x + along_y[:, None]
            inside &= (middle >= first) & (middle <= last)
    return inside


class LsmFlag(IntFlag):
    """Reasons why least squares matching gives no position, one bit each."""

    NONE = 0
    FLAT_TEXTURE = 1 << 0  # in some direction no more texture than noise
    DIVERGED = 1 << 1  # no solution within the steps allowed, or a degenerate warp or gain
    OUTSIDE = 1 << 2  # the window, or the margin of its kernel, reaches beyond a photograph
    TOO_FAR = 1 << 3  # farther from the start than allowed
    LOW_CORRELATION = 1 << 4  # converged, but the patches are not similar
