"""Other solutions of the same image points: tries principal distances from a fraction to a multiple.

In weak networks the sum of squares has several minima. With few photographs and small angles, c is coupled
with the distance, and relief or tilt can be inverted as in a drawing of a cube. Each minimum has small
standard deviations, which do not reveal the others.

The network is therefore followed along c in both directions with c held, from the result and from its
reflection in depth. If v'Pv is as small as that of the result, or at a minimum, c is freed and the network is
adjusted.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.8 (approximate values); Luhmann
et al., Close-Range Photogrammetry (2020), sec. 7.3.2 (correlated interior and exterior orientation); Szeliski
and Kang (1997), IEEE PAMI 19(5), for the reversal of depth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.iterate import TOLERANCE
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.distributions import f_isf
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.similarity import fit_similarity, reverse_depth

STEP = 1.3  # ratio of successive principal distances that are tried
STEPS = 6  # steps in each direction, from a fifth of c to five times c
STATED_FREEDOM = 10  # number of observations that the stated weights count for in the estimated variance
WEAK_C = 5e-4  # relative standard deviation of c; a network is not weak below it,
MIN_STRONG_PHOTOGRAPHS = 5  # if it has at least this number of photographs
MIN_STRONG_IMAGE_POINTS = 4000  # number of image points from which a network is not weak
BARRIER = 3e3  # multiple of v'Pv of the result beyond which the search ends
MIN_APART_SIGMAS = 1.0  # smallest root mean square difference between different solutions
MAX_ITERATIONS = 60  # finding the relief from a plane takes about fifty
FOLLOWING_TOLERANCE = 1e-3  # |A dx| / |v| at which the search continues to the next c


@dataclass(frozen=True)
class OtherSolution:
    """A solution that fits the image points as well as the result, or better."""

    camera: str  # first camera with free c
    c: float  # its principal distance in this solution, mm or px
    unit: str  # unit of c
    reflected: bool  # whether it differs from the result in depth rather than in c
    moved: float  # difference of points over their standard deviations in the result, RMS
    c_moved: float  # difference of c over its standard deviation in the result; 0 if c is held
    vPv: float  # v'Pv over that of the result
    estimate: Estimate
    converges: bool  # whether an adjustment of all observations converges from there


def other_solutions(
    adjustment: Adjustment, *, starts: tuple[Estimate, ...] = (), had_to_be_held: tuple[str, ...] = ()
) -> tuple[OtherSolution, ...]:
    """Return other solutions with a similar or smaller v'Pv, smallest v'Pv first.

    Args:
        adjustment: the result, with its covariance.
        starts: approximate values of further solutions to try.
        had_to_be_held: cameras with c held because the adjustment does not converge if it is free. Other
            values of c are tried, and it is freed again from a better one.

    Returns:
        The solutions; empty if the network is strong, the result did not converge, or there is no redundancy.
    """
    a = adjustment
    if (
        not a.converged
        or a.redundancy < 1
        or len(a.network.image_points) > MIN_STRONG_IMAGE_POINTS
        or not _weak(a)
    ):
        return ()
    alone = replace(a.network, image_points=a.network.image_points.select(~a.rejected))
    search = _Search(alone, Datum(a.datum, a.datum_points), a.image_sigma_factor[~a.rejected])
    base = search.adjusted(a.estimate)
    if base is None or base.redundancy < 1 or not base.vPv > 0:
        return ()
    limit = 1 + _allowed(base, a.levels.question) / base.vPv
    result = _Place(a, np.sqrt(np.trace(a.covariance.points, axis1=1, axis2=2) / 3))
    others: list[OtherSolution] = []
    tried = search.candidates(a.estimate, starts, base.vPv, limit, follow_c=bool(had_to_be_held))
    for candidate in sorted(tried, key=lambda candidate: candidate.vPv):
        if _impossible(candidate.estimate, result.adjustment.estimate):
            continue
        known = any(
            result.distance(candidate.estimate, known_solution.estimate) < MIN_APART_SIGMAS
            for known_solution in others
        )
        if candidate.vPv > base.vPv * limit or known:
            continue
        described = result.describe(candidate.estimate, candidate.vPv / base.vPv)
        if described.moved > MIN_APART_SIGMAS:
            others.append(described)
    if others and others[0].vPv < 1:
        estimate = others[0].estimate
        free = [
            camera.free | camera.parts[0] if camera.name in had_to_be_held else camera.free
            for camera in estimate.cameras
        ]
        ended = search.adjusted(_with_free(estimate, free), tolerance=TOLERANCE)
        if ended is not None and ended.converged:
            others[0] = replace(others[0], estimate=ended.estimate, converges=True)
    return tuple(others)


def _allowed(base: Adjustment, level: float) -> float:
    """Return the largest excess of v'Pv of another solution.

    With little redundancy v'Pv hardly tests the stated weights, and any other solution would pass. So the
    stated weights count like STATED_FREEDOM observations.
    """
    freedom = base.redundancy + STATED_FREEDOM
    variance = (base.vPv + STATED_FREEDOM) / freedom
    return float(variance * f_isf(level, 1, freedom))


def _weak(a: Adjustment) -> bool:
    """Return whether there are few photographs, or a principal distance is poorly determined."""
    if len(a.network.images) < MIN_STRONG_PHOTOGRAPHS:
        return True
    for number in set(a.network.camera.tolist()):
        camera = a.estimate.cameras[number]
        if camera.free[0] and not a.interior_sigma(number)[0] < WEAK_C * abs(camera.parameters[0]):
            return True
    return False


def _impossible(other: Estimate, result: Estimate) -> bool:
    """Return whether a solution has a principal point outside the photograph, which no lens produces.

    Cropped photographs are an exception: there the result has it outside too, or it is given.
    """
    pairs = zip(other.cameras, result.cameras, strict=True)
    return any(
        theirs.free[theirs.parts[1]].any() and _is_beyond(theirs) and not _is_beyond(ours)
        for theirs, ours in pairs
    )


def _is_beyond(camera: Camera) -> bool:
    at = camera.principal_point_px
    return bool((at < 0).any() or (at > camera.size_px).any())


@dataclass(frozen=True)
class _Candidate:
    estimate: Estimate
    vPv: float


@dataclass(frozen=True)
class _Search:
    """Adjustments of the accepted image points from other start values."""

    network: Network
    datum: Datum
    factor: FloatArray  # factor on the standard deviations of the image points, (k,)

    def adjusted(
        self, start: Estimate, *, held: bool = False, tolerance: float = FOLLOWING_TOLERANCE
    ) -> Adjustment | None:
        """Return the adjustment with c free or held; None if it has no solution.

        Gauss-Newton comes first: in the bent valleys of weak networks it takes a few steps, damping fifty.
        The damped method follows if it does not converge.
        """
        if held:
            start = _with_free(start, [camera.free & ~camera.parts[0] for camera in start.cameras])
        adjusted: list[Adjustment] = []
        for method in ("gauss-newton", "levenberg-marquardt"):
            try:
                a = adjust(
                    self.network,
                    start,
                    datum=self.datum,
                    reject="none",
                    covariance=False,
                    options=AdjustmentOptions(
                        image_sigma_factor=self.factor,
                        method=method,
                        max_iterations=MAX_ITERATIONS,
                        tolerance=tolerance,
                    ),
                )
            except GeometryError:
                continue
            if not np.isfinite(a.vPv) or a.rejected.any():
                continue
            if a.converged:
                return a
            adjusted.append(a)
        return min(adjusted, key=lambda adjustment: adjustment.vPv, default=None)

    def candidates(
        self, result: Estimate, others: tuple[Estimate, ...], vPv: float, limit: float, *, follow_c: bool
    ) -> Iterator[_Candidate]:
        """Yield solutions of similar v'Pv along c, and minima beyond them."""
        free = [camera.free for camera in result.cameras]
        steps = STEPS if follow_c or any(flags[0] for flags in free) else 0
        starts = [result, *others]
        if self.datum.kind != "control":
            starts.append(reverse_depth(result))
        for start in starts:
            first, minima = self.adjusted(start, held=steps > 0), {}
            for direction in (STEP, 1 / STEP) if steps else (1.0,):
                track = self._along(start, first, direction, steps, vPv)
                heights = [point.vPv for point in track]
                for k, point in enumerate(track):
                    if point.vPv <= limit * vPv:
                        yield _Candidate(_with_free(point.estimate, free), point.vPv)
                    if heights[k] <= min(heights[max(k - 1, 0) : k + 2]) and (k or start is not result):
                        minima[direction**k] = point.estimate
            for estimate in minima.values():
                ended = self.adjusted(_with_free(estimate, free))
                if ended is not None and ended.converged:
                    yield _Candidate(_with_free(ended.estimate, free), ended.vPv)

    def _along(
        self, start: Estimate, first: Adjustment | None, factor: float, steps: int, vPv: float
    ) -> list[_Candidate]:
        """Follow the network with c held at multiples of its start value, while v'Pv is not too large.

        Each step starts from the previous one, which stays in one valley, and also from the start, which
        finds other valleys. The result with the smaller v'Pv is used.

        Args:
            start: the start values.
            first: their adjustment.
            factor: ratio of successive principal distances.
            steps: number of further principal distances.
            vPv: that of the result.
        """
        track: list[_Candidate] = []
        lowest = first
        for k in range(1, steps + 2):
            if lowest is None:
                break
            track.append(_Candidate(lowest.estimate, lowest.vPv))
            if k > steps or lowest.vPv > BARRIER * vPv:
                break
            starts = [scale_estimate(lowest.estimate, factor), scale_estimate(start, factor**k)][: min(k, 2)]
            ended = [self.adjusted(start, held=True) for start in starts]
            lowest = min(
                (adjustment for adjustment in ended if adjustment is not None),
                key=lambda adjustment: adjustment.vPv,
                default=None,
            )
        return track


