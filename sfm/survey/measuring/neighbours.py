"""Photographs taken near each photograph, whatever they show: by position, by series, by orientation.

Pairs of neighbours are matched beside those that have most features in common.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import PurePosixPath

import numpy as np
from scipy.spatial import cKDTree

from sfm.model.camera import EDGE_PIXELS, Camera, border_pixels, in_field, tangents_from_pixel
from sfm.model.conventions import FloatArray, IntArray, rotation_from_angles
from sfm.model.estimate import Estimate
from sfm.photographs.exif import USUAL_SIGMAS_M, Metadata, local_coordinates
from sfm.survey.inputs.survey import Survey

NONE = -1  # no photograph
# Median distance from the median position, in standard deviations, beyond which positions differ by more than
# their errors: errors alone give 1.5 (three axes).
MIN_SPREAD_SIGMAS = 2.0
STEP = 2.0  # between the distances at which fields of view are compared, where the object is not known
BEYOND = 16.0  # of these, over the extent of the projection centres: few stations before a far façade
DEPTHS = (0.1, 0.5, 0.9)  # of known points in view, quantiles
MOST_POINTS = 500  # known points, of which the depths are taken
RAYS = 3  # rows and columns of the rays of a photograph that are compared
CANDIDATES = 2  # footprints tested for each neighbour, the nearest ones at each distance
WIDEST = 10.0  # tangent at which the field of view of a fisheye ends here


def neighbours_by_position(metadata: Sequence[Metadata], count: int) -> IntArray:
    """Return the nearest photographs of each photograph, nearest first, padded with NONE, (m, k).

    EXIF positions are compared in units of their standard deviations. If they differ by no more than their
    errors, they say nothing, and no photograph has neighbours.

    Args:
        metadata: metadata of m photographs; some may have no position.
        count: number of neighbours, k.
    """
    neighbours = np.full((len(metadata), count), NONE)
    rows = np.array(
        [k for k, photograph in enumerate(metadata) if photograph.position is not None], dtype=np.int64
    )
    positions = [photograph.position for photograph in metadata if photograph.position is not None]
    if len(positions) < 2:
        return neighbours
    _, places = local_coordinates(positions)
    sigma = np.array([position.sigma_m for position in positions])
    places /= np.median(np.where(np.isnan(sigma), USUAL_SIGMAS_M, sigma), axis=0)
    up = places[:, 2]
    up[np.isnan(up)] = np.median(up[~np.isnan(up)]) if not np.isnan(up).all() else 0.0
    if np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)) < MIN_SPREAD_SIGMAS:
        return neighbours
    neighbours[rows] = _nearest(places, rows, count)
    return neighbours


def _nearest(places: FloatArray, rows: IntArray, count: int) -> IntArray:
    """Return the photographs nearest to each, padded with NONE, (k, count).

    Args:
        places: positions of two photographs or more, (k, 3).
        rows: indices of these photographs, (k,).
        count: number of neighbours.
    """
    neighbours = np.full((len(rows), count), NONE)
    for k, others in enumerate(cKDTree(places).query(places, min(count + 1, len(rows)))[1]):
        closest = others[others != k][:count]
        neighbours[k, : len(closest)] = rows[closest]
    return neighbours


def given_exterior(survey: Survey, names: Sequence[str], cameras: tuple[Camera, ...]) -> Estimate:
    """Return the given exterior orientation of photographs, NaN where none is given, and the known points.

    An orientation in [exterior] comes before that in [approximate], and this before a position alone.

    Args:
        survey: gives both tables, control and approximate points.
        names: names of m photographs.
        cameras: cameras with their start values.
    """
    position, rotation = np.full((len(names), 3), np.nan), np.full((len(names), 3, 3), np.nan)
    index = {name: i for i, name in enumerate(names)}
    start, observed = survey.start_orientations, survey.exterior
    if start is not None:
        for name, X0, R in zip(start.names, start.position, start.rotation, strict=True):
            if name in index:
                position[index[name]], rotation[index[name]] = X0, R
    if observed is not None:
        for name, value in zip(observed.names, observed.value, strict=True):
            i = index.get(name)
            if i is None or not np.isfinite(value[:3]).all():
                continue
            if np.isfinite(value[3:]).all():
                position[i], rotation[i] = value[:3], rotation_from_angles(*value[3:])
            elif np.isnan(position[i]).any():
                position[i] = value[:3]
    known = [given.xyz for given in (survey.control, survey.start_points) if given is not None]
    points = np.concatenate([np.zeros((0, 3)), *known])
    return Estimate(cameras, position, rotation, points[np.isfinite(points).all(axis=1)])


def neighbours_in_view(exterior: Estimate, camera: IntArray, count: int) -> IntArray:
    """Return the photographs that show most of the field of view of each, most first, (m, k).

    Fields of view are compared at the depths of the known points; without any, at distances between half the
    usual one of nearest photographs and BEYOND times the extent of all. Of what a photograph from another
    direction shows, the cosine of the angle between the axes counts. Photographs of which the position alone
    is given have the nearest ones. NONE where there are no others.

    Args:
        exterior: cameras, given exterior orientation of m photographs, NaN where not given, and known points.
        camera: index of the camera of each photograph, (m,).
        count: number of neighbours, k.
    """
    neighbours = np.full((len(camera), count), NONE)
    X0, placed = exterior.position, np.flatnonzero(np.isfinite(exterior.position).all(axis=1))
    turned = placed[np.isfinite(exterior.rotation[placed]).all(axis=(1, 2))]
    alone = np.setdiff1d(placed, turned)
    if len(placed) > 1 and len(alone) and np.ptp(X0[placed], axis=0).any():
        neighbours[alone] = _nearest(X0[placed], placed, count)[np.searchsorted(placed, alone)]
    depths = _depths(exterior, camera, turned)
    if not len(depths):
        return neighbours
    axis, most = -exterior.rotation[:, :, 2], min(CANDIDATES * count + 1, len(turned))
    footprints = [X0[turned] + depth * axis[turned] for depth in depths.tolist()]
    near = [cKDTree(at).query(at, most)[1].reshape(len(turned), most) for at in footprints]
    windows = np.array([_window(lens) for lens in exterior.cameras])[camera]
    part = np.linspace(0.1, 0.9, RAYS)
    for k, i in enumerate(turned.tolist()):
        others = np.setdiff1d(turned[np.unique([of[k] for of in near])], [i])
        low, high = windows[i, :2], windows[i, 2:]
        uv = low + np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2) * (high - low)
        rays = np.column_stack([uv, -np.ones(len(uv))]) @ exterior.rotation[i].T
        points = X0[i] + (depths[:, None, None] * rays).reshape(-1, 3)
        U, V, W = np.moveaxis(
            np.einsum("onc,ocd->ond", points[None] - X0[others][:, None], exterior.rotation[others]), 2, 0
        )
        before = W < 0
        u, v = (-np.divide(of, W, out=np.full(W.shape, np.inf), where=before) for of in (U, V))
        left, bottom, right, top = windows[others].T[:, :, None]
        inside = before & (left <= u) & (u <= right) & (bottom <= v) & (v <= top)
        shown = inside.mean(axis=1) * np.maximum(axis[others] @ axis[i], 0.0)
        best = np.argsort(-shown, kind="stable")[:count]
        best = best[shown[best] > 0]
        neighbours[i, : len(best)] = others[best]
    return neighbours


def _depths(exterior: Estimate, camera: IntArray, turned: IntArray) -> FloatArray:
    """Return distances along the axes of photographs at which the object may be; none if nothing tells them.

    turned: photographs with position and rotation.
    """
    X0, points = exterior.position, exterior.points[:: len(exterior.points) // MOST_POINTS + 1]
    seen = [np.zeros(0)]
    for i in turned.tolist():
        lens, R = exterior.cameras[camera[i]], exterior.rotation[i]
        shown = points[in_field(lens, X0[i], R, points)]
        seen.append((X0[i] - shown) @ R[:, 2])
    depths = np.concatenate(seen)
    depths = depths[depths > 0]  # a fisheye shows points behind it
    if len(depths):
        return np.asarray(np.quantile(depths, DEPTHS), dtype=np.float64)
    if len(turned) < 2:
        return depths
    extent = float(np.linalg.norm(np.ptp(X0[turned], axis=0)))
    apart = cKDTree(X0[turned]).query(X0[turned], 2)[0][:, 1]
    if not extent or not (apart > 0).any():
        return depths
    nearest = float(np.median(apart[apart > 0])) / 2
    steps = int(np.ceil(np.log(BEYOND * extent / nearest) / np.log(STEP)))
    return np.asarray(nearest * STEP ** np.arange(steps + 1), dtype=np.float64)


def _window(camera: Camera) -> FloatArray:
    """Return the limits of the tangents of a photograph: u and v of the lower left, and the upper right."""
    tangents = tangents_from_pixel(camera, border_pixels(camera, EDGE_PIXELS))
    if not np.isfinite(tangents).all():
        return np.array([-WIDEST, -WIDEST, WIDEST, WIDEST])
    return np.asarray(np.clip(np.concatenate([tangents.min(axis=0), tangents.max(axis=0)]), -WIDEST, WIDEST))


def neighbours_in_sequence(names: Sequence[str], metadata: Sequence[Metadata], count: int) -> IntArray:
    """Return the photographs taken before and after each photograph, NONE at the ends of a series, (m, k).

    A series consists of photographs of one camera with an EXIF time. Without times it consists of photographs
    whose names differ only in numbers. Photographs of the same time are sorted by the numbers in their names.

    Args:
        names: unique names of m photographs.
        metadata: metadata of these photographs.
        count: number of neighbours, k, even: half of them before, half after; the nearest first.
    """
    series: dict[tuple[object, ...], list[int]] = {}
    for k, photograph in enumerate(metadata):
        camera = (photograph.make, photograph.model, photograph.serial, PurePosixPath(names[k]).parent)
        by_name = re.sub(r"\d+", "0", names[k]) if photograph.taken is None else ""
        series.setdefault((*camera, by_name), []).append(k)

    def moment(k: int) -> tuple[datetime, list[int], str]:
        numbers = [int(digits) for digits in re.findall(r"\d+", names[k])]
        return metadata[k].taken or datetime.min, numbers, names[k]

    neighbours = np.full((len(names), count), NONE)
    for members in series.values():
        ordered = np.array(sorted(members, key=moment))
        for column, offset in enumerate(step for k in range(1, count // 2 + 1) for step in (k, -k)):
            from_, to = (
                (ordered[:-offset], ordered[offset:]) if offset > 0 else (ordered[-offset:], ordered[:offset])
            )
            neighbours[from_, column] = to
    return neighbours
