"""Sentences and numbers as several reports and the terminal print them.

Numbers are written for people: with significant digits, exponents, and units of a readable size.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from sfm.adjustment.quality.statistics import GlobalTest
from sfm.adjustment.result import Adjustment
from sfm.judgement.calibrated_cameras import CalibratedCamera
from sfm.judgement.checks import Sigma0
from sfm.judgement.survey_result import ControlCheck, SurveyResult
from sfm.model.conventions import SUPERSCRIPTS, FloatArray
from sfm.model.conventions import finer_unit as finer_unit
from sfm.model.display import NO_BREAK, counted, listed
from sfm.model.distributions import normal_ppf
from sfm.model.remarks.row import probability as probability
from sfm.model.remarks.row import significant as significant
from sfm.report.findings import Findings
from sfm.report.precision import Precision
from sfm.report.rig_mounts import Rig

MIN_PLAIN_VALUE = 1e-3  # parameters below it are written with an exponent
ROUNDING = 1e-10  # standard deviation over value below which it counts as zero
NOT_DETERMINED = "not determined"  # replaces an infinite standard deviation
NORMAL_95 = float(normal_ppf(0.975))  # standard deviations that contain 95 % of the errors of a coordinate


def describe_sigma0(sigma0: Sigma0) -> tuple[str, str]:
    """Return sigma0 and its ratio to the stated one, with that of the image points if it differs."""
    times = f"{sigma0.px / sigma0.stated_px:.3f} times the {significant(sigma0.stated_px)} px expected"
    alone = f"image points alone {sigma0.image_points_px:.4f} px, {sigma0.ratio:.3f} times"
    return f"{sigma0.px:.4f} px", f"{times}; {alone}" if sigma0.differs else times


def describe_neighbours(a: Adjustment) -> str:
    """Return how far the errors of neighbouring image points agree; empty if they are independent."""
    correlation = a.error_correlation
    if correlation is None:
        return ""
    alone, common = (significant(sigma) for sigma in correlation.sigmas_px(a.sigma0_px))
    length, effect = significant(correlation.length_px), correlation.design_effect
    counted_as = f"; beside other sources {significant(effect)} of them have the weight of one"
    return (
        f"neighbours in a photograph have errors of {common} px in common, which fall to 1/e within {length} "
        f"px; each also has {alone} px alone; standard deviations include both"
        f"{counted_as if effect > 1 else ''}"
    )


def percent(probability: float) -> str:
    """Return a probability in percent, exact to the last digit that is not 0."""
    return f"{100 * probability:.6g} %"


def describe_test(test: GlobalTest, adjustment: Adjustment | None = None) -> str:
    """Return the outcome of a global test, and what would fit if the stated values are too cautious.

    Args:
        test: test of all observations, or of one kind.
        adjustment: adjustment, to suggest its sigma_px; None to suggest a factor.
    """
    if test.passed is None:
        why = f"its redundancy, {test.redundancy:.2g}, is too small"
        if test.untested == "reweighted":
            why = "the weights come from the residuals, so v'Pv is not chi-square distributed"
        return f"{test.of}: not tested, {why}"
    r = f"{test.redundancy:.1f}".removesuffix(".0")
    said = "passed" if test.passed else "NOT passed, worse than stated"
    if not test.passed and test.statistic < test.lower:
        factor, a = float(np.sqrt(test.statistic / test.redundancy)), adjustment
        fitting = f"{significant(factor)} times the stated standard deviations"
        if a is not None and a.observations == 2 * int((~a.rejected).sum()):
            measured = a.stated_px**2 - a.sigma_px**2  # part stated for targets; sigma_px is added to it
            left = (factor * a.stated_px) ** 2 - measured
            if 0 <= measured < 0.5 * a.stated_px**2 and left > 0:
                fitting = f"sigma_px = {significant(float(np.sqrt(left)))}"
        said = f"better than stated, {fitting} would fit"
    return (
        f"{test.of}: {said}; v'Pv = {test.statistic:.2f}, chi-square of {r} between {test.lower:.2f} and "
        f"{test.upper:.2f} ({percent(1 - test.alpha)})"
    )


def describe_weights(result: SurveyResult) -> str:
    """Return the weights of the image points and the consequence for the tests; empty for plain weights."""
    factor = result.adjustment.weight_factor
    if result.weights == "stated":
        return "Weights: as stated for all observations, with one sigma0 for all standard deviations."
    if factor == 1:
        return ""
    sources = result.adjustment.network.sources
    if len(sources) > 1:
        sigmas = [
            f"{significant(sigma)} px of {source.name}"
            for source, sigma in zip(sources, result.adjustment.sigma_of_sources, strict=True)
        ]
        return (
            "Weights: image points have the standard deviations that the variance component of their source "
            f"shows, in the median {listed(sigmas)}. The other kinds of observation keep their stated ones. "
            "A test of all observations together would pass by construction, so each kind is tested against "
            "its stated standard deviations."
        )
    return (
        "Weights: the standard deviations of the image points were multiplied by "
        f"{factor:.3f}, from their variance component, and the other kinds of "
        "observation keep their stated ones. A test of all observations together would pass by "
        "construction, so each kind is tested against its stated standard deviations."
    )


def describe_check(check: ControlCheck, unit: str) -> str:
    """Return the differences between the fitted points and control that took no part.

    Args:
        check: the differences.
        unit: object unit.
    """
    length = np.linalg.norm(check.differences, axis=1)
    worst, points = int(np.argmax(length)), check.points
    longest = float(length[worst])
    factor, finer = finer_unit(unit, longest)
    *rms, most = alike([*(check.rms * factor), longest * factor])
    return (
        f"RMS {', '.join(rms)} {finer} in X, Y, Z at {counted(len(points), 'point')}; largest "
        f"{most} {finer} at {points[worst]}"
    )


def describe_limiting(precision: Precision) -> str:
    """Return why a limiting standard deviation exceeds the achieved one; empty if none does.

    With the cameras held, the points take their shift, rotation and scale from the cameras. Inner constraints
    on the points remove these, which can remove more of a coordinate's error than the cameras add.
    """
    if not (precision.limiting > precision.rms).any():
        return ""
    return (
        "The limiting precision is in the datum of the cameras. A coordinate can be less precise in it than "
        "in the datum of the adjustment."
    )


def describe_precision(typical: float, largest: float, unit: str) -> str:
    """Return the precision of the points: one standard deviation, and the limit for 95 % of the errors.

    Args:
        typical: RMS standard deviation, object unit.
        largest: largest standard deviation, object unit.
        unit: object unit.
    """
    factor, finer = finer_unit(unit, largest)
    one_sigma = np.array([typical, largest]) * factor
    rms, most, rms_95, most_95 = alike([*one_sigma, *(NORMAL_95 * one_sigma)])
    sigmas = f"1 sigma {rms} {finer} RMS, {most} {finer} at most"
    return f"{sigmas}; 95 % {rms_95} {finer} RMS, {most_95} {finer} at most"


def describe_calibration(camera: CalibratedCamera) -> tuple[str, str, str, str]:
    """Return c and principal point, their 1 sigma and 95 % limits, and the projection uncertainty."""
    values, sigmas, within = [], [], []
    for parameter in camera.parameters:
        value, sigma = with_exponent(parameter.value, parameter.sigma)
        state = NOT_DETERMINED if np.isinf(parameter.sigma) else "" if parameter.sigma > 0 else "held"
        value = state if np.isinf(parameter.sigma) else f"{value} {parameter.unit}"
        values.append(f"{parameter.name}{NO_BREAK}{value}")
        sigmas.append(state or f"{sigma} {parameter.unit}")
        within.append(state or f"{significant(NORMAL_95 * parameter.sigma, 2)} {parameter.unit}")
    rms, largest = camera.projection_rms_px, camera.projection_largest_px
    if np.isinf(rms):
        return ", ".join(values), ", ".join(sigmas), ", ".join(within), NOT_DETERMINED
    projection = (
        f"1 sigma {significant(rms)} px RMS over the photograph, {significant(largest)} px at most; "
        f"95 % {significant(NORMAL_95 * rms)} px, {significant(NORMAL_95 * largest)} px"
    )
    return ", ".join(values), ", ".join(sigmas), ", ".join(within), projection


def describe_view(findings: Findings, name: str) -> str:
    """Return f, cx and cy of a camera in px if it has mm, and its field of view; empty without such a camera.

    cx and cy count from the centre of the upper left pixel, as in OpenCV.
    """
    cameras = {camera.name: camera for camera in findings.result.adjustment.estimate.cameras}
    for lens in findings.protocol.lenses:
        if lens.camera == name:
            cx, cy = (fixed(place, 1) for place in cameras[name].principal_point_px - 0.5)
            f = fixed(cameras[name].c_px, 1)
            in_px = f"f {f} px, cx {cx} px, cy {cy} px as OpenCV counts; " if cameras[name].in_mm else ""
            across, up, _ = (fixed(angle, 1) for angle in lens.field_of_view_deg)
            return f"{in_px}field of view {across} x {up} deg"
    return ""


def describe_fixed(precision: Precision) -> str:
    """Return a note that fixed coordinates do not count; empty if there are none."""
    count = precision.fixed_points
    return f"without the fixed coordinates of {counted(count, 'point')}" if count else ""


def words_left_out(findings: Findings) -> str:
    """Return what the comparison with the other adjuster omits from the survey; empty if nothing."""
    counts, fixed = findings.counts, findings.precision.fixed_points
    control = findings.result.adjustment.datum == "control"
    numbers = (
        (fixed if control else 0, "fixed point"),
        (counts.control, "control coordinate"),
        (counts.exterior, "observed exterior orientation parameter"),
        (counts.interior, "observed interior orientation parameter"),
        (counts.scale_bars, "scale bar"),
        (counts.further, "further observation"),
    )
    left_out = [counted(number, what) for number, what in numbers if number]
    return f"without {listed(left_out)}" if left_out else ""


def describe_rigs(rigs: Sequence[Rig], unit: str) -> Iterator[tuple[str, str]]:
    """Yield the name of each rig with the mount of a camera: base and angles with standard deviations."""
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


def fixed(value: float, decimals: int) -> str:
    """Write a number with a given number of decimals, and without a sign before zero."""
    return f"{float(value):z.{decimals}f}" if np.isfinite(value) else "not known"


def scientific(value: float, decimals: int) -> str:
    """Write a number with an exponent and a given number of decimals."""
    return f"{value:.{decimals}e}"


def general(value: float, digits: int) -> str:
    """Write a number with a maximum number of digits, with an exponent if that is shorter."""
    return f"{value:.{digits}g}"


def placed(value: float, size: float) -> str:
    """Write a coordinate with the decimals that give the largest one six digits.

    Args:
        value: a coordinate, in any unit.
        size: the largest coordinate written beside it, in the same unit.
    """
    return fixed(value, max(0, 5 - math.floor(math.log10(size)))) if size > 0 else general(value, 6)


def signed(value: float) -> str:
    """Write a difference with three significant digits and its sign."""
    return ("+" if value >= 0 else "") + significant(value)


def or_unlimited(value: float) -> str:
    """Write a reliability, which is unlimited if nothing checks an observation."""
    return "unlimited" if np.isinf(value) else significant(value)


def or_fixed(sigma: float) -> str:
    """Write the standard deviation of a coordinate, or "fixed" if it is zero."""
    return "fixed" if sigma == 0 else significant(sigma)


def alike(values: Sequence[float], digits: int = 3) -> tuple[str, ...]:
    """Write numbers of one quantity with significant digits, all with an exponent if one needs it."""
    written = tuple(significant(value, digits) for value in values)
    if not any("e" in number for number in written):
        return written
    return tuple(scientific(value, digits - 1) if np.isfinite(value) else "not known" for value in values)


def with_exponent(value: float, sigma: float) -> tuple[str, str]:
    """Write a parameter to the second digit of its sigma, and the sigma; small ones as m e-n.

    Args:
        value: the parameter.
        sigma: its standard deviation, NaN if it was held fixed, infinite if it is not determined.
    """
    if np.isinf(sigma):
        return (f"{value:.6g}", NOT_DETERMINED)
    if not (np.isfinite(sigma) and sigma > 0):
        return (f"{value:.6g}", "held fixed")
    if abs(value) >= MIN_PLAIN_VALUE or value == 0:
        return to_precision(value, sigma), significant(sigma, 2)
    power = int(np.floor(np.log10(abs(value))))
    decimals = int(np.clip(1 - np.floor(np.log10(sigma)) + power, 0, 12))
    mantissa = value / 10.0**power
    return f"{mantissa:.{decimals}f}e{power}", f"{sigma / 10.0**power:.{decimals}f}e{power}"


def with_sigma(value: float, sigma: float) -> tuple[str, str]:
    """Write a value to the second digit of its standard deviation, and the standard deviation.

    Args:
        value: a value of any unit.
        sigma: its standard deviation, 0 if it was held or defines the datum, NaN if it is not known.
    """
    if np.isnan(sigma):
        return f"{value:.9g}", "not known"
    if sigma > ROUNDING * (1 + abs(value)):
        return to_precision(value, sigma), significant(sigma, 2)
    return f"{round(value, 10) + 0.0:.9g}", "0"


def to_precision(value: float, sigma: float) -> str:
    """Write a coordinate to the second digit of its standard deviation, or with six decimals without one."""
    if not np.isfinite(value):
        return "not known"
    known = np.isfinite(sigma) and sigma > 0
    decimals = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 12)) if known else 6
    return f"{value:.{decimals}f}"


def raised(unit: str) -> str:
    """Write the exponent of a unit such as mm^-2 as a superscript; empty for a pure number."""
    if unit == "1":
        return ""
    base, _, power = unit.partition("^")
    return base + power.translate(SUPERSCRIPTS) if power else unit


def finer_unit_of(unit: str, *values: FloatArray) -> tuple[float, str]:
    """Return factor and unit as `finer_unit` does, for the largest known length of some arrays."""
    return finer_unit(unit, max(float(np.nanmax(np.abs(array), initial=0.0)) for array in values))


def length_of(value: float, unit: str, *, of_unknown: str = "object units") -> str:
    """Write a length in a readable unit, or with the given words if the unit is not known."""
    factor, finer = finer_unit(unit, value)
    return f"{significant(value * factor)} {finer or of_unknown}"


def is_number(text: str) -> bool:
    """Return whether a table cell is a number, which is right-aligned."""
    return text.lstrip("+-")[:1].isdigit() and not any(c.isalpha() for c in text.replace("e", ""))
