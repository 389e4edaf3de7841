"""Observations between two points: distances, differences, directions and zenith angles."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.estimate import Estimate
from sfm.model.observations.kind import PHOTOGRAPH, POINT, Block, Fit, Group, Linear, Names, RowKind, Values


@dataclass(frozen=True)
class Pairs(RowKind):
    """Observations of d components between two object points or photographs."""

    texts: ClassVar[tuple[str, ...]] = ("from", "to")

    start: IntArray  # index of the first point or photograph, (n,)
    end: IntArray  # index of the second point or photograph, (n,)
    value: FloatArray  # object unit or rad, (n, d)
    sigma: FloatArray  # (n, d)

    def __len__(self) -> int:
        return len(self.start)

    @property
    def values(self) -> FloatArray:
        """Observed values, (n, d)."""
        return self.value

    def with_values(self, values: FloatArray) -> Self:
        """Return the observations with other observed values, (n, d)."""
        return replace(self, value=values)

    def with_sigma(self, sigma: FloatArray) -> Self:
        """Return the observations with other standard deviations, (n, d)."""
        return replace(self, sigma=sigma)

    def blocks(self) -> tuple[Block, ...]:
        """Return the blocks of both ends."""
        return Block(self.texts_of, self.start), Block(self.texts_of, self.end)

    def names(self, network: Names, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of both ends."""
        of = network.images if self.texts_of == PHOTOGRAPH else network.points
        return tuple(f"{of[i]} - {of[j]}" for i, j in zip(self.start, self.end, strict=True))

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return the observations selected by a mask or indices."""
        return replace(
            self,
            start=self.start[rows],
            end=self.end[rows],
            value=self.value[rows],
            sigma=self.sigma[rows],
        )

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return the observations with new indices of their ends."""
        place = points if self.texts_of == POINT else images
        return self if place is None else replace(self, start=place[self.start], end=place[self.end])

    @classmethod
    def of_table(cls, indices: tuple[IntArray, ...], value: FloatArray, sigma: FloatArray) -> Self:
        """Return the observations of a table."""
        start, end = indices
        return cls(start, end, value, sigma)


class PointPairs(Pairs):
    """Observations that depend on the difference of the coordinates of two object points."""

    @classmethod
    @abstractmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return values (n, d) and derivatives (n, d, 3) by the differences of the points X2 - X1, (n, 3)."""

    def linearise(self, values: Values) -> Linear:
        """Return computed minus observed, and the derivatives by both points."""
        computed, J = self.computed(values.points[self.end] - values.points[self.start])
        return Linear(computed - self.value, (-J, J))


class Distances(PointPairs):
    """Slope distances between object points."""

    name: ClassVar[str] = "distances"
    single: ClassVar[str] = "distance"
    components: ClassVar[tuple[str, ...]] = ("length",)

    @classmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return |d|, and the direction of d as derivative."""
        length = np.linalg.norm(d, axis=1, keepdims=True)
        return length, (d / np.maximum(length, np.finfo(float).tiny))[:, None]


@dataclass(frozen=True)
class OffsetDistances(Group):
    """Slope distances of an instrument, all too long by the same unknown constant."""

    name: ClassVar[str] = "distances with additive constant"
    single: ClassVar[str] = "distances with additive constant"
    components: ClassVar[tuple[str, ...]] = ("length",)
    texts: ClassVar[tuple[str, ...]] = ("instrument", "from", "to")
    least: ClassVar[int] = 3  # two distances

    ends: IntArray  # indices, in `point`, of both ends of each distance, (r, 2)

    @property
    def reported(self) -> tuple[str, ...]:
        """The name of the constant."""
        return ("additive constant",)

    def fit(self, X: FloatArray) -> Fit:
        """Return |X2 - X1| plus the constant minus the distances, with derivatives H by the constant."""
        d = X[self.ends[:, 1]] - X[self.ends[:, 0]]
        length = np.maximum(np.linalg.norm(d, axis=1), np.finfo(float).tiny)
        away, w, row = length - self.value[:, 0], self.weights, np.arange(len(d))
        Jx = np.zeros((len(d), 1, len(X), 3))
        Jx[row, 0, self.ends[:, 1]] = d / length[:, None]
        Jx[row, 0, self.ends[:, 0]] = -d / length[:, None]
        constant = -(w * away).sum() / w.sum()
        return Fit((away + constant)[:, None], Jx, np.ones((len(d), 1, 1)), np.array([constant]))

    def simulated(self, values: Values, rng: np.random.Generator | None = None) -> Self:
        """Return simulated distances with the same constant; the constant is 0 if all distances are 0.

        Planned distances are not measured yet, and their zeros do not mean that the constant cancels the
        lengths.
        """
        planned = self
        if not self.value.any():
            start, end = values.points[self.point[self.ends]].swapaxes(0, 1)
            planned = replace(self, value=np.linalg.norm(end - start, axis=1)[:, None])
        return super(OffsetDistances, planned).simulated(values, rng)

    def row_points(self, network: Names) -> list[tuple[str, ...]]:
        """Return the names of both points of each distance, (r,)."""
        names = [network.points[j] for j in self.point]
        return [(names[i], names[j]) for i, j in self.ends]

    def parts_within(self, points: BoolArray, images: BoolArray) -> BoolArray:
        """Return which distances are between points of a mask, (r,)."""
        return np.asarray(np.logical_and(*points[self.point[self.ends]].T))

    def select_parts(self, on: BoolArray) -> Self:
        """Return the distances selected by a mask (r,), with their end points."""
        used, ends = np.unique(self.ends[on], return_inverse=True)
        part = replace(self, point=self.point[used], ends=ends.reshape(-1, 2))
        return replace(part, value=self.value[on], sigma=self.sigma[on])

    @classmethod
    def of_group(
        cls, group: str, points: IntArray, value: FloatArray, sigma: FloatArray, number: Mapping[str, int]
    ) -> Self:
        """Return the distances of an instrument."""
        used, ends = np.unique(points, return_inverse=True)
        return cls(group, used, value, sigma, ends.reshape(-1, 2))


