"""What `kolinear refine` keeps of a COLMAP model: numbers, colours, cameras, rigs, and points not used."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from adapters.colmap.camera_models import read_model, write_model
from adapters.colmap.database import write_database
from adapters.colmap.model_files import MODELS
from adapters.colmap.reconstruction import colmap_parameters
from adapters.colmap.refined_model import open_model
from datasets.textured import render
from sfm.adjustment.quality import correlations as error_correlation
from sfm.adjustment.result import ErrorCorrelation
from sfm.cli.commands.refine import refine
from sfm.matching.radiometry import GreyPhotographs
from sfm.model.camera import camera_from_values, project, tangents_from_pixel
from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.errors import BackendError, GeometryError, OutputError, PhotographError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.similarity import Similarity
from sfm.products.refining import windows as model_photographs
from sfm.products.refining.refinement import UNSUPPORTED, refine_model, refinement_text
from sfm.products.refining.windows import KeyPoints, Limits, Size, Windows, match_reduced
from sfm.targets.codes.rings import ring_family
from tests.tables import rows_of

pycolmap = pytest.importorskip("pycolmap")

SIZE = (300, 240)
FOCAL = render.C_MM / render.PIXEL_MM[0]
PHOTOGRAPHS = 4
NOISE_PX = 0.3
COLOUR = (10, 200, 30)
TARGETS = (3, 7, 12, 20, 31, 40)
CODES = ring_family("ring12")
DOT_TEXELS = 10
PARAMS = {
    "SIMPLE_PINHOLE": [FOCAL, SIZE[0] / 2, SIZE[1] / 2],
    "PINHOLE": [FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2],
    "SIMPLE_RADIAL": [FOCAL, SIZE[0] / 2, SIZE[1] / 2, 1e-4],
    "RADIAL": [FOCAL, SIZE[0] / 2, SIZE[1] / 2, 1e-4, 1e-4],
    "FULL_OPENCV": [FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, 1e-4, *[0.0] * 7],
    "EQUIRECTANGULAR": [*SIZE],
}
AWAY = 40  # of the numbers of COLMAP
SMALL = 0.8  # scale of the photographs of a second camera


def _paint_target(skin: AnyArray, code: int, at: FloatArray) -> None:
    """Paint a coded target on the texture: black on white, a dot of 5 px in the photographs."""
    entry = CODES.pattern[CODES.number == code][0]
    row, column = np.mgrid[-110:111, -110:111] / 2.5  # texels, five times as fine as the texture
    angle = -np.arctan2(row, column) % (2 * np.pi)  # the texture has y up: clockwise in the photographs
    cell = (angle / (2 * np.pi) * CODES.cells).astype(int) % CODES.cells
    radius = np.hypot(row, column) / DOT_TEXELS
    ring = (radius > CODES.inner) & (radius < CODES.outer) & ((entry >> (CODES.cells - 1 - cell)) & 1 > 0)
    white = np.where((radius < 1) | ring, 0.05, 0.95).astype(np.float32)
    x, y = at / render.TEXEL_M + len(skin) / 2
    box = np.mgrid[round(y) - 44 : round(y) + 45, round(x) - 44 : round(x) + 45].astype(np.float32)
    places = ((box[1] - x) * 2.5 + 110).astype(np.float32), ((box[0] - y) * 2.5 + 110).astype(np.float32)
    patch = cv2.remap(cv2.blur(white, (3, 3)), *places, cv2.INTER_LINEAR, borderValue=-1.0)
    part = skin[round(y) - 44 : round(y) + 45, round(x) - 44 : round(x) + 45]
    inside = np.hypot(box[1] - x, box[0] - y) < (CODES.outer + 1.0) * DOT_TEXELS
    part[inside] = patch[inside]


@cache
def _scene(targets: bool = False) -> tuple[tuple[AnyArray, ...], Estimate]:
    """Four small photographs of the textured surface, their orientation, and points on the surface."""
    lens = camera_from_values("lens", "opencv", SIZE, render.PIXEL_MM, c_mm=render.C_MM)
    pair = [part[:2] for part in render.stations()]
    turn = cv2.Rodrigues(np.array([0.0, 0.0, -0.8]))[
        0
    ]  # the same two cameras again, as a rig would carry them
    position = np.vstack([pair[0], pair[0] @ turn.T])
    rotation = np.concatenate([pair[1], turn @ pair[1]])
    skin = render.texture()
    if targets:
        for code, at in zip(TARGETS, _target_places(), strict=True):
            _paint_target(skin, code, at[:2])
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    uv = tangents_from_pixel(lens, np.column_stack([x.ravel(), y.ravel()]))
    pictures = []
    for i in range(PHOTOGRAPHS):
        rays = np.column_stack([uv, -np.ones(len(uv))]) @ rotation[i].T
        at = render.surface_points(position[i], rays)[:, :2] / render.TEXEL_M + len(skin) / 2
        at = at.astype(np.float32).reshape(*SIZE[::-1], 2)
        light = cv2.GaussianBlur(cv2.remap(skin, at[..., 0], at[..., 1], cv2.INTER_LINEAR), (0, 0), 0.8)
        pictures.append(np.rint(np.clip(200 * light, 0, 255)).astype(np.uint8))
    x, y = np.meshgrid(np.arange(90, 211, 15.0), np.arange(70, 171, 15.0))
    uv = tangents_from_pixel(lens, np.column_stack([x.ravel(), y.ravel()]))
    points = render.surface_points(position[0], np.column_stack([uv, -np.ones(len(uv))]) @ rotation[0].T)
    return tuple(pictures), Estimate((lens,), position, rotation, points)


def _target_places() -> FloatArray:
    """Return where the targets are, m, (6, 3)."""
    x, y = np.array([(x, y) for x in (-0.09, 0.09, 0.0) for y in (-0.065, 0.065)]).T
    return np.column_stack([x, y, render.height(x, y)])


def _model(
    folder: Path,
    camera: str = "SIMPLE_RADIAL",
    *,
    rig: bool = False,
    targets: bool = False,
    second: str | None = None,
    each: bool = False,
) -> Any:
    """Write photographs in two folders and a model of them with numbers of its own, and return the scene.

    With a second camera model the photographs of the second folder are smaller, and have the names of those
    in the first. With a camera for each folder these are alike.
    """
    pictures, truth = _scene(targets)
    rng = np.random.default_rng(9)
    scene = pycolmap.Reconstruction()
    cameras = (7, 9) if rig or second or each else (7, 7)
    for number in sorted(set(cameras)):
        lens = pycolmap.Camera(
            model=camera, width=SIZE[0], height=SIZE[1], params=PARAMS[camera], camera_id=number
        )
        if second and number == 9:
            size = tuple(round(SMALL * side) for side in SIZE)
            lens = pycolmap.Camera.create_from_model_name(9, second, SMALL * FOCAL, *size)
        (scene.add_camera if rig else scene.add_camera_with_trivial_rig)(lens)
    poses = []
    for i in range(len(pictures)):
        M = np.diag([1.0, -1.0, -1.0]) @ truth.rotation[i].T
        poses.append(pycolmap.Rigid3d(pycolmap.Rotation3d(M), -M @ truth.position[i]))
    if rig:
        _add_rig(scene, poses)
    for i, picture in enumerate(pictures):
        seen = project(truth.cameras[0], truth.position[i], truth.rotation[i], truth.points)
        name = f"{'ab'[i % 2]}/{i // 2 if second else i}.png"
        if second and i % 2:
            seen = SMALL * (seen + 0.5) - 0.5
            picture = cv2.resize(picture, None, fx=SMALL, fy=SMALL, interpolation=cv2.INTER_AREA)
        seen = np.vstack(
            [[5.0, 6.0], seen + rng.normal(0, NOISE_PX, seen.shape)]
        )  # the first claims no point
        image = pycolmap.Image(name=name, keypoints=seen + 0.5, camera_id=cameras[i % 2], image_id=AWAY + i)
        if rig:
            image.frame_id = 1 + i // 2
            scene.add_image(image)
        else:
            scene.add_image_with_trivial_frame(image, poses[i])
        (folder / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(folder / name), picture)
    if rig:
        for number in scene.frames:
            scene.register_frame(number)
    for j, xyz in enumerate(truth.points):
        rays = range(2) if j < 3 else range(len(pictures))
        point = pycolmap.Point3D(xyz=xyz, color=np.array(COLOUR, np.uint8))
        scene.add_point3D_with_id(AWAY + 2 * j, point)
        for i in rays:
            scene.add_observation(AWAY + 2 * j, pycolmap.TrackElement(AWAY + i, j + 1))
    (folder / "model").mkdir()
    scene.write_binary(str(folder / "model"))
    return scene


def _add_rig(scene: Any, poses: list[Any]) -> None:
    """Add one rig of both cameras, near the poses of the truth, and its two frames."""
    sensors = [pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=number) for number in (7, 9)]
    rig = pycolmap.Rig(rig_id=3)
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], poses[1] * poses[0].inverse())
    scene.add_rig(rig)
    for k in range(2):
        frame = pycolmap.Frame(frame_id=k + 1, rig_id=3)
        for sensor, i in zip(sensors, (2 * k, 2 * k + 1), strict=True):
            frame.add_data_id(pycolmap.data_t(sensor_id=sensor, id=AWAY + i))
        frame.rig_from_world = poses[2 * k]
        scene.add_frame(frame)


def _key_points(scene: Any, image: int) -> FloatArray:
    return np.array([p.xy for p in scene.image(image).points2D])


def _rms(scene: Any) -> float:
    """Return the RMS per coordinate of all key points with a point, px."""
    v = [
        scene.image(ray.image_id).project_point(point.xyz)
        - scene.image(ray.image_id).points2D[ray.point2D_idx].xy
        for point in scene.points3D.values()
        for ray in point.track.elements
    ]
    return float(np.sqrt(np.mean(np.square(v))))


@pytest.mark.parametrize("camera", ["SIMPLE_RADIAL", "PINHOLE"])
def test_what_is_not_measured_stays_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], camera: str
) -> None:
    before = _model(tmp_path, camera)
    refine(tmp_path / "model", tmp_path)
    out = tmp_path / "model_refined"
    printed = capsys.readouterr().out
    assert "measured anew" in printed
    after = pycolmap.Reconstruction(str(out))
    assert f"in the files  {_rms(after):.4f} px, including " in printed
    assert list(after.images) == list(before.images) and set(after.point3D_ids()) == set(before.point3D_ids())
    assert after.camera(7).model_name == camera
    params = after.camera(7).params
    assert params[0] == pytest.approx(FOCAL, rel=0.02)
    assert not (params == before.camera(7).params)[:3].any()  # focal length and principal point are estimated
    assert all((p.color == COLOUR).all() for p in after.points3D.values())
    truth = _scene()[1]
    moved = []
    for i in range(AWAY, AWAY + PHOTOGRAPHS):
        was, now = _key_points(before, i), _key_points(after, i)
        assert (was[0] == now[0]).all() and len(was) == len(now)  # a key point without a point
        moved.append(np.abs(now - was)[4:].max(axis=1) > 0.05)
    assert np.mean(moved) > 0.9  # the template of each point is at a whole pixel
    for j in range(3):  # of two photographs: key points as they came, the point intersected anew
        assert after.point3D(AWAY + 2 * j).track.length() == 2
        assert (_key_points(after, AWAY)[j + 1] == _key_points(before, AWAY)[j + 1]).all()
        assert 0 < np.linalg.norm(after.point3D(AWAY + 2 * j).xyz - truth.points[j]) < 0.05
    rows = rows_of(out / "sigma_points.csv")
    assert {int(row["point3D_id"]) for row in rows} <= set(after.point3D_ids()) and len(rows) > 40
    assert all(0 < float(row["sZ"]) < 0.01 for row in rows)
    interior = rows_of(out / "sigma_cameras.csv")
    assert interior[0]["model"] == camera and float(interior[0]["sigma"]) > 0
    assert float(interior[0]["after"]) == pytest.approx(params[0], rel=1e-9)
    page = (out / "refinement.html").read_text(encoding="utf-8")
    assert (
        "a/0.png" in page and "of a point that fewer than 3 photographs see" in page and "http:" not in page
    )
    assert "[px]" in page.partition("<h2>Cameras")[2].partition("</tr>")[2].partition("</tr>")[0]
    # COLMAP goes on from there: the same key points, hardly anything left to change
    error = after.compute_mean_reprojection_error()
    pycolmap.bundle_adjustment(after, pycolmap.BundleAdjustmentOptions(print_summary=False))
    assert after.compute_mean_reprojection_error() < 1.05 * error


@pytest.mark.parametrize(("camera", "second"), [("SIMPLE_RADIAL", "OPENCV"), ("FULL_OPENCV", "PINHOLE")])
def test_two_sizes_of_photographs_with_the_same_names(tmp_path: Path, camera: str, second: str) -> None:
    before = _model(tmp_path, camera, second=second)
    before.write_text(str(tmp_path / "model"))
    for kind in ("cameras", "images", "points3D", "rigs", "frames"):  # the text is read
        (tmp_path / "model" / f"{kind}.bin").unlink()
    refine(tmp_path / "model", tmp_path, fix="f,fx,fy,cx,cy,k1")
    after = pycolmap.Reconstruction(str(tmp_path / "model_refined"))
    assert [after.camera(i).model_name for i in (7, 9)] == [camera, second]
    assert (after.camera(9).width, after.camera(9).height) == (240, 192)
    names = [after.image(AWAY + i).name for i in range(PHOTOGRAPHS)]
    assert names == ["a/0.png", "b/0.png", "a/1.png", "b/1.png"]
    assert set(after.point3D_ids()) == set(before.point3D_ids())
    after.update_point_3d_errors()
    errors = [p.error for p in after.points3D.values() if p.track.length() > 2]
    assert len(errors) == 60 and np.median(errors) < 0.05  # of key points with a noise of 0.3 px


def test_a_rig_comes_out_with_its_rig(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    before = _model(tmp_path, "PINHOLE", rig=True)
    refine(tmp_path / "model", tmp_path, out=tmp_path / "out", fix="f,cx")
    assert "adjustment.cc" not in capfd.readouterr().err  # COLMAP's log
    after = pycolmap.Reconstruction(str(tmp_path / "out"))
    told = {(int(r["camera_id"]), r["parameter"]): r for r in rows_of(tmp_path / "out" / "sigma_cameras.csv")}
    for number in (7, 9):  # of two photographs: cy is held anyway
        params, was = after.camera(number).params, before.camera(number).params
        assert (params == was).all() and told[number, "fx"]["sigma"] == ""
    kept, came = (np.mean([p.xyz for p in one.points3D.values()], axis=0) for one in (after, before))
    assert np.linalg.norm(kept - came) < 0.01
    assert after.rig(3).num_sensors() == 2 and len(after.frames) == 2
    sensor = after.rig(3).non_ref_sensors
    assert list(sensor) == list(before.rig(3).non_ref_sensors)
    (was,), (now,) = (list(one.rig(3).non_ref_sensors.values()) for one in (before, after))
    assert not np.array_equal(was.matrix(), now.matrix())
    after.update_point_3d_errors()  # by mount and moments alone
    errors = [p.error for p in after.points3D.values() if p.track.length() > 2]
    assert len(errors) == 60 and np.median(errors) < 0.05  # of key points with a noise of 0.3 px


def test_a_model_of_too_few_points_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    scene = _model(tmp_path, "FULL_OPENCV", second="FULL_OPENCV")
    number = sorted(scene.point3D_ids())
    for j in {*number} - {number[k] for k in (10, 16, 46, 52)}:
        scene.delete_point3D(j)
    scene.write_binary(str(tmp_path / "model"))
    with pytest.raises(GeometryError, match="leave no redundancy; hold param"):
        refine(tmp_path / "model", tmp_path)
    for j in scene.point3D_ids():
        scene.delete_point3D(j)
    scene.write_binary(str(tmp_path / "model"))
    with pytest.raises(GeometryError, match="no key point of the model has a point, nothing to refine"):
        refine(tmp_path / "model", tmp_path)
    assert not (tmp_path / "model_refined").exists()
    with pytest.raises(OutputError, match="cannot be written here: Not a directory"):  # before the work
        refine(tmp_path / "model", tmp_path, out=tmp_path / "a" / "0.png" / "out")


def test_a_model_that_is_not_dependable_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _model(tmp_path)
    monkeypatch.setattr("sfm.products.refining.refinement.MAX_ITERATIONS", 1)
    with pytest.raises(SystemExit, match="1"):
        refine(tmp_path / "model", tmp_path)
    assert "error: The adjustment did not converge in " in capsys.readouterr().out


def test_a_model_whose_halves_are_worse_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _model(tmp_path)
    refined = refine_model(*read_model(tmp_path / "model"), tmp_path)
    for halves in ((2e-4, 1e-4), (float("nan"), 1e-4), (1e-4, float("nan"))):
        better = replace(refined, halves=halves)
        assert better.better and not better.remarks
        assert ("halves        not compared" in refinement_text(better)) == bool(np.isnan(sum(halves)))
    worse = replace(refined, halves=(1e-4, 1.1e-4))
    assert [said.kind for said in worse.remarks] == ["refinement_not_better"]
    differences = iter((1e-4, 1.2e-4))
    monkeypatch.setattr("sfm.products.refining.refinement.halves_apart", lambda *_: next(differences))
    with pytest.raises(SystemExit, match="1"):
        refine(tmp_path / "model", tmp_path)
    printed = capsys.readouterr().out
    assert "100 ppm of the distance before, 120 ppm after" in printed
    assert f"Model: {tmp_path / 'model'}\n" in printed and "in the files" not in printed
    out = tmp_path / "model_refined"
    assert (out / "refinement.html").is_file() and not list(out.glob("*.bin"))


def test_cameras_are_joined_although_new_key_points_are_not_better(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model then has its own key points, adjusted with one camera; before, it kept its two cameras."""
    _model(tmp_path, each=True)
    before = pycolmap.Reconstruction(str(tmp_path / "model"))
    differences = iter((1e-4, 1.2e-4))
    monkeypatch.setattr("sfm.products.refining.refinement.halves_apart", lambda *_: next(differences))
    with pytest.raises(SystemExit, match="1"):
        refine(tmp_path / "model", tmp_path, one_camera=True)
    out = tmp_path / "model_refined"
    printed = capsys.readouterr().out
    after = pycolmap.Reconstruction(str(out))
    count = sum(len(point.track.elements) for point in before.points3D.values())
    assert f"Model: {out}\n" in printed
    assert f"in the files  {_rms(after):.4f} px, {count} key points as they came" in printed
    assert len(before.cameras) == 2 and len(after.cameras) == 1
    assert after.num_reg_images() == before.num_reg_images() == PHOTOGRAPHS
    assert after.num_points3D() == before.num_points3D()
    for i in before.images:
        np.testing.assert_array_equal(_key_points(after, i), _key_points(before, i))
    assert _rms(after) < _rms(before)


