"""Validation over random networks: the networks, the verdicts, and both adjusters on some of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from adapters.colmap.adjuster import ColmapBackend, adjust_with_colmap
from benchmarks.random_networks import (
    ARRANGEMENTS,
    IMAGES,
    MIN_POINTS,
    NOISE_PX,
    SIZE_PX,
    random_network,
)
from benchmarks.validation import (
    WORSE,
    Validation,
    how_ended,
    make_trial,
    validate,
    write_table,
)
from sfm.comparison.solutions import reprojection
from sfm.model.errors import BackendError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from tests.tables import rows_of

NETWORKS = 60


@pytest.fixture(scope="module")
def drawn() -> list:
    return [random_network(np.random.default_rng([5, k])) for k in range(NETWORKS)]


def test_networks_are_of_every_kind_and_size(drawn: list) -> None:
    plans = [made.plan for made in drawn]
    assert {plan.arrangement for plan in plans} == set(ARRANGEMENTS)
    assert {plan.model for plan in plans} == {"opencv", "full_opencv"}
    assert {plan.datum for plan in plans} == {"free", "control"}
    assert {plan.interior for plan in plans} == {"fixed", "focal and principal point", "all"}
    assert {plan.planar for plan in plans} == {False, True}
    assert {plan.cameras for plan in plans} == {1, 2, 3}
    for made in drawn:
        assert IMAGES[0] <= made.plan.images <= IMAGES[1]
        assert NOISE_PX[0] <= made.plan.noise_px <= NOISE_PX[1]
        assert len(made.network.points) >= MIN_POINTS


def test_truth_fits_with_the_noise_and_the_start_does_not(drawn: list) -> None:
    for made in drawn:
        v = reprojection(made.network, made.truth)
        assert len(v) == len(made.network.image_points)
        # RMS of 2k normal deviates: within five of its standard deviations
        tolerance = 5 / np.sqrt(2 * v.size)
        assert np.sqrt((v**2).mean()) == pytest.approx(made.plan.noise_px, rel=tolerance)
        assert np.sqrt((reprojection(made.network, made.start) ** 2).mean()) > 3 * made.plan.noise_px
        xy = made.network.image_points.xy
        assert (xy > -6).all() and (xy < np.array(SIZE_PX) + 6).all()
        assert made.network.rays().min() >= 2
        assert np.bincount(made.network.image_points.image, minlength=made.plan.images).min() >= 4


def test_control_is_exact_at_truth_and_start(drawn: list) -> None:
    for made in drawn:
        control = made.network.control
        assert (len(control) == 0) == (made.plan.datum == "free")
        np.testing.assert_array_equal(made.truth.points[control.point], control.xyz)
        np.testing.assert_array_equal(made.start.points[control.point], control.xyz)


HUNDREDTH = 0.01**2 * 0.5**2 / 2  # what a difference of 0.01 standard deviations costs, 0.5 px each


@pytest.mark.parametrize(
    ("a", "b", "ours", "theirs", "ended", "is_worse"),
    [
        (1.0, 1.0, (), (), "same optimum", False),
        (1.0, 1.0, ("c",), (), "same optimum", False),
        (1.0, 1.0 + 0.9 * HUNDREDTH, (), (), "same optimum", False),
        (1.0, 1.0 + 1.1 * HUNDREDTH, (), (), "ours lower", False),
        (1.0 + 1.1 * HUNDREDTH, 1.0, (), (), "ours higher", True),
        (2.0, 1.0, ("c",), (), "ours failed", True),
        (np.nan, 1.0, (), (), "ours failed", True),
        (1.0, np.nan, (), ("stopped",), "the other failed", False),
        (1.0, np.nan, (), (), "the other failed", False),
        (np.nan, np.nan, ("c",), ("stopped",), "both failed", False),
    ],
)
def test_how_two_adjusters_end(
    a: float, b: float, ours: tuple[str, ...], theirs: tuple[str, ...], ended: str, is_worse: bool
) -> None:
    assert how_ended(a, b, 0.5, ours, theirs) == ended
    assert (ended in WORSE) == is_worse


def test_both_adjusters_end_at_the_same_optimum_with_the_same_covariances() -> None:
    found = validate(ColmapBackend(), networks=5, seed=2)
    assert found.passed
    assert found.counts() == {"same optimum": 5}
    for trial in found.trials:
        for name in ("position_sigmas", "rotation_sigmas", "point_sigmas"):
            assert getattr(trial, name) < 1e-3  # of a standard deviation
        free = trial.plan.interior != "fixed"
        assert trial.interior_sigmas < 1e-3 if free else np.isnan(trial.interior_sigmas)
        assert trial.conditional_difference < 1e-5
        assert not trial.interior_difference > 1e-5
        assert trial.rms_px[0] == pytest.approx(trial.rms_px[1], rel=1e-9)


@dataclass(frozen=True)
class Spoiled:
    """A backend that stops beside the optimum, refuses, or loses points."""

    kind: str
    name: str = "spoiled"

    def adjust(self, network: Network, start: Estimate, *, control: bool) -> object:
        if self.kind == "refuses":
            raise BackendError("out of order")
        found = adjust_with_colmap(network, start, gauge="control" if control else "free")
        points = found.estimate.points.copy()
        points[0] += {"beside": 1e-4, "lost": np.nan}[self.kind]
        return replace(found, estimate=replace(found.estimate, points=points))

    def covariance(self, network: Network, estimate: Estimate, *, control: bool) -> None:
        return None


@pytest.mark.parametrize(
    ("kind", "ended"),
    [
        ("beside", "ours lower"),
        ("refuses", "the other failed"),
        ("lost", "the other failed"),
    ],
)
def test_a_bad_backend_is_found_out(kind: str, ended: str) -> None:
    trial = make_trial(2, 1, Spoiled(kind))  # type: ignore[arg-type]
    assert trial.ended == ended
    assert trial.messages == (("out of order",) if kind == "refuses" else ())
    assert (trial.apart > 0.01) == (kind == "beside")


def test_a_worse_in_house_adjuster_fails_the_run(tmp_path: Path) -> None:
    trial = make_trial(2, 1, ColmapBackend())
    assert Validation("colmap", 1, (trial,)).passed
    worse = replace(trial, ended="ours higher", apart=0.02)
    found = Validation("colmap", 1, (trial, worse))
    assert not found.passed
    assert found.largest()["object coordinate, sigmas"] == trial.point_sigmas
    write_table(found, tmp_path / "out" / "table.csv")
    rows = rows_of(tmp_path / "out" / "table.csv")
    assert [row["ended"] for row in rows] == ["same optimum", "ours higher"]
    assert float(rows[0]["cost_ours"]) == trial.cost[0] and rows[0]["model"] == trial.plan.model


def test_processes_give_what_one_gives() -> None:
    one = validate(ColmapBackend(), networks=2, seed=4)
    two = validate(ColmapBackend(), networks=2, seed=4, jobs=2)
    assert [t.cost for t in one.trials] == [t.cost for t in two.trials]


@pytest.mark.slow
def test_two_hundred_networks() -> None:
    found = validate(ColmapBackend(), networks=200, seed=1, jobs=2)
    assert found.passed
    assert {trial.ended for trial in found.trials} <= {
        "same optimum", "the other failed", "both failed",
    }  # fmt: skip
