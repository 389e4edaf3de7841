"""Photographs along their optical axes: small angles, which are hundreds of times what rays are known to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.model.camera import Camera, project
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, empty_estimate
from sfm.model.similarity import fit_similarity, reverse_depth
from sfm.orientation.incremental import growth as growing
from sfm.orientation.incremental.growth import Growth
from sfm.orientation.incremental.poor_photographs import casts_doubt
from sfm.orientation.incremental.sequence import START_TOLERANCE, orient
from sfm.orientation.incremental.starting_pair import MIN_MEDIAN_ANGLE_DEG, Start
from tests.synthetic import make_network, seed_of

NOISE_PX = 0.1
C_FACTOR = 1.33  # of the start value, as a draft assumes it


def street(name: str, count: int = 8) -> tuple[Network, Estimate]:
    """Return photographs that follow one another between two rows of houses, and their truth."""
    rng = seed_of(name)
    network, truth = make_network(rng, images=count, points=240, noise_px=NOISE_PX)
    along = rng.uniform(-36, -8, 240)
    left, right, ground, end = np.array_split(np.arange(240), 4)
    points = np.column_stack([rng.uniform(-5, 5, 240), rng.uniform(-1.7, 4, 240), along])
    points[left, 0], points[right, 0], points[ground, 1], points[end, 2] = -5.0, 5.0, -1.7, -42.0
    position = np.column_stack(
        [rng.uniform(-0.3, 0.3, count), rng.uniform(-0.1, 0.1, count), -1.2 * np.arange(count)]
    )
    truth = replace(truth, position=position, rotation=np.tile(np.eye(3), (count, 1, 1)), points=points)
    rows = []
    for i in range(count):
        xy = project(truth.cameras[0], position[i], np.eye(3), points)
        inside = np.isfinite(xy).all(1) & (xy > 0).all(1) & (xy < truth.cameras[0].size_px).all(1)
        rows += [(i, j, *(xy[j] + NOISE_PX * rng.standard_normal(2))) for j in np.flatnonzero(inside)]
    image, point, *xy = np.array(rows).T
    covariance = np.tile(NOISE_PX**2 * np.eye(2), (len(image), 1, 1))
    measured = ImagePoints(image.astype(int), point.astype(int), np.stack(xy, axis=1), covariance)
    return replace(network, image_points=measured), truth


def drafted(truth: Estimate) -> Camera:
    """Return the camera with another c and no distortion."""
    camera = truth.cameras[0]
    parameters = np.zeros_like(camera.parameters)
    parameters[0] = C_FACTOR * camera.parameters[0]
    return camera.with_parameters(parameters)


@pytest.mark.parametrize("number", [0, 2, 3])
def test_the_first_solution_of_a_street_is_the_true_one(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was a plane within the tolerance of the start, from which c ran to ten times itself."""
    network, truth = street(f"along the axis {number}")
    starts: list[Start] = []
    steps = []

    def counted(*args: object, real: object = growing.best_start, **options: object) -> Start:
        starts.append(real(*args, **options))  # type: ignore[operator]
        return starts[-1]

    def refine(part: Network, estimate: Estimate) -> Estimate:
        a = adjust(part, estimate, datum=Datum("free"), reject="none", covariance=False)
        steps.append(a.iterations)
        return a.estimate

    monkeypatch.setattr(growing, "best_start", counted)
    result = orient(network, empty_estimate(network, (drafted(truth),)), refine=refine)
    start = starts[0]
    assert start.kind == "spatial" and start.pair is not None
    base = start.position[start.pair[1]]
    assert abs(base[2]) > np.cos(np.radians(20)) * np.linalg.norm(base)
    assert _median_angle(truth, network, start.pair) < np.radians(MIN_MEDIAN_ANGLE_DEG)
    assert len(starts) == 1 and sum(steps) < 200
    assert result.failures == () and result.rms_px < 2 * NOISE_PX
    placed = fit_similarity(result.estimate.position, truth.position).apply(result.estimate.position)
    assert np.linalg.norm(placed - truth.position, axis=1).max() < 0.15  # of 8.4


def _median_angle(truth: Estimate, network: Network, pair: tuple[int, int]) -> float:
    seen = network.image_points
    common = np.intersect1d(*(seen.point[seen.image == i] for i in pair))
    rays = [truth.points[common] - truth.position[i] for i in pair]
    first, second = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    return float(np.median(np.arccos(np.clip((first * second).sum(axis=1), -1, 1))))


@pytest.mark.parametrize("turned_back", [False, True])
def test_a_reversal_that_turns_back_casts_no_doubt(turned_back: bool) -> None:
    """Both fit equally well; only the one whose depths are reversed may be the true one."""
    network, truth = make_network(seed_of("turned back"), images=6, points=40)
    tolerance_px = np.array([START_TOLERANCE * np.hypot(*truth.cameras[0].size_px)])
    solution = Growth(network, truth, 0, tolerance_px, 4)
    other = truth if turned_back else reverse_depth(truth)
    reversal = Growth(network, other, 0, tolerance_px, 4)
    reversal.residuals_px = solution.residuals_px  # type: ignore[method-assign]
    assert casts_doubt(solution, reversal) == (not turned_back)
