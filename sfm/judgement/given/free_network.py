"""Free network: observations of any kind as differences from the network of the image points alone.

Every kind of observation linearises itself. With its derivatives J by the unknowns, the covariance C of the
free network and the motions H of a similarity, which the image points leave open, the differences v have the
covariance J C J' + stated, and the parameters A = J H. Those of a group, such as a plane, are further ones.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.2 (propagation, elimination of
groups of parameters).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csr_matrix

from sfm.adjustment.covariance import Marginal, marginal_of
from sfm.adjustment.result import Adjustment
from sfm.judgement.given.values import RANK, GivenModel
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import AdjustedValues, Estimate, values_of
from sfm.model.network import Network
from sfm.model.observations.kind import MOUNT, PHOTOGRAPH, POINT, Block, Kind
from sfm.model.similarity import Similarity, similarity_motions

MAX_PLACES = 1000  # given points with a joint covariance, 72 MB; if there are more, only so many are judged


@dataclass(frozen=True)
class FreeNetwork:
    """The image points adjusted alone, whose covariance is computed once."""

    adjustment: Adjustment

    @cached_property
    def marginal(self) -> Marginal | None:
        """The normal equations at the solution; None if the image points determine no network."""
        a = self.adjustment
        if not a.converged or a.redundancy < 1 or a.undetermined or a.defect != a.expected_defect:
            return None
        try:
            return marginal_of(a)
        except (GeometryError, np.linalg.LinAlgError):
            return None

    def reference_of(self, kinds: Sequence[Kind]) -> Reference | None:
        """Return the unknowns that observations depend on; None if the image points do not determine them."""
        m = self.marginal
        if m is None:
            return None
        columns, points = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
        for block in (block for kind in kinds for block in kind.blocks()):
            if block.of == POINT:
                points.append(block.at)
            elif block.of == PHOTOGRAPH:
                columns.append(m.layout.photograph_terms(m.optimum.state, block.at)[0].ravel())
            elif block.of == MOUNT:
                columns.append(m.layout.mount_column[block.at].ravel())
        reduced, point = np.unique(np.concatenate(columns)), np.unique(np.concatenate(points))
        reduced = reduced[reduced >= 0]
        try:
            C = m.joint(reduced, point)
        except (GeometryError, np.linalg.LinAlgError):
            return None
        return Reference(m, reduced, point, (C + C.T) / 2) if np.isfinite(C).all() else None


class Differences(NamedTuple):
    """Differences of observations from the free network in the object frame, and what they depend on.

    The first parameters are `similarity_motions` about the centre. The parameters of groups follow.
    """

    v: FloatArray  # observed minus predicted, (m,)
    J: csr_matrix  # derivatives of the prediction by the unknowns of the reference, (m, u)
    stated: FloatArray  # stated covariance, (m, m)
    A: FloatArray  # derivatives by the parameters that only given values determine, (m, 7 + h)
    item: IntArray  # given value of each row, (m,)
    kind: IntArray  # kind of each given value, (items,)
    size: float  # length by which rotations and scale are divided, object unit


@dataclass(frozen=True)
class Reference:
    """Unknowns of the free network that are compared with given values."""

    marginal: Marginal
    reduced: IntArray  # columns of reduced unknowns, (r,)
    points: IntArray  # object points, (p,)
    C: FloatArray  # joint covariance, (r + 3 p, r + 3 p)

    def places(self, kind: Kind, placing: Similarity | None = None) -> FloatArray:
        """Return the points and projection centres that observations depend on, (n, 3).

        They are in the object frame, or without a `placing` in the frame of the free network.
        """
        free = self.marginal.adjustment.estimate
        by_type = {POINT: free.points, PHOTOGRAPH: free.position}
        X = [np.zeros((0, 3)), *(by_type[of][at] for of, at in kind.blocks() if of in by_type)]
        return np.concatenate(X) if placing is None else placing.apply(np.concatenate(X))

    def compare(self, kinds: Sequence[Kind], placing: Similarity) -> Differences:
        """Return the differences of observations from the free network; each part of a kind is a value.

        `placing` is the object frame from the frame of the free network.
        """
        free = placing.apply_estimate(self.marginal.adjustment.estimate)
        values = values_of(free)
        X = np.concatenate([self.places(kind, placing) for kind in kinds])
        centre, size = centre_and_size(X) if len(X) else (np.zeros(3), 1.0)
        moved = _motions(values, free, centre, size)
        v, stated, motions, own, item, of = [], [], [], [], [], list[int]()
        triplets, rows = [], 0
        for k, kind in enumerate(kinds):
            linear, covariance = kind.linearise(values), kind.covariances()
            n, d = linear.difference.shape
            A = np.zeros((n, d, 7))
            row = rows + np.arange(n * d).reshape(n, d, 1)
            for block, by in zip(kind.blocks(), linear.J, strict=True):
                A += by @ moved[block.of][block.at]
                columns, derivatives = self._by_free(block, by, placing)
                triplets.append(np.broadcast_arrays(derivatives, row, columns[:, None, :]))
            parts = np.array([kind.part_of(row, a) for row in range(n) for a in range(d)], dtype=np.int64)
            v.append(-linear.difference.ravel())
            stated.append((row[:, :, 0], covariance))
            motions.append(A.reshape(n * d, 7))
            basis = np.zeros((n * d, 0))
            if linear.taken is not None:  # of the columns of the cofactors of its own parameters
                eigenvalues, vectors = np.linalg.eigh(linear.taken[0])
                basis = np.asarray(vectors[:, eigenvalues > RANK * eigenvalues.max(initial=0.0)])
            own.append(basis)
            item.append(parts + len(of))
            of += [k] * (int(parts.max(initial=-1)) + 1)
            rows += n * d
        data, row_of, column_of = (
            np.concatenate([triplet[k].ravel() for triplet in triplets]) for k in range(3)
        )
        J = csr_matrix((data, (row_of, column_of)), shape=(rows, len(self.C)))
        S = np.zeros((rows, rows))
        for at, covariance in stated:
            S[at[:, :, None], at[:, None]] = covariance
        on = np.isfinite(np.diagonal(S))
        A = np.hstack([np.concatenate(motions), block_diag(*own)])[on]
        kept, items = np.concatenate(item)[on], np.array(of, dtype=np.int64)
        S = np.where(np.isfinite(S), S, 0.0)[np.ix_(on, on)]
        return Differences(np.concatenate(v)[on], J[on], S, A, kept, items, size)

    def differences(self, kinds: Sequence[Kind], placing: Similarity) -> tuple[GivenModel, IntArray]:
        """Return the differences as a model of given values, and the kind of each value; see `compare`."""
        comparison = self.compare(kinds, placing)
        network = np.asarray((comparison.J @ (comparison.J @ self.C).T).T)
        redundancy = self.marginal.adjustment.redundancy
        model = GivenModel(
            comparison.v, network, comparison.stated, comparison.A, comparison.item, redundancy
        )
        return model, comparison.kind

    def _by_free(self, block: Block, by: FloatArray, placing: Similarity) -> tuple[IntArray, FloatArray]:
        """Return the columns of a block, (n, u), and its derivatives by the free unknowns, (n, d, u)."""
        m, turned = self.marginal, placing.scale * placing.rotation
        if block.of == POINT:
            start = len(self.reduced) + 3 * np.searchsorted(self.points, block.at)
            return start[:, None] + np.arange(3), by @ turned
        if block.of == PHOTOGRAPH:
            columns, terms = m.layout.photograph_terms(m.optimum.state, block.at)
            terms = np.concatenate([turned @ terms[:, :3], terms[:, 3:]], axis=1)
        else:
            columns = m.layout.mount_column[block.at]
            lengths = np.array([placing.scale] * 3 + [1.0] * 3)
            terms = np.eye(6) * lengths * (columns >= 0)[:, None]
        # fixed unknowns have derivatives of 0 in any column
        return np.searchsorted(self.reduced, columns).clip(0, max(len(self.reduced) - 1, 0)), by @ terms


def _motions(
    values: AdjustedValues, placed: Estimate, centre: FloatArray, size: float
) -> dict[str, FloatArray]:
    """Return the `similarity_motions` of the unknowns of each type, (n, 3 or 6, 7)."""
    poses = np.zeros((len(values.position), 6, 7))
    poses[:, :3] = similarity_motions(values.position, centre=centre, size=size)
    poses[:, 3:, 3:6] = values.M / size
    mounts = np.zeros((len(values.mount_position), 6, 7))
    if placed.mounts is not None:
        mounts[:, :3, 6] = placed.mounts.free[:, :3] * values.mount_position / size
    points = similarity_motions(values.points, centre=centre, size=size)
    return {POINT: points, PHOTOGRAPH: poses, MOUNT: mounts}


def centre_and_size(X: FloatArray) -> tuple[FloatArray, float]:
    """Return the centre of points and the largest distance of a coordinate from it; 1 if they coincide."""
    centre = X.mean(axis=0)
    return centre, float(np.abs(X - centre).max()) or 1.0


def confirmed(network: Network) -> tuple[Kind, ...]:
    """Return the given values that are judged before all others; of very many of a kind only some."""
    return tuple(
        kind.select(thinned(len(kind))) for kind in (network.control, network.exterior, network.scale_bars)
    )


def thinned(count: int) -> IntArray:
    """Return the indices of the given values that are judged: not all if there are more than MAX_PLACES."""
    return np.arange(count)[:: max(1, -(-count // MAX_PLACES))]
