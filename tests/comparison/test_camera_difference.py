"""The difference of two cameras: what a rotation takes up is none, and its sigma is true."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from sfm.adjustment.solve import adjust
from sfm.comparison.camera_difference import CameraDifference, compare_cameras
from sfm.comparison.camera_readjustment import LIMIT_PX, readjust_cameras, residuals_px
from sfm.model.camera import Camera, camera_from_values, pixel_from_tangents, tangents_from_pixel
from sfm.model.camera_file import CameraFile, cameras_of
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError, SurveyFileError, UnknownNameError
from tests.rigs import make_rig
from tests.synthetic import DISTORTION, make_network, observed_anew, seed_of

FREE = ("c", "x0", "y0", "K1", "K2", "P1", "P2")
SIZE = (2000, 1500)


def lens(**values: float) -> Camera:
    return camera_from_values(
        "lens", "brown", SIZE, (0.005, 0.005), c_mm=10.0, values=tuple({"K1": 1e-4, **values}.items())
    )


def test_a_camera_does_not_differ_from_itself() -> None:
    found = compare_cameras(lens(), lens())
    assert found.largest_px < 1e-8 and np.linalg.norm(found.rotation) < 1e-9
    assert found.significant is None and np.isnan(found.over_sigma) and found.known.all()


def test_a_shift_of_the_principal_point_is_nearly_a_rotation() -> None:
    """By x0 / c about the y axis; what is left of 20 px is far less than 20 px."""
    found = compare_cameras(lens(), lens(x0=0.1))
    np.testing.assert_allclose(found.rotation[1], 0.1 / 10, rtol=0.15)
    assert 0.01 < found.rms_px < 2.0


def test_a_distance_implies_a_shift_along_the_axis() -> None:
    """A longer principal distance looks like a smaller distance at one depth, and not at infinity."""
    longer = lens()
    longer = longer.with_parameters(longer.parameters * np.where(np.array(longer.names) == "c", 1.001, 1.0))
    far, near = compare_cameras(lens(), longer), compare_cameras(lens(), longer, distance=3.0)
    assert near.rms_px < far.rms_px / 3
    np.testing.assert_allclose(near.translation[:2], 0.0, atol=1e-6)
    assert abs(near.translation[2]) > 1e-3


def with_value(camera: Camera, name: str, value: float) -> Camera:
    return camera.with_parameters(np.where(np.array(camera.names) == name, value, camera.parameters))


def test_a_shift_is_converged_where_no_rotation_is_implied() -> None:
    """Against a search over shifts along the axis, which is the only shift by symmetry."""
    shorter, short = (
        with_value(lens(), "c", 8.0),
        compare_cameras(lens(), with_value(lens(), "c", 8.0), distance=3.0),
    )
    np.testing.assert_allclose(np.linalg.norm(short.rotation), 0.0, atol=1e-9)
    grid = np.stack(np.meshgrid(short.x, short.y), axis=-1).reshape(-1, 2)
    rays = np.column_stack([tangents_from_pixel(lens(), grid), -np.ones(len(grid))])
    points = 3.0 * rays / np.linalg.norm(rays, axis=1)[:, None]

    def rms(z: float) -> float:
        moved = points + np.array([0.0, 0.0, z])
        away = pixel_from_tangents(shorter, -moved[:, :2] / moved[:, 2:]) - grid
        return float(np.sqrt((away**2).sum(axis=1).mean()))

    best = minimize_scalar(rms, bounds=(0.0, 1.0), method="bounded")
    np.testing.assert_allclose(short.rms_px, best.fun, rtol=1e-6)
    far = compare_cameras(lens(), shorter, distance=300.0)  # the same but for the scale of the shift
    np.testing.assert_allclose(far.difference, short.difference, atol=1e-6)
    np.testing.assert_allclose(far.translation, 100 * short.translation, atol=1e-6)


@pytest.mark.parametrize("distance", [np.inf, 3.0])
@pytest.mark.parametrize(("name", "value"), [("c", 20.0), ("x0", 1.0), ("K1", -1e-3)])
def test_cameras_that_differ_much_have_the_right_sigma(name: str, value: float, distance: float) -> None:
    """The differences after a change of each parameter by its sigma, square by square."""
    a, b = lens(), with_value(lens(), name, value)
    sigma = {"c": 2e-3, "x0": 2e-3, "y0": 1e-3, "K1": 2e-6, "P1": 1e-6}
    Q = np.diag([sigma.get(of, 0.0) ** 2 for of in a.names])
    compared = compare_cameras(a, b, covariance=(Q, Q), distance=distance)
    expected = np.zeros_like(compared.covariance)
    for of, change in sigma.items():
        for pair in (
            (with_value(a, of, a.value(of) + change), b),
            (a, with_value(b, of, b.value(of) + change)),
        ):
            moved = compare_cameras(*pair, distance=distance).difference - compared.difference
            expected += moved[..., :, None] * moved[..., None, :]
    np.testing.assert_allclose(compared.expected_rms_px**2, np.einsum("rcii->rc", expected).mean(), rtol=0.05)


def test_places_at_the_end_of_a_models_range_are_not_known() -> None:
    """There its derivatives are missing; the others have an expected RMS all the same."""
    folding = camera_from_values("x", "opencv", SIZE, (1.0, 1.0), c_mm=900.0, values=(("k1", -0.4),))
    Q = np.diag(np.full(len(folding.names), 1e-6))
    compared = compare_cameras(folding, with_value(folding, "k1", -0.39), covariance=(Q, Q))
    assert 0.1 < compared.known.mean() < 1.0 and np.isfinite(compared.covariance[compared.known]).all()
    assert compared.over_sigma > 0.0 and 0.0 <= compared.p_value <= 1.0


def calibrated(rng: np.random.Generator) -> tuple[Camera, FloatArray, FloatArray]:
    """Return a camera, its covariance and its image points of one simulated calibration."""
    network, truth = make_network(seed_of("calibrations"), images=8, points=40, free=FREE, noise_px=0.0)
    network = observed_anew(network, truth, 0.2, rng)
    adjusted = adjust(network, truth, reject="none")
    file = cameras_of(adjusted.solution)
    seen, Q = file.image_points(file.cameras[0].name), file.covariance[0]
    assert seen is not None and Q is not None
    return file.cameras[0], Q / adjusted.sigma0**2 * max(adjusted.sigma0, 1.0) ** 2, seen


@pytest.fixture(scope="module")
def simulated() -> dict[float, list[CameraDifference]]:
    """Differences of pairs of independent calibrations of one camera, for directions and at a distance."""
    rng = seed_of("differences of calibrations")
    made = [calibrated(rng) for _ in range(120)]
    found: dict[float, list[CameraDifference]] = {}
    for distance in (np.inf, 5.0):
        found[distance] = [
            compare_cameras(a[0], b[0], covariance=(a[1], b[1]), seen_px=(a[2], b[2]), distance=distance)
            for a, b in zip(made[::2], made[1::2], strict=True)
        ]
    return found


@pytest.mark.parametrize("distance", [np.inf, 5.0])
def test_predicted_differences_are_those_of_simulated_calibrations(
    distance: float, simulated: dict[float, list[CameraDifference]]
) -> None:
    """Over the known region as a whole, in its middle and where it is largest; and few are significant."""
    differences = simulated[distance]
    predicted = np.sqrt(np.mean([one.expected_rms_px**2 for one in differences]))
    empirical = np.sqrt(np.mean([one.rms_px**2 for one in differences]))
    assert 0.9 < predicted / empirical < 1.1
    known = np.all([one.known for one in differences], axis=0)
    length = np.array([one.length_px for one in differences])
    variance = np.array([np.einsum("rcii->rc", one.covariance) for one in differences])
    ratio = np.sqrt(variance.mean(axis=0) / (length**2).mean(axis=0))[known]
    assert 0.9 < np.median(ratio) < 1.1
    p = np.array([one.p_value for one in differences])
    assert (p < 0.05).mean() < 0.15 and 0.35 < np.median(p) < 0.65
    assert not any(one.significant for one in differences[:20])


def test_another_camera_is_significant(simulated: dict[float, list[CameraDifference]]) -> None:
    camera, Q, seen = calibrated(seed_of("one calibration"))
    s = camera.names.index("K1")
    other = camera.parameters.copy()
    other[s] += 12 * np.sqrt(Q[s, s])
    found = compare_cameras(camera, camera.with_parameters(other), covariance=(Q, Q), seen_px=(seen, seen))
    assert found.significant and found.over_sigma > 1.5
    alone = compare_cameras(camera, camera.with_parameters(other), covariance=(Q, None))
    assert alone.has_sigma == (True, False) and alone.significant
    assert "px RMS" in repr(found) and "implied rotation" in found._repr_html_()


def test_what_cannot_be_compared_is_refused() -> None:
    small = replace(lens(), size_px=(1000, 750))
    with pytest.raises(GeometryError, match="photographs of 2000 x 1500 px and of 1000 x 750 px"):
        compare_cameras(lens(), small)
    with pytest.raises(GeometryError, match="distance -1, it must be positive"):
        compare_cameras(lens(), lens(), distance=-1.0)
    with pytest.raises(GeometryError, match="1 of 1036 places of the photograph are known"):
        compare_cameras(lens(), lens(), seen_px=(np.array([[0.0, 0], [5, 0], [0, 5]]), None))
    with pytest.raises(GeometryError, match="a covariance of shape"):
        compare_cameras(lens(), lens(), covariance=(np.eye(3), None))


def forms(*models: str) -> list[Form]:
    return [Form(model) for model in models]


class Form:
    """A model that a file stores."""

    def __init__(self, model: str, held: tuple[str, ...] = ()) -> None:
        self.model, self.held = model, held


def test_the_image_points_are_adjusted_again_in_the_other_model() -> None:
    """The misfit is a part of that of a curve over the photograph, and a rig keeps its mounts consistent."""
    network, truth = make_rig(seed_of("readjusted"), moments=8, points=50, free=FREE, noise_px=0.05)
    given = dict(DISTORTION)
    values = [
        of_rig.with_parameters(np.array([given.get(name, of_rig.value(name)) for name in of_rig.names]))
        for of_rig in truth.cameras
    ]
    solution = adjust(network, replace(truth, cameras=tuple(values)), reject="none").solution
    file = cameras_of(solution)
    anew, conversions = readjust_cameras(file, lambda camera: None, forms("opencv"))
    assert all(one.adjusted and one.rms_px < LIMIT_PX for one in conversions)
    assert [camera.model for camera in anew.cameras] == ["opencv", "opencv"]
    assert anew.mounts is not None and file.mounts is not None and all(Q is not None for Q in anew.covariance)
    np.testing.assert_allclose(anew.mounts.position, file.mounts.position, atol=1e-3)
    curves, fitted = readjust_cameras(replace(file, solution=None), lambda camera: None, forms("opencv"))
    assert not any(one.adjusted for one in fitted) and curves.mounts is file.mounts
    assert conversions[0].max_px < fitted[0].max_px and "image points adjusted again" in conversions[0].words
    same, none = readjust_cameras(file, lambda camera: camera, forms("opencv"))
    assert same.cameras == file.cameras and not none
    assert all(0.03 < rms < 0.07 for rms in residuals_px(solution))


def test_the_leanest_form_within_the_limit_is_taken() -> None:
    strong = camera_from_values(
        "wide", "full_opencv", (640, 480), (1.0, 1.0), c_mm=700.0,
        values=(("k1", -0.3), ("k2", 0.12), ("k3", -0.03)),
    )  # fmt: skip
    file = CameraFile("x", (strong,), (None,))
    _, (taken,) = readjust_cameras(file, lambda camera: None, forms("opencv", "brown_forward", "brown"))
    assert taken.camera.model == "brown_forward" and taken.rms_px < 1e-6
    _, (best,) = readjust_cameras(file, lambda camera: None, forms("pinhole"))
    assert best.rms_px > LIMIT_PX
    fisheye = camera_from_values("f", "opencv_fisheye", (640, 480), (1.0, 1.0), c_mm=400.0)
    with pytest.raises(SurveyFileError, match="opencv_fisheye cannot be converted to fov"):
        readjust_cameras(CameraFile("x", (fisheye,), (None,)), lambda camera: None, forms("fov"))


def test_a_camera_of_a_file_is_found_by_its_name() -> None:
    file = CameraFile("f.yaml", (lens(), replace(lens(), name="b")), (None, None))
    assert file.only("b").cameras[0].name == "b"
    with pytest.raises(UnknownNameError, match=r"f\.yaml: no camera 'c', it has lens, b"):
        file.only("c")
    with pytest.raises(SurveyFileError, match="2 cameras, one is needed; name it with --camera: lens, b"):
        file.only(None)
    assert file.image_points("lens") is None
    with pytest.raises(SurveyFileError, match="1 covariance of 2 cameras, needed one of each"):
        replace(file, covariance=(None,))
