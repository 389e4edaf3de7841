"""The page of a comparison of two results."""

from __future__ import annotations

import math
from itertools import compress
from typing import Any

import numpy as np

from sfm.comparison.comparison_remarks import verdict_of_comparison
from sfm.comparison.significance import InteriorDifference, ResultComparison
from sfm.model.conventions import FloatArray
from sfm.model.display import counted
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
ANGLES = ("omega", "phi", "kappa")
ELEMENTS = ("X0", "Y0", "Z0", *ANGLES)
IN_DEG = np.array([1.0, 1.0, 1.0, *[math.degrees(1.0)] * 3])  # elements in object unit and deg, from rad
VALUES = (Column(), Column("value", format=str), Column("unit"))


def page(comparison: ResultComparison, *, xyz: FloatArray) -> Page:
    """Return the page of a comparison: verdict, key figures, picture and tables.

    Args:
        comparison: the comparison.
        xyz: coordinates of the common points in the first result, object unit, (n, 3).
    """
    first, second = comparison.names
    known = list(compress(comparison.names, comparison.has_sigma))
    tested = int(np.isfinite(comparison.statistic).sum())
    one_sided = len(known) == 1 and tested
    words = "The other result has no standard deviations; the test treats it as free of error."
    note = Note(words) if one_sided else None
    picture = None
    if len(comparison.points) >= 3 and _longest(comparison.point_difference) > 0:
        figure = difference_figure(xyz, comparison.point_difference, comparison.significant, comparison.unit)
        picture = plot("differences", PICTURE, figure)
    columns = (
        Column("point", "id"),
        *axes("d", comparison.unit),
        *axes("sd", comparison.unit),
        Column("T", "T", format=significant),
        Column("significant", "significant", flag=YES),
    )
    rows = [
        (name, *d, *s, t, flag)
        for name, d, s, t, flag in zip(
            comparison.points,
            comparison.point_difference,
            comparison.point_sigma,
            comparison.statistic,
            comparison.significant,
            strict=True,
        )
    ]
    cameras = [
        Section(f"Camera {interior.camera}", *_camera(interior, second)) for interior in comparison.interior
    ]
    verdict = verdict_of_comparison(comparison)
    return Page(
        "comparison",
        "Comparison",
        f"{second} minus {first}",
        verdict,
        (
            Section("Figures", _figures(comparison, known), note),
            Section("Test", *_test(comparison, tested)),
            Section("Photographs", *_poses(comparison)),
            Section("Picture", picture),
            *cameras,
            tested_section(verdict),
            Section("Points", FoldedParts(counted(len(rows), "point"), Table(columns, rows, "differences"))),
        ),
        summary=_summary(comparison, tested),
    )


def _figures(comparison: ResultComparison, known: list[str]) -> Table:
    """Return how the two results were aligned, and how far apart they are."""

    def length(name: str, value: float) -> tuple[str, str, str]:
        factor, unit = finer_unit(comparison.unit, value)
        return name, significant(value * factor), unit or "object units"

    aligned = {
        "points": counted(len(comparison.points), "common point"),
        "cameras": counted(len(comparison.images), "projection centre"),
        "control": "control points",
        "none": "nothing: both are compared as they are",
    }[comparison.alignment]
    rows = (
        ("aligned by", aligned, ""),
        ("scale", describe_scale(comparison), ""),
        ("common points", describe_pairing(comparison), ""),
        length("RMS difference of a point coordinate", _rms(comparison.point_difference)),
        length("largest difference of a point", _longest(comparison.point_difference)),
        ("common photographs", len(comparison.images), ""),
        length("RMS difference of a projection centre coordinate", _rms(comparison.position_difference)),
        ("largest difference of a rotation", significant(_largest(comparison.rotation_deg)), "deg"),
        ("standard deviations known for", " and ".join(known) or "neither", ""),
    )
    return Table(VALUES, rows)


