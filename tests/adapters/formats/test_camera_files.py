"""Files of cameras: there and back, read by the programs that own them, and files that are none."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import yaml

from adapters.formats.cameras.registry import (
    CAMERA_FORMATS,
    NAMES,
    camera_format,
    camera_format_of,
    read_cameras,
    write_cameras,
)
from sfm.cli.commands.convert import convert
from sfm.model.camera import Camera, camera_from_values, pixel_from_tangents
from sfm.model.camera_file import CameraFile
from sfm.model.errors import KolinearError, OutputError, SurveyFileError
from sfm.model.estimate import Mounts
from tests.places import SHARED
from tests.rigs import make_rig
from tests.synthetic import seed_of

SIZE = (640, 480)
PLANE = (("fx", 533.4), ("fy", 533.9), ("cx", 341.2), ("cy", 235.6))
BROWN = (("K1", -1e-7), ("K2", 2e-13), ("P1", 1e-6), ("P2", -2e-6))


def camera(model: str, *values: tuple[str, float], c: float = 533.4) -> Camera:
    return camera_from_values("left 1", model, SIZE, (1.0, 1.0), c_mm=c, values=values)


LENSES = {
    "opencv": camera("opencv", *PLANE, ("k1", -0.29), ("k2", 0.1), ("p1", 1e-3), ("p2", -2e-4)),
    "five": camera("full_opencv", *PLANE, ("k1", -0.29), ("k2", 0.1), ("p1", 1e-3), ("k3", -0.02)),
    "rational": camera(
        "full_opencv", *PLANE, ("k1", 0.1), ("k2", 0.1), ("k4", 0.39), ("k5", 0.1), ("k6", 1e-5)
    ),
    "fisheye": camera("opencv_fisheye", *PLANE, ("k1", -0.01), ("k2", 2e-3), ("k4", 1e-5)),
    "pinhole": camera("pinhole", *PLANE),
    "simple_radial": camera("simple_radial", ("f", 500.0), ("cx", 320.5), ("k", -0.1)),
    "stereographic": camera("eucm", *PLANE, ("alpha", 0.5), ("beta", 1.0)),
    "eucm": camera("eucm", *PLANE, ("alpha", 0.6), ("beta", 1.1)),
    "fov": camera("fov", *PLANE, ("omega", 0.9)),
    "metashape": camera(
        "brown_forward_affine", *BROWN, ("K4", 1e-24), ("b1", 1e-4), ("b2", 2e-4), ("x0", 3.0)
    ),
    "brown_affine": camera("brown_affine", *BROWN, ("x0", 3.0), ("b1", 1e-4), ("b2", -1e-4)),
    "brown": camera("brown", *BROWN, ("y0", -2.0)),
}
RAYS = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.4, 0.4, 7)), axis=-1).reshape(-1, 2)


def file_of(*cameras: Camera, mounts: Mounts | None = None, unit: str = "") -> CameraFile:
    return CameraFile("test", cameras, (None,) * len(cameras), mounts, unit)


def stored_in() -> list[tuple[str, str, str]]:
    """Every format with each of its endings and each lens that it stores."""
    return [
        (form.name, suffix, name)
        for form in CAMERA_FORMATS
        for suffix in form.suffixes
        for name, lens in LENSES.items()
        if form.stored(lens) is not None
    ]


@pytest.mark.parametrize(("name", "suffix", "lens"), stored_in())
def test_cameras_are_read_as_they_were_written(name: str, suffix: str, lens: str, tmp_path: Path) -> None:
    """To 1e-6 px over the photograph, and recognised by the content alone."""
    path = tmp_path / (f"cameras{suffix}" if name == "colmap-camera" else f"a{suffix}")
    write_cameras(path, name, file_of(LENSES[lens]))
    found = camera_format_of(path)
    assert found is not None and found.name == name
    (read,) = read_cameras(path).cameras
    assert read.size_px == SIZE
    np.testing.assert_allclose(
        pixel_from_tangents(read, RAYS), pixel_from_tangents(LENSES[lens], RAYS), atol=1e-6
    )


def test_every_format_stores_something_and_no_format_everything() -> None:
    formats = {name for name, _, _ in stored_in()}
    assert formats == set(NAMES)
    assert {"eucm", "fov", "metashape"} & {
        lens for name, _, lens in stored_in() if name == "opencv-camera"
    } == set()


def projected(lens: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return points in axes x right, y down, z forward, and where the camera sees them."""
    return np.column_stack([RAYS * (1, -1), np.ones(len(RAYS))]), pixel_from_tangents(lens, RAYS)


