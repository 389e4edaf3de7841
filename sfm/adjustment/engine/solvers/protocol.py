"""Protocol of the solvers of the reduced normal equations, and the memory that they may use.

The reduced normal matrix S of orientations and kept points is factored once for each step. Its factor gives
the step and, at the optimum, the elements of S^-1 that covariances need.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

from sfm.adjustment.datum import Motions
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError
from sfm.runtime.memory import limit_bytes

SHARE = 0.75  # share of the memory; the network, its blocks and other programs need the rest
UNKNOWN = 8e9  # bytes assumed if the system does not state its memory


@dataclass(frozen=True)
class Inverse:
    """Elements of S^-1 in the units of the unknowns, 0 for fixed unknowns."""

    exterior: FloatArray  # X0, w of each pose, (poses, 6, 6)
    mixed: FloatArray  # poses x border unknowns, (6 poses, i + 3 s)
    border: FloatArray  # interior unknowns, mounts and kept points, (i + 3 s, i + 3 s)
    core: FloatArray  # Y'S^-1 Y of each object point, (n, 3, 3)
    YQ: FloatArray  # Y'S^-1 of the object point x the pose of each image point, (k, 3, 6)
    YQ_border: FloatArray  # Y'S^-1 of each object point x the border, (n, 3, i + 3 s)


class Factor(Protocol):
    """The factored reduced normal matrix, with its null space held."""

    @property
    def further(self) -> FloatArray:
        """Null vectors that the datum does not explain, scaled, orthonormal, (reduced, e)."""

    def solve(self, right: FloatArray) -> FloatArray:
        """Return a solution of S x = right for right-hand sides (reduced,) or (reduced, r)."""

    def inverse(self, equations: Any, *, cross: bool) -> Inverse:
        """Return the elements of the inverse.

        Args:
            equations: the undamped normal equations that were factored.
            cross: whether to compute Y'S^-1; it is empty otherwise.
        """


class Solver(Protocol):
    """A way to store and factor the reduced normal matrix of one network."""

    @property
    def has_coarse(self) -> bool:
        """Whether an intermediate step takes less time in single precision."""

    @property
    def bytes(self) -> float:
        """Peak memory of factor and inverse without the results, bytes; a second thread takes 0.05 GB."""

    def factor(
        self, equations: Any, motions: Motions, *, damped: bool = False, coarse: bool = False
    ) -> Factor | None:
        """Return the factored reduced normal equations; None if they are not positive definite.

        Args:
            equations: normal equations with object points eliminated, of the kind that the solver takes.
            motions: null vectors that are motions, with their datum constraints.
            damped: whether the equations are damped; then no further null vectors are sought.
            coarse: whether to use single precision, for an intermediate step; the result is None if a pivot
                is too weak for it.
        """


@cache
def available_bytes() -> float:
    """Return the memory that normal equations may use, bytes; determined once, as it is read from files."""
    known = limit_bytes()
    return SHARE * (known if math.isfinite(known) else UNKNOWN)


def refuse_what_does_not_fit(size: float, unknowns: str) -> None:
    """Refuse normal equations that need more memory than is available.

    Args:
        size: memory of the equations, their factor and its inverse, bytes.
        unknowns: description of the unknowns, for the message.

    Raises:
        GeometryError: they need more.
    """
    limit = available_bytes()
    if size > limit:
        raise GeometryError(
            f"adjustment: {unknowns} need {size / 1e9:.0f} GB when they are factored and inverted, the "
            f"limit is {limit / 1e9:.0f} GB"
        )
