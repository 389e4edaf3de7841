"""The commands on a folder of a plate: its pitch, order of lines, and where photographs are."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from adapters.formats.registry import ENDINGS, FORMATS
from sfm.cli import survey_runs as drafting
from sfm.cli.app import app
from sfm.cli.process import stopped_once
from sfm.model.conventions import METRES
from sfm.model.errors import KolinearError, OutputError, SurveyFileError
from sfm.products.drafting.draft import Draft, draft_survey
from sfm.survey.inputs.settings import Head
from sfm.survey.inputs.survey_file import read_survey_file
from tests.commands import kolinear, refused
from tests.first_tries import TRIES, Try, answer
from tests.surveys import write_observed_survey

FOUR_LINES = """
import sys
from sfm.cli.process import guard_streams
guard_streams()
for k in range(2):
    print(2 * k)
    print(2 * k + 1, file=sys.stderr)
"""


@pytest.mark.parametrize("given", [("--pitch", "12,5"), ("--pitch=12,5",)])
def test_a_decimal_comma_is_explained(given: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert "12.5" in refused(capsys, "init", "here", *given)
    assert "comma" not in refused(capsys, "init", "here", "--pitch", "wide")


def test_lines_of_both_streams_keep_their_order() -> None:
    done = subprocess.run(
        [sys.executable, "-c", FOUR_LINES], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=True
    )
    assert done.stdout.split() == [b"0", b"1", b"2", b"3"]


def test_a_pitch_goes_into_a_drafted_file_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float | None] = []

    def drafted(photographs: Path, file: Path, pitch: float | None = None, name: str | None = None) -> Draft:
        asked.append(pitch)
        return Draft("plate", "[survey]\n", (), (), ())

    monkeypatch.setattr(drafting, "draft_folder", drafted)
    out = tmp_path / "out" / "plate"
    with stopped_once():  # as every command
        file = drafting.drafted_beside(tmp_path, out, 12.5).file
        assert asked == [12.5] and file.is_file()
        with pytest.raises(KolinearError, match=r"targets\.pitch"):
            drafting.drafted_beside(tmp_path, out, 12.5)
        assert drafting.drafted_beside(tmp_path, out, None)[0] == file


def test_a_draft_of_other_photographs_is_neither_run_nor_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the run failed and left no result, and after all was moved together."""
    stated = '[survey]\nphotographs = "../b \\"1\\"/plate"\n'
    monkeypatch.setattr(drafting, "draft_folder", lambda *_: Draft("plate", stated, (), (), ()))
    first, second = tmp_path / "all" / 'b "1"' / "plate", tmp_path / "all" / "c" / "plate"
    for folder in (first, second):
        folder.mkdir(parents=True)
    out = tmp_path / "all" / "out" / "plate"
    with stopped_once():
        file = drafting.drafted_beside(first, out, None).file
        file.write_text(file.read_text(encoding="utf-8") + "# mine\n", encoding="utf-8")
        edited = file.read_bytes()
        for overwrite in (False, True):
            with pytest.raises(OutputError, match="plate"):
                drafting.drafted_beside(second, out, None, overwrite=overwrite)
            assert drafting.drafted_beside(first, out, None, overwrite=overwrite)[0] == file
            assert file.read_bytes() == edited
    (tmp_path / "all").rename(tmp_path / "moved")
    moved = tmp_path / "moved"
    with stopped_once():
        drafting.drafted_beside(moved / 'b "1"' / "plate", moved / "out" / "plate", None)


def test_a_pitch_for_a_survey_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "survey.toml").write_text("", encoding="utf-8")
    for given in (tmp_path, tmp_path / "survey.toml"):
        assert kolinear("run", given, "--pitch", "12.5") == 2
        assert "targets.pitch" in capsys.readouterr().err


def test_the_folder_that_has_photographs_is_named(tmp_path: Path) -> None:
    for name in ("images", "notes"):
        (tmp_path / name).mkdir()
    cv2.imwrite(str(tmp_path / "images" / "1.png"), np.zeros((8, 8), np.uint8))
    with pytest.raises(SurveyFileError) as refusal:
        draft_survey(tmp_path)
    assert str(tmp_path / "images") in str(refusal.value)
    assert str(tmp_path / "notes") not in str(refusal.value)


@pytest.mark.parametrize(
    "one",
    [pytest.param(one, id=one.name, marks=[pytest.mark.slow] * one.photographs) for one in TRIES],
)
def test_a_first_try_is_reported_what_is_wrong(one: Try, tmp_path: Path) -> None:
    found = answer(one, tmp_path)
    assert found.code == one.code, found.text
    for words in one.told:
        assert words in found.text
    assert "nan" not in found.text and "Warning:" not in found.text.replace("! Warning:", "")
    assert [path.name for path in tmp_path.iterdir() if path.name not in ("s", "out")] == []


def test_the_help_of_convert_lists_every_format() -> None:
    text = "".join(CliRunner().invoke(app, ["convert", "--help"]).output.split())  # names break at hyphens
    assert all(one.name in text for one in FORMATS) and all(ending in text for ending in ENDINGS)


def test_units_are_known_ones(tmp_path: Path) -> None:
    assert set(get_args(Head.model_fields["unit"].annotation)) == set(METRES)
    path = write_observed_survey(tmp_path / "s", "s")
    path.write_text(path.read_text().replace('unit = "m"', 'unit = "metres"'), encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"unit: found 'metres', needed one of 'km', 'm'"):
        read_survey_file(path)


def test_everything_that_is_missing_is_said_at_once(tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    path.write_text(
        '[survey]\nname = "s"\n[[camera]]\nname = "c"\n[[scale_bar]]\nfrom = "1"\n', encoding="utf-8"
    )
    with pytest.raises(SurveyFileError) as error:
        read_survey_file(path)
    for key in ("survey.unit", "to", "length", "sigma", "are missing"):
        assert key in str(error.value)
