"""Whether the photographs of one camera are those of two: another body, zoom or focus under the same name.

Each photograph votes by its residuals: the normal equations of c, x0, y0 and K1 of its own, its exterior
orientation eliminated and the points held as adjusted. Two clusters in that metric (k-means with the normal
equations as weights) are two cameras, if they explain more than chance does.

Source: Koch (1999), Parameter Estimation and Hypothesis Testing in Linear Models, sec. 4.2 (tests of
additional parameters); Lloyd (1982), IEEE Trans. Inf. Theory 28(2), for the clusters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.camera import Camera, project
from sfm.conventions import BoolArray, FloatArray, rotation_from_vector
from sfm.distortion.models import Role
from sfm.distributions import chi2_sf
from sfm.network import Estimate, Network, rows_of

OWN = (Role.FOCAL, Role.X0, Role.Y0, Role.RADIAL)
LEAST_IN_GROUP = 2  # photographs: a single one is tried with a camera of its own before
LEAST_POINTS = 8  # of a photograph that has a vote
SIGNIFICANT = 1e-6  # chance with which clusters of equal photographs are so far apart, before it is tried
ROUNDS, MOST_STARTS = 20, 50  # of k-means
MOST_DOUBLINGS = 1000  # what a float holds
SMALL_STEP = 1e-6  # of differences, in parts of the size of what is varied


@dataclass(frozen=True)
class TwoGroups:
    """Photographs of one camera that seem to have been taken with two."""

    second: BoolArray  # photographs of the smaller group, (m,)
    probability: float  # of so different groups by chance


@dataclass(frozen=True)
class _Votes:
    """Normal equations of the photographs of one camera, whitened by sigma0."""

    images: list[int]
    N: FloatArray  # (k, p, p)
    g: FloatArray  # (k, p)


def two_groups(network: Network, estimate: Estimate) -> TwoGroups | None:
    """Return the clearest two groups among the photographs of one camera; None where they are all alike.

    Args:
        network: what was adjusted.
        estimate: the adjusted values; residuals may be as large as two cameras make them.
    """
    votes = [
        _votes(network, estimate, np.flatnonzero(network.camera == index).tolist())
        for index in range(len(estimate.cameras))
    ]
    found = [one for vote in votes if vote and (one := _clusters(vote, len(network.images))) is not None]
    return min(found, key=lambda one: one.probability, default=None)


def _votes(network: Network, estimate: Estimate, images: list[int]) -> _Votes | None:
    """Return what each photograph says of an interior orientation of its own; None if none has the points."""
    seen = network.image_points
    rows_by_image = rows_of(seen.image, len(network.images))
    used, N, g, squares = [], [], [], []
    for i in images:
        rows = rows_by_image[i]
        camera = estimate.cameras[network.camera[i]]
        A, v = _equations(camera, estimate, i, seen.xy[rows], estimate.points[seen.point[rows]])
        good = np.isfinite(v) & np.isfinite(A).all(axis=1)
        if good.sum() < 2 * LEAST_POINTS:
            continue
        A, v = A[good], v[good]
        own = A[:, 6:]
        Q, _ = np.linalg.qr(A[:, :6])  # exterior orientation, eliminated
        own, v = own - Q @ (Q.T @ own), v - Q @ (Q.T @ v)
        used.append(i)
        N.append(own.T @ own)
        g.append(own.T @ v)
        squares.append(float(np.median(np.abs(v))))
    if not used:
        return None
    sigma = max(float(np.median(squares)) / 0.6745, np.finfo(float).tiny)
    return _Votes(used, np.array(N) / sigma**2, np.array(g) / sigma**2)


def _equations(
    camera: Camera, estimate: Estimate, image: int, xy: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of pixel coordinates by exterior and own interior orientation, and residuals."""
    X0, R = estimate.position[image], estimate.rotation[image]
    at = project(camera, X0, R, points)
    distance = float(np.nanmedian(np.linalg.norm(points - X0, axis=1)))
    columns = []
    for k in range(3):
        step = np.zeros(3)
        step[k] = SMALL_STEP * distance
        columns.append((project(camera, X0 + step, R, points) - at) / step[k])
    for k in range(3):
        turn = np.zeros(3)
        turn[k] = SMALL_STEP
        columns.append((project(camera, X0, R @ rotation_from_vector(turn), points) - at) / turn[k])
    for s in _own(camera):
        p = camera.parameters.copy()
        step_s = SMALL_STEP * max(abs(p[s]), _unit(camera, s))
        p[s] += step_s
        columns.append((project(camera.with_parameters(p), X0, R, points) - at) / step_s)
    A = np.stack([column.ravel() for column in columns], axis=1)
    return A, (xy - at).ravel()


def _own(camera: Camera) -> list[int]:
    """Return the parameters that tell two cameras apart: of the radial ones the first."""
    radial = np.flatnonzero(camera.plays(Role.RADIAL))[1:]
    return [int(s) for s in np.flatnonzero(camera.plays(*OWN)) if s not in radial]


def _unit(camera: Camera, s: int) -> float:
    """Return the order of magnitude of a parameter: principal points like c, K1 that of one half of 1/c^2."""
    c = float(camera.parameters[0])
    return (
        1 / (2 * c**2)
        if camera.plays(Role.RADIAL)[s] and camera.in_mm
        else (1.0 if camera.parts[2][s] else c)
    )


def _clusters(votes: _Votes, m: int) -> TwoGroups | None:
    """Return the two clusters of the photographs of one camera, and how likely they are by chance."""
    k, p = votes.g.shape
    if k < 2 * LEAST_IN_GROUP:
        return None
    best: tuple[float, BoolArray] | None = None
    together = _gain(votes, np.ones(k, dtype=bool))
    for first in range(0, k, max(1, k // MOST_STARTS)):  # from one photograph against all others
        group = np.arange(k) == first
        for _ in range(ROUNDS):
            means = [_mean(votes, mask) for mask in (group, ~group)]
            cost = np.stack(
                [np.einsum("kab,a,b->k", votes.N, mu, mu) - 2 * votes.g @ mu for mu in means], axis=1
            )
            again = cost[:, 0] < cost[:, 1]
            if again.all() or not again.any() or (again == group).all():
                break
            group = again
        if min(group.sum(), k - group.sum()) < LEAST_IN_GROUP:
            continue
        gain = _gain(votes, group) + _gain(votes, ~group) - together
        if best is None or gain > best[0]:
            best = gain, group
    if best is None:
        return None
    # that many divisions were possible
    probability = float(chi2_sf(best[0], p)) * 2.0 ** min(k - 1, MOST_DOUBLINGS)
    if not probability < SIGNIFICANT:
        return None
    group = best[1] if best[1].sum() <= k / 2 else ~best[1]
    second = np.zeros(m, dtype=bool)
    second[np.array(votes.images)[group]] = True
    return TwoGroups(second, probability)


def _mean(votes: _Votes, group: BoolArray) -> FloatArray:
    """Return the interior orientation on which the photographs of a group agree, as a correction."""
    N, g = votes.N[group].sum(axis=0), votes.g[group].sum(axis=0)
    return np.asarray(np.linalg.lstsq(N, g, rcond=1e-12)[0])


def _gain(votes: _Votes, group: BoolArray) -> float:
    """Return by how much v'Pv falls with a correction for all photographs of a group."""
    return float(votes.g[group].sum(axis=0) @ _mean(votes, group))
