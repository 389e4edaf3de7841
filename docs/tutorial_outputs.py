"""Runs the commands of docs/tutorial.md and writes what they print into the page.

`python docs/tutorial_outputs.py` does so in a minute; a test compares them with the page.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "tutorial.md"
HEADLINE = "The survey worked"
COLUMNS = 120  # of a terminal


def blocks(page: str, kind: str) -> list[str]:
    """Return the code blocks of a kind."""
    return re.findall(rf"```{kind}\n(.*?)```", page, re.S)


def outputs(page: str, folder: Path) -> dict[str, str]:
    """Return what the page shows of its two runs, each with what they print now.

    Args:
        page: text of the page.
        folder: an empty one, where its commands are run.

    Raises:
        subprocess.CalledProcessError: a command failed.
    """
    render, first, second = (block.strip() for block in blocks(page, "sh")[:3])
    shown_first, camera, bars, shown_second = blocks(page, "text")[:4]
    _printed(render, folder)
    now_first = _printed(first, folder)
    file = folder / "out" / "photos.toml"
    text = file.read_text(encoding="utf-8")
    text = re.sub(r"pixel_mm = .*\nc_mm = .*\nc_assumed = .*\n", lambda _: camera, text)
    text = text.replace("sigma_px = 0.05", "sigma_px = 0.02")
    file.write_text(f"{text}\n{bars}", encoding="utf-8")
    return {shown_first: now_first, shown_second: _printed(second, folder)}


def _printed(command: str, folder: Path) -> str:
    """Return what a command of the page prints from its headline on, without gaps at the ends of lines."""
    program, *arguments = command.replace("datasets/", f"{ROOT / 'datasets'}/").split()
    start = [sys.executable] if program == "python" else [sys.executable, "-m", "sfm.cli"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": str(COLUMNS)}
    done = subprocess.run(
        [*start, *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    _, headline, rest = done.stdout.partition(HEADLINE)
    return "\n".join(line.rstrip() for line in f"{headline}{rest}".splitlines()) + "\n"


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as place:
        for shown, now in outputs(text, Path(place)).items():
            text = text.replace(shown, now)
    PAGE.write_text(text, encoding="utf-8")
