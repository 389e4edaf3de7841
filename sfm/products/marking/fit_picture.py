"""Picture of the fit of a mark: the pixels around it, enlarged, with what was fitted."""

from __future__ import annotations

import cv2
import numpy as np

from sfm.model.conventions import AnyArray, FloatArray

ENLARGEMENT = 8
MARGIN_PX, LEAST_PX, MOST_PX = 4, 16, 60  # around the outline; half sides of the picture
OUTLINE, CENTRE = (255, 160, 40), (40, 40, 255)  # blue, green, red
SHIFT = 4  # bits of a fraction of a pixel in OpenCV's lines


def picture_of_mark(photograph: AnyArray, x: float, y: float, outline: FloatArray) -> bytes:
    """Return the picture of a mark as PNG.

    Args:
        photograph: intensities, (H, W), uint8 or uint16.
        x: column of the mark, px.
        y: row of the mark, px.
        outline: line that was fitted, px, (n, 2), or none.
    """
    reach = float(np.abs(outline - (x, y)).max()) if len(outline) else 0.0
    half = int(np.clip(np.ceil(reach) + MARGIN_PX, LEAST_PX, MOST_PX))
    left, top = round(x) - half, round(y) - half
    height, width = photograph.shape
    rows = np.clip(np.arange(top, top + 2 * half + 1), 0, height - 1)
    columns = np.clip(np.arange(left, left + 2 * half + 1), 0, width - 1)
    part = photograph[np.ix_(rows, columns)].astype(np.float32)
    low, high = float(part.min()), float(part.max())
    part = (part - low) * (255 / max(high - low, 1.0))
    side = ENLARGEMENT * (2 * half + 1)
    large = cv2.resize(part.astype(np.uint8), (side, side), interpolation=cv2.INTER_NEAREST)
    picture = cv2.cvtColor(large, cv2.COLOR_GRAY2BGR)

    def at(xy: FloatArray) -> AnyArray:
        place = (np.asarray(xy) - (left, top) + 0.5) * ENLARGEMENT - 0.5
        return np.asarray(np.round(place * 2**SHIFT), dtype=np.int32)

    if len(outline):
        cv2.polylines(picture, [at(outline)], False, OUTLINE, 1, cv2.LINE_AA, SHIFT)
    centre, arm = np.array([x, y]), 1.2
    for step in ((arm, 0.0), (0.0, arm)):
        ends = at(np.array([centre - step, centre + step]))
        cv2.line(picture, ends[0].tolist(), ends[1].tolist(), CENTRE, 1, cv2.LINE_AA, SHIFT)
    _, data = cv2.imencode(".png", picture)
    return bytes(data)
