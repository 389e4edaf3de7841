"""Verdicts: what `sfm.adjust` and `run_survey` return states what the image points show of it."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

import sfm
from sfm.adjustment.result import Adjustment
from sfm.errors import KolinearError
from sfm.judgement.verdict import judge_survey
from sfm.network import Estimate, Network
from sfm.remarks.remark import kinds_of, remark
from sfm.remarks.verdict import Verdict
from sfm.result import FailedImage, SurveyResult
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def made() -> tuple[Network, Estimate]:
    return make_network(seed_of("verdicts"), images=6, points=30, noise_px=0.1)


def verdict_of(adjustment: Adjustment) -> Verdict:
    assert adjustment.verdict is not None
    return adjustment.verdict


def with_gross_errors(network: Network) -> Network:
    """Return the network with twelve image points that are off by 30 px."""
    xy = network.image_points.xy.copy()
    xy[::15] += 30.0
    return replace(network, image_points=replace(network.image_points, xy=xy))


def test_a_good_adjustment_is_good_and_says_what_was_adjusted(made: tuple[Network, Estimate]) -> None:
    adjustment = sfm.adjust(*made)
    verdict = verdict_of(adjustment)
    assert verdict.level == "good" and "6 of 6 photographs, 30 object points" in verdict.headline
    assert verdict.headline in repr(adjustment) and adjustment.solution.verdict == verdict
    assert pickle.loads(pickle.dumps(sfm.adjust)) is sfm.adjust
    assert verdict_of(pickle.loads(pickle.dumps(adjustment))) == verdict


def test_photographs_without_start_values_are_missing(made: tuple[Network, Estimate]) -> None:
    network, truth = made
    position = truth.position.copy()
    position[0] = np.nan
    verdict = verdict_of(sfm.adjust(network, replace(truth, position=position)))
    (missing,) = [one for one in verdict.remarks if one.kind == "photographs_missing"]
    assert verdict.level == "fair" and "5 of 6 photographs" in verdict.headline
    assert missing.number("missing") == 1
    assert not {"image_points_rejected", "rays_tested"} & set(kinds_of(verdict.remarks))


@pytest.mark.parametrize(("reject", "kept"), [("none", True), ("huber", False), ("tau", False)])
def test_gross_errors_are_said_where_nothing_acts_on_them(
    reject: str, kept: bool, made: tuple[Network, Estimate]
) -> None:
    network, truth = made
    kinds = kinds_of(verdict_of(sfm.adjust(with_gross_errors(network), truth, reject=reject)).remarks)
    assert ("gross_errors_kept" in kinds) == kept


def test_a_rank_defect_is_bad(made: tuple[Network, Estimate]) -> None:
    network, truth = made
    single = np.isin(network.image_points.image, (0, 1))  # two photographs do not determine six parameters
    part = replace(network, image_points=network.image_points.select(single))
    try:
        adjustment = sfm.adjust(part, truth)
    except KolinearError:
        return
    assert verdict_of(adjustment).level == "bad"


@pytest.mark.parametrize(("unreadable", "level"), [(1, "fair"), (9, "fair"), (0, "good")])
def test_files_that_cannot_be_read_are_no_missing_photographs(
    unreadable: int, level: str, made: tuple[Network, Estimate]
) -> None:
    """They made right results bad: half of a folder may be files of another kind."""
    reason = remark("photographs_unreadable", reason="not a photograph")
    failed = tuple(FailedImage(f"{k}.jpg", reason) for k in range(unreadable))
    adjustment = sfm.adjust(*made)
    result = SurveyResult("s", "m", 6 + unreadable, failed, adjustment, np.full(30, -1), None)
    verdict = judge_survey(result).verdict
    kinds = kinds_of(verdict.remarks)
    assert verdict.level == level and "photographs_missing" not in kinds
    assert ("photographs_unreadable" in kinds) == (unreadable > 0)
