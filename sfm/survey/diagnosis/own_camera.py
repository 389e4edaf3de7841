"""Photographs that lose most of their points: whether an interior orientation of their own explains them.

A zoom that slipped, a lens that was focused anew or a picture that was resampled shows the points of the
others at another scale. Its exterior orientation takes up a part of that, and the rejection of image points
the rest, so that a photograph with a few accepted points would stand among the oriented ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.camera import Camera, tangents_from_pixel
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.distortion.models import Role
from sfm.errors import GeometryError
from sfm.network import Estimate, ImagePoints, Network, ObjectPoints, rows_of
from sfm.orientation.incremental.growth import residual_lengths
from sfm.orientation.resection.ransac import resect_robust
from sfm.remarks.remark import Remark, remark

LOST = 0.5  # share of the image points of a photograph without which the rest does not speak for it
EXPLAINED = 0.2  # of them that may still be rejected where a camera of its own explains the photograph
UNLIKE = 3.0  # times the median residual of the others: a photograph of which no point need be rejected
BETTER = 0.5  # of its median residual: what a camera of its own must reach
MIN_POINTS = 8  # of a photograph, for exterior orientation, c and some redundancy
MAX_FRACTION = 1 / 3  # of the survey: if more do not fit, it is not the single photograph that is wrong
SCALES = np.geomspace(0.5, 2.0, 29)  # of c that are tried, 5 % apart
TOLERANCE_PX = 8.0  # largest residual of a point that fits with c to 2.5 %; the adjustment follows
TRIALS = 300  # triples for each scale
SIGNIFICANT = 4.0  # standard deviations by which the own c differs
OWN = ((Role.FOCAL,), (Role.FOCAL, Role.X0, Role.Y0, Role.RADIAL))  # parameters of its own, the fewest first


@dataclass(frozen=True)
class Treated:
    """A network after its photographs that did not fit were given a camera of their own, or left out."""

    network: Network
    estimate: Estimate
    left_out: tuple[tuple[str, Remark], ...]  # (name of the photograph, reason)
    remarks: tuple[Remark, ...]  # on those with a camera of their own
    own: tuple[str, ...]  # names of these
    without: BoolArray  # photographs that are left out, (m,)


@dataclass(frozen=True)
class _Fit:
    """One photograph resected on the points of the others with a camera of its own."""

    camera: Camera
    position: FloatArray
    rotation: FloatArray
    rejected: int
    rms_px: float  # of the accepted image coordinates


def treat_lost(
    network: Network,
    estimate: Estimate,
    accepted: BoolArray,
    *,
    oriented: BoolArray,
    suspected: tuple[str, ...] = (),
) -> Treated | None:
    """Give photographs that lost most of their points a camera of their own, or leave them out.

    Args:
        network: all image points, a camera each for what shares one.
        estimate: adjusted; NaN for photographs and points that left it.
        accepted: image points that the adjustment accepted, (k,).
        oriented: photographs that had an exterior orientation before the adjustment, (m,).
        suspected: names of photographs that fitted with a camera of their own before; all their points
            together may bend the others so much that none of them looks wrong.

    Returns:
        The network, and the estimate with start values of the new cameras; None where nothing is to be done.
    """
    seen, m = network.image_points, len(network.images)
    known = estimate.determined[seen.point]
    count = np.bincount(seen.image[known], minlength=m)
    kept = np.bincount(seen.image[known & accepted], minlength=m)
    everything = np.bincount(seen.image, minlength=m)
    enough = (count >= MIN_POINTS) & (count > LOST * everything)
    lost = enough & (kept < (1 - LOST) * count)
    length = residual_lengths(network, estimate)
    median = np.array(
        [np.median(length[rows]) if len(rows) else np.inf for rows in _finite_rows(seen, length, m)]
    )
    unlike = enough & estimate.oriented & (median > UNLIKE * np.median(median[estimate.oriented]))
    known_before = np.isin(network.images, suspected)
    doubtful = lost | unlike | (enough & known_before & estimate.oriented)
    if not doubtful.any() or doubtful.sum() > MAX_FRACTION * m:
        return None
    cameras, owner = list(estimate.cameras), network.camera.copy()
    position, rotation = estimate.position.copy(), estimate.rotation.copy()
    left, remarks, with_own = [], [], []
    out = np.zeros(m, dtype=bool)
    for i in np.flatnonzero(doubtful).tolist():
        rows = np.flatnonzero((seen.image == i) & known)
        better = median[i] if known_before[i] else BETTER * median[i]
        fit = _own_camera(network, estimate, i, rows, better)
        name = network.images[i]
        if fit is None and not lost[i]:
            continue  # told as not like the others, with all its points
        if fit is None:
            if oriented[i]:
                left.append(
                    (
                        name,
                        remark(
                            "photograph_not_explained",
                            against=int(count[i] - kept[i]),
                            points=int(count[i]),
                        ),
                    )
                )
            out[i] = True
            continue
        before = estimate.cameras[network.camera[i]]
        cameras.append(fit.camera)
        owner[i] = len(cameras) - 1
        position[i], rotation[i] = fit.position, fit.rotation
        with_own.append(name)
        own = [n for n, group in zip(fit.camera.names, fit.camera.shared, strict=True) if not group]
        share = fit.camera.c_px / before.c_px - 1
        remarks.append(
            remark(
                "camera_per_photograph",
                photograph=name,
                camera=before.name,
                rejected=int(count[i] - kept[i]),
                points=int(count[i]),
                parameters=own,
                change=(100 * share, "%"),
                rms=(fit.rms_px, "px"),
            )
        )
    if len(cameras) == len(estimate.cameras) and not out.any():
        return None
    if len(cameras) > len(estimate.cameras):
        cameras[: len(estimate.cameras)] = [_sharing(camera) for camera in estimate.cameras]
    position[out], rotation[out] = np.nan, np.nan
    return Treated(
        replace(network, camera=owner),
        replace(estimate, cameras=tuple(cameras), position=position, rotation=rotation),
        tuple(left),
        tuple(remarks),
        tuple(with_own),
        out,
    )


def _finite_rows(seen: ImagePoints, length: FloatArray, m: int) -> list[IntArray]:
    """Return the image points of each photograph that have a residual."""
    finite = np.flatnonzero(np.isfinite(length))
    return [finite[rows] for rows in rows_of(seen.image[finite], m)]


def _own_camera(
    network: Network, estimate: Estimate, image: int, rows: IntArray, most_px: float
) -> _Fit | None:
    """Return the least special camera with which a photograph fits the points of the others, if any does."""
    camera = estimate.cameras[network.camera[image]]
    if any(not group for group in camera.shared):
        return None  # has parameters of its own already
    seen = network.image_points
    xy, points = seen.xy[rows], estimate.points[seen.point[rows]]
    start = _scaled_resection(camera, xy, points)
    if start is None:
        return None
    scaled, position, rotation = start
    n = len(rows)
    alone = Network(
        (network.images[image],),
        np.zeros(1, dtype=np.int64),
        tuple(str(k) for k in range(n)),
        ImagePoints(np.zeros(n, dtype=np.int64), np.arange(n), xy, seen.covariance[rows]),
        ObjectPoints(np.arange(n), points, np.zeros((n, 3, 3))),
    )
    for roles in OWN:
        own = scaled.plays(*roles) & _usable(scaled)
        begin = Estimate((replace(scaled, free=own, shared=()),), position[None], rotation[None], points)
        try:
            found = adjust(alone, begin, datum=Datum("control"), reject="tau")
        except (GeometryError, np.linalg.LinAlgError):
            continue
        moved = abs(found.estimate.cameras[0].c_px - camera.c_px)
        sigma = found.interior_sigma(0)[0] * (1.0 if not camera.in_mm else 1.0 / np.mean(camera.pixel_mm))
        rejected = int(found.rejected.sum())
        rms = float(np.sqrt(np.mean(found.residuals[~found.rejected] ** 2)))
        if found.converged and rejected <= EXPLAINED * n and moved > SIGNIFICANT * sigma and rms < most_px:
            shared = tuple("" if mine else (camera.group_of(s) or camera.name) for s, mine in enumerate(own))
            values = np.where(own, found.estimate.cameras[0].parameters, camera.parameters)
            variant = replace(
                camera,
                name=f"{camera.name} {network.images[image]}",
                parameters=values,
                free=camera.free | own,
                shared=shared,
            )
            return _Fit(variant, found.estimate.position[0], found.estimate.rotation[0], rejected, rms)
    return None


def _usable(camera: Camera) -> BoolArray:
    """Return which parameters one photograph on known points can determine: of the radial ones the first."""
    radial = np.flatnonzero(camera.plays(Role.RADIAL))
    out = np.ones(len(camera.names), dtype=bool)
    out[radial[1:]] = False
    return out


def _scaled_resection(
    camera: Camera, xy: FloatArray, points: FloatArray
) -> tuple[Camera, FloatArray, FloatArray] | None:
    """Return the camera with c multiplied by the factor that fits best, and the exterior orientation."""
    best: tuple[float, Camera, FloatArray, FloatArray] | None = None
    for scale in SCALES:
        p = camera.parameters.copy()
        p[camera.parts[0]] *= scale
        one = camera.with_parameters(p)
        tolerance = TOLERANCE_PX / one.c_px
        found = resect_robust(tangents_from_pixel(one, xy), points, tolerance=tolerance, max_trials=TRIALS)
        if not found.found:
            continue
        squares = np.sum((found.residuals * one.c_px) ** 2, axis=1)
        cost = float(np.minimum(np.where(np.isnan(squares), np.inf, squares), TOLERANCE_PX**2).sum())
        if best is None or cost < best[0]:
            best = cost, one, found.position, found.rotation
    return None if best is None else best[1:]


def _sharing(camera: Camera) -> Camera:
    """Return a camera that shares its parameters, in groups, with those that were split off it."""
    shared = tuple(camera.group_of(s) or camera.name for s in range(len(camera.names)))
    return camera if camera.shared else replace(camera, shared=shared)
