"""Given values with what they are judged by: the free network, and a kind of given points as judged."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.given_points import GivenPoints, PlacedPoints, excludes_mirror
from sfm.adjustment.quality.given_values import LEVEL, GivenModel, GivenTest, Judgement
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.network import Network
from sfm.remarks.kind import WRONG_SIGMAS
from sfm.remarks.remark import Remark, remark
from sfm.similarity import extended_axes

MIN_IN_SPACE = 4  # points that do not lie in a plane, whose mirror image is another figure


@dataclass(frozen=True)
class Places:
    """Points and projection centres of the free network with their joint covariance."""

    xyz: FloatArray  # (p, 3)
    joint: FloatArray  # (3 p, 3 p)
    redundancy: int
    of_point: dict[str, int]  # place of a point
    of_image: dict[str, int]  # place of a photograph

    def at(self, places: Sequence[int]) -> tuple[IntArray, IntArray]:
        """Return indices of places, and of their coordinates."""
        index = np.asarray(places, dtype=np.int64)
        return index, (3 * index[:, None] + np.arange(3)).ravel()


@dataclass(frozen=True)
class Task:
    """The values to be judged, and the test."""

    network: Network  # with all that was given
    places: Places
    datum: Datum  # that was asked for
    unit: str
    rescale: bool
    plates: tuple[frozenset[str], ...] = ()  # points of each, the first of which is control; none without
    checks_scale: bool = False  # whether given mounts check the scale of the others

    @property
    def of_plate(self) -> bool:
        """Whether control is the grid of a plate."""
        return bool(self.plates)

    def plate_at(self, points: Collection[str]) -> str | None:
        """Return the name of the plate that has all these points, None without one."""
        on = (plate_name(k) for k, plate in enumerate(self.plates) if plate.issuperset(points))
        return next(on, None)

    @property
    def level(self) -> float:
        """Probability with which one kind of right given values is reported as wrong."""
        kinds = (self.network.scale_bars, self.network.control, self.network.exterior)
        return LEVEL / max(sum(len(one) > 0 for one in kinds), 1)


@dataclass(frozen=True)
class Group:
    """Given points of a kind, judged."""

    of: str  # control or centres
    rows: IntArray  # of the kind in the network, (n,)
    names: tuple[str, ...]
    points: GivenPoints
    places: IntArray  # (n,)
    placed: PlacedPoints
    rounded: bool = False  # whether the standard deviations are those of the rounding

    @property
    def found(self) -> Judgement:
        """The group of values found wrong."""
        return self.placed.judgement

    @property
    def out(self) -> tuple[int, ...]:
        """Those that were left out."""
        return self.found.wrong

    @property
    def dependable(self) -> bool:
        """Whether a scale may rest on them."""
        return not (self.placed.mirrored or self.found.doubtful)

    @property
    def checks_handedness(self) -> bool:
        """Whether they fit the network or its mirror image, and not both."""
        return self.placed.mirrored or excludes_mirror(self.points, self.placed)

    @property
    def test(self) -> GivenTest:
        """Test of all of them."""
        return GivenTest(self.of, self.found.statistic, self.found.dof, self.found.probability)

    def taking_part(self, *, rescale: bool) -> tuple[GivenPoints, IntArray]:
        """Return those that take part, with the covariance with which they do, and their places."""
        kept = np.setdiff1d(np.arange(len(self.names)), self.out)
        order = np.array(self.placed.order or range(len(self.names)), dtype=np.int64)
        points = self.points.reordered(tuple(order.tolist())).select(kept)
        if self.found.doubtful and rescale and self.points.stated.any():
            points = replace(points, stated=self.placed.model.factor()[0] ** 2 * points.stated)
        return points, self.places[kept]

    def as_judged(self, covariance: FloatArray, *, rescale: bool) -> tuple[IntArray, BoolArray, FloatArray]:
        """Return whose coordinates each given point has, which take part, and their covariance, (n, 3, 3)."""
        order, keep = np.arange(len(covariance)), np.ones(len(covariance), dtype=bool)
        if self.placed.order:
            order[self.rows] = self.rows[list(self.placed.order)]
        keep[self.rows[list(self.out)]] = False
        changed = covariance[order]
        changed[self.rows] = self._confirmed(changed[self.rows], rescale)
        return order, keep, changed

    def _confirmed(self, covariance: FloatArray, rescale: bool) -> FloatArray:
        """Return the covariance of the points with which they fit."""
        known = np.isfinite(covariance)
        if self.rounded:
            return np.where(known, self.points.stated, covariance)
        fixed = not np.where(known, covariance, 0.0).any()
        changes = bool(self.found.doubtful) or self.found.factor != 1.0
        if fixed or not rescale or not changes or self.placed.model.estimated:
            return covariance
        factor = self.placed.model.factor()[0] if self.found.doubtful else self.found.factor
        return np.where(known, factor**2 * covariance, covariance)


def plate_name(k: int) -> str:
    """Return the name of a plate by its place in the survey file, that of the targets being the first."""
    return f"plate {k + 1}"


def contradiction_of(task: Task, groups: Sequence[Group]) -> Remark | None:
    """Return the remark that control and projection centres place the network differently; None if not.

    Each by itself fits the network with a similarity. Both have the errors of one network, and with their
    joint covariance one similarity is tested against two: what seven parameters more explain.
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
    """Return whether the mirror image of points is another figure."""
    return len(xyz) >= MIN_IN_SPACE and len(extended_axes(xyz)[0]) == 3


def remarks_on_unchecked(
    of: str, names: Sequence[str], model: GivenModel, without: tuple[int, ...] = ()
) -> Iterator[Remark]:
    """Yield remarks on given values of which nothing, or hardly anything, would find an error."""
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
