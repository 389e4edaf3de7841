"""Direct orientation to control, and separate adjustment."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.model.camera import tangents_from_pixel
from sfm.model.errors import GeometryError
from sfm.model.network import ObjectPoints, ScaleBars
from sfm.textbook.direct import adjust_separately, orient_direct
from tests.synthetic import make_network, perturb, seed_of


def _two(noise_px=0.1):
    network, truth = make_network(seed_of("direct"), images=8, points=30, noise_px=noise_px)
    keep = network.image_points.image < 2
    seen = network.image_points.select(keep)
    uv = tangents_from_pixel(truth.cameras[0], seen.xy)
    return seen, truth, uv, noise_px / truth.cameras[0].c_px


def test_direct_orientation():
    seen, truth, uv, sigma = _two()
    control = np.full_like(truth.points, np.nan)
    ids = np.intersect1d(seen.point[seen.image == 0], seen.point[seen.image == 1])
    control[ids[:6]] = truth.points[ids[:6]]
    both = np.isin(seen.point, ids)
    result = orient_direct(uv[both], seen.image[both], seen.point[both], control)
    assert result.converged
    assert result.redundancy == 4 * len(ids) - 12 - 3 * (len(ids) - 6)
    assert result.sigma0 == pytest.approx(sigma, rel=0.5)
    d = np.concatenate(
        [
            np.concatenate(
                [
                    result.positions[i] - truth.position[i],
                    _turn(truth.rotation[i].T @ result.rotations[i]),
                ]
            )
            for i in range(2)
        ]
    )
    # chi^2 with 12 degrees of freedom exceeds 33 once in 1000
    assert d @ np.linalg.solve(result.covariance * (sigma / result.sigma0) ** 2, d) < 33
    assert np.abs(result.points[ids] - truth.points[ids]).max() < 0.01
    np.testing.assert_array_equal(result.points[ids[:6]], truth.points[ids[:6]])
    # the new points strengthen the photographs against their resections alone
    alone = orient_direct(
        uv[np.isin(seen.point, ids[:6])],
        seen.image[np.isin(seen.point, ids[:6])],
        seen.point[np.isin(seen.point, ids[:6])],
        control,
    )
    together = np.diag(result.covariance) / result.sigma0**2
    assert (together <= np.diag(alone.covariance) / alone.sigma0**2 * (1 + 1e-9)).all()


def _turn(W):
    return np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]]) / 2


def test_direct_orientation_refusals():
    seen, truth, uv, _ = _two()
    control = np.full_like(truth.points, np.nan)
    ids = np.intersect1d(seen.point[seen.image == 0], seen.point[seen.image == 1])
    control[ids[:3]] = truth.points[ids[:3]]
    with pytest.raises(GeometryError, match="photograph 0: 3 points, resection needs 4"):
        orient_direct(uv, seen.image, seen.point, control)
    control[ids[:6]] = truth.points[ids[:6]]
    only = (seen.image == 0) | (seen.point != ids[10])
    with pytest.raises(GeometryError, match=f"point {ids[10]} is neither control nor seen by two"):
        keep = np.isin(seen.point, ids) & only
        orient_direct(uv[keep], seen.image[keep], seen.point[keep], control)


@pytest.mark.parametrize("free", [(), ("c", "x0", "y0", "K1")])
@pytest.mark.parametrize("control", [False, True])
def test_rounds_end_at_the_simultaneous_optimum(free: tuple[str, ...], control: bool) -> None:
    rng = seed_of(f"separate {free} {control}")
    network, truth = make_network(rng, images=6, points=20, free=free)
    if control:
        network = network.with_given(ObjectPoints(np.arange(8), truth.points[:8], np.zeros((8, 3, 3))))
    start = perturb(truth, rng, position=1e-3, angle_deg=0.1, points=1e-3)
    both = adjust(network, start, datum=Datum("control" if control else "free"), reject="none")
    turn = adjust_separately(network, start)
    assert turn.rounds > 5 * both.iterations
    assert turn.vPv == pytest.approx(both.vPv, rel=1e-6)
    if control:
        sigma = np.sqrt(np.diagonal(both.covariance.points, axis1=1, axis2=2))
        error = np.abs(turn.estimate.points - both.estimate.points)
        assert (error <= 0.1 * sigma + 1e-12).all()


def test_scale_bars_are_refused() -> None:
    network, truth = make_network(seed_of("bars"), images=4, points=10)
    bars = ScaleBars(np.array([0]), np.array([1]), np.array([1.0]), np.array([1e-3]))
    with pytest.raises(GeometryError, match="expected image points and fixed control only"):
        adjust_separately(network.with_given(bars), truth)
