"""The report of a survey that a stage could not finish: what stopped it, and how far it came."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version

import numpy as np

from sfm.model.display import counted
from sfm.model.remarks.row import SEVERITIES
from sfm.model.remarks.verdict import Verdict
from sfm.report.figures.overlays import Overlay
from sfm.report.page import Column, Note, Page, Part, Section, Table, Tile, facts, values_of
from sfm.report.survey_report import overlay_parts
from sfm.survey.unfinished import UnfinishedSurvey


def page(unfinished: UnfinishedSurvey, *, overlays: Sequence[Overlay] = ()) -> Page:
    """Return the page: the reason, what every stage reached, and the photographs.

    Args:
        unfinished: what the survey reached.
        overlays: photographs with their measured targets; links lead to the folder of overlays.
    """
    table = photograph_table(unfinished)
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
    written = facts([("Written", f"by Kolinear {version('kolinear')}"), *unfinished.settings])
    oriented = 0 if unfinished.oriented is None else int(unfinished.oriented.sum())
    return Page(
        "summary",
        "Survey report",
        unfinished.survey,
        verdict(unfinished),
        (
            Section("How far did it come?", facts(_steps(unfinished)), key="reached"),
            Section("Photographs", table, note, *shown, key="photographs"),
            Section("Settings", written, key="settings"),
        ),
        (
            Tile("Stopped in", unfinished.stage),
            Tile("Image points", len(unfinished.network.image_points)),
            Tile("Photographs oriented", f"{oriented} of {unfinished.images_total}"),
        ),
        summary=summary(unfinished),
        file="report",
    )


def verdict(unfinished: UnfinishedSurvey) -> Verdict:
    """Return the verdict: bad, whatever the remarks of the stages that were reached.

    Where one of them is the reason, it is an error, and its text is not repeated as the headline.
    """
    remarks = [remark for remark in unfinished.remarks if remark.test is None]
    tests = [remark for remark in unfinished.remarks if remark.test is not None]
    why = [remark for remark in remarks if unfinished.reason.startswith(remark.text.rstrip("."))]
    remarks = [replace(remark, at_least="error") if remark in why else remark for remark in remarks]
    remarks.sort(key=lambda remark: SEVERITIES.index(remark.severity))
    headline = f"The survey stopped in the stage {unfinished.stage}." if why else unfinished.reason
    return Verdict("bad", headline, tuple(remarks), tuple(tests))


def summary(unfinished: UnfinishedSurvey) -> dict[str, object]:
    """Return the content of summary.json, with the names that it has for a finished survey."""
    return {
        **values_of(unfinished, "survey unit"),
        "verdict": verdict(unfinished).entry,
        "stopped_in": unfinished.stage,
        "images": {
            "used": 0,
            "oriented": None if unfinished.oriented is None else int(unfinished.oriented.sum()),
            "total": unfinished.images_total,
            "failed": [
                {"image": failure.image, "reason": failure.reason.as_dict()} for failure in unfinished.failed
            ],
        },
        "image_points": len(unfinished.network.image_points),
        "seconds": {time.stage: round(time.seconds, 3) for time in unfinished.seconds},
    }


def photograph_table(unfinished: UnfinishedSurvey) -> Table:
    """Return every photograph with its measured targets and image points, and why it is not oriented."""
    network = unfinished.network
    seen, m = network.image_points, len(network.images)
    rays = np.bincount(seen.point, minlength=len(network.points))
    points = np.bincount(seen.image, minlength=m)
    shared = np.bincount(seen.image[rays[seen.point] > 1], minlength=m)
    index = {name: i for i, name in enumerate(network.images)}
    targets = {photograph.image: len(photograph.xy) for photograph in unfinished.photographs}
    reasons = {
        failure.image: f"{failure.reason.text} {failure.reason.remedy}".rstrip()
        for failure in unfinished.failed
    }
    rows = []
    for image in unfinished.images:
        i = index.get(image)
        oriented = i is not None and unfinished.oriented is not None and bool(unfinished.oriented[i])
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


def _steps(unfinished: UnfinishedSurvey) -> list[tuple[str, str]]:
    """Return what every stage reached, by name."""
    network = unfinished.network
    seen = network.image_points
    rays = np.bincount(seen.point, minlength=len(network.points))
    measured, shared = (counted(int((rays >= least).sum()), "object point") for least in (1, 2))
    finished = ", ".join(f"{time.stage} ({time.seconds:.1f} s)" for time in unfinished.seconds)
    lost = {failure.image for failure in unfinished.failed if failure.is_counted} - set(network.images)
    photographs = f"{unfinished.images_total - len(lost)} of {unfinished.images_total} measured"
    rows = [
        ("Stopped in", unfinished.stage),
        ("Stages finished", finished or "none"),
        (
            "Photographs",
            photographs if unfinished.photographs else f"{len(network.images)} with image points",
        ),
    ]
    if unfinished.photographs:
        targets = sum(len(photograph.xy) for photograph in unfinished.photographs)
        rows.append(
            ("Targets", f"{targets} measured in {counted(len(unfinished.photographs), 'photograph')}")
        )
    points = f"{counted(len(seen), 'image point')} of {measured}; {shared} in two or more photographs"
    rows.append(("Image points", f"{points}{', matched' if unfinished.matched else ''}"))
    if unfinished.oriented is None or unfinished.determined is None:
        return [*rows, ("Orientation", "stopped, none oriented")]
    oriented = f"{unfinished.oriented.sum()} of {counted(len(unfinished.oriented), 'photograph')} oriented"
    known = counted(int(unfinished.determined.sum()), "object point")
    return [*rows, ("Orientation", f"{oriented}, {known} with approximate coordinates")]
