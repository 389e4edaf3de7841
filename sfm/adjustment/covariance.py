"""Covariance of any subset of the unknowns of a finished adjustment, in any datum.

`marginal_of` forms the normal equations once more at the solution and gives joint covariances. A change of
datum keeps the coordinates and transforms their covariance by an S-transformation.

`local_of` prepares a network for computing, and `LocalNetwork` converts the result back. Coordinates far from
the origin are reduced to the centroid: near 5e6 m a double has steps of 1e-9 m, more than the change at which
the iteration of a close-range network has converged. The points of a large network are sorted along a
space-filling curve, so the points of a photograph lie close together in memory. Sums over 646,000 image
points then take a third of the time.

Source: Baarda (1973), S-transformations and criterion matrices; Luhmann et al., Close-Range Photogrammetry
(2020), sec. 2.2.2; Morton (1966), A computer oriented geodetic data base and a new technique in file
sequencing, IBM.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from sfm.adjustment.datum import Datum, ResolvedDatum, motions_of, without_far_points
from sfm.adjustment.engine.cofactors import (
    Cofactors,
    cofactors,
    largest_fixed,
    marginal_covariance,
    without_held,
)
from sfm.adjustment.engine.correlated import (
    CorrelatedPart,
    Influence,
    correlated_part,
    influence_of,
    largest_factor,
    whitening_matrices,
)
from sfm.adjustment.engine.iterate import Optimum, optimum_at, problem_of
from sfm.adjustment.engine.observed import ObservedKind, observed_of
from sfm.adjustment.engine.unknowns import Unknowns, unknowns_of
from sfm.adjustment.quality.rank import reduced_names
from sfm.adjustment.result import Adjustment, Covariance, ErrorCorrelation
from sfm.model.arguments import checked_arguments
from sfm.model.camera import KNOWN_WITHOUT, pixel_from_rays, rays_from_pixel
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.observations.pose import exterior_jacobian
from sfm.runtime.threads import own_threads

# Distance from the origin, in extents of the network, at which an axis is reduced: three digits are lost.
MAX_EXTENTS = 1000.0
# Bound of the factor of variances up to which it takes the place of the propagation of correlated errors,
# which takes most of the time of many photographs. Standard deviations are then too large by 10 % at most,
# less than the 15 % to which residuals tell the correlation (tests/adjustment/test_error_correlation.py).
MOST_FACTOR = 1.1**2
MIN_SORTED_POINTS = 5000  # number of points from which order matters; fewer stay in the cache
LEVELS = 10  # levels of the curve: each axis is cut into 2^10 parts


@dataclass(frozen=True)
class Marginal:
    """A finished adjustment with its normal equations at the solution."""

    adjustment: Adjustment
    layout: Unknowns
    observed: tuple[ObservedKind, ...]
    optimum: Optimum
    cofactors: Cofactors

    def names(self) -> list[tuple[str, str]]:
        """Return (parameter, owner) of each reduced unknown: exterior orientation, then interior ones."""
        return reduced_names(self.layout, self.adjustment.network, self.adjustment.estimate)

    @cached_property
    def influence(self) -> Influence:
        """Effect of errors of image points on the unknowns."""
        weight = np.ascontiguousarray(self.adjustment.weights[self.layout.order])
        return influence_of(self.optimum, self.layout, weight)

    @cached_property
    def correlated(self) -> CorrelatedPart | None:
        """Part of the covariance due to correlated errors; None if errors are independent, or nearly."""
        a = self.adjustment
        if a.error_correlation is None or np.isfinite(self.variance_factor):
            return None
        which = a.network.may_correlate[self.layout.order]
        return correlated_part(self.influence, a.error_correlation, a.usual_px, which)

    @cached_property
    def variance_factor(self) -> float:
        """Factor of all variances in place of their part due to correlated errors; infinite if that is large.

        It is a bound, so that no variance is stated too small.
        """
        a, layout = self.adjustment, self.layout
        if a.error_correlation is None:
            return 1.0
        weight = np.ascontiguousarray(a.weights[layout.order])
        relative = a.usual_px * whitening_matrices(layout.observations, weight)
        which = a.network.may_correlate[layout.order]
        return largest_factor(layout.observations, relative, a.error_correlation, which, MOST_FACTOR)

    def of_independent_errors(self, factor: float = 1.0) -> Covariance:
        """Return the covariance of points, exterior and interior orientation without the correlated part.

        Args:
            factor: factor of all variances.
        """
        variance = factor * self.adjustment.sigma0**2
        marginal = marginal_covariance(self.optimum, self.layout, self.cofactors, variance)
        return without_held(marginal, self.layout, self.optimum)

    def covariance(self) -> Covariance:
        """Return the marginal covariances of points, exterior and interior orientation."""
        if self.correlated is None:
            return self.of_independent_errors(self.variance_factor)
        variance = self.adjustment.sigma0**2
        return self.correlated.added_to(self.of_independent_errors(), variance, self.optimum)

    def joint(self, unknowns: IntArray, points: IntArray) -> FloatArray:
        """Return the joint covariance of some reduced unknowns and some object points.

        Args:
            unknowns: indices into `names`; for a photograph these are X0 and a small rotation in its axes.
            points: indices of object points.

        Returns:
            Covariance of the unknowns and then X, Y, Z of each point, shape (u + 3 p, u + 3 p).
        """
        Q, motions = self.cofactors, self.optimum.motions
        first, u = self.layout.kept_start, len(unknowns)
        rows = (3 * np.asarray(points)[:, None] + np.arange(3)).ravel()
        E = np.zeros((self.layout.reduced, u + len(rows)))
        E[unknowns, np.arange(u)] = 1.0
        # each dx as a linear function of the reduced unknowns: an unknown itself, or -L^-T Y' for a point
        E[:, u:] = -self.optimum.equations.through(np.asarray(points))
        for s, j in enumerate(points):
            kept = np.flatnonzero(self.layout.kept == j)
            if len(kept):
                place = first + 3 * int(kept[0])
                E[:, u + 3 * s : u + 3 * s + 3] = 0.0
                E[place : place + 3, u + 3 * s : u + 3 * s + 3] = np.eye(3)
        E *= self.layout.reduced_free()[:, None]
        E[:, u:] *= self.layout.point_free[points].ravel()
        cofactor = E.T @ self.optimum.factor.solve(E)
        for s, j in enumerate(points):
            at = slice(u + 3 * s, u + 3 * s + 3)
            cofactor[at, at] = Q.points[j]
        d = len(motions.inverse)
        H = np.vstack([motions.reduced[unknowns], motions.points[points].reshape(len(rows), d)])
        F = np.hstack(
            [
                Q.F_reduced[:, unknowns],
                np.moveaxis(Q.F_points[points], 1, 0).reshape(d, len(rows)),
            ]
        )
        half = H @ F
        cofactor -= half
        cofactor -= half.T
        del half  # each term is as large as the whole covariance
        cofactor += H @ Q.G @ H.T
        if self.correlated is None:
            cofactor *= self.variance_factor
        else:
            cofactor += self.correlated.joint(unknowns, np.asarray(points))
        largest = largest_fixed(self.optimum, self.layout, Q)[points].ravel()
        fixed = u + np.flatnonzero(np.diagonal(cofactor)[u:] <= largest)
        cofactor[fixed] = 0.0
        cofactor[:, fixed] = 0.0
        cofactor *= self.adjustment.sigma0**2
        return np.asarray(cofactor)


class JointOnDemand:
    """Joint covariances of an adjustment; the normal equations are formed at the first call."""

    def __init__(self, adjustment: Adjustment) -> None:
        """Keep the adjustment that `adjust` returned."""
        self._adjustment = adjustment

    @cached_property
    def _marginal(self) -> Marginal:
        return marginal_of(self._adjustment, cross=False)

    def __call__(self, points: IntArray, images: IntArray) -> FloatArray:
        """Return the joint covariance of points and photographs.

        Args:
            points: indices of points, (p,).
            images: indices of photographs, (m,).

        Returns:
            Covariance of X, Y, Z of each point, then X0, Y0, Z0, omega, phi, kappa of each photograph, object
            unit and rad, (3 p + 6 m, 3 p + 6 m).

        Raises:
            GeometryError: the normal equations cannot be solved.
        """
        with own_threads():
            m, p = self._marginal, 3 * len(points)
            chosen = np.asarray(images, dtype=np.int64)
            columns, by = m.layout.photograph_terms(m.optimum.state, chosen)
            joint = m.joint(columns.ravel(), np.asarray(points))
        u = columns.size
        J = block_diag(np.zeros((0, 0)), *(exterior_jacobian(m.optimum.state.M[chosen]) @ by))
        ordered = np.empty((p + len(J), p + len(J)))
        ordered[:p, :p] = joint[u:, u:]
        ordered[p:, :p] = J @ joint[:u, u:]
        ordered[:p, p:] = ordered[p:, :p].T
        ordered[p:, p:] = J @ joint[:u, :u] @ J.T
        return ordered


@checked_arguments()
def marginal_of(adjustment: Adjustment, *, datum: Datum | None = None, cross: bool = True) -> Marginal:
    """Return a finished adjustment with its normal equations at the solution.

    Args:
        adjustment: result of `adjust`.
        datum: another datum, with control only if the adjustment has it; that of the adjustment if None.
        cross: whether to compute cofactors between points and photographs.

    Raises:
        GeometryError: a change between a datum with control and one without.
    """
    use_control = adjustment.datum == "control"
    resolved = ResolvedDatum(adjustment.datum, adjustment.datum_points)
    if datum is not None:
        resolved = _resolved(datum, adjustment)
    if (resolved.kind == "control") != use_control:
        raise GeometryError(
            "datum: adding or removing control is another adjustment, not an S-transformation"
        )
    centroid = centroid_of(adjustment.network, adjustment.estimate)
    network, estimate = shifted(adjustment.network, adjustment.estimate, -centroid)
    layout, state = unknowns_of(
        network, estimate, use_control=use_control, image_sigma_factor=adjustment.image_sigma_factor
    )
    observed = observed_of(network, layout, state, use_control=use_control)
    weight = np.ascontiguousarray(adjustment.weights[layout.order])
    optimum = optimum_at(problem_of(layout, observed, resolved), state, weight)
    if optimum is None:
        motions_of(layout, observed, state, resolved)  # raises if the datum is the reason
        raise GeometryError("adjustment: its normal equations cannot be solved")
    return Marginal(adjustment, layout, observed, optimum, cofactors(optimum, layout, cross=cross))


@checked_arguments()
def change_datum(adjustment: Adjustment, datum: Datum | str) -> Adjustment:
    """Transform an adjustment into another datum by an S-transformation, without adjusting again.

    `adjust` in this datum, with the adjusted coordinates as approximate values, gives the same result. The
    coordinates, residuals, tests and all else that is independent of the datum stay. Only the covariance
    changes.

    Args:
        adjustment: result of `adjust`.
        datum: free or minimal, on all points or on some given by name, index or mask; or only its kind.

    Raises:
        GeometryError: a change between a datum with control and one without, unknown points, or points that
            cannot carry the datum.

    Example:
        >>> import sfm
        >>> sfm.change_datum(result.adjustment, sfm.Datum("minimal", points=["1", "2", "3"])).datum
        'minimal'

    Source: Baarda (1973), S-transformations and criterion matrices.
    """
    datum = Datum(datum) if isinstance(datum, str) else datum
    if not isinstance(adjustment, Adjustment):
        raise GeometryError(f"change_datum: {type(adjustment).__name__}, expected an Adjustment")
    with own_threads():
        m = marginal_of(adjustment, datum=datum, cross=False)
        changed = _with_covariance(m)
    kind, points = _resolved(datum, adjustment)
    return replace(changed, datum=kind, datum_points=points)


def _resolved(datum: Datum, adjustment: Adjustment) -> ResolvedDatum:
    """Return a datum on the points of an adjustment."""
    return without_far_points(datum.resolve(adjustment.network), adjustment.estimate.points)


@checked_arguments()
def with_error_correlation(adjustment: Adjustment, correlation: ErrorCorrelation) -> Adjustment:
    """Return the adjustment with a covariance for correlated errors of neighbouring image points.

    The estimate is still that for independent errors. Residuals and tests do not change either.

    Args:
        adjustment: result of `adjust`.
        correlation: correlation of the errors, such as `estimate_error_correlation` finds in the residuals.

    Source: Koch (1999), Parameter Estimation and Hypothesis Testing in Linear Models, sec. 3.2.
    """
    correlated = replace(adjustment, error_correlation=correlation)
    with own_threads():
        return _with_covariance(marginal_of(correlated, cross=False))


def _with_covariance(m: Marginal) -> Adjustment:
    """Return the adjustment with the covariance in the datum of the marginal."""
    independent = None if m.adjustment.error_correlation is None else m.of_independent_errors()
    return replace(m.adjustment, covariance=m.covariance(), independent=independent, judge=None)


def determines_cameras(marginal: Marginal) -> bool:
    """Return whether a network determines its cameras well enough for linear error propagation.

    The criterion is how far a joint error of one standard deviation in the free parameters moves image
    points.

    Args:
        marginal: adjustment with its normal equations.
    """
    a, none = marginal.adjustment, np.zeros(0, dtype=np.int64)
    seen = a.network.image_points.select(~a.rejected)
    for k, camera in enumerate(a.estimate.cameras):
        xy = seen.xy[a.network.camera[seen.image] == k]
        covariance = marginal.joint(marginal.layout.interior_column[k], none)
        sigma = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        if not len(xy) or not sigma.all():
            continue
        rays = rays_from_pixel(camera, xy)
        moved = np.empty((len(sigma), *xy.shape))
        for n, s in enumerate(marginal.layout.interior_free[k]):
            parameters = camera.parameters.copy()
            parameters[s] += sigma[n]
            moved[n] = pixel_from_rays(camera.with_parameters(parameters), rays) - xy
        correlation = covariance / np.outer(sigma, sigma)
        shift = np.sqrt(np.einsum("st,skx,tkx->k", correlation, moved, moved).max())
        reach = np.linalg.norm(xy - (np.array(camera.size_px) - 1) / 2, axis=1).max()
        if not shift <= KNOWN_WITHOUT * reach:
            return False
    return True


@dataclass(frozen=True)
class LocalNetwork:
    """A network prepared for computing, with its relation to the given network."""

    network: Network
    estimate: Estimate
    datum: ResolvedDatum
    given: Network
    centroid: FloatArray  # subtracted from the coordinates of the given network, object unit, (3,)
    order: IntArray | None  # given points in the order of this network, None if unchanged, (n,)

    def back(self, result: Adjustment) -> Adjustment:
        """Convert an adjustment of this network to one of the given network.

        Args:
            result: adjustment of this network.
        """
        if self.order is not None:
            place = np.argsort(self.order)
            covariance = result.covariance
            result = replace(
                result,
                estimate=replace(result.estimate, points=result.estimate.points[place]),
                covariance=replace(
                    covariance,
                    points=covariance.points[place],
                    points_limiting=covariance.points_limiting[place],
                ),
                datum_points=None if result.datum_points is None else result.datum_points[place],
            )
        estimate = result.estimate
        if self.centroid.any():
            _, estimate = shifted(self.given, estimate, self.centroid)
        return replace(result, network=self.given, estimate=estimate)


def local_of(network: Network, estimate: Estimate, datum: ResolvedDatum) -> LocalNetwork:
    """Prepare a network for computing: reduce its coordinates and sort its points where that pays.

    Args:
        network: the given network.
        estimate: its start values.
        datum: its datum.
    """
    centroid = centroid_of(network, estimate)
    local, start = network, estimate
    if centroid.any():
        local, start = shifted(network, estimate, -centroid)
    order = None
    if len(network.points) >= MIN_SORTED_POINTS:
        order = along_curve(start.points)
        local, start, datum = _renumber_points(local, start, datum, order)
    return LocalNetwork(local, start, datum, network, centroid, order)


def along_curve(points: FloatArray) -> IntArray:
    """Return the order of points along Morton's curve, points without coordinates last.

    Args:
        points: object points, NaN where unknown, shape (n, 3).
    """
    known = np.isfinite(points).all(axis=1)
    key = np.full(len(points), np.iinfo(np.int64).max)
    if known.any():
        cloud = points[known] - points[known].min(axis=0)
        cells = (cloud * ((2**LEVELS - 1) / max(float(cloud.max()), np.finfo(float).tiny))).astype(np.int64)
        code = np.zeros(len(cells), dtype=np.int64)
        for level in range(LEVELS):
            for axis in range(3):
                code |= ((cells[:, axis] >> level) & 1) << (3 * level + axis)
        key[known] = code
    return np.argsort(key, kind="stable")


def _renumber_points(
    network: Network, estimate: Estimate, datum: ResolvedDatum, order: IntArray
) -> tuple[Network, Estimate, ResolvedDatum]:
    """Return network, estimate and datum with the points in another order."""
    place = np.argsort(order)
    renumbered = replace(
        network,
        points=tuple(network.points[j] for j in order),
        image_points=replace(network.image_points, point=place[network.image_points.point]),
        observations=tuple(kind.renumbered(place) for kind in network.observations),
    )
    if datum.points is not None:
        datum = datum._replace(points=datum.points[order])
    return renumbered, replace(estimate, points=estimate.points[order]), datum


def centroid_of(network: Network, estimate: Estimate) -> FloatArray:
    """Return the centroid to subtract from a network, 0 in each axis in which the origin is near, (3,).

    Args:
        network: network with the control.
        estimate: all other points and the projection centres; NaN where unknown.
    """
    control = network.control.xyz
    xyz = np.concatenate([estimate.points, estimate.position, control])
    known = xyz[np.isfinite(xyz).all(axis=1)]
    if len(known) == 0:
        return np.zeros(3)
    low, high = known.min(axis=0), known.max(axis=0)
    if max(high.max(), -low.min()) <= MAX_EXTENTS * (high - low).max() / 2:  # a lower bound of the extent
        return np.zeros(3)
    centre = np.median(known, axis=0)
    extent = np.abs(known - centre).max()
    # Far from the origin x - c is exact for all x between c / 2 and 2 c (Sterbenz), and so is its reversal.
    return np.where(np.abs(centre) > MAX_EXTENTS * extent, centre, 0.0)


def shifted(network: Network, estimate: Estimate, by: FloatArray) -> tuple[Network, Estimate]:
    """Shift all object coordinates of a network and an estimate.

    Args:
        network: the network.
        estimate: its estimate.
        by: shift, object unit, (3,).
    """
    moved = replace(
        network,
        observations=tuple(kind.shifted(by) for kind in network.observations),
    )
    return moved, replace(estimate, position=estimate.position + by, points=estimate.points + by)
