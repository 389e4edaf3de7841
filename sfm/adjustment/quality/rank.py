"""Rank defect of the normal equations, determined numerically, and a description of what is undetermined.

A null vector is a direction of the unknowns that the normal matrix maps to zero. The defect counts motions of
the whole network, further null vectors, open directions of points, and unknowns that were held. The
description names points, photographs, motions and parameters.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from sfm.adjustment.datum import free_motions, leading
from sfm.adjustment.engine.iterate import Optimum
from sfm.adjustment.engine.unknowns import MIN_RAYS, Unknowns, interior_names
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.display import counted
from sfm.model.estimate import Estimate
from sfm.model.network import Network

MAPPED_TO_ZERO = 1e-6  # largest |N h| of a null vector, |h| = 1, unit diagonal of N; rounding leaves 1e-13
AXIS = 1e-3  # largest deviation from 1 of a component for a direction to be called that of an axis
AXES = ("X", "Y", "Z")
EXTERIOR = ("X0", "Y0", "Z0", "x rotation", "y rotation", "z rotation")


def rank_defect(optimum: Optimum, layout: Unknowns) -> int:
    """Return the rank defect of the normal equations without datum.

    It counts the motions that the normal matrix maps to zero, and its further null vectors. It also counts
    directions of object points that their rays leave open, and unknowns held for lack of image points.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
    """
    motions = null_motions(optimum, layout) + optimum.motions.further
    return motions + int(optimum.equations.held.sum()) + layout.held_defect


def null_motions(optimum: Optimum, layout: Unknowns) -> int:
    """Return the number of motions that the datum fixes and that the normal matrix maps to zero.

    If it maps their sum to zero, it maps all of them to zero. This is tested first; otherwise they are
    counted one by one.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
    """
    d = optimum.motions.defect
    if d == 0:
        return 0
    scale = optimum.equations.scale[:, None]
    H = optimum.motions.orthonormal(optimum.equations.scale)
    together = H.sum(axis=1, keepdims=True) / np.sqrt(d)
    if _mapped_to_zero(optimum, layout, scale * together).all():
        return d
    return int(_mapped_to_zero(optimum, layout, scale * H).sum())


def _mapped_to_zero(optimum: Optimum, layout: Unknowns, H: FloatArray) -> BoolArray:
    """Return which columns of H, with scaled length 1, the reduced normal matrix maps to zero, (d,)."""
    scale = optimum.equations.scale[:, None]
    NH = optimum.equations.times_schur(H)
    return np.asarray(np.linalg.norm(scale * NH, axis=0) < MAPPED_TO_ZERO)


def undetermined_of(
    optimum: Optimum,
    layout: Unknowns,
    network: Network,
    estimate: Estimate,
    weight: FloatArray,
    *,
    allowed_motions: int,
) -> tuple[str, ...]:
    """Return a description of what is undetermined, in words; empty if everything is determined.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
        network: network with the names of photographs and points.
        estimate: estimate with the names of cameras.
        weight: factor on the weight of each image point, 0 where rejected, (k,).
        allowed_motions: defect that this kind of datum is expected to fix.
    """
    words = list(layout.held)
    open_points = np.flatnonzero(optimum.equations.held)
    rays = np.bincount(layout.observations.point[weight > 0], minlength=len(network.points))[open_points]
    words += [
        f"point {network.points[j]}: "
        + ("its rays are parallel" if r > 1 else f"{counted(r, 'ray')} accepted, {MIN_RAYS} are needed")
        for j, r in zip(open_points.tolist(), rays.tolist(), strict=True)
    ]
    if optimum.motions.defect > allowed_motions:
        words.append(
            f"datum: {optimum.motions.defect - allowed_motions} of the seven of position, attitude and scale "
            f"are not determined by the control: {describe_motions(optimum, layout)}"
        )
    words += [_name(vector, layout, network, estimate) for vector in optimum.factor.further.T]
    return tuple(words)


def describe_motions(optimum: Optimum, layout: Unknowns) -> str:
    """Return the motions that the observations leave open: "shift along X and Y, rotation about Z, scale".

    A rotation about an axis that misses the centre of the points is reported as a rotation, without the
    accompanying shift.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
    """
    sound = optimum.equations.held == 0  # other points do not follow the motions
    d = optimum.motions.defect
    generators = free_motions(layout, optimum.state)[2][sound].reshape(-1, 7)
    opened = optimum.motions.points[sound, :, :d].reshape(-1, d)
    V = np.linalg.qr(np.linalg.lstsq(generators, opened, rcond=None)[0])[0]  # (7, d)
    turns = _null_space(V[3:])  # combinations that only shift
    rest = _null_space(turns.T) if turns.shape[1] else np.eye(V.shape[1])
    scales = rest @ _null_space(V[6:] @ rest)  # other combinations, without a change of scale
    parts = []
    if turns.shape[1]:
        parts.append(f"shift along {_axes(V[:3] @ turns)}")
    if scales.shape[1]:
        parts.append(f"rotation about {_axes(V[3:6] @ scales)}")
    if turns.shape[1] + scales.shape[1] < V.shape[1]:
        parts.append("scale")
    return ", ".join(parts)


def _null_space(A: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the null space of a matrix."""
    _, singular, Vt = np.linalg.svd(A, full_matrices=True)
    return np.asarray(Vt[int((singular > MAPPED_TO_ZERO).sum()) :].T)


