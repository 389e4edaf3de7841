"""The page of a comparison of two results."""

from __future__ import annotations

import math
from itertools import compress
from typing import Any

import numpy as np

from sfm.comparison.findings import verdict_of_comparison
from sfm.comparison.significance import InteriorDifference, ResultComparison
from sfm.conventions import FloatArray
from sfm.display import counted
from sfm.report.figures.comparisons import difference_figure
from sfm.report.figures.plots import plot
from sfm.report.page import (
    YES,
    Column,
    FoldedParts,
    Note,
    Page,
    Part,
    Section,
    Table,
    axes,
    tested_section,
    values_of,
)
from sfm.report.phrases import finer_unit, fixed, length_of, significant

PICTURE = (
    "Differences of the points. Arrows show the part in the object's main plane, red if significant; the "
    "colour of the dots shows the part out of the plane."
)
VALUES = (Column(), Column("value", format=str), Column("unit"))


def page(found: ResultComparison, *, xyz: FloatArray) -> Page:
    """Return the page of a comparison: verdict, key figures, picture and tables.

    Args:
        found: the comparison.
        xyz: coordinates of the common points in the first result, object unit, (n, 3).
    """
    first, second = found.names
    known = list(compress(found.names, found.has_sigma))
    tested = int(np.isfinite(found.statistic).sum())
    one_sided = len(known) == 1 and tested
    words = "The other result has no standard deviations; the test treats it as free of error."
    note = Note(words) if one_sided else None
    picture = None
    if len(found.points) >= 3 and _longest(found.point_difference) > 0:
        figure = difference_figure(xyz, found.point_difference, found.significant, found.unit)
        picture = plot("differences", PICTURE, figure)
    columns = (
        Column("point", "id"),
        *axes("d", found.unit),
        *axes("sd", found.unit),
        Column("T", "T", format=significant),
        Column("significant", "significant", flag=YES),
    )
    rows = [
        (name, *d, *s, t, flag)
        for name, d, s, t, flag in zip(
            *(found.points, found.point_difference, found.point_sigma, found.statistic, found.significant),
            strict=True,
        )
    ]
    verdict = verdict_of_comparison(found)
    return Page(
        "comparison",
        "Comparison",
        f"{second} minus {first}",
        verdict,
        (
            Section("Figures", _figures(found, known), note),
            Section("Test", *_test(found, tested)),
            Section("Picture", picture),
            *(Section(f"Camera {one.camera}", *_camera(one, second)) for one in found.interior),
            tested_section(verdict),
            Section("Points", FoldedParts(counted(len(rows), "point"), Table(columns, rows, "differences"))),
        ),
        summary=_summary(found, tested),
    )


def _figures(found: ResultComparison, known: list[str]) -> Table:
    """Return how the two results were aligned, and how far apart they are."""

    def length(name: str, value: float) -> tuple[str, str, str]:
        factor, unit = finer_unit(found.unit, value)
        return name, significant(value * factor), unit or "object units"

    aligned = {
        "points": counted(len(found.points), "common point"),
        "cameras": counted(len(found.images), "projection centre"),
        "control": "control points",
        "none": "nothing: both are compared as they are",
    }[found.alignment]
    rows = (
        ("aligned by", aligned, ""),
        ("scale", describe_scale(found), ""),
        ("common points", describe_pairing(found), ""),
        length("RMS difference of a point coordinate", _rms(found.point_difference)),
        length("largest difference of a point", _longest(found.point_difference)),
        ("common photographs", len(found.images), ""),
        length("RMS difference of a projection centre coordinate", _rms(found.position_difference)),
        ("largest difference of a rotation", significant(_largest(found.rotation_deg)), "deg"),
        ("standard deviations known for", " and ".join(known) or "neither", ""),
    )
    return Table(VALUES, rows)


