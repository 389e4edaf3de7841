"""The verdict: what a person reads first. One function judges every kind of result by its remarks.

The most serious remark decides: an error makes a result bad, a warning fair, notes leave it good.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from sfm.display import MAX_LISTED
from sfm.remarks.kind import Grade
from sfm.remarks.remark import SEVERITIES, Remark, Severity

Level = Literal["good", "fair", "bad"]
EFFECT: Mapping[Severity, Level] = {"note": "good", "warning": "fair", "error": "bad"}


@dataclass(frozen=True)
class Line:
    """A remark as it is printed."""

    severity: Severity
    text: str
    remedy: str = ""  # with the first of a kind
    lost: bool = False  # whether a photograph or a point is lost that the remedy brings back


@dataclass(frozen=True)
class Verdict:
    """The lines that a person reads first."""

    level: Level
    headline: str
    remarks: tuple[Remark, ...]  # the most serious first

    @property
    def lines(self) -> tuple[Line, ...]:
        """The remarks as printed: the first ones of each kind, and how many more there are."""
        return lines_of(self.remarks)

    def as_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON."""
        remarks = [one.as_dict() for one in self.remarks]
        return {"headline": self.headline, "verdict": self.level, "remarks": remarks}


def judge(remarks: Iterable[Remark], headlines: Mapping[Level, str]) -> Verdict:
    """Return the verdict on a result; what others of its remarks explain is left out.

    A warning that explains an error takes its severity: the result is as bad, and the reason is stated.

    Args:
        remarks: all that was found, in the order in which it is to be read within a severity.
        headlines: what each level means for this kind of result.
    """
    every = tuple(remarks)
    every = tuple(
        replace(one, at_least=_worst_explained(one, every))
        for one in every
        if not any(_explains(cause, one) for cause in every)
    )
    order = tuple(one for severity in SEVERITIES for one in every if one.severity == severity)
    level: Level = EFFECT[order[0].severity] if order else "good"
    return Verdict(level, headlines[level], order)


def _explains(cause: Remark, one: Remark) -> bool:
    """Return whether a remark follows from another one; from a note with a grade only what is one as well."""
    graded = isinstance(cause.row.severity, Grade)
    serious = cause.severity != "note" or one.severity == "note"
    return one.kind in cause.row.explains and (serious or not graded)


def _worst_explained(cause: Remark, every: tuple[Remark, ...]) -> Severity:
    """Return the worst severity of what a remark with a grade explains."""
    graded = isinstance(cause.row.severity, Grade)
    explained = [one.severity for one in every if graded and _explains(cause, one)]
    return min((cause.at_least, *explained), key=SEVERITIES.index)


def lines_of(remarks: Iterable[Remark]) -> tuple[Line, ...]:
    """Return the lines that are printed: the first ones of a kind and severity, and how many more."""
    groups: dict[tuple[Severity, str], list[Remark]] = {}
    for one in remarks:
        groups.setdefault((one.severity, one.kind), []).append(one)
    lines = []
    for (severity, _), same in groups.items():
        lines += [
            Line(severity, one.text, "" if k else one.remedy, bool(one.row.explains))
            for k, one in enumerate(same[:MAX_LISTED])
        ]
        if len(same) > MAX_LISTED:
            lines.append(Line(severity, f"{len(same) - MAX_LISTED} more like these."))
    return tuple(lines)
