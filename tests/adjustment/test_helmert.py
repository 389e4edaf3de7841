"""Helmert blocking gives the adjustment in one piece: estimates, covariances, tests and null vectors."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.engine import iterate
from sfm.adjustment.engine.iterate import problem_of
from sfm.adjustment.engine.observed import observed_of
from sfm.adjustment.engine.solvers import choice
from sfm.adjustment.engine.solvers.helmert import HelmertSolver
from sfm.adjustment.engine.solvers.partition import layout_of, partition_of, unpacked
from sfm.adjustment.engine.unknowns import unknowns_of
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.camera import project
from sfm.model.conventions import FloatArray, IntArray, angles_from_rotation, rotation_from_vector
from sfm.model.estimate import Estimate, Mounts
from sfm.model.network import ImagePoints, Network
from sfm.model.observations.control_and_bars import ObjectPoints, ScaleBars
from sfm.model.observations.pose import AntennaPositions, ExteriorObservations, RelativeOrientations
from sfm.runtime.executor import Blocking, KeptHere, in_blocks
from tests.adjustment.test_null_space import in_fronts
from tests.synthetic import seed_of
from tests.synthetic_blocks import NOISE_PX, SIZE_PX, aerial, in_sigmas, lens, spoiled, unordered

TO_THE_END = AdjustmentOptions(tolerance=1e-9)
EXACT = 1e-9  # rounding; see tests.adjustment.test_multifrontal for that of covariances


class Case(NamedTuple):
    """A network, its start values and how it is adjusted."""

    network: Network
    start: Estimate
    options: dict[str, Any]


def free() -> Case:
    network, truth = aerial("helmert", 6, 14, 1700)
    return Case(network, spoiled(truth, "helmert", 0.25), {"reject": "none"})


def controlled() -> Case:
    """Control points, weighted and fixed, and scale bars of which one ends in a control point."""
    network, truth = aerial("helmert control", 6, 14, 1700)
    rng, index = np.random.default_rng(seed_of("control")), np.arange(3, 1600, 90)
    sigma = np.where(np.arange(len(index)) < 2, 0.0, 0.02)
    given = truth.points[index] + sigma[:, None] * rng.standard_normal((len(index), 3))
    control = ObjectPoints(index, given, sigma[:, None, None] ** 2 * np.eye(3))
    start, end = np.array([index[0], index[5], 11]), np.array([700, 1200, 1500])
    length = np.linalg.norm(truth.points[end] - truth.points[start], axis=1)
    bars = ScaleBars(start, end, length + 0.01, np.full(3, 0.02))
    network = network.with_given(control, bars)
    return Case(network, spoiled(truth, "helmert", 0.1), {"reject": "none", "datum": Datum("control")})


def measured_photographs() -> Case:
    """Two cameras, antennas, a fixed photograph, and known relative orientations of two pairs."""
    network, truth = aerial("helmert antennas", 6, 14, 1700, tilt=0.2)
    m = len(network.images)
    image, lever = np.arange(0, m, 2), np.tile([0.1, 0.2, 0.3], ((m + 1) // 2, 1))
    there = truth.position[image] + np.einsum("nab,nb->na", truth.rotation[image], lever)
    antennas = AntennaPositions(image, lever, there, np.full((len(image), 3), 0.05))
    first, second = np.array([3, 20]), np.array([40, 71])
    R = np.swapaxes(truth.rotation[first], 1, 2)
    t = np.einsum("nab,nb->na", R, truth.position[second] - truth.position[first])
    value = np.hstack([t, angles_from_rotation(R @ truth.rotation[second])])
    pairs = RelativeOrientations(first, second, value, np.full((2, 6), 1e-3))
    fixed = ExteriorObservations(
        np.array([7]), truth.position[[7]], angles_from_rotation(truth.rotation[[7]]), np.zeros((1, 6, 6))
    )
    network = replace(network, camera=np.arange(m) % 2).with_given(fixed, further=(antennas, pairs))
    start = spoiled(truth, "helmert", 0.05)
    start.position[7], start.rotation[7] = truth.position[7], truth.rotation[7]
    cameras = (start.cameras[0], replace(start.cameras[0], name="B"))
    return Case(network, replace(start, cameras=cameras), {"reject": "none"})


def rig() -> Case:
    """A rig of two cameras along a strip, with a free mount; a scale bar gives the scale."""
    _, along = aerial("helmert rig", 2, 30, 900, tilt=0.1)
    poses, rng = len(along.position), np.random.default_rng(seed_of("rig"))
    mounts = Mounts(
        np.array([[0.0, 0, 0], [3.0, 1.0, 0.5]]),
        np.array([np.eye(3), rotation_from_vector(np.array([0.05, 0.15, 1.0]))]),
        np.array([[False] * 6, [True] * 6]),
        ("rig", "rig"),
    )
    moment, camera = np.repeat(np.arange(poses), 2), np.tile([0, 1], poses)
    R = along.rotation[moment]
    X0 = along.position[moment] + np.einsum("mab,mb->ma", R, mounts.position[camera])
    cameras = (lens(("c",)), replace(lens(("c",)), name="B"))
    truth = Estimate(cameras, X0, R @ mounts.rotation[camera], along.points, mounts)
    image, point, xy = [], [], []
    for i, of in enumerate(camera):
        pixel = project(cameras[of], truth.position[i], truth.rotation[i], truth.points)
        seen = np.flatnonzero(((pixel > 0) & (pixel < np.array(SIZE_PX) - 1)).all(axis=1))
        image.append(np.full(len(seen), i))
        point.append(seen)
        xy.append(pixel[seen] + NOISE_PX * rng.standard_normal((len(seen), 2)))
    i, j, measured = (np.concatenate(part) for part in (image, point, xy))
    network = Network(
        tuple(f"{i}" for i in range(2 * poses)),
        camera,
        tuple(f"{j}" for j in range(len(truth.points))),
        ImagePoints(i, j, measured, np.tile(np.eye(2) * NOISE_PX**2, (len(i), 1, 1))),
        moment=moment,
    )
    length = np.linalg.norm(truth.points[[600]] - truth.points[[20]], axis=1)
    return Case(
        network.with_given(ScaleBars(np.array([20]), np.array([600]), length, np.array([0.01]))),
        replace(truth, points=truth.points + rng.normal(0, 0.1, truth.points.shape)),
        {"reject": "none"},
    )


def gross_errors(reject: str) -> Case:
    network, truth = aerial("helmert errors", 6, 14, 1700)
    rng = np.random.default_rng(seed_of("errors"))
    k = network.image_points
    wrong = rng.choice(len(k.image), 40, replace=False)
    xy = k.xy.copy()
    xy[wrong] += rng.uniform(3, 30, (40, 2))
    twice = np.append(np.arange(len(k.image)), wrong)  # measured twice in a photograph
    network = replace(network, image_points=replace(k, xy=xy).select(twice))
    return Case(network, spoiled(truth, "helmert", 0.1), {"reject": reject})


def two_networks() -> Case:
    """Two blocks without a common point: nothing but the camera is common to them."""
    (a, of_a), (b, of_b) = aerial("helmert one", 4, 12, 800), aerial("helmert other", 4, 12, 800)
    both = Network(
        (*a.images, *(f"b{name}" for name in b.images)),
        np.zeros(len(a.images) + len(b.images), dtype=np.int64),
        (*a.points, *(f"b{name}" for name in b.points)),
        ImagePoints(
            np.append(a.image_points.image, b.image_points.image + len(a.images)),
            np.append(a.image_points.point, b.image_points.point + len(a.points)),
            np.concatenate([a.image_points.xy, b.image_points.xy]),
            np.concatenate([a.image_points.covariance, b.image_points.covariance]),
        ),
    )
    away = np.array([400.0, 0, 0])
    of_b = replace(of_b, position=of_b.position + away, points=of_b.points + away)
    truth = Estimate(
        of_a.cameras,
        np.concatenate([of_a.position, of_b.position]),
        np.concatenate([of_a.rotation, of_b.rotation]),
        np.concatenate([of_a.points, of_b.points]),
    )
    return Case(both, truth, {"reject": "none"})


def without_image_points(photographs: int, *, at_one_end: bool = False) -> Case:
    """Some photographs have no image points, such as those whose measurement failed."""
    network, truth = aerial("helmert empty", 6, 14, 1700)
    order = np.argsort(truth.position[:, 0]) if at_one_end else np.arange(len(network.images))
    seen = np.isin(network.image_points.image, order[photographs:])
    network = replace(network, image_points=network.image_points.select(np.flatnonzero(seen)))
    return Case(network, spoiled(truth, "helmert", 0.1), {"reject": "none"})


CASES: dict[str, Callable[[], Case]] = {
    "free": free,
    "controlled": controlled,
    "measured photographs": measured_photographs,
    "rig": rig,
    "snooping": lambda: gross_errors("tau"),
    "tukey": lambda: gross_errors("tukey"),
    "two networks": two_networks,
    "10 photographs without image points": lambda: without_image_points(10),
    "half of the photographs without image points": lambda: without_image_points(42, at_one_end=True),
}


def in_this_process(case: Case, blocks: int | None) -> Adjustment:
    """Adjust a network in so many blocks, or in one piece."""
    with nullcontext() if blocks is None else in_blocks(Blocking(KeptHere(), blocks)):
        return adjust(case.network, case.start, options=TO_THE_END, **case.options)


def solver_of(case: Case, blocks: int) -> object:
    use_control = "datum" in case.options
    layout, state = unknowns_of(case.network, case.start, use_control=use_control)
    observed = observed_of(case.network, layout, state, use_control=use_control)
    with in_blocks(Blocking(KeptHere(), blocks)):
        return problem_of(layout, observed, Datum("free").resolve(case.network)).solver


def sigmas(Q: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.diagonal(Q, axis1=-2, axis2=-1)))


def assert_same(blocks: Adjustment, whole: Adjustment, exact: float = EXACT) -> None:
    """Assert that two adjustments are the same but for rounding."""
    assert blocks.converged and whole.converged
    assert (blocks.defect, blocks.redundancy) == (whole.defect, whole.redundancy)
    assert np.array_equal(blocks.rejected, whole.rejected)
    assert blocks.vPv == pytest.approx(whole.vPv, rel=1e-11)
    Q, q = whole.covariance, blocks.covariance
    free = (np.diagonal(Q.points, axis1=1, axis2=2) > 0).all(axis=1)
    moved = np.abs(blocks.estimate.points - whole.estimate.points)[free] / sigmas(Q.points)[free]
    assert moved.max() < exact
    there = blocks.estimate.points[~free], whole.estimate.points[~free]
    assert np.allclose(*there, rtol=0, atol=exact, equal_nan=True)
    on = (np.diagonal(Q.exterior, axis1=1, axis2=2) > 0).all(axis=1)
    away = np.abs(blocks.estimate.position - whole.estimate.position)[on] / sigmas(Q.exterior)[on, :3]
    assert away.max() < exact
    for camera, other, cofactor in zip(
        blocks.estimate.cameras, whole.estimate.cameras, Q.interior, strict=True
    ):
        changed = np.abs(camera.parameters - other.parameters)[np.flatnonzero(camera.free)]
        assert (changed / sigmas(cofactor)).max(initial=0.0) < exact
    assert in_sigmas(q.points[free], Q.points[free]) < exact
    assert in_sigmas(q.exterior[on], Q.exterior[on]) < exact
    for own, other in zip(q.interior, Q.interior, strict=True):
        assert in_sigmas(own, other) < exact
    numbers = np.abs(blocks.redundancy_numbers - whole.redundancy_numbers)
    assert np.nanmax(numbers) < exact
    assert np.array_equal(np.isnan(blocks.redundancy_numbers), np.isnan(whole.redundancy_numbers))
    for own, other in zip(blocks.observed, whole.observed, strict=True):
        assert np.allclose(
            own.redundancy_numbers, other.redundancy_numbers, rtol=0, atol=exact, equal_nan=True
        )


def joint_of(a: Adjustment, points: IntArray, images: IntArray) -> FloatArray:
    assert a.joint is not None
    return a.joint(a)(points, images)


@pytest.fixture
def whole_in_fronts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Adjust the whole in fronts: a free datum follows the damped steps, which full rows hold otherwise."""
    monkeypatch.setattr(iterate, "choose_solver", in_fronts)


