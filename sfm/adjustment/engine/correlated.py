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
from typing import NamedTuple

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
from sfm.runtime.compiling import compiled, kernel

POINTS_AT_ONCE = 2000
RUN = 256  # points whose effects on the reduced unknowns are taken together
CELLS_PER_LENGTH, LENGTHS_SUMMED = 8, 20  # of the bound of common errors, per correlation length
PAIRS_PER_CELL = 8  # pairs of image points whose distances take as long as a cell of the bound
BYTES_AT_ONCE = 16_000_000  # bytes of the correlations held at a time


@dataclass(frozen=True)
class Linearised:
    """Whitened derivatives of all image points in the order of the layout, and the factor at the optimum."""

    layout: Unknowns
    factor: Factor
    A: csr_matrix  # derivatives by reduced unknowns, (2k, reduced)
    B: csr_matrix  # derivatives by eliminated points, (2k, 3n)
    by_cameras: FloatArray  # derivatives by the pose and the free parameters of the camera, (k, 2, 6 + f)
    by_points: FloatArray  # derivatives by each object point, eliminated or kept, (k, 2, 3)
    column: IntArray  # reduced unknowns of the former in each photograph, (m, 6 + f)
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


class _Errors(NamedTuple):
    """Image points with correlated errors, photograph by photograph, in the form that compiled code uses."""

    first: IntArray  # first image point of each photograph, and the end, (m + 1,)
    image: IntArray  # photograph of each image point, (k,)
    point: IntArray  # object point of each image point, (k,)
    of_point: IntArray  # image points, object point by object point, (k,)
    first_of_point: IntArray  # first of these of each object point, and the end, (n + 1,)
    xy: FloatArray  # px, (k, 2)
    by_cameras: FloatArray  # whitened derivatives by pose and camera, times whitening, 1/px, (k, 2, 6 + f)
    by_points: FloatArray  # the same by the object point, (k, 2, 3)
    alone: FloatArray  # covariance that each image point has with no other, px^2, (k, 2, 2)


@dataclass(frozen=True)
class _OfPoints:
    """Covariances by R - I of the right-hand sides B'e of some object points."""

    others: IntArray  # points in their photographs, (c,)
    with_points: FloatArray  # with B'e of these points, (3 p, 3 c)
    direct: FloatArray  # with A'e, of which the scores are A'e - W V^-1 B'e, (3 p, reduced + d)
    indirect: FloatArray  # with W V^-1 B'e, (3 p, reduced + d)
    columns: IntArray  # scores in which B'e of the points themselves takes part, (s,)
    through: FloatArray  # how: these columns of W V^-1, transposed, (3 p, s)

    @property
    def with_scores(self) -> FloatArray:
        """The covariances with the scores, (3 p, reduced + d)."""
        return self.direct - self.indirect


@dataclass(frozen=True)
class _ErrorsInCommon:
    """R - I of all photographs, and where its sums belong."""

    influence: Influence
    correlation: ErrorCorrelation
    errors: _Errors
    column: IntArray  # reduced unknowns of the pose and the camera of each photograph, (m, 6 + f)
    shows: csr_matrix  # which photographs show each point with such errors, (n, m)
    order: IntArray  # points with such errors, those in about the same photographs one after the other
    inverse: FloatArray  # V^-1 of each point, 0 for kept points, (n, 3, 3)

    def parts(self, points: IntArray) -> Iterator[IntArray]:
        """Yield points in parts whose covariances take about as much memory as the derivatives do.

        Points without errors in common are in no part.
        """
        left = [self.order[np.isin(self.order, points)]]
        while left:
            part = left.pop()
            scores = 3 * len(part) * len(self.influence.unknowns)  # of which there are five
            taken = 9 * len(part) * len(self._beside(part)) + 5 * scores
            if len(part) > 1 and taken > 2 * self.errors.by_cameras.size:
                left += np.array_split(part, 2)
            elif len(part):
                yield part

    def no_cameras(self) -> FloatArray:
        """Return zeros for the covariances of A'e of each photograph, (m, 6 + f, 6 + f)."""
        m, unknowns = self.column.shape
        return np.zeros((m, unknowns, unknowns))

    def _beside(self, points: IntArray) -> IntArray:
        """Return the points in all photographs that show some points, and others of their runs, in order."""
        first, beside = self.errors.first, np.zeros(len(self.inverse), dtype=bool)
        for i in np.unique(self.shows[points].indices).tolist():
            beside[self.errors.point[first[i] : first[i + 1]]] = True
        runs = np.add.reduceat(beside[self.order], np.arange(0, len(self.order), RUN)) > 0
        return self.order[np.repeat(runs, RUN)[: len(self.order)]]

    def of_points(self, points: IntArray, cameras: FloatArray) -> _OfPoints:
        """Return the covariances of the right-hand sides of some points.

        Args:
            points: the points, (p,).
            cameras: covariances of A'e of each photograph, (m, 6 + f, 6 + f); their shares are added.
        """
        influence, others = self.influence, self._beside(points)
        p = 3 * len(points)
        place = np.zeros(len(self.inverse), dtype=np.int64)
        place[others] = np.arange(len(others))
        with_points = np.zeros((p, 3 * len(others)))
        with_scores = np.zeros((p, len(influence.unknowns)))
        _add_pairs(
            self.errors,
            (points, place, self.column),
            (float(self.correlation.common), float(self.correlation.length_px)),
            (with_points, with_scores, cameras),
        )
        indirect = np.zeros((len(influence.unknowns), p))
        for first in range(0, len(others), RUN):
            run = others[first : first + RUN]
            of_run = with_points[:, 3 * first : 3 * (first + len(run))]
            columns, through = self._through(run)
            indirect[columns] += through.T @ of_run.T
        columns, through = self._through(points)
        return _OfPoints(others, with_points, with_scores, indirect.T, columns, through)

    def _through(self, points: IntArray) -> tuple[IntArray, FloatArray]:
        """Return the rows of W V^-1 that are not 0 for some points, and these rows, transposed, (3 p, s)."""
        influence, reduced = self.influence, len(self.influence.H)
        shown = influence.through[:, (3 * points[:, None] + np.arange(3)).ravel()]
        touched = np.flatnonzero(np.bincount(shown.indices, minlength=reduced))
        place = np.zeros(reduced, dtype=np.int64)
        place[touched] = np.arange(len(touched))
        shape = (3 * len(points), len(touched))
        rows = csr_matrix((shown.data, place[shown.indices], shown.indptr), shape=shape).toarray()
        of_datum = self.inverse[points] @ influence.of_datum[points]
        d = of_datum.shape[2]
        columns = np.concatenate([touched, np.arange(reduced, reduced + d)])
        return columns, np.hstack([rows, -of_datum.reshape(shape[0], d)])


