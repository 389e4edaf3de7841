"""Tables of a result and files of COLMAP as untrusted input, and writing onto a full disk."""

from __future__ import annotations

import json
import resource
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapters.colmap.database import write_database
from adapters.formats.registry import FORMATS, read_any, write_any
from adapters.formats.result_tables import read_result, write_tables
from adapters.reading import text_lines as lines
from adapters.reading.text_lines import Lines
from adapters.reading.xml_lines import read_xml
from sfm.comparison.camera_conversion import convert_cameras
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.solution import Solution
from tests.adapters.formats.clouds import LIBRARIES, library
from tests.rigs import make_rig
from tests.synthetic import make_network, seed_of

HUGE_BYTES = 10_000_000_000


@pytest.fixture(scope="module")
def made() -> tuple[Network, Estimate]:
    network, truth = make_network(seed_of("tables"), images=4, points=6, model="opencv")
    return replace(network, images=tuple(f"p{i}.jpg" for i in range(4))), truth


@pytest.fixture
def folder(made: tuple[Network, Estimate], tmp_path: Path) -> Path:
    network, truth = made
    sigma = np.tile(np.eye(3) * 1e-6, (6, 1, 1))
    write_tables(tmp_path / "t", Solution("t", network, truth, sigma, sigma[:4], None, 7, "mm"))
    return tmp_path / "t"


def with_camera(**changed: Any) -> str:
    """A summary whose camera has something else in it; None takes a key away."""
    camera = {"name": "camera 1", "model": "opencv", "size_px": [2000, 1500], "pixel_mm": [0.005, 0.005]}
    camera = {key: value for key, value in (camera | changed).items() if value is not None}
    return json.dumps({"cameras": [camera]})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"cameras": [1]}', r"cameras\[0\] is 1, needed an object"),
        ("[" * 100_000, "line 1: not the summary of a result .*recursion"),
        ("[1]", r"the content is \[1\], needed an object"),
        ("{}", "cameras is missing, which the summary of a result needs"),
        ('{"cameras": []}', "camera 'camera 1' is not in summary.json"),
        (with_camera(size_px="x"), r"cameras\[0\]\.size_px is 'x', needed a valid (tuple|array)"),
        (with_camera(size_px=[float("inf"), 5]), r"cameras\[0\]\.size_px\[0\] is inf"),
        (with_camera(size_px=[-5, 0]), r"size_px\[0\] is -5, needed greater than or equal to 1"),
        (with_camera(size_px=[10**30, 5]), r"size_px\[0\] is 10+\.*, needed less than or equal to 1000000"),
        (with_camera(size_px=[2000, "1500"]), r"size_px\[1\] is '1500', needed a valid integer"),
        (with_camera(pixel_mm=[0, 0.005]), r"pixel_mm\[0\] is 0, needed greater than 0"),
        (with_camera(pixel_mm=[float("nan"), 1.0]), r"pixel_mm\[0\] is nan, needed a finite number"),
        (with_camera(pixel_mm=[0.005] * 3), r"pixel_mm.* is .*at most 2 items"),
        (with_camera(model=["opencv"]), r"cameras\[0\]\.model is \['opencv'\], needed 'brown'"),
        (with_camera(model="panorama"), r"cameras\[0\]\.model is 'panorama', needed 'brown'"),
        (with_camera(name=["a"]), r"cameras\[0\]\.name is \['a'\], needed a valid string"),
        (with_camera(name=None), r"cameras\[0\]\.name is missing"),
        (with_camera(size_px=None), "states size and pixel of camera camera 1"),
        ('{"redundancy": -3, ' + with_camera()[1:], "redundancy is -3, needed greater than or equal to 0"),
        ('{"redundancy": "abc", ' + with_camera()[1:], "redundancy is 'abc', needed a valid integer"),
        (with_camera()[:-2] + ", " + with_camera()[13:], "camera 'camera 1' is a duplicate"),
    ],
)
def test_bad_summaries_are_refused(folder: Path, text: str, message: str) -> None:
    good = read_result(folder)
    assert (good.redundancy, good.unit) == (7, "mm")
    (folder / "summary.json").write_text(text)
    with pytest.raises(SurveyFileError, match=message) as refused:
        read_result(folder)
    assert "\n" not in str(refused.value) and str(folder) in str(refused.value)


