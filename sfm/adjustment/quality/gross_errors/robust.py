"""Gross errors: iterative data snooping by Pope's tau with reinstatement, Huber's and Tukey's M-estimators.

**Data snooping** (`snoop`) rejects, round by round, the image points with the largest tau above the critical
value. It rejects the largest of all, and others whose photograph and object point contain no larger one. So
no image point is judged next to a larger error. In a photograph with many image points, an error affects the
residuals of the others only by its leverage, a few hundredths of it. There all image points are rejected
whose tau is not much smaller than the largest. A rejected image point is reinstated (`would_pass`) when it
would clearly pass the test in the adjustment.

**Several wrong rays of one object point** (`further_rays`) are rejected one after another in the same round.
A rejected ray changes the residuals of the other rays of its point strongly. It changes all other residuals
only by its leverage on a photograph. With fixed cameras, the cofactors of the residuals of a point's rays are
I - B V^-1 B'. Residuals and cofactors after a rejection follow from those before, without an adjustment.

**M-estimators.** Huber's estimator bounds the influence of an image point. Tukey's biweight reduces it to
nothing: beyond TUKEY standard deviations an image point has weight 0. Tukey's starts from Huber's, because
its sum has many minima. Both take their scale from the median of the residuals.

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
from sfm.model.conventions import MAD_TO_SIGMA, BoolArray, FloatArray

MIN_RAYS = 3  # fewest rays of a point whose residuals can show the wrong ray
# Divided by the number of image points of a photograph: the share by which the photograph may change a
# standardised residual, about three times its six unknowns over two coordinates per image point
INFLUENCE = 8.0
MIN_REDUNDANCY = 1e-6  # smallest redundancy of a ray in its less checked direction, relative to the other

# In sigmas of a coordinate, for the length of a residual vector. Both are 95 % efficient with normal errors
# in the plane; for a single coordinate they would be 1.345 and 4.685.
HUBER = 1.501
TUKEY = 5.123
# In a photograph with n image points an error changes the residual of another image point by about 6 / (2 n)
# of itself, or at most a few times that. So from MIN_CROWDED_POINTS image points on, one with BESIDE_FRACTION
# of the largest tau is a separate error.
MIN_CROWDED_POINTS = 60
BESIDE_FRACTION = 0.4
# Share of the critical value below which an image point is reinstated; with 1 the rounds would never end.
RETURN_FRACTION = 0.99
MIN_FREEDOM = 0.05  # redundancy over observations, at least, so that there is a scale without redundancy


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
    """Return which image points to reject in one round, (k,).

    Args:
        observations: image points.
        state: values of all unknowns.
        residuals: v of all image points, predicted for rejected ones, px, shape (k, 2).
        complement: whitened cofactors of the residuals, shape (k, 2, 2).
        limiting: cofactors of each object point with fixed cameras, shape (n, 3, 3).
        used: image points in the adjustment, shape (k,).
        sigma0: sigma0 of the adjustment, at least the rounding of image points.
        critical: critical value of tau in the test of one image coordinate.
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
    """Return v'Pv and redundancy of the image points alone in an adjustment.

    Other observations have standard deviations stated by the user, which say nothing about the noise of image
    points.

    Args:
        observations: image points.
        residuals: v, px, (k, 2).
        complement: whitened cofactors of the residuals, (k, 2, 2).
        used: image points in the adjustment, (k,).
    """
    v = np.einsum("kab,kb->ka", whitening_matrix(observations.whitening[used]), residuals[used])
    of_each = np.einsum("kaa->k", complement[used])  # between 0 and 2 except for rounding
    share = observations.share[used]
    return float(share @ (v**2).sum(axis=1)), float(share @ np.clip(of_each, 0.0, 2.0))


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

    In whitened form, H = A Q A' without the image point, and l is its predicted residual. In the adjustment
    its residual would be (I + H)^-1 l with the cofactor (I + H)^-1. The sum of squares would grow by
    l' (I + H)^-1 l.

    Args:
        observations: image points.
        residuals: v of all image points, predicted for rejected ones, px, shape (k, 2).
        complement: whitened cofactors of the residuals, I + H for rejected ones, shape (k, 2, 2).
        used: image points in the adjustment, shape (k,).
        vPv: weighted sum of squares of the image points in the adjustment, see `sum_of_squares`.
        redundancy: redundancy of these image points.
        alpha: probability that the test of one image coordinate rejects a good one.

    Source: Cook and Weisberg (1982), Residuals and Influence in Regression, sec. 2.2.3.
    """
    rows = np.flatnonzero(
        ~used & np.isfinite(residuals).all(axis=1) & np.isfinite(complement).all(axis=(1, 2))
    )
    F = whitening_matrix(observations.whitening[rows])
    # No eigenvalue of I + H is below 1. But next to the huge eigenvalue of a ray that its point needs,
    # rounding destroys the other one.
    values, vectors = np.linalg.eigh(complement[rows])
    cofactor = np.asarray(vectors / np.maximum(values, 1.0)[:, None] @ vectors.transpose(0, 2, 1))
    predicted = np.einsum("kab,kb->ka", F, residuals[rows])
    inside = np.einsum("kab,kb->ka", cofactor, predicted)
    v = np.linalg.solve(F, inside[:, :, None])[:, :, 0]
    w = np.abs(standardised_residuals(v, cofactor, observations.whitening[rows])).max(axis=1)
    share = observations.share[rows]
    sigma0 = np.sqrt((vPv + share * np.sum(predicted * inside, axis=1)) / (redundancy + 2 * share))
    sigma0 = np.maximum(sigma0, rounding_of(observations))
    passes = np.zeros(len(used), dtype=bool)
    passes[rows] = w <= RETURN_FRACTION * tau_critical(alpha, redundancy + 2) * sigma0
    return passes


def rounding_of(observations: Observations) -> float:
    """Return the effect of rounding on a residual, in standard deviations; below it nothing can be tested."""
    size = float(np.abs(observations.xy).max(initial=0.0))
    return max(ROUNDING * size * float(observations.whitening[:, 0].max(initial=0.0)), np.finfo(float).tiny)


def least_sigma(observations: Observations) -> float:
    """Return MIN_SIGMA_PX in stated standard deviations; residuals below it do not reveal gross errors."""
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
    """Return the derivatives of psi(v) = w(|v|) v along and across v, from Huber's weights, (k, 2)."""
    return np.stack([np.where(weight < 1.0, 0.0, 1.0), weight], axis=1)


