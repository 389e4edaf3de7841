"""Kind: a row of the catalogue of remarks, and the sentences that it makes of a remark.

Sentence, cause and remedy are texts with fields in braces, one for each part of the remark:

    {point}                 names, listed          {distance}            number with its unit
    {points:point}          "3 points"             {count:point}         the same of a number
    {points:is|are}         by the count           {count:is|are}        the same of a number
    {change:+}              with its sign          {share:%}             100 times, with %
    {p:<}                   "p = 0.012", "p < 0.001"
    {of:@}                  nouns by their keys    {given:@bar}          of others "bar 1 - 2"

Text in [[ ]] appears only if the remark has all parts in it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sfm.conventions import METRES, finer_unit
from sfm.display import agreeing, listed, plural
from sfm.remarks.remark import SEVERITIES, Quantity, Remark, Severity

# Standard deviations beyond which a value is wrong: noise makes so large an error once in a million
# coordinates, and where it is the root mean square of all, nothing of a result is right.
WRONG_SIGMAS = 5.0
MIN_PROBABILITY = 1e-3  # smaller ones are written as less than it
# Below these a shifted result stays within the limits that anybody expects: 99.7 % of normally distributed
# errors are within (Pukelsheim 1994, "The three sigma rule", The American Statistician 48(2)).
EXPECTED_SIGMAS = 3.0
NOUNS = {  # what a remark may be of, by the names in its data
    "bars": "the scale bars",
    "cameras": "Interior parameters",
    "centres": "the projection centres",
    "control": "the control points",
    "coordinates": "Coordinates",
    "coordinates without control": "Coordinates of the network without the control points",
    "lengths": "the given lengths",
    # mistakes in tables of survey observations
    "counter-clockwise": "directions are counted counter-clockwise",
    "elevation": "angles are counted from the horizon",
    "exchanged": "both ends are exchanged",
    "feet": "lengths are in feet",
    "gon": "angles are in gon",
    "mirrored": "coordinates are those of a mirrored system",
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
class Grade:
    """Severity by a number of the remark: a note below `warning`, an error from `error` on."""

    number: str
    warning: float = -np.inf
    error: float = np.inf
    also: Grade | None = None  # of another number; the more serious of the two counts
    at_most: Grade | None = None  # likewise; the less serious of the two counts

    def severity_of(self, one: Remark) -> Severity:
        """Return the severity of a remark."""
        found = self.of(one.number(self.number))
        if self.at_most is not None:
            found = max(found, self.at_most.severity_of(one), key=SEVERITIES.index)
        if self.also is not None:
            found = min(found, self.also.severity_of(one), key=SEVERITIES.index)
        return found

    def of(self, value: float) -> Severity:
        """Return the severity of a value; a number that is not known is as bad as can be."""
        if np.isnan(value):
            return "error" if np.isfinite(self.error) else "warning"
        return "error" if value >= self.error else "warning" if value >= self.warning else "note"


@dataclass(frozen=True)
class Kind:
    """A row of the catalogue."""

    name: str
    severity: Severity | Grade
    sentence: str  # with fields, see above
    cause: str  # why it happens; fields as of the sentence
    remedy: str  # what to do; likewise
    short: str = ""  # what it is called in the sentences of others, whose subjects have its name
    explains: tuple[str, ...] = ()  # kinds that follow from it, whose remedies would mislead beside it

    @property
    def fields(self) -> frozenset[str]:
        """Names of the parts that the sentence shows."""
        return frozenset(name for name, _ in FIELD.findall(self.sentence))

    def severity_of(self, one: Remark) -> Severity:
        """Return the severity of a remark of this kind."""
        if isinstance(self.severity, Grade):
            return self.severity.severity_of(one)
        return self.severity

    def write(self, text: str, one: Remark) -> str:
        """Return a text of this kind, its sentence, cause or remedy, with the parts of a remark.

        Raises:
            KeyError: a part is missing that is not optional.
        """
        stated: dict[str, tuple[str, ...] | Quantity] = {**one.subjects, **one.numbers}
        parts = {**stated, **_readable(one.numbers)}

        def optional(found: re.Match[str]) -> str:
            inner = found.group(1)
            return inner if all(name in parts for name, _ in FIELD.findall(inner)) else ""

        text = OPTIONAL.sub(optional, text)

        def field(found: re.Match[str]) -> str:
            name, spec = found.group(1), found.group(2) or ""
            return _written(stated if spec.startswith(".") else parts, name, spec)  # decimals are of its unit

        return FIELD.sub(field, text)


def _readable(numbers: Mapping[str, Quantity]) -> dict[str, Quantity]:
    """Return numbers with lengths in the metric unit in which the largest reads well, or in a larger one."""
    largest: dict[str, float] = {}
    for one in numbers.values():
        if one.unit in METRES and np.isfinite(one.value):
            largest[one.unit] = max(abs(one.value), largest.get(one.unit, 0.0))
    finer = {unit: finer_unit(unit, value) for unit, value in largest.items()}
    shown = dict(numbers)
    for name, one in numbers.items():
        factor, unit = finer.get(one.unit, (1.0, one.unit))
        if factor > 1:
            shown[name] = Quantity(factor * one.value, unit)
    return shown


def _written(parts: Mapping[str, tuple[str, ...] | Quantity], name: str, spec: str) -> str:
    """Write one part as its field asks for."""
    part = parts[name]
    count = part.value if isinstance(part, Quantity) else len(part)
    if "|" in spec:
        return agreeing(count, spec)
    if spec and spec[0].isalpha():
        return f"{count:,.0f} {plural(spec, count)}"
    if not isinstance(part, Quantity):
        return listed(_nouns(part, spec[1:]) if spec else part)
    return _number(part, spec)


def _nouns(names: tuple[str, ...], other: str) -> list[str]:
    """Return the nouns of names, and the names that have none behind another noun."""
    return [NOUNS.get(name) or f"{other} {name}".lstrip() for name in names]


def _number(one: Quantity, spec: str) -> str:
    """Write a number with three significant digits, or as the format asks, and its unit."""
    if not np.isfinite(one.value):
        return "not known"
    if spec == "<":
        return probability(one.value)
    if spec == "%":
        return f"{significant(100 * one.value)} %"
    if spec == "+":
        text = ("+" if one.value >= 0 else "") + significant(one.value)
    elif spec:
        text = format(one.value, spec)
    elif not one.unit and float(one.value).is_integer() and abs(one.value) < 1e15:
        text = f"{one.value:,.0f}"
    else:
        text = significant(one.value)
    return f"{text} {one.unit}".rstrip()


def significant(value: float, digits: int = 3) -> str:
    """Write a number with so many significant digits and no exponent where that is short."""
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
    """Write a probability with "p" before it and three decimals, smaller ones as such."""
    return f"p < {MIN_PROBABILITY:g}" if value < MIN_PROBABILITY else f"p = {value:.3f}"
