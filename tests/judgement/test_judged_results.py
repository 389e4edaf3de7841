"""What a verdict says of a result, question by question: given values, checks, rays and scale."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.unknowns import NO_START
from sfm.adjustment.quality.consistency import Consistency, Uneven
from sfm.adjustment.quality.other_solutions import OtherSolution
from sfm.adjustment.quality.statistics import more_than_chance
from sfm.adjustment.result import Adjustment, ErrorCorrelation
from sfm.adjustment.solve import adjust
from sfm.judgement import verdict as verdicts
from sfm.judgement.bundle_statistics import Given, statistics_of
from sfm.judgement.checks import ControlCoordinate, LongestResidual, sigma0_of
from sfm.judgement.survey_result import PhotographTargets, SurveyResult
from sfm.model.distributions import normal_ppf
from sfm.model.network import ScaleBars
from sfm.model.observation_residuals import CENTRE, ROTATION, GivenResiduals
from sfm.model.remarks.remark import Remark, kinds_of, of_kind, remark
from tests.synthetic import make_network, seed_of

LEVEL = 1e-3


@pytest.fixture(scope="module")
def a() -> Adjustment:
    network, truth = make_network(seed_of("judged results"), images=6, points=14, free=("c",))
    return adjust(network, truth, datum=Datum("free"), reject="none")


def result_of(a: Adjustment, unit: str = "m", **parts: Any) -> SurveyResult:
    return SurveyResult("judged", unit, 6, (), a, np.full(len(a.network.points), -1), None, **parts)


def test_what_has_no_start_is_no_rank_defect(a: Adjustment) -> None:
    """It took no part, and with it the defect is another one."""
    absent = replace(a, undetermined=(f"point 7{NO_START}",), defect=a.expected_defect + 3)
    assert verdicts.convergence_remarks(absent) == ()
    (said,) = verdicts.convergence_remarks(replace(absent, undetermined=(f"7{NO_START}", "c of camera A")))
    assert said.kind == "rank_defect" and said.names("undetermined") == ("c of camera A",)
    (said,) = verdicts.convergence_remarks(replace(a, defect=a.expected_defect + 3))
    assert said.names("undetermined") == () and said.number("defect") == a.expected_defect + 3
    assert kinds_of(verdicts.convergence_remarks(replace(a, converged=False))) == ("not_converged",)


def test_the_rejected_share_is_of_what_took_part(a: Adjustment) -> None:
    rejected = np.arange(len(a.rejected)) % 4 == 0
    (said,) = of_kind(verdicts.convergence_remarks(replace(a, rejected=rejected)), "image_points_rejected")
    assert said.number("rejected") == rejected.sum() and said.number("total") == len(rejected)
    assert said.number("share") == pytest.approx(0.25, abs=0.02)
    points = a.estimate.points.copy()
    points[:7] = np.nan
    part = replace(a, rejected=rejected, estimate=replace(a.estimate, points=points))
    took_part = a.network.image_points.point >= 7
    (said,) = of_kind(verdicts.convergence_remarks(part), "image_points_rejected")
    assert said.number("total") == took_part.sum()
    assert said.number("rejected") == (rejected & took_part).sum()


def of_kind_named(kind: str, w: Any, r: Any, *, d: int = 1) -> GivenResiduals:
    """Return residuals of given values with these w and redundancy numbers, (n, d) each."""
    w, r = (np.array(one, dtype=float).reshape(-1, d) for one in (w, r))
    n = len(w)
    names, unit = tuple(f"v{k}" for k in range(n)), tuple(("m",) * d for _ in range(n))
    difference = 1e-3 * w
    return GivenResiduals(
        kind, ("X", "Y", "Z")[:d], names, unit, np.ones((n, d)), difference, np.full((n, d), 1e-3), r, w
    )


def differing(kind: GivenResiduals) -> list[Remark]:
    return list(verdicts._differing(Given((kind,)), LEVEL))


@pytest.mark.parametrize("count", [1, 4, 40])
def test_the_value_that_differs_most_must_exceed_the_chance_of_all(count: int) -> None:
    critical = -normal_ppf(LEVEL / (2 * count))
    for sign, factor, said in ((1, 0.98, False), (-1, 1.02, True), (1, 1.02, True)):
        w = [*[0.5] * (count - 1), sign * factor * critical]
        found = differing(of_kind_named("scale bar", w, [0.5] * count))
        assert bool(found) == said
        for one in found:
            assert f"v{count - 1}" in one.text and one.number("sigmas") == pytest.approx(factor * critical)
            assert one.number("difference") == pytest.approx(factor * critical * 1e-3)


def test_the_shift_by_a_value_is_that_of_the_adjusted_one() -> None:
    """|w| sqrt((1 - r) / r): of a value that the others hardly check it is many times w."""
    (said,) = differing(of_kind_named("scale bar", [9.0, 1.0], [0.2, 0.8]))
    assert said.number("shift") == said.number("harm") == pytest.approx(9 * 2)
    (said,) = differing(of_kind_named("control point", [[1.0, -9.0, 2.0]], [[0.5, 0.8, 0.5]], d=3))
    assert "Y" in said.text and said.number("shift") == pytest.approx(9 / 2)
    (said,) = differing(of_kind_named("height difference", [9.0], [0.5]))
    assert said.number("harm") == pytest.approx(9.0)
    for kind in (CENTRE, ROTATION):  # neither a coordinate nor a length of the object
        (said,) = differing(of_kind_named(kind, [[1.0, -9.0, 2.0]], [[0.5, 0.8, 0.5]], d=3))
        assert said.number("harm") == 0 and "shift" not in said.numbers
    assert differing(of_kind_named("scale bar", [np.nan, 1.0], [0.5, 0.5])) == []


def checked(point: str, coordinate: str, test: float, difference: float) -> ControlCoordinate:
    return ControlCoordinate("check", point, coordinate, 1.0, 0.1, 1.0 + difference, 0.1, difference, test)


def test_check_points_share_the_level_and_are_counted_once() -> None:
    """Of five coordinates of three points, one without a test."""
    beyond, within = (factor * -normal_ppf(LEVEL / (2 * 5)) for factor in (1.02, 0.98))
    some = [
        checked("A", "X", within, 0.5),
        checked("A", "Y", -1.0, 0.4),
        checked("B", "Z", -within, -0.3),
        checked("C", "X", 0.0, 0.0),
        checked("C", "Z", 2.0, 0.1),
        checked("D", "X", np.nan, 9.0),
    ]
    assert verdicts._checks(some, "m", LEVEL) == ()
    assert verdicts._checks([], "m", LEVEL) == ()
    some[2] = checked("B", "Z", -beyond, -0.3)
    (said,) = verdicts._checks(some, "m", LEVEL)
    assert said.names("points") == ("B",) and said.names("coordinates") == ("Z",)
    assert (said.number("count"), said.number("all"), said.number("more")) == (1, 3, -1)
    assert said.number("distance") == pytest.approx(0.3) and said.number("sigmas") == pytest.approx(beyond)
    assert said.severity == "warning"
    some[0] = checked("A", "X", 2 * beyond, 0.5)
    some[1] = checked("A", "Y", -beyond, -0.6)
    (said,) = verdicts._checks(some, "m", LEVEL)
    assert said.names("points") == ("A", "B") and said.names("coordinates") == ("X", "Y", "Z")
    assert (said.number("more"), said.number("distance")) == (1, pytest.approx(0.6))
    assert said.number("sigmas") == pytest.approx(2 * beyond) and said.severity == "error"


def test_points_that_lost_many_rays_are_listed_and_those_of_two_counted(a: Adjustment) -> None:
    """A point of two rays keeps its errors, unless its coordinates are given."""
    seen, n = a.network.image_points, len(a.network.points)
    rejected = np.zeros(len(a.rejected), dtype=bool)
    for j, lost in ((2, 4), (5, 4), (7, 1)):
        rejected[np.flatnonzero(seen.point == j)[:lost]] = True
    part = replace(a, rejected=rejected)
    tested, third = verdicts.ray_remarks(part)
    expected = more_than_chance(
        np.bincount(seen.point[rejected], minlength=n), np.bincount(seen.point), a.levels.family
    )
    assert tested.names("points") == tuple(a.network.points[j] for j in np.flatnonzero(expected))
    assert set(tested.names("points")) >= {"3", "6"} and "8" not in tested.names("points")
    assert tested.number("tested") == len(rejected) and tested.number("more") == expected.sum()
    assert (third.kind, third.number("two"), third.number("total")) == ("third_ray_missing", 2, n)
    given = part.network.with_control(["3"], a.estimate.points[2:3])
    _, third = verdicts.ray_remarks(replace(part, network=given, datum="control"))
    assert third.number("two") == 1
    (tested,) = verdicts.ray_remarks(a)
    assert tested.number("more") == 0 and tested.names("points") == ()


@pytest.mark.parametrize(("distance", "implausible"), [(11e-3, False), (9e-3, True)])
def test_an_object_nearer_than_its_image_is_implausible(distance: float, implausible: bool) -> None:
    """c = 10 mm: at a distance of 10 mm the image is as large as the object, which is macrophotography."""
    a, unit, c = of_distance(distance), "m", 10e-3
    found = verdicts._scale(result_of(a, unit))
    assert bool(found) == implausible
    for one in found:
        assert one.number("distance") == pytest.approx(1e3 * distance, rel=0.05)
        assert one.number("magnification") == pytest.approx(c / distance, rel=0.05)
        assert one.severity == "error"
    metres = replace(a.estimate, points=1e3 * a.estimate.points, position=1e3 * a.estimate.position)
    in_mm = replace(a, estimate=metres)
    assert bool(verdicts._scale(result_of(in_mm, "mm"))) == implausible
    assert verdicts._scale(result_of(a, "")) == ()
    free = replace(a, network=a.network.with_given(ScaleBars()))
    assert verdicts._scale(result_of(free, unit)) == ()  # nothing gives a scale


def of_distance(distance: float) -> Adjustment:
    """Return an adjustment whose nearest photograph is so far from the object, the others twice, m."""
    network, truth = make_network(seed_of("distance"), images=4, points=14, free=("c",))
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    depth = []
    for i in range(4):
        d = (a.estimate.points - a.estimate.position[i]) @ a.estimate.rotation[i]
        depth.append(float(np.median(-d[a.network.image_points.point[a.network.image_points.image == i], 2])))
    scale = distance / min(depth)
    estimate = replace(a.estimate, points=scale * a.estimate.points, position=scale * a.estimate.position)
    return replace(a, estimate=estimate, network=a.network.with_scale_bar("1", "2", 1.0, 1e-3))


def test_pixels_have_no_magnification() -> None:
    network, truth = make_network(seed_of("in pixels"), images=4, points=14, model="opencv", free=("fx",))
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    near = replace(
        a,
        estimate=replace(a.estimate, points=1e-3 * a.estimate.points, position=1e-3 * a.estimate.position),
        network=a.network.with_scale_bar("1", "2", 1.0, 1e-3),
    )
    assert verdicts._scale(result_of(near, "m")) == ()


@pytest.mark.parametrize(("reflected", "named"), [(True, 2), (False, 1)])
def test_the_farthest_other_solution_of_each_sort_is_stated(
    reflected: bool, named: int, a: Adjustment
) -> None:
    truth = a.estimate
    some = (
        OtherSolution("A", 12.0, "mm", False, 3.0, 4.0, 1.0, truth, True),
        OtherSolution("B", 14.0, "mm", reflected, 2.0, 4.0, 1.0, truth, True),
        OtherSolution("C", 13.0, "mm", False, 5.0, 4.0, 1.0, truth, True),
    )
    found = verdicts.other_solution_remarks(result_of(a, other_solutions=some))
    assert len(found) == named
    assert found[0].number("moved") == max(one.moved for one in some if not one.reflected)
    assert [one.names("reversed") for one in found[1:]] == [("object",)] * (named - 1)


@pytest.mark.parametrize(("common", "stated"), [(1.4, False), (1.6, True)])
def test_errors_in_common_are_stated_where_they_exceed_the_others(
    common: float, stated: bool, a: Adjustment
) -> None:
    """Those of a window alone count as often as windows share them."""
    shared = ErrorCorrelation(alone=0.5, common=common, length_px=300.0, design_effect=3.0)
    high = replace(a, error_correlation=shared, sigma0=50.0)
    sigma0 = replace(sigma0_of(a), ratio=50.0)
    (_, said) = verdicts.sigma0_remarks(sigma0, high)
    assert ("common" in said.numbers) == ("length" in said.numbers) == stated


def test_the_test_of_sigma0_is_of_the_accepted_coordinates(a: Adjustment) -> None:
    rejected = np.arange(len(a.rejected)) < 3
    (tested,) = verdicts.sigma0_remarks(sigma0_of(a), replace(a, rejected=rejected))
    assert tested.number("tested") == 2 * (len(rejected) - 3)


def test_an_unknown_residual_is_no_long_one() -> None:
    long = LongestResidual("i", "p", 9.0, 40.0, 1.0)
    assert kinds_of(verdicts.residual_remarks(long)) == ("residual_kept",)
    assert verdicts.residual_remarks(replace(long, over_sigma=float("inf"))) == ()
    assert verdicts.residual_remarks(replace(long, over_sigma=float("nan"))) == ()


def test_only_points_that_a_person_can_correct_are_remarks() -> None:
    doubtful = tuple(SimpleNamespace(point=name) for name in ("A", "auto 1"))
    found: Any = Consistency((), Uneven(1e-6, "image 3", 3.0, 1.5), tested=9)
    found = replace(found, doubtful=doubtful, large=("A", "auto 2"))
    outlying = found.outlying
    said = verdicts.consistency_remarks(found, 4, automatic=frozenset({"auto 1", "auto 2"}))
    (one,) = of_kind(said, "points_doubtful")
    assert one.names("points") == ("A",)
    (one,) = of_kind(said, "photographs_uneven")
    assert one.number("ratio") == 2.0 and one.names("photograph") == ("image 3",)
    (one,) = of_kind(said, "points_tested")
    assert (one.number("tested"), one.number("larger")) == (9, 2) and len(one.names("points")) == 2
    (one,) = of_kind(said, "doubtful_tested")
    assert (one.number("tested"), one.number("doubtful")) == (4, 2)
    assert all(
        "auto" not in name
        for one in of_kind(said, "points_with_large_residuals")
        for name in one.names("points")
    )
    assert set(outlying) <= {"A", "auto 2"}


@pytest.mark.parametrize(
    ("images", "rejected", "oriented", "kinds"),
    [(6, (), 6, ()), (6, (), 5, ("photographs_missing",))],
)
def test_a_photograph_without_start_is_missing(
    images: int, rejected: tuple[int, ...], oriented: int, kinds: tuple[str, ...], a: Adjustment
) -> None:
    position = a.estimate.position.copy()
    position[oriented:] = np.nan
    part = replace(a, estimate=replace(a.estimate, position=position))
    verdict = verdicts._verdict_of_adjustment(part, rejects=True)
    assert kinds_of(of_kind(verdict.remarks, "photographs_missing")) == kinds
    assert f"{oriented} of {images} photographs" in verdict.headline
    for one in of_kind(verdict.remarks, "photographs_missing"):
        assert one.number("share") == pytest.approx((images - oriented) / images)


@pytest.mark.parametrize("measured", [False, True])
def test_only_given_image_points_have_stated_standard_deviations(
    measured: bool, a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of measured ones are the program's."""
    said = remark("image_sigmas", count=9, points=["1"], stated=(0.1, "px"), factor=3.0, rejected=0.0)
    monkeypatch.setattr(verdicts, "stated_precision_remarks", lambda _: (said,))
    photograph: Any = SimpleNamespace(image="image 1", blur=None, camera="")
    verdict = verdicts.judge_survey(result_of(a, photographs=(photograph,) if measured else ())).verdict
    assert bool(of_kind(verdict.remarks, "image_sigmas")) != measured


