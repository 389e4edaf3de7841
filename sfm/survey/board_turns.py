"""Turns of a plate that looks alike when turned: cameras of a rig must see the same turn at one moment.

For a single camera any turn is as good as another, since the points of the turned plate coincide with those
of the plate. For two cameras it is not: their relative orientation is that of the rig in one turn only.
Cameras mounted together have the same relative orientation at every position of the plate. A wrong turn
violates this, unless the plate was not moved. Photographs of one moment are found by the last number in their
names, or by their order.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import NamedTuple

import numpy as np

from sfm.model.camera import Camera, project
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distributions import f_isf
from sfm.model.estimate import Estimate
from sfm.model.network import rows_of
from sfm.model.remarks.remark import Remark, remark
from sfm.model.similarity import fit_similarity
from sfm.survey.inputs.measurements import Measurements
from sfm.survey.inputs.survey import Survey
from sfm.survey.target_network import build_network, name_coded
from sfm.targets.codes.plates import PlateFamily

RIGS_TRIED = 12  # evenly spread pairs of photographs whose relative orientation is tried on the others
OF_A_RIG = 6  # parameters of a relative orientation with its scale


class Pair(NamedTuple):
    """Two photographs of one moment."""

    left: int  # of the first camera
    right: int


@dataclass(frozen=True)
class _Rig:
    """A relative orientation of two cameras, and how pairs of photographs agree with it."""

    turn: IntArray  # turn of the plate in the right photograph, 0 if both have the same names, (p,)
    misfit: FloatArray  # RMS distance of its points from their predicted positions, px, (p,)
    agrees: BoolArray  # whether each point is nearest to the predicted position of its number, (p,)

    @classmethod
    def none(cls, count: int) -> _Rig:
        """Return a relative orientation that no pair agrees with."""
        return cls(np.zeros(count, dtype=np.int64), np.full(count, np.inf), np.zeros(count, dtype=bool))

    def squares(self, rows: BoolArray) -> float:
        """Return the sum of squared misfits of the selected pairs, px^2."""
        return float((self.misfit[rows] ** 2).sum())

    @property
    def rank(self) -> tuple[int, float]:
        """Sort key: smaller if more pairs agree, then if they agree more closely."""
        return -int(self.agrees.sum()), self.squares(self.agrees)


@dataclass(frozen=True)
class AgreedTurns:
    """The plate in the turn that the first camera sees, and what remains uncertain."""

    measured: Measurements | None  # with image points renamed; None if all had the names of that turn
    uncertain: Remark | None  # names the photographs whose turn is uncertain; None without any


def agree_on_turns(survey: Survey, measured: Measurements, estimate: Estimate) -> AgreedTurns:
    """Rename the points of a plate that looks alike turned, so that mounted cameras see the same turn.

    Args:
        survey: states the plate.
        measured: all named image points.
        estimate: orientation from the points of the plate in each photograph, in any turn.
    """
    plate, photographs = survey.family, measured.photographs
    cameras = np.unique(measured.network.camera)
    if (
        not isinstance(plate, PlateFamily)
        or not plate.is_ambiguous
        or photographs is None
        or len(cameras) < 2
        or measured.parts  # other sources of image points show which turn is right
    ):
        return AgreedTurns(None, None)
    codes = [target.code for target in photographs.targets]
    level = survey.adjust.levels.question
    unsure = np.zeros(len(measured.network.images), dtype=bool)
    for camera in cameras[1:].tolist():
        tried = [
            (pairs, _common_rig(plate, measured, estimate, pairs, level))
            for pairs in _pairings(measured, int(cameras[0]), camera)
        ]
        pairs, rig = max(tried, key=lambda trial: 0 if trial[1] is None else int(trial[1].agrees.sum()))
        if rig is None:
            unsure |= np.isin(measured.network.camera, [cameras[0], camera])
            continue
        for k in np.flatnonzero(~rig.agrees).tolist():
            unsure[list(pairs[k])] = True
        for k in np.flatnonzero(rig.agrees & (rig.turn > 0)).tolist():
            right, number = pairs[k].right, plate.turns[int(rig.turn[k]) - 1]
            codes[right] = np.where(codes[right] >= 0, number[codes[right]], codes[right])
    uncertain = None
    unsure &= estimate.oriented
    if unsure.any():
        uncertain = remark(
            "plate_looks_alike_turned",
            cameras=sorted({measured.cameras[a].name for a in measured.network.camera[unsure]}),
            photographs=[photographs.names[i] for i in np.flatnonzero(unsure)],
        )
    pairs_of_codes = list(zip(photographs.targets, codes, strict=True))
    if not any((target.code != code).any() for target, code in pairs_of_codes):
        return AgreedTurns(None, uncertain)
    targets = tuple(replace(target, code=code) for target, code in pairs_of_codes)
    photographs = replace(photographs, targets=targets)
    naming = name_coded(photographs)
    network = replace(build_network(survey, photographs, naming), sources=measured.network.sources)
    return AgreedTurns(replace(measured, network=network, photographs=photographs, naming=naming), uncertain)


def _pairings(measured: Measurements, first: int, second: int) -> list[list[Pair]]:
    """Return the possible pairs of photographs of one moment: by number, and by order."""
    assert measured.files is not None
    files, row = measured.files, {name: i for i, name in enumerate(measured.network.images)}
    names = [
        [name for name, k in zip(files.names, files.camera.tolist(), strict=True) if k == camera]
        for camera in (first, second)
    ]
    numbers = []
    for of_camera in names:
        by_number: dict[int, list[str]] = {}  # by the last number in a name
        for name in of_camera:
            digits = re.findall(r"\d+", PurePosixPath(name).stem)
            if digits:
                by_number.setdefault(int(digits[-1]), []).append(name)
        numbers.append({number: same[0] for number, same in by_number.items() if len(same) == 1})
    ways = [[(numbers[0][k], numbers[1][k]) for k in sorted(numbers[0].keys() & numbers[1].keys())]]
    if len(names[0]) == len(names[1]):
        ways.append(list(zip(*names, strict=True)))
    # without pairs whose photographs are not both measured
    return [
        [Pair(row[left], row[right]) for left, right in way if left in row and right in row] for way in ways
    ]


def _common_rig(
    plate: PlateFamily, measured: Measurements, estimate: Estimate, pairs: Sequence[Pair], level: float
) -> _Rig | None:
    """Return the relative orientation of two cameras that most pairs agree on; None if another is possible.

    If the plate was moved too little, the relative orientation of other turns may fit as well. Both have the
    same number of unknowns, so the ratio of their squared misfits decides.
    """
    seen = np.flatnonzero([estimate.oriented[list(pair)].all() for pair in pairs])
    if len(seen) < 2:
        return None
    views = _Views(plate, measured, estimate)
    rigs: dict[bytes, _Rig] = {}
    for k in seen[np.unique(np.linspace(0, len(seen) - 1, RIGS_TRIED).round().astype(int))]:
        for turn in range(len(views.turns)):
            rig = views.compare(pairs, seen, *views.relative_orientation(pairs[k], turn))
            turns = rig.turn.tobytes()
            if turns not in rigs or rig.rank < rigs[turns].rank:
                rigs[turns] = rig
    best, *others = sorted(rigs.values(), key=lambda rig: rig.rank)
    return best if _is_certain(best, others, len(seen), level) else None


def _is_certain(best: _Rig, others: Sequence[_Rig], pairs: int, level: float) -> bool:
    """Return whether most pairs agree with the best one, and no other fits as well (F test)."""
    agreeing = int(best.agrees.sum())
    if agreeing < 2 or 2 * agreeing <= pairs:
        return False
    redundancy = OF_A_RIG * (agreeing - 1)
    limit = float(f_isf(level, redundancy, redundancy))
    rivals = [other for other in others if (other.turn != best.turn)[best.agrees].any()]
    return all(other.squares(best.agrees) > limit * best.squares(best.agrees) for other in rivals)


class _Views:
    """The photographs of a plate, with their orientation relative to it."""

    def __init__(self, plate: PlateFamily, measured: Measurements, estimate: Estimate) -> None:
        network, naming = measured.network, measured.naming
        assert naming is not None
        self.turns = (np.arange(plate.count), *plate.turns)
        self.estimate = estimate
        self.cameras: list[Camera] = [estimate.cameras[k] for k in network.camera]
        rows = rows_of(network.image_points.image, len(network.images))
        self.number = [naming.code[network.image_points.point[of_photograph]] for of_photograph in rows]
        self.xy = [network.image_points.xy[of_photograph] for of_photograph in rows]
        # the exact plate: the approximate points do not look exactly alike turned
        plane, known = plate.plane(1.0), estimate.determined
        self.points = fit_similarity(plane[naming.code[known]], estimate.points[known]).apply(plane)

    def relative_orientation(self, pair: Pair, turn: int) -> tuple[FloatArray, FloatArray]:
        """Return rotation and base of the right camera, its plate turned, in the frame of the left one."""
        left, right = pair
        motion = fit_similarity(self.points, self.points[self.turns[turn]], scale=1.0)
        R, X0 = self.estimate.rotation, self.estimate.position
        base = motion.apply(X0[right][None])[0] - X0[left]
        return R[left].T @ motion.rotation @ R[right], R[left].T @ base

    def compare(self, pairs: Sequence[Pair], rows: IntArray, rotation: FloatArray, base: FloatArray) -> _Rig:
        """Return how the selected pairs, each in its best turn, agree with a relative orientation."""
        rig = _Rig.none(len(pairs))
        R, X0 = self.estimate.rotation, self.estimate.position
        for k in rows.tolist():
            left, right = pairs[k]
            placed = project(self.cameras[right], X0[left] + R[left] @ base, R[left] @ rotation, self.points)
            placed[~np.isfinite(placed)] = np.inf  # behind the camera
            away = np.linalg.norm(self.xy[right][:, None] - placed, axis=2)
            places = [(np.arange(len(away)), number[self.number[right]]) for number in self.turns]
            misfit = [float(np.sqrt((away[place] ** 2).mean())) for place in places]
            turn = int(np.argmin(misfit))
            rig.turn[k], rig.misfit[k] = turn, misfit[turn]
            rig.agrees[k] = bool((away.argmin(axis=1) == places[turn][1]).all())
        return rig
