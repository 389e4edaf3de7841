"""Rounds of an adjustment with gross errors: decides which image points take part, and with what weight.

The first optimum is that of all image points. If gross errors distort the network, it is that of the image
points that a robust start retains. Then data snooping or an M-estimator follows, and each round starts from
the optimum of the last one.

Source: Pope (1976), NOAA TR NOS 65 NGS 1; Huber and Ronchetti (2009), Robust Statistics, ch. 7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.engine.cofactors import cofactors, hat_complement
from sfm.adjustment.engine.collinearity import Observations, State, behind_camera, residuals
from sfm.adjustment.engine.iterate import Optimum, Problem, iterate, optimum_at
from sfm.adjustment.engine.observed import count_of
from sfm.adjustment.engine.unknowns import start_weights
from sfm.adjustment.quality.gross_errors.robust import (
    RETURN_FRACTION,
    huber_weights,
    least_sigma,
    residual_lengths,
    robust_scale,
    rounding_of,
    snoop,
    sum_of_squares,
    tukey_weights,
    would_pass,
)
from sfm.adjustment.quality.statistics import tau_critical
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.model.remarks.remark import Remark, remark

MAX_ROUNDS = 200  # most rounds of data snooping
MAX_VAGUE = 5  # rounds without convergence; only residuals at an optimum show gross errors
ROUND_TOLERANCE = 1e-2  # |A dx| / |v| of a last step after which gross errors can be judged
# Ratio of the spread of residuals to that with the start values above which gross errors distort the network.
MIN_BENT_RATIO = 2.0
MIN_BENT_RATIO_OF_ONE = 10.0  # the same for one photograph, relative to the median of all photographs
FAR_OFF = 100.0  # median residuals; an image point beyond has no influence with any estimator
MIN_ANGLE_DEG = 0.1  # between two rays of a point: a few pixels of parallax, needed to determine depth
REWEIGHTINGS = 30
# Successive reweightings without convergence; more helped in none of the 400 networks with gross errors of
# tests.adjustment.test_studies.
MAX_VAGUE_WEIGHTS = 2
WEIGHT_TOLERANCE = 1e-3  # largest change of a weight at which reweighting ends
REJECTS = ("tau", "huber", "tukey", "none")


def find_optimum(
    run: Run, state: State, *, reject: str, alpha: float, without: BoolArray
) -> tuple[Optimum, FloatArray]:
    """Return the optimum and the factor on the weight of each image point, 0 where rejected, (k,).

    Args:
        run: problem and method of the adjustment.
        state: start values.
        reject: tau | huber | tukey | none.
        alpha: probability that the test of one image coordinate rejects a good one.
        without: image points that data snooping leaves out at the start, (k,).

    Raises:
        GeometryError: the normal equations of the start values cannot be solved.
    """
    weight = start_weights(run.problem.layout, state)
    if reject == "none":
        return _optimum_of_all(run, state, weight, without)
    wanted, run.tolerance = run.tolerance, max(run.tolerance, ROUND_TOLERANCE)
    optimum, weight = _undistorted_optimum(run, state, weight, without)
    run.remarks = ()  # remarks on estimators that only provided a start are dropped
    if reject == "tau":
        optimum, weight = _snoop_all(run, optimum, weight, alpha)
    else:
        # Image points that a robust start left out and that have very large residuals distort their
        # photograph even with the bounded influence of Huber's weights.
        layout = run.problem.layout
        length = residual_lengths(layout.observations, residuals(layout.observations, optimum.state))
        bends = np.asarray(layout.active & (weight == 0) & (length > FAR_OFF * np.nanmedian(length)))
        out = bends if reject == "tukey" else None  # even bounded, their influence may hide a good one
        robust, factor = _reweight(run, optimum, weight, huber_weights, out=out)
        ends = (residuals(layout.observations, at) for at in (state, robust.state))
        if _distorted_photographs(run, *ends).any():
            robust, factor = optimum, weight
            if reject == "huber":
                robust, factor = _reweight(run, optimum, weight, huber_weights, out=bends)
        if reject == "tukey":
            robust, factor = _reweight(run, robust, factor, tukey_weights)
        optimum, weight = robust, factor
    if run.tolerance > wanted:
        run.tolerance = wanted
        optimum = run.again(optimum, weight)
        if not optimum.converged:  # near the optimum undamped steps may oscillate across a valley
            optimum = run.start(optimum.state, weight)
    return optimum, weight


@dataclass
class Run:
    """Constants of the rounds of one adjustment, and the number of steps so far."""

    problem: Problem
    method: str
    max_iterations: int
    tolerance: float
    exact: bool  # whether the factor must belong to the last normal equations
    iterations: int = 0
    start_vPv: float = float("nan")  # v'Pv at the start values with the first weights
    remarks: tuple[Remark, ...] = ()

    def start(self, state: State, weight: FloatArray) -> Optimum:
        """Return the optimum from start values by the chosen method.

        Args:
            state: start values.
            weight: factor on the weight of each image point, (k,).
        """
        return self._iterate(state, weight, self.method)

    def reinstate(
        self, optimum: Optimum, weight: FloatArray, without: BoolArray
    ) -> tuple[Optimum, FloatArray]:
        """Return the optimum with image points reinstated that were behind the camera only at the start.

        Args:
            optimum: optimum without them.
            weight: factor on the weight of each image point there, (k,).
            without: image points that stay out, (k,).
        """
        ready = self.problem.layout.active & ~without
        ready &= ~behind_camera(self.problem.layout.observations, optimum.state)
        if (ready & (weight == 0)).any():
            weight = np.where(ready, 1.0, weight)
            optimum = self._iterate(optimum.state, weight, self.method)
        return optimum, weight

    def again(self, optimum: Optimum, weight: FloatArray) -> Optimum:
        """Return the optimum with other weights, starting from a near optimum.

        Args:
            optimum: near optimum.
            weight: factor on the weight of each image point, (k,).
        """
        return self._iterate(optimum.state, weight, "gauss-newton", near=True)

    def count(self, used: BoolArray) -> float:
        """Return the number of observations, of which image points with errors in common count in part.

        Args:
            used: image points that take part, (k,).
        """
        return 2 * float(self.problem.layout.observations.share[used].sum()) + count_of(self.problem.observed)

    def discount(self, used: BoolArray) -> int:
        """Return by how much errors in common lower the redundancy, before redundancy numbers are known.

        Observations with errors in common count in part, and so do points that only they determine.

        Args:
            used: image points that take part, (k,).
        """
        layout = self.problem.layout
        o, largest = layout.observations, np.zeros(len(layout.point_free))
        np.maximum.at(largest, o.point[used], o.share[used])
        of_points = np.where(largest > 0, 1 - largest, 0.0) @ layout.point_free.sum(axis=1)
        return round(2 * float((1 - o.share[used]).sum()) - float(of_points))

    def redundancy(self, optimum: Optimum, weight: FloatArray) -> int:
        """Return the number of observations and constraints minus unknowns, less the discount.

        Args:
            optimum: optimum.
            weight: factor on the weight of each image point, (k,).
        """
        every = self.undiscounted(optimum, weight)
        return every - min(self.discount(weight > 0), max(every - 1, 0))

    def undiscounted(self, optimum: Optimum, weight: FloatArray) -> int:
        """Return the number of observations and constraints minus unknowns.

        Args:
            optimum: optimum.
            weight: factor on the weight of each image point, (k,).
        """
        held = len(optimum.motions.inverse)
        held += int(optimum.equations.held.sum())
        observations = 2 * int((weight > 0).sum()) + count_of(self.problem.observed)
        return observations - self.problem.layout.count + held

    def _iterate(self, state: State, weight: FloatArray, method: str, near: bool = False) -> Optimum:
        optimum = iterate(
            self.problem,
            state,
            weight,
            method=method,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
            near=near,
            exact=self.exact,
        )
        if not self.iterations and np.isnan(self.start_vPv):
            self.start_vPv = optimum.start_vPv
        self.iterations += optimum.iterations
        return optimum


def _optimum_of_all(
    run: Run, state: State, weight: FloatArray, without: BoolArray
) -> tuple[Optimum, FloatArray]:
    """Return the optimum of all image points except those in `without`."""
    weight = np.where(without, 0.0, weight)
    return run.reinstate(run.start(state, weight), weight, without)


def _undistorted_optimum(
    run: Run, state: State, weight: FloatArray, without: BoolArray
) -> tuple[Optimum, FloatArray]:
    """Return the optimum from which gross errors are judged: of all image points, unless they distort it.

    An error of hundreds of pixels can turn a photograph over or make the principal distance collapse. Then
    the adjustment does not converge, or most image points, of all photographs or of one, fit worse than with
    the start values. In this case the adjustment restarts there with Huber's and Tukey's weights, and image
    points with a Tukey weight of 0 are left out.

    Raises:
        GeometryError: neither adjustment can be solved.
    """
    layout = run.problem.layout

    def spread(v: FloatArray) -> float:
        return robust_scale(layout.observations, v, layout.active & np.isfinite(v).all(axis=1), freedom=1.0)

    try:
        (optimum, plain), begun = _optimum_of_all(run, state, weight, without), None
    except GeometryError:
        begun = optimum_at(run.problem, state, weight)
        if begun is None:
            raise
        optimum, plain = replace(begun, converged=False), weight
    before, after = residuals(layout.observations, state), residuals(layout.observations, optimum.state)
    limit, first = spread(after), max(spread(before), least_sigma(layout.observations))

    def sound(optimum: Optimum, v: FloatArray) -> bool:
        fits = spread(v) <= MIN_BENT_RATIO * first
        return optimum.converged and fits and not _distorted_photographs(run, before, v).any()

    if sound(optimum, after):
        return optimum, plain
    begun = begun or optimum_at(run.problem, state, weight)
    if begun is None:
        return optimum, plain
    # With Huber's weights an error keeps a bounded influence, which may still turn over a photograph with few
    # image points. With Tukey's weights it has none if the start values are good.
    for estimators in ((tukey_weights,), (huber_weights, tukey_weights)):
        robust, factor = begun, weight
        try:
            for weights in estimators:
                robust, factor = _reweight(run, robust, factor, weights)
            factor = (factor > 0).astype(float)
            robust = run.again(robust, factor)
        except GeometryError:
            continue
        last, after = estimators[0] is huber_weights, residuals(layout.observations, robust.state)
        if sound(robust, after) or (last and robust.converged and spread(after) < limit):
            return robust, factor
    return optimum, plain


def _distorted_photographs(run: Run, start: FloatArray, end: FloatArray) -> BoolArray:
    """Return the photographs with most image points fitting far worse at the end than at the start, (m,).

    The residuals of all image points are px, (k, 2).

    They must fit worse than before and worse than the others. An error in one of six image points distorts
    its photograph only, which the median over all photographs does not show.
    """
    observations, active = run.problem.layout.observations, run.problem.layout.active
    before, after = (_median_lengths(observations, v, active) for v in (start, end))
    before = np.maximum(before, least_sigma(observations))
    return np.asarray(
        after > np.maximum(MIN_BENT_RATIO * before, MIN_BENT_RATIO_OF_ONE * np.nanmedian(after))
    )


def _median_lengths(observations: Observations, v: FloatArray, active: BoolArray) -> FloatArray:
    """Return the median length of the residuals of each photograph, in standard deviations, (m,).

    For an even number it is the upper median, because three of six image points fit any resection.
    """
    length = residual_lengths(observations, v)
    length = np.where(active & np.isfinite(length), length, np.inf)
    out = np.full(len(observations.camera), np.nan)
    order = np.lexsort((length, observations.image))
    count = np.bincount(observations.image, minlength=len(out))
    first = np.cumsum(count) - count
    seen = count > 0
    out[seen] = length[order][(first + count // 2)[seen]]
    return out


def _snoop_all(run: Run, optimum: Optimum, weight: FloatArray, alpha: float) -> tuple[Optimum, FloatArray]:
    """Return the optimum without the image points that fail Pope's test.

    If a round cannot be solved, the previous round is the result.
    """
    layout = run.problem.layout
    returned, vague = np.zeros(len(weight), dtype=bool), 0
    loose = np.zeros(len(weight), dtype=bool)
    for _ in range(MAX_ROUNDS):
        vague += not optimum.converged
        if vague > MAX_VAGUE:
            run.remarks = (remark("rejection_not_converging", rounds=MAX_VAGUE),)
            break
        vPv, redundancy = optimum.vPv, float(run.redundancy(optimum, weight))
        if redundancy < 2:
            break
        v = residuals(layout.observations, optimum.state)
        Q = cofactors(optimum, layout, datum=False)
        complement = hat_complement(optimum, layout, Q, weight)
        if run.problem.observed:
            vPv, of_image_points = sum_of_squares(layout.observations, v, complement, weight > 0)
            redundancy = min(max(of_image_points, 1.0), redundancy)
        seen, used = layout.observations, weight > 0
        out = snoop(
            seen,
            optimum.state,
            v,
            complement,
            Q.limiting,
            used,
            sigma0=max(np.sqrt(vPv / max(redundancy, 1)), rounding_of(seen)),
            critical=tau_critical(alpha, redundancy),
        )
        back = would_pass(seen, v, complement, used, vPv=vPv, redundancy=redundancy, alpha=alpha)
        back &= layout.active & ~returned & ~loose
        back &= _stays_right(seen, v, complement, out, vPv=vPv, redundancy=redundancy)
        if not (out.any() or back.any()):
            break
        changed = np.where(out, 0.0, np.where(back, 1.0, weight))
        returned |= back
        loose |= _without_angle(run.problem, optimum.state, changed > 0, out | back)
        changed = np.where(loose, 0.0, changed)
        try:
            optimum, weight = run.again(optimum, changed), changed
        except GeometryError:
            more, rejected = int((changed == 0).sum()), int((weight == 0).sum())
            run.remarks = (remark("rejection_not_converging", more=more, rejected=rejected),)
            break
    return optimum, weight


def _stays_right(
    observations: Observations,
    v: FloatArray,
    complement: FloatArray,
    out: BoolArray,
    *,
    vPv: float,
    redundancy: float,
) -> BoolArray:
    """Return of which image points a test that they pass is not changed by rejecting others, (k,).

    It is changed if sigma0 falls by more than the margin of the test, or if a ray of the same point is out.

    Args:
        observations: image points.
        v: residuals of all image points, px, (k, 2).
        complement: whitened cofactors of the residuals, (k, 2, 2).
        out: image points to reject, (k,).
        vPv: weighted sum of squares of the image points in the adjustment.
        redundancy: redundancy of these image points.
    """
    lost, of_lost = sum_of_squares(observations, v, complement, out)
    left = (vPv - lost) / max(redundancy - of_lost, 1.0)
    if left < RETURN_FRACTION**2 * vPv / redundancy:
        return np.zeros(len(out), dtype=bool)
    touched = np.bincount(observations.point[out], minlength=len(observations.start) - 1) > 0
    return np.asarray(~touched[observations.point])


def _without_angle(problem: Problem, state: State, used: BoolArray, changed: BoolArray) -> BoolArray:
    """Return all image points of points with almost parallel rays after a change, (k,).

    Two photographs from the same position determine no depth. The point would move to infinity, and the steps
    of all others would be shortened. Known points stay, and so do single rays, which have no effect.

    Args:
        problem: constants of the adjustment.
        state: values of all unknowns.
        used: image points that take part, (k,).
        changed: image points that were rejected or reinstated, (k,).
    """
    o, count = problem.layout.observations, len(state.points)
    suspect = np.bincount(o.point[changed], minlength=count) > 0
    suspect &= problem.layout.point_free.all(axis=1)
    for observed_kind in problem.observed:
        if observed_kind.point is not None:
            suspect[observed_kind.point] = False
    rows = np.flatnonzero(used & suspect[o.point])
    ray = state.points[o.point[rows]] - state.position[o.image[rows]]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    first = np.zeros((count, 3))
    first[o.point[rows]] = ray  # one ray of each point
    apart, rays = np.zeros(count), np.bincount(o.point[rows], minlength=count)
    np.maximum.at(apart, o.point[rows], np.linalg.norm(ray - first[o.point[rows]], axis=1))
    return np.asarray((suspect & (rays > 1) & (apart < np.radians(MIN_ANGLE_DEG)))[o.point])


def _reweight(
    run: Run,
    optimum: Optimum,
    weight: FloatArray,
    weights: Callable[..., FloatArray],
    *,
    out: BoolArray | None = None,
) -> tuple[Optimum, FloatArray]:
    """Return the optimum of an M-estimator by reweighting, with a new scale from the median in each round.

    Args:
        run: problem and method of the adjustment.
        optimum: optimum to start from.
        weight: factor on the weight of each image point there, (k,).
        weights: weight function of the estimator.
        out: image points that take no part, (k,).
    """
    layout = run.problem.layout
    ready = layout.active & ~behind_camera(layout.observations, optimum.state)
    if out is not None:
        ready &= ~out
    count = run.count(ready)
    freedom, vague = run.redundancy(optimum, ready.astype(float)) / max(count, 1), 0
    for _ in range(REWEIGHTINGS):
        v = residuals(layout.observations, optimum.state)
        sigma0 = robust_scale(layout.observations, v, ready & np.isfinite(v).all(axis=1), freedom=freedom)
        new = np.where(ready, weights(layout.observations, v, sigma0=sigma0), 0.0)
        change = float(np.abs(new - weight).max())
        weight = new
        optimum = run.again(optimum, weight)
        vague = 0 if optimum.converged else vague + 1
        if change <= WEIGHT_TOLERANCE or vague > MAX_VAGUE_WEIGHTS:
            break
    run.remarks = (remark("rejection_not_converging", rounds=vague),) if vague > MAX_VAGUE_WEIGHTS else ()
    return optimum, weight
