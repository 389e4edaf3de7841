"""Finding, measuring and decoding the circular targets of one photograph."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.kernels.options import compiled
from sfm.targets.codes.rings import UNCODED, UNREADABLE, CodeFamily, read_codes
from sfm.targets.codes.tags import DRAWN_PX, TagCorners, TagFamily, find_tags, inside_tags, target_family
from sfm.targets.counters import find_counters
from sfm.targets.flags import Flag
from sfm.targets.measure import EllipseFit, axes_from_shape, fit_ellipse_model
from sfm.targets.outlines import (
    LEAST_AXIS_RATIO,
    LEAST_STEP,
    STEP_SIGMAS,
    estimate_noise,
    find_outlines,
    scale_of,
)

# Largest RMS of the residuals and largest mean residual on an eighth of the edge, over the contrast.
POOR_FIT = 0.12
UNEVEN_EDGE = 0.18
# Largest lobes of an outline, in radii, for noise so many sigma of a component more (four of them are seen);
# only half of it where the background is a thin stroke on more than this share of the circumference.
LOBES, LOBES_SIGMAS, STROKES = 0.02, 5.0, 0.5
# Centres nearer than this share of the smaller radius belong to concentric targets.
CONCENTRIC = 0.5
# Parts of an unreadable code are smaller than this share of its dot.
PART_OF_DOT = 0.75
# Softest edge: this share of the minor semi-axis, or this blur in px where that is more.
SOFTEST_EDGE = 0.35
SOFTEST_EDGE_PX = 1.3


@dataclass(frozen=True)
class Targets:
    """The targets measured in one photograph, circles and corners of tags, and the rejected candidates."""

    xy: FloatArray
    """centres, px, (0, 0) is the centre of the top-left pixel, shape (k, 2)"""
    covariance: FloatArray
    """covariance of the centres, px^2, shape (k, 2, 2)"""
    semi_axes: FloatArray
    """major and minor semi-axis of the ellipse, px; what is drawn for a corner of a tag, shape (k, 2)"""
    angle: FloatArray
    """direction of the major axis from x (right) towards y (down), rad, shape (k,)"""
    code: IntArray
    """code number, of a corner of a tag see codes.tags.TagCorners, -1 where uncoded, shape (k,)"""
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
    codes: str | CodeFamily | TagFamily = "none",
    min_diameter_px: float = 4.0,
    max_diameter_px: float = 250.0,
) -> Targets:
    """Find, measure and decode the circular targets of one photograph.

    Candidates are the outlines of what differs from its local mean; those that resemble ellipses are fitted
    with the model of a blurred ellipse, and what the model does not explain is rejected with a reason.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16.
        polarity: dark, bright or auto (both).
        codes: arcs, ring12, ring14, ring20, none, a family of tags, the path of a code table, or a family.
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
    family = target_family(codes)
    noise, scale = estimate_noise(photograph), scale_of(photograph)
    outlines = find_outlines(
        photograph,
        signs,
        noise=noise,
        scale=scale,
        min_diameter_px=min_diameter_px,
        max_diameter_px=max_diameter_px,
    )
    fit = fit_ellipse_model(
        photograph, outlines.xy, outlines.shape, outlines.sign, noise=noise, saturation=scale
    )
    reason = _judge(fit, noise, scale, min_diameter_px, max_diameter_px)
    reason[_duplicates(fit, reason)] = Flag.DUPLICATE
    code, confidence = np.full(len(reason), UNCODED), np.zeros(len(reason))
    tags = None
    if isinstance(family, TagFamily):
        tags = find_tags(photograph, family, polarity=polarity, scale=scale)
        reason[(reason == 0) & inside_tags(fit.xy, tags, family)] = Flag.PART_OF_CODE
    good = reason == 0
    if isinstance(family, CodeFamily) and good.any():
        levels = np.column_stack([fit.background, fit.contrast])
        code[good], confidence[good] = read_codes(
            photograph, fit.xy[good], fit.shape[good], levels[good], family, blur_px=fit.blur[good]
        )
        reason[good & _inside_codes(fit, code, confidence, family)] = Flag.PART_OF_CODE
    free = np.flatnonzero((reason == 0) & (code < 0))
    levels = np.column_stack([fit.background, fit.contrast])[free]
    counter = find_counters(photograph, fit.xy[free], fit.shape[free], levels)
    reason[free[counter]] = Flag.THIN_BACKGROUND.value
    keep = np.flatnonzero(reason == 0)
    keep = keep[np.lexsort((fit.xy[keep, 0], fit.xy[keep, 1]))]
    remark = np.where(code == UNREADABLE, fit.flag | Flag.CODE_UNREADABLE.value, fit.flag)
    semi_axes, angle = axes_from_shape(fit.shape[keep])
    targets = Targets(
        xy=fit.xy[keep],
        covariance=fit.covariance[keep],
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
    return targets if tags is None else _with_corners(targets, tags)


def _with_corners(targets: Targets, tags: TagCorners) -> Targets:
    """Return circular targets and the corners of tags behind them."""
    k = len(tags.xy)
    return Targets(
        xy=np.vstack([targets.xy, tags.xy]),
        covariance=np.concatenate([targets.covariance, tags.covariance]),
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


def _judge(fit: EllipseFit, noise: float, scale: float, smallest: float, largest: float) -> IntArray:
    """Return the first reason against each fitted candidate, 0 where there is none."""
    a, b = np.full(len(fit.xy), np.nan), np.full(len(fit.xy), np.nan)
    defined = fit.shape[:, 0] * fit.shape[:, 2] > fit.shape[:, 1] ** 2
    if defined.any():
        a[defined], b[defined] = axes_from_shape(fit.shape[defined])[0].T
    contrast = np.abs(fit.contrast)
    lobes = LOBES + LOBES_SIGMAS * fit.lobes_sigma
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
            (Flag.LOBED, fit.lobes > lobes),
            (Flag.THIN_BACKGROUND, (fit.strokes > STROKES) & (fit.lobes > lobes / 2)),
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
    p, q, r = fit.shape[good].T
    radius = (p * r - q * q) ** -0.5
    order = np.argsort(fit.xy[good, 0], kind="stable")
    duplicate[good[order]] = _surrounds(fit.xy[good][order], radius[order])
    return duplicate


@compiled
def _surrounds(xy: FloatArray, radius: FloatArray) -> BoolArray:
    """Return which of the circles, in order of x, have the centre of a smaller one near their own."""
    outer = np.zeros(len(xy), dtype=np.bool_)
    widest = radius.max() if len(radius) else 0.0
    for i in range(len(xy)):
        for j in range(i + 1, len(xy)):
            if xy[j, 0] - xy[i, 0] > widest:
                break
            small, large = (i, j) if radius[i] <= radius[j] else (j, i)
            if math.hypot(xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]) < CONCENTRIC * radius[small]:
                outer[large] = True
    return outer


def _inside_codes(fit: EllipseFit, code: IntArray, confidence: FloatArray, family: CodeFamily) -> BoolArray:
    """Return which candidates lie in the code ring of another target, hence are parts of its code.

    The codes are gone through from the most confident to those that could not be read, and a part of one
    code has no say in what follows: an arc that resembles a dot does not take the dot of its own ring away.
    About a dot whose code was not read only what is clearly smaller than the dot counts.
    """
    inside = np.zeros(len(fit.xy), dtype=bool)
    size = np.sqrt(np.abs(fit.shape[:, 0] * fit.shape[:, 2] - fit.shape[:, 1] ** 2))  # 1 / mean semi-axis
    coded = np.flatnonzero(code != UNCODED)
    for k in coded[np.lexsort((size[coded], -confidence[coded], code[coded] < 0))]:
        if inside[k]:
            continue
        p, q, r = fit.shape[k]
        dx, dy = (fit.xy - fit.xy[k]).T
        rho = np.hypot(p * dx + q * dy, q * dx + r * dy)
        part = (rho > 1) & (rho < family.outer + 0.2)
        inside |= part if code[k] >= 0 else part & (size * PART_OF_DOT > size[k])
    return inside
