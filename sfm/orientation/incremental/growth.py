"""A growing network: resection, intersection, adjustment, and tests whether photographs are confirmed.

`Growth` replaces one estimate step by step. Photographs are resected on the points known so far, new points
are intersected, and the caller adjusts the network. `photograph_support` counts the image points for and
against each photograph; photographs without enough support are dropped.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from sfm.model.camera import Camera, project
from sfm.model.conventions import MAD_TO_SIGMA, BoolArray, FloatArray, IntArray
from sfm.model.distortion.models import Role
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, empty_estimate, rows_of
from sfm.model.reduced_network import reduce_network
from sfm.model.remarks.remark import Remark, remark
from sfm.orientation.image_rays import image_residuals, image_tangents
from sfm.orientation.incremental.starting_pair import Start, best_start
from sfm.orientation.intersection import RayLimits, intersect
from sfm.orientation.resection.ransac import RobustResection, fewest_fitting, resect_robust
from sfm.runtime.progress import report_step

RELATIVE_UNKNOWNS = 5  # unknowns of a relative orientation
FIRST_ADJUSTMENT = 4  # photographs
MIN_ANGLE_DEG = 2.0  # smallest ray angle of a point used to orient other photographs
MIN_SHARE = 0.5  # smallest share of the rays of a point that must meet in it
TOLERANCE_FACTOR = 6.0  # times the robust spread of the residuals
ALL_FREE_PHOTOGRAPHS = 6  # number of photographs from which all parameters are adjusted
WEAK_PER_ROUND = 20  # one in this number of unsupported photographs is removed before the next judgement
SURPLUS_PER_PARAMETER = 3  # observations, beyond those of exterior orientations, for each free parameter
Refine = Callable[[Network, Estimate], Estimate]


class Growth:
    """State of a growing network: one estimate that is replaced step by step."""

    def __init__(
        self, network: Network, estimate: Estimate, seed: int, tolerance_px: FloatArray, min_points: int
    ) -> None:
        self.network = network
        self.estimate = estimate
        self.seed = seed
        self.tolerance_px = tolerance_px
        self.start_tolerance_px = tolerance_px
        self.min_points = min_points
        self.reasons: dict[int, Remark] = {}  # reason why a photograph is not oriented
        self.dropped = np.zeros(len(network.images), dtype=bool)  # photographs that do not belong, (m,)
        area = [np.prod(camera.size_px) / camera.c_px**2 for camera in estimate.cameras]
        self.field = np.array(area)[network.camera]  # area of each photograph, squared tangents, (m,)
        control = network.control.complete
        # control with other coordinates in the estimate is intersected like any other point
        self.fixed = np.zeros(len(network.points), dtype=bool)
        self.fixed[control.point] = (estimate.points[control.point] == control.xyz).all(axis=1)
        self.adjusted = np.zeros(0, dtype=bool)  # image points of the last adjustment, (k,)

    def state(self) -> Growth:
        """Return a copy that later steps do not change."""
        kept = copy(self)
        kept.reasons, kept.dropped, kept.fixed = dict(self.reasons), self.dropped.copy(), self.fixed.copy()
        return kept

    def restore(self, state: Growth) -> None:
        """Return to an earlier state."""
        vars(self).update(vars(state))

    # --- views of the measured image points --------------------------------------------------------

    def tangents(self) -> FloatArray:
        """Return the tangents of all image points with the present interior orientations, (k, 2)."""
        return image_tangents(self.network.image_points, self.network.camera, self.estimate.cameras)

    def tolerance(self) -> FloatArray:
        """Return the tolerance of every photograph, tangents, (m,)."""
        c = np.array([camera.c_px for camera in self.estimate.cameras])
        return np.asarray((self.tolerance_px / c)[self.network.camera])

    def residuals_px(self) -> FloatArray:
        """Return the length of every reprojection residual, px, inf where undetermined, (k,)."""
        return residual_lengths(self.network, self.estimate)

    # --- steps -------------------------------------------------------------------------------------

    def begin(self, judge: Callable[[Estimate], float] | None = None) -> Start:
        """Find a start and adopt it.

        Args:
            judge: misfit of an estimate with other knowledge of the caller, see `best_start`.

        Raises:
            GeometryError: no two photographs can be oriented, or the given values do not suffice.
        """
        network, control = self.network, self.network.control.complete
        given = has_given_values(network, self.estimate)
        if given or len(control) >= 3:
            if not given:
                points = self.estimate.points.copy()
                points[control.point] = control.xyz
                self.fixed[control.point] = True
                self.estimate = replace(self.estimate, points=points)
            self.resect_all(only_new=True)
            self.intersect()
            oriented = int(self.estimate.oriented.sum())
            if oriented >= 2:
                now = self.estimate
                kind = "given" if given else "control"
                return Start(None, kind, now.position, now.rotation, now.points)
            if given:
                raise GeometryError(
                    f"orientation: the given approximate values orient {oriented} of {len(network.images)} "
                    "photographs, at least 2 are needed"
                )
        # too little control in any photograph: a free start, transformed to control later
        self.estimate = empty_estimate(network, self.estimate.cameras)
        self.fixed[:] = False

        def judged(start: Start) -> float:
            assert judge is not None
            return judge(Estimate(self.estimate.cameras, start.position, start.rotation, start.points))

        start = best_start(
            network,
            self.tangents(),
            self.tolerance(),
            seed=self.seed,
            judge=None if judge is None else judged,
        )
        self.estimate = replace(
            self.estimate, position=start.position, rotation=start.rotation, points=start.points
        )
        return start

    def resect_next(self) -> int:
        """Orient the photographs that see enough determined points; return the number added.

        Photographs with most points come first. A photograph with less than half as many points as the best
        one waits for the points that the others add.
        """
        waiting = np.flatnonzero(~self.estimate.oriented)
        seen = self.network.image_points
        known = self.estimate.determined[seen.point]
        count = np.bincount(seen.image[known], minlength=len(self.network.images))
        if not len(waiting) or count[waiting].max() < self.min_points:
            for i in waiting.tolist():
                self.reasons[i] = remark(
                    "photograph_with_few_points", seen=int(count[i]), needed=self.min_points
                )
            return 0
        best = count[waiting].max()
        order = waiting[np.argsort(-count[waiting], kind="stable")].tolist()
        added = self.resect([i for i in order if count[i] >= max(self.min_points, best / 2)])
        if not added:
            added = self.resect([i for i in order if count[i] < best / 2])
        return added

    def resect_all(self, *, only_new: bool = False) -> None:
        """Resect the photographs again on the present points; oriented ones keep the better orientation.

        Args:
            only_new: whether to resect only photographs that are not oriented.
        """
        left_out = self.dropped | (self.estimate.oriented if only_new else False)
        self.resect(np.flatnonzero(~left_out).tolist())

    def share_fitting(self) -> FloatArray:
        """Return the share of fitting image points of determined points in each photograph, (m,)."""
        seen, m = self.network.image_points, len(self.network.images)
        known = self.estimate.determined[seen.point] & self.estimate.oriented[seen.image]
        fits = self.residuals_px() <= self.tolerance_px[self.network.camera[seen.image]]
        count = np.bincount(seen.image[known], minlength=m)
        return np.asarray(np.bincount(seen.image[known & fits], minlength=m) / np.maximum(count, 1))

    def resect(self, images: list[int]) -> int:
        """Resect photographs; oriented ones keep the better orientation. Return the number of new ones.

        Args:
            images: indices of the photographs.
        """
        uv = self.tangents()
        position, rotation = self.estimate.position.copy(), self.estimate.rotation.copy()
        seen = self.network.image_points
        known = self.estimate.determined[seen.point] & np.isfinite(uv).all(axis=1)
        residuals = self.residuals_px()
        of_image, added = rows_of(seen.image, len(position)), 0
        for i in images:
            rows = of_image[i][known[of_image[i]]]
            result = self.resection(i, rows, uv[rows])
            camera = self.estimate.cameras[self.network.camera[i]]
            if not result.found:
                if not np.isfinite(position[i]).all():
                    fitting = int(result.inliers.sum())
                    self.reasons[i] = _too_few(fitting, len(rows), result.needed)
                continue
            if np.isfinite(position[i]).all():
                limit = self.tolerance_px[self.network.camera[i]] ** 2
                old = np.minimum(residuals[rows] ** 2, limit).sum()
                new = np.minimum(np.sum((result.residuals * camera.c_px) ** 2, axis=1), limit)
                if not np.nansum(np.where(np.isnan(new), limit, new)) < old:
                    continue
            else:
                added += 1
            position[i], rotation[i] = result.position, result.rotation
            self.reasons.pop(i, None)
        self.estimate = replace(self.estimate, position=position, rotation=rotation)
        report_step("photographs oriented", int(self.estimate.oriented.sum()), len(position))
        return added

    def resection(self, i: int, rows: IntArray, uv: FloatArray) -> RobustResection:
        """Return the resection of a photograph on the present points.

        Args:
            i: index of the photograph.
            rows: some of its image points, all of determined points, (k,).
            uv: tangents of these image points, (k, 2).
        """
        camera = self.network.camera[i]
        return resect_robust(
            uv,
            self.estimate.points[self.network.image_points.point[rows]],
            tolerance=float(self.tolerance_px[camera] / self.estimate.cameras[camera].c_px),
            seed=self.seed + i,
            min_inliers=self.min_points,
            field=self.field[i],
        )

    def release(self, images: IntArray) -> None:
        """Remove the orientation of photographs, and intersect the points again from the others.

        Args:
            images: indices of the photographs.
        """
        position, rotation = self.estimate.position.copy(), self.estimate.rotation.copy()
        position[images], rotation[images] = np.nan, np.nan
        self.estimate = replace(self.estimate, position=position, rotation=rotation)
        self.intersect()

    def intersect(self, *, only_missing: bool = False) -> None:
        """Intersect the points from the oriented photographs, except fixed control.

        Args:
            only_missing: whether to intersect only points without coordinates.
        """
        seen = self.network.image_points
        result = intersect(
            self.tangents(),
            seen.image,
            seen.point,
            self.estimate.position,
            self.estimate.rotation,
            n_points=len(self.network.points),
            limits=RayLimits(tolerance=float(self.tolerance().max()), min_angle_deg=MIN_ANGLE_DEG),
        )
        # if a point is elsewhere in every photograph, pairs of its rays still meet by chance
        rays = np.bincount(seen.point[self.estimate.oriented[seen.image]], minlength=len(self.network.points))
        points = np.where((result.rays >= MIN_SHARE * rays)[:, None], result.points, np.nan)
        stay = self.fixed | self.estimate.determined if only_missing else self.fixed
        points = np.where(stay[:, None], self.estimate.points, points)
        self.estimate = replace(self.estimate, points=points)

    def adjust(self, refine: Refine | None, *, everything: bool = False) -> bool:
        """Let the caller adjust everything determined; keep the result if the image points fit better.

        Args:
            refine: the caller's adjustment.
            everything: whether image points beyond the tolerance take part, for rough start values.

        Returns:
            Whether there was anything new to adjust.
        """
        if refine is None:
            return False
        seen = self.network.image_points
        residuals = self.residuals_px()
        limit = self.tolerance_px[self.network.camera[seen.image]]
        fits = np.isfinite(residuals) if everything else residuals <= limit
        limit = np.full(len(limit), np.inf) if everything else limit
        rays = np.bincount(seen.point[fits], minlength=len(self.network.points))
        points = self.estimate.determined & ((rays >= 2) | self.fixed)
        count = np.bincount(seen.image[fits & points[seen.point]], minlength=len(self.network.images))
        images = self.estimate.oriented & (count >= 3)
        used = fits & images[seen.image] & points[seen.point]
        if images.sum() < 2 or np.array_equal(used, self.adjusted):
            return False
        self.adjusted = used
        part, start = reduce_network(self.network, self.estimate, images, points, fits)
        staged = tuple(_free_by_stages(camera, part, index) for index, camera in enumerate(start.cameras))
        try:
            result = refine(part, replace(start, cameras=staged))
        except (GeometryError, np.linalg.LinAlgError):
            return True
        if not (result.oriented.all() and result.determined.all()):
            return True
        cameras = tuple(
            replace(new, free=old.free)
            for new, old in zip(result.cameras, self.estimate.cameras, strict=True)
        )
        position, rotation, xyz = (
            self.estimate.position.copy(),
            self.estimate.rotation.copy(),
            self.estimate.points.copy(),
        )
        position[images], rotation[images], xyz[points] = result.position, result.rotation, result.points
        candidate = Estimate(cameras, position, rotation, xyz)
        capped = np.minimum(residuals, limit)[fits]
        new = np.minimum(residual_lengths(self.network, candidate), limit)[fits]
        if np.sum(new**2) < np.sum(capped**2):
            self.estimate = candidate
        return True

    def drop_unsupported(self) -> int:
        """Drop the photographs that the others do not support, worst first; return the number dropped so far.

        Points that depended on them are intersected again from the others, or lost.
        """
        seen = self.network.image_points
        limit = self.tolerance_px[self.network.camera[seen.image]]
        tolerance = self.tolerance()
        while self.estimate.oriented.any():
            support = photograph_support(self.network, self.estimate, self.residuals_px(), limit, self.fixed)
            needed = np.array(
                [
                    fewest_fitting(int(n), tolerance[i], self.field[i], minimum=self.min_points)
                    for i, n in enumerate(support.known)
                ]
            )
            few = support.fitting < needed
            weak = np.flatnonzero(self.estimate.oriented & (few | support.doubtful))
            if not len(weak):
                break
            share = support.fitting / np.maximum(support.fitting + support.against, 1)
            worst = weak[np.argsort(share[weak], kind="stable")][: max(1, len(weak) // WEAK_PER_ROUND)]
            for i in worst.tolist():
                if few[i]:
                    fitting = int(support.fitting[i])
                    self.reasons[i] = _too_few(fitting, int(support.known[i]), int(needed[i]))
                else:
                    self.reasons[i] = remark(
                        "photograph_contradicting",
                        confirmed=int(support.confirmed[i]),
                        against=int(support.against[i]),
                        points=int(support.fitting[i] + support.against[i]),
                    )
            self.dropped[worst] = True
            self.release(worst)
        return int(self.dropped.sum())

    def adapt_tolerance(self, final_px: float) -> None:
        """Adapt the tolerance of each camera to the spread of its residuals.

        Args:
            final_px: smallest tolerance, px.
        """
        camera = self.network.camera[self.network.image_points.image]
        residuals = self.residuals_px()
        tolerance = self.tolerance_px.copy()
        for index, rows in enumerate(rows_of(camera, len(tolerance))):
            finite = residuals[rows][np.isfinite(residuals[rows])]
            if len(finite):
                spread = MAD_TO_SIGMA * float(np.median(finite))
                tolerance[index] = np.clip(
                    TOLERANCE_FACTOR * spread, final_px, self.start_tolerance_px[index]
                )
        self.tolerance_px = tolerance


def has_given_values(network: Network, estimate: Estimate) -> bool:
    """Return whether an estimate has more than cameras and the coordinates of control.

    Args:
        network: network with the control.
        estimate: start values.
    """
    control = network.control.complete
    other = estimate.determined
    other[control.point] &= (estimate.points[control.point] != control.xyz).any(axis=1)
    return bool(estimate.oriented.any() or other.any())


def residual_lengths(network: Network, estimate: Estimate) -> FloatArray:
    """Return the length of every image residual, px, inf where undetermined, shape (k,).

    Args:
        network: network of k image points.
        estimate: estimate of this network.
    """
    length = np.linalg.norm(image_residuals(network, estimate), axis=1)
    return np.where(np.isfinite(length), length, np.inf)


def _free_by_stages(camera: Camera, network: Network, index: int) -> Camera:
    """Free as many interior parameters as the photographs can determine: none, the first few, or all.

    The redundancy of the camera's image points after the exterior orientations must exceed its free
    parameters several times, and so must the redundancy of the network.
    """
    of_camera = network.camera == index
    n, m = len(network.points), len(network.images)
    redundancy = 2 * len(network.image_points) - 6 * m - 3 * n + 7
    surplus = min(2 * int(of_camera[network.image_points.image].sum()) - 6 * int(of_camera.sum()), redundancy)
    # few photographs determine focal lengths and the first radial parameter
    early = camera.plays(Role.FOCAL)
    early[np.flatnonzero(camera.plays(Role.RADIAL))[:1]] = True
    early &= camera.free
    if m >= ALL_FREE_PHOTOGRAPHS and surplus >= SURPLUS_PER_PARAMETER * camera.free.sum():
        return camera
    if m >= FIRST_ADJUSTMENT and surplus >= SURPLUS_PER_PARAMETER * early.sum():
        return replace(camera, free=early)
    return replace(camera, free=np.zeros_like(camera.free))


def _too_few(fitting: int, points: int, needed: int) -> Remark:
    """Return why a photograph is not oriented: it shows too few points, or too few of its points fit."""
    if points < needed:
        return remark("photograph_with_few_points", seen=points, needed=needed)
    return remark("photograph_with_few_fitting", fitting=fitting, points=points, needed=needed)


@dataclass(frozen=True)
class Support:
    """Evidence for and against the orientation of every photograph."""

    fitting: IntArray  # image points within the tolerance, (m,)
    known: IntArray  # image points of determined points, (m,)
    confirmed: IntArray  # conditions beyond those that the orientation and its points use up, (m,)
    against: IntArray  # image points that lie elsewhere, or inside the network without belonging to it, (m,)

    @property
    def doubtful(self) -> BoolArray:
        """Photographs with fewer than half of their image points where the network predicts them, (m,).

        Source: Rousseeuw (1984), J. Am. Stat. Assoc. 79: if more than half of the data contradict an
        estimate, nothing distinguishes it from its opposite.
        """
        return np.asarray(self.confirmed < self.against)


def photograph_support(
    network: Network, estimate: Estimate, residuals_px: FloatArray, limit_px: FloatArray, fixed: BoolArray
) -> Support:
    """Count the image points of each photograph for and against its orientation.

    A point with three rays does not depend on this photograph, and confirms it. A point seen by this
    photograph and one other was intersected from the two. It leaves one condition, that its rays meet.
    Relative orientation uses up five of these conditions (Luhmann et al. 2020, sec. 4.3.3); the surplus
    confirms the photograph.

    An image point inside the network that does not belong to it is evidence against the photograph. A
    mirrored photograph, for example, fits the few coplanar codes that are unchanged by mirroring, as if seen
    from behind. No other photograph shows the rest of its codes. Outside the network, other photographs need
    not confirm anything.

    Args:
        network: network of k image points, m photographs and n points.
        estimate: orientation that is judged.
        residuals_px: lengths of the residuals, inf where undetermined, px, (k,).
        limit_px: largest residual of a fitting image point, px, (k,).
        fixed: points known independently of the photographs, (n,).
    """
    seen, m = network.image_points, len(network.images)
    fits = residuals_px <= limit_px
    rays = np.bincount(seen.point[fits], minlength=len(network.points))
    known = estimate.determined[seen.point] & estimate.oriented[seen.image]
    alone = fits & ((rays[seen.point] >= 3) | fixed[seen.point])
    surplus = np.zeros(m)  # conditions in pairs of photographs beyond a relative orientation
    for first, second, count in network.common_points(fits & ~alone):
        beyond = np.maximum(count - RELATIVE_UNKNOWNS, 0)
        surplus += np.bincount(first, beyond, minlength=m) + np.bincount(second, beyond, minlength=m)
    confirmed = _count(alone, seen.image, m) + surplus.astype(np.int64)
    against = ~fits & (known | _inside_network(network, estimate, ~fits & ~known))
    fitting, known_count, against_count = (_count(rows, seen.image, m) for rows in (fits, known, against))
    return Support(fitting, known_count, confirmed, against_count)


def _inside_network(network: Network, estimate: Estimate, asked: BoolArray) -> BoolArray:
    """Return which of some image points lie inside the convex hull of the projected network, (k,)."""
    seen = network.image_points
    out = np.zeros(len(seen), dtype=bool)
    points = estimate.points[estimate.determined]
    chosen = np.flatnonzero(asked & estimate.oriented[seen.image])
    for i, of_image in enumerate(rows_of(seen.image[chosen], len(network.images))):
        if not len(of_image):
            continue
        rows, camera = chosen[of_image], estimate.cameras[network.camera[i]]
        xy = project(camera, estimate.position[i], estimate.rotation[i], points)
        xy = xy[((xy >= 0) & (xy < camera.size_px)).all(axis=1)]
        if len(xy) < 3:
            continue
        try:
            lines = ConvexHull(xy).equations
        except QhullError:  # all on a line
            continue
        out[rows] = (seen.xy[rows] @ lines[:, :2].T + lines[:, 2] <= 0).all(axis=1)
    return out


def _count(rows: BoolArray, image: IntArray, m: int) -> IntArray:
    return np.bincount(image[rows], minlength=m)
