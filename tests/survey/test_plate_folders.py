"""Photographs of plates and boards in a folder, and nothing else: found, and the camera as it truly is."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from sfm.pipeline import run_survey
from sfm.survey.drafting.draft import draft_survey
from sfm.survey.inputs.survey import read_survey
from sfm.targets.codes.plates import TAGGED, PlateFamily
from tests.plates import GRID, PITCH, PIXEL_MM, TRUTH, plate_pictures
from tests.synthetic import seed_of

PLATES = {
    "checkerboard, odd": (PlateFamily("checkerboard", 8, 11), 4.6),
    "checkerboard, even": (PlateFamily("checkerboard", 7, 9), 4.6),
    "ChArUco": (PlateFamily("charuco", 7, 10, (), "aruco5x5_50", 0.72), 4.6),
    "grid with marks": (GRID, 4.6),
    "grid with marks 1.08 times larger": (GRID, 3.24),
    "grid without marks": (PlateFamily("grid", 8, 10), 4.6),
    "asymmetric": (PlateFamily("asymmetric-grid", 13, 5), 4.6),
    "AprilGrid": (PlateFamily("aprilgrid", 8, 12, (), "apriltag36h11", 0.769), 4.6),
    "AprilGrid from tag 40": (PlateFamily("aprilgrid", 10, 10, (), "apriltag36h11", 0.7, 40), 4.6),
    "hexagonal": (PlateFamily("hexagonal-grid", 9, 9), 4.6),
}


QUICK = ("grid with marks 1.08 times larger", "hexagonal", "checkerboard, even", "AprilGrid")


@pytest.mark.parametrize(
    "kind", [kind if kind in QUICK else pytest.param(kind, marks=pytest.mark.slow) for kind in PLATES]
)
def test_a_folder_of_a_plate_calibrates_the_camera(kind: str, tmp_path: Path) -> None:
    plate, mark = PLATES[kind]
    for k, picture in enumerate(plate_pictures(plate, seed_of(f"folder of {kind}"), 8, mark=mark)):
        cv2.imwrite(str(tmp_path / f"photo {k}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    draft = draft_survey(tmp_path, pitch=PITCH)
    file = tmp_path / "survey.toml"
    file.write_text(draft.text.replace('backend = "colmap"', 'backend = "none"'))
    survey = read_survey(file)
    assert survey.targets.codes == plate.name
    found_size, size = (survey.targets.rows, survey.targets.columns), (plate.rows, plate.columns)
    assert found_size == size or (sorted(found_size) == sorted(size) and plate.name != "aprilgrid")
    assert len(survey.targets.marks) == len(plate.marks)
    if plate.name in TAGGED:
        assert survey.targets.first_tag == plate.first_tag
        assert survey.targets.dictionary == plate.dictionary
        assert survey.targets.tag_size == pytest.approx(plate.tag_share * PITCH, rel=0.05)
    result = run_survey(survey)
    assert len(result.failed) <= 1  # some show a part of it
    adjustment = result.adjustment
    (found,) = adjustment.estimate.cameras
    covariance = adjustment.covariance.interior[0]
    free = [name for name, is_free in zip(found.names, found.free, strict=True) if is_free]
    for name in ("c", "x0", "y0"):
        sigma = covariance[free.index(name), free.index(name)] ** 0.5
        error = found.value(name) - TRUTH[name] * found.pixel_mm[0] / PIXEL_MM
        assert abs(error) < 4.5 * sigma, name
