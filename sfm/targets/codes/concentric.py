"""Concentric circle tags (CCTag): black rings around one centre, with the code in their widths.

The outer edge has radius 1. Each following edge is one step further in. A step is narrow for a clear bit and
wide for a set bit; the first step is the highest bit. Rings are alternately black and white from the outside,
and the central disc is white. The point of a tag is the image of the common centre, not the centre of an
ellipse.

Source: Calvet, Gurdjos, Griwodz and Gasparini (2016), "Detection and accurate localization of circular
fiducials under highly challenging conditions", CVPR; widths as published with alicevision/CCTag.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.runtime.sampling import as_grey, resample
from sfm.targets.fits.concentric import (
    CONTRAST,
    GEOMETRY,
    SPREAD,
    SPREAD_SIGMA,
    SURROUNDINGS,
    ConcentricFit,
    fit_concentric,
    fit_edges,
    positions_at,
    rho_at,
)
from sfm.targets.measure import axes_from_shape
from sfm.targets.outlines import (
    MIN_STEP,
    STEP_SIGMAS,
    Outlines,
    estimate_noise,
    find_outlines,
    scale_of,
)

# Number of steps, their minimum width, and the additional width of a set bit, in outer radii.
WIDTHS = {"cctag3": (5, 0.10, 0.05), "cctag4": (7, 0.08, 0.04)}
# Rings wider than this are resolved on every ray, like the modules of tags (`tags.MIN_MODULE_PX`).
RESOLVED_PX = 3.0
# Number of rays for edge detection, samples per px on them, and the part of the rays that must show all
# edges.
RAYS, SAMPLES_PER_PX, MIN_RAYS = 64, 2.0, 0.5
# Blurs, px, and scale errors of the outline for which profiles of tags are compared, and samples of a
# profile.
PROFILE_BLURS, PROFILE_SIZES, PROFILE = (0.6, 0.9, 1.3, 1.8, 2.5), (0.96, 0.98, 1.0, 1.02, 1.04), 80
# Maximum part of a profile that a tag may leave unexplained, and the number of most similar tags that are
# fitted. On 48 tags of 15 to 60 px the unexplained part was 0.05, and the right tag explained the most.
MAX_UNEXPLAINED_FRACTION, MAX_FITTED_TAGS = 0.1, 2
# A code is read if the radii are within a quarter of the way to any other code, the ink spreads by no more
# than a quarter of a bit, and half the way is at least this many standard deviations.
QUARTER, CODE_SIGMAS = 0.25, 5.0
# A priori sigma of a printed radius, outer radii: 0.05 mm on a tag of 40 mm, one dot at 600 dots per inch.
PRINT_SIGMA = 0.0025
# Maximum RMS residual on a sixteenth of the circumference, in steps of intensity. On tags of 15 to 40 px it
# is 1.05 times the noise: 0.074 with noise of 7 % of the step. More means that something covers the tag.
MAX_SECTOR_RMS = 0.3


@dataclass(frozen=True)
class ConcentricFamily:
    """The tags with one number of rings."""

    name: str
    """a name in WIDTHS"""
    steps: int
    """number of steps from the outer edge to the white disc, one bit each"""
    narrow: float
    """width of the step of a clear bit, outer radii"""
    bit: float
    """additional width of a set bit, outer radii"""

    @property
    def count(self) -> int:
        """Number of tags; their ids begin with 0."""
        return 1 << self.steps

    def radii(self, number: int) -> FloatArray:
        """Return the radii of all edges from the outside inwards, starting with 1, shape (steps + 1,).

        Raises:
            GeometryError: the family has no such tag.
        """
        if not 0 <= number < self.count:
            raise GeometryError(f"tag {number}: family {self.name} has 0 to {self.count - 1}")
        bits = (number >> np.arange(self.steps - 1, -1, -1)) & 1
        return np.append(1.0, 1.0 - np.cumsum(self.narrow + self.bit * bits))


@dataclass(frozen=True)
class ConcentricTags:
    """The tags of one photograph."""

    code: IntArray
    """ids, shape (k,)"""
    confidence: FloatArray
    """1 if the radii are exactly those of the code, 0.5 a quarter of the way to another one, shape (k,)"""
    fits: tuple[ConcentricFit, ...]
    """the fit of each tag"""

    def inside(self, xy: FloatArray) -> BoolArray:
        """Return which positions (n, 2) are on a tag or on the paper close around it."""
        within = np.zeros(len(xy), dtype=bool)
        for fit in self.fits:
            geometry = fit.theta[:GEOMETRY]
            reach = 2 * axes_from_shape(geometry[None, 2:5])[0][0, 0]  # rho is valid in front of the plane
            near = np.hypot(*(xy - geometry[:2]).T) < reach
            within[near] |= rho_at(geometry, xy[near])[0] < SURROUNDINGS
        return within


def concentric_family(name: str) -> ConcentricFamily:
    """Return the family with a name in WIDTHS."""
    return ConcentricFamily(name, *WIDTHS[name])


def mean_radius(geometry: FloatArray) -> float:
    """Return the mean radius of the outer edge, px."""
    p, q, r = geometry[2:5]
    return float(abs(p * r - q * q) ** -0.5)


def find_concentric(
    photograph: AnyArray, family: ConcentricFamily, outlines: Outlines, *, noise: float, scale: float
) -> ConcentricTags:
    """Read and measure the tags among the outlines of a photograph.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16.
        family: family of the tags.
        outlines: outlines of candidates, some of which are outer edges of tags.
        noise: standard deviation of the intensities.
        scale: largest intensity that the photograph can represent; intensities that reach it are censored.

    Returns:
        The tags, each once.
    """
    grey = as_grey(photograph)
    table = np.array([family.radii(k) for k in range(family.count)])
    least = max(STEP_SIGMAS * noise, MIN_STEP * scale)
    read = []
    for k in np.flatnonzero(_resembles_rings(grey, outlines, least)):
        start = np.concatenate([outlines.xy[k], outlines.shape[k], [0.0, 0.0]])
        tag = _read(grey, start, float(outlines.sign[k]), table, family, noise=noise, scale=scale)
        if tag is not None:
            read.append(tag)
    read.sort(key=lambda tag: -tag[1])
    kept: list[tuple[int, float, ConcentricFit]] = []
    for tag in read:
        tags = ConcentricTags(np.zeros(0, np.int64), np.zeros(0), tuple(fit for _, _, fit in kept))
        if not tags.inside(tag[2].theta[None, :2])[0]:
            kept.append(tag)
    code = np.array([number for number, _, _ in kept], dtype=np.int64)
    confidence = np.array([sure for _, sure, _ in kept], dtype=float)
    return ConcentricTags(code, confidence, tuple(fit for _, _, fit in kept))


def read_resolved(photograph: AnyArray) -> dict[str, IntArray]:
    """Return the ids of the tags whose rings are resolved on every ray, by family.

    Args:
        photograph: intensities, shape (H, W), uint8 or uint16.
    """
    noise, scale = estimate_noise(photograph), scale_of(photograph)
    families = [concentric_family(name) for name in WIDTHS]
    least = 2 * RESOLVED_PX / max(family.narrow for family in families)
    outlines = find_outlines(
        photograph, (1, -1), noise=noise, scale=scale, min_diameter_px=least, max_diameter_px=math.inf
    )
    return {
        family.name: find_concentric(photograph, family, outlines, noise=noise, scale=scale).code
        for family in families
    }


def _resembles_rings(grey: AnyArray, outlines: Outlines, least: float) -> BoolArray:
    """Return which outlines have ink inside the edge, and paper in the middle and outside, (k,)."""
    if not len(outlines.xy):
        return np.zeros(0, dtype=bool)
    p, q, r = outlines.shape.T[:, :, None]
    angle = np.linspace(0, 2 * math.pi, 16, endpoint=False)
    c, s = np.cos(angle), np.sin(angle)
    det = p * r - q * q
    ray = np.stack([(r * c - q * s) / det, (p * s - q * c) / det], axis=-1)
    radii = np.array([0.0, 0.93, SURROUNDINGS])
    points = outlines.xy[:, None, None] + radii[:, None, None] * ray[:, None]
    height, width = grey.shape
    low, high = points.min(axis=(1, 2)), points.max(axis=(1, 2))
    inside = (low >= 0).all(axis=1) & (high[:, 0] < width - 1) & (high[:, 1] < height - 1)
    points = np.clip(points, 0, [width - 1, height - 1])
    value = resample(grey, points.reshape(-1, 2), interpolation="bilinear").reshape(points.shape[:3])
    middle, ring, paper = np.median(value, axis=2).T * outlines.sign
    step = ring - paper
    return np.asarray(inside & (step > least / 2) & (ring - middle > step / 4))


def _read(
    grey: AnyArray,
    start: FloatArray,
    sign: float,
    table: FloatArray,
    family: ConcentricFamily,
    *,
    noise: float,
    scale: float,
) -> tuple[int, float, ConcentricFit] | None:
    """Return id, confidence and fit of the tag with about this outer edge; None without one."""
    least = max(STEP_SIGMAS * noise, MIN_STEP * scale)
    geometry = _edges_on_rays(grey, start, sign, family)
    if geometry is None:
        return None
    length = mean_radius(geometry)
    angle = np.linspace(0, 2 * math.pi, RAYS, endpoint=False)
    rho = (np.arange(PROFILE) + 0.5) / PROFILE * SURROUNDINGS
    points = positions_at(geometry, rho, angle)
    if not _within(grey, points):
        return None
    profile = np.median(_sampled(grey, points), axis=0)
    for number, size, blur in _most_similar(profile, rho, table, length):
        begin = geometry.copy()
        begin[2:5] /= size
        fit = fit_concentric(grey, begin, table[number], blur, noise=noise, saturation=scale)
        if fit is None:
            continue
        contrast = sign * fit.theta[CONTRAST]
        confidence = _confidence(fit, number, table, family)
        if confidence > 0 and contrast > least and fit.sectors.max() < MAX_SECTOR_RMS * contrast:
            return number, confidence, fit
    return None


def _confidence(fit: ConcentricFit, number: int, table: FloatArray, family: ConcentricFamily) -> float:
    """Return how well the radii agree with the code, 0 if another code is not excluded.

    On the line from this code (0) to each other one (1), the position that fits the photograph best is
    computed. Errors of the printed radii and the spread of the ink are random with a priori variances.
    """
    others = np.delete(table, number, axis=0)[:, 1:] - table[number, 1:]
    n = family.steps
    spreads = SPREAD_SIGMA * (1 - 2 * (np.arange(1, n + 1) % 2))
    printed = PRINT_SIGMA**2 * np.eye(n) + np.outer(spreads, spreads)
    # (M^-1 + R)^-1 of the information M and the covariance R in print, and its product with the corrections
    weight = np.linalg.inv(np.eye(n) + fit.radius_information @ printed)
    length = np.einsum("ki,ij,kj->k", others, weight @ fit.radius_information, others)
    shift = others @ (weight @ fit.radius_gradient) / np.maximum(length, 1e-12)
    spread = abs(fit.theta[SPREAD]) / family.bit
    if spread > QUARTER or np.abs(shift).max() > QUARTER or length.min() < (2 * CODE_SIGMAS) ** 2:
        return 0.0
    return float(1 - 2 * np.abs(shift).max())


def _edges_on_rays(
    grey: AnyArray, start: FloatArray, sign: float, family: ConcentricFamily
) -> FloatArray | None:
    """Return the geometry through the edges on rays.

    If the rays do not show all edges of a small tag, the outermost edge alone determines the geometry.
    """
    edges = family.steps + 1
    angle = np.linspace(0, 2 * math.pi, RAYS, endpoint=False)
    longest, shortest = axes_from_shape(start[None, 2:5])[0][0]
    count = int(np.clip(SAMPLES_PER_PX * SURROUNDINGS * longest, 40, 1000))
    rho = np.linspace(SURROUNDINGS, 0.0, count)
    points = positions_at(start, rho, angle)
    if not _within(grey, points):
        return None
    value = sign * _sampled(grey, points)
    paper = float(np.median(value[:, rho > 1.07]))
    ink = float(np.percentile(value[:, rho < 1.0], 95))
    if ink <= paper:
        return None
    level = (value - paper) / (ink - paper) - 0.5
    crossing = (level[:, 1:] > 0) != (level[:, :-1] > 0)
    complete = (crossing.sum(axis=1) == edges) & (level[:, 0] < 0)
    outer_edge = crossing.any(axis=1) & (level[:, 0] < 0)
    if outer_edge.mean() < MIN_RAYS:
        return None
    ray, at = np.nonzero(crossing)
    ring = (np.cumsum(crossing, axis=1) - 1)[ray, at]
    before, after = level[ray, at], level[ray, at + 1]
    share = before / (before - after)
    xy = points[ray, at] + share[:, None] * (points[ray, at + 1] - points[ray, at])
    geometry = None
    if complete.mean() >= MIN_RAYS:
        of = complete[ray]
        geometry = fit_edges(start, xy[of], ring[of], edges)
    elif family.narrow * shortest > RESOLVED_PX:
        return None
    if geometry is None:
        of = outer_edge[ray] & (ring == 0)
        geometry = fit_edges(start, xy[of], ring[of], 1)
    return geometry


def _most_similar(
    profile: FloatArray, rho: FloatArray, table: FloatArray, length: float
) -> list[tuple[int, float, float]]:
    """Return the most similar tags, sizes of their outer edges and blurs, px, at most MAX_FITTED_TAGS."""
    size = np.array(PROFILE_SIZES)
    # The tags share few radii: each edge is computed once and added to the tags that have it.
    radii, which = np.unique(np.round(table, 9), return_inverse=True)
    black = np.zeros((len(table), len(radii)))
    which = which.reshape(table.shape)
    black[np.arange(len(table))[:, None], which] = 1.0 - 2 * (np.arange(table.shape[1]) % 2)
    blur = np.array(PROFILE_BLURS)[:, None] / length
    ink = np.tensordot(black, ndtr(((radii[:, None] * size)[:, :, None, None] - rho) / blur), 1)
    weight = rho / rho.sum()
    ink -= (ink @ weight)[..., None]
    seen = profile - profile @ weight
    explained = (ink @ (weight * seen)) ** 2 / np.maximum((ink * ink) @ weight, 1e-12)
    share = explained / max(float(weight @ (seen * seen)), 1e-12)
    best = share.reshape(len(table), -1)
    order = np.argsort(-best.max(axis=1))[:MAX_FITTED_TAGS]
    at = best.argmax(axis=1)
    return [
        (int(k), float(size[at[k] // len(blur)]), PROFILE_BLURS[at[k] % len(blur)])
        for k in order
        if best[k].max() > 1 - MAX_UNEXPLAINED_FRACTION
    ]


def _within(grey: AnyArray, points: FloatArray) -> bool:
    """Return whether all positions (..., 2) are in the photograph."""
    height, width = grey.shape
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    return bool(np.isfinite(points).all() and low.min() >= 0 and high[0] < width - 1 and high[1] < height - 1)


def _sampled(grey: AnyArray, points: FloatArray) -> FloatArray:
    """Return the intensities at positions (k, m, 2), shape (k, m)."""
    value = resample(grey, points.reshape(-1, 2), interpolation="bilinear")
    return np.asarray(value, dtype=float).reshape(points.shape[:2])
