"""COLMAP's camera models: what they project is what COLMAP projects, near the axis and far from it."""

from __future__ import annotations

import numpy as np
import pytest

from adapters.colmap.reconstruction import COLMAP_NAMES, as_opencv, camera_of, colmap_camera
from sfm.model.camera import Camera, pixel_from_tangents, tangents_from_pixel
from sfm.model.conventions import FloatArray
from sfm.model.distortion.models import COLMAP, MAX_PARAMETERS, MODELS, OF_COLMAP, Role, observe
from sfm.model.errors import BackendError
from tests.synthetic import DISTORTION, seed_of

pycolmap = pytest.importorskip("pycolmap")

SIZE_PX = (2000, 1600)
FOCAL_PX = 500.0  # a circle of 85 deg about the axis is 740 px wide on the photograph of an equidistant lens
PERSPECTIVE_DEG = 60.0  # beyond which the polynomials of perspective lenses fold over
WIDE_DEG = 85.0
# COLMAP cuts the series of FOV off where r^2 or omega^2 is below 1e-4
EXACT_DEG = {"fov": 0.6}


def wide(model: str) -> Camera:
    """Return a camera of a short focal length, distorted as the mild one of `tests.synthetic`."""
    values = {"f": FOCAL_PX, "fx": FOCAL_PX, "fy": 1.01 * FOCAL_PX} | dict(DISTORTION[model])
    values |= {"cx": 1003.0, "cy": 797.0}
    parameters = np.array([values[name] for name in MODELS[model].names])
    return Camera("wide", model, SIZE_PX, np.ones(2), parameters)


def rays(model: str) -> FloatArray:
    """Return tangents on the axis, near it, and as far as the model goes, (n, 2)."""
    rng = seed_of(f"rays of {model}")
    widest = PERSPECTIVE_DEG if "pinhole" in model or model in ("simple_radial", "radial") else WIDE_DEG
    angle = np.radians(np.r_[0.0, 1e-7, 1e-4, 1e-2, 1.0, 5.7, 5.75, rng.uniform(0, widest, 200), widest])
    azimuth = rng.uniform(0, 2 * np.pi, len(angle))
    return np.tan(angle)[:, None] * np.column_stack([np.cos(azimuth), np.sin(azimuth)])


@pytest.mark.parametrize("model", [one.name for one in COLMAP])
def test_pixels_are_those_of_colmap(model: str) -> None:
    camera = wide(model)
    theirs = colmap_camera(pycolmap, camera, 1)
    assert theirs.model_name == model.upper()
    assert [name.strip() for name in theirs.params_info.split(",")] == list(camera.names)
    assert (camera_of(theirs).parameters == camera.parameters).all()
    uv = rays(model)
    xy = pixel_from_tangents(camera, uv)
    expected = np.asarray(theirs.img_from_cam(np.column_stack([uv[:, 0], -uv[:, 1], np.ones(len(uv))]))) - 0.5
    far = np.hypot(*uv.T) > np.tan(np.radians(EXACT_DEG.get(model, 0.0)))
    assert np.abs(xy - expected)[far].max() < 1e-9
    assert np.abs(xy - expected).max() < 1e-7


@pytest.mark.parametrize("model", [one.name for one in COLMAP])
def test_rays_are_found_again_however_wide(model: str) -> None:
    camera, uv = wide(model), rays(model)
    back = tangents_from_pixel(camera, pixel_from_tangents(camera, uv))
    apart = np.linalg.norm(back - uv, axis=1) / (1 + (uv**2).sum(axis=1))  # the angle, rad, at most
    assert apart.max() < 1e-13


@pytest.mark.parametrize("model", [one.name for one in COLMAP])
def test_derivatives_on_the_axis_and_far_from_it(model: str) -> None:
    camera, h = wide(model), 1e-4
    n = len(camera.parameters)

    def observed(p: FloatArray, at: FloatArray) -> tuple[FloatArray, FloatArray]:
        r, Ju, Jp = np.empty(2), np.empty((2, 2)), np.empty((2, MAX_PARAMETERS))
        observe(camera.index, camera.frame, p, 0.0, 0.0, *at, r, Ju, Jp)
        return r, np.column_stack([Ju, Jp[:, :n]])

    def steps(direction: FloatArray, at: FloatArray) -> FloatArray:
        moved = [
            observed(camera.parameters + f * h * direction[2:], at + f * h * direction[:2])[0]
            for f in (-2, -1, 1, 2)
        ]
        return np.asarray((moved[0] - 8 * moved[1] + 8 * moved[2] - moved[3]) / (12 * h))

    for at in rays(model)[:40]:
        J = observed(camera.parameters, at)[1]
        differences = np.column_stack([steps(direction, at) for direction in np.eye(2 + n)])
        # rounding of 1000 px, and the fifth derivatives by coefficients of high powers of 85 deg
        assert np.abs(J - differences).max() < 1e-7 * max(1.0, np.abs(J).max())


def test_a_fraction_without_a_solution_is_no_pixel() -> None:
    """Division with k > 0 shows nothing beyond r = 1 / sqrt(4 k)."""
    camera = wide("simple_division")
    p = camera.parameters.copy()
    p[camera.plays(Role.RADIAL)] = 0.25
    xy = pixel_from_tangents(camera.with_parameters(p), np.array([[0.9, 0.0], [1.1, 0.0]]))
    assert np.isfinite(xy[0]).all() and np.isnan(xy[1]).all()


def test_models_with_fewer_parameters_are_opencv_ones() -> None:
    uv = rays("radial")
    for model in ("simple_pinhole", "pinhole", "simple_radial", "radial"):
        camera = wide(model)
        assert as_opencv(camera).model == "opencv"
        assert pixel_from_tangents(as_opencv(camera), uv) == pytest.approx(pixel_from_tangents(camera, uv))
    assert as_opencv(wide("fov")).model == "fov"


def test_a_panorama_is_refused_with_what_to_do() -> None:
    panorama = pycolmap.Camera.create_from_model_name(3, "EQUIRECTANGULAR", 1.0, 640, 320)
    with pytest.raises(
        BackendError, match=r"camera 3: COLMAP's model EQUIRECTANGULAR is not read.*perspective"
    ):
        camera_of(panorama)


def test_the_models_of_colmap_are_those_that_pycolmap_has() -> None:
    assert set(COLMAP_NAMES) == OF_COLMAP