class HeightDifferences(PointPairs):
    """Differences of Z between object points."""

    name: ClassVar[str] = "height differences"
    single: ClassVar[str] = "height difference"
    components: ClassVar[tuple[str, ...]] = ("dZ",)

    @classmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return dZ, and the direction of Z as derivative."""
        return d[:, 2:], np.broadcast_to(np.array([0.0, 0.0, 1.0]), (len(d), 1, 3))

    def mistakes(self) -> Mapping[str, Self]:
        """Return the differences between exchanged points."""
        return {**super().mistakes(), "exchanged": replace(self, value=-self.value)}


class CoordinateDifferences(PointPairs):
    """Differences of X, Y and Z between object points."""

    name: ClassVar[str] = "coordinate differences"
    single: ClassVar[str] = "coordinate difference"
    components: ClassVar[tuple[str, ...]] = ("dX", "dY", "dZ")

    @classmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return d, and the unit matrix as derivative."""
        return d, np.broadcast_to(np.eye(3), (len(d), 3, 3))

    def mistakes(self) -> Mapping[str, Self]:
        """Return the differences between exchanged points, and those with X and Y exchanged.

        In a network of any attitude both are differences in a left-handed system, and any such one is.
        """
        swapped = replace(self, value=self.value[:, [1, 0, 2]], sigma=self.sigma[:, [1, 0, 2]])
        exchanged = replace(self, value=-self.value)
        return {**super().mistakes(), "exchanged": exchanged, "mirrored": swapped}


class HorizontalDirections(Group):
    """Directions in X, Y from one object point to others, clockwise as instruments count, with Z up."""

    name: ClassVar[str] = "horizontal directions"
    single: ClassVar[str] = "horizontal direction"
    components: ClassVar[tuple[str, ...]] = ("direction",)
    texts: ClassVar[tuple[str, ...]] = ("station", "point")
    angles: ClassVar[tuple[str, ...]] = ("direction",)
    labelled: ClassVar[bool] = False
    least: ClassVar[int] = 3  # the station and two targets

    def fit(self, X: FloatArray) -> Fit:
        """Return atan2(dX, dY) minus orientation and direction, with derivatives H by the orientation."""
        d = X[1:, :2] - X[0, :2]
        square = np.maximum((d**2).sum(axis=1), np.finfo(float).tiny)
        away = np.arctan2(d[:, 0], d[:, 1]) - self.value[:, 0]
        w = self.weights
        orientation = np.arctan2((w * np.sin(away)).sum(), (w * np.cos(away)).sum())
        l = (away - orientation + np.pi) % (2 * np.pi) - np.pi
        l = l - (w * l).sum() / w.sum()
        Jx = np.zeros((len(d), 1, len(X), 3))
        by = np.stack([d[:, 1] / square, -d[:, 0] / square], axis=1)
        Jx[np.arange(len(d)), 0, 1 + np.arange(len(d)), :2] = by
        Jx[:, 0, 0, :2] = -by
        return Fit(l[:, None], Jx, -np.ones((len(d), 1, 1)))

    def mistakes(self) -> Mapping[str, Self]:
        """Return the directions counted counter-clockwise."""
        return {**super().mistakes(), "counter-clockwise": replace(self, value=-self.value)}

    @classmethod
    def of_group(
        cls, group: str, points: IntArray, value: FloatArray, sigma: FloatArray, number: Mapping[str, int]
    ) -> Self:
        """Return the directions from a station; its point precedes those of the targets."""
        return cls(group, np.concatenate([[number[group]], points[:, 0]]), value, sigma)


class ZenithAngles(PointPairs):
    """Angles between Z and the direction from one object point to another."""

    name: ClassVar[str] = "zenith angles"
    single: ClassVar[str] = "zenith angle"
    components: ClassVar[tuple[str, ...]] = ("zenith",)
    angles: ClassVar[tuple[str, ...]] = ("zenith",)

    @classmethod
    def computed(cls, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return atan2(h, dZ) with the horizontal distance h, and its derivatives."""
        tiny = np.finfo(float).tiny
        h = np.maximum(np.hypot(d[:, 0], d[:, 1]), tiny)
        square = np.maximum(h**2 + d[:, 2] ** 2, tiny)
        along = d[:, 2] / (square * h)
        J = np.stack([along * d[:, 0], along * d[:, 1], -h / square], axis=1)
        return np.arctan2(h, d[:, 2])[:, None], J[:, None]

    def mistakes(self) -> Mapping[str, Self]:
        """Return the angles counted from the horizon, and between exchanged points."""
        return {
            **super().mistakes(),
            "elevation": replace(self, value=np.pi / 2 - self.value),
            "exchanged": replace(self, value=np.pi - self.value),
        }