def opencv_values(path: Path) -> dict[str, Any]:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    nodes = {name: storage.getNode(name) for name in storage.root().keys()}  # noqa: SIM118
    return {
        name: node.mat() if node.isMap() else node.string() if node.isString() else node.real()
        for name, node in nodes.items()
    }


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
@pytest.mark.parametrize("lens", ["opencv", "five", "rational", "fisheye", "pinhole", "simple_radial"])
def test_opencv_sees_what_we_see(lens: str, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    write_cameras(path, "opencv-camera", replace(file_of(LENSES[lens]), rms_px=(0.25,)))
    found = opencv_values(path)
    assert (found["width"], found["height"], found["camera"], found["rms"]) == (*SIZE, "left 1", 0.25)
    points, xy = projected(LENSES[lens])
    if lens == "fisheye":
        seen = cv2.fisheye.projectPoints(
            points[:, None], np.zeros(3), np.zeros(3), found["K"], found["D"][0]
        )[0]
    else:
        seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), found["K"], found["D"])[0]
    np.testing.assert_allclose(seen.reshape(-1, 2), xy, atol=1e-6)


def test_what_opencv_writes_is_read(tmp_path: Path) -> None:
    """As its calibration sample names it, in both of its formats, and a stereo pair."""
    K, D = np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]), np.array([[-0.2, 0.1, 1e-3, 1e-5, 0.0]])
    for ending in ("yml", "json"):
        path = tmp_path / f"sample.{ending}"
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", 640)
        storage.write("image_height", 480)
        storage.write("camera_matrix", K)
        storage.write("distortion_coefficients", D)
        storage.write("avg_reprojection_error", 0.31)
        storage.release()
        file = read_cameras(path)
        np.testing.assert_array_equal(file.cameras[0].parameters, [500, 501, 320, 240, -0.2, 0.1, 1e-3, 1e-5])
        assert file.rms_px == (0.31,) and file.cameras[0].name == "sample"


