"""Normal equations of all image points, reduced to orientations and kept points by the Schur complement.

With N = (U W; W' V), V block diagonal with one L L' per object point, and Y = W L^-T, the reduced normal
equations are (U - Y Y') dx = -(g - Y y), y = L^-1 g_points. Unknowns are scaled so that the diagonal of U
is 1. Y Y' is summed as one dense product, or pair by pair of rays into fronts, whichever is less work
(`sfm.adjustment.engine.solvers.choice`).

Products of Y with steps and right-hand sides use Y as `sfm.adjustment.engine.accumulate` stores it: by image
points and, for interior unknowns, by object points.

Source: Brown (1958, 1976); Mikhail, Bethel and McGlone (2001), sec. 5.8; Foerstner and Wrobel (2016), sec.
15.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.sparse import csr_matrix

from sfm.adjustment.engine.accumulate import (
    RESIDUAL,
    Blocks,
    Sums,
    add_photographs,
    eliminate_points,
    gather_interior,
    sum_poses,
)
from sfm.adjustment.engine.collinearity import Observations, State, new_workspace
from sfm.adjustment.engine.observed import GivenTerms, ObservedKind, terms_of
from sfm.adjustment.engine.ordering import by_photograph
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.runtime.compiling import kernel
from sfm.runtime.threads import at_once

# Number of image points from which two halves of the photographs are summed separately. A second thread takes
# 0.1 ms to start and saves 0.07 microseconds per image point.
MIN_HALVED_POINTS = 8_000
SUMMED = ("D", "gi", "V", "gp", "Y_interior")  # parts of `Sums` that both halves add to


class Space(NamedTuple):
    """Reusable memory for normal equations."""

    blocks: Blocks
    sums: tuple[Sums, ...]  # sums of all photographs, or of each half; the first share arrays with `blocks`


class Parts(NamedTuple):
    """Reduced normal equations before Y Y' is subtracted, without the exterior diagonal blocks."""

    border: FloatArray  # X0, w of poses x interior unknowns, mounts and kept points, (6 poses, i + 3 s)
    corner: FloatArray  # interior unknowns, mounts and kept points, (i + 3 s, i + 3 s)
    coupled: csr_matrix | None  # poses x poses, from observations of two poses; None without, (6 poses,) * 2
    g: FloatArray  # reduced right-hand side, (reduced,)
    scale: FloatArray  # 1/sqrt of the diagonal of U, (reduced,)


class NormalEquations(Protocol):
    """Normal equations at a state with object points eliminated, whoever keeps Y."""

    @property
    def vPv(self) -> float:
        """Weighted sum of squares at the state; infinite if a point is behind a camera."""

    @property
    def g(self) -> FloatArray:
        """Reduced right-hand side, (reduced,)."""

    @property
    def scale(self) -> FloatArray:
        """1/sqrt of the diagonal of U, (reduced,)."""

    @property
    def held(self) -> IntArray:
        """Number of directions of each point that had to be held, (n,)."""

    @property
    def y_squared(self) -> float:
        """Y'y of the eliminated points."""

    @property
    def lower(self) -> FloatArray:
        """Cholesky factors of V; unit matrix for kept points, (n, 3, 3)."""

    def normals_of(self, points: IntArray) -> FloatArray:
        """Return V of some object points before elimination, (p, 3, 3)."""

    def point_step(self, reduced_step: FloatArray) -> FloatArray:
        """Return the step of all object points that belongs to a step of the reduced unknowns, (n, 3)."""

    def times_schur(self, x: FloatArray) -> FloatArray:
        """Return S x with the undamped reduced normal matrix S, without forming S, (reduced, e)."""

    def times_reduced(self, x: FloatArray) -> FloatArray:
        """Return Y'x of vectors of the reduced unknowns (reduced, e), (n, 3, e)."""

    def times_points(self, h: FloatArray) -> FloatArray:
        """Return Y h of vectors of the object points (n, 3, e), (reduced, e)."""

    def through(self, points: IntArray) -> FloatArray:
        """Return Y L^-1, the effect of the reduced unknowns on some object points, (reduced, 3 p)."""


