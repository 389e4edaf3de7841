"""Numbers as people read them: significant digits, exponents, units of a readable size.

Every report writes its numbers with these; the templates know them as filters of the same names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sfm.conventions import SUPERSCRIPTS, FloatArray
from sfm.conventions import finer_unit as finer_unit
from sfm.remarks.kind import probability as probability
from sfm.remarks.kind import significant as significant

MIN_PLAIN_VALUE = 1e-3  # below it parameters are written with an exponent
ROUNDING = 1e-10  # standard deviation over the value that is none
NOT_DETERMINED = "not determined"  # in place of an infinite standard deviation


def fixed(value: float, decimals: int) -> str:
    """Write a number with so many decimals, and no sign before zero."""
    return f"{float(value):z.{decimals}f}"


def scientific(value: float, decimals: int) -> str:
    """Write a number with an exponent and so many decimals before it."""
    return f"{value:.{decimals}e}"


def general(value: float, digits: int) -> str:
    """Write a number with at most so many digits, with an exponent where that is shorter."""
    return f"{value:.{digits}g}"


def placed(value: float, size: float) -> str:
    """Write a coordinate with the decimals that leave six digits of the largest one.

    Args:
        value: a coordinate, in any unit.
        size: the largest of all that are written beside it, in that unit.
    """
    return fixed(value, max(0, 5 - math.floor(math.log10(size)))) if size > 0 else general(value, 6)


def signed(value: float) -> str:
    """Write a difference with three significant digits and its sign."""
    return ("+" if value >= 0 else "") + significant(value)


def or_unlimited(value: float) -> str:
    """Write a reliability, which is unlimited where nothing checks an observation."""
    return "unlimited" if np.isinf(value) else significant(value)


def or_fixed(sigma: float) -> str:
    """Write the standard deviation of a coordinate, which a fixed one has not."""
    return "fixed" if sigma == 0 else significant(sigma)


def alike(values: Sequence[float], digits: int = 3) -> tuple[str, ...]:
    """Write numbers of one quantity with significant digits, all with an exponent if one has it."""
    written = tuple(significant(value, digits) for value in values)
    if not any("e" in one for one in written):
        return written
    return tuple(scientific(value, digits - 1) if np.isfinite(value) else "not known" for value in values)


def with_exponent(value: float, sigma: float) -> tuple[str, str]:
    """Write a parameter to the second digit of its standard deviation, and the latter; small ones as m e-n.

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
    """Write a value to the second digit of its standard deviation, and the latter.

    Args:
        value: of any unit.
        sigma: its standard deviation, 0 if it was held or defines the system, NaN if it is not known.
    """
    if np.isnan(sigma):
        return f"{value:.9g}", "not known"
    if sigma > ROUNDING * (1 + abs(value)):
        return to_precision(value, sigma), significant(sigma, 2)
    return f"{round(value, 10) + 0.0:.9g}", "0"


def to_precision(value: float, sigma: float) -> str:
    """Write a coordinate to the second digit of its standard deviation, six decimals if that is not known."""
    if not np.isfinite(value):
        return "not known"
    known = np.isfinite(sigma) and sigma > 0
    decimals = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 12)) if known else 6
    return f"{value:.{decimals}f}"


def raised(unit: str) -> str:
    """Write the exponent of a unit such as mm^-2 above the line, nothing for a pure number."""
    if unit == "1":
        return ""
    base, _, power = unit.partition("^")
    return base + power.translate(SUPERSCRIPTS) if power else unit


def finer_unit_of(unit: str, *values: FloatArray) -> tuple[float, str]:
    """Return the same for arrays of lengths, of which the largest known one counts."""
    return finer_unit(unit, max(float(np.nanmax(np.abs(array), initial=0.0)) for array in values))


def length_of(value: float, unit: str, *, of_unknown: str = "object units") -> str:
    """Write a length in a unit in which it reads well, or in the words for a unit that is not known."""
    factor, finer = finer_unit(unit, value)
    return f"{significant(value * factor)} {finer or of_unknown}"


def is_number(text: str) -> bool:
    """Whether a cell of a table is a number, which is set to the right."""
    return text.lstrip("+-")[:1].isdigit() and not any(c.isalpha() for c in text.replace("e", ""))
