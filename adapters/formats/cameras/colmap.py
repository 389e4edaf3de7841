"""Cameras of COLMAP: cameras.txt or cameras.bin alone, and the rig configuration of rig_configurator.

    cameras.txt    CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], a line for each camera

Pixels count from the corner of the top-left pixel.

Source: COLMAP 4.2 documentation, "Output Format" and "Rigs and Frames".
"""

from __future__ import annotations

import re
import struct
from collections import defaultdict
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from adapters.colmap.model_files import MODELS as COLMAP_MODELS
from adapters.colmap.model_files import camera_rows
from adapters.colmap.reconstruction import COLMAP_NAMES, HALF_PIXEL, colmap_parameters
from adapters.formats.cameras.lens_terms import Mounted, camera_in_pixels
from sfm.model.camera_file import CameraFile
from sfm.model.distortion.models import MODELS, Role
from sfm.model.errors import SurveyFileError
from sfm.model.network import Network

HEADER = (
    "# Camera list with one line of data per camera:\n"
    "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    "# Number of cameras: {}\n"
)


def read_colmap(path: Path) -> CameraFile:
    """Read the cameras of cameras.txt or cameras.bin, named by their numbers; a pixel is 1 mm.

    Raises:
        SurveyFileError: damaged, no camera, or a model that is not read.
    """
    cameras = []
    for number, model, size, params in camera_rows(path):
        name = model.lower()
        if name not in COLMAP_NAMES:
            raise SurveyFileError(
                f"{path}: camera {number}: COLMAP's model {model} is not read, expected one of "
                f"{', '.join(COLMAP_NAMES.values())}"
            )
        centre = [parameter.role in (Role.X0, Role.Y0) for parameter in MODELS[name].parameters]
        values = params - HALF_PIXEL * np.array(centre)
        cameras.append(camera_in_pixels(f"{path}: camera {number}", f"{number}", name, size, values))
    if not cameras:
        raise SurveyFileError(f"{path}: no camera is in this file")
    return CameraFile(path.name, tuple(cameras), (None,) * len(cameras))


def write_colmap(path: Path, file: CameraFile) -> str | bytes:
    """Return the cameras, numbered from 1, as text, or in binary where the path ends in .bin."""
    rows = [
        (k, COLMAP_NAMES[camera.model], camera.size_px, colmap_parameters(camera))
        for k, camera in enumerate(file.cameras, 1)
    ]
    if path.suffix.lower() == ".bin":
        numbers = {name: number for number, name in enumerate(COLMAP_MODELS)}
        records = [
            struct.pack(f"<IiQQ{len(params)}d", k, numbers[model], *size, *params)
            for k, model, size, params in rows
        ]
        return struct.pack("<Q", len(rows)) + b"".join(records)
    lines = [
        f"{k} {model} {size[0]} {size[1]} {' '.join(repr(float(value)) for value in params)}\n"
        for k, model, size, params in rows
    ]
    return HEADER.format(len(rows)) + "".join(lines)


def rig_entry(cameras: list[Mounted], prefixes: list[str]) -> dict[str, list[dict[str, Any]]]:
    """Return a rig in COLMAP's configuration.

    Args:
        cameras: the cameras, the reference first.
        prefixes: start of the names of the photographs of each.
    """
    entries: list[dict[str, Any]] = []
    for k, (mounted, prefix) in enumerate(zip(cameras, prefixes, strict=True)):
        entry: dict[str, Any] = {"image_prefix": prefix}
        if k == 0:
            entry["ref_sensor"] = True
        else:
            quaternion = Rotation.from_matrix(mounted.R).as_quat(scalar_first=True)
            entry |= {
                "cam_from_rig_rotation": quaternion.tolist(),
                "cam_from_rig_translation": mounted.T.tolist(),
            }
        entry["camera_model_name"] = COLMAP_NAMES[mounted.camera.model]
        entry["camera_params"] = colmap_parameters(mounted.camera).tolist()
        entries.append(entry)
    return {"cameras": entries}


def prefixes_of(network: Network, on: list[int], names: list[str]) -> list[str]:
    """Return the start of the photograph names of each camera, before the part shared within a moment.

    If the names have no such start, the photographs are expected in folders named like the cameras.
    """
    folders = [re.sub(r"[^\w.\- ]+", "_", name) + "/" for name in names]  # names may contain glob patterns
    if network.moment is None:
        return folders
    moments: dict[int, dict[int, str]] = defaultdict(dict)
    for name, t, a in zip(network.images, network.moment.tolist(), network.camera.tolist(), strict=True):
        if a in on:
            moments[t][a] = name
    starts: dict[int, set[str]] = {a: set() for a in on}
    for together in moments.values():
        if len(together) > 1:
            backwards = [name[::-1] for name in together.values()]
            same = zip(*backwards, strict=False)
            end = "".join(c[0] for c in takewhile(lambda c: len(set(c)) == 1, same))[::-1]
            end = re.sub(r"^[^\W\d_]*[\W_]*", "", end)  # from the end of the word in which it begins
            for a, name in together.items():
                starts[a].add(name.removesuffix(end))
    if any(len(of_camera) != 1 for of_camera in starts.values()):
        return folders
    prefixes = [next(iter(starts[a])) for a in on]
    mixed = any(
        prefix.startswith(other)
        for k, prefix in enumerate(prefixes)
        for other in prefixes[:k] + prefixes[k + 1 :]
    )
    return folders if mixed else prefixes
