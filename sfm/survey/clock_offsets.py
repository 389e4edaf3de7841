"""Clocks of a rig that fit at two offsets: the cameras on it must keep their relative orientation.

Photographs at regular intervals, of which one camera misses the first or last, have as many partners at two
offsets of the clocks. Photographs are oriented one by one, so that the relative rotations of the cameras at
all moments show which offset is right: those of wrong moments differ by the motion of the rig.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.model.conventions import IntArray
from sfm.model.distributions import f_isf
from sfm.model.estimate import Estimate
from sfm.survey.inputs.measurements import Measurements
from sfm.survey.inputs.survey import Survey
from sfm.survey.rigs import middle_rotation, with_moments

MIN_MOMENTS = 3  # of two cameras, whose relative rotations are compared


def agree_on_clocks(
    survey: Survey, measured: Measurements, estimate: Estimate
) -> tuple[Survey, Measurements] | None:
    """Return the moments by the second offset of clocks, if the cameras agree better on their mounts by it.

    Args:
        survey: may have the moments by a second offset.
        measured: all named image points, with the moments by the first.
        estimate: has photographs oriented one by one.

    Returns:
        Survey and measurements with the other moments, whose remarks state that offset; None if the first one
        stays.
    """
    if not survey.other_moments or measured.network.moment is None:
        return None
    other = replace(survey, moments=survey.other_moments, other_moments={})
    network = with_moments(other, replace(measured.network, moment=None))
    assert network.moment is not None
    now, count = rotation_spread(measured.network.camera, measured.network.moment, estimate)
    then, of_other = rotation_spread(network.camera, network.moment, estimate)
    dof = 3 * (min(count, of_other) - 1)
    level = survey.adjust.levels.question
    if min(count, of_other) < MIN_MOMENTS or not now > then * f_isf(level, dof, dof):
        return None
    said = tuple(
        replace(remark, subjects={role: names for role, names in remark.subjects.items() if role != "unsure"})
        if remark.kind == "clock_differs"
        else remark
        for remark in measured.remarks
    )
    return other, replace(measured, network=network, remarks=said)


def rotation_spread(camera: IntArray, moment: IntArray, estimate: Estimate) -> tuple[float, int]:
    """Return the median square of the differences of relative rotations from their middle, and their number.

    Args:
        camera: index of the camera of each photograph, (m,).
        moment: index of its moment, (m,).
        estimate: has photographs oriented one by one.

    Returns:
        The largest median of two cameras, rad^2, and the smallest number of moments that two cameras share.
    """
    largest, fewest = 0.0, len(camera)
    cameras = np.unique(camera).tolist()
    oriented = np.flatnonzero(estimate.oriented)
    of = {(int(camera[i]), int(moment[i])): int(i) for i in oriented}
    for b in cameras[1:]:
        pairs = [(i, of[b, when]) for (a, when), i in of.items() if a == cameras[0] and (b, when) in of]
        fewest = min(fewest, len(pairs))
        if not pairs:
            continue
        relative = np.array([estimate.rotation[i].T @ estimate.rotation[j] for i, j in pairs])
        along = np.einsum("iab,ab->i", relative, middle_rotation(relative))
        angle = np.arccos(np.clip((along - 1) / 2, -1.0, 1.0))
        largest = max(largest, float(np.median(angle**2)))
    return largest, fewest
