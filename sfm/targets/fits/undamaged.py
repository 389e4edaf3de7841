"""Fit of blurred ellipses to the undamaged parts of the targets of a photograph."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.special import ndtri

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.distributions import FAMILY
from sfm.targets.edge_rays import RAYS
from sfm.targets.fits import goodness
from sfm.targets.fits.blurred_ellipse import BLUR, CONTRAST, UNKNOWNS, P, R
from sfm.targets.fits.ellipse_fit import MIN_AGREEMENT, EllipseFits, fit_ellipses
from sfm.targets.fits.outline_noise import (
    MAD,
    MIN_POPULATION,
    OutlineNoise,
    OutlineShape,
    common_shape,
    find_damage,
    gap_shifts,
    judge_outlines,
    most_telling,
    outline_shape,
    rise_to_first,
)
from sfm.targets.outlines import Flag

# Limits of a sound target: the mean residual on an eighth of the edge over the contrast, and its contrast as
# a part of that which a tenth of the targets exceeds, since compression produces faint blobs by the hundred.
UNEVEN_EDGE, MIN_CONTRAST_SHARE = 0.18, 0.2
# Largest lobes of an outline, in radii, plus this many sigmas of a component for noise (four components are
# seen). Only half of it is permitted if the background is a thin stroke, as in letters, on this part of the
# circumference.
LOBES, LOBES_SIGMAS, STROKES = 0.02, 5.0, 0.5
# Largest RMS of the residuals over the contrast.
POOR_FIT = 0.12
# Number of rounds in which damage is searched; each fit shows more of it.
ROUNDS = 3
# Intensities are changed up to this many blurs beside damage in the edge, by up to 7 % of the step.
SKIRT_BLURS = 1.5
# Residuals larger than usual by this many robust sigmas of their logarithms over the photograph stand out.
# The scatter is at least that of the variance of 200 pixels.
POPULATION_SIGMAS, MIN_SCATTER = 5.0, 0.1
# If an edge is more curved than this, the model of its blur is not exact, and shape is not taken as damage.
MIN_CURVATURE_BLURS = 2.0
# Largest mean residual that this leaves in a square of two blurs, over the contrast: for each blur over the
# radius of curvature, and in proportion to the flattening of the ellipse. It is exact for circles. Rendered
# ellipses with a ratio of the axes of 0.26 to 0.4 and blurs of 0.77 to 3.6 px need 0.032 to 0.042.
MISFIT = 0.045
# Smaller targets have too few pixels to separate damage from another shape.
MIN_RADIUS_PX = 4.0
# Classes of size are separate if no targets lie within this of the logarithm: 15 % of the radius.
SIZE_STEP = 0.14
# Fewer targets than this are not worth a thread.
TARGETS_PER_THREAD = 100


def fit_undamaged(
    image: AnyArray, start: FloatArray, sign: IntArray, noise: float, saturation: float, least_variance: float
) -> tuple[EllipseFits, FloatArray, OutlineNoise]:
    """Fit ellipses to the undamaged parts of their edges and of their insides.

    Args:
        image: intensities, shape (H, W).
        start: x0, y0, p, q, r, shape (k, 5).
        sign: +1 bright, -1 dark target, shape (k,).
        noise: approximate standard deviation of the intensities.
        saturation: intensities from this value on are censored.
        least_variance: variance from rounding the intensities.

    Returns:
        The fits, flagged DAMAGED if something was left out and UNEVEN_EDGE if too little of the edge agrees
        with one ellipse; the variances of the intensities, shape (k,); the noise of the outlines.
    """

    def fit(begin: FloatArray, signs: IntArray, keep: BoolArray, depth: FloatArray) -> EllipseFits:
        return _fit_in_threads(image, begin, signs, noise, saturation, keep, depth)

    k = len(start)
    every = fit(start, sign, np.ones((k, RAYS), bool), np.full(k, np.inf))
    # light and compression shift edges by polarity
    alike = (np.flatnonzero(sign == polarity) for polarity in (1, -1))
    classes = [rows[of_size] for rows in alike for of_size in sizes_apart(_radii(start[rows]))]
    classes = classes or [np.zeros(0, dtype=np.int64)]
    repaired = []
    for rows in classes:
        of_class: Iterator[Any] = (part[rows] for part in every)
        repaired.append(_repaired(EllipseFits(*of_class), sign[rows], fit, noise**2, least_variance))
    back = np.argsort(np.concatenate(classes))

    def together(parts: Iterable[tuple[FloatArray | IntArray, ...]]) -> Iterator[Any]:
        return (np.concatenate(part)[back] for part in zip(*parts, strict=True))

    fits, variances, noises = zip(*repaired, strict=True)
    return (
        EllipseFits(*together(fits)),
        np.concatenate(variances)[back],
        OutlineNoise(*together(noises)),
    )


def unlike_targets(
    *,
    unevenness: FloatArray,
    lobes: FloatArray,
    lobes_sigma: FloatArray,
    strokes: FloatArray,
    noise_of_fit: FloatArray,
    contrast: FloatArray,
    noise: float,
) -> list[tuple[Flag, BoolArray]]:
    """Return the reasons why candidates are not targets, without regard to the rest of the photograph.

    Args:
        unevenness: largest mean residual on an eighth of the edge over the contrast, shape (k,).
        lobes: amplitude of harmonics 3 and 4 of the outline, radii, shape (k,).
        lobes_sigma: standard deviation of one of their components from the noise, radii, shape (k,).
        strokes: part of the circumference where the background is only a thin stroke, shape (k,).
        noise_of_fit: standard deviation of the intensities about the fit, shape (k,).
        contrast: step of intensity, positive, shape (k,).
        noise: standard deviation of the intensities of the photograph.

    Returns:
        Each reason with a mask of the candidates that it rejects, shape (k,).
    """
    limit = LOBES + LOBES_SIGMAS * lobes_sigma
    return [
        (Flag.UNEVEN_EDGE, unevenness > UNEVEN_EDGE + 3 * noise / contrast),
        (Flag.LOBED, lobes > limit),
        (Flag.THIN_BACKGROUND, (strokes > STROKES) & (lobes > limit / 2)),
        (Flag.POOR_FIT, noise_of_fit / contrast > POOR_FIT + noise / contrast),
    ]


def sizes_apart(radius: FloatArray) -> list[IntArray]:
    """Return targets in classes of size separated by gaps, such as letters and targets on one sheet.

    The effect of blur, sharpening and compression on an outline depends on its size. Targets of one make
    differ continuously in size by perspective. A class too small to be a population joins its nearest
    neighbour.

    Args:
        radius: radii of the targets, px, shape (k,).
    """
    order = np.argsort(radius, kind="stable")
    log = np.log(np.maximum(radius[order], 1e-6))
    classes = [part for part in np.split(order, np.flatnonzero(np.diff(log) > SIZE_STEP) + 1) if len(part)]
    while len(classes) > 1:
        small = min(range(len(classes)), key=lambda c: len(classes[c]))
        if len(classes[small]) >= MIN_POPULATION:
            break
        middle = [float(np.median(np.log(radius[rows]))) for rows in classes]
        beside = [c for c in (small - 1, small + 1) if 0 <= c < len(classes)]
        other = min(beside, key=lambda c: abs(middle[c] - middle[small]))
        low, high = min(small, other), max(small, other)
        classes[low : high + 1] = [np.concatenate([classes[low], classes[high]])]
    return classes


def _repaired(
    fits: EllipseFits,
    sign: IntArray,
    fit: Callable[[FloatArray, IntArray, BoolArray, FloatArray], EllipseFits],
    variance_of_noise: float,
    least_variance: float,
) -> tuple[EllipseFits, FloatArray, OutlineNoise]:
    """Return the fits of targets of about one size without damage, variances, and the noise of outlines.

    Args:
        fits: fits of whole targets, which are changed.
        sign: +1 bright, -1 dark target, shape (k,).
        fit: fits targets from start values, with the sectors and depths that take part.
        variance_of_noise: approximate variance of the intensities.
        least_variance: variance from rounding the intensities.
    """
    k = len(sign)
    keep, depth = np.ones((k, RAYS), bool), np.full(k, np.inf)
    judged = _least_curvature(fits.theta) > MIN_CURVATURE_BLURS * fits.theta[:, BLUR]
    usual: list[FloatArray] = []
    for _ in range(ROUNDS):
        seen = _deviations(fits, keep, variance_of_noise + least_variance, least_variance)
        weight, sound = seen.weight, seen.sound
        # Those of whole targets: a cross in the middle of every dot is usual, though most are left out.
        usual = usual or [values[sound] for values in _unexplained(fits, sound, least_variance)]
        skirt = np.ceil(SKIRT_BLURS * fits.theta[:, BLUR] * RAYS / (2 * math.pi * _radii(fits.theta)))
        damaged = find_damage(seen.h, weight, sound, skirt)
        shallow = goodness.HALO_PX + goodness.EDGE_ENDS_BLURS * fits.theta[:, BLUR]
        deep = np.isinf(depth) & (shallow < _radii(fits.theta))
        deep &= _has_marks_inside(fits, sound)
        damaged &= judged[:, None]
        again = weight.any(axis=1) & ((damaged == keep).any(axis=1) | deep)
        if not again.any():
            break
        keep[again] = ~damaged[again]
        depth[again & deep] = shallow[again & deep]
        begin = fits.theta[again, : R + 1]
        repaired = fit(begin, sign[again], keep[again], depth[again])
        for of_all, part in zip(fits, repaired, strict=True):
            of_all[again] = part
    else:  # the last fits have not been looked at
        seen = _deviations(fits, keep, variance_of_noise + least_variance, least_variance)
    weight, sound, telling = seen.weight, seen.sound, seen.telling
    cut = ~keep.all(axis=1)
    small = _radii(fits.theta) < MIN_RADIUS_PX
    fits.flag[cut | np.isfinite(depth)] |= Flag.DAMAGED.value
    fits.flag[(keep.mean(axis=1) < MIN_AGREEMENT) | (cut & small)] |= Flag.UNEVEN_EDGE.value
    variance = _variances(fits, least_variance)
    if sound.sum() >= MIN_POPULATION:
        unexplained = _unexplained(fits, sound, least_variance)
        more, relative, marks = (
            _stands_out(values, values[sound]) & _stands_out(values, before)
            for values, before in zip(unexplained, usual, strict=True)
        )
        marks &= (unexplained[2] > 1) & np.isinf(depth)
        fits.flag[((more & relative & judged) | marks) & weight.any(axis=1)] |= Flag.POOR_FIT.value
    shift = gap_shifts(seen.common, weight, keep)
    p, q, r = fits.theta[:, P : R + 1].T
    with np.errstate(divide="ignore", invalid="ignore"):
        px = np.array([r * shift[:, 0] - q * shift[:, 1], p * shift[:, 1] - q * shift[:, 0]]) / (
            p * r - q * q
        )
    fits.theta[cut, :2] -= px.T[cut]
    # A mark inside that was left out may reach the edge, where it pulls the centre as far as it stands out.
    rest = np.where(np.isfinite(depth), np.maximum(_marks(fits, goodness.TOGETHER, sound), 1.0), 1.0)
    softness = fits.theta[:, BLUR] / _radii(fits.theta)
    usual_softness = float(np.median(softness[telling])) if telling.any() else 0.0
    rise = rise_to_first(seen.h[telling], weight[telling], usual_softness)
    noise = judge_outlines(seen.outlines, variance, telling, softness, rise)
    return fits, variance, noise._replace(factor=noise.factor * rest**2)


def _variances(fits: EllipseFits, least: float) -> FloatArray:
    """Return the variances of the intensities about the fits, shape (k,)."""
    squares, pixels = fits.statistics[:, goodness.SQUARES], fits.statistics[:, goodness.PIXELS]
    return np.asarray(np.maximum(squares / np.maximum(pixels - UNKNOWNS, 1), least))


class _Deviations(NamedTuple):
    """Outlines of targets, and which of them are usual."""

    h: FloatArray  # deviation in each sector without the common shape, radii, (k, RAYS)
    weight: FloatArray  # of each deviation, (k, RAYS)
    common: FloatArray  # common shape, radii, (RAYS,)
    sound: BoolArray  # targets that are not unlike targets, (k,)
    telling: BoolArray  # those of them that tell what an outline is, (k,)
    outlines: OutlineShape


def _deviations(
    fits: EllipseFits, keep: BoolArray, variance_of_noise: float, least_variance: float
) -> _Deviations:
    """Return the deviations of outlines.

    Damage that was not left out increases the variance of a target; the variance is therefore limited to the
    usual one.
    """
    fitted, contrast = np.isfinite(fits.cofactor[:, 0, 0]), np.abs(fits.theta[:, CONTRAST])
    variance = _variances(fits, least_variance)
    outlines, noise = outline_shape(fits.shape), math.sqrt(variance_of_noise)
    with np.errstate(divide="ignore", invalid="ignore"):
        against = unlike_targets(
            unevenness=fits.statistics[:, goodness.UNEVENNESS],
            lobes=outlines.lobes,
            lobes_sigma=noise * np.sqrt(outlines.lobes_cofactor),
            strokes=fits.statistics[:, goodness.STROKES],
            noise_of_fit=np.sqrt(variance),
            contrast=contrast,
            noise=noise,
        )
    sound = fitted & keep.all(axis=1) & ~np.any([unlike for _, unlike in against], axis=0)
    if fitted.any():
        sound &= contrast > MIN_CONTRAST_SHARE * np.percentile(contrast[fitted], 90)
    squares = fits.sectors[:, 1]
    # of deviations in px, for a px of the edge: a large outline tells no more than a small one seen as well
    of_edge = squares.sum(axis=1) / np.maximum(_radii(fits.theta), 1.0) ** 3
    telling = most_telling(sound, of_edge / np.maximum(variance, max(variance_of_noise, 1e-12)))
    if sound.sum() >= MIN_POPULATION:
        variance = np.minimum(variance, np.median(variance[sound] / contrast[sound] ** 2) * contrast**2)
    variance = np.maximum(variance, variance_of_noise)
    weight = np.where(fitted[:, None], squares / np.maximum(variance, 1e-12)[:, None], 0.0)
    h = np.divide(fits.sectors[:, 0], squares, out=np.zeros_like(squares), where=weight > 0)
    common = common_shape(h, weight, telling)
    return _Deviations(h - common, weight, common, sound, telling, outlines)


def _unexplained(
    fits: EllipseFits, sound: BoolArray, least_variance: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return variances of the intensities, also over the square of the contrasts, and marks, shape (k,)."""
    variance, contrast = _variances(fits, least_variance), np.abs(fits.theta[:, CONTRAST])
    return variance, variance / np.maximum(contrast, 1e-9) ** 2, _marks(fits, goodness.TOGETHER, sound)


