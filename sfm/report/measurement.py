"""The pages of a measurement and of an acceptance test."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from sfm.conventions import FloatArray
from sfm.display import counted, plural
from sfm.files.covariance_file import write_covariance
from sfm.geometry.alignment import Alignment
from sfm.geometry.shapes.fit import ShapeFit
from sfm.geometry.tolerance import DECISIONS, Deviations
from sfm.inspection.acceptance import Acceptance
from sfm.inspection.measure import Measurement
from sfm.report.figures.comparisons import deviation_figure, length_error_figure
from sfm.report.figures.plots import plot
from sfm.report.page import (
    Column,
    FoldedParts,
    Heading,
    Note,
    Page,
    Part,
    Section,
    Table,
    Tile,
    axes,
    facts,
    tested_section,
    values_of,
)
from sfm.report.phrases import fixed, general, signed, significant, with_sigma
from sfm.report.viewer.embedded import measurement_viewer
from sfm.solution import MAX_POINTS, Solution

PICTURE = (
    "Length measurement error over length. Bars are the expanded uncertainty of the calibration, lines the "
    "limit A + K L, at most B."
)
METHODS = {"3-2-1": "3-2-1", "features": "by features", "points": "best fit to nominal points"}
USED = ("no", "yes")


def page(found: Measurement, *, result: Solution) -> Page:
    """Return the page of a measurement: verdict, tolerances, shapes, functions and points.

    Args:
        found: the measurement.
        result: the result that was measured, for the scene.
    """
    points, u = found.points, found.unit
    groups = counted(len(found.groups), "group") if found.groups else ""
    quantities = quantity_table(found)
    columns = (*(Column("point", "id"), *axes("", u, ".9g"), *axes("s", u)), Column("group", "group"))
    rows = [
        (name, *xyz, *sigma, found.group_of(j))
        for j, (name, xyz, sigma) in enumerate(zip(points.names, points.xyz, point_sigma(found), strict=True))
    ]
    return Page(
        "measurement",
        "Measurement",
        found.name,
        found.verdict,
        (
            Section("Tolerances", *_tolerances(found)),
            Section("Shapes", *(part for fit in found.shapes for part in _shape(found, fit))),
            Section("Distances, angles and heights", quantities if quantities.rows else None),
            Section("Alignment", *_alignment(found.alignment, u)),
            Section("Points", FoldedParts(counted(len(rows), "point"), Table(columns, rows, "points"))),
        ),
        tiles=(
            Tile("Points", len(points.names), groups),
            Tile("Shapes", len(found.shapes)),
            *(
                Tile(
                    one.name,
                    f"{one.count('in')} of {len(one.points)} in",
                    f"{one.count('out')} out, {one.count('undecided')} undecided, against {one.against}",
                )
                for one in found.tolerances[:3]
            ),
        ),
        viewer=measurement_viewer(found, result),
        summary=_summary(found, quantities),
        files=(
            _parameters(found, found.shapes),
            _shape_points(found, found.shapes),
            *(() if quantities.rows else (quantities,)),
            _deviations(found, found.tolerances),
        ),
    )


def write_point_covariance(found: Measurement, folder: Path) -> None:
    """Write the joint covariance of the points, if it is known and there are not too many."""
    covariance = found.points.covariance
    if covariance is not None and covariance.ndim == 2 and len(found.points.names) <= MAX_POINTS:
        write_covariance(folder, covariance, found.points.names, None)


def _tolerances(found: Measurement) -> tuple[Part, ...]:
    """Return the number of deviations with each decision, and every deviation."""
    if not found.tolerances:
        return ()
    u = found.unit
    columns = (
        *(Column(), Column("against"), Column("lower", "", u, significant)),
        *(Column("upper", "", u, significant), *(Column(one, format=str) for one in DECISIONS)),
        Column("not measured", format=str),
    )
    rows = [
        (one.name, one.against, one.lower, one.upper, *map(one.count, DECISIONS), len(one.missing))
        for one in found.tolerances
    ]
    note = Note(
        f"ISO 14253-1 with U = {general(found.coverage, 3)} sigma unless a tolerance states another factor. "
        "In and out are proven; undecided means within U of a limit."
    )
    parts: list[Part] = [Table(columns, rows), note]
    for k, one in enumerate(found.tolerances):
        caption = f"Deviations of {one.name} from {one.against}, with the limits."
        folded = FoldedParts(counted(len(one.points), "deviation"), _deviations(found, [one], file=""))
        parts += [Heading(one.name), plot(f"deviations {k}", caption, deviation_figure(one, u)), folded]
    return tuple(parts)


def _deviations(found: Measurement, those: Iterable[Deviations], *, file: str = "deviations") -> Table:
    """Return the deviations of tolerances."""
    u = found.unit
    columns = (
        *(Column(None, "tolerance"), Column("point", "point"), *axes("d", u, signed)),
        *(Column("deviation", "deviation", u, signed), Column("sigma", "sigma", u, significant)),
        *(Column(None, "U"), Column(None, "lower"), Column(None, "upper"), Column("decision", "decision")),
    )
    rows = [
        (one.name, found.points.names[j], *d, v, s, one.coverage * s, one.lower, one.upper, decision)
        for one in those
        for j, d, v, s, decision in zip(
            one.points, one.vector, one.value, one.sigma, one.decision, strict=True
        )
    ]
    return Table(columns, rows, file)


def _shape(found: Measurement, fit: ShapeFit) -> tuple[Part, ...]:
    """Return parameters, fit and points of a shape."""
    u, size = found.unit, len(fit.used)
    sigma0 = "not known" if np.isnan(fit.sigma0) else fixed(fit.sigma0, 3)
    if fit.weights != "network" and np.isfinite(fit.sigma0):
        sigma0 = f"{significant(fit.sigma0)} {u}"
    span = "twice the largest distance" if fit.distances.shape[1] == 2 else "largest minus smallest distance"
    used = "" if fit.used.all() else f" of {size}; the others contradict them"
    rows = [
        ("Points", f"{fit.used.sum()}{used}"),
        ("RMS distance", f"{significant(fit.rms)} {u}"),
        ("Form error", f"{significant(fit.form_error)} {u}, {span}"),
    ]
    network = f"covariance of the points{'' if found.points.correlated else ', each point alone'}"
    rows.append(("Weights", network if fit.weights == "network" else "equal"))
    rows.append(("Sigma0", f"{sigma0}, redundancy {fit.redundancy}"))
    if fit.weights == "network" and fit.fits is not None:
        said = "as" if fit.fits else "larger than"
        limit = f"{significant(fit.statistic)}, limit {significant(fit.critical)}"
        rows.append(("Test of the residuals", f"{said} the precision of the points: {limit}"))
    source = "the residuals" if fit.from_residuals else "the covariance of the points"
    rows.append(("Standard deviations from", source))
    if fit.offset:
        rows.append(("Offset of the targets", f"{signed(fit.offset)} {u} along the normal"))
    points = _shape_points(found, [fit], file="")
    return (
        Heading(f"{fit.name}: {fit.shape.kind.name}"),
        _parameters(found, [fit], file=""),
        facts(rows),
        FoldedParts(counted(len(fit.points), "point"), points),
    )


def _parameters(found: Measurement, shapes: Iterable[ShapeFit], *, file: str = "shapes") -> Table:
    """Return a table of the parameters of shapes, angles in degrees."""
    columns = (
        *(Column(None, "shape"), Column(None, "kind"), Column("parameter"), Column(None, "parameter")),
        *(Column(None, "axis"), Column(None, "value"), Column(None, "sigma"), Column("value", format=str)),
        *(Column("sigma", format=str), Column("unit"), Column(None, "unit")),
    )
    rows = [
        (
            *(fit.name, fit.shape.kind.name, f"{name} {axis}".rstrip(), name, axis, value, sigma),
            *(*with_sigma(value, sigma), "" if unit == "1" else unit, unit),
        )
        for fit in shapes
        for name, axis, value, sigma, unit in parameter_rows(fit, found.unit)
    ]
    return Table(columns, rows, file)


def _shape_points(found: Measurement, shapes: Iterable[ShapeFit], *, file: str = "shape_points") -> Table:
    """Return the distances of points from shapes."""
    u = found.unit
    columns = (
        *(Column(None, "shape"), Column("point", "point"), Column("deviation", "deviation", u, signed)),
        Column("sigma", "sigma", u, significant),
        Column("w", "w", format="z.2f", unknown=""),
        Column("used", "used", flag=USED),
    )
    rows = [
        (fit.name, found.points.names[j], *values)
        for fit in shapes
        for j, *values in zip(fit.points, fit.deviation, fit.sigma, fit.w, fit.used, strict=True)
    ]
    return Table(columns, rows, file)


def quantity_table(found: Measurement) -> Table:
    """Return a table of distances, angles and heights, angles in degrees."""
    columns = (
        *(Column("", "name"), Column("of", "what"), Column(None, "value"), Column(None, "sigma")),
        *(Column("value", format=str), Column("sigma", format=str), Column("unit", "unit")),
        Column("remark", "remark"),
    )
    rows = []
    for one in found.quantities:
        text = " ".join(said.text for said in one.remarks) or None
        factor, unit = (float(np.rad2deg(1.0)), "deg") if one.kind == "angle" else (1.0, found.unit)
        value, sigma = one.value * factor, one.sigma * factor
        rows.append((one.name, one.what, value, sigma, *with_sigma(value, sigma), unit, text))
    return Table(columns, rows, "quantities")


def _alignment(found: Alignment | None, u: str) -> tuple[Part, ...]:
    """Return how the points were aligned, and the differences from nominal points."""
    if found is None:
        return ()
    fit = found.fitted
    if fit is None:
        return (facts([("Method", METHODS[found.method])]),)
    sigma0 = "not known" if np.isnan(fit.sigma0) else significant(fit.sigma0)
    rows = [
        ("Method", METHODS[found.method]),
        ("Points", f"{fit.used.sum()} of {len(fit.used)}"),
        ("Scale", f"{general(fit.scale, 10)} {'fitted' if found.scaled else 'kept'}"),
        ("Sigma0", f"{sigma0}, redundancy {fit.redundancy}"),
    ]
    columns = (Column("point"), *axes("d", u, signed), Column("used", flag=USED))
    differences = [(n, *d, used) for n, d, used in zip(fit.names, fit.difference, fit.used, strict=True)]
    title = f"{counted(len(fit.names), 'difference')}, aligned minus nominal"
    return facts(rows), FoldedParts(title, Table(columns, differences))


def point_sigma(found: Measurement) -> FloatArray:
    """Return the standard deviations of the points, NaN if not known, object unit, (n, 3)."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("nii->ni", found.points.blocks), 0.0)))


