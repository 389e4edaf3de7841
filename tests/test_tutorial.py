"""The tutorial: its commands print what the page shows."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.places import DATASETS, ROOT

PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
COMMANDS, TEXTS = (re.findall(rf"```{kind}\n(.*?)```", PAGE, re.S) for kind in ("sh", "text"))
HEADLINE = "The survey worked: 12 of 12 photographs oriented, 96 object points."


def printed(command: str, folder: Path) -> str:
    """Return what a command of the page prints from its headline on."""
    program, *arguments = command.replace("datasets/", f"{DATASETS}/").split()
    start = [sys.executable] if program == "python" else [str(Path(sys.executable).parent / program)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "120"}
    done = subprocess.run(
        [*start, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.partition(HEADLINE)[2] and HEADLINE + done.stdout.partition(HEADLINE)[2]


def without_figures(text: str) -> str:
    return re.sub(r"\d+(?:\.\d+)?", "0", " ".join(text.split()))


@pytest.mark.slow
def test_the_tutorial_prints_what_its_page_shows(tmp_path: Path) -> None:
    """Headlines, rows and remarks as they are, further figures without their digits."""
    render, first, second = (one.strip() for one in COMMANDS[:3])
    shown_first, camera, bars, shown_second = TEXTS[:4]
    assert shown_first.startswith(HEADLINE) and shown_second.startswith(HEADLINE)
    printed(render, tmp_path)
    assert without_figures(printed(first, tmp_path)) == without_figures(shown_first)
    file = tmp_path / "out" / "photos.toml"
    text = file.read_text(encoding="utf-8")
    assert "c_assumed = true" in text and "`c_assumed`" in PAGE and "`sigma_px = 0.02`" in PAGE
    text = re.sub(r"pixel_mm = .*\nc_mm = .*\nc_assumed = .*\n", camera, text)
    text = text.replace("sigma_px = 0.05", "sigma_px = 0.02")
    file.write_text(f"{text}\n{bars}", encoding="utf-8")
    assert without_figures(printed(second, tmp_path)) == without_figures(shown_second)
