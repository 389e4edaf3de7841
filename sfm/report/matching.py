"""Conjugate points for people: the table and JSON of `kolinear match`."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from sfm.files.plain_text import csv_text
from sfm.matching.conjugate_patches import ConjugatePoints

COLUMNS = (
    "point",
    "x_px",
    "y_px",
    "x_right_px",
    "y_right_px",
    "sx_px",
    "sy_px",
    "r",
    "r_second",
    "steps",
    "reason",
)
NO_SECOND = -1.0  # r of the second-best place where there is none


def matches_text(names: tuple[str, ...], found: ConjugatePoints) -> str:
    """Return the results as an aligned table for the terminal."""
    rows = [
        ("point", "left px", "right px", "sigma px", "r", "second r", "steps", ""),
        *_text_rows(names, found),
    ]
    width = [max(len(row[c]) for row in rows) for c in range(len(rows[0]))]
    lines = ["  ".join(cell.rjust(w) for cell, w in zip(row[:-1], width, strict=False)) for row in rows]
    return "".join(f"{line}  {row[-1]}".rstrip() + "\n" for line, row in zip(lines, rows, strict=True))


def matches_csv(names: tuple[str, ...], found: ConjugatePoints) -> str:
    """Return the results as CSV, empty fields where there is nothing."""
    rows = []
    for name, row in zip(names, _values(found), strict=True):
        numbers = ["" if not math.isfinite(value) else f"{value:.6g}" for value in row[:-2]]
        rows.append([name, *numbers, int(row[-2]), row[-1]])
    return csv_text(COLUMNS, rows)


def matches_json(names: tuple[str, ...], found: ConjugatePoints) -> str:
    """Return the results as JSON, null where there is nothing."""
    entries = []
    for k, (name, row) in enumerate(zip(names, _values(found), strict=True)):
        clean = [None if isinstance(value, float) and not math.isfinite(value) else value for value in row]
        entry = dict(zip(COLUMNS, (name, *clean), strict=True))
        finite = np.isfinite(found.covariance[k]).all()
        entry["covariance_px2"] = found.covariance[k].tolist() if finite else None
        gain, offset = float(found.gain[k]), float(found.offset[k])
        entry["gain"], entry["offset"] = (v if math.isfinite(v) else None for v in (gain, offset))
        entries.append(entry)
    return json.dumps({"method": found.method, "points": entries}, indent=1, ensure_ascii=False) + "\n"


def _values(found: ConjugatePoints) -> list[tuple[Any, ...]]:
    """Return the columns behind the name, one tuple for each point."""
    table = np.column_stack([found.left, found.right, found.sigma, found.correlation, found.second])
    return [
        (*row, int(s), why) for row, s, why in zip(table.tolist(), found.steps, found.reason, strict=True)
    ]


def _text_rows(names: tuple[str, ...], found: ConjugatePoints) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for name, row in zip(names, _values(found), strict=True):
        x, y, xr, yr, sx, sy, r, second, steps, why = row
        place = "-" if why else f"{xr:.3f}, {yr:.3f}"
        sigma = "-" if why else f"{sx:.4f}, {sy:.4f}"
        quality = f"{r:.4f}" if math.isfinite(float(r)) else "-"
        next_best = f"{second:.2f}" if second > NO_SECOND else "-"
        rows.append((name, f"{x:.2f}, {y:.2f}", place, sigma, quality, next_best, str(steps), str(why)))
    return rows
