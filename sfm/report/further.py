"""Photographs to be added to a survey, as page, table and exterior orientation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from sfm.conventions import angles_from_rotation
from sfm.display import counted
from sfm.files.plain_text import csv_text
from sfm.planning.further import Further
from sfm.report.html.page import render
from sfm.report.numbers import finer_unit, significant
from sfm.report.page_files import write_files
from sfm.report.viewer.embedded import viewer_of
from sfm.report.viewer.pictures import Pictures
from sfm.report.viewer.stored_scene import scene_of_stored
from sfm.solution import Solution

FILES = ("exterior.csv", "points.csv", "more.html")


def write_further(found: Further, result: Solution, out: Path) -> Path:
    """Write the photographs to be added into a folder and return the path of its page.

    Args:
        found: the photographs.
        result: of the survey.
        out: the folder.

    Raises:
        OutputError: the folder holds something else or cannot be written.
    """
    angles = np.degrees(angles_from_rotation(found.stations.rotation))
    exterior = (
        (name, *X0, *a)
        for name, X0, a in zip(
            found.stations.names, found.stations.position.tolist(), angles.tolist(), strict=True
        )
    )
    sigma = (
        (name, *("" if not np.isfinite(s) else s for s in both))
        for name, *both in zip(
            result.network.points, found.before.tolist(), found.after.tolist(), strict=True
        )
    )
    a = found.adjustment
    scene = scene_of_stored(replace(a.solution, name=result.name, unit=result.unit))
    page = render(
        "more.html",
        viewer=viewer_of(scene, Pictures()),
        title=result.name,
        level=_level(found),
        headline=headline(found, result),
        remarks=["What hides a point from a new station is not known: look before you photograph."],
        found=found,
        size=float(np.abs([s.position for s in found.shots]).max(initial=0.0)),
        unit=result.unit or "object units",
        weakest=weakest(found, result),
    )
    texts = (
        csv_text(("image", "X", "Y", "Z", "omega_deg", "phi_deg", "kappa_deg"), exterior),
        csv_text(("id", "sigma", "sigma_with_more"), sigma),
        page,
    )
    return write_files(out, tuple(zip(FILES, texts, strict=True)), main=FILES[-1])


def headline(found: Further, result: Solution) -> str:
    """Return what the photographs give, in a sentence."""
    known = np.isfinite(found.before)
    before, after = (_length(result, float(s[known].max())) for s in (found.before, found.after))
    count = len(found.stations)
    return f"{counted(count, 'more photograph')}: sigma of the worst point from {before} to {after}"


def _level(found: Further) -> str:
    """Say "good" only of what is determined with them."""
    return "bad" if found.adjustment.undetermined else "good"


def weakest(found: Further, result: Solution) -> list[tuple[str, str, str]]:
    """Return name and sigma before and after of the weakest points."""
    return [
        (
            result.network.points[j],
            _length(result, float(found.before[j])),
            _length(result, float(found.after[j])),
        )
        for j in found.points
    ]


def _length(result: Solution, value: float) -> str:
    factor, unit = finer_unit(result.unit, value)
    return f"{significant(value * factor)} {unit or 'object units'}"
