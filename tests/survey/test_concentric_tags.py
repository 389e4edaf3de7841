"""A survey of concentric tags: their centres are not corrected for eccentricity."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import sfm.pipeline as pipeline
from sfm.camera import camera_from_values
from sfm.errors import SurveyFileError
from sfm.rendering.render import render_photographs
from sfm.rendering.scene import CircularTargets, Faces, Optics, Scene, concentric_rings, join_marks
from sfm.similarity import fit_similarity
from sfm.survey.inputs.survey import read_survey
from sfm.targets.codes.concentric import concentric_family
from tests.surveys import stations

SURVEY = """\
[survey]
name = "concentric"
unit = "mm"
[[camera]]
name = "c"
images = "*.png"
free = ["c"]
pixel_mm = [0.005, 0.005]
c_mm = 6.0
[targets]
codes = "cctag3"
polarity = "dark"
{targets}
[compare]
backend = "none"
"""
# Places on a plate and on one above it, mm: (face, x, y).
PLACES = [(0, x, y) for x in (-165.0, -105.0, 105.0, 165.0) for y in (-115.0, 0.0, 115.0)]
PLACES += [(1, x, y) for x in (-35.0, 35.0) for y in (-30.0, 30.0)]
RADIUS_MM = 25.0


def scene() -> Scene:
    """Return two plates with tags, ids in the order of PLACES."""
    one = np.ones(2)
    faces = Faces(
        np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 60.0]]),
        np.tile(np.eye(3)[:2], (2, 1, 1)),
        np.array([[215.0, 165.0], [65.0, 60.0]]),
        0.8 * one,
        0 * one,
        one,
    )
    family = concentric_family("cctag3")
    marks = [
        concentric_rings(face, np.array([x, y]), RADIUS_MM, k, family, 0.08)
        for k, (face, x, y) in enumerate(PLACES)
    ]
    none = CircularTargets(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
    return Scene(faces, join_marks(marks), none)


@pytest.mark.slow
def test_centres_are_not_corrected_twice(tmp_path: Path) -> None:
    camera = camera_from_values("c", "brown", (1200, 900), (0.005, 0.005), c_mm=6.0)
    positions, rotations = stations(6)
    pictures, _ = render_photographs(
        scene(), camera, positions, rotations, optics=Optics(blur_px=0.7, noise=2 / 255), seed=3
    )
    for i, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"{i}.png"), picture)
    (tmp_path / "survey.toml").write_text(SURVEY.format(targets=""), encoding="utf-8")
    result = pipeline.run_survey(read_survey(tmp_path / "survey.toml"))
    assert result.eccentricity is None
    height = np.array([0.0, 60.0])
    truth = np.array([[x, y, height[face]] for face, x, y in PLACES])
    network, estimate = result.adjustment.network, result.adjustment.estimate
    coded = [j for j, name in enumerate(network.points) if name.isdigit()]
    assert len(coded) >= len(PLACES) - 2  # the upper plate hides some in most photographs
    points, truth = estimate.points[coded], truth[[int(network.points[j]) for j in coded]]
    moved = fit_similarity(points, truth).apply(points) - truth
    assert np.sqrt(np.mean(moved**2)) < 0.002  # mm, 0.004 px; a correction would be of 0.6 px RMS


def test_radii_of_rings_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    path.write_text(SURVEY.format(targets="ring_radii = [2.0, 3.0]"), encoding="utf-8")
    with pytest.raises(SurveyFileError):
        read_survey(path)