def test_a_folder_without_a_result_is_named(tmp_path: Path) -> None:
    with pytest.raises(SurveyFileError) as refused:
        read_result(tmp_path)
    assert str(refused.value) == f"{tmp_path}: not the folder of a result, summary.json is missing"


@pytest.mark.parametrize(
    ("name", "column", "value", "message"),
    [
        (
            "points.csv",
            "X",
            "1e300",
            "points.csv, line 2: column X contains 1e300, needed a number of",
        ),
        ("points.csv", "X", "nan", "points.csv, line 2: column X contains 'nan', a finite number"),
        ("points.csv", "sX", "-0.1", "points.csv, line 2: column sX contains -0.1, needed 0 or more"),
        ("points.csv", "id", "2", "points.csv, line 3: id '2' is on line 2 already"),
        ("images.csv", "sZ", "-1", "images.csv, line 2: column sZ contains -1, needed 0 or more"),
        ("images.csv", "image", "p1.jpg", "images.csv, line 3: image 'p1.jpg' is on line 2 already"),
        ("images.csv", "camera", "x", "images.csv, line 2: camera 'x' is not in cameras.csv"),
        ("cameras.csv", "value", "0", "cameras.csv, line 2: column value contains 0, needed a positive c"),
        ("cameras.csv", "value", "-9", "cameras.csv, line 2: column value contains -9, needed a positive c"),
        ("cameras.csv", "sigma", "-1", "cameras.csv, line 2: column sigma contains -1"),
        ("cameras.csv", "camera", "y", "cameras.csv, line 2: camera 'y' is not in summary.json"),
        ("cameras.csv", "parameter", "fy", "line 3: camera 'camera 1', parameter 'fy' is on line 2"),
        (
            "image_points.csv",
            "sx_px",
            "0",
            "image_points.csv, line 2: column sx_px contains 0, needed more than",
        ),
        ("image_points.csv", "x_px", "1e13", "image_points.csv, line 2: column x_px contains 1e13"),
        ("image_points.csv", "point", "77", "image_points.csv, line 2: point '77' is not in points.csv"),
    ],
)
def test_nonsense_in_tables_names_its_line(
    folder: Path, name: str, column: str, value: str, message: str
) -> None:
    rows = [line.split(",") for line in (folder / name).read_text().splitlines()]
    rows[1][rows[0].index(column)] = value
    (folder / name).write_text("\n".join(",".join(row) for row in rows) + "\n")
    with pytest.raises(SurveyFileError, match=message):
        read_result(folder)


def test_an_image_point_twice_is_refused(folder: Path) -> None:
    path = folder / "image_points.csv"
    text = path.read_text()
    path.write_text(text + text.splitlines()[1] + "\n")
    with pytest.raises(SurveyFileError, match=r"image 'p0\.jpg', point '\d' is on line 2 already"):
        read_result(folder)


def test_sigmas_that_nobody_knows_are_none(made: tuple[Network, Estimate], tmp_path: Path) -> None:
    network, truth = made
    write_tables(tmp_path, Solution("t", network, truth))
    assert (tmp_path / "points.csv").read_text().splitlines()[0] == "id,X,Y,Z"
    found = read_result(tmp_path)
    assert found.point_covariance is None and found.position_covariance is None
    for name, more in (("points.csv", 3), ("images.csv", 3)):  # columns of nothing, as older tables have
        head, *rows = (tmp_path / name).read_text().splitlines()
        text = "\n".join([head + ",sX,sY,sZ", *(row + "," * more for row in rows)])
        (tmp_path / name).write_text(text + "\n")
    found = read_result(tmp_path)
    assert found.point_covariance is None and found.position_covariance is None


