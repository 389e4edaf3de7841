"""Uncertainty of projection against the scatter of simulated calibrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sfm
from sfm.adjustment.solve import predict
from sfm.model.camera import Camera, pixel_from_rays, rays_from_pixel
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.products.calibration.projection import ProjectionUncertainty, projection_uncertainty
from tests.products.calibration.boards import CAMERA, simulated_board
from tests.synthetic import seed_of

PIXELS = np.array(
    [[599.5, 449.5], [20.0, 20.0], [1179.0, 20.0], [20.0, 879.0], [1179.0, 879.0], [150.0, 600.0]]
)
DISTANCES = (300.0, 1000.0, np.inf)


def projected(truth: Estimate, estimate: Estimate, xy: FloatArray, distance: float) -> FloatArray:
    """Return where points at pixels and a distance of the true camera are imaged by the estimated one.

    Written as the definition reads: each photograph fixes them to the object, and the mean is projected.
    """
    camera: Camera = truth.cameras[0]
    ray = rays_from_pixel(camera, xy)
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    mean = np.zeros_like(ray)
    for i in range(len(truth.position)):
        if np.isfinite(distance):
            fixed = truth.position[i] + distance * ray @ truth.rotation[i].T
            mean += (fixed - estimate.position[i]) @ estimate.rotation[i]
        else:
            mean += ray @ truth.rotation[i].T @ estimate.rotation[i]
    return pixel_from_rays(estimate.cameras[0], mean)


def predicted_and_scatter(
    *, fixed: bool, simulations: int
) -> tuple[ProjectionUncertainty, dict[float, FloatArray]]:
    """Return the predicted uncertainty and the shifts of simulated calibrations, px, by distance."""
    board, rng = simulated_board(seed_of("projection"), fixed=fixed), seed_of("scatter")
    datum = "control" if fixed else "free"
    shifts: dict[float, list[FloatArray]] = {distance: [] for distance in DISTANCES}
    for _ in range(simulations):
        a = sfm.adjust(board.noisy(rng), board.truth, datum=datum, reject="none", covariance=False)
        for distance in DISTANCES:
            shifts[distance].append(projected(board.truth, a.estimate, PIXELS, distance) - PIXELS)
    predicted = projection_uncertainty(predict(board.network, board.truth, datum=datum))
    return predicted, {distance: np.array(of_distance) for distance, of_distance in shifts.items()}


@pytest.mark.parametrize("fixed", [True, False], ids=["fixed board", "free board"])
def test_predicted_scatter_is_that_of_a_hundred_calibrations(fixed: bool) -> None:
    predicted, simulated = predicted_and_scatter(fixed=fixed, simulations=100)
    for distance, shifts in simulated.items():
        ratio = predicted.sigma_at(PIXELS, distance) / np.sqrt((shifts**2).mean(axis=(0, 2)))
        assert ((ratio > 0.85) & (ratio < 1.15)).all(), (distance, ratio)


@pytest.mark.slow
@pytest.mark.parametrize("fixed", [True, False], ids=["fixed board", "free board"])
def test_predicted_scatter_is_that_of_many_calibrations(fixed: bool) -> None:
    predicted, simulated = predicted_and_scatter(fixed=fixed, simulations=3000)
    for distance, shifts in simulated.items():
        ratio = predicted.sigma_at(PIXELS, distance) / np.sqrt((shifts**2).mean(axis=(0, 2)))
        assert ((ratio > 0.95) & (ratio < 1.05)).all(), (distance, ratio)
        covariance = np.einsum("sni,snj->nij", shifts, shifts) / len(shifts)
        size = np.trace(covariance, axis1=1, axis2=2)[:, None, None]
        assert np.abs((predicted.covariance_at(PIXELS, distance) - covariance) / size).max() < 0.05


def test_distances_grow_into_infinity() -> None:
    board = simulated_board(seed_of("projection"))
    known = projection_uncertainty(predict(board.network, board.truth, datum="control"))
    far, infinite = known.sigma_at(PIXELS, 1e9), known.sigma_at(PIXELS, np.inf)
    assert np.allclose(far, infinite, rtol=1e-4)
    x, y, sigma = known.map_at(np.inf)
    assert sigma.shape == (len(y), len(x)) and sigma[len(y) // 2, len(x) // 2] < sigma[0, 0]


def test_the_datum_does_not_matter() -> None:
    board = simulated_board(seed_of("projection"), fixed=False)
    network = board.noisy(seed_of("noise"))
    free = sfm.adjust(network, board.truth, reject="none")
    minimal = sfm.adjust(network, board.truth, datum="minimal", reject="none")
    known, other = projection_uncertainty(free), projection_uncertainty(minimal)
    for distance in DISTANCES:
        assert np.allclose(known.sigma_at(PIXELS, distance), other.sigma_at(PIXELS, distance), rtol=1e-3)


@pytest.mark.parametrize("sigma", [0.01, 0.1, 1.0, 100.0])
def test_knowing_the_board_does_not_make_the_camera_less_certain(sigma: float) -> None:
    board = simulated_board(seed_of("projection"), fixed=False)
    network = board.network.with_control(board.network.points, board.truth.points, sigma)
    held = board.network.with_control(board.network.points, board.truth.points, 0.0)
    known, unknown, best = (
        projection_uncertainty(predict(seen, board.truth, datum=datum))
        for seen, datum in ((network, "control"), (board.network, "free"), (held, "control"))
    )
    for distance in DISTANCES:
        weighted, free = known.sigma_at(PIXELS, distance), unknown.sigma_at(PIXELS, distance)
        assert (weighted <= free * (1 + 1e-3)).all(), (distance, weighted / free)
        if sigma > 10:
            assert np.allclose(weighted, free, rtol=1e-2)
        if sigma < 0.05:
            assert np.allclose(weighted, best.sigma_at(PIXELS, distance), rtol=0.2)


def test_an_undetermined_camera_has_no_finite_uncertainty() -> None:
    board = simulated_board(seed_of("frontal"), tilt_deg=0.0, distance=(400.0, 400.0), photographs=6)
    known = projection_uncertainty(sfm.adjust(board.noisy(seed_of("n")), board.truth, datum="control"))
    assert not (known.sigma_at(PIXELS, np.inf) < 0.5).any()


def test_a_camera_without_photographs_is_refused() -> None:
    board = simulated_board(seed_of("projection"))
    estimate = replace(board.truth, cameras=(CAMERA, replace(CAMERA, name="other")))
    adjustment = sfm.adjust(board.network, estimate, datum="control")
    assert projection_uncertainty(adjustment, "cam").camera.name == "cam"
    with pytest.raises(GeometryError, match="no photograph of it took part"):
        projection_uncertainty(adjustment, "other")
