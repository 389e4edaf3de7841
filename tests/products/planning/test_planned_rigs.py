"""Plans of rigs and of observations of every kind: what is predicted, and what each of them adds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sfm
from sfm.adjustment.solve import predict
from sfm.files.plain_text import csv_text
from sfm.model.camera import camera_from_values
from sfm.model.conventions import angles_from_rotation, rotation_from_vector
from sfm.model.distributions import chi2_ppf
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.observations.kind import PHOTOGRAPH, Group, TableKind
from sfm.model.observations.rigid_frames import RigidFrames
from sfm.model.observations.tables import TABLES
from sfm.products.inspection.planned_survey import compare_with_plan, read_plan, write_simulation
from sfm.products.planning.plan import describe_plan
from sfm.products.planning.planned_object import shape_object
from sfm.products.planning.prediction import ScaleBarPlan, WantedPrecision, predict_network
from sfm.products.planning.stations import arrangement
from sfm.products.planning.visibility import Seeing, TargetImage, Visibility
from sfm.products.planning.weakness import contributions, open_counts, reason_of
from sfm.report.pages import write_page
from tests.cli.test_planning_commands import plan
from tests.rigs import make_rig
from tests.survey.test_survey_observations import network_of_all, observed
from tests.synthetic import make_network, seed_of
from tests.tables import rows_of

STATIONS = ("--unit", "m", "--sigma-px", "0.1", "--stations", "hemisphere:6")


def planned_survey(folder: Path, network: Network, truth: Estimate, sigma: float = 1e-4) -> Path:
    """Write the survey file of a plan: its cameras, rig and survey observations; beside it points.csv."""
    assert truth.mounts is not None
    points = [(name, *xyz) for name, xyz in zip(network.points, truth.points.tolist(), strict=True)]
    (folder / "points.csv").write_text(csv_text(("id", "X", "Y", "Z"), points), "utf-8")
    lines = ['[survey]\nname = "plan"\nunit = "m"\n']
    for camera in truth.cameras:
        lines += [f'[[camera]]\nname = "{camera.name}"\nimages = "{camera.name}-*"\nfree = []']
        lines += [f"size_px = {list(camera.size_px)}\npixel_mm = {camera.pixel_mm.tolist()}\nc_mm = 10.0\n"]
    names = [camera.name for camera in truth.cameras]
    lines += [f'[[rig]]\nname = "stereo"\ncameras = {json.dumps(names)}\nmoment = "-(.*)"']
    lines += ['mounts = "mounts.csv"\n']
    columns = ("X", "Y", "Z", "omega_deg", "phi_deg", "kappa_deg")
    mounts = [
        (name, *X, *np.degrees(angles_from_rotation(R)), *[sigma] * 3, *[np.degrees(sigma)] * 3)
        for name, X, R in zip(names[1:], truth.mounts.position[1:], truth.mounts.rotation[1:], strict=True)
    ]
    header = ("camera", *columns, *(f"s{name}" for name in columns))
    (folder / "mounts.csv").write_text(csv_text(header, mounts), "utf-8")
    for number, one in enumerate(network.further, 1):
        for kind, of in TABLES.items():
            if type(one) is of:
                table = csv_text((*of.texts, *of.columns()), one.table_rows(network))
                (folder / f"{number}.csv").write_text(table, "utf-8")
                lines += [f'[[survey_observations]]\nkind = "{kind}"\nfile = "{number}.csv"\n']
    path = folder / "survey.toml"
    path.write_text("\n".join(lines), "utf-8")
    return path


def test_a_plan_states_what_rig_and_every_kind_of_observation_add(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network, truth = network_of_all()
    path = planned_survey(tmp_path, network, truth)
    for table, one in enumerate(network.further, 1):
        if isinstance(one, TableKind) and one.texts_of == PHOTOGRAPH:
            text = (tmp_path / f"{table}.csv").read_text("utf-8")
            for k in range(5):  # of photographs of the plan
                for camera in (1, 2):
                    text = text.replace(f"moment {k + 1} camera {camera},", f"camera {camera}-S{k + 1},")
            (tmp_path / f"{table}.csv").write_text(text, "utf-8")
    out = tmp_path / "plan"
    assert plan(tmp_path / "points.csv", "--survey", path, *STATIONS, "--out", out) == 0
    printed = capsys.readouterr().out
    found = json.loads((out / "plan.json").read_text("utf-8"))
    gain = {one["name"]: one for one in found["contributions"]}
    kinds = {of.name for name, of in TABLES.items() if name != "distance"} | {"mounts", "scale bars", "rig"}
    assert set(gain) == kinds
    assert all(one["gain"] >= 1 - 1e-9 for one in gain.values()) and gain["rig"]["gain"] > 1.0001
    assert {row[""] if "" in row else row["kind"] for row in rows_of(out / "gain.csv")} == kinds
    assert "gain by plumb lines: points 1." in printed and "rig stereo: camera 2 0.4" in printed
    (mount,) = found["rigs"][0]["mounts"]
    assert 0 < mount["base"]["sigma"] < 1e-4 and found["photographs"] == 12
    (assumes,) = (one for one in found["remarks"] if one["kind"] == "plan_assumes")
    assert "known scale" not in assumes["subjects"]["assumed"]


def test_a_camera_of_a_rig_that_sees_nothing_is_named() -> None:
    plate = shape_object("plate", (1.0, 0.7), 30)
    _, truth = make_rig(seed_of("motions"))
    assert truth.mounts is not None
    away = truth.mounts.rotation.copy()
    away[1] = rotation_from_vector(np.array([0.0, 1.4, 0.0]))
    stations = arrangement("ring:5", plate, truth.cameras[0]).with_rig(
        replace(truth.mounts, rotation=away), truth.cameras
    )
    with pytest.raises(GeometryError, match="plan: camera camera 2 shows no points that another photograph"):
        predict_network(plate, truth.cameras, stations, Seeing(sigma_px=0.1))


def test_the_rig_condition_has_a_gain() -> None:
    plate = shape_object("plate", (1.0, 0.7), 30)
    _, truth = make_rig(seed_of("motions"))
    assert truth.mounts is not None
    stations = arrangement("ring:5", plate, truth.cameras[0]).with_rig(truth.mounts, truth.cameras)
    prediction = predict_network(plate, truth.cameras, stations, Seeing(sigma_px=0.1))
    (rig,) = contributions(prediction)
    assert (rig.name, rig.count, rig.shifts, rig.rotations, rig.scale) == ("rig", 5, 0, 0, False)
    assert rig.gain > 1.0
    assert rig.sigma_with == pytest.approx(prediction.rms_sigma)  # both with inner constraints on all points


def test_gain_is_that_of_the_plan_where_two_kinds_give_the_scale() -> None:
    """A bad bar and a good frame: only what is lost without one of them is its gain."""
    plate = shape_object("plate", (1.0, 0.7), 30)
    _, truth = make_rig(seed_of("motions"))
    camera = truth.cameras[0]
    stations = arrangement("ring:6", plate, camera)
    ends = plate.names[0], plate.names[-1]

    def framed(network: Network) -> Network:
        frame = RigidFrames.of_group("frame", np.arange(4)[:, None], plate.xyz[:4], np.full((4, 3), 1e-5), {})
        return network.with_given(further=(*network.further, frame))

    seeing, bars = Seeing(sigma_px=0.1), [ScaleBarPlan(*ends, 5e-3)]
    without = predict_network(plate, camera, stations, seeing, bars=bars)
    found = predict_network(plate, camera, stations, seeing, bars=bars, given=framed)
    bar, frame = contributions(found)
    assert frame.gain == pytest.approx(without.rms_sigma / found.rms_sigma, rel=1e-6) and frame.gain > 2
    assert 1.0 <= bar.gain < 1.01
    assert not (frame.scale or bar.scale)
    (alone,) = contributions(without)
    assert alone.scale and alone.gain == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "given"),
    [
        ("height difference", (0, 2, True)),
        ("coordinate difference", (0, 3, True)),
        ("antenna position", (3, 3, True)),
        ("zenith angle", (0, 2, False)),
        ("rigid frame", (0, 0, True)),
    ],
)
def test_what_only_one_kind_gives_is_named(kind: str, given: tuple[int, int, bool]) -> None:
    network, truth = make_network(seed_of("gives"), images=8, points=34, free=())
    one = observed(kind, truth, seed_of(kind))
    a = predict(network.with_given(further=(one,)), truth)
    every = np.arange(len(truth.points))
    assert open_counts(predict(network, truth), every).tolist() == [3, 3, 1]
    fixed = np.array([3, 3, 1]) - open_counts(a, every)
    assert tuple(fixed) == given


def test_points_off_their_planned_line_are_refused() -> None:
    plate = shape_object("plate", (1.0, 0.7), 30)
    _, truth = make_rig(seed_of("motions"))
    stations = arrangement("ring:6", plate, truth.cameras[0])
    points = np.arange(3)

    def on_line(network: Network) -> Network:
        wire = TABLES["line"].of_group("wire", points[:, None], np.zeros((3, 0)), np.full((3, 1), 1e-4), {})
        return network.with_given(further=(wire,))

    with pytest.raises(GeometryError, match=r"plan: line wire: point \S+ is 0\.\d+ off it.* sigma 0\.0001"):
        predict_network(plate, truth.cameras[0], stations, Seeing(sigma_px=0.1), given=on_line)


@pytest.mark.parametrize(("kind", "cause"), [("height difference", "attitude"), ("bar", "scale")])
def test_points_are_weak_by_what_an_observation_gives_badly(kind: str, cause: str) -> None:
    plate = shape_object("plate", (1.0, 0.7), 30)
    _, truth = make_rig(seed_of("motions"))
    stations = arrangement("ring:6", plate, truth.cameras[0])
    ends = np.arange(4)

    def levelled(network: Network) -> Network:
        level = TABLES[
            kind
        ].of_table(  # type: ignore[attr-defined]
            (ends[:-1], ends[1:]), np.zeros((3, 1)), np.full((3, 1), 0.05)
        )
        return network.with_given(further=(level,))

    bars = [ScaleBarPlan(plate.names[0], plate.names[5], 0.05)] if kind == "bar" else []
    given = None if bars else levelled
    seeing = Seeing(sigma_px=0.1)
    found = predict_network(plate, truth.cameras[0], stations, seeing, bars=bars, given=given)
    far = int(np.linalg.norm(plate.xyz, axis=1).argmax())
    assert f"mostly from the {cause} of the whole network" in reason_of(found, far)
    free = predict_network(plate, truth.cameras[0], stations, seeing)
    assert "whole network" not in reason_of(free, far)


def test_a_rig_without_which_nothing_is_determined_gives_all_points() -> None:
    """Three points in each photograph, four in each moment."""
    plate = shape_object("plate", (1.0, 0.7), 8)
    _, truth = make_rig(seed_of("narrow"))
    assert truth.mounts is not None
    cameras = truth.cameras
    stations = arrangement("ring:6", plate, cameras[0]).with_rig(truth.mounts, cameras)
    seeing = Seeing(sigma_px=0.1)
    whole = predict_network(plate, cameras, stations, seeing)
    why = whole.sight.visibility.copy()
    for k in range(6):
        for camera in (0, 1):
            shown = (np.arange(3) + 3 * camera + k) % 8
            why[2 * k + camera, ~np.isin(np.arange(8), shown)] = Visibility.OUTSIDE
    narrow = predict_network(plate, cameras, stations, seeing, sight=replace(whole.sight, visibility=why))
    (rig,) = contributions(narrow)
    assert rig.points == narrow.determined.sum() > 0 and rig.sigma_without == np.inf


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("--camera", "full-frame-24"), "expected either --camera or --survey"),
        (("--free", "c"), "--c-mm, --camera-name and --free belong to --camera"),
        (("--unit", "mm"), "has unit 'm', but the plan has 'mm'"),
    ],
)
def test_contradicting_options_are_refused(
    change: tuple[str, ...], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network, truth = make_rig(seed_of("refused"), moments=3)
    path = planned_survey(tmp_path, network, truth)
    assert plan(tmp_path / "points.csv", "--survey", path, *STATIONS, *change) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_unknown_points_and_photographs_of_a_plan_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network, truth = network_of_all()
    path = planned_survey(tmp_path, network, truth)
    given = (tmp_path / "points.csv", "--survey", path, *STATIONS)
    assert plan(*given) == 2
    assert "photograph 'moment 1 camera 1' is not in the plan" in capsys.readouterr().err
    assert plan(*given[:3], "--unit", "m", "--sigma-px", "0.1", "--sigma", "0.001") == 2
    assert "a rig or observations of photographs need --stations" in capsys.readouterr().err
    text = (tmp_path / "points.csv").read_text("utf-8").splitlines()
    (tmp_path / "points.csv").write_text("\n".join(text[:-5]), "utf-8")
    assert plan(*given) == 2
    assert "is not in the object of the plan" in capsys.readouterr().err


def test_every_kind_is_written_as_the_table_that_it_is_read_from(tmp_path: Path) -> None:
    from sfm.survey.observation_tables import read_observation_table, with_tables

    network, truth = network_of_all()
    planned_survey(tmp_path, network, truth)
    for number, one in enumerate(network.further, 1):
        if isinstance(one, TableKind):
            (kind,) = (kind for kind, of in TABLES.items() if type(one) is of)
            table = read_observation_table(kind, tmp_path / f"{number}.csv", "survey.toml")
            (again,) = with_tables((table,), network).further[len(network.further) :]
            if isinstance(one, Group):
                assert isinstance(again, Group) and again.row_points(network) == one.row_points(network)
                assert again.group == one.group
            np.testing.assert_allclose(again.values, one.values, rtol=1e-12)
            np.testing.assert_allclose(again.covariances(), one.covariances(), rtol=1e-12)


@pytest.mark.slow
def test_image_points_of_a_planned_rig_give_its_mounts_within_their_standard_deviations(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With all kinds of observations, whose names a simulated survey keeps; mounts given as observations."""
    network, truth = network_of_all()
    observations = tuple(
        one for one in network.further if not (isinstance(one, TableKind) and one.texts_of == PHOTOGRAPH)
    )
    path = planned_survey(tmp_path, network.with_given(further=observations), truth, sigma=1e-3)
    out = tmp_path / "plan"
    (tmp_path / "points.csv").write_text(
        csv_text(
            ("id", "X", "Y", "Z", "nX", "nY", "nZ"),
            [
                (name, *X, 0.0, 0.0, 1.0)
                for name, X in zip(network.points, truth.points.tolist(), strict=True)
            ],
        ),
        "utf-8",
    )
    given = (*STATIONS[:4], "--stations", "hemisphere:8", "--max-incidence-deg", "89")
    assert plan(tmp_path / "points.csv", "--survey", path, *given, "--out", out) == 0
    simulated = tmp_path / "simulation"
    assert plan(out, "--image-points", "--out", simulated, command="simulate") == 0
    found = json.loads((simulated / "simulation.json").read_text("utf-8"))
    assert found["points"] == found["planned"] == 34 and found["sigma_px"] == pytest.approx(0.1, rel=0.15)
    assert (
        found["mount_ratio_squared"] < 4.0
        and 0.36 < found["error_ratio_squared"] < 1.69
        and found["ratio"] == pytest.approx(1, rel=0.15)
    )
    result = json.loads((simulated / "result" / "summary.json").read_text("utf-8"))
    assert set(result["further_observations"]) >= {"plane", "line", "rigid frame", "horizontal direction"}
    assert result["rigs"][0]["moments"] == 8


