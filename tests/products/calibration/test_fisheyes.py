"""Fisheyes of 190 degrees: calibrated with image points beyond 90 degrees from the axis, with true sigmas."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import sfm
from sfm.adjustment.solve import predict
from sfm.model.camera import pixel_curvature, project, ray_jacobian, rays_from_pixel
from sfm.orientation.eccentricity import CircleViews, fit_circles
from sfm.orientation.image_rays import axes_along
from sfm.products.calibration import projection_uncertainty
from tests.commands import kolinear
from tests.products.calibration.fisheyes import FISHEYE, fisheye_board, off_axis
from tests.products.calibration.surveys import write_board_survey
from tests.products.calibration.test_projection import projected
from tests.synthetic import perturb, seed_of

MIDDLE = FISHEYE.principal_point_px - 0.5
# in the middle, at about 50 degrees and, on three sides, at about 94 degrees from the axis
PLACES = MIDDLE + np.array([[0, 0], [300, 0], [0, -300], [-578, 0], [0, 578], [409, -409]])


def write_fisheye_survey(folder: Path, name: str, *, c_mm: float) -> Path:
    """Write the survey of a board in photographs of a fisheye; only c is known roughly."""
    camera = (
        'name = "cam"\nsize_px = [1200, 1200]\npixel_mm = [0.005, 0.005]\nmodel = "opencv_fisheye"\n'
        f'c_mm = {c_mm}\nfree = ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"]\n'
    )
    board = fisheye_board(seed_of("survey of a fisheye"))
    return write_board_survey(folder, board, name=name, camera=camera, free="")


def test_points_beyond_90_degrees_are_adjusted() -> None:
    board = fisheye_board(seed_of("fisheye"))
    network, seen = board.noisy(seed_of("points beyond")), board.network.image_points
    angle = np.concatenate(
        [
            off_axis(board.truth.position[i], board.truth.rotation[i], board.truth.points)[
                seen.point[seen.image == i]
            ]
            for i in range(len(network.images))
        ]
    )
    assert (angle > 90).sum() > 50 and angle.max() > 94
    start = perturb(board.truth, seed_of("start"), points=0.0)
    a = sfm.adjust(network, start, datum="control", reject="none")
    assert a.converged and 0.9 < a.sigma0 < 1.1
    beyond = a.residuals[angle > 90]
    assert np.isfinite(beyond).all() and 0.085 < np.sqrt((beyond**2).mean()) < 0.115
    error = a.estimate.cameras[0].parameters - FISHEYE.parameters
    assert (np.abs(error) < 4 * np.sqrt(np.diagonal(a.covariance.interior[0]))).all()
    without = sfm.adjust(
        sfm.Network(
            network.images, network.camera, network.points, network.image_points.select(angle < 90),
        ).with_control(network.points, board.truth.points, 0.0),
        start, datum="control", reject="none",
    )  # fmt: skip
    known, less = projection_uncertainty(a), projection_uncertainty(without)
    assert (known.sigma_at(PLACES[3:], np.inf) < 0.8 * less.sigma_at(PLACES[3:], np.inf)).all()


def test_stated_sigmas_are_true_beyond_90_degrees() -> None:
    """Thirty calibrations: their parameters and projections scatter as stated, 0.9 to 1.1."""
    board, rng = fisheye_board(seed_of("fisheye")), seed_of("thirty fisheyes")
    assert (rays_from_pixel(FISHEYE, PLACES)[3:, 2] > 0.05).all()
    expected = predict(board.network, board.truth, datum="control")
    known = projection_uncertainty(expected)
    root = np.linalg.inv(np.linalg.cholesky(expected.covariance.interior[0]))
    normed, shifts = [], []
    for _ in range(30):
        a = sfm.adjust(board.noisy(rng), board.truth, datum="control", reject="none", covariance=False)
        normed.append(root @ (a.estimate.cameras[0].parameters - FISHEYE.parameters))
        shifts.append(projected(board.truth, a.estimate, PLACES, np.inf) - PLACES)
    assert 0.9 < np.sqrt(np.mean(np.square(normed))) < 1.1
    ratio = np.sqrt((np.array(shifts) ** 2).mean(axis=(0, 2))) / known.sigma_at(PLACES, np.inf)
    assert 0.9 < np.sqrt((ratio**2).mean()) < 1.1 and ((ratio > 0.7) & (ratio < 1.3)).all()


@pytest.mark.usefixtures("plots")
def test_a_fisheye_of_190_degrees_is_calibrated_from_nothing(tmp_path: Path) -> None:
    """Without poses, and with c wrong by 10 %: the command gives the camera, and does not doubt it."""
    path = write_fisheye_survey(tmp_path / "s", "fisheye", c_mm=1.6)
    out = tmp_path / "out"
    assert kolinear("calibrate", path, "--out", out) == 0
    stored = json.loads((out / "calibration.json").read_text(encoding="utf-8"))
    (camera,) = stored["cameras"]
    for name in ("fx", "fy"):
        value, sigma = camera["focal_px"][name]["value"], camera["focal_px"][name]["sigma"]
        assert abs(value - 350.0) < 4 * sigma and sigma < 0.1
    assert stored["verdict"]["level"] == "good", stored["verdict"]


def test_the_eccentricity_of_circles_beyond_90_degrees_is_that_of_their_outlines() -> None:
    """Seen by tangents about their rays, as `sfm.survey.circles` has them for models of directions."""
    centre, normal, radius = np.array([300.0, 80.0, 12.0]), np.array([-0.8, 0.3, 0.5]), 8.0
    normal /= np.linalg.norm(normal)
    across = np.cross(normal, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    turn = np.linspace(0, 2 * np.pi, 4000, endpoint=False)[:, None]
    circle = centre + radius * (np.cos(turn) * across + np.sin(turn) * np.cross(normal, across))
    stations = np.array([[0.0, 0.0, 0.0], [120.0, -180.0, 4.0], [150.0, 320.0, -2.0], [80.0, 120.0, -9.0]])
    rays = centre - stations
    assert (rays[:, 2] > 0).all()  # behind the image planes
    shapes, truth, xy = [], [], project(FISHEYE, np.zeros(3), np.eye(3), rays)
    for station, seen in zip(stations, xy, strict=True):
        outline = project(FISHEYE, station, np.eye(3), circle)
        ends = np.roll(outline, -1, axis=0)
        area = (outline[:, 0] * ends[:, 1] - outline[:, 1] * ends[:, 0]) / 2
        middle = ((outline + ends) * area[:, None]).sum(axis=0) / 3 / area.sum()
        # triangles about the middle: squares at the middles of their sides
        p, q = outline - middle, ends - middle
        area = (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]) / 2
        second = sum(np.einsum("k,ki,kj->ij", area, side, side) for side in (p / 2, q / 2, (p + q) / 2)) / 3
        shapes.append(4 * second / area.sum())
        truth.append(middle - seen)
    along, k = axes_along(rays), len(stations)
    distance = np.linalg.norm(rays, axis=1)
    views = CircleViews(
        np.zeros(k, dtype=np.int64),
        np.array(shapes),
        np.column_stack([np.zeros((k, 2)), -distance]),
        along,
        ray_jacobian(FISHEYE, xy, rays / distance[:, None]) @ along[:, :, :2],
        pixel_curvature(FISHEYE, np.zeros((k, 2)), along),
    )
    shift = fit_circles(views, 1, radius=np.array([radius])).shift
    assert np.abs(truth).max() > 0.15
    np.testing.assert_allclose(shift, truth, atol=0.1 * np.abs(truth).max())
