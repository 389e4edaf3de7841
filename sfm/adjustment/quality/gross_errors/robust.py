"""Gross errors: iterative data snooping by Pope's tau with reinstatement, Huber's and Tukey's M-estimators.

Data snooping takes out, round by round, the image points of the largest tau above the critical value:
the largest of all, and with it others whose photograph and object point hold no larger one, so that
none is judged beside a larger error. In a photograph of many image points an error moves the residuals of
the others by its leverage only, some hundredths of it: there all those go that are not much smaller than the
largest, and further rays of an object point that has lost one go one after another in the same round
(`rays_of_points`). A rejected point is taken back when it would clearly pass the test in the adjustment.

Huber's estimator bounds the influence of an image point, Tukey's biweight takes it back to nothing:
beyond TUKEY standard deviations an image point has weight 0. It starts from Huber's, because its sum
has many minima, and both take their scale from the median of the residuals.

Several wrong rays of one object point, taken out one after another from one adjustment. A ray that leaves
moves the residuals of the other rays of its point much, and those of all else by its leverage on a photograph
only. With the cameras fixed the cofactors of the residuals of a point's rays are I - B V^-1 B', and residuals
and cofactors after a ray has left follow from those before, without another adjustment.

Source: Pope (1976), NOAA TR NOS 65 NGS 1; Kok (1984), On data snooping and multiple outlier testing; Huber
and Ronchetti (2009), Robust Statistics, ch. 7; Beaton and Tukey (1974), Technometrics 16(2), for the
biweight; Maronna et al. (2019), Robust Statistics, sec. 2.3, for efficiency; Cook and Weisberg (1982),
Residuals and Influence in Regression, sec. 2.2.3, for the residuals when observations are left out; Foerstner
and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.engine.collinearity import Observations, State, residuals
from sfm.adjustment.quality.statistics import standardised_residuals, tau_critical, whitening_matrix
from sfm.adjustment.result import MIN_SIGMA_PX, ROUNDING
from sfm.conventions import MAD_TO_SIGMA, BoolArray, FloatArray

MIN_RAYS = 3  # of a point, of which residuals show the wrong one
# Over the image points of a photograph: share by which the photograph may change a standardised residual,
# about three times its six unknowns over two coordinates each
INFLUENCE = 8.0
MIN_REDUNDANCY = 1e-6  # of a ray in the direction that the others check less, over the other

# In sigmas of a coordinate, for the length of a residual vector: both are 95 % efficient with normal errors
# in the plane (for a single coordinate they would be 1.345 and 4.685).
HUBER = 1.501
TUKEY = 5.123
# In a photograph of n image points an error moves the residual of another by about 6 / (2 n) of itself, at
# most some times that: beside MIN_CROWDED_POINTS points one of BESIDE_FRACTION of the largest tau is a
# separate error.
MIN_CROWDED_POINTS = 60
BESIDE_FRACTION = 0.4
# Of the critical value: a rejected one returns below, since at it rounds turn in circles.
RETURN_FRACTION = 0.99
MIN_FREEDOM = 0.05  # of redundancy over observations, so that a network without redundancy has a scale


def snoop(
    observations: Observations,
    state: State,
    residuals: FloatArray,
    complement: FloatArray,
    limiting: FloatArray,
    used: BoolArray,
    *,
    sigma0: float,
    critical: float,
) -> BoolArray:
    """Return which image points to take out in one round, (k,).

    Args:
        observations: image points.
        state: the unknowns.
        residuals: v of all image points, rejected ones predicted, px, shape (k, 2).
        complement: whitened cofactors of the residuals, shape (k, 2, 2).
        limiting: cofactors of each object point with the cameras fixed, shape (n, 3, 3).
        used: image points in the adjustment, shape (k,).
        sigma0: of the adjustment, at least the rounding of image points.
        critical: value of tau that the test of one image coordinate does not let pass.
    """
    w = np.abs(standardised_residuals(residuals, complement, observations.whitening)).max(axis=1)
    w = np.where(np.isfinite(w), w, np.inf)
    tau = w / sigma0
    suspect = used & (tau > critical)
    worst_image = np.zeros(len(observations.camera))
    np.maximum.at(worst_image, observations.image[suspect], tau[suspect])
    crowded = np.bincount(observations.image[used], minlength=len(worst_image)) >= MIN_CROWDED_POINTS
    worst_image[crowded] *= BESIDE_FRACTION
    worst_point = np.zeros(len(observations.start) - 1)
    np.maximum.at(worst_point, observations.point[suspect], tau[suspect])
    out = suspect & (tau >= worst_image[observations.image]) & (tau >= worst_point[observations.point])
    least = np.where(crowded, np.maximum(worst_image, critical), np.inf) * sigma0
    return out | further_rays(observations, state, residuals, complement, limiting, used, out, least=least)


def sum_of_squares(
    observations: Observations, residuals: FloatArray, complement: FloatArray, used: BoolArray
) -> tuple[float, float]:
    """Return v'Pv and redundancy of the image points in an adjustment, by themselves.

    Other observations, whose standard deviations are stated by a person, say nothing of their noise.

    Args:
        observations: image points.
        residuals: v, px, (k, 2).
        complement: whitened cofactors of the residuals, (k, 2, 2).
        used: image points in the adjustment, (k,).
    """
    v = np.einsum("kab,kb->ka", whitening_matrix(observations.whitening[used]), residuals[used])
    of_each = np.einsum("kaa->k", complement[used])  # between 0 and 2, but for what rounding leaves of it
    return float((v**2).sum()), float(np.clip(of_each, 0.0, 2.0).sum())


def would_pass(
    observations: Observations,
    residuals: FloatArray,
    complement: FloatArray,
    used: BoolArray,
    *,
    vPv: float,
    redundancy: float,
    alpha: float,
) -> BoolArray:
    """Return which rejected image points would clearly pass the test if each were in the adjustment, (k,).

    Whitened, with H = A Q A' without the image point: its residual (I + H)^-1 l from the predicted one l, the
    cofactor (I + H)^-1 of that, and l' (I + H)^-1 l more in the sum of squares.

    Args:
        observations: image points.
        residuals: v of all image points, rejected ones predicted, px, shape (k, 2).
        complement: whitened cofactors of the residuals, I + H of rejected ones, shape (k, 2, 2).
        used: image points in the adjustment, shape (k,).
        vPv: weighted sum of squares of the image points in the adjustment, see `sum_of_squares`.
        redundancy: of the same.
        alpha: probability with which the test of one image coordinate rejects a good one.

    Source: Cook and Weisberg (1982), Residuals and Influence in Regression, sec. 2.2.3.
    """
    rows = np.flatnonzero(
        ~used & np.isfinite(residuals).all(axis=1) & np.isfinite(complement).all(axis=(1, 2))
    )
    F = whitening_matrix(observations.whitening[rows])
    # No eigenvalue of I + H is below 1, but rounding leaves nothing of one beside that of a ray without which
    # its point has no place along the other.
    values, vectors = np.linalg.eigh(complement[rows])
    cofactor = np.asarray(vectors / np.maximum(values, 1.0)[:, None] @ vectors.transpose(0, 2, 1))
    predicted = np.einsum("kab,kb->ka", F, residuals[rows])
    inside = np.einsum("kab,kb->ka", cofactor, predicted)
    v = np.linalg.solve(F, inside[:, :, None])[:, :, 0]
    w = np.abs(standardised_residuals(v, cofactor, observations.whitening[rows])).max(axis=1)
    sigma0 = np.sqrt((vPv + np.sum(predicted * inside, axis=1)) / (redundancy + 2))
    sigma0 = np.maximum(sigma0, rounding_of(observations))
    passes = np.zeros(len(used), dtype=bool)
    passes[rows] = w <= RETURN_FRACTION * tau_critical(alpha, redundancy + 2) * sigma0
    return passes


def rounding_of(observations: Observations) -> float:
    """Return what rounding makes of a residual, in standard deviations: below it nothing can be tested."""
    size = float(np.abs(observations.xy).max(initial=0.0))
    return max(ROUNDING * size * float(observations.whitening[:, 0].max(initial=0.0)), np.finfo(float).tiny)


def least_sigma(observations: Observations) -> float:
    """Return MIN_SIGMA_PX in stated standard deviations; residuals below it show no gross error."""
    return MIN_SIGMA_PX * float(observations.whitening[:, 0].max(initial=0.0))


def huber_weights(observations: Observations, residuals: FloatArray, *, sigma0: float) -> FloatArray:
    """Return the factor min(1, HUBER / |v|) on the weight of each image point, (k,).

    Args:
        observations: image points.
        residuals: v, px, shape (k, 2).
        sigma0: standard deviation of unit weight.
    """
    size = residual_lengths(observations, residuals) / sigma0
    return np.where(size > HUBER, HUBER / np.maximum(size, HUBER), 1.0)


def tukey_weights(observations: Observations, residuals: FloatArray, *, sigma0: float) -> FloatArray:
    """Return the factor (1 - (|v| / TUKEY)^2)^2 on the weight of each image point, 0 beyond TUKEY, (k,).

    Args:
        observations: image points.
        residuals: v, px, shape (k, 2).
        sigma0: standard deviation of unit weight.
    """
    share = np.minimum(residual_lengths(observations, residuals) / (TUKEY * sigma0), 1.0)
    return np.asarray((1.0 - share**2) ** 2)


def huber_slopes(weight: FloatArray) -> FloatArray:
    """Return the derivatives of psi(v) = w(|v|) v along v and across it, from Huber's weights, (k, 2)."""
    return np.stack([np.where(weight < 1.0, 0.0, 1.0), weight], axis=1)


