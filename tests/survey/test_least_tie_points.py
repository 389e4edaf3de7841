"""A photograph that few matches of texture hold is left out: those of a pattern are wrong together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.remarks.remark import remark
from sfm.survey.adjusting.solution import solve_survey
from sfm.survey.correspondences import Correspondences
from sfm.survey.inputs.settings import TiePointSettings
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of


@pytest.mark.parametrize(("left", "stays"), [(9, False), (30, True)])
def test_a_photograph_needs_more_tie_points_than_it_would_need_targets(left: int, stays: bool) -> None:
    network, truth = make_network(seed_of("few tie points"), images=10, points=60, free=("c",))
    seen = network.image_points
    last = np.flatnonzero(seen.image == 9)
    keep = np.ones(len(seen), dtype=bool)
    keep[last[left:]] = False
    network = replace(network, image_points=seen.select(keep))
    survey = survey_of(network, truth)
    matched = Correspondences(network, truth, np.full(len(network.points), 3))
    of_targets = solve_survey(survey, matched)
    assert len(of_targets.adjustment.network.images) == 10
    textured = replace(survey, tie_points=TiePointSettings())
    found = solve_survey(textured, matched)
    assert len(found.adjustment.network.images) == (10 if stays else 9)
    told = [("image 10", remark("photograph_with_few_accepted", needed=15))]
    assert list(found.dropped_images) == ([] if stays else told)


def test_points_that_leave_with_a_photograph_are_reported_so() -> None:
    """All their rays are accepted, and one is of a photograph that is not in the result."""
    network, truth = make_network(seed_of("leave with it"), images=10, points=60, free=("c",))
    seen = network.image_points
    few = seen.point < 9
    keep = np.where(seen.image == 9, few, ~few | (seen.image < 2))
    network = replace(network, image_points=seen.select(keep))
    survey = replace(survey_of(network, truth), tie_points=TiePointSettings())
    found = solve_survey(survey, Correspondences(network, truth, np.full(len(network.points), 3)))
    reasons = {(one.reason.kind, one.reason.number("needed")) for one in found.left_out}
    assert reasons == {("point_of_lost_photographs", 3)}
