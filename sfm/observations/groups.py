"""Observations of a group of points with parameters of the group: planes, lines, frames, directions.

The parameters of a group are found anew from its points whenever the observations are linearised, and do not
appear among the unknowns: with their derivatives H and the weight W, the derivatives by the points are
(I - H (H'W H)^-1 H'W) Jx, which leaves minimum and covariance as they are with the parameters among them.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.2.6 (elimination of groups of
parameters); Golub and Pereyra (1973), SIAM J. Numer. Anal. 10(2) (variable projection).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Self

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.observations.kind import POINT, Block, Linear, TableKind, Values

if TYPE_CHECKING:
    from sfm.network import Estimate, Network


NO_PARAMETERS = np.zeros(0)
SINGULAR = 1e-9  # eigenvalue of the group's scaled normal equations below which a parameter is open


class Fit(NamedTuple):
    """A group at some values of its points, with the parameters of the group fitted."""

    difference: FloatArray  # computed minus observed, (r, c)
    Jx: FloatArray  # derivatives by the points, (r, c, p, 3)
    H: FloatArray  # derivatives by the parameters of the group, (r, c, h)
    parameters: FloatArray = NO_PARAMETERS  # their values, where they are reported, (h,)


class OwnParameters(NamedTuple):
    """Parameters of a group at some values of its points."""

    value: FloatArray  # object unit or rad, (h,)
    cofactor: FloatArray  # were the points without error, (h, h)
    J: FloatArray  # derivatives by the points, (h, p, 3)


@dataclass(frozen=True)
class Group(TableKind):
    """Observations of one group: r of them, of c components each, by p points."""

    texts: ClassVar[tuple[str, ...]] = ("group", "point")
    labelled: ClassVar[bool] = True  # whether the first of these names the group alone, and no point
    least: ClassVar[int]  # points that a group needs to be of use

    group: str
    point: IntArray  # indices of the points, (p,)
    value: FloatArray  # one row for each observation, (r, c)
    sigma: FloatArray  # (r, c)

    @property
    def reported(self) -> tuple[str, ...]:
        """Names of the parameters that a survey is made to find, (h,)."""
        return ()

    @abstractmethod
    def fit(self, X: FloatArray) -> Fit:
        """Return the observations at coordinates of the points, (p, 3)."""

    def __len__(self) -> int:
        return int(len(self.point) >= self.least)

    @property
    def weights(self) -> FloatArray:
        """Inverse variances of all components, (r c,)."""
        return 1 / self.sigma.ravel() ** 2

    def covariances(self) -> FloatArray:
        """Return that of all components together, (1, r c, r c)."""
        return np.diag(self.sigma.ravel() ** 2)[None][: len(self)]

    @property
    def values(self) -> FloatArray:
        """Observed values, (1, r c)."""
        return self.value.reshape(1, -1)[: len(self)]

    def with_values(self, values: FloatArray) -> Self:
        """Return the group with other observed values."""
        return replace(self, value=values.reshape(self.value.shape))

    def with_sigma(self, sigma: FloatArray) -> Self:
        """Return them with other standard deviations."""
        return replace(self, sigma=sigma)

    def blocks(self) -> tuple[Block, ...]:
        """Return the points, each a block."""
        return tuple(Block(POINT, self.point[k : k + 1][: len(self)]) for k in range(len(self.point)))

    def linearise(self, values: Values) -> Linear:
        """Return computed minus observed and the derivatives, the parameters of the group fitted."""
        fit = self.fit(values.points[self.point])
        d = fit.difference.size
        Jx, H = fit.Jx.reshape(d, -1, 3), fit.H.reshape(d, -1)
        HW = H.T * self.weights
        flat, HQ = Jx.reshape(d, -1), H @ inverse_of_determined(HW @ H)
        J = (flat - HQ @ (HW @ flat)).reshape(1, *Jx.shape)
        blocks = tuple(J[:, :, k] for k in range(J.shape[2]))
        return Linear(fit.difference.reshape(1, d), blocks, (HQ @ H.T)[None])

    def own_parameters(self, values: Values) -> OwnParameters:
        """Return the parameters named `reported`: h = -(H'W H)^-1 H'W Jx dX about these values."""
        fit = self.fit(values.points[self.point])
        H = fit.H.reshape(self.sigma.size, -1)
        HW = H.T * self.weights
        inverse = inverse_of_determined(HW @ H)
        J = -inverse @ (HW @ fit.Jx.reshape(self.sigma.size, -1))
        return OwnParameters(fit.parameters, inverse, J.reshape(len(J), -1, 3))

    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the name of the group."""
        return (self.group,)[: len(self)]

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of each component."""
        of_row = tuple("rad" if name in self.angles else length_unit for name in self.components)
        return (of_row * len(self.sigma),)[: len(self)]

    def labels(self, network: Network) -> tuple[str, ...]:
        """Return what each component of the group is called, (r c,)."""
        several = len(self.components) > 1
        return tuple(
            f"{row} {part}" if several else row for row in self.rows(network) for part in self.components
        )

    def rows(self, network: Network) -> tuple[str, ...]:
        """Return what the observations of the group are called, (r,)."""
        return tuple(" - ".join(names) for names in self.row_points(network))

    def row_points(self, network: Network) -> list[tuple[str, ...]]:
        """Return the names of the points of each observation, as columns of a table have them, (r,)."""
        return [(network.points[j],) for j in self.point[len(self.point) - len(self.value) :]]

    def table_rows(self, network: Network) -> list[tuple[str | float, ...]]:
        """Return the observations as a table has them."""
        factor, group = self.in_tables(), self.group if self.labelled else network.points[self.point[0]]
        numbers = np.hstack([factor * self.value, factor * self.sigma])[:, -len(self.columns()) :]
        rows = zip(self.row_points(network), numbers.tolist(), strict=True)
        return [(group, *names, *values) for names, values in rows]

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return the group, or nothing of it."""
        if np.asarray(rows).size and (np.asarray(rows).dtype != bool or np.asarray(rows).any()):
            return self
        return replace(self, point=self.point[:0], value=self.value[:0], sigma=self.sigma[:0])

    def parts(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the rows: "plane wall: 7", (r,)."""
        return tuple(f"{self.single} {self.group}: {row}" for row in self.rows(network))

    def part_of(self, row: int, component: int) -> int:
        """Return the row of a component."""
        return component // len(self.components)

    def select_parts(self, on: BoolArray) -> Self:
        """Return some of the rows, (r,)."""
        stations = len(self.point) - len(self.value)
        point = np.concatenate([self.point[:stations], self.point[stations:][on]])
        return replace(self, point=point, value=self.value[on], sigma=self.sigma[on])

    def keep(self, points: BoolArray, images: BoolArray) -> Self:
        """Return the group with some points alone; nothing where too few are left."""
        on = points[self.point]
        stations = len(on) - len(self.value)
        return self.select_parts(on[stations:] & on[:stations].all())

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return the group with its points at other places."""
        return replace(self, point=points[self.point])

    @classmethod
    def of_group(
        cls, group: str, points: IntArray, value: FloatArray, sigma: FloatArray, number: Mapping[str, int]
    ) -> Self:
        """Return the observations of one group of a table, its rows in order.

        Args:
            group: its name.
            points: indices of the points of each row, (r, columns of points).
            value: object unit or rad, (r, c).
            sigma: standard deviations, (r, c).
            number: of each point of the network, by name.
        """
        return cls(group, points[:, 0], value, sigma)


def inverse_of_determined(N: FloatArray) -> FloatArray:
    """Return the inverse of the group's normal equations over the determined parameters, (h, h)."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(N), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(N * scale[:, None] * scale)
    on = values > SINGULAR
    half = scale[:, None] * vectors[:, on] / np.sqrt(values[on])
    return np.asarray(half @ half.T)
