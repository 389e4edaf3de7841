"""Units of length by the factors between them, and the one in which a length reads well."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from pydantic import TypeAdapter
from scipy.spatial.transform import Rotation

from sfm.model.conventions import METRES, UNITS, find_unit, finer_unit, rotation_from_vector
from sfm.survey.inputs.settings import Unit
from tests.synthetic import seed_of

MM = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "inch": 25.4, "foot": 304.8, "m": 1000.0}


def test_factors_are_those_between_their_units() -> None:
    assert len(UNITS) == 11
    for factor, (finer, coarser) in UNITS.items():
        assert factor == pytest.approx(MM[coarser] / MM[finer], rel=1e-12)


@pytest.mark.parametrize(
    ("lengths", "rest", "factor"),
    [
        (1015.0, 0.0, 1e3),  # a wrong scale beside a power of ten
        (1 / 985.0, 0.0, 1e-3),
        (1030.0, 0.0, None),
        (970.0, 0.0, None),
        (25.0, 0.01, None),
        (2.5, 0.01, None),  # no inch
        (25.41, 0.001, 25.4),
        (25.41, 0.0003, None),
        (11.2, 0.2, 12.0),  # the nearest one
        (10.8, 0.2, 10.0),
        (1.0, 0.1, None),
    ],
)
def test_a_factor_is_that_of_a_unit_where_the_rest_is_no_contradiction(
    lengths: float, rest: float, factor: float | None
) -> None:
    found = find_unit(lengths, rest)
    assert (found and found.factor) == (factor and pytest.approx(factor))


def test_nanometres_are_a_unit_of_surveys_and_plans() -> None:
    assert METRES["nm"] == 1e-9
    assert TypeAdapter(Unit).validate_python("nm") == "nm"
    assert set(METRES) == set(get_args(get_args(Unit)[0]))


def test_lengths_are_shown_in_a_unit_that_reads_well() -> None:
    assert finer_unit("m", 3.2e-5) == (pytest.approx(1e6), "µm")
    assert finer_unit("mm", 0.5) == (pytest.approx(1e3), "µm")
    assert finer_unit("m", 0.012) == (pytest.approx(1e3), "mm")
    assert finer_unit("ft", 1e-5) == (1.0, "ft") and finer_unit("", 1e-5) == (1.0, "")
    assert finer_unit("network units", 2.12e-5) == (1e6, "× 10⁻⁶ network units")
    assert finer_unit("network units", 0.5) == (1e3, "× 10⁻³ network units")
    assert finer_unit("network units", 5.0) == (1.0, "network units")


def test_a_rotation_by_a_vector_is_that_of_scipy() -> None:
    rng = seed_of("vectors")
    for length in (0.0, 1e-9, 1e-5, 1e-3, 0.3, 3.0):
        vectors = length * rng.normal(size=(20, 3))
        expected = Rotation.from_rotvec(vectors).as_matrix()
        np.testing.assert_allclose(rotation_from_vector(vectors), expected, atol=4e-16, rtol=1e-12)