def _axes(directions: FloatArray) -> str:
    """Return the directions that vectors span, in words: axes by name, other directions by components."""
    U = np.linalg.svd(directions, full_matrices=False)[0][:, : directions.shape[1]]
    if U.shape[1] >= len(AXES):
        return "X, Y and Z"
    share = np.linalg.norm(U, axis=1)
    named = [axis for axis, part in zip(AXES, share, strict=True) if part > 1 - AXIS]
    if len(named) == U.shape[1]:
        return " and ".join(named)
    across = U[:, 0] if U.shape[1] == 1 else np.cross(U[:, 0], U[:, 1])
    shown = ", ".join(f"{value:.2f}" for value in across * np.sign(across[np.argmax(np.abs(across))]))
    return f"({shown})" if U.shape[1] == 1 else f"all directions across ({shown})"


def reduced_names(layout: Unknowns, network: Network, estimate: Estimate) -> list[tuple[str, str]]:
    """Return (parameter, owner) of each reduced unknown.

    Args:
        layout: order of the unknowns.
        network: network with the names of photographs and points.
        estimate: estimate with the names of cameras.
    """
    first = np.unique(layout.observations.pose_of, return_index=True)[1]
    what = "rig at photograph" if layout.rigged else "photograph"
    names = [(part, f"{what} {network.images[i]}") for i in first for part in EXTERIOR]
    names += interior_names(layout, estimate)
    names += [(axis, f"point {network.points[j]}") for j in layout.kept for axis in "XYZ"]
    return names


def _name(vector: FloatArray, layout: Unknowns, network: Network, estimate: Estimate) -> str:
    """Return the leading parameters of a null vector, such as "c of camera A with Z0 of 12 photographs"."""
    names, named = reduced_names(layout, network, estimate), leading(vector[:, None])[:, 0]
    open_ones = [names[r] for r in np.argsort(-np.abs(vector)) if named[r]]
    interior = [f"{part} of {owner}" for part, owner in open_ones if owner.startswith("camera")]
    others = Counter(part for part, owner in open_ones if not owner.startswith("camera"))
    single = {part: owner for part, owner in open_ones if not owner.startswith("camera")}
    parts = interior + [
        f"{part} of {single[part]}" if count == 1 else f"{part} of {count} photographs"
        for part, count in others.items()
    ]
    first, *rest = parts
    return f"{first} with {', '.join(rest)}" if rest else first
