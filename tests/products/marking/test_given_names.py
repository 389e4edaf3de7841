"""Points that a survey gives: their names, what a person refuses of them, and what a rename leaves alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from sfm.model.conventions import FloatArray
from sfm.products.marking.project import project_of_survey
from sfm.products.marking.session import MarkingSession
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
