"""Rigs of a survey: which photographs were taken at the same moment, and where their cameras are mounted.

Each photograph is first oriented by itself. Two photographs of one moment then give the pose of one camera in
the axes of the other. All moments together give its mount: the median of the positions, and the rotation from
which the rotations of the moments differ least. A photograph that could not be oriented by itself is placed
by its rig.

Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 4.4.2 and 8.4; Hartley et al.
(2013), Rotation averaging, Int. J. Comput. Vis. 103 (medians of rotations).
"""

from __future__ import annotations

import fnmatch
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sfm.model.conventions import FloatArray, IntArray, rotation_from_angles
from sfm.model.display import counted, listed
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.estimate import Estimate, Mounts
from sfm.model.network import Network
from sfm.model.observations.pose import MountObservations
from sfm.model.similarity import Similarity, nearest_rotation
from sfm.survey.inputs.settings import RigSettings
from sfm.survey.inputs.survey import Survey

TINY = float(np.finfo(float).tiny)
ROUNDS = 10  # iterations of the mean rotation; after two it moves by less than the scatter of the rotations


def with_moments(survey: Survey, network: Network) -> Network:
    """Return the network with the moment of each photograph; unchanged if the survey has no rigs.

    Args:
        survey: states which cameras make a rig and how to find the moment of a photograph.
        network: has one camera for each camera of the survey, in the same order.

    Raises:
        SurveyFileError: a photograph of a rig has no moment, two photographs of one camera have the same
            moment, or no moment has photographs of two cameras.
    """
    if not survey.rigs:
        return network
    key: list[object] = [(name,) for name in network.images]
    number = {camera.name: a for a, camera in enumerate(survey.cameras)}
    for rig in survey.rigs:
        where = f"{survey.source}: rig {rig.name}"
        of_rig = [number[name] for name in rig.cameras]
        moment = _moments(rig, network.images, network.camera, of_rig, survey.moments, where)
        first: dict[tuple[object, int], str] = {}
        cameras = defaultdict(set)
        for i, when in moment.items():
            a = int(network.camera[i])
            before = first.setdefault((when, a), network.images[i])
            if before != network.images[i]:
                raise SurveyFileError(
                    f"{where}: photographs {before} and {network.images[i]} of camera "
                    f"{survey.cameras[a].name} are of one moment, '{when}'; needed one of each camera"
                )
            cameras[when].add(a)
            key[i] = (rig.name, when)
        if moment and max(len(of_moment) for of_moment in cameras.values()) < 2:
            shown = listed([str(when) for when in cameras], most=3)
            raise SurveyFileError(
                f"{where}: no moment has photographs of two cameras; moments are {shown}; correct moment"
            )
    order = {moment: k for k, moment in enumerate(dict.fromkeys(key))}
    return replace(network, moment=np.array([order[moment] for moment in key], dtype=np.int64))


def planned_mounts(survey: Survey) -> Mounts:
    """Return the given mounts of the cameras of a planned survey, free unless they are held fixed.

    Raises:
        SurveyFileError: cameras on no rig, several rigs, or a camera without a mount.
    """
    names = [camera.name for camera in survey.cameras]
    if len(survey.rigs) != 1 or set(survey.rigs[0].cameras) != set(names):
        on = listed([name for rig in survey.rigs for name in rig.cameras]) or "none"
        raise SurveyFileError(
            f"{survey.source}: cameras {listed(names)}, on rigs {on}; a plan needs one camera, or one rig of "
            "all cameras"
        )
    (rig,), given = survey.rigs, survey.given_mounts
    missing = [name for name in rig.cameras[1:] if names.index(name) not in given.camera]
    if missing:
        raise SurveyFileError(
            f"{survey.source}: rig {rig.name}: no mount of {listed(missing)}; a plan needs their mounts"
        )
    n = len(names)
    at_reference = np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 6), dtype=bool)
    return _with_given(Mounts(*at_reference, (rig.name,) * n), given)


def _with_given(mounts: Mounts, given: MountObservations) -> Mounts:
    """Return mounts with the given ones inserted; those without standard deviations are held fixed."""
    a = given.camera
    position, rotation, free = mounts.position.copy(), mounts.rotation.copy(), mounts.free.copy()
    position[a], free[a] = given.position, np.diagonal(given.covariance, axis1=1, axis2=2) > 0
    rotation[a] = [rotation_from_angles(*angles) for angles in given.angles]
    return replace(mounts, position=position, rotation=rotation, free=free)


