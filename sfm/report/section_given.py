"""What was given beside the photographs, in the report: control and scale bars."""

from __future__ import annotations

from html import escape

import numpy as np

from sfm.report.given import bar_residuals, control_residuals, words_of_w
from sfm.report.markup import finer_unit, signed, significant, table
from sfm.result import SurveyResult

NOTE = (
    "r: redundancy number (0 no check, 1 full check). w: the difference over its own standard deviation, "
    "that which was given times the root of r; by chance 1 of 1000 is beyond 3.3."
)


def given_section(result: SurveyResult) -> str:
    """Control, as a check where it took no part, else with its residuals, and scale bars with theirs."""
    return _check(result) + _control_residuals(result) + _bars(result)


def _check(result: SurveyResult) -> str:
    check = result.control_check
    if check is None:
        return ""
    factor, unit = finer_unit(result.length_unit, float(np.abs(check.differences).max()))
    rows = [
        (name, *(signed(v) for v in d), significant(float(np.linalg.norm(d))))
        for name, d in zip(check.points, check.differences * factor, strict=True)
    ]
    rms = check.rms * factor
    rows.append(("RMS", *(significant(v) for v in rms), significant(float(np.linalg.norm(rms)))))
    if result.adjustment.network.scale_bars:
        placed = (
            "by shift and rotation, in the scale of the scale bars; the control says lengths are "
            f"{check.scale:.9g} times those of the scale bars."
        )
    else:
        placed = "by shift, rotation and scale; the scale was taken from the control."
    return (
        "<h3>Check at the control</h3><p class=note>The control took no part in the adjustment. The result "
        f"was placed on it afterwards {placed} What remains at each point, placed minus nominal "
        f"[{escape(unit)}]:</p>" + table(("control point", "dX", "dY", "dZ", "length"), rows, last_bold=True)
    )


def _control_residuals(result: SurveyResult) -> str:
    found = control_residuals(result)
    if found is None:
        return ""
    factor, unit = finer_unit(result.length_unit, float(np.nanmax(np.abs(found.difference), initial=0.0)))
    rows = [
        (
            name,
            *(signed(v) for v in d * factor),
            *("not known" if np.isnan(v) else "fixed" if v == 0 else significant(v) for v in s * factor),
            *("" if np.isnan(v) else f"{v:.3f}" for v in r),
            *(words_of_w(*both) for both in zip(w, r, strict=True)),
        )
        for name, d, s, r, w in zip(found.names, found.difference, found.sigma, found.r, found.w, strict=True)
    ]
    header = tuple(f"{what}{axis}" for what in "dsrw" for axis in "XYZ")
    return (
        "<h3>Control</h3><p class=note>d: adjusted minus given, s: given standard deviation "
        f"[{escape(unit)}]. {NOTE}</p>" + table(("control point", *header), rows)
    )


def _bars(result: SurveyResult) -> str:
    found = bar_residuals(result)
    if found is None:
        return ""
    largest = float(np.abs(np.concatenate([found.difference, found.sigma])).max())
    factor, unit = finer_unit(result.length_unit, largest)
    rows = [
        (
            name,
            f"{found.given[b, 0]:.9g}",
            signed(found.difference[b, 0] * factor),
            significant(found.sigma[b, 0] * factor),
            f"{found.r[b, 0]:.3f}",
            words_of_w(found.w[b, 0], found.r[b, 0]),
        )
        for b, name in enumerate(found.names)
    ]
    header = (
        "scale bar",
        f"given [{result.length_unit}]",
        f"adjusted minus given [{unit}]",
        f"sigma given [{unit}]",
        "r",
        "w",
    )
    text = f"<h3>Scale bars</h3><p class=note>{NOTE}</p>" + table(header, rows)
    if len(rows) == 1 and result.adjustment.datum != "control":
        text += (
            "<p class=note>A single bar gives the scale and cannot be checked; two or more check one "
            "another.</p>"
        )
    return text