def test_files_are_bounded_before_memory_is_taken(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("points.csv", "summary.json", "x.txt", "x.xml"):
        with (folder / name).open("ab") as file:
            file.truncate(HUGE_BYTES)  # sparse, takes no room
    for read in (
        lambda: Lines.of(folder / "x.txt"),
        lambda: read_xml(folder / "x.xml"),
        lambda: read_result(folder),
    ):
        with pytest.raises(SurveyFileError, match=f"{HUGE_BYTES} bytes, at most"):
            read()
    monkeypatch.setattr(lines, "MAX_LINES", 10)
    (tmp_path / "many.txt").write_text("\n" * 11)
    with pytest.raises(SurveyFileError, match="more than 10 lines"):
        Lines.of(tmp_path / "many.txt").end()
    (tmp_path / "bal.txt").write_text("9" * 15 + " 1 1\n")
    with pytest.raises(SurveyFileError, match=r"bal\.txt, line 1: the number of cameras is '9+'"):
        read_any(tmp_path / "bal.txt", "bal")


@contextmanager
def full_disk(limit_bytes: int) -> Iterator[None]:
    """No file may grow beyond a size, as with `ulimit -f`."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


MODEL_OF = {"bundler": "radial", "nvm": "brown"}
MODEL_OF |= dict.fromkeys(("openmvg", "micmac", "aicon", "realitycapture"), "brown_forward")


@pytest.mark.parametrize("name", [form.name for form in FORMATS if form.writable])
def test_a_full_disk_leaves_nothing_and_says_why(name: str, tmp_path: Path) -> None:
    library(name)
    model = "brown" if name in ("photomodeler", "bundle-csharp", "bundle-matlab") else "opencv"
    network, truth = make_network(seed_of("full"), images=6, points=300, model=model, visibility=1.0)
    camera = truth.cameras[0]
    plain = camera.with_parameters(np.where(np.arange(len(camera.names)) < 4, camera.parameters, 0.0))
    if model == "brown":
        plain = camera.with_parameters(np.where(np.arange(len(camera.names)) < 3, camera.parameters, 0.0))
    else:
        plain = plain.with_parameters(plain.parameters[[1, 1, 2, 3, 4, 5, 6, 7]])
    network = replace(network, images=tuple(f"p{i}.jpg" for i in range(6)))
    estimate = replace(truth, cameras=(plain,))
    if name == "rig":
        network, estimate = make_rig(seed_of("full"), moments=3, points=12)
        estimate = convert_cameras(estimate, ("opencv",))[0]
    if name == "micmac":  # it has the coordinates of control only
        network = network.with_control(network.points, truth.points)
    if name in ("bundler", "nvm", "openmvg", "micmac", "aicon", "realitycapture"):
        estimate = convert_cameras(estimate, (MODEL_OF[name],))[0]
    with (
        full_disk(256 if name in ("rig", "nerfstudio", "realitycapture", *LIBRARIES) else 8192),
        pytest.raises(OutputError, match=r"out.*: .*cannot be written: File too large$"),
    ):
        write_any(tmp_path / "out", name, network, estimate)
    assert not list(tmp_path.iterdir())
    write_any(tmp_path / "out", name, network, estimate)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "cameras.txt",
            " 2000 1500 ",
            f" {'9' * 20} 1500 ",
            r"line \d+: WIDTH is '9+', needed a whole number",
        ),
        ("cameras.txt", " 2000 1500 ", " 2000 0 ", r"line \d+: HEIGHT is '0', needed a whole number from 1"),
        ("cameras.txt", " 2000 1500 ", " 2000 1500 -", r"line \d+: focal length -.*must be positive"),
        ("points3D.txt", "\n1 ", "\n-1 ", r"line \d+: POINT3D_ID is '-1'"),
        ("images.txt", "\n1 ", "\n1 1e300 ", r"line \d+: '1e300.*, needed a number of at most 1e\+12"),
        ("frames.txt", "\n1 1 ", "\n1 x ", r"line \d+: an ID is 'x'"),
        ("rigs.txt", "\n1 1 ", "\n1 2 ", r"line \d+: 4 words for 2 sensors"),
        ("images.txt", " 1 p0.jpg", " 5 p0.jpg", "do not fit together"),
        ("points3D.txt", "\n2 ", "\n1 ", r"points3D\.txt: 2 points3D have the ID 1"),
        ("images.txt", " p1.jpg", " p0.jpg", "more than one photograph has the name 'p0.jpg'"),
    ],
)
def test_colmaps_own_words_stay_inside(
    made: tuple[Network, Estimate], tmp_path: Path, name: str, old: str, new: str, message: str
) -> None:
    write_any(tmp_path / "m", "colmap-text", *made)
    path = tmp_path / "m" / name
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(SurveyFileError, match=message) as refused:
        read_any(tmp_path / "m")
    assert ".cc:" not in str(refused.value) and "Check failed" not in str(refused.value)


def test_names_with_blanks_are_read_in_full_from_colmaps_text(
    made: tuple[Network, Estimate], tmp_path: Path
) -> None:
    names = tuple(f"a {i}  ü.jpg" for i in range(len(made[0].images)))
    write_any(tmp_path / "m", "colmap-text", replace(made[0], images=names), made[1])
    (tmp_path / "m" / "kolinear.json").unlink()  # COLMAP's own models have none
    assert read_any(tmp_path / "m")[0].images == names


def test_parts_of_a_colmap_model_that_are_missing_are_named(
    made: tuple[Network, Estimate], tmp_path: Path
) -> None:
    write_any(tmp_path / "m", "colmap", *made)
    frames = (tmp_path / "m" / "frames.bin").read_bytes()
    (tmp_path / "m" / "frames.bin").unlink()
    with pytest.raises(SurveyFileError, match=r"frames\.bin: this file of the COLMAP model is missing"):
        read_any(tmp_path / "m")
    (tmp_path / "m" / "frames.bin").write_bytes(frames)
    (tmp_path / "m" / "points3D.bin").write_bytes(bytes(8))  # none
    with pytest.raises(SurveyFileError, match="image 1 has a key point of point 1, which is not"):
        read_any(tmp_path / "m")


def test_impossible_binary_cameras_are_refused(made: tuple[Network, Estimate], tmp_path: Path) -> None:
    write_any(tmp_path / "m", "colmap", *made)
    path = tmp_path / "m" / "cameras.bin"
    data = bytearray(path.read_bytes())
    data[16:24] = (0).to_bytes(8, "little")  # width
    path.write_bytes(data)
    with pytest.raises(SurveyFileError, match=r"cameras\.bin, byte \d+: photographs of 0 x 1500 px"):
        read_any(tmp_path / "m")


def test_damaged_databases_say_what_is_wrong(made: tuple[Network, Estimate], tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    write_database(path, made[0], made[1].cameras)
    shutil.copy(path, tmp_path / "b.db")
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(SurveyFileError, match=r"a\.db: the file is cut off, it has 5000 of the \d+ bytes"):
        read_any(path)
    database = sqlite3.connect(tmp_path / "b.db")
    database.execute("UPDATE cameras SET width = 0")
    database.commit()
    database.close()
    with pytest.raises(SurveyFileError, match=r"b\.db: camera 1 has photographs of 0 x 1500 px"):
        read_any(tmp_path / "b.db")
    sqlite3.connect(tmp_path / "c.db").execute("CREATE TABLE x (y)").connection.close()
    with pytest.raises(SurveyFileError, match=r"c\.db: an SQLite file without the table cameras"):
        read_any(tmp_path / "c.db")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("pixel_mm", [-0.005, 0.005], r"cameras\[0\]\.pixel_mm\[0\] is -0\.005, needed greater than 0"),
        ("name", 5, r"cameras\[0\]\.name is 5, needed a valid string"),
    ],
)
def test_names_beside_a_model_say_what_is_wrong(
    made: tuple[Network, Estimate], tmp_path: Path, key: str, value: object, message: str
) -> None:
    write_any(tmp_path / "m", "colmap", *made)
    path = tmp_path / "m" / "kolinear.json"
    side = json.loads(path.read_text())
    side["cameras"][0][key] = value
    path.write_text(json.dumps(side))
    with pytest.raises(SurveyFileError, match=r"kolinear\.json: " + message):
        read_any(tmp_path / "m")


def test_the_name_of_a_format_is_honoured(made: tuple[Network, Estimate], tmp_path: Path) -> None:
    write_any(tmp_path / "m", "colmap", *made)
    with pytest.raises(SurveyFileError, match=r"no COLMAP model of text files \(cameras\.txt\)"):
        read_any(tmp_path / "m", "colmap-text")
    network, truth = made
    moved = replace(truth, points=truth.points + 1.0)
    write_any(tmp_path / "text", "colmap-text", network, moved)
    for path in (tmp_path / "text").iterdir():
        shutil.copy(path, tmp_path / "m")
    np.testing.assert_array_equal(read_any(tmp_path / "m", "colmap-text")[1].points, moved.points)
    np.testing.assert_array_equal(read_any(tmp_path / "m", "colmap")[1].points, truth.points)
