"""What explains large residuals: the cause that was put into a network is the one that is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.camera import project
from sfm.network import Estimate, Network
from sfm.pipeline import run_survey
from sfm.report.findings.findings import findings_of
from sfm.result import Explanation
from sfm.survey.diagnosis import explanations
from sfm.survey.diagnosis.explanations import explain_residuals
from sfm.survey.diagnosis.two_groups import TwoGroups, two_groups
from tests.survey.test_own_camera import TAU, with_zoom
from tests.surveys import survey_of
from tests.synthetic import make_network, perturb, seed_of


def adjusted(network: Network, truth: Estimate, free: tuple[str, ...]) -> Adjustment:
    cameras = tuple(
        replace(one, free=np.array([name in free for name in one.names])) for one in truth.cameras
    )
    start = perturb(
        replace(truth, cameras=cameras), seed_of("start"), position=0.002, angle_deg=0.1, points=0.002
    )
    return adjust(network, start, datum=Datum("free"), reject="tau")


def test_nothing_is_looked_for_where_all_is_well() -> None:
    network, truth = make_network(seed_of("well"), images=10, points=40)
    assert explain_residuals(adjusted(network, truth, ("c",))) == ()


def test_two_zooms_under_one_name() -> None:
    network, truth = with_zoom("two zooms", dict.fromkeys(range(4), 1.05))
    first, *others = explain_residuals(adjusted(network, truth, ("c",)))
    assert first.cause.startswith(
        "two cameras, zooms or states of the lens under one name: image 1, image 2, image 3, image 4 with c"
    )
    assert first.explains and first.after_px == pytest.approx(0.1, rel=0.1)
    assert len(others) >= 2


def test_a_sample_of_the_points_of_a_large_network_tells_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Photographs of few image points keep all of them."""
    network, truth = with_zoom("large", dict.fromkeys(range(4), 1.05))
    found, counted = adjusted(network, truth, ("c",)), []
    whole = explain_residuals(found)[0]
    monkeypatch.setattr(explanations, "LARGE", 150)
    monkeypatch.setattr(explanations, "FEW", 10)

    def groups(part: Network, estimate: Estimate) -> TwoGroups | None:
        counted.append(np.bincount(part.image_points.image))
        return two_groups(part, estimate)

    monkeypatch.setattr(explanations, "two_groups", groups)
    first = explain_residuals(found)[0]
    assert first.cause.partition(" with c")[0] == whole.cause.partition(" with c")[0]
    assert first.after_px == pytest.approx(whole.after_px, rel=0.1)
    assert counted[0].min() >= 10 and counted[0].sum() < 0.6 * len(network.image_points)


def test_a_distortion_that_is_held() -> None:
    network, truth = make_network(seed_of("held lens"), images=10, points=60)
    bare = truth.cameras[0].parameters.copy()
    bare[3:] = 0.0  # all but c, x0, y0
    held = replace(truth, cameras=(truth.cameras[0].with_parameters(bare),))
    first = explain_residuals(adjusted(network, held, ("c",)))[0]
    assert first.cause.startswith("the camera, with free x0, y0, K1") and first.explains
    assert first.after_px == pytest.approx(0.1, rel=0.1)


def test_half_of_the_object_moved() -> None:
    """Half of the points lie 20 mm away in the last four photographs."""
    network, truth = with_zoom("half moved", {})
    seen, rng = network.image_points, seed_of("half moved noise")
    moved, xy = truth.points.copy(), seen.xy.copy()
    moved[:30] += [0.02, 0.01, 0.0]
    for i in range(6, 10):
        rows = np.flatnonzero(seen.image == i)
        xy[rows] = project(truth.cameras[0], truth.position[i], truth.rotation[i], moved[seen.point[rows]])
        xy[rows] += 0.1 * rng.standard_normal((len(rows), 2))
    network = replace(network, image_points=replace(seen, xy=xy))
    first = explain_residuals(adjusted(network, truth, ("c",)))[0]
    assert first.cause.startswith("two states of the object, one up to image 6 and one from image 7 on")
    assert first.explains and first.after_px == pytest.approx(0.1, rel=0.1)


def test_two_cameras_of_nearly_the_same_c_are_told_apart() -> None:
    """c 0.3 % and the principal point 15 px apart, far below a cautious sigma_px."""
    network, truth = make_network(seed_of("two bodies"), images=8, points=60, free=("c", "x0", "y0"))
    seen, rng, camera = network.image_points, seed_of("two bodies noise"), truth.cameras[0]
    other = camera.parameters.copy()
    other[0] *= 1.003
    other[2] += 15 * camera.pixel_mm[1]
    xy = seen.xy.copy()
    for i in (1, 4, 6):
        rows = np.flatnonzero(seen.image == i)
        points = truth.points[seen.point[rows]]
        xy[rows] = project(camera.with_parameters(other), truth.position[i], truth.rotation[i], points)
        xy[rows] += 0.1 * rng.standard_normal((len(rows), 2))
    cautious = replace(network, image_points=replace(seen, xy=xy, covariance=100 * seen.covariance))
    found = adjusted(cautious, truth, ("c", "x0", "y0"))
    assert found.sigma0 < 1
    first = explain_residuals(found)[0]
    assert "under one name: image 2, image 5, image 7 with c +0.3" in first.cause
    assert first.explains and first.after_px == pytest.approx(0.1, rel=0.1) and first.moved < 1


def test_photographs_of_one_camera_are_alike() -> None:
    for k in range(8):
        rng = seed_of(f"alike {k}")
        network, truth = make_network(rng, images=int(rng.integers(4, 20)), points=40, planar=bool(k % 2))
        assert two_groups(network, adjusted(network, truth, ("c", "x0", "y0", "K1")).estimate) is None


def test_photographs_of_few_points_have_no_vote() -> None:
    network, truth = make_network(seed_of("few points"), images=4, points=7)
    assert two_groups(network, truth) is None


def test_a_pair_with_a_camera_at_wrong_start_values_is_bad() -> None:
    """Most of the error of c and K1 goes into the depth: sigma0 2.6 alone says only that it was too small."""
    network, truth = make_network(seed_of("wrong pair"), images=2, points=40, free=("c", "K1"))
    camera = truth.cameras[0]
    p = camera.parameters.copy()
    p[0] *= 1.02
    p[camera.names.index("K1")] = 0.0
    wrong = replace(truth, cameras=(replace(camera.with_parameters(p), free=camera.free),))
    result = run_survey(survey_of(network, wrong, adjust=TAU))
    verdict = findings_of(result).verdict
    assert result.explanations[0].cause.startswith("another camera, near the values")
    assert result.explanations[0].explains and result.explanations[0].moved > 5
    assert verdict.level == "bad"


def test_a_pair_with_a_right_camera_needs_no_explanation() -> None:
    network, truth = make_network(seed_of("right pair"), images=2, points=40, free=("c", "K1"))
    result = run_survey(survey_of(network, truth, adjust=TAU))
    assert result.explanations == () and findings_of(result).verdict.level != "bad"


def test_what_is_significant_takes_away_some_of_the_residuals() -> None:
    """4000 points of a rendered texture had two cameras: sigma0 0.0321 px with one and with two."""
    found = Explanation("two cameras", 0.0321, 0.03205, moved=2.0, significant=True)
    assert not found.explains
    assert replace(found, after_px=0.0315).explains
    assert not replace(found, after_px=0.0315, significant=False).explains
