"""Natural points that a person names: a place in one photograph, found in all others.

What the person marks is a template: the window around the place. The point is what the middle of this window
shows. Therefore its image point in the photograph of the template has no error of pointing, and the point is
the same in every run, and in every epoch that uses this template. Least squares matching measures it in the
others. A match has the noise of both windows: half of its covariance, or more where its window is smaller
than the template, is that of its image point. The rest, common to all, is that of the image point of the
template. The standard deviations are those of the displacement of the point between epochs. Residuals of all
named points give the factor of these covariances, and the part of the errors that no match sees (`joined`).
Its coordinates have the noise of the template beside, about 0.02 px, which is the same in all epochs. What
the person means by the name may lie beside it by the error of pointing, about a pixel; a bar to this point
has that error too.

Marks of a point in further photographs, with the sigma of pointing, show where it is: they may orient these
photographs, they decide where a pattern looks alike at several places, and they stay where nothing is
matched. Those beside the matched point are left out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from sfm.files.open_folders import path_inside
from sfm.judgement.survey_result import LeftOutPoint
from sfm.matching.conjugate import KeyPoints, match_points
from sfm.matching.lsm.coverage import project_points
from sfm.matching.lsm.surface_planes import squares_over_covariance
from sfm.matching.radiometry import GreyPhotographs, grey_of
from sfm.model.camera import tangents_from_pixel
from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.distributions import Levels, chi2_isf
from sfm.model.errors import SurveyFileError
from sfm.model.network import ImagePoints, Network, indices_of
from sfm.model.remarks.remark import remark
from sfm.orientation.image_rays import intersect_image_points
from sfm.orientation.incremental.sequence import FINAL_TOLERANCE_PX, Orientation
from sfm.orientation.resection.ransac import resect_robust
from sfm.photographs.masks import Masks
from sfm.photographs.reading import read_photograph
from sfm.survey.inputs.given_values import Observations
from sfm.survey.inputs.measurements import NO_PHOTOGRAPHS, Measurements, PhotographList
from sfm.survey.inputs.settings import PointSettings
from sfm.survey.inputs.sources import GIVEN, MARKS
from sfm.survey.inputs.start import network_of
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.covering_points import FIRST_PHOTOGRAPHS, TOLERANCE_PX
from sfm.survey.measuring.surface_points import masked_pixels
from sfm.survey.measuring.templates import NONE, TemplateRays, TemplateScene, match_templates
from sfm.survey.measuring.tie_points import drawn_windows
from sfm.survey.orientation import Oriented
from sfm.survey.sources.given import read_tables
from sfm.survey.sources.source import Correspondences, SurveySource

EARLIER = "earlier"  # name of a photograph of an earlier epoch, which takes no part in the network
MOST_RESECTED = 100  # points of a photograph that orient it
MIN_MARKED = 2  # photographs in which a point without a match is marked by hand


def measure_marks(survey: Survey, files: PhotographList = NO_PHOTOGRAPHS, **_: object) -> Measurements:
    """Return the network of the places that a person names in the photographs of a survey.

    Args:
        survey: a survey with named points.
        files: its photographs.

    Raises:
        SurveyFileError: the photograph of a named point shows less than its place.
        PhotographError: photographs of different sizes have the same camera.
    """
    here = [mark for mark in survey.marks if mark.image in files.names]
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
        SurveyFileError: a named point has the name of one that another source measured.
        PhotographError: a photograph of an earlier epoch cannot be read.
    """
    survey, whole, part = oriented.survey, oriented.measured.network, measured.network
    points = tuple(dict.fromkeys(mark.name for mark in survey.marks))
    measuring = np.array([source not in (MARKS, GIVEN) for source in whole.sources])
    taken = {whole.points[j] for j in whole.image_points.point[measuring[whole.source]].tolist()}
    for name in points:
        if name in taken:
            raise SurveyFileError(
                f"{survey.source}: point '{name}' has the name of a target or tie point, needed another name"
            )
    scene = _scene_of(oriented)
    index = {name: i for i, name in enumerate(whole.images)}
    image = np.array([index[name] for name in part.images], dtype=np.int64)
    point = indices_of(points, part.points)
    known = np.full((len(points), 3), np.nan)
    known[point] = start.estimate.points
    seen = part.image_points
    by_hand = replace(seen, image=image[seen.image], point=point[seen.point], source=None)
    rays = _match_all(oriented, scene, points, known, jobs)
    used = _without_contradictions(scene, rays.image_points, by_hand, survey.adjust.levels)
    lost = np.setdiff1d(np.arange(len(points)), rays.image_points.point)
    matched = _with_pointing(survey, whole, points, used.matched)
    key, by_hand_key = (rows.image * len(points) + rows.point for rows in (matched, used.by_hand))
    everything = ImagePoints.joined([matched, used.by_hand.select(~np.isin(by_hand_key, key))])
    everything = everything.select(np.argsort(everything.point, kind="stable"))
    network = network_of(survey, whole.images, whole.camera, points, everything)
    placed = intersect_image_points(
        everything,
        network.camera,
        scene.estimate,
        n_points=len(points),
        tolerance_px=float(start.tolerance_px.max()),
    )
    paths = _paths_of(oriented)
    drawn = drawn_windows(
        network, [paths.get(name, Path()) for name in network.images], survey.texture.window_px
    )
    contradicting = tuple(f"{points[j]} in {whole.images[i]}" for i, j in used.contradicting)
    remarks = []
    if len(lost):
        alike = [points[j] for j in np.intersect1d(rays.alike, lost)]
        remarks.append(remark("marks_unmatched", points=[points[j] for j in lost], alike=alike or None))
    return Correspondences(
        network,
        replace(scene.estimate, points=placed.points),
        np.full(len(points), MIN_MARKED),
        point_failures=start.point_failures,
        given=start.kind == "given",
        remarks=tuple(remarks),
        overlays=tuple(overlay for overlay in drawn if overlay.image in paths),
        left_out_image_points=tuple(
            LeftOutPoint(name, 1, remark("image_points_contradicting", image_points=name))
            for name in contradicting
        ),
    )


