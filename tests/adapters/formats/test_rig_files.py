"""Calibration files of rigs: read by the programs that own them, or as their documentation has them."""

from __future__ import annotations

import ast
import json
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pycolmap
import pytest
import yaml
from scipy.spatial.transform import Rotation

from adapters.formats.content import Content
from adapters.formats.registry import write_content
from sfm.cli.commands.convert import convert
from sfm.comparison.camera_conversion import convert_cameras
from sfm.model.camera import project
from sfm.model.conventions import rotation_from_vector
from sfm.model.errors import OutputError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.rectification import rectify
from sfm.model.solution import Solution
from tests.rigs import make_rig
from tests.synthetic import make_network, seed_of

AXES = np.diag([1.0, -1.0, -1.0])


def made(cameras: int = 2) -> tuple[Network, Estimate]:
    """A rig with cameras in model opencv, and photographs in folders of their cameras."""
    network, truth = make_rig(seed_of("rig files"), cameras=cameras, moments=4, points=15)
    truth = convert_cameras(truth, ("opencv",))[0]
    small = np.where(np.array(truth.cameras[0].names) == "p1", 1e-5, truth.cameras[0].parameters)
    truth = replace(truth, cameras=tuple(camera.with_parameters(small) for camera in truth.cameras))
    assert network.moment is not None
    pairs = zip(network.camera.tolist(), network.moment.tolist(), strict=True)
    return replace(network, images=tuple(f"c{a}/{t:03d}.jpg" for a, t in pairs)), truth


def written(folder: Path, network: Network, truth: Estimate, unit: str = "mm") -> Path:
    write_content(folder, "rig", Content(Solution("x", network, truth, unit=unit)))
    return folder


def opencv(path: Path) -> dict[str, Any]:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    nodes = {name: storage.getNode(name) for name in storage.root().keys()}  # noqa: SIM118
    return {
        name: node.mat() if node.isMap() else node.string() if node.isString() else node.real()
        for name, node in nodes.items()
    }


def undistorted(xy: Any, K: Any, D: Any, R: Any, P: Any) -> np.ndarray:
    """Return where OpenCV sees points without distortion, iterated to the end, (n, 2)."""
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    return np.asarray(cv2.undistortPoints(xy, K, D, None, R, P, until))[:, 0]


