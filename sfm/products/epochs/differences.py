"""Differences between two epochs in one frame, of points and of mounts, with their covariance.

Points are recognised by their codes and other names. Points with only a number are recognised by their
position after a robust alignment. If both epochs use the same given values, they are correlated, for example
because a wrong length of a bar causes the same error in both. Then Q_d = Q_1 + Q_2 - C - C'. With an
observation l of standard deviation s and gradient g, a unit of l shifts an epoch by Q g / s^2, so that

    C = (Q_1 g_1) (Q_2 g_2)' / (s^2 s01 s02),

with sigma0 of both epochs, which their covariances contain. The sum is over the bars and the coordinates of
control that both share.

The change of the mounts of a rig is tested by T = d' (Q_1 + Q_2)^-1 d over its degrees of freedom. If both
epochs use the same given values, such as a scale bar, the true variance of d is smaller than Q_1 + Q_2. The
test is then conservative: it finds fewer changes.

Source: Niemeier (2008), Ausgleichungsrechnung, sec. 12.2; Koch (1999), Parameter Estimation and Hypothesis
Testing in Linear Models, sec. 3.2.3 (covariance of estimates and observations).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from sfm.comparison.congruency import MOTIONS, motions
from sfm.comparison.pairing import (
    PointPairs,
    coordinates_of,
    fit_robustly,
    held_points,
    pair_results,
    pairs_of_results,
)
from sfm.comparison.significance import known_scale
from sfm.comparison.stable_points import critical_value
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray, IntArray, angles_from_rotation
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.network import ObjectPoints, ScaleBars
from sfm.model.solution import Solution

MAX_SAME_DIFFERENCE = 1e-9  # relative difference up to which two given values are the same


@dataclass(frozen=True)
class Differences:
    """Second minus first coordinates of the common points, in the frame of the first epoch."""

    names: tuple[str, str]  # of the epochs
    unit: str
    points: tuple[str, ...]  # names in the first epoch, (n,)
    pairs: PointPairs  # the points of both epochs, each in its frame
    xyz: FloatArray  # coordinates in the first epoch, object unit, (n, 3)
    difference: FloatArray  # object unit, (n, 3)
    covariance: FloatArray  # of the differences, object unit^2, (3 n, 3 n)
    motion: str  # motion that is not a change: rigid, or similarity unless both have a scale
    redundancy: int | None  # of both adjustments together
    only_first: tuple[str, ...]  # points that the second epoch does not have
    only_second: tuple[str, ...]  # points that the first epoch does not have
    by_place: int  # number of points recognised by their position
    untested: tuple[str, ...]  # common points that an epoch holds fixed, or whose covariance is not stored
    shared: tuple[str, ...]  # text on given values that both epochs share
    held_alike: tuple[str, ...] = ()  # cameras with the same values held in both epochs
    held_apart: tuple[str, ...] = ()  # cameras with values held in only one epoch, or at different values

    @property
    def motions(self) -> FloatArray:
        """G: motions of the whole that are not a change, (3 n, u)."""
        return motions(self.xyz)[:, : MOTIONS[self.motion]]


@checked_arguments()
def epoch_differences(first: Epoch, second: Epoch) -> Differences:
    """Transform the second epoch into the frame of the first, and return the differences.

    Args:
        first: an epoch.
        second: a later epoch.

    Raises:
        GeometryError: an epoch without the covariance of its points, two epochs with the same image points,
            fewer than four common points, units that cannot be converted, or a weighted calibration that both
            share.
    """
    for epoch in (first, second):
        if epoch.result.redundancy == 0:
            raise GeometryError(f"{epoch.name}: redundancy 0, so its standard deviations mean nothing")
        if epoch.result.covariance is None:
            raise GeometryError(
                f"{epoch.name}: the covariance of all points together (point_covariance.npy) is missing; run "
                "the survey again with this version"
            )
    together = first.common is not None and second.common is not None
    _refuse_dependent(first, second, together=together)
    a, b = _with_prefixed_photographs(first.result, "a"), _with_prefixed_photographs(second.result, "b")
    pairing = pair_results(a, b)
    pa, pb = pairing.points.T
    rows_a, rows_b = a.covariance_rows(pa), b.covariance_rows(pb)
    kept = (rows_a >= 0) & (rows_b >= 0)
    for epoch, rows in ((first, rows_a), (second, rows_b)):
        assert epoch.result.covariance is not None  # refused before
        variance = np.diagonal(epoch.result.covariance).reshape(-1, 3)
        if epoch.result.datum == "control":
            kept[kept] = ~held_points(variance[rows[kept]])
    untested = tuple(a.network.points[j] for j in pa[~kept])
    pairs = pairing.points[kept]
    others = _others(a, pa), _others(b, pb)
    pa, pb = pairs.T
    if len(pa) < 4:
        of_these = f" that are not fixed and have a covariance, here {len(pa)}" if untested else ""
        raise GeometryError(
            f"{first.name} and {second.name} have {counted(len(kept), 'point')} in common, a "
            f"test needs 4 or more{of_these}"
        )
    scale = known_scale(a, b)
    if scale is None and a.has_scale and b.has_scale:
        raise GeometryError(
            f"{first.name} is in {a.unit} and {second.name} in {b.unit}: give both the same unit"
        )
    moved = fit_robustly(b.estimate.points[pb], a.estimate.points[pa], scale=scale)
    C, shared = (_correlation_of_joint if together else _correlation_of_shared)(first, second, pairs)
    points = replace(pairs_of_results(a, b, pairs, scale)[0], C=C)
    difference, Q = points.differences(moved)
    ours, theirs = _held_values(a), _held_values(b)
    held = tuple(dict.fromkeys((*ours, *theirs)))  # cameras with nonzero values held in an epoch
    held_alike = tuple(name for name in held if ours.get(name) == theirs.get(name))
    held_apart = tuple(name for name in held if name not in held_alike)
    return Differences(
        names=(first.name, second.name),
        unit=a.unit,
        points=points.names,
        pairs=points,
        xyz=points.a,
        difference=difference,
        covariance=Q,
        motion="similarity" if scale is None else "rigid",
        redundancy=points.redundancy,
        only_first=others[0],
        only_second=others[1],
        by_place=pairing.points_by_place,
        untested=untested,
        shared=shared,
        held_alike=held_alike,
        held_apart=held_apart,
    )


def _with_prefixed_photographs(result: Solution, prefix: str) -> Solution:
    """Return a result with prefixed names of photographs, which differ from those of another epoch."""
    names = tuple(f"{prefix}/{name}" for name in result.network.images)
    return replace(result, network=replace(result.network, images=names))


def _others(result: Solution, paired: IntArray) -> tuple[str, ...]:
    left = np.ones(len(result.network.points), dtype=bool)
    left[paired] = False
    left &= result.estimate.determined
    return tuple(result.network.points[j] for j in np.flatnonzero(left))


def _held_values(result: Solution) -> dict[str, tuple[tuple[str, float], ...]]:
    held_values: dict[str, tuple[tuple[str, float], ...]] = {}
    mounts = result.estimate.mounts
    for a, camera in enumerate(result.estimate.cameras):
        held = ~camera.free & (camera.parameters != 0)
        values = [(camera.names[k], float(camera.parameters[k])) for k in np.flatnonzero(held)]
        if mounts is not None and not mounts.free[a].any():
            values += zip("XYZ", mounts.position[a].tolist(), strict=True) if mounts.position[a].any() else ()
        if values:
            held_values[camera.name] = tuple(values)
    return held_values


def _refuse_dependent(first: Epoch, second: Epoch, *, together: bool) -> None:
    """Refuse the same survey under two names, and a shared calibration unless adjusted together."""
    a, b = (epoch.result.network.image_points.xy for epoch in (first, second))
    if len(a) and a.shape == b.shape and np.array_equal(a, b):
        raise GeometryError(
            f"{first.name} and {second.name} have the same image points: they are one epoch, not two"
        )
    if together:
        return
    theirs = {(camera, parameter): value for camera, parameter, value, _ in second.interior}
    for camera, parameter, value, _ in first.interior:
        other = theirs.get((camera, parameter))
        if other is not None and abs(other - value) <= MAX_SAME_DIFFERENCE * abs(value):
            raise GeometryError(
                f"{first.name} and {second.name} share the weighted {parameter} of camera {camera}, whose "
                "error is in both: adjust the epochs together (--together), or let each epoch "
                "determine it (free)"
            )


def _correlation_of_joint(
    first: Epoch, second: Epoch, pairs: IntArray
) -> tuple[FloatArray | None, tuple[str, ...]]:
    """Return C of two epochs that were adjusted together, and a text on each shared given value."""
    assert first.common is not None and second.common is not None
    a, b = first.common, second.common
    given = np.flatnonzero(
        a.columns[:, : len(a.given)].any(axis=0) & b.columns[:, : len(b.given)].any(axis=0)
    )
    words = tuple(a.given[k].partition(" = ")[0] for k in given)
    return _covariance(first, second, a.columns * a.signs, b.columns, pairs), words


def _correlation_of_shared(
    first: Epoch, second: Epoch, pairs: IntArray
) -> tuple[FloatArray | None, tuple[str, ...]]:
    """Return C of two epochs with the same given values, and a text on each of these."""
    mine: list[FloatArray] = []
    yours: list[FloatArray] = []
    words: list[str] = []
    theirs = dict(given_observations(second))
    for key, (ours, sigma, value) in given_observations(first):
        if key not in theirs:
            continue
        other, other_sigma, other_value = theirs[key]
        if abs(other_value - value) > MAX_SAME_DIFFERENCE * max(abs(value), 1.0):
            continue
        for epoch, gradient, s, columns in ((first, ours, sigma, mine), (second, other, other_sigma, yours)):
            Q = epoch.result.covariance
            assert Q is not None and epoch.sigma0 is not None  # refused before; see `Epoch`
            columns.append(
                sum((Q[:, k] * g for k, g in gradient), start=np.zeros(len(Q))) / (s * epoch.sigma0)
            )
        words.append(key)
    if not words:
        return None, ()
    return _covariance(first, second, np.stack(mine, axis=1), np.stack(yours, axis=1), pairs), tuple(words)


def _covariance(first: Epoch, second: Epoch, a: FloatArray, b: FloatArray, pairs: IntArray) -> FloatArray:
    """Return a b' for the common points, each epoch in its frame, (3 n, 3 n)."""
    rows_a, rows_b = (
        coordinates_of(epoch.result.covariance_rows(p))
        for epoch, p in zip((first, second), pairs.T, strict=True)
    )
    return np.asarray(a[rows_a] @ b[rows_b].T)