def _moments(
    rig: RigSettings,
    images: Sequence[str],
    camera: IntArray,
    of_rig: list[int],
    named: Mapping[str, str],
    where: str,
) -> dict[int, object]:
    """Return the moment of each photograph of a rig, by photograph index."""
    of_photographs = [i for i in range(len(images)) if camera[i] in of_rig]
    if rig.named:
        for i in of_photographs:
            if images[i] not in named:
                raise SurveyFileError(
                    f"{where}: {rig.table or 'EXIF data'} has no moment of photograph '{images[i]}'"
                )
        return {i: named[images[i]] for i in of_photographs}
    if rig.moment == "order":
        counts = {a: int((camera == a).sum()) for a in of_rig}
        if len(set(counts.values())) > 1:
            said = ", ".join(f"{n} of {name}" for n, name in zip(counts.values(), rig.cameras, strict=True))
            raise SurveyFileError(
                f"{where}: moment = 'order' needs as many photographs of each camera, found {said}"
            )
        inside = [np.flatnonzero(camera == a).tolist() for a in of_rig]
        return {i: k for rows in inside for k, i in enumerate(sorted(rows, key=lambda i: images[i]))}
    pattern, moments = re.compile(rig.moment), {}
    for i in of_photographs:
        match = pattern.search(images[i])
        if match is None or match.group(1) is None:
            raise SurveyFileError(f"{where}: moment = '{rig.moment}' does not match photograph '{images[i]}'")
        moments[i] = match.group(1)
    return moments


def mount_cameras(survey: Survey, network: Network, estimate: Estimate) -> Estimate:
    """Return the estimate with the mounts of the rigs' cameras, and with all photographs of oriented moments.

    Args:
        survey: names the rigs.
        network: has moments, see `with_moments`.
        estimate: has photographs oriented one by one.

    Raises:
        GeometryError: a camera of a rig is oriented at no moment together with the others.
    """
    if network.moment is None:
        return estimate
    if any(rig.blocks for rig in survey.rigs):  # the final adjustment determines their mounts
        placed = place_by_rigs(*split_blocks(survey, network, estimate))
        return replace(estimate, position=placed.position, rotation=placed.rotation)
    mounts = mounts_of(_rigs_of(survey), network, estimate)
    return place_by_rigs(network, replace(estimate, mounts=mounts))


def hold_mounts(estimate: Estimate, given: MountObservations, *, scaled: bool) -> Estimate:
    """Return the estimate with the given mounts; those without standard deviations are held fixed.

    Args:
        estimate: has mounts.
        given: mounts that its photographs confirm, except for their common scale.
        scaled: whether something else gives the scale; otherwise the given bases do.
    """
    mounts, a = estimate.mounts, given.camera
    if mounts is None or not len(given):
        return estimate
    if not scaled:
        base = np.maximum(np.linalg.norm(mounts.position[a], axis=1), TINY)
        scale = float(np.median(np.linalg.norm(given.position, axis=1) / base))
        estimate = Similarity(scale, np.eye(3), np.zeros(3)).apply_estimate(estimate)
        mounts = replace(mounts, position=scale * mounts.position)  # all mounts are free
    return replace(estimate, mounts=_with_given(mounts, given))


def _rigs_of(survey: Survey) -> dict[str, list[int]]:
    """Return the camera indices of each rig, the reference camera first."""
    number = {camera.name: a for a, camera in enumerate(survey.cameras)}
    return {rig.name: [number[name] for name in rig.cameras] for rig in survey.rigs}


def split_blocks(survey: Survey, network: Network, estimate: Estimate) -> tuple[Network, Estimate]:
    """Return the network and estimate with a separate rig for each block of time.

    Rigs without blocks stay as they are. The cameras of each block are named after it, and share their
    interior orientation with the cameras of the other blocks.

    Args:
        survey: names the rigs.
        network: has moments, and one camera for each camera of the survey.
        estimate: of this network.

    Raises:
        SurveyFileError: a photograph of a rig with blocks is in no block or in several, a moment is in two
            blocks, or a block has no photographs.
        GeometryError: as in `mounts_of`.
    """
    if network.moment is None or not any(rig.blocks for rig in survey.rigs):
        return network, estimate
    cameras, owner, rigs = list(estimate.cameras), network.camera.copy(), _rigs_of(survey)
    for rig in survey.rigs:
        if not rig.blocks:
            continue
        of_rig = rigs.pop(rig.name)
        block = _blocks_of(rig, survey.source, network, of_rig)
        for g, glob in enumerate(rig.blocks):
            mounted = rigs[f"{rig.name} {glob}"] = []
            for a in of_rig:
                camera = estimate.cameras[a]
                shared = (camera.name,) * len(camera.names)
                of_block = replace(camera, name=f"{camera.name} {glob}", shared=shared)
                mounted.append(len(cameras) if g else a)
                cameras[mounted[-1] : mounted[-1] + 1] = [of_block]
                owner[[i for i in block if block[i] == g and network.camera[i] == a]] = mounted[-1]
    network, estimate = replace(network, camera=owner), replace(estimate, cameras=tuple(cameras))
    return network, replace(estimate, mounts=mounts_of(rigs, network, estimate))


