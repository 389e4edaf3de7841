"""Validates the in-house adjuster against COLMAP's on random networks, with the same start values.

    python -m benchmarks.validation [--networks N] [--seed S] [--jobs N] [--out FILE]

Each trial has cost, RMS, steps and seconds of both adjusters, how the two ended, and the largest differences
of their results in standard deviations, and of their covariances at the same solution. Two solutions are the
same optimum if their costs differ by no more than a shift of SAME_SIGMAS standard deviations in one direction
causes. A table of all networks is written as CSV. The exit code is 1 if the in-house adjuster was worse on
any network.
"""

from __future__ import annotations

import argparse
import csv
import math
import multiprocessing
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Literal, Protocol, TypeVar, get_args

import numpy as np
from threadpoolctl import threadpool_limits

from adapters.colmap.adjuster import ColmapBackend
from benchmarks.random_networks import MODELS, Plan, RandomNetwork, random_network
from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.comparison.solutions import SAME_SIGMAS, reprojection, rotation_angle_deg
from sfm.comparison.two_adjusters.adjusters import BackendAdjustment
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.errors import KolinearError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.similarity import fit_similarity

T = TypeVar("T")
Ended = Literal["same optimum", "ours higher", "ours failed", "ours lower", "the other failed", "both failed"]
WORSE: tuple[Ended, ...] = ("ours higher", "ours failed")  # faults of the in-house adjuster
MAX_ITERATIONS = 100
WARM_UP_SEED = 0  # of networks that are adjusted before the timing starts
WARM_UP_IMAGE_POINTS = 3000  # these networks have fewer image points


class ValidationAdjustment(BackendAdjustment, Protocol):
    """Result that the other adjuster must return, with the reason why it stopped."""

    @property
    def message(self) -> str:
        """Why it stopped."""


class ValidationCovariance(Protocol):
    """Covariances for image coordinates of standard deviation 1 px."""

    @property
    def interior(self) -> tuple[FloatArray, ...]:
        """Marginal covariance of the free parameters of each camera."""

    @property
    def points(self) -> FloatArray:
        """Covariance of the points with photographs and cameras held, (n, 3, 3)."""


class ValidationBackend(Protocol):
    """The other adjuster: a module or an object with a name and two functions."""

    @property
    def name(self) -> str:
        """Its name."""

    def adjust(self, network: Network, start: Estimate, *, control: bool) -> ValidationAdjustment:
        """Adjust with unit weights, and with control points held or in a free datum."""

    def covariance(
        self, network: Network, estimate: Estimate, *, control: bool
    ) -> ValidationCovariance | None:
        """Return covariances at a solution, None if they are not available."""


@dataclass(frozen=True)
class Trial:
    """One random network adjusted by both; pairs are (kolinear, the other), NaN if missing."""

    number: int  # of the network; number and seed reproduce it
    plan: Plan
    points: int  # object points that took part
    image_points: int
    cost: tuple[float, float]  # half the sum of squared residuals, px^2
    rms_px: tuple[float, float]  # per coordinate, px
    iterations: tuple[int, int]
    seconds: tuple[float, float]  # of adjustment alone, covariance not included, s
    interior_sigmas: float  # largest difference of a free interior parameter over its sigma
    position_sigmas: float  # largest difference of a coordinate of a projection centre over its sigma
    rotation_sigmas: float  # largest difference of a rotation over the smallest sigma of its angles
    point_sigmas: float  # largest difference of an object coordinate over its sigma
    conditional_difference: float  # relative, of the points' covariances with cameras held
    interior_difference: float  # relative, of the marginal covariances of the interior orientation
    marginal_over_conditional: float  # median ratio of a point's sigma to its sigma with cameras held
    ended: Ended  # how the two ended
    apart: float  # shift in one direction that explains the difference of the costs, standard deviations
    messages: tuple[str, ...] = ()  # why each that failed did


