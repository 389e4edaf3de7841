"""Photographs that do not fit: zoomed and strange ones; central perspective or fisheye."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.model.camera import Camera, project, tangents_from_pixel
from sfm.model.conventions import FloatArray
from sfm.model.distortion.models import Role
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.reduced_network import reduce_network
from sfm.model.remarks.remark import of_kind
from sfm.model.similarity import fit_similarity
from sfm.orientation.incremental.sequence import Orientation
from sfm.orientation.resection.ransac import resect_robust
from sfm.pipeline import run_survey
from sfm.products.drafting.draft import draft_survey
from sfm.survey.diagnosis import photograph_cameras
from sfm.survey.diagnosis.photograph_cameras import SCALES, TOLERANCE
from sfm.survey.inputs.cameras import start_cameras
from sfm.survey.inputs.measurements import Measurements
from sfm.survey.inputs.settings import AdjustSettings
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.orientation import FISHEYE, orient_survey
from sfm.survey.sources.target_matching import restore_strayed
from tests.findings import findings_of
from tests.survey.faults import planted
from tests.survey.texture_scenes import Plane, upright, wall
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

TAU = AdjustSettings(reject="tau")


def with_zoom(name: str, factors: dict[int, float], *, images: int = 10) -> tuple[Network, Estimate]:
    """Return a network of which some photographs were taken with another c."""
    network, truth = make_network(seed_of(name), images=images, points=60, free=("c",))
    seen, rng = network.image_points, seed_of(f"{name} noise")
    xy = seen.xy.copy()
    for i, factor in factors.items():
        p = truth.cameras[0].parameters.copy()
        p[0] *= factor
        rows = np.flatnonzero(seen.image == i)
        camera = truth.cameras[0].with_parameters(p)
        xy[rows] = project(camera, truth.position[i], truth.rotation[i], truth.points[seen.point[rows]])
        xy[rows] += 0.1 * rng.standard_normal((len(rows), 2))
    return replace(network, image_points=replace(seen, xy=xy)), truth


@pytest.mark.parametrize("factor", [0.98, *(pytest.param(k, marks=pytest.mark.slow) for k in (0.95, 1.1))])
def test_a_zoomed_photograph_gets_its_own_c(factor: float) -> None:
    network, truth = with_zoom(f"zoomed {factor}", {7: factor})
    result = run_survey(survey_of(network, truth, adjust=TAU))
    a = result.adjustment
    assert result.failed == () and a.rejected.sum() <= 3
    # the other photographs' precision, as if the zoom were known
    assert a.sigma0_px == pytest.approx(0.1, rel=0.1)
    own = {camera.name: camera for camera in a.estimate.cameras}
    assert own["synthetic image 8"].value("c") == pytest.approx(factor * 10.0, rel=2e-3)
    assert own["synthetic"].value("c") == pytest.approx(10.0, rel=2e-3)
    (found,) = of_kind(result.remarks, "camera_per_photograph")
    assert found.names("photograph") == ("image 8",) and found.names("parameters")[0] == "c"
    assert found.number("change") == pytest.approx(100 * (factor - 1), abs=0.3)
    assert findings_of(result).verdict.level == "fair"


def test_the_camera_of_a_photograph_follows_the_false_alarm_of_the_survey() -> None:
    """One survey with two levels: a c that differs by 1 % is found, or only makes residuals uneven."""
    network, truth = with_zoom("zoomed little", {7: 0.99})
    for level, expected in ((0.05, "camera_per_photograph"), (1e-9, "photographs_uneven")):
        survey = survey_of(network, truth, adjust={"reject": "tau", "false_alarm": level})
        kinds = {named.kind for named in run_survey(survey).verdict.remarks}
        assert kinds & {"camera_per_photograph", "photographs_uneven"} == {expected}


@pytest.mark.parametrize(("share", "left_out"), [(0.65, True), (0.4, False)])
def test_a_photograph_of_another_state_is_left_out(share: float, left_out: bool) -> None:
    """The larger part of the points lies elsewhere in one photograph: no c explains that."""
    network, truth = with_zoom("moved", {})
    seen, rng = network.image_points, seed_of("moved elsewhere")
    rows = np.flatnonzero(seen.image == 4)
    moved = rows[rng.permutation(len(rows))[: int(share * len(rows))]]
    xy = seen.xy.copy()
    xy[moved] += rng.uniform(10, 40, (len(moved), 2))
    network = replace(network, image_points=replace(seen, xy=xy))
    result = run_survey(survey_of(network, truth, adjust=TAU))
    assert [one.image for one in result.failed] == (["image 5"] if left_out else [])
    kinds = ("photograph_contradicting", "photograph_contradicting")
    assert all(one.reason.kind in kinds for one in result.failed)
    assert not of_kind(result.remarks, "camera_per_photograph")
    assert result.adjustment.sigma0_px == pytest.approx(0.1, rel=0.1)


@pytest.mark.sweep(0)
@pytest.mark.parametrize("number", [215, 219])
def test_a_photograph_with_the_names_of_other_points_is_left_out(number: int) -> None:
    """A per-photograph camera left residuals of 200 px, and was believed; c was -106 %."""
    one = planted("names shifted", number)
    camera = one.start.cameras[0]
    free = tuple(name for name, on in zip(camera.names, camera.free, strict=True) if on)
    result = run_survey(survey_of(one.network, one.start, free=free, adjust=TAU))
    assert len(result.failed) == 1 and result.adjustment.sigma0_px == pytest.approx(0.1, rel=0.1)
    assert result.failed[0].reason.kind in ("photograph_contradicting", "photograph_with_few_fitting")
    assert not of_kind(result.remarks, "camera_per_photograph")


@pytest.mark.parametrize(
    ("kind", "cause"),
    [
        pytest.param("held b1", "held_parameter", marks=pytest.mark.slow),
        ("autofocus", "camera_varies"),
    ],
)
def test_what_all_photographs_share_is_no_camera_of_one(kind: str, cause: str) -> None:
    """A photograph lost points, and another c explained them; what explains all photographs is likelier."""
    one = planted(kind, {"held b1": 7002, "autofocus": 7013}[kind])
    camera = one.start.cameras[0]
    free = tuple(name for name, on in zip(camera.names, camera.free, strict=True) if on)
    result = run_survey(survey_of(one.network, one.start, free=free, adjust=TAU))
    assert len(result.adjustment.estimate.cameras) == 1
    assert not of_kind(result.remarks, "camera_per_photograph")
    assert of_kind(result.remarks, cause)


def test_in_a_large_network_parts_decide_what_all_photographs_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """Above the size that is tested as a whole, as in a smaller one: in both ways."""
    asked = list[int]()
    explained = photograph_cameras._is_explained_otherwise

    def noted(*arguments: Any) -> bool:
        asked.append(int(arguments[5].sum()))
        return explained(*arguments)

    monkeypatch.setattr(photograph_cameras, "_is_explained_otherwise", noted)
    monkeypatch.setattr(photograph_cameras, "MAX_PHOTOGRAPHS", 9)
    monkeypatch.setattr(photograph_cameras, "PART_PHOTOGRAPHS", 8)
    test_what_all_photographs_share_is_no_camera_of_one("autofocus", "camera_varies")
    assert asked and max(asked) <= 8
    asked.clear()
    test_a_zoomed_photograph_gets_its_own_c(0.98)
    assert asked and max(asked) <= 8


def test_nothing_speaks_against_the_camera_of_a_photograph_that_no_part_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The adjustment of a large network has removed it: no other cause is likelier for it."""
    network, truth = with_zoom("removed", {7: 0.95})
    camera = network.camera.copy()
    camera[7] = 1
    lost = np.arange(10) == 7
    position = np.where(lost[:, None], np.nan, truth.position)
    removed = replace(
        truth, position=position, rotation=np.where(lost[:, None, None], np.nan, truth.rotation)
    )
    own = replace(truth, cameras=(*truth.cameras, truth.cameras[0]))
    monkeypatch.setattr(photograph_cameras, "MAX_PHOTOGRAPHS", 8)
    accepted, kept = ~lost[network.image_points.image], np.ones(10, dtype=bool)
    assert not photograph_cameras._explained_otherwise(
        network, removed, replace(network, camera=camera), own, accepted, kept, 0.05
    )


