"""sba's text files: what is read, what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.registry import read_any, write_any
from adapters.formats.sba_text import read_sba_text, sba_files
from sfm.camera import project
from sfm.errors import KolinearError, OutputError, SurveyFileError
from tests.synthetic import seed_of

CAMERAS = "1 0 0 0 0 0 4\n0.8 0 0.6 0 1 0 4 # turned\n"
CALIBRATION = "800 0 320\n0 808 240\n0 0 1\n"


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """Four points projected with x = K [R|t] X."""
    X = seed_of("sba").uniform(-0.5, 0.5, (4, 3))
    K = np.array([[800.0, 0, 320], [0, 808, 240], [0, 0, 1]])
    turn = np.array([[0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, 0.28]])  # of the quaternion 0.8, 0, 0.6, 0
    rays = np.stack([X + np.array([0, 0, 4]), X @ turn.T + np.array([1, 0, 4])]) @ K.T
    xy = rays[..., :2] / rays[..., 2:]
    lines = [
        " ".join(map(str, [*X[j].tolist(), 2, 0, *xy[0, j].tolist(), 1, *xy[1, j].tolist()]))
        for j in range(4)
    ]
    paths = {name: tmp_path / f"{name}.txt" for name in ("cams", "pts", "calib", "sigmas")}
    paths["cams"].write_text(CAMERAS)
    paths["pts"].write_text("# X Y Z n ...\n" + "\n".join(lines))
    paths["calib"].write_text(CALIBRATION)
    paths["sigmas"].write_text("0.1 0.2\n" * 8)
    return paths


def test_projections_fit_cameras_and_points(files: dict[str, Path]) -> None:
    network, estimate = read_sba_text(files["cams"], files["pts"], files["calib"], sigmas=files["sigmas"])
    k = network.image_points
    for i in range(2):
        xy = project(estimate.cameras[0], estimate.position[i], estimate.rotation[i], estimate.points)
        own = k.image == i
        assert np.abs(k.xy[own] - xy[k.point[own]]).max() < 1e-9
    assert k.covariance[3] == pytest.approx(np.diag([0.01, 0.04]))


def test_cameras_with_their_own_parameters(files: dict[str, Path]) -> None:
    lines = CAMERAS.splitlines()
    files["cams"].write_text(f"800 320 240 1.01 0 {lines[0]}\n800 320 240 1.01 0 {lines[1]}")
    with_own = read_sba_text(files["cams"], files["pts"])[1].cameras
    assert len(with_own) == 1
    assert with_own[0].parameters[:4] == pytest.approx([800, 808, 320, 240])


def test_covariances_in_the_points_file(files: dict[str, Path]) -> None:
    files["pts"].write_text("0 0 0 2 0 1 2 0.04 0.01 0.01 0.09 1 3 4 1 0 0 1\n")
    network, _ = read_sba_text(files["cams"], files["pts"], files["calib"])
    assert network.image_points.covariance[0] == pytest.approx(np.array([[0.04, 0.01], [0.01, 0.09]]))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cams", "1 0 0 0 0 0\n", r"line 1: 6 numbers, all lines"),
        ("cams", "", "no numbers"),
        ("cams", "1 0 0 0 x 0 0\n", "line 1: 'x' is not a number"),
        ("pts", "0 0 0 2 0 1 2\n", "line 1: 3 numbers for 2 projections"),
        ("pts", "0 0 0 1 5 1 2\n", "line 1: frame 5, there are 2 cameras"),
        ("pts", "0 0 0 1 0 1 2\n", "pts.txt: no projection in frame 1 of .*cams.txt, line 2"),
        ("pts", "0 0 1e300 1 0 1 2\n", "line 1: '1e300', needed a number of at most 1e\\+12"),
        ("pts", "0 0 0\n", "line 1: X Y Z and a number of projections"),
        ("calib", "1 0 0\n", "line 1: three lines of 3 numbers"),
        ("calib", "800 3 320\n0 808 240\n0 0 1\n", "skew 3"),
        ("sigmas", "0.1 0.1\n", "line 1: 2 numbers to the end, 16 positive"),
    ],
)
def test_bad_files_are_refused(files: dict[str, Path], name: str, text: str, message: str) -> None:
    files[name].write_text(text)
    with pytest.raises(SurveyFileError, match=message):
        read_sba_text(files["cams"], files["pts"], files["calib"], sigmas=files["sigmas"])


def test_missing_calibration_is_refused(files: dict[str, Path]) -> None:
    with pytest.raises(SurveyFileError, match="a calibration matrix is needed"):
        read_sba_text(files["cams"], files["pts"])


def test_a_problem_is_found_by_its_cameras_or_its_folder(files: dict[str, Path], tmp_path: Path) -> None:
    network, estimate = read_any(tmp_path)
    assert network.image_points.covariance[3] == pytest.approx(np.diag([0.01, 0.04]))  # sigmas.txt is used
    write_any(tmp_path / "again", "sba", network, estimate)
    again, same = read_any(tmp_path / "again" / "cams.txt")
    np.testing.assert_array_equal(again.image_points.xy, network.image_points.xy)
    np.testing.assert_allclose(again.image_points.covariance, network.image_points.covariance, rtol=1e-15)
    np.testing.assert_allclose(same.position, estimate.position, atol=1e-14)
    np.testing.assert_allclose(same.cameras[0].parameters, estimate.cameras[0].parameters, rtol=1e-15)
    (tmp_path / "54cams.txt").write_text(CAMERAS)
    with pytest.raises(SurveyFileError, match=r"there are: 54cams\.txt, cams\.txt"):
        sba_files(tmp_path)
    with pytest.raises(SurveyFileError, match=r"54cams\.txt: .* beside one \*pts\*\.txt"):
        sba_files(tmp_path / "54cams.txt")


def test_what_sba_cannot_hold_is_refused(files: dict[str, Path], tmp_path: Path) -> None:
    network, estimate = read_any(tmp_path)
    camera = estimate.cameras[0]
    bent = camera.with_parameters(camera.parameters + np.array([0, 0, 0, 0, 0.1, 0, 0, 0]))
    with pytest.raises(KolinearError, match=r"camera 1: format sba cannot hold k1 .* --undistort corrects"):
        write_any(tmp_path / "x", "sba", network, replace(estimate, cameras=(bent,)))
    lost = replace(estimate, points=estimate.points * np.nan)
    with pytest.raises(OutputError, match="start values of all"):
        write_any(tmp_path / "y", "sba", network, lost)
