"""Camera models: derivatives against differences, inverse, signs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numba import njit

from sfm.model.camera import (
    Camera,
    camera_from_values,
    corner_shift,
    in_field,
    parameter_jacobian,
    pixel_from_rays,
    pixel_from_tangents,
    pixel_jacobian,
    plane_from_rays,
    project,
    rays_from_pixel,
    tangents_from_pixel,
)
from sfm.model.distortion.models import ALL, MAX_PARAMETERS, MODELS, Model, Parameter, Role, observe, one_of
from sfm.model.errors import SurveyFileError
from tests.synthetic import DISTORTION, FREE, PIXEL_MM, SIZE_PX, seed_of


def lens(model: str) -> Camera:
    """A camera with every parameter of its model different from 0."""
    rng = seed_of(model)
    camera = camera_from_values(
        "lens", model, SIZE_PX, PIXEL_MM, c_mm=10.0, free=FREE[model], values=DISTORTION[model]
    )
    size = {"K1": 1e-4, "K2": 1e-6, "K3": 1e-8, "K4": 1e-10, "b1": 1e-3, "b2": 1e-3}
    small = np.array([size.get(name, 1e-4) for name in camera.names])
    return camera.with_parameters(camera.parameters + small * rng.uniform(0.2, 1.0, len(small)))


def residual(camera: Camera, p: np.ndarray, xy: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, ...]:
    r, Ju, Jp = np.empty(2), np.empty((2, 2)), np.empty((2, MAX_PARAMETERS))
    MODELS[camera.model].function(camera.frame, p, xy[0], xy[1], uv[0], uv[1], r, Ju, Jp)
    return r, Ju, Jp[:, : len(p)]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("shrink", [2, 3])
def test_a_reduced_camera_sees_the_same_in_larger_pixels(model: str, shrink: int) -> None:
    camera = replace(lens(model), size_px=(SIZE_PX[0] - 1, SIZE_PX[1] - 1))  # a rest is cut off
    small = camera.reduced(shrink)
    assert small.size_px == tuple(side // shrink for side in camera.size_px)
    uv = seed_of(model).uniform(-0.2, 0.2, (20, 2))
    expected = (pixel_from_tangents(camera, uv) + 0.5) / shrink - 0.5
    assert pixel_from_tangents(small, uv) == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize("model", MODELS)
def test_derivatives_equal_differences(model: str) -> None:
    camera = lens(model)
    rng = seed_of(model + " derivatives")
    share = 1e-6 if model.startswith("splined") else 1e-8  # third derivatives of cubic splines have steps
    for xy in rng.uniform(100, 1400, (20, 2)):
        uv = tangents_from_pixel(camera, xy[None])[0] + rng.normal(0, 1e-3, 2)
        _, Ju, Jp = residual(camera, camera.parameters, xy, uv)
        Jp = Jp.copy()
        for s in range(2):
            h = 1e-4
            steps = [
                residual(camera, camera.parameters, xy, uv + f * h * np.eye(2)[s])[0] for f in (-2, -1, 1, 2)
            ]
            assert_derivative(Ju[:, s], steps, h, share)
        others = rng.choice(len(camera.parameters), min(20, len(camera.parameters)), replace=False)
        for s in np.union1d(np.flatnonzero(Jp.any(axis=0)), others):  # of a surface most are 0
            # moves the residual by 0.1 px at most, and seldom beyond a knot of a spline
            h = (0.01 if model.startswith("splined") else 0.1) / max(np.abs(Jp[:, s]).max(), 100.0)
            steps = [
                residual(camera, camera.parameters + f * h * np.eye(len(camera.parameters))[s], xy, uv)[0]
                for f in (-2, -1, 1, 2)
            ]
            assert_derivative(Jp[:, s], steps, h, share)


def assert_derivative(derivative: np.ndarray, steps: list[np.ndarray], h: float, share: float) -> None:
    """Five-point differences are good to h^4 and to the rounding of the residual over h."""
    difference = (steps[0] - 8 * steps[1] + 8 * steps[2] - steps[3]) / (12 * h)
    rounding = 1e-12 / h  # residuals are of the order of 1000 px
    assert np.abs(derivative - difference).max() <= share * np.abs(derivative).max() + rounding


def test_a_model_is_a_function_and_a_row() -> None:
    """A row more in the table is all that a further model needs to be observed by."""

    @njit(error_model="numpy")
    def fisheye(frame, p, x, y, u, v, r, Ju, Jp):  # type: ignore[no-untyped-def]
        r[0] = p[0] * np.arctan(u) - x
        r[1] = p[0] * np.arctan(v) - y

    further = Model("fisheye", fisheye, (Parameter("f", "px", Role.FOCAL),))
    assert (further.names, further.in_mm) == (("f",), False)
    observe = one_of((*ALL, further))
    r, Ju, Jp = np.zeros(2), np.zeros((2, 2)), np.zeros((2, MAX_PARAMETERS))
    observe(len(ALL), np.zeros(4), np.array([1000.0]), 1.0, 2.0, 0.5, -0.25, r, Ju, Jp)
    assert r == pytest.approx([1000 * np.arctan(0.5) - 1, 1000 * np.arctan(-0.25) - 2])
    for number, model in enumerate(ALL):
        camera = lens(model.name)
        assert camera.index == number and len(camera.units) == len(camera.names)
        xy, uv = np.array([400.0, 300.0]), np.array([0.2, -0.1])
        observe(number, camera.frame, camera.parameters, *xy, *uv, r, Ju, Jp)
        assert (r == residual(camera, camera.parameters, xy, uv)[0]).all()


@pytest.mark.parametrize("model", MODELS)
def test_rays_and_pixels_are_inverse(model: str) -> None:
    camera = lens(model)
    xy = seed_of("inverse").uniform((0, 0), SIZE_PX, (200, 2))
    uv = tangents_from_pixel(camera, xy)
    assert np.abs(pixel_from_tangents(camera, uv) - xy).max() < 1e-9


def strong_lens(model: str, rng: np.random.Generator) -> Camera:
    """A lens whose distortion moves the corner by tens of percent, of either sign, with all other effects."""
    c_mm, half = float(rng.uniform(4.0, 9.0)), np.hypot(*np.array(SIZE_PX) * PIXEL_MM) / 2
    camera = camera_from_values("strong", model, SIZE_PX, PIXEL_MM, c_mm=c_mm)
    reach = half if camera.in_mm else half / c_mm
    p, powers = camera.parameters.copy(), {Role.RADIAL: 0, Role.DENOMINATOR: 0}
    for s, parameter in enumerate(MODELS[model].parameters):
        share, role = rng.uniform(-0.4, 0.4), parameter.role
        if parameter.name in ("omega", "alpha", "beta"):
            p[s] = {"omega": 0.9, "alpha": 0.5, "beta": 1.0}[parameter.name] * (1 + share)
        elif role in powers:
            powers[role] += 1
            p[s] = share * (0.3 if role is Role.DENOMINATOR else 1.0) / reach ** (2 * powers[role])
        elif role in (Role.DECENTRING, Role.PRISM):
            p[s] = share / 20 / reach
        elif role in (Role.AFFINITY, Role.SHEAR):
            p[s] = share / 20
        elif role is Role.RANGE:
            p[s] = 1.0
        elif role is Role.SURFACE:
            p[s] = share / 10
        elif role in (Role.X0, Role.Y0):
            p[s] += share * (0.3 if camera.in_mm else 30.0)
    return camera.with_parameters(p)


def rays_of(camera: Camera, uv: np.ndarray) -> np.ndarray:
    """Directions with these coordinates in the plane of the camera's model."""
    r2 = (uv**2).sum(axis=1) / 4 if MODELS[camera.model].stereographic else np.zeros(len(uv))
    return np.column_stack([uv, r2 - 1])


