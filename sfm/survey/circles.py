"""Eccentricity of circular targets: the centre of an ellipse is not the image of the circle's centre.

Each target's ellipses in several photographs give a circle in space. Image points of circles are corrected
for eccentricity. Uncoded points whose outlines are not images of one circle are removed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.judgement.survey_result import Eccentricity
from sfm.model.camera import pixel_curvature, pixel_jacobian, ray_jacobian
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.distortion.models import MODELS
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, rows_of
from sfm.model.remarks.remark import Remark, remark
from sfm.orientation.eccentricity import CircleViews, ellipse_shape, fit_circles
from sfm.orientation.image_rays import axes_along
from sfm.survey.inputs.measurements import MeasuredPhotographs, Naming
from sfm.survey.inputs.survey import Survey
from sfm.survey.placing import object_scale
from sfm.survey.target_network import UNNAMED
from sfm.targets.outlines import Flag

# Points that are not centres of ellipses have no eccentricity.
NO_CIRCLE = Flag.CORNER | Flag.CROSSING | Flag.CONCENTRIC

# Relative misfit of the semi-axes; targets have 0.003 to 0.03, letters and leaves over 0.2.
NOT_A_CIRCLE = 0.1
# Relative difference of a stated diameter from that of the ellipses, which are good to 1 to 3 %.
OTHER_SIZE = 0.1


@dataclass(frozen=True)
class CircleCheck:
    """The network after its targets were compared with circles in space."""

    network: Network  # its image points are corrected to the centres of the circles
    estimate: Estimate  # without the points that are not circles
    no_circles: tuple[str, ...]  # uncoded points left out: their outlines are not images of one circle
    eccentricity: Eccentricity | None  # of the corrections; None without corrections
    remarks: tuple[Remark, ...] = ()  # on stated diameters


def check_circles(
    survey: Survey, photographs: MeasuredPhotographs, naming: Naming, network: Network, estimate: Estimate
) -> CircleCheck:
    """Remove uncoded points that are not circles, and correct the others for eccentricity.

    Radius and normal of every target come from its ellipses. A diameter that the survey states replaces the
    radius. The covariance of the correction is added to that of the image point.

    Args:
        survey: states whether to correct the eccentricity, and the diameter if it is known.
        photographs: the targets that `network` was built from.
        naming: object point of each target.
        network: all image points.
        estimate: adjusted, in any datum and scale.
    """
    seen = network.image_points
    rows = _seen_twice(photographs, naming, network, estimate)
    numbers, point = np.unique(seen.point[rows], return_inverse=True)
    if not len(numbers):
        return CircleCheck(network, estimate, (), None)
    views = _circle_views(photographs, naming, network, estimate, rows, point)
    circles = fit_circles(views, len(numbers))
    no_circle = numbers[(circles.misfit > NOT_A_CIRCLE) & (naming.code[numbers] < 0)]
    points = estimate.points.copy()
    points[no_circle] = np.nan
    estimate = replace(estimate, points=points)
    names = tuple(network.points[j] for j in no_circle)
    if not survey.targets.eccentricity:
        return CircleCheck(network, estimate, names, None)
    names_of_circles = tuple(network.points[j] for j in numbers)
    diameter = survey.targets.diameter
    known = np.full(len(names_of_circles), np.nan if diameter is None else diameter / 2)
    remarks: tuple[Remark, ...] = ()
    if survey.diameters is not None:
        measured = set(network.points)
        stated = dict(zip(survey.diameters.names, survey.diameters.diameter.tolist(), strict=True))
        known = np.array([stated.get(p, 2 * r) / 2 for p, r in zip(names_of_circles, known, strict=True)])
        unknown = [name for name in survey.diameters.names if name not in measured]
        if unknown:
            remarks = (remark("names_missing", of="diameters", names=unknown),)
    if np.isfinite(known).any():
        scale = object_scale(network, estimate)
        other: tuple[Remark, ...] = ()
        if np.isfinite(scale):
            other = _remarks_on_diameters(survey, names_of_circles, known, scale * circles.radius)
            remarks += other
        if other or not np.isfinite(scale):  # a bar may be wrong: the targets alone give the scale
            scale = float(np.nanmedian(known / circles.radius))
        circles = fit_circles(views, len(numbers), radius=known / scale)
    xy, covariance = seen.xy.copy(), seen.covariance.copy()
    xy[rows] -= circles.shift
    covariance[rows] += circles.shift_covariance
    corrected = replace(network, image_points=ImagePoints(seen.image, seen.point, xy, covariance))
    kept = np.isin(numbers, no_circle, invert=True)[point]
    length = np.linalg.norm(circles.shift[kept], axis=1)
    sigma = np.trace(circles.shift_covariance[kept], axis1=1, axis2=2) / 2
    summary = Eccentricity(
        float(length.max(initial=0.0)),
        float(np.sqrt(np.sum(length**2) / max(2 * len(length), 1))),
        float(np.sqrt(np.sum(sigma) / max(len(sigma), 1))),
    )
    return CircleCheck(corrected, estimate, names, summary, remarks)


def circle_misfit(
    photographs: MeasuredPhotographs, naming: Naming, network: Network, estimate: Estimate
) -> float:
    """Return the median misfit of the targets as circles, relative to their size; infinite without targets.

    A wrong solution of a plane distorts the plane, so that its circles become ellipses with large misfits.

    Args:
        photographs: the targets that `network` was built from.
        naming: object point of each target.
        network: all image points.
        estimate: in any datum and scale; points and photographs that are NaN are ignored.
    """
    rows = _seen_twice(photographs, naming, network, estimate)
    numbers, point = np.unique(network.image_points.point[rows], return_inverse=True)
    if not len(numbers):
        return float("inf")
    circles = fit_circles(_circle_views(photographs, naming, network, estimate, rows, point), len(numbers))
    return float(np.median(circles.misfit))


def _seen_twice(
    photographs: MeasuredPhotographs, naming: Naming, network: Network, estimate: Estimate
) -> BoolArray:
    """Return which image points belong to targets with outlines in two or more oriented photographs, (k,)."""
    seen = network.image_points
    rows = estimate.oriented[seen.image] & estimate.determined[seen.point]
    rows &= _values_of_image_points(
        naming, [(targets.flag & NO_CIRCLE) == 0 for targets in photographs.targets]
    )
    rays = np.bincount(seen.point[rows], minlength=len(network.points))
    return np.asarray(rows & (rays[seen.point] >= 2))


def _remarks_on_diameters(
    survey: Survey, points: tuple[str, ...], stated: FloatArray, measured: FloatArray
) -> tuple[Remark, ...]:
    """Return remarks on stated diameters that the ellipses contradict.

    The common diameter of all targets is judged by their median, since the uncoded ones may include other
    round things. The diameters of a table are judged one by one.

    Args:
        survey: states which diameters apply to single targets.
        points: names of the targets, (n,).
        stated: stated radii, NaN where not stated, object unit, (n,).
        measured: radii from the ellipses, object unit, (n,).
    """
    single = np.zeros(len(points), dtype=bool)
    if survey.diameters is not None:
        single = np.isin(points, survey.diameters.names)
    remarks = []
    common = ~single & np.isfinite(stated)
    if common.any():
        given, seen = 2 * stated[common][0], 2 * float(np.median(measured[common]))
        if abs(np.log(given / seen)) > np.log1p(OTHER_SIZE):
            remarks.append(
                remark(
                    "diameters_differ",
                    differing=int(common.sum()),
                    stated=(given, survey.unit),
                    found=(seen, survey.unit),
                )
            )
    differs = single & (np.abs(np.log(stated / measured)) > np.log1p(OTHER_SIZE))
    if differs.any() and survey.diameters is not None:
        worst = int(np.nanargmax(np.where(differs, np.abs(np.log(stated / measured)), np.nan)))
        remarks.append(
            remark(
                "diameters_differ",
                target=points[worst],
                stated=(2 * stated[worst], survey.unit),
                found=(2 * measured[worst], survey.unit),
                differing=int(differs.sum()),
                total=int(single.sum()),
            )
        )
    return tuple(remarks)


def _values_of_image_points(naming: Naming, values: list[AnyArray]) -> AnyArray:
    """Return the values of the named targets in the order of the image points, (k, ...).

    values: one array for each photograph, with a row for each of its targets.
    """
    targets = zip(values, naming.point, strict=True)
    return np.concatenate([of_photograph[named != UNNAMED] for of_photograph, named in targets])


def _circle_views(
    photographs: MeasuredPhotographs,
    naming: Naming,
    network: Network,
    estimate: Estimate,
    rows: BoolArray,
    point: IntArray,
) -> CircleViews:
    """Return the ellipses of the selected image points, with their rays."""
    shapes = [ellipse_shape(targets.semi_axes, targets.angle) for targets in photographs.targets]
    shape = _values_of_image_points(naming, shapes)[rows]
    seen = network.image_points.select(rows)
    rotation = estimate.rotation[seen.image]
    outward = estimate.points[seen.point] - estimate.position[seen.image]
    rays = np.einsum("kji,kj->ki", rotation, outward)
    rotation = rotation.copy()
    jacobian, curvature = np.empty((len(seen), 2, 2)), np.empty((len(seen), 2, 2, 2))
    of_camera = rows_of(network.camera[seen.image], len(estimate.cameras))
    for camera, of_one in zip(estimate.cameras, of_camera, strict=True):
        if MODELS[camera.model].stereographic:  # tangents about the ray; those about the axis may not exist
            along, ahead = axes_along(rays[of_one]), np.zeros((len(of_one), 2))
            distance = np.linalg.norm(rays[of_one], axis=1)
            by_ray = ray_jacobian(camera, seen.xy[of_one], rays[of_one] / distance[:, None])
            jacobian[of_one] = by_ray @ along[:, :, :2]
            curvature[of_one] = np.nan_to_num(pixel_curvature(camera, ahead, along))
            rotation[of_one] = rotation[of_one] @ along
            rays[of_one] = np.column_stack([ahead, -distance])
        else:
            jacobian[of_one] = pixel_jacobian(camera, seen.xy[of_one])
            curvature[of_one] = np.nan_to_num(pixel_curvature(camera, -rays[of_one, :2] / rays[of_one, 2:]))
    return CircleViews(point, shape, rays, rotation, jacobian, curvature)
