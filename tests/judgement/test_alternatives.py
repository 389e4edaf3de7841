"""The score test of alternatives: against a dense elimination, and on systems small enough to do by hand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from math import comb
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.conventions import FloatArray, IntArray
from sfm.judgement.hypotheses import alternatives, columns, families, hypotheses, moved, refit, score
from sfm.judgement.hypotheses import moved as patterns
from sfm.judgement.hypotheses.alternatives import (
    alternatives_of,
    is_significant,
)
from sfm.judgement.hypotheses.columns import Columns, columns_of, interior_columns
from sfm.judgement.hypotheses.families import Alternative
from sfm.judgement.hypotheses.score import (
    NONE,
    Gain,
    Reduced,
    Spread,
    gain_of,
    least_share,
    log_f_sf,
    log_likelihood_gain,
    log_probability,
    reduce_adjustment,
)
from sfm.network import ImagePoints, InteriorObservations
from tests.survey.faults import planted
from tests.synthetic import make_network, observed_anew, seed_of

NO_POINTS = np.zeros(0, dtype=np.int64)


def test_a_gain_is_that_of_determined_parameters() -> None:
    found = gain_of(np.diag([4.0, 2.0]), np.array([2.0, 3.0]), np.array([8.0, 8.0]))
    assert (found.value, found.rank) == (pytest.approx(1.0 + 4.5), 2)
    np.testing.assert_allclose(found.beta, [-0.5, -1.5])
    # of a column photographs, cameras and points take all but 1e-5 of the squares
    assert gain_of(np.diag([1.0, 1.5e-5]), np.ones(2), np.ones(2)).rank == 2
    assert gain_of(np.diag([1.0, 0.7e-5]), np.ones(2), np.ones(2)).rank == 1
    assert gain_of(np.array([[2e-8]]), np.ones(1), np.ones(1), least_share(1)).rank == 1
    assert gain_of(np.array([[1e-8]]), np.ones(1), np.ones(1), least_share(1)).rank == 0
    assert least_share(2) == 1e-5
    none = gain_of(np.zeros((1, 1)), np.zeros(1), np.zeros(1))
    assert (none.value, none.rank, none.beta.tolist()) == (0.0, 0, [0.0])


def test_probability_and_likelihood_of_a_gain() -> None:
    assert log_likelihood_gain(50.0, 100) == pytest.approx(50 * np.log(2))
    assert log_likelihood_gain(200.0, 100) > 1e4
    assert log_probability(50.0, 5, 100) == pytest.approx(stats.f.logsf(10 * 95 / 50, 5, 95))
    assert log_probability(3.0, 5, 5) == log_probability(3.0, 0, 5) == 0.0
    assert log_probability(3.0, 4, 5) < 0
    assert log_probability(5.0, 4, 5) == -np.inf
    # beyond the floats, for q = 2 in closed form: ln p = -d/2 ln(1 + 2 f / d)
    for f, d in ((2000.0, 2000), (900.0, 4000), (1e6, 300)):
        assert log_f_sf(f, 2, d) == pytest.approx(-d / 2 * np.log1p(2 * f / d), rel=1e-12)
    for f, q, d in (
        (400.0, 7, 1500),
        (300.0, 9, 2000),
        (250.0, 12, 900),
    ):  # -1 to -1.5 thousand, by its integral
        assert log_f_sf(f, q, d) == pytest.approx(_log_tail(f, q, d), rel=1e-6)


def _log_tail(f: float, q: int, d: int) -> float:
    """Return ln of the integral of the density of F beyond f, with t = ln of the variable."""
    t = np.log(f) + np.linspace(0, 0.5, 200_001)
    log_density = stats.f.logpdf(np.exp(t), q, d) + t
    top = log_density.max()
    return float(top + np.log(np.trapezoid(np.exp(log_density - top), t)))


# ---- against a dense elimination ----


@dataclass(frozen=True)
class Dense:
    """The whitened columns of all unknowns, and what they leave of others."""

    a: Adjustment
    columns: Columns
    reduced: Reduced
    Q: FloatArray  # orthonormal base of the unknowns' columns, prior rows at the end
    prior: float  # residual of the given c, whitened
    every: tuple[Alternative, ...]
    spreads: dict[int, Spread]  # with which each was judged, by its identity

    def left(self, D: FloatArray) -> FloatArray:
        """Return what the unknowns leave of whitened columns (k, 2, q), (2 k, q)."""
        flat = np.concatenate(
            [D.reshape(-1, D.shape[2]), np.zeros((len(self.Q) - D.size // D.shape[2], D.shape[2]))]
        )
        return flat - self.Q @ (self.Q.T @ flat)

    def normals(self, D: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        left = self.left(D)
        flat = D.reshape(-1, D.shape[2])
        v = np.append(self.reduced.v.ravel(), self.prior)
        v = v - self.Q @ (self.Q.T @ v)
        return left.T @ left, left.T @ v, (flat**2).sum(axis=0)


@pytest.fixture(scope="module")
def dense() -> Dense:
    """A network of two cameras and correlated coordinates; two points move together, some take no part.

    Every point moves a little by itself, and every photograph has its scale, so that there is a spread.
    """
    rng = seed_of("dense")
    network, truth = make_network(rng, images=7, points=20, cameras=2, visibility=0.85, free=("c",))
    xyz = truth.points.copy()
    first = observed_anew(network, truth, 0.1, rng)
    xyz += rng.normal(0, 2.5e-4, xyz.shape)
    xyz[[2, 17]] += (0.006, -0.005, 0.003)
    second = observed_anew(network, replace(truth, points=xyz), 0.1, rng)
    seen = network.image_points
    xy = np.where(seen.image[:, None] >= 4, second.image_points.xy, first.image_points.xy)
    xy += rng.normal(0, 3e-4, 7)[seen.image][:, None] * (xy - (999.5, 749.5))
    covariance = 0.01 * np.tile([[1.3, 0.4], [0.4, 0.8]], (len(seen), 1, 1))
    given = InteriorObservations(np.array([0]), np.array([0]), np.array([10.0]), np.array([2e-3]))
    network = replace(network, image_points=replace(seen, xy=xy, covariance=covariance), interior=given)
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    # some take no part: the others are then no optimum, as after the last round of an adjustment
    out = np.zeros(len(seen), dtype=bool)
    out[[5, 30]] = True
    a = replace(a, rejected=out, redundancy=a.redundancy - 4)
    every = columns_of(a)
    reduced = reduce_adjustment(a, every)
    k, m, n = len(reduced.used), 7, 20
    A = np.zeros((k, 2, 6 * m + 2 + 3 * n))
    rows = np.arange(k)
    for c in range(6):
        A[rows, :, 6 * reduced.image + c] = (reduced.F @ every.exterior[reduced.used])[:, :, c]
    for c in range(3):
        A[rows, :, 6 * m + 2 + 3 * reduced.point + c] = (reduced.F @ every.point[reduced.used])[:, :, c]
    for index in range(2):
        A[:, :, 6 * m + index] = reduced.whiten(interior_columns(a, index, [0]))[:, :, 0]
    flat = A.reshape(2 * k, -1)
    prior = np.zeros((1, flat.shape[1]))
    prior[0, 6 * m] = columns.interior_step(a, 0, 0) / 2e-3 / a.sigma0
    U, d, _ = np.linalg.svd(np.concatenate([flat, prior]), full_matrices=False)
    assert int((d < 1e-9 * d[0]).sum()) == 7
    spreads: dict[int, Spread] = {}
    judge = patterns.score_alternative

    def recorded(*given: Any, **parts: Any) -> Alternative:
        one = judge(*given, **parts)
        spreads[id(one)] = next((part for part in given if isinstance(part, Spread)), NONE)
        kept.append(one)  # so that no identity comes twice
        return one

    kept: list[Alternative] = []
    with pytest.MonkeyPatch.context() as patch:
        one_camera = np.zeros(7, dtype=np.int64)  # all photographs in every pattern
        patch.setattr(alternatives, "cameras_of_photographs", lambda a: one_camera)
        for module in (alternatives, moved):
            patch.setattr(module, "score_alternative", recorded)
        found = alternatives_of(a, reduced, every)
    residual = (float(a.estimate.cameras[0].parameters[0]) - 10.0) / 2e-3 / a.sigma0
    return Dense(a, every, reduced, U[:, d > 1e-9 * d[0]], residual, found, spreads)


def test_without_redundancy_only_rejected_image_points_have_a_likelihood() -> None:
    """Five points in two photographs fit any relative orientation; it was a division by zero."""
    network, truth = make_network(seed_of("no redundancy"), images=2, points=5, free=())
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    assert a.redundancy == 0
    assert refit.log_likelihood_of(a) == refit.log_likelihood_of(a, freed=3) == 0
    rejected = np.arange(len(network.image_points)) < 2
    width, height = truth.cameras[0].size_px
    found = refit.log_likelihood_of(replace(a, rejected=rejected))
    assert found == pytest.approx(-2 * np.log(width * height))


def test_whitening_makes_coordinates_independent_of_unit_variance(dense: Dense) -> None:
    r = dense.reduced
    assert r.used.tolist() == np.flatnonzero(~dense.a.rejected).tolist() and r.count == 2 * len(r.used)
    P = np.linalg.inv(dense.a.image_covariance[r.used]) / dense.a.sigma0**2
    np.testing.assert_allclose(np.swapaxes(r.F, 1, 2) @ r.F, P)
    np.testing.assert_allclose(r.v, np.einsum("kab,kb->ka", r.F, dense.a.residuals[r.used]))


def test_elimination_is_that_of_a_dense_solution(dense: Dense) -> None:
    D = dense.reduced.whiten(dense.columns.freedoms)
    for found, right in zip(dense.reduced.project(D), dense.normals(D), strict=True):
        np.testing.assert_allclose(found, right, atol=1e-7 * np.abs(right).max())
    for run in (np.arange(7), np.array([0, 0, 1, 1, 1, 2, 3])):
        right = dense.normals(_by_photograph(D, run[dense.reduced.image], run[-1] + 1))
        for found, own in zip(dense.reduced.project_by_run(D, run), right, strict=True):
            np.testing.assert_allclose(found.reshape(own.shape), own, atol=1e-7 * np.abs(own).max())


def test_given_values_of_free_parameters_have_weight(dense: Dense) -> None:
    """Not those of held parameters, nor fixed ones; a group of cameras has one column and all its weights."""
    given = InteriorObservations(
        np.array([0, 0, 1]), np.array([0, 1, 0]), np.array([10.0, 0.03, 10.2]), np.array([2e-3, 1e-3, 0.0])
    )
    a = replace(dense.a, network=replace(dense.a.network, interior=given))
    weight = (columns.interior_step(a, 0, 0) / 2e-3 / a.sigma0) ** 2
    found, prior, slope = score._free_interior(a)
    assert found.shape[2] == 2 and prior.tolist() == [pytest.approx([weight, 0.0]), [0.0, 0.0]]
    off = float(a.estimate.cameras[0].parameters[0]) - 10.0
    assert slope == pytest.approx([np.sqrt(weight) * off / 2e-3 / a.sigma0, 0.0])
    group = tuple(replace(one, shared=("lens",) * len(one.names)) for one in a.estimate.cameras)
    a = replace(a, estimate=replace(a.estimate, cameras=group))
    both, prior, _ = score._free_interior(a)
    units = [columns.interior_step(a, index, 0) for index in range(2)]  # of the first, mm for a column
    np.testing.assert_allclose(both[:, :, 0], found[:, :, 0] + units[0] / units[1] * found[:, :, 1])
    assert both.shape[2] == 1 and prior == pytest.approx(weight)
    held = tuple(alternatives.interiors(a, dense.reduced, families.HELD))
    assert [len(one.parameters) for one in held] == [
        *[2] * (len(held) - 1),
        2 * len(a.estimate.cameras[0].names) - 2,
    ]
    np.testing.assert_allclose(
        held[0].columns(a, dense.columns)[:, :, 0],
        interior_columns(a, 0, [1])[:, :, 0]
        + columns.interior_step(a, 0, 1)
        / columns.interior_step(a, 1, 1)
        * interior_columns(a, 1, [1])[:, :, 0],
    )
    fixed = tuple(replace(one, free=np.zeros_like(one.free)) for one in a.estimate.cameras)
    a = replace(a, estimate=replace(a.estimate, cameras=fixed))
    none, prior, _ = score._free_interior(a)
    assert none.shape == (len(a.rejected), 2, 0) and len(prior) == 0


def test_scores_are_slopes_of_each_photograph(dense: Dense) -> None:
    D = dense.reduced.whiten(dense.columns.freedoms[:, :, [0, 3]])
    left = dense.left(D)[: 2 * len(D)].reshape(len(D), 2, 2)
    slope = ((dense.reduced.v + left[:, :, 1]) * left[:, :, 0]).sum(axis=1)
    right = np.bincount(dense.reduced.image, slope, minlength=7)
    np.testing.assert_allclose(
        dense.reduced.scores(D[:, :, 0], D[:, :, 1]), right, atol=1e-7 * np.abs(right).max()
    )


def _judged(one: Alternative, dense: Dense, spread: Spread) -> tuple[float, float, float]:
    """Return ln p, price and evidence of an alternative by its definition."""
    r, q, gain = dense.reduced.redundancy, one.gain.rank, one.gain.value
    if not q:
        return 0.0, one.search, -one.search
    on = one.factor[dense.reduced.image] != 0
    if len(one.points):
        on &= np.isin(dense.reduced.point, one.points)
    price = q / 2 * np.log(2 * max(on.sum(), 2)) + one.search
    log_p = float(stats.f.logsf(gain / q * (r - q) / (r - gain), q, r - q))
    evidence = r / 2 * np.log(r / (r - gain))
    if spread.factor > 1:
        f = gain / q / spread.factor / ((r - gain) / r)
        log_p = max(log_p, float(stats.f.logsf(f, q, spread.redundancy)))
        d = spread.redundancy
        among = d / 2 * np.log(1 + f * q / d)
        evidence = min(evidence, among) if spread.among else r / 2 * np.log(r / (r - gain / spread.factor))
    return log_p, price, evidence - price


def _by_photograph(D: FloatArray, image: IntArray, m: int) -> FloatArray:
    """Return columns (k, 2, f) as those of each photograph, (k, 2, m f)."""
    by = np.zeros((*D.shape[:2], m, D.shape[2]))
    by[np.arange(len(D)), :, image] = D
    return by.reshape(len(D), 2, -1)


def _assert_judged(one: Alternative, dense: Dense, spread: Spread) -> None:
    found = dense.spreads[id(one)]
    assert found.factor == pytest.approx(spread.factor, rel=1e-4)
    assert (found.redundancy, found.among) == (spread.redundancy, spread.among)
    assert (one.log_p, one.price, one.evidence) == pytest.approx(_judged(one, dense, spread), rel=1e-4)


def test_every_alternative_has_the_gain_of_its_columns(dense: Dense) -> None:
    every = dense.every
    assert [one.evidence for one in every] == sorted((one.evidence for one in every), reverse=True)
    plain = [one.family.name for one in every if one.pattern != "group"]
    count = {family: plain.count(family) for family in plain}
    assert count == {
        "held": 20, "given": 1, "format": 1, "c": 4, "centre": 4, "camera": 4, "strain": 3, "bending": 3,
        "moved": 1, "shifted": 1,
    }  # fmt: skip
    for one in every:
        H, g, squares = dense.normals(dense.reduced.whiten(one.columns(dense.a, dense.columns)))
        single = isinstance(one.family, families.InteriorFamily)
        right = gain_of(H, g, squares, least_share(len(H)) if single else least_share(2))
        assert one.gain.rank == right.rank, one.family.name
        assert one.gain.value == pytest.approx(right.value, rel=1e-5), (one.family.name, one.pattern)


def test_patterns_are_the_best_of_their_kind(dense: Dense) -> None:
    """By trying all of them; ln of how many there are is the price of the search."""
    every = {(one.family.name, one.pattern): one for one in dense.every}
    m, places = 7, {one.name: one.places for one in families.OF_PHOTOGRAPHS}
    for family in ("c", "centre", "strain"):
        D = dense.reduced.whiten(dense.columns.freedoms[:, :, list(places[family])])

        def gain(factor: IntArray, D: FloatArray = D) -> float:
            return gain_of(*dense.normals(np.asarray(factor)[dense.reduced.image][:, None, None] * D)).value

        splits = [np.arange(m) >= k for k in (2, 3, 4, 5)]
        one = every[family, "split"]
        assert one.gain.value == pytest.approx(max(map(gain, splits)), rel=1e-5)
        assert one.search == pytest.approx(np.log(4)) and one.factor.sum() in (2, 3, 4, 5)
        if family != "strain":
            one = every[family, "single"]
            assert one.gain.value == pytest.approx(max(map(gain, np.eye(m))), rel=1e-5)
            assert one.search == pytest.approx(np.log(m)) and one.factor.sum() == 1
        normals = dense.normals(_by_photograph(D, dense.reduced.image, m))
        q = D.shape[2]
        part = patterns.Part(
            normals[0].reshape(m, q, m, q), normals[1].reshape(m, q), normals[2].reshape(m, q)
        )
        for pattern in ("split", "linear", "alternating", "single"):
            if (family, pattern) != ("strain", "single"):
                one = every[family, pattern]
                spread = part.spread(one.factor, one.gain)
                if pattern == "single":
                    own = alternatives._variance_of(dense.reduced, one.factor > 0, one.gain)
                    spread = replace(spread, factor=max(spread.factor, own))
                _assert_judged(one, dense, spread)
        if family == "strain":
            continue
        one = every[family, "group"]
        groups = [np.array(some) for some in product((0, 1), repeat=m) if 2 <= sum(some) <= 5]
        assert one.gain.value == pytest.approx(max(map(gain, groups)), rel=1e-5)
        assert one.search == pytest.approx(6 * np.log(2))
        assert every[family, "linear"].factor == pytest.approx(np.linspace(-1, 1, m))
        assert every[family, "alternating"].factor.tolist() == [0, 1, 0, 1, 0, 1, 0]
        assert every[family, "linear"].search == every[family, "alternating"].search == 0


def test_a_camera_differs_in_photographs_of_its_own_only() -> None:
    """Two cameras taking turns, the second one zoomed between: each by itself, by all its patterns."""
    rng = seed_of("two cameras")
    network, truth = make_network(rng, images=10, points=25, cameras=2, free=("c",))
    zoomed = replace(truth.cameras[1], parameters=truth.cameras[1].parameters * ([1.02] + [1.0] * 9))
    third = replace(network, camera=np.where(np.arange(10) >= 6, network.camera * 2, network.camera))
    moved = observed_anew(third, replace(truth, cameras=(*truth.cameras, zoomed)), 0.05, rng)
    network = replace(moved, camera=network.camera)
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    assert alternatives.cameras_of_photographs(a).tolist() == [0, 1] * 5
    every_columns = columns_of(a)
    reduced = reduce_adjustment(a, every_columns)
    every = alternatives.alternatives_of(a, reduced, every_columns)
    found = [one for one in every if isinstance(one.family, families.CameraFamily) and one.pattern != "each"]
    for one in found:
        assert len({int(network.camera[i]) for i in np.flatnonzero(one.factor)}) == 1
        assert len({int(network.camera[i]) for i in one.photographs}) == 1
    D = reduced.whiten(every_columns.freedoms[:, :, :1])

    def gain(factor: FloatArray) -> float:
        return gain_of(*reduced.project(factor[reduced.image][:, None, None] * D)).value

    for camera in (0, 1):
        own = np.arange(10) % 2 == camera
        of_camera = {one.pattern: one for one in found if one.family.name == "c" and one.factor[own].any()}
        splits = [own & (np.cumsum(own) > k) for k in (2, 3)]
        assert of_camera["split"].gain.value == pytest.approx(max(gain(one * 1.0) for one in splits))
        assert of_camera["split"].search == pytest.approx(np.log(2))
        groups = [some for some in product((0.0, 1.0), repeat=5) if 2 <= sum(some) <= 3]
        largest = 0.0
        for some in groups:
            factor = np.zeros(10)
            factor[own] = some
            largest = max(largest, gain(factor))
        assert of_camera["group"].gain.value == pytest.approx(largest)
        assert of_camera["group"].search == pytest.approx(4 * np.log(2))
    best = next(one for one in every if one.kind == "other_camera")
    assert best.photographs.tolist() == [7, 9]
    cause = hypotheses.find_causes(a)[0]
    named = hypotheses.remark_of(a, cause, "m")
    assert named.subjects["camera"] == ("camera 2",)
    assert named.subjects["photographs"] == tuple(network.images[i] for i in (7, 9))
    assert named.number("change") == pytest.approx(2.0, abs=0.1)


def zoomed_pair(which: int) -> Adjustment:
    """Return six photographs of one camera, and two of another, one of which has c 2 % longer."""
    rng = seed_of("two cameras")
    network, truth = make_network(rng, images=8, points=40, cameras=2, free=("c",))
    camera = np.array([0] * 6 + [1] * 2)
    longer = replace(truth.cameras[1], parameters=truth.cameras[1].parameters * ([1.02] + [1.0] * 9))
    own = np.where(np.arange(8) == which, 2, camera)
    moved = observed_anew(
        replace(network, camera=own), replace(truth, cameras=(*truth.cameras, longer)), 0.05, rng
    )
    return adjust(replace(moved, camera=camera), truth, datum=Datum("free"), reject="none")


def test_of_two_photographs_of_a_camera_neither_is_blamed() -> None:
    """Before, the second one was, whichever had another c."""
    for which, sign in ((6, -1), (7, 1)):
        a = zoomed_pair(which)
        columns = columns_of(a)
        reduced = reduce_adjustment(a, columns)
        every = alternatives.alternatives_of(a, reduced, columns)
        one = next(one for one in every if one.kind == "two_cameras" and one.family.name == "c")
        found = refit.refit(a, one, a)
        assert found is not None
        parts = one.family.parts(one, found.adjustment, found.beta, "m")
        assert parts["photographs"] == ("image 7", "image 8")
        assert parts["change"][0] == pytest.approx(2.0 * sign, abs=0.1)
        assert abs(len(every) - alternatives.count_alternatives(a)) <= 5


@pytest.mark.parametrize("which", [6, 7])
def test_a_zoomed_photograph_of_two_is_reported_from_a_camera_that_varies(which: int) -> None:
    """Before, image 7 was not: c moved no distortion, whose errors c of every photograph took up."""
    cause = hypotheses.find_causes(zoomed_pair(which))[0]
    assert cause.alternative.kind == "two_cameras" and cause.as_well == ()


def test_alternatives_are_counted_by_cameras() -> None:
    """Before, 30 were assumed of any network of eight cameras of five photographs; 12 have no gain."""
    rng = seed_of("many")
    network, truth = make_network(rng, images=40, points=40, cameras=8, free=("c",))
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    columns = columns_of(a)
    every = alternatives.alternatives_of(a, reduce_adjustment(a, columns), columns)
    count = alternatives.count_alternatives(a)
    held = sum(one.family.name == "held" for one in every)
    assert held == 8 * (9 + 1)  # each parameter of a camera, and all of them
    assert count == 215 and 0 <= count - len(every) <= 12
    assert alternatives.count_alternatives(a, bodies=3) == count + 3


def test_gains_that_might_be_named_are_divided_by_the_effect_of_correlation() -> None:
    def of_gain(gain: float) -> Any:
        return SimpleNamespace(
            gain=SimpleNamespace(value=gain),
            price=0.0,
            evidence=gain,
            columns=lambda *_: None,
            with_design_effect=lambda effect, redundancy: SimpleNamespace(evidence=gain / effect),
        )

    reduced: Any = SimpleNamespace(redundancy=100, design_effect=lambda _: 2.0, whiten=lambda by: by)
    for correlation, evidence in ((0.1, [45.0, 1.0]), (None, [90.0, 1.0])):
        reduced.correlation = correlation
        found = alternatives._by_evidence(reduced, reduced, reduced, [of_gain(1.0), of_gain(90.0)])
        assert [one.evidence for one in found] == evidence


def test_runs_are_of_one_camera_and_in_the_order_of_the_sequence() -> None:
    camera = np.arange(150) % 2
    run = patterns.runs_of(camera)
    assert run.max() + 1 == 60 and all(len(set(camera[run == k])) == 1 for k in range(60))
    middle = [np.flatnonzero(run == k).mean() for k in range(60)]
    assert middle == sorted(middle)
    assert patterns.runs_of(np.zeros(150, dtype=np.int64)).tolist() == (np.arange(150) * 60 // 150).tolist()
    assert patterns.runs_of(np.zeros(7, dtype=np.int64)).tolist() == list(range(7))


def test_held_parameters_are_judged_by_what_photographs_say_of_them(dense: Dense) -> None:
    """The spread is the smaller one of two: with the parameter free, and with all of its camera."""
    every = [one for one in dense.every if one.family is families.HELD]
    assert sorted(len(one.parameters) for one in every)[-3:] == [1, 9, 9]
    for one in every:
        D = dense.reduced.whiten(one.columns(dense.a, dense.columns))
        owner = next(
            other
            for other in every
            if len(other.parameters) > 1 and set(one.parameters) <= set(other.parameters)
        )
        whole = dense.reduced.whiten(owner.columns(dense.a, dense.columns))
        direction = D @ one.gain.beta
        variance = float(one.gain.beta @ dense.normals(D)[0] @ one.gain.beta)
        spreads = [
            alternatives._of_scores(dense.reduced.scores(direction, step), variance)
            for step in (direction, whole @ owner.gain.beta)
        ]
        spread = min(spreads, key=lambda one: one.factor)
        _assert_judged(one, dense, spread)
    one = next(one for one in dense.every if one.family is families.FORMAT)
    D = dense.reduced.whiten(one.columns(dense.a, dense.columns))
    scores = dense.reduced.scores(D @ one.gain.beta, D @ one.gain.beta)
    spread = alternatives._of_scores(scores, float(one.gain.beta @ dense.normals(D)[0] @ one.gain.beta))
    _assert_judged(one, dense, spread)


def test_moved_points_are_found_with_their_evidence(dense: Dense) -> None:
    moved, shifted = (
        next(one for one in dense.every if one.family is family)
        for family in (families.MOVED, families.SHIFTED)
    )
    assert set(shifted.points.tolist()) == set(moved.points.tolist()) == {2, 17}
    for one in (moved, shifted):
        assert one.factor.tolist() == [0, 0, 0, 0, 1, 1, 1] and one.pattern == "split"
        assert one.photographs.tolist() == [4, 5, 6]
        seen = [np.bincount(dense.reduced.point[dense.reduced.image >= 4], minlength=20),
                np.bincount(dense.reduced.point[dense.reduced.image < 4], minlength=20)]  # fmt: skip
        movable = np.flatnonzero(np.minimum(*seen) >= 2)
        assert one.search == pytest.approx(np.log(4) + np.log(comb(len(movable), 2)))
    after = np.where((dense.reduced.image >= 4)[:, None, None], dense.reduced.B, 0.0)
    normals = [
        dense.normals(np.where((dense.reduced.point == j)[:, None, None], after, 0.0)) for j in movable
    ]
    others = [gain_of(*one).value for j, one in zip(movable, normals, strict=True) if j not in (2, 17)]
    spread = Spread(float(np.mean(others)) / 3, 3 * len(others))
    _assert_judged(moved, dense, spread)
    beta = shifted.gain.beta
    left = [
        gain_of(H, g + (H @ beta if j in (2, 17) else 0.0), np.diagonal(H))
        for j, (H, g, _) in zip(movable, normals, strict=True)
    ]
    redundancy = sum(one.rank for one in left) - 3
    spread = Spread(sum(one.value for one in left) / redundancy, redundancy)
    _assert_judged(shifted, dense, spread)


@pytest.mark.parametrize(
    ("images", "patterns"),
    [(2, {"pair"}), (3, {"single"}), (4, {"single", "split", "linear", "alternating"})],
)
def test_of_few_photographs_there_are_fewer_patterns(images: int, patterns: set[str]) -> None:
    """A group of two of four is a split or as good as one; of fewer only one photograph may differ."""
    network, truth = make_network(seed_of("few photographs"), images=images, points=14, free=())
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    every = columns_of(a)
    found = alternatives_of(a, reduce_adjustment(a, every), every)
    assert {one.pattern for one in found if one.family in families.CAMERA_FAMILIES} == patterns
    assert any(one.family is families.MOVED for one in found) == (images == 4)


# ---- small enough to do by hand ----


def part(g: list[float], coupling: float = 0.0) -> patterns.Part:
    """Return normal equations of one parameter in each photograph, with a diagonal of 1."""
    m = len(g)
    H = ((1 - coupling) * np.eye(m) + coupling)[:, None, :, None]
    return patterns.Part(H, np.array(g)[:, None], np.ones((m, 1)))


def test_the_spread_is_of_what_a_pattern_leaves() -> None:
    one = part([5.0, 7.0, 1.0, -1.0])
    split = np.array([1.0, 1.0, 0.0, 0.0])
    gain = one.gain(split)
    assert (gain.value, gain.rank, gain.beta[0]) == (pytest.approx(72.0), 1, pytest.approx(-6.0))
    found = one.spread(split, gain)
    assert (found.factor, found.redundancy, found.among) == (pytest.approx(4 / 3), 3, True)
    single = np.array([0.0, 1.0, 0.0, 0.0])  # nothing is left where one photograph differs: of the others
    found = one.spread(single, one.gain(single))
    assert (found.factor, found.redundancy) == (pytest.approx(27 / 2), 2)
    assert part([5.0, 7.0]).spread(np.array([1.0, 0.0]), Gain(1.0, 1, np.ones(1))) == NONE
    assert part([5.0, 7.0]).spread(np.ones(2), Gain(1.0, 1, -np.ones(1))).redundancy == 1


@pytest.mark.parametrize("coupling", [-0.1, 0.0, 0.2])
def test_a_group_is_grown_to_the_one_of_the_largest_gain(coupling: float) -> None:
    for g in ([6.0, 0.5, 5.0, -0.3, 7.0, 0.2, -0.4], [-4.0, -5.0, 0.1, 0.2, 0.3, -6.0, 0.5]):
        one = part(g, coupling)
        factor, gain = one.group()
        every = [
            one.gain(np.array(some, dtype=float)).value for some in product((0, 1), repeat=7) if any(some)
        ]
        assert gain.value == pytest.approx(max(every))
        assert one.gain(factor).value == pytest.approx(gain.value)


def stub(**parts: Any) -> Any:
    return SimpleNamespace(**parts)


def made(gain: Gain, spread: Spread = NONE, *, points: IntArray = NO_POINTS) -> Alternative:
    """Return an alternative of 4 photographs with 10 image points each, at a redundancy of 60."""
    image = np.repeat(np.arange(4), 10)
    reduced = stub(redundancy=60, image=image, point=np.tile(np.arange(10), 4))
    pattern = patterns.Pattern("split", np.array([0.0, 0.0, 1.0, 1.0]), 0.7)
    return patterns.score_alternative(
        reduced, families.CAMERA_FAMILIES[0], pattern, gain, spread, points=points
    )


def test_the_price_is_by_the_image_points_that_are_touched() -> None:
    gain = Gain(20.0, 2, np.zeros(2))
    one = made(gain)
    assert one.price == pytest.approx(np.log(2 * 20) + 0.7) and one.search == 0.7
    assert one.evidence == pytest.approx(30 * np.log(60 / 40) - one.price)
    assert one.log_p == pytest.approx(stats.f.logsf(10 / (40 / 58), 2, 58))
    some = made(gain, points=np.array([3, 4, 5]))
    assert some.price == pytest.approx(np.log(2 * 6) + 0.7) and some.points.tolist() == [3, 4, 5]
    assert made(gain, points=np.array([99])).price == pytest.approx(np.log(4) + 0.7)


def test_a_spread_lowers_the_evidence() -> None:
    gain = Gain(20.0, 2, np.zeros(2))
    plain, f = made(gain), 10 / 4 / (40 / 60)
    assert made(gain, Spread(0.5, 3)).evidence == plain.evidence
    among = made(gain, Spread(4.0, 6))
    assert among.log_p == pytest.approx(stats.f.logsf(f, 2, 6))
    assert among.evidence == pytest.approx(3 * np.log(1 + 2 * f / 6) - plain.price)
    beside = made(gain, Spread(4.0, 6, among=False))
    assert beside.log_p == pytest.approx(among.log_p)
    assert beside.evidence == pytest.approx(30 * np.log(60 / 55) - plain.price)
    assert made(Gain(0.0, 0, np.zeros(0)), Spread(4.0, 6)).log_p == 0.0
    # no more than without: a spread that is hardly known, and a little over 1
    assert made(gain, Spread(1.01, 10**6)).log_p >= plain.log_p
    assert made(Gain(59.9, 2, np.zeros(2)), Spread(2.0, 6)).log_p == pytest.approx(
        stats.f.logsf(59.9 / 2 / 2 * 60, 2, 6)
    )


def test_spread_of_scores() -> None:
    found = alternatives._of_scores(np.array([1.0, 2.0, 3.0]), 7.0)
    assert (found.factor, found.redundancy, found.among) == (pytest.approx(14 / 7 * 3 / 2), 2, False)
    assert alternatives._of_scores(np.ones(1), 7.0) == NONE
    assert alternatives._of_scores(np.ones(2), 1.0).redundancy == 1


def test_variance_that_is_left_in_a_photograph() -> None:
    v = np.array([[1.0, 2.0], [3.0, 1.0], [2.0, 2.0], [9.0, 9.0]])
    reduced = stub(v=v, image=np.array([0, 0, 0, 1]), redundancy=6, count=8)
    # 6 coordinates with 6 * 6 / 8 expected, less one parameter
    assert alternatives._variance_of(
        reduced, np.array([True, False]), Gain(3.0, 1, np.zeros(1))
    ) == pytest.approx(20 / 3.5)
    assert alternatives._variance_of(reduced, np.array([True, False]), Gain(30.0, 1, np.zeros(1))) == 0.0
    assert alternatives._variance_of(
        reduced, np.array([False, True]), Gain(30.0, 4, np.zeros(4))
    ) == pytest.approx(132.0)


def test_points_of_three_photographs_have_no_place_to_move_at() -> None:
    few: Any = SimpleNamespace(photographs=3)
    assert list(moved.moved_points(few)) == []


def test_as_many_places_are_tried_as_can_be_afforded(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[float] = []
    monkeypatch.setattr(moved, "_moved_at", lambda _, factor, __: tried.append(factor.sum()) or ())
    monkeypatch.setattr(moved, "MAX_PRODUCTS", 3.5 * 6 * 100 * 126**2)
    large: Any = SimpleNamespace(photographs=20, L=np.zeros((100, 3, 3)), t=np.zeros(126))
    assert list(moved.moved_points(large)) == [] and len(tried) == 3


def test_a_camera_of_each_photograph_must_exceed_what_it_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the other freedoms of the photographs take once it is in: the gain of all less its own."""
    one = planted("stabiliser", 18)
    a = adjust(one.network, one.start, datum=Datum("free"), reject="none")
    columns = columns_of(a)
    reduced = reduce_adjustment(a, columns)
    m = reduced.photographs
    H, g, squares = reduced.project_by_run(reduced.whiten(columns.freedoms), np.arange(m))
    made: dict[str, Spread] = {}
    monkeypatch.setattr(
        alternatives, "score_alternative", lambda *given: made.update({given[1].name: given[4]}) or given[1]
    )
    list(alternatives._each(reduced, H, g, squares, np.arange(m)))
    size = g.size
    every = gain_of(H.reshape(size, size), g.ravel(), squares.ravel())
    for family in families.OF_EACH:
        if family.name not in made:
            continue
        some, spread = np.array(family.places), made[family.name]
        q = m * len(some)
        own = gain_of(H[:, some][:, :, :, some].reshape(q, q), g[:, some].ravel(), squares[:, some].ravel())
        assert spread.factor * spread.redundancy == pytest.approx(every.value - own.value, rel=0.05)
    assert "point" in made