def test_the_tolerance_is_that_of_half_a_step_of_c() -> None:
    largest = []
    for name in ("first", "second", "third"):
        network, truth = make_network(seed_of(f"tolerance {name}"), images=8, points=60)
        seen, camera = network.image_points, truth.cameras[0]
        assert SCALES[1] / SCALES[0] == pytest.approx(1.05, abs=1e-3)
        wrong = camera.with_parameters(np.where(camera.plays(Role.FOCAL), 1.025, 1.0) * camera.parameters)
        for i in range(8):
            rows = np.flatnonzero(seen.image == i)
            uv = tangents_from_pixel(wrong, seen.xy[rows])
            found = resect_robust(uv, truth.points[seen.point[rows]], tolerance=1.0)
            lengths = np.linalg.norm(found.residuals, axis=1) * wrong.c_px
            largest.append(float(lengths.max()) / max(camera.size_px))
    assert TOLERANCE / 2 < max(largest) < TOLERANCE


def test_photographs_that_fit_keep_their_camera() -> None:
    network, truth = with_zoom("fits", {})
    result = run_survey(survey_of(network, truth, adjust=TAU))
    assert len(result.adjustment.estimate.cameras) == 1 and result.failed == ()
    assert not of_kind(result.remarks, "camera_per_photograph")


