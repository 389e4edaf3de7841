"""Score test: the decrease of v'Pv that more freedom would bring, from the finished adjustment alone.

    H = B'PB - B'PA N^- A'PB,  g = B'Pv - B'PA N^- A'Pv,  gain = g' H^-1 g

A are the columns of the adjustment (photographs, free interior parameters, object points), B the columns of
an alternative, and v the residuals of the accepted image points. Object points are eliminated first, then
photographs and cameras, whose seven motions are fixed by inner constraints. If the alternative is false,
(gain / q) / ((v'Pv - gain) / (r - q)) has an F distribution.

If neighbouring image points have errors in common, the variance of g is D'RD instead of H = D'D, where D is B
after elimination of the unknowns. Many points with one common error then show it many times. So gains are
divided by the design effect, the sum of squares of the eigenvalues of H^-1 D'RD over their sum.

Source: Koch (1999), Parameter Estimation and Hypothesis Testing in Linear Models, sec. 4.2; Rao (1948), Proc.
Camb. Phil. Soc. 44, for the score test; Rao and Scott (1984), Annals of Statistics 12, for the design effect;
Foerstner and Wrobel (2016), sec. 4.6.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from sfm.adjustment.engine.correlated import correlated_sum
from sfm.adjustment.result import Adjustment
from sfm.judgement.hypotheses.columns import Columns, columns_of, interior_columns
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distributions import f_sf
from sfm.model.similarity import similarity_motions
from sfm.runtime.compiling import compiled, inlined

# Share of the squares of combined columns that must remain after eliminating photographs, cameras and points.
MIN_DETERMINED_SHARE = 1e-5
ROUNDING = float(np.sqrt(np.finfo(float).eps))  # share of the squares of a single column left by rounding


@dataclass(frozen=True)
class Reduced:
    """The accepted image points with object points, photographs and cameras eliminated.

    They are whitened by the weights and the a posteriori sigma0, so a gain is in units of the variance
    factor.
    """

    adjustment: Adjustment
    columns: Columns  # derivatives of all its image points
    used: IntArray  # accepted image points, (k,)
    F: FloatArray  # whitening of each image point, (k, 2, 2)
    v: FloatArray  # whitened residuals, (k, 2)
    image: IntArray  # photograph of each image point, (k,)
    point: IntArray  # object point of each image point, (k,)
    B: FloatArray  # whitened derivatives by object points, (k, 2, 3)
    A: FloatArray  # whitened derivatives by photographs and free interior parameters, (k, 2, 6 + i)
    L: FloatArray  # inverse Cholesky factors of the object points' normal equations, (n, 3, 3)
    W: FloatArray  # L B'A of each object point, (n, 3, a)
    Sinv: FloatArray  # inverse of the reduced normal matrix with inner constraints, (a, a)
    y: FloatArray  # L B'v, (n, 3)
    t: FloatArray  # right-hand side of photographs and cameras, reduced by the points, (a,)
    share: FloatArray  # what each image point counts, see `Network.share`, (k,)

    @property
    def photographs(self) -> int:
        """Number of photographs."""
        return len(self.adjustment.network.images)

    @property
    def redundancy(self) -> int:
        """Redundancy of the adjustment."""
        return self.adjustment.redundancy

    @property
    def count(self) -> float:
        """Number of accepted image coordinates, of which those with errors in common count in part."""
        return 2 * float(self.share.sum())

    def whiten(self, columns: FloatArray) -> FloatArray:
        """Return the whitened columns of accepted image points, from columns of all (k, 2, q)."""
        D = np.empty((len(self.used), 2, columns.shape[2]))
        _whiten(self.used, self.F, np.ascontiguousarray(columns), D)
        return D

    def project_by_run(self, D: FloatArray, run: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return H (u, f, u, f), g (u, f) and squares (u, f) of whitened columns (k, 2, f).

        Every run of photographs (m,) has f separate freedoms.
        """
        count, f = int(run.max()) + 1, D.shape[2]
        C, K = self._eliminated(D, run)
        flat = C.T @ C
        flat += K.T @ (self.Sinv @ K)
        H = -flat.reshape(count, f, count, f)
        g = -(C.T @ self.y.ravel() + K.T @ (self.Sinv @ self.t)).reshape(count, f)
        squares = np.zeros((count, f))
        _add_normals(np.ascontiguousarray(D), self.v, run[self.image], H, g, squares)
        return H, g, squares

    def project(self, D: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return H (q, q), g (q,) and the squares (q,) of whitened columns (k, 2, q)."""
        H, g, squares = self.project_by_run(D, np.zeros(self.photographs, dtype=np.int64))
        return H[0, :, 0], g[0], squares[0]

    def design_effect(self, D: FloatArray) -> float:
        """Return the factor by which correlated errors of neighbours multiply a gain by chance, at least 1.

        Only the directions that the whitened columns (k, 2, q) determine count.
        """
        a, network = self.adjustment, self.adjustment.network
        if a.error_correlation is None:
            return 1.0
        H, _, squares = self.project(D)
        correlated = correlated_sum(
            self.image,
            network.image_points.xy[self.used],
            a.sigma0_px * self.F,
            self.absorb(D)[2],
            a.error_correlation,
            network.may_correlate[self.used],
        )
        effects = determined_inverse(H, squares) @ (H + correlated)
        first = float(np.trace(effects))
        return max(float((effects * effects.T).sum()) / first, 1.0) if first > 0 else 1.0

    def scores(self, direction: FloatArray, step: FloatArray) -> FloatArray:
        """Return the contribution of each photograph to the slope along a direction, after a step, (m,).

        Args:
            direction: whitened effect of the direction on the image points, (k, 2).
            step: whitened effect of the step on the image points, (k, 2).
        """
        left = self.absorb(np.stack([direction, step], axis=2))[2]
        slope = ((self.v + left[:, :, 1]) * left[:, :, 0]).sum(axis=1)
        return np.asarray(np.bincount(self.image, slope, minlength=self.photographs), dtype=float)

    def contributions(self) -> tuple[FloatArray, FloatArray]:
        """Return what the residuals of each photograph contribute to points and free interior parameters.

        Returns:
            Shifts of object points, (n, 3, m), and of the interior parameters over their standard deviations,
            (i, m). They sum to zero over the photographs.
        """
        m = self.photographs
        D = np.zeros((len(self.used), 2, m))
        D[np.arange(len(self.used)), :, self.image] = self.v
        by_points, by_cameras, _ = self.absorb(D)
        sigma = np.sqrt(np.diagonal(self.Sinv)[6 * m :])
        return by_points, by_cameras[6 * m :] / sigma[:, None]

    def absorb(self, D: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what the unknowns absorb if the effect of whitened columns (k, 2, q) is in the image points.

        Returns:
            Shifts of object points (n, 3, q), those of photographs and cameras (a, q), and what is left of
            the columns, (k, 2, q).
        """
        n, m, q = len(self.L), self.photographs, D.shape[2]
        C, K = self._eliminated(D, np.zeros(m, dtype=np.int64))
        by_cameras = self.Sinv @ K
        by_points = np.swapaxes(self.L, 1, 2) @ (C.reshape(n, 3, q) - self.W @ by_cameras)
        left = D - self.B @ by_points[self.point]
        left -= self.A[:, :, :6] @ by_cameras[: 6 * m].reshape(m, 6, q)[self.image]
        left -= self.A[:, :, 6:] @ by_cameras[6 * m :]
        return by_points, by_cameras, left

    def _eliminated(self, D: FloatArray, run: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return L B'D (3 n, u f), and A'D (a, u f) reduced by the object points."""
        n, m, f, count = len(self.L), self.photographs, D.shape[2], int(run.max()) + 1
        by_points, K = np.zeros((n, 3, count, f)), np.zeros((len(self.t), count, f))
        B, A, D = (np.ascontiguousarray(array) for array in (self.B, self.A, D))
        _sum_products(B, A, D, self.image, self.point, run[self.image], by_points, K, m)
        C = (self.L @ by_points.reshape(n, 3, count * f)).reshape(3 * n, count * f)
        return C, K.reshape(len(self.t), count * f) - self.W.reshape(3 * n, -1).T @ C


@compiled
def _sum_products(
    B: FloatArray, A: FloatArray, D: FloatArray, image: IntArray, point: IntArray, run: IntArray,
    by_points: FloatArray, by_cameras: FloatArray, m: int,
) -> None:  # fmt: skip
    """Add B'D to each object point (n, 3, u, f), and A'D to photographs and cameras, (a, u, f).

    Args:
        B: derivatives by object points, (k, 2, 3).
        A: those by photographs and interior parameters, (k, 2, 6 + i).
        D: columns, (k, 2, f).
        image: photograph of each image point, (k,).
        point: object point of each image point, (k,).
        run: run of photographs of each image point, (k,).
        by_points: sums of object points.
        by_cameras: sums of m photographs, 6 rows each, and of i interior parameters.
        m: number of photographs.
    """
    ends = np.empty(D.shape[2] + 1, dtype=np.int64)
    for k in range(len(D)):
        u, x, y = run[k], D[k, 0], D[k, 1]
        stretches = _stretches(x, y, ends)
        for c in range(3 + A.shape[2]):
            if c < 3:
                a, b, total = B[k, 0, c], B[k, 1, c], by_points[point[k], c, u]
            else:
                row = 6 * image[k] + c - 3 if c < 9 else 6 * (m - 1) + c - 3
                a, b, total = A[k, 0, c - 3], A[k, 1, c - 3], by_cameras[row, u]
            if a != 0.0 or b != 0.0:
                for s in range(0, stretches, 2):
                    for j in range(ends[s], ends[s + 1]):
                        total[j] += a * x[j] + b * y[j]


@compiled
def _add_normals(
    D: FloatArray, v: FloatArray, run: IntArray, H: FloatArray, g: FloatArray, squares: FloatArray
) -> None:
    """Add D'D to the diagonal blocks of H, (u, f, u, f), and D'v to g, (u, f), of each run of photographs.

    Args:
        D: columns, (k, 2, f).
        v: residuals, (k, 2).
        run: run of each image point, (k,).
        H: normal equations.
        g: right-hand sides.
        squares: receives the squares of the columns, (u, f).
    """
    f, count = D.shape[2], len(g)
    N, ends = np.zeros((count, f, f)), np.empty(f + 1, dtype=np.int64)
    for k in range(len(D)):
        u, x, y = run[k], D[k, 0], D[k, 1]
        stretches = _stretches(x, y, ends)
        for r in range(0, stretches, 2):
            for i in range(ends[r], ends[r + 1]):
                a, b, row = x[i], y[i], N[u, i]
                g[u, i] += a * v[k, 0] + b * v[k, 1]
                for j in range(i, ends[r + 1]):
                    row[j] += a * x[j] + b * y[j]
                for s in range(r + 2, stretches, 2):
                    for j in range(ends[s], ends[s + 1]):
                        row[j] += a * x[j] + b * y[j]
    for u in range(count):
        for i in range(f):
            squares[u, i] = N[u, i, i]
            H[u, i, u, i] += N[u, i, i]
            for j in range(i + 1, f):
                H[u, i, u, j] += N[u, i, j]
                H[u, j, u, i] += N[u, i, j]


@inlined
def _stretches(x: FloatArray, y: FloatArray, ends: IntArray) -> int:
    """Fill in the first and end of each stretch of columns that are not 0; return how many these are."""
    count, within = 0, False
    for j in range(len(x)):
        moves = x[j] != 0.0 or y[j] != 0.0
        if moves != within:
            ends[count] = j
            count, within = count + 1, moves
    if within:
        ends[count] = len(x)
        count += 1
    return count


def reduce_adjustment(a: Adjustment) -> Reduced:
    """Return the accepted image points of an adjustment with all its unknowns eliminated.

    Args:
        a: adjustment of image points, alone or with control, without scale bars or observed orientation.

    Raises:
        numpy.linalg.LinAlgError: the network is not determined.
    """
    network, m, n = a.network, len(a.network.images), len(a.network.points)
    seen, columns = network.image_points, columns_of(a)
    weight, slope_of_given, fixed = _given_points(a)
    usable = ~a.rejected & columns.usable & np.isfinite(a.residuals).all(axis=1)
    several = np.bincount(seen.point[usable], minlength=n) > 1
    usable &= (several | fixed.any(axis=1) | weight.any(axis=(1, 2)))[seen.point]
    used = np.flatnonzero(usable)
    share = network.share[used]
    P = np.linalg.inv(a.image_covariance[used]) * (share / a.sigma0**2)[:, None, None]
    F = np.ascontiguousarray(np.swapaxes(np.linalg.cholesky(P), 1, 2))
    image, point = seen.image[used], seen.point[used]
    interior, prior, slope = _free_interior(a)
    v, B = np.einsum("kab,kb->ka", F, a.residuals[used]), np.empty((len(used), 2, 3))
    A = np.empty((len(used), 2, 6 + interior.shape[2]))
    _whiten(used, F, columns.point, B)
    _whiten(used, F, columns.exterior, A[:, :, :6])
    _whiten(used, F, interior, A[:, :, 6:])
    if fixed.any():
        B[np.swapaxes(np.broadcast_to(fixed[point, :, None], (len(used), 3, 2)), 1, 2)] = 0.0
    size = 6 * m + interior.shape[2]
    V, gp, W = weight, slope_of_given, np.zeros((n, 3, size))
    add_to_points(B, A, v, image, point, m, V, gp, W)
    V[~V.any(axis=2)] += np.tile(np.eye(3), (n, 1, 1))[~V.any(axis=2)]  # fixed or not seen
    L = np.linalg.inv(np.linalg.cholesky(V))
    W = L @ W
    y = np.einsum("nab,nb->na", L, gp)
    flat = W.reshape(3 * n, size)
    S, t = _camera_normals(A, image, v, m, size)
    S[6 * m :, 6 * m :] += prior
    t[6 * m :] += slope
    S -= flat.T @ flat
    t = t - flat.T @ y.ravel()
    if a.datum != "control":
        S += _constraints(a, S, m)
    idle = np.diagonal(S) == 0  # photographs without accepted image points
    S[idle, idle] = 1.0
    scale = 1 / np.sqrt(np.diagonal(S))
    inverse = cho_solve(cho_factor(S * scale[:, None] * scale), np.diag(scale)) * scale[:, None]
    return Reduced(
        adjustment=a,
        columns=columns,
        used=used,
        F=F,
        v=v,
        image=image,
        point=point,
        B=B,
        A=A,
        L=L,
        W=W,
        Sinv=inverse,
        y=y,
        t=t,
        share=share,
    )


def _given_points(a: Adjustment) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return weight (n, 3, 3) and slope (n, 3) of control points, and which coordinates are fixed, (n, 3)."""
    n, control = len(a.network.points), a.network.control
    weight, slope, fixed = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3), dtype=bool)
    if a.datum != "control":
        return weight, slope, fixed
    for j, xyz, stated in zip(control.point.tolist(), control.xyz, control.covariance, strict=True):
        variance = np.diagonal(stated)
        fixed[j], weighted = variance == 0, np.isfinite(variance) & (variance > 0)
        P = np.linalg.inv(stated[np.ix_(weighted, weighted)]) / a.sigma0**2
        weight[j][np.ix_(weighted, weighted)] = P
        slope[j][weighted] = P @ (a.estimate.points[j] - xyz)[weighted]
    return weight, slope, fixed


