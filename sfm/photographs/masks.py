"""Masks of photographs: what is black in them is ignored.

The mask of `a/b.jpg` is the picture `a/b.jpg.png` in the folder of masks, of the size of the photograph, or
`b.jpg.png` there. That of `c.png` may be `c.png` too. COLMAP and OpenSfM name masks so. A photograph without
a mask is used whole.

A survey asks for a mask in several stages. One bit a pixel, compressed, keeps it from being decoded in each.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from threading import Lock

import numpy as np

from sfm.files.globs import why_no_folder
from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import PhotographError, SurveyFileError
from sfm.model.network import rows_of
from sfm.photographs.exif import read_metadata
from sfm.photographs.reading import read_mask
from sfm.runtime.sampling import is_shown

SUFFIX = ".png"
MASKS = "masks"  # folder in which masks are searched
HELD_BYTES = 50_000_000  # of decoded masks; one of 24 megapixels with smooth outlines takes 30 kB


@dataclass(frozen=True)
class Masks:
    """The masks of a survey; without a folder, no photograph has one."""

    folder: Path | None = None

    def path_of(self, name: str) -> Path | None:
        """Return the mask of a photograph; None if it has none.

        Args:
            name: name of the photograph.
        """
        path = PurePosixPath(name)
        if self.folder is None or path.is_absolute() or ".." in path.parts:
            return None
        for text in (name, path.name):
            for mask in (f"{text}{SUFFIX}", text):
                if mask.endswith(SUFFIX) and (self.folder / mask).is_file():
                    return self.folder / mask
        return None

    def beside(self, names: Sequence[str]) -> frozenset[Path]:
        """Return the masks that cannot be meant as photographs: those that have the name of one and a suffix.

        Args:
            names: names of the photographs, among which masks in their folder may be.
        """
        masks = {name: self.path_of(name) for name in names}
        return frozenset(
            mask.resolve()
            for name, mask in masks.items()
            if mask is not None and mask.name == PurePosixPath(name).name + SUFFIX
        )

    def visible(self, name: str, xy: FloatArray, size_px: tuple[int, int]) -> BoolArray:
        """Return which positions in a photograph are not masked, (k,).

        Args:
            name: name of the photograph.
            xy: positions in the pixel frame, px, (k, 2); those outside the photograph count as at its border.
            size_px: width and height of the photograph, px.

        Raises:
            SurveyFileError: the mask has another size than the photograph.
            PhotographError: the mask cannot be read.
        """
        black = self.black(name, size_px)
        return np.ones(len(xy), dtype=bool) if black is None else is_shown(black, xy)

    def visible_points(
        self, names: Sequence[str], sizes_px: Sequence[tuple[int, int]], image: IntArray, xy: FloatArray
    ) -> BoolArray:
        """Return which positions in several photographs are not masked, (k,).

        Args:
            names: names of the photographs.
            sizes_px: width and height of each, px.
            image: index of the photograph of each position, (k,).
            xy: positions in the pixel frame, px, (k, 2).

        Raises:
            SurveyFileError: a mask has another size than its photograph.
            PhotographError: a mask cannot be read.
        """
        visible = np.ones(len(xy), dtype=bool)
        for i, rows in enumerate(rows_of(image, len(names))) if self.folder is not None else ():
            if len(rows):
                visible[rows] = self.visible(names[i], xy[rows], sizes_px[i])
        return visible

    def black(self, name: str, size_px: tuple[int, int]) -> BoolArray | None:
        """Return which pixels of a photograph are masked, (H, W); None if it has no mask.

        Args:
            name: name of the photograph.
            size_px: width and height of the photograph, px.

        Raises:
            SurveyFileError: the mask has another size than the photograph.
            PhotographError: the mask cannot be read.
        """
        path = self.path_of(name)
        if path is None:
            return None
        height, width, bits = _HELD.mask(path, size_px)
        _refuse_size(path, (width, height), size_px)
        packed = np.frombuffer(zlib.decompress(bits), np.uint8)
        return np.unpackbits(packed, count=height * width).reshape(height, width).astype(bool)

    def cover(self, name: str, photograph: AnyArray) -> AnyArray:
        """Return the photograph with the median of its visible pixels where it is masked, (H, W).

        Args:
            name: name of the photograph.
            photograph: intensities, (H, W).

        Raises:
            SurveyFileError: the mask has another size than the photograph.
            PhotographError: the mask cannot be read.
        """
        height, width = photograph.shape
        black = self.black(name, (width, height))
        if black is None or not black.any():
            return photograph
        usual = 0 if black.all() else np.median(photograph[~black])
        return np.where(black, np.asarray(usual).astype(photograph.dtype), photograph)

    def refuse_wrong(self, paths: Mapping[str, Path]) -> None:
        """Raise SurveyFileError if no photograph has a mask, or one has that of another.

        Args:
            paths: paths of all photographs, by their names; those that cannot be read are not checked.

        Raises:
            SurveyFileError: no photograph has a mask; a mask has another size than its photograph, is that of
                two photographs, or a photograph.
            PhotographError: a mask cannot be read.
        """
        if self.folder is None:
            return
        if not self.folder.is_dir():
            raise SurveyFileError(
                f"{self.folder}: {why_no_folder(self.folder)}; needed the folder of the masks"
            )
        owner: dict[Path, str] = {}
        photographs = {path.resolve() for path in paths.values()}
        for name, path in paths.items():
            mask = self.path_of(name)
            if mask is None:
                continue
            if mask.resolve() in photographs:
                raise SurveyFileError(
                    f"{mask}: is a photograph, needed the mask of {name}; name it {name}{SUFFIX}, or leave "
                    "its folder out of images"
                )
            if mask in owner:
                raise SurveyFileError(f"{mask}: the mask would be that of {owner[mask]} and of {name}")
            owner[mask] = name
            with suppress(PhotographError):  # reported when it is measured
                _refuse_size(mask, read_metadata(mask).size_px, read_metadata(path).size_px)
        if not owner:
            first = next(iter(paths))
            raise SurveyFileError(
                f"{self.folder}: no mask of a photograph; that of {first} would be {first}{SUFFIX}"
            )


class _HeldMasks:
    """Masks that were decoded, as height, width, and compressed bits that are 1 where the mask is black."""

    def __init__(self) -> None:
        self._of_file: dict[tuple[Path, int, int], tuple[int, int, bytes]] = {}
        self._lock = Lock()

    def mask(self, path: Path, size_px: tuple[int, int]) -> tuple[int, int, bytes]:
        """Return the mask in a file, which is read again if the file has changed.

        Raises:
            SurveyFileError: it is read, and has another size than its photograph.
            PhotographError: it cannot be read.
        """
        try:
            state = path.stat()
        except OSError as error:
            raise PhotographError(f"{path.name}: {error.strerror}") from error
        key = path, state.st_mtime_ns, state.st_size
        with self._lock:
            held = self._of_file.get(key)
        if held is None:
            _refuse_size(path, read_metadata(path).size_px, size_px)  # before so many pixels are decoded
            mask = read_mask(path)
            held = *mask.shape, zlib.compress(np.packbits(mask == 0).tobytes(), 1)
            with self._lock:
                self._of_file[key] = held
                while sum(len(bits) for _, _, bits in self._of_file.values()) > HELD_BYTES:
                    del self._of_file[next(iter(self._of_file))]
        return held


_HELD = _HeldMasks()


def find_masks(folder: Path, names: Sequence[str]) -> tuple[Masks, str]:
    """Return the masks in a folder of photographs, and the path of their folder from there.

    Args:
        folder: contains the photographs, and a folder of masks; or one is beside it, as OpenSfM has it. The
            masks of that are not returned, as a survey uses no files outside its folder.
        names: names of the photographs.
    """
    for path in (MASKS, f"../{MASKS}"):
        masks = Masks(folder / path)
        if any(map(masks.path_of, names)):
            return masks if path == MASKS else Masks(), path
    return Masks(), ""


def _refuse_size(mask: Path, size_px: tuple[int, int], needed: tuple[int, int]) -> None:
    if size_px != tuple(needed):
        raise SurveyFileError(
            f"{mask}: the mask has {size_px[0]} x {size_px[1]} px, its photograph {needed[0]} x "
            f"{needed[1]} px"
        )
