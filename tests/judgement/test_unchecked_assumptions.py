"""How far an assumption may be wrong before a test names it: against image points with errors so large."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment, ErrorCorrelation
from sfm.adjustment.solve import adjust
from sfm.judgement.hypotheses import alternatives, families
from sfm.judgement.hypotheses import refit as unchecked
from sfm.judgement.hypotheses.alternatives import count_alternatives, interiors, needed_gain
from sfm.judgement.hypotheses.columns import interior_columns
from sfm.judgement.hypotheses.refit import reach_of, unchecked_assumptions
from sfm.judgement.hypotheses.score import reduce_adjustment
from sfm.model.conventions import FloatArray
from sfm.model.remarks.remark import of_kind
from sfm.model.similarity import fit_similarity, without_motions
from sfm.survey.inputs.sources import TEXTURE
from tests.synthetic import make_network, observed_anew, seed_of


def adjusted(points: int = 30, images: int = 10, noise_px: float = 0.1) -> Adjustment:
    network, truth = make_network(
        seed_of("unchecked"), images=images, points=points, planar=False, free=("c", "x0", "y0")
    )
    network = observed_anew(network, truth, noise_px, seed_of("unchecked noise"))
    return adjust(network, truth, datum=Datum("free"), reject="none")


def test_the_gain_that_is_needed_is_that_of_the_test_and_of_the_price() -> None:
    # 1 parameter, 2 image points: ln 4 / 2 and ln 100 in ln likelihood; the test asks for more with many rows
    assert needed_gain(1, 2, 0.0, 1, 0.01) == pytest.approx(np.log(4) + 2 * np.log(100))
    assert needed_gain(1, 2, 0.0, 10_000, 0.01) == pytest.approx(stats.chi2.isf(1e-6, 1))
    assert needed_gain(1, 2, np.log(100), 100, 0.01) == pytest.approx(
        max(stats.chi2.isf(1e-6, 1), np.log(4) + 4 * np.log(100))
    )
    assert needed_gain(3, 500, 2.0, 30, 0.01) == pytest.approx(3 * np.log(1000) + 4.0 + 2 * np.log(100))


def shift_of(a: Adjustment, moved_px: FloatArray) -> tuple[float, float]:
    """Return the shift in standard deviations by a change of the image points, and the gain of v'Pv."""
    seen = a.network.image_points
    exact = replace(seen, xy=seen.xy + a.residuals)
    start = adjust(replace(a.network, image_points=exact), a.estimate, datum=Datum("free"), reject="none")
    moved = replace(a.network, image_points=replace(exact, xy=exact.xy + moved_px))
    found = adjust(moved, a.estimate, datum=Datum("free"), reject="none")
    X, Y = start.estimate.points, found.estimate.points
    sigma = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    away = fit_similarity(Y, X).apply(Y) - X
    return float((np.abs(away) / sigma).max()), float((found.vPv - start.vPv) / a.sigma0**2)


@pytest.mark.parametrize("name", ["K1", "K2", "b1"])
def test_a_held_parameter_shifts_coordinates_by_its_reach(name: str) -> None:
    """The found noncentrality is that of 80 %; the shift of one parameter is the reach itself."""
    a = adjusted()
    reduced = reduce_adjustment(a)
    s = a.estimate.cameras[0].names.index(name)
    one = next(one for one in interiors(reduced, families.HELD) if one.parameters == ((0, s),))
    reach = reach_of(one, reduced, rows=count_alternatives(a))
    D = interior_columns(a, [(0, s)])[0][:, :, 0]
    H = float(reduced.project(reduced.whiten(D[:, :, None]))[0][0, 0])
    needed = needed_gain(1, len(D), 0.0, count_alternatives(a), 0.01)
    least = next(x for x in np.linspace(needed, 2 * needed, 2000) if stats.ncx2.sf(needed, 1, x) > 0.8)
    shift, gained = shift_of(a, D * np.sqrt(least / H))
    assert gained == pytest.approx(least, rel=0.02)
    assert reach == pytest.approx(shift, rel=0.1)
    strict = replace(a, false_alarm=a.false_alarm / 1e6)
    assert reach_of(one, replace(reduced, adjustment=strict), rows=count_alternatives(a)) > 1.2 * reach


