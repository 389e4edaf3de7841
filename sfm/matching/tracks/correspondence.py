"""Correspondence: combine unlabelled targets of all oriented photographs into object points.

Two rays meet within the tolerance all along an epipolar line, so a pair is only a hypothesis. Its
intersection is projected into all photographs, and the targets found there decide. The measure is the number
of equally good points that chance would give. It is small if many photographs agree closely, and large if the
point should be visible in a photograph but is not found. The best hypotheses are accepted first and their
targets are used up. The rest is judged again among the remaining targets.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm.matching.epipolar import essential_matrices
from sfm.matching.tracks.evidence import (
    SEARCH,
    Scene,
    grow,
    in_view,
    intersect,
    list_seeds,
    meet,
    prune,
    same_target,
)
from sfm.model.arguments import check_indices, checked_arguments, checked_fields
from sfm.model.camera import tangents_from_pixel
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate

# Two points that never share a photograph and lie closer than this many tolerances are one target.
SAME_TOLERANCES = 2.5
# Largest number of cells of the search raster along the longer side of a photograph.
RASTER = 64


@dataclass(frozen=True)
class Correspondences:
    """Object points found among unlabelled targets, and the targets that belong to them."""

    image: IntArray  # index of the photograph, (k,)
    target: IntArray  # index among the targets of that photograph, (k,)
    point: IntArray  # number of the object point, 0 to n - 1, (k,)
    residual_px: FloatArray  # distance of the target from the projected point, px, (k,)
    points: FloatArray  # intersected object points, object unit, (n, 3)

    def rays(self) -> IntArray:
        """Return the number of photographs in which each point was found, (n,)."""
        return np.bincount(self.point, minlength=len(self.points))


@checked_fields
@dataclass(frozen=True)
class TargetLimits:
    """Limits of the search for targets that belong together."""

    max_size_ratio: float = 1.6  # largest ratio of two diameters on the object for one target
    min_angle_deg: float = 5.0  # smallest angle of two rays that may start a point
    max_partners: int = 20  # photographs with which each one is paired to start points
    max_false: float = 0.1
    """largest number of chance points, expected among all hypotheses, for a point to be accepted"""


@checked_arguments(camera="m")
def match_targets(
    estimate: Estimate,
    camera: IntArray,
    targets: Sequence[FloatArray],
    *,
    tolerance_px: float,
    min_rays: int = 3,
    kinds: Sequence[IntArray] | None = None,
    diameters_px: Sequence[FloatArray] | None = None,
    limits: TargetLimits = TargetLimits(),
) -> Correspondences:
    """Match unlabelled targets across all oriented photographs at once and intersect their points.

    Args:
        estimate: interior and exterior orientation; photographs without orientation are ignored.
        camera: index of the camera of each photograph, (m,).
        targets: positions of the unlabelled targets of each photograph, px, m arrays (k_i, 2).
        tolerance_px: largest distance of a target from its projected point. It must cover the error of the
            orientation, and should be less than a quarter of the spacing of the targets.
        min_rays: fewest photographs per point; with 2, pairs without a rival are added.
        kinds: only targets with the same number match (such as dark and bright), m arrays (k_i,).
        diameters_px: diameters of the targets, m arrays (k_i,). If given, only targets with equal sizes on
            the object match.
        limits: further limits of the search.

    Returns:
        The correspondences; points are ordered by their first photograph and target.

    Raises:
        GeometryError: the lists do not match the photographs, or min_rays is below 2.

    Source: Maas (1992), Digitale Photogrammetrie in der dreidimensionalen Stroemungsmesstechnik, ch. 4
    (epipolar search in several photographs); Moisan and Stival (2004), IJCV 57(3) (false alarms).
    """
    m = len(estimate.position)
    lists = (
        ("cameras", camera),
        ("lists of targets", targets),
        ("kinds", kinds),
        ("diameters", diameters_px),
    )
    for what, given in lists:
        if given is not None and len(given) != m:
            raise GeometryError(
                f"matching: {len(given)} {what} for {counted(m, 'photograph')}, needed one for each"
            )
    for i, xy in enumerate(targets):
        if xy.size and xy.shape != (len(xy), 2):
            raise GeometryError(f"matching: targets of photograph {i} of shape {xy.shape}, needed (k, 2)")
        for numbers in (kinds, diameters_px):
            if numbers is not None and len(numbers[i]) != len(xy):
                raise GeometryError(
                    f"matching: {len(numbers[i])} kinds or diameters for {counted(len(xy), 'target')} of "
                    f"photograph {i}, needed one for each"
                )
    check_indices("match_targets: camera", camera, len(estimate.cameras))
    if min_rays < 2:
        raise GeometryError(f"matching: min_rays is {min_rays}, an object point needs at least 2 rays")
    scene, unusable = _scene(
        estimate, camera, targets, kinds, diameters_px, tolerance_px, limits.max_size_ratio
    )
    # pairs of photographs: each with the nearest ones taken from another position
    index = np.flatnonzero(estimate.oriented)
    base = np.linalg.norm(estimate.position[index][:, None] - estimate.position[index][None], axis=2)
    apart = base > 1e-3 * base.max(initial=0.0)
    order = np.argsort(np.where(apart, base, np.inf), axis=1, kind="stable")
    near = {
        (min(i, int(j)), max(i, int(j)))
        for i in range(len(index))
        for j in order[i, : min(limits.max_partners, int(apart[i].sum()))]
    }
    pairs = index[np.array(sorted(near), dtype=np.int64).reshape(-1, 2)]
    search = _Search(
        scene,
        np.repeat(np.arange(m), np.diff(scene.first)),
        pairs,
        essential_matrices(estimate.position, estimate.rotation, pairs),
        math.cos(math.radians(limits.min_angle_deg)),
        unusable,
        [],
        np.zeros((0, 3)),
    )
    while _take_best(search, max(3, min_rays), math.log(limits.max_false)):
        pass
    if min_rays == 2:
        _take_lone_pairs(search)
    return _collect(search)


@dataclass
class _Search:
    """State shared by the rounds of the search; `used` and `tracks` grow from round to round."""

    scene: Scene
    photograph: IntArray  # of each target, (N,)
    pairs: IntArray  # photographs that start points together, (p, 2)
    E: FloatArray  # their essential matrices, (p, 3, 3)
    cos_angle: float  # of the smallest angle between rays
    used: BoolArray  # targets that no longer take part, (N,)
    tracks: list[IntArray]  # of each accepted point, its target in each photograph or -1, (m,)
    points: FloatArray  # coordinates of the accepted points, object unit, (n, 3)

    def seeds(self) -> IntArray:
        """Return pairs of unused targets on each other's epipolar lines, (s, 2)."""
        arguments = (self.scene, self.pairs, self.E, self.used)
        seeds = np.empty((list_seeds(np.empty((0, 2), dtype=np.int64), *arguments), 2), dtype=np.int64)
        list_seeds(seeds, *arguments)
        return seeds

    def accept(self, track: IntArray, point: FloatArray) -> None:
        """Use up the targets of a point, and keep the point unless it repeats an accepted one.

        If the orientation is off by more than the tolerance, one target may split into two points.
        """
        self.used[track[track >= 0]] = True
        for k in self._near(track, point):
            if same_target(self.scene, track, point, self.tracks[k], self.points[k], self._reach_px):
                return
        self.tracks.append(track.copy())
        self.points = np.vstack([self.points, point])

    @property
    def _reach_px(self) -> float:
        """Distance in photographs within which two points may be one target, px."""
        return SAME_TOLERANCES * self.scene.tolerance

    def _near(self, track: IntArray, point: FloatArray) -> IntArray:
        """Return the accepted points that may be one target with a point: within its reach of two rays of it.

        Along a ray that is as far as two rays at the smallest angle leave open.
        """
        images = np.flatnonzero(track >= 0)
        ranges = np.linalg.norm(point - self.scene.position[images], axis=1)
        reach = self._reach_px * float((ranges / self.scene.c[images]).max())
        away = np.linalg.norm(self.points - point, axis=1)
        return np.flatnonzero(away <= 2 * reach / math.sqrt(1 - self.cos_angle**2))


