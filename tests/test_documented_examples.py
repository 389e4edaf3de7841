"""Examples of the pages: their commands print the headline that the page shows."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.conventions import rotation_from_vector
from sfm.products.rendering.render import corner_rays, render_photograph
from sfm.products.rendering.scene import Optics
from sfm.targets.codes.plates import PlateFamily
from tests.places import DATASETS, ROOT
from tests.plates import camera, plate_scene, stations
from tests.products.inspection.test_acceptance import accepted, volume
from tests.synthetic import seed_of


def blocks_of(page: str, heading: str) -> list[str]:
    """Return the code blocks of a section of a page."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    section = re.split(r"^## ", text.partition(f"## {heading}\n")[2], flags=re.M)[0]
    return re.findall(r"^```\w+\n(.*?)^```", section, re.M | re.S)


def printed(command: str, folder: Path) -> str:
    """Return what a command of a page prints, with one space for each gap."""
    arguments = command.replace("datasets/", f"{DATASETS}/").split()[1:]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    ended = subprocess.run(
        [sys.executable, "-m", "sfm.cli", *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )
    return "\n".join(" ".join(line.split()) for line in ended.stdout.splitlines())


def without_figures(text: str) -> str:
    return re.sub(r"\d+(?:\.\d+)?", "0", text)


@pytest.mark.slow
def test_measuring_prints_its_headline_and_quantities(tmp_path: Path) -> None:
    features, commands, shown = blocks_of("measuring.md", "An example")
    (tmp_path / "features.toml").write_text(features, encoding="utf-8")
    adjusting, measuring = commands.splitlines()
    printed(adjusting, tmp_path)
    assert shown in printed(measuring, tmp_path)


def test_acceptance_has_the_headline_of_its_page() -> None:
    (shown,) = blocks_of("measuring.md", "Acceptance")
    texts = [accepted(*volume(error=error)).verdict.text for error in (0.0, 0.2)]
    assert texts == shown.strip().split("\n\n")


def write_pairs(folder: Path, count: int) -> None:
    """Render a checkerboard before two cameras, whose base is a twelfth of the distance."""
    board, lens, rng = PlateFamily("checkerboard", 6, 9), camera(), seed_of("documented pairs")
    scene, rays = plate_scene(board), corner_rays(lens)
    optics = Optics(blur_px=0.8, exposure=0.9, noise=0.01, oversampling=3)
    convergence = rotation_from_vector(np.array([0.0, 0.087, 0.01]))
    folder.mkdir()
    for k, (X0, R) in enumerate(zip(*stations(rng, count, board), strict=True), 1):
        poses = {"left": (X0, R), "right": (X0 + R @ np.array([20.0, 0.0, 0.0]), R @ convergence)}
        for side, (position, rotation) in poses.items():
            grey, _ = render_photograph(scene, lens, position, rotation, optics=optics, rng=rng, rays=rays)
            cv2.imwrite(str(folder / f"{side}{k:02d}.png"), grey)


@pytest.mark.slow
def test_a_stereo_camera_is_calibrated_by_the_commands_of_its_page(tmp_path: Path) -> None:
    commands, draft, shown, *_ = blocks_of("how-to/rigs.md", "Calibrate a stereo camera")
    write_pairs(tmp_path / "pair", 10)
    drafting, running = commands.splitlines()
    printed(drafting, tmp_path)
    text = (tmp_path / "pair.toml").read_text(encoding="utf-8")
    assert all(line in text for line in draft.splitlines()) and "[[rig]]" in text
    lines = printed(running, tmp_path).splitlines()
    assert lines[0] == shown.splitlines()[0]
    assert without_figures(shown.splitlines()[1]) in [without_figures(line) for line in lines]
