"""Points that a survey gives: their names, what a person refuses of them, and what a rename leaves alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sfm.model.conventions import FloatArray
from sfm.model.errors import SurveyFileError
from sfm.pipeline import run_survey
from sfm.products.marking.project import project_of_survey
from sfm.products.marking.session import MarkError, MarkingSession
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.marks_file import Mark, Marking, write_marks
from sfm.survey.inputs.survey import read_survey
from tests.products.marking.test_session import SURVEY, write_board

GIVEN = """
[[observations]]
file = "given.csv"
sigma_px = 0.1

[[point]]
name = "P6"
image = "i0.png"
x_px = 100.0
y_px = 100.0

[[scale_bar]]
from = "P1"
to = "P7"
length = 0.4
sigma = 0.01
"""


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FloatArray]:
    """Return a survey file that gives the image points of P1 to P5, and the places of all dots."""
    folder = tmp_path_factory.mktemp("given")
    xy = write_board(folder, 2)
    rows = [f"i{i}.png,P{j + 1},{x},{y}" for i in range(2) for j, (x, y) in enumerate(xy[i, :5])]
    (folder / "given.csv").write_text("\n".join(["image,point,x_px,y_px", *rows]) + "\n", encoding="utf-8")
    (folder / "survey.toml").write_text(SURVEY + GIVEN, encoding="utf-8")
    return folder / "survey.toml", xy


@pytest.fixture
def session(given: tuple[Path, FloatArray], tmp_path: Path) -> Iterator[MarkingSession]:
    file = given[0]
    made = MarkingSession(project_of_survey(read_survey(file), survey_file=file), tmp_path / "marks.csv")
    yield made
    made.close()


def test_a_new_point_has_no_name_that_the_survey_gives(
    session: MarkingSession, given: tuple[Path, FloatArray]
) -> None:
    assert session.click(0, *given[1][0, 9])["mark"]["point"] == "P8"


def shown(session: MarkingSession) -> set[tuple[int, str]]:
    return {(mark["image"], mark["point"]) for mark in session.state()["marks"]}


def test_what_was_refused_stays_refused_after_a_rename(session: MarkingSession) -> None:
    session.refuse(1, "P4")
    before = shown(session)
    session.rename("P4", "bolt")
    assert shown(session) == before - {(0, "P4")} | {(0, "bolt")}
    session.rename("bolt", "P4")
    assert shown(session) == before


def test_a_whole_point_is_deleted_and_comes_back_in_one_step(
    session: MarkingSession, given: tuple[Path, FloatArray]
) -> None:
    session.refuse(0, "P3")
    session.click(1, *given[1][1, 2], point="P3")
    before = shown(session)
    session.delete("P3")
    assert not {(0, "P3"), (1, "P3")} & shown(session)
    session.undo()
    assert shown(session) == before
    session.delete("P2")  # without a mark
    assert not {(0, "P2"), (1, "P2")} & shown(session)
    with pytest.raises(MarkError, match="has no mark"):
        session.delete("P2")


def test_two_points_do_not_become_one(session: MarkingSession, given: tuple[Path, FloatArray]) -> None:
    before = shown(session)
    with pytest.raises(MarkError, match=r"has a mark in i0\.png already"):
        session.rename("P3", "P2")
    session.rename("P3", "P3")
    assert shown(session) == before and session.state()["undo"] is None
    session.click(0, *given[1][0, 9], point="A")
    session.click(1, *given[1][1, 9], point="B")
    session.set_bar("A", "B", ScaleBar("A", "B", 1.0, 0.1))
    with pytest.raises(MarkError, match="a scale bar is between 'A' and 'B'"):
        session.rename("A", "B")


def mark_at(photograph: str, point: str, xy: FloatArray) -> Mark:
    return Mark(photograph, point, float(xy[0]), float(xy[1]), 0.01, 0.0, 0.01, "target", when="t")


def test_a_run_leaves_out_what_was_refused_and_takes_each_bar_once(tmp_path: Path) -> None:
    xy = write_board(tmp_path, 3)
    rows = [f"i{i}.png,P{j},{x},{y}" for i in range(3) for j, (x, y) in enumerate(xy[i]) if j]
    (tmp_path / "given.csv").write_text("\n".join(["image,point,x_px,y_px", *rows]) + "\n", encoding="utf-8")
    bars = "".join(
        f'[[scale_bar]]\nfrom = "P{a}"\nto = "P{a + 1}"\nlength = 0.4\nsigma = 0.01\n' for a in (1, 5)
    )
    tables = '[[observations]]\nfile = "given.csv"\nsigma_px = 0.1\n[marks]\nfile = "marks.csv"\n'
    file = tmp_path / "survey.toml"
    file.write_text(SURVEY + bars + tables, encoding="utf-8")
    marking = Marking("board", bars={("P2", "P1"): ScaleBar("P2", "P1", 0.41, 0.01)})
    for i in range(3):
        marking = marking.with_mark(mark_at(f"i{i}.png", "bolt", xy[i, 0]))
    marking = marking.with_refused(mark_at("i2.png", "P3", xy[2, 3]))  # its target has no code
    write_marks(tmp_path / "marks.csv", marking)
    survey = read_survey(file)
    assert [(bar.start, bar.end, bar.length) for bar in survey.scale_bars] == [
        ("P5", "P6", 0.4),
        ("P2", "P1", 0.41),
    ]
    network = run_survey(survey).adjustment.network
    seen = network.image_points
    rays = {(network.images[i], network.points[j]) for i, j in zip(seen.image, seen.point, strict=True)}
    assert {photograph for photograph, point in rays if point == "P3"} == {"i0.png", "i1.png"}
    assert {photograph for photograph, point in rays if point == "bolt"} == {f"i{i}.png" for i in range(3)}
    assert not np.isclose(seen.xy[seen.image == 2], xy[2, 3], atol=1.0).all(axis=1).any()


def test_the_marks_of_another_survey_are_not_run(tmp_path: Path) -> None:
    file = tmp_path / "survey.toml"
    file.write_text(SURVEY + '[marks]\nfile = "marks.csv"\n', encoding="utf-8")
    write_marks(tmp_path / "marks.csv", Marking("another hall"))
    with pytest.raises(SurveyFileError, match="has the marks of survey 'another hall'"):
        read_survey(file)
