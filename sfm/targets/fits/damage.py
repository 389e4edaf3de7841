"""Damage of the outlines of targets, found against the shape that the targets of a photograph share.

The edge of a target is divided into sectors. The deviation h of the outline in a sector, in radii, follows
from the residuals of the blurred ellipse there. The median over the targets of a photograph is shape:
polygonal printing or sharpening, which moves all of them alike. A place is damaged where the rest is
significant against the scatter along the edge, of this target and of the others.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from sfm.conventions import BoolArray, FloatArray
from sfm.targets.edge_rays import RAYS

# Level of the tests of a photograph, divided by their number.
LEVEL = 0.01
# Numbers of neighbouring sectors that are tested together; an ellipse follows much of wider damage.
WIDTHS = (1, 2, 4)
# From so many sound targets on a photograph shows what they have in common.
MIN_POPULATION = 8
# Median over circles of the largest scan statistic, by simulation (tests/targets/test_outline_noise.py).
USUAL_SCAN = 2.18
# Scatter along an edge, and the largest scan statistic, are excused up to so many times the usual; more is
# damage in many places or of many targets.
MAX_LEVEL = 3.0
# Where few others show what is shape, damage is in at most so many places; a scratch is in two.
MAX_PLACES = 2
# Rounds of the robust fit, and its tuning constant for 95 % efficiency (Huber and Ronchetti 2009, sec. 4.8).
ROUNDS, BIWEIGHT = 10, 4.685
MAD = 1.4826
_PHI = 2 * np.pi * (np.arange(RAYS) + 0.5) / RAYS


def harmonics(first: int, last: int) -> FloatArray:
    """Return cosine and sine of these harmonics in the middle of each sector, shape (RAYS, 2 n)."""
    return np.column_stack([f(k * _PHI) for k in range(first, last + 1) for f in (np.cos, np.sin)])


_ELLIPSE = np.column_stack([np.ones(RAYS), harmonics(1, 2)])
_PRODUCTS = (_ELLIPSE[:, :, None] * _ELLIPSE[:, None, :]).reshape(-1, 25)  # of these, (RAYS, 25)


def find_damage(h: FloatArray, weight: FloatArray, sound: BoolArray, skirt: FloatArray) -> BoolArray:
    """Return which sectors of the edges are damaged.

    The largest scan statistic is cut first and the rest is tested again: a wide window about damage is
    significant, too, but not its other sectors.

    Args:
        h: deviations of the outlines from their ellipses and the common shape, radii, shape (k, RAYS).
        weight: 1 / variance of them by the noise of the intensities, shape (k, RAYS).
        sound: targets that show what is usual, shape (k,).
        skirt: so many sectors to both sides of damage are as blurred as it, shape (k,).

    Returns:
        Damaged sectors with their skirts, shape (k, RAYS).

    Source: Glaz, Naus and Wallenstein, Scan Statistics (2001), with Bonferroni's bound.
    """
    z = _robust_residuals(h, weight)
    level = np.maximum(MAD * np.median(np.abs(z), axis=1), 1.0)
    limit = -ndtri(LEVEL / (2 * len(WIDTHS) * RAYS * max(len(h), 1)))
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
    for i in range(1, RAYS // 2):
        damaged |= (np.roll(hit, i, axis=1) | np.roll(hit, -i, axis=1)) & (i <= skirt[:, None])
    return damaged


def common_shape(h: FloatArray, weight: FloatArray, sound: BoolArray) -> FloatArray:
    """Return the median deviation of the sound outlines in each sector, radii, (RAYS,); 0 for few of them."""
    seen = sound[:, None] & (weight > 0)
    enough = seen.sum(axis=0) >= MIN_POPULATION
    return np.array([np.median(h[seen[:, j], j]) if enough[j] else 0.0 for j in range(RAYS)])


def gap_shifts(common: FloatArray, weight: FloatArray, keep: BoolArray) -> FloatArray:
    """Return by how much gaps in the edges make the common shape shift the centres, radii, shape (k, 2)."""
    h = np.broadcast_to(common, weight.shape)
    return (_fit_harmonics(h, weight * keep) - _fit_harmonics(h, weight))[:, 1:3]


def _fit_harmonics(h: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the harmonics 0 to 2 of outlines, which ellipses follow to first order, radii, shape (k, 5)."""
    N = (weight @ _PRODUCTS).reshape(-1, 5, 5)
    N += 1e-9 * (1 + np.trace(N, axis1=1, axis2=2))[:, None, None] * np.eye(5)
    return np.asarray(np.linalg.solve(N, ((weight * h) @ _ELLIPSE)[..., None])[..., 0])


def _robust_residuals(h: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the residuals of ellipses through most sectors, in sigmas of the noise, shape (k, RAYS).

    Source: Huber and Ronchetti, Robust Statistics (2009): Tukey's biweight by iteratively reweighted least
    squares, from the fit of least absolute residuals.
    """
    robust, root = weight, np.sqrt(weight)
    z = h * root
    for k in range(2 * ROUNDS):
        z = (h - _fit_harmonics(h, robust) @ _ELLIPSE.T) * root
        if k < ROUNDS:
            robust = weight / np.maximum(np.abs(z), 0.1)
        else:
            scale = np.maximum(MAD * np.median(np.abs(z), axis=1), 1.0)[:, None]
            robust = weight * np.maximum(1 - (z / (BIWEIGHT * scale)) ** 2, 0.0) ** 2
    return z


def _scan(z: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the sums of so many residuals from each sector on, in sigmas, shape (k, len(WIDTHS), RAYS)."""
    total, norm = z * np.sqrt(weight), weight
    scans = np.empty((len(z), len(WIDTHS), RAYS))
    for k, width in enumerate(WIDTHS):
        if k:
            total = total + np.roll(total, -width // 2, axis=1)
            norm = norm + np.roll(norm, -width // 2, axis=1)
        scans[:, k] = np.abs(total) / np.sqrt(np.maximum(norm, 1e-12))
    return scans
