"""Natural texture of a survey: tie points; once photographs are oriented, windows that cover them."""

from __future__ import annotations

from pathlib import Path

from sfm.orientation.incremental.sequence import Orientation
from sfm.photographs.masks import Masks
from sfm.survey.inputs.measurements import Measurements
from sfm.survey.inputs.survey import Survey
from sfm.survey.inputs.survey_file import SurveyFile
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.measuring.surface_points import cover_photographs
from sfm.survey.measuring.tie_points import natural_points_of, needed_rays, tie_photographs
from sfm.survey.orientation import Oriented
from sfm.survey.sources.source import Correspondences, SurveySource, complete_as_measured


def _cover(
    oriented: Oriented, measured: Measurements, start: Orientation, *, jobs: int = 1
) -> Correspondences:
    """Return the windows that cover the photographs, or the tie points if these have more rays."""
    surface = cover_photographs(
        oriented.survey, measured, start, targets=oriented.measured.photographs, jobs=jobs
    )
    if surface is None:
        return complete_as_measured(oriented, measured, start)
    return Correspondences(
        surface.network,
        surface.estimate,
        needed_rays(surface.network),
        point_failures=start.point_failures,
        given=start.kind == "given",
        remarks=surface.remarks,
        overlays=surface.overlays,
    )


def _measure_one(
    survey: Survey | SurveyFile, image: str, path: Path, store: MeasuredStore
) -> tuple[dict[str, int], bool]:
    natural, stored = natural_points_of(path, image, survey.texture, Masks(survey.masks), store)
    return {"features": len(natural)}, stored


SOURCE = SurveySource(tie_photographs, _cover, lambda survey: (("tie_points", survey.texture),), _measure_one)