def tukey_slopes(weight: FloatArray) -> FloatArray:
    """Return the derivatives of psi(v) = w(|v|) v along v and across it, from Tukey's weights, (k, 2)."""
    root = np.sqrt(weight)  # 1 - (|v| / TUKEY)^2
    return np.stack([root * (5.0 * root - 4.0), weight], axis=1)


def inflation(
    observations: Observations,
    residuals: FloatArray,
    weight: FloatArray,
    slopes: FloatArray,
    *,
    vPv: float,
    count: int,
    redundancy: float,
) -> float:
    """Return by what to multiply sqrt(v'Pv / r) for the standard deviations of an M-estimator.

    Its covariance is K^2 [sum psi^2 / r] / [mean psi']^2 (X'X)^-1, K = 1 + (u / n) var psi' / [mean psi']^2,
    while v'Pv / r belongs to the cofactors (X'WX)^-1, which are (X'X)^-1 over the mean weight. It is
    asymptotic: standard deviations are about 2 % too small where the redundancy is 3/4 of the observations,
    and 3 % (Huber) to 8 % (Tukey) where it is 0.4 to 0.6 of them.

    Args:
        observations: image points.
        residuals: v, px, shape (k, 2).
        weight: of the estimator at its end, shape (k,).
        slopes: psi' along and across the residual, shape (k, 2).
        vPv: sum of squares of all observations with these weights; those that are no image points have 1.
        count: n, scalar observations of weight above 0.
        redundancy: r = n - u.

    Source: Huber and Ronchetti (2009), Robust Statistics, sec. 7.6, here for vectors in the plane.
    """
    used = weight > 0
    w = weight[used]
    others = count - 2 * len(w)
    psi2 = vPv - float((w * (1 - w)) @ residual_lengths(observations, residuals)[used] ** 2)
    slope = np.concatenate([slopes[used].ravel(), np.ones(others)])
    mean = float(slope.mean())
    K = 1 + (count - redundancy) / count * float(slope.var()) / mean**2
    mean_weight = (2 * float(w.sum()) + others) / count
    return float(np.sqrt(psi2 / vPv * mean_weight) * K / mean)