def _with_free(estimate: Estimate, free: list[BoolArray]) -> Estimate:
    """Return the estimate with the given parameters of its cameras free."""
    cameras = tuple(replace(camera, free=freed) for camera, freed in zip(estimate.cameras, free, strict=True))
    return replace(estimate, cameras=cameras)


def scale_estimate(estimate: Estimate, factor: float) -> Estimate:
    """Return the estimate with c and the distances of photographs from the object multiplied.

    Args:
        estimate: the estimate.
        factor: factor on c and the distances.
    """
    cameras = []
    for camera in estimate.cameras:
        p = camera.parameters.copy()
        p[camera.parts[0]] *= factor
        cameras.append(camera.with_parameters(p))
    centre = estimate.points.mean(axis=0)
    return replace(estimate, cameras=tuple(cameras), position=centre + factor * (estimate.position - centre))


@dataclass(frozen=True)
class _Place:
    """The result that other solutions are compared with, in its standard deviations."""

    adjustment: Adjustment
    sigma: FloatArray  # standard deviation of a coordinate of each point, (n,)

    def describe(self, other: Estimate, vPv: float) -> OtherSolution:
        """Return the description of another solution by its differences from the result."""
        result = self.adjustment.estimate
        free = (k for k, lens in enumerate(result.cameras) if lens.free[lens.parts[0]].any())
        number = next(free, 0)  # the first camera with free c, otherwise the first camera
        camera = other.cameras[number]
        c, sigma = float(camera.parameters[0]), float(self.adjustment.interior_sigma(number)[0])
        return OtherSolution(
            camera.name,
            c,
            camera.units[0],
            reflected=bool(abs(np.log(c / result.cameras[number].parameters[0])) < np.log(STEP) / 2),
            moved=self.distance(other, result),
            c_moved=abs(c - result.cameras[number].parameters[0]) / sigma if sigma > 0 else 0.0,
            vPv=vPv,
            estimate=other,
            converges=False,
        )

    def distance(self, first: Estimate, other: Estimate) -> float:
        """Return the RMS difference of the points of two solutions after a similarity, over their sigmas."""
        known = np.isfinite(self.sigma) & (self.sigma > 0)
        if known.sum() < 3:
            return 0.0
        points, others, sigma = first.points[known], other.points[known], self.sigma[known]
        try:
            placed = fit_similarity(points, others, weights=1 / sigma**2)
        except GeometryError:
            return np.inf
        off = (placed.apply(points) - others) / sigma[:, None]
        return float(np.sqrt((off**2).mean()))
