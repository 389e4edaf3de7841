"""Finding, measuring and decoding the circular targets of one photograph."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.targets.codes import UNCODED, UNREADABLE, CodeFamily, code_family, read_codes
from sfm.targets.flags import Flag
from sfm.targets.measure import EllipseFit, axes_from_shape, fit_ellipse_model

# Side of the window of the local mean, px: an edge is seen up to half of it, whatever the target's size.
MEAN_WINDOW_PX = 15
# The local step of intensity that makes a candidate: this many sigma of the smoothed noise, at least ...
STEP_SIGMAS = 6.0
# ... this share of the scale.
LEAST_STEP = 4 / 255
# Axis ratio of a circle tilted by 75 degrees, with a little room for perspective and noise.
LEAST_AXIS_RATIO = 0.9 * math.cos(math.radians(75))
# Outlines farther than this from their ellipse (in radii, plus 1.5 px for the pixel grid) are not elliptic.
OUTLINE_TOLERANCE = 0.2
# Largest RMS of the residuals and largest mean residual on an eighth of the edge, over the contrast.
POOR_FIT = 0.12
UNEVEN_EDGE = 0.18
# Parts of an unreadable code are smaller than this share of its dot.
PART_OF_DOT = 0.75
# Softest edge: this share of the minor semi-axis, or this blur in px where that is more.
SOFTEST_EDGE = 0.35
SOFTEST_EDGE_PX = 1.3


@dataclass(frozen=True)
class Targets:
    """The circular targets measured in one photograph, and the candidates that were rejected."""

    xy: FloatArray
    """centres, px, (0, 0) is the centre of the top-left pixel, shape (k, 2)"""
    covariance: FloatArray
    """covariance of the centres, px^2, shape (k, 2, 2)"""
    semi_axes: FloatArray
    """major and minor semi-axis of the ellipse, px, shape (k, 2)"""
    angle: FloatArray
    """direction of the major axis from x (right) towards y (down), rad, shape (k,)"""
    code: IntArray
    """code number, -1 where uncoded, shape (k,)"""
    confidence: FloatArray
    """confidence of the code, 0 to 1, 0 where uncoded, shape (k,)"""
    polarity: IntArray
    """+1 brighter, -1 darker than the surroundings, shape (k,)"""
    contrast: FloatArray
    """step of intensity from background to target, units of the photograph, shape (k,)"""
    background: FloatArray
    """intensity around the target, units of the photograph, shape (k,)"""
    blur: FloatArray
    """standard deviation of the edge, px, shape (k,)"""
    noise: FloatArray
    """standard deviation of the intensities about the fitted model, shape (k,)"""
    flag: IntArray
    """remarks, see sfm.targets.flags.Flag, shape (k,)"""
    rejected_xy: FloatArray
    """positions of rejected candidates, px, shape (m, 2)"""
    rejected_flag: IntArray
    """their reasons, see sfm.targets.flags.Flag, shape (m,)"""

    def __len__(self) -> int:
        return len(self.xy)


def find_targets(
    photograph: AnyArray,
    *,
    polarity: str = "auto",
    codes: str | CodeFamily = "none",
    min_diameter_px: float = 4.0,
    max_diameter_px: float = 250.0,
) -> Targets:
    """Find, measure and decode the circular targets of one photograph.

    Candidates are the outlines of what differs from its local mean; those that resemble ellipses are fitted
    with the model of a blurred ellipse, and what the model does not explain is rejected with a reason.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16.
        polarity: dark, bright or auto (both).
        codes: arcs, ring12, ring14, ring20, none, the path of a code table, or a family.
        min_diameter_px: least minor axis of a target.
        max_diameter_px: largest major axis of a target.

    Returns:
        The targets in order of rows, and the rejected candidates.

    Raises:
        ValueError: not a grey photograph of 8 or 16 bit, or an unknown polarity.
        SurveyFileError: neither a known code family nor a readable table.
    """
    if photograph.ndim != 2 or photograph.dtype not in (np.uint8, np.uint16):
        raise ValueError(
            f"photograph is {photograph.dtype} of shape {photograph.shape}, needed uint8 or uint16 (H, W)"
        )
    signs = {"bright": (1,), "dark": (-1,), "auto": (1, -1)}.get(polarity)
    if signs is None:
        raise ValueError(f"polarity {polarity!r} is none of dark, bright, auto")
    family = code_family(codes)
    noise = estimate_noise(photograph)
    xy, shape, sign, rejected_xy, rejected_flag = find_outlines(
        photograph, signs, noise, min_diameter_px=min_diameter_px, max_diameter_px=max_diameter_px
    )
    fit = fit_ellipse_model(photograph, xy, shape, sign, noise=noise)
    reason = _judge(fit, noise, _scale(photograph), min_diameter_px, max_diameter_px)
    reason[_duplicates(fit, reason)] = Flag.DUPLICATE
    code, confidence = np.full(len(xy), UNCODED), np.zeros(len(xy))
    good = reason == 0
    if family is not None and good.any():
        levels = np.column_stack([fit.background, fit.contrast])
        code[good], confidence[good] = read_codes(
            photograph, fit.xy[good], fit.shape[good], levels[good], family
        )
        reason[good & _inside_codes(fit, code, family)] = Flag.PART_OF_CODE
    keep = np.flatnonzero(reason == 0)
    keep = keep[np.lexsort((fit.xy[keep, 0], fit.xy[keep, 1]))]
    remark = np.where(code == UNREADABLE, fit.flag | Flag.CODE_UNREADABLE.value, fit.flag)
    semi_axes, angle = axes_from_shape(fit.shape[keep])
    return Targets(
        xy=fit.xy[keep],
        covariance=fit.covariance[keep],
        semi_axes=semi_axes,
        angle=angle,
        code=np.where(code == UNREADABLE, UNCODED, code)[keep],
        confidence=confidence[keep],
        polarity=sign[keep],
        contrast=fit.contrast[keep],
        background=fit.background[keep],
        blur=fit.blur[keep],
        noise=fit.noise[keep],
        flag=remark[keep],
        rejected_xy=np.vstack([rejected_xy, xy[reason != 0]]),
        rejected_flag=np.concatenate([rejected_flag, reason[reason != 0]]),
    )


def estimate_noise(photograph: AnyArray) -> float:
    """Return the standard deviation of the noise of a photograph in its own units.

    Source: Immerkaer, "Fast noise variance estimation" (1996): the mask 1 -2 1 x 1 -2 1 annuls planes;
    its median over every eighth row is used, so that edges do not count.
    """
    rows = photograph.astype(np.float32) if photograph.shape[0] < 24 else None
    if rows is None:
        at = np.arange(1, photograph.shape[0] - 1, 8)
        a, b, c = (photograph[at + k].astype(np.float32) for k in (-1, 0, 1))
        v = a - 2 * b + c
    else:
        v = rows[:-2] - 2 * rows[1:-1] + rows[2:]
    mask = v[:, :-2] - 2 * v[:, 1:-1] + v[:, 2:]
    return float(np.median(np.abs(mask)) / (0.6745 * 6))


def find_outlines(
    photograph: AnyArray,
    signs: tuple[int, ...],
    noise: float,
    *,
    min_diameter_px: float,
    max_diameter_px: float,
) -> tuple[FloatArray, FloatArray, IntArray, FloatArray, IntArray]:
    """Find outlines that resemble ellipses.

    A pixel belongs to a candidate if the smoothed photograph there differs from the local mean. Along the
    edge of a target this gives a closed band just inside of it, whatever the size of the target and the level
    of the light, and the outer contour of the band is the edge itself.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16.
        signs: +1 to look for bright, -1 for dark targets.
        noise: standard deviation of the intensities.
        min_diameter_px, max_diameter_px: limits of the minor and major axis.

    Returns:
        Centres, px, shape (k, 2); (p, q, r) of the ellipses, 1/px, shape (k, 3); signs, shape (k,);
        positions, px, shape (m, 2), and reasons, shape (m,), of the outlines that were rejected.
    """
    smooth = cv2.GaussianBlur(photograph, (3, 3), 0)
    mean = cv2.boxFilter(photograph, -1, (MEAN_WINDOW_PX, MEAN_WINDOW_PX))
    smoothing = 3 / 8  # the 1 2 1 x 1 2 1 / 16 mask leaves this share of the noise
    step = max(STEP_SIGMAS * smoothing * noise, LEAST_STEP * _scale(photograph))
    found, signs_found, rejected = [], [], []
    for sign in signs:
        band = cv2.subtract(smooth, mean) if sign > 0 else cv2.subtract(mean, smooth)
        contours, hierarchy = cv2.findContours(
            (band > step).view(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE
        )
        if hierarchy is None:
            continue
        parent = hierarchy.reshape(-1, 4)[:, 3]
        outer = [c for c, p in zip(contours, parent, strict=True) if p < 0 and len(c) >= 4]
        if not outer:
            continue
        first = np.cumsum([0, *(len(c) for c in outer)])
        points = np.concatenate(outer).reshape(-1, 2).astype(np.int64)
        ellipse, reason = _ellipses_of_outlines(
            points,
            first,
            photograph.shape[1],
            photograph.shape[0],
            float(min_diameter_px),
            float(max_diameter_px),
        )
        found.append(ellipse[reason == 0])
        signs_found.append(np.full(len(found[-1]), sign))
        rejected.append((ellipse[reason != 0, :2], reason[reason != 0]))
    ellipses = np.concatenate([np.empty((0, 5)), *found])
    return (
        ellipses[:, :2],
        ellipses[:, 2:],
        np.concatenate([np.empty(0, np.int64), *signs_found]),
        np.concatenate([np.empty((0, 2)), *(xy for xy, _ in rejected)]),
        np.concatenate([np.empty(0, np.int64), *(flag for _, flag in rejected)]),
    )


def _scale(photograph: AnyArray) -> float:
    """Return the range of intensities that the photograph uses, at least that of its type's lower eighth."""
    return float(np.iinfo(photograph.dtype).max)


