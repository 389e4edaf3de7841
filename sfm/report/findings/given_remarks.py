"""Remarks on given values after the adjustment: residuals, checks, and whether the scale can be.

Given values are judged by the image points alone before they take part; these are the tests of those that
took part, and of those that only check the result. Given interior orientation is not tested here: whether it
is wrong is the question of an alternative (`sfm.adjustment.hypotheses`), which states the shift of object
points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sfm.adjustment.quality.given_values import LEVEL
from sfm.adjustment.quality.statistics import component_tests
from sfm.adjustment.quality.variance_components import IMAGE_POINTS, INTERIOR
from sfm.conventions import METRES
from sfm.distributions import normal_ppf
from sfm.given_residuals import GivenResiduals, GivenValue
from sfm.network import rows_of
from sfm.remarks.remark import Remark, remark
from sfm.report.findings.bundle_statistics import Statistics
from sfm.report.findings.given_residuals import Given
from sfm.report.findings.protocol import ControlCoordinate
from sfm.result import SurveyResult

MM = 1e-3  # m
JUDGED_AS = {"control points": "control", "exterior orientation": "centres", "scale bars": "scale"}
# The rest of the error of a value that is checked less is below the rounding and the neglected second
# order of the others, and w magnifies that.
MIN_REDUNDANCY = 1e-3
MAX_MAGNIFICATION = 1.0  # of the median image distance c over the object distance; macrophotography is beyond


def given_remarks(
    result: SurveyResult, given: Given, statistics: Statistics, checks: Sequence[ControlCoordinate]
) -> tuple[Remark, ...]:
    """Return the remarks on given values that took part or check the result.

    Args:
        result: of a survey.
        given: residuals of what took part.
        statistics: of the adjustment.
        checks: coordinates that took no part.
    """
    return (
        *_differing(given),
        *_kinds(statistics, {test.what for test in result.given_tests}),
        *_checks(checks, result.length_unit),
        *_scale(result),
    )


def _kinds(statistics: Statistics, judged: set[str]) -> tuple[Remark, ...]:
    """Return the remarks on kinds of given values whose residuals are larger than stated, beyond chance.

    Kinds that were judged against the free network have theirs.
    """
    found = statistics.kinds
    level = LEVEL / max(len(found.names) - 1, 1)
    return tuple(
        remark("given_sigmas", of=test.of, factor=float(found.sigma0[g]))
        for g, test in enumerate(component_tests(found, alpha=2 * level))
        if test.of not in (IMAGE_POINTS, INTERIOR)
        and JUDGED_AS.get(test.of) not in judged
        and found.count[g] > 1
        and test.statistic > test.upper
    )


def _differing(given: Given) -> Iterator[Remark]:
    """Yield the remark on the value of each kind whose w is largest, where chance does not explain it.

    The shift is that of the adjusted value itself, |w| sqrt((1 - r) / r), a coordinate or a length of the
    object. The orientation of a photograph is neither, so that none is given there.
    """
    for kind in (given.control, given.bars, *given.further):
        worst = _beyond_chance(kind) if kind else None
        if kind and worst:
            shift = abs(worst.w) * np.sqrt((1 - worst.r) / worst.r)
            yield remark("given_differs", shift=shift, **_parts(worst, kind))
    for kind in given.exterior:
        worst = _beyond_chance(kind)
        if worst:
            yield remark("orientation_differs", **_parts(worst, kind))


def _beyond_chance(kind: GivenResiduals) -> GivenValue | None:
    """Return the value of a kind whose w is largest, if it is larger than chance makes it."""
    tested = [one for one in kind.by_w if np.isfinite(one.w) and one.r >= MIN_REDUNDANCY]
    if not tested or not abs(tested[0].w) > -normal_ppf(LEVEL / (2 * len(tested))):
        return None
    return tested[0]


def _parts(one: GivenValue, kind: GivenResiduals) -> dict[str, str | float | tuple[float, str]]:
    """Return a value, its difference and its w as a remark has them."""
    return {
        "given": f"{one.coordinate} of {kind.kind} {one.name}",
        "difference": (abs(one.difference), one.unit),
        "sigmas": abs(one.w),
    }


def _checks(checks: Sequence[ControlCoordinate], unit: str) -> tuple[Remark, ...]:
    """Return the remarks on coordinates that took no part: single ones, or most of them."""
    tested = [one for one in checks if np.isfinite(one.test)]
    critical = -normal_ppf(LEVEL / (2 * max(len(tested), 1)))
    beyond = [one for one in tested if abs(one.test) > critical]
    if not beyond:
        return ()
    points, off = {one.point for one in tested}, {one.point for one in beyond}
    if 2 * len(off) > len(points):
        farthest = max(abs(one.difference) for one in beyond)
        return (remark("checks_contradict", count=len(off), all=len(points), distance=(farthest, unit)),)
    worst = max(beyond, key=lambda one: abs(one.test))
    return (
        remark(
            "check_differs",
            coordinate=worst.coordinate,
            point=worst.point,
            difference=(abs(worst.difference), unit),
            sigmas=abs(worst.test),
        ),
    )


def _scale(result: SurveyResult) -> tuple[Remark, ...]:
    """Return the remark on a scale that puts the object nearer to the camera than any lens forms its image.

    At the image distance c the image is as large as the object. Source: DIN 19040-2 (macrophotography is
    photography at 1 : 1 and larger); Luhmann et al. (2020), sec. 3.1.1 (thin lens).
    """
    a, metres = result.adjustment, METRES.get(result.length_unit)
    if metres is None or not result.has_scale:
        return ()
    network, largest, nearest = a.network, 0.0, np.nan
    seen = network.image_points
    for i, rows in enumerate(rows_of(seen.image, len(network.images))):
        camera = a.estimate.cameras[network.camera[i]]
        used = rows[~a.rejected[rows]]
        if not camera.in_mm or not len(used):
            continue
        d = (a.estimate.points[seen.point[used]] - a.estimate.position[i]) @ a.estimate.rotation[i]
        distance = float(np.median(-d[:, 2])) * metres
        magnification = abs(float(camera.parameters[0])) * MM / distance if distance > 0 else 0.0
        if magnification > largest:
            largest, nearest = magnification, distance
    if not largest > MAX_MAGNIFICATION:
        return ()
    return (remark("scale_implausible", distance=(nearest / MM, "mm"), magnification=largest),)
