"""The report of a survey that a stage could not finish: what stopped it, and how far it came."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version

import numpy as np

from sfm.display import counted
from sfm.remarks.remark import SEVERITIES
from sfm.remarks.verdict import Verdict
from sfm.report.figures.overlays import Overlay
from sfm.report.page import Column, Note, Page, Part, Section, Table, Tile, facts, values_of
from sfm.report.survey_report import overlay_parts
from sfm.survey.unfinished import UnfinishedSurvey


def page(found: UnfinishedSurvey, *, overlays: Sequence[Overlay] = ()) -> Page:
    """Return the page: the reason, what every stage reached, and the photographs.

    Args:
        found: what the survey reached.
        overlays: photographs with their measured targets; links lead to the folder of overlays.
    """
    table = photograph_table(found)
    seen = dict(zip((row[0] for row in table.rows), (row[2] for row in table.rows), strict=True))
    shown: tuple[Part, ...] = ()
    if overlays:
        legend = Note(
            "Green: image points with their names; blue: measured, but not an image point; crosses: "
            "candidates that were not measured, coloured by reason. Click a picture to see it at full size."
        )
        words = {image: counted(int(points), "image point") for image, points in seen.items()}
        shown = (legend, *overlay_parts(overlays, lambda image: words.get(image, "")))
    note = Note("Shared: image points whose object point is also measured in another photograph.")
    written = facts([("Written", f"by Kolinear {version('kolinear')}"), *found.settings])
    oriented = 0 if found.oriented is None else int(found.oriented.sum())
    return Page(
        "summary",
        "Survey report",
        found.survey,
        verdict(found),
        (
            Section("How far did it come?", facts(_steps(found)), key="reached"),
            Section("Photographs", table, note, *shown, key="photographs"),
            Section("Settings", written, key="settings"),
        ),
        (
            Tile("Stopped in", found.stage),
            Tile("Image points", len(found.network.image_points)),
            Tile("Photographs oriented", f"{oriented} of {found.images_total}"),
        ),
        summary=summary(found),
        file="report",
    )


def verdict(found: UnfinishedSurvey) -> Verdict:
    """Return the verdict: bad, whatever the remarks of the stages that were reached."""
    remarks = [one for one in found.remarks if one.test is None]
    tests = [one for one in found.remarks if one.test is not None]
    remarks.sort(key=lambda one: SEVERITIES.index(one.severity))
    return Verdict("bad", found.reason, tuple(remarks), tuple(tests))


def summary(found: UnfinishedSurvey) -> dict[str, object]:
    """Return the content of summary.json, with the names that it has for a finished survey."""
    return {
        **values_of(found, "survey unit"),
        "verdict": verdict(found).entry,
        "stopped_in": found.stage,
        "images": {
            "used": 0,
            "oriented": None if found.oriented is None else int(found.oriented.sum()),
            "total": found.images_total,
            "failed": [{"image": one.image, "reason": one.reason.as_dict()} for one in found.failed],
        },
        "image_points": len(found.network.image_points),
        "seconds": {one.stage: round(one.seconds, 3) for one in found.seconds},
    }


def photograph_table(found: UnfinishedSurvey) -> Table:
    """Return every photograph with its measured targets and image points, and why it is not oriented."""
    network = found.network
    seen, m = network.image_points, len(network.images)
    rays = np.bincount(seen.point, minlength=len(network.points))
    points = np.bincount(seen.image, minlength=m)
    shared = np.bincount(seen.image[rays[seen.point] > 1], minlength=m)
    index = {name: i for i, name in enumerate(network.images)}
    targets = {one.image: len(one.xy) for one in found.photographs}
    reasons = {one.image: f"{one.reason.text} {one.reason.remedy}".rstrip() for one in found.failed}
    rows = []
    for image in found.images:
        i = index.get(image)
        oriented = i is not None and found.oriented is not None and bool(found.oriented[i])
        state = "oriented" if oriented else "not oriented"
        if not oriented and (i is None or not shared[i]):
            state = "none of its points is in another photograph"
        rows.append(
            (
                image,
                targets.get(image),
                0 if i is None else int(points[i]),
                0 if i is None else int(shared[i]),
                state if oriented else reasons.get(image, state),
            )
        )
    return Table(
        (
            Column("photograph", "image"),
            Column("targets" if targets else None, "targets", format=str),
            Column("image points", "image_points", format=str),
            Column("shared", "shared", format=str),
            Column("orientation", "orientation"),
        ),
        rows,
        "photographs",
    )


def _steps(found: UnfinishedSurvey) -> list[tuple[str, str]]:
    """Return what every stage reached, by name."""
    network = found.network
    seen = network.image_points
    rays = np.bincount(seen.point, minlength=len(network.points))
    measured, shared = (counted(int((rays >= least).sum()), "object point") for least in (1, 2))
    finished = ", ".join(f"{one.stage} ({one.seconds:.1f} s)" for one in found.seconds)
    lost = {one.image for one in found.failed if one.is_counted} - set(network.images)
    photographs = f"{found.images_total - len(lost)} of {found.images_total} measured"
    rows = [
        ("Stopped in", found.stage),
        ("Stages finished", finished or "none"),
        ("Photographs", photographs if found.photographs else f"{len(network.images)} with image points"),
    ]
    if found.photographs:
        targets = sum(len(one.xy) for one in found.photographs)
        rows.append(("Targets", f"{targets} measured in {counted(len(found.photographs), 'photograph')}"))
    points = f"{counted(len(seen), 'image point')} of {measured}; {shared} in two or more photographs"
    rows.append(("Image points", f"{points}{', matched' if found.matched else ''}"))
    if found.oriented is None or found.determined is None:
        return [*rows, ("Orientation", "stopped, none oriented")]
    oriented = f"{found.oriented.sum()} of {counted(len(found.oriented), 'photograph')} oriented"
    known = counted(int(found.determined.sum()), "object point")
    return [*rows, ("Orientation", f"{oriented}, {known} with approximate coordinates")]
