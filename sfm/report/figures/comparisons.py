"""The figure of differences between two sets of coordinates."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from sfm.model.conventions import BoolArray, FloatArray
from sfm.report.figures.plots import (
    ALONE_IN,
    BLUE,
    RED,
    plan_axes,
    single_panel_figure,
)
from sfm.report.phrases import finer_unit, significant

LONGEST_ARROW = 0.1  # length of the largest difference over the size of the object


def difference_figure(
    xyz: FloatArray, difference: FloatArray, significant_ones: BoolArray, unit: str
) -> Figure:
    """Draw differences: their part in the object's main plane as arrows, the part across it as colours.

    Args:
        xyz: coordinates, object unit, (n, 3).
        difference: object unit, (n, 3).
        significant_ones: drawn in red, (n,).
        unit: the object unit, empty if it is not known.
    """
    plane, names = plan_axes(xyz)
    turned, d = xyz @ plane.T, difference @ plane.T
    flat = turned[:, :2]
    size = float(np.linalg.norm(np.ptp(flat, axis=0)))
    longest = float(np.linalg.norm(d[:, :2], axis=1).max())
    across = float(np.abs(d[:, 2]).max())
    factor = LONGEST_ARROW * size / longest if longest > 0 else 1.0
    finer, fine_unit = finer_unit(unit, max(longest, across))
    fine_unit = fine_unit or "object units"
    height = float(np.clip(ALONE_IN * np.ptp(flat[:, 1]) / max(np.ptp(flat[:, 0]), 1e-12 * size), 2.5, 8.0))
    picture = single_panel_figure(height + 0.8)
    axes = picture.subplots()
    colours = np.where(significant_ones, RED, BLUE)
    arrows = axes.quiver(
        *flat.T, *(factor * d[:, :2]).T, color=colours, angles="xy", scale_units="xy", scale=1, width=0.002
    )
    limit = across * finer or 1.0
    x, y = flat.T
    dots = axes.scatter(
        x, y, c=d[:, 2] * finer, s=14, cmap="coolwarm", vmin=-limit, vmax=limit, edgecolors="grey", lw=0.3
    )
    picture.colorbar(dots, ax=axes, label=f"{names[2]} [{fine_unit}]", shrink=0.7, fraction=0.04)
    if longest > 0:
        label = f"{significant(longest * finer)} {fine_unit}"
        axes.quiverkey(arrows, 0.08, 1.03, factor * longest, label, labelpos="E", coordinates="axes")
    axes.plot(*(flat + factor * d[:, :2]).T, alpha=0.0)  # arrows do not widen the axes by themselves
    axes.set_aspect("equal")
    suffix = f" [{unit}]" if unit else ""
    axes.set(xlabel=f"{names[0]}{suffix}", ylabel=f"{names[1]}{suffix}")
    return picture
