"""A measured result as tables, JSON, drawing and page."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sfm.conventions import FloatArray
from sfm.display import counted, plural
from sfm.files.covariance_file import MAX_POINTS, write_covariance
from sfm.files.folder_lock import locked
from sfm.files.plain_text import csv_text, or_none
from sfm.files.whole_files import remove_leftovers, whole_folder
from sfm.geometry.shapes.fit import ShapeFit
from sfm.geometry.tolerance import DECISIONS, Deviations
from sfm.inspection.measure import Measurement
from sfm.report.figures.measurements import deviation_figure
from sfm.report.figures.plots import plot
from sfm.report.html.page import render
from sfm.report.viewer.embedded import Viewer, viewer_of
from sfm.report.viewer.pictures import cut_pictures
from sfm.report.viewer.stored_scene import scene_of_stored
from sfm.solution import Solution

POINT_COLUMNS = ("id", "X", "Y", "Z", "sX", "sY", "sZ", "group")
SHAPE_COLUMNS = ("shape", "kind", "parameter", "axis", "value", "sigma", "unit")
RESIDUAL_COLUMNS = ("shape", "point", "deviation", "sigma", "w", "used")
QUANTITY_COLUMNS = ("name", "what", "value", "sigma", "unit", "remark")
DEVIATION_COLUMNS = (
    *("tolerance", "point", "dX", "dY", "dZ", "deviation", "sigma", "U", "lower", "upper", "decision"),
)
MAX_ROWS_SHOWN = 2000  # of a table of the page
PAGE = "measurement.html"

Writer = Callable[[Path], None]


def write_measurement(
    found: Measurement, result: Solution, out: Path, *, drawings: Sequence[tuple[str, Writer]] = ()
) -> Path:
    """Write a measured result into a folder and return the path of its page.

    Args:
        found: what was measured.
        result: that it was measured in, for the scene of the page.
        out: the folder.
        drawings: name of a file, and what writes it, of formats of other programs.

    Raises:
        OutputError: the folder holds something else or cannot be written.
    """
    text = json.dumps(measurement_summary(found), indent=2, ensure_ascii=False, allow_nan=False)
    texts = {
        "points.csv": csv_text(POINT_COLUMNS, point_rows(found)),
        "shapes.csv": csv_text(SHAPE_COLUMNS, shape_rows(found)),
        "shape_points.csv": csv_text(RESIDUAL_COLUMNS, residual_rows(found)),
        "quantities.csv": csv_text(QUANTITY_COLUMNS, quantity_rows(found)),
        "deviations.csv": csv_text(DEVIATION_COLUMNS, deviation_rows(found)),
        "measurement.json": text + "\n",
        PAGE: measurement_page(found, scene_viewer(found, result)),
    }
    with locked(out.parent / f".{out.name}.lock", out):
        remove_leftovers(out)
        with whole_folder(out, "the result", replaceable=True) as folder:
            for name, content in texts.items():
                (folder / name).write_text(content, encoding="utf-8", newline="")
            covariance = found.points.covariance
            if covariance is not None and covariance.ndim == 2 and len(found.points.names) <= MAX_POINTS:
                write_covariance(folder, covariance, found.points.names, None)
            for name, write in drawings:
                write(folder / name)
    return out / PAGE


def point_rows(found: Measurement) -> list[tuple[object, ...]]:
    """Return the rows of points.csv."""
    sigma = point_sigma(found)
    return [
        (name, *found.points.xyz[j], *sigma[j], found.group_of(j))
        for j, name in enumerate(found.points.names)
    ]


def point_sigma(found: Measurement) -> FloatArray:
    """Return the standard deviations of the points, NaN where not known, object unit, (n, 3)."""
    return np.asarray(np.sqrt(np.maximum(np.einsum("nii->ni", found.points.blocks), 0.0)))


def shape_rows(found: Measurement) -> list[tuple[object, ...]]:
    """Return the rows of shapes.csv, angles in degrees."""
    return [
        (fit.name, fit.shape.kind.name, name, axis, value, sigma, unit)
        for fit in found.shapes
        for name, axis, value, sigma, unit in parameter_rows(fit, found.unit)
    ]


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


def residual_rows(found: Measurement) -> list[tuple[object, ...]]:
    """Return the rows of shape_points.csv."""
    return [
        (fit.name, found.points.names[j], d, s, w, int(used))
        for fit in found.shapes
        for j, d, s, w, used in zip(fit.points, fit.deviation, fit.sigma, fit.w, fit.used, strict=True)
    ]


def quantity_rows(found: Measurement) -> list[tuple[str, str, float, float, str, str]]:
    """Return the rows of quantities.csv, angles in degrees."""
    rows = []
    for one in found.quantities:
        text = " ".join(said.text for said in one.remarks)
        factor, unit = (float(np.rad2deg(1.0)), "deg") if one.kind == "angle" else (1.0, found.unit)
        rows.append((one.name, one.what, one.value * factor, one.sigma * factor, unit, text))
    return rows


def deviation_rows(found: Measurement) -> list[tuple[object, ...]]:
    """Return the rows of deviations.csv."""
    return [
        (one.name, found.points.names[j], *d, v, s, one.coverage * s, one.lower, one.upper, decision)
        for one in found.tolerances
        for j, d, v, s, decision in zip(
            one.points, one.vector, one.value, one.sigma, one.decision, strict=True
        )
    ]


def measurement_summary(found: Measurement) -> dict[str, Any]:
    """Return what measurement.json holds: plain values only, None for what is not known."""
    alignment = None
    if found.alignment is not None:
        T, fit = found.alignment.aligned_from_object, found.alignment.fitted
        alignment = {
            "method": found.alignment.method,
            "scale": T.scale,
            "rotation": T.rotation.tolist(),
            "translation": T.translation.tolist(),
            "best_fit": None
            if fit is None
            else {
                "points": int(fit.used.sum()),
                "held_out": [n for n, used in zip(fit.names, fit.used, strict=True) if not used],
                "rms": or_none(float(np.sqrt((fit.difference[fit.used] ** 2).mean()))),
                "sigma0": or_none(fit.sigma0),
                "redundancy": fit.redundancy,
                "statistic": or_none(fit.statistic),
                "critical": or_none(fit.critical),
            },
        }
    return {
        "result": found.name,
        "length_unit": found.unit,
        "datum": found.points.datum,
        **found.verdict.as_dict(),
        "points": len(found.points.names),
        "groups": {name: [found.points.names[j] for j in members] for name, members in found.groups},
        "alignment": alignment,
        "shapes": [_shape_summary(found, fit) for fit in found.shapes],
        "quantities": [
            {"name": n, "what": what, "value": v, "sigma": or_none(s), "unit": unit, "remark": remark or None}
            for n, what, v, s, unit, remark in quantity_rows(found)
        ],
        "tolerances": [
            {
                "name": one.name,
                "against": one.against,
                "lower": or_none(one.lower),
                "upper": or_none(one.upper),
                "coverage": one.coverage,
                "points": len(one.points),
                **{decision.replace(" ", "_"): one.count(decision) for decision in DECISIONS},
                "missing": list(one.missing),
            }
            for one in found.tolerances
        ],
    }


def _shape_summary(found: Measurement, fit: ShapeFit) -> dict[str, Any]:
    return {
        "name": fit.name,
        "kind": fit.shape.kind.name,
        "weights": fit.weights,
        "points": int(fit.used.sum()),
        "left_out": [found.points.names[j] for j in fit.points[~fit.used]],
        "parameters": [
            {"name": f"{name}{f' {axis}' if axis else ''}", "value": v, "sigma": or_none(s), "unit": unit}
            for name, axis, v, s, unit in parameter_rows(fit, found.unit)
        ],
        "covariance": [[or_none(v) for v in row] for row in fit.covariance],
        "rms": fit.rms,
        "form_error": fit.form_error,
        "sigma0": or_none(fit.sigma0),
        "redundancy": fit.redundancy,
        "statistic": or_none(fit.statistic),
        "critical": or_none(fit.critical),
        "converged": fit.converged,
    }


def words_of_measured(found: Measurement) -> str:
    """Return in one line how much was measured, and how many deviations are decided in which way."""
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
    told = [f"{count} {decision}" for decision, count in counts.items() if count]
    return f"{counted(total, 'deviation')} judged by ISO 14253-1: {', '.join(told)}."


def scene_viewer(found: Measurement, result: Solution) -> Viewer | None:
    """Return the scene in the system of the measurement; None without photographs."""
    if not result.estimate.oriented.any():
        return None
    estimate, n = result.estimate, int(result.estimate.determined.sum())
    positions = result.position_covariance
    if found.alignment is not None:
        estimate = found.alignment.aligned_from_object.apply_estimate(estimate)
        positions = None
    kept = np.flatnonzero(result.estimate.determined)
    covariance = np.full((len(result.network.points), 3, 3), np.nan)
    covariance[kept] = found.points.blocks[:n]
    moved = replace(
        result,
        estimate=estimate,
        point_covariance=covariance,
        position_covariance=positions,
        covariance=None,
        unit=found.unit,
    )
    scene = scene_of_stored(moved)
    deviation = worst_deviation(found)[:n]
    if np.isfinite(deviation).any():
        scene = replace(scene, deviation=deviation)
    return viewer_of(scene, cut_pictures(scene, {}, budget_mb=0.0))


def worst_deviation(found: Measurement) -> FloatArray:
    """Return of each point its largest deviation from what tolerances, else shapes, say; NaN without any."""
    worst = np.full(len(found.points.names), np.nan)
    judged: list[Deviations | ShapeFit] = [*found.tolerances] or [*found.shapes]
    for one in judged:
        value = one.value if isinstance(one, Deviations) else one.deviation
        larger = ~(np.abs(value) <= np.abs(worst[one.points]))
        worst[one.points[larger]] = value[larger]
    return worst


def measurement_page(found: Measurement, viewer: Viewer | None) -> str:
    """Return the page: verdict, tolerances, shapes, functions and points."""
    pictures = [
        plot(
            f"deviations {k}",
            f"Deviations of {one.name} from {one.against}, with its limits.",
            deviation_figure(one, found.unit),
        )
        for k, one in enumerate(found.tolerances)
    ]
    verdict = found.verdict
    return render(
        "measurement.html",
        viewer=viewer,
        m=found,
        headline=verdict.headline,
        level=verdict.level,
        remarks=verdict.lines,
        pictures=pictures,
        decisions=DECISIONS,
        parameters=[parameter_rows(fit, found.unit) for fit in found.shapes],
        quantities=quantity_rows(found),
        sigma=point_sigma(found),
        shown=MAX_ROWS_SHOWN,
    )
