"""Design diagram of targets: how large they must be at which distance."""

from __future__ import annotations

import io
from collections.abc import Sequence

from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from sfm.planning.sight import MIN_PIXELS
from sfm.planning.target_size import compute_target_size

SIZE_IN = (7.0, 4.5)
DIAGRAM_PIXELS = (MIN_PIXELS, 10.0, 15.0, 20.0)  # lines of the diagram


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
    figure = Figure(figsize=SIZE_IN, layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.add_subplot()
    for pixels in lines:
        end = compute_target_size(p=pixels, w_mm=w_mm, d=d, c_mm=c_mm, n=n, tilt_deg=tilt_deg).diameter
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
