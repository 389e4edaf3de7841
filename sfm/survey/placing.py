"""Position, attitude and scale of a network: from control, scale bars, observations, or its datum's frame.

Image points do not determine these seven parameters. Start values are transformed into the frame of the
adjustment. Adjusted free networks are transformed to the coordinates that their datum refers to, without a
change of shape. Heights, coordinate differences, antenna positions and distances determine some of the seven.
A robust adjustment finds these, starting from attitudes all round, so that the main adjustment starts close
to its solution.

Observed exterior orientation takes part in the datum `control`, beside the control, and in no other datum.

Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 2.2.3 (spatial similarity).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations, product

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.judgement.survey_result import ControlCheck
from sfm.model.conventions import (
    BoolArray,
    FloatArray,
    IntArray,
    rotation_from_angles,
    rotation_from_vector,
    skew,
)
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate, values_of
from sfm.model.network import Network
from sfm.model.observations.control_and_bars import ScaleBars
from sfm.model.observations.kind import PHOTOGRAPH, POINT, Kind, TableKind, inverse_of_observed
from sfm.model.observations.pose import MountObservations
from sfm.model.similarity import Similarity, fit_similarity, nearest_rotation

Weighted = TableKind | ScaleBars  # with one standard deviation for each value

ROUGH_ROUNDS, ROUNDS = 6, 20  # Gauss-Newton steps from each attitude, and from the best attitudes
BEST = 3  # attitudes that are fitted to the end
MIN_FRACTION = 1e-9  # of the derivatives, below which the effect of a motion is only rounding
MAX_STEP = 0.5  # largest rotation of one step, rad, and largest change of ln(scale)
MIN_POINTS = 3  # that fix position, attitude and scale
# Breadth over length of positions below which observed angles give their rotation about the length.
MAX_BREADTH_RATIO = 0.05
MIN_OFF_LINE_SIGMAS = 3.0  # breadth, in standard deviations, needed to give the rotation about a line
MIN_OFF_LINE_FRACTION = 1e-6  # the same for positions without error, over their extent
START_TOLERANCE = 1e-3  # of the extent of the positions: start values need not be better
MIN_CONTROL = 3  # points that a control datum needs, and that place a free network


def place_on_observations(network: Network, estimate: Estimate) -> Estimate:
    """Return the estimate in the scale and attitude that survey observations give; unchanged without them.

    Args:
        network: has observations of points and photographs.
        estimate: start values.
    """
    kinds = _of_motions(network, estimate)
    if not kinds or not network.further:
        return estimate
    start, rows, rounding = _about_centre(kinds, estimate)
    scaled = not has_held_mounts(estimate)
    turns = np.abs(rows[:, 3:6]).max() > rounding
    attitudes = [np.eye(3)]  # undetermined by distances and frames
    if turns:  # the 24 rotations of a cube
        attitudes = []
        for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
            R = np.zeros((3, 3))
            R[np.arange(3), list(order)] = signs
            if np.linalg.det(R) > 0:
                attitudes.append(R)
    turned = [Similarity(1.0, R, np.zeros(3)).apply_estimate(start) for R in attitudes]
    tried = [_fitted(kinds, candidate, ROUGH_ROUNDS, scaled=scaled) for candidate in turned]
    best = sorted(tried, key=lambda fit: fit[1])[:BEST]
    return min(
        (_fitted(kinds, candidate, ROUNDS, scaled=scaled) for candidate, _ in best), key=lambda fit: fit[1]
    )[0]


def scale_sigma(network: Network, estimate: Estimate) -> float:
    """Return the relative standard deviation of the scale from observations of points and photographs.

    Nothing else is assumed to give a scale. The result is infinite if these observations do not either.
    """
    kinds = _of_motions(network, estimate)
    if not kinds:
        return float("inf")
    _, rows, rounding = _about_centre(kinds, estimate)
    U, singular, _ = np.linalg.svd(rows[:, :6], full_matrices=False)
    U = U[:, singular > rounding]
    left = float(np.linalg.norm(rows[:, 6] - U @ (U.T @ rows[:, 6])))
    return 1 / left if left > rounding else float("inf")


def _about_centre(kinds: Sequence[Kind], estimate: Estimate) -> tuple[Estimate, FloatArray, float]:
    """Return an estimate about its centre, its observations' derivatives by motions, and their rounding.

    Returns:
        The estimate; whitened derivatives by shift in units of its extent, rotation and scale, (n, 7); the
        value below which these are only rounding errors, where derivatives by points and photographs cancel.
    """
    centre = np.nanmean(estimate.points, axis=0)
    start = Similarity(1.0, np.eye(3), -centre).apply_estimate(estimate)
    rows, _ = _rows(kinds, start)
    size, norm = float(np.nanmax(np.abs(start.points))), 0.0
    rows[:, :3] *= size
    for kind in kinds:
        J = np.concatenate([by.ravel() for by in kind.linearise(values_of(start)).J])
        norm += float(np.linalg.norm(J) * np.sqrt(inverse_of_observed(kind.covariances()).max()))
    return start, rows, MIN_FRACTION * size * norm


def _of_motions(network: Network, estimate: Estimate) -> list[Weighted]:
    """Return scale bars and tabulated observations whose points and photographs have start values."""
    tables = (kind for kind in network.further if isinstance(kind, TableKind))
    kinds: tuple[Weighted, ...] = (network.scale_bars, *tables)
    usable = []
    for kind in kinds:
        on = np.ones(len(kind), dtype=bool)
        for of, at in kind.blocks():
            if of not in (POINT, PHOTOGRAPH):
                on[:] = False  # of mounts and cameras, which motions do not change
            else:
                on &= (estimate.determined if of == POINT else estimate.oriented)[at]
        usable.append(kind.select(on))
    return [kind for kind in usable if len(kind)]


def _fitted(
    kinds: list[Weighted], estimate: Estimate, rounds: int, *, scaled: bool
) -> tuple[Estimate, float]:
    """Return the estimate, moved and scaled to the least sum of absolute residuals over sigma, and this sum.

    With a sum of squares one mistyped value would decide. Weights of 1 over the residual turn it into a sum
    of absolute values (Foerstner and Wrobel 2016, sec. 4.7.4).
    """
    weighted = kinds
    for _ in range(rounds):
        rows, l = _rows(weighted, estimate)
        rows[:, 6] *= scaled
        step: FloatArray = np.asarray(-np.linalg.lstsq(rows, l, rcond=1e-9)[0], dtype=float)
        size = max(float(np.abs(step[3:]).max()), MAX_STEP) / MAX_STEP
        step /= size
        R = rotation_from_vector(step[3:6])
        estimate = Similarity(float(np.exp(step[6])), R, step[:3]).apply_estimate(estimate)
        away = []  # absolute residuals over the stated sigma
        for kind, reweighted in zip(kinds, weighted, strict=True):
            difference = reweighted.linearise(values_of(estimate)).difference
            away.append(np.asarray(np.abs(difference.reshape(kind.sigma.shape)) / kind.sigma))
        weighted = [
            kind.with_sigma(kind.sigma * np.sqrt(np.maximum(over, 1.0)))
            for kind, over in zip(kinds, away, strict=True)
        ]
    return estimate, sum(float(over.sum()) for over in away)


def _rows(kinds: Sequence[Kind], estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return whitened derivatives by shift, rotation and scale, (n, 7), and differences, (n,)."""
    values, rows, differences = values_of(estimate), [], []
    for kind in kinds:
        linear = kind.linearise(values)
        J = np.zeros((*linear.difference.shape, 7))
        for (of, at), by in zip(kind.blocks(), linear.J, strict=True):
            X = values.points[at] if of == POINT else values.position[at]
            motion = np.zeros((len(at), by.shape[2], 7))
            motion[:, :3, :3] = np.eye(3)
            motion[:, :3, 3:6] = -skew(X)
            motion[:, :3, 6] = X
            if of == PHOTOGRAPH:
                motion[:, 3:, 3:6] = values.M[at]
            J += by @ motion
        weight = inverse_of_observed(kind.covariances())
        F = np.swapaxes(np.linalg.cholesky(weight), 1, 2)
        rows.append((F @ J).reshape(-1, 7))
        differences.append(np.einsum("nab,nb->na", F, linear.difference).ravel())
    return np.concatenate(rows), np.concatenate(differences)


