"""Pictures of comparisons: differences of two results, and the time of two adjusters."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from sfm.comparison.significance import ResultComparison
from sfm.comparison.two_adjusters.adjuster_validation import Validation
from sfm.conventions import FloatArray
from sfm.report.figures.plots import BLUE, RED, plan_axes
from sfm.report.numbers import finer_unit, significant

LONGEST_ARROW = 0.1  # of the object's size, that of the largest difference


def difference_figure(found: ResultComparison, xyz: FloatArray) -> Figure:
    """Draw the differences as arrows on the object's main plane, and across it as colours."""
    plane, names = plan_axes(xyz)
    turned, d = xyz @ plane.T, found.point_difference @ plane.T
    flat = turned[:, :2]
    size = float(np.linalg.norm(np.ptp(flat, axis=0)))
    longest = float(np.linalg.norm(d[:, :2], axis=1).max())
    across = float(np.abs(d[:, 2]).max())
    factor = LONGEST_ARROW * size / longest if longest > 0 else 1.0
    finer, fine_unit = finer_unit(found.unit, max(longest, across))
    fine_unit = fine_unit or "object units"
    height = float(np.clip(8.5 * np.ptp(flat[:, 1]) / max(np.ptp(flat[:, 0]), 1e-12 * size), 2.5, 8.0))
    picture = Figure(figsize=(8.5, height + 0.8), layout="constrained")
    axes = picture.subplots()
    colours = np.where(found.significant, RED, BLUE)
    arrows = axes.quiver(
        *flat.T, *(factor * d[:, :2]).T, color=colours, angles="xy", scale_units="xy", scale=1, width=0.002
    )
    limit = across * finer or 1.0
    dots = axes.scatter(
        flat[:, 0],
        flat[:, 1],
        c=d[:, 2] * finer,
        s=14,
        cmap="coolwarm",
        vmin=-limit,
        vmax=limit,
        edgecolors="grey",
        lw=0.3,
    )
    picture.colorbar(dots, ax=axes, label=f"{names[2]} [{fine_unit}]", shrink=0.7, fraction=0.04)
    if longest > 0:
        label = f"{significant(longest * finer)} {fine_unit}"
        axes.quiverkey(arrows, 0.08, 1.03, factor * longest, label, labelpos="E", coordinates="axes")
    axes.plot(*(flat + factor * d[:, :2]).T, alpha=0.0)  # arrows do not widen the axes by themselves
    axes.set_aspect("equal")
    unit = f" [{found.unit}]" if found.unit else ""
    axes.set_xlabel(f"{names[0]}{unit}")
    axes.set_ylabel(f"{names[1]}{unit}")
    return picture


def time_figure(validation: Validation) -> Figure:
    """Draw the seconds of both adjusters over the number of image points."""
    k = np.array([t.image_points for t in validation.trials])
    seconds = np.array([t.seconds for t in validation.trials])
    picture = Figure(figsize=(8.5, 3.6), layout="constrained")
    axes = picture.subplots()
    axes.loglog(k, seconds[:, 0], "o", ms=3.5, color=BLUE, label="kolinear")
    axes.loglog(k, seconds[:, 1], "o", ms=3.5, color=RED, label=validation.backend)
    axes.set_xlabel("image points")
    axes.set_ylabel("s")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return picture
