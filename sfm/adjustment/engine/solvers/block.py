"""What is computed of one block of photographs: its normal equations, and their reduction to the interface.

With the inner poses I of a block, the poses R of the interface and the border B, its normal equations without
object points are

    (A_II  A_IR  C_I)        A_II = L L'  in fronts (`multifrontal`),
    (A_RI  A_RR  C_R)        K = A_RI L^-T,   E = L^-1 C_I
    (C_I'  C_R'  D  )

and its part of the normal equations of the interface is exact:

    (A_RR - K K'      C_R - K E)
    (    .            D - E'E  )        right-hand side  g_R - K h,  g_B - E'h,   h = L^-1 g_I

Every function here takes what the one before returned, which stays in the process of the block. Only parts of
the interface, and the values and steps of its own unknowns, are sent.

Source: Helmert (1880); Wolf (1978); Duff and Reid (1983), ACM Trans. Math. Softw. 9(3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dtrttp

from sfm.adjustment.engine.collinearity import State, sum_of_squares
from sfm.adjustment.engine.normals import Equations, new_space, reduced_to_orientations
from sfm.adjustment.engine.solvers.fronts import Fronts, fronts_of
from sfm.adjustment.engine.solvers.multifrontal import border_of, eliminate_below, extend, sum_front
from sfm.adjustment.engine.solvers.multifrontal_factor import (
    BorderInverse,
    EliminatedFront,
    eliminate_right,
    inverse_fronts,
    inverse_of,
    substitute_back,
)
from sfm.adjustment.engine.solvers.partition import graph_of, repeated, unpacked
from sfm.adjustment.engine.solvers.protocol import Inverse
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.model.conventions import FloatArray, IntArray

NO_POINTS = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class Block:
    """A block with its fronts, of which the last is the interface."""

    layout: Unknowns
    inner: int  # number of inner poses, which come first
    fronts: Fronts


@dataclass(frozen=True)
class OwnTerms:
    """Terms of a block from observations other than image points, as `sfm.adjustment.engine.observed`."""

    points: IntArray  # object points with terms, (p,)
    V: FloatArray  # their normal equations, (p, 3, 3)
    gp: FloatArray  # their right-hand sides, (p, 3)
    U: FloatArray  # normal equations of the inner poses, (inner, 6, 6)
    border: FloatArray  # inner poses x border, (6 inner, b)
    g: FloatArray  # right-hand side of the inner poses, (6 inner,)
    vPv: float = 0.0  # counted with the interface

    def add_to(self, U: FloatArray, border: FloatArray, corner: FloatArray, g: FloatArray) -> None:
        """Add to the blocks of the reduced normal equations."""
        U[: len(self.U)] += self.U
        border[: len(self.border)] += self.border
        g[: len(self.g)] += self.g


class Summary(NamedTuple):
    """What the interface needs of the normal equations of a block before they are reduced."""

    vPv: float
    y_squared: float  # y'y of its object points
    g: FloatArray  # right-hand side of its reduced unknowns, (reduced,)
    diagonal: FloatArray  # diagonal of its reduced unknowns before reduction, (reduced,)
    held: IntArray  # number of held directions of each of its object points, (n,)


@dataclass(frozen=True)
class Reduced:
    """The inner poses of a block, eliminated."""

    scale: FloatArray  # scale of exterior unknowns, 1 for those of the interface, (6 poses,)
    eliminated: list[EliminatedFront]
    E: FloatArray  # L^-1 C_I, and C_R - K E below, (6 poses, b)
    joint: FloatArray  # lower triangle at the interface, packed by columns, (q (q + 1) / 2,)

    @property
    def weakest(self) -> float:
        """Smallest pivot."""
        return min((front.weakest for front in self.eliminated), default=1.0)


def block_of(layout: Unknowns, inner: int) -> Block:
    """Return a block with its fronts.

    Args:
        layout: order of its unknowns, as it was sent.
        inner: number of its inner poses, which come first.
    """
    layout = unpacked(layout)
    observations = layout.observations
    graph = graph_of(observations, NO_POINTS)
    return Block(layout, inner, fronts_of(observations, graph, observations.poses - inner))


def form(block: Block, state: State, weight: FloatArray, damping: float, given: OwnTerms | None) -> Equations:
    """Return the normal equations of a block at a state, with object points eliminated.

    Args:
        block: the block.
        state: values of its parameters.
        weight: factor on the weight of each of its image points, (k,), or one for all, (1,).
        damping: share of its diagonal added to the normal matrix.
        given: terms of other observations.
    """
    layout, space = block.layout, new_space(block.layout)
    b = space.blocks
    b.V.fill(0.0)
    b.gp.fill(0.0)
    if given is None:
        none = np.zeros((0, 6, 6)), np.zeros((0, layout.reduced - layout.pose_free.size)), np.zeros(0)
        given = OwnTerms(NO_POINTS, np.zeros((0, 3, 3)), np.zeros((0, 3)), *none)
    b.V[given.points] += given.V
    b.gp[given.points] += given.gp
    weight = repeated(weight, len(layout.observations.point))
    return reduced_to_orientations(layout, given, state, weight, damping, space)


def summary_of(equations: Equations) -> Summary:
    """Return what the interface needs before the reduction."""
    e = equations
    return Summary(e.vPv, e.y_squared, e.g, e.scale**-2.0, e.held)


def reduce(block: Block, equations: Equations, added: FloatArray) -> Reduced | None:
    """Eliminate the inner poses of a block; None if its matrix is not positive definite.

    Args:
        block: the block.
        equations: its normal equations.
        added: numbers to add to the scaled diagonal of its inner poses, (6 inner,).
    """
    layout, fronts, own = block.layout, block.fronts, 6 * block.inner
    observations, first = layout.observations, layout.pose_free.size
    scale = np.ones(first)
    scale[:own] = equations.scale[:own]
    left: dict[int, FloatArray] = {}
    root = len(fronts.fronts) - 1
    eliminated = eliminate_below(observations, fronts, root, equations, scale, added, left)
    if eliminated is None:
        return None
    outer = first - own
    A = sum_front(observations, fronts, fronts.fronts[root], equations, scale, np.empty(outer**2))
    for child in fronts.fronts[root].children:
        extend(left.pop(child), fronts.fronts[child].into, A)
    E, D = border_of(equations, scale, np.ones(layout.reduced - first))
    eliminate_right(fronts, eliminated, E)
    joint = np.zeros((outer + len(D), outer + len(D)))
    joint[:outer, :outer] = A
    joint[outer:, :outer] = E[own:].T
    joint[outer:, outer:] = D - E[:own].T @ E[:own]
    packed, _ = dtrttp(joint.T, uplo="U")  # the upper triangle of the transpose
    return Reduced(scale, eliminated, E, packed)


def joint_of(reduced: Reduced | None) -> tuple[FloatArray, float] | None:
    """Return the packed normal matrix at the interface, and the smallest pivot; None without a reduction."""
    return None if reduced is None else (reduced.joint, reduced.weakest)


def forward(block: Block, reduced: Reduced, right: FloatArray) -> FloatArray:
    """Return right-hand sides with the inner poses eliminated: h = L^-1 g_I, and -K h below, (6 poses, r).

    Args:
        block: the block.
        reduced: its inner poses, eliminated.
        right: right-hand sides of its inner poses, (6 inner, r).
    """
    own = 6 * block.inner
    x = np.zeros((len(reduced.scale), right.shape[1]))
    x[:own] = reduced.scale[:own, None] * right
    eliminate_right(block.fronts, reduced.eliminated, x)
    return x


def at_interface(block: Block, reduced: Reduced, h: FloatArray) -> FloatArray:
    """Return the part of eliminated right-hand sides at the interface, -K h and -E'h, (6 r + b, r)."""
    own = 6 * block.inner
    return np.concatenate([h[own:], -reduced.E[:own].T @ h[:own]])


