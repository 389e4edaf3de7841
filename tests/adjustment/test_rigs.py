"""Rigs in the adjustment: poses of moments and mounts of cameras in place of one orientation a photograph."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.datum import Datum
from sfm.adjustment.engine import iterate
from sfm.adjustment.engine.collinearity import residuals
from sfm.adjustment.engine.normals import normal_equations
from sfm.adjustment.engine.observed import observed_of
from sfm.adjustment.engine.solvers.choice import choose_solver
from sfm.adjustment.engine.solvers.dense import DenseSolver
from sfm.adjustment.engine.solvers.fronts import fronts_of, pairs_of
from sfm.adjustment.engine.solvers.multifrontal import MultifrontalSolver
from sfm.adjustment.engine.unknowns import Unknowns, start_weights, step, unknowns_of
from sfm.adjustment.result import Adjustment, ErrorCorrelation
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from tests.rigs import make_rig
from tests.synthetic import perturb, seed_of


def start_of(truth: Estimate, name: str) -> Estimate:
    """Start values: photographs spoiled each by itself, mounts by centimetres and a degree."""
    assert truth.mounts is not None
    rng = seed_of(name)
    spoiled = perturb(truth, rng, position=0.005, angle_deg=0.3, points=0.005, distortion=False)
    moved = truth.mounts.position + 0.01 * rng.standard_normal(truth.mounts.position.shape)
    moved[0] = 0.0
    return replace(spoiled, mounts=replace(truth.mounts, position=moved))


def test_right_side_is_the_gradient_by_all_unknowns() -> None:
    """g of poses, interior orientation, mounts and points against differences of v'Pv."""
    network, truth = make_rig(seed_of("gradient"), cameras=3, moments=3, points=12, free=("c", "K1"))
    layout, state = unknowns_of(network, truth, use_control=False)
    weight = start_weights(layout, state)

    def cost(reduced: np.ndarray, points: np.ndarray) -> float:
        v = residuals(layout.observations, step(layout, state, reduced, points))
        return float((v**2).sum() / 0.1**2)

    equations = normal_equations(
        layout, observed_of(network, layout, state, use_control=False), state, weight
    )
    b = equations.blocks
    g = equations.parts.g + b.Yy
    none, h = np.zeros((len(truth.points), 3)), 1e-6
    assert layout.reduced == 6 * 3 + 3 * 2 + 2 * 6
    for q in range(layout.reduced):
        d = np.zeros(layout.reduced)
        d[q] = h
        slope = (cost(d, none) - cost(-d, none)) / (4 * h)
        assert slope == pytest.approx(g[q], rel=2e-5, abs=2e-4 * np.abs(g).max())


def test_exterior_orientation_by_the_unknowns() -> None:
    network, truth = make_rig(seed_of("terms"), cameras=3, moments=3, points=12)
    layout, state = unknowns_of(network, truth, use_control=False)
    images = np.arange(9)
    columns, J = layout.photograph_terms(state, images)
    rng = seed_of("step")
    dx = 1e-6 * rng.standard_normal(layout.reduced)
    moved = step(layout, state, dx, np.zeros_like(state.points))
    found = np.einsum("eau,eu->ea", J, dx[columns])
    assert moved.position - state.position == pytest.approx(found[:, :3], abs=1e-11)
    turned = np.swapaxes(state.M @ np.swapaxes(moved.M, 1, 2), 1, 2)  # exp(-[w]x)
    w = np.stack([turned[:, 1, 2], turned[:, 2, 0], turned[:, 0, 1]], axis=1)
    assert w == pytest.approx(found[:, 3:], abs=1e-11)


@pytest.mark.parametrize("cameras", [2, 4])
def test_a_rig_is_found_from_spoiled_start_values(cameras: int) -> None:
    network, truth = make_rig(seed_of("exact"), cameras=cameras, moments=6, noise_px=0.0)
    a = adjust(network, start_of(truth, "start"), reject="none")
    assert a.converged and a.defect == a.expected_defect == 7
    assert a.rms_px < 1e-8
    m, t = a.estimate.mounts, truth.mounts
    assert m is not None and t is not None
    scale = np.linalg.norm(m.position[1]) / np.linalg.norm(t.position[1])
    assert m.position == pytest.approx(scale * t.position, abs=1e-9)
    assert m.rotation == pytest.approx(t.rotation, abs=1e-9)
    assert a.unknown_counts == (6 * 6 + 6 * (cameras - 1), 0, 3 * 40)


def test_fixed_mounts_give_the_scale() -> None:
    network, truth = make_rig(seed_of("held"))
    assert truth.mounts is not None
    held = replace(truth, mounts=replace(truth.mounts, free=np.zeros((2, 6), dtype=bool)))
    a = adjust(network, held, reject="none")
    assert a.defect == a.expected_defect == 6
    centres = np.linalg.norm(np.diff(a.estimate.position.reshape(-1, 2, 3), axis=1), axis=2)
    assert centres == pytest.approx(np.linalg.norm(truth.mounts.position[1]), abs=1e-12)


