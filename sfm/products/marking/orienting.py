"""Orientation by hand: from three marks of known points in a photograph, or five common points of two.

Marks are few and precise. Four or more known points orient a photograph by the robust resection of surveys;
three by the closed form, whose up to four solutions the photographs decide. Where nothing is known, five or
more points that two photographs share orient them relative to one another; again the photographs decide
between the solutions. What is oriented gives points, which orient further photographs. The result starts
the adjustment.

Source: Fischler and Bolles (1981), Comm. ACM 24(6); Nister (2004), IEEE PAMI 26(6).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, islice
from typing import Literal, Protocol

import numpy as np

from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distortion.models import Role
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.reduced_network import merge_estimate, reduce_network
from sfm.model.similarity import fit_similarity
from sfm.orientation.image_rays import image_tangents, intersect_image_points
from sfm.orientation.incremental.sequence import FINAL_TOLERANCE_PX, START_TOLERANCE
from sfm.orientation.relative import (
    RelativeOrientation,
    five_point_orientations,
    model_points,
    relative_orientations,
)
from sfm.orientation.resection.fischler_bolles import rays_from_tangents, resect_triples
from sfm.orientation.resection.ransac import resect_robust
from sfm.products.marking.evidence import Pose
from sfm.survey.free_parameters import C_SIGMA
from sfm.survey.placing import object_scale

MIN_KNOWN, MIN_COMMON = 3, 5  # marks of known points that orient a photograph, and common points of a pair
MANY_COMMON = 8  # common points that orient a pair without other features
MOST_PAIRS = 3  # that are tried as the first pair
MIN_SHARE = 0.6  # of the known points of a photograph that must fit; a few marks may be wrong
AGAIN = 1.3  # photographs over those of the last adjustment, from which all are adjusted again
# Part of its support, and features, by which the best orientation leads if it is clear.
CLEAR, LEAD = 0.25, 2.0
# Principal distances that are tried, in parts of the nominal one, which is the first: two standard deviations
# to each side. With steps of a quarter of one, features support the right orientation with one of them.
C_FACTORS = (1.0, *(1 + sign * C_SIGMA * k / 4 for k in range(1, 9) for sign in (-1, 1)))
MOST_TRIED = 2  # photographs that decide on the principal distance
ALIKE_DEG = 15.0  # between orientations that are no rivals, but one with and without further features


Frame = Literal["model", "scaled", "control"]
"""coordinates of an orientation: of its own, of its own in the object unit, or those of the control"""


class Evidence(Protocol):
    """What the photographs say of the orientations of two of them."""

    def support(self, i: int, j: int, first: Pose, second: Pose) -> float:
        """Return the number of features that support two orientations."""
        ...

    def matches(self, i: int, j: int) -> tuple[FloatArray, FloatArray]:
        """Return the tangents of features of two photographs that look alike, (k, 2) each."""
        ...

    def places(self, i: int, pose: Pose, points: FloatArray) -> float:
        """Return the number of points that are seen where an orientation predicts them."""
        ...

    def with_cameras(self, cameras: Sequence[Camera]) -> Evidence:
        """Return the evidence with another interior orientation of each photograph."""
        ...


@dataclass(frozen=True)
class HandOrientation:
    """Photographs and points that marks determine."""

    estimate: Estimate  # NaN where nothing is determined
    open: tuple[int, ...] = ()  # photographs with several orientations of which none is clearly better
    contradicting: tuple[int, ...] = ()  # photographs whose marks fit no orientation
    frame: Frame = "model"


def orient_by_hand(
    network: Network, start: Estimate, evidence: Evidence, *, frame: Frame = "model"
) -> HandOrientation:
    """Return the orientation of the photographs that have enough marks, and the points that follow.

    Args:
        network: marks of m photographs and n points, with control and scale bars.
        start: cameras, and what is oriented already; NaN elsewhere.
        evidence: decides between orientations that fit the marks.
        frame: frame of what is oriented already.
    """
    work = _Work(network, start, evidence, frame)
    if not work.estimate.oriented.any() and len(network.control.complete) < MIN_KNOWN:
        work.orient_pair()
    work.grow()
    if not work.estimate.oriented.any():
        work.orient_pair()
        work.grow()
    work.place()
    if work.frame == "control":
        work.grow()  # on the other known points
    undecided = {i for i in work.undecided if not work.estimate.oriented[i]}
    return HandOrientation(
        work.estimate, tuple(sorted(work.open | undecided)), tuple(sorted(work.contradicting)), work.frame
    )


@dataclass(frozen=True)
class _Threes:
    """Orientations of photographs from three known points each."""

    poses: dict[int, Pose]
    support: float  # of all of them
    open: set[int]  # of which none is clearly better


@dataclass(frozen=True)
class _Chosen:
    """The relative orientation of two photographs that their features support most."""

    support: float
    points: IntArray  # common points
    solution: RelativeOrientation
    clear: bool  # whether it leads over those that differ from it
    alone: bool  # whether there is no other


class _Work:
    """An orientation that grows."""

    def __init__(self, network: Network, start: Estimate, evidence: Evidence, frame: Frame) -> None:
        self.network, self.evidence, self.estimate = network, evidence, start
        self.known = np.zeros(len(network.points), dtype=bool)  # whose coordinates are given
        self.frame: Frame = frame if start.oriented.any() else "model"
        self.given, self.adjusted = start.oriented, 0
        begins = not start.oriented.any() and len(network.control.complete) >= MIN_KNOWN
        if self.frame == "control" or begins:
            self.use_control()
        self.use_cameras(start.cameras)
        self.open: set[int] = set()
        self.undecided: set[int] = set()  # on which nothing is built
        self.contradicting: set[int] = set()
        self.intersect()

    def use_control(self) -> None:
        """Give the points of the control their coordinates."""
        control, points = self.network.control.complete, self.estimate.points.copy()
        points[control.point] = control.xyz
        self.known[control.point] = True
        self.estimate, self.frame = replace(self.estimate, points=points), "control"

    def grow(self) -> None:
        """Orient all photographs that have enough points, and determine the points that follow."""
        while True:
            while self.resect_next():
                self.intersect()
                self.adjust()
            if not (self.estimate.oriented.any() and self.attach_pair()):
                break
            self.intersect()

    def tolerance(self, i: int) -> float:
        """Return the largest residual of a fitting mark, tangents: distortion is not known yet."""
        camera = self.estimate.cameras[self.network.camera[i]]
        return float(START_TOLERANCE * np.hypot(*camera.size_px) / camera.c_px)

    def rows(self, i: int) -> IntArray:
        """Return the marks of determined points in a photograph."""
        seen = self.network.image_points
        good = self.estimate.determined[seen.point] & np.isfinite(self.uv).all(axis=1)
        return np.flatnonzero((seen.image == i) & good)

    def resect_next(self) -> int:
        """Orient the photographs with the most marks of determined points; return their number."""
        seen = self.network.image_points
        waiting = [i for i in np.flatnonzero(~self.estimate.oriented).tolist() if i not in self.contradicting]
        rows = {i: self.rows(i) for i in waiting}
        most = max((len(k) for k in rows.values()), default=0)
        if most > MIN_KNOWN:
            for i in sorted(waiting, key=lambda i: -len(rows[i])):
                if len(rows[i]) <= MIN_KNOWN:
                    break
                k = rows[i]
                resection = resect_robust(
                    self.uv[k],
                    self.estimate.points[seen.point[k]],
                    tolerance=self.tolerance(i),
                    min_inliers=max(MIN_KNOWN + 1, int(np.ceil(MIN_SHARE * len(k)))),
                )
                if resection.found:
                    self.put(i, (resection.position, resection.rotation))
                    return 1
                self.contradicting.add(i)
            return self.resect_next()
        if most < MIN_KNOWN:
            return 0
        return self.resect_threes({i: k for i, k in rows.items() if len(k) == MIN_KNOWN})

    def resect_threes(self, rows: dict[int, IntArray]) -> int:
        """Orient the photographs with three known points, all at once: each supports the others.

        Three points fit with any principal distance. Where c is free, and no photograph determines it yet, it
        is the one with which the features support the orientations most clearly.
        """
        undecided = self.undecided_c(rows)
        if undecided:
            first = dict(islice(rows.items(), MOST_TRIED))
            trials = [self.scaled_cameras(undecided, factor) for factor in C_FACTORS]
            support = [self.of_threes(first, cameras).support for cameras in trials]
            best = int(np.argmax(support))
            if _is_clear(support[best] - support[0], support[best]):
                self.use_cameras(trials[best])
        threes = self.of_threes(rows, self.estimate.cameras)
        self.open |= threes.open
        self.contradicting |= rows.keys() - threes.poses.keys()
        for i, pose in threes.poses.items():
            self.put(i, pose)
        return len(threes.poses)

    def undecided_c(self, rows: dict[int, IntArray]) -> set[int]:
        """Return the cameras of photographs whose c is free, and is not determined by other photographs."""
        cameras, owner = self.estimate.cameras, self.network.camera
        known = set(owner[self.estimate.oriented].tolist())
        return {
            k
            for k in {int(owner[i]) for i in rows} - known
            if (cameras[k].free & cameras[k].plays(Role.FOCAL)).any()
        }

    def scaled_cameras(self, which: set[int], factor: float) -> tuple[Camera, ...]:
        """Return the cameras, of which some have another principal distance."""
        return tuple(
            replace(camera, parameters=np.where(camera.plays(Role.FOCAL), factor, 1.0) * camera.parameters)
            if k in which
            else camera
            for k, camera in enumerate(self.estimate.cameras)
        )

    def use_cameras(self, cameras: tuple[Camera, ...]) -> None:
        """Take the interior orientations from which everything follows."""
        owner = self.network.camera
        self.estimate = replace(self.estimate, cameras=cameras)
        self.evidence = self.evidence.with_cameras([cameras[k] for k in owner])
        self.uv = image_tangents(self.network.image_points, owner, cameras)

    def of_threes(self, rows: dict[int, IntArray], cameras: tuple[Camera, ...]) -> _Threes:
        """Return the orientations of photographs from three known points each."""
        seen, owner = self.network.image_points, self.network.camera
        evidence = self.evidence.with_cameras([cameras[k] for k in owner])
        uv = image_tangents(seen, owner, cameras)
        poses: dict[int, list[Pose]] = {
            i: [(self.estimate.position[i], self.estimate.rotation[i])]
            for i in np.flatnonzero(self.estimate.oriented).tolist()
        }
        for i, k in rows.items():
            found = resect_triples(rays_from_tangents(uv[k])[None], self.estimate.points[seen.point[k]][None])
            poses[i] = [(found.position[0, s], found.rotation[0, s]) for s in range(found.count[0])]
            if not poses[i]:
                del poses[i]
        new, not_clear = [i for i in rows if i in poses], set[int]()
        while any(len(poses[i]) > 1 for i in new):
            not_clear |= self.decide(poses, evidence)
        support = sum(evidence.places(i, poses[i][0], self.estimate.points) for i in new)
        support += sum(
            evidence.support(j, i, poses[j][0], poses[i][0])
            for i in new
            for j in poses
            if j < i or j not in new
        )
        return _Threes({i: poses[i][0] for i in new}, support, not_clear)

    def decide(self, poses: dict[int, list[Pose]], evidence: Evidence) -> set[int]:
        """Keep one pose of the photograph, or of the two, that the others support most clearly.

        Returns:
            Those of them whose poses are not clearly better than others.
        """
        best: tuple[float, float, dict[int, int]] | None = None
        for i in [i for i in poses if len(poses[i]) > 1]:
            own = np.array([evidence.places(i, p, self.estimate.points) for p in poses[i]])
            for j in [j for j in poses if j != i]:
                support = own[:, None] + [[evidence.support(j, i, q, p) for q in poses[j]] for p in poses[i]]
                k, q = divmod(int(np.argmax(support)), support.shape[1])
                rival = max((float(support[a].max()) for a in range(len(support)) if a != k), default=0.0)
                row = float(support[k, q]) - rival, float(support[k, q]), {i: k, j: q}
                best = row if best is None or row[0] > best[0] else best
            if len(poses) == 1:
                first = int(np.argmax(own))
                best = float(own[first] - np.sort(own)[-2]), float(own[first]), {i: first}
        assert best is not None
        lead, support_of_best, chosen = best
        open_ones = {i for i in chosen if len(poses[i]) > 1 and not _is_clear(lead, support_of_best)}
        for i, k in chosen.items():
            poses[i] = [poses[i][k]]
        return open_ones

    def orient_pair(self) -> None:
        """Orient the two photographs with the best common points, in the frame of the first."""
        best: tuple[int, int, _Chosen] | None = None
        for i, j in self.pairs()[:MOST_PAIRS]:
            chosen = self.choose(i, j)
            if chosen is not None and (best is None or chosen.support > best[2].support):
                best = i, j, chosen
            if chosen is not None and chosen.alone and len(chosen.points) >= MANY_COMMON:
                break  # its marks determine it
        if best is None:
            return
        i, j, chosen = best
        solution = chosen.solution
        if not chosen.clear:
            self.open |= {i, j}
        self.known[:], self.frame = False, "model"
        self.estimate = replace(self.estimate, points=np.full_like(self.estimate.points, np.nan))
        self.put(i, (np.zeros(3), np.eye(3)))
        self.put(j, (solution.base, solution.rotation))
        self.intersect()
        self.adjust()

    def attach_pair(self) -> bool:
        """Orient a photograph on one that is oriented, by common points some of which are known.

        One that several orientations fit stays open: others would follow from a wrong one.
        """
        for i, j in self.pairs():
            if self.estimate.oriented[i] == self.estimate.oriented[j]:
                continue
            i, j = (i, j) if self.estimate.oriented[i] else (j, i)
            chosen = self.choose(i, j)
            if chosen is None:
                continue
            solution, points = chosen.solution, chosen.points
            a, b = (self.tangents_of(k, points) for k in (i, j))
            model = model_points(a, b, solution)
            X0, R = self.estimate.position[i], self.estimate.rotation[i]
            ratio = np.linalg.norm(self.estimate.points[points] - X0, axis=1) / np.linalg.norm(model, axis=1)
            if not np.isfinite(ratio).any():
                continue
            if not chosen.clear:
                self.undecided.add(j)
                continue
            self.put(j, (X0 + np.nanmedian(ratio) * R @ solution.base, R @ solution.rotation))
            return True
        return False

    def choose(self, i: int, j: int) -> _Chosen | None:
        """Return the relative orientation of two photographs with the largest support; None without any."""
        candidates = list(self.solutions(i, j))
        if not candidates:
            return None
        support, points, solution = max(candidates, key=lambda row: row[0])
        rivals = [row[0] for row in candidates if _angle_deg(row[2].rotation, solution.rotation) > ALIKE_DEG]
        clear = not rivals or _is_clear(support - max(rivals), support)
        return _Chosen(support, points, solution, clear, alone=len(candidates) == 1)

    def pairs(self) -> list[tuple[int, int]]:
        """Return the pairs with enough common points, those with most of them first."""
        seen = self.network.image_points
        marked = np.zeros((len(self.network.images), len(self.network.points)), dtype=np.int64)
        marked[seen.image, seen.point] = 1
        common = marked @ marked.T
        pairs = [(i, j) for i, j in combinations(range(len(common)), 2) if common[i, j] >= MIN_COMMON]
        return sorted(pairs, key=lambda pair: -common[pair])

    def tangents_of(self, i: int, points: IntArray) -> FloatArray:
        """Return the tangents of marks of points in a photograph, (k, 2)."""
        seen = self.network.image_points
        row = {int(seen.point[k]): k for k in np.flatnonzero(seen.image == i)}
        return self.uv[[row[int(j)] for j in points]]

    def solutions(self, i: int, j: int) -> Iterator[tuple[float, IntArray, RelativeOrientation]]:
        """Yield the relative orientations of two photographs: their support, the common points, and each."""
        seen = self.network.image_points
        points = np.intersect1d(seen.point[seen.image == i], seen.point[seen.image == j])
        a, b = self.tangents_of(i, points), self.tangents_of(j, points)
        good = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
        points, a, b = points[good], a[good], b[good]
        if len(points) < MIN_COMMON:
            return
        tolerance = FINAL_TOLERANCE_PX / self.estimate.cameras[self.network.camera[i]].c_px
        solutions: list[RelativeOrientation] = []
        if len(points) == MIN_COMMON:
            solutions += five_point_orientations(a, b)
        with suppress(GeometryError):
            solutions += relative_orientations(a, b, tolerance=tolerance)
        few = len(points) < MANY_COMMON  # which may determine the orientation badly
        alike = self.evidence.matches(i, j) if few else (a[:0], b[:0])
        if len(alike[0]):
            with suppress(GeometryError):
                of_all = relative_orientations(
                    np.vstack([a, alike[0]]), np.vstack([b, alike[1]]), tolerance=tolerance
                )
                rows = slice(0, len(points))
                solutions += [
                    replace(s, inliers=s.inliers[rows], residuals=s.residuals[rows])
                    for s in of_all
                    if s.inliers[rows].sum() >= MIN_SHARE * len(points)
                ]
        solutions = [
            solution
            for solution in solutions
            if solution.kind != "infinite"
            and np.isfinite(model_points(a, b, solution)).all(axis=1).sum() >= MIN_KNOWN + 1
        ]
        for solution in solutions:
            support = float(len(points))
            if few or len(solutions) > 1:
                pose = solution.base, solution.rotation
                support = self.evidence.support(i, j, (np.zeros(3), np.eye(3)), pose)
            yield support, points, solution

    def put(self, i: int, pose: Pose) -> None:
        """Orient a photograph."""
        position, rotation = self.estimate.position.copy(), self.estimate.rotation.copy()
        position[i], rotation[i] = pose
        self.estimate = replace(self.estimate, position=position, rotation=rotation)

    def intersect(self) -> None:
        """Intersect the points that are not given."""
        seen = self.network.image_points
        met = intersect_image_points(
            seen,
            self.network.camera,
            self.estimate,
            n_points=len(self.network.points),
            tolerance_px=max(self.tolerance(i) for i in range(len(self.network.images)))
            * min(camera.c_px for camera in self.estimate.cameras),
        )
        points = np.where(self.known[:, None], self.estimate.points, met.points)
        kept = np.isnan(points).any(axis=1) & self.estimate.determined & self.given.any()
        points[kept] = self.estimate.points[kept]
        self.estimate = replace(self.estimate, points=points)

    def adjust(self) -> None:
        """Adjust what is determined, with held cameras; keep the result if it is one."""
        if self.estimate.oriented.sum() < AGAIN * self.adjusted:
            return
        images, points, used = determined_part(self.network, self.estimate)
        given = int(self.known[points].sum())
        control = self.frame == "control" and given >= MIN_KNOWN
        unknowns = 6 * images.sum() + 3 * (points.sum() - given) - (0 if control else 7)
        if images.sum() < 2 or 2 * used.sum() <= unknowns:
            return
        self.adjusted = int(images.sum())
        held = tuple(replace(camera, free=np.zeros_like(camera.free)) for camera in self.estimate.cameras)
        part, start = reduce_network(self.network, replace(self.estimate, cameras=held), images, points, used)
        if not control:
            part = part.with_given(type(part.scale_bars)())
        with suppress(GeometryError, np.linalg.LinAlgError):
            adjusted = adjust(
                part,
                start,
                datum="control" if control else "free",
                reject="huber",
                covariance=False,
                options=AdjustmentOptions(redundancy_numbers=False, max_iterations=30),
            ).estimate
            if adjusted.oriented.all():
                whole = merge_estimate(adjusted, images, points)
                self.estimate = Estimate(
                    self.estimate.cameras,
                    np.where(images[:, None], whole.position, self.estimate.position),
                    np.where(images[:, None, None], whole.rotation, self.estimate.rotation),
                    np.where(points[:, None], whole.points, self.estimate.points),
                )

    def place(self) -> None:
        """Bring a free orientation to its control, or to the scale of its bars."""
        if self.frame == "control" or not self.estimate.oriented.any():
            return
        control = self.network.control.complete
        determined = self.estimate.determined[control.point]
        if determined.sum() >= MIN_KNOWN:
            with suppress(GeometryError):
                points = self.estimate.points[control.point[determined]]
                self.estimate = fit_similarity(points, control.xyz[determined]).apply_estimate(self.estimate)
                self.use_control()
                return
        scale = object_scale(self.network, self.estimate) if self.frame == "model" else 0.0
        if scale > 0:
            self.frame = "scaled"
            self.estimate = replace(
                self.estimate, position=scale * self.estimate.position, points=scale * self.estimate.points
            )


def _is_clear(lead: float, support: float) -> bool:
    return lead >= max(LEAD, CLEAR * support)


def _angle_deg(a: FloatArray, b: FloatArray) -> float:
    """Return the angle of the rotation between two attitudes, degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1.0, 1.0))))


def determined_part(network: Network, estimate: Estimate) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return the photographs (m,), points (n,) and image points (k,) that can be adjusted together.

    A point needs two rays or coordinates, and a photograph three points.
    """
    seen = network.image_points
    control = np.zeros(len(network.points), dtype=bool)
    control[network.control.complete.point] = True
    images, points = estimate.oriented.copy(), estimate.determined.copy()
    while True:
        used = images[seen.image] & points[seen.point]
        rays = np.bincount(seen.point[used], minlength=len(points))
        count = np.bincount(seen.image[used], minlength=len(images))
        fewer = points & (rays >= np.where(control, 1, 2)), images & (count >= MIN_KNOWN)
        if np.array_equal(fewer[0], points) and np.array_equal(fewer[1], images):
            return images, points, used
        points, images = fewer