def edge(camera: Camera, towards: np.ndarray, far: float) -> float:
    """Part of the way from the axis to `far` at which derivatives first lose the orientation of the axis."""
    J, Jp, r = np.empty((2, 2)), np.empty((2, MAX_PARAMETERS)), np.empty(2)
    corrects = MODELS[camera.model].corrects
    axis = camera.principal_point_px - 0.5 if corrects else np.zeros(2)

    def derivatives(at: np.ndarray) -> np.ndarray:
        xy, uv = (at, np.zeros(2)) if corrects else (np.zeros(2), at)
        observe(camera.index, camera.linear_frame, camera.parameters, *xy, *uv, r, J, Jp)
        return np.array(Jp[:, 1:3] if corrects else J)

    inverse = np.linalg.inv(derivatives(axis))
    for part in np.linspace(0, 1, 101)[1:]:
        turned = inverse @ derivatives(axis + part * far * towards)
        if not (np.isfinite(turned).all() and np.linalg.det(turned) > 0 and np.trace(turned) > 0):
            return float(part)
    return np.inf


@pytest.mark.parametrize("model", MODELS)
def test_rays_and_pixels_of_strong_lenses_are_inverse_up_to_the_fold_and_end_there(model: str) -> None:
    rng = seed_of(f"strong {model}")
    corrects = MODELS[model].corrects
    back = 0
    for _ in range(8):
        camera = strong_lens(model, rng)
        axis = camera.principal_point_px - 0.5 if corrects else np.zeros(2)
        far = np.hypot(*SIZE_PX) * 0.7 if corrects else 1.24 if MODELS[model].stereographic else 2.0  # 63 deg
        for angle in rng.uniform(0, 2 * np.pi, 5):
            towards = np.array([np.cos(angle), np.sin(angle)])
            at = edge(camera, towards, far)
            inside = axis + np.outer(rng.uniform(0.0, min(at - 0.02, 1.0), 5) * far, towards)
            if corrects:
                again = pixel_from_tangents(camera, tangents_from_pixel(camera, inside))
            else:
                rays = rays_from_pixel(camera, pixel_from_rays(camera, rays_of(camera, inside)))
                again = plane_from_rays(camera, rays)
            assert again == pytest.approx(inside, abs=1e-9, rel=1e-9)
            back += len(inside)
            if at >= 0.95:
                continue
            beyond = axis + np.outer(rng.uniform(at + 0.02, 1.0, 5) * far, towards)
            if corrects:  # their rays turn back; whatever has them is a pixel before the fold
                again = pixel_from_tangents(camera, tangents_from_pixel(camera, beyond))
                known = np.isfinite(again[:, 0])
                reached = np.linalg.norm(again[known] - axis, axis=1)
                assert (reached < (at + 0.02) * far).all()
            else:
                assert np.isnan(pixel_from_rays(camera, rays_of(camera, beyond))).all()
    assert back == 200


