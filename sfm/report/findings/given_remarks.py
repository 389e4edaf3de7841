"""Remarks on given values after the adjustment: residuals, checks, and whether the scale can be.

What was given is judged by the image points alone before it takes part; these are the tests of what took
part, and of what only checks the result.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.adjustment.quality.given_values import LEVEL
from sfm.adjustment.quality.statistics import component_tests
from sfm.adjustment.quality.variance_components import IMAGE_POINTS
from sfm.conventions import METRES
from sfm.distributions import normal_ppf
from sfm.network import rows_of
from sfm.remarks.remark import Remark, remark
from sfm.report.findings.bundle_statistics import Statistics
from sfm.report.findings.given_residuals import Given, GivenResiduals
from sfm.report.findings.protocol import ControlCoordinate
from sfm.report.numbers import finer_unit
from sfm.result import SurveyResult

MM = 1e-3  # m
# What is left of the error of a value that is checked less is below the rounding and the neglected second
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
        *(one for kind in given.kinds for one in _residuals(kind)),
        *_kinds(statistics),
        *_checks(checks, result.length_unit),
        *_scale(result),
    )


def _kinds(statistics: Statistics) -> tuple[Remark, ...]:
    """Return the remarks on kinds of given values whose residuals are larger than stated, beyond chance."""
    found = statistics.kinds
    level = LEVEL / max(len(found.names) - 1, 1)
    return tuple(
        remark("given_sigmas", of=test.of, factor=float(found.sigma0[g]))
        for g, test in enumerate(component_tests(found, alpha=2 * level))
        if test.of != IMAGE_POINTS and found.count[g] > 1 and test.statistic > test.upper
    )


def _residuals(kind: GivenResiduals) -> tuple[Remark, ...]:
    """Return the remark on the value whose w is largest, where chance does not explain it.

    The shift is the largest that any function of the unknowns has without it: |w| sqrt((1 - r) / r).
    """
    tested = [one for one in kind.by_w if np.isfinite(one.w) and one.r >= MIN_REDUNDANCY]
    if not tested:
        return ()
    worst = max(tested, key=lambda one: abs(one.w))
    if not abs(worst.w) > -normal_ppf(LEVEL / (2 * len(tested))):
        return ()
    what = "" if worst.coordinate == "value" else f"{worst.coordinate} of {kind.kind} "
    return (
        remark(
            "given_differs",
            given=f"{what}{worst.name}",
            difference=(abs(worst.difference), "" if worst.unit == "1" else worst.unit),
            sigmas=abs(worst.w),
            shift=abs(worst.w) * np.sqrt((1 - worst.r) / worst.r),
        ),
    )


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
        factor, finer = finer_unit(unit, farthest)
        distance = (factor * farthest, finer)
        return (remark("checks_contradict", count=len(off), all=len(points), distance=distance),)
    worst = max(beyond, key=lambda one: abs(one.test))
    factor, finer = finer_unit(unit, abs(worst.difference))
    return (
        remark(
            "check_differs",
            coordinate=worst.coordinate,
            point=worst.point,
            difference=(factor * abs(worst.difference), finer),
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