@dataclass(frozen=True)
class Equations:
    """Normal equations at a state, with object points eliminated but Y Y' not yet subtracted."""

    layout: Unknowns
    blocks: Blocks
    parts: Parts
    damping: float  # share of its diagonal added to the whole normal matrix
    vPv: float  # weighted sum of squares at the state; infinite if a point is behind a camera

    @property
    def g(self) -> FloatArray:
        """Reduced right-hand side, (reduced,)."""
        return self.parts.g

    @property
    def scale(self) -> FloatArray:
        """1/sqrt of the diagonal of U, (reduced,)."""
        return self.parts.scale

    @property
    def held(self) -> IntArray:
        """Number of directions of each point that had to be held, (n,)."""
        return self.blocks.held

    @property
    def y_squared(self) -> float:
        """Y'y of the eliminated points."""
        y = self.blocks.y.ravel()
        return float(y @ y)

    @property
    def lower(self) -> FloatArray:
        """Cholesky factors of V; unit matrix for kept points, (n, 3, 3)."""
        return self.blocks.L

    def normals_of(self, points: IntArray) -> FloatArray:
        """Return V of some object points before elimination, (p, 3, 3)."""
        return self.blocks.V[points]

    def point_step(self, reduced_step: FloatArray) -> FloatArray:
        """Return the step of all object points that belongs to a step of the reduced unknowns.

        Args:
            reduced_step: step of the reduced unknowns, (reduced,).

        Returns:
            Steps, (n, 3).
        """
        layout, dX = self.layout, np.empty_like(self.blocks.y)
        step_points(layout.observations, layout.point_free, self.blocks, reduced_step, dX)
        if len(layout.kept):
            dX[layout.kept] = (
                reduced_step[layout.kept_start :].reshape(-1, 3) * layout.point_free[layout.kept]
            )
        return dX

    def times_schur(self, x: FloatArray) -> FloatArray:
        """Return S x with the undamped reduced normal matrix S, without forming S, (reduced, e).

        Args:
            x: vectors, (reduced, e).
        """
        b, parts = self.blocks, self.parts
        first, e = 6 * len(b.U), x.shape[1]
        product = -self.times_points(self.times_reduced(x))
        product[:first] += (b.U @ x[:first].reshape(len(b.U), 6, e)).reshape(first, e)
        product[:first] += parts.border @ x[first:]
        product[first:] += parts.border.T @ x[:first] + parts.corner @ x[first:]
        if parts.coupled is not None:
            product[:first] += parts.coupled @ x[:first]
        return product

    def times_reduced(self, x: FloatArray) -> FloatArray:
        """Return Y'x of vectors of the reduced unknowns (reduced, e), (n, 3, e)."""
        out = np.empty((len(self.blocks.y), 3, x.shape[1]))
        times_reduced(self.layout.observations, self.blocks, np.ascontiguousarray(x), out)
        return out

    def times_points(self, h: FloatArray) -> FloatArray:
        """Return Y h of vectors of the object points (n, 3, e), (reduced, e)."""
        out = np.zeros((self.layout.reduced, h.shape[2]))
        times_points(self.layout.observations, self.blocks, np.ascontiguousarray(h), out)
        return out

    def through(self, points: IntArray) -> FloatArray:
        """Return Y L^-1, the effect of the reduced unknowns on some object points, (reduced, 3 p)."""
        b, observations, m = self.blocks, self.layout.observations, len(self.blocks.U)
        through = np.zeros((self.layout.reduced, 3 * len(points)))
        of_poses = through[: 6 * m].reshape(m, 6, -1)
        of_interior = through[6 * m :][: b.Y_interior.shape[2]]
        inverse = solve_lower(b.L[points], np.tile(np.eye(3), (len(points), 1, 1)))
        for s, j in enumerate(points):
            seen = slice(observations.start[j], observations.start[j + 1])
            at = slice(3 * s, 3 * s + 3)
            rays = np.swapaxes(b.Y[seen], 1, 2) @ inverse[s]
            np.add.at(of_poses[:, :, at], observations.pose[seen], rays)
            of_interior[:, at] = b.Y_interior[j].T @ inverse[s]
        return through


def normal_equations(
    layout: Unknowns,
    observed: tuple[ObservedKind, ...],
    state: State,
    weight: FloatArray,
    *,
    damping: float = 0.0,
    space: Space | None = None,
) -> Equations:
    """Return the normal equations at a state with object points eliminated.

    Args:
        layout: order of the unknowns.
        observed: observations other than image points.
        state: values of all parameters.
        weight: factor on the weight of each image point, 0 = takes no part, shape (k,).
        damping: share of its diagonal added to the whole normal matrix (Marquardt); 0 without damping.
        space: memory to reuse; new memory if not given.
    """
    space = new_space(layout) if space is None else space
    b = space.blocks
    b.V.fill(0.0)
    b.gp.fill(0.0)
    terms = terms_of(observed, layout, state, b.V, b.gp)
    return reduced_to_orientations(layout, terms, state, weight, damping, space)


