"""What a click measures: a target, a ring with its code, a saddle, a corner, a cross or a window.

A person points to a feature within a few pixels. The feature is measured by the method that surveys use for
it: targets and rings by the fit of a blurred ellipse, saddles by the intersection of their edges, corners
by the fit of two blurred edges, natural points by the interest operator. A cross is its own image after
half a turn, so least squares matching of its window with the turned one gives its centre. A measurement
that depends on the size of its window is refused, since another feature is in it.

Source: Foerstner and Guelch (1987), ISPRS Intercommission Workshop Interlaken; Loy and Zelinsky (2003),
IEEE PAMI 25(8), for points of symmetry.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np

from sfm.matching.conjugate import match_points
from sfm.matching.conjugate_patches import MatchSettings
from sfm.matching.lsm.two_photo import LsmSettings, match_lsm
from sfm.matching.tracks.interest import foerstner_points
from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.runtime.sampling import as_grey
from sfm.survey.inputs.marks_file import Kind
from sfm.targets.codes.plates import TargetFamily
from sfm.targets.detect import find_targets
from sfm.targets.fits.corner import CONTRAST, fit_corners
from sfm.targets.fits.saddle import measure_saddles
from sfm.targets.outlines import MIN_STEP, STEP_SIGMAS, estimate_noise, scale_of

REACH_PX = 12.0  # from a click to the outline of a target, or to another feature
WINDOW_REACH_PX = 6.0  # from a click to a natural point
ROUNDING_NOISE = 12**-0.5  # grey values, of photographs without noise, such as rendered or overexposed ones
TARGET_HALVES_PX = (60, 160, 400)  # half sides of the parts in which targets are found; large ones need more
SADDLE_HALVES_PX = (4, 6, 9, 13)
CORNER_REACHES_PX = (7.0, 10.0, 14.0, 19.0)  # lengths of the edges that are fitted
CROSS_RADII_PX = (7.0, 10.0, 14.0, 20.0, 28.0)  # of the circles that cut the arms
BESIDE = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))  # half radii
ANGLES = 128  # samples of a circle
AGREEMENT_SIGMAS, AGREEMENT_PX = 4.0, 0.1  # of one feature measured in windows of two sizes
MIN_WEDGE, MAX_WEDGE = math.radians(20), math.radians(160)  # between the edges of a corner
REACH_SIZES = 2.5  # half side of the part in which a target of known size is found, in its sizes
MIN_SYMMETRY = 0.7  # correlation of the intensities on a circle with those half a turn on
DISTINCT = 2.0  # weight of a natural point over that of another one that the click may have meant
SHARP_PX = 0.15  # largest standard deviation of a natural point that attracts a click


@dataclass(frozen=True)
class Measured:
    """A feature that was measured at a click."""

    x: float  # px
    y: float  # px
    covariance: FloatArray  # noise of the photograph, px^2, (2, 2)
    kind: Kind
    outline: FloatArray  # what was fitted, closed or open line, px, (n, 2)
    code: int | None = None  # of a ring
    note: str = ""  # what a person should know

    @property
    def size_px(self) -> float:
        """Half side of what was fitted, px."""
        return float(np.abs(self.outline - (self.x, self.y)).max()) if len(self.outline) else 0.0

    def moved(self, origin: FloatArray) -> Measured:
        """Return the measurement in the whole photograph, of which the measured part begins at `origin`."""
        outline = self.outline + origin
        return replace(self, x=self.x + float(origin[0]), y=self.y + float(origin[1]), outline=outline)


@dataclass(frozen=True)
class Template:
    """The window of a natural point, in the photograph in which it was marked first."""

    photograph: AnyArray  # intensities, (H, W)
    x: float  # px
    y: float  # px


@dataclass(frozen=True)
class _Asked:
    """What is to be measured."""

    at: FloatArray  # click, px, (2,)
    family: TargetFamily | None
    window_px: int
    reach: float  # px
    size: float  # half side of a target, 0 if not known, px


@dataclass(frozen=True)
class _Part:
    """A part of a photograph around a click."""

    pixels: AnyArray  # (h, w), uint8 or uint16
    grey: AnyArray  # the same, float32
    at: FloatArray  # click in the part, px, (2,)
    origin: FloatArray  # of the part in the photograph, px, (2,)
    noise: float  # standard deviation of an intensity
    scale: float  # largest intensity

    @property
    def least_step(self) -> float:
        """Smallest step of intensity that is an edge."""
        return max(STEP_SIGMAS * self.noise, MIN_STEP * self.scale)


def measure_click(
    photograph: AnyArray,
    x: float,
    y: float,
    kind: Kind | None = None,
    *,
    family: TargetFamily | None = None,
    template: Template | None = None,
    window_px: int = 21,
    reach_px: float = REACH_PX,
    size_px: float = 0.0,
) -> Measured:
    """Measure the feature at a click.

    Args:
        photograph: intensities, (H, W), uint8 or uint16.
        x: column of the click, px.
        y: row of the click, px.
        kind: what to measure; None for the first of target, saddle, cross, corner and window that fits.
        family: codes of rings.
        template: window of a natural point, which is searched for around the click.
        window_px: odd side of the windows of natural points.
        reach_px: largest distance from the click to the feature, px.
        size_px: half side of a target, if it is known from other photographs, px.

    Raises:
        GeometryError: the click is outside the photograph, or nothing of this kind is there.
    """
    height, width = photograph.shape
    if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
        raise GeometryError(f"mark: {x:.1f}, {y:.1f} px is outside the photograph of {width} x {height} px")
    if template is not None:
        return _matched(photograph, np.array([x, y]), template, window_px, reach_px)
    kinds = tuple(METHODS) if kind is None else (kind,)
    asked = _Asked(np.array([x, y]), family, window_px, reach_px, size_px)
    for name in kinds:
        measured = METHODS[name](photograph, asked)
        if measured is not None and (kind != "ring" or measured.kind == "ring"):
            return measured
    what = "nothing" if kind is None else f"no {kind}"
    raise GeometryError(f"mark: {what} can be measured within {reach_px:.0f} px of {x:.1f}, {y:.1f} px")


def _part(photograph: AnyArray, at: FloatArray, half: int) -> _Part:
    height, width = photograph.shape
    left, top = (max(round(float(v)) - half, 0) for v in at)
    right, bottom = min(left + 2 * half + 1, width), min(top + 2 * half + 1, height)
    pixels = np.ascontiguousarray(photograph[top:bottom, left:right])
    origin = np.array([left, top], dtype=float)
    noise = max(estimate_noise(pixels), ROUNDING_NOISE)
    return _Part(pixels, as_grey(pixels), at - origin, origin, noise, scale_of(pixels))


def _target(photograph: AnyArray, asked: _Asked) -> Measured | None:
    """Return the target whose outline contains the click or is nearest to it."""
    at, family, reach = asked.at, asked.family, asked.reach
    known = (int(reach + REACH_SIZES * asked.size) + 8,) if asked.size > 0 else ()
    for half in known or TARGET_HALVES_PX:
        part = _part(photograph, at, half)
        targets = find_targets(part.pixels, codes="none" if family is None else family)
        circles = np.flatnonzero(targets.is_circle)
        if not len(circles):
            continue
        away = part.at - targets.xy[circles]
        c, s = np.cos(targets.angle[circles]), np.sin(targets.angle[circles])
        along = np.column_stack([c * away[:, 0] + s * away[:, 1], -s * away[:, 0] + c * away[:, 1]])
        radii = np.hypot(*(along / targets.semi_axes[circles]).T)
        outside = np.maximum(radii - 1, 0) * np.sqrt(targets.semi_axes[circles].prod(axis=1))
        best = int(np.lexsort((radii, np.round(outside, 6)))[0])
        if outside[best] > reach:
            continue
        k = int(circles[best])
        code = int(targets.code[k])
        turn = np.linspace(0, 2 * np.pi, 65)
        a, b = targets.semi_axes[k]
        u, v = a * np.cos(turn), b * np.sin(turn)
        outline = targets.xy[k] + np.column_stack([c[best] * u - s[best] * v, s[best] * u + c[best] * v])
        return Measured(
            float(targets.xy[k, 0]),
            float(targets.xy[k, 1]),
            targets.covariance[k],
            "ring" if code >= 0 else "target",
            outline,
            code if code >= 0 else None,
        ).moved(part.origin)
    return None


def _saddle(photograph: AnyArray, asked: _Asked) -> Measured | None:
    """Return the crossing of two edges between squares of alternating brightness."""
    reach = asked.reach
    part = _part(photograph, asked.at, int(reach) + 3 * SADDLE_HALVES_PX[-1])
    smooth = cv2.GaussianBlur(part.grey, (0, 0), 1.5)
    xx, yy, xy = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((2, 0), (0, 2), (1, 1)))
    for start in _peaks(np.asarray(xy * xy - xx * yy), part.at, reach):

        def fit(half: float, start: FloatArray = start) -> tuple[FloatArray, FloatArray] | None:
            measured = measure_saddles(part.grey, start[None], np.array([half]), noise=part.noise)
            at_half = measured.xy[0]
            if not (np.isfinite(at_half).all() and measured.contrast[0] >= part.least_step):
                return None
            runs = _runs(part, at_half, 0.75 * half)
            if runs is None or runs.changes != 4 or runs.symmetry < MIN_SYMMETRY:
                return None
            return at_half, measured.covariance[0]

        grown = _largest_that_agrees(fit, SADDLE_HALVES_PX)
        if grown is not None:
            (xy_px, C), half = grown
            return _with_arms(part, xy_px, C, "saddle", _runs(part, xy_px, 0.75 * half), half)
    return None


def _cross(photograph: AnyArray, asked: _Asked) -> Measured | None:
    """Return the centre of two bars that cross."""
    reach = asked.reach
    part = _part(photograph, asked.at, int(reach) + 2 * int(CROSS_RADII_PX[-1]))
    centre, radius = part.at, 0.0
    for r, away in product(CROSS_RADII_PX, BESIDE):
        place = _cross_start(part, part.at + r / 2 * np.array(away), r)
        if place is not None and np.hypot(*(place - part.at)) <= reach:
            centre, radius = place, r
            break
    if not radius:
        return None
    last: tuple[FloatArray, FloatArray, int] | None = None
    for r in CROSS_RADII_PX:
        half = int(r)
        matched = _half_turn(part, centre, half)
        if matched is None:
            continue
        xy, C = matched
        runs = _runs(part, xy, 0.8 * r)
        if (
            np.hypot(*(xy - centre)) > 3.0
            or runs is None
            or runs.changes != 8
            or runs.symmetry < MIN_SYMMETRY
        ):
            if last is not None:
                break
            continue
        if last is not None and not _agree(last[0], last[1], xy, C):
            break
        last = xy, C, half
    if last is None or np.hypot(*(last[0] - part.at)) > reach:
        return None
    return _with_arms(part, last[0], last[1], "cross", _runs(part, last[0], 0.8 * last[2]), last[2])


def _cross_start(part: _Part, at: FloatArray, r: float) -> FloatArray | None:
    """Return where the lines through opposite arms cross, seen on a circle around an approximate centre."""
    centre = at
    for _ in range(4):
        runs = _runs(part, centre, r)
        if runs is None or runs.changes != 8 or len(runs.middles) != 4:
            return None
        p = centre + r * np.column_stack([np.cos(runs.middles), np.sin(runs.middles)])
        d1, d2 = p[2] - p[0], p[3] - p[1]
        det = d1[0] * d2[1] - d1[1] * d2[0]
        if abs(det) < 0.2 * np.hypot(*d1) * np.hypot(*d2):
            return None
        t = ((p[1] - p[0])[0] * d2[1] - (p[1] - p[0])[1] * d2[0]) / det
        moved = p[0] + t * d1
        if np.hypot(*(moved - centre)) < 0.2:
            return np.asarray(moved)
        centre = moved
    return np.asarray(centre)


def _half_turn(part: _Part, centre: FloatArray, half: int) -> tuple[FloatArray, FloatArray] | None:
    """Return the point about which a window is symmetric, and its covariance.

    The match of a window with its turned image is a displacement of twice the distance to the point. Every
    pair of pixels takes part twice, which doubles its variance.
    """
    h, w = part.grey.shape
    turned = np.ascontiguousarray(part.grey[::-1, ::-1])
    last = np.array([w - 1, h - 1], dtype=float)
    settings = LsmSettings(model="shift", window_px=2 * half + 1, max_shift_px=6.0, min_correlation=0.8)
    xy = centre
    for _ in range(3):
        match = match_lsm(part.grey, turned, xy[None], (last - xy)[None], settings)
        if not match.good[0]:
            return None
        xy = (xy + last - match.xy[0]) / 2
    return xy, match.covariance[0] / 2


def _corner(photograph: AnyArray, asked: _Asked) -> Measured | None:
    """Return the corner where two edges of one surface meet."""
    reach = asked.reach
    part = _part(photograph, asked.at, int(reach) + 3 * int(CORNER_REACHES_PX[-1]))
    response = cv2.cornerMinEigenVal(cv2.GaussianBlur(part.grey, (0, 0), 1.0), 5)
    for start in _peaks(np.asarray(response), part.at, reach):

        def fit(length: float, start: FloatArray = start) -> tuple[FloatArray, FloatArray] | None:
            return _fit_corner(part, start, length)

        grown = _largest_that_agrees(fit, CORNER_REACHES_PX)
        if grown is not None:
            (xy, C), length = grown
            return _with_arms(part, xy, C, "corner", _runs(part, xy, length), length)
    return None


def _fit_corner(part: _Part, start: FloatArray, length: float) -> tuple[FloatArray, FloatArray] | None:
    """Return a corner and its covariance, from edges of a length, px."""
    runs = _runs(part, start, length)
    if runs is None or runs.changes != 2:
        return None
    first, second = runs.crossings
    wedge = (second - first) % (2 * math.pi)
    if wedge > math.pi:
        first, second, wedge = second, first, 2 * math.pi - wedge
    if not MIN_WEDGE <= wedge <= MAX_WEDGE:
        return None
    side = length / 0.45
    one, two = (side * np.array([math.cos(a), math.sin(a)]) for a in (first, second))
    quad = np.array([start, start + one, start + one + two, start + two])
    square = np.array([[0, 0], [8, 0], [8, 8], [0, 8]], dtype=np.float32)
    tag_from_pixel = np.asarray(cv2.getPerspectiveTransform(quad.astype(np.float32), square), dtype=float)
    clear = np.zeros((1, 8, 8), dtype=np.bool_)
    fits = fit_corners(part.grey, quad[None], tag_from_pixel[None], clear, part.scale)
    C = fits.covariance[0, 0, :2, :2]
    if not (np.isfinite(C).all() and abs(fits.theta[0, 0, CONTRAST]) >= part.least_step):
        return None
    xy = fits.theta[0, 0, :2]
    after = _runs(part, xy, length)
    return (xy, C) if after is not None and after.changes == 2 else None


def _window(photograph: AnyArray, asked: _Asked) -> Measured | None:
    """Return the natural point near the click, or the place itself where several or none are distinct."""
    within, window_px = min(asked.reach, WINDOW_REACH_PX), asked.window_px
    part = _part(photograph, asked.at, int(within) + 2 * window_px + 20)
    points = foerstner_points(part.pixels, min_distance_px=3.0)
    near = np.flatnonzero(np.hypot(*(points.xy - part.at).T) <= within)
    around = np.flatnonzero(
        np.hypot(*(points.xy - part.at).T) <= 2 * within
    )  # another click would reach these
    half, xy, note = window_px // 2, part.at, ""
    alone = len(near) and points.weight[near[0]] >= DISTINCT * points.weight[around[around != near[0]]].max(
        initial=0
    )
    if alone and np.linalg.eigvalsh(points.covariance[near[0]])[1] <= SHARP_PX**2:
        xy, C = points.xy[near[0]], points.covariance[near[0]]
    else:
        note = f"no distinct place within {within:.0f} px: the place itself is the point"
        column, row = (round(float(v)) for v in xy)
        window = part.grey[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1]
        if min(window.shape) < half + 1:
            return None
        # the covariance with which least squares matching finds a window
        gy, gx = np.gradient(window.astype(float))
        N = np.array([[(gx * gx).sum(), (gx * gy).sum()], [(gx * gy).sum(), (gy * gy).sum()]])
        N -= part.noise**2 / 2 * window.size * np.eye(2)  # of the differences
        if not (np.linalg.eigvalsh(N)[0] > part.noise**2 * window.size / 2):
            return None
        C = np.asarray(part.noise**2 * np.linalg.inv(N))
    box = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    return Measured(float(xy[0]), float(xy[1]), C, "window", xy + box, note=note).moved(part.origin)


def _matched(
    photograph: AnyArray, at: FloatArray, template: Template, window_px: int, reach: float
) -> Measured:
    """Return the place near a click that looks like the window of a point."""
    place = np.array([template.x, template.y])
    left = _part(template.photograph, place, 3 * window_px)
    right = _part(photograph, at, 3 * window_px + int(reach))
    settings = MatchSettings(template_px=window_px, search_px=window_px + 2 * int(reach))
    match = match_points(left.pixels, right.pixels, left.at[None], settings, xy_right=right.at[None])
    if not match.good[0]:
        raise GeometryError(
            f"mark: the window of the point is not matched within {reach:.0f} px of {at[0]:.1f}, "
            f"{at[1]:.1f} px ({match.reason[0]})"
        )
    half, xy = window_px // 2, match.right[0]
    box = half * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    turned = box @ match.warp[0, :2, :2].T
    return Measured(float(xy[0]), float(xy[1]), match.covariance[0] / 2, "window", xy + turned).moved(
        right.origin
    )


METHODS: dict[Kind, Callable[..., Measured | None]] = {
    "target": _target,
    "ring": _target,
    "saddle": _saddle,
    "cross": _cross,
    "corner": _corner,
    "window": _window,
}


@dataclass(frozen=True)
class _Runs:
    """Bright and dark runs on a circle."""

    changes: int  # between them
    crossings: FloatArray  # angles of the changes, rad, (changes,)
    middles: FloatArray  # angles of the middles of the shorter runs, rad, (changes / 2,)
    symmetry: float  # correlation with the circle half a turn on


def _runs(part: _Part, centre: FloatArray, radius: float) -> _Runs | None:
    """Return the runs on a circle; None if it leaves the part or has no contrast."""
    height, width = part.grey.shape
    if not (radius + 1 < centre[0] < width - radius - 2 and radius + 1 < centre[1] < height - radius - 2):
        return None
    angle = np.arange(ANGLES) * 2 * np.pi / ANGLES
    x = (centre[0] + radius * np.cos(angle)).astype(np.float32)
    y = (centre[1] + radius * np.sin(angle)).astype(np.float32)
    values = cv2.remap(part.grey, x[None], y[None], cv2.INTER_LINEAR)[0].astype(float)
    low, high = np.percentile(values, (5, 95))
    if high - low < part.least_step:
        return None
    off = values - (low + high) / 2
    bright = off > 0
    at = np.flatnonzero(bright != np.roll(bright, -1))
    following = np.roll(off, -1)[at]
    crossings = angle[at] + 2 * np.pi / ANGLES * off[at] / (off[at] - following)
    rises = np.flatnonzero(~bright[at])  # where a bright run begins
    middles = []
    if len(at):
        short = bright.mean() < 0.5
        for k in rises if short else np.flatnonzero(bright[at]):
            end = crossings[(k + 1) % len(at)]
            middles.append(crossings[k] + ((end - crossings[k]) % (2 * np.pi)) / 2)
    opposite = np.roll(values, ANGLES // 2)
    symmetry = float(np.corrcoef(values, opposite)[0, 1])
    return _Runs(len(at), crossings, np.sort(np.array(middles)), symmetry)


def _peaks(response: FloatArray, at: FloatArray, reach: float) -> Iterator[FloatArray]:
    """Yield the strongest maxima within reach of a click, the nearest of the strong ones first, (2,)."""
    height, width = response.shape
    y, x = np.mgrid[:height, :width]
    away = np.hypot(x - at[0], y - at[1])
    top = (response >= cv2.dilate(response, np.ones((5, 5), np.uint8))) & (away <= reach) & (response > 0)
    rows, columns = np.nonzero(top)
    if not len(rows):
        return
    strength = response[rows, columns]
    strong = np.flatnonzero(strength >= 0.3 * strength.max())
    for k in strong[np.argsort(away[rows[strong], columns[strong]])][:4]:
        yield np.array([columns[k], rows[k]], dtype=float)


def _largest_that_agrees(
    fit: Callable[[float], tuple[FloatArray, FloatArray] | None], sizes: tuple[float, ...]
) -> tuple[tuple[FloatArray, FloatArray], float] | None:
    """Return the measurement in the largest window that agrees with the smaller ones, and its size."""
    last: tuple[tuple[FloatArray, FloatArray], float] | None = None
    for size in sizes:
        fitted = fit(size)
        if fitted is None:
            if last is not None:
                break
            continue
        if last is not None and not _agree(*last[0], *fitted):
            break
        last = fitted, size
    return last


def _agree(a: FloatArray, Ca: FloatArray, b: FloatArray, Cb: FloatArray) -> bool:
    limit = AGREEMENT_PX + AGREEMENT_SIGMAS * math.sqrt(max(np.trace(Ca), np.trace(Cb)))
    return bool(np.hypot(*(a - b)) <= limit)


def _with_arms(
    part: _Part, xy: FloatArray, C: FloatArray, kind: Kind, runs: _Runs | None, length: float
) -> Measured:
    """Return a measurement with the edges or arms that it was measured from as its outline."""
    lines = [xy]
    if runs is not None:
        for angle in runs.middles if kind == "cross" else runs.crossings:
            lines += [xy + length * np.array([math.cos(angle), math.sin(angle)]), xy]
    return Measured(float(xy[0]), float(xy[1]), np.asarray(C), kind, np.array(lines)).moved(part.origin)
