"""Noise of the outlines of targets: how much larger than by the noise of intensities the variances are.

Harmonics 3 to 6 of an outline follow no ellipse. They are estimated jointly with it on what is left of the
edge. Deviations common to the targets of a photograph are shape. The rest shows the variance of the first
harmonic, which is the centre, whatever makes it: rough printing, compression, correlated noise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import digamma, fdtri, polygamma

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.targets.edge_rays import RAYS
from sfm.targets.fits.damage import LEVEL, MAD, MIN_POPULATION, harmonics
from sfm.targets.fits.goodness import SHAPES

# The spectrum of outlines is that of harmonics 3 to this one, of which blur leaves this share at least.
MAX_HARMONIC, MIN_DAMPED = 12, 0.2
# Its exponent is used where it is so many sigmas above 0, and up to this.
EXPONENT_SIGMAS, MAX_EXPONENT = 2.0, 3.0
# Larger than any degree of freedom that a population can show.
_MAX_HALF_FREEDOM = 1e4


class OutlineShape(NamedTuple):
    """Harmonics 3 to 6 of the outlines of k targets, which no ellipse follows."""

    harmonics: FloatArray
    """cosine and sine of each, radii, shape (k, SHAPES)"""
    normal: FloatArray
    """their normal equations, shape (k, SHAPES, SHAPES)"""
    effect: FloatArray
    """change of the centre by each, px per radius, shape (k, 2, SHAPES)"""
    lobes: FloatArray
    """amplitude of harmonics 3 and 4 together, radii, shape (k,)"""
    lobes_cofactor: FloatArray
    """largest cofactor of their four components, for unit variance of the intensities, shape (k,)"""


class OutlineNoise(NamedTuple):
    """Noise of the outlines of k targets."""

    factor: FloatArray
    """ratio of the variances to those by the noise of the intensities, shape (k,)"""
    gap_covariance: FloatArray
    """what gaps in the edges add to the covariance of the centres, px^2, shape (k, 2, 2)"""


def outline_shape(equations: FloatArray) -> OutlineShape:
    """Return the harmonics of outlines from their `goodness.shape_equations`, (k, SHAPES + 3, SHAPES)."""
    N, g, effect = np.split(equations, [SHAPES, SHAPES + 1], axis=1)
    N = N + 1e-9 * (1 + np.trace(N, axis1=1, axis2=2))[:, None, None] * np.eye(SHAPES)
    cofactor = np.linalg.inv(N)
    shape = np.einsum("kab,kb->ka", cofactor, g[:, 0])
    return OutlineShape(
        shape,
        N,
        effect,
        np.sqrt((shape[:, :4] ** 2).sum(axis=1)),
        np.maximum(np.diagonal(cofactor, axis1=1, axis2=2)[:, :4].max(axis=1), 0.0),
    )


def judge_outlines(
    outlines: OutlineShape, variance: FloatArray, sound: BoolArray, softness: FloatArray, rise: float
) -> OutlineNoise:
    """Return the noise of outlines.

    A nick moves all harmonics of an outline alike, and its blur leaves little of the high ones. They show the
    first one by the share that is left of them: where an outline is stranger than noise, the excess of its
    variance is divided by that.

    Args:
        outlines: their harmonics.
        variance: of the intensities, shape (k,).
        sound: targets that show what is usual, shape (k,).
        softness: blur of the edges over the radius, which leaves little of high harmonics, shape (k,).
        rise: power of the first harmonic over that of harmonics 3 to 6, see `rise_to_first`.
    """
    shape, N, effect = outlines[:3]
    rest = shape - np.median(shape[sound], axis=0) if sound.sum() >= MIN_POPULATION else shape
    softness = np.minimum(softness, 1.0)[:, None]  # more where a fit failed
    damping = np.repeat(damping_of(np.arange(3, 3 + SHAPES // 2), softness), 2, axis=1)
    damping = np.where(damping[:, :1] > MIN_DAMPED, damping, 1.0)  # softer edges show none
    seen, squares = damping.sum(axis=1), (damping**2).sum(axis=1)
    weighted = np.sqrt(damping) * rest
    ratio = np.maximum(np.einsum("ka,kab,kb->k", weighted, N, weighted), 0.0) / (
        seen * np.maximum(variance, 1e-12)
    )
    freedom = float(np.median((seen**2 / squares)[sound])) if sound.any() else float(SHAPES)
    factor, strange = moderate(ratio, sound, freedom)
    excess = np.maximum(factor - 1, 0.0) * np.where(strange, seen / squares, rise)
    in_radii = excess * variance / np.maximum(np.diagonal(N, axis1=1, axis2=2).max(axis=1), 1e-12)
    return OutlineNoise(
        np.minimum(factor, 1.0) + excess,
        in_radii[:, None, None] * effect @ np.swapaxes(effect, 1, 2),
    )


def moderate(ratio: FloatArray, sound: BoolArray, freedom: float) -> tuple[FloatArray, BoolArray]:
    """Return ratios of variances with a common degree of freedom, drawn to those of the population, (k,).

    Ratios too large for the population are not drawn to it; a mask of them is returned second. Few targets
    are drawn half way to 1.

    Source: Smyth, "Linear models and empirical Bayes methods for assessing differential expression" (2004);
    Phipson et al., "Robust hyperparameter estimation protects against hypervariable genes" (2016).
    """
    ratios = ratio[sound & (ratio > 0)]
    prior, prior_freedom = 1.0, float(freedom)
    if len(ratios) >= MIN_POPULATION:
        z = np.log(ratios) - digamma(freedom / 2) + np.log(freedom / 2)
        middle = np.median(z)
        half = _inverse_trigamma((MAD * np.median(np.abs(z - middle))) ** 2 - polygamma(1, freedom / 2))
        prior_freedom, prior = 2 * half, np.exp(middle + digamma(half) - np.log(half))
    moderated = (prior_freedom * prior + freedom * ratio) / (prior_freedom + freedom)
    strange = ratio > prior * fdtri(freedom, prior_freedom, 1 - LEVEL / max(len(ratio), 1))
    return np.where(strange, ratio, moderated), strange


def damping_of(k: IntArray, softness: FloatArray | float) -> FloatArray:
    """Return the share of the power of these harmonics of outlines that so soft edges leave."""
    return np.asarray(np.exp(-((k * softness) ** 2)))


def _inverse_trigamma(value: float) -> float:
    """Return y with trigamma(y) = value, by Newton steps (Smyth 2004, appendix)."""
    if value < 1 / _MAX_HALF_FREEDOM:
        return _MAX_HALF_FREEDOM
    y = 0.5 + 1 / value
    for _ in range(10):
        y += polygamma(1, y) * (1 - polygamma(1, y) / value) / polygamma(2, y)
    return float(y)


def rise_to_first(h: FloatArray, weight: FloatArray, softness: float) -> float:
    """Return the power of the first harmonic of random outlines over the mean of harmonics 3 to 6.

    The power of harmonic k falls as a power of k, which the population shows.

    Args:
        h: deviations of sound outlines in each sector without the common shape, radii, shape (k, RAYS).
        weight: 1 / variance of them by the noise of the intensities, shape (k, RAYS).
        softness: blur of the edges over the radius, damps harmonics as the width of the sectors does.
    """
    k = np.arange(3, MAX_HARMONIC + 1)
    damped = damping_of(k, softness) * np.sinc(k / RAYS) ** 2
    k = k[damped > MIN_DAMPED]
    if len(h) < MIN_POPULATION or len(k) < 3:
        return 1.0
    design = harmonics(3, int(k[-1]))
    norm = np.maximum(weight @ design**2, 1e-12)
    squares = (((weight * h) @ design / norm) ** 2).reshape(len(h), len(k), 2).mean(axis=2)
    total = np.median(squares, axis=0) / math.log(2)  # the median of (c^2 + s^2) / 2 over its mean
    power = total - np.median(1 / norm, axis=0).reshape(len(k), 2).mean(axis=1)
    if (power <= 0).any():
        return 1.0
    sigma = np.sqrt(2 / len(h)) * total / power
    line = np.column_stack([np.ones(len(k)), -np.log(k)]) / sigma[:, None]
    cofactor = np.linalg.inv(line.T @ line)
    exponent = (cofactor @ line.T @ (np.log(power / damped[: len(k)]) / sigma))[1]
    if exponent < EXPONENT_SIGMAS * math.sqrt(cofactor[1, 1]):
        return 1.0
    return float(1 / np.mean(np.arange(3.0, 3 + SHAPES // 2) ** -min(exponent, MAX_EXPONENT)))
