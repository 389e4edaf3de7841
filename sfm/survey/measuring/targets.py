"""The targets of all photographs of a survey, measured side by side."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from sfm.conventions import AnyArray, FloatArray
from sfm.photographs.exif import Metadata, read_metadata
from sfm.photographs.reading import read_photograph, take_back_srgb
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.inputs.cameras import start_cameras
from sfm.survey.inputs.checks.copies import MIN_COMMON
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.survey.inputs.photograph_list import PhotographList
from sfm.survey.inputs.settings import TargetSettings
from sfm.survey.inputs.survey import Survey
from sfm.survey.measuring.measured_store import TARGETS, MeasuredStore, measured_once
from sfm.survey.measuring.photographs import each_photograph
from sfm.targets.codes.concentric import ConcentricFamily
from sfm.targets.codes.families import TargetFamily
from sfm.targets.codes.plates import PlateFamily, PlateGroup
from sfm.targets.codes.tags import TagFamily
from sfm.targets.detect import Targets, find_targets


def measure_photographs(
    survey: Survey,
    photographs: PhotographList,
    *,
    jobs: int = 1,
    store: MeasuredStore | None = None,
    progress: Progress = SILENT,
) -> MeasuredPhotographs:
    """Read the photographs, find, measure and decode their targets.

    A photograph that cannot be read does not stop the others; it is named with the reason, as is one whose
    file is a copy of another.

    Args:
        survey: describes the targets and what is known of the cameras.
        photographs: the files.
        jobs: how many photographs are worked on at a time.
        store: keeps what is measured and spares measuring it again; None to measure everything.
        progress: informed of every photograph.

    Raises:
        GeometryError: fewer than two readable photographs.
        PhotographError: photographs of different size under one camera.
        SurveyFileError: the code table or the start values of a camera are unusable.
    """
    family = survey.family
    found, failed = each_photograph(
        photographs,
        lambda path: _read_and_measure(path, survey.targets, family, store),
        picture=lambda one: one[1].xy.tobytes() if len(one[1]) >= MIN_COMMON else b"",
        jobs=jobs,
        progress=progress,
    )
    order = sorted(found)
    names = tuple(photographs.names[k] for k in order)
    camera = photographs.camera[order]
    return MeasuredPhotographs(
        names,
        tuple(photographs.paths[k] for k in order),
        camera,
        start_cameras(
            survey.cameras,
            survey.source,
            tuple(found[k][0] for k in order),
            camera,
            names,
            survey.start_cameras,
        ),
        tuple(found[k][1] for k in order),
        failed,
        tuple(found[k][2] for k in order),
    )


def _read_and_measure(
    path: Path, settings: TargetSettings, family: TargetFamily | None, store: MeasuredStore | None
) -> tuple[Metadata, Targets, bool]:
    targets, stored = measure_photograph(path, settings, family, store)  # reports faults of a file best
    return read_metadata(path), targets, stored


def measure_photograph(
    path: Path,
    settings: TargetSettings,
    family: TargetFamily | None,
    store: MeasuredStore | None = None,
) -> tuple[Targets, bool]:
    """Return the targets of one photograph and whether an earlier run has measured them.

    The pixels are released at once.

    Args:
        path: the photograph.
        settings: what the targets look like.
        family: their codes, None where they have none.
        store: is asked first, and keeps what had to be measured.

    Raises:
        PhotographError: the photograph cannot be read.
    """
    return measured_once(
        store,
        path,
        TARGETS,
        target_settings(settings, family),
        lambda: targets_in(read_photograph(path, channel=settings.channel), settings, family),
    )


def target_settings(settings: TargetSettings, family: TargetFamily | None) -> str:
    """Return what the targets of a photograph depend on besides it, for the store of what was measured."""
    codes = "none"
    if isinstance(family, TagFamily | ConcentricFamily):
        codes = family.name
    elif isinstance(family, PlateFamily | PlateGroup):
        codes = repr(family)
    elif family is not None:
        table = family.number.tobytes() + family.pattern.tobytes()
        codes = f"{family.cells} {family.inner} {family.outer} {hashlib.sha256(table).hexdigest()}"
    return settings.model_dump_json(include={"channel", "tone", "polarity", "min_diameter_px"}) + "\0" + codes


def targets_in(photograph: AnyArray, settings: TargetSettings, family: TargetFamily | None) -> Targets:
    """Return the targets of a photograph (H, W) that was read in the channel of the settings."""
    return find_targets(
        take_back_srgb(photograph) if settings.tone == "srgb" else photograph,
        polarity=settings.polarity,
        codes=family if family is not None else "none",
        min_diameter_px=settings.min_diameter_px,
    )


def image_point_covariance(targets: Targets, sigma_px: float) -> FloatArray:
    """Return the covariance of image points for the adjustment, px^2, shape (k, 2, 2).

    The fit of a target knows the noise of the photograph only. Errors that it cannot know (JPEG, print, lens,
    a sheet that is not flat) are added by the survey's sigma of an image coordinate.
    """
    return np.asarray(targets.covariance + sigma_px**2 * np.eye(2))
