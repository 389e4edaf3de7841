"""Given mounts of the cameras of a rig, judged by the photographs.

The image points alone give rotations and directions of bases, but no lengths. The lengths are compared with
one another, and with everything else that gives a scale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from sfm.conventions import FloatArray, rotation_from_angles
from sfm.judgement.given.free_network import FreeNetwork, Reference, confirmed
from sfm.judgement.given.scales import numbers_of_scale
from sfm.judgement.given.values import RANK, GivenModel
from sfm.network import Network
from sfm.observations.kind import Kind
from sfm.observations.pose import MountObservations
from sfm.remarks.remark import Remark, remark
from sfm.similarity import Similarity

TINY = float(np.finfo(float).tiny)


def judge_mounts(
    given: MountObservations, free: FreeNetwork, level: float
) -> tuple[MountObservations, tuple[Remark, ...]]:
    """Return the mounts whose rotation and base direction the photographs confirm, and remarks on the others.

    Args:
        given: mounts, held fixed or observed.
        free: adjustment of the image points alone.
        level: probability that right mounts are reported as wrong.
    """
    reference, mounts = free.reference_of([given]), free.adjustment.estimate.mounts
    if reference is None or mounts is None:
        return given, ()
    level, kept, remarks = level / len(given), np.ones(len(given), dtype=bool), []
    rest = free.adjustment.redundancy
    for k, camera in enumerate(given.camera.tolist()):
        one = given.select(np.array([k]))
        model = _shape(one, reference, mounts.position[camera])
        if model.fits(level):
            continue
        kept[k] = False
        turn = rotation_from_angles(*one.angles[0]).T @ mounts.rotation[camera]
        mistakes = (
            name
            for name, mended in one.mistakes().items()
            if _shape(mended, reference, mounts.position[camera]).fits(level)
        )
        remarks.append(
            remark(
                "mount_contradicted",
                camera=free.adjustment.estimate.cameras[camera].name,
                angle=(_degrees((np.trace(turn) - 1) / 2), "deg"),
                direction=(_degrees(_cosine(one.position[0], mounts.position[camera])), "deg"),
                sigmas=float(np.sqrt(model.kept().chi2)),
                mistake=next(mistakes, None),
                rest=rest if rest > model.kept().dof else None,
            )
        )
    return given.select(kept), tuple(remarks)


def _shape(one: MountObservations, reference: Reference, X: FloatArray) -> GivenModel:
    """Return the differences of one mount from that of the photographs, X; the length of the base is free."""
    P = one.position[0]
    scale = float(np.linalg.norm(P)) / max(float(np.linalg.norm(X)), TINY) or 1.0
    model, _ = reference.differences([one], Similarity(scale, np.eye(3), np.zeros(3)))
    return model if P @ X > 0 else replace(model, A=np.zeros((6, 0)))  # no positive scale reverses a base


def judge_mount_scales(
    given: MountObservations,
    network: Network,
    reference: Reference,
    place: Callable[[Network], Similarity],
    level: float,
) -> tuple[MountObservations, tuple[Remark, ...]]:
    """Return the mounts if their scales agree; otherwise no mounts, and the remark that they contradict.

    Args:
        given: mounts whose rotation and direction the photographs confirm.
        network: has all other given values and observations that were found right.
        reference: the unknowns of all these.
        place: gives the object frame from the frame of the free network, by all given values of a network.
        level: probability that right mounts are reported as wrong.
    """
    right = [kind for kind in (*confirmed(network), *network.observations) if len(kind)]
    free = reference.marginal.adjustment.estimate
    mounts, has_scale = free.mounts, given.position.any(axis=1).all()  # a base of 0 has none
    if mounts is None or not has_scale:
        return given, ()
    placing = place(network)
    model = _lengths(given, right, reference, placing)
    if model.A.any():  # nothing else gives the scale: the covariance is that at the scale of the mounts
        bases = np.linalg.norm(mounts.position[given.camera], axis=1)
        scale = float(np.median(np.linalg.norm(given.position, axis=1) / bases))
        model = _lengths(given, right, reference, replace(placing, scale=scale))
    if model.kept().probability() >= level:
        return given, ()
    cameras, S = free.cameras, model.network + model.stated
    if model.A.any():  # the two that differ most
        low, high = int(model.v.argmin()), int(model.v.argmax())
        off, sigma = model.v[high] - model.v[low], np.sqrt(S[low, low] + S[high, high] - 2 * S[low, high])
        contradicting, others = [high], [f"the mount of {cameras[given.camera[low]].name}"]
    else:
        k = int(np.argmax(np.abs(model.v) / np.sqrt(np.diagonal(S))))
        off, sigma, contradicting = model.v[k], np.sqrt(S[k, k]), list(range(len(given)))
        sources = (
            ("bars", network.scale_bars),
            ("control", network.control),
            ("centres", network.exterior),
        )
        others = [name for name, values in sources if len(values)]
        others += [one.name for one in network.observations]
    said = remark(
        "scale_contradicted",
        cameras=[cameras[a].name for a in given.camera[contradicting]],
        others=others,
        **numbers_of_scale(float(off), float(sigma)),
    )
    return given.select(np.zeros(len(given), dtype=bool)), (said,)


def _lengths(
    given: MountObservations, right: Sequence[Kind], reference: Reference, placing: Similarity
) -> GivenModel:
    """Return the differences of ln of the lengths of bases from what the right values imply."""
    model, kind = reference.differences([*right, given], placing)
    model = model.beside((kind < len(right))[model.item])
    along = block_diag(*(position[None] / (position @ position) for position in given.position))
    along = along.reshape(len(given), -1, 3)
    along = np.concatenate([along, np.zeros(along.shape)], axis=2).reshape(len(given), -1)
    A = along @ model.A
    return GivenModel(
        -np.log(1 - along @ model.v),
        along @ model.network @ along.T,
        along @ model.stated @ along.T,
        A[:, np.abs(A).max(axis=0, initial=0.0) > RANK],
        np.arange(len(given)),
        model.redundancy,
    )


def _cosine(a: FloatArray, b: FloatArray) -> float:
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), TINY))


def _degrees(cosine: float) -> float:
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
