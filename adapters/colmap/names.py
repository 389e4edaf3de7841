"""kolinear.json beside a COLMAP model: what COLMAP cannot hold.

Names of cameras, photographs and points, the size of a pixel, and which parameters are free.
"""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import Field

from sfm.files.json_files import Content, Name, Pixel, Side, read_json
from sfm.network import Estimate, Network

SIDE_FILE = "kolinear.json"


class NamedCamera(Content):
    """What COLMAP does not know of a camera."""

    name: Name
    pixel_mm: tuple[Pixel, Pixel]  # width and height of a pixel, mm
    free: tuple[bool, ...]  # to be adjusted, of each parameter
    size_px: tuple[Side, Side] | None = None  # width and height of its photographs, px
    rig: Name | None = None  # what its rig is called
    mount_free: tuple[bool, bool, bool, bool, bool, bool] | None = None  # which of X, Y, Z, rotations


class Names(Content):
    """Content of kolinear.json."""

    cameras: tuple[NamedCamera, ...] = ()  # in the order of their numbers
    images: dict[str, Name] = Field(default_factory=dict)  # names by COLMAP's number of the photograph
    points: dict[str, Name] = Field(default_factory=dict)  # names by COLMAP's number of the point


def read_side_file(path: Path) -> Names:
    """Read what Kolinear adds to a model; nothing where the file is missing.

    Raises:
        SurveyFileError: what is wrong in it.
    """
    if not path.is_file():
        return Names()
    return read_json(path, Names, "the names beside a COLMAP model")


def write_side_file(path: Path, network: Network, estimate: Estimate) -> None:
    """Write what COLMAP cannot hold."""
    mounts = estimate.mounts
    side = {
        "cameras": [
            {
                "name": camera.name,
                "size_px": [int(side) for side in camera.size_px],
                "pixel_mm": [float(side) for side in camera.pixel_mm],
                "free": camera.free.tolist(),
            }
            | (
                {"rig": mounts.rig[a], "mount_free": mounts.free[a].tolist()}
                if mounts is not None and mounts.rig[a]
                else {}
            )
            for a, camera in enumerate(estimate.cameras)
        ],
        "images": {str(i + 1): name for i, name in enumerate(network.images)},
        "points": {str(j + 1): name for j, name in enumerate(network.points)},
    }
    path.write_text(json.dumps(side, ensure_ascii=False, indent=1) + "\n", encoding="utf-8")
