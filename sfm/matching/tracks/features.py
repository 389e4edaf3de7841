"""SIFT features of natural texture, spread over a photograph, and which of two photographs belong together.

Source: Lowe (2004), IJCV 60(2); Hartley and Zisserman (2003), sec. 11.6 (epipolar geometry by RANSAC).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from sfm.conventions import AnyArray, FloatArray, IntArray
from sfm.kernels.options import compiled
from sfm.matching.radiometry import FULL_SCALE_8, grey_of_8_bit

RATIO = 0.8  # of the distances to the nearest and the second-nearest descriptor; Lowe (2004), IJCV 60(2)
EPIPOLAR_PX = 4.0  # distance from the epipolar line; lens distortion is not yet known
MIN_PAIR_MATCHES = 20  # with fewer the epipolar geometry of a pair is not trusted
RANSAC_CONFIDENCE, RANSAC_TRIALS = 0.999, 5000
# Contrast of a feature over the full scale; OpenCV's 0.04 leaves a fifth of what a weak natural texture has.
# Lowe (2004) has 0.03 of the range 0 to 1, before the division by the layers of an octave.
MIN_CONTRAST = 0.01
# Features are looked for in a picture of at most this side, and of half the photograph's: they start the
# matching, which measures in the photograph itself. Where such a picture has too few, in finer ones.
MAX_SIDE_PX = 1600
BLOCK = 256  # descriptors of one photograph that are compared with all of another at a time
CELLS = 12  # along the longer side of a photograph: each cell has its share of the features


@dataclass(frozen=True)
class Features:
    """SIFT features of one photograph."""

    xy: FloatArray  # px, (k, 2)
    scale: FloatArray  # size of the feature, px, (k,)
    angle: FloatArray  # direction from x towards y, rad, (k,)
    descriptor: AnyArray  # float32, (k, 128)

    def __len__(self) -> int:
        return len(self.xy)


def sift_features(photograph: AnyArray, *, max_features: int = 2000) -> Features:
    """Return SIFT features with root-normalised descriptors, spread over the photograph.

    Args:
        photograph: (H, W), 8 or 16 bit, grey or colour.
        max_features: of more, every cell of a raster keeps its strongest.

    Source: Lowe (2004), IJCV 60(2); Arandjelovic and Zisserman (2012), CVPR (square roots).
    """
    eight_bit = photograph
    if photograph.ndim > 2 or photograph.dtype != np.uint8:
        eight_bit = np.rint(np.clip(grey_of_8_bit(photograph), 0, FULL_SCALE_8)).astype(np.uint8)
    shrink = 2
    while max(eight_bit.shape) > shrink * MAX_SIDE_PX:
        shrink *= 2
    sift = cv2.SIFT.create(contrastThreshold=MIN_CONTRAST, enable_precise_upscale=True)
    while True:
        height, width = (max(1, side // shrink) for side in eight_bit.shape)
        # whole blocks of pixels: what is left at the border belongs to none
        whole = eight_bit[: height * shrink, : width * shrink]
        picture = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
        points = sift.detect(picture, None)
        if shrink == 1 or len(points) >= max_features:
            break
        shrink //= 2
    xy = np.array([p.pt for p in points], dtype=float).reshape(-1, 2)
    kept = _spread_out(xy, np.array([p.response for p in points]), picture.shape, max_features)
    points, descriptor = sift.compute(picture, [points[k] for k in kept.tolist()])
    if descriptor is None:
        descriptor = np.zeros((0, 128), np.float32)
    norm = np.maximum(descriptor.sum(axis=1, keepdims=True), 1e-12)
    xy = np.array([p.pt for p in points], dtype=float).reshape(-1, 2)
    return Features(
        shrink * (xy + 0.5) - 0.5,
        shrink * np.array([p.size for p in points], dtype=float),
        np.radians([p.angle for p in points]),
        np.sqrt(descriptor / norm),
    )


def _spread_out(xy: FloatArray, strength: FloatArray, shape: tuple[int, ...], most: int) -> IntArray:
    """Return the rows of the features to keep: the strongest of every cell, then the next ones, up to `most`.

    Args:
        xy: features, px, (k, 2).
        strength: of each, (k,).
        shape: of the photograph, (H, W).
        most: how many are kept.
    """
    cell_px = max(shape) / CELLS
    cell = (xy[:, 1] // cell_px).astype(np.int64) * (CELLS + 1) + (xy[:, 0] // cell_px).astype(np.int64)
    order = np.lexsort((-strength, cell))
    starts = np.searchsorted(cell[order], cell[order])
    rank = np.arange(len(order)) - starts  # place of each feature in its cell
    chosen = order[np.lexsort((-strength[order], rank))][:most]
    return np.sort(chosen)


def match_features(a: Features, b: Features, *, seed: int = 0) -> IntArray:
    """Return pairs of features (k, 2) that choose each other and obey one epipolar geometry."""
    return matched_features(a, b, seed=seed)[0]


def matched_features(a: Features, b: Features, *, seed: int) -> tuple[IntArray, FloatArray]:
    """Return such pairs, and 1 - the ratio of the distances to the nearest and second-nearest one, (k,)."""
    none = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    if min(len(a), len(b)) < MIN_PAIR_MATCHES:
        return none
    nearest = _nearest_descriptors(a.descriptor, b.descriptor)
    mutual = nearest.back[nearest.forth] == np.arange(len(a))
    # of unit vectors the squared distance is 2 - 2 s
    rows = np.flatnonzero(mutual & (1 - nearest.best < RATIO**2 * (1 - nearest.second)))
    forth, best, second = nearest.forth, nearest.best[rows], nearest.second[rows]
    distinct = 1 - np.sqrt(np.maximum(1 - best, 0.0) / np.maximum(1 - second, 1e-12))
    found = np.column_stack([rows, forth[rows]])
    if len(found) < MIN_PAIR_MATCHES:
        return none
    cv2.setRNGSeed(seed)
    _, fits = cv2.findFundamentalMat(
        a.xy[found[:, 0]],
        b.xy[found[:, 1]],
        cv2.FM_RANSAC,
        EPIPOLAR_PX,
        RANSAC_CONFIDENCE,
        RANSAC_TRIALS,
    )
    if fits is None or fits.sum() < MIN_PAIR_MATCHES:
        return none
    kept = fits.ravel() > 0
    return np.asarray(found[kept], dtype=np.int64), np.asarray(distinct[kept], dtype=float)


class _Nearest(NamedTuple):
    """The most similar descriptors of two photographs."""

    forth: IntArray  # of the second photograph, for each one of the first, (k,)
    best: AnyArray  # similarity of that one, (k,)
    second: AnyArray  # of the one behind it, (k,)
    back: IntArray  # of the first photograph, for each one of the second, (l,)


def _nearest_descriptors(first: AnyArray, second: AnyArray) -> _Nearest:
    """Return which unit vectors of two photographs have the largest products, the first of equal ones.

    The products are taken block by block, so that they are read where they were written, in the cache.
    """
    k, size = len(first), len(second)
    found = _Nearest(
        np.empty(k, np.int64), np.empty(k, np.float32), np.empty(k, np.float32), np.empty(size, np.int64)
    )
    of_back = np.full(size, -np.inf, np.float32)
    transposed = np.ascontiguousarray(second.T)
    for begin in range(0, k, BLOCK):
        _take_nearest(first[begin : begin + BLOCK] @ transposed, begin, found, of_back)
    return found


@compiled
def _take_nearest(similarity: AnyArray, begin: int, found: _Nearest, of_back: AnyArray) -> None:
    """Take over the largest of some rows, and of all columns so far."""
    for i in range(similarity.shape[0]):
        best, second, at = np.float32(-np.inf), np.float32(-np.inf), 0
        for j in range(similarity.shape[1]):
            value = similarity[i, j]
            if value > best:
                best, second, at = value, best, j
            elif value > second:
                second = value
            if value > of_back[j]:
                of_back[j], found.back[j] = value, begin + i
        found.forth[begin + i], found.best[begin + i], found.second[begin + i] = at, best, second
