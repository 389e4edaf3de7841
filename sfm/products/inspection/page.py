"""The pages of a measurement and of an acceptance test."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import chain, compress
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sfm.files.covariance_file import write_covariance
from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.display import counted, plural
from sfm.model.solution import MAX_POINTS, Solution
from sfm.products.geometry.alignment import Alignment
from sfm.products.geometry.shapes.fit import ShapeFit
from sfm.products.geometry.tolerance import DECISIONS, IN, OUT, Deviations
from sfm.products.inspection.acceptance import Acceptance
from sfm.products.inspection.measurement import Measurement
from sfm.report.figures.plots import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    plot,
    single_panel_figure,
    two_panel_figure,
)
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
from sfm.report.phrases import finer_unit, fixed, general, signed, significant, with_sigma
from sfm.report.viewer.embedded import Viewer, scene_of_stored, viewer_of
from sfm.report.viewer.pictures import cut_pictures

PICTURE = (
    "Length measurement error over length. Bars are the expanded uncertainty of the calibration, lines the "
    "limit A + K L, at most B."
)
BINS = 30  # of a histogram
COLOURS = {IN: GREEN, OUT: RED}
METHODS = {"3-2-1": "3-2-1", "features": "by features", "points": "best fit to nominal points"}
USED = ("no", "yes")


def page(measurement: Measurement, *, result: Solution) -> Page:
    """Return the page of a measurement: verdict, tolerances, shapes, functions and points.

    Args:
        measurement: the measurement.
        result: the result that was measured, for the scene.
    """
    points, u = measurement.points, measurement.unit
    groups = counted(len(measurement.groups), "group") if measurement.groups else ""
    quantities = quantity_table(measurement)
    columns = (Column("point", "id"), *axes("", u, ".9g"), *axes("s", u), Column("group", "group"))
    rows = [
        (name, *xyz, *sigma, measurement.group_of(j))
        for j, (name, xyz, sigma) in enumerate(
            zip(points.names, points.xyz, point_sigma(measurement), strict=True)
        )
    ]
    judged = [
        Tile(
            tolerance.name,
            f"{tolerance.count('in')} of {len(tolerance.points)} in",
            f"{tolerance.count('out')} out, {tolerance.count('undecided')} undecided, against "
            f"{tolerance.against}",
        )
        for tolerance in measurement.tolerances[:3]
    ]
    files = [
        _parameters(measurement, measurement.shapes),
        _shape_points(measurement, measurement.shapes),
        _deviations(measurement, measurement.tolerances),
    ]
    if not quantities.rows:  # else it is on the page
        files.insert(2, quantities)
    return Page(
        "measurement",
        "Measurement",
        measurement.name,
        measurement.verdict,
        (
            Section("Tolerances", *_tolerances(measurement)),
            Section("Shapes", *chain.from_iterable(_shape(measurement, fit) for fit in measurement.shapes)),
            Section("Distances, angles and heights", quantities if quantities.rows else None),
            Section("Alignment", *_alignment(measurement.alignment, u)),
            Section("Points", FoldedParts(counted(len(rows), "point"), Table(columns, rows, "points"))),
        ),
        tiles=(
            Tile("Points", len(points.names), groups),
            Tile("Shapes", len(measurement.shapes)),
            *judged,
        ),
        viewer=measurement_viewer(measurement, result),
        summary=_summary(measurement, quantities),
        files=tuple(files),
    )


def write_point_covariance(measurement: Measurement, folder: Path) -> None:
    """Write the joint covariance of the points, if it is known and there are not too many."""
    covariance = measurement.points.covariance
    if covariance is not None and covariance.ndim == 2 and len(measurement.points.names) <= MAX_POINTS:
        write_covariance(folder, covariance, measurement.points.names, None)


def _tolerances(measurement: Measurement) -> tuple[Part, ...]:
    """Return the number of deviations with each decision, and every deviation."""
    if not measurement.tolerances:
        return ()
    u = measurement.unit
    decisions = [Column(decision, format=str) for decision in DECISIONS]
    columns = (
        Column(),
        Column("against"),
        Column("lower", "", u, significant),
        Column("upper", "", u, significant),
        *decisions,
        Column("not measured", format=str),
    )
    rows = [
        (
            tolerance.name,
            tolerance.against,
            tolerance.lower,
            tolerance.upper,
            *map(tolerance.count, DECISIONS),
            len(tolerance.missing),
        )
        for tolerance in measurement.tolerances
    ]
    note = Note(
        f"ISO 14253-1 with U = {general(measurement.coverage, 3)} sigma unless a tolerance states another "
        "factor. In and out are proven; undecided means within U of a limit."
    )
    parts: list[Part] = [Table(columns, rows), note]
    for k, tolerance in enumerate(measurement.tolerances):
        caption = f"Deviations of {tolerance.name} from {tolerance.against}, with the limits."
        folded = FoldedParts(
            counted(len(tolerance.points), "deviation"), _deviations(measurement, [tolerance], file="")
        )
        parts += [
            Heading(tolerance.name),
            plot(f"deviations {k}", caption, deviation_figure(tolerance, u)),
            folded,
        ]
    return tuple(parts)


def _deviations(
    measurement: Measurement, tolerances: Iterable[Deviations], *, file: str = "deviations"
) -> Table:
    """Return the deviations of tolerances."""
    u = measurement.unit
    columns = (
        Column(None, "tolerance"),
        Column("point", "point"),
        *axes("d", u, signed),
        Column("deviation", "deviation", u, signed),
        Column("sigma", "sigma", u, significant),
        Column(None, "U"),
        Column(None, "lower"),
        Column(None, "upper"),
        Column("decision", "decision"),
    )
    rows = [
        (
            tolerance.name,
            measurement.points.names[j],
            *d,
            v,
            s,
            tolerance.coverage * s,
            tolerance.lower,
            tolerance.upper,
            decision,
        )
        for tolerance in tolerances
        for j, d, v, s, decision in zip(
            tolerance.points,
            tolerance.vector,
            tolerance.value,
            tolerance.sigma,
            tolerance.decision,
            strict=True,
        )
    ]
    return Table(columns, rows, file)


def _shape(measurement: Measurement, fit: ShapeFit) -> tuple[Part, ...]:
    """Return parameters, fit and points of a shape."""
    u, size = measurement.unit, len(fit.used)
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
    network = f"covariance of the points{'' if measurement.points.correlated else ', each point alone'}"
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
    points = _shape_points(measurement, [fit], file="")
    return (
        Heading(f"{fit.name}: {fit.shape.kind.name}"),
        _parameters(measurement, [fit], file=""),
        facts(rows),
        FoldedParts(counted(len(fit.points), "point"), points),
    )


def _parameters(measurement: Measurement, shapes: Iterable[ShapeFit], *, file: str = "shapes") -> Table:
    """Return a table of the parameters of shapes, angles in degrees."""
    columns = (
        Column(None, "shape"),
        Column(None, "kind"),
        Column("parameter"),
        Column(None, "parameter"),
        Column(None, "axis"),
        Column(None, "value"),
        Column(None, "sigma"),
        Column("value", format=str),
        Column("sigma", format=str),
        Column("unit"),
        Column(None, "unit"),
    )
    rows = [
        (
            fit.name,
            fit.shape.kind.name,
            f"{name} {axis}".rstrip(),
            name,
            axis,
            value,
            sigma,
            *with_sigma(value, sigma),
            "" if unit == "1" else unit,
            unit,
        )
        for fit in shapes
        for name, axis, value, sigma, unit in parameter_rows(fit, measurement.unit)
    ]
    return Table(columns, rows, file)


def _shape_points(
    measurement: Measurement, shapes: Iterable[ShapeFit], *, file: str = "shape_points"
) -> Table:
    """Return the distances of points from shapes."""
    u = measurement.unit
    columns = (
        Column(None, "shape"),
        Column("point", "point"),
        Column("deviation", "deviation", u, signed),
        Column("sigma", "sigma", u, significant),
        Column("w", "w", format="z.2f", unknown=""),
        Column("used", "used", flag=USED),
    )
    rows = [
        (fit.name, measurement.points.names[j], *values)
        for fit in shapes
        for j, *values in zip(fit.points, fit.deviation, fit.sigma, fit.w, fit.used, strict=True)
    ]
    return Table(columns, rows, file)


def quantity_table(measurement: Measurement) -> Table:
    """Return a table of distances, angles and heights, angles in degrees."""
    columns = (
        Column("", "name"),
        Column("of", "what"),
        Column(None, "value"),
        Column(None, "sigma"),
        Column("value", format=str),
        Column("sigma", format=str),
        Column("unit", "unit"),
        Column("remark", "remark"),
    )
    rows = []
    for quantity in measurement.quantities:
        text = " ".join(said.text for said in quantity.remarks) or None
        factor, unit = (
            (float(np.rad2deg(1.0)), "deg") if quantity.kind == "angle" else (1.0, measurement.unit)
        )
        value, sigma = quantity.value * factor, quantity.sigma * factor
        rows.append((quantity.name, quantity.what, value, sigma, *with_sigma(value, sigma), unit, text))
    return Table(columns, rows, "quantities")


def _alignment(alignment: Alignment | None, u: str) -> tuple[Part, ...]:
    """Return how the points were aligned, and the differences from nominal points."""
    if alignment is None:
        return ()
    fit = alignment.fitted
    if fit is None:
        return (facts([("Method", METHODS[alignment.method])]),)
    sigma0 = "not known" if np.isnan(fit.sigma0) else significant(fit.sigma0)
    rows = [
        ("Method", METHODS[alignment.method]),
        ("Points", f"{fit.used.sum()} of {len(fit.used)}"),
        ("Scale", f"{general(fit.scale, 10)} {'fitted' if alignment.scaled else 'kept'}"),
        ("Sigma0", f"{sigma0}, redundancy {fit.redundancy}"),
    ]
    columns = (Column("point"), *axes("d", u, signed), Column("used", flag=USED))
    differences = [(n, *d, used) for n, d, used in zip(fit.names, fit.difference, fit.used, strict=True)]
    title = f"{counted(len(fit.names), 'difference')}, aligned minus nominal"
    return facts(rows), FoldedParts(title, Table(columns, differences))


def point_sigma(measurement: Measurement) -> FloatArray:
    """Return the standard deviations of the points, NaN if not known, object unit, (n, 3)."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("nii->ni", measurement.points.blocks), 0.0)))


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


