"""Measurement of circular targets by blurred ellipses, and rejection of other candidates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled
from sfm.runtime.sampling import as_grey, bilinear
from sfm.targets.codes.rings import UNCODED
from sfm.targets.edge_rays import RAYS
from sfm.targets.fits import goodness
from sfm.targets.fits.blurred_ellipse import BACKGROUND, BLUR, CONTRAST, GAIN_X, UNKNOWNS, P, R
from sfm.targets.fits.outline_noise import outline_shape
from sfm.targets.fits.undamaged import MIN_RADIUS_PX, fit_undamaged, unlike_targets
from sfm.targets.outlines import MIN_AXIS_RATIO, MIN_STEP, STEP_SIGMAS, Flag

# Reasons that concern the shape of a candidate and not damage.
SHAPE_REASONS = (Flag.LOBED, Flag.THIN_BACKGROUND, Flag.POOR_FIT)
# Centres nearer than this part of the smaller radius belong to concentric targets.
MAX_CENTRE_FRACTION = 0.5
# The centres of a ring are within this part of the radius, for perspective, plus this many sigmas.
ECCENTRIC, ECCENTRIC_SIGMAS = 0.02, 5.0
# Parts of an unreadable code are smaller than this part of its dot.
PART_OF_DOT = 0.75
# Softest edge: this part of the minor semi-axis, or this blur in px if it is larger. Rendered dots of 8 to
# 50 px have errors of 0.7 to 1.1 stated sigmas up to it; photographs without targets (berlin, fountain, fox)
# show no more candidates at 0.6 than at 0.35.
SOFTEST_EDGE, SOFTEST_EDGE_PX = 0.5, 1.3
BLUR_SIGMAS = 3.0  # beyond which an edge is certainly softer: one in 700 targets that are exactly as soft
# Part of the rays on which a stroke must end, and on which another object begins behind it. No ring of up to
# 20 cells is set on so much of the circumference: even parity leaves at least two cells clear.
CLOSED, CROWDED = 0.95, 0.08
# Minimum median and maximum width of the stroke, in radii of the counter; rims of the retro-panel reach 0.46.
MIN_STROKE, MAX_STROKE = 0.5, 1.75
# The outline of a label is within this part of its radius, or this many px, of a circle on CLOSED of the rays
# (the stem of a round b or d takes three), or of a rectangle on this part of them, since blur rounds corners.
# Of 1,795 rendered labels between others (round, square and 3:2, rims of 0.3 to 1.2 radii, 10 to 60 px, tilts
# to 60 degrees, blurs to 2 px) 98 % do; of 484 counters of letters of the faces DejaVu and Hershey
# none does; a geometric face has round ones.
OUTLINE_FRACTION, OUTLINE_PX, ON_RECTANGLE = 0.05, 0.4, 0.875
# Directions that are tried for the sides of a rectangle, and the angle from their normals, rad, to which rays
# hit them if the sides differ by less than 1 to 2.4.
TURNS, BESIDE_NORMAL = 24, math.pi / 8
# Letters of one size have counters that differ by up to this factor (o and e of one face: 1.3).
LETTERS_ALIKE = 1.5
# Distance behind a stroke in which neighbours are searched, radii; brightness, in contrasts, that is glare.
NEIGHBOURS, GLARE = 2.0, 1.5
_STEP_PX, _RISE_PX = 0.5, 3.0
# Variance of rounding to integer intensities.
QUANTISATION = 1 / 12
# Number of targets from which the shading of a photograph is estimated from them. A target whose gain differs
# from it by more than this many sigmas is not shrunk.
MIN_FOR_SHADING, OWN_GAIN_SIGMAS = 10, 3.0
# A halo exceeds this part of the contrast (9 of 10 of the retro-panel are below) and this many of its sigmas.
# Flare means a background of which more than this part is saturated, that has glare behind it on more than
# this part of the circumference, or that changes by more than this part of the contrast.
HALO, HALO_SIGMAS, FLARE_SATURATED, FLARE_AROUND, FLARE_CHANGE = 0.035, 5.0, 0.02, 0.25, 0.25
# A gain per px below this counts as zero.
NO_GAIN = 1e-7


@dataclass(frozen=True)
class EllipseFit:
    """Blurred ellipses fitted to the targets of one photograph."""

    xy: FloatArray
    """centres, px, shape (k, 2)"""
    full_covariance: FloatArray
    """covariance of centre, shape, background, contrast and blur in this order from the fit, its
    residuals and the outlines of the photograph, nan if the fit failed, shape (k, 8, 8)"""
    shape: FloatArray
    """(p, q, r) of S, which turns image vectors into radii, 1/px, shape (k, 3)"""
    background: FloatArray
    """intensity B around the target, shape (k,)"""
    contrast: FloatArray
    """step of intensity A from background to target, positive for bright targets, shape (k,)"""
    blur: FloatArray
    """standard deviation s of the edge, including the pixel box, px, shape (k,)"""
    gain: FloatArray
    """relative change of the intensity per px in x and y, shape (k, 2)"""
    noise: FloatArray
    """standard deviation of the intensities about the fit, shape (k,)"""
    unevenness: FloatArray
    """largest mean residual over one eighth of the edge, relative to the contrast, shape (k,)"""
    lobes: FloatArray
    """amplitude of the third and fourth harmonic of the outline about the ellipse, radii, shape (k,)"""
    lobes_sigma: FloatArray
    """standard deviation of one of their components from the given noise, radii, shape (k,)"""
    strokes: FloatArray
    """part of the circumference where the background is only a thin stroke, shape (k,)"""
    pixels: IntArray
    """number of intensities in the fit, shape (k,)"""
    iterations: IntArray
    """number of steps, shape (k,)"""
    flag: IntArray
    """remarks and reasons for failure, see Flag, shape (k,)"""

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the centres, px^2, shape (k, 2, 2)."""
        return self.full_covariance[:, :2, :2]


