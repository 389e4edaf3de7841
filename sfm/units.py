"""Units of length that are taken for one another, recognised by the factor of lengths."""

from __future__ import annotations

from dataclasses import dataclass

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
