"""Photographs that are not alike or not new: other sizes, other files, links, copies."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.adjustment.solve import adjust
from sfm.judgement.survey_result import SurveyResult
from sfm.model.errors import GeometryError, PhotographError, SurveyFileError
from sfm.photographs import camera_files
from sfm.photographs.reading import read_photograph
from sfm.pipeline import run_survey
from sfm.products.drafting.draft import draft_survey
from sfm.survey.inputs.checks.copies import (
    find_copies,
    without_copies,
)
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.survey.measuring.targets import OtherSizes, separate_sizes
from sfm.targets.codes.tags import tag_family, tag_modules
from tests.surveys import SIZE_PX, survey_of, write_photograph_survey
from tests.synthetic import make_network, seed_of

WIDTH, HEIGHT = SIZE_PX


def sized(folder: Path, sizes: dict[str, tuple[int, int]], *, camera: str = "") -> OtherSizes:
    """Return what is made of a survey of grey photographs of these sizes."""
    folder.mkdir()
    for name, (width, height) in sizes.items():
        cv2.imwrite(str(folder / name), np.full((height, width), 90, dtype=np.uint8))
    text = f"""[survey]
name = "sizes"
unit = "mm"
[[camera]]
name = "small"
images = "*.png"
pixel_mm = [0.01, 0.02]
c_mm = 8.0
{camera}
"""
    (folder / "survey.toml").write_text(text, encoding="utf-8")
    survey = read_survey(folder / "survey.toml")
    return separate_sizes(survey, find_photographs(survey))


@pytest.mark.parametrize(
    ("size", "kind", "pixel_mm"),
    [
        ((30, 40), "stored upright", (0.02, 0.01)),
        ((80, 60), "resampled", (0.005, 0.01)),
        ((36, 30), "cropped or from another sensor", (0.01, 0.02)),
    ],
)
def test_photographs_of_another_size_are_a_second_camera(
    size: tuple[int, int], kind: str, pixel_mm: tuple[float, float], tmp_path: Path
) -> None:
    sizes = {f"a{k}.png": (40, 30) for k in range(4)} | {f"b{k}.png": size for k in range(3)}
    found = sized(tmp_path / "s", sizes)
    assert [camera.name for camera in found.survey.cameras] == ["small", f"small {size[0]}x{size[1]}"]
    assert found.files.camera.tolist() == [0] * 4 + [1] * 3 and found.left_out == ()
    assert found.survey.cameras[1].pixel_mm == pytest.approx(pixel_mm)
    (one,) = found.remarks
    assert one.kind == "camera_by_size" and one.severity == "note" and one.names("what") == (kind,)
    assert one.names("photographs") == ("b0.png", "b1.png", "b2.png") and one.names("camera") == ("small",)


@pytest.mark.parametrize(
    ("count", "camera", "kind"),
    [
        (1, "", "photograph_of_other_size"),
        (3, "fixed = {K1 = 1e-4}", "photograph_of_other_size"),
    ],
)
def test_too_few_of_them_are_left_out_with_a_remark(
    count: int, camera: str, kind: str, tmp_path: Path
) -> None:
    sizes = {f"a{k}.png": (40, 30) for k in range(4)} | {f"b{k}.png": (30, 40) for k in range(count)}
    found = sized(tmp_path / "s", sizes, camera=camera)
    assert [one.image for one in found.left_out] == [f"b{k}.png" for k in range(count)]
    assert all(one.reason.kind == kind for one in found.left_out)
    assert len(found.survey.cameras) == 1 and len(found.files) == 4


def test_sizes_that_agree_change_nothing(tmp_path: Path) -> None:
    found = sized(tmp_path / "s", {"a.png": (40, 30), "b.png": (40, 30), "c.png": (40, 30)})
    assert isinstance(found.survey, Survey) and found.remarks == () and len(found.files) == 3


def test_a_survey_with_a_crop_goes_on(tmp_path: Path) -> None:
    path = write_photograph_survey(tmp_path / "s", "crop")
    crop = cv2.imread(str(path.parent / "photo 3.png"), cv2.IMREAD_GRAYSCALE)
    assert crop is not None
    cv2.imwrite(str(path.parent / "photo 3.png"), crop[10 : HEIGHT - 20, 20 : WIDTH - 10])
    result = run_survey(read_survey(path))
    (failed,) = result.failed
    assert failed.image == "photo 3.png" and failed.reason.names("size") == ("610 x 450 px",)
    assert result.images_total == 6 and len(result.network.images) == 5


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("a.HEIC", "a HEIF file, .* pillow-heif.*kolinear.photographs."),
        ("a.nef", "a raw file, .* rawpy"),
        ("a.dng", "a raw file"),
        ("a.avif", "an AVIF file, .* convert"),
    ],
)
def test_what_cannot_be_read_is_reported_with_the_remedy(
    name: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Raw files are TIFF files whose first picture is a small preview."""
    monkeypatch.setattr(camera_files, "is_installed", lambda _: False)
    cv2.imwrite(str(tmp_path / "a.tif"), np.full((30, 40), 90, dtype=np.uint8))
    (tmp_path / "a.tif").rename(tmp_path / name)
    with pytest.raises(PhotographError, match=told):
        read_photograph(tmp_path / name)
    with pytest.raises(SurveyFileError, match=f"no photographs .* it contains {name}: {told}"):
        draft_survey(tmp_path)


