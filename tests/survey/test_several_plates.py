"""Several plates in one frame, and plates that look alike turned."""

from __future__ import annotations

import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.similarity import fit_similarity
from sfm.orientation.incremental.sequence import Orientation
from sfm.pipeline import run_survey
from sfm.products.drafting.draft import draft_survey
from sfm.products.rendering.render import corner_rays, render_photograph
from sfm.products.rendering.scene import Faces, Optics, Scene, join_marks
from sfm.survey.assembly import settings_by_table
from sfm.survey.board_turns import _is_certain, _Rig
from sfm.survey.diagnosis.codes_found import plates_not_in_result
from sfm.survey.inputs.measurements import MeasuredPhotographs, Measurements, Naming, PhotographList
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.orientation import orient_survey
from sfm.survey.target_network import build_network, min_rays, name_coded, plate_bars
from sfm.targets.codes import boards
from sfm.targets.codes.plates import PlateFamily, group_plates
from sfm.targets.detect import Targets, _of_crossings, find_targets
from sfm.targets.fits.saddle import Saddles
from tests.findings import findings_of
from tests.plates import GRID, PITCH, PIXEL_MM, SIZE_PX, SURVEY, camera, plate_scene, stations
from tests.synthetic import seed_of

APRIL = PlateFamily("aprilgrid", 8, 10, (), "apriltag36h11", 0.75)
OTHER = replace(APRIL, rows=6, columns=8, first_tag=40)
BOARD = PlateFamily("checkerboard", 7, 10)
# the second plate lies to the right of the first, tilted towards it
TURN, PLACE = rotation_from_vector(np.array([0.0, -0.4, 0.1])), np.array([160.0, 5.0, 12.0])


def side_by_side(first: PlateFamily, second: PlateFamily) -> Scene:
    """Return two plates."""
    one, two = plate_scene(first), plate_scene(second)
    faces = Faces(
        np.vstack([one.faces.centre, two.faces.centre @ TURN.T + PLACE]),
        np.concatenate([one.faces.axes, two.faces.axes @ TURN.T]),
        *(np.concatenate([getattr(one.faces, n), getattr(two.faces, n)]) for n in ("half", "value")),
        np.zeros(2),
        np.ones(2),
    )
    marks = join_marks([one.marks, replace(two.marks, face=two.marks.face + 1)])
    return Scene(faces, marks, one.targets)


def written(folder: Path, first: PlateFamily, second: PlateFamily, count: int = 6) -> Path:
    """Render photographs of two plates and write their survey; return its file."""
    folder.mkdir(exist_ok=True)
    scene, truth = side_by_side(first, second), camera()
    rng = seed_of(f"{first.name} {second.name}")
    position, rotation = stations(rng, count, first)
    middle = first.plane(PITCH).mean(axis=0)
    position = middle + 1.9 * (position - middle) + [80.0, 0.0, 0.0]
    rays, optics = corner_rays(truth), Optics(blur_px=0.8, exposure=0.9, noise=0.01, oversampling=3)
    for k in range(count):
        picture, _ = render_photograph(
            scene, truth, position[k], rotation[k], optics=optics, rng=rng, rays=rays
        )
        cv2.imwrite(str(folder / f"{k}.png"), picture)
    text = SURVEY.format(
        name="several",
        polarity="dark",
        pixel=PIXEL_MM,
        datum="control",
        pitch=PITCH,
        codes=first.name,
        rows=first.rows,
        columns=first.columns,
        marks=[list(mark) for mark in first.marks],
    ).replace("marks = []\n", "")
    tags = [
        f'dictionary = "{one.dictionary}"\ntag_size = {one.tag_share * PITCH}\nfirst_tag = {one.first_tag}\n'
        if one.dictionary
        else ""
        for one in (first, second)
    ]
    text = text.replace(f"pitch = {PITCH}\n", f"pitch = {PITCH}\n{tags[0]}")
    text += f'[[plate]]\ncodes = "{second.name}"\nrows = {second.rows}\ncolumns = {second.columns}\n'
    text += f"pitch = {PITCH}\n"
    (folder / "survey.toml").write_text(text + tags[1], encoding="utf-8")
    return folder / "survey.toml"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (APRIL, OTHER),
        *(pytest.param(*two, marks=pytest.mark.slow) for two in ((GRID, BOARD), (BOARD, OTHER))),
    ],
)
def test_a_second_plate_is_measured_in_the_frame_of_the_first(
    tmp_path: Path, first: PlateFamily, second: PlateFamily
) -> None:
    result = run_survey(read_survey(written(tmp_path / "two", first, second)))
    adjustment = result.adjustment
    assert adjustment.estimate.oriented.all()
    number = np.array([int(name) for name in adjustment.network.points])
    beside = number >= first.count
    assert beside.sum() > 0.9 * second.count
    plane = second.plane(PITCH)[number[beside] - first.count]
    found = adjustment.estimate.points[beside]
    error = found - (plane @ TURN.T + PLACE)
    shape = fit_similarity(found, plane)
    print(f"RMS {np.sqrt((error**2).mean()):.4f} mm, scale {shape.scale:.5f}")
    assert np.sqrt((error**2).mean()) < 0.02
    covariance = adjustment.covariance.points[beside]
    ratio = np.sqrt(np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error).mean() / 3)
    assert 0.5 < ratio < 1.7  # errors of the orientations are common to all points of a plate
    assert shape.scale == pytest.approx(1.0, abs=5e-4)


