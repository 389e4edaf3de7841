"""Redundancy numbers, standardised residuals and the tests of Baarda and Pope.

    R = Q_vv P (redundancy numbers on its diagonal; their sum is the redundancy),
    w = (P v)_i / sqrt(sigma0'^2 (P Q_vv P)_ii)     with sigma0' a priori: Baarda's w ~ N(0, 1),
    tau = the same with sigma0 a posteriori:         Pope's tau ~ tau(r).

Source: Baarda (1968), A testing procedure for use in geodetic networks; Pope (1976), NOAA TR NOS 65
NGS 1; Foerstner and Wrobel (2016), sec. 4.6.
"""

from __future__ import annotations

import numpy as np

from sfm.adjustment.engine.cofactors import Cofactors
from sfm.adjustment.engine.iterate import Optimum
from sfm.adjustment.engine.observed import ObservedKind, Reduced, reduced_rows
from sfm.adjustment.engine.unknowns import Unknowns
from sfm.adjustment.result import ObservedResiduals
from sfm.conventions import FloatArray
from sfm.distributions import t_ppf


def redundancy_numbers(complement: FloatArray, whitening: FloatArray) -> FloatArray:
    """Return the diagonal of Q_vv P of each image point, (k, 2).

    Args:
        complement: I - A Q A' in whitened coordinates, shape (k, 2, 2).
        whitening: a, b, c of F = (a 0; b c) with F'F = P, shape (k, 3).
    """
    F = whitening_matrix(whitening)
    R = np.linalg.inv(F) @ complement @ F
    return np.ascontiguousarray(np.diagonal(R, axis1=1, axis2=2))


def standardised_residuals(
    residuals: FloatArray, complement: FloatArray, whitening: FloatArray
) -> FloatArray:
    """Return Baarda's w of each image coordinate for sigma0 = 1, (k, 2); 0 where it is not controlled.

    Args:
        residuals: v, px, shape (k, 2).
        complement: I - A Q A' in whitened coordinates, shape (k, 2, 2).
        whitening: a, b, c of F = (a 0; b c) with F'F = P, shape (k, 3).
    """
    F = whitening_matrix(whitening)
    Ft = np.swapaxes(F, 1, 2)
    Pv = np.einsum("kab,kb->ka", Ft @ F, residuals)
    PQP = residual_weights(complement, whitening)
    P = np.diagonal(Ft @ F, axis1=1, axis2=2)
    controlled = PQP > MIN_CHECKED_REDUNDANCY * P
    return np.where(controlled, Pv / np.sqrt(np.where(controlled, PQP, 1.0)), 0.0)


def residual_weights(complement: FloatArray, whitening: FloatArray) -> FloatArray:
    """Return the diagonal of P Qvv P of each image point, px^-2, (k, 2).

    Args:
        complement: I - A Q A' in whitened coordinates, shape (k, 2, 2).
        whitening: a, b, c of F = (a 0; b c) with F'F = P, shape (k, 3).
    """
    F = whitening_matrix(whitening)
    with np.errstate(invalid="ignore"):  # the cofactors of a ray that nothing determines are infinite
        return np.diagonal(np.swapaxes(F, 1, 2) @ complement @ F, axis1=1, axis2=2).copy()


MIN_CHECKED_REDUNDANCY = 1e-6  # redundancy number below which an observation has no check


