"""A result from either half of its object points: do the two agree as well as their covariances say?

    python -m benchmarks.halves build/fountain/result
    python -m benchmarks.halves build/fountain/result build/fountain/colmap --ways checker stripes --draws 4

Object points are halved in four ways: by chance, as a checkerboard and in stripes over the object, and into
near and far ones; each several times, with other chance, boards and stripes that are turned and shifted, and
near and far as other photographs see it. Neighbours share errors that are smooth over a photograph; by chance
both halves have them in common, in the other ways they do not. Each half of the accepted image points is
adjusted anew with what is free in the result, and the projection centres of both are compared after a
similarity. What is predicted for their difference has the correlation of errors that the residuals of the
whole show, between the halves, too. Points are halved by their rays: two intersections of each point from
alternate photographs with the orientation of the whole.

A ratio of 1 says that differences are what their standard deviations say: the root of the mean over the draws
of squared differences over what is predicted of each. Draws of one way have image points and few deciding
directions in common: the standard deviation of the ratio beside it is that of all draws together.
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
from sfm.adjustment.solve import adjust
from sfm.conventions import BoolArray, FloatArray
from sfm.network import Estimate, Network, without_given
from sfm.orientation.image_rays import image_tangents
from sfm.orientation.intersection import intersect
from sfm.reduced_network import reduce_network
from sfm.similarity import fit_similarity

WAYS = ("random", "checker", "stripes", "near-far")
STEPS = np.eye(2)  # px
DRAWS = 8  # of halves of each way
CELLS = 8  # of the checkerboard along the longer side of the object
STRIPES = 4
MIN_RAYS = 2  # of a point in each half of its rays
HEAD = "result            way        points       ppm  predicted   ratio  sigma"


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("results", type=Path, nargs="+", help="folders of results, or models of COLMAP")
    parser.add_argument("--ways", nargs="+", default=WAYS, choices=WAYS)
    parser.add_argument("--draws", type=int, default=DRAWS, help="pairs of halves of each way")
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
        whole = adjust(network, estimate, reject="none", redundancy_numbers=False)
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
    name: str, way: str, points: int, found: float, predicted: float, ratio: float, sigma: float | None = None
) -> None:
    """Print one row of the table."""
    row = f"{name[-17:]:<18}{way:<10}{points:>7}{1e6 * found:>10.1f}{1e6 * predicted:>11.1f}"
    print(f"{row}{ratio:>8.2f}{'' if sigma is None else f'{sigma:>7.2f}'}", flush=True)


def _of_centres(
    whole: Adjustment, correlation: ErrorCorrelation | None, way: str, draws: int
) -> tuple[int, float, float, float, float]:
    """Return number of points, RMS difference of the centres, what is predicted, the ratio and its sigma.

    Differences are relative to the mean distance of the centres from the middle of the object. The ratio
    takes all draws alike.
    """
    network, estimate, seen = whole.network, whole.estimate, whole.network.image_points
    m = len(network.images)
    found, of_draws = np.zeros(draws), np.zeros((draws, len(seen), 2, 3 * m))
    for n, half in enumerate(_halves(estimate.points, estimate.position, way, draws)):
        one, other = (_adjusted(network, estimate, points) for points in (half, ~half))
        a, b = one.estimate, other.estimate
        placed = fit_similarity(b.position, a.position)
        scale = np.linalg.norm(a.position - np.nanmean(a.points, axis=0), axis=1).mean()
        turned = placed.scale * np.kron(np.eye(m), placed.rotation.T)
        of_draws[n, half[seen.point]] = _influence(one) / scale
        of_draws[n, ~half[seen.point]] = -_influence(other) @ turned / scale
        found[n] = ((placed.apply(b.position) - a.position) ** 2).sum() / scale**2
    Z = np.moveaxis(of_draws, 0, 2).reshape(len(seen), 2, -1)
    covariance = np.tensordot(Z, Z, axes=((0, 1), (0, 1)))
    if correlation is not None:
        relative = whole.usual_px * np.linalg.inv(np.linalg.cholesky(seen.covariance))
        covariance += correlated_sum(seen.image, seen.xy, relative, Z, correlation)
    predicted = np.diagonal(covariance).reshape(draws, -1).sum(axis=1)
    size = np.repeat(np.sqrt(predicted), 3 * m)
    sigma = np.sqrt(((covariance / np.outer(size, size)) ** 2).sum() / 2) / draws  # of a root with mean 1
    rms, expected = (float(np.sqrt(one.mean() / m)) for one in (found, predicted))
    return len(network.points), rms, expected, float(np.sqrt((found / predicted).mean())), float(sigma)


def _influence(adjustment: Adjustment) -> FloatArray:
    """Return d centres / d errors of one standard deviation in the datum on the centres, (k, 2, 3 m)."""
    marginal, m = marginal_of(adjustment, cross=False), len(adjustment.estimate.position)
    Z = marginal.influence.of(np.arange(6 * m), np.zeros(0, dtype=np.int64)) @ onto_centres(adjustment).T
    Z = Z.reshape(len(Z), 2, m, 6)[..., :3].reshape(len(Z), 2, 3 * m)
    return np.asarray(adjustment.sigma0 * Z[np.argsort(marginal.layout.order)])


def _adjusted(network: Network, estimate: Estimate, points: BoolArray) -> Adjustment:
    """Return the adjustment of some of the points, all photographs in it."""
    everything = np.ones(len(network.image_points), dtype=bool)
    images = np.ones(len(network.images), dtype=bool)
    part, start = reduce_network(network, estimate, images, points, everything)
    return adjust(part, start, reject="none", redundancy_numbers=False)


def _halves(xyz: FloatArray, centres: FloatArray, way: str, draws: int) -> Iterator[BoolArray]:
    """Yield halves of points: which are in the first."""
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
        elif way == "stripes":  # of as many points each
            rank = np.argsort(np.argsort(at[:, 0])) / len(at)
            yield np.floor(rank * STRIPES + shift[0]) % 2 == 0
        else:
            away = depth[:, rng.integers(len(centres))] if n else depth.mean(axis=1)
            yield away < np.median(away)


def _of_points(network: Network, estimate: Estimate, sigma0: float) -> tuple[int, float, float, float]:
    """Return the same of points that are intersected from alternate rays, each with its covariance."""
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
    found = []
    for part in (0, 1):
        rays = several[seen.point] & (rank % 2 == part)
        met = intersect(
            uv[rays], seen.image[rays], seen.point[rays], estimate.position, estimate.rotation,
            n_points=len(network.points), weights=weights[rays],
        )  # fmt: skip
        found.append((met.points[several], met.cofactors[several]))
    (a, of_a), (b, of_b) = found
    scale = np.linalg.norm(estimate.position[:, None] - np.nanmean(a, axis=0), axis=2).mean()
    trace = np.einsum("nii->n", of_a + of_b)
    usual = trace < np.quantile(trace, 0.99)  # a few along their rays would decide it
    square = ((a - b) ** 2).sum(axis=1)[usual].mean()
    predicted = sigma0**2 * trace[usual].mean()
    rms, expected = (float(np.sqrt(one) / scale) for one in (square, predicted))
    return int(usual.sum()), rms, expected, rms / expected


if __name__ == "__main__":
    main()
