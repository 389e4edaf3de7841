"""Conversion between distortion models: directions, signs, the stated misfit, and back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison import camera_conversion
from sfm.comparison.camera_conversion import convert_camera, corresponding_free, start_values, undistort
from sfm.comparison.two_adjusters.adjusters import AdjusterComparison, compare_adjusters
from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import Camera, camera_from_values, pixel_from_tangents, tangents_from_pixel
from sfm.model.distortion.models import GENERAL_MODELS, MODELS, Model, Role
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.remarks.remark import of_kind
from tests.findings import findings_of
from tests.other_adjuster import in_house_adjuster
from tests.synthetic import make_network, seed_of

SIZE_PX = (2272, 1704)
HEIGHT_MM = 5.43764
PIXEL_MM = HEIGHT_MM / 1704
# camcal, free network: the values of an independent adjustment of 2074 image points (datasets/camcal)
CAMCAL = (
    ("x0", 3.615025 - 1136 * PIXEL_MM),
    ("y0", HEIGHT_MM / 2 - 2.613659),
    ("K1", 4.599155e-3),
    ("K2", -4.599046e-5),
    ("K3", -2.023446e-6),
    ("P1", -6.102879e-5),
    ("P2", -4.589405e-5),
    ("b1", 3.916193e-4),
)


def camcal() -> Camera:
    return camera_from_values(
        "olympus",
        "brown",
        SIZE_PX,
        (PIXEL_MM, PIXEL_MM),
        c_mm=7.456893,
        free=("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1"),
        values=CAMCAL,
    )


def everywhere() -> np.ndarray:
    """Pixels of a finer grid than the one that conversion fits to."""
    x, y = np.meshgrid(np.linspace(0, SIZE_PX[0] - 1, 61), np.linspace(0, SIZE_PX[1] - 1, 47))
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def misfit(a: Camera, b: Camera) -> np.ndarray:
    xy = everywhere()
    return pixel_from_tangents(b, tangents_from_pixel(a, xy)) - xy


def test_camcal_to_full_opencv_and_back_stays_within_three_hundredths_of_a_pixel() -> None:
    there = convert_camera(camcal(), "full_opencv")
    back = convert_camera(there.camera, "brown")
    assert there.rms_px * np.sqrt(2) == pytest.approx(0.0090, abs=2e-4)  # of the length; another grid
    assert there.max_px < 0.03
    assert back.max_px < 0.03
    np.testing.assert_allclose(back.camera.parameters[0], 7.456893, atol=2e-6)
    assert there.camera.free.all()
    assert dict(zip(back.camera.names, back.camera.free, strict=True)) == {
        **dict.fromkeys(back.camera.names, True),
        "b2": False,
    }


@pytest.mark.parametrize("model", ["full_opencv", "opencv", "brown_forward"])
def test_stated_misfit_is_what_an_independent_grid_finds(model: str) -> None:
    converted = convert_camera(camcal(), model)
    found = misfit(camcal(), converted.camera)
    assert np.sqrt((found**2).mean()) == pytest.approx(converted.rms_px, rel=0.25)
    assert np.hypot(*found.T).max() <= converted.max_px * 1.01


@pytest.mark.parametrize("share", [0.05, 0.15, 0.24, 0.35])
def test_a_fraction_fitted_to_a_lens_has_no_pole_in_the_photograph(share: float) -> None:
    """A common factor of numerator and denominator is to spare; its zero would have no pixel around it."""
    K1, K2 = 0.96 * share / 8.8, 0.04 * share / 8.8**2
    lens = camera_from_values(
        "right", "brown", (640, 480), (0.0074, 0.0074), c_mm=3.95,
        values=(("x0", 0.05), ("K1", K1), ("K2", K2), ("P1", -7e-5), ("P2", -3e-4), ("b1", -6e-4)),
    )  # fmt: skip
    converted = convert_camera(lens, "full_opencv")
    p = dict(zip(converted.camera.names, converted.camera.parameters, strict=True))
    poles = np.roots([p["k6"], p["k5"], p["k4"], 1.0])
    corner = (tangents_from_pixel(lens, np.array([[0.0, 0.0], [639.0, 479.0]])) ** 2).sum(axis=1).max()
    real = poles[np.abs(poles.imag) < 1e-12].real
    assert not ((real > 0) & (real < corner)).any()
    assert converted.rms_px < 0.2


def test_series_alone_gives_the_signs() -> None:
    """On a weak lens the neglected terms vanish: 10 px of distortion leave less than 0.1 px."""
    weak = camera_from_values(
        "weak",
        "brown",
        SIZE_PX,
        (PIXEL_MM, PIXEL_MM),
        c_mm=7.4,
        values=(("x0", 0.05), ("y0", -0.03), ("K1", 2e-4), ("K2", -1e-6), ("P1", 3e-5), ("P2", -4e-5)),
    )
    for model in ("opencv", "full_opencv"):
        there = start_values(weak, model)
        assert np.abs(misfit(weak, there)).max() < 0.1
        back = start_values(there, "brown")
        np.testing.assert_allclose(back.parameters[:3], weak.parameters[:3], atol=1e-12)
        np.testing.assert_allclose(back.parameters[6:8], weak.parameters[6:8], rtol=1e-9)
        assert back.parameters[3] == pytest.approx(2e-4, rel=1e-9)
    undistorted = camera_from_values("ideal", "opencv", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=7.4)
    assert np.abs(misfit(weak, undistorted)).max() > 5  # so that the 0.1 px above mean something


@pytest.mark.parametrize(
    ("source", "exact"), [("brown", "brown_forward_affine"), ("brown_forward_affine", "brown")]
)
def test_affinity_and_shear_keep_their_side_of_the_distortion(source: str, exact: str) -> None:
    """Affinity of 1 % and shear of 2 % of the distorted point, with 60 px of distortion.

    Nothing but the series that is cut short remains, a few thousandths of a pixel as without affinity; a
    model that has affinity and shear on the side of the ideal point leaves their product with the distortion.
    """
    sign = 1 if MODELS[source].corrects else -1
    values = (("K1", sign * 1.5e-3), ("b1", 0.01), ("b2", 0.02))
    camera = camera_from_values("a", source, SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=7.4, values=values)
    plain = camera.with_parameters(np.where(camera.plays(Role.AFFINITY, Role.SHEAR), 0.0, camera.parameters))
    assert convert_camera(camera, exact).max_px < 2 * convert_camera(plain, exact).max_px + 1e-3
    for other in ("brown_affine", "brown_forward"):
        assert convert_camera(camera, other).max_px > 0.1


def test_a_model_in_mm_without_affinity_is_converted(monkeypatch: pytest.MonkeyPatch) -> None:
    """As those of CONTRIBUTING's exercises are: before, a survey with one ended at its comparison."""
    brown = MODELS["brown"]
    monkeypatch.setitem(MODELS, "plain", Model("plain", brown.function, brown.parameters[:3]))
    camera = camera_from_values(
        "plain", "plain", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=7.4, values=(("x0", 0.02),)
    )
    assert not camera.plays(Role.AFFINITY).any()
    start = start_values(camera, "opencv")
    assert start.value("fx") == start.value("fy") == pytest.approx(7.4 / PIXEL_MM)
    assert (start.principal_point_px == camera.principal_point_px).all()
    assert start_values(camera, "brown_forward_affine").value("x0") == 0.02
    folded = camera_conversion._affinity_in_pixels(camera)
    assert (folded.parameters == camera.parameters).all() and (folded.pixel_mm == camera.pixel_mm).all()


