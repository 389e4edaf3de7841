"""A session of marking: from a click to coordinates, and what may happen to its files."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.remarks.remark import of_kind
from sfm.pipeline import run_survey
from sfm.products.marking.clicks import Measured
from sfm.products.marking.project import MarkedProject, project_of_folder, project_of_survey
from sfm.products.marking.session import MOST_WAITING, MarkError, MarkingSession
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.marks_file import Kind, Mark, Marking, StatedPoint, read_marks
from sfm.survey.inputs.survey import CameraSetup, Survey, read_survey
from tests.products.marking.photographs import LENS, seen_points, stations

BOARD = np.array([[-0.6 + 0.4 * (k % 4), -0.6 + 0.4 * (k // 4), 0.15 * (k % 3)] for k in range(16)])
SHRINK = 4  # of the lens of the photographs
SURVEY = """[survey]
name = "board"
unit = "m"

[[camera]]
name = "lens"
images = "i*.png"
pixel_mm = [0.016, 0.016]
c_mm = 9.0
model = "brown"
free = []
"""


def write_board(folder: Path, count: int) -> FloatArray:
    """Write photographs of dots on a textured ground, and return their places, px, (m, n, 2)."""
    pictures, xy = pictures_of_board(count)
    for i, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"i{i}.png"), picture)
    return xy.copy()


@cache
def pictures_of_board(count: int) -> tuple[tuple[AnyArray, ...], FloatArray]:
    """Return the photographs and the places of the dots."""
    rng = np.random.default_rng(4)
    places, rotations = stations(rng, count, around=1.4)
    xy = (seen_points(places, rotations, BOARD) + 0.5) / SHRINK - 0.5
    pictures = []
    for i in range(count):
        picture = np.full((4 * 500, 4 * 750), 200.0, dtype=np.float32)
        for j, (x, y) in enumerate(xy[i]):
            centre = tuple(round(float(4 * (v + 0.5) - 0.5)) for v in (x, y))
            exact = (4 * (xy[i, j] + 0.5) - 0.5 - np.array(centre)) * 16
            at = (16 * centre[0] + round(exact[0]), 16 * centre[1] + round(exact[1]))
            cv2.circle(picture, at, 16 * 24, 40, -1, 8, 4)
        small = cv2.resize(cv2.GaussianBlur(picture, (0, 0), 3), (750, 500), interpolation=cv2.INTER_AREA)
        noisy = small + rng.normal(0, 1.0, small.shape)
        pictures.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return tuple(pictures), np.asarray(xy)


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FloatArray]:
    folder = tmp_path_factory.mktemp("board")
    return folder, write_board(folder, 4)


def project_of(folder: Path) -> MarkedProject:
    (folder / "survey.toml").write_text(SURVEY, encoding="utf-8")
    file = folder / "survey.toml"
    return project_of_survey(read_survey(file), survey_file=file)


@pytest.fixture
def session(board: tuple[Path, FloatArray], tmp_path: Path) -> Iterator[MarkingSession]:
    made = MarkingSession(project_of(board[0]), tmp_path / "marks.csv")
    yield made
    made.close()


def settled(session: MarkingSession) -> dict[str, Any]:
    state = session.state()
    end = time.monotonic() + 60
    while state["adjustment"]["state"] == "running" and time.monotonic() < end:
        state = session.state(state["version"], wait_s=5)
    return state


def orient(session: MarkingSession, xy: FloatArray, photographs: int = 4) -> None:
    """Orient the first photographs by known points, which no others hide."""
    for j in (1, 3, 8, 15, 9):
        session.set_control(f"K{j}", StatedPoint((*BOARD[j].tolist(),), (0.0, 0.0, 0.0)))  # type: ignore[arg-type]
        for i in range(photographs):
            session.click(i, *(xy[i, j] + (2, -1)), point=f"K{j}")
    assert [p["oriented"] for p in settled(session)["photographs"]] == [k < photographs for k in range(4)]


def test_click_left_match_right_coordinates(session: MarkingSession, board: tuple[Path, FloatArray]) -> None:
    """The fields of document 002: a point of the left photograph, its match in the right one, X, Y, Z."""
    _, xy = board
    orient(session, xy, photographs=2)
    answer = session.click(0, *(xy[0, 6] + (1.5, 2.0)))
    name = answer["mark"]["point"]
    (proposed,) = [row for row in settled(session)["proposals"] if row["point"] == name]
    assert proposed["image"] == 1 and proposed["measured"]
    assert np.hypot(proposed["x"] - xy[1, 6, 0], proposed["y"] - xy[1, 6, 1]) < 0.1
    session.accept(1, name)
    (point,) = [row for row in settled(session)["points"] if row["name"] == name]
    assert point["rays"] == 2
    error = np.array(point["X"]) - BOARD[6]
    assert (np.abs(error) < 5 * np.array(point["sigma"]) + 1e-4).all()
    assert np.linalg.norm(error) < 2e-3


def test_an_adjusted_mark_has_its_residual_and_the_next_step_is_said(
    session: MarkingSession, board: tuple[Path, FloatArray]
) -> None:
    _, xy = board
    assert "Click a point" in session.state()["next"]
    orient(session, xy)
    state = settled(session)
    assert all(mark["residual"] is not None and mark["test"] is not None for mark in state["marks"])
    assert state["adjustment"]["state"] == "done" and not state["adjustment"]["worst"]["flagged"]
    session.delete("K9", 2)
    session.click(2, *(xy[2, 10]), point="K9")  # the neighbour
    worst = settled(session)["adjustment"]["worst"]
    assert (worst["image"], worst["point"], worst["flagged"]) == (2, "K9", True)
    assert session.state()["next"] == "Check K9 in i2.png: it does not fit the other marks."
    session.undo()
    assert not settled(session)["adjustment"]["worst"]["flagged"]


def test_everything_is_undone_and_made_again(session: MarkingSession, board: tuple[Path, FloatArray]) -> None:
    _, xy = board
    changes = [
        lambda: session.click(0, *xy[0, 1]),
        lambda: session.click(1, *xy[1, 1], point="P1"),
        lambda: session.click(1, 20.0, 30.0, kind="hand", sigma_px=2.0),
        lambda: session.rename("P1", "bolt"),
        lambda: session.set_control("bolt", StatedPoint((1.0, 2.0, 3.0), (0.1, 0.1, 0.1))),
        lambda: session.delete("P2"),
    ]
    files = []
    for change in changes:
        change()
        files.append(session._saved.path.read_bytes())
    said = ["P1 marked in i0.png", "P1 marked in i1.png", "P2 marked in i1.png", "P1 renamed bolt"]
    said += ["coordinates of bolt stated", "P2 deleted"]
    for before in (*files[-2::-1], None):
        assert session.state()["undo"]["what"] == said.pop()
        session.undo()
        if before is not None:
            assert session._saved.path.read_bytes() == before
    assert read_marks(session._saved.path).marks == {}
    assert session.state()["undo"] is None
    for after in files:
        session.redo()
        assert session._saved.path.read_bytes() == after
    assert session.state()["redo"] is None


def test_only_what_the_page_showed_is_accepted(
    session: MarkingSession, board: tuple[Path, FloatArray]
) -> None:
    _, xy = board
    orient(session, xy)
    before = settled(session)["version"]
    for i in (0, 1):
        session.click(i, *xy[i, 2], point="P")
    after = settled(session)
    measured = [row for row in after["proposals"] if row["measured"] and row["point"] == "P"]
    assert {row["image"] for row in measured} == {2, 3}
    for decide in (session.accept, session.refuse):
        with pytest.raises(MarkError, match="came later than what the page shows"):
            decide(None, "P", seen=before)
    answer = session.accept(2, "P", seen=after["version"])
    assert answer["count"] == 1
    assert session.accept(seen=after["version"])["count"] == 1  # what was seen and has not moved
    assert {mark["image"] for mark in session.state()["marks"] if mark["point"] == "P"} == {0, 1, 2, 3}


def test_another_page_undoes_a_change_only_when_it_says_so(
    session: MarkingSession, board: tuple[Path, FloatArray]
) -> None:
    _, xy = board
    session.click(0, *xy[0, 1], page="left")
    first = session.state()["undo"]
    assert (first["what"], first["page"]) == ("P1 marked in i0.png", "left")
    with pytest.raises(MarkError, match=r"another page made this change: P1 marked in i0\.png"):
        session.undo(first["number"], page="right")
    session.click(0, *xy[0, 2], page="right")
    for page in ("left", "right"):
        with pytest.raises(MarkError, match=r"something else was changed: P2 marked in i0\.png"):
            session.undo(first["number"], page=page)
    assert session.undo(page="right")["undo"] == first
    state = session.undo(first["number"], page="right", anyway=True)
    assert state["marks"] == [] and state["undo"] is None
    assert state["redo"] == first
    with pytest.raises(MarkError, match="no such change"):
        session.undo()
    mark = Mark("i0.png", "A", 10.0, 20.0, 1.0, 0.0, 1.0, "hand", "hand", when="t")
    assert session.add(Marking("board").with_mark(mark)) == 1  # by --import, which is no page
    assert session.undo(page="right")["marks"] == []


def test_a_few_pages_wait_at_a_time_and_the_oldest_is_answered(session: MarkingSession) -> None:
    version, answered = settled(session)["version"], list[int]()

    def wait(page: int) -> None:
        session.state(version, wait_s=60)
        answered.append(page)

    pages = [threading.Thread(target=wait, args=(page,)) for page in range(MOST_WAITING + 2)]
    for page in pages:
        page.start()
        time.sleep(0.2)
    for page in pages[:2]:
        page.join(10)
    assert answered == [0, 1]
    session.click(0, 10.0, 90.5, kind="hand")
    for page in pages:
        page.join(10)
    assert len(answered) == len(pages)


def test_values_of_the_survey_are_not_taken_back_by_the_page(tmp_path: Path) -> None:
    write_board(tmp_path, 2)
    (tmp_path / "control.csv").write_text(
        "id,X,Y,Z,sX,sY,sZ\nA,0,0,0,0.01,0.01,0.01\nB,1,0,0,0.01,0.01,0.01\n", encoding="utf-8"
    )
    file = tmp_path / "with_control.toml"
    bar = '[[scale_bar]]\nfrom = "A"\nto = "B"\nlength = 1.0\nsigma = 0.01\n'
    file.write_text(f'{SURVEY}{bar}[control]\nfile = "control.csv"\n', encoding="utf-8")
    session = MarkingSession(project_of_survey(read_survey(file), survey_file=file), tmp_path / "marks.csv")
    state = session.state()
    assert state["bars"][0]["given"] and all(point["control"]["given"] for point in state["points"])
    with pytest.raises(MarkError, match="those of the survey stay"):
        session.set_control("A", None)
    with pytest.raises(MarkError, match="one of the survey stays"):
        session.set_bar("B", "A", None)
    assert session.state()["undo"] is None
    session.set_control("A", StatedPoint((5.0, 0.0, 0.0), (0.01, 0.01, 0.01)))
    assert not session.state()["points"][0]["control"]["given"]
    assert session.set_control("A", None)["points"][0]["control"]["X"] == [0.0, 0.0, 0.0]
    with pytest.raises(MarkError, match="no family of codes"):
        session.click(0, 10.0, 10.0, kind="ring")
    session.close()


def test_a_length_has_a_unit_when_its_bar_is_marked(
    session: MarkingSession, board: tuple[Path, FloatArray]
) -> None:
    _, xy = board
    for j in range(8):
        for i in (0, 1):
            session.click(i, *xy[i, j], point=f"D{j}")
    assert any(photograph["oriented"] for photograph in settled(session)["photographs"])
    length = float(np.linalg.norm(BOARD[9] - BOARD[0]))
    session.set_bar("D0", "D9", ScaleBar("D0", "D9", length, 0.0001))
    assert not settled(session)["scaled"]
    for i in (0, 1):  # its other end, after the photographs are oriented
        session.click(i, *xy[i, 9], point="D9")
    state = settled(session)
    assert state["scaled"] and abs(state["bars"][0]["residual"]) < 1e-3
    X = {point["name"]: np.array(point["X"]) for point in state["points"]}
    assert np.linalg.norm(X["D6"] - X["D1"]) == pytest.approx(np.linalg.norm(BOARD[6] - BOARD[1]), rel=0.01)


def test_another_ring_than_at_the_other_marks_is_refused(
    session: MarkingSession, board: tuple[Path, FloatArray], monkeypatch: pytest.MonkeyPatch
) -> None:
    codes = {0: 12, 1: 15, 2: 12, 3: None}
    image = {session.pixels.grey(i)[::50, ::50].tobytes(): i for i in range(4)}

    def ring(photograph: AnyArray, x: float, y: float, kind: Kind | None = None, **_: object) -> Measured:
        code = codes[image[photograph[::50, ::50].tobytes()]]
        return Measured(x, y, 0.01 * np.eye(2), "target" if code is None else "ring", np.zeros((0, 2)), code)

    monkeypatch.setattr("sfm.products.marking.session.measure_click", ring)
    session.click(0, 50.0, 50.0, point="bolt")
    session._fits.clear()  # as after a restart
    with pytest.raises(MarkError, match=r"this is ring 15, but 'bolt' is ring 12 in i0\.png"):
        session.click(1, 50.0, 50.0, point="bolt")
    for i in (2, 3, 0):  # a code that is not read contradicts nothing, and a mark may be measured again
        assert not session.click(i, 50.0, 50.0, point="bolt")["note"]
    assert session.click(1, 80.0, 80.0, point="12")["note"] == "its code is 15"
    assert {mark["image"] for mark in session.state()["marks"] if mark["point"] == "bolt"} == {0, 2, 3}


def test_no_neighbour_is_proposed_after_a_restart(tmp_path: Path) -> None:
    """The dot of the point is gone in one photograph, and one of three times its size is there."""
    xy = write_board(tmp_path, 4)
    picture = cv2.imread(str(tmp_path / "i3.png"), cv2.IMREAD_GRAYSCALE)
    cv2.circle(picture, tuple(round(16 * float(v)) for v in xy[3, 2]), 16 * 18, 40, -1, cv2.LINE_AA, 4)
    cv2.imwrite(str(tmp_path / "i3.png"), cv2.GaussianBlur(picture, (0, 0), 0.8))
    pictures = []
    for start in range(2):
        session = MarkingSession(project_of(tmp_path), tmp_path / "marks.csv")
        if not start:
            orient(session, xy)
            for i in (0, 1):
                session.click(i, *xy[i, 2], point="P")
        state = settled(session)
        measured = {row["image"]: row["measured"] for row in state["proposals"] if row["point"] == "P"}
        assert measured == {2: True, 3: False}
        pictures.append(session.fit_picture(0, "P"))
        session.close()
    assert pictures[0] == pictures[1]  # they show what was fitted, as before


def test_a_changed_photograph_is_told_until_all_its_marks_are_measured_again(tmp_path: Path) -> None:
    xy = write_board(tmp_path, 4)
    session = MarkingSession(project_of(tmp_path), tmp_path / "marks.csv")
    for j in (1, 2):
        session.click(0, *xy[0, j], point=f"D{j}")
    session.close()
    picture = cv2.imread(str(tmp_path / "i0.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "i0.png"), picture // 2 + 60)
    session = MarkingSession(project_of(tmp_path), tmp_path / "marks.csv")
    told = [settled(session)["photographs"][0]["changed"]]
    for j in (1, 2):
        session.click(0, *xy[0, j], point=f"D{j}")
        told.append(session.state()["photographs"][0]["changed"])
    assert told[0] and told[1] and told[2] is None
    session.undo()
    assert session.state()["photographs"][0]["changed"]
    session.close()


def test_a_run_tells_photographs_that_changed_since_they_were_marked(tmp_path: Path) -> None:
    xy = write_board(tmp_path, 4)
    session = MarkingSession(project_of(tmp_path), tmp_path / "marks.csv")
    orient(session, xy)
    session.close()
    file = tmp_path / "marked.toml"
    file.write_text(f'{SURVEY}[targets]\n[marks]\nfile = "marks.csv"\n', encoding="utf-8")
    picture = cv2.imread(str(tmp_path / "i2.png"), cv2.IMREAD_GRAYSCALE)
    for changed in (False, True):
        if changed:
            cv2.imwrite(str(tmp_path / "i2.png"), picture - picture // 20)
        verdict = run_survey(read_survey(file)).verdict
        said = of_kind(verdict.remarks, "photographs_changed")
        assert [row.names("photographs") for row in said] == ([("i2.png",)] if changed else [])


def test_by_hand_has_the_stated_sigma(session: MarkingSession) -> None:
    mark = session.click(0, 100.25, 90.5, kind="hand", sigma_px=0.5)["mark"]
    assert (mark["x"], mark["y"], mark["sigma"], mark["by"]) == (100.25, 90.5, [0.5, 0.5], "hand")
    assert session.click(0, 10.0, 90.5, kind="hand")["mark"]["sigma"] == [1.0, 1.0]
    with pytest.raises(MarkError, match="outside"):
        session.click(0, 5000.0, 1.0, kind="hand")


def test_names_are_not_mixed(session: MarkingSession, board: tuple[Path, FloatArray]) -> None:
    _, xy = board
    session.click(0, *xy[0, 1], point="A")
    session.click(0, *xy[0, 2], point="B")
    with pytest.raises(MarkError, match="has a mark in"):
        session.rename("A", "B")
    session.click(1, *xy[1, 2], point="C")
    session.rename("C", "B")  # both are one point
    assert {(mark["image"], mark["point"]) for mark in session.state()["marks"]} == {
        (0, "A"),
        (0, "B"),
        (1, "B"),
    }
    for wrong in ("", " x", "a\nb", "\u202e"):
        with pytest.raises(MarkError):
            session.rename("A", wrong)


def test_photographs_that_changed_or_are_missing_are_named_and_their_marks_kept(
    board: tuple[Path, FloatArray], tmp_path: Path
) -> None:
    folder = tmp_path / "photographs"
    folder.mkdir()
    xy = write_board(folder, 4)
    marks = tmp_path / "marks.csv"
    first = MarkingSession(project_of(folder), marks)
    first.click(0, *xy[0, 1], point="A")
    first.click(1, *xy[1, 1], point="A")
    first.close()
    picture = cv2.imread(str(folder / "i0.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(folder / "i0.png"), 255 - picture)
    (folder / "i1.png").unlink()
    again = MarkingSession(project_of(folder), marks)
    state = settled(again)
    assert "changed since it was marked" in state["photographs"][0]["changed"]
    assert "i1.png has marks, but is not among the photographs" in state["next"]
    again.click(0, *xy[0, 2], point="B")
    again.close()
    assert set(read_marks(marks).marks) == {("i0.png", "A"), ("i1.png", "A"), ("i0.png", "B")}


def test_what_a_survey_gives_is_looked_at_renamed_and_refused(
    board: tuple[Path, FloatArray], tmp_path: Path
) -> None:
    folder, xy = board
    rows = [f"i{i}.png,{j},{x},{y}" for i in range(4) for j, (x, y) in enumerate(xy[i])]
    (folder / "given.csv").write_text("\n".join(["image,point,x_px,y_px", *rows]) + "\n", encoding="utf-8")
    file = folder / "with_given.toml"
    file.write_text(SURVEY + '[[observations]]\nfile = "given.csv"\nsigma_px = 0.1\n', encoding="utf-8")
    session = MarkingSession(project_of_survey(read_survey(file), survey_file=file), tmp_path / "marks.csv")
    state = settled(session)
    assert all(mark["automatic"] for mark in state["marks"]) and len(state["marks"]) == 64
    assert all(photograph["oriented"] for photograph in state["photographs"])
    session.refuse(2, "7")
    assert (2, "7") not in {(mark["image"], mark["point"]) for mark in session.state()["marks"]}
    session.rename("3", "bolt")
    state = settled(session)
    names = {(mark["image"], mark["point"]) for mark in state["marks"]}
    assert {(i, "bolt") for i in range(4)} <= names and not {(i, "3") for i in range(4)} & names
    session.click(1, *(xy[1, 5] + 2), point="5")  # measured again
    (mark,) = [m for m in session.state()["marks"] if (m["image"], m["point"]) == (1, "5")]
    assert not mark["automatic"] and mark["kind"] == "target"
    session.close()


def test_a_survey_takes_its_marks_and_finds_the_other_targets(
    board: tuple[Path, FloatArray], tmp_path: Path
) -> None:
    folder, xy = board
    session = MarkingSession(project_of(folder), folder / "marks.csv")
    orient(session, xy)
    session.close()
    file = folder / "marked.toml"
    file.write_text(
        SURVEY + '[targets]\n[datum]\nkind = "control"\n[marks]\nfile = "marks.csv"\n', encoding="utf-8"
    )
    result = run_survey(read_survey(file))
    adjustment = result.adjustment
    assert adjustment.converged and len(adjustment.network.images) == 4
    assert len(adjustment.network.points) == 16
    points = adjustment.estimate.points
    away = np.linalg.norm(points[:, None] - BOARD, axis=2).min(axis=1)
    assert away.max() < 2e-3
    (folder / "marks.csv").unlink()


def test_a_folder_is_marked_without_a_survey(board: tuple[Path, FloatArray], tmp_path: Path) -> None:
    project = project_of_folder(board[0])
    assert project.survey.unit == "mm" and len(project.sizes) == 4
    assert project.survey_file is None


def test_the_lens_of_the_photographs_is_that_of_the_survey() -> None:
    camera = CameraSetup(name="lens", images=["*.png"], size_px=[750, 500], pixel_mm=[0.016, 0.016], c_mm=9.0)
    survey = Survey(name="board", cameras=(camera,))
    assert survey.cameras[0].c_mm == LENS.value("c")
