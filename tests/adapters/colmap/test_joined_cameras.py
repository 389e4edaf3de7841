"""Cameras of a COLMAP model joined into one: all else stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from adapters.colmap.camera_models import write_model, write_scene
from adapters.colmap.refined_model import join_cameras_of, open_model
from sfm.products.refining.joined_cameras import join_cameras
from tests.synthetic import make_network, seed_of


def test_photographs_of_joined_cameras_are_of_the_first(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("joined"), images=5, points=20, model="opencv", free=())
    (camera,) = truth.cameras
    cameras = tuple(
        replace(camera, name=f"{i}", parameters=camera.parameters * (1 + 0.01 * (i - 2))) for i in range(5)
    )
    small = replace(cameras[4], size_px=(640, 480))  # another size: stays
    network = replace(network, camera=np.arange(5))
    write_model(tmp_path / "model", network, replace(truth, cameras=(*cameras[:4], small)))
    opened = open_model(tmp_path / "model")
    joined = join_cameras_of(opened, *join_cameras(opened.network, opened.estimate))
    write_scene(tmp_path / "joined", joined.scene)
    before, after = (pycolmap.Reconstruction(tmp_path / name) for name in ("model", "joined"))
    assert sorted(after.cameras) == [1, 5] and sorted(after.images) == sorted(before.images)
    assert [after.image(i).camera_id for i in sorted(after.images)] == [1, 1, 1, 1, 5]
    mean = np.mean([before.camera(k).params for k in (1, 2, 3, 4)], axis=0)
    np.testing.assert_allclose(after.camera(1).params, mean, rtol=1e-12)
    np.testing.assert_array_equal(after.camera(5).params, before.camera(5).params)
    for i in before.images:
        np.testing.assert_allclose(
            after.image(i).cam_from_world().matrix(), before.image(i).cam_from_world().matrix(), atol=1e-12
        )
        ours, theirs = after.image(i).points2D, before.image(i).points2D
        assert [(*p.xy, p.point3D_id) for p in ours] == [(*p.xy, p.point3D_id) for p in theirs]
    for j in before.point3D_ids():
        np.testing.assert_array_equal(after.point3D(j).xyz, before.point3D(j).xyz)
        assert after.point3D(j).track.length() == before.point3D(j).track.length()
