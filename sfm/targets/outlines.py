"""Outlines that resemble ellipses, the candidates for targets, and the quality flags.

The quality flags are the one list of remarks on targets and of reasons against candidates. A measured target
may have several remarks (`SATURATED`, `CODE_UNREADABLE`, ...). A candidate that is not measured has the first
reason that excluded it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntFlag
from typing import Any

import cv2
import numpy as np

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled

# The local mean is that of 3 x 3 cells of 4 x 4 px, interpolated, about 14 px: an edge is detected up to half
# of it, for any size of the target.
CELL_PX = 4
MEAN_CELLS = 3
# Local step of intensity for a candidate: this many sigma of the smoothed noise (the mask 1 2 1 x 1 2 1
# leaves 3/8 of it), and at least this part of the scale.
STEP_SIGMAS = 6.0
SMOOTHED_NOISE = 3 / 8
MIN_STEP = 4 / 255
# Minor over major axis: 75 degrees of tilt give 0.26; with allowance for perspective and for elliptic blobs.
MIN_AXIS_RATIO = 0.14
# Outlines farther than this from their ellipse (in radii, plus this many px for the grid) are not elliptic.
OUTLINE_TOLERANCE, GRID_TOLERANCE_PX = 0.2, 1.5
# Minimum number of outline points of a damaged target, in this part of the directions from its centre. The
# points lie within this distance of the ellipse (radii, plus px for the grid). The hull of an ellipse fills
# 1.00 of the ellipse in the box around it, and not much less with a nick or a splash of ink.
MIN_OUTLINE_POINTS, MIN_AROUND, DIRECTIONS = 24, 0.6, 32
BRIDGED_TOLERANCE, BRIDGED_GRID_PX, HULL_FILLS, BRIDGE_ROUNDS = 0.03, 0.8, (0.75, 1.12), 5
# The noise is estimated from about this many rows.
NOISE_ROWS = 40


@dataclass(frozen=True)
class Outlines:
    """Outlines that resemble ellipses, and the reasons against the other outlines."""

    xy: FloatArray
    """centres, px, shape (k, 2)"""
    shape: FloatArray
    """(p, q, r) of S, which turns image vectors into radii, 1/px, shape (k, 3)"""
    sign: IntArray
    """+1 brighter, -1 darker than the surroundings, shape (k,)"""
    rejected_xy: FloatArray
    """positions of the other outlines, px, shape (m, 2)"""
    rejected_flag: IntArray
    """reasons against them, see Flag, shape (m,)"""


def find_outlines(
    photograph: AnyArray,
    signs: tuple[int, ...],
    *,
    noise: float,
    scale: float,
    min_diameter_px: float,
    max_diameter_px: float,
    hidden: BoolArray | None = None,
    reach: float = 1.0,
) -> Outlines:
    """Find outlines that resemble ellipses.

    A pixel belongs to a candidate if the smoothed photograph differs from the local mean there. Along the
    edge of a target this gives a closed band just inside the edge, for any size of the target and any level
    of light. The outer contour of the band is the edge itself.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16.
        signs: +1 to find bright targets, -1 for dark targets.
        noise: standard deviation of the intensities.
        scale: largest intensity that the photograph can represent.
        min_diameter_px: minimum minor axis of a target.
        max_diameter_px: maximum major axis of a target.
        hidden: masked pixels, (H, W); outlines that do not reach any other pixel are left out.
        reach: of a target and its code, in semi-axes of its outline.

    Returns:
        The outlines.
    """
    # Outlines need no more than 8 bits; the measurement uses all bits.
    image = as_bytes(photograph, scale)
    step = 255 / scale * max(STEP_SIGMAS * SMOOTHED_NOISE * noise, MIN_STEP * scale)
    # the mean intensity around each pixel of every fourth row, (H // 4, W)
    height, width = image.shape
    rows, columns = max(1, height // CELL_PX), max(1, width // CELL_PX)
    half = cv2.resize(image, (2 * columns, 2 * rows), interpolation=cv2.INTER_AREA)
    cells = cv2.resize(half, (columns, rows), interpolation=cv2.INTER_AREA)
    cells = cv2.blur(cells, (MEAN_CELLS, MEAN_CELLS))
    mean = cv2.resize(cells, (width, rows), interpolation=cv2.INTER_LINEAR)
    band = np.empty_like(image)
    ellipses, kept_signs, rejected_xy, rejected_flag = [], [], [], []
    for sign in signs:
        _mark_band(image, mean, step, sign, band)
        points, first = _trace_contours(band)
        ellipse, reason = _ellipses_of_contours(
            points, first, height, width, float(min_diameter_px), float(max_diameter_px)
        )
        shown = _reaching_shown(ellipse, hidden, reach)
        _bridge_damage(points, first, ellipse, reason, shown)
        good = (reason == 0) & shown
        ellipses.append(ellipse[good])
        kept_signs.append(np.full(int(good.sum()), sign))
        rejected_xy.append(ellipse[~good & shown, :2])
        rejected_flag.append(reason[~good & shown])
    candidates = np.concatenate(ellipses)
    return Outlines(
        xy=candidates[:, :2],
        shape=candidates[:, 2:],
        sign=np.concatenate(kept_signs),
        rejected_xy=np.concatenate(rejected_xy),
        rejected_flag=np.concatenate(rejected_flag),
    )


def _reaching_shown(ellipse: FloatArray, hidden: BoolArray | None, reach: float) -> BoolArray:
    """Return which ellipses, x, y, p, q, r, (k, 5), reach pixels that are not masked, (k,).

    The code of a target whose centre is masked shows that the parts of it that are not are no targets.
    """
    if hidden is None:
        return np.ones(len(ellipse), dtype=bool)
    distance = cv2.distanceTransform(hidden.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    column, row = np.rint(ellipse[:, :2]).astype(np.int64).T
    p, q, r = ellipse[:, 2:].T
    smallest = (p + r) / 2 - np.hypot((p - r) / 2, q)  # inverse of the major semi-axis; 0 without a shape
    reaching = distance[row, column] * smallest <= reach
    return np.asarray(reaching & ((smallest > 0) | ~hidden[row, column]))


def estimate_noise(photograph: AnyArray) -> float:
    """Return the standard deviation of the noise of a photograph in its units.

    Source: Immerkaer, "Fast noise variance estimation" (1996): the mask 1 -2 1 x 1 -2 1 cancels planes; the
    median over a part of the rows is used, so that edges do not count.
    """
    height = photograph.shape[0]
    if min(photograph.shape) < 3:
        return 0.0
    at = np.arange(1, height - 1, max(1, height // NOISE_ROWS))
    above, here, below = (photograph[at + k].astype(np.float32) for k in (-1, 0, 1))
    v = above - 2 * here + below
    mask = np.abs(v[:, :-2] - 2 * v[:, 1:-1] + v[:, 2:])
    # 6 = norm of the mask, 0.6745 = median of |N(0, 1)|
    return float(np.median(mask)) / (0.6745 * 6)


def as_bytes(photograph: AnyArray, scale: float) -> AnyArray:
    """Return intensities of a given scale as bytes, (H, W)."""
    return photograph if photograph.dtype == np.uint8 else cv2.convertScaleAbs(photograph, alpha=255 / scale)


def scale_of(photograph: AnyArray) -> float:
    """Return the largest intensity a photograph can represent: 255, or 2^bits - 1 for the bits in use."""
    if photograph.dtype == np.uint8:
        return 255.0
    return float((1 << max(8, int(photograph.max()).bit_length())) - 1)


@compiled
def _mark_band(image: AnyArray, mean: AnyArray, step: float, sign: int, band: AnyArray) -> None:
    """Set band to 1 where the smoothed photograph is beyond the local mean by the step, elsewhere to 0.

    The photograph is smoothed by 1 2 1 x 1 2 1. The mean is interpolated between rows of cells: the four rows
    of pixels of a cell lie 3/8 and 1/8 of it before and after its middle. Sums have 16 bits, so that many
    pixels are processed at once.
    """
    height, width = image.shape
    last = len(mean) - 1
    column, row_mean = np.zeros(width, np.int16), np.zeros(width, np.int16)
    limit, direction, bit = np.int16(16 * step), np.int16(sign), np.int16(1)
    band[0] = 0
    band[height - 1] = 0
    for i in range(1, height - 1):
        cell, phase = min(i // CELL_PX, last), i % CELL_PX
        far = np.int16(6) if phase in (0, 3) else np.int16(2)
        near = np.int16(16) - far
        mean_here, mean_next = mean[cell], mean[min(max(cell + (-1 if phase < 2 else 1), 0), last)]
        above, here, below, out = image[i - 1], image[i], image[i + 1], band[i]
        for j in range(width):
            row_mean[j] = near * np.int16(mean_here[j]) + far * np.int16(mean_next[j])
        for j in range(width):
            column[j] = np.int16(above[j]) + (np.int16(here[j]) << bit) + np.int16(below[j])
        for j in range(1, width - 1):
            smooth = np.int16(column[j - 1] + column[j + 1]) + np.int16(column[j] << bit)
            out[j] = np.int16(direction * np.int16(np.int16(smooth) - row_mean[j])) > limit
        out[0] = 0
        out[width - 1] = 0


def _trace_contours(band: AnyArray) -> tuple[AnyArray, IntArray]:
    """Return the points of the outer contours, int32, (n, 2), and the start of each contour, (k + 1,)."""
    contours: Any
    contours, hierarchy = cv2.findContours(band, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    parent = np.zeros(0) if hierarchy is None else np.asarray(hierarchy).reshape(-1, 4)[:, 3]
    outer = [contours[k] for k in np.flatnonzero(parent < 0) if len(contours[k]) >= 4]
    if not outer:
        return np.zeros((0, 2), np.int32), np.zeros(1, np.int64)
    first = np.cumsum([0, *(len(c) for c in outer)])
    return np.concatenate(outer).reshape(-1, 2), first


@compiled
def _ellipses_of_contours(
    points: AnyArray, first: IntArray, height: int, width: int, smallest: float, largest: float
) -> tuple[FloatArray, IntArray]:
    """Return x, y, p, q, r of the ellipse with the moments of each contour, and the reason against it.

    The contour runs through the outermost pixels, so half a pixel is added to the semi-axes.
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
        # The outline is smaller by less than a pixel; the limits are applied exactly after the fit.
        if 2 * b + 2 < smallest:
            reason[c] = Flag.TOO_SMALL.value
            continue
        if 2 * a - 2 > largest:
            reason[c] = Flag.TOO_LARGE.value
            continue
        if (b + 0.5) / a < MIN_AXIS_RATIO:
            reason[c] = Flag.TOO_OBLIQUE.value
            continue
        angle = 0.5 * math.atan2(2 * xy, xx - yy)
        cos, sin = math.cos(angle), math.sin(angle)
        p = cos * cos / a + sin * sin / b
        q = cos * sin * (1 / a - 1 / b)
        r = sin * sin / a + cos * cos / b
        ellipse[c, 2], ellipse[c, 3], ellipse[c, 4] = p, q, r
        tolerance = OUTLINE_TOLERANCE + GRID_TOLERANCE_PX / b
        for i in range(i0, i1):
            dx, dy = points[i, 0] - ellipse[c, 0], points[i, 1] - ellipse[c, 1]
            rho = math.sqrt((p * dx + q * dy) ** 2 + (q * dx + r * dy) ** 2)
            if abs(rho - 1) > tolerance:
                reason[c] = Flag.NOT_ELLIPTIC.value
                break
    return ellipse, reason


