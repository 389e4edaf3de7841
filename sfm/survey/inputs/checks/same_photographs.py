"""Photographs that show the same picture as another: copies that were saved again, whatever their bytes.

A copy is no second observation: it would only make the result look more precise than it is. No two exposures
have the same noise, so that image points which are the same to the last digit were measured in one picture.
"""

from __future__ import annotations

import numpy as np

from sfm.conventions import FloatArray, IntArray

MIN_COMMON = 4  # image points that must be the same
DIGIT_PX = 1e-6  # differences below it are of writing, not of measuring, px


def same_photographs(image: IntArray, point: IntArray, xy: FloatArray, camera: IntArray) -> dict[int, int]:
    """Return for each photograph that is a copy which earlier one it is a copy of.

    Args:
        image: photograph of each image point, (k,).
        point: its object point, (k,).
        xy: its position, px, (k, 2).
        camera: of each photograph, (m,).
    """
    seen: dict[tuple[int, bytes], int] = {}
    copies: dict[int, int] = {}
    order = np.lexsort((point, image))
    bounds = np.searchsorted(image[order], np.arange(len(camera) + 1))
    for i in range(len(camera)):
        rows = order[bounds[i] : bounds[i + 1]]
        if len(rows) < MIN_COMMON:
            continue
        places = np.rint(xy[rows] / DIGIT_PX).astype(np.int64)
        key = int(camera[i]), point[rows].tobytes() + places.tobytes()
        first = seen.setdefault(key, i)
        if first != i:
            copies[i] = first
    return copies