def _test(comparison: ResultComparison, tested: int) -> tuple[Part, ...]:
    if not tested:
        return ()
    largest = _largest(comparison.statistic[np.isfinite(comparison.statistic)])
    moved = f"{comparison.significant.sum()} of {tested}" if comparison.majority else "not known"
    columns = (Column(), *(Column(name, format=significant) for name in ("value", "critical value")))
    rows = (
        ("all points together", comparison.global_statistic, comparison.global_critical),
        ("largest of a single point", largest, comparison.critical),
        ("points that moved", moved, ""),
    )
    datum = "the points that did not move" if comparison.majority else "all common points"
    words = (
        "T = d' (Qa + Qb)^-1 d / 3 for a difference d, with the covariance of each point alone"
        if comparison.approximate
        else f"Both results refer to the datum of {datum}. T of a point is a third of the decrease in the "
        "weighted square sum of all differences when that point is left out"
    )
    return Table(columns, rows), Note(f"{words}; chance alone gives about 1.")


def elements_table(comparison: ResultComparison) -> Table:
    """Return the differences of the elements of exterior orientation, with their standard deviations.

    Args:
        comparison: with tested photographs.
    """
    poses, unit = comparison.poses, comparison.unit or "object units"
    columns = (
        Column("photograph", "photograph"),
        Column("element", "element"),
        Column("difference", "difference", format=".4g"),
        Column("sigma", "sigma", format=".2g", unknown="not known"),
        Column("unit", "unit"),
        Column("in sigma", "in_sigma", format="+.2f", unknown="-"),
    )
    rows = []
    for k, image in enumerate(comparison.images if poses is not None else ()):
        assert poses is not None
        values = zip(
            ELEMENTS, poses.difference[k] * IN_DEG, poses.sigma[k] * IN_DEG, poses.sigmas[k], strict=True
        )
        rows += [
            (image, name, difference, sigma, "deg" if name in ANGLES else unit, ratio)
            for name, difference, sigma, ratio in values
        ]
    return Table(columns, rows, "elements")


def _poses(comparison: ResultComparison) -> tuple[Part, ...]:
    """Return the tests of the exterior orientations, and their differences."""
    poses = comparison.poses
    if poses is None:
        return ()
    columns = (
        Column("photograph", "photograph"),
        Column("T", "T", format=significant),
        Column("chi-square", "chi_square", format=significant),
        Column("critical value of T", "critical", format=significant),
        Column("significant", "significant", flag=YES),
    )
    tests = [
        (image, statistic, 6 * statistic, poses.critical, flag)
        for image, statistic, flag in zip(comparison.images, poses.statistic, poses.significant, strict=True)
    ]
    law = (
        "chi-square has 6 degrees of freedom"
        if poses.redundancy is None
        else f"T has the F distribution of 6 and {poses.redundancy} degrees of freedom"
    )
    words = (
        "Chi-square = d' (Qa + Qb)^-1 d for the difference d of the six elements, and T a sixth of it. "
        f"Measured separately and without any change, {law}, and T is about 1."
    )
    return Table(columns, tests, "orientations"), Note(words), elements_table(comparison)


def _camera(interior: InteriorDifference, second: str) -> tuple[Part | None, ...]:
    columns = (
        Column("parameter"),
        Column("difference", format=".4g"),
        Column("sigma", format=".2g", unknown="not known"),
        Column("unit"),
    )
    converted = interior.conversion
    note = (
        None
        if converted is None
        else Note(
            f"{second}: {converted.source_model} written as {interior.model} differs by "
            f"{fixed(converted.rms_px, 4)} px RMS, {fixed(converted.max_px, 4)} px at most. Parameters of a "
            "converted camera have no sigma here."
        )
    )
    return Table(
        columns, list(zip(interior.names, interior.difference, interior.sigma, interior.units, strict=True))
    ), note


