"""The verdict: what a person reads first. One function judges every kind of result by its remarks.

The most serious remark decides: an error makes a result bad, a warning fair, notes leave it good.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from sfm.remarks.remark import SEVERITIES, Remark, Severity

Level = Literal["good", "fair", "bad"]
EFFECT: Mapping[Severity, Level] = {"note": "good", "warning": "fair", "error": "bad"}


@dataclass(frozen=True)
class Verdict:
    """What a person reads first."""

    level: Level
    headline: str
    remarks: tuple[Remark, ...]  # the most serious first

    @property
    def texts(self) -> tuple[str, ...]:
        """The sentences of the remarks."""
        return tuple(one.text for one in self.remarks)


def judge(remarks: Iterable[Remark], headlines: Mapping[Level, str]) -> Verdict:
    """Return the verdict on a result.

    Args:
        remarks: all that was found, in the order in which it is to be read within a severity.
        headlines: what each level means for this kind of result.
    """
    every = tuple(remarks)
    order = tuple(one for severity in SEVERITIES for one in every if one.severity == severity)
    level: Level = EFFECT[order[0].severity] if order else "good"
    return Verdict(level, headlines[level], order)
