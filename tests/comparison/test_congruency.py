"""Significance of differences and congruency of two epochs."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import pytest

from adapters.colmap.camera_models import read_model, write_model
from adapters.colmap.mapper import MapperBaseline
from adapters.formats.result_tables import read_result, write_tables
from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison.comparison_remarks import verdict_of_comparison
from sfm.comparison.congruency import congruency, motions
from sfm.comparison.significance import NO_COMMON_DATUM, ResultComparison, compare_results
from sfm.comparison.solutions import compare_baseline, reprojection
from sfm.comparison.stable_points import tests_in_datum as single_tests_in_datum
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.distortion.models import Role
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import Remark, kinds_of, remark
from sfm.model.similarity import Similarity
from sfm.model.solution import Solution
from sfm.report.differences import describe_scale
from tests.synthetic import make_network, observed_anew, seed_of, stored_of

DATUMS = ("free", "minimal", "control")
PAIRS = tuple(combinations_with_replacement(DATUMS, 2))
CONTROL = ("1", "10", "20", "30", "40", "50")
MOVED = [5, 17, 22, 41, 58]


@cache
def scene() -> tuple[Network, Estimate]:
    return make_network(seed_of("congruency"), images=8, points=60, model="opencv", noise_px=0.0)


def epoch(seed: int, datum: str, shift: FloatArray | None = None, *, bar: float = 1.0) -> Solution:
    """One epoch, adjusted in a datum; its scale bar is `bar` times as long as stated."""
    network, truth = scene()
    rng = np.random.default_rng(seed)
    moved = truth if shift is None else replace(truth, points=truth.points + shift)
    network = observed_anew(network, moved, 0.1, rng)
    length = float(np.linalg.norm(moved.points[3] - moved.points[43])) * bar
    network = network.with_scale_bar("4", "44", length + 1e-4 * rng.standard_normal(), 1e-4)
    kind = Datum(datum, points=[["1", "2", "3"], ["7", "15", "33"]][seed % 2] if datum == "minimal" else None)
    if datum == "control":
        given = moved.points[[int(name) - 1 for name in CONTROL]] + 0.001 * rng.standard_normal((6, 3))
        network = network.with_control(CONTROL, given, 0.001)
    a = adjust(network, moved, datum=kind, reject="none")
    return stored_of(f"{datum} {seed}", a)


def sampled(result: Solution, points: np.ndarray) -> Solution:
    """The same with the covariance of some points only."""
    assert result.covariance is not None
    rows = (3 * points[:, None] + np.arange(3)).ravel()
    return replace(result, covariance=result.covariance[np.ix_(rows, rows)], covariance_points=points)


def remarks(found: ResultComparison) -> tuple[Remark, ...]:
    return verdict_of_comparison(found).remarks


def compared(first: str, second: str, shift: FloatArray | None = None) -> ResultComparison:
    return compare_results(epoch(4, first), epoch(5, second, shift))


def test_the_statistic_does_not_depend_on_the_datum() -> None:
    """Free and minimal are S-transformations of one another; weak control adds observations of its own."""
    statistics = {pair: compared(*pair).global_statistic for pair in combinations_with_replacement(DATUMS, 2)}
    free = statistics["free", "free"]
    assert statistics["free", "minimal"] == pytest.approx(free, rel=1e-4)
    assert statistics["minimal", "minimal"] == pytest.approx(free, rel=1e-4)
    for statistic in statistics.values():  # 174 degrees of freedom: a standard deviation of 0.11
        assert abs(statistic - 1) < 0.4


@pytest.mark.parametrize("datums", PAIRS)
def test_points_that_moved_are_found_and_no_others(datums: tuple[str, str]) -> None:
    shift = np.zeros((60, 3))
    shift[MOVED] = [0.004, -0.002, 0.003]
    found = compared(*datums, shift)
    assert found.changed is True and found.majority
    assert list(np.flatnonzero(found.significant)) == MOVED
    assert found.point_difference[MOVED] == pytest.approx(shift[MOVED], abs=1.5e-3)
    still = np.setdiff1d(np.arange(60), MOVED)
    assert np.abs(found.point_difference[still] / found.point_sigma[still]).max() < 4.5
    (one,) = remarks(found)
    assert found.cause is None and one.kind == "points_differ"
    assert (one.number("differing"), one.number("tested")) == (5, 60)
    assert verdict_of_comparison(found).level == "bad"


def test_a_bending_of_the_whole_is_reported_from_points_that_move() -> None:
    xyz = scene()[1].points
    dome = np.zeros((60, 3))
    dome[:, 2] = 0.01 * (xyz[:, :2] ** 2).sum(axis=1)
    bent = compared("free", "control", dome)
    assert bent.changed is True and "bent" in kinds_of(remarks(bent))
    assert remarks(compared("free", "free")) == ()


def test_another_interior_orientation_is_reported() -> None:
    first, second = epoch(4, "free"), epoch(5, "free", 0.01 * scene()[1].points[:, :1] ** 2 * [0.0, 0.0, 1.0])
    camera = second.estimate.cameras[0]
    other = camera.with_parameters(camera.parameters + 50.0 * camera.plays(Role.X0))
    second = replace(second, estimate=replace(second.estimate, cameras=(other,)))
    (one,) = [one for one in remarks(compare_results(first, second)) if one.kind == "interior_differs"]
    assert one.names("camera") == (camera.name,) and one.names("parameter") == ("cx",)


def test_where_a_sample_is_kept_the_points_of_both_samples_are_tested() -> None:
    shift = np.zeros((60, 3))
    shift[MOVED] = [0.004, -0.002, 0.003]
    first = sampled(epoch(4, "free"), np.arange(0, 45))
    second = sampled(epoch(5, "minimal", shift), np.arange(10, 60))
    found = compare_results(first, second)
    assert list(np.flatnonzero(np.isfinite(found.statistic))) == list(range(10, 45))
    assert list(np.flatnonzero(found.significant)) == [17, 22, 41]  # of 5, 17, 22, 41, 58
    assert found.point_difference[MOVED] == pytest.approx(shift[MOVED], abs=1.5e-3)
    untested = compare_results(sampled(epoch(4, "free"), np.arange(3)), second).untested
    assert untested is not None and untested.kind == "untestable"


def test_where_no_half_agrees_no_point_is_blamed() -> None:
    rng = seed_of("scattered")
    found = compared("free", "free", 0.02 * rng.standard_normal((60, 3)))
    assert found.changed is True and not found.majority
    assert not found.significant.any() and found.stable.all()
    assert kinds_of(remarks(found)) == ("no_majority_agrees",)


def test_a_change_of_size_is_a_change_where_both_have_a_scale() -> None:
    longer = epoch(3, "free", bar=1.01)
    found = compare_results(epoch(2, "free"), longer)
    assert found.changed is True and found.a_from_b.scale == 1.0
    assert describe_scale(found) == "scale kept: both results are scaled"
    unscaled = compare_results(epoch(2, "free"), replace(longer, unit=""))
    assert unscaled.changed is False and unscaled.scale_estimated
    assert unscaled.a_from_b.scale == pytest.approx(1 / 1.01, rel=1e-3)
    assert describe_scale(unscaled).startswith("scale estimated, 0.99")


def test_units_are_carried_over() -> None:
    metres = epoch(2, "free")
    thousand = replace(
        metres.estimate, points=1000 * metres.estimate.points, position=1000 * metres.estimate.position
    )
    assert metres.covariance is not None and metres.point_covariance is not None
    millimetres = replace(
        metres,
        estimate=thousand,
        unit="mm",
        point_covariance=1e6 * metres.point_covariance,
        covariance=1e6 * metres.covariance,
    )
    found = compare_results(metres, millimetres)
    assert found.a_from_b.scale == 1e-3
    assert np.abs(found.point_difference).max() < 1e-12


def test_without_a_common_datum_or_correlations_no_verdict_is_given() -> None:
    first, second = epoch(2, "minimal"), epoch(3, "minimal")
    assert compare_results(first, second, align="none").untested == remark(
        "untestable", reason=NO_COMMON_DATUM
    )
    found = compare_results(replace(first, covariance=None), replace(second, covariance=None))
    assert found.changed is None and kinds_of(remarks(found)) == ("no_covariance",)
    approximate = compare_results(*(replace(epoch(k, "free"), covariance=None) for k in (2, 3)))
    assert approximate.approximate and approximate.changed is False
    held = compare_results(epoch(2, "control"), epoch(3, "control"), align="none")
    assert held.changed is False and held.statistic.shape == (60,)


def test_the_motion_of_the_whole_is_no_change() -> None:
    rng = seed_of("motions")
    xyz = rng.uniform(-1, 1, (12, 3))
    A = rng.standard_normal((36, 36))
    Q = A @ A.T
    G = motions(xyz)
    whole = (G @ rng.standard_normal(7)).reshape(12, 3)
    found = congruency(whole, Q, xyz, motion="similarity")
    assert found.first_test.statistic < 1e-20 and np.abs(found.difference).max() < 1e-12
    grown = G[:, 6].reshape(12, 3)
    assert congruency(100 * grown, Q, xyz, motion="rigid").first_test.statistic > 1


def test_the_drop_of_omega_is_that_of_leaving_the_point_out() -> None:
    rng = seed_of("drop")
    xyz = rng.uniform(-1, 1, (10, 3))
    A = rng.standard_normal((30, 30))
    Q, d = A @ A.T, rng.standard_normal((10, 3))
    whole = congruency(d, Q, xyz, alpha=1e-12)
    for k in range(10):
        rest = np.delete(np.arange(10), k)
        rows = (3 * rest[:, None] + np.arange(3)).ravel()
        part = congruency(d[rest], Q[np.ix_(rows, rows)], xyz[rest], alpha=1e-12)
        drop = whole.first_test.statistic * 24 - part.first_test.statistic * 21
        assert whole.statistic[k] * 3 == pytest.approx(drop, rel=1e-6)


def test_too_few_points_are_refused() -> None:
    with pytest.raises(GeometryError, match="congruency: 3 points of reference, expected 4 or more"):
        congruency(np.zeros((3, 3)), np.eye(9), np.eye(3))


@pytest.mark.slow
@pytest.mark.parametrize("datums", PAIRS)
def test_false_alarms_are_as_rare_as_stated(datums: tuple[str, str]) -> None:
    """200 pairs of epochs without a change: 10 alarms expected, with a standard deviation of 3.1."""
    alarms = sum(
        bool(compare_results(epoch(2 * r, datums[0]), epoch(2 * r + 1, datums[1])).changed)
        for r in range(10, 210)
    )
    assert 1 <= alarms <= 20


TURN = Similarity(1000.0, rotation_from_vector(np.array([0.3, -1.1, 0.7])), np.array([10.0, -20.0, 5.0]))


def measured(name: str, *, shift: np.ndarray | None = None, model: str = "opencv") -> Solution:
    """One epoch of an object of 60 points, of which some may have moved, adjusted free."""
    network, truth = make_network(seed_of("object"), model=model, images=10, noise_px=0.0)
    points = truth.points if shift is None else truth.points + shift
    rng = seed_of(f"epoch {name}")
    moved = replace(truth, points=points)
    seen = network.image_points
    xy = seen.xy + reprojection(network, moved) + 0.1 * rng.standard_normal(seen.xy.shape)
    network = replace(network, image_points=replace(seen, xy=xy))
    a = adjust(network, moved, datum=Datum("free"), reject="none")
    sigma = []
    for camera, Q in zip(a.estimate.cameras, a.covariance.interior, strict=True):
        s = np.full(len(camera.names), np.nan)
        s[camera.free] = np.sqrt(np.diag(Q))
        sigma.append(s)
    return Solution(
        name,
        network,
        a.estimate,
        a.covariance.points,
        a.covariance.exterior[:, :3, :3],
        tuple(sigma),
        a.redundancy,
    )


@pytest.fixture(scope="module")
def epochs() -> tuple[Solution, Solution]:
    first, second = measured("one"), measured("two")
    moved = TURN.apply_estimate(second.estimate)
    J = TURN.scale * TURN.rotation
    assert second.point_covariance is not None
    covariance = J @ second.point_covariance @ J.T
    return first, replace(second, estimate=moved, point_covariance=covariance)


def test_two_epochs_without_change_differ_by_their_sigmas(epochs: tuple[Solution, Solution]) -> None:
    found = compare_results(*epochs)
    assert found.a_from_b.scale == pytest.approx(1e-3, rel=1e-3)
    assert len(found.points) == 60 and len(found.images) == 10
    # mean of 60 values of chi-square(3)/3: 1 with a standard deviation of 0.105, less 7 parameters of 180
    assert 1 - 7 / 180 - 0.4 < found.global_statistic < 1 + 0.4
    assert found.changed is False
    assert not found.significant.any()
    assert np.abs(found.point_difference / found.point_sigma).max() < 4.5
    assert found.interior[0].conversion is None
    assert np.nanmax(np.abs(found.interior[0].difference / found.interior[0].sigma)) < 4


def test_a_moved_point_is_found(epochs: tuple[Solution, Solution]) -> None:
    shift = np.zeros((60, 3))
    shift[17] = [0.0, 0.002, 0.0]
    found = compare_results(epochs[0], measured("three", shift=shift))
    assert found.changed is True
    assert list(np.flatnonzero(found.significant)) == [17]
    assert found.point_difference[17] == pytest.approx([0, 0.002, 0], abs=5 * found.point_sigma[17].max())


@pytest.mark.parametrize("align", ["points", "cameras", "control"])
def test_alignments_bring_the_datum_back(align: str, epochs: tuple[Solution, Solution]) -> None:
    first, _ = epochs
    turned = replace(first, estimate=TURN.apply_estimate(first.estimate), point_covariance=None)
    found = compare_results(first, turned, align=align, control=("1", "5", "9", "20"))
    assert np.abs(found.point_difference).max() < 1e-11
    assert np.abs(found.position_difference).max() < 1e-11
    assert found.rotation_deg.max() < 1e-10
    with pytest.raises(GeometryError, match="control point 99 is not in both"):
        compare_results(first, turned, align="control", control=("99",))
    with pytest.raises(GeometryError, match="align 'middle', expected one of"):
        compare_results(first, turned, align="middle")


def test_without_alignment_and_covariance_differences_remain_and_no_test_is_made(
    epochs: tuple[Solution, Solution],
) -> None:
    first, _ = epochs
    bare = replace(first, point_covariance=None, estimate=TURN.apply_estimate(first.estimate))
    found = compare_results(replace(first, point_covariance=None), bare, align="none")
    assert found.changed is None
    assert np.isnan(found.critical)
    assert np.linalg.norm(found.point_difference, axis=1).min() > 5


def test_results_are_matched_by_name_and_models_are_converted(
    epochs: tuple[Solution, Solution],
) -> None:
    first, _ = epochs
    brown = measured("four", model="brown")
    order = np.random.default_rng(1).permutation(60)
    names = tuple(brown.network.points[j] for j in order)
    inverse = np.argsort(order)
    seen = brown.network.image_points
    assert brown.point_covariance is not None
    shuffled = replace(
        brown,
        network=replace(brown.network, points=names, image_points=replace(seen, point=inverse[seen.point])),
        estimate=replace(brown.estimate, points=brown.estimate.points[order]),
        point_covariance=brown.point_covariance[order],
    )
    a, b = compare_results(first, brown), compare_results(first, shuffled)
    assert a.points == b.points
    np.testing.assert_allclose(a.point_difference, b.point_difference, atol=1e-12)
    assert a.interior[0].model == "opencv"
    assert a.interior[0].conversion is not None and a.interior[0].conversion.source_model == "brown"
    nothing = replace(first, network=replace(first.network, points=tuple(f"x{j}" for j in range(60))))
    with pytest.raises(GeometryError, match="0 points in common, alignment needs 3"):
        compare_results(first, nothing)


def test_tables_go_round_to_the_last_digit(epochs: tuple[Solution, Solution], tmp_path: Path) -> None:
    first, _ = epochs
    write_tables(tmp_path, first)
    again = read_result(tmp_path)
    assert again.name == "one" and again.redundancy == first.redundancy
    assert again.network.images == first.network.images and again.network.points == first.network.points
    np.testing.assert_array_equal(again.estimate.points, first.estimate.points)
    np.testing.assert_array_equal(again.estimate.position, first.estimate.position)
    np.testing.assert_allclose(again.estimate.rotation, first.estimate.rotation, atol=1e-15)
    np.testing.assert_array_equal(again.network.image_points.xy, first.network.image_points.xy)
    np.testing.assert_array_equal(again.estimate.cameras[0].parameters, first.estimate.cameras[0].parameters)
    np.testing.assert_array_equal(again.estimate.cameras[0].free, first.estimate.cameras[0].free)
    assert again.point_covariance is not None and first.point_covariance is not None
    np.testing.assert_allclose(
        np.einsum("njj->nj", again.point_covariance),
        np.einsum("njj->nj", first.point_covariance),
        rtol=1e-14,
    )
    second = tmp_path / "again"
    write_tables(second, again)
    for name in ("points.csv", "image_points.csv", "cameras.csv", "summary.json"):
        assert (second / name).read_text() == (tmp_path / name).read_text()


@pytest.mark.parametrize(
    "name", ["points.csv", "images.csv", "cameras.csv", "image_points.csv", "summary.json"]
)
@pytest.mark.parametrize("part", [0.0, 0.4, 0.8])
def test_truncated_tables_are_refused(
    name: str, part: float, epochs: tuple[Solution, Solution], tmp_path: Path
) -> None:
    write_tables(tmp_path, epochs[0])
    data = (tmp_path / name).read_bytes()
    cut = data[: int(part * len(data))]
    if b"\n" in data[len(cut) - 1 : len(cut) + 1]:  # a table cut between two rows is a shorter table
        cut = cut[: cut.rstrip(b"\n").rfind(b",")]
    (tmp_path / name).write_bytes(cut)
    with pytest.raises(SurveyFileError, match=r"\.(csv|json), line \d+: "):
        read_result(tmp_path)


def test_colmap_model_is_compared_with_tables(epochs: tuple[Solution, Solution], tmp_path: Path) -> None:
    first, _ = epochs
    write_model(tmp_path / "colmap", first.network, first.estimate)
    network, estimate = read_model(tmp_path / "colmap")
    found = compare_results(first, Solution("colmap", network, estimate))
    assert np.abs(found.point_difference).max() < 1e-12
    assert np.abs(found.interior[0].difference).max() < 1e-9


def test_baseline_is_compared_at_the_targets(epochs: tuple[Solution, Solution]) -> None:
    network, truth = make_network(seed_of("baseline"), model="opencv", images=8, noise_px=0.1)
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    # a baseline that oriented six of eight photographs, in a frame of its own, and a camera wrong by 1 px
    kept = [0, 2, 3, 4, 6, 7]
    theirs = TURN.apply_estimate(a.estimate)
    camera = theirs.cameras[0].with_parameters(
        theirs.cameras[0].parameters + np.array([0, 0, 1, 0, 0, 0, 0, 0])
    )
    baseline = Estimate((camera,), theirs.position[kept], theirs.rotation[kept], np.zeros((0, 3)))
    photographs = Network(
        tuple(network.images[i] for i in kept),
        np.zeros(6, dtype=np.int64),
        (),
        network.image_points.select(slice(0)),  # type: ignore[arg-type]
    )
    found = compare_baseline(
        a, MapperBaseline(photographs, baseline, total=8, rms_px=0.5, seconds=50.0), seconds=1.0
    )
    assert found.photographs == (8, 6) and found.total == 8
    assert found.targets == 60
    assert 0.2 < found.target_rms_px < 1.0
    assert np.isnan(found.rotation_deg[[1, 5]]).all()
    assert np.nanmax(found.rotation_deg) < 0.1
    assert 1e-5 < found.point_rms < 1e-3


def test_points_that_alone_are_the_datum_are_not_tested() -> None:
    """Two points fix six motions: of their covariance rounding is left, which may be singular or negative."""
    rng, weight = seed_of("datum points"), (np.arange(6) < 2).astype(float)
    for _ in range(100):
        A = rng.normal(size=(18, 18))
        T = single_tests_in_datum(rng.normal(size=(6, 3)), A @ A.T, rng.normal(size=(18, 6)), weight)
        assert np.isnan(T).tolist() == [True, True, False, False, False, False]
