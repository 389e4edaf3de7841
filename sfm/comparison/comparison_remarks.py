"""Remarks on a comparison of two results, and the verdict on it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from sfm.comparison.causes import Cause
from sfm.comparison.significance import ResultComparison
from sfm.model.remarks.remark import Remark, remark
from sfm.model.remarks.row import WRONG_SIGMAS
from sfm.model.remarks.verdict import Level, Verdict, judge
from sfm.model.solution import MAX_POINTS

HEADLINES: Mapping[Level, str] = {
    "good": "The results do not differ significantly.",
    "fair": "The results were compared, and not tested.",
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
            # with its largest component positive
            axis = stretch.axis * np.sign(stretch.axis[np.argmax(np.abs(stretch.axis))])
            words = "(" + ", ".join(f"{x + 0.0:.2f}" for x in np.round(axis, 2)) + ")"
            yield remark("strained", axis=words, moved=moved, **numbers, **between)
    if row.bending:
        yield remark("bent", distance=largest, moved=moved, **between)


def _remarks(comparison: ResultComparison) -> Iterator[Remark]:
    tested = int(np.isfinite(comparison.statistic).sum())
    counted_points = {"tested": tested, "points": len(comparison.points)}
    yield from _remarks_on_differences(comparison, tested)
    if comparison.untested is not None:
        # untestable differences of which a cause is known were tested with it
        if comparison.cause is None or comparison.untested.kind != "untestable":
            yield comparison.untested
    elif comparison.approximate:
        yield remark("differences_tested", how="singly", **counted_points)
    elif tested <= MAX_POINTS < len(comparison.points):
        yield remark("differences_tested", how="jointly", **counted_points)
    too_lean = any(weakness.cameras for weakness in comparison.weaker)
    if comparison.changed and comparison.independent and not too_lean:
        yield from _remarks_on_cameras(comparison)
    for weakness in comparison.weaker:
        lean = bool(weakness.cameras)
        yield remark(
            "weaker_solution",
            weaker=weakness.name,
            of=weakness.of,
            theirs=(weakness.sigma_px, "px") if weakness.sigma_px is not None else None,
            ours=(weakness.own_px if lean else weakness.of_sigma_px, "px"),  # one number of both
            model=weakness.model if lean else None,
            cameras=weakness.cameras if lean else None,
            fits=(weakness.with_model_px, "px") if lean else None,
            own=(weakness.own_px, "px") if lean else None,
        )


def _remarks_on_differences(comparison: ResultComparison, tested: int) -> Iterator[Remark]:
    """Yield remarks on what differs: as a whole, poses of photographs, or so many tested points singly."""
    first, second = comparison.names
    longest = np.linalg.norm(comparison.point_difference, axis=1)
    unit = comparison.unit or "object units"
    if comparison.cause is not None:
        yield from remarks_of_cause(
            comparison.cause, first, second, len(comparison.points), (float(longest.max()), unit)
        )
    elif comparison.changed and comparison.poses is not None:
        poses = comparison.poses
        differ = [name for name, flag in zip(comparison.images, poses.significant, strict=True) if flag]
        yield remark(
            "points_differ",
            photographs=differ,
            orientation=float(np.nanmax(poses.statistic)),
            critical=poses.critical,
        )
    elif comparison.changed:
        names = [
            name for name, differs in zip(comparison.points, comparison.significant, strict=True) if differs
        ]
        if not comparison.majority:
            yield remark("no_majority_agrees", first=first, second=second)
        elif names:
            farthest = float(longest[comparison.significant].max())
            yield remark(
                "points_differ", points=names, differing=len(names), tested=tested, distance=(farthest, unit)
            )
        else:
            statistic, critical = comparison.global_statistic, comparison.global_critical
            yield remark("points_differ", statistic=statistic, critical=critical)


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