def _take_best(search: _Search, min_rays: int, log_max_false: float) -> int:
    """Accept the points that are best for all their targets; return their number."""
    seeds = search.seeds()
    if len(seeds) == 0:
        return 0
    scene = search.scene
    free = np.bincount(search.photograph[~search.used], minlength=len(scene.c))
    best, points, score = grow(
        scene, seeds, search.photograph, search.used, free / scene.area, math.log(len(seeds)), min_rays,
        search.cos_angle,
    )  # fmt: skip
    accepted = 0
    for a in np.argsort(score, kind="stable"):
        if score[a] > log_max_false:
            break
        members = best[a][best[a] >= 0]
        # A target that belongs to a better point waits until that point is accepted or ruled out.
        if not search.used[members].any() and (score[members] >= score[a]).all():
            search.accept(best[a], points[a])
            accepted += 1
    return accepted


def _take_lone_pairs(search: _Search) -> None:
    """Accept pairs without a rival, unless more photographs contradict them than support them."""
    seeds = search.seeds()
    scene = search.scene
    rivals = np.bincount(seeds.ravel(), minlength=len(search.used))
    X, residual = np.empty(3), np.empty(len(scene.c))
    for a, b in seeds[(rivals[seeds] == 1).all(axis=1)]:
        i, j = search.photograph[a], search.photograph[b]
        track = np.full(len(scene.c), -1, dtype=np.int64)
        track[i], track[j] = a, b
        if not meet(scene, a, b, i, j, search.cos_angle, X) or not intersect(scene, track, X):
            continue
        seen = sum(in_view(scene, k, X) for k in range(len(scene.c)))
        if prune(scene, X, track, residual) == 2 and seen <= 4:
            search.accept(track, X)