@pytest.mark.slow
def test_true_errors_are_those_predicted_in_the_mean(tmp_path: Path) -> None:
    """A bar that is known badly: most of the error of points is that of the scale, which is no datum."""
    camera = camera_from_values("small", "brown", (900, 700), (0.005, 0.005), c_mm=6.0, free=())
    plate = shape_object("plate", (500.0, 380.0), 12)
    stations = arrangement("ring:4", plate, camera)
    bar = ScaleBarPlan(plate.names[0], plate.names[11], 1.0)
    seeing = Seeing(sigma_px=0.1)
    prediction = predict_network(plate, camera, stations, seeing, bars=[bar])
    found = describe_plan("plate", "mm", prediction, seeing, WantedPrecision())
    write_page(found, tmp_path / "plan")
    read, squares = read_plan(tmp_path / "plan"), []
    for seed in range(10):
        (tmp_path / str(seed)).mkdir()
        survey = write_simulation(read, tmp_path / str(seed), codes=None, seed=seed)
        result = sfm.run_survey(survey, compare_with="none")
        squares.append(compare_with_plan(read, None, result, seed=seed).error_ratio_squared)
    low, high = chi2_ppf(0.001, 10) / 10, chi2_ppf(0.999, 10) / 10  # of the bar alone
    assert low < np.mean(squares) < high


