"""Several plates that are fixed to one another: those beside the first are measured in its frame."""

from __future__ import annotations

import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.camera import project
from sfm.conventions import rotation_from_vector
from sfm.errors import GeometryError, SurveyFileError
from sfm.pipeline import run_survey
from sfm.rendering.render import corner_rays, render_photograph
from sfm.rendering.scene import Faces, Optics, Scene, join_marks
from sfm.report.findings.survey_remarks import findings_of
from sfm.similarity import fit_similarity
from sfm.survey.assembly import settings_by_table
from sfm.survey.diagnosis.codes_found import plates_not_in_result
from sfm.survey.drafting.draft import draft_survey
from sfm.survey.inputs.measurements import Naming
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.target_network import plate_bars
from sfm.targets.codes import boards
from sfm.targets.codes.plates import PlateFamily, group_plates
from sfm.targets.detect import find_targets
from tests.plates import GRID, PITCH, PIXEL_MM, SURVEY, camera, plate_scene, stations
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
def test_a_plate_that_slipped_is_named_and_not_the_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By 0.32 mm; before, a camera that differs from photograph to photograph was."""
    survey = written(tmp_path / "two", APRIL, OTHER)
    slip = np.array([0.3, 0.1, 0.0])
    monkeypatch.setattr(sys.modules[__name__], "PLACE", PLACE + slip)
    written(tmp_path / "slipped", APRIL, OTHER)
    for k in (3, 4, 5):
        (tmp_path / "slipped" / f"{k}.png").replace(tmp_path / "two" / f"{k}.png")
    result = run_survey(read_survey(survey))
    (found,) = (one for one in findings_of(result).verdict.remarks if one.severity != "note")
    assert found.kind == "plate_moved" and found.names("from") == ("3.png",)
    assert {int(name) for name in found.names("points")} == set(range(80, 128))
    assert found.number("distance") == pytest.approx(np.linalg.norm(slip), rel=0.1)


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
        ('codes = "ring14"', "plate 2: codes = 'ring14' is no plate"),
        ('codes = "grid"\nrows = 5', "plate 2: targets.columns is missing"),
        ('codes = "checkerboard"\nrows = 5\ncolumns = 6\npitch = 3.0', "are not distinguished"),
    ):
        (tmp_path / "survey.toml").write_text(f"{text}[[plate]]\n{plate}\n", encoding="utf-8")
        with pytest.raises(SurveyFileError, match=message):
            read_survey(tmp_path / "survey.toml")
    text = text.replace('kind = "control"', 'kind = "free"')
    rings = text.replace('codes = "checkerboard"\nrows = 7\ncolumns = 10\npitch = 12.0', 'codes = "ring14"')
    (tmp_path / "survey.toml").write_text(f'{rings}[[plate]]\ncodes = "grid"\n', encoding="utf-8")
    with pytest.raises(SurveyFileError, match="needed a first plate"):
        read_survey(tmp_path / "survey.toml")


def test_a_plate_without_a_point_in_the_result_is_reported() -> None:
    """Before, a plate that one photograph showed counted as seen, and the survey as one that worked."""
    plates = group_plates([GRID, APRIL, BOARD])
    first, second, third = (np.arange(one.first_point, one.last_point + 1) for one in plates.plates)
    assert plates_not_in_result(plates, np.concatenate([first, second[:1], third, [-1]])) == ()
    (lost,) = plates_not_in_result(plates, np.concatenate([first, third]))
    assert (lost.kind, lost.severity) == ("plate_not_in_result", "warning")
    assert lost.names("codes") == ("aprilgrid",)
