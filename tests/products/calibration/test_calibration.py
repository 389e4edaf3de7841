"""The calibration of a survey: figures, remarks and page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sfm
from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import camera_from_values
from sfm.model.errors import GeometryError
from sfm.model.remarks.remark import kinds_of, of_kind
from sfm.products.calibration.calibration import Calibration, calibrate
from sfm.products.calibration.crossvalidation import cross_validate
from sfm.products.calibration.page import page, verdict_of
from sfm.report.pages import html, text
from tests.products.calibration.boards import CAMERA, SimulatedBoard, simulated_board, zoomed
from tests.products.calibration.surveys import ALL, write_board_survey
from tests.synthetic import seed_of


def surveyed(folder: Path, board: SimulatedBoard, **more: str) -> SurveyResult:
    return sfm.run_survey(sfm.read_survey(write_board_survey(folder / "s", board, **more)))


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    """A calibration without model error."""
    board = simulated_board(seed_of("calibration"), photographs=16)
    return calibrate(surveyed(tmp_path_factory.mktemp("sound"), board), (300.0,))


def test_a_sound_calibration_is_trusted(sound: Calibration) -> None:
    verdict = verdict_of(sound)
    assert verdict.level == "good", verdict.text
    assert verdict.headline.startswith("Camera cam is known to 0.0")
    (camera,) = sound.cameras
    assert sound.distances == (300.0, np.inf)
    assert not camera.is_insufficient(0.01) and not camera.demanded and len(camera.next.poses) == 3
    assert not any(alternative.contradicts for alternative in camera.alternatives)
    assert all(halves.ratio < 2 for halves in sound.validation.differences)
    assert camera.degrees == pytest.approx((52.9, 41.0, 63.6), abs=1.5)


def test_the_known_region_has_image_points(sound: Calibration) -> None:
    (camera,) = sound.cameras
    xy, inside = camera.known_region(np.inf)
    assert 0.3 < inside.mean() < 1
    assert not inside[(xy == 0).all(axis=1)].any() or (camera.xy < 30).all(axis=1).any()


@pytest.mark.usefixtures("plots")
def test_the_page_answers_four_questions_and_has_the_same_for_programs(sound: Calibration) -> None:
    declared = page(sound, folder="out/board")
    titles = [section.title for section in declared.sections]
    assert titles == ["Can I trust it?", "Where?", "What is wrong?", "What next?"]
    words = text(declared)
    assert "1205" in words or "120" in words  # f in px
    assert "kolinear convert out/board OUT --to FORMAT" in words and "deg, diagonal" in words
    assert "<h2" in html(declared)
    stored = json.loads(declared.texts["calibration.json"])
    (camera,) = stored["cameras"]
    c = sound.cameras[0].camera.value("c")
    assert camera["focal_px"]["f"]["value"] == pytest.approx(c / 0.005)
    assert camera["projection"][1]["distance"] == "infinity" and len(camera["halves"]) == 4
    assert len(camera["next_poses"]["poses"]) == 3 and not camera["residual_field"]["insufficient"]
    assert camera["projection"][0]["middle_px"] < camera["projection"][1]["middle_px"]
    rows = declared.texts["projection_uncertainty.csv"].splitlines()
    assert rows[0] == "camera,distance,x_px,y_px,sigma_px,known" and len(rows) > 500


def test_a_model_that_does_not_fit_is_called_insufficient(tmp_path: Path) -> None:
    K3 = 4e-5 * (np.arange(len(CAMERA.names)) == CAMERA.names.index("K3"))
    lens = CAMERA.with_parameters(CAMERA.parameters + K3)
    board = simulated_board(seed_of("calibration"), photographs=16, camera=lens)
    found = calibrate(surveyed(tmp_path, board))
    (camera,) = found.cameras
    assert camera.splined is None, "a parameter of the model mends it"
    assert camera.is_insufficient(0.001) and ("K3",) in {a.parameters for a in camera.alternatives if a.borne}
    assert {"model_insufficient", "distortion_not_described"} & set(
        kinds_of(found.remarks)
    ) or camera.demanded
    (differ,) = of_kind(found.remarks, "halves_differ")
    assert differ.number("times") > 2 and differ.names("camera") == ("cam",)
    assert verdict_of(found).level != "good"
    assert "It is insufficient" in text(page(found))


@pytest.mark.parametrize("number", range(2))
def test_a_parameter_that_is_demanded_is_in_the_verdict(tmp_path: Path, number: int) -> None:
    K3 = 3e-6 * (np.arange(len(CAMERA.names)) == CAMERA.names.index("K3"))  # the corners are wrong by 0.6 px
    lens = CAMERA.with_parameters(CAMERA.parameters + K3)
    board = simulated_board(seed_of(f"demanded {number}"), photographs=8, camera=lens)
    found = calibrate(surveyed(tmp_path, board, name=f"demanded-{number}"))
    assert found.cameras[0].missing == ("K3",)
    assert {"parameters_missing", "held_parameter", "model_insufficient"} & set(kinds_of(found.remarks))
    assert verdict_of(found).level == "fair", verdict_of(found).text
    assert "demand K3" in text(page(found)) and "It suffices" not in text(page(found))


def test_page_and_remarks_test_residuals_at_one_level(sound: Calibration) -> None:
    (camera,) = sound.cameras
    between = (sound.level + sound.result.adjustment.levels.family) / 2
    field = replace(camera.field, whole=between, mean=camera.field.mean + 1.0)
    assert not replace(camera, field=field).is_insufficient(sound.level)
    changed = replace(sound, cameras=(replace(camera, field=field),))
    assert "It is insufficient" not in text(page(changed))


@pytest.mark.usefixtures("plots")
def test_a_bent_board_is_seen(tmp_path: Path) -> None:
    found = calibrate(surveyed(tmp_path, simulated_board(seed_of("calibration"), photographs=16, bent=2.0)))
    assert found.shape is not None and found.shape.flat
    off, sigma = found.shape.off_plane
    assert 0.8 < np.ptp(off) / 2.0 < 1.2 and np.median(sigma) < 0.2  # its sagitta
    words = " ".join(text(page(found)).split())
    assert "Board" in words and "coordinates adjusted, given with" in words
    assert "The board is not flat" in words and "the camera does not depend on a true plane" in words
    assert "Fix the print to a rigid plate" in words
    assert "given_scatter" in kinds_of(found.remarks) and verdict_of(found).level == "fair"


@pytest.mark.usefixtures("plots")
def test_frontal_photographs_do_not_make_a_camera(tmp_path: Path) -> None:
    board = simulated_board(seed_of("frontal"), tilt_deg=0.0, distance=(400.0, 400.0), photographs=8)
    found = calibrate(surveyed(tmp_path, board))
    assert verdict_of(found).level == "bad", verdict_of(found).text
    assert verdict_of(found).headline == "Do not trust this calibration."
    words = text(page(found))
    assert html(page(found)) and "not determined" in words and "Use it" not in words


@pytest.mark.usefixtures("plots")
def test_a_camera_that_was_not_adjusted_has_a_page(tmp_path: Path) -> None:
    """Without `free` the program holds the camera of frontal photographs."""
    board = simulated_board(seed_of("frontal"), tilt_deg=0.0, distance=(400.0, 400.0), photographs=8)
    found = calibrate(surveyed(tmp_path, board, free=""))
    assert not found.cameras and "held_parameter" in kinds_of(found.remarks)
    assert verdict_of(found).headline == "Do not trust this calibration."
    words = " ".join(text(page(found)).split())
    assert "The image points contradict the held values" in words and "No camera is known anywhere" in words
    assert "tilted by 30 to 45 degrees" in words and "Use it" not in words and html(page(found))


def test_a_zoomed_camera_is_named(tmp_path: Path) -> None:
    found = calibrate(surveyed(tmp_path, zoomed(simulated_board(seed_of("zoomed"), photographs=16))))
    (differ,) = of_kind(found.remarks, "halves_differ")
    assert differ.names("division") == ("first and last photographs",) and differ.number("times") > 2
    assert verdict_of(found).level != "good"
    assert "but halves of its photographs differ by" in verdict_of(found).headline
    assert any("camera" in line.text and line.severity != "note" for line in verdict_of(found).lines)


def test_three_photographs_are_not_divided(tmp_path: Path) -> None:
    found = calibrate(surveyed(tmp_path, simulated_board(seed_of("three"), photographs=3)))
    assert not found.validation.differences
    words = text(page(found))
    assert "half of its photographs are" in words and "Its residuals are not tested" in words
    assert "halves_missing" in kinds_of(found.remarks) and verdict_of(found).level == "fair"


def test_a_held_camera_is_no_calibration(tmp_path: Path) -> None:
    straight = camera_from_values("cam", "brown", (1200, 900), (0.005, 0.005), c_mm=6.0)
    result = surveyed(tmp_path, simulated_board(seed_of("held"), camera=straight), free="free = []")
    with pytest.raises(GeometryError, match="no camera was adjusted, so that nothing is calibrated"):
        calibrate(result)


def test_a_camera_whose_photographs_show_nothing_has_no_calibration(sound: Calibration) -> None:
    a = sound.result.adjustment
    blind = replace(a.estimate.cameras[0], name="blind")
    network = replace(a.network, images=(*a.network.images, "blind0"), camera=np.append(a.network.camera, 1))
    estimate = replace(
        a.estimate,
        cameras=(*a.estimate.cameras, blind),
        position=np.vstack([a.estimate.position, np.full(3, np.nan)]),
        rotation=np.concatenate([a.estimate.rotation, np.full((1, 3, 3), np.nan)]),
    )
    (seen,) = a.covariance.interior
    unknown = np.diag(np.full(len(seen), np.inf))
    covariance = replace(a.covariance, interior=(seen, unknown))
    further = replace(a, network=network, estimate=estimate, covariance=covariance)
    calibrated = calibrate(replace(sound.result, adjustment=further), (sound.distances[0],))
    assert [camera.name for camera in calibrated.cameras] == ["cam"]
    assert len(cross_validate(further).of_camera("cam")) == 4  # the blind one does not hinder the other


def test_commands_on_the_page_can_be_pasted(sound: Calibration) -> None:
    assert "kolinear convert 'my results/board' OUT" in text(page(sound, folder="my results/board"))


def test_distances_are_positive(sound: Calibration) -> None:
    with pytest.raises(GeometryError, match="distance -1, expected more than 0"):
        calibrate(sound.result, (-1.0,))


def test_photographs_with_a_c_of_their_own_share_a_model(tmp_path: Path) -> None:
    board = zoomed(simulated_board(seed_of("zoomed"), photographs=16))
    found = calibrate(surveyed(tmp_path, board, free=f'{ALL}\nper_photograph = ["c"]'))
    assert verdict_of(found).level == "good", verdict_of(found).text
    (camera,) = found.cameras
    needed = {alternative.parameters: alternative.borne for alternative in camera.alternatives}
    assert needed["K2",] and not needed["K3",]
    assert min(alternative.gain for alternative in camera.alternatives) > -0.01  # wider models fit as well
