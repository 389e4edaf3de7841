"""Correlations of camera parameters with exterior orientation: known cases, and the inverse of the whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.correlations import _correlations, orientation_correlations
from sfm.adjustment.quality.variance_components import estimate_common_part
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import FloatArray, rotation_from_angles
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ObjectPoints
from sfm.report.pages import WIDTH, html_of
from sfm.report.survey_report import text_report
from sfm.report.tables.summary import summary
from tests.findings import findings_of
from tests.synthetic import PIXEL_MM, SIZE_PX, make_network, seed_of

HEIGHT = 10.0


def strip(
    name: str, *, relief: float, free: tuple[str, ...], turned: bool = False
) -> tuple[Network, Estimate]:
    """Return six near-nadir photographs of a field of points, all of the same height above it."""
    rng = seed_of(name)
    camera = camera_from_values("nadir", "brown", SIZE_PX, PIXEL_MM, c_mm=10.0, free=free)
    x, y = np.meshgrid(np.linspace(-1.6, 1.6, 9), np.linspace(-1.2, 1.2, 6))
    X = np.stack([x.ravel(), y.ravel(), relief * rng.uniform(-1, 1, x.size)], axis=1)
    position = np.array([[a, b, HEIGHT] for b in (-0.8, 0.8) for a in (-1.2, 0.0, 1.2)])
    tilt = rng.uniform(-0.01, 0.01, (6, 3))
    kappa = np.pi / 2 * np.arange(6) if turned else np.zeros(6)
    rotation = np.stack([rotation_from_angles(*(tilt[i] + [0, 0, kappa[i]])) for i in range(6)])
    image, point, xy = [], [], []
    for i in range(6):
        seen = project(camera, position[i], rotation[i], X)
        inside = np.flatnonzero((seen > 0).all(1) & (seen < SIZE_PX).all(1))
        image.append(np.full(len(inside), i))
        point.append(inside)
        xy.append(seen[inside] + 0.1 * rng.standard_normal((len(inside), 2)))
    rows = np.concatenate(xy)
    points = ImagePoints(
        np.concatenate(image), np.concatenate(point), rows, np.tile(0.01 * np.eye(2), (len(rows), 1, 1))
    )
    names = tuple(f"p{j}" for j in range(len(X)))
    network = Network(tuple("ABCDEF"), np.zeros(6, dtype=np.int64), names, points)
    return network, Estimate((camera,), position, rotation, X)


def controlled(network: Network, truth: Estimate) -> Network:
    """Return the network with its four corner points known to 1 mm."""
    corners = np.array([0, 8, 45, 53])
    return network.with_given(
        ObjectPoints(corners, truth.points[corners], np.tile(1e-6 * np.eye(3), (4, 1, 1)))
    )


def test_c_is_strongly_correlated_with_the_height_in_a_flat_parallel_network() -> None:
    network, truth = strip("flat", relief=0.2, free=("c",))
    a = adjust(controlled(network, truth), truth, datum=Datum("control"), reject="none")
    (found,) = orientation_correlations(a)
    assert found.parameter == "c of camera nadir"
    assert found.part == "Z0" and found.largest > 0.99
    assert dict(found.counts)["Z0"] == 6
    assert "Z0 of 6 photographs" in found.partners


def test_convergent_photographs_tell_c_from_the_height() -> None:
    network, truth = make_network(seed_of("convergent"), images=8, points=40, planar=True, free=("c",))
    convergent = adjust(network, truth, datum=Datum("free"), reject="none")
    flat, start = strip("flat", relief=0.2, free=("c",))
    parallel = adjust(flat, start, datum=Datum("free"), reject="none")
    own = [
        1 - np.median(_correlations(a)[1][:, 2, 0] ** 2) for a in (parallel, convergent)
    ]  # of c's variance
    assert own[0] < 1e-3 and own[1] > 0.1


def test_turned_photographs_tell_the_principal_point_from_the_orientation() -> None:
    def strong(turned: bool) -> set[str]:
        network, truth = strip("turned", relief=0.2, free=("x0", "y0"), turned=turned)
        a = adjust(controlled(network, truth), truth, datum=Datum("control"), reject="none")
        return {one.parameter for one in orientation_correlations(a)}

    assert strong(False) == {"x0 of camera nadir", "y0 of camera nadir"}
    assert strong(True) == set()


@pytest.mark.parametrize("datum", ["free", "minimal"])
@pytest.mark.parametrize("far", [0.0, 1e5])
def test_they_are_those_of_the_joint_covariance(datum: str, far: float) -> None:
    network, truth = make_network(seed_of("joint"), images=6, points=30, cameras=2, planar=True)
    a = adjust(network, truth, datum=Datum(datum), reject="none")
    names, rho = _correlations(moved(a, far))
    m = marginal_of(a)
    interior = [k for k, (_, owner) in enumerate(m.names()) if owner.startswith("camera")]
    assert names == [m.names()[k] for k in interior]
    for i in range(6):
        joint = m.joint(np.array([*range(6 * i, 6 * i + 3), *interior]), np.zeros(0, dtype=np.int64))
        np.testing.assert_allclose(rho[i, :3], correlation(joint)[:3, 3:], atol=1e-6)
    assert np.abs(rho).max() > 0.5


def moved(a: Adjustment, by: float) -> Adjustment:
    """Return an adjustment far from the origin."""
    X, X0 = a.estimate.points + by, a.estimate.position + by
    return replace(a, estimate=replace(a.estimate, points=X, position=X0))


def correlation(Q: FloatArray) -> FloatArray:
    sigma = np.sqrt(np.diagonal(Q))
    return np.asarray(Q / np.where(sigma > 0, sigma, 1)[:, None] / np.where(sigma > 0, sigma, 1))


def test_a_calibrated_camera_has_none() -> None:
    network, truth = strip("calibrated", relief=0.2, free=())
    a = adjust(network, truth, datum=Datum("free"), reject="none")
    assert orientation_correlations(a) == ()


def test_they_stand_in_all_reports_in_one_line_each() -> None:
    network, truth = strip("flat", relief=0.2, free=("c", "x0", "y0"))
    a = adjust(controlled(network, truth), truth, datum=Datum("control"), reject="none")
    found = orientation_correlations(a)
    result = SurveyResult("s", "m", 6, (), a, np.full(54, -1), None, orientation_correlations=found)
    text, page = text_report(findings_of(result)), html_of(findings_of(result))
    assert all(len(line) <= WIDTH for line in text.splitlines())
    told = summary(findings_of(result))["statistics"]["orientation_correlations"]
    assert [row["parameter"] for row in told] == [one.parameter for one in found]
    assert told[0]["value"] == found[0].largest
    words = " ".join(text.split())
    for one in found:
        assert (
            one.parameter in page
            and one.partners in page
            and one.parameter in words
            and one.partners in words
        )


@pytest.mark.parametrize(("factor", "common_px"), [(1.0, 0.05), (3.0, 0.05), (2.0, 0.0), (0.0, 0.1)])
def test_factor_and_common_part_are_found(factor: float, common_px: float) -> None:
    """Within three standard deviations of what 2,000 image points can tell."""
    rng = seed_of(f"common part {factor} {common_px}")
    network, truth = make_network(seed_of("common part"), images=12, points=180, free=("c",), noise_px=0.0)
    seen = network.image_points
    sigma = 0.02 * 10.0 ** rng.random(len(seen))
    noise = np.sqrt((factor * sigma) ** 2 + common_px**2)[:, None] * rng.standard_normal((len(seen), 2))
    network = replace(network, image_points=replace(seen, xy=seen.xy + noise))

    def adjust_with(covariance: FloatArray) -> Adjustment:
        return adjust(
            replace(network, image_points=replace(network.image_points, covariance=covariance)),
            truth,
            reject="none",
        )

    found = estimate_common_part(adjust_with, sigma[:, None, None] ** 2 * np.eye(2), 0.1)
    assert found[0] == pytest.approx(factor, abs=0.15 if factor else 0.3)
    assert found[1] == pytest.approx(common_px, abs=0.01)