def fit_ellipse_model(
    photograph: AnyArray,
    xy: FloatArray,
    shape: FloatArray,
    sign: IntArray,
    *,
    noise: float = 1.0,
    saturation: float | None = None,
) -> EllipseFit:
    """Fit the model of a blurred ellipse to every target, starting from approximate outlines.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16 or float32.
        xy: approximate centres, px, shape (k, 2).
        shape: approximate (p, q, r) of S, 1/px, shape (k, 3).
        sign: +1 for a target brighter than its surroundings, -1 for a darker one, shape (k,).
        noise: approximate standard deviation of the intensities; decides what counts as a disturbance.
        saturation: intensities from this value on are censored; None for the end of the integer scale.

    Returns:
        The fits; if `flag` is NO_CONVERGENCE or CUT_BY_BORDER the values are the last ones reached.

    Source: Gauss-Markov model with Levenberg-Marquardt steps; Ahn, Rauh, Kim, "Circular coded target for
    automation of optical 3D-measurement" (1997), for the least squares template of an ellipse.
    """
    integers = photograph.dtype.kind == "u"
    if saturation is None:
        saturation = float(np.iinfo(photograph.dtype).max) if integers else math.inf
    k = len(xy)
    start = np.column_stack([np.asarray(xy, float).reshape(k, 2), np.asarray(shape, float).reshape(k, 3)])
    least_variance = QUANTISATION if integers else 0.0
    fits, variance, outlines = fit_undamaged(
        as_grey(photograph),
        start,
        np.asarray(sign, np.int64),
        float(noise),
        float(saturation),
        least_variance,
    )
    theta, cofactor, statistics, flag = fits[:4]
    harmonics = outline_shape(fits.shape)
    columns = statistics.T
    covariance = np.full((k, GAIN_X, GAIN_X), np.nan)
    failed = Flag.NO_CONVERGENCE | Flag.CUT_BY_BORDER | Flag.NOT_ELLIPTIC
    good = np.flatnonzero((flag & failed) == 0)
    if len(good):
        theta[good], covariance[good], shaded = _shrink_gain(
            theta[good], cofactor[good], variance[good], columns[goodness.LENGTH][good]
        )
        flag[good[shaded]] |= Flag.SHADED.value
        covariance[good] *= outlines.factor[good, None, None]
        covariance[good, :2, :2] += outlines.gap_covariance[good]
    gain = theta[:, GAIN_X:] / columns[goodness.LENGTH][:, None]
    halo = columns[goodness.HALO]
    flag[(halo > HALO) & (halo > HALO_SIGMAS * columns[goodness.HALO_SIGMA])] |= Flag.HALO.value
    glare = (columns[goodness.SATURATED] > FLARE_SATURATED) | (columns[goodness.GLARING] > FLARE_AROUND)
    p, q, r, B, A = theta[:, 2:7].T
    with np.errstate(divide="ignore", invalid="ignore"):  # of the background across the target
        change = 2 * np.abs(p * r - q * q) ** -0.5 * np.abs(B) * np.hypot(*gain.T)
        changes = change > FLARE_CHANGE * np.abs(A)
    flag[glare | changes] |= Flag.FLARE.value
    return EllipseFit(
        xy=theta[:, :2],
        full_covariance=covariance,
        shape=theta[:, P : R + 1],
        background=theta[:, BACKGROUND],
        contrast=theta[:, CONTRAST],
        blur=theta[:, BLUR],
        gain=gain,
        noise=np.sqrt(variance),
        unevenness=columns[goodness.UNEVENNESS],
        lobes=harmonics.lobes,
        lobes_sigma=noise * np.sqrt(harmonics.lobes_cofactor),
        strokes=columns[goodness.STROKES],
        pixels=columns[goodness.PIXELS].astype(np.int64),
        iterations=columns[goodness.STEPS].astype(np.int64),
        flag=flag,
    )


