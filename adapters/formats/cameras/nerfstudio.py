"""Intrinsics of nerfstudio and instant-ngp (transforms.json).

    camera_model    PINHOLE, SIMPLE_PINHOLE, OPENCV or OPENCV_FISHEYE; OPENCV if it is not stated
    fl_x, fl_y, cx, cy, w, h, k1, k2, k3, k4, p1, p2
    frames          photographs, each of which may state these for itself

Pixels count from the corner of the top-left pixel, as in COLMAP. k4 is the coefficient of r^8 of a polynomial
here, not of a denominator; with it a camera is `brown_forward_affine`, as of Metashape.

Source: nerfstudio documentation, "Data conventions"; instant-ngp, scripts/colmap2nerf.py.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from adapters.colmap.reconstruction import HALF_PIXEL
from adapters.formats.cameras.lens_terms import camera_in_pixels
from adapters.formats.cameras.metashape import CALIBRATION, camera_of_values, values_of
from adapters.reading.trees import Tree, read_tree
from sfm.model.camera import Camera
from sfm.model.camera_file import CameraFile

WHAT = "a transforms.json of nerfstudio"
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV_FISHEYE")
NUMBERS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2")
OF_CAMERA = ("camera_model", "is_fisheye", *NUMBERS)
MAX_CAMERAS = 10_000


def read_nerfstudio(path: Path) -> CameraFile:
    """Read the camera of the file, or the different cameras of its frames; a pixel is 1 mm.

    Raises:
        SurveyFileError: no focal length, or a model that is not read.
    """
    tree = read_tree(path, WHAT)
    if _has_focal_length(tree.values):
        return CameraFile(path.name, (camera_of(tree, path.stem),), (None,))
    stated = {name: tree.values[name] for name in OF_CAMERA if tree.key(name)}
    frames = tree.values.get("frames")
    of_frames: dict[tuple[str, ...], Tree] = {}
    for k, frame in enumerate((frames if isinstance(frames, list) else [])[:MAX_CAMERAS]):
        if isinstance(frame, Mapping) and _has_focal_length({**frame, **stated}):
            # what the file states is so of every frame
            entry = Tree(path, {**frame, **stated}, f"frames[{k}].")
            of_frames.setdefault(tuple(str(entry.values.get(name)) for name in OF_CAMERA), entry)
    if not of_frames:
        raise tree.error("fl_x is missing, of the file and of its frames: no camera is stated")
    cameras = tuple(camera_of(entry, f"camera {k}") for k, entry in enumerate(of_frames.values(), 1))
    return CameraFile(path.name, cameras, (None,) * len(cameras))


def _has_focal_length(values: Mapping[str, Any]) -> bool:
    """Return whether a file or frame states it, or the angle of view of a width."""
    angle = values.get("camera_angle_x") is not None and values.get("w") is not None
    return angle or values.get("fl_x") is not None


def camera_of(entry: Tree, name: str) -> Camera:
    """Return the camera of a file or frame; a pixel is 1 mm.

    Raises:
        SurveyFileError: no focal length or size, or a model that is not read.
    """
    model = entry.text("camera_model", "OPENCV")
    fisheye = model == "OPENCV_FISHEYE" or entry.truth("is_fisheye")
    if model not in MODELS:
        raise entry.error(f"{entry.place}camera_model {model}, expected one of {', '.join(MODELS)}")
    size = entry.sides(("w",), ("h",))
    if entry.key("fl_x", "camera_angle_x") == "camera_angle_x":
        angle = entry.number("camera_angle_x")
        if not 0 < angle < np.pi:
            raise entry.error(f"{entry.place}camera_angle_x is {angle:g} rad, needed 0 to pi")
        fx = size[0] / 2 / float(np.tan(angle / 2))
    else:
        fx = entry.number("fl_x")
    fy = entry.number("fl_y") if entry.key("fl_y") else fx
    middle = {"cx": size[0] / 2, "cy": size[1] / 2}
    centre = [(entry.number(axis) if entry.key(axis) else middle[axis]) - HALF_PIXEL for axis in ("cx", "cy")]
    k = {n: entry.number(n) if entry.key(n) else 0.0 for n in ("k1", "k2", "k3", "k4", "p1", "p2")}
    plane = np.array([fx, fy, *centre])
    if fisheye or model.endswith("PINHOLE"):
        kept = np.array([k[f"k{i}"] for i in range(1, 5)]) if fisheye else np.zeros(0)
        name_of_model = "opencv_fisheye" if fisheye else "pinhole"
        return camera_in_pixels(f"{entry.path}", name, name_of_model, size, np.concatenate([plane, kept]))
    camera_in_pixels(f"{entry.path}", name, "pinhole", size, plane)  # refuses focal lengths
    p = dict.fromkeys(CALIBRATION, 0.0) | {f"k{i}": k[f"k{i}"] for i in range(1, 5)}
    p |= {"f": fy, "b1": fx - fy, "p1": k["p2"], "p2": k["p1"]}
    p |= {axis: c - (side - 1) / 2 for axis, c, side in zip(("cx", "cy"), centre, size, strict=True)}
    return camera_of_values(name, size, (1.0, 1.0), p, set())


def write_nerfstudio(path: Path, file: CameraFile) -> str:
    """Return the text of a file with one camera and no frames.

    Raises:
        OutputError: nerfstudio has no equivalent of its model.
    """
    content = keys_of(file.cameras[0])
    return json.dumps(content | {"frames": []}, indent=1, allow_nan=False) + "\n"


def keys_of(camera: Camera) -> dict[str, object]:
    """Return the keys of a camera.

    Raises:
        OutputError: nerfstudio has no equivalent of its model.
    """
    width, height = camera.size_px
    content: dict[str, object] = {"w": width, "h": height}
    if camera.model == "opencv_fisheye":
        fx, fy, cx, cy, *k = camera.parameters.tolist()
        content |= {"camera_model": "OPENCV_FISHEYE", "fl_x": fx, "fl_y": fy}
        content |= {"cx": cx + HALF_PIXEL, "cy": cy + HALF_PIXEL}
        content |= dict(zip(("k1", "k2", "k3", "k4"), k, strict=True))
    else:
        p = values_of(camera)
        content |= {"camera_model": "OPENCV", "fl_x": p["f"] + p["b1"], "fl_y": p["f"]}
        content |= {"cx": width / 2 + p["cx"], "cy": height / 2 + p["cy"]}
        content |= {name: p[name] for name in ("k1", "k2", "k3", "k4")} | {"p1": p["p2"], "p2": p["p1"]}
    return content