@pytest.mark.parametrize("model", MODELS)
def test_many_points_of_strong_lenses_are_mapped_like_single_ones(model: str) -> None:
    """The range without a fold is found once for many points, and tested for every one of few."""
    rng = seed_of(f"many {model}")
    for _ in range(4):
        camera = strong_lens(model, rng)
        xy = rng.uniform(-0.2, 1.2, (200, 2)) * SIZE_PX
        rays = rays_from_pixel(camera, xy)
        single = np.vstack([rays_from_pixel(camera, of_point[None]) for of_point in xy])
        assert rays == pytest.approx(single, rel=1e-9, abs=1e-9, nan_ok=True)
        single = np.vstack([pixel_from_rays(camera, ray[None]) for ray in rays])
        assert pixel_from_rays(camera, rays) == pytest.approx(single, rel=1e-9, abs=1e-9, nan_ok=True)


@pytest.mark.parametrize("share", [0.25, 0.4, 0.7])
def test_barrel_distortion_of_any_share_has_pixels_in_the_corners(share: float) -> None:
    """A fixed-point iteration diverges where 3 K1 r^2 reaches 1, and with it a third of a wide lens."""
    K1 = share / np.hypot(2.368, 1.776) ** 2
    camera = camera_from_values("wide", "brown", (640, 480), (0.0074, 0.0074), c_mm=3.9, values=(("K1", K1),))
    xy = np.array([[0.0, 0.0], [639.0, 0.0], [639.0, 479.0], [320.0, 0.0]])
    assert pixel_from_tangents(camera, tangents_from_pixel(camera, xy)) == pytest.approx(xy, abs=1e-9)
    assert np.isfinite(corner_shift(camera, 3, 1e-4))


