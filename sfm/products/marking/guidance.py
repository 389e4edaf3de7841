"""Guidance: where the points that are marked should be in the other photographs, and what is there.

A point with one ray lies on its epipolar lines. With two rays, or known coordinates, it has a predicted
place in every oriented photograph, with an error ellipse from the joint covariance of everything. What is
there is measured as it was at the marks: targets, corners and crosses by their fits, natural points by
matching their windows.

Source: Kraus (2007), sec. 4.3, for epipolar lines; Luhmann et al. (2020), sec. 6.7 (driveback).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sfm.matching.epipolar import epipolar_paths
from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.distributions import chi2_isf
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.orientation.image_rays import intersect_image_points
from sfm.products.marking.adjusting import CONTAINED, MarkAdjustment
from sfm.products.marking.clicks import Measured, Template, measure_click
from sfm.survey.inputs.marks_file import Kind
from sfm.targets.codes.plates import TargetFamily

GATE = 0.001  # probability that a place is outside where it is measured
LEAST_REACH_PX, MOST_REACH_PX = 3.0, 40.0  # around predicted places in which is measured
MOST_SIZES, MOST_RATIO = 3.0, 2.0  # reach in sizes of a target, and change of its size
BORDER_PX = 4.0
SAME_PX = 0.5  # movement of a predicted place after which nothing is measured again
NEAREST, FARTHEST = 0.3, 3.0  # of the depths of known points, within which a ray is shown
BEYOND = 0.1  # of its sides, by which a line may leave a photograph


@dataclass(frozen=True)
class Ellipse:
    """The 95 % error ellipse of a place."""

    a: float  # semi-axes, px
    b: float
    angle_deg: float  # of the major axis, from x towards y


@dataclass(frozen=True)
class Predicted:
    """Where a photograph should show a point."""

    image: int
    xy: FloatArray  # px, (2,)
    covariance: FloatArray  # px^2, (2, 2)

    @property
    def ellipse(self) -> Ellipse:
        """Its 95 % error ellipse."""
        values, vectors = np.linalg.eigh(self.covariance)
        b, a = np.sqrt(chi2_isf(CONTAINED, 2) * np.maximum(values, 0.0))
        return Ellipse(float(a), float(b), math.degrees(math.atan2(vectors[1, 1], vectors[0, 1])))


@dataclass(frozen=True)
class Look:
    """How a point looks at its marks."""

    kind: Kind
    code: int | None = None
    template: Template | None = None  # of a natural point
    size_px: float = 0.0  # half side of what was fitted, px


class Guide:
    """The oriented photographs, in which places are predicted."""

    def __init__(self, network: Network, estimate: Estimate, marks: MarkAdjustment | None) -> None:
        """Take the orientation so far.

        Args:
            network: marks of m photographs and n points.
            estimate: what is oriented and determined.
            marks: the adjustment, whose precision is used; None if there is none.
        """
        self.network, self.estimate, self.marks = network, estimate, marks
        self._sizes = np.array([estimate.cameras[k].size_px for k in network.camera], dtype=float)

    def predict(self, point: int) -> list[Predicted]:
        """Return the places of a point in the oriented photographs without its mark.

        Args:
            point: index of a point with coordinates.
        """
        X, joint = self.estimate.points[point], None if self.marks is None else self.marks.joint
        if joint is None or self.marks is None or not np.isfinite(X).all():
            return []
        seen = self.network.image_points
        of_point = np.flatnonzero(seen.point == point)
        marked = set(seen.image[of_point].tolist())
        adjusted = point < len(self.marks.points) and bool(self.marks.points[point])
        rays = [k for k in of_point.tolist() if self.marks.images[seen.image[k]]]
        through = self._through_rays(rays, X) if not adjusted else None
        predicted = []
        for i in np.flatnonzero(self.marks.images).tolist():
            terms = None if i in marked else joint.of_unknowns(i, int(self.network.camera[i]), X)
            if terms is None:
                continue
            xy, by, by_X = terms
            if not ((xy > BORDER_PX) & (xy < self._sizes[i] - 1 - BORDER_PX)).all():
                continue
            if adjusted:
                C = joint.of_adjusted(point, by, by_X)
            elif through is not None:
                G, N = through
                C = joint.of_new(by + by_X @ G) + by_X @ N @ by_X.T * self.marks.variance_factor
            else:
                control = self.network.control
                row = np.flatnonzero(control.point == point)
                given = control.covariance[row[0]] if len(row) else np.zeros((3, 3))
                C = joint.of_new(by) + by_X @ np.where(np.isfinite(given), given, 0.0) @ by_X.T
            predicted.append(Predicted(i, xy, C))
        return predicted

    def _through_rays(self, rays: Sequence[int], X: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return the derivatives of an intersection by the unknowns, (3, u), and its cofactors, (3, 3)."""
        joint = None if self.marks is None else self.marks.joint
        if joint is None or len(rays) < 2:
            return None
        seen, N, right = self.network.image_points, np.zeros((3, 3)), np.zeros((3, joint.size))
        for k in rays:
            i = int(seen.image[k])
            terms = joint.of_unknowns(i, int(self.network.camera[i]), X)
            if terms is None:
                continue
            _, by, by_X = terms
            P = np.linalg.inv(seen.covariance[k])
            N += by_X.T @ P @ by_X
            right += by_X.T @ P @ by
        try:
            Q = np.linalg.inv(N)
        except np.linalg.LinAlgError:
            return None
        return -Q @ right, np.asarray(Q, dtype=float)

    def with_rays(self, point: int) -> FloatArray:
        """Return the coordinates of a point from its present rays, NaN if they do not determine it, (3,)."""
        seen = self.network.image_points
        rows = seen.select(seen.point == point)
        if len(rows) < 2:
            return np.full(3, np.nan)
        tolerance = 0.03 * float(np.hypot(*self._sizes.max(axis=0)))
        met = intersect_image_points(
            rows,
            self.network.camera,
            self.estimate,
            n_points=len(self.network.points),
            tolerance_px=tolerance,
        )
        return np.asarray(met.points[point])

    def lines(self, image: int, xy: FloatArray) -> list[tuple[int, FloatArray]]:
        """Return the images of the ray of sight through a place, in all other oriented photographs.

        Args:
            image: the photograph of the place.
            xy: the place, px, (2,).

        Returns:
            Photographs, and lines in them, px, (n, 2).
        """
        oriented = self.estimate.oriented
        if not oriented[image]:
            return []
        # depths between which the object is, seen from the photograph
        away = (self.estimate.points - self.estimate.position[image]) @ self.estimate.rotation[image]
        depth = -away[:, 2]
        depth = depth[np.isfinite(depth) & (depth > 0)]
        if not len(depth):
            base = np.linalg.norm(self.estimate.position - self.estimate.position[image], axis=1)
            depth = base[np.isfinite(base) & (base > 0)]
        if not len(depth):
            depth = np.ones(1)
        nearest, farthest = NEAREST * float(depth.min()), FARTHEST * float(depth.max())
        lines = []
        for j in np.flatnonzero(oriented).tolist():
            if j == image:
                continue
            (path,) = epipolar_paths(
                self.estimate,
                self.network.camera,
                image,
                j,
                np.asarray(xy, dtype=float)[None],
                nearest=nearest,
                farthest=farthest,
            )
            margin = BEYOND * self._sizes[j]
            path = path[((path > -margin) & (path < self._sizes[j] + margin)).all(axis=1)]
            if len(path) > 1:
                lines.append((j, path))
        return lines