@pytest.mark.parametrize("source", GENERAL_MODELS)
@pytest.mark.parametrize("target", GENERAL_MODELS)
def test_mild_lens_converts_between_all_models(source: str, target: str) -> None:
    rng = seed_of(f"mild {source} {target}")
    opencv = camera_from_values(
        "mild",
        "opencv",
        SIZE_PX,
        (PIXEL_MM, 1.001 * PIXEL_MM),
        c_mm=7.4,
        values=(
            ("k1", rng.uniform(-0.02, 0.02)),
            ("k2", rng.uniform(-0.01, 0.01)),
            ("p1", rng.uniform(-2e-4, 2e-4)),
            ("p2", rng.uniform(-2e-4, 2e-4)),
            ("cx", 1150.0),
        ),
    )
    camera = convert_camera(opencv, source).camera
    there = convert_camera(camera, target)
    back = convert_camera(there.camera, source)
    # Second-order terms of the reversed decentring, |p| * |k| * c_px ~ 2e-4 * 0.02 * 2300 px, remain.
    assert there.max_px < 0.02
    assert back.max_px < 0.02


def test_region_is_fitted_better_than_the_whole() -> None:
    region = np.array([600.0, 400.0, 1700.0, 1300.0])
    whole, part = convert_camera(camcal(), "opencv"), convert_camera(camcal(), "opencv", region_px=region)
    assert part.max_px < 0.2 * whole.max_px


def test_free_parameters_follow_their_meaning() -> None:
    camera = camera_from_values("a", "brown", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=7.4, free=("x0", "K1"))
    names = np.array(MODELS["full_opencv"].names)
    assert list(names[corresponding_free(camera, "full_opencv")]) == [
        "cx",
        "k1",
        "k2",
        "k3",
        "k4",
        "k5",
        "k6",
    ]


