"""Base classes of the kinds of observations other than image points: single observations and groups.

A kind is one class in this package. The adjustment gets from it the input of its normal equations, redundancy
numbers, tests and variance components; the report gets its names and units.

The observations of a `Group` share parameters: planes, lines, frames, directions. These parameters are
computed from the points of the group at each linearisation, and are not among the unknowns. With their
derivatives H and the weight W, the derivatives by the points are (I - H (H'W H)^-1 H'W) Jx. The minimum and
the covariance are the same as with the parameters among the unknowns.

Source: Mikhail, Bethel and McGlone, Modern Photogrammetry (2001), sec. 4.4 and 5.6 (unified least squares);
Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.2.6 (elimination of groups of
parameters); Golub and Pereyra (1973), SIAM J. Numer. Anal. 10(2) (variable projection).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Protocol, Self

import numpy as np

from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.estimate import Estimate

# Units that tables have by mistake: the factor that corrects values and standard deviations.
UNITS_OF_LENGTHS = {"thousandfold": 1e-3, "thousandth": 1e3, "feet": 0.3048}
UNITS_OF_ANGLES = {"gon": 0.9, "radians": float(np.degrees(1.0))}
# Mistakes in coordinates of single points: which coordinate is where, and its sign.
MISTAKES_OF_ROWS = {"axes": ([1, 0, 2], [1.0, 1.0, 1.0]), "depth": ([0, 1, 2], [1.0, 1.0, -1.0])}
NO_PARAMETERS = np.zeros(0)
SINGULAR = 1e-9  # eigenvalue of the scaled normal equations of a group below which a parameter is open
POINT, PHOTOGRAPH, PARAMETER, MOUNT = "point", "photograph", "parameter", "mount"  # types of unknowns


def no_index() -> IntArray:
    """Return an empty array of indices, (0,)."""
    return np.zeros(0, dtype=np.int64)


def no_value() -> FloatArray:
    """Return an empty array of values, (0,)."""
    return np.zeros(0)


class Names(Protocol):
    """The names of what observations are of; a network has them."""

    @property
    def images(self) -> tuple[str, ...]:
        """Names of the m photographs."""

    @property
    def points(self) -> tuple[str, ...]:
        """Names of the n points."""


class Values(Protocol):
    """Values of all unknowns."""

    @property
    def points(self) -> FloatArray:
        """Object points X, object unit, (n, 3)."""

    @property
    def position(self) -> FloatArray:
        """Projection centres X0, object unit, (m, 3)."""

    @property
    def M(self) -> FloatArray:  # noqa: N802
        """Rotation from object axes to image axes of each photograph, (m, 3, 3)."""

    @property
    def parameters(self) -> FloatArray:
        """Interior orientation of each camera, (a, parameters)."""

    @property
    def mount_position(self) -> FloatArray:
        """Projection centre of each camera in the axes of its rig, object unit, (a, 3)."""

    @property
    def camera_from_rig(self) -> FloatArray:
        """Rotation from rig axes to the image axes of each camera, (a, 3, 3)."""


class Block(NamedTuple):
    """Unknowns of one type, one set for each observation."""

    of: str  # POINT: X, 3 unknowns | PHOTOGRAPH: X0, w, 6 | MOUNT: of a camera, 6 | PARAMETER: of a camera, 1
    at: IntArray  # index of the point, photograph or camera, (n,); of camera and parameter, (n, 2)


class Linear(NamedTuple):
    """Linearised observations at given values of the unknowns."""

    difference: FloatArray  # computed minus observed, (n, d)
    J: tuple[FloatArray, ...]  # derivatives by the unknowns of each block, (n, d, 1, 3 or 6)
    taken: FloatArray | None = None  # cofactors due to parameters that are not among the unknowns, (n, d, d)


class Kind(ABC):
    """Observations of one kind: n observations with d components each."""

    name: ClassVar[str]  # "scale bars"
    single: ClassVar[str]  # "scale bar"
    components: ClassVar[tuple[str, ...]]  # names of the d components
    needs_scale: ClassVar[bool] = False  # whether they are meaningless if the scale of the network is open
    carries_datum: ClassVar[bool] = False  # whether they take part only where they define the datum

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def covariances(self) -> FloatArray:
        """Return the covariance of each; variance 0 = fixed, infinite = not observed, (n, d, d)."""

    @property
    @abstractmethod
    def values(self) -> FloatArray:
        """Observed values, in the units of `units`, (n, d)."""

    @abstractmethod
    def blocks(self) -> tuple[Block, ...]:
        """Return the unknowns that the observations depend on."""

    @abstractmethod
    def linearise(self, values: Values) -> Linear:
        """Return computed minus observed and the derivatives at given values of the unknowns."""

    @abstractmethod
    def names(self, network: Names, estimate: Estimate) -> tuple[str, ...]:
        """Return the name of each observation in tables, (n,)."""

    @abstractmethod
    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the units of the components of each observation, (n, d)."""

    @abstractmethod
    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return the observations selected by a mask or indices."""

    @abstractmethod
    def with_values(self, values: FloatArray) -> Self:
        """Return the observations with other observed values, (n, d)."""

    def simulated(self, values: Values, rng: np.random.Generator | None = None) -> Self:
        """Return simulated observations for given values of the unknowns, with the stated errors.

        Args:
            values: true values.
            rng: source of the errors, normally distributed with the stated covariance; no errors if None.
        """
        if not len(self):
            return self
        exact = self.values + self.linearise(values).difference
        return self.with_values(exact if rng is None else exact + self.draw_errors(rng))

    def displaced(self, values: Values, rng: np.random.Generator) -> FloatArray:
        """Return object points with the errors of observations that have no values, (n, 3).

        For example, a wire is straight, and it is the points that deviate from it.

        Args:
            values: true values.
            rng: source of the errors.
        """
        return values.points

    def draw_errors(self, rng: np.random.Generator) -> FloatArray:
        """Return normally distributed errors of the components; 0 where fixed or not observed, (n, d)."""
        P = self.weight_of_all()
        C = self.covariances() if P is None else np.linalg.inv(P)[None]
        variance = np.diagonal(C, axis1=1, axis2=2)
        sigma = np.sqrt(np.where(is_observed(variance), variance, 1.0))
        R = np.where(np.isfinite(C), C, 0.0) / (sigma[:, :, None] * sigma[:, None, :])
        values, vectors = np.linalg.eigh(R)
        normal = np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(values.shape)
        return np.asarray(sigma * np.einsum("nab,nb->na", vectors, normal)).reshape(self.values.shape)

    def met(self, values: Values) -> FloatArray:
        """Return object points that fulfil the observations exactly, near the given values, (n, 3).

        The effect of motions of the network on observations is computed there. Otherwise the errors of points
        on a line, with observed offsets of 0, would seem to determine the scale.
        """
        return values.points

    def labels(self, network: Names) -> tuple[str, ...]:
        """Return the names of the components in tables, (d,)."""
        return self.components

    def parts(self, network: Names, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of parts that can be left out separately, such as a wrong observation, (q,)."""
        return tuple(f"{self.single} {name}" for name in self.names(network, estimate))

    def part_of(self, row: int, component: int) -> int:
        """Return the index of the part to which a component of an observation belongs."""
        return row

    def select_parts(self, on: BoolArray) -> Self:
        """Return the observations of the parts selected by a mask, (q,)."""
        return self.select(on)

    def mistakes(self) -> Mapping[str, Self]:
        """Return the observations corrected for common mistakes, by the name of the mistake."""
        return {}

    def parts_within(self, points: BoolArray, images: BoolArray) -> BoolArray:
        """Return which parts involve only the points (n,) and photographs (m,) of two masks, (q,)."""
        on = np.ones(len(self), dtype=bool)
        for of, at in self.blocks():
            if of in (POINT, PHOTOGRAPH):
                on &= (points if of == POINT else images)[at]
        return on

    def keep(self, points: BoolArray, images: BoolArray) -> Self:
        """Return the observations that involve only the points (n,) and photographs (m,) to keep.

        A group has length 0 if too few remain.
        """
        return self.select_parts(self.parts_within(points, images))

    def weight_of_all(self) -> FloatArray | None:
        """Return the weight matrix of all components, (n d, n d); None if it is block diagonal."""
        return None

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return the observations with new indices of points and photographs.

        Args:
            points: new index of each object point, (n,).
            images: new index of each photograph, (m,); unchanged if None.
        """
        return self

    def shifted(self, by: FloatArray) -> Self:
        """Return the observations after a shift of all coordinates, object unit, (3,)."""
        return self


class CoordinateKind(Kind):
    """A kind whose first components are coordinates of points or projection centres: X, Y, Z."""

    @property
    def coordinates(self) -> FloatArray:
        """X, Y, Z, object unit; NaN where not observed, (n, 3)."""
        return np.where(
            np.isfinite(np.einsum("nii->ni", self.coordinate_covariance)), self.values[:, :3], np.nan
        )

    @property
    def coordinate_covariance(self) -> FloatArray:
        """Covariance of X, Y, Z, object unit^2; variance 0 = fixed, infinite = not observed, (n, 3, 3)."""
        return self.covariances()[:, :3, :3]

    @abstractmethod
    def with_covariance(self, covariance: FloatArray) -> Self:
        """Return the observations with another covariance, (n, d, d)."""

    def with_coordinate_covariance(self, covariance: FloatArray) -> Self:
        """Return the observations with another covariance of X, Y, Z, object unit^2, (n, 3, 3)."""
        covariance_of_all = self.covariances().copy()
        covariance_of_all[:, :3, :3] = covariance
        return self.with_covariance(covariance_of_all)

    def reordered(self, order: IntArray) -> Self:
        """Return the observations with the values of others, for example of exchanged names, (n,)."""
        return self.with_values(self.values[order]).with_covariance(self.covariances()[order])

    def mistakes(self) -> Mapping[str, Self]:
        """Return the coordinates in a mirrored system."""
        values, flip = self.values.copy(), np.array([-1.0, 1.0, 1.0])
        values[:, :3] *= flip
        mirrored = self.with_values(values)
        return {
            "mirrored": mirrored.with_coordinate_covariance(self.coordinate_covariance * flip * flip[:, None])
        }

    def mistakes_at(self, rows: IntArray) -> Mapping[str, Self]:
        """Return the coordinates corrected in some rows for mistakes that single rows have, by their names.

        Args:
            rows: rows to correct, (r,).
        """
        corrected = {}
        for mistake, (order, sign) in MISTAKES_OF_ROWS.items():
            values, covariance = self.values.copy(), self.coordinate_covariance.copy()
            values[rows, :3] = values[rows][:, order] * sign
            covariance[rows] = covariance[rows][:, order][:, :, order] * np.outer(sign, sign)
            corrected[mistake] = self.with_values(values).with_coordinate_covariance(covariance)
        return corrected


class TableKind(Kind):
    """A kind that a survey gives as a table: names, then values, then their standard deviations."""

    texts: ClassVar[tuple[str, ...]]  # columns of names
    texts_of: ClassVar[str] = POINT  # type of the named things: POINT or PHOTOGRAPH
    numbers: ClassVar[tuple[str, ...]] = ()  # columns of numbers without a standard deviation
    angles: ClassVar[tuple[str, ...]] = ()  # components that are angles: rad, but degrees in tables

    sigma: FloatArray  # standard deviation of each component, object unit or rad, (n, d); groups: (r, c)

    @abstractmethod
    def with_sigma(self, sigma: FloatArray) -> Self:
        """Return the observations with other standard deviations, of the shape of `sigma`."""

    def mistakes(self) -> Mapping[str, Self]:
        """Return the observations in other units; some kinds add further mistakes."""
        turned = np.array([name in self.angles for name in self.components])
        corrected: dict[str, Self] = {}
        for units, scaled in ((UNITS_OF_LENGTHS, ~turned), (UNITS_OF_ANGLES, turned)):
            for name, factor in (units if scaled.any() else {}).items():
                by = np.where(scaled, factor, 1.0)
                values = self.values * np.resize(by, self.values.shape)
                sigma = self.sigma * np.resize(by, self.sigma.shape)
                corrected[name] = self.with_values(values).with_sigma(sigma)
        return corrected

    @classmethod
    def columns(cls) -> tuple[str, ...]:
        """Return the columns of numbers: those without standard deviation, values, standard deviations."""
        values = tuple(f"{name}_deg" if name in cls.angles else name for name in cls.components)
        return (*cls.numbers, *values, *(f"s{name}" for name in values))

    @classmethod
    def in_tables(cls) -> FloatArray:
        """Return the factor from rad to degrees for each component, 1 for lengths, (d,)."""
        return np.array([np.degrees(1.0) if name in cls.angles else 1.0 for name in cls.components])

    @abstractmethod
    def table_rows(self, network: Names) -> list[tuple[str | float, ...]]:
        """Return the rows of the table of the observations: `texts`, then `columns`."""

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of each component: the length unit, or rad."""
        return (tuple("rad" if name in self.angles else length_unit for name in self.components),) * len(self)


