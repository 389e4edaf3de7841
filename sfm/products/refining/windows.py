"""Key points of a model, measured again in its photographs by least squares matching.

Every key point is matched from the reference photograph of its object point. Trials on a few photographs
choose the size of the windows. Blurred or noisy photographs are reduced before matching.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfm.files.globs import why_no_folder
from sfm.matching.lsm.coverage import MAX_COST_RATIO, plane_warps, points_apart
from sfm.matching.lsm.patch_equations import linear_part
from sfm.matching.lsm.surface_planes import planes_at
from sfm.matching.lsm.two_photo import LsmSettings, match_lsm
from sfm.matching.radiometry import MEMORY_BYTES, Grey, GreyPhotographs, grey_of, shrink_photograph
from sfm.model.conventions import MAD_TO_SIGMA, AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import PhotographError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, rows_of
from sfm.orientation.image_rays import intersect_image_points
from sfm.photographs.masks import Masks
from sfm.photographs.reading import read_photograph
from sfm.runtime.progress import SILENT, Progress

TRIAL_PHOTOGRAPHS = 3  # whose points choose the window
MIN_RAYS = 3  # of a point that is measured
SHRINKS = (1, 2, 4)  # pixels of the photograph along the side of one pixel of the reduced photograph
# Ratio of precisions up to which finer pixels are preferred. Surfaces are not plane over large windows, which
# shifts the matches of all photographs alike, and no residual shows it.
MAX_REDUCED_RATIO = 1.5
TRIAL_RAYS = 100  # with fewer rays the window stays as it is


class Size(NamedTuple):
    """Size of windows in photographs that may be reduced."""

    window_px: int  # odd side, in pixels of the reduced photographs
    shrink: int = 1  # pixels of the photograph along the side of a reduced pixel

    @property
    def side_px(self) -> int:
        """Side in pixels of the model."""
        return self.window_px * self.shrink


class Limits(NamedTuple):
    """Limits of an accepted match."""

    shift_px: float  # largest distance from the key point
    correlation: float  # smallest correlation coefficient


@dataclass(frozen=True)
class Windows:
    """Image points measured again."""

    xy: FloatArray  # px, NaN if not measured, with the reason in the flag, (k, 2)
    covariance: FloatArray  # px^2, (k, 2, 2)
    flag: IntArray  # see LsmFlag, (k,)


@dataclass(frozen=True)
class KeyPoints:
    """Image points of a model that can be measured again, with their templates."""

    folder: Path  # of the photographs
    network: Network  # the model
    rows: IntArray  # image points that can be measured, (k,)
    reference: IntArray  # image point that is the template of each point, -1 for points not measured, (n,)
    limits: Limits  # of a match, in pixels of the photographs


def match_windows(
    keys: KeyPoints,
    estimate: Estimate,
    size: Size,
    *,
    rows: IntArray | None = None,
    progress: Progress = SILENT,
) -> Windows:
    """Measure image points by least squares matching from the reference photograph of their point.

    The window is projected in perspective on the plane through the points around it. In the reference it is
    moved to a whole pixel, which avoids resampling. Half of the noise of a match is that of the template, and
    is assigned to the reference. Matching uses the pixels of the photographs, which may be reduced. The
    result is in pixels of the model.

    Args:
        keys: key points of the model.
        estimate: solution of the model.
        size: size of the windows.
        rows: image points to measure; all key points if not given.
        progress: receives the reference photographs.

    Raises:
        PhotographError: a photograph cannot be read, or has another size than its camera.

    Source: Gruen (1985), S. Afr. J. Photogrammetry 14(3).
    """
    photographs = Photographs(keys.network, estimate, keys.folder, shrink=size.shrink)
    rows, reference, limits = keys.rows if rows is None else rows, keys.reference, keys.limits
    window_px = size.window_px
    shrink = size.shrink
    # the model in the pixels of reduced photographs
    network, camera = keys.network, keys.network.camera
    seen = network.image_points
    seen = replace(seen, xy=(seen.xy + 0.5) / shrink - 0.5, covariance=seen.covariance / shrink**2)
    estimate = replace(estimate, cameras=tuple(camera.reduced(shrink) for camera in estimate.cameras))
    xy, covariance = np.full((len(seen), 2), np.nan), np.full((len(seen), 2, 2), np.nan)
    flag = np.zeros(len(seen), dtype=np.int64)
    at_template, number = np.zeros((len(reference), 2, 2)), np.zeros(len(reference), dtype=np.int64)
    template_of = reference[seen.point]
    place = np.rint(seen.xy[template_of])  # px, in the reference, (k, 2)
    from_photograph = rows_of(seen.image[template_of[rows]], len(network.images))
    of_photograph = rows_of(seen.image, len(network.images))
    progress.stage("matching", sum(len(to_match) > 0 for to_match in from_photograph))
    for i, part in enumerate(from_photograph):
        if not len(part):
            continue
        matched = rows[part]
        matched = matched[seen.image[matched] != i]
        image, at, point = seen.image[matched], place[matched], seen.point[matched]
        points, normal = _planes(estimate, camera, i, at, point, of_photograph[i], seen)
        warp = plane_warps(estimate, camera, i, image, at, points, normal, window_px / 2)
        moved = np.einsum("kij,kj->ki", linear_part(warp), at - seen.xy[template_of[matched]])
        others, number_of = np.unique(image, return_inverse=True)
        for j, in_photograph in zip(others.tolist(), rows_of(number_of, len(others)), strict=True):
            to = matched[in_photograph]
            match = match_lsm(
                photographs.grey(i),
                photographs.grey(j),
                place[to],
                seen.xy[to] + moved[in_photograph],
                start=warp[in_photograph],
                settings=LsmSettings(
                    window_px=window_px, max_shift_px=limits.shift_px, min_correlation=limits.correlation
                ),
            )
            flag[to] = match.flag
            good = match.good
            half, back = match.covariance[good] / 2, np.linalg.inv(linear_part(match.warp[good]))
            xy[to[good]], covariance[to[good]] = match.xy[good], half
            at_template[seen.point[to[good]]] += back @ half @ back.transpose(0, 2, 1)
            number[seen.point[to[good]]] += 1
        progress.advance(network.images[i])
    measured = np.flatnonzero(number)
    xy[reference[measured]] = place[reference[measured]]
    covariance[reference[measured]] = at_template[measured] / number[measured, None, None]
    return Windows(shrink * (xy + 0.5) - 0.5, shrink**2 * covariance, flag)


def best_size(
    keys: KeyPoints,
    estimate: Estimate,
    sizes: Sequence[Size],
    *,
    alike: float = MAX_COST_RATIO,
    tolerance_px: float,
) -> Size:
    """Return the size of windows that together give the best precision.

    The criterion is the spread of the rays that meet, over the square root of the number of windows that do
    not overlap. If windows are too small to be matched, few rays meet. A few photographs are enough for the
    test.

    Args:
        keys: key points of the model.
        estimate: solution of the model.
        sizes: sizes to try.
        alike: ratio of precisions up to which the first size is preferred to the best one.
        tolerance_px: largest residual of a ray that counts, px.
    """
    network, rows = keys.network, keys.rows
    seen = network.image_points
    template = seen.image[keys.reference[seen.point[rows]]]
    most = np.argsort(-np.bincount(template, minlength=len(network.images)), kind="stable")
    trial_rows = rows[np.isin(template, most[:TRIAL_PHOTOGRAPHS])]
    costs = []
    for size in sizes:
        windows = match_windows(keys, estimate, size, rows=trial_rows)
        used, v = _rays_that_meet(network, estimate, windows, tolerance_px)
        apart = points_apart(replace(seen, xy=windows.xy), used, size.side_px, n_points=len(network.points))
        number = int((used & apart[seen.point]).sum())
        enough = len(v) >= TRIAL_RAYS
        costs.append(MAD_TO_SIGMA * float(np.median(np.abs(v))) / np.sqrt(number) if enough else np.inf)
    return sizes[int(np.argmax(np.array(costs) <= alike * min(costs)))]


def match_reduced(
    keys: KeyPoints,
    estimate: Estimate,
    windows: Windows,
    others: BoolArray,
    *,
    size: Size,
    tolerance_px: float,
) -> Windows:
    """Measure points that were not matched in all of their photographs again, in reduced photographs.

    If a photograph is blurred, or its noise is smoothed as in telephones, single pixels have no texture, and
    matching diverges. Each point uses the finest pixels in which most of its rays meet.

    Args:
        keys: key points of the model.
        estimate: adjusted with the image points measured so far.
        windows: image points measured so far.
        others: points that may be measured again, those that were not adjusted, (n,).
        size: size of these windows; windows in reduced photographs have the same number of pixels.
        tolerance_px: largest residual of a ray that counts, px.
    """
    network, seen, n = keys.network, keys.network.image_points, len(keys.network.points)
    rows = keys.rows[others[seen.point[keys.rows]]]
    xy, covariance, flag = windows.xy.copy(), windows.covariance.copy(), windows.flag.copy()
    asked = np.bincount(seen.point[rows], minlength=n)
    rays = np.bincount(seen.point[_rays_that_meet(network, estimate, windows, tolerance_px)[0]], minlength=n)
    for shrink in [coarser for coarser in SHRINKS if coarser > size.shrink]:
        again = rows[(rays < asked)[seen.point[rows]]]
        if not len(again):
            break
        reduced = match_windows(keys, estimate, size._replace(shrink=shrink), rows=again)
        used, _ = _rays_that_meet(network, estimate, reduced, tolerance_px)
        now = np.bincount(seen.point[used], minlength=n)
        taken = np.flatnonzero((now > rays)[seen.point])
        xy[taken], covariance[taken], flag[taken] = (
            reduced.xy[taken],
            reduced.covariance[taken],
            reduced.flag[taken],
        )
        rays = np.maximum(rays, now)
    return Windows(xy, covariance, flag)


def _rays_that_meet(
    network: Network, estimate: Estimate, windows: Windows, tolerance_px: float
) -> tuple[BoolArray, FloatArray]:
    """Return which rays meet in their points, (k,), and the residuals of these rays, tangents, (r, 2)."""
    seen = network.image_points
    good = np.isfinite(windows.xy).all(axis=1)
    rays = ImagePoints(seen.image[good], seen.point[good], windows.xy[good], windows.covariance[good])
    met = intersect_image_points(
        rays, network.camera, estimate, n_points=len(network.points), tolerance_px=tolerance_px
    )
    meet = met.used & (met.rays >= MIN_RAYS)[rays.point]
    used = np.zeros(len(seen), dtype=bool)
    used[np.flatnonzero(good)[meet]] = True
    return used, met.residuals[meet]


def _planes(
    estimate: Estimate,
    camera: IntArray,
    i: int,
    place: FloatArray,
    point: IntArray,
    rows_seen: IntArray,
    seen: ImagePoints,
) -> tuple[FloatArray, FloatArray]:
    """Return object points and normals at positions of a photograph.

    Without a known plane, the normal is the viewing direction of the photograph.
    """
    planes = planes_at(estimate, camera, i, place, seen.point[rows_seen])
    points, normal = planes.points, planes.normal
    unknown = ~np.isfinite(points).all(axis=1)
    points[unknown] = estimate.points[point[unknown]]
    normal[unknown] = estimate.rotation[i][:, 2]
    return points, normal


class Photographs:
    """The photographs of a model, read when needed; the oldest are removed from memory."""

    def __init__(
        self,
        network: Network,
        estimate: Estimate,
        folder: Path,
        *,
        shrink: int = 1,
        memory_bytes: int = MEMORY_BYTES,
    ) -> None:
        """Start with no photograph read; `shrink` pixels along each side are averaged into one."""
        self._paths = photograph_paths(network, estimate, folder)
        self._names = network.images
        self._sizes = [estimate.cameras[camera].size_px for camera in network.camera]
        self.shrink = shrink
        self._kept = GreyPhotographs(self._read, memory_bytes=memory_bytes)

    def grey(self, i: int) -> Grey:
        """Return one photograph."""
        return self._kept[i]

    def _read(self, i: int) -> AnyArray:
        photograph = read_of_size(self._paths[i], self._names[i], self._sizes[i])
        return photograph if self.shrink == 1 else shrink_photograph(grey_of(photograph), self.shrink)


def outside_masks(network: Network, estimate: Estimate, folder: Path, photographs: Path) -> BoolArray:
    """Return which image points are in the black part of their photograph's mask, (k,).

    Args:
        network: the model.
        estimate: solution of the model.
        folder: folder of the masks.
        photographs: folder of the photographs.

    Raises:
        SurveyFileError: the folder has no mask of any photograph, or one that cannot be its mask.
        PhotographError: a mask cannot be read.
    """
    seen, masks = network.image_points, Masks(folder)
    masks.refuse_wrong({name: photographs / name for name in network.images})
    sizes = [estimate.cameras[lens].size_px for lens in network.camera]
    return ~masks.visible_points(network.images, sizes, seen.image, seen.xy)


def photograph_paths(network: Network, estimate: Estimate, folder: Path) -> list[Path]:
    """Return the paths of all photographs of a model.

    Raises:
        SurveyFileError: an oriented photograph is not in the folder, or a path leads out of the folder.
    """
    if not folder.is_dir():
        raise SurveyFileError(f"{folder}: {why_no_folder(folder)}; the photographs of the model were needed")
    paths = [folder / name for name in network.images]
    for name, path in zip(network.images, paths, strict=True):
        if not path.resolve().is_relative_to(folder.resolve()):
            raise SurveyFileError(f"{folder}: photograph '{name}' of the model is outside this folder")
    lost = [i for i in np.flatnonzero(estimate.oriented) if not paths[i].is_file()]
    if lost:
        more = f", and {len(lost) - 1} more are not" if len(lost) > 1 else ""
        raise SurveyFileError(
            f"{folder}: photograph '{network.images[lost[0]]}' of the model is not in this folder{more}"
        )
    return paths


def read_of_size(path: Path, name: str, size_px: tuple[int, int], *, channel: str = "luminance") -> AnyArray:
    """Return a photograph of a model, (H, W).

    Raises:
        PhotographError: it cannot be read, or has another size than its camera.
    """
    (width, height), short = size_px, f"{path.name}: "
    try:
        photograph = read_photograph(path, channel=channel)
    except PhotographError as error:  # folders of a rig contain photographs of equal names
        raise PhotographError(f"{name}: {str(error).removeprefix(short)}") from error
    if photograph.shape != (height, width):
        raise PhotographError(
            f"{name}: {photograph.shape[1]} x {photograph.shape[0]} px, its camera has {width} x {height} px"
        )
    return photograph
