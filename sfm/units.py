"""Units of length that are taken for one another, recognised by the factor of lengths."""

from __future__ import annotations

from dataclasses import dataclass

UNITS = {
    **{10.0: ("mm", "cm"), 100.0: ("cm", "m"), 1e3: ("mm", "m"), 1e6: ("um", "m")},
    **{25.4: ("mm", "inch"), 2.54: ("cm", "inch"), 1 / 0.0254: ("inch", "m"), 12.0: ("inch", "foot")},
    **{304.8: ("mm", "foot"), 30.48: ("cm", "foot"), 1 / 0.3048: ("foot", "m")},
}
"""factors of lengths by what the finer and the coarser unit are"""
SAME_UNIT = 0.02  # relative difference up to which a factor is that of a unit; 10 and 12 are 0.2 apart


@dataclass(frozen=True)
class UnitFactor:
    """A factor of lengths as that of two units."""

    factor: float  # of UNITS, or 1 over it
    units: tuple[str, str]  # the finer and the coarser one


def find_unit(lengths: float) -> UnitFactor | None:
    """Return the factor between two units that a factor of lengths is nearly; None if it is none."""
    for size, units in UNITS.items():
        for factor in (size, 1 / size):
            if abs(lengths / factor - 1) < SAME_UNIT:
                return UnitFactor(factor, units)
    return None