def in_opencv_axes(truth: Estimate, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation vector and translation of a photograph for cv2.projectPoints."""
    R = AXES @ truth.rotation[i].T
    return cv2.Rodrigues(R)[0], -R @ truth.position[i]


def test_opencv_projects_as_we_do_and_rectifies_to_rows(tmp_path: Path) -> None:
    """Points through K1, D1, R, T, K2, D2 of the file, epipolar lines of F, and stereoRectify itself."""
    network, truth = made()
    found = opencv(written(tmp_path / "r", network, truth) / "opencv-camera_1-camera_2.yml")
    assert (found["camera1"], found["camera2"], found["width"], found["height"]) == (
        *("camera 1", "camera 2"),
        *(2000, 1500),
    )
    K, D, R, T = (found["K1"], found["K2"]), (found["D1"], found["D2"]), found["R"], found["T"]
    r, t = in_opencv_axes(truth, 0)
    xyz = (cv2.Rodrigues(r)[0] @ truth.points.T).T + t
    views = [
        cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), K[0], D[0])[0][:, 0],
        cv2.projectPoints(xyz, cv2.Rodrigues(R)[0], T, K[1], D[1])[0][:, 0],
    ]
    for i, view in enumerate(views):
        own = project(truth.cameras[i], truth.position[i], truth.rotation[i], truth.points)
        np.testing.assert_allclose(view, own, atol=1e-7)
    ideal = [undistorted(v, k, d, None, k) for v, k, d in zip(views, K, D, strict=True)]
    h = [np.column_stack([v, np.ones(len(v))]) for v in ideal]
    lines = h[0] @ found["F"].T
    assert np.abs((h[1] * lines).sum(axis=1) / np.linalg.norm(lines[:, :2], axis=1)).max() < 1e-6
    E = K[1].T @ found["F"] @ K[0]
    np.testing.assert_allclose(found["E"] / np.linalg.norm(found["E"]), E / np.linalg.norm(E), atol=1e-9)
    exact: Any = cv2.stereoRectify(
        *(K[0], D[0], K[1], D[1], (2000, 1500), R, T), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0
    )
    for name, M in zip(("R1", "R2", "P1", "P2", "Q"), exact, strict=False):
        np.testing.assert_allclose(found[name], M, rtol=1e-9, atol=1e-9, err_msg=name)
    rows = [
        undistorted(v, k, d, found[f"R{n}"], found[f"P{n}"])
        for n, (v, k, d) in enumerate(zip(views, K, D, strict=True), 1)
    ]
    np.testing.assert_allclose(rows[0][:, 1], rows[1][:, 1], atol=1e-6)
    deep = np.column_stack([rows[0], rows[0][:, 0] - rows[1][:, 0], np.ones(len(xyz))]) @ found["Q"].T
    np.testing.assert_allclose(deep[:, :3] / deep[:, 3:], xyz @ found["R1"].T, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("base", [(0.3, 0.02, 0.01), (-0.3, 0.02, 0.05), (0.02, 0.4, 0.0), (0.0, -0.4, 0.1)])
@pytest.mark.parametrize("alpha", [0.0, 0.4, 1.0])
def test_rectification_is_that_of_opencv(base: tuple[float, ...], alpha: float) -> None:
    """Left, right, above and below, with cameras of different focal length, in all digits."""
    _, truth = made()
    first = truth.cameras[0]
    second = first.with_parameters(first.parameters * (1.1, 1.1, 1, 1, 1, 1, 1, 1))
    R, T = rotation_from_vector(np.array([0.05, -0.08, 0.03])), np.array(base)
    found = rectify(first, second, R, T, alpha=alpha)
    assert found is not None
    K = [
        np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]]) for p in (first.parameters, second.parameters)
    ]
    exact: Any = cv2.stereoRectify(
        *(K[0], first.parameters[4:], K[1], second.parameters[4:], first.size_px, R, T[:, None]),
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=alpha,
    )
    for mine, M in zip(found, exact, strict=False):
        np.testing.assert_allclose(mine, M, rtol=1e-9, atol=1e-9)


def test_cameras_that_look_apart_have_no_rectification(tmp_path: Path) -> None:
    network, truth = made()
    assert truth.mounts is not None
    rotation = truth.mounts.rotation.copy()
    rotation[1] = rotation_from_vector(np.array([0.0, 2.5, 0.0]))
    apart = replace(truth, mounts=replace(truth.mounts, rotation=rotation))
    found = opencv(written(tmp_path / "r", network, apart) / "opencv-camera_1-camera_2.yml")
    assert "R" in found and "R1" not in found
    assert "# no rectification" in (tmp_path / "r" / "opencv-camera_1-camera_2.yml").read_text()


def test_colmap_reads_the_rig(tmp_path: Path) -> None:
    network, truth = made(cameras=3)
    (config,) = pycolmap.read_rig_config(written(tmp_path / "r", network, truth) / "rig_config.json")
    assert [one.image_prefix for one in config.cameras] == ["c0/", "c1/", "c2/"]
    assert [one.ref_sensor for one in config.cameras] == [True, False, False]
    for i, one in enumerate(config.cameras):
        r, t = in_opencv_axes(truth, i)
        first = in_opencv_axes(truth, 0)
        R = cv2.Rodrigues(r)[0] @ cv2.Rodrigues(first[0])[0].T
        if i:
            assert one.cam_from_rig is not None
            pose = one.cam_from_rig.matrix()
            np.testing.assert_allclose(pose, np.column_stack([R, t - R @ first[1]]), atol=1e-12)
        assert one.camera is not None
        params = np.asarray(one.camera.params)
        np.testing.assert_allclose(params - truth.cameras[i].parameters, [0, 0, 0.5, 0.5, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("names", "prefixes"),
    [
        (("left{t:02d}.jpg", "right{t:02d}.jpg"), ["left", "right"]),
        (("a/img_{t}.png", "b/img_{t}.png"), ["a/", "b/"]),
        (("cam1/{t}.png", "cam10/{t}.png"), ["cam1/", "cam10/"]),
        (("{t}-left.jpg", "{t}-right.jpg"), ["camera 1/", "camera 2/"]),
        (("x{t}.jpg", "x1{t}.jpg"), ["camera 1/", "camera 2/"]),
    ],
)
def test_prefixes_are_what_names_of_a_camera_begin_with(
    names: tuple[str, str], prefixes: list[str], tmp_path: Path
) -> None:
    network, truth = made()
    assert network.moment is not None
    pairs = zip(network.camera.tolist(), network.moment.tolist(), strict=True)
    network = replace(network, images=tuple(names[a].format(t=t) for a, t in pairs))
    text = (written(tmp_path / "r", network, truth) / "rig_config.json").read_text()
    assert [one["image_prefix"] for one in json.loads(text)[0]["cameras"]] == prefixes


def test_folders_of_blocks_are_names_of_folders(tmp_path: Path) -> None:
    network, truth = made()
    cameras = tuple(replace(one, name=f"{one.name} [1-4]*") for one in truth.cameras)
    network = replace(network, images=tuple(f"{i} {a}" for i, a in enumerate(network.camera)))
    text = (written(tmp_path / "r", network, replace(truth, cameras=cameras)) / "rig_config.json").read_text()
    found = [one["image_prefix"] for one in json.loads(text)[0]["cameras"]]
    assert found == ["camera 1 _1-4_/", "camera 2 _1-4_/"]


def test_kalibr_chains_each_camera_to_the_one_before(tmp_path: Path) -> None:
    """In metres: the pose of the third camera is that of the chain."""
    network, truth = made(cameras=3)
    text = (written(tmp_path / "r", network, truth) / "kalibr-rig.yaml").read_text()
    assert text.startswith("# translations are in m\n")
    chain = yaml.safe_load(text)
    pose = np.array(chain["cam2"]["T_cn_cnm1"]) @ np.array(chain["cam1"]["T_cn_cnm1"])
    (r0, t0), (r, t) = in_opencv_axes(truth, 0), in_opencv_axes(truth, 2)
    R = cv2.Rodrigues(r)[0] @ cv2.Rodrigues(r0)[0].T
    np.testing.assert_allclose(pose[:3, :3], R, atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], 1e-3 * (t - R @ t0), atol=1e-12)
    first = chain["cam0"]
    found = [*first["intrinsics"], *first["distortion_coeffs"]]
    np.testing.assert_array_equal(found, truth.cameras[0].parameters)
    assert (first["resolution"], first["cam_overlaps"]) == ([2000, 1500], [1, 2])
    assert (first["camera_model"], first["distortion_model"]) == ("pinhole", "radtan")


def test_ros_has_the_rectification_of_a_pair_in_metres(tmp_path: Path) -> None:
    network, truth = made()
    folder = written(tmp_path / "r", network, truth)
    pair = opencv(folder / "opencv-camera_1-camera_2.yml")
    info = yaml.safe_load((folder / "ros-camera_2.yaml").read_text())
    P = np.array(info["projection_matrix"]["data"]).reshape(3, 4)
    np.testing.assert_allclose(P, pair["P2"] * np.array([1, 1, 1, 1e-3]), rtol=1e-12)
    np.testing.assert_array_equal(info["camera_matrix"]["data"], pair["K2"].ravel())
    np.testing.assert_allclose(info["rectification_matrix"]["data"], pair["R2"].ravel(), atol=1e-15)
    np.testing.assert_array_equal(info["distortion_coefficients"]["data"], pair["D2"].ravel())
    assert (info["image_width"], info["image_height"], info["camera_name"]) == (2000, 1500, "camera 2")
    three = written(tmp_path / "three", *made(cameras=3), unit="")
    text = (three / "ros-camera_3.yaml").read_text()
    assert "px times unknown units" in text
    assert yaml.safe_load(text)["rectification_matrix"]["data"] == np.eye(3).ravel().tolist()


def test_dice_has_the_second_camera_after_the_first(tmp_path: Path) -> None:
    network, truth = made()
    cameras = (replace(truth.cameras[0], name='<"a&b">'), truth.cameras[1])
    folder = written(tmp_path / "r", network, replace(truth, cameras=cameras))
    root = ElementTree.fromstring((folder / "dice-_a_b_-camera_2.xml").read_text())
    flags = {one.attrib["name"]: one.attrib["value"] for one in root.findall("Parameter")}
    assert flags == {
        "xml_file_format": "DICe_xml_camera_system_file",
        "system_type_3D": "OPENCV",
        "extrinsics_relative_camera_to_camera": "true",
    }
    pair = opencv(folder / "opencv-_a_b_-camera_2.yml")
    for k, R, T in ((0, np.eye(3), np.zeros(3)), (1, pair["R"], pair["T"][:, 0])):
        (camera,) = root.findall(f"ParameterList[@name='CAMERA {k}']")
        value = {one.attrib["name"]: one.attrib["value"] for one in camera.findall("Parameter")}
        assert value["CAMERA_ID"] == cameras[k].name and value["IMAGE_HEIGHT_WIDTH"] == "{ 1500, 2000 }"
        own = [float(value[name]) for name in ("FX", "FY", "CX", "CY", "K1", "K2", "P1", "P2")]
        np.testing.assert_array_equal(own, cameras[k].parameters)
        np.testing.assert_array_equal([float(value[name]) for name in ("TX", "TY", "TZ")], T)
        rows = [
            one.attrib["value"].strip("{} ").split(", ")
            for one in camera.iter()
            if "ROW" in one.attrib["name"]
        ]
        np.testing.assert_array_equal(np.array(rows, dtype=float), R)


def test_matchid_has_angles_and_millimetres(tmp_path: Path) -> None:
    """As pyvale reads such a file: R from Euler angles about fixed axes."""
    network, truth = made()
    folder = written(tmp_path / "r", network, truth, unit="m")
    lines = (folder / "matchid-camera_1-camera_2.caldat").read_text("utf-8").splitlines()
    value = {name: float(number) for name, number in (line.split(";") for line in lines)}
    pair = opencv(folder / "opencv-camera_1-camera_2.yml")
    angles = [value[f"{name} [deg]"] for name in ("Theta", "Phi", "Psi")]
    np.testing.assert_allclose(
        Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), pair["R"], atol=1e-14
    )
    T = [value[f"T{axis} [mm]"] for axis in "xyz"]
    np.testing.assert_allclose(T, 1e3 * pair["T"][:, 0], rtol=1e-14)
    for k, camera in enumerate(truth.cameras):
        names = ("Fx [pixels]", "Fy [pixels]", "Cx [pixels]", "Cy [pixels]", "Kappa 1", "Kappa 2", "P1", "P2")
        np.testing.assert_array_equal([value[f"Cam{k}_{name}"] for name in names], camera.parameters)
    assert not list(written(tmp_path / "no", network, truth, unit="").glob("matchid*"))


def test_mrcal_models_are_of_the_reference_camera(tmp_path: Path) -> None:
    """A Python literal, as mrcal evaluates it."""
    network, truth = made()
    folder = written(tmp_path / "r", network, truth)
    text = (folder / "mrcal-camera_2.cameramodel").read_text()
    model = ast.literal_eval(text)
    assert model["lensmodel"] == "LENSMODEL_OPENCV4" and model["imagersize"] == [2000, 1500]
    np.testing.assert_array_equal(model["intrinsics"], truth.cameras[1].parameters)
    pair = opencv(folder / "opencv-camera_1-camera_2.yml")
    np.testing.assert_allclose(cv2.Rodrigues(np.array(model["rt_cam_ref"][:3]))[0], pair["R"], atol=1e-12)
    np.testing.assert_allclose(model["rt_cam_ref"][3:], 1e-3 * pair["T"][:, 0], atol=1e-15)


def test_convert_writes_a_rig_of_a_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    network, truth = make_rig(seed_of("convert rig"), moments=4, points=15)
    Solution("x", network, truth).write(tmp_path / "t")
    convert(tmp_path / "t", tmp_path / "r", to_format="rig")
    told = capsys.readouterr().out
    assert "2 cameras of 1 rig as rig" in told and "to opencv, curve fitted, misfit" in told
    assert len(list((tmp_path / "r").iterdir())) == 8
    single = make_network(seed_of("convert single"), images=3, points=8)
    Solution("x", *single).write(tmp_path / "single")
    with pytest.raises(OutputError, match="the result has no rigs") as refused:
        convert(tmp_path / "single", tmp_path / "none", to_format="rig")
    assert "\n" not in str(refused.value) and not (tmp_path / "none").exists()


def test_names_that_give_one_file_are_refused(tmp_path: Path) -> None:
    network, truth = made()
    cameras = tuple(replace(one, name=name) for one, name in zip(truth.cameras, ("a b", "a_b"), strict=True))
    with pytest.raises(OutputError, match="two files would be ros-a_b"):
        written(tmp_path / "r", network, replace(truth, cameras=cameras))