def _bridge_damage(
    points: AnyArray, first: IntArray, ellipse: FloatArray, reason: IntArray, shown: BoolArray
) -> None:
    """Fit ellipses to the longest smooth part of outlines interrupted by a nick, a splash or a scratch.

    The outline of a large target is that of a thin band along its edge, and the contour enters the band
    through a nick. The hull excludes the inner side of the band, and points far from the ellipse through the
    rest are dropped step by step.

    Args:
        points: points of the contours, px, (n, 2).
        first: start of each contour, (k + 1,).
        ellipse: x, y, p, q, r, improved for a bridged outline, (k, 5).
        reason: set to 0 for a bridged outline, (k,).
        shown: outlines that are looked at, (k,).
    """
    for c in np.flatnonzero((reason == Flag.NOT_ELLIPTIC.value) & shown):
        contour = points[first[c] : first[c + 1]]
        if len(contour) < MIN_OUTLINE_POINTS:
            continue
        hull = cv2.convexHull(contour)
        (_, _), (long, short), _ = cv2.minAreaRect(hull)
        low, high = HULL_FILLS
        if not low < cv2.contourArea(hull) / (math.pi / 4 * max(long * short, 1.0)) < high:
            continue
        bridged = _trimmed_ellipse(contour.astype(float), hull.reshape(-1, 2).astype(float))
        if bridged is not None:
            ellipse[c], reason[c] = bridged, 0


