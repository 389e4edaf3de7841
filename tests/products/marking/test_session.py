"""A session of marking: from a click to coordinates, and what may happen to its files."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sfm.model.conventions import FloatArray
from sfm.pipeline import run_survey
from sfm.products.marking.project import MarkedProject, project_of_folder, project_of_survey
from sfm.products.marking.session import MarkError, MarkingSession
from sfm.survey.inputs.marks_file import StatedPoint, read_marks
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
    rng = np.random.default_rng(4)
    places, rotations = stations(rng, count, around=1.4)
    xy = (seen_points(places, rotations, BOARD) + 0.5) / SHRINK - 0.5
    for i in range(count):
        picture = np.full((4 * 500, 4 * 750), 200.0, dtype=np.float32)
        for j, (x, y) in enumerate(xy[i]):
            centre = tuple(round(float(4 * (v + 0.5) - 0.5)) for v in (x, y))
            exact = (4 * (xy[i, j] + 0.5) - 0.5 - np.array(centre)) * 16
            at = (16 * centre[0] + round(exact[0]), 16 * centre[1] + round(exact[1]))
            cv2.circle(picture, at, 16 * 24, 40, -1, 8, 4)
        small = cv2.GaussianBlur(picture, (0, 0), 3).reshape(500, 4, 750, 4).mean(axis=(1, 3))
        noisy = small + rng.normal(0, 1.0, small.shape)
        cv2.imwrite(str(folder / f"i{i}.png"), np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return np.asarray(xy)


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
    for before in (*files[-2::-1], None):
        session.undo()
        if before is not None:
            assert session._saved.path.read_bytes() == before
    assert read_marks(session._saved.path).marks == {}
    assert not session.state()["can_undo"]
    for after in files:
        session.redo()
        assert session._saved.path.read_bytes() == after
    assert not session.state()["can_redo"]


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