def test_key_points_that_are_neighbours_err_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before and after, so that the standard deviations of both can be compared."""
    _model(tmp_path)
    correlation = ErrorCorrelation(alone=0.5, common=0.5, length_px=100.0)
    monkeypatch.setattr(error_correlation, "estimate_error_correlation", lambda _: correlation)
    found = refine_model(*read_model(tmp_path / "model"), tmp_path)
    for one in (found.readjusted, found.adjustment):
        assert one.error_correlation == correlation
        independent = one.cofactors.exterior * one.sigma0**2
        assert np.trace(one.covariance.exterior.sum(axis=0)) > 1.05 * np.trace(independent.sum(axis=0))


def test_a_photograph_that_cannot_be_read_is_named_with_its_folder(tmp_path: Path) -> None:
    _model(tmp_path, "PINHOLE", second="PINHOLE")
    (tmp_path / "b" / "1.png").write_bytes(b"")
    with pytest.raises(PhotographError, match=r"^b/1\.png: the file is empty"):
        refine(tmp_path / "model", tmp_path)


def test_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _model(tmp_path)
    masks = tmp_path / "masks"
    with pytest.raises(SurveyFileError, match="needed the folder of the masks"):
        refine(tmp_path / "model", tmp_path, masks=masks)
    (masks / "a").mkdir(parents=True)
    with pytest.raises(SurveyFileError, match=r"no mask of a photograph; .* would be a/0\.png\.png"):
        refine(tmp_path / "model", tmp_path, masks=masks)
    with pytest.raises(SurveyFileError, match=r"a/0\.png: is a photograph, needed the mask of a/0\.png"):
        refine(tmp_path / "model", tmp_path, masks=tmp_path)
    cv2.imwrite(str(masks / "a" / "0.png.png"), np.zeros((10, 10), np.uint8))
    with pytest.raises(SurveyFileError, match="the mask has 10 x 10 px, its photograph 300 x 240 px"):
        refine(tmp_path / "model", tmp_path, masks=masks)
    for name in ("a/0", "b/1", "a/2", "b/3"):
        (masks / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(masks / f"{name}.png.png"), np.zeros(SIZE[::-1], np.uint8))
    with pytest.raises(
        GeometryError, match="none of 246 key points is left to be measured: 246 where the mask"
    ):
        refine(tmp_path / "model", tmp_path, masks=masks)
    for name in ("b/1", "a/2", "b/3"):
        (masks / f"{name}.png.png").unlink()
    mask = np.full(SIZE[::-1], 255, np.uint8)
    mask[:, : SIZE[0] // 2] = 0
    cv2.imwrite(str(masks / "a" / "0.png.png"), mask)
    refine(tmp_path / "model", tmp_path, masks=masks)
    assert "where the mask is black" in capsys.readouterr().out


def test_a_panorama_is_refused_by_its_name(tmp_path: Path) -> None:
    _model(tmp_path, "EQUIRECTANGULAR")
    with pytest.raises(BackendError, match="COLMAP's model EQUIRECTANGULAR is not read, expected one of"):
        refine(tmp_path / "model", tmp_path)


def test_every_model_of_colmap_is_known_by_its_number() -> None:
    known = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
    theirs = {int(pycolmap.CameraModelId.__members__[name].value): name for name in known}
    assert [theirs[number] for number in range(len(theirs))] == list(MODELS)
    for name, count in MODELS.items():
        assert len(pycolmap.Camera.create_from_model_name(1, name, 100.0, 640, 480).params) == count


@pytest.mark.parametrize("camera", ["SIMPLE_PINHOLE", "RADIAL"])
def test_cameras_keep_their_model_and_its_parameters(tmp_path: Path, camera: str) -> None:
    scene = _model(tmp_path, camera)
    opened = open_model(tmp_path / "model")
    ours = opened.estimate.cameras[0]
    assert ours.model.upper() == camera and opened.models == (camera,)
    assert (colmap_parameters(ours) == scene.camera(7).params).all()
    widened = read_model(tmp_path / "model")[1].cameras[0]
    assert widened.model == "opencv" and widened.value("fx") == widened.value("fy") == FOCAL


def test_photographs_keep_to_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _model(tmp_path)
    network, estimate = read_model(tmp_path / "model")
    read: list[str] = []
    was = model_photographs.read_of_size
    monkeypatch.setattr(
        model_photographs, "read_of_size", lambda path, *rest: read.append(path.name) or was(path, *rest)
    )
    monkeypatch.setattr(model_photographs, "GreyPhotographs", partial(GreyPhotographs, grey_bytes=0))
    two = model_photographs.Photographs(network, estimate, tmp_path, memory_bytes=2 * SIZE[0] * SIZE[1])
    for i in (0, 1, 0, 2, 0, 1):  # the oldest is forgotten
        assert two.grey(i).pixels.shape == SIZE[::-1]
    assert read == ["0.png", "1.png", "2.png", "1.png"]


def test_points_of_windows_that_overlap_are_intersected_and_not_adjusted(tmp_path: Path) -> None:
    """Otherwise the same pixels count several times, and the model is told more precise than it is."""
    _model(tmp_path)
    network, estimate = read_model(tmp_path / "model")
    seen, n = network.image_points, len(network.points)
    rng = np.random.default_rng(8)  # every point thrice, as detectors have it at several scales
    twins = ImagePoints(
        np.tile(seen.image, 3),
        np.concatenate([seen.point + k * n for k in range(3)]),
        np.tile(seen.xy, (3, 1)) + rng.normal(0, NOISE_PX, (3 * len(seen), 2)),
        np.tile(seen.covariance, (3, 1, 1)),
    )
    thrice = replace(
        network, points=tuple(f"{k}{name}" for k in range(3) for name in network.points), image_points=twins
    )
    start = replace(estimate, points=np.tile(estimate.points, (3, 1)))
    once, found = (refine_model(*model, tmp_path) for model in ((network, estimate), (thrice, start)))
    assert found.window_px == 15 and found.points.sum() <= n < 0.4 * found.points_anew.sum()
    assert 2.9 * once.refined < found.refined == found.accepted.sum()
    sigma = [
        np.sqrt(np.trace(one.adjustment.covariance.exterior[:, :3, :3].sum(axis=0))) for one in (once, found)
    ]
    assert sigma[1] == pytest.approx(sigma[0], rel=0.15)  # 0.58 times as large if all of them were adjusted
    anew = np.flatnonzero(found.points_anew & ~found.points)
    near = np.linalg.norm(found.estimate.points[anew] - _scene()[1].points[anew % n], axis=1)
    assert len(anew) > 100 and np.median(near) < 1e-3


def _blur(folder: Path) -> None:
    """Blur the photographs of a model by 2 px, and add noise of 2."""
    rng = np.random.default_rng(1)
    for path in sorted(folder.glob("[ab]/*.png")):
        sharp = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(float)
        seen = cv2.GaussianBlur(sharp, (0, 0), 2.0) + rng.normal(0, 2, sharp.shape)
        cv2.imwrite(str(path), seen.clip(0, 255).astype(np.uint8))


def test_blurred_photographs_are_measured_reduced(tmp_path: Path) -> None:
    _model(tmp_path)
    _blur(tmp_path)
    found = refine_model(*read_model(tmp_path / "model"), tmp_path)
    assert found.window_px == 30 and found.refined > 0.9 * found.key_points
    off = np.linalg.norm(found.estimate.points - _scene()[1].points, axis=1)
    assert np.median(off[found.points_anew]) < 3e-3


def test_points_not_found_in_fine_pixels_are_looked_for_in_coarser_ones(tmp_path: Path) -> None:
    _model(tmp_path)
    _blur(tmp_path)
    network, estimate = read_model(tmp_path / "model")
    seen = network.image_points
    rays = np.bincount(seen.point, minlength=len(network.points))
    rows = np.flatnonzero((rays >= 3)[seen.point])
    reference = np.where(rays >= 3, np.unique(seen.point, return_index=True)[1], -1)
    windows = Windows(np.full((len(seen), 2), np.nan), seen.covariance, np.zeros(len(seen), dtype=np.int64))
    known = seen.point < 20
    windows.xy[known] = seen.xy[known]
    keys = KeyPoints(tmp_path, network, rows, reference, Limits(3.0, 0.7))
    every = np.ones(len(network.points), dtype=bool)
    found = match_reduced(keys, estimate, windows, every, size=Size(15), tolerance_px=3.0)
    again = rows[~known[rows]]
    assert np.isfinite(found.xy[again]).all(axis=1).mean() > 0.9
    assert np.abs(found.xy[again] - seen.xy[again])[np.isfinite(found.xy[again])].max() < 3.0
    assert (found.xy[known] == seen.xy[known]).all()


def test_what_is_written_is_what_was_adjusted(tmp_path: Path) -> None:
    """Points that one photograph lacks in fine pixels are not replaced after the adjustment."""
    _model(tmp_path)
    path = sorted(tmp_path.glob("b/*.png"))[-1]
    sharp = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(float)
    seen = cv2.GaussianBlur(sharp, (0, 0), 2.0) + np.random.default_rng(2).normal(0, 2, sharp.shape)
    cv2.imwrite(str(path), seen.clip(0, 255).astype(np.uint8))
    opened = open_model(tmp_path / "model")
    found = refine_model(opened.network, opened.estimate, tmp_path)
    adjusted = found.adjustment.network.image_points
    assert len(found.rows) == len(adjusted) > 50
    np.testing.assert_array_equal(found.xy[found.rows], adjusted.xy)
    assert np.isfinite(found.xy[found.accepted]).all()
    refine(tmp_path / "model", tmp_path)
    network, written = read_model(tmp_path / "model_refined")
    seen, ours = network.image_points, found.model.image_points
    there = {(network.images[i], j): xy for i, j, xy in zip(seen.image, seen.point, seen.xy, strict=True)}
    numbers = {name: j for j, name in enumerate(network.points)}
    rows = np.flatnonzero(found.accepted)
    of_file = [
        there[found.model.images[ours.image[row]], numbers[found.model.points[ours.point[row]]]]
        for row in rows
    ]
    np.testing.assert_allclose(of_file, found.xy[rows], rtol=0, atol=1e-12)
    np.testing.assert_allclose(written.points, found.estimate.points[: len(written.points)], atol=1e-12)


def test_matches_of_a_point_with_too_few_of_them_contradict_nothing(tmp_path: Path) -> None:
    _model(tmp_path)
    network, estimate = read_model(tmp_path / "model")
    before = dict(refine_model(network, estimate, tmp_path).reasons)
    seen = network.image_points
    rank = np.empty(len(seen), dtype=int)  # of each image point among those of its object point
    order = np.argsort(seen.point, kind="stable")
    rank[order] = np.arange(len(seen)) - np.searchsorted(seen.point[order], seen.point[order])
    few = np.isin(seen.point, np.arange(0, len(network.points), 7))
    xy = np.where((few & (rank == 2))[:, None], seen.xy + 60.0, seen.xy)
    points = replace(seen, xy=xy).select(~few | (rank < 3))
    found = dict(refine_model(replace(network, image_points=points), estimate, tmp_path).reasons)
    assert found.get("contradict the others", 0) <= before.get("contradict the others", 0)
    assert found[UNSUPPORTED] > 0


def _survey(folder: Path, text: str) -> Path:
    path = folder / "survey.toml"
    path.write_text(
        '[survey]\nname = "scale"\nunit = "mm"\n[[camera]]\nname = "all"\nimages = "*.png"\n'
        f'[targets]\ncodes = "ring12"\n{text}',
        encoding="utf-8",
    )
    return path


def _targets_of(out: Path) -> tuple[FloatArray, FloatArray]:
    """Return the coordinates of the targets and their standard deviations, in order of their codes."""
    rows = {int(r["target"]): r for r in rows_of(out / "targets.csv")}
    found = [[float(rows[k][c]) for c in ("X", "Y", "Z", "sX", "sY", "sZ")] for k in TARGETS]
    return np.array(found)[:, :3], np.array(found)[:, 3:]


def test_scale_bars_give_a_model_with_a_rig_its_scale(tmp_path: Path) -> None:
    before = _model(tmp_path, "PINHOLE", rig=True, targets=True)
    truth = 1000 * _target_places()
    bars = [(TARGETS[i], TARGETS[j], np.linalg.norm(truth[i] - truth[j])) for i, j in ((0, 3), (1, 2))]
    text = "".join(
        f'[[scale_bar]]\nfrom = "{a}"\nto = "{b}"\nlength = {length:.5f}\nsigma = 0.005\n'
        for a, b, length in bars
    )
    survey = _survey(tmp_path, text)
    refine(tmp_path / "model", tmp_path, out=tmp_path / "out", fix="f,cx,cy", survey=survey)
    found, sigma = _targets_of(tmp_path / "out")
    for i, j in ((0, 1), (0, 2), (1, 3), (2, 3)):  # distances that nobody gave
        difference = np.linalg.norm(found[i] - found[j]) - np.linalg.norm(truth[i] - truth[j])
        assert abs(difference) < 4 * np.hypot(*sigma[[i, j]].max(axis=1))
    after = pycolmap.Reconstruction(str(tmp_path / "out"))
    base = [
        np.linalg.norm(one.rig(3).sensor_from_rig(next(iter(one.rig(3).non_ref_sensors))).translation)
        for one in (before, after)
    ]
    assert base[1] == pytest.approx(1000 * base[0], rel=1e-2)
    page = (tmp_path / "out" / "refinement.html").read_text(encoding="utf-8")
    assert "target 3 - target 20" in page and "[mm]" in page


def test_control_gives_a_model_its_frame_and_what_is_wrong_of_it_is_taken_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _model(tmp_path, targets=True)
    frame = Similarity(1000.0, cv2.Rodrigues(np.array([0.3, -0.2, 1.0]))[0], np.array([500.0, 900.0, -40.0]))
    truth = frame.apply(_target_places())
    given = truth.copy()
    given[2, 0] += 4.0
    rows = "".join(f"{k},{x},{y},{z},0.02,0.02,0.02\n" for k, (x, y, z) in zip(TARGETS, given, strict=True))
    (tmp_path / "control.csv").write_text("id,X,Y,Z,sX,sY,sZ\n" + rows + "99,0,0,0,1,1,1\n", encoding="utf-8")
    survey = _survey(tmp_path, '[datum]\nkind = "control"\n[control]\nfile = "control.csv"\n')
    refine(tmp_path / "model", tmp_path, out=tmp_path / "out", fix="f,cx,cy,k1", survey=survey)
    told = capsys.readouterr().out
    assert "warning: Of the control points, 99 is not in the result." in told
    assert "target 12" in told and "5 control points" in told
    found, sigma = _targets_of(tmp_path / "out")
    assert (np.abs(found - truth) < 4 * sigma).all() and sigma.max() < 0.5
    after = pycolmap.Reconstruction(str(tmp_path / "out"))
    points = frame.apply(_scene(True)[1].points)
    assert np.median([np.linalg.norm(after.point3D(AWAY + 2 * j).xyz - p) for j, p in enumerate(points)]) < 1
    with pytest.raises(
        GeometryError, match="nothing gives the model its scale; Of the scale bars, 3 - 98 is not"
    ):
        bar = '[[scale_bar]]\nfrom = "3"\nto = "98"\nlength = 1.0\nsigma = 0.1\n'
        refine(tmp_path / "model", tmp_path, out=tmp_path / "again", survey=_survey(tmp_path, bar))
    assert not (tmp_path / "again").exists()


def test_photographs_of_another_object_are_reported(tmp_path: Path) -> None:
    scene = _model(tmp_path)
    grey = np.full(SIZE[::-1], 90, np.uint8)
    for i in range(PHOTOGRAPHS):
        cv2.imwrite(str(tmp_path / f"{'ab'[i % 2]}/{i}.png"), grey)
    with pytest.raises(
        GeometryError,
        match=r"0 of 246 .*180 flat texture, 60 template of .*, 6 of a point .*are these the photographs",
    ):
        refine(tmp_path / "model", tmp_path)
    for j in list(scene.point3D_ids()):
        for i in (AWAY + 2, AWAY + 3):
            for slot, point in enumerate(scene.image(i).points2D):
                if point.point3D_id == j:
                    scene.delete_observation(i, slot)
    scene.write_binary(str(tmp_path / "model"))
    with pytest.raises(GeometryError, match="no point of the model in 3 oriented photographs"):
        refine(tmp_path / "model", tmp_path)
    assert not (tmp_path / "model_refined").exists()


def test_the_mapper_goes_on_from_a_refined_model(tmp_path: Path) -> None:
    """Three photographs are refined, COLMAP registers the fourth; what was measured anew stays."""
    pictures, truth = _scene()
    rng = np.random.default_rng(12)
    m, n = PHOTOGRAPHS, len(truth.points)
    seen = [project(truth.cameras[0], truth.position[i], truth.rotation[i], truth.points) for i in range(m)]
    xy = np.concatenate(seen) + rng.normal(0, NOISE_PX, (m * n, 2))
    for i, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"{i}.png"), picture)
    image, point = np.repeat(np.arange(m), n), np.tile(np.arange(n), m)
    network = Network(
        tuple(f"{i}.png" for i in range(m)),
        np.zeros(m, dtype=np.int64),
        tuple(str(j) for j in range(n)),
        ImagePoints(image, point, xy, np.tile(np.eye(2), (m * n, 1, 1))),
    )
    write_database(tmp_path / "scene.db", network, truth.cameras)
    position = truth.position.copy()
    position[-1] = np.nan
    write_model(tmp_path / "model", network, replace(truth, position=position))
    refine(tmp_path / "model", tmp_path, out=tmp_path / "out", fix="f,cx,cy")
    before = pycolmap.Reconstruction(str(tmp_path / "out"))
    assert before.num_reg_images() == m - 1
    options = pycolmap.IncrementalPipelineOptions(min_model_size=2, multiple_models=False)
    options.mapper.abs_pose_min_num_inliers = 15
    (tmp_path / "more").mkdir()
    models = pycolmap.incremental_mapping(
        str(tmp_path / "scene.db"),
        str(tmp_path),
        str(tmp_path / "more"),
        options=options,
        input_path=str(tmp_path / "out"),
    )
    after = models[0]
    assert after.num_reg_images() == m
    for i in range(1, m):
        assert (_key_points(after, i) == _key_points(before, i)).all()
    more = pycolmap.triangulate_points(
        before, str(tmp_path / "scene.db"), str(tmp_path), str(tmp_path / "more"), clear_points=False
    )
    assert more.num_points3D() >= 0.9 * n and (_key_points(more, 1) == _key_points(after, 1)).all()
