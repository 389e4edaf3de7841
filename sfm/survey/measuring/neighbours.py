"""Which photographs were taken near one another: by satellite navigation, and in a series."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import PurePosixPath

import numpy as np
from scipy.spatial import cKDTree

from sfm.conventions import IntArray
from sfm.photographs.exif import Metadata
from sfm.photographs.satellite_positions import USUAL_SIGMAS_M, local_coordinates

NONE = -1  # in place of a photograph
# Median distance from the median position, in standard deviations, beyond which positions differ by more than
# their errors: errors alone make 1.5 (three axes).
MIN_SPREAD_SIGMAS = 2.0


def neighbours_by_position(metadata: Sequence[Metadata], count: int) -> IntArray:
    """Return the photographs that are nearest to each, nearest first, NONE where there are no more, (m, k).

    Positions in EXIF data are compared in their standard deviations. Where they differ by no more than their
    errors they decide nothing, and no photograph has neighbours.

    Args:
        metadata: of m photographs; some may state no position.
        count: k, of neighbours.
    """
    found = np.full((len(metadata), count), NONE)
    rows = np.array([k for k, one in enumerate(metadata) if one.position is not None], dtype=np.int64)
    positions = [one.position for one in metadata if one.position is not None]
    if len(positions) < 2:
        return found
    _, places = local_coordinates(positions)
    sigma = np.array([one.sigma_m for one in positions])
    places /= np.median(np.where(np.isnan(sigma), USUAL_SIGMAS_M, sigma), axis=0)
    up = places[:, 2]
    up[np.isnan(up)] = np.median(up[~np.isnan(up)]) if not np.isnan(up).all() else 0.0
    if np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)) < MIN_SPREAD_SIGMAS:
        return found
    nearest = min(count + 1, len(rows))
    order = np.atleast_2d(cKDTree(places).query(places, nearest)[1])
    for k, others in enumerate(order):
        closest = others[others != k][:count]
        found[rows[k], : len(closest)] = rows[closest]
    return found


def neighbours_in_sequence(names: Sequence[str], metadata: Sequence[Metadata], count: int) -> IntArray:
    """Return the photographs taken before and after each, NONE at the ends of a series, (m, k).

    A series is of photographs with a time in their EXIF data or, without, of names that differ in nothing but
    numbers. Photographs of the same time are in the order of the numbers in their names.

    Args:
        names: of m photographs, different ones.
        metadata: of them.
        count: k, of neighbours, even: half of them before, half after; the nearest first.
    """
    series: dict[tuple[object, ...], list[int]] = {}
    for k, one in enumerate(metadata):
        camera = (one.make, one.model, one.serial, PurePosixPath(names[k]).parent)
        by_name = re.sub(r"\d+", "0", names[k]) if one.taken is None else ""
        series.setdefault((*camera, by_name), []).append(k)

    def moment(k: int) -> tuple[datetime, list[int], str]:
        numbers = [int(digits) for digits in re.findall(r"\d+", names[k])]
        return metadata[k].taken or datetime.min, numbers, names[k]

    found = np.full((len(names), count), NONE)
    for members in series.values():
        ordered = np.array(sorted(members, key=moment))
        for column, offset in enumerate(step for k in range(1, count // 2 + 1) for step in (k, -k)):
            from_, to = (
                (ordered[:-offset], ordered[offset:]) if offset > 0 else (ordered[-offset:], ordered[:offset])
            )
            found[from_, column] = to
    return found
