"""Points that cover the texture of oriented photographs, measured by least squares matching.

A few hundred tie points orient the photographs and give the shape of the surface. No more features are needed
after that. Textured squares, side by side, are placed on the plane through the points around them in space.
They are projected into all photographs that see the plane, and matched there. Photographs with the most
similar direction come first, and their rays correct the position of the point for the others. A point is thus
followed through all its photographs, even if their directions are too different for descriptors. All rays of
a point share the slope of its plane, which their windows correct. Windows hardly overlap. Each photograph
takes squares from pixels that earlier photographs did not cover. A square is matched only in photographs
whose pixels there are still free.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.matching.correlation import MIN_CORRELATION
from sfm.matching.lsm.coverage import CoveredPixels, photographs_towards, plane_warps, project_points
from sfm.matching.lsm.patch_equations import linear_part
from sfm.matching.lsm.surface_planes import NEIGHBOURS, Planes, planes_at, tilted_planes
from sfm.matching.lsm.two_photo import COARSE_STEP, LsmMatches, LsmSettings, match_lsm
from sfm.matching.lsm.window_slopes import ShiftedWindows, estimate_slopes, slope_equations
from sfm.matching.radiometry import Grey, GreyPhotographs
from sfm.matching.tracks.interest import squares_side_by_side, textured_pixels
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
STEP = 1e-3  # towards the photograph, relative to the distance, that shows parallaxes
# Mean square of the tangent, along one axis, of the angle between a plane and the one across its ray, if all
# directions of MIN_COSINE and more are alike: the variance of slopes that are not known, times c^2.
UNKNOWN_SLOPE = (1 / MIN_COSINE - 1) / 2
MAX_ROUNDS = 5  # of matching on planes whose slopes move the borders of windows by more than COARSE_STEP
SQUARES_AT_ONCE = 100_000  # that are projected together, all squares into each of several photographs
TOLERANCE_PX = 1.5  # largest residual of a ray that stays with its point


@dataclass(frozen=True)
class CoveringPoints:
    """Points and their rays."""

    image_points: ImagePoints  # k image points of the points 0 to n - 1
    points: FloatArray  # object points, (n, 3)
    of_slopes: FloatArray  # covariance of the rays by the slopes of their windows, px^2, (k, 2, 2)
    residuals: FloatArray  # of the rays in the given orientation, px, (k, 2)
    matched: int  # rays of points that enough photographs matched; k of them agree with each other


@dataclass(frozen=True)
class Squares:
    """Textured squares of one reference photograph."""

    image: int  # the photograph
    xy: FloatArray  # middles, px, (k, 2)
    planes: Planes  # of the surface there

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, rows: BoolArray) -> Squares:
        """Return the selected squares."""
        return Squares(self.image, self.xy[rows], self.planes.select(rows))


@dataclass(frozen=True)
class SquareRays:
    """The squares of one reference photograph, measured in all photographs that see them.

    The errors of the slopes of their windows move a square in depth, the same in all its rays. No residual
    shows that. It is not in the covariance of the image points, but apart.
    """

    image_points: ImagePoints
    of_slopes: FloatArray  # covariance of the image points by the slopes of the windows, px^2, (k, 2, 2)
    scale: FloatArray  # of the windows relative to the reference, (k,)
    correlation: FloatArray  # r of each window and that of the reference, 1 for the latter, (k,)


@dataclass(frozen=True)
class _Matched:
    """Rays of one photograph."""

    seen: ImagePoints
    windows: ShiftedWindows
    correlation: FloatArray  # (k,)
    scale: FloatArray  # of the windows relative to the reference, (k,)
    in_reference: FloatArray  # half of the noise, assigned to the reference, px^2, (k, 2, 2)

    def select(self, rows: BoolArray) -> _Matched:
        """Return the selected rays."""
        return _Matched(
            self.seen.select(rows),
            self.windows.select(rows),
            self.correlation[rows],
            self.scale[rows],
            self.in_reference[rows],
        )

    def border_step(self, step: FloatArray) -> FloatArray:
        """Return how far borders of windows move by changes of slope times half a side, px, (k,)."""
        return np.asarray(np.linalg.norm(self.windows.parallax, axis=1) * step[self.seen.point])


def find_covering_points(
    photographs: Sequence[AnyArray],
    network: Network,
    estimate: Estimate,
    *,
    window_px: int,
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
        window_px: odd side of the windows.
        side_px: side of the squares around the windows, px; no two squares share pixels.
        references: photographs to take points from; by default all, those with the most tie points first.
        hidden: masked pixels, which show nothing of the surface.
        threads: number of photographs processed in parallel.

    Source: Gruen (1985), S. Afr. J. Photogrammetry 14(3).
    """
    m, camera, seen = len(photographs), network.camera, network.image_points
    margin = window_px // 2 + BORDER_PX
    tie_rows = rows_of(seen.image, m)
    order = np.argsort([-len(rows) for rows in tie_rows], kind="stable") if references is None else references
    shapes = [estimate.cameras[lens].size_px[::-1] for lens in camera]
    covered = CoveredPixels(shapes)
    grey = GreyPhotographs(photographs.__getitem__)
    none = np.zeros(0, dtype=np.int64)
    nothing = ImagePoints(none, none, np.zeros((0, 2)), np.zeros((0, 2, 2)))
    parts = [CoveringPoints(nothing, np.zeros((0, 3)), np.zeros((0, 2, 2)), np.zeros((0, 2)), 0)]

    usable: dict[int, AnyArray] = {}  # middles of squares with texture that are not hidden, one bit each

    def usable_middles(i: int) -> BoolArray:
        if i not in usable:
            black = None if hidden is None else hidden.pixels(i).astype(bool)
            middles = textured_pixels(grey[i].pixels, side_px, black)
            if hidden is not None:
                middles &= hidden.free_middles(i, window_px)
            usable[i] = np.packbits(middles)
        height, width = shapes[i]
        return np.unpackbits(usable[i], count=height * width).reshape(height, width).astype(bool)

    def cover(i: int, rays: int, *, more: bool) -> None:
        """Take points that exactly `rays` photographs see, or at least so many if `more`."""
        free_middles = covered.free_middles(i, side_px) & usable_middles(i)
        xy = squares_side_by_side(free_middles, side_px, border_px=margin)
        planes = planes_at(estimate, camera, i, xy, seen.point[tie_rows[i]])
        squares = Squares(i, xy, planes).select(np.asarray(np.isfinite(planes.points).all(axis=1)))
        visible, free = _visible(estimate, camera, squares, covered, margin, side_px, window_px, hidden)
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
            window_px,
            threads,
            both_ways=not more,
        )
        new, used = _points_that_meet(measured, estimate, camera, rays)
        parts.append(new)
        covered.cover(new.image_points.image, new.image_points.xy, side_px * measured.scale[used])

    in_order = [
        i for i in np.asarray(order).tolist() if estimate.oriented[i] and len(tie_rows[i]) >= NEIGHBOURS
    ]
    for i in reported(f"photographs covered by windows of {window_px} px", in_order, len(in_order)):
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
    k, points = len(squares), squares.planes.points
    near = photographs_towards(estimate, camera, points)
    for images in np.array_split(near, 1 + len(near) * k // SQUARES_AT_ONCE) if len(near) else ():
        image = np.repeat(images, k)
        at = project_points(estimate, camera, image, np.tile(points, (len(images), 1)))
        at = at.reshape(len(images), k, 2)
        size = np.array([estimate.cameras[lens].size_px for lens in camera[images]])[:, None]
        with np.errstate(invalid="ignore"):
            seen = ((at >= margin_px) & (at <= size - 1 - margin_px)).all(axis=2)
            seen &= _cosines(estimate.position[images], squares.planes) > MIN_COSINE
        for j, of_image, rows in zip(images.tolist(), at, seen, strict=True):
            if rows.any():
                yield j, np.flatnonzero(rows), of_image[rows]


def _cosines(position: FloatArray, planes: Planes) -> FloatArray:
    """Return the cosines of the angles between the normals of planes and their rays to positions.

    Args:
        position: projection centres, (m, 3).
        planes: planes at k positions.

    Returns:
        Cosines, (m, k).
    """
    ray = position[:, None] - planes.points
    return np.asarray(np.einsum("mkc,kc->mk", ray, planes.normal) / np.linalg.norm(ray, axis=2))


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
    window_px: int,
    threads: int,
    *,
    both_ways: bool,
) -> SquareRays:
    """Measure the squares of a photograph in the others, those with the most similar direction first.

    Windows are shifted on the planes of the squares. The first matches correct positions and slopes of the
    planes, if need be several times, and all photographs are matched on these. What these say of the slopes
    is applied to the matches themselves, of which it is a linear function.

    Half of the noise of a match is that of the template, and is assigned to the reference, as in
    `tie_points`. If no third ray checks a match, it is also matched back.
    """
    i, k = squares.image, len(squares)
    ray = estimate.position[:, None] - squares.planes.points[None]
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    cosine = np.where(visible, np.einsum("mkc,kc->mk", ray, ray[i]), -np.inf)
    cosine[i] = np.inf
    rank = np.argsort(np.argsort(-cosine, axis=0, kind="stable"), axis=0, kind="stable")
    reference = ImagePoints(np.full(k, i), np.arange(k), squares.xy, np.full((k, 2, 2), np.nan))

    def measure(which: BoolArray, planes: Planes, max_shift_px: float) -> list[_Matched]:
        settings = LsmSettings(
            model="shift",
            window_px=window_px,
            max_shift_px=max_shift_px,
            min_correlation=MIN_CORRELATION,
            blur=True,
            linear=True,
        )
        others = np.flatnonzero(which.any(axis=1))
        on_planes = replace(squares, planes=planes)
        matched = in_threads(
            lambda j: _matched(
                photographs, estimate, camera, on_planes, j, np.flatnonzero(which[j]), settings, both_ways
            ),
            others[others != i].tolist(),
            threads,
        )
        return [rays for rays in matched if rays is not None]

    unknown = np.eye(2) * UNKNOWN_SLOPE / estimate.cameras[camera[i]].c_px ** 2
    planes, of_planes, changed = squares.planes, squares.planes.slope_covariance, np.zeros((k, 2))
    first, coarse = visible & (rank <= FIRST_PHOTOGRAPHS), np.ones(k, dtype=bool)
    matched: list[_Matched] = []
    unknown_planes = ~np.isfinite(of_planes).all(axis=(1, 2))
    if unknown_planes.any():
        changed = _affine_slopes(
            photographs, estimate, camera, squares, first & unknown_planes, window_px, threads
        )
        planes = tilted_planes(estimate, camera, i, squares.xy, planes, changed)
    for _ in range(MAX_ROUNDS):
        matched = [rays.select(~coarse[rays.seen.point]) for rays in matched]
        matched += measure(first & coarse, planes, FIRST_SHIFT_PX)
        equations = slope_equations([rays.windows for rays in matched], k)
        better = estimate_slopes(equations, of_planes, unknown, changed).slope
        before, changed = changed, np.where(coarse[:, None], better, changed)  # others are on earlier planes
        points = intersect_image_points(
            ImagePoints.joined([reference, *(rays.seen for rays in matched)]),
            camera,
            estimate,
            n_points=k,
            tolerance_px=TOLERANCE_PX,
        ).points
        planes = replace(squares.planes, points=points)
        planes = tilted_planes(estimate, camera, i, squares.xy, planes, changed)
        step = np.linalg.norm(changed - before, axis=1) * window_px / 2
        coarse = np.zeros(k, dtype=bool)
        for rays in matched:
            coarse[rays.seen.point[rays.border_step(step) > COARSE_STEP]] = True
        coarse &= np.isfinite(points).all(axis=1)
        if not coarse.any():
            break
    matched = measure(visible & np.isfinite(points).all(axis=1), planes, LATER_SHIFT_PX)
    equations = slope_equations([rays.windows for rays in matched], k)
    slopes = estimate_slopes(equations, of_planes, unknown, changed)
    # matches are linear functions of slopes for short steps only
    step = np.linalg.norm(slopes.slope - changed, axis=1) * window_px / 2
    matched = [rays.select(rays.border_step(step) <= COARSE_STEP) for rays in matched]
    number, in_reference = np.zeros(k), np.zeros((k, 2, 2))
    seen, of_slopes = [reference], [np.zeros((k, 2, 2))]
    for rays in matched:
        window, G = rays.seen.point, rays.windows.shift_per_slope()
        number[window] += 1
        in_reference[window] += rays.in_reference
        moved = np.einsum("kab,kb->ka", G, (slopes.slope - changed)[window])
        seen.append(replace(rays.seen, xy=rays.seen.xy + moved))
        of_slopes.append(G @ slopes.covariance[window] @ G.transpose(0, 2, 1))
    reference.covariance[:] = in_reference / np.where(number > 0, number, np.nan)[:, None, None]
    joined = ImagePoints.joined(seen)
    used = (number > 0)[joined.point]
    return SquareRays(
        joined.select(used),
        np.concatenate(of_slopes)[used],
        np.concatenate([np.ones(k), *(rays.scale for rays in matched)])[used],
        np.concatenate([np.ones(k), *(rays.correlation for rays in matched)])[used],
    )


