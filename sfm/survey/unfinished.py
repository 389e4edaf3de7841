"""How far a survey came whose stage cannot go on, for its report and for Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm.judgement.survey_result import FailedImage, PhotographTargets, StageTime
from sfm.model.conventions import BoolArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.network import Network
from sfm.model.remarks.remark import Remark
from sfm.orientation.incremental.sequence import NotOrientedError
from sfm.runtime.progress import StageClock
from sfm.survey.assembly import settings_by_table
from sfm.survey.inputs.measurements import Measurements, remarks_on_contradicting
from sfm.survey.inputs.survey import Survey
from sfm.survey.orientation import Oriented
from sfm.survey.sources.source import Correspondences


@dataclass(frozen=True)
class UnfinishedSurvey:
    """What a survey reached before a stage that cannot go on."""

    survey: str  # name of the survey
    unit: str  # object unit
    reason: str  # why the stage cannot go on, one line
    stage: str  # the stage, or the last one before it
    seconds: tuple[StageTime, ...]  # of the finished stages, in order
    images: tuple[str, ...]  # all photographs of the survey
    failed: tuple[FailedImage, ...]  # photographs that could not be read or oriented, with the reason
    network: Network  # image points of the last stage that was reached
    oriented: BoolArray | None  # photographs of the network; None if the orientation was not reached, (m,)
    determined: BoolArray | None  # its points with approximate coordinates; None as before, (n,)
    matched: bool  # whether the network contains the matched image points
    photographs: tuple[PhotographTargets, ...]  # measured targets; none with [observations]
    remarks: tuple[Remark, ...]  # of the stages that were reached
    settings: tuple[tuple[str, str], ...]  # (table of the survey file, its content)

    @property
    def images_total(self) -> int:
        """Number of photographs of the survey, without copies and files that cannot be read."""
        return len(self.images) - sum(not photograph.is_counted for photograph in self.failed)

    @property
    def steps(self) -> tuple[str, ...]:
        """What each stage reached, in words."""
        network = self.network
        seen = len(np.unique(network.image_points.image))
        points = counted(len(network.image_points), "image point")
        steps = [f"{points} in {seen} of {counted(len(network.images), 'photograph')}"]
        if self.oriented is not None and self.determined is not None:
            oriented = f"{self.oriented.sum()} of {counted(len(self.oriented), 'photograph')} oriented"
            steps.append(f"{oriented}, {counted(int(self.determined.sum()), 'object point')}")
        return tuple(steps)


class UnfinishedSurveyError(GeometryError):
    """A stage of a survey cannot go on."""

    reached: UnfinishedSurvey  # how far the survey came


def unfinished_survey(
    survey: Survey,
    reached: Measurements | Oriented,
    matched: Correspondences | None,
    clock: StageClock,
    error: GeometryError,
) -> UnfinishedSurvey:
    """Return how far a survey came.

    Args:
        survey: settings and given data.
        reached: the measured image points, or their orientation if that stage was reached.
        matched: all image points; None if that stage was not reached.
        clock: times of the stages.
        error: why the last stage cannot go on.
    """
    if isinstance(reached, Oriented):
        survey, measured, start = reached.survey, reached.measured, reached.orientation
    else:
        measured, start = reached, None
    network, estimate = measured.network, None if start is None else start.estimate
    overlays = measured.overlays
    if matched is not None:
        network, estimate = matched.network, matched.estimate
        overlays = overlays if matched.overlays is None else matched.overlays
    reasons: Sequence[tuple[str, Remark]] = () if start is None else start.failures
    cause: BaseException | None = error if start is None else None  # that states what could not be oriented
    while cause is not None and not isinstance(cause, NotOrientedError):
        cause = cause.__cause__
    if cause is not None:
        reasons = cause.failures
    left_out = () if matched is None else matched.left_out
    remarks = (() if start is None else start.remarks) + (() if matched is None else matched.remarks)
    contradicting = (*measured.left_out, *(() if matched is None else matched.left_out_image_points))
    return UnfinishedSurvey(
        survey=survey.name,
        unit=survey.unit,
        reason=str(error),
        stage=clock.last,
        seconds=tuple(StageTime(stage, seconds) for stage, seconds in clock.seconds),
        images=measured.images,
        failed=(
            *measured.failed,
            *(measured.not_in_result(image, reason) for image, reason in (*reasons, *left_out)),
        ),
        network=network,
        oriented=None if estimate is None else estimate.oriented,
        determined=None if estimate is None else estimate.determined,
        matched=matched is not None,
        photographs=overlays,
        remarks=(
            *measured.remarks,
            *remarks_on_contradicting(contradicting, measured.network),
            *remarks,
        ),
        settings=settings_by_table(survey),
    )
