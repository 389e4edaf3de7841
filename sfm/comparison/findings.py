"""Remarks on a comparison of two results, and the verdict on it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from sfm.comparison.causes import Cause
from sfm.comparison.significance import ResultComparison
from sfm.model.conventions import FloatArray
from sfm.model.remarks.remark import WRONG_SIGMAS, Remark, remark
from sfm.model.remarks.verdict import Level, Verdict, judge
from sfm.model.solution import MAX_POINTS

HEADLINES: Mapping[Level, str] = {
    "good": "The points do not differ significantly.",
    "fair": "The points were compared, and not tested.",
    "bad": "The results differ significantly.",
}


def verdict_of_comparison(comparison: ResultComparison) -> Verdict:
    """Return the verdict on a comparison, with its remarks."""
    return judge(_remarks(comparison), HEADLINES)


def remarks_of_cause(
    cause: Cause, first: str, second: str, points: int, largest: tuple[float, str]
) -> Iterator[Remark]:
    """Yield the remarks on the cause of the differences of two results, one for each part of it.

    Args:
        cause: cause of the differences.
        first: name of the first result.
        second: name of the second result.
        points: number of compared points.
        largest: largest difference of a point, and its unit.
    """
    row, between = cause.row, {"first": first, "second": second}
    moved = cause.moved or None
    if cause.other_object:
        yield remark("another_object", points=points, **between)
    if row.mirror:
        yield remark("mirrored", **between)
    if cause.unit is not None:
        factor, (finer, coarser) = cause.unit.factor, cause.unit.units
        of_unit = {"factor": factor, "lengths": factor}
        if row.scale and cause.rest:
            rest, sigma = cause.lengths / factor, cause.lengths_sigma / factor
            of_unit |= {"lengths": cause.lengths, "rest": rest, "sigma": sigma}
        last = None if row.strain or row.bending else moved
        yield remark("unit_differs", moved=last, finer=finer, coarser=coarser, **of_unit, **between)
    elif row.scale:
        numbers = {"lengths": cause.lengths, "sigma": cause.lengths_sigma}
        yield remark("lengths_differ", moved=moved, **numbers, **between)
    if row.names:
        exchanged = [f"{ours} = {theirs}" for ours, theirs in cause.renamed]
        yield remark("names_differ", count=len(exchanged), exchanged=exchanged, **between)
    if row.strain:
        for stretch in cause.stretches:
            numbers = {"lengths": stretch.lengths, "sigma": stretch.sigma}
            if cause.unit is not None:
                numbers["factor"] = cause.unit.factor
            yield remark(
                "strained", axis=_describe_direction(stretch.axis), moved=moved, **numbers, **between
            )
    if row.bending:
        yield remark("bent", distance=largest, moved=moved, **between)


def _describe_direction(axis: FloatArray) -> str:
    """Return a direction as text, with its largest component positive."""
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    return "(" + ", ".join(f"{x + 0.0:.2f}" for x in np.round(axis, 2)) + ")"


def _remarks(comparison: ResultComparison) -> Iterator[Remark]:
    first, second = comparison.names
    longest = np.linalg.norm(comparison.point_difference, axis=1)
    unit = comparison.unit or "object units"
    if comparison.cause is not None:
        yield from remarks_of_cause(
            comparison.cause, first, second, len(comparison.points), (float(longest.max()), unit)
        )
    elif comparison.changed:
        yield _remark_on_differences(comparison, longest, unit)
    tested = int(np.isfinite(comparison.statistic).sum())
    if comparison.untested is not None:
        if (
            comparison.cause is None or comparison.untested.kind != "untestable"
        ):  # a cause was found and tested
            yield comparison.untested
    elif comparison.approximate:
        yield remark("tested_singly")
    elif tested <= MAX_POINTS < len(comparison.points):
        yield remark("tested_part", tested=tested, points=len(comparison.points))
    if comparison.changed and comparison.independent:
        yield from _remarks_on_cameras(comparison)


def _remark_on_differences(comparison: ResultComparison, longest: FloatArray, unit: str) -> Remark:
    """Return the remark on differences without any other cause than that points moved."""
    if not comparison.majority:
        return remark("no_majority_agrees", first=comparison.names[0], second=comparison.names[1])
    names = [name for name, differs in zip(comparison.points, comparison.significant, strict=True) if differs]
    if not names:
        return remark(
            "points_differ", statistic=comparison.global_statistic, critical=comparison.global_critical
        )
    largest = float(longest[comparison.significant].max())
    tested = int(np.isfinite(comparison.statistic).sum())
    return remark(
        "points_differ", points=names, differing=len(names), tested=tested, distance=(largest, unit)
    )


def _remarks_on_cameras(comparison: ResultComparison) -> Iterator[Remark]:
    """Yield remarks on cameras whose interior orientation differs, which shows that a lens moved."""
    for camera in comparison.interior:
        with np.errstate(invalid="ignore", divide="ignore"):
            sigmas = np.where(camera.sigma > 0, np.abs(camera.difference) / camera.sigma, 0.0)
        worst = int(np.argmax(sigmas))
        if sigmas[worst] >= WRONG_SIGMAS:
            difference = float(abs(camera.difference[worst])), camera.units[worst]
            yield remark(
                "interior_differs",
                camera=camera.camera,
                parameter=camera.names[worst],
                difference=difference,
                sigmas=float(sigmas[worst]),
            )
