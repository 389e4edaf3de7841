"""Design of a network: how large targets must be, before anything is photographed."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sfm.arguments import checked_arguments
from sfm.errors import GeometryError

STEEPEST_DEG = 75.0  # beyond, a target is not recognised


@dataclass(frozen=True)
class TargetSize:
    """The size of targets for a camera and a distance."""

    diameter: float  # of the dot, unit of the distance
    ring: float  # outer diameter of a coded ring around it, unit of the distance
    pixel: float  # side of a pixel at the object, unit of the distance


@checked_arguments()
def compute_target_size(
    *,
    p: float,
    w_mm: float,
    d: float,
    c_mm: float,
    n: int,
    tilt_deg: float = 0.0,
    ring_per_dot: float = 3.0,
) -> TargetSize:
    """Return how large a target must be to show so many pixels: r = p w d / (c n).

    A target that is seen obliquely is shorter in one direction by the cosine of the tilt; its diameter is
    larger by as much, so that it still shows p pixels there.

    Args:
        p: pixels across the target, at least.
        w_mm: width of the sensor, mm.
        d: farthest distance of the camera from the object, in any unit.
        c_mm: principal distance (focal length), mm.
        n: pixels along the width of the photograph.
        tilt_deg: largest angle between the ray and the normal of a target, deg.
        ring_per_dot: outer diameter of the code's ring in diameters of the dot.

    Raises:
        GeometryError: a number that is not positive, or a tilt at which targets are not recognised.

    Source: document 000, eq. 2.88 (manual of PhotoModeler), there r = p fw d / (f pw).
    """
    given = {"pixels": p, "sensor width": w_mm, "distance": d, "principal distance": c_mm, "photograph": n}
    for name, value in given.items():
        if not (math.isfinite(value) and value > 0):
            raise GeometryError(f"target size: {name} is {value:g}, needed more than 0")
    if not 0 <= tilt_deg <= STEEPEST_DEG:
        raise GeometryError(f"target size: tilt is {tilt_deg:g} deg, needed 0 to {STEEPEST_DEG:g} deg")
    pixel = w_mm * d / (c_mm * n)
    diameter = p * pixel / math.cos(math.radians(tilt_deg))
    return TargetSize(diameter, ring_per_dot * diameter, pixel)