def _matched(
    photographs: GreyPhotographs,
    estimate: Estimate,
    camera: IntArray,
    squares: Squares,
    j: int,
    rows: IntArray,
    settings: LsmSettings,
    both_ways: bool,
) -> _Matched | None:
    """Return the matches of some squares in photograph j; None if it sees none of their planes."""
    i = squares.image
    placed = _placed(estimate, camera, squares, j, rows, settings.window_px / 2)
    if not len(placed.rows):
        return None
    xy = squares.xy[placed.rows]
    match = match_lsm(photographs[i], photographs[j], xy, placed.at, settings, start=placed.warp)
    good = match.good
    if both_ways:
        good &= _returning(photographs[i], photographs[j], xy, match, settings.window_px)
    if match.linear is None or not good.any():
        return None
    linear, half = linear_part(match.warp[good]), match.covariance[good] / 2
    back = np.linalg.inv(linear)
    return _Matched(
        ImagePoints(np.full(int(good.sum()), j), placed.rows[good], match.xy[good], half),
        ShiftedWindows(placed.rows[good], linear, placed.parallax[good], match.linear.select(good)),
        match.correlation[good],
        placed.scale[good],
        back @ half @ back.transpose(0, 2, 1),
    )


@dataclass(frozen=True)
class _Placed:
    """Squares on their planes in another photograph."""

    rows: IntArray  # of the squares that the photograph sees, (k,)
    at: FloatArray  # where, px, (k, 2)
    warp: FloatArray  # homographies of the windows, relative to both points, (k, 3, 3)
    scale: FloatArray  # of the windows relative to the reference, (k,)
    parallax: FloatArray  # shift in the reference for a relative change of inverse depth by 1, px, (k, 2)