def standardised_of_given(
    difference: FloatArray, weight: FloatArray, cofactor: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return Baarda's w for sigma0 = 1, and the redundancy number, of unknowns that were observed, (n, d).

    w is NaN where the observation has no check, both are where a component was not observed.

    Args:
        difference: v, adjusted minus given, shape (n, d).
        weight: P, inverse covariance of what was given, 0 where it was not, shape (n, d, d).
        cofactor: Q of the adjusted unknowns, shape (n, d, d).
    """
    PQP = np.diagonal(weight - weight @ cofactor @ weight, axis1=1, axis2=2)
    P = np.diagonal(weight, axis1=1, axis2=2)
    r = np.where(P > 0, 1 - np.diagonal(cofactor @ weight, axis1=1, axis2=2), np.nan)
    Pv = np.einsum("nab,nb->na", weight, difference)
    checked = PQP > MIN_CHECKED_REDUNDANCY * P
    return np.where(checked, Pv / np.sqrt(np.where(checked, PQP, 1.0)), np.nan), np.clip(r, 0.0, 1.0)


def residuals_of_observed(
    one: ObservedKind, layout: Unknowns, optimum: Optimum, cofactors: Cofactors | None
) -> ObservedResiduals:
    """Return the residuals of observations of a kind, with their redundancy numbers and tests.

    Args:
        one: observations of a kind.
        layout: order of the unknowns.
        optimum: undamped normal equations and their factor.
        cofactors: of the same; None where they are not wanted, and numbers are NaN.
    """
    linear = one.kind.linearise(optimum.state)
    shape = linear.difference.shape
    l = linear.difference.reshape(one.weight.shape[:2])
    vPv = float(np.einsum("na,nab,nb->", l, one.weight, l))
    r, w, redundancy = np.full(shape, np.nan), np.full(shape, np.nan), float("nan")
    if cofactors is not None:
        if one.point is not None:
            Q = linear.J[0] @ cofactors.points[one.point] @ np.swapaxes(linear.J[0], 1, 2)
        else:
            Q = _cofactors_of(reduced_rows(one, layout, optimum.state), optimum, cofactors)
        if linear.taken is not None:
            Q = Q + linear.taken
        w, r = (part.reshape(shape) for part in standardised_of_given(l, one.weight, Q))
        redundancy = float(one.components.sum() - np.einsum("nab,nba->", one.weight, Q))
    return ObservedResiduals(one.index, one.rows, linear.difference, r, w, one.count, vPv, redundancy)


def _cofactors_of(rows: Reduced, optimum: Optimum, cofactors: Cofactors) -> FloatArray:
    """Return J Q J' of observations by the reduced unknowns, (n, d, d); estimable, so in any datum."""
    (columns, J, _), poses = rows, len(cofactors.exterior)
    n, d, u = J.shape
    outer = columns < 6 * poses
    pose = np.where(outer, columns // 6, -1)
    lone = pose.max(axis=1, initial=-1)
    if (outer & (pose != lone[:, None])).any():  # several poses in one observation
        found = np.empty((n, d, d))
        for row in range(n):
            right = np.zeros((d, len(optimum.equations.parts.scale)))
            np.add.at(right, (np.arange(d)[:, None], columns[row]), J[row])
            found[row] = right @ optimum.factor.solve(right.T)
        return found
    Q = np.zeros((n, u, u))
    inner, part = np.where(outer, 0, columns - 6 * poses), np.where(outer, columns % 6, 0)
    r, c = outer[:, :, None], outer[:, None]
    if outer.any():
        at = np.maximum(lone, 0)[:, None, None]
        Q += np.where(r & c, cofactors.exterior[at, part[:, :, None], part[:, None]], 0.0)
    if not outer.all():
        Q += np.where(r | c, 0.0, cofactors.border[inner[:, :, None], inner[:, None]])
        if outer.any():
            mixed = cofactors.mixed.reshape(poses, 6, -1)[at, part[:, :, None], inner[:, None]]
            mixed = np.where(r & ~c, mixed, 0.0)
            Q += mixed + np.swapaxes(mixed, 1, 2)
    return np.asarray(J @ Q @ np.swapaxes(J, 1, 2))


FALSE_ALARM = 0.05  # chance that a survey without any outlier loses an image coordinate; Pope (1976)


def level_of_single(family: float, tests: int) -> float:
    """Return the level of each of some tests, so that any of them rejects what is good with a probability.

    Args:
        family: that probability, of all tests together.
        tests: how many there are.

    Source: Sidak (1967), J. Am. Stat. Assoc. 62.
    """
    return float(1 - (1 - family) ** (1 / max(tests, 1)))


def tau_critical(alpha: float, redundancy: float) -> float:
    """Return the critical value of Pope's tau for a two-sided test of one observation.

    Args:
        alpha: probability of rejecting a good observation.
        redundancy: r of the adjustment; infinite if not positive at least 2.

    Source: Pope (1976), eq. 21: tau = t sqrt(r) / sqrt(r - 1 + t^2), t of r - 1 degrees of freedom.
    """
    if redundancy < 2:
        return np.inf
    t = t_ppf(1 - alpha / 2, redundancy - 1)
    return float(t * np.sqrt(redundancy) / np.sqrt(redundancy - 1 + t**2))


def whitening_matrix(whitening: FloatArray) -> FloatArray:
    """Return F = (a 0; b c), (k, 2, 2)."""
    F = np.zeros((len(whitening), 2, 2))
    F[:, 0, 0], F[:, 1, 0], F[:, 1, 1] = whitening.T
    return F
