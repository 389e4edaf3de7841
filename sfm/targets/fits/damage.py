"""Damage and shape of the outlines of targets, judged against the targets of their photograph.

An edge is divided into sectors. The deviation h of the outline in a sector, in radii, follows from the residuals
of the blurred ellipse there. What is common to the dots of a photograph is shape: polygonal printing,
sharpening, compression; it moves all of them alike. A place is damaged where a scan statistic of what is left
is significant against the scatter of the dot and that of the others. The harmonics 3 to 6 of what is left,
which no ellipse follows, show how much larger than that of white noise the variance of the first one is, which
is the centre.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import digamma, fdtri, ndtri, polygamma

from sfm.conventions import BoolArray, FloatArray
from sfm.targets.edge_rays import RAYS
from sfm.targets.fits.goodness import SHAPES

# Level of the test for damage over all places of a photograph.
LEVEL = 0.01
# Numbers of neighbouring sectors that are tested together: nicks of 3 to 25 % of the edge.
WIDTHS = (1, 2, 4, 8)
# Median of the largest of these statistics of a whole dot (by simulation).
USUAL = 2.18
# The scatter of a dot along its edge is at most so many times that of the others, else it is damage.
LARGEST_LEVEL = 3.0
# An exponent of the spectrum of outlines is believed from so many sigmas on, and up to this.
EXPONENT_SIGMAS, LARGEST_EXPONENT = 2.0, 3.0
# It is estimated from harmonics 3 to this one that are damped to no less than this share.
MAX_HARMONIC, LEAST_DAMPED = 12, 0.2
# Median of the mean square of two normal deviates.
MEDIAN_OF_PAIRS = math.log(2)
# From so many targets on a photograph shows what its dots have in common.
MIN_POPULATION = 8
# Rounds of the robust fit to the sectors; its tuning constant has 95 % efficiency (Huber and Ronchetti 2009).
ROUNDS, BIWEIGHT = 10, 4.685
_MAD = 1.4826
_PHI = 2 * np.pi * (np.arange(RAYS) + 0.5) / RAYS


def _harmonics(first: int, last: int) -> FloatArray:
    """Return cosine and sine of the harmonics from first to last in the middle of each sector, (RAYS, 2 n)."""
    return np.column_stack([f(k * _PHI) for k in range(first, last + 1) for f in (np.cos, np.sin)])


_ELLIPSE = np.column_stack([np.ones(RAYS), _harmonics(1, 2)])


def common_outline(h: FloatArray, weight: FloatArray, sound: BoolArray) -> FloatArray:
    """Return the deviation of the outline that the sound targets of a photograph have in common, (RAYS,).

    Args:
        h: deviations in each sector, radii, shape (k, RAYS).
        weight: their weights, 0 where nothing is known, shape (k, RAYS).
        sound: targets that count, shape (k,).
    """
    common = np.zeros(RAYS)
    if sound.sum() < MIN_POPULATION:
        return common
    own = np.where(weight[sound] > 0, h[sound], np.nan)
    with np.errstate(all="ignore"):
        common = np.nan_to_num(np.nanmedian(own, axis=0))
    return common


def find_damage(h: FloatArray, weight: FloatArray, sound: BoolArray, skirt: FloatArray) -> BoolArray:
    """Return which sectors are damaged.

    Args:
        h: deviations of the outlines in each sector, without the common ones, radii, shape (k, RAYS).
        weight: their weights by white noise, 1 / variance, shape (k, RAYS).
        sound: targets that show what is usual, shape (k,).
        skirt: how far damage reaches along the edge by the blur, sectors, shape (k,).

    Returns:
        Damaged sectors and the skirts to both sides, shape (k, RAYS).

    Source: the scan statistic of Glaz, Naus and Wallenstein (2001), with Bonferroni's bound.
    """
    z = _robust_residuals(h, weight)
    level = np.maximum(_MAD * np.median(np.abs(z), axis=1), 1.0)
    limit = -ndtri(LEVEL / (2 * len(WIDTHS) * RAYS * max(len(h), 1)))
    if sound.sum() >= MIN_POPULATION:
        usual = np.median(level[sound])
        level = np.clip(level, usual, LARGEST_LEVEL * usual)
        largest = (_scan(z, weight) / level[:, None, None]).max(axis=(1, 2))
        limit *= max(np.median(largest[sound]) / USUAL, 1.0)
    hit, limits = np.zeros(z.shape, bool), limit * level
    for _ in range(RAYS):  # the most significant place first, and what is left without it
        scans = _scan(z, np.where(hit, 0.0, weight))
        best = scans.reshape(len(z), -1).argmax(axis=1) if len(z) else np.zeros(0, int)
        more = np.flatnonzero(scans.max(axis=(1, 2), initial=0.0) > limits)
        if not len(more):
            break
        width, first = np.array(WIDTHS)[best[more] // RAYS], best[more] % RAYS
        hit[more] |= (np.arange(RAYS) - first[:, None]) % RAYS < width[:, None]
    wide = hit.copy()
    for i in range(1, RAYS // 2):
        wide |= (np.roll(hit, i, axis=1) | np.roll(hit, -i, axis=1)) & (i <= skirt[:, None])
    return wide


def gap_shifts(common: FloatArray, weight: FloatArray, keep: BoolArray) -> FloatArray:
    """Return by how much the common shape shifts the centres of outlines with gaps, radii, shape (k, 2)."""
    h = np.broadcast_to(common, weight.shape)
    return (_fit_ellipses(h, weight * keep) - _fit_ellipses(h, weight))[:, 1:3]


def _fit_ellipses(h: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the harmonics 0 to 2 of outlines, which an ellipse follows, radii, shape (k, 5)."""
    N = np.einsum("ki,ia,ib->kab", weight, _ELLIPSE, _ELLIPSE)
    N += (1e-9 * (1 + np.trace(N, axis1=1, axis2=2)))[:, None, None] * np.eye(5)
    return np.linalg.solve(N, np.einsum("ki,ia->ka", weight * h, _ELLIPSE)[..., None])[..., 0]