def test_common_errors_let_a_held_parameter_reach_farther() -> None:
    """By the square root of the design effect, with which they multiply a gain by chance."""
    a = adjusted(points=100)
    correlation = ErrorCorrelation(alone=0.1, common=0.9, length_px=300.0)
    textured = replace(a, network=replace(a.network, sources=(TEXTURE,)), error_correlation=correlation)
    one = families.Alternative(families.HELD, "all", np.ones(10), parameters=((0, 7),))  # b1
    reduced, common = reduce_adjustment(a), reduce_adjustment(textured)
    effect = common.design_effect(one.whitened(common))
    reach, farther = (reach_of(one, which, rows=1) for which in (reduced, common))
    assert effect > 2 and farther / reach == pytest.approx(np.sqrt(effect))


def test_the_worst_strain_reaches_as_far_as_its_displacement() -> None:
    """No direction of the family reaches farther at the same noncentrality, and one nearly as far."""
    a = adjusted()
    reduced = reduce_adjustment(a)
    one = next(one for one in unchecked._typical(a) if one.family is families.STRAIN)
    assert one.factor.tolist() == [0] * 5 + [1] * 5 and one.search == pytest.approx(np.log(7))
    reach = reach_of(one, reduced, rows=count_alternatives(a))
    D = one.whitened(reduced)
    H = reduced.project(D)[0]
    needed = needed_gain(5, int((D != 0).any(axis=(1, 2)).sum()), one.search, count_alternatives(a), 0.01)
    least = next(x for x in np.linspace(needed / 2, 2 * needed, 3000) if stats.ncx2.sf(needed, 5, x) > 0.8)
    sigma = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    rng, farthest = seed_of("directions"), 0.0
    for _ in range(3000):
        beta = rng.standard_normal(5)
        beta *= np.sqrt(least / (beta @ H @ beta))
        away = np.abs(one.family.displaced(one, a.estimate.points, beta)) / sigma
        farthest = max(farthest, float(away.max()))
    assert 0.8 * reach < farthest < 1.01 * reach


def test_what_a_photograph_alone_may_hide_is_priced_by_its_image_points() -> None:
    """Another c in the last of ten photographs moves a tenth of the image points."""
    a = adjusted()
    reduced = reduce_adjustment(a)
    factor = (np.arange(10) == 9).astype(float)
    one = families.Alternative(families.CAMERA_FAMILIES[0], "single", factor)
    D = one.whitened(reduced)
    H = float(reduced.project(D)[0][0, 0])
    count = int((a.network.image_points.image == 9).sum())
    needed = needed_gain(1, count, 0.0, 1, 0.01)
    least = next(x for x in np.linspace(needed, 3 * needed, 30000) if stats.ncx2.sf(needed, 1, x) > 0.8)
    X, sigma = a.estimate.points, np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2))
    moved = without_motions(X, reduced.absorb(D)[0] * np.sqrt(least / H))
    expected = float((np.abs(moved[:, :, 0]) / sigma).max())
    assert reach_of(one, reduced, rows=1) == pytest.approx(expected, rel=2e-3)


def test_weak_networks_say_what_they_cannot_test_and_strong_ones_nothing() -> None:
    assert unchecked_assumptions(adjusted(points=80, images=16)) == ()
    weak = unchecked_assumptions(adjusted(points=12, images=5))
    assert {"constant cameras", "constant object"} <= {one.tested[0] for one in weak}
    for one in weak:
        assert one.severity == "note" and one.number("sigmas") > 5
    few = unchecked_assumptions(adjusted(points=9, images=3))
    assert all(one.tested[0] != "constant object" for one in few)  # of three photographs none is a part


