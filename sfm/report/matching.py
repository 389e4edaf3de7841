"""Conjugate points as `kolinear match` prints and writes them."""

from __future__ import annotations

import json

import numpy as np

from sfm.matching.conjugate_patches import ConjugatePoints
from sfm.report.page import Column, Table, plain

NO_SECOND = -1.0  # r of the second-best place where there is none
COLUMNS = (
    *(Column("point", "point"), Column(None, "x_px"), Column(None, "y_px"), Column("left px", format=str)),
    *(Column(None, "x_right_px"), Column(None, "y_right_px"), Column("right px", format=str)),
    *(Column(None, "sx_px"), Column(None, "sy_px"), Column("sigma px", format=str)),
    Column("r", "r", format=".4f", unknown="-"),
    Column("second r", "r_second", format=lambda r: f"{r:.2f}" if r > NO_SECOND else "-"),
    *(Column("steps", "steps", format=str), Column("", "reason")),
)
NAMES = tuple(one.name for one in COLUMNS if one.name)


def matches_table(names: tuple[str, ...], found: ConjugatePoints) -> Table:
    """Return the results, NaN where there is nothing."""
    values = np.column_stack([found.left, found.right, found.sigma, found.correlation, found.second])
    rows = []
    for name, row, steps, why in zip(names, values.tolist(), found.steps, found.reason, strict=True):
        x, y, x_right, y_right, sx, sy, r, second = row
        right, sigma = ("-", "-") if why else (f"{x_right:.3f}, {y_right:.3f}", f"{sx:.4f}, {sy:.4f}")
        left = f"{x:.2f}, {y:.2f}"
        rows.append((name, x, y, left, x_right, y_right, right, sx, sy, sigma, r, second, int(steps), why))
    return Table(COLUMNS, rows)


def matches_json(names: tuple[str, ...], found: ConjugatePoints) -> str:
    """Return the results as JSON, null where there is nothing."""
    beside = zip(matches_table(names, found).records, found.covariance, found.gain, found.offset, strict=True)
    entries = [
        entry | {"covariance_px2": Q if np.isfinite(Q).all() else None, "gain": gain, "offset": offset}
        for entry, Q, gain, offset in beside
    ]
    return json.dumps(plain({"method": found.method, "points": entries}), indent=1, ensure_ascii=False) + "\n"
