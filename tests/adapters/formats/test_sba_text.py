"""Text formats of bundle blocks, sba's and BAL: what is read, what is refused, costs met."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from adapters.formats.registry import read_any, read_comparable, write_any
from adapters.formats.sba_text import read_sba_text, sba_files
from sfm.adjustment.solve import adjust
from sfm.cli.commands.convert import convert
from sfm.comparison.camera_conversion import convert_camera
from sfm.comparison.significance import compare_results
from sfm.model.camera import project
from sfm.model.errors import KolinearError, OutputError, SurveyFileError
from sfm.model.solution import Solution
from tests.synthetic import make_network, seed_of

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
    with pytest.raises(SurveyFileError, match=r"found: 54cams\.txt, cams\.txt"):
        sba_files(tmp_path)
    with pytest.raises(SurveyFileError, match=r"54cams\.txt: .* beside one \*pts\*\.txt"):
        sba_files(tmp_path / "54cams.txt")


def test_what_sba_cannot_hold_is_refused(files: dict[str, Path], tmp_path: Path) -> None:
    network, estimate = read_any(tmp_path)
    camera = estimate.cameras[0]
    bent = camera.with_parameters(camera.parameters + np.array([0, 0, 0, 0, 0.1, 0, 0, 0]))
    with pytest.raises(KolinearError, match=r"camera 1: format sba cannot store k1 .* --undistort corrects"):
        write_any(tmp_path / "x", "sba", network, replace(estimate, cameras=(bent,)))
    lost = replace(estimate, points=estimate.points * np.nan)
    with pytest.raises(OutputError, match="start values of all"):
        write_any(tmp_path / "y", "sba", network, lost)


VIEWS, POINTS = 5, 14


def projected(values: np.ndarray, image: np.ndarray, point: np.ndarray) -> np.ndarray:
    """BAL's own model from its page: p = -P / P_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p."""
    cameras, xyz = (
        values[: 9 * VIEWS].reshape(-1, 9)[image],
        values[9 * VIEWS :].reshape(-1, 3)[point],
    )
    P = Rotation.from_rotvec(cameras[:, :3]).apply(xyz) + cameras[:, 3:6]
    p = -P[:, :2] / P[:, 2:]
    r2 = (p**2).sum(axis=1)
    return (cameras[:, 6] * (1 + cameras[:, 7] * r2 + cameras[:, 8] * r2**2))[:, None] * p


def problem(path: Path, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Write a problem by hand whose photographs have other f, k1, k2 each; noise of 0.5 px."""
    rng = seed_of(name)
    xyz = rng.uniform(-1, 1, (POINTS, 3))
    cameras = []
    for i in range(VIEWS):
        turn = Rotation.from_euler("xyz", [0.3 * np.cos(i), 2 * np.pi * i / VIEWS, 0.7 * i])
        cameras.append([*turn.as_rotvec(), *rng.uniform(-0.1, 0.1, 2), -5, 900 + 40 * i, -0.1, 0.02])
    image, point = (index.ravel() for index in np.indices((VIEWS, POINTS)))
    values = np.array([*np.ravel(cameras), *xyz.ravel()])
    xy = projected(values, image, point) + 0.5 * rng.standard_normal((len(image), 2))
    start = values + 1e-3 * rng.standard_normal(len(values)) * np.maximum(1, np.abs(values))
    rows = [f"{i} {j} {float(x)!r} {float(y)!r}" for i, j, (x, y) in zip(image, point, xy, strict=True)]
    path.write_text(
        "\n".join([f"{VIEWS} {POINTS} {len(image)}", *rows, *(repr(float(v)) for v in start)]) + "\n"
    )
    return start, image, point, xy


@pytest.mark.parametrize("name", ["bal 1", "bal 2"])
def test_adjustment_reaches_the_cost_of_an_independent_solver(name: str, tmp_path: Path) -> None:
    start, image, point, xy = problem(tmp_path / "problem.txt", name)

    def residuals(values: np.ndarray) -> np.ndarray:
        return np.asarray((projected(values, image, point) - xy).ravel())

    best = least_squares(residuals, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    network, estimate = read_any(tmp_path / "problem.txt")
    a = adjust(network, estimate, reject="none")
    cost = 0.5 * float((a.residuals**2).sum())
    assert cost == pytest.approx(best.cost, rel=1e-9)
    assert a.redundancy == 2 * len(image) - 9 * VIEWS - 3 * POINTS + 7
    # written back, it is the same minimum of BAL's model
    write_any(tmp_path / "solved.txt", "bal", a.network, a.estimate)
    lines = (tmp_path / "solved.txt").read_text().split("\n")
    solved = np.array([float(line) for line in lines[1 + len(image) :] if line])
    assert 0.5 * float((residuals(solved) ** 2).sum()) == pytest.approx(best.cost, rel=1e-8)


def test_numbers_are_no_names_and_what_coincides_is_paired_by_place(tmp_path: Path) -> None:
    """The points of a result, numbered by BAL in another order, and back in tables."""
    network, truth = make_network(seed_of("bal names"), images=5, points=30, model="radial")
    order = seed_of("bal order").permutation(30)
    named = replace(network, points=tuple(str(j) for j in order))
    write_any(tmp_path / "problem.txt", "bal", named, truth)
    convert(tmp_path / "problem.txt", tmp_path / "tables")
    found = compare_results(Solution("own", named, truth), read_comparable(tmp_path / "tables"))
    assert len(found.points) == 30 and found.pairing.points_by_name == 0
    assert np.abs(found.point_difference).max() < 1e-9


@pytest.mark.parametrize("model", ["simple_pinhole", "pinhole", "simple_radial", "radial"])
def test_models_with_one_focal_length_are_converted_both_ways(model: str) -> None:
    _, truth = make_network(seed_of("one focal length"), images=2, points=8, model=model)
    for general in ("opencv", "full_opencv", "brown_forward"):
        there = convert_camera(truth.cameras[0], general)
        back = convert_camera(there.camera, model)
        assert max(there.max_px, back.max_px) < 1e-8
        np.testing.assert_allclose(back.camera.parameters, truth.cameras[0].parameters, rtol=1e-8)
    assert convert_camera(convert_camera(truth.cameras[0], "brown").camera, model).max_px < 0.1