@compiled
def _whiten(used: IntArray, F: FloatArray, columns: FloatArray, whitened: FloatArray) -> None:
    """Fill in the whitened columns of the accepted image points.

    Args:
        used: accepted image points, (k,).
        F: upper triangular whitening of each of them, (k, 2, 2).
        columns: columns of all image points, px, (all, 2, q).
        whitened: to fill, (k, 2, q).
    """
    for k in range(len(used)):
        x, y, a, b, c = columns[used[k], 0], columns[used[k], 1], F[k, 0, 0], F[k, 0, 1], F[k, 1, 1]
        for j in range(len(x)):
            whitened[k, 0, j] = a * x[j] + b * y[j]
            whitened[k, 1, j] = c * y[j]


@compiled
def add_to_points(
    B: FloatArray, A: FloatArray, v: FloatArray, image: IntArray, point: IntArray, m: int,
    V: FloatArray, g: FloatArray, W: FloatArray,
) -> None:  # fmt: skip
    """Add B'B, B'v and B'A of image points to their object points.

    Args:
        B: derivatives by object points, (k, 2, 3).
        A: those by photographs and interior parameters, (k, 2, 6 + i).
        v: residuals, (k, 2).
        image: photograph of each image point, (k,).
        point: object point of each image point, (k,).
        m: number of photographs.
        V: sums of B'B, (n, 3, 3).
        g: sums of B'v, (n, 3).
        W: sums of B'A by m photographs, 6 columns each, and by i interior parameters, (n, 3, 6 m + i).
    """
    for k in range(len(B)):
        j, first = point[k], 6 * image[k]
        for p in range(3):
            a, b, row = B[k, 0, p], B[k, 1, p], W[j, p]
            g[j, p] += a * v[k, 0] + b * v[k, 1]
            for q in range(3):
                V[j, p, q] += a * B[k, 0, q] + b * B[k, 1, q]
            for q in range(6):
                row[first + q] += a * A[k, 0, q] + b * A[k, 1, q]
            for q in range(6, A.shape[2]):
                row[6 * (m - 1) + q] += a * A[k, 0, q] + b * A[k, 1, q]


