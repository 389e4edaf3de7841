"""Acceptance test of a measuring system with calibrated lengths: VDI/VDE 2634 part 1.

The error of a length measurement is the measured minus the calibrated length. The limit of its absolute value
is A + K L, and at most B. ISO 14253-1 decides whether conformity is proven, given the uncertainty of the
calibration. Requirements of part 1 that the data do not meet are listed. This is not a test by ISO 10360-13,
which applies to area scanners.

Source: VDI/VDE 2634 part 1 (2002), Optical 3D measuring systems: imaging systems with point-by-point probing,
secs. 3 and 4; ISO 14253-1:2017.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.files.csv_tables import read_table
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError, SurveyFileError, UnknownNameError
from sfm.model.remarks.remark import Remark, remark
from sfm.model.remarks.verdict import Level, Verdict, judge
from sfm.model.solution import Solution
from sfm.products.geometry.measured import distance, measured_points, point_function
from sfm.products.geometry.tolerance import COVERAGE, OUT, UNDECIDED, UNKNOWN, decide

MIN_LINES = 7
MIN_LENGTHS = 5  # on a line
MIN_LONGEST = 2 / 3  # of the body diagonal of the measuring volume
SAME_DIRECTION_DEG = 5.0  # lines with a smaller angle have the same direction
HEADLINES: Mapping[Level, str] = {
    "good": "The limit is kept: all lengths are proven to be inside.",
    "fair": "It is not proven by a complete test that the limit is kept.",
    "bad": "The limit is not kept.",
}


@dataclass(frozen=True)
class CalibratedLengths:
    """Calibrated lengths between targets."""

    line: tuple[str, ...]  # measuring line of each length, (k,)
    start: tuple[str, ...]  # names of points
    end: tuple[str, ...]
    length: FloatArray  # object unit, (k,)
    sigma: FloatArray  # standard deviation of the calibration, object unit; NaN if not stated, (k,)


@dataclass(frozen=True)
class LengthLimit:
    """Limit A + K L of the error of a length L, at most B.

    Raises:
        GeometryError: A or K is negative, or both are 0, or B is not above 0.
    """

    a: float  # object unit
    k: float  # pure number
    b: float = np.inf  # object unit

    def __post_init__(self) -> None:
        """Refuse an impossible limit."""
        if not (self.a >= 0 and self.k >= 0 and self.a + self.k > 0 and self.b > 0):
            raise GeometryError(
                f"limit: A = {self.a:g}, K = {self.k:g}, B = {self.b:g}, expected A and K not negative, one "
                "above 0"
            )


@dataclass(frozen=True)
class Acceptance:
    """Errors of length measurement, and the decision on each."""

    name: str  # of the result
    unit: str
    lengths: CalibratedLengths
    error: FloatArray  # measured minus calibrated, object unit, (k,)
    sigma: FloatArray  # of the measured lengths from the network's covariance; NaN if unknown, (k,)
    limit: FloatArray  # A + K L, at most B, object unit, (k,)
    a: float  # object unit
    k: float  # pure number
    b: float  # object unit; infinite without B
    coverage: float  # k of U = k sigma of the calibration
    decision: tuple[str, ...]  # in | out | undecided | not known, of each length
    diagonal: float  # of the measuring volume, object unit
    lacking: tuple[Remark, ...]  # requirements of part 1 that the data do not meet

    def count(self, decision: str) -> int:
        """Return the number of lengths with a decision."""
        return self.decision.count(decision)

    @property
    def largest(self) -> float:
        """Largest absolute error, object unit."""
        return float(np.abs(self.error).max())

    @property
    def verdict(self) -> Verdict:
        """The verdict: good if conformity is proven and nothing is lacking, else fair or bad.

        It is bad if an error is proven to exceed the limit, or exceeds it without a known uncertainty.
        """
        unknown = np.array([decision == UNKNOWN for decision in self.decision])
        exceeding = int((unknown & (np.abs(self.error) > self.limit)).sum())
        total, undecided = len(self.error), self.count(UNDECIDED)
        out, without = self.count(OUT) + exceeding, int(unknown.sum()) - exceeding
        decided = []
        if out:
            decided.append(remark("out_of_tolerance", out=out, total=total, unknown=exceeding or None))
        if undecided:
            decided.append(remark("tolerance_undecided", undecided=undecided, total=total))
        if without:
            decided.append(remark("tolerance_unknown", unknown=without, total=total))
        return judge((*decided, *self.lacking, remark("temperature_unknown")), HEADLINES)


def read_lengths(path: Path) -> CalibratedLengths:
    """Read calibrated lengths: line,from,to,length[,sigma].

    Raises:
        SurveyFileError: something is wrong; the message has file and line number.
    """
    table = read_table(path, ("line", "from", "to"), ("length",), ("sigma",), blank=("sigma",))
    lines, start, end = table.texts
    table.refuse(table.values[:, :1], table.values[:, :1] <= 0, ("length",), "more than 0")
    sigma = table.values[:, 1:]
    table.refuse(sigma, sigma <= 0, ("sigma",), "more than 0, or nothing")
    for k, (a, b) in enumerate(zip(start, end, strict=True)):
        if a == b:
            raise SurveyFileError(f"{table.place(k)}: both ends are point {a}, two points are needed")
    table.refuse_duplicates(
        tuple(tuple(sorted(pair)) for pair in zip(start, end, strict=True)), ("from", "to")
    )
    known = sigma[:, 0] if sigma.size else np.full(len(lines), np.nan)
    return CalibratedLengths(lines, start, end, table.values[:, 0].copy(), known)


def accept_result(
    result: Solution,
    lengths: CalibratedLengths,
    limit: LengthLimit,
    *,
    bars: Sequence[str] | None,
    control: Sequence[str] = (),
    coverage: float = COVERAGE,
    diagonal: float | None = None,
) -> Acceptance:
    """Test a result against calibrated lengths.

    Args:
        result: result of a survey with a scale from other bars.
        lengths: calibrated lengths between points of the result.
        limit: limit of the error of a length.
        bars: "start - end" of the scale bars that gave the scale; None if unknown.
        control: names of control points that gave the scale.
        coverage: k of the expanded uncertainty of the calibration.
        diagonal: diagonal of the measuring volume, object unit; that of the box around all points if not
            given.

    Raises:
        GeometryError: no scale, or a scale from the tested lengths.
        UnknownNameError: an end of a length is not in the result.
    """
    points = measured_points(result)
    if not points.has_scale:
        raise GeometryError(
            f"{result.name}: its scale is undefined; a test of lengths needs a scale from other bars"
        )
    for name in (*lengths.start, *lengths.end):
        if name not in points.names:
            raise UnknownNameError(f"lengths: point {name} is not in the result {result.name}")
    _refuse_tested_scale(result.name, lengths, bars, control)
    functions = [
        distance(point_function(points, start), point_function(points, end))
        for start, end in zip(lengths.start, lengths.end, strict=True)
    ]
    measured = np.array([function.value[0] for function in functions])
    variance = np.array([points.covariance_between([function])[0, 0] for function in functions])
    error = measured - lengths.length
    largest = np.minimum(limit.a + limit.k * lengths.length, limit.b)
    # |error| is scaled so that the limit of each length is 1
    decision = decide(np.abs(error) / largest, lengths.sigma / largest, -np.inf, 1.0, coverage)
    if diagonal is None:  # of the smaller box: along the axes of the system, or along the object's axes
        _, _, principal = np.linalg.svd(points.xyz - points.xyz.mean(axis=0), full_matrices=False)
        boxes = [np.ptp(points.xyz @ axes.T, axis=0) for axes in (np.eye(3), principal)]
        diagonal = float(min(np.linalg.norm(box) for box in boxes))
    directions = np.array(
        [
            points.xyz[points.index(end)] - points.xyz[points.index(start)]
            for start, end in zip(lengths.start, lengths.end, strict=True)
        ]
    )
    return Acceptance(
        result.name,
        result.unit,
        lengths,
        error,
        np.sqrt(np.maximum(variance, 0.0)),
        largest,
        limit.a,
        limit.k,
        limit.b,
        coverage,
        decision,
        diagonal,
        tuple(_unmet_requirements(lengths, directions, diagonal, result.unit)),
    )


def _refuse_tested_scale(
    name: str, lengths: CalibratedLengths, bars: Sequence[str] | None, control: Sequence[str]
) -> None:
    """Refuse lengths on a bar or between control points that gave the scale."""
    if bars is None or not (bars or control):
        raise GeometryError(
            f"{name}: the origin of its scale is not stated, it must come from other bars than those tested"
        )
    given, fixed = set(bars), set(control)
    for line in dict.fromkeys(lengths.line):
        rows = [k for k, owner in enumerate(lengths.line) if owner == line]
        ends = sorted({end for k in rows for end in (lengths.start[k], lengths.end[k])})
        for i in ends:
            for j in ends:
                if i != j and f"{i} - {j}" in given:
                    raise GeometryError(
                        f"line {line}: bar {i} - {j} gave the scale of the result, it must come from other "
                        "bars than those tested"
                    )
        for k in rows:
            if lengths.start[k] in fixed and lengths.end[k] in fixed:
                raise GeometryError(
                    f"line {line}: {lengths.start[k]} and {lengths.end[k]} are control points of the result, "
                    "its scale must come from elsewhere"
                )


def _unmet_requirements(
    lengths: CalibratedLengths, directions: FloatArray, diagonal: float, unit: str
) -> list[Remark]:
    """Return remarks on requirements of part 1 that the data do not meet."""
    lines = list(dict.fromkeys(lengths.line))
    lacking = []
    if len(lines) < MIN_LINES:
        lacking.append(remark("lengths_lacking", lines=len(lines), needed=MIN_LINES))
    of_line: dict[str, FloatArray] = {}
    for line in lines:
        rows = np.array([k for k, owner in enumerate(lengths.line) if owner == line])
        if len(rows) < MIN_LENGTHS:
            lacking.append(remark("lengths_lacking", line=line, lengths=len(rows), needed=MIN_LENGTHS))
        longest = directions[rows[np.argmax(lengths.length[rows])]]
        of_line[line] = longest / np.linalg.norm(longest)
        off = np.linalg.norm(np.cross(directions[rows], of_line[line]), axis=1)
        if (off > np.sin(np.deg2rad(SAME_DIRECTION_DEG)) * np.linalg.norm(directions[rows], axis=1)).any():
            lacking.append(remark("line_not_straight", line=line))
    for i, first in enumerate(lines):
        for second in lines[i + 1 :]:
            cosine = min(1.0, abs(float(of_line[first] @ of_line[second])))
            if np.rad2deg(np.arccos(cosine)) < SAME_DIRECTION_DEG:
                lacking.append(remark("lengths_lacking", parallel=(first, second)))
    longest = float(lengths.length.max())
    if longest < MIN_LONGEST * diagonal:
        lacking.append(remark("lengths_lacking", longest=(longest, unit), diagonal=(diagonal, unit)))
    return lacking