@dataclass(frozen=True)
class CorrelatedPart:
    """Cofactors due to the correlation of the errors, in the datum of the influence."""

    influence: Influence
    in_common: _ErrorsInCommon
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
        place = np.full(len(self.points), -1)
        place[points] = np.arange(p)
        of_all, inverse = np.zeros((3 * p, C.shape[1])), self.in_common.inverse
        cameras = self.in_common.no_cameras()
        for part in self.in_common.parts(np.asarray(points)):
            of = self.in_common.of_points(part, cameras)
            rows = (3 * place[part][:, None] + np.arange(3)).ravel()
            of_all[rows] = _times(inverse[part], of.with_scores @ C)
            asked = np.flatnonzero(place[of.others] >= 0)
            columns = (3 * place[of.others[asked]][:, None] + np.arange(3)).ravel()
            between = of.with_points[:, (3 * asked[:, None] + np.arange(3)).ravel()]
            between = _times(inverse[of.others[asked]], _times(inverse[part], between).T).T
            added[np.ix_(u + rows, u + columns)] += between
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
    in_common = _errors_in_common(influence, correlation, usual_px, which)
    inverse, r = in_common.inverse, len(influence.unknowns)
    n = len(inverse)
    middle, added, limiting = np.zeros((r, r)), np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    cameras = in_common.no_cameras()
    for points in in_common.parts(np.arange(n)):
        of = in_common.of_points(points, cameras)
        half = of.through.T @ (of.direct - of.indirect / 2)
        middle[of.columns] -= half
        middle[:, of.columns] -= half.T
        at = np.full(n, -1)
        at[of.others] = np.arange(len(of.others))
        at = 3 * at[points][:, None] + np.arange(3)
        alone = of.with_points.reshape(-1, 3, of.with_points.shape[1])
        alone = inverse[points] @ np.take_along_axis(alone, at[:, None], axis=2) @ inverse[points]
        right = influence.unknowns @ influence.of_points((3 * points[:, None] + np.arange(3)).ravel())
        scores = _times(inverse[points], of.with_scores).reshape(len(points), 3, -1)
        half = np.einsum("pas,spb->pab", scores, right.reshape(-1, len(points), 3), optimize=True)
        limiting[points] = alone
        added[points] = half + half.transpose(0, 2, 1) + alone
    column = in_common.column
    np.add.at(middle, (column[:, :, None], column[:, None]), cameras)
    D = influence.unknowns.T @ middle @ influence.unknowns
    for first in range(0, n, POINTS_AT_ONCE):
        C = influence.of_points(np.arange(3 * first, min(3 * (first + POINTS_AT_ONCE), 3 * n)))
        through = np.einsum("rpa,rpb->pab", C.reshape(r, -1, 3), (D @ C).reshape(r, -1, 3))
        added[first : first + POINTS_AT_ONCE] += through
    return CorrelatedPart(influence, in_common, middle, added, limiting)


