"""Influence of image points on the unknowns, and covariance with correlated errors of neighbouring points.

Least squares with weights for independent errors stays unbiased if the errors in a photograph are correlated,
but it is less precise than its cofactors show. Errors e move the unknowns by dx = Z'e with the influence Z.
If the errors have the covariance sigma0^2 R, the unknowns have sigma0^2 Z'R Z; R = I gives the usual
covariance. R has two parts: the independent error of each image point, in units of its standard deviation,
and an error common to neighbours in a photograph, in px. After whitening, the common part is larger for more
precise image points.

At the optimum the adjustment is a linear function of the errors. With the whitened derivatives A (reduced
unknowns) and B (eliminated object points), errors e in units of their standard deviations move the reduced
unknowns by dx = Q M e. Here M = A' - W V^-1 B', W = A'B, and V is B'B plus the observations of points. Each
point moves by V^-1 (B'e - W'dx).

Source: Koch (1999), Parameter Estimation and Hypothesis Testing in Linear Models, sec. 2.6 and 3.2;
covariance function: Moritz (1980), Advanced Physical Geodesy, sec. 22; Foerstner and Wrobel (2016), sec. 4.2
and 15.2.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix
from scipy.spatial.distance import cdist

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
from sfm.adjustment.result import Covariance, ErrorCorrelation
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.network import rows_of
from sfm.model.observations.pose import exterior_jacobian
from sfm.runtime.compiling import kernel

POINTS_AT_ONCE = 2000
BYTES_AT_ONCE = 16_000_000  # bytes of the correlations held at a time


@dataclass(frozen=True)
class Linearised:
    """Whitened derivatives of all image points in the order of the layout, and the factor at the optimum."""

    layout: Unknowns
    factor: Factor
    A: csr_matrix  # derivatives by reduced unknowns, (2k, reduced)
    B: csr_matrix  # derivatives by eliminated points, (2k, 3n)
    V_inverse: csr_matrix  # V^-1 of the eliminated points, (3n, 3n)
    by_ray: FloatArray  # B V^-1, d X / d errors of each ray with fixed cameras; 0 for kept points, (k, 2, 3)
    whitening: FloatArray  # F of each image point with F'F its weight, 1/px, (k, 2, 2)

    @property
    def through(self) -> csr_matrix:
        """W V^-1: effect of the points on the reduced unknowns, (reduced, 3n)."""
        return self.A.T @ self.B @ self.V_inverse

    def cofactor(self) -> FloatArray:
        """Return a cofactor matrix of the reduced unknowns, in any datum, (reduced, reduced)."""
        return self.solve(np.eye(self.layout.reduced))

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve the reduced normal equations for some right-hand sides, (reduced, e)."""
        free = self.layout.reduced_free()[:, None]
        return self.factor.solve(right * free) * free

    def residuals(self, errors: FloatArray) -> FloatArray:
        """Return the whitened residuals caused by whitened errors of image points, both (2k, e)."""
        of_points = self.B.T @ errors
        dx = self.solve(self.A.T @ (errors - self.B @ (self.V_inverse @ of_points)))
        moved = self.A @ dx
        return np.asarray(errors - moved - self.B @ (self.V_inverse @ (of_points - self.B.T @ moved)))


