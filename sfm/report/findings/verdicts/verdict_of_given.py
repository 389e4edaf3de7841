"""What the verdict says of what was given beside the image points: control, bars, cameras, orientation."""

from __future__ import annotations

import numpy as np

from sfm.adjustment.quality.reliability import UNCONTROLLED
from sfm.adjustment.quality.statistics import ALPHA
from sfm.adjustment.quality.variance_components import IMAGE_POINTS
from sfm.display import listed
from sfm.remarks.remark import Remark, remark
from sfm.report.findings.given_residuals import GivenResiduals, GivenValue
from sfm.report.findings.verdicts.evidence import Evidence, Judged
from sfm.report.numbers import finer_unit, significant

WEIGHTED_REMARK, WEIGHTED_BAD = 5.0, 30.0  # w of control, scale bars, interior orientation
# An observation of a smaller redundancy number determines itself: what is left of its error is less than the
# rounding and the neglected second order of the others, and w magnifies that.
TESTABLE = 1e-3
# Differences at control that took no part, in sigmas. Control without standard deviations is a print or a
# drawing, never as good as the network; control that states them must keep to them.
CHECK_REMARK = 100.0
MISCLOSURE_BAD = 0.01  # of the size of the object, or of a length: no measurement, a mistake


def remarks_on_given(evidence: Evidence) -> tuple[Remark, ...]:
    """Return remarks on everything that was given, kind by kind."""
    kinds = (
        *(_taken_out, _scale, _control_apart, _control, _bars, _interior),
        *(_exterior, _kinds, _check, _check_coordinates),
    )
    judged = [one for judge_kind in kinds for one in judge_kind(evidence)]
    return (
        *(
            remark("given_contradicted" if is_bad else "given_remarkable", line=line.rstrip("."))
            for is_bad, line in judged
        ),
        *(remark("given_unchecked", line=line.rstrip(".")) for line in _unchecked(evidence)),
    )


def _unchecked(evidence: Evidence) -> tuple[str, ...]:
    """Say what nothing in the survey checks, which is no fault that anybody could see in the result."""
    result, a = evidence.result, evidence.result.adjustment
    lines = []
    bars, free = evidence.given.bars, result.free_network
    if bars is not None and not (bars.r > UNCONTROLLED).any():
        which = f"scale bar {bars.names[0]}" if len(bars.names) == 1 else "scale bars"
        lines.append(f"The scale rests on the {which}, which nothing checks.")
    if a.datum == "control" and free is not None and len(a.network.control):
        added = a.redundancy - free.redundancy
        if added <= 0:
            lines.append("Position, attitude and scale rest on the control, which nothing checks.")
    return tuple(lines)


def _taken_out(evidence: Evidence) -> Judged:
    """Judge control and bars that were not used: as if they were kept, or worse where nothing is resolved."""
    judged: Judged = []
    for one in evidence.result.taken_out:
        if not one.resolved:
            judged.append(
                (True, f"{_capital(one.what)} was not used: what it contradicts may be what is wrong.")
            )
        elif one.relative > MISCLOSURE_BAD:
            off = significant(100 * one.relative)
            judged.append((True, f"{_capital(one.what)} was not used: it is {off} % off."))
    return judged


def _scale(evidence: Evidence) -> Judged:
    """Judge the scale of the bars against that of the control, and all that was given by the F-test."""
    judged: Judged = []
    test = evidence.given_test
    if test is not None and test.probability < ALPHA:
        line = (
            f"What was given beside the image points contradicts them: F {significant(test.statistic)} with "
            f"{test.redundancy} degrees of freedom, by chance in fewer than {100 * ALPHA:g} % of surveys."
        )
        judged.append((False, line))
    found = evidence.scale_difference
    if found is None or not found.over_sigma > WEIGHTED_REMARK:
        return judged
    line = (
        f"Lengths by the control are {significant(100 * found.relative)} % larger than by the scale bars, "
        f"{significant(found.over_sigma)} times the standard deviation of that difference."
    )
    return [*judged, (found.over_sigma > WEIGHTED_BAD or abs(found.relative) > MISCLOSURE_BAD, line)]


def _control_apart(evidence: Evidence) -> Judged:
    """Judge the control points that do not fit the shape that the image points give: a mistake, or moved."""
    found = evidence.control_apart
    if not found:
        return []
    factor, unit = finer_unit(evidence.result.length_unit, found[0].distance)
    shown = listed(f"{one.point} ({significant(factor * one.distance)} {unit})" for one in found)
    line = (
        f"{len(found)} control point(s) do not fit the photographs as the others do: {shown}; correct "
        "them or take them out."
    )
    part = found[0].distance / evidence.object_size
    return [(found[0].over_sigma > WEIGHTED_BAD or part > MISCLOSURE_BAD, line)]


