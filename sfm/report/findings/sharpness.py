"""How sharp the photographs are, by the edges of their targets, and which are blurred beside the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sfm.adjustment.quality.consistency import FAMILY, Consistency
from sfm.adjustment.quality.statistics import more_than_chance
from sfm.conventions import BoolArray, FloatArray
from sfm.distributions import t_ppf
from sfm.remarks.remark import Remark, remark
from sfm.result import PhotographTargets, SurveyResult


def edges_of(photographs: Sequence[PhotographTargets]) -> dict[str, float]:
    """Return the median blur of the edges of the targets of each photograph.

    Args:
        photographs: with their targets.

    Returns:
        Standard deviation of an edge, px, by name; photographs without measured edges are
        left out.
    """
    found = {}
    for one in photographs:
        blur = np.zeros(0) if one.blur is None else one.blur[np.isfinite(one.blur)]
        if len(blur):
            found[one.image] = float(np.median(blur))
    return found


def sharpness_remarks(
    result: SurveyResult, edges: Mapping[str, float], consistency: Consistency
) -> tuple[Remark, ...]:
    """Return that photographs are blurred where that explains their residuals, few points or absence.

    Photographs are compared with those of their camera: lens, pixels and size of the photographs differ
    between cameras, and edges with them.
    """
    a = result.adjustment
    m, n = len(a.network.images), len(a.network.points)
    unseen = n - np.bincount(a.network.image_points.image[~a.rejected], minlength=m)
    few = np.flatnonzero(more_than_chance(unseen, np.full(m, n), FAMILY))
    suspected = {one.image for one in result.failed} | {a.network.images[i] for i in few}
    if consistency.uneven is not None:
        suspected.add(consistency.uneven.worst)
    cameras: dict[str, list[str]] = {}
    for one in result.photographs:
        if one.image in edges:
            cameras.setdefault(one.camera, []).append(one.image)
    remarks = []
    for camera, names in cameras.items():
        blur = np.array([edges[name] for name in names])
        large = larger_than_the_others(np.log(blur), level=FAMILY / len(cameras))
        blurred = [name for name, one in zip(names, large, strict=True) if one and name in suspected]
        if blurred:
            remarks.append(
                remark(
                    "photographs_blurred",
                    photographs=blurred,
                    blur=(max(edges[name] for name in blurred), "px"),
                    camera=camera if len(cameras) > 1 else None,
                    others=(float(np.median(blur[~large])), "px"),
                )
            )
    return tuple(remarks)


def larger_than_the_others(values: FloatArray, *, level: float = FAMILY) -> BoolArray:
    """Return which values are larger than those of the others by more than chance, fewer than half, (n,).

    Args:
        values: (n,).
        level: probability that chance makes one of them larger.

    Source: Rosner (1983), Percentage points for a generalized ESD many-outlier procedure, Technometrics
    25(2), 165-172; one-sided.
    """
    n = len(values)
    order = np.argsort(-values, kind="stable")
    outliers = 0
    for k in range((n - 1) // 2):
        kept = values[order[k:]]
        left = n - k
        if left < 3 or not kept.std():
            break
        t = float(t_ppf(1 - level / left, left - 2))
        critical = (left - 1) * t / np.sqrt((left - 2 + t**2) * left)
        if (kept[0] - kept.mean()) / kept.std(ddof=1) > critical:
            outliers = k + 1
    large: BoolArray = np.zeros(n, dtype=bool)
    large[order[:outliers]] = True
    return large
