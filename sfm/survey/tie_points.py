"""The tie points of all photographs of a survey without targets, as a network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm.camera import Camera, tangents_from_pixel
from sfm.conventions import AnyArray, BoolArray, IntArray
from sfm.errors import GeometryError
from sfm.matching.tracks.feature_tracks import find_tie_points
from sfm.network import ImagePoints, Network, reduce_network
from sfm.orientation.intersection import intersect
from sfm.orientation.sequence import Orientation
from sfm.photographs.exif import Metadata, read_metadata
from sfm.photographs.reading import read_photograph
from sfm.progress import SILENT, Progress
from sfm.result import FailedImage, PhotographTargets
from sfm.survey.inputs.cameras import start_cameras
from sfm.survey.inputs.settings import TiePointSettings
from sfm.survey.inputs.start import PhotographList, approximate_values, control_points, scale_bars
from sfm.survey.inputs.survey_file import Survey
from sfm.survey.orientation import orient_survey
from sfm.survey.photographs import each_photograph

MIN_RAYS = 3  # photographs that must agree on a tie point; two rays cannot contradict each other
ORIENTATION_POINTS = 400  # that take part in the orientation, those with the most rays, and
POINTS_PER_PHOTOGRAPH = 100  # of every photograph at least so many


@dataclass(frozen=True)
class TiedPhotographs:
    """The readable photographs of a survey with the tie points that they have in common."""

    network: Network  # image points with the covariance of matching and the survey's sigma
    cameras: tuple[Camera, ...]  # with start values of the interior orientation
    paths: tuple[Path, ...]  # of the photographs of the network, (m,)
    failed: tuple[FailedImage, ...]  # photographs that could not be read, and copies of others

    def overlays(self, window_px: int) -> tuple[PhotographTargets, ...]:
        """Return what the report draws into each photograph: circles as wide as the windows."""
        seen = self.network.image_points
        drawn = []
        for i, (name, path) in enumerate(zip(self.network.images, self.paths, strict=True)):
            xy = seen.xy[seen.image == i]
            radius = np.full((len(xy), 2), window_px / 2)
            none = np.zeros(0, dtype=np.int64)
            drawn.append(PhotographTargets(name, path, xy, radius, np.zeros(len(xy)), np.zeros((0, 2)), none))
        return tuple(drawn)


def tie_photographs(
    survey: Survey,
    settings: TiePointSettings,
    photographs: PhotographList,
    *,
    jobs: int = 1,
    progress: Progress = SILENT,
) -> TiedPhotographs:
    """Read the photographs and measure the points of natural texture that they have in common.

    All photographs are in memory at the same time, since points are matched between any two of them. One
    that cannot be read does not stop the others; it is named with the reason, as is a copy of another.

    Args:
        survey: says what is known of the cameras, and the sigma of an image coordinate.
        settings: detector and windows.
        photographs: the files.
        jobs: how many photographs are worked on at a time.
        progress: told of every photograph.

    Raises:
        GeometryError: fewer than two readable photographs, or no point that three of them have in common.
        PhotographError: photographs of different size under one camera.
        SurveyFileError: the start values of a camera are incomplete.
    """
    found, failed = each_photograph(survey, photographs, _read, jobs=jobs, progress=progress)
    read = sorted(found)
    names = tuple(photographs.names[k] for k in read)
    camera: IntArray = photographs.camera[read]
    cameras = start_cameras(survey, tuple(found[k][0] for k in read), camera, names)
    tied = find_tie_points(
        [found[k][1] for k in read],
        detector=settings.detector,
        window_px=settings.window_px,
        max_features=settings.max_features,
        min_rays=MIN_RAYS,
        threads=jobs,
    )
    if not len(tied):
        raise GeometryError(
            f"survey {survey.name}: no texture that {MIN_RAYS} photographs have in common; more overlap or "
            "smaller steps between the photographs are needed"
        )
    points = tuple(f"t{j + 1:05d}" for j in range(int(tied.point.max()) + 1))
    covariance = tied.covariance + survey.adjust.sigma_px**2 * np.eye(2)
    network = Network(
        names,
        camera,
        points,
        ImagePoints(tied.image, tied.point, tied.xy, covariance),
    )
    control, _ = control_points(survey, points)
    bars, _ = scale_bars(survey, points)
    return TiedPhotographs(
        replace(network, control=control, scale_bars=bars),
        cameras,
        tuple(photographs.paths[k] for k in read),
        failed,
    )


def orient_tied(survey: Survey, tied: TiedPhotographs, files: PhotographList) -> Orientation:
    """Orient the photographs on the tie points with the most rays, then intersect all the others.

    Thousands of points orient a survey no better than hundreds, and take their time in every trial.

    Args:
        survey: gives approximate values, if any.
        tied: photographs and tie points.
        files: all photographs of the survey.

    Returns:
        The orientation with all points of the network.

    Raises:
        GeometryError: no two photographs could be oriented.
        SurveyFileError: [approximate] names photographs that are none of the survey's.
    """
    network = tied.network
    part, start = reduce_network(
        network,
        approximate_values(survey, network, tied.cameras, files.names),
        np.ones(len(network.images), dtype=bool),
        _strongest(network),
        np.ones(len(network.image_points), dtype=bool),
    )
    found = orient_survey(survey, part, start)
    seen, estimate = network.image_points, found.estimate
    uv = np.full((len(seen), 2), np.nan)
    for index, camera in enumerate(estimate.cameras):
        own = network.camera[seen.image] == index
        uv[own] = tangents_from_pixel(camera, seen.xy[own])
    c = min(camera.c_px for camera in estimate.cameras)
    rays = intersect(
        uv,
        seen.image,
        seen.point,
        estimate.position,
        estimate.rotation,
        n_points=len(network.points),
        tolerance=float(found.tolerance_px.max()) / c,
    )
    return replace(found, estimate=replace(estimate, points=rays.points))


def _strongest(network: Network) -> BoolArray:
    """Choose the points with the most rays, and in every photograph at least some, (n,)."""
    seen = network.image_points
    order = np.argsort(-network.rays(), kind="stable")
    chosen = np.zeros(len(network.points), dtype=bool)
    chosen[order[:ORIENTATION_POINTS]] = True
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    for i in range(len(network.images)):
        own = seen.point[seen.image == i]
        chosen[own[np.argsort(rank[own], kind="stable")][:POINTS_PER_PHOTOGRAPH]] = True
    return chosen


def _read(path: Path) -> tuple[Metadata, AnyArray]:
    return read_metadata(path), read_photograph(path)