def place_on_exterior(network: Network, estimate: Estimate) -> Estimate:
    """Return start values in the frame of control and observed exterior orientation.

    Args:
        network: has all image points, control and observed exterior orientation.
        estimate: result of the orientation; photographs without start values are NaN.

    Raises:
        GeometryError: control and observed exterior orientation cannot place the network.
    """
    image, covariance = network.exterior.image, network.exterior.covariance
    variances = np.einsum("nii->ni", covariance)
    value = np.where(np.isfinite(variances), network.exterior.values, np.nan)
    control = network.control.complete
    known = estimate.determined[control.point]
    length, breadth = _extents(control.xyz[known], np.ones(int(known.sum())))
    if known.sum() >= MIN_POINTS and breadth >= MAX_BREADTH_RATIO * length:
        return estimate  # the orientation already used the control
    oriented = estimate.oriented[image]
    centres = oriented & np.isfinite(value[:, :3]).all(axis=1)
    source = np.concatenate([estimate.points[control.point[known]], estimate.position[image[centres]]])
    target = np.concatenate([control.xyz[known], value[centres, :3]])
    variance = np.concatenate(
        [np.einsum("nii->n", control.covariance[known]), variances[centres, :3].sum(axis=1)]
    )
    turned = oriented & np.isfinite(value[:, 3:]).all(axis=1)
    if not len(target) or not (len(target) >= MIN_POINTS or turned.any()):
        raise GeometryError(_too_few(len(target), int(turned.sum())))
    least = (START_TOLERANCE * float(np.ptp(target, axis=0).max())) ** 2
    weight = 1 / np.maximum(variance, least if least > 0 else 1.0)
    length, breadth = _extents(target, weight)
    noise = float(np.sqrt(weight @ variance / weight.sum() / 3))
    if turned.any() and (len(target) < MIN_POINTS or breadth < MAX_BREADTH_RATIO * length):
        similarity = _by_angles(network, estimate, image[turned], value[turned, 3:], source, target, weight)
    elif (
        breadth > max(MIN_OFF_LINE_SIGMAS * noise, MIN_OFF_LINE_FRACTION * length)
        or np.isfinite(value[:, 3:]).any()
    ):
        similarity = fit_similarity(source, target, weights=weight)
    else:
        if length == 0:
            how = "all the same"
        elif length > MIN_OFF_LINE_SIGMAS * noise and breadth <= max(noise, MIN_OFF_LINE_FRACTION * length):
            how = "on a line"  # no broader than their errors
        else:
            how = (
                f"of RMS extents {length / noise:.1f} and {breadth / noise:.1f} standard deviations, needed "
                f"{MIN_OFF_LINE_SIGMAS:g} in both directions"
            )
        raise GeometryError(_too_few(len(target), 0, f", {how}"))
    return similarity.apply_estimate(estimate)


