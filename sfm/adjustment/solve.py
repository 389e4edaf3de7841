"""Bundle adjustment of a network: solution, statistics and covariance from start values.

`adjust` applies unified least squares to the collinearity equations, with self-calibration. It finds gross
errors by iterative data snooping or robust estimation, and determines the rank defect numerically. The final
normal equations are undamped. `predict` gives the same statistics for a planned network.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.covariance import JointOnDemand, LocalNetwork, local_of
from sfm.adjustment.datum import Datum, without_far_points
from sfm.adjustment.engine.cofactors import (
    Cofactors,
    cofactors,
    hat_complement,
    marginal_covariance,
    without_held,
)
from sfm.adjustment.engine.collinearity import State, residuals
from sfm.adjustment.engine.iterate import (
    METHODS,
    TOLERANCE,
    Optimum,
    Problem,
    optimum_at,
    problem_of,
)
from sfm.adjustment.engine.observed import count_of, observed_of
from sfm.adjustment.engine.unknowns import Unknowns, estimate_of, unknowns_of
from sfm.adjustment.quality.gross_errors.rejection import REJECTS, Run, find_optimum
from sfm.adjustment.quality.gross_errors.robust import (
    TUKEY,
    huber_slopes,
    inflation,
    tukey_slopes,
)
from sfm.adjustment.quality.rank import rank_defect, undetermined_of
from sfm.adjustment.quality.statistics import redundancy_numbers as numbers_of
from sfm.adjustment.quality.statistics import (
    residual_weights,
    residuals_of_observed,
    standardised_residuals,
)
from sfm.adjustment.result import Adjustment, Covariance
from sfm.model.arguments import checked_arguments, checked_fields
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.display import counted
from sfm.model.distortion.models import MODELS, Role
from sfm.model.distributions import FALSE_ALARM, Levels, level_of_single, normal_sf
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.reduced_network import check_network, check_number
from sfm.model.remarks.remark import Remark, remark
from sfm.runtime.threads import own_threads

FREE = Datum("free")
MIN_HOLD = 0.01  # largest weight of the image points of a photograph below which none of them fits
# Standard deviation of a principal distance over its value, beyond which it may have drifted and derivatives
# say little. Of nadir photographs of flat ground that converged it was 0.26 to 1.9.
MAX_LINEAR = 0.1
SLOPES = {"huber": huber_slopes, "tukey": tukey_slopes}  # derivatives of psi of the M-estimators


@checked_fields
@dataclass(frozen=True, eq=False)
class AdjustmentOptions:
    """Options of an adjustment that hardly any network needs.

    Attributes:
        sigma_px: standard deviation of unit weight, px. The network states the weights, so this changes
            sigma0 but not sigma0_px.
        image_sigma_factor: factor on the stated standard deviations of the image points, one number or (k,).
            The network of the result keeps the stated ones.
        alpha: probability that the test of one image coordinate rejects a good one; if not given, such that
            all of them together reject any with the probability `false_alarm` of the adjustment.
        method: "gauss-newton" (line search) or "levenberg-marquardt" (ends with undamped Gauss-Newton).
        max_iterations: largest number of steps in each round of the robust test.
        tolerance: |A dx| / |v| at which the iteration has converged.
        redundancy_numbers: whether to compute redundancy numbers and standardised residuals, if there is a
            covariance.

    Example:
        >>> import sfm
        >>> few = sfm.AdjustmentOptions(max_iterations=0)
        >>> sfm.adjust(result.network, result.estimate, options=few).iterations
        0
    """

    sigma_px: float = 0.1
    image_sigma_factor: float | FloatArray = 1.0
    alpha: float | None = None
    method: str = "levenberg-marquardt"
    max_iterations: int = 50
    tolerance: float = TOLERANCE
    redundancy_numbers: bool = True


@checked_arguments()
def adjust(
    network: Network,
    estimate: Estimate,
    *,
    datum: Datum | str = FREE,
    reject: str = "tau",
    false_alarm: float = FALSE_ALARM,
    rejected: BoolArray | None = None,
    covariance: bool = True,
    options: AdjustmentOptions = AdjustmentOptions(),
) -> Adjustment:
    """Return the least-squares adjustment of a network.

    Weights are the inverse covariances of the observations. The cameras of the estimate state which interior
    parameters are free.

    Args:
        network: the measurements.
        estimate: start values; a photograph or point without one (NaN) takes no part and is reported. So is
            a point with one ray that nothing else determines; it has no coordinates (NaN) in the result.
        datum: definition of position, attitude and scale; or only its kind.
        reject: "tau" (data snooping by Pope's test), "huber" or "tukey" (reweighting; Tukey's biweight starts
            from Huber's result and rejects image points with weight 0) or "none".
        false_alarm: probability that a right result is called wrong; the level of every test of the result
            follows from it.
        rejected: image points that data snooping leaves out at the start, such as those rejected before,
            (k,). They return if they pass the test. The other options of `reject` start with all image
            points.
        covariance: whether to compute covariance and redundancy numbers; they are NaN otherwise.
        options: further options.

    Raises:
        GeometryError: nothing to adjust, an unknown option, or datum points that cannot carry the datum.

    Source: document 000, secs. 2.2 to 2.4; Foerstner, Wrobel (2016), Photogrammetric Computer Vision, ch. 15.

    Example:
        >>> import sfm
        >>> sfm.adjust(result.network, result.estimate, reject="huber").converged
        True
    """
    datum = Datum(datum) if isinstance(datum, str) else datum
    method, sigma_px, alpha = options.method, options.sigma_px, options.alpha
    check_network(network, estimate)
    check_number("sigma_px", sigma_px, 0.0)
    check_number("false_alarm", false_alarm, 0.0, 1.0)
    if alpha is None:
        alpha = level_of_single(false_alarm, 2 * len(network.image_points))
    check_number("alpha", alpha, 0.0, 1.0)
    if reject not in REJECTS:
        raise GeometryError(f"adjustment: reject '{reject}', expected one of {', '.join(REJECTS)}")
    if method not in METHODS:
        raise GeometryError(f"adjustment: method '{method}', expected one of {', '.join(METHODS)}")
    use_control = datum.kind == "control"
    resolved = without_far_points(datum.resolve(network), estimate.points)
    local = local_of(network, estimate, resolved)
    k = len(network.image_points)
    given = np.asarray(options.image_sigma_factor, dtype=float)
    if given.shape not in ((), (k,)) or not (np.isfinite(given) & (given > 0)).all():
        raise GeometryError(f"image_sigma_factor of shape {given.shape}, expected positive numbers, 1 or {k}")
    factor = np.broadcast_to(given, (k,))
    without = _mask_of(rejected, k)
    if reject != "tau":
        without = np.zeros(k, dtype=bool)
    layout, state = unknowns_of(
        local.network, local.estimate, use_control=use_control, image_sigma_factor=factor
    )
    observed = observed_of(local.network, layout, state, use_control=use_control)
    problem = problem_of(layout, observed, local.datum)
    exact = covariance or reject == "tau"
    run = Run(problem, method, options.max_iterations, options.tolerance, exact=exact)
    with own_threads():
        optimum, weight = find_optimum(run, state, reject=reject, alpha=alpha, without=without[layout.order])
        Q = cofactors(optimum, layout, cross=options.redundancy_numbers) if covariance else None
        result = _result(local, run, optimum, weight, Q, sigma_px, SLOPES.get(reject))
        if not optimum.converged or (covariance and not result.undetermined and _has_open_c(result)):
            result = _with_open_start(result, local, problem, state, weight)
        if reject != "tau":  # without rejection the usual probability that a good coordinate is rejected
            alpha = float(2 * normal_sf(TUKEY)) if reject == "tukey" else Levels(false_alarm).question
        return local.back(
            replace(result, image_sigma_factor=factor, test_alpha=alpha, false_alarm=false_alarm)
        )


@checked_arguments()
def predict(
    network: Network, estimate: Estimate, *, datum: Datum | str = FREE, sigma_px: float = 0.1
) -> Adjustment:
    """Predict the covariance, redundancy and rank of a planned network.

    Nothing is adjusted. Covariances refer to sigma0 = 1, that is, to the standard deviations stated by the
    network. Residuals are 0 up to rounding if the image points are projected ones.

    Args:
        network: the planned image points with their standard deviations, scale bars and control.
        estimate: the planned cameras, exterior orientations and points.
        datum: definition of position, attitude and scale; or only its kind.
        sigma_px: standard deviation of unit weight, px.

    Raises:
        GeometryError: nothing to adjust, or datum points that cannot carry the datum.

    Source: Grafarend (1974), first-order design; Fraser (1984), Photogramm. Eng. Remote Sens. 50(8).
    """
    datum = Datum(datum) if isinstance(datum, str) else datum
    check_network(network, estimate)
    check_number("sigma_px", sigma_px, 0.0)
    use_control = datum.kind == "control"
    resolved = without_far_points(datum.resolve(network), estimate.points)
    local = local_of(network, estimate, resolved)
    factor = np.ones(len(network.image_points))
    layout, state = unknowns_of(
        local.network, local.estimate, use_control=use_control, image_sigma_factor=factor
    )
    observed = observed_of(local.network, layout, state, use_control=use_control)
    run = Run(problem_of(layout, observed, local.datum), METHODS[0], 0, TOLERANCE, exact=True)
    weight = layout.active.astype(float)
    with own_threads():
        optimum = optimum_at(run.problem, state, weight)
        if optimum is None:
            raise GeometryError("the normal equations of this network cannot be solved")
        Q = cofactors(optimum, layout, cross=True)
        result = _result(local, run, optimum, weight, Q, sigma_px, None, sigma0=1.0)
        return local.back(replace(result, image_sigma_factor=factor))


def _mask_of(rejected: BoolArray | None, k: int) -> BoolArray:
    """Return which image points are given as rejected, (k,).

    Raises:
        GeometryError: the mask has another shape, or rejects all image points.
    """
    if rejected is None:
        return np.zeros(k, dtype=bool)
    if rejected.shape != (k,):
        raise GeometryError(
            f"rejected of shape {rejected.shape}, expected one truth value for each of {k} image points"
        )
    if rejected.all():
        raise GeometryError(f"rejected: all {counted(k, 'image point')}, expected fewer")
    return rejected


def _with_open_start(
    result: Adjustment, local: LocalNetwork, problem: Problem, start: State, weight: FloatArray
) -> Adjustment:
    """Return an adjustment with the rank defect of its start, if that is larger.

    What nothing determines drifts with the noise of the image points, such as c of nadir photographs, until
    the normal equations are regular by chance.
    """
    optimum = optimum_at(problem, start, weight)
    if optimum is None or (defect := rank_defect(optimum, problem.layout)) <= result.defect:
        return result
    allowed = 0 if problem.datum.kind == "control" else 7
    undetermined = undetermined_of(
        optimum, problem.layout, local.network, local.estimate, weight, allowed_motions=allowed
    )
    return replace(result, defect=defect, undetermined=undetermined)


def _has_open_c(result: Adjustment) -> bool:
    """Return whether a principal distance may lie anywhere, by its standard deviation."""
    for k, camera in enumerate(result.estimate.cameras):
        focal = [parameter.role is Role.FOCAL for parameter in MODELS[camera.model].parameters]
        with np.errstate(invalid="ignore"):
            if (result.interior_sigma(k)[focal] > MAX_LINEAR * np.abs(camera.parameters[focal])).any():
                return True
    return False


def _small_weight_remarks(layout: Unknowns, weight: FloatArray, network: Network) -> tuple[Remark, ...]:
    """Return the remark on photographs with small robust weights only, whose orientation is arbitrary."""
    seen = layout.active
    image = layout.observations.image
    largest = np.zeros(len(network.images))
    np.maximum.at(largest, image[seen], weight[seen])
    loose = np.bincount(image[seen], minlength=len(largest)) > 0
    loose &= largest < MIN_HOLD
    loose[network.exterior.image] = False
    if not loose.any():
        return ()
    names = [network.images[i] for i in np.flatnonzero(loose)]
    return (remark("photograph_without_weight", photographs=names),)


def _result(
    local: LocalNetwork,
    run: Run,
    optimum: Optimum,
    weight: FloatArray,
    Q: Cofactors | None,
    sigma_px: float,
    slopes: Callable[[FloatArray], FloatArray] | None,
    *,
    sigma0: float | None = None,  # used instead of the a posteriori value
) -> Adjustment:
    """Return the adjustment with statistics at an optimum; without cofactors Q, covariances are NaN."""
    layout, network, estimate = run.problem.layout, local.network, local.estimate
    of_control = run.problem.datum.kind == "control"
    allowed = 0 if of_control else 7  # motions; control is expected to fix all of them
    defect = rank_defect(optimum, layout)
    undetermined = undetermined_of(optimum, layout, network, estimate, weight, allowed_motions=allowed)
    redundancy = run.redundancy(optimum, weight)
    observations = 2 * int((weight > 0).sum()) + count_of(run.problem.observed)
    v = residuals(layout.observations, optimum.state)
    discount = run.undiscounted(optimum, weight) - redundancy
    numbers = standardised = residual_weight = np.full((len(weight), 2), np.nan)
    complement = None
    if Q is not None and Q.has_cross:
        complement = hat_complement(optimum, layout, Q, weight)
        # it can overflow for image points of a photograph that nothing determines
        complement[~np.isfinite(complement).all(axis=(1, 2))] = np.nan
        numbers = numbers_of(complement, layout.observations.whitening)
        numbers[weight == 0] = np.nan
        of_each = round(float(np.nansum((1 - layout.observations.share)[:, None] * numbers)))
        redundancy, discount = redundancy + discount - of_each, of_each
    if sigma0 is None:
        sigma0 = float(np.sqrt(optimum.vPv / redundancy)) if redundancy > 0 else float("nan")
    factor = 1.0
    if slopes is not None and redundancy > 0:
        factor = inflation(
            layout.observations, v, weight, slopes(weight),
            vPv=optimum.vPv, count=observations, redundancy=redundancy,
        )  # fmt: skip
        sigma0 *= factor
    k, n, m = len(weight), len(network.points), len(network.images)
    back = np.empty(k, dtype=np.int64)  # position of each image point of the network in the layout
    back[layout.order] = np.arange(k)
    if Q is None:
        empty = np.full((n, 3, 3), np.nan)
        interior = tuple(np.full((len(free), len(free)), np.nan) for free in layout.interior_free)
        shared = len(layout.rig_terms(optimum.state)[0])
        rigs = np.full((shared, shared), np.nan)
        result = Covariance(empty, np.full((m, 6, 6), np.nan), interior, empty, rigs)
    else:
        result = marginal_covariance(optimum, layout, Q, sigma0**2)
        result = without_held(result, layout, optimum)
    if complement is not None:
        numbers = np.take(numbers, back, axis=0)
        residual_weight = residual_weights(complement, layout.observations.whitening)
        residual_weight[weight == 0] = np.nan
        residual_weight = np.take(residual_weight, back, axis=0)
        standardised = np.take(
            standardised_residuals(v, complement, layout.observations.whitening), back, axis=0
        )
    solved = estimate_of(optimum.state, estimate)
    left_out = ~layout.point_on & (network.rays() > 0)  # a start value is no result
    return Adjustment(
        network=network,
        estimate=replace(solved, points=np.where(left_out[:, None], np.nan, solved.points)),
        converged=optimum.converged,
        iterations=run.iterations,
        datum=run.problem.datum.kind,
        defect=defect,
        expected_defect=0 if of_control else optimum.motions.defect,
        undetermined=undetermined,
        residuals=np.take(v, back, axis=0),
        rejected=np.take((weight == 0), back, axis=0),
        redundancy_numbers=numbers,
        sigma_px=sigma_px,
        sigma0=sigma0,
        redundancy=redundancy,
        discount=discount,
        unknowns=layout.count,
        unknown_counts=layout.counts,
        observations=observations,
        covariance=result,
        standardised=standardised,
        residual_weights=residual_weight,
        weights=np.take(weight, back, axis=0),
        inflation=factor,
        observed=tuple(
            residuals_of_observed(observed_kind, layout, optimum, Q) for observed_kind in run.problem.observed
        ),
        datum_points=run.problem.datum.points,
        remarks=(*run.remarks, *_small_weight_remarks(layout, weight, network)),
        start_sigma0=float(np.sqrt(run.start_vPv / redundancy)) if redundancy > 0 else float("nan"),
        joint=JointOnDemand,
    )
