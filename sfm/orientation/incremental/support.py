"""Which photographs of a network are held up by the others, and which only happen to fit a few points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from sfm.camera import project
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.network import Estimate, Network, rows_of

RELATIVE_UNKNOWNS = 5  # of a relative orientation


@dataclass(frozen=True)
class Support:
    """Evidence for and against the orientation of every photograph."""

    fitting: IntArray  # image points within the tolerance, (m,)
    known: IntArray  # image points of determined points, (m,)
    confirmed: IntArray  # conditions beyond those that the orientation and its points take up, (m,)
    against: (
        IntArray  # image points that lie elsewhere, or in the midst of points that should know them, (m,)
    )

    @property
    def doubtful(self) -> BoolArray:
        """Photographs of whose image points fewer than half are where the network predicts, (m,).

        Source: Rousseeuw (1984), J. Am. Stat. Assoc. 79: no estimate can be distinguished from its contrary
        if more than half of what it rests on contradicts it.
        """
        return np.asarray(self.confirmed < self.against)


def photograph_support(
    network: Network, estimate: Estimate, residuals_px: FloatArray, limit_px: FloatArray, fixed: BoolArray
) -> Support:
    """Count the image points of each photograph that speak for its orientation, and those against it.

    A point of three rays does not rest on this photograph and confirms it. Points that this photograph and
    one other see were intersected from the two: each leaves one condition, that its rays meet, and five of
    these the relative orientation takes up (Luhmann et al. 2020, sec. 4.3.3); the surplus confirms. An image
    point in the midst of the network that has no place in it contradicts: a
    mirrored photograph fits, seen from behind, the few coplanar codes that a mirror leaves as they are, and
    no other photograph shows the rest of its codes. Outside the network nothing is expected of the others.

    Args:
        network: k image points of m photographs and n points.
        estimate: the orientation that is judged.
        residuals_px: lengths, inf where undetermined, px, (k,).
        limit_px: largest residual of a fitting image point, px, (k,).
        fixed: points known from elsewhere than the photographs, (n,).
    """
    seen, m = network.image_points, len(network.images)
    fits = residuals_px <= limit_px
    rays = np.bincount(seen.point[fits], minlength=len(network.points))
    known = estimate.determined[seen.point] & estimate.oriented[seen.image]
    alone = fits & ((rays[seen.point] >= 3) | fixed[seen.point])
    confirmed = _count(alone, seen.image, m) + _surplus_of_pairs(network, fits & ~alone)
    against = ~fits & (known | _amidst(network, estimate))
    fitting, known_count, against_count = (_count(rows, seen.image, m) for rows in (fits, known, against))
    return Support(fitting, known_count, confirmed, against_count)


def _surplus_of_pairs(network: Network, two_rays: BoolArray) -> IntArray:
    """Return the conditions that the pairs of each photograph have beyond a relative orientation, (m,)."""
    m = len(network.images)
    both = np.zeros(m)
    for first, second, count in network.common_points(two_rays):
        surplus = np.maximum(count - RELATIVE_UNKNOWNS, 0)
        both += np.bincount(first, surplus, minlength=m) + np.bincount(second, surplus, minlength=m)
    return both.astype(np.int64)


def _amidst(network: Network, estimate: Estimate) -> BoolArray:
    """Return which image points lie in the convex hull of the network as their photograph shows it, (k,)."""
    seen = network.image_points
    out = np.zeros(len(seen), dtype=bool)
    points = estimate.points[estimate.determined]
    of_image = rows_of(seen.image, len(network.images))
    for i in np.flatnonzero(estimate.oriented):
        camera = estimate.cameras[network.camera[i]]
        xy = project(camera, estimate.position[i], estimate.rotation[i], points)
        xy = xy[((xy >= 0) & (xy < camera.size_px)).all(axis=1)]
        rows = of_image[i]
        if len(xy) < 3 or not len(rows):
            continue
        try:
            lines = ConvexHull(xy).equations
        except QhullError:  # all on one line
            continue
        out[rows] = (seen.xy[rows] @ lines[:, :2].T + lines[:, 2] <= 0).all(axis=1)
    return out


def _count(rows: BoolArray, image: IntArray, m: int) -> IntArray:
    return np.bincount(image[rows], minlength=m)
