"""The survey file: everything it may say is read, everything else is refused with file, line and remedy."""

from __future__ import annotations

import json
import os
from glob import escape
from pathlib import Path

import numpy as np
import pytest

from sfm.model.conventions import angles_from_rotation, image_from_pixel
from sfm.model.errors import PhotographError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.photographs.exif import Metadata
from sfm.survey.adjusting.solution_remarks import datum_remarks, missing_control
from sfm.survey.inputs.cameras import camera_of_images, start_cameras
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.start import start_values
from sfm.survey.inputs.survey import read_survey
from sfm.survey.inputs.survey_file import read_survey_file
from sfm.survey.sources.given import measure_given

FULL = """\
[survey]
name = "camcal"
unit = "m"
[[camera]]
name = "olympus"
images = "P825*.JPG"
size_px = [2272, 1704]
pixel_mm = [0.0031923, 0.0031911]
c_mm = 7.3
model = "brown"
free = ["c","x0","y0","K1","K2","K3","P1","P2","b1"]
[camera.fixed]
b2 = 1e-5
[targets]
polarity = "dark"
codes = "arcs"
min_diameter_px = 6
[datum]
kind = "free"
[control]
file = "control.csv"
[[scale_bar]]
from = "506"
to = "507"
length = 1389.688
sigma = 0.010
[observations]
file = "image_points.csv"
[approximate]
images = "images.csv"
points = "points.csv"
[adjust]
sigma_px = 0.1
[compare]
backend = "colmap"
"""
MINIMAL = """\
[survey]
name = "small"
unit = "mm"
[[camera]]
name = "one"
images = "*.jpg"
"""
OBSERVED = """\
[survey]
name = "observed"
unit = "m"
[[camera]]
name = "one"
size_px = [200, 100]
pixel_mm = [0.01, 0.02]
c_mm = 5
[observations]
file = "image_points.csv"
"""


def write(folder: Path, text: str, **tables: str) -> Path:
    path = folder / "survey.toml"
    path.write_text(text, encoding="utf-8")
    for name, table in tables.items():
        (folder / f"{name}.csv").write_text(table, encoding="utf-8")
    return path


def network_of(path: Path) -> tuple[Network, Estimate]:
    """Return the network of a survey with observations, and its start values."""
    survey = read_survey(path)
    measured = measure_given(survey)
    return measured.network, start_values(survey, measured.network, measured.cameras)


def metadata(size: tuple[int, int], focal: float | None = None, pixel: float | None = None) -> Metadata:
    return Metadata(size, None, None, focal, None, None if pixel is None else (pixel, pixel), 1)


def test_every_key_of_the_survey_file_is_read(tmp_path: Path) -> None:
    survey = read_survey_file(write(tmp_path, FULL))
    assert (survey.name, survey.unit, survey.path.name) == ("camcal", "m", "survey.toml")
    camera = survey.cameras[0]
    assert (camera.name, camera.images, camera.size_px) == ("olympus", ("P825*.JPG",), (2272, 1704))
    assert camera.pixel_mm == (0.0031923, 0.0031911)
    assert (camera.c_mm, camera.model, camera.fixed) == (7.3, "brown", (("b2", 1e-5),))
    assert camera.free == ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1")
    assert (survey.targets.polarity, survey.codes, survey.targets.min_diameter_px) == ("dark", "arcs", 6.0)
    assert survey.datum.kind == "free"
    assert survey.control is not None and survey.control.file == "control.csv"
    bar = survey.scale_bars[0]
    assert (bar.start, bar.end, bar.length, bar.sigma) == ("506", "507", 1389.688, 0.01)
    assert survey.observations is not None and survey.observations.file == "image_points.csv"
    assert (survey.approximate.images, survey.approximate.points) == ("images.csv", "points.csv")
    assert (survey.adjust.sigma_px, survey.compare.backend) == (0.1, "colmap")


