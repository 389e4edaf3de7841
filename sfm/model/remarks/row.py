"""Rows of the catalogue of remarks: kinds of remarks and tests, and how their texts are filled.

A row of the catalogue is a `Kind`, or `Tested` of the table of tests, and turns a remark into sentences.

Their texts have fields in braces. Each field shows one part of the remark:

    {point}                 names, listed          {distance}            number with its unit
    {parameters:@all}       all names, listed
    {points:point}          "3 points"             {count:point}         the same for a number
    {points:is|are}         agrees with the count  {count:is|are}        the same for a number
    {change:+}              with its sign          {share:%}             in per cent
    {p:<}                   "p = 0.012", "p < 0.001"
    {of:@}                  nouns of NOUNS         {given:@bar}          other names as "bar 1 - 2"
    {mistake:@?}            nouns, of which any explains

Text in [[ ]] appears only if the remark has all parts that it contains.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sfm.model.conventions import METRES, finer_unit
from sfm.model.display import MAX_LISTED, agreeing, listed, plural

Severity = Literal["note", "warning", "error"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")  # the most serious first
# A value that is further off than this number of standard deviations is wrong, and a result with such a
# coordinate too. Noise causes an error of this size once in a million coordinates.
WRONG_SIGMAS = 5.0
DIGITS, MAX_DIGITS = 3, 12  # significant digits of a number; more distinguish it from others of its unit
# Square of the largest over the smallest length that a survey may state: no number of a survey is larger.
LARGEST_SAID = (1e12 / 1e-9) ** 2
MIN_PROBABILITY = 1e-3  # smaller probabilities are written as "p < 0.001"
# Noise stays below this number of standard deviations in 99.7 % of all cases (Pukelsheim 1994, "The three
# sigma rule", The American Statistician 48(2)); a result that shifts by the rest only is not wrong with it.
EXPECTED_SIGMAS = 3.0
HARMLESS_SIGMAS = WRONG_SIGMAS - EXPECTED_SIGMAS
NOUNS = {  # subjects of remarks, by their names in the data
    # plates, by their codes
    "aprilgrid": "AprilGrid",
    "charuco": "ChArUco board",
    "checkerboard": "checkerboard",
    "grid": "calibration plate",
    "adjuster": "another adjuster",
    "bars": "the scale bars",
    "cameras": "Interior parameters",
    "centres": "the projection centres",
    "in common": "pairs with most in common",
    "listed": "the pairs of the given list",
    "control": "the control points",
    "coordinates": "Coordinates",
    "coordinates without control": "Coordinates of the network without the control points",
    "coordinates without the other photographs": "Coordinates of a part of the network",
    "datum": "the datum points",
    "diameters": "the targets with given diameters",
    "observations": "the survey observations",
    "covariance": "covariances",
    "jointly": "those whose joint covariance both results store",
    "singly": "approximate: the covariance between points is not known",
    "sigmas": "standard deviations",
    "steadily": "steadily through the sequence",
    "alike": "at the same values",
    "apart": "at different values or in one of them",
    "lengths": "the given lengths",
    "pipeline": "another pipeline",
    "object": "the object reversed in depth",
    "scale": "the scale",
    # what a plan assumes
    "known scale": "a scale without error",
    "no surface": "that no surface hides a point",
    "no normals": "that points are seen from everywhere",
    "precision of targets": "the precision that the targets allow, without errors of lens and sensor",
    "no depth of field": "that all distances are sharp",
    # what shows which of two parts is mirrored
    "known handedness": "The handedness of codes or control",
    "most photographs": "The larger number of the others",
    # mistakes in tables of survey observations
    "axes": "X and Y are exchanged",
    "counter-clockwise": "directions are counted counter-clockwise",
    "depth": "Z has the other sign",
    "elevation": "angles are counted from the horizon",
    "exchanged": "both ends are exchanged",
    "feet": "lengths are in feet",
    "gon": "angles are in gon",
    "mirrored": "coordinates are those of a mirrored system",
    "radians": "angles are in radians",
    "thousandfold": "lengths are divided by 1000, as from mm to m",
    "thousandth": "lengths are multiplied by 1000, as from m to mm",
    # mistakes in tables of mounts
    "inverse pose": "it is the inverse pose, of the reference camera in the axes of this one",
    "inverse rotation": "its rotation is the inverse, from the axes of the rig to those of the image",
    "opposite base": "the signs of X, Y and Z are changed",
}
FIELD = re.compile(r"\{(\w+)(?::([^{}]*))?\}")
OPTIONAL = re.compile(r"\[\[(.*?)\]\]", re.S)


@dataclass(frozen=True)
class Quantity:
    """A number with its unit; a dimensionless number has an empty unit."""

    value: float
    unit: str = ""


@dataclass(frozen=True)
class Said:
    """What a remark says: names and numbers, by their roles in its sentence."""

    kind: str  # row of the catalogue
    subjects: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # names by their role
    numbers: Mapping[str, Quantity] = field(default_factory=dict)

    def number(self, name: str) -> float:
        """Return the value of a number, or NaN if the remark has no number of that name."""
        quantity = self.numbers.get(name)
        return math.nan if quantity is None else quantity.value

    def names(self, role: str) -> tuple[str, ...]:
        """Return the names of the subjects of a role; an empty tuple if the remark has no such role."""
        return self.subjects.get(role, ())


@dataclass(frozen=True)
class Grade:
    """Severity by a number of the remark: a note below `warning`, an error at `error` and above."""

    number: str
    warning: float = -np.inf
    error: float = np.inf
    also: Grade | None = None  # of another number, if there is one; the more serious severity counts
    at_most: Grade | None = None  # grade of another number; the less serious severity counts

    def severity_of(self, said: Said) -> Severity:
        """Return the severity of a remark."""
        severity = self.of(said.number(self.number))
        if self.at_most is not None:
            severity = max(severity, self.at_most.severity_of(said), key=SEVERITIES.index)
        if self.also is not None and self.also.number in said.numbers:
            severity = min(severity, self.also.severity_of(said), key=SEVERITIES.index)
        return severity

    def of(self, value: float) -> Severity:
        """Return the severity of a value; NaN has the worst severity of this grade."""
        if np.isnan(value):
            return "error" if np.isfinite(self.error) else "warning"
        return "error" if value >= self.error else "warning" if value >= self.warning else "note"


@dataclass(frozen=True)
class Unless:
    """Severity of a remark, and a lower one of a remark that has a part, such as the cause of an error."""

    parts: tuple[str, ...]  # any of these
    severity: Severity
    named: Severity

    def severity_of(self, said: Said) -> Severity:
        """Return the severity of a remark."""
        known = any(said.names(part) or part in said.numbers for part in self.parts)
        return self.named if known else self.severity


@dataclass(frozen=True)
class Row:
    """A row of the catalogue."""

    name: str

    def write(self, text: str, said: Said) -> str:
        """Fill the fields of a text with the parts of a remark.

        Args:
            text: text of this row.
            said: the remark.

        Raises:
            KeyError: a part that is not optional is missing.
        """
        stated: dict[str, tuple[str, ...] | Quantity] = {**said.subjects, **said.numbers}
        parts = {**stated, **_readable(said.numbers)}

        def optional(match: re.Match[str]) -> str:
            inner = match.group(1)
            return inner if all(name in parts for name, _ in FIELD.findall(inner)) else ""

        text = OPTIONAL.sub(optional, text)

        def field(match: re.Match[str]) -> str:
            name, spec = match.group(1), match.group(2) or ""
            # decimals refer to the stored unit
            return _written(stated if spec.startswith(".") else parts, name, spec)

        return FIELD.sub(field, text)


@dataclass(frozen=True)
class Tested(Row):
    """A row of the table "What was tested": a test, and its result or why there is none."""

    test: str
    on: str  # what was tested, with fields
    result: str  # with fields


@dataclass(frozen=True)
class Kind(Row):
    """A kind of remark, which leads a reader to an action."""

    severity: Severity | Grade | Unless
    sentence: str  # with fields, see the module docstring
    cause: str  # why it happens, with the same fields
    remedy: str  # advice, with the same fields
    short: str = ""  # noun for it in sentences of other remarks that have this kind as a subject
    explains: tuple[str, ...] = ()  # kinds that follow from it and whose remedies would mislead

    @property
    def fields(self) -> frozenset[str]:
        """Names of the parts in the sentence."""
        return frozenset(name for name, _ in FIELD.findall(self.sentence))

    def severity_of(self, said: Said) -> Severity:
        """Return the severity of a remark of this kind."""
        if isinstance(self.severity, str):
            return self.severity
        return self.severity.severity_of(said)


def _readable(numbers: Mapping[str, Quantity]) -> dict[str, Quantity]:
    """Return the numbers with lengths in a finer metric unit if their largest value reads better in it."""
    largest: dict[str, float] = {}
    for quantity in numbers.values():
        if quantity.unit in METRES and np.isfinite(quantity.value):
            largest[quantity.unit] = max(abs(quantity.value), largest.get(quantity.unit, 0.0))
    finer = {unit: finer_unit(unit, value) for unit, value in largest.items()}
    shown = dict(numbers)
    for name, quantity in numbers.items():
        factor, unit = finer.get(quantity.unit, (1.0, quantity.unit))
        if factor > 1:
            shown[name] = Quantity(factor * quantity.value, unit)
    return shown


def _written(parts: Mapping[str, tuple[str, ...] | Quantity], name: str, spec: str) -> str:
    """Format one part as the specification of its field asks."""
    part = parts[name]
    count = part.value if isinstance(part, Quantity) else len(part)
    if "|" in spec:
        return agreeing(count, spec)
    if spec and spec[0].isalpha():
        return f"{count:,.0f} {plural(spec, count)}"
    if spec == "@?" and not isinstance(part, Quantity):
        return listed(_nouns(part, ""), separator=", or if ")
    if not isinstance(part, Quantity):
        names = part if spec in ("", "@all") else _nouns(part, spec[1:])
        return listed(names, most=len(names) if spec == "@all" else MAX_LISTED)
    others = [
        other.value
        for other in parts.values()
        if isinstance(other, Quantity) and other.unit == part.unit != "" and other.value != part.value
    ]
    # as many significant digits as distinguish it from all others of its unit in the sentence
    digits = DIGITS
    while digits < MAX_DIGITS and significant(part.value, digits) in {
        significant(other, digits) for other in others
    }:
        digits += 1
    return _number(part, spec, digits)


def _nouns(names: tuple[str, ...], other: str) -> list[str]:
    """Return the nouns of names; a name that is none, such as "the first table", follows `other`."""
    others = {name: name if name.startswith("the ") else f"{other} {name}".lstrip() for name in names}
    return [NOUNS.get(name, others[name]) for name in names]


def _number(quantity: Quantity, spec: str, digits: int) -> str:
    """Format a number and its unit, with so many significant digits unless the field asks otherwise."""
    if not abs(quantity.value) <= LARGEST_SAID:
        return "not known"
    if spec == "<":
        return probability(quantity.value)
    if spec == "%":
        return f"{significant(100 * quantity.value)} %"
    if spec == "+":
        text = ("+" if quantity.value >= 0 else "") + significant(quantity.value, digits)
    elif spec:
        text = format(quantity.value, spec)
    elif not quantity.unit and float(quantity.value).is_integer() and abs(quantity.value) < 1e15:
        text = f"{quantity.value:,.0f}"
    else:
        text = significant(quantity.value, digits)
    return f"{text} {quantity.unit}".rstrip()


def significant(value: float, digits: int = DIGITS) -> str:
    """Format a number with significant digits, with an exponent only if it is very large or small.

    Args:
        value: the number.
        digits: number of significant digits.
    """
    value = float(value)
    if not np.isfinite(value):
        return "not known"
    if value == 0:
        return "0"
    exponent = int(np.floor(np.log10(abs(value))))
    if -6 <= exponent < 7:
        return f"{value:.{max(0, digits - 1 - exponent)}f}"
    return f"{value:.{digits - 1}e}"


def probability(value: float) -> str:
    """Format a probability as "p = 0.012", with three decimals, or as "p < 0.001" if it is smaller."""
    return f"p < {MIN_PROBABILITY:g}" if value < MIN_PROBABILITY else f"p = {value:.3f}"
