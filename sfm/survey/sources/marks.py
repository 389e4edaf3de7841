"""Natural points that a person names: a place in one photograph, found in all others.

What the person marks is a template: the window around the place. The point is what the middle of this window
shows. Therefore its image point in the photograph of the template has no error of pointing, and the point is
the same in every run, and in every epoch that uses this template. Least squares matching measures it in the
others. A match has the noise of both windows: half of its covariance is that of its image point, and the
other half, common to all, that of the image point of the template. The standard deviations are those of the
point in the middle of the template. What the person means by the name may lie beside it by the error of
pointing, about a pixel; a bar to this point has that error too.

Marks of a point in further photographs, with the sigma of pointing, show where it is: they may orient these
photographs, and they stay where nothing is matched.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from sfm.camera import tangents_from_pixel
from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.errors import SurveyFileError
from sfm.matching.conjugate import match_points
from sfm.matching.lsm.coverage import Windows
from sfm.matching.lsm.depth_search import search_depth
from sfm.matching.lsm.surface_planes import FARTHEST, NEAREST, planes_at
from sfm.matching.radiometry import GreyPhotographs, grey_of
from sfm.network import Estimate, ImagePoints, Network, rows_of
from sfm.orientation.image_rays import intersect_image_points
from sfm.orientation.incremental.sequence import FINAL_TOLERANCE_PX, Orientation
from sfm.orientation.resection.ransac import resect_robust
from sfm.photographs.masks import Masks
from sfm.photographs.reading import read_photograph
from sfm.remarks.remark import remark
from sfm.survey.inputs.given import Observations
from sfm.survey.inputs.measurements import NO_PHOTOGRAPHS, Measurements, PhotographList
from sfm.survey.inputs.settings import PointSettings
from sfm.survey.inputs.sources import GIVEN, MARKS
from sfm.survey.inputs.start import network_of
from sfm.survey.inputs.survey import Survey
from sfm.survey.inputs.survey_file import path_inside
from sfm.survey.measuring.covering_points import (
    BORDER_PX,
    FIRST_PHOTOGRAPHS,
    MIN_RAYS,
    TOLERANCE_PX,
    Squares,
    match_squares,
    seen_squares,
)
from sfm.survey.measuring.tie_points import drawn_windows
from sfm.survey.orientation import Oriented
from sfm.survey.sources.given import full_names, read_tables
from sfm.survey.sources.source import Correspondences, SurveySource

EARLIER = "earlier"  # name of a photograph of an earlier epoch, which takes no part in the network
MOST_RESECTED = 100  # points of a photograph that orient it
MIN_MARKED = 2  # photographs in which a point without a match is marked by hand
NONE = np.zeros(0, dtype=np.int64)


def measure_marks(survey: Survey, files: PhotographList = NO_PHOTOGRAPHS, **_: object) -> Measurements:
    """Return the network of the places that a person names in the photographs of a survey.

    Args:
        survey: a survey with named points.
        files: its photographs.

    Raises:
        SurveyFileError: the photograph of a named point does not exist, or shows less than its place.
        PhotographError: photographs of different sizes have the same camera.
    """
    known = _names_of(files)
    here = [mark for mark in survey.marks if mark.image in known]
    for mark in survey.marks:
        if mark.image not in known and not _path_of(survey, mark).is_file():
            raise SurveyFileError(
                f"{survey.source}: point '{mark.name}' is named in '{mark.image}', which is neither a "
                "photograph of the survey nor a file of an earlier epoch"
            )
    if not here:
        nothing = ImagePoints(NONE, NONE, np.zeros((0, 2)), np.zeros((0, 2, 2)))
        return Measurements(Network((), NONE, (), nothing), (), (), NONE)
    table = Observations.from_arrays(
        [mark.image for mark in here],
        [mark.name for mark in here],
        [[mark.x_px, mark.y_px] for mark in here],
        [[mark.sigma_px, mark.sigma_px] for mark in here],
    )
    table = replace(table, table=replace(table.table, path=Path(f"{survey.source}: [[point]]")))
    return read_tables(survey, (table,), files)


def _names_of(files: PhotographList | None) -> frozenset[str]:
    """Return the names of photographs, with folders and without."""
    return frozenset() if files is None else frozenset({*files.names, *full_names(files)})


def _path_of(survey: Survey, mark: PointSettings) -> Path:
    """Return the file of the photograph of a mark, which may be of an earlier epoch."""
    return path_inside(survey.folder, mark.image, survey.source, allow_outside=survey.allow_outside)


def match_marks(
    oriented: Oriented, measured: Measurements, start: Orientation, *, jobs: int = 1
) -> Correspondences:
    """Return the image points of the named points in all photographs that show them.

    Args:
        oriented: the survey with the image points of all its sources, which give the surface.
        measured: the places that the person names in photographs of the survey.
        start: orientation of these photographs, and points that several of them show.
        jobs: number of photographs processed in parallel.

    Raises:
        SurveyFileError: a named point has the name of a target, or its place is outside a photograph of an
            earlier epoch.
        PhotographError: a photograph of an earlier epoch cannot be read.
    """
    survey, whole, part = oriented.survey, oriented.measured.network, measured.network
    points = tuple(dict.fromkeys(mark.name for mark in survey.marks))
    _refuse_names_of_others(survey, whole, points)
    scene = _scene_of(oriented)
    known = np.full((len(points), 3), np.nan)
    index = {name: i for i, name in enumerate(whole.images)}
    image = np.array([index[name] for name in part.images], dtype=np.int64)
    point = np.array([points.index(name) for name in part.points], dtype=np.int64)
    known[point] = start.estimate.points
    seen = part.image_points
    by_hand = replace(seen, image=image[seen.image], point=point[seen.point], source=None)
    windows = Windows(survey.texture.window_px)
    first = {mark.name: mark.image for mark in reversed(survey.marks)}  # the photograph of the template
    templates_here = np.array([first[name] in scene.names for name in points])
    parts = [
        *_match_templates_here(scene, by_hand.select(templates_here[by_hand.point]), known, windows, jobs),
        *_match_templates_of_others(survey, scene, points, known, windows, jobs),
    ]
    matched = ImagePoints.joined([by_hand.select(NONE), *parts])
    lost = np.setdiff1d(np.arange(len(points)), matched.point).tolist()
    noise = survey.adjust.sigma_px**2 * np.eye(2)
    matched = replace(matched, covariance=matched.covariance + noise)
    by_hand_key, key = (one.image * len(points) + one.point for one in (by_hand, matched))
    everything = ImagePoints.joined([matched, by_hand.select(~np.isin(by_hand_key, key))])
    everything = everything.select(np.argsort(everything.point, kind="stable"))
    network = network_of(survey, whole.images, whole.camera, points, everything)
    found = intersect_image_points(
        everything,
        network.camera,
        scene.estimate,
        n_points=len(points),
        tolerance_px=float(start.tolerance_px.max()),
    )
    paths = [scene.paths.get(name, Path()) for name in network.images]
    drawn = drawn_windows(network, paths, windows.side_px)
    return Correspondences(
        network,
        replace(scene.estimate, points=found.points),
        np.full(len(points), MIN_MARKED),
        point_failures=start.point_failures,
        given=start.kind == "given",
        remarks=(remark("marks_unmatched", points=[points[j] for j in lost]),) if lost else (),
        overlays=tuple(overlay for overlay in drawn if overlay.image in scene.paths),
    )


@dataclass(frozen=True)
class _Scene:
    """The oriented photographs that have files, and the image points that give the surface."""

    network: Network
    estimate: Estimate
    seen: ImagePoints
    paths: Mapping[str, Path]
    names: frozenset[str]  # of these photographs, with folders and without
    grey: GreyPhotographs
    masks: Masks
    earlier: int = -1  # photograph of an earlier epoch, of which the points may have moved

    def visible(self, j: int, xy: FloatArray) -> BoolArray:
        """Return which positions in a photograph are not masked, (k,)."""
        size_px = self.estimate.cameras[self.network.camera[j]].size_px
        return self.masks.visible(self.network.images[j], xy, size_px)


def _scene_of(oriented: Oriented) -> _Scene:
    network, start, files = oriented.measured.network, oriented.orientation, oriented.measured.files
    paths = {} if files is None else dict(zip(files.names, files.paths, strict=True))
    position = start.estimate.position.copy()
    position[[name not in paths for name in network.images]] = np.nan
    fits = start.fits & start.estimate.determined[network.image_points.point]
    return _Scene(
        network,
        replace(start.estimate, position=position),
        replace(network.image_points.select(fits), source=None, stated=None),
        paths,
        _names_of(files),
        GreyPhotographs(lambda i: read_photograph(paths[network.images[i]])),
        Masks(oriented.survey.masks),
    )


def _refuse_names_of_others(survey: Survey, network: Network, points: Sequence[str]) -> None:
    """Raise SurveyFileError if a named point has the name of a point that another source measured."""
    measuring = np.array([source not in (MARKS, GIVEN) for source in network.sources])
    measured = {network.points[j] for j in network.image_points.point[measuring[network.source]].tolist()}
    for name in points:
        if name in measured:
            raise SurveyFileError(
                f"{survey.source}: point '{name}' has the name of a target, needed another name"
            )


def _match_templates_here(
    scene: _Scene, by_hand: ImagePoints, known: FloatArray, windows: Windows, jobs: int
) -> Iterator[ImagePoints]:
    """Yield the rays of points whose first mark is in a photograph of the survey."""
    of_point, first = np.unique(by_hand.point, return_index=True)
    for i, rows in enumerate(rows_of(by_hand.image[first], len(scene.network.images))):
        if len(rows) and scene.estimate.oriented[i]:
            point = of_point[rows]
            rays = _match_templates(scene, i, by_hand.xy[first[rows]], known[point], windows, jobs)
            yield replace(rays, point=point[rays.point])


def _match_templates_of_others(
    survey: Survey, scene: _Scene, points: Sequence[str], known: FloatArray, windows: Windows, jobs: int
) -> Iterator[ImagePoints]:
    """Yield the rays of points whose first mark is in a photograph of an earlier epoch.

    This photograph is oriented on points that have not moved, and gives nothing but the templates.
    """
    first = {mark.name: mark for mark in reversed(survey.marks)}
    earlier = [mark for mark in first.values() if mark.image not in scene.names]
    for path in dict.fromkeys(_path_of(survey, mark) for mark in earlier):
        marks = [mark for mark in earlier if _path_of(survey, mark) == path]
        photograph = grey_of(read_photograph(path))
        height, width = photograph.shape
        for mark in marks:
            if not (0 <= mark.x_px < width and 0 <= mark.y_px < height):
                raise SurveyFileError(
                    f"{survey.source}: point '{mark.name}' is at {mark.x_px:g}, {mark.y_px:g} px, outside "
                    f"{mark.image} of {width} x {height} px"
                )
        with_earlier = _with_earlier(scene, photograph)
        if with_earlier is not None:
            xy = np.array([[mark.x_px, mark.y_px] for mark in marks])
            point = np.array([points.index(mark.name) for mark in marks])
            rays = _match_templates(with_earlier, len(scene.network.images), xy, known[point], windows, jobs)
            yield replace(rays, point=point[rays.point])


def _with_earlier(scene: _Scene, photograph: AnyArray) -> _Scene | None:
    """Return the photographs and one of an earlier epoch, oriented on its points; None if it cannot be.

    It is assumed to be of the first camera with photographs of its size.
    """
    network, estimate, seen = scene.network, scene.estimate, scene.seen
    of_size = [a for a, lens in enumerate(estimate.cameras) if lens.size_px == photograph.shape[::-1]]
    if not of_size:
        return None
    lens, m = estimate.cameras[of_size[0]], len(network.images)
    most = np.argsort(-np.bincount(seen.image, minlength=m), kind="stable")[:FIRST_PHOTOGRAPHS]
    parts = [seen.select(NONE)]
    for i in most.tolist():
        shown = seen.select(seen.image == i)
        if len(shown):
            shown = shown.select(np.arange(0, len(shown), -(-len(shown) // MOST_RESECTED)))
            found = match_points(scene.grey[i].pixels, photograph, shown.xy)
            there = replace(shown, image=np.full(len(shown), m), xy=found.right)
            parts.append(there.select(found.good))
    matched = ImagePoints.joined(parts)
    resected = resect_robust(
        tangents_from_pixel(lens, matched.xy),
        estimate.points[matched.point],
        tolerance=FINAL_TOLERANCE_PX / lens.c_px,
        field=lens.size_px[0] * lens.size_px[1] / lens.c_px**2,
    )
    if not resected.found:
        return None
    return replace(
        scene,
        network=replace(
            network, images=(*network.images, EARLIER), camera=np.append(network.camera, of_size[0])
        ),
        estimate=replace(
            estimate,
            position=np.concatenate([estimate.position, resected.position[None]]),
            rotation=np.concatenate([estimate.rotation, resected.rotation[None]]),
        ),
        seen=ImagePoints.joined([seen, matched.select(resected.inliers)]),
        grey=GreyPhotographs(lambda j: photograph if j == m else scene.grey[j].pixels),
        earlier=m,
    )


def _match_templates(
    scene: _Scene,
    i: int,
    xy: FloatArray,
    known: FloatArray,
    windows: Windows,
    jobs: int,
) -> ImagePoints:
    """Return the rays of points with a template in photograph i, in all photographs that show them.

    The object point is approximately known, or on the surface of its neighbours, or else it is searched for
    along its ray.

    Args:
        scene: the oriented photographs.
        i: photograph of the templates.
        xy: middles of the templates, px, (k, 2).
        known: approximate object points, NaN where unknown, (k, 3).
        windows: size of the windows; larger ones are tried where these are not matched.
        jobs: number of photographs processed in parallel.
    """
    estimate, camera = scene.estimate, scene.network.camera
    neighbours = np.unique(scene.seen.point[scene.seen.image == i])
    on_surface, normal = planes_at(estimate, camera, i, xy, neighbours)
    normal = np.where(np.isfinite(normal), normal, estimate.rotation[i][:, 2])

    def along_rays(rows: IntArray, windows: Windows) -> FloatArray:
        return _search_along_rays(scene, i, xy[rows], normal[rows], neighbours, windows.side_px)

    parts = [scene.seen.select(NONE)]
    lost = np.arange(len(xy))
    for side_px, approximate in product(
        (windows.side_px, 2 * windows.side_px - 1),  # larger ones show more texture
        (lambda rows, _: known[rows], lambda rows, _: on_surface[rows], along_rays),
    ):
        tried = replace(windows, side_px=side_px)
        points = approximate(lost, tried)
        rows = lost[np.isfinite(points).all(axis=1)]
        if len(rows):
            squares = Squares(i, xy[rows], normal[rows], points[np.isin(lost, rows)])
            rays = _rays_that_meet(scene, squares, tried, jobs)
            parts.append(replace(rays, point=rows[rays.point]))
            lost = np.setdiff1d(lost, parts[-1].point)
    return ImagePoints.joined(parts)


def _search_along_rays(
    scene: _Scene, i: int, xy: FloatArray, normal: FloatArray, neighbours: IntArray, window_px: int
) -> FloatArray:
    """Return object points where photographs of similar directions show the surroundings most alike."""
    estimate, camera = scene.estimate, scene.network.camera
    depth = -((estimate.points[neighbours] - estimate.position[i]) @ estimate.rotation[i])[:, 2]
    depth = depth[depth > 0]
    if not len(depth):
        return np.full((len(xy), 3), np.nan)
    direction = estimate.position - np.median(estimate.points[neighbours], axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    cosine = np.where(estimate.oriented, direction @ direction[i], -np.inf)
    cosine[i] = -np.inf
    nearest = [j for j in np.argsort(-cosine)[:FIRST_PHOTOGRAPHS].tolist() if np.isfinite(cosine[j])]
    others = {j: scene.grey[j].pixels for j in nearest}
    points = [
        search_depth(
            scene.grey[i].pixels,
            others,
            estimate,
            camera,
            i,
            place,
            normal=across,
            nearest=NEAREST * float(depth.min()),
            farthest=FARTHEST * float(depth.max()),
            window_px=window_px,
        )
        for place, across in zip(xy, normal, strict=True)
    ]
    return np.reshape(points, (-1, 3))


def _rays_that_meet(scene: _Scene, squares: Squares, windows: Windows, jobs: int) -> ImagePoints:
    """Return the rays of squares that meet in a point: three, or two where only two photographs show it."""
    estimate, camera, i = scene.estimate, scene.network.camera, squares.image
    shown = np.zeros((len(scene.network.images), len(squares)), dtype=bool)
    for j, rows, at in seen_squares(estimate, camera, squares, windows.side_px // 2 + BORDER_PX):
        shown[j, rows[scene.visible(j, at)]] = True
    shown[i] = True
    count = shown.sum(axis=0) - (i == scene.earlier)
    parts = []
    for needed, these in ((MIN_RAYS, count >= MIN_RAYS), (2, count == 2)):
        numbers = np.flatnonzero(these)
        if not len(numbers):
            continue
        rays = match_squares(
            scene.grey,
            estimate,
            camera,
            squares.select(these),
            shown[:, these],
            windows,
            jobs,
            both_ways=needed == 2,
        ).image_points
        rays = rays.select(rays.image != scene.earlier)
        met = intersect_image_points(rays, camera, estimate, n_points=len(numbers), tolerance_px=TOLERANCE_PX)
        used = rays.select(met.used & _under_no_mask(scene, rays))
        enough = np.bincount(used.point, minlength=len(numbers)) >= needed
        if i != scene.earlier:  # the ray of the template is the point
            enough &= np.bincount(used.point[used.image == i], minlength=len(numbers)) > 0
        used = used.select(enough[used.point])
        parts.append(replace(used, point=numbers[used.point]))
    return ImagePoints.joined([scene.seen.select(NONE), *parts])


def _under_no_mask(scene: _Scene, rays: ImagePoints) -> BoolArray:
    """Return which image points are not masked where they were matched, (k,)."""
    visible = np.ones(len(rays), dtype=bool)
    for j in np.unique(rays.image).tolist():
        rows = np.flatnonzero(rays.image == j)
        visible[rows] = scene.visible(j, rays.xy[rows])
    return visible


SOURCE = SurveySource(measure_marks, match_marks)