@pytest.mark.sweep(0, 1, 2, 3, 4, 6, 7)
@pytest.mark.usefixtures("whole_in_fronts")
@pytest.mark.parametrize("name", CASES)
def test_blocks_give_the_adjustment_in_one_piece(name: str) -> None:
    case = CASES[name]()
    whole = in_this_process(case, None)
    # null vectors that are found numerically are rounded by 2e-16 over the smallest eigenvalue, 1e-8
    exact = 1e-7 if name == "two networks" else EXACT
    for count in (2, 4):
        solver = solver_of(case, count)
        assert isinstance(solver, HelmertSolver)
        assert len(solver.pieces) == count
        blocks = in_this_process(case, count)
        assert_same(blocks, whole, exact)
        points, images = np.array([5, 77, 20, 600]), np.array([0, 50])
        with in_blocks(Blocking(KeptHere(), count)):
            joint = joint_of(blocks, points, images)
        reference = joint_of(whole, points, images)
        here = np.diagonal(reference) > 0
        assert in_sigmas(joint[np.ix_(here, here)], reference[np.ix_(here, here)]) < exact


def test_blocks_without_control_are_placed_by_their_neighbours() -> None:
    """Control is in two opposite quarters of the area only; blocks adjusted alone would not fit to them."""
    network, truth = aerial("control in two quarters", 10, 14, 2400)
    rng, ground = np.random.default_rng(seed_of("two quarters")), truth.points[:, :2]
    upper = ground > np.median(ground, axis=0)
    without = upper[:, 0] != upper[:, 1]
    index, sigma = np.flatnonzero(~without)[::120], 0.02
    given = truth.points[index] + sigma * rng.standard_normal((len(index), 3))
    control = ObjectPoints(index, given, np.tile(sigma**2 * np.eye(3), (len(index), 1, 1)))
    options = {"reject": "none", "datum": Datum("control")}
    case = Case(network.with_given(control), spoiled(truth, "two quarters", 0.1), options)
    blocks, whole = in_this_process(case, 4), in_this_process(case, None)
    assert_same(blocks, whole, EXACT)
    error = (blocks.estimate.points - truth.points)[without]
    expected = np.sqrt(np.diagonal(blocks.covariance.points, axis1=1, axis2=2))[without]
    z = error / expected
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.25
    assert np.abs(z).max() < 5.0


