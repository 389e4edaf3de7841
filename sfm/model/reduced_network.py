"""Reduces networks to parts with new indices, and checks networks before they are adjusted.

Networks passed from Python are checked as strictly as files: shapes, indices, numbers and covariances. The
message names the first error and states what was expected.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.observations.kind import Kind

CORRELATION_LIMIT = 0.999999  # above it a covariance matrix is singular in floating point
K = TypeVar("K", bound=Kind)
MIN_IMAGE_POINTS = 4  # fewest per photograph in the final adjustment: three determine it, the fourth checks


def reduce_network(
    network: Network, estimate: Estimate, images: BoolArray, points: BoolArray, image_points: BoolArray
) -> tuple[Network, Estimate]:
    """Return the network and estimate of the photographs, points and image points to keep.

    Args:
        network: network of m photographs, n points and k image points.
        estimate: estimate of this network.
        images: photographs to keep, (m,).
        points: points to keep, (n,).
        image_points: image points to keep, (k,); those of dropped photographs and points are dropped too.

    Returns:
        Reduced network and estimate, with new indices and without observations of dropped points and
        photographs.
    """
    image_index = np.cumsum(images) - 1
    point_index = np.cumsum(points) - 1
    seen = network.image_points.select(
        image_points & images[network.image_points.image] & points[network.image_points.point]
    )

    def kept(kind: K) -> K:
        return kind.keep(points, images).renumbered(point_index, image_index)

    reduced = replace(
        network,
        images=tuple(name for name, keep in zip(network.images, images, strict=True) if keep),
        camera=network.camera[images],
        moment=None if network.moment is None else network.moment[images],
        points=tuple(name for name, keep in zip(network.points, points, strict=True) if keep),
        image_points=replace(seen, image=image_index[seen.image], point=point_index[seen.point]),
        observations=tuple(kind for kind in map(kept, network.observations) if len(kind)),
    )
    return reduced, replace(
        estimate,
        position=estimate.position[images],
        rotation=estimate.rotation[images],
        points=estimate.points[points],
    )


def select_supported(
    network: Network,
    estimate: Estimate,
    accepted: BoolArray,
    *,
    min_points: int | IntArray,
    min_rays: int | IntArray,
) -> tuple[BoolArray, BoolArray]:
    """Return the photographs and points that remain after dropping those with too few image points.

    Each dropped photograph or point takes its image points with it, so the test is repeated until nothing
    changes.

    Args:
        network: network of m photographs, n points and k image points.
        estimate: estimate of this network.
        accepted: image points that count, (k,).
        min_points: image points that a photograph needs, one number or (m,).
        min_rays: image points that a point needs, one number or (n,).

    Returns:
        Masks of photographs (m,) and points (n,), restricted to oriented photographs and determined points.
    """
    seen = network.image_points
    images, points = estimate.oriented, estimate.determined
    while True:
        used = accepted & images[seen.image] & points[seen.point]
        shown = np.bincount(seen.image[used], minlength=len(images))
        rays = np.bincount(seen.point[used], minlength=len(points))
        still_images, still_points = images & (shown >= min_points), points & (rays >= min_rays)
        if (still_images == images).all() and (still_points == points).all():
            return images, points
        images, points = still_images, still_points


def select_determined(
    network: Network,
    estimate: Estimate,
    accepted: BoolArray,
    min_rays: IntArray,
    min_points: int | IntArray = MIN_IMAGE_POINTS,
) -> tuple[BoolArray, BoolArray]:
    """Return the photographs (m,) and points (n,) that accepted image points determine.

    Args:
        network: network of m photographs, n points and k image points.
        estimate: estimate of this network.
        accepted: image points that count, (k,).
        min_rays: image points that a point needs, (n,).
        min_points: image points that a photograph needs, one number or (m,).

    Raises:
        GeometryError: fewer than two photographs remain.
    """
    images, points = select_supported(network, estimate, accepted, min_points=min_points, min_rays=min_rays)
    if images.sum() < 2:
        needed = " or ".join(str(least) for least in np.unique(min_points))
        moments = 0 if network.moment is None else int((np.bincount(network.moment) > 1).sum())
        paired = (
            f"; {counted(moments, 'moment')} may pair photographs of different moments, see [[rig]] moment"
        )
        raise GeometryError(
            f"{images.sum()} of {len(images)} photographs see enough points of the network (at least "
            f"{needed}), at least 2 photographs are needed{paired if moments else ''}"
        )
    return images, points


def merge_estimate(part: Estimate, images: BoolArray, points: BoolArray) -> Estimate:
    """Return the estimate of all photographs (m,) and points (n,), with NaN outside the given part."""
    position, rotation = np.full((len(images), 3), np.nan), np.full((len(images), 3, 3), np.nan)
    xyz = np.full((len(points), 3), np.nan)
    position[images], rotation[images], xyz[points] = part.position, part.rotation, part.points
    return replace(part, position=position, rotation=rotation, points=xyz)


def check_network(network: Network, estimate: Estimate) -> None:
    """Refuse a network and an estimate that do not fit together or contain values that cannot be adjusted.

    Args:
        network: the measurements.
        estimate: start values; NaN where unknown.

    Raises:
        GeometryError: the message states what was found, where, and what was expected.
    """
    if not isinstance(network, Network) or not isinstance(estimate, Estimate):
        given = f"{type(network).__name__} and {type(estimate).__name__}"
        raise GeometryError(f"adjustment: {given}, expected a Network and an Estimate")
    m, n = len(network.images), len(network.points)
    seen = network.image_points
    k = len(seen)
    for what, array, shape in (
        ("projection centres", estimate.position, (m, 3)),
        ("rotations", estimate.rotation, (m, 3, 3)),
        ("object points", estimate.points, (n, 3)),
        ("cameras of the photographs", network.camera, (m,)),
        ("image points", seen.xy, (k, 2)),
        ("covariances of the image points", seen.covariance, (k, 2, 2)),
        ("photographs of the image points", seen.image, (k,)),
        ("object points of the image points", seen.point, (k,)),
        ("control coordinates", network.control.xyz, (len(network.control), 3)),
        ("covariances of the control", network.control.covariance, (len(network.control), 3, 3)),
    ):
        if np.shape(array) != shape:
            raise GeometryError(f"network: {what} of shape {np.shape(array)}, expected {shape}")
    for what, index, count in (
        ("camera", network.camera, len(estimate.cameras)),
        ("photograph", seen.image, m),
        ("object point", seen.point, n),
        ("object point", network.control.point, n),
        ("object point", network.scale_bars.start, n),
        ("object point", network.scale_bars.end, n),
        ("photograph", network.exterior.image, m),
    ):
        if not np.issubdtype(np.asarray(index).dtype, np.integer):
            raise GeometryError(
                f"network: indices of a {what} of type {np.asarray(index).dtype}, expected whole numbers"
            )
        wrong = _first((index < 0) | (index >= count))
        if wrong is not None:
            raise GeometryError(f"network: index {index[wrong]} of a {what}, expected 0 to {count - 1}")

    def of_row(row: int) -> str:
        return f"image {network.images[seen.image[row]]}, point {network.points[seen.point[row]]}"

    wrong = _first(np.asarray(~np.isfinite(seen.xy).all(axis=1)))
    if wrong is not None:
        raise GeometryError(
            f"{of_row(wrong)}: image coordinates {_in_text(seen.xy[wrong])} px, expected numbers"
        )
    a, b, c = seen.covariance[:, 0, 0], seen.covariance[:, 0, 1], seen.covariance[:, 1, 1]
    symmetric = np.abs(b - seen.covariance[:, 1, 0]) <= 1e-9 * np.sqrt(np.abs(a * c))
    possible = np.isfinite(seen.covariance).all(axis=(1, 2)) & symmetric & (a > 0) & (a * c > b * b)
    wrong = _first(~possible)
    if wrong is not None:
        raise GeometryError(
            f"{of_row(wrong)}: covariance {_in_text(seen.covariance[wrong])} px^2, expected a symmetric "
            "positive definite matrix"
        )
    control, bars = network.control, network.scale_bars
    if len(control):
        wrong = _first(~np.isfinite(control.xyz).all(axis=1) | ~possible_covariances(control.covariance))
        if wrong is not None:
            raise GeometryError(
                f"control point {network.points[control.point[wrong]]}: expected finite coordinates and a "
                "symmetric positive definite covariance, of which variances may be 0 (fixed) or infinite "
                "(not known)"
            )
        twice = np.flatnonzero(np.bincount(control.point, minlength=len(network.points)) > 1)
        if len(twice):
            raise GeometryError(
                f"control point {network.points[twice[0]]}: duplicate, expected each point once"
            )
    good = np.isfinite(bars.length) & (bars.length > 0) & np.isfinite(bars.sigma) & (bars.sigma > 0)
    wrong = _first(~good | (bars.start == bars.end))
    if wrong is not None:
        raise GeometryError(
            f"scale bar {network.points[bars.start[wrong]]} - {network.points[bars.end[wrong]]}: length "
            f"{bars.length[wrong]:g}, sigma {bars.sigma[wrong]:g}, expected two points and positive numbers"
        )


def check_number(what: str, value: float, low: float, high: float = np.inf) -> None:
    """Refuse a number that does not lie strictly between two bounds.

    Args:
        what: name of the number, for the message.
        value: the number.
        low: lower bound.
        high: upper bound.

    Raises:
        GeometryError: the number lies outside; the message states what was found and expected.
    """
    if not isinstance(value, int | float | np.number) or not low < value < high:
        expected = f"more than {low:g}" if np.isinf(high) else f"between {low:g} and {high:g}"
        raise GeometryError(f"{what} = {value}, expected a number {expected}")


def _first(wrong: BoolArray) -> int | None:
    rows: IntArray = np.flatnonzero(wrong)
    return int(rows[0]) if len(rows) else None


def _in_text(values: FloatArray) -> str:
    return " ".join(f"{value:g}" for value in np.ravel(values))


def possible_covariances(covariance: FloatArray) -> BoolArray:
    """Return which matrices (c, n, n) are valid covariances of control coordinates, (c,).

    The coordinates that are neither fixed nor unknown must have a positive definite covariance.

    Args:
        covariance: variance 0 = fixed, infinite = unknown; such coordinates may not be correlated.
    """
    n = covariance.shape[1]
    unknown = np.eye(n, dtype=bool) & np.isposinf(covariance)  # a variance may be infinite
    finite = (np.isfinite(covariance) | unknown).all(axis=(1, 2))
    symmetric = np.isclose(covariance, np.swapaxes(covariance, 1, 2), rtol=1e-9, atol=0).all(axis=(1, 2))
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    usable: BoolArray = np.asarray(finite & symmetric & (variance >= 0).all(axis=1))
    free = np.isfinite(variance) & (variance > 0)
    scale = np.where(free, 1 / np.sqrt(np.where(free, variance, 1.0)), 1.0)
    unit = np.eye(n, dtype=bool)
    mixed = np.where(unit | ~usable[:, None, None], 0.0, covariance)
    correlation = np.where(unit, 1.0, mixed * scale[:, :, None] * scale[:, None, :])
    pairs = free[:, :, None] & free[:, None, :]
    bearable = unit | (correlation == 0) | (pairs & (np.abs(correlation) <= CORRELATION_LIMIT))
    regular = np.linalg.eigvalsh(correlation).min(axis=1) > n * np.finfo(float).eps
    return np.asarray(usable & bearable.all(axis=(1, 2)) & regular)
