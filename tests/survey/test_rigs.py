"""Surveys with rigs: moments from names, mounts from photographs oriented one by one, results."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.result_tables import read_result
from sfm.adjustment.quality.variance_components import by_kind
from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import project
from sfm.model.conventions import FloatArray, angles_from_rotation, rotation_from_vector
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.estimate import Estimate, Mounts
from sfm.model.network import Network
from sfm.model.remarks.remark import Remark, kinds_of, of_kind
from sfm.pipeline import run_survey
from sfm.products.planning.prediction import simulate_network
from sfm.report.figures.plots import epipolar_figure
from sfm.report.output import plot_data, write_result
from sfm.report.rig_mounts import rigs_of
from sfm.report.survey_report import text_report
from sfm.survey import rigs
from sfm.survey.inputs.survey import CameraSetup, Survey, read_survey
from sfm.survey.rigs import mounts_of, place_by_rigs, planned_mounts
from tests.findings import findings_of
from tests.rigs import make_rig
from tests.synthetic import SIZE_PX, seed_of

RIG = '[[rig]]\nname = "stereo"\ncameras = ["camera 1", "camera 2"]\nmoment = "moment ([0-9]+)"\n'


def written(folder: Path, network: Network, truth: Estimate, rig: str = RIG) -> Path:
    """Write a survey of the image points of a network, with calibrated cameras."""
    k = network.image_points
    rows = [
        f"{network.images[i]},{network.points[j]},{x!r},{y!r},0.1,0.1"
        for i, j, (x, y) in zip(k.image, k.point, k.xy.tolist(), strict=True)
    ]
    (folder / "points.csv").write_text("\n".join(["image,point,x_px,y_px,sx_px,sy_px", *rows]), "utf-8")
    lines = ['[survey]\nname = "rig"\nunit = "m"\n', rig, '[observations]\nfile = "points.csv"\n']
    for camera in truth.cameras:
        values = dict(zip(camera.names, camera.parameters.tolist(), strict=True))
        glob = f"*{camera.name}" if len(truth.cameras) > 1 else "*"
        fixed = ", ".join(f"{name} = {value!r}" for name, value in values.items() if name != "c")
        lines.append(
            f'[[camera]]\nname = "{camera.name}"\nimages = "{glob}"\nfree = []\n'
            f"size_px = {list(camera.size_px)}\npixel_mm = {camera.pixel_mm.tolist()}\n"
            f"c_mm = {values['c']!r}\nfixed = {{ {fixed} }}\n"
        )
    path = folder / "survey.toml"
    path.write_text("\n".join(lines), "utf-8")
    return path


def test_a_survey_of_a_rig_states_its_mount(tmp_path: Path) -> None:
    """One photograph sees two points only: its rig places it. Base and angles are within their sigmas."""
    network, truth = make_rig(seed_of("survey"), moments=6)
    k = network.image_points
    few = (k.image != 3) | (np.cumsum(k.image == 3) <= 2)
    network = replace(network, image_points=k.select(few))
    result = run_survey(read_survey(written(tmp_path, network, truth)))
    found = findings_of(result)
    assert len(result.adjustment.network.images) == 12
    (rig,) = found.rigs
    assert (rig.name, rig.reference, rig.moments) == ("stereo", "camera 1", 6)
    (mount,) = rig.mounts
    assert truth.mounts is not None
    points = result.adjustment.estimate.points
    order = [network.points.index(name) for name in result.adjustment.network.points]
    size = np.linalg.norm(points - points.mean(axis=0)) / np.linalg.norm(
        truth.points[order] - truth.points[order].mean(axis=0)
    )
    assert abs(mount.base / size - np.linalg.norm(truth.mounts.position[1])) < 4 * mount.base_sigma / size
    write_result(found, tmp_path / "out")
    again = read_result(tmp_path / "out")
    assert again.estimate.mounts is not None and again.estimate.mounts.rig == ("stereo", "stereo")
    np.testing.assert_array_equal(again.rig_covariance, result.adjustment.covariance.rigs)
    shutil.copy(tmp_path / "out" / "mounts.csv", tmp_path)
    path = written(tmp_path, network, truth, RIG + 'mounts = "mounts.csv"\n')
    (given,) = run_survey(read_survey(path)).network.further
    assert len(given) == 1  # the row of the reference is none
    (stored,) = json.loads((tmp_path / "out" / "summary.json").read_text("utf-8"))["rigs"]
    assert stored["mounts"][0]["base"] == {"value": mount.base, "sigma": mount.base_sigma}
    assert set(stored["mounts"][0]["rotation_deg"]) == {"omega", "phi", "kappa"}
    assert "Rig stereo" in text_report(found)
    assert mount.epipolar is not None
    epipolar_px = mount.epipolar.rms_px
    assert 0.06 < epipolar_px < 0.16  # of points with 0.1 px in both photographs, one is adjusted
    assert stored["mounts"][0]["epipolar_rms_px"] == epipolar_px
    drawn, *_ = epipolar_figure(plot_data(found)).axes
    assert drawn.get_title() == f"camera 2 from camera 1: RMS {epipolar_px:.3g} px"
    far = replace(result.adjustment, estimate=replace(result.estimate, mounts=turned(result.estimate.mounts)))
    turned_away = rigs_of(far)[0].mounts[0].epipolar
    assert turned_away is not None and turned_away.rms_px > 5 * epipolar_px


@pytest.mark.sweep(0, 2)
@pytest.mark.parametrize("seen", [1, 3, 4])
def test_a_photograph_that_only_its_rig_poses_is_named(seen: int, tmp_path: Path) -> None:
    """Four image points determine a pose and check it."""
    network, truth = make_rig(seed_of("posed by rig"), cameras=3, moments=5)
    k = network.image_points
    few = (k.image != 4) | (np.cumsum(k.image == 4) <= seen)
    network = replace(network, image_points=k.select(few))
    rig = RIG.replace('"camera 2"', '"camera 2", "camera 3"')
    result = run_survey(read_survey(written(tmp_path, network, truth, rig)))
    assert network.images[4] in result.adjustment.network.images
    named = [one for one in result.remarks if one.kind == "photographs_posed_by_rig"]
    assert [one.names("photographs") for one in named] == ([("moment 2 camera 2",)] if seen < 4 else [])
    assert all(one.severity == "note" and one.numbers["accepted"].value == seen for one in named)


def test_a_photograph_of_a_rig_without_points_of_the_result_is_missing(tmp_path: Path) -> None:
    """Its only point is in no other photograph."""
    network, truth = make_rig(seed_of("none accepted"), moments=6)
    k = network.image_points
    alone = int(k.point[k.image == 3][0])
    network = replace(network, image_points=k.select((k.image == 3) == (k.point == alone)))
    result = run_survey(read_survey(written(tmp_path, network, truth)))
    (missing,) = result.failed
    assert missing.image == "moment 2 camera 2" and missing.reason.kind == "photograph_with_few_points"
    assert "photographs_posed_by_rig" not in kinds_of(result.remarks)


def turned(mounts: Mounts | None) -> Mounts:
    """Return mounts with the second camera turned by 1 mrad about the base."""
    assert mounts is not None
    rotation, axis = mounts.rotation.copy(), mounts.position[1] / np.linalg.norm(mounts.position[1])
    rotation[1] = rotation_from_vector(1e-3 * axis) @ rotation[1]
    return replace(mounts, rotation=rotation)


@pytest.mark.parametrize(
    ("rig", "said"),
    [
        (RIG.replace("camera 2", "camera 3"), "rig stereo: no camera is named 'camera 3'"),
        (RIG.replace(', "camera 2"', ""), "rig stereo: 1 camera, at least 2 are needed"),
        (RIG.replace("moment (", "time ("), "does not match photograph 'moment 1 camera 1'"),
        (RIG.replace("([0-9]+)", "[0-9]+"), "has 0 groups, needed 1"),
        (RIG.replace("([0-9]+)", "([0-9+"), "is not a regular expression"),
        (RIG.replace("([0-9]+)", "(.*.*.*.*)x"), "repeats more than 3 parts"),
        (RIG.replace("([0-9]+)", "([0-9]+)*"), "repeats more than 3 parts, or a group"),
        (RIG.replace("moment ([0-9]+)", "(camera)"), "of camera camera 1 are of one moment, 'camera'"),
        (RIG.replace("moment ([0-9]+)", "(.+)"), "no moment has photographs of two cameras"),
        (RIG + RIG.replace("stereo", "other"), "camera camera 1 is already on rig stereo"),
        (RIG + "tolerance_s = 2.0\n", 'tolerance_s is given, moment = "exif" is needed with it'),
    ],
)
def test_wrong_rigs_are_refused_in_one_line(rig: str, said: str, tmp_path: Path) -> None:
    network, truth = make_rig(seed_of("wrong"), moments=3, points=12)
    with pytest.raises(SurveyFileError) as error:
        run_survey(read_survey(written(tmp_path, network, truth, rig)))
    assert said in str(error.value) and "\n" not in str(error.value)


def test_moments_in_order_need_as_many_photographs(tmp_path: Path) -> None:
    network, truth = make_rig(seed_of("order"), moments=3, points=12)
    k = network.image_points
    less = replace(network, image_points=k.select(k.image != 5))
    rig = RIG.replace("moment ([0-9]+)", "order")
    with pytest.raises(SurveyFileError, match="found 3 of camera 1, 2 of camera 2"):
        run_survey(read_survey(written(tmp_path, less, truth, rig)))
    survey = read_survey(written(tmp_path, network, truth, rig))
    assert run_survey(survey).adjustment.estimate.mounts is not None


def test_mounts_are_those_of_most_moments() -> None:
    """Three cameras; camera 3 is never oriented beside camera 1, and some photographs are wrong."""
    network, truth = make_rig(seed_of("median"), cameras=3, moments=10, points=12)
    assert truth.mounts is not None
    position = truth.position.copy()
    position[1::18] += 1.0
    position[2::6] = np.nan  # camera 3 at every other moment, and camera 1 at the others
    position[3::6] = np.nan
    rigs, start = {"rig": [0, 1, 2]}, replace(truth, position=position, mounts=None)
    found = mounts_of(rigs, network, start)
    assert found.position == pytest.approx(truth.mounts.position, abs=1e-9)
    assert found.rotation == pytest.approx(truth.mounts.rotation, abs=1e-9)
    assert list(found.free.any(axis=1)) == [False, True, True]
    placed = place_by_rigs(network, replace(start, mounts=found))
    assert placed.position[3::6] == pytest.approx(truth.position[3::6], abs=1e-9)
    lost = replace(start, position=np.where(np.arange(30)[:, None] % 3 == 2, np.nan, position))
    with pytest.raises(GeometryError, match="camera camera 3 is oriented at no moment together with"):
        mounts_of(rigs, network, lost)


@pytest.mark.parametrize("sigma", [0.0, 1e-4])
def test_given_mounts_give_the_scale(sigma: float, tmp_path: Path) -> None:
    """Held fixed, or observed with a standard deviation; with residuals in the report then."""
    network, truth = make_rig(seed_of("given mounts"), moments=5, points=25)
    assert truth.mounts is not None
    X = truth.mounts.position[1]
    angles = np.degrees(angles_from_rotation(truth.mounts.rotation[1]))
    cells = [*X.tolist(), *[sigma] * 3, *angles.tolist(), *[float(np.degrees(sigma))] * 3]
    header = "camera,X,Y,Z,sX,sY,sZ,omega_deg,phi_deg,kappa_deg,somega_deg,sphi_deg,skappa_deg"
    (tmp_path / "mounts.csv").write_text(f"{header}\ncamera 2,{','.join(map(repr, cells))}\n", "utf-8")
    path = written(tmp_path, network, truth, RIG + 'mounts = "mounts.csv"\n')
    result = run_survey(read_survey(path))
    a = result.adjustment
    assert a.has_scale and a.defect == a.expected_defect == 6
    found = np.linalg.norm(np.ptp(a.estimate.points, axis=0))
    exact = np.linalg.norm(np.ptp(truth.points[[network.points.index(n) for n in a.network.points]], axis=0))
    assert found == pytest.approx(exact, rel=0.2)  # turned, so that its box is another
    (mount,) = findings_of(result).rigs[0].mounts
    assert mount.base == pytest.approx(np.linalg.norm(X), abs=1e-12 if sigma == 0 else 4 * sigma)
    (said,) = of_kind(result.tests, "scale_unchecked")
    assert said.names("given") == ("the mount of camera 2",)
    kinds = [kind.kind for kind in findings_of(result).given.kinds]
    assert kinds == ([] if sigma == 0 else ["mount"])
    if sigma:
        assert by_kind(a).names == ("image points", "mounts")
        assert by_kind(a).redundancy.sum() == pytest.approx(a.redundancy, abs=1e-3)


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("camera 1,1,0,0,0,0,0,0,0,0,0,0,0", "camera 'camera 1' is on no rig, or is the reference"),
        ("camera 2,1,0,0,0,0,0,0,0,0,1,1,1", "needed all six values, held fixed .sigma 0. together"),
        ("camera 2,1,0,0,1,1,1,,,,,,", "needed all six values"),
        ("\n".join(["camera 2,1,0,0,1,1,1,0,0,0,1,1,1"] * 2), "camera 'camera 2' is on line 2 already"),
    ],
)
def test_wrong_mounts_are_refused(row: str, said: str, tmp_path: Path) -> None:
    network, truth = make_rig(seed_of("wrong mounts"), moments=3, points=12)
    header = "camera,X,Y,Z,sX,sY,sZ,omega_deg,phi_deg,kappa_deg,somega_deg,sphi_deg,skappa_deg"
    (tmp_path / "mounts.csv").write_text(f"{header}\n{row}\n", "utf-8")
    path = written(tmp_path, network, truth, RIG + 'mounts = "mounts.csv"\n')
    with pytest.raises(SurveyFileError, match=said):
        run_survey(read_survey(path))


@pytest.mark.sweep(1, 2, 5, 6, 9)
@pytest.mark.parametrize("sigma", [0.0, 1e-3])
@pytest.mark.parametrize(
    ("mistake", "kind", "direction"),
    [
        ("inverse pose", "mount_contradicted", None),
        ("opposite base", "mount_contradicted", 180.0),
        ("turned", "mount_contradicted", 0.0),
        ("longer", "scale_contradicted", None),
        ("none", None, None),
    ],
)
def test_given_mounts_are_judged_before_they_are_used(
    sigma: float, mistake: str, kind: str | None, direction: float | None, tmp_path: Path
) -> None:
    """By the photographs, and by four distances; the result is that without the mount."""
    network, truth = make_rig(seed_of("judged mounts"), moments=6, points=20)
    assert truth.mounts is not None
    X, R = truth.mounts.position[1], truth.mounts.rotation[1]
    if mistake == "inverse pose":
        X, R = -R.T @ X, R.T
    if mistake == "turned":
        R = R @ rotation_from_vector(np.array([0.05, 0.0, 0.0]))
    X = {"opposite base": -1.0, "longer": 1.05}.get(mistake, 1.0) * X
    angles = np.degrees(angles_from_rotation(R))
    cells = [*X.tolist(), *[sigma] * 3, *angles.tolist(), *[100 * sigma] * 3]
    header = "camera,X,Y,Z,sX,sY,sZ,omega_deg,phi_deg,kappa_deg,somega_deg,sphi_deg,skappa_deg"
    (tmp_path / "mounts.csv").write_text(f"{header}\ncamera 2,{','.join(map(repr, cells))}\n", "utf-8")
    P = truth.points
    rows = [f"{j + 1},{j + 2},{float(np.linalg.norm(P[j] - P[j + 1]))!r},0.0001" for j in (0, 2, 4, 6)]
    (tmp_path / "tape.csv").write_text("\n".join(["from,to,length,slength", *rows]), "utf-8")
    tape = '[[survey_observations]]\nkind = "distance"\nfile = "tape.csv"\n\n'
    path = written(tmp_path, network, truth, RIG + 'mounts = "mounts.csv"\n' + tape)
    result = run_survey(read_survey(path))
    judged = {one.kind: one for one in result.remarks if re.search("mount|rig|scale_c", one.kind)}
    assert list(judged) == ([] if kind is None else [kind])
    if direction is not None:
        found = judged["mount_contradicted"]
        assert found.number("direction") == pytest.approx(direction, abs=0.5)
        assert found.number("angle") == pytest.approx(np.degrees(0.05) if mistake == "turned" else 0, abs=0.1)
    if kind == "mount_contradicted":
        assert judged[kind].subjects.get("mistake", ()) == (() if mistake == "turned" else (mistake,))
        assert judged[kind].severity == "warning"  # by many more photographs, and it is not used
    if kind == "scale_contradicted":
        assert judged[kind].number("off") == pytest.approx(5.0, abs=0.5)
        assert judged[kind].names("cameras") == ("camera 2",) and judged[kind].names("others") == ("bars",)
    (mount,) = findings_of(result).rigs[0].mounts
    assert mount.base == pytest.approx(np.linalg.norm(truth.mounts.position[1]), abs=4 * mount.base_sigma)


@pytest.mark.parametrize("longer", [1.0, 1.03])
def test_mounts_of_two_scales_give_none(longer: float, tmp_path: Path) -> None:
    network, truth = make_rig(seed_of("two scales"), cameras=3, moments=5, points=20)
    assert truth.mounts is not None
    rows = ["camera,X,Y,Z,sX,sY,sZ,omega_deg,phi_deg,kappa_deg,somega_deg,sphi_deg,skappa_deg"]
    for a, factor in ((1, 1.0), (2, longer)):
        X, angles = truth.mounts.position[a], angles_from_rotation(truth.mounts.rotation[a])
        cells = [*(factor * X).tolist(), *[5e-4] * 3, *np.degrees(angles).tolist(), *[0.05] * 3]
        rows.append(f"camera {a + 1},{','.join(map(repr, cells))}")
    (tmp_path / "mounts.csv").write_text("\n".join(rows), "utf-8")
    rig = RIG.replace('"camera 2"', '"camera 2", "camera 3"') + 'mounts = "mounts.csv"\n'
    result = run_survey(read_survey(written(tmp_path, network, truth, rig)))
    said = [one for one in result.remarks if one.kind == "scale_contradicted"]
    assert len(said) == (longer != 1.0) and result.adjustment.has_scale == (longer == 1.0)
    for one in said:
        assert one.number("off") == pytest.approx(3.0, abs=1.0)
        assert one.names("cameras") == ("camera 3",) and one.names("others") == ("the mount of camera 2",)


BLOCKS = RIG + 'blocks = ["moment [1-4] *", "moment [5-8] *"]\n'


def moved_rig(name: str) -> tuple[Network, Estimate, FloatArray]:
    """Return a rig whose second camera is moved by 20 mm and turned by 2 deg after four of eight moments."""
    network, truth = make_rig(seed_of(name), moments=8, free=("c",))
    assert truth.mounts is not None
    move, turn = np.array([0.02, -0.01, 0.01]), rotation_from_vector(np.array([0.02, -0.03, 0.01]))
    position, rotation = truth.position.copy(), truth.rotation.copy()
    for i in range(9, 16, 2):
        rig = rotation[i] @ truth.mounts.rotation[1].T
        position[i] += rig @ move
        rotation[i] = rig @ truth.mounts.rotation[1] @ turn
    moved = replace(truth, position=position, rotation=rotation)
    return *simulate_network(network, moved, seed_of(f"{name} noise")), move


def test_a_rig_has_other_mounts_in_another_block_of_time(tmp_path: Path) -> None:
    """Each block its base; c is one for both, and COLMAP gets the same."""
    network, truth, move = moved_rig("blocks")
    path = written(tmp_path, network, truth, BLOCKS)
    path.write_text(path.read_text("utf-8").replace("free = []", 'free = ["c"]'), "utf-8")
    result = run_survey(read_survey(path))
    found = findings_of(result)
    assert [one.kind for one in found.verdict.remarks if one.kind == "rig_contradicted"] == []
    first, second = found.rigs
    assert (first.name, second.name) == ("stereo moment [1-4] *", "stereo moment [5-8] *")
    assert (first.moments, second.moments) == (4, 4)
    assert truth.mounts is not None
    sizes = [np.linalg.norm(X - X.mean(axis=0)) for X in (result.estimate.points, truth.points)]
    scale = sizes[1] / sizes[0]
    for rig, X in ((first, truth.mounts.position[1]), (second, truth.mounts.position[1] + move)):
        (mount,) = rig.mounts
        assert np.abs((mount.position * scale - X) / (mount.position_sigma * scale)).max() < 5
    c = {one.name: one.c_px for one in result.estimate.cameras}
    assert len(c) == 4 and len(set(c.values())) == 2
    write_result(found, tmp_path / "out")
    again = read_result(tmp_path / "out")
    assert again.estimate.mounts is not None and again.estimate.mounts.rig[:2] == (first.name,) * 2


REJECTING = '\n[adjust]\nreject = "tau"\n'


def bumped(network: Network, truth: Estimate, photographs: list[int], turn: float) -> Network:
    """Return the network with photographs taken by cameras turned by an angle, deg, and shifted by 1 mm."""
    seen, rng = network.image_points, seed_of("bump")
    axis, shift = rng.standard_normal(3), rng.normal(0, 1e-3, 3)
    R, xy = rotation_from_vector(np.radians(turn) * axis / np.linalg.norm(axis)), seen.xy.copy()
    for i in photographs:
        rows, camera = seen.image == i, truth.cameras[network.camera[i]]
        X, X0, of_camera = truth.points[seen.point[rows]], truth.position[i], truth.rotation[i]
        moved = project(camera, X0 + of_camera @ shift, of_camera @ R, X)
        xy[rows] += moved - project(camera, X0, of_camera, X)
    inside = (np.isfinite(xy) & (xy > 0) & (xy < np.array(SIZE_PX) - 1)).all(axis=1)
    return replace(network, image_points=replace(seen, xy=xy).select(inside))


def judged(folder: Path, network: Network, truth: Estimate) -> SurveyResult:
    """Return the result of a survey that rejects image points."""
    names = ", ".join(f'"{camera.name}"' for camera in truth.cameras)
    rig = re.sub("cameras = .*", f"cameras = [{names}]", RIG) + REJECTING
    return run_survey(read_survey(written(folder, network, truth, rig)))


def of_rigs(result: SurveyResult) -> tuple[Remark, ...]:
    return of_kind(result.remarks, "rig_contradicted")


@pytest.mark.sweep(1, 3)
@pytest.mark.parametrize(
    ("cameras", "turn", "which"),
    [
        (2, 0.02, [11, 13, 15]),
        (2, 0.1, [11, 13, 15]),
        pytest.param(2, 2.0, [11, 13, 15], marks=pytest.mark.slow),
        (3, 0.1, [12]),  # the reference camera
        pytest.param(3, 1.0, [12], marks=pytest.mark.slow),
        pytest.param(3, 0.1, [17, 20, 23], marks=pytest.mark.slow),
    ],
)
def test_photographs_of_a_bumped_camera_are_free_of_the_rig_and_named(
    cameras: int, turn: float, which: list[int], tmp_path: Path
) -> None:
    """From 0.1 degrees on they lost their image points to the rig, and nothing named them."""
    network, truth = make_rig(seed_of(f"bumped {cameras}"), cameras=cameras, moments=8, points=35)
    result = judged(tmp_path, bumped(network, truth, which, turn), truth)
    (said,) = of_rigs(result)
    assert sorted(said.names("photographs")) == [network.images[i] for i in which]
    assert said.number("angle") == pytest.approx(turn, abs=max(0.02, 0.05 * turn))
    assert result.failed == () and result.adjustment.sigma0_px == pytest.approx(0.1, rel=0.1)
    assert result.verdict.level == "fair"


@pytest.mark.sweep(1)
@pytest.mark.parametrize("moments", [[2, 5], [1, 2, 3, 4, 5, 6, 7, 0]])
def test_photographs_of_other_moments_are_named(moments: list[int], tmp_path: Path) -> None:
    """Two photographs with exchanged names, and a camera whose first photograph is missing."""
    network, truth = make_rig(seed_of("wrong moments"), moments=8, points=35)
    names = list(network.images)
    rows = [2 * k + 1 for k in moments]
    for row, other in zip(rows, rows[1:] + rows[:1], strict=True):
        names[row] = network.images[other]
    result = judged(tmp_path, replace(network, images=tuple(names)), truth)
    (said,) = of_rigs(result)
    assert len(result.network.images) == 16
    assert set(said.names("photographs")) <= {network.images[row] for row in rows}
    assert len(said.names("photographs")) >= len(rows) - 1
    assert said.severity == "warning" and result.verdict.level == "fair"


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_photograph_that_kept_its_mount_stays_on_its_rig(share: float, tmp_path: Path) -> None:
    """Also one of which half of the points are wrong."""
    network, truth = make_rig(seed_of("kept mounts"), moments=8, points=35)
    seen, rng = network.image_points, seed_of("gross errors of one photograph")
    wrong = (seen.image == 5) & (rng.random(len(seen)) < share)
    xy = seen.xy + np.where(wrong[:, None], rng.normal(0, 30.0, seen.xy.shape), 0.0)
    result = judged(tmp_path, replace(network, image_points=replace(seen, xy=xy)), truth)
    assert of_rigs(result) == () and network.moment is not None
    assert result.network.moment is not None and (result.network.moment == network.moment).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("[5-8]", "[5-7]"), "photograph 'moment 8 camera 1' is in no block of"),
        (("[5-8]", "[4-8]"), "photograph 'moment 4 camera 1' is in 2 blocks of"),
        (("[5-8] *", "[5-8] camera 1"), "photograph 'moment 5 camera 2' is in no block"),
        (("[1-4] *", "[1-8] *"), "is in 2 blocks of"),
    ],
)
def test_photographs_are_of_one_block(change: tuple[str, str], said: str, tmp_path: Path) -> None:
    network, truth, _ = moved_rig("blocks")
    with pytest.raises(SurveyFileError, match=re.escape(said)):
        run_survey(read_survey(written(tmp_path, network, truth, BLOCKS.replace(*change))))


@pytest.mark.parametrize("rigs", [[], [(1, 2, 3)], [(1, 2), (3, 4)]])
def test_a_plan_needs_one_rig_of_all_cameras(rigs: list[tuple[int, ...]]) -> None:
    """Of four cameras none is on a rig, three are, or they are on two rigs."""
    cameras = [CameraSetup(name=f"camera {k}", images=f"{k}-*", c_mm=10.0) for k in (1, 2, 3, 4)]
    given = [
        {"name": f"rig {n}", "cameras": [f"camera {k}" for k in some], "moment": "-(.*)"}
        for n, some in enumerate(rigs)
    ]
    with pytest.raises(SurveyFileError) as error:
        planned_mounts(Survey(name="plan", cameras=cameras, rigs=given))
    on = "camera 1, camera 2" if rigs else "none;"
    assert f"on rigs {on}" in str(error.value) and "one rig of all cameras" in str(error.value)


def test_a_mount_is_the_mean_of_the_majority() -> None:
    """Three of seven rotations are wrong by 60 degrees, and come first."""
    rng = seed_of("majority")
    true = rotation_from_vector(np.array([0.2, -0.4, 0.3]))
    R = true @ rotation_from_vector(0.01 * rng.normal(size=(7, 3)))
    R[:3] = R[:3] @ rotation_from_vector(np.array([0.0, np.pi / 3, 0.0]))
    away = np.arccos((np.trace(rigs.middle_rotation(R).T @ true) - 1) / 2)
    assert away < 0.02
