"""Copies of photographs that were saved again or compressed, found by their errors.

A copy is not a second observation: it would only make the result look more precise than it is. However, if
compression causes larger errors than the original has, the errors differ, and the copy counts as an
observation. Two photographs from one position have the residuals r_i and r_j, which differ by d = r_i - r_j.
With independent errors the square sum of d equals that of both residuals together. With identical errors it
is 0:

    |d|^2 / (|r_i|^2 + |r_j|^2) = 1 - rho.

Copies with the same bytes are found earlier, see `sfm.survey.measuring.targets`. So are copies with identical
image points: no two exposures have the same noise, so image points that agree to the last digit come from one
picture.

Source: Koch (1999), Parameter Estimation and Hypothesis Testing in Linear Models, sec. 2.7 (F distribution).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from sfm.adjustment.result import Adjustment
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.display import agreeing, counted, listed
from sfm.model.distributions import f_sf
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, rows_of

# Correlation from which half of the variance of the errors is common. Real photographs saved again as JPEG of
# quality 40 reach 0.99.
MIN_CORRELATION = 0.5**0.5
SAME_PLACE = 1e-3  # of the distance, and rad: photographs that differ by more are not copies
MIN_COMMON = 4  # image points that must agree
DIGIT_PX = 1e-6  # smaller differences are from writing, not from measuring, px


def find_copies(adjustment: Adjustment) -> dict[str, tuple[str, float]]:
    """Return the copies by name, each with its original and the correlation of their errors.

    Args:
        adjustment: adjustment of all photographs.
    """
    network, estimate = adjustment.network, adjustment.estimate
    seen = network.image_points
    middle = np.median(estimate.points, axis=0)
    distance = np.linalg.norm(estimate.position - middle, axis=1)
    place = np.hstack(
        [estimate.position / max(float(np.median(distance)), 1e-300), estimate.rotation.reshape(-1, 9)]
    )
    level = adjustment.levels.question
    pairs = sorted(cKDTree(place).query_pairs(SAME_PLACE))
    of_image = rows_of(seen.image, len(network.images))
    copies: dict[str, tuple[str, float]] = {}
    for i, j in pairs:
        names = network.images[i], network.images[j]
        if names[0] in copies or names[1] in copies:
            continue
        rho, p = _correlation(adjustment, of_image[i], of_image[j])
        if rho > MIN_CORRELATION and p < level / len(pairs):
            copies[names[1]] = names[0], rho
    return copies


def _correlation(adjustment: Adjustment, rows_i: IntArray, rows_j: IntArray) -> tuple[float, float]:
    """Return the correlation of the errors of two photographs, and its probability for independent errors."""
    seen = adjustment.network.image_points
    used_i, used_j = (rows[~adjustment.rejected[rows]] for rows in (rows_i, rows_j))
    _, a, b = np.intersect1d(seen.point[used_i], seen.point[used_j], return_indices=True)
    if len(a) < MIN_COMMON:
        return 0.0, 1.0
    i, j = used_i[a], used_j[b]
    together = (adjustment.residuals[i] ** 2).sum() + (adjustment.residuals[j] ** 2).sum()
    if not together > 0:
        return 0.0, 1.0
    ratio = float(((seen.xy[i] - seen.xy[j]) ** 2).sum() / together)
    return 1 - ratio, float(1 - f_sf(ratio, 2 * len(a), 2 * len(a)))


def without_copies(network: Network, estimate: Estimate, copies: Collection[str]) -> tuple[Network, Estimate]:
    """Return the network without the image points of copies, and the estimate without their orientation.

    Args:
        network: all image points.
        estimate: approximate values.
        copies: names of the copies.

    Raises:
        GeometryError: fewer than two oriented photographs are left.
    """
    copied = np.isin(network.images, list(copies))
    count = int(estimate.oriented.sum())
    if (estimate.oriented & ~copied).sum() < 2:
        raise GeometryError(
            f"{len(copies)} of {counted(count, 'photograph')} {agreeing(len(copies), 'shows|show')} "
            f"the object as another one does, down to the errors ({listed(copies)}): copies, or nothing "
            "moved between the exposures; photograph from other directions, or move the plate"
        )
    position = np.where(copied[:, None], np.nan, estimate.position)
    rotation = np.where(copied[:, None, None], np.nan, estimate.rotation)
    points = network.image_points.select(~copied[network.image_points.image])
    return replace(network, image_points=points), replace(estimate, position=position, rotation=rotation)


def same_photographs(image: IntArray, point: IntArray, xy: FloatArray, camera: IntArray) -> dict[int, int]:
    """Return the copies with identical image points, each with its original, as indices.

    Args:
        image: photograph of each image point, (k,).
        point: object point of each image point, (k,).
        xy: position of each image point, px, (k, 2).
        camera: camera of each photograph, (m,).
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
