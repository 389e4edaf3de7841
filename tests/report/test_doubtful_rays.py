"""Points of three rays with one wrong: where the test blames another ray, the point is doubtful."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.quality.consistency import consistency_of
from sfm.adjustment.solve import adjust
from sfm.network import Estimate, Network
from sfm.pipeline import run_survey
from sfm.remarks.remark import of_kind
from sfm.report.findings.survey_remarks import findings_of
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

ERROR_SIGMA = 10.0


def _with_wrong_rays(name: str) -> tuple[Network, Estimate, dict[int, int]]:
    """A network of 60 points, twelve of three rays of which one is wrong; the wrong image point by point."""
    rng = seed_of(name)
    network, truth = make_network(rng, images=10, points=60, visibility=0.8, free=("c",))
    seen = network.image_points
    keep, wrong = np.ones(len(seen), dtype=bool), {}
    xy = seen.xy.copy()
    for j in range(12):
        rows = rng.permutation(np.flatnonzero(seen.point == j))
        keep[rows[3:]] = False
        angle = rng.uniform(0, 2 * np.pi)
        xy[rows[0]] += ERROR_SIGMA * 0.1 * np.array([np.cos(angle), np.sin(angle)])
        wrong[j] = int(rows[0])
    number = np.cumsum(keep) - 1
    moved = replace(seen, xy=xy).select(keep)
    return replace(network, image_points=moved), truth, {j: int(number[k]) for j, k in wrong.items()}


def _blame(networks: int) -> Counter[str]:
    """Count whom the test blames, and which of these points are reported as doubtful."""
    count: Counter[str] = Counter()
    for k in range(networks):
        network, truth, wrong = _with_wrong_rays(f"three rays {k}")
        a = adjust(network, truth, alpha=1 - 0.95 ** (0.5 / len(network.image_points)))
        told = {one.point for one in consistency_of(a).doubtful}
        for j, row in wrong.items():
            out = np.flatnonzero(a.rejected & (network.image_points.point == j))
            if not len(out):
                count["not found"] += 1
                continue
            who = "right" if out.tolist() == [row] else "wrong"
            count[f"{who}, {'doubtful' if network.points[j] in told else 'believed'}"] += 1
    print(dict(count))
    return count


def test_given_coordinates_are_not_doubtful() -> None:
    """Before, points of a plate were, whose rays show a wrong camera."""
    network, truth, _ = _with_wrong_rays("three rays 0")
    alpha = 1 - 0.95 ** (0.5 / len(network.image_points))
    assert consistency_of(adjust(network, truth, alpha=alpha)).doubtful
    given = network.with_control(network.points, truth.points)
    assert not consistency_of(adjust(given, truth, datum="control", alpha=alpha)).doubtful


def test_a_point_whose_wrong_ray_was_not_the_one_rejected_is_doubtful() -> None:
    count = _blame(6)
    assert count["wrong, doubtful"] >= 5
    assert count["wrong, believed"] == 0
    assert count["right, believed"] > 0


@pytest.mark.slow
def test_how_often_the_wrong_ray_is_blamed_and_believed() -> None:
    count = _blame(60)
    total = sum(count.values())
    assert count["wrong, believed"] < 0.005 * total


def test_doubtful_points_are_a_remark() -> None:
    network, truth, _ = _with_wrong_rays("three rays 1")
    verdict = findings_of(run_survey(survey_of(network, truth, adjust={"reject": "tau"}))).verdict
    assert of_kind(verdict.remarks, "points_doubtful")
