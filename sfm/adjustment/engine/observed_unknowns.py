"""Unknowns that are observed themselves: control points, exterior and interior orientation, scale bars.

Unified least squares: every unknown may be fixed, free or observed with a weight, so these
observations add to the normal equations beside the image points.

Source: Mikhail, Bethel and McGlone, Modern Photogrammetry (2001), sec. 4.4 and 5.6 (unified least
squares).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.engine.collinearity import State
from sfm.adjustment.engine.unknowns import Unknowns, exterior_jacobian
from sfm.conventions import BoolArray, FloatArray, IntArray, angles_from_rotation
from sfm.network import Network


@dataclass(frozen=True)
class Weighted:
    """Observed unknowns and distances with their weights (inverse covariance; 0 where not observed)."""

    point: IntArray  # observed object points, (p,)
    xyz: FloatArray  # their observed coordinates, (p, 3)
    point_weight: FloatArray  # (p, 3, 3)
    image: IntArray  # photographs with observed exterior orientation, (e,)
    position: FloatArray  # (e, 3)
    angles: FloatArray  # omega, phi, kappa, rad, (e, 3)
    exterior_weight: FloatArray  # (e, 6, 6)
    camera: IntArray  # camera of each observed interior parameter, (q,)
    parameter: IntArray  # index of the parameter in its camera, (q,)
    column: IntArray  # its column among the reduced unknowns, (q,)
    value: FloatArray  # (q,)
    interior_weight: FloatArray  # (q, q)
    start: IntArray  # first kept point of each scale bar, (b,)
    end: IntArray  # second kept point of each scale bar, (b,)
    length: FloatArray  # (b,)
    length_weight: FloatArray  # (b,)
    count: int  # scalar observations


@dataclass(frozen=True)
class WeightedTerms:
    """Contribution of the observed unknowns to the normal equations N dx = -g, and to v'Pv."""

    exterior: FloatArray  # N of X0, w of each observed photograph, (e, 6, 6)
    exterior_g: FloatArray  # (e, 6)
    interior_g: FloatArray  # (q,); N is Weighted.interior_weight
    kept: FloatArray  # N of the kept points from scale bars, (3 s, 3 s)
    kept_g: FloatArray  # (3 s,)
    vPv: float  # of all observed unknowns and distances


def weighted_of(network: Network, layout: Unknowns, *, use_control: bool) -> Weighted:
    """Return the observed unknowns of a network that take part in its adjustment."""
    control, exterior, interior, bars = (
        network.control,
        network.exterior,
        network.interior,
        network.scale_bars,
    )
    on = layout.point_free[control.point].any(axis=1) if use_control else np.zeros(len(control), dtype=bool)
    point_weight, point_count = inverse_of_observed(control.covariance[on])
    on_e = layout.exterior_free[exterior.image].any(axis=1)
    on_e &= observed(np.einsum("eii->ei", exterior.covariance)).any(axis=1)  # not only fixed or unknown
    exterior_weight, exterior_count = inverse_of_observed(exterior.covariance[on_e])
    columns, used = [], []
    for q in range(len(interior)):
        a, s = interior.camera[q], interior.parameter[q]
        where = np.flatnonzero(layout.interior_free[a] == s)
        if len(where) and 0 < interior.sigma[q] < np.inf:
            used.append(q)
            columns.append(layout.interior_column[a][where[0]])
    slot = np.full(len(network.points), -1)
    slot[layout.kept] = np.arange(len(layout.kept))
    b = layout.bars
    return Weighted(
        point=control.point[on],
        xyz=control.xyz[on],
        point_weight=point_weight,
        image=exterior.image[on_e],
        position=exterior.position[on_e],
        angles=exterior.angles[on_e],
        exterior_weight=exterior_weight,
        camera=interior.camera[used],
        parameter=interior.parameter[used],
        column=np.array(columns, dtype=np.int64),
        value=interior.value[used],
        interior_weight=interior.weight_of(np.array(used, dtype=np.int64)),
        start=slot[bars.start[b]],
        end=slot[bars.end[b]],
        length=bars.length[b],
        length_weight=1 / bars.sigma[b] ** 2,
        count=point_count + exterior_count + len(used) + len(b),
    )


def weighted_vPv(weighted: Weighted, layout: Unknowns, state: State) -> float:
    """Return v'Pv of the observed unknowns and distances."""
    if weighted.count == 0:
        return 0.0
    e = exterior_misclosure(weighted, state) * layout.exterior_free[weighted.image]
    return _vPv(weighted, state, e, bar_directions(weighted, layout, state)[1])