@dataclass(frozen=True)
class MountChange:
    """Change of the mount of a camera between two epochs."""

    camera: str
    # second minus first: X, Y, Z (object unit of the first; NaN unless both epochs have a scale), omega, phi,
    # kappa (rad), (6,)
    difference: FloatArray
    sigma: FloatArray  # (6,)
    statistic: float  # T
    critical: float

    @property
    def changed(self) -> bool:
        """Whether the camera moved on its rig."""
        return self.statistic > self.critical


def mount_changes(
    first: Solution, second: Solution, *, alpha: float, redundancy: int | None
) -> tuple[MountChange, ...]:
    """Test the changes of adjusted mounts between two epochs, with one level for all mounts together.

    Args:
        first: an epoch.
        second: a later epoch.
        alpha: level of the tests of all mounts together.
        redundancy: redundancy of both epochs; None if their variances are known.
    """
    scale = known_scale(first, second)
    ours, theirs = _mounts(first, 1.0), _mounts(second, scale or 1.0)
    common = [name for name in ours if name in theirs]
    tested = np.arange(6) if scale is not None else np.arange(3, 6)
    changes = []
    for name in common:
        (a, Q_a), (b, Q_b) = ours[name], theirs[name]
        d, Q = b - a, Q_a + Q_b
        d[3:] = (d[3:] + np.pi) % (2 * np.pi) - np.pi
        sigma = np.sqrt(np.diagonal(Q))
        if scale is None:
            d[:3] = sigma[:3] = np.nan
        part = Q[np.ix_(tested, tested)]
        statistic = float(d[tested] @ np.linalg.solve(part, d[tested])) / len(tested)
        critical = critical_value(alpha / len(common), len(tested), redundancy)
        changes.append(MountChange(name, d, sigma, statistic, critical))
    return tuple(changes)


