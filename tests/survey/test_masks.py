"""Masks of photographs: what is black takes no part, of whatever source it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.errors import PhotographError, SurveyFileError
from sfm.photographs.masks import Masks
from sfm.photographs.reading import read_mask, read_photograph
from sfm.pipeline import run_survey
from sfm.products.drafting.draft import draft_survey
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.survey import read_survey
from sfm.survey.inputs.survey_file import read_survey_file
from sfm.targets.detect import find_targets
from sfm.targets.measure import EllipseFit, fit_ellipse_model
from tests.survey.test_sources import CORNERS, write, write_given

BLACK = slice(0, 220)  # columns of the masked part, px


def masked(folder: Path, count: int = 6) -> Path:
    """Write the survey of targets, texture and given points, and masks of some of its photographs."""
    write_given(folder / "corners.csv", CORNERS)
    path = write(
        folder, '[tie_points]\nwindow_px = 15\n[[observations]]\nfile = "corners.csv"\nsigma_px = 0.2\n'
    )
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


def test_targets_under_black_are_neither_fitted_nor_reported_as_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time of a masked survey is that of what is seen."""
    fitted: list[FloatArray] = []

    def counted(photograph: AnyArray, xy: FloatArray, *others: FloatArray, **options: float) -> EllipseFit:
        fitted.append(xy)
        return fit_ellipse_model(photograph, xy, *others, **options)

    monkeypatch.setattr("sfm.targets.detect.fit_ellipse_model", counted)
    masked(tmp_path)
    picture = read_photograph(tmp_path / "photo 1.png")
    hidden = np.zeros(picture.shape, dtype=bool)
    hidden[:, BLACK] = True
    whole, shown = (find_targets(picture, codes="ring14", hidden=part) for part in (None, hidden))
    seen = whole.select((whole.code >= 0) & (whole.xy[:, 0] > BLACK.stop - 0.5))
    coded = shown.select(shown.code >= 0)
    assert 0 < len(seen) < (whole.code >= 0).sum() and (coded.code == seen.code).all()
    sigma = np.sqrt(np.einsum("kii->ki", seen.covariance))
    assert (np.abs(coded.xy - seen.xy) < 0.05 * sigma).all()  # the noise of outlines is that of what is seen
    assert (shown.xy[:, 0] > BLACK.stop - 1).all()
    assert len(fitted[1]) < len(fitted[0])
    assert (shown.rejected_xy[:, 0] > BLACK.stop - 1).all()


def test_masks_are_among_the_photographs_if_these_are_elsewhere(tmp_path: Path) -> None:
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    file = masked(photographs)
    moved = tmp_path / "survey.toml"
    text = file.read_text("utf-8").replace('masks = "masks"', 'masks = "./masks"')
    moved.write_text(text, "utf-8")
    (photographs / "corners.csv").rename(tmp_path / "corners.csv")
    result = run_survey(read_survey(moved), images_dir=photographs)
    assert (result.adjustment.network.image_points.xy[:, 0] > BLACK.stop - 1).all()
    (photographs / "masks").rename(tmp_path / "masks")  # beside the survey file
    again = run_survey(read_survey(moved), images_dir=photographs)
    np.testing.assert_array_equal(
        again.adjustment.network.image_points.xy, result.adjustment.network.image_points.xy
    )
    (tmp_path / "masks").rename(tmp_path / "hidden")
    with pytest.raises(SurveyFileError, match="needed the folder of the masks"):
        run_survey(read_survey(moved), images_dir=photographs)