@njit(cache=True, nogil=True, error_model="numpy")
def _ellipses_of_outlines(
    points: IntArray, first: IntArray, width: int, height: int, smallest: float, largest: float
) -> tuple[FloatArray, IntArray]:
    """Return x, y, p, q, r of the ellipse with the moments of each outline, and the reason against it.

    The outline runs through the outermost pixels, so half a pixel is added to the semi-axes.
    """
    k = len(first) - 1
    ellipse = np.zeros((k, 5))
    reason = np.zeros(k, np.int64)
    for c in range(k):
        i0, i1 = first[c], first[c + 1]
        ox, oy = points[i0, 0], points[i0, 1]
        left, right, top, bottom = ox, ox, oy, oy
        m00, m10, m01, m20, m11, m02 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(i0, i1):
            j = i + 1 if i + 1 < i1 else i0
            left, right = min(left, points[i, 0]), max(right, points[i, 0])
            top, bottom = min(top, points[i, 1]), max(bottom, points[i, 1])
            ax, ay = float(points[i, 0] - ox), float(points[i, 1] - oy)
            bx, by = float(points[j, 0] - ox), float(points[j, 1] - oy)
            cross = ax * by - bx * ay  # Green's theorem
            m00 += cross
            m10 += cross * (ax + bx)
            m01 += cross * (ay + by)
            m20 += cross * (ax * ax + ax * bx + bx * bx)
            m11 += cross * (2 * ax * ay + ax * by + bx * ay + 2 * bx * by)
            m02 += cross * (ay * ay + ay * by + by * by)
        ellipse[c, 0], ellipse[c, 1] = (left + right) / 2, (top + bottom) / 2
        if max(right - left, bottom - top) + 1 > 1.5 * largest + 4:
            reason[c] = Flag.TOO_LARGE.value
            continue
        if max(right - left, bottom - top) + 3 < smallest or m00 == 0.0:
            reason[c] = Flag.TOO_SMALL.value
            continue
        if left < 2 or top < 2 or right > width - 3 or bottom > height - 3:
            reason[c] = Flag.CUT_BY_BORDER.value
            continue
        area = m00 / 2
        x, y = m10 / (6 * area), m01 / (6 * area)
        xx = m20 / (12 * area) - x * x
        xy = m11 / (24 * area) - x * y
        yy = m02 / (12 * area) - y * y
        half = math.sqrt((xx - yy) ** 2 / 4 + xy * xy)
        a = 2 * math.sqrt(max((xx + yy) / 2 + half, 0.0)) + 0.5
        b = 2 * math.sqrt(max((xx + yy) / 2 - half, 0.0)) + 0.5
        ellipse[c, 0], ellipse[c, 1] = ox + x, oy + y
        # The outline is shrunk by less than a pixel; the limits are applied exactly after the fit.
        if 2 * b + 2 < smallest:
            reason[c] = Flag.TOO_SMALL.value
            continue
        if 2 * a - 2 > largest:
            reason[c] = Flag.TOO_LARGE.value
            continue
        if (b + 0.5) / a < LEAST_AXIS_RATIO:
            reason[c] = Flag.TOO_OBLIQUE.value
            continue
        angle = 0.5 * math.atan2(2 * xy, xx - yy)
        cos, sin = math.cos(angle), math.sin(angle)
        p = cos * cos / a + sin * sin / b
        q = cos * sin * (1 / a - 1 / b)
        r = sin * sin / a + cos * cos / b
        ellipse[c, 2], ellipse[c, 3], ellipse[c, 4] = p, q, r
        tolerance = OUTLINE_TOLERANCE + 1.5 / b
        for i in range(i0, i1):
            dx, dy = points[i, 0] - ellipse[c, 0], points[i, 1] - ellipse[c, 1]
            rho = math.sqrt((p * dx + q * dy) ** 2 + (q * dx + r * dy) ** 2)
            if abs(rho - 1) > tolerance:
                reason[c] = Flag.NOT_ELLIPTIC.value
                break
    return ellipse, reason


