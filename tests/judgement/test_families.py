"""From an alternative to its remark: which one is adjusted, what it is called, and its numbers."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.hypotheses import families, hypotheses
from sfm.judgement.hypotheses.columns import columns_of, interior_columns, object_fields
from sfm.judgement.hypotheses.families import Alternative
from sfm.judgement.hypotheses.hypotheses import (
    Cause,
    JudgedAssumptions,
    contradicted_parameters,
    free_network,
    judge_alternatives,
    remark_of,
)
from sfm.judgement.hypotheses.refit import Refit, log_likelihood_of, shifts_of
from sfm.judgement.hypotheses.score import Gain
from sfm.model.conventions import FloatArray
from sfm.model.network import ObjectPoints, ScaleBars, without_given
from sfm.model.remarks.remark import Remark
from sfm.model.similarity import fit_similarity
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def a() -> Adjustment:
    network, truth = make_network(seed_of("described"), images=6, points=14, free=("c",))
    return adjust(network, truth, datum=Datum("free"), reject="none")


FAMILIES = {
    one.name: one
    for one in (
        *families.OF_PHOTOGRAPHS,
        *families.OF_EACH,
        *(families.HELD, families.GIVEN, families.FORMAT, families.MOVED),
    )
}


def alternative(
    family: str = "c",
    pattern: str = "split",
    factor: tuple[float, ...] = (0, 0, 0, 0, 1, 1),
    *,
    points: tuple[int, ...] = (),
    parameters: tuple[tuple[int, int], ...] = (),
) -> Alternative:
    return Alternative(
        FAMILIES[family],
        pattern,
        np.array(factor, dtype=float),
        Gain(9.0, 1, np.ones(1)),
        points=np.array(points, dtype=np.int64),
        parameters=parameters,
    )


@pytest.mark.parametrize(
    ("family", "pattern", "kind"),
    [
        ("c", "split", "other_camera"),
        ("camera", "linear", "camera_drift"),
        ("point", "each", "camera_varies"),
        ("held", "all", "held_parameter"),
        ("given", "all", "given_parameter"),
        ("format", "all", "distortion_not_described"),
        ("moved", "split", "points_moved"),
        ("moved", "all", "shape_of_control"),
        ("strain", "linear", "object_deformed"),
        ("bending", "split", "object_deformed"),
    ],
)
def test_kinds(family: str, pattern: str, kind: str) -> None:
    assert alternative(family, pattern).kind == kind


def remark(a: Adjustment, one: Alternative, beta: list[float], *others: Alternative) -> Remark:
    found = Refit(a, np.array(beta), 50.0, 4.0, 2.0)
    return remark_of(a, Cause(one, found, tuple((other, found) for other in others)), "mm")


def test_the_remark_on_a_camera(a: Adjustment) -> None:
    one = remark(
        a, alternative("c"), [5.0], alternative("strain"), alternative("bending"), alternative("moved")
    )
    assert one.names("photographs") == ("image 5", "image 6")
    assert one.names("instead") == ("object_deformed", "points_moved")
    assert one.number("otherwise") == 4.0
    unknown = remark(a, alternative("c"), [5.0], alternative("point", "each"))
    assert unknown.names("instead") == ("camera_varies",) and "otherwise" not in unknown.numbers
    assert (one.number("shift"), one.number("rms")) == (4.0, 2.0)
    assert one.number("change") == pytest.approx(100 * 5.0 / 1000) and "away" not in one.numbers
    others = remark(a, alternative("centre", factor=(1, 1, 1, 1, 0, 0)), [5.0, 3.0, -4.0, 1.0])
    assert others.number("change") == pytest.approx(-0.5) and others.names("instead") == ()
    assert others.number("away") == pytest.approx(5.0)
    three = remark(a, alternative("centre"), [5.0, 3.0, -4.0])
    assert three.number("away") == pytest.approx(5.0)
    drift = remark(a, alternative("centre", "linear", (-1, -0.6, -0.2, 0.2, 0.6, 1)), [5.0, 3.0, -4.0, 1.0])
    assert drift.kind == "camera_drift" and "away" not in drift.numbers
    assert drift.number("change") == pytest.approx(2 * 0.5)  # from the first photograph to the last


def test_a_deformation_that_grows_is_told_from_one_of_some_photographs(a: Adjustment) -> None:
    factors = {"split": (0, 0, 0, 0, 1, 1), "linear": (-1, -0.6, -0.2, 0.2, 0.6, 1)}
    for pattern, factor in factors.items():
        one = alternative("strain", pattern, factor)
        said = remark(a, one, [1e-3] * 5)
        assert bool(said.names("photographs")) == (pattern == "split")
        assert ("steadily" in said.text) == (pattern == "linear")


def test_the_remark_on_a_camera_of_each_photograph(a: Adjustment) -> None:
    """From the mean of the photographs: 6, 3, 0, 0, 0, -3 px of c at the edge, and x0 of one."""
    c = [6.0, 3.0, 0.0, 0.0, 0.0, -3.0]
    every = (0, 1, 2, 3, 4, 5)
    one = remark(a, alternative("c", "each", every), c)
    assert one.kind == "camera_varies" and one.number("change") == pytest.approx(0.5)
    assert "away" not in one.numbers
    one = remark(a, alternative("point", "each", every), [0.0, 0, 0, 0, 6, 0, 0, 0, 0, 0, 0, 0])
    assert one.number("away") == pytest.approx(5.0) and "change" not in one.numbers
    beta = np.zeros((6, 4))
    beta[:, 0], beta[2, 2] = c, 1.2
    both = remark(a, alternative("centre", "each", every), beta.ravel().tolist())
    assert (both.number("change"), both.number("away")) == pytest.approx((0.5, 1.0))


def test_the_columns_of_each_photograph_are_its_own(a: Adjustment) -> None:
    columns = columns_of(a)
    image = a.network.image_points.image
    D = alternative("point", "each", (0, 1, 2, 3, 4, 5)).columns(a, columns)
    assert D.shape == (len(image), 2, 12)
    for row in (0, 40, 83):
        own = slice(2 * image[row], 2 * image[row] + 2)
        np.testing.assert_array_equal(D[row, :, own], columns.freedoms[row, :, 1:3])
        assert np.count_nonzero(D[row]) == np.count_nonzero(D[row, :, own])


def test_the_remark_on_held_parameters(a: Adjustment) -> None:
    camera = a.estimate.cameras[0]
    x0, K1 = camera.names.index("x0"), camera.names.index("K1")
    one = remark(a, alternative("held", "all", parameters=((0, x0),)), [7.0])
    assert one.names("camera") == ("camera 1",) and one.names("parameters") == ("x0",)
    assert one.number("value") == pytest.approx(0.03) and one.numbers["value"].unit == "mm"
    assert one.number("instead_of") == pytest.approx(0.03 + 7 * interior_columns(a, [(0, x0)])[2][0])
    assert one.numbers["instead_of"].unit == "mm"
    both = remark(a, alternative("held", "all", parameters=((0, x0), (0, K1))), [7.0, 1.0])
    assert both.names("parameters") == ("x0", "K1") and "value" not in both.numbers


def test_a_pure_number_has_no_unit() -> None:
    network, truth = make_network(seed_of("pure"), images=4, points=12, model="opencv", free=("fx",))
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    k1 = a.estimate.cameras[0].names.index("k1")
    one = remark(a, alternative("held", "all", (1, 1, 1, 1), parameters=((0, k1),)), [7.0])
    assert one.numbers["value"].unit == "" and one.number("value") == pytest.approx(-0.08)


def test_the_remark_on_the_format(a: Adjustment) -> None:
    one = remark(a, alternative("format", "all"), [0.1, 0.0, 0.3, -0.4, 0.0, 0.2])
    assert one.number("largest") == pytest.approx(0.5) and one.numbers["largest"].unit == "px"


def test_the_remark_on_points(a: Adjustment) -> None:
    one = remark(a, alternative("moved", points=(2, 5)), [1.0, 2.0, 2.0, 0.0, 0.0, 1.0])
    assert one.names("points") == ("3", "6") and one.names("from") == ("image 5",)
    assert one.number("distance") == pytest.approx(3.0) and one.numbers["distance"].unit == "mm"


@pytest.mark.parametrize(("family", "size"), [("strain", 5), ("bending", 18)])
def test_the_remark_on_a_deformation(a: Adjustment, family: str, size: int) -> None:
    beta = seed_of(family).normal(0, 1e-3, size)
    fields, extent = object_fields(a.estimate.points)
    own = fields[:, :, :5] if family == "strain" else fields[:, :, 5:]
    away = np.linalg.norm(own @ beta, axis=1) / extent
    one = remark(a, alternative(family), beta.tolist())
    assert one.number("deformation") == pytest.approx(1000 * away.max())
    linear = remark(a, alternative(family, "linear", (-1, -0.6, -0.2, 0.2, 0.6, 1)), beta.tolist())
    assert linear.number("deformation") == pytest.approx(2000 * away.max())


# ---- the adjustment with an alternative ----


def test_the_likelihood_spreads_rejected_points_over_their_photograph(a: Adjustment) -> None:
    plain = -a.redundancy / 2 * (np.log(2 * np.pi * a.sigma0_px**2) + 1)
    assert log_likelihood_of(a) == pytest.approx(plain)
    out = np.zeros(len(a.rejected), dtype=bool)
    out[[1, 4, 5]] = True
    assert log_likelihood_of(replace(a, rejected=out)) == pytest.approx(plain - 3 * np.log(2000 * 1500))


def moved_points(a: Adjustment, points: FloatArray) -> Adjustment:
    return replace(a, estimate=replace(a.estimate, points=points))


def test_shifts_are_in_standard_deviations_after_a_similarity(a: Adjustment) -> None:
    X, sigma = a.estimate.points, np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    one, beta = alternative("c"), np.zeros(1)
    turned = 1.3 * X @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).T + (3.0, 2.0, 1.0)
    assert shifts_of(a, a, moved_points(a, turned), one, beta) == pytest.approx((0, 0), abs=1e-6)
    # points that the similarity does not see: the shift of a moved point is its whole difference
    Y = X.copy()
    Y[4] += (0.0, 6 * sigma[4, 1], 0.0)
    still = alternative("moved", points=(4,))
    largest, rms = shifts_of(a, a, moved_points(a, Y), still, np.zeros(3))
    assert (largest, rms) == pytest.approx((6.0, 6 / np.sqrt(3 * len(X))))
    # what the alternative takes out of the coordinates counts where it is more
    largest, rms = shifts_of(a, a, moved_points(a, Y), still, np.array([0.0, 0.0, -9 * sigma[4, 2]]))
    assert (largest, rms) == pytest.approx((9.0, 9 / np.sqrt(3 * len(X))))
    # a point that is not known has no part
    Y[4] = np.nan
    assert shifts_of(a, a, moved_points(a, Y), one, beta) == pytest.approx((0, 0), abs=1e-6)
    unknown = np.full_like(X, np.nan)
    assert np.isnan(shifts_of(a, a, moved_points(a, unknown), one, beta)).all()


def test_a_deformation_counts_from_its_mean(a: Adjustment) -> None:
    X = a.estimate.points
    every, _ = object_fields(X)
    for family, own in (("strain", every[:, :, :5]), ("bending", every[:, :, 5:])):
        beta = np.arange(1.0, own.shape[2] + 1)
        one = alternative(family, factor=(0, 0, 0, 0, 0, 1))
        away = 5 / 6 * own @ beta
        right = fit_similarity(X + 1e-6 * away, X).apply(X + 1e-6 * away) - X
        np.testing.assert_allclose(one.family.displaced(one, X, beta), 1e6 * right, rtol=0.01, atol=0.02)
    one = alternative("c")
    assert not one.family.displaced(one, X, np.ones(1)).any()
    one = alternative("moved", points=(1, 3))
    away = one.family.displaced(one, X, np.arange(1.0, 7.0))
    assert away[[1, 3]].tolist() == [[1, 2, 3], [4, 5, 6]] and np.count_nonzero(away) == 6


# ---- the choice ----


def test_causes() -> None:
    def cause(one: Alternative) -> tuple[object, ...]:
        return one.family.cause(one)

    assert cause(alternative("c")) == cause(alternative("camera"))
    assert cause(alternative("c")) != cause(alternative("c", factor=(0, 0, 1, 1, 1, 1)))
    assert cause(alternative("strain")) == cause(alternative("bending")) == cause(alternative("moved"))
    assert cause(alternative("strain")) != cause(alternative("strain", "linear"))
    assert cause(alternative("held", parameters=((0, 1),))) == ("held", False)
    assert cause(alternative("held", parameters=((0, 1), (0, 2)))) == ("held", True)
    assert cause(alternative("held", parameters=((0, 1), (1, 1)))) == ("held", False)
    assert cause(alternative("c", "each")) == cause(alternative("centre", "each")) == ("camera", "each")
    assert cause(alternative("given", parameters=((0, 1),))) == ("given", False)
    assert cause(alternative("format")) == ("format",)


def test_the_free_network_is_the_adjustment_itself_where_nothing_else_was_observed(
    a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = np.zeros(len(a.rejected), dtype=bool)
    out[3] = True
    tested = replace(a, rejected=out)
    assert free_network(tested) is tested
    assert free_network(a) is not a  # gross errors may have been kept
    for other in ({"inflation": 1.2}, {"undetermined": ("X0",)}):
        assert free_network(replace(tested, **other)) is not None  # type: ignore[arg-type]
    assert free_network(replace(a, redundancy=2)) is not None
    for wrong in (
        {"converged": False},
        {"sigma0": 0.0},
        {"sigma0": float("nan")},
        {"redundancy": 1},
    ):
        assert free_network(replace(a, **wrong)) is None  # type: ignore[arg-type]
    assert judge_alternatives(replace(a, converged=False)) == JudgedAssumptions()
    assert contradicted_parameters(replace(a, converged=False)) == ()
    bars = ScaleBars(np.array([0]), np.array([1]), np.array([9.0]), np.array([1e-3]))
    final = replace(a, network=a.network.with_given(bars), sigma0=5.0)
    free = free_network(final)
    assert free is not None and len(free.network.scale_bars) == 0 and free.sigma0 < 2
    fixed = free_network(replace(a, datum="control"))
    assert fixed is not None and fixed is not a and fixed.datum == "free"
    k = len(a.rejected)
    monkeypatch.setattr(hypotheses, "MAX_IMAGE_POINTS", k)
    assert free_network(tested) is tested
    monkeypatch.setattr(hypotheses, "MAX_IMAGE_POINTS", k // 2)
    half = free_network(tested)
    assert half is not None and 6 < len(half.network.points) < len(a.network.points)


def test_of_a_large_network_the_points_of_most_rays_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Until each photograph has its share: here of six photographs ten image points each."""
    large, truth = make_network(seed_of("large"), images=6, points=40, visibility=0.6, free=("c",))
    a = adjust(large, truth, datum=Datum("free"), reject="none")
    seen = a.network.image_points
    rays = np.bincount(seen.point)
    monkeypatch.setattr(hypotheses, "MAX_IMAGE_POINTS", 60)
    network, estimate, rows = hypotheses._sample(a.network, a.estimate, hypotheses.MAX_IMAGE_POINTS)
    assert len(seen) > 60 and len(network.images) == 6
    kept = np.isin(a.network.points, network.points)
    count = np.bincount(seen.image[rows], minlength=6)
    assert count.min() >= 10 and rows.sum() < 60 + 6 * 4
    np.testing.assert_array_equal(rows, kept[seen.point])
    assert rays[kept].min() >= np.median(rays[~kept])
    np.testing.assert_array_equal(estimate.points, a.estimate.points[kept])
    np.testing.assert_array_equal(network.image_points.xy, seen.xy[rows])
    monkeypatch.setattr(hypotheses, "MAX_IMAGE_POINTS", len(seen))
    assert hypotheses._sample(a.network, a.estimate, hypotheses.MAX_IMAGE_POINTS)[2].all()


