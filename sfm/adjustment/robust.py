"""Gross errors: iterative data snooping by Pope's tau with reinstatement, and Huber's M-estimator.

Data snooping takes out, round by round, the image points of the largest tau above the critical value:
the largest of all, and with it others whose photograph and object point hold no larger one, so that
none is judged beside a larger error. A rejected point is taken back when its predicted residual
passes the test again.

Source: Pope (1976), NOAA TR NOS 65 NGS 1; Kok (1984), On data snooping and multiple outlier testing;
Huber (1981), Robust Statistics, ch. 7.
"""

from __future__ import annotations

import numpy as np

from sfm.adjustment.collinearity import Observations
from sfm.adjustment.reliability import standardised_residuals, tau_critical
from sfm.conventions import BoolArray, FloatArray

HUBER = 1.345  # in sigmas; 95 % efficient with normal errors (Huber 1981)


def snoop(
    obs: Observations,
    residuals: FloatArray,
    complement: FloatArray,
    used: BoolArray,
    *,
    vPv: float,
    redundancy: int,
    alpha: float,
) -> tuple[BoolArray, BoolArray]:
    """Return which image points to take out and which to take back in one round.

    Args:
        obs: image points.
        residuals: v of all image points, rejected ones predicted, px, shape (k, 2).
        complement: whitened cofactors of the residuals, shape (k, 2, 2).
        used: image points in the adjustment, shape (k,).
        vPv: weighted sum of squares of the adjustment.
        redundancy: of the adjustment.
        alpha: probability with which the test of one image coordinate rejects a good one.
    """
    w = np.abs(standardised_residuals(residuals, complement, obs.whitening)).max(axis=1)
    w = np.where(np.isfinite(w), w, np.inf)
    sigma0 = np.sqrt(vPv / max(redundancy, 1))
    tau = w / max(sigma0, np.finfo(float).tiny)
    critical = tau_critical(alpha, redundancy)
    suspect = used & (tau > critical)
    worst_image = np.zeros(len(obs.camera))
    np.maximum.at(worst_image, obs.image[suspect], tau[suspect])
    worst_point = np.zeros(len(obs.start) - 1)
    np.maximum.at(worst_point, obs.point[suspect], tau[suspect])
    out = suspect & (tau >= worst_image[obs.image]) & (tau >= worst_point[obs.point])
    back = ~used & (tau <= critical)
    return out, back


def huber_weights(obs: Observations, residuals: FloatArray, *, sigma0: float) -> FloatArray:
    """Return the factor min(1, HUBER / |v|) on the weight of each image point, (k,).

    Args:
        obs: image points.
        residuals: v, px, shape (k, 2).
        sigma0: standard deviation of unit weight.
    """
    a, b, c = obs.whitening.T
    size = np.hypot(a * residuals[:, 0], b * residuals[:, 0] + c * residuals[:, 1]) / sigma0
    return np.where(size > HUBER, HUBER / np.maximum(size, HUBER), 1.0)
