"""The command `calibrate`: from a folder of photographs of a board to a judged camera."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import cv2
import pytest

from sfm.cli.commands.calibrate import _for_calibration
from tests.commands import kolinear, refused
from tests.places import SHARED
from tests.plates import BOARD, PIXEL_MM, TRUTH, plate_pictures
from tests.products.calibration.boards import simulated_board
from tests.products.calibration.surveys import write_board_survey
from tests.synthetic import seed_of

STEREO, CAMCAL = SHARED / "data" / "stereo-chessboard" / "images", SHARED / "data" / "camcal" / "images"


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibrate") / "board"
    folder.mkdir()
    for k, picture in enumerate(plate_pictures(BOARD, seed_of("calibrate"), 8)):
        cv2.imwrite(str(folder / f"photo {k}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return folder


@pytest.mark.usefixtures("plots")
def test_a_folder_of_a_board_becomes_a_judged_camera(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert kolinear("calibrate", photographs, "--out", out, "--distance", 200, "--jobs", 1) == 0
    said = capsys.readouterr().out
    assert "projection at infinity" in said and "Next 3 photographs" in said
    assert f"Calibration: {out / 'calibration.html'}" in said
    assert f"kolinear convert {out} OUT --to FORMAT" in (out / "calibration.html").read_text(encoding="utf-8")
    stored = json.loads((out / "calibration.json").read_text(encoding="utf-8"))
    (camera,) = stored["cameras"]
    f = camera["focal_px"]["f"]
    assert abs(f["value"] - TRUTH["c"] / PIXEL_MM) < 5 * f["sigma"] + 0.05
    assert [row["distance"] for row in camera["projection"]] == [200, "infinity"]
    listed = (out / "manifest.json").read_text(encoding="utf-8")
    assert all(f'"{name}"' in listed for name in ("calibration.html", "calibration.json", "report.html"))
    text = (tmp_path / "out.toml").read_text(encoding="utf-8")
    assert 'backend = "none"' in text
    assert kolinear("calibrate", photographs, "--out", out, "--model", "opencv") == 2
    assert "--model opencv is for drafting a survey file, but this one exists" in capsys.readouterr().err


def test_the_model_of_a_draft_may_be_given(photographs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    file = tmp_path / "camera.yaml"
    arguments = (photographs, "--out", out, "--model", "opencv", "--jobs", 1, "--export", file)
    assert kolinear("calibrate", *arguments) == 0
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    assert abs(storage.getNode("K").mat()[0, 0] - TRUTH["c"] / PIXEL_MM) < 1.0
    (camera,) = json.loads((out / "calibration.json").read_text(encoding="utf-8"))["cameras"]
    assert camera["model"] == "opencv" and set(camera["focal_px"]) == {"fx", "fy"}


def test_wrong_options_are_refused_before_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--model 'pinehole', expected one of" in refused(
        capsys, "calibrate", tmp_path, "--model", "pinehole"
    )
    assert "--export is not for --watch" in refused(capsys, "calibrate", tmp_path, "--export", "a", "--watch")
    assert "--distance -1, expected more than 0" in refused(capsys, "calibrate", tmp_path, "--distance", -1)


def test_a_survey_file_is_calibrated_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_board_survey(tmp_path / "s", simulated_board(seed_of("command"), photographs=10))
    before = path.read_bytes()
    assert kolinear("calibrate", path) == 0
    assert (tmp_path / "out" / "board" / "calibration.html").is_file() and path.read_bytes() == before


@pytest.mark.parametrize(
    "line", ['model = "brown"', '# model = "brown"  # without it: what', 'model = "opencv_fisheye"  # so']
)
def test_a_model_replaces_that_of_the_draft(line: str) -> None:
    text = f'[[camera]]\n{line}\nfree = ["c", "x0"]\n[compare]\nbackend = "colmap"  # or none\n'
    changed = _for_calibration(text, "full_opencv")
    assert tomllib.loads(changed)["camera"] == [{"model": "full_opencv"}]
    assert tomllib.loads(changed)["compare"] == {"backend": "none"}
    assert "free" in _for_calibration(text, None) and line in _for_calibration(text, None)


@pytest.mark.slow
@pytest.mark.skipif(not STEREO.is_dir(), reason="no photographs of the stereo pair here")
def test_a_print_that_is_not_flat_is_adjusted(tmp_path: Path) -> None:
    out = tmp_path / "stereo"
    assert kolinear("calibrate", STEREO, "--out", out, "--jobs", 1) == 0
    assert "plate_sigma = 0.0" in (tmp_path / "stereo.toml").read_text(encoding="utf-8")
    stored = json.loads((out / "calibration.json").read_text(encoding="utf-8"))
    left, right = stored["cameras"]
    assert left["sigma0_px"] < 0.09 and 0.2 < stored["object_shape"]["largest_off_plane"] < 0.35
    assert left["projection"][0]["middle_px"] < left["projection"][1]["middle_px"] / 3
    assert {"halves_differ"} <= {one["kind"] for one in stored["verdict"]["remarks"]}
    assert max(halves["ratio"] for halves in right["halves"]) > 2


@pytest.mark.slow
@pytest.mark.skipif(not CAMCAL.is_dir(), reason="no photographs of camcal here")
def test_the_camera_of_camcal_changed_between_its_photographs(tmp_path: Path) -> None:
    out = tmp_path / "camcal"
    assert kolinear("calibrate", CAMCAL, "--out", out, "--jobs", 1) == 0
    (camera,) = json.loads((out / "calibration.json").read_text(encoding="utf-8"))["cameras"]
    assert max(halves["ratio"] for halves in camera["halves"]) > 5