@pytest.mark.parametrize(
    ("at", "named", "allowed"),
    [("photos", True, True), (".secret", True, False), ("photos", False, False), ("", True, False)],
)
def test_links_to_photographs_of_ones_own_are_read_in_a_folder_that_is_named(
    at: str, named: bool, allowed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("USERPROFILE", str(tmp_path / "home"))
    own = tmp_path / "home" / at if at else tmp_path / "elsewhere"
    own.mkdir(parents=True)
    given = tmp_path / "given"
    given.mkdir()
    for k in range(2):
        cv2.imwrite(str(own / f"{k}.png"), np.full((30, 40), 90, dtype=np.uint8))
        (given / f"{k}.png").symlink_to(own / f"{k}.png")
    text = '[survey]\nname = "s"\nunit = "mm"\n[[camera]]\nname = "c"\nimages = "*.png"\nc_mm = 8.0\n'
    (given / "survey.toml").write_text(text, encoding="utf-8")
    survey = read_survey(given / "survey.toml")
    if allowed:
        assert find_photographs(survey, images_dir=given).names == ("0.png", "1.png")
    else:
        with pytest.raises(SurveyFileError, match="leaves the survey's folder"):
            find_photographs(survey, images_dir=given if named else None)


def test_tags_in_place_of_the_rings_that_were_asked_for_are_reported(tmp_path: Path) -> None:
    path = write_photograph_survey(tmp_path / "s", "no rings", photographs=2)
    family = tag_family("aruco4x4_50")
    for k in (1, 2):
        sheet = np.full((HEIGHT, WIDTH), 220, dtype=np.uint8)
        for number, (x, y) in enumerate(((60, 50), (300, 60 + 40 * k), (80, 250), (400, 280))):
            tag = np.where(tag_modules(family, number), 20, 220).astype(np.uint8)
            sheet[y : y + 120, x : x + 120] = np.kron(tag, np.ones((20, 20), dtype=np.uint8))
        cv2.imwrite(str(path.parent / f"photo {k}.png"), cv2.GaussianBlur(sheet, (0, 0), 0.8))
    with pytest.raises(GeometryError, match="shows 4 square tags: codes = 'aruco4x4_50' reads them"):
        run_survey(read_survey(path))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs with the noise of real ones: compression adds less."""
    made = write_photograph_survey(tmp_path_factory.mktemp("copies") / "s", "copies").parent
    rng = seed_of("noise of copies")
    for path in sorted(made.glob("*.png")):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        noisy = np.rint(grey + 8.0 * rng.standard_normal(grey.shape))
        cv2.imwrite(str(path), np.clip(noisy, 0, 255).astype(np.uint8))
    return made


@pytest.fixture(scope="module")
def plain(folder: Path) -> SurveyResult:
    return run_survey(read_survey(folder / "survey.toml"))


@pytest.mark.parametrize("quality", [75, pytest.param(95, marks=pytest.mark.slow)])
def test_photographs_saved_again_as_jpeg_count_once(
    plain: SurveyResult, folder: Path, quality: int, tmp_path: Path
) -> None:
    shutil.copytree(folder, tmp_path / "s")
    for path in sorted((tmp_path / "s").glob("*.png")):
        _, data = cv2.imencode(".jpg", cv2.imread(str(path)), [cv2.IMWRITE_JPEG_QUALITY, quality])
        cv2.imwrite(str(path.with_name(f"{path.stem}_again.png")), cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))
    result = run_survey(read_survey(tmp_path / "s" / "survey.toml"))
    assert result.images_total == 6 and len(result.failed) == 6
    assert [one.reason.names("original")[0] for one in result.failed] == sorted(plain.network.images)
    assert result.adjustment.redundancy == plain.adjustment.redundancy
    assert np.allclose(result.adjustment.covariance.points, plain.adjustment.covariance.points, rtol=1e-6)


def test_exposures_from_one_place_count_each(folder: Path, tmp_path: Path) -> None:
    other = write_photograph_survey(tmp_path / "other", "second exposures").parent
    shutil.copytree(folder, tmp_path / "s")
    for path in other.glob("*.png"):
        shutil.copy(path, tmp_path / "s" / f"{path.stem}_second.png")
    result = run_survey(read_survey(tmp_path / "s" / "survey.toml"))
    assert result.images_total == 12 and result.failed == ()


@pytest.mark.parametrize("rho", [0.5, 0.85])
def test_photographs_whose_errors_correlate(rho: float) -> None:
    """As of given image points; the correlation that is found is that of the errors."""
    network, truth = make_network(seed_of("correlated"), images=8, points=60, noise_px=0.1)
    seen = network.image_points
    exact, _ = make_network(seed_of("correlated"), images=8, points=60, noise_px=0.0)
    rng = seed_of("correlated errors")
    order = np.arange(8)
    order[5] = 2
    position, rotation = truth.position[order], truth.rotation[order]
    xy = exact.image_points.xy.copy()
    third, sixth = (np.flatnonzero(seen.image == k) for k in (2, 5))
    assert (seen.point[third] == seen.point[sixth]).all()
    xy[sixth] = xy[third]
    noise = 0.1 * rng.standard_normal(xy.shape)
    noise[sixth] = rho * noise[third] + np.sqrt(1 - rho**2) * noise[sixth]
    both = replace(network, image_points=replace(seen, xy=xy + noise))
    start = replace(truth, position=position, rotation=rotation)
    found = find_copies(adjust(both, start))
    if rho == 0.5:
        assert found == {}
    else:
        assert found["image 6"][0] == "image 3" and abs(found["image 6"][1] - rho) < 0.1
        result = run_survey(survey_of(both, start, start=start))
        assert [(one.image, *one.reason.names("original")) for one in result.failed] == [
            ("image 6", "image 3")
        ]


def test_photographs_of_one_place_are_named_as_such() -> None:
    """A fixed camera and a fixed board: what is seen differs by far less than residuals."""
    network, truth = make_network(seed_of("still"), images=3, points=60, noise_px=0.1)
    assert without_copies(network, truth, ["image 2"])[1].oriented.tolist() == [True, False, True]
    with pytest.raises(GeometryError, match="2 of 3 photographs show"):
        without_copies(network, truth, ["image 2", "image 3"])