def hold_fixed(network: Network, estimate: Estimate) -> Estimate:
    """Return the estimate with fixed control, projection centres and rotations at their given values."""
    points, position = estimate.points.copy(), estimate.position.copy()
    rotation, oriented = estimate.rotation.copy(), estimate.oriented
    control, seen = network.control, network.exterior
    fixed = np.einsum("nii->ni", control.covariance) == 0
    points[control.point] = np.where(fixed, control.xyz, points[control.point])
    for e, i in enumerate(seen.image):
        variance = np.diagonal(seen.covariance[e])
        if oriented[i]:
            position[i] = np.where(variance[:3] == 0, seen.position[e], position[i])
            if (variance[3:] == 0).all():
                rotation[i] = rotation_from_angles(*seen.angles[e])
    return replace(estimate, points=points, position=position, rotation=rotation)


def _by_angles(
    network: Network,
    estimate: Estimate,
    image: IntArray,
    angles: FloatArray,
    source: FloatArray,
    target: FloatArray,
    weight: FloatArray,
) -> Similarity:
    """Return the similarity whose rotation is the mean of observed angles (Horn 1987)."""
    observed = np.stack([rotation_from_angles(omega, phi, kappa) for omega, phi, kappa in angles])
    R = nearest_rotation(np.einsum("eab,ecb->ac", observed, estimate.rotation[image]))
    w = weight / weight.sum()
    centre_s, centre_t = w @ source, w @ target
    spread_s, spread_t = (w @ ((x - c) ** 2).sum(axis=1) for x, c in ((source, centre_s), (target, centre_t)))
    scale = float(np.sqrt(spread_t / spread_s)) if spread_s > 0 else object_scale(network, estimate)
    if not scale > 0:
        raise GeometryError(
            "observed exterior orientation: one projection centre gives no scale; a second one, control or a "
            "scale bar is needed"
        )
    return Similarity(scale, R, centre_t - scale * R @ centre_s)


