"""The catalogue of remarks: a row for each kind, in one module for each subject.

A new kind is one row. `docs/symptoms.md` has its table from here.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from sfm.remarks.catalogue import hypotheses
from sfm.remarks.kind import Kind
from sfm.remarks.remark import Remark, Severity

SUBJECTS: Mapping[str, tuple[Kind, ...]] = MappingProxyType({"Causes and assumptions": hypotheses.ROWS})
KINDS: Mapping[str, Kind] = MappingProxyType({row.name: row for rows in SUBJECTS.values() for row in rows})


def severity_of(one: Remark) -> Severity:
    """Return the severity of a remark."""
    return KINDS[one.kind].severity_of(one)


def sentence_of(one: Remark) -> str:
    """Return the sentence of a remark."""
    return KINDS[one.kind].sentence_of(one)
