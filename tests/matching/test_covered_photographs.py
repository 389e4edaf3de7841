"""Tests which photographs can show a group of object points."""

from __future__ import annotations

import numpy as np
import pytest

from sfm.matching.lsm.coverage import photographs_towards, project_points
from sfm.model.camera import camera_from_values
from sfm.model.estimate import Estimate

SIZE = (800, 600)
LENSES = {
    "normal": camera_from_values("normal", "opencv", SIZE, (0.005, 0.005), c_mm=5.0, values=(("k1", -0.1),)),
    "fisheye": camera_from_values("fisheye", "opencv_fisheye", SIZE, (0.005, 0.005), c_mm=1.3),
}


@pytest.mark.parametrize("lens", LENSES)
def test_photographs_that_show_one_of_the_points_are_among_those_towards_them(lens: str) -> None:
    rng = np.random.default_rng(4)
    m = 400
    rotation = np.linalg.qr(rng.standard_normal((m, 3, 3)))[0]
    rotation[:, :, 0] *= np.linalg.det(rotation)[:, None]
    points = np.array([4.0, 1.0, 0.0]) + rng.uniform(-0.5, 0.5, (30, 3))
    position = rng.uniform(-6.0, 6.0, (m, 3))
    position[0] = points.mean(axis=0)  # amid the points
    position[7] = np.nan  # not oriented
    estimate = Estimate((LENSES[lens],), position, rotation, points)
    camera = np.zeros(m, dtype=np.int64)
    towards = photographs_towards(estimate, camera, np.vstack([points, np.full(3, np.nan)]))
    oriented = np.flatnonzero(estimate.oriented)
    image = np.repeat(oriented, len(points))
    at = project_points(estimate, camera, image, np.tile(points, (len(oriented), 1)))
    shown = ((at >= 0) & (at <= np.array(SIZE) - 1)).all(axis=1)
    showing = np.unique(image[shown])
    assert len(showing) > 20
    assert np.isin(showing, towards).all()
    assert 0 in towards and 7 not in towards
    # a ball is wider than its points: some photographs beside it stay, most of the others do not
    assert len(towards) < 3 * len(showing)
    assert not len(photographs_towards(estimate, camera, np.full((2, 3), np.nan)))