class RowKind(TableKind):
    """A kind of table in which each row is an observation."""

    def covariances(self) -> FloatArray:
        """Return the covariance of each observation, (n, d, d)."""
        return np.eye(self.sigma.shape[1]) * self.sigma[:, None] ** 2

    @property
    def without_sigma(self) -> FloatArray:
        """Values of `numbers`, object unit, (n, q)."""
        return np.zeros((len(self), 0))

    def table_rows(self, network: Names) -> list[tuple[str | float, ...]]:
        """Return the rows of the table of the observations."""
        names = [
            [(network.images if of == PHOTOGRAPH else network.points)[i] for i in at]
            for of, at in self.blocks()
        ]
        factor = self.in_tables()
        values = np.hstack([self.without_sigma, factor * self.values, factor * self.sigma])
        return [(*row, *numbers) for *row, numbers in zip(*names, values.tolist(), strict=True)]

    @classmethod
    @abstractmethod
    def of_table(cls, indices: tuple[IntArray, ...], value: FloatArray, sigma: FloatArray) -> Self:
        """Return the observations of a table.

        Args:
            indices: indices of the photographs or points in each column of names, (n,) each.
            value: `numbers` and values, object unit or rad, (n, q + d).
            sigma: standard deviations of the values, (n, d).
        """