def _summary(measurement: Measurement, quantities: Table) -> dict[str, Any]:
    """Return the content of measurement.json."""
    alignment, best_fit = None, None
    if measurement.alignment is not None:
        fit = measurement.alignment.fitted
        if fit is not None:
            best_fit = {
                "points": fit.used.sum(),
                "held_out": list(compress(fit.names, ~fit.used)),
                "rms": np.sqrt((fit.difference[fit.used] ** 2).mean()),
                **values_of(fit, "sigma0 redundancy statistic critical"),
            }
        placed = values_of(measurement.alignment.aligned_from_object, "scale rotation translation")
        alignment = {"method": measurement.alignment.method, **placed, "best_fit": best_fit}
    return {
        "result": measurement.name,
        "length_unit": measurement.unit,
        "datum": measurement.points.datum,
        **measurement.verdict.as_dict(),
        "points": len(measurement.points.names),
        "groups": {
            name: [measurement.points.names[j] for j in members] for name, members in measurement.groups
        },
        "alignment": alignment,
        "shapes": [_shape_summary(measurement, fit) for fit in measurement.shapes],
        "quantities": quantities.records,
        "tolerances": [
            {
                **values_of(tolerance, "name against lower upper coverage"),
                "points": len(tolerance.points),
                **{decision.replace(" ", "_"): tolerance.count(decision) for decision in DECISIONS},
                "missing": tolerance.missing,
            }
            for tolerance in measurement.tolerances
        ],
    }


