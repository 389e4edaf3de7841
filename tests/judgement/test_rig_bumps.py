"""A camera that was moved on its rig is found and named; rigs that kept theirs are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.solve import adjust
from sfm.camera import project
from sfm.estimate import Estimate
from sfm.judgement.hypotheses.bumps import _gain, _scores, bump_remarks, find_bumps
from sfm.network import Network
from tests.rigs import make_rig
from tests.synthetic import seed_of


def bumped(network: Network, truth: Estimate, i: int, shift: np.ndarray) -> Network:
    """Return the network with one photograph taken from another place."""
    seen = network.image_points
    rows = seen.image == i
    camera, X = truth.cameras[network.camera[i]], truth.points[seen.point[rows]]
    xy = seen.xy.copy()
    for sign, at in ((1, truth.position[i] + shift), (-1, truth.position[i])):
        xy[rows] += sign * project(camera, at, truth.rotation[i], X)
    return replace(network, image_points=replace(seen, xy=xy))


def scene(number: int, cameras: int) -> tuple[Network, Estimate]:
    return make_rig(seed_of(f"bump {number}"), cameras=cameras, moments=8, points=25)


@pytest.mark.parametrize(("cameras", "moved"), [(2, 7), (3, 4), (3, 6)])
def test_a_bump_of_six_sigma_is_named(cameras: int, moved: int) -> None:
    """The sixth photograph of camera 3 of 3 is the reference camera, which a third one shows."""
    network, truth = scene(1, cameras)
    a = adjust(network, truth, reject="none")
    _, G = _scores(a, np.array([moved]))
    C = np.linalg.inv(G[0][:, 0])
    d = seed_of("direction").standard_normal(3)
    d /= np.linalg.norm(d)
    shift = 6 * np.sqrt(d @ C[:3, :3] @ d)
    b = adjust(bumped(network, truth, moved, shift * d), truth, reject="none")
    (found,) = find_bumps(b)
    assert found.photograph == network.images[moved]
    assert found.shift == pytest.approx(shift, rel=0.7)
    (said,) = bump_remarks(b, "m")
    assert said.kind == "rig_contradicted" and said.names("photographs") == (network.images[moved],)
    assert said.severity == "warning" and said.number("share") == pytest.approx(1 / 8)  # of its camera


def test_two_bumps_are_both_named() -> None:
    network, truth = scene(2, 2)
    shift = np.array([0.004, -0.003, 0.002])
    both = bumped(bumped(network, truth, 3, shift), truth, 11, -2 * shift)
    found = find_bumps(adjust(both, truth, reject="none"))
    assert [one.photograph for one in found] == [network.images[11], network.images[3]]


def test_a_rig_that_most_photographs_contradict_while_they_share_its_pose_is_an_error() -> None:
    """The third camera was at another place at each of eight moments; nothing was freed."""
    network, truth = scene(4, 3)
    rng = seed_of("places of a camera")
    for moment in range(8):
        network = bumped(network, truth, 3 * moment + 2, rng.normal(0, 0.02, 3))
    (said,) = bump_remarks(adjust(network, truth, reject="none"), "m")
    assert said.kind == "rig_contradicted" and said.severity == "error"


def test_rigs_that_kept_their_places_are_left_alone() -> None:
    """30 of them at a level of 0.1 %: one alarm has a chance of 3 %, two of 0.04 %."""
    alarms = sum(bool(find_bumps(adjust(*scene(k, 2), reject="none"))) for k in range(10, 40))
    assert alarms <= 1


def test_scores_are_those_of_an_adjustment_with_a_pose_of_its_own() -> None:
    """The fall of v'Pv where the photograph leaves its rig is chi-square of the test."""
    network, truth = scene(3, 2)
    moved = bumped(network, truth, 5, np.array([1e-3, 0.0, 0.0]))
    a = adjust(moved, truth, reject="none", tolerance=1e-9)
    (found,) = find_bumps(a)
    assert moved.moment is not None
    free = replace(moved, moment=np.where(np.arange(16) == 5, 99, moved.moment))
    start = replace(a.estimate, cameras=a.estimate.cameras)
    b = adjust(free, start, reject="none", tolerance=1e-9)
    fall = a.vPv - b.vPv
    assert (found.sigmas * a.sigma0) ** 2 == pytest.approx(fall, rel=0.01)


def test_the_gain_of_a_pose_is_beside_those_of_others() -> None:
    """Chi-square of all three less that of the two others; the shift is that of the joint solution."""
    rng = seed_of("beside")
    A = rng.normal(size=(60, 18))
    G, s = A.T @ A, rng.normal(size=18)
    gain, shift = _gain(s.reshape(3, 6), G.reshape(3, 6, 3, 6), 1, [0, 2])
    others = np.r_[0:6, 12:18]
    expected = s @ np.linalg.solve(G, s) - s[others] @ np.linalg.solve(G[np.ix_(others, others)], s[others])
    assert gain == pytest.approx(expected)
    np.testing.assert_allclose(np.abs(shift), np.abs(np.linalg.solve(G, s)[6:12]), rtol=1e-9)
    alone, _ = _gain(s.reshape(3, 6), G.reshape(3, 6, 3, 6), 1, [])
    assert alone == pytest.approx(s[6:12] @ np.linalg.solve(G[6:12, 6:12], s[6:12]))
