"""Free network: observations of any kind as differences from the network of the image points alone.

Every kind of observation linearises itself. With its derivatives J by the unknowns, the covariance C of the
free network and the motions H that the image points leave open, the differences v have the covariance
J C J' + stated, and the parameters A = J H. The parameters of a group, such as a plane, are further ones.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.2 (propagation, elimination of
groups of parameters).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from sfm.adjustment.covariance import Marginal, marginal_of
from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.judgement.given.values import RANK, GivenModel
from sfm.network import Network, values_of
from sfm.observations.kind import MOUNT, PHOTOGRAPH, POINT, Block, Kind
from sfm.similarity import Similarity

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
        if not np.isfinite(C).all():
            return None
        motions = m.optimum.motions
        of_points = motions.points[point].reshape(3 * len(point), motions.reduced.shape[1])
        H = np.concatenate([motions.reduced[reduced], of_points])
        return Reference(m, reduced, point, (C + C.T) / 2, H)


@dataclass(frozen=True)
class Reference:
    """Unknowns of the free network that are compared with given values."""

    marginal: Marginal
    reduced: IntArray  # columns of reduced unknowns, (r,)
    points: IntArray  # object points, (p,)
    C: FloatArray  # joint covariance, (r + 3 p, r + 3 p)
    motions: FloatArray  # derivatives by the motions that the image points leave open, (r + 3 p, d)

    def differences(self, kinds: Sequence[Kind], placing: Similarity) -> tuple[GivenModel, IntArray]:
        """Return the differences of observations from the free network, and the kind of each value.

        Each part of a kind is a value, see `Kind.part_of`.

        Args:
            kinds: observations.
            placing: object frame from the frame of the free network.
        """
        values = values_of(placing.apply_estimate(self.marginal.adjustment.estimate))
        differences, by_unknowns, stated, own, item, of = [], [], [], [], [], list[int]()
        for k, kind in enumerate(kinds):
            linear, covariance = kind.linearise(values), kind.covariances()
            n, d = linear.difference.shape
            J = np.zeros((n, d, len(self.C)))
            for block, by in zip(kind.blocks(), linear.J, strict=True):
                columns, derivatives = self._by_free(block, by, placing)
                place = np.arange(n)[:, None, None], np.arange(d)[:, None], columns[:, None, :]
                np.add.at(J, place, derivatives)
            parts = np.array([kind.part_of(row, a) for row in range(n) for a in range(d)], dtype=np.int64)
            on = np.isfinite(np.einsum("nii->ni", covariance)).ravel()
            differences.append(-linear.difference.ravel()[on])
            by_unknowns.append(J.reshape(n * d, -1)[on])
            stated.append(block_diag(*np.where(np.isfinite(covariance), covariance, 0.0))[np.ix_(on, on)])
            own.append(np.zeros((n * d, 0)) if linear.taken is None else _columns(linear.taken[0]))
            item.append(parts[on] + len(of))
            of += [k] * (int(parts.max(initial=-1)) + 1)
        J = np.concatenate(by_unknowns)
        model = GivenModel(
            np.concatenate(differences),
            J @ self.C @ J.T,
            block_diag(*stated),
            np.hstack([J @ self.motions, block_diag(*own)]),
            np.concatenate(item),
            self.marginal.adjustment.redundancy,
        )
        return model, np.array(of, dtype=np.int64)

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


def confirmed(network: Network) -> tuple[Kind, ...]:
    """Return the given values that are judged before all others; of very many control points only some."""
    return tuple(
        kind.select(np.arange(len(kind))[:: every_of(len(kind))])
        for kind in (network.control, network.exterior, network.scale_bars)
    )


def every_of(count: int) -> int:
    """Return the step by which given values are thinned if there are more than MAX_PLACES."""
    return max(1, -(-count // MAX_PLACES))


def _columns(cofactor: FloatArray) -> FloatArray:
    """Return a basis of the columns of the cofactors of parameters, (r c, h)."""
    values, vectors = np.linalg.eigh(cofactor)
    return np.asarray(vectors[:, values > RANK * values.max(initial=0.0)])
