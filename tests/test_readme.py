"""README and pages keep their word: survey files are read; commands, formats, files are those there are."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import typer

from adapters.formats.registry import FORMATS
from sfm.cli.app import app
from sfm.model.distortion.models import COLMAP, GENERAL_MODELS
from sfm.runtime.faults import FAULT
from sfm.survey.inputs.settings import Section
from sfm.survey.inputs.survey_file import BESIDE, SurveyFile, read_survey_file
from sfm.targets.codes.plates import PlateFamily, refuse_unusable_plate
from tests.places import ROOT, load_page_code
from tests.written import WRITTEN

README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCS = ROOT / "docs"


def keys_of(section: type[Section]) -> set[str]:
    return {field.alias or name for name, field in section.model_fields.items()}


def page(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def test_readme_is_short_and_has_the_commands_to_install() -> None:
    lines = README.splitlines()
    assert len(lines) < 150
    for line in ("make demo", "make test", "py -m venv .venv", "pip install -c constraints.txt -e .[all]"):
        assert line in "\n".join(lines[:50]), line
    for line in ("py -m venv .venv", "pip install -c constraints.txt -e .[dev]", "python -m sfm.cli.warm_up"):
        assert line in page("install.md"), line


def test_what_the_readme_links_to_exists() -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", README):
        assert (ROOT / target).is_file(), target


def test_survey_files_of_the_examples_are_read_and_show_every_key(tmp_path: Path) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", page("reference/survey-examples.md"), re.S)
    assert blocks
    shown: dict[str, set[str]] = {}
    sections: dict[str, type[Section]] = {}
    for block in blocks:
        path = tmp_path / "survey.toml"
        path.write_text(block, encoding="utf-8")
        survey = read_survey_file(path)
        for key, given in tomllib.loads(block).items():
            if key == "observations" and isinstance(given, list):
                key = BESIDE
            name = next(n for n, field in SurveyFile.model_fields.items() if (field.alias or n) == key)
            value = getattr(survey, name)
            sections[key] = type(value[0] if isinstance(value, tuple) else value)
            for one in given if isinstance(given, list) else [given]:
                shown.setdefault(key, set()).update(one)
    assert shown.keys() == keys_of(SurveyFile)
    for key, section in sections.items():
        assert keys_of(section) - shown[key] <= {"sensor_mm"}, key


def test_the_readme_lists_the_commands() -> None:
    assert load_page_code("command_list").with_list(README) == README, "python docs/command_list.py README.md"


def shown_commands() -> list[str]:
    """Return the lines of all pages that call the program, those that go on joined."""
    pages = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    blocks = "\n".join(re.findall(r"^```(?:sh|bat)\n(.*?)^```", text, re.M | re.S)).replace("\\\n", " ")
    return [line.partition("  #")[0] for line in blocks.splitlines() if line.startswith("kolinear ")]


def test_commands_of_all_pages_have_the_options_that_are_shown() -> None:
    root = typer.main.get_command(app)
    lines = shown_commands()
    assert len(lines) > 40
    for line in lines:
        words = line.split()[1:]
        if words[0] == "COMMAND":
            continue
        command = root.commands[words[0]]  # type: ignore[attr-defined]
        if hasattr(command, "commands"):
            command = command.commands[words[1]]
        known = {name for one in command.params for name in (*one.opts, *one.secondary_opts)} | {"--help"}
        used = {word.partition("=")[0] for word in words if word.startswith("-") and not word[1:2].isdigit()}
        assert used <= known, line


def test_formats_of_the_page_are_those_there_are() -> None:
    rows = re.findall(r"^\| `([\w-]+)` \|", page("how-to/other-programs.md"), re.M)
    assert sorted(rows) == sorted(one.name for one in FORMATS)


def test_the_table_of_formats_is_that_of_their_registry() -> None:
    text = page("how-to/other-programs.md")
    assert load_page_code("format_table").with_table(text) == text


def test_everything_that_is_written_is_explained() -> None:
    explained = set(re.findall(r"^\| `([\w.]+)/?` \|", page("reference/results.md"), re.M))
    assert explained == set(WRITTEN)


def test_make_targets_of_the_pages_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    text = README + page("install.md")
    for target in set(re.findall(r"`?make (demo|test|docs|study|bench)\b", text)):
        assert re.search(rf"^{target}:", makefile, re.M), target


def test_camera_models_of_the_examples_are_those_there_are() -> None:
    table = (
        page("reference/survey-examples.md")
        .partition("## Camera models")[2]
        .partition("\n`brown` in full")[0]
    )
    named = [
        name for row in re.findall(r"^\| (`.*?) \|", table, re.M) for name in re.findall(r"`(\w+)`", row)
    ]
    assert sorted(named) == sorted(GENERAL_MODELS)
    others = page("reference/survey-examples.md").partition("### COLMAP's camera models")[2]
    others = others.partition("\n## ")[0]
    assert set(re.findall(r"`([A-Z_]{3,})`", others)) == {model.name.upper() for model in COLMAP}


def test_exit_codes_of_the_page_are_those_of_the_program() -> None:
    codes = {int(code) for code in re.findall(r"^\| (\d+) \|", page("reference/verdict.md"), re.M)}
    assert codes == {0, 1, 2, FAULT, 130, 141}


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


def test_the_home_page_has_a_picture_and_three_commands_that_exist() -> None:
    text = page("index.md")
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", text)
    assert len(pictures) == 1 and (DOCS / pictures[0]).is_file()
    block = re.search(r"```sh\n(.*?)```", text, re.S)
    assert block is not None
    commands = [line.split()[1] for line in block[1].splitlines()]
    known = {one.name or getattr(one.callback, "__name__", "") for one in app.registered_commands}
    assert len(commands) == 3 and set(commands) <= known


def test_the_plate_of_the_page_is_numbered_as_the_program_does() -> None:
    """Marks of the drawing and the sentences below it: usable marks, row 1 further right in shifted rows."""
    text = page("how-to/calibrate-a-camera.md")
    drawn = (DOCS / "drawings.py").read_text(encoding="utf-8")
    told = re.search(r"`marks = (\[\[.*?\]\])`", text)
    assert told is not None and "```{drawing} plates" in text
    marks = tuple(tuple(one) for one in json.loads(told[1]))
    plate = PlateFamily("grid", 5, 6, marks)
    refuse_unusable_plate(plate)
    assert f'PlateFamily("grid", 5, 6, {marks})' in drawn
    x, y = plate.plane(1.0)[:, :2].T
    assert y[plate.columns] < y[0] and x[1] > x[0]  # rows downwards, columns to the right
    for name in ("asymmetric-grid", "hexagonal-grid"):
        x = PlateFamily(name, 4, 5).plane(1.0)[:, 0]
        assert x[5] - x[0] == 0.5