def test_very_many_photographs_are_tested_in_parts(a: Adjustment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hypotheses, "find_causes", lambda *_: ())
    monkeypatch.setattr(hypotheses, "unchecked_assumptions", lambda *_: ())
    monkeypatch.setattr(hypotheses, "MAX_PHOTOGRAPHS", 6)
    assert [one.kind for one in judge_alternatives(a).unchecked] == ["assumptions_tested"]
    monkeypatch.setattr(hypotheses, "MAX_PHOTOGRAPHS", 5)
    (one,) = judge_alternatives(a).unchecked
    assert one.kind == "assumptions_tested" and one.number("parts") == 1
    assert "image point" not in one.text
    count = len(a.network.image_points)
    monkeypatch.setattr(hypotheses, "PART_IMAGE_POINTS", 60)
    (of_parts,) = judge_alternatives(a).unchecked
    monkeypatch.setattr(hypotheses, "MAX_PHOTOGRAPHS", 6)
    monkeypatch.setattr(hypotheses, "MAX_IMAGE_POINTS", 60)
    (of_whole,) = judge_alternatives(a).unchecked
    for said in (of_parts, of_whole):
        sample, total = said.number("sample"), said.number("image_points")
        assert 60 <= sample < total <= count and f"with {sample:.0f} image points of {total:.0f}" in said.text
    monkeypatch.setattr(hypotheses, "MAX_PHOTOGRAPHS", 5)
    monkeypatch.setattr(hypotheses, "free_network", None)  # is not asked for
    assert contradicted_parameters(a) == ()


