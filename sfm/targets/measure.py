"""Measurement of circular targets by the least squares fit of a blurred ellipse."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.kernels.sampling import as_grey
from sfm.targets.fits import goodness
from sfm.targets.fits.blurred_ellipse import BACKGROUND, BLUR, CONTRAST, GAIN_X, UNKNOWNS, P, R
from sfm.targets.fits.outline_noise import outline_shape
from sfm.targets.fits.undamaged import fit_undamaged
from sfm.targets.flags import Flag

# Variance of rounding to whole intensities.
QUANTISATION = 1 / 12
# From so many targets on, the shading of a photograph is estimated from them; a target whose gain differs
# from that by more than so many sigma keeps its own.
MIN_FOR_SHADING, OWN_GAIN_SIGMAS = 10, 3.0
# A halo is above this share of the contrast (9 of 10 of the retro-panel are below) and so many of its
# sigmas. Flare is a background of which more than this share is saturated, that has glare behind it on more
# than this share of the circumference, or that changes by more than this share of the contrast.
HALO, HALO_SIGMAS, FLARE_SATURATED, FLARE_AROUND, FLARE_CHANGE = 0.035, 5.0, 0.02, 0.25, 0.25
# A gain per px below this is none.
NO_GAIN = 1e-7


@dataclass(frozen=True)
class EllipseFit:
    """Blurred ellipses fitted to the targets of one photograph."""

    xy: FloatArray
    """centres, px, shape (k, 2)"""
    full_covariance: FloatArray
    """covariance of centre, shape, background, contrast and blur in this order from the fit, its
    residuals and the outlines of the photograph, nan where it failed, shape (k, 8, 8)"""
    shape: FloatArray
    """(p, q, r) of S, which turns image vectors into radii, 1/px, shape (k, 3)"""
    background: FloatArray
    """intensity B around the target, shape (k,)"""
    contrast: FloatArray
    """step of intensity A from background to target, positive for bright targets, shape (k,)"""
    blur: FloatArray
    """standard deviation s of the edge, pixel box included, px, shape (k,)"""
    gain: FloatArray
    """relative change of the intensity per px in x and y, shape (k, 2)"""
    noise: FloatArray
    """standard deviation of the intensities about the fit, shape (k,)"""
    unevenness: FloatArray
    """largest mean residual over one eighth of the edge, relative to the contrast, shape (k,)"""
    lobes: FloatArray
    """amplitude of the third and fourth harmonic of the outline about the ellipse, radii, shape (k,)"""
    lobes_sigma: FloatArray
    """standard deviation of one of their components that the given noise makes, radii, shape (k,)"""
    strokes: FloatArray
    """share of the circumference where the background is only a thin stroke, shape (k,)"""
    pixels: IntArray
    """number of intensities in the fit, shape (k,)"""
    iterations: IntArray
    """number of steps, shape (k,)"""
    flag: IntArray
    """remarks and reasons of failure, see Flag, shape (k,)"""

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
    """Fit the model of a blurred ellipse to every target, starting from roughly known outlines.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16 or float32.
        xy: approximate centres, px, shape (k, 2).
        shape: approximate (p, q, r) of S, 1/px, shape (k, 3).
        sign: +1 for a target brighter than its surroundings, -1 for a darker one, shape (k,).
        noise: approximate standard deviation of the intensities; decides what counts as a disturbance.
        saturation: intensities from here on are censored; default is the end of the integer scale.

    Returns:
        The fits; where `flag` is NO_CONVERGENCE or CUT_BY_BORDER the values are the last ones reached.

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
    found = statistics.T
    covariance = np.full((k, GAIN_X, GAIN_X), np.nan)
    failed = Flag.NO_CONVERGENCE | Flag.CUT_BY_BORDER | Flag.NOT_ELLIPTIC
    good = np.flatnonzero((flag & failed) == 0)
    if len(good):
        theta[good], covariance[good], shaded = _shrink_gain(
            theta[good], cofactor[good], variance[good], found[goodness.LENGTH][good]
        )
        flag[good[shaded]] |= Flag.SHADED.value
        covariance[good] *= outlines.factor[good, None, None]
        covariance[good, :2, :2] += outlines.gap_covariance[good]
    gain = theta[:, GAIN_X:] / found[goodness.LENGTH][:, None]
    halo = found[goodness.HALO]
    flag[(halo > HALO) & (halo > HALO_SIGMAS * found[goodness.HALO_SIGMA])] |= Flag.HALO.value
    glare = (found[goodness.SATURATED] > FLARE_SATURATED) | (found[goodness.GLARING] > FLARE_AROUND)
    flag[glare | _changes(theta, gain)] |= Flag.FLARE.value
    return EllipseFit(
        xy=theta[:, :2],
        full_covariance=covariance,
        shape=theta[:, P : R + 1],
        background=theta[:, BACKGROUND],
        contrast=theta[:, CONTRAST],
        blur=theta[:, BLUR],
        gain=gain,
        noise=np.sqrt(variance),
        unevenness=found[goodness.UNEVENNESS],
        lobes=harmonics.lobes,
        lobes_sigma=noise * np.sqrt(harmonics.lobes_cofactor),
        strokes=found[goodness.STROKES],
        pixels=found[goodness.PIXELS].astype(np.int64),
        iterations=found[goodness.STEPS].astype(np.int64),
        flag=flag,
    )


def _changes(theta: FloatArray, gain: FloatArray) -> BoolArray:
    """Return where the background changes across the target by a good part of the contrast, (k,)."""
    p, q, r, B, A = theta[:, 2:7].T
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.abs(p * r - q * q) ** -0.5
        change = 2 * radius * np.abs(B) * np.hypot(*gain.T)
        return np.asarray(change > FLARE_CHANGE * np.abs(A))


def _shrink_gain(
    theta: FloatArray, cofactor: FloatArray, variance: FloatArray, length: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Use the shading that the targets of a photograph show together as prior for that of each target.

    A gradient of the gain inside a target and a shift of its centre look alike, so that estimating the gain
    costs up to a third of the precision of a bright target. The variance tau^2 of the gains over the targets
    is estimated (minus that of their errors, weighted), and "gain = 0 with variance tau^2" is added to
    each target as an observation: without shading this is the fit without gain, with shading the fit with it.

    Source: DerSimonian and Laird (1986), moment estimate of the variance between units; empirical Bayes.

    Returns:
        Unknowns, shape (k, 10); covariance of all but the gains, shape (k, 8, 8); which gains are not zero.
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
