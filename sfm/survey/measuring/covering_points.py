"""Points that cover the texture of oriented photographs, measured by least squares matching.

A few hundred tie points orient the photographs and give the shape of the surface. No more features are needed
after that. Textured squares, side by side, are placed on the plane through the points around them in space.
They are projected into all photographs that see the plane, and matched there. Photographs with the most
similar direction come first, and their rays correct the position of the point for the others. A point is thus
followed through all its photographs, even if their directions are too different for descriptors. No pixel is
measured twice. Each photograph takes squares from pixels that earlier photographs did not cover. A square is
matched only in photographs whose pixels there are still free.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.matching.correlation import MIN_CORRELATION
from sfm.matching.lsm.coverage import CoveredPixels, Windows, plane_warps, project_points
from sfm.matching.lsm.patch_equations import linear_part
from sfm.matching.lsm.surface_planes import NEIGHBOURS, planes_at
from sfm.matching.lsm.two_photo import LsmMatches, LsmSettings, match_lsm
from sfm.matching.radiometry import Grey, GreyPhotographs
from sfm.matching.tracks.interest import textured_squares
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, rows_of
from sfm.orientation.image_rays import intersect_image_points
from sfm.runtime.progress import give_back_memory, reported
from sfm.runtime.threads import in_threads

FIRST_PHOTOGRAPHS = 4  # of the most similar direction; their rays correct the position of a point
FIRST_SHIFT_PX = 6.0  # largest distance of a match from the position that the plane gives
LATER_SHIFT_PX = 3.0  # largest distance of a match from the position that the first rays give
MIN_COSINE = 0.35  # between a ray and the normal of the plane; below it windows shrink to a third
SCALES = (0.4, 2.5)  # smallest and largest scale of a window relative to the reference
BORDER_PX = 4  # between a window and the border of a photograph
RETURN_FACTOR = 3.0  # largest return error of a match that is matched back, over the median error, in sigmas
MIN_RAYS = 3  # of a point; two where only two photographs see the surface
STEP = 1e-3  # towards the photograph, relative to the distance, that shows the direction of epipolar lines
TOLERANCE_PX = 1.5  # largest residual of a ray that stays with its point


@dataclass(frozen=True)
class CoveringPoints:
    """Points and their rays."""

    image_points: ImagePoints  # k image points of the points 0 to n - 1
    points: FloatArray  # object points, (n, 3)
    residuals: FloatArray  # of the rays in the given orientation, px, (k, 2)
    matched: int  # rays of points that enough photographs matched; k of them agree with each other


@dataclass(frozen=True)
class Squares:
    """Textured squares of one reference photograph."""

    image: int  # the photograph
    xy: FloatArray  # middles, px, (k, 2)
    normal: FloatArray  # of the surface there, towards the photograph, unit vectors, (k, 3)
    points: FloatArray  # object points, (k, 3)

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, rows: BoolArray) -> Squares:
        """Return the selected squares."""
        return Squares(self.image, self.xy[rows], self.normal[rows], self.points[rows])


@dataclass(frozen=True)
class SquareRays:
    """The squares of one reference photograph, measured in all photographs that see them."""

    image_points: ImagePoints
    scale: FloatArray  # of the windows relative to the reference, (k,)
    correlation: FloatArray  # r of each window and that of the reference, 1 for the latter, (k,)


@dataclass(frozen=True)
class _Matched:
    """Rays of one photograph."""

    seen: ImagePoints
    correlation: FloatArray  # (k,)
    scale: FloatArray  # of the windows relative to the reference, (k,)
    in_reference: FloatArray  # half of the noise, assigned to the reference, px^2, (k, 2, 2)


def find_covering_points(
    photographs: Sequence[AnyArray],
    network: Network,
    estimate: Estimate,
    *,
    windows: Windows,
    side_px: int,
    references: Sequence[int] | None = None,
    hidden: CoveredPixels | None = None,
    threads: int = 1,
) -> CoveringPoints:
    """Measure points in all photographs that see them, until the texture of the photographs is covered.

    Args:
        photographs: m photographs, (H, W) each; files are read when needed.
        network: fitting image points of the tie points, which give the surface.
        estimate: orientation of the photographs, good to a few pixels, and the tie points.
        windows: side and model of the windows.
        side_px: side of the squares around the windows, px; no two squares share pixels.
        references: photographs to take points from; by default all, those with the most tie points first.
        hidden: masked pixels, which show nothing of the surface.
        threads: number of photographs processed in parallel.

    Source: Gruen (1985), S. Afr. J. Photogrammetry 14(3).
    """
    m, camera, seen = len(photographs), network.camera, network.image_points
    margin = windows.side_px // 2 + BORDER_PX
    tie_rows = rows_of(seen.image, m)
    order = np.argsort([-len(rows) for rows in tie_rows], kind="stable") if references is None else references
    shapes = [estimate.cameras[lens].size_px[::-1] for lens in camera]
    covered = CoveredPixels(shapes)
    grey = GreyPhotographs(photographs.__getitem__)
    none = np.zeros(0, dtype=np.int64)
    nothing = ImagePoints(none, none, np.zeros((0, 2)), np.zeros((0, 2, 2)))
    parts = [CoveringPoints(nothing, np.zeros((0, 3)), np.zeros((0, 2)), 0)]

    def cover(i: int, rays: int, *, more: bool) -> None:
        """Take points that exactly `rays` photographs see, or at least so many if `more`."""
        free_middles = covered.free_middles(i, side_px)
        if hidden is not None:
            free_middles &= hidden.free_middles(i, windows.side_px)
        xy = textured_squares(grey[i].pixels, side_px, free_middles, border_px=margin)
        points, normal = planes_at(estimate, camera, i, xy, seen.point[tie_rows[i]])
        known = np.asarray(np.isfinite(points).all(axis=1))
        squares = Squares(i, xy, normal, points).select(known)
        visible, free = _visible(estimate, camera, squares, covered, margin, side_px, windows.side_px, hidden)
        of = free.sum(axis=0) >= rays
        if not more:
            of &= visible.sum(axis=0) == rays
        if not of.any():
            return
        measured = match_squares(
            grey,
            estimate,
            camera,
            squares.select(of),
            free[:, of],
            windows,
            threads,
            both_ways=not more,
        )
        new, used = _points_that_meet(measured.image_points, estimate, camera, rays)
        parts.append(new)
        covered.cover(new.image_points.image, new.image_points.xy, side_px * measured.scale[used])

    in_order = [
        i for i in np.asarray(order).tolist() if estimate.oriented[i] and len(tie_rows[i]) >= NEIGHBOURS
    ]
    for i in reported(f"photographs covered by windows of {windows.side_px} px", in_order, len(in_order)):
        cover(i, MIN_RAYS, more=True)
        give_back_memory()
    for i in reported("photographs covered where one other one sees the surface", in_order, len(in_order)):
        cover(i, 2, more=False)
        give_back_memory()
    return _concatenate_points(parts)


def seen_squares(
    estimate: Estimate, camera: IntArray, squares: Squares, margin_px: int
) -> Iterator[tuple[int, IntArray, FloatArray]]:
    """Yield each oriented photograph that sees squares from their front, which these are, and where, px."""
    for j in np.flatnonzero(estimate.oriented).tolist():
        at = project_points(estimate, camera, np.full(len(squares), j), squares.points)
        size = np.array(estimate.cameras[camera[j]].size_px)
        ray = estimate.position[j] - squares.points
        cosine = np.sum(ray * squares.normal, axis=1) / np.linalg.norm(ray, axis=1)
        with np.errstate(invalid="ignore"):
            inside = ((at >= margin_px) & (at <= size - 1 - margin_px)).all(axis=1)
        rows = np.flatnonzero(inside & (cosine > MIN_COSINE))
        yield j, rows, at[rows]


def _visible(
    estimate: Estimate,
    camera: IntArray,
    squares: Squares,
    covered: CoveredPixels,
    margin: int,
    side_px: int,
    window_px: int = 0,
    hidden: CoveredPixels | None = None,
) -> tuple[BoolArray, BoolArray]:
    """Return which photographs see the squares, and which of these have their pixels free, (m, k) each.

    The reference is among them.
    """
    visible = np.zeros((len(covered.shapes), len(squares)), dtype=bool)
    free = visible.copy()
    for j, rows, at in seen_squares(estimate, camera, squares, margin):
        if hidden is not None:
            shown = hidden.is_free(j, at, window_px)
            rows, at = rows[shown], at[shown]
        visible[j, rows] = True
        free[j, rows] = covered.is_free(j, at, side_px)
    visible[squares.image] = free[squares.image] = True
    return visible, free


def match_squares(
    photographs: GreyPhotographs,
    estimate: Estimate,
    camera: IntArray,
    squares: Squares,
    visible: BoolArray,
    windows: Windows,
    threads: int,
    *,
    both_ways: bool,
) -> SquareRays:
    """Measure the squares of a photograph in the others, those with the most similar direction first.

    Position and tilt of a plane are unknown in oriented photographs, and nothing else of its warp. A tilt
    that is assumed instead moves the depth of a window by the same in all photographs, which no residual
    shows.

    Half of the noise of a match is that of the template, and is assigned to the reference, as in
    `tie_points`. If no third ray checks a match, it is also matched back.
    """
    i, k = squares.image, len(squares.xy)
    ray = estimate.position[:, None] - squares.points[None]
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    cosine = np.where(visible, np.einsum("mkc,kc->mk", ray, ray[i]), -np.inf)
    cosine[i] = np.inf
    rank = np.argsort(np.argsort(-cosine, axis=0, kind="stable"), axis=0, kind="stable")
    first = visible & (rank <= FIRST_PHOTOGRAPHS)
    template = photographs[i]
    parts = [ImagePoints(np.full(k, i), np.arange(k), squares.xy, np.full((k, 2, 2), np.nan))]
    scales, correlations = [np.ones(k)], [np.ones(k)]
    in_reference, number = np.zeros((k, 2, 2)), np.zeros(k, dtype=np.int64)

    def matched(j: int, rows: IntArray, points: FloatArray, max_shift_px: float) -> _Matched | None:
        at = project_points(estimate, camera, np.full(len(rows), j), points[rows])
        warp = plane_warps(
            estimate, camera, i, j, squares.xy[rows], points[rows], squares.normal[rows], windows.side_px / 2
        )
        with np.errstate(invalid="ignore"):  # for planes that the photograph does not see
            scale = np.sqrt(np.abs(np.linalg.det(warp[:, :2, :2])))
        fits = np.isfinite(at).all(axis=1) & (scale > SCALES[0]) & (scale < SCALES[1])
        if not fits.any():
            return None
        along = _epipolar_lines(estimate, camera, i, j, points[rows[fits]], warp[fits])
        match = match_lsm(
            template,
            photographs[j],
            squares.xy[rows[fits]],
            at[fits],
            start=warp[fits],
            along=along,
            settings=LsmSettings(
                model=windows.model,
                window_px=windows.side_px,
                max_shift_px=max_shift_px,
                min_correlation=MIN_CORRELATION,
                blur=True,
            ),
        )
        good = match.good
        if both_ways:
            at = squares.xy[rows[fits]]
            good &= _returning(template, photographs[j], at, match, along, windows)
        half = match.covariance[good] / 2
        back = np.linalg.inv(linear_part(match.warp[good]))
        seen = ImagePoints(np.full(int(good.sum()), j), rows[fits][good], match.xy[good], half)
        r = match.correlation[good]
        return _Matched(seen, r, scale[fits][good], back @ half @ back.transpose(0, 2, 1))

    def measure(which: BoolArray, points: FloatArray, max_shift_px: float) -> None:
        others = np.flatnonzero(which.any(axis=1))
        others = others[others != i].tolist()
        for rays in in_threads(
            lambda j: matched(j, np.flatnonzero(which[j]), points, max_shift_px), others, threads
        ):
            if rays is not None:
                in_reference[rays.seen.point] += rays.in_reference
                number[rays.seen.point] += 1
                parts.append(rays.seen)
                scales.append(rays.scale)
                correlations.append(rays.correlation)

    measure(first, squares.points, FIRST_SHIFT_PX)
    points = intersect_image_points(
        ImagePoints.joined(parts), camera, estimate, n_points=k, tolerance_px=TOLERANCE_PX
    ).points
    measure(visible & ~first & np.isfinite(points).all(axis=1), points, LATER_SHIFT_PX)
    used = number > 0
    parts[0].covariance[used] = in_reference[used] / number[used, None, None]
    seen = ImagePoints.joined(parts)
    used = used[seen.point]
    return SquareRays(seen.select(used), np.concatenate(scales)[used], np.concatenate(correlations)[used])


def _epipolar_lines(
    estimate: Estimate, camera: IntArray, i: int, j: int, points: FloatArray, warp: FloatArray
) -> FloatArray:
    """Return the directions in photograph i along which its windows move against photograph j, (k, 2).

    Args:
        estimate: interior and exterior orientation of all photographs.
        camera: index of the camera of each photograph, (m,).
        i: photograph of the windows.
        j: the other photograph.
        points: object points at the middles of the windows, (k, 3).
        warp: homographies from i to j, (k, 3, 3).
    """
    nearer = points + STEP * (estimate.position[i] - points)
    image = np.full(len(points), j)
    moved = project_points(estimate, camera, image, nearer) - project_points(estimate, camera, image, points)
    return np.asarray(np.linalg.solve(linear_part(warp), moved[:, :, None])[:, :, 0])


def _returning(
    template: Grey, other: Grey, xy: FloatArray, match: LsmMatches, along: FloatArray, windows: Windows
) -> BoolArray:
    """Return which matches, matched back, return to their origin within the usual error, (k,)."""
    rows = np.flatnonzero(match.good)
    linear = linear_part(match.warp[rows])
    back = match_lsm(
        other,
        template,
        match.xy[rows],
        xy[rows],
        start=np.asarray(np.linalg.inv(linear)),
        along=np.einsum("kab,kb->ka", linear, along[rows]),
        settings=LsmSettings(
            model=windows.model, window_px=windows.side_px, min_correlation=MIN_CORRELATION, blur=True
        ),
    )
    off = back.xy - xy[rows]
    square = np.einsum("ka,kab,kb->k", off, np.linalg.inv(back.covariance), off)
    good = np.zeros(len(xy), dtype=bool)
    good[rows] = square <= RETURN_FACTOR**2 * np.median(square[back.good]) if back.good.any() else False
    return good


def _points_that_meet(
    seen: ImagePoints, estimate: Estimate, camera: IntArray, min_rays: int
) -> tuple[CoveringPoints, BoolArray]:
    """Return the points with enough rays that meet, and which rays these are, (k,)."""
    n = int(seen.point.max(initial=-1)) + 1
    met = intersect_image_points(seen, camera, estimate, n_points=n, tolerance_px=TOLERANCE_PX)
    used = met.used & (np.bincount(seen.point[met.used], minlength=n) >= min_rays)[seen.point]
    kept, point = np.unique(seen.point[used], return_inverse=True)
    c = np.array([lens.c_px for lens in estimate.cameras])[camera[seen.image[used]]]
    image_points = replace(seen.select(used), point=point.ravel())
    residuals = met.residuals[used] * c[:, None]
    matched = int((np.bincount(seen.point, minlength=n) >= min_rays)[seen.point].sum())
    return CoveringPoints(image_points, met.points[kept], residuals, matched), used


def _concatenate_points(parts: Sequence[CoveringPoints]) -> CoveringPoints:
    """Concatenate points and renumber them consecutively."""
    first = np.cumsum([0, *(len(part.points) for part in parts)])
    moved = [
        replace(part.image_points, point=part.image_points.point + start)
        for part, start in zip(parts, first.tolist(), strict=False)
    ]
    return CoveringPoints(
        ImagePoints.joined(moved),
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.residuals for part in parts]),
        sum(part.matched for part in parts),
    )