def _has_marks_inside(fits: EllipseFits, sound: BoolArray) -> BoolArray:
    """Return where adjacent residuals inside are significant and larger than in sound targets, shape (k,).

    If most targets have marks, as glare on each of them, these are usual. Therefore a significant mark also
    counts if it differs from the model by more than the residuals of any target may: spots of 0.2 to 0.5
    radii differ by 0.13 to 0.27 contrasts, undamaged rendered dots after compression to JPEG 60 by up to
    0.06, after sharpening by 0.11.
    """
    marks = _marks(fits, goodness.INSIDE, sound)
    side, contrast = np.maximum(2, np.round(2 * fits.theta[:, BLUR])), np.abs(fits.theta[:, CONTRAST])
    large = fits.statistics[:, goodness.INSIDE] > POOR_FIT * side * contrast
    large &= not sound.any() or bool(np.median(marks[sound]) > 1)
    return np.asarray((marks > 1) & (large | _stands_out(marks, marks[sound])))


def _marks(fits: EllipseFits, column: int, sound: BoolArray) -> FloatArray:
    """Return the largest sums of adjacent residuals in units of the significant ones, shape (k,).

    The level is divided by the number of squares of one blur in all targets. Misfits of the model do not
    count. The usual spread is that of most targets: damage increases that of a target, compression reduces it
    locally.
    """
    blur, contrast = np.maximum(fits.theta[:, BLUR], 1.0), np.maximum(np.abs(fits.theta[:, CONTRAST]), 1e-9)
    spread = fits.statistics[:, goodness.SPREAD]
    if sound.sum() >= MIN_POPULATION:
        spread = np.maximum(np.median(spread[sound] / contrast[sound]) * contrast, goodness.ROUNDING)
    lacking = _model_misfit(fits.theta) * contrast * 2 * blur
    marks = np.maximum((fits.statistics[:, column] - lacking) / spread, 1.0)
    squares = (fits.statistics[:, goodness.PIXELS] / blur**2).sum()
    return np.asarray(marks / -ndtri(FAMILY / (2 * max(squares, 1.0))))