def test_networks_are_cut_where_blocks_save_time_or_their_number_is_stated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case = free()
    layout, _ = unknowns_of(case.network, case.start, use_control=False)

    class TwoWorkers(KeptHere):
        workers = 2

    assert choice.blocks_of(layout, ()) is None
    with in_blocks(Blocking(TwoWorkers())):
        assert choice.blocks_of(layout, ()) is None  # its messages take longer than its steps
        monkeypatch.setattr(choice, "MESSAGES_SECONDS", 0.0)
        solver = choice.blocks_of(layout, ())
        assert solver is not None and len(solver.pieces) == 2
    with in_blocks(Blocking(KeptHere(), 3)):
        solver = choice.blocks_of(layout, ())
        assert solver is not None and len(solver.pieces) == 3
        inside, start = unordered("no separator", 70, 300, 20)
        assert choice.blocks_of(unknowns_of(inside, start, use_control=False)[0], ()) is None


def test_photographs_without_image_points_make_no_blocks() -> None:
    """However many blocks are wanted: each has image points, and the interface is that of the others."""
    case = without_image_points(10)
    layout, _ = unknowns_of(case.network, case.start, use_control=False)
    for coupled in (np.array([20, 50]), np.array([3, 20])):
        partition = partition_of(layout, 50, coupled)
        assert partition is not None
        assert min(len(piece.rays) for piece in partition.pieces) > 0
        aside = np.setdiff1d(np.arange(10), coupled)
        assert np.isin(aside, partition.pieces[0].poses[: partition.pieces[0].inner]).all()
        assert np.isin(coupled, partition.poses).all()
    assert partition_of(layout, 50, np.arange(84)) is None  # all are at the interface