def is_observed(variance: FloatArray) -> BoolArray:
    """Return which variances belong to observed components: neither 0 (fixed) nor infinite (unknown)."""
    return np.asarray((variance > 0) & np.isfinite(variance))


def inverse_of_observed(covariance: FloatArray) -> FloatArray:
    """Return the inverse covariances of the observed components, 0 elsewhere, (n, d, d)."""
    weight = np.zeros(covariance.shape)
    on = is_observed(np.diagonal(covariance, axis1=1, axis2=2))
    for components in np.unique(on, axis=0):
        rows = np.flatnonzero((on == components).all(axis=1))
        at = np.ix_(rows, components, components)
        weight[at] = np.linalg.inv(covariance[at])
    return weight


class Fit(NamedTuple):
    """A group at given coordinates of its points, with the parameters of the group fitted."""

    difference: FloatArray  # computed minus observed, (r, c)
    Jx: FloatArray  # derivatives by the points, (r, c, p, 3)
    H: FloatArray  # derivatives by the parameters of the group, (r, c, h)
    parameters: FloatArray = NO_PARAMETERS  # values of the parameters if they are reported, (h,)


class OwnParameters(NamedTuple):
    """Parameters of a group at given coordinates of its points."""

    value: FloatArray  # object unit or rad, (h,)
    cofactor: FloatArray  # cofactors for points without error, (h, h)
    J: FloatArray  # derivatives by the points, (h, p, 3)


