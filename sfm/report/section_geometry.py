"""The geometry of the network in the reports: rays, intersection angles, coverage, residuals by point."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfm.conventions import FloatArray
from sfm.files.plain_text import or_none
from sfm.report.geometry import WEAK_DEG, Coverage, Geometry, geometry_of
from sfm.report.markup import table
from sfm.report.text_lines import head, lines
from sfm.result import SurveyResult

MOST_BINS = 12  # numbers of rays that are told one by one
MOST_NAMES = 5  # weak points that are named


def geometry_text(result: SurveyResult) -> list[str]:
    """Return the part of report.txt."""
    found = geometry_of(result.adjustment)
    by_rays = ", ".join(f"{rays}: {n}" for rays, n in binned(found))
    told = (*_facts(result, found), ("points by rays", by_rays))
    return head("Geometry of the network") + [part for name, words in told for part in lines(name, words)]


def geometry_section(result: SurveyResult) -> str:
    """Return the part of report.html."""
    found = geometry_of(result.adjustment)
    bins = binned(found)
    return (
        "<h3>Geometry of the network</h3>"
        + table(("", ""), _facts(result, found), plain_first=True, head=False)
        + table(("rays", *(rays for rays, _ in bins)), [("points", *(str(n) for _, n in bins))])
        + "<p class=note>Rays are the accepted image points of a point; its intersection angle is the "
        "largest between two of them, 90 degrees at best. Coverage is the part of a photograph within the "
        "convex hull of its image points: the lens is known only there. Of every point and photograph: "
        "points.csv and images.csv.</p>"
    )


def geometry_summary(result: SurveyResult) -> dict[str, Any]:
    """Return the part of summary.json."""
    found, network = geometry_of(result.adjustment), result.adjustment.network
    return {
        "rays": _spread(found.rays.astype(float)),
        "points_by_rays": {str(rays): n for rays, n in found.histogram()},
        "intersection_angle_deg": _spread(found.angle_deg),
        "weak_points": [network.points[j] for j in found.weak],
        "point_rms_px": _spread(found.point_rms_px),
        "image_rms_px": _spread(found.image_rms_px),
        "coverage": [
            {
                "camera": one.camera,
                "hull": _spread(one.hull) | {"all": or_none(one.hull_of_all)},
                "radius": _spread(one.radius),
            }
            for one in found.coverage
        ],
    }


def binned(found: Geometry) -> list[tuple[str, int]]:
    """Return (rays, points with so many); ranges of rays where there are many different numbers."""
    histogram = found.histogram()
    if len(histogram) <= MOST_BINS:
        return [(str(rays), n) for rays, n in histogram]
    low, high = histogram[0][0], histogram[-1][0]
    width = -(-(high - low + 1) // MOST_BINS)
    bins = []
    for first in range(low, high + 1, width):
        last = min(first + width - 1, high)
        count = sum(n for rays, n in histogram if first <= rays <= last)
        bins.append((f"{first}-{last}" if last > first else str(first), count))
    return bins


def _facts(result: SurveyResult, found: Geometry) -> list[tuple[str, str]]:
    """Return what is told of the network, and the words for it."""
    network = result.adjustment.network
    weak = found.weak
    names = ", ".join(f"{network.points[j]} ({found.angle_deg[j]:.1f})" for j in weak[:MOST_NAMES])
    more = " ..." if len(weak) > MOST_NAMES else ""
    told = f"{len(weak)} points: {names}{more}" if len(weak) else "none"
    points = tuple(f"point {name}" for name in network.points)
    known = found.angle_deg[np.isfinite(found.angle_deg)]
    mean = f", mean {known.mean():.1f} deg; below {WEAK_DEG:g} deg: {told}" if len(known) else ""
    return [
        ("rays of a point", f"{found.rays.min()} to {found.rays.max()}, mean {found.rays.mean():.1f}"),
        ("intersection angle", _between(found.angle_deg, points, "deg", 1) + mean),
        ("RMS by point", f"{_between(found.point_rms_px, points, 'px', 4)} per coordinate"),
        ("RMS by photograph", f"{_between(found.image_rms_px, network.images, 'px', 4)} per coordinate"),
        *((f"coverage {one.camera}", _covered(one)) for one in found.coverage),
    ]


def _between(values: FloatArray, names: tuple[str, ...], unit: str, decimals: int) -> str:
    """Write the smallest and the largest of values, and whose they are."""
    if not np.isfinite(values).any():
        return "not known"
    low, high = int(np.nanargmin(values)), int(np.nanargmax(values))
    return (
        f"{values[low]:.{decimals}f} {unit} ({names[low]}) to {values[high]:.{decimals}f} {unit} "
        f"({names[high]})"
    )


def _covered(one: Coverage) -> str:
    hull, radius = 100 * one.hull, 100 * one.radius
    area = f"{hull.min():.0f} to {hull.max():.0f} % of a photograph, mean {hull.mean():.0f} %"
    reach = f"{radius.min():.0f} to {radius.max():.0f} % of half the diagonal"
    return f"{area}, all together {100 * one.hull_of_all:.0f} %; from the centre {reach}"


def _spread(values: FloatArray) -> dict[str, float | None]:
    """Return the smallest, mean and largest of the values known."""
    known = values[np.isfinite(values)]
    if not len(known):
        return {"min": None, "mean": None, "max": None}
    return {"min": float(known.min()), "mean": float(known.mean()), "max": float(known.max())}
