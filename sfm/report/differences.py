"""The comparison of two results as differences.csv, comparison.json and comparison.html."""

from __future__ import annotations

import json
import math
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sfm.comparison.significance import ResultComparison
from sfm.files.plain_text import csv_text, or_none
from sfm.report.markup import figure, finer_unit, significant, table
from sfm.report.pages import page, png, write_files
from sfm.report.plots import BLUE, RED, plan_axes

COLUMNS = ("id", "dX", "dY", "dZ", "sdX", "sdY", "sdZ", "T", "significant")
FILES = ("differences.csv", "comparison.json", "comparison.html")
LONGEST_ARROW = 0.1  # of the object's size, that of the largest difference


def write_differences(found: ResultComparison, xyz: np.ndarray, out: Path) -> Path:
    """Write a comparison into a folder and return the path of its page.

    Args:
        found: the comparison.
        xyz: coordinates of the common points in the first result, object unit, (n, 3).
        out: the folder.

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
    texts = (csv_text(COLUMNS, rows), text + "\n", differences_page(found, xyz))
    return write_files(out, tuple(zip(FILES, texts, strict=True)), main=FILES[-1])


def differences_summary(found: ResultComparison) -> dict[str, Any]:
    """Return what comparison.json holds: plain values only, None for what is not known."""
    return {
        "results": list(found.names),
        "length_unit": found.unit,
        "standard_deviations": list(found.has_sigma),
        "same_image_points": or_none(found.same_share),
        "alignment": found.alignment,
        "scale": or_none(found.a_from_b.scale),
        "points": len(found.points),
        "images": len(found.images),
        "rms_point": or_none(_rms(found.point_difference)),
        "max_point": or_none(_longest(found.point_difference)),
        "rms_position": or_none(_rms(found.position_difference)),
        "max_rotation_deg": or_none(_largest(found.rotation_deg)),
        "changed": found.changed,
        "tested": _tested(found),
        "global_test": {
            "statistic": or_none(found.global_statistic),
            "critical": or_none(found.global_critical),
        },
        "significant": [n for n, flag in zip(found.points, found.significant, strict=True) if flag],
        "cameras": [
            {
                "name": one.camera,
                "model": one.model,
                "difference": dict(zip(one.names, map(or_none, one.difference), strict=True)),
                "sigma": dict(zip(one.names, map(or_none, one.sigma), strict=True)),
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


def words_of_test(found: ResultComparison) -> tuple[str, str]:
    """Return in words what the test of the points says, or why there is none, and good | fair | bad."""
    if not found.points:
        return "No points in common: only photographs and cameras are compared.", "fair"
    if not found.independent:
        return (
            f"Not tested: {found.same_share:.0%} of the image points of {found.names[0]} are those of "
            f"{found.names[1]}. The differences are those of adjusters, models and datum.",
            "fair",
        )
    if not any(found.has_sigma):
        return "Not tested: neither result knows its standard deviations.", "fair"
    if found.changed is None:
        return "Not tested: the standard deviations of the common points are not known.", "fair"
    if found.changed:
        return f"The points differ significantly, {int(found.significant.sum())} of them singly.", "bad"
    single = int(found.significant.sum())
    alone = f", but {single} of them singly" if single else ""
    return f"The points do not differ significantly as a whole{alone}.", "fair" if single else "good"


def largest_difference(found: ResultComparison) -> str:
    """Return the largest difference of a point with its unit."""
    longest = _longest(found.point_difference)
    factor, unit = finer_unit(found.unit, longest)
    return f"{significant(longest * factor)} {unit or 'object units of ' + found.names[0]}"


def differences_page(found: ResultComparison, xyz: np.ndarray) -> str:
    """Return the page: verdict, figures, picture and tables."""
    a, b = found.names
    verdict, level = words_of_test(found)
    aligned = {
        "points": f"{len(found.points)} common points",
        "cameras": f"{len(found.images)} projection centres",
        "control": "control points",
        "none": "nothing: both as they are",
    }[found.alignment]
    known = [name for name, has in zip(found.names, found.has_sigma, strict=True) if has]
    tested = _tested(found)
    sections = [
        (
            "Figures",
            table(
                ("", "value", "unit"),
                [
                    ("aligned by", aligned, ""),
                    ("scale of A over B", f"{found.a_from_b.scale:.9g}", ""),
                    ("common points", str(len(found.points)), ""),
                    ("RMS difference of a point coordinate", *_length(found, _rms(found.point_difference))),
                    ("largest difference of a point", *_length(found, _longest(found.point_difference))),
                    ("common photographs", str(len(found.images)), ""),
                    (
                        "RMS difference of a projection centre's coordinate",
                        *_length(found, _rms(found.position_difference)),
                    ),
                    ("largest difference of a rotation", significant(_largest(found.rotation_deg)), "deg"),
                    ("standard deviations known of", " and ".join(known) or "neither", ""),
                ],
            )
            + (
                "<p class=note>The other result has none, and counts as free of error in the test.</p>"
                if len(known) == 1 and tested
                else ""
            ),
        ),
    ]
    if tested:
        sections.append(
            (
                "Test",
                table(
                    ("", "value", "critical value"),
                    [
                        (
                            "all points together",
                            significant(found.global_statistic),
                            significant(found.global_critical),
                        ),
                        (
                            "largest of a single point",
                            significant(float(np.nanmax(found.statistic))),
                            significant(found.critical),
                        ),
                        (
                            "points above the critical value",
                            f"{int(found.significant.sum())} of {tested}",
                            "",
                        ),
                    ],
                )
                + "<p class=note>T = d' (Qa + Qb)^-1 d / 3 of a difference d: 1 is what chance gives.</p>",
            )
        )
    if len(found.points) >= 3 and _longest(found.point_difference) > 0:
        sections.append(("Picture", figure(png(difference_figure(found, xyz)), PICTURE)))
    for one in found.interior:
        rows = [
            (name, f"{d:.4g}", "not known" if math.isnan(s) else f"{s:.2g}", unit)
            for name, d, s, unit in zip(one.names, one.difference, one.sigma, one.units, strict=True)
        ]
        text = table(("parameter", "difference", "sigma", "unit"), rows)
        if one.conversion is not None:
            text += (
                f"<p class=note>{escape(b)}: {one.conversion.source_model} written as {one.model} differs by "
                f"{one.conversion.rms_px:.4f} px RMS, {one.conversion.max_px:.4f} px at most. Parameters of "
                "a converted camera have no sigma here.</p>"
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
    unit = f" [{found.unit}]" if found.unit else ""
    listed = (
        *("point", f"dX{unit}", f"dY{unit}", f"dZ{unit}"),
        *(f"sdX{unit}", f"sdY{unit}", f"sdZ{unit}", "T", "significant"),
    )
    sections.append(
        (
            "Points",
            f"<details><summary>{len(point_rows)} points</summary>{table(listed, point_rows)}</details>",
        )
    )
    return page("Comparison", f"{b} minus {a}", verdict, level, sections)


PICTURE = (
    "Differences of the points: arrows in the object's main plane, significant ones in red; the colour of "
    "the dots is the difference out of the plane."
)


def difference_figure(found: ResultComparison, xyz: np.ndarray) -> Figure:
    """Draw the differences as arrows on the object's main plane, and across it as colours."""
    plane, names = plan_axes(xyz)
    turned, d = xyz @ plane.T, found.point_difference @ plane.T
    flat = turned[:, :2]
    size = float(np.linalg.norm(np.ptp(flat, axis=0)))
    longest = float(np.linalg.norm(d[:, :2], axis=1).max())
    across = float(np.abs(d[:, 2]).max())
    factor = LONGEST_ARROW * size / longest if longest > 0 else 1.0
    finer, fine_unit = finer_unit(found.unit, max(longest, across))
    fine_unit = fine_unit or "object units"
    height = float(np.clip(8.5 * np.ptp(flat[:, 1]) / max(np.ptp(flat[:, 0]), 1e-12 * size), 2.5, 8.0))
    picture = Figure(figsize=(8.5, height + 0.8), layout="constrained")
    axes = picture.subplots()
    colours = np.where(found.significant, RED, BLUE)
    arrows = axes.quiver(
        *flat.T, *(factor * d[:, :2]).T, color=colours, angles="xy", scale_units="xy", scale=1, width=0.002
    )
    limit = across * finer or 1.0
    dots = axes.scatter(
        flat[:, 0],
        flat[:, 1],
        c=d[:, 2] * finer,
        s=14,
        cmap="coolwarm",
        vmin=-limit,
        vmax=limit,
        edgecolors="grey",
        lw=0.3,
    )
    picture.colorbar(dots, ax=axes, label=f"{names[2]} [{fine_unit}]", shrink=0.7, fraction=0.04)
    if longest > 0:
        label = f"{significant(longest * finer)} {fine_unit}"
        axes.quiverkey(arrows, 0.08, 1.03, factor * longest, label, labelpos="E", coordinates="axes")
    axes.plot(*(flat + factor * d[:, :2]).T, alpha=0.0)  # arrows do not widen the axes by themselves
    axes.set_aspect("equal")
    unit = f" [{found.unit}]" if found.unit else ""
    axes.set_xlabel(f"{names[0]}{unit}")
    axes.set_ylabel(f"{names[1]}{unit}")
    return picture


def _length(found: ResultComparison, value: float) -> tuple[str, str]:
    factor, unit = finer_unit(found.unit, value)
    return significant(value * factor), unit or "object units"


def _tested(found: ResultComparison) -> int:
    """How many points were tested."""
    return int(np.isfinite(found.statistic).sum())


def _largest(values: np.ndarray) -> float:
    return float(values.max()) if len(values) else math.nan


def _rms(vectors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(vectors**2))) if vectors.size else math.nan


def _longest(vectors: np.ndarray) -> float:
    return float(np.linalg.norm(vectors, axis=1).max()) if len(vectors) else math.nan
