"""Groups of given points, and what they are judged with."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.judgement.given.free_network import FreeNetwork, Reference
from sfm.judgement.given.points import GivenPoints, PlacedPoints, excludes_mirror
from sfm.judgement.given.values import GivenModel, Judgement
from sfm.judgement.survey_result import GivenTest
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.distributions import FALSE_ALARM, Levels
from sfm.model.network import Network
from sfm.model.observations.kind import CoordinateKind, Kind
from sfm.model.remarks.remark import Remark, remark
from sfm.model.remarks.row import WRONG_SIGMAS
from sfm.model.similarity import extended_axes

K = TypeVar("K", bound=Kind)
C = TypeVar("C", bound=CoordinateKind)
MIN_IN_SPACE = 4  # points off a plane, whose mirror image is another figure


@dataclass(frozen=True)
class GivenSettings:
    """How given values are judged, and what they are used for."""

    datum: Datum  # of the survey
    unit: str  # object unit
    rescale: bool = True  # whether standard deviations that are too small may be replaced
    # names of the points of each plate, if control is the first plate: its fixed coordinates are not rounded
    # to decimals, its scale is that of the survey, and bars between points of another plate are its size
    plates: tuple[frozenset[str], ...] = ()
    checks_scale: bool = False  # whether mounts or tables check the scale of the others
    false_alarm: float = FALSE_ALARM  # probability that right values are called wrong

    @property
    def level(self) -> float:
        """Probability of reporting one kind of right values as wrong."""
        return Levels(self.false_alarm).question


@dataclass(frozen=True)
class Task:
    """The values to judge, and what they are compared with."""

    network: Network  # has all given values
    free: FreeNetwork
    reference: Reference  # unknowns of control, centres and bars
    of_point: IntArray  # index of each point of the network in the free network, -1 if it is not there, (n,)
    of_image: IntArray  # the same of each photograph, (m,)
    settings: GivenSettings

    def in_free(self, kind: K) -> tuple[IntArray, K]:
        """Return the parts of observations that are in the free network, and these observations there."""
        return in_free(kind, self.of_point, self.of_image)

    @property
    def of_plate(self) -> bool:
        """Whether control is the grid of a plate."""
        return bool(self.settings.plates)

    @property
    def in_control(self) -> bool:
        """Whether the datum is control."""
        return self.settings.datum.kind == "control"

    def plate_at(self, points: Collection[str]) -> str | None:
        """Return the name of the plate that has all these points, or None."""
        on = (plate_name(k) for k, plate in enumerate(self.settings.plates) if plate.issuperset(points))
        return next(on, None)

    @property
    def level(self) -> float:
        """Probability of reporting one kind of correct given values as wrong."""
        kinds = (self.network.scale_bars, self.network.control, self.network.exterior)
        return self.settings.level / max(sum(len(kind) > 0 for kind in kinds), 1)


def in_free(kind: K, of_point: IntArray, of_image: IntArray) -> tuple[IntArray, K]:
    """Return the parts of observations that are in the free network, and these observations there.

    Args:
        kind: observations of a network.
        of_point: index of each point of the network in the free network, -1 if it is not there, (n,).
        of_image: the same of each photograph, (m,).
    """
    on = kind.parts_within(of_point >= 0, of_image >= 0)
    return np.flatnonzero(on), kind.select_parts(on).renumbered(of_point, of_image)


@dataclass(frozen=True)
class Group:
    """Judged given points of one kind."""

    of: str  # control or centres
    rows: IntArray  # rows of the points in their table of the network, (n,)
    names: tuple[str, ...]
    placed: PlacedPoints
    scatter: float = 0.0  # standard deviation of fixed coordinates from their scatter, object unit; 0: exact

    @property
    def judgement(self) -> Judgement:
        """The judgement of the group."""
        return self.placed.judgement

    @property
    def dependable(self) -> bool:
        """Whether the points may give a scale."""
        return not (self.placed.mirrored or self.judgement.doubtful)

    @property
    def checks_handedness(self) -> bool:
        """Whether the points fit either the network or its mirror image, but not both."""
        return self.placed.mirrored or excludes_mirror(self.placed)

    @property
    def test(self) -> GivenTest:
        """Test of all points."""
        judged, model = self.judgement, self.placed.model
        if model.estimated:
            return GivenTest(self.of, None, judged.dof, judged.probability, model.items - 1)
        return GivenTest(self.of, judged.statistic, judged.dof, judged.probability)

    def taking_part(self, *, rescale: bool) -> GivenPoints:
        """Return the points that take part, with their covariance in the adjustment."""
        kept = np.setdiff1d(np.arange(len(self.names)), self.judgement.wrong)
        points = self.placed.points.select(kept)
        if self.judgement.doubtful and rescale and points.stated.any():
            points = points.with_stated(self.placed.model.factor()[0] ** 2 * points.stated)
        return points

    def as_judged(self, given: C, *, rescale: bool, used: bool) -> C:
        """Return the given points of the kind that fit, with their covariance; none if they are not used.

        The values of names that were exchanged are those of the right names.
        """
        keep = np.full(len(given), used)
        keep[self.rows[list(self.judgement.wrong)]] = False
        if self.placed.order:
            order = np.arange(len(given))
            order[self.rows] = self.rows[list(self.placed.order)]
            given = given.reordered(order)
        covariance = given.coordinate_covariance.copy()
        stated = covariance[self.rows]
        known = np.isfinite(stated)
        doubtful, factor = bool(self.judgement.doubtful), self.judgement.factor
        too_small = (doubtful or factor != 1.0) and np.where(known, stated, 0.0).any()
        if self.scatter and rescale:
            covariance[self.rows] = np.where(known, self.placed.points.stated, stated)
        elif rescale and too_small and not self.placed.model.estimated:
            factor = self.placed.model.factor()[0] if doubtful else factor
            covariance[self.rows] = np.where(known, factor**2 * stated, stated)
        return given.with_coordinate_covariance(covariance).select(keep)


def plate_name(k: int) -> str:
    """Return the name of plate k in the survey file; the plate of the targets is the first, k = 0."""
    return f"plate {k + 1}"


def contradiction_of(task: Task, groups: Sequence[Group]) -> Remark | None:
    """Return the remark that control and projection centres place the network differently, or None.

    Each by itself fits the network with a similarity. Both have the errors of the same network. With their
    joint covariance, one similarity is tested against two, which have seven more parameters.
    """
    if len(groups) < 2:
        return None
    parts = [group.taking_part(rescale=task.settings.rescale) for group in groups]
    model, kind = task.reference.differences([points.kind for points in parts], groups[0].placed.placing)
    second = (kind == 1)[model.item]
    columns = second[:, None] * model.A
    columns = columns[:, columns.any(axis=0)]
    apart = model.kept().bias(columns)
    if apart.probability >= task.level:
        return None
    known = [np.isfinite(points.given) for points in parts]
    moved = np.zeros((sum(map(len, known)), 3))
    moved[np.concatenate(known)] = columns @ apart.parameters
    return remark(
        "datum_contradicted",
        given=[group.of for group in groups],
        distance=(float(np.linalg.norm(moved, axis=1).max()), task.settings.unit),
        chi2=apart.statistic,
        dof=apart.dof,
    )


def are_in_space(xyz: FloatArray) -> bool:
    """Return whether the mirror image of points, (n, 3), is another figure."""
    return len(xyz) >= MIN_IN_SPACE and len(extended_axes(xyz)[0]) == 3


def remarks_on_unchecked(
    of: str, names: Sequence[str], model: GivenModel, without: tuple[int, ...], level: float
) -> Iterator[Remark]:
    """Yield remarks on given values whose errors nothing, or hardly anything, would reveal.

    `without` are the values that are left out, and `level` is that of the test of one value.
    """
    reach, rank = model.external(without, level=level), model.kept(without).decreases()[1]
    for kind, concerned in (
        ("given_unchecked", np.isinf(reach) & (rank == 0)),
        ("given_partly_checked", np.isinf(reach) & (rank > 0)),
    ):
        if concerned.any():
            yield remark(kind, given=[names[k] for k in np.flatnonzero(concerned).tolist()], of=of)
    weak = np.flatnonzero((reach > WRONG_SIGMAS) & np.isfinite(reach)).tolist()
    if weak:
        largest = float(reach[weak].max())
        yield remark("given_weakly_checked", given=[names[k] for k in weak], of=of, sigmas=largest)
