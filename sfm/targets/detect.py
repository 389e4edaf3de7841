"""Detection, measurement and decoding of the targets of one photograph: the entry point of this package."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import KolinearError, PhotographError
from sfm.runtime.sampling import as_grey, is_shown
from sfm.targets.codes.boards import find_boards
from sfm.targets.codes.concentric import ConcentricFamily, ConcentricTags, find_concentric
from sfm.targets.codes.dot_plates import name_dots, rings_among
from sfm.targets.codes.plates import BOARDS, PlateFamily, PlateGroup, TargetFamily, code_family, plates_of
from sfm.targets.codes.rings import UNCODED, UNREADABLE, CodeFamily, read_codes
from sfm.targets.codes.tags import DRAWN_PX, TagCorners, TagFamily, find_tags, inside_tags
from sfm.targets.fits.centroid import WEIGHTS, measure_centroids, measure_edge_ellipses
from sfm.targets.fits.concentric import BACKGROUND, BLUR, CONTRAST
from sfm.targets.fits.saddle import Saddles
from sfm.targets.measure import (
    EllipseFit,
    axes_covariance,
    axes_from_shape,
    find_counters,
    find_duplicates,
    find_legible,
    find_parts_of_codes,
    fit_ellipse_model,
    judge_fits,
)
from sfm.targets.outlines import Flag, Outlines, estimate_noise, find_outlines, scale_of

SIGNS = {"dark": (-1,), "bright": (1,), "auto": (1, -1)}
CENTRES = ("model", "edges", *WEIGHTS)


@dataclass(frozen=True)
class Targets:
    """The targets of one photograph, circles and corners of tags, and the rejected candidates."""

    xy: FloatArray
    """centres, px, (0, 0) is the centre of the top-left pixel, shape (k, 2)"""
    covariance: FloatArray
    """covariance of the centres, px^2, shape (k, 2, 2)"""
    axes_covariance: FloatArray
    """covariance of (major, minor, angle), px and rad, nan for corners of tags, shape (k, 3, 3)"""
    edge_covariance: FloatArray
    """covariance of (background, contrast, blur), units of the photograph and px, shape (k, 3, 3)"""
    semi_axes: FloatArray
    """major and minor semi-axis of the ellipse, px; for a corner of a tag the drawn circle, shape (k, 2)"""
    angle: FloatArray
    """direction of the major axis from x (right) towards y (down), rad, shape (k,)"""
    code: IntArray
    """code number, for a corner of a tag see codes.tags.TagCorners, -1 if uncoded, shape (k,)"""
    confidence: FloatArray
    """confidence of the code, 0 to 1, 0 if uncoded, shape (k,)"""
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
    """remarks, see sfm.targets.outlines.Flag, shape (k,)"""
    rejected_xy: FloatArray
    """positions of rejected candidates, px, shape (m, 2)"""
    rejected_flag: IntArray
    """reasons for rejection, see sfm.targets.outlines.Flag, shape (m,)"""

    def __len__(self) -> int:
        return len(self.xy)

    @property
    def is_circle(self) -> BoolArray:
        """Which targets are circles, and not corners of tags, (k,)."""
        return np.asarray(np.isfinite(self.axes_covariance[:, 0, 0]))

    def select(self, rows: BoolArray) -> Targets:
        """Return some of the targets, with all rejected candidates."""
        if rows.all():
            return self
        of_targets = (field.name for field in fields(self) if not field.name.startswith("rejected"))
        return replace(self, **{name: getattr(self, name)[rows] for name in of_targets})

    def __repr__(self) -> str:
        coded, rejected = int((self.code >= 0).sum()), len(self.rejected_xy)
        return f"<{len(self)} targets, {coded} of them coded, {rejected} candidates rejected>"


@checked_arguments()
def find_targets(
    photograph: AnyArray,
    *,
    polarity: str = "auto",
    codes: str | TargetFamily = "none",
    centres: str = "model",
    min_diameter_px: float = 4.0,
    max_diameter_px: float = math.inf,
    hidden: BoolArray | None = None,
) -> Targets:
    """Find, measure and decode the targets of one photograph.

    Candidates are outlines of regions that differ from their local mean. Those that resemble ellipses are
    fitted with the model of a blurred ellipse; candidates that the model does not explain are rejected with a
    reason.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16.
        polarity: dark, bright or auto (both).
        codes: a name in `sfm.targets.codes.plates.FAMILIES` (arcs, ring12, ring14, ring20, none, a family
            of tags), the path of a code table, or a family such as that of a calibration plate.
        centres: method of measuring centres: model (least squares fit of a blurred ellipse, the most
            precise), edges (ellipse through the edges on rays), or the centroid with binary, intensity or
            squared weights.
        min_diameter_px: minimum minor axis of a target.
        max_diameter_px: maximum major axis of a target; infinite for the width of the photograph.
        hidden: masked pixels, which have no targets, (H, W).

    Returns:
        The targets in order of rows, and the rejected candidates.

    Raises:
        PhotographError: not a grey photograph of 8 or 16 bit.
        SurveyFileError: codes is neither a known code family nor a readable table.
        KolinearError: unknown polarity or method for centres, or impossible diameters.

    Example:
        >>> y, x = np.mgrid[:60, :80]
        >>> disc = np.clip(12.5 - np.hypot(x - 40.3, y - 29.8), 0, 1)
        >>> targets = find_targets((200 - 160 * disc).astype(np.uint8), polarity="dark")
        >>> targets
        <1 targets, 0 of them coded, 0 candidates rejected>
        >>> targets.xy.round(1), targets.semi_axes.round(1)
        (array([[40.3, 29.8]]), array([[12., 12.]]))
        >>> bool(np.sqrt(targets.covariance[0, 0, 0]) < 0.02)  # px
        True
    """
    if not isinstance(photograph, np.ndarray):
        raise PhotographError(
            f"photograph is {type(photograph).__name__}, expected an array, which read_photograph(file) gives"
        )
    if photograph.ndim != 2 or not photograph.size or photograph.dtype not in (np.uint8, np.uint16):
        raise PhotographError(
            f"photograph is {photograph.dtype} of shape {photograph.shape}, expected uint8 or uint16 (H, W)"
        )
    for name, given, known in (("polarity", polarity, tuple(SIGNS)), ("centres", centres, CENTRES)):
        if given not in known:
            raise KolinearError(f"{name} {given!r}, expected one of {', '.join(known)}")
    if not 0 < min_diameter_px < max_diameter_px:
        raise KolinearError(
            f"diameters from {min_diameter_px} to {max_diameter_px} px, expected positive ones in order"
        )
    if not isinstance(codes, str | CodeFamily | TagFamily | ConcentricFamily | PlateFamily | PlateGroup):
        raise KolinearError(f"codes {codes!r}, expected the name of a family, as 'ring14' or 'none'")
    targets = _targets_of(photograph, polarity, codes, centres, min_diameter_px, max_diameter_px, hidden)
    if hidden is None:
        return targets
    shown, rejected = is_shown(hidden, targets.xy), is_shown(hidden, targets.rejected_xy)
    return replace(
        targets.select(shown),
        rejected_xy=targets.rejected_xy[rejected],
        rejected_flag=targets.rejected_flag[rejected],
    )


def _targets_of(
    photograph: AnyArray,
    polarity: str,
    codes: str | TargetFamily,
    centres: str,
    min_diameter_px: float,
    max_diameter_px: float,
    hidden: BoolArray | None,
) -> Targets:
    """Return the targets of a photograph; the arguments are those of `find_targets`."""
    noise, scale = estimate_noise(photograph), scale_of(photograph)
    boards = [plate for plate in plates_of(codes) if plate.name in BOARDS]
    crossings = find_boards(photograph, boards, scale=scale, noise=noise) if boards else []
    parts = [
        _of_crossings(saddles, plate.first_point + number)
        for plate, (saddles, number) in zip(boards, crossings, strict=True)
    ]
    limits = {"min_diameter_px": min_diameter_px, "max_diameter_px": max_diameter_px}
    if isinstance(codes, PlateGroup):
        parts += [
            _targets_of(photograph, polarity, plate, centres, min_diameter_px, max_diameter_px, hidden)
            for plate in codes.plates
            if plate not in boards
        ]
        columns = {field.name: [getattr(part, field.name) for part in parts] for field in fields(Targets)}
        return Targets(**{name: np.concatenate(values) for name, values in columns.items()})
    if parts:
        return parts[0]
    family = codes if isinstance(codes, PlateFamily) else code_family(codes)
    outlines = find_outlines(
        photograph,
        SIGNS[polarity],
        noise=noise,
        scale=scale,
        min_diameter_px=min_diameter_px,
        max_diameter_px=max_diameter_px,
        hidden=hidden,
        reach=family.outer if isinstance(family, CodeFamily) else 1.0,
    )
    fit = fit_ellipse_model(
        photograph, outlines.xy, outlines.shape, outlines.sign, noise=noise, saturation=scale
    )
    reason = judge_fits(fit, noise=noise, scale=scale, **limits)
    code, confidence = np.full(len(reason), UNCODED), np.zeros(len(reason))
    dots = _Dots(
        photograph,
        outlines,
        fit,
        reason,
        code,
        confidence,
        ring_radius=np.zeros(len(reason)),
        polarity=polarity,
        noise=noise,
        scale=scale,
    )
    reading = next((row for kind, row in READINGS.items() if isinstance(family, kind)), _Reading())
    reading.before(family, dots)
    duplicate, off_centre = find_duplicates(fit, outlines.sign, reason, code >= 0)
    reason[duplicate] = Flag.DUPLICATE
    with_tags = reading.after(family, dots)
    grey, free = as_grey(photograph), np.flatnonzero((reason == 0) & (code < 0))
    counter = find_counters(grey, fit.xy[free], fit.shape[free], dots.levels[free])
    reason[free[counter]] = Flag.THIN_BACKGROUND.value
    xy, covariance = fit.xy, fit.covariance
    if centres == "edges":
        edges = measure_edge_ellipses(grey, fit.xy, fit.shape, outlines.sign, noise=noise)
        xy, covariance = edges.xy, edges.covariance
    elif centres != "model":
        xy, covariance = measure_centroids(
            grey, fit.xy, fit.shape, outlines.sign, noise=noise, weights=centres
        )
    if centres != "model":
        reason[(reason == 0) & np.isnan(xy[:, 0])] = Flag.NO_CONVERGENCE.value
    covariance = covariance + off_centre[:, :, None] * off_centre[:, None, :]
    keep = np.flatnonzero(reason == 0)
    keep = keep[np.lexsort((xy[keep, 0], xy[keep, 1]))]
    remark = np.where(code == UNREADABLE, fit.flag | Flag.CODE_UNREADABLE.value, fit.flag)
    semi_axes, angle = axes_from_shape(fit.shape[keep])
    targets = Targets(
        xy=xy[keep],
        covariance=covariance[keep],
        axes_covariance=axes_covariance(semi_axes, angle, fit.full_covariance[keep, 2:5, 2:5]),
        edge_covariance=fit.full_covariance[keep, 5:, 5:],
        semi_axes=semi_axes,
        angle=angle,
        code=np.where(code == UNREADABLE, UNCODED, code)[keep],
        confidence=confidence[keep],
        polarity=outlines.sign[keep],
        contrast=fit.contrast[keep],
        background=fit.background[keep],
        blur=fit.blur[keep],
        noise=fit.noise[keep],
        flag=remark[keep],
        rejected_xy=np.vstack([outlines.rejected_xy, outlines.xy[reason != 0]]),
        rejected_flag=np.concatenate([outlines.rejected_flag, reason[reason != 0]]),
    )
    return with_tags(targets)


@dataclass(frozen=True)
class _Dots:
    """The k fitted dots of a photograph, and what is known of their codes; reading changes the arrays."""

    photograph: AnyArray
    outlines: Outlines
    fit: EllipseFit
    reason: IntArray  # for their rejection, 0 for good ones, (k,)
    code: IntArray  # number of each, `UNCODED` or `UNREADABLE`, (k,)
    confidence: FloatArray  # of the code, (k,)
    ring_radius: FloatArray  # outer radius of the ring around each, in radii of the dot, 0 for none, (k,)
    polarity: str
    noise: float
    scale: float

    @property
    def levels(self) -> FloatArray:
        """Intensity of the background and its step to the dot, (k, 2)."""
        return np.column_stack([self.fit.background, self.fit.contrast])


def _read_rings(family: CodeFamily, dots: _Dots) -> None:
    """Read the rings around legible dots: a code shows that what it surrounds is a target."""
    fit, legible = dots.fit, find_legible(dots.fit, dots.reason)
    rings = read_codes(
        as_grey(dots.photograph),
        fit.xy[legible],
        fit.shape[legible],
        dots.levels[legible],
        family,
        blur_px=fit.blur[legible],
        noise=fit.noise[legible],
    )
    dots.code[legible], dots.confidence[legible] = rings.code, rings.confidence
    dots.ring_radius[legible] = rings.outer
    dots.reason[dots.code >= 0] = 0


def _without_parts_of_rings(_: CodeFamily, dots: _Dots) -> WithTags:
    good = dots.reason == 0
    dots.code[~good] = UNCODED
    parts = find_parts_of_codes(dots.fit, dots.code, dots.confidence, dots.ring_radius)
    dots.reason[good & parts] = Flag.PART_OF_CODE
    return _as_they_are


def _name_dots(plate: PlateFamily, dots: _Dots) -> WithTags:
    """Name the good dots by the points of a plate; insides of rings have the other polarity."""
    good = dots.reason == 0
    if good.any():
        semi_axes, _ = axes_from_shape(dots.fit.shape[good])
        is_ring = rings_among(dots.outlines.sign[good])
        number = name_dots(dots.fit.xy[good], np.sqrt(semi_axes.prod(axis=1)), is_ring, plate)
        dots.code[good] = np.where(number == UNCODED, UNCODED, plate.first_point + number)
    dots.confidence[dots.code >= 0] = 1.0
    dots.reason[good & (dots.code < 0)] = Flag.NOT_ON_PLATE.value
    return _as_they_are


def _read_tags(family: TagFamily, dots: _Dots) -> WithTags:
    """Read square tags, whose corners are targets; dots inside them are none."""
    tags = find_tags(dots.photograph, family, polarity=dots.polarity, scale=dots.scale)
    dots.reason[(dots.reason == 0) & inside_tags(dots.fit.xy, tags, family)] = Flag.PART_OF_CODE
    return partial(_with_corners, tags=tags)


def _read_concentric(family: ConcentricFamily, dots: _Dots) -> WithTags:
    """Read concentric tags, whose centres are targets; dots inside them are none."""
    rings = find_concentric(dots.photograph, family, dots.outlines, noise=dots.noise, scale=dots.scale)
    dots.reason[(dots.reason == 0) & rings.inside(dots.fit.xy)] = Flag.PART_OF_CODE
    return partial(_with_concentric, rings=rings)


def _of_crossings(saddles: Saddles, code: IntArray) -> Targets:
    """Return the crossings of a board as targets; attributes of circles are nan or fixed values."""
    k = len(saddles.xy)
    return Targets(
        xy=saddles.xy,
        covariance=saddles.covariance,
        axes_covariance=np.full((k, 3, 3), np.nan),
        edge_covariance=np.full((k, 3, 3), np.nan),
        semi_axes=np.full((k, 2), DRAWN_PX),
        angle=np.zeros(k),
        code=code,
        confidence=np.ones(k),
        polarity=np.ones(k, dtype=np.int64),
        contrast=saddles.contrast,
        background=np.full(k, np.nan),
        blur=saddles.blur,
        noise=np.full(k, np.nan),
        flag=np.full(k, Flag.CROSSING.value),
        rejected_xy=np.zeros((0, 2)),
        rejected_flag=np.zeros(0, dtype=np.int64),
    )


def _with_concentric(targets: Targets, rings: ConcentricTags) -> Targets:
    """Return circular targets followed by the centres of concentric tags, drawn as their outer edges."""
    if not rings.fits:
        return targets
    theta = np.array([fit.theta for fit in rings.fits])
    covariance = np.array([fit.covariance for fit in rings.fits])
    semi_axes, angle = axes_from_shape(theta[:, 2:5])
    edge = covariance[:, BACKGROUND : BLUR + 1, BACKGROUND : BLUR + 1]
    flag = np.array([fit.flag for fit in rings.fits]) | Flag.CONCENTRIC.value
    return replace(
        targets,
        xy=np.vstack([targets.xy, theta[:, :2]]),
        covariance=np.concatenate([targets.covariance, covariance[:, :2, :2]]),
        axes_covariance=np.concatenate(
            [targets.axes_covariance, axes_covariance(semi_axes, angle, covariance[:, 2:5, 2:5])]
        ),
        edge_covariance=np.concatenate([targets.edge_covariance, edge]),
        semi_axes=np.vstack([targets.semi_axes, semi_axes]),
        angle=np.append(targets.angle, angle),
        code=np.append(targets.code, rings.code),
        confidence=np.append(targets.confidence, rings.confidence),
        polarity=np.append(targets.polarity, np.sign(theta[:, CONTRAST]).astype(np.int64)),
        contrast=np.append(targets.contrast, theta[:, CONTRAST]),
        background=np.append(targets.background, theta[:, BACKGROUND]),
        blur=np.append(targets.blur, theta[:, BLUR]),
        noise=np.append(targets.noise, [fit.noise for fit in rings.fits]),
        flag=np.append(targets.flag, flag),
    )


def _with_corners(targets: Targets, tags: TagCorners) -> Targets:
    """Return circular targets followed by the corners of tags."""
    k = len(tags.xy)
    return Targets(
        xy=np.vstack([targets.xy, tags.xy]),
        covariance=np.concatenate([targets.covariance, tags.covariance]),
        axes_covariance=np.concatenate([targets.axes_covariance, np.full((k, 3, 3), np.nan)]),
        edge_covariance=np.concatenate([targets.edge_covariance, tags.edge_covariance]),
        semi_axes=np.vstack([targets.semi_axes, np.full((k, 2), DRAWN_PX)]),
        angle=np.append(targets.angle, np.zeros(k)),
        code=np.append(targets.code, tags.code),
        confidence=np.append(targets.confidence, np.ones(k)),
        polarity=np.append(targets.polarity, np.sign(tags.levels[:, 1]).astype(np.int64)),
        contrast=np.append(targets.contrast, tags.levels[:, 1]),
        background=np.append(targets.background, tags.levels[:, 0]),
        blur=np.append(targets.blur, tags.blur),
        noise=np.append(targets.noise, tags.noise),
        flag=np.append(targets.flag, tags.flag),
        rejected_xy=np.vstack([targets.rejected_xy, tags.rejected_xy]),
        rejected_flag=np.append(targets.rejected_flag, tags.rejected_flag),
    )


WithTags = Callable[[Targets], Targets]
"""returns the measured dots followed by the points that tags define"""


def _as_they_are(targets: Targets) -> Targets:
    return targets


@dataclass(frozen=True)
class _Reading:
    """How the codes of a kind of family are read."""

    before: Callable[[Any, _Dots], None] = lambda _, __: None  # before one of concentric dots is chosen
    after: Callable[[Any, _Dots], WithTags] = lambda _, __: _as_they_are  # where each dot is a target


READINGS: dict[type, _Reading] = {  # kind of family; without a row, dots have no codes
    CodeFamily: _Reading(before=_read_rings, after=_without_parts_of_rings),
    PlateFamily: _Reading(after=_name_dots),
    TagFamily: _Reading(after=_read_tags),
    ConcentricFamily: _Reading(after=_read_concentric),
}