def _free_interior(a: Adjustment) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the columns of free interior parameters, (k, 2, i), and weight and slope of given values."""
    network, cameras = a.network, a.estimate.cameras
    used = np.unique(network.camera).tolist()
    columns, keys, units = interior_columns(
        a, [(index, int(s)) for index in used for s in np.flatnonzero(cameras[index].free)]
    )
    given = network.interior
    rows, per_unit, off = [], [], []
    for row, (index, s) in enumerate(zip(given.camera.tolist(), given.parameter.tolist(), strict=True)):
        camera = cameras[index]
        key = (camera.owner_of(s), camera.names[s])
        if key in keys and given.sigma[row] > 0:
            rows.append(row)
            per_unit.append(np.where([other == key for other in keys], units, 0.0))
            off.append(float(camera.parameters[s] - given.value[row]))
    if not rows:
        return columns, np.zeros((len(keys), len(keys))), np.zeros(len(keys))
    J = np.array(per_unit)
    P = given.weight_of(np.array(rows)) / a.sigma0**2
    return columns, J.T @ P @ J, J.T @ P @ np.array(off)


@compiled
def _camera_normals(
    A: FloatArray, image: IntArray, v: FloatArray, m: int, size: int
) -> tuple[FloatArray, FloatArray]:
    """Return A'A (a, a) and A'v (a,) of photographs and cameras."""
    S, t = np.zeros((size, size)), np.zeros(size)
    for k in range(len(A)):
        x, y, own, common = A[k, 0], A[k, 1], 6 * image[k], 6 * (m - 1)
        for p in range(A.shape[2]):
            a, b = x[p], y[p]
            if a != 0.0 or b != 0.0:  # of another camera
                row = own + p if p < 6 else common + p
                t[row] += a * v[k, 0] + b * v[k, 1]
                total = S[row]
                for q in range(p, 6):
                    total[own + q] += a * x[q] + b * y[q]
                for q in range(max(p, 6), A.shape[2]):
                    total[common + q] += a * x[q] + b * y[q]
    for row in range(size):
        for column in range(row):
            S[row, column] = S[column, row]
    return S, t


def _constraints(a: Adjustment, S: FloatArray, m: int) -> FloatArray:
    """Return G G' of the seven motions of the photographs, scaled like the normal equations."""
    X0, R = a.estimate.position, a.estimate.rotation
    centre = X0.mean(axis=0)
    G = np.zeros((m, 6, 7))
    G[:, :3], G[:, 3:, 3:6] = similarity_motions(X0, centre=centre), np.swapaxes(R, 1, 2)
    scale = np.sqrt(np.diagonal(S)[: 6 * m])
    heavy = np.zeros_like(S)
    Q = np.linalg.qr(scale[:, None] * G.reshape(6 * m, 7))[0]
    # with N scaled to a unit diagonal the constraints G'D dx = 0 have weight 1
    heavy[: 6 * m, : 6 * m] = scale[:, None] * (Q @ Q.T) * scale
    return heavy


