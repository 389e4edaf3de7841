"""Parts of pages on what was given beside the photographs: control, scale bars, exterior orientation."""

from __future__ import annotations

from sfm.adjustment.result import Adjustment
from sfm.display import counted
from sfm.report.findings.checks import CheckedControl
from sfm.report.findings.given_residuals import Given, GivenResiduals
from sfm.report.numbers import finer_unit_of, general, signed, significant, with_exponent
from sfm.report.page import Column, Folded, Heading, Note, Paragraph, Part, Table, axes
from sfm.report.phrases import words_of_w

R_AND_W = (
    "r: redundancy number (0 no check, 1 full check). w: the difference over its own standard deviation, "
    "that which was given times the root of r; by chance 1 of 1000 is beyond 3.3."
)
MAX_OPEN = 30  # photographs whose observed orientation is shown without a click


def given_parts(
    given: Given, adjustment: Adjustment, unit: str, check: CheckedControl | None = None
) -> tuple[Part, ...]:
    """Return how the given values fit.

    Args:
        given: their residuals.
        adjustment: in which they took part.
        unit: object unit.
        check: control that took no part, if there is any.
    """
    parts: list[Part] = []
    if check is not None:
        parts += _check(check, adjustment, unit)
    if given.control is not None:
        parts += _control(given.control, unit)
    if given.bars is not None:
        parts += _bars(given.bars, adjustment, unit)
    for kind in given.further:
        parts += _further(kind)
    if given.exterior:
        note = Note(f"d: adjusted minus given, s: given standard deviation. {R_AND_W}")
        parts += [Heading("Observed exterior orientation"), note, *map(_exterior, given.exterior)]
    return tuple(parts)


def _check(found: CheckedControl, adjustment: Adjustment, unit: str) -> tuple[Part, ...]:
    """Return the differences at control that took no part."""
    check = found.check
    factor, finer = finer_unit_of(unit, check.differences)
    placed = "shift, rotation and scale; the scale was taken from the control."
    if adjustment.network.scale_bars:
        placed = (
            "shift and rotation, in the scale of the scale bars; the control says lengths are "
            f"{general(check.scale, 9)} times those of the scale bars."
        )
    note = Note(
        "The control took no part in the adjustment. The result was placed on it afterwards by "
        f"{placed} Differences at each point, placed minus nominal [{finer}]:"
    )
    columns = (
        *(Column("control point"), *axes("d", "", signed, factor=factor)),
        Column("length", format=significant, factor=factor),
    )
    rows = [(n, *d, s) for n, d, s in zip(check.points, check.differences, found.length, strict=True)]
    rms = ("RMS", *(significant(factor * one) for one in check.rms), found.rms_length)
    return Heading("Check at the control"), note, Table(columns, rows, total=rms)


def _control(found: GivenResiduals, unit: str) -> tuple[Part, ...]:
    factor, finer = finer_unit_of(unit, found.difference)
    if not found.checked:
        points = counted(len(found.names), "control point")
        words = f"{points} held fixed: adjusted coordinates are those given, without residuals."
        return Heading("Control"), Paragraph(words)
    note = Note(f"d: adjusted minus given, s: given standard deviation [{finer}]. {R_AND_W}")
    return Heading("Control"), note, _residuals(found, "control point", factor, unknown="not known")


def _bars(found: GivenResiduals, adjustment: Adjustment, unit: str) -> tuple[Part, ...]:
    factor, finer = finer_unit_of(unit, found.difference, found.sigma)
    columns = (
        *(Column("scale bar"), Column("given", "", unit, ".9g")),
        Column("adjusted minus given", "", finer, signed, factor),
        Column("sigma given", "", finer, significant, factor),
        *(Column("r", format="z.3f"), Column("w", format=str)),
    )
    rows = [
        (one.name, one.given, one.difference, one.sigma, one.r, words_of_w(one.w, one.r))
        for one in found.values
    ]
    parts = (Heading("Scale bars"), Note(R_AND_W), Table(columns, rows))
    if len(rows) > 1 or adjustment.datum == "control":
        return parts
    return *parts, Note("A single bar gives the scale and cannot be checked; two or more check one another.")


def _further(found: GivenResiduals) -> tuple[Part, ...]:
    columns = (
        *(Column(found.kind), Column(), Column("given", format=str), Column("sigma given", format=str)),
        *(Column("adjusted minus given", format=signed), Column("unit")),
        *(Column("r", format="z.3f"), Column("w", format=str)),
    )
    rows = [
        (one.name, one.coordinate, *with_exponent(one.given, one.sigma), one.difference, one.unit, one.r,
         words_of_w(one.w, one.r))
        for one in found.values
    ]  # fmt: skip
    table = Folded(counted(len(rows), "value"), Table(columns, rows), open=len(rows) < MAX_OPEN)
    return Heading(f"Observations: {found.kind}"), Note(R_AND_W), table


def _exterior(found: GivenResiduals) -> Part:
    factor, finer = finer_unit_of(found.units[0][0], found.difference)
    count = len(found.names)
    title = f"{', '.join(found.coordinates)} of {counted(count, 'photograph')} [{finer}]"
    return Folded(title, _residuals(found, "photograph", factor, gap=" ", rms=True), open=count < MAX_OPEN)


def _residuals(
    found: GivenResiduals, what: str, factor: float, *, gap: str = "", unknown: str = "", rms: bool = False
) -> Table:
    """Return residuals d of given values, their given standard deviations s, r and w.

    Args:
        found: the residuals.
        what: names of the first column, in the singular.
        factor: from the object unit to that of the page.
        gap: between the letter and the name of a coordinate.
        unknown: in place of a standard deviation that is not known.
        rms: whether a last row has the root mean squares of d.
    """
    letters = (
        ("d", signed, factor, ""),
        ("s", significant, factor, unknown),
        ("r", "z.3f", 1.0, ""),
        ("w", str, 1.0, None),
    )
    columns = [
        Column(f"{letter}{gap}{axis}", format=write, factor=of, unknown=blank)
        for letter, write, of, blank in letters
        for axis in found.coordinates
    ]
    rows = [
        (
            *(name, *d, *("fixed" if one == 0 else one for one in s), *r),
            *(words_of_w(one, its_r) for one, its_r in zip(w, r, strict=True)),
        )
        for name, d, s, r, w in zip(found.names, found.difference, found.sigma, found.r, found.w, strict=True)
    ]
    size = len(found.coordinates)
    sums = ("RMS", *(significant(factor * one) for one in found.rms), *[""] * (3 * size)) if rms else None
    return Table((Column(what), *columns), rows, total=sums)
