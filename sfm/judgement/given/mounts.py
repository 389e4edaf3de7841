"""Given mounts of the cameras of a rig, judged by the photographs.

The image points alone give rotations and directions of bases, but no lengths. The lengths are compared with
one another, and with everything else that gives a scale.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from sfm.judgement.given.free_network import FreeNetwork, Reference, confirmed
from sfm.judgement.given.mistakes import explanations
from sfm.judgement.given.scales import Scales, common_scale, difference_of, numbers_of_scale, scales_of
from sfm.judgement.given.values import GivenModel
from sfm.model.conventions import FloatArray, rotation_from_angles
from sfm.model.network import Network
from sfm.model.observations.pose import MountObservations
from sfm.model.remarks.remark import Remark, remark
from sfm.model.similarity import Similarity

TINY = float(np.finfo(float).tiny)


def judge_mounts(
    given: MountObservations, free: FreeNetwork, level: float
) -> tuple[MountObservations, tuple[Remark, ...]]:
    """Return the mounts whose rotation and base direction the photographs confirm, and remarks on the others.

    The mounts are held fixed or observed.
    """
    reference, mounts = free.reference_of([given]), free.adjustment.estimate.mounts
    if reference is None or mounts is None:
        return given, ()
    level, kept, remarks = level / len(given), np.ones(len(given), dtype=bool), []
    rest = free.adjustment.redundancy
    for k, camera in enumerate(given.camera.tolist()):
        mount = given.select(np.array([k]))
        model = _shape(mount, reference, mounts.position)
        if model.fits(level):
            continue
        kept[k] = False
        turn = rotation_from_angles(*mount.angles[0]).T @ mounts.rotation[camera]
        P, X = mount.position[0], mounts.position[camera]
        cosine = float(P @ X / max(float(np.linalg.norm(P) * np.linalg.norm(X)), TINY))
        mistakes = explanations(
            [mount], lambda mended: _shape(mended[0], reference, mounts.position).fits(level)
        )
        remarks.append(
            remark(
                "mount_contradicted",
                camera=free.adjustment.estimate.cameras[camera].name,
                angle=(_degrees((np.trace(turn) - 1) / 2), "deg"),
                direction=(_degrees(cosine), "deg"),
                sigmas=float(np.sqrt(model.kept().chi2)),
                mistake=next(iter(mistakes), None),
                rest=rest if rest > model.kept().dof else None,
            )
        )
    return given.select(kept), tuple(remarks)


def _shape(mount: MountObservations, reference: Reference, positions: FloatArray) -> GivenModel:
    """Return the differences of one mount from that of the photographs; the length of the base is free."""
    P, X = mount.position[0], positions[mount.camera[0]]
    scale = float(np.linalg.norm(P)) / max(float(np.linalg.norm(X)), TINY) or 1.0
    model, _ = reference.differences([mount], Similarity(scale, np.eye(3), np.zeros(3)))
    return model if P @ X > 0 else replace(model, A=np.zeros((6, 0)))  # no positive scale reverses a base


def judge_mount_scales(
    given: MountObservations,
    network: Network,
    reference: Reference,
    place: Callable[[Network], Similarity],
    level: float,
) -> tuple[MountObservations, tuple[Remark, ...]]:
    """Return the mounts if their scales agree; otherwise no mounts, and the remark that they contradict.

    The network has all other given values and observations that were found right. `place` gives the object
    frame from the frame of the free network, by all given values of a network.
    """
    right = [kind for kind in (*confirmed(network), *network.further) if len(kind)]
    free = reference.marginal.adjustment.estimate
    mounts, has_scale = free.mounts, given.position.any(axis=1).all()  # a base of 0 has none
    if mounts is None or not has_scale:
        return given, ()
    placing = place(network)
    of_right = common_scale(reference, right, placing)
    if of_right is None:
        bases = np.linalg.norm(mounts.position[given.camera], axis=1)
        scale = float(np.median(np.linalg.norm(given.position, axis=1) / bases))
        placing = replace(placing, scale=scale)
    along = [np.append(position, np.zeros(3))[None] / (position @ position) for position in given.position]
    of_mounts = scales_of(reference, [given], placing, block_diag(*along))
    model = Scales.joined([of_mounts, *([] if of_right is None else [of_right])]).model(reference)
    if model.kept().probability() >= level:
        return given, ()
    cameras = [free.cameras[a].name for a in given.camera]
    if of_right is None:  # the two that differ most
        low, high = int(model.v.argmin()), int(model.v.argmax())
        (off, sigma), contradicting = difference_of(model, high, low), [cameras[high]]
        others = [f"the mount of {cameras[low]}"]
    else:
        differences = [difference_of(model, k, len(given)) for k in range(len(given))]
        off, sigma = max(differences, key=lambda by: abs(by[0]) / by[1])
        contradicting = cameras
        sources = {"bars": network.scale_bars, "control": network.control, "centres": network.exterior}
        others = [name for name, values in sources.items() if len(values)]
        others += [kind.name for kind in network.further]
    by = numbers_of_scale(off, sigma, level)
    said = remark("scale_contradicted", cameras=contradicting, others=others, **by)
    return given.select(np.zeros(len(given), dtype=bool)), (said,)


def _degrees(cosine: float) -> float:
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