@pytest.mark.parametrize(("bars", "named"), [(1, False), (5, True)])
def test_a_kind_of_given_values_that_scatters_more_than_stated_is_named(bars: int, named: bool) -> None:
    """Not a single value, and none of a kind that was judged against the free network."""
    rng = seed_of("scattering bars")
    network, truth = make_network(rng, images=6, points=14, free=("c",))
    start, end = np.arange(bars), np.arange(bars) + 7
    length = np.linalg.norm(truth.points[end] - truth.points[start], axis=1)
    off = 0.02 * np.array([1.0, -1.0, 1.0, -1.0, 1.0])[:bars]
    given = ScaleBars(start, end, length + off, np.full(bars, 1e-3))
    network = network.with_control(network.points[:8], truth.points[:8], 1e-3)
    a = adjust(network.with_given(given), truth, datum=Datum("control"), reject="none")
    statistics = statistics_of(a)
    found = [one for one in verdicts._kinds(statistics, set(), LEVEL) if one.names("of") == ("scale bars",)]
    assert len(found) == named
    for one in found:
        place = statistics.kinds.names.index("scale bars")
        assert (
            one.number("factor") == pytest.approx(statistics.kinds.sigma0[place]) and one.number("factor") > 5
        )
    others = verdicts._kinds(statistics, {"scale"}, LEVEL)
    assert ("scale bars",) not in [one.names("of") for one in others]


