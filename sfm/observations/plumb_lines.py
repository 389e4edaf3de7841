"""Points on one plumb line: Z is up, and the place of the line is found from them."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sfm.conventions import FloatArray
from sfm.observations.lines import Lines


class PlumbLines(Lines):
    """Offsets of points in X and Y from a plumb line through them; observed is none."""

    name: ClassVar[str] = "plumb lines"
    single: ClassVar[str] = "plumb line"
    components: ClassVar[tuple[str, ...]] = ("X", "Y")
    least: ClassVar[int] = 2
    turns: ClassVar[bool] = False

    @classmethod
    def axes(cls, X: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return Z, and X and Y."""
        return np.eye(3)[2], np.eye(3)[:2]