def _test(found: ResultComparison, tested: int) -> tuple[Part, ...]:
    if not tested:
        return ()
    largest = _largest(found.statistic[np.isfinite(found.statistic)])
    moved = f"{found.significant.sum()} of {tested}" if found.majority else "not known"
    columns = (Column(), *(Column(name, format=significant) for name in ("value", "critical value")))
    rows = (
        ("all points together", found.global_statistic, found.global_critical),
        ("largest of a single point", largest, found.critical),
        ("points that moved", moved, ""),
    )
    datum = "the points that did not move" if found.majority else "all common points"
    words = (
        "T = d' (Qa + Qb)^-1 d / 3 for a difference d, with the covariance of each point alone"
        if found.approximate
        else f"Both results refer to the datum of {datum}. T of a point is a third of the decrease in the "
        "weighted square sum of all differences when that point is left out"
    )
    return Table(columns, rows), Note(f"{words}; chance alone gives about 1.")


def _camera(one: InteriorDifference, second: str) -> tuple[Part | None, ...]:
    columns = (
        Column("parameter"),
        Column("difference", format=".4g"),
        Column("sigma", format=".2g", unknown="not known"),
        Column("unit"),
    )
    converted = one.conversion
    note = (
        None
        if converted is None
        else Note(
            f"{second}: {converted.source_model} written as {one.model} differs by "
            f"{fixed(converted.rms_px, 4)} px RMS, {fixed(converted.max_px, 4)} px at most. Parameters of a "
            "converted camera have no sigma here."
        )
    )
    return Table(columns, list(zip(one.names, one.difference, one.sigma, one.units, strict=True))), note


def _summary(found: ResultComparison, tested: int) -> dict[str, Any]:
    """Return the content of comparison.json."""
    verdict = verdict_of_comparison(found)
    return {
        "results": found.names,
        "length_unit": found.unit,
        "standard_deviations": found.has_sigma,
        "same_image_points": found.same_share,
        "paired": values_of(
            found.pairing, "points_by_name points_by_image_points points_by_place images_by_name"
        ),
        **values_of(found, "alignment scale_estimated"),
        "scale": found.a_from_b.scale,
        "points": len(found.points),
        "images": len(found.images),
        "rms_point": _rms(found.point_difference),
        "max_point": _longest(found.point_difference),
        "rms_position": _rms(found.position_difference),
        "max_rotation_deg": _largest(found.rotation_deg),
        "changed": found.changed,
        **verdict.as_dict(),
        "untested": found.untested and found.untested.kind,
        "approximate": found.approximate,
        "tested": tested,
        "global_test": {"statistic": found.global_statistic, "critical": found.global_critical},
        "significant": list(compress(found.points, found.significant)),
        "cameras": [
            {
                "name": one.camera,
                "model": one.model,
                "difference": dict(zip(one.names, one.difference, strict=True)),
                "sigma": dict(zip(one.names, one.sigma, strict=True)),
                "conversion": one.conversion
                and {"from": one.conversion.source_model} | values_of(one.conversion, "rms_px max_px"),
            }
            for one in found.interior
        ],
    }


def describe_pairing(found: ResultComparison) -> str:
    """Return in words how many points are common and how they were matched."""
    pairing = found.pairing
    ways = [
        (pairing.points_by_name, "by name"),
        (pairing.points_by_image_points, "by their image points"),
        (pairing.points_by_place, "by position"),
    ]
    said = ", ".join(f"{count} {way}" for count, way in ways if count)
    return f"{counted(len(found.points), 'common point')}{f' ({said})' if said else ''}"


def describe_scale(found: ResultComparison) -> str:
    """Return in words how the alignment treated the scale."""
    if found.alignment == "none":
        return "not aligned"
    if not found.scale_estimated:
        return "scale kept: both results are scaled"
    return f"scale estimated, {found.a_from_b.scale:.9g}: not both results are scaled"


def largest_difference(found: ResultComparison) -> str:
    """Return the largest difference of a point with its unit."""
    longest = _longest(found.point_difference)
    return length_of(longest, found.unit, of_unknown=f"object units of {found.names[0]}")


def _largest(values: FloatArray) -> float:
    return float(values.max()) if len(values) else math.nan


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(vectors**2))) if vectors.size else math.nan


def _longest(vectors: FloatArray) -> float:
    return float(np.linalg.norm(vectors, axis=1).max()) if len(vectors) else math.nan
