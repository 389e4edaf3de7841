"""Geometry of an adjusted network: rays and intersection angles of points, coverage of photographs.

Only accepted image points count.

Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 7.1 (network design: rays, intersection
angles, full format).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.adjustment.quality.correlations import observed_part
from sfm.adjustment.result import Adjustment
from sfm.judgement.calibrated_cameras import families, family_of_photographs
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.network import rows_of
from sfm.orientation.image_rays import ray_angles

WEAK_DEG = 10.0  # below this angle a point is eleven times less precise along its rays than across


@dataclass(frozen=True)
class Coverage:
    """The part of its photographs that a camera's image points cover."""

    camera: str
    hull: FloatArray  # area of their convex hull over that of the photograph, for each photograph, (p,)
    hull_of_all: float  # the same for the image points of all photographs together
    radius: FloatArray  # largest distance from the centre over half the diagonal, for each photograph, (p,)


@dataclass(frozen=True)
class Geometry:
    """Rays, angles, coverage and residuals; NaN if not known."""

    rays: IntArray  # of each point, (n,)
    angle_deg: FloatArray  # largest angle between two rays of each point, 0 parallel to 90, deg, (n,)
    point_rms_px: FloatArray  # root mean square residual per coordinate of each point, px, (n,)
    image_rms_px: FloatArray  # root mean square residual per coordinate of each photograph, px, (m,)
    hull: FloatArray  # part of each photograph within the convex hull of its image points, (m,)
    coverage: tuple[Coverage, ...]  # of each camera that took photographs
    image_points: IntArray  # accepted image points of each photograph, (m,)

    @property
    def weak(self) -> IntArray:
        """Points whose rays meet at a small angle, smallest angle first."""
        order = np.argsort(self.angle_deg, kind="stable")
        return order[self.angle_deg[order] < WEAK_DEG]

    def histogram(self) -> tuple[tuple[int, int], ...]:
        """Return pairs of a number of rays and the number of points with that many rays."""
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
    of_images = rows_of(used.image, m)
    hull = np.array([hull_area(scaled[rows]) for rows in of_images])
    farthest = np.array([radius[rows].max(initial=0.0) for rows in of_images])
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


def rms_of_groups(index: IntArray, v: FloatArray, count: int) -> FloatArray:
    """Return the RMS residual per coordinate of each photograph or point, px, NaN if unknown, (n,).

    Args:
        index: photograph or point of each image point, (k,).
        v: residuals, NaN where not known, px, (k, 2).
        count: number of photographs or points, n.
    """
    known = np.isfinite(v).all(axis=1)
    number = np.bincount(index[known], minlength=count)
    total = np.bincount(index[known], weights=(v[known] ** 2).sum(axis=1), minlength=count)
    mean = np.divide(total, 2 * number, out=np.full(count, np.nan), where=number > 0)
    return np.asarray(np.sqrt(mean))


def hull_area(xy: FloatArray) -> float:
    """Return the area of the convex hull of points (k, 2), 0 if they lie on a line."""
    return observed_part(xy, np.zeros((0, 2)))[0]