@pytest.mark.slow
def test_photographs_of_a_planned_rig_are_rendered_and_surveyed(tmp_path: Path) -> None:
    """Mounts to be found, a scale bar: codes name its ends, and the mounts are found within their sigmas."""
    _, truth = make_rig(seed_of("rendered"))
    assert truth.mounts is not None
    mounts = replace(truth.mounts, position=100 * truth.mounts.position)
    small = camera_from_values("left", "brown", (900, 700), (0.005, 0.005), c_mm=6.0, free=())
    cameras = (small, replace(small, name="right"))
    plate = shape_object("plate", (500.0, 380.0), 20)
    seeing = Seeing(diameter=12.0, target=TargetImage(contrast=120, noise=3, blur_px=0.8))
    stations = arrangement("ring:5", plate, small).with_rig(mounts, cameras)
    bar = ScaleBarPlan(plate.names[3], plate.names[16], 0.02)
    prediction = predict_network(plate, cameras, stations, seeing, bars=[bar])
    found = describe_plan("plate", "mm", prediction, seeing, WantedPrecision())
    write_page(found, tmp_path / "plan")
    read = read_plan(tmp_path / "plan")
    assert read.coded[[3, 16]].all()
    result = sfm.run_survey(write_simulation(read, tmp_path), compare_with="none")
    assert result.adjustment.expected_defect == 6 and len(result.adjustment.network.images) == 10
    reached = compare_with_plan(read, "ring14", result)
    assert reached.points == reached.planned == 20
    assert reached.mount_ratio_squared is not None and reached.mount_ratio_squared < 4.0
    assert reached.ratio == pytest.approx(1.0, abs=0.25)
