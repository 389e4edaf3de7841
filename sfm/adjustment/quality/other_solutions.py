"""Other solutions of the same image points: principal distances tried from a fraction to a multiple.

In weak networks the sum of squares has several minima: of few photographs with small angles c and the
distance go together, and relief or tilt can be turned inside out as in a drawing of a cube. Each minimum has
a small standard deviation, which does not show the others. The network is therefore followed
along c in both directions, from the result and from its reflection in depth, with c held; where v'Pv is as
small as that of the result, or at a minimum, c is freed and the network adjusted.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.8 (approximate values); Luhmann
et al., Close-Range Photogrammetry (2020), sec. 7.3.2 (correlated interior and exterior orientation); Szeliski
and Kang (1997), IEEE PAMI 19(5), for the reversal of depth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.iterate import TOLERANCE
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray
from sfm.distributions import f_isf
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.similarity import fit_similarity, reverse_depth

STEP = 1.3  # from one principal distance that is tried to the next
STEPS = 6  # in each direction: c from a fifth to the fivefold
ALPHA = 0.001  # chance of so much larger a v'Pv where the other solution is the true one
STATED_FREEDOM = 10  # observations that the stated weights count as in the estimate of the variance
WEAK_C = 5e-4  # relative standard deviation of c below which a network is not weak, and
MIN_STRONG_PHOTOGRAPHS = 5  # from so many photographs on
MIN_STRONG_IMAGE_POINTS = 4000  # image points from which on a network is not weak
BARRIER = 3e3  # times v'Pv of the result: what lies beyond is not looked for
MIN_APART_SIGMAS = 1.0  # root mean square between solutions that are not the same
MAX_ITERATIONS = 60  # from planes, whose relief is to be found, some fifty
FOLLOWING_TOLERANCE = 1e-3  # |A dx| / |v| at which the network is followed to the next c


@dataclass(frozen=True)
class OtherSolution:
    """A solution that the image points allow as well as the result, or better."""

    camera: str  # the first one whose c is free
    c: float  # its principal distance there, mm or px
    unit: str  # of c
    reflected: bool  # whether it is another one than the result in depth rather than in c
    moved: float  # by how much points differ, over their standard deviations in the result, RMS
    c_moved: float  # by how much c differs, over its standard deviation in the result; 0 of a c that is held
    vPv: float  # over that of the result
    estimate: Estimate
    converges: bool  # whether an adjustment of all observations from there ends


def other_solutions(
    adjustment: Adjustment, *, starts: tuple[Estimate, ...] = (), had_to_be_held: tuple[str, ...] = ()
) -> tuple[OtherSolution, ...]:
    """Return other solutions of about the same v'Pv, and better ones, the smallest v'Pv first.

    Args:
        adjustment: the result, with its covariance.
        starts: approximate values of other solutions that are looked for besides.
        had_to_be_held: cameras whose c is held because the adjustment does not converge with it; it is tried
            at other values, and freed again from a better one.

    Returns:
        None of them where the network is strong, the result did not converge, or nothing is redundant.
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
    limit = 1 + _allowed(base) / base.vPv
    result = _Place(a)
    found: list[OtherSolution] = []
    tried = search.candidates(a.estimate, starts, base.vPv, limit, follow_c=bool(had_to_be_held))
    for candidate in sorted(tried, key=lambda one: one.vPv):
        if _impossible(candidate.estimate, result.adjustment.estimate):
            continue
        known = any(result.distance(candidate.estimate, one.estimate) < MIN_APART_SIGMAS for one in found)
        if candidate.vPv > base.vPv * limit or known:
            continue
        one = result.describe(candidate.estimate, candidate.vPv / base.vPv)
        if one.moved > MIN_APART_SIGMAS:
            found.append(one)
    if found and found[0].vPv < 1:
        best = _with_c_freed(found[0].estimate, had_to_be_held)
        ended = search.adjusted(best, tolerance=TOLERANCE)
        if ended is not None and ended.converged:
            found[0] = replace(found[0], estimate=ended.estimate, converges=True)
    return tuple(found)


def _allowed(base: Adjustment) -> float:
    """Return by how much v'Pv of another solution may be larger.

    With hardly any redundancy v'Pv shows little of the weights, and any other solution would pass; they are
    believed as stated, with the weight of some observations.
    """
    freedom = base.redundancy + STATED_FREEDOM
    variance = (base.vPv + STATED_FREEDOM) / freedom
    return float(variance * f_isf(ALPHA, 1, freedom))


def _weak(a: Adjustment) -> bool:
    """Return whether there are few photographs, or a principal distance is not well determined."""
    if len(a.network.images) < MIN_STRONG_PHOTOGRAPHS:
        return True
    for number in set(a.network.camera.tolist()):
        camera = a.estimate.cameras[number]
        if camera.free[0] and not a.interior_sigma(number)[0] < WEAK_C * abs(camera.parameters[0]):
            return True
    return False