def _trimmed_ellipse(contour: FloatArray, hull: FloatArray) -> FloatArray | None:
    """Return x, y, p, q, r of the ellipse that fits most of an outline; None if there is none."""
    ahead = np.roll(hull, -1, axis=0) - hull
    across = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.hypot(*ahead.T)[:, None]
    inside = np.abs(np.einsum("eb,neb->ne", across, contour[:, None] - hull[None])).min(axis=1)
    chosen = contour[inside < 1.5]
    ellipse = None
    for _ in range(BRIDGE_ROUNDS):
        if len(chosen) < MIN_OUTLINE_POINTS / 2:
            return None
        (x, y), (width, height), degrees = cv2.fitEllipseDirect(chosen.astype(np.float32))
        a, b = width / 2 + 0.5, height / 2 + 0.5
        if not (np.isfinite([x, y, a, b]).all() and min(a, b) / max(a, b) > MIN_AXIS_RATIO):
            return None
        cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        p, q = cos * cos / a + sin * sin / b, cos * sin * (1 / a - 1 / b)
        r = sin * sin / a + cos * cos / b
        ellipse = np.array([x, y, p, q, r])
        dx, dy = (contour - (x, y)).T
        u, v = p * dx + q * dy, q * dx + r * dy
        tolerance = BRIDGED_TOLERANCE + BRIDGED_GRID_PX / min(a, b)
        on_it = np.abs(np.hypot(u, v) - (1 - 0.5 / min(a, b))) < tolerance
        if len(chosen) == on_it.sum() and (chosen == contour[on_it]).all():
            break
        chosen = contour[on_it]
    direction = np.floor((np.arctan2(v, u)[on_it] / (2 * math.pi) + 0.5) * DIRECTIONS).astype(int)
    return ellipse if len(np.unique(direction % DIRECTIONS)) >= MIN_AROUND * DIRECTIONS else None