@dataclass(frozen=True)
class Group(TableKind):
    """Observations of one group: r observations with c components each, on p points."""

    texts: ClassVar[tuple[str, ...]] = ("group", "point")
    labelled: ClassVar[bool] = True  # whether the first column names the group rather than a point
    least: ClassVar[int]  # smallest number of points of a useful group

    group: str
    point: IntArray  # indices of the points, (p,)
    value: FloatArray  # value of each observation, (r, c)
    sigma: FloatArray  # (r, c)

    @property
    def reported(self) -> tuple[str, ...]:
        """Names of the parameters that are results of a survey, (h,)."""
        return ()

    @abstractmethod
    def fit(self, X: FloatArray) -> Fit:
        """Return the observations at given coordinates of the points, (p, 3)."""

    def __len__(self) -> int:
        return int(len(self.point) >= self.least)

    @property
    def weights(self) -> FloatArray:
        """Inverse variances of all components, (r c,)."""
        return 1 / self.sigma.ravel() ** 2

    def covariances(self) -> FloatArray:
        """Return the joint covariance of all components, (1, r c, r c)."""
        return np.diag(self.sigma.ravel() ** 2)[None][: len(self)]

    @property
    def values(self) -> FloatArray:
        """Observed values, (1, r c)."""
        return self.value.reshape(1, -1)[: len(self)]

    def with_values(self, values: FloatArray) -> Self:
        """Return the group with other observed values."""
        return replace(self, value=values.reshape(self.value.shape))

    def with_sigma(self, sigma: FloatArray) -> Self:
        """Return the group with other standard deviations, (r, c)."""
        return replace(self, sigma=sigma)

    def blocks(self) -> tuple[Block, ...]:
        """Return the points, one block each."""
        return tuple(Block(POINT, self.point[k : k + 1][: len(self)]) for k in range(len(self.point)))

    def linearise(self, values: Values) -> Linear:
        """Return computed minus observed and the derivatives, with the parameters of the group fitted."""
        fit = self.fit(values.points[self.point])
        d = fit.difference.size
        Jx, H = fit.Jx.reshape(d, -1, 3), fit.H.reshape(d, -1)
        HW = H.T * self.weights
        flat, HQ = Jx.reshape(d, -1), H @ inverse_of_determined(HW @ H)
        J = (flat - HQ @ (HW @ flat)).reshape(1, *Jx.shape)
        blocks = tuple(J[:, :, k] for k in range(J.shape[2]))
        return Linear(fit.difference.reshape(1, d), blocks, (HQ @ H.T)[None])

    def own_parameters(self, values: Values) -> OwnParameters:
        """Return the parameters named in `reported`: h = -(H'W H)^-1 H'W Jx dX about these values."""
        fit = self.fit(values.points[self.point])
        H = fit.H.reshape(self.sigma.size, -1)
        HW = H.T * self.weights
        inverse = inverse_of_determined(HW @ H)
        J = -inverse @ (HW @ fit.Jx.reshape(self.sigma.size, -1))
        return OwnParameters(fit.parameters, inverse, J.reshape(len(J), -1, 3))

    def names(self, network: Names, estimate: Estimate) -> tuple[str, ...]:
        """Return the name of the group."""
        return (self.group,)[: len(self)]

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of each component."""
        of_row = tuple("rad" if name in self.angles else length_unit for name in self.components)
        return (of_row * len(self.sigma),)[: len(self)]

    def labels(self, network: Names) -> tuple[str, ...]:
        """Return the name of each component of the group, (r c,)."""
        several = len(self.components) > 1
        return tuple(
            f"{row} {part}" if several else row for row in self.rows(network) for part in self.components
        )

    def rows(self, network: Names) -> tuple[str, ...]:
        """Return the names of the observations of the group, (r,)."""
        return tuple(" - ".join(names) for names in self.row_points(network))

    def row_points(self, network: Names) -> list[tuple[str, ...]]:
        """Return the names of the points of each observation, in the order of the table columns, (r,)."""
        return [(network.points[j],) for j in self.point[len(self.point) - len(self.value) :]]

    def table_rows(self, network: Names) -> list[tuple[str | float, ...]]:
        """Return the rows of the table of the observations."""
        factor, group = self.in_tables(), self.group if self.labelled else network.points[self.point[0]]
        numbers = np.hstack([factor * self.value, factor * self.sigma])[:, -len(self.columns()) :]
        rows = zip(self.row_points(network), numbers.tolist(), strict=True)
        return [(group, *names, *values) for names, values in rows]

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return the group if it is selected, otherwise an empty group."""
        if np.asarray(rows).size and (np.asarray(rows).dtype != bool or np.asarray(rows).any()):
            return self
        return replace(self, point=self.point[:0], value=self.value[:0], sigma=self.sigma[:0])

    def parts(self, network: Names, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of the rows, such as "plane wall: 7", (r,)."""
        return tuple(f"{self.single} {self.group}: {row}" for row in self.rows(network))

    def part_of(self, row: int, component: int) -> int:
        """Return the row to which a component belongs."""
        return component // len(self.components)

    def select_parts(self, on: BoolArray) -> Self:
        """Return the group with the rows selected by a mask, (r,)."""
        stations = len(self.point) - len(self.value)
        point = np.concatenate([self.point[:stations], self.point[stations:][on]])
        return replace(self, point=point, value=self.value[on], sigma=self.sigma[on])

    def parts_within(self, points: BoolArray, images: BoolArray) -> BoolArray:
        """Return which rows involve only the points of a mask, (r,)."""
        on = points[self.point]
        stations = len(on) - len(self.value)
        return np.asarray(on[stations:] & on[:stations].all())

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return the group with new indices of its points."""
        return replace(self, point=points[self.point])

    @classmethod
    def of_group(
        cls, group: str, points: IntArray, value: FloatArray, sigma: FloatArray, number: Mapping[str, int]
    ) -> Self:
        """Return the observations of one group of a table, with its rows in order.

        Args:
            group: name of the group.
            points: indices of the points of each row, (r, columns of points).
            value: values, object unit or rad, (r, c).
            sigma: standard deviations, (r, c).
            number: index of each point of the network, by name.
        """
        return cls(group, points[:, 0], value, sigma)


def inverse_of_determined(N: FloatArray) -> FloatArray:
    """Return the inverse of the normal equations of a group in its determined directions, (h, h)."""
    scale = 1 / np.sqrt(np.maximum(np.diagonal(N), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(N * scale[:, None] * scale)
    on = values > SINGULAR
    half = scale[:, None] * vectors[:, on] / np.sqrt(values[on])
    return np.asarray(half @ half.T)
