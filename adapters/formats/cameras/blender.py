"""A camera of Blender without distortion: the properties of camera and render in JSON.

    lens, sensor_width, sensor_height    mm
    sensor_fit, shift_x, shift_y         HORIZONTAL; in widths of the sensor, x right, y up of the picture
    resolution_x, resolution_y           px, of which resolution_percentage is rendered
    pixel_aspect_x, pixel_aspect_y       sides of a pixel, the smaller one is 1

The sensor is seen through a lens: a positive shift moves the picture to the left and down, so that cx = w/2 -
w shift_x and cy = h/2 + w shift_y, in px of square shape, from the corner of the top-left pixel.

Source: Blender 4 manual, "Cameras", and Python API, bpy.types.Camera and RenderSettings.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from adapters.colmap.reconstruction import HALF_PIXEL
from adapters.formats.cameras.lens_terms import camera_in_pixels, matrix_of
from adapters.reading.trees import read_tree
from sfm.model.camera_file import CameraFile

WHAT = "a camera of Blender"
DEFAULT_SENSOR_MM = 36.0  # Blender's; for cameras whose pixel is not known


def read_blender(path: Path) -> CameraFile:
    """Read a camera in model pinhole, with its pixel size.

    Raises:
        SurveyFileError: not a perspective camera, or a property is missing.
    """
    tree = read_tree(path, WHAT)
    if tree.text("type", "PERSP") != "PERSP":
        raise tree.error(f"type {tree.text('type')}, only perspective cameras (PERSP) can be read")
    size = tree.sides(("resolution_x",), ("resolution_y",))
    percent = tree.number("resolution_percentage") if tree.key("resolution_percentage") else 100.0
    scaled = [int(side * percent / 100) for side in size]  # rounded down, as Blender renders
    size = tree.side("resolution_x", scaled[0]), tree.side("resolution_y", scaled[1])
    aspect = [tree.number(name) if tree.key(name) else 1.0 for name in ("pixel_aspect_x", "pixel_aspect_y")]
    fit = tree.text("sensor_fit", "AUTO")
    if fit not in ("AUTO", "HORIZONTAL", "VERTICAL"):
        raise tree.error(f"sensor_fit {fit}, expected AUTO, HORIZONTAL or VERTICAL")
    lens, extent = tree.number("lens"), np.array(size) * aspect
    across = fit == "HORIZONTAL" or (fit == "AUTO" and extent[0] >= extent[1])
    sensor = tree.number("sensor_height" if fit == "VERTICAL" else "sensor_width")
    fitted = extent[0] if across else extent[1]
    if not (lens > 0 and sensor > 0 and min(aspect) > 0):
        raise tree.error(f"lens {lens:g} mm and sensor {sensor:g} mm: they must be positive")
    f = lens / sensor * fitted  # in px of aspect 1
    shift = [tree.number(name) if tree.key(name) else 0.0 for name in ("shift_x", "shift_y")]
    cx = (extent[0] / 2 - shift[0] * fitted) / aspect[0] - HALF_PIXEL
    cy = (extent[1] / 2 + shift[1] * fitted) / aspect[1] - HALF_PIXEL
    name = tree.text("name", path.stem)
    camera = camera_in_pixels(
        f"{path}", name, "pinhole", size, np.array([f / aspect[0], f / aspect[1], cx, cy])
    )
    pixel = sensor / fitted * np.array(aspect)
    return CameraFile(
        path.name,
        (type(camera)(name, "pinhole", size, pixel, camera.parameters),),
        (None,),
    )


def write_blender(path: Path, file: CameraFile) -> str:
    """Return the text of a file with one camera without distortion."""
    camera = file.cameras[0]
    width, height = camera.size_px
    K = matrix_of(camera)
    # a pixel is wider, where fewer of them fill the focal length
    aspect = np.array([1.0 / K[0, 0], 1.0 / K[1, 1]])
    aspect /= aspect.min()
    pixel = float(camera.pixel_mm[0] / aspect[0])
    extent = width * aspect[0]
    sensor = DEFAULT_SENSOR_MM if camera.pixel_mm[0] == 1.0 else extent * pixel
    content = {
        "name": camera.name,
        "type": "PERSP",
        "lens": K[0, 0] * aspect[0] / extent * sensor,
        "sensor_fit": "HORIZONTAL",
        "sensor_width": sensor,
        "sensor_height": sensor * height * aspect[1] / extent,
        "shift_x": (width / 2 - K[0, 2] - HALF_PIXEL) * aspect[0] / extent,
        "shift_y": (K[1, 2] + HALF_PIXEL - height / 2) * aspect[1] / extent,
        "resolution_x": width,
        "resolution_y": height,
        "pixel_aspect_x": aspect[0],
        "pixel_aspect_y": aspect[1],
    }
    numbers = {name: float(v) if isinstance(v, np.floating) else v for name, v in content.items()}
    return json.dumps(numbers, indent=1, allow_nan=False) + "\n"