def _judge(fit: EllipseFit, noise: float, scale: float, smallest: float, largest: float) -> IntArray:
    """Return the first reason against each fitted candidate, 0 where there is none."""
    a, b = np.full(len(fit.xy), np.nan), np.full(len(fit.xy), np.nan)
    defined = fit.shape[:, 0] * fit.shape[:, 2] > fit.shape[:, 1] ** 2
    if defined.any():
        a[defined], b[defined] = axes_from_shape(fit.shape[defined])[0].T
    contrast = np.abs(fit.contrast)
    border = (fit.flag & Flag.CUT_BY_BORDER) != 0
    with np.errstate(divide="ignore", invalid="ignore"):
        tests = [
            (Flag.CUT_BY_BORDER, border),
            (Flag.NOT_ELLIPTIC, (fit.flag & Flag.NOT_ELLIPTIC) != 0),
            (Flag.NO_CONVERGENCE, (fit.flag & Flag.NO_CONVERGENCE) != 0),
            (Flag.TOO_SMALL, ~(2 * b >= smallest)),
            (Flag.TOO_LARGE, ~(2 * a <= largest)),
            (Flag.TOO_OBLIQUE, b / a < LEAST_AXIS_RATIO),
            (Flag.LOW_CONTRAST, contrast < np.maximum(STEP_SIGMAS * noise, LEAST_STEP * scale)),
            (Flag.BLURRED, fit.blur > np.maximum(SOFTEST_EDGE * b, SOFTEST_EDGE_PX)),
            (Flag.UNEVEN_EDGE, fit.unevenness > UNEVEN_EDGE + 3 * noise / contrast),
            (Flag.POOR_FIT, fit.noise / contrast > POOR_FIT + noise / contrast),
        ]
    reason = np.zeros(len(fit.xy), dtype=np.int64)
    for flag, against in tests:
        reason[(reason == 0) & against] = flag.value
    return reason


