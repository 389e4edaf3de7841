"""The solution of a survey: what control, scale bars and the other adjuster do to it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.errors import BackendError
from sfm.network import Estimate, Network, ObjectPoints, ScaleBars
from sfm.pipeline import adjust_survey
from sfm.project import read_survey
from sfm.survey.comparison import OtherPrograms
from sfm.survey.datum import object_scale, without_contradicted_control
from tests.surveys import write_observed_survey
from tests.synthetic import make_network, seed_of


def test_a_failing_comparison_leaves_the_survey(tmp_path: Path) -> None:
    def refuse(network: Network, estimate: Estimate) -> object:
        raise BackendError("COLMAP is not installed")

    survey = read_survey(write_observed_survey(tmp_path / "alone", "alone"))
    result = adjust_survey(survey, others=OtherPrograms(refuse))  # type: ignore[arg-type]
    assert result.comparison is None
    assert result.adjustment.converged
    assert "the comparison with the other adjuster failed: COLMAP is not installed" in result.warnings


@pytest.mark.parametrize("wrong", [False, True])
def test_control_that_its_own_rays_contradict_is_named(wrong: bool) -> None:
    rng = seed_of("contradicted control")
    network, truth = make_network(rng, images=8, points=30, noise_px=0.1)
    rows = np.arange(6)
    xyz = truth.points[rows].copy()
    if wrong:
        xyz[2, 0] += 0.05
    network = replace(network, control=ObjectPoints(rows, xyz, np.zeros((6, 3, 3))))
    start = replace(truth, points=truth.points.copy())
    start.points[rows] = xyz
    adjustment = adjust(network, start, datum=Datum("control"), sigma_px=0.1, reject="tau", alpha=1e-4)
    left, line = without_contradicted_control(network, adjustment)
    if not wrong:
        assert left is None
        return
    assert left is not None
    assert network.points[2] in line
    assert list(left.control.point) == [0, 1, 3, 4, 5]


def test_scale_comes_from_bars_before_control_and_two_control_points_are_enough() -> None:
    rng = seed_of("scale")
    network, truth = make_network(rng, images=4, points=10)
    half = replace(truth, points=truth.points / 2)
    two = ObjectPoints(np.array([0, 1]), truth.points[:2], np.zeros((2, 3, 3)))
    assert object_scale(replace(network, control=two), half) == pytest.approx(2.0)
    length = np.linalg.norm(truth.points[3] - truth.points[2])
    bar = ScaleBars(np.array([2]), np.array([3]), np.array([3 * length]), np.array([1e-3]))
    assert object_scale(replace(network, control=two, scale_bars=bar), half) == pytest.approx(6.0)
    assert np.isnan(object_scale(network, half))
