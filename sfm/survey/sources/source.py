"""What a source of image points does: a first measurement, and a second one in oriented photographs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from sfm.judgement.survey_result import Eccentricity, LeftOutPoint, PhotographTargets
from sfm.model.conventions import IntArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import Remark
from sfm.orientation.incremental.sequence import Orientation
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.inputs.measurements import NO_NAMES, Measurements, Naming, PhotographList
from sfm.survey.inputs.settings import Section
from sfm.survey.inputs.survey import Survey
from sfm.survey.inputs.survey_file import SurveyFile
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.orientation import Oriented


@dataclass(frozen=True)
class Correspondences:
    """The network of a survey with all its points, and approximate values."""

    network: Network
    estimate: Estimate  # NaN for points that were removed
    min_rays: IntArray  # photographs that each point needs, (n,)
    naming: Naming = NO_NAMES  # of the targets
    eccentricity: Eccentricity | None = None  # of the corrections; None without corrections
    no_circles: tuple[str, ...] = ()  # uncoded points left out: their outlines are not images of one circle
    remarks: tuple[Remark, ...] = ()
    point_failures: tuple[tuple[str, Remark], ...] = ()  # points without approximate values, with the reason
    given: bool = False  # whether the orientation started from approximate values of the survey
    left_out: tuple[tuple[str, Remark], ...] = ()  # photographs of another object, with the reason
    suspected: tuple[str, ...] = ()  # photographs matched only with a per-photograph camera
    left_out_image_points: tuple[LeftOutPoint, ...] = ()  # that contradict one another
    overlays: tuple[PhotographTargets, ...] | None = None  # drawn in the report; None: those measured


class Measure(Protocol):
    """Returns the image points of photographs before these are oriented.

    Args:
        survey: settings of the survey.
        files: photographs; none for a source that measures nothing.
        jobs: number of photographs measured at the same time.
        store: keeps the measurements; None to measure all anew.
        progress: receives every photograph.
    """

    def __call__(  # noqa: D102
        self,
        survey: Survey,
        files: PhotographList,
        *,
        jobs: int = 1,
        store: MeasuredStore | None = None,
        progress: Progress = SILENT,
    ) -> Measurements: ...


class Complete(Protocol):
    """Returns all image points of a source once the photographs are oriented.

    Args:
        oriented: the survey with the image points of all its sources.
        measured: what the first measurement of this source returned.
        start: orientation of these photographs and points.
        jobs: number of photographs processed in parallel.
    """

    def __call__(  # noqa: D102
        self, oriented: Oriented, measured: Measurements, start: Orientation, *, jobs: int = 1
    ) -> Correspondences: ...


class MeasureOne(Protocol):
    """Measures what a photograph shows by itself, and stores it.

    Args:
        survey: settings of the survey, or its file.
        image: name of the photograph.
        path: its file.
        store: stores the measurement, and is searched first.

    Returns:
        Counts of what was measured by name, and whether they were read from the store.
    """

    def __call__(  # noqa: D102
        self, survey: Survey | SurveyFile, image: str, path: Path, store: MeasuredStore
    ) -> tuple[dict[str, int], bool]: ...


@dataclass(frozen=True)
class SurveySource:
    """What a source of image points does."""

    measure: Measure
    complete: Complete
    # (table of the survey file, its settings)
    settings: Callable[[Survey], tuple[tuple[str, Section], ...]] = lambda _: ()
    measure_one: MeasureOne | None = None  # None: nothing is measured in a photograph by itself


def complete_as_measured(
    oriented: Oriented, measured: Measurements, start: Orientation, *, jobs: int = 1
) -> Correspondences:
    """Return the image points as they were first measured."""
    return Correspondences(
        measured.network,
        start.estimate,
        measured.min_rays,
        point_failures=start.point_failures,
        given=start.kind == "given",
    )