def _paths_of(oriented: Oriented) -> dict[str, Path]:
    """Return the files of the photographs, by their names."""
    files = oriented.measured.files
    return {} if files is None else files.path_of()


def _scene_of(oriented: Oriented) -> TemplateScene:
    """Return the oriented photographs that have files, and the image points that fit."""
    network, start, paths = oriented.measured.network, oriented.orientation, _paths_of(oriented)
    position = start.estimate.position.copy()
    position[[name not in paths for name in network.images]] = np.nan
    measured = np.array([source != MARKS for source in network.sources])[network.source]
    fits = start.fits & start.estimate.determined[network.image_points.point] & measured
    return TemplateScene(
        network,
        replace(start.estimate, position=position),
        replace(network.image_points.select(fits), source=None, stated=None),
        GreyPhotographs(lambda i: read_photograph(paths[network.images[i]])),
        masked_pixels(Masks(oriented.survey.masks), network, start.estimate),
    )


@dataclass(frozen=True)
class _Used:
    """Image points that agree."""

    matched: ImagePoints
    by_hand: ImagePoints
    contradicting: tuple[tuple[int, int], ...]  # (photograph, point) of marks that are left out


def _without_contradictions(
    scene: TemplateScene, matched: ImagePoints, by_hand: ImagePoints, levels: Levels
) -> _Used:
    """Return the matched image points and the marks that are where the point is.

    Where most further marks of a point contradict, its template is not where the person means it to be: what
    was matched is left out, with the marks that agree with it. Otherwise the others are left out.
    """
    n = 1 + int(max(by_hand.point.max(initial=-1), matched.point.max(initial=-1)))
    placed = intersect_image_points(
        matched, scene.network.camera, scene.estimate, n_points=n, tolerance_px=TOLERANCE_PX
    )
    at = project_points(scene.estimate, scene.network.camera, by_hand.image, placed.points[by_hand.point])
    off = squares_over_covariance(by_hand.xy - at, by_hand.covariance)  # NaN where nothing was matched
    wrong = off > chi2_isf(levels.of_each(len(off)), 2)
    tested = np.bincount(by_hand.point[np.isfinite(off)], minlength=n)
    of_point = np.bincount(by_hand.point[wrong], minlength=n)
    elsewhere = (of_point > 1) & (2 * of_point >= tested)
    wrong = np.where(elsewhere[by_hand.point], np.isfinite(off) & ~wrong, wrong)
    contradicting = zip(by_hand.image[wrong].tolist(), by_hand.point[wrong].tolist(), strict=True)
    kept = ~elsewhere[matched.point]
    return _Used(matched.select(kept), by_hand.select(~wrong), tuple(contradicting))


