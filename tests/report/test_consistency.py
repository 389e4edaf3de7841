"""Tests inside a result: photographs of other noise, and no false alarms in clean networks."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.quality import consistency
from sfm.adjustment.quality.consistency import consistency_of
from sfm.adjustment.quality.variance_components import VarianceComponents
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.judgement.hypotheses.hypotheses import judge_alternatives
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import of_kind
from sfm.pipeline import run_survey
from tests.findings import findings_of
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of


def _solved(network: Network, truth: Estimate, reject: str) -> Adjustment:
    alpha = 1 - (1 - 0.05) ** (1 / (2 * len(network.image_points)))
    return adjust(network, truth, reject=reject, options=AdjustmentOptions(alpha=alpha))


def test_photographs_of_other_noise_are_reported() -> None:
    rng = seed_of("blurred")
    network, truth = make_network(rng, images=12, points=50, free=("c",))
    seen = network.image_points
    own = seen.image == 4
    xy = seen.xy + 0.3 * own[:, None] * rng.standard_normal((len(seen), 2))
    found = consistency_of(_solved(replace(network, image_points=replace(seen, xy=xy)), truth, "none")).uneven
    assert found is not None and found.worst == "image 5" and found.largest > 2 * found.median


def _components(largest: float, redundancy: float) -> VarianceComponents:
    """Return those of eight photographs, one of which has a larger one."""
    names, r = tuple("abcdefgh"), np.full(8, redundancy)
    return VarianceComponents(names, np.array([1.0] * 7 + [largest]), r, r.astype(int))


def test_photographs_are_uneven_from_half_as_large_again() -> None:
    assert consistency._uneven(_components(1.4, 1e4), 0.01) is None
    found = consistency._uneven(_components(1.6, 1e4), 0.01)
    assert found is not None and (found.worst, found.largest, found.median) == ("h", 1.6, 1.0)
    every = [consistency._uneven(_components(1.6, r), 0.01) for r in np.arange(2, 100, 0.5)]
    assert 0.008 < max(one.probability for one in every if one is not None) <= 0.01


def _false_alarms(runs: int) -> Counter[str]:
    count: Counter[str] = Counter()
    for k in range(runs):
        rng = seed_of(f"clean {k}")
        network, truth = make_network(
            rng,
            images=int(rng.integers(5, 25)),
            points=int(rng.integers(15, 80)),
            planar=bool(k % 2),
            visibility=float(rng.uniform(0.4, 1)),
            noise_px=float(rng.choice([0.03, 0.1, 0.5])),
            free=("c", "x0", "y0", "K1") if k % 3 else (),
        )
        a = _solved(network, truth, "tau" if k % 2 else "none")
        found = consistency_of(a)
        count["cause"] += bool(judge_alternatives(a).causes)
        count["large"] += bool(found.large)
        count["uneven"] += found.uneven is not None
    return count


def test_points_of_residuals_too_large_together_are_named() -> None:
    rng = seed_of("one rough point")
    network, truth = make_network(rng, images=12, points=50, free=("c",))
    seen = network.image_points
    rough = (seen.point == 7)[:, None] * 0.25 * rng.standard_normal((len(seen), 2))
    a = _solved(replace(network, image_points=replace(seen, xy=seen.xy + rough)), truth, "none")
    assert consistency_of(a).large == (network.points[7],)


def test_clean_networks_raise_no_alarm() -> None:
    assert max(_false_alarms(6).values()) <= 1  # each test speaks once in 100


@pytest.mark.slow
def test_false_alarms_keep_to_their_level() -> None:
    assert max(_false_alarms(300).values()) <= 9  # 3 expected at 1 %; 10 once in 1000


def test_a_point_with_half_of_its_rays_rejected_is_named() -> None:
    network, truth = make_network(seed_of("third"), images=6, points=30, free=("c",))
    seen = network.image_points
    rows = np.flatnonzero(seen.point == 4)[:3]
    xy = seen.xy.copy()
    xy[rows[0]] += (9.0, 0.0)
    xy[rows[1]] += (0.0, -14.0)
    xy[rows[2]] += (-11.0, 0.0)
    spoiled = replace(network, image_points=replace(seen, xy=xy))
    verdict = findings_of(run_survey(survey_of(spoiled, truth, adjust={"reject": "tau"}))).verdict
    (found,) = of_kind(verdict.tests, "rays_tested")
    assert found.names("points") == (network.points[4],)


@pytest.mark.parametrize("number", [0, 1, 4])
def test_image_points_without_noise_are_a_good_survey(number: int) -> None:
    """Residuals of 1e-13 px are rounding, whose distribution says nothing."""
    network, truth = make_network(
        seed_of(f"nf{number}"),
        images=8 + number,
        points=40,
        noise_px=0.0,
        visibility=0.8,
        free=("c", "x0", "y0"),
    )
    result = run_survey(survey_of(network, truth, free=("c", "x0", "y0"), adjust={"reject": "tau"}))
    assert result.adjustment.is_exact and result.adjustment.sigma0 > 0
    verdict = findings_of(result).verdict
    assert verdict.level == "good"
    assert {one.kind for one in verdict.remarks} == {"scale_undefined"}
    assert {"image_sigma_tested", "handedness_unchecked"} <= {one.kind for one in verdict.tests}


def test_residuals_are_rounding_up_to_a_billionth_of_the_coordinates() -> None:
    network, truth = make_network(seed_of("exact"), images=6, points=20, noise_px=0.0, free=("c",))
    a = adjust(network, truth, reject="none")
    limit = 1e-9 * float(np.abs(network.image_points.xy).max())
    for factor, exact in ((0.6, True), (1.6, False)):
        assert replace(a, residuals=np.full_like(a.residuals, factor * limit)).is_exact == exact


def test_a_point_moves_by_the_difference_of_two_choices_of_its_rays() -> None:
    rng = seed_of("moved")
    A = rng.normal(size=(4, 2, 3))
    v = rng.normal(size=(4, 2))
    parts = consistency.PointNormals(
        np.einsum("kia,kib->kab", A, A), np.einsum("kia,ki->ka", A, v), (v**2).sum(axis=1)
    )
    kept, other = np.array([0, 1, 2]), np.array([0, 1, 3])
    steps = [np.linalg.lstsq(A[k].reshape(-1, 3), v[k].ravel(), rcond=None)[0] for k in (kept, other)]
    expected = np.linalg.norm(A[kept].reshape(-1, 3) @ (steps[1] - steps[0]))
    assert consistency._moved(parts, kept, other) == pytest.approx(expected)
    assert consistency._moved(parts, kept, kept) == 0