def _shape_summary(measurement: Measurement, fit: ShapeFit) -> dict[str, Any]:
    return {
        "name": fit.name,
        "kind": fit.shape.kind.name,
        "weights": fit.weights,
        "points": fit.used.sum(),
        "left_out": [measurement.points.names[j] for j in fit.points[~fit.used]],
        "parameters": [
            {"name": f"{name} {axis}".rstrip(), "value": v, "sigma": s, "unit": unit}
            for name, axis, v, s, unit in parameter_rows(fit, measurement.unit)
        ],
        **values_of(fit, "covariance rms form_error sigma0 redundancy statistic critical converged"),
    }


def describe_measured(measurement: Measurement) -> str:
    """Return in one line how much was measured, and the number of deviations with each decision."""
    if not measurement.tolerances:
        parts = [counted(len(measurement.points.names), "point")]
        if measurement.shapes:
            parts.append(counted(len(measurement.shapes), "shape"))
        if measurement.quantities:
            count = len(measurement.quantities)
            kinds = {quantity.kind for quantity in measurement.quantities}  # length, angle
            words = plural(kinds.pop(), count) if len(kinds) == 1 else "lengths and angles"
            parts.append(f"{count} {words}")
        return ", ".join(parts) + "."
    counts = {decision: sum(t.count(decision) for t in measurement.tolerances) for decision in DECISIONS}
    total = sum(counts.values())
    parts = [f"{count} {decision}" for decision, count in counts.items() if count]
    return f"{counted(total, 'deviation')} judged by ISO 14253-1: {', '.join(parts)}."


