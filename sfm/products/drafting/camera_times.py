"""Rigs that times of exposure propose: photographs of cameras pair up, at a constant difference of clocks.

Two hypotheses explain pairs without a rig. Photographs taken independently are of one time by chance, and so
are as many at other differences of the clocks. Cameras that a person uses in turn follow one another, but at
intervals that scatter. Both must be improbable.

Times only propose: two cameras that are released together need not be fixed to one another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np

from sfm.model.conventions import FloatArray
from sfm.model.distributions import LEVEL, binomial_sf, normal_sf
from sfm.photographs.exif import Metadata
from sfm.survey.inputs.from_exif import clock_offsets, named_moments
from sfm.survey.inputs.settings import RigSettings

# Smallest share of the photographs of a camera in pairs. With more than half, 1 of 300 simulated surveys by
# two people was a rig (eight stations, photographs within 10 s, times in whole seconds); with this, none.
MIN_PAIRED = 0.75
# Cameras with one trigger differ by the delay of their shutters, some 10 ms, and of radio triggers: an
# estimate.
TRIGGER_S = 0.25
# Standard deviation of the interval between two photographs that a person takes in turn, by an even hand:
# the intervals of others scatter more, and as many pairs are less probable (estimate: 300 simulated surveys
# with intervals that scatter by 0.7 to 3 s give no rig).
BY_HAND_S = 0.5
BESIDE_S = 10.0  # up to which from the difference of the clocks pairs are counted that are by chance
ROUNDING_S = 1e-6  # of EXIF times
USUAL_S = float(RigSettings.model_fields["tolerance_s"].default)


@dataclass(frozen=True)
class TimedRig:
    """Cameras whose photographs pair up by their times."""

    cameras: tuple[str, ...]  # the first is the reference
    moment: Mapping[str, str]  # moment of each photograph, by its name
    tolerance_s: float  # of `[[rig]]`


def rig_of_times(cameras: Mapping[str, Sequence[str]], metadata: Mapping[str, Metadata]) -> TimedRig | None:
    """Return the rig that the times of photographs propose; None if they propose none.

    Args:
        cameras: names of the photographs of each camera. One with a photograph without time is on no rig.
        metadata: metadata of each photograph.
    """
    taken: dict[str, dict[str, datetime]] = {}
    for camera, names in cameras.items():
        times = {name: time for name in names if (time := metadata[name].taken) is not None}
        if len(times) == len(names) > 1:
            taken[camera] = times
    exif_of = {camera: metadata[cameras[camera][0]] for camera in taken}
    rigs = [_rig(reference, taken, exif_of) for reference in sorted(taken)]
    return max((rig for rig in rigs if rig is not None), key=lambda rig: len(rig.moment), default=None)


def _rig(
    reference: str, taken: Mapping[str, Mapping[str, datetime]], exif_of: Mapping[str, Metadata]
) -> TimedRig | None:
    """Return the rig of a reference camera and all cameras whose photographs pair up with its own."""
    first = min(taken[reference].values())
    seconds = {
        camera: np.sort([(time - first).total_seconds() for time in times.values()])
        for camera, times in taken.items()
    }
    mounted = [
        camera
        for camera in sorted(set(taken) - {reference})
        if (ahead := _paired_at(seconds[reference], seconds[camera])) is not None
        and not _is_one_camera(exif_of[reference], exif_of[camera], ahead)
    ]
    rig = (reference, *mounted)
    shortest = min(float(np.diff(seconds[camera]).min()) for camera in rig)
    exact = not any(_is_whole(seconds[camera]) for camera in rig) and shortest < 4 * USUAL_S
    tolerance = TRIGGER_S if exact else USUAL_S
    corrected = dict(taken[reference])
    for camera in mounted:
        offset, *others = clock_offsets(
            list(taken[reference].values()), list(taken[camera].values()), tolerance
        )
        if offset and others:  # a survey of this rig would be refused
            return None
        corrected |= {name: time - timedelta(seconds=offset) for name, time in taken[camera].items()}
    moment = named_moments(corrected, tolerance)
    placed = {(camera, moment[name]) for camera in rig for name in taken[camera]}
    return TimedRig(rig, moment, tolerance) if mounted and len(placed) == len(moment) else None


def _is_one_camera(a: Metadata, b: Metadata, ahead: float) -> bool:
    """Return whether photographs that pair up at a difference of clocks, s, may be of one camera.

    Copies, and photographs of one release of one body, are of one time too.
    """
    if (a.make, a.model) != (b.make, b.model):
        return False
    return a.serial == b.serial if a.serial and b.serial else abs(ahead) <= USUAL_S


def _paired_at(reference: FloatArray, times: FloatArray) -> float | None:
    """Return the difference of two clocks at which more photographs pair up than without a rig, s; or None.

    Args:
        reference: sorted times of the photographs of one camera, s.
        times: sorted times of those of the other, s.
    """
    in_seconds = _is_whole(reference) or _is_whole(times)
    # whole seconds of one moment differ by one of two neighbouring numbers
    half, wider = (0.5, 1.0) if in_seconds else (TRIGGER_S, 0.0)
    differences = np.sort((times[:, None] - reference).ravel())
    last = np.searchsorted(differences, differences + 2 * half + ROUNDING_S, side="right") - 1
    count = last - np.arange(len(differences))
    best = np.flatnonzero(count == count.max())
    ahead = min(((differences[best] + differences[last[best]]) / 2).tolist(), key=abs)
    pairs, fewest = _pairs(reference, times - ahead, half), min(len(reference), len(times))
    if pairs < MIN_PAIRED * fewest:
        return None
    width = 2 * half + wider
    away = np.arange(2 * width, BESIDE_S + width, width)
    beside = [_pairs(reference, times - ahead - shift, half) for shift in (*away, *-away)]
    usual = float(np.mean(beside)) / fewest
    covered = np.minimum(np.diff(reference), width).sum() / max(float(np.ptp(reference)), width)
    independent = len(differences) * binomial_sf(pairs - 1, fewest, min(max(usual, covered), 1.0))
    # A person who takes turns does not take two photographs at the same time by clocks that agree.
    in_turn = 0.0
    if abs(ahead) > half:
        within = 1 - 2 * float(normal_sf(width / 2 / BY_HAND_S))
        in_turn = float(binomial_sf(pairs - 2, fewest - 1, within))  # one pair gives the difference
    return ahead if max(independent, in_turn) < LEVEL else None


def _is_whole(seconds: FloatArray) -> bool:
    """Return whether times are stated in whole seconds."""
    return bool((seconds - seconds[0] == np.round(seconds - seconds[0])).all())


def _pairs(reference: FloatArray, times: FloatArray, half: float) -> int:
    """Return the number of photographs of one camera that are of one time with another of the reference."""
    nearest = np.abs(reference[:, None] - times).argmin(axis=0)
    near = np.abs(reference[nearest] - times) <= half + ROUNDING_S
    return len(np.unique(nearest[near]))
