"""The page of photographs to add to a survey."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.model.display import counted
from sfm.model.remarks.verdict import Line
from sfm.model.solution import Solution
from sfm.products.planning.page import exterior_table, shot_columns, shot_rows
from sfm.products.planning.plan import Further
from sfm.report.page import Banner, Column, Note, Page, Section, Table
from sfm.report.phrases import length_of
from sfm.report.viewer.embedded import scene_of_stored, viewer_of
from sfm.report.viewer.pictures import Pictures

HIDDEN = Line("note", "Obstructions at a new station are not known: check the view before you photograph.")


def page(further: Further, *, result: Solution) -> Page:
    """Return the page: the photographs, and how they improve the weakest points.

    Args:
        further: the photographs to add.
        result: result of the survey.
    """
    lines: tuple[Line, ...] = (HIDDEN,)
    if result.network.moment is not None:
        single = f"These are single photographs by camera {further.camera}, without the others of its rig."
        lines = (Line("note", single), HIDDEN)
    size = float(np.abs([shot.position for shot in further.shots]).max(initial=0.0))
    columns = shot_columns(result.unit or "object units", size, planned=False)
    scene = scene_of_stored(replace(further.adjustment.solution, name=result.name, unit=result.unit))
    stations = Note(
        f"In the coordinates of the result, with camera {further.camera}. Azimuth (from +X towards +Y) and "
        "elevation give the viewing direction. Roll: counter-clockwise about that direction. Keep the focus "
        "of the survey: another focus needs another calibration."
    )
    sigma = Note(
        "Sigma: RMS of the three coordinates, in a free datum. Predicted for image points as precise as "
        "those of the survey."
    )
    weak = (Column("point"), Column("sigma now", format=str), Column("sigma with them", format=str))
    points = (Column(name="id"), Column(name="sigma"), Column(name="sigma_with_more"))
    level = "bad" if further.adjustment.undetermined else "good"  # good only if everything is determined
    return Page(
        "more",
        "Photographs to add",
        result.name,
        Banner(level, headline(further, result), lines),
        (
            Section("Photographs", Table(columns, shot_rows(further.shots)), stations),
            Section("Weakest points", Table(weak, weakest(further, result)), sigma),
        ),
        viewer=viewer_of(scene, Pictures()),
        files=(
            exterior_table(further.stations),
            Table(
                points, list(zip(result.network.points, further.before, further.after, strict=True)), "points"
            ),
        ),
    )


def headline(further: Further, result: Solution) -> str:
    """Return the improvement by the photographs, in a sentence."""
    known = np.isfinite(further.before)
    before, after = (length_of(float(s[known].max()), result.unit) for s in (further.before, further.after))
    count = len(further.stations)
    return f"{counted(count, 'more photograph')}: sigma of the worst point from {before} to {after}"


def weakest(further: Further, result: Solution) -> list[tuple[str, str, str]]:
    """Return name, sigma before and sigma after of the weakest points."""
    return [
        (
            result.network.points[j],
            length_of(float(further.before[j]), result.unit),
            length_of(float(further.after[j]), result.unit),
        )
        for j in further.points
    ]
