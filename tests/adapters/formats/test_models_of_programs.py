"""Models of OpenSfM, nerfstudio, Bundler, VisualSFM, AliceVision and OpenMVG, read and written.

Each program's projection is written here again in a few lines from its documentation; what is read must have
the residuals that it states. Files of the programs themselves lie in ../shared/data/formats, if at all.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adapters.formats.content import KINDS, Content, losses
from adapters.formats.registry import (
    describe_stored,
    format_named,
    format_of,
    losses_in_words,
    read_content,
    write_content,
)
from adapters.formats.stated_model import numbers_of_slots
from sfm.cli.commands.convert import convert
from sfm.comparison.solutions import reprojection
from sfm.model.camera import Camera, pixel_from_tangents
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.network import Network
from sfm.model.reduced_network import reduce_network
from sfm.model.solution import Solution
from tests.places import SHARED
from tests.rigs import make_rig
from tests.synthetic import make_network, seed_of

FORMATS = SHARED / "data" / "formats"
Residuals = dict[tuple[str, str], np.ndarray]  # computed minus measured, px, by photograph and point

# --- the projections of the programs themselves ---


def perspective(a: float, b: float, k: list[float], t: list[float]) -> np.ndarray:
    """Radial and tangential distortion as OpenSfM, AliceVision and OpenMVG write it."""
    r2 = a * a + b * b
    s = 1 + sum(value * r2 ** (i + 1) for i, value in enumerate(k))
    t1, t2 = t or (0.0, 0.0)
    return np.array(
        [s * a + 2 * t1 * a * b + t2 * (r2 + 2 * a * a), s * b + 2 * t2 * a * b + t1 * (r2 + 2 * b * b)]
    )


def equidistant(a: float, b: float, k: list[float]) -> np.ndarray:
    r = np.hypot(a, b)
    theta = np.arctan(r)
    return theta * (1 + sum(v * theta ** (2 * i + 2) for i, v in enumerate(k))) / r * np.array([a, b])


def of_opensfm(path: Path) -> Residuals:
    """In parts of the longer side, from the middle."""
    part = json.loads((path / "reconstruction.json").read_text())[0]
    residuals = {}
    for line in (path / "tracks.csv").read_text().splitlines()[1:]:
        image, track, _, x, y, *_ = line.split("\t")
        if image not in part["shots"] or track not in part["points"]:
            continue
        shot = part["shots"][image]
        camera = part["cameras"][shot["camera"]]
        X = np.array(part["points"][track]["coordinates"])
        P = Rotation.from_rotvec(shot["rotation"]).apply(X) + shot["translation"]
        a, b = P[:2] / P[2]
        kind, c = camera["projection_type"], camera
        if kind == "perspective":
            uv = c["focal"] * perspective(a, b, [c["k1"], c["k2"]], [])
        elif kind == "brown":
            uv = perspective(a, b, [c["k1"], c["k2"], c["k3"]], [c["p1"], c["p2"]])
            uv = uv * [c["focal_x"], c["focal_y"]] + [c["c_x"], c["c_y"]]
        else:
            assert kind == "fisheye_opencv"
            uv = equidistant(a, b, [c[f"k{i}"] for i in (1, 2, 3, 4)])
            uv = uv * [c["focal_x"], c["focal_y"]] + [c["c_x"], c["c_y"]]
        residuals[image, f"u{track}"] = (uv - [float(x), float(y)]) * max(c["width"], c["height"])
    return residuals


def of_bundler(path: Path) -> Residuals:
    """From the middle of the photograph, y up."""
    file = path / "bundle.out" if path.is_dir() else path
    words = iter(" ".join(file.read_text().splitlines()[1:]).split())
    numbers = lambda count: np.array([float(next(words)) for _ in range(count)])  # noqa: E731
    m, n = (int(v) for v in numbers(2))
    cameras = [numbers(15) for _ in range(m)]
    names = (path / "list.txt").read_text().splitlines() if path.is_dir() else [f"{i}" for i in range(m)]
    residuals = {}
    for j in range(n):
        X = numbers(6)[:3]
        for _ in range(int(numbers(1)[0])):
            i, _, x, y = numbers(4)
            f, k1, k2, *pose = cameras[int(i)]
            P = np.reshape(pose[:9], (3, 3)) @ X + pose[9:]
            p = -P[:2] / P[2]
            d = f * (1 + k1 * p @ p + k2 * (p @ p) ** 2) * p - [x, y]
            residuals[names[int(i)], f"u{j}"] = d * (1, -1)
    return residuals


def of_nvm(path: Path) -> Residuals:
    """VisualSFM corrects the point measured from the principal point; COLMAP counts from the corner."""
    lines = [line for line in path.read_text().splitlines() if line.strip()]
    m = int(lines[1])
    cameras = [line.rsplit(maxsplit=10) for line in lines[2 : 2 + m]]
    residuals: Residuals = {}
    n = int(lines[2 + m])
    rows = [line.split() for line in lines[3 + m : 3 + m + n]]
    corner = min(min(map(float, (row[at], row[at + 1]))) for row in rows for at in range(9, len(row), 4)) >= 0
    for j, row in enumerate(rows):
        for at in range(7, len(row), 4):
            name, *values = cameras[int(row[at])]
            f, *q = map(float, values[:5])
            R = Rotation.from_quat(q, scalar_first=True)
            P = R.apply(np.array(row[:3], dtype=float) - np.array(values[5:8], dtype=float))
            p, r = P[:2] / P[2], float(values[8])
            xy = np.array([float(row[at + 2]), float(row[at + 3])])
            if corner:  # the middle of the photographs of the castle
                d = f * p * (1 - r * p @ p) + np.array([1416, 1064]) - xy
            else:  # the measured point whose correction is the computed one
                measured = f * p
                for _ in range(100):
                    measured = f * p / (1 + r * measured @ measured / f**2)
                d = measured - xy
            residuals[name.replace('"', " "), f"u{j}"] = d
    return residuals


def of_alicevision(path: Path) -> Residuals:
    scene = json.loads(path.read_text())
    intrinsics = {entry["intrinsicId"]: entry for entry in scene["intrinsics"]}
    poses = {entry["poseId"]: entry["pose"]["transform"] for entry in scene["poses"]}
    views = {entry["viewId"]: entry for entry in scene["views"]}
    number = lambda values: np.array(values, dtype=float)  # noqa: E731
    residuals = {}
    for point in scene["structure"]:
        for seen in point["observations"]:
            view = views[seen["observationId"]]
            c, pose = intrinsics[view["intrinsicId"]], poses[view["poseId"]]
            R = number(pose["rotation"]).reshape(3, 3, order="F")
            P = R @ (number(point["X"]) - number(pose["center"]))
            size = number([c["width"], c["height"]])
            fx = float(c["focalLength"]) / float(c["sensorWidth"]) * size[0]
            focal = np.array([fx, fx * float(c["pixelRatio"])])
            k = list(map(float, c["distortionParams"]))
            a, b = P[:2] / P[2]
            lens = c["distortionType"]
            ab = equidistant(a, b, k) if lens == "fisheye4" else perspective(a, b, k[:3], k[3:])
            xy = focal * ab + size / 2 + number(c["principalPoint"])
            residuals[view["path"], f"u{point['landmarkId']}"] = xy - number(seen["x"])
    return residuals


def of_openmvg(path: Path) -> Residuals:
    scene = json.loads(path.read_text())
    data = lambda entry: entry["value"]["ptr_wrapper"]["data"]  # noqa: E731
    intrinsics = {entry["key"]: data(entry) for entry in scene["intrinsics"]}
    poses = {entry["key"]: entry["value"] for entry in scene["extrinsics"]}
    views = {entry["key"]: data(entry) for entry in scene["views"]}
    residuals = {}
    for point in scene["structure"]:
        for seen in point["value"]["observations"]:
            view = views[seen["key"]]
            c, pose = intrinsics[view["id_intrinsic"]], poses[view["id_pose"]]
            P = np.array(pose["rotation"]) @ (np.array(point["value"]["X"]) - pose["center"])
            a, b = P[:2] / P[2]
            if "fisheye" in c:
                ab = equidistant(a, b, c["fisheye"])
            else:
                k = c.get("disto_t2") or c["disto_k3"]
                ab = perspective(a, b, k[:3], k[3:])
            xy = c["focal_length"] * ab + c["principal_point"]
            residuals[view["filename"], f"u{point['key']}"] = xy - np.array(seen["value"]["x"])
    return residuals


OWN: dict[str, Callable[[Path], Residuals]] = {
    "opensfm": of_opensfm,
    "bundler": of_bundler,
    "nvm": of_nvm,
    "alicevision": of_alicevision,
    "openmvg": of_openmvg,
}
LENSES = {
    "opensfm": ("opencv", "radial", "opencv_fisheye", "full_opencv"),
    "nerfstudio": ("opencv", "opencv_fisheye", "full_opencv", "brown_forward_affine"),
    "bundler": ("radial",),
    "nvm": ("brown",),
    "alicevision": ("opencv", "opencv_fisheye", "full_opencv"),
    "openmvg": ("brown_forward", "opencv_fisheye"),
}
NAMES = tuple(LENSES)

# --- random models ---


def kept(form: str, camera: Camera) -> Camera:
    """The camera without what a format cannot hold."""
    p = dict(zip(camera.names, camera.parameters, strict=True))
    for name in format_named(form).lacks if not camera.wide_angle else ():
        p |= {name: 0.0} if name in p else {}
    if form == "openmvg" and "fy" in p:
        p["fy"] = p["fx"]
    elif "fy" in p:
        p["fy"] *= 1.001
    return camera.with_parameters(np.array(list(p.values())))


def random_model(form: str, seed: str) -> Content:
    """A network of one to three cameras with distortion, and image points with noise."""
    rng = seed_of(f"{form} {seed}")
    lenses = LENSES[form]
    model = lenses[int(rng.integers(len(lenses)))]
    network, truth = make_network(
        rng,
        images=int(rng.integers(3, 8)),
        points=int(rng.integers(9, 30)),
        model=model,
        noise_px=0.3,
        cameras=int(rng.integers(1, 4)),
        visibility=0.8,
        free=(),
    )
    truth = replace(truth, cameras=tuple(kept(form, camera) for camera in truth.cameras))
    xy = network.image_points.xy + reprojection(network, truth)  # as these cameras see the points
    seen = replace(
        network.image_points,
        xy=xy + rng.normal(0, 0.3, xy.shape),
        covariance=np.tile(np.eye(2), (len(xy), 1, 1)),
        stated=np.zeros(len(xy), dtype=bool),
    )
    images = tuple(f"flight {i}/DSC {i:04d} ü.jpg" for i in range(len(network.images)))
    return Content(Solution(form, replace(network, images=images, image_points=seen), truth))


def written(content: Content, form: str, folder: Path) -> Path:
    path = folder / {"alicevision": "m.sfm", "nvm": "m.nvm"}.get(form, "m")
    write_content(path, form, content)
    return path


def by_names(network: Network, values: np.ndarray) -> Residuals:
    seen = network.image_points
    return {
        (network.images[i], network.points[j]): value
        for i, j, value in zip(seen.image, seen.point, values, strict=True)
    }


def assert_own_residuals(path: Path, own: Callable[[Path], Residuals]) -> float:
    """Compare the residuals of what is read with those of the program, and return their RMS per point."""
    content = read_content(path)
    network, estimate = content.result.network, content.result.estimate
    ours = by_names(network, reprojection(network, estimate))
    theirs = own(path)
    short = {name.rsplit("/", 1)[-1]: name for name in network.images}
    theirs = {(image if image in network.images else short[image], j): d for (image, j), d in theirs.items()}
    assert set(theirs) == set(ours) and len(ours) > 20
    for key, d in theirs.items():
        np.testing.assert_allclose(ours[key], d, atol=1e-6)
    return float(np.sqrt(np.mean([d @ d for d in theirs.values()])))


@pytest.mark.parametrize("form", [name for name in NAMES if name in OWN])
@pytest.mark.parametrize("seed", ["a", "b", "c", "d", "e"])
def test_residuals_are_those_of_the_program(form: str, seed: str, tmp_path: Path) -> None:
    content = random_model(form, seed)
    path = written(content, form, tmp_path)
    rms = assert_own_residuals(path, OWN[form])
    v = reprojection(content.result.network, content.result.estimate)
    assert rms == pytest.approx(np.sqrt((v**2).sum(axis=1).mean()), abs=1e-6)


# --- files of the programs themselves ---


def own_file(name: str) -> Path:
    path = FORMATS / name
    if not path.exists():
        pytest.skip("files of other programs are not beside the repository")
    return path


def test_opensfm_of_berlin(tmp_path: Path) -> None:
    folder = tmp_path / "project" / "opensfm"  # as in a project of OpenDroneMap
    folder.mkdir(parents=True)
    for name in ("reconstruction", "tracks"):
        (source,) = own_file("opensfm").glob(f"{name}_example.*")
        shutil.copyfile(source, folder / f"{name}{source.suffix}")
    assert_own_residuals(folder, of_opensfm)
    content = read_content(tmp_path / "project")
    assert format_of(tmp_path / "project").name == format_of(folder / "reconstruction.json").name == "opensfm"
    network = content.result.network
    assert (len(network.images), len(network.points), len(network.image_points)) == (3, 1430, 3082)
    assert content.notes[-1].startswith("137 image points of tracks.csv left out")


def test_bundler_of_kermit() -> None:
    path = own_file("bundle-kermit.out")
    rms = assert_own_residuals(path, of_bundler)
    assert rms == pytest.approx(0.4931541, abs=1e-6)
    content = read_content(path)
    assert content.notes == ("2 photographs without orientation left out",)


def test_nvm_of_the_castle() -> None:
    """COLMAP's dialect: the middle of the photographs, which the file does not state, is found exactly."""
    path = own_file("visualsfm.nvm")
    assert assert_own_residuals(path, of_nvm) == pytest.approx(0.7808, abs=1e-3)
    cameras = read_content(path).result.estimate.cameras
    assert {camera.size_px for camera in cameras} == {(2832, 2128)}


