"""The verdict on a survey in plain words: good, with remarks, or not usable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sfm.adjustment.quality.held_camera import HeldParameter
from sfm.adjustment.quality.reliability import UNCONTROLLED
from sfm.adjustment.quality.statistics import ALPHA, GlobalTest, component_tests
from sfm.adjustment.quality.variance_components import IMAGE_POINTS
from sfm.conventions import MAD_TO_SIGMA
from sfm.report.findings.bundle_statistics import Statistics
from sfm.report.findings.checks import CheckedControl, LongestResidual, Sigma0
from sfm.report.findings.consistency import Consistency
from sfm.report.findings.given_residuals import Given, GivenResiduals, GivenValue
from sfm.report.findings.scale import given_test, scale_difference
from sfm.report.numbers import finer_unit, significant
from sfm.result import SurveyResult

MUCH_REJECTED = 0.05  # share of rejected image points above which a person should look
MANY_RAYS = 1 / 3  # share of the rays of a point: so many of them say something else than the result
FEW_RAYS = 2  # that are left of a point of which others were rejected check it no more
MAX_NAMES = 5  # points named in one remark
# sigma_px is a rough guess, so the global test alone says little. Twice the guess is worth a look; five
# times is no precision that anybody expected, but a wrong model, wrong names or wrong control.
SIGMA0_REMARK, SIGMA0_BAD = 2.0, 5.0
SIGMA0_LOW = 0.5  # the same times too cautious
AS_STATED = 1.5  # standard deviation of w by its median, up to which image points are about as stated
# Data snooping leaves nothing beyond 4 or 5 sigma; ten is an outlier, thirty is a mistake that was kept.
RESIDUAL_REMARK, RESIDUAL_BAD = 10.0, 30.0
WEIGHTED_REMARK, WEIGHTED_BAD = 5.0, 30.0  # w of control, scale bars, interior orientation
# An observation of a smaller redundancy number determines itself: what is left of its error is less than the
# rounding and the neglected second order of the others, and w magnifies that.
TESTABLE = 1e-3
# Differences at control that took no part, in sigmas. Control without standard deviations is a print or a
# drawing, never as good as the network; control that states them must keep to them.
CHECK_REMARK = 100.0
HELD_BAD = 5.0  # standard deviations by which a held camera moves the points (RMS): a wrong result
PRINCIPAL_POINT_REMARK = 0.1  # share of the diagonal; a decentred lens or sensor has 1 or 2 %
MISCLOSURE_BAD = 0.01  # of the size of the object, or of a length: no measurement, a mistake


@dataclass(frozen=True)
class Verdict:
    """What a person is told first."""

    level: Literal["good", "fair", "bad"]
    headline: str
    remarks: tuple[str, ...]  # what to look at or to know, one line each


@dataclass(frozen=True)
class Evidence:
    """What a result is judged by."""

    result: SurveyResult
    sigma0: Sigma0
    longest: LongestResidual
    statistics: Statistics
    given: Given
    check: CheckedControl | None
    object_size: float  # diagonal of the box around the points, object unit
    consistency: Consistency
    held: tuple[HeldParameter, ...] = ()  # interior parameters held at values that the photographs contradict

    @property
    def kind_tests(self) -> tuple[GlobalTest, ...]:
        """Tests of the kinds of observation at the level at which a remark is made."""
        return component_tests(self.statistics.kinds, alpha=2 * ALPHA)


def judge(evidence: Evidence) -> Verdict:
    """Judge a result by convergence, rank, sigma0, residuals, control, photographs and the comparison.

    Args:
        evidence: the result and what was found in it.

    Returns:
        `bad` if the adjustment did not converge, something cannot be determined, or the observations
        contradict one another; `fair` if there is something to look at; else `good`.
    """
    result = evidence.result
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
    remarks: list[str] = []
    kinds = (
        *(_sigma0, _residual, _untested, _rays, _consistency, _taken_out, _scale),
        *(_control, _bars, _interior, _held, _principal_point, _exterior, _kinds, _check),
    )
    for judge_kind in kinds:
        for is_bad, line in judge_kind(evidence):
            (serious if is_bad else remarks).append(line)
    if oriented < total:
        remarks.append(f"{total - oriented} of {total} photographs are not in the result.")
    rejected = int(a.rejected.sum())
    if len(a.rejected) and rejected > MUCH_REJECTED * len(a.rejected):
        remarks.append(f"{rejected} of {len(a.rejected)} image points were rejected.")
    if result.comparison is not None and not result.comparison.agree:
        remarks.append(f"{result.comparison.backend} does not agree with the adjustment.")
    if result.warnings:
        more = len(result.warnings) - 1
        other = f" ({more} more warning{'s' if more > 1 else ''}, see below)" if more else ""
        remarks.append(f"Warning: {result.warnings[0].rstrip('.')}{other}.")
    notes = (*_pessimistic(evidence), *_unchecked(evidence))
    if serious:
        return Verdict("bad", "The survey has no dependable result.", (*serious, *remarks, *notes))
    found = f"{oriented} of {total} photographs oriented, {len(a.network.points)} object points"
    if remarks:
        return Verdict("fair", f"The survey worked, with remarks: {found}.", (*remarks, *notes))
    return Verdict("good", f"The survey worked: {found}.", notes)


Judged = list[tuple[bool, str]]  # whether the result cannot be depended on, and why


def _sigma0(evidence: Evidence) -> Judged:
    """Judge sigma0 a posteriori over a priori."""
    ratio = evidence.sigma0.ratio
    if not ratio > SIGMA0_REMARK:
        return []
    line = (
        f"Sigma0 is {significant(ratio)} times the expected standard deviation of an image coordinate "
        f"({significant(evidence.sigma0.stated_px)} px): "
    )
    if ratio > SIGMA0_BAD:
        return [(True, line + "points, control or the camera contradict the photographs.")]
    return [(False, line + "see the residuals, or set sigma_px to what the photographs give.")]


def _residual(evidence: Evidence) -> Judged:
    """Judge the longest accepted residual."""
    worst = evidence.longest
    if not worst.over_sigma > RESIDUAL_REMARK:
        return []
    line = (
        f"Point {worst.point} in {worst.image} has a residual of {significant(worst.length_px)} px, "
        f"{significant(worst.over_sigma)} times the standard deviation, and was not rejected."
    )
    return [(worst.over_sigma > RESIDUAL_BAD, line)]


def _untested(evidence: Evidence) -> Judged:
    """Judge what the tests of single image coordinates show where the survey rejects nothing.

    Tau is blind where gross errors are so many that they make sigma0; w tells then, if the bulk of the
    image points is as good as stated.
    """
    if evidence.result.reject != "none":
        return []
    tests, w = [("tau", evidence.statistics.tau)], evidence.statistics.w
    if w.tested and MAD_TO_SIGMA * np.nanmedian(np.abs(w.statistic)) < AS_STATED:
        tests.append(("w", w))
    name, most = max(tests, key=lambda one: one[1].beyond)
    if not most.far_more:
        return []
    line = (
        f"{most.beyond} of {most.tested} image coordinates have |{name}| beyond {most.critical:.2f} "
        f'({most.expected:.1f} by chance), none was rejected: adjust.reject = "tau" takes out gross errors.'
    )
    return [(False, line)]


def _pessimistic(evidence: Evidence) -> tuple[str, ...]:
    """Say if the image points are far better than stated, which is no fault of the result."""
    sigma0, image = evidence.sigma0, evidence.kind_tests[0]
    if not (sigma0.ratio < SIGMA0_LOW and image.statistic < image.lower):
        return ()
    return (
        f"The stated standard deviation of the image points, {significant(sigma0.stated_px)} px, is "
        f"pessimistic: their residuals show {significant(sigma0.image_points_px)} px.",
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
    rays = np.bincount(a.network.image_points.point[~a.rejected], minlength=len(a.network.points))
    two = int((rays == 2).sum())
    if two:
        lines.append(
            f"{two} of {len(rays)} points have two rays: errors of their image points along the epipolar "
            "line are not found."
        )
    return tuple(lines)


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


def _held(evidence: Evidence) -> Judged:
    """Judge the interior parameters that were held: the clearest, since those that go with it follow."""
    if not evidence.held:
        return []
    worst, more = evidence.held[0], len(evidence.held) - 1
    unit = "" if worst.unit == "1" else f" {worst.unit}"
    others = f" {more} other{'s' if more > 1 else ''} would help as well." if more else ""
    line = (
        f"{worst.parameter} of camera {worst.camera} is held at {worst.value:.6g}{unit}; the photographs say "
        f"{worst.value + worst.change:.6g}{unit}, {significant(abs(worst.t))} standard deviations off, and "
        f"points are wrong by {significant(worst.moved)} of theirs (RMS): free it.{others}"
    )
    return [(worst.moved > HELD_BAD, line)]


def _principal_point(evidence: Evidence) -> Judged:
    """Judge adjusted principal points that lie where no lens has them."""
    judged: Judged = []
    for camera in evidence.result.adjustment.estimate.cameras:
        names = ("x0", "y0") if camera.in_mm else ("cx", "cy")
        x, y = (camera.value(name) for name in names)
        size = np.array(camera.size_px) * (camera.pixel_mm if camera.in_mm else 1.0)
        if not camera.in_mm:
            x, y = x - (camera.size_px[0] - 1) / 2, y - (camera.size_px[1] - 1) / 2
        away = float(np.hypot(x, y) / np.linalg.norm(size))
        if away > PRINCIPAL_POINT_REMARK and camera.free[[camera.names.index(name) for name in names]].any():
            line = (
                f"The principal point of camera {camera.name} was adjusted to {significant(100 * away)} % of "
                "the diagonal of the photograph from its centre, farther than lenses have it: the network "
                "hardly determines it, hold it or add photographs turned by 90 degrees."
            )
            judged.append((False, line))
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


def _remarkable(found: GivenResiduals | None) -> tuple[GivenValue, ...]:
    """Return the given value with the largest |w| if that is worth a remark."""
    if found is None:
        return ()
    tested = (one for one in found.by_w if np.isfinite(one.w) and not one.r < TESTABLE)
    return tuple(one for one in tested if abs(one.w) > WEIGHTED_REMARK)[:1]


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


def _rays(evidence: Evidence) -> Judged:
    """Judge the points that lost many of their rays to rejection, or all but two."""
    adjustment = evidence.result.adjustment
    network, rejected = adjustment.network, adjustment.rejected
    n, point = len(network.points), network.image_points.point
    lost, rays = np.bincount(point[rejected], minlength=n), network.rays()
    most = np.flatnonzero((lost > 0) & ((lost >= MANY_RAYS * rays) | (rays - lost <= FEW_RAYS)))
    if not len(most):
        return []
    shown = ", ".join(f"{network.points[j]} ({lost[j]} of {rays[j]})" for j in most[:MAX_NAMES])
    more = " ..." if len(most) > MAX_NAMES else ""
    line = f"A third of the rays or more were rejected, or only two are left, of {len(most)} point(s)"
    return [(False, f"{line}: {shown}{more}.")]


def _consistency(evidence: Evidence) -> Judged:
    """Judge the tests inside the result: points, photographs, the format."""
    found, result = evidence.consistency, evidence.result
    lines = []
    for one in found.two_positions[:MAX_NAMES]:
        factor, unit = finer_unit(result.length_unit, one.distance)
        lines.append(
            f"Point {one.point} is at two positions, {significant(factor * one.distance)} {unit} apart "
            f"({significant(one.over_sigma)} standard deviations): one in {len(one.first)} photographs from "
            f"{one.first[0]} on, the other in {len(one.second)} from {one.second[0]} on. It moved, or two "
            "bear its name."
        )
    if len(found.two_positions) > MAX_NAMES:
        lines.append(f"{len(found.two_positions) - MAX_NAMES} more points are at two positions.")
    if found.large:
        more = " ..." if len(found.large) > MAX_NAMES else ""
        lines.append(
            f"The residuals of {len(found.large)} point(s) are together larger than chance: "
            f"{', '.join(found.large[:MAX_NAMES])}{more}."
        )
    uneven = found.uneven
    if uneven is not None:
        lines.append(
            f"The photographs are not alike (Bartlett's test, p {uneven.probability:.1g}): sigma0 of "
            f"{uneven.worst} is {significant(uneven.largest / uneven.median)} times the median."
        )
    lines += [
        f"The residuals of camera {one.camera} depend on the place in the photograph "
        f"(p {one.probability:.1g}): its cells explain {100 * one.explained:.0f} % of their squares, the "
        f"longest mean is {significant(one.largest_px)} px."
        for one in found.patterns
    ]
    return [(False, line) for line in lines]


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
    test = given_test(evidence.result)
    if test is not None and test.probability < ALPHA:
        line = (
            f"What was given beside the image points contradicts them: F {significant(test.statistic)} with "
            f"{test.redundancy} degrees of freedom, by chance in fewer than {100 * ALPHA:g} % of surveys."
        )
        judged.append((False, line))
    found = scale_difference(evidence.result)
    if found is None or not found.over_sigma > WEIGHTED_REMARK:
        return judged
    line = (
        f"Lengths by the control are {significant(100 * found.relative)} % larger than by the scale bars, "
        f"{significant(found.over_sigma)} times the standard deviation of that difference."
    )
    return [*judged, (found.over_sigma > WEIGHTED_BAD, line)]


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


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
