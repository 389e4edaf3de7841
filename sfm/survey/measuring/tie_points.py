"""Tie points of a survey without targets, and the neighbours of each photograph.

Natural texture is matched between photographs that are neighbours in position or sequence. Photographs with
few tie points are searched again for more features.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial import cKDTree

from sfm.judgement.survey_result import PhotographTargets
from sfm.matching.radiometry import full_scale, grey_of
from sfm.matching.tracks.feature_tracks import TiePoints, TrackSettings, find_tie_points
from sfm.matching.tracks.features import MIN_PAIR_MATCHES
from sfm.matching.tracks.interest import NaturalPoints, natural_points
from sfm.matching.tracks.matched_pairs import MatchedPairs
from sfm.matching.tracks.overlap import PARTNERS
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.model.network import ImagePoints, Network, rows_of
from sfm.model.remarks.remark import Remark, remark
from sfm.photographs.exif import USUAL_SIGMAS_M, Metadata, local_coordinates, read_metadata
from sfm.photographs.masks import Masks
from sfm.photographs.reading import PhotographFiles, read_photograph
from sfm.runtime.progress import SILENT, Progress, reported
from sfm.survey.inputs.cameras import start_cameras
from sfm.survey.inputs.measurements import Measurements, PhotographList
from sfm.survey.inputs.settings import TiePointSettings
from sfm.survey.inputs.start import network_of
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.measured_store import (
    TEXTURE,
    MeasuredStore,
    StoredMatches,
    content_hash,
    measured_once,
)
from sfm.survey.measuring.targets import each_photograph
from sfm.targets.outlines import estimate_noise

NONE = -1  # no photograph
# Median distance from the median position, in standard deviations, beyond which positions differ by more than
# their errors: errors alone give 1.5 (three axes).
MIN_SPREAD_SIGMAS = 2.0
# A photograph with fewer image points is searched for more features, if it has more in common with another
# one than chance gives: at most 14 pairs of 2,000 features of different textures choose each other. Three
# photographs of a portal, taken while walking towards it, have 36 tie points in common with 2,000 features
# each, and 249 with 8,000.
SCARCE_TIE_POINTS, MORE_FEATURES = 100, 4
# Share of the features of a photograph from which those that stand still are reported. Dirt on the sensor
# makes a few.
STILL_SHARE = 0.01
# Photographs that must agree on a point: two rays do not reveal an error along the epipolar line. Points of
# two rays are used if a photograph, or a part of it, has no others.
MIN_RAYS = 3


def tie_photographs(
    survey: Survey,
    files: PhotographList,
    *,
    jobs: int = 1,
    store: MeasuredStore | None = None,
    progress: Progress = SILENT,
) -> Measurements:
    """Read the photographs and measure the points of natural texture that they have in common.

    Photographs are read when needed. A photograph that cannot be read does not stop the others. It is listed
    with the reason, and so is a copy of another photograph.

    Args:
        survey: states detector and windows, camera data, and the sigma of an image coordinate.
        files: files of the photographs.
        jobs: number of photographs processed in parallel.
        store: store of features of single photographs; None to detect all features anew.
        progress: receives every photograph.

    Raises:
        GeometryError: fewer than two readable photographs, or no point that two of them have in common.
        PhotographError: photographs of different sizes have the same camera.
        SurveyFileError: the start values of a camera are incomplete.
    """
    settings, masks = survey.texture, Masks(survey.masks)
    name_of = dict(zip(files.paths, files.names, strict=True))

    def read_and_detect(path: Path) -> tuple[Metadata, NaturalPoints, bool]:
        natural, stored = natural_points_of(path, name_of[path], settings, masks, store)
        return read_metadata(path), natural, stored  # after the pixels, as for targets

    detected, failed = each_photograph(
        files,
        read_and_detect,
        places=lambda read: read[1].xy,
        jobs=jobs,
        progress=progress,
    )
    read = sorted(detected)
    names = tuple(files.names[k] for k in read)
    camera: IntArray = files.camera[read]
    metadata = [detected[k][0] for k in read]
    cameras = start_cameras(
        survey.cameras, survey.source, tuple(metadata), camera, names, survey.start_cameras
    )
    pictures = PhotographFiles([files.paths[k] for k in read])
    natural = [detected[k][1] for k in read]
    neighbours = (
        neighbours_by_position(metadata, PARTNERS),
        neighbours_in_sequence(names, metadata, PARTNERS),
    )
    matched = MatchedPairs(store=None if store is None else StoredMatches(store))

    def tie(min_image_points: int) -> TiePoints:
        tied = find_tie_points(
            pictures,
            natural,
            threads=jobs,
            known=matched,
            neighbours=neighbours,
            settings=TrackSettings(
                window_px=settings.window_px,
                min_rays=min(MIN_RAYS, len(read)),
                min_image_points=min_image_points,
            ),
        )
        shown = masks.visible_points(
            names, [photograph.size_px for photograph in metadata], tied.image, tied.xy
        )
        return tied if shown.all() else _shown_tie_points(tied, shown)

    tied = tie(0)
    scarce = np.flatnonzero(np.bincount(tied.image, minlength=len(read)) < SCARCE_TIE_POINTS).tolist()
    if "max_features" not in settings.model_fields_set:
        more = settings.model_copy(update={"max_features": MORE_FEATURES * settings.max_features})
        alike = {
            a for pair, match in matched.known.items() if match.candidates >= MIN_PAIR_MATCHES for a in pair
        }
        searched = [a for a in scarce if a in alike]
        for a in reported("photographs searched for more features", searched, len(searched)):
            natural[a] = natural_points_of(files.paths[read[a]], names[a], more, masks, store)[0]
        matched.forget(set(searched))
    if scarce and matched.known:
        tied = tie(SCARCE_TIE_POINTS)
    if not len(tied):
        raise GeometryError(
            "no texture that two photographs have in common; more overlap or "
            "smaller steps between the photographs are needed"
        )
    # These names differ from those of the result, which control and scale bars use: see `surface_points`.
    points = tuple(f"tie {j + 1}" for j in range(int(tied.point.max()) + 1))
    covariance = tied.covariance + survey.adjust.sigma_px**2 * np.eye(2)
    image_points = ImagePoints(tied.image, tied.point, tied.xy, covariance)
    network = network_of(survey, names, camera, points, image_points)
    paths = tuple(files.paths[k] for k in read)
    drawn = drawn_windows(network, paths, settings.window_px)
    return Measurements(
        network,
        cameras,
        files.names,
        needed_rays(network),
        failed,
        tuple(replace(overlay, stored=detected[k][2]) for k, overlay in zip(read, drawn, strict=True)),
        files,
        remarks=_remarks_on_matching(len(matched.known), neighbours, tied.still, names),
    )


def _shown_tie_points(tied: TiePoints, shown: BoolArray) -> TiePoints:
    """Return the image points that are not masked, of points that have as many of them as they need."""
    rays, left = np.bincount(tied.point), np.bincount(tied.point[shown], minlength=len(tied.reference))
    kept = shown & (left >= np.minimum(rays, MIN_RAYS))[tied.point]
    points, point = np.unique(tied.point[kept], return_inverse=True)
    return TiePoints(
        tied.image[kept],
        point.ravel(),
        tied.xy[kept],
        tied.covariance[kept],
        tied.reference[points],
        tied.still,
    )


def _remarks_on_matching(
    pairs: int, neighbours: Sequence[IntArray], still: FloatArray, names: Sequence[str]
) -> tuple[Remark, ...]:
    """Return the remarks on matched pairs, if these are not all pairs, and on features that stand still.

    still: share of such features in each photograph, (m,).
    """
    remarks = []
    possible = len(names) * (len(names) - 1) // 2
    if pairs != possible:
        by_position, in_sequence = (int((near >= 0).any(axis=1).sum()) or None for near in neighbours)
        remarks.append(
            remark(
                "pairs_matched",
                pairs=pairs,
                possible=possible,
                by_position=by_position,
                in_sequence=in_sequence,
            )
        )
    there = np.flatnonzero(still >= STILL_SHARE)
    if len(there):
        share = float(np.median(still[there]))
        remarks.append(remark("still_features", share=share, photographs=[names[i] for i in there.tolist()]))
    return tuple(remarks)


def needed_rays(network: Network) -> IntArray:
    """Return how many rays each point needs: as many as it has, up to MIN_RAYS, (n,)."""
    return np.minimum(network.rays(), MIN_RAYS)


def drawn_windows(network: Network, paths: Sequence[Path], window_px: int) -> tuple[PhotographTargets, ...]:
    """Return the overlays of each photograph in the report: circles as wide as the windows."""
    seen = network.image_points
    drawn = []
    of_image = rows_of(seen.image, len(network.images))
    for name, path, rows in zip(network.images, paths, of_image, strict=True):
        xy = seen.xy[rows]
        radius = np.full((len(xy), 2), window_px / 2)
        none = np.zeros(0, dtype=np.int64)
        drawn.append(PhotographTargets(name, path, xy, radius, np.zeros(len(xy)), np.zeros((0, 2)), none))
    return tuple(drawn)


def natural_points_of(
    path: Path,
    name: str,
    settings: TiePointSettings,
    masks: Masks,
    store: MeasuredStore | None = None,
) -> tuple[NaturalPoints, bool]:
    """Return the natural points of one photograph, and whether they were read from the store.

    Args:
        path: the photograph.
        name: its name.
        settings: detector and number of features.
        masks: what is black in that of the photograph has no points.
        store: is searched first, and stores new features.

    Raises:
        PhotographError: the photograph or its mask cannot be read.
        SurveyFileError: the mask has another size than the photograph.
    """
    stated = settings.model_dump_json(include={"detector", "max_features"})
    mask = masks.path_of(name)
    if mask is not None:
        stated += content_hash(mask)

    def measured() -> NaturalPoints:
        pixels = read_photograph(path)
        noise = estimate_noise(grey_of(pixels)) / full_scale(pixels)
        return natural_points(
            pixels,
            detector=settings.detector,
            max_features=settings.max_features,
            noise=noise,
            hidden=masks.black(name, pixels.shape[1::-1]),
        )

    return measured_once(store, path, TEXTURE, stated, measured)


def neighbours_by_position(metadata: Sequence[Metadata], count: int) -> IntArray:
    """Return the nearest photographs of each photograph, nearest first, padded with NONE, (m, k).

    EXIF positions are compared in units of their standard deviations. If they differ by no more than their
    errors, they say nothing, and no photograph has neighbours.

    Args:
        metadata: metadata of m photographs; some may have no position.
        count: number of neighbours, k.
    """
    neighbours = np.full((len(metadata), count), NONE)
    rows = np.array(
        [k for k, photograph in enumerate(metadata) if photograph.position is not None], dtype=np.int64
    )
    positions = [photograph.position for photograph in metadata if photograph.position is not None]
    if len(positions) < 2:
        return neighbours
    _, places = local_coordinates(positions)
    sigma = np.array([position.sigma_m for position in positions])
    places /= np.median(np.where(np.isnan(sigma), USUAL_SIGMAS_M, sigma), axis=0)
    up = places[:, 2]
    up[np.isnan(up)] = np.median(up[~np.isnan(up)]) if not np.isnan(up).all() else 0.0
    if np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)) < MIN_SPREAD_SIGMAS:
        return neighbours
    nearest = min(count + 1, len(rows))
    order = np.atleast_2d(cKDTree(places).query(places, nearest)[1])
    for k, others in enumerate(order):
        closest = others[others != k][:count]
        neighbours[rows[k], : len(closest)] = rows[closest]
    return neighbours


def neighbours_in_sequence(names: Sequence[str], metadata: Sequence[Metadata], count: int) -> IntArray:
    """Return the photographs taken before and after each photograph, NONE at the ends of a series, (m, k).

    A series consists of photographs of one camera with an EXIF time. Without times it consists of photographs
    whose names differ only in numbers. Photographs of the same time are sorted by the numbers in their names.

    Args:
        names: unique names of m photographs.
        metadata: metadata of these photographs.
        count: number of neighbours, k, even: half of them before, half after; the nearest first.
    """
    series: dict[tuple[object, ...], list[int]] = {}
    for k, photograph in enumerate(metadata):
        camera = (photograph.make, photograph.model, photograph.serial, PurePosixPath(names[k]).parent)
        by_name = re.sub(r"\d+", "0", names[k]) if photograph.taken is None else ""
        series.setdefault((*camera, by_name), []).append(k)

    def moment(k: int) -> tuple[datetime, list[int], str]:
        numbers = [int(digits) for digits in re.findall(r"\d+", names[k])]
        return metadata[k].taken or datetime.min, numbers, names[k]

    neighbours = np.full((len(names), count), NONE)
    for members in series.values():
        ordered = np.array(sorted(members, key=moment))
        for column, offset in enumerate(step for k in range(1, count // 2 + 1) for step in (k, -k)):
            from_, to = (
                (ordered[:-offset], ordered[offset:]) if offset > 0 else (ordered[-offset:], ordered[:offset])
            )
            neighbours[from_, column] = to
    return neighbours
