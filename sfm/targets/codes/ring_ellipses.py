"""Rings of codes as a photograph shows them: their radii, and the ellipses that they are.

On a ray from the centre of a dot through a set cell the intensity leaves the dot, rises again at the inner
radius of the ring and falls at its outer radius. Makers print rings of different proportions, but these two
radii are the same on all such rays of all targets of a make. What else is around dots (neighbours, letters,
edges of labels) is not concentric with them, and is not at the same radii around several dots.

A ring is not always similar to its dot: in perspective it is displaced, and motion blur flattens a small dot
more than the ring around it. The radii on the rays of one dot show both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled
from sfm.runtime.sampling import bilinear
from sfm.targets.edge_rays import reshape

# Rays, and the steps along them, in radii of the dot. A ring farther away than this is not searched.
ANGLES, STEP, FARTHEST = 180, 0.05, 6.0
# Pairs of radii within this of each other are one ring in different photographs or of different dots.
SAME_RING = 0.15
# Perspective and motion blur move the edges of a ring by up to this part of their radius from ray to ray.
DISPLACED = 0.1
# A dot has such a ring if it is on this part of its rays (half a cell of a ring of 20), and on this part of
# the rays that rise anywhere before its outer radius: an arc rises there on all of them, and the ring between
# dot and arcs is clear. A round neighbour rises there on 0.71, and on 0.77 with soft edges; in the window
# between two neighbours farther ones look like an arc, but on the rays beside it the neighbours rise before.
LEAST_SEEN, PURE = 0.025, 0.9
# A dot has no ring if fewer of the rays that rise before its outer radius than this part cross edges at the
# same radii, within these parts of them. Of 1,148 rings that are read (retro-panel, rings on screens,
# sharpened JPEG, and tests of spread ink and light, blur, other proportions and tilt) the worst has 0.51, and
# all but three have 0.89. Of holes and keys in rendered plates and keyboards 5 % have more than 0.4.
LEAST_ALIKE, INNER_ALIKE, OUTER_ALIKE = 0.4, 0.15, 0.2
# Number of dots that must have the same ring.
MIN_DOTS = 3
# A priori sigma of the displacement and of the flattening of a ring relative to its dot, and of the radius on
# a ray, in radii of the ring. Neighbouring rays are not independent: each counts as a quarter.
_HARMONIC_SIGMA, _RAY_SIGMA = 0.05, 0.02


class Rings(NamedTuple):
    """Rings around some of the dots of a photograph."""

    inner: float
    """inner radius, in radii of the dot"""
    outer: float
    """outer radius, in radii of the dot"""
    are_other: bool
    """whether several dots have other radii than the expected ones in common"""
    row: IntArray
    """dots that may have such a ring: all of them if the radii are other ones, shape (m,)"""
    shape: FloatArray
    """(p, q, r) of S, which turns image vectors into dot radii on the ring; that of the dot where the ring is
    not seen well, 1/px, shape (m, 3)"""
    tilt: FloatArray
    """perspective g: a point at rho (cos t, sin t) radii is seen at rho + rho^2 (g1 cos t + g2 sin t) radii,
    shape (m, 2)"""


def measure_rings(crossings: FloatArray, shape: FloatArray, expected: tuple[float, float]) -> Rings:
    """Find the rings that most dots have in common, and measure the ellipses that they are.

    Args:
        crossings: radii where the rays of each dot cross a ring, see `trace_crossings`, (k, ANGLES, 2).
        shape: (p, q, r) of S, which turns image vectors into dot radii, 1/px, shape (k, 3).
        expected: inner and outer radius in radii of the dot, which are used if fewer than three dots have
            other radii in common.
    """
    common = _common_radii(crossings)
    inner, outer = expected
    other = common is not None and bool(np.abs(common - expected).max() > SAME_RING)
    if common is not None and other:
        inner, outer = common.tolist()
    dots = len(shape)
    row = np.arange(dots)
    seen_shape, tilt, seen = np.array(shape, dtype=float), np.zeros((dots, 2)), np.zeros(dots, bool)
    for k in row:
        on = _on_ring(crossings[k], inner, outer, DISPLACED)
        if on.any():
            seen[k] = True
            seen_shape[k], tilt[k] = _as_seen(shape[k], crossings[k].mean(axis=1), (inner + outer) / 2, on)
    row = row if other else row[seen]
    return Rings(inner, outer, other, row, seen_shape[row], tilt[row])


@compiled
def trace_crossings(image: AnyArray, xy: FloatArray, shape: FloatArray, levels: FloatArray) -> FloatArray:
    """Return where rays rise to half the step behind the gap around the dot, and fall again.

    Args:
        image: intensities, shape (H, W).
        xy: centres of the dots, px, shape (k, 2).
        shape: (p, q, r) of S, which turns image vectors into dot radii, 1/px, shape (k, 3).
        levels: intensity of the background and its step to the dot, shape (k, 2).

    Returns:
        Radii, nan where the ray does not rise or fall within the photograph, (k, ANGLES, 2).
    """
    height, width = image.shape
    out = np.full((len(xy), ANGLES, 2), math.nan)
    for k in range(len(xy)):
        p, q, r = shape[k]
        det = p * r - q * q
        for j in range(ANGLES):
            t = 2 * math.pi * j / ANGLES
            c, s = math.cos(t), math.sin(t)
            ex, ey = (r * c - q * s) / det, (p * s - q * c) / det
            edges, before, rho = 0, 1.0, 1.0
            while edges < 3 and rho < FARTHEST:
                x, y = xy[k, 0] + rho * ex, xy[k, 1] + rho * ey
                if not (x >= 0 and y >= 0 and x < width - 1 and y < height - 1):
                    break
                level = (bilinear(image, x, y) - levels[k, 0]) / levels[k, 1] - 0.5
                if (level > 0) == (edges % 2 == 1):  # the dot ends, the ring begins, the ring ends
                    if edges:
                        out[k, j, edges - 1] = rho - STEP * level / (level - before)
                    edges += 1
                before, rho = level, rho + STEP
            if edges < 3:
                out[k, j, 1] = math.nan
    return out


@compiled
def may_have_rings(crossings: FloatArray, inner: float, outer: float) -> BoolArray:
    """Return which dots may have a ring with these radii; without one, the rays cross something else.

    All edges of a ring are moved alike by spreading ink and light, so the inner radius on most rays gives the
    outer one. A ray that does not fall again says nothing about the outer radius, and a dot with hardly any
    rays that rise says nothing at all, because a blurred ring may stay below half a step.

    Args:
        crossings: radii where the rays of each dot cross a ring, see `trace_crossings`, (k, ANGLES, 2).
        inner: inner radius of the ring in radii of the dot.
        outer: outer radius of the ring in radii of the dot.

    Returns:
        Shape (k,).
    """
    out = np.ones(len(crossings), np.bool_)
    for k in range(len(crossings)):
        rays = crossings[k]
        rises = rays[:, 0] < outer  # nan does not rise
        rising = rises.sum()
        if rising < LEAST_SEEN * ANGLES:
            continue
        begin = np.median(rays[rises, 0])
        spread = (inner - begin) / (inner + 1)
        end = outer * (1 - spread) + spread
        alike = 0
        for ray in rays[rises]:
            falls_elsewhere = abs(ray[1] - end) > OUTER_ALIKE * end  # nan falls nowhere
            alike += abs(ray[0] - begin) <= INNER_ALIKE * begin and not falls_elsewhere
        out[k] = alike >= LEAST_ALIKE * rising
    return out


@compiled
def _common_radii(crossings: FloatArray) -> FloatArray | None:
    """Return the inner and outer radius that most dots have, (2,); None if there are too few."""
    bins = int(FARTHEST / SAME_RING) + 2
    dots, last = np.zeros((bins, bins), np.int64), np.full((bins, bins), -1)
    for k in range(len(crossings)):
        for ray in crossings[k]:
            if math.isnan(ray[1]):
                continue
            i, j = int(ray[0] / SAME_RING), int(ray[1] / SAME_RING)
            for m in range(i, i + 2):
                for n in range(j, j + 2):
                    dots[m, n] += last[m, n] != k
                    last[m, n] = k
    having = np.empty((len(crossings), 2))
    best, most = np.zeros(2), MIN_DOTS - 1
    while dots.max() > most:
        cell = int(dots.argmax())
        dots.flat[cell] = 0
        inner, outer = SAME_RING * (cell // bins), SAME_RING * (cell % bins)
        count = 0
        for k in range(len(crossings)):
            on = _on_ring(crossings[k], inner, outer, 0.0)
            if on.any():
                for edge in range(2):
                    having[count, edge] = np.median(crossings[k][on, edge])
                count += 1
        if count > most:
            most = count
            best[0], best[1] = np.median(having[:count, 0]), np.median(having[:count, 1])
    return best if most >= MIN_DOTS else None


@compiled
def _on_ring(rays: FloatArray, inner: float, outer: float, part: float) -> BoolArray:
    """Return which rays of a dot cross a ring with about these radii, (ANGLES,); none without the ring.

    Args:
        rays: inner and outer radius on each ray, (ANGLES, 2).
        inner: inner radius.
        outer: outer radius.
        part: permitted difference from the inner radius as a part of it, which is SAME_RING at least.
    """
    on = np.zeros(len(rays), np.bool_)
    near = max(SAME_RING, part * inner)
    far = near * (outer / max(inner, near)) ** 2  # perspective displaces points by the square of the radius
    crossing, before = 0, 0
    for k in range(len(rays)):
        on[k] = abs(rays[k, 0] - inner) <= near and abs(rays[k, 1] - outer) <= far
        crossing += on[k]
        before += on[k] or rays[k, 0] < outer
    if crossing < LEAST_SEEN * ANGLES or crossing < PURE * before:
        on[:] = False
    return on


def _as_seen(
    shape: FloatArray, radius: FloatArray, middle: float, on: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return (p, q, r) of S, (3,), and the perspective g, (2,), of a ring.

    Perspective displaces points along the rays from the centre, motion blur changes the shape.

    Args:
        shape: (p, q, r) of S of the dot, 1/px, (3,).
        radius: radius of the middle of the ring on each ray, radii of the dot, (ANGLES,).
        middle: that radius for a ring that is similar to its dot.
        on: rays that cross the ring, (ANGLES,).
    """
    t = 2 * np.pi * np.flatnonzero(on) / ANGLES
    A = np.column_stack([np.ones(len(t)), np.cos(t), np.sin(t), np.cos(2 * t), np.sin(2 * t)])
    prior = np.diag([0.0, 1.0, 1.0, 1.0, 1.0]) * 4 * (_RAY_SIGMA / _HARMONIC_SIGMA) ** 2
    c = np.linalg.solve(A.T @ A + prior, A.T @ radius[on] / middle)
    theta = np.concatenate([np.zeros(2), shape])
    reshape(theta, np.array([c[0], 0.0, 0.0, c[3], c[4]]))
    return theta[2:], c[1:3] / middle
