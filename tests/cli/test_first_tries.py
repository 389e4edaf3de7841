"""What people get wrong at the first try is answered in one line that says what to write."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
from typer.testing import CliRunner

from adapters.formats.registry import ENDINGS, FORMATS
from sfm.cli.app import app
from sfm.conventions import METRES
from sfm.errors import SurveyFileError
from sfm.survey.inputs.settings import Head
from sfm.survey.inputs.survey_file import read_survey_file
from tests.first_tries import TRIES, Try, answer
from tests.surveys import write_observed_survey


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
    text = CliRunner().invoke(app, ["convert", "--help"]).output
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
