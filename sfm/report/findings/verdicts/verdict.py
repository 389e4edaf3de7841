"""The verdict on a survey in plain words: good, with remarks, or not usable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sfm.adjustment.quality.reliability import UNCONTROLLED
from sfm.conventions import MAD_TO_SIGMA
from sfm.display import MAX_LISTED, listed, program_name
from sfm.report.findings.other_adjuster import words_of_better_fit
from sfm.report.findings.verdicts.evidence import Evidence, Judged
from sfm.report.findings.verdicts.verdict_of_given import free_line, judge_given
from sfm.report.numbers import finer_unit, significant

MUCH_REJECTED = 0.05  # share of rejected image points above which a person should look
MANY_RAYS = 1 / 3  # share of the rays of a point: so many of them say something else than the result
FEW_RAYS = 2  # that are left of a point of which others were rejected check it no more
MAX_SOLUTIONS = 2  # of about the same v'Pv that are told
SOLUTION_BAD = 3.0  # standard deviations by which points differ in another solution: theirs say nothing then
# sigma_px is a rough guess, so the global test alone says little. Twice the guess is worth a look; five
# times is no precision that anybody expected, but a wrong model, wrong names or wrong control.
SIGMA0_REMARK, SIGMA0_BAD = 2.0, 5.0
SIGMA0_LOW = 0.5  # the same times too cautious
AS_STATED = 1.5  # standard deviation of w by its median, up to which image points are about as stated
EXPLAINED_BAD = 5.0  # standard deviations by which points move (RMS) with what explains the residuals: wrong
# Data snooping leaves nothing beyond 4 or 5 sigma; ten is an outlier, thirty is a mistake that was kept.
RESIDUAL_REMARK, RESIDUAL_BAD = 10.0, 30.0


@dataclass(frozen=True)
class Verdict:
    """What a person is told first."""

    level: Literal["good", "fair", "bad"]
    headline: str
    remarks: tuple[str, ...]  # what to look at or to know, one line each


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
    if 2 * oriented < total:
        serious.append(
            f"The larger part of the photographs, {total - oriented} of {total}, is not in the result."
        )
    serious += [f"Not decided: {line}." for line in result.undecided]
    remarks: list[str] = []
    kinds = (_other_solutions, _sigma0, _residual, _untested, _rays, _consistency, judge_given)
    for judge_kind in kinds:
        for is_bad, line in judge_kind(evidence):
            (serious if is_bad else remarks).append(line)
    if oriented < total <= 2 * oriented:
        remarks.append(f"{total - oriented} of {total} photographs are not in the result.")
    rejected = int(a.rejected.sum())
    if len(a.rejected) and rejected > MUCH_REJECTED * len(a.rejected):
        remarks.append(f"{rejected} of {len(a.rejected)} image points were rejected.")
    if result.comparison is not None and not result.comparison.agree:
        remarks.append(f"{program_name(result.comparison.backend)} does not agree with the adjustment.")
    if better := words_of_better_fit(result.comparison):
        remarks.append(better)
    if result.warnings:
        more = len(result.warnings) - 1
        other = f" ({more} more warning{'s' if more > 1 else ''}, see below)" if more else ""
        remarks.append(f"Warning: {result.warnings[0].rstrip('.')}{other}.")
    notes = (*result.notes, *_pessimistic(evidence), *_unchecked(evidence))
    if serious:
        return Verdict("bad", "The survey has no dependable result.", (*serious, *remarks, *notes))
    found = f"{oriented} of {total} photographs oriented, {len(a.network.points)} object points"
    if remarks:
        return Verdict("fair", f"The survey worked, with remarks: {found}.", (*remarks, *notes))
    return Verdict("good", f"The survey worked: {found}.", notes)


def _other_solutions(evidence: Evidence) -> Judged:
    """Judge whether the image points allow another solution: which of them is true they do not say."""
    judged = []
    farthest = sorted(evidence.result.other_solutions, key=lambda one: -one.moved)
    for other in farthest[:MAX_SOLUTIONS]:
        what = (
            "turned inside out in depth"
            if other.reflected
            else f"with c of camera {other.camera} at {other.c:.5g} {other.unit}"
        )
        line = (
            f"Another solution, {what}, fits as well (v'Pv {other.vPv:.3g} times that of the result), and "
            f"its points differ by {significant(other.moved)} times their standard deviations (RMS): hold c "
            "at a calibrated value, or add photographs at larger angles and other distances."
        )
        judged.append((other.moved > SOLUTION_BAD, line))
    return judged


def _sigma0(evidence: Evidence) -> Judged:
    """Judge sigma0 a posteriori over a priori."""
    ratio = evidence.sigma0.ratio
    tried = evidence.result.explanations
    if tried and tried[0].explains:
        cause = tried[0]
        is_wrong = cause.moved > EXPLAINED_BAD
        explained = (
            f"sigma0 of all image points falls from {significant(cause.before_px)} to "
            f"{significant(cause.after_px)} px with {cause.cause}, most likely that is what does not fit"
        )
        if np.isfinite(cause.moved):
            explained += f"; points then differ by {significant(cause.moved)} standard deviations (RMS)"
        explained += "."
        if not ratio > SIGMA0_REMARK:
            return [(is_wrong, explained[0].upper() + explained[1:])]
    elif not ratio > SIGMA0_REMARK:
        return []
    line = (
        f"Sigma0 is {significant(ratio)} times the expected standard deviation of an image coordinate "
        f"({significant(evidence.sigma0.stated_px)} px): "
    )
    if tried and tried[0].explains and not evidence.held:
        return [(is_wrong or ratio > SIGMA0_BAD, line + explained)]
    cameras = evidence.result.adjustment.estimate.cameras
    if evidence.held:
        line += "most likely the camera, which is held at values that do not fit."
        is_bad = ratio > SIGMA0_BAD
        if tried and tried[0].explains:
            line, is_bad = f"{line[:-1]}; {explained}", is_bad or is_wrong
        return [(is_bad, line)]
    if ratio > SIGMA0_BAD:
        held = "" if any(one.free.any() for one in cameras) else f" (it is held: try {free_line(evidence)})"
        return [(True, f"{line}points, control or the camera{held} contradict the photographs.")]
    if tried:
        causes = "; ".join(f"{one.cause} ({significant(one.after_px)} px)" for one in tried)
        line += (
            f"none of the obvious causes explains it, from {significant(tried[0].before_px)} px: {causes}. "
        )
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
    if len(a.network.images) == 2:
        lines.append(
            "Two photographs: no third ray checks a point, uncoded targets are not in the result, and the "
            "camera is only as good as its given values."
        )
    rays = np.bincount(a.network.image_points.point[~a.rejected], minlength=len(a.network.points))
    two = int((rays == 2).sum())
    if two:
        lines.append(
            f"{two} of {len(rays)} points have two rays: errors of their image points along the epipolar "
            "line are not found."
        )
    return tuple(lines)


def _rays(evidence: Evidence) -> Judged:
    """Judge the points that lost many of their rays to rejection, or all but two."""
    adjustment = evidence.result.adjustment
    network, rejected = adjustment.network, adjustment.rejected
    n, point = len(network.points), network.image_points.point
    lost, rays = np.bincount(point[rejected], minlength=n), network.rays()
    most = np.flatnonzero((lost > 0) & ((lost >= MANY_RAYS * rays) | (rays - lost <= FEW_RAYS)))
    if not len(most):
        return []
    shown = listed(f"{network.points[j]} ({lost[j]} of {rays[j]})" for j in most)
    line = f"A third of the rays or more were rejected, or only two are left, of {len(most)} point(s)"
    return [(False, f"{line}: {shown}.")]


def _consistency(evidence: Evidence) -> Judged:
    """Judge the tests inside the result: points, photographs, the format."""
    found, result = evidence.consistency, evidence.result
    lines = []
    matched = any(table == "tie_points" for table, _ in result.settings)
    cause = "Two points were matched as one" if matched else "It moved, or two bear its name"
    for one in found.two_positions[:MAX_LISTED]:
        factor, unit = finer_unit(result.length_unit, one.distance)
        lines.append(
            f"Point {one.point} is at two positions, {significant(factor * one.distance)} {unit} apart "
            f"({significant(one.over_sigma)} standard deviations): one in {len(one.first)} photographs from "
            f"{one.first[0]} on, the other in {len(one.second)} from {one.second[0]} on. {cause}."
        )
    if len(found.two_positions) > MAX_LISTED:
        lines.append(f"{len(found.two_positions) - MAX_LISTED} more points are at two positions.")
    if found.doubtful:
        shown = listed(f"{one.point} ({one.rejected} rejected, or {one.instead})" for one in found.doubtful)
        lines.append(
            f"Which ray is wrong cannot be told of {len(found.doubtful)} point(s), whose coordinates are "
            f"doubtful: {shown}."
        )
    if found.large:
        lines.append(
            f"The residuals of {len(found.large)} point(s) are together larger than chance: "
            f"{listed(found.large)}."
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
