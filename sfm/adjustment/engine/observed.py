"""Observations other than image points: the terms that each kind adds to the normal equations.

The method is unified least squares. An observation has derivatives J by the unknowns of its blocks, a weight
P and a difference l, computed minus observed. It adds J'P J to N and J'P l to g. Observations of object
points alone are added before the points are eliminated; all others are added to the reduced normal equations.
The kinds are those of `sfm.model.observations`, and this module does not depend on any particular one.

Source: Mikhail, Bethel and McGlone, Modern Photogrammetry (2001), sec. 4.4 and 5.6 (unified least
squares).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.sparse import csr_matrix

from sfm.adjustment.engine.collinearity import State
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.network import Network
from sfm.model.observations.kind import MOUNT, PHOTOGRAPH, POINT, Block, Kind, inverse_of_observed


@dataclass(frozen=True)
class ObservedKind:
    """Observations of one kind that take part in an adjustment."""

    index: int  # index of the kind in `Network.observations`
    kind: Kind  # the n observations that take part
    rows: IntArray  # their rows among all observations of the kind, (n,)
    weight: FloatArray  # inverse covariance, 0 where not observed, (n, d, d); or joint, (1, n d, n d)

    @property
    def components(self) -> BoolArray:
        """Which components were observed, (n, d)."""
        return np.reshape(np.diagonal(self.weight, axis1=1, axis2=2) > 0, (len(self.kind), -1))

    fitted: int = 0  # number of group parameters, which are not among the unknowns

    @property
    def count(self) -> int:
        """Number of scalar observations minus the number of group parameters."""
        return int(self.components.sum()) - self.fitted

    @property
    def point(self) -> IntArray | None:
        """Object point of each observation if it depends on nothing else, (n,); otherwise None."""
        blocks = self.kind.blocks()
        return blocks[0].at if len(blocks) == 1 and blocks[0].of == POINT else None

    def vPv(self, state: State) -> float:
        """Return v'Pv at the given values of the unknowns."""
        l = self.kind.linearise(state).difference.reshape(self.weight.shape[:2])
        return float(np.einsum("na,nab,nb->", l, self.weight, l))


class Reduced(NamedTuple):
    """Derivatives of observations by the reduced unknowns."""

    columns: IntArray  # columns of the reduced unknowns, (n, u)
    J: FloatArray  # 0 for fixed unknowns, (n, d, u)
    l: FloatArray  # computed minus observed, (n, d)


def observed_of(
    network: Network, layout: Unknowns, state: State, *, use_control: bool
) -> tuple[ObservedKind, ...]:
    """Return the observations other than image points that take part in the adjustment of a network.

    Args:
        network: the network.
        layout: order of the unknowns.
        state: values of all unknowns.
        use_control: whether control points take part.
    """
    observed = []
    for index, kind in enumerate(network.observations):
        if not len(kind) or (kind.carries_datum and not use_control):
            continue
        rows = np.flatnonzero(_takes_part(kind, layout))
        if not len(rows):
            continue
        taking_part = kind.select(rows)
        together = taking_part.weight_of_all()
        weight = inverse_of_observed(taking_part.covariances()) if together is None else together[None]
        if weight.any():
            taken = taking_part.linearise(state).taken
            fitted = 0 if taken is None else round(float(np.einsum("nab,nba->", weight, taken)))
            observed.append(ObservedKind(index, taking_part, rows, weight, fitted))
    return tuple(observed)


