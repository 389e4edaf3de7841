"""Remark: one finding about a result, as data.

Each kind of remark is a row of the catalogue (`sfm.model.remarks.catalogue`). Code that finds something
returns a remark of that kind with its subjects and numbers, and contains no English. The catalogue supplies
the sentence, the cause and the remedy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sfm.model.remarks.catalogue import KINDS, TESTS
from sfm.model.remarks.row import SEVERITIES, Kind, Quantity, Said, Severity, Tested


@dataclass(frozen=True)
class Remark(Said):
    """One finding about a result.

    Example:
        >>> from sfm.model.remarks.remark import remark
        >>> one = remark("two_places", point="12", distance=(0.3, "mm"), sigmas=8.0)
        >>> one.number("sigmas"), one.names("point")
        (8.0, ('12',))
    """

    at_least: Severity = "note"  # worst severity of the remarks that it explains

    @property
    def row(self) -> Kind:
        """Row of its kind in the catalogue; KeyError for a test."""
        return KINDS[self.kind]

    @property
    def test(self) -> Tested | None:
        """Row of the table of tests; None if it is a remark that leads to an action."""
        return TESTS.get(self.kind)

    @property
    def tested(self) -> tuple[str, str, str]:
        """Test, what was tested, and the result or why there is none, of a row of the table of tests."""
        row = TESTS[self.kind]
        return self._write(row.test), self._write(row.on), self._write(row.result)

    @property
    def is_known(self) -> bool:
        """Whether the catalogue has its kind, with texts that its parts fill."""
        try:
            return bool(self.text) and (self.test is not None or bool(self.cause and self.remedy))
        except KeyError:
            return False

    @property
    def severity(self) -> Severity:
        """Severity, from the catalogue and from the remarks that it explains: note, warning or error."""
        if self.test is not None:
            return "note"
        return min(self.row.severity_of(self), self.at_least, key=SEVERITIES.index)

    @property
    def text(self) -> str:
        """Sentence of the catalogue; of a test what was tested, and the result."""
        if self.test is not None:
            return "{}, {}: {}.".format(*self.tested)
        return self._write(self.row.sentence)

    @property
    def cause(self) -> str:
        """Cause, as the catalogue states it."""
        return self._write(self.row.cause)

    @property
    def remedy(self) -> str:
        """Remedy of the catalogue."""
        return self._write(self.row.remedy)

    def _write(self, text: str) -> str:
        subjects = {  # kinds are replaced by their short names
            role: tuple(KINDS[name].short or name if name in KINDS else name for name in names)
            for role, names in self.subjects.items()
        }
        return (self.test or self.row).write(text, replace(self, subjects=subjects))

    def as_dict(self) -> dict[str, Any]:
        """Return the remark for JSON: kind, subjects, numbers with units, and its texts.

        The texts of a remark are severity, text, cause and remedy; those of a test are test, on and result.
        """
        if self.test is None:
            texts = {"severity": self.severity, "text": self.text, "cause": self.cause, "remedy": self.remedy}
        else:
            texts = dict(zip(("test", "on", "result"), self.tested, strict=True))
        return {
            "kind": self.kind,
            **texts,
            "subjects": {role: list(names) for role, names in self.subjects.items()},
            "numbers": {
                name: {
                    "value": quantity.value if math.isfinite(quantity.value) else None,
                    "unit": quantity.unit,
                }
                for name, quantity in self.numbers.items()
            },
        }


def remark(kind: str, **parts: str | Iterable[str] | float | tuple[float, str] | Quantity | None) -> Remark:
    """Return a remark of a kind.

    Args:
        kind: row of the catalogue.
        parts: parts of the sentence by name: names of subjects, a number, or a number with its unit. A part
            that is None is left out.

    Raises:
        KeyError: the catalogue has no such kind.
    """
    if kind not in TESTS:
        KINDS[kind]  # a misspelt kind fails where the remark is made
    subjects: dict[str, tuple[str, ...]] = {}
    numbers: dict[str, Quantity] = {}
    for name, part in parts.items():
        if part is None:
            continue
        if isinstance(part, str):
            subjects[name] = (part,)
        elif isinstance(part, Quantity):
            numbers[name] = part
        elif isinstance(part, tuple) and len(part) == 2 and not isinstance(part[0], str):
            numbers[name] = Quantity(float(part[0]), part[1])
        elif isinstance(part, Iterable):
            subjects[name] = tuple(part)
        else:
            numbers[name] = Quantity(float(part))
    return Remark(kind, subjects, numbers)


def unless_note(said: Remark) -> tuple[Remark, ...]:
    """Return the remark in a tuple if it is more serious than a note, else an empty tuple."""
    return () if said.severity == "note" else (said,)


def of_kind(remarks: Iterable[Remark], *kinds: str) -> tuple[Remark, ...]:
    """Return the remarks of the given kinds, in their order."""
    return tuple(said for said in remarks if said.kind in kinds)


def kinds_of(remarks: Iterable[Remark]) -> tuple[str, ...]:
    """Return the kind of each remark, in their order."""
    return tuple(said.kind for said in remarks)


def together(remarks: Sequence[Remark]) -> Remark:
    """Return one remark for several of a kind: the subjects of all, and the numbers of the largest shift."""
    sizes = ("shift", "distance")
    largest = max(
        remarks, key=lambda said: [said.numbers[name].value for name in sizes if name in said.numbers]
    )
    roles = dict.fromkeys(role for said in remarks for role in said.subjects)
    subjects = {
        role: tuple(dict.fromkeys(name for said in remarks for name in said.subjects.get(role, ())))
        for role in roles
    }
    return replace(largest, subjects=subjects)
