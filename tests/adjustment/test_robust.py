"""Gross errors: found, good observations kept, false alarms as often as alpha says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.collinearity import residuals
from sfm.adjustment.engine.iterate import Optimum
from sfm.adjustment.engine.unknowns import unknowns_of
from sfm.adjustment.quality.gross_errors import rejection
from sfm.adjustment.quality.gross_errors.robust import (
    HUBER,
    TUKEY,
    huber_slopes,
    huber_weights,
    robust_scale,
    tukey_slopes,
    tukey_weights,
)
from sfm.adjustment.quality.statistics import tau_critical
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import fit_similarity
from tests.synthetic import make_network, seed_of

FREE = Datum("free")


def spoiled(rng: np.random.Generator, part: float, sigmas: float) -> tuple[Network, Estimate, BoolArray]:
    """A network with gross errors of a given size in random directions in part of its image points."""
    network, truth = make_network(rng, images=10, points=40, noise_px=0.1)
    k = network.image_points
    bad = rng.random(len(k)) < part
    angle = rng.uniform(0, 2 * np.pi, len(k))
    error = 0.1 * sigmas * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return replace(network, image_points=replace(k, xy=k.xy + error * bad[:, None])), truth, bad


@pytest.mark.parametrize("sigmas", [10.0, 200.0])
def test_data_snooping_finds_gross_errors_and_keeps_the_rest(sigmas: float) -> None:
    network, truth, bad = spoiled(seed_of(f"snoop {sigmas}"), 0.05, sigmas)
    a = adjust(network, truth, datum=FREE)
    assert a.converged
    assert np.nanmean(a.redundancy_numbers) > 0.6
    assert (a.rejected & bad).sum() >= 0.99 * bad.sum()
    # 2 coordinates tested at 0.001, known good ones: binomial mean 0.8, so 5 would be a chance of 1e-3
    assert (a.rejected & ~bad).sum() <= 5
    assert a.sigma0 == pytest.approx(1, abs=4 / np.sqrt(2 * a.redundancy))


def test_a_good_network_keeps_nearly_all() -> None:
    network, truth, _ = spoiled(seed_of("good"), 0.0, 0.0)
    a = adjust(network, truth, datum=FREE, options=AdjustmentOptions(alpha=0.01))
    expected = 2 * 0.01 * len(network.image_points)
    assert abs(a.rejected.sum() - expected) < 4 * np.sqrt(expected) + 2


def test_huber_limits_the_harm_of_gross_errors() -> None:
    network, truth, bad = spoiled(seed_of("huber"), 0.05, 100.0)
    plain = adjust(network, truth, datum=FREE, reject="none")
    robust = adjust(network, truth, datum=FREE, reject="huber")
    good = ~bad
    assert (plain.residuals[good] ** 2).mean() > 4 * (robust.residuals[good] ** 2).mean()


@pytest.mark.parametrize("reject", ["huber", "tukey"])
def test_a_photograph_that_nothing_holds_is_reported(reject: str) -> None:
    """It converges wherever the photograph is; one was 1e140 mm away."""
    rng = seed_of("let go")
    network, truth = make_network(rng, images=8, points=30)
    k = network.image_points
    other = k.image == 3
    xy = np.where(other[:, None], rng.uniform(0, 3000, k.xy.shape), k.xy)  # of another object
    lost = adjust(replace(network, image_points=replace(k, xy=xy)), truth, datum=FREE, reject=reject)
    name = network.images[3]
    assert kinds_of(lost.remarks) == ("photograph_without_weight",)
    assert lost.remarks[0].names("photographs") == (name,)
    assert adjust(network, truth, datum=FREE, reject=reject).remarks == ()


def one_sided(name: str, part: float) -> tuple[Network, Estimate, BoolArray]:
    """Gross errors of 20 to 200 sigma that all point about the same way, so that they do not average out."""
    rng = seed_of(name)
    network, truth = make_network(rng, images=12, points=40)
    k = network.image_points
    bad = rng.random(len(k)) < part
    angle = rng.normal(0.5, 0.3, len(k))
    error = rng.uniform(2, 20, len(k))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return replace(network, image_points=replace(k, xy=k.xy + error * bad[:, None])), truth, bad


def point_error(a: Adjustment, truth: Estimate) -> float:
    """Root mean square error of a coordinate of an object point."""
    placed = fit_similarity(a.estimate.points, truth.points).apply_estimate(a.estimate)
    return float(np.sqrt(((placed.points - truth.points) ** 2).mean()))


def test_tukey_rejects_a_third_of_gross_errors_where_huber_has_broken_down() -> None:
    network, truth, bad = one_sided("breakdown", 0.3)
    k = network.image_points
    clean, _ = make_network(seed_of("breakdown"), images=12, points=40)
    best = point_error(adjust(clean, truth, datum=FREE, reject="none"), truth)
    tukey = adjust(network, truth, datum=FREE, reject="tukey")
    huber = adjust(network, truth, datum=FREE, reject="huber")
    assert tukey.converged
    assert (tukey.rejected == (tukey.weights == 0)).all()
    assert tukey.rejected[bad].all()
    assert tukey.rejected[~bad].mean() < 0.01  # a normal vector is beyond 5 sigma once in 10^5
    assert tukey.observations == 2 * int((~tukey.rejected).sum())
    # with 0.7 of the image points, errors are 1.2 times as large; huber's are systematic
    assert point_error(tukey, truth) < 2 * best
    assert point_error(huber, truth) > 5 * best
    assert len(k) > 300


def test_tukey_agrees_with_least_squares_where_nothing_is_wrong() -> None:
    network, truth, _ = spoiled(seed_of("nothing wrong"), 0.0, 0.0)
    plain = adjust(network, truth, datum=FREE, reject="none")
    tukey = adjust(network, truth, datum=FREE, reject="tukey")
    assert tukey.rejected.sum() <= 1
    assert tukey.weights.max() <= 1 and tukey.weights[~tukey.rejected].min() > 0
    assert point_error(tukey, truth) < 1.2 * point_error(plain, truth)  # 95 % efficient


def scatter_over_predicted(reject: str, part: float, copies: int) -> tuple[dict[str, FloatArray], float]:
    """Empirical over predicted standard deviation of each unknown over noisy copies of one network.

    A part of the image points has gross errors of 10 to 50 sigma in random directions. Also returned is the
    mean factor by which the predicted ones are those of reweighted least squares.
    """
    rng = seed_of(f"estimator {part}")
    network, truth = make_network(rng, images=12, points=40, noise_px=0.0, visibility=0.8)
    k = network.image_points
    exact = adjust(network, truth, datum=FREE, reject="none").estimate
    free = exact.cameras[0].free
    errors: dict[str, list[FloatArray]] = {"points": [], "centres": [], "interior": []}
    variances: dict[str, list[FloatArray]] = {"points": [], "centres": [], "interior": []}
    inflated = []
    for _ in range(copies):
        angle = rng.uniform(0, 2 * np.pi, len(k))
        size = 0.1 * rng.uniform(10, 50, len(k)) * (rng.random(len(k)) < part)
        gross = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        noisy = replace(k, xy=k.xy + rng.normal(0, 0.1, k.xy.shape) + gross)
        a = adjust(replace(network, image_points=noisy), truth, datum=FREE, reject=reject)
        back = fit_similarity(a.estimate.points, exact.points).apply_estimate(a.estimate)
        errors["points"].append((back.points - exact.points).ravel())
        errors["centres"].append((back.position - exact.position).ravel())
        errors["interior"].append((a.estimate.cameras[0].parameters - exact.cameras[0].parameters)[free])
        variances["points"].append(np.einsum("nii->ni", a.covariance.points).ravel())
        variances["centres"].append(np.einsum("nii->ni", a.covariance.exterior[:, :3, :3]).ravel())
        variances["interior"].append(np.diagonal(a.covariance.interior[0]))
        inflated.append(a.inflation)
    ratio = {
        kind: np.sqrt(np.square(found).mean(axis=0) / np.mean(variances[kind], axis=0))
        for kind, found in errors.items()
    }
    return ratio, float(np.mean(inflated))


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize("reject", ["huber", "tukey"])
@pytest.mark.parametrize("part", [0.0, 0.05])
def test_standard_deviations_of_m_estimators_are_those_of_their_errors(reject: str, part: float) -> None:
    """A short form of the study: 30 copies of 120 coordinates, a sampling error of about 2 %."""
    ratio, inflated = scatter_over_predicted(reject, part, 30)
    assert rms(ratio["points"]) == pytest.approx(1, abs=0.06)
    assert abs(rms(ratio["points"]) * inflated - 1) > 0.07  # reweighted least squares would claim that


def rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def test_slopes_of_both_estimators_are_the_derivatives_of_psi() -> None:
    size = np.array([0.3, 1.2, 1.7, 3.0, 4.9])
    network, truth = make_network(seed_of("slopes"), images=4, points=10)
    layout, _ = unknowns_of(network, truth, use_control=False)
    obs = layout.observations
    for weights, slopes in ((huber_weights, huber_slopes), (tukey_weights, tukey_slopes)):

        def psi(v: FloatArray, weights=weights) -> FloatArray:  # type: ignore[no-untyped-def]
            padded = np.zeros((len(obs.image), 2))
            padded[: len(v)] = 0.1 * v  # px
            return weights(obs, padded, sigma0=1.0)[: len(v), None] * v

        v = size[:, None] * [0.6, 0.8]
        found = slopes(np.linalg.norm(psi(v), axis=1) / size)
        for column, direction in enumerate(([0.6, 0.8], [-0.8, 0.6])):
            step = 1e-6 * np.array(direction)
            derivative = (psi(v + step) - psi(v - step)) / 2e-6 @ direction
            assert found[:, column] == pytest.approx(derivative, abs=1e-6)


def test_without_outliers_or_with_least_squares_nothing_is_inflated() -> None:
    network, truth = make_network(seed_of("inflated"), images=6, points=20)
    for reject in ("none", "tau"):
        a = adjust(network, truth, datum=FREE, reject=reject)
        assert a.inflation == 1.0 and not a.reweighted
    a = adjust(network, truth, datum=FREE, reject="huber")
    v = a.residuals / 0.1
    assert a.vPv == pytest.approx(float(a.weights @ (v**2).sum(axis=1)), rel=1e-9)
    assert a.reweighted and 1.0 < a.inflation < 1.3


def test_weights_of_both_estimators() -> None:
    network, truth = make_network(seed_of("weights"), images=4, points=10)
    layout, state = unknowns_of(network, truth, use_control=False)
    v = np.zeros((len(network.image_points), 2))
    v[:5, 0] = 0.1 * np.array([0.5 * HUBER, 2 * HUBER, TUKEY / 2, 0.999 * TUKEY, 1.001 * TUKEY])
    v[5] = np.nan  # behind its camera
    huber = huber_weights(layout.observations, v, sigma0=1.0)
    tukey = tukey_weights(layout.observations, v, sigma0=1.0)
    assert huber[:2] == pytest.approx([1.0, 0.5])
    assert tukey[[2, 4, 5, 6]] == pytest.approx([0.5625, 0.0, 0.0, 1.0])
    assert 0 < tukey[3] < 1e-5 and huber[5] == 0
    noise = residuals(layout.observations, state)
    used = np.ones(len(v), dtype=bool)
    assert robust_scale(layout.observations, noise, used, freedom=1.0) == pytest.approx(
        1, abs=4 * 1.17 / np.sqrt(2 * 40)
    )


def test_tau_is_bounded_by_the_root_of_the_redundancy() -> None:
    assert tau_critical(0.001, 10_000) == pytest.approx(3.2905, abs=2e-3)  # normal for large redundancy
    assert tau_critical(1e-12, 5) < np.sqrt(5)
    assert tau_critical(0.05, 1) == np.inf


def test_a_point_behind_its_camera_at_the_start_comes_back() -> None:
    network, truth = make_network(seed_of("behind"), images=8, points=25)
    points = truth.points.copy()
    points[7] = truth.position[2] * 1.05
    a = adjust(network, replace(truth, points=points), datum=FREE, reject="none")
    reference = adjust(network, truth, datum=FREE, reject="none")
    assert a.converged
    assert not a.rejected.any()
    assert a.sigma0 == pytest.approx(reference.sigma0, rel=1e-9)


def exchanged(network: Network, photographs: int, first: int, second: int) -> tuple[Network, BoolArray]:
    """The names of two points exchanged in some photographs, and which image points are wrong by it."""
    k = network.image_points
    there = k.image < photographs
    a, b = there & (k.point == first), there & (k.point == second)
    point = k.point.copy()
    point[a], point[b] = second, first
    return replace(network, image_points=replace(k, point=point)), a | b


@pytest.mark.parametrize("photographs", [1, 4])
@pytest.mark.parametrize("reject", ["tau", "tukey"])
def test_exchanged_names_are_rejected_though_they_bend_the_network(photographs: int, reject: str) -> None:
    # Errors of hundreds of pixels; in four photographs data snooping from a plain adjustment fails.
    network, truth = make_network(seed_of("exchanged 0"), images=12, points=40, planar=True)
    extent = np.linalg.norm(truth.points - truth.points[0], axis=1)
    network, bad = exchanged(network, photographs, 0, int(np.argmax(extent)))
    plain = adjust(network, truth, datum=FREE, reject="none", covariance=False)
    assert plain.sigma0 > 20
    a = adjust(network, truth, datum=FREE, reject=reject, options=AdjustmentOptions(alpha=1e-5))
    assert a.converged
    assert a.defect == a.expected_defect == 7
    assert bad.sum() == 2 * photographs
    assert a.rejected[bad].all()
    assert a.rejected[~bad].sum() <= (2 if reject == "tau" else 0.01 * len(bad))
    if reject == "tau":
        assert a.sigma0 == pytest.approx(1, abs=4 / np.sqrt(2 * a.redundancy))


def test_an_adjustment_that_gross_errors_break_is_begun_again(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = make_network(seed_of("broken"), images=10, points=30)
    clean = adjust(network, truth, datum=FREE, reject="tau", options=AdjustmentOptions(alpha=1e-5))
    monkeypatch.setattr(rejection, "_optimum_of_all", refuse)
    again = adjust(network, truth, datum=FREE, reject="tau", options=AdjustmentOptions(alpha=1e-5))
    assert again.converged
    np.testing.assert_array_equal(again.rejected, clean.rejected)
    assert again.vPv == pytest.approx(clean.vPv, rel=1e-9)


def test_snooping_keeps_the_last_round_that_could_be_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth, _ = spoiled(seed_of("last round"), 0.05, 50.0)
    plain = adjust(network, truth, datum=FREE, reject="none", options=AdjustmentOptions(tolerance=1e-3))
    monkeypatch.setattr(rejection.Run, "again", once_more(rejection.Run.again))
    a = adjust(network, truth, datum=FREE, options=AdjustmentOptions(alpha=1e-5))
    assert a.rejected.sum() > 0
    assert a.vPv < plain.vPv


def refuse(*_: object) -> None:
    raise GeometryError("adjustment: the normal equations cannot be solved from these start values")


def once_more(again):  # type: ignore[no-untyped-def]
    """The rounds of an adjustment of which the second cannot be solved."""
    calls = []

    def counted(run, optimum, weight):  # type: ignore[no-untyped-def]
        calls.append(weight)
        if len(calls) == 2:
            refuse()
        return again(run, optimum, weight)

    return counted


def test_reweighting_ends_where_its_rounds_do_not_converge(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two photographs of a plane do not determine a camera: three reweightings by each estimator show it."""
    rng = seed_of("flat valley")
    network, truth = make_network(rng, images=2, points=60, planar=True, free=("c", "x0", "y0", "K1", "P1"))
    rounds = []
    again = rejection.Run.again

    def counted(run: rejection.Run, optimum: Optimum, weight: FloatArray) -> Optimum:
        found = again(run, optimum, weight)
        rounds.append(found.converged)
        return found

    monkeypatch.setattr(rejection.Run, "again", counted)
    a = adjust(network, truth, datum=FREE, covariance=False, options=AdjustmentOptions(max_iterations=3))
    assert not a.converged and not any(rounds)
    assert (
        len(rounds) == 3 + 1 + 3 + 3 + 1 + 1
    )  # by Tukey, by Huber and Tukey, with what is left; and the last one


def test_only_rounds_in_a_row_that_do_not_converge_end_reweighting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, the third in all did, without a word, wherever rounds between them had converged."""
    network, truth, _ = spoiled(seed_of("in a row"), 0.05, 30.0)
    again, rounds = rejection.Run.again, []

    def run_with(vague: tuple[int, ...]) -> Adjustment:
        rounds.clear()

        def marked(run: rejection.Run, optimum: Optimum, weight: FloatArray) -> Optimum:
            rounds.append(len(rounds))
            found = again(run, optimum, weight)
            return replace(found, converged=found.converged and rounds[-1] not in vague)

        monkeypatch.setattr(rejection.Run, "again", marked)
        return adjust(network, truth, datum=FREE, reject="huber", covariance=False)

    plain = run_with(())
    every = len(rounds)
    assert every > 7 and plain.remarks == ()
    apart = run_with((0, 2, 4))
    assert len(rounds) == every and apart.remarks == ()
    broken = run_with((1, 2, 3))
    assert len(rounds) == 4 + 1 and kinds_of(broken.remarks) == ("rejection_not_converging",)
    assert broken.remarks[0].number("rounds") == rejection.MAX_VAGUE_WEIGHTS + 1