def test_a_photograph_that_the_adjustment_loses_stays_where_it_was() -> None:
    """A zoom of 3 % was moved out of sight of its points, or 1e140 mm away, and left out without a reason."""
    network, truth = make_network(seed_of("out of sight"), images=4, points=12)
    adjusted = adjust(network, truth, datum=Datum("free"), reject="none")
    for off in (np.nan, 7000.0):
        residuals = adjusted.residuals.copy()
        residuals[network.image_points.image == 2] = off
        lost, all_of_them = replace(adjusted, residuals=residuals), np.ones(12, dtype=bool)
        kept = restore_strayed(truth, lost, all_of_them[:4], all_of_them, tolerance_px=2.0)
        assert np.array_equal(kept.position[2], truth.position[2])
        assert np.array_equal(kept.position[[0, 1, 3]], adjusted.estimate.position[[0, 1, 3]])
        assert kept.oriented.all()


def test_a_photograph_that_takes_no_part_in_an_adjustment_stays_where_it_was() -> None:
    network, truth = make_network(seed_of("too few of its own"), images=4, points=12)
    images, points = np.arange(4) != 1, np.arange(12) != 5
    everything = np.ones(len(network.image_points), dtype=bool)
    part, start = reduce_network(network, truth, images, points, everything)
    adjusted = adjust(part, start, datum=Datum("free"), reject="none")
    kept = restore_strayed(truth, adjusted, images, points, tolerance_px=2.0)
    assert np.array_equal(kept.position[1], truth.position[1])
    assert np.array_equal(kept.points[5], truth.points[5])
    alone = replace(truth, position=np.where(images[:, None], truth.position, np.nan))
    kept = restore_strayed(alone, adjusted, images, points, tolerance_px=2.0)
    assert not kept.oriented[1] and not kept.determined[5]


SIZE_PX = (640, 480)
SURVEY = """
[survey]
name = "room"
unit = "m"
[[camera]]
name = "lens"
images = "*.png"
size_px = [640, 480]
pixel_mm = [0.01, 0.01]
c_mm = 7.68
{model}
[tie_points]
[compare]
backend = "none"
"""


