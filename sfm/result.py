"""SurveyResult: everything that a survey ends with, as the report needs it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sfm.adjustment.quality.correlations import OrientationCorrelation
from sfm.adjustment.result import Adjustment
from sfm.comparison.adjusters import AdjusterComparison
from sfm.comparison.baseline import BaselineComparison
from sfm.conventions import FloatArray, IntArray
from sfm.targets.flags import count_flags

NO_SCALE = "network units"


@dataclass(frozen=True)
class FailedImage:
    """A photograph that is not part of the result."""

    image: str  # name of the photograph
    reason: str  # one line: what was found and what was needed


@dataclass(frozen=True)
class StageTime:
    """How long a stage took."""

    stage: str
    seconds: float


@dataclass(frozen=True)
class PhotographTargets:
    """What was measured and what was rejected in one photograph, for its overlay."""

    image: str  # name of the photograph
    path: Path  # its file
    xy: FloatArray  # centres of the measured targets, pixel frame, px, (k, 2)
    semi_axes: FloatArray  # of their outlines, larger first, px, (k, 2)
    angle: FloatArray  # of the larger semi-axis from x towards y, rad, (k,)
    rejected_xy: FloatArray  # centres of the rejected candidates, px, (r, 2)
    rejected_flag: IntArray  # reason for each rejection, see sfm.targets.flags.Flag, (r,)
    flag: IntArray | None = None  # remarks on the measured targets, see sfm.targets.flags.Flag, (k,)
    stored: bool = False  # whether the targets were measured in an earlier run

    def reasons(self) -> list[tuple[str, int]]:
        """Return (reason, number of candidates) of this photograph, most frequent first."""
        return [(in_words(name), count) for name, count in count_flags(self.rejected_flag)]


@dataclass(frozen=True)
class ControlCheck:
    """Differences at control that took no part in the adjustment, after placing the result on it."""

    points: tuple[str, ...]  # names of the control points that were measured, (n,)
    differences: FloatArray  # placed minus nominal X, Y, Z, object unit, (n, 3)
    scale: float  # of the control over the adjusted network; 1 where the scale came from the control

    @property
    def rms(self) -> FloatArray:
        """Root mean square difference in X, Y, Z, object unit, (3,)."""
        return np.asarray(np.sqrt((self.differences**2).mean(axis=0)))


@dataclass(frozen=True)
class Eccentricity:
    """By how much image points were corrected because a circle's centre is not its ellipse's centre."""

    largest_px: float  # longest correction, px
    rms_px: float  # root mean square per coordinate, px
    sigma_px: float  # root mean square of the standard deviations of a corrected coordinate, px


@dataclass(frozen=True)
class SurveyResult:
    """Result of a survey: the adjustment and what a person must know to judge it."""

    survey: str  # name of the survey
    unit: str  # object unit
    images_total: int  # photographs that the survey names
    failed: tuple[FailedImage, ...]  # those that could not be read or oriented, with the reason
    adjustment: Adjustment  # in the datum and on the control that the survey asks for
    code: IntArray  # code number of each point of adjustment.network, -1 = uncoded, (n,)
    comparison: AdjusterComparison | None  # with the other adjuster; None if the survey asks for none
    baseline: BaselineComparison | None = None  # another pipeline on the photographs; None likewise
    photographs: tuple[PhotographTargets, ...] = ()  # of every readable photograph; none with [observations]
    control_check: ControlCheck | None = None  # None without control, or where the datum is control
    warnings: tuple[str, ...] = ()  # one line each, in words
    eccentricity: Eccentricity | None = None  # None where it was not corrected
    no_circles: tuple[str, ...] = ()  # uncoded points left out: their outlines are not images of one circle
    orientation_correlations: tuple[OrientationCorrelation, ...] = ()  # of camera parameters with exterior
    # orientation, the strong ones
    seconds: tuple[StageTime, ...] = field(default_factory=tuple)  # in the order of the stages
    reject: str = "tau"  # how the survey treats gross errors: tau | huber | tukey | none

    @property
    def has_scale(self) -> bool:
        """Whether lengths are in the object unit: from control, from scale bars, or placed on control."""
        a = self.adjustment
        return a.datum == "control" or len(a.network.scale_bars) > 0 or len(a.network.control) >= 2

    @property
    def length_unit(self) -> str:
        """What lengths are measured in: the object unit, or nothing that anybody knows."""
        return self.unit if self.has_scale else NO_SCALE


def in_words(flag_name: str) -> str:
    """Return the name of a flag in words, such as `cut by border`."""
    return flag_name.replace("_", " ")
