"""Calibrations of Agisoft Metashape (Tools > Camera Calibration, saved as XML), one camera in a file.

    calibration/projection   frame
    width, height, f, cx, cy, b1, b2, k1, k2, k3, k4, p1, p2

With x = X/Z, y = Y/Z in camera axes (x right, y down, z forward) and r2 = x2 + y2

    x' = x (1 + k1 r2 + k2 r4 + k3 r6 + k4 r8) + p1 (r2 + 2 x2) + 2 p2 x y,   y' with p1, p2 exchanged
    u = w/2 + cx + x' f + x' b1 + y' b2,   v = h/2 + cy + y' f

from the corner of the top-left pixel. This is exactly `opencv` (k3 = k4 = b2 = 0) or `full_opencv` (k4 = b2 =
0) with p1 and p2 exchanged; with k4 or b2 it is exactly `brown_forward_affine`. The p3 and p4 of versions
before 1.7 are refused unless they are 0.

Source: Agisoft Metashape Professional user manual 2.x, app. D "Camera models".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adapters.reading.xml_lines import Node, read_xml
from sfm.files.plain_text import shorten
from sfm.model.camera import Camera, camera_from_values
from sfm.model.camera_file import CameraFile
from sfm.model.distortion.models import MODELS
from sfm.model.errors import OutputError

CALIBRATION = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
OPENCV_PARAMETERS: dict[str, tuple[str, ...]] = {  # that are free where one of a calibration is
    "f": ("fx", "fy"),
    "cx": ("cx",),
    "cy": ("cy",),
    "b1": ("fx",),
    "k1": ("k1",),
    "k2": ("k2",),
    "k3": ("k3",),
    "p1": ("p2",),
    "p2": ("p1",),
}
BROWN_PARAMETERS: dict[str, tuple[str, ...]] = {
    "f": ("c",),
    "cx": ("x0",),
    "cy": ("y0",),
    "b1": ("b1",),
    "b2": ("b2",),
}
BROWN_PARAMETERS |= {name: (name.upper(),) for name in ("k1", "k2", "k3", "k4", "p1", "p2")}


WHAT = "a calibration of Metashape"


def read_metashape_camera(path: Path) -> CameraFile:
    """Read one camera in the equivalent model; a pixel is 1 mm, as the file does not state its size.

    Raises:
        SurveyFileError: not a calibration of a frame camera; with the line.
    """
    root = read_xml(path)
    if root.tag != "calibration":
        raise root.error(f"not {WHAT}: <{shorten(root.tag)}> in place of <calibration>")
    projection = root.maybe("projection")
    if projection is not None and projection.text.strip() != "frame":
        raise projection.error(f"projection {shorten(projection.text)}, only frame cameras can be read")
    width, height = (_side(root.one(side)) for side in ("width", "height"))
    if root.maybe("f") is None and root.maybe("fx") is not None:
        raise root.error("fx and fy in place of f: a calibration of PhotoScan before version 1.2 is not read")
    p, _ = calibration_values(root)
    return CameraFile(
        path.name, (camera_of_values(path.stem, (width, height), (1.0, 1.0), p, set()),), (None,)
    )


def write_metashape_camera(path: Path, file: CameraFile) -> str:
    """Return the text of a file with one camera.

    Raises:
        OutputError: Metashape has no equivalent of its model.
    """
    camera = file.cameras[0]
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<calibration>", "  <projection>frame</projection>"]
    lines += [f"  <width>{camera.size_px[0]}</width>", f"  <height>{camera.size_px[1]}</height>"]
    lines += [f"  {line}" for line in calibration_lines(values_of(camera))]
    return "\n".join([*lines, "</calibration>"]) + "\n"


def _side(node: Node) -> int:
    """Return the text of an element as the side of a photograph, px."""
    value = float(node.numbers(1)[0])
    return Node(node.path, node.line, node.tag, {node.tag: repr(value)}).side_px(node.tag)


def calibration_values(node: Node) -> tuple[dict[str, float], set[str]]:
    """Return the values of CALIBRATION of an element, and which of them it states.

    Raises:
        SurveyFileError: f or f + b1 are not positive, or p3 or p4 is not 0; with the line.
    """
    for child in node.children:
        if child.tag in ("p3", "p4") and child.numbers(1)[0] != 0:
            raise child.error(f"{child.tag} = {shorten(child.text.strip())}, which no model has: needed 0")
    stated = {child.tag: float(child.numbers(1)[0]) for child in node.children if child.tag in CALIBRATION}
    p = dict.fromkeys(CALIBRATION, 0.0) | stated
    if not (p["f"] > 0 and p["f"] + p["b1"] > 0):
        raise node.error(f"f = {p['f']:g} px, b1 = {p['b1']:g} px: f and f + b1 must be positive")
    return p, set(stated)


def camera_of_values(
    name: str, size: tuple[int, int], pixel: tuple[float, float], p: dict[str, float], stated: set[str]
) -> Camera:
    """Return the camera of a calibration in the equivalent model.

    Args:
        name: name of the camera.
        size: width and height of its photographs, px.
        pixel: width and height of a pixel, mm.
        p: values of CALIBRATION.
        stated: names of those that are free.
    """
    if p["k4"] == 0 and p["b2"] == 0:
        model = "opencv" if p["k3"] == 0 else "full_opencv"
        centre = (np.array(size) - 1) / 2
        values = {"fx": p["f"] + p["b1"], "fy": p["f"], "cx": centre[0] + p["cx"], "cy": centre[1] + p["cy"]}
        values |= {"k1": p["k1"], "k2": p["k2"], "k3": p["k3"], "p1": p["p2"], "p2": p["p1"]}
        names = OPENCV_PARAMETERS
    else:
        model, names = "brown_forward_affine", BROWN_PARAMETERS
        c = p["f"] * pixel[1]
        values = {"x0": p["cx"] * pixel[0], "y0": -p["cy"] * pixel[1]}
        values |= {"b1": (p["f"] + p["b1"]) * pixel[0] / c - 1, "b2": -p["b2"] * pixel[0] / c}
        values |= {f"K{i}": p[f"k{i}"] / c ** (2 * i) for i in (1, 2, 3, 4)}
        values |= {"P1": p["p1"] / c, "P2": -p["p2"] / c}
    freed = [name for tag in CALIBRATION if tag in stated for name in names.get(tag, ())]
    has = MODELS[model].names
    return camera_from_values(
        name,
        model,
        size,
        pixel,
        c_mm=p["f"] * pixel[1],
        free=tuple(name for name in freed if name in has),
        values=tuple((name, float(value)) for name, value in values.items() if name in has),
    )


def values_of(camera: Camera) -> dict[str, float]:
    """Return the values of CALIBRATION of a camera.

    Raises:
        OutputError: Metashape has no equivalent of its model.
    """
    centre = (np.array(camera.size_px) - 1) / 2
    p = dict.fromkeys(CALIBRATION, 0.0)
    if camera.model in ("opencv", "full_opencv"):
        if camera.model == "full_opencv" and any(camera.value(name) for name in ("k4", "k5", "k6")):
            raise OutputError(
                f"camera {camera.name}: Metashape has no k4-k6 of full_opencv, convert it to "
                "brown_forward_affine"
            )
        p |= {"f": camera.value("fy"), "b1": camera.value("fx") - camera.value("fy")}
        p |= {"cx": camera.value("cx") - centre[0], "cy": camera.value("cy") - centre[1]}
        p |= {"k1": camera.value("k1"), "k2": camera.value("k2")}
        p |= {"p1": camera.value("p2"), "p2": camera.value("p1")}
        p |= {"k3": camera.value("k3")} if camera.model == "full_opencv" else {}
    elif camera.model == "brown_forward_affine":
        c, (sx, sy) = camera.value("c"), camera.pixel_mm
        p |= {
            "f": c / sy,
            "b1": c * (1 + camera.value("b1")) / sx - c / sy,
            "b2": -c * camera.value("b2") / sx,
        }
        p |= {"cx": camera.value("x0") / sx, "cy": -camera.value("y0") / sy}
        p |= {f"k{i}": camera.value(f"K{i}") * c ** (2 * i) for i in (1, 2, 3, 4)}
        p |= {"p1": camera.value("P1") * c, "p2": -camera.value("P2") * c}
    else:
        raise OutputError(
            f"camera {camera.name}: Metashape has no model {camera.model}, convert it to brown_forward_affine"
        )
    return p


def calibration_lines(p: dict[str, float]) -> list[str]:
    """Return the elements of a calibration, f and those that are not 0."""
    return [f"<{name}>{float(value)!r}</{name}>" for name, value in p.items() if value or name == "f"]