def test_transforms_of_the_fox() -> None:
    path = own_file("transforms-fox.json")
    result = read_content(path).result
    assert (len(result.network.images), len(result.network.points)) == (67, 0)
    frames = json.loads(path.read_text())["frames"]
    T = np.array([frame["transform_matrix"] for frame in frames])
    np.testing.assert_allclose(result.estimate.position, T[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(result.estimate.rotation, T[:, :3, :3], atol=1e-6)
    assert result.estimate.cameras[0].value("cx") == pytest.approx(554.558 - 0.5)


# --- round trips ---


def parts_of(content: Content, images: bool, points: bool, *, posed: bool = True) -> Content:
    """A model without photographs, points, or poses."""
    network, estimate = content.result.network, content.result.estimate
    m, n = len(network.images), len(network.points)
    every = np.ones(len(network.image_points), dtype=bool)
    network, estimate = reduce_network(network, estimate, np.full(m, images), np.full(n, points), every)
    if not posed:
        estimate = replace(estimate, position=np.full((m, 3), np.nan), rotation=np.full((m, 3, 3), np.nan))
    return Content(replace(content.result, network=network, estimate=estimate))


def assert_same(before: Solution, after: Solution, form: str) -> None:
    a, b = before.estimate, after.estimate
    keeps = format_named(form).keeps
    np.testing.assert_allclose(b.position, a.position[a.oriented], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(b.rotation, a.rotation[a.oriented], atol=1e-12)
    assert after.network.images == tuple(
        n for n, on in zip(before.network.images, a.oriented, strict=True) if on
    )
    if "object points" in keeps:
        np.testing.assert_allclose(b.points, a.points[a.determined], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("form", NAMES)
@pytest.mark.parametrize("seed", [f"round {k}" for k in range(6)])
def test_round_trip(form: str, seed: str, tmp_path: Path) -> None:
    """Cameras, poses, points and image points: nothing is lost that is not named."""
    content = random_model(form, seed)
    path = written(content, form, tmp_path)
    again = read_content(path, form)
    before, after = content.result, again.result
    assert_same(before, after, form)
    named = {kind.name for kind, _ in losses(content, format_named(form).held(content))}
    assert named <= {"point names", "object points", "image points"}
    if form == "nerfstudio":
        assert named == {"point names", "object points", "image points"}
    else:
        numbered = replace(before.network, points=tuple(f"u{j}" for j in range(len(before.network.points))))
        v = by_names(numbered, reprojection(before.network, before.estimate))
        w = by_names(after.network, reprojection(after.network, after.estimate))
        assert set(v) == set(w)
        for key, residual in v.items():
            np.testing.assert_allclose(w[key], residual, atol=1e-8)
    for i, a in enumerate(before.network.camera):
        lens, other = before.estimate.cameras[a], after.estimate.cameras[after.network.camera[i]]
        uv = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 7), np.linspace(-0.3, 0.3, 7)), axis=-1).reshape(
            -1, 2
        )
        here, there = pixel_from_tangents(lens, uv), pixel_from_tangents(other, uv)
        if form in ("bundler", "nvm"):  # they state no size, and count from the principal point
            here, there = here - lens.principal_point_px, there - other.principal_point_px
        else:
            assert other.size_px == lens.size_px
        np.testing.assert_allclose(there, here, atol=1e-8)


@pytest.mark.parametrize("form", (*NAMES, "colmap", "tables", "metashape"))
@pytest.mark.parametrize("images,points", [(True, False), (False, True), (False, False)])
def test_parts_alone(form: str, images: bool, points: bool, tmp_path: Path) -> None:
    """Poses alone, points alone, cameras alone are written and read; what lacks is said."""
    if form in ("colmap", "tables", "metashape"):
        lens = {"tables": "brown"}.get(form, "opencv")
        network, truth = make_network(seed_of("parts"), images=4, points=9, model=lens, free=())
        content = Content(Solution("x", network, truth))
    else:
        content = random_model(form, "parts")
    part = parts_of(content, images, points)
    path = tmp_path / "m.xml" if form == "metashape" else tmp_path / "m"
    if form in ("bundler", "nvm") and not (images or points):  # they have cameras of photographs only
        with pytest.raises(
            OutputError, match="stores nothing of this survey, in which there is cameras only"
        ):
            write_content(path, form, part)
        return
    if form == "nerfstudio" and not images:
        cameras = part.result.estimate.cameras
        if len(cameras) > 1:
            with pytest.raises(OutputError, match="without photographs has one camera, not"):
                write_content(path, form, part)
        part = replace(
            part, result=replace(part.result, estimate=replace(part.result.estimate, cameras=cameras[:1]))
        )
        write_content(path, form, part)
        named = losses_in_words(form, part)
        assert not points or any("coordinates of points" in words for words in named)
        assert len(read_content(path, form).result.network.points) == 0
        return
    write_content(path, form, part)
    again = read_content(path, form).result
    if form != "metashape":
        assert_same(part.result, again, form)
    assert len(again.network.images) == (len(part.result.network.images) if images else 0)
    assert len(again.network.points) == (len(part.result.network.points) if points else 0)
    if form not in ("bundler", "nvm"):
        assert len(again.estimate.cameras) == len(part.result.estimate.cameras)


def test_without_poses_only_points_are_written(tmp_path: Path) -> None:
    content = random_model("opensfm", "no poses")
    part = parts_of(content, True, True, posed=False)
    named = losses_in_words("opensfm", part)
    assert any("photographs and points without coordinates" in words for words in named)
    again = read_content(written(part, "opensfm", tmp_path)).result
    assert (len(again.network.images), len(again.network.points)) == (0, len(part.result.network.points))
    assert describe_stored("opensfm", part.result.network, part.result.estimate).startswith("0 photographs, ")
    none = parts_of(content, True, False, posed=False)
    with pytest.raises(OutputError, match="no photograph and no point has coordinates"):
        write_content(tmp_path / "none", "opensfm", none)


@pytest.mark.parametrize("form", NAMES)
def test_convert_from_one_program_to_another(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By content alone, to COLMAP and to this program; cameras of other models are fitted, and it is said."""
    path = written(random_model(form, "convert"), form, tmp_path)
    convert(path, tmp_path / "colmap", to_format="colmap")
    convert(tmp_path / "colmap", tmp_path / "back", to_format=form)
    told = capsys.readouterr().out
    assert "as colmap" in told and f"as {form}" in told
    a, b = read_content(path, form).result, read_content(tmp_path / "back", form).result
    np.testing.assert_allclose(b.estimate.position, a.estimate.position, rtol=1e-9, atol=1e-12)


def test_a_lens_with_two_focal_lengths_is_named_where_there_is_one(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("two focal"), images=4, points=9, model="opencv_fisheye", free=())
    camera = truth.cameras[0]
    other = camera.parameters * np.where([name == "fy" for name in camera.names], 1.001, 1.0)
    truth = replace(truth, cameras=(camera.with_parameters(other),))
    with pytest.raises(Exception, match="format openmvg cannot store fx other than fy of opencv_fisheye"):
        write_content(tmp_path / "m", "openmvg", Content(Solution("x", network, truth)))


# --- further shapes of the files ---


def test_rigs_of_opensfm_and_alicevision_have_poses(tmp_path: Path) -> None:
    """A photograph with the pose of its rig only: x = R_camera (R_rig X + t_rig) + t_camera."""
    path = written(random_model("opensfm", "rig"), "opensfm", tmp_path)
    file = path / "reconstruction.json"
    plain = read_content(path).result.estimate
    (part,) = json.loads(file.read_text())
    name, shot = next(iter(part["shots"].items()))
    R = Rotation.from_rotvec([0.1, -0.2, 0.3])
    t = np.array([0.5, 0.1, -0.2])
    rig = R.inv() * Rotation.from_rotvec(shot["rotation"])
    part["rig_cameras"] = {"left": {"rotation": R.as_rotvec().tolist(), "translation": t.tolist()}}
    part["rig_instances"] = {
        "7": {
            "rotation": rig.as_rotvec().tolist(),
            "translation": R.inv().apply(np.array(shot["translation"]) - t).tolist(),
            "rig_camera_ids": {name: "left"},
        }
    }
    del shot["rotation"], shot["translation"]
    file.write_text(json.dumps([part]))
    rigged = read_content(path).result.estimate
    np.testing.assert_allclose(rigged.position, plain.position, atol=1e-12)
    np.testing.assert_allclose(rigged.rotation, plain.rotation, atol=1e-12)

    scene_path = written(random_model("alicevision", "rig"), "alicevision", tmp_path)
    plain = read_content(scene_path).result.estimate
    scene = json.loads(scene_path.read_text())
    pose = scene["poses"][0]["pose"]["transform"]
    R_view = np.array(pose["rotation"], dtype=float).reshape(3, 3).T
    R_sub, centre_sub = R.as_matrix(), np.array([0.2, 0.0, 0.1])
    R_rig = R_sub.T @ R_view
    centre_rig = np.array(pose["center"], dtype=float) - R_rig.T @ centre_sub
    pose |= {"rotation": [str(v) for v in R_rig.T.ravel()], "center": [str(v) for v in centre_rig]}
    sub = {"rotation": [str(v) for v in R_sub.T.ravel()], "center": [str(v) for v in centre_sub]}
    scene["rigs"] = [{"rigId": "5", "subPoses": [{"status": "estimated", "pose": sub}]}]
    scene["views"][0] |= {"rigId": "5", "subPoseId": "0", "isPoseIndependant": "false"}
    scene_path.write_text(json.dumps(scene))
    rigged = read_content(scene_path).result.estimate
    np.testing.assert_allclose(rigged.position, plain.position, atol=1e-12)


def rigged_model(name: str, *, cameras: int) -> Content:
    """A rig of some cameras in a lens model that the formats have, and one photograph of a camera alone."""
    network, truth = make_rig(seed_of(name), cameras=cameras, moments=4)
    lens = make_network(seed_of(name), model="opencv", free=())[1].cameras[0]
    of_rig = tuple(replace(lens, name=camera.name) for camera in truth.cameras)
    moment = network.moment.copy()
    moment[-1] = moment.max() + 1  # one photograph without companions of its moment
    points = tuple(f"u{j}" for j in range(len(network.points)))
    return Content(
        Solution(
            "rig",
            replace(network, moment=moment, points=points),
            replace(truth, cameras=of_rig),
            points_named=False,
        )
    )


@pytest.mark.parametrize("form", ["colmap", "opensfm", "alicevision", "tables"])
@pytest.mark.parametrize("cameras", [2, 3])
def test_rigs_are_read_as_they_are_written(form: str, cameras: int, tmp_path: Path) -> None:
    content = rigged_model(f"round trip {cameras}", cameras=cameras)
    write_content(tmp_path / "rig", form, content)
    again = read_content(tmp_path / "rig", form)
    before, after = content.result, again.result
    first, second = before.estimate.mounts, after.estimate.mounts
    assert first is not None and second is not None
    for kind in KINDS:
        if kind.name in ("rigs", "moments"):
            assert (
                kind.name in format_named(form).keeps and len(kind.rows(content)) == len(kind.rows(again)) > 0
            )
            np.testing.assert_allclose(kind.rows(again), kind.rows(content), atol=1e-12)
    assert after.network.moment is not None and before.network.moment is not None
    together = before.network.moment[:, None] == before.network.moment
    np.testing.assert_array_equal(after.network.moment[:, None] == after.network.moment, together)
    np.testing.assert_allclose(after.estimate.position, before.estimate.position, atol=1e-12)
    np.testing.assert_allclose(after.estimate.rotation, before.estimate.rotation, atol=1e-12)
    lost = {kind.name for kind, _ in losses(content, format_named(form).held(content))}
    assert ("rig names" in lost) == (form in ("opensfm", "alicevision"))


def test_a_camera_at_two_places_of_a_rig_is_one_at_each(tmp_path: Path) -> None:
    """OpenSfM's rigs may share the interior orientation of their cameras."""
    content = rigged_model("one lens", cameras=2)
    write_content(tmp_path / "rig", "opensfm", content)
    file = tmp_path / "rig" / "reconstruction.json"
    (part,) = json.loads(file.read_text())
    first, second = part["cameras"]
    for shot in part["shots"].values():
        shot["camera"] = first
    del part["cameras"][second]
    file.write_text(json.dumps([part]))
    result = read_content(tmp_path / "rig").result
    cameras, mounts = result.estimate.cameras, result.estimate.mounts
    assert [camera.shared_name for camera in cameras] == [first, first] and mounts is not None
    assert {camera.name for camera in cameras} == {f"{first} {first}", f"{first} {second}"}
    np.testing.assert_array_equal(result.network.camera, content.result.network.camera)
    np.testing.assert_allclose(mounts.position, content.result.estimate.mounts.position, atol=1e-12)


def test_a_rig_with_two_photographs_at_one_place_and_moment_is_refused(tmp_path: Path) -> None:
    write_content(tmp_path / "rig", "opensfm", rigged_model("twice", cameras=2))
    file = tmp_path / "rig" / "reconstruction.json"
    (part,) = json.loads(file.read_text())
    ids = part["rig_instances"]["0"]["rig_camera_ids"]
    ids |= {next(iter(part["rig_instances"]["1"]["rig_camera_ids"])): next(iter(ids.values()))}
    del part["rig_instances"]["1"]
    file.write_text(json.dumps([part]))
    with pytest.raises(SurveyFileError, match=r"rigs: photographs .* are of one moment; needed different"):
        read_content(tmp_path / "rig")


def test_older_scenes_of_alicevision(tmp_path: Path) -> None:
    """Before 1.2.5 the ratio is of the focal lengths; before distortionType the type names the lens."""
    path = written(random_model("alicevision", "old"), "alicevision", tmp_path)
    scene = json.loads(path.read_text())
    intrinsic = scene["intrinsics"][0]
    ratio = float(intrinsic["pixelRatio"])
    scene["version"] = ["1", "2", "3"]
    intrinsic |= {
        "type": "radial3",
        "pixelRatio": str(1 / ratio),
        "distortionParams": ["0.1", "-0.2", "0.05"],
    }
    del intrinsic["distortionType"]
    scene["views"][0]["path"] = "B:/PG/photos south/IMG 1.jpg"
    scene["views"][1]["path"] = "B:\\PG\\photos south\\IMG 2.jpg"
    path.write_text(json.dumps(scene))
    result = read_content(path).result
    camera = result.estimate.cameras[0]
    assert camera.value("fy") / camera.value("fx") == pytest.approx(ratio)
    assert [camera.value(name) for name in ("k1", "k2", "k3", "p1")] == [0.1, -0.2, 0.05, 0.0]
    assert result.network.images[:2] == ("IMG 1.jpg", "IMG 2.jpg")
    # Meshroom 2021: one focal length in px, the principal point from the corner
    scene["version"] = ["1", "0", "0"]
    for every in scene["intrinsics"]:
        every |= {"pxFocalLength": "1900", "principalPoint": ["1003", "748"]}
    path.write_text(json.dumps(scene))
    camera = read_content(path).result.estimate.cameras[0]
    assert [camera.value(name) for name in ("fx", "fy", "cx", "cy")] == pytest.approx([1900, 1900, 1003, 748])
    for wrong in ("0", "-3", "nan"):
        intrinsic["pxFocalLength"] = wrong
        path.write_text(json.dumps(scene))
        assert assert_one_line(path, "alicevision")


def test_older_scenes_of_openmvg(tmp_path: Path) -> None:
    """The plane below value0, one coefficient, folders, views without camera or pose."""
    path = written(random_model("openmvg", "old"), "openmvg", tmp_path)
    scene = json.loads(path.read_text())
    data = scene["intrinsics"][0]["value"]["ptr_wrapper"]["data"]
    plane = {name: data.pop(name) for name in ("width", "height", "focal_length", "principal_point")}
    data.clear()
    data |= {"value0": plane, "disto_k1": [0.07]}
    views = [view["value"]["ptr_wrapper"]["data"] for view in scene["views"]]
    views[0]["id_pose"], views[1]["id_intrinsic"] = 2**32 - 1, 2**32 - 1
    path.write_text(json.dumps(scene))
    content = read_content(path)
    camera = content.result.estimate.cameras[0]
    assert camera.value("K1") * camera.value("c") ** 2 == pytest.approx(0.07)
    assert len(content.result.network.images) == len(views) - 1
    assert not content.result.estimate.oriented[0] and content.notes == ("1 views without a camera left out",)


def test_transforms_of_frames_and_before_their_transformation(tmp_path: Path) -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.3, 0.2, -0.4]).as_matrix(), [1.0, 2.0, 3.0]
    A = np.array([[1.0, 0, 0, 0.5], [0, 0, 1, 0.0], [0, -1, 0, 0]])
    applied = np.vstack([A, [0, 0, 0, 1]]) @ T
    applied[:3, 3] *= 2
    frame = {"file_path": "./images/1.png", "transform_matrix": applied.tolist()}
    size = {"w": 400, "h": 300}
    file = tmp_path / "transforms.json"
    file.write_text(
        json.dumps(
            {
                "camera_model": "SIMPLE_PINHOLE",
                "applied_transform": A.tolist(),
                "applied_scale": 2,
                "frames": [
                    frame | size | {"fl_x": 350.0},
                    frame | size | {"camera_angle_x": 2 * np.arctan(0.5), "file_path": "images/2"},
                ],
            }
        )
    )
    content = read_content(file)
    estimate = content.result.estimate
    np.testing.assert_allclose(estimate.position, [T[:3, 3]] * 2, atol=1e-12)
    np.testing.assert_allclose(estimate.rotation, [T[:3, :3]] * 2, atol=1e-12)
    assert content.result.network.images == ("images/1.png", "images/2")
    assert [camera.value("fx") for camera in estimate.cameras] == pytest.approx([350.0, 400.0])
    assert content.notes == ("coordinates are those before applied_transform and applied_scale",)


