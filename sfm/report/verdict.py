"""The verdict on a survey in plain words: good, with remarks, or not usable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sfm.adjustment.quality.statistics import ALPHA, component_tests, tau_test, w_test
from sfm.adjustment.quality.variance_components import IMAGE_POINTS, by_kind
from sfm.conventions import MAD_TO_SIGMA
from sfm.report.checks import (
    check_over_sigma,
    longest_residual,
    object_size,
    sigma0_ratio,
)
from sfm.report.given import (
    EXTERIOR,
    bar_residuals,
    control_residuals,
    exterior_residuals,
    interior_residuals,
)
from sfm.report.markup import finer_unit, significant
from sfm.result import SurveyResult

MUCH_REJECTED = 0.05  # share of rejected image points above which a person should look
MOST_RAYS = 0.5  # share of the rays of a point: most of them say something else than the result
MOST_NAMES = 5  # points named in one remark
# sigma_px is a rough guess, so the global test alone says little. Twice the guess is worth a look; five
# times is no precision that anybody expected, but a wrong model, wrong names or wrong control.
SIGMA0_REMARK, SIGMA0_BAD = 2.0, 5.0
SIGMA0_LOW = 0.5  # the same times too cautious
AS_STATED = 1.5  # standard deviation of w by its median, up to which image points are about as stated
# Data snooping leaves nothing beyond 4 or 5 sigma; ten is an outlier, thirty is a mistake that was kept.
RESIDUAL_REMARK, RESIDUAL_BAD = 10.0, 30.0
WEIGHTED_REMARK, WEIGHTED_BAD = 5.0, 30.0  # w of control, scale bars, interior orientation
# Differences at control that took no part, in sigmas. Control without standard deviations is a print or a
# drawing, never as good as the network; control that states them must keep to them.
CHECK_REMARK = 100.0
MISCLOSURE_BAD = 0.01  # of the size of the object, or of a length: no measurement, a mistake


@dataclass(frozen=True)
class Verdict:
    """What a person is told first."""

    level: Literal["good", "fair", "bad"]
    headline: str
    remarks: tuple[str, ...]  # what to look at or to know, one line each


def verdict_of(result: SurveyResult) -> Verdict:
    """Judge a result by convergence, rank, sigma0, residuals, control, photographs and the comparison.

    Args:
        result: the result.

    Returns:
        `bad` if the adjustment did not converge, something cannot be determined, or the observations
        contradict one another; `fair` if there is something to look at; else `good`.
    """
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
    for judge in (
        _sigma0,
        _residual,
        _untested,
        _rays,
        _control,
        _bars,
        _interior,
        _exterior,
        _kinds,
        _check,
    ):
        for is_bad, line in judge(result):
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
    notes = _pessimistic(result)
    if serious:
        return Verdict("bad", "The survey has no dependable result.", (*serious, *remarks, *notes))
    found = f"{oriented} of {total} photographs oriented, {len(a.network.points)} object points"
    if remarks:
        return Verdict("fair", f"The survey worked, with remarks: {found}.", (*remarks, *notes))
    return Verdict("good", f"The survey worked: {found}.", notes)


Judged = list[tuple[bool, str]]  # whether the result cannot be depended on, and why


def _sigma0(result: SurveyResult) -> Judged:
    """Judge sigma0 a posteriori over a priori."""
    ratio = sigma0_ratio(result)
    if not ratio > SIGMA0_REMARK:
        return []
    line = (
        f"Sigma0 is {significant(ratio)} times the expected standard deviation of an image coordinate "
        f"({significant(result.adjustment.stated_px)} px): "
    )
    if ratio > SIGMA0_BAD:
        return [(True, line + "points, control or the camera contradict the photographs.")]
    return [(False, line + "see the residuals, or set sigma_px to what the photographs give.")]


def _residual(result: SurveyResult) -> Judged:
    """Judge the longest accepted residual."""
    ratio, worst = longest_residual(result.adjustment)
    if not ratio > RESIDUAL_REMARK:
        return []
    network = result.adjustment.network
    image = network.images[network.image_points.image[worst]]
    point = network.points[network.image_points.point[worst]]
    length = float(np.linalg.norm(result.adjustment.residuals[worst]))
    weight = float(result.adjustment.weights[worst]) if len(result.adjustment.weights) else 1.0
    lowered = f", {significant(ratio)} times with its lowered weight," if weight < 1 else ""
    line = (
        f"Point {point} in {image} has a residual of {significant(length)} px, "
        f"{significant(ratio / np.sqrt(weight))} times the standard deviation{lowered or ','} and was not "
        "rejected."
    )
    return [(ratio > RESIDUAL_BAD, line)]


def _untested(result: SurveyResult) -> Judged:
    """Judge what the tests of single image coordinates show where the survey rejects nothing.

    Tau is blind where gross errors are so many that they make sigma0; w tells then, if the bulk of the
    image points is as good as stated.
    """
    if result.reject != "none":
        return []
    a = result.adjustment
    tests = [("tau", tau_test(a))]
    w = w_test(a)
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


def _pessimistic(result: SurveyResult) -> tuple[str, ...]:
    """Say if the image points are far better than stated, which is no fault of the result."""
    ratio = sigma0_ratio(result)
    image = component_tests(by_kind(result.adjustment), alpha=2 * ALPHA)[0]
    if not (ratio < SIGMA0_LOW and image.statistic < image.lower):
        return ()
    stated = result.adjustment.stated_px
    return (
        f"The stated standard deviation of the image points, {significant(stated)} px, is pessimistic: their "
        f"residuals show {significant(ratio * stated)} px.",
    )


def _control(result: SurveyResult) -> Judged:
    """Judge the residuals of weighted control."""
    found = control_residuals(result)
    worst = found.worst() if found is not None else None
    if found is None or worst is None or not worst[1] > WEIGHTED_REMARK:
        return []
    line = (
        f"Control point {found.names[worst[0]]} differs from its given coordinates by "
        f"{significant(worst[1])} times the standard deviation of that difference."
    )
    return [(worst[1] > WEIGHTED_BAD, line)]


def _bars(result: SurveyResult) -> Judged:
    """Judge the residuals of scale bars."""
    found = bar_residuals(result)
    worst = found.worst() if found is not None else None
    if found is None or worst is None or not worst[1] > WEIGHTED_REMARK:
        return []
    relative = abs(float(found.difference[worst[0], 0] / found.given[worst[0], 0]))
    line = (
        f"Scale bar {found.names[worst[0]]} differs from its given length by {significant(worst[1])} "
        f"times the standard deviation of that difference ({significant(100 * relative)} %)."
    )
    return [(worst[1] > WEIGHTED_BAD or relative > MISCLOSURE_BAD, line)]


def _interior(result: SurveyResult) -> Judged:
    """Judge the residuals of weighted interior orientation, as of a calibration certificate."""
    found = interior_residuals(result)
    worst = found.worst() if found is not None else None
    if found is None or worst is None or not worst[1] > WEIGHTED_REMARK:
        return []
    unit = "" if found.units[worst[0]] == "1" else f" {found.units[worst[0]]}"
    line = (
        f"The given {found.names[worst[0]]}, {found.given[worst[0], 0]:.6g}{unit}, differs from the adjusted "
        f"one by {significant(worst[1])} times the standard deviation of that difference."
    )
    return [(worst[1] > WEIGHTED_BAD, line)]


def _kinds(result: SurveyResult) -> Judged:
    """Judge control, bars and interior orientation as a whole by their variance components."""
    found = by_kind(result.adjustment)
    judged: Judged = []
    for g, test in enumerate(component_tests(found, alpha=2 * ALPHA)):
        if test.of == IMAGE_POINTS or found.count[g] < 2 or not test.statistic > test.upper:
            continue
        line = (
            f"The residuals of the {test.of} are {significant(float(found.sigma0[g]))} times what the "
            f"standard deviations stated for them give, more than chance (redundancy {test.redundancy:.1f})."
        )
        judged.append((False, line))
    return judged


def _exterior(result: SurveyResult) -> Judged:
    """Judge the residuals of observed exterior orientation."""
    judged: Judged = []
    for found, (_, names) in zip(exterior_residuals(result) or (), EXTERIOR, strict=False):
        worst = found.worst()
        if worst is None or not worst[1] > WEIGHTED_REMARK:
            continue
        name = names[int(np.nanargmax(np.abs(found.w[worst[0]])))]
        line = (
            f"The given {name} of photograph {found.names[worst[0]]} differs from the adjusted one by "
            f"{significant(worst[1])} times the standard deviation of its residual."
        )
        judged.append((worst[1] > WEIGHTED_BAD, line))
    return judged


def _rays(result: SurveyResult) -> Judged:
    """Judge the points that lost most of their rays to rejection."""
    network, rejected = result.adjustment.network, result.adjustment.rejected
    n, point = len(network.points), network.image_points.point
    lost, rays = np.bincount(point[rejected], minlength=n), network.rays()
    most = np.flatnonzero(lost > MOST_RAYS * rays)
    if not len(most):
        return []
    shown = ", ".join(f"{network.points[j]} ({lost[j]} of {rays[j]})" for j in most[:MOST_NAMES])
    more = " ..." if len(most) > MOST_NAMES else ""
    return [(False, f"Most rays were rejected of {len(most)} point(s): {shown}{more}.")]


def _check(result: SurveyResult) -> Judged:
    """Judge the differences at control that took no part."""
    check = result.control_check
    if check is None:
        return []
    judged: Judged = []
    if result.adjustment.network.scale_bars and abs(check.scale - 1) > MISCLOSURE_BAD:
        line = f"The control says lengths are {check.scale:.6g} times those of the scale bars."
        judged.append((True, line))
    length = np.linalg.norm(check.differences, axis=1)
    worst = int(np.argmax(length))
    part = float(length[worst]) / object_size(result.adjustment.estimate.points)
    sigmas, stated = check_over_sigma(result, check)
    beyond = np.nan_to_num(sigmas) / np.where(stated, WEIGHTED_REMARK, CHECK_REMARK)
    factor, unit = finer_unit(result.length_unit, float(length[worst]))
    said = f"differs from its given place by {significant(float(length[worst]) * factor)} {unit}"
    if part > MISCLOSURE_BAD:
        line = f"Control point {check.points[worst]} {said}, {significant(100 * part)} % of the object."
        judged.append((True, line))
    elif beyond.max(initial=0.0) > 1:
        worst = int(np.argmax(beyond))
        factor, unit = finer_unit(result.length_unit, float(length[worst]))
        line = (
            f"Control point {check.points[worst]} differs from its given place by "
            f"{significant(float(length[worst]) * factor)} {unit}, {significant(float(sigmas[worst]))} times "
            f"the standard deviation of {'both' if stated[worst] else 'its adjusted place'} in a coordinate."
        )
        judged.append((False, line))
    return judged
