"""The distortion model of the cameras that photographed a plate: central perspective or fisheye.

The photographs that the plate was searched in are measured and oriented as in a survey that states no model,
so the same likelihood decides here and there, see `orient_survey`. The survey finds them measured.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm.model.errors import GeometryError, PhotographError
from sfm.model.remarks.remark import of_kind
from sfm.products.drafting.camera_groups import CameraGroup
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.inputs.measurements import PhotographList
from sfm.survey.inputs.survey import survey_of_file
from sfm.survey.inputs.survey_file import SurveyFile
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.orientation import orient_survey
from sfm.survey.target_network import measure_targets

MAX_OF_CAMERA = 8  # photographs of a camera, spread over the folder


def with_lens_models(
    text: str,
    cameras: tuple[CameraGroup, ...],
    folder: Path,
    *,
    store: MeasuredStore | None = None,
    progress: Progress = SILENT,
) -> tuple[CameraGroup, ...]:
    """Return the cameras; those that the image points of a plate show to have a fisheye lens state so.

    Args:
        text: survey file of the cameras and the plate, with neither models nor free parameters.
        cameras: cameras of the survey, in its order.
        folder: contains the photographs.
        store: stores the measurements, so that the survey need not repeat them.
        progress: receives every photograph.
    """
    survey = survey_of_file(SurveyFile.model_validate(tomllib.loads(text)))
    survey = replace(survey, rigs=(), masks=survey.masks and folder / survey.masks)
    names, owner = list[str](), list[int]()
    for index, camera in enumerate(cameras):
        count = len(camera.photographs)
        chosen = sorted({round(k) for k in np.linspace(0, count - 1, min(count, MAX_OF_CAMERA))})
        names += [camera.photographs[k] for k in chosen]
        owner += [index] * len(chosen)
    files = PhotographList(tuple(names), tuple(folder / name for name in names), np.array(owner), folder)
    try:
        measured = measure_targets(survey, files, store=store, progress=progress)
        oriented = orient_survey(survey, measured)
    except (GeometryError, PhotographError):  # the survey states the reason
        return cameras
    taken = {
        name: f"likelier: {said.number('fitting'):.0f} of {said.number('total'):.0f} image points fit it, "
        f"{said.number('before'):.0f} a central perspective"
        for said in of_kind(oriented.measured.remarks, "fisheye_taken")
        for name in said.names("camera")
    }
    return tuple(replace(camera, fisheye=taken.get(camera.name, camera.fisheye)) for camera in cameras)
