"""The release as somebody else gets it: source distribution, wheel from it, a clean environment, a survey."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
from pathlib import Path
from zipfile import ZipFile

import pytest

from tests.places import DATASETS, ROOT

pytestmark = pytest.mark.slow
NOT_SOURCE = shutil.ignore_patterns(
    *(
        ".git",
        ".venv",
        "__pycache__",
        "node_modules",
        "build",
        "dist",
        "out",
        "_build",
        "*.egg-info",
        ".*_cache",
    ),
    ".hypothesis",
)
BUILD = "from setuptools import build_meta as b; import sys; getattr(b, sys.argv[1])(sys.argv[2])"
MAX_BYTES = 3_000_000  # of the wheel and of the source distribution; a data set would not go unnoticed


def run(*command: object, folder: Path, home: Path | None = None) -> str:
    """Run a program without anything of this tree in its way; return what it prints."""
    keep = {"PATH", "HOME", "TMPDIR", "TEMP", "SYSTEMROOT", "LANG", "PIP_INDEX_URL", "PIP_CONFIG_FILE"}
    environment = {key: value for key, value in os.environ.items() if key in keep or key.startswith("PIP_")}
    if home is not None:
        environment |= {"XDG_CACHE_HOME": str(home), "LOCALAPPDATA": str(home)}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=1800,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stdout + done.stderr


def environment_in(folder: Path, *requirements: object) -> Path:
    """Make an environment and return the folder of its programs."""
    run(sys.executable, "-m", "venv", folder, folder=folder.parent)
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    pip = (programs / "python", "-m", "pip", "install", "-q", "--disable-pip-version-check")
    run(*pip, "-c", ROOT / "constraints.txt", *requirements, folder=folder.parent)
    return programs


@pytest.fixture(scope="module")
def released(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The source distribution, and the wheel that is built from nothing but it."""
    folder = tmp_path_factory.mktemp("release")
    programs = environment_in(folder / "tools", *("setuptools>=77", "wheel"))
    shutil.copytree(ROOT, folder / "tree", ignore=NOT_SOURCE, symlinks=True)
    run(programs / "python", "-c", BUILD, "build_sdist", folder, folder=folder / "tree")
    (source,) = folder.glob("*.tar.gz")
    with tarfile.open(source) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    run(programs / "python", "-c", BUILD, "build_wheel", folder, folder=unpacked)
    (wheel,) = folder.glob("*.whl")
    return source, wheel


def test_the_source_distribution_has_the_tree(released: tuple[Path, Path]) -> None:
    source, _ = released
    assert source.stat().st_size < MAX_BYTES
    with tarfile.open(source) as archive:
        files = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    needed = ("tests/conftest.py", "viewer/src/main.js", "constraints.txt", "Makefile", "CHANGELOG.md")
    assert not {*needed, "docs/architecture.md", "datasets/demo/survey.toml", "LICENSE"} - files
    assert not [name for name in files if "__pycache__" in name or name.endswith((".nbi", ".nbc", ".jpg"))]


def test_the_wheel_has_all_files_of_the_packages(released: tuple[Path, Path]) -> None:
    _, wheel = released
    assert wheel.stat().st_size < MAX_BYTES
    with ZipFile(wheel) as archive:
        files = {name for name in archive.namelist() if ".dist-info/" not in name}
        (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        text = archive.read(metadata).decode()
    tree = {
        path.relative_to(ROOT).as_posix()
        for package in ("sfm", "adapters")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert files == tree
    for name in ("LICENSE", "sfm/report/viewer/LICENSES.txt", "sfm/products/marking/page/LICENSES.txt"):
        assert f"License-File: {name}" in text
    assert "Requires-Dist: pycolmap<4.3,>=4.2\n" in text


def test_a_survey_of_rendered_photographs_runs_from_the_wheel(
    released: tuple[Path, Path], tmp_path: Path
) -> None:
    programs = environment_in(tmp_path / "clean", released[1])
    kolinear, home = programs / "kolinear", tmp_path / "home"
    home.mkdir()
    shutil.copytree(DATASETS / "demo", tmp_path / "demo")
    told = run(kolinear, "doctor", folder=tmp_path, home=home)
    assert "This installation works." in told and "is not installed" not in told.split("dask")[0]
    scene = ("demo/scene.toml", "photographs")
    run(programs / "python", "-P", "-m", "sfm.products.rendering.render", *scene, folder=tmp_path, home=home)
    survey = ("demo/survey.toml", "--images", "photographs", "--out", "result")
    run(kolinear, "run", *survey, folder=tmp_path, home=home)
    summary = json.loads((tmp_path / "result" / "summary.json").read_text(encoding="utf-8"))
    assert summary["images"]["used"] == summary["images"]["total"] > 5
    assert summary["sigma0_px"] < 0.1
    page = (tmp_path / "result" / "report.html").read_text(encoding="utf-8")
    assert "three.js" in page and "Not compared with another adjuster" not in page
    for photograph in (tmp_path / "photographs").glob("part_*.jpg"):
        shutil.copy(photograph, tmp_path / "demo")
    told = run(kolinear, "batch", "demo/survey.toml", "--out", "batch", folder=tmp_path, home=home)
    assert "Dask is not installed" in told and (tmp_path / "batch" / "demo" / "report.html").is_file()
