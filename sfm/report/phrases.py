"""Sentences that several reports and the terminal print: the same words everywhere."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sfm.adjustment.quality.statistics import GLOBAL_ALPHA, GlobalTest
from sfm.adjustment.result import Adjustment
from sfm.display import NO_BREAK, counted, listed
from sfm.distributions import normal_ppf
from sfm.report.findings.calibrated_cameras import CalibratedCamera
from sfm.report.findings.checks import Sigma0
from sfm.report.findings.findings import Findings
from sfm.report.findings.precision import Precision
from sfm.report.findings.rigs import Rig
from sfm.report.numbers import NOT_DETERMINED, alike, finer_unit, significant, with_exponent
from sfm.result import ControlCheck, SurveyResult

NORMAL_95 = float(normal_ppf(0.975))  # standard deviations of a coordinate that 95 % of its errors are within


def describe_sigma0(sigma0: Sigma0) -> tuple[str, str]:
    """Return sigma0 and what it is to the stated one, with the image points where they show another."""
    times = f"{sigma0.px / sigma0.stated_px:.3f} times the {significant(sigma0.stated_px)} px expected"
    alone = f"image points by themselves {sigma0.image_points_px:.4f} px, {sigma0.ratio:.3f} times"
    return f"{sigma0.px:.4f} px", f"{times}; {alone}" if sigma0.differs else times


def describe_neighbours(a: Adjustment) -> str:
    """Return how far the errors of neighbouring image points agree; empty where they are independent."""
    found = a.error_correlation
    if found is None:
        return ""
    alone, common = (significant(sigma) for sigma in found.sigmas_px(a.sigma0_px))
    return (
        f"neighbours in a photograph have errors of {common} px in common, which fall to 1/e in "
        f"{significant(found.length_px)} px; each has {alone} px alone; standard deviations contain both"
    )


def describe_test(test: GlobalTest, adjustment: Adjustment | None = None) -> str:
    """Return the outcome of a global test, with what would fit where the stated values are too cautious.

    Args:
        test: of all observations, or of a kind.
        adjustment: with its sigma_px; None to write a factor.
    """
    if test.passed is None:
        return f"{test.of}: not tested, {_why_untested(test)}"
    r = f"{test.redundancy:.1f}".removesuffix(".0")
    said = "passed" if test.passed else "NOT passed, worse than stated"
    if not test.passed and test.statistic < test.lower:
        said = f"better than stated, {_fitting(test, adjustment)} would fit"
    return (
        f"{test.of}: {said}; v'Pv = {test.statistic:.2f}, chi-square of {r} between {test.lower:.2f} and "
        f"{test.upper:.2f} ({100 * (1 - GLOBAL_ALPHA):.0f} %)"
    )


def _why_untested(test: GlobalTest) -> str:
    if test.untested == "reweighted":
        return "the weights come from the residuals, so that v'Pv is not chi-square distributed"
    return f"its redundancy, {test.redundancy:.2g}, is too small"


def _fitting(test: GlobalTest, a: Adjustment | None) -> str:
    """Return the stated standard deviations with which a test would pass, as sigma_px where that decides."""
    factor = float(np.sqrt(test.statistic / test.redundancy))
    if a is not None and a.observations == 2 * int((~a.rejected).sum()):
        measured = a.stated_px**2 - a.sigma_px**2  # what targets state; sigma_px is added
        left = (factor * a.stated_px) ** 2 - measured
        if 0 <= measured < 0.5 * a.stated_px**2 and left > 0:
            return f"sigma_px = {significant(float(np.sqrt(left)))}"
    return f"{significant(factor)} times the stated standard deviations"


def describe_weights(result: SurveyResult) -> str:
    """Return which weights the image points have, and what follows for the tests; empty if nothing chose."""
    factor = result.adjustment.weight_factor
    if result.weights == "stated":
        return "Weights: those stated for all observations, with one sigma0 for all standard deviations."
    if factor == 1:
        return ""
    return (
        "Weights: the standard deviations of the image points were multiplied by "
        f"{factor:.3f}, from their variance component, so that the other kinds of "
        "observation keep those stated for them. A test of all observations together would pass by "
        "construction; each kind is tested against the standard deviations stated for it."
    )


def describe_check(found: ControlCheck, unit: str) -> str:
    """Return how far the placed points are from control that took no part.

    Args:
        found: the differences.
        unit: object unit.
    """
    length = np.linalg.norm(found.differences, axis=1)
    worst, points = int(np.argmax(length)), found.points
    longest = float(length[worst])
    factor, finer = finer_unit(unit, longest)
    *rms, most = alike([*(found.rms * factor), longest * factor])
    return (
        f"RMS {', '.join(rms)} {finer} in X, Y, Z at {counted(len(points), 'point')}; largest "
        f"{most} {finer} at {points[worst]}"
    )


def describe_limiting(precision: Precision) -> str:
    """Return why a limiting standard deviation is above the achieved one; empty where none is.

    With the cameras held, shift, rotation and scale of the points are theirs; inner constraints on the
    points take these out, and can take out more of a coordinate than the errors of the cameras add.
    """
    if not (precision.limiting > precision.rms).any():
        return ""
    return (
        "The limiting precision is in the datum of the cameras, in which a coordinate can be less precise "
        "than in that of the adjustment."
    )


def describe_precision(typical: float, largest: float, unit: str) -> str:
    """Return the precision of the points: one standard deviation, and what 95 % of the errors are within.

    Args:
        typical: RMS standard deviation, object unit.
        largest: likewise.
        unit: object unit.
    """
    factor, finer = finer_unit(unit, largest)
    one = np.array([typical, largest]) * factor
    rms, most, rms_95, most_95 = alike([*one, *(NORMAL_95 * one)])
    sigmas = f"1 sigma {rms} {finer} RMS, {most} {finer} at most"
    return f"{sigmas}; 95 % {rms_95} {finer} RMS, {most_95} {finer} at most"


def describe_calibration(camera: CalibratedCamera) -> tuple[str, str, str, str]:
    """Return c and principal point, their 1 sigma, their 95 %, and the projection uncertainty."""
    values, sigmas, within = [], [], []
    for one in camera.parameters:
        value, sigma = with_exponent(one.value, one.sigma)
        state = NOT_DETERMINED if np.isinf(one.sigma) else "" if one.sigma > 0 else "held"
        value = state if np.isinf(one.sigma) else f"{value} {one.unit}"
        values.append(f"{one.name}{NO_BREAK}{value}")
        sigmas.append(state or f"{sigma} {one.unit}")
        within.append(state or f"{significant(NORMAL_95 * one.sigma, 2)} {one.unit}")
    rms, largest = camera.projection_rms_px, camera.projection_largest_px
    if np.isinf(rms):
        return ", ".join(values), ", ".join(sigmas), ", ".join(within), NOT_DETERMINED
    projection = (
        f"1 sigma {significant(rms)} px RMS over the photograph, {significant(largest)} px at most; "
        f"95 % {significant(NORMAL_95 * rms)} px, {significant(NORMAL_95 * largest)} px"
    )
    return ", ".join(values), ", ".join(sigmas), ", ".join(within), projection


def describe_fixed(precision: Precision) -> str:
    """Say that fixed coordinates do not count; empty where there are none."""
    count = precision.fixed_points
    return f"without the fixed coordinates of {counted(count, 'point')}" if count else ""


def words_left_out(findings: Findings) -> str:
    """Say what of the survey the comparison with the other adjuster leaves out; empty where nothing."""
    counts, fixed = findings.counts, findings.precision.fixed_points
    control = findings.result.adjustment.datum == "control"
    left_out = [
        *([counted(fixed, "fixed point")] if control and fixed else []),
        *(
            counted(number, what)
            for number, what in (
                (counts.control, "control coordinate"),
                (counts.exterior, "observed exterior orientation parameter"),
                (counts.interior, "observed interior orientation parameter"),
                (counts.scale_bars, "scale bar"),
                (counts.further, "further observation"),
            )
            if number
        ),
    ]
    return f"without {listed(left_out)}" if left_out else ""


def describe_rigs(rigs: Sequence[Rig], unit: str) -> Iterator[tuple[str, str]]:
    """Yield each rig and where one of its cameras is mounted: base and angles with standard deviations."""
    for rig in rigs:
        for mount in rig.mounts:
            base = " ± ".join(with_exponent(mount.base, mount.base_sigma))
            angles = [
                " ± ".join(with_exponent(value, sigma))
                for value, sigma in zip(mount.rotation_deg, mount.rotation_sigma_deg, strict=True)
            ]
            where = f"{mount.camera} {base} {unit} from {rig.reference}"
            turned = f"omega, phi, kappa {', '.join(angles)} deg (1 sigma)"
            yield f"rig {rig.name}", f"{where}; {turned}"
