"""Poses and cameras of nerfstudio and instant-ngp (transforms.json).

    frames              photographs: file_path, transform_matrix (4 x 4), and their camera where it differs
    applied_transform   (3 x 4, may be missing) transformed the object before the poses were written
    applied_scale       scaled it after that

A transform_matrix takes camera axes (x right, y up, looking along -z, as Kolinear's) into the object.
Coordinates are those before the applied transformation. The file has neither points nor image points.

Source: nerfstudio documentation, "Data conventions"; instant-ngp, scripts/colmap2nerf.py.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from adapters.formats.cameras.lens_terms import is_rotation
from adapters.formats.cameras.nerfstudio import OF_CAMERA, WHAT, camera_of, keys_of
from adapters.formats.content import Content, select_placed
from adapters.formats.stated_model import StatedModel, content_of
from adapters.reading.trees import Tree, read_tree
from sfm.files.whole_files import whole_file
from sfm.model.errors import OutputError
from sfm.model.similarity import Similarity


def read_nerfstudio_poses(path: Path) -> Content:
    """Read the photographs of a file with their poses; frames with the same camera share it.

    Raises:
        SurveyFileError: with the file and its key.
    """
    tree = read_tree(path, WHAT)
    stated = StatedModel(path)
    object_from_file = _object_from_file(tree, stated)
    common = {name: tree.values[name] for name in OF_CAMERA if tree.key(name)}
    cameras: dict[tuple[str, ...], int] = {}
    for frame in tree.items("frames"):
        entry = Tree(
            path, {**frame.values, **common}, frame.place
        )  # what the file states is so of every frame
        key = tuple(str(entry.values.get(name)) for name in OF_CAMERA)
        if key not in cameras:
            cameras[key] = len(cameras)
            name = path.stem if tree.key("fl_x", "camera_angle_x") else f"camera {len(cameras)}"
            stated.cameras.append(camera_of(entry, name))
        name = frame.text("file_path").removeprefix("./")
        if frame.key("transform_matrix") is None:
            stated.add_image(name, cameras[key])
            continue
        T = frame.numbers(("transform_matrix",), 12, 16).reshape(-1, 4)
        position = object_from_file.apply(T[:3, 3])
        stated.add_image(name, cameras[key], position, object_from_file.rotation @ T[:3, :3])
    if not stated.images:
        stated.cameras.append(camera_of(tree, path.stem))
    return content_of(stated)


def write_nerfstudio_poses(path: Path, content: Content) -> None:
    """Write the photographs that have an orientation, and their cameras.

    Raises:
        OutputError: several cameras without photographs, fisheye lenses beside others, or the file cannot be
            written.
    """
    result = select_placed(content).result
    network, estimate = result.network, result.estimate
    used = sorted(set(network.camera.tolist())) or list(range(len(estimate.cameras)))
    keys = {a: keys_of(estimate.cameras[a]) for a in used}
    kinds = {str(keys[a]["camera_model"]) for a in used}
    if not network.images and len(used) > 1:
        raise OutputError(
            f"{path}: a file of format nerfstudio without photographs has one camera, not {len(used)}"
        )
    if len(kinds) > 1:
        raise OutputError(
            f"{path}: a file of format nerfstudio has one camera_model, the cameras are "
            f"{' and '.join(sorted(kinds))}"
        )
    shared = len(used) == 1
    file: dict[str, Any] = keys[used[0]] if shared else {"camera_model": kinds.pop()}
    frames = []
    T = np.tile(np.eye(4), (len(network.images), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = estimate.rotation, estimate.position
    for name, a, matrix in zip(network.images, network.camera.tolist(), T.tolist(), strict=True):
        of_frame = {} if shared else {k: value for k, value in keys[a].items() if k != "camera_model"}
        frames.append({"file_path": name, "transform_matrix": matrix} | of_frame)
    with whole_file(path) as part:
        text = json.dumps(file | {"frames": frames}, indent=1, allow_nan=False, ensure_ascii=False)
        part.write_text(text + "\n", encoding="utf-8")


def _object_from_file(tree: Tree, stated: StatedModel) -> Similarity:
    """Return the inverse of the applied transformation.

    Raises:
        SurveyFileError: it is no rotation and translation, or its scale is not positive.
    """
    A = np.eye(4)[:3]
    if tree.key("applied_transform"):
        A = tree.numbers(("applied_transform",), 12, 16).reshape(-1, 4)[:3]
    scale = tree.number("applied_scale") if tree.key("applied_scale") else 1.0
    if not (is_rotation(A[:, :3]) and scale > 0):
        raise tree.error("applied_transform is no rotation and translation, or applied_scale not more than 0")
    if tree.key("applied_transform", "applied_scale"):
        stated.notes.append("coordinates are those before applied_transform and applied_scale")
    return Similarity(1 / scale, A[:, :3].T, -A[:, :3].T @ A[:, 3])
