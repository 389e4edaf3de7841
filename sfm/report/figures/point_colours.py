"""Colours of the points of texture, as the photographs show them."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.judgement.survey_result import PhotographTargets
from sfm.model.conventions import AnyArray
from sfm.model.errors import PhotographError
from sfm.model.network import rows_of
from sfm.photographs.reading import read_for_display

SHRINKS = (8, 4, 2, 1)
SIDE_PX = 600  # the shorter side is decoded at this size or larger: a pixel averages a part of a window


def photographed_colours(
    photographs: Sequence[PhotographTargets], adjustment: Adjustment, *, jobs: int = 1
) -> AnyArray | None:
    """Return the colour of each point: the median of those at its accepted image points.

    Args:
        photographs: read again from their files; those that can no longer be read have no part.
        adjustment: the adjustment of the image points.
        jobs: photographs decoded at the same time.

    Returns:
        Red, green and blue, uint8, (n, 3), middle grey for points without a photograph; None where no point
        is one of texture.
    """
    network = adjustment.network
    if not network.windows:
        return None
    used = network.image_points.select(~adjustment.rejected)
    rows = dict(zip(network.images, rows_of(used.image, len(network.images)), strict=True))
    colours = np.full((len(used), 3), -1, dtype=np.int16)

    def sample(photograph: PhotographTargets) -> None:
        at = rows.get(photograph.image, np.zeros(0, dtype=np.int64))
        if not len(at):
            return
        size_px = adjustment.estimate.cameras[network.camera[network.images.index(photograph.image)]].size_px
        shrink = next(s for s in SHRINKS if s == 1 or min(size_px) >= s * SIDE_PX)
        try:
            picture = read_for_display(photograph.path, shrink=shrink)
        except PhotographError:
            return
        scale = np.array(picture.shape[1::-1]) / size_px
        u, v = np.rint(scale * (used.xy[at] + 0.5) - 0.5).astype(np.int64).T
        inside = (np.clip(v, 0, picture.shape[0] - 1), np.clip(u, 0, picture.shape[1] - 1))
        colours[at] = picture[inside][:, ::-1]

    with ThreadPoolExecutor(max_workers=max(1, jobs)) as pool:
        list(pool.map(sample, photographs))
    known = colours[:, 0] >= 0
    point, colours = used.point[known], colours[known]
    medians = np.full((len(network.points), 3), 128, dtype=np.uint8)
    count = np.bincount(point, minlength=len(network.points))
    seen = np.flatnonzero(count)
    middle = (np.cumsum(count) - count + (count - 1) // 2)[seen]
    for channel in range(3):
        order = np.lexsort((colours[:, channel], point))
        medians[seen, channel] = colours[order[middle], channel]
    return medians