def _shrink_gain(
    theta: FloatArray, cofactor: FloatArray, variance: FloatArray, length: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Use the shading that the targets of a photograph show together as a prior for each target.

    A gradient of the gain inside a target and a shift of its centre look alike, so estimating the gain costs
    up to a third of the precision of a bright target. The variance tau^2 of the gains over the targets is
    estimated (minus that of their errors, weighted). "gain = 0 with variance tau^2" is then added to each
    target as an observation. Without shading this is the fit without gain, with shading the fit with it.

    Source: DerSimonian and Laird (1986), moment estimate of the variance between units; empirical Bayes.

    Returns:
        Unknowns, (k, 10); covariance of all except the gains, (k, 8, 8); which gains differ from zero.
    """
    gains = slice(GAIN_X, UNKNOWNS)
    gain = theta[:, gains] / length[:, None]
    gain_variance = (variance / length**2)[:, None] * np.diagonal(cofactor, axis1=1, axis2=2)[:, gains]
    shaded = np.any(gain**2 > OWN_GAIN_SIGMAS**2 * gain_variance, axis=1)
    if len(theta) >= MIN_FOR_SHADING:
        w = gain_variance**-2
        tau2 = max(float((w * (gain**2 - gain_variance)).sum() / w.sum()), NO_GAIN**2)
        distinct = np.any(gain**2 > OWN_GAIN_SIGMAS**2 * (gain_variance + tau2), axis=1)
        prior = (tau2 * length**2 / variance)[:, None, None] * np.eye(2)
        K = cofactor[:, :, gains] @ np.linalg.inv(prior + cofactor[:, gains, gains])
        K[distinct] = 0.0
        theta = theta - np.einsum("kij,kj->ki", K, theta[:, gains])
        cofactor = cofactor - K @ cofactor[:, gains]
    return theta, variance[:, None, None] * cofactor[:, :GAIN_X, :GAIN_X], shaded


def axes_from_shape(shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return semi-axes (major, minor), px, shape (k, 2), and the angle of the major axis, rad, shape (k,).

    The angle runs from x (right) to y (down), from -pi/2 to pi/2.
    """
    p, q, r = np.asarray(shape, dtype=float).T
    mean, half = (p + r) / 2, np.hypot((p - r) / 2, q)
    angle = 0.5 * np.arctan2(2 * q, p - r) + math.pi / 2  # the small eigenvalue of S belongs to the long axis
    angle = (angle + math.pi / 2) % math.pi - math.pi / 2
    return np.column_stack([1 / (mean - half), 1 / (mean + half)]), angle


def axes_covariance(semi_axes: FloatArray, angle: FloatArray, shape_covariance: FloatArray) -> FloatArray:
    """Return the covariance of semi-axes and angle from that of (p, q, r).

    Args:
        semi_axes: major and minor semi-axis, px, shape (k, 2).
        angle: direction of the major axis, rad, shape (k,).
        shape_covariance: covariance of (p, q, r), 1/px^2, shape (k, 3, 3).

    Returns:
        Covariance of (major, minor, angle), px and rad, shape (k, 3, 3); the angle of a circle has none.
    """
    major, minor = semi_axes.T
    c, s = np.cos(angle), np.sin(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = 1 / (1 / major - 1 / minor)  # d angle = u2' dS u1 / (l1 - l2) with eigenvectors u of S
        rows = np.array(
            [
                [-(major**2) * c * c, -2 * major**2 * c * s, -(major**2) * s * s],
                [-(minor**2) * s * s, 2 * minor**2 * c * s, -(minor**2) * c * c],
                [-turn * c * s, turn * (c * c - s * s), turn * c * s],
            ]
        )
        J = np.moveaxis(rows, -1, 0)
        return np.asarray(J @ shape_covariance @ np.swapaxes(J, 1, 2))


def shape_from_axes(semi_axes: FloatArray, angle: FloatArray) -> FloatArray:
    """Return (p, q, r) of S, shape (k, 3), of ellipses with semi-axes (k, 2) in px and angle (k,) in rad."""
    a, b = 1 / np.asarray(semi_axes, dtype=float).reshape(-1, 2).T
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c])


