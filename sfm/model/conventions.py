"""Frames, units and rotations of the project, stated once and used everywhere.

Pixel frame
    (0, 0) is the centre of the top-left pixel, x = column to the right, y = row down, unit px.
    (COLMAP counts from the corner of that pixel; only adapters/colmap adds the half pixel.)
Image frame
    mm, origin at the centre of the sensor, x right, y up; the camera looks along -z.
Object frame
    right-handed, in the object unit that the survey declares.
Rotation
    R = Rx(omega) Ry(phi) Rz(kappa) turns image axes into object axes; M = R^T is the inverse.
    (U, V, W) = M (X - X0); tangents u = -U/W, v = -V/W; ideal image point x = c u, y = c v.
Angles are radians inside and degrees in files and reports. A `sigma` is one standard deviation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

METRIC = (("km", 1e3), ("m", 1.0), ("mm", 1e-3), ("µm", 1e-6))
"""metric units and their lengths in metres, largest first"""
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
AnyArray = NDArray[Any]
METRES = {
    "km": 1e3,
    "m": 1.0,
    "dm": 0.1,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "µm": 1e-6,
    "nm": 1e-9,
    "in": 0.0254,
    "ft": 0.3048,
}
"""units and their lengths in metres"""
VISION_AXES = np.diag([1.0, -1.0, -1.0])
"""image axes in the camera axes of computer vision, x right, y down, z forward, and these in image axes"""
MAD_TO_SIGMA = 1.4826
"""ratio of the standard deviation of a normal variable to its median absolute deviation; Hampel (1974), JASA
69"""


def rotation_from_angles(omega: float, phi: float, kappa: float) -> FloatArray:
    """Return R = Rx(omega) Ry(phi) Rz(kappa), which turns image axes into object axes.

    Args:
        omega: rotation about x, rad.
        phi: rotation about y', rad.
        kappa: rotation about z'', rad.

    Returns:
        Rotation matrix, shape (3, 3).

    Source: Kraus, Photogrammetry (2007), sec. 2.1.2; Mikhail, Bethel, McGlone (2001), app. E (there
    M = R^T).
    """
    so, co = np.sin(omega), np.cos(omega)
    sp, cp = np.sin(phi), np.cos(phi)
    sk, ck = np.sin(kappa), np.cos(kappa)
    return np.array(
        [
            [cp * ck, -cp * sk, sp],
            [co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp],
            [so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp],
        ]
    )


def angles_from_rotation(rotation: FloatArray) -> FloatArray:
    """Return (omega, phi, kappa) in rad of R = Rx(omega) Ry(phi) Rz(kappa).

    Args:
        rotation: R, image to object axes, shape (..., 3, 3).

    Returns:
        Angles, shape (..., 3). At phi = +-90 deg omega and kappa are not separable, and omega is 0.

    Source: as for `rotation_from_angles`.
    """
    R = np.asarray(rotation, dtype=float)
    sin_phi = np.clip(R[..., 0, 2], -1.0, 1.0)
    singular = np.abs(sin_phi) > 1 - 1e-14
    omega = np.where(singular, 0.0, np.arctan2(-R[..., 1, 2], R[..., 2, 2]))
    kappa = np.where(
        singular,
        np.arctan2(R[..., 1, 0], R[..., 1, 1]),
        np.arctan2(-R[..., 0, 1], R[..., 0, 0]),
    )
    phi = np.arctan2(sin_phi, np.hypot(R[..., 0, 0], R[..., 0, 1]))
    return np.stack([omega, phi, kappa], axis=-1)


def image_from_pixel(xy_px: FloatArray, size_px: tuple[int, int], pixel_mm: FloatArray) -> FloatArray:
    """Convert pixel coordinates to image-frame coordinates (mm, y up, origin at the sensor centre).

    Args:
        xy_px: pixel coordinates, shape (..., 2), px.
        size_px: width and height of the photograph, px.
        pixel_mm: width and height of a pixel, shape (2,), mm.

    Returns:
        Image coordinates, shape (..., 2), mm.
    """
    centre = (np.asarray(size_px, dtype=float) - 1) / 2
    return (np.asarray(xy_px, dtype=float) - centre) * np.asarray(pixel_mm) * (1.0, -1.0)


def pixel_from_longer_side(xy: FloatArray, size_px: FloatArray) -> FloatArray:
    """Return pixel coordinates of positions from the middle of a photograph, in parts of its longer side.

    Args:
        xy: positions, x right and y down, (k, 2).
        size_px: width and height of the photograph of each, px, (k, 2).

    Source: documentation of OpenSfM, "Normalized image coordinates".
    """
    return np.asarray(xy * size_px.max(axis=1, keepdims=True) + (size_px - 1) / 2)


def pixel_from_image(xy_mm: FloatArray, size_px: tuple[int, int], pixel_mm: FloatArray) -> FloatArray:
    """Convert image-frame coordinates to pixel coordinates; the inverse of `image_from_pixel`.

    Args:
        xy_mm: image coordinates, shape (..., 2), mm.
        size_px: width and height of the photograph, px.
        pixel_mm: width and height of a pixel, shape (2,), mm.

    Returns:
        Pixel coordinates, shape (..., 2), px.
    """
    centre = (np.asarray(size_px, dtype=float) - 1) / 2
    return np.asarray(xy_mm, dtype=float) / (np.asarray(pixel_mm) * (1.0, -1.0)) + centre


def rotation_from_vector(vector: FloatArray) -> FloatArray:
    """Return exp([vector]x), the rotation by |vector| rad about the direction of the vector.

    Args:
        vector: rotation vectors, shape (..., 3), rad.

    Returns:
        Rotation matrices, shape (..., 3, 3).

    Source: Rodrigues' formula, written with sin(t)/t and (1 - cos t)/t^2 so that it is exact at 0.
    """
    w = np.asarray(vector, dtype=float)
    t2 = np.sum(w * w, axis=-1)[..., None, None]
    t = np.sqrt(t2)
    small = t < 1e-4
    safe = np.where(small, 1.0, t)
    a = np.where(small, 1 - t2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - t2 / 24, (1 - np.cos(safe)) / safe**2)
    W = skew(w)
    return np.asarray(np.eye(3) + a * W + b * (W @ W))


def skew(vector: FloatArray) -> FloatArray:
    """Return [vector]x, the matrix of the cross product with the vector on the left, shape (..., 3, 3)."""
    w = np.asarray(vector, dtype=float)
    W = np.zeros((*w.shape[:-1], 3, 3))
    W[..., 2, 1], W[..., 0, 2], W[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    W[..., 1, 2], W[..., 2, 0], W[..., 0, 1] = -w[..., 0], -w[..., 1], -w[..., 2]
    return W


SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
IMPERIAL = ("in", "ft")
UNITS = {
    **{10.0: ("mm", "cm"), 100.0: ("cm", "m"), 1e3: ("mm", "m"), 1e6: ("um", "m")},
    **{25.4: ("mm", "inch"), 2.54: ("cm", "inch"), 1 / 0.0254: ("inch", "m"), 12.0: ("inch", "foot")},
    **{304.8: ("mm", "foot"), 30.48: ("cm", "foot"), 1 / 0.3048: ("foot", "m")},
}
"""factors of lengths, with the finer and the coarser unit of each"""
POWERS_OF_TEN = (10.0, 100.0, 1e3, 1e6)
SAME_POWER = 0.02  # relative: a wrong scale this close to a power of ten is not there by chance
SWELLING = 0.002  # relative: printed paper swells by 1 to 2 permille


@dataclass(frozen=True)
class UnitFactor:
    """The factor between two units of length."""

    factor: float  # a key of UNITS, or its reciprocal
    units: tuple[str, str]  # the finer and the coarser unit


def finer_unit(unit: str, value: float) -> tuple[float, str]:
    """Return a factor for lengths of about this size, and the unit in which the multiplied lengths read well.

    Args:
        unit: object unit of the survey. Lengths in feet and inches stay as they are. A unit of unknown
            length, as in a network without scale, is divided into thousandths, millionths and so on.
        value: largest of the lengths, in that unit.
    """
    metres = METRES.get(unit)
    if not unit or unit in IMPERIAL or not math.isfinite(value) or value <= 0:
        return 1.0, unit
    if metres is None:
        power = min(0, 3 * math.floor(math.log10(value) / 3))
        return (10.0**-power, f"× 10{str(power).translate(SUPERSCRIPTS)} {unit}") if power else (1.0, unit)
    name, size = next(((n, s) for n, s in METRIC if value * metres >= s), METRIC[-1])
    return metres / size, name


def find_unit(lengths: float, rest: float) -> UnitFactor | None:
    """Return the factor between two units that a factor of lengths equals; None if there is none.

    Args:
        lengths: factor of lengths.
        rest: largest relative difference from the factor between two units; for a power of ten at least
            SAME_POWER is allowed.
    """
    fitting: list[tuple[float, UnitFactor]] = []
    for size, units in UNITS.items():
        most = max(rest, SAME_POWER) if size in POWERS_OF_TEN else rest
        for factor in (size, 1 / size):
            off = abs(lengths / factor - 1)
            if off < most:
                fitting.append((off, UnitFactor(factor, units)))
    return min(fitting, key=lambda candidate: candidate[0])[1] if fitting else None