def tukey_slopes(weight: FloatArray) -> FloatArray:
    """Return the derivatives of psi(v) = w(|v|) v along and across v, from Tukey's weights, (k, 2)."""
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
    """Return the factor on sqrt(v'Pv / r) that gives the standard deviations of an M-estimator.

    Its covariance is K^2 [sum psi^2 / r] / [mean psi']^2 (X'X)^-1, K = 1 + (u / n) var psi' / [mean psi']^2.
    In contrast, v'Pv / r belongs to the cofactors (X'WX)^-1, which are (X'X)^-1 over the mean weight. The
    formula is asymptotic. Standard deviations are about 2 % too small if the redundancy is 3/4 of the
    observations, and 3 % (Huber) to 8 % (Tukey) if it is 0.4 to 0.6 of them.

    Args:
        observations: image points.
        residuals: v, px, shape (k, 2).
        weight: final weights of the estimator, shape (k,).
        slopes: psi' along and across the residual, shape (k, 2).
        vPv: sum of squares of all observations with these weights; other observations have weight 1.
        count: n, number of scalar observations with a weight above 0.
        redundancy: r = n - u.

    Source: Huber and Ronchetti (2009), Robust Statistics, sec. 7.6, here for vectors in the plane.
    """
    used = weight > 0
    w, share = weight[used], observations.share[used]
    others = count - 2 * len(w)
    counted = 2 * float(share.sum()) + others
    squares = share * residual_lengths(observations, residuals)[used] ** 2
    # the other observations count with what v'Pv exceeds by, which is rounding where there are none
    psi2 = float(w**2 @ squares) + max(vPv - float(w @ squares), 0.0)
    mean = (float(share @ slopes[used].sum(axis=1)) + others) / counted
    spread = (float(share @ ((slopes[used] - mean) ** 2).sum(axis=1)) + others * (1 - mean) ** 2) / counted
    K = 1 + (counted - redundancy) / counted * spread / mean**2
    mean_weight = (2 * float(share @ w) + others) / counted
    return float(np.sqrt(psi2 / vPv * mean_weight) * K / mean)