def test_a_mask_is_decoded_once_in_a_survey(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Targets, tie points, given image points and windows all ask for it; it is read again if it changes."""
    read: list[str] = []

    def counted(path: Path) -> AnyArray:
        read.append(path.name)
        return read_mask(path)

    monkeypatch.setattr("sfm.photographs.masks.read_mask", counted)
    path = masked(tmp_path, count=2)
    run_survey(read_survey(path))
    assert sorted(read) == ["photo 1.png.png", "photo 2.png.png"]
    masks, mask = Masks(tmp_path / "masks"), np.zeros((480, 640), np.uint8)
    cv2.imwrite(str(tmp_path / "masks" / "photo 1.png.png"), mask)
    black = masks.black("photo 1.png", (640, 480))
    assert black is not None and black.all() and len(read) == 3


def test_a_mask_of_24_million_pixels_may_have_few_bytes(tmp_path: Path) -> None:
    mask = np.zeros((4000, 6000), np.uint8)
    mask[1000:3000, 2000:4000] = 255
    cv2.imwrite(str(tmp_path / "a.jpg.png"), mask)
    with pytest.raises(PhotographError, match="is not a photograph"):
        read_photograph(tmp_path / "a.jpg.png")
    black = Masks(tmp_path).black("a.jpg", (6000, 4000))
    assert black is not None and (black == (mask == 0)).all()


def test_masks_of_another_size_or_other_photographs_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sfm.pipeline.measure_sources", lambda *a, **k: pytest.fail("measured"))
    path = masked(tmp_path)
    cv2.imwrite(str(tmp_path / "masks" / "photo 3.png.png"), np.full((240, 320), 255, np.uint8))
    wrong_size = r"photo 3.png.png: the mask has 320 x 240 px, .* 640 x 480 px"
    with pytest.raises(SurveyFileError, match=wrong_size):
        run_survey(read_survey(path))
    draft = draft_survey(tmp_path)  # it may be a folder of another purpose
    assert '\n# masks = "masks"' in draft.text
    assert any("photo 3.png.png: the mask has 320 x 240 px" in found for _, found in draft.found)
    for mask in (tmp_path / "masks").iterdir():
        mask.rename(mask.with_name(mask.name.replace(".png.png", "_mask.png")))
    with pytest.raises(SurveyFileError, match=r"no mask of a photograph; .* would be photo 1.png.png"):
        run_survey(read_survey(path))
    path.write_text(path.read_text("utf-8").replace('masks = "masks"', 'masks = "."'), "utf-8")
    with pytest.raises(SurveyFileError, match=r"photo 1.png: is a photograph, needed the mask of photo 1"):
        run_survey(read_survey(path))


def test_masks_may_lie_beside_png_photographs(tmp_path: Path) -> None:
    path = masked(tmp_path)
    apart = find_photographs(read_survey(path))
    for mask in (tmp_path / "masks").iterdir():
        mask.rename(tmp_path / mask.name)
    with pytest.raises(SurveyFileError):
        run_survey(read_survey(path))
    path.write_text(path.read_text("utf-8").replace('masks = "masks"', 'masks = "."'), "utf-8")
    survey = read_survey(path)
    assert find_photographs(survey).names == apart.names == find_photographs(read_survey_file(path)).names
    Masks(survey.masks).refuse_wrong(apart.path_of())
    (tmp_path / "photo 6.png.png").unlink()
    with pytest.raises(
        SurveyFileError, match=r"photo 6.png: is a photograph, .*; name it photo 6.png.png, or"
    ):
        run_survey(survey)


@pytest.mark.parametrize(
    ("files", "name", "mask"),
    [
        (["a.jpg.png"], "a.jpg", "a.jpg.png"),
        (["sub/a.jpg.png", "a.jpg.png"], "sub/a.jpg", "sub/a.jpg.png"),
        (["a.jpg.png"], "images/a.jpg", "a.jpg.png"),
        (["a.png", "a.png.png"], "a.png", "a.png.png"),
        (["a.png"], "a.png", "a.png"),
        (["a.png"], "a.jpg", None),
        (["a.jpg"], "a.jpg", None),
        (["a.jpg.png"], "../a.jpg", None),
    ],
)
def test_the_mask_of_a_photograph_has_its_name(
    tmp_path: Path, files: list[str], name: str, mask: str | None
) -> None:
    for file in files:
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    found = Masks(tmp_path).path_of(name)
    assert found == (None if mask is None else tmp_path / mask)


def test_a_mask_is_that_of_one_photograph(tmp_path: Path) -> None:
    for name in ("one/a.png", "two/a.png", "masks/a.png.png"):
        (tmp_path / name).parent.mkdir()
        cv2.imwrite(str(tmp_path / name), np.full((6, 8), 255, np.uint8))
    paths = {name: tmp_path / name for name in ("one/a.png", "two/a.png")}
    with pytest.raises(SurveyFileError, match=r"the mask would be that of one/a.png and of two/a.png"):
        Masks(tmp_path / "masks").refuse_wrong(paths)


def test_a_draft_has_the_masks_beside_the_photographs_and_ignores_what_they_hide(tmp_path: Path) -> None:
    masked(tmp_path)
    codes, line = 'codes = "ring14"', 'masks = "masks"'
    draft = draft_survey(tmp_path).text
    assert codes in draft and f"\n{line}" in draft
    for path in (tmp_path / "masks").iterdir():
        cv2.imwrite(str(path), np.zeros((480, 640), np.uint8))
    draft = draft_survey(tmp_path).text
    assert codes not in draft and "\n[tie_points]" in draft and f"\n{line}" in draft
    (tmp_path / "masks").rename(tmp_path / "hidden")
    assert "masks =" not in draft_survey(tmp_path).text
    images = tmp_path / "images"
    images.mkdir()
    for path in tmp_path.glob("*.png"):
        path.rename(images / path.name)
    (tmp_path / "hidden").rename(tmp_path / "masks")
    outside = draft_survey(images)  # as OpenSfM has them; a survey uses no files outside its folder
    assert codes in outside.text and '\n# masks = "../masks"' in outside.text
    assert any("--allow-outside" in found for subject, found in outside.found if subject == "masks")