def test_same_model_is_left_alone_and_unknown_ones_are_refused() -> None:
    assert convert_camera(camcal(), "brown").camera.parameters == pytest.approx(camcal().parameters, abs=0)
    with pytest.raises(SurveyFileError, match="model 'fisheye', expected one of brown"):
        convert_camera(camcal(), "fisheye")


@pytest.mark.parametrize("model", ["brown", "full_opencv", "brown_forward"])
@pytest.mark.parametrize("models", [("opencv",), ("brown",), GENERAL_MODELS])
def test_rays_stay_and_covariances_follow(model: str, models: tuple[str, ...]) -> None:
    network, truth = make_network(seed_of("undistort"), images=2, points=10, model=model)
    camera = replace(truth.cameras[0], pixel_mm=truth.cameras[0].pixel_mm * [1.01, 1.0])
    truth = replace(truth, cameras=(camera,))
    straight, ideal = undistort(network, truth, models)
    new = ideal.cameras[0]
    assert new.model in models
    assert new.model == ("brown" if camera.in_mm and "brown" in models else new.model)
    distortion = [new.value(n) for n in new.names if n not in ("c", "x0", "y0", "fx", "fy", "cx", "cy")]
    assert not any(distortion) and not new.free[-len(distortion) :].any()
    assert new.pixel_mm[0] == new.pixel_mm[1]
    before, after = network.image_points, straight.image_points
    uv = tangents_from_pixel(camera, before.xy)
    np.testing.assert_allclose(tangents_from_pixel(new, after.xy), uv, atol=1e-13)
    assert np.abs(after.xy - before.xy).max() > 1  # px: there was something to correct
    # one sigma to the right by the covariance against where that point really goes
    step = 1e-3
    moved = replace(network, image_points=replace(before, xy=before.xy + np.array([step, 0])))
    G = (undistort(moved, truth, models)[0].image_points.xy - after.xy) / step
    along = replace(before, covariance=np.tile(np.diag([1.0, 0.0]), (len(before), 1, 1)))
    found = undistort(replace(network, image_points=along), truth, models)[0].image_points.covariance
    np.testing.assert_allclose(found, G[:, :, None] * G[:, None, :], atol=1e-5)


def test_what_cannot_be_inverted_is_refused() -> None:
    network, truth = make_network(seed_of("undistort"), images=2, points=10, model="opencv")
    camera = truth.cameras[0]
    folded = camera.with_parameters(camera.parameters + np.array([0, 0, 0, 0, -50.0, 0, 0, 0]))
    with pytest.raises(
        GeometryError, match=r"cannot be inverted at \d+ image points?, the first is point \d"
    ):
        undistort(network, replace(truth, cameras=(folded,)), ("opencv",))


def compared(stretch: float, free: tuple[str, ...]) -> tuple[AdjusterComparison, SurveyResult]:
    """Adjust and compare photographs whose pixels are wider than the survey says, by a factor."""
    network, truth = make_network(seed_of("better"), images=10, points=50, model="brown_forward", free=free)
    camera = truth.cameras[0]
    start = replace(truth, cameras=(replace(camera, pixel_mm=camera.pixel_mm * np.array([stretch, 1.0])),))
    a = adjust(network, start, datum=Datum("free"), reject="none")
    both = compare_adjusters(a, in_house_adjuster, name="other", model="opencv")
    codes = np.full(len(network.points), -1)
    return both, SurveyResult("s", "m", len(network.images), (), a, codes, both)


USUAL = ("c", "x0", "y0", "K1", "K2", "P1", "P2")


def test_a_camera_that_fits_many_times_better_is_no_agreement() -> None:
    both, result = compared(1.007, USUAL)
    assert both.agree and both.better is not None
    assert both.better.free == ("b1",)
    assert both.better.rms_px == pytest.approx(0.1, rel=0.1) and both.better.times > 5
    (found,) = of_kind(findings_of(result).verdict.remarks, "adjuster_fits_better")
    assert found.names("parameters") == ("b1",) and found.severity == "warning"
    assert found.number("times") == both.better.times


@pytest.mark.parametrize(("stretch", "free"), [(1.0, USUAL), (1.007, (*USUAL, "b1"))])
def test_a_camera_that_fits_as_well_is_not_reported(stretch: float, free: tuple[str, ...]) -> None:
    both, result = compared(stretch, free)
    assert both.agree and both.better is None
    assert not of_kind(findings_of(result).verdict.remarks, "adjuster_fits_better")