def reduced_to_orientations(
    layout: Unknowns, terms: GivenTerms, state: State, weight: FloatArray, damping: float, space: Space
) -> Equations:
    """Return the normal equations of image points and given terms, with object points eliminated.

    Args:
        layout: order of the unknowns.
        terms: terms of observations other than image points; those of points are in V and gp of `space`.
        state: values of all parameters.
        weight: factor on the weight of each image point, (k,).
        damping: share of its diagonal added to the whole normal matrix.
        space: memory of the equations.
    """
    b = space.blocks
    slot = np.full(len(state.points), -1, dtype=np.int64)
    slot[layout.kept] = np.arange(len(layout.kept))
    vPv = _sum_photographs(layout, state, weight, space)
    eliminate_points(layout.observations, layout.point_free, slot, layout.kept_start, 1 + damping, b)
    return Equations(layout, b, _parts(layout, terms, b), damping, vPv + terms.vPv)


def _sum_photographs(layout: Unknowns, state: State, weight: FloatArray, space: Space) -> float:
    """Fill the blocks of all photographs and return v'Pv; halves do not depend on the number of threads."""
    b = space.blocks

    def add(s: Sums) -> float:
        return float(
            add_photographs(layout.observations, state, weight, layout.pose_free, new_workspace(), s, b)
        )

    if len(space.sums) == 1:
        vPv = add(space.sums[0])
    else:
        half, other = space.sums
        other.V.fill(0.0)
        other.gp.fill(0.0)
        vPv = sum(at_once(lambda: add(half), lambda: add(other)))
        for name in SUMMED:
            total: FloatArray = getattr(half, name)
            total += getattr(other, name)
    if layout.rigged:
        sum_poses(layout.observations, layout.pose_free, space.sums[0], b)
    return vPv


def _parts(layout: Unknowns, terms: GivenTerms, b: Blocks) -> Parts:
    """Gather the blocks of interior unknowns, kept points and observations other than image points."""
    first = 6 * len(b.U)
    inner = layout.kept_start - first
    border = np.zeros((first, layout.reduced - first))
    corner = np.zeros((layout.reduced - first, layout.reduced - first))
    g = np.zeros(layout.reduced)
    gather_interior(layout.observations, b, border, corner, g)
    if len(layout.kept):
        border[:, inner:] = b.K[:, :first].T
        corner[:inner, inner:] = b.K[:, first : layout.kept_start].T
        corner[inner:, :inner] = b.K[:, first : layout.kept_start]
        corner[inner:, inner:] = b.K[:, layout.kept_start :]
        g[layout.kept_start :] = b.gp[layout.kept].ravel()
    coupled = terms.add_to(b.U, border, corner, g)
    if len(layout.kept):
        fixed = np.flatnonzero(~layout.point_free[layout.kept].ravel()) + inner
        border[:, fixed] = corner[fixed] = corner[:, fixed] = 0.0
        corner[fixed, fixed] = 1.0
        g[first + fixed] = 0.0
    diagonal = np.concatenate([np.diagonal(b.U, axis1=1, axis2=2).ravel(), corner.diagonal()])
    scale = 1 / np.sqrt(np.maximum(diagonal, np.finfo(float).tiny))
    with np.errstate(invalid="ignore"):  # equations that are not finite are refused when they are solved
        g -= b.Yy
    return Parts(border, corner, coupled, g, scale)


def solve_lower(L: FloatArray, h: FloatArray) -> FloatArray:
    """Return L^-1 h of every point, (n, 3, d).

    Args:
        L: lower triangular factors, (n, 3, 3).
        h: right-hand sides, (n, 3, d).
    """
    x = np.empty_like(h)
    x[:, 0] = h[:, 0] / L[:, 0, 0, None]
    x[:, 1] = (h[:, 1] - L[:, 1, 0, None] * x[:, 0]) / L[:, 1, 1, None]
    x[:, 2] = (h[:, 2] - L[:, 2, 0, None] * x[:, 0] - L[:, 2, 1, None] * x[:, 1]) / L[:, 2, 2, None]
    return x


def solve_transposed(L: FloatArray, h: FloatArray) -> FloatArray:
    """Return L^-T h of every point, (n, 3, d).

    Args:
        L: lower triangular factors, (n, 3, 3).
        h: right-hand sides, (n, 3, d).
    """
    x = np.empty_like(h)
    x[:, 2] = h[:, 2] / L[:, 2, 2, None]
    x[:, 1] = (h[:, 1] - L[:, 2, 1, None] * x[:, 2]) / L[:, 1, 1, None]
    x[:, 0] = (h[:, 0] - L[:, 1, 0, None] * x[:, 1] - L[:, 2, 0, None] * x[:, 2]) / L[:, 0, 0, None]
    return x


