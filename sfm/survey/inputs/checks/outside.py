"""Image points outside their photograph: no photograph has them, so that a setting or a value is wrong.

Single ones are gross errors and are left out by name. More of them refuse the survey, with what would bring
them inside: x and y exchanged, another unit, or a larger photograph.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sfm.camera import Camera
from sfm.conventions import BoolArray, FloatArray, IntArray, pixel_from_image
from sfm.display import listed
from sfm.errors import SurveyFileError
from sfm.network import rows_of
from sfm.survey.inputs.given import Observations

MARGIN_PX = 1.0  # that programs which count pixels from 1 or from corners differ by
MAX_OUTSIDE = 0.05  # of the image points: as many gross errors as measuring ever makes


def outside_photograph(xy: FloatArray, size: FloatArray) -> BoolArray:
    """Return whether image points are outside of their photographs, (k,).

    Args:
        xy: image points, px, (k, 2).
        size: width and height of the photograph of each, px, (k, 2).
    """
    return np.asarray(((xy < -0.5 - MARGIN_PX) | (xy > size - 0.5 + MARGIN_PX)).any(axis=1))


def refuse_outside(
    given: Observations, xy: FloatArray, cameras: Sequence[Camera], camera: IntArray
) -> BoolArray:
    """Return which image points are outside of their photographs, (k,).

    Args:
        given: as they were given.
        xy: in px, (k, 2).
        cameras: of the survey.
        camera: of each image point, (k,).

    Raises:
        SurveyFileError: so many are that a setting is wrong, or all are inside with x and y exchanged.
    """
    size = np.array([one.size_px for one in cameras], dtype=float)[camera]
    outside = outside_photograph(xy, size)
    count, allowed = int(outside.sum()), MAX_OUTSIDE * len(xy)
    if not count:
        return outside
    reasons = [
        words
        for words, other, other_size in _alternatives(given, xy, size, cameras, camera)
        if outside_photograph(other, other_size).sum() <= (allowed if count > allowed else 0)
    ]
    if count <= allowed and not (reasons and reasons[0] == EXCHANGED):
        return outside
    k = int(np.argmax(outside))
    names = listed(dict.fromkeys(cameras[a].name for a in camera[outside].tolist()))
    width, height = size[k].astype(int)
    x, y = given.xy[k]
    needed = np.ceil(xy[outside].max(axis=0)).astype(int)
    larger = f"size_px must be {needed[0]} x {needed[1]} or more, or the unit is another"
    raise SurveyFileError(
        f"{given.table.place(k)}: image point {x:g}, {y:g} {given.unit} is outside its photograph of {width} "
        f"x {height} px (camera {names}), as are {count} of {len(xy)}: {reasons[0] if reasons else larger}"
    )


EXCHANGED = "with x and y exchanged, or width and height in size_px, they are inside"


def _alternatives(
    given: Observations, xy: FloatArray, size: FloatArray, cameras: Sequence[Camera], camera: IntArray
) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Yield what may be wrong, with the image points and photograph sizes as they would be, px."""
    yield EXCHANGED, xy, size[:, ::-1]
    if given.unit == "mm":
        yield "read as px in place of mm they are inside", given.xy, size
        return
    read = xy.copy()
    for one, rows in zip(cameras, rows_of(camera, len(cameras)), strict=True):
        read[rows] = pixel_from_image(xy[rows], one.size_px, one.pixel_mm)
    yield "read as mm in place of px they are inside", read, size
