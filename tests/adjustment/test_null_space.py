"""Networks that leave more open than position, attitude and scale: what solvers hold makes no difference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from sfm.adjustment.datum import Datum, Motions
from sfm.adjustment.engine import iterate
from sfm.adjustment.engine.cofactors import cofactors, hat_complement, marginal_covariance
from sfm.adjustment.engine.iterate import optimum_at, problem_of
from sfm.adjustment.engine.observed import observed_of
from sfm.adjustment.engine.solvers import choice
from sfm.adjustment.engine.solvers.dense import DenseSolver
from sfm.adjustment.engine.solvers.fronts import fronts_of
from sfm.adjustment.engine.solvers.multifrontal import MultifrontalSolver
from sfm.adjustment.engine.unknowns import Unknowns, unknowns_of
from sfm.adjustment.quality.rank import rank_defect
from sfm.adjustment.solve import adjust
from sfm.model.camera import project
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from tests.synthetic import make_network, seed_of
from tests.synthetic_blocks import aerial, in_sigmas, lens, run

MOTIONS = 7
APART = np.array([1000.0, 0.0, 0.0])  # of two halves


def in_fronts(layout: Unknowns) -> MultifrontalSolver:
    m = layout.observations.poses
    joined = np.zeros((m, m), dtype=np.uint8)
    choice._join(layout.observations, np.arange(len(layout.observations.start) - 1), joined)
    return MultifrontalSolver(layout, fronts_of(layout.observations, csr_matrix(joined)))


def halves(name: str, free: tuple[str, ...]) -> tuple[tuple[Network, Estimate], ...]:
    """Two blocks, with a lens each, that have no point in common."""
    made = [aerial(f"{half} half {name}", 5, 7, 700) for half in ("one", "other")]
    return tuple(
        (network, replace(truth, cameras=(replace(lens(free), name=f"lens {half}"),)))
        for half, (network, truth) in enumerate(made)
    )


def together(parts: tuple[tuple[Network, Estimate], ...]) -> tuple[Network, Estimate]:
    """Both as one network."""
    (a, start), (b, other) = parts
    k, own = a.image_points, b.image_points
    network = Network(
        a.images + tuple(f"other {name}" for name in b.images),
        np.repeat([0, 1], [len(a.images), len(b.images)]),
        a.points + tuple(f"other {name}" for name in b.points),
        ImagePoints(
            np.append(k.image, own.image + len(a.images)),
            np.append(k.point, own.point + len(a.points)),
            np.concatenate([k.xy, own.xy]),
            np.concatenate([k.covariance, own.covariance]),
        ),
    )
    return network, Estimate(
        start.cameras + other.cameras,
        np.concatenate([start.position, other.position + APART]),
        np.concatenate([start.rotation, other.rotation]),
        np.concatenate([start.points, other.points + APART]),
    )


@pytest.mark.parametrize("free", [(), ("c", "x0", "y0", "K1")])
def test_two_networks_without_a_common_point_are_each_in_a_datum_of_their_own(
    free: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Together they have twice seven defects, and the precision that each of them has by itself."""
    parts = halves("datum", free)
    network, start = together(parts)
    results = {}
    for way in (in_fronts, DenseSolver):
        monkeypatch.setattr(iterate, "choose_solver", way)
        results[way] = run(network, start, method="gauss-newton", tolerance=1e-9)
    fronts, full = results[in_fronts], results[DenseSolver]
    assert fronts.defect == full.defect == 2 * MOTIONS
    assert fronts.redundancy == full.redundancy
    assert fronts.sigma0 == pytest.approx(full.sigma0, rel=1e-9)
    alone = [run(*part, method="gauss-newton", tolerance=1e-9) for part in parts]
    assert full.redundancy == sum(one.redundancy for one in alone)
    assert full.vPv == pytest.approx(sum(one.vPv for one in alone), rel=1e-9)
    expected = np.concatenate([one.covariance.points / one.sigma0**2 for one in alone])
    orientation = np.concatenate([one.covariance.exterior / one.sigma0**2 for one in alone])
    for found in results.values():
        assert in_sigmas(found.covariance.points / found.sigma0**2, expected) < 1e-7
        assert in_sigmas(found.covariance.exterior / found.sigma0**2, orientation) < 1e-7
    moved = np.linalg.norm(fronts.estimate.points - full.estimate.points, axis=1)
    assert (moved / np.sqrt(np.trace(full.covariance.points, axis1=1, axis2=2))).max() < 1e-5


