"""Two solutions of the same photographs: which is weaker, by its image points or by its lens model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.comparison import weaker_solution
from sfm.comparison.camera_readjustment import adjusted_with
from sfm.comparison.comparison_remarks import verdict_of_comparison
from sfm.comparison.significance import compare_results
from sfm.model.camera import Camera, camera_from_values
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import of_kind
from sfm.model.solution import Solution
from tests.synthetic import make_network, observed_anew, seed_of


def scene(name: str) -> tuple[Network, Estimate]:
    """Return a network whose lens has a strong radial distortion, without noise."""
    network, truth = make_network(seed_of(name), images=14, points=70, visibility=0.9)
    lens = camera_from_values(
        truth.cameras[0].name,
        "opencv",
        truth.cameras[0].size_px,
        tuple(truth.cameras[0].pixel_mm.tolist()),
        c_mm=truth.cameras[0].c_px * float(truth.cameras[0].pixel_mm[0]),
        free=("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
        values=(("k1", -0.25), ("k2", 0.3), ("p1", 2e-3), ("p2", -1e-3)),
    )
    return network, replace(truth, cameras=(lens,))


def solved(name: str, noise_px: float, *, lean: bool = False, seed: str = "") -> Solution:
    """Return a solution with image points of some noise, and without k2, p1 and p2 if it is lean."""
    network, truth = scene("weaker")
    network = observed_anew(network, truth, noise_px, seed_of(f"{name} {seed}"))
    if lean:
        camera = truth.cameras[0]
        kept = np.isin(camera.names, ["fx", "fy", "cx", "cy", "k1"])
        camera = replace(camera.with_parameters(np.where(kept, camera.parameters, 0.0)), free=kept)
        truth = replace(truth, cameras=(camera,))
    return replace(adjust(network, truth, datum="free", reject="none").solution, name=name)


@pytest.mark.parametrize("turned", [False, True])
def test_a_leaner_lens_and_coarser_image_points_are_named(turned: bool) -> None:
    fine, coarse = solved("survey", 0.05), solved("model", 0.4, lean=True)
    comparison = compare_results(*((coarse, fine) if turned else (fine, coarse)))
    (weakness,) = comparison.weaker
    assert (weakness.name, weakness.of) == ("model", "survey")
    assert weakness.sigma_px == pytest.approx(0.4, rel=0.5) and weakness.of_sigma_px == pytest.approx(
        0.05, rel=0.1
    )
    assert (
        weakness.model == "opencv without k2, p1, p2"
        and weakness.own_px < 0.06 < 0.08 < weakness.with_model_px
    )
    texts = [said.text for said in of_kind(verdict_of_comparison(comparison).remarks, "weaker_solution")]
    (text,) = texts
    assert text.startswith("model is weaker than survey: the standard deviation of its image points is 0.")
    assert "; its lens model opencv without k2, p1, p2 is too lean for camera " in text


def test_residuals_of_a_leaner_lens_do_not_make_its_image_points_coarse() -> None:
    (weakness,) = compare_results(solved("survey", 0.05), solved("model", 0.05, lean=True)).weaker
    assert weakness.sigma_px is None and weakness.cameras


def test_coarser_image_points_alone_are_named() -> None:
    (weakness,) = compare_results(solved("survey", 0.1), solved("model", 0.2)).weaker
    assert weakness.sigma_px == pytest.approx(0.2, rel=0.1) and not weakness.cameras


def test_like_solutions_and_solutions_of_other_photographs_have_no_weakness() -> None:
    assert compare_results(solved("a", 0.1), solved("b", 0.1, seed="other")).weaker == ()
    other = solved("b", 0.4)
    other = replace(
        other, network=replace(other.network, images=tuple(f"x{name}" for name in other.network.images))
    )
    assert compare_results(solved("a", 0.1), replace(other, images_named=True), align="points").weaker == ()


def test_solutions_without_noise_are_compared() -> None:
    (weakness,) = compare_results(solved("a", 0.0), solved("b", 0.1)).weaker
    assert weakness.name == "b" and weakness.of_sigma_px < 0.1 * 0.1
    (weakness,) = compare_results(solved("a", 0.0), solved("lean", 0.0, lean=True)).weaker
    assert weakness.name == "lean" and weakness.own_px < weakness.with_model_px


def test_cameras_of_one_model_are_adjusted_together(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = scene("weaker")
    (lens,) = truth.cameras
    count = len(network.images)
    cameras = tuple(replace(lens, name=f"{k}") for k in range(count))
    network = replace(observed_anew(network, truth, 0.05, seed_of("each")), camera=np.arange(count))
    truth = replace(truth, cameras=cameras)
    each = replace(Solution("each", network, truth), points_named=True, images_named=True)
    adjusted = list[int]()

    def counting(solution: Solution, cameras: dict[str, Camera]) -> Adjustment | None:
        adjusted.append(len(cameras))
        return adjusted_with(solution, cameras)

    monkeypatch.setattr(weaker_solution, "adjusted_with", counting)
    (weakness,) = compare_results(each, solved("model", 0.05, lean=True)).weaker
    assert weakness.cameras == tuple(camera.name for camera in cameras)
    assert adjusted == [0, count]


@pytest.mark.parametrize("turned", [False, True])
def test_results_whose_lenses_do_not_convert_are_compared(turned: bool) -> None:
    """A's fisheye was refused as no model to convert to."""
    survey, other = solved("survey", 0.05), solved("model", 0.05, seed="fisheye")
    (lens,) = other.estimate.cameras
    fisheye = camera_from_values(
        lens.name,
        "opencv_fisheye",
        lens.size_px,
        tuple(lens.pixel_mm.tolist()),
        c_mm=10.0,
        free=(),
        values=(),
    )
    other = replace(other, estimate=replace(other.estimate, cameras=(fisheye,)))
    comparison = compare_results(*((other, survey) if turned else (survey, other)))
    assert len(comparison.points) == len(survey.network.points)
    assert all(weakness.cameras == () for weakness in comparison.weaker)
    assert len(comparison.interior) == (0 if turned else 1)