def parameter_rows(fit: ShapeFit, unit: str) -> list[tuple[str, str, float, float, str]]:
    """Return name, axis, value, sigma and unit of each parameter of a shape, angles in degrees."""
    rows = []
    p = fit.parameters
    for name, axis, kind, value, sigma in zip(
        p.names, p.axes, p.kinds, fit.function.value.tolist(), fit.parameter_sigma.tolist(), strict=True
    ):
        if kind == "angle":
            rows.append((f"{name}_deg", axis, float(np.rad2deg(value)), float(np.rad2deg(sigma)), "deg"))
        else:
            rows.append((name, axis, value, sigma, "1" if kind == "direction" else unit))
    return rows


def _summary(found: Measurement, quantities: Table) -> dict[str, Any]:
    """Return the content of measurement.json."""
    alignment, best_fit = None, None
    if found.alignment is not None:
        fit = found.alignment.fitted
        if fit is not None:
            best_fit = {
                "points": fit.used.sum(),
                "held_out": list(compress(fit.names, ~fit.used)),
                "rms": np.sqrt((fit.difference[fit.used] ** 2).mean()),
                **values_of(fit, "sigma0 redundancy statistic critical"),
            }
        placed = values_of(found.alignment.aligned_from_object, "scale rotation translation")
        alignment = {"method": found.alignment.method, **placed, "best_fit": best_fit}
    return {
        "result": found.name,
        "length_unit": found.unit,
        "datum": found.points.datum,
        **found.verdict.as_dict(),
        "points": len(found.points.names),
        "groups": {name: [found.points.names[j] for j in members] for name, members in found.groups},
        "alignment": alignment,
        "shapes": [_shape_summary(found, fit) for fit in found.shapes],
        "quantities": quantities.records,
        "tolerances": [
            {
                **values_of(one, "name against lower upper coverage"),
                "points": len(one.points),
                **{decision.replace(" ", "_"): one.count(decision) for decision in DECISIONS},
                "missing": one.missing,
            }
            for one in found.tolerances
        ],
    }


