"""The analysis of epochs as displacements.csv, series.csv, epochs.json and epochs.html.

The scene of two epochs: the points of the first with their displacements to the second.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sfm.adjustment.quality.statistics import POWER
from sfm.comparison.stable_points import point_blocks
from sfm.conventions import FloatArray
from sfm.display import counted, listed
from sfm.epochs.blocks import BlockMotion
from sfm.epochs.displacements import Displacements
from sfm.epochs.findings import verdict_of_epochs
from sfm.epochs.series import EpochPair, EpochSeries
from sfm.files.plain_text import csv_text, or_none
from sfm.report.figures.comparisons import difference_figure, series_figure
from sfm.report.figures.plot_data import Plot
from sfm.report.figures.plots import plot
from sfm.report.html.page import render
from sfm.report.numbers import finer_unit
from sfm.report.page_files import write_files
from sfm.report.viewer.embedded import Viewer, viewer_of
from sfm.report.viewer.pictures import cut_pictures
from sfm.report.viewer.scene import ViewerScene
from sfm.report.viewer.stored_scene import scene_of_stored
from sfm.solution import Solution

MOVED, STABLE, UNTESTED = "moved", "stable", "not tested"

NAMED = 12  # points in a sentence
FILES = ("displacements.csv", "series.csv", "epochs.json", "epochs.html")
COLUMNS = (
    *("first", "second", "id", "dX", "dY", "dZ", "sdX", "sdY", "sdZ", "length", "T", "critical", "stable"),
    *("moved", "detectable"),
)
SERIES = ("id", "epoch", "dX", "dY", "dZ", "sdX", "sdY", "sdZ", "moved")
DRAWN = 12  # points of a series that are drawn, those that moved farthest
PICTURE = (
    "Displacements: arrows in the object's main plane, points that moved in red; the colour of the dots is "
    "the displacement out of the plane."
)
BANDS = "Displacements since the first epoch along their last direction; bands of two standard deviations."


def write_epochs(found: EpochSeries, out: Path) -> Path:
    """Write an analysis of epochs into a folder and return the path of its page.

    Args:
        found: the analysis.
        out: the folder.

    Raises:
        OutputError: the folder holds something else or cannot be written.
    """
    text = json.dumps(epochs_summary(found), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    texts = (
        csv_text(COLUMNS, (row for pair in found.pairs for row in _rows(pair.displacements))),
        csv_text(SERIES, _series_rows(found)),
        text,
        epochs_page(found),
    )
    return write_files(out, tuple(zip(FILES, texts, strict=True)), main=FILES[-1])


def words_of_stable(found: Displacements) -> str:
    """Return in words which points carry the datum, and how they were found."""
    if not found.agreed:
        return (
            "No stable set is proposed; what is shown is in the datum of all points of reference. Name "
            "stable ones with --reference."
        )
    removed = [
        found.differences.points[s.removed] for s in found.congruency.search.steps if s.removed is not None
    ]
    count, all_of_them = int(found.stable.sum()), int(found.reference.sum())
    if count == all_of_them:
        return f"All {counted(count, 'point')} of reference agree."
    by = (
        " by removing one after the other"
        if found.congruency.robust is None or _same(found)
        else " by a robust start"
    )
    undecided = [n for n, u in zip(found.differences.points, found.undecided, strict=True) if u]
    left = f" Left out, and not shown to have moved: {_names(undecided)}." if undecided else ""
    gone = f" ({_names(removed)} in this order)" if removed and " one " in by else ""
    return (
        f"{count} of {all_of_them} points of reference are proposed as stable, found{by}{gone}.{left} Name "
        "others with --reference if you know better."
    )


def words_of_block(block: BlockMotion) -> str:
    """Return in words how a group moved."""
    parts = [part.name for part in block.parts if part.significant]
    how = " and ".join(parts) if parts else "nothing significant"
    rest = "its points moved as one" if block.fits else "what is left is significant: it changed its shape"
    return f"{block.name} ({counted(len(block.points), 'point')}, {block.model}): {how}; {rest}"


def epochs_summary(found: EpochSeries) -> dict[str, Any]:
    """Return what epochs.json holds: plain values only, None for what is not known."""
    verdict = verdict_of_epochs(found)
    return {
        "epochs": list(found.names),
        "changed": found.changed,
        **verdict.as_dict(),
        "adjusted_together": [
            {
                "camera": one.name,
                "epochs": list(one.epochs),
                "parameters": list(one.parameters),
                "T": or_none(one.statistic),
                "critical": or_none(one.critical),
            }
            for one in found.cameras
        ],
        "pairs": [_pair(p) for p in found.pairs],
    }


def epochs_page(found: EpochSeries) -> str:
    """Return the page: verdict, pairs of epochs with their tests, displacements and groups."""
    verdict = verdict_of_epochs(found)
    return render(
        "epochs.html",
        title=" - ".join((found.names[0], found.names[-1])),
        headline=verdict.headline,
        remarks=verdict.lines,
        level=verdict.level,
        power=POWER,
        viewer=_viewer(found),
        pairs=[
            {
                "found": pair.displacements,
                "title": " to ".join(pair.displacements.differences.names),
                "stable": words_of_stable(pair.displacements),
                "unit": finer_unit(pair.displacements.differences.unit, _typical(pair.displacements)),
                "groups": pair.blocks,
                "picture": _picture(pair.displacements, k),
            }
            for k, pair in enumerate(found.pairs)
        ],
        words_of_block=words_of_block,
        names=_names,
        series=_series_picture(found),
    )


def _pair(pair: EpochPair) -> dict[str, Any]:
    found = pair.displacements
    d = found.differences
    names = np.array(d.points, dtype=object)
    return {
        "first": d.names[0],
        "second": d.names[1],
        "length_unit": d.unit,
        "points": len(d.points),
        "only_first": list(d.only_first),
        "only_second": list(d.only_second),
        "untested": list(d.untested),
        "no_change": d.motion,
        "shared_given_values": list(d.shared),
        "held_alike": list(d.held_alike),
        "held_apart": list(d.held_apart),
        "alpha": found.alpha,
        "agreed": found.agreed,
        "stable": names[found.stable].tolist(),
        "moved": names[found.moved].tolist(),
        "undecided": names[found.undecided].tolist(),
        "steps": [
            {
                "points": step.points,
                "omega": or_none(step.omega),
                "freedom": step.freedom,
                "T": or_none(step.statistic),
                "critical": or_none(step.critical),
                "removed": None if step.removed is None else d.points[step.removed],
            }
            for step in found.congruency.search.steps
        ],
        "groups": [
            {
                "name": one.name,
                "points": list(one.points),
                "model": one.model,
                "centre": one.centre.tolist(),
                "parameters": {
                    name: {"value": or_none(value), "sigma": or_none(sigma)}
                    for name, value, sigma in zip(one.parameters, one.value, one.sigma, strict=True)
                },
                "significant": [part.name for part in one.parts if part.significant],
                "moved_as_one": one.fits,
            }
            for one in pair.blocks
        ],
    }


def _rows(found: Displacements) -> Iterable[tuple[object, ...]]:
    d = found.differences
    for k, name in enumerate(d.points):
        yield (
            *(*d.names, name, *found.displacement[k], *found.sigma[k]),
            *(
                float(np.linalg.norm(found.displacement[k])),
                found.congruency.statistic[k],
                found.congruency.critical[k],
            ),
            *(int(found.stable[k]), int(found.moved[k]), found.detectable[k]),
        )


def _series_rows(found: EpochSeries) -> Iterable[tuple[object, ...]]:
    for pair in found.since_first:
        one = pair.displacements
        for k, name in enumerate(one.differences.points):
            yield (name, one.differences.names[1], *one.displacement[k], *one.sigma[k], int(one.moved[k]))


def _viewer(found: EpochSeries) -> Viewer | None:
    """Return the scene of the first epoch with the displacements to the last; None without photographs."""
    if not found.first.result.estimate.oriented.any():
        return None
    scene = scene_of_displacements(found.since_first[-1].displacements, found.first.result)
    return viewer_of(scene, cut_pictures(scene, {}, budget_mb=0.0))


def _picture(found: Displacements, number: int) -> Plot | None:
    if not np.linalg.norm(found.displacement, axis=1).max() > 0:
        return None
    d = found.differences
    figure = difference_figure(d.xyz, found.displacement, found.moved, d.unit)
    return plot(f"displacements-{number}", PICTURE, figure)


def _series_picture(found: EpochSeries) -> Plot | None:
    """Return the series of the points that moved farthest; None with two epochs, or where none moved."""
    if len(found.names) < 3:
        return None
    pairs = [pair.displacements for pair in found.since_first]
    moved: dict[str, float] = {}
    for one in pairs:
        for k in np.flatnonzero(one.moved):
            name = one.differences.points[k]
            moved[name] = max(moved.get(name, 0.0), float(np.linalg.norm(one.displacement[k])))
    chosen = sorted(moved, key=lambda name: -moved[name])[:DRAWN]
    if not chosen:
        return None
    factor, unit = finer_unit(pairs[0].differences.unit, max(moved.values()))
    rows = [_along(name, pairs) for name in chosen]
    length, sigma = (factor * np.array([row[k] for row in rows]) for k in (0, 1))
    return plot("series", BANDS, series_figure(found.names, tuple(chosen), length, sigma, unit))


def _along(name: str, pairs: list[Displacements]) -> tuple[list[float], list[float]]:
    """Displacements of a point since the first epoch along its last direction, and their sigmas."""
    rows = [one.differences.points.index(name) if name in one.differences.points else -1 for one in pairs]
    last, k = next((one, k) for one, k in zip(reversed(pairs), reversed(rows), strict=True) if k >= 0)
    direction = last.displacement[k] / max(float(np.linalg.norm(last.displacement[k])), 1e-300)
    length, sigma = [0.0], [0.0]
    for one, k in zip(pairs, rows, strict=True):
        if k < 0:
            length.append(np.nan)
            sigma.append(np.nan)
            continue
        Q = one.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        length.append(float(one.displacement[k] @ direction))
        sigma.append(float(np.sqrt(max(direction @ Q @ direction, 0.0))))
    return length, sigma


def _typical(found: Displacements) -> float:
    lengths: FloatArray = np.linalg.norm(found.displacement, axis=1)
    return float(max(np.median(found.detectable), lengths.max()))


def _same(found: Displacements) -> bool:
    """Whether the proposed set is the one from the search through all points."""
    return bool((found.stable == found.congruency.search.stable).all())


def _names(names: Iterable[str]) -> str:
    return listed(names, most=NAMED)


def scene_of_displacements(found: Displacements, first: Solution) -> ViewerScene:
    """Return the scene of an epoch with the displacement of every point and what the test says of it.

    Standard deviations and ellipsoids are those of the displacements.

    Args:
        found: displacements from this epoch to another one.
        first: the epoch.
    """
    names = first.network.points
    row = {name: j for j, name in enumerate(names)}
    tested = np.array([row[name] for name in found.differences.points], dtype=np.int64)
    covariance = np.full((len(names), 3, 3), np.nan)
    covariance[tested] = point_blocks(found.covariance, 3)
    scene = scene_of_stored(replace(first, point_covariance=covariance, covariance=None))
    displacement = np.full((len(names), 3), np.nan)
    displacement[tested] = found.displacement
    state = [UNTESTED] * len(names)
    for k, j in enumerate(tested.tolist()):
        state[j] = MOVED if found.moved[k] else STABLE if found.stable[k] else ""
    kept = [row[name] for name in scene.points]
    return replace(
        scene,
        name=" to ".join(found.differences.names),
        displacement=displacement[kept],
        state=tuple(state[j] for j in kept),
        notes=(
            *scene.notes,
            f"Displacements from {found.differences.names[0]} to {found.differences.names[1]}; standard "
            "deviations and ellipsoids are those of the displacements.",
        ),
    )
