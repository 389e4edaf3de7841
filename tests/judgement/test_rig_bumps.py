"""A camera that was moved on its rig is found and named; rigs that kept theirs are not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sfm.adjustment.result import Adjustment, ErrorCorrelation
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.judgement.hypotheses.bumps import (
    Bump,
    _difference,
    _gain,
    _of_freed,
    _scores,
    _testable,
    bump_remarks,
    find_bumps,
)
from sfm.model.camera import project
from sfm.model.conventions import angles_from_rotation, rotation_from_angles
from sfm.model.distributions import chi2_isf, chi2_sf, level_of_single
from sfm.model.estimate import Estimate
from sfm.model.network import Network
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
    a = adjust(moved, truth, reject="none", options=AdjustmentOptions(tolerance=1e-9))
    (found,) = find_bumps(a)
    assert moved.moment is not None
    free = replace(moved, moment=np.where(np.arange(16) == 5, 99, moved.moment))
    start = replace(a.estimate, cameras=a.estimate.cameras)
    b = adjust(free, start, reject="none", options=AdjustmentOptions(tolerance=1e-9))
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


def freed(by: float, i: int = 4, *, number: int = 7) -> tuple[Adjustment, Network]:
    """Return a rig of three cameras whose photograph i left its place and was adjusted by itself."""
    network, truth = scene(number, 3)
    moved = bumped(network, truth, i, np.array([by, 0.0, 0.0]))
    free = replace(moved, moment=np.where(np.arange(len(moved.images)) == i, 99, moved.moment))
    return adjust(free, truth, reject="none"), network


@pytest.mark.parametrize("by", [0.0, 0.002, 0.02])
def test_a_photograph_that_was_freed_is_compared_with_another_moment(by: float) -> None:
    """Its shift and rotation are those of the bump, in the axes of the other camera."""
    a, network = freed(by)
    found = find_bumps(a, network.moment)
    assert len(found) == (by > 0) and find_bumps(a) == ()
    (one,) = _of_freed(a, np.array([4]), network.moment)
    assert one.free and one.shift == pytest.approx(by, abs=5e-4)
    assert one.turn < 5e-4 and one.probability == pytest.approx(chi2_sf(one.sigmas**2, 6))
    for bump in found:
        assert bump.photograph == network.images[4] and bump.camera == "camera 2"
        (said,) = bump_remarks(a, "m", network.moment)
        assert said.number("bound") == 0.0 and said.number("angle") == pytest.approx(np.degrees(bump.turn))


def test_freed_photographs_that_kept_their_places_are_tested_at_the_level() -> None:
    """Chi-square of six degrees of freedom, of photographs of several rigs."""
    squares = []
    for number in range(20, 32):
        a, network = freed(0.0, 4, number=number)
        (one,) = _of_freed(a, np.array([4]), network.moment)
        squares.append(one.sigmas**2)
    assert 3 < np.mean(squares) < 10


def test_a_freed_photograph_without_another_moment_is_not_compared() -> None:
    a, network = freed(0.02)
    once = np.arange(len(network.images)) // 3 + np.where(np.arange(len(network.images)) % 3 == 1, 100, 0)
    assert list(_of_freed(a, np.array([4]), once)) == []  # alone at its stated moment
    assert network.moment is not None
    alone = np.where(np.arange(len(network.images)) < 6, network.moment, 50 + np.arange(len(network.images)))
    (one,) = _of_freed(a, np.array([4]), alone)  # with the first moment
    assert one.shift == pytest.approx(0.02, abs=1e-3)
    last = np.where(
        np.arange(len(network.images)) // 3 == 1, network.moment, 50 + np.arange(len(network.images))
    )
    assert list(_of_freed(a, np.array([4]), last)) == []


def test_the_difference_of_two_pairs_has_its_derivatives() -> None:
    a, _ = freed(0.002)
    images = np.array([4, 3, 1, 0])
    d, J = _difference(a, images)
    for k, i in enumerate(images.tolist()):
        for c in range(6):
            step = 1e-5
            position, rotation = a.estimate.position.copy(), a.estimate.rotation.copy()
            if c < 3:
                position[i, c] += step
            else:
                angles = np.array(angles_from_rotation(rotation[i]))
                angles[c - 3] += step
                rotation[i] = rotation_from_angles(*angles)
            changed = replace(a, estimate=replace(a.estimate, position=position, rotation=rotation))
            np.testing.assert_allclose(
                (_difference(changed, images)[0] - d) / step, J[:, 6 * k + c], atol=2e-4
            )


@pytest.mark.parametrize(
    ("kept", "testable"),
    [([0, 1, 2], [0, 1, 2]), ([0, 1], [1]), ([1, 2], [1, 2]), ([0], []), ([2], [])],
)
def test_a_photograph_is_contradicted_by_others_of_its_moment(kept: list[int], testable: list[int]) -> None:
    """With one other photograph, the one that is not of the reference camera is named."""
    network, truth = scene(8, 3)
    of_first = np.isin(np.arange(3), kept)
    moment = np.where(np.arange(24) < 3, np.where(np.r_[of_first, [False] * 21], 0, 90 + np.arange(24)), 100)
    part: Any = SimpleNamespace(network=SimpleNamespace(moment=moment, camera=network.camera), estimate=truth)
    assert [i for i in _testable(part) if i < 3] == testable


def test_photographs_of_correlated_errors_are_tested_where_they_were_freed() -> None:
    network, truth = scene(2, 2)
    a = adjust(bumped(network, truth, 3, np.array([0.004, -0.003, 0.002])), truth, reject="none")
    assert find_bumps(a)
    assert find_bumps(replace(a, error_correlation=ErrorCorrelation(0.1, 0.1, 100.0))) == ()
    assert find_bumps(replace(a, network=replace(a.network, moment=None))) == ()
    none = replace(a.estimate, mounts=None)
    assert find_bumps(replace(a, estimate=none)) == ()


def test_the_level_is_shared_by_all_that_are_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    """A probability of 0.9 of the share of one of 16 photographs is a bump, one of 1.1 is none."""
    network, truth = scene(3, 2)
    a = adjust(network, truth, reject="none")
    tested = len(_testable(a))
    monkeypatch.setattr("sfm.judgement.hypotheses.bumps._of_freed", lambda *_: iter(()))
    for freed in (0, 5):  # whose moment is another one than was stated
        stated = np.where(np.arange(16) < freed, 99, network.moment)
        critical = level_of_single(a.levels.question, tested + freed)
        for factor, count in ((0.9, 1), (1.1, 0)):
            sigmas = np.sqrt(chi2_isf(factor * critical, 6))
            bump = Bump("x", "camera 2", 1.0, 1.0, sigmas, factor * critical, False)
            monkeypatch.setattr(
                "sfm.judgement.hypotheses.bumps._of_mounted", lambda *_, one=bump: iter([one])
            )
            assert len(find_bumps(a, stated)) == count
    assert tested == 16 - 8  # of two photographs those that are not of the reference camera


@pytest.mark.parametrize(("share", "counts"), [(0.7e-9, False), (1.4e-9, True)])
def test_a_direction_of_a_pose_that_nothing_checks_gains_nothing(share: float, counts: bool) -> None:
    """A shift that a rotation takes up but for a share of its squares."""
    G = np.eye(6)
    G[0, 4] = G[4, 0] = 1 - share
    s = np.array([1.0, 0, 0, 0, -1.0, 0])
    gain, shift = _gain(s[None], G.reshape(1, 6, 1, 6), 0, [])
    assert gain == (pytest.approx(2 / share, rel=1e-3) if counts else pytest.approx(0.0, abs=1e-9))
    assert bool(np.abs(shift).max() > 1) == counts


def test_a_freed_photograph_is_compared_with_one_that_shares_its_pose() -> None:
    """Another one that left its place first would count as where the rig is."""
    network, truth = scene(7, 3)
    moved = network
    out = (1, 4, 13)  # of the second camera, at moments 0, 1 and 4
    for i, by in zip(out, (0.03, 0.01, -0.02), strict=True):
        moved = bumped(moved, truth, i, np.array([by, 0.0, 0.0]))
    number = np.arange(len(moved.images))
    assert moved.moment is not None
    free = replace(moved, moment=np.where(np.isin(number, out), 99 + number, moved.moment))
    a = adjust(free, truth, reject="none")
    found = list(_of_freed(a, np.array(out), network.moment))
    assert [one.shift for one in found] == pytest.approx([0.03, 0.01, 0.02], abs=1e-3)