def test_rays_are_found_where_a_model_is_badly_conditioned() -> None:
    """A fraction of two large polynomials: rounding alone is 5e-9 px at the border, over the tolerance."""
    names = MODELS["full_opencv"].names
    values = (
        2318.9480140959195, 2316.631409611496, 1150.0000265921674, 851.4999811407453,
        -5.20101347502722, 6.529947834774356, 1.3353232903087897e-4, -1.8985929217992648e-4,
        0.6056708355522757, -5.190179785106526, 6.472662701812773, 0.681379195975658,
    )  # fmt: skip
    camera = camera_from_values(
        "mild", "full_opencv", (2272, 1704), (0.0032, 0.0032), c_mm=7.4,
        values=tuple(zip(names, values, strict=True)),
    )  # fmt: skip
    x, y = np.meshgrid(np.linspace(0, 2271, 50), np.linspace(0, 1703, 50))
    xy = np.column_stack([x.ravel(), y.ravel()])
    assert np.abs(pixel_from_tangents(camera, tangents_from_pixel(camera, xy)) - xy).max() < 1e-6


def test_ray_to_the_right_and_up_is_seen_right_and_up() -> None:
    near = np.array([0.001, 0.0005])  # near the axis, where every projection is the central one
    for model in MODELS:
        camera = camera_from_values("ideal", model, SIZE_PX, PIXEL_MM, c_mm=10.0)
        x, y = pixel_from_tangents(camera, near[None])[0]
        assert x - (SIZE_PX[0] - 1) / 2 == pytest.approx(near[0] * 10.0 / PIXEL_MM[0], rel=1e-5)
        assert (SIZE_PX[1] - 1) / 2 - y == pytest.approx(near[1] * 10.0 / PIXEL_MM[1], rel=1e-5)


def test_points_behind_the_camera_are_not_seen() -> None:
    camera = camera_from_values("ideal", "brown", SIZE_PX, PIXEL_MM, c_mm=10.0)
    xy = project(camera, np.zeros(3), np.eye(3), np.array([[0, 0, -2.0], [0, 0, 2.0]]))
    assert np.isfinite(xy[0]).all()
    assert np.isnan(xy[1]).all()


@pytest.mark.parametrize("model", MODELS)
def test_what_a_photograph_shows_is_in_its_field(model: str) -> None:
    """Also beyond a right angle from the axis, where a lens shows that."""
    wide = MODELS[model].stereographic
    camera = camera_from_values("C", model, (2000, 1500), (0.005, 0.005), c_mm=2.7 if wide else 6.0)
    rng = seed_of(f"field {model}")
    away, turn = rng.uniform(0, np.radians(110), 2000), rng.uniform(0, 2 * np.pi, 2000)
    rays = np.column_stack([np.sin(away) * np.cos(turn), np.sin(away) * np.sin(turn), -np.cos(away)])
    xy = project(camera, np.zeros(3), np.eye(3), rays)
    shown = ((xy >= 0) & (xy <= (1999, 1499))).all(axis=1)
    inside = in_field(camera, np.zeros(3), np.eye(3), rays)
    assert shown.sum() > 100 and inside[shown].all()
    assert (wide or not inside.all()) and (model != "opencv_fisheye" or (away[shown] > np.pi / 2).any())
    assert not in_field(camera, np.zeros(3), np.eye(3), np.full((1, 3), np.nan)).any()


