"""The figures of differences between two sets of coordinates, and between two cameras."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from sfm.comparison.camera_difference import CameraDifference
from sfm.model.conventions import BoolArray, FloatArray
from sfm.report.figures.plots import (
    ALONE_IN,
    BAR_FRACTION,
    BLUE,
    RED,
    SHADES,
    plan_axes,
    single_panel_figure,
    two_panel_figure,
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


def camera_difference_figure(difference: CameraDifference) -> Figure:
    """Draw the difference of two cameras over the format: its length as colour, its direction as arrows.

    Outside of the region in which both cameras are known, colours are pale, without arrows. With covariances
    a second panel shows the differences in standard deviations.
    """
    length, known = difference.length_px, difference.known
    over = length / difference.sigma_px
    panels: list[tuple[FloatArray, str]] = [(length, "difference [px]")]
    if np.isfinite(over[known]).any():
        panels.append((over, "over its standard deviation"))
    width, height = difference.size_px
    picture = two_panel_figure(1.2 + 4.0 * height / width) if len(panels) == 2 else single_panel_figure(4.8)
    axes = np.atleast_1d(picture.subplots(1, len(panels)))
    X, Y = np.meshgrid(difference.x, difference.y)
    arrows = np.where(known[:, :, None], difference.difference, np.nan)
    for panel, (values, label) in zip(axes, panels, strict=True):
        top = float(np.nanmax(values[known])) or 1.0
        cell = [difference.x[1] - difference.x[0], difference.y[1] - difference.y[0]]
        extent = (-cell[0] / 2, width - 1 + cell[0] / 2, height - 1 + cell[1] / 2, -cell[1] / 2)
        drawn = panel.imshow(
            values, cmap=SHADES, vmin=0.0, vmax=top, extent=extent, alpha=np.where(known, 1.0, 0.3)
        )
        picture.colorbar(drawn, ax=panel, label=label, shrink=0.8, fraction=BAR_FRACTION)
        panel.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="x [px]", ylabel="y [px]")
    step = slice(None, None, 3)
    longest = float(np.nanmax(length[known])) or 1.0
    scale = longest / (3 * (difference.x[1] - difference.x[0]))
    drawn_arrows = axes[0].quiver(
        X[step, step], Y[step, step], arrows[step, step, 0], arrows[step, step, 1],
        color="black", angles="xy", scale_units="xy", scale=scale, width=0.003,
    )  # fmt: skip
    axes[0].quiverkey(drawn_arrows, 0.1, 1.03, longest, f"{significant(longest)} px", labelpos="E")
    return picture
