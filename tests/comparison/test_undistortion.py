"""Image points corrected for distortion: the same rays, and covariances that follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.camera import tangents_from_pixel
from sfm.comparison.camera_conversion import undistort
from sfm.distortion.models import GENERAL_MODELS
from sfm.errors import GeometryError
from tests.synthetic import make_network, seed_of


@pytest.mark.parametrize("model", ["brown", "full_opencv", "brown_forward"])
@pytest.mark.parametrize("models", [("opencv",), ("brown",), GENERAL_MODELS])
def test_rays_stay_and_covariances_follow(model: str, models: tuple[str, ...]) -> None:
    network, truth = make_network(seed_of("undistort"), images=2, points=10, model=model)
    camera = replace(truth.cameras[0], pixel_mm=truth.cameras[0].pixel_mm * [1.01, 1.0])
    truth = replace(truth, cameras=(camera,))
    straight, ideal = undistort(network, truth, models)
    new = ideal.cameras[0]
    assert new.model in models
    assert new.model == ("brown" if camera.in_mm and "brown" in models else new.model)
    distortion = [new.value(n) for n in new.names if n not in ("c", "x0", "y0", "fx", "fy", "cx", "cy")]
    assert not any(distortion) and not new.free[-len(distortion) :].any()
    assert new.pixel_mm[0] == new.pixel_mm[1]
    before, after = network.image_points, straight.image_points
    uv = tangents_from_pixel(camera, before.xy)
    np.testing.assert_allclose(tangents_from_pixel(new, after.xy), uv, atol=1e-13)
    assert np.abs(after.xy - before.xy).max() > 1  # px: there was something to correct
    # one sigma to the right by the covariance against where that point really goes
    step = 1e-3
    moved = replace(network, image_points=replace(before, xy=before.xy + np.array([step, 0])))
    G = (undistort(moved, truth, models)[0].image_points.xy - after.xy) / step
    along = replace(before, covariance=np.tile(np.diag([1.0, 0.0]), (len(before), 1, 1)))
    found = undistort(replace(network, image_points=along), truth, models)[0].image_points.covariance
    np.testing.assert_allclose(found, G[:, :, None] * G[:, None, :], atol=1e-5)


def test_what_cannot_be_inverted_is_refused() -> None:
    network, truth = make_network(seed_of("undistort"), images=2, points=10, model="opencv")
    camera = truth.cameras[0]
    folded = camera.with_parameters(camera.parameters + np.array([0, 0, 0, 0, -50.0, 0, 0, 0]))
    with pytest.raises(
        GeometryError, match=r"cannot be inverted at \d+ image points?, the first is point \d"
    ):
        undistort(network, replace(truth, cameras=(folded,)), ("opencv",))
