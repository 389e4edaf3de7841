"""Helmert blocking: one exact adjustment of blocks of photographs that are computed in several processes.

Each block forms its normal equations and eliminates its object points and inner photographs (`block`). Its
part of the normal equations of the interface (`partition`) is sent here, where the parts are added and the
interface is solved; the blocks then substitute back. Nothing is approximated: estimates and covariances are
those of the adjustment in one piece, to rounding. An iteration sends the lower triangle at the interface of
each block once, q (q + 1) / 2 numbers for q unknowns, besides the values and steps of its own unknowns.

Elements of the inverse follow from the interface down. With its normal equations (A_RR C_R; C_R' D) = L L',

    Z_R = (L_RR L_RR')^-1,   X_R = L_RR^-T L_BR',   Q = (L_BB L_BB')^-1

are A^-1 of its poses, A^-1 C and the inverse of the border. The blocks continue from them as fronts do
(`multifrontal_factor`).

Null vectors are held as in one piece: by 1 added to a diagonal element, in a block or at the interface.

Source: Helmert (1880), Die mathematischen und physikalischen Theorieen der hoeheren Geodaesie, part 1; Wolf
(1978), The Helmert block method, its origin and development, 2nd Int. Symposium on Problems Related to the
Redefinition of North American Geodetic Networks; Erisman and Tinney (1975), Comm. ACM 18(3).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.lapack import dpotrf, dpotri, dtpttr, dtrtrs
from scipy.sparse import csr_matrix

from sfm.adjustment.datum import Motions
from sfm.adjustment.engine.collinearity import State
from sfm.adjustment.engine.normals import Equations
from sfm.adjustment.engine.observed import ObservedKind, terms_of, vPv_of
from sfm.adjustment.engine.solvers import block as of_block
from sfm.adjustment.engine.solvers import protocol
from sfm.adjustment.engine.solvers.dense import WEAK_PIVOT
from sfm.adjustment.engine.solvers.fronts import BYTES
from sfm.adjustment.engine.solvers.multifrontal import factor_with_null_space
from sfm.adjustment.engine.solvers.partition import Partition, Piece, added_at, layout_of, packed
from sfm.adjustment.engine.solvers.protocol import Inverse
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.runtime.executor import Call, Keeper

COPIES = 3  # copies of the matrix of the interface at a time: sum, factor, inverse


class Given(NamedTuple):
    """Terms of observations other than image points, before they are divided among blocks and interface."""

    V: FloatArray  # object points, (n, 3, 3)
    gp: FloatArray  # right-hand side of object points, (n, 3)
    U: FloatArray  # poses, (poses, 6, 6)
    border: FloatArray  # poses x border, (6 poses, b)
    corner: FloatArray  # border, (b, b)
    coupled: csr_matrix | None  # poses of the interface with one another, (6 poses, 6 poses)
    g: FloatArray  # right-hand side, (reduced,)
    vPv: float


@dataclass(frozen=True)
class HelmertSolver:
    """Forms, factors and solves the normal equations of a network in blocks."""

    layout: Unknowns
    observed: tuple[ObservedKind, ...]
    partition: Partition
    keeper: Keeper  # computes the blocks, and keeps what they need again
    sent: dict[str, Any] = field(default_factory=dict)  # blocks and weights, which change rarely

    @property
    def has_coarse(self) -> bool:
        """Whether an intermediate step takes less time in single precision: never."""
        return False

    @property
    def bytes(self) -> float:
        """Peak memory of the interface in this process, bytes."""
        return COPIES * BYTES * len(self.partition.columns) ** 2

    @property
    def pieces(self) -> tuple[Piece, ...]:
        """The blocks."""
        return self.partition.pieces

    def each(self, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> list[Any]:
        """Return the results of a function of each block."""
        return self.keeper.fetch(Call(function, given) for given in arguments)

    def kept(self, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> list[Any]:
        """Compute a function of each block, and return where its results are kept."""
        return self.keeper.keep(Call(function, given) for given in arguments)

    def blocks(self) -> list[Any]:
        """Return where the blocks are kept; the image points are sent in the first step only."""
        if "blocks" not in self.sent:
            # one block after the other, since their image points are as large as those of the network
            given = ((layout_of(self.layout, piece), piece.inner) for piece in self.pieces)
            self.sent["blocks"] = self.kept(of_block.block_of, given)
        blocks: list[Any] = self.sent["blocks"]
        return blocks

    def _weights(self, weight: FloatArray) -> list[Any]:
        """Return where the weights of the blocks are kept, which are sent when they change."""
        if "weight" not in self.sent or not np.array_equal(self.sent["weight"], weight):
            of_blocks = ((packed(weight[piece.rays]),) for piece in self.pieces)
            self.sent["weights"], self.sent["weight"] = self.kept(_same, of_blocks), weight.copy()
        weights: list[Any] = self.sent["weights"]
        return weights

    def normal_equations(self, state: State, weight: FloatArray, damping: float) -> HelmertEquations:
        """Return the normal equations at a state.

        Args:
            state: values of all parameters.
            weight: factor on the weight of each image point, (k,).
            damping: share of its diagonal added to the normal matrix.
        """
        given = self._given(state) if self.observed else None
        kept = zip(self.pieces, self.blocks(), self._weights(weight), strict=True)
        arguments = (
            (block, piece.state(state), weights, damping, self._own_terms(b, given))
            for b, (piece, block, weights) in enumerate(kept)
        )
        formed = self.kept(of_block.form, arguments)
        summaries = self.each(of_block.summary_of, [(equations,) for equations in formed])
        g, diagonal = np.zeros(self.layout.reduced), np.zeros(self.layout.reduced)
        held = np.zeros(len(self.layout.point_free), dtype=np.int64)
        for piece, summary in zip(self.pieces, summaries, strict=True):
            g[piece.columns] += summary.g
            diagonal[piece.columns] += summary.diagonal
            held[piece.points] = summary.held
        vPv = float(sum(summary.vPv for summary in summaries))
        if given is not None:
            at = self.partition.columns
            of_all = np.diagonal(given.U, axis1=1, axis2=2).ravel(), given.corner.diagonal()
            g[at] += given.g[at]
            diagonal[at] += np.concatenate(of_all)[at]
            vPv += given.vPv
        scale = 1 / np.sqrt(np.maximum(diagonal, np.finfo(float).tiny))
        y_squared = float(sum(summary.y_squared for summary in summaries))
        return HelmertEquations(self, formed, given, vPv, g, scale, held, y_squared, damping)

    def vPv(self, state: State, weight: FloatArray) -> float:
        """Return v'Pv of all observations; infinite if a point is behind a camera."""
        arguments = [
            (kept, piece.state(state), weights)
            for piece, kept, weights in zip(self.pieces, self.blocks(), self._weights(weight), strict=True)
        ]
        return float(sum(self.each(of_block.squares, arguments))) + vPv_of(self.observed, state)

    def factor(
        self, equations: HelmertEquations, motions: Motions, *, damped: bool = False, coarse: bool = False
    ) -> HelmertFactor | None:
        """Return the factored reduced normal equations; arguments as in `Solver.factor`.

        Raises:
            GeometryError: the interface would not fit in memory.
        """
        protocol.refuse_what_does_not_fit(
            self.bytes,
            f"{counted(len(self.partition.columns), 'unknown')} at the interface",
        )

        def factor_with(added: FloatArray) -> HelmertFactor | None:
            return self._factor_with(equations, added)

        return factor_with_null_space(factor_with, equations, motions, damped=damped)

    def _factor_with(self, equations: HelmertEquations, added: FloatArray) -> HelmertFactor | None:
        """Return the factor with `added` on the diagonal; None if it is not positive definite."""
        at = self.partition.columns
        own = [
            (kept, formed, added[piece.own])
            for piece, kept, formed in zip(self.pieces, self.blocks(), equations.formed, strict=True)
        ]
        reduced = self.kept(of_block.reduce, own)
        joints = self.each(of_block.joint_of, [(one,) for one in reduced])
        S = equations.given_at_interface()
        weakest = np.inf
        for piece, joint in zip(self.pieces, joints, strict=True):
            if joint is None:
                return None
            packed, weakest = joint[0], min(weakest, joint[1])
            part, _ = dtpttr(len(piece.at), packed, uplo="U")
            added_at(S, piece.at, part.T)
        del joints
        s = equations.scale[at]
        S *= s
        S *= s[:, None]
        S[np.diag_indices_from(S)] += equations.damping + added[at]
        cholesky, info = dpotrf(S.T, lower=0, clean=1, overwrite_a=1)
        if info != 0:
            return None
        weakest = min(weakest, float(np.diagonal(cholesky).min(initial=1.0)))
        further = np.zeros((self.layout.reduced, 0))
        return HelmertFactor(self, reduced, s, cholesky, weakest**2 < WEAK_PIVOT, further)

    def _given(self, state: State) -> Given:
        """Return the terms of all observations other than image points."""
        layout, n, first = self.layout, len(self.layout.point_free), self.layout.pose_free.size
        V, gp, U = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((len(layout.pose_free), 6, 6))
        border, g = np.zeros((first, layout.reduced - first)), np.zeros(layout.reduced)
        corner = np.zeros((border.shape[1], border.shape[1]))
        terms = terms_of(self.observed, layout, state, V, gp)
        coupled = terms.add_to(U, border, corner, g)
        return Given(V, gp, U, border, corner, coupled, g, terms.vPv)

    def _own_terms(self, b: int, given: Given | None) -> of_block.OwnTerms | None:
        """Return the terms of a block: of its inner poses and object points, kept points in the first."""
        if given is None:
            return None
        piece = self.pieces[b]
        mine: BoolArray = np.asarray(given.V[piece.points].any(axis=(1, 2)))
        mine[piece.kept] &= b == 0
        points = np.flatnonzero(mine)
        there, poses = piece.points[points], piece.poses[: piece.inner]
        return of_block.OwnTerms(
            points,
            given.V[there],
            given.gp[there],
            given.U[poses],
            given.border[piece.own],
            given.g[piece.own],
        )


