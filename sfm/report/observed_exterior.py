"""Observed exterior orientation in the reports: by how much the adjusted one differs, and its test."""

from __future__ import annotations

from html import escape

import numpy as np

from sfm.conventions import FloatArray
from sfm.report.given import EXTERIOR, GivenResiduals, exterior_residuals, words_of_w
from sfm.report.markup import finer_unit, signed, significant, table
from sfm.report.precision import root_mean_square
from sfm.report.section_given import NOTE
from sfm.report.text_given import worst_of_given
from sfm.report.text_lines import head, line
from sfm.result import SurveyResult

OPEN_ROWS = 30  # up to which a table of the page is unfolded


def exterior_text(result: SurveyResult) -> list[str]:
    """Return the part of report.txt: RMS of each coordinate and angle, and the worst of all."""
    kinds = [(found, names, *_unit(found)) for found, names in _kinds(result)]
    if not kinds:
        return []
    lines = head("Observed exterior orientation: adjusted minus given")
    for found, names, factor, unit in kinds:
        rms = ", ".join(significant(root_mean_square(v) * factor) for v in found.difference.T)
        lines.append(line(", ".join(names), f"{len(found.names)} photographs, RMS {rms} {unit}"))
    return lines + worst_of_given("photograph", kinds)


def exterior_section(result: SurveyResult) -> str:
    """Return the part of report.html: residual, standard deviation, r and w of each photograph."""
    text = ""
    for found, names in _kinds(result):
        factor, unit = _unit(found)
        header = ("photograph", *(f"{what} {name}" for what in "dsrw" for name in names))
        rows = [
            (
                name,
                *("" if np.isnan(v) else signed(v * factor) for v in found.difference[k]),
                *(
                    "" if np.isnan(s) else "fixed" if s == 0 else significant(s * factor)
                    for s in found.sigma[k]
                ),
                *("" if np.isnan(r) else f"{r:.3f}" for r in found.r[k]),
                *(words_of_w(w, r) for w, r in zip(found.w[k], found.r[k], strict=True)),
            )
            for k, name in enumerate(found.names)
        ]
        rms = (significant(root_mean_square(v) * factor) for v in found.difference.T)
        rows.append(("RMS", *rms, *[""] * (3 * len(names))))
        text += (
            f"<details{' open' if len(rows) <= OPEN_ROWS else ''}><summary>{', '.join(names)} of "
            f"{len(found.names)} photographs [{escape(unit)}]</summary>"
            + table(header, rows, last_bold=True)
            + "</details>"
        )
    if not text:
        return ""
    return (
        "<h3>Observed exterior orientation</h3><p class=note>d: adjusted minus given, s: given standard "
        f"deviation. {NOTE}</p>{text}"
    )


def _kinds(result: SurveyResult) -> list[tuple[GivenResiduals, tuple[str, ...]]]:
    """Return projection centres and angles, those photographs of which something was observed."""
    kinds: list[tuple[GivenResiduals, tuple[str, ...]]] = []
    for found, (_, names) in zip(exterior_residuals(result) or (), EXTERIOR, strict=False):
        seen = np.flatnonzero(np.isfinite(found.sigma).any(axis=1))
        if len(seen):
            kinds.append((found.select(seen), names))
    return kinds


def _unit(found: GivenResiduals) -> tuple[float, str]:
    """Return factor and unit in which the differences read well."""
    largest: FloatArray = np.abs(found.difference[np.isfinite(found.difference)])
    return finer_unit(found.units[0], float(largest.max(initial=0.0)))
