"""Orthogonal-distance fits with equal or single weights, by Levenberg and Marquardt.

Source: Ahn (2004), Least Squares Orthogonal Distance Fitting of Curves and Surfaces in Space, ch. 3;
Marquardt (1963), SIAM J. 11(2); Nielsen (1999), Damping parameter in Marquardt's method.
"""

from __future__ import annotations

import numpy as np

from sfm.conventions import BoolArray, FloatArray
from sfm.geometry.shapes.shape import Shape

ITERATIONS = 400  # large residuals on short arcs converge slowly
FIRST_DAMPING = 1e-4
CONVERGED = 1e-15  # step over the unit size of the points


def refine_orthogonal(
    start: Shape,
    xyz: FloatArray,
    *,
    free: BoolArray,
    offset: FloatArray,
    weight: FloatArray | None = None,
    placed: bool = True,
    iterations: int = ITERATIONS,
) -> tuple[Shape, float, bool]:
    """Return the shape of the least sum of squared distances near a start.

    Args:
        start: shape to start from.
        xyz: points about their centroid, of unit size, (n, 3).
        free: which of the six motions and the form are adjusted, (6 + q,).
        offset: signed distances that the points shall have, (c,).
        weight: of each point, (n,); equal if not given.
        placed: whether the origin may be anywhere along the axis.
        iterations: at most.

    Returns:
        The shape, the weighted sum of squares, and whether it converged.
    """
    root = np.ones(len(xyz)) if weight is None else np.sqrt(weight)
    nothing = np.zeros(3)
    shape = start.placed(nothing) if placed else start

    def system(one: Shape) -> tuple[FloatArray, FloatArray]:
        d, _, A = one.design(xyz)
        return ((d - offset) * root[:, None]).ravel(), (A[..., free] * root[:, None, None]).reshape(
            d.size, -1
        )

    e, A = system(shape)
    cost = float(e @ e)
    damping, growth = FIRST_DAMPING, 2.0
    for _ in range(iterations):
        N, h = A.T @ A, A.T @ e
        level = np.maximum(np.diagonal(N), 1e-12 * np.trace(N) + 1e-300)
        step = np.zeros(len(free))
        step[free] = -np.linalg.solve(N + damping * np.diag(level), h)
        size = float(np.abs(step).max())
        if not np.isfinite(size):
            return shape, cost, False
        if size <= CONVERGED * max(1.0, float(np.abs(shape.form).max(initial=0.0))):
            return shape, cost, True
        trial = shape.moved(step, nothing) if placed else moved_in_place(shape, step)
        new_e, new_A = system(trial)
        new_cost = float(new_e @ new_e)
        foreseen = float(step[free] @ (damping * level * step[free] - h))
        if new_cost < cost and np.isfinite(new_A).all():
            gain = (cost - new_cost) / max(foreseen, 1e-300)
            shape, e, A, cost = trial, new_e, new_A, new_cost
            damping *= max(1 / 3, 1 - (2 * min(gain, 2.0) - 1) ** 3)
            growth = 2.0
        elif abs(new_cost - cost) <= 1e-13 * cost and size < 1e-5:
            # rounding hides the gain: the gradient still shows where to go
            if float(np.abs(new_A.T @ new_e).max()) >= float(np.abs(h).max()):
                return shape, cost, True
            shape, e, A, cost = trial, new_e, new_A, new_cost
        else:
            damping *= growth
            growth *= 2
            if damping > 1e20:
                return shape, cost, size < 1e-6
    return shape, cost, False


def moved_in_place(shape: Shape, step: FloatArray) -> Shape:
    """Return the shape after a step with its origin where the step leaves it."""
    moved = shape.moved(step, shape.origin)
    return Shape(moved.kind, shape.origin + shape.rotation @ step[:3], moved.rotation, shape.form + step[6:])
