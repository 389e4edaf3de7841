"""The camcal photographs with the texture of their floor: it must not outvote the targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sfm
from sfm.judgement.survey_result import SurveyResult
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.survey.inputs.settings import TiePointSettings
from tests.places import DATASETS, SHARED

CAMCAL = SHARED / "data" / "camcal" / "images"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CAMCAL.is_dir(), reason="the camcal photographs are not here"),
]


def test_the_floor_moves_the_dots_by_less_than_their_precision_and_changes_no_verdict() -> None:
    survey = sfm.read_survey(DATASETS / "camcal/survey.toml")
    alone = run_survey(survey, images_dir=CAMCAL)
    both = run_survey(replace(survey, tie_points=TiePointSettings()), images_dir=CAMCAL)
    assert alone.verdict.level == both.verdict.level == "fair"
    kinds = [{one.kind for one in result.verdict.remarks} for result in (alone, both)]
    assert "camera_varies" in kinds[0] & kinds[1] and "points_moved" in kinds[0] & kinds[1]
    assert not {"other_camera", "rolling_shutter"} & kinds[1]
    dots = [name for name in alone.adjustment.network.points if name in both.adjustment.network.points]
    assert len(dots) == 100
    # the rays of a dot before and after it moved are two points, and a result has one of them
    moving = {name for result in (alone, both) for name in moved_points(result)}
    assert moved_points(alone) and len(moving) <= 8
    dots = [name for name in dots if name not in moving]
    X, Y = (
        one.adjustment.estimate.points[[one.adjustment.network.points.index(name) for name in dots]]
        for one in (alone, both)
    )
    sigma = np.sqrt(np.diagonal(alone.adjustment.covariance.points, axis1=1, axis2=2))
    sigma = sigma[[alone.adjustment.network.points.index(name) for name in dots]]
    moved = (fit_similarity(Y, X).apply(Y) - X) / sigma
    assert np.sqrt((moved**2).mean()) < 0.2


def moved_points(result: SurveyResult) -> set[str]:
    """Return the points that a result says moved."""
    remarks = [one for one in result.verdict.remarks if one.kind == "points_moved"]
    return {name for one in remarks for name in one.subjects["points"]}