class Flag(IntFlag):
    """Remarks on a target (kept) and reasons for a rejection, one bit each."""

    NONE = 0
    # remarks: the target is measured and kept
    SATURATED = 1 << 0  # pixels at the end of the scale were censored
    CODE_UNREADABLE = 1 << 1  # something like a code surrounds the dot, but no valid code was read
    SHADED = 1 << 2  # the gain changes by more than 3 sigma across the target
    CLOSE_NEIGHBOUR = 1 << 3  # part of the background was left out because another object is there
    CORNER = 1 << 4  # the corner of a square tag, not a circle
    HALO = 1 << 5  # the background falls off from the edge: light scattered around a retro-reflective target
    FLARE = 1 << 6  # the background is saturated or changes strongly across the target: glare on its surface
    CROSSING = 1 << 7  # a crossing of a checkerboard, not a circle
    # reasons for a rejection
    CUT_BY_BORDER = 1 << 8  # the border of the photograph cuts the target or its background
    TOO_SMALL = 1 << 9  # below min_diameter_px
    TOO_LARGE = 1 << 10  # above max_diameter_px
    TOO_OBLIQUE = 1 << 11  # axis ratio below that of a circle seen at 75 degrees
    NOT_ELLIPTIC = 1 << 12  # the outline is not an ellipse
    LOW_CONTRAST = 1 << 13  # the step of intensity is too small for the noise
    UNEVEN_EDGE = 1 << 14  # the edge is missing or different on part of the circumference
    POOR_FIT = 1 << 15  # the intensities differ from the model of a blurred ellipse
    BLURRED = 1 << 16  # the edge is too soft for the size
    NO_CONVERGENCE = 1 << 17  # the least squares fit did not converge on this outline
    DUPLICATE = 1 << 18  # the same target was found twice
    PART_OF_CODE = 1 << 19  # inside the code ring of another target
    LOBED = 1 << 20  # the outline deviates from the ellipse like that of a bar or a square
    THIN_BACKGROUND = 1 << 21  # the background is only a thin stroke, as in a letter "o"
    NOT_ON_PLATE = 1 << 22  # not a dot of the calibration plate
    # other remarks
    DAMAGED = 1 << 23  # a nick, a scratch or a mark in the target was left out of the fit
    CONCENTRIC = 1 << 24  # the image of the common centre of rings, not eccentric


# Reasons for a rejection, from the most target-like candidates on: each has passed the tests of the reasons
# after it, which `sfm.targets.measure` applies first. The last two do not mean a lost target.
LIKELIEST_FIRST = (
    Flag.NOT_ON_PLATE, Flag.POOR_FIT, Flag.THIN_BACKGROUND, Flag.LOBED, Flag.UNEVEN_EDGE, Flag.BLURRED,
    Flag.LOW_CONTRAST, Flag.TOO_OBLIQUE, Flag.TOO_LARGE, Flag.NO_CONVERGENCE, Flag.CUT_BY_BORDER,
    Flag.NOT_ELLIPTIC, Flag.TOO_SMALL, Flag.PART_OF_CODE, Flag.DUPLICATE,
)  # fmt: skip


def count_flags(flags: IntArray) -> list[tuple[str, int]]:
    """Return pairs of the name of a flag and its number of entries, most frequent first, without zeros.

    Args:
        flags: flags of targets or of rejected candidates, shape (k,).

    Returns:
        Pairs of lower-case name and count.
    """
    counts = [(str(f.name).lower(), int(((flags & f.value) != 0).sum())) for f in Flag if f.value]
    return sorted((c for c in counts if c[1]), key=lambda c: (-c[1], c[0]))
