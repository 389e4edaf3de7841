"""The photographs and masks of a model: where they are, and as many in memory as there is place for."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfm.conventions import AnyArray, BoolArray
from sfm.errors import PhotographError, SurveyFileError
from sfm.files.globs import why_no_folder
from sfm.matching.grey_photographs import MEMORY_BYTES, GreyPhotographs
from sfm.matching.radiometry import Grey, averaged, grey_of
from sfm.network import Estimate, Network
from sfm.photographs.reading import read_photograph


class Photographs:
    """The photographs of a model, read when they are needed; the oldest are forgotten."""

    def __init__(
        self,
        network: Network,
        estimate: Estimate,
        folder: Path,
        *,
        shrink: int = 1,
        memory_bytes: int = MEMORY_BYTES,
    ) -> None:
        """Begin with none; `shrink` pixels along each side of a photograph become one."""
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
        return photograph if self.shrink == 1 else averaged(grey_of(photograph), self.shrink)


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
        raise SurveyFileError(f"{folder}: {why_no_folder(folder)}; the photographs of the model were needed")
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
    (width, height), short = size_px, f"{path.name}: "
    try:
        photograph = read_photograph(path, channel=channel)
    except PhotographError as error:  # of the photographs of a rig, each folder has one of that name
        raise PhotographError(f"{name}: {str(error).removeprefix(short)}") from error
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