def _mounts(result: Solution, scale: float) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return values and covariance of the adjusted mounts of a result, by camera."""
    mounts, Q = result.estimate.mounts, result.mount_covariance
    if mounts is None or Q is None:
        return {}
    unit = np.repeat([scale, 1.0], 3)
    values = unit * np.hstack([mounts.position, angles_from_rotation(mounts.rotation)])
    Q = unit[:, None] * Q * unit
    on = mounts.free.any(axis=1) & np.isfinite(Q).all(axis=(1, 2))
    on &= (np.diagonal(Q, axis1=1, axis2=2) > 0).all(axis=1)
    return {result.estimate.cameras[a].name: (values[a], Q[a]) for a in np.flatnonzero(on)}


@dataclass(frozen=True)
class Common:
    """Correlation of an epoch with epochs adjusted together with it: C_12 = U_1 diag(signs) U_2'."""

    given: tuple[str, ...]  # given values that several epochs share, (g,)
    columns: FloatArray  # U, with the columns of the given values first, object unit, (3 k, q)
    signs: FloatArray  # (q,)


@dataclass(frozen=True)
class Epoch:
    """One epoch: a result with its given values and sigma0, which are those of its solution if not given.

    Example:
        >>> from sfm.products.epochs import Epoch
        >>> Epoch("spring", result.solution).result.covariance is not None
        True
    """

    name: str
    result: Solution
    bars: ScaleBars = field(default_factory=ScaleBars)  # that took part, by index of the result's points
    control: ObjectPoints = field(default_factory=ObjectPoints)  # that took part, as observed
    interior: tuple[tuple[str, str, float, float], ...] = ()  # (camera, parameter, observed value, sigma)
    sigma0: float | None = None  # sigma0 that scales the covariance of the result
    sigma0_px: float | None = None  # median a posteriori sigma of an image coordinate; None if unknown
    common: Common | None = None  # correlation with the epochs adjusted together with it, if any

    def __post_init__(self) -> None:
        """Take the joint covariance and the given values of an adjustment from its solution."""
        result = self.result.solution.with_joint_covariance
        given = result.network
        object.__setattr__(self, "result", result)
        if self.sigma0 is None:
            object.__setattr__(self, "sigma0", result.sigma0)
        if not len(self.bars):
            object.__setattr__(self, "bars", given.scale_bars)
        if not len(self.control) and result.datum == "control":
            object.__setattr__(self, "control", given.control)
        if not self.interior and len(given.interior):
            seen, cameras = given.interior, result.estimate.cameras
            interior = tuple(
                (cameras[a].owner_of(s), cameras[a].names[s], float(value), float(sigma))
                for a, s, value, sigma in zip(
                    seen.camera, seen.parameter, seen.value, seen.sigma, strict=True
                )
            )
            object.__setattr__(self, "interior", interior)


Observed = tuple[list[tuple[int, float]], float, float]  # gradient by column, standard deviation, value


def given_observations(epoch: Epoch) -> Iterator[tuple[str, Observed]]:
    """Yield the observed scale bars and coordinates of control of an epoch, with their names.

    Args:
        epoch: has its covariance; the columns of the gradients count its rows.
    """
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
