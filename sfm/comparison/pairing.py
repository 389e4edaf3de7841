"""Pairs of points and photographs that two results have in common, and the covariance of their differences.

Names are used if they identify something: codes, control, given observations, or file names. Uncoded targets
and tie points get new numbers in every run, and some formats have no names at all. If both results have the
same photographs, such a point is recognised by its image points. Otherwise it is recognised by its position,
after an alignment on the pairs found so far. Numbers that identify nothing are never compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from sfm.model.camera import tangents_from_pixel
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.model.network import rows_of
from sfm.model.similarity import Similarity, extended_axes, fit_similarity, mean_distance
from sfm.model.solution import MAX_POINTS, UNCODED, Solution

ROUNDING = 1e-9  # of the extent of the object: largest error of double precision and of written digits
MAX_HELD_VARIANCE = 1e-12  # of the mean variance; a coordinate with less is held fixed
SAME_PX = 1e-2  # closer image points are one measurement, rounded in files
SAME_RAY_PX = 0.1  # the same for directions, which differ by the conversion of the camera
NEAR_PX = 1.0  # measurements of one target or one piece of texture by two programs are closer than this
MAJORITY = 0.5  # of the rays in common photographs on which two points must coincide
# Largest distance of two positions of one point, over the distance to the next neighbour.
MAX_PLACE_FRACTION = 0.3
ROUNDS = 20  # of weighting
SAME_PLACE = 0.5  # of the points must coincide for two results to be in the same frame already


@dataclass(frozen=True)
class Pairing:
    """Common points and photographs of two results, by index, and how they were recognised."""

    points: IntArray  # of a and of b, (n, 2)
    images: IntArray  # of a and of b, (m, 2)
    points_by_name: int
    points_by_image_points: int
    points_by_place: int
    images_by_name: int
    # Image points of a and of b in one frame, px, (k, 2) each. They are directions times c if one result is
    # corrected for distortion or has another pixel origin.
    xy: tuple[FloatArray, FloatArray]


def pair_results(a: Solution, b: Solution) -> Pairing:
    """Pair the points and photographs of two results.

    Args:
        a: first result.
        b: second result.
    """
    images = _by_name(
        a.network.images,
        a.estimate.oriented & a.images_named,
        b.network.images,
        b.estimate.oriented & b.images_named,
    )
    by_name = len(images)
    images, xy = _images_by_image_points(a, b, images)
    ours, theirs = identified(a), identified(b)
    points = _by_name(a.network.points, ours, b.network.points, theirs)
    named = len(points)
    further = _points_by_image_points(a, b, xy, images, points)
    points = np.concatenate([points, further[~(ours[further[:, 0]] & theirs[further[:, 1]])]])
    seen = len(points)
    transform = _frame(a, b, points, images)
    if transform is not None:
        moved = transform.apply_estimate(b.estimate)
        further = nearest_places(
            (a.estimate.points, a.estimate.determined), (moved.points, moved.determined), points
        )
        points = np.concatenate([points, further[~(ours[further[:, 0]] & theirs[further[:, 1]])]])
        if not (a.images_named and b.images_named):
            further = nearest_places(
                (a.estimate.position, a.estimate.oriented), (moved.position, moved.oriented), images
            )
            images = np.concatenate([images, further])
    return Pairing(
        points[np.argsort(points[:, 0], kind="stable")],
        images[np.argsort(images[:, 0], kind="stable")],
        named,
        seen - named,
        len(points) - seen,
        by_name,
        xy,
    )


def identified(result: Solution) -> BoolArray:
    """Return whether the name of each determined point identifies it, (n,)."""
    if not result.points_named:
        return np.zeros(len(result.network.points), dtype=bool)
    named = np.array([UNCODED.fullmatch(name) is None for name in result.network.points], dtype=bool)
    return named & result.estimate.determined


def _by_name(a: tuple[str, ...], a_known: BoolArray, b: tuple[str, ...], b_known: BoolArray) -> IntArray:
    index = {name: k for k, name in enumerate(b) if b_known[k]}
    rows = [(k, index[name]) for k, name in enumerate(a) if a_known[k] and name in index]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def _free(count: int, taken: IntArray) -> BoolArray:
    free = np.ones(count, dtype=bool)
    free[taken] = False
    return free


def _best_pairs(votes: IntArray, weight: IntArray, enough: FloatArray) -> IntArray:
    """Return the pairs (i, j) with enough votes, and with more votes than any other pair of i or of j."""
    if not len(votes):
        return votes
    most_i = np.zeros(votes[:, 0].max() + 1)
    most_j = np.zeros(votes[:, 1].max() + 1)
    np.maximum.at(most_i, votes[:, 0], weight)
    np.maximum.at(most_j, votes[:, 1], weight)
    good = (weight >= enough) & (weight == most_i[votes[:, 0]]) & (weight == most_j[votes[:, 1]])
    pairs: IntArray = votes[good]
    once = (np.bincount(pairs[:, 0])[pairs[:, 0]] == 1) & (np.bincount(pairs[:, 1])[pairs[:, 1]] == 1)
    return pairs[once] if len(pairs) else pairs


def _images_by_image_points(
    a: Solution, b: Solution, images: IntArray
) -> tuple[IntArray, tuple[FloatArray, FloatArray]]:
    """Pair photographs, (m, 2), by measurements at the same positions, then by rays of the same direction."""
    as_they_are = a.network.image_points.xy, b.network.image_points.xy
    if a.images_named and b.images_named:
        return images, as_they_are
    further = _images_of_places(a, b, as_they_are, images, SAME_PX)
    if len(further):
        return np.concatenate([images, further]), as_they_are
    c_px = float(np.median([camera.c_px for camera in a.estimate.cameras]))
    of_rays = c_px * directions(a), c_px * directions(b)
    further = _images_of_places(a, b, of_rays, images, SAME_RAY_PX)
    return np.concatenate([images, further]), of_rays if len(further) else as_they_are


def directions(result: Solution) -> FloatArray:
    """Return the tangents of the rays of all image points, NaN where distortion is not invertible, (k, 2)."""
    seen = result.network.image_points
    uv = np.full(seen.xy.shape, np.nan)
    of_camera = rows_of(result.network.camera[seen.image], len(result.estimate.cameras))
    for camera, rows in zip(result.estimate.cameras, of_camera, strict=True):
        uv[rows] = tangents_from_pixel(camera, seen.xy[rows])
    return uv


def _images_of_places(
    a: Solution, b: Solution, xy: tuple[FloatArray, FloatArray], images: IntArray, same_px: float
) -> IntArray:
    """Pair the photographs that are not paired yet by image points at the same positions."""
    none = np.empty((0, 2), dtype=np.int64)
    ours, theirs = a.network.image_points, b.network.image_points
    free_a = (_free(len(a.network.images), images[:, 0]) & a.estimate.oriented)[ours.image]
    free_b = (_free(len(b.network.images), images[:, 1]) & b.estimate.oriented)[theirs.image]
    rows_a = np.flatnonzero(free_a & np.isfinite(xy[0]).all(axis=1))
    rows_b = np.flatnonzero(free_b & np.isfinite(xy[1]).all(axis=1))
    if not len(rows_a) or not len(rows_b):
        return none
    near = cKDTree(xy[0][rows_a]).query_ball_tree(cKDTree(xy[1][rows_b]), same_px)
    near_pairs = [
        (ours.image[i], theirs.image[j]) for i, js in zip(rows_a, near, strict=True) for j in rows_b[js]
    ]
    if not near_pairs:
        return none
    votes, weight = np.unique(np.array(near_pairs), axis=0, return_counts=True)
    count_a, count_b = np.bincount(ours.image), np.bincount(theirs.image)
    return _best_pairs(votes, weight, MAJORITY * np.minimum(count_a[votes[:, 0]], count_b[votes[:, 1]]))


def _points_by_image_points(
    a: Solution, b: Solution, xy: tuple[FloatArray, FloatArray], images: IntArray, points: IntArray
) -> IntArray:
    """Pair points that have the same image points in most of the common photographs that see them."""
    ours, theirs = a.network.image_points, b.network.image_points
    free_a = _free(len(a.network.points), points[:, 0]) & a.estimate.determined
    free_b = _free(len(b.network.points), points[:, 1]) & b.estimate.determined
    use_a = free_a[ours.point] & np.isfinite(xy[0]).all(axis=1)
    use_b = free_b[theirs.point] & np.isfinite(xy[1]).all(axis=1)
    near_pairs = []
    of_image_a = rows_of(ours.image, len(a.network.images))
    of_image_b = rows_of(theirs.image, len(b.network.images))
    for i, j in images:
        rows_a = of_image_a[i][use_a[of_image_a[i]]]
        rows_b = of_image_b[j][use_b[of_image_b[j]]]
        if not len(rows_a) or not len(rows_b):
            continue
        there = cKDTree(xy[1][rows_b]).query(xy[0][rows_a], distance_upper_bound=NEAR_PX)[1]
        back = cKDTree(xy[0][rows_a]).query(xy[1][rows_b], distance_upper_bound=NEAR_PX)[1]
        k = np.flatnonzero(there < len(rows_b))
        k = k[back[there[k]] == k]
        near_pairs.append(np.stack([ours.point[rows_a[k]], theirs.point[rows_b[there[k]]]], axis=1))
    if not near_pairs or not sum(map(len, near_pairs)):
        return np.empty((0, 2), dtype=np.int64)
    votes, weight = np.unique(np.concatenate(near_pairs), axis=0, return_counts=True)
    shared_a = np.bincount(ours.point[np.isin(ours.image, images[:, 0])], minlength=len(free_a))
    shared_b = np.bincount(theirs.point[np.isin(theirs.image, images[:, 1])], minlength=len(free_b))
    return _best_pairs(votes, weight, MAJORITY * np.minimum(shared_a[votes[:, 0]], shared_b[votes[:, 1]]))


def _frame(a: Solution, b: Solution, points: IntArray, images: IntArray) -> Similarity | None:
    """Return a_from_b from the pairs so far, or the identity if the results coincide; else None."""
    for pairs, ours, theirs in (
        (points, a.estimate.points, b.estimate.points),
        (images, a.estimate.position, b.estimate.position),
    ):
        if len(pairs) >= 3:
            try:
                return fit_robustly(theirs[pairs[:, 1]], ours[pairs[:, 0]])
            except GeometryError:
                continue
    as_they_are = Similarity(1.0, np.eye(3), np.zeros(3))
    pairs = nearest_places(
        (a.estimate.points, a.estimate.determined), (b.estimate.points, b.estimate.determined), points
    )
    least = SAME_PLACE * min(int(a.estimate.determined.sum()), int(b.estimate.determined.sum()))
    return as_they_are if len(pairs) >= max(3.0, least) else None


def fit_robustly(source: FloatArray, target: FloatArray, *, scale: float | None = None) -> Similarity:
    """Return the similarity that most of the points agree on: iterated weights 1 / distance (L1 norm).

    Args:
        source: points in the source frame, source unit, (n, 3).
        target: the same points in the target frame, target unit, (n, 3).
        scale: scale to keep; estimated if not given.

    Raises:
        GeometryError: fewer than three points, or all points on a line.

    Source: Caspary (2000), Concepts of network and deformation analysis, sec. 8.3 (robust transformation).
    """
    similarity = fit_similarity(source, target, scale=scale)
    for _ in range(ROUNDS):
        length = np.linalg.norm(similarity.apply(source) - target, axis=1)
        least = 1e-3 * np.median(length)
        if not least > 0:
            break
        similarity = fit_similarity(source, target, scale=scale, weights=1 / np.maximum(length, least))
    return similarity


def fit_affinity(start: Similarity, a: FloatArray, b: FloatArray, reference: BoolArray) -> Similarity:
    """Return the affinity that most of the points agree on, as a similarity whose rotation is any matrix.

    The object is sheared and stretched along the axes along which it extends. The L1 norm is minimised.

    Args:
        start: similarity from b to a.
        a: points, (n, 3).
        b: the same points in the other frame, (n, 3).
        reference: points that take part, (n,).
    """
    source = start.apply(b)
    axes, along = extended_axes(source)
    X, gap = np.hstack([np.ones((len(a), 1)), along])[reference], (a - source)[reference]
    weight = np.ones(len(X))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        shift, *shapes = np.linalg.lstsq(root * X, root * gap, rcond=None)[0]
        length = np.linalg.norm(gap - X @ [shift, *shapes], axis=1)
        least = 1e-3 * np.median(length)
        if not least > 0:
            break
        weight = 1 / np.maximum(length, least)
    A = np.eye(3) + np.transpose(shapes) @ axes
    centre = source.mean(axis=0)
    return replace(
        start, rotation=A @ start.rotation, translation=A @ (start.translation - centre) + centre + shift
    )


def nearest_places(
    a: tuple[FloatArray, BoolArray], b: tuple[FloatArray, BoolArray], pairs: IntArray
) -> IntArray:
    """Pair positions that are mutually nearest and much closer than the next neighbour of either.

    Args:
        a: positions in a's frame, (n, 3), and which are known, (n,).
        b: positions in a's frame, (m, 3), and which are known, (m,).
        pairs: pairs so far, (k, 2), which are excluded.
    """
    rows_a = np.flatnonzero(a[1] & _free(len(a[0]), pairs[:, 0]))
    rows_b = np.flatnonzero(b[1] & _free(len(b[0]), pairs[:, 1]))
    if not len(rows_a) or not len(rows_b):
        return np.empty((0, 2), dtype=np.int64)
    ours, theirs = a[0][rows_a], b[0][rows_b]
    tree_a, tree_b = cKDTree(ours), cKDTree(theirs)
    distance, there = tree_b.query(ours)
    back = tree_a.query(theirs)[1]
    k = np.flatnonzero(back[there] == np.arange(len(ours)))
    good = distance[k] < MAX_PLACE_FRACTION * np.minimum(
        _spacing(a, rows_a[k]), _spacing(b, rows_b[there[k]])
    )
    nearest: IntArray = np.stack([rows_a[k], rows_b[there[k]]], axis=1)[good]
    return nearest


def _spacing(result: tuple[FloatArray, BoolArray], rows: IntArray) -> FloatArray:
    """Return the distance of each position to its nearest neighbour in the same result, else infinite."""
    places = result[0][result[1]]
    if len(places) < 2:
        return np.full(len(rows), np.inf)
    return np.asarray(cKDTree(places).query(result[0][rows], k=2)[0][:, 1])


@dataclass(frozen=True)
class PointPairs:
    """Coordinates of the same points in two results, each in its frame and unit."""

    names: tuple[str, ...]  # (n,)
    a: FloatArray  # (n, 3)
    b: FloatArray  # (n, 3)
    Q_a: FloatArray  # covariance of all coordinates of a, (3 n, 3 n)
    Q_b: FloatArray  # (3 n, 3 n)
    C: FloatArray | None  # covariance between a and b, (3 n, 3 n); None if they are independent
    scale: float | None  # of a over b if both have a scale; None if it is estimated
    redundancy: int | None  # of the variances; None if they are known

    def differences(self, a_from_b: Similarity) -> tuple[FloatArray, FloatArray]:
        """Return b - a in the frame of a, (n, 3), and their covariance including rounding, (3 n, 3 n)."""
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
        """Return the selected pairs, in which points of b may be assigned differently from their names.

        Args:
            kept: points of a, (k,).
            other: points of b, (k,); the same as `kept` if not given.
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
    """Return the coordinates of common points with their covariance.

    If the joint covariance of all points is unknown, that of each single point is used. If there are more
    points than a covariance is stored for, every k-th point is used.

    Args:
        a: first result.
        b: second result.
        points: indices of the same points in both results, (n, 2).
        scale: scale of a over b, if both have a scale.

    Returns:
        The pairs; their rows in `points`, (k,); and which rows of `points` have a known covariance, (n,).
    """
    known = [
        result for result in (a, b) if result.point_covariance is not None or result.covariance is not None
    ]
    joint = all(result.covariance is not None for result in known)
    rows_a, rows_b = (result.covariance_rows(p) for result, p in zip((a, b), points.T, strict=True))
    if joint:
        together = (rows_a >= 0) & (rows_b >= 0)
    else:  # the covariance of either point of each pair
        of_points = [
            np.isfinite(result.point_covariance[p]).all(axis=(1, 2))
            for result, p in zip((a, b), points.T, strict=True)
            if result.point_covariance is not None
        ]
        together = np.any(of_points, axis=0) if of_points else np.zeros(len(points), dtype=bool)
    chosen = np.flatnonzero(together)
    chosen = chosen[:: -(-len(chosen) // MAX_POINTS)] if len(chosen) else chosen
    pa, pb = points[chosen].T
    redundancies = [result.redundancy for result in known if result.redundancy is not None]
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
    if all(result.datum == "control" for result in known):
        variance = np.diagonal(pairs.Q_a) + (scale or 1.0) ** 2 * np.diagonal(pairs.Q_b)
        free = np.flatnonzero(~held_points(variance.reshape(-1, 3)))
        pairs, chosen = pairs.chosen(free), chosen[free]
    return pairs, chosen, together


def held_points(variance: FloatArray) -> BoolArray:
    """Return whether any coordinate of a point is known without error, so that it cannot be tested, (n,).

    Args:
        variance: variances of the coordinates, object unit^2, (n, 3).
    """
    return (
        np.asarray((variance <= MAX_HELD_VARIANCE * variance.mean()).any(axis=1))
        if len(variance)
        else np.zeros(0, dtype=bool)
    )


def rounding_of(xyz: FloatArray) -> float:
    """Return the standard deviation of rounding of the coordinates, (n, 3), of an object, object unit."""
    return ROUNDING * mean_distance(xyz) if len(xyz) else 0.0


def coordinates_of(points: IntArray) -> IntArray:
    """Return the rows of the coordinates of points, (3 k,)."""
    return np.asarray((3 * points[:, None] + np.arange(3)).ravel())


def _covariance_of(result: Solution, points: IntArray, joint: bool) -> FloatArray:
    """Return the joint covariance of points, or that of each single point, or 0 if it is unknown."""
    n = len(points)
    if joint and result.covariance is not None:
        rows = coordinates_of(result.covariance_rows(points))
        return np.asarray(result.covariance[np.ix_(rows, rows)])
    Q = np.zeros((n, 3, n, 3))
    if not joint and result.point_covariance is not None:
        Q[np.arange(n), :, np.arange(n)] = np.nan_to_num(result.point_covariance[points])
    return Q.reshape(3 * n, 3 * n)