@dataclass(frozen=True)
class Gain:
    """The decrease of v'Pv by an alternative, divided by the variance factor."""

    value: float
    rank: int  # number of its parameters that the image points determine
    beta: FloatArray  # step of its parameters, (q,)


NO_GAIN = Gain(0.0, 0, np.zeros(0))


def directions_of(H: FloatArray, squares: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the eigenvectors of scaled normal equations, and the share of the squares left in each.

    Args:
        H: normal equations after elimination, (..., q, q).
        squares: squares of the columns before elimination, (..., q).

    Returns:
        Share left in each direction, (..., q), the directions, (..., q, q), and the scale of the columns to
        which they refer, (..., q).
    """
    scale = np.where(squares > 0, 1 / np.sqrt(np.where(squares > 0, squares, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(H * scale[..., :, None] * scale[..., None, :])
    return values, vectors, scale


def least_share(columns: int) -> float:
    """Return the share of the squares above which directions of a number of columns count as determined.

    With several columns, a direction below it is left out, because the step along it would exceed the linear
    range. A single column has no other direction; an example is x0, if P1 and a rotation absorb most of it.
    """
    return MIN_DETERMINED_SHARE if columns > 1 else ROUNDING


def gain_of(H: FloatArray, g: FloatArray, squares: FloatArray, least: float = MIN_DETERMINED_SHARE) -> Gain:
    """Return the gain of columns.

    Args:
        H: normal equations after elimination, (q, q).
        g: right-hand side, (q,).
        squares: squares of the columns before elimination, (q,).
        least: share of the squares above which directions count as determined.
    """
    values, vectors, scale = directions_of(H, squares)
    good = values > least
    projected = vectors[:, good].T @ (scale * g)
    beta = -scale * (vectors[:, good] @ (projected / values[good]))
    return Gain(float((projected**2 / values[good]).sum()), int(good.sum()), beta)


def determined_inverse(H: FloatArray, squares: FloatArray, least: float = MIN_DETERMINED_SHARE) -> FloatArray:
    """Return the inverse of normal equations in the directions that are determined, as in `gain_of`."""
    values, vectors, scale = directions_of(H, squares)
    good = values > least
    half = scale[:, None] * vectors[:, good] / np.sqrt(values[good])
    return np.asarray(half @ half.T)


def gains_of(H: FloatArray, g: FloatArray, squares: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return gains (n,), ranks (n,) and steps (n, q) of separate alternatives, see `gain_of`."""
    values, vectors, scale = directions_of(H, squares)
    good = values > MIN_DETERMINED_SHARE
    projected = np.einsum("nij,ni->nj", vectors, scale * g)
    steps = np.where(good, projected / np.where(good, values, 1.0), 0.0)
    beta = -scale * np.einsum("nij,nj->ni", vectors, steps)
    return (projected * steps).sum(axis=1), good.sum(axis=1), beta


def log_probability(gain: float, q: int, redundancy: int) -> float:
    """Return ln of the probability of such a gain by chance.

    Args:
        gain: decrease of v'Pv over the variance factor.
        q: number of parameters.
        redundancy: redundancy r, which equals v'Pv over the variance factor.
    """
    left = redundancy - gain
    if q < 1 or redundancy <= q:
        return 0.0
    return log_f_sf((gain / q) / (left / (redundancy - q)), q, redundancy - q) if left > 0 else -np.inf


def log_f_sf(f: float, q: int, d: int) -> float:
    """Return ln of the probability that F of redundancies q and d is larger than f, at least -708."""
    return float(np.log(max(float(f_sf(f, q, d)), np.finfo(float).tiny)))


def log_likelihood_gain(gain: float, redundancy: int) -> float:
    """Return the growth of ln likelihood if v'Pv falls from r by a gain, with unknown sigma0.

    Source: Patterson and Thompson (1971), Biometrika 58, for the restricted likelihood.
    """
    left = max(redundancy - gain, np.finfo(float).tiny)
    return float(redundancy / 2 * (np.log(redundancy) - np.log(left)))


def squares_gained(gain: float, redundancy: int) -> float:
    """Return the decrease of v'Pv from r if ln likelihood grows by a gain."""
    return float(redundancy * -np.expm1(-2 * gain / redundancy))


@dataclass(frozen=True)
class Spread:
    """Variance between parts that an alternative does not concern, relative to that expected by chance.

    Image points of one photograph have common errors that no weight states: from the lens, the shutter, or
    light from one side. Photographs then differ individually, and an effect in some of them must be larger
    than that. The same holds for points, because each has errors of its target.
    """

    factor: float = 1.0  # ratio of the variances
    redundancy: int = 10**9  # redundancy of the variance
    among: bool = True  # whether an alternative that concerns some of the parts was chosen from them

    def ratio(self, gain: float, q: int, redundancy: int) -> float:
        """Return the ratio of a gain, per parameter, to the spread of the parts; see `log_probability`."""
        left = max(redundancy - gain, 1.0) / redundancy  # remaining share of the variance factor
        return gain / max(q, 1) / max(self.factor, 1.0) / left

    def evidence(self, gain: float, q: int, redundancy: int) -> float:
        """Return the growth of ln likelihood before the price of the parameters; arguments as in `ratio`."""
        grows = log_likelihood_gain(gain, redundancy)
        if self.factor <= 1:
            return grows
        if not self.among:
            return log_likelihood_gain(gain / self.factor, redundancy)
        f = max(self.ratio(gain, q, redundancy), 0.0)  # a loss is no evidence
        return min(grows, float(self.redundancy / 2 * np.log1p(f * q / self.redundancy)))


NONE = Spread()
