"""Points of texture that are at two places did not move: their windows show another place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.hypotheses.hypotheses import JudgedAssumptions
from sfm.remarks.remark import of_kind, remark
from sfm.survey.adjusting import solution
from sfm.survey.adjusting.solution import solve_survey
from sfm.survey.correspondences import Correspondences
from sfm.survey.inputs.settings import TiePointSettings
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

POINTS = 40


def test_windows_show_another_place_where_targets_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether a test of alternatives found it, or rejected image points that agree."""
    network, truth = make_network(seed_of("elsewhere"), images=8, points=POINTS, free=("c",))
    moved = [
        remark("points_moved", points=[name], distance=0.1, shift=9.0, wrong=1.0, **{"from": "image 5"})
        for name in ("7", "17")
    ]
    monkeypatch.setattr(
        solution, "judge_alternatives", lambda *_, **__: JudgedAssumptions(causes=(moved[0],))
    )
    monkeypatch.setattr(solution, "explain_rejections", lambda *_, **__: (moved[1],))
    survey = survey_of(network, truth)
    matched = Correspondences(network, truth, np.full(POINTS, 2))
    assert of_kind(solve_survey(survey, matched).remarks, "points_moved") == tuple(moved)
    textured = solve_survey(replace(survey, tie_points=TiePointSettings()), matched).remarks
    found = of_kind(textured, "windows_elsewhere")
    assert [one.names("points") for one in found] == [("7",), ("17",)]
    assert [one.severity for one in found] == ["warning", "warning"] and not of_kind(textured, "points_moved")