def _placed(
    estimate: Estimate, camera: IntArray, squares: Squares, j: int, rows: IntArray, reach_px: float
) -> _Placed:
    """Return where photograph j shows some squares on their planes."""
    i, planes, xy = squares.image, squares.planes.select(rows), squares.xy[rows]
    at = project_points(estimate, camera, np.full(len(rows), j), planes.points)
    warp = plane_warps(estimate, camera, i, j, xy, planes.points, planes.normal, reach_px)
    with np.errstate(invalid="ignore"):  # for planes that the photograph does not see
        scale = np.sqrt(np.maximum(np.linalg.det(warp[:, :2, :2]), 0.0))
        fits = _cosines(estimate.position[j : j + 1], planes)[0] > MIN_COSINE
    fits &= np.isfinite(at).all(axis=1) & (scale > SCALES[0]) & (scale < SCALES[1])
    parallax = _parallaxes(estimate, camera, i, j, planes.points[fits], warp[fits])
    return _Placed(rows[fits], at[fits], warp[fits], scale[fits], parallax)


def _affine_slopes(
    photographs: GreyPhotographs,
    estimate: Estimate,
    camera: IntArray,
    squares: Squares,
    which: BoolArray,
    window_px: int,
    threads: int,
) -> FloatArray:
    """Return approximate slopes of squares from affine matches, which find planes that are far off, (k, 2).

    Args:
        photographs: m photographs.
        estimate: their orientation.
        camera: index of the camera of each photograph, (m,).
        squares: k squares of one photograph.
        which: squares to match in each of the others, (m, k).
        window_px: odd side of the windows.
        threads: number of photographs processed in parallel.
    """
    i, k = squares.image, len(squares)
    settings = LsmSettings(
        window_px=window_px, max_shift_px=FIRST_SHIFT_PX, min_correlation=MIN_CORRELATION, blur=True
    )

    def matched(j: int) -> tuple[IntArray, FloatArray, FloatArray]:
        placed = _placed(estimate, camera, squares, j, np.flatnonzero(which[j]), window_px / 2)
        match = match_lsm(
            photographs[i], photographs[j], squares.xy[placed.rows], placed.at, settings, start=placed.warp
        )
        rows, good = placed.rows[match.good], match.good
        turned = np.linalg.solve(linear_part(placed.warp[good]), linear_part(match.warp[good])) - np.eye(2)
        return rows, placed.parallax[good], turned

    others = np.flatnonzero(which.any(axis=1))
    products, squares_of_parallax = np.zeros((k, 2)), np.zeros(k)
    for rows, parallax, turned in in_threads(matched, others[others != i].tolist(), threads):
        products[rows] += np.einsum("ka,kab->kb", parallax, turned)
        squares_of_parallax[rows] += np.einsum("ka,ka->k", parallax, parallax)
    slope = products / np.where(squares_of_parallax > 0, squares_of_parallax, 1.0)[:, None]
    # a plane seen at grazing incidence at most: beyond, the affine matches are wrong
    possible = np.linalg.norm(slope, axis=1) * estimate.cameras[camera[i]].c_px < 1 / MIN_COSINE
    return np.where(possible[:, None], slope, 0.0)