def test_each_camera_of_two_photographs_is_named() -> None:
    network = SimpleNamespace(images=tuple("abcde"), camera=np.array([0, 0, 0, 1, 1]))
    cameras = tuple(SimpleNamespace(shared_name=name) for name in ("A", "B"))
    final: Any = SimpleNamespace(network=network, estimate=SimpleNamespace(cameras=cameras))
    (said,) = hypotheses._calibrated_from_few(final)
    assert said.names("camera") == ("B",) and said.names("photographs") == ("d", "e")


@pytest.mark.parametrize(("given", "tested"), [(3, 0), (4, 1), (7, 1)])
def test_four_given_points_have_a_shape_that_the_image_points_test(given: int, tested: int) -> None:
    network, truth = make_network(seed_of("shape"), images=6, points=14, free=("c",))
    control = ObjectPoints(np.arange(given), truth.points[:given], np.tile(1e-8 * np.eye(3), (given, 1, 1)))
    network = network.with_given(control)
    held = adjust(network, truth, datum=Datum("control"), reject="none")
    free = adjust(without_given(network), truth, datum=Datum("free"), reject="none")
    found = hypotheses._with_free_shape(held, free)
    assert len(found) == tested
    for one, refitted in found:
        assert one.points.tolist() == list(range(given)) and refitted.beta.shape == (3 * given,)


