"""The differences of two epochs in one frame, with the covariance of all of them together.

Points are recognised by their codes and other names, and what bears a mere number by its place after a robust
alignment. Q_d = Q_1 + Q_2 - C - C' where both epochs were given the same values: a bar whose length is stated
wrong makes both epochs wrong alike. With an observation l of standard deviation s and gradient g, an epoch
moves by Q g / s^2 for a unit of l, so that

    C = (Q_1 g_1) (Q_2 g_2)' / (s^2 s01 s02),

with the sigma0 of both that their covariances hold, summed over the bars, and over the coordinates of
control, that both share.

Source: Niemeier (2008), Ausgleichungsrechnung, sec. 12.2; Koch (1999), Parameter Estimation and Hypothesis
Testing in Linear Models, sec. 3.2.3 (covariance of estimates and observations).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from sfm.comparison.congruency import MOTIONS, motions
from sfm.comparison.pairing import fit_robustly, pair_results
from sfm.comparison.point_tests import held_points, joint_covariance, known_scale
from sfm.conventions import FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.network import ObjectPoints, ScaleBars
from sfm.similarity import Similarity
from sfm.stored_result import StoredResult

SAME = 1e-9  # relative difference of two given values that are the same one


@dataclass(frozen=True)
class Epoch:
    """One epoch: a result, and what it was given."""

    name: str
    result: StoredResult
    bars: ScaleBars = field(default_factory=ScaleBars)  # that took part, by index of the result's points
    control: ObjectPoints = field(default_factory=ObjectPoints)  # that took part, as observed
    interior: tuple[tuple[str, str, float], ...] = ()  # camera, parameter and value observed with a sigma
    sigma0: float = 1.0  # of unit weight, by which the covariance of the result is scaled


@dataclass(frozen=True)
class Differences:
    """Second minus first coordinates of the common points, in the frame of the first epoch."""

    names: tuple[str, str]  # of the epochs
    unit: str
    points: tuple[str, ...]  # names in the first epoch, n of them
    xyz: FloatArray  # in the first epoch, object unit, (n, 3)
    difference: FloatArray  # object unit, (n, 3)
    covariance: FloatArray  # of the differences, object unit^2, (3 n, 3 n)
    motion: str  # what is no change: rigid, or similarity where not both have a scale
    redundancy: int | None  # of both adjustments together
    only_first: tuple[str, ...]  # points that the second epoch lacks
    only_second: tuple[str, ...]
    by_place: int  # points recognised by their place
    untested: tuple[str, ...]  # common points that an epoch holds, or did not keep the covariance of
    shared: tuple[str, ...]  # given values that both epochs share, in words

    @property
    def motions(self) -> FloatArray:
        """G: motions of the whole that are no change, (3 n, u)."""
        return motions(self.xyz)[:, : MOTIONS[self.motion]]


def epoch_differences(first: Epoch, second: Epoch) -> Differences:
    """Bring the second epoch into the frame of the first, and return the differences.

    Args:
        first: an epoch.
        second: a later one.

    Raises:
        GeometryError: an epoch without the covariance of its points, fewer than four common points, units
            that cannot be converted, or a weighted calibration that both share.
    """
    for epoch in (first, second):
        if epoch.result.redundancy == 0:
            raise GeometryError(f"{epoch.name}: redundancy 0, its standard deviations say nothing")
        if epoch.result.covariance is None:
            raise GeometryError(
                f"{epoch.name}: the covariance of all points together (point_covariance.npy) is missing; run "
                "the survey again with this version"
            )
    _refuse_shared_calibration(first, second)
    a, b = _of_own_photographs(first.result, "a"), _of_own_photographs(second.result, "b")
    pairing = pair_results(a, b)
    pa, pb = pairing.points.T
    rows_a, rows_b = a.covariance_rows(pa), b.covariance_rows(pb)
    kept = (rows_a >= 0) & (rows_b >= 0)
    for epoch, rows in ((first, rows_a), (second, rows_b)):
        assert epoch.result.covariance is not None  # refused before
        variance = np.diagonal(epoch.result.covariance).reshape(-1, 3)
        kept[kept] = ~held_points(variance[rows[kept]])
    untested = tuple(a.network.points[j] for j in pa[~kept])
    pairs = pairing.points[kept]
    others = _others(a, pa), _others(b, pb)
    pa, pb = pairs.T
    if len(pa) < 4:
        raise GeometryError(
            f"{first.name} and {second.name} have {len(pa)} points in common, a test needs 4 or more"
        )
    scale = known_scale(a, b)
    if scale is None and a.has_scale and b.has_scale:
        raise GeometryError(f"{first.name} is in {a.unit} and {second.name} in {b.unit}: give both one unit")
    moved = fit_robustly(b.estimate.points[pb], a.estimate.points[pa], scale=scale)
    xyz = a.estimate.points[pa]
    Q = joint_covariance(a, rows_a[kept], 1.0, np.eye(3))
    Q += joint_covariance(b, rows_b[kept], moved.scale, moved.rotation)
    influence_a, influence_b, shared = _shared(first, second, pairs, moved)
    C = influence_a @ influence_b.T
    Q -= C
    Q -= C.T
    known = [one.redundancy for one in (a, b) if one.redundancy is not None]
    return Differences(
        names=(first.name, second.name),
        unit=a.unit,
        points=tuple(a.network.points[j] for j in pa),
        xyz=xyz,
        difference=moved.apply(b.estimate.points[pb]) - xyz,
        covariance=Q,
        motion="similarity" if scale is None else "rigid",
        redundancy=sum(known) if known else None,
        only_first=others[0],
        only_second=others[1],
        by_place=pairing.points_by_place,
        untested=untested,
        shared=shared,
    )


def _of_own_photographs(result: StoredResult, prefix: str) -> StoredResult:
    """Return a result whose photographs are told from those of another epoch, which may bear their names."""
    names = tuple(f"{prefix}/{name}" for name in result.network.images)
    return replace(result, network=replace(result.network, images=names))


def _others(result: StoredResult, paired: IntArray) -> tuple[str, ...]:
    left = np.ones(len(result.network.points), dtype=bool)
    left[paired] = False
    left &= result.estimate.determined
    return tuple(result.network.points[j] for j in np.flatnonzero(left))


def _refuse_shared_calibration(first: Epoch, second: Epoch) -> None:
    theirs = {(camera, parameter): value for camera, parameter, value in second.interior}
    for camera, parameter, value in first.interior:
        other = theirs.get((camera, parameter))
        if other is not None and abs(other - value) <= SAME * abs(value):
            raise GeometryError(
                f"{first.name} and {second.name} share the weighted {parameter} of camera {camera}, whose "
                "error is in both: let every epoch determine its own (free), or hold it"
            )


def _shared(
    first: Epoch, second: Epoch, pairs: IntArray, frame: Similarity
) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """Columns Q g / s of both epochs for each value that both were given, (3 n, k) each; and words."""
    mine: list[FloatArray] = []
    yours: list[FloatArray] = []
    words: list[str] = []
    theirs = dict(_observations(second))
    for key, (ours, sigma, value) in _observations(first):
        if key not in theirs:
            continue
        other, other_sigma, other_value = theirs[key]
        if abs(other_value - value) > SAME * max(abs(value), 1.0):
            continue
        for epoch, gradient, s, found in ((first, ours, sigma, mine), (second, other, other_sigma, yours)):
            Q = epoch.result.covariance
            assert Q is not None  # refused before
            found.append(sum((Q[:, k] * g for k, g in gradient), start=np.zeros(len(Q))) / (s * epoch.sigma0))
        words.append(key)
    if not words:
        nothing = np.zeros((3 * len(pairs), 0))
        return nothing, nothing, ()
    pa, pb = (one.result.covariance_rows(p) for one, p in zip((first, second), pairs.T, strict=True))
    a, b = np.stack(mine, axis=1), np.stack(yours, axis=1)
    turn = frame.scale * frame.rotation
    turned = np.einsum("xi,nik->nxk", turn, b.reshape(-1, 3, len(words))[pb])
    return (
        a.reshape(-1, 3, len(words))[pa].reshape(3 * len(pa), -1),
        turned.reshape(3 * len(pa), -1),
        tuple(words),
    )


Observed = tuple[list[tuple[int, float]], float, float]  # gradient by column, standard deviation, value


def _observations(epoch: Epoch) -> Iterable[tuple[str, Observed]]:
    """Bars and coordinates of control that an epoch was given with a standard deviation, by their names."""
    names, x = epoch.result.network.points, epoch.result.estimate.points
    bars, row = epoch.bars, epoch.result.covariance_rows(np.arange(len(names)))
    count: Counter[str] = Counter()
    for i, j, length, sigma in zip(bars.start, bars.end, bars.length, bars.sigma, strict=True):
        if not (sigma > 0 and row[i] >= 0 and row[j] >= 0):
            continue
        key = f"bar {' - '.join(sorted((names[i], names[j])))}"
        count[key] += 1
        u = (x[j] - x[i]) / np.linalg.norm(x[j] - x[i])
        gradient = [(3 * int(row[i]) + k, -float(u[k])) for k in range(3)]
        gradient += [(3 * int(row[j]) + k, float(u[k])) for k in range(3)]
        again = f" ({count[key]})" if count[key] > 1 else ""
        yield key + again, (gradient, float(sigma), float(length))
    control = epoch.control
    for j, given, C in zip(control.point, control.xyz, control.covariance, strict=True):
        for k in range(3):
            if 0 < C[k, k] < np.inf and row[j] >= 0:
                key = f"{'XYZ'[k]} of control point {names[j]}"
                yield key, ([(3 * int(row[j]) + k, 1.0)], float(np.sqrt(C[k, k])), float(given[k]))