def test_distortion_bends_what_is_photographed_from_one_side() -> None:
    """Three photographs of a plane do not show K1; x0, as good as their angles, shifts nothing either."""
    network, truth = make_network(seed_of("one side"), images=3, points=15, planar=True, free=())
    rotation = np.tile(truth.rotation[0], (3, 1, 1))
    position = truth.position[0] + np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0.3, 0]])
    truth = replace(truth, rotation=rotation, position=position)
    network = observed_anew(network, truth, 0.1, seed_of("one side noise"))
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    found = of_kind(unchecked_assumptions(a), "held_weakly_tested")
    assert len(found) == 1
    assert found[0].names("camera") == ("camera 1",)
    assert "K1" in found[0].names("parameters") and "x0" not in found[0].names("parameters")


def test_a_parameter_that_nothing_determines_counts_by_what_it_shifts() -> None:
    """Not without end: 1e-5 of the squares of its column is what rounding leaves."""
    a = adjusted()
    reduced = reduce_adjustment(a)
    one = next(unchecked._typical(a))
    H = reduced.project(one.whitened(reduced))[0]
    blind = SimpleNamespace(
        adjustment=a,
        columns=reduced.columns,
        whiten=reduced.whiten,
        absorb=reduced.absorb,
        design_effect=reduced.design_effect,
        project=lambda D: (1e-12 * H, np.zeros(1), reduced.project(D)[2]),
    )
    rows = count_alternatives(a)
    far = reach_of(one, blind, rows=rows)  # type: ignore[arg-type]
    share = float(H[0, 0] / reduced.project(one.whitened(reduced))[2][0])
    assert far == pytest.approx(reach_of(one, reduced, rows=count_alternatives(a)) * np.sqrt(share / 1e-5))


def test_cameras_of_few_photographs_are_checked_too() -> None:
    """Of two photographs or one, nothing shows that the camera changed between them."""
    network, truth = make_network(seed_of("few of a camera"), images=8, points=40, cameras=2, free=("c",))
    for own, pattern in ((2, ""), (3, "single"), (1, "")):
        camera = (np.arange(8) >= 8 - own).astype(np.int64)
        a = adjust(replace(network, camera=camera), truth, datum=Datum("free"), reject="none")
        found = [
            one
            for one in unchecked._typical(a)
            if one.among is not None and one.among.sum() == own and one.family.of_camera
        ]
        assert {one.pattern for one in found} == ({pattern} if pattern else set())
        assert all(np.flatnonzero(one.factor).tolist() == [7] for one in found)
        assert all(one.search == pytest.approx(np.log(own)) for one in found)
        others = [
            one
            for one in unchecked._typical(a)
            if one.among is not None and one.among.sum() == 8 - own and one.family.of_camera
        ]
        assert {one.pattern for one in others} == {"split"}
        assert all(one.search == pytest.approx(np.log(8 - own - 3)) for one in others)


def test_cameras_too_many_to_test_are_not_taken_for_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, more than 60 cameras counted as one, of which some photographs might have another one."""
    monkeypatch.setattr(alternatives, "MAX_RUNS", 4)
    network, truth = make_network(seed_of("61"), images=10, points=30, cameras=5, free=("c",))
    for cameras, untested in ((5, True), (4, False)):
        camera = np.minimum(np.arange(10) % 5, cameras - 1)
        a = adjust(replace(network, camera=camera), truth, datum=Datum("free"), reject="none")
        every = alternatives.alternatives_of(reduce_adjustment(a))
        of_camera = [one for one in every if isinstance(one.family, families.CameraFamily)]
        assert bool(of_camera) != untested
        said = of_kind(unchecked_assumptions(a), "cameras_untested")
        assert [one.number("cameras") for one in said] == ([5] if untested else [])
