"""Cameras that share single parameters, for adjusters that know no such sharing."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from sfm.camera import Camera
from sfm.display import counted


def without_sharing(cameras: tuple[Camera, ...]) -> tuple[tuple[Camera, ...], tuple[str, ...]]:
    """Return the cameras on their own, with what they share held at its value, and what that is, in words.

    COLMAP shares all parameters of a camera among its photographs or none. What several cameras share in
    part, such as one distortion for photographs that differ in c, can only be held at the survey's result.

    Args:
        cameras: interior orientations, some parameters of which may be shared.
    """
    groups = [[camera.group_of(s) for s in range(len(camera.names))] for camera in cameras]
    members = Counter(group for own in groups for group in set(own) if group)
    alone: list[Camera] = []
    held: dict[str, tuple[str, ...]] = dict.fromkeys(members, ())
    for camera, own in zip(cameras, groups, strict=True):
        shared = np.array([members[group] > 1 for group in own]) & camera.free
        for s in np.flatnonzero(shared):
            held[own[s]] = tuple(dict.fromkeys((*held[own[s]], camera.names[s])))
        alone.append(replace(camera, free=camera.free & ~shared, shared=()))
    words = tuple(
        f"{', '.join(names)} of {group}, shared by {counted(members[group], 'camera')}"
        for group, names in held.items()
        if names
    )
    return tuple(alone), words
