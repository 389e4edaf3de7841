"""Cameras that were moved on their rig, or photographed at another moment than the rig.

`find_bumps` tests whether the cameras of a rig kept their mounts, by a separate pose of each photograph. E
are the derivatives of its image points by a separate pose, v the whitened residuals, and R = I - A Q A'. The
shift is estimated as (E'R E)^-1 E'v, and v'E (E'R E)^-1 E'v / sigma0^2 is chi-square with six degrees of
freedom. The photographs of all rigs are tested together. The largest shift comes first, and each further one
is tested jointly with those found before.

A large shift costs a photograph its image points, which then take no part in that test. Such a photograph is
adjusted free of its rig. Its pose relative to another camera of the rig is then compared with that of a
moment at which both cameras kept their mounts. The difference d, three coordinates and three rotations, has
the covariance Qdd of the four photographs, and d'Qdd^-1 d is chi-square with six degrees of freedom.

Source: Baarda (1968), A testing procedure for use in geodetic networks; Foerstner and Wrobel (2016), sec.
4.6.4 (groups of parameters) and 2.10 (tests of differences).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sfm.adjustment.covariance import JointOnDemand, marginal_of
from sfm.adjustment.engine.collinearity import residuals
from sfm.adjustment.engine.correlated import linearise
from sfm.adjustment.result import Adjustment
from sfm.judgement.hypotheses.score import gain_of
from sfm.model.conventions import FloatArray, IntArray, angles_from_rotation, rotation_from_angles
from sfm.model.distributions import chi2_sf, level_of_single
from sfm.model.remarks.remark import Remark, remark
from sfm.runtime.threads import own_threads

MIN_REDUNDANCY = 1e-9  # redundancy of a separate pose below which nothing checks it
STEP = 1e-6  # of a numerical derivative, as a share of the distance of two photographs, and in rad


@dataclass(frozen=True)
class Bump:
    """A photograph whose camera was displaced on the rig."""

    photograph: str
    camera: str
    shift: float  # shift of the projection centre, object unit
    turn: float  # rotation, rad
    sigmas: float  # square root of chi-square
    probability: float  # probability of such a shift by chance, in one test
    free: bool  # whether it was adjusted free of the rig


def find_bumps(a: Adjustment, stated: IntArray | None = None) -> tuple[Bump, ...]:
    """Return the photographs whose cameras were displaced on a rig, largest shift first.

    With two photographs at a moment, nothing shows which camera was displaced; the one that is not the
    reference camera is named.

    Args:
        a: adjustment with rigs. With correlated errors only photographs free of their rig are tested.
        stated: moment of each photograph as the survey states it, (m,); a photograph with another moment in
            the network was adjusted free of its rig. The moments of the network if not given.
    """
    moment = a.network.moment
    if moment is None or a.estimate.mounts is None:
        return ()
    tested = _testable(a) if a.error_correlation is None else np.zeros(0, dtype=np.int64)
    stated = moment if stated is None else stated
    freed = np.flatnonzero(moment != stated)
    critical = level_of_single(a.levels.question, max(len(tested) + len(freed), 1))
    with own_threads():
        every = [*_of_freed(a, freed, stated), *_of_mounted(a, tested, critical)]
    significant = [bump for bump in every if bump.probability < critical]
    return tuple(sorted(significant, key=lambda bump: -bump.sigmas))


def bump_remarks(a: Adjustment, unit: str, stated: IntArray | None = None) -> tuple[Remark, ...]:
    """Return the remark on cameras that were displaced on a rig, see `find_bumps`; empty if none were."""
    bumps = find_bumps(a, stated)
    if not bumps:
        return ()
    cameras = {bump.camera for bump in bumps}
    theirs = [k for k, camera in enumerate(a.estimate.cameras) if camera.name in cameras]
    return (
        remark(
            "rig_contradicted",
            share=len(bumps) / int(np.isin(a.network.camera, theirs).sum()),
            photographs=[bump.photograph for bump in bumps],
            cameras=list(dict.fromkeys(bump.camera for bump in bumps)),
            distance=(max(bump.shift for bump in bumps), unit),
            angle=(float(np.degrees(max(bump.turn for bump in bumps))), "deg"),
            shift=max(bump.sigmas for bump in bumps),
            bound=float(np.mean([not bump.free for bump in bumps])),
        ),
    )


def _bump(a: Adjustment, i: int, step: FloatArray, chi2: float, *, free: bool) -> Bump:
    """Return the bump of a photograph by a shift and a rotation, (6,), with its chi-square."""
    return Bump(
        a.network.images[i],
        a.estimate.cameras[a.network.camera[i]].name,
        float(np.linalg.norm(step[:3])),
        float(np.linalg.norm(step[3:])),
        float(np.sqrt(chi2)),
        float(chi2_sf(chi2, 6)),
        free,
    )


def _testable(a: Adjustment) -> IntArray:
    """Return the photographs that others of their moment can contradict."""
    moment, mounts = a.network.moment, a.estimate.mounts
    assert moment is not None and mounts is not None
    together = np.bincount(moment)[moment]
    mounted = np.isin(np.arange(len(mounts.rig)), np.flatnonzero(mounts.position.any(axis=1)))
    return np.flatnonzero((together > 1) & (mounted[a.network.camera] | (together > 2)))


def _of_mounted(a: Adjustment, tested: IntArray, critical: float) -> Iterator[Bump]:
    """Yield the bumps of photographs that share the pose of their rig, until the largest is chance."""
    if not len(tested):
        return
    s, G = _scores(a, tested)
    taken: list[int] = []
    while len(taken) < len(tested):
        best, chi2, step = -1, 0.0, np.zeros(6)
        for k in range(len(tested)):
            if k in taken:
                continue
            value, d = _gain(s, G, k, taken)
            if value > chi2:
                best, chi2, step = k, value, d
        bump = _bump(a, int(tested[best]), step, chi2 / a.sigma0**2, free=False)
        if best < 0 or bump.probability >= critical:
            break
        yield bump
        taken.append(best)


def _of_freed(a: Adjustment, freed: IntArray, stated: IntArray) -> Iterator[Bump]:
    """Yield the bumps of photographs that were adjusted free of their rig, compared with another moment."""
    camera, moment = a.network.camera, a.network.moment
    joint = JointOnDemand(a)
    pairs = [  # of photographs of one stated moment; first those that share a pose
        (i, j)
        for i in range(len(stated))
        for j in np.flatnonzero(stated == stated[i]).tolist()
        if i != j and j not in freed
    ]
    pairs.sort(key=lambda pair: moment is None or moment[pair[0]] != moment[pair[1]])
    for i in freed.tolist():
        mate = next((j for first, j in pairs if first == i), None)
        if mate is None:
            continue
        kinds = (camera[i], camera[mate])
        other = next((p for p in pairs if p[0] != i and (camera[p[0]], camera[p[1]]) == kinds), None)
        if other is None:
            continue
        images = np.array([i, mate, *other])
        d, J = _difference(a, images)
        Q = J @ joint(np.zeros(0, dtype=np.int64), images) @ J.T
        yield _bump(a, i, d, float(d @ np.linalg.lstsq(Q, d, rcond=None)[0]), free=True)


def _difference(a: Adjustment, images: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the difference of the relative poses of two pairs of photographs, and its derivatives.

    Returns:
        Shift and rotation in the axes of the second camera, object unit and rad, (6,). Derivatives by X0,
        omega, phi and kappa of the four photographs, (6, 24).
    """
    estimate = a.estimate
    angles = np.array([angles_from_rotation(estimate.rotation[i]) for i in images])
    start = np.hstack([estimate.position[images], angles]).ravel()

    def relative(x: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
        of_rig, other = (rotation_from_angles(*x[6 * k + 6 * n + 3 : 6 * k + 6 * n + 6]) for n in (0, 1))
        base = x[6 * k : 6 * k + 3] - x[6 * k + 6 : 6 * k + 9]
        return other.T @ base, other.T @ of_rig

    def difference(x: FloatArray) -> FloatArray:
        (t, R), (t_usual, R_usual) = relative(x, 0), relative(x, 2)
        return np.concatenate([t - t_usual, Rotation.from_matrix(R @ R_usual.T).as_rotvec()])

    steps = np.tile(np.r_[np.ones(3), np.full(3, STEP)], 4)  # it is linear in the positions
    rows = [
        (difference(start + step) - difference(start - step)) / (2 * step.sum()) for step in np.diag(steps)
    ]
    return difference(start), np.array(rows).T


def _scores(a: Adjustment, tested: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return E'v (t, 6) and E'R E (t, 6, t, 6) of the tested photographs."""
    m = marginal_of(a, cross=False)
    o, weight = m.layout.observations, np.ascontiguousarray(a.weights[m.layout.order])
    linear = linearise(m.optimum, m.layout, weight)
    v = np.einsum("kab,kb->ka", linear.whitening, residuals(o, m.optimum.state)).ravel()
    v = np.where(np.repeat(weight > 0, 2), np.nan_to_num(v), 0.0)
    E = np.zeros((len(v), len(tested), 6))
    for t, i in enumerate(tested):
        rows = (2 * np.flatnonzero(o.image == i)[:, None] + np.arange(2)).ravel()
        columns = 6 * o.pose_of[i] + np.arange(6)
        E[rows, t] = linear.A[rows][:, columns].toarray()
    flat = E.reshape(len(v), -1)
    G = flat.T @ linear.residuals(flat)
    return (flat.T @ v).reshape(-1, 6), G.reshape(len(tested), 6, len(tested), 6)


def _gain(s: FloatArray, G: FloatArray, k: int, taken: list[int]) -> tuple[float, FloatArray]:
    """Return chi-square and shift (6,) of a separate pose of a photograph, jointly with those taken."""
    t, M = s[k], G[k][:, k]
    if taken:
        across = G[k][:, taken].reshape(6, -1)
        others = G[taken][:, :, taken].reshape(6 * len(taken), -1)
        solved = np.linalg.lstsq(others, np.column_stack([across.T, s[taken].ravel()]), rcond=None)[0]
        M, t = M - across @ solved[:, :6], t - across @ solved[:, 6]
    gain = gain_of(M, t, np.diagonal(G[k][:, k]), MIN_REDUNDANCY)
    return gain.value, gain.beta
