"""Points of texture whose residuals are together larger than chance are no points of the result."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.network import Estimate, Network
from sfm.survey.adjusting.solution import solve_survey
from sfm.survey.correspondences import Correspondences
from sfm.survey.inputs.settings import TiePointSettings
from sfm.survey.inputs.survey import Survey
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

WRONG = (5, 40, 90)  # points
NOISE_PX = 0.1


@pytest.fixture(scope="module")
def noisy() -> tuple[Network, Estimate]:
    """Return a network of which some points have errors of 2.5 sigma, too small for tests of single ones."""
    rng = seed_of("wrong windows")
    network, truth = make_network(rng, images=8, points=150, free=("c",), noise_px=NOISE_PX)
    seen, xy = network.image_points, network.image_points.xy.copy()
    wrong = np.isin(seen.point, WRONG)
    turn = rng.uniform(0.0, 2 * np.pi, wrong.sum())
    xy[wrong] += 2.5 * NOISE_PX * np.column_stack([np.cos(turn), np.sin(turn)])
    return replace(network, image_points=replace(seen, xy=xy)), truth


def texture(network: Network, truth: Estimate, reject: str) -> Survey:
    """Return a survey of texture that rejects gross errors, or does not."""
    survey = survey_of(network, truth)
    settings = survey.adjust.model_copy(update={"reject": reject})
    return replace(survey, tie_points=TiePointSettings(), adjust=settings)


def test_texture_loses_them_and_targets_are_named(noisy: tuple[Network, Estimate]) -> None:
    network, truth = noisy
    names = {network.points[j] for j in WRONG}
    survey, matched = texture(network, truth, "tau"), Correspondences(network, truth, np.full(150, 3))
    of_targets = solve_survey(replace(survey, tie_points=None), matched)
    assert set(of_targets.adjustment.network.points) == set(network.points)
    textured = solve_survey(survey, matched)
    assert set(network.points) - set(textured.adjustment.network.points) == names
    assert {one.point for one in textured.left_out} == names


def test_what_control_names_stays(noisy: tuple[Network, Estimate]) -> None:
    network, truth = noisy
    given = [*WRONG[:1], 10, 60, 120]
    network = network.with_control([network.points[j] for j in given], truth.points[given], 1.0)
    found = solve_survey(texture(network, truth, "tau"), Correspondences(network, truth, np.full(150, 3)))
    left = set(network.points) - set(found.adjustment.network.points)
    assert left == {network.points[j] for j in WRONG[1:]}


def test_a_survey_that_rejects_nothing_loses_nothing(noisy: tuple[Network, Estimate]) -> None:
    network, truth = noisy
    found = solve_survey(texture(network, truth, "none"), Correspondences(network, truth, np.full(150, 3)))
    assert set(found.adjustment.network.points) == set(network.points)
