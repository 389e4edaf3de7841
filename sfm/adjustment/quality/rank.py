"""Rank defect of the normal equations, found numerically, and what it leaves undetermined, in words."""

from __future__ import annotations

from collections import Counter

import numpy as np

from sfm.adjustment.engine.iterate import Optimum
from sfm.adjustment.engine.products import times_points, times_reduced
from sfm.adjustment.engine.unknowns import Unknowns, interior_names
from sfm.conventions import BoolArray, FloatArray
from sfm.network import Estimate, Network

MAPPED_TO_ZERO = 1e-6  # length of the image of a null vector of length 1, diagonal 1; rounding leaves 1e-13
LEADING = 0.1  # share of the largest component of a null vector from which a parameter is named
EXTERIOR = ("X0", "Y0", "Z0", "x rotation", "y rotation", "z rotation")


def rank_defect(optimum: Optimum, layout: Unknowns) -> int:
    """Return the rank defect of the normal equations without datum.

    It counts the motions that the normal matrix maps to zero, its further null vectors, directions of
    object points that their rays leave open, and the unknowns held for want of image points.
    """
    found = null_motions(optimum, layout) + int(optimum.factor.further.shape[1])
    return found + int(optimum.equations.blocks.held.sum()) + layout.held_defect


def null_motions(optimum: Optimum, layout: Unknowns) -> int:
    """Return how many of the motions that the datum has to fix the normal matrix maps to zero.

    All do if their sum does, which is tried first; otherwise they are counted one by one.
    """
    d = optimum.motions.defect
    if d == 0:
        return 0
    scale = optimum.equations.parts.scale[:, None]
    H = np.linalg.qr(optimum.motions.reduced / scale)[0]
    together = H.sum(axis=1, keepdims=True) / np.sqrt(d)
    if _mapped_to_zero(optimum, layout, scale * together).all():
        return d
    return int(_mapped_to_zero(optimum, layout, scale * H).sum())


def _mapped_to_zero(optimum: Optimum, layout: Unknowns, H: FloatArray) -> BoolArray:
    """Return which columns of H, of scaled length 1, the reduced normal matrix maps to zero, (d,)."""
    b, parts = optimum.equations.blocks, optimum.equations.parts
    first, d = 6 * len(b.U), H.shape[1]
    NH = np.empty_like(H)
    NH[:first] = (b.U @ H[:first].reshape(len(b.U), 6, d)).reshape(first, d) + parts.border @ H[first:]
    NH[first:] = parts.border.T @ H[:first] + parts.corner @ H[first:]
    through = np.empty((len(b.y), 3, d))
    times_reduced(layout.observations, b, H, through)
    np.negative(through, out=through)
    times_points(layout.observations, b, through, NH)
    return np.asarray(np.linalg.norm(parts.scale[:, None] * NH, axis=0) < MAPPED_TO_ZERO)


def undetermined_of(
    optimum: Optimum, layout: Unknowns, network: Network, estimate: Estimate, *, allowed_motions: int
) -> tuple[str, ...]:
    """Return what cannot be determined, in words; empty if everything can.

    Args:
        optimum: undamped normal equations and their factor.
        layout: order of the unknowns.
        network: for the names of photographs and points.
        estimate: for the names of cameras.
        allowed_motions: defect that the kind of datum is meant to fix.
    """
    words = list(layout.held)
    words += [
        f"point {network.points[j]}: its rays are parallel"
        for j in np.flatnonzero(optimum.equations.blocks.held)
    ]
    if optimum.motions.defect > allowed_motions:
        words.append(
            f"datum: {optimum.motions.defect - allowed_motions} of the seven of position, attitude and scale "
            "are not determined by the control"
        )
    words += [_name(vector, layout, network, estimate) for vector in optimum.factor.further.T]
    return tuple(words)


def reduced_names(layout: Unknowns, network: Network, estimate: Estimate) -> list[tuple[str, str]]:
    """Return (parameter, of what) of each reduced unknown."""
    names = [(part, f"photograph {image}") for image in network.images for part in EXTERIOR]
    names += interior_names(layout, estimate)
    names += [(axis, f"point {network.points[j]}") for j in layout.kept for axis in "XYZ"]
    return names


def _name(vector: FloatArray, layout: Unknowns, network: Network, estimate: Estimate) -> str:
    """Return the leading parameters of a null vector: "c, y0 of camera A with Z0 of 12 photographs"."""
    size = np.abs(vector)
    names = reduced_names(layout, network, estimate)
    leading = [names[r] for r in np.argsort(-size) if size[r] >= LEADING * size.max()]
    interior = [f"{part} of {owner}" for part, owner in leading if owner.startswith("camera")]
    others = Counter(part for part, owner in leading if not owner.startswith("camera"))
    single = {part: owner for part, owner in leading if not owner.startswith("camera")}
    parts = interior + [
        f"{part} of {single[part]}" if count == 1 else f"{part} of {count} photographs"
        for part, count in others.items()
    ]
    return "not separable: " + ", ".join(parts)