def robust_scale(
    observations: Observations, residuals: FloatArray, used: BoolArray, *, freedom: float
) -> float:
    """Return the standard deviation of unit weight from the median of the residuals.

    Half of the image points may be wrong before it is.

    Args:
        observations: image points.
        residuals: v, px, shape (k, 2).
        used: image points that can take part, shape (k,).
        freedom: redundancy over observations, by which residuals are smaller than errors.

    Source: Hampel (1974), J. Am. Stat. Assoc. 69, for the median absolute deviation.
    """
    a, b, c = observations.whitening[used].T
    v = residuals[used]
    whitened = np.abs(np.concatenate([a * v[:, 0], b * v[:, 0] + c * v[:, 1]]))
    scale = MAD_TO_SIGMA * float(np.median(whitened)) / np.sqrt(max(freedom, MIN_FREEDOM))
    return float(max(scale, np.finfo(float).tiny))


def residual_lengths(observations: Observations, residuals: FloatArray) -> FloatArray:
    """Return the lengths of the residuals in their standard deviations, infinite behind the camera, (k,)."""
    a, b, c = observations.whitening.T
    length = np.hypot(a * residuals[:, 0], b * residuals[:, 0] + c * residuals[:, 1])
    return np.where(np.isfinite(length), length, np.inf)