def _shape_summary(found: Measurement, fit: ShapeFit) -> dict[str, Any]:
    return {
        "name": fit.name,
        "kind": fit.shape.kind.name,
        "weights": fit.weights,
        "points": fit.used.sum(),
        "left_out": [found.points.names[j] for j in fit.points[~fit.used]],
        "parameters": [
            {"name": f"{name} {axis}".rstrip(), "value": v, "sigma": s, "unit": unit}
            for name, axis, v, s, unit in parameter_rows(fit, found.unit)
        ],
        **values_of(fit, "covariance rms form_error sigma0 redundancy statistic critical converged"),
    }


def describe_measured(found: Measurement) -> str:
    """Return in one line how much was measured, and the number of deviations with each decision."""
    if not found.tolerances:
        parts = [counted(len(found.points.names), "point")]
        if found.shapes:
            parts.append(counted(len(found.shapes), "shape"))
        if found.quantities:
            count = len(found.quantities)
            kinds = {one.kind for one in found.quantities}  # length, angle
            words = plural(kinds.pop(), count) if len(kinds) == 1 else "lengths and angles"
            parts.append(f"{count} {words}")
        return ", ".join(parts) + "."
    counts = {one: sum(t.count(one) for t in found.tolerances) for one in DECISIONS}
    total = sum(counts.values())
    parts = [f"{count} {decision}" for decision, count in counts.items() if count]
    return f"{counted(total, 'deviation')} judged by ISO 14253-1: {', '.join(parts)}."


