"""Orders the image points of a network for the compiled kernels.

Object points are eliminated one by one. So image points are stored object point by object point, with
ascending poses. Derivatives are computed photograph by photograph, through an index into this order.
"""

from __future__ import annotations

import numpy as np

from sfm.model.conventions import FloatArray, IntArray
from sfm.runtime.compiling import compiled


def by_point(image: IntArray, point: IntArray, pose_of: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Return the image points sorted by object point (k,), and the start of each object point (n + 1,).

    Args:
        image: photograph of each image point, (k,).
        point: object point of each image point, (k,).
        pose_of: pose of each photograph, (m,); the poses of an object point are sorted in ascending order.
        n: number of object points.
    """
    m = len(pose_of)
    order = _sorted(image, np.arange(len(image)), _starts(image, m))
    pose = pose_of[image]
    if not np.array_equal(pose, image):
        order = _sorted(pose, order, _starts(pose, m))
    start = _starts(point, n)
    return _sorted(point, order, start), start


def by_photograph(image: IntArray, m: int) -> tuple[IntArray, IntArray]:
    """Return the image points sorted by photograph (k,), and the start of each photograph (m + 1,).

    Args:
        image: photograph of each image point, (k,).
        m: number of photographs.
    """
    first = _starts(image, m)
    return _sorted(image, np.arange(len(image)), first), first


def whitening_of(covariance: FloatArray, order: IntArray) -> FloatArray:
    """Return a, b, c of F = (a 0; b c) with F'F the inverse covariance; F inverts the Cholesky factor.

    Args:
        covariance: covariance of image points, px^2, shape (k, 2, 2).
        order: image points in the desired order, shape (k,).

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
    """Sort the order `before` stably by key (counting sort); `place` is the next free place of each key."""
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
