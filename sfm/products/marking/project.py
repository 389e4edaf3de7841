"""What is marked: the photographs of a folder, a survey or a result, with cameras and given values."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.model.camera import Camera
from sfm.model.conventions import FloatArray
from sfm.model.errors import SurveyFileError
from sfm.model.solution import Solution
from sfm.photographs.exif import read_metadata
from sfm.products.drafting.camera_groups import SensorWidth, group_photographs
from sfm.products.drafting.draft import UNIT, metadata_of_folder, names_of_folder
from sfm.survey.inputs.cameras import start_cameras
from sfm.survey.inputs.given_values import KnownPoints, ScaleBar
from sfm.survey.inputs.measurements import PhotographList, find_photographs
from sfm.survey.inputs.sources import given_tables
from sfm.survey.inputs.survey import CameraSetup, Survey
from sfm.survey.sources.given import in_pixels


@dataclass(frozen=True)
class GivenImagePoint:
    """An image point that a survey gives or that was measured automatically."""

    photograph: str
    point: str
    xy: tuple[float, float]  # px
    covariance: FloatArray  # px^2, (2, 2)


@dataclass(frozen=True)
class MarkedProject:
    """Photographs to mark, and what is known of them."""

    survey: Survey  # settings; of a folder, only its cameras
    photographs: PhotographList
    sizes: tuple[tuple[int, int], ...]  # width and height of each photograph, px
    cameras: tuple[Camera, ...]  # start values; those of the result, if there is one
    solution: Solution | None = None  # orientation, points and image points of an automatic survey
    survey_file: Path | None = None  # None: of a folder, which has none yet
    given: tuple[GivenImagePoint, ...] = ()  # image points that the survey gives

    @property
    def control(self) -> KnownPoints | None:
        """Known points of the survey."""
        return self.survey.control

    @property
    def bars(self) -> tuple[ScaleBar, ...]:
        """Scale bars of the survey."""
        return self.survey.scale_bars


def project_of_folder(folder: Path, sensor_width: SensorWidth = lambda make, model: None) -> MarkedProject:
    """Return the photographs of a folder, with the cameras that their EXIF data show; decodes none.

    Args:
        folder: contains the photographs.
        sensor_width: looks up the sensor width if EXIF data do not give the pixel size.

    Raises:
        SurveyFileError: there is no folder, or no photograph in it.
    """
    metadata, _ = metadata_of_folder(folder)
    if not metadata:
        raise SurveyFileError(f"{folder}: no photograph can be read there")
    grouping = group_photographs(metadata, sensor_width)
    cameras = [
        CameraSetup(
            name=camera.name,
            images=list(camera.globs),
            pixel_mm=list(camera.pixel_mm),
            c_mm=camera.c_mm,
            c_assumed=camera.assumed,
        )
        for camera in grouping.cameras
    ]
    name = next(names_of_folder(folder))
    survey = Survey(name=name, unit=UNIT, cameras=tuple(cameras), folder=folder, source=str(folder))
    return project_of_survey(survey)


def project_of_survey(
    survey: Survey,
    *,
    images_dir: Path | None = None,
    survey_file: Path | None = None,
    solution: Solution | None = None,
) -> MarkedProject:
    """Return the photographs of a survey; decodes none.

    Args:
        survey: its settings and given values.
        images_dir: folder of the photographs; that of the survey if not given.
        survey_file: the file that states it.
        solution: result of the survey, whose orientation is used.

    Raises:
        SurveyFileError: a camera has no photographs or no start values.
        PhotographError: a photograph cannot be read, or differs in size from others of its camera.
    """
    files = find_photographs(survey, images_dir=images_dir)
    metadata = tuple(read_metadata(path) for path in files.paths)
    cameras = start_cameras(
        survey.cameras, survey.source, metadata, files.camera, files.names, survey.start_cameras
    )
    given = _given_image_points(survey, files, cameras)
    if solution is not None:
        # those of the result, then those of the survey for photographs that are not in it
        network = solution.network
        index = {name: int(network.camera[i]) for i, name in enumerate(network.images)}
        solved = solution.estimate.cameras
        owner = [
            index.get(name, len(solved) + int(k)) for name, k in zip(files.names, files.camera, strict=True)
        ]
        cameras = (*solved, *cameras)
        files = PhotographList(files.names, files.paths, np.array(owner, dtype=np.int64), files.folder)
    sizes = tuple(data.size_px for data in metadata)
    return MarkedProject(survey, files, sizes, cameras, solution, survey_file, given)


def _given_image_points(
    survey: Survey, files: PhotographList, cameras: tuple[Camera, ...]
) -> tuple[GivenImagePoint, ...]:
    """Return the image points of the tables of a survey, and of its control, in its photographs."""
    owner = dict(zip(files.names, files.camera.tolist(), strict=True))
    given = []
    for table in given_tables(survey):
        here = table.select(np.array([image in owner for image in table.image], dtype=bool))
        camera = np.array([owner[image] for image in here.image], dtype=np.int64)
        xy, C = in_pixels(here, cameras, camera, table.sigma_px or survey.adjust.sigma_px)
        given += [
            GivenImagePoint(image, point, (float(x), float(y)), covariance)
            for image, point, (x, y), covariance in zip(here.image, here.point, xy, C, strict=True)
        ]
    return tuple(given)


def refuse_other_survey(marks: str, survey: str, path: Path) -> None:
    """Raise SurveyFileError if a marks file belongs to another survey.

    Args:
        marks: name of the survey in the marks file; empty if it states none.
        survey: name of the survey.
        path: the marks file.
    """
    if marks and marks != survey:
        raise SurveyFileError(f"{path}: has the marks of survey '{marks}', not of '{survey}'; choose --out")
