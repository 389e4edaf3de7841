"""Given mounts of the cameras of a rig, judged by the photographs before they are used.

A network without them has the mounts that its photographs give, with their covariance. Rotation and direction
of the base are compared with those of the image points alone, which leave the length of the base open; the
length with those of the other mounts, and of all else that gives a scale.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6 (tests).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.quality.given_values import LEVEL, GivenModel
from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, angles_from_rotation, rotation_from_angles
from sfm.errors import GeometryError
from sfm.observations.mounts import MountObservations
from sfm.observations.pose import exterior_jacobian
from sfm.remarks.remark import Remark, remark
from sfm.survey.hypotheses.given_scales import numbers_of_scale

TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class _Found:
    """The mounts of the same cameras in a network without the given ones."""

    position: FloatArray  # (c, 3)
    angles: FloatArray  # rad, (c, 3)
    covariance: FloatArray  # of X, Y, Z, omega, phi, kappa of all, (6 c, 6 c)
    motions: FloatArray  # derivatives by what the network leaves open, (6 c, d)
    redundancy: int


def judge_mounts(given: MountObservations, free: Adjustment) -> tuple[MountObservations, tuple[Remark, ...]]:
    """Return the mounts whose rotation and direction the photographs confirm, and remarks on the others.

    Args:
        given: mounts, held fixed or observed.
        free: adjustment of the image points alone.
    """
    found = _found(given, free)
    if found is None:
        return given, ()
    level, kept, remarks = LEVEL / len(given), np.ones(len(given), dtype=bool), []
    for k in range(len(given)):
        one = given.select(np.array([k]))
        model = _shape(one, found, k)
        if model.fits(level):
            continue
        kept[k] = False
        R, X = rotation_from_angles(*found.angles[k]), found.position[k]
        turn = rotation_from_angles(*one.angles[0]).T @ R
        named = (name for name, other in _mistaken(one) if _shape(other, found, k).fits(level))
        remarks.append(
            remark(
                "mount_contradicted",
                camera=free.estimate.cameras[given.camera[k]].name,
                angle=(_degrees((np.trace(turn) - 1) / 2), "deg"),
                direction=(_degrees(_cosine(one.position[0], X)), "deg"),
                sigmas=float(np.sqrt(model.kept().chi2)),
                mistake=next(named, None),
            )
        )
    return given.select(kept), tuple(remarks)


def judge_mount_scales(
    given: MountObservations, without: Adjustment, others: Sequence[str]
) -> tuple[MountObservations, tuple[Remark, ...]]:
    """Return the mounts if their scales agree, else none of them and the remark that they contradict.

    Args:
        given: mounts whose rotation and direction the photographs confirm.
        without: adjustment of all but the mounts.
        others: kinds of given values in it that give a scale.
    """
    found = _found(given, without)
    if found is None or not len(given) or not given.position.any(axis=1).all():  # a base of 0 has no scale
        return given, ()
    c = len(given)
    length = np.linalg.norm(given.position, axis=1), np.linalg.norm(found.position, axis=1)
    rows, stated = np.zeros((c, 6 * c)), np.zeros(c)
    for k, along in enumerate(given.position / length[0][:, None]):
        rows[k, 6 * k : 6 * k + 3] = found.position[k] / length[1][k] ** 2
        stated[k] = along @ given.covariance[k, :3, :3] @ along / length[0][k] ** 2
    model = GivenModel(
        np.log(length[0] / length[1]),
        rows @ found.covariance @ rows.T,
        np.diag(stated),
        rows @ found.motions,
        np.arange(c),
        found.redundancy,
    )
    if model.kept().probability() >= LEVEL:
        return given, ()
    is_open = bool(np.abs(model.A).max(initial=0.0) > 0)
    S = model.network + model.stated
    if is_open:  # the two that differ most
        low, high = int(model.v.argmin()), int(model.v.argmax())
        off, sigma = model.v[high] - model.v[low], np.sqrt(S[low, low] + S[high, high] - 2 * S[low, high])
        cameras, others = [high], [f"the mount of {without.estimate.cameras[given.camera[low]].name}"]
    else:
        k = int(np.argmax(np.abs(model.v) / np.sqrt(np.diagonal(S))))
        off, sigma, cameras = model.v[k], np.sqrt(S[k, k]), list(range(c))
    names = [without.estimate.cameras[a].name for a in given.camera[cameras]]
    by = numbers_of_scale(float(off), float(sigma))
    said = remark("mounts_scale_contradicted", cameras=names, others=others, **by)
    return given.select(np.zeros(c, dtype=bool)), (said,)


def _found(given: MountObservations, a: Adjustment) -> _Found | None:
    """Return the mounts of an adjustment without given ones; None where it does not determine them."""
    mounts = a.estimate.mounts
    if mounts is None or not a.converged or a.redundancy < 1:
        return None
    if a.undetermined or a.defect != a.expected_defect:
        return None
    try:
        m = marginal_of(a, cross=False)
        rigs = m.covariance().rigs
    except (GeometryError, np.linalg.LinAlgError):
        return None
    k = given.camera
    at = (len(rigs) - 6 * len(mounts.rig) + 6 * k[:, None] + np.arange(6)).ravel()
    covariance, columns = rigs[np.ix_(at, at)], m.layout.mount_column[k]
    if not np.isfinite(covariance).all() or (columns < 0).any():
        return None
    R = mounts.rotation[k]
    J = block_diag(*exterior_jacobian(np.swapaxes(R, 1, 2)))
    motions = J @ m.optimum.motions.reduced[columns.ravel()]
    motions[np.abs(motions) < 1e-9 * np.abs(motions).max(initial=1.0)] = 0.0
    return _Found(mounts.position[k], angles_from_rotation(R), covariance, motions, a.redundancy)


def _shape(one: MountObservations, found: _Found, k: int) -> GivenModel:
    """Return the differences of one mount from that of the photographs, the length of the base left open."""
    X, P = found.position[k], one.position[0]
    scale = float(np.linalg.norm(P)) / max(float(np.linalg.norm(X)), TINY) or 1.0
    turned = one.angles[0] - found.angles[k]
    open_scale = P @ X > 0  # no positive scale turns a base round
    D, own = np.diag([scale] * 3 + [1.0] * 3), slice(6 * k, 6 * k + 6)
    return GivenModel(
        np.concatenate([P - scale * X, (turned + np.pi) % (2 * np.pi) - np.pi]),
        D @ found.covariance[own, own] @ D,
        one.covariance[0],
        np.concatenate([open_scale * scale * X, np.zeros(3)])[:, None],
        np.zeros(6, dtype=np.int64),
        found.redundancy,
    )


def _mistaken(one: MountObservations) -> Iterator[tuple[str, MountObservations]]:
    """Yield the mount that was meant, if the given one is the result of a common mistake, with its name."""
    R, X, S = rotation_from_angles(*one.angles[0]), one.position[0], one.covariance[0]
    turned = S.copy()
    turned[:3, :3] = R.T @ S[:3, :3] @ R + float(X @ X) * S[3:, 3:].max() * np.eye(3)
    angles = angles_from_rotation(R.T)
    yield (
        "inverse pose",
        replace(one, position=-(R.T @ X)[None], angles=angles[None], covariance=turned[None]),
    )
    yield "opposite base", one.with_values(np.concatenate([-X, one.angles[0]])[None])
    yield "inverse rotation", one.with_values(np.concatenate([X, angles])[None])


def _cosine(a: FloatArray, b: FloatArray) -> float:
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), TINY))


def _degrees(cosine: float) -> float:
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