def is_same_place(before: Predicted, after: Predicted) -> bool:
    """Return whether what was measured at a place is also what would be measured at another."""
    moved = float(np.linalg.norm(after.xy - before.xy))
    wider = float(np.linalg.eigvalsh(after.covariance)[-1] / np.linalg.eigvalsh(before.covariance)[-1])
    return moved <= SAME_PX and 0.5 < wider <= 1.5


def measure_predicted(
    read: Callable[[int], AnyArray], predicted: Predicted, look: Look, family: TargetFamily | None
) -> Measured | None:
    """Return what is measured at a predicted place; None if nothing fits there.

    Args:
        read: returns the intensities of a photograph, (H, W).
        predicted: the place.
        look: how the point looks at its marks.
        family: codes of rings.
    """
    gate = float(np.sqrt(chi2_isf(GATE, 2) * np.linalg.eigvalsh(predicted.covariance)[-1]))
    if not np.isfinite(gate):  # marks that contradict one another predict nothing
        return None
    if look.size_px > 0 and gate > MOST_SIZES * look.size_px:  # a neighbour may be there
        return None
    reach = float(np.clip(gate, LEAST_REACH_PX, MOST_REACH_PX))
    try:
        measured = measure_click(
            read(predicted.image),
            float(predicted.xy[0]),
            float(predicted.xy[1]),
            look.kind,
            family=family if look.code is not None else None,
            template=look.template,
            reach_px=reach,
            size_px=look.size_px,
        )
    except GeometryError:
        return None
    if look.code is not None and measured.code != look.code:
        return None
    if look.size_px > 0 and not 1 / MOST_RATIO <= measured.size_px / look.size_px <= MOST_RATIO:
        return None
    off = np.array([measured.x, measured.y]) - predicted.xy
    # half a pixel for what is not adjusted yet
    C = predicted.covariance + measured.covariance + SAME_PX**2 * np.eye(2)
    return measured if off @ np.linalg.solve(C, off) <= chi2_isf(GATE, 2) else None