def _duplicates(fit: EllipseFit, reason: IntArray) -> BoolArray:
    """Return which of the good candidates surround another one: of concentric ellipses the smallest is kept.

    A retro-reflective dot with a dark rim in glare is seen as bright dot and, larger, as the dark rim.
    """
    duplicate = np.zeros(len(fit.xy), dtype=bool)
    good = np.flatnonzero(reason == 0)
    size = fit.shape[good, 0] * fit.shape[good, 2] - fit.shape[good, 1] ** 2  # 1 / (a b)^2
    order = good[np.argsort(-size, kind="stable")]
    xy, shape = fit.xy[order], fit.shape[order]
    by_x = np.argsort(xy[:, 0], kind="stable")
    for i, k in enumerate(order):
        if duplicate[k]:
            continue
        # centres of larger ellipses near this centre
        reach = 0.5 / math.sqrt(max(shape[i, 0] * shape[i, 2] - shape[i, 1] ** 2, 1e-12))
        lo, hi = np.searchsorted(xy[by_x, 0], (xy[i, 0] - reach, xy[i, 0] + reach))
        for j in by_x[lo:hi]:
            if j > i and np.hypot(*(xy[j] - xy[i])) < reach:
                duplicate[order[j]] = True
    return duplicate


def _inside_codes(fit: EllipseFit, code: IntArray, family: CodeFamily) -> BoolArray:
    """Return which candidates lie in the code ring of another target, hence are parts of its code.

    About a dot whose code was not read only what is clearly smaller than the dot counts.
    """
    inside = np.zeros(len(fit.xy), dtype=bool)
    size = np.sqrt(np.abs(fit.shape[:, 0] * fit.shape[:, 2] - fit.shape[:, 1] ** 2))  # 1 / mean semi-axis
    for k in np.flatnonzero(code != UNCODED):
        p, q, r = fit.shape[k]
        dx, dy = (fit.xy - fit.xy[k]).T
        rho = np.hypot(p * dx + q * dy, q * dx + r * dy)
        part = (rho > 1) & (rho < family.outer + 0.2)
        inside |= part if code[k] >= 0 else part & (size * PART_OF_DOT > size[k])
    return inside
