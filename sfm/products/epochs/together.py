"""Joint adjustment of all epochs, if one camera took their photographs.

Every epoch is first adjusted by itself from its image points. The conditions that the interior orientation is
the same in all epochs, B x = 0, then turn this into one adjustment. With the covariance Q of all epochs,

    M = B Q B',  x' = x - Q B' M^-1 B x,  Q' = Q - Q B' M^-1 B Q,

to first order in the corrections, which are of the size of standard deviations. A given value that epochs
share (bars, control, a calibration) is a single observation, and correlates them beforehand. T = (B x)' M^-1
B x over the number of conditions tests whether the camera is the same.

Source: Koch (1999), Parameter Estimation and Hypothesis Testing in Linear Models, secs. 3.2.7 (constraints)
and 4.2 (their test); Niemeier (2008), Ausgleichungsrechnung, sec. 12.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.comparison.stable_points import critical_value
from sfm.model.arguments import checked_arguments
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.display import listed
from sfm.model.distributions import FAMILY
from sfm.model.errors import GeometryError
from sfm.model.network import InteriorObservations, Network
from sfm.products.epochs.differences import MAX_SAME_DIFFERENCE, Common, Epoch, given_observations

MAX_NAMED = 4  # cameras that an error message lists
# Largest difference between the stored result and an adjustment from its tables: of coordinates in standard
# deviations, and of the standard deviations relatively.
SAME_SIGMA = 0.05


@dataclass(frozen=True)
class SharedCamera:
    """A camera with one interior orientation in several epochs."""

    name: str
    epochs: tuple[str, ...]
    parameters: tuple[str, ...]
    statistic: float  # T
    critical: float

    @property
    def same(self) -> bool:
        """Whether the epochs agree on the camera."""
        return self.statistic <= self.critical


@dataclass(frozen=True)
class _Alone:
    """An epoch adjusted by itself."""

    epoch: Epoch
    points: IntArray  # of the covariance, (k,)
    values: FloatArray  # of the parameters of shared cameras, (p,)
    names: tuple[tuple[str, str], ...]  # (camera, parameter) of each value
    covariance: FloatArray  # of these values, then of X Y Z of the points, (p + 3 k, p + 3 k)
    given: dict[
        str, tuple[FloatArray, float]
    ]  # Q g / (s sigma0) of each given value, (p + 3 k,), and the value


@checked_arguments()
def adjust_together(epochs: Sequence[Epoch]) -> tuple[tuple[Epoch, ...], tuple[SharedCamera, ...]]:
    """Adjust epochs together, with one interior orientation of each camera that several epochs share.

    Args:
        epochs: two or more epochs, with their image points and given values.

    Returns:
        The epochs with adjusted coordinates, covariances and correlations; and the shared cameras.

    Raises:
        GeometryError: no camera of one name in two epochs, a camera with different settings, a camera that
            changed between the epochs, or a result that its tables do not reproduce.

    Source: Koch (1999), secs. 3.2.7 and 4.2.
    """
    shared = _shared_cameras(epochs)
    alone = [_adjust_alone(epoch, shared) for epoch in epochs]
    keys, given = _shared_values(alone)
    conditions, owner = _conditions(alone, shared)
    q = len(owner)
    sizes = [len(single.values) for single in alone]
    M, w = np.zeros((q, q)), np.zeros(q)
    left = []
    for single, B, A, p in zip(alone, conditions, given, sizes, strict=True):
        others = sum(
            (A_j[:p_j].T @ B_j.T for B_j, A_j, p_j in zip(conditions, given, sizes, strict=True)),
            start=np.zeros((len(keys), q)),
        )
        U = single.covariance[:, :p] @ B.T + A @ (others - A[:p].T @ B.T)
        left.append(U)
        M += B @ U[:p]
        w += B @ single.values
    scale = 1 / np.sqrt(np.diagonal(M))
    M, w = M * np.outer(scale, scale), w * scale
    factor = cho_factor(M, lower=True)
    cameras = tuple(
        _tested(name, [epochs[k].name for k in numbers], alone, owner, M, w)
        for name, numbers in shared.items()
    )
    for camera in cameras:
        if not camera.same:
            raise GeometryError(_describe_change(camera, alone))
    out = []
    correction = cho_solve(factor, w)
    for single, U, A, p in zip(alone, left, given, sizes, strict=True):
        U = U[p:] * scale
        V = solve_triangular(factor[0], U.T, lower=True).T
        result = single.epoch.result
        points = np.array(result.estimate.points)
        points[single.points] -= (U @ correction).reshape(-1, 3)
        Q = single.covariance[p:, p:] - V @ V.T
        every = len(single.points) == len(points)
        result = replace(
            result,
            estimate=replace(result.estimate, points=points),
            covariance=Q,
            covariance_points=None if every else single.points,
        )
        signs = np.concatenate([np.ones(len(keys)), -np.ones(q)])
        out.append(replace(single.epoch, result=result, common=Common(keys, np.hstack([A[p:], V]), signs)))
    return tuple(out), cameras


def _shared_cameras(epochs: Sequence[Epoch]) -> dict[str, list[int]]:
    """Return the cameras that several epochs share by name, with the indices of these epochs."""
    epochs_of: dict[str, list[int]] = {}
    for k, epoch in enumerate(epochs):
        for camera in epoch.result.estimate.cameras:
            epochs_of.setdefault(camera.name, []).append(k)
    shared = {name: numbers for name, numbers in epochs_of.items() if len(numbers) > 1}
    if not shared:
        raise GeometryError(
            f"epochs together: no camera is in two of them ({listed(epochs_of, most=MAX_NAMED)}); a camera "
            "that took several epochs needs one name in their survey files, and no parameters per photograph"
        )
    kept = {}
    for name, numbers in shared.items():
        cameras = [
            next(camera for camera in epochs[k].result.estimate.cameras if camera.name == name)
            for k in numbers
        ]
        first = cameras[0]
        for k, other in zip(numbers[1:], cameras[1:], strict=True):
            alike = other.model == first.model and other.size_px == first.size_px
            if not alike or (other.free != first.free).any():
                raise GeometryError(
                    f"epochs together: camera {name} has another model, size or other free parameters in "
                    f"{epochs[k].name} than in {epochs[numbers[0]].name}"
                )
        if first.free.any():
            kept[name] = numbers
    if not kept:
        raise GeometryError(
            "epochs together: every shared camera is held, the epochs have nothing to adjust together"
        )
    return kept


def _adjust_alone(epoch: Epoch, shared: dict[str, list[int]]) -> _Alone:
    """Adjust an epoch from its image points as its survey did; refuse it if the result differs."""
    result = epoch.result
    network = _network_of(epoch)
    control = result.datum == "control"
    a = adjust(
        network, result.estimate, datum="control" if control else "free", reject="none", covariance=True
    )
    m = marginal_of(a)
    names = m.names()
    place = {name: k for k, name in enumerate(names)}
    wanted = [
        (camera.name, parameter)
        for camera in result.estimate.cameras
        if camera.name in shared
        for parameter, free in zip(camera.names, camera.free, strict=True)
        if free
    ]
    unknowns = np.array([place[parameter, f"camera {camera}"] for camera, parameter in wanted], np.int64)
    points = result.covariance_points
    points = np.arange(len(network.points)) if points is None else points
    joint = m.joint(unknowns, points)
    _refuse_another(epoch, a, joint[len(wanted) :, len(wanted) :], points)
    values = {
        (camera.name, parameter): value
        for camera in a.estimate.cameras
        for parameter, value in zip(camera.names, camera.parameters.tolist(), strict=True)
    }
    alone = replace(
        epoch, result=replace(result, estimate=a.estimate, covariance_points=points), sigma0=a.sigma0
    )
    given = {}
    for key, (gradient, sigma, value) in given_observations(alone):
        column = sum((joint[:, len(wanted) + k] * g for k, g in gradient), start=np.zeros(len(joint)))
        given[key] = (column / (sigma * a.sigma0), value)
    for camera, parameter, value, sigma in epoch.interior:
        if (camera, parameter) in wanted:
            column = joint[:, wanted.index((camera, parameter))]
            given[f"{parameter} of camera {camera}"] = (column / (sigma * a.sigma0), value)
    adjusted = np.array([values[key] for key in wanted])
    return _Alone(alone, points, adjusted, tuple(wanted), joint, given)


def _network_of(epoch: Epoch) -> Network:
    """Return the network with the given values and the weights of the survey."""
    result = epoch.result
    seen = result.network.image_points
    if epoch.sigma0_px is None:
        raise GeometryError(f"{epoch.name}: its summary.json has no sigma0_px, which its weights come from")
    median = float(np.sqrt(np.median(np.trace(seen.covariance, axis1=1, axis2=2)) / 2))
    assert epoch.sigma0 is not None  # see `Epoch`
    factor = epoch.sigma0_px / (epoch.sigma0 * median)
    index = {camera.name: k for k, camera in enumerate(result.estimate.cameras)}
    rows = [
        (index[camera], result.estimate.cameras[index[camera]].names.index(parameter), value, sigma)
        for camera, parameter, value, sigma in epoch.interior
        if camera in index and parameter in result.estimate.cameras[index[camera]].names
    ]
    table = np.array(rows, dtype=float).reshape(-1, 4)
    return replace(
        result.network, image_points=replace(seen, covariance=seen.covariance * factor**2, stated=None)
    ).with_given(
        epoch.control,
        InteriorObservations(
            table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2], table[:, 3]
        ),
        epoch.bars,
    )


def _refuse_another(epoch: Epoch, a: Adjustment, Q: FloatArray, points: IntArray) -> None:
    """Refuse an adjustment that does not reproduce the stored result, whose tables are then incomplete."""
    stored = epoch.result
    sigma = np.sqrt(np.diagonal(Q).reshape(-1, 3).sum(axis=1))
    moved = np.linalg.norm(a.estimate.points[points] - stored.estimate.points[points], axis=1)
    off = float(np.median(moved / sigma))
    if a.datum == stored.datum and stored.covariance is not None:
        before = np.sqrt(np.diagonal(stored.covariance).reshape(-1, 3).sum(axis=1))
        off = max(off, float(np.abs(np.median(sigma / before) - 1)))
    if not (a.converged and off < SAME_SIGMA):
        raise GeometryError(
            f"{epoch.name}: adjusting its image points again leads {off:.2g} standard deviations away from "
            "its result: it used input that its tables do not keep (weights by robust estimation or of "
            "single photographs, correlated calibrations, exterior orientation, survey observations, "
            "mounts), and cannot be adjusted together"
        )


def _shared_values(alone: Sequence[_Alone]) -> tuple[tuple[str, ...], list[FloatArray]]:
    """Return the given values that two or more epochs share, and their columns in each, (p + 3 k, g).

    The column of a value that an epoch does not have is zero.
    """
    keys: dict[str, None] = {}
    for k, single in enumerate(alone):
        for key, (_, value) in single.given.items():
            earlier = [other.given[key][1] for other in alone[:k] if key in other.given]
            if any(abs(a - value) <= MAX_SAME_DIFFERENCE * max(abs(a), 1.0) for a in earlier):
                keys[f"{key} = {value:.12g}"] = None
    shared = []
    for single in alone:
        columns = {f"{key} = {value:.12g}": column for key, (column, value) in single.given.items()}
        nothing = np.zeros(len(single.covariance))
        A = [columns.get(key, nothing) for key in keys]
        shared.append(np.stack(A, axis=1) if A else np.zeros((len(nothing), 0)))
    return tuple(keys), shared


def _conditions(
    alone: Sequence[_Alone], shared: dict[str, list[int]]
) -> tuple[list[FloatArray], list[tuple[str, int, str]]]:
    """Return B of each epoch, (q, p), and (camera, later epoch, parameter) of each condition."""
    rows: list[tuple[str, int, str]] = [
        (name, later, parameter)
        for name, (first, *others) in shared.items()
        for later in others
        for camera, parameter in alone[first].names
        if camera == name
    ]
    B = [np.zeros((len(rows), len(single.names))) for single in alone]
    for r, (name, later, parameter) in enumerate(rows):
        for k, sign in ((shared[name][0], -1.0), (later, 1.0)):
            B[k][r, alone[k].names.index((name, parameter))] = sign
    return B, rows


def _tested(
    name: str,
    epochs: list[str],
    alone: Sequence[_Alone],
    owner: list[tuple[str, int, str]],
    M: FloatArray,
    w: FloatArray,
) -> SharedCamera:
    rows = np.array([r for r, (camera, _, _) in enumerate(owner) if camera == name])
    statistic = float(w[rows] @ np.linalg.solve(M[np.ix_(rows, rows)], w[rows])) / len(rows)
    known = [single.epoch.result.redundancy for single in alone]
    redundancy = None if None in known else sum(r for r in known if r is not None)
    parameters = tuple(dict.fromkeys(owner[r][2] for r in rows))
    return SharedCamera(
        name, tuple(epochs), parameters, statistic, critical_value(FAMILY, len(rows), redundancy)
    )


def _describe_change(camera: SharedCamera, alone: Sequence[_Alone]) -> str:
    """Describe a camera that changed, with the parameter that changed most."""
    first, worst, which, where = None, 0.0, "", ""
    for single in alone:
        if single.epoch.name not in camera.epochs:
            continue
        if first is None:
            first = single
            continue
        for parameter in camera.parameters:
            i, j = (part.names.index((camera.name, parameter)) for part in (first, single))
            sigma = np.sqrt(first.covariance[i, i] + single.covariance[j, j])
            off = abs(float(single.values[j] - first.values[i])) / float(sigma)
            if off > worst:
                worst, which, where = off, parameter, f"{first.epoch.name} and {single.epoch.name}"
    return (
        f"epochs together: camera {camera.name} is not the same: T {camera.statistic:.3g}, limit "
        f"{camera.critical:.3g}; {which} of {where} differs by {worst:.1f} standard deviations. Analyse the "
        "epochs without --together, each with a separate interior orientation"
    )
