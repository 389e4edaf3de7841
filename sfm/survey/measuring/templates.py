"""Templates of single points, matched in all oriented photographs that show them.

A point lies somewhere on the ray of its template. Candidates are the surface of its neighbours, and every
place along the ray where other photographs show its surroundings alike, each with the plane of its neighbours
and with a plane that is not known. All are matched by least squares in all photographs. On a repeated pattern
several of them are matched: the one that the photographs show most alike is the point, if it differs from the
others by more than chance, and else the point is not measured. An approximate position, of marks in several
photographs, decides between them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sfm.matching.correlation import MAX_R, ambiguous, independent_pixels
from sfm.matching.lsm.coverage import CoveredPixels
from sfm.matching.lsm.depth_search import SearchedRay, search_depths
from sfm.matching.lsm.surface_planes import FARTHEST, NEAREST, Planes, planes_at
from sfm.matching.radiometry import GreyPhotographs, grey_of
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.distributions import Levels, normal_ppf
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.orientation.image_rays import intersect_image_points
from sfm.survey.measuring.covering_points import (
    BORDER_PX,
    FIRST_PHOTOGRAPHS,
    MIN_RAYS,
    TOLERANCE_PX,
    SquareRays,
    Squares,
    covariance_with_slopes,
    match_squares,
    seen_squares,
)

NONE = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class TemplateScene:
    """The oriented photographs in which templates are matched, and the image points that give the surface."""

    network: Network
    estimate: Estimate
    seen: ImagePoints
    grey: GreyPhotographs
    hidden: CoveredPixels | None = None  # masked pixels of the photographs of the survey
    earlier: int = -1  # photograph of an earlier epoch, of which the points may have moved

    def visible(self, image: IntArray, xy: FloatArray) -> BoolArray:
        """Return which positions in photographs (k,) are not masked, (k,)."""
        visible = np.ones(len(xy), dtype=bool)
        if self.hidden is not None:
            here = image != self.earlier
            visible[here] = self.hidden.free_positions(image[here], xy[here])
        return visible


@dataclass(frozen=True)
class TemplateRays:
    """The rays of templates."""

    image_points: ImagePoints  # of the points 0 to k - 1
    alike: IntArray  # points that are matched at several places, and therefore at none, (a,)


@dataclass(frozen=True)
class _Candidates:
    """Places of templates."""

    template: IntArray  # of each candidate, (c,)
    across: BoolArray  # whether its plane is across the axis, and not that of neighbours, (c,)
    stated: BoolArray  # whether it started from the approximate position of the point, (c,)
    points: FloatArray  # object points, (c, 3)

    def __len__(self) -> int:
        return len(self.template)

    def select(self, rows: BoolArray | IntArray) -> _Candidates:
        """Return the selected candidates."""
        return replace(
            self,
            template=self.template[rows],
            across=self.across[rows],
            stated=self.stated[rows],
            points=self.points[rows],
        )


@dataclass(frozen=True)
class _Matched(_Candidates):
    """Places of templates with rays that meet there."""

    rays: ImagePoints  # of the candidates 0 to c - 1
    r: FloatArray  # mean correlation, by Fisher's z, with 0 where a photograph should show the place, (c,)
    count: IntArray  # rays of each, (c,)


def match_templates(
    scene: TemplateScene,
    i: int,
    xy: FloatArray,
    known: FloatArray,
    window_px: int,
    levels: Levels,
    jobs: int,
) -> TemplateRays:
    """Return the rays of points with a template in photograph i, in all photographs that show them.

    Args:
        scene: the oriented photographs.
        i: photograph of the templates.
        xy: middles of the templates, px, (k, 2).
        known: approximate object points, NaN where unknown, (k, 3).
        window_px: odd side of the windows; larger ones are tried where these are not matched.
        levels: of the comparisons of places that look alike.
        jobs: number of photographs processed in parallel.
    """
    neighbours = np.unique(scene.seen.point[scene.seen.image == i])
    planes = planes_at(scene.estimate, scene.network.camera, i, xy, neighbours)
    axis = np.tile(scene.estimate.rotation[i][:, 2], (len(xy), 1))
    normal = np.where(np.isfinite(planes.normal), planes.normal, axis)
    grey, parts = grey_of(scene.grey[i].pixels), [scene.seen.select(NONE)]
    lost, alike = np.arange(len(xy), dtype=np.int64), NONE
    for side_px in (window_px, 2 * window_px - 1):
        if not len(lost):
            break
        along = _along_rays(scene, i, xy[lost], normal[lost], neighbours, side_px)
        points = np.vstack([known[lost], planes.points[lost], *along])
        template = np.concatenate([lost, lost, np.repeat(lost, [len(places) for places in along])])
        stated = np.arange(len(template)) < len(lost)
        across = np.repeat([False, True], len(template))
        candidates = _Candidates(np.tile(template, 2), across, np.tile(stated, 2), np.tile(points, (2, 1)))
        has_plane = across | np.isfinite(planes.normal[candidates.template]).all(axis=1)
        finite = np.asarray(np.isfinite(candidates.points).all(axis=1) & has_plane)
        if not finite.any():
            continue
        candidates = candidates.select(finite)
        for _ in range(2):  # the rays of the first time correct the places, so that all others find them
            matched = _matched(scene, i, xy, planes, candidates, side_px, jobs)
            candidates = matched
        pixels = np.full(len(xy), np.nan)
        pixels[lost] = independent_pixels(grey, xy[lost], side_px)
        rays, doubtful = _most_alike(matched, pixels, levels)
        parts.append(rays)
        alike = np.union1d(alike, doubtful)  # larger windows would only lose some of the places
        lost = np.setdiff1d(lost, np.union1d(rays.point, alike))
    return TemplateRays(ImagePoints.joined(parts), alike)


def _along_rays(
    scene: TemplateScene, i: int, xy: FloatArray, normal: FloatArray, neighbours: IntArray, window_px: int
) -> list[FloatArray]:
    """Return the places on rays where photographs of similar directions show the surroundings alike."""
    estimate, camera = scene.estimate, scene.network.camera
    depth = -((estimate.points[neighbours] - estimate.position[i]) @ estimate.rotation[i])[:, 2]
    depth = depth[depth > 0]
    if not len(depth):
        return [np.zeros((0, 3))] * len(xy)
    direction = estimate.position - np.median(estimate.points[neighbours], axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    cosine = np.where(estimate.oriented, direction @ direction[i], -np.inf)
    cosine[i] = -np.inf
    nearest = [j for j in np.argsort(-cosine)[:FIRST_PHOTOGRAPHS].tolist() if np.isfinite(cosine[j])]
    others: Mapping[int, AnyArray] = {j: scene.grey[j].pixels for j in nearest}
    return [
        search_depths(
            scene.grey[i].pixels,
            others,
            estimate,
            camera,
            SearchedRay(i, place, across, NEAREST * float(depth.min()), FARTHEST * float(depth.max())),
            window_px=window_px,
        )
        for place, across in zip(xy, normal, strict=True)
    ]


def _matched(
    scene: TemplateScene,
    i: int,
    xy: FloatArray,
    planes: Planes,
    candidates: _Candidates,
    window_px: int,
    jobs: int,
) -> _Matched:
    """Return the places where rays meet: three, or two where only two photographs show it."""
    estimate, camera, n = scene.estimate, scene.network.camera, len(candidates)
    of_neighbours = planes.select(candidates.template)
    across = candidates.across[:, None]
    on_planes = Planes(
        candidates.points,
        np.where(across, estimate.rotation[i][:, 2], of_neighbours.normal),
        np.where(across[:, None], np.nan, of_neighbours.slope_covariance),
    )
    squares = Squares(i, xy[candidates.template], on_planes)
    shown = np.zeros((len(scene.network.images), n), dtype=bool)
    for j, rows, at in seen_squares(estimate, camera, squares, window_px // 2 + BORDER_PX):
        shown[j, rows[scene.visible(np.full(len(rows), j), at)]] = True
    shown[i] = True
    count = shown.sum(axis=0) - (i == scene.earlier)
    parts, z, points = [scene.seen.select(NONE)], np.zeros(n), candidates.points.copy()
    for needed, these in ((MIN_RAYS, count >= MIN_RAYS), (2, count == 2)):
        numbers = np.flatnonzero(these)
        if not len(numbers):
            continue
        measured = match_squares(
            scene.grey,
            estimate,
            camera,
            squares.select(these),
            shown[:, these],
            window_px,
            jobs,
            both_ways=needed == 2,
        )
        kept = np.flatnonzero(measured.image_points.image != scene.earlier)
        rays = measured.image_points.select(kept)
        met = intersect_image_points(rays, camera, estimate, n_points=len(numbers), tolerance_px=TOLERANCE_PX)
        kept = kept[met.used & scene.visible(rays.image, rays.xy)]
        rays = measured.image_points.select(kept)
        enough = np.bincount(rays.point, minlength=len(numbers)) >= needed
        if i != scene.earlier:  # the ray of the template is the point
            enough &= np.bincount(rays.point[rays.image == i], minlength=len(numbers)) > 0
        kept = kept[enough[rays.point]]
        rays, r = measured.image_points.select(kept), measured.correlation[kept]
        rays = replace(rays, covariance=rays.covariance * _shares_of_noise(measured, i)[kept][:, None, None])
        rays = replace(rays, covariance=covariance_with_slopes(rays, measured.of_slopes[kept]))
        others = rays.image != i
        points[numbers] = met.points
        z[numbers] = np.bincount(
            rays.point[others], np.arctanh(np.minimum(r[others], MAX_R)), minlength=len(numbers)
        )
        parts.append(replace(rays, point=numbers[rays.point]))
    joined = ImagePoints.joined(parts)
    rays_of = np.bincount(joined.point, minlength=n)
    mean = np.tanh(z / np.maximum(shown.sum(axis=0) - 1, 1))
    kept, point = np.unique(joined.point, return_inverse=True)
    return _Matched(
        candidates.template[kept],
        candidates.across[kept],
        candidates.stated[kept],
        points[kept],
        replace(joined, point=point),
        mean[kept],
        rays_of[kept],
    )


def _shares_of_noise(measured: SquareRays, i: int) -> FloatArray:
    """Return the noise that a match owes to each image point, over half of that of the match, (k,).

    A window that is smaller than the template shows the texture by fewer pixels, which are used more than
    once: the variance of its noise is that of the template over the ratio of areas, see `two_photo.judge`.

    Args:
        measured: rays of templates, with half of the noise of a match each.
        i: photograph of the templates.
    """
    seen = measured.image_points
    smaller = np.maximum(1.0, 1.0 / measured.scale**2)
    of_template, others = 2.0 / (1.0 + smaller), seen.image != i
    n = int(seen.point.max(initial=-1)) + 1
    total = np.bincount(seen.point[others], of_template[others], minlength=n)
    mean = total / np.maximum(np.bincount(seen.point[others], minlength=n), 1)
    return np.where(others, 2.0 - of_template, mean[seen.point])


def _most_alike(candidates: _Matched, pixels: FloatArray, levels: Levels) -> tuple[ImagePoints, IntArray]:
    """Return the rays of templates at the place that photographs show most alike, and templates without one.

    All photographs are compared with the same template, whose errors they share: several are no more
    evidence than one. A place with fewer rays than another is not the point by its correlation alone.

    Args:
        candidates: the places.
        pixels: independent pixels of each template, (k,).
        levels: of the comparisons of a place with the others.
    """
    chosen, doubtful = [], []
    for template in np.unique(candidates.template).tolist():
        numbers = np.flatnonzero(candidates.template == template)
        best, *others = numbers[np.argsort(-candidates.r[numbers], kind="stable")].tolist()
        same = [k for k in others if _same_place(candidates.rays, best, k)]
        rivals = np.array([k for k in others if k not in same], dtype=np.int64)
        most = max([best, *same], key=lambda k: candidates.count[k])
        r, independent = (np.full(len(rivals), value) for value in (candidates.r[best], pixels[template]))
        quantile = -float(normal_ppf(levels.of_each(len(rivals))))
        doubt = ambiguous(r, candidates.r[rivals], independent, quantile)
        if (doubt | (candidates.count[rivals] > candidates.count[most])).any():
            by_marks = numbers[candidates.stated[numbers]].tolist()
            if by_marks and all(_same_place(candidates.rays, by_marks[0], k) for k in by_marks[1:]):
                chosen.append(max(by_marks, key=lambda k: candidates.count[k]))
            else:
                doubtful.append(template)
        else:
            chosen.append(most)
    kept = np.isin(candidates.rays.point, chosen)
    rays = candidates.rays.select(kept)
    return replace(rays, point=candidates.template[rays.point]), np.array(doubtful, dtype=np.int64)


def _same_place(rays: ImagePoints, a: int, b: int) -> bool:
    """Return whether two candidates ended at the same image points."""
    first, second = (rays.select(rays.point == number) for number in (a, b))
    _, in_a, in_b = np.intersect1d(first.image, second.image, return_indices=True)
    apart = np.linalg.norm(first.xy[in_a] - second.xy[in_b], axis=1)
    return bool(len(apart) > 1 and apart.max() < TOLERANCE_PX)  # the template is one of them
