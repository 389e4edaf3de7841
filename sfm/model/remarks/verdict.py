"""The verdict on a result: a level and a headline that summarise its remarks.

`judge` serves every kind of result. The most serious remark decides: an error makes the result bad, a warning
makes it fair, and with notes alone it is good.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from sfm.model.display import MAX_LISTED, counted
from sfm.model.remarks.remark import Remark
from sfm.model.remarks.row import SEVERITIES, Severity

Level = Literal["good", "fair", "bad"]
EFFECT: Mapping[Severity, Level] = {"note": "good", "warning": "fair", "error": "bad"}


@dataclass(frozen=True)
class Line:
    """A remark as it is printed."""

    severity: Severity
    text: str
    remedy: str = ""  # only with the first remark of a kind
    lost: bool = False  # whether the remedy recovers a lost photograph or point


@dataclass(frozen=True)
class Verdict:
    """The summary of all remarks, which the user reads first."""

    level: Level
    headline: str
    remarks: tuple[Remark, ...]  # the most serious first
    tests: tuple[Remark, ...] = ()  # what was tested, and what could not be

    @property
    def lines(self) -> tuple[Line, ...]:
        """The remarks as they are printed: the first ones of each kind, and the number of the others."""
        return lines_of(self.remarks)

    @property
    def text(self) -> str:
        """Headline and remarks, a line each; errors and warnings begin with an exclamation mark."""
        signs = {"note": " "}
        return "\n".join(
            [self.headline, *(f"{signs.get(line.severity, '!')} {line.text}" for line in self.lines)]
        )

    @property
    def summary(self) -> str:
        """Headline and numbers of remarks."""
        counts = Counter(remark.severity for remark in self.remarks)
        listed = ", ".join(counted(counts[severity], severity) for severity in SEVERITIES if counts[severity])
        return f"{self.headline} {listed}".rstrip()

    @property
    def entry(self) -> dict[str, Any]:
        """The entry `verdict` of summary.json."""
        stated = self.as_dict()
        return {"level": stated.pop("verdict"), **stated}

    def as_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON."""
        remarks = [remark.as_dict() for remark in self.remarks]
        tests = [test.as_dict() for test in self.tests]
        return {"headline": self.headline, "verdict": self.level, "remarks": remarks, "tests": tests}


NOT_JUDGED = Verdict("bad", "The result was not judged.", ())
"""the verdict on a result before `judge`"""


def judge(remarks: Iterable[Remark], headlines: Mapping[Level, str]) -> Verdict:
    """Return the verdict on a result, without the remarks that other remarks explain.

    A warning that explains an error takes over its severity: the result is just as bad, and the reason is
    stated instead.

    Args:
        remarks: all remarks on the result, in reading order within a severity, and all tests.
        headlines: headline of each level for this kind of result.
    """
    given = tuple(remarks)
    tests = tuple(remark for remark in given if remark.test is not None)
    every = tuple(remark for remark in given if remark.test is None)
    causes = []
    for remark in every:
        if any(_explains(cause, remark) for cause in every):
            continue
        graded = not isinstance(remark.row.severity, str)
        explained = [effect.severity for effect in every if graded and _explains(remark, effect)]
        worst = min((remark.at_least, *explained), key=SEVERITIES.index)
        causes.append(replace(remark, at_least=worst))
    order = tuple(remark for severity in SEVERITIES for remark in causes if remark.severity == severity)
    level: Level = EFFECT[order[0].severity] if order else "good"
    return Verdict(level, headlines[level], order, tests)


def _explains(cause: Remark, remark: Remark) -> bool:
    """Return whether `cause` explains a remark; a note with a grade explains only other notes."""
    graded = not isinstance(cause.row.severity, str)
    serious = cause.severity != "note" or remark.severity == "note"
    return remark.kind in cause.row.explains and (serious or not graded)


def split_lines(lines: Sequence[Line]) -> tuple[tuple[Line, ...], tuple[Line, ...]]:
    """Return the lines that are shown under a headline, and the notes that are folded.

    Errors and warnings are always shown. Notes are shown up to MAX_LISTED lines, as they change no decision.

    Args:
        lines: the most serious first.
    """
    serious = sum(line.severity != "note" for line in lines)
    shown = max(serious, MAX_LISTED)
    return tuple(lines[:shown]), tuple(lines[shown:])


def lines_of(remarks: Iterable[Remark]) -> tuple[Line, ...]:
    """Return the printed lines: the first remarks of each kind and severity, and the number of the others."""
    groups: dict[tuple[Severity, str], list[Remark]] = {}
    for remark in remarks:
        groups.setdefault((remark.severity, remark.kind), []).append(remark)
    lines = []
    for (severity, _), same in groups.items():
        lines += [
            Line(severity, remark.text, "" if k else remark.remedy, bool(remark.row.explains))
            for k, remark in enumerate(same[:MAX_LISTED])
        ]
        if len(same) > MAX_LISTED:
            lines.append(Line(severity, f"{len(same) - MAX_LISTED} more like these."))
    return tuple(lines)
