"""Splined cameras: a lens that no parametric model describes, and one that a model does."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sfm
from sfm.adjustment.quality.correlations import observed_part
from sfm.adjustment.result import Adjustment
from sfm.model.camera import Camera, pixel_from_rays, ray_jacobian, rays_from_pixel
from sfm.model.conventions import FloatArray, skew
from sfm.model.errors import GeometryError
from sfm.products.calibration import projection_uncertainty, spline_camera
from sfm.products.calibration.residual_field import residual_field
from sfm.products.calibration.splined import SplinedCalibration, _with_knots, splined_like
from tests.commands import kolinear
from tests.products.calibration.boards import CAMERA, simulated_board
from tests.products.calibration.strange_lenses import noisy, strange_board, waves, with_everything_free
from tests.products.calibration.surveys import write_board_survey
from tests.products.calibration.test_projection import projected
from tests.synthetic import seed_of

EVERYTHING = 'free = ["c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1", "b2"]'
GRID = np.stack(np.meshgrid(np.linspace(0, 1199, 25), np.linspace(0, 899, 19)), -1).reshape(-1, 2)


@pytest.fixture(scope="module")
def parametric() -> Adjustment:
    board = strange_board(seed_of("strange"), photographs=60)
    start = with_everything_free(board.truth)
    return sfm.adjust(noisy(board, seed_of("strange noise")), start, datum="control", reject="none")


@pytest.fixture(scope="module")
def splined(parametric: Adjustment) -> SplinedCalibration:
    return spline_camera(parametric)


def errors(camera: Camera, inside: FloatArray, finer: float = 1.0) -> FloatArray:
    """Errors of projection of far points over the format, RMS of both coordinates, after one rotation, px."""
    return shifts(camera, rays_from_pixel(CAMERA, GRID), GRID + waves(GRID, finer), inside)


def shifts(camera: Camera, rays: FloatArray, expected: FloatArray, inside: FloatArray) -> FloatArray:
    """Shifts of projections from expected places after one rotation, RMS of both coordinates, px."""
    seen = pixel_from_rays(camera, rays)
    error = seen - expected
    turned = ray_jacobian(camera, seen, rays) @ -skew(rays)
    sound = inside & np.isfinite(turned).all(axis=(1, 2))
    w = np.linalg.lstsq(turned[sound].reshape(-1, 3), error[sound].ravel(), rcond=None)[0]
    return np.asarray(np.sqrt(((error - turned @ w) ** 2).mean(axis=1)))


def test_a_lens_that_no_model_describes_is_known_where_it_was_measured(
    parametric: Adjustment, splined: SplinedCalibration
) -> None:
    field = residual_field(parametric)
    assert field.whole < 0.001 and field.rms_px > 0.1
    assert splined.borne and splined.gain > 1000 and 50 < splined.determined < 150
    assert parametric.sigma0 > 4 and 0.95 < splined.adjustment.sigma0 < 1.05
    inside = observed_part(parametric.network.image_points.xy, GRID)[1]
    error, before = errors(splined.camera, inside), errors(parametric.estimate.cameras[0], inside)
    assert np.sqrt((error[inside] ** 2).mean()) < 0.02 < 0.2 < np.sqrt((before[inside] ** 2).mean())
    assert error[inside].max() < 0.05


def test_sigma_grows_where_there_are_no_image_points(
    parametric: Adjustment, splined: SplinedCalibration
) -> None:
    inside = observed_part(parametric.network.image_points.xy, GRID)[1]
    sigma = projection_uncertainty(splined.adjustment).sigma_at(GRID, np.inf)
    lean = projection_uncertainty(parametric).sigma_at(GRID, np.inf)
    usual = np.sqrt((sigma[inside] ** 2).mean())
    far = GRID[:, 0] > 1000
    assert usual < 0.05 and (sigma[far] > 3 * usual).all()
    error = errors(splined.camera, inside)[far]
    assert 0.4 < np.sqrt(np.mean((error / sigma[far]) ** 2)) < 2.5
    wrong = errors(parametric.estimate.cameras[0], inside)[far]
    assert np.sqrt(np.mean((wrong / lean[far]) ** 2)) > 3, "the parametric model does not know"


def test_the_stated_precision_of_image_points_does_not_matter(
    parametric: Adjustment, splined: SplinedCalibration
) -> None:
    """Ten times too small: sigma0 is 10, and surface, its size and its sigmas are the same."""
    network = parametric.network
    stated = replace(network.image_points, covariance=network.image_points.covariance / 100)
    a = sfm.adjust(replace(network, image_points=stated), parametric.estimate, datum="control", reject="none")
    other = _with_knots(a, 0, splined.knots)
    assert other.adjustment.sigma0 == pytest.approx(10 * splined.adjustment.sigma0, rel=1e-3)
    assert other.sigma_px == splined.sigma_px and other.gain == pytest.approx(splined.gain, rel=1e-3)
    rays = rays_from_pixel(CAMERA, GRID)
    moved = pixel_from_rays(other.camera, rays) - pixel_from_rays(splined.camera, rays)
    assert np.abs(moved).max() < 1e-2
    sigmas = [
        projection_uncertainty(a).sigma_at(GRID, np.inf) for a in (splined.adjustment, other.adjustment)
    ]
    np.testing.assert_allclose(*sigmas, rtol=1e-2)


def test_the_image_points_choose_the_grid(parametric: Adjustment, splined: SplinedCalibration) -> None:
    assert splined.knots == 10
    coarse, fine = (_with_knots(parametric, 0, knots) for knots in (7, 14))
    assert max(coarse.gain, fine.gain) < splined.gain - 10
    inside = observed_part(parametric.network.image_points.xy, GRID)[1]
    best, *others = (
        np.sqrt((errors(one.camera, inside)[inside] ** 2).mean()) for one in (splined, coarse, fine)
    )
    assert best < min(others)


def test_the_surface_is_no_surer_than_the_model_where_there_are_no_image_points() -> None:
    """Longer waves: the model follows them where image points are, and departs from the lens elsewhere."""
    ratios = []
    for finer in (0.35, 0.7):
        board = strange_board(seed_of(f"long waves {finer}"), photographs=40, finer=finer)
        start = with_everything_free(board.truth)
        a = sfm.adjust(noisy(board, seed_of("long noise")), start, datum="control", reject="none")
        surface = spline_camera(a)
        inside, far = observed_part(a.network.image_points.xy, GRID)[1], GRID[:, 0] > 1000
        error, before = (
            errors(camera, inside, finer)[far] for camera in (surface.camera, a.estimate.cameras[0])
        )
        assert np.sqrt((error**2).mean()) < 0.7 * np.sqrt((before**2).mean())
        sigma = projection_uncertainty(surface.adjustment).sigma_at(GRID, np.inf)[far]
        ratios.append(np.sqrt(np.mean((error / sigma) ** 2)))
    assert min(ratios) > 0.4 and max(ratios) < 2.5, ratios


@pytest.mark.slow
def test_shorter_waves_need_a_finer_grid() -> None:
    board = strange_board(seed_of("strange"), photographs=60, finer=2.0)
    start = with_everything_free(board.truth)
    a = sfm.adjust(noisy(board, seed_of("strange noise")), start, datum="control", reject="none")
    fine = spline_camera(a)
    assert fine.knots == 20 and fine.camera.model == "splined_20"
    inside = observed_part(a.network.image_points.xy, GRID)[1]
    assert np.sqrt((errors(fine.camera, inside, 2.0)[inside] ** 2).mean()) < 0.02


@pytest.mark.slow
def test_the_covariance_is_that_of_the_scatter() -> None:
    """Calibrations of one lens with other noise: coefficients that the image points determine scatter so."""
    board = strange_board(seed_of("scatter of splines"), photographs=24)
    start, rng = with_everything_free(board.truth), seed_of("splines")
    made = []
    for _ in range(10):
        a = sfm.adjust(noisy(board, rng), start, datum="control", reject="none")
        made.append(spline_camera(a))
    places = np.array([[150.0, 150.0], [400.0, 450.0], [650.0, 700.0], [150.0, 700.0], [650.0, 200.0]])
    truth = replace(board.truth, cameras=(made[0].camera,))
    shifts = np.array([projected(truth, one.adjustment.estimate, places, 400.0) for one in made])
    scatter = np.sqrt(shifts.var(axis=0, ddof=1).mean(axis=1))
    stated = np.mean([projection_uncertainty(one.adjustment).sigma_at(places, 400.0) for one in made], axis=0)
    assert 0.6 < np.sqrt(((scatter / stated) ** 2).mean()) < 1.2


def test_a_lens_that_its_model_describes_bears_no_surface() -> None:
    board = simulated_board(seed_of("usual lens"), photographs=12)
    a = sfm.adjust(board.noisy(seed_of("usual noise")), board.truth, datum="control", reject="none")
    usual = spline_camera(a)
    assert not usual.borne and usual.gain < 3
    inside = observed_part(a.network.image_points.xy, GRID)[1]
    moved = shifts(usual.camera, rays_from_pixel(a.estimate.cameras[0], GRID), GRID, inside)
    sigma = projection_uncertainty(a).sigma_at(GRID, np.inf)
    assert moved[inside].max() < 0.1 and (moved[inside] < sigma[inside]).all()


@pytest.mark.parametrize("model", ["brown", "opencv_fisheye"])
def test_the_surface_starts_as_the_adjusted_model(model: str) -> None:
    values = (("K1", -2e-3),) if model == "brown" else (("k1", -0.02), ("k2", 3e-3))
    c_mm = 6.0 if model == "brown" else 1.75
    camera = sfm.camera_from_values("a", model, (1200, 900), (0.005, 0.005), c_mm=c_mm, values=values)
    seen = GRID if model == "brown" else GRID[np.linalg.norm(GRID - (599.5, 449.5), axis=1) < 570]
    surface = splined_like(camera, seen, 14)
    rays = rays_from_pixel(camera, seen)
    error = pixel_from_rays(surface, rays) - seen
    most, rms = (0.02, 0.005) if model == "brown" else (0.15, 0.03)  # of 190 degrees, at the border
    assert np.abs(error).max() < most and np.sqrt((error**2).mean()) < rms
    assert surface.free.sum() == 2 * 14**2 and (surface.value("a_max") > 1.9) == (model != "brown")


def test_cameras_of_single_photographs_are_refused() -> None:
    board = simulated_board(seed_of("shared"), photographs=8)
    (camera,) = board.truth.cameras
    shared = replace(camera, shared=("", *("group",) * (len(camera.names) - 1)))
    a = sfm.adjust(board.network, replace(board.truth, cameras=(shared,)), datum="control", reject="none")
    with pytest.raises(GeometryError, match="differ between photographs"):
        spline_camera(a)


@pytest.mark.slow
def test_calibrate_offers_a_splined_camera_that_other_commands_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where the model is insufficient: a folder of its own, which is read, compared and used, or refused."""
    board = strange_board(seed_of("command of splines"), photographs=60)
    network = noisy(board, seed_of("noise of the command"))
    path = write_board_survey(tmp_path / "s", replace(board, network=network), free=EVERYTHING, noise=False)
    out = tmp_path / "out"
    kolinear("calibrate", path, "--out", out)
    stored = json.loads((out / "calibration.json").read_text(encoding="utf-8"))
    (camera,) = stored["cameras"]
    assert camera["residual_field"]["insufficient"] and camera["residual_field"]["p"] < 0.001
    assert camera["splined"]["gain"] > camera["splined"]["price"] and camera["splined"]["sigma0_px"] < 0.05
    page = (out / "calibration.html").read_text(encoding="utf-8")
    assert "A splined camera describes the lens" in page and f"--camera {out}/splined-cam" in page
    result = sfm.read_result(out / "splined-cam")
    (lens,) = result.estimate.cameras
    again = sfm.read_cameras(out / "splined-cam")
    assert lens.model.startswith("splined_") and (again.cameras[0].parameters == lens.parameters).all()
    assert again.covariance[0] is not None and (np.diagonal(again.covariance[0])[6:] > 0).all()
    capsys.readouterr()
    assert kolinear("compare", out, out / "splined-cam", "--cameras", "--out", tmp_path / "difference") == 0
    assert "more than chance" in capsys.readouterr().out
    assert kolinear("convert", out / "splined-cam", tmp_path / "a.yaml", "--to", "opencv-camera") == 2
    said = capsys.readouterr().err
    assert (
        "differs from splined_" in said
        and " by 0.2" in said
        and "px RMS" in said
        and not (tmp_path / "a.yaml").exists()
    )
    known = path.read_text(encoding="utf-8").replace(EVERYTHING, f'calibration = "{out / "splined-cam"}"')
    known = known.replace("c_mm = 6.0\n", "").replace("pixel_mm = [0.005, 0.005]\n", "")
    (tmp_path / "s" / "known.toml").write_text(known, encoding="utf-8")
    folder = tmp_path / "known"
    assert kolinear("adjust", tmp_path / "s" / "known.toml", "--out", folder, "--allow-outside") == 0
    used = json.loads((tmp_path / "known" / "summary.json").read_text(encoding="utf-8"))
    assert used["sigma0_px"] < 0.05
