"""The viewer as a page embeds it: script, styles, data, pictures, and the policy that allows them.

A scene as text inside a page: names as JSON, numbers as arrays, gzip, base64.

    4 bytes     length of the header, little-endian
    header      JSON in UTF-8, filled up with spaces to a multiple of 8 bytes
    arrays      one after the other, each from a multiple of 8 bytes on

The header names them as [type, first byte, values]. Its reader is viewer/src/data.js.

Source: RFC 1952 (gzip), RFC 4648 (base64).
"""

from __future__ import annotations

import base64
import gzip
import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from markupsafe import Markup

from sfm.conventions import AnyArray, angles_from_rotation
from sfm.files.covariance_file import MAX_POINTS
from sfm.files.plain_text import or_none
from sfm.report.numbers import finer_unit
from sfm.report.viewer.pictures import COLUMNS, CROP_PX, Pictures
from sfm.report.viewer.scene import ViewerScene

ALIGNED = 8  # bytes
TYPES = {"f8": "<f8", "f4": "<f4", "u4": "<u4", "u1": "|u1"}
NO_CROP = "no picture: it is neither in this page nor beside it"
NO_FILE = "the picture lies in the folder of the report, which is not beside this page"
NO_PICTURE = "no photograph was read for this page"


@dataclass(frozen=True)
class Viewer:
    """The parts of a viewer that a page embeds."""

    script: Markup  # to the letter, since the policy allows it by its hash
    style: Markup
    data: str  # base64
    pictures: str  # base64
    notes: tuple[str, ...]  # what the page leaves out


def viewer_of(scene: ViewerScene, pictures: Pictures) -> Viewer:
    """Return the viewer of a scene."""
    script, style = sources()
    notes = (*scene.notes, *pictures.notes)
    return Viewer(Markup(script), Markup(style), packed_scene(scene, pictures), pictures.base64, notes)


@cache
def sources() -> tuple[str, str]:
    """Return script and style sheet of the viewer."""
    folder = files("sfm.report.viewer")
    script = folder.joinpath("viewer.js").read_text(encoding="utf-8")
    return script, folder.joinpath("viewer.css").read_text(encoding="utf-8")


def packed_scene(scene: ViewerScene, pictures: Pictures) -> str:
    """Return a scene as base64 text, fit for an element of a page."""
    upper = np.triu_indices(3)
    rays, marks = scene.rays, scene.marks
    arrays: dict[str, tuple[str, AnyArray]] = {
        "point.xyz": ("f8", scene.xyz),
        "point.covariance": ("f4", scene.covariance[:, upper[0], upper[1]]),
        "point.rays": ("u4", scene.rays_of_point),
        "point.angle": ("f4", scene.angle_deg),
        "point.rms": ("f4", scene.point_rms_px),
        "photo.camera": ("u4", scene.camera),
        "photo.position": ("f8", scene.position),
        "photo.rotation": ("f8", scene.rotation),
        "photo.angles": ("f8", np.degrees(angles_from_rotation(scene.rotation))),
        "photo.sigma": ("f4", scene.exterior_sigma),
        "photo.rms": ("f4", scene.photo_rms_px),
        "photo.points": ("u4", scene.points_of_photo),
        "ray.point": ("u4", rays.point),
        "ray.photo": ("u4", rays.photo),
        "ray.xy": ("f4", rays.xy),
        "ray.v": ("f4", rays.v),
        "ray.w": ("f4", rays.w),
        "ray.rejected": ("u1", rays.rejected),
        "ray.ellipse": ("f4", rays.ellipse),
        "mark.photo": ("u4", marks.photo),
        "mark.xy": ("f4", marks.xy),
        "mark.reason": ("u4", marks.reason),
        **pictures.arrays(),
    }
    if scene.distance_sigma is not None:
        arrays["pair.sigma"] = ("f4", scene.distance_sigma)
    if scene.displacement is not None:
        states = sorted(set(scene.state))
        arrays["point.displacement"] = ("f4", scene.displacement)
        arrays["point.state"] = ("u1", np.array([states.index(one) for one in scene.state]))
    if scene.deviation is not None:
        arrays["point.deviation"] = ("f4", scene.deviation)
    return _packed(_header(scene, pictures), arrays)


def _header(scene: ViewerScene, pictures: Pictures) -> dict[str, Any]:
    variance = np.trace(scene.covariance, axis1=1, axis2=2) / 3
    known = variance[variance > 0]
    factor, unit = finer_unit(scene.unit, float(np.sqrt(np.median(known))) if len(known) else np.nan)
    return {
        "name": scene.name,
        "unit": scene.unit,
        "fine": {"factor": factor, "unit": unit},
        "points": scene.points,
        "photographs": scene.photographs,
        "cameras": [
            {"name": one.name, "width": one.size_px[0], "height": one.size_px[1], "c_px": one.c_px}
            for one in scene.cameras
        ],
        "reasons": scene.marks.reasons,
        "bars": [
            {
                "from": one.start,
                "to": one.end,
                "length": or_none(one.length),
                "sigma": or_none(one.sigma),
                "difference": or_none(one.difference),
            }
            for one in scene.bars
        ],
        "control": scene.control,
        "states": sorted(set(scene.state)),
        "rms_px": scene.rms_px if np.isfinite(scene.rms_px) else 0,
        "crop_px": CROP_PX,
        "crop_columns": COLUMNS,
        "files": pictures.files,
        "crop_files": pictures.crop_files,
        "notes": {
            "page": [*scene.notes, *pictures.notes],
            "no_crop": NO_CROP if pictures.count else NO_PICTURE,
            "no_file": NO_FILE,
            "no_picture": NO_PICTURE,
            "covariance": "their correlation is not known here"
            + (f", it is kept of at most {MAX_POINTS} points." if len(scene.points) > MAX_POINTS else "."),
        },
    }


def _packed(header: dict[str, Any], arrays: dict[str, tuple[str, AnyArray]]) -> str:
    places: dict[str, tuple[str, int, int]] = {}
    parts: list[bytes] = []
    at = 0
    for name, (kind, values) in arrays.items():
        array = np.ascontiguousarray(values, dtype=TYPES[kind])
        places[name] = (kind, at, array.size)
        raw = array.tobytes()
        raw += bytes(-len(raw) % ALIGNED)
        parts.append(raw)
        at += len(raw)
    body = b"".join(parts)

    def head(start: int) -> bytes:
        moved = {name: [kind, start + first, count] for name, (kind, first, count) in places.items()}
        text = json.dumps({**header, "arrays": moved}, ensure_ascii=False, allow_nan=False).encode()
        return text + b" " * (-(4 + len(text)) % ALIGNED)

    start = 4 + len(head(0))
    while 4 + len(head(start)) != start:  # digits of the offsets may lengthen the header
        start = 4 + len(head(start))
    text = head(start)
    data = len(text).to_bytes(4, "little") + text + body
    return base64.b64encode(gzip.compress(data, compresslevel=6, mtime=0)).decode()