@dataclass(frozen=True)
class Influence:
    """Effect of errors of image points on the unknowns of an adjustment, in its datum."""

    linear: Linearised
    through: csc_matrix  # effect of the reduced unknowns on the object points, transposed, (reduced, 3n)
    of_datum: FloatArray  # datum parameters by the object points, (n, 3, d)
    unknowns: FloatArray  # reduced unknowns and datum parameters by their scores, (reduced + d, reduced + d)
    H: FloatArray  # motions of the reduced unknowns, (reduced, d)
    H_points: FloatArray  # motions of the object points, (3n, d)

    def of(self, unknowns: IntArray, points: IntArray) -> FloatArray:
        """Return d (reduced unknowns, X Y Z of points) / d errors, (k, 2, u + 3 p)."""
        point, reduced = self.linear.layout.observations.point, len(self.H)
        coordinates = (3 * np.asarray(points)[:, None] + np.arange(3)).ravel()
        right = self.unknowns @ np.hstack([self.of_reduced()[:, unknowns], self.of_points(coordinates)])
        A, B, of_unknowns = self.linear.A, self.linear.B, right[:reduced]
        Z = np.asarray(A @ of_unknowns - B @ (self.through.T @ of_unknowns)).reshape(len(point), 2, -1)
        Z += self._scores_of_datum(np.arange(len(point))) @ right[reduced:]
        place = np.full(len(self.linear.layout.point_free), -1)
        place[points] = len(unknowns) + 3 * np.arange(len(points))
        for axis in range(3):
            rays = np.flatnonzero(place[point] >= 0)
            Z[rays, :, place[point[rays]] + axis] += self.linear.by_ray[rays, :, axis]
        return Z

    def scores_of(self, rows: IntArray) -> tuple[IntArray, FloatArray]:
        """Return the columns of `unknowns` that image points affect, and their scores, (k, 2, columns).

        Scores are the derivatives, by errors, of the right-hand side of the reduced normal equations and the
        datum. Scores of all image points would take more memory than the rest of the adjustment.
        """
        xy_rows = (2 * rows[:, None] + np.arange(2)).ravel()
        scores, reduced = self.linear.A[xy_rows] - self.linear.B[xy_rows] @ self.through.T, len(self.H)
        touched = np.flatnonzero(np.bincount(scores.indices, minlength=reduced))
        S = scores[:, touched].toarray().reshape(len(rows), 2, len(touched))
        columns = np.concatenate([touched, np.arange(reduced, len(self.unknowns))])
        return columns, np.concatenate([S, self._scores_of_datum(rows)], axis=2)

    def _scores_of_datum(self, rows: IntArray) -> FloatArray:
        """Return the derivatives of the datum parameters by the errors of some image points, (k, 2, d)."""
        return self.linear.by_ray[rows] @ self.of_datum[self.linear.layout.observations.point[rows]]

    def of_reduced(self) -> FloatArray:
        """Return the matrix that gives the reduced unknowns in the datum, (reduced + d, reduced)."""
        return np.vstack([np.eye(len(self.H)), -self.H.T])

    def of_points(self, rows: IntArray) -> FloatArray:
        """Return the same matrix for some coordinates of points, without the direct effect of their rays."""
        return np.vstack([-self.through[:, rows].toarray(), -self.H_points[rows].T])


def influence_of(optimum: Optimum, layout: Unknowns, weight: FloatArray) -> Influence:
    """Return the effect of errors of image points on the unknowns, in the datum of the optimum.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
        weight: factor on the weight of each image point, (k,).
    """
    linear, motions = linearise(optimum, layout, weight), optimum.motions
    n, d = len(layout.point_free), len(motions.inverse)
    kept = (3 * layout.kept[:, None] + np.arange(3)).ravel()
    of_kept = (-np.ones(len(kept)), (layout.kept_start + np.arange(len(kept)), kept))
    through = csc_matrix(linear.through + csc_matrix(of_kept, shape=(layout.reduced, 3 * n)))
    B = motions.constraints.reshape(3 * n, d)
    of_datum = (motions.on_reduced - through @ B) @ motions.inverse.T
    Q = linear.cofactor()
    unknowns = np.eye(layout.reduced + d)
    unknowns[: layout.reduced, : layout.reduced] = Q
    unknowns[: layout.reduced, layout.reduced :] = Q @ of_datum
    return Influence(
        linear,
        through,
        motions.constraints @ motions.inverse.T,
        unknowns,
        motions.reduced,
        motions.points.reshape(3 * n, d),
    )


@dataclass(frozen=True)
class CorrelatedPart:
    """Cofactors due to the correlation of the errors, in the datum of the influence."""

    influence: Influence
    correlation: ErrorCorrelation
    relative: FloatArray  # whitening of each image point relative to a usual one, (k, 2, 2)
    which: BoolArray  # image points with correlated errors, (k,)
    middle: FloatArray  # S'(R - I) S of the scores S, (reduced + d, reduced + d)
    points: FloatArray  # covariance of each object point, (n, 3, 3)
    limiting: FloatArray  # the same with photographs and cameras held fixed, (n, 3, 3)

    def joint(self, unknowns: IntArray, points: IntArray) -> FloatArray:
        """Return the addition to the joint cofactor of reduced unknowns and points, (u + 3 p, u + 3 p)."""
        influence, p, u = self.influence, len(points), len(unknowns)
        coordinates = (3 * np.asarray(points)[:, None] + np.arange(3)).ravel()
        C = influence.unknowns @ np.hstack(
            [influence.of_reduced()[:, unknowns], influence.of_points(coordinates)]
        )
        added = C.T @ self.middle @ C
        if not p:
            return np.asarray(added)
        o, by_ray = influence.linear.layout.observations, influence.linear.by_ray
        place = np.full(len(self.points), -1)
        place[points] = np.arange(p)
        of_all = np.zeros((3 * p, C.shape[1]))
        for photograph in _photographs(o.image, o.xy, self.relative, self.correlation, self.which):
            rows = photograph.rows
            chosen = np.flatnonzero(place[o.point[rows]] >= 0)
            if not len(chosen):
                continue
            columns, S = influence.scores_of(rows)
            O, at = by_ray[rows[chosen]], place[o.point[rows[chosen]]]
            lines = (3 * at[:, None] + np.arange(3)).ravel()
            KS = photograph.times(S, chosen)
            of_all[lines] += (O.transpose(0, 2, 1) @ KS).reshape(len(lines), -1) @ C[columns]
            photograph.add_between(added, u + 3 * at, O, chosen)
        added[u:] += of_all
        added[:, u:] += of_all.T
        return np.asarray(added)

    def added_to(self, covariance: Covariance, variance: float, optimum: Optimum) -> Covariance:
        """Return the marginal covariance plus the effect of the correlation; `variance` is sigma0^2."""
        layout = self.influence.linear.layout
        reduced = self.influence.unknowns @ self.influence.of_reduced()
        D = variance * reduced.T @ self.middle @ reduced
        columns, J = layout.photograph_terms(optimum.state, np.arange(len(optimum.state.M)))
        T = exterior_jacobian(optimum.state.M) @ J
        exterior = D[columns[:, :, None], columns[:, None]]
        columns, J = layout.rig_terms(optimum.state)
        return replace(
            covariance,
            points=covariance.points + variance * self.points,
            points_limiting=covariance.points_limiting + variance * self.limiting,
            exterior=covariance.exterior + T @ exterior @ np.swapaxes(T, 1, 2),
            rigs=covariance.rigs + J @ D[np.ix_(columns, columns)] @ J.T,
            interior=tuple(
                Q + D[np.ix_(of_camera, of_camera)]
                for Q, of_camera in zip(covariance.interior, layout.interior_column, strict=True)
            ),
        )