@dataclass(frozen=True)
class Validation:
    """All trials of one run."""

    backend: str  # name of the other adjuster
    seed: int
    trials: tuple[Trial, ...]

    @property
    def passed(self) -> bool:
        """Whether the in-house adjuster is never the worse one."""
        return not any(trial.ended in WORSE for trial in self.trials)

    def counts(self) -> dict[Ended, int]:
        """Return the number of networks by how they ended, the most frequent first."""
        return dict(Counter(trial.ended for trial in self.trials).most_common())

    def largest(self) -> dict[str, float]:
        """Return the largest differences over all networks, in standard deviations or relative; NaN: none."""
        solved = [trial for trial in self.trials if trial.ended == "same optimum"]
        costs = [
            abs(trial.cost[1] - trial.cost[0]) / min(trial.cost) for trial in solved if min(trial.cost) > 0
        ]
        return {
            "cost, relative": max(costs, default=math.nan),
            "interior parameter, sigmas": _largest(trial.interior_sigmas for trial in solved),
            "projection centre, sigmas": _largest(trial.position_sigmas for trial in solved),
            "rotation, sigmas": _largest(trial.rotation_sigmas for trial in solved),
            "object coordinate, sigmas": _largest(trial.point_sigmas for trial in solved),
            "conditional covariance of a point, relative": _largest(
                trial.conditional_difference for trial in self.trials
            ),
            "covariance of interior orientation, relative": _largest(
                trial.interior_difference for trial in self.trials
            ),
        }


def _largest(values: Iterable[float]) -> float:
    return max((value for value in values if math.isfinite(value)), default=math.nan)


def validate(backend: ValidationBackend, *, networks: int, seed: int, jobs: int = 1) -> Validation:
    """Adjust random networks with both adjusters, and compare the results.

    Args:
        backend: the other adjuster; it must be picklable if jobs > 1.
        networks: number of networks.
        seed: seed of the random networks; network k is the same for any number of networks.
        jobs: number of processes, each with one thread.
    """
    return Validation(backend.name, seed, tuple(_run(backend, seed, networks, jobs)))


def make_trial(number: int, seed: int, backend: ValidationBackend) -> Trial:
    """Make network `number` of a seed, adjust it with both adjusters, and judge the results.

    Args:
        number: number of the network, from 0.
        seed: seed of the run.
        backend: the other adjuster.
    """
    made = random_network(np.random.default_rng([seed, number]))
    network, plan = made.network, made.plan
    control = plan.datum == "control"
    begun = time.perf_counter()
    ours, our_failure = _try_adjuster(lambda: _adjust(made, covariance=False))
    our_seconds = time.perf_counter() - begun
    theirs, their_failure = _try_adjuster(lambda: backend.adjust(network, made.start, control=control))
    if ours is not None:
        our_failure = ours.undetermined or (() if ours.converged else ("not_converged",))
    if theirs is not None and not theirs.converged:
        their_failure = (theirs.message or "not_converged",)
    cost_a, rms_a = _fit(network, None if ours is None else ours.estimate)
    cost_b, rms_b = _fit(network, None if theirs is None else theirs.estimate)
    sigmas = (np.nan,) * 4
    covariances = (np.nan,) * 3
    if ours is not None and not our_failure:
        at_optimum = ours.estimate
        full, our_failure = _try_adjuster(lambda: _adjust(made, covariance=True, start=at_optimum))
        if full is not None and theirs is not None and np.isfinite(cost_b):
            sigmas = _differences(full, theirs.estimate, control=control)
        if full is not None:
            covariances = _covariances(full, backend, control=control)
    return Trial(
        number,
        plan,
        len(network.points),
        len(network.image_points),
        (cost_a, cost_b),
        (rms_a, rms_b),
        (0 if ours is None else ours.iterations, 0 if theirs is None else theirs.iterations),
        (our_seconds, np.nan if theirs is None else theirs.seconds),
        *sigmas,
        *covariances,
        how_ended(cost_a, cost_b, plan.noise_px, our_failure, their_failure),
        sigmas_apart(cost_a, cost_b, plan.noise_px),
        (*our_failure, *their_failure),
    )


