"""Photographs that a camera took while it turned at one place: rotations alone fit, and no point has a depth.

An adjustment of such photographs has no minimum: it goes along a valley in which the base is as small as the
errors, takes wherever that ends for a solution, and with a wrong principal distance it even converges. The
parallax is what rotations leave between conjugate rays, with the principal distance and the first radial
distortion that make it least. A wall photographed from the front looks like a rotation with a lens without
end; where the least parallax is at the end of what is tried, nothing is refused.

Source: Hartley (1997), Self-calibration of stationary cameras, IJCV 22(1); Foerstner and Wrobel (2016),
Photogrammetric Computer Vision, sec. 13.3.6 (critical configurations).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import minimum_spanning_tree

from sfm.camera import Camera
from sfm.conventions import FloatArray, IntArray
from sfm.errors import GeometryError
from sfm.network import Network, rows_of
from sfm.orientation.homography import rays_of
from sfm.orientation.image_rays import image_tangents
from sfm.similarity import nearest_rotation

MIN_PARALLAX = 10.0  # standard deviations of image points, below which a depth is known to a tenth at best
# Part of the points of a pair that may have no depth, as distant hills behind a near object;
# a smaller rest may be wrong matches.
MAX_DISTANT_FRACTION = 0.9
MIN_COMMON = 20  # points of a pair of photographs: rotation and camera take five coordinates of them
SCALES = np.geomspace(0.5, 2.0, 15)  # of c that are tried, 10 % apart; the best is improved
TRIMMINGS = 3  # rotations without the half of the pairs of rays that fits worst
MAX_RADIAL = 0.2  # first radial distortion that is tried, of the squared tangent: that of telephones is
# a few hundredths
STEP = 0.02  # of it
EVALUATIONS = 80  # of the parallax by the simplex method of Nelder and Mead


def refuse_no_base(network: Network, cameras: tuple[Camera, ...]) -> None:
    """Refuse photographs whose conjugate rays fit rotations alone, but for gross errors.

    Args:
        network: image points with their standard deviations.
        cameras: start values.

    Raises:
        GeometryError: the parallax of every pair of photographs that hold the network together is below
            MIN_PARALLAX standard deviations of its image points.
    """
    pairs = _conjugate_points(network)
    if not pairs:
        return
    needed = MIN_PARALLAX * network.image_points.median_sigma_px
    parallax = _least_parallax(network, cameras, pairs)
    if parallax is None or not parallax.max() < needed:
        return
    raise GeometryError(
        f"orientation: no base: the {len(network.images)} photographs were taken from one place; rotations "
        f"alone fit {MAX_DISTANT_FRACTION:.0%} of their points to {np.median(parallax):.2g} px, and depths "
        f"need {needed:.2g} px; photograph from several places"
    )


def _conjugate_points(network: Network) -> list[tuple[IntArray, IntArray]]:
    """Return the image points, by twos, of the pairs of photographs with most in common that connect all."""
    seen, m = network.image_points, len(network.images)
    every = np.ones(len(seen), dtype=bool)
    found = [
        (i[common >= MIN_COMMON], j[common >= MIN_COMMON], common[common >= MIN_COMMON])
        for i, j, common in network.common_points(every)
    ]
    first, second, common = (np.concatenate(parts) for parts in zip(*found, strict=True))
    if not len(first):
        return []
    tree = minimum_spanning_tree(csr_matrix((1.0 / common, (first, second)), shape=(m, m))).tocoo()
    rows = rows_of(seen.image, m)
    pairs = []
    for i, j in zip(tree.row.tolist(), tree.col.tolist(), strict=True):
        _, a, b = np.intersect1d(seen.point[rows[i]], seen.point[rows[j]], return_indices=True)
        pairs.append((rows[i][a], rows[j][b]))
    return pairs


def _least_parallax(
    network: Network, cameras: tuple[Camera, ...], pairs: list[tuple[IntArray, IntArray]]
) -> FloatArray | None:
    """Return the parallax of each pair with c and radial distortion that make it least, px.

    None where these are at the end of what is tried.
    """
    seen = network.image_points
    given = image_tangents(seen, network.camera, cameras)
    c_px = np.array([one.c_px for one in cameras])[network.camera[seen.image]]

    def parallax(x: FloatArray) -> FloatArray:
        uv = given / np.exp(x[0])
        rays = rays_of(uv * (1 + x[1] * (uv**2).sum(axis=1, keepdims=True)))
        return np.array([c_px[a[0]] * np.exp(x[0]) * _parallax(rays[a], rays[b]) for a, b in pairs])

    def cost(x: FloatArray) -> float:
        if not (SCALES[0] <= np.exp(x[0]) <= SCALES[-1] and abs(x[1]) <= MAX_RADIAL):
            return np.inf
        return float(np.log(np.maximum(parallax(x), np.finfo(float).tiny)).mean())

    start = min((np.array([np.log(scale), 0.0]) for scale in SCALES), key=cost)
    simplex = start + np.array([[0.0, 0.0], [np.log(SCALES[1] / SCALES[0]), 0.0], [0.0, STEP]])
    options = {"initial_simplex": simplex, "maxfev": EVALUATIONS}
    best = minimize(cost, start, method="Nelder-Mead", options=options).x
    inside = SCALES[1] < np.exp(best[0]) < SCALES[-2] and abs(best[1]) < MAX_RADIAL - STEP
    return parallax(best) if inside else None


def _parallax(first: FloatArray, second: FloatArray) -> float:
    """Return the angle that most conjugate rays do not exceed after the rotation that fits most, rad.

    Args:
        first: rays of one photograph, (k, 3).
        second: those of the other, (k, 3).
    """
    known = np.isfinite(first + second).all(axis=1)  # of wide angles some have no ray
    if known.sum() < MIN_COMMON:
        return np.inf
    first = first[known] / np.linalg.norm(first[known], axis=1, keepdims=True)
    second = second[known] / np.linalg.norm(second[known], axis=1, keepdims=True)
    apart = np.zeros(len(first))
    for _ in range(TRIMMINGS):
        near = apart <= np.median(apart)
        R = nearest_rotation(second[near].T @ first[near])
        apart = np.linalg.norm(first @ R.T - second, axis=1)
    return float(np.quantile(apart, MAX_DISTANT_FRACTION))