def correlated_part(
    influence: Influence, correlation: ErrorCorrelation, usual_px: float, which: BoolArray
) -> CorrelatedPart:
    """Return the addition to the cofactors of all unknowns due to correlated errors.

    Args:
        influence: effect of errors on the unknowns.
        correlation: correlation of the errors.
        usual_px: a priori standard deviation of a usual image coordinate, px.
        which: image points with correlated errors, (k,).
    """
    linear, r = influence.linear, len(influence.unknowns)
    relative = usual_px * linear.whitening
    o, n = linear.layout.observations, len(linear.layout.point_free)
    middle, added, limiting = np.zeros((r, r)), np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    for photograph in _photographs(o.image, o.xy, relative, correlation, which):
        rows = photograph.rows
        columns, S = influence.scores_of(rows)
        KS = photograph.times(S)
        middle[np.ix_(columns, columns)] += np.tensordot(S, KS, axes=((0, 1), (0, 1)))
        j, by_ray = o.point[rows], linear.by_ray[rows].transpose(0, 2, 1)
        right = influence.unknowns[columns] @ influence.of_points((3 * j[:, None] + np.arange(3)).ravel())
        half = by_ray @ (KS @ right.reshape(len(columns), len(rows), 3).transpose(1, 0, 2))
        alone = by_ray @ photograph.variances() @ by_ray.transpose(0, 2, 1)
        np.add.at(limiting, j, alone)
        np.add.at(added, j, half + half.transpose(0, 2, 1) + alone)
    D = influence.unknowns.T @ middle @ influence.unknowns
    for first in range(0, n, POINTS_AT_ONCE):
        C = influence.of_points(np.arange(3 * first, min(3 * (first + POINTS_AT_ONCE), 3 * n)))
        through = np.einsum("rpa,rpb->pab", C.reshape(r, -1, 3), (D @ C).reshape(r, -1, 3))
        added[first : first + POINTS_AT_ONCE] += through
    return CorrelatedPart(influence, correlation, relative, which, middle, added, limiting)


def correlated_sum(
    image: IntArray,
    xy: FloatArray,
    relative: FloatArray,
    Z: FloatArray,
    correlation: ErrorCorrelation,
    which: BoolArray,
) -> FloatArray:
    """Return Z'(R - I) Z, the addition to the covariance of functions of errors, for sigma0 = 1.

    Args:
        image: photograph of each image point, (k,).
        xy: image points, px, (k, 2).
        relative: whitening of each image point relative to a usual one, (k, 2, 2).
        Z: derivatives of the functions by the errors in units of their standard deviations, (k, 2, u).
        correlation: correlation of the errors.
        which: image points with correlated errors, (k,).
    """
    total = np.zeros((Z.shape[2], Z.shape[2]))
    for photograph in _photographs(image, xy, relative, correlation, which):
        of_photograph = Z[photograph.rows]
        total += np.tensordot(of_photograph, photograph.times(of_photograph), axes=((0, 1), (0, 1)))
    return total


