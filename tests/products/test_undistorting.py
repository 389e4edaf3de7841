"""Photographs without distortion and rectified pairs: as OpenCV draws them, with bits and EXIF data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from adapters.formats.cameras.registry import read_cameras, write_cameras
from sfm.cli.undistorted import owners
from sfm.model.camera import Camera, camera_from_values
from sfm.model.camera_file import CameraFile, cameras_of
from sfm.model.conventions import AnyArray
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.solution import Solution
from sfm.photographs.reading import read_photograph
from sfm.products.undistorting.photographs import UndistortedPhotographs
from sfm.products.undistorting.views import rectified_pair, row_differences, undistorted_view
from tests.commands import kolinear, refused
from tests.places import SHARED
from tests.rigs import make_rig
from tests.synthetic import seed_of

SIZE = (320, 240)
PLANE = (("fx", 260.0), ("fy", 262.0), ("cx", 165.0), ("cy", 117.0))
RADTAN = (("k1", -0.25), ("k2", 0.08), ("p1", 1e-3), ("p2", -5e-4))


def lens(model: str = "opencv", *values: tuple[str, float], name: str = "left") -> Camera:
    return camera_from_values(name, model, SIZE, (1.0, 1.0), c_mm=260.0, values=(*PLANE, *(values or RADTAN)))


def smooth(shape: tuple[int, ...] = (SIZE[1], SIZE[0]), most: int = 255) -> AnyArray:
    """A picture without edges, in which interpolation hardly matters."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    grey = 0.5 + 0.2 * np.sin(x / 17) * np.cos(y / 13) + 0.001 * x
    picture = grey if len(shape) == 2 else grey[:, :, None] * np.array([1.0, 0.8, 0.6])
    return (picture * most).astype(np.uint8 if most < 256 else np.uint16)


def drawn(
    picture: AnyArray, camera: Camera, tmp_path: Path, ending: str = ".png", **options: Any
) -> AnyArray:
    path, out = tmp_path / f"a{ending}", tmp_path / f"b{ending}"
    cv2.imwrite(str(path), picture)
    UndistortedPhotographs().draw(path, undistorted_view(camera, **options), out)
    return np.asarray(cv2.imread(str(out), cv2.IMREAD_UNCHANGED))


def test_opencv_undistorts_alike(tmp_path: Path) -> None:
    """With its camera, principal distance and principal point kept; and with its fisheye lens."""
    view = undistorted_view(lens())
    K, D = np.array([[260.0, 0, 165], [0, 262, 117], [0, 0, 1]]), np.array([-0.25, 0.08, 1e-3, -5e-4])
    exact = cv2.initUndistortRectifyMap(K, D, None, view.matrix, SIZE, cv2.CV_32FC1)
    for mine, theirs in zip(view.places(), exact, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-3)
    own = drawn(smooth(), lens(), tmp_path).astype(int)
    theirs = cv2.remap(smooth(), *exact, cv2.INTER_CUBIC).astype(int)
    assert np.abs(own - theirs).max() <= 1
    fisheye = lens("opencv_fisheye", ("k1", -0.02), ("k2", 1e-3))
    view, D = undistorted_view(fisheye), np.array([-0.02, 1e-3, 0, 0])
    exact = cv2.fisheye.initUndistortRectifyMap(K, D, np.eye(3), view.matrix, SIZE, cv2.CV_32FC1)
    inner = (slice(40, 200), slice(60, 260))
    for mine, theirs in zip(view.places(), exact, strict=True):
        np.testing.assert_allclose(mine[inner], theirs[inner], atol=1e-3)


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0])
def test_alpha_leaves_no_border_empty_or_nothing_out(alpha: float) -> None:
    view = undistorted_view(lens(), alpha)
    x, y = view.places()
    empty = (x < -0.5) | (y < -0.5) | (x > SIZE[0] - 0.5) | (y > SIZE[1] - 0.5)
    corners = view.pixels(
        np.array([[0.0, 0], [SIZE[0] - 1, 0], [0, SIZE[1] - 1], [SIZE[0] - 1, SIZE[1] - 1]])
    )
    inside = ((corners > -0.5) & (corners < np.array(SIZE) - 0.5)).all()
    assert empty.any() == (alpha > 0) and inside == (alpha == 1)