def test_a_survey_is_frozen(tmp_path: Path) -> None:
    survey = read_survey_file(write(tmp_path, FULL))
    with pytest.raises(ValueError, match="frozen"):
        survey.datum.kind = "control"  # type: ignore[misc]


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (
            "unit =",
            "units =",
            r"survey.toml, line 3: unknown key 'units' in \[survey\], known are name, unit, equipment",
        ),
        (
            "sigma = 0.010",
            "sigmas = 0.010",
            r"line 26: unknown key 'sigmas' in \[scale_bar 1\], known are from, to, length, sigma$",
        ),
        (
            "sigma_px =",
            "sigma =",
            r"unknown key 'sigma' in \[adjust\], known are sigma_px, reject, weights, false_alarm$",
        ),
        ('name = "camcal"\n', "", r"line 1: survey.name is missing"),
        ("[datum]", "[date]", r"line 18: unknown key 'date' in the file, known are survey, camera,"),
        ("c_mm = 7.3", 'c_mm = "7.3"', r"line 9: camera 1.c_mm: found '7.3', needed a number"),
        ("c_mm = 7.3", "c_mm = nan", r"line 9: camera 1.c_mm: found nan, needed a finite number"),
        ("c_mm = 7.3", "c_mm = -7.3", r"line 9: camera 1.c_mm: found -7.3, needed more than 0"),
        ("c_mm = 7.3", "c_mm = true", r"found true, needed a number"),
        (
            "[2272, 1704]",
            "[2272.5, 1704]",
            r"line 7: camera 1.size_px 1: found 2272.5, needed a whole number",
        ),
        ("[2272, 1704]", "[2272]", r"camera 1.size_px: found \[2272\], needed 2 values"),
        ("[2272, 1704]", "[2272, 1704, 3]", r"camera 1.size_px: found \[2272, 1704, 3\], needed 2 values"),
        ("[2272, 1704]", "2272", r"needed a list in square brackets"),
        ('"dark"', '"black"', r"line 15: targets.polarity: found 'black', needed one of 'dark', 'bright'"),
        ('kind = "free"', 'kind = "fixed"', r"line 19: datum.kind: found 'fixed', needed one of 'free',"),
        ('model = "brown"', 'model = "kannala"', r"camera 1.model: found 'kannala', needed one of 'brown'"),
        ('"K3",', '"K9",', r"camera olympus: model brown has no parameter 'K9', it has c, x0, y0, K1"),
        ("b2 = 1e-5", "c = 7.0", r"parameter 'c' is both free and fixed"),
        ('free = ["c",', 'free = ["c","c",', r"camera olympus: parameter 'c' occurs 2 times in free"),
        ("b2 = 1e-5", 'b2 = "0"', r"found '0', needed a number"),
        ('from = "506"', "from = 506", r"line 23: scale_bar 1.from: found 506, needed a text in quotes"),
        ('to = "507"', 'to = "506"', r"scale_bar from '506' to the same point"),
        ("sigma = 0.010", "sigma = 0", r"scale_bar 1.sigma: found 0, needed more than 0"),
        ("sigma_px = 0.1", "sigma_px = inf", r"needed a finite number"),
        ('"arcs"', '"ring13"', r"targets.codes = 'ring13' is neither one of arcs, ring12,"),
        ('name = "camcal"', 'name = " "', r"line 2: survey.name: found an empty text"),
        ('name = "camcal"', r'name = "a\u001b[31m"', r"survey.name: found 'a\\x1b\[31m', needed plain text"),
        (
            'name = "camcal"',
            f'name = "{"a" * 501}"',
            r"needed plain text on one line, at most 500 characters",
        ),
        ("c_mm = 7.3", "c_mm = 7.3\nsensor_mm = [7, 5]", r"pixel_mm and sensor_mm are both given"),
        ('[control]\nfile = "control.csv"', "", None),
        ("[survey]", "[survey", r"line 1: \[survey: a section must be in \[ \]"),
        ("c_mm = 7.3", "c_mm = 7,3", r"line \d+: c_mm = 7,3: a number has a decimal point, not a comma"),
        ('name = "camcal"', "name = camcal", r"line 2: name = camcal: text must be in quotation marks"),
        (
            'name = "camcal"',
            "name = \u201ccamcal\u201d",
            r"line 2: .*: text must be in straight",
        ),
        ('name = "camcal"', 'name = "C:\\Users\\x"', r"line 2: .*: write / in a path, or put it"),
        ('name = "camcal"', "name = True", r"line 2: name = True: write true or false"),
        ('name = "camcal"', "name =", r"line 2: name =: no value follows"),
        ('name = "camcal"', "camcal", r"line 2: camcal: neither a section in \[ \] nor a key"),
        ('name = "camcal"', 'name = "camcal"\nname = "b"', r"line 3: name is there twice"),
        ("[control]", "[survey]", r"line \d+: \[survey\] is there twice, first in line 1; put"),
        (
            "[control]",
            "[camera]",
            r"line \d+: \[camera\] is there twice, first in line 4; write \[\[camera\]\]",
        ),
        ("c_mm = 7.3", "c_mm = 7.3\npixel_mm = [0,005, 0,005]", r"line \d+: .*: a number has a decimal"),
        ('name = "camcal"', "name = [1 2]", r"not a TOML file: .*line 2"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path: Path, old: str, new: str, match: str | None) -> None:
    assert old in FULL
    path = write(tmp_path, FULL.replace(old, new, 1))
    if match is None:
        read_survey_file(path)
        return
    with pytest.raises(SurveyFileError, match=match) as caught:
        read_survey_file(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_the_second_of_two_cameras_is_named(tmp_path: Path) -> None:
    text = MINIMAL + '[[camera]]\nname = "two"\nimages = "*.tif"\ncolour = 3\n'
    with pytest.raises(SurveyFileError, match=r"line 10: unknown key 'colour' in \[camera 2\]"):
        read_survey_file(write(tmp_path, text))
    with pytest.raises(SurveyFileError, match="two cameras are named 'one'"):
        read_survey_file(write(tmp_path, text.replace("colour = 3", "").replace('"two"', '"one"')))


@pytest.mark.parametrize("line", ["", "c_mm = 8.0\n", "fixed = { a_max = 0.5, b_max = 0.4, A0_0 = 0.0 }\n"])
def test_a_splined_camera_comes_from_a_calibration(tmp_path: Path, line: str) -> None:
    missing = 199 if "fixed" in line else 202
    text = MINIMAL + f'model = "splined_10"\n{line}'
    expected = (
        f"model splined_10 needs the values of 202 parameters of its surface, {missing} are missing; give"
    )
    with pytest.raises(SurveyFileError, match=expected):
        read_survey_file(write(tmp_path, text))


def test_natural_points_have_no_start_values(tmp_path: Path) -> None:
    """Other points would get the numbers of an earlier run, without a word."""
    text = MINIMAL + '[targets]\ncodes = "none"\n[tie_points]\n[approximate]\n'
    read_survey(
        write(
            tmp_path,
            text + 'images = "images.csv"\n',
            images="image,X,Y,Z,omega_deg,phi_deg,kappa_deg\na.jpg,0,0,1,0,0,0\n",
        )
    )
    path = write(tmp_path, text + 'points = "points.csv"\n', points="point,X,Y,Z\n1,0,0,0\n")
    with pytest.raises(SurveyFileError, match=r"tie points differ in every run"):
        read_survey(path)


def test_datum_points_are_not_for_control(tmp_path: Path) -> None:
    given = MINIMAL + '[datum]\nkind = "control"\npoints = ["1"]\n[control]\nfile = "control.csv"\n'
    with pytest.raises(SurveyFileError, match=r"datum.points are for kind 'free' or 'minimal'"):
        read_survey_file(write(tmp_path, given))


def test_unreadable_survey_files(tmp_path: Path) -> None:
    with pytest.raises(SurveyFileError, match="cannot be read: No such file"):
        read_survey_file(tmp_path / "none.toml")
    with pytest.raises(SurveyFileError, match="not a file, a survey file"):
        read_survey_file(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'[survey]\nname = "M\xfcnchen"\n')
    with pytest.raises(SurveyFileError, match=r"not a text file in UTF-8 \(byte 18\)"):
        read_survey_file(tmp_path / "latin.toml")
    (tmp_path / "large.toml").write_bytes(b"#" * 1_000_001)
    with pytest.raises(SurveyFileError, match="1000001 bytes, a survey file has at most"):
        read_survey_file(tmp_path / "large.toml")
    (tmp_path / "deep.toml").write_text("a = " + "[" * 5000, encoding="utf-8")
    with pytest.raises(SurveyFileError, match="not a TOML file: brackets nested too deeply"):
        read_survey_file(tmp_path / "deep.toml")
    (tmp_path / "long.toml").write_text("a = " + "9" * 5000, encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"not a TOML file: a number is too long$"):
        read_survey_file(tmp_path / "long.toml")


def test_a_survey_file_with_byte_order_mark_and_crlf_is_read(tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    path.write_bytes(b"\xef\xbb\xbf" + FULL.replace("\n", "\r\n").encode())
    assert read_survey_file(path) == read_survey_file(write(tmp_path, FULL))


def test_photographs_are_found_by_glob(tmp_path: Path) -> None:
    survey = read_survey_file(write(tmp_path, MINIMAL + '[[camera]]\nname = "two"\nimages = "sub/*.jpg"\n'))
    with pytest.raises(
        SurveyFileError, match=r"no photographs found: camera one needs '\*.jpg' in .*such as"
    ):
        find_photographs(survey)
    (tmp_path / "sub").mkdir()
    for name in ("b c.jpg", "ä.jpg", "sub/b c.jpg"):
        (tmp_path / name).touch()
    found = find_photographs(survey)
    assert found.names == ("b c.jpg", "ä.jpg", "sub/b c.jpg")
    assert list(found.camera) == [0, 0, 1]
    (tmp_path / "empty").mkdir()
    with pytest.raises(SurveyFileError, match=r"no photographs found.*which has no files"):
        find_photographs(survey, images_dir=tmp_path / "empty")
    with pytest.raises(SurveyFileError, match="no such folder"):
        find_photographs(survey, images_dir=tmp_path / "nowhere")


@pytest.mark.parametrize("glob", ["/abs/*.jpg", ""])
def test_globs_that_are_none(tmp_path: Path, glob: str) -> None:
    with pytest.raises(SurveyFileError, match=r"not a glob|empty text"):
        find_photographs(read_survey_file(write(tmp_path, MINIMAL.replace("*.jpg", glob))))


def test_a_photograph_whose_name_is_no_plain_text_is_refused(tmp_path: Path) -> None:
    survey = read_survey_file(write(tmp_path, FULL), allow_outside=True)
    odd = tmp_path / os.fsdecode(b"P825\xff\n.JPG")
    try:
        odd.touch()
    except OSError:
        pytest.skip("this disk takes names in UTF-8 only")
    with pytest.raises(
        SurveyFileError, match=r"photograph 'P825\\xff\\n.JPG' has control or invisible characters; rename"
    ):
        find_photographs(survey)
    odd.rename(tmp_path / "P825 ü,'<b>.JPG")
    assert find_photographs(survey).names == ("P825 ü,'<b>.JPG",)


def test_a_photograph_that_is_missing_behind_its_link_is_not_passed_over(tmp_path: Path) -> None:
    survey = read_survey_file(write(tmp_path, FULL))
    (tmp_path / "P8251.JPG").touch()
    (tmp_path / "P8252.JPG").symlink_to("nowhere.JPG")
    (tmp_path / "P8253.JPG").mkdir()
    assert find_photographs(survey).names == ("P8251.JPG", "P8252.JPG")


def test_a_photograph_of_two_cameras_is_refused(tmp_path: Path) -> None:
    survey = read_survey_file(write(tmp_path, MINIMAL + '[[camera]]\nname = "two"\nimages = "a*"\n'))
    (tmp_path / "a.jpg").touch()
    with pytest.raises(SurveyFileError, match=r"'a.jpg' matches the globs of cameras one and two"):
        find_photographs(survey)


def test_start_values_come_from_the_file_then_from_the_photographs(tmp_path: Path) -> None:
    survey = read_survey_file(write(tmp_path, MINIMAL))
    names, index = ("a.jpg", "b.jpg"), np.zeros(2, dtype=np.int64)
    camera = start_cameras(
        survey.cameras, survey.source, (metadata((600, 400)), metadata((600, 400), 8.0, 0.004)), index, names
    )[0]
    assert camera.size_px == (600, 400)
    assert camera.value("c") == 8.0
    assert camera.free.tolist() == [True] * 5 + [False] * 5  # as far as the photographs determine them
    np.testing.assert_array_equal(camera.pixel_mm, [0.004, 0.004])
    with pytest.raises(SurveyFileError, match="state the pixel size; needed pixel_mm or sensor_mm"):
        start_cameras(survey.cameras, survey.source, (metadata((600, 400), 8.0),), index, names)
    with pytest.raises(SurveyFileError, match="state the focal length; needed c_mm"):
        start_cameras(survey.cameras, survey.source, (metadata((600, 400), None, 0.004),), index, names)
    with pytest.raises(SurveyFileError, match=r"size_px = .* is needed"):
        start_cameras(survey.cameras, survey.source)
    given = (
        MINIMAL + 'sensor_mm = [6, 4]\nmodel = "opencv"\nfree = ["fx"]\n[camera.fixed]\nk1 = -0.1\nfy = 900\n'
    )
    camera = start_cameras(
        read_survey_file(write(tmp_path, given)).cameras, "survey", (metadata((600, 400), 8.0),), index, names
    )[0]
    np.testing.assert_allclose(camera.parameters, [800, 900, 299.5, 199.5, -0.1, 0, 0, 0])
    assert camera.free.tolist() == [True] + [False] * 7


def test_photographs_of_one_camera_have_one_size(tmp_path: Path) -> None:
    names, index = ("a.jpg", "b.jpg"), np.zeros(2, dtype=np.int64)
    sizes = metadata((600, 400), 8.0, 0.004), metadata((400, 600), 8.0, 0.004)
    with pytest.raises(
        PhotographError, match=r"camera one: photograph 'b.jpg' has 400 x 600 px, 'a.jpg' 600 x 400 px"
    ):
        start_cameras(read_survey_file(write(tmp_path, MINIMAL)).cameras, "survey", sizes, index, names)
    survey = read_survey_file(write(tmp_path, MINIMAL + "size_px = [400, 600]\n"))
    with pytest.raises(PhotographError, match=r"'a.jpg' has 600 x 400 px, size_px 400 x 600 px"):
        start_cameras(survey.cameras, survey.source, sizes, index, names)


def test_image_points_in_pixels_and_in_millimetres_are_the_same(tmp_path: Path) -> None:
    rows = [("i1", "p1", 10.0, 20.0), ("i1", "p2", 150.25, 70.5), ("i2", "p1", 99.5, 49.5)]
    px = "image,point,x_px,y_px,sx_px,sy_px\n" + "".join(f"{i},{p},{x},{y},0.1,0.2\n" for i, p, x, y in rows)
    network, estimate = network_of(write(tmp_path, OBSERVED, image_points=px))
    assert network.images == ("i1", "i2")
    assert network.points == ("p1", "p2")
    np.testing.assert_array_equal(network.image_points.image, [0, 0, 1])
    np.testing.assert_array_equal(network.image_points.point, [0, 1, 0])
    np.testing.assert_array_equal(network.image_points.xy, [row[2:] for row in rows])
    np.testing.assert_allclose(network.image_points.covariance[0], np.diag([0.01, 0.04]), rtol=1e-15)
    assert np.isnan(estimate.position).all() and np.isnan(estimate.points).all()

    mm = "image,point,x_mm,y_mm,sx_mm,sy_mm\n"
    for i, p, *xy in rows:
        x, y = image_from_pixel(np.array(xy), (200, 100), np.array([0.01, 0.02]))
        mm += f"{i},{p},{x!r},{y!r},0.001,0.004\n".replace("np.float64(", "").replace(")", "")
    again, _ = network_of(write(tmp_path, OBSERVED, image_points=mm))
    np.testing.assert_allclose(again.image_points.xy, network.image_points.xy, atol=1e-12)
    np.testing.assert_allclose(again.image_points.covariance, network.image_points.covariance, rtol=1e-12)


def test_observations_without_sigma_have_that_of_the_survey(tmp_path: Path) -> None:
    text = OBSERVED + "[adjust]\nsigma_px = 0.25\n"
    table = "image,point,x_px,y_px\n1,1,10,20\n2,1,11,20\n"
    network, _ = network_of(write(tmp_path, text, image_points=table))
    np.testing.assert_array_equal(network.image_points.covariance, np.tile(np.eye(2) * 0.0625, (2, 1, 1)))


def test_control_scale_bars_and_start_values(tmp_path: Path) -> None:
    text = (
        OBSERVED
        + '[datum]\nkind = "control"\n[control]\nfile = "control.csv"\n'
        + '[approximate]\nimages = "images.csv"\npoints = "points.csv"\n'
        + '[[scale_bar]]\nfrom = "b"\nto = "a"\nlength = 2\nsigma = 0.1\n'
        + '[[scale_bar]]\nfrom = "a"\nto = "lost"\nlength = 2\nsigma = 0.1\n'
    )
    path = write(
        tmp_path,
        text,
        image_points="image,point,x_px,y_px\n1,a,10,20\n2,a,11,20\n1,b,5,5\n2,c,7,7\n",
        control="id,X,Y,Z,sX,sY,sZ\na,1,2,3,0,0.1,0.2\nelsewhere,0,0,0,0,0,0\n",
        images="image,X,Y,Z,omega_deg,phi_deg,kappa_deg\n2,10,20,30,1,-2,179\n",
        points="point,X,Y,Z\nb,4,5,6\na,9,9,9\n",
    )
    network, estimate = network_of(path)
    np.testing.assert_array_equal(network.control.point, [0])
    np.testing.assert_array_equal(network.control.xyz, [[1, 2, 3]])
    np.testing.assert_allclose(network.control.covariance[0], np.diag([0, 0.01, 0.04]))
    assert (network.scale_bars.start[0], network.scale_bars.end[0]) == (1, 0)
    missing = [
        (*one.names("of"), *one.names("names"))
        for survey in [read_survey(path)]
        for one in datum_remarks(survey, network, missing_control(survey, network, ()), has_scale=True)
    ]
    assert missing == [("control", "elsewhere"), ("bars", "a - lost")]
    assert estimate.oriented.tolist() == [False, True]
    np.testing.assert_array_equal(estimate.position[1], [10, 20, 30])
    np.testing.assert_allclose(np.degrees(angles_from_rotation(estimate.rotation[1])), [1, -2, 179])
    np.testing.assert_array_equal(estimate.points[:2], [[1, 2, 3], [4, 5, 6]])
    assert np.isnan(estimate.points[2]).all()


GOOD = "image,point,x_px,y_px\n1,a,10,20\n"


@pytest.mark.parametrize(
    ("table", "match"),
    [
        ("", r"line 1: no column image, needed image,point,x_px,y_px\[,sx_px,sy_px\]"),
        (
            GOOD.replace("x_px", "x"),
            r"line 1: unknown column 'x', needed image,point,x_px,y_px\[,sx_px,sy_px\]$",
        ),
        (
            GOOD.replace(",", ";"),
            r"line 1: unknown column 'image;point;.*; commas must separate the columns$",
        ),
        (GOOD.replace("y_px", "x_px"), r"line 1: column 'x_px' is a duplicate"),
        (GOOD.replace("y_px", "y_px,sx_px").replace("20", "20,1"), r"line 1: no column sy_px"),
        (GOOD + "1,b,nan,3\n", r"line 3: column x_px contains 'nan', a finite number is needed"),
        (GOOD + "1,b,1,1e999\n", r"line 3: column y_px contains '1e999'"),
        (GOOD + "1,b,1,2px\n", r"line 3: column y_px contains '2px'"),
        (GOOD + "1,b,1\n", r"line 3: 3 columns, the header has 4"),
        (GOOD + "1,,1,2\n", r"line 3: column point is empty"),
        ("image,point,x_px,y_px\n", r"no rows below the header"),
        (
            "image,point,x_px,y_px,sx_px,sy_px\n1,a,1,2,0.1,0\n",
            r"column sy_px contains 0, needed more",
        ),
        ('image,point,x_px,y_px\n"1,a,10,20\n', r"line 2|columns"),
        ("image,point,x_px,y_px\n1,a\x00,1,2\n", r"line 2: column point contains 'a\\x00', needed plain"),
    ],
)
def test_bad_tables_are_named_with_their_line(tmp_path: Path, table: str, match: str) -> None:
    path = write(tmp_path, OBSERVED, image_points=table)
    with pytest.raises(SurveyFileError, match=match) as caught:
        read_survey(path)
    assert "image_points.csv" in str(caught.value)


def test_bad_control_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, MINIMAL + '[control]\nfile = "control.csv"\n')
    for table, match in (
        ("id,X,Y,Z\n1,0,0,0\n1,1,1,1\n", "line 3: id '1' is on line 2 already"),
        ("id,X,Y,Z,sX,sY,sZ\n1,0,0,0,0,-1,0\n", r"column sY contains -1, needed 0 \(fixed\) or more"),
        ("id,X,Y\n1,0,0\n", "no column Z"),
    ):
        (tmp_path / "control.csv").write_text(table, encoding="utf-8")
        with pytest.raises(SurveyFileError, match=match):
            read_survey(path)
    (tmp_path / "control.csv").unlink()
    with pytest.raises(SurveyFileError, match=r"control.csv: the table cannot be read: No such file"):
        read_survey(path)
    (tmp_path / "control.csv").write_bytes(b"id,X,Y,Z\n\xff,0,0,0\n")
    with pytest.raises(SurveyFileError, match="UTF-8"):
        read_survey(path)


def test_a_table_with_byte_order_mark_and_crlf_is_read(tmp_path: Path) -> None:
    path = write(tmp_path, MINIMAL + '[control]\nfile = "control.csv"\n')
    (tmp_path / "control.csv").write_bytes("\ufeffid,X,Y,Z\r\n ä 1 ,0,0,1.5\r\n".encode())
    control = read_survey(path).control
    assert control is not None and control.names == ("ä 1",)
    np.testing.assert_array_equal(control.xyz, [[0, 0, 1.5]])


def test_images_belong_to_the_camera_whose_glob_they_match(tmp_path: Path) -> None:
    text = MINIMAL.replace("*.jpg", "a*") + '[[camera]]\nname = "two"\nimages = "*b"\n'
    survey = read_survey_file(write(tmp_path, text))
    assert camera_of_images(survey.cameras, ["ac", "cb"], survey.source) == [0, 1]
    with pytest.raises(SurveyFileError, match=r"'ab' matches the glob of 2 cameras: one 'a\*', two '\*b'"):
        camera_of_images(survey.cameras, ["ab"], survey.source)
    with pytest.raises(SurveyFileError, match="'c' matches the glob of no camera"):
        camera_of_images(survey.cameras, ["c"], survey.source)


def test_names_of_photographs_are_no_globs_however_many(tmp_path: Path) -> None:
    """Names, escaped or plain, are not searched; the limit is of globs with wildcards."""
    names = [f"left/{k} [{k % 7}]?.jpg" for k in range(1500)]
    listed = ", ".join(json.dumps(escape(name)) for name in names)
    text = MINIMAL.replace('"*.jpg"', f"[{listed}]") + '[[camera]]\nname = "two"\nimages = ["b", "c*"]\n'
    survey = read_survey(write(tmp_path, text))
    owners = camera_of_images(survey.cameras, [*names, "b", "cb"], survey.source)
    assert owners == [0] * len(names) + [1, 1]
    with pytest.raises(SurveyFileError, match="matches the glob of no camera"):
        camera_of_images(survey.cameras, ["left/8 1?.jpg"], survey.source)  # no wildcards
    globs = ", ".join(f'"{k}*"' for k in range(1001))
    path = write(tmp_path, MINIMAL.replace('"*.jpg"', f"[{globs}]"))
    with pytest.raises(SurveyFileError, match="1001 globs of photographs with wildcards, at most 1000"):
        read_survey(path)


def test_single_brackets_of_a_camera_are_explained(tmp_path: Path) -> None:
    path = write(tmp_path, MINIMAL.replace("[[camera]]", "[camera]"))
    with pytest.raises(SurveyFileError, match=r"found \[camera\], needed \[\[camera\]\] in double brackets"):
        read_survey_file(path)


def test_every_file_that_a_survey_names_is_among_its_tables(tmp_path: Path) -> None:
    (tmp_path / "codes.csv").write_text("code\n", "utf-8")
    camera = """[[camera]]
name = "{0}"
images = "{0}*.jpg"
c_mm = 8.0
pixel_mm = [0.005, 0.005]
"""
    path = tmp_path / "survey.toml"
    path.write_text(
        '[survey]\nname = "all"\nunit = "m"\n'
        + camera.format("left")
        + camera.format("right")
        + """[targets]
codes = "codes.csv"
diameters = "diameters.csv"
[control]
file = "control.csv"
[exterior]
file = "exterior.csv"
[[rig]]
name = "stereo"
cameras = ["left", "right"]
moment = "moments.csv"
mounts = "mounts.csv"
[[observations]]
file = "by_hand.csv"
[[observations]]
file = "tracker.csv"
[[survey_observations]]
kind = "distance"
file = "tape.csv"
[approximate]
images = "images.csv"
points = "points.csv"
cameras = "cameras.csv"
""",
        "utf-8",
    )
    named = {word.strip('"') for word in path.read_text("utf-8").split() if word.endswith('.csv"')}
    tables = read_survey_file(path).tables()
    assert {table.name for table in tables} == named and len(tables) == len(named)