def _model_misfit(theta: FloatArray) -> FloatArray:
    """Return the largest mean residual of undamaged ellipses in a square of two blurs, in contrasts, (k,)."""
    p, q, r = theta[:, P : R + 1].T
    mean, half = (p + r) / 2, np.hypot((p - r) / 2, q)
    flattened = 2 * half / np.maximum(mean + half, 1e-12)
    return np.asarray(MISFIT * flattened * theta[:, BLUR] / np.maximum(_least_curvature(theta), 1e-12))


def _stands_out(value: FloatArray, usual: FloatArray) -> BoolArray:
    """Return which positive values exceed those of sound targets significantly, by logarithms, (k,)."""
    if len(usual) < MIN_POPULATION:
        return np.ones(len(value), bool)
    z, middle = np.log(np.maximum(value, 1e-12)), np.log(np.maximum(usual, 1e-12))
    z -= np.median(middle)
    scatter = MAD * np.median(np.abs(middle - np.median(middle)))
    return np.asarray(z > POPULATION_SIGMAS * np.maximum(scatter, MIN_SCATTER))


def _radii(theta: FloatArray) -> FloatArray:
    """Return the mean radii of ellipses, px, shape (k,)."""
    p, q, r = theta[:, P : R + 1].T
    return np.asarray(np.maximum(np.abs(p * r - q * q), 1e-12) ** -0.5)


def _least_curvature(theta: FloatArray) -> FloatArray:
    """Return the smallest radius of curvature of ellipses, at the ends of their long axes, px, (k,)."""
    p, q, r = theta[:, P : R + 1].T
    mean, half = (p + r) / 2, np.hypot((p - r) / 2, q)
    return np.asarray((mean - half) / np.maximum(mean + half, 1e-12) ** 2)


def _fit_in_threads(
    image: AnyArray,
    start: FloatArray,
    sign: IntArray,
    noise: float,
    saturation: float,
    keep: BoolArray,
    depth: FloatArray,
) -> EllipseFits:
    """Fit the ellipses in as many threads as OpenCV may use; the results do not depend on their number."""
    parts = max(1, min(cv2.getNumThreads(), len(start) // TARGETS_PER_THREAD))
    if parts == 1:
        return fit_ellipses(image, start, sign, noise, saturation, keep, depth)
    chunks = np.array_split(np.arange(len(start)), parts)
    with ThreadPoolExecutor(parts) as pool:
        fits = pool.map(
            lambda c: fit_ellipses(image, start[c], sign[c], noise, saturation, keep[c], depth[c]), chunks
        )
        return EllipseFits(*(np.concatenate(part) for part in zip(*fits, strict=True)))
