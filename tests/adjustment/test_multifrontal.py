"""Blocks of photographs: normal equations in fronts, and the covariance from them, against the full ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import block_diag, csr_matrix
from threadpoolctl import threadpool_limits

from sfm.adjustment.covariance import Marginal, marginal_of
from sfm.adjustment.datum import Datum
from sfm.adjustment.engine import iterate, normals
from sfm.adjustment.engine.cofactors import hat_complement, marginal_covariance
from sfm.adjustment.engine.normals import MIN_HALVED_POINTS, Equations
from sfm.adjustment.engine.solvers import choice
from sfm.adjustment.engine.solvers.choice import choose_solver
from sfm.adjustment.engine.solvers.dense import DenseFactor, DenseSolver
from sfm.adjustment.engine.solvers.fronts import LEAF, dissect, pairs_of
from sfm.adjustment.engine.solvers.multifrontal import MultifrontalSolver
from sfm.adjustment.engine.solvers.multifrontal_factor import MultifrontalFactor
from sfm.adjustment.engine.solvers.protocol import Solver
from sfm.adjustment.engine.unknowns import Unknowns, unknowns_of
from sfm.adjustment.quality.rank import null_motions
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, ScaleBars
from tests.synthetic import observed_anew, seed_of
from tests.synthetic_blocks import FREE, HEIGHT, aerial, in_sigmas, lens, run, spoiled, unordered


def solver_for(network: Network, estimate: Estimate) -> Solver:
    return choose_solver(unknowns_of(network, estimate, use_control=False)[0])


def pair_by_pair(layout: Unknowns) -> DenseSolver:
    return DenseSolver(layout, pairs_of(layout.observations))


def grid(strips: int, per_strip: int, reach: int) -> csr_matrix:
    """The graph of a block in which photographs share points with all that are at most so many steps away."""
    strip, place = np.divmod(np.arange(strips * per_strip), per_strip)
    apart = np.maximum(np.abs(strip[:, None] - strip), np.abs(place[:, None] - place))
    return csr_matrix((apart <= reach).astype(np.uint8))


@pytest.mark.parametrize(("strips", "per_strip", "most"), [(24, 24, 2.4), (6, 96, 2.2), (1, 300, 2.0)])
def test_dissection_splits_a_block_by_short_separators(strips: int, per_strip: int, most: float) -> None:
    """Of a block no separator is longer than the way straight across it, but for steps in it."""
    graph, shuffled = grid(strips, per_strip, 2), np.random.default_rng(1).permutation(strips * per_strip)
    order = dissect(graph[shuffled][:, shuffled])
    assert sorted(np.concatenate(order.groups)) == list(range(strips * per_strip))
    assert order.parents.count(-1) == 1
    assert len(order.groups[-1]) <= most * min(strips, per_strip)
    full = graph[shuffled][:, shuffled].toarray()
    above = [set[int]() for _ in order.groups]
    for g in range(len(order.groups) - 1, -1, -1):
        parent = order.parents[g]
        above[g] = {g} if parent < 0 else above[parent] | {g}
    group = np.empty(len(full), dtype=int)
    for g, photographs in enumerate(order.groups):
        group[photographs] = g
    for one, other in zip(*np.nonzero(full), strict=True):  # neighbours stand above one another
        assert group[one] in above[group[other]] or group[other] in above[group[one]]


def test_parts_without_a_common_point_are_dissected_by_themselves() -> None:
    graph = block_diag([grid(5, 12, 2), grid(5, 12, 2), grid(1, 1, 0)]).tocsr()
    order = dissect(graph)
    assert sorted(np.concatenate(order.groups)) == list(range(121))
    assert order.parents.count(-1) > 1
    assert max(len(group) for group in order.groups) <= LEAF


def test_blocks_take_fronts_and_networks_of_many_rays_the_product_of_full_rows() -> None:
    fronts = solver_for(*aerial("choice", 6, 14, 1700))
    assert isinstance(fronts, MultifrontalSolver)
    assert max(len(front.photographs) for front in fronts.fronts.fronts) < 0.6 * 84
    pairs = solver_for(*unordered("some seen", 70, 300, 20))
    assert isinstance(pairs, DenseSolver) and pairs.pairs is not None and not pairs.has_coarse
    product = solver_for(*unordered("all seen", 70, 100, 70))
    assert isinstance(product, DenseSolver) and product.pairs is None and product.has_coarse
    small = solver_for(*aerial("small", 3, 8, 300))
    assert isinstance(small, DenseSolver) and small.pairs is None


@pytest.mark.sweep(1, 2, 4, 7)
@pytest.mark.parametrize("bars", [False, True])
@pytest.mark.parametrize("kind", ["free", "minimal"])
@pytest.mark.parametrize("pattern", ["fronts", "pairs"])
def test_covariance_of_fronts_and_pairs_equals_that_of_the_product_of_full_rows(
    pattern: str, kind: str, bars: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, truth = aerial("covariance", 6, 14, 1700)
    twice = np.arange(0, len(network.image_points), 50)  # measured twice in a photograph
    network = replace(
        network,
        image_points=network.image_points.select(np.append(np.arange(len(network.image_points)), twice)),
    )
    if bars:  # kept points in the border; the scale is no longer free
        length = np.linalg.norm(truth.points[5] - truth.points[900])
        ends = np.array([5]), np.array([900])
        network = network.with_given(ScaleBars(*ends, np.array([length]), np.array([0.01])))
    a = run(network, truth, covariance=False, tolerance=1e-9)
    if pattern == "pairs":
        monkeypatch.setattr(iterate, "choose_solver", pair_by_pair)
    fronts = marginal_of(a, datum=Datum(kind))
    monkeypatch.setattr(iterate, "choose_solver", DenseSolver)
    full = marginal_of(a, datum=Datum(kind))
    if isinstance(fronts.optimum.factor, MultifrontalFactor):
        assert pattern == "fronts"
    else:
        assert isinstance(fronts.optimum.factor, DenseFactor) and pattern == "pairs"
        assert fronts.optimum.factor.pairs is not None
        assert fronts.optimum.factor.pairs.tiles > 1
    assert isinstance(full.optimum.factor, DenseFactor)
    assert full.optimum.factor.pairs is None
    for found in (fronts, full):
        assert null_motions(found.optimum, found.layout) == (6 if bars else 7)
    Q, reference = (marginal_covariance(m.optimum, m.layout, m.cofactors, 1.0) for m in (fronts, full))
    free = np.diagonal(reference.points, axis1=1, axis2=2).all(axis=1)  # a minimal datum fixes some
    # Rounding allows 2e-16 over the smallest eigenvalue of the scaled matrix, 7e-7: 3e-10. The three ways are
    # 1.6e-10 to 2.8e-10 from an inverse in 80-bit arithmetic, and up to 4.5e-10 from one another.
    assert in_sigmas(Q.points[free], reference.points[free]) < 1e-9
    assert in_sigmas(Q.exterior, reference.exterior) < 1e-9
    assert in_sigmas(Q.interior[0], reference.interior[0]) < 1e-9
    assert np.abs(complement_of(fronts) - complement_of(full)).max() < 1e-9
    some = np.arange(0, 500, 37), np.array([5, 77, 1200])
    assert in_sigmas(fronts.joint(*some), full.joint(*some)) < 1e-9


def test_a_camera_for_each_photograph_has_the_covariance_of_full_rows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Interior unknowns are the border of the fronts; points are multiplied by it a few at a time."""
    network, truth = aerial("own cameras", 6, 14, 1000, tilt=0.4)
    m = len(network.images)
    cameras = tuple(replace(lens(("c", "K1")), name=f"camera {k}") for k in range(m))
    network, truth = replace(network, camera=np.arange(m)), replace(truth, cameras=cameras)
    a = run(network, truth, covariance=False, tolerance=1e-9)
    fronts = marginal_of(a, datum=Datum("free"))
    monkeypatch.setattr(iterate, "choose_solver", DenseSolver)
    full = marginal_of(a, datum=Datum("free"))
    assert isinstance(fronts.optimum.factor, MultifrontalFactor)
    assert isinstance(full.optimum.factor, DenseFactor)
    Q, reference = (marginal_covariance(m.optimum, m.layout, m.cofactors, 1.0) for m in (fronts, full))
    seen = np.diagonal(reference.exterior, axis1=1, axis2=2).all(axis=1)
    assert seen.mean() > 0.9 and in_sigmas(Q.points, reference.points) < 1e-7
    assert in_sigmas(Q.exterior[seen], reference.exterior[seen]) < 1e-7
    some = np.flatnonzero(np.repeat(seen, 6))[::37], np.array([5, 77, 700])
    assert in_sigmas(fronts.joint(*some), full.joint(*some)) < 1e-7


