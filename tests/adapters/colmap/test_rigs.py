"""Rigs and frames of COLMAP's models: read as mounts and moments, and written as what they were."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from adapters.colmap.camera_models import read_model, write_model
from adapters.formats.registry import read_content, write_content
from sfm.adjustment.solve import adjust
from sfm.cli.commands.convert import convert
from sfm.comparison.camera_conversion import convert_cameras
from sfm.model.conventions import VISION_AXES
from sfm.model.errors import SurveyFileError
from tests.rigs import make_rig
from tests.synthetic import seed_of


def synthesized(rigs: int = 1, cameras: int = 2) -> pycolmap.Reconstruction:
    """Return a model that COLMAP has made: five frames of each rig."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = rigs, cameras, 5
    options.num_points3D = 30
    options.sensor_from_rig_translation_stddev = 0.1
    options.sensor_from_rig_rotation_stddev = 5.0
    pycolmap.set_random_seed(1)
    return pycolmap.synthesize_dataset(options)


def rigs_of(scene: pycolmap.Reconstruction) -> list[tuple[int, list[np.ndarray]]]:
    """Return the reference camera of each rig, and the poses of its other cameras, in order."""
    return [
        (rig.ref_sensor_id.id, [pose.matrix() for _, pose in sorted(rig.non_ref_sensors.items(), key=str)])
        for _, rig in sorted(scene.rigs.items())
    ]


@pytest.mark.parametrize("form", ["colmap", "colmap-text", "tables"])
def test_one_rig_stays_one_rig(form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Converted, through tables too: one rig of two cameras and five frames of two photographs."""
    scene = synthesized()
    (tmp_path / "in").mkdir()
    scene.write(tmp_path / "in")
    convert(tmp_path / "in", tmp_path / "out", to_format=form)
    told = capsys.readouterr().out
    assert "on rigs" not in told and "moment" not in told
    if form == "tables":
        convert(tmp_path / "out", tmp_path / "model", to_format="colmap")
    again = pycolmap.Reconstruction(tmp_path / ("model" if form == "tables" else "out"))
    assert (again.num_rigs(), again.num_frames(), again.num_reg_images()) == (1, 5, 10)
    before, after = rigs_of(scene)[0], rigs_of(again)[0]
    assert after[0] == before[0] and len(before[1]) == 1
    np.testing.assert_allclose(after[1], before[1], atol=1e-12)
    of = {image.name: image for image in again.images.values()}
    pairs = {
        frozenset(scene.image(one.id).name for one in frame.image_ids) for frame in scene.frames.values()
    }
    assert pairs == {
        frozenset(again.image(one.id).name for one in f.image_ids) for f in again.frames.values()
    }
    for image in scene.images.values():
        pose = of[image.name].cam_from_world().matrix()
        np.testing.assert_allclose(pose, image.cam_from_world().matrix(), atol=1e-12)


def test_mounts_are_those_of_colmap(tmp_path: Path) -> None:
    """Two rigs of three cameras; each photograph is where pose and mount of its camera have it."""
    scene = synthesized(rigs=2, cameras=3)
    (tmp_path / "in").mkdir()
    scene.write(tmp_path / "in")
    network, estimate = read_model(tmp_path / "in")
    mounts, moment = estimate.mounts, network.moment
    assert mounts is not None and moment is not None
    assert mounts.rig == ("rig 1",) * 3 + ("rig 2",) * 3 and moment.max() == 9
    assert mounts.free.any(axis=1).tolist() == [False, True, True] * 2
    for t in range(10):
        first, *others = np.flatnonzero(moment == t)
        assert mounts.position[network.camera[first]].tolist() == [0, 0, 0]
        R = estimate.rotation[first]
        for i in others:
            a = network.camera[i]
            np.testing.assert_allclose(estimate.rotation[i], R @ mounts.rotation[a], atol=1e-12)
            X = estimate.position[first] + R @ mounts.position[a]
            np.testing.assert_allclose(estimate.position[i], X, atol=1e-12)
    pose = rigs_of(scene)[0][1][0]
    np.testing.assert_allclose(mounts.rotation[1], VISION_AXES @ pose[:, :3].T @ VISION_AXES, atol=1e-12)
    assert adjust(network, estimate, reject="none").estimate.mounts is not None


def test_names_and_held_mounts_come_back(tmp_path: Path) -> None:
    network, truth = make_rig(seed_of("colmap rig"), cameras=3, moments=4, points=12, free=())
    assert truth.mounts is not None
    free = truth.mounts.free.copy()
    free[2] = False
    opencv = convert_cameras(replace(truth, mounts=replace(truth.mounts, free=free)), ("full_opencv",))[0]
    write_model(tmp_path / "m", network, opencv)
    again = read_model(tmp_path / "m")
    assert again[1].mounts is not None and again[1].mounts.rig == ("rig",) * 3
    assert (again[1].mounts.free == free).all()
    content = read_content(tmp_path / "m")
    write_content(tmp_path / "t", "tables", content)
    held = read_content(tmp_path / "t").result.estimate.mounts
    assert held is not None and (held.free == free).all()


def test_a_camera_without_pose_in_its_rig_is_refused(tmp_path: Path) -> None:
    scene = synthesized()
    (tmp_path / "in").mkdir()
    scene.write_text(str(tmp_path / "in"))
    path = tmp_path / "in" / "rigs.txt"
    *head, line = path.read_text().splitlines()
    words = line.split()
    assert words[:2] == ["1", "2"] and words[6] == "1"
    path.write_text("\n".join([*head, " ".join([*words[:6], "0"])]) + "\n")
    with pytest.raises(SurveyFileError, match=r"in: .*camera 2 in it is not known") as refused:
        read_model(tmp_path / "in")
    assert "\n" not in str(refused.value)


def test_two_photographs_of_one_camera_in_a_frame_are_refused(tmp_path: Path) -> None:
    """The second image of the first frame is said to be of camera 1, as the first one is."""
    scene = synthesized()
    (tmp_path / "in").mkdir()
    scene.write_text(str(tmp_path / "in"))
    path = tmp_path / "in" / "frames.txt"
    *head, line = path.read_text().splitlines()
    words = line.split()
    assert words[9] == "2" and words[10:12] == ["CAMERA", "1"] and words[13:15] == ["CAMERA", "2"]
    path.write_text("\n".join([*head, " ".join([*words[:14], "1", words[15]])]) + "\n")
    images = (tmp_path / "in" / "images.txt").read_text().splitlines()
    for k, row in enumerate(images):
        cells = row.split()
        if len(cells) == 10 and cells[0] == words[15] and cells[8] == "2":
            images[k] = " ".join([*cells[:8], "1", cells[9]])
    (tmp_path / "in" / "images.txt").write_text("\n".join(images) + "\n")
    with pytest.raises(SurveyFileError, match="are of one moment; needed different") as refused:
        read_model(tmp_path / "in")
    assert "\n" not in str(refused.value)
