"""Figures of comparisons, of inspections, and of target sizes for planning."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from sfm.model.conventions import AnyArray, BoolArray, FloatArray
from sfm.products.epochs.displacements import Displacements
from sfm.products.epochs.series import EpochSeries
from sfm.products.geometry.tolerance import IN, OUT, Deviations
from sfm.products.inspection.acceptance import Acceptance
from sfm.products.planning import MIN_PIXELS
from sfm.products.planning.visibility import compute_target_size
from sfm.report.figures.plot_data import Plot
from sfm.report.figures.plots import (
    ALONE_IN,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    plan_axes,
    plot,
    single_panel_figure,
    two_panel_figure,
)
from sfm.report.phrases import finer_unit, significant

BINS = 30
COLOURS = {IN: GREEN, OUT: RED}
SIZE_IN = (7.0, 4.5)
DIAGRAM_PIXELS = (MIN_PIXELS, 10.0, 15.0, 20.0)  # px across the target, one line of the diagram each
MAX_DRAWN = 12  # points drawn of a series: those that moved farthest
BANDS = "Displacements since the first epoch along their latest direction; bands of two standard deviations."
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


def plot_series(series: EpochSeries) -> Plot | None:
    """Plot the series of the points that moved farthest; None with two epochs, or if no point moved."""
    if len(series.names) < 3:
        return None
    pairs = [pair.displacements for pair in series.since_first]
    moved: dict[str, float] = {}
    for displacements in pairs:
        for k in np.flatnonzero(displacements.moved):
            name = displacements.differences.points[k]
            moved[name] = max(moved.get(name, 0.0), float(np.linalg.norm(displacements.displacement[k])))
    chosen = sorted(moved, key=lambda name: -moved[name])[:MAX_DRAWN]
    if not chosen:
        return None
    factor, unit = finer_unit(pairs[0].differences.unit, max(moved.values()))
    picture = single_panel_figure(3.8)
    axes = picture.subplots()
    at = np.arange(len(series.names))
    for name in chosen:
        length, sigma = (factor * np.array(values) for values in _along(name, pairs))
        (line,) = axes.plot(at, length, marker="o", ms=3, label=name)
        axes.fill_between(
            at, length - 2 * sigma, length + 2 * sigma, color=line.get_color(), alpha=0.15, lw=0
        )
    axes.axhline(0.0, color="grey", lw=0.8)
    axes.set_xticks(at, series.names)
    axes.set_ylabel(f"displacement [{unit}]")
    axes.legend(fontsize=8, ncols=4, loc="upper left")
    return plot("series", BANDS, picture)


def _along(name: str, pairs: list[Displacements]) -> tuple[list[float], list[float]]:
    """Return displacements of a point since the first epoch along its latest direction, and their sigmas."""
    rows = [
        displacements.differences.points.index(name) if name in displacements.differences.points else -1
        for displacements in pairs
    ]
    last, k = next((epoch, k) for epoch, k in zip(reversed(pairs), reversed(rows), strict=True) if k >= 0)
    direction = last.displacement[k] / max(float(np.linalg.norm(last.displacement[k])), 1e-300)
    length, sigma = [0.0], [0.0]
    for epoch, k in zip(pairs, rows, strict=True):
        if k < 0:
            length.append(np.nan)
            sigma.append(np.nan)
            continue
        Q = epoch.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        length.append(float(epoch.displacement[k] @ direction))
        sigma.append(float(np.sqrt(max(direction @ Q @ direction, 0.0))))
    return length, sigma


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
    """Return the design diagram as SVG: dot diameter over distance, with a line for each minimum size.

    Args:
        w_mm: width of the sensor, mm.
        d: farthest distance of the camera from the object, where the diagram ends.
        c_mm: principal distance (focal length), mm.
        n: pixels along the width of the photograph.
        unit: unit of the distance and the diameter.
        tilt_deg: largest angle between the ray and the normal of a target, deg.
        lines: minimum size of the target in the photograph for each line, px.

    Raises:
        GeometryError: a number is not positive, or targets are not recognised at this tilt.

    Source: document 000, fig. 2.11, drawn there for 7 px and a camera of 18 mm.
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


def deviation_figure(deviations: Deviations, unit: str) -> Figure:
    """Draw a histogram of the deviations, and each deviation with its uncertainty in ascending order."""
    limits = [x for x in (deviations.lower, deviations.upper) if np.isfinite(x)]
    largest = float(np.abs([*deviations.value, *limits]).max())
    factor, fine = finer_unit(unit, largest)
    value, U = deviations.value * factor, deviations.coverage * np.nan_to_num(deviations.sigma) * factor
    picture = two_panel_figure(3.6)
    left, right = picture.subplots(1, 2)
    left.hist(value, bins=min(BINS, max(5, len(value) // 3)), color=BLUE, alpha=0.8)
    left.set(xlabel=f"deviation [{fine}]", ylabel="points")
    order = np.argsort(value, kind="stable")
    x = np.arange(1, len(order) + 1)
    _draw_decided(right, x, value[order], U[order], np.array(deviations.decision)[order], 3)
    for limit in limits:
        left.axvline(limit * factor, color=GREY, lw=1, ls="--")
        right.axhline(limit * factor, color=GREY, lw=1, ls="--")
    right.set(xlabel="points in order of their deviation", ylabel=f"deviation and U [{fine}]")
    right.legend(fontsize=8, loc="upper left")
    return picture


def length_error_figure(acceptance: Acceptance) -> Figure:
    """Draw the length measurement errors over the length, with their limits."""
    length, error = acceptance.lengths.length, acceptance.error
    U = acceptance.coverage * np.nan_to_num(acceptance.lengths.sigma)
    factor, fine = finer_unit(acceptance.unit, float(max(np.abs(error).max(), acceptance.limit.max())))
    picture = single_panel_figure(4.2)
    axes = picture.subplots()
    x = np.linspace(0, 1.05 * float(length.max()), 200)
    limit = np.minimum(acceptance.a + acceptance.k * x, acceptance.b) * factor
    axes.plot(x, limit, color=GREY, lw=1.2)
    axes.plot(x, -limit, color=GREY, lw=1.2)
    axes.axhline(0, color=GREY, lw=0.6)
    _draw_decided(axes, length, error * factor, U * factor, np.array(acceptance.decision), 4)
    axes.set(
        xlabel=f"calibrated length [{acceptance.unit}]",
        ylabel=f"measured minus calibrated [{fine}]",
    )
    axes.legend(fontsize=8, loc="upper left")
    return picture


def _draw_decided(
    axes: Axes, x: AnyArray, y: FloatArray, U: FloatArray, decision: AnyArray, size: float
) -> None:
    """Draw values with their uncertainty, one colour per decision."""
    for name in dict.fromkeys(decision.tolist()):
        rows = decision == name
        colour, label = COLOURS.get(name, ORANGE), f"{name} ({rows.sum()})"
        axes.errorbar(x[rows], y[rows], yerr=U[rows], fmt="o", ms=size, lw=0.8, color=colour, label=label)
