"""Units of length by the factors between them."""

from __future__ import annotations

import pytest

from sfm.units import UNITS, find_unit

MM = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "inch": 25.4, "foot": 304.8, "m": 1000.0}


def test_factors_are_those_between_their_units() -> None:
    assert len(UNITS) == 11
    for factor, (finer, coarser) in UNITS.items():
        assert factor == pytest.approx(MM[coarser] / MM[finer], rel=1e-12)


@pytest.mark.parametrize(
    ("lengths", "factor"),
    [
        (1015.0, 1e3),
        (1 / 985.0, 1e-3),
        (1030.0, None),
        (970.0, None),
        (25.0, 25.4),
        (11.0, None),
        (1.0, None),
    ],
)
def test_a_factor_is_that_of_a_unit_within_two_percent(lengths: float, factor: float | None) -> None:
    found = find_unit(lengths)
    assert (found and found.factor) == (factor and pytest.approx(factor))
