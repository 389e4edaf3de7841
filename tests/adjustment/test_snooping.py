"""Data snooping of many image points a round rejects what it rejects one by one."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.gross_errors import rejection
from sfm.adjustment.quality.gross_errors.robust import _Rays, would_pass
from sfm.adjustment.quality.gross_errors.robust import snoop as many_at_once
from sfm.adjustment.quality.statistics import standardised_residuals, tau_critical
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.errors import GeometryError
from sfm.model.network import ImagePoints
from tests.synthetic import make_network, seed_of

NETWORKS = 50


def spoiled_network(k, of_points=1.0):
    """Return a network of 6 to 20 photographs, 1 to 12 % of its image points off by 4 to 30 sigma.

    All these are rays of a share of the object points.
    """
    rng = seed_of(f"snooping {k}")
    network, truth = make_network(
        rng,
        images=int(rng.integers(6, 21)),
        points=int(rng.integers(80, 240)),
        visibility=rng.uniform(0.3, 0.9),
    )
    seen = network.image_points
    draw, share = rng.random(len(seen)), rng.uniform(0.01, 0.12)
    size = 0.1 * np.exp(rng.uniform(np.log(4), np.log(30), len(seen)))
    some = np.arange(len(network.points)) % 100 < 100 * of_points
    wrong = some[seen.point] & (draw < share / some.mean())
    turn = rng.uniform(0, 2 * np.pi, len(seen))
    xy = seen.xy + np.where(wrong, size, 0.0)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return replace(network, image_points=replace(seen, xy=xy)), truth, wrong


def one_by_one(observations, state, v, complement, limiting, used, *, sigma0, critical):
    """Take out the image point of the largest tau of all, as Baarda and Pope did."""
    w = np.abs(standardised_residuals(v, complement, observations.whitening)).max(axis=1)
    tau = np.where(np.isfinite(w), w, np.inf) / sigma0
    return used & (tau > critical) & (tau == tau[used].max())


def rejected(network, truth, snoop=None, start=None):
    """Return what data snooping rejects, and its rounds."""
    rounds = []
    method = snoop or many_at_once

    def counted(*arguments, **options):
        rounds.append(1)
        return method(*arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rejection, "snoop", counted)
        patch.setattr(rejection, "MAX_ROUNDS", 5000)
        alpha = 1 - 0.95 ** (1 / (2 * len(network.image_points)))
        found = adjust(
            network,
            truth,
            datum=Datum("free"),
            covariance=False,
            rejected=start,
            options=AdjustmentOptions(alpha=alpha),
        )
    return found.rejected, len(rounds)


def compared(k, of_points=1.0):
    """Return a network, what is wrong in it, what both ways reject, and the rounds of both."""
    network, truth, wrong = spoiled_network(k, of_points)
    many, rounds = rejected(network, truth)
    single, single_rounds = rejected(network, truth, one_by_one)
    return network, wrong, many, single, rounds, single_rounds


def test_image_points_rejected_before_may_be_left_out_from_the_start():
    """The same are rejected in fewer rounds; good ones among them are taken back."""
    network, truth, _ = spoiled_network(1)
    alpha = 1 - 0.95 ** (1 / (2 * len(network.image_points)))
    first = adjust(network, truth, covariance=False, options=AdjustmentOptions(alpha=alpha))
    for also in (0, 5):
        without = first.rejected.copy()
        without[np.flatnonzero(~first.rejected)[:also]] = True
        again = adjust(
            network,
            first.estimate,
            covariance=False,
            rejected=without,
            options=AdjustmentOptions(alpha=alpha),
        )
        np.testing.assert_array_equal(again.rejected, first.rejected)
        np.testing.assert_allclose(again.estimate.points, first.estimate.points, atol=1e-6)
    assert again.iterations < first.iterations


@pytest.mark.parametrize("reject", ["tau", "huber"])
def test_image_points_rejected_before_are_one_truth_value_each(reject):
    network, truth = make_network(seed_of("truth values"), images=4, points=20)
    k = len(network.image_points)
    wrong = {
        rf"shape \(3,\), .* {k} image": np.zeros(3, dtype=bool),
        rf"int64 of shape \({k},\)": np.arange(k),
        rf"all {k} image points": np.ones(k, dtype=bool),
    }
    for message, rejected in wrong.items():
        with pytest.raises(GeometryError, match=f"rejected.*{message}"):
            adjust(network, truth, reject=reject, rejected=rejected)


@pytest.mark.parametrize("ray", [5, 77, 130])
def test_a_rejected_image_point_comes_back_where_it_would_pass_in_the_adjustment(ray):
    """Not where its predicted residual passes, which tests both coordinates at once."""
    network, truth = make_network(seed_of("comes back"), images=6, points=40, visibility=0.8)
    seen, alpha = network.image_points, 0.001
    direction = np.array([0.6, 0.8])

    def moved(px):
        xy = seen.xy.copy()
        xy[ray] += px * direction
        return replace(network, image_points=replace(seen, xy=xy))

    def excess(px):
        one = adjust(moved(px), truth, reject="none")
        tau = np.abs(one.standardised[ray]).max() / one.sigma0
        return tau - tau_critical(alpha, one.redundancy)

    limit = brentq(excess, 0.0, 3.0, xtol=1e-6)
    alone = np.zeros(len(seen), dtype=bool)
    alone[ray] = True
    for share in (0.98, 1.0):
        found = adjust(
            moved(share * limit),
            truth,
            rejected=alone,
            covariance=False,
            options=AdjustmentOptions(alpha=alpha),
        )
        assert found.rejected[ray] == (share == 1.0)


@pytest.mark.parametrize("offset, passes", [([0.9, -0.45], False), ([450.0, 900.0], True)])
def test_a_ray_that_alone_places_its_point_is_tested_across_the_other(offset, passes):
    """Without it the point has no place along the other ray: its cofactor there is 1e16, and singular."""
    singular = 2.0**53 * np.array([[1.0, 2.0], [2.0, 4.0]])
    observations = SimpleNamespace(
        whitening=np.tile([10.0, 0.0, 10.0], (3, 1)), xy=np.full((3, 2), 9.0), share=np.ones(3)
    )
    back = would_pass(
        *(observations, np.array([[0.0, 0.0]] * 2 + [offset]), np.stack([np.eye(2)] * 2 + [singular])),
        np.array([True, True, False]),
        vPv=900.0,
        redundancy=1000.0,
        alpha=0.001,
    )
    assert back.tolist() == [False, False, passes]


def test_many_at_once_are_the_same_as_one_by_one():
    _, _, many, single, rounds, single_rounds = compared(1)
    np.testing.assert_array_equal(many, single)
    assert single.sum() > 10 and rounds <= 6 and single_rounds > 30


@pytest.mark.slow
@pytest.mark.parametrize("of_points", [1.0, 0.2])
def test_the_same_rejections_in_fifty_networks(of_points):
    """But for one in a hundred, in points of which several rays are wrong: there the order decides which.

    With wrong rays in a fifth of the points alone, up to half of all rays of a point are wrong.
    """
    others, rejections, networks, rounds = 0, 0, 0, np.zeros(2, dtype=int)
    good, left = np.zeros(2, dtype=int), np.zeros(2, dtype=int)
    for k in range(NETWORKS):
        _, wrong, many, single, *own_rounds = compared(k, of_points)
        rounds += own_rounds
        others, rejections = others + int((many != single).sum()), rejections + int(single.sum())
        networks += (many != single).any()
        good += (many & ~wrong).sum(), (single & ~wrong).sum()
        left += (~many & wrong).sum(), (~single & wrong).sum()
    print(
        f"\n{rounds[0]} rounds in place of {rounds[1]}: {others} of {rejections} rejections "
        f"differ in {networks} networks; good ones rejected {good}, wrong ones left {left}"
    )
    assert others <= 0.01 * rejections and rounds[0] < rounds[1] / 5
    assert good[0] <= 1.1 * good[1] and left[0] <= 1.01 * left[1]


def test_several_wrong_rays_of_a_point_leave_in_one_round():
    """They are the same, one after another, as in as many adjustments."""
    rng = seed_of("wrong rays")
    network, truth = make_network(rng, images=12, points=120, visibility=0.8)
    seen = network.image_points
    xy = seen.xy.copy()
    for j in (3, 50, 99):
        wrong = np.flatnonzero(seen.point == j)[:3]
        xy[wrong] += rng.uniform(1.5, 4.0, (3, 2)) * rng.choice([-1, 1], (3, 2))
    network = replace(network, image_points=replace(seen, xy=xy))
    many, rounds = rejected(network, truth)
    single, single_rounds = rejected(network, truth, one_by_one)
    np.testing.assert_array_equal(many, single)
    assert single.sum() >= 9 and rounds <= 4 and single_rounds >= 10


def test_what_is_left_when_rays_leave_is_that_of_an_adjustment_without_them():
    """With the cameras fixed: residuals and cofactors of the other rays, and those of the point."""
    rng = seed_of("rays leave")
    B, error = rng.standard_normal((6, 2, 3)), rng.standard_normal((6, 2))

    def adjusted(rows):
        A = B[rows].reshape(-1, 3)
        C = np.linalg.inv(A.T @ A)
        e = error.reshape(-1) - B.reshape(-1, 3) @ (C @ A.T @ error[rows].reshape(-1))
        return _Rays(e.reshape(-1, 2), np.eye(2) - B @ C @ B.transpose(0, 2, 1), B, C)

    left = adjusted(np.arange(6)).without(4).without(1)
    again, rest = adjusted([0, 2, 3, 5]), [0, 2, 3, 5]
    np.testing.assert_allclose(left.C, again.C, atol=1e-12)
    np.testing.assert_allclose(left.e[rest], again.e[rest], atol=1e-12)
    np.testing.assert_allclose(left.Q[rest], again.Q[rest], atol=1e-12)


def test_a_point_that_keeps_rays_from_one_place_leaves():
    """Of three rays two are from the same place, and the third is wrong: nothing tells its depth any more."""
    network, truth = make_network(seed_of("one place"), images=8, points=60, free=("c",))
    seen, twin = network.image_points, network.image_points.image == 0
    image, point = np.append(seen.image, np.full(twin.sum(), 8)), np.append(seen.point, seen.point[twin])
    noise = 0.1 * seed_of("twin").standard_normal((int(twin.sum()), 2))
    xy = np.concatenate([seen.xy, seen.xy[twin] + noise])
    xy[(image == 3) & (point < 5)] += 6.0
    keep = (point >= 5) | np.isin(image, (0, 3, 8))
    points = ImagePoints(image, point, xy, np.tile(0.01 * np.eye(2), (len(xy), 1, 1))).select(keep)
    network = replace(
        network, images=(*network.images, "twin"), camera=np.append(network.camera, 0), image_points=points
    )
    start = replace(
        truth,
        position=np.vstack([truth.position, truth.position[:1] + 1e-6]),
        rotation=np.concatenate([truth.rotation, truth.rotation[:1]]),
    )
    found = adjust(network, start, datum=Datum("free"), options=AdjustmentOptions(alpha=1e-4))
    assert found.converged and found.iterations < 20
    assert found.rejected[points.point < 5].all() and not found.rejected[points.point >= 5].any()
    assert np.isnan(found.covariance.points[:5]).all() and np.isfinite(found.covariance.points[5:]).all()


def only_where_nothing_is_rejected(_, __, ___, out, **____):
    """Stand for the question what stays right: nothing does beside a rejection."""
    return np.full(len(out), not out.any())


def test_reinstating_beside_rejecting_takes_fewer_rounds_for_the_same_image_points() -> None:
    """Begun without a twentieth of the right image points, as another adjustment may have rejected them."""
    rounds, differ, count = {"beside": 0, "after": 0}, 0, 0
    for k in range(8):
        network, truth, wrong = spoiled_network(k)
        start = ~wrong & (seed_of(f"left out {k}").random(len(wrong)) < 0.05)
        left_out = {}
        for when in rounds:
            with pytest.MonkeyPatch.context() as patch:
                if when == "after":
                    patch.setattr(rejection, "_stays_right", only_where_nothing_is_rejected)
                left_out[when], needed = rejected(network, truth, start=start)
            rounds[when] += needed
        differ += int((left_out["beside"] != left_out["after"]).sum())
        count += len(wrong)
    assert rounds["beside"] < 0.9 * rounds["after"]
    assert differ < 1e-3 * count