@dataclass(frozen=True)
class _Photograph:
    """R - I of the image points of a photograph: (alone - 1) I + G C G' with the relative whitening G."""

    rows: IntArray  # its image points, (r,)
    xy: FloatArray  # px, (r, 2)
    relative: FloatArray  # G, (r, 2, 2)
    correlation: ErrorCorrelation

    def times(self, Z: FloatArray, rows: IntArray | None = None) -> FloatArray:
        """Return (R - I) Z of some image points, (s, 2, u), from Z (r, 2, u); C is formed in parts."""
        rows = np.arange(len(self.rows)) if rows is None else rows
        of_shift = (np.swapaxes(self.relative, 1, 2) @ Z).reshape(len(Z), -1)
        parts = np.array_split(rows, 1 + 8 * len(rows) * len(self.xy) // BYTES_AT_ONCE)
        moved = np.concatenate([self.common(part, slice(None)) @ of_shift for part in parts])
        moved = moved.reshape(len(rows), *Z.shape[1:])
        return np.asarray((self.correlation.alone - 1.0) * Z[rows] + self.relative[rows] @ moved)

    def add_between(self, added: FloatArray, first: IntArray, O: FloatArray, rows: IntArray) -> None:
        """Add O'(R - I) O for functions O of some image points, three each (s, 2, 3).

        Args:
            added: a matrix, changed.
            first: its first row for each image point, (s,).
            O: derivatives of the functions by the errors, (s, 2, 3).
            rows: image points, (s,).
        """
        of_shift = np.swapaxes(self.relative[rows], 1, 2) @ O
        alone = (self.correlation.alone - 1.0) * np.swapaxes(O, 1, 2) @ O
        xy, of_shift = np.ascontiguousarray(self.xy[rows]), np.ascontiguousarray(of_shift)
        common, length_px = float(self.correlation.common), float(self.correlation.length_px)
        _add_between(added, first, xy, of_shift, alone, common, length_px)

    def variances(self) -> FloatArray:
        """Return the diagonal blocks of R - I, one per image point, (r, 2, 2)."""
        together = self.correlation.common * self.relative @ np.swapaxes(self.relative, 1, 2)
        return np.asarray((self.correlation.alone - 1.0) * np.eye(2) + together)

    def common(self, rows: IntArray, others: IntArray | slice) -> FloatArray:
        """Return C between some image points and others, (s, o)."""
        C = cdist(self.xy[rows], self.xy[others])
        C /= -self.correlation.length_px
        np.exp(C, out=C)
        C *= self.correlation.common
        return np.asarray(C)


@kernel
def _add_between(
    added: FloatArray,
    first: IntArray,
    xy: FloatArray,
    of_shift: FloatArray,
    alone: FloatArray,
    common: float,
    length_px: float,
) -> None:
    """Add the covariances of three functions each of all pairs of image points of a photograph."""
    for a in range(len(first)):
        for b in range(a + 1):
            distance = np.hypot(xy[a, 0] - xy[b, 0], xy[a, 1] - xy[b, 1])
            shared = common * np.exp(-distance / length_px)
            for x in range(3):
                for y in range(3):
                    both = of_shift[a, 0, x] * of_shift[b, 0, y] + of_shift[a, 1, x] * of_shift[b, 1, y]
                    if a == b:
                        added[first[a] + x, first[a] + y] += shared * both + alone[a, x, y]
                    else:
                        added[first[a] + x, first[b] + y] += shared * both
                        added[first[b] + y, first[a] + x] += shared * both


def _photographs(
    image: IntArray, xy: FloatArray, relative: FloatArray, correlation: ErrorCorrelation, which: BoolArray
) -> Iterator[_Photograph]:
    """Yield R - I of the image points of each photograph; it is 0 for those without correlated errors."""
    for of_photograph in rows_of(image, int(image.max(initial=-1)) + 1):
        rows = of_photograph[which[of_photograph]]
        yield _Photograph(rows, xy[rows], relative[rows], correlation)


def linearise(optimum: Optimum, layout: Unknowns, weight: FloatArray) -> Linearised:
    """Return the whitened derivatives of all image points at an optimum.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
        weight: factor on the weight of each image point, (k,).
    """
    o, L = layout.observations, optimum.equations.lower
    k, n, f = len(o.image), len(L), int(o.free_count.max(initial=0))
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
    half = solve_lower(L, np.tile(np.eye(3), (n, 1, 1)))
    V_inverse = half.transpose(0, 2, 1) @ half
    F = np.zeros((k, 2, 2))
    F[:, 0, 0], F[:, 1, 0], F[:, 1, 1] = (o.whitening * np.sqrt(weight * o.share)[:, None]).T
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
    """Return the derivatives of all image points, (2k, columns), from the image points that have some.

    Args:
        values: derivatives of x and y by q unknowns each, (s, 2, q).
        column: columns of these unknowns, (s, q).
        which: which image points have derivatives, s of them, (k,).
        columns: total number of columns.
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