def test_a_network_that_photographs_without_image_points_leave_in_shreds_is_the_same() -> None:
    """Every other photograph at random: what is left has single rays and undetermined photographs."""
    case = without_image_points(42)
    whole, blocks = in_this_process(case, None), in_this_process(case, 4)
    assert (blocks.defect, blocks.redundancy) == (whole.defect, whole.redundancy)
    assert blocks.vPv == pytest.approx(whole.vPv, rel=1e-11)
    assert blocks.undetermined == whole.undetermined


def test_every_pose_point_and_image_point_has_its_place_in_the_blocks() -> None:
    """Inner poses, object points and image points are in one block each, and no block sees inside another."""
    case = controlled()
    layout, _ = unknowns_of(case.network, case.start, use_control=True)
    partition = partition_of(layout, 4, np.array([3, 50]))
    assert partition is not None and {3, 50} <= set(partition.poses.tolist())
    inner = np.concatenate([piece.poses[: piece.inner] for piece in partition.pieces])
    assert np.array_equal(np.sort(np.append(inner, partition.poses)), np.arange(len(layout.pose_free)))
    rays = np.concatenate([piece.rays for piece in partition.pieces])
    assert np.array_equal(np.sort(rays), np.arange(len(layout.order)))
    counts = np.bincount(np.concatenate([piece.points for piece in partition.pieces]))
    assert len(layout.kept) == 6
    assert set(counts[layout.kept]) == {4} and set(np.delete(counts, layout.kept)) == {1}
    for piece in partition.pieces:
        own = unpacked(layout_of(layout, piece)).observations
        o = layout.observations
        assert np.array_equal(piece.poses[own.pose], o.pose[piece.rays])
        assert np.array_equal(piece.points[own.point], o.point[piece.rays])
        assert np.array_equal(own.whitening, o.whitening[piece.rays])
        assert np.array_equal(piece.columns[6 * piece.inner :], partition.columns[piece.at])


