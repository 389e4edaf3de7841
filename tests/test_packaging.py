"""What is released is complete, from the build configuration alone: files, licences, extras, one version.

`tests/test_wheel.py` builds and installs it, which takes minutes.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from benchmarks import table
from tests.places import ROOT

CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = CONFIG["project"]
SETUPTOOLS = CONFIG["tool"]["setuptools"]
PACKAGES = ("sfm", "adapters")
MADE = {"__pycache__", ".DS_Store"}  # by running it, no part of it


def packed(package: str) -> set[Path]:
    """Return the files of a package that the wheel gets by the build configuration."""
    folder = ROOT / package
    modules = {
        path
        for path in folder.rglob("*.py")
        if all((parent / "__init__.py").is_file() for parent in parents_in(path, folder))
    }
    patterns = SETUPTOOLS["package-data"].get(package, [])
    return modules | {path for pattern in patterns for path in folder.glob(pattern)}


def parents_in(path: Path, folder: Path) -> list[Path]:
    return [parent for parent in path.parents if parent == folder or folder in parent.parents]


@pytest.mark.parametrize("package", PACKAGES)
def test_every_file_of_a_package_is_in_the_wheel(package: str) -> None:
    there = {
        path for path in (ROOT / package).rglob("*") if path.is_file() and MADE.isdisjoint(path.parts)
    } - set((ROOT / package).rglob("*.nb[ic]"))
    missing = sorted(path.relative_to(ROOT).as_posix() for path in there - packed(package))
    assert not missing, "package-data in pyproject.toml leaves these out, or a folder has no __init__.py"


def test_the_wheel_has_what_runs_at_run_time() -> None:
    needed = (
        *("py.typed", "__init__.pyi", "report/viewer/viewer.js", "report/viewer/viewer.css"),
        *("report/viewer/LICENSES.txt", "report/templates/tables.js", "report/templates/page.html"),
        *(f"products/marking/page/{name}" for name in ("mark.html", "mark.js", "mark.css", "LICENSES.txt")),
    )
    files = packed("sfm")
    assert not [name for name in needed if ROOT / "sfm" / name not in files]


def test_both_packages_are_found_and_nothing_else() -> None:
    found = set(SETUPTOOLS["packages"]["find"]["include"])
    assert found == {pattern for name in PACKAGES for pattern in (name, f"{name}.*")}


def test_licences_of_all_that_is_shipped_are_named() -> None:
    assert PROJECT["license"] == "BSD-3-Clause AND MIT AND Apache-2.0"
    assert len(PROJECT["license-files"]) == 3
    own, viewer, marking = ((ROOT / name).read_text(encoding="utf-8") for name in PROJECT["license-files"])
    assert own.startswith("BSD 3-Clause") and "The MIT License" in viewer
    assert all(name in marking for name in ("The BSD 3-Clause License", "The MIT License", "Apache License"))
    for script, texts in (("report/viewer/viewer.js", viewer), ("products/marking/page/mark.js", marking)):
        head = (ROOT / "sfm" / script).read_text(encoding="utf-8")[:200]
        built_with = re.match(r"/\* \w+ of Kolinear with (\S+ [\d.]+);", head)
        assert built_with and f"- {built_with[1]} (" in texts, f"{script}: licences of another version"


def test_the_package_brings_colmap_and_no_library_of_an_extra() -> None:
    extras = PROJECT["optional-dependencies"]
    assert set(extras) == {"cluster", "exchange", "mark", "pdf", "photographs", "all", "docs", "dev"}
    assert (
        extras["all"] == ["kolinear[cluster,exchange,mark,photographs]"] and "kolinear[all]" in extras["dev"]
    )
    core = " ".join(PROJECT["dependencies"])
    assert "pycolmap>=4.2,<4.3" in PROJECT["dependencies"]
    extra = r"dask|distributed|cryptography|starlette|uvicorn|heif|rawpy|\bav\b|pytest|mypy"
    extra += "|pyproj|laspy|lazrs|pye57|trimesh|lxml|networkx|weasyprint"
    assert not re.search(extra, core)


def test_the_version_stands_in_one_place() -> None:
    version = PROJECT["version"]
    again = re.compile(rf"__version__ *=|version\s*[:=]+\s*[\"']?{re.escape(version)}")
    places = [
        path
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py*")
        if MADE.isdisjoint(path.parts)
    ]
    places += [ROOT / "CITATION.cff", ROOT / "README.md", ROOT / "viewer" / "package.json"]
    assert not [path for path in places if again.search(path.read_text(encoding="utf-8"))]
    headings = re.findall(r"^## \[?([\w.]+)\]?", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
    assert headings[0] in ("Unreleased", version)
    assert "Unreleased" not in headings[1:]


def test_metadata_are_complete_and_name_no_place_that_does_not_exist() -> None:
    assert not PROJECT["name"].isspace() and len(PROJECT["description"]) < 120
    assert PROJECT["readme"] == "README.md" and PROJECT["authors"] and PROJECT["keywords"]
    assert PROJECT["scripts"] == {"kolinear": "sfm.cli:main"}
    oldest = PROJECT["requires-python"].removeprefix(">=")
    assert f"Programming Language :: Python :: {oldest}" in PROJECT["classifiers"]
    assert "Typing :: Typed" in PROJECT["classifiers"]
    assert not [one for one in PROJECT["classifiers"] if one.startswith("License ::")]  # license says it
    assert "urls" not in PROJECT, "then CITATION.cff and SECURITY.md can name them, too"


def test_make_bench_prints_the_table_of_timings() -> None:
    """As a module of this tree, which finds `tests`, `datasets` and its siblings."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert "-m benchmarks.table $(if $(QUICK),--quick)" in makefile
    files = {path.stem: path.read_text(encoding="utf-8") for path in (ROOT / "benchmarks").glob("*.py")}
    for name, text in files.items():
        own = re.findall(r"^(?:from|import) (\w+)", text, re.M)
        assert not set(own) & set(files), f"{name}: a sibling is benchmarks.NAME"


def test_a_row_of_timings_has_its_ratios() -> None:
    assert table.Row("survey", 2.0, 1.5, before=4.0, rival=7.0).cells() == [
        *("survey", "2", "1.5", "4", "7", "2", "3.5"),
    ]
    assert table.Row("survey", 2.0).cells() == ["survey", "2", "", "", "", "", ""]


def test_the_source_distribution_names_files_that_are_there() -> None:
    lines = (ROOT / "MANIFEST.in").read_text(encoding="utf-8").splitlines()
    named = [word for line in lines if line.startswith(("include ", "graft ")) for word in line.split()[1:]]
    assert len(named) > 10
    assert not [name for name in named if not (ROOT / name).exists()]
    tree = {path.name for path in ROOT.iterdir() if path.suffix in (".md", ".cff", ".txt", ".yaml")}
    assert tree <= {*named, "README.md"}


def test_the_hosted_workflow_runs_what_make_test_runs() -> None:
    workflow = (ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8")
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    recipe = re.search(r"^test: .*\n((?:\t.*\n)+)", makefile, re.M)
    assert recipe
    for command in recipe[1].replace("$(BIN)/", "").splitlines():
        assert f"- run: {command.strip()}\n" in workflow, command
    for python in ("3.11", "3.12", "3.13", "3.14"):
        assert f'"{python}"' in workflow
    assert all(system in workflow for system in ("ubuntu-latest", "macos-latest", "windows-latest"))
