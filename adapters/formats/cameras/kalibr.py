"""Camera chains of Kalibr (camchain): cameras cam0, cam1, ..., each mounted relative to the one before.

    camera_model        pinhole: fu fv pu pv; eucm: alpha beta fu fv pu pv
    distortion_model    radtan: k1 k2 p1 p2; equidistant: k1 k2 k3 k4; fov: w; none
    resolution, T_cn_cnm1 (4 x 4, metres), cam_overlaps, rostopic

The double sphere (ds) and unified (omni) models have no equal here and are refused.

Source: Kalibr wiki, "YAML formats" and "Supported models".
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from adapters.formats.cameras.lens_terms import (
    Mounted,
    alone,
    camera_in_pixels,
    coefficients_of,
    is_rotation,
    matrix_of,
    mounts_of,
    numbers_text,
)
from adapters.reading.trees import Tree, read_tree
from sfm.model.camera import Camera
from sfm.model.camera_file import CameraFile
from sfm.model.conventions import METRES, FloatArray

WHAT = "a camera chain of Kalibr"
MAX_CAMERAS = 1000
# Kolinear's model and count of coefficients by Kalibr's camera and distortion model
MODELS = {
    ("pinhole", "radtan"): ("opencv", 4),
    ("pinhole", "equidistant"): ("opencv_fisheye", 4),
    ("pinhole", "fov"): ("fov", 1),
    ("pinhole", "none"): ("pinhole", 0),
    ("eucm", "none"): ("eucm", 0),
}
NAMES = {model: names for names, (model, _) in MODELS.items()}


def read_kalibr(path: Path) -> CameraFile:
    """Read a chain of cameras, with their mounts in the axes of the first one, in metres.

    Raises:
        SurveyFileError: no camera, or a model that is not read.
    """
    tree = read_tree(path, WHAT)
    cameras: list[Camera] = []
    poses: list[tuple[FloatArray, FloatArray]] = []
    while len(cameras) < MAX_CAMERAS and tree.key(f"cam{len(cameras)}"):
        k = len(cameras)
        cameras.append(_camera(tree.below(f"cam{k}"), f"cam{k}"))
        entry = tree.below(f"cam{k}")
        if k and entry.key("T_cn_cnm1") and len(poses) == k:
            T = entry.numbers(("T_cn_cnm1",), 16).reshape(4, 4)
            if not is_rotation(T[:3, :3]) or not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
                raise entry.error(f"{entry.place}T_cn_cnm1 is no rotation and translation")
            before_R, before_T = poses[-1]
            poses.append((T[:3, :3] @ before_R, T[:3, :3] @ before_T + T[:3, 3]))
        elif not k:
            poses.append((np.eye(3), np.zeros(3)))
    if not cameras:
        raise tree.error("no camera: cam0 is missing")
    mounts = mounts_of(poses) if len(poses) == len(cameras) > 1 else None
    return CameraFile(path.name, tuple(cameras), (None,) * len(cameras), mounts, "m" if mounts else "")


def _camera(entry: Tree, name: str) -> Camera:
    names = entry.text("camera_model"), entry.text("distortion_model", "none")
    if names not in MODELS:
        known = ", ".join(f"{camera}-{distortion}" for camera, distortion in MODELS)
        raise entry.error(f"{entry.place}camera_model {names[0]}-{names[1]}, expected one of {known}")
    model, count = MODELS[names]
    resolution = entry.numbers(("resolution",), 2)
    size = entry.side("resolution", resolution[0]), entry.side("resolution", resolution[1])
    values = entry.numbers(("intrinsics",), 6 if model == "eucm" else 4)
    if model == "eucm":
        values = values[[2, 3, 4, 5, 0, 1]]
    D = entry.numbers(("distortion_coeffs",), count) if count else np.zeros(0)
    return camera_in_pixels(f"{entry.path}: {name}", name, model, size, np.concatenate([values, D]))


def write_kalibr(path: Path, file: CameraFile) -> str:
    """Return the text of a chain in metres; cameras that are not on one rig are not connected."""
    mounts = file.mounts
    if mounts is None or len(set(mounts.rig)) > 1 or not all(mounts.rig):
        cameras = [alone(camera) for camera in file.cameras]
        return "\n".join(chain_lines(cameras, "unknown units", connected=False)) + "\n"
    metres = METRES.get(file.unit)
    cameras = [Mounted.of(camera, mounts, a).scaled(metres or 1.0) for a, camera in enumerate(file.cameras)]
    return "\n".join(chain_lines(cameras, "m" if metres else file.unit or "unknown units")) + "\n"


def chain_lines(cameras: list[Mounted], unit: str, *, connected: bool = True) -> Iterator[str]:
    """Yield the lines of a chain, each camera relative to the one before.

    Args:
        cameras: in models that Kalibr has.
        unit: unit of lengths.
        connected: whether they are mounted on one frame.
    """
    yield f"# translations are in {unit}"
    for k, mounted in enumerate(cameras):
        camera = mounted.camera
        yield f"cam{k}:  # {json.dumps(camera.name)}"
        if k and connected:
            yield "  T_cn_cnm1:"
            pose = mounted.pose @ np.linalg.inv(cameras[k - 1].pose)
            yield from (f"  - [{numbers_text(row)}]" for row in pose)
        yield f"  cam_overlaps: [{', '.join(str(o) for o in range(len(cameras)) if o != k)}]"
        kind, distortion = NAMES[camera.model]
        K = matrix_of(camera)
        plane = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        before = [camera.value(name) for name in ("alpha", "beta")] if kind == "eucm" else []
        D = [camera.value("omega")] if distortion == "fov" else []
        if distortion in ("radtan", "equidistant"):
            D = coefficients_of(camera, fewest=4)
        yield f"  camera_model: {kind}"
        yield f"  distortion_coeffs: [{numbers_text(D)}]"
        yield f"  distortion_model: {distortion}"
        yield f"  intrinsics: [{numbers_text([*before, *plane])}]"
        yield f"  resolution: [{camera.size_px[0]}, {camera.size_px[1]}]"
        yield f"  rostopic: /cam{k}/image_raw"
