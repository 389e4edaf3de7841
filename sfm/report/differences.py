"""The comparison of two results as differences.csv, comparison.json and comparison.html."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from sfm.comparison.findings import verdict_of_comparison
from sfm.comparison.significance import ResultComparison
from sfm.conventions import FloatArray
from sfm.display import counted
from sfm.files.plain_text import csv_text, or_none
from sfm.report.figures.comparisons import difference_figure
from sfm.report.figures.plot_data import Plot
from sfm.report.figures.plots import plot
from sfm.report.html.page import render
from sfm.report.numbers import finer_unit, significant
from sfm.report.page_files import write_files

COLUMNS = ("id", "dX", "dY", "dZ", "sdX", "sdY", "sdZ", "T", "significant")
FILES = ("differences.csv", "comparison.json", "comparison.html")
PICTURE = (
    "Differences of the points: arrows in the object's main plane, significant ones in red; the colour of "
    "the dots is the difference out of the plane."
)


def write_differences(found: ResultComparison, xyz: FloatArray, out: Path) -> Path:
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
    verdict = verdict_of_comparison(found)
    return {
        "results": list(found.names),
        "length_unit": found.unit,
        "standard_deviations": list(found.has_sigma),
        "same_image_points": or_none(found.same_share),
        "paired": {
            "points_by_name": found.pairing.points_by_name,
            "points_by_image_points": found.pairing.points_by_image_points,
            "points_by_place": found.pairing.points_by_place,
            "images_by_name": found.pairing.images_by_name,
        },
        "alignment": found.alignment,
        "scale_estimated": found.scale_estimated,
        "scale": or_none(found.a_from_b.scale),
        "points": len(found.points),
        "images": len(found.images),
        "rms_point": or_none(_rms(found.point_difference)),
        "max_point": or_none(_longest(found.point_difference)),
        "rms_position": or_none(_rms(found.position_difference)),
        "max_rotation_deg": or_none(_largest(found.rotation_deg)),
        "changed": found.changed,
        **verdict.as_dict(),
        "untested": found.untested and found.untested.kind,
        "approximate": found.approximate,
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


def words_of_pairing(found: ResultComparison) -> str:
    """Return in words how many points are common and by what they were recognised."""
    pairing = found.pairing
    ways = [
        (pairing.points_by_name, "by name"),
        (pairing.points_by_image_points, "by their image points"),
        (pairing.points_by_place, "by their place"),
    ]
    said = ", ".join(f"{count} {way}" for count, way in ways if count)
    return f"{counted(len(found.points), 'common point')}{f' ({said})' if said else ''}"


def words_of_scale(found: ResultComparison) -> str:
    """Return in words what became of the scale in the alignment."""
    if found.alignment == "none":
        return "not aligned"
    if not found.scale_estimated:
        return "scale kept: both results have one"
    return f"scale estimated, {found.a_from_b.scale:.9g}: not both results have one"


def largest_difference(found: ResultComparison) -> str:
    """Return the largest difference of a point with its unit."""
    longest = _longest(found.point_difference)
    factor, unit = finer_unit(found.unit, longest)
    return f"{significant(longest * factor)} {unit or 'object units of ' + found.names[0]}"


def differences_page(found: ResultComparison, xyz: FloatArray) -> str:
    """Return the page: verdict, figures, picture and tables."""
    verdict = verdict_of_comparison(found)
    largest = _longest(found.point_difference)
    return render(
        "comparison.html",
        headline=verdict.headline,
        level=verdict.level,
        remarks=verdict.lines,
        paired=words_of_pairing(found),
        scale=words_of_scale(found),
        found=found,
        size={
            "rms_point": _rms(found.point_difference),
            "max_point": largest,
            "rms_position": _rms(found.position_difference),
            "max_rotation_deg": _largest(found.rotation_deg),
            "tested": _tested(found),
            "largest_statistic": _largest(found.statistic[np.isfinite(found.statistic)]),
        },
        known=[name for name, has in zip(found.names, found.has_sigma, strict=True) if has],
        picture=_picture(found, xyz) if len(found.points) >= 3 and largest > 0 else None,
    )


def _picture(found: ResultComparison, xyz: FloatArray) -> Plot:
    figure = difference_figure(xyz, found.point_difference, found.significant, found.unit)
    return plot("differences", PICTURE, figure)


def _tested(found: ResultComparison) -> int:
    """How many points were tested."""
    return int(np.isfinite(found.statistic).sum())


def _largest(values: FloatArray) -> float:
    return float(values.max()) if len(values) else math.nan


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(vectors**2))) if vectors.size else math.nan


def _longest(vectors: FloatArray) -> float:
    return float(np.linalg.norm(vectors, axis=1).max()) if len(vectors) else math.nan
