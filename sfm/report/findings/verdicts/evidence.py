"""What a result is judged by, and how a judgement reads."""

from __future__ import annotations

from dataclasses import dataclass

from sfm.adjustment.quality.against_free import ControlApart, GivenTest, ScaleDifference
from sfm.adjustment.quality.statistics import ALPHA, GlobalTest, component_tests
from sfm.report.findings.bundle_statistics import Statistics
from sfm.report.findings.checks import CheckedControl
from sfm.report.findings.given_residuals import Given
from sfm.report.findings.protocol import ControlCoordinate
from sfm.result import SurveyResult

Judged = list[tuple[bool, str]]  # whether the result cannot be depended on, and why


@dataclass(frozen=True)
class Evidence:
    """What a result is judged by."""

    result: SurveyResult
    statistics: Statistics
    given: Given
    check: CheckedControl | None
    object_size: float  # diagonal of the box around the points, object unit
    given_test: GivenTest | None = None  # of all that was given against the free network
    scale_difference: ScaleDifference | None = None  # of control and bars
    check_coordinates: tuple[ControlCoordinate, ...] = ()  # that took no part beside control
    control_apart: tuple[ControlApart, ...] = ()  # control that does not fit the free network as others

    @property
    def kind_tests(self) -> tuple[GlobalTest, ...]:
        """Tests of the kinds of observation at the level at which a remark is made."""
        return component_tests(self.statistics.kinds, alpha=2 * ALPHA)