def judge_fits(
    fit: EllipseFit, *, noise: float, scale: float, min_diameter_px: float, max_diameter_px: float
) -> IntArray:
    """Return the first reason for rejecting each fitted candidate.

    Args:
        fit: fits of the candidates.
        noise: standard deviation of the intensities of the photograph.
        scale: largest intensity that the photograph can represent.
        min_diameter_px: minimum minor axis of a target.
        max_diameter_px: maximum major axis of a target.

    Returns:
        Flags, see `sfm.targets.outlines.Flag`, 0 for an accepted candidate, shape (k,).
    """
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
            (Flag.TOO_SMALL, ~(2 * b >= min_diameter_px)),
            (Flag.TOO_LARGE, ~(2 * a <= max_diameter_px)),
            (Flag.TOO_OBLIQUE, b / a < MIN_AXIS_RATIO),
            (Flag.LOW_CONTRAST, contrast < np.maximum(STEP_SIGMAS * noise, MIN_STEP * scale)),
            (
                Flag.BLURRED,
                fit.blur - BLUR_SIGMAS * np.sqrt(fit.full_covariance[:, BLUR, BLUR])
                > np.maximum(SOFTEST_EDGE * b, SOFTEST_EDGE_PX),
            ),
            *unlike_targets(
                unevenness=fit.unevenness,
                lobes=fit.lobes,
                lobes_sigma=fit.lobes_sigma,
                strokes=fit.strokes,
                noise_of_fit=fit.noise,
                contrast=contrast,
                noise=noise,
            ),
            (Flag.UNEVEN_EDGE, (fit.flag & Flag.UNEVEN_EDGE) != 0),
            (Flag.POOR_FIT, (fit.flag & Flag.POOR_FIT) != 0),
        ]
    reason = np.zeros(len(fit.xy), dtype=np.int64)
    for flag, against in tests:
        reason[(reason == 0) & against] = flag.value
    return reason


def find_legible(fit: EllipseFit, reason: IntArray) -> BoolArray:
    """Return which candidates are targets if a code is read around them, shape (k,).

    They are the good candidates and those rejected only for their shape. A dot with a hole, a sharpened dot
    or one made of screen pixels does not resemble a blurred ellipse, but no letter has a code around it. A
    code does not excuse an edge that is missing or damaged, nor a blob too small to show a shape.
    """
    damaged = (fit.flag & (Flag.UNEVEN_EDGE | Flag.POOR_FIT)) != 0
    p, q, r = fit.shape.T
    shown = np.abs(p * r - q * q) * MIN_RADIUS_PX**2 < 1
    return np.asarray((reason == 0) | (np.isin(reason, SHAPE_REASONS) & ~damaged & shown))


