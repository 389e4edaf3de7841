"""Coordinates of the same points in two results, and the covariance of their differences in any frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.files.covariance_file import MAX_POINTS
from sfm.similarity import Similarity, mean_distance
from sfm.solution import Solution

ROUNDING = 1e-9  # of the extent of the object: what computing in double precision and writing cost at most
MAX_HELD_VARIANCE = 1e-12  # variance over the mean one below which a coordinate is held


@dataclass(frozen=True)
class PointPairs:
    """Coordinates of the same points in two results, each in its frame and unit."""

    names: tuple[str, ...]  # n of them
    a: FloatArray  # (n, 3)
    b: FloatArray  # (n, 3)
    Q_a: FloatArray  # covariance of all coordinates of a, (3 n, 3 n)
    Q_b: FloatArray  # (3 n, 3 n)
    C: FloatArray | None  # covariance between a and b, (3 n, 3 n); None where they are independent
    scale: float | None  # of a over b where both have one; None where it is estimated
    redundancy: int | None  # of the variances; None if they are known

    def differences(self, a_from_b: Similarity) -> tuple[FloatArray, FloatArray]:
        """Return b - a in the frame of a (n, 3), and their covariance with that of rounding, (3 n, 3 n)."""
        n = len(self.a)
        J = a_from_b.scale * a_from_b.rotation
        Q = np.einsum("xi,aibj,yj->axby", J, self.Q_b.reshape(n, 3, n, 3), J, optimize=True)
        Q = self.Q_a + Q.reshape(3 * n, 3 * n)
        if self.C is not None:
            between = np.einsum("axbj,yj->axby", self.C.reshape(n, 3, n, 3), J).reshape(3 * n, 3 * n)
            Q -= between + between.T
        Q[np.diag_indices(3 * n)] += rounding_of(self.a) ** 2
        return a_from_b.apply(self.b) - self.a, Q

    def chosen(self, kept: IntArray, other: IntArray | None = None) -> PointPairs:
        """Return some of the pairs, with the points of b that are others of them than by their names.

        Args:
            kept: which of a, (k,).
            other: which of b, (k,); the same if not given.
        """
        other = kept if other is None else other
        rows, columns = coordinates_of(kept), coordinates_of(other)
        return replace(
            self,
            names=tuple(self.names[k] for k in kept),
            a=self.a[kept],
            b=self.b[other],
            Q_a=self.Q_a[np.ix_(rows, rows)],
            Q_b=self.Q_b[np.ix_(columns, columns)],
            C=None if self.C is None else self.C[np.ix_(rows, columns)],
        )


def pairs_of_results(
    a: Solution, b: Solution, points: IntArray, scale: float | None
) -> tuple[PointPairs, IntArray, BoolArray]:
    """Return points that two results have in common, and which of them these are.

    Where the covariance of all points together is known of neither, that of each single point is taken, and
    of more points than a covariance is kept of every so manieth.

    Args:
        a: first result.
        b: second result.
        points: indices of the same points in both, (n, 2).
        scale: of a over b where both have one.
    """
    known = [one for one in (a, b) if one.point_covariance is not None or one.covariance is not None]
    joint = all(one.covariance is not None for one in known)
    rows_a, rows_b = (one.covariance_rows(p) for one, p in zip((a, b), points.T, strict=True))
    together = (rows_a >= 0) & (rows_b >= 0) if joint else _has_sigma(a, b, points)
    chosen = np.flatnonzero(together)
    chosen = chosen[:: -(-len(chosen) // MAX_POINTS)] if len(chosen) else chosen
    pa, pb = points[chosen].T
    redundancies = [one.redundancy for one in known if one.redundancy is not None]
    pairs = PointPairs(
        tuple(a.network.points[j] for j in pa),
        a.estimate.points[pa],
        b.estimate.points[pb],
        _covariance_of(a, pa, joint),
        _covariance_of(b, pb, joint),
        None,
        scale,
        sum(redundancies) if redundancies else None,
    )
    if all(one.datum == "control" for one in known):
        variance = np.diagonal(pairs.Q_a) + (scale or 1.0) ** 2 * np.diagonal(pairs.Q_b)
        free = np.flatnonzero(~held_points(variance.reshape(-1, 3)))
        pairs, chosen = pairs.chosen(free), chosen[free]
    return pairs, chosen, together


def held_points(variance: FloatArray) -> BoolArray:
    """Return whether a coordinate of a point is known without error, so that nothing is left to test, (n,).

    Args:
        variance: of the coordinates, object unit^2, (n, 3).
    """
    return (
        np.asarray((variance <= MAX_HELD_VARIANCE * variance.mean()).any(axis=1))
        if len(variance)
        else np.zeros(0, dtype=bool)
    )


def rounding_of(xyz: FloatArray) -> float:
    """Return the standard deviation of rounding of the coordinates (n, 3) of an object, object unit."""
    return ROUNDING * mean_distance(xyz) if len(xyz) else 0.0


def coordinates_of(points: IntArray) -> IntArray:
    """Return the rows of the coordinates of points, (3 k,)."""
    return np.asarray((3 * points[:, None] + np.arange(3)).ravel())


def _has_sigma(a: Solution, b: Solution, points: IntArray) -> BoolArray:
    """Return whether the covariance of either point is known, (n,)."""
    known = [
        np.isfinite(one.point_covariance[p]).all(axis=(1, 2))
        for one, p in zip((a, b), points.T, strict=True)
        if one.point_covariance is not None
    ]
    return np.any(known, axis=0) if known else np.zeros(len(points), dtype=bool)


def _covariance_of(result: Solution, points: IntArray, joint: bool) -> FloatArray:
    """Return the covariance of points together, that of each single one, or 0 where none is known."""
    n = len(points)
    if joint and result.covariance is not None:
        rows = coordinates_of(result.covariance_rows(points))
        return np.asarray(result.covariance[np.ix_(rows, rows)])
    Q = np.zeros((n, 3, n, 3))
    if not joint and result.point_covariance is not None:
        Q[np.arange(n), :, np.arange(n)] = np.nan_to_num(result.point_covariance[points])
    return Q.reshape(3 * n, 3 * n)