def _control(evidence: Evidence) -> Judged:
    """Judge the residuals of weighted control."""
    return [
        (
            abs(worst.w) > WEIGHTED_BAD,
            f"Control point {worst.name} differs from its given coordinates by {significant(abs(worst.w))} "
            "times the standard deviation of that difference.",
        )
        for worst in _remarkable(evidence.given.control)
    ]


def _bars(evidence: Evidence) -> Judged:
    """Judge the residuals of scale bars."""
    judged: Judged = []
    for worst in _remarkable(evidence.given.bars):
        relative = abs(worst.difference / worst.given)
        line = (
            f"Scale bar {worst.name} differs from its given length by {significant(abs(worst.w))} "
            f"times the standard deviation of that difference ({significant(100 * relative)} %)."
        )
        judged.append((abs(worst.w) > WEIGHTED_BAD or relative > MISCLOSURE_BAD, line))
    return judged


def _interior(evidence: Evidence) -> Judged:
    """Judge the residuals of weighted interior orientation, as of a calibration certificate."""
    judged: Judged = []
    for worst in _remarkable(evidence.given.interior):
        unit = "" if worst.unit == "1" else f" {worst.unit}"
        line = (
            f"The given {worst.name}, {worst.given:.6g}{unit}, differs from the adjusted one by "
            f"{significant(abs(worst.w))} times the standard deviation of that difference."
        )
        judged.append((abs(worst.w) > WEIGHTED_BAD, line))
    return judged


def _exterior(evidence: Evidence) -> Judged:
    """Judge the residuals of observed exterior orientation."""
    return [
        (
            abs(worst.w) > WEIGHTED_BAD,
            f"The given {worst.coordinate} of photograph {worst.name} differs from the adjusted one by "
            f"{significant(abs(worst.w))} times the standard deviation of its residual.",
        )
        for found in (evidence.given.position, evidence.given.rotation)
        for worst in _remarkable(found)
    ]


def _kinds(evidence: Evidence) -> Judged:
    """Judge control, bars and interior orientation as a whole by their variance components."""
    found = evidence.statistics.kinds
    judged: Judged = []
    for g, test in enumerate(evidence.kind_tests):
        if test.of == IMAGE_POINTS or found.count[g] < 2 or not test.statistic > test.upper:
            continue
        line = (
            f"The residuals of the {test.of} are {significant(float(found.sigma0[g]))} times what the "
            f"standard deviations stated for them give, more than chance (redundancy {test.redundancy:.1f})."
        )
        judged.append((False, line))
    return judged


def _check(evidence: Evidence) -> Judged:
    """Judge the differences at control that took no part."""
    found = evidence.check
    if found is None:
        return []
    judged: Judged = []
    check, result = found.check, evidence.result
    if result.adjustment.network.scale_bars and abs(check.scale - 1) > MISCLOSURE_BAD:
        line = f"The control says lengths are {check.scale:.6g} times those of the scale bars."
        judged.append((True, line))

    def differs(point: int) -> str:
        factor, unit = finer_unit(result.length_unit, float(found.length[point]))
        apart = significant(float(found.length[point]) * factor)
        return f"Control point {check.points[point]} differs from its given place by {apart} {unit}"

    part = float(found.length[found.worst]) / evidence.object_size
    beyond = np.nan_to_num(found.over_sigma) / np.where(found.stated, WEIGHTED_REMARK, CHECK_REMARK)
    if part > MISCLOSURE_BAD:
        judged.append((True, f"{differs(found.worst)}, {significant(100 * part)} % of the object."))
    elif beyond.max(initial=0.0) > 1:
        worst = int(np.argmax(beyond))
        line = (
            f"{differs(worst)}, {significant(float(found.over_sigma[worst]))} times the standard deviation "
            f"of {'both' if found.stated[worst] else 'its adjusted place'} in a coordinate."
        )
        judged.append((False, line))
    return judged


def _check_coordinates(evidence: Evidence) -> Judged:
    """Judge the single coordinates that check a datum of control: the worst in its standard deviations."""
    tested = [one for one in evidence.check_coordinates if np.isfinite(one.test)]
    worst = max(tested, key=lambda one: abs(one.test), default=None)
    if worst is None or not abs(worst.test) > WEIGHTED_REMARK:
        return []
    factor, unit = finer_unit(evidence.result.length_unit, abs(worst.difference))
    line = (
        f"{worst.coordinate} of check point {worst.point} differs from its given value by "
        f"{significant(factor * abs(worst.difference))} {unit}, {significant(abs(worst.test))} times the "
        "standard deviation of both."
    )
    return [(abs(worst.test) > WEIGHTED_BAD, line)]


def _remarkable(found: GivenResiduals | None) -> tuple[GivenValue, ...]:
    """Return the given value with the largest |w| if that is worth a remark."""
    if found is None:
        return ()
    tested = (one for one in found.by_w if np.isfinite(one.w) and not one.r < TESTABLE)
    return tuple(one for one in tested if abs(one.w) > WEIGHTED_REMARK)[:1]


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
