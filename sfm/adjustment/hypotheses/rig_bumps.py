"""Whether the cameras of a rig kept their places: a test of each photograph for a separate pose.

With the derivatives E of the image points of one photograph by a separate pose, the whitened residuals v
and R = I - A Q A', its shift is estimated as (E'R E)^-1 E'v, and v'E (E'R E)^-1 E'v / sigma0^2 is chi-square
of six. The photographs of a rig are tested together, the largest shift first, each beside those found before.

Source: Baarda (1968), A testing procedure for use in geodetic networks; Foerstner and Wrobel (2016), sec.
4.6.4 (groups of parameters).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.engine.collinearity import residuals
from sfm.adjustment.engine.linearised import linearise
from sfm.adjustment.quality.reliability import level_of_single
from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, IntArray
from sfm.distributions import chi2_sf
from sfm.kernels.threads import own_threads
from sfm.remarks.remark import Remark, remark

FALSE_ALARM = 0.01  # probability that a rig without a bump is reported to have one
MIN_REDUNDANCY = 1e-9  # redundancy of a separate pose below which nothing checks it


@dataclass(frozen=True)
class Bump:
    """A photograph whose camera has left its place on the rig."""

    photograph: str
    camera: str
    shift: float  # of the projection centre, object unit
    turn: float  # rad
    sigmas: float  # root of chi-square
    probability: float  # of so large a shift by chance, in one test


def find_bumps(a: Adjustment) -> tuple[Bump, ...]:
    """Return the photographs whose cameras have left their places on a rig, the largest shift first.

    Of a moment with two photographs nothing shows which of them; the one that is not of the reference camera
    is named.

    Args:
        a: an adjustment with rigs, of independent errors.
    """
    moment, mounts = a.network.moment, a.estimate.mounts
    if moment is None or mounts is None or a.error_correlation is not None:
        return ()
    together = np.bincount(moment)[moment]
    mounted = np.isin(np.arange(len(mounts.rig)), np.flatnonzero(mounts.position.any(axis=1)))
    tested = np.flatnonzero((together > 1) & (mounted[a.network.camera] | (together > 2)))
    if not len(tested):
        return ()
    with own_threads():
        s, G = _scores(a, tested)
    critical = level_of_single(FALSE_ALARM, len(tested))
    found: list[Bump] = []
    taken: list[int] = []
    while len(taken) < len(tested):
        best, chi2, step = -1, 0.0, np.zeros(6)
        for k in range(len(tested)):
            if k in taken or _same_moment(moment, tested, k, taken):
                continue
            value, d = _gain(s, G, k, taken)
            if value > chi2:
                best, chi2, step = k, value, d
        probability = float(chi2_sf(chi2 / a.sigma0**2, 6))
        if best < 0 or probability >= critical:
            break
        i = int(tested[best])
        found.append(
            Bump(
                a.network.images[i],
                a.estimate.cameras[a.network.camera[i]].name,
                float(np.linalg.norm(step[:3])),
                float(np.linalg.norm(step[3:])),
                float(np.sqrt(chi2) / a.sigma0),
                probability,
            )
        )
        taken.append(best)
    return tuple(found)


def bump_remarks(a: Adjustment, unit: str) -> tuple[Remark, ...]:
    """Return the remark on cameras that have left their places on a rig; none without.

    Args:
        a: an adjustment.
        unit: of its coordinates.
    """
    found = find_bumps(a)
    if not found:
        return ()
    cameras = {one.camera for one in found}
    theirs = [k for k, camera in enumerate(a.estimate.cameras) if camera.name in cameras]
    most = 2 * len(found) >= int(np.isin(a.network.camera, theirs).sum())
    return (
        remark(
            "rig_contradicted" if most else "rig_bumped",
            photographs=[one.photograph for one in found],
            cameras=list(dict.fromkeys(one.camera for one in found)),
            distance=(max(one.shift for one in found), unit),
            angle=(float(np.degrees(max(one.turn for one in found))), "deg"),
            shift=max(one.sigmas for one in found),
        ),
    )


def _same_moment(moment: IntArray, tested: IntArray, k: int, taken: list[int]) -> bool:
    """Whether all but one photograph of the moment of a photograph have a separate pose already."""
    taken_with = sum(int(moment[tested[t]] == moment[tested[k]]) for t in taken)
    return taken_with + 2 > int((moment == moment[tested[k]]).sum())


def _scores(a: Adjustment, tested: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return E'v (t, 6) and E'R E (t, 6, t, 6) of the photographs that are tested."""
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
    """Return chi-square of a separate pose of a photograph beside those of others, and the shift, (6,)."""
    t, M = s[k], G[k][:, k]
    if taken:
        across = G[k][:, taken].reshape(6, -1)
        others = G[taken][:, :, taken].reshape(6 * len(taken), -1)
        solved = np.linalg.lstsq(others, np.column_stack([across.T, s[taken].ravel()]), rcond=None)[0]
        M, t = M - across @ solved[:, :6], t - across @ solved[:, 6]
    scale = np.sqrt(np.maximum(np.diagonal(G[k][:, k]), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(M / np.outer(scale, scale))
    on = values > MIN_REDUNDANCY
    part = vectors[:, on].T @ (t / scale)
    return float((part**2 / values[on]).sum()), -(vectors[:, on] @ (part / values[on])) / scale
