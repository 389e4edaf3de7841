"""What people get wrong at the first try is answered in one line that says what to write."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
from typer.testing import CliRunner

from sfm.cli.app import app
from sfm.conventions import METRES
from sfm.errors import SurveyFileError
from sfm.survey.inputs.settings import Head
from sfm.survey.inputs.survey_file import read_survey_file
from tests.surveys import write_observed_survey

CAMERA = ["--c-mm", "24", "--sensor-width-mm", "36", "--width-px", "6000"]


def refused(*words: str) -> str:
    """Return the message with which a command refuses."""
    with pytest.raises(SurveyFileError) as error:
        CliRunner().invoke(app, list(words), catch_exceptions=False)
    return str(error.value)


def test_an_unknown_ending_is_no_folder(tmp_path: Path) -> None:
    line = refused("convert", str(tmp_path), str(tmp_path / "x.dxf"))
    assert "x.dxf: unknown ending .dxf, expected .xml, .ply, .db, a folder for tables, or --to with" in line
    assert "photomodeler" in line and not (tmp_path / "x.dxf").exists()


def test_a_distance_in_the_wrong_unit_is_noticed() -> None:
    line = refused("plan", "target-size", "--distance", "3", *CAMERA)
    assert "--distance 3 mm: not farther than the principal distance of 24 mm" in line
    assert "expected one of km, m" in refused(
        "plan", "target-size", "--distance", "3", "--unit", "yd", *CAMERA
    )


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
