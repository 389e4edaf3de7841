"""Key points of a model measured anew, each in all photographs of its point by the window of one of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm.conventions import MAD_TO_SIGMA, FloatArray, IntArray
from sfm.matching.lsm.coverage import WINDOWS_PX, largest_alike
from sfm.matching.lsm.projected_points import plane_warps
from sfm.matching.lsm.surface_planes import planes_at
from sfm.matching.lsm.two_photo import match_lsm
from sfm.matching.lsm.warp import linear_part
from sfm.network import Estimate, ImagePoints, Network, rows_of
from sfm.orientation.image_rays import intersect_image_points
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.refining.model_photographs import Photographs

TRIAL_PHOTOGRAPHS = 3  # whose points choose the window
MIN_RAYS = 3  # of a point that is measured
TRIAL_RAYS = 100  # with fewer the window stays as it is


class Limits(NamedTuple):
    """What is a match no more."""

    shift_px: float  # farther from the key point
    correlation: float  # below it a window is not alike


@dataclass(frozen=True)
class Windows:
    """Image points measured anew."""

    xy: FloatArray  # px, NaN where the flag says why, (k, 2)
    covariance: FloatArray  # px^2, (k, 2, 2)
    flag: IntArray  # see LsmFlag, (k,)


def match_windows(
    photographs: Photographs,
    network: Network,
    estimate: Estimate,
    rows: IntArray,
    reference: IntArray,
    *,
    window_px: int,
    limits: Limits,
    progress: Progress = SILENT,
) -> Windows:
    """Measure image points by least squares matching from the reference photograph of their point.

    The window is seen in perspective on the plane through the points around it. In the reference it is moved
    to a whole pixel, which needs no resampling. Half of the noise of a match is that of the template and goes
    to the reference.

    Args:
        photographs: of the model.
        network: the model.
        estimate: its solution.
        rows: image points to measure, (k,).
        reference: the row of each point that is its template, -1 for points that are not measured, (n,).
        window_px: odd side of the windows.
        limits: what is a match no more.
        progress: told of reference photographs.

    Raises:
        PhotographError: a photograph that cannot be read, or of another size than its camera.

    Source: Gruen (1985), S. Afr. J. Photogrammetry 14(3).
    """
    seen, camera = network.image_points, network.camera
    xy, covariance = np.full((len(seen), 2), np.nan), np.full((len(seen), 2, 2), np.nan)
    flag = np.zeros(len(seen), dtype=np.int64)
    at_template, number = np.zeros((len(reference), 2, 2)), np.zeros(len(reference), dtype=np.int64)
    template_of = reference[seen.point]
    place = np.rint(seen.xy[template_of])  # px, in the reference, (k, 2)
    from_photograph = rows_of(seen.image[template_of[rows]], len(network.images))
    of_photograph = rows_of(seen.image, len(network.images))
    progress.stage("matching", sum(len(own) > 0 for own in from_photograph))
    for i, part in enumerate(from_photograph):
        if not len(part):
            continue
        own = rows[part]
        own = own[seen.image[own] != i]
        points, normal = _planes(estimate, camera, i, place[own], seen.point[own], of_photograph[i], seen)
        warp = plane_warps(estimate, camera, i, seen.image[own], place[own], points, normal, window_px / 2)
        moved = np.einsum("kij,kj->ki", linear_part(warp), place[own] - seen.xy[template_of[own]])
        others, number_of = np.unique(seen.image[own], return_inverse=True)
        for j, some in zip(others.tolist(), rows_of(number_of, len(others)), strict=True):
            to = own[some]
            match = match_lsm(
                photographs.grey(i),
                photographs.grey(j),
                place[to],
                seen.xy[to] + moved[some],
                window_px=window_px,
                start=warp[some],
                max_shift_px=limits.shift_px,
                min_correlation=limits.correlation,
            )
            flag[to] = match.flag
            good = match.good
            half, back = match.covariance[good] / 2, np.linalg.inv(linear_part(match.warp[good]))
            xy[to[good]], covariance[to[good]] = match.xy[good], half
            at_template[seen.point[to[good]]] += back @ half @ back.transpose(0, 2, 1)
            number[seen.point[to[good]]] += 1
        progress.advance(network.images[i])
    some = np.flatnonzero(number)
    xy[reference[some]] = place[reference[some]]
    covariance[reference[some]] = at_template[some] / number[some, None, None]
    return Windows(xy, covariance, flag)


def best_window(
    photographs: Photographs,
    network: Network,
    estimate: Estimate,
    rows: IntArray,
    reference: IntArray,
    *,
    limits: Limits,
    tolerance_px: float,
) -> int:
    """Return the side of the windows with which the same pixels are the most precise, px.

    A few photographs whose orientation is known to less than the matches tell.

    Args:
        photographs: of the model.
        network: the model.
        estimate: adjusted with windows of one size.
        rows: image points that can be measured, (k,).
        reference: as in `match_windows`.
        limits: likewise.
        tolerance_px: largest residual of a ray that counts.
    """
    template = network.image_points.image[reference[network.image_points.point[rows]]]
    most = np.argsort(-np.bincount(template, minlength=len(network.images)), kind="stable")
    some = rows[np.isin(template, most[:TRIAL_PHOTOGRAPHS])]
    costs: list[tuple[int, float]] = []
    for window in WINDOWS_PX:
        found = match_windows(
            photographs, network, estimate, some, reference, window_px=window, limits=limits
        )
        v = _residuals(network, estimate, found, tolerance_px)
        if len(v) >= TRIAL_RAYS:
            costs.append((window, window * MAD_TO_SIGMA * float(np.median(np.abs(v)))))
    return largest_alike(costs) if costs else WINDOWS_PX[0]


def _residuals(network: Network, estimate: Estimate, windows: Windows, tolerance_px: float) -> FloatArray:
    """Return the residuals of the rays that meet in their points, tangents, (k, 2)."""
    seen = network.image_points
    good = np.isfinite(windows.xy).all(axis=1)
    rays = ImagePoints(seen.image[good], seen.point[good], windows.xy[good], windows.covariance[good])
    met = intersect_image_points(
        rays, network.camera, estimate, n_points=len(network.points), tolerance_px=tolerance_px
    )
    return met.residuals[met.used & (met.rays >= MIN_RAYS)[rays.point]]


def _planes(
    estimate: Estimate,
    camera: IntArray,
    i: int,
    place: FloatArray,
    point: IntArray,
    own: IntArray,
    seen: ImagePoints,
) -> tuple[FloatArray, FloatArray]:
    """Return object points and normals of places of a photograph; it is faced where no plane is known."""
    points, normal = planes_at(estimate, camera, i, place, seen.point[own])
    unknown = ~np.isfinite(points).all(axis=1)
    points[unknown] = estimate.points[point[unknown]]
    normal[unknown] = estimate.rotation[i][:, 2]
    return points, normal
