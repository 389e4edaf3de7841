"""Rejected rays for which another ray of the same point could have been rejected just as well.

Of three rays two always nearly meet: which one is wrong is told by what remains along the epipolar line, and
data snooping blames the wrong one in a quarter of such points with an error of ten standard deviations. Both
explanations are compared by what they leave; where they differ by less than chance, the point is doubtful.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.5 (separability of alternative
hypotheses).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.point_normals import PointNormals
from sfm.adjustment.result import Adjustment
from sfm.conventions import IntArray
from sfm.distributions import chi2_isf

CHANCE = 1e-3  # of so much larger a misfit where the other explanation is the true one
MOVED = 3.0  # standard deviations by which the other explanation moves the point, for it to matter


@dataclass(frozen=True)
class DoubtfulPoint:
    """A point of which another ray may be the wrong one."""

    point: str
    rejected: str  # photograph of the ray that was rejected
    instead: str  # photograph of the ray that may as well be wrong
    misfit: float  # v'Pv that is left over sigma0^2
    other: float  # the same with the other ray rejected in its place


def doubtful_points(
    adjustment: Adjustment, parts: PointNormals, rows_of: list[IntArray]
) -> tuple[DoubtfulPoint, ...]:
    """Return the points of which another ray could have been rejected, the most doubtful first.

    Args:
        adjustment: with rejected image points.
        parts: its normal equations by image point.
        rows_of: usable image points of each object point.
    """
    images, seen = adjustment.network.images, adjustment.network.image_points
    limit = float(chi2_isf(CHANCE, 1))
    found = []
    for j in np.unique(seen.point[adjustment.rejected]).tolist():
        rows = rows_of[j]
        out, kept = rows[adjustment.rejected[rows]], rows[~adjustment.rejected[rows]]
        if not len(out) or len(kept) < 2:
            continue
        left = parts.misfit(kept)
        others = [
            (parts.misfit(np.append(np.delete(kept, s), r)), int(r), int(kept[s]))
            for r in out
            for s in range(len(kept))
        ]
        other, r, instead = min(others)
        if other - left < limit and _moved(parts, kept, np.append(kept[kept != instead], r)) > MOVED:
            names = images[seen.image[r]], images[seen.image[instead]]
            found.append(DoubtfulPoint(adjustment.network.points[j], *names, left, other))
    return tuple(sorted(found, key=lambda one: one.other - one.misfit))


def _moved(parts: PointNormals, kept: IntArray, other: IntArray) -> float:
    """Return how far a point moves from one choice of its rays to another, in standard deviations."""
    step = parts.step(other) - parts.step(kept)
    return float(np.sqrt(step @ parts.N[kept].sum(axis=0) @ step))
