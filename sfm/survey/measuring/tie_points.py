"""Tie points of a survey without targets, and the neighbours of each photograph.

Natural texture is matched between photographs that are neighbours in position or sequence. Photographs with
few tie points are searched again for more features.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

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
from sfm.photographs.exif import Metadata, read_metadata
from sfm.photographs.masks import Masks
from sfm.photographs.reading import PhotographFiles, read_photograph
from sfm.runtime.progress import SILENT, Progress, reported
from sfm.survey.inputs.cameras import start_cameras
from sfm.survey.inputs.measurements import Measurements, PhotographList
from sfm.survey.inputs.pair_list import PairList
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
from sfm.survey.measuring.neighbours import (
    given_exterior,
    neighbours_by_position,
    neighbours_in_sequence,
    neighbours_in_view,
)
from sfm.survey.measuring.targets import each_photograph
from sfm.targets.outlines import estimate_noise

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
        neighbours_in_view(given_exterior(survey, names, cameras), camera, PARTNERS),
    )
    pairs = _listed_pairs(survey.pairs, names)
    matched = MatchedPairs(store=None if store is None else StoredMatches(store))

    def tie(min_image_points: int) -> TiePoints:
        tied = find_tie_points(
            pictures,
            natural,
            threads=jobs,
            known=matched,
            neighbours=neighbours,
            pairs=pairs,
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
        remarks=_remarks_on_matching(
            len(matched.known), neighbours if pairs is None else None, tied.still, names
        ),
    )


def _listed_pairs(pairs: PairList | None, names: Sequence[str]) -> IntArray | None:
    """Return the pairs of a list whose photographs were read, i < j, sorted, (p, 2); None without a list."""
    if pairs is None:
        return None
    index = {name: i for i, name in enumerate(names)}
    listed = [(index[a], index[b]) for a, b in pairs.names if a in index and b in index]
    return np.unique(np.sort(np.array(listed, dtype=np.int64).reshape(-1, 2), axis=1), axis=0)


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
    pairs: int, neighbours: Sequence[IntArray] | None, still: FloatArray, names: Sequence[str]
) -> tuple[Remark, ...]:
    """Return the remarks on matched pairs, if these are not all pairs, and on features that stand still.

    neighbours: by position, in sequence and in view, (m, k) each; None if the pairs are those of a list.
    still: share of such features in each photograph, (m,).
    """
    remarks = []
    possible = len(names) * (len(names) - 1) // 2
    if pairs != possible:
        ways = ("by_position", "in_sequence", "by_exterior")
        used = dict(zip(ways, neighbours or (), strict=neighbours is not None))
        counts = {way: int((near >= 0).any(axis=1).sum()) or None for way, near in used.items()}
        how = ("in common" if neighbours else "listed",)
        remarks.append(remark("pairs_matched", pairs=pairs, possible=possible, how=how, **counts))
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