@pytest.mark.sweep(0, 3, 5, 6)
@pytest.mark.parametrize("kind", ["free", "minimal"])
@pytest.mark.parametrize(("left", "open_directions"), [(1, 4), (2, 2)])
@pytest.mark.parametrize("free", [(), ("c", "x0", "y0", "K1")])
def test_photographs_with_too_few_points_beside_two_networks_are_found_by_fronts_as_by_the_full_matrix(
    free: tuple[str, ...],
    left: int,
    open_directions: int,
    kind: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A test has left three photographs one point or two; more null vectors than are looked for at first."""
    network, start = together(halves("few", free))
    layout, state = unknowns_of(network, start, use_control=False)
    observed = observed_of(network, layout, state, use_control=False)
    image, rays = layout.observations.image, np.diff(layout.observations.start)
    weight = np.ones(len(image))
    poor = np.array([3, 20, 50])
    for i in poor:
        own = np.flatnonzero(image == i)
        richest = np.argsort(-rays[layout.observations.point[own]], kind="stable")
        weight[own[richest[left:]]] = 0
    rays = np.bincount(layout.observations.point, weights=weight)
    found = []
    for way in (in_fronts, DenseSolver):
        monkeypatch.setattr(iterate, "choose_solver", way)
        problem = problem_of(layout, observed, Datum(kind).resolve(network))
        optimum = optimum_at(problem, state, weight)
        assert optimum is not None
        further = MOTIONS + open_directions * len(poor)
        assert optimum.motions.further == further
        of_points = 3 * (rays == 0).sum() + (rays == 1).sum()
        assert rank_defect(optimum, layout) == MOTIONS + further + of_points
        Q = cofactors(optimum, layout)
        found.append(
            (marginal_covariance(optimum, layout, Q, 1.0), hat_complement(optimum, layout, Q, weight))
        )
    (fronts, complement), (full, reference) = found
    sound = (rays >= 2) & np.diagonal(full.points, axis1=1, axis2=2).all(axis=1)
    rich = np.setdiff1d(np.arange(len(network.images)), poor)
    assert in_sigmas(fronts.points[sound], full.points[sound]) < 1e-7
    assert in_sigmas(fronts.exterior[rich], full.exterior[rich]) < 1e-7
    assert np.abs(complement - reference)[weight > 0].max() < 1e-9
    assert np.trace(reference[weight > 0], axis1=1, axis2=2).sum() == pytest.approx(
        2 * weight.sum() - layout.count + MOTIONS + further + of_points, abs=1e-6
    )


def test_a_block_of_calibrated_cameras_is_adjusted_in_fronts(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = aerial("calibrated", 5, 7, 700)
    truth = replace(truth, cameras=(lens(()),))
    full = run(network, truth)
    monkeypatch.setattr(iterate, "choose_solver", in_fronts)
    fronts = run(network, truth)
    assert fronts.defect == MOTIONS
    assert in_sigmas(fronts.covariance.points, full.covariance.points) < 1e-8


@pytest.mark.parametrize("steps", [(), (3,)])
def test_steps_in_the_datum_meet_its_constraints(steps: tuple[int, ...]) -> None:
    """Those of points, and of photographs where points do not carry it."""
    rng = seed_of("in the datum")
    (H, on_reduced), (P, B) = rng.standard_normal((2, 6, 2)), rng.standard_normal((2, 4, 3, 2))
    inverse = np.linalg.inv(np.tensordot(B, P, ((0, 1), (0, 1))) + on_reduced.T @ H)
    motions = Motions(H, P, B, on_reduced, inverse)
    x, X = motions.transform(rng.standard_normal((6, *steps)), rng.standard_normal((4, 3, *steps)))
    np.testing.assert_allclose(on_reduced.T @ x + np.tensordot(B, X, ((0, 1), (0, 1))), 0.0, atol=1e-12)


def street(away: float) -> tuple[Network, Estimate]:
    """Parallel photographs with a base of 2 of a block of points, and two points far behind it."""
    rng = seed_of(f"street {away}")
    network, seen = make_network(rng, images=8, points=40, free=())
    near = seen.points * [1.2, 1.2, 0.8]
    points = np.vstack([near, [[0.1 * away, 0.05 * away, -away], [-0.1 * away, 0.07 * away, -away]]])
    position = np.column_stack([np.linspace(-1, 1, 8), rng.uniform(-0.2, 0.2, 8), rng.uniform(3.8, 4.2, 8)])
    truth = replace(seen, position=position, rotation=np.tile(np.eye(3), (8, 1, 1)), points=points)
    rows = []
    for i in range(8):
        xy = project(truth.cameras[0], position[i], np.eye(3), points)
        inside = np.isfinite(xy).all(1) & (xy > 0).all(1) & (xy < truth.cameras[0].size_px).all(1)
        rows += [(i, j, *(xy[j] + rng.normal(0, 0.1, 2))) for j in np.flatnonzero(inside)]
    image, point, *xy = np.array(rows).T
    measured = ImagePoints(
        image.astype(int),
        point.astype(int),
        np.stack(xy, axis=1),
        np.tile(0.01 * np.eye(2), (len(image), 1, 1)),
    )
    names = (*network.points, "far 1", "far 2")
    return replace(network, points=names, image_points=measured), truth


@pytest.mark.parametrize("away", [1e3, 1e5, 1e9])
def test_points_far_behind_all_others_carry_no_datum(away: float) -> None:
    """They turned and scaled the whole network by their own errors, until nothing could fix it any more."""
    network, truth = street(away)
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    near = network.image_points.point < 40
    alone = replace(network, points=network.points[:40], image_points=network.image_points.select(near))
    b = adjust(alone, replace(truth, points=truth.points[:40]), datum=Datum("free"), reject="none")
    assert a.converged and a.expected_defect == 7
    sigma, expected = (np.sqrt(np.trace(one.covariance.points[:40], axis1=1, axis2=2)) for one in (a, b))
    assert (sigma < 1.2 * expected).all()
    assert a.datum_points is not None and a.datum_points.tolist() == [True] * 40 + [False] * 2
    assert b.datum_points is None
