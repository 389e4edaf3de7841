"""The adjustment as a linear function of the errors of its image points, at the optimum.

With the whitened derivatives A (reduced unknowns) and B (eliminated object points), errors e of the image
points, in units of their standard deviations, move the unknowns by dx = Q M e with M = A' - W V^-1 B',
W = A'B and V = B'B with what is observed of points, and each point by V^-1 (B'e - W'dx).

Source: Foerstner and Wrobel (2016), sec. 4.2.1 and 15.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix

from sfm.adjustment.engine.collinearity import (
    Observations,
    State,
    Workspace,
    collinearity,
    new_workspace,
)
from sfm.adjustment.engine.iterate import Optimum
from sfm.adjustment.engine.normals import solve_lower
from sfm.adjustment.engine.solvers.protocol import Factor
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.kernels.options import kernel


@dataclass(frozen=True)
class Linearised:
    """Whitened derivatives of all image points, in the order of the layout, and the factor at the optimum."""

    layout: Unknowns
    factor: Factor
    A: csr_matrix  # by reduced unknowns, (2k, reduced)
    B: csr_matrix  # by eliminated points, (2k, 3n)
    V_inverse: csr_matrix  # of eliminated points, (3n, 3n)
    by_ray: FloatArray  # d X / d errors of each ray, (B V^-1), cameras fixed; 0 for kept points, (k, 2, 3)
    whitening: FloatArray  # F of each image point with F'F its weight, 1/px, (k, 2, 2)

    @property
    def through(self) -> csr_matrix:
        """W V^-1: what a reduced unknown takes from the points, (reduced, 3n)."""
        return self.A.T @ self.B @ self.V_inverse

    def cofactor(self) -> FloatArray:
        """Return a cofactor matrix of the reduced unknowns, in any datum, (reduced, reduced)."""
        return self.solve(np.eye(self.layout.reduced))

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the reduced unknowns of right sides of their normal equations, (reduced, e)."""
        free = self.layout.reduced_free()[:, None]
        return self.factor.solve(right * free) * free

    def residuals(self, errors: FloatArray) -> FloatArray:
        """Return the residuals that errors of the image points leave, whitened, both (2k, e)."""
        of_points = self.B.T @ errors
        dx = self.solve(self.A.T @ (errors - self.B @ (self.V_inverse @ of_points)))
        moved = self.A @ dx
        return np.asarray(errors - moved - self.B @ (self.V_inverse @ (of_points - self.B.T @ moved)))


def linearise(optimum: Optimum, layout: Unknowns, weight: FloatArray) -> Linearised:
    """Return the whitened derivatives of all image points at an optimum.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
        weight: factor on the weight of each image point, (k,).
    """
    o, b = layout.observations, optimum.equations.blocks
    k, n, f = len(o.image), len(b.L), int(o.free_count.max(initial=0))
    A, B = np.zeros((k, 2, 6 + f)), np.zeros((k, 2, 3))
    _fill(o, optimum.state, weight, new_workspace(), A, B)
    A[:, :, :6] *= layout.pose_free[o.pose][:, None]
    B *= layout.point_free[o.point][:, None]
    column = np.concatenate(
        [6 * o.pose[:, None] + np.arange(6), o.free_column[o.camera[o.image], :f]], axis=1
    )
    by_cameras = _of_rays(A, column, np.ones(k, dtype=bool), layout.reduced)
    slot = np.full(n, -1)
    slot[layout.kept] = np.arange(len(layout.kept))
    kept = slot[o.point] >= 0
    of_kept = layout.kept_start + 3 * slot[o.point[kept]][:, None] + np.arange(3)
    by_kept = _of_rays(B[kept], of_kept, kept, layout.reduced)
    of_point = 3 * o.point[~kept][:, None] + np.arange(3)
    half = solve_lower(b.L, np.tile(np.eye(3), (n, 1, 1)))
    V_inverse = half.transpose(0, 2, 1) @ half
    F = np.zeros((k, 2, 2))
    F[:, 0, 0], F[:, 1, 0], F[:, 1, 1] = (o.whitening * np.sqrt(weight)[:, None]).T
    return Linearised(
        layout,
        optimum.factor,
        by_cameras + by_kept if kept.any() else by_cameras,
        _of_rays(B[~kept], of_point, ~kept, 3 * n),
        csr_matrix(bsr_matrix((V_inverse, np.arange(n), np.arange(n + 1)))),
        np.where(kept[:, None, None], 0.0, B) @ V_inverse[o.point],
        F,
    )


def _of_rays(values: FloatArray, column: IntArray, which: BoolArray, columns: int) -> csr_matrix:
    """Return the derivatives of all image points, (2k, columns), of those of some.

    Args:
        values: derivatives of x and y by q unknowns each, (s, 2, q).
        column: of these unknowns, (s, q).
        which: image points with derivatives, s of them, (k,).
        columns: how many there are.
    """
    first = np.concatenate([[0], np.cumsum(np.repeat(which, 2) * column.shape[1])])
    entries = (values.ravel(), np.repeat(column, 2, axis=0).ravel(), first)
    return csr_matrix(entries, shape=(2 * len(which), columns))


@kernel
def _fill(
    observations: Observations,
    state: State,
    weight: FloatArray,
    workspace: Workspace,
    A: FloatArray,
    B: FloatArray,
) -> None:
    """Fill A (X0, w, free interior parameters) and B of all image points that take part."""
    for o in range(len(observations.image)):
        if weight[o] > 0.0:
            a = observations.camera[observations.image[o]]
            collinearity(o, observations, state, weight[o], workspace)
            for row in range(2):
                for p in range(6):
                    A[o, row, p] = workspace.A[row, p]
                for q in range(observations.free_count[a]):
                    A[o, row, 6 + q] = workspace.A[row, 6 + observations.free_index[a, q]]
                for p in range(3):
                    B[o, row, p] = workspace.B[row, p]