def test_points_that_a_photograph_shows_twice_are_read_once(tmp_path: Path) -> None:
    path = written(random_model("bundler", "twice"), "bundler", tmp_path)
    lines = (path / "bundle.out").read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if len(line.split()) > 9 and k > 5)
    count, *views = lines[at].split()
    m = int(lines[1].split()[0])
    if int(count) < m:
        lines[at] = " ".join([f"{int(count) + 1}", *views, *views[:4]])
        (path / "bundle.out").write_text("\n".join(lines) + "\n")
        content = read_content(path)
        assert content.notes == ("1 image point of points that their photograph shows twice left out",)


def test_slots_number_the_image_points_of_each_photograph() -> None:
    assert numbers_of_slots(np.array([2, 0, 2, 1, 0, 2])).tolist() == [0, 0, 1, 0, 1, 2]
    assert numbers_of_slots(np.zeros(0, dtype=np.int64)).tolist() == []


# --- damaged and hostile files ---

STRANGE: tuple[Any, ...] = (
    *(None, "x", "", [], {}, [[]], True, -1, 0, "NaN", float("nan"), "1e999", 10**30, "../../etc/passwd"),
    *("a\x1b[2J", "x" * 2000, [1, 2], {"a": 1}, "4294967295", "/", ".", "\\"),
)


