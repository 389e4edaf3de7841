"""Observed exterior orientation of a survey: satellite positioning, a tracker, known stations.

In the datum `control` it takes part in the adjustment beside the control; in the others it does not, as the
control does not. Start values are brought into its frame where control alone does not do that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.conventions import FloatArray, IntArray, rotation_from_angles
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.network import Estimate, ExteriorObservations, Network
from sfm.remarks.remark import Remark, remark
from sfm.similarity import Similarity, fit_similarity, nearest_rotation
from sfm.survey.adjusting.datum_definition import object_scale
from sfm.survey.inputs.exterior_table import ObservedExterior

MIN_POINTS = 3  # that fix position, attitude and scale
NARROW = 0.05  # breadth over length of places below which their turn about the length is taken from angles
SURE = 3.0  # standard deviations by which places must be off a line to give the turn about it
FLAT = 1e-6  # the same for places without error, over their extent
ROUGH = 1e-3  # of the extent of the places: no start value needs to be better


@dataclass(frozen=True)
class Placed:
    """A network with its observed exterior orientation, ready to be adjusted."""

    network: Network
    estimate: Estimate  # start values in the frame of the datum
    remarks: tuple[Remark, ...] = ()


def add_exterior(network: Network, estimate: Estimate, table: ObservedExterior | None, datum: str) -> Placed:
    """Return the network with the observed exterior orientations, and start values in their frame.

    Args:
        network: all image points.
        estimate: after the orientation; photographs without start values are NaN.
        table: what was observed, None if nothing was.
        datum: kind of the survey's datum.

    Returns:
        All as it was, with a remark, where the datum is not `control`.

    Raises:
        GeometryError: they and the control cannot place the network.
    """
    if table is None:
        return Placed(network, estimate)
    if datum != "control":
        return Placed(network, estimate, (remark("exterior_unused", datum=datum),))
    index = {name: i for i, name in enumerate(network.images)}
    rows = np.array([k for k, name in enumerate(table.names) if name in index], dtype=np.int64)
    image = np.array([index[table.names[k]] for k in rows], dtype=np.int64)
    value, sigma = table.value[rows], table.sigma[rows]
    covariance = np.zeros((len(rows), 6, 6))
    covariance[:, range(6), range(6)] = sigma**2
    # what was not observed has no weight, and any number may stand in its place
    filled = np.where(np.isnan(value), 0.0, value)
    observed = ExteriorObservations(image, filled[:, :3], filled[:, 3:], covariance)
    return Placed(replace(network, exterior=observed), _placed(network, estimate, image, value, sigma))


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


def _placed(
    network: Network,
    estimate: Estimate,
    image: IntArray,
    value: FloatArray,
    sigma: FloatArray,
) -> Estimate:
    """Return the start values in the frame of control and observed exterior orientation."""
    control = network.control.complete
    known = estimate.determined[control.point]
    length, breadth = _extents(control.xyz[known], np.ones(int(known.sum())))
    if known.sum() >= MIN_POINTS and breadth >= NARROW * length:
        return estimate  # the orientation has brought it there
    oriented = estimate.oriented[image]
    centres = oriented & np.isfinite(value[:, :3]).all(axis=1)
    source = np.concatenate([estimate.points[control.point[known]], estimate.position[image[centres]]])
    target = np.concatenate([control.xyz[known], value[centres, :3]])
    variance = np.concatenate(
        [np.einsum("nii->n", control.covariance[known]), (sigma[centres, :3] ** 2).sum(axis=1)]
    )
    turned = oriented & np.isfinite(value[:, 3:]).all(axis=1)
    if not len(target) or not (len(target) >= MIN_POINTS or turned.any()):
        raise GeometryError(_too_few(len(target), int(turned.sum())))
    least = (ROUGH * float(np.ptp(target, axis=0).max())) ** 2
    weight = 1 / np.maximum(variance, least if least > 0 else 1.0)
    length, breadth = _extents(target, weight)
    noise = float(np.sqrt(weight @ variance / weight.sum() / 3))
    if turned.any() and (len(target) < MIN_POINTS or breadth < NARROW * length):
        similarity = _by_angles(network, estimate, image[turned], value[turned, 3:], source, target, weight)
    elif breadth > max(SURE * noise, FLAT * length) or np.isfinite(value[:, 3:]).any():
        similarity = fit_similarity(source, target, weights=weight)
    else:
        raise GeometryError(_too_few(len(target), 0, f", {_arrangement(length, breadth, noise)}"))
    return similarity.apply_estimate(estimate)


def _by_angles(
    network: Network,
    estimate: Estimate,
    image: IntArray,
    angles: FloatArray,
    source: FloatArray,
    target: FloatArray,
    weight: FloatArray,
) -> Similarity:
    """Return the similarity whose rotation is the mean that observed angles say (Horn 1987)."""
    observed = np.stack([rotation_from_angles(*one) for one in angles])
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
    """Return the first and second principal extent of weighted places, (n, 3) and (n,), as RMS."""
    if len(places) < 2:
        return 0.0, 0.0
    w = weight / weight.sum()
    spread = np.linalg.svd((places - w @ places) * np.sqrt(w)[:, None], compute_uv=False)
    return float(spread[0]), float(spread[1])


def _arrangement(length: float, breadth: float, noise: float) -> str:
    """Say how places that do not place the network lie, by their extents and standard deviation."""
    if length == 0:
        return "all the same"
    if length > SURE * noise and breadth <= max(noise, FLAT * length):  # no broader than by their errors
        return "on a line"
    return (
        f"of RMS extents {length / noise:.1f} and {breadth / noise:.1f} standard deviations, needed "
        f"{SURE:g} in both directions"
    )


def _too_few(places: int, turned: int, how: str = "") -> str:
    """Say why observed exterior orientation and control do not place the network."""
    return (
        f"datum 'control': the network has {counted(places, 'place')} of projection centres and control "
        f"points with X, Y and Z{how}, and the angles of {counted(turned, 'photograph')}; needed three "
        'places that are not on a line, or two and the angles of a photograph; for the shape alone, "free"'
    )