def find_duplicates(
    fit: EllipseFit, sign: IntArray, reason: IntArray, coded: BoolArray
) -> tuple[BoolArray, FloatArray]:
    """Return which good candidates are not targets because of what is around or inside them.

    Also return by how much holes are farther from the centres of their surroundings than perspective
    explains, (k, 2).

    Among concentric ellipses the one with a code is kept, or else the smallest: a retro-reflective dot with
    a dark rim in glare appears as a bright dot and, larger, as the dark rim. A candidate inside another, not
    shown to be concentric, and of the minority polarity in the photograph, is a stain.
    """
    duplicate, off_centre = np.zeros(len(fit.xy), dtype=bool), np.zeros((len(fit.xy), 2))
    p, q, r = fit.shape.T
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.abs(p * r - q * q) ** -0.5
        sigma = np.sqrt(np.trace(fit.covariance, axis1=1, axis2=2))
    good = np.flatnonzero(reason == 0)
    usual = 1 if (sign[good] > 0).sum() > len(good) / 2 else -1
    typical = np.median(sigma[good]) if len(good) else 0.0
    seen = np.flatnonzero((reason == 0) | (np.isfinite(sigma) & (sign == usual)))
    order = seen[np.argsort(fit.xy[seen, 0], kind="stable")]
    widest = radius[order].max() if len(order) else 0.0
    x = fit.xy[order, 0]
    for i in good:
        near = order[
            np.searchsorted(x, x_i := fit.xy[i, 0] - widest) : np.searchsorted(x, x_i + 2 * widest, "right")
        ]
        distance = np.hypot(*(fit.xy[near] - fit.xy[i]).T)
        larger = (near != i) & ((radius[near] > radius[i]) | ((radius[near] == radius[i]) & (near > i)))
        smaller = (
            (near != i) & ~larger & (reason[near] == 0) & (distance < MAX_CENTRE_FRACTION * radius[near])
        )
        smaller &= coded[near] | ~coded[i]
        inner = np.where(larger, i, near)
        tolerance = ECCENTRIC_SIGMAS * (sigma[inner] + typical)
        apart = distance > ECCENTRIC * radius[inner] + tolerance
        apart |= tolerance > MAX_CENTRE_FRACTION * radius[inner]
        stained = larger & (distance < radius[near]) & apart & (sign[near] == usual)
        if sign[i] != usual:
            duplicate[i] = stained.any()
            about = near[larger & (sign[near] == usual) & (distance < radius[near]) & ~coded[i]]
            if len(about):
                shift = fit.xy[i] - fit.xy[about[radius[about].argmin()]]
                off_centre[i] = shift * max(0.0, 1 - ECCENTRIC * radius[i] / max(np.hypot(*shift), 1e-9))
        duplicate[i] |= (smaller & ~(apart & (sign[near] != usual) & (sign[i] == usual))).any()
        within = larger & coded[near] & ~coded[i] & (reason[near] == 0)
        duplicate[i] |= (within & (distance < MAX_CENTRE_FRACTION * radius[i])).any()
    return duplicate, off_centre