def test_other_programs_spellings_are_read(tmp_path: Path) -> None:
    """Lists of lists from Python, and frames of nerfstudio with cameras of their own."""
    path = tmp_path / "a.json"
    K = [[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]
    path.write_text(json.dumps({"mtx": K, "dist": [[-0.2, 0.1, 1e-3, 1e-5, 0]], "image_size": [640, 480]}))
    (camera_read,) = read_cameras(path).cameras
    np.testing.assert_array_equal(camera_read.parameters, [500, 501, 320, 240, -0.2, 0.1, 1e-3, 1e-5])
    frames = [
        {"file_path": "a", "transform_matrix": [[1]], "fl_x": f, "w": 640, "h": 480, "cx": 320.5, "cy": 240.5}
        for f in (500, 600, 500)
    ]
    path.write_text(json.dumps({"frames": frames, "camera_model": "PINHOLE"}))
    read = read_cameras(path).cameras
    assert [lens.parameters.tolist() for lens in read] == [[500, 500, 320, 240], [600, 600, 320, 240]]


def test_a_stereo_pair_has_its_mounts(tmp_path: Path) -> None:
    """As `convert --to rig` and Kalibr's chain have them: the same mount from either."""
    _, truth = make_rig(seed_of("pair of files"), moments=4, points=15)
    assert truth.mounts is not None
    lenses = tuple(replace(LENSES["opencv"], name=name) for name in ("left", "right"))
    chain = tmp_path / "chain.yaml"
    write_cameras(chain, "kalibr-camera", file_of(*lenses, mounts=truth.mounts, unit="m"))
    read = read_cameras(chain)
    assert read.mounts is not None and read.unit == "m"
    np.testing.assert_allclose(read.mounts.position, truth.mounts.position, atol=1e-12)
    np.testing.assert_allclose(read.mounts.rotation, truth.mounts.rotation, atol=1e-12)
    for ending in ("yaml", "json"):
        pair = tmp_path / f"pair.{ending}"
        write_cameras(pair, "opencv-camera", file_of(*lenses, mounts=truth.mounts, unit="mm"))
        found, storage = read_cameras(pair), opencv_values(pair)
        assert found.mounts is not None and [camera.name for camera in found.cameras] == ["left", "right"]
        np.testing.assert_allclose(found.mounts.position, truth.mounts.position, atol=1e-12)
        exact: Any = cv2.stereoRectify(
            *(storage[name] for name in ("K1", "D1", "K2", "D2")),
            SIZE,
            *(storage["R"], storage["T"]),
            flags=cv2.CALIB_ZERO_DISPARITY,
            alpha=0,
        )
        np.testing.assert_allclose(storage["Q"], exact[4], rtol=1e-9, atol=1e-9)
    in_mm = tmp_path / "mm.yaml"
    write_cameras(in_mm, "kalibr-camera", file_of(*lenses, mounts=truth.mounts, unit="mm"))
    scaled = read_cameras(in_mm).mounts
    assert scaled is not None
    np.testing.assert_allclose(1000 * scaled.position, truth.mounts.position, atol=1e-9)
    larger = replace(lenses[1], size_px=(2 * SIZE[0], SIZE[1]))  # of which the file of a pair has no place
    with pytest.raises(OutputError, match="has one camera, not 2"):
        write_cameras(
            tmp_path / "sizes.yaml", "opencv-camera", file_of(lenses[0], larger, mounts=truth.mounts)
        )
    single = replace(truth.mounts, rig=("a", "b"))
    write_cameras(tmp_path / "apart.yaml", "kalibr-camera", file_of(*lenses, mounts=single, unit="m"))
    assert read_cameras(tmp_path / "apart.yaml").mounts is None


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
@pytest.mark.parametrize("lens", ["opencv", "rational", "fisheye", "pinhole", "simple_radial", "fov", "eucm"])
def test_colmap_sees_what_we_see(lens: str, suffix: str, tmp_path: Path) -> None:
    """The file among those of an empty model, as COLMAP reads it."""
    scene = pycolmap.Reconstruction()
    (scene.write_text if suffix == ".txt" else scene.write_binary)(str(tmp_path))
    path = tmp_path / f"cameras{suffix}"
    path.unlink()
    write_cameras(path, "colmap-camera", file_of(LENSES[lens]))
    scene = pycolmap.Reconstruction()
    (scene.read_text if suffix == ".txt" else scene.read_binary)(str(tmp_path))
    points, xy = projected(LENSES[lens])
    np.testing.assert_allclose(scene.camera(1).img_from_cam(points) - 0.5, xy, atol=1e-6)


def test_yaml_of_ros_and_kalibr_is_plain(tmp_path: Path) -> None:
    """PyYAML's safe loader reads numbers as numbers."""
    for name in ("ros-camera", "kalibr-camera"):
        write_cameras(tmp_path / f"{name}.yaml", name, file_of(LENSES["opencv"]))
    ros = yaml.safe_load((tmp_path / "ros-camera.yaml").read_text())
    assert (ros["image_width"], ros["distortion_model"]) == (640, "plumb_bob")
    K = np.array(ros["camera_matrix"]["data"]).reshape(3, 3)
    points, xy = projected(LENSES["opencv"])
    D = np.array(ros["distortion_coefficients"]["data"])
    np.testing.assert_allclose(
        cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0][:, 0], xy, atol=1e-6
    )
    chain = yaml.safe_load((tmp_path / "kalibr-camera.yaml").read_text())["cam0"]
    np.testing.assert_array_equal(
        chain["intrinsics"] + chain["distortion_coeffs"], LENSES["opencv"].parameters
    )


