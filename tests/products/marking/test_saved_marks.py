"""What a session saves is read again, and nothing that another program wrote is lost."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.files.plain_text import read_toml
from sfm.model.conventions import AnyArray
from sfm.model.errors import KolinearError, OutputError, SurveyFileError
from sfm.products.marking.automatic import AutomaticRun, Run, name_marks
from sfm.products.marking.clicks import measure_click
from sfm.products.marking.project import project_of_folder
from sfm.products.marking.session import MarkingSession
from sfm.survey.inputs.marks_file import Kind, Mark, Marking, read_marks, write_marks
from tests.products.marking.photographs import write_photographs

SURVEY = (
    '[survey]\nname = "a"\nunit = "mm"\n[[camera]]\nname = "c"\nimages = "*.png"\n[targets]\ncodes = "none"\n'
)


@pytest.fixture
def photographs(tmp_path: Path) -> tuple[Path, AnyArray]:
    folder = tmp_path / "photographs"
    folder.mkdir()
    return folder, write_photographs(folder, np.random.default_rng(1))


@pytest.fixture
def session(photographs: tuple[Path, AnyArray], tmp_path: Path) -> Iterator[MarkingSession]:
    opened = MarkingSession(project_of_folder(photographs[0]), tmp_path / "marks.csv")
    yield opened
    opened.close()


@pytest.mark.parametrize("kind", ["saddle", "corner"])
def test_a_click_in_a_photograph_without_noise_has_a_precision(kind: Kind) -> None:
    """Rendered, or overexposed: the noise of rounding is left."""
    y, x = np.mgrid[0:120, 0:120]
    dark = (x < 60) ^ (y < 60) if kind == "saddle" else (x < 60) | (y < 60)
    photograph = cv2.GaussianBlur(np.where(dark, 50, 200).astype(np.uint8), (0, 0), 0.7)
    C = measure_click(photograph, 61.0, 58.0, kind).covariance
    assert (np.linalg.eigvalsh(C) > 1e-8).all()


@pytest.mark.parametrize("changes", [{"sxx": 0.0}, {"x": float("nan")}, {"sxy": 1.0}])
def test_a_mark_that_would_not_be_read_is_not_written(changes: dict[str, float], tmp_path: Path) -> None:
    path = tmp_path / "marks.csv"
    mark = Mark("a.jpg", "P1", 1.0, 2.0, 0.1, 0.0, 0.1, "target", "measured", when="2026-01-01T00:00:00Z")
    write_marks(path, Marking("hall").with_mark(mark))
    before = path.read_bytes()
    with pytest.raises(SurveyFileError, match="no place with a precision"):
        write_marks(path, Marking("hall").with_mark(replace(mark, **changes)))
    assert path.read_bytes() == before and read_marks(path).marks


def test_what_another_program_wrote_is_left_alone(
    session: MarkingSession, photographs: tuple[Path, AnyArray], tmp_path: Path
) -> None:
    x, y = photographs[1][0, 0]
    session.click(0, x, y, point="a", kind="target")
    path = tmp_path / "marks.csv"
    edited = path.read_text("utf-8") + path.read_text("utf-8").splitlines()[-1].replace(",a,", ",b,") + "\n"
    path.write_text(edited, "utf-8")
    with pytest.raises(OutputError, match="changed by another program"):
        session.click(0, x, y, point="c", kind="target")
    assert path.read_text("utf-8") == edited
    assert [mark["point"] for mark in session.state()["marks"]] == ["a"]


def test_a_further_mark_that_is_not_what_the_point_is_is_refused(
    session: MarkingSession, photographs: tuple[Path, AnyArray]
) -> None:
    x, y = photographs[1][0, 0]
    session.click(0, x, y, point="a", kind="target")
    for kind in (None, "window"):
        with pytest.raises(KolinearError):
            session.click(1, 5.0, 5.0, point="a", kind=kind)
    assert len(session.state()["marks"]) == 1


def test_a_changed_photograph_stays_told_after_a_click_in_it(
    photographs: tuple[Path, AnyArray], tmp_path: Path
) -> None:
    folder, dots = photographs
    path = tmp_path / "marks.csv"
    changed = sorted(folder.iterdir())[0]
    for click in range(3):
        session = MarkingSession(project_of_folder(folder), path)
        session.click(0, *dots[0, click], point=f"p{click}", kind="target")
        session.close()
        first = read_marks(path).hashes[changed.name]
        if click == 0:
            cv2.imwrite(str(changed), cv2.imread(str(changed), 0) // 2 + 20)
            hashed = first
        assert first == hashed


def test_a_survey_file_that_cannot_name_its_marks_is_what_it_was(tmp_path: Path) -> None:
    inside = tmp_path / "survey"
    inside.mkdir()
    file = inside / "survey.toml"
    for text, marks in (
        (SURVEY, tmp_path / "marks.csv"),
        (SURVEY + '[observations]\nfile = "o.csv"\n', None),
    ):
        file.write_bytes(text.replace("\n", "\r\n").encode())
        told: list[Run] = []
        path = marks or inside / "marks.csv"
        write_marks(path, Marking("a"))
        AutomaticRun(file, inside, path, "a").run(told.append, control=False)
        assert told[-1].state == "failed" and told[-1].sentence
        assert file.read_bytes() == text.replace("\n", "\r\n").encode()


def test_a_survey_file_keeps_its_ends_of_lines(tmp_path: Path) -> None:
    file, marks = tmp_path / "survey.toml", tmp_path / "marks.csv"
    file.write_bytes(SURVEY.replace("\n", "\r\n").encode())
    write_marks(marks, Marking("a"))
    name_marks(file, marks)
    assert b"\n" not in file.read_bytes().replace(b"\r\n", b"")
    assert read_toml(file, "a survey file")[1]["marks"] == {"file": "marks.csv"}
