"""Given observations are adjusted as they are; what cannot be used is counted and named everywhere."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.network import Estimate, Network
from sfm.pipeline import run_survey
from sfm.remarks.remark import of_kind
from sfm.report.findings.survey_remarks import findings_of
from sfm.report.output import write_result
from sfm.result import SurveyResult
from sfm.similarity import fit_similarity
from sfm.survey.adjusting.settling import datum_carriers
from tests.surveys import survey_of
from tests.synthetic import add_narrow_points, make_network, seed_of


@pytest.mark.parametrize("given", [False, True])
def test_two_ray_points_at_small_angles_take_part_with_their_true_sigma(given: bool) -> None:
    rng = seed_of("narrow")
    network, truth = add_narrow_points(*make_network(rng, images=8, points=60), rng, 12)
    result = run_survey(survey_of(network, truth, start=truth if given else None))
    assert set(result.network.points) == set(network.points)
    assert result.left_out == () and result.unused_image_points == 0
    assert len(result.network.image_points) == len(network.image_points)
    normalised = _normalised_errors(result, network, truth)
    narrow = np.array([name.startswith("w") for name in result.network.points])
    sigma = np.sqrt(np.trace(result.adjustment.covariance.points, axis1=1, axis2=2))
    assert sigma[narrow].min() > 5 * np.median(sigma[~narrow])
    for rows in (narrow, ~narrow):  # mean square 1 within three standard deviations of it
        assert np.mean(normalised[rows] ** 2) == pytest.approx(1, abs=3 * np.sqrt(2 / (3 * rows.sum())))
    assert result.adjustment.datum_points is not None  # they do not carry the datum
    assert not result.adjustment.datum_points[narrow].any()


def _normalised_errors(result: SurveyResult, network: Network, truth: Estimate) -> np.ndarray:
    """Errors of coordinates over their standard deviations after a fit on the well-determined points."""
    index = [network.point_index(name) for name in result.network.points]
    good = np.array([not name.startswith("w") for name in result.network.points])
    placing = fit_similarity(result.estimate.points[good], truth.points[index][good])
    error = placing.apply(result.estimate.points) - truth.points[index]
    variance = np.einsum(
        "ab,nbc,dc->nad", placing.rotation, result.adjustment.covariance.points, placing.rotation
    )
    return np.asarray(error / np.sqrt(np.diagonal(variance, axis1=1, axis2=2)) / placing.scale)


def _with_contradicting_points(name: str) -> tuple[Network, Estimate, list[str]]:
    """A network of which eight three-ray points have two wrong rays each, and two two-ray points miss."""
    rng = seed_of(name)
    network, truth = make_network(rng, images=10, points=80, visibility=0.3)
    seen, rays = network.image_points, network.rays()
    xy, keep = seen.xy.copy(), np.ones(len(seen), dtype=bool)
    wrong = np.flatnonzero(rays == 3)[:10]
    for number, j in enumerate(wrong):
        own = np.flatnonzero(seen.point == j)
        xy[own[:2]] += rng.choice([-1, 1], (2, 2)) * rng.uniform(20, 120, (2, 2))
        keep[own[2]] = number < 8
    points = replace(seen, xy=xy).select(keep)
    return replace(network, image_points=points), truth, [network.points[j] for j in wrong]


def test_rays_that_do_not_meet_are_adjusted_as_they_are() -> None:
    network, truth, wrong = _with_contradicting_points("vanish")
    result = run_survey(survey_of(network, truth, adjust={"reject": "none"}))
    assert set(wrong) <= set(result.network.points)
    assert len(result.adjustment.rejected) == len(network.image_points) and result.left_out == ()
    assert findings_of(result).verdict.level == "bad"  # and their residuals say so


def test_what_is_left_out_is_counted_and_named_everywhere(tmp_path: Path) -> None:
    network, truth, wrong = _with_contradicting_points("vanish")
    result = run_survey(survey_of(network, truth, adjust={"reject": "tau"}))
    left = {one.point: one for one in result.left_out}
    assert left and set(left) <= set(wrong)
    assert set(result.network.points) | set(left) == set(network.points)
    assert len(result.adjustment.rejected) + result.unused_image_points == len(network.image_points)
    assert all(one.reason.kind == "point_with_rays_rejected" for one in left.values())
    findings = findings_of(result)
    (lost,) = of_kind(result.remarks, "points_contradicted")
    assert set(lost.names("points")) == set(left) and lost.number("measured") == 80
    folder = tmp_path / "out"
    write_result(findings, folder)
    stored = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert stored["observations"]["not_in_result"] == result.unused_image_points
    assert {one["point"] for one in stored["left_out"]} == set(left)
    with (folder / "left_out.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["name"] for row in rows} == set(left)
    assert sum(int(row["image_points"]) for row in rows) == result.unused_image_points
    counts = f"{result.unused_image_points} not in the result (of {len(left)} points)"
    for name in ("report.txt", "report.html"):
        page = (folder / name).read_text(encoding="utf-8")
        assert "not in the result" in page and all(one.reason.text in page for one in left.values()), name
    assert counts in (folder / "report.txt").read_text(encoding="utf-8")


def test_rays_parallel_within_their_precision_are_named() -> None:
    rng = seed_of("parallel")
    network, truth = add_narrow_points(*make_network(rng, images=8, points=60), rng, 3, noise_px=0.1)
    # the same direction in both photographs: points at infinity
    seen = network.image_points
    xy = seen.xy.copy()
    for j in range(60, 63):
        first, second = np.flatnonzero(seen.point == j)
        xy[second] = xy[first] + 0.05 * rng.standard_normal(2)
    network = replace(network, image_points=replace(seen, xy=xy))
    result = run_survey(survey_of(network, truth, adjust={"reject": "none"}))
    assert result.adjustment.converged and len(result.network.points) == 60
    assert {one.point for one in result.left_out} == {"w1", "w2", "w3"}
    for one in result.left_out:
        assert one.reason.kind in ("point_with_parallel_rays", "point_with_rays_apart")


def test_carriers_of_a_datum_are_those_whose_rays_meet_clearly() -> None:
    carriers = datum_carriers(np.array([50.0, 1.0, 30.0, np.nan]), 2.0)
    assert carriers is not None and carriers.tolist() == [True, False, True, True]
    assert datum_carriers(np.array([50.0, 40.0]), 2.0) is None
    assert datum_carriers(np.array([0.5, 0.4, 1.0, 50.0]), 2.0) is None  # all that there is
