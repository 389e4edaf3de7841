"""Cameras by their sensor, for plans made before one is bought or calibrated; the lens comes on top.

Source: sizes of sensors and photographs as the makers state them; Nikon D60 as in document 000, sec. 2.5.1.
"""

from __future__ import annotations

from sfm.camera import Camera, camera_from_values
from sfm.errors import GeometryError

SENSORS = {
    "full-frame-24": ((6000, 4000), (36.0, 24.0)),
    "full-frame-45": ((8192, 5464), (36.0, 24.0)),
    "full-frame-61": ((9504, 6336), (35.7, 23.8)),
    "aps-c-24": ((6000, 4000), (23.5, 15.6)),
    "four-thirds-20": ((5184, 3888), (17.3, 13.0)),
    "one-inch-20": ((5472, 3648), (13.2, 8.8)),
    "machine-vision-5": ((2448, 2048), (8.446, 7.066)),
    "machine-vision-12": ((4096, 3000), (14.131, 10.35)),
    "nikon-d60": ((3872, 2592), (23.6, 15.8)),
}
"""width and height of the photographs, px, and of the sensor, mm"""
FREE = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2")
"""what a self-calibrating adjustment usually determines"""


def listed_camera(name: str, c_mm: float | None) -> Camera:
    """Return a camera of the list with a lens without distortion, its interior orientation to be adjusted.

    Args:
        name: in SENSORS.
        c_mm: principal distance, mm.

    Raises:
        GeometryError: another name, or no principal distance.
    """
    if name not in SENSORS:
        raise GeometryError(
            f"camera '{name:.60}': expected a survey file, a result folder or one of {', '.join(SENSORS)}"
        )
    if c_mm is None:
        raise GeometryError(f"camera {name}: no focal length, needed --c-mm")
    size, sensor = SENSORS[name]
    pixel = (sensor[0] / size[0], sensor[1] / size[1])
    return camera_from_values(name, "brown", size, pixel, c_mm=c_mm, free=FREE)
