"""Windows that cover photographs without overlap, and object points projected into photographs.

Windows that overlap measure the same pixels twice, so part of their errors is common. Results would then be
reported as too precise, and no residual would show it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np

from sfm.model.camera import FIELD_MARGIN, pixel_from_tangents, ray_directions, tangents_from_pixel
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, rows_of
from sfm.runtime.compiling import compiled

# Ratio of precisions for the same pixels up to which the preferred windows are used.
MAX_COST_RATIO = 1.1
MAX_SHARED_FRACTION = 0.15  # of the pixels of a point, or of a window, that others may have measured
SAMPLES = np.linspace(-0.42, 0.42, 6)  # positions in a window, in sides, where coverage is checked


def first_alike(costs: Sequence[tuple[int, float]]) -> int:
    """Return the side of the first windows that are nearly as precise as the best for the same pixels, px.

    The standard deviation of a window's position is proportional to 1 / side, and the number of windows to
    1 / side^2. With noise alone, all sizes together give the same precision. If larger ones give less, the
    surface is not plane over them.

    Args:
        costs: sides of windows, the preferred ones first, with the standard deviation from all rays together.
    """
    best = min(cost for _, cost in costs)
    return next(side_px for side_px, cost in costs if cost <= MAX_COST_RATIO * best)


class CoveredPixels:
    """A record of the pixels that have been measured in each photograph, one bit each."""

    def __init__(self, shapes: Sequence[tuple[int, ...]], covered: Iterable[BoolArray | None] = ()) -> None:
        """Start with nothing covered, or with what is covered, for photographs of shapes (height, width).

        Args:
            shapes: shapes of the photographs.
            covered: pixels of each photograph, (H, W); None where nothing is covered.
        """
        self.shapes = [shape[:2] for shape in shapes]
        self._bits = [np.zeros((height, -(-width // 8)), np.uint8) for height, width in self.shapes]
        for bits, pixels in zip(self._bits, covered, strict=False):
            if pixels is not None:
                bits[:] = np.packbits(pixels, axis=1)

    def pixels(self, image: int) -> AnyArray:
        """Return a photograph with 1 where it is covered, uint8, (H, W)."""
        return np.unpackbits(self._bits[image], axis=1, count=self.shapes[image][1])

    def cover(self, image: IntArray, xy: FloatArray, side_px: FloatArray) -> None:
        """Cover squares, given by photograph (k,), centre (px, (k, 2)) and side (px, (k,))."""
        sizes = np.array([shape[::-1] for shape in self.shapes])[image]
        first = np.clip(np.rint(xy - side_px[:, None] / 2 + 0.5).astype(np.int64), 0, sizes)
        behind = np.clip(np.rint(xy + side_px[:, None] / 2 + 0.5).astype(np.int64), 0, sizes)
        for i, (x0, y0), (x1, y1) in zip(image.tolist(), first.tolist(), behind.tolist(), strict=True):
            row = np.zeros(8 * self._bits[i].shape[1], np.uint8)
            row[x0:x1] = 1
            self._bits[i][y0:y1] |= np.packbits(row)

    def free_middles(self, image: int, side_px: int) -> BoolArray:
        """Return which pixels of a photograph are centres of squares with few covered pixels, (H, W)."""
        shared = cv2.boxFilter(self.pixels(image), cv2.CV_32F, (side_px, side_px))
        return np.asarray(shared <= MAX_SHARED_FRACTION)

    def is_free(self, image: int, xy: FloatArray, side_px: float) -> BoolArray:
        """Return which squares of a photograph have few covered pixels, (k,).

        Args:
            image: index of the photograph.
            xy: centres of the squares, px, (k, 2).
            side_px: side of the squares.
        """
        height, width = self.shapes[image]
        col = np.rint(xy[:, :1] + side_px * SAMPLES).astype(np.int64).clip(0, width - 1)[:, None, :]
        row = np.rint(xy[:, 1:] + side_px * SAMPLES).astype(np.int64).clip(0, height - 1)[:, :, None]
        covered = (self._bits[image][row, col >> 3] >> (7 - (col & 7)).astype(np.uint8)) & 1
        return np.asarray(covered.mean(axis=(1, 2)) <= MAX_SHARED_FRACTION)

    def free_positions(self, image: IntArray, xy: FloatArray) -> BoolArray:
        """Return which positions, given by photograph (k,) and xy (px, (k, 2)), are on free pixels, (k,)."""
        free = np.ones(len(xy), dtype=bool)
        for i, rows in enumerate(rows_of(image, len(self.shapes))):
            if len(rows):
                free[rows] = self.is_free(i, xy[rows], 0.0)
        return free


def points_apart(seen: ImagePoints, fits: BoolArray, side_px: float, *, n_points: int) -> BoolArray:
    """Choose points, those with the most rays first, whose windows share few of their pixels, (n,).

    Args:
        seen: image points.
        fits: image points that count, (k,).
        side_px: side of the windows.
        n_points: number of points.
    """
    kept = np.zeros(n_points, dtype=bool)
    rows = np.flatnonzero(fits)
    if not len(rows):
        return kept
    count = np.bincount(seen.point[rows], minlength=n_points)
    order = np.argsort(-count, kind="stable")
    rows = rows[np.argsort(seen.point[rows], kind="stable")]
    cells = np.floor(seen.xy[rows] / side_px).astype(np.int64)
    cells -= cells.min(axis=0) - 1  # with a free cell on each side, so that neighbours have different numbers
    columns, lines = cells.max(axis=0) + 2
    cell = (seen.image[rows] * lines + cells[:, 1]) * columns + cells[:, 0]
    first = np.concatenate([[0], np.cumsum(count)])
    _keep_apart(order, first, seen.xy[rows] / side_px, cell, np.unique(cell), int(columns), kept)
    return kept


@compiled
def _keep_apart(
    order: IntArray,
    first: IntArray,
    xy: AnyArray,
    cell: IntArray,
    cells: IntArray,
    columns: int,
    kept: BoolArray,
) -> None:
    """Mark points in this order whose windows, of side 1, share few of their pixels with those marked before.

    Args:
        order: points, the first to be kept first, (n,).
        first: first ray of each point, and the end, (n + 1,).
        xy: centres of the windows, point by point, in sides, (k, 2).
        cell: number of the unit square that contains each centre, (k,).
        cells: these numbers, sorted, (c,).
        columns: squares per line; the number of a neighbour differs by 1, by `columns` or by both.
        kept: filled, (n,).
    """
    latest = np.full(len(cells), -1)  # window kept last in each square
    before = np.full(len(xy), -1)  # window kept before it in the same square
    for point in order:
        begin, end = first[point], first[point + 1]
        shared, most = 0.0, MAX_SHARED_FRACTION * (end - begin)
        for k in range(begin, end):
            for line in (-columns, 0, columns):
                at = np.searchsorted(cells, cell[k] + line - 1)
                while at < len(cells) and cells[at] <= cell[k] + line + 1:
                    other = latest[at]
                    while other >= 0:
                        wide, high = 1 - abs(xy[k, 0] - xy[other, 0]), 1 - abs(xy[k, 1] - xy[other, 1])
                        shared += max(wide, 0.0) * max(high, 0.0)
                        other = before[other]
                    at += 1
            if shared > most:
                break
        if shared > most or begin == end:
            continue
        kept[point] = True
        for k in range(begin, end):
            at = np.searchsorted(cells, cell[k])
            before[k], latest[at] = latest[at], k


def project_points(estimate: Estimate, camera: IntArray, image: IntArray, points: FloatArray) -> FloatArray:
    """Return the image of one object point per row, px, NaN behind the photograph, (k, 2)."""
    UVW = np.asarray(np.einsum("ki,kij->kj", points - estimate.position[image], estimate.rotation[image]))
    out = np.full((len(image), 2), np.nan)
    uv = -UVW[:, :2] / np.where(UVW[:, 2:] < 0, UVW[:, 2:], np.nan)
    for k, rows in enumerate(rows_of(camera[image], len(estimate.cameras))):
        if len(rows):
            out[rows] = pixel_from_tangents(estimate.cameras[k], uv[rows])
    return out


def photographs_towards(estimate: Estimate, camera: IntArray, points: FloatArray) -> IntArray:
    """Return the oriented photographs whose field of view meets a ball around object points, (n,).

    No other photograph can show one of the points.

    Args:
        estimate: interior and exterior orientation of all photographs.
        camera: index of the camera of each photograph, (m,).
        points: object points, (k, 3); those that are not finite are seen nowhere.
    """
    points = points[np.isfinite(points).all(axis=1)]
    oriented = np.flatnonzero(estimate.oriented)
    if not len(points):
        return oriented[:0]
    widest = FIELD_MARGIN * np.array([lens.field_angle for lens in estimate.cameras])[camera[oriented]]
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - middle, axis=1).max())
    ray = middle - estimate.position[oriented]
    distance = np.linalg.norm(ray, axis=1)
    axis = -estimate.rotation[oriented][:, :, 2]
    off_axis = np.arctan2(
        np.linalg.norm(np.cross(axis, ray), axis=1), np.einsum("mc,mc->m", axis, ray)
    )  # pi / 2 and more behind the photograph
    inside = distance <= radius
    ball = np.arcsin(np.minimum(radius / np.where(inside, np.inf, distance), 1.0))
    return np.asarray(oriented[inside | (off_axis <= widest + ball)])


def plane_warps(
    estimate: Estimate,
    camera: IntArray,
    i: int,
    j: int | IntArray,
    xy: FloatArray,
    points: FloatArray,
    normal: FloatArray,
    reach_px: float,
) -> FloatArray:
    """Return the homographies of windows of one photograph in another, relative to both points, (k, 3, 3).

    A window is seen in perspective, so its centre is not the centre of its image. Over 15 px at 45 degrees an
    affine warp is off by about 0.01 px, in the same direction all over a photograph.

    Args:
        estimate: interior and exterior orientation of all photographs.
        camera: index of the camera of each photograph, (m,).
        i: photograph of the windows.
        j: the other photograph, one for all windows or one for each, (k,).
        xy: centres of the windows in i, px, (k, 2).
        points: object points at these centres, (k, 3).
        normal: surface normals there, (k, 3).
        reach_px: distance from the centre at which the perspective is computed: half the side of the windows.
    """
    R, X0 = estimate.rotation[i], estimate.position[i]
    lens, other = estimate.cameras[camera[i]], np.broadcast_to(np.asarray(j), (len(xy),))
    height = np.einsum("kc,kc->k", normal, points - X0)

    def seen(offset: tuple[float, float]) -> FloatArray:
        uv = tangents_from_pixel(lens, xy + np.array(offset))
        d = ray_directions(uv, R)
        on_plane = X0 + d * (height / np.einsum("kc,kc->k", normal, d))[:, None]
        return project_points(estimate, camera, other, on_plane)

    h = reach_px
    middle = seen((0.0, 0.0))
    warps = np.zeros((len(xy), 3, 3))
    warps[:, 2, 2] = 1.0
    for a, (forth, back) in enumerate((((h, 0.0), (-h, 0.0)), ((0.0, h), (0.0, -h)))):
        after, before = seen(forth), seen(back)
        linear, bent = (after - before) / (2 * h), (after + before - 2 * middle) / (2 * h * h)
        warps[:, :2, a] = linear
        warps[:, 2, a] = -np.einsum("kc,kc->k", bent, linear) / np.einsum("kc,kc->k", linear, linear)
    return warps
