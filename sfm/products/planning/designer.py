"""Design of a network for a wanted precision: candidate stations, their gains, and the choice among them.

The choice uses the limiting covariance of points, in which the orientations are held (`gains`). It ignores
orientation, self-calibration and datum. Their share in the variance of each point is taken from the full
covariance of the network so far. The figures of a design always come from the full covariance.

The gain of a candidate is the improvement of the points that it shows, with the orientations of all
photographs held. Each image point adds A'PA to the 3 x 3 normal matrix of its point. The gain of every
candidate therefore follows from updates of rank 2, without solving a system of equations (limiting error
propagation):

    Q' = Q - Q A' (P^-1 + A Q A')^-1 A Q

Source: Fraser (1984) (zero- to first-order design); Fedorov (1972), Theory of Optimal Experiments (greedy
choice and exchange); Olague and Mohr (2002), Pattern Recognition 35(4) (placing cameras); van der Corput,
Halton (1960), Numer. Math. 2 (evenly spread positions); Fraser (1987), Photogramm. Eng. Remote Sens. 53(5)
(limiting error propagation); Foerstner and Wrobel (2016), sec. 4.2.7 (recursive estimation).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera, pixel_jacobian
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.network import Network
from sfm.products.planning.planned_object import PlannedObject, farthest_points
from sfm.products.planning.prediction import (
    MIN_RAYS,
    Prediction,
    ScaleBarPlan,
    WantedPrecision,
    predict_network,
    short_of,
)
from sfm.products.planning.stations import Stations, aim_camera, filling_distance, roll_rotations
from sfm.products.planning.visibility import Seeing, Sight, sight_of
from sfm.products.planning.weakness import reason_of
from sfm.runtime.compiling import compiled
from sfm.runtime.progress import report_step

POWER = 4  # of the variances in the cost: a smooth maximum, which also breaks ties
COUNT = 300  # stations that the designer chooses from, each upright and rolled
DISTANCES = (0.75, 1.25)  # default distances, over the distance at which the object fills the photograph
AIMS = 8  # parts of the object that a station may look at, besides its middle
TRIES = 60  # positions tried for each wanted station before a lack of room is reported
MIN_POINTS = 4  # points that a candidate must show
BASES = (2, 3, 5)  # of the Halton sequence
MIN_PHOTOGRAPHS = 4  # photographs of a network in which gross errors can be found
MAX_PHOTOGRAPHS = 100
SWEEPS = 3  # largest number of exchanges of all stations
MIN_DECREASE = 1e-3  # relative decrease of the cost that justifies an exchange
MAX_RATIO = 25.0  # largest accepted ratio of the full to the limiting variance of a point
NO_BETTER = 0.98  # of the shortfall: additions that leave more than this are no gain
ROUNDS = 6  # largest number of rounds of additions and exchanges
PATIENCE = 6  # consecutive photographs without gain before the limit is reported


@dataclass(frozen=True)
class Design:
    """The chosen stations and their predicted precision."""

    prediction: Prediction  # with the full covariance of the network
    shortfall: float  # largest ratio of predicted to wanted values; reached at 1 or below
    reached: bool
    limit: str  # text on the limitation; empty if the requirements are reached
    photographs_tried: int  # number of candidates, upright and rolled


@checked_arguments()
def design_network(
    planned: PlannedObject,
    camera: Camera,
    allowed: StationLimits,
    seeing: Seeing,
    wanted: WantedPrecision,
    *,
    count: int = COUNT,
    bars: Sequence[ScaleBarPlan] = (),
    given: Callable[[Network], Network] | None = None,
) -> Design:
    """Return few stations that meet the requirements.

    Args:
        planned: the object.
        camera: interior orientation and its free parameters.
        allowed: limits of the stations, and of their number.
        seeing: limits and precision of image points.
        wanted: requirements on the network.
        count: number of candidate stations, each upright and rolled.
        bars: scale bars.
        given: as in `predict_network`.

    Raises:
        GeometryError: no room for stations, or nothing can be determined from them.

    Source: Fedorov (1972), Theory of Optimal Experiments; Fraser (1984).
    """
    if allowed.photographs < MIN_PHOTOGRAPHS:
        raise GeometryError(
            f"plan: at most {counted(allowed.photographs, 'photograph')}, needed {MIN_PHOTOGRAPHS} or more"
        )
    room = candidates(planned, camera, allowed, seeing, count=count)
    return _Designer(planned, camera, seeing, wanted, room, allowed.photographs, bars, given).run()


@dataclass
class _Designer:
    """State of the design that its steps share."""

    planned: PlannedObject
    camera: Camera
    seeing: Seeing
    wanted: WantedPrecision
    room: Candidates  # stations to choose from
    most: int  # photographs
    bars: Sequence[ScaleBarPlan]
    given: Callable[[Network], Network] | None  # as in `predict_network`

    def __post_init__(self) -> None:
        self.rows = image_rows(self.planned, self.camera, self.room.stations, self.room.sight)
        self.single = np.einsum("mnai,mnaj->mnij", self.rows, self.rows)
        self.prior = np.eye(3) / self.planned.size**2  # weight of a point that no photograph shows yet
        self.seeable = self.room.sight.seen.sum(axis=0) >= 2 * MIN_RAYS  # upright and rolled
        self.scale = np.where(self.seeable, 1 / self.wanted.point_variance(self.planned), 0.0)
        self.ratio = np.ones(len(self.planned.names))

    def run(self) -> Design:
        chosen: list[int] = []
        while len(chosen) < min(MIN_PHOTOGRAPHS, self.most):
            chosen.append(self._next(chosen))
        short = self._predict_fully(chosen)[1]
        for _ in range(ROUNDS):
            before, idle = short, 0
            while short > 1 and len(chosen) < self.most and idle < PATIENCE:
                chosen.append(self._next(chosen))
                new = self._predict_fully(chosen)[1]
                idle = idle + 1 if new > NO_BETTER * short else 0
                short = min(short, new)
            chosen, prediction, short = self._exchange(chosen)
            if short <= 1 or len(chosen) >= self.most or short > NO_BETTER * before:
                break
        if short <= 1:
            chosen, prediction, short = self._remove_unneeded(chosen, prediction, short)
        limit = ""
        if not short <= 1:
            j = int(np.argmax(np.where(self.seeable, prediction.sigma, -1.0)))
            worst = f"{self.planned.names[j]} ({reason_of(prediction, j)})"
            limit = (
                f"where one may stand: {PATIENCE} more photographs gain less than {1 - NO_BETTER:.0%} each; "
                f"the worst point is {worst}"
            )
            if len(chosen) >= self.most:
                limit = f"the {self.most} photographs that are allowed; the worst is {worst}"
        return Design(prediction, short, bool(short <= 1), limit, len(self.room.stations))

    def _cofactors(self, chosen: Sequence[int]) -> FloatArray:
        """Return the covariance of each point with the chosen photographs, (n, 3, 3)."""
        return np.asarray(np.linalg.inv(self.prior + self.single[list(chosen)].sum(axis=0)))

    def _available(self, chosen: Sequence[int]) -> BoolArray:
        """Return the candidates that may be taken: each station once, either upright or rolled."""
        open_ = np.ones(len(self.room.stations), dtype=bool)
        taken = np.array(chosen, dtype=np.int64)
        half = self.room.count
        open_[taken] = False
        open_[(taken + half) % (2 * half)] = False
        # if the camera is calibrated, half of the photographs are rolled
        if self.camera.free.any() and len(chosen):
            turned = int((taken >= half).sum())
            if turned > len(chosen) - turned:
                open_[half:] = False
            elif turned < len(chosen) - turned:
                open_[:half] = False
        return open_

    def _next(self, chosen: Sequence[int]) -> int:
        gain = gains(self._cofactors(chosen), self.rows, self.scale * self.ratio, self._available(chosen))
        if not (gain > 0).any():
            raise GeometryError("plan: fewer stations show the object than a network needs")
        return int(np.argmax(gain))

    def _cost(self, chosen: Sequence[int]) -> float:
        return cost_of(np.trace(self._cofactors(chosen), axis1=1, axis2=2) / 3, self.scale * self.ratio)

    def _predict_fully(self, chosen: Sequence[int]) -> tuple[Prediction | None, float]:
        """Return the full prediction and its shortfall; update the ratios of full to limiting variances."""
        which = np.array(chosen, dtype=np.int64)
        report_step(f"predicting {counted(len(chosen), 'photograph')}")
        try:
            prediction = predict_network(
                self.planned,
                self.camera,
                self.room.stations.of(which).renamed(),
                self.seeing,
                bars=self.bars,
                given=self.given,
                sight=self.room.sight.of(which),
            )
        except GeometryError:  # too few photographs yet
            return None, float("inf")
        limiting = np.trace(self._cofactors(chosen), axis1=1, axis2=2) / 3
        ratio = np.where(prediction.determined, prediction.sigma**2 / limiting, MAX_RATIO)
        ratio[prediction.rays < MIN_RAYS] = MAX_RATIO
        self.ratio = np.clip(ratio, 1.0, MAX_RATIO)
        return prediction, short_of(prediction, self.wanted, self.seeable)

    def _exchange(self, chosen: list[int]) -> tuple[list[int], Prediction, float]:
        """Exchange stations for better ones as long as the full prediction improves."""
        prediction, short = self._predict_fully(chosen)
        for _ in range(SWEEPS):
            tried = list(chosen)
            cost = self._cost(tried)
            for k in range(len(tried)):
                rest = tried[:k] + tried[k + 1 :]
                new = [*rest, self._next(rest)]
                new_cost = self._cost(new)
                if new_cost < (1 - MIN_DECREASE) * cost:
                    tried, cost = [*tried[:k], new[-1], *tried[k + 1 :]], new_cost
            if tried == chosen:
                break
            other, other_short = self._predict_fully(tried)
            if other_short >= short:
                break
            chosen, prediction, short = tried, other, other_short
        if prediction is None:
            raise GeometryError(
                "plan: the allowed stations do not make a network: fewer than two of them share enough points"
            )
        return chosen, prediction, short

    def _remove_unneeded(
        self, chosen: list[int], prediction: Prediction, short: float
    ) -> tuple[list[int], Prediction, float]:
        """Remove photographs that the requirements do not need."""
        while len(chosen) > MIN_PHOTOGRAPHS:
            order = np.argsort([self._cost(chosen[:k] + chosen[k + 1 :]) for k in range(len(chosen))])
            for k in order[:3]:
                fewer = chosen[: int(k)] + chosen[int(k) + 1 :]
                new, new_short = self._predict_fully(fewer)
                if new_short > 1:
                    fewer, new, new_short = self._exchange(fewer)
                if new is not None and new_short <= 1:
                    chosen, prediction, short = fewer, new, new_short
                    break
            else:
                break
        return chosen, prediction, short


@dataclass(frozen=True)
class StationLimits:
    """Limits of the stations."""

    # least and largest distance to the nearest point of the object, object unit; None = it fills the
    # photographs
    distance: tuple[float, float] | None = None
    space: FloatArray | None = None  # least and largest X, Y, Z of a station, object unit, (2, 3)
    floor: float | None = None  # least Z of a station, object unit
    photographs: int = MAX_PHOTOGRAPHS  # largest number of them


@dataclass(frozen=True)
class Candidates:
    """Stations to choose from: upright ones, then the same ones rolled by 90 deg."""

    stations: Stations
    sight: Sight

    @property
    def count(self) -> int:
        """Number of different stations."""
        return len(self.stations) // 2


def candidates(
    planned: PlannedObject, camera: Camera, allowed: StationLimits, seeing: Seeing, *, count: int = COUNT
) -> Candidates:
    """Return candidate stations, spread evenly over the allowed room.

    From each position a camera looks at the middle of the object, or at the part where it shows most points.

    Args:
        planned: the object.
        camera: interior orientation.
        allowed: limits of the stations.
        seeing: limits of visibility.
        count: number of stations, each upright and rolled.

    Raises:
        GeometryError: no room, or too little is seen from the allowed positions.
    """
    least, most = _distances(planned, camera, allowed)
    low, high = _room(planned, allowed, most)
    aims = np.concatenate([planned.centre[None], planned.xyz[farthest_points(planned.xyz, AIMS)]])
    sees_all = float(np.linalg.norm(np.array(camera.size_px)) / camera.c_px)
    position, rotation, counted = [], [], 0
    tried = _halton(TRIES * count) * (high - low) + low
    inside = 0
    for place in tried:
        if counted == count:
            break
        away = planned.xyz - place
        nearest = np.linalg.norm(away, axis=1).min()
        if not least <= nearest <= most:
            continue
        inside += 1
        faced = (planned.normals * -away).sum(axis=1) > 0
        faced |= np.isnan(planned.normals[:, 0])
        if faced.sum() < MIN_POINTS:
            continue
        near = planned.size / nearest > sees_all  # the object does not fit in a photograph from this position
        aimed_at = np.concatenate([planned.xyz[faced].mean(axis=0)[None], aims]) if near else aims[:1]
        ways = np.array([aim_camera(aim - place) for aim in aimed_at])
        shown = sight_of(planned, camera, np.tile(place, (len(ways), 1)), ways, seeing).seen.sum(axis=1)
        best = int(np.argmax(shown))
        if shown[best] < MIN_POINTS:
            continue
        if near and counted % 2:  # half of the stations look elsewhere, for more overlaps of neighbours
            others = np.flatnonzero(shown >= max(MIN_POINTS, shown[best] / 2))
            best = int(others[counted // 2 % len(others)])
        position.append(place)
        rotation.append(ways[best])
        counted += 1
    if not inside:
        raise GeometryError(
            f"plan: no station is {least:g} to {most:g} from the object in the space that is allowed; needed "
            "another distance or space"
        )
    if counted < 2:
        raise GeometryError(
            f"plan: of {inside} places that are allowed fewer than 2 show {MIN_POINTS} points; the object "
            "faces away, or is too far, too oblique or not sharp from there"
        )
    places, ways = np.array(position), np.array(rotation)
    names = tuple(f"{k + 1}" for k in range(2 * counted))
    stations = Stations(names, np.tile(places, (2, 1)), np.concatenate([ways, roll_rotations(ways)]))
    return Candidates(stations, sight_of(planned, camera, stations.position, stations.rotation, seeing))


def _distances(planned: PlannedObject, camera: Camera, allowed: StationLimits) -> tuple[float, float]:
    """Return the least and the largest distance to the nearest point of the object."""
    if allowed.distance is not None:
        least, most = allowed.distance
        if not 0 < least < most:
            raise GeometryError(f"plan: distances {least:g} to {most:g}, needed 0 < least < most")
        return least, most
    ways = [aim_camera(np.array(way)) for way in ((1.0, 0, 0), (0, 1.0, 0), (0, 0, -1.0), (1.0, 1.0, -1.0))]
    fills = max(filling_distance(planned, camera, R) for R in ways)
    return DISTANCES[0] * fills - planned.size / 2 if fills > planned.size else 0.2 * fills, (
        DISTANCES[1] * fills
    )


def _room(planned: PlannedObject, allowed: StationLimits, most: float) -> tuple[FloatArray, FloatArray]:
    low, high = planned.xyz.min(axis=0) - most, planned.xyz.max(axis=0) + most
    if allowed.space is not None:
        if not (allowed.space[0] < allowed.space[1]).all():
            raise GeometryError("plan: the space to stand in has a side without length, needed X0 < X1")
        low, high = np.maximum(low, allowed.space[0]), np.minimum(high, allowed.space[1])
    if allowed.floor is not None:
        if not np.isfinite(allowed.floor):
            raise GeometryError(f"plan: floor at {allowed.floor:g}, expected a finite number")
        low[2] = max(low[2], allowed.floor)
    if not (low < high).all():
        raise GeometryError(
            f"plan: no room within {most:g} of the object inside the allowed space and above the floor; "
            "needed a space that reaches the object"
        )
    return low, high


def _halton(count: int) -> FloatArray:
    """Return evenly spread points of the unit cube, (count, 3)."""
    out = np.zeros((count, 3))
    for axis, base in enumerate(BASES):
        rest, share = np.arange(1, count + 1), 1.0
        while rest.any():
            share /= base
            out[:, axis] += share * (rest % base)
            rest //= base
    return out


def image_rows(planned: PlannedObject, camera: Camera, stations: Stations, sight: Sight) -> FloatArray:
    """Return A of every image point over its standard deviation, 0 if it is not seen, (m, n, 2, 3).

    Args:
        planned: the object.
        camera: interior orientation.
        stations: m stations.
        sight: visibility of n points in their photographs.
    """
    m, n = sight.visibility.shape
    rows = np.zeros((m, n, 2, 3))
    for i in range(m):
        used = np.flatnonzero(sight.seen[i])
        if not len(used):
            continue
        R = stations.rotation[i]
        U, V, W = ((planned.xyz[used] - stations.position[i]) @ R).T
        zero = np.zeros(len(used))
        of_tangents = np.stack(
            [np.stack([-1 / W, zero, U / W**2], axis=1), np.stack([zero, -1 / W, V / W**2], axis=1)], axis=1
        )
        A = pixel_jacobian(camera, sight.xy[i, used]) @ of_tangents @ R.T
        whitening = np.linalg.inv(np.linalg.cholesky(sight.covariance[i, used]))
        rows[i, used] = whitening @ A
    return rows


def cost_of(variance: FloatArray, scale: FloatArray) -> float:
    """Return the cost: the sum of the variances of points over the wanted ones, each to the POWER.

    Args:
        variance: variance of a coordinate of each point, object unit^2, (n,).
        scale: 1 over the wanted variance of each point, (n,).
    """
    return float(((variance * scale) ** POWER).sum())


def gains(Q: FloatArray, rows: FloatArray, scale: FloatArray, open_: BoolArray) -> FloatArray:
    """Return the reduction of the cost by each candidate, (m,); -1 for candidates that may not be taken.

    Args:
        Q: covariance of each point, object unit^2, (n, 3, 3).
        rows: result of `image_rows` for the candidates, (m, n, 2, 3).
        scale: 1 over the wanted variance of each point, (n,).
        open_: candidates that may be taken, (m,).
    """
    return np.asarray(_gains(Q, rows, scale, open_))


@compiled
def _gains(Q: FloatArray, rows: FloatArray, scale: FloatArray, open_: BoolArray) -> FloatArray:
    m, n = rows.shape[0], rows.shape[1]
    out = np.full(m, -1.0)
    QA = np.empty((3, 2))
    for c in range(m):
        if not open_[c]:
            continue
        total = 0.0
        for j in range(n):
            A = rows[c, j]
            if A[0, 0] == 0.0 and A[0, 1] == 0.0 and A[0, 2] == 0.0:
                continue
            for i in range(3):
                for a in range(2):
                    QA[i, a] = Q[j, i, 0] * A[a, 0] + Q[j, i, 1] * A[a, 1] + Q[j, i, 2] * A[a, 2]
            s00, s01, s11 = 1.0, 0.0, 1.0
            g00, g01, g11 = 0.0, 0.0, 0.0
            for i in range(3):
                s00 += A[0, i] * QA[i, 0]
                s01 += A[0, i] * QA[i, 1]
                s11 += A[1, i] * QA[i, 1]
                g00 += QA[i, 0] * QA[i, 0]
                g01 += QA[i, 0] * QA[i, 1]
                g11 += QA[i, 1] * QA[i, 1]
            drop = (s11 * g00 - 2.0 * s01 * g01 + s00 * g11) / (s00 * s11 - s01 * s01)
            before = scale[j] * (Q[j, 0, 0] + Q[j, 1, 1] + Q[j, 2, 2]) / 3.0
            after = max(before - scale[j] * drop / 3.0, 0.0)
            total += before**4 - after**4
        out[c] = total
    return out
