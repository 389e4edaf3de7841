"""Two sets of points brought onto one another by their geometry alone, whatever their names.

Triangles of neighbouring points are compared by their sides, or by the ratios of these where the scale is not
known. Each pair of triangles of one shape proposes a similarity, and the one that brings most points of one
set onto points of the other wins.

Source: Groth (1986), A pattern-matching algorithm for two-dimensional coordinate lists, Astronomical Journal
91, 1244-1248, with triangles in space; Fischler, Bolles (1981), Random sample consensus.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from sfm.comparison.pairing import nearest_places
from sfm.conventions import FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.similarity import MAX_COLLINEAR_RATIO, Similarity, fit_similarity

NEIGHBOURS = 6  # of each point, that make triangles with it
TRIANGLES = 100  # of the first set that are tried
SIMILAR_TRIANGLES = 5  # triangles of the second set that are tried for each
ROUNDS = 5  # of pairing and fitting after a proposal
ENOUGH_FRACTION = 0.9  # of the points: no better proposal is looked for
MIRROR = np.diag([1.0, 1.0, -1.0])


def find_pattern(
    a: FloatArray, b: FloatArray, *, scale: float | None = None, mirrored: bool = False
) -> Similarity | None:
    """Return the similarity that brings most points of b onto points of a; None if none brings four.

    Args:
        a: points, (n, 3).
        b: points in another frame, (m, 3).
        scale: of a over b; found too if not given.
        mirrored: whether the similarity has a reflection.
    """
    if min(len(a), len(b)) < 4:
        return None
    source = b @ MIRROR if mirrored else b
    ours, sides = _triangles(a)
    theirs, their_sides = _triangles(source if scale is None else scale * source)
    if scale is None:
        sides, their_sides = (np.log(s[:, :2] / s[:, 2:]) for s in (sides, their_sides))
    else:
        sides, their_sides = np.log(sides), np.log(their_sides)
    order = np.random.default_rng(len(a)).permutation(len(ours))[:TRIANGLES]
    near = (
        cKDTree(their_sides)
        .query(sides[order], k=min(SIMILAR_TRIANGLES, len(theirs)))[1]
        .reshape(len(order), -1)
    )
    best, most = None, 3
    for k, candidates in zip(order, near, strict=True):
        for j in candidates:
            try:
                found, count = _refined(
                    a, source, fit_similarity(source[theirs[j]], a[ours[k]], scale=scale), scale
                )
            except GeometryError:
                continue
            if count > most:
                best, most = found, count
        if most >= ENOUGH_FRACTION * min(len(a), len(b)):
            break
    if best is None:
        return None
    return replace(best, rotation=best.rotation @ MIRROR) if mirrored else best


def _refined(
    a: FloatArray, b: FloatArray, proposed: Similarity, scale: float | None
) -> tuple[Similarity, int]:
    """Return the similarity by all points that it brings onto others, and how many these are."""
    none = np.empty((0, 2), dtype=np.int64)
    every_a, every_b = np.ones(len(a), dtype=bool), np.ones(len(b), dtype=bool)
    found, count = proposed, 0
    for _ in range(ROUNDS):
        pairs = nearest_places((a, every_a), (found.apply(b), every_b), none)
        if len(pairs) <= max(3, count):
            break
        count = len(pairs)
        found = fit_similarity(b[pairs[:, 1]], a[pairs[:, 0]], scale=scale)
    return found, count


def _triangles(xyz: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return triangles of neighbours, vertices opposite to rising sides, (t, 3), and their sides, (t, 3)."""
    near = cKDTree(xyz).query(xyz, k=min(NEIGHBOURS + 1, len(xyz)))[1]
    corners = np.concatenate([near[:, [0, i, j]] for i, j in combinations(range(1, near.shape[1]), 2)])
    p = xyz[corners]
    sides = np.linalg.norm(p[:, [1, 2, 0]] - p[:, [2, 0, 1]], axis=2)
    order = np.argsort(sides, axis=1)
    sides = np.take_along_axis(sides, order, axis=1)
    corners = np.take_along_axis(corners, order, axis=1)
    proper = sides[:, 0] + sides[:, 1] > (1 + MAX_COLLINEAR_RATIO) * sides[:, 2]
    return corners[proper], sides[proper]
