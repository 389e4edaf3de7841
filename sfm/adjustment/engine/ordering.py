"""Image points of a network in the order that the compiled kernels go through them.

Object points are eliminated one by one, so image points are stored object point by object point, poses
ascending; the derivatives are taken photograph by photograph, for which an index gives their places.
"""

from __future__ import annotations

import numpy as np

from sfm.conventions import FloatArray, IntArray
from sfm.kernels.compiling import compiled


def by_point(image: IntArray, point: IntArray, pose_of: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Return the image points object point by object point (k,), and where each one starts (n + 1,).

    Args:
        image: photograph of each image point, (k,).
        point: object point of each, (k,).
        pose_of: pose of each photograph; those of an object point ascend, (m,).
        n: how many object points there are.
    """
    m = len(pose_of)
    order = _sorted(image, np.arange(len(image)), _starts(image, m))
    pose = pose_of[image]
    if not np.array_equal(pose, image):
        order = _sorted(pose, order, _starts(pose, m))
    start = _starts(point, n)
    return _sorted(point, order, start), start


def by_photograph(image: IntArray, m: int) -> tuple[IntArray, IntArray]:
    """Return the image points photograph by photograph (k,), and where each one starts (m + 1,)."""
    first = _starts(image, m)
    return _sorted(image, np.arange(len(image)), first), first


def whitening_of(covariance: FloatArray, order: IntArray) -> FloatArray:
    """Return a, b, c of F = (a 0; b c) with F'F = inverse covariance, the inverse of its Cholesky factor.

    Args:
        covariance: of image points, px^2, shape (k, 2, 2).
        order: image points in the order wanted, shape (k,).

    Returns:
        Factors, 1/px, shape (k, 3).
    """
    F = np.empty((len(order), 3))
    _whiten(np.ascontiguousarray(covariance, dtype=float), order, F)
    return F


def _starts(key: IntArray, count: int) -> IntArray:
    start = np.zeros(count + 1, dtype=np.int64)
    np.cumsum(np.bincount(key, minlength=count), out=start[1:])
    return start


def _sorted(key: IntArray, before: IntArray, start: IntArray) -> IntArray:
    order = np.empty(len(key), dtype=np.int64)
    _sort(np.ascontiguousarray(key, dtype=np.int64), before, start[:-1].copy(), order)
    return order


@compiled
def _sort(key: IntArray, before: IntArray, place: IntArray, order: IntArray) -> None:
    """Counting sort of an order before: `place` is where the next one of each key goes."""
    for o in before:
        order[place[key[o]]] = o
        place[key[o]] += 1


@compiled
def _whiten(covariance: FloatArray, order: IntArray, factor: FloatArray) -> None:
    for row in range(len(order)):
        o = order[row]
        a = 1.0 / np.sqrt(covariance[o, 0, 0])
        slope = covariance[o, 0, 1] * a
        c = 1.0 / np.sqrt(covariance[o, 1, 1] - slope * slope)
        factor[row, 0], factor[row, 1], factor[row, 2] = a, -slope * a * c, c
