"""The catalogue of remarks: a row for each kind, in one module for each subject.

A new kind is one row. `docs/symptoms.md` has its table from here.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from sfm.remarks.catalogue import (
    adjustment,
    batches,
    cameras,
    comparisons,
    datum,
    drafting,
    given_values,
    hypotheses,
    inputs,
    measuring,
    other_programs,
    photographs,
    plans,
    points,
    refining,
)
from sfm.remarks.kind import Kind

SUBJECTS: Mapping[str, tuple[Kind, ...]] = MappingProxyType(
    {
        "The adjustment": adjustment.ROWS,
        "Causes and assumptions": hypotheses.ROWS,
        "Cameras": cameras.ROWS,
        "Photographs": photographs.ROWS,
        "Points and image points": points.ROWS,
        "Datum and scale": datum.ROWS,
        "Scale bars, control and observed orientation": given_values.ROWS,
        "Other programs": other_programs.ROWS,
        "Refining": refining.ROWS,
        "Drafts of survey files": drafting.ROWS,
        "Batches and validation": batches.ROWS,
        "Input": inputs.ROWS,
        "Comparisons and epochs": comparisons.ROWS,
        "Measuring and acceptance": measuring.ROWS,
        "Plans": plans.ROWS,
    }
)
KINDS: Mapping[str, Kind] = MappingProxyType({row.name: row for rows in SUBJECTS.values() for row in rows})
