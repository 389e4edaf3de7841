"""The score test of alternatives: against a dense elimination, and on systems small enough to do by hand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.correlated import correlated_sum
from sfm.adjustment.result import Adjustment, ErrorCorrelation
from sfm.adjustment.solve import adjust
from sfm.judgement.hypotheses import alternatives, families, hypotheses, refit, score
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
    determined_inverse,
    gain_of,
    least_share,
    log_likelihood_gain,
    log_probability,
    reduce_adjustment,
)
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.network import ImagePoints, InteriorObservations
from tests.synthetic import make_network, observed_anew, seed_of


def test_the_inverse_is_that_of_the_directions_that_are_determined() -> None:
    """Three columns, and a fourth one that is the difference of the first two."""
    rng = seed_of("determined")
    D = rng.standard_normal((50, 3)) * [1.0, 30.0, 0.02]
    H = D.T @ D
    np.testing.assert_allclose(determined_inverse(H, np.diagonal(H)), np.linalg.inv(H), rtol=1e-9)
    dependent = np.column_stack([D, D[:, 0] - D[:, 1] / 30.0])
    K = dependent.T @ dependent
    found = determined_inverse(K, np.diagonal(K))
    np.testing.assert_allclose(K @ found @ K, K, rtol=1e-7, atol=1e-7)


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
    network = replace(network, image_points=replace(seen, xy=xy, covariance=covariance)).with_given(given)
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    # some take no part: the others are then no optimum, as after the last round of an adjustment
    out = np.zeros(len(seen), dtype=bool)
    out[[5, 30]] = True
    a = replace(a, rejected=out, redundancy=a.redundancy - 4)
    every = columns_of(a)
    reduced = reduce_adjustment(a)
    k, m, n = len(reduced.used), 7, 20
    A = np.zeros((k, 2, 6 * m + 2 + 3 * n))
    rows = np.arange(k)
    for c in range(6):
        A[rows, :, 6 * reduced.image + c] = (reduced.F @ every.exterior[reduced.used])[:, :, c]
    for c in range(3):
        A[rows, :, 6 * m + 2 + 3 * reduced.point + c] = (reduced.F @ every.point[reduced.used])[:, :, c]
    for index in range(2):
        A[:, :, 6 * m + index] = reduced.whiten(interior_columns(a, [(index, 0)])[0])[:, :, 0]
    flat = A.reshape(2 * k, -1)
    prior = np.zeros((1, flat.shape[1]))
    prior[0, 6 * m] = interior_columns(a, [(0, 0)])[2][0] / 2e-3 / a.sigma0
    U, d, _ = np.linalg.svd(np.concatenate([flat, prior]), full_matrices=False)
    assert int((d < 1e-9 * d[0]).sum()) == 7
    with pytest.MonkeyPatch.context() as patch:
        one_camera = np.zeros(7, dtype=np.int64)  # all photographs in every pattern
        patch.setattr(alternatives, "cameras_of_photographs", lambda a: one_camera)
        found = alternatives_of(reduced)
    residual = (float(a.estimate.cameras[0].parameters[0]) - 10.0) / 2e-3 / a.sigma0
    return Dense(a, every, reduced, U[:, d > 1e-9 * d[0]], residual, found)


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
    a = replace(dense.a, network=dense.a.network.with_given(given))
    weight = (interior_columns(a, [(0, 0)])[2][0] / 2e-3 / a.sigma0) ** 2
    found, prior, slope = score._free_interior(a)
    assert found.shape[2] == 2 and prior.tolist() == [pytest.approx([weight, 0.0]), [0.0, 0.0]]
    off = float(a.estimate.cameras[0].parameters[0]) - 10.0
    assert slope == pytest.approx([np.sqrt(weight) * off / 2e-3 / a.sigma0, 0.0])
    group = tuple(replace(one, shared=("lens",) * len(one.names)) for one in a.estimate.cameras)
    a = replace(a, estimate=replace(a.estimate, cameras=group))
    both, prior, _ = score._free_interior(a)
    units = [interior_columns(a, [(index, 0)])[2][0] for index in range(2)]  # of the first, mm for a column
    np.testing.assert_allclose(both[:, :, 0], found[:, :, 0] + units[0] / units[1] * found[:, :, 1])
    assert both.shape[2] == 1 and prior == pytest.approx(weight)
    held = tuple(alternatives.interiors(replace(dense.reduced, adjustment=a), families.HELD))
    assert [len(one.parameters) for one in held] == [
        *[2] * (len(held) - 1),
        2 * len(a.estimate.cameras[0].names) - 2,
    ]
    (first, _, unit), (second, _, other) = (interior_columns(dense.a, [(index, 1)]) for index in (0, 1))
    np.testing.assert_allclose(held[0].columns(a, dense.columns), first + unit[0] / other[0] * second)
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


def _spread_along(reduced: Any, direction: FloatArray, step: FloatArray, variance: float) -> Spread:
    """Return the sum of squares of the scores of m photographs over m - 1 parts in m of their variance."""
    m, scores = reduced.photographs, reduced.scores(direction, step)
    return Spread((scores**2).sum() / (variance * (m - 1) / m), m - 1, among=False)


def _assert_judged(one: Alternative, dense: Dense, spread: Spread) -> None:
    found = one.spread
    assert found.factor == pytest.approx(spread.factor, rel=1e-4)
    assert (found.redundancy, found.among) == (spread.redundancy, spread.among)
    assert (one.log_p, one.price, one.evidence) == pytest.approx(_judged(one, dense, spread), rel=1e-4)


def test_every_alternative_has_the_gain_of_its_columns(dense: Dense) -> None:
    every = dense.every
    assert [one.evidence for one in every] == sorted((one.evidence for one in every), reverse=True)
    plain = [one.family.name for one in every]
    count = {family: plain.count(family) for family in plain}
    assert count == {
        "held": 20, "given": 1, "format": 1, "c": 5, "centre": 5, "camera": 5, "strain": 3, "bending": 3,
        "moved": 1, "body": 1,
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
        part = alternatives.Part(
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
    reduced = reduce_adjustment(a)
    every = alternatives.alternatives_of(reduced)
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
    best = next(one for one in every if one.kind == "other_camera")
    assert best.photographs.tolist() == [7, 9]
    cause = hypotheses.find_causes(a)[0]
    named = hypotheses.remark_of(a, cause, "m")
    assert named.subjects["camera"] == ("camera 2",)
    assert named.subjects["photographs"] == tuple(network.images[i] for i in (7, 9))
    assert named.number("change") == pytest.approx(2.0, abs=0.1)


def test_alternatives_are_counted_by_cameras() -> None:
    """Before, 30 were assumed of any network of eight cameras of five photographs; 13 have no gain."""
    rng = seed_of("many")
    network, truth = make_network(rng, images=40, points=40, cameras=8, free=("c",))
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    every = alternatives.alternatives_of(reduce_adjustment(a))
    count = alternatives.count_alternatives(a)
    held = sum(one.family.name == "held" for one in every)
    assert held == 8 * (9 + 1)  # each parameter of a camera, and all of them
    assert count == 214 and 0 <= count - len(every) <= 13


def test_runs_are_of_one_camera_and_in_the_order_of_the_sequence() -> None:
    camera = np.arange(150) % 2
    run = alternatives.runs_of(camera)
    assert run.max() + 1 == 60 and all(len(set(camera[run == k])) == 1 for k in range(60))
    middle = [np.flatnonzero(run == k).mean() for k in range(60)]
    assert middle == sorted(middle)
    assert (
        alternatives.runs_of(np.zeros(150, dtype=np.int64)).tolist() == (np.arange(150) * 60 // 150).tolist()
    )
    assert alternatives.runs_of(np.zeros(7, dtype=np.int64)).tolist() == list(range(7))


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
            _spread_along(dense.reduced, direction, step, variance)
            for step in (direction, whole @ owner.gain.beta)
        ]
        spread = min(spreads, key=lambda one: one.factor)
        _assert_judged(one, dense, spread)
    one = next(one for one in dense.every if one.family is families.FORMAT)
    D = dense.reduced.whiten(one.columns(dense.a, dense.columns))
    step, variance = D @ one.gain.beta, float(one.gain.beta @ dense.normals(D)[0] @ one.gain.beta)
    spread = _spread_along(dense.reduced, step, step, variance)
    _assert_judged(one, dense, spread)


def test_moved_points_are_found_with_their_evidence(dense: Dense) -> None:
    moved = next(one for one in dense.every if one.family is families.MOVED)
    assert set(moved.points.tolist()) == {2, 17}
    assert moved.factor.tolist() == [0, 0, 0, 0, 1, 1, 1] and moved.pattern == "split"
    assert moved.photographs.tolist() == [4, 5, 6]
    seen = [np.bincount(dense.reduced.point[dense.reduced.image >= 4], minlength=20),
            np.bincount(dense.reduced.point[dense.reduced.image < 4], minlength=20)]  # fmt: skip
    movable = np.flatnonzero(np.minimum(*seen) >= 2)
    assert moved.search == pytest.approx(np.log(4) + np.log(comb(len(movable), 2)))
    after = np.where((dense.reduced.image >= 4)[:, None, None], dense.reduced.B, 0.0)
    normals = [
        dense.normals(np.where((dense.reduced.point == j)[:, None, None], after, 0.0)) for j in movable
    ]
    others = [gain_of(*one).value for j, one in zip(movable, normals, strict=True) if j not in (2, 17)]
    spread = Spread(float(np.mean(others)) / 3, 3 * len(others))
    _assert_judged(moved, dense, spread)


@pytest.mark.parametrize(
    ("images", "patterns"),
    [(2, set()), (3, {"single"}), (4, {"single", "split", "linear", "alternating"})],
)
def test_of_few_photographs_there_are_fewer_patterns(images: int, patterns: set[str]) -> None:
    """Of two, neither differs from the other; of three, only one may."""
    network, truth = make_network(seed_of("few photographs"), images=images, points=14, free=())
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    found = alternatives_of(reduce_adjustment(a))
    assert {one.pattern for one in found if one.family in families.CAMERA_FAMILIES} == patterns
    assert any(one.family is families.MOVED for one in found) == (images == 4)


# ---- small enough to do by hand ----


def part(g: list[float], coupling: float = 0.0) -> alternatives.Part:
    """Return normal equations of one parameter in each photograph, with a diagonal of 1."""
    m = len(g)
    H = ((1 - coupling) * np.eye(m) + coupling)[:, None, :, None]
    return alternatives.Part(H, np.array(g)[:, None], np.ones((m, 1)))


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


def stub(**parts: Any) -> Any:
    return SimpleNamespace(**parts)


def made(gain: Gain, spread: Spread = NONE, *, points: IntArray | None = None) -> Alternative:
    """Return an alternative of 4 photographs with 10 image points each, at a redundancy of 60."""
    image = np.repeat(np.arange(4), 10)
    reduced = stub(redundancy=60, image=image, point=np.tile(np.arange(10), 4))
    after, none = np.array([0.0, 0.0, 1.0, 1.0]), np.zeros(0, dtype=np.int64)
    family = families.CAMERA_FAMILIES[0]
    some = none if points is None else points
    return Alternative(family, "split", after, gain, spread, 0.7, some).priced(reduced)


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


def test_patterns_have_two_photographs_on_each_side() -> None:
    of_camera = {name: f.tolist() for name, f in alternatives.patterns_of(families.CAMERA_FAMILIES[0], 5)}
    assert of_camera.pop("single") == np.eye(5).tolist() and of_camera.pop("group") == []
    of_object = {name: f.tolist() for name, f in alternatives.patterns_of(families.STRAIN, 5)}
    assert of_object == of_camera
    assert of_object["split"] == [[0, 0, 1, 1, 1], [0, 0, 0, 1, 1]]
    assert of_object["linear"] == [[-1, -0.5, 0, 0.5, 1]]
    assert of_object["alternating"] == [[0, 1, 0, 1, 0]]


def test_cells_divide_the_format() -> None:
    xy = np.array([[0.0, 0.0], [1999.0, 1499.0], [1000.0, 290.0], [-0.4, 1500.4]])
    seen = ImagePoints(np.array([0, 0, 0, 0]), np.arange(4), xy, np.tile(np.eye(2), (4, 1, 1)))
    network = stub(image_points=seen, camera=np.zeros(1, dtype=int))
    a = stub(network=network, estimate=stub(cameras=[stub(size_px=(2000, 1500))]))
    D = families.FORMAT.columns(stub(), a, stub())
    assert D.shape == (4, 2, 50)
    for row, cell in enumerate((0, 24, 2, 20)):
        assert np.flatnonzero(D[row, 0]).tolist() == [2 * cell] and D[row, 0, 2 * cell] == 1
        assert np.flatnonzero(D[row, 1]).tolist() == [2 * cell + 1] and D[row, 1, 2 * cell + 1] == 1


def test_the_level_is_shared_by_rows_and_lowered_by_the_search() -> None:
    one = made(Gain(20.0, 2, np.zeros(2)))
    rows = 0.01 / np.exp(one.log_p + one.search)
    assert is_significant(one, int(0.9 * rows), 0.01)
    assert not is_significant(one, int(1.1 * rows) + 1, 0.01)


def test_photographs_that_differ_are_the_fewer_ones() -> None:
    one = made(Gain(20.0, 2, np.zeros(2)))
    for factor, few in (([0, 1, 0], [1]), ([1, 0, 1], [1]), ([-1, 0, 1], [2]), ([1, 0, 0, 1], [0, 3])):
        assert replace(one, factor=np.array(factor, dtype=float)).photographs.tolist() == few


def test_what_photographs_contribute_to_cameras_is_in_standard_deviations() -> None:
    """Residuals of chance contribute about one standard deviation in all, of each parameter."""
    total = []
    for seed in range(4):
        network, truth = make_network(
            seed_of(f"contributions {seed}"), images=12, points=60, free=("c", "x0", "y0"), noise_px=0.1
        )
        a = adjust(network, truth, datum=Datum("free"), reject="none")
        _, of_interior = reduce_adjustment(a).contributions()
        assert of_interior.sum(axis=1) == pytest.approx(0.0, abs=0.01)
        total.append((of_interior**2).sum(axis=1))
    assert 0.3 < np.mean(total) < 3


def test_a_photograph_with_more_noise_has_a_spread_by_itself() -> None:
    """Its image points scatter three times as much: a change of its camera must stand out from that."""
    rng = seed_of("noisy photograph")
    network, truth = make_network(rng, images=12, points=60, free=("c",), noise_px=0.1)
    seen = network.image_points
    xy = seen.xy + np.where(seen.image == 3, 0.28, 0.0)[:, None] * rng.standard_normal(seen.xy.shape)
    network = replace(network, image_points=replace(seen, xy=xy))
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    found = [
        one for one in alternatives_of(reduce_adjustment(a)) if one.pattern == "single" and one.factor[3] > 0
    ]
    assert found
    for one in found:
        assert one.factor.sum() == 1 and 3 < one.spread.factor < 9


def test_the_design_effect_is_of_the_eigenvalues_of_the_variance_over_that_of_independent_errors(
    dense: Dense,
) -> None:
    """Sum of their squares over their sum; 1 without correlation, and for columns that determine nothing."""
    D = dense.reduced.whiten(dense.columns.freedoms)[:, :, :3]
    assert dense.reduced.design_effect(D) == 1
    near = ErrorCorrelation(alone=0.2, common=1.5, length_px=400.0)
    reduced = replace(dense.reduced, adjustment=replace(dense.a, error_correlation=near))
    network, used = dense.a.network, reduced.used
    H = reduced.project(D)[0]
    common = correlated_sum(
        reduced.image,
        network.image_points.xy[used],
        dense.a.sigma0_px * reduced.F,
        reduced.absorb(D)[2],
        near,
        network.may_correlate[used],
    )
    eigenvalues = np.linalg.eigvals(np.linalg.solve(H, H + common)).real
    expected = (eigenvalues**2).sum() / eigenvalues.sum()
    assert reduced.design_effect(D) == pytest.approx(expected) and expected > 1.05
    assert reduced.design_effect(np.zeros_like(D)) == 1


def test_the_spread_of_photographs_that_differ_by_chance_is_one() -> None:
    """Their scores along a direction are independent; what the unknowns take up makes it smaller."""
    factors = []
    for number in range(24):
        network, truth = make_network(seed_of(f"spread of chance {number}"), images=8, points=24, free=("c",))
        reduced = reduce_adjustment(adjust(network, truth, datum=Datum("free"), reject="none"))
        of_k1 = [one for one in alternatives.interiors(reduced, families.HELD) if len(one.parameters) == 1]
        assert all(one.spread.redundancy == 7 and not one.spread.among for one in of_k1)
        factors.append(of_k1[0].spread.factor)
    assert 0.4 < np.mean(factors) < 1.2 and np.std(factors) > 0.2
