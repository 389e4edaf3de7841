"""Rejection: which of the fitted candidates are no targets, and why."""

from __future__ import annotations

import math

import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.kernels.compiling import compiled
from sfm.kernels.sampling import bilinear
from sfm.targets.codes.rings import UNCODED, CodeFamily
from sfm.targets.edge_rays import RAYS
from sfm.targets.fits.blurred_ellipse import BLUR
from sfm.targets.fits.undamaged import MIN_RADIUS_PX, unlike_targets
from sfm.targets.flags import Flag
from sfm.targets.measure import EllipseFit, axes_from_shape
from sfm.targets.outlines import MIN_AXIS_RATIO, MIN_STEP, STEP_SIGMAS

# Reasons that are about the shape of a candidate and not about damage.
SHAPE_REASONS = (Flag.LOBED, Flag.THIN_BACKGROUND, Flag.POOR_FIT)
# Centres nearer than this share of the smaller radius belong to concentric targets.
MAX_CENTRE_FRACTION = 0.5
# Centres of a ring are as near as this share of the radius, by the perspective, and so many sigmas.
ECCENTRIC, ECCENTRIC_SIGMAS = 0.02, 5.0
# Parts of an unreadable code are smaller than this share of its dot.
PART_OF_DOT = 0.75
# Softest edge: this share of the minor semi-axis, or this blur in px where that is more.
SOFTEST_EDGE, SOFTEST_EDGE_PX = 0.35, 1.3
BLUR_SIGMAS = 3.0  # beyond which an edge is certainly softer: one target in 700 that is as soft as that
# Share of the rays on which a stroke ends, and on which something else begins behind it. No ring of up to 20
# cells is set on so much of the circumference: even parity leaves at least two of them clear.
CLOSED, CROWDED = 0.95, 0.08
# Least median and largest width of the stroke, radii of the counter; rims of the retro-panel have up to 0.46.
MIN_STROKE, MAX_STROKE = 0.5, 1.75
# So far behind a stroke its neighbours are looked for, radii; what is so many contrasts bright is glare.
NEIGHBOURS, GLARE = 2.0, 1.5
_STEP_PX, _RISE_PX = 0.5, 3.0


def judge_fits(
    fit: EllipseFit, *, noise: float, scale: float, min_diameter_px: float, max_diameter_px: float
) -> IntArray:
    """Return the first reason against each fitted candidate.

    Args:
        fit: the candidates as they were fitted.
        noise: standard deviation of the intensities of the photograph.
        scale: largest intensity that the photograph can hold.
        min_diameter_px: least minor axis of a target.
        max_diameter_px: largest major axis of a target.

    Returns:
        Flags, see `sfm.targets.flags.Flag`, 0 where nothing is against a candidate, shape (k,).
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
    """Return which candidates are targets if a code is read about them, shape (k,).

    Those are the good ones and those against which only their shape is: a dot with a hole, sharpened or made
    of the pixels of a screen resembles no blurred ellipse, but no letter has a code about it. A code does not
    excuse an edge that is missing or that damage changed, nor a blob too small to show a shape.
    """
    damaged = (fit.flag & (Flag.UNEVEN_EDGE | Flag.POOR_FIT)) != 0
    p, q, r = fit.shape.T
    shown = np.abs(p * r - q * q) * MIN_RADIUS_PX**2 < 1
    return np.asarray((reason == 0) | (np.isin(reason, SHAPE_REASONS) & ~damaged & shown))


def find_duplicates(
    fit: EllipseFit, sign: IntArray, reason: IntArray, coded: BoolArray
) -> tuple[BoolArray, FloatArray]:
    """Return which of the good candidates are no targets because of what is about or inside of them.

    And how much farther holes are from the centres of what they are in than perspective puts them, (k, 2).

    Of concentric ellipses the one with a code is kept, else the smallest: a retro-reflective dot with a dark
    rim in glare is seen as bright dot and, larger, as the dark rim. A candidate inside another and not
    shown to be concentric, of the polarity that fewer targets of the photograph have, is a stain.
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
    fit: EllipseFit, code: IntArray, confidence: FloatArray, family: CodeFamily
) -> BoolArray:
    """Return which candidates lie in the code ring of another target, hence are parts of its code.

    Codes are taken from the most confident to those that could not be read, and a part of one code does not
    count afterwards: an arc that resembles a dot does not take the dot of the same ring away. About a dot
    whose code was not read only what is clearly smaller than the dot is a part.
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


@compiled
def find_counters(image: AnyArray, xy: FloatArray, shape: FloatArray, levels: FloatArray) -> BoolArray:
    """Return which candidates are counters: the white inside of letters such as o, e and 8.

    It looks like a target on the stroke of the letter. The background of a counter is a closed stroke, behind
    which the paper begins again, and next to a letter there are others. A target with a dark rim is
    not like that: its rim is thinner than half its radius, or the surroundings of the rim are free. Nor is a
    dot in the ring of a code, which always has clear cells.

    Args:
        image: intensities, shape (H, W).
        xy: centres, px, shape (k, 2).
        shape: (p, q, r) of S, 1/px, shape (k, 3).
        levels: intensity of the background and its step to the target, shape (k, 2).

    Returns:
        Which candidates are counters, shape (k,).
    """
    counter = np.zeros(len(xy), np.bool_)
    for k in range(len(xy)):
        p, q, r = shape[k]
        det = p * r - q * q
        closed, wide, crowded = 0, 0, 0
        for i in range(RAYS):
            c, s = math.cos(2 * math.pi * i / RAYS), math.sin(2 * math.pi * i / RAYS)
            ex, ey = (r * c - q * s) / det, (p * s - q * c) / det
            R = math.hypot(ex, ey)
            width, behind = _stroke(image, xy[k], ex / R, ey / R, R, levels[k])
            closed += width <= MAX_STROKE * R
            wide += MIN_STROKE * R <= width <= MAX_STROKE * R
            crowded += behind
        counter[k] = closed >= CLOSED * RAYS and wide >= RAYS // 2 and crowded >= CROWDED * RAYS
    return counter


@compiled
def _stroke(
    image: AnyArray, xy: FloatArray, ux: float, uy: float, R: float, levels: FloatArray
) -> tuple[float, bool]:
    """Return the width of the background on a ray, px, inf where it does not end, and if more is behind."""
    h, w = image.shape
    left, width, highest, t = -1.0, math.inf, 0.0, 0.0
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
        else:
            if t < left + width + _RISE_PX:
                highest = max(highest, level)
            if level < 0.5:
                return (math.inf if highest >= GLARE else width), True
        t += _STEP_PX
    return (math.inf if highest >= GLARE else width), False