def _same(value: FloatArray) -> FloatArray:
    """Return what is to be kept."""
    return value


@dataclass(frozen=True)
class HelmertEquations:
    """Normal equations of all blocks at a state, see `NormalEquations`."""

    solver: HelmertSolver
    formed: list[Any]  # where the normal equations of the blocks are kept
    given: Given | None
    vPv: float
    g: FloatArray  # reduced right-hand side, (reduced,)
    scale: FloatArray  # 1/sqrt of the diagonal of U, (reduced,)
    held: IntArray  # number of held directions of each object point, (n,)
    y_squared: float
    damping: float  # share of its diagonal added to the whole normal matrix

    @cached_property
    def lower(self) -> FloatArray:
        """Cholesky factors of V; unit matrix for kept points, (n, 3, 3)."""
        L = np.empty((len(self.held), 3, 3))
        for piece, of_points in zip(self.solver.pieces, self._each(attrgetter("lower")), strict=True):
            L[piece.points] = of_points
        return L

    def _each(self, function: Callable[..., Any], *arguments: Sequence[Any]) -> list[Any]:
        """Return a function of the normal equations of each block, and of its own arguments."""
        return self.solver.each(function, list(zip(self.formed, *arguments, strict=True)))

    def _rows(self, x: FloatArray) -> list[FloatArray]:
        """Return the rows of reduced unknowns that each block needs."""
        return [x[piece.columns] for piece in self.solver.pieces]

    def normals_of(self, points: IntArray) -> FloatArray:
        """Return V of some object points before elimination, (p, 3, 3)."""
        places = self._places(points)
        V = np.zeros((len(points), 3, 3))
        parts = self._each(Equations.normals_of, [own for own, _ in places])
        for (_, at), part in zip(places, parts, strict=True):
            V[at] += part  # kept points have image points in several blocks
        return V

    def point_step(self, reduced_step: FloatArray) -> FloatArray:
        """Return the step of all object points that belongs to a step of the reduced unknowns, (n, 3)."""
        dX = np.empty((len(self.held), 3))
        steps = self._each(Equations.point_step, self._rows(reduced_step))
        for piece, of_points in zip(self.solver.pieces, steps, strict=True):
            dX[piece.points] = of_points
        return dX

    def times_schur(self, x: FloatArray) -> FloatArray:
        """Return S x with the undamped reduced normal matrix S, without forming S, (reduced, e)."""
        product, first = np.zeros_like(x), self.solver.layout.pose_free.size
        parts = self._each(Equations.times_schur, self._rows(x))
        for piece, part in zip(self.solver.pieces, parts, strict=True):
            product[piece.columns] += part
        if self.given is not None:
            poses, given, at = self.solver.partition.poses, self.given, self.solver.partition.columns
            of_poses, outer = at[: 6 * len(poses)], x[first:]
            own = x[of_poses].reshape(len(poses), 6, x.shape[1])
            product[of_poses] += (given.U[poses] @ own).reshape(len(of_poses), -1)
            product[of_poses] += given.border[of_poses] @ outer
            product[first:] += given.border[of_poses].T @ x[of_poses] + given.corner @ outer
            if given.coupled is not None:
                product[of_poses] += given.coupled[np.ix_(of_poses, of_poses)] @ x[of_poses]
        return product

    def times_reduced(self, x: FloatArray) -> FloatArray:
        """Return Y'x of vectors of the reduced unknowns (reduced, e), (n, 3, e)."""
        out = np.empty((len(self.held), 3, x.shape[1]))
        parts = self._each(Equations.times_reduced, self._rows(x))
        for piece, part in zip(self.solver.pieces, parts, strict=True):
            out[piece.points] = part  # 0 for kept points
        return out

    def times_points(self, h: FloatArray) -> FloatArray:
        """Return Y h of vectors of the object points (n, 3, e), (reduced, e)."""
        out = np.zeros((self.solver.layout.reduced, h.shape[2]))
        parts = self._each(Equations.times_points, [h[piece.points] for piece in self.solver.pieces])
        for piece, part in zip(self.solver.pieces, parts, strict=True):
            out[piece.columns] += part
        return out

    def through(self, points: IntArray) -> FloatArray:
        """Return Y L^-1, the effect of the reduced unknowns on some object points, (reduced, 3 p)."""
        through = np.zeros((self.solver.layout.reduced, 3 * len(points)))
        places = self._places(points)
        parts = self._each(Equations.through, [own for own, _ in places])
        for piece, (_, at), part in zip(self.solver.pieces, places, parts, strict=True):
            through[np.ix_(piece.columns, (3 * at[:, None] + np.arange(3)).ravel())] += part
        return through

    def given_at_interface(self) -> FloatArray:
        """Return the lower triangle of the terms of the interface that come from no block, (t, t)."""
        partition, given = self.solver.partition, self.given
        size, poses = len(partition.columns), 6 * len(partition.poses)
        S = np.zeros((size, size))
        if given is None:
            return S
        of_poses = partition.columns[:poses]
        if given.coupled is not None:
            S[:poses, :poses] = np.tril(given.coupled[np.ix_(of_poses, of_poses)].toarray())
        for i, pose in enumerate(partition.poses):
            S[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] += given.U[pose]
        S[poses:, :poses] = given.border[of_poses].T
        S[poses:, poses:] = given.corner
        return S

    def _places(self, points: IntArray) -> list[tuple[IntArray, IntArray]]:
        """Return the object points of each block among the given ones, and their places there."""
        places, at = [], np.full(len(self.held), -1)
        for piece in self.solver.pieces:
            at[piece.points] = np.arange(len(piece.points))
            own = at[points]
            at[piece.points] = -1
            places.append((own[own >= 0], np.flatnonzero(own >= 0)))
        return places


