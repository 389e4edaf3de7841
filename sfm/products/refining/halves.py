"""Halves of the points of a model, adjusted apart: how far their projection centres differ.

Residuals say how well image points fit, not whether errors are common to neighbours. Halves that lie apart on
the object do not have such errors in common.

Source: `benchmarks.halves`, with more draws and the predicted difference.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sfm.adjustment.solve import adjust
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, without_given
from sfm.model.reduced_network import merge_estimate
from sfm.model.similarity import fit_similarity
from sfm.products.refining.oriented_windows import part_of
from sfm.products.refining.windows import MIN_RAYS

STRIPES = 4  # over the object, and cells of a checkerboard along each side
MIN_CENTRES = 4  # three fit a similarity, the fourth checks


def halves_apart(network: Network, estimate: Estimate, accepted: BoolArray) -> float:
    """Return the RMS difference of the projection centres of two halves of the points.

    It is that of a coordinate over three divisions of the points, after a similarity, relative to the
    distance of the centres from the middle of the object.

    Args:
        network: image points; given values take no part.
        estimate: its solution; free parameters of the cameras are adjusted in each half.
        accepted: image points that count, (k,).

    Returns:
        The relative difference; NaN if no division leaves both halves determined.
    """
    network = without_given(network)
    squares = []
    for half in _halves(estimate.points, estimate.position):
        centres = []
        for points in (half, ~half):
            rows = accepted & points[network.image_points.point]
            rays = np.full(len(network.points), MIN_RAYS)
            try:
                part, start, images, kept = part_of(network, estimate, rows, rays)
                a = adjust(part, start, reject="none", covariance=False)
            except GeometryError:
                break
            if not a.converged:
                break
            centres.append(merge_estimate(a.estimate, images, kept).position)
        if len(centres) < 2:
            continue
        first, second = centres
        shared = np.isfinite(first + second).all(axis=1)
        if shared.sum() < MIN_CENTRES:
            continue
        first, second = first[shared], second[shared]
        off = fit_similarity(second, first).apply(second) - first
        distance = np.linalg.norm(first - np.nanmean(estimate.points, axis=0), axis=1).mean()
        squares.append((off**2).mean() / distance**2)
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")


def _halves(xyz: FloatArray, centres: FloatArray) -> Iterator[BoolArray]:
    """Yield masks of the points in the first half: stripes, a checkerboard, and near points."""
    middle = np.median(xyz, axis=0)
    axes = np.linalg.svd(xyz - middle, full_matrices=False)[2]
    across = (xyz - middle) @ axes[:2].T
    rank = np.argsort(np.argsort(across, axis=0), axis=0) / len(xyz)  # stripes of as many points each
    stripe = np.floor(rank * STRIPES)
    yield stripe[:, 0] % 2 == 0
    yield stripe.sum(axis=1) % 2 == 0
    depth = xyz @ (middle - np.nanmean(centres, axis=0))
    yield depth < np.median(depth)
