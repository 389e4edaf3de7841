"""Parameters of interior orientation known beforehand, as from a calibration certificate."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.observations.kind import PARAMETER, Block, Kind, Linear, Values, no_index, no_value

if TYPE_CHECKING:
    from sfm.network import Estimate, Network


@dataclass(frozen=True)
class InteriorObservations(Kind):
    """Parameters of interior orientation known beforehand, as from a calibration certificate."""

    name: ClassVar[str] = "interior orientation"
    single: ClassVar[str] = "interior orientation"
    components: ClassVar[tuple[str, ...]] = ("value",)

    camera: IntArray = field(default_factory=no_index)  # index of the camera, (p,)
    parameter: IntArray = field(default_factory=no_index)  # index among the camera's names, (p,)
    value: FloatArray = field(default_factory=no_value)  # in the parameter's unit, (p,)
    sigma: FloatArray = field(default_factory=no_value)  # in the parameter's unit, (p,)
    correlation: FloatArray | None = None  # of all of them together; independent where not given, (p, p)

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
        """Return them with other values."""
        return replace(self, value=values[:, 0])

    def blocks(self) -> tuple[Block, ...]:
        """Return the parameters."""
        return (Block(PARAMETER, np.stack([self.camera, self.parameter], axis=1)),)

    def linearise(self, values: Values) -> Linear:
        """Return parameter minus observed, and 1."""
        difference = values.parameters[self.camera, self.parameter] - self.value
        return Linear(difference[:, None], (np.ones((len(self), 1, 1)),))

    def names(self, network: Network, estimate: Estimate) -> tuple[str, ...]:
        """Return "c of camera A"."""
        pairs = [(estimate.cameras[a], s) for a, s in zip(self.camera, self.parameter, strict=True)]
        return tuple(f"{camera.names[s]} of camera {camera.owner_of(s)}" for camera, s in pairs)

    def units(self, estimate: Estimate, length_unit: str) -> tuple[tuple[str, ...], ...]:
        """Return the unit of each parameter."""
        pairs = zip(self.camera, self.parameter, strict=True)
        return tuple((estimate.cameras[a].units[s],) for a, s in pairs)

    def select(self, rows: IntArray | BoolArray) -> Self:
        """Return some of the parameters."""
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
        """Return the inverse of the covariance of all of them, (p, p); None where they are independent."""
        if self.correlation is None:
            return None
        return np.asarray(np.linalg.inv(self.correlation) / np.outer(self.sigma, self.sigma))

    def weight_of(self, rows: IntArray) -> FloatArray:
        """Return the inverse of the covariance of some of the values, (r, r)."""
        some = self.select(rows)
        together = some.weight_of_all()
        return np.diag(1 / some.sigma**2) if together is None else together