def _impossible(other: Estimate, result: Estimate) -> bool:
    """Return whether a solution has a principal point beyond its photograph, where no lens draws a picture.

    Of photographs that were cropped the result has it there too, or it is given.
    """
    pairs = zip(other.cameras, result.cameras, strict=True)
    return any(
        one.free[one.parts[1]].any() and _is_beyond(one) and not _is_beyond(ours) for one, ours in pairs
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
    factor: FloatArray  # on the standard deviations of the image points, (k,)

    def adjusted(
        self, start: Estimate, *, held: bool = False, tolerance: float = FOLLOWING_TOLERANCE
    ) -> Adjustment | None:
        """Return the adjustment, with c free or held; None where it has no solution.

        By Gauss-Newton, which in the bent valleys of weak networks takes a few steps where damping takes
        fifty; damped where that does not converge.
        """
        cameras = tuple(_with_c_held(camera) for camera in start.cameras) if held else start.cameras
        found: list[Adjustment] = []
        for method in ("gauss-newton", "levenberg-marquardt"):
            try:
                a = adjust(
                    self.network,
                    replace(start, cameras=cameras),
                    datum=self.datum,
                    image_sigma_factor=self.factor,
                    reject="none",
                    method=method,
                    max_iterations=MAX_ITERATIONS,
                    tolerance=tolerance,
                    covariance=False,
                )
            except GeometryError:
                continue
            if not np.isfinite(a.vPv) or a.rejected.any():
                continue
            if a.converged:
                return a
            found.append(a)
        return min(found, key=lambda one: one.vPv, default=None)

    def candidates(
        self, result: Estimate, others: tuple[Estimate, ...], vPv: float, limit: float, *, follow_c: bool
    ) -> Iterator[_Candidate]:
        """Return solutions and places of about the same v'Pv along c, and minima beyond them."""
        free = [camera.free for camera in result.cameras]
        steps = STEPS if follow_c or any(one[0] for one in free) else 0
        starts = [result, *others]
        if self.datum.kind != "control":
            starts.append(reverse_depth(result))
        for start in starts:
            for direction in (STEP, 1 / STEP) if steps else (1.0,):
                track = self._along(start, direction, steps, vPv)
                heights = [one.vPv for one in track]
                for k, one in enumerate(track):
                    lower = heights[k] <= min(heights[max(k - 1, 0) : k + 2])
                    if one.vPv <= limit * vPv:
                        yield _Candidate(_with_free(one.estimate, free), one.vPv)
                    if lower and (k or start is not result):
                        ended = self.adjusted(_with_free(one.estimate, free))
                        if ended is not None and ended.converged:
                            yield _Candidate(_with_free(ended.estimate, free), ended.vPv)

    def _along(self, start: Estimate, factor: float, steps: int, vPv: float) -> list[_Candidate]:
        """Follow the network with c held at multiples of the start's, while v'Pv is not too large.

        Each is adjusted from the one before it, which stays in one valley, and from the start, which finds
        others; the smaller v'Pv is taken.
        """
        track: list[_Candidate] = []
        estimate = start
        for k in range(steps + 1):
            starts = (scaled(estimate, factor), scaled(start, factor**k))[: min(k, 2)] or (start,)
            ended = [self.adjusted(one, held=steps > 0) for one in starts]
            found = min((one for one in ended if one is not None), key=lambda one: one.vPv, default=None)
            if found is None:
                break
            estimate = found.estimate
            track.append(_Candidate(estimate, found.vPv))
            if found.vPv > BARRIER * vPv:
                break
        return track


def _with_c_held(camera: Camera) -> Camera:
    free = camera.free.copy()
    free[camera.parts[0]] = False
    return replace(camera, free=free)


def _with_c_freed(estimate: Estimate, names: tuple[str, ...]) -> Estimate:
    cameras = []
    for camera in estimate.cameras:
        free = camera.free.copy()
        free[camera.parts[0]] |= camera.name in names
        cameras.append(replace(camera, free=free))
    return replace(estimate, cameras=tuple(cameras))


def _with_free(estimate: Estimate, free: list[BoolArray]) -> Estimate:
    """Return the estimate with these parameters of its cameras free."""
    cameras = tuple(replace(one, free=freed) for one, freed in zip(estimate.cameras, free, strict=True))
    return replace(estimate, cameras=cameras)


def scaled(estimate: Estimate, factor: float) -> Estimate:
    """Return the estimate with multiples of c, and photographs as many times as far from the object."""
    cameras = []
    for camera in estimate.cameras:
        p = camera.parameters.copy()
        p[camera.parts[0]] *= factor
        cameras.append(camera.with_parameters(p))
    centre = estimate.points.mean(axis=0)
    return replace(estimate, cameras=tuple(cameras), position=centre + factor * (estimate.position - centre))


@dataclass(frozen=True)
class _Place:
    """The result, from which others are so many standard deviations away."""

    adjustment: Adjustment

    def describe(self, other: Estimate, vPv: float) -> OtherSolution:
        """Return another solution as it differs from the result."""
        result, number = self.adjustment.estimate, self._number
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

    def distance(self, one: Estimate, other: Estimate) -> float:
        """Return by how many standard deviations of the result the points of two solutions differ, RMS."""
        return _apart(one.points, other.points, self._sigma)

    @cached_property
    def _sigma(self) -> FloatArray:
        variance: FloatArray = np.trace(self.adjustment.covariance.points, axis1=1, axis2=2) / 3
        return np.sqrt(variance)

    @cached_property
    def _number(self) -> int:
        """The first camera whose c is free, else the first."""
        cameras = self.adjustment.estimate.cameras
        return next((k for k, one in enumerate(cameras) if one.free[one.parts[0]].any()), 0)


def _apart(points: FloatArray, others: FloatArray, sigma: FloatArray) -> float:
    """Return the difference of two sets of points after a similarity over their sigmas (n,), RMS."""
    known = np.isfinite(sigma) & (sigma > 0)
    if known.sum() < 3:
        return 0.0
    try:
        placed = fit_similarity(points[known], others[known], weights=1 / sigma[known] ** 2)
    except GeometryError:
        return np.inf
    off = (placed.apply(points[known]) - others[known]) / sigma[known, None]
    return float(np.sqrt((off**2).mean()))