def acceptance_page(found: Acceptance) -> Page:
    """Return the page of an acceptance test: limit, decisions, and every length."""
    a, lengths, u = found, found.lengths, found.unit
    most = f", at most B = {significant(a.b)} {u}" if np.isfinite(a.b) else ""
    limit = f"A + K L with A = {significant(a.a)} {u}, K = {general(a.k, 4)}{most}"
    lines = len(set(lengths.line))
    figures = facts(
        [
            ("Limit", limit),
            ("Lengths", f"{len(a.error)} on {counted(lines, 'line')}"),
            ("Largest error", f"{significant(a.largest)} {u}"),
            *((one.capitalize(), counted(a.count(one), "length")) for one in DECISIONS if a.count(one)),
            ("Body diagonal", f"{general(a.diagonal, 6)} {u}"),
        ]
    )
    note = Note(
        "Length measurement error: measured minus calibrated length. ISO 14253-1 with U = "
        f"{general(a.coverage, 3)} sigma of the calibration: in and out are proven; undecided means within U "
        "of the limit. The scale of the result comes from other bars."
    )
    columns = (
        *(Column(name, name) for name in ("line", "from", "to")),
        Column("calibrated", "length", u, ".9g"),
        Column("sigma", "sigma", u, significant),
        Column("measured", "measured", u, ".9g"),
        Column("sigma", "sigma_measured", u, significant),
        Column("error", "error", u, signed),
        Column("limit", "limit", u, significant),
        Column("decision", "decision"),
    )
    rows = zip(
        *(lengths.line, lengths.start, lengths.end, lengths.length, lengths.sigma, lengths.length + a.error),
        *(a.sigma, a.error, a.limit, a.decision),
        strict=True,
    )
    summary = {
        "test": "VDI/VDE 2634 part 1",
        "result": a.name,
        "length_unit": u,
        **a.verdict.as_dict(),
        "limit": {"A": a.a, "K": a.k, "B": a.b},
        "coverage": a.coverage,
        "lines": lines,
        "lengths": len(a.error),
        **{one.replace(" ", "_"): a.count(one) for one in DECISIONS},
        "largest_error": a.largest,
        "rms_error": float(np.sqrt((a.error**2).mean())),
        "body_diagonal": a.diagonal,
    }
    return Page(
        "acceptance",
        "Acceptance test, VDI/VDE 2634 part 1",
        a.name,
        a.verdict,
        (
            Section("Figures", figures, note, plot("errors", PICTURE, length_error_figure(found))),
            tested_section(a.verdict),
            Section("Lengths", Table(columns, list(rows), "lengths")),
        ),
        summary=summary,
    )
