"""Per-photograph interior orientation, for photographs that lose many of their points.

If a zoom slipped, a lens was refocused or a picture was resampled, the photograph shows the common points at
another scale. Its exterior orientation absorbs part of the difference, and the rejection of image points the
rest. Without this test, a photograph with only a few accepted points would count as oriented.

Photographs that lose more points to the outlier test than chance explains are examined. Each is adjusted
alone on the points of the others: with the camera that it shares, and with per-photograph parameters. The
gain in likelihood must pay for these parameters and for the search, as in `sfm.judgement.hypotheses`. It
must also exceed that of the alternatives there, because a wrong parameter that all photographs share makes
some of them look zoomed. A photograph that loses more than half of its points with either camera is left out.

Source: Rousseeuw and Leroy (1987), Robust Regression and Outlier Detection, sec. 1.2 (half of the points as
the breakdown point of any estimate); Rissanen (1978), Automatica 14 (likelihood of rejected points); Fischler
and Bolles (1981), sec. II (triples of points).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.statistics import more_than_chance
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.hypotheses.hypotheses import (
    MAX_PHOTOGRAPHS,
    PART_PHOTOGRAPHS,
    adjust_image_points,
    best_explanation,
)
from sfm.judgement.hypotheses.parts import MIN_RAYS, parts_of
from sfm.judgement.hypotheses.refit import log_likelihood_of
from sfm.judgement.model_choice import Choice, choose
from sfm.model.camera import Camera, tangents_from_pixel
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distortion.models import Role
from sfm.model.distributions import FALSE_ALARM, FAMILY, Levels
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.likelihood import log_likelihood, price_of
from sfm.model.network import ImagePoints, Network, ObjectPoints
from sfm.model.reduced_network import reduce_network
from sfm.model.remarks.remark import Remark, remark
from sfm.orientation.incremental.growth import residual_lengths
from sfm.orientation.resection.ransac import resect_robust

MAJORITY_FRACTION = 0.5  # of image points or photographs; the minority then does not fit
SCALES = np.geomspace(0.5, 2.0, 29)  # factors of c that are tried, 5 % apart
TOLERANCE = 1.5e-3  # of the longer side of the format: largest residual of good points if c is within 2.5 %
PAIR = 2  # photographs of a camera: nothing shows which of the two changed
FREED_ROLES = ((Role.FOCAL,), (Role.FOCAL, Role.X0, Role.Y0, Role.RADIAL))  # the simpler choice first


@dataclass(frozen=True)
class PhotographCameras:
    """A network in which misfitting photographs have per-photograph cameras, or are left out."""

    network: Network
    estimate: Estimate
    left_out: tuple[tuple[str, Remark], ...]  # (name of the photograph, reason)
    remarks: tuple[Remark, ...]  # on photographs with per-photograph cameras
    photographs: tuple[str, ...]  # names of the photographs with per-photograph cameras
    without: BoolArray  # photographs that are left out, (m,)


def find_photograph_cameras(
    network: Network,
    estimate: Estimate,
    accepted: BoolArray,
    *,
    oriented: BoolArray,
    suspected: tuple[str, ...] = (),
    false_alarm: float = FALSE_ALARM,
) -> PhotographCameras | None:
    """Give photographs that lost many of their points a per-photograph camera, or leave them out.

    Args:
        network: has all image points, and one camera for all photographs that share it.
        estimate: adjusted; NaN for photographs and points that were removed.
        accepted: image points that the adjustment accepted, (k,).
        oriented: photographs that had an exterior orientation before the adjustment, (m,).
        suspected: names of photographs that fitted with per-photograph cameras before; their points may bend
            the network so much that none of them looks wrong.
        false_alarm: probability that a right result is called wrong, as the user states it.

    Returns:
        The network, and the estimate with start values of the new cameras; None if nothing changes.
    """
    seen, m = network.image_points, len(network.images)
    known = estimate.determined[seen.point]
    count = np.bincount(seen.image[known], minlength=m)
    against = np.bincount(seen.image[known & ~accepted], minlength=m)
    enough = count > MAJORITY_FRACTION * np.bincount(seen.image, minlength=m)
    lost = against > MAJORITY_FRACTION * count
    unusual = more_than_chance(against, count, Levels(false_alarm).family)
    doubtful = enough & (unusual | (np.isin(network.images, suspected) & estimate.oriented))
    if not doubtful.any() or (doubtful & lost).sum() > MAJORITY_FRACTION * m:
        return None
    spread = residual_lengths(network, estimate)[known & accepted]
    sigma_px = float(np.median(spread)) / np.sqrt(2 * np.log(2))  # of a Rayleigh distribution
    cameras, owner = list(estimate.cameras), network.camera.copy()
    position, rotation = estimate.position.copy(), estimate.rotation.copy()
    left, remarks, changed = [], [], []
    out = np.zeros(m, dtype=bool)
    for i in np.flatnonzero(doubtful).tolist():
        name, before = network.images[i], estimate.cameras[network.camera[i]]
        rows = np.flatnonzero((seen.image == i) & known)
        has_others = (network.camera == network.camera[i]).sum() > 1  # else the camera is its own already
        fit = _photograph_camera(network, estimate, i, rows, sigma_px, false_alarm) if has_others else None
        if fit is None:
            out[i] = lost[i]
            if lost[i] and oriented[i]:
                reason = remark("photograph_contradicting", against=int(against[i]), points=int(count[i]))
                left.append((name, reason))
            continue
        camera, adjustment = fit
        owner[i] = len(cameras)
        cameras.append(camera)
        position[i], rotation[i] = adjustment.estimate.position[0], adjustment.estimate.rotation[0]
        changed.append(name)
        same = np.flatnonzero(network.camera == network.camera[i])
        remarks.append(
            remark(
                "camera_per_photograph",
                photograph=name,
                camera=before.name,
                rejected=int(against[i]),
                points=int(count[i]),
                parameters=[n for n, group in zip(camera.names, camera.shared, strict=True) if not group],
                change=(100 * (camera.c_px / before.c_px - 1), "%"),
                rms=(float(np.sqrt(np.mean(adjustment.residuals[~adjustment.rejected] ** 2))), "px"),
                other=[network.images[k] for k in same if k != i] if len(same) == PAIR else None,
            )
        )
    if changed:
        cameras[: len(estimate.cameras)] = [_with_parameter_groups(camera) for camera in estimate.cameras]
        own_network = replace(network, camera=owner)
        own_estimate = replace(estimate, cameras=tuple(cameras), position=position, rotation=rotation)
        if _explained_otherwise(network, estimate, own_network, own_estimate, accepted, ~out, false_alarm):
            changed, remarks = [], []
        else:
            network, estimate = own_network, own_estimate
    if not changed and not out.any():
        return None
    position = np.where(out[:, None], np.nan, estimate.position)
    rotation = np.where(out[:, None, None], np.nan, estimate.rotation)
    return PhotographCameras(
        network,
        replace(estimate, position=position, rotation=rotation),
        tuple(left),
        tuple(remarks),
        tuple(changed),
        out,
    )


def _explained_otherwise(
    network: Network,
    estimate: Estimate,
    own_network: Network,
    own_estimate: Estimate,
    accepted: BoolArray,
    kept: BoolArray,
    false_alarm: float,
) -> bool:
    """Return whether another cause makes the image points likelier than per-photograph cameras do.

    A network of very many photographs is tested in parts: the cause must be likelier in each of those that
    have a photograph with a camera of its own. Nothing speaks for it if no such photograph is oriented.

    own_network and own_estimate have the per-photograph cameras; kept photographs, (m,), are not left out.
    """
    images = kept & estimate.oriented
    parts = [images]
    if images.sum() > MAX_PHOTOGRAPHS:
        seen, theirs = network.image_points, network.camera != own_network.camera
        used = images[seen.image] & estimate.determined[seen.point]
        parts = [part & images for part in parts_of(network, used, PART_PHOTOGRAPHS)]
        parts = [part for part in parts if (part & theirs).any()]
    level = false_alarm / max(len(parts), 1)
    return bool(parts) and all(
        _is_explained_otherwise(network, estimate, own_network, own_estimate, accepted, part, level)
        for part in parts
    )


def _is_explained_otherwise(
    network: Network,
    estimate: Estimate,
    own_network: Network,
    own_estimate: Estimate,
    accepted: BoolArray,
    images: BoolArray,
    false_alarm: float,
) -> bool:
    """Return whether another cause is likelier in some photographs, (m,)."""
    seen, theirs = network.image_points, network.camera != own_network.camera
    rows = images[seen.image] & estimate.determined[seen.point]
    points = np.bincount(seen.point[rows], minlength=len(network.points)) >= MIN_RAYS
    rows &= points[seen.point]
    start = ~accepted[rows]
    adjusted = [
        adjust_image_points(
            *reduce_network(tried, values, images, points, rows),
            rejected,
            np.ones(int(rows.sum())),
            false_alarm=false_alarm,
        )
        for tried, values, rejected in (
            (network, estimate, start),
            (own_network, own_estimate, start & ~theirs[seen.image[rows]]),
        )
    ]
    plain, separate = adjusted
    other = None if plain is None else best_explanation(plain)
    if plain is None or other is None or other.alternative.kind == "other_camera":
        return False  # the rejected points show best which photographs these are
    if separate is None:
        return True
    camera_of_row = separate.network.camera[separate.network.image_points.image]
    search = float(np.log(len(FREED_ROLES) * len(network.images)))
    freed, price = 0, 0.0
    for index in np.unique(camera_of_row[camera_of_row >= len(estimate.cameras)]).tolist():
        q = sum(not group for group in own_estimate.cameras[index].shared)
        freed += q
        price += price_of(q, int((camera_of_row == index).sum()), search)
    gained = log_likelihood_of(separate, freed) - log_likelihood_of(plain) - price
    return other.evidence > gained


def _photograph_camera(
    network: Network, estimate: Estimate, image: int, rows: IntArray, sigma_px: float, false_alarm: float
) -> tuple[Camera, Adjustment] | None:
    """Return the per-photograph camera with which a photograph fits the points of the others, or None."""
    camera = estimate.cameras[network.camera[image]]
    if any(not group for group in camera.shared):
        return None  # has per-photograph parameters already
    seen = network.image_points
    xy, points, n = seen.xy[rows], estimate.points[seen.point[rows]], len(rows)
    start = _scaled_resection(camera, xy, points, SCALES)
    if start is None:
        return None
    alone = Network(
        (network.images[image],),
        np.zeros(1, dtype=np.int64),
        tuple(str(k) for k in range(n)),
        ImagePoints(np.zeros(n, dtype=np.int64), np.arange(n), xy, seen.covariance[rows]),
        observations=(ObjectPoints(np.arange(n), points, np.zeros((n, 3, 3))),),
    )
    nothing = np.zeros(len(camera.names), dtype=bool)
    begin = _scaled_resection(camera, xy, points, np.ones(1))
    shared = _adjust_alone(alone, begin, points, nothing, false_alarm)

    def freed_parameters(_: _Fit) -> Iterator[BoolArray]:
        for roles in FREED_ROLES:
            freed = camera.plays(*roles)
            freed[np.flatnonzero(camera.plays(Role.RADIAL))[1:]] = (
                False  # one photograph determines the first
            )
            yield freed

    def adjust_freed(freed: BoolArray) -> _Fit:
        return _Fit(_adjust_alone(alone, start, points, freed, false_alarm), freed)

    def gain(before: _Fit, after: _Fit) -> float:
        adjustment = after.adjustment
        if adjustment is None or adjustment.rejected.sum() > MAJORITY_FRACTION * n:
            return -np.inf
        if not SCALES[0] < adjustment.estimate.cameras[0].c_px / camera.c_px < SCALES[-1]:
            return -np.inf  # not a picture of these points: their names may be wrong
        sigma = max(sigma_px, adjustment.sigma0_px)
        return _likelihood(adjustment, camera, n, sigma) - _likelihood(before.adjustment, camera, n, sigma)

    row = Choice(
        freed_parameters,
        gain,
        lambda _, after: [(int(after.freed.sum()), n)],
        behind=len(SCALES) * len(network.images),
    )
    best = choose(_Fit(shared, nothing), (row,), adjust_freed, false_alarm=false_alarm)
    if best.adjustment is None or not best.freed.any():
        return None
    adjustment, freed = best.adjustment, best.freed
    variant = replace(
        camera,
        name=f"{camera.name} {network.images[image]}",
        parameters=np.where(freed, adjustment.estimate.cameras[0].parameters, camera.parameters),
        free=camera.free | freed,
        shared=tuple(
            "" if mine else group
            for mine, group in zip(freed, _with_parameter_groups(camera).shared, strict=True)
        ),
    )
    return variant, adjustment


@dataclass(frozen=True)
class _Fit:
    """One photograph on known points."""

    adjustment: Adjustment | None  # None without a solution
    freed: BoolArray  # parameters of its camera that are free


def _adjust_alone(
    alone: Network,
    start: tuple[Camera, FloatArray, FloatArray] | None,
    points: FloatArray,
    free: BoolArray,
    false_alarm: float,
) -> Adjustment | None:
    """Adjust one photograph on known points, with some parameters free; None if there is no solution."""
    if start is None or 2 * len(points) <= 6 + free.sum():
        return None
    camera, position, rotation = start
    begin = Estimate((replace(camera, free=free, shared=()),), position[None], rotation[None], points)
    try:
        adjustment = adjust(alone, begin, datum=Datum("control"), false_alarm=false_alarm)
    except (GeometryError, np.linalg.LinAlgError):
        return None
    return adjustment if adjustment.converged and adjustment.redundancy > 0 else None


def _likelihood(adjustment: Adjustment | None, camera: Camera, count: int, sigma_px: float) -> float:
    """Return the log-likelihood of a photograph, with misfits where that is likelier."""
    areas = np.full(count, float(np.prod(camera.size_px)))
    squares = np.full(count, np.inf)
    if adjustment is not None:
        squares = np.nan_to_num((adjustment.residuals**2).sum(axis=1), nan=np.inf)
    fits = squares < 2 * sigma_px**2 * np.log(areas / (2 * np.pi * sigma_px**2))
    return log_likelihood(float(squares[fits].sum()), fits, areas, sigma_px=sigma_px)


def _scaled_resection(
    camera: Camera, xy: FloatArray, points: FloatArray, scales: FloatArray
) -> tuple[Camera, FloatArray, FloatArray] | None:
    """Return the camera with c times the best of the scales, and the exterior orientation."""
    best: tuple[float, Camera, FloatArray, FloatArray] | None = None
    tolerance_px = TOLERANCE * max(camera.size_px)
    # trials that find a triple of good points, except with probability FAMILY over all scales
    trials = math.ceil(math.log(FAMILY / len(SCALES)) / math.log1p(-((1 - MAJORITY_FRACTION) ** 3)))
    for scale in scales:
        p = camera.parameters.copy()
        p[camera.parts[0]] *= scale
        scaled = camera.with_parameters(p)
        resected = resect_robust(
            tangents_from_pixel(scaled, xy), points, tolerance=tolerance_px / scaled.c_px, max_trials=trials
        )
        if not resected.found:
            continue
        squares = np.sum((resected.residuals * scaled.c_px) ** 2, axis=1)
        cost = float(np.minimum(np.where(np.isnan(squares), np.inf, squares), tolerance_px**2).sum())
        if best is None or cost < best[0]:
            best = cost, scaled, resected.position, resected.rotation
    return None if best is None else best[1:]


def _with_parameter_groups(camera: Camera) -> Camera:
    """Return the camera with its parameters in groups, which it shares with cameras split off from it."""
    shared = tuple(camera.owner_of(s) for s in range(len(camera.names)))
    return camera if camera.shared else replace(camera, shared=shared)