def _takes_part(kind: Kind, layout: Unknowns) -> BoolArray:
    """Return which observations take part, (n,).

    All their points and photographs must be in the adjustment. They must have a free unknown or several
    blocks.
    """
    variance = np.diagonal(kind.covariances(), axis1=1, axis2=2)
    on = ((variance > 0) & np.isfinite(variance)).any(axis=1)
    free = np.zeros(len(kind), dtype=bool)
    blocks = kind.blocks()
    for of, index in blocks:
        if of == POINT:
            on &= layout.point_on[index]
            free |= layout.point_free[index].any(axis=1)
        elif of == PHOTOGRAPH:
            on &= layout.image_on[index]
            free |= layout.rigged | layout.pose_free[layout.observations.pose_of[index]].any(axis=1)
        elif of == MOUNT:
            free |= (layout.mount_column[index] >= 0).any(axis=1)
        else:
            free |= _parameter_columns(layout, index) >= 0
    # a distance between two fixed points determines nothing, but it counts: a contradiction shows in sigma0
    return on & (free | (len(blocks) > 1))


def _parameter_columns(layout: Unknowns, index: IntArray) -> IntArray:
    """Return the columns of interior parameters (camera, parameter), -1 where not free, (n,)."""
    columns = np.full(len(index), -1)
    for row, (a, s) in enumerate(index):
        where = np.flatnonzero(layout.interior_free[a] == s)
        if len(where):
            columns[row] = layout.interior_column[a][where[0]]
    return columns


def count_of(observed: tuple[ObservedKind, ...]) -> int:
    """Return the number of scalar observations other than image points."""
    return sum(observed_kind.count for observed_kind in observed)


def vPv_of(observed: tuple[ObservedKind, ...], state: State) -> float:
    """Return v'Pv of the observations other than image points."""
    return sum(observed_kind.vPv(state) for observed_kind in observed)


def reduced_rows(observed_kind: ObservedKind, layout: Unknowns, state: State) -> Reduced:
    """Return the derivatives of observations of a kind by the reduced unknowns, including kept points.

    Args:
        observed_kind: observations of one kind.
        layout: order of the unknowns.
        state: values of all unknowns.
    """
    linear = observed_kind.kind.linearise(state)
    columns, parts = [], []
    for block, J in zip(observed_kind.kind.blocks(), linear.J, strict=True):
        at, by = _of_block(block, layout, state)
        columns.append(at)
        parts.append(J @ by)
    reduced = Reduced(np.hstack(columns), np.concatenate(parts, axis=2), linear.difference)
    if len(observed_kind.weight) == len(observed_kind.kind):
        return reduced
    n, d, u = reduced.J.shape  # mutually correlated observations are a single observation
    joint = np.zeros((n, d, n, u))
    joint[np.arange(n), :, np.arange(n)] = reduced.J
    rows = joint.reshape(1, n * d, n * u)
    return Reduced(reduced.columns.reshape(1, n * u), rows, reduced.l.reshape(1, n * d))


def _of_block(block: Block, layout: Unknowns, state: State) -> tuple[IntArray, FloatArray]:
    """Return the columns of the reduced unknowns of a block, (n, u), and its derivatives by them."""
    if block.of == PHOTOGRAPH:
        return layout.photograph_terms(state, block.at)
    if block.of == POINT:
        slot = np.searchsorted(layout.kept, block.at)
        columns = layout.kept_start + 3 * slot[:, None] + np.arange(3)
        return columns, np.eye(3) * layout.point_free[block.at][:, None]
    if block.of == MOUNT:
        columns = layout.mount_column[block.at]
        return np.maximum(columns, 0), np.eye(6) * (columns >= 0)[:, None]
    columns = _parameter_columns(layout, block.at)[:, None]
    return np.maximum(columns, 0), (columns >= 0).astype(float)[:, :, None]


class GivenTerms(Protocol):
    """Terms of the reduced normal equations that do not come from image points."""

    @property
    def vPv(self) -> float:
        """V'Pv of their observations."""

    def add_to(
        self, U: FloatArray, border: FloatArray, corner: FloatArray, g: FloatArray
    ) -> FloatArray | None:
        """Add to the blocks of the reduced normal equations; arguments as in `Terms.add_to`."""


