"""Numbers by which given values are judged: each test fails where one of them is twice or half as large."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.pipeline import run_survey
from sfm.remarks.remark import kinds_of
from sfm.survey.hypotheses import given
from sfm.survey.inputs.given import KnownPoints, ScaleBar
from tests.surveys import remarks_on_given, survey_of
from tests.synthetic import make_network, observed_anew, seed_of


@pytest.mark.parametrize(
    ("factor", "unit"), [(1015.0, 1000.0), (1 / 985.0, 1000.0), (1030.0, None), (25.0, 25.4), (11.0, None)]
)
def test_a_factor_is_that_of_a_unit_within_two_percent(factor: float, unit: float | None) -> None:
    assert given._unit_factor(float(np.log(factor))) == unit


def test_units_of_length() -> None:
    mm = {"mm": 1.0, "cm": 10.0, "inch": 25.4, "foot": 304.8, "m": 1000.0}
    apart = {max(a, b) / min(a, b) for a in mm.values() for b in mm.values() if a != b}
    assert set(given.UNIT_FACTORS) <= {round(one, 6) for one in apart}


@pytest.mark.parametrize(("off", "contradicted"), [(0.006, False), (0.01, True)])
def test_a_print_may_be_half_a_percent_larger_than_stated(off: float, contradicted: bool) -> None:
    """Of coordinates without standard deviations, whose scale is known to 0.2 %: beyond 3.8 times that."""
    network, truth = make_network(seed_of("print"), images=8, points=30)
    control = KnownPoints.from_arrays([str(k + 1) for k in range(8)], (1 + off) * truth.points[:8])
    bar = ScaleBar("9", "20", float(np.linalg.norm(truth.points[8] - truth.points[19])), 1e-4)
    result = run_survey(survey_of(network, truth, control=control, scale_bars=(bar,), datum={"kind": "free"}))
    assert ("scale_contradicted" in kinds_of(remarks_on_given(result))) == contradicted


def test_the_joint_covariance_of_what_is_judged_takes_72_megabytes() -> None:
    assert 50e6 < 8 * (3 * given.MAX_PLACES) ** 2 < 100e6


def test_of_many_points_some_are_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(given, "MAX_PLACES", 10)
    network, truth = make_network(seed_of("many given"), images=8, points=30)
    control = KnownPoints.from_arrays([str(k + 1) for k in range(30)], truth.points, 1e-3)
    result = run_survey(survey_of(network, truth, control=control, datum={"kind": "control"}))
    assert result.given_tests[0].dof == 3 * 10 - 7


def test_image_points_are_no_better_than_a_ten_thousandth_of_their_standard_deviation() -> None:
    network, truth = make_network(seed_of("no noise"), images=8, points=30)
    network = observed_anew(network, truth, 0.0, seed_of("no noise"))
    length = float(np.linalg.norm(truth.points[8] - truth.points[19]))
    result = run_survey(survey_of(network, truth, scale_bars=(ScaleBar("9", "20", length, 1e-4),)))
    stated = np.sqrt(network.image_points.covariance[0, 0, 0])
    used = np.sqrt(result.adjustment.image_covariance[0, 0, 0])
    assert used / stated == pytest.approx(1e-4, rel=0.4)