def robust_scale(
    observations: Observations, residuals: FloatArray, used: BoolArray, *, freedom: float
) -> float:
    """Return the standard deviation of unit weight from the median of the residuals.

    It tolerates gross errors in up to half of the image points.

    Args:
        observations: image points.
        residuals: v, px, shape (k, 2).
        used: image points that can take part, shape (k,).
        freedom: redundancy over observations; residuals are smaller than errors by its square root.

    Source: Hampel (1974), J. Am. Stat. Assoc. 69, for the median absolute deviation.
    """
    a, b, c = observations.whitening[used].T
    v = residuals[used]
    whitened = np.abs(np.concatenate([a * v[:, 0], b * v[:, 0] + c * v[:, 1]]))
    scale = MAD_TO_SIGMA * float(np.median(whitened)) / np.sqrt(max(freedom, MIN_FREEDOM))
    return float(max(scale, np.finfo(float).tiny))


def residual_lengths(observations: Observations, residuals: FloatArray) -> FloatArray:
    """Return the lengths of the residuals in standard deviations, infinite behind the camera, (k,).

    Args:
        observations: image points.
        residuals: v, px, shape (k, 2).
    """
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
    """Return further rays to reject from object points that lose a ray, one after another, (k,).

    For a point this ends when its worst ray may not be rejected, or is not clearly the worst.

    Args:
        observations: image points, ordered by object point.
        state: values of all unknowns.
        v: residuals of all image points, px, shape (k, 2).
        complement: whitened cofactors of the residuals, shape (k, 2, 2).
        limiting: cofactors of each object point with fixed cameras, shape (n, 3, 3).
        used: image points in the adjustment, shape (k,).
        out: image points that are rejected first, shape (k,).
        least: standardised residual above which image points of each photograph may be rejected, shape (m,).
    """
    further = np.zeros(len(used), dtype=bool)
    if not out.any():
        return further
    count = np.bincount(observations.image[used], minlength=len(least))
    F, B = whitening_matrix(observations.whitening), _by_points(observations, state, v, limiting)
    B *= np.sqrt(observations.share)[:, None, None]
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
    """Whitened rays of one point."""

    e: FloatArray  # residuals, (r, 2)
    Q: FloatArray  # cofactors of the residuals, (r, 2, 2)
    B: FloatArray  # derivatives by the point, (r, 2, 3)
    C: FloatArray  # cofactors of the point, (3, 3); -B C B' are the cofactors between residuals

    def without(self, a: int) -> _Rays:
        """Return the rays after rejecting one; the old values are meaningless afterwards."""
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
    """Return the derivatives of image points by their object point, px per object unit, (k, 2, 3).

    They are differences over the standard deviation of the point, a range in which the projection is linear.
    """
    h = np.sqrt(np.maximum(np.trace(limiting, axis1=1, axis2=2), 0.0))
    B = np.zeros((len(v), 2, 3))
    for p in range(3):
        moved = state.points.copy()
        moved[:, p] += h
        step = moved[:, p] - state.points[:, p]
        free = (step != 0)[observations.point]  # a held point has no cofactors
        difference = residuals(observations, state._replace(points=moved)) - v
        B[free, :, p] = difference[free] / step[observations.point[free], None]
    return B
