"""The survey beside other programs: another adjuster on its network, another pipeline on its photographs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sfm.comparison.baseline import Baseline, BaselineComparison, compare_baseline
from sfm.comparison.two_adjusters.adjusters import AdjusterComparison, BackendAdjustment, compare_adjusters
from sfm.errors import KolinearError, MissingLibraryError
from sfm.network import Estimate, Network
from sfm.remarks.remark import Remark, remark
from sfm.runtime.progress import StageClock
from sfm.survey.adjusting.solution import SolvedSurvey
from sfm.survey.inputs.photograph_list import PhotographList

Adjuster = Callable[[Network, Estimate], BackendAdjustment]
"""another adjuster: network and start values in, its solution out"""
Mapper = Callable[[Path, tuple[tuple[str, ...], ...]], Baseline]
"""another pipeline: folder, and for each camera the names of its photographs in it, in; its solution out"""


@dataclass(frozen=True)
class OtherPrograms:
    """Programs to compare a survey with; functions, so that the survey imports none of their libraries."""

    adjuster: Adjuster | None = None
    mapper: Mapper | None = None


ALONE = OtherPrograms()
"""compare with nothing"""


@dataclass(frozen=True)
class SurveyComparison:
    """The survey beside what it was compared with; None where there is nothing."""

    adjusters: AdjusterComparison | None = None
    baseline: BaselineComparison | None = None
    remarks: tuple[Remark, ...] = ()  # comparisons that were asked for and failed, or were left out


def compare_solution(
    solution: SolvedSurvey, others: OtherPrograms, clock: StageClock, *, files: PhotographList | None = None
) -> SurveyComparison:
    """Compare a solution with those of other programs.

    The survey is valid without them: one that refuses is a warning in the result and does not lose it. A
    library that is not installed is reported without a warning's weight, since it is no defect of the survey.

    Args:
        solution: of the survey.
        others: what to compare with.
        clock: of the survey; the stages it has timed so far are the time of the survey.
        files: the photographs, for another pipeline.
    """
    own_seconds = sum(seconds for _, seconds in clock.seconds)
    adjusters = baseline = None
    remarks: list[Remark] = []
    if others.adjuster is not None:
        with clock.stage("comparison"):
            try:
                adjusters = compare_adjusters(solution.adjustment, others.adjuster)
            except MissingLibraryError as error:
                remarks.append(remark("adjuster_not_compared", reason=str(error)))
            except KolinearError as error:
                remarks.append(remark("adjuster_failed", reason=str(error)))
    if others.mapper is not None and files is not None:
        with clock.stage("baseline"):
            try:
                mapped = others.mapper(files.folder, files.by_camera())
                baseline = compare_baseline(solution.adjustment, mapped, seconds=own_seconds)
            except MissingLibraryError as error:
                remarks.append(remark("pipeline_not_compared", reason=str(error)))
            except KolinearError as error:
                remarks.append(remark("pipeline_failed", reason=str(error)))
    return SurveyComparison(adjusters, baseline, tuple(remarks))