def _parallaxes(
    estimate: Estimate, camera: IntArray, i: int, j: int, points: FloatArray, warp: FloatArray
) -> FloatArray:
    """Return by how much windows of photograph i move against j if the inverse depth doubles, linearly, px.

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
    return np.asarray(np.linalg.solve(linear_part(warp), moved[:, :, None])[:, :, 0]) / STEP


def _returning(template: Grey, other: Grey, xy: FloatArray, match: LsmMatches, window_px: int) -> BoolArray:
    """Return which matches, matched back, return to their origin within the usual error, (k,)."""
    rows = np.flatnonzero(match.good)
    back = match_lsm(
        other,
        template,
        match.xy[rows],
        xy[rows],
        start=np.asarray(np.linalg.inv(linear_part(match.warp[rows]))),
        settings=LsmSettings(model="shift", window_px=window_px, min_correlation=MIN_CORRELATION, blur=True),
    )
    off = back.xy - xy[rows]
    square = np.einsum("ka,kab,kb->k", off, np.linalg.inv(back.covariance), off)
    good = np.zeros(len(xy), dtype=bool)
    good[rows] = square <= RETURN_FACTOR**2 * np.median(square[back.good]) if back.good.any() else False
    return good


def covariance_with_slopes(seen: ImagePoints, of_slopes: FloatArray) -> FloatArray:
    """Return covariances of image points that give object points their whole variance, (k, 2, 2).

    The errors of matching of n rays of a point average, those of its slope are the same in all. Slopes
    therefore count n times. The reference has none.

    Args:
        seen: image points with the covariance of matching.
        of_slopes: covariance by the slopes, px^2, (k, 2, 2).
    """
    moved = np.einsum("kaa->k", of_slopes) > 0
    rays = np.bincount(seen.point[moved], minlength=int(seen.point.max(initial=-1)) + 1)[seen.point]
    return np.asarray(seen.covariance + rays[:, None, None] * of_slopes)


def _points_that_meet(
    measured: SquareRays, estimate: Estimate, camera: IntArray, min_rays: int
) -> tuple[CoveringPoints, BoolArray]:
    """Return the points with enough rays that meet, and which rays these are, (k,)."""
    seen = measured.image_points
    n = int(seen.point.max(initial=-1)) + 1
    met = intersect_image_points(seen, camera, estimate, n_points=n, tolerance_px=TOLERANCE_PX)
    used = met.used & (np.bincount(seen.point[met.used], minlength=n) >= min_rays)[seen.point]
    kept, point = np.unique(seen.point[used], return_inverse=True)
    c = np.array([lens.c_px for lens in estimate.cameras])[camera[seen.image[used]]]
    image_points = replace(seen.select(used), point=point.ravel())
    residuals = met.residuals[used] * c[:, None]
    matched = int((np.bincount(seen.point, minlength=n) >= min_rays)[seen.point].sum())
    of_slopes = measured.of_slopes[used]
    return CoveringPoints(image_points, met.points[kept], of_slopes, residuals, matched), used


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
        np.concatenate([part.of_slopes for part in parts]),
        np.concatenate([part.residuals for part in parts]),
        sum(part.matched for part in parts),
    )