def _with_pointing(
    survey: Survey, network: Network, points: Sequence[str], matched: ImagePoints
) -> ImagePoints:
    """Return matched image points with the noise of image points, and that of pointing where it matters.

    A table that has the point too means it by its name: the template is beside it by the error of pointing.
    """
    noise = np.full(len(points), survey.adjust.sigma_px**2)
    given = np.array([source == GIVEN for source in network.sources])[network.source]
    by_tables = {network.points[j] for j in network.image_points.point[given].tolist()}
    pointing = {mark.name: mark.sigma_px for mark in reversed(survey.marks)}
    for j, name in enumerate(points):
        if name in by_tables:
            noise[j] += pointing[name] ** 2
    return replace(matched, covariance=matched.covariance + noise[matched.point][:, None, None] * np.eye(2))


def _match_all(
    oriented: Oriented, scene: TemplateScene, points: Sequence[str], known: FloatArray, jobs: int
) -> TemplateRays:
    """Return the rays of the named points, each with its first template.

    It is in an oriented photograph of the survey, or in one of an earlier epoch, which is oriented on points
    that have not moved, and gives nothing but templates.
    """
    survey, files = oriented.survey, oriented.measured.files or NO_PHOTOGRAPHS
    window_px = survey.texture.window_px
    scenes: dict[str, tuple[TemplateScene, int] | None] = {}
    templates: defaultdict[str, list[PointSettings]] = defaultdict(list)
    named, key_points = set[str](), KeyPoints()
    images, is_oriented = scene.network.images, scene.estimate.oriented
    for mark in survey.marks:
        if mark.name in named:
            continue
        if mark.image not in scenes:
            scenes[mark.image] = None  # unless it is oriented
            if mark.image not in files.names:
                path = path_inside(
                    survey.folder, mark.image, survey.source, allow_outside=survey.allow_outside
                )
                with_earlier = _with_earlier(scene, grey_of(read_photograph(path)), key_points)
                if with_earlier is not None:
                    scenes[mark.image] = with_earlier, with_earlier.earlier
            elif mark.image in images and is_oriented[images.index(mark.image)]:
                scenes[mark.image] = scene, images.index(mark.image)
        if scenes[mark.image] is not None:
            templates[mark.image].append(mark)
            named.add(mark.name)
    parts, alike = [scene.seen.select(NONE)], [NONE]
    for name, marks in templates.items():
        with_template, i = cast(tuple[TemplateScene, int], scenes[name])
        xy = np.array([[mark.x_px, mark.y_px] for mark in marks])
        point = np.array([points.index(mark.name) for mark in marks])
        rays = match_templates(with_template, i, xy, known[point], window_px, survey.adjust.levels, jobs)
        parts.append(replace(rays.image_points, point=point[rays.image_points.point]))
        alike.append(point[rays.alike])
    return TemplateRays(ImagePoints.joined(parts), np.concatenate(alike))


def _with_earlier(scene: TemplateScene, photograph: AnyArray, key_points: KeyPoints) -> TemplateScene | None:
    """Return the photographs and one of an earlier epoch, oriented on its points; None if it cannot be.

    It is assumed to be of the first camera with photographs of its size. The key points are those of all
    photographs, for the next one of an earlier epoch.
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
            matches = match_points(scene.grey[i].pixels, photograph, shown.xy, key_points=key_points)
            there = replace(shown, image=np.full(len(shown), m), xy=matches.right)
            parts.append(there.select(matches.good))
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


SOURCE = SurveySource(measure_marks, match_marks)