def acceptance_page(acceptance: Acceptance) -> Page:
    """Return the page of an acceptance test: limit, decisions, and every length."""
    a, lengths, u = acceptance, acceptance.lengths, acceptance.unit
    most = f", at most B = {significant(a.b)} {u}" if np.isfinite(a.b) else ""
    limit = f"A + K L with A = {significant(a.a)} {u}, K = {general(a.k, 4)}{most}"
    lines = len(set(lengths.line))
    counts = [
        (decision.capitalize(), counted(a.count(decision), "length"))
        for decision in DECISIONS
        if a.count(decision)
    ]
    figures = facts(
        [
            ("Limit", limit),
            ("Lengths", f"{len(a.error)} on {counted(lines, 'line')}"),
            ("Largest error", f"{significant(a.largest)} {u}"),
            *counts,
            ("Body diagonal", f"{general(a.diagonal, 6)} {u}"),
        ]
    )
    note = Note(
        "Length measurement error: measured minus calibrated length. ISO 14253-1 with U = "
        f"{general(a.coverage, 3)} sigma of the calibration: in and out are proven; undecided means within U "
        "of the limit. The scale of the result comes from other bars."
    )
    columns = (
        Column("line", "line"),
        Column("from", "from"),
        Column("to", "to"),
        Column("calibrated", "length", u, ".9g"),
        Column("sigma", "sigma", u, significant),
        Column("measured", "measured", u, ".9g"),
        Column("sigma", "sigma_measured", u, significant),
        Column("error", "error", u, signed),
        Column("limit", "limit", u, significant),
        Column("decision", "decision"),
    )
    rows = zip(
        lengths.line,
        lengths.start,
        lengths.end,
        lengths.length,
        lengths.sigma,
        lengths.length + a.error,
        a.sigma,
        a.error,
        a.limit,
        a.decision,
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
        **{decision.replace(" ", "_"): a.count(decision) for decision in DECISIONS},
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
            Section("Figures", figures, note, plot("errors", PICTURE, length_error_figure(acceptance))),
            tested_section(a.verdict),
            Section("Lengths", Table(columns, list(rows), "lengths")),
        ),
        summary=summary,
    )