@pytest.mark.parametrize(("px", "said"), [(0.8e-3, False), (1.4e-3, True)])
def test_what_no_measurement_shows_is_no_part_of_a_remark(a: Adjustment, px: float, said: bool) -> None:
    """A thousandth of a pixel: of c at the edge, of the principal point, and of one photograph."""
    both = remark(a, alternative("centre"), [px, px, 0.0, 1.0])
    assert ("change" in both.numbers) == ("away" in both.numbers) == said
    drift = remark(a, alternative("c", "linear", (-1, -0.6, -0.2, 0.2, 0.6, 1)), [px / 2])
    assert ("change" in drift.numbers) == said  # from the first photograph to the last
    beta = np.zeros((6, 4))
    beta[2] = px * 6 / 5  # from the mean of six photographs
    beta[2, 2] = 0.0
    each = remark(a, alternative("centre", "each", (0, 1, 2, 3, 4, 5)), beta.ravel().tolist())
    for part in ("change", "away", "distortion"):
        assert (part in each.numbers) == said


def test_the_largest_part_of_a_camera_of_each_photograph_is_stated(a: Adjustment) -> None:
    beta = np.zeros((6, 9))
    beta[1, 3], beta[4, 8] = 2.4, -3.6
    every = remark(a, alternative("camera", "each", (0, 1, 2, 3, 4, 5)), beta.ravel().tolist())
    assert every.number("distortion") == pytest.approx(3.0)
    assert "change" not in every.numbers and "away" not in every.numbers


def test_rows_of_a_shutter_displace_by_their_speed(a: Adjustment) -> None:
    """2 px at the edge of 1,000 px are so many over all rows; a zoom of all photographs is none."""
    rows = next(one for one in families.OF_EACH if one.name == "rows")
    beta = np.zeros((6, 3))
    beta[:, 0] = 1.0  # of c
    beta[3] = (4.0, 0.0, 2.0)
    beta[5] = (1.0, 0.0, 1.7)
    one = Alternative(rows, "each", np.arange(6.0), Gain(9.0, 18, np.ones(18)))
    said = remark(a, one, beta.ravel().tolist())
    speed = np.hypot(beta[:, 0] - 1.5, beta[:, 2])
    assert said.number("skew") == pytest.approx(2 * speed.max() * 1500 / 2000)
    assert said.names("photographs") == tuple(
        a.network.images[i] for i in np.flatnonzero(speed >= speed.max() / 2)
    )
    assert said.names("photographs") == ("image 4", "image 6")
