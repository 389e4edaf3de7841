"""The README keeps its word: its survey file is read, its commands exist, its folder is what is written."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from adapters.formats.registry import FORMATS
from sfm.cli.app import app
from sfm.report.output import WRITTEN
from sfm.survey.inputs.settings import Section
from sfm.survey.inputs.survey_file import SurveyFile, read_survey_file
from tests.places import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
FIRST_SCREEN = "\n".join(README.splitlines()[:30])


def keys_of(section: type[Section]) -> set[str]:
    return {field.alias or name for name, field in section.model_fields.items()}


def test_first_screen_has_both_commands_and_the_plain_lines() -> None:
    for line in ("make demo", "make test", "py -m venv .venv", "pip install -c constraints.txt -e .[dev]"):
        assert line in FIRST_SCREEN, line


def test_survey_files_of_the_readme_are_read_and_show_every_key(tmp_path: Path) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", README, re.S)
    assert blocks
    shown: dict[str, set[str]] = {}
    sections: dict[str, type[Section]] = {}
    for block in blocks:
        path = tmp_path / "survey.toml"
        path.write_text(block, encoding="utf-8")
        survey = read_survey_file(path)
        for key, given in tomllib.loads(block).items():
            name = next(n for n, field in SurveyFile.model_fields.items() if (field.alias or n) == key)
            value = getattr(survey, name)
            sections[key] = type(value[0] if isinstance(value, tuple) else value)
            shown.setdefault(key, set()).update(given[0] if isinstance(given, list) else given)
    assert shown.keys() == keys_of(SurveyFile)
    for key, section in sections.items():
        assert keys_of(section) - shown[key] <= {"sensor_mm"}, key


def test_commands_of_the_readme_exist() -> None:
    commands = {command.callback.__name__ for command in app.registered_commands if command.callback}
    commands |= {group.typer_instance.info.name for group in app.registered_groups if group.typer_instance}
    assert set(re.findall(r"^kolinear ([a-z]+) ", README, re.M)) == commands


def test_formats_of_the_readme_exist() -> None:
    line = README[README.index("Formats of `convert`") :].split("\n\n")[0]
    named = set(re.findall(r"`([\w-]+)`", line)) - {"convert", "compare"}
    assert named == {one.name for one in FORMATS}


def test_everything_that_is_written_is_explained() -> None:
    explained = set(re.findall(r"^\| `([\w.]+)/?` \|", README, re.M))
    assert explained == set(WRITTEN)


def test_make_targets_of_the_readme_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in set(re.findall(r"make (demo|test|study|bench)\b", README)):
        assert re.search(rf"^{target}:", makefile, re.M), target


def test_constraints_pin_every_requirement() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = {line.split("==")[0].lower().replace("_", "-") for line in lines}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    for requirement in (*project["dependencies"], *(one for extra in extras.values() for one in extra)):
        if own := re.fullmatch(r"kolinear\[([\w,]+)\]", requirement):
            assert set(own[1].split(",")) <= set(extras)
            continue
        name = re.split(r"[\[<>=~! ]", requirement)[0].lower().replace("_", "-")
        assert name in pins, name