def test_mrcals_own_files_are_read() -> None:
    """Its example of eight coefficients, at its pixels; the splined one is refused."""
    path = SHARED / "data" / "formats" / "mrcal" / "cam0.opencv8.cameramodel"
    if not path.exists():
        pytest.skip("the file is not in ../shared/data")
    (lens,) = read_cameras(path).cameras
    assert lens.size_px == (4000, 2200)
    p = lens.parameters
    points = np.column_stack([RAYS * (1, -1), np.ones(len(RAYS))])
    K = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]])
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, p[4:])[0][:, 0]
    np.testing.assert_allclose(pixel_from_tangents(lens, RAYS), seen, atol=1e-6)
    with pytest.raises(SurveyFileError, match="splined models are not read"):
        read_cameras(path.with_name("cam0.splined.cameramodel"))


def test_the_optimization_inputs_of_mrcal_are_skipped(tmp_path: Path) -> None:
    path = tmp_path / "a.cameramodel"
    text = MRCAL.format("LENSMODEL_PINHOLE", "5, 5, 3, 2", "6, 4")
    path.write_text(f"{text[:-2]},\n 'optimization_inputs': b'{'a#{}' * 300_000}' }}")
    assert read_cameras(path).cameras[0].parameters.tolist() == [5, 5, 3, 2, 0, 0, 0, 0]


def test_a_stereographic_projection_is_2_tan_of_half_the_angle() -> None:
    angle = np.radians([10.0, 45.0, 80.0])
    lens = LENSES["stereographic"]
    xy = pixel_from_tangents(lens, np.column_stack([np.tan(angle), np.zeros(3)]))
    np.testing.assert_allclose(xy[:, 0], 341.2 + 533.4 * 2 * np.tan(angle / 2), atol=1e-6)


def test_nerfstudio_counts_from_the_corner() -> None:
    path = SHARED / "data" / "formats" / "transforms-fox.json"
    if not path.exists():
        pytest.skip("the file is not in ../shared/data")
    (lens,) = read_cameras(path).cameras
    assert (lens.size_px, lens.model) == ((1080, 1920), "opencv")
    assert (lens.value("fx"), lens.value("cx"), lens.value("cy")) == (1375.52, 554.058, 964.768)


def test_metashape_has_its_signs(tmp_path: Path) -> None:
    """The formula of its manual for one ray, and the frame of its pixels."""
    path = tmp_path / "a.xml"
    path.write_text(
        "<calibration><projection>frame</projection><width>640</width><height>480</height><f>500</f>"
        "<cx>3</cx><cy>-2</cy><b1>0.5</b1><b2>0.2</b2><k1>-0.1</k1><p1>1e-3</p1><p2>2e-3</p2></calibration>"
    )
    (lens,) = read_cameras(path).cameras
    x, y = 0.2, -0.1
    r2 = x * x + y * y
    xd = x * (1 - 0.1 * r2) + 1e-3 * (r2 + 2 * x * x) + 2 * 2e-3 * x * y
    yd = y * (1 - 0.1 * r2) + 2e-3 * (r2 + 2 * y * y) + 2 * 1e-3 * x * y
    expected = np.array([320 + 3 + xd * 500.5 + yd * 0.2, 240 - 2 + yd * 500]) - 0.5
    np.testing.assert_allclose(pixel_from_tangents(lens, np.array([[x, -y]]))[0], expected, atol=1e-9)


