"""Groups of given points, and what they are judged with."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.distributions import LEVEL
from sfm.judgement.given.points import (
    GivenPoints,
    PlacedPoints,
    excludes_mirror,
)
from sfm.judgement.given.values import (
    GivenModel,
    Judgement,
)
from sfm.network import Network
from sfm.remarks.kind import WRONG_SIGMAS
from sfm.remarks.remark import Remark, remark
from sfm.result import GivenTest
from sfm.similarity import extended_axes

MIN_IN_SPACE = 4  # points off a plane, whose mirror image is another figure


@dataclass(frozen=True)
class Places:
    """Points and projection centres of the free network with their joint covariance."""

    xyz: FloatArray  # (p, 3)
    joint: FloatArray  # (3 p, 3 p)
    redundancy: int
    of_point: dict[str, int]  # row of a point by name
    of_image: dict[str, int]  # row of a photograph by name

    def at(self, places: Sequence[int]) -> tuple[IntArray, IntArray]:
        """Return the indices of places as an array, and the indices of their coordinates."""
        index = np.asarray(places, dtype=np.int64)
        return index, (3 * index[:, None] + np.arange(3)).ravel()


@dataclass(frozen=True)
class Task:
    """The values to judge, and the settings of the tests."""

    network: Network  # has all given values
    places: Places
    datum: Datum  # of the survey
    unit: str
    rescale: bool
    plates: tuple[frozenset[str], ...] = ()  # points of each plate; the first plate is control
    checks_scale: bool = False  # whether mounts or tables check the scale of the others

    @property
    def of_plate(self) -> bool:
        """Whether control is the grid of a plate."""
        return bool(self.plates)

    def plate_at(self, points: Collection[str]) -> str | None:
        """Return the name of the plate that has all these points, or None."""
        on = (plate_name(k) for k, plate in enumerate(self.plates) if plate.issuperset(points))
        return next(on, None)

    @property
    def level(self) -> float:
        """Probability of reporting one kind of correct given values as wrong."""
        kinds = (self.network.scale_bars, self.network.control, self.network.exterior)
        return LEVEL / max(sum(len(one) > 0 for one in kinds), 1)


@dataclass(frozen=True)
class Group:
    """Judged given points of one kind."""

    of: str  # control or centres
    rows: IntArray  # rows of the points in their table of the network, (n,)
    names: tuple[str, ...]
    points: GivenPoints
    places: IntArray  # rows of the points in `Places`, (n,)
    placed: PlacedPoints
    scatter: float = 0.0  # standard deviation of fixed coordinates from their scatter, object unit; 0: exact

    @property
    def found(self) -> Judgement:
        """The judgement of the group."""
        return self.placed.judgement

    @property
    def out(self) -> tuple[int, ...]:
        """Points that were left out."""
        return self.found.wrong

    @property
    def dependable(self) -> bool:
        """Whether the points may give a scale."""
        return not (self.placed.mirrored or self.found.doubtful)

    @property
    def checks_handedness(self) -> bool:
        """Whether the points fit either the network or its mirror image, but not both."""
        return self.placed.mirrored or excludes_mirror(self.points, self.placed)

    @property
    def test(self) -> GivenTest:
        """Test of all points."""
        return GivenTest(self.of, self.found.statistic, self.found.dof, self.found.probability)

    def taking_part(self, *, rescale: bool) -> tuple[GivenPoints, IntArray]:
        """Return the points that take part, with their covariance in the adjustment, and their places."""
        kept = np.setdiff1d(np.arange(len(self.names)), self.out)
        order = np.array(self.placed.order or range(len(self.names)), dtype=np.int64)
        points = self.points.reordered(tuple(order.tolist())).select(kept)
        if self.found.doubtful and rescale and self.points.stated.any():
            points = replace(points, stated=self.placed.model.factor()[0] ** 2 * points.stated)
        return points, self.places[kept]

    def as_judged(self, covariance: FloatArray, *, rescale: bool) -> tuple[IntArray, BoolArray, FloatArray]:
        """Return the order of the given points, which points take part, and their covariance, (n, 3, 3).

        The order corrects names that were exchanged.
        """
        order, keep = np.arange(len(covariance)), np.ones(len(covariance), dtype=bool)
        if self.placed.order:
            order[self.rows] = self.rows[list(self.placed.order)]
        keep[self.rows[list(self.out)]] = False
        changed = covariance[order]
        changed[self.rows] = self._confirmed(changed[self.rows], rescale)
        return order, keep, changed

    def _confirmed(self, covariance: FloatArray, rescale: bool) -> FloatArray:
        """Return the covariance with which the points fit."""
        known = np.isfinite(covariance)
        if self.scatter and rescale:
            return np.where(known, self.points.stated, covariance)
        fixed = not np.where(known, covariance, 0.0).any()
        changes = bool(self.found.doubtful) or self.found.factor != 1.0
        if fixed or not rescale or not changes or self.placed.model.estimated:
            return covariance
        factor = self.placed.model.factor()[0] if self.found.doubtful else self.found.factor
        return np.where(known, factor**2 * covariance, covariance)


def plate_name(k: int) -> str:
    """Return the name of plate k in the survey file; the plate of the targets is the first, k = 0."""
    return f"plate {k + 1}"


def contradiction_of(task: Task, groups: Sequence[Group]) -> Remark | None:
    """Return the remark that control and projection centres place the network differently, or None.

    Each by itself fits the network with a similarity. Both have the errors of the same network. With their
    joint covariance, one similarity is tested against two, which have seven more parameters.

    Args:
        task: settings of the test.
        groups: control and projection centres.
    """
    if len(groups) < 2:
        return None
    parts = [one.taking_part(rescale=task.rescale) for one in groups]
    index, coordinates = task.places.at(np.concatenate([at for _, at in parts]).tolist())
    points = GivenPoints(
        np.concatenate([one.given for one, _ in parts]),
        np.concatenate([one.stated for one, _ in parts]),
        task.places.xyz[index],
        task.places.joint[np.ix_(coordinates, coordinates)],
        task.places.redundancy,
    )
    model = points.model(groups[0].placed.placing, estimated=False)
    second = model.item >= len(parts[0][0].given)
    columns = second[:, None] * model.A
    columns = columns[:, columns.any(axis=0)]
    apart = model.kept().bias(columns)
    if apart.probability >= task.level:
        return None
    moved = np.zeros(points.given.shape)
    moved[points.known] = columns @ apart.parameters
    return remark(
        "datum_contradicted",
        given=[one.of for one in groups],
        distance=(float(np.linalg.norm(moved, axis=1).max()), task.unit),
        chi2=apart.statistic,
        dof=apart.dof,
    )


def are_in_space(xyz: FloatArray) -> bool:
    """Return whether the mirror image of points, (n, 3), is another figure."""
    return len(xyz) >= MIN_IN_SPACE and len(extended_axes(xyz)[0]) == 3


def remarks_on_unchecked(
    of: str, names: Sequence[str], model: GivenModel, without: tuple[int, ...] = ()
) -> Iterator[Remark]:
    """Yield remarks on given values whose errors nothing, or hardly anything, would reveal.

    Args:
        of: kind of the given values.
        names: names of the given values.
        model: differences of the given values.
        without: indices of values that are left out.
    """
    reach, rank = model.external(without), model.kept(without).decreases()[1]
    for kind, some in (
        ("given_unchecked", np.isinf(reach) & (rank == 0)),
        ("given_partly_checked", np.isinf(reach) & (rank > 0)),
    ):
        if some.any():
            yield remark(kind, given=[names[k] for k in np.flatnonzero(some).tolist()], of=of)
    weak = np.flatnonzero((reach > WRONG_SIGMAS) & np.isfinite(reach)).tolist()
    if weak:
        largest = float(reach[weak].max())
        yield remark("given_weakly_checked", given=[names[k] for k in weak], of=of, sigmas=largest)