def places_in(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    below = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [path, *(place for key, value in below for place in places_in(value, (*path, key)))]


def assert_one_line(path: Path, form: str) -> bool:
    """Read a file; a refusal is one clear line that begins with the file."""
    try:
        read_content(path, form)
    except SurveyFileError as error:
        assert str(error).startswith(str(path)) and "\n" not in str(error) and "\x1b" not in str(error)
        assert len(str(error)) < 600
        return True
    return False


@pytest.mark.parametrize("form", ["opensfm", "nerfstudio", "alicevision", "openmvg"])
def test_damaged_json_ends_in_one_line(form: str, tmp_path: Path) -> None:
    content = random_model(form, "damage")
    path = written(content, form, tmp_path)
    file = path / "reconstruction.json" if path.is_dir() else path
    whole = file.read_text()
    places = [place for place in places_in(json.loads(whole)) if place]
    rng = seed_of(f"damage {form}")
    refused = 0
    for trial in range(250):
        tree = json.loads(whole)
        # every kind of place, not only the many coordinates
        kinds = sorted({tuple(k for k in p if isinstance(k, str)) for p in places})
        kind = kinds[trial % len(kinds)]
        of_kind = [p for p in places if tuple(k for k in p if isinstance(k, str)) == kind]
        *above, key = of_kind[int(rng.integers(len(of_kind)))]
        node = tree
        for step in above:
            node = node[step]
        if trial % 3 == 0:
            del node[key]
        else:
            node[key] = STRANGE[int(rng.integers(len(STRANGE)))]
        file.write_text(json.dumps(tree))
        refused += assert_one_line(path, form)
    assert refused > 60
    for part in (0.0, 0.3, 0.9):
        file.write_text(whole[: int(part * len(whole))])
        assert assert_one_line(path, form)
    for text in ("[" * 100_000, "[]", "{}", "[{}]", "null", "[1]", '{"a": ' * 50_000, "\x00\xff"):
        file.write_text(text)
        assert assert_one_line(path, form)
    file.write_bytes(b"\xff\xfe{}")
    assert assert_one_line(path, form)


@pytest.mark.parametrize("form", ["bundler", "nvm", "opensfm"])
def test_damaged_text_ends_in_one_line(form: str, tmp_path: Path) -> None:
    content = random_model(form, "damage")
    path = written(content, form, tmp_path)
    file = {"bundler": path / "bundle.out", "opensfm": path / "tracks.csv"}.get(form, path)
    whole = file.read_text()
    words = whole.split(" " if form != "opensfm" else "\t")
    rng = seed_of(f"damage {form}")
    refused = 0
    strange = ("nan", "x", "", "-5", "1e999", "99999999999999999999999", "../../x", "1 2", "0", "\x1b[2J")
    for trial in range(150):
        some = list(words)
        at = int(rng.integers(12 if trial % 2 else len(some)))
        some[at] = strange[trial % len(strange)]
        file.write_text((" " if form != "opensfm" else "\t").join(some))
        refused += assert_one_line(path, form)
    assert refused > (10 if form == "opensfm" else 30)  # most columns of tracks.csv are not read
    for part in (0.0, 0.3, 0.9) if form != "opensfm" else ():
        file.write_text(whole[: int(part * len(whole))])
        assert assert_one_line(path, form)


@pytest.mark.parametrize(
    ("form", "change", "message"),
    [
        ("nvm", ("NVM_V3", "NVM_V2"), r"line 1: 'NVM_V2' at the start, needed NVM_V3"),
        ("nvm", ("NVM_V3", "NVM_V3 FixedK 900 500 901 400"), r"line 1: a fixed calibration is read as"),
        ("nvm", ('flight"0/', "../"), r"m.nvm: photograph '\.\./DSC.*': a path that leaves the folder"),
        ("bundler", ("\n5 ", "\n99999999 "), r"too few for|number of cameras"),
    ],
)
def test_what_is_refused_is_named(form: str, change: tuple[str, str], message: str, tmp_path: Path) -> None:
    path = written(random_model(form, "named"), form, tmp_path)
    file = path / "bundle.out" if path.is_dir() else path
    text = file.read_text()
    if form == "bundler":
        lines = text.splitlines(keepends=True)
        lines[1] = "90000 5000000\n"
        file.write_text("".join(lines))
    else:
        assert change[0] in text
        file.write_text(text.replace(*change, 1))
    with pytest.raises(SurveyFileError, match=message):
        read_content(path, form)


@pytest.mark.parametrize(("form", "name"), [("opensfm", "tracks.csv"), ("bundler", "list.txt")])
def test_links_out_of_the_folder_are_refused(form: str, name: str, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret\n" * 20)
    path = written(random_model(form, "links"), form, tmp_path)
    (path / name).unlink()
    (path / name).symlink_to(tmp_path / "secret")
    for source in (path, path / format_named(form).marks[0]):
        with pytest.raises(SurveyFileError, match=f"{name}: a link that leaves its folder"):
            read_content(source)


@pytest.mark.parametrize("name", ["../a.jpg", "a/../../b.jpg", "..\\x.jpg"])
def test_names_stay_below_the_folder_of_the_photographs(name: str, tmp_path: Path) -> None:
    path = written(random_model("nerfstudio", "names"), "nerfstudio", tmp_path)
    tree = json.loads(path.read_text())
    tree["frames"][0]["file_path"] = name
    path.write_text(json.dumps(tree))
    with pytest.raises(SurveyFileError, match="a path that leaves the folder of the photographs"):
        read_content(path)
