"""Masks of photographs: what is black in them is ignored.

The mask of `a/b.jpg` is the picture `a/b.jpg.png` in the folder of masks, of the size of the photograph, as
in COLMAP and OpenSfM. A photograph without a mask is used whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.conventions import BoolArray, FloatArray
from sfm.errors import SurveyFileError
from sfm.files.globs import why_no_folder
from sfm.photographs.reading import read_photograph


@dataclass(frozen=True)
class Masks:
    """The masks of a survey; without a folder, no photograph has one."""

    folder: Path | None = None

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
        if black is None:
            return np.ones(len(xy), dtype=bool)
        last = np.array(size_px) - 1
        column, row = np.clip(np.rint(np.nan_to_num(xy)).astype(np.int64), 0, last).T
        return np.asarray(~black[row, column])

    def black(self, name: str, size_px: tuple[int, int]) -> BoolArray | None:
        """Return which pixels of a photograph are masked, (H, W); None if it has no mask.

        Args:
            name: name of the photograph.
            size_px: width and height of the photograph, px.

        Raises:
            SurveyFileError: the mask has another size than the photograph.
            PhotographError: the mask cannot be read.
        """
        path = None if self.folder is None else self.folder / f"{name}.png"
        if path is None or not path.is_file():
            return None
        mask = read_photograph(path)
        height, width = mask.shape[:2]
        if (width, height) != tuple(size_px):
            raise SurveyFileError(
                f"{path}: the mask has {width} x {height} px, its photograph {size_px[0]} x {size_px[1]} px"
            )
        return np.asarray(mask == 0)

    def refuse_without(self, names: tuple[str, ...]) -> None:
        """Raise SurveyFileError if the folder has a mask of no photograph.

        Args:
            names: names of all photographs.
        """
        if self.folder is None:
            return
        if not self.folder.is_dir():
            raise SurveyFileError(
                f"{self.folder}: {why_no_folder(self.folder)}; needed the folder of the masks"
            )
        if not any((self.folder / f"{name}.png").is_file() for name in names):
            raise SurveyFileError(
                f"{self.folder}: no mask of a photograph; that of {names[0]} would be {names[0]}.png"
            )
