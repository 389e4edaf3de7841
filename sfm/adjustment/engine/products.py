"""Products of Y, the reduced rows of the object points, with steps and right sides.

Y is stored by image points and, for interior unknowns, by object points (`sfm.adjustment.engine.accumulate`).
"""

from __future__ import annotations

from sfm.adjustment.engine.accumulate import Blocks
from sfm.adjustment.engine.collinearity import Observations
from sfm.conventions import BoolArray, FloatArray
from sfm.kernels.options import kernel


@kernel
def step_points(
    observations: Observations, point_free: BoolArray, blocks: Blocks, dx: FloatArray, dX: FloatArray
) -> None:
    """Fill the step of the object points dX = -L^-T (y + Y'dx), dx of the reduced unknowns; 0 where fixed."""
    first = 6 * len(observations.camera)
    for j in range(len(dX)):
        h0, h1, h2 = blocks.y[j, 0], blocks.y[j, 1], blocks.y[j, 2]
        for q in range(blocks.Y_interior.shape[2]):
            d = dx[first + q]
            h0 += blocks.Y_interior[j, 0, q] * d
            h1 += blocks.Y_interior[j, 1, q] * d
            h2 += blocks.Y_interior[j, 2, q] * d
        for o in range(observations.start[j], observations.start[j + 1]):
            Y, column = blocks.Y[o], 6 * observations.image[o]
            for q in range(6):
                d = dx[column + q]
                h0 += Y[0, q] * d
                h1 += Y[1, q] * d
                h2 += Y[2, q] * d
        L = blocks.L[j]
        z = -h2 / L[2, 2]
        y = (-h1 - L[2, 1] * z) / L[1, 1]
        x = (-h0 - L[1, 0] * y - L[2, 0] * z) / L[0, 0]
        dX[j, 0] = x if point_free[j, 0] else 0.0
        dX[j, 1] = y if point_free[j, 1] else 0.0
        dX[j, 2] = z if point_free[j, 2] else 0.0


@kernel
def times_reduced(observations: Observations, blocks: Blocks, x: FloatArray, out: FloatArray) -> None:
    """Fill out with Y' x: x of the reduced unknowns, (reduced, d), out of the object points, (n, 3, d)."""
    first = 6 * len(observations.camera)
    out[:] = 0.0
    for j in range(len(out)):
        for p in range(3):
            for q in range(blocks.Y_interior.shape[2]):
                z = blocks.Y_interior[j, p, q]
                for e in range(x.shape[1]):
                    out[j, p, e] += z * x[first + q, e]
        for o in range(observations.start[j], observations.start[j + 1]):
            column = 6 * observations.image[o]
            for p in range(3):
                for q in range(6):
                    y = blocks.Y[o, p, q]
                    for e in range(x.shape[1]):
                        out[j, p, e] += y * x[column + q, e]


@kernel
def times_points(observations: Observations, blocks: Blocks, h: FloatArray, out: FloatArray) -> None:
    """Add Y h to out: h of the object points, (n, 3, d), out of the reduced unknowns, (reduced, d)."""
    first = 6 * len(observations.camera)
    for j in range(len(h)):
        for p in range(3):
            for q in range(blocks.Y_interior.shape[2]):
                z = blocks.Y_interior[j, p, q]
                for e in range(h.shape[2]):
                    out[first + q, e] += z * h[j, p, e]
        for o in range(observations.start[j], observations.start[j + 1]):
            column = 6 * observations.image[o]
            for p in range(3):
                for q in range(6):
                    y = blocks.Y[o, p, q]
                    for e in range(h.shape[2]):
                        out[column + q, e] += y * h[j, p, e]
