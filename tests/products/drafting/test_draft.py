"""From a folder of photographs to a result, with no file written by hand."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageFilter
from PIL.TiffImagePlugin import IFDRational

from adapters.colmap.mapper import sensor_width_mm
from sfm.files.open_folders import manifest_text, sha256_of
from sfm.model.errors import GeometryError, OutputError
from sfm.products.drafting.draft import draft_survey
from sfm.report.output import Origin, read_origin, refuse_other_origin
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.survey_file import read_survey_file
from sfm.targets.codes.plates import FAMILIES, PLATES
from tests.commands import kolinear
from tests.satellite import at, state_position
from tests.surveys import write_photograph_survey
from tests.tables import rows_of

PHOTOS = """
[survey]
name = "photos"
unit = "mm"
[[camera]]
name = "small"
images = "*.png"
pixel_mm = [0.005, 0.005]
c_mm = 8.0
[datum]
kind = "free"
"""


def sizes(result: Path) -> np.ndarray:
    """Distances between all coded points, in units of their mean: what a free network without scale has."""
    rows = sorted((row["id"], *(float(row[a]) for a in "XYZ")) for row in rows_of(result / "points.csv"))
    xyz = np.array([row[1:] for row in rows if row[0].isdigit()])
    distance = np.linalg.norm(xyz[:, None] - xyz, axis=-1)
    return distance / distance.mean()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs with what lies about in such folders; no survey file."""
    photographs = tmp_path_factory.mktemp("drafting") / 'plate "A"'
    write_photograph_survey(photographs, "drafted").unlink()
    (photographs / "notes.txt").write_text("lunch at 12")
    (photographs / "broken.jpg").write_bytes(b"no photograph")
    cv2.imwrite(str(photographs / "screenshot.png"), np.full((300, 200), 90, dtype=np.uint8))
    return photographs


def test_positions_are_named_and_observations_only_if_asked_for(tmp_path: Path) -> None:
    folder = tmp_path / "positions"
    folder.mkdir()
    for k in (1, 2, 3):
        Image.new("L", (120, 80), 10 * k).save(folder / f"photo {k}.png")
    without = draft_survey(folder)
    for k in (1, 2):
        state_position(folder / f"photo {k}.png", at(0.3 * k, 0.0, 25.0))
    draft = draft_survey(folder)
    assert "positions" not in dict(without.found) and "exif_sigma_m" not in without.text
    assert "2 photographs" in dict(draft.found)["positions"]
    assert "exterior" not in tomllib.loads(draft.text)
    asked = re.sub(r"^# (\[exterior\]|exif_sigma_m)", r"\1", draft.text, flags=re.M)
    (tmp_path / "survey.toml").write_text(asked, encoding="utf-8")
    assert read_survey_file(tmp_path / "survey.toml").exif_sigma_m == (5, 10)


