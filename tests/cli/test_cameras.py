"""Cameras on the command line: written without rigs, compared, and refused in one line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.formats.cameras.registry import read_cameras, write_cameras
from sfm.adjustment.solve import adjust
from sfm.model.camera import Camera, pixel_from_tangents
from sfm.model.camera_file import CameraFile
from sfm.model.solution import Solution
from tests.commands import kolinear, refused
from tests.synthetic import make_network, observed_anew, seed_of

FREE = ("c", "x0", "y0", "K1", "K2", "P1", "P2")


def calibrated(seed: str, *, noise_px: float = 0.1, cameras: int = 1) -> Solution:
    """A calibration of the same camera, with its own noise."""
    network, truth = make_network(
        seed_of("cameras on the command line"), images=8, points=40, free=FREE, noise_px=0.0, cameras=cameras
    )
    network = observed_anew(network, truth, noise_px, seed_of(seed))
    return replace(adjust(network, truth, reject="none").solution, name=seed)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("cameras")
    for name in ("first", "second"):
        calibrated(name).write(folder / name)
    return folder / "first", folder / "second"


@pytest.mark.parametrize(
    "form", ["opencv", "ros", "kalibr", "mrcal", "colmap", "metashape", "australis", "nerfstudio"]
)
def test_a_result_without_rigs_gives_a_camera_file(
    form: str, results: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its image points adjusted again in another model, which is within the stated misfit of the camera."""
    path = tmp_path / "camera.out"
    assert kolinear("convert", results[0], path, "--to", f"{form}-camera") == 0
    told = capsys.readouterr().out
    (written,) = read_cameras(path, f"{form}-camera").cameras
    (given,) = read_cameras(results[0]).cameras
    assert f"{path}: 1 camera as {form}-camera\n" in told
    if form != "australis":
        assert f"{given.model} to {written.model}, image points adjusted again, misfit 0.0" in told
    assert written.size_px == given.size_px
    uv = np.array([[0.0, 0.0], [0.2, 0.1], [-0.2, -0.1]])
    away = pixel_from_tangents(written, uv) - pixel_from_tangents(given, uv)
    assert np.abs(away).max() < 0.2