def test_patterns_have_two_photographs_on_each_side() -> None:
    found = {name: (factors.tolist(), search) for name, factors, search in patterns.patterns_of(5)}
    assert found["single"] == (np.eye(5).tolist(), pytest.approx(np.log(5)))
    assert found["split"] == ([[0, 0, 1, 1, 1], [0, 0, 0, 1, 1]], pytest.approx(np.log(2)))
    assert found["linear"] == ([[-1, -0.5, 0, 0.5, 1]], 0.0)
    assert found["alternating"] == ([[0, 1, 0, 1, 0]], 0.0)


def test_cells_divide_the_format() -> None:
    xy = np.array([[0.0, 0.0], [1999.0, 1499.0], [1000.0, 290.0], [-0.4, 1500.4]])
    seen = ImagePoints(np.array([0, 0, 0, 0]), np.arange(4), xy, np.tile(np.eye(2), (4, 1, 1)))
    network = stub(image_points=seen, camera=np.zeros(1, dtype=int))
    D = families.format_columns(stub(network=network, estimate=stub(cameras=[stub(size_px=(2000, 1500))])))
    assert D.shape == (4, 2, 50)
    for row, cell in enumerate((0, 24, 2, 20)):
        assert np.flatnonzero(D[row, 0]).tolist() == [2 * cell] and D[row, 0, 2 * cell] == 1
        assert np.flatnonzero(D[row, 1]).tolist() == [2 * cell + 1] and D[row, 1, 2 * cell + 1] == 1


