"""Cameras of OpenCV, as cv2.FileStorage reads and writes YAML and JSON.

    width, height, K, D [, rms, fisheye]        one camera, as written here
    image_width, image_height, camera_matrix, distortion_coefficients [, avg_reprojection_error]
                                                one camera, as OpenCV's calibration sample writes it
    width, height, K1, D1, K2, D2, R, T, ...    two cameras, x2 = R x1 + T; R1, R2, P1, P2, Q if rectified

Matrices are mappings of rows, cols, dt and data. Files of one or two cameras with other programs' spellings
of these names (cameraMatrix, dist_coeffs, M1, ...) are read too.

Source: OpenCV 4 documentation, "XML/YAML/JSON file storages", "stereoCalibrate" and "stereoRectify"; its
samples calibration.cpp and stereo_calib.cpp.
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
    is_rotation,
    matrix_of,
    mounts_of,
    numbers_text,
)
from adapters.reading.trees import Tree, read_tree
from sfm.model.camera import Camera
from sfm.model.camera_file import CameraFile
from sfm.model.conventions import FloatArray, skew
from sfm.model.rectification import Rectification, rectify

WHAT = "a file of an OpenCV camera"
WIDTH, HEIGHT = (
    ("width", "image_width", "imageWidth", "image_Width"),
    (*("height", "image_height", "imageHeight", "image_Height"),),
)
SIZE = ("image_size", "imageSize", "size", "resolution")
MATRIX = ("K", "camera_matrix", "cameraMatrix", "Camera_Matrix", "M", "mtx", "intrinsic_matrix")
COEFFICIENTS = (
    *("D", "distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients"),
    *("distortion", "dist", "dist_coeff"),
)
Entry = FloatArray | float | int | str
RMS = ("rms", "avg_reprojection_error", "reprojection_error", "error", "RMS")
MATRICES = tuple((f"{name}1", f"{name}2") for name in ("K", "M", "camera_matrix_", "cameraMatrix"))


def read_opencv(path: Path) -> CameraFile:
    """Read one or two cameras; a pixel is 1 mm, as the files do not state its size.

    Raises:
        SurveyFileError: no camera, without the size of its photographs, or not a model that is read.
    """
    tree = read_tree(path, WHAT)
    if tree.key(*WIDTH):
        size = tree.sides(WIDTH, HEIGHT)
    elif tree.key(*SIZE):
        width, height = tree.numbers(SIZE, 2)
        size = tree.side("width", width), tree.side("height", height)
    else:  # as in OpenCV's own files of a pair
        raise tree.error(
            "the size of the photographs is missing, which a camera needs; add width and height to the file"
        )
    pair = next((names for names in MATRICES if tree.key(names[0]) and tree.key(names[1])), None)
    rms = (tree.number(*RMS),) if tree.key(*RMS) else ()
    fisheye = tree.truth("fisheye", "fisheye_model")
    if pair is None:
        name = tree.text("camera", tree.text("camera_name", path.stem))
        camera = _camera(tree, name, size, MATRIX, COEFFICIENTS, fisheye)
        return CameraFile(path.name, (camera,), (None,), rms_px=rms)
    cameras = tuple(
        _camera(
            tree,
            tree.text(f"camera{k}", f"camera {k}"),
            size,
            (name,),
            (f"D{k}", f"dist_coeffs_{k}", f"distCoeffs{k}", f"distortion_coefficients_{k}"),
            fisheye,
        )
        for k, name in enumerate(pair, 1)
    )
    mounts = None
    if tree.key("R") and tree.key("T"):
        R, T = tree.numbers(("R",), 9).reshape(3, 3), tree.numbers(("T",), 3)
        if not is_rotation(R):
            raise tree.error("R is no rotation")
        mounts = mounts_of([(np.eye(3), np.zeros(3)), (R, T)])
    return CameraFile(path.name, cameras, (None, None), mounts)


def _camera(
    tree: Tree,
    name: str,
    size: tuple[int, int],
    matrix: tuple[str, ...],
    coefficients: tuple[str, ...],
    fisheye: bool,
) -> Camera:
    K = tree.numbers(matrix, 9)
    D = tree.numbers(coefficients, *COUNTS) if tree.key(*coefficients) else np.zeros(0)
    return camera_of_matrix(f"{tree.path}", name, size, K, D, fisheye=fisheye)


def write_opencv(path: Path, file: CameraFile) -> str:
    """Return the text of a file with one camera or a pair, as YAML or, where the path ends in .json, as JSON.

    Args:
        path: the file to be written.
        file: cameras in models of OpenCV; two only if `is_pair`.
    """
    remarks: tuple[str, ...] = ()
    if len(file.cameras) == 2 and file.mounts is not None:
        first, second = (
            Mounted.of(file.cameras[k], file.mounts, k) for k in next(iter(file.mounts.by_rig().values()))
        )
        rectified = rectify(first.camera, second.camera, second.R, second.T)
        content, remarks = _pair_content(first, second, file.unit, rectified)
    else:
        camera = file.cameras[0]
        content = {"camera": camera.name, "width": camera.size_px[0], "height": camera.size_px[1]}
        content |= {"fisheye": int(camera.model == "opencv_fisheye")}
        content |= {"K": matrix_of(camera), "D": np.array([coefficients_of(camera)])}
        content |= {"rms": file.rms_px[0]} if file.rms_px else {}
    if path.suffix.lower() == ".json":
        values: dict[str, object] = dict(content)
        for name, M in content.items():
            if isinstance(M, np.ndarray):
                shape, data = dict(zip(("rows", "cols"), M.shape, strict=True)), M.ravel().tolist()
                values[name] = {"type_id": "opencv-matrix", **shape, "dt": "d", "data": data}
        return json.dumps(values, indent=1, allow_nan=False) + "\n"
    return "\n".join(_yaml_lines(content, remarks)) + "\n"


def is_pair(file: CameraFile) -> bool:
    """Return whether cameras are a stereo pair that one file of OpenCV holds, which has one size."""
    mounts = file.mounts
    fisheye = any(camera.model == "opencv_fisheye" for camera in file.cameras)
    return (
        mounts is not None
        and len(file.cameras) == 2
        and not fisheye
        and file.cameras[0].size_px == file.cameras[1].size_px
        and [*map(len, mounts.by_rig().values())] == [2]
    )


def pair_lines(
    first: Mounted, mounted: Mounted, unit: str, *, rectified: Rectification | None = None
) -> Iterator[str]:
    """Yield the lines of two cameras with their rectification.

    Args:
        first: the reference camera, in model opencv.
        mounted: the second camera.
        unit: unit of lengths; empty if it is not known.
        rectified: the rectification that gave them, if they are rectified; otherwise theirs is computed.
    """
    rectified = rectified or rectify(first.camera, mounted.camera, mounted.R, mounted.T)
    content, remarks = _pair_content(first, mounted, unit, rectified)
    yield from _yaml_lines(content, remarks)


def _pair_content(
    first: Mounted, mounted: Mounted, unit: str, rectified: Rectification | None
) -> tuple[dict[str, Entry], tuple[str, ...]]:
    """Return the entries of a pair of cameras, and what is to be remarked."""
    R, T, second = mounted.R, mounted.T, mounted.camera
    K1, K2 = matrix_of(first.camera), matrix_of(second)
    E = skew(T) @ R
    F = np.linalg.inv(K2).T @ E @ np.linalg.inv(K1)
    content: dict[str, Entry] = {"camera1": first.camera.name, "camera2": second.name}
    content |= {"width": first.camera.size_px[0], "height": first.camera.size_px[1]}
    content |= {"K1": K1, "D1": np.array([coefficients_of(first.camera)])}
    content |= {"K2": K2, "D2": np.array([coefficients_of(second)])}
    content |= {"R": R, "T": T[:, None], "E": E, "F": F / (F[2, 2] or 1.0)}
    remarks = (f"T is in {unit or 'unknown units'}: x2 = R x1 + T",)
    if rectified is None:
        apart = "no rectification: the viewing directions differ too much for a common image plane"
        return content, (*remarks, apart)
    return content | rectified._asdict(), remarks


def _yaml_lines(content: dict[str, Entry], remarks: tuple[str, ...]) -> Iterator[str]:
    yield from ("%YAML:1.0", "---", *(f"# {remark}" for remark in remarks))
    for name, value in content.items():
        if isinstance(value, np.ndarray):
            yield f"{name}: !!opencv-matrix"
            yield from (f"   rows: {value.shape[0]}", f"   cols: {value.shape[1]}", "   dt: d")
            yield f"   data: [ {numbers_text(value)} ]"
        elif isinstance(value, float):
            yield f"{name}: {numbers_text([value])}"
        else:
            yield f"{name}: {json.dumps(value, ensure_ascii=False)}"
