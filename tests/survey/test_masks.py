"""Masks of photographs: what is black takes no part, of whatever source it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.errors import SurveyFileError
from sfm.pipeline import run_survey
from sfm.survey.inputs.survey import read_survey
from tests.survey.test_sources import CORNERS, write, write_given

BLACK = slice(0, 220)  # columns of the masked part, px


def masked(folder: Path, count: int = 6) -> Path:
    """Write the survey of targets, texture and given points, and masks of some of its photographs."""
    write_given(folder / "corners.csv", CORNERS)
    path = write(folder, '[tie_points]\n[[observations]]\nfile = "corners.csv"\nsigma_px = 0.2\n')
    path.write_text(path.read_text("utf-8").replace("[survey]\n", '[survey]\nmasks = "masks"\n'), "utf-8")
    (folder / "masks").mkdir()
    mask = np.full((480, 640), 255, np.uint8)
    mask[:, BLACK] = 0
    for number in range(1, count + 1):
        cv2.imwrite(str(folder / "masks" / f"photo {number}.png.png"), mask)
    return path


def test_nothing_is_measured_under_black(tmp_path: Path) -> None:
    survey = read_survey(masked(tmp_path, count=5))
    network = run_survey(survey).adjustment.network
    seen = network.image_points
    of_last = seen.image == network.images.index("photo 6.png")
    assert (seen.xy[~of_last, 0] > BLACK.stop - 1).all()
    assert set(network.source.tolist()) == {0, 1, 2}
    for source in (0, 2):
        assert (seen.xy[(network.source == source) & of_last, 0] < BLACK.stop - 1).any()
    whole = run_survey(replace(survey, masks=None)).adjustment.network.image_points
    assert len(seen) < len(whole)


def test_masks_of_another_size_or_other_photographs_are_refused(tmp_path: Path) -> None:
    path = masked(tmp_path)
    cv2.imwrite(str(tmp_path / "masks" / "photo 3.png.png"), np.full((240, 320), 255, np.uint8))
    with pytest.raises(SurveyFileError, match=r"photo 3.png.png: the mask has 320 x 240 px, .* 640 x 480 px"):
        run_survey(read_survey(path))
    for mask in (tmp_path / "masks").iterdir():
        mask.rename(mask.with_name(mask.name.replace(".png.png", "_mask.png")))
    with pytest.raises(SurveyFileError, match=r"no mask of a photograph; .* would be photo 1.png.png"):
        run_survey(read_survey(path))
