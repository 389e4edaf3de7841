"""The verdict on a survey in plain words: good, with remarks, or not usable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sfm.report.result import SurveyResult

MUCH_REJECTED = 0.05  # share of rejected image points above which a person should look


@dataclass(frozen=True)
class Verdict:
    """What a person is told first."""

    level: Literal["good", "fair", "bad"]
    headline: str
    remarks: tuple[str, ...]  # what to look at, one line each


def verdict_of(result: SurveyResult) -> Verdict:
    """Judge a result by convergence, rank, photographs, rejections and the comparison.

    Args:
        result: the result.

    Returns:
        `bad` if the adjustment did not converge or something cannot be determined; `fair` if there is
        something to look at; else `good`.
    """
    a = result.adjustment
    oriented, total = len(a.network.images), result.images_total
    serious = []
    if not a.converged:
        serious.append(f"The adjustment did not converge in {a.iterations} iterations.")
    if a.defect != a.expected_defect or a.undetermined:
        what = f": {', '.join(a.undetermined)}" if a.undetermined else ""
        serious.append(
            f"Rank defect {a.defect}, expected {a.expected_defect}; not everything can be determined{what}."
        )
    remarks = []
    if oriented < total:
        remarks.append(f"{total - oriented} of {total} photographs are not in the result.")
    rejected = int(a.rejected.sum())
    if len(a.rejected) and rejected > MUCH_REJECTED * len(a.rejected):
        remarks.append(f"{rejected} of {len(a.rejected)} image points were rejected.")
    if result.comparison is not None and not result.comparison.agree:
        remarks.append(f"{result.comparison.backend} does not agree with the adjustment.")
    if result.warnings:
        remarks.append(f"{len(result.warnings)} warning{'s' if len(result.warnings) > 1 else ''}, see below.")
    if serious:
        return Verdict("bad", "The survey has no dependable result.", (*serious, *remarks))
    found = f"{oriented} of {total} photographs oriented, {len(a.network.points)} object points"
    if remarks:
        return Verdict("fair", f"The survey worked, with remarks: {found}.", tuple(remarks))
    return Verdict("good", f"The survey worked: {found}.", ())
