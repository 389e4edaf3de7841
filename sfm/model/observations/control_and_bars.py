"""Given values: control points, interior orientation and lengths of scale bars."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.estimate import Estimate
from sfm.model.observations.kind import (
    PARAMETER,
    POINT,
    Block,
    CoordinateKind,
    Kind,
    Linear,
    Names,
    Values,
    no_index,
    no_value,
)


@dataclass(frozen=True)
class ObjectPoints(CoordinateKind):
    """Object points with given coordinates (control)."""

    name: ClassVar[str] = "control points"
    single: ClassVar[str] = "control point"
    components: ClassVar[tuple[str, ...]] = ("X", "Y", "Z")
    carries_datum: ClassVar[bool] = True

    point: IntArray = field(default_factory=no_index)  # index of the point, (n,)
    xyz: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # object unit, (n, 3)
    # object unit^2; variance 0 = fixed, infinite = unknown, (n, 3, 3)
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))

    def __len__(self) -> int:
        return len(self.point)

    def covariances(self) -> FloatArray:
        """Return the covariance of each point, (n, 3, 3)."""
        return self.covariance

    @property
    def values(self) -> FloatArray:
        """Coordinates, object unit, (n, 3)."""
        return self.xyz

    @property
    def complete(self) -> ObjectPoints:
        """The points with all three coordinates known."""
        return self.select(np.isfinite(np.einsum("nii->ni", self.covariance)).all(axis=1))

    def with_values(self, values: FloatArray) -> Self:
        """Return the points with other coordinates, (n, 3)."""
        return replace(self, xyz=values)

    def with_covariance(self, covariance: FloatArray) -> Self:
        """Return the points with another covariance, (n, 3, 3)."""
        return replace(self, covariance=covariance)

    def blocks(self) -> tuple[Block, ...]:
        """Return the block of the points."""
        return (Block(POINT, self.point),)

    def linearise(self, values: Values) -> Linear:
        """Return X - observed, and the unit matrix as derivative."""
        J = np.broadcast_to(np.eye(3), (len(self), 3, 3))
        return Linear(values.points[self.point] - self.xyz, (J,))

    def names(self, network: Names, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the points."""
        return tuple(network.points[j] for j in self.point)

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of lengths."""
        return ((length_unit,) * 3,) * len(self)

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return the points selected by a mask or indices."""
        return replace(self, point=self.point[rows], xyz=self.xyz[rows], covariance=self.covariance[rows])

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return the points with new indices."""
        return replace(self, point=points[self.point])

    def shifted(self, by: FloatArray) -> Self:
        """Return the points with a shift added to all coordinates, object unit, (3,)."""
        return replace(self, xyz=self.xyz + by)


@dataclass(frozen=True)
class InteriorObservations(Kind):
    """Given parameters of interior orientation, for example from a calibration certificate."""

    name: ClassVar[str] = "interior orientation"
    single: ClassVar[str] = "interior orientation"
    components: ClassVar[tuple[str, ...]] = ("value",)

    camera: IntArray = field(default_factory=no_index)  # index of the camera, (p,)
    parameter: IntArray = field(default_factory=no_index)  # index among the camera's names, (p,)
    value: FloatArray = field(default_factory=no_value)  # in the parameter's unit, (p,)
    sigma: FloatArray = field(default_factory=no_value)  # in the parameter's unit, (p,)
    correlation: FloatArray | None = None  # correlation of all parameters; independent if not given, (p, p)

    def __len__(self) -> int:
        return len(self.camera)

    def covariances(self) -> FloatArray:
        """Return the variance of each parameter, (p, 1, 1)."""
        return self.sigma[:, None, None] ** 2

    @property
    def values(self) -> FloatArray:
        """The parameters, (p, 1)."""
        return self.value[:, None]

    def with_values(self, values: FloatArray) -> Self:
        """Return the parameters with other values, (p, 1)."""
        return replace(self, value=values[:, 0])

    def blocks(self) -> tuple[Block, ...]:
        """Return the block of the parameters."""
        return (Block(PARAMETER, np.stack([self.camera, self.parameter], axis=1)),)

    def linearise(self, values: Values) -> Linear:
        """Return parameter minus observed, and 1 as derivative."""
        difference = values.parameters[self.camera, self.parameter] - self.value
        return Linear(difference[:, None], (np.ones((len(self), 1, 1)),))

    def names(self, network: Names, estimate: Estimate) -> tuple[str, ...]:
        """Return names such as "c of camera A"."""
        pairs = [(estimate.cameras[a], s) for a, s in zip(self.camera, self.parameter, strict=True)]
        return tuple(f"{camera.names[s]} of camera {camera.owner_of(s)}" for camera, s in pairs)

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of each parameter."""
        pairs = zip(self.camera, self.parameter, strict=True)
        return tuple((estimate.cameras[a].units[s],) for a, s in pairs)

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return the parameters selected by a mask or indices."""
        R = self.correlation
        return replace(
            self,
            camera=self.camera[rows],
            parameter=self.parameter[rows],
            value=self.value[rows],
            sigma=self.sigma[rows],
            correlation=None if R is None else R[rows][:, rows],
        )

    def weight_of_all(self) -> FloatArray | None:
        """Return the inverse covariance of all parameters, (p, p); None if they are independent."""
        if self.correlation is None:
            return None
        # by its factor the inverse is that of a positive definite matrix, however near to singular
        root = np.linalg.inv(np.linalg.cholesky(self.correlation)) / self.sigma
        return np.asarray(root.T @ root)

    def weight_of(self, rows: IntArray) -> FloatArray:
        """Return the inverse covariance of the parameters in some rows, (r, r)."""
        selected = self.select(rows)
        together = selected.weight_of_all()
        return np.diag(1 / selected.sigma**2) if together is None else together


@dataclass(frozen=True)
class ScaleBars(Kind):
    """Measured distances between object points."""

    name: ClassVar[str] = "scale bars"
    single: ClassVar[str] = "scale bar"
    components: ClassVar[tuple[str, ...]] = ("length",)

    start: IntArray = field(default_factory=no_index)  # index of the first point, (b,)
    end: IntArray = field(default_factory=no_index)  # index of the second point, (b,)
    length: FloatArray = field(default_factory=no_value)  # object unit, (b,)
    sigma: FloatArray = field(default_factory=no_value)  # object unit, (b,)
    # number of the table of distances of each, whose scale they share; 0 or empty: of none, (b,)
    table: IntArray = field(default_factory=no_index)

    def __len__(self) -> int:
        return len(self.start)

    @property
    def is_one_scale(self) -> bool:
        """Whether all have one scale: a single bar, or those of one table."""
        return len(self) == 1 or bool(len(self.table) and self.table[0] and np.ptp(self.table) == 0)

    def covariances(self) -> FloatArray:
        """Return the variance of each length, object unit^2, (b, 1, 1)."""
        return self.sigma[:, None, None] ** 2

    @property
    def values(self) -> FloatArray:
        """Lengths, object unit, (b, 1)."""
        return self.length[:, None]

    def with_values(self, values: FloatArray) -> Self:
        """Return the bars with other lengths."""
        return replace(self, length=values[:, 0])

    def with_sigma(self, sigma: FloatArray) -> Self:
        """Return the bars with other standard deviations, (b,)."""
        return replace(self, sigma=sigma)

    def blocks(self) -> tuple[Block, ...]:
        """Return the blocks of both ends."""
        return Block(POINT, self.start), Block(POINT, self.end)

    def linearise(self, values: Values) -> Linear:
        """Return |X2 - X1| - length, and the directions between the ends as derivatives."""
        d = values.points[self.end] - values.points[self.start]
        length = np.linalg.norm(d, axis=1)
        direction = (d / np.maximum(length, np.finfo(float).tiny)[:, None])[:, None]
        return Linear((length - self.length)[:, None], (-direction, direction))

    def names(self, network: Names, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of both ends."""
        ends = zip(self.start, self.end, strict=True)
        return tuple(f"{network.points[i]} - {network.points[j]}" for i, j in ends)

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of lengths."""
        return ((length_unit,),) * len(self)

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return the bars selected by a mask or indices."""
        return replace(
            self,
            start=self.start[rows],
            end=self.end[rows],
            length=self.length[rows],
            sigma=self.sigma[rows],
            table=self.table[rows] if len(self.table) else self.table,
        )

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return the bars with new indices of their points."""
        return replace(self, start=points[self.start], end=points[self.end])
