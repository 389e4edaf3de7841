"""A kind of observation beside image points: what was observed, how precisely, and what unknowns explain it.

A kind is one class in one file of this package. The adjustment takes from it what its normal equations,
redundancy numbers, tests and variance components need; the report takes its names and units.

Source: Mikhail, Bethel and McGlone, Modern Photogrammetry (2001), sec. 4.4 and 5.6 (unified least squares).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Protocol, Self

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from sfm.network import Estimate, Network

POINT, PHOTOGRAPH, PARAMETER, MOUNT = "point", "photograph", "parameter", "mount"  # sorts of unknowns


def no_index() -> IntArray:
    """Return indices of nothing, (0,)."""
    return np.zeros(0, dtype=np.int64)


def no_value() -> FloatArray:
    """Return values of nothing, (0,)."""
    return np.zeros(0)


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
        """Object to image axes of each photograph, (m, 3, 3)."""

    @property
    def parameters(self) -> FloatArray:
        """Interior orientation of each camera, (a, parameters)."""

    @property
    def mount_position(self) -> FloatArray:
        """Projection centre of each camera in the axes of its rig, object unit, (a, 3)."""

    @property
    def camera_from_rig(self) -> FloatArray:
        """Axes of the rig to those of each camera, (a, 3, 3)."""


class Block(NamedTuple):
    """Unknowns of one sort, one for each observation."""

    of: str  # POINT: X, 3 unknowns | PHOTOGRAPH: X0, w, 6 | MOUNT: of a camera, 6 | PARAMETER: of a camera, 1
    at: IntArray  # index of the point, photograph or camera, (n,); of camera and parameter, (n, 2)


class Linear(NamedTuple):
    """Observations at some values of the unknowns."""

    difference: FloatArray  # computed minus observed, (n, d)
    J: tuple[FloatArray, ...]  # derivatives by the unknowns of each block, (n, d, 1, 3 or 6)
    taken: FloatArray | None = None  # of cofactors by parameters that are not among the unknowns, (n, d, d)


class Kind(ABC):
    """Observations of one kind: n of them, of d components each."""

    name: ClassVar[str]  # "scale bars"
    single: ClassVar[str]  # "scale bar"
    components: ClassVar[tuple[str, ...]]  # names of the d components
    needs_scale: ClassVar[bool] = False  # whether they mean nothing where the scale of the network is open

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def covariances(self) -> FloatArray:
        """Return that of the components of each; 0 = fixed, infinite = not observed, (n, d, d)."""

    @property
    @abstractmethod
    def values(self) -> FloatArray:
        """Observed values, in the units of `units`, (n, d)."""

    @abstractmethod
    def blocks(self) -> tuple[Block, ...]:
        """Return the unknowns that the observations depend on."""

    @abstractmethod
    def linearise(self, values: Values) -> Linear:
        """Return computed minus observed and the derivatives at some values of the unknowns."""

    @abstractmethod
    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return what each observation is called in tables, (n,)."""

    @abstractmethod
    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the units of the components of each observation, (n, d)."""

    @abstractmethod
    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return some of the observations."""

    @abstractmethod
    def with_values(self, values: FloatArray) -> Self:
        """Return the observations with other observed values, (n, d)."""

    def simulated(self, values: Values, rng: np.random.Generator | None = None) -> Self:
        """Return the observations that values of the unknowns give, with errors as stated.

        Args:
            values: taken as true.
            rng: source of the errors, normally distributed with the covariance stated; no errors if None.
        """
        if not len(self):
            return self
        exact = self.values + self.linearise(values).difference
        return self.with_values(exact if rng is None else exact + self.draw_errors(rng))

    def displaced(self, values: Values, rng: np.random.Generator) -> FloatArray:
        """Return object points with the errors of observations that have no values, (n, 3).

        A wire is straight; what is on it only nearly are the points.
        """
        return values.points

    def draw_errors(self, rng: np.random.Generator) -> FloatArray:
        """Return errors of the components, normally distributed; 0 where fixed or not observed, (n, d)."""
        P = self.weight_of_all()
        C = self.covariances() if P is None else np.linalg.inv(P)[None]
        variance = np.diagonal(C, axis1=1, axis2=2)
        sigma = np.sqrt(np.where(is_observed(variance), variance, 1.0))
        R = np.where(np.isfinite(C), C, 0.0) / (sigma[:, :, None] * sigma[:, None, :])
        values, vectors = np.linalg.eigh(R)
        normal = np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(values.shape)
        return np.asarray(sigma * np.einsum("nab,nb->na", vectors, normal)).reshape(self.values.shape)

    def met(self, values: Values) -> FloatArray:
        """Return object points that meet the observations, near those of values, (n, 3).

        There the effect of a motion of the network on observations is asked for: offsets of nothing from a
        line would have its errors determine the scale.
        """
        return values.points

    def labels(self, network: Network) -> tuple[str, ...]:
        """Return what the components are called in tables, (d,)."""
        return self.components

    def parts(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return the names of what can leave alone, as a wrong observation does, (q,)."""
        return tuple(f"{self.single} {name}" for name in self.names(network, estimate))

    def part_of(self, row: int, component: int) -> int:
        """Return the part that a component of an observation belongs to."""
        return row

    def select_parts(self, on: BoolArray) -> Self:
        """Return the observations of some parts, (q,)."""
        return self.select(on)

    def mistakes(self) -> Mapping[str, Self]:
        """Return the observations as they would be without a common mistake, by what the mistake is."""
        return {}

    def keep(self, points: BoolArray, images: BoolArray) -> Self:
        """Return the observations of some points (n,) and photographs (m,) alone."""
        on = np.ones(len(self), dtype=bool)
        for of, at in self.blocks():
            if of in (POINT, PHOTOGRAPH):
                on &= (points if of == POINT else images)[at]
        return self.select(on)

    def weight_of_all(self) -> FloatArray | None:
        """Return the weight matrix of all components, (n d, n d); None where it is block diagonal."""
        return None

    def renumbered(self, points: IntArray, images: IntArray | None = None) -> Self:
        """Return the observations of a network with its points and photographs at other places.

        Args:
            points: place of each object point, (n,).
            images: place of each photograph, (m,); the same as before if None.
        """
        return self

    def shifted(self, by: FloatArray) -> Self:
        """Return the observations for coordinates with a shift added, object unit, (3,)."""
        return self


class TableKind(Kind):
    """A kind that a survey gives as a table: names, then values, then their standard deviations."""

    texts: ClassVar[tuple[str, ...]]  # columns of names
    texts_of: ClassVar[str] = POINT  # what they name: POINT or PHOTOGRAPH
    numbers: ClassVar[tuple[str, ...]] = ()  # columns of numbers without a standard deviation
    angles: ClassVar[tuple[str, ...]] = ()  # components that are angles: rad, and degrees in tables

    sigma: FloatArray  # of each component, object unit or rad, (n, d); of groups (r, c)

    @abstractmethod
    def with_sigma(self, sigma: FloatArray) -> Self:
        """Return the observations with other standard deviations."""

    def mistakes(self) -> Mapping[str, Self]:
        """Return the observations in other units, and what a kind knows besides."""
        turned = np.array([name in self.angles for name in self.components])
        units = {"thousandfold": 1e-3, "thousandth": 1e3, "feet": 0.3048} if not turned.all() else {}
        found: dict[str, Self] = {}
        for name, factor in (units | ({"gon": 0.9} if turned.any() else {})).items():
            by = np.where(turned == (name == "gon"), factor, 1.0)
            values = self.values * np.resize(by, self.values.shape)
            found[name] = self.with_values(values).with_sigma(self.sigma * np.resize(by, self.sigma.shape))
        return found

    @classmethod
    def columns(cls) -> tuple[str, ...]:
        """Return the columns of numbers: those without standard deviation, values, standard deviations."""
        values = tuple(f"{name}_deg" if name in cls.angles else name for name in cls.components)
        return (*cls.numbers, *values, *(f"s{name}" for name in values))

    @classmethod
    def in_tables(cls) -> FloatArray:
        """Return the factor of each component from rad to degrees, 1 for lengths, (d,)."""
        return np.array([np.degrees(1.0) if name in cls.angles else 1.0 for name in cls.components])

    @abstractmethod
    def table_rows(self, network: Network) -> list[tuple[str | float, ...]]:
        """Return the observations as a table has them: `texts`, then `columns`."""

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of each component: that of lengths, or rad."""
        return (tuple("rad" if name in self.angles else length_unit for name in self.components),) * len(self)


class RowKind(TableKind):
    """A kind of table of which each row is an observation."""

    def covariances(self) -> FloatArray:
        """Return the covariance of each, (n, d, d)."""
        return np.eye(self.sigma.shape[1]) * self.sigma[:, None] ** 2

    @property
    def without_sigma(self) -> FloatArray:
        """Values of `numbers`, object unit, (n, q)."""
        return np.zeros((len(self), 0))

    def table_rows(self, network: Network) -> list[tuple[str | float, ...]]:
        """Return the observations as a table has them."""
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
            indices: of the photographs or points of each column of names, (n,) each.
            value: `numbers` and values, object unit or rad, (n, q + d).
            sigma: standard deviations of the values, (n, d).
        """


def is_observed(variance: FloatArray) -> BoolArray:
    """Return which variances belong to observed components: neither 0 (fixed) nor infinite (unknown)."""
    return np.asarray((variance > 0) & np.isfinite(variance))


def inverse_of_observed(covariance: FloatArray) -> FloatArray:
    """Return inverse covariances over the observed components only, 0 elsewhere, (n, d, d)."""
    weight = np.zeros(covariance.shape)
    for p, Q in enumerate(covariance):
        on = is_observed(np.diagonal(Q))
        weight[p][np.ix_(on, on)] = np.linalg.inv(Q[np.ix_(on, on)])
    return weight
