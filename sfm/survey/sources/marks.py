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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.errors import SurveyFileError
from sfm.matching.lsm.coverage import Windows
from sfm.matching.lsm.depth_search import search_depth
from sfm.matching.lsm.surface_planes import FARTHEST, NEAREST, planes_at
from sfm.matching.radiometry import GreyPhotographs
from sfm.network import Estimate, ImagePoints, Network, rows_of
from sfm.orientation.image_rays import intersect_image_points
from sfm.orientation.incremental.sequence import Orientation
from sfm.photographs.masks import Masks
from sfm.photographs.reading import read_photograph
from sfm.remarks.remark import remark
from sfm.survey.inputs.given import Observations
from sfm.survey.inputs.measurements import NO_PHOTOGRAPHS, Measurements, PhotographList
from sfm.survey.inputs.sources import GIVEN, MARKS
from sfm.survey.inputs.start import network_of
from sfm.survey.inputs.survey import Survey
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
from sfm.survey.sources.given import read_tables
from sfm.survey.sources.source import Correspondences, SurveySource


def measure_marks(survey: Survey, files: PhotographList = NO_PHOTOGRAPHS, **_: object) -> Measurements:
    """Return the network of the places that a person names.

    Args:
        survey: a survey with named points.
        files: its photographs.

    Raises:
        SurveyFileError: a named point is in no photograph of the survey, or outside its photograph.
        PhotographError: photographs of different sizes have the same camera.
    """
    marks = survey.marks
    sigma = np.array([[mark.sigma_px] * 2 for mark in marks])
    table = Observations.from_arrays(
        [mark.image for mark in marks],
        [mark.name for mark in marks],
        [[mark.x_px, mark.y_px] for mark in marks],
        sigma,
    )
    table = replace(table, table=replace(table.table, path=Path(f"{survey.source}: [[point]]")))
    measured = read_tables(survey, (table,), files)
    known = set(files.names)
    for image in measured.network.images:
        if image not in known:
            name = next(mark.name for mark in marks if mark.image == image)
            raise SurveyFileError(
                f"{survey.source}: point '{name}' is named in '{image}', which is no photograph of the survey"
            )
    return measured


def match_marks(
    oriented: Oriented, measured: Measurements, start: Orientation, *, jobs: int = 1
) -> Correspondences:
    """Return the image points of the named points in all photographs that show them.

    Args:
        oriented: the survey with the image points of all its sources, which give the surface.
        measured: the places that the person names.
        start: orientation of their photographs, and points that several of them show.
        jobs: number of photographs processed in parallel.

    Raises:
        SurveyFileError: a named point has the name of a target.
    """
    survey, whole, points = oriented.survey, oriented.measured.network, measured.network.points
    _refuse_names_of_others(survey, whole, points)
    scene = _scene_of(oriented)
    by_hand = measured.network.image_points
    index = {name: i for i, name in enumerate(whole.images)}
    image = np.array([index[name] for name in measured.network.images], dtype=np.int64)
    by_hand = replace(by_hand, image=image[by_hand.image], source=None)
    of_point, first = np.unique(by_hand.point, return_index=True)
    windows = Windows(survey.texture.window_px)
    parts = [by_hand.select(slice(0))]
    for i, rows in enumerate(rows_of(by_hand.image[first], len(whole.images))):
        if len(rows) and scene.estimate.oriented[i]:
            point = of_point[rows]
            places = by_hand.xy[first[rows]]
            rays = _match_templates(scene, i, places, start.estimate.points[point], windows, jobs)
            parts.append(replace(rays, point=point[rays.point]))
    matched = ImagePoints.joined(parts)
    lost = np.setdiff1d(of_point, matched.point)
    noise = survey.adjust.sigma_px**2 * np.eye(2)
    matched = replace(matched, covariance=matched.covariance + noise)
    key, known = (seen.image * len(points) + seen.point for seen in (by_hand, matched))
    everything = ImagePoints.joined([matched, by_hand.select(~np.isin(key, known))])
    everything = everything.select(np.argsort(everything.point, kind="stable"))
    network = network_of(survey, whole.images, whole.camera, points, everything)
    found = intersect_image_points(
        everything,
        network.camera,
        scene.estimate,
        n_points=len(points),
        tolerance_px=float(start.tolerance_px.max()),
    )
    unmatched = (remark("marks_unmatched", points=[points[j] for j in lost]),) if len(lost) else ()
    paths = [scene.paths.get(name, Path()) for name in network.images]
    drawn = drawn_windows(network, paths, windows.side_px)
    return Correspondences(
        network,
        replace(scene.estimate, points=found.points),
        measured.min_rays,
        point_failures=start.point_failures,
        given=start.kind == "given",
        remarks=unmatched,
        overlays=tuple(overlay for overlay in drawn if overlay.image in scene.paths),
    )


@dataclass(frozen=True)
class _Scene:
    """The oriented photographs that have files, and the image points that give the surface."""

    network: Network
    estimate: Estimate
    seen: ImagePoints
    paths: Mapping[str, Path]
    grey: GreyPhotographs
    masks: Masks

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
        network.image_points.select(fits),
        paths,
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


def _match_templates(
    scene: _Scene, i: int, xy: FloatArray, known: FloatArray, windows: Windows, jobs: int
) -> ImagePoints:
    """Return the rays of points with a template in photograph i, in all photographs that show them.

    The object point is approximately known, or on the surface of its neighbours, or else it is searched for
    along its ray.

    Args:
        scene: the oriented photographs.
        i: photograph of the templates.
        xy: middles of the templates, px, (k, 2).
        known: approximate object points, NaN where unknown, (k, 3).
        windows: size of the windows.
        jobs: number of photographs processed in parallel.
    """
    estimate, camera = scene.estimate, scene.network.camera
    neighbours = np.unique(scene.seen.point[scene.seen.image == i])
    on_surface, normal = planes_at(estimate, camera, i, xy, neighbours)
    normal = np.where(np.isfinite(normal), normal, estimate.rotation[i][:, 2])

    def along_rays(rows: IntArray) -> FloatArray:
        return _search_along_rays(scene, i, xy[rows], normal[rows], neighbours, windows.side_px)

    parts: list[ImagePoints] = []
    lost = np.arange(len(xy))
    for approximate in (lambda rows: known[rows], lambda rows: on_surface[rows], along_rays):
        points = approximate(lost)
        rows = lost[np.isfinite(points).all(axis=1)]
        if len(rows):
            squares = Squares(i, xy[rows], normal[rows], points[np.isin(lost, rows)])
            rays = _rays_that_meet(scene, squares, windows, jobs)
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
    count = shown.sum(axis=0)
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
        met = intersect_image_points(rays, camera, estimate, n_points=len(numbers), tolerance_px=TOLERANCE_PX)
        used = rays.select(met.used)
        enough = np.bincount(used.point, minlength=len(numbers)) >= needed
        enough &= np.bincount(used.point[used.image == i], minlength=len(numbers)) > 0
        used = used.select(enough[used.point])
        parts.append(replace(used, point=numbers[used.point]))
    return ImagePoints.joined(parts)


SOURCE = SurveySource(measure_marks, match_marks)
