"""Interest points by the Foerstner operator: the natural points of a photograph.

A match is precise in all directions if the window contains gradients of all directions. The normal equations
N = sum g g^T of a shift are then large (weight w) and nearly isotropic (roundness q).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from sfm.matching.radiometry import grey_of, odd_window
from sfm.matching.tracks.features import Features, shown_part, sift_features
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.runtime.compiling import compiled
from sfm.runtime.sampling import is_shown

DETECTORS = ("foerstner", "sift")
# Foerstner and Guelch (1987): 0.5 <= q <= 0.75, and w >= 0.5 to 1.5 times its mean over the photograph.
MIN_ROUNDNESS = 0.5
WEIGHT_OF_MEAN = 0.5
# Standard deviation of the derivative of a Gaussian used for the gradients, px; their noise is then
# sigma_n^2 / (8 pi s^4).
DERIVATION_PX = 1.0
# Rows of a photograph processed at a time: the sums over the windows take 20 times its memory.
STRIP = 256
REACH_PX = 3  # of this derivative
TEXTURE_OF_MEAN = 0.1  # smallest weight of a square, relative to the mean; matching decides about the rest


@dataclass(frozen=True)
class InterestPoints:
    """Interest points of one photograph, the best first."""

    xy: FloatArray  # intersection of the edges in the window, px, (k, 2)
    covariance: FloatArray  # ellipse of precision of xy, px^2, (k, 2, 2)
    weight: FloatArray  # w = det N / tr N, squared intensity per squared px, (k,)
    roundness: FloatArray  # q = 4 det N / tr^2 N, 1 = a circle, (k,)

    def __len__(self) -> int:
        return len(self.xy)


@checked_arguments()
def foerstner_points(
    photograph: AnyArray,
    *,
    window_px: int = 7,
    min_distance_px: float = 10.0,
    max_points: int = 5000,
    border_px: int = 0,
) -> InterestPoints:
    """Find the points of a photograph at which matching is precise in all directions.

    Args:
        photograph: (H, W), 8 or 16 bit or float, grey or colour.
        window_px: odd side of the window in which gradients are collected.
        min_distance_px: of two points that are closer, the weaker one is omitted.
        max_points: if there are more, the strongest are kept.
        border_px: no point may be this close to the border of the photograph.

    Returns:
        The points. The covariances use the standard deviation of intensities from the misfit of the edges.

    Source: Foerstner and Guelch (1987), ISPRS Intercommission Workshop Interlaken, p. 281.

    Raises:
        GeometryError: max_points is below 1.
    """
    side = odd_window("interest operator", window_px)
    if max_points < 1:
        raise GeometryError(
            f"interest operator: {counted(max_points, 'point')} asked for, at least 1 is needed"
        )
    grey = grey_of(photograph)
    weight, is_round = np.empty_like(grey), np.empty(grey.shape, dtype=np.bool_)
    for first, end, begin, gx, gy in _strips(grey, side // 2):
        inner = slice(first - begin, end - begin)
        part, roundness = _texture(gx, gy, side)
        weight[first:end], is_round[first:end] = part[inner], roundness[inner] >= MIN_ROUNDNESS
    top = np.asarray(cv2.dilate(weight, np.ones((3, 3), np.uint8)) <= weight)
    good = top & is_round & (weight > WEIGHT_OF_MEAN * weight.mean()) & (weight > 0)
    margin = max(border_px, side // 2 + REACH_PX)
    good[:margin], good[-margin:], good[:, :margin], good[:, -margin:] = False, False, False, False
    row, col = np.nonzero(good)
    order = np.argsort(-weight[row, col], kind="stable")
    row, col = row[order], col[order]
    kept = np.zeros(len(row), dtype=np.bool_)
    near = np.zeros(grey.shape, dtype=np.bool_)
    _keep_distant(row, col, float(min_distance_px), max_points, near, kept)
    row, col = row[kept], col[kept]
    position, covariance = np.empty((len(row), 2)), np.empty((len(row), 2, 2))
    roundness = np.empty(len(row))
    for first, end, begin, gx, gy in _strips(grey, side // 2):
        rows = np.flatnonzero((row >= first) & (row < end))
        part, C = np.empty((len(rows), 2)), np.empty((len(rows), 2, 2))
        _intersect_edges(gx, gy, begin, row[rows], col[rows], side // 2, part, C)
        position[rows], covariance[rows] = part, C
        roundness[rows] = _texture(gx, gy, side)[1][row[rows] - begin, col[rows]]
    return InterestPoints(position, covariance, weight[row, col], roundness)


def textured_pixels(photograph: AnyArray, side_px: int, hidden: BoolArray | None = None) -> BoolArray:
    """Return which pixels of a photograph are the middles of squares with texture, (H, W).

    Args:
        photograph: (H, W), 8 or 16 bit or float, grey or colour.
        side_px: odd side of the squares.
        hidden: masked pixels, (H, W); only the part around all others is searched.

    Source: the weight of Foerstner and Guelch (1987), ISPRS Intercommission Workshop Interlaken, p. 281.
    """
    shown = shown_part(hidden, photograph.shape)
    grey = grey_of(photograph)[shown]
    weight = np.empty_like(grey)
    for first, end, begin, gx, gy in _strips(grey, side_px // 2):
        det, trace = _invariants(gx, gy, side_px)
        weight[first:end] = (det / trace)[first - begin : end - begin]
    textured = np.zeros(photograph.shape[:2], dtype=bool)
    textured[shown] = weight > TEXTURE_OF_MEAN * weight.mean()
    return textured


def squares_side_by_side(allowed: BoolArray, side_px: int, *, border_px: int = 0) -> FloatArray:
    """Return the middles of disjoint squares, side by side from the upper left, whole px, (k, 2).

    Args:
        allowed: pixels that may be a middle, (H, W).
        side_px: odd side of the squares.
        border_px: no middle may be this close to the border of the photograph.
    """
    free = allowed.copy()
    margin = max(border_px, 1)
    free[:margin], free[-margin:], free[:, :margin], free[:, -margin:] = False, False, False, False
    corners = []  # line by line, each square disjoint from those before
    for y in np.flatnonzero(free.any(axis=1)).tolist():
        for x in np.flatnonzero(free[y]).tolist():
            if free[y, x]:
                corners.append((x, y))
                free[y : y + side_px, max(0, x - side_px + 1) : x + side_px] = False
    return np.array(corners, dtype=float).reshape(-1, 2)


def _strips(grey: AnyArray, half: int) -> Iterator[tuple[int, int, int, AnyArray, AnyArray]]:
    """Yield first and last line of strips of a photograph, and the first line, x and y of their gradients.

    For a whole large photograph, the gradients, their products and sums would take twenty times its memory.

    Args:
        grey: the photograph, float32, (H, W).
        half: lines above and below a strip that its windows reach.
    """
    for first in range(0, len(grey), STRIP):
        end = min(first + STRIP, len(grey))
        begin, behind = max(0, first - half), min(len(grey), end + half)
        above = min(begin, REACH_PX + 1)  # lines that the derivatives need
        seen, side = grey[begin - above : behind + REACH_PX + 1], 2 * REACH_PX + 1
        smooth = cv2.GaussianBlur(seen, (side, side), DERIVATION_PX, borderType=cv2.BORDER_REFLECT_101)
        gx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1, scale=0.5, borderType=cv2.BORDER_REFLECT_101)
        gy = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=1, scale=0.5, borderType=cv2.BORDER_REFLECT_101)
        yield first, end, begin, gx[above : above + behind - begin], gy[above : above + behind - begin]


def _texture(gx: AnyArray, gy: AnyArray, side: int) -> tuple[AnyArray, AnyArray]:
    """Return weight and roundness of the window around every pixel, each (H, W), from gradients (H, W)."""
    det, trace = _invariants(gx, gy, side)
    return (det / trace).astype(np.float32), (4 * det / (trace * trace)).astype(np.float32)


def _invariants(gx: AnyArray, gy: AnyArray, side: int) -> tuple[FloatArray, FloatArray]:
    """Return determinant and trace of N of the window around every pixel, each (H, W)."""
    xx, xy, yy = (
        cv2.boxFilter(product, cv2.CV_64F, (side, side), normalize=False)
        for product in (gx * gx, gx * gy, gy * gy)
    )
    trace = np.maximum(xx + yy, 1e-12)
    return np.maximum(xx * yy - xy * xy, 0.0), trace


@compiled
def _keep_distant(
    row: IntArray, col: IntArray, distance: float, most: int, near: BoolArray, kept: BoolArray
) -> None:
    """Mark points, strongest first, that have no stronger one within the distance."""
    count = 0
    for k in range(len(row)):
        if near[row[k], col[k]]:
            continue
        kept[k] = True
        count += 1
        if count == most:
            return
        _mark_near(near, row[k], col[k], distance)


@compiled
def _mark_near(near: BoolArray, row: int, col: int, distance: float) -> None:
    """Mark the pixels within the distance of a pixel."""
    height, width = near.shape
    reach = int(np.ceil(distance))
    for i in range(max(0, row - reach), min(height, row + reach + 1)):
        for j in range(max(0, col - reach), min(width, col + reach + 1)):
            if (i - row) ** 2 + (j - col) ** 2 < distance * distance:
                near[i, j] = True


@compiled
def _intersect_edges(
    gx: AnyArray,
    gy: AnyArray,
    begin: int,
    row: IntArray,
    col: IntArray,
    half: int,
    position: FloatArray,
    covariance: FloatArray,
) -> None:
    """Fill the point nearest to the edge elements of each window: N x = sum g g^T x, with their gradients g.

    `gx` and `gy` begin at line `begin` of the photograph.
    """
    n = (2 * half + 1) ** 2
    for k in range(len(row)):
        xx, xy, yy, bx, by, rest = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(-half, half + 1):
            for j in range(-half, half + 1):
                a, b = gx[row[k] - begin + i, col[k] + j], gy[row[k] - begin + i, col[k] + j]
                along = a * j + b * i
                xx += a * a
                xy += a * b
                yy += b * b
                bx += a * along
                by += b * along
                rest += along * along
        det = xx * yy - xy * xy
        dx, dy = (yy * bx - xy * by) / det, (xx * by - xy * bx) / det
        variance = max(rest - dx * bx - dy * by, 0.0) / (n - 2)
        # a centre of curvature far from the centre of the window is not a corner of this window
        inside = abs(dx) <= half and abs(dy) <= half
        position[k, 0] = col[k] + (dx if inside else 0.0)
        position[k, 1] = row[k] + (dy if inside else 0.0)
        covariance[k, 0, 0], covariance[k, 1, 1] = variance * yy / det, variance * xx / det
        covariance[k, 0, 1] = covariance[k, 1, 0] = -variance * xy / det


@dataclass(frozen=True)
class NaturalPoints(Features):
    """SIFT features of a photograph, and the positions in it at which matching is most precise."""

    corners: FloatArray  # px, the strongest first, (c, 2); empty if features keep their positions


@checked_arguments()
def natural_points(
    photograph: AnyArray,
    *,
    detector: str = "foerstner",
    max_features: int = 2000,
    noise: float | None = None,
    hidden: BoolArray | None = None,
) -> NaturalPoints:
    """Find the natural points by which a photograph is linked to others and measured.

    Args:
        photograph: (H, W), 8 or 16 bit, grey or colour.
        detector: foerstner finds positions for the points, sift keeps those of the features.
        max_features: largest number of features, the strongest of all parts of the photograph. What is masked
            takes its share with it.
        noise: standard deviation of its noise over the full scale, down to which weak texture is used.
        hidden: masked pixels, which have no points, (H, W).

    Raises:
        GeometryError: an unknown detector.

    Source: Lowe (2004), IJCV 60(2), for the features; Foerstner and Guelch (1987) for the positions.
    """
    if detector not in DETECTORS:
        raise GeometryError(f"tie points: detector '{detector}', expected one of {', '.join(DETECTORS)}")
    features = sift_features(photograph, max_features=max_features, noise=noise, hidden=hidden)
    corners = np.zeros((0, 2))
    if detector == "foerstner":
        shown = shown_part(hidden, photograph.shape)
        corners = np.array([shown[1].start, shown[0].start]) + foerstner_points(photograph[shown]).xy
    if hidden is not None:
        corners = corners[is_shown(hidden, corners)]
    return NaturalPoints(features.xy, features.scale, features.angle, features.descriptor, corners)
