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
from typing import NamedTuple

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.judgement.survey_result import ControlCheck
from sfm.model.conventions import (
    BoolArray,
    FloatArray,
    IntArray,
    rotation_from_angles,
    rotation_from_vector,
)
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.estimate import AdjustedValues, Estimate, values_of
from sfm.model.network import Network
from sfm.model.observations.kind import PHOTOGRAPH, POINT, RowKind, TableKind, is_observed
from sfm.model.observations.point_pairs import Distances
from sfm.model.observations.pose import MountObservations
from sfm.model.similarity import Similarity, fit_similarity, nearest_rotation

ROUGH_ROUNDS, ROUNDS = 6, 20  # most Gauss-Newton steps from each attitude, and from the best attitudes
BEST = 3  # attitudes that are fitted to the end
LAST_STEP = 1e-7  # rad, of the extent, and of the scale: with a smaller step the fit ends
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
    count = len(attitudes)
    observed, kinds = _observed_part(kinds, start)
    tried = _Motions(observed, _size_of(start), np.ones(count), np.stack(attitudes), np.zeros((count, 3)))
    tried, cost = _fitted(kinds, tried, ROUGH_ROUNDS, scaled=scaled)
    best, cost = _fitted(kinds, tried.select(np.argsort(cost, kind="stable")[:BEST]), ROUNDS, scaled=scaled)
    k = int(np.argmin(cost))
    return Similarity(float(best.scale[k]), best.rotation[k], best.shift[k]).apply_estimate(start)


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


def _about_centre(kinds: Sequence[TableKind], estimate: Estimate) -> tuple[Estimate, FloatArray, float]:
    """Return an estimate about its centre, its observations' derivatives by motions, and their rounding.

    Returns:
        The estimate; whitened derivatives by shift in units of its extent, rotation and scale, (n, 7); the
        value below which these are only rounding errors, where derivatives by points and photographs cancel.
    """
    centre = np.nanmean(estimate.points, axis=0)
    start = Similarity(1.0, np.eye(3), -centre).apply_estimate(estimate)
    size = _size_of(start)
    observed, kinds = _observed_part(kinds, start)
    still = _Motions(observed, size, np.ones(1), np.eye(3)[None], np.zeros((1, 3)))
    rows, norm, values = [], 0.0, still.values()
    for kind in kinds:
        linear = _linearised(kind, still, values, kind.sigma.reshape(1, -1))
        root = _inverse_of(kind.sigma.ravel())
        rows.append(root[:, None] * linear.J[0])
        norm += linear.norm * float(root.max())
    by_motion = np.concatenate(rows)
    by_motion[:, :3] *= size
    return start, by_motion, MIN_FRACTION * size * norm


def _size_of(estimate: Estimate) -> float:
    """Return the largest coordinate of the points."""
    return float(np.nanmax(np.abs(estimate.points)))


def _observed_part(kinds: Sequence[TableKind], estimate: Estimate) -> tuple[Estimate, list[TableKind]]:
    """Return the points and photographs that observations involve, a few of many, and these renumbered."""
    points, images = np.zeros(len(estimate.points), dtype=bool), np.zeros(len(estimate.position), dtype=bool)
    for kind in kinds:
        for of, at in kind.blocks():
            (points if of == POINT else images)[at] = True
    part = replace(
        estimate,
        points=estimate.points[points],
        position=estimate.position[images],
        rotation=estimate.rotation[images],
    )
    return part, [kind.renumbered(np.cumsum(points) - 1, np.cumsum(images) - 1) for kind in kinds]


def _of_motions(network: Network, estimate: Estimate) -> list[TableKind]:
    """Return scale bars and tabulated observations whose points and photographs have start values."""
    tables = (kind for kind in network.further if isinstance(kind, TableKind))
    bars = network.scale_bars
    kinds = (Distances(bars.start, bars.end, bars.values, bars.sigma[:, None]), *tables)
    usable = list[TableKind]()
    for kind in kinds:
        on = np.ones(len(kind), dtype=bool)
        for of, at in kind.blocks():
            if of not in (POINT, PHOTOGRAPH):
                on[:] = False  # of mounts and cameras, which motions do not change
            else:
                on &= (estimate.determined if of == POINT else estimate.oriented)[at]
        usable.append(kind.select(on))
    return [kind for kind in usable if len(kind)]


class _Motions(NamedTuple):
    """Positions, attitudes and scales of an estimate: X = scale R x + shift, a of them."""

    start: Estimate
    size: float  # largest coordinate of all points, object unit
    scale: FloatArray  # (a,)
    rotation: FloatArray  # R, (a, 3, 3)
    shift: FloatArray  # (a, 3)

    def select(self, at: IntArray) -> _Motions:
        """Return the motions of the given indices."""
        return _Motions(self.start, self.size, self.scale[at], self.rotation[at], self.shift[at])

    def then(self, step: FloatArray) -> _Motions:
        """Return the motions followed by a shift, a rotation vector and a change of ln(scale), (a, 7)."""
        R, scale = rotation_from_vector(step[:, 3:6]), np.exp(step[:, 6])
        shift = scale[:, None] * np.einsum("aij,aj->ai", R, self.shift) + step[:, :3]
        return _Motions(self.start, self.size, scale * self.scale, R @ self.rotation, shift)

    def values(self) -> AdjustedValues:
        """Return the values after all motions, one behind the other."""
        values, R = values_of(self.start), np.swapaxes(self.rotation, 1, 2)
        points, position = (
            (self.scale[:, None, None] * (X @ R) + self.shift[:, None]).reshape(-1, 3)
            for X in (values.points, values.position)
        )
        M = (values.M @ R[:, None]).reshape(-1, 3, 3)
        return values._replace(points=points, position=position, M=M)


