"""Statistics of `brown`: sigma0 is chi-square distributed, b1 unbiased, w as wide at the edge as inside.

Five networks with a lens whose corrections shrink or stretch the edge of the photograph by up to a tenth,
where residuals in the corrected plane (`brown_dbat`) are too small or too large by as much.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.similarity import fit_similarity
from tests.synthetic import make_network, seed_of

SIZE_PX = (2000, 1500)
SIGMA_PX = 0.3
BARREL = (("x0", 0.03), ("y0", -0.02), ("K1", 1.2e-3), ("K2", -4e-6), ("P1", 3e-5), ("b1", 2e-4))
PINCUSHION = (("x0", -0.03), ("y0", 0.05), ("K1", -8e-4), ("K2", -2e-6), ("P2", 5e-5), ("b1", 2e-4))
LENS = ("c", "x0", "y0", "K1", "K2", "P1", "P2", "b1", "b2")
NETWORKS = {  # name: kind of network, lens, free parameters
    "ball, barrel": ("ball", BARREL, LENS),
    "ball, pincushion": ("ball", PINCUSHION, LENS),
    "dome, barrel": ("dome", BARREL, LENS),
    "dome, pincushion": ("dome", PINCUSHION, LENS),
    "plane from the front, unrolled": ("front", (("b1", 2e-4),), ("b1", "b2")),
}


@dataclass(frozen=True)
class Copies:
    """What noisy copies of a network gave."""

    vPv: FloatArray  # (s,)
    redundancy: int
    b1: FloatArray  # error over standard deviation, (s,)
    edge: float  # root mean square of w in the outer fifth of the photograph
    points: float  # root mean square of coordinate errors over standard deviation


def exact_network(
    kind: str, lens: tuple[tuple[str, float], ...], free: tuple[str, ...], model: str
) -> tuple[Network, Estimate]:
    """Return a network without noise and its truth; distances in m."""
    rng = seed_of(f"plane of residuals {kind}")
    if kind == "front":  # three photographs side by side over two, upright, in one plane before it
        x, y = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-0.7, 0.7, 7))
        points = np.stack([x.ravel(), y.ravel(), rng.normal(0, 0.1, x.size)], axis=1)
        base = np.array([[a, b, 3.0] for a in (-0.4, 0.0, 0.4) for b in (-0.25, 0.25)])
        position = base + rng.normal(0, 0.02, base.shape)
        rotation = rotation_from_vector(rng.normal(0, 0.06, base.shape) * (1, 1, 0.05))
    else:
        _, truth = make_network(rng, images=10, points=60, planar=kind == "dome", noise_px=0.0)
        position, rotation, points = truth.position * 0.55, truth.rotation, truth.points
    camera = camera_from_values("A", model, SIZE_PX, (0.005, 0.005), c_mm=10.0, free=free, values=lens)
    rows = []
    for i in range(len(position)):
        xy = project(camera, position[i], rotation[i], points)
        j = np.flatnonzero(np.isfinite(xy).all(1) & (xy > 0).all(1) & (xy < np.array(SIZE_PX) - 1).all(1))
        rows.append((np.full(len(j), i), j, xy[j]))
    image, point, xy = (np.concatenate(part) for part in zip(*rows, strict=True))
    covariance = np.tile(SIGMA_PX**2 * np.eye(2), (len(xy), 1, 1))
    network = Network(
        tuple(f"image {i}" for i in range(len(position))),
        np.zeros(len(position), dtype=np.int64),
        tuple(f"{j}" for j in range(len(points))),
        ImagePoints(image, point, xy, covariance),
    )
    return network, Estimate((camera,), position, rotation, points)


def copies_of(name: str, count: int, *, model: str = "brown") -> Copies:
    """Return the statistics of noisy copies; the lens is that of `brown` in either model."""
    network, truth = exact_network(*NETWORKS[name], model)
    rng = seed_of(f"noise {name}")
    seen = network.image_points
    side = np.abs(seen.xy - (np.array(SIZE_PX) - 1) / 2) / (np.array(SIZE_PX) / 2)
    edge = side.max(axis=1) > 0.8
    b1 = truth.cameras[0].names.index("b1")
    k = int(truth.cameras[0].free[:b1].sum())
    vPv, errors, w, z, redundancy = [], [], [], [], 0
    for _ in range(count):
        noisy = replace(
            network, image_points=replace(seen, xy=seen.xy + rng.normal(0, SIGMA_PX, seen.xy.shape))
        )
        a = adjust(noisy, truth, datum=Datum("free"), reject="none")
        assert a.converged
        redundancy = a.redundancy
        vPv.append(a.vPv)
        sigma = np.sqrt(np.diagonal(a.covariance.interior[0])) / a.sigma0
        errors.append((a.estimate.cameras[0].parameters[b1] - truth.cameras[0].parameters[b1]) / sigma[k])
        w.append(a.standardised[edge].ravel())
        back = fit_similarity(a.estimate.points, truth.points).apply_estimate(a.estimate)
        points = np.sqrt(np.diagonal(a.covariance.points, axis1=1, axis2=2)) / a.sigma0
        z.append((back.points - truth.points) / points)
    root_mean_square = [float(np.sqrt((np.concatenate(values) ** 2).mean())) for values in (w, z)]
    return Copies(np.array(vPv), redundancy, np.array(errors), *root_mean_square)


def told(name: str, found: Copies, model: str) -> str:
    p = stats.kstest(found.vPv, stats.chi2(found.redundancy).cdf).pvalue
    sigma0 = np.sqrt(found.vPv.mean() / found.redundancy)
    return (
        f"{model} {name}: sigma0 {sigma0:.4f}, chi-square p {p:.3f}, b1 off by {found.b1.mean():+.2f} sigma "
        f"(+- {1 / np.sqrt(len(found.b1)):.2f}), w at the edge {found.edge:.3f}, points {found.points:.3f}"
    )


def is_true(found: Copies, *, edge: float) -> bool:
    """Whether sigma0 is chi-square distributed, b1 unbiased and w standard normal at the edge, by chance."""
    p = stats.kstest(found.vPv, stats.chi2(found.redundancy).cdf).pvalue
    return bool(
        p > 0.01
        and abs(found.b1.mean()) < 3.5 / np.sqrt(len(found.b1))
        and abs(found.edge - 1) < edge
        and abs(found.points - 1) < 0.05 + 1 / np.sqrt(len(found.b1))
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_brown_is_unbiased_on_five_networks(name: str) -> None:
    found = copies_of(name, 300)
    print(told(name, found, "brown"))
    assert is_true(found, edge=0.02)
    dbat = copies_of(name, 300, model="brown_dbat")
    print(told(name, dbat, "brown_dbat"))
    assert not is_true(dbat, edge=0.02)


@pytest.mark.parametrize("name", ["plane from the front, unrolled", "ball, pincushion"])
def test_brown_is_unbiased(name: str) -> None:
    found = copies_of(name, 30)
    print(told(name, found, "brown"))
    assert is_true(found, edge=0.03)


def test_affinity_of_a_plane_from_the_front_is_not_shrunk() -> None:
    """With residuals in the corrected plane a smaller b1 makes all of them smaller, and nothing resists."""
    network, truth = exact_network(*NETWORKS["plane from the front, unrolled"], "brown")
    rng = seed_of("front")
    seen = network.image_points
    noisy = replace(network, image_points=replace(seen, xy=seen.xy + rng.normal(0, 1.5, seen.xy.shape)))
    found = {}
    for model in ("brown", "brown_dbat"):
        start = replace(truth, cameras=(replace(truth.cameras[0], model=model),))
        a = adjust(noisy, start, datum=Datum("free"), reject="none")
        sigma = float(np.sqrt(a.covariance.interior[0][0, 0]))
        found[model] = (a.estimate.cameras[0].value("b1") - 2e-4) / sigma
    print(found)
    assert abs(found["brown"]) < 3
    assert found["brown_dbat"] < -5
