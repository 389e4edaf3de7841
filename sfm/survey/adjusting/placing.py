"""A network without control brought to what survey observations say of its scale and attitude.

Heights, coordinate differences, antenna positions and distances know a part of the seven of position,
attitude and scale, which image points leave open. They are found from the observations by least squares, from
attitudes all round, so that the adjustment starts near.

Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 2.2.3 (spatial similarity).
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from sfm.conventions import FloatArray, rotation_from_vector, skew
from sfm.network import Estimate, Network, values_of
from sfm.observations.kind import PHOTOGRAPH, POINT, Kind, inverse_of_observed
from sfm.similarity import Similarity
from sfm.survey.adjusting.datum_definition import has_held_mounts

ROUNDS = 20  # of Gauss-Newton from each attitude
LARGEST_STEP = 0.5  # turn of one step, rad, and change of the scale


def place_on_observations(network: Network, estimate: Estimate) -> Estimate:
    """Return the estimate in the scale and attitude that survey observations give; as it is without.

    Args:
        network: with observations of points and photographs.
        estimate: start values.
    """
    kinds = [one for one in (_usable(kind, estimate) for kind in network.observations) if len(one)]
    if not kinds:
        return estimate
    centre = np.nanmean(estimate.points, axis=0)
    start = Similarity(1.0, np.eye(3), -centre).apply_estimate(estimate)
    scaled = not has_held_mounts(estimate)
    turned = [Similarity(1.0, R, np.zeros(3)).apply_estimate(start) for R in _attitudes()]
    tried = [_fitted(kinds, one, scaled=scaled) for one in turned]
    return min(tried, key=lambda one: one[1])[0]


def scale_sigma(network: Network, estimate: Estimate) -> float:
    """Return the relative standard deviation of the scale that observations of points and photographs give.

    It is that of a network in which nothing else gives one; infinite where they do not either.
    """
    kinds = [one for one in (_usable(kind, estimate) for kind in network.observations) if len(one)]
    if not kinds:
        return float("inf")
    centre = np.nanmean(estimate.points, axis=0)
    rows, _ = _rows(kinds, Similarity(1.0, np.eye(3), -centre).apply_estimate(estimate))
    N, others = rows.T @ rows, rows[:, :6]
    left = N[6, 6] - N[6, :6] @ np.linalg.pinv(others.T @ others, hermitian=True) @ N[:6, 6]
    return float(1 / np.sqrt(left)) if left > 0 else float("inf")


def _usable(kind: Kind, estimate: Estimate) -> Kind:
    """Return the observations of a kind whose points and photographs have start values."""
    on = np.ones(len(kind), dtype=bool)
    for of, at in kind.blocks():
        if of not in (POINT, PHOTOGRAPH):
            on[:] = False  # of mounts and cameras, which motions leave alone
        else:
            on &= (estimate.determined if of == POINT else estimate.oriented)[at]
    return kind.select(on)


def _fitted(kinds: list[Kind], estimate: Estimate, *, scaled: bool) -> tuple[Estimate, float]:
    """Return the estimate moved, and scaled, to least v'Pv of observations, and it."""
    for _ in range(ROUNDS):
        rows, l = _rows(kinds, estimate)
        rows[:, 6] *= scaled
        step: FloatArray = np.asarray(-np.linalg.lstsq(rows, l, rcond=1e-9)[0], dtype=float)
        size = max(float(np.abs(step[3:]).max()), LARGEST_STEP) / LARGEST_STEP
        step /= size
        R = rotation_from_vector(step[3:6])
        estimate = Similarity(float(np.exp(step[6])), R, step[:3]).apply_estimate(estimate)
        if np.abs(step[3:]).max() < 1e-9:
            break
    return estimate, float((_rows(kinds, estimate)[1] ** 2).sum())


def _rows(kinds: list[Kind], estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return whitened derivatives by shift, turn and scale, (n, 7), and differences, (n,)."""
    values, rows, differences = values_of(estimate), [], []
    for kind in kinds:
        linear = kind.linearise(values)
        J = np.zeros((*linear.difference.shape, 7))
        for (of, at), by in zip(kind.blocks(), linear.J, strict=True):
            X = values.points[at] if of == POINT else values.position[at]
            motion = np.zeros((len(at), by.shape[2], 7))
            motion[:, :3, :3] = np.eye(3)
            motion[:, :3, 3:6] = -skew(X)
            motion[:, :3, 6] = X
            if of == PHOTOGRAPH:
                motion[:, 3:, 3:6] = values.M[at]
            J += by @ motion
        weight = inverse_of_observed(kind.covariances())
        F = np.swapaxes(np.linalg.cholesky(weight), 1, 2)
        rows.append((F @ J).reshape(-1, 7))
        differences.append(np.einsum("nab,nb->na", F, linear.difference).ravel())
    return np.concatenate(rows), np.concatenate(differences)


def _attitudes() -> list[FloatArray]:
    """Return the 24 rotations of a cube."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[np.arange(3), list(order)] = signs
            if np.linalg.det(R) > 0:
                found.append(R)
    return found