def _vPv(weighted: Weighted, state: State, exterior: FloatArray, bars: FloatArray) -> float:
    """Return v'Pv from the misclosures of exterior orientations (e, 6) and of scale bars (b,)."""
    dp = state.parameters[weighted.camera, weighted.parameter] - weighted.value
    dX = state.points[weighted.point] - weighted.xyz
    return (
        float(weighted.length_weight @ bars**2)
        + float(np.einsum("ea,eab,eb->", exterior, weighted.exterior_weight, exterior))
        + float(dp @ weighted.interior_weight @ dp)
        + float(np.einsum("pa,pab,pb->", dX, weighted.point_weight, dX))
    )


def weighted_terms(weighted: Weighted, layout: Unknowns, state: State) -> WeightedTerms:
    """Return the part of the normal equations that comes from observed unknowns and distances.

    Object points are not in it but in `point_terms`.
    """
    if weighted.count == 0:
        s = 3 * len(layout.kept)
        none = np.zeros(0)
        return WeightedTerms(np.zeros((0, 6, 6)), np.zeros((0, 6)), none, np.zeros((s, s)), np.zeros(s), 0.0)
    free = layout.exterior_free[weighted.image]
    e = exterior_misclosure(weighted, state) * free
    J = exterior_jacobian(state.M[weighted.image]) * free[:, None, :]
    PJ = weighted.exterior_weight @ J
    dp = state.parameters[weighted.camera, weighted.parameter] - weighted.value
    rows, length = bar_rows(weighted, layout, state)
    Pa = weighted.length_weight[:, None] * rows
    return WeightedTerms(
        exterior=np.swapaxes(J, 1, 2) @ PJ,
        exterior_g=np.einsum("eab,ea->eb", PJ, e),
        interior_g=weighted.interior_weight @ dp,
        kept=rows.T @ Pa,
        kept_g=Pa.T @ length,
        vPv=_vPv(weighted, state, e, length),
    )


def point_terms(weighted: Weighted, state: State) -> tuple[FloatArray, FloatArray]:
    """Return N (n, 3, 3) and g (n, 3) of the object points from their observed coordinates."""
    n = len(state.points)
    N, g = np.zeros((n, 3, 3)), np.zeros((n, 3))
    N[weighted.point] = weighted.point_weight
    dX = state.points[weighted.point] - weighted.xyz
    g[weighted.point] = np.einsum("pab,pb->pa", weighted.point_weight, dX)
    return N, g


def exterior_misclosure(weighted: Weighted, state: State) -> FloatArray:
    """Return state minus observed X0, omega, phi, kappa, (e, 6)."""
    M = state.M[weighted.image]
    angles = angles_from_rotation(np.swapaxes(M, 1, 2)) - weighted.angles
    return np.hstack(
        [state.position[weighted.image] - weighted.position, (angles + np.pi) % (2 * np.pi) - np.pi]
    )


def bar_directions(weighted: Weighted, layout: Unknowns, state: State) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors from start to end (b, 3) and computed minus measured lengths (b,)."""
    d = state.points[layout.kept[weighted.end]] - state.points[layout.kept[weighted.start]]
    length = np.linalg.norm(d, axis=1)
    return d / np.maximum(length, np.finfo(float).tiny)[:, None], length - weighted.length


def bar_rows(weighted: Weighted, layout: Unknowns, state: State) -> tuple[FloatArray, FloatArray]:
    """Return derivatives of the lengths by the kept points (b, 3 s) and computed minus measured (b,)."""
    s = len(layout.kept)
    direction, misclosure = bar_directions(weighted, layout, state)
    a = np.zeros((len(misclosure), s, 3))
    bar = np.arange(len(misclosure))
    a[bar, weighted.end] = direction
    a[bar, weighted.start] = -direction
    return a.reshape(len(bar), 3 * s) * layout.point_free[layout.kept].ravel(), misclosure


def inverse_of_observed(covariance: FloatArray) -> tuple[FloatArray, int]:
    """Return inverse covariances (n, d, d) over the observed components only, and how many there are."""
    weight = np.zeros(covariance.shape)
    count = 0
    for p, Q in enumerate(covariance):
        variance = np.diagonal(Q)
        on = observed(variance)
        weight[p][np.ix_(on, on)] = np.linalg.inv(Q[np.ix_(on, on)])
        count += int(on.sum())
    return weight, count


def observed(variance: FloatArray) -> BoolArray:
    """Return which variances belong to observed components: neither 0 (fixed) nor infinite (unknown)."""
    return np.asarray((variance > 0) & np.isfinite(variance))