def test_covariance_is_the_scatter_of_repeated_surveys() -> None:
    """Of points, exterior orientation and the mount, from 200 draws."""
    network, truth = make_rig(seed_of("scatter"), moments=5, points=25, noise_px=0.0)
    rng, draws = seed_of("draws"), 200
    datum = Datum("minimal", points=["1", "2", "3"])
    sums = {"points": 0.0, "exterior": 0.0, "mount": 0.0}
    xy = network.image_points.xy
    exact = adjust(
        network, truth, reject="none", datum=datum, options=AdjustmentOptions(sigma_px=0.01)
    ).estimate
    marginal = None
    for _ in range(draws):
        noisy = replace(network.image_points, xy=xy + 0.01 * rng.standard_normal(xy.shape))
        a = adjust(
            replace(network, image_points=noisy),
            exact,
            reject="none",
            datum=datum,
            options=AdjustmentOptions(sigma_px=0.01),
        )
        unit = a.sigma0**2
        if marginal is None:
            marginal = marginal_of(a)
            columns = marginal.layout.mount_column[1]
            Q_mount = marginal.joint(columns, np.zeros(0, dtype=int)) / unit
        Q, dX = a.covariance.points[5] / unit, a.estimate.points[5] - exact.points[5]
        sums["points"] += dX @ np.linalg.solve(Q, dX)
        dX = a.estimate.position[3] - exact.position[3]
        sums["exterior"] += dX @ np.linalg.solve(a.covariance.exterior[3, :3, :3] / unit, dX)
        assert a.estimate.mounts is not None and exact.mounts is not None
        dt = a.estimate.mounts.position[1] - exact.mounts.position[1]
        R = exact.mounts.rotation[1].T @ a.estimate.mounts.rotation[1]
        d = np.concatenate([dt, [R[2, 1], R[0, 2], R[1, 0]]])
        sums["mount"] += d @ np.linalg.solve(Q_mount, d)
    for name, size in (("points", 3), ("exterior", 3), ("mount", 6)):
        low, high = stats.chi2.ppf([0.001, 0.999], size * draws)
        assert low < sums[name] < high, name


def test_all_solvers_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = make_rig(seed_of("solvers"), cameras=3, moments=8, points=30, free=("c",))

    def by_fronts(layout: Unknowns) -> MultifrontalSolver:
        from scipy.sparse import csr_matrix

        poses = layout.observations.poses
        return MultifrontalSolver(layout, fronts_of(layout.observations, csr_matrix(np.ones((poses, poses)))))

    def by_pairs(layout: Unknowns) -> DenseSolver:
        return DenseSolver(layout, pairs_of(layout.observations))

    found = []
    for solver in (choose_solver, by_pairs, by_fronts):
        monkeypatch.setattr(iterate, "choose_solver", solver)
        found.append(adjust(network, truth, reject="none", options=AdjustmentOptions(tolerance=1e-10)))
    for a in found[1:]:
        assert a.estimate.points == pytest.approx(found[0].estimate.points, abs=1e-9)
        assert a.covariance.points == pytest.approx(found[0].covariance.points, rel=1e-6, abs=1e-16)
        assert a.covariance.exterior == pytest.approx(found[0].covariance.exterior, rel=1e-6, abs=1e-15)
        assert a.redundancy_numbers == pytest.approx(found[0].redundancy_numbers, abs=1e-7)
    assert np.nansum(found[0].redundancy_numbers) == pytest.approx(found[0].redundancy, abs=1e-6)


def test_a_photograph_that_sees_little_is_held_by_its_rig() -> None:
    """Two points in one photograph: alone it could not be oriented."""
    network, truth = make_rig(seed_of("little"), noise_px=0.0)
    k = network.image_points
    few = (k.image != 3) | (np.cumsum(k.image == 3) <= 2)
    network = replace(network, image_points=k.select(few))
    start = start_of(truth, "start")
    start.position[3] = np.nan
    a = adjust(network, start, reject="none")
    assert a.converged and not a.undetermined and a.rms_px < 1e-8
    assert np.isfinite(a.covariance.exterior[3]).all()


def test_moments_are_of_one_rig() -> None:
    network, truth = make_rig(seed_of("two rigs"))
    assert truth.mounts is not None
    other = replace(truth, mounts=replace(truth.mounts, rig=("rig", "")))
    with pytest.raises(GeometryError, match="photograph moment 1 camera 2: its moment is that of others"):
        adjust(network, other)


def test_a_rig_is_more_precise_than_its_photographs_alone() -> None:
    network, truth = make_rig(seed_of("gain"))
    rig = adjust(network, truth, reject="none")
    single: Network = replace(network, moment=None)
    alone = adjust(single, replace(truth, mounts=None), reject="none")

    def rms(a: Adjustment) -> float:
        return float(np.sqrt(np.trace(a.covariance.points, axis1=1, axis2=2).mean()) / a.sigma0)

    assert rms(rig) < rms(alone)


@pytest.mark.parametrize("correlation", [None, ErrorCorrelation(alone=0.5, common=0.8, length_px=300.0)])
def test_covariance_of_rigs_is_that_of_the_inverse(correlation: ErrorCorrelation | None) -> None:
    """Interior orientation and mounts together, against columns of the inverse, with J of their angles."""
    network, truth = make_rig(seed_of("joint rigs"), moments=5, points=20, free=("c",))
    a = replace(adjust(network, truth, reject="none"), error_correlation=correlation)
    marginal = marginal_of(a)
    columns, J = marginal.layout.rig_terms(marginal.optimum.state)
    exact = J @ marginal.joint(columns, np.zeros(0, dtype=np.int64)) @ J.T
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact))) + (exact == 0)
    assert np.abs((marginal.covariance().rigs - exact) / scale).max() < 1e-8
