"""Pictures of measured results: deviations with their limits, errors of length measurement."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from sfm.geometry.tolerance import IN, OUT, Deviations
from sfm.inspection.acceptance import Acceptance
from sfm.report.figures.plots import BLUE, GREEN, GREY, ORANGE, RED, alone, panelled
from sfm.report.numbers import finer_unit

BINS = 30
COLOURS = ((IN, GREEN), (OUT, RED))


def deviation_figure(found: Deviations, unit: str) -> Figure:
    """Draw the histogram of deviations, and each with its uncertainty, in the order of their size."""
    limits = [x for x in (found.lower, found.upper) if np.isfinite(x)]
    largest = float(np.abs([*found.value, *limits]).max())
    factor, fine = finer_unit(unit, largest)
    value, U = found.value * factor, found.coverage * np.nan_to_num(found.sigma) * factor
    picture = panelled(3.6)
    left, right = picture.subplots(1, 2)
    left.hist(value, bins=min(BINS, max(5, len(value) // 3)), color=BLUE, alpha=0.8)
    left.set_xlabel(f"deviation [{fine}]")
    left.set_ylabel("points")
    order = np.argsort(value, kind="stable")
    decision = np.array(found.decision)[order]
    x = np.arange(1, len(order) + 1)
    for name in dict.fromkeys(decision.tolist()):
        rows = decision == name
        colour = dict(COLOURS).get(name, ORANGE)
        right.errorbar(
            x[rows],
            value[order][rows],
            yerr=U[order][rows],
            fmt="o",
            ms=3,
            lw=0.8,
            color=colour,
            label=f"{name} ({rows.sum()})",
        )
    for limit in limits:
        left.axvline(limit * factor, color=GREY, lw=1, ls="--")
        right.axhline(limit * factor, color=GREY, lw=1, ls="--")
    right.set_xlabel("points in order of their deviation")
    right.set_ylabel(f"deviation and U [{fine}]")
    right.legend(fontsize=8, loc="upper left")
    return picture


def length_error_figure(found: Acceptance) -> Figure:
    """Draw the errors of length measurement over the length, with their limit."""
    length, error = found.lengths.length, found.error
    U = found.coverage * np.nan_to_num(found.lengths.sigma)
    factor, fine = finer_unit(found.unit, float(max(np.abs(error).max(), found.limit.max())))
    picture = alone(4.2)
    axes = picture.subplots()
    x = np.linspace(0, 1.05 * float(length.max()), 200)
    limit = np.minimum(found.a + found.k * x, found.b) * factor
    axes.plot(x, limit, color=GREY, lw=1.2)
    axes.plot(x, -limit, color=GREY, lw=1.2)
    axes.axhline(0, color=GREY, lw=0.6)
    decision = np.array(found.decision)
    for name in dict.fromkeys(found.decision):
        rows = decision == name
        axes.errorbar(
            length[rows],
            error[rows] * factor,
            yerr=U[rows] * factor,
            fmt="o",
            ms=4,
            lw=0.8,
            color=dict(COLOURS).get(name, ORANGE),
            label=f"{name} ({rows.sum()})",
        )
    axes.set_xlabel(f"calibrated length [{found.unit}]")
    axes.set_ylabel(f"measured minus calibrated [{fine}]")
    axes.legend(fontsize=8, loc="upper left")
    return picture