def lens(model: str, f: float, k1: float, k2: float) -> Camera:
    """Return a camera whose principal point is 3 px beside the middle."""
    more = (0.0, 0.0)
    p = np.array([f, f, 322.5, 237.5, k1, k2, *more])
    return Camera("lens", model, SIZE_PX, np.full(2, 0.01), p)


def stations(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
    """Return where photographs of the end of a room are taken, every third turned by 90 degrees."""
    position = np.column_stack(
        [np.linspace(-1.2, 1.2, count), rng.uniform(-0.5, 0.8, count), rng.uniform(0.2, 1.2, count)]
    )
    directions = np.column_stack(
        [rng.uniform(-0.3, 0.3, count) - 0.3 * position[:, 0], rng.uniform(-0.2, 0.2, count), -np.ones(count)]
    )
    rolls = [np.pi / 2 * (i % 3 == 2) for i in range(count)]
    return position, np.array([upright(d, roll) for d, roll in zip(directions, rolls, strict=True)])


def oriented(folder: Path, camera: Camera, model: str = "") -> tuple[Survey, Measurements, Orientation]:
    """Return the orientation of six photographs of points on the walls of a room, 0.1 px of noise."""
    (folder / "survey.toml").write_text(SURVEY.format(model=model), encoding="utf-8")
    survey, rng = read_survey(folder / "survey.toml"), seed_of("room")
    on = rng.integers(0, 3, 150)
    xyz = rng.uniform([-4.0, -1.5, -3.0], [4.0, 3.5, 1.0], (150, 3))
    xyz[on == 0, 2] = -3.0
    xyz[on == 1, 0] = np.where(rng.random(150) < 0.5, -4.0, 4.0)[on == 1]
    xyz[on == 2, 1] = np.where(rng.random(150) < 0.5, -1.5, 3.5)[on == 2]
    position, rotation = stations(rng, 6)
    xy = np.stack([project(camera, *one, xyz) for one in zip(position, rotation, strict=True)])
    xy += rng.normal(0, 0.1, xy.shape)
    image, point = np.nonzero((np.isfinite(xy) & (xy > 0) & (xy < np.array(SIZE_PX) - 1)).all(axis=2))
    seen = ImagePoints(image, point, xy[image, point], np.tile(0.01 * np.eye(2), (len(image), 1, 1)))
    names = tuple(f"{i}.png" for i in range(6))
    network = Network(names, np.zeros(6, dtype=np.int64), tuple(map(str, range(150))), seen)
    cameras = start_cameras(survey.cameras, "room")
    found = orient_survey(survey, Measurements(network, cameras, names, np.full(150, 3)))
    return found.survey, found.measured, found.orientation


@pytest.mark.parametrize(
    ("model", "f", "k1", "k2"),
    [
        (FISHEYE, 200.0, -0.03, 0.01),  # the corner is beyond 90 degrees
        pytest.param(FISHEYE, 230.0, 0.02, -0.005, marks=pytest.mark.slow),
        pytest.param(FISHEYE, 360.0, 0.02, -0.005, marks=pytest.mark.slow),  # 62 degrees
        ("opencv", 240.0, -0.05, 0.01),  # a central perspective of 59 degrees
        pytest.param("opencv", 336.0, -0.1, 0.03, marks=pytest.mark.slow),
    ],
)
def test_the_image_points_tell_a_fisheye_from_a_wide_lens(
    tmp_path: Path, model: str, f: float, k1: float, k2: float
) -> None:
    survey, measured, found = oriented(tmp_path, lens(model, f, k1, k2))
    taken = FISHEYE if model == FISHEYE else "brown"
    assert survey.cameras[0].model == measured.cameras[0].model == found.estimate.cameras[0].model == taken
    assert found.estimate.oriented.all() and found.estimate.cameras[0].c_px == pytest.approx(f, rel=0.01)
    assert len(of_kind(measured.remarks, "fisheye_taken")) == (model == FISHEYE)


@pytest.mark.parametrize("model", ['model = "brown"', pytest.param('free = ["c"]', marks=pytest.mark.slow)])
def test_a_model_that_the_survey_states_stays(tmp_path: Path, model: str) -> None:
    survey, _, found = oriented(tmp_path, lens(FISHEYE, 230.0, 0.02, -0.005), model)
    assert survey.cameras[0].model == found.estimate.cameras[0].model == "brown"


def photograph(planes: list[Plane], camera: Camera, X0: FloatArray, R: FloatArray) -> FloatArray:
    """Return what a camera of any model sees of textured planes, the nearest first."""
    w, h = SIZE_PX
    y, x = np.mgrid[0 : 2 * h, 0 : 2 * w] / 2 - 0.25
    uv = tangents_from_pixel(camera, np.column_stack([x.ravel(), y.ravel()]))
    d = np.column_stack([uv, -np.ones(len(uv))]) @ R.T
    nearest, grey = np.full(len(d), np.inf), np.full(len(d), 30.0)
    for one in planes:
        normal = np.cross(one.right, one.up)
        with np.errstate(all="ignore"):
            t = ((one.corner - X0) @ normal) / (d @ normal)
            X = X0 + t[:, None] * d - one.corner
            right, up = (X @ side / (side @ side) for side in (one.right, one.up))
            on = (t > 0) & (t < nearest) & (right > 0) & (right < 1) & (up > 0) & (up < 1)
        tall, wide = one.texture.shape
        column, row = (
            np.where(on, part, 0.0).astype(np.float32).reshape(2 * h, 2 * w)
            for part in (right * wide - 0.5, (1 - up) * tall - 0.5)
        )
        smooth = cv2.GaussianBlur(np.asarray(one.texture, dtype=np.float32), (0, 0), 0.8)
        value = cv2.remap(smooth, column, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        grey[on], nearest[on] = value.ravel()[on], t[on]
    return np.asarray(cv2.resize(grey.reshape(2 * h, 2 * w), SIZE_PX, interpolation=cv2.INTER_AREA))


@pytest.mark.slow
def test_a_folder_of_fisheye_photographs_without_exif_data_needs_nothing_more(tmp_path: Path) -> None:
    """With Brown's model the centres of such photographs in a room of 8 m were 6 cm wrong (RMS)."""
    rng, camera = seed_of("fisheye"), lens(FISHEYE, 230.0, 0.02, -0.005)
    across, up, along = np.array([8.0, 0, 0]), np.array([0, 5.0, 0]), np.array([0, 0, 8.0])
    planes = [
        wall(rng, np.array([0.0, 1.0, -3.0]), across, up),
        *(wall(rng, np.array([x, 1.0, 1.0]), along, up) for x in (-4.0, 4.0)),
        *(wall(rng, np.array([0.0, y, 1.0]), across, along) for y in (-1.5, 3.5)),
    ]
    position, rotation = stations(rng, 6)
    for i in range(6):
        grey = photograph(planes, camera, position[i], rotation[i]) + rng.normal(0, 1.5, SIZE_PX[::-1])
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.clip(np.rint(grey), 0, 255).astype(np.uint8))
    (tmp_path / "survey.toml").write_text(draft_survey(tmp_path).text, encoding="utf-8")
    a = run_survey(read_survey(tmp_path / "survey.toml")).adjustment
    (found,) = a.estimate.cameras
    assert found.model == FISHEYE and len(a.network.images) == 6 and len(a.network.points) > 1000
    assert found.parameters[:4] == pytest.approx(camera.parameters[:4], abs=0.2)
    placed = fit_similarity(a.estimate.position, position)
    assert np.linalg.norm(placed.apply(a.estimate.position) - position, axis=1).max() < 1e-3