def test_blender_shifts_the_picture(tmp_path: Path) -> None:
    """A shift by a tenth of the sensor moves the principal point by a tenth of the width to the left."""
    path = tmp_path / "a.json"
    content = {"lens": 50.0, "sensor_width": 36.0, "sensor_fit": "AUTO", "shift_x": 0.1, "shift_y": 0.05}
    path.write_text(json.dumps(content | {"resolution_x": 1000, "resolution_y": 500}))
    (lens,) = read_cameras(path).cameras
    np.testing.assert_allclose(lens.parameters, [50 / 36 * 1000] * 2 + [399.5, 299.5])
    np.testing.assert_allclose(lens.pixel_mm, 0.036)


def test_blender_renders_a_part_of_its_resolution(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    content = {"lens": 50.0, "sensor_width": 36.0, "shift_x": 0.1, "resolution_percentage": 50}
    path.write_text(json.dumps(content | {"resolution_x": 1000, "resolution_y": 501}))
    (lens,) = read_cameras(path).cameras
    assert lens.size_px == (500, 250)
    np.testing.assert_allclose(lens.parameters, [50 / 36 * 500] * 2 + [199.5, 124.5])


@pytest.mark.parametrize(("suffix", "value", "model"), [
    (".json", "true", "opencv_fisheye"), (".json", "false", "opencv"),
    (".yaml", "False", "opencv"), (".yaml", "yes", "opencv_fisheye"),
])  # fmt: skip
def test_a_fisheye_lens_is_stated_by_truth_values(
    suffix: str, value: str, model: str, tmp_path: Path
) -> None:
    path = tmp_path / f"a{suffix}"
    K = "[[500, 0, 320], [0, 500, 240], [0, 0, 1]]"
    entries = [f'"{key}": {text}' for key, text in (("size", "[640, 480]"), ("fisheye", value), ("K", K))]
    path.write_text(f"{{{', '.join(entries)}}}" if suffix == ".json" else "\n".join(entries))
    assert read_cameras(path).cameras[0].model == model


def test_frames_share_what_the_file_of_nerfstudio_states(tmp_path: Path) -> None:
    """Sizes are the file's, focal lengths those of frames; equal frames are one camera."""
    path = tmp_path / "transforms.json"
    frames = [{"fl_x": f, "cx": 320, "cy": 240} for f in (500, 500, 510)]
    path.write_text(json.dumps({"w": 640, "h": 480, "is_fisheye": True, "frames": frames}))
    cameras = read_cameras(path).cameras
    assert [(camera.name, camera.value("fx")) for camera in cameras] == [("camera 1", 500), ("camera 2", 510)]
    assert all(camera.model == "opencv_fisheye" and camera.size_px == (640, 480) for camera in cameras)


def test_ros_may_leave_model_and_name_empty(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(
        ROS.format('""', 500) + "camera_name: ''\ndistortion_coefficients: {data: [0.1, 0, 0, 0, 0]}\n"
    )
    (camera,) = read_cameras(path).cameras
    assert camera.name == "a" and not camera.parameters[4:].any()


AUSTRALIS = """\
Australis Bundle Adjustment Results: Camera Parameters

Results for Camera 1   WASP-LT Camera 3 Lens

Sensor Size       Pixel Size (mm)
H   648           0.007
V   494           0.007

C         8.0000        0.30937     8.3094   1.0e+003   6.782e-003 (mm)
XP        0.0000       -0.02804    -0.0280   1.0e+003   6.879e-003 (mm)
YP        0.0000        0.02142     0.0214   1.0e+003   7.204e-003 (mm)
K1   0.00000e+000  1.674e-003  1.67381e-003  1.0e+003   1.238e-004
P1   0.00000e+000  1.752e-005  1.75249e-005  1.0e+003   3.496e-005
B1   0.00000e+000 -4.343e-004 -4.34298e-004  1.0e+003   1.100e-004

Maximum Observational Radial Distance Encountered:  2.9 mm
"""


def test_australis_has_final_values(tmp_path: Path) -> None:
    path = tmp_path / "report.txt"
    path.write_text(AUSTRALIS)
    (lens,) = read_cameras(path).cameras
    assert (lens.name, lens.model, lens.size_px) == ("WASP-LT Camera 3", "brown_affine", (648, 494))
    names = ("c", "x0", "y0", "K1", "K2", "P1", "b1")
    assert [lens.value(name) for name in names] == [
        *(8.3094, -0.028, 0.0214, 1.67381e-3, 0.0, 1.75249e-5, -4.34298e-4)
    ]


CV_YAML = "%YAML:1.0\n---\nwidth: 640\nheight: 480\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
GOOD = CV_YAML + "   data: [ 500., 0., 320., 0., 500., 240., 0., 0., 1. ]\n"
ROS = (
    "image_width: 640\nimage_height: 480\ndistortion_model: {}\n"
    "camera_matrix:\n  data: [500, 0, 320, 0, {}, 240, 0, 0, 1]\n"
)
CHAIN = "".join(
    f"cam{k}:\n  camera_model: pinhole\n  intrinsics: [5, 5, 3, 2]\n  resolution: [6, 4]\n" for k in (0, 1)
) + (  # of the last camera
    "  T_cn_cnm1: [[{}, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, {}]]\n"
)
MRCAL = "{{ 'lensmodel': '{}', 'intrinsics': [{}], 'imagersize': [{}] }}"
BAD: dict[str, tuple[str, str]] = {
    "a.yaml": ("hello", "not a file of a camera in a format"),
    "b.yaml": (GOOD.replace("width: 640\n", ""), "the size of the photographs is missing"),
    "c.yaml": (GOOD.replace("height: 480\n", ""), "height is missing"),
    "d.yaml": (GOOD.replace("500.", ".Nan", 1), "K.data is '.Nan', needed a finite number"),
    "e.yaml": (GOOD.replace("640", "-3"), "width is -3 px, needed a whole number"),
    "f.yaml": (GOOD.replace("500., 0.", "-500., 0.", 1), "focal length -500 px, it must be positive"),
    "g.yaml": (GOOD.replace("500., 0.", "500., 0.3", 1), "skew 0.3"),
    "h.yaml": (GOOD.replace("rows: 3", "rows: 4"), "9 numbers, rows and cols state 4 x 3"),
    "i.yaml": (GOOD + "D: [1, 2]\n", "D: 2 numbers, needed 0 or 4 or 5 or 8"),
    "j.yaml": (GOOD + "D: [0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]\n", "thin prism or tilted sensor"),
    "k.yaml": (GOOD + "b: &x [1]\nc: *x\n", "an alias, which is not read"),
    "l.yaml": (GOOD + "  : : [\n", ", line 10: not a file of an OpenCV camera"),
    "m.yaml": (ROS.format("equirectangular", 500), "distortion_model equirectangular, expected one of"),
    "n.yaml": (ROS.format("plumb_bob", "nan"), "camera_matrix.data is 'nan'"),
    "o.yaml": (
        "cam0:\n  camera_model: ds\n  intrinsics: [1]\n",
        "cam0.camera_model ds-none, expected one of",
    ),
    "p.yaml": ("cam0: hello\n", "cam0 is 'hello', needed keys and values"),
    "a.cameramodel": (MRCAL.format("LENSMODEL_CAHVOR", 1, 2), "lensmodel LENSMODEL_CAHVOR, expected one of"),
    "b.cameramodel": (MRCAL.format("LENSMODEL_PINHOLE", "1, 2", "3, 4"), "intrinsics: 2 numbers, needed 4"),
    "c.cameramodel": (
        "{ 'lensmodel': open('/etc/passwd') }",
        "not a camera model of mrcal (no Python literal)",
    ),
    "f.cameramodel": (
        MRCAL.format("LENSMODEL_PINHOLE", "1, " * 200_000, "3, 4"),
        "characters besides the optimization inputs, a camera model of mrcal has at most",
    ),
    "d.cameramodel": (MRCAL.format("LENSMODEL_PINHOLE", "1e400, 2, 3, 4", "3, 4"), "intrinsics is 'inf'"),
    "e.cameramodel": ("[" * 5000, "not a camera model of mrcal"),
    "a.json": (
        '{"fl_x": 1, "w": 640, "h": 480, "camera_model": "X"}',
        "camera_model X, expected one of OPENCV",
    ),
    "b.json": ('{"camera_angle_x": 1, "frames": []}', "no camera is stated"),
    "c.json": ('{"fl_x": NaN, "w": 640, "h": 480}', "fl_x is 'NaN'"),
    "d.json": ('{"fl_x": 1, "w": 640', ", line 1: not a transforms.json"),
    "e.json": (
        '{"lens": 50, "sensor_width": 0, "resolution_x": 6, "resolution_y": 4}',
        "they must be positive",
    ),
    "a.xml": ("<calibration><width>6</width></calibration>", "<calibration> without <height>"),
    "b.xml": ("<calibration><width>6</width><height>4</height></calibration>", "must be positive"),
    "c.xml": ("<calibration><projection>fisheye</projection></calibration>", "only frame cameras"),
    "d.xml": (
        "<calibration><width>6</width><height>4</height><f>5</f><p3>0</p3><p4>2.5</p4></calibration>",
        "p4 = 2.5, which no model has",
    ),
    "q.yaml": (GOOD + "fisheye: perhaps\n", "fisheye is 'perhaps', needed true or false"),
    "r.yaml": (CHAIN.format(-1, 1), "cam1.T_cn_cnm1 is no rotation and translation"),
    "s.yaml": (CHAIN.format(1, 2), "cam1.T_cn_cnm1 is no rotation and translation"),
    "f.json": (
        json.dumps({"h": 4, "frames": [{}, {"fl_x": 5, "w": 6}, {"fl_x": 5, "w": 0.5}]}),
        "frames[2].w is 0.5 px",
    ),
    "cameras.txt": ("1 PINHOLE 640 480 500 500 320\n", "3 parameters, model PINHOLE has 4"),
    "cameras.bin": ("x", "the file ends here"),
    "a.txt": ("Australis\nResults for Camera 1 X\nC 8 0 8 1 1 (mm)\n", "sensor size and pixel size"),
    "b.txt": ("Australis\nResults for Camera 1 X\nH 6 nan\n", "'nan' is not a number"),
    "c.txt": ("Australis\n", "no results for a camera are in this file"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_camera_is_told_in_one_line(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(BAD[name][0])
    with pytest.raises(SurveyFileError) as refused:
        read_cameras(path)
    message = str(refused.value)
    assert BAD[name][1] in message and "\n" not in message and message.startswith(str(path))


def test_what_is_not_there_or_leads_elsewhere_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SurveyFileError, match="No such file"):
        read_cameras(tmp_path / "absent.yaml")
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "secret.yaml").write_text(GOOD)
    (tmp_path / "given").mkdir()
    link = tmp_path / "given" / "a.yaml"
    link.symlink_to(tmp_path / "home" / "secret.yaml")
    with pytest.raises(SurveyFileError, match="a link that leaves its folder"):
        read_cameras(link)
    (tmp_path / "loop.yaml").symlink_to(tmp_path / "loop.yaml")
    with pytest.raises(SurveyFileError, match=r"loop\.yaml: cannot be read"):
        read_cameras(tmp_path / "loop.yaml")
    with pytest.raises(SurveyFileError, match="camera format 'x', expected one of"):
        camera_format("x")


def test_what_a_format_cannot_store_is_not_written(tmp_path: Path) -> None:
    two = file_of(LENSES["opencv"], replace(LENSES["opencv"], name="right"))
    bad = LENSES["opencv"].with_parameters(np.full(8, np.nan))
    cases: tuple[tuple[str, CameraFile, str], ...] = (
        ("opencv-camera", two, "has one camera, not 2"),
        ("opencv-camera", file_of(LENSES["fov"]), "not fov with all its parameters"),
        ("metashape-camera", file_of(LENSES["rational"]), "not full_opencv with all its parameters"),
        ("mrcal-camera", file_of(LENSES["eucm"]), "not eucm with all"),
        ("ros-camera", file_of(bad), "not finite"),
    )
    for name, file, told in cases:
        with pytest.raises(OutputError, match=told):
            write_cameras(tmp_path / "a.yaml", name, file)
        assert not list(tmp_path.iterdir())
    write_cameras(tmp_path / "a.yaml", "ros-camera", file_of(LENSES["opencv"]))
    with pytest.raises(OutputError, match="exists already"):
        write_cameras(tmp_path / "a.yaml", "ros-camera", file_of(LENSES["opencv"]))


def converted(run: Callable[[], None], capsys: pytest.CaptureFixture[str]) -> str:
    run()
    return capsys.readouterr().out


def test_convert_goes_from_file_to_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exactly where both have the model, with its misfit where not, and not at all beyond the limit."""
    source = tmp_path / "a.cameramodel"
    write_cameras(source, "mrcal-camera", file_of(LENSES["rational"]))
    told = converted(lambda: convert(source, tmp_path / "a.yaml", to_format="ros-camera"), capsys)
    assert told == f"{tmp_path / 'a.yaml'}: 1 camera as ros-camera\n"
    told = converted(lambda: convert(source, tmp_path / "a.xml", to_format="metashape-camera"), capsys)
    assert "full_opencv to brown_forward_affine, curve fitted, misfit 0.0" in told
    convert(source, tmp_path / "b.cameramodel")
    assert read_cameras(tmp_path / "b.cameramodel").cameras[0].model == "full_opencv"
    with pytest.raises(
        OutputError, match=r"model opencv differs .* more than 0\.05 px; --inexact .* undistort"
    ):
        convert(source, tmp_path / "a.json", to_format="blender-camera")
    assert not (tmp_path / "a.json").exists()
    convert(source, tmp_path / "a.json", to_format="blender-camera", inexact=True)
    assert read_cameras(tmp_path / "a.json").cameras[0].model == "pinhole"
    skewed = camera("brown_forward_affine", ("b2", 1e-3))
    write_cameras(tmp_path / "skew.xml", "metashape-camera", file_of(skewed))
    with pytest.raises(OutputError, match="model brown_forward_affine without b2 differs from"):
        convert(tmp_path / "skew.xml", tmp_path / "c.json", to_format="nerfstudio-camera")
    with pytest.raises(KolinearError, match="a file of cameras, without a survey"):
        convert(source, tmp_path / "folder")


def test_mounts_that_are_not_written_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, truth = make_rig(seed_of("mounts that are told"), moments=4, points=15)
    lenses = tuple(replace(LENSES["opencv"], name=name) for name in ("left", "right"))
    source, pair = tmp_path / "chain.yaml", tmp_path / "pair.yaml"
    write_cameras(source, "kalibr-camera", file_of(*lenses, mounts=truth.mounts, unit="m"))
    told = converted(lambda: convert(source, tmp_path / "each", to_format="mrcal-camera"), capsys)
    assert told.startswith("mrcal-camera does not store how these cameras are mounted, as kalibr-camera does")
    told = converted(lambda: convert(source, pair, to_format="opencv-camera"), capsys)
    assert told == f"{pair}: 2 cameras as opencv-camera\n"
    told = converted(lambda: convert(pair, tmp_path / "again.yaml", to_format="kalibr-camera"), capsys)
    assert told.startswith("translations are in unknown units, which Kalibr takes for metres\n")
    told = converted(
        lambda: convert(source, tmp_path / "one.yaml", to_format="ros-camera", camera="cam0"), capsys
    )
    assert told == f"{tmp_path / 'one.yaml'}: 1 camera as ros-camera\n"