def test_the_level_is_shared_by_the_kinds_that_are_tested(
    a: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Image points are no given values; each side of a test has the level of the question."""
    asked = []
    monkeypatch.setattr(verdicts, "component_tests", lambda kinds, alpha: asked.append(alpha) or ())
    for names in (("image points",), ("image points", "bars"), ("image points", "bars", "control")):
        statistics: Any = SimpleNamespace(kinds=SimpleNamespace(names=names))
        assert verdicts._kinds(statistics, set(), LEVEL) == ()
    assert asked == pytest.approx([2 * LEVEL, 2 * LEVEL, LEVEL])


def test_a_result_counts_its_coded_points(a: Adjustment) -> None:
    code = np.where(np.arange(len(a.network.points)) < 5, np.arange(len(a.network.points)), -1)
    result = replace(result_of(a), code=code)
    assert "14, 5 coded" in str(result) and "14, 0 coded" in str(result_of(a))


def test_an_overlay_was_stored_if_all_its_image_points_were() -> None:
    def part(k: int, stored: bool, **more: Any) -> PhotographTargets:
        of, none = np.full((k, 2), float(k)), np.zeros((0, 2))
        return PhotographTargets(
            "1", Path("1.jpg"), of, of, of[:, 0], none, np.zeros(0, np.int64), stored=stored, **more
        )

    for first, second in ((True, True), (True, False), (False, True), (False, False)):
        joined = part(2, first, flag=np.array([1, 2])).with_more(part(3, second, blur=np.full(3, 0.5)))
        assert joined.stored == (first and second) and len(joined.xy) == len(joined.angle) == 5
        assert joined.flag is not None and joined.flag.tolist() == [1, 2, 0, 0, 0]
        assert joined.blur is not None and np.isnan(joined.blur).tolist() == [True] * 2 + [False] * 3