def _blocks_of(rig: RigSettings, source: str, network: Network, of_rig: Sequence[int]) -> dict[int, int]:
    """Return the block index of each photograph of a rig, by photograph index."""
    assert network.moment is not None
    where, block_of, at = f"{source}: rig {rig.name}", dict[int, int](), dict[int, int]()
    for i in np.flatnonzero(np.isin(network.camera, of_rig)).tolist():
        name, moment = network.images[i], int(network.moment[i])
        blocks = [g for g, glob in enumerate(rig.blocks) if fnmatch.fnmatchcase(name, glob)]
        if len(blocks) != 1:
            many = "no block" if not blocks else counted(len(blocks), "block")
            raise SurveyFileError(
                f"{where}: photograph '{name}' is in {many} of {listed(rig.blocks)}, needed 1"
            )
        block_of[i] = blocks[0]
        if at.setdefault(moment, block_of[i]) != block_of[i]:
            raise SurveyFileError(f"{where}: the moment of photograph '{name}' is in two blocks, needed 1")
    for g, glob in enumerate(rig.blocks):
        if g not in block_of.values():
            raise SurveyFileError(f"{where}: block '{glob}' has no photographs")
    return block_of


def mounts_of(rigs: Mapping[str, Sequence[int]], network: Network, estimate: Estimate) -> Mounts:
    """Return mounts from photographs oriented one by one, free except for the reference cameras.

    Args:
        rigs: camera indices of each rig by its name, the reference camera first.
        network: has moments.
        estimate: has photographs oriented one by one.

    Raises:
        GeometryError: a camera of a rig is oriented at no moment together with the others.
    """
    cameras = estimate.cameras
    a = len(cameras)
    position, rotation = np.zeros((a, 3)), np.tile(np.eye(3), (a, 1, 1))
    free, names = np.zeros((a, 6), dtype=bool), [""] * a
    at: dict[tuple[int, int], int] = {}
    if network.moment is not None:
        for i in np.flatnonzero(estimate.oriented).tolist():
            at[int(network.moment[i]), int(network.camera[i])] = i
    for rig, (reference, *left) in rigs.items():
        known = [reference]
        names[reference] = rig
        while left:
            pairs = {  # of photographs of one moment, with the camera of the first
                b: [
                    (k, i, at[when, b])
                    for k in known
                    for (when, camera), i in at.items()
                    if camera == k and (when, b) in at
                ]
                for b in left
            }
            b = max(left, key=lambda camera: len(pairs[camera]))
            if not pairs[b]:
                raise GeometryError(
                    f"rig {rig}: camera {cameras[b].name} is oriented at no moment together with "
                    f"{listed([cameras[k].name for k in known])}; more points that both see are needed"
                )
            positions, rotations = [], []  # of the camera, in the axes of the rig
            for k, i, j in pairs[b]:
                of_rig = estimate.rotation[i] @ rotation[k].T
                origin = estimate.position[i] - of_rig @ position[k]
                positions.append(of_rig.T @ (estimate.position[j] - origin))
                rotations.append(of_rig.T @ estimate.rotation[j])
            position[b] = np.median(positions, axis=0)
            rotation[b] = middle_rotation(np.array(rotations))
            free[b], names[b] = True, rig
            known.append(b)
            left.remove(b)
    return Mounts(position, rotation, free, tuple(names))


def middle_rotation(R: FloatArray) -> FloatArray:
    """Return the mean of the rotations nearest to their median rotation, (3, 3)."""
    angle = np.arccos(np.clip((np.einsum("iab,jab->ij", R, R) - 1) / 2, -1.0, 1.0))
    middle = R[int(np.argmin(np.median(angle, axis=1)))]
    for _ in range(ROUNDS):
        away = np.arccos(np.clip((np.einsum("iab,ab->i", R, middle) - 1) / 2, -1.0, 1.0))
        middle = nearest_rotation(R[away <= np.median(away)].sum(axis=0))
    return np.asarray(middle)


def place_by_rigs(network: Network, estimate: Estimate) -> Estimate:
    """Return the estimate with all photographs oriented of each moment that has an oriented photograph."""
    mounts = estimate.mounts
    if network.moment is None or mounts is None:
        return estimate
    position, rotation = estimate.position.copy(), estimate.rotation.copy()
    by_moment: dict[int, int] = {}
    for i in np.flatnonzero(estimate.oriented):
        by_moment.setdefault(int(network.moment[i]), int(i))
    for j in np.flatnonzero(~estimate.oriented):
        if int(network.moment[j]) in by_moment:
            reference = by_moment[int(network.moment[j])]
            a, b = network.camera[reference], network.camera[j]
            of_rig = rotation[reference] @ mounts.rotation[a].T
            rotation[j] = of_rig @ mounts.rotation[b]
            position[j] = position[reference] + of_rig @ (mounts.position[b] - mounts.position[a])
    return replace(estimate, position=position, rotation=rotation)
