"""Seen targets joined with the image points of a network: their ellipses, and what was not used and why."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from sfm.conventions import FloatArray, IntArray
from sfm.report.viewer.scene import Marks
from sfm.result import likest_first
from sfm.solution import SeenTargets

SAME_PX = 0.5  # between a target and the image point made of it: re-measuring may move it
UNUSED = "measured, not part of the result"


def joined_targets(seen: SeenTargets, image: IntArray, xy: FloatArray) -> tuple[FloatArray, Marks]:
    """Return the ellipse of each image point, NaN without one, (k, 3), and what else was seen.

    Args:
        seen: in the same photographs.
        image: photograph of each image point, (k,).
        xy: where it is, px, (k, 2).
    """
    ellipse = np.full((len(xy), 3), np.nan)
    left = np.ones(len(seen.image), dtype=bool)
    for i in np.unique(seen.image).tolist():
        rows = np.flatnonzero(image == i)
        own = np.flatnonzero((seen.image == i) & seen.measured)
        used = _join(seen.xy[own], xy[rows])
        ellipse[rows[used[used >= 0]]] = seen.ellipse[own[used >= 0]]
        left[own[used >= 0]] = False
    kept = np.flatnonzero(left)
    kept = kept[np.argsort(seen.image[kept], kind="stable")]
    words = [seen.reason[k] or UNUSED for k in kept.tolist()]
    reasons = {word: number for number, word in enumerate(likest_first(set(words)))}
    number = np.array([reasons[word] for word in words], dtype=np.int64)
    return ellipse, Marks(seen.image[kept], seen.xy[kept], number, tuple(reasons))


def _join(targets: FloatArray, xy: FloatArray) -> IntArray:
    """Return for each target of a photograph the image point that was made of it, -1 for none, (k,)."""
    if not len(targets) or not len(xy):
        return np.full(len(targets), -1, dtype=np.int64)
    distance, nearest = cKDTree(xy).query(targets, distance_upper_bound=SAME_PX)
    return np.where(np.isfinite(distance), nearest, -1)
