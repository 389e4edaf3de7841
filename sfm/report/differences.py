"""The comparison of two results as differences.csv, comparison.json and comparison.html."""

from __future__ import annotations

import json
import math
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sfm.analysis.significance import ResultComparison
from sfm.report.markup import figure, significant, table
from sfm.report.pages import csv_text, page, png, write_files
from sfm.report.plots import plan_axes

COLUMNS = ("id", "dX", "dY", "dZ", "sdX", "sdY", "sdZ", "T", "significant")
BLUE, RED = "#1f5fa8", "#c8372d"
LONGEST_ARROW = 0.1  # of the object's size, that of the largest difference


def write_differences(found: ResultComparison, xyz: np.ndarray, out: Path, *, unit: str = "") -> Path:
    """Write a comparison into a folder and return the path of its page.

    Args:
        found: the comparison.
        xyz: coordinates of the common points in the first result, object unit, (n, 3).
        out: the folder.
        unit: object unit, for people.

    Raises:
        OutputError: the folder holds something else or cannot be written.
    """
    rows = [
        (name, *d, *s, t, int(flag))
        for name, d, s, t, flag in zip(
            found.points,
            found.point_difference,
            found.point_sigma,
            found.statistic,
            found.significant,
            strict=True,
        )
    ]
    text = json.dumps(differences_summary(found), indent=2, ensure_ascii=False, allow_nan=False)
    return write_files(
        out,
        (
            ("differences.csv", csv_text(COLUMNS, rows)),
            ("comparison.json", text + "\n"),
            ("comparison.html", differences_page(found, xyz, unit)),
        ),
        main="comparison.html",
    )


def differences_summary(found: ResultComparison) -> dict[str, Any]:
    """Return what comparison.json holds: plain values only, None for what is not known."""
    return {
        "results": list(found.names),
        "alignment": found.alignment,
        "scale": _number(found.a_from_b.scale),
        "points": len(found.points),
        "images": len(found.images),
        "rms_point": _number(_rms(found.point_difference)),
        "max_point": _number(_longest(found.point_difference)),
        "rms_position": _number(_rms(found.position_difference)),
        "max_rotation_deg": _number(float(np.max(found.rotation_deg, initial=0.0))),
        "changed": found.changed,
        "global_test": {
            "statistic": _number(found.global_statistic),
            "critical": _number(found.global_critical),
        },
        "significant": [n for n, flag in zip(found.points, found.significant, strict=True) if flag],
        "cameras": [
            {
                "name": one.camera,
                "model": one.model,
                "difference": dict(zip(one.names, map(_number, one.difference), strict=True)),
                "sigma": dict(zip(one.names, map(_number, one.sigma), strict=True)),
                "conversion": None
                if one.conversion is None
                else {
                    "from": one.conversion.source_model,
                    "rms_px": one.conversion.rms_px,
                    "max_px": one.conversion.max_px,
                },
            }
            for one in found.interior
        ],
    }


def differences_page(found: ResultComparison, xyz: np.ndarray, unit: str) -> str:
    """Return the page: verdict, figures, picture and tables."""
    a, b = found.names
    verdict, level = {
        None: ("No standard deviations are known: differences without a test.", "fair"),
        False: ("No significant difference of the points as a whole.", "good"),
        True: ("The points differ significantly.", "bad"),
    }[found.changed]
    aligned = {
        "points": f"{len(found.points)} common points",
        "cameras": f"{len(found.images)} projection centres",
        "control": "control points",
        "none": "nothing: both as they are",
    }[found.alignment]
    facts = [
        ("aligned by", aligned, ""),
        ("scale", f"{found.a_from_b.scale:.9g}", ""),
        ("RMS of a point coordinate", significant(_rms(found.point_difference)), unit),
        ("largest point difference", significant(_longest(found.point_difference)), unit),
        ("RMS of a projection centre", significant(_rms(found.position_difference)), unit),
        ("largest rotation", significant(float(np.max(found.rotation_deg, initial=0.0))), "deg"),
        (
            "global test",
            significant(found.global_statistic),
            f"critical {significant(found.global_critical)}",
        ),
        ("points above the critical value", str(int(found.significant.sum())), f"of {len(found.points)}"),
    ]
    sections = [("Figures", table(("", "value", ""), facts, plain_first=True))]
    if len(found.points) >= 3:
        caption = "Differences of the points in the object's main plane; red ones are significant."
        sections.append(("Picture", figure(png(difference_figure(found, xyz, unit)), caption)))
    for one in found.interior:
        rows = [
            (name, f"{d:.4g}", "" if math.isnan(s) else f"{s:.2g}")
            for name, d, s in zip(one.names, one.difference, one.sigma, strict=True)
        ]
        text = table(("parameter", "difference", "sigma"), rows)
        if one.conversion is not None:
            text += (
                f"<p class=note>{escape(b)}: {one.conversion.source_model} written as {one.model} differs by "
                f"{one.conversion.rms_px:.4f} px RMS, {one.conversion.max_px:.4f} px at most.</p>"
            )
        sections.append((f"Camera {one.camera}", text))
    point_rows = [
        (
            name,
            *(significant(v) for v in d),
            *(significant(v) for v in s),
            significant(t),
            "yes" if flag else "",
        )
        for name, d, s, t, flag in zip(
            found.points,
            found.point_difference,
            found.point_sigma,
            found.statistic,
            found.significant,
            strict=True,
        )
    ]
    listed = ("point", "dX", "dY", "dZ", "sdX", "sdY", "sdZ", "T", "significant")
    sections.append(
        (
            "Points",
            f"<details><summary>{len(point_rows)} points</summary>{table(listed, point_rows)}</details>",
        )
    )
    return page("Comparison", f"{b} minus {a}", verdict, level, sections)


def difference_figure(found: ResultComparison, xyz: np.ndarray, unit: str) -> Figure:
    """Draw the differences as arrows on the object's main plane."""
    plane, names = plan_axes(xyz)
    flat, arrows = xyz @ plane[:2].T, found.point_difference @ plane[:2].T
    size = float(np.linalg.norm(np.ptp(flat, axis=0)))
    longest = float(np.linalg.norm(arrows, axis=1).max(initial=0.0))
    factor = LONGEST_ARROW * size / longest if longest > 0 else 1.0
    picture = Figure(figsize=(8.5, 6), layout="constrained")
    axes = picture.subplots()
    colours = np.where(found.significant, RED, BLUE)
    axes.quiver(
        *flat.T, *(factor * arrows).T, color=colours, angles="xy", scale_units="xy", scale=1, width=0.002
    )
    axes.plot(*flat.T, ".", ms=2, color="black")
    axes.plot(*(flat + factor * arrows).T, alpha=0.0)  # arrows do not widen the axes by themselves
    axes.set_aspect("equal")
    axes.set_xlabel(f"{names[0]} {unit}".strip())
    axes.set_ylabel(f"{names[1]} {unit}".strip())
    axes.set_title(f"largest arrow {significant(longest)} {unit}".strip(), fontsize=10)
    return picture


def _rms(vectors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(vectors**2))) if vectors.size else math.nan


def _longest(vectors: np.ndarray) -> float:
    return float(np.linalg.norm(vectors, axis=1).max()) if len(vectors) else math.nan


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
