"""Parts of pages on given values: control, scale bars, orientation, equipment and further observations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.files.result_tables import GIVEN
from sfm.judgement.bundle_statistics import Given
from sfm.judgement.survey_result import ControlCheck, PlacedEquipment
from sfm.model.display import counted
from sfm.model.observation_residuals import CENTRE, ROTATION, GivenResiduals
from sfm.report.page import (
    Column,
    FoldedParts,
    Heading,
    Note,
    Paragraph,
    Part,
    Table,
    axes,
    columns,
    columns_of,
)
from sfm.report.phrases import (
    describe_check,
    finer_unit_of,
    general,
    or_fixed,
    signed,
    significant,
    with_exponent,
    with_sigma,
)

HEADINGS = {
    "control point": "Control",
    "scale bar": "Scale bars",
    "interior orientation": "Observed interior orientation",
    CENTRE: "Observed exterior orientation: projection centres",
    ROTATION: "Observed exterior orientation: rotations",
}
R_AND_W = (
    "r: redundancy number (0 no check, 1 full check). w: the difference over its standard deviation, "
    "which is that of the given value times the root of r; by chance 1 of 1000 exceeds 3.3. Largest w first."
)
MAX_OPEN = 90  # values shown without a click


def given_parts(
    given: Given,
    adjustment: Adjustment,
    unit: str,
    check: ControlCheck | None = None,
    equipment: Sequence[PlacedEquipment] = (),
) -> tuple[Part, ...]:
    """Return the parts on how well the given values fit.

    Args:
        given: residuals of the given values.
        adjustment: adjustment in which they took part.
        unit: object unit.
        check: control that took no part, if any.
        equipment: calibrated equipment that provides scale bars and frames.
    """
    parts = list(_check(check, adjustment, unit)) if check is not None else []
    for kind in given.kinds:
        parts += _kind(kind, adjustment, unit)
    if group_parameters := adjustment.group_parameters:
        rows = [
            (parameters.group, name, *with_exponent(value, sigma), unit)
            for parameters in group_parameters
            for name, value, sigma in zip(
                parameters.names, parameters.value, np.sqrt(np.diagonal(parameters.covariance)), strict=True
            )
        ]
        heads = columns("of", "parameter", ">value", ">sigma", "unit")
        parts += [Heading("Parameters of survey observations"), Table(heads, rows, all_in="summary.json")]
    return *parts, *_equipment(equipment)


def _equipment(placed: Sequence[PlacedEquipment]) -> tuple[Part, ...]:
    """Return which calibrated bars and frames were used, and at which temperature."""
    if not placed:
        return ()
    heads = (
        *columns("equipment", "given as", "calibrated"),
        Column("calibrated at", unit="deg C", format=".4g"),
        Column("expansion", unit="1e-6 per K", format=".4g"),
        Column("sigma", unit="1e-6 per K", format=".3g"),
        Column("surveyed at", unit="deg C", format=".4g"),
        Column("sigma", unit="K", format=".3g"),
        Column("correction", unit="1e-6", format="+.1f"),
    )
    rows = [
        (
            equipment.name,
            equipment.given_as,
            equipment.calibrated.isoformat(),
            equipment.calibration_temperature,
            equipment.expansion,
            equipment.expansion_sigma,
            equipment.temperature,
            equipment.temperature_sigma,
            equipment.correction,
        )
        for equipment in placed
    ]
    note = Note(
        "Lengths are corrected to the temperature of the survey. Their standard deviations include "
        "calibration, expansion and temperature. An error that N placements have in common is counted "
        "sqrt(N) times as large for each."
    )
    return Heading("Equipment"), note, Table(heads, rows, all_in="summary.json")


def _check(check: ControlCheck, adjustment: Adjustment, unit: str) -> tuple[Part, ...]:
    """Return the differences at control points that took no part."""
    factor, finer = finer_unit_of(unit, check.differences)
    placed = "shift, rotation and scale; the scale was taken from the control."
    if adjustment.network.scale_bars:
        placed = (
            "shift and rotation, in the scale of the scale bars; lengths by the control are "
            f"{general(check.scale, 9)} times those by the scale bars."
        )
    note = Note(
        "The control took no part in the adjustment. The result was fitted to it afterwards by "
        f"{placed} Differences at each point, fitted minus nominal [{finer}]:"
    )
    heads = (
        Column("control point"),
        *axes("d", "", signed, factor=factor),
        Column("length", format=significant, factor=factor),
    )
    length = np.linalg.norm(check.differences, axis=1)
    rows = [(n, *d, s) for n, d, s in zip(check.points, check.differences, length, strict=True)]
    rms = ("RMS", *(significant(factor * value) for value in check.rms), float(np.linalg.norm(check.rms)))
    words = Paragraph(describe_check(check, unit))
    return Heading("Check at the control"), words, note, Table(heads, rows, total=rms)


def _kind(residuals: GivenResiduals, a: Adjustment, length_unit: str) -> Iterator[Part]:
    """Yield the residuals of the values of a kind, largest w first."""
    columns = GIVEN.names_of()
    given, sigma = columns.index("given"), columns.index("sigma")
    rows = []
    for row in residuals.table_rows:  # the given value is written to the second digit of its sigma
        stated = np.nan if row[sigma] is None else float(row[sigma])
        rows.append((*row[:given], with_sigma(float(row[given]), stated)[0], *row[given + 1 :]))
    if not rows:
        return
    yield Heading(HEADINGS.get(residuals.kind, f"Observations: {residuals.kind}"))
    what = counted(len(residuals.names), _named(residuals))
    if not residuals.checked and residuals.kind == "control point":
        yield Paragraph(f"{what} held fixed: the adjusted coordinates are the given ones, without residuals.")
        return
    heads, factor, unit = _columns(residuals, length_unit)
    if (
        len(residuals.names) > 1 and len(residuals.coordinates) > 1 and unit
    ):  # not of one group of observations
        rms = ", ".join(significant(factor * value) for value in residuals.rms)
        yield Paragraph(
            f"{what}, RMS {rms} {unit} in {', '.join(residuals.coordinates)}, adjusted minus given."
        )
    yield Note(R_AND_W)
    rows.sort(key=lambda row: -abs(np.nan_to_num(row[-1])))
    table = Table(heads, rows, all_in="given.csv")
    yield table if len(rows) <= MAX_OPEN else FoldedParts(counted(len(rows), "value"), table, in_text=True)
    if residuals.kind == "scale bar" and len(rows) == 1 and a.datum != "control":
        yield Note("A single bar gives the scale but cannot be checked; two or more check one another.")


def _named(residuals: GivenResiduals) -> str:
    """Return the noun for the names of the values."""
    return "photograph" if residuals.kind in (CENTRE, ROTATION) else residuals.kind


def _columns(residuals: GivenResiduals, length_unit: str) -> tuple[tuple[Column, ...], float, str]:
    """Return the columns of given.csv, and factor and unit of differences if all values share a unit."""
    units = {unit for row in residuals.units for unit in row}
    unit = finer = "" if len(units) > 1 else units.pop()
    factor = 1.0
    if unit == length_unit:
        factor, finer = finer_unit_of(unit, residuals.difference, residuals.sigma)
    several = {"coordinate": Column()} if len(residuals.coordinates) > 1 else {}
    shown = {
        **({} if unit else {"unit": Column("unit")}),
        "name": Column(_named(residuals)),
        "given": Column("given", "", unit, str),
        "difference": Column("adjusted - given", "", finer, signed, factor),
        "sigma": Column("sigma", "", finer, or_fixed, factor),
        "r": Column("r", format="z.3f", unknown=""),
        "w": Column("w", format="+.2f", unknown="not checked"),
    }
    return columns_of(GIVEN, shown | several), factor, finer