def _extents(places: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Return the first and second principal RMS extent of positions, (n, 3), with weights, (n,)."""
    if len(places) < 2:
        return 0.0, 0.0
    w = weight / weight.sum()
    spread = np.linalg.svd((places - w @ places) * np.sqrt(w)[:, None], compute_uv=False)
    return float(spread[0]), float(spread[1])


def _too_few(places: int, turned: int, how: str = "") -> str:
    """Explain why observed exterior orientation and control do not place the network."""
    return (
        f"datum 'control': the network has {counted(places, 'place')} of projection centres and control "
        f"points with X, Y and Z{how}, and the angles of {counted(turned, 'photograph')}; needed three "
        'places that are not on a line, or two and the angles of a photograph; for the shape alone, "free"'
    )


def object_scale(network: Network, estimate: Estimate) -> float:
    """Return the object units per unit of an estimate, from its scale bars, else its control, else NaN."""
    bars, control = network.scale_bars, network.control.complete
    length = np.linalg.norm(estimate.points[bars.end] - estimate.points[bars.start], axis=1)
    usable = np.isfinite(length) & (length > 0)
    if usable.any():
        return float(np.median(bars.length[usable] / length[usable]))
    known = estimate.determined[control.point]
    if known.sum() < 2:
        return float("nan")
    given, points = control.xyz[known], estimate.points[control.point[known]]
    spread = np.linalg.norm(points - points.mean(axis=0))
    return float(np.linalg.norm(given - given.mean(axis=0)) / spread) if spread > 0 else float("nan")


def scale_to_bars(network: Network, estimate: Estimate, datum: Datum) -> Estimate:
    """Scale a network whose datum is not its control to its scale bars, else to its control."""
    if datum.kind == "control" or has_held_mounts(estimate):
        return estimate
    scale = object_scale(network, estimate)
    if not scale > 0:
        return estimate
    centre = np.nanmean(estimate.points, axis=0)
    return Similarity(scale, np.eye(3), (1 - scale) * centre).apply_estimate(estimate)


def is_scaled(network: Network, estimate: Estimate) -> bool:
    """Return whether scale bars, other observations or mounts held fixed give a network its scale."""
    return bool(len(network.scale_bars) or len(network.further) or has_held_mounts(estimate))


def has_held_mounts(estimate: Estimate) -> bool:
    """Return whether a mount is held fixed, other than the mounts of reference cameras."""
    mounts = estimate.mounts
    if mounts is None:
        return False
    return bool((mounts.position.any(axis=1) & ~mounts.free[:, :3].any(axis=1)).any())


def mounts_give_scale(network: Network, estimate: Estimate) -> bool:
    """Return whether given mounts, held fixed or observed, contribute to the scale of a network."""
    observed = any(isinstance(kind, MountObservations) for kind in network.further)
    return observed or has_held_mounts(estimate)


def place_on_control(network: Network, estimate: Estimate) -> tuple[Estimate, ControlCheck]:
    """Place an adjusted network on its control; if anything else gives its scale, it keeps this scale."""
    control = network.control.complete
    points = estimate.points[control.point]
    fitted = fit_similarity(points, control.xyz)
    scaled = is_scaled(network, estimate)
    placing = fit_similarity(points, control.xyz, scale=1.0) if scaled else fitted
    scale = fitted.scale if scaled else 1.0
    names = tuple(network.points[j] for j in control.point)
    return placing.apply_estimate(estimate), ControlCheck(names, placing.apply(points) - control.xyz, scale)


def place_on_frame(
    network: Network, estimate: Estimate, frame: Estimate, carriers: BoolArray | None
) -> Estimate:
    """Place an adjusted free network on the coordinates that its inner constraints refer to.

    The least-squares similarity over the datum points meets the inner constraints exactly, however far the
    network moved: the sum of the differences and their moments of rotation and scale are 0. Scale bars keep
    the scale, and so do two control points.

    Args:
        network: adjusted in a free datum.
        estimate: its adjusted values.
        frame: coordinates to refer to, NaN where there are none; with fewer than three points the projection
            centres are used.
        carriers: points that carry the datum, all if None, (n,).
    """
    on = frame.determined if carriers is None else frame.determined & carriers
    source, target = estimate.points[on], frame.points[on]
    if on.sum() < MIN_CONTROL:
        oriented = frame.oriented & estimate.oriented
        source, target = estimate.position[oriented], frame.position[oriented]
    scaled = is_scaled(network, estimate)
    keep = scaled or len(network.control.complete) == MIN_CONTROL - 1
    scale = object_scale(network, estimate) if len(network.control.complete) and not scaled else 1.0
    try:
        return fit_similarity(source, target, scale=scale if keep else None).apply_estimate(estimate)
    except GeometryError:  # too few, or on a line: the adjustment has kept their values
        return estimate
