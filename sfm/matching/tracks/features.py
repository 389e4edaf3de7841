"""SIFT features of natural texture, and those that two photographs have in common.

Source: Lowe (2004), IJCV 60(2); Hartley and Zisserman (2003), sec. 11.6 (epipolar geometry by RANSAC).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from sfm.matching.radiometry import FULL_SCALE_8, grey_of_8_bit
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled
from sfm.runtime.sampling import is_shown

MIN_MUTUAL_FEATURES = 6  # mutual matches from which an overlap is not due to chance
RATIO = 0.8  # of the distances to the nearest and the second-nearest descriptor; Lowe (2004), IJCV 60(2)
EPIPOLAR_PX = 4.0  # distance from the epipolar line; lens distortion is not yet known
MIN_PAIR_MATCHES = 20  # with fewer the epipolar geometry of a pair is not trusted
RANSAC_CONFIDENCE, RANSAC_TRIALS = 0.999, 5000
# Contrast of a feature over the full scale; OpenCV's 0.04 keeps only a fifth of the features of a weak
# texture. Lowe (2004) uses 0.03 of the range 0 to 1, before the division by the layers of an octave.
MIN_CONTRAST = 0.01
# Contrast of features of noise alone, in its standard deviations: three of those of the differences of
# Gaussians of the finest octave (0.10 of the noise), times the three layers of an octave. White noise of 0.5
# to 4 grey values has 30 to 70 such features in a megapixel, 0.6 of it 300 to 400.
NOISE_CONTRAST = 0.9
LAYERS = 3  # of an octave, as in Lowe (2004)
ROUNDING_8 = 1 / FULL_SCALE_8 / np.sqrt(12)  # standard deviation of rounding to 8 bit, over the full scale
# Features are extracted from an image of at most this side, reduced at least by 2: they only start the
# matching, which measures in the photograph itself. If too few are found, a finer image is used.
MAX_SIDE_PX = 1600
BLOCK = 256  # descriptors of one photograph compared with all of another at a time
MARGIN_PX = 64  # around what is not masked, in which descriptors reach
CELLS = 12  # along the longer side of a photograph: each cell receives its share of the features


@dataclass(frozen=True)
class Features:
    """SIFT features of one photograph."""

    xy: FloatArray  # px, (k, 2)
    scale: FloatArray  # size of the feature, px, (k,)
    angle: FloatArray  # direction from x towards y, rad, (k,)
    descriptor: AnyArray  # float32, (k, 128)

    def __len__(self) -> int:
        return len(self.xy)


def sift_features(
    photograph: AnyArray,
    *,
    max_features: int = 2000,
    noise: float | None = None,
    hidden: BoolArray | None = None,
) -> Features:
    """Return SIFT features with root-normalised descriptors, spread over the photograph.

    Args:
        photograph: (H, W), 8 or 16 bit, grey or colour.
        max_features: if there are more, every cell of a raster keeps its strongest. What is masked takes its
            share with it.
        noise: standard deviation of its noise over the full scale; with fewer features than `max_features`
            their smallest contrast sinks to what noise alone would have. Not below MIN_CONTRAST if None.
        hidden: masked pixels, which have no features, (H, W); only the part around all others is searched.

    Source: Lowe (2004), IJCV 60(2); Arandjelovic and Zisserman (2012), CVPR (square roots).
    """
    shrink = 2
    while max(photograph.shape[:2]) > shrink * MAX_SIDE_PX:
        shrink *= 2
    shown = shown_part(hidden, photograph.shape)
    if hidden is not None:
        max_features = round(max_features * (1 - float(hidden.mean())))
    eight_bit = photograph[shown]
    if photograph.ndim > 2 or photograph.dtype != np.uint8:
        eight_bit = np.rint(np.clip(grey_of_8_bit(eight_bit), 0, FULL_SCALE_8)).astype(np.uint8)
    least = MIN_CONTRAST if noise is None else NOISE_CONTRAST * float(np.hypot(noise, ROUNDING_8))
    of_shown = None if hidden is None else hidden[shown]
    sift, picture, shrink, points = _detect(eight_bit, of_shown, shrink, max_features, least)
    xy = np.array([p.pt for p in points], dtype=float).reshape(-1, 2)
    kept = _strongest_per_cell(xy, np.array([p.response for p in points]), picture.shape, max_features)
    described, descriptor = sift.compute(picture, [points[k] for k in kept.tolist()])
    if descriptor is None:
        descriptor = np.zeros((0, 128), np.float32)
    norm = np.maximum(descriptor.sum(axis=1, keepdims=True), 1e-12)
    xy = np.array([p.pt for p in described], dtype=float).reshape(-1, 2)
    return Features(
        shrink * (xy + 0.5) - 0.5 + (shown[1].start, shown[0].start),
        shrink * np.array([p.size for p in described], dtype=float),
        np.radians([p.angle for p in described]),
        np.sqrt(descriptor / norm),
    )


def shown_part(hidden: BoolArray | None, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return rows and columns of the part of a photograph around all that is not masked.

    It is wider by MARGIN_PX, and begins at a multiple of it, where the reduced images of the whole photograph
    have a pixel too.

    Args:
        hidden: masked pixels, (H, W); None if none are.
        shape: shape of the photograph, (H, W, ...).
    """
    parts = []
    for axis in range(2):
        there = np.arange(shape[axis]) if hidden is None else np.flatnonzero(~hidden.all(axis=1 - axis))
        first, last = (there[0], there[-1]) if len(there) else (0, 0)
        parts.append(
            slice(max(0, first // MARGIN_PX - 1) * MARGIN_PX, min(shape[axis], last + 1 + MARGIN_PX))
        )
    return parts[0], parts[1]


def _detect(
    eight_bit: AnyArray, hidden: BoolArray | None, shrink: int, enough: int, least: float
) -> tuple[cv2.SIFT, AnyArray, int, list[cv2.KeyPoint]]:
    """Detect features in a photograph that is reduced as much as leaves enough of them.

    Args:
        eight_bit: the photograph, (H, W).
        hidden: pixels without features, (H, W); None if all are shown.
        shrink: largest factor of the reduction, a power of 2.
        enough: number of features.
        least: smallest contrast at full size, over the full scale.

    Returns:
        The detector, the reduced photograph, its factor and its features.
    """
    while True:
        contrast = min(MIN_CONTRAST, least) if shrink == 1 else MIN_CONTRAST
        sift = cv2.SIFT.create(nOctaveLayers=LAYERS, contrastThreshold=contrast, enable_precise_upscale=True)
        height, width = (max(1, side // shrink) for side in eight_bit.shape)
        # whole blocks of pixels: a remainder at the border belongs to none
        blocks = eight_bit[: height * shrink, : width * shrink]
        picture = cv2.resize(blocks, (width, height), interpolation=cv2.INTER_AREA)
        points = list(sift.detect(picture, None))
        if hidden is not None:
            at = shrink * (np.array([p.pt for p in points]).reshape(-1, 2) + 0.5) - 0.5
            points = [points[k] for k in np.flatnonzero(is_shown(hidden, at)).tolist()]
        if shrink == 1:  # those of the largest contrast, halved as often as needed, that leaves enough
            response = np.array([p.response for p in points], dtype=np.float32)  # in a layer of the octave
            of_octave, smallest = (response * np.float32(LAYERS)).astype(float), MIN_CONTRAST
            while smallest > least and np.count_nonzero(of_octave >= smallest) < enough:
                smallest = max(smallest / 2, least)
            points = [points[k] for k in np.flatnonzero(of_octave >= smallest).tolist()]
        if len(points) >= enough or shrink == 1:
            return sift, picture, shrink, points
        shrink //= 2


def _strongest_per_cell(xy: FloatArray, strength: FloatArray, shape: tuple[int, ...], most: int) -> IntArray:
    """Return the rows of the features to keep: the strongest of each cell, then the second ones and so on.

    Args:
        xy: features, px, (k, 2).
        strength: strength of each feature, (k,).
        shape: shape of the image, (H, W).
        most: number of features to keep.
    """
    cell_px = max(shape) / CELLS
    cell = (xy[:, 1] // cell_px).astype(np.int64) * (CELLS + 1) + (xy[:, 0] // cell_px).astype(np.int64)
    order = np.lexsort((-strength, cell))
    starts = np.searchsorted(cell[order], cell[order])
    rank = np.arange(len(order)) - starts  # rank of each feature in its cell
    chosen = order[np.lexsort((-strength[order], rank))][:most]
    return np.sort(chosen)


class TwoMotions(NamedTuple):
    """Features of two photographs of which some stand still while the others agree on another motion."""

    rows: IntArray  # those that fit the epipolar geometry of the moving ones, (k, 2)
    distinct: FloatArray  # see `PairMatches`, (k,)
    still: IntArray  # those that stand still and do not fit it, (l, 2)


class PairMatches(NamedTuple):
    """Features of two photographs that choose each other and fit one epipolar geometry."""

    rows: IntArray  # feature in the first and in the second photograph, (k, 2)
    distinct: FloatArray  # 1 - the ratio of distances to the nearest and second-nearest feature, (k,)
    candidates: int  # pairs that choose each other, of which these fit the geometry
    motions: TwoMotions | None  # None if the photographs show one motion


def match_features(a: Features, b: Features, *, seed: int = 0) -> IntArray:
    """Return pairs of features, (k, 2), that choose each other and fit one epipolar geometry."""
    return matched_features(a, b, seed=seed).rows


def matched_features(a: Features, b: Features, *, seed: int) -> PairMatches:
    """Return the pairs of features that choose each other, and whether they show two motions."""
    none = PairMatches(np.zeros((0, 2), dtype=np.int64), np.zeros(0), 0, None)
    if min(len(a), len(b)) < MIN_PAIR_MATCHES:
        return none
    nearest = _nearest_descriptors(a.descriptor, b.descriptor)
    mutual = nearest.back[nearest.forth] == np.arange(len(a))
    # the squared distance of unit vectors is 2 - 2 s
    rows = np.flatnonzero(mutual & (1 - nearest.best < RATIO**2 * (1 - nearest.second)))
    forth, best, second = nearest.forth, nearest.best[rows], nearest.second[rows]
    distinct = 1 - np.sqrt(np.maximum(1 - best, 0.0) / np.maximum(1 - second, 1e-12))
    pairs = np.column_stack([rows, forth[rows]])
    none = none._replace(candidates=len(pairs))
    if len(pairs) < MIN_PAIR_MATCHES:
        return none
    first, other = a.xy[pairs[:, 0]], b.xy[pairs[:, 1]]
    motions = None
    fits, still = _two_motions(first, other, seed)
    if still.any():
        motions = TwoMotions(pairs[fits], distinct[fits], pairs[still])
    kept = _epipolar_geometry(first, other, seed)
    if kept.sum() < MIN_PAIR_MATCHES:
        return none._replace(motions=motions)
    return PairMatches(pairs[kept], distinct[kept], len(pairs), motions)


def _two_motions(first: FloatArray, other: FloatArray, seed: int) -> tuple[BoolArray, BoolArray]:
    """Return which matches fit the epipolar geometry of those that moved, and which stand still beside it.

    There are two motions if most of the matches that moved agree on an epipolar geometry, and most of those
    at the same place do not fit it. A distant background fits it where a camera moves without turning.

    Args:
        first: positions in the first photograph, px, (k, 2).
        other: positions in the second one, px, (k, 2).
        seed: seed of the random samples.
    """
    fits, none = np.zeros(len(first), dtype=bool), np.zeros(len(first), dtype=bool)
    here = np.linalg.norm(first - other, axis=1) <= EPIPOLAR_PX
    if here.sum() < MIN_MUTUAL_FEATURES or (~here).sum() < MIN_PAIR_MATCHES:
        return fits, none
    fits[~here] = _epipolar_geometry(first[~here], other[~here], seed)
    if fits.sum() < max(MIN_PAIR_MATCHES, (~here).sum() / 2):
        return fits, none
    # of all of them: that of the best sample is not determined well enough where nothing moved
    F = cv2.findFundamentalMat(first[fits], other[fits], cv2.FM_8POINT)[0]
    if F is None:
        return fits, none
    x, y = (np.column_stack([xy, np.ones(len(xy))])[here] for xy in (first, other))
    lines, lines_back = x @ F.T, y @ F
    slope = np.minimum(np.linalg.norm(lines[:, :2], axis=1), np.linalg.norm(lines_back[:, :2], axis=1))
    fits[here] = np.abs(np.einsum("ki,ki->k", y, lines)) <= EPIPOLAR_PX * slope
    still = here & ~fits
    return fits, still if 2 * still.sum() > here.sum() else none


def _epipolar_geometry(first: FloatArray, other: FloatArray, seed: int) -> BoolArray:
    """Return which matches fit the epipolar geometry that most of them fit, (k,)."""
    cv2.setRNGSeed(seed)
    _, fits = cv2.findFundamentalMat(
        first, other, cv2.FM_RANSAC, EPIPOLAR_PX, RANSAC_CONFIDENCE, RANSAC_TRIALS
    )
    return np.zeros(len(first), dtype=bool) if fits is None else np.asarray(fits.ravel() > 0)


class _Nearest(NamedTuple):
    """The most similar descriptors of two photographs."""

    forth: IntArray  # feature of the second photograph for each one of the first, (k,)
    best: AnyArray  # similarity of that feature, (k,)
    second: AnyArray  # similarity of the next-best feature, (k,)
    back: IntArray  # feature of the first photograph for each one of the second, (l,)


def _nearest_descriptors(first: AnyArray, second: AnyArray) -> _Nearest:
    """Return the unit vectors of two photographs with the largest products, the first of equal ones.

    The products are computed block by block, so that they are still in the cache when they are read.
    """
    k, size = len(first), len(second)
    nearest = _Nearest(
        np.empty(k, np.int64), np.empty(k, np.float32), np.empty(k, np.float32), np.empty(size, np.int64)
    )
    of_back = np.full(size, -np.inf, np.float32)
    transposed = np.ascontiguousarray(second.T)
    for begin in range(0, k, BLOCK):
        _update_nearest(first[begin : begin + BLOCK] @ transposed, begin, nearest, of_back)
    return nearest


@compiled
def _update_nearest(similarity: AnyArray, begin: int, nearest: _Nearest, of_back: AnyArray) -> None:
    """Update the largest of some rows, and the largest of all columns so far."""
    for i in range(similarity.shape[0]):
        best, second, at = np.float32(-np.inf), np.float32(-np.inf), 0
        for j in range(similarity.shape[1]):
            value = similarity[i, j]
            if value > best:
                best, second, at = value, best, j
            elif value > second:
                second = value
            if value > of_back[j]:
                of_back[j], nearest.back[j] = value, begin + i
        nearest.forth[begin + i], nearest.best[begin + i], nearest.second[begin + i] = at, best, second