@dataclass(frozen=True)
class Terms:
    """Terms of the reduced normal equations, from observations that depend on more than one object point."""

    rows: tuple[tuple[Reduced, FloatArray], ...]  # derivatives and J'P of each kind, (n, u, d)
    vPv: float  # v'Pv of all kinds

    def add_to(
        self, U: FloatArray, border: FloatArray, corner: FloatArray, g: FloatArray
    ) -> csr_matrix | None:
        """Add J'P J and J'P l to the blocks of the reduced normal equations.

        Args:
            U: diagonal blocks of poses, (poses, 6, 6).
            border: poses x other reduced unknowns, (6 poses, b).
            corner: other reduced unknowns, (b, b).
            g: right-hand side, (6 poses + b,).

        Returns:
            The terms that couple poses with one another, (6 poses, 6 poses); None without such terms.
        """
        first, coupled = 6 * len(U), list[csr_matrix]()
        for (columns, J, l), JP in self.rows:
            N = JP @ J
            np.add.at(g, columns, np.einsum("nud,nd->nu", JP, l))
            r = np.broadcast_to(columns[:, :, None], N.shape)
            c = np.broadcast_to(columns[:, None, :], N.shape)
            there = N != 0
            r, c, value = r[there], c[there], N[there]
            inner, outer = (r >= first) & (c >= first), (r < first) & (c >= first)
            np.add.at(corner, (r[inner] - first, c[inner] - first), value[inner])
            np.add.at(border, (r[outer], c[outer] - first), value[outer])
            of_poses = (r < first) & (c < first)
            r, c, value = r[of_poses], c[of_poses], value[of_poses]
            same = r // 6 == c // 6
            np.add.at(U, (r[same] // 6, r[same] % 6, c[same] % 6), value[same])
            if not same.all():
                coupled.append(csr_matrix((value[~same], (r[~same], c[~same])), shape=(first, first)))
        return sum(coupled[1:], coupled[0]) if coupled else None


def terms_of(
    observed: tuple[ObservedKind, ...], layout: Unknowns, state: State, V: FloatArray, gp: FloatArray
) -> Terms:
    """Return the terms of the reduced normal equations; observations of one point alone go to V and gp.

    Args:
        observed: kinds of observations.
        layout: order of the unknowns.
        state: values of all unknowns.
        V: normal equations of each object point, to add to, (n, 3, 3).
        gp: right-hand side of each object point, to add to, (n, 3).
    """
    rows, vPv = [], 0.0
    for observed_kind in observed:
        point = observed_kind.point
        if point is not None:
            linear = observed_kind.kind.linearise(state)
            l, J = linear.difference, linear.J[0]
            JP = np.swapaxes(J, 1, 2) @ observed_kind.weight
            np.add.at(V, point, JP @ J)
            np.add.at(gp, point, np.einsum("nud,nd->nu", JP, l))
        else:
            reduced = reduced_rows(observed_kind, layout, state)
            l = reduced.l
            rows.append((reduced, np.swapaxes(reduced.J, 1, 2) @ observed_kind.weight))
        vPv += float(np.einsum("na,nab,nb->", l, observed_kind.weight, l))
    return Terms(tuple(rows), vPv)


def coupled_poses(observed: tuple[ObservedKind, ...], layout: Unknowns) -> IntArray:
    """Return the poses that observations of several poses each couple with one another, (c,).

    Args:
        observed: kinds of observations.
        layout: order of the unknowns.
    """
    coupled = [np.zeros(0, dtype=np.int64)]
    for observed_kind in observed:
        of = [block.at for block in observed_kind.kind.blocks() if block.of == PHOTOGRAPH]
        if not of:
            continue
        poses = layout.observations.pose_of[np.stack(of, axis=1)]
        if len(observed_kind.weight) != len(poses):  # mutually correlated observations are a single one
            poses = poses.reshape(1, -1)
        coupled.append(poses[(poses != poses[:, :1]).any(axis=1)].ravel())
    return np.unique(np.concatenate(coupled))