def test_calibrated_cameras_are_adjusted_pair_by_pair_too() -> None:
    """There are no interior unknowns in the border."""
    network, truth = unordered("calibrated", 70, 300, 20)
    truth = replace(truth, cameras=(lens(()),))
    network = observed_anew(network, truth, 0.1, seed_of("calibrated"))
    pairs = solver_for(network, truth)
    assert isinstance(pairs, DenseSolver) and pairs.pairs is not None
    a = run(network, truth)
    assert a.converged and a.unknown_counts[1] == 0 and abs(a.sigma0 - 1) < 4 / np.sqrt(2 * a.redundancy)


def complement_of(m: Marginal) -> FloatArray:
    return hat_complement(m.optimum, m.layout, m.cofactors, np.ones(len(m.layout.order)))


@pytest.mark.parametrize(("free", "defect"), [(("c", "x0", "y0"), 8), (FREE, 10)])
def test_what_a_flat_nadir_block_leaves_open_is_found_in_fronts_too(
    free: tuple[str, ...], defect: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parallel views of flat ground: c goes with Z0, and x0, y0 with X0, Y0 where P1, P2 make up for K1."""
    network, truth = aerial("flat", 6, 14, 1700, tilt=0.0, hills=0.0, noise_px=0.0)
    truth = replace(truth, cameras=(lens(free),))
    fronts = run(network, truth)
    monkeypatch.setattr(iterate, "choose_solver", DenseSolver)
    full = run(network, truth)
    assert fronts.defect == full.defect == defect
    assert len(fronts.undetermined) == len(full.undetermined) == defect - 7
    assert any("c of camera A" in words for words in fronts.undetermined)
    assert fronts.redundancy == full.redundancy
    # The smallest eigenvalue is 8e-12, and covariances of both ways are 1e-5 to 2e-5 sigma from one in 80-bit
    # arithmetic, as rounding allows; redundancy numbers are 6e-8 from one another.
    assert np.abs(fronts.redundancy_numbers - full.redundancy_numbers).max() < 1e-6


@pytest.mark.parametrize(
    ("strips", "per_strip", "points"),
    [(6, 14, 1700), pytest.param(25, 40, 99000, marks=pytest.mark.slow)],
)
def test_a_weak_block_near_nadir_converges(strips: int, per_strip: int, points: int) -> None:
    network, truth = aerial(f"weak {strips}", strips, per_strip, points, rays=5.0)
    assert isinstance(solver_for(network, truth), MultifrontalSolver)
    a = run(network, spoiled(truth, "weak", 0.25), covariance=False)
    assert a.converged
    assert abs(a.sigma0 - 1) < 5 / np.sqrt(2 * a.redundancy)


@pytest.mark.parametrize(
    ("photographs", "points"), [(90, 1200), pytest.param(500, 30000, marks=pytest.mark.slow)]
)
def test_an_unordered_collection_converges(photographs: int, points: int) -> None:
    network, truth = unordered(f"unordered {photographs}", photographs, points, 6)
    a = run(network, spoiled(truth, "unordered", 0.01), covariance=False)
    assert a.converged
    assert abs(a.sigma0 - 1) < 5 / np.sqrt(2 * a.redundancy)


@pytest.mark.parametrize("method", ["gauss-newton", "levenberg-marquardt"])
def test_a_step_to_where_nothing_can_be_solved_is_shortened(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, truth = aerial("refused", 3, 5, 120)
    start = spoiled(truth, "refused", 0.25)
    expected = run(network, start, method=method, covariance=False)
    calls = 0
    solvable = DenseSolver.factor

    def failing_once(*args: object, **options: object) -> object:
        nonlocal calls
        calls += 1
        return None if calls == 2 else solvable(*args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(DenseSolver, "factor", failing_once)
    a = run(network, start, method=method, covariance=False)
    assert a.converged
    assert a.vPv == pytest.approx(expected.vPv, rel=1e-9)


def test_nowhere_to_go_ends_as_not_converged_and_bad_start_values_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    network, truth = aerial("refused", 3, 5, 120)
    start = spoiled(truth, "refused", 0.25)
    at_start = start.position[0].copy()
    solvable = DenseSolver.factor

    def only_at_start(solver: DenseSolver, equations: Equations, *args: object, **options: object) -> object:
        near = abs(equations.vPv - first) < 1e-6 * first
        return solvable(solver, equations, *args, **options) if near else None  # type: ignore[arg-type]

    def noted(solver: DenseSolver, equations: Equations, *args: object, **options: object) -> object:
        seen.append(equations.vPv)
        return solvable(solver, equations, *args, **options)  # type: ignore[arg-type]

    first = np.inf
    seen: list[float] = []
    monkeypatch.setattr(DenseSolver, "factor", noted)
    run(network, start, method="gauss-newton", covariance=False)
    first = seen[0]
    monkeypatch.setattr(DenseSolver, "factor", only_at_start)
    a = run(network, start, method="gauss-newton", covariance=False)
    assert not a.converged
    assert np.allclose(a.estimate.position[0], at_start)
    monkeypatch.setattr(DenseSolver, "factor", lambda *args, **options: None)
    with pytest.raises(GeometryError, match="start values"):
        run(network, start, method="gauss-newton", covariance=False)


@pytest.mark.parametrize("way", ["chosen", "fronts", "pairs", "product"])
def test_two_threads_give_the_same_to_the_last_bit(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a network large enough that a second thread takes half of the sums and of the products."""
    if way == "pairs":
        monkeypatch.setattr(iterate, "choose_solver", pair_by_pair)
    elif way == "product":
        monkeypatch.setattr(iterate, "choose_solver", DenseSolver)
    elif way == "fronts":
        monkeypatch.setattr(choice, "SMALL", 0)
        monkeypatch.setattr(choice, "FACTOR_RATE", 1e-3)
        monkeypatch.setattr(choice, "MOSTLY", 1.0)
    network, truth = aerial("threads", 4, 14, 600, rays=40.0)
    assert len(network.image_points) >= MIN_HALVED_POINTS
    results = []
    for threads in (1, 2):
        with threadpool_limits(threads):
            a = run(network, truth)
        results.append(a.estimate.points.tobytes() + a.covariance.points.tobytes())
    assert results[0] == results[1]
    monkeypatch.setattr(normals, "MIN_HALVED_POINTS", len(network.image_points) + 1)
    whole = run(network, truth)  # the sums in another order
    assert np.abs(whole.estimate.points - a.estimate.points).max() < 1e-9 * HEIGHT


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
@pytest.mark.parametrize("rays", [20, 50])
def test_values_without_covariance_are_those_with_it(tolerance: float, rays: int) -> None:
    """Their last step may be taken with the reduced matrix before it; the defect is found all the same."""
    network, truth = unordered(f"simplified {rays}", 70, 300, rays)
    start = spoiled(truth, "simplified", 0.02)
    options = {"method": "gauss-newton", "tolerance": tolerance}
    quick = run(network, start, covariance=False, **options)
    whole = run(network, start, **options)
    assert quick.converged
    assert whole.converged
    assert quick.defect == whole.defect == 7
    assert quick.vPv == pytest.approx(whole.vPv, rel=1e-9)
    moved = np.linalg.norm(quick.estimate.points - whole.estimate.points, axis=1)
    sigma = np.sqrt(np.trace(whole.covariance.points, axis1=1, axis2=2))
    assert (moved / sigma).max() < 10 * tolerance
