"""What was given beside the photographs, in report.txt: control, scale bars, given interior orientation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.report.checks import words_of_check
from sfm.report.given import (
    NOT_CHECKED,
    GivenResiduals,
    bar_residuals,
    control_residuals,
    interior_residuals,
    words_of_w,
)
from sfm.report.markup import finer_unit, signed, significant, with_exponent
from sfm.report.precision import root_mean_square
from sfm.report.text_lines import MOST_ROWS, columns, head
from sfm.report.text_lines import lines as told
from sfm.result import SurveyResult


def given_text(result: SurveyResult) -> list[str]:
    """Return control, differences at it, scale bars, and weighted interior orientation."""
    lines: list[str] = []
    check = result.control_check
    if check is not None:
        lines += told("check at control", words_of_check(check, result.length_unit))
    control, bars, interior = control_residuals(result), bar_residuals(result), interior_residuals(result)
    if control is not None:
        lines += _of_control(control)
    rows = []
    for kind, one in (("scale bar", bars), ("interior", interior)):
        if one is None:
            continue
        for k, name in enumerate(one.names):
            given, v, sigma, r, w = (x[k, 0] for x in (one.given, one.difference, one.sigma, one.r, one.w))
            unit = "" if one.units[k] == "1" else one.units[k]
            rows.append((kind, name, *with_exponent(given, sigma), significant(v), unit, f"{r:.3f}",
                         words_of_w(w, r)))  # fmt: skip
    if rows:
        header = ("given", "", "value", "sigma", "adjusted - given", "unit", "r", "w")
        lines += columns(header, rows[: 2 * MOST_ROWS], left=2)
    if len(rows) > 2 * MOST_ROWS:
        lines.append(f"  and {len(rows) - 2 * MOST_ROWS} more, in given.csv")
    return head("Control, scale and given interior orientation") + lines if lines else []


def worst_of_given(
    what: str, kinds: Sequence[tuple[GivenResiduals, tuple[str, ...], float, str]]
) -> list[str]:
    """Return a table of the coordinates with the largest w, and of how many they are.

    Args:
        what: what the names stand for, as "photograph".
        kinds: residuals, names of their coordinates, factor and unit in which they read well.
    """
    rows: list[tuple[float, tuple[str, ...]]] = []
    for found, names, factor, unit in kinds:
        for k, d in np.argwhere(np.isfinite(found.r)):
            v, sigma, r, w = (float(x[k, d]) for x in (found.difference, found.sigma, found.r, found.w))
            words = (signed(v * factor), significant(sigma * factor), unit, f"{r:.3f}", words_of_w(w, r))
            rows.append((-abs(np.nan_to_num(w)), (found.names[k], names[d], *words)))
    if not rows:
        return []
    rows.sort(key=lambda row: row[0])
    header = (what, "", "adjusted - given", "sigma", "unit", "r", "w")
    lines = columns(header, [words for _, words in rows[:MOST_ROWS]], left=2)
    if len(rows) > MOST_ROWS:
        lines.append(f"  the {MOST_ROWS} with the largest w of {len(rows)}; all in given.csv")
    return lines


def _of_control(found: GivenResiduals) -> list[str]:
    """Return how well the adjusted control agrees with what was given, and its worst coordinates."""
    points = f"{len(found.names)} points"
    if not np.isfinite(found.r).any():
        return told("control", f"{points} without standard deviation: {NOT_CHECKED}")
    factor, unit = finer_unit(found.units[0], float(np.nanmax(np.abs(found.difference), initial=0.0)))
    rms = ", ".join(significant(root_mean_square(v) * factor) for v in found.difference.T)
    worst = worst_of_given("control point", [(found, ("X", "Y", "Z"), factor, unit)])
    return told("control", f"{points}, RMS {rms} {unit} in X, Y, Z, adjusted minus given") + worst