def find_parts_of_codes(
    fit: EllipseFit, code: IntArray, confidence: FloatArray, ring_radius: FloatArray
) -> BoolArray:
    """Return which candidates lie in the code ring of another target and are therefore parts of its code.

    Codes are processed from the most confident to those that could not be read, and a part of one code does
    not count afterwards: an arc that resembles a dot does not remove the dot of the same ring. Around a dot
    whose code was not read, only candidates clearly smaller than the dot are parts.

    Args:
        fit: fits of the candidates.
        code: codes, see `sfm.targets.codes.rings.RingCodes`, shape (k,).
        confidence: of the codes, 0 to 1, shape (k,).
        ring_radius: outer radius of the ring in radii of the dot, shape (k,).
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
        part = (rho > 1) & (rho < ring_radius[k] + 0.2)
        inside |= part if code[k] >= 0 else part & (size * PART_OF_DOT > size[k])
    return inside


def find_counters(image: AnyArray, xy: FloatArray, shape: FloatArray, levels: FloatArray) -> BoolArray:
    """Return which candidates are counters: the white inside of letters such as o, e and 8.

    A counter looks like a target on the stroke of the letter. Its background is a closed stroke, behind which
    the paper begins again, and next to a letter there are others. A target with a dark rim differs: its rim
    is thinner than half its radius, the surroundings of the rim are free, or the rim ends in the outline of a
    label, which is a circle or a rectangle about the target where the target is a circle. A dot in the ring
    of a code differs as well, since the ring always has clear cells.

    Letters of geometric faces have round rims too, but are among letters of their size that have none.

    Args:
        image: intensities, shape (H, W).
        xy: centres, px, shape (k, 2).
        shape: (p, q, r) of S, 1/px, shape (k, 3).
        levels: intensity of the background and its step to the target, shape (k, 2).

    Returns:
        Which candidates are counters, shape (k,).
    """
    radius, width, end, behind = np.moveaxis(_trace_strokes(image, xy, shape, levels), 2, 0)
    ends = width <= MAX_STROKE * radius
    closed = ends.mean(axis=1) >= CLOSED
    wide = (ends & (width >= MIN_STROKE * radius)).mean(axis=1) >= 0.5
    enclosed = np.flatnonzero(closed & wide & (behind.mean(axis=1) >= CROWDED))
    labelled = np.array([_is_label(end[k] / radius[k], radius[k]) for k in enclosed], dtype=bool)
    size = np.log(radius[enclosed]).mean(axis=1)
    order = np.argsort(size)
    sorted_size, labels = size[order], np.concatenate([[0], np.cumsum(labelled[order])])
    first = np.searchsorted(sorted_size, size - math.log(LETTERS_ALIKE))
    last = np.searchsorted(sorted_size, size + math.log(LETTERS_ALIKE), "right")
    counter = np.zeros(len(xy), dtype=bool)
    counter[enclosed] = ~labelled | (labels[last] - labels[first] <= (last - first) / 2)
    return counter


def _is_label(outline: FloatArray, radius: FloatArray) -> bool:
    """Return whether an outline about a target is that of a round or rectangular label.

    Args:
        outline: radii of the outline in radii of the target, on rays at equal angles where the target is a
            circle, shape (RAYS,).
        radius: radius of the target on the same rays, px, shape (RAYS,).
    """
    tolerance = np.maximum(OUTLINE_FRACTION * outline, OUTLINE_PX / radius)
    ends = np.isfinite(outline)
    if (ends & (np.abs(outline - np.median(outline)) <= tolerance)).mean() >= CLOSED:
        return True
    phi = 2 * np.pi * (np.arange(RAYS) / RAYS - np.arange(TURNS)[:, None] / (4 * TURNS))  # (TURNS, RAYS)
    sides = []
    for cosine in (np.abs(np.cos(phi)), np.abs(np.sin(phi))):
        on_side = cosine > math.cos(BESIDE_NORMAL)
        distance = [np.median(outline[on] * part[on]) for on, part in zip(on_side, cosine, strict=True)]
        sides.append(np.array(distance)[:, None] / np.maximum(cosine, 1e-9))
    on_rectangle = ends & (np.abs(outline - np.minimum(*sides)) <= tolerance)
    return bool((on_rectangle.mean(axis=1) >= ON_RECTANGLE).any())


@compiled
def _trace_strokes(image: AnyArray, xy: FloatArray, shape: FloatArray, levels: FloatArray) -> FloatArray:
    """Return radius of the target, width and outer radius of the stroke, px, and whether more is behind it.

    Width and outer radius are inf where the stroke does not end.

    Returns:
        Shape (k, RAYS, 4).
    """
    strokes = np.empty((len(xy), RAYS, 4))
    for k in range(len(xy)):
        p, q, r = shape[k]
        det = p * r - q * q
        for i in range(RAYS):
            c, s = math.cos(2 * math.pi * i / RAYS), math.sin(2 * math.pi * i / RAYS)
            ex, ey = (r * c - q * s) / det, (p * s - q * c) / det
            R = math.hypot(ex, ey)
            strokes[k, i, 0] = R
            strokes[k, i, 1:] = _stroke(image, xy[k], ex / R, ey / R, R, levels[k])
    return strokes


@compiled
def _stroke(
    image: AnyArray, xy: FloatArray, ux: float, uy: float, R: float, levels: FloatArray
) -> tuple[float, float, float]:
    """Return width and outer radius of the background on a ray, px, and 1.0 if more is behind.

    Width and radius are inf if the background does not end.
    """
    h, w = image.shape
    left, width, end, highest, before, t = -1.0, math.inf, math.inf, 0.0, 1.0, 0.0
    while t < (MAX_STROKE + 1) * R + 1 if width == math.inf else t < left + width + NEIGHBOURS * R:
        x, y = xy[0] + (R + t) * ux, xy[1] + (R + t) * uy
        if x < 0 or y < 0 or x >= w - 1 or y >= h - 1:
            break
        level = (bilinear(image, x, y) - levels[0]) / levels[1]
        if left < 0:
            if level < 0.5:
                left = t
        elif width == math.inf:
            if level > 0.5:
                width = t - left
                end = R + t - _STEP_PX * (level - 0.5) / (level - before)
        else:
            if t < left + width + _RISE_PX:
                highest = max(highest, level)
            if level < 0.5:
                return (math.inf if highest >= GLARE else width), end, 1.0
        before = level
        t += _STEP_PX
    return (math.inf if highest >= GLARE else width), end, 0.0
