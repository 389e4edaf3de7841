"""Units of length: those in which a length reads well, and those that are taken for one another."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sfm.conventions import METRES

METRIC = (("km", 1e3), ("m", 1.0), ("mm", 1e-3), ("µm", 1e-6))
"""metric units and their length in metres, largest first"""
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
IMPERIAL = ("in", "ft")
UNITS = {
    **{10.0: ("mm", "cm"), 100.0: ("cm", "m"), 1e3: ("mm", "m"), 1e6: ("um", "m")},
    **{25.4: ("mm", "inch"), 2.54: ("cm", "inch"), 1 / 0.0254: ("inch", "m"), 12.0: ("inch", "foot")},
    **{304.8: ("mm", "foot"), 30.48: ("cm", "foot"), 1 / 0.3048: ("foot", "m")},
}
"""factors of lengths by what the finer and the coarser unit are"""
POWERS_OF_TEN = (10.0, 100.0, 1e3, 1e6)
SAME_POWER = 0.02  # relative: a wrong scale beside a power of ten; no length is near one by chance
SWELLING = 0.002  # relative, of prints: paper swells by 1 to 2 permille


@dataclass(frozen=True)
class UnitFactor:
    """A factor of lengths as that of two units."""

    factor: float  # of UNITS, or 1 over it
    units: tuple[str, str]  # the finer and the coarser one


def finer_unit(unit: str, value: float) -> tuple[float, str]:
    """Return by what to multiply lengths of about this size, and the unit in which they read well.

    Args:
        unit: object unit of the survey. Lengths in feet and inches stay as they are; of a unit without a
            known length, as that of a network without scale, thousandths, millionths and so on are taken.
        value: the largest of the lengths, in that unit.
    """
    metres = METRES.get(unit)
    if not unit or unit in IMPERIAL or not math.isfinite(value) or value <= 0:
        return 1.0, unit
    if metres is None:
        power = min(0, 3 * math.floor(math.log10(value) / 3))
        return (10.0**-power, f"× 10{str(power).translate(SUPERSCRIPTS)} {unit}") if power else (1.0, unit)
    name, size = next(((n, s) for n, s in METRIC if value * metres >= s), METRIC[-1])
    return metres / size, name


def find_unit(lengths: float, rest: float) -> UnitFactor | None:
    """Return the factor between two units that a factor of lengths is; None if it is none.

    Args:
        lengths: factor.
        rest: relative difference from the factor of two units that is no contradiction; from a power of
            ten it may be SAME_POWER.
    """
    found: list[tuple[float, UnitFactor]] = []
    for size, units in UNITS.items():
        most = max(rest, SAME_POWER) if size in POWERS_OF_TEN else rest
        for factor in (size, 1 / size):
            off = abs(lengths / factor - 1)
            if off < most:
                found.append((off, UnitFactor(factor, units)))
    return min(found, key=lambda one: one[0])[1] if found else None