class _ByMotions(NamedTuple):
    """Observations after a motions, with derivatives by further ones."""

    difference: FloatArray  # computed minus observed, (a, n d)
    J: FloatArray  # derivatives by shift, rotation and ln(scale), (a, n d, 7)
    norm: float  # of the derivatives by all unknowns


def _fitted(
    kinds: Sequence[TableKind], motions: _Motions, rounds: int, *, scaled: bool
) -> tuple[_Motions, FloatArray]:
    """Return motions to the least sum of absolute residuals over sigma, and this sum, (a,).

    With a sum of squares one mistyped value would decide. Weights of 1 over the residual turn it into a sum
    of absolute values (Foerstner and Wrobel 2016, sec. 4.7.4).
    """
    count, size = len(motions.scale), motions.size
    stated = [np.broadcast_to(kind.sigma.ravel(), (count, kind.sigma.size)) for kind in kinds]
    sigma, values = stated, motions.values()
    linear = [_linearised(kind, motions, values, of) for kind, of in zip(kinds, sigma, strict=True)]
    for _ in range(rounds):
        root = np.concatenate([_inverse_of(of) for of in sigma], axis=1)
        rows = root[:, :, None] * np.concatenate([of.J for of in linear], axis=1)
        rows[:, :, 6] *= scaled
        l = root * np.concatenate([of.difference for of in linear], axis=1)
        step = -np.einsum("aij,aj->ai", np.linalg.pinv(rows, rcond=1e-9), l)
        step /= np.maximum(np.abs(step[:, 3:]).max(axis=1, keepdims=True), MAX_STEP) / MAX_STEP
        motions = motions.then(step)
        values = motions.values()
        linear = [_linearised(kind, motions, values, of) for kind, of in zip(kinds, sigma, strict=True)]
        away = [np.abs(of.difference) / by for of, by in zip(linear, stated, strict=True)]
        if np.abs(step / ([size] * 3 + [1.0] * 4)).max() < LAST_STEP:
            break
        sigma = [by * np.sqrt(np.maximum(over, 1.0)) for by, over in zip(stated, away, strict=True)]
        linear = [  # weights decide on the derivatives of a group, whose parameters they eliminate
            at if isinstance(kind, RowKind) else _linearised(kind, motions, values, of)
            for kind, at, of in zip(kinds, linear, sigma, strict=True)
        ]
    return motions, np.concatenate(away, axis=1).sum(axis=1)


def _inverse_of(sigma: FloatArray) -> FloatArray:
    """Return 1 over standard deviations, 0 of values that are fixed or unknown."""
    on = is_observed(sigma)
    return np.where(on, 1 / np.where(on, sigma, 1.0), 0.0)


def _linearised(kind: TableKind, motions: _Motions, values: AdjustedValues, sigma: FloatArray) -> _ByMotions:
    """Return observations after motions, with their standard deviations after each, (a, n d).

    Rows are computed for all motions at once, as those of a network with as many copies of each point, which
    have the values of `_Motions.values`.
    """
    count = len(motions.scale)
    n, m = len(motions.start.points), len(motions.start.position)
    copies = list[tuple[TableKind, AdjustedValues]]()
    if isinstance(kind, RowKind):
        first = np.arange(count)[:, None]
        places = tuple((at + first * (n if of == POINT else m)).ravel() for of, at in kind.blocks())
        observed = np.tile(np.hstack([kind.without_sigma, kind.values]), (count, 1))
        copies.append((kind.of_table(places, observed, sigma.reshape(len(observed), -1)), values))
    else:
        points, position = values.points.reshape(count, n, 3), values.position.reshape(count, m, 3)
        M = values.M.reshape(count, m, 3, 3)
        for k in range(count):
            of_motion = values._replace(points=points[k], position=position[k], M=M[k])
            copies.append((kind.with_sigma(sigma[k].reshape(kind.sigma.shape)), of_motion))
    difference, J, norm = [], [], 0.0
    for of_copy, at_copy in copies:
        linear, blocks = of_copy.linearise(at_copy), of_copy.blocks()
        X = np.stack([at_copy.points[at] if of == POINT else at_copy.position[at] for of, at in blocks])
        by = np.stack([derivatives[:, :, :3] for derivatives in linear.J])  # (blocks, n, d, 3)
        turn, scale = np.cross(X[:, :, None], by).sum(axis=0), np.einsum("bni,bndi->nd", X, by)
        for (of, at), derivatives in zip(blocks, linear.J, strict=True):
            if of == PHOTOGRAPH:
                turn += derivatives[:, :, 3:] @ at_copy.M[at]
            norm += float((derivatives**2).sum())
        J.append(np.concatenate([by.sum(axis=0), turn, scale[:, :, None]], axis=2))
        difference.append(linear.difference)
    return _ByMotions(
        np.stack(difference).reshape(count, -1), np.stack(J).reshape(count, -1, 7), float(np.sqrt(norm))
    )


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
