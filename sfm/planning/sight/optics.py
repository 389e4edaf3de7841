"""Depth of field of a lens.

Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 3.1.1.3; with the hyperfocal distance
H = f^2 / (N c) + f, near s (H - f) / (H + s - 2 f) and far s (H - f) / (H - s).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sfm.arguments import checked_arguments
from sfm.errors import GeometryError


@dataclass(frozen=True)
class Lens:
    """A lens with its setting; lengths in mm."""

    f_number: float  # focal length over the diameter of the aperture
    focus_mm: float  # distance of the plane in focus from the projection centre
    confusion_mm: float  # diameter of the circle of confusion that still counts as sharp


@dataclass(frozen=True)
class DepthOfField:
    """Distances along the optical axis between which points are sharp."""

    near: float
    far: float  # infinite beyond the hyperfocal distance
    focus: float  # distance in focus


@checked_arguments()
def depth_of_field(lens: Lens, f_mm: float) -> DepthOfField:
    """Return between which distances a lens is sharp, mm.

    Args:
        lens: the lens and its setting.
        f_mm: focal length.

    Raises:
        GeometryError: a number that is not positive, or a focus within the focal length.

    Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 3.1.1.3.
    """
    for name, value in (
        ("f-number", lens.f_number),
        ("focus distance", lens.focus_mm),
        ("circle of confusion", lens.confusion_mm),
        ("focal length", f_mm),
    ):
        if not (math.isfinite(value) and value > 0):
            raise GeometryError(f"depth of field: {name} is {value:g}, needed more than 0")
    s = lens.focus_mm
    if s <= f_mm:
        raise GeometryError(
            f"depth of field: focus at {s:g} mm, needed farther than the focal length {f_mm:g} mm"
        )
    H = f_mm**2 / (lens.f_number * lens.confusion_mm) + f_mm
    return DepthOfField(
        s * (H - f_mm) / (H + s - 2 * f_mm), s * (H - f_mm) / (H - s) if s < H else math.inf, s
    )


def best_focus(near: float, far: float) -> float:
    """Return the focus distance that is as sharp at the nearest as at the farthest point: 2 n f / (n + f)."""
    return 2 * near * far / (near + far)
