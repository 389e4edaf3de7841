"""Geometry of an adjusted network: rays and angles of points, coverage of photographs, their residuals.

Only image points that were accepted count.

Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 7.1 (network design: rays, intersection
angles, full format); the figures are those that the report of DBAT gives (Boerlin and Grussenmeyer 2013,
Photogramm. Record 28(144)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from sfm.adjustment.result import Adjustment
from sfm.conventions import FloatArray, IntArray
from sfm.orientation.ray_angles import ray_angles
from sfm.report.findings.interior_parameters import families, family_of_photographs
from sfm.report.findings.precision import rms_of_groups

WEAK_DEG = 10.0  # below it a point is eleven times less precise along its rays than across


@dataclass(frozen=True)
class Coverage:
    """How much of its photographs a camera's image points cover."""

    camera: str
    hull: FloatArray  # area of their convex hull in each photograph over that of the photograph, (p,)
    hull_of_all: float  # the same of the image points of all photographs together
    radius: FloatArray  # largest distance from the centre over half the diagonal, of each photograph, (p,)


@dataclass(frozen=True)
class Geometry:
    """Rays, angles, coverage and residuals; NaN where nothing is known."""

    rays: IntArray  # of each point, (n,)
    angle_deg: FloatArray  # largest angle between two rays of each point, 0 parallel to 90, deg, (n,)
    point_rms_px: FloatArray  # root mean square residual per coordinate of each point, px, (n,)
    image_rms_px: FloatArray  # the same of each photograph, px, (m,)
    hull: FloatArray  # share of each photograph within the convex hull of its image points, (m,)
    coverage: tuple[Coverage, ...]  # of each camera that took photographs
    image_points: IntArray  # number of each photograph, (m,)

    @property
    def weak(self) -> IntArray:
        """Points whose rays meet at a small angle, smallest first."""
        order = np.argsort(self.angle_deg, kind="stable")
        return order[self.angle_deg[order] < WEAK_DEG]

    def histogram(self) -> tuple[tuple[int, int], ...]:
        """Return (rays, points with so many)."""
        values, counts = np.unique(self.rays, return_counts=True)
        return tuple(zip(values.tolist(), counts.tolist(), strict=True))


def geometry_of(adjustment: Adjustment) -> Geometry:
    """Return the geometry of an adjusted network."""
    network = adjustment.network
    m, n = len(network.images), len(network.points)
    used = network.image_points.select(~adjustment.rejected)
    size = np.array([adjustment.estimate.cameras[a].size_px for a in network.camera], dtype=float)[used.image]
    scaled = (used.xy - (size - 1) / 2) / size  # -1/2 to 1/2 in both axes
    radius = np.linalg.norm(scaled * size, axis=1) / (np.linalg.norm(size, axis=1) / 2)
    ends = np.cumsum(np.bincount(used.image, minlength=m))
    rows_of = np.split(np.argsort(used.image, kind="stable"), ends[:-1])
    hull = np.array([hull_area(scaled[rows]) for rows in rows_of])
    farthest = np.array([radius[rows].max(initial=0.0) for rows in rows_of])
    family = family_of_photographs(adjustment)
    coverage = tuple(
        Coverage(name, hull[family == f], hull_area(scaled[family[used.image] == f]), farthest[family == f])
        for f, (name, _) in enumerate(families(adjustment))
        if (family == f).any()
    )
    v = adjustment.residuals[~adjustment.rejected]
    image_rms, point_rms = rms_of_groups(used.image, v, m), rms_of_groups(used.point, v, n)
    rays, image_points = np.bincount(used.point, minlength=n), np.bincount(used.image, minlength=m)
    angle = ray_angles(adjustment.network, adjustment.estimate, ~adjustment.rejected)
    return Geometry(rays, angle, point_rms, image_rms, hull, coverage, image_points)


def hull_area(xy: FloatArray) -> float:
    """Return the area of the convex hull of points (k, 2), 0 where they lie on a line."""
    if len(xy) < 3:
        return 0.0
    try:
        return float(ConvexHull(xy).volume)
    except QhullError:
        return 0.0