def _errors_in_common(
    influence: Influence, correlation: ErrorCorrelation, usual_px: float, which: BoolArray
) -> _ErrorsInCommon:
    """Return R - I of all photographs, see `correlated_part`."""
    linear = influence.linear
    layout, o = linear.layout, linear.layout.observations
    m, n = len(o.camera), len(layout.point_free)
    used = which & (np.linalg.det(linear.whitening) > 0)  # others have no weight
    rows = np.flatnonzero(used)
    rows = rows[np.argsort(o.image[rows], kind="stable")]
    image, point = o.image[rows], o.point[rows]
    whitening = np.swapaxes(usual_px * linear.whitening[rows], 1, 2)
    unwhitened = np.linalg.inv(whitening)
    errors = _Errors(
        np.searchsorted(image, np.arange(m + 1)),
        image,
        point,
        np.argsort(point, kind="stable"),
        np.searchsorted(np.sort(point), np.arange(n + 1)),
        o.xy[rows],
        whitening @ linear.by_cameras[rows],
        whitening @ linear.by_points[rows],
        (correlation.alone - 1.0) * np.swapaxes(unwhitened, 1, 2) @ unwhitened,
    )
    inverse = linear.V_inverse.data.reshape(n, 3, 3).copy()  # its only blocks are on the diagonal
    inverse[layout.kept] = 0.0
    shows = csr_matrix((np.ones(len(rows), dtype=np.int8), (point, image)), shape=(n, m))
    rays = np.diff(errors.first_of_point)
    seen = np.flatnonzero(rays)
    first = image[errors.of_point[errors.first_of_point[seen]]]
    order = seen[np.lexsort([first, -np.floor(np.log2(rays[seen]))])]
    return _ErrorsInCommon(influence, correlation, errors, linear.column, shows, order, inverse)


def _times(blocks: FloatArray, values: FloatArray) -> FloatArray:
    """Return the product of a block-diagonal matrix, blocks (p, 3, 3), and a matrix (3 p, q)."""
    return np.asarray((blocks @ values.reshape(len(blocks), 3, -1)).reshape(values.shape))