@dataclass(frozen=True)
class HelmertFactor:
    """Factor of the reduced normal equations in blocks and at the interface, see `Factor`."""

    solver: HelmertSolver
    reduced: list[Any]  # where the factors of the blocks are kept
    scale: FloatArray  # scale of the unknowns of the interface, (t,)
    cholesky: FloatArray  # upper factor of the scaled matrix of the interface, (t, t)
    weak: bool  # whether a pivot is near 0
    further: FloatArray  # null vectors that the datum does not explain, scaled, orthonormal, (reduced, e)

    def with_further(self, further: FloatArray) -> HelmertFactor:
        """Return the factor with the null vectors that it holds beside the motions.

        Args:
            further: scaled and orthonormal, (reduced, e).
        """
        return replace(self, further=further)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return a solution of S x = right for right-hand sides (reduced,) or (reduced, r)."""
        columns = right if right.ndim == 2 else right[:, None]
        pieces, at, solver = self.solver.pieces, self.solver.partition.columns, self.solver
        blocks = list(zip(solver.blocks(), self.reduced, strict=True))
        own = [(*block, columns[piece.own]) for block, piece in zip(blocks, pieces, strict=True)]
        eliminated = solver.kept(of_block.forward, own)
        parts = [(*block, h) for block, h in zip(blocks, eliminated, strict=True)]
        there = columns[at].copy()
        for piece, part in zip(pieces, solver.each(of_block.at_interface, parts), strict=True):
            there[piece.at] += part
        s, x = self.scale[:, None], np.empty_like(columns)
        solved = s * cho_solve((self.cholesky, False), s * there) if len(there) else there
        x[at] = solved
        arguments = [(*part, solved[piece.at]) for part, piece in zip(parts, pieces, strict=True)]
        for piece, part in zip(pieces, solver.each(of_block.backward, arguments), strict=True):
            x[piece.own] = part
        return np.asarray(x.reshape(right.shape))

    def inverse(self, equations: HelmertEquations, *, cross: bool) -> Inverse:
        """Return the elements of the inverse; arguments as in `Factor.inverse`."""
        layout, partition, pieces = self.solver.layout, self.solver.partition, self.solver.pieces
        outer, first, poses = 6 * len(partition.poses), layout.pose_free.size, len(layout.pose_free)
        free = layout.reduced_free()
        sR, sB = self.scale[:outer], self.scale[outer:]
        Z = _inverse_of_factor(self.cholesky[:outer, :outer]) * sR[:, None] * sR
        X = self.cholesky[:outer, outer:]
        X = dtrtrs(self.cholesky[:outer, :outer], X)[0] if X.size else X
        X = X * sR[:, None] / sB
        sB = sB * free[first:]
        Q = np.ascontiguousarray(_inverse_of_factor(self.cholesky[outer:, outer:]) * sB[:, None] * sB)
        border = len(sB)
        arguments = []
        blocks = zip(pieces, self.solver.blocks(), self.reduced, equations.formed, strict=True)
        for piece, block, reduced, formed in blocks:
            own = piece.at[: len(piece.at) - border]
            arguments.append((block, reduced, formed, Z[np.ix_(own, own)], X[own], Q, cross))
        parts: list[Inverse] = self.solver.each(of_block.inverse_in, arguments)
        n, k = len(layout.point_free), len(layout.order)
        exterior, mixed = np.empty((poses, 6, 6)), np.empty((first, border))
        core = np.empty((n, 3, 3))
        YQ, YQ_border = np.empty((k if cross else 0, 3, 6)), np.empty((n if cross else 0, 3, border))
        for piece, part in zip(pieces, parts, strict=True):
            # the elements at the interface are the same in all blocks
            exterior[piece.poses] = part.exterior
            mixed[piece.columns[: len(part.mixed)]] = part.mixed
            core[piece.points] = part.core
            if cross:
                YQ[piece.rays] = part.YQ
                YQ_border[piece.points] = part.YQ_border
        return Inverse(exterior, mixed, Q, core, YQ, YQ_border)


def _inverse_of_factor(U: FloatArray) -> FloatArray:
    """Return (U'U)^-1, symmetric."""
    if not len(U):
        return np.zeros_like(U)
    inverse, _ = dpotri(np.asfortranarray(U))
    return np.asarray(np.triu(inverse) + np.triu(inverse, 1).T)