def backward(block: Block, reduced: Reduced, h: FloatArray, interface: FloatArray) -> FloatArray:
    """Return the solution of the inner poses, (6 inner, r).

    Args:
        block: the block.
        reduced: its inner poses, eliminated.
        h: eliminated right-hand sides.
        interface: solution of its unknowns of the interface, (6 r + b, r).
    """
    own, outer = 6 * block.inner, len(reduced.scale) - 6 * block.inner
    x = h.copy()
    x[:own] -= reduced.E[:own] @ interface[outer:]
    x[own:] = interface[:outer]
    substitute_back(block.fronts, reduced.eliminated, x)
    return np.asarray(reduced.scale[:own, None] * x[:own])


def inverse_in(
    block: Block,
    reduced: Reduced,
    equations: Equations,
    Z: FloatArray,
    X: FloatArray,
    Q: FloatArray,
    cross: bool,
) -> Inverse:
    """Return the elements of the inverse that belong to a block.

    Args:
        block: the block.
        reduced: its inner poses, eliminated.
        equations: its undamped normal equations.
        Z: A^-1 of its poses of the interface, A of all poses of the network, (6 r, 6 r).
        X: A^-1 C of these poses, (6 r, b).
        Q: elements of the inverse of the border, 0 for fixed unknowns, (b, b).
        cross: whether to compute Y'S^-1.
    """
    layout, fronts, own = block.layout, block.fronts, 6 * block.inner
    x = reduced.E.copy()
    x[own:] = X
    substitute_back(fronts, reduced.eliminated, x)
    scale = reduced.scale * layout.pose_free.ravel()
    matrices = inverse_fronts(fronts, reduced.eliminated, Z)
    return inverse_of(matrices, fronts, equations, scale, BorderInverse(x * scale[:, None], Q), cross=cross)


def squares(block: Block, state: State, weight: FloatArray) -> float:
    """Return v'Pv of the image points of a block; infinite if a point is behind a camera."""
    observations = block.layout.observations
    return sum_of_squares(observations, state, repeated(weight, len(observations.point)))
