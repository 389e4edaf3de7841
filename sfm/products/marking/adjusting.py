"""Adjustment of the marks: residuals, sigma0, and the mark that fits least.

Everything that marks determine is adjusted together. The free parameters of the cameras are observed: as
well as they are known of any camera, so that few marks bend nothing, and many determine them. Data snooping
rejects marks; where it would reject many, few marks are too good to be tested, and all take part. The mark
that contradicts is the one without which all others fit best. If none does, the one with the largest test
value fits least. Predicted places follow from the joint covariance of points, photographs and cameras.

Source: Baarda (1968) for the test; Foerstner and Wrobel (2016), sec. 3.2, for the joint covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sfm.adjustment.covariance import Marginal, marginal_of
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.camera import (
    KNOWN_WITHOUT,
    Camera,
    corner_shift,
    parameter_jacobian,
    pixel_from_rays,
    ray_jacobian,
)
from sfm.model.conventions import BoolArray, FloatArray, IntArray, skew
from sfm.model.distortion.models import Role
from sfm.model.distributions import chi2_isf, f_isf, level_of_single, normal_ppf, t_ppf
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import InteriorObservations, Network
from sfm.model.reduced_network import merge_estimate, reduce_network
from sfm.products.marking.orienting import MIN_KNOWN, determined_part
from sfm.survey.free_parameters import C_SIGMA

CONTAINED = 0.05  # probability that a place is outside its ellipse
MOST_DOUBTED = 4  # marks that are left out for trial
MAX_STEPS, TOLERANCE = 40, 1e-3  # marks that were only begun determine some parameters hardly at all
MOST_REJECTED = 0.1  # of the marks; measured marks are hardly ever wrong
PRIOR_REDUNDANCY = 10.0  # with which the stated standard deviations count against the residuals of few marks


@dataclass(frozen=True)
class WorstMark:
    """The mark that fits least."""

    photograph: str
    point: str
    test: float  # its largest |w|
    flagged: bool  # whether the test rejects it


@dataclass(frozen=True)
class MarkAdjustment:
    """Adjustment of the part of a network that marks determine."""

    adjustment: Adjustment
    estimate: Estimate  # of the whole network, NaN outside the part
    images: BoolArray  # photographs in the adjustment, (m,)
    points: BoolArray  # points in the adjustment, (n,)
    rows: IntArray  # image points of the network in the adjustment, in its order
    named: int | None = None  # of these, the one that contradicts the others

    @property
    def worst(self) -> WorstMark | None:
        """The mark that fits least, if the redundancy allows a test."""
        a = self.adjustment
        if a.redundancy <= 0 or not len(a.standardised):
            return None
        test = np.nanmax(np.where(np.isfinite(a.standardised), np.abs(a.standardised), 0.0), axis=1)
        k = int(np.argmax(test)) if self.named is None else self.named
        seen = a.network.image_points
        return WorstMark(
            a.network.images[seen.image[k]],
            a.network.points[seen.point[k]],
            float(test[k]),
            self.named is not None and a.converged,  # else residuals are not those of an optimum
        )

    @property
    def variance_factor(self) -> float:
        """Factor on cofactors: the residuals, and as long as there are few, the stated precision.

        It is as much larger as a sigma0 from this redundancy makes regions of 95 %.
        """
        a = self.adjustment
        r = float(np.nansum(a.redundancy_numbers)) if a.redundancy > 0 else 0.0  # of the marks alone
        vPv = a.image_sigma0**2 * r if r > 0 else 0.0
        r += PRIOR_REDUNDANCY
        wider = 2 * float(f_isf(CONTAINED, 2, r)) / float(chi2_isf(CONTAINED, 2))
        return (PRIOR_REDUNDANCY + vPv) / r * wider

    @cached_property
    def joint(self) -> JointPrecision | None:
        """Joint precision of what was adjusted; None if the normal equations cannot be solved."""
        try:
            return JointPrecision(self)
        except (GeometryError, np.linalg.LinAlgError):
            return None


def adjust_marks(
    network: Network,
    estimate: Estimate,
    cameras: tuple[Camera, ...],
    *,
    in_control: bool,
    false_alarm: float,
) -> MarkAdjustment | None:
    """Return the adjustment of everything that marks determine; None if that is nothing yet.

    Args:
        network: marks, control and scale bars.
        estimate: what is oriented.
        cameras: what is known of the cameras; they state which parameters are free.
        in_control: whether the estimate is in the frame of the control.
        false_alarm: probability that a right set of marks is called wrong.
    """
    images, points, used = determined_part(network, estimate)
    if not images.any():
        return None
    part, start = reduce_network(network, estimate, images, points, used)
    control = in_control and len(part.control.complete) >= MIN_KNOWN
    part = part.with_given(_observed_cameras(part, cameras))
    options = AdjustmentOptions(method="gauss-newton", max_iterations=MAX_STEPS, tolerance=TOLERANCE)

    def adjusted(values: Estimate, reject: str, rejected: BoolArray | None = None) -> Adjustment | None:
        try:
            adjustment = adjust(
                part,
                values,
                datum="control" if control else "free",
                reject=reject,
                false_alarm=false_alarm,
                rejected=rejected,
                options=options,
            )
        except (GeometryError, np.linalg.LinAlgError):
            return None
        determined = not adjustment.undetermined and bool(adjustment.estimate.oriented.all())
        return adjustment if determined else None

    everything = adjusted(start, "none")
    if everything is None:
        return None
    chosen, named = everything, None
    if _is_doubtful(everything, false_alarm):
        robust = adjusted(start, "huber") or everything
        named = _contradicting(part, robust, options)
        without = np.zeros(len(everything.rejected), dtype=bool)
        without[[] if named is None else named] = True
        tested = adjusted(robust.estimate, "tau", without)
        most = max(1, MOST_REJECTED * len(without))
        if tested is not None and tested.converged and 0 < tested.rejected.sum() <= most:
            chosen = tested
            if named is None or not tested.rejected[named]:
                test = np.nan_to_num(np.abs(tested.standardised)).max(axis=1)
                named = int(np.argmax(np.where(tested.rejected, test, -1.0)))
    whole = merge_estimate(chosen.estimate, images, points)
    return MarkAdjustment(chosen, whole, images, points, np.flatnonzero(used), named)


def _contradicting(network: Network, adjustment: Adjustment, options: AdjustmentOptions) -> int | None:
    """Return the image point without which all others fit best, of those that fit least and the same points.

    The test values of the image points of one point are correlated, and those of a gross error are not
    linear.
    """
    seen = network.image_points
    test = np.nan_to_num(np.abs(adjustment.standardised)).max(axis=1)
    first = np.argsort(-test)[:MOST_DOUBTED]
    doubted = np.union1d(first, np.flatnonzero(seen.point == seen.point[first[0]]))
    best: tuple[float, int] | None = None
    for k in doubted.tolist():
        kept = np.arange(len(seen)) != k
        other = replace(network, image_points=seen.select(kept))
        images, points, used = determined_part(other, adjustment.estimate)
        if not images.all():
            continue
        part, start = reduce_network(other, adjustment.estimate, images, points, used)
        try:
            without = adjust(
                part, start, datum=adjustment.datum, reject="none", covariance=False, options=options
            )
        except (GeometryError, np.linalg.LinAlgError):
            continue
        if without.redundancy > 0 and np.isfinite(without.sigma0):
            best = min(best or (np.inf, k), (without.sigma0, k))
    return None if best is None else best[1]


def _is_doubtful(adjustment: Adjustment, false_alarm: float) -> bool:
    """Return whether the test of all marks together rejects one, by Pope's tau and by Baarda's w.

    Residuals of marks that fit far better than stated differ, and contradict nothing.
    """
    r = adjustment.redundancy
    if r < 2 or not adjustment.sigma0 > 0:
        return False
    level = level_of_single(false_alarm, adjustment.standardised.size)
    if not np.nanmax(np.abs(adjustment.standardised)) > normal_ppf(1 - level / 2):
        return False
    t = float(t_ppf(1 - level / 2, r - 1))
    limit = t * np.sqrt(r) / np.sqrt(r - 1 + t * t)
    return bool(np.nanmax(np.abs(adjustment.tau)) > limit)


def _observed_cameras(network: Network, cameras: tuple[Camera, ...]) -> InteriorObservations:
    """Return the free parameters of the cameras of a network, with what is known of any camera."""
    rows = []
    for a in np.unique(network.camera).tolist():
        camera = cameras[a]
        focal = camera.plays(Role.FOCAL)
        for s in np.flatnonzero(camera.free).tolist():
            value, unit = float(camera.parameters[s]), 1e-6
            sigma = unit * KNOWN_WITHOUT / max(corner_shift(camera, s, unit), 1e-12)
            rows.append((a, s, value, C_SIGMA * abs(value) if focal[s] else sigma))
    columns = list(zip(*rows, strict=True)) or [(), (), (), ()]
    return InteriorObservations(
        np.array(columns[0], dtype=np.int64),
        np.array(columns[1], dtype=np.int64),
        np.array(columns[2], dtype=float),
        np.array(columns[3], dtype=float),
    )


class JointPrecision:
    """Joint covariance of poses, interior orientation and points of an adjustment of marks.

    A place is a function of the unknowns: X0 and a small rotation of its photograph, free parameters of its
    camera, and its point.
    """

    def __init__(self, marks: MarkAdjustment) -> None:
        """Compute the covariance.

        Args:
            marks: the adjustment.

        Raises:
            GeometryError: the normal equations cannot be solved.
        """
        self._marks, a = marks, marks.adjustment
        m: Marginal = marginal_of(a, cross=False)
        self._layout = m.layout
        count = len(a.network.images)
        columns, self._by = m.layout.photograph_terms(m.optimum.state, np.arange(count))
        self._interior = [np.asarray(column, dtype=np.int64) for column in m.layout.interior_column]
        unknowns = np.concatenate([columns.ravel(), *self._interior])
        self._width = columns.shape[1]
        self._first = np.cumsum([columns.size, *(len(column) for column in self._interior)])
        self.size = len(unknowns)
        everything = m.joint(unknowns, np.arange(len(a.network.points)))
        sigma0 = a.sigma0 if a.sigma0 > 0 and np.isfinite(a.sigma0) else 1.0
        self._covariance = everything * (marks.variance_factor / sigma0**2)
        self._image = np.cumsum(marks.images) - 1
        self._point = np.cumsum(marks.points) - 1

    def of_unknowns(
        self, i: int, camera: int, X: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Return where a photograph shows a point, and its derivatives; None if it does not.

        Args:
            i: index of a photograph of the whole network, which is in the adjustment.
            camera: its camera.
            X: object point, (3,).

        Returns:
            Place, px, (2,); derivatives by the unknowns without points, (2, u), and by X, (2, 3).
        """
        estimate = self._marks.estimate
        lens, R = estimate.cameras[camera], estimate.rotation[i]
        U = R.T @ (X - estimate.position[i])
        xy = pixel_from_rays(lens, U[None])
        if not np.isfinite(xy).all():
            return None
        by_U = ray_jacobian(lens, xy, U[None])[0]
        by_X = by_U @ R.T
        by_pose = np.hstack([-by_X, by_U @ skew(U[None])[0]])
        by = np.zeros((2, self.size))
        k, width = int(self._image[i]), self._width
        by[:, k * width : (k + 1) * width] = by_pose @ self._by[k]
        free = self._layout.interior_free[camera]
        if len(self._interior[camera]):
            first = int(self._first[camera])
            by[:, first : first + len(free)] = parameter_jacobian(lens, U[None])[0][:, free]
        return xy[0], by, by_X

    def of_adjusted(self, j: int, by: FloatArray, by_X: FloatArray) -> FloatArray:
        """Return the covariance of a place of an adjusted point, px^2, (2, 2).

        Args:
            j: index of the point in the whole network.
            by: derivatives by the unknowns, (2, u).
            by_X: derivatives by the point, (2, 3).
        """
        at = self.size + 3 * int(self._point[j])
        rows = np.concatenate([np.arange(self.size), np.arange(at, at + 3)])
        J = np.hstack([by, by_X])
        return np.asarray(J @ self._covariance[np.ix_(rows, rows)] @ J.T)

    def of_new(self, J: FloatArray) -> FloatArray:
        """Return the covariance of a place that depends on the unknowns alone, px^2, (2, 2)."""
        return np.asarray(J @ self._covariance[: self.size, : self.size] @ J.T)
