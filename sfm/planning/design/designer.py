"""A network designed for what is wanted: stations one by one, exchanged, and left out again where possible.

The choice goes by the limiting covariance of points, in which the orientations are held (`gain`); each
point's share of what that ignores - orientation, self-calibration, datum - is taken from the full covariance
of the network so far. Figures of the design always are of the full covariance.

Source: Fraser (1984) (zero- to first-order design); Fedorov (1972), Theory of Optimal Experiments (greedy
choice and exchange); Olague and Mohr (2002), Pattern Recognition 35(4) (placing cameras).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sfm.arguments import checked_arguments
from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.network import Network
from sfm.planning.design.candidates import (
    COUNT,
    Candidates,
    StationLimits,
    candidates,
    cost_of,
    gains,
    image_rows,
)
from sfm.planning.planned_object import PlannedObject
from sfm.planning.prediction import Prediction, ScaleBarPlan, predict_network
from sfm.planning.sight.visibility import Seeing
from sfm.planning.wanted import MIN_RAYS, WantedPrecision, short_of
from sfm.planning.weakness import reason_of
from sfm.runtime.progress import report_step

MIN_PHOTOGRAPHS = 4  # photographs of a network whose gross errors can be found
MAX_PHOTOGRAPHS = 100
SWEEPS = 3  # exchanges of all stations at most
MIN_DECREASE = 1e-3  # relative decrease of the cost from which an exchange is one
MAX_RATIO = 25.0  # of the full over the limiting variance of a point that is believed
NO_BETTER = 0.98  # of the shortfall: a round of additions that leaves more than this gains nothing
ROUNDS = 6  # of additions and exchanges at most
PATIENCE = 6  # photographs that gain nothing one after the other, until the limit is reported


@dataclass(frozen=True)
class Design:
    """Stations that were chosen, and what they will give."""

    prediction: Prediction  # full covariance of the network
    shortfall: float  # largest of what is wanted: predicted over wanted, reached at 1 or below
    reached: bool
    limit: str  # what limits it, in words; empty where it is reached
    photographs_tried: int  # candidates, upright and rolled


@checked_arguments()
def design_network(
    planned: PlannedObject,
    camera: Camera,
    allowed: StationLimits,
    seeing: Seeing,
    wanted: WantedPrecision,
    *,
    max_photographs: int = MAX_PHOTOGRAPHS,
    count: int = COUNT,
    bars: Sequence[ScaleBarPlan] = (),
    given: Callable[[Network], Network] | None = None,
) -> Design:
    """Return the few stations that give what is wanted.

    Args:
        planned: the object.
        camera: interior orientation, and which parameters are adjusted.
        allowed: where one may stand.
        seeing: limits and precision of image points.
        wanted: what the network must give.
        max_photographs: photographs at most.
        count: candidates for stations, each upright and rolled.
        bars: scale bars.
        given: as of `predict_network`.

    Raises:
        GeometryError: no room to stand in, or nothing can be determined from there.

    Source: Fedorov (1972), Theory of Optimal Experiments; Fraser (1984).
    """
    if max_photographs < MIN_PHOTOGRAPHS:
        raise GeometryError(
            f"plan: at most {counted(max_photographs, 'photograph')}, needed {MIN_PHOTOGRAPHS} or more"
        )
    found = candidates(planned, camera, allowed, seeing, count=count)
    return _Designer(planned, camera, seeing, wanted, found, max_photographs, bars, given).run()


class _Designer:
    """The choice so far, with what its steps share."""

    def __init__(
        self,
        planned: PlannedObject,
        camera: Camera,
        seeing: Seeing,
        wanted: WantedPrecision,
        found: Candidates,
        most: int,
        bars: Sequence[ScaleBarPlan],
        given: Callable[[Network], Network] | None,
    ) -> None:
        self.planned, self.camera, self.seeing, self.wanted = planned, camera, seeing, wanted
        self.found, self.most, self.bars, self.given = found, most, bars, given
        self.rows = image_rows(planned, camera, found.stations, found.sight)
        self.single = np.einsum("mnai,mnaj->mnij", self.rows, self.rows)
        self.prior = np.eye(3) / planned.size**2  # what is known of a point that nothing shows yet
        self.seeable = found.sight.seen.sum(axis=0) >= 2 * MIN_RAYS  # upright and rolled
        self.scale = np.where(self.seeable, 1 / wanted.point_variance(planned), 0.0)
        self.ratio = np.ones(len(planned.names))

    def run(self) -> Design:
        chosen: list[int] = []
        while len(chosen) < min(MIN_PHOTOGRAPHS, self.most):
            chosen.append(self._next(chosen))
        short = self._full(chosen)[1]
        for _ in range(ROUNDS):
            before, idle = short, 0
            while short > 1 and len(chosen) < self.most and idle < PATIENCE:
                chosen.append(self._next(chosen))
                new = self._full(chosen)[1]
                idle = idle + 1 if new > NO_BETTER * short else 0
                short = min(short, new)
            chosen, prediction, short = self._exchanged(chosen)
            if short <= 1 or len(chosen) >= self.most or short > NO_BETTER * before:
                break
        if short <= 1:
            chosen, prediction, short = self._fewer(chosen, prediction, short)
        return Design(
            prediction,
            short,
            bool(short <= 1),
            "" if short <= 1 else self._limit(prediction, len(chosen)),
            len(self.found.stations),
        )

    def _cofactors(self, chosen: Sequence[int]) -> FloatArray:
        return (
            np.linalg.inv(self.prior + self.single[list(chosen)].sum(axis=0))
            if len(chosen)
            else np.tile(np.linalg.inv(self.prior), (len(self.planned.names), 1, 1))
        )

    def _open(self, chosen: Sequence[int]) -> BoolArray:
        """Return which candidates may be taken: of one station one photograph, upright or rolled."""
        open_ = np.ones(len(self.found.stations), dtype=bool)
        taken = np.array(chosen, dtype=np.int64)
        half = self.found.count
        open_[taken] = False
        open_[(taken + half) % (2 * half)] = False
        # half of the photographs rolled where the camera is calibrated
        if self.camera.free.any() and len(chosen):
            turned = int((taken >= half).sum())
            if turned > len(chosen) - turned:
                open_[half:] = False
            elif turned < len(chosen) - turned:
                open_[:half] = False
        return open_

    def _next(self, chosen: Sequence[int]) -> int:
        gain = gains(self._cofactors(chosen), self.rows, self.scale * self.ratio, self._open(chosen))
        if not (gain > 0).any():
            raise GeometryError("plan: fewer stations show the object than a network needs")
        return int(np.argmax(gain))

    def _cost(self, chosen: Sequence[int]) -> float:
        return cost_of(np.trace(self._cofactors(chosen), axis1=1, axis2=2) / 3, self.scale * self.ratio)

    def _full(self, chosen: Sequence[int]) -> tuple[Prediction | None, float]:
        """Return the full prediction and what it falls short by; learn what the limiting one ignores."""
        which = np.array(chosen, dtype=np.int64)
        report_step(f"predicting {counted(len(chosen), 'photograph')}")
        try:
            prediction = predict_network(
                self.planned,
                self.camera,
                self.found.stations.of(which).renamed(),
                self.seeing,
                bars=self.bars,
                given=self.given,
                sight=self.found.sight.of(which),
            )
        except GeometryError:  # too few photographs yet
            return None, float("inf")
        limiting = np.trace(self._cofactors(chosen), axis1=1, axis2=2) / 3
        ratio = np.where(prediction.determined, prediction.sigma**2 / limiting, MAX_RATIO)
        ratio[prediction.rays < MIN_RAYS] = MAX_RATIO
        self.ratio = np.clip(ratio, 1.0, MAX_RATIO)
        return prediction, short_of(prediction, self.wanted, self.seeable)

    def _exchanged(self, chosen: list[int]) -> tuple[list[int], Prediction, float]:
        """Return the choice with stations exchanged for better ones, while the full prediction gains."""
        prediction, short = self._full(chosen)
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
            other, other_short = self._full(tried)
            if other_short >= short:
                break
            chosen, prediction, short = tried, other, other_short
        if prediction is None:
            raise GeometryError(
                "plan: the stations that are allowed do not make a network: fewer than two of them share "
                "enough points"
            )
        return chosen, prediction, short

    def _fewer(
        self, chosen: list[int], prediction: Prediction, short: float
    ) -> tuple[list[int], Prediction, float]:
        """Return the choice without those photographs that what is wanted does not need."""
        while len(chosen) > MIN_PHOTOGRAPHS:
            order = np.argsort([self._cost(chosen[:k] + chosen[k + 1 :]) for k in range(len(chosen))])
            for k in order[:3]:
                fewer = chosen[: int(k)] + chosen[int(k) + 1 :]
                new, new_short = self._full(fewer)
                if new_short > 1:
                    fewer, new_, new_short = self._exchanged(fewer)
                    new = new_
                if new is not None and new_short <= 1:
                    chosen, prediction, short = fewer, new, new_short
                    break
            else:
                break
        return chosen, prediction, short

    def _limit(self, prediction: Prediction, photographs: int) -> str:
        if photographs >= self.most:
            return f"the {self.most} photographs that are allowed; the worst is {self._worst(prediction)}"
        return (
            f"where one may stand: {PATIENCE} more photographs gain less than {1 - NO_BETTER:.0%} each; "
            f"the worst point is {self._worst(prediction)}"
        )

    def _worst(self, prediction: Prediction) -> str:
        j = int(np.argmax(np.where(self.seeable, prediction.sigma, -1.0)))
        return f"{self.planned.names[j]} ({reason_of(prediction, j)})"