def deviation_figure(deviations: Deviations, unit: str) -> Figure:
    """Draw a histogram of the deviations, and each deviation with its uncertainty in ascending order."""
    limits = [x for x in (deviations.lower, deviations.upper) if np.isfinite(x)]
    largest = float(np.abs([*deviations.value, *limits]).max())
    factor, fine = finer_unit(unit, largest)
    value, U = deviations.value * factor, deviations.coverage * np.nan_to_num(deviations.sigma) * factor
    picture = two_panel_figure(3.6)
    left, right = picture.subplots(1, 2)
    left.hist(value, bins=min(BINS, max(5, len(value) // 3)), color=BLUE, alpha=0.8)
    left.set(xlabel=f"deviation [{fine}]", ylabel="points")
    order = np.argsort(value, kind="stable")
    x = np.arange(1, len(order) + 1)
    _draw_decided(right, x, value[order], U[order], np.array(deviations.decision)[order], 3)
    for limit in limits:
        left.axvline(limit * factor, color=GREY, lw=1, ls="--")
        right.axhline(limit * factor, color=GREY, lw=1, ls="--")
    right.set(xlabel="points in order of their deviation", ylabel=f"deviation and U [{fine}]")
    right.legend(fontsize=8, loc="upper left")
    return picture


def length_error_figure(acceptance: Acceptance) -> Figure:
    """Draw the length measurement errors over the length, with their limits."""
    length, error = acceptance.lengths.length, acceptance.error
    U = acceptance.coverage * np.nan_to_num(acceptance.lengths.sigma)
    factor, fine = finer_unit(acceptance.unit, float(max(np.abs(error).max(), acceptance.limit.max())))
    picture = single_panel_figure(4.2)
    axes = picture.subplots()
    x = np.linspace(0, 1.05 * float(length.max()), 200)
    limit = np.minimum(acceptance.a + acceptance.k * x, acceptance.b) * factor
    axes.plot(x, limit, color=GREY, lw=1.2)
    axes.plot(x, -limit, color=GREY, lw=1.2)
    axes.axhline(0, color=GREY, lw=0.6)
    _draw_decided(axes, length, error * factor, U * factor, np.array(acceptance.decision), 4)
    axes.set(
        xlabel=f"calibrated length [{acceptance.unit}]",
        ylabel=f"measured minus calibrated [{fine}]",
    )
    axes.legend(fontsize=8, loc="upper left")
    return picture


def _draw_decided(
    axes: Axes, x: AnyArray, y: FloatArray, U: FloatArray, decision: AnyArray, size: float
) -> None:
    """Draw values with their uncertainty, one colour per decision."""
    for name in dict.fromkeys(decision.tolist()):
        rows = decision == name
        colour, label = COLOURS.get(name, ORANGE), f"{name} ({rows.sum()})"
        axes.errorbar(x[rows], y[rows], yerr=U[rows], fmt="o", ms=size, lw=0.8, color=colour, label=label)


def measurement_viewer(measurement: Measurement, result: Solution) -> Viewer | None:
    """Return the viewer in the coordinate system of a measurement; None without photographs."""
    if not result.estimate.oriented.any():
        return None
    estimate, n = result.estimate, int(result.estimate.determined.sum())
    positions = result.position_covariance
    if measurement.alignment is not None:
        estimate = measurement.alignment.aligned_from_object.apply_estimate(estimate)
        positions = None
    kept = np.flatnonzero(result.estimate.determined)
    covariance = np.full((len(result.network.points), 3, 3), np.nan)
    covariance[kept] = measurement.points.blocks[:n]
    moved = replace(
        result,
        estimate=estimate,
        point_covariance=covariance,
        position_covariance=positions,
        covariance=None,
        unit=measurement.unit,
    )
    scene = scene_of_stored(moved)
    worst = np.full(len(measurement.points.names), np.nan)
    judged: list[Deviations | ShapeFit] = [*measurement.tolerances] or [*measurement.shapes]
    for fit in judged:
        value = fit.value if isinstance(fit, Deviations) else fit.deviation
        larger = ~(np.abs(value) <= np.abs(worst[fit.points]))
        worst[fit.points[larger]] = value[larger]
    deviation = worst[:n]
    if np.isfinite(deviation).any():
        scene = replace(scene, deviation=deviation)
    return viewer_of(scene, cut_pictures(scene, {}, budget_mb=0.0))