def _collect(search: _Search) -> Correspondences:
    """Return the accepted points in the order of their first target."""
    if not search.tracks:
        none = np.zeros(0, dtype=np.int64)
        return Correspondences(none, none, none, np.zeros(0), np.zeros((0, 3)))
    scene = search.scene
    tracks, points = np.array(search.tracks), search.points
    order = np.argsort(np.where(tracks >= 0, tracks, len(search.used)).min(axis=1), kind="stable")
    tracks, points = tracks[order], points[order]
    residual = np.zeros(tracks.shape)
    for track, X, r in zip(tracks, points, residual, strict=True):
        intersect(scene, track, X)
        prune(scene, X, track, r)
    point, image = np.nonzero(tracks >= 0)
    target = tracks[point, image]
    return Correspondences(image, target - scene.first[image], point, residual[point, image], points)


def _scene(
    estimate: Estimate,
    camera: IntArray,
    targets: Sequence[FloatArray],
    kinds: Sequence[IntArray] | None,
    diameters_px: Sequence[FloatArray] | None,
    tolerance: float,
    ratio: float,
) -> tuple[Scene, BoolArray]:
    """Return all targets in images free of distortion, and which of them cannot be used."""
    m = len(targets)
    first = np.concatenate([[0], np.cumsum([len(t) for t in targets])]).astype(np.int64)
    total = int(first[-1])
    uv, kind, size = np.zeros((total, 2)), np.zeros(total, dtype=np.int64), np.zeros(total)
    unusable = np.ones(total, dtype=bool)
    c = np.array([estimate.cameras[k].c_px for k in camera])
    windows = []  # largest upright window of tangents (u0, v0, u1, v1) inside the photograph of each camera
    for lens in estimate.cameras:
        width, height = lens.size_px
        x, y = (np.linspace(0, side - 1, 21) for side in (width, height))
        left, right = (tangents_from_pixel(lens, np.column_stack([0 * y + at, y])) for at in (0, width - 1))
        top, bottom = (tangents_from_pixel(lens, np.column_stack([x, 0 * x + at])) for at in (0, height - 1))
        windows.append([left[:, 0].max(), bottom[:, 1].max(), right[:, 0].min(), top[:, 1].min()])
    area, corner, cell = np.ones(m), np.zeros((m, 2)), np.ones(m)
    columns, cells = np.ones((m, 2), dtype=np.int64), np.zeros(m + 1, dtype=np.int64)
    cell_of = np.zeros(total, dtype=np.int64)
    for i in range(m):
        part = slice(first[i], first[i + 1])
        uv[part] = tangents_from_pixel(estimate.cameras[camera[i]], targets[i])
        kind[part] = 0 if kinds is None else kinds[i]
        size[part] = 0.0 if diameters_px is None else diameters_px[i] / c[i]
        unusable[part] = ~np.isfinite(uv[part]).all(axis=1) | ~estimate.oriented[i]
        uv[part][unusable[part]] = 0.0
        known = uv[part][~unusable[part]]
        widest = SEARCH[0] * tolerance / c[i]
        if len(known):
            extent = np.ptp(known, axis=0)
            # Chance could have put the targets anywhere in their extent, widened by the search radius.
            area[i] = np.prod(extent + 2 * widest) * c[i] ** 2
            corner[i] = known.min(axis=0)
            cell[i] = max(widest, extent.max() / RASTER)
            columns[i] = (extent / cell[i]).astype(np.int64) + 1
        at = np.clip(((uv[part] - corner[i]) / cell[i]).astype(np.int64), 0, columns[i] - 1)
        cell_of[part] = cells[i] + at[:, 1] * columns[i, 0] + at[:, 0]
        cells[i + 1] = cells[i] + columns[i].prod()
    start = np.concatenate([[0], np.cumsum(np.bincount(cell_of, minlength=cells[-1]))]).astype(np.int64)
    scene = Scene(
        first, uv, kind, size, float(ratio), float(tolerance), estimate.oriented, c,
        np.ascontiguousarray(estimate.position),  # kernels are compiled for each layout
        np.swapaxes(estimate.rotation, 1, 2).copy(), np.array([windows[k] for k in camera]), area, corner,
        cell, columns, cells[:-1], start, np.argsort(cell_of, kind="stable"),
    )  # fmt: skip
    return scene, unusable
