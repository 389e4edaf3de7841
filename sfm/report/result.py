"""SurveyResult: everything that a survey ends with, as the report needs it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.analysis.comparison import Comparison
from sfm.conventions import FloatArray, IntArray
from sfm.targets.flags import Flag


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
    direction: FloatArray  # of the larger semi-axis from x towards y (clockwise in the picture), rad, (k,)
    rejected_xy: FloatArray  # centres of the rejected candidates, px, (r, 2)
    rejected_flags: IntArray  # reason for each rejection, targets.flags.Flag, (r,)

    def reasons(self) -> list[tuple[str, int]]:
        """Return (reason, number of candidates) of this photograph, most frequent first."""
        counts = [
            (words_of_flag(flag), int(((self.rejected_flags & flag.value) != 0).sum()))
            for flag in Flag
            if flag.value
        ]
        return sorted((c for c in counts if c[1]), key=lambda c: (-c[1], c[0]))


@dataclass(frozen=True)
class ControlCheck:
    """Differences at control that took no part in the adjustment, after placing the result on it."""

    points: tuple[str, ...]  # names of the control points that were measured, (n,)
    differences: FloatArray  # placed minus nominal X, Y, Z, object unit, (n, 3)
    scale: float  # by which the adjusted network was multiplied

    @property
    def rms(self) -> FloatArray:
        """Root mean square difference in X, Y, Z, object unit, (3,)."""
        return np.asarray(np.sqrt((self.differences**2).mean(axis=0)))


@dataclass(frozen=True)
class SurveyResult:
    """Result of a survey: the adjustment and what a person must know to judge it."""

    survey: str  # name of the survey
    unit: str  # object unit
    images_total: int  # photographs that the survey names
    failed: tuple[FailedImage, ...]  # those that could not be read or oriented, with the reason
    adjustment: Adjustment  # in the datum and on the control that the survey asks for
    code: IntArray  # code number of each point of adjustment.network, -1 = uncoded, (n,)
    comparison: Comparison | None  # None if the survey asks for none
    photographs: tuple[PhotographTargets, ...] = ()  # of every readable photograph; none with [observations]
    control_check: ControlCheck | None = None  # None without control, or where the datum is control
    warnings: tuple[str, ...] = ()  # one line each, in words
    seconds: tuple[StageTime, ...] = field(default_factory=tuple)  # in the order of the stages


def words_of_flag(flag: Flag) -> str:
    """Return the name of a flag in words, such as `cut by border`."""
    return str(flag.name).lower().replace("_", " ")
