"""What explains large residuals: the cause that was put into a network is the one that is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.network import Estimate, Network
from sfm.survey.diagnosis.explanations import explain_residuals
from tests.survey.test_own_camera import with_zoom
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
        "two cameras or zooms under one name: image 1, image 2, image 3, image 4 with"
    )
    assert first.explains and first.after_px == pytest.approx(0.1, rel=0.1)
    assert len(others) >= 2


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
    from sfm.camera import project

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
