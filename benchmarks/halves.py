"""Tests the covariance of a result: do adjustments of two halves of its object points agree as predicted?

    python -m benchmarks.halves build/fountain/result
    python -m benchmarks.halves build/fountain/result build/fountain/colmap --ways checker stripes --draws 4

Object points are halved in four ways: at random, as a checkerboard over the object, in stripes over the
object, and into near and far points. Each way is drawn several times: with other random numbers, with rotated
and shifted boards and stripes, and with near and far as other photographs see them. Neighbouring points share
errors that are smooth over a photograph. Random halves have these errors in common; the other halves do not.

Each half of the accepted image points is adjusted again with the free parameters of the result. The
projection centres of both halves are compared after a similarity. The predicted difference takes into account
the correlation of errors that the residuals of the whole result show, also between the halves.

Points are tested by halving their rays: each point is intersected twice, from alternate photographs, with the
orientation of the whole result.

The ratio is the root mean square, over the draws, of the difference over the predicted difference. A ratio of
1 means that the standard deviations are right. Draws of one way have image points and a few decisive
directions in common; the standard deviation of the ratio is for all draws together.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import sfm
from benchmarks.textured import onto_centres
from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.engine.correlated import correlated_sum
from sfm.adjustment.quality.correlations import estimate_error_correlation
from sfm.adjustment.result import Adjustment, ErrorCorrelation
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network, without_given
from sfm.model.reduced_network import reduce_network
from sfm.model.similarity import fit_similarity
from sfm.orientation.image_rays import image_tangents
from sfm.orientation.intersection import intersect

WAYS = ("random", "checker", "stripes", "near-far")
STEPS = np.eye(2)  # px
DRAWS = 8  # pairs of halves for each way
CELLS = 8  # cells of the checkerboard along the longer side of the object
STRIPES = 4
MIN_RAYS = 2  # fewest rays of a point in each half
HEAD = "result            way        points       ppm  predicted   ratio  sigma"


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("results", type=Path, nargs="+", help="result folders or COLMAP models")
    parser.add_argument("--ways", nargs="+", default=WAYS, choices=WAYS)
    parser.add_argument("--draws", type=int, default=DRAWS, help="pairs of halves for each way")
    parser.add_argument("--equal", action="store_true", help="weight all image points alike")
    arguments = parser.parse_args()
    print(HEAD)
    for path in arguments.results:
        stored = sfm.read_result(path)
        network, estimate = without_given(stored.network), stored.estimate
        if arguments.equal or not np.isfinite(network.image_points.covariance).all():
            seen = network.image_points
            alike = np.tile(0.01 * np.eye(2), (len(seen), 1, 1))
            network = replace(network, image_points=replace(seen, covariance=alike))
        whole = adjust(network, estimate, reject="none", options=AdjustmentOptions(redundancy_numbers=False))
        correlation = estimate_error_correlation(whole)
        if correlation is not None:
            s_px = whole.sigma0_px * correlation.common**0.5
            print(f"{path.name[-17:]:<18}common to neighbours {s_px:.3f} px, falls to 1/e in ", end="")
            print(f"{correlation.length_px:.0f} px; each image point alone ", end="")
            print(f"{whole.sigma0_px * correlation.alone**0.5:.3f} px")
        for way in arguments.ways:
            _print(path.name, way, *_of_centres(whole, correlation, way, arguments.draws))
        _print(path.name, "rays", *_of_points(network, estimate, whole.sigma0))


def _print(
    name: str,
    way: str,
    points: int,
    deviation: float,
    predicted: float,
    ratio: float,
    sigma: float | None = None,
) -> None:
    """Print one row of the table."""
    row = f"{name[-17:]:<18}{way:<10}{points:>7}{1e6 * deviation:>10.1f}{1e6 * predicted:>11.1f}"
    print(f"{row}{ratio:>8.2f}{'' if sigma is None else f'{sigma:>7.2f}'}", flush=True)


def _of_centres(
    whole: Adjustment, correlation: ErrorCorrelation | None, way: str, draws: int
) -> tuple[int, float, float, float, float]:
    """Return number of points, RMS difference of the centres, predicted difference, ratio and its sigma.

    Differences are relative to the mean distance of the centres from the middle of the object. All draws have
    the same weight in the ratio.
    """
    network, estimate, seen = whole.network, whole.estimate, whole.network.image_points
    m = len(network.images)
    measured, of_draws = np.zeros(draws), np.zeros((draws, len(seen), 2, 3 * m))
    for n, half in enumerate(_halves(estimate.points, estimate.position, way, draws)):
        half_result, other = (_adjusted(network, estimate, points) for points in (half, ~half))
        a, b = half_result.estimate, other.estimate
        placed = fit_similarity(b.position, a.position)
        scale = np.linalg.norm(a.position - np.nanmean(a.points, axis=0), axis=1).mean()
        turned = placed.scale * np.kron(np.eye(m), placed.rotation.T)
        of_draws[n, half[seen.point]] = _influence(half_result) / scale
        of_draws[n, ~half[seen.point]] = -_influence(other) @ turned / scale
        measured[n] = ((placed.apply(b.position) - a.position) ** 2).sum() / scale**2
    Z = np.moveaxis(of_draws, 0, 2).reshape(len(seen), 2, -1)
    covariance = np.tensordot(Z, Z, axes=((0, 1), (0, 1)))
    if correlation is not None:
        relative = whole.usual_px * np.linalg.inv(np.linalg.cholesky(seen.covariance))
        covariance += correlated_sum(seen.image, seen.xy, relative, Z, correlation, network.may_correlate)
    predicted = np.diagonal(covariance).reshape(draws, -1).sum(axis=1)
    size = np.repeat(np.sqrt(predicted), 3 * m)
    sigma = np.sqrt(((covariance / np.outer(size, size)) ** 2).sum() / 2) / draws  # of a root near 1
    rms, expected = (float(np.sqrt(square.mean() / m)) for square in (measured, predicted))
    return len(network.points), rms, expected, float(np.sqrt((measured / predicted).mean())), float(sigma)


def _influence(adjustment: Adjustment) -> FloatArray:
    """Return the derivatives of the centres by standardised errors, datum on the centres, (k, 2, 3 m)."""
    marginal, m = marginal_of(adjustment, cross=False), len(adjustment.estimate.position)
    Z = marginal.influence.of(np.arange(6 * m), np.zeros(0, dtype=np.int64)) @ onto_centres(adjustment).T
    Z = Z.reshape(len(Z), 2, m, 6)[..., :3].reshape(len(Z), 2, 3 * m)
    return np.asarray(adjustment.sigma0 * Z[np.argsort(marginal.layout.order)])


def _adjusted(network: Network, estimate: Estimate, points: BoolArray) -> Adjustment:
    """Return the adjustment of some of the points and all photographs."""
    everything = np.ones(len(network.image_points), dtype=bool)
    images = np.ones(len(network.images), dtype=bool)
    part, start = reduce_network(network, estimate, images, points, everything)
    return adjust(part, start, reject="none", options=AdjustmentOptions(redundancy_numbers=False))


def _halves(xyz: FloatArray, centres: FloatArray, way: str, draws: int) -> Iterator[BoolArray]:
    """Yield masks of the points in the first half."""
    rng = np.random.default_rng(0)
    middle = np.median(xyz, axis=0)
    axes = np.linalg.svd(xyz - middle, full_matrices=False)[2]
    across = (xyz - middle) @ axes[:2].T
    extent = np.quantile(np.abs(across), 0.99, axis=0).max() * 2
    depth = xyz @ (middle - centres).T
    for n in range(draws):
        turn, shift = (rng.uniform(0.0, np.pi), rng.random(2)) if n else (0.0, np.zeros(2))
        at = across @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        if way == "random":
            yield rng.random(len(xyz)) < 0.5
        elif way == "checker":
            yield np.floor(at * CELLS / extent + shift).sum(axis=1) % 2 == 0
        elif way == "stripes":  # with the same number of points each
            rank = np.argsort(np.argsort(at[:, 0])) / len(at)
            yield np.floor(rank * STRIPES + shift[0]) % 2 == 0
        else:
            away = depth[:, rng.integers(len(centres))] if n else depth.mean(axis=1)
            yield away < np.median(away)


def _of_points(network: Network, estimate: Estimate, sigma0: float) -> tuple[int, float, float, float]:
    """Return the same figures, without sigma, for points intersected from alternate rays."""
    seen = network.image_points
    rank = np.zeros(len(seen), dtype=np.int64)
    order = np.lexsort([seen.image, seen.point])
    first = np.searchsorted(seen.point[order], np.arange(len(network.points)))
    rank[order] = np.arange(len(seen)) - first[seen.point[order]]
    uv = image_tangents(seen, network.camera, estimate.cameras)
    slope = [
        image_tangents(replace(seen, xy=seen.xy + step), network.camera, estimate.cameras) - uv
        for step in STEPS
    ]
    J = np.stack(slope, axis=2)  # d (tangents) / d (px)
    weights = np.linalg.inv(J @ seen.covariance @ J.transpose(0, 2, 1))
    several = network.rays() >= 2 * MIN_RAYS
    points_of_halves = []
    for part in (0, 1):
        rays = several[seen.point] & (rank % 2 == part)
        met = intersect(
            uv[rays], seen.image[rays], seen.point[rays], estimate.position, estimate.rotation,
            n_points=len(network.points), weights=weights[rays],
        )  # fmt: skip
        points_of_halves.append((met.points[several], met.cofactors[several]))
    (a, of_a), (b, of_b) = points_of_halves
    scale = np.linalg.norm(estimate.position[:, None] - np.nanmean(a, axis=0), axis=2).mean()
    trace = np.einsum("nii->n", of_a + of_b)
    usual = trace < np.quantile(trace, 0.99)  # a few points, uncertain along their rays, would dominate
    square = ((a - b) ** 2).sum(axis=1)[usual].mean()
    predicted = sigma0**2 * trace[usual].mean()
    rms, expected = (float(np.sqrt(mean_square) / scale) for mean_square in (square, predicted))
    return int(usual.sum()), rms, expected, rms / expected


if __name__ == "__main__":
    main()
