"""Statistics of an adjustment: tests, reliability, variance components, subsets and other datums."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

from sfm.adjustment.covariance import change_datum, marginal_of
from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.correlations import observed_part, projection_covariance, projection_map
from sfm.adjustment.quality.statistics import (
    component_tests,
    correlations,
    global_test,
    non_centrality,
    reliability,
    significance,
    tau_test,
    w_test,
)
from sfm.adjustment.quality.variance_components import (
    by_camera,
    by_kind,
    by_photograph,
    by_source,
    estimate_components,
)
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.camera import Camera, camera_from_values, pixel_from_tangents, tangents_from_pixel
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.errors import GeometryError
from sfm.model.network import (
    ExteriorObservations,
    InteriorObservations,
    ObjectPoints,
    ScaleBars,
    Source,
)
from tests.synthetic import make_network, seed_of

FREE = Datum("free")


@pytest.fixture(scope="module")
def plain() -> Adjustment:
    network, truth = make_network(seed_of("statistics"), images=9, points=40, cameras=2, visibility=0.8)
    return adjust(network, truth, datum=FREE, reject="none")


def test_standardised_residuals_of_uncorrelated_coordinates(plain: Adjustment) -> None:
    w = plain.residuals / (0.1 * np.sqrt(plain.redundancy_numbers))
    assert np.abs(plain.standardised - w).max() < 1e-8
    assert np.abs(plain.tau - w / plain.sigma0).max() < 1e-8
    assert stats.kstest(plain.standardised.ravel(), "norm").pvalue > 0.01


def test_w_and_tau_tests_reject_as_often_as_alpha_says(plain: Adjustment) -> None:
    for test, statistic in ((w_test, plain.standardised), (tau_test, plain.tau)):
        found = test(plain, alpha=0.05)
        assert found.tested == statistic.size == 2 * len(plain.network.image_points)
        assert found.beyond == (np.abs(statistic) > found.critical).sum()
        assert abs(found.beyond - found.expected) < 4 * np.sqrt(found.expected)
    assert w_test(plain).critical == pytest.approx(3.2905, abs=1e-4)
    assert tau_test(plain).critical < w_test(plain).critical


def test_global_test_is_two_sided(plain: Adjustment) -> None:
    assert global_test(plain).passed
    assert plain.vPv == pytest.approx((plain.residuals**2).sum() / 0.01, rel=1e-9)
    for factor in (0.8, 1.25):
        assert not global_test(replace(plain, sigma0=factor)).passed
    none = global_test(replace(plain, sigma0=np.nan, redundancy=0))
    assert none.passed is None and none.untested == "redundancy"


@pytest.mark.slow
def test_the_component_of_a_kind_is_tested_against_what_is_stated_for_it() -> None:
    """Of right standard deviations each kind is refused as often as alpha says."""
    copies, alpha = 200, 0.1
    network, truth = make_network(seed_of("tests of kinds"), images=5, points=15, noise_px=0.0, free=())
    k, start, end = network.image_points, np.arange(5), np.arange(5) + 8
    length = np.linalg.norm(truth.points[end] - truth.points[start], axis=1)
    rng, alarms = seed_of("noise of kinds"), np.zeros(2)
    for _ in range(copies):
        bars = ScaleBars(start, end, length + rng.normal(0, 1e-3, 5), np.full(5, 1e-3))
        noisy = replace(k, xy=k.xy + rng.normal(0, 0.1, k.xy.shape))
        found = by_kind(
            adjust(replace(network, image_points=noisy).with_given(bars), truth, datum=FREE, reject="none")
        )
        tests = component_tests(found, alpha=alpha)
        assert [test.of for test in tests] == ["image points", "scale bars"]
        alarms += [test.passed is False for test in tests]
    assert np.abs(alarms / copies - alpha).max() < 4 * np.sqrt(alpha * (1 - alpha) / copies)
    wrong = component_tests(replace(found, sigma0=found.sigma0 * (1.2, 3.0)), alpha=alpha)
    assert [test.passed for test in wrong] == [False, False]


def test_reliability_of_a_known_redundancy_number() -> None:
    assert non_centrality(0.001, 0.8) == pytest.approx(4.13, abs=5e-3)  # Baarda's value
    network, truth = make_network(seed_of("mdb"), images=6, points=20)
    a = adjust(network, truth, datum=FREE, reject="none")
    C = a.residual_weights.copy()
    C[0] = 0.5 / 0.1**2, 0.0
    found = reliability(replace(a, residual_weights=C))
    assert found.minimal_bias[0, 0] == pytest.approx(found.delta0 * a.sigma0 * 0.1 / np.sqrt(0.5))
    assert found.external[0, 0] == pytest.approx(found.delta0)
    assert found.minimal_bias[0, 1] == found.external[0, 1] == np.inf


def test_variance_components_of_groups(plain: Adjustment) -> None:
    for components in (by_photograph(plain), by_camera(plain)):
        assert components.redundancy.sum() == pytest.approx(plain.redundancy, abs=1e-3)
        assert components.count.sum() == 2 * len(plain.network.image_points)
        assert np.abs(components.sigma0 - 1).max() < 5 / np.sqrt(2 * components.redundancy.min())


def test_weights_of_two_cameras_are_estimated() -> None:
    rng = seed_of("two cameras")
    network, truth = make_network(rng, images=10, points=40, cameras=2, noise_px=0.0)
    k = network.image_points
    group = network.camera[k.image]
    noise = np.array([0.05, 0.3])[group][:, None] * rng.standard_normal(k.xy.shape)
    network = replace(network, image_points=replace(k, xy=k.xy + noise))

    def run(factor: FloatArray) -> Adjustment:
        return adjust(
            network, truth, datum=FREE, reject="none", options=AdjustmentOptions(image_sigma_factor=factor)
        )

    a, factor, settled = estimate_components(run, group, ("one", "two"))
    assert settled
    assert factor == pytest.approx([0.5, 3.0], rel=0.1)
    np.testing.assert_array_equal(a.image_sigma_factor, factor[group])
    assert by_camera(a).sigma0 / factor == pytest.approx([1, 1], abs=2e-3)
    assert a.sigma0 == pytest.approx(1, abs=2e-3)


def test_a_group_that_takes_over_its_own_variance_factor_in_part_is_weighted_in_few_rounds(
    plain: Adjustment,
) -> None:
    """Each round shows a third of the logarithm of the factor that is missing; one by one they need 17."""
    group, rounds = np.zeros(len(plain.rejected), dtype=np.int64), []

    def run(factor: FloatArray) -> Adjustment:
        rounds.append(float(factor[0]))
        shown = factor[0] * (0.05 / factor[0]) ** (1 / 3)
        return replace(plain, residuals=plain.residuals * shown, image_sigma_factor=factor)

    _, factor, settled = estimate_components(run, group, ("all",))
    assert settled and len(rounds) <= 5
    assert by_camera(run(factor)).sigma0 / factor == pytest.approx([1, 1], abs=0.1)


@pytest.mark.parametrize(("noise_px", "ends"), [(2e-3, 2e-3), (5e-4, 1e-3), (0.0, 1e-3)])
def test_no_image_point_is_weighted_as_better_than_a_thousandth_of_a_pixel(
    noise_px: float, ends: float
) -> None:
    rng = seed_of("least")
    network, truth = make_network(rng, images=10, points=40, noise_px=0.0)
    k = network.image_points
    network = replace(network, image_points=replace(k, xy=k.xy + noise_px * rng.standard_normal(k.xy.shape)))

    def run(factor: FloatArray) -> Adjustment:
        return adjust(
            network, truth, datum=FREE, reject="none", options=AdjustmentOptions(image_sigma_factor=factor)
        )

    a, factor, settled = estimate_components(run, np.zeros(len(network.image_points), dtype=int), ("all",))
    assert settled and factor[0] * a.stated_px == pytest.approx(ends, rel=0.1)
    assert a.sigma0 == pytest.approx(1, abs=2e-3)
    plain = run(a.image_sigma_factor)
    np.testing.assert_allclose(a.covariance.points, plain.covariance.points / plain.sigma0**2, rtol=5e-3)


def test_weights_that_come_back_in_a_cycle_end_their_estimation(plain: Adjustment) -> None:
    """Larger standard deviations reject other image points and are not borne out by those that are left."""
    group = np.zeros(len(plain.rejected), dtype=np.int64)
    some = np.arange(len(group)) < 10
    factors: list[float] = []

    def run(factor: FloatArray) -> Adjustment:
        factors.append(factor[0])
        few = factor[0] > 10
        residuals = plain.residuals * (1 if few else 30)
        return replace(plain, residuals=residuals, rejected=some & few, image_sigma_factor=factor)

    a, factor, settled = estimate_components(run, group, ("all",))
    assert len(factors) == 3 and not settled
    assert not a.rejected.any()  # of the adjustments of the cycle the one that rejects fewest
    assert factor[0] == a.image_sigma_factor[0] < 10


def test_weights_that_swing_into_place_are_no_cycle(plain: Adjustment) -> None:
    group = np.zeros(len(plain.rejected), dtype=np.int64)

    def run(factor: FloatArray) -> Adjustment:
        return replace(plain, residuals=plain.residuals * 2 / np.sqrt(factor[0]), image_sigma_factor=factor)

    a, factor, settled = estimate_components(run, group, ("all",))
    assert settled
    assert factor[0] == pytest.approx(2 ** (2 / 3), rel=0.05)
    assert by_camera(a).sigma0 / factor == pytest.approx([1, 1], rel=0.1)


def test_kinds_of_observation_share_the_redundancy() -> None:
    rng = seed_of("kinds")
    network, truth = make_network(rng, images=8, points=30)
    ends = np.array([[6, 9, 11], [8, 20, 25]])
    sigma = np.array([1e-3] * 3 + [np.inf] * 3)
    network = network.with_given(
        ObjectPoints(
            np.arange(5), truth.points[:5] + rng.normal(0, 1e-4, (5, 3)), np.tile(1e-8 * np.eye(3), (5, 1, 1))
        ),
        ExteriorObservations(
            np.arange(4),
            truth.position[:4] + rng.normal(0, 1e-3, (4, 3)),
            np.zeros((4, 3)),
            np.tile(np.diag(sigma**2), (4, 1, 1)),
        ),
        InteriorObservations(np.array([0]), np.array([0]), np.array([10.001]), np.array([1e-3])),
        ScaleBars(
            ends[0],
            ends[1],
            np.linalg.norm(truth.points[ends[0]] - truth.points[ends[1]], axis=1) + rng.normal(0, 1e-4, 3),
            np.full(3, 1e-4),
        ),
    )
    a = adjust(network, truth, datum=Datum("control"), reject="none")
    kinds = by_kind(a)
    assert kinds.names == (
        "image points",
        "control points",
        "exterior orientation",
        "interior orientation",
        "scale bars",
    )
    assert list(kinds.count) == [2 * len(network.image_points), 15, 12, 1, 3]
    assert kinds.redundancy.sum() == pytest.approx(a.redundancy, abs=1e-3)
    assert (kinds.redundancy > 0).all()
    assert np.nansum(kinds.sigma0**2 * kinds.redundancy) == pytest.approx(a.vPv, rel=1e-6)
    m = marginal_of(a)  # redundancy numbers of the scale bars from the covariance of their ends
    taken = 0.0
    for i, j in ends.T:
        Q = m.joint(np.zeros(0, dtype=int), np.array([i, j])) / a.sigma0**2
        d = a.estimate.points[j] - a.estimate.points[i]
        row = np.concatenate([-d, d]) / np.linalg.norm(d)
        own = row @ Q @ row / 1e-8
        of_bars = a.observed[-1].redundancy_numbers[:, 0]
        assert of_bars[list(ends[0]).index(i)] == pytest.approx(1 - own, abs=1e-4)
        taken += own
    assert kinds.redundancy[4] == pytest.approx(3 - taken, abs=1e-3)


def test_significance_and_correlations() -> None:
    network, truth = make_network(
        seed_of("significance"), images=10, points=60, free=("c", "x0", "K1", "K2", "K3", "b2")
    )
    a = adjust(network, truth, datum=FREE, reject="none")
    tests = {test.parameter: test for test in significance(a, alpha=0.001)}
    assert set(tests) == {"x0", "K1", "K2", "K3", "b2"}
    assert tests["K1"].significant and tests["x0"].significant
    assert not tests["b2"].significant
    pairs = correlations(a)
    named = {frozenset((pair.first, pair.second)): pair.value for pair in pairs}
    assert named[frozenset(("K2 of camera camera 1", "K3 of camera camera 1"))] < -0.95
    assert all(abs(pair.value) > 0.9 for pair in pairs)
    assert correlations(a, limit=1.0) == ()


def test_joint_covariance_of_a_subset_and_of_a_distance(plain: Adjustment) -> None:
    m = marginal_of(plain)
    names = m.names()
    c = names.index(("c", "camera camera 2"))
    Q = m.joint(np.array([6, 7, 8, c]), np.array([3, 17]))
    assert np.allclose(Q[:3, :3], plain.covariance.exterior[1, :3, :3], rtol=1e-4, atol=1e-16)
    assert Q[3, 3] == pytest.approx(plain.covariance.interior[1][0, 0], rel=1e-5)
    assert np.allclose(Q[4:7, 4:7], plain.covariance.points[3], rtol=1e-4, atol=1e-16)
    assert np.linalg.eigvalsh(Q / np.sqrt(np.outer(np.diag(Q), np.diag(Q)))).min() > 0

    def ratio_sigma(a: Adjustment) -> float:
        """Standard deviation of the ratio of two distances, which no datum changes."""
        Q = marginal_of(a, datum=Datum(a.datum)).joint(np.zeros(0, dtype=int), np.array([3, 17, 22]))
        X = a.estimate.points[[3, 17, 22]]
        d1, d2 = X[1] - X[0], X[2] - X[0]
        l1, l2 = np.linalg.norm(d1), np.linalg.norm(d2)
        row = np.concatenate([-d1 / l1**2 + d2 / l2**2, d1 / l1**2, -d2 / l2**2])
        return float(np.sqrt(row @ Q @ row))

    assert ratio_sigma(plain) == pytest.approx(ratio_sigma(change_datum(plain, Datum("minimal"))), rel=1e-5)


def test_datum_changes_without_a_new_adjustment(plain: Adjustment) -> None:
    """Adjusting anew from the adjusted coordinates takes no step, so that both are of the same state."""
    index = np.array([1, 5, 9, 20])
    some = np.zeros(40, dtype=bool)
    some[index] = True
    names = [plain.network.points[j] for j in index]
    for points in (None, some, index, names):
        for kind in ("minimal", "free"):
            again = adjust(plain.network, plain.estimate, datum=Datum(kind, points), reject="none")
            changed = change_datum(plain, Datum(kind, points))
            assert changed.datum == again.datum == kind
            np.testing.assert_array_equal(changed.datum_points, again.datum_points)
            for a, b in zip(values_of(changed), values_of(again), strict=True):
                assert np.abs(a - b).max() < 1e-9 * np.abs(b).max()
    back = change_datum(change_datum(plain, Datum("minimal")), FREE)
    assert np.allclose(back.covariance.points, plain.covariance.points, rtol=1e-5, atol=1e-18)
    with pytest.raises(GeometryError, match="another adjustment"):
        change_datum(plain, Datum("control"))


def values_of(a: Adjustment) -> tuple[FloatArray, ...]:
    """Return all that an adjustment says of its unknowns."""
    interior = tuple(camera.parameters for camera in a.estimate.cameras)
    Q = a.covariance
    values = a.estimate.points, a.estimate.position, a.estimate.rotation, *interior
    return *values, Q.points, Q.exterior, Q.points_limiting, *Q.interior


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (["no such point"], "datum: point no such point is not in the network of 40 points"),
        ([40, 41], "datum: point 40 is not in the network"),
        (np.ones(3, dtype=bool), r"a mask of shape \(3,\), expected \(40,\)"),
        ([], "expected names or indices"),
        ([0.5], "points of type float64, expected names, indices or a mask"),
    ],
)
def test_missing_datum_points_are_reported(plain: Adjustment, points: object, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        change_datum(plain, Datum("free", points))


SIZE = (2000, 1500)


def camera_of(free: tuple[str, ...]) -> Camera:
    values = (("K1", 8e-4), ("K2", -4e-6))
    made = camera_from_values("c", "brown", SIZE, (0.005, 0.005), c_mm=10.0, values=values)
    return replace(made, free=np.array([name in free for name in made.names]))


def turned(camera: Camera, uv: FloatArray, w: FloatArray) -> FloatArray:
    rays = np.column_stack([uv, np.full(len(uv), -1.0)]) @ rotation_from_vector(w).T
    return pixel_from_tangents(camera, -rays[:, :2] / rays[:, 2:])


def test_it_is_the_spread_of_cameras_drawn_from_the_covariance() -> None:
    rng = seed_of("projection")
    camera = camera_of(("c", "x0", "y0", "K1"))
    free = np.flatnonzero(camera.free)
    root = np.diag([2e-3, 4e-3, 4e-3, 1e-5]) @ (np.eye(4) + 0.4 * rng.normal(size=(4, 4)))
    covariance = root @ root.T
    seen = rng.uniform((300, 300), (1500, 1200), (60, 2))
    xy = np.array([[100.0, 80.0], [1000.0, 750.0], [1900.0, 1400.0]])
    places, targets = tangents_from_pixel(camera, seen), tangents_from_pixel(camera, xy)
    shifts = []
    for drawn in rng.multivariate_normal(np.zeros(4), covariance, 400):
        parameters = camera.parameters.copy()
        parameters[free] += drawn
        other = camera.with_parameters(parameters)
        fit = least_squares(lambda w, one=other: (turned(one, places, w) - seen).ravel(), np.zeros(3))
        shifts.append(turned(other, targets, fit.x) - xy)
    spread = np.std(shifts, axis=0)
    stated = np.sqrt(np.einsum("kii->ki", projection_covariance(camera, covariance, seen, xy)))
    np.testing.assert_allclose(stated, spread, rtol=0.12)  # 400 draws: 3.5 % each, 3 of these


def test_a_shift_of_the_principal_point_is_nearly_a_rotation() -> None:
    camera = camera_of(("x0",))
    seen = np.random.default_rng(0).uniform((900, 700), (1100, 800), (50, 2))
    sigma_px = 2.0
    Q = projection_covariance(camera, np.array([[(0.005 * sigma_px) ** 2]]), seen, seen)
    assert np.sqrt(np.einsum("kii->k", Q).max()) < 0.01 * sigma_px  # where it was fitted
    x, y, sigma = projection_map(camera, np.array([[(0.005 * sigma_px) ** 2]]), seen)
    assert sigma.shape == (len(y), len(x))
    middle = sigma[len(y) // 2, len(x) // 2]
    assert sigma[0, 0] > 20 * middle  # the rotation is no shift of all places alike
    assert not projection_covariance(camera, np.zeros((1, 1)), seen, seen).any()


def test_image_points_cover_their_convex_hull() -> None:
    triangle, places = (
        np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 50.0]]),
        np.array([[10.0, 10.0], [60.0, 40.0]]),
    )
    area, inside = observed_part(triangle, places)
    assert np.isclose(area, 2500) and inside.tolist() == [True, False]
    for some in (triangle[:2], np.outer(np.arange(4.0), [1, 2])):
        area, inside = observed_part(some, places)
        assert area == 0 and not inside.any()


def test_component_of_a_source_is_relative_to_what_was_stated_of_it() -> None:
    """The weights of sources against one another already contain what their residuals show."""
    network, truth = make_network(seed_of("balance"), images=12, points=60, visibility=0.9)
    rng, seen = np.random.default_rng(seed_of("balance")), network.image_points
    coarse = np.arange(len(seen)) % 2 == 1
    xy = seen.xy + np.where(coarse[:, None], np.sqrt(3) * 0.1, 0.0) * rng.standard_normal(seen.xy.shape)
    weighted = replace(
        seen,
        xy=xy,
        covariance=np.where(coarse[:, None, None], 4.0, 1.0) * seen.covariance,
        source=coarse.astype(np.int64),
    )
    sources = (Source("fine"), Source("coarse", balance=2.0))
    network = replace(network, image_points=weighted, sources=sources)
    components = by_source(adjust(network, truth, datum=FREE, reject="none"))
    assert components.sigma0 == pytest.approx([1.0, 2.0], rel=0.12)