def _scan(z: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the weighted sums of so many residuals from each sector on, (k, len(WIDTHS), RAYS)."""
    out = np.zeros((len(z), len(WIDTHS), RAYS))
    for k, width in enumerate(WIDTHS):
        total = sum(np.roll(z * np.sqrt(weight), -i, axis=1) for i in range(width))
        norm = sum(np.roll(weight, -i, axis=1) for i in range(width))
        out[:, k] = np.abs(total) / np.sqrt(np.maximum(norm, 1e-12))
    return out


def _robust_residuals(h: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the residuals of ellipses through most sectors, in standard deviations of white noise, (k, RAYS).

    Source: Tukey's biweight by iteratively reweighted least squares, Huber and Ronchetti, Robust Statistics
    (2009), from the fit of least absolute residuals.
    """
    robust, root = weight.copy(), np.sqrt(weight)
    z = h * root
    for k in range(2 * ROUNDS):
        z = (h - _fit_ellipses(h, robust) @ _ELLIPSE.T) * root
        if k < ROUNDS:
            robust = weight / np.maximum(np.abs(z), 0.1)
        else:
            scale = np.maximum(_MAD * np.median(np.abs(z), axis=1), 1.0)[:, None]
            robust = weight * np.maximum(1 - (z / (BIWEIGHT * scale)) ** 2, 0.0) ** 2
    return z


def outline_noise(
    equations: FloatArray, variance: FloatArray, sound: BoolArray, rise: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the factors of the covariances and what the gaps of outlines add to the centres.

    Args:
        equations: of the harmonics of the outlines, see `goodness.shape_equations`, (k, SHAPES + 3, SHAPES).
        variance: of the intensities, shape (k,).
        sound: targets that show what is usual, shape (k,).
        rise: power of the first harmonic over that of the others, where they are random.

    Returns:
        Ratio of the variances of harmonics to those of white noise, shape (k,); covariance of the centre that
        is added, px^2, shape (k, 2, 2).

    Source: Smyth, "Linear models and empirical Bayes methods" (2004), for the moderated variances.
    """
    N = equations[:, :SHAPES] / variance[:, None, None]
    N = N + (1e-9 * (1 + np.trace(N, axis1=1, axis2=2)))[:, None, None] * np.eye(SHAPES)
    shape = np.linalg.solve(N, equations[:, SHAPES, :, None] / variance[:, None, None])[..., 0]
    if sound.sum() >= MIN_POPULATION:
        shape = shape - np.median(shape[sound], axis=0)
    ratio = np.maximum(np.einsum("ka,kab,kb->k", shape, N, shape), 0.0) / SHAPES
    factor, strange = moderate(ratio, sound, SHAPES)
    own_variance = 1 / np.maximum(np.diagonal(N, axis1=1, axis2=2), 1e-9)
    excess = np.maximum(factor - 1, 0.0)
    effect = equations[:, SHAPES + 1 :]
    added = (excess * own_variance.min(axis=1))[:, None, None] * effect @ np.swapaxes(effect, 1, 2)
    return factor + (rise - 1) * excess, added, strange


def rise_to_first(h: FloatArray, weight: FloatArray, softness: float) -> float:
    """Return the power of the first harmonic of random outlines over the mean of harmonics 3 to 6.

    The power falls with k by an exponent that the population shows: rough paper has 0, cut or drawn outlines
    have more. Blur and the width of a sector damp the harmonics, too.

    Args:
        h: deviations of sound outlines in each sector, radii, shape (k, RAYS).
        weight: their weights by white noise, shape (k, RAYS).
        softness: blur of the edges over the radius.
    """
    if len(h) < MIN_POPULATION:
        return 1.0
    k = np.arange(3, MAX_HARMONIC + 1)
    damped = np.exp(-((k * softness) ** 2)) * np.sinc(k / RAYS) ** 2
    k, damped = k[damped > LEAST_DAMPED], damped[damped > LEAST_DAMPED]
    if len(k) < 3:
        return 1.0
    design = _harmonics(3, MAX_HARMONIC)[:, : 2 * len(k)]
    norm = weight @ design**2
    squares = ((weight * h) @ design) ** 2 / np.maximum(norm, 1e-12) ** 2
    pairs = squares.reshape(-1, len(k), 2).mean(axis=2), (1 / np.maximum(norm, 1e-12)).reshape(-1, len(k), 2).mean(axis=2)
    total, by_noise = np.median(pairs[0], axis=0) / MEDIAN_OF_PAIRS, np.median(pairs[1], axis=0)
    power = (total - by_noise) / damped
    if (power <= 0).any():
        return 1.0
    sigma = np.sqrt(2 / len(h)) * total / (power * damped)
    line = np.column_stack([np.ones(len(k)), -np.log(k)]) / sigma[:, None]
    inverse = np.linalg.inv(line.T @ line)
    exponent = (inverse @ line.T @ (np.log(power) / sigma))[1]
    if exponent < EXPONENT_SIGMAS * np.sqrt(inverse[1, 1]):
        return 1.0
    return float(1 / np.mean(np.arange(3.0, 7.0) ** -min(exponent, LARGEST_EXPONENT)))


def moderate(ratio: FloatArray, sound: BoolArray, freedom: int) -> tuple[FloatArray, BoolArray]:
    """Return ratios of variances with a common degree of freedom, drawn to those of the population, (k,).

    What the population does not explain at the level of the tests is not drawn to it.
    """
    own = ratio[sound & (ratio > 0)]
    prior, prior_freedom = 1.0, float(freedom)
    if len(own) >= MIN_POPULATION:
        z = np.log(own) - digamma(freedom / 2) + np.log(freedom / 2)
        middle = np.median(z)
        spread = (_MAD * np.median(np.abs(z - middle))) ** 2 - polygamma(1, freedom / 2)
        half = _inverse_trigamma(spread) if spread > 0.01 else 100.0
        prior_freedom, prior = 2 * half, np.exp(middle + digamma(half) - np.log(half))
    moderated = (prior_freedom * prior + freedom * ratio) / (prior_freedom + freedom)
    strange = ratio > prior * fdtri(freedom, prior_freedom, 1 - LEVEL / max(len(ratio), 1))
    return np.where(strange, ratio, moderated), strange


def _inverse_trigamma(value: float) -> float:
    """Return y with trigamma(y) = value, by Newton steps (Smyth 2004, appendix)."""
    y = 0.5 + 1 / value
    for _ in range(50):
        trigamma = polygamma(1, y)
        step = trigamma * (1 - trigamma / value) / polygamma(2, y)
        y += step
        if abs(step) < 1e-8 * y:
            break
    return float(y)
