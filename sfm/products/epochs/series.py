"""Series of epochs of one object: each epoch against the first and the previous one, and blocks.

The motion of a group of points shows whether a block tilted or changed its shape. The displacements of a
group are d = t + omega x (X - c) + E (X - c), with a translation t of its centre c, small rotations omega,
and the symmetric strain E or a part of it, depending on the model. They are fitted by least squares with the
full covariance of the displacements, in the datum of the stable points outside the group. The residuals show
whether the group moved as the model assumes.

Source: Niemeier (2008), Ausgleichungsrechnung, sec. 12; Caspary (2000), Concepts of network and deformation
analysis, secs. 7 and 9; Chen (1983), Analysis of deformation surveys; Welsch, Heunecke,
Kuhlmann (2000), Auswertung geodaetischer Ueberwachungsmessungen, sec. 6.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sfm.comparison.comparison_remarks import remarks_of_cause
from sfm.comparison.stable_points import critical_value, in_datum
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.display import counted
from sfm.model.distributions import FALSE_ALARM
from sfm.model.errors import GeometryError
from sfm.model.remarks.remark import Remark, remark
from sfm.model.remarks.verdict import Level, Verdict, judge
from sfm.model.similarity import similarity_motions
from sfm.products.epochs.differences import Differences, Epoch, MountChange, epoch_differences, mount_changes
from sfm.products.epochs.displacements import Displacements, find_displacements
from sfm.products.epochs.together import SharedCamera, adjust_together
from sfm.products.geometry.measured import matches

PARTS = (
    ("translation", ("tX", "tY", "tZ")),
    ("rotation", ("omega", "phi", "kappa")),
    ("scale", ("scale",)),
    ("shear", ("eXX-eYY", "eXX-eZZ", "eXY", "eXZ", "eYZ")),
)
MODELS = {"rigid": 2, "similarity": 3, "affine": 4}  # number of PARTS of each model
MIN_POINTS = {"rigid": 3, "similarity": 3, "affine": 4}
RANK = 1e-9  # of the largest singular value; below it a group does not determine a model


@dataclass(frozen=True)
class Part:
    """A translation, rotation, scale or shear, and its test."""

    name: str
    statistic: float  # over its degrees of freedom
    critical: float

    @property
    def significant(self) -> bool:
        """Whether it is larger than chance explains."""
        return self.statistic > self.critical


@dataclass(frozen=True)
class BlockMotion:
    """Motion of a group of points."""

    name: str
    points: tuple[str, ...]
    model: str  # rigid | similarity | affine
    centre: FloatArray  # reference of the translation, object unit, (3,)
    parameters: tuple[str, ...]  # names of the parameters, (p,)
    value: FloatArray  # object unit, rad and ratios, (p,)
    sigma: FloatArray  # (p,)
    parts: tuple[Part, ...]
    statistic: float  # of the residuals, over their degrees of freedom; NaN without any
    critical: float

    @property
    def fits(self) -> bool:
        """Whether the points moved as the model assumes."""
        return not self.statistic > self.critical

    @property
    def moved(self) -> bool:
        """Whether the group as a whole moved."""
        return any(part.significant for part in self.parts)


HEADLINES: Mapping[Level, str] = {
    "good": "No displacement is significant.",
    "fair": "Points moved, and the others agree.",
    "bad": "The epochs do not agree as a whole.",
}
MOVED = "points that moved"


@dataclass(frozen=True)
class EpochPair:
    """Displacements between two epochs, by points and by groups."""

    displacements: Displacements
    groups: tuple[BlockMotion, ...]  # the requested groups
    together: BlockMotion | None  # all points that moved as one rigid block; None if they are too few
    mounts: tuple[MountChange, ...] = ()  # of the cameras on rigs of both epochs

    @property
    def blocks(self) -> tuple[BlockMotion, ...]:
        """The requested groups, and the block of all points that moved."""
        return self.groups if self.together is None else (*self.groups, self.together)


@dataclass(frozen=True)
class EpochSeries:
    """Epochs of one object in their order."""

    names: tuple[str, ...]
    first: Epoch  # reference of the displacements, which are in its frame
    since_first: tuple[EpochPair, ...]  # every epoch from the second on, against the first
    since_previous: tuple[EpochPair, ...]  # every epoch from the second on, against the previous one
    cameras: tuple[SharedCamera, ...] = ()  # with one interior orientation in all epochs adjusted together

    @property
    def pairs(self) -> tuple[EpochPair, ...]:
        """Every pair of epochs once: those with the first epoch, then those with the previous one."""
        return (*self.since_first, *self.since_previous[1:])

    @property
    def changed(self) -> bool:
        """Whether anything moved between any two epochs."""
        return any(pair.displacements.changed for pair in self.pairs)


@checked_arguments()
def analyse_epochs(
    epochs: Sequence[Epoch],
    *,
    reference: Sequence[str] = (),
    groups: Mapping[str, Sequence[str]] | None = None,
    model: str = "rigid",
    alpha: float = FALSE_ALARM,
    together: bool = False,
) -> EpochSeries:
    """Test which points moved between epochs.

    Args:
        epochs: two or more epochs, in their order.
        reference: names or patterns (`R*`) of the points that may carry the datum; all common points if
            empty.
        groups: names or patterns of the points of each group whose motion is requested.
        model: model of the motion of groups: rigid, similarity or affine.
        alpha: level of the tests of every pair of epochs.
        together: whether all epochs are adjusted as one, with one interior orientation of each camera that
            took photographs in several epochs, see `adjust_together`.

    Raises:
        GeometryError: fewer than two epochs, two epochs of one name, a reference point missing in an epoch,
            too few points, or as in `epoch_differences` and `block_motion`.

    Source: Niemeier (2008), Ausgleichungsrechnung, sec. 12.
    """
    if len(epochs) < 2:
        raise GeometryError(f"epochs: {len(epochs)} given, expected 2 or more")
    if model not in MODELS:
        raise GeometryError(f"epochs: model '{model}', expected one of {', '.join(MODELS)}")
    names = tuple(epoch.name for epoch in epochs)
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice is not None:
        raise GeometryError(f"epochs: two of them are called '{twice}'; give each a different name")

    cameras: tuple[SharedCamera, ...] = ()
    if together:
        epochs, cameras = adjust_together(epochs)

    def analysed(first: Epoch, second: Epoch) -> EpochPair:
        differences = epoch_differences(first, second)
        chosen = _reference(differences, reference, (first, second)) if reference else None
        moved = find_displacements(differences, reference=chosen, alpha=alpha)
        common = None  # the motion of all points that moved, as one block
        if moved.moved.sum() > MIN_POINTS["rigid"]:
            with suppress(GeometryError):  # points on a line do not determine their rotation about it
                common = block_motion(moved, moved.moved, name=MOVED)
        return EpochPair(
            moved,
            tuple(
                block_motion(moved, _group(differences, name, patterns), name=name, model=model)
                for name, patterns in (groups or {}).items()
            ),
            common,
            mount_changes(first.result, second.result, alpha=alpha, redundancy=differences.redundancy),
        )

    first = [analysed(epochs[0], epoch) for epoch in epochs[1:]]
    previous = [first[0]]
    previous += [analysed(earlier, later) for earlier, later in pairwise(epochs[1:])]
    return EpochSeries(names, epochs[0], tuple(first), tuple(previous), cameras)


def _reference(differences: Differences, patterns: Sequence[str], epochs: tuple[Epoch, Epoch]) -> BoolArray:
    """Return the reference points among the common points; a point missing in an epoch is an error."""
    chosen = np.zeros(len(differences.points), dtype=bool)
    for pattern in patterns:
        hits = _matching(differences.points, pattern)
        chosen |= hits
        if not hits.any():
            if _matching(differences.untested, pattern).any():
                raise GeometryError(
                    f"epochs: point of reference {pattern} cannot be tested in {epochs[0].name} and "
                    f"{epochs[1].name}: one of them holds it as known, or did not keep its covariance "
                    "with the others"
                )
            lacking = [e.name for e in epochs if not _matching(e.result.network.points, pattern).any()]
            raise GeometryError(
                f"epochs: point of reference {pattern} is missing in {' and in '.join(lacking)}"
                if lacking
                else f"epochs: no point {pattern} is in both {epochs[0].name} and {epochs[1].name}"
            )
    return chosen


def _group(differences: Differences, name: str, patterns: Sequence[str]) -> BoolArray:
    chosen = np.zeros(len(differences.points), dtype=bool)
    first, second = differences.names
    for pattern in patterns:
        hits = _matching(differences.points, pattern)
        if not hits.any():
            raise GeometryError(
                f"group {name}: no point that {first} and {second} share is called '{pattern}'"
            )
        chosen |= hits
    return chosen


def _matching(names: tuple[str, ...], pattern: str) -> BoolArray:
    return np.array([matches(name, pattern) for name in names], dtype=bool)


def verdict_of_epochs(series: EpochSeries) -> Verdict:
    """Return the verdict on epochs with the remarks on every pair; pairs with the first epoch come first."""
    remarks = [said for pair in series.pairs for said in remarks_of_pair(pair.displacements)]
    remarks += [
        remark(
            "mount_changed",
            camera=mount.camera,
            first=pair.displacements.differences.names[0],
            second=pair.displacements.differences.names[1],
            statistic=mount.statistic,
            critical=mount.critical,
        )
        for pair in series.pairs
        for mount in pair.mounts
        if mount.changed
    ]
    cameras = [
        remark(
            "one_camera",
            camera=camera.name,
            epochs=camera.epochs,
            statistic=camera.statistic,
            critical=camera.critical,
        )
        for camera in series.cameras
    ]
    return judge((*remarks, *cameras), HEADLINES)


def remarks_of_pair(displacements: Displacements) -> Iterator[Remark]:
    """Yield the remarks on two epochs."""
    d = displacements.differences
    first, second = d.names
    length = np.linalg.norm(displacements.displacement, axis=1)
    unit = d.unit or "object units"
    if displacements.cause is not None:
        yield from remarks_of_cause(
            displacements.cause, first, second, len(d.points), (float(length.max()), unit)
        )
    elif not displacements.agreed:
        yield remark("no_majority_agrees", first=first, second=second)
    elif displacements.moved.any():
        names = [name for name, moved in zip(d.points, displacements.moved, strict=True) if moved]
        yield remark(
            "displaced",
            first=first,
            second=second,
            points=names,
            displaced=len(names),
            tested=len(d.points),
            distance=(float(length[displacements.moved].max()), unit),
        )
    if d.held_alike:
        yield remark("cameras_held", how="alike", cameras=d.held_alike, first=first, second=second)
    if d.held_apart:
        yield remark("cameras_held", how="apart", cameras=d.held_apart, first=first, second=second)


@checked_arguments()
def block_motion(
    displacements: Displacements,
    group: BoolArray,
    *,
    name: str,
    model: str = "rigid",
    alpha: float | None = None,
) -> BlockMotion:
    """Fit the motion of a group of points to their displacements.

    Args:
        displacements: displacements of two epochs.
        group: points of the group, (n,).
        name: name of the group.
        model: rigid (translation and rotation), similarity (also scale) or affine (also shear).
        alpha: level of each test; that of the displacements if not given.

    Raises:
        GeometryError: too few points, points on a line or in a plane that do not determine the model, or too
            few stable points outside the group.
    """
    if model not in MODELS:
        raise GeometryError(f"group {name}: model '{model}', expected one of {', '.join(MODELS)}")
    chosen = np.flatnonzero(group)
    if len(chosen) < MIN_POINTS[model]:
        raise GeometryError(
            f"group {name}: {counted(len(chosen), 'point')}, a {model} motion needs "
            f"{MIN_POINTS[model]} or more"
        )
    differences = displacements.differences
    d, Q, G = differences.difference, differences.covariance, differences.motions
    outside = displacements.stable & ~group
    if np.linalg.matrix_rank(G[np.repeat(outside, 3)], tol=RANK * np.linalg.norm(G, 2)) < G.shape[1]:
        raise GeometryError(
            f"group {name}: {counted(int(outside.sum()), 'stable point')} outside it, too few or "
            "on a line to show a motion of the group"
        )
    d, Q = in_datum(d, Q, G, outside.astype(float))
    alpha = displacements.alpha if alpha is None else alpha
    parts = PARTS[: MODELS[model]]
    x = differences.xyz[chosen]
    centre = x.mean(axis=0)
    A = _motion_columns(x, centre, MODELS[model])
    spread = np.linalg.svd(A / np.maximum(np.linalg.norm(A, axis=0), 1e-300), compute_uv=False)
    if spread[-1] < RANK * spread[0]:
        raise GeometryError(
            f"group {name}: its points lie on a line or in a plane, which does not determine a {model} motion"
        )
    rows = (3 * chosen[:, None] + np.arange(3)).ravel()
    d = d[chosen].ravel()
    factor = cho_factor(Q[np.ix_(rows, rows)], lower=True)
    PA = cho_solve(factor, A)
    cofactor = np.linalg.inv(A.T @ PA)
    value = cofactor @ (PA.T @ d)
    v = d - A @ value
    freedom = len(d) - len(value)
    redundancy = differences.redundancy
    names = tuple(name for _, group_of in parts for name in group_of)
    tests, at = [], 0
    for part, members in parts:
        block = slice(at, at + len(members))
        statistic = float(value[block] @ np.linalg.solve(cofactor[block, block], value[block])) / len(members)
        tests.append(Part(part, statistic, critical_value(alpha, len(members), redundancy)))
        at += len(members)
    return BlockMotion(
        name=name,
        points=tuple(differences.points[j] for j in chosen),
        model=model,
        centre=centre,
        parameters=names,
        value=value,
        sigma=np.sqrt(np.diagonal(cofactor)),
        parts=tuple(tests),
        statistic=float(v @ cho_solve(factor, v)) / freedom if freedom else float("nan"),
        critical=critical_value(alpha, freedom, redundancy) if freedom else float("nan"),
    )


def _motion_columns(xyz: FloatArray, centre: FloatArray, parts: int) -> FloatArray:
    """Return the derivatives of the coordinates of k points by the parameters, (3 k, p)."""
    motion = similarity_motions(xyz, centre=centre)
    columns = [motion[:, :, : (0, 3, 6, 7, 7)[parts]]]
    if parts == MODELS["affine"]:
        x, y, z = (xyz - centre).T
        o = np.zeros_like(x)
        shear = [(x, -y, o), (x, o, -z), (y, x, o), (z, o, x), (o, z, y)]
        columns.append(np.stack([np.stack(components, axis=1) for components in shear], axis=2))
    A = np.concatenate(columns, axis=2)
    return A.reshape(-1, A.shape[2])
