"""Noise of the outlines of targets, and damage relative to the shape that they have in common.

No ellipse can follow harmonics 3 to 6 of an outline. They are estimated jointly with the ellipse from the
undamaged part of the edge. Deviations common to the targets of a photograph are shape. The rest shows the
variance of the first harmonic, which is the centre, whatever its cause: rough printing, compression or
correlated noise.

Damage is detected relative to that shape. The edge of a target is divided into sectors. The deviation h of
the outline in a sector, in radii, follows from the residuals of the blurred ellipse there. The median over
the targets of a photograph is shape, such as polygonal printing or sharpening, which shifts all of them
alike. A sector is damaged if the rest is significant relative to the scatter along the edges of this target
and of the others.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import digamma, fdtri, ndtri, polygamma

from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distributions import FAMILY
from sfm.runtime.compiling import compiled
from sfm.runtime.small_algebra import solve_symmetric
from sfm.targets.edge_rays import RAYS
from sfm.targets.fits.goodness import SHAPES

# Numbers of neighbouring sectors that are tested together; an ellipse follows most of any wider damage.
WIDTHS = (1, 2, 4)
# Number of sound targets from which a photograph shows their common shape.
MIN_POPULATION = 8
# Median over circles of the largest scan statistic, by simulation (tests/targets/test_outline_noise.py).
USUAL_SCAN = 2.18
# Factor over the usual up to which scatter along an edge, and the largest scan statistic, are tolerated; more
# means damage in many sectors or on many targets.
MAX_LEVEL = 3.0
# If too few other targets show what is shape, damage is in at most this many places; a scratch is in two.
MAX_PLACES = 2
# Rounds of the robust fit, and its tuning constant for 95 % efficiency (Huber and Ronchetti 2009, sec. 4.8).
ROUNDS, BIWEIGHT = 10, 4.685
MAD = 1.4826
_PHI = 2 * np.pi * (np.arange(RAYS) + 0.5) / RAYS
# The spectrum of outlines covers harmonics 3 to this one, if blur leaves at least this part of their power.
MAX_HARMONIC, MIN_DAMPED = 12, 0.2
# The exponent of the spectrum is used if it is this many sigmas above 0, and up to this value.
EXPONENT_SIGMAS, MAX_EXPONENT = 2.0, 3.0
# Larger than any degree of freedom that a population can show.
_MAX_HALF_FREEDOM = 1e4


class OutlineShape(NamedTuple):
    """Harmonics 3 to 6 of the outlines of k targets, which no ellipse can follow."""

    harmonics: FloatArray
    """cosine and sine of each harmonic, radii, shape (k, SHAPES)"""
    normal: FloatArray
    """their normal equations, shape (k, SHAPES, SHAPES)"""
    effect: FloatArray
    """change of the centre by each component, px per radius, shape (k, 2, SHAPES)"""
    lobes: FloatArray
    """amplitude of harmonics 3 and 4 together, radii, shape (k,)"""
    lobes_cofactor: FloatArray
    """largest cofactor of their four components, for unit variance of the intensities, shape (k,)"""


class OutlineNoise(NamedTuple):
    """Noise of the outlines of k targets."""

    factor: FloatArray
    """ratio of the variances to those from the noise of the intensities, shape (k,)"""
    gap_covariance: FloatArray
    """covariance of the centres added by gaps in the edges, px^2, shape (k, 2, 2)"""


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

    A nick affects all harmonics of an outline alike, and its blur leaves little of the high ones. They show
    the first harmonic by the part of their power that is left: if an outline is stranger than noise, the
    excess of its variance is divided by that part.

    Args:
        outlines: harmonics of the outlines.
        variance: variance of the intensities, shape (k,).
        sound: targets that represent the usual, shape (k,).
        softness: blur of the edges over the radius, which leaves little of high harmonics, shape (k,).
        rise: power of the first harmonic over that of harmonics 3 to 6, see `rise_to_first`.
    """
    shape, N, effect = outlines[:3]
    rest = shape - np.median(shape[sound], axis=0) if sound.sum() >= MIN_POPULATION else shape
    softness = np.minimum(softness, 1.0)[:, None]  # larger if a fit failed
    damping = np.repeat(damping_of(np.arange(3, 3 + SHAPES // 2), softness), 2, axis=1)
    damping = np.where(damping[:, :1] > MIN_DAMPED, damping, 1.0)  # softer edges show no harmonics
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
    """Return ratios of variances with a common degree of freedom, shrunk to those of the population, (k,).

    Ratios too large for the population are not shrunk; their mask is returned second. A few targets are
    shrunk half way to 1.

    Source: Smyth, "Linear models and empirical Bayes methods for assessing differential expression" (2004);
    Phipson et al., "Robust hyperparameter estimation protects against hypervariable genes" (2016).
    """
    ratios = ratio[sound & (ratio > 0)]
    prior, prior_freedom = 1.0, float(freedom)
    if len(ratios) >= MIN_POPULATION:
        z = np.log(ratios) - digamma(freedom / 2) + np.log(freedom / 2)
        middle = np.median(z)
        excess = (MAD * np.median(np.abs(z - middle))) ** 2 - polygamma(1, freedom / 2)
        half = _MAX_HALF_FREEDOM
        if not excess < 1 / _MAX_HALF_FREEDOM:  # trigamma(half) = excess, by Newton steps (Smyth, appendix)
            half = 0.5 + 1 / excess
            for _ in range(10):
                half += polygamma(1, half) * (1 - polygamma(1, half) / excess) / polygamma(2, half)
            half = float(half)
        prior_freedom, prior = 2 * half, np.exp(middle + digamma(half) - np.log(half))
    moderated = (prior_freedom * prior + freedom * ratio) / (prior_freedom + freedom)
    strange = ratio > prior * fdtri(freedom, prior_freedom, 1 - FAMILY / max(len(ratio), 1))
    return np.where(strange, ratio, moderated), strange


def damping_of(k: IntArray, softness: FloatArray | float) -> FloatArray:
    """Return the part of the power of these harmonics that remains in outlines with soft edges."""
    return np.asarray(np.exp(-((k * softness) ** 2)))


def rise_to_first(h: FloatArray, weight: FloatArray, softness: float) -> float:
    """Return the power of the first harmonic of random outlines over the mean of harmonics 3 to 6.

    The power of harmonic k falls as a power of k, which is estimated from the population.

    Args:
        h: deviations of sound outlines in each sector without the common shape, radii, shape (k, RAYS).
        weight: 1 / variance of these deviations from the noise of the intensities, shape (k, RAYS).
        softness: blur of the edges over the radius; like the width of the sectors, it damps harmonics.
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


def harmonics(first: int, last: int) -> FloatArray:
    """Return cosine and sine of harmonics in the middle of each sector, shape (RAYS, 2 n)."""
    return np.column_stack([f(k * _PHI) for k in range(first, last + 1) for f in (np.cos, np.sin)])


_ELLIPSE = np.column_stack([np.ones(RAYS), harmonics(1, 2)])  # that ellipses follow, (RAYS, 5)


def find_damage(h: FloatArray, weight: FloatArray, sound: BoolArray, skirt: FloatArray) -> BoolArray:
    """Return which sectors of the edges are damaged.

    The sectors of the largest scan statistic are removed first, and the rest is tested again: a wide window
    around damage is also significant, but its other sectors are not.

    Args:
        h: deviations of the outlines from their ellipses and the common shape, radii, shape (k, RAYS).
        weight: 1 / variance of these deviations from the noise of the intensities, shape (k, RAYS).
        sound: targets that represent the usual, shape (k,).
        skirt: number of sectors on each side of damage that are blurred with it, shape (k,).

    Returns:
        Damaged sectors with their skirts, shape (k, RAYS).

    Source: Glaz, Naus and Wallenstein, Scan Statistics (2001), with Bonferroni's bound.
    """
    z = _robust_residuals(h, weight)
    level = np.maximum(MAD * np.median(np.abs(z), axis=1), 1.0)
    limit = -ndtri(FAMILY / (2 * len(WIDTHS) * RAYS * max(len(h), 1)))
    if sound.sum() >= MIN_POPULATION:
        usual = np.median(level[sound])
        level = np.clip(level, usual, MAX_LEVEL * usual)
        largest = _scan(z, weight).max(axis=(1, 2)) / level
        limit *= float(np.clip(np.median(largest[sound]) / USUAL_SCAN, 1.0, MAX_LEVEL))
    hit = np.zeros(z.shape, bool)
    for _ in range(RAYS):
        scans = _scan(z, np.where(hit, 0.0, weight)).reshape(len(z), len(WIDTHS) * RAYS)
        more = np.flatnonzero(scans.max(axis=1, initial=0.0) > limit * level)
        if not len(more):
            break
        width, first = np.divmod(scans[more].argmax(axis=1), RAYS)
        hit[more] |= (np.arange(RAYS) - first[:, None]) % RAYS < np.array(WIDTHS)[width][:, None]
    if sound.sum() < MIN_POPULATION:
        places = (hit & ~np.roll(hit, 1, axis=1) & ~np.roll(hit, 2, axis=1)).sum(axis=1)
        hit[places > MAX_PLACES] = False
    damaged = hit.copy()
    for i in range(1, int(min(RAYS // 2, skirt[hit.any(axis=1)].max(initial=0) + 1))):
        damaged |= (np.roll(hit, i, axis=1) | np.roll(hit, -i, axis=1)) & (i <= skirt[:, None])
    return damaged


def most_telling(sound: BoolArray, information: FloatArray) -> BoolArray:
    """Return which targets represent the usual, (k,): those that are sound, unless most tell next to nothing.

    A photograph of texture shows more blobs than targets, whose faint edges tell little of an outline. They
    would make theirs the usual one: all targets would seem damaged, or as rough as the blobs.
    If they tell as much as fewer than half as many equal ones, those below the mean do not count.

    Args:
        sound: targets that are not unlike targets, shape (k,).
        information: of a px of their edges, shape (k,).

    Source: Kish (1965), Survey Sampling (number of equal weights that tell as much).
    """
    w = information[sound]
    if w.sum() ** 2 >= len(w) / 2 * (w**2).sum():
        return sound
    return np.asarray(sound & (information >= w.mean()))


def common_shape(h: FloatArray, weight: FloatArray, sound: BoolArray) -> FloatArray:
    """Return the median deviation of sound outlines in each sector, radii, (RAYS,); 0 if they are few."""
    seen = sound[:, None] & (weight > 0)
    enough = seen.sum(axis=0) >= MIN_POPULATION
    return np.array([np.median(h[seen[:, j], j]) if enough[j] else 0.0 for j in range(RAYS)])


def gap_shifts(common: FloatArray, weight: FloatArray, keep: BoolArray) -> FloatArray:
    """Return the shifts of the centres by the common shape due to gaps in the edges, radii, shape (k, 2)."""
    h = np.broadcast_to(common, weight.shape)
    return (_fit_harmonics(h, weight * keep) - _fit_harmonics(h, weight))[:, 1:3]


@compiled
def _fit_harmonics(h: FloatArray, weight: FloatArray) -> FloatArray:
    """Return harmonics 0 to 2 of outlines, which ellipses follow to first order, radii, shape (k, 5)."""
    n = _ELLIPSE.shape[1]
    fitted, N = np.empty((len(h), n)), np.empty((n, n))
    for k in range(len(h)):
        N[:], fitted[k] = 0.0, 0.0
        for j in range(RAYS):
            for a in range(n):
                effect = weight[k, j] * _ELLIPSE[j, a]
                fitted[k, a] += effect * h[k, j]
                for b in range(a + 1):
                    N[a, b] += effect * _ELLIPSE[j, b]
        least = 1e-9 * (1 + np.trace(N))
        for a in range(n):
            N[a, a] += least
        if not solve_symmetric(N, fitted[k]):
            fitted[k] = np.nan
    return fitted


@compiled
def _robust_residuals(h: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the residuals of ellipses through most sectors, in sigmas of the noise, shape (k, RAYS).

    Source: Huber and Ronchetti, Robust Statistics (2009): Tukey's biweight by iteratively reweighted least
    squares, from the fit of least absolute residuals.
    """
    z, robust = np.empty(h.shape), weight.copy()
    for k in range(len(h)):
        of_one, root = slice(k, k + 1), np.sqrt(weight[k])
        for step in range(2 * ROUNDS):
            z[k] = (h[k] - _ELLIPSE @ _fit_harmonics(h[of_one], robust[of_one])[0]) * root
            size = np.abs(z[k])
            if step < ROUNDS:
                robust[k] = weight[k] / np.maximum(size, 0.1)
            else:
                scale = max(MAD * np.median(size), 1.0)
                robust[k] = weight[k] * np.maximum(1 - (size / (BIWEIGHT * scale)) ** 2, 0.0) ** 2
    return z


def _scan(z: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the sums of WIDTHS residuals starting at each sector, in sigmas, (k, len(WIDTHS), RAYS)."""
    total, norm = z * np.sqrt(weight), weight
    scans = np.empty((len(z), len(WIDTHS), RAYS))
    for k, width in enumerate(WIDTHS):
        if k:
            total = total + np.roll(total, -width // 2, axis=1)
            norm = norm + np.roll(norm, -width // 2, axis=1)
        scans[:, k] = np.abs(total) / np.sqrt(np.maximum(norm, 1e-12))
    return scans