def new_space(layout: Unknowns) -> Space:
    """Return memory for the normal equations of a network.

    Args:
        layout: order of the unknowns.
    """
    m, n, k = len(layout.image_on), len(layout.point_free), len(layout.observations.point)
    a, poses = len(layout.interior_free), len(layout.pose_free)
    f = int(layout.observations.free_count.max())
    order, first = by_photograph(layout.observations.image, m)
    most = int(np.diff(first).max())
    width = -(-(RESIDUAL + 1 + f) // 4) * 4  # whole vector registers
    b = Blocks(
        U=np.empty((poses, 6, 6)),
        C=np.empty((m, 6, f)),
        D=np.empty((a, f, f)),
        g=np.empty((poses, 6)),
        gi=np.empty((a, f)),
        V=np.empty((n, 3, 3)),
        gp=np.empty((n, 3)),
        L=np.empty((n, 3, 3)),
        y=np.empty((n, 3)),
        Y=np.empty((k, 3, 6)),
        Y_interior=np.empty((n, 3, layout.kept_start - 6 * poses)),
        Yy=np.empty(layout.reduced),
        K=np.zeros((3 * len(layout.kept), layout.reduced)),
        held=np.zeros(n, dtype=np.int64),
        order=order,
        first=first,
    )
    U, g = (np.empty((m, 6, 6)), np.empty((m, 6))) if layout.rigged else (b.U, b.g)
    sums = Sums(0, m, U, g, b.D, b.gi, b.V, b.gp, b.Y_interior, np.zeros((2 * most, width)))
    if k < MIN_HALVED_POINTS:
        return Space(b, (sums,))
    separate = {name: np.zeros_like(getattr(sums, name)) for name in SUMMED}
    middle = int(np.searchsorted(first, k // 2))
    other = sums._replace(first=middle, A=np.zeros_like(sums.A), **separate)
    return Space(b, (sums._replace(end=middle), other))


@kernel
def step_points(
    observations: Observations, point_free: BoolArray, blocks: Blocks, dx: FloatArray, dX: FloatArray
) -> None:
    """Fill the step of the object points, dX = -L^-T (y + Y'dx); 0 where fixed.

    Args:
        observations: image points.
        point_free: free coordinates, (n, 3).
        blocks: filled blocks.
        dx: step of the reduced unknowns, (reduced,).
        dX: receives the step of the object points, (n, 3).
    """
    first = 6 * observations.poses
    for j in range(len(dX)):
        h0, h1, h2 = blocks.y[j, 0], blocks.y[j, 1], blocks.y[j, 2]
        for q in range(blocks.Y_interior.shape[2]):
            d = dx[first + q]
            h0 += blocks.Y_interior[j, 0, q] * d
            h1 += blocks.Y_interior[j, 1, q] * d
            h2 += blocks.Y_interior[j, 2, q] * d
        for o in range(observations.start[j], observations.start[j + 1]):
            Y, column = blocks.Y[o], 6 * observations.pose[o]
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
    """Fill `out` with Y' x.

    Args:
        observations: image points.
        blocks: filled blocks.
        x: vectors of the reduced unknowns, (reduced, d).
        out: vectors of the object points, (n, 3, d).
    """
    first = 6 * observations.poses
    out[:] = 0.0
    for j in range(len(out)):
        for p in range(3):
            for q in range(blocks.Y_interior.shape[2]):
                z = blocks.Y_interior[j, p, q]
                for e in range(x.shape[1]):
                    out[j, p, e] += z * x[first + q, e]
        for o in range(observations.start[j], observations.start[j + 1]):
            column = 6 * observations.pose[o]
            for p in range(3):
                for q in range(6):
                    y = blocks.Y[o, p, q]
                    for e in range(x.shape[1]):
                        out[j, p, e] += y * x[column + q, e]


@kernel
def times_points(observations: Observations, blocks: Blocks, h: FloatArray, out: FloatArray) -> None:
    """Add Y h to `out`.

    Args:
        observations: image points.
        blocks: filled blocks.
        h: vectors of the object points, (n, 3, d).
        out: vectors of the reduced unknowns, (reduced, d).
    """
    first = 6 * observations.poses
    for j in range(len(h)):
        for p in range(3):
            for q in range(blocks.Y_interior.shape[2]):
                z = blocks.Y_interior[j, p, q]
                for e in range(h.shape[2]):
                    out[first + q, e] += z * h[j, p, e]
        for o in range(observations.start[j], observations.start[j + 1]):
            column = 6 * observations.pose[o]
            for p in range(3):
                for q in range(6):
                    y = blocks.Y[o, p, q]
                    for e in range(h.shape[2]):
                        out[column + q, e] += y * h[j, p, e]