def _summary(comparison: ResultComparison, tested: int) -> dict[str, Any]:
    """Return the content of comparison.json."""
    verdict = verdict_of_comparison(comparison)
    return {
        "results": comparison.names,
        "length_unit": comparison.unit,
        "standard_deviations": comparison.has_sigma,
        "same_image_points": comparison.same_share,
        "paired": values_of(
            comparison.pairing, "points_by_name points_by_image_points points_by_place images_by_name"
        ),
        **values_of(comparison, "alignment scale_estimated"),
        "scale": comparison.a_from_b.scale,
        "points": len(comparison.points),
        "images": len(comparison.images),
        "rms_point": _rms(comparison.point_difference),
        "max_point": _longest(comparison.point_difference),
        "rms_position": _rms(comparison.position_difference),
        "max_rotation_deg": _largest(comparison.rotation_deg),
        "changed": comparison.changed,
        **verdict.as_dict(),
        "untested": comparison.untested and comparison.untested.kind,
        "approximate": comparison.approximate,
        "tested": tested,
        "exterior_orientation": _summary_of_poses(comparison),
        "global_test": {"statistic": comparison.global_statistic, "critical": comparison.global_critical},
        "significant": list(compress(comparison.points, comparison.significant)),
        "cameras": [
            {
                "name": interior.camera,
                "model": interior.model,
                "difference": dict(zip(interior.names, interior.difference, strict=True)),
                "sigma": dict(zip(interior.names, interior.sigma, strict=True)),
                "conversion": interior.conversion
                and {"from": interior.conversion.source_model}
                | values_of(interior.conversion, "rms_px max_px"),
            }
            for interior in comparison.interior
        ],
    }


def _summary_of_poses(comparison: ResultComparison) -> list[dict[str, Any]]:
    """Return the differences of X0, Y0, Z0 (object unit), omega, phi, kappa (deg) and their tests."""
    poses = comparison.poses
    if poses is None:
        return []
    return [
        {
            "photograph": image,
            "difference": poses.difference[k] * IN_DEG,
            "sigma": poses.sigma[k] * IN_DEG,
            "statistic": poses.statistic[k],
            "critical": poses.critical,
            "redundancy": poses.redundancy,
        }
        for k, image in enumerate(comparison.images)
    ]


def describe_pairing(comparison: ResultComparison) -> str:
    """Return in words how many points are common and how they were matched."""
    pairing = comparison.pairing
    ways = [
        (pairing.points_by_name, "by name"),
        (pairing.points_by_image_points, "by their image points"),
        (pairing.points_by_place, "by position"),
    ]
    said = ", ".join(f"{count} {way}" for count, way in ways if count)
    return f"{counted(len(comparison.points), 'common point')}{f' ({said})' if said else ''}"


def describe_scale(comparison: ResultComparison) -> str:
    """Return in words how the alignment treated the scale."""
    if comparison.alignment == "none":
        return "not aligned" if comparison.points else "not aligned, as no points are common"
    if not comparison.scale_estimated:
        return "scale kept: both results are scaled"
    return f"scale estimated, {comparison.a_from_b.scale:.9g}: not both results are scaled"


def largest_difference(comparison: ResultComparison) -> str:
    """Return the largest difference of a point with its unit."""
    longest = _longest(comparison.point_difference)
    return length_of(longest, comparison.unit, of_unknown=f"object units of {comparison.names[0]}")


def largest_pose_difference(comparison: ResultComparison) -> str:
    """Return the largest difference of a projection centre with its unit, and of a rotation."""
    of_unknown = f"object units of {comparison.names[0]}"
    position = length_of(_longest(comparison.position_difference), comparison.unit, of_unknown=of_unknown)
    said = f"{position} and {significant(_largest(comparison.rotation_deg))} deg"
    if comparison.poses is None:
        return said
    statistic = _largest(comparison.poses.statistic[np.isfinite(comparison.poses.statistic)])
    return f"{said}; T {significant(statistic)}, limit {significant(comparison.poses.critical)}"


def _largest(values: FloatArray) -> float:
    return float(values.max()) if len(values) else math.nan


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(vectors**2))) if vectors.size else math.nan


def _longest(vectors: FloatArray) -> float:
    return float(np.linalg.norm(vectors, axis=1).max()) if len(vectors) else math.nan