def further_rays(
    observations: Observations,
    state: State,
    v: FloatArray,
    complement: FloatArray,
    limiting: FloatArray,
    used: BoolArray,
    out: BoolArray,
    *,
    least: FloatArray,
) -> BoolArray:
    """Return the rays of points that lose one to take out with it, as if one left after another, (k,).

    A point ends with a ray that is its worst and may not leave, or not plainly the worst.

    Args:
        observations: image points, ordered by object point.
        state: the unknowns.
        v: residuals of all image points, px, shape (k, 2).
        complement: whitened cofactors of the residuals, shape (k, 2, 2).
        limiting: cofactors of each object point with the cameras fixed, shape (n, 3, 3).
        used: image points in the adjustment, shape (k,).
        out: those that leave it first, shape (k,).
        least: standardised residual above which image points of each photograph may leave, shape (m,).
    """
    further = np.zeros(len(used), dtype=bool)
    count = np.bincount(observations.image[used], minlength=len(least))
    F, B = whitening_matrix(observations.whitening), _by_points(observations, state, v, limiting)
    sound = used & np.isfinite(v).all(axis=1) & np.isfinite(complement).all(axis=(1, 2))
    for j in np.unique(observations.point[out]).tolist():
        rows = np.arange(observations.start[j], observations.start[j + 1])
        rows = rows[sound[rows]]
        e = np.einsum("kab,kb->ka", F[rows], v[rows])
        rays = _Rays(e, complement[rows], F[rows] @ B[rows], limiting[j])
        left = np.ones(len(rows), dtype=bool)
        leaving = np.flatnonzero(out[rows]).tolist()
        while leaving:
            for a in leaving:
                rays = rays.without(a)
            left[leaving] = False
            rest = np.flatnonzero(left)
            leaving = []
            if len(rest) >= MIN_RAYS:
                back = np.asarray(np.linalg.solve(F[rows[rest]], rays.e[rest, :, None])[:, :, 0], dtype=float)
                w = standardised_residuals(back, rays.Q[rest], observations.whitening[rows[rest]])
                size = np.abs(w).max(axis=1)
                second, worst = np.argsort(size)[-2:].tolist()
                i = observations.image[rows[rest[worst]]]
                if size[worst] > max(least[i], (1 + INFLUENCE / count[i]) * size[second]):
                    leaving = [int(rest[worst])]
        further[rows[~left]] = True
    return further & ~out


@dataclass(frozen=True)
class _Rays:
    """Rays of one point, whitened."""

    e: FloatArray  # residuals, (r, 2)
    Q: FloatArray  # their cofactors, (r, 2, 2)
    B: FloatArray  # derivatives by the point, (r, 2, 3)
    C: FloatArray  # cofactors of the point, (3, 3): -B C B' are those of two residuals

    def without(self, a: int) -> _Rays:
        """Return what is left when one of them leaves; its place means nothing afterwards."""
        with_a = -self.B @ self.C @ self.B[a].T
        weight = np.linalg.pinv(self.Q[a], rcond=MIN_REDUNDANCY, hermitian=True)
        gain = with_a @ weight
        to_point = self.C @ self.B[a].T
        return _Rays(
            self.e - gain @ self.e[a],
            self.Q - gain @ np.swapaxes(with_a, 1, 2),
            self.B,
            self.C + to_point @ weight @ to_point.T,
        )


def _by_points(observations: Observations, state: State, v: FloatArray, limiting: FloatArray) -> FloatArray:
    """Return the derivatives of the image points by their object point, px over unit, (k, 2, 3).

    By differences over the standard deviation of the point, within which image points move in proportion.
    """
    h = np.sqrt(np.maximum(np.trace(limiting, axis1=1, axis2=2), 0.0))
    B = np.zeros((len(v), 2, 3))
    for p in range(3):
        moved = state.points.copy()
        moved[:, p] += h
        step = moved[:, p] - state.points[:, p]
        free = (step != 0)[observations.point]  # a point that is held has no cofactors to multiply
        difference = residuals(observations, state._replace(points=moved)) - v
        B[free, :, p] = difference[free] / step[observations.point[free], None]
    return B
