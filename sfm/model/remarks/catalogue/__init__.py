"""The catalogue of remarks: one row for each kind, and one module for each subject. `tested` has the tests.

To add a kind, add a row. The tables in `docs/symptoms.md` are generated from these rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from sfm.model.remarks.catalogue import (
    cameras,
    comparisons,
    given_values,
    hypotheses,
    measuring,
    photographs,
    plans,
    tested,
)
from sfm.model.remarks.row import Kind, Tested

SUBJECTS: Mapping[str, tuple[Kind, ...]] = MappingProxyType(
    {
        "The adjustment": hypotheses.ADJUSTMENT,
        "Causes and assumptions": hypotheses.ROWS,
        "Cameras": cameras.ROWS,
        "Calibrations": cameras.CALIBRATIONS,
        "Photographs": photographs.ROWS,
        "Points and image points": measuring.POINTS,
        "Datum and scale": given_values.DATUM,
        "Scale bars, control and observed orientation": given_values.ROWS,
        "Other programs": comparisons.OTHER_PROGRAMS,
        "Refining": comparisons.REFINING,
        "Drafts of survey files": photographs.DRAFTS,
        "Batches": plans.BATCHES,
        "Input": photographs.INPUT,
        "Comparisons and epochs": comparisons.ROWS,
        "Measuring and acceptance": measuring.ROWS,
        "Plans": plans.ROWS,
    }
)
KINDS: Mapping[str, Kind] = MappingProxyType({row.name: row for rows in SUBJECTS.values() for row in rows})
TESTS: Mapping[str, Tested] = MappingProxyType({row.name: row for row in tested.ROWS})