def _run(backend: ValidationBackend, seed: int, networks: int, jobs: int) -> Iterator[Trial]:
    with threadpool_limits(1):
        warm_up(backend)  # compiles if needed, once and not in every worker
        if jobs <= 1:
            for number in range(networks):
                yield make_trial(number, seed, backend)
            return
    # New processes: threads of compiled libraries do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        jobs, mp_context=context, initializer=_prepare_worker, initargs=(backend,)
    ) as pool:
        try:
            yield from pool.map(make_trial, range(networks), [seed] * networks, [backend] * networks)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _prepare_worker(backend: ValidationBackend) -> None:
    """Prepare a worker: one thread, Ctrl-C ignored (the parent ends the worker), kernels loaded."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threadpool_limits(1)
    warm_up(backend)


def warm_up(backend: ValidationBackend) -> None:
    """Adjust a network of every camera model once, so that timings exclude loading and compiling."""
    waiting = set(MODELS)
    for number in count():
        made = random_network(np.random.default_rng([WARM_UP_SEED, number]))
        if made.plan.model in waiting and len(made.network.image_points) < WARM_UP_IMAGE_POINTS:
            waiting.remove(made.plan.model)
            control = made.plan.datum == "control"
            _try_adjuster(partial(_adjust, made, covariance=True))
            _try_adjuster(partial(backend.adjust, made.network, made.start, control=control))
        if not waiting:
            return


def _adjust(made: RandomNetwork, *, covariance: bool, start: Estimate | None = None) -> Adjustment:
    return adjust(
        made.network,
        made.start if start is None else start,
        datum=Datum(made.plan.datum),
        reject="none",
        covariance=covariance,
        options=AdjustmentOptions(sigma_px=made.plan.noise_px, max_iterations=MAX_ITERATIONS),
    )


def _try_adjuster(run: Callable[[], T]) -> tuple[T | None, tuple[str, ...]]:
    """Run an adjuster; every failure is a result here, including faults of a program."""
    try:
        return run(), ()
    except KolinearError as error:
        return None, (str(error),)
    except Exception as error:
        return None, (f"{type(error).__name__}: {error}",)


def _fit(network: Network, estimate: Estimate | None) -> tuple[float, float]:
    """Return cost, px^2, and RMS, px, of an estimate; NaN if it has lost points."""
    if estimate is None:
        return np.nan, np.nan
    v = reprojection(network, estimate)
    if len(v) < len(network.image_points):
        return np.nan, np.nan
    return float((v**2).sum() / 2), float(np.sqrt((v**2).mean()))


def sigmas_apart(a: float, b: float, sigma_px: float) -> float:
    """Return the shift in one direction, in standard deviations, that explains the difference of two costs.

    A shift of s standard deviations increases the cost by s^2 sigma_px^2 / 2.

    Args:
        a: first cost, px^2.
        b: second cost, px^2.
        sigma_px: standard deviation of an image coordinate, px.
    """
    return float(np.sqrt(2 * abs(a - b)) / sigma_px)


def how_ended(a: float, b: float, sigma_px: float, ours: tuple[str, ...], theirs: tuple[str, ...]) -> Ended:
    """Return how two adjusters ended, from their costs (px^2) and failures."""
    # An adjuster that ends at the other's optimum has solved the network, whatever it reports.
    if sigmas_apart(a, b, sigma_px) <= SAME_SIGMAS:
        return "same optimum"
    if ours and theirs:
        return "both failed"
    if ours or not np.isfinite(a):
        return "ours failed"
    if theirs or not np.isfinite(b):
        return "the other failed"
    return "ours lower" if a < b else "ours higher"


def _differences(full: Adjustment, theirs: Estimate, *, control: bool) -> tuple[float, float, float, float]:
    """Return the largest differences of interior, position, rotation and points, in standard deviations.

    A free network is first aligned by a 7-parameter similarity over all points, since its standard deviations
    refer to the datum of inner constraints.
    """
    ours = full.estimate
    if not control:
        theirs = fit_similarity(theirs.points, ours.points).apply_estimate(theirs)
    interior = [
        (q.parameters - p.parameters)[p.free] / np.sqrt(np.diag(Q))
        for p, q, Q in zip(ours.cameras, theirs.cameras, full.covariance.interior, strict=True)
    ]
    sigma = np.sqrt(np.diagonal(full.covariance.exterior, axis1=1, axis2=2))
    angle = np.deg2rad(rotation_angle_deg(ours.rotation, theirs.rotation))
    variance = np.diagonal(full.covariance.points, axis1=1, axis2=2)
    moved = variance.min(axis=1) > 0
    shift = (theirs.points - ours.points)[moved] / np.sqrt(variance[moved])
    return (
        float(np.abs(np.concatenate(interior)).max()) if any(map(len, interior)) else np.nan,
        float(np.abs((theirs.position - ours.position) / sigma[:, :3]).max()),
        float((angle / sigma[:, 3:].min(axis=1)).max()),
        float(np.abs(shift).max()) if len(shift) else np.nan,
    )


def _covariances(
    full: Adjustment, backend: ValidationBackend, *, control: bool
) -> tuple[float, float, float]:
    """Return relative differences of conditional and interior covariances, and the ratio of sigmas."""
    network, variance = full.network, (full.sigma0 * full.sigma_px) ** 2
    conditional = full.covariance.points_limiting
    spread = np.trace(full.covariance.points, axis1=1, axis2=2)
    moved: BoolArray = spread > 0
    ratio = np.sqrt(spread[moved] / np.trace(conditional[moved], axis1=1, axis2=2))
    found, _ = _try_adjuster(lambda: backend.covariance(network, full.estimate, control=control))
    if found is None:
        return np.nan, np.nan, float(np.median(ratio))
    points = [
        _relative(ours / variance, theirs)
        for ours, theirs in zip(conditional[moved], found.points[moved], strict=True)
    ]
    interior = [
        _relative(ours / variance, theirs)
        for ours, theirs in zip(full.covariance.interior, found.interior, strict=True)
        if len(theirs)
    ]
    return (max(points, default=np.nan), max(interior, default=np.nan), float(np.median(ratio)))


def _relative(ours: FloatArray, theirs: FloatArray) -> float:
    """Return the largest difference of two covariances, each element over its two sigmas."""
    sigma = np.sqrt(np.diag(theirs))
    return float(np.abs((ours - theirs) / np.outer(sigma, sigma)).max())


def write_table(validation: Validation, path: Path) -> None:
    """Write a row for each network, with its plan and every figure, as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [_row(trial) for trial in validation.trials]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _row(trial: Trial) -> dict[str, object]:
    row: dict[str, object] = {"network": trial.number, **vars(trial.plan)}
    for name, value in vars(trial).items():
        if name in ("cost", "rms_px", "iterations", "seconds"):
            row[f"{name}_ours"], row[f"{name}_other"] = value
        elif name not in ("number", "plan"):
            row[name] = "; ".join(value) if name == "messages" else value
    return row


def main() -> int:
    """Validate on so many networks, print the figures and write the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--networks", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/validation.csv"))
    given = parser.parse_args()
    validation = validate(ColmapBackend(), networks=given.networks, seed=given.seed, jobs=given.jobs)
    counts = validation.counts()
    for ended in get_args(Ended):
        print(f"{ended:45} {counts.get(ended, 0):8}")
    for what, value in validation.largest().items():
        print(f"{what:45} {value:8.1e}")
    for place, program in enumerate(("Kolinear", "COLMAP")):
        seconds = sum(trial.seconds[place] for trial in validation.trials if trial.seconds[place] > 0)
        print(f"{f'{program}, s':45} {seconds:8.2f}")
    for trial in validation.trials:
        if trial.ended != "same optimum":
            print(f"network {trial.number}: {trial.ended}, {trial.apart:.2g} sigmas apart {trial.messages}")
    write_table(validation, given.out)
    print(f"Table: {given.out}")
    return 0 if validation.passed else 1


if __name__ == "__main__":
    sys.exit(main())
