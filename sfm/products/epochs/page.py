"""The page of a deformation analysis; its viewer shows the points of the first epoch and their motion."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import chain, compress
from typing import Any

import numpy as np

from sfm.comparison.stable_points import point_blocks
from sfm.model.conventions import FloatArray
from sfm.model.display import counted, listed
from sfm.model.distributions import POWER
from sfm.model.solution import Solution
from sfm.products.epochs.displacements import Displacements
from sfm.products.epochs.series import BlockMotion, EpochPair, EpochSeries, verdict_of_epochs
from sfm.report.figures.comparisons import difference_figure
from sfm.report.figures.plot_data import Plot
from sfm.report.figures.plots import plot, single_panel_figure
from sfm.report.page import (
    YES,
    Column,
    FoldedParts,
    Heading,
    Note,
    Page,
    Paragraph,
    Part,
    Section,
    Table,
    axes,
    tested_section,
    values_of,
)
from sfm.report.phrases import finer_unit, general, significant
from sfm.report.viewer.embedded import Viewer, scene_of_stored, viewer_of
from sfm.report.viewer.pictures import ViewerScene, cut_pictures

MAX_NAMED = 12  # points in a sentence
MAX_DRAWN = 12  # points drawn of a series: those that moved farthest
MOVED, STABLE, UNTESTED = "moved", "stable", "not tested"  # in the viewer
BANDS = "Displacements since the first epoch along their latest direction; bands of two standard deviations."
PICTURE = (
    "Displacements. Arrows show the part in the object's main plane, red for points that moved; the colour "
    "of the dots shows the part out of the plane."
)
STEPS = (
    Column("points", "points", format=str),
    Column("Omega", "omega", format=significant),
    Column("degrees of freedom", "freedom", format=str),
    Column("T", "T", format=significant),
    Column("critical value", "critical", format=significant),
    Column("removed then", "removed"),
)
SERIES = (
    Column(name="id"),
    Column(name="epoch"),
    *axes("d"),
    *axes("sd"),
    Column(name="moved", flag=YES),
)
MICRO, DEGREES = 1e6, float(np.rad2deg(1.0))


def page(series: EpochSeries) -> Page:
    """Return the page: verdict, pairs of epochs with their tests, displacements and groups."""
    displacements = [row for pair in series.pairs for row in _rows(pair.displacements)]
    since = [row for pair in series.since_first for row in _rows(pair.displacements)]
    moved_on = [(row[2], row[1], *row[3:9], row[-2]) for row in since]
    verdict = verdict_of_epochs(series)
    sections = [_section(pair, k) for k, pair in enumerate(series.pairs)]
    return Page(
        "epochs",
        "Epochs",
        " - ".join((series.names[0], series.names[-1])),
        verdict,
        (
            Section("Series", plot_series(series)),
            *sections,
            tested_section(verdict),
        ),
        viewer=displacements_viewer(series),
        summary={
            "epochs": series.names,
            "changed": series.changed,
            **verdict.as_dict(),
            "adjusted_together": [
                {
                    "camera": camera.name,
                    "epochs": camera.epochs,
                    "parameters": camera.parameters,
                    "T": camera.statistic,
                    "critical": camera.critical,
                }
                for camera in series.cameras
            ],
            "pairs": [_pair(pair) for pair in series.pairs],
        },
        files=(
            Table(_columns(), displacements, "displacements"),
            Table(SERIES, moved_on, "series"),
        ),
    )  # fmt: skip


def _columns(factor: float = 1.0, unit: str = "") -> tuple[Column, ...]:
    """Return the columns of displacements."""
    return (
        Column(None, "first"),
        Column(None, "second"),
        Column("point", "id"),
        *axes("d", unit, factor=factor),
        *axes("sd", unit, factor=factor),
        Column(None, "length"),
        Column("T", "T", format=significant),
        Column("critical", "critical", format=significant),
        Column(),
        Column(None, "stable", flag=YES),
        Column(None, "moved", flag=YES),
        Column("detectable", "detectable", unit, significant, factor),
    )


def _rows(displacements: Displacements) -> list[tuple[Any, ...]]:
    """Return a row for each displacement, in the object unit."""
    states = [
        "moved" if m else "stable" if s else ""
        for m, s in zip(displacements.moved, displacements.stable, strict=True)
    ]
    length = np.linalg.norm(displacements.displacement, axis=1)
    return [
        (*displacements.differences.names, name, *d, *s, *others)
        for name, d, s, *others in zip(
            displacements.differences.points,
            displacements.displacement,
            displacements.sigma,
            length,
            displacements.congruency.statistic,
            displacements.congruency.critical,
            states,
            displacements.stable,
            displacements.moved,
            displacements.detectable,
            strict=True,
        )
    ]


def _steps(displacements: Displacements) -> Table:
    """Return the steps of the search for stable points."""
    names = displacements.differences.points
    return Table(
        STEPS,
        [
            (step.points, step.omega, step.freedom, step.statistic, step.critical,
             None if step.removed is None else names[step.removed])
            for step in displacements.congruency.search.steps
        ],
    )  # fmt: skip


def _section(pair: EpochPair, number: int) -> Section:
    """Return the section of a pair of epochs."""
    displacements = pair.displacements
    d = displacements.differences
    lengths: FloatArray = np.linalg.norm(displacements.displacement, axis=1)
    factor, unit = finer_unit(d.unit, float(max(np.median(displacements.detectable), lengths.max())))
    unit = unit or "object units"
    kept = "translation and rotation" if d.motion == "rigid" else (
        "translation, rotation and scale: not both epochs are scaled"
    )  # fmt: skip
    common: list[tuple[str, object]] = [
        ("common points", len(d.points)),
        ("of these, matched by position", d.by_place),
        (f"only in {d.names[0]}", _names(d.only_first)),
        (f"only in {d.names[1]}", _names(d.only_second)),
        ("not tested (fixed, or without covariance)", _names(d.untested)),
        ("not counted as change", kept),
        ("given to both epochs", _names(d.shared) or "nothing"),
    ]
    shared = Note(
        "An error in these values affects both epochs alike. Their part of the covariance is therefore "
        "removed from the differences."
    )
    test = Note(
        "T is the weighted square sum of the differences over its degrees of freedom, after the "
        "S-transformation to the remaining points; chance alone gives about 1. The level of "
        f"{general(100 * displacements.alpha, 2)} % is shared between this test and those of single points."
    )
    limits = Note(
        "sd: standard deviations. Detectable: the smallest displacement, in its worst direction, that would "
        f"be detected with a probability of {general(100 * POWER, 2)} %."
    )
    points = (Table(_columns(factor, unit), _rows(displacements)), limits)
    picture = None
    if lengths.max() > 0:
        figure = difference_figure(d.xyz, displacements.displacement, displacements.moved, d.unit)
        picture = plot(f"displacements-{number}", PICTURE, figure)
    return Section(
        " to ".join(d.names),
        Table((Column(), Column("value", format=str)), [row for row in common if row[1]]),
        shared if d.shared else None,
        Paragraph(describe_stable(displacements)),
        _steps(displacements),
        test,
        picture,
        FoldedParts(counted(len(d.points), "point"), *points, open=bool(displacements.moved.any())),
        *chain.from_iterable(_block(block, factor, unit) for block in pair.blocks),
        *_mounts(pair, factor, unit),
    )


def _block(block: BlockMotion, factor: float, unit: str) -> tuple[Part, ...]:
    """Return heading, motion and tests of a group of points."""
    rows = []
    for name, value, sigma in zip(block.parameters, block.value, block.sigma, strict=True):
        scale, of = (factor, unit) if name[0] == "t" else (MICRO, "1e-6")
        if name in ("omega", "phi", "kappa"):
            scale, of = DEGREES, "deg"
        rows.append((name, scale * value, scale * sigma, of))
    tests = [
        (part.name, part.statistic, part.critical, "significant" if part.significant else "")
        for part in block.parts
    ]
    remaining = "" if block.fits else "significant"
    tests.append(("remaining displacements", block.statistic, block.critical, remaining))
    numbers = [Column(name, format=significant) for name in ("value", "sigma")]
    limits = [Column(name, format=significant, unknown="") for name in ("T", "critical value")]
    return (
        Heading(block.name),
        Paragraph(f"{describe_block(block)}."),
        Table((Column("parameter"), *numbers, Column("unit")), rows),
        Table((Column(), *limits, Column()), tests),
    )


def _mounts(pair: EpochPair, factor: float, unit: str) -> tuple[Part, ...]:
    """Return how the cameras of rigs moved on their mounts."""
    if not pair.mounts:
        return ()
    scale = np.repeat([factor, DEGREES], 3)
    rows = []
    for mount in pair.mounts:
        moved = "moved" if mount.changed else ""
        rows.append((mount.camera, *scale * mount.difference, mount.statistic, mount.critical, moved))
    angles = [Column(f"d{name}", "", "deg", significant) for name in ("omega", "phi", "kappa")]
    test = [Column(name, format=significant) for name in ("T", "critical value")]
    columns = (Column("camera"), *axes("d", unit), *angles, *test, Column())
    return Heading("Mounts of rigs"), Table(columns, rows)


def describe_stable(displacements: Displacements) -> str:
    """Return in words which points define the datum, and how they were found."""
    if not displacements.agreed:
        return (
            "No stable set is proposed; displacements refer to the datum of all reference points. Name "
            "stable ones with --reference."
        )
    removed = [
        displacements.differences.points[s.removed]
        for s in displacements.congruency.search.steps
        if s.removed is not None
    ]
    count, all_of_them = int(displacements.stable.sum()), int(displacements.reference.sum())
    if count == all_of_them:
        return f"All {counted(count, 'reference point')} agree."
    by = (
        " by removing one point after another"
        if displacements.congruency.robust is None
        or bool((displacements.stable == displacements.congruency.search.stable).all())
        else " by a robust start"
    )
    undecided = list(compress(displacements.differences.points, displacements.undecided))
    left = f" Left out but not shown to have moved: {_names(undecided)}." if undecided else ""
    gone = f" ({_names(removed)} in this order)" if removed and " one " in by else ""
    return (
        f"{count} of {all_of_them} reference points are proposed as stable, found{by}{gone}.{left} Name "
        "others with --reference if you know better."
    )


def describe_block(block: BlockMotion) -> str:
    """Return in words how a group of points moved."""
    parts = [part.name for part in block.parts if part.significant]
    how = " and ".join(parts) if parts else "nothing significant"
    rest = (
        "its points moved as one"
        if block.fits
        else "the remaining displacements are significant: its shape changed"
    )
    return f"{block.name} ({counted(len(block.points), 'point')}, {block.model}): {how}; {rest}"


def _pair(pair: EpochPair) -> dict[str, Any]:
    displacements = pair.displacements
    d = displacements.differences
    return {
        "first": d.names[0],
        "second": d.names[1],
        "length_unit": d.unit,
        "points": len(d.points),
        **values_of(d, "only_first only_second untested"),
        "no_change": d.motion,
        "shared_given_values": d.shared,
        **values_of(d, "held_alike held_apart"),
        **values_of(displacements, "alpha agreed"),
        "stable": list(compress(d.points, displacements.stable)),
        "moved": list(compress(d.points, displacements.moved)),
        "undecided": list(compress(d.points, displacements.undecided)),
        "steps": _steps(displacements).records,
        "groups": [
            {
                **values_of(block, "name points model centre"),
                "parameters": {
                    name: {"value": value, "sigma": sigma}
                    for name, value, sigma in zip(block.parameters, block.value, block.sigma, strict=True)
                },
                "significant": [part.name for part in block.parts if part.significant],
                "moved_as_one": block.fits,
            }
            for block in pair.blocks
        ],
        "mounts": [
            values_of(mount, "camera difference sigma statistic critical changed") for mount in pair.mounts
        ],
    }


def _names(names: Iterable[str]) -> str:
    return listed(names, most=MAX_NAMED)


def plot_series(series: EpochSeries) -> Plot | None:
    """Plot the series of the points that moved farthest; None with two epochs, or if no point moved."""
    if len(series.names) < 3:
        return None
    pairs = [pair.displacements for pair in series.since_first]
    moved: dict[str, float] = {}
    for displacements in pairs:
        for k in np.flatnonzero(displacements.moved):
            name = displacements.differences.points[k]
            moved[name] = max(moved.get(name, 0.0), float(np.linalg.norm(displacements.displacement[k])))
    chosen = sorted(moved, key=lambda name: -moved[name])[:MAX_DRAWN]
    if not chosen:
        return None
    factor, unit = finer_unit(pairs[0].differences.unit, max(moved.values()))
    picture = single_panel_figure(3.8)
    axes = picture.subplots()
    at = np.arange(len(series.names))
    for name in chosen:
        length, sigma = (factor * np.array(values) for values in _along(name, pairs))
        (line,) = axes.plot(at, length, marker="o", ms=3, label=name)
        axes.fill_between(
            at, length - 2 * sigma, length + 2 * sigma, color=line.get_color(), alpha=0.15, lw=0
        )
    axes.axhline(0.0, color="grey", lw=0.8)
    axes.set_xticks(at, series.names)
    axes.set_ylabel(f"displacement [{unit}]")
    axes.legend(fontsize=8, ncols=4, loc="upper left")
    return plot("series", BANDS, picture)


def _along(name: str, pairs: list[Displacements]) -> tuple[list[float], list[float]]:
    """Return displacements of a point since the first epoch along its latest direction, and their sigmas."""
    rows = [
        displacements.differences.points.index(name) if name in displacements.differences.points else -1
        for displacements in pairs
    ]
    last, k = next((epoch, k) for epoch, k in zip(reversed(pairs), reversed(rows), strict=True) if k >= 0)
    direction = last.displacement[k] / max(float(np.linalg.norm(last.displacement[k])), 1e-300)
    length, sigma = [0.0], [0.0]
    for epoch, k in zip(pairs, rows, strict=True):
        if k < 0:
            length.append(np.nan)
            sigma.append(np.nan)
            continue
        Q = epoch.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        length.append(float(epoch.displacement[k] @ direction))
        sigma.append(float(np.sqrt(max(direction @ Q @ direction, 0.0))))
    return length, sigma


def displacements_viewer(series: EpochSeries) -> Viewer | None:
    """Return the viewer of the first epoch with displacements to the last; None without photographs."""
    if not series.first.result.estimate.oriented.any():
        return None
    scene = _scene_of_displacements(series.since_first[-1].displacements, series.first.result)
    return viewer_of(scene, cut_pictures(scene, {}, budget_mb=0.0))


def _scene_of_displacements(displacements: Displacements, first: Solution) -> ViewerScene:
    """Return the scene of an epoch with the displacement of every point and the outcome of its test.

    Standard deviations and ellipsoids are those of the displacements.
    """
    names = first.network.points
    row = {name: j for j, name in enumerate(names)}
    tested = np.array([row[name] for name in displacements.differences.points], dtype=np.int64)
    covariance = np.full((len(names), 3, 3), np.nan)
    covariance[tested] = point_blocks(displacements.covariance, 3)
    scene = scene_of_stored(replace(first, point_covariance=covariance, covariance=None))
    displacement = np.full((len(names), 3), np.nan)
    displacement[tested] = displacements.displacement
    state = [UNTESTED] * len(names)
    for k, j in enumerate(tested.tolist()):
        state[j] = MOVED if displacements.moved[k] else STABLE if displacements.stable[k] else ""
    kept = [row[name] for name in scene.points]
    return replace(
        scene,
        name=" to ".join(displacements.differences.names),
        displacement=displacement[kept],
        state=tuple(state[j] for j in kept),
        notes=(
            *scene.notes,
            f"Displacements from {' to '.join(displacements.differences.names)}; standard deviations and "
            " ellipsoids are those of the displacements.",
        ),
    )