def test_the_file_for_opencv_has_the_residuals(results: tuple[Path, Path], tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    assert kolinear("convert", results[0], path, "--to", "opencv-camera") == 0
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.getNode("K").mat().shape == (3, 3)
    assert 0.05 < storage.getNode("rms").real() < 0.15


def test_two_calibrations_of_one_camera_do_not_differ(
    results: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert kolinear("compare", *results, "--cameras", "--out", out) == 0
    told = capsys.readouterr().out
    assert "standard deviations: no more than chance." in told and f"Report: {out / 'cameras.html'}" in told
    summary = json.loads((out / "cameras.json").read_text())
    assert summary["significant"] is False and summary["covariances"] == [True, True]
    assert 0.3 < summary["standard_deviations"] < 2.5 and summary["headline"] in told
    assert (out / "difference.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (out / "difference.svg").read_text(encoding="utf-8")
    table = np.genfromtxt(out / "camera_difference.csv", delimiter=",", names=True)
    assert len(table) > 500 and np.isfinite(table["sigma_px"]).all()
    page = (out / "cameras.html").read_text()
    assert "chance alone would give" in page and "implied rotation" in page


def test_calibrations_from_the_same_image_points_are_not_separate(
    results: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They differ by less than chance; that no more is in it would not be known."""
    first = calibrated("first")
    estimate = first.estimate
    lens = estimate.cameras[0]
    free = lens.free & ~np.isin(lens.names, ("P1", "P2"))
    start = replace(estimate, cameras=(replace(lens, free=free),))
    replace(adjust(first.network, start, reject="none").solution, name="again").write(tmp_path / "again")
    out = tmp_path / "out"
    assert kolinear("compare", results[0], tmp_path / "again", "--cameras", "--out", out) == 0
    told = capsys.readouterr().out
    assert "standard deviations of separate calibrations." in told and "than chance" not in told
    assert "or the same image points; their correlation is left out of the test." in told
    summary = json.loads((out / "cameras.json").read_text())
    assert summary["significant"] is None and summary["independent"] is False
    assert kolinear("compare", *results, "--cameras", "--out", tmp_path / "separate") == 0
    assert "no more than chance" in capsys.readouterr().out


def test_a_changed_camera_differs(
    results: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file without covariance, whose K1 is another by far; at a distance too."""
    path = tmp_path / "changed.yaml"
    assert kolinear("convert", results[1], path, "--to", "opencv-camera") == 0
    (camera,) = read_cameras(path).cameras
    other = camera.with_parameters(camera.parameters + 0.05 * (np.array(camera.names) == "k1"))
    write_cameras(tmp_path / "other.yaml", "opencv-camera", CameraFile("x", (other,), (None,)))
    capsys.readouterr()
    for more in ((), ("--distance", "5")):
        arguments = ("compare", results[0], tmp_path / "other.yaml", *more, "--out", tmp_path / "out")
        assert kolinear(*arguments) == 0
        told = capsys.readouterr().out
        assert "standard deviations: more than chance." in told
        assert "the other camera counts as free of error." in told
    assert kolinear("compare", path, tmp_path / "other.yaml", "--out", tmp_path / "files") == 0
    assert "standard deviations are not known." in capsys.readouterr().out


def lens(camera: Camera, **other: object) -> CameraFile:
    return CameraFile("x", (replace(camera, **other),), (None,))  # type: ignore[arg-type]


def test_what_cannot_be_done_is_one_line(
    results: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two = tmp_path / "two"
    calibrated("two cameras", cameras=2).write(two)
    names = [camera.name for camera in read_cameras(two).cameras]
    one = tmp_path / "one.yaml"
    assert kolinear("convert", two, one, "--to", "ros-camera", "--camera", names[0]) == 0
    assert kolinear("convert", two, tmp_path / "both", "--to", "ros-camera") == 0
    assert len(list((tmp_path / "both").glob("*.yaml"))) == 2
    capsys.readouterr()
    out = ("--out", tmp_path / "out")
    told = refused(capsys, "convert", two, tmp_path / "b.yaml", "--to", "ros-camera")
    assert f"{two}: 2 cameras, one is needed; name it with --camera: {names[0]}, {names[1]}" in told
    assert "one is needed" in refused(capsys, "compare", two, two, "--cameras", *out)
    assert "no camera 'x'" in refused(capsys, "compare", two, one, "--camera", "x", *out)
    told = refused(capsys, "compare", two, two, "--camera", names[0], *out)
    assert "would be compared with itself" in told
    assert "no camera 'x'" in refused(capsys, "compare", two, one, "--camera", f"{names[0]}=x", *out)
    assert kolinear("compare", two, two, "--camera", f"{names[0]}={names[1]}", *out) == 0
    assert "their correlation is left out of the test" in capsys.readouterr().out
    assert kolinear("compare", two, one, "--camera", names[0], *out) == 0
    (camera,) = read_cameras(one).cameras
    write_cameras(tmp_path / "small.yaml", "ros-camera", lens(camera, size_px=(100, 80)))
    capsys.readouterr()
    told = refused(capsys, "compare", one, tmp_path / "small.yaml", "--out", tmp_path / "other")
    assert "and of 100 x 80 px, needed the same size" in told
    (tmp_path / "bad.yaml").write_text("hello: 1\n")
    told = refused(capsys, "compare", one, tmp_path / "bad.yaml", "--out", tmp_path / "other")
    assert "expected" in told or "format" in told
    told = refused(capsys, "convert", one, tmp_path / "c.yaml", "--to", "opencv-kamera")
    assert "format 'opencv-kamera', expected one of" in told
    told = refused(capsys, "convert", results[0], tmp_path / "c.json", "--to", "blender-camera")
    assert "--inexact writes it all the same, kolinear undistort" in told
    assert not (tmp_path / "c.json").exists()
