"""Key points of a model measured anew in parts, so that few photographs are in memory at a time."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.errors import PhotographError, SurveyFileError
from sfm.matching.lsm.multi_photo import match_multi
from sfm.matching.radiometry import grey_of
from sfm.network import Estimate, Network
from sfm.photographs.reading import read_photograph
from sfm.runtime.progress import Progress

MEMORY_BYTES = 1_000_000_000  # of photographs in memory at a time, as single precision
MIN_PARTS = 20  # that the points are matched in, so that progress is seen


@dataclass(frozen=True)
class Windows:
    """Image points measured anew; see `sfm.matching.lsm.multi_photo.MultiMatches`."""

    xy: FloatArray  # px, NaN where the flag says why, (k, 2)
    covariance: FloatArray  # px^2, (k, 2, 2)
    flag: IntArray  # see LsmFlag, (k,)


class Photographs:
    """The photographs of a model, read when they are needed; the oldest are forgotten."""

    def __init__(self, network: Network, estimate: Estimate, folder: Path, memory_bytes: int) -> None:
        self._paths = photograph_paths(network, estimate, folder)
        self._names = network.images
        self._sizes = [estimate.cameras[camera].size_px for camera in network.camera]
        self._memory = memory_bytes
        self._kept: OrderedDict[int, AnyArray] = OrderedDict()

    def bytes_of(self, i: int) -> int:
        """Memory that a photograph takes."""
        width, height = self._sizes[i]
        return 4 * int(width) * int(height)

    def grey(self, i: int) -> AnyArray:
        """Return one photograph, float32, (H, W)."""
        if i not in self._kept:
            self._kept[i] = grey_of(read_of_size(self._paths[i], self._names[i], self._sizes[i]))
        self._kept.move_to_end(i)
        while len(self._kept) > 1 and sum(one.nbytes for one in self._kept.values()) > self._memory:
            self._kept.popitem(last=False)
        return self._kept[i]


def match_windows(
    network: Network,
    estimate: Estimate,
    folder: Path,
    rows: IntArray,
    reference: IntArray,
    *,
    orientation_px: float,
    window_px: int,
    max_shift_px: float,
    min_correlation: float,
    progress: Progress,
    memory_bytes: int = MEMORY_BYTES,
) -> Windows:
    """Measure image points by multi-photo matching, part after part.

    Args:
        network: the model.
        estimate: its solution.
        folder: of its photographs.
        rows: image points to measure, (k,).
        reference: the row of each point that is its template, -1 for points that are not measured, (n,).
        orientation_px: this and the next three as in `sfm.matching.lsm.multi_photo.match_multi`.
        window_px: odd side of the windows.
        max_shift_px: farther from the key point is too far.
        min_correlation: below it a window is not alike.
        progress: told of points.
        memory_bytes: of photographs in memory at a time; those that see one point are in memory together.

    Raises:
        SurveyFileError: a photograph of the model is not in the folder.
        PhotographError: a photograph that cannot be read, or of another size than its camera.
    """
    photographs = Photographs(network, estimate, folder, memory_bytes)
    seen = network.image_points
    xy, covariance = np.full((len(seen), 2), np.nan), np.full((len(seen), 2, 2), np.nan)
    flag = np.zeros(len(seen), dtype=np.int64)
    sizes = np.array([photographs.bytes_of(i) for i in range(len(network.images))])
    parts = list(parts_of(seen.image[rows], seen.point[rows], seen.image[reference], sizes, memory_bytes))
    progress.stage("matching", len(parts))
    row_of = np.full(len(seen), -1)
    for part in parts:
        own = rows[part]
        points, number = np.unique(seen.point[own], return_inverse=True)
        needed, image = np.unique(seen.image[own], return_inverse=True)
        row_of[own] = np.arange(len(own))
        found = match_multi(
            [photographs.grey(i) for i in needed.tolist()],
            replace(
                estimate,
                position=estimate.position[needed],
                rotation=estimate.rotation[needed],
                points=estimate.points[points],
            ),
            network.camera[needed],
            image.ravel(),
            number.ravel(),
            seen.xy[own],
            row_of[reference[points]],
            orientation_px=orientation_px,
            window_px=window_px,
            max_shift_px=max_shift_px,
            min_correlation=min_correlation,
        )
        xy[own], covariance[own], flag[own] = found.xy, found.covariance, found.flag
        progress.advance(network.images[int(seen.image[own[0]])])
    return Windows(xy, covariance, flag)


def parts_of(
    image: IntArray, point: IntArray, reference: IntArray, size: Sequence[int] | IntArray, limit: int
) -> Iterator[IntArray]:
    """Yield the rows of parts of the points, whose photographs are in memory together.

    Points of one reference photograph follow one another, and of these those that the same photographs see;
    a part ends where another point would need more memory.

    Args:
        image: photograph of each row, (k,).
        point: point of each row, (k,).
        reference: photograph of the reference of each point, (n,).
        size: of each photograph, bytes, (m,).
        limit: of a part, bytes.
    """
    by_point = np.argsort(point, kind="stable")
    points, first = np.unique(point[by_point], return_index=True)
    groups = np.split(by_point, first[1:])
    farthest = np.array([int(image[rows].max()) for rows in groups])
    most = max(1, -(-len(groups) // MIN_PARTS))
    part: list[IntArray] = []
    needed: set[int] = set()
    for g in np.lexsort([farthest, reference[points]]).tolist():
        more = needed | set(image[groups[g]].tolist())
        if part and (len(part) >= most or sum(int(size[i]) for i in more) > limit):
            yield np.sort(np.concatenate(part))
            part, more = [], set(image[groups[g]].tolist())
        part.append(groups[g])
        needed = more
    if part:
        yield np.sort(np.concatenate(part))


def outside_masks(network: Network, estimate: Estimate, folder: Path) -> BoolArray:
    """Return which image points are where the mask of their photograph is black, (k,).

    Masks have the name of their photograph with .png behind it, as COLMAP has them; photographs without one
    are seen whole.

    Raises:
        SurveyFileError: no mask at all in the folder.
        PhotographError: a mask that cannot be read or has another size than its photograph.
    """
    seen = network.image_points
    masked = np.zeros(len(seen), dtype=bool)
    some = False
    for i, name in enumerate(network.images):
        path = _path_in(folder, f"{name}.png")
        if not path.is_file():
            continue
        some = True
        mask, (width, height) = read_photograph(path), estimate.cameras[network.camera[i]].size_px
        if mask.shape != (height, width):
            raise PhotographError(
                f"{path.name}: the mask has {mask.shape[1]} x {mask.shape[0]} px, its photograph {width} x "
                f"{height} px"
            )
        rows = np.flatnonzero(seen.image == i)
        at = np.clip(np.rint(np.nan_to_num(seen.xy[rows])).astype(int), 0, [width - 1, height - 1])
        masked[rows] = mask[at[:, 1], at[:, 0]] == 0
    if not some:
        raise SurveyFileError(f"{folder}: no mask of any photograph, expected '{network.images[0]}.png'")
    return masked


def photograph_paths(network: Network, estimate: Estimate, folder: Path) -> list[Path]:
    """Return the paths of all photographs of a model.

    Raises:
        SurveyFileError: one with an orientation is not in the folder, or outside of it.
    """
    if not folder.is_dir():
        raise SurveyFileError(f"{folder}: no such folder; the photographs of the model were needed")
    paths = [_path_in(folder, name) for name in network.images]
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
    photograph, (width, height) = read_photograph(path, channel=channel), size_px
    if photograph.shape != (height, width):
        raise PhotographError(
            f"{name}: {photograph.shape[1]} x {photograph.shape[0]} px, its camera has {width} x {height} px"
        )
    return photograph


def _path_in(folder: Path, name: str) -> Path:
    """Return the path of a photograph, which must be inside the folder."""
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise SurveyFileError(f"{folder}: photograph '{name}' of the model is outside this folder")
    return path
