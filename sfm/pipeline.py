"""A survey from photographs to result, start to end.

    photographs -> targets -> orientation -> matching -> adjustment -> comparison -> result

Every stage is one call; what it does, and from which book, is told where it is written.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sfm.analysis.comparison import AdjusterComparison, BackendAdjustment, compare_adjusters
from sfm.network import Estimate, Network, empty_estimate
from sfm.orientation.sequence import orient
from sfm.progress import SILENT, Progress
from sfm.project import Survey
from sfm.report.result import FailedImage, StageTime, SurveyResult
from sfm.survey_network import build_network, min_rays, name_coded
from sfm.survey_solution import Solution, match_and_adjust, refine, solve
from sfm.survey_start import find_photographs, network_from_observations
from sfm.survey_targets import measure_photographs
from sfm.targets.store import TargetStore

Backend = Callable[[Network, Estimate], BackendAdjustment]


def run_survey(
    survey: Survey,
    *,
    images_dir: Path | None = None,
    jobs: int = 1,
    backend: Backend | None = None,
    store: TargetStore | None = None,
    progress: Progress = SILENT,
) -> SurveyResult:
    """Run a survey from its photographs.

    Args:
        survey: what was read from the survey file.
        images_dir: folder of the photographs in place of the survey file's own.
        jobs: photographs measured at a time.
        backend: the other adjuster to compare with, none if not given.
        store: of measured targets, so that a photograph is not measured twice.
        progress: told of stages and photographs.

    Raises:
        KolinearError: the survey cannot be run; the message says what to do.
    """
    clock = _Clock(progress)
    files = find_photographs(survey, images_dir=images_dir)
    with clock.stage("targets"):
        photographs = measure_photographs(survey, files, jobs=jobs, store=store, progress=progress)
    with clock.stage("orientation"):
        naming = name_coded(photographs)
        network = build_network(survey, photographs, naming)
        orientation = orient(network, empty_estimate(network, photographs.cameras), refine=refine)
    with clock.stage("matching"):
        naming, network, estimate = match_and_adjust(
            survey,
            photographs,
            naming,
            orientation.estimate,
            tolerance_px=float(orientation.tolerance_px.max()),
        )
    with clock.stage("adjustment"):
        solution = solve(survey, network, estimate, min_rays=min_rays(naming))
    with clock.stage("comparison"):
        comparison = _compare(solution, backend)
    failures = tuple(FailedImage(*one) for one in (*orientation.failures, *solution.dropped_images))
    code = dict(zip(naming.names, naming.code, strict=True))
    return SurveyResult(
        survey.name,
        survey.unit,
        len(files),
        photographs.failed + failures,
        solution.adjustment,
        np.array([code[name] for name in solution.adjustment.network.points], dtype=np.int64),
        comparison,
        photographs.overlays(),
        solution.control_check,
        solution.warnings,
        tuple(clock.times),
    )


def adjust_survey(
    survey: Survey, *, backend: Backend | None = None, progress: Progress = SILENT
) -> SurveyResult:
    """Run the part of a survey that comes after the photographs, on its [observations].

    Args:
        survey: what was read from the survey file.
        backend: the other adjuster to compare with, none if not given.
        progress: told of stages.

    Raises:
        KolinearError: the survey cannot be run; the message says what to do.
    """
    clock = _Clock(progress)
    network, start = network_from_observations(survey)
    with clock.stage("orientation"):
        orientation = orient(network, start, refine=refine)
    with clock.stage("adjustment"):
        solution = solve(survey, network, orientation.estimate)
    with clock.stage("comparison"):
        comparison = _compare(solution, backend)
    return SurveyResult(
        survey.name,
        survey.unit,
        len(network.images),
        tuple(FailedImage(*one) for one in (*orientation.failures, *solution.dropped_images)),
        solution.adjustment,
        np.full(len(solution.adjustment.network.points), -1),
        comparison,
        control_check=solution.control_check,
        warnings=solution.warnings,
        seconds=tuple(clock.times),
    )


def _compare(solution: Solution, backend: Backend | None) -> AdjusterComparison | None:
    return None if backend is None else compare_adjusters(solution.adjustment, backend)


@dataclass
class _Clock:
    """Times the stages and announces them."""

    progress: Progress
    times: list[StageTime] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self.progress.stage(name)
        begun = time.perf_counter()
        yield
        self.times.append(StageTime(name, time.perf_counter() - begun))