@pytest.mark.slow
def test_a_plate_that_slipped_is_no_good_survey(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By 0.32 mm, which cameras that differ from photograph to photograph take up: such a cause is named."""
    survey = written(tmp_path / "two", APRIL, OTHER)
    monkeypatch.setattr(sys.modules[__name__], "PLACE", PLACE + np.array([0.3, 0.1, 0.0]))
    written(tmp_path / "slipped", APRIL, OTHER)
    for k in (3, 4, 5):
        (tmp_path / "slipped" / f"{k}.png").replace(tmp_path / "two" / f"{k}.png")
    result = run_survey(read_survey(survey))
    (found,) = (one for one in findings_of(result).verdict.remarks if one.severity != "note")
    assert found.kind in ("camera_varies", "rolling_shutter") and found.number("shift") > 5


def two_plates(folder: Path, line: str = "") -> Survey:
    """Return a survey of two AprilGrids, with one line more in the second."""
    tags = 'dictionary = "apriltag36h11"\ntag_size = 9.0\n'
    text = SURVEY.format(
        name="two", polarity="dark", pixel=PIXEL_MM, datum="control", pitch=f"{PITCH}\n{tags}",
        codes="aprilgrid", rows=8, columns=10, marks=[],
    ).replace("marks = []\n", "")  # fmt: skip
    text += f'[[plate]]\ncodes = "aprilgrid"\nrows = 6\ncolumns = 8\npitch = {PITCH}\n{tags}first_tag = 40\n'
    (folder / "survey.toml").write_text(text + line, encoding="utf-8")
    return read_survey(folder / "survey.toml")


def test_a_further_plate_is_as_true_as_the_first(tmp_path: Path) -> None:
    """Before, its diagonals had 0.2 % where nothing is stated, and those of the first none."""

    def bars(line: str, codes: list[int]) -> list[tuple[str, str, float, float]]:
        naming = Naming((), np.array(codes), (), False)
        found = plate_bars(two_plates(tmp_path, line), naming)
        return [(one.start, one.end, one.sigma / one.length, one.sigma) for one in found]

    (first, second) = bars("", list(range(80, 128)))
    assert first[:3] == ("120", "87", 1e-6) and second[:3] == ("80", "127", 1e-6)
    (first, second) = bars("plate_sigma = 0.01", list(range(80, 128)))
    assert first[3] == pytest.approx(0.01 * np.sqrt(2)) == second[3]
    assert bars("", [80]) == [] and len(bars("", [80, 81])) == 2 and len(bars("", [80, 89])) == 1  # across
    assert [name for name, _ in settings_by_table(two_plates(tmp_path))][1:3] == ["targets", "plate 2"]


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), [(APRIL, OTHER), (GRID, BOARD)])
def test_two_plates_in_one_folder_are_both_drafted(
    tmp_path: Path, first: PlateFamily, second: PlateFamily
) -> None:
    folder = written(tmp_path / "two", first, second).parent
    sections = tomllib.loads(draft_survey(folder).text)
    drafted = [sections["targets"], *sections["plate"]]
    size = {(one["codes"], one["rows"], one["columns"], one.get("first_tag", 0)) for one in drafted}
    assert size == {(one.name, one.rows, one.columns, one.first_tag) for one in (first, second)}


def test_points_are_numbered_on_and_found_in_one_photograph(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tags of all plates are read once."""
    read = []
    reading = boards.read_april_tags
    monkeypatch.setattr(boards, "read_april_tags", lambda *what: read.append(1) or reading(*what))
    scene, truth = side_by_side(APRIL, OTHER), camera()
    rng = seed_of("numbered on")
    position, rotation = stations(rng, 1, APRIL)
    at = 1.9 * position[0] + [20.0, 40.0, 0.0]
    picture, _ = render_photograph(scene, truth, at, rotation[0], optics=Optics(noise=0.01), rng=rng)
    found = find_targets(picture, codes=group_plates([APRIL, OTHER]))
    assert len(read) == 1
    assert found.code.min() == 0 and found.code.max() == APRIL.count + OTHER.count - 1
    xyz = np.vstack([APRIL.plane(PITCH), OTHER.plane(PITCH) @ TURN.T + PLACE])
    assert np.abs(found.xy - project(truth, at, rotation[0], xyz)[found.code]).max() < 0.3


@pytest.mark.parametrize(
    ("plates", "message"),
    [
        ((GRID, PlateFamily("checkerboard", 8, 10)), "looks alike when it is turned"),
        ((GRID, replace(GRID, rows=10)), "are not distinguished"),
        ((BOARD, PlateFamily("charuco", 7, 10, (), "aruco5x5_50", 0.5)), "are not distinguished"),
        ((APRIL, replace(APRIL, first_tag=19)), "are not distinguished"),
    ],
)
def test_plates_without_a_place_or_a_name_are_refused(plates: list[PlateFamily], message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        group_plates(plates)


def test_plates_of_a_survey_must_be_complete(tmp_path: Path) -> None:
    text = SURVEY.format(
        name="two", polarity="dark", pixel=PIXEL_MM, datum="control", pitch=PITCH,
        codes="checkerboard", rows=7, columns=10, marks=[],
    ).replace("marks = []\n", "")  # fmt: skip
    for plate, message in (
        ('codes = "ring14"', "plate 2: codes = 'ring14' is not a plate"),
        ('codes = "grid"\nrows = 5', "plate 2: targets.columns is missing"),
        ('codes = "checkerboard"\nrows = 5\ncolumns = 6\npitch = 3.0', "are not distinguished"),
    ):
        (tmp_path / "survey.toml").write_text(f"{text}[[plate]]\n{plate}\n", encoding="utf-8")
        with pytest.raises(SurveyFileError, match=message):
            read_survey(tmp_path / "survey.toml")
    text = text.replace('kind = "control"', 'kind = "free"')
    rings = text.replace('codes = "checkerboard"\nrows = 7\ncolumns = 10\npitch = 12.0', 'codes = "ring14"')
    (tmp_path / "survey.toml").write_text(f'{rings}[[plate]]\ncodes = "grid"\n', encoding="utf-8")
    with pytest.raises(SurveyFileError, match="needed the first plate"):
        read_survey(tmp_path / "survey.toml")


def test_a_plate_without_a_point_in_the_result_is_reported() -> None:
    """Before, a plate that one photograph showed counted as seen, and the survey as one that worked."""
    plates = group_plates([GRID, APRIL, BOARD])
    first, second, third = (np.arange(one.first_point, one.last_point + 1) for one in plates.plates)
    assert plates_not_in_result(plates, np.concatenate([first, second[:1], third, [-1]])) == ()
    (lost,) = plates_not_in_result(plates, np.concatenate([first, third]))
    assert (lost.kind, lost.severity) == ("plate_not_in_result", "warning")
    assert lost.names("codes") == ("aprilgrid",)


TURNS = {
    PlateFamily("checkerboard", 6, 9): 0,
    PlateFamily("checkerboard", 7, 9): 1,
    PlateFamily("checkerboard", 6, 8): 1,
    PlateFamily("checkerboard", 7, 7): 1,  # colours tell one that is turned by 90 degrees
    PlateFamily("checkerboard", 8, 8): 3,
    PlateFamily("grid", 8, 9): 1,
    PlateFamily("grid", 9, 9): 3,
    PlateFamily("grid", 9, 9, ((2, 3), (4, 4), (5, 2))): 0,
    PlateFamily("asymmetric-grid", 11, 4): 0,
    PlateFamily("asymmetric-grid", 12, 4): 1,
    PlateFamily("hexagonal-grid", 9, 9): 0,
    PlateFamily("hexagonal-grid", 8, 9): 1,
    PlateFamily("charuco", 7, 9, (), "aruco4x4_50", 0.7): 0,
}
BASE = np.array([90.0, 0.0, 5.0])
CONVERGENCE = rotation_from_vector(np.array([0.01, 0.3, -0.02]))


@pytest.mark.parametrize("plate", TURNS, ids=lambda one: f"{one.name} {one.rows} x {one.columns}")
def test_turns_bring_a_plate_onto_itself(plate: PlateFamily) -> None:
    assert len(plate.turns) == TURNS[plate]
    middle = plate.plane(1.0).mean(axis=0)
    for number in plate.turns:
        away = plate.plane(1.0) - middle
        assert np.hypot(*away.T[:2]) == pytest.approx(np.hypot(*away[number].T[:2]))
        assert sorted(number.tolist()) == list(range(plate.count))
        if plate.name == "checkerboard":
            row, column = np.divmod(number[[0, plate.columns + 1]], plate.columns)
            assert (row.min() + column.min()) % 2 == 0


def measured_pairs(
    folder: Path, plate: PlateFamily, names: list[str], right_names: list[str], *, roll: float,
    moved: float = 1.0, apart: tuple[int, ...] = (),
) -> tuple[Measurements, Orientation, MeasuredPhotographs]:  # fmt: skip
    """Return a plate before two cameras, each photograph named as it is upright, and its orientation.

    Args:
        roll: of the right camera, rad.
        moved: by how much the plate is moved between pairs.
        apart: pairs that are not of one moment.
    """
    text = SURVEY.format(
        name="pairs", polarity="dark", pixel=PIXEL_MM, codes=plate.name, rows=plate.rows,
        columns=plate.columns, pitch=PITCH, marks=[], datum="control",
    ).replace("marks = []\n", "")  # fmt: skip
    begin, end = text.index("[[camera]]"), text.index("[targets]")
    sides = [
        text[begin:end].replace('"small"', f'"{s}"').replace("*.png", f"{s}*") for s in ("left", "right")
    ]
    (folder / "survey.toml").write_text(text[:begin] + "".join(sides) + text[end:])
    survey, rng = read_survey(folder / "survey.toml"), seed_of(f"pairs {plate.rows} {roll} {moved}")
    cameras = [
        camera_from_values(name, "brown", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=8.0, free=("c",))
        for name in ("left", "right")
    ]
    X = plate.plane(PITCH)
    targets: list[list[Targets]] = [[], []]
    for k in range(len(names)):
        turn = rotation_from_vector(np.array([0.0, 0.0, moved * rng.uniform(-np.pi, np.pi)]))
        R = rotation_from_vector(moved * np.array([*rng.uniform(-0.3, 0.3, 2), 0.0]) + (0.2, 0.1, 0.0)) @ turn
        X0 = X.mean(axis=0) + R @ (moved * rng.uniform(-12, 12, 3) + (-45.0, 0.0, 330.0))
        right_R = (
            R @ CONVERGENCE @ rotation_from_vector(np.array([0.0, 0.0, roll + (1 + 0.8 * k) * (k in apart)]))
        )
        for side, at, rotation in ((0, X0, R), (1, X0 + R @ BASE, right_R)):
            xy = project(cameras[side], at, rotation, X) + 0.03 * rng.standard_normal((plate.count, 2))
            targets[side].append(upright(xy, plate))
    every = [*names, *right_names]
    camera = np.repeat([0, 1], len(names))
    paths = tuple(folder / name for name in every)
    photographs = MeasuredPhotographs(
        tuple(every), paths, camera, tuple(cameras), (*targets[0], *targets[1]), ()
    )
    naming = name_coded(photographs)
    measured = Measurements(
        build_network(survey, photographs, naming), tuple(cameras), tuple(every), min_rays(naming),
        files=PhotographList(tuple(every), paths, camera, folder), photographs=photographs, naming=naming,
    )  # fmt: skip
    oriented = orient_survey(survey, measured)
    found, start = oriented.measured, oriented.orientation
    return found, start, photographs


def upright(xy: FloatArray, plate: PlateFamily) -> Targets:
    """Return the crossings of a plate, named in the turn in which its columns run to the right most."""
    ways = [np.arange(plate.count), *plate.turns]
    code = max(ways, key=lambda way: float(xy[way.argsort()][plate.columns - 1, 0] - xy[way.argsort()][0, 0]))
    k = len(xy)
    return _of_crossings(Saddles(xy, np.tile(1e-3 * np.eye(2), (k, 1, 1)), np.ones(k), np.ones(k)), code)


def bases(measured: Measurements, start: Orientation, count: int) -> FloatArray:
    """Return the base of each pair in the frame of its left photograph, mm, (p, 3)."""
    R, X0 = start.estimate.rotation, start.estimate.position
    return np.array([R[k].T @ (X0[count + k] - X0[k]) for k in range(count)])


def numbered(side: str, count: int, first: int = 1) -> list[str]:
    return [f"{side} {k + first:02d}.png" for k in range(count)]


@pytest.mark.parametrize(
    ("plate", "roll", "first"),
    [
        (PlateFamily("checkerboard", 7, 9), 1.3, 1),
        (PlateFamily("checkerboard", 8, 8), 0.8, 101),  # photographs in order, numbers without meaning
        (PlateFamily("grid", 8, 10), 2.8, 1),
    ],
)
def test_both_cameras_see_the_plate_in_one_turn(
    plate: PlateFamily, roll: float, first: int, tmp_path: Path
) -> None:
    left, right = numbered("left", 8), numbered("right", 8, first)
    measured, start, before = measured_pairs(tmp_path, plate, left, right, roll=roll)
    assert "plate_looks_alike_turned" not in [one.kind for one in start.remarks]
    assert np.abs(bases(measured, start, 8) - BASE).max() < 3
    assert measured.photographs is not None
    codes = zip(before.targets, measured.photographs.targets, strict=True)
    renamed = [bool((one.code != two.code).any()) for one, two in codes]
    assert not any(renamed[:8]) and any(renamed[8:])  # they were not in one turn


@pytest.mark.parametrize(("moved", "apart"), [(0.0, ()), (1.0, (0, 2, 3, 4, 5))])
def test_an_undecided_turn_is_reported(moved: float, apart: tuple[int, ...], tmp_path: Path) -> None:
    """A plate that was not moved, and photographs most of which are not of one moment."""
    names = numbered("left", 6), numbered("right", 6)
    plate = PlateFamily("checkerboard", 7, 9)
    _, start, _ = measured_pairs(tmp_path, plate, *names, roll=2.8, moved=moved, apart=apart)
    (told,) = [one for one in start.remarks if one.kind == "plate_looks_alike_turned"]
    assert len(told.names("photographs")) == 12 and told.names("cameras") == ("left", "right")


def test_a_pair_of_two_moments_is_reported(tmp_path: Path) -> None:
    names = numbered("left", 6), numbered("right", 6)
    plate = PlateFamily("checkerboard", 7, 9)
    measured, start, _ = measured_pairs(tmp_path, plate, *names, roll=2.8, apart=(3,))
    (told,) = [one for one in start.remarks if one.kind == "plate_looks_alike_turned"]
    assert told.names("photographs") == ("left 04.png", "right 04.png")
    assert np.abs(np.delete(bases(measured, start, 6), 3, axis=0) - BASE).max() < 3


def test_a_turn_is_certain_at_one_in_a_thousand() -> None:
    """F of 6 and 6 degrees of freedom exceeds 20.03 so often (Abramowitz, Stegun 1964, table 26.9)."""
    both = np.ones(2, dtype=bool)
    best = _Rig(np.zeros(2, dtype=np.int64), np.full(2, 0.1), both)
    for ratio, level, is_certain in ((18.0, 1e-3, False), (22.0, 1e-3, True), (22.0, 1e-4, False)):
        other = _Rig(np.ones(2, dtype=np.int64), np.full(2, 0.1 * ratio**0.5), both)
        assert _is_certain(best, [other], 2, level) == is_certain
