"""Calibration of a camera for ROS (camera_info, as camera_calibration_parsers reads it).

    image_width, image_height, camera_name, distortion_model, camera_matrix, distortion_coefficients,
    rectification_matrix, projection_matrix

Distortion models: plumb_bob (4 or 5 coefficients), rational_polynomial (8), equidistant (4, a fisheye lens).

Source: ROS REP 104 and sensor_msgs/CameraInfo; camera_calibration_parsers.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from adapters.formats.cameras.lens_terms import (
    COUNTS,
    Mounted,
    camera_of_matrix,
    coefficients_of,
    matrix_of,
    numbers_text,
)
from adapters.reading.trees import read_tree
from sfm.files.plain_text import shorten
from sfm.model.camera_file import CameraFile
from sfm.model.conventions import FloatArray
from sfm.model.rectification import rectify

WHAT = "a camera_info of ROS"
FISHEYE = ("equidistant", "fisheye")
MODELS = ("plumb_bob", "rational_polynomial", *FISHEYE, "none", "")


def read_ros(path: Path) -> CameraFile:
    """Read one camera; rectification and projection are computed from it anew where they are needed.

    Raises:
        SurveyFileError: no camera, or a model that is not read.
    """
    tree = read_tree(path, WHAT)
    model = tree.values.get("distortion_model", "plumb_bob")
    if model not in MODELS:
        raise tree.error(
            f"distortion_model {shorten(str(model))}, expected one of {', '.join(filter(None, MODELS))}"
        )
    size = tree.sides(("image_width", "width"), ("image_height", "height"))
    K = tree.numbers(("camera_matrix", "K", "k"), 9)
    names = ("distortion_coefficients", "D", "d")
    D = tree.numbers(names, *COUNTS) if tree.key(*names) and model not in ("none", "") else np.zeros(0)
    name = tree.text("camera_name") if tree.values.get("camera_name") else path.stem
    camera = camera_of_matrix(f"{path}", name, size, K, D, fisheye=model in FISHEYE)
    return CameraFile(path.name, (camera,), (None,))


def write_ros(path: Path, file: CameraFile) -> str:
    """Return the text of a file with one camera in a model of OpenCV."""
    camera = file.cameras[0]
    K = matrix_of(camera)
    return "\n".join(_lines(Mounted(camera, np.eye(3), np.zeros(3)), np.eye(3), _projection(K))) + "\n"


def rig_lines(cameras: list[Mounted], k: int, unit: str) -> Iterator[str]:
    """Yield the lines of camera k of a rig, rectified if the rig is a stereo pair."""
    R, P = np.eye(3), _projection(matrix_of(cameras[k].camera))
    pair = (
        rectify(cameras[0].camera, cameras[1].camera, cameras[1].R, cameras[1].T)
        if len(cameras) == 2
        else None
    )
    if pair is not None:
        R, P = (pair.R1, pair.P1) if k == 0 else (pair.R2, pair.P2)
    yield f"# fourth column of projection_matrix: px times {unit}"
    yield from _lines(cameras[k], R, P)


def _projection(K: FloatArray) -> FloatArray:
    return np.hstack([K, np.zeros((3, 1))])


def _lines(mounted: Mounted, R: FloatArray, P: FloatArray) -> Iterator[str]:
    camera = mounted.camera
    D = coefficients_of(camera)
    model = "equidistant" if camera.model == "opencv_fisheye" else MODELS[len(D) > 5]
    yield from (f"image_width: {camera.size_px[0]}", f"image_height: {camera.size_px[1]}")
    yield f"camera_name: {json.dumps(camera.name)}"
    yield f"distortion_model: {model}"
    for name, M in (
        ("camera_matrix", matrix_of(camera)),
        ("distortion_coefficients", np.array([D])),
        ("rectification_matrix", R),
        ("projection_matrix", P),
    ):
        yield f"{name}:"
        yield from (f"  rows: {M.shape[0]}", f"  cols: {M.shape[1]}", f"  data: [{numbers_text(M)}]")