@compiled
def _add_pairs(
    errors: _Errors,
    places: tuple[IntArray, IntArray, IntArray],
    covariance: tuple[float, float],
    sums: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Add the covariances of all pairs of image points of a photograph, one of them of some points.

    Args:
        errors: image points.
        places: the points, (p,); the column of each point, divided by 3, (n,); the columns of pose and camera
            of each photograph, (m, 6 + f).
        covariance: variance of the error in common, px^2 relative to a usual one, and correlation length, px.
        sums: covariances of B'e of the points with that of others, (3 p, 3 c), and with A'e, (3 p, s); and of
            A'e of each photograph with itself, (m, 6 + f, 6 + f).
    """
    points, place, column = places
    common, length_px = covariance
    with_points, with_cameras, cameras = sums
    unknowns = column.shape[1]
    moved = np.empty((2, unknowns))
    for p in range(len(points)):
        for at in range(errors.first_of_point[points[p]], errors.first_of_point[points[p] + 1]):
            a = errors.of_point[at]
            i = errors.image[a]
            B = errors.by_points[a]
            moved[:] = 0.0
            for b in range(errors.first[i], errors.first[i + 1]):
                dx, dy = errors.xy[a, 0] - errors.xy[b, 0], errors.xy[a, 1] - errors.xy[b, 1]
                shared = common * np.exp(-np.sqrt(dx * dx + dy * dy) / length_px)
                first = 3 * place[errors.point[b]]
                for c in range(unknowns):
                    moved[0, c] += shared * errors.by_cameras[b, 0, c]
                    moved[1, c] += shared * errors.by_cameras[b, 1, c]
                for x in range(3):
                    from_x, from_y = shared * B[0, x], shared * B[1, x]
                    for y in range(3):
                        with_points[3 * p + x, first + y] += (
                            from_x * errors.by_points[b, 0, y] + from_y * errors.by_points[b, 1, y]
                        )
            own, O = 3 * place[points[p]], errors.alone[a]
            for x in range(3):
                from_x = B[0, x] * O[0, 0] + B[1, x] * O[1, 0]
                from_y = B[0, x] * O[0, 1] + B[1, x] * O[1, 1]
                for y in range(3):
                    with_points[3 * p + x, own + y] += from_x * B[0, y] + from_y * B[1, y]
            for c in range(unknowns):
                for row in range(2):
                    moved[row, c] += (
                        O[row, 0] * errors.by_cameras[a, 0, c] + O[row, 1] * errors.by_cameras[a, 1, c]
                    )
            for c in range(unknowns):
                for x in range(3):
                    with_cameras[3 * p + x, column[i, c]] += B[0, x] * moved[0, c] + B[1, x] * moved[1, c]
                for q in range(unknowns):
                    cameras[i, q, c] += (
                        errors.by_cameras[a, 0, q] * moved[0, c] + errors.by_cameras[a, 1, q] * moved[1, c]
                    )


def largest_factor(
    observations: Observations,
    relative: FloatArray,
    correlation: ErrorCorrelation,
    which: BoolArray,
    most: float,
) -> float:
    """Return a bound of the factor of the variance of any function of errors, infinite beyond `most`.

    It is the largest row sum of R, which no eigenvalue of R exceeds (Gershgorin's theorem). The distances of
    many image points are those between the nearest parts of small cells, whose sums a convolution gives.

    Args:
        observations: k image points.
        relative: whitening of each image point relative to a usual one, (k, 2, 2).
        correlation: correlation of the errors.
        which: image points with correlated errors, (k,).
        most: largest factor that is asked for.

    Source: Golub and Van Loan (2013), Matrix Computations, sec. 7.2.1.
    """
    from scipy.signal import fftconvolve  # importing takes half a second, and most commands never need it

    side_px, factor = correlation.length_px / CELLS_PER_LENGTH, 1.0
    reach = LENGTHS_SUMMED * CELLS_PER_LENGTH
    o = observations
    for photograph in _photographs(o.image, o.xy, relative, correlation, which):
        if not len(photograph.rows):
            continue
        squares = np.linalg.norm(photograph.relative, ord=2, axis=(1, 2)) ** 2
        xy = photograph.xy - photograph.xy.min(axis=0)
        if len(xy) ** 2 < PAIRS_PER_CELL * np.prod(xy.max(axis=0) / side_px + 2 * reach):
            rows = np.arange(len(xy))
            parts = np.array_split(rows, 1 + 8 * len(xy) ** 2 // BYTES_AT_ONCE)
            exact = max(float((photograph.common(part) @ squares).max()) for part in parts)
            factor = max(factor, correlation.alone + exact)
            if factor > most:
                return np.inf
            continue
        cell = np.floor(xy / side_px).astype(np.int64)
        weight = np.zeros(cell.max(axis=0) + 1)
        np.add.at(weight, tuple(cell.T), squares)
        beside = np.arange(-reach, reach + 1)
        apart = np.maximum(np.abs(beside) - 1, 0) / CELLS_PER_LENGTH  # in correlation lengths
        shared = np.exp(-np.hypot(apart[:, None], apart))
        sums = fftconvolve(weight, shared, mode="full")
        middle = len(beside) // 2
        largest = float(sums[cell[:, 0] + middle, cell[:, 1] + middle].max())
        largest += float(np.exp(-LENGTHS_SUMMED) * weight.sum())
        factor = max(factor, correlation.alone + correlation.common * largest)
        if factor > most:
            return np.inf
    return factor


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

    def times(self, Z: FloatArray) -> FloatArray:
        """Return (R - I) Z of all image points from Z, both (r, 2, u); C is formed in parts."""
        of_shift = (np.swapaxes(self.relative, 1, 2) @ Z).reshape(len(Z), -1)
        parts = np.array_split(np.arange(len(Z)), 1 + 8 * len(Z) ** 2 // BYTES_AT_ONCE)
        moved = np.concatenate([self.common(part) @ of_shift for part in parts]).reshape(Z.shape)
        return np.asarray((self.correlation.alone - 1.0) * Z + self.relative @ moved)

    def common(self, rows: IntArray) -> FloatArray:
        """Return C between some image points and all, (s, r)."""
        C = cdist(self.xy[rows], self.xy)
        C /= -self.correlation.length_px
        np.exp(C, out=C)
        C *= self.correlation.common
        return np.asarray(C)


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
    F = whitening_matrices(o, weight)
    return Linearised(
        layout,
        optimum.factor,
        by_cameras + by_kept if kept.any() else by_cameras,
        _of_rays(B[~kept], of_point, ~kept, 3 * n),
        A,
        B,
        np.concatenate([6 * o.pose_of[:, None] + np.arange(6), o.free_column[o.camera, :f]], axis=1),
        csr_matrix(bsr_matrix((V_inverse, np.arange(n), np.arange(n + 1)))),
        np.where(kept[:, None, None], 0.0, B) @ V_inverse[o.point],
        F,
    )


def whitening_matrices(observations: Observations, weight: FloatArray) -> FloatArray:
    """Return F of each image point with F'F its weight, 1/px, (k, 2, 2), from factors on weights, (k,)."""
    F = np.zeros((len(weight), 2, 2))
    scale = np.sqrt(weight * observations.share)[:, None]
    F[:, 0, 0], F[:, 1, 0], F[:, 1, 1] = (observations.whitening * scale).T
    return F


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