def test_pixels_and_places_are_inverse() -> None:
    view = undistorted_view(lens(), 0.3)
    x, y = view.places()
    at = np.stack([x[50:200:30, 50:300:30], y[50:200:30, 50:300:30]], axis=-1).reshape(-1, 2)
    grid = np.stack(np.meshgrid(np.arange(50, 300, 30), np.arange(50, 200, 30)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(view.pixels(at.astype(float)), grid, atol=1e-3)


@pytest.mark.parametrize(
    ("shape", "most", "ending"),
    [
        ((240, 320), 255, ".png"),
        ((240, 320, 3), 255, ".png"),
        ((240, 320), 65535, ".png"),
        ((240, 320, 3), 65535, ".png"),
        ((240, 320, 3), 255, ".tif"),
        ((240, 320), 65535, ".tif"),
        ((240, 320, 3), 255, ".jpg"),
        ((240, 320), 255, ".bmp"),
    ],
)
def test_bits_and_colours_are_kept(shape: tuple[int, ...], most: int, ending: str, tmp_path: Path) -> None:
    picture = smooth(shape, most)
    ideal = camera_from_values("ideal", "opencv", SIZE, (1.0, 1.0), c_mm=260.0)
    same = drawn(picture, ideal, tmp_path, ending)
    assert same.shape == picture.shape and same.dtype == picture.dtype
    assert np.abs(same.astype(int) - picture.astype(int)).max() <= (6 if ending == ".jpg" else 1)


@pytest.mark.parametrize("ending", [".jpg", ".png", ".tif", ".webp"])
def test_exif_is_kept(ending: str, tmp_path: Path) -> None:
    path, out = tmp_path / f"a{ending}", tmp_path / f"b{ending}"
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "Maker", "Model 1", 6
    exif.get_ifd(0x8769)[0x920A] = 8.5  # focal length, mm
    Image.fromarray(smooth((240, 320, 3))).save(path, exif=exif.tobytes())
    draw = UndistortedPhotographs()
    draw.draw(path, undistorted_view(lens()), out)
    assert read_photograph(out).shape == SIZE[::-1]
    with Image.open(out) as read:
        kept = read.getexif()
        assert (kept[0x010F], kept[0x0110]) == ("Maker", "Model 1")
        assert float(kept.get_ifd(0x8769)[0x920A]) == 8.5
        assert kept[0x0112] == 6
    assert not draw.without_exif


def rig(folder: Path, *, unlike: bool = False) -> tuple[Path, Path]:
    """Return the file of a stereo pair and a folder with two photographs of each camera."""
    _, truth = make_rig(seed_of("pair to rectify"), moments=4, points=15)
    cameras = tuple(lens(name=name) for name in ("left", "right"))
    path = folder / "chain.yaml"
    write_cameras(path, "kalibr-camera", CameraFile("x", cameras, (None, None), truth.mounts, "m"))
    photographs = folder / "photographs"
    photographs.mkdir()
    for name in ("left01", "right01", "left02", "right02") if not unlike else ("a", "b"):
        cv2.imwrite(str(photographs / f"{name}.png"), smooth())
    return path, photographs


def test_pairs_of_a_file_are_rectified_for_opencv(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The file has the two new cameras, one base along the rows, and the matrices of stereoRectify."""
    path, photographs = rig(tmp_path)
    out = tmp_path / "out"
    assert kolinear("undistort", path, photographs, "--pairs", "--out", out) == 0
    told = capsys.readouterr().out
    assert (
        "cam0-cam1: 2 pairs as left01.png and right01.png" in told
        and f"{out}: 4 photographs without distortion" in told
    )
    assert sorted(one.name for one in out.glob("*.png")) == [
        "left01.png",
        "left02.png",
        "right01.png",
        "right02.png",
    ]
    file, given = read_cameras(out / "rectified-cam0-cam1.yaml"), read_cameras(path)
    storage = cv2.FileStorage(str(out / "rectified-cam0-cam1.yaml"), cv2.FILE_STORAGE_READ)
    assert file.mounts is not None and given.mounts is not None
    np.testing.assert_array_equal(file.cameras[0].parameters, file.cameras[1].parameters)
    base = np.linalg.norm(given.mounts.position[1])
    np.testing.assert_allclose(file.mounts.position[1], [base, 0, 0], atol=1e-9)
    p = [camera.parameters for camera in given.cameras]
    axes = np.diag([1.0, -1.0, -1.0])
    R = axes @ given.mounts.rotation[1].T @ axes
    T = -R @ axes @ given.mounts.position[1]
    K = [np.array([[q[0], 0, q[2]], [0, q[1], q[3]], [0, 0, 1]]) for q in p]
    exact: Any = cv2.stereoRectify(
        *(K[0], p[0][4:], K[1], p[1][4:], SIZE, R, T[:, None]), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
    )
    for name, M in zip(("R1", "R2", "P1", "P2", "Q"), exact, strict=False):
        np.testing.assert_allclose(storage.getNode(name).mat(), M, rtol=1e-9, atol=1e-9, err_msg=name)
    assert kolinear("undistort", path, photographs, "--pairs", "--out", out) == 0  # replaces its own


def test_rows_of_conjugate_points_agree() -> None:
    """Exactly without noise, for lenses in mm too; and a shifted camera is seen in them."""
    network, truth = make_rig(seed_of("rows"), moments=5, points=30, noise_px=0.0)
    assert truth.mounts is not None
    pair = rectified_pair(truth.cameras, truth.mounts, 0, 1)
    v = row_differences(pair, Solution("x", network, truth))
    assert len(v) > 50 and np.abs(v).max() < 1e-6
    turned = replace(truth.mounts, rotation=truth.mounts.rotation[::-1])
    wrong = rectified_pair(truth.cameras, turned, 0, 1)
    assert np.abs(row_differences(wrong, Solution("x", network, truth))).max() > 1.0
    assert len(row_differences(pair, Solution("x", replace(network, moment=None), truth))) == 0


def test_single_photographs_of_a_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "left.yaml"
    write_cameras(path, "ros-camera", CameraFile("x", (lens(),), (None,)))
    cv2.imwrite(str(tmp_path / "a.png"), smooth())
    out = tmp_path / "out"
    assert kolinear("undistort", path, tmp_path / "a.png", "--out", out, "--to", "mrcal-camera") == 0
    assert (
        "camera left: 1 photograph as a.png, new camera camera-left.cameramodel, f = 262.0000 px"
        in capsys.readouterr().out
    )
    (new,) = read_cameras(out / "camera-left.cameramodel").cameras
    assert not new.parameters[4:].any() and (out / "a.png").exists()


def test_what_does_not_belong_together_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, photographs = rig(tmp_path)
    single = tmp_path / "left.yaml"
    write_cameras(single, "ros-camera", CameraFile("x", (lens(),), (None,)))
    out = ("--out", tmp_path / "out")
    told = refused(capsys, "undistort", single, photographs, "--pairs", *out)
    assert "how the cameras are mounted is not known" in told
    assert "no camera 'x'" in refused(capsys, "undistort", path, photographs, "--camera", "x", *out)
    for more in (("--camera", "cam0"), ("--to", "ros-camera")):
        told = refused(capsys, "undistort", path, photographs, "--pairs", *more, *out)
        assert "--pairs takes both cameras of a rig and writes opencv-camera" in told
    assert "--alpha 2, needed 0" in refused(capsys, "undistort", single, photographs, "--alpha", "2", *out)
    assert "there is no such folder" in refused(capsys, "undistort", single, tmp_path / "none", *out)
    (tmp_path / "empty").mkdir()
    assert "no photographs are in this folder" in refused(
        capsys, "undistort", single, tmp_path / "empty", *out
    )
    (tmp_path / "others").mkdir()
    cv2.imwrite(str(tmp_path / "others" / "x.png"), smooth())
    cv2.imwrite(str(tmp_path / "others" / "y.png"), smooth())
    told = refused(capsys, "undistort", path, tmp_path / "others", *out)
    assert "which of the cameras cam0, cam1 took it is not known" in told
    cv2.imwrite(str(tmp_path / "others" / "x.png"), smooth((100, 100)))
    told = refused(capsys, "undistort", single, tmp_path / "others", *out)
    assert "x.png: 100 x 100 px, camera left was calibrated with photographs of 320 x 240 px" in told
    (tmp_path / "others" / "x.png").unlink()
    (tmp_path / "others" / "x.png").symlink_to(photographs / "left01.png")
    told = refused(capsys, "undistort", single, tmp_path / "others", *out)
    assert "a link that leaves its folder" in told
    assert not (tmp_path / "out").exists()
    (tmp_path / "others" / "x.png").unlink()
    (tmp_path / "others" / "y.png").write_bytes(b"hello")
    assert "not a photograph" in refused(capsys, "undistort", single, tmp_path / "others", *out)
    cv2.imwrite(str(tmp_path / "others" / "z.png"), smooth())
    (tmp_path / "others" / "y.png").unlink()
    told = refused(capsys, "undistort", path, tmp_path / "others" / "z.png", "--pairs", *out)
    assert "took it is not known" in told and not (tmp_path / "out").exists()


def test_a_result_knows_whose_photographs_they_are() -> None:
    network, truth = make_rig(seed_of("whose photographs"), moments=4, points=15)
    file = cameras_of(Solution("x", network, truth))
    names = list(network.images)
    assert owners(file, names) == network.camera.tolist()
    first = file.only(file.cameras[0].name)
    mine = [name for name, k in zip(names, network.camera.tolist(), strict=True) if k == 0]
    assert owners(first, [*mine, "another.jpg"]) == [0] * (len(mine) + 1)
    with pytest.raises(SurveyFileError, match=f"camera {file.cameras[1].name} took it by the result, not"):
        owners(first, names)


def test_what_no_plane_shows_is_refused() -> None:
    wide = camera_from_values("f", "opencv_fisheye", SIZE, (1.0, 1.0), c_mm=80.0)
    with pytest.raises(GeometryError, match="see too wide for one image plane"):
        undistorted_view(wide, 0.0)
    _, truth = make_rig(seed_of("apart"), moments=4, points=15)
    assert truth.mounts is not None
    mounts = replace(truth.mounts, position=np.zeros((2, 3)))
    with pytest.raises(GeometryError, match="no base between them"):
        rectified_pair(truth.cameras, mounts, 0, 1)
    small = replace(truth.cameras[1], size_px=(100, 100))
    with pytest.raises(GeometryError, match="cannot be rectified to a pair, needed the same size"):
        rectified_pair((truth.cameras[0], small), truth.mounts, 0, 1)


def corners_of(folder: Path, name: str) -> AnyArray | None:
    picture = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
    found, corners = cv2.findChessboardCorners(picture, (9, 6))
    if not found:
        return None
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
    return np.asarray(cv2.cornerSubPix(picture, corners, (5, 5), (-1, -1), until)).reshape(-1, 2)


def test_matches_of_a_real_pair_are_on_equal_rows(tmp_path: Path) -> None:
    """Calibrated and measured by OpenCV: corners in the rectified photographs, on average to 0.05 px."""
    images = SHARED / "data" / "stereo-chessboard" / "images"
    if not images.is_dir():
        pytest.skip("the photographs are not in ../shared/data")
    board = np.zeros((54, 3), np.float32)
    board[:, :2] = 30 * np.mgrid[:9, :6].T.reshape(-1, 2)
    numbers = range(1, 15)
    seen = [[corners_of(images, f"{side}{k:02d}.jpg") for k in numbers] for side in ("left", "right")]
    both = [(a, b) for a, b in zip(*seen, strict=True) if a is not None and b is not None]
    points: Any = [board] * len(both)
    a, b = ([pair[k].astype(np.float32)[:, None] for pair in both] for k in (0, 1))
    flags = cv2.CALIB_FIX_K3
    _, K1, D1, *_ = cv2.calibrateCamera(points, a, (640, 480), np.eye(3), np.zeros(5), flags=flags)
    _, K2, D2, *_ = cv2.calibrateCamera(points, b, (640, 480), np.eye(3), np.zeros(5), flags=flags)
    _, K1, D1, K2, D2, R, T, *_ = cv2.stereoCalibrate(points, a, b, K1, D1, K2, D2, (640, 480), flags=flags)
    path = tmp_path / "stereo.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    values = {"width": 640, "height": 480, "camera1": "left", "camera2": "right", "K1": K1, "D1": D1}
    for name, value in (values | {"K2": K2, "D2": D2, "R": R, "T": T}).items():
        storage.write(name, value)
    storage.release()
    assert kolinear("undistort", path, images, "--pairs", "--out", tmp_path / "out") == 0
    rows = []
    for k in numbers:
        left, right = (corners_of(tmp_path / "out", f"{side}{k:02d}.jpg") for side in ("left", "right"))
        if left is not None and right is not None:
            rows.append(right[:, 1] - left[:, 1])
    v = np.concatenate(rows)
    assert len(v) > 500 and abs(np.mean(v)) < 0.05 and np.median(np.abs(v)) < 0.2