def test_the_level_is_shared_by_rows_and_lowered_by_the_search() -> None:
    limit = np.log(0.01 / 20) - 0.7
    one = made(Gain(20.0, 2, np.zeros(2)))
    assert is_significant(replace(one, log_p=limit - 0.5), 20)
    assert not is_significant(replace(one, log_p=limit + 0.5), 20)


def test_photographs_that_differ_are_the_fewer_ones() -> None:
    one = made(Gain(20.0, 2, np.zeros(2)))
    for factor, few in (([0, 1, 0], [1]), ([1, 0, 1], [1]), ([-1, 0, 1], [2]), ([1, 0, 0, 1], [0, 3])):
        assert replace(one, factor=np.array(factor, dtype=float)).photographs.tolist() == few


def test_more_points_are_tried_until_twice_as_many_and_four_more_gain_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Evidence falls at the second point and is largest at the third: eleven sets are tried."""
    network, truth = make_network(seed_of("moved sets"), images=10, points=40, free=())
    a = adjust(network, truth, datum=Datum("free"))
    reduced = reduce_adjustment(a, columns_of(a))
    tried: list[int] = []

    def scored(*_: object, points: IntArray) -> SimpleNamespace:
        tried.append(len(points))
        return SimpleNamespace(evidence={1: 5.0, 2: 4.0, 3: 9.0}.get(len(points), 1.0), points=points)

    monkeypatch.setattr(moved, "score_alternative", scored)
    found = next(moved._moved_at(reduced, np.repeat([0.0, 1.0], 5), 0.0))
    assert len(found.points) == 3 and tried == list(range(1, 12))