@pytest.mark.parametrize("model", MODELS)
def test_pixel_jacobian_against_differences(model: str) -> None:
    camera = lens(model)
    uv = np.array([[0.2, -0.15], [-0.3, 0.1]])
    J = pixel_jacobian(camera, pixel_from_tangents(camera, uv))
    h = 1e-6
    for a, e in enumerate(np.eye(2)):
        ahead, behind = pixel_from_tangents(camera, uv + h * e), pixel_from_tangents(camera, uv - h * e)
        assert np.abs(J[:, :, a] - (ahead - behind) / (2 * h)).max() < 1e-6 * camera.c_px


@pytest.mark.parametrize("model", MODELS)
def test_parameter_jacobian_against_differences(model: str) -> None:
    camera = lens(model)
    uv = np.array([[0.2, -0.15], [-0.3, 0.1], [0.01, 0.02]])
    J = parameter_jacobian(camera, uv)
    assert J.shape == (3, 2, len(camera.parameters))
    for s in range(len(camera.parameters)):
        moves = max(np.abs(J[:, :, s]).max(), 1.0)  # some coefficients act elsewhere
        step = np.zeros(len(camera.parameters))
        step[s] = 1e-4 / moves  # px
        ahead, behind = (
            pixel_from_tangents(camera.with_parameters(camera.parameters + sign * step), uv)
            for sign in (1, -1)
        )
        assert np.abs(J[:, :, s] * step[s] - (ahead - behind) / 2).max() < 1e-8


def test_parameter_jacobian_is_unknown_where_the_distortion_folds_over() -> None:
    camera = camera_from_values("folded", "brown", SIZE_PX, PIXEL_MM, c_mm=10.0, values=(("K1", 0.1),))
    uv = np.array([[0.05, 0.0], [3.0, 2.0]])
    J = parameter_jacobian(camera, uv)
    assert np.isfinite(J[0]).all()
    assert np.isnan(J[1]).all() == np.isnan(pixel_from_tangents(camera, uv)[1]).all()


@pytest.mark.parametrize(
    ("model", "free", "values", "message"),
    [
        ("panorama", (), (), "model 'panorama', expected one of brown"),
        ("brown", ("f",), (), "has no parameter 'f'"),
        ("opencv", (), (("K1", 0.1),), "has no parameter 'K1'"),
    ],
)
def test_unknown_names_are_refused(
    model: str, free: tuple[str, ...], values: tuple[tuple[str, float], ...], message: str
) -> None:
    with pytest.raises(SurveyFileError, match=message):
        camera_from_values("A", model, SIZE_PX, PIXEL_MM, c_mm=10.0, free=free, values=values)


def test_a_camera_needs_all_parameters_of_its_model() -> None:
    with pytest.raises(SurveyFileError, match="3 parameters, model brown has 10"):
        Camera("A", "brown", SIZE_PX, np.array(PIXEL_MM), np.zeros(3))


def test_the_corner_of_a_fisheye_that_no_ray_reaches_is_taken_farther_in() -> None:
    """Of 150 px focal length, 800 by 600 px: 180 degrees off the axis lie at 0.94 of the half diagonal."""
    p = np.array([150.0, 150.0, 399.5, 299.5, 0.0, 0.0, 0.0, 0.0])
    camera = Camera("lens", "opencv_fisheye", (800, 600), np.ones(2), p)
    half = np.hypot(800, 600) / 2
    assert corner_shift(camera, 2, 5.0) == pytest.approx(5.0 / half)
    angle = 299.5 / 150.0 * half / 300 * 0.92  # of places, each 0.04 of the diagonal, the first inside
    assert corner_shift(camera, 4, 1e-4) == pytest.approx(1e-4 * angle**3 * 150 / half, rel=0.02)
    assert corner_shift(camera, 4, np.inf) == np.inf
    narrow = camera.with_parameters(np.array([600.0, 600.0, *p[2:]]))
    assert corner_shift(narrow, 0, 6.0) == pytest.approx(0.01 * 399.5 / half, rel=1e-6)