def test_what_a_flat_nadir_block_leaves_open_is_found_in_blocks_too() -> None:
    """Null vectors beyond the datum, some of which only the camera and all blocks together have."""
    network, truth = aerial("flat", 6, 14, 1700, tilt=0.0, hills=0.0, noise_px=0.0)
    with in_blocks(Blocking(KeptHere(), 4)):
        a = adjust(network, truth, reject="none")
    assert a.defect == 10 and len(a.undetermined) == 3
    assert any("c of camera A" in words for words in a.undetermined)


def test_a_photograph_that_nothing_determines_is_found_inside_a_block() -> None:
    """Two points, one of them measured twice, leave two directions of an inner photograph open."""
    network, truth = aerial("loose", 6, 14, 1700)
    layout, _ = unknowns_of(network, truth, use_control=False)
    partition = partition_of(layout, 2, np.zeros(0, dtype=np.int64))
    assert partition is not None
    loose = int(partition.pieces[1].poses[3])
    seen = np.flatnonzero(network.image_points.image == loose)
    left = np.append(np.delete(np.arange(len(network.image_points)), seen[2:]), seen[1])
    network = replace(network, image_points=network.image_points.select(left))
    case = Case(network, truth, {"reject": "none"})
    whole, blocks = in_this_process(case, None), in_this_process(case, 2)
    assert blocks.defect == whole.defect
    for a in (blocks, whole):  # any two directions span what is open
        assert sum(f"of photograph {loose}" in words for words in a.undetermined) == 2
    others = np.delete(np.arange(len(network.images)), loose)
    sigma = sigmas(whole.covariance.exterior[others])[:, :3]
    assert (np.abs(blocks.estimate.position - whole.estimate.position)[others] / sigma).max() < 1e-6