def test_a_folder_becomes_a_result(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert kolinear("run", folder, "--out", "mine/first") == 0
    told = capsys.readouterr()
    assert (
        "broken.jpg: not a photograph" in told.err and "screenshot.png: the only one of 200 x 300" in told.err
    )
    assert "targets: ring14, dark" in told.err and "scale is undefined" in told.out
    first = sizes(tmp_path / "mine/first")
    assert len(first) == 20 and "112 accepted, 0 rejected" in told.out

    survey = tmp_path / "mine/first.toml"
    comments = [line for line in survey.read_text().splitlines() if line.startswith("#")]
    listed = set(" ".join(comments).replace("#", "").replace(",", "").replace(";", "").split())
    assert set(PLATES) <= listed and max(map(len, comments[1:])) <= 110
    heads = tuple(word.removesuffix("…") for word in listed if word.endswith("…"))
    assert all(name in listed or name.startswith(heads) for name in FAMILIES)
    survey.write_text(survey.read_text().replace('kind = "free"', 'kind = "minimal"'))
    capsys.readouterr()
    assert kolinear("run", folder, "--out", "mine/first") == 0
    told = capsys.readouterr()
    assert f"Running {Path('mine/first.toml')}, which exists" in told.err
    assert "minimal" in told.out, "the file that a person changed is run as it is"
    np.testing.assert_allclose(sizes(tmp_path / "mine/first"), first, atol=1e-9)


def test_a_result_of_another_survey_is_replaced_only_when_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same survey is run again as it is, also after all was moved together."""
    out = tmp_path / "all" / "out" / "photos"
    out.mkdir(parents=True)
    file, images = out.parent / "photos.toml", tmp_path / "all" / "photos"
    own = Origin(file, images)
    assert read_origin(out) is None
    refuse_other_origin(out, own)  # nothing is there
    line = {"event": "start", "survey": "photos", **own.written(out)}
    (out / "log.jsonl").write_text(json.dumps(line) + "\n", encoding="utf-8")
    (out / "manifest.json").write_text(
        manifest_text({"log.jsonl": [sha256_of(out / "log.jsonl")]}), encoding="utf-8"
    )
    refuse_other_origin(out, own)
    for other in (Origin(file, tmp_path / "photos"), Origin(tmp_path / "photos.toml", images)):
        with pytest.raises(OutputError, match="--overwrite"):
            refuse_other_origin(out, other)
    file.write_text(PHOTOS, encoding="utf-8")
    monkeypatch.chdir(tmp_path / "all")
    for given in (("--images", tmp_path / "photos"), ("--images", images)):
        assert kolinear("run", file, *given) == 2
        said = capsys.readouterr().err
        assert ("--overwrite" in said) == (given[1] != images), said
        assert kolinear("run", file, *given, "--overwrite") == 2
        assert "--overwrite" not in capsys.readouterr().err, "no photographs are there"
    (tmp_path / "all").rename(tmp_path / "moved")
    moved = tmp_path / "moved"
    refuse_other_origin(moved / "out/photos", Origin(moved / "out/photos.toml", moved / "photos"))


def test_a_result_that_states_no_origin_is_known_by_its_name_and_photographs(tmp_path: Path) -> None:
    """As those of a script; before, any other survey replaced them."""
    out, images = tmp_path / "result", tmp_path / "photos"
    out.mkdir()
    images.mkdir()
    own = Origin(tmp_path / "survey.toml", images)
    refuse_other_origin(out, own, survey="tower")  # no result
    (out / "summary.json").write_text('{"survey": "bridge"}', encoding="utf-8")
    with pytest.raises(OutputError, match=r"survey bridge with no table of photographs.*--overwrite"):
        refuse_other_origin(out, own, survey="bridge")
    (out / "images.csv").write_text("image,X\na.jpg,1.0\nb.jpg,2.0\n", encoding="utf-8")
    with pytest.raises(OutputError, match=r"survey bridge with 2 photographs \(a.jpg, b.jpg\).*--overwrite"):
        refuse_other_origin(out, own, survey="bridge")
    refuse_other_origin(out, own, survey="bridge", photographs=False)  # of image points
    (images / "b.jpg").touch()
    for survey in ("bridge", ""):
        refuse_other_origin(out, own, survey=survey)
    with pytest.raises(OutputError, match="--overwrite"):
        refuse_other_origin(out, own, survey="tower")


def test_init_writes_only_the_file_and_replaces_none(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert kolinear("init", folder, "--out", "draft.toml") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["draft.toml"]
    described = read_survey_file(tmp_path / "draft.toml")
    assert described.name == 'plate "A"' and described.targets.codes == "ring14"
    assert described.cameras[0].images == ("photo *.png",)
    assert tomllib.loads((tmp_path / "draft.toml").read_text())["datum"] == {"kind": "free"}
    capsys.readouterr()
    assert kolinear("init", folder, "--out", "draft.toml") == 2
    assert "draft.toml" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("names", "line"),
    [
        ((), "no photographs"),
        (("a.txt",), "no photographs"),
        (("a.jpg", "b.jpg"), "at least 2 are needed"),
    ],
)
def test_folders_that_are_no_survey(
    names: tuple[str, ...],
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for name in names:
        (photographs / name).write_bytes(b"nothing")
    monkeypatch.chdir(tmp_path)
    assert kolinear("run", photographs) == 2
    error = capsys.readouterr().err
    assert line in error and error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["photographs"], "nothing is left behind"


def test_a_changed_focal_length_and_hostile_names_make_a_file_that_reads(tmp_path: Path) -> None:
    for k in range(6):
        exif = Image.Exif()
        exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Ma]ker", 'X"\n[[camera]]'
        exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLength: IFDRational(50 if k < 4 else 85, 1)}
        name = f'a [{k}] "*" # \\{k}.jpg'
        Image.new("L", (120, 80), 10 * k).save(tmp_path / name, exif=exif)
    draft = draft_survey(tmp_path)
    (tmp_path / "survey.toml").write_text(draft.text, encoding="utf-8")
    described = read_survey_file(tmp_path / "survey.toml")
    assert [len(one.images or ()) for one in described.cameras] == [4, 2]
    assert [one.c_mm for one in described.cameras] == [50.0, 85.0]
    assert described.tie_points is not None, "there is no target"
    assert "two targets" not in draft.text and "# [[point]]" in draft.text


@pytest.mark.parametrize(
    ("lens", "model"), [("AF Fisheye Nikkor 16mm f/2.8D", "opencv_fisheye"), ("EF16mm f/2.8 USM", None)]
)
def test_a_lens_that_is_called_a_fisheye_is_drafted_as_one(
    tmp_path: Path, lens: str, model: str | None
) -> None:
    """Of others nothing is said where natural texture is measured: the photographs decide."""
    for k in range(2):
        exif = Image.Exif()
        exif[ExifTags.IFD.Exif] = {
            ExifTags.Base.FocalLength: IFDRational(16, 1),
            ExifTags.Base.FocalLengthIn35mmFilm: 16,
            ExifTags.Base.LensModel: lens,
        }
        Image.new("L", (120, 80), 10 * k).save(tmp_path / f"{k}.jpg", exif=exif)
    (tmp_path / "survey.toml").write_text(draft_survey(tmp_path).text, encoding="utf-8")
    (camera,) = read_survey_file(tmp_path / "survey.toml").cameras
    assert camera.model == (model or "brown") and camera.states_model == (model is not None)
    assert not camera.states_free


def test_a_truncated_photograph_is_passed_over_by_name(tmp_path: Path) -> None:
    for k in range(4):
        smooth = Image.effect_noise((120, 80), 60).filter(ImageFilter.GaussianBlur(3))
        smooth.save(tmp_path / f"{k}.jpg")  # noise itself has thousands of squares, each read as a tag
    for broken in ("0.jpg", "3.jpg"):
        file = tmp_path / broken
        file.write_bytes(file.read_bytes()[:-400])
    draft = draft_survey(tmp_path)
    assert [name for name, _ in draft.left_out] == ["0.jpg", "3.jpg"]
    (tmp_path / "1.jpg").write_bytes(file.read_bytes())
    with pytest.raises(GeometryError, match="1 readable photograph, at least 2 are needed"):
        draft_survey(tmp_path)


def test_files_that_are_no_photographs_are_in_no_glob(tmp_path: Path) -> None:
    """Neither what the draft leaves out nor what macOS writes beside files."""
    for k in range(4):
        smooth = Image.effect_noise((120, 80), 60).filter(ImageFilter.GaussianBlur(3))
        smooth.save(tmp_path / f"IMG_{k}.jpg")
        (tmp_path / f"._IMG_{k}.jpg").write_bytes(b"of macOS")
    (tmp_path / "notes.jpg").write_bytes(b"no photograph")
    draft = draft_survey(tmp_path)
    assert [name for name, _ in draft.left_out] == ["notes.jpg"]
    (tmp_path / "survey.toml").write_text(draft.text, encoding="utf-8")
    survey = read_survey_file(tmp_path / "survey.toml")
    assert find_photographs(survey).names == tuple(f"IMG_{k}.jpg" for k in range(4))


def test_cameras_that_may_be_one_are_named_with_what_helps(tmp_path: Path) -> None:
    """Photographs of other sizes cannot be combined in the survey file, but may be of one camera."""
    for k in range(6):
        smooth = Image.effect_noise((120, 80), 60).filter(ImageFilter.GaussianBlur(3))
        (smooth.transpose(Image.Transpose.ROTATE_90) if k > 3 else smooth).save(tmp_path / f"{k}.png")
    (said,) = (said for said in draft_survey(tmp_path).remarks if "cameras" in said.kind)
    assert said.kind == "several_cameras" and "unnamed-2 (2 of 80 x 120 px)" in said.text
    assert "original files" in said.remedy


def test_colmap_knows_the_width_of_a_sensor() -> None:
    assert sensor_width_mm("OLYMPUS OPTICAL CO.,LTD", "C4040Z") == pytest.approx(7.11)
    assert sensor_width_mm("Nobody", "Nothing 1") is None


def test_names_that_pair_up_are_two_cameras_with_a_rig(tmp_path: Path) -> None:
    """Each moment was taken for a camera."""
    for k in range(12):
        Image.new("L", (120, 80), 9 * k).save(tmp_path / f"dot_{k // 2:02d}_{k % 2}.png")
    draft = draft_survey(tmp_path)
    read = tomllib.loads(draft.text)
    assert len(read["camera"]) == 2 and len(read["rig"]) == 1
    assert "several_cameras" not in [said.kind for said in draft.remarks]  # nobody takes them for one


def test_names_by_date_and_time_are_one_camera(tmp_path: Path) -> None:
    for k in range(6):
        Image.new("L", (120, 80), 9 * k).save(tmp_path / f"img-2024-05-0{k + 1}-12-{10 + k}-33-7.png")
    read = tomllib.loads(draft_survey(tmp_path).text)
    assert len(read["camera"]) == 1 and "rig" not in read
