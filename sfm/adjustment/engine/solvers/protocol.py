"""Interface of the solvers of the reduced normal equations, whichever way the matrix is stored.

The reduced normal matrix S of orientations and kept points is factored once for each step; its factor
solves for the step and, at the optimum, gives the elements of S^-1 that covariances are made of.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from sfm.adjustment.engine.accumulate import Blocks
from sfm.adjustment.engine.motions import Motions
from sfm.adjustment.engine.normals import Equations
from sfm.conventions import FloatArray


@dataclass(frozen=True)
class Inverse:
    """Elements of S^-1, in the units of the unknowns, 0 where they are fixed."""

    exterior: FloatArray  # of X0, w of each pose, (poses, 6, 6)
    mixed: FloatArray  # of poses by border unknowns, (6 poses, i + 3 s)
    border: FloatArray  # of interior unknowns, mounts and kept points, (i + 3 s, i + 3 s)
    core: FloatArray  # Y'S^-1 Y of each object point, (n, 3, 3)
    YQ: FloatArray  # Y'S^-1 of the object point by the pose of each image point, (k, 3, 6)
    YQ_border: FloatArray  # Y'S^-1 of each object point by the border, (n, 3, i + 3 s)


class Factor(Protocol):
    """The factored reduced normal matrix, its null space held."""

    @property
    def further(self) -> FloatArray:
        """Null vectors that the datum does not explain, scaled, orthonormal, (reduced, e)."""

    def solve(self, right: FloatArray) -> FloatArray:
        """Return a solution of S x = right for one or several right sides, (reduced,) or (reduced, r)."""

    def inverse(self, blocks: Blocks, *, cross: bool) -> Inverse:
        """Return the elements of the inverse.

        Args:
            blocks: of the undamped normal equations.
            cross: whether Y'S^-1 is wanted; empty otherwise.
        """


class Solver(Protocol):
    """A way to store and factor the reduced normal matrix of one network."""

    @property
    def has_coarse(self) -> bool:
        """Whether a step on the way takes less time in single precision."""

    @property
    def bytes(self) -> float:
        """Memory of the factor and its inverse at the peak, results apart; a second thread takes 0.05 GB."""

    def factor(
        self, equations: Equations, motions: Motions, *, damped: bool = False, coarse: bool = False
    ) -> Factor | None:
        """Return the factored reduced normal equations; None if they are not positive definite.

        Args:
            equations: normal equations with object points eliminated.
            motions: null vectors that the datum explains.
            damped: whether the equations carry damping, so that no further null vectors are sought.
            coarse: whether single precision will do, for a step on the way; None if that is too weak.
        """
