"""Design of a network: how large targets must be, before anything is photographed."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

from sfm.errors import GeometryError

MIN_PIXELS = 7.0  # on a target, as the source takes it; the measurement itself begins at 3
DIAGRAM_PIXELS = (MIN_PIXELS, 10.0, 15.0, 20.0)  # lines of the diagram
STEEPEST_DEG = 75.0  # beyond, a target is not recognised


@dataclass(frozen=True)
class TargetSize:
    """The size of targets for a camera and a distance."""

    diameter: float  # of the dot, unit of the distance
    ring: float  # outer diameter of a coded ring around it, unit of the distance
    pixel: float  # side of a pixel at the object, unit of the distance


def target_size(
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


def design_diagram(
    *,
    w_mm: float,
    d: float,
    c_mm: float,
    n: int,
    unit: str,
    tilt_deg: float = 0.0,
    lines: Sequence[float] = DIAGRAM_PIXELS,
) -> bytes:
    """Return the design diagram as SVG: diameter of the dot over the distance, a line for each least size.

    Args:
        w_mm: width of the sensor, mm.
        d: farthest distance of the camera from the object, which the diagram ends at.
        c_mm: principal distance (focal length), mm.
        n: pixels along the width of the photograph.
        unit: of the distance and the diameter.
        tilt_deg: largest angle between the ray and the normal of a target, deg.
        lines: pixels across the target, at least, of each line.

    Raises:
        GeometryError: a number that is not positive, or a tilt at which targets are not recognised.

    Source: document 000, fig. 2.11, there for 7 px and a camera of 18 mm.
    """
    from matplotlib.backends.backend_svg import FigureCanvasSVG  # slow to import, and for this only
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.add_subplot()
    for pixels in lines:
        end = target_size(p=pixels, w_mm=w_mm, d=d, c_mm=c_mm, n=n, tilt_deg=tilt_deg).diameter
        axes.plot([0, d], [0, end], gid=f"{pixels:g} px")  # in proportion
        axes.annotate(f"{pixels:g} px", (d, end), xytext=(4, 0), textcoords="offset points", va="center")
    axes.set(
        xlim=(0, d),
        ylim=(0, None),
        xlabel=f"distance [{unit}]",
        ylabel=f"diameter of the dot [{unit}]",
        title=f"c = {c_mm:g} mm, sensor {w_mm:g} mm wide, {n} px, tilt up to {tilt_deg:g} deg",
    )
    axes.minorticks_on()
    axes.grid(which="both", alpha=0.3)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()
