"""Two or more epochs of one object: each against the first, and each against the one before.

Source: Niemeier (2008), Ausgleichungsrechnung, sec. 12; Caspary (2000), Concepts of network and deformation
analysis, sec. 7.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import BoolArray
from sfm.epochs.blocks import MIN_POINTS, MODELS, BlockMotion, block_motion
from sfm.epochs.differences import Differences, epoch_differences
from sfm.epochs.displacements import ALPHA, Displacements, find_displacements
from sfm.epochs.epoch import Epoch
from sfm.epochs.mounts import MountChange, mount_changes
from sfm.epochs.together import SharedCamera, adjust_together
from sfm.errors import GeometryError
from sfm.geometry.measured import matches

MOVED = "points that moved"


@dataclass(frozen=True)
class EpochPair:
    """Displacements between two epochs, by points and by groups."""

    displacements: Displacements
    groups: tuple[BlockMotion, ...]  # those asked for
    together: BlockMotion | None  # of all points that moved, as one rigid block; None where they are too few
    mounts: tuple[MountChange, ...] = ()  # of the cameras of rigs that both have

    @property
    def blocks(self) -> tuple[BlockMotion, ...]:
        """The groups asked for, and the points that moved."""
        return self.groups if self.together is None else (*self.groups, self.together)


@dataclass(frozen=True)
class EpochSeries:
    """Epochs of one object in their order."""

    names: tuple[str, ...]
    first: Epoch  # of which displacements are, in its frame
    since_first: tuple[EpochPair, ...]  # of every epoch from the second on, against the first
    since_previous: tuple[EpochPair, ...]  # against the one before
    cameras: tuple[SharedCamera, ...] = ()  # with one interior orientation in all epochs adjusted together

    @property
    def pairs(self) -> tuple[EpochPair, ...]:
        """Every pair of epochs once: those with the first, then those with the one before."""
        return (*self.since_first, *self.since_previous[1:])

    @property
    def changed(self) -> bool:
        """Whether anything moved between any two of them."""
        return any(pair.displacements.changed for pair in self.pairs)


@checked_arguments()
def analyse_epochs(
    epochs: Sequence[Epoch],
    *,
    reference: Sequence[str] = (),
    groups: Mapping[str, Sequence[str]] | None = None,
    model: str = "rigid",
    alpha: float = ALPHA,
    together: bool = False,
) -> EpochSeries:
    """Test what moved between epochs.

    Args:
        epochs: two or more, in their order.
        reference: names or patterns (`R*`) of the points that may carry the datum; all common ones if empty.
        groups: names or patterns of the points of each group whose motion is asked for.
        model: of the motion of groups: rigid, similarity or affine.
        alpha: level of the tests of every pair of epochs.
        together: whether all epochs are adjusted as one, with one interior orientation of each camera that
            took photographs of several, see `adjust_together`.

    Raises:
        GeometryError: fewer than two epochs, two of one name, a point of reference that an epoch lacks, too
            few points, or what `epoch_differences` and `block_motion` refuse.

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
        found = epoch_differences(first, second)
        chosen = _reference(found, reference, (first, second)) if reference else None
        moved = find_displacements(found, reference=chosen, alpha=alpha)
        return EpochPair(
            moved,
            tuple(
                block_motion(moved, _group(found, name, patterns), name=name, model=model)
                for name, patterns in (groups or {}).items()
            ),
            _together(moved),
            mount_changes(first.result, second.result, alpha=alpha, redundancy=found.redundancy),
        )

    first = [analysed(epochs[0], epoch) for epoch in epochs[1:]]
    previous = [first[0]]
    previous += [analysed(one, other) for one, other in pairwise(epochs[1:])]
    return EpochSeries(names, epochs[0], tuple(first), tuple(previous), cameras)


def _reference(found: Differences, patterns: Sequence[str], epochs: tuple[Epoch, Epoch]) -> BoolArray:
    """Return the points of reference among the common ones; one that an epoch lacks is an error."""
    chosen = np.zeros(len(found.points), dtype=bool)
    for pattern in patterns:
        hits = _matching(found.points, pattern)
        chosen |= hits
        if not hits.any():
            if _matching(found.untested, pattern).any():
                raise GeometryError(
                    f"epochs: point of reference {pattern} cannot be tested in {epochs[0].name} and "
                    f"{epochs[1].name}: one has it as known, or did not keep its covariance with the others"
                )
            lacking = [e.name for e in epochs if not _matching(e.result.network.points, pattern).any()]
            raise GeometryError(
                f"epochs: point of reference {pattern} is missing in {' and in '.join(lacking)}"
                if lacking
                else f"epochs: no point {pattern} is in both {epochs[0].name} and {epochs[1].name}"
            )
    return chosen


def _group(found: Differences, name: str, patterns: Sequence[str]) -> BoolArray:
    chosen = np.zeros(len(found.points), dtype=bool)
    for pattern in patterns:
        hits = _matching(found.points, pattern)
        if not hits.any():
            raise GeometryError(
                f"group {name}: no point that {found.names[0]} and {found.names[1]} share is called "
                f"'{pattern}'"
            )
        chosen |= hits
    return chosen


def _matching(names: tuple[str, ...], pattern: str) -> BoolArray:
    return np.array([matches(name, pattern) for name in names], dtype=bool)


def _together(found: Displacements) -> BlockMotion | None:
    """Return the motion of all points that moved as one block; None where that shows nothing."""
    if found.moved.sum() <= MIN_POINTS["rigid"]:
        return None
    try:
        return block_motion(found, found.moved, name=MOVED)
    except GeometryError:  # they lie on a line: their rotation about it is not determined
        return None
