"""Entries of a bundle protocol that users know from other programs.

The entries are: residuals by photograph and by point, control before and after, distortion and field of view
of the cameras, cumulative tests of radial distortion.

Source: the protocols of DBAT (Boerlin and Grussenmeyer 2013, Photogramm. Record 28(144)) and of AICON 3D
Studio.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm.adjustment.quality.gross_errors.robust import HUBER, TUKEY
from sfm.adjustment.quality.statistics import tau_critical
from sfm.adjustment.result import Adjustment
from sfm.judgement.bundle_statistics import Given
from sfm.judgement.checks import (
    ControlCoordinate,
    check_coordinates,
    compare_coordinate,
    standard_deviations,
)
from sfm.judgement.survey_result import ControlCheck, SurveyResult
from sfm.model.camera import (
    Camera,
    angle_between,
    border_pixels,
    outermost_reached,
    pixel_from_rays,
    rays_from_pixel,
    within_reach,
)
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.distortion.models import Role
from sfm.model.distributions import f_sf

EDGE_STEPS = 9  # positions along a side of the photograph at which distortion is evaluated


@dataclass(frozen=True)
class Lens:
    """Distortion and field of view of a camera."""

    camera: str
    largest_px: float  # largest displacement by distortion along the edge of the photograph
    field_of_view_deg: FloatArray  # horizontal, vertical, diagonal, (3,)


@dataclass(frozen=True)
class CumulativeTest:
    """F-test of a radial parameter together with all higher ones against 0."""

    camera: str
    parameters: str  # such as "K2, K3"
    probability: float  # of an F this large by chance


@dataclass(frozen=True)
class Protocol:
    """All entries of a bundle protocol."""

    residuals: tuple[tuple[Any, ...], ...]  # rows of residuals.csv
    limits: str  # limits of rejection, in words
    control: tuple[ControlCoordinate, ...]
    lenses: tuple[Lens, ...]
    cumulative: tuple[CumulativeTest, ...]


def protocol_of(result: SurveyResult, given: Given) -> Protocol:
    """Return the protocol entries of a result."""
    a = result.adjustment
    seen, source = a.network.image_points, a.network.source
    names = tuple(declared.name for declared in a.network.sources)
    residuals = list(_groups(a, "source", source, names, seen.point, a.network.points)) if names[1:] else []
    residuals += _groups(a, "photograph", seen.image, a.network.images, seen.point, a.network.points)
    residuals += _groups(a, "point", seen.point, a.network.points, seen.image, a.network.images)
    control = list[ControlCoordinate]()
    if given.control is not None:
        points = a.network.control.point
        xyz, posterior = a.estimate.points[points], standard_deviations(a.covariance.points[points])
        prior, names = given.control.sigma, given.control.names
        numbers = np.stack(
            [given.control.given, prior, xyz, posterior, given.control.difference, given.control.w], axis=-1
        )
        for k, c in np.argwhere(np.isfinite(prior)):
            control.append(ControlCoordinate("control", names[k], "XYZ"[c], *numbers[k, c].tolist()))
    return Protocol(
        residuals=tuple(residuals),
        limits=_limits(result),
        control=(
            *control,
            *_checked(a, result.control_check),
            *check_coordinates(result, placed=True),
        ),
        lenses=tuple(
            _lens(camera, seen.xy[a.network.camera[seen.image] == k])
            for k, camera in enumerate(a.estimate.cameras)
            if (a.network.camera == k).any()
        ),
        cumulative=_cumulative(a),
    )


def _groups(
    a: Adjustment,
    kind: str,
    index: IntArray,
    names: tuple[str, ...],
    other: IntArray,
    others: tuple[str, ...],
) -> list[tuple[Any, ...]]:
    """Return kind, name, accepted, rejected, RMS and largest |v| in x and y, px, and who sees the largest."""
    n, kept = len(names), np.flatnonzero(~a.rejected)
    every, accepted = (np.bincount(of, minlength=n) for of in (index, index[kept]))
    rms, largest = np.full((2, 2, n), np.nan)
    worst = np.full((2, n), "", dtype=object)
    seen = np.flatnonzero(accepted)
    for axis, v in enumerate(np.abs(a.residuals[kept]).T):
        rms[axis, seen] = np.sqrt(np.bincount(index[kept], v**2, minlength=n)[seen] / accepted[seen])
        order = np.lexsort((-v, index[kept]))
        first = kept[order[np.cumsum(accepted[seen]) - accepted[seen]]]  # the largest of each group
        largest[axis, seen] = np.abs(a.residuals[first, axis])
        worst[axis, seen] = [others[j] for j in other[first]]
    columns = (accepted, every - accepted, *rms, *largest)
    rows = zip(names, *(column.tolist() for column in columns), *worst.tolist(), strict=True)
    return [(kind, *row) for row in rows]


def _limits(result: SurveyResult) -> str:
    """Return the limit beyond which image points are rejected, and below which they are restored."""
    a = result.adjustment
    if result.reject == "tau":
        critical = tau_critical(a.test_alpha, a.redundancy)
        return (
            f"where |tau| exceeds {critical:.2f} (level {a.test_alpha:.2g}, all together {a.false_alarm:g}), "
            "restored where it no longer does"
        )
    if result.reject == "tukey":
        return f"weight 0 beyond {TUKEY:g} standard deviations, restored below"
    if result.reject == "huber":
        return f"none rejected; weight below 1 beyond {HUBER:g} standard deviations"
    return "none rejected"


def _checked(a: Adjustment, check: ControlCheck | None) -> list[ControlCoordinate]:
    """Return the control that took no part, compared with the points placed on it."""
    if check is None:
        return []
    control = a.network.control
    index_of = {a.network.points[j]: k for k, j in enumerate(control.point)}
    rows = [(n, index_of[name]) for n, name in enumerate(check.points) if name in index_of]
    prior, posterior = (
        standard_deviations(control.covariance),
        standard_deviations(a.covariance.points[control.point]),
    )
    placed = [(check.points[n], k, check.differences[n]) for n, k in rows]
    return [
        compare_coordinate(name, c, given, prior[k, c], given + d[c], posterior[k, c], d[c])
        for name, k, d in placed
        for c, given in enumerate(control.xyz[k])
    ]


def _lens(camera: Camera, seen: FloatArray) -> Lens:
    """Return distortion along the edge, relative to the same c and principal point, and the field of view.

    Args:
        camera: interior orientation.
        seen: its image points, px, (k, 2); see `within_reach`.
    """
    width, height = camera.size_px
    straight = camera.with_parameters(np.where(camera.parts[2], 0.0, camera.parameters))
    edge = border_pixels(camera, EDGE_STEPS)
    edge = edge[within_reach(camera, edge, seen)]
    moved = np.linalg.norm(pixel_from_rays(straight, rays_from_pixel(camera, edge)) - edge, axis=1)
    middle = np.array([[0.0, (height - 1) / 2], [width - 1.0, (height - 1) / 2]])
    upright = np.array([[(width - 1) / 2, 0.0], [(width - 1) / 2, height - 1.0]])
    corners = np.array([[0.0, 0.0], [width - 1.0, height - 1.0]])
    angles = []  # between the rays of opposite points, rad
    for pair in (middle, upright, corners):
        rays = rays_from_pixel(camera, outermost_reached(camera, pair, seen))
        angles.append(angle_between(rays[0], rays[1]))
    largest = float(moved[np.isfinite(moved)].max(initial=0.0)) if np.isfinite(moved).any() else np.nan
    return Lens(camera.name, largest, np.degrees(angles))


def _cumulative(a: Adjustment) -> tuple[CumulativeTest, ...]:
    tests: dict[tuple[str, str], CumulativeTest] = {}
    for camera, Q in zip(a.estimate.cameras, a.covariance.interior, strict=True):
        free = np.flatnonzero(camera.free)[: len(Q)]
        names = [camera.names[s] for s in free]
        radial = np.flatnonzero(camera.plays(Role.RADIAL)[free])
        for first in range(len(radial)):
            terms = radial[first:]
            value = camera.parameters[free[terms]]
            scale = np.sqrt(np.diagonal(Q)[terms])
            if not (scale > 0).all() or a.redundancy < 1:
                continue
            normed = Q[np.ix_(terms, terms)] / scale[:, None] / scale
            statistic = float((value / scale) @ np.linalg.solve(normed, value / scale)) / len(terms)
            p = float(f_sf(statistic, len(terms), a.redundancy))
            owner = camera.owner_of(int(free[terms[0]]))
            which = ", ".join(names[s] for s in terms)
            tests[owner, which] = CumulativeTest(owner, which, p)
    return tuple(tests.values())
