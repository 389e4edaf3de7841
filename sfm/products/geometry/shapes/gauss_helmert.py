"""Gauss-Helmert adjustment of shapes, with equal weights or the covariance of the points.

Each point x has constraints d(x + v, p) = 0, and v' Q^-1 v is minimised. Linearised at the adjusted points,
B v + A dp + w = 0 with w = d + B (x - x_adjusted). The constraints have the cofactors Q_w = B Q B'; for a
single point with normal n this is n' Q n.

The covariance of a free network is singular. Q_w is singular if a motion of the network is also a motion of
the shape, for example if all points lie on one plane. Then W = Q_w + A U A' replaces it. Estimates, residuals
and v' Q^-1 v stay the same, and so does the covariance F Q F' = (A' W^-1 A)^-1 - U of the parameters. In
another datum of the network, the adjusted points and the shape move together; form, v' Q^-1 v and tests do
not change.

Source: Helmert (1907), Die Ausgleichungsrechnung; Pope (1972), Some pitfalls to be avoided in the iterative
adjustment of nonlinear problems; Rao (1973), Linear Statistical Inference, sec. 4i (unified theory); Ahn
(2004), Least Squares Orthogonal Distance Fitting of Curves and Surfaces in Space, ch. 3; Marquardt (1963),
SIAM J. 11(2); Nielsen (1999), Damping parameter in Marquardt's method.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.linalg.lapack import dpotri

from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.products.geometry.shapes.kinds import Shape

ORTHOGONAL_ITERATIONS = 400  # for equal weights; large residuals on short arcs converge slowly
FIRST_DAMPING = 1e-4
ORTHOGONAL_CONVERGED = 1e-15  # last step, relative to the unit size of the points
ITERATIONS = 100
CONVERGED = 1e-13  # last step, relative to the unit size of the points
SAME_NORMALS = 1e-9  # change of normals below which the weights are not recomputed
SINGULAR = 1e-6  # ratio of the smallest to the largest pivot of W below which it is singular
UNCHECKED = 1e-9  # redundancy of a constraint below which nothing checks it


@dataclass(frozen=True)
class WeightedFit:
    """A shape adjusted with the covariance of its points, and the equations at the solution."""

    shape: Shape
    adjusted: FloatArray  # points on the shape, (n, 3)
    normals: FloatArray  # B, derivatives of each constraint by its point, (n, c, 3)
    design: FloatArray  # A, derivatives of the constraints by the free parameters, (n c, u)
    linear: FloatArray  # F, derivatives of the parameters by the coordinates, (u, 3 n)
    omega: float  # v' Q^-1 v
    standardised: FloatArray  # test of each point: w, or the root of T of two constraints, (n,)
    converged: bool


def refine_weighted(
    start: Shape,
    xyz: FloatArray,
    covariance: FloatArray,
    *,
    free: BoolArray,
    offset: FloatArray,
    size: float = 1.0,
    placed: bool = True,
) -> WeightedFit:
    """Return the shape with the least v' Q^-1 v near a start.

    Args:
        start: fit with equal weights.
        xyz: points about their centroid, of unit size, (n, 3).
        covariance: Q, joint (3 n, 3 n) or of each point (n, 3, 3), in any unit of length.
        free: which of the six motions and the form are adjusted, (6 + q,).
        offset: required signed distances of the points, (c,).
        size: unit of the points in the unit of the covariance.
        placed: whether the origin may be anywhere along the axis.

    Raises:
        GeometryError: the covariance is singular beyond the effect of the free parameters, or the adjustment
            diverges.
    """
    n = len(xyz)
    nothing = np.zeros(3)
    shape = start.placed(nothing) if placed else start
    d, B, _ = shape.design(xyz)
    adjusted = xyz - np.einsum("nc,nci->ni", d - offset, B)
    converged = False
    factored = np.full_like(B, np.inf)  # normals used for the weights
    for _ in range(ITERATIONS):
        d, B, A = shape.design(adjusted)
        w = (d - offset + np.einsum("nci,ni->nc", B, xyz - adjusted)).ravel()
        A = A[..., free].reshape(len(w), -1)
        if not np.abs(B - factored).max(initial=0.0) < SAME_NORMALS:
            Qw = constraint_covariance(covariance, B) / size**2
            # roots of the diagonal U, the precision of each parameter from a typical constraint
            variance = float(np.einsum("nii->", Qw) / len(A) if Qw.ndim == 3 else np.trace(Qw) / len(A))
            unit = np.asarray(np.sqrt(variance / np.maximum((A**2).mean(axis=0), 1e-300)))
            solve, factored = _factor(Qw, A * unit), B
        PA = solve(A)
        N = A.T @ PA
        try:
            dp = -np.linalg.solve(N, PA.T @ w)
        except LinAlgError:
            dp = np.full(len(N), np.nan)
        if not np.isfinite(dp).all():
            raise GeometryError(
                "the fit diverges with the covariance of its points: they are too far from any "
                f'{shape.kind.name}; expected weights = "equal"'
            )
        k = -solve(w + A @ dp)
        v = times_covariance(covariance, B, k) / size**2
        step = np.zeros(len(free))
        step[free] = dp
        shape = shape.moved(step, nothing) if placed else moved_in_place(shape, step)
        change = max(float(np.abs(step).max()), float(np.abs(xyz + v - adjusted).max()))
        adjusted = xyz + v
        if change <= CONVERGED * max(1.0, float(np.abs(shape.form).max(initial=0.0))):
            converged = True
            break
    inverse: FloatArray = np.asarray(np.linalg.inv(N))
    linear = -(inverse @ PA.T)
    by_point = linear.reshape(len(dp), n, -1)
    return WeightedFit(
        shape,
        adjusted,
        B,
        A,
        np.asarray(np.einsum("unc,nci->uni", by_point, B).reshape(len(dp), 3 * n)),
        max(float(-k @ (w + A @ dp)), 0.0),
        _tests(k, solve, PA, inverse, n),
        converged,
    )


def constraint_covariance(covariance: FloatArray, normals: FloatArray) -> FloatArray:
    """Return Q_w = B Q B', of all constraints (n c, n c), or of the constraints of each point (n, c, c).

    Args:
        covariance: Q, joint (3 n, 3 n) or of each point (n, 3, 3).
        normals: B, (n, c, 3).
    """
    if covariance.ndim == 3:
        return np.asarray(np.einsum("nai,nij,nbj->nab", normals, covariance, normals))
    n, c, _ = normals.shape
    Qw = np.empty((n, c, n, c))
    for a in range(c):
        half = sum((normals[:, a, i, None] * covariance[i::3] for i in range(3)), start=np.zeros(()))
        for b in range(a, c):
            block = sum((half[:, i::3] * normals[:, b, i] for i in range(3)), start=np.zeros(()))
            Qw[:, a, :, b] = block
            if b > a:
                Qw[:, b, :, a] = block.T
    return np.asarray(Qw.reshape(n * c, n * c))


def times_covariance(covariance: FloatArray, normals: FloatArray, k: FloatArray) -> FloatArray:
    """Return the residuals v = Q B' k, (n, 3).

    Args:
        covariance: Q, joint (3 n, 3 n) or of each point (n, 3, 3).
        normals: B, (n, c, 3).
        k: correlates, (n c,).
    """
    n, c, _ = normals.shape
    back = np.einsum("nci,nc->ni", normals, k.reshape(n, c))
    if covariance.ndim == 3:
        return np.asarray(np.einsum("nij,nj->ni", covariance, back))
    return np.asarray((covariance @ back.ravel()).reshape(n, 3))


class _Blocks:
    """W of uncorrelated points: Q_w block by block, and A U A' by Woodbury's formula."""

    def __init__(self, Qw: FloatArray, AU: FloatArray) -> None:
        self.inverse = np.linalg.inv(Qw)
        self.AU = AU
        weighted = self._weighted(AU)
        self.core = np.linalg.inv(np.eye(AU.shape[1]) + AU.T @ weighted)
        self.weighted = weighted

    def _weighted(self, b: FloatArray) -> FloatArray:
        n, c, _ = self.inverse.shape
        return np.asarray(np.einsum("nab,nbk->nak", self.inverse, b.reshape(n, c, -1)).reshape(n * c, -1))

    def __call__(self, b: FloatArray) -> FloatArray:
        x = self._weighted(b)
        x = x - self.weighted @ (self.core @ (self.AU.T @ x))
        return x[:, 0] if b.ndim == 1 else x


class _Dense:
    """W of correlated points."""

    def __init__(self, Qw: FloatArray, AU: FloatArray) -> None:
        W = AU @ AU.T
        W += Qw
        self.factor = cho_factor(W, lower=True, overwrite_a=True, check_finite=False)

    def inverse_blocks(self, n: int, c: int) -> FloatArray:
        """Return the diagonal blocks of the inverse, (n, c, c)."""
        lower, _ = dpotri(self.factor[0], lower=True)
        W = lower.reshape(n, c, n, c)[np.arange(n), :, np.arange(n), :]
        return np.asarray(np.tril(W) + np.tril(W, -1).transpose(0, 2, 1))

    def __call__(self, b: FloatArray) -> FloatArray:
        return np.asarray(cho_solve(self.factor, b, check_finite=False))


def _factor(Qw: FloatArray, AU: FloatArray) -> _Blocks | _Dense:
    try:
        if Qw.ndim == 3:
            return _Blocks(Qw, AU)
        solve = _Dense(Qw, AU)
        diagonal = np.diagonal(solve.factor[0])
        if diagonal.min() < SINGULAR * diagonal.max():
            raise LinAlgError
        return solve
    except LinAlgError as error:
        raise GeometryError(
            "the covariance of its points is singular: a free network does not determine the held values, or "
            'points are exactly known; expected weights = "equal"'
        ) from error


def _tests(k: FloatArray, solve: _Blocks | _Dense, PA: FloatArray, inverse: FloatArray, n: int) -> FloatArray:
    """Return for each point the root of k' Q_kk^-1 k over the number of its constraints, (n,).

    For a single constraint this is Baarda's w.
    """
    c = len(k) // n
    if isinstance(solve, _Blocks):
        AU = solve.weighted.reshape(n, c, -1)
        blocks = solve.inverse - np.einsum("nau,uv,nbv->nab", AU, solve.core, AU)
    else:
        blocks = solve.inverse_blocks(n, c)
    scale = np.einsum("naa->n", blocks)[:, None]
    by_point = PA.reshape(n, c, -1)
    blocks = blocks - np.einsum("nau,uv,nbv->nab", by_point, inverse, by_point)
    ks = k.reshape(n, c)
    values, vectors = np.linalg.eigh(blocks)
    along = np.einsum("nab,na->nb", vectors, ks)
    checked = values > UNCHECKED * scale
    squares = np.where(checked, along**2 / np.where(checked, values, 1.0), 0.0).sum(axis=1)
    return np.where(checked.any(axis=1), np.sqrt(squares / np.maximum(checked.sum(axis=1), 1)), np.nan)


def refine_orthogonal(
    start: Shape,
    xyz: FloatArray,
    *,
    free: BoolArray,
    offset: FloatArray,
    weight: FloatArray | None = None,
    placed: bool = True,
    iterations: int = ORTHOGONAL_ITERATIONS,
) -> tuple[Shape, float, bool]:
    """Return the shape with the least sum of squared distances near a start.

    Args:
        start: shape to start from.
        xyz: points about their centroid, of unit size, (n, 3).
        free: which of the six motions and the form are adjusted, (6 + q,).
        offset: required signed distances of the points, (c,).
        weight: weight of each point, (n,); equal if not given.
        placed: whether the origin may be anywhere along the axis.
        iterations: largest number of iterations.

    Returns:
        The shape, the weighted sum of squares, and whether it converged.
    """
    root = np.ones(len(xyz)) if weight is None else np.sqrt(weight)
    nothing = np.zeros(3)
    shape = start.placed(nothing) if placed else start

    def system(at: Shape) -> tuple[FloatArray, FloatArray]:
        d, _, A = at.design(xyz)
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
        if size <= ORTHOGONAL_CONVERGED * max(1.0, float(np.abs(shape.form).max(initial=0.0))):
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
            # rounding hides the gain, but the gradient still shows the direction
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
    """Return the shape after a step, without shifting its origin along the axis.

    Args:
        shape: the shape.
        step: shifts and rotations in the axes of the shape, and of the form, (6 + q,).
    """
    moved = shape.moved(step, shape.origin)
    return Shape(moved.kind, shape.origin + shape.rotation @ step[:3], moved.rotation, shape.form + step[6:])
