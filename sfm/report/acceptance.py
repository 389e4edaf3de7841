"""The page of an acceptance test."""

from __future__ import annotations

import numpy as np

from sfm.display import counted
from sfm.geometry.tolerance import DECISIONS
from sfm.inspection.acceptance import Acceptance
from sfm.report.figures.comparisons import length_error_figure
from sfm.report.figures.plots import plot
from sfm.report.page import Column, Note, Page, Section, Table, facts
from sfm.report.phrases import general, signed, significant

PICTURE = (
    "Error of length measurement over length: bars are the expanded uncertainty of the calibration, lines "
    "the limit A + K L, at most B."
)


def page(found: Acceptance) -> Page:
    """Return the page: limit, decisions, and every length."""
    a, lengths, u = found, found.lengths, found.unit
    most = f", at most B = {significant(a.b)} {u}" if np.isfinite(a.b) else ""
    limit = f"A + K L with A = {significant(a.a)} {u}, K = {general(a.k, 4)}{most}"
    lines = len(set(lengths.line))
    figures = facts(
        [
            ("Limit", limit),
            ("Lengths", f"{len(a.error)} on {counted(lines, 'line')}"),
            ("Largest error", f"{significant(a.largest)} {u}"),
            *((one.capitalize(), counted(a.count(one), "length")) for one in DECISIONS if a.count(one)),
            ("Body diagonal", f"{general(a.diagonal, 6)} {u}"),
        ]
    )
    note = Note(
        "Error of a length measurement: measured minus calibrated length. ISO 14253-1 with U = "
        f"{general(a.coverage, 3)} sigma of the calibration: in and out are proven, undecided is what lies "
        "within U of the limit. The scale of the result comes from other bars."
    )
    columns = (
        *(Column(name, name) for name in ("line", "from", "to")),
        Column("calibrated", "length", u, ".9g"),
        Column("sigma", "sigma", u, significant),
        Column("measured", "measured", u, ".9g"),
        Column("sigma", "sigma_measured", u, significant),
        Column("error", "error", u, signed),
        Column("limit", "limit", u, significant),
        Column("decision", "decision"),
    )
    rows = zip(
        *(lengths.line, lengths.start, lengths.end, lengths.length, lengths.sigma, lengths.length + a.error),
        *(a.sigma, a.error, a.limit, a.decision),
        strict=True,
    )
    summary = {
        "test": "VDI/VDE 2634 part 1",
        "result": a.name,
        "length_unit": u,
        **a.verdict.as_dict(),
        "limit": {"A": a.a, "K": a.k, "B": a.b},
        "coverage": a.coverage,
        "lines": lines,
        "lengths": len(a.error),
        **{one.replace(" ", "_"): a.count(one) for one in DECISIONS},
        "largest_error": a.largest,
        "rms_error": float(np.sqrt((a.error**2).mean())),
        "body_diagonal": a.diagonal,
    }
    return Page(
        "acceptance",
        "Acceptance test, VDI/VDE 2634 part 1",
        a.name,
        a.verdict,
        (
            Section("Figures", figures, note, plot("errors", PICTURE, length_error_figure(found))),
            Section("Lengths", Table(columns, list(rows), "lengths")),
        ),
        summary=summary,
    )
