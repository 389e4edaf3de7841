"""Files of other programs and folders from a stranger: endless XML, computed databases, links out."""

from __future__ import annotations

import os
import sqlite3
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from adapters.colmap.adjuster import reason_of
from adapters.colmap.camera_models import read_model, write_model
from adapters.colmap.database import read_database, write_database
from adapters.formats.metashape import read_metashape, write_metashape
from adapters.formats.registry import read_any, read_comparable
from adapters.formats.result_tables import read_result, write_tables
from sfm.files import globs
from sfm.files.csv_tables import read_header, read_table
from sfm.model.errors import KolinearError, SurveyFileError
from sfm.pipeline import run_survey
from sfm.products.batch.run import find_surveys
from sfm.products.inspection.planned_survey import read_plan
from sfm.products.refining.refinement import refine_model
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.survey import read_survey
from sfm.survey.sources.given import measure_given
from tests.findings import findings_of
from tests.products.inspection.benches import one_bench
from tests.synthetic import make_network, seed_of

SECONDS = 8.0
SURVEY = '[survey]\nname = "a"\nunit = "m"\n[[camera]]\nname = "c"\nimages = "{}"\n'


def attributes(count: int) -> str:
    return "<document " + " ".join(f'a{k}=""' for k in range(count)) + "/>"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("<document>" + "\n" * 2_000_000 + "</document>", r"<document> without <chunk>"),
        (
            attributes(1_000_000),
            r"a tag or comment of more than 1000000",
        ),
        (
            attributes(200),
            r"200 attributes of an element, at most 100",
        ),
        (
            "<document><!--" + "x" * 20_000_000 + "--></document>",
            r"a tag or comment of more than 1000000 bytes",
        ),
        ("<document>" + "<a/>" * 100_000 + "</document>", r"takes more than 10000000 bytes of memory"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><document>&b;</document>', r"a document type is not allowed here"),
    ],
    ids=["newlines", "attributes", "some-attributes", "comment", "elements", "entities"],
)
def test_large_xml_is_read_in_time_that_grows_with_it(
    tmp_path: Path, text: str, match: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("adapters.reading.xml_lines.MAX_KEPT_BYTES", 10_000_000)
    (tmp_path / "a.xml").write_text(text, encoding="utf-8")
    begun = time.process_time()
    with pytest.raises(SurveyFileError, match=match):
        read_metashape(tmp_path / "a.xml")
    assert time.process_time() - begun < SECONDS


def test_image_points_of_an_export_take_memory_only_as_numbers(tmp_path: Path) -> None:
    """More of them than its elements could take."""
    network, truth = make_network(seed_of("many"), images=3, points=8, model="opencv")
    write_metashape(tmp_path / "a.xml", network, truth)
    text = (tmp_path / "a.xml").read_text()
    marker = '<marker marker_id="0">'
    found = text.partition(marker)[2].partition("<location ")[2].partition("/>")[0]
    often = f"{marker}<location {found}/></marker>"
    more = f'<frame id="1"><markers>{often * 20_000}</markers></frame></frames>'
    (tmp_path / "a.xml").write_text(text.replace("</frames>", more))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("adapters.reading.xml_lines.MAX_KEPT_BYTES", 1_000_000)
        again, _ = read_metashape(tmp_path / "a.xml")
    assert len(again.image_points) == len(network.image_points)  # those of the first frame
    (tmp_path / "a.xml").write_text(text.replace(marker, often * 20_000 + marker))
    with pytest.raises(SurveyFileError, match="a marker is a duplicate in one camera"):
        read_metashape(tmp_path / "a.xml")


def test_hidden_characters_in_labels_are_refused(tmp_path: Path) -> None:
    text = (
        '<document><chunk><sensors><sensor id="0" label="a&#x202e;b"><resolution width="9" height="9"/>'
        "<calibration><f>9</f></calibration></sensor></sensors><cameras/></chunk></document>"
    )
    (tmp_path / "a.xml").write_text(text, encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"line 1: label is 'a\\u202eb', needed plain text"):
        read_metashape(tmp_path / "a.xml")


@pytest.fixture
def database(tmp_path: Path) -> Path:
    network, truth = make_network(seed_of("hostile"), images=3, points=8, model="opencv")
    path = tmp_path / "given" / "a.db"
    path.parent.mkdir()
    write_database(path, network, truth.cameras)
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA journal_mode = DELETE")
    connection.close()
    return path


def test_a_database_is_only_read(database: Path) -> None:
    before = database.read_bytes()
    network, _ = read_database(database)
    assert len(network.images) == 3 and len(network.points) == 8
    assert database.read_bytes() == before
    assert [path.name for path in database.parent.iterdir()] == ["a.db"]


def test_a_database_that_is_still_written_is_refused(database: Path) -> None:
    database.with_name("a.db-wal").write_bytes(b"changes")
    with pytest.raises(SurveyFileError, match=r"changes to it are still in a\.db-wal; close the program"):
        read_database(database)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (
            "UPDATE cameras SET model = 99",
            r"cameras, camera_id 1: model is 99, needed a whole number from 0 to",
        ),
        ("UPDATE cameras SET params = x'00'", r"camera_id 1: 1 bytes of numbers do not match 1 rows"),
        ("UPDATE cameras SET width = 'wide'", r"camera 1 has photographs of wide x 1500 px"),
        ("UPDATE images SET camera_id = 7", r"images, image_id 1: camera_id is 7, there is no such camera"),
        (
            "UPDATE images SET name = 'a' || char(8238) WHERE image_id = 1",
            r"image_id \d: name is 'a\\u202e', needed plain text",
        ),
        (
            "UPDATE images SET name = x'ff' || image_id WHERE image_id = 1",
            r"image_id 1: name is '\\xff1', needed plain text",
        ),
        (
            "UPDATE keypoints SET rows = 1000000000",
            r"keypoints, image_id 1: 64 bytes of numbers do not match 1000000000",
        ),
        ("UPDATE keypoints SET cols = 3", r"keypoints, image_id 1: cols is 3, needed 2, 4 or 6"),
        ("UPDATE keypoints SET image_id = image_id + 7", r"image_id 8: image_id is 8, there is no such"),
        ("UPDATE keypoints SET rows = 'x'", r"image_id 1: 64 bytes of numbers do not match x rows"),
        ("UPDATE two_view_geometries SET pair_id = 5", r"pair_id 5: pair_id of photographs 0 and 5"),
        ("UPDATE two_view_geometries SET rows = -1", r"two_view_geometries, pair_id \d+: 64 bytes"),
        (
            "UPDATE two_view_geometries SET data = x'" + "00" * 56 + "ff" * 8 + "'",
            r"a match names a keypoint",
        ),
    ],
)
def test_wrong_rows_of_a_database_are_named(database: Path, change: str, match: str) -> None:
    connection = sqlite3.connect(database)
    if "pair_id = 5" in change:
        connection.execute("DELETE FROM two_view_geometries WHERE pair_id <> 2147483649")
    connection.execute(change)
    connection.commit()
    connection.close()
    with pytest.raises(SurveyFileError, match=match) as refused:
        read_database(database)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "computed",
    [
        "CREATE VIEW images AS WITH RECURSIVE n(i) AS (VALUES(1) UNION ALL SELECT i + 1 FROM n) "
        "SELECT i AS image_id, 'a' || i AS name, 1 AS camera_id FROM n",
        "CREATE TABLE images (image_id INTEGER, camera_id INTEGER, name AS (hex(zeroblob(100000000))))",
    ],
)
def test_a_database_that_computes_its_tables_is_refused(database: Path, computed: str) -> None:
    connection = sqlite3.connect(database)
    connection.execute("DROP TABLE images")
    connection.execute(computed)
    connection.commit()
    connection.close()
    begun = time.process_time()
    with pytest.raises(SurveyFileError, match=r"images is computed, needed a table that contains it"):
        read_database(database)
    assert time.process_time() - begun < SECONDS


@pytest.mark.parametrize("pattern", ["sub/**/*.jpg", "**/sub/**/*.jpg", "s*/**/*.jpg", "sub/../**/*.jpg"])
def test_links_out_of_the_folder_are_refused_before_they_are_walked(tmp_path: Path, pattern: str) -> None:
    inner = tmp_path / "survey"
    inner.mkdir()
    (inner / "sub").symlink_to("/")
    (inner / "survey.toml").write_text(SURVEY.format(pattern))
    begun = time.process_time()
    with pytest.raises(SurveyFileError, match=r"'sub' leaves the survey's folder; --allow-outside"):
        find_photographs(read_survey(inner / "survey.toml"))
    assert time.process_time() - begun < 1
    if not pattern.startswith("**"):
        with pytest.raises(SurveyFileError, match=r"sub leads out of .*survey, which is not searched with"):
            find_surveys([f"{inner}/{pattern}" if "*" in pattern[:2] else f"{inner}/[s]ub/**/survey.toml"])


def test_globs_follow_no_links_below_and_find_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "loop").symlink_to(tmp_path)
    for name in ("1.jpg", "a/2.jpg", "a/b/3.jpg", "a/b/.4.jpg"):
        (tmp_path / name).touch()

    def found(pattern: str, **options: bool) -> list[str]:
        return [
            path.relative_to(tmp_path).as_posix() for path in globs.find_files(tmp_path, pattern, **options)
        ]

    assert found("**/*.jpg") == found("**/**/*.jpg") == ["1.jpg", "a/2.jpg", "a/b/.4.jpg", "a/b/3.jpg"]
    assert found("**/*.jpg", hidden=False) == ["1.jpg", "a/2.jpg", "a/b/3.jpg"]
    assert found("a/*/*.jpg") == ["a/b/.4.jpg", "a/b/3.jpg", "a/loop/1.jpg"]
    assert found("a/b/3.jpg") == ["a/b/3.jpg"] and found("a/b/5.jpg") == []
    assert found("a/*", folders=True) == ["a/2.jpg", "a/b", "a/loop"]
    for pattern in ("", ".", "/etc/*", "a**/b"):
        with pytest.raises(ValueError, match="not a relative glob"):
            found(pattern)


def test_globs_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "survey.toml").write_text(SURVEY.format("**/a/**/b/**/*.jpg"))
    for k in range(60):
        (tmp_path / f"{k}.txt").touch()
    monkeypatch.setattr(globs, "MAX_ENTRIES", 50)
    with pytest.raises(SurveyFileError, match=r"more than 50 files and folders to look through for '\*\*/a"):
        find_photographs(read_survey(tmp_path / "survey.toml"))


@pytest.mark.parametrize("name", ["../outside.png", "{}/outside.png", "link.png", "sub/../../outside.png"])
def test_refine_stays_in_its_folder(tmp_path: Path, name: str) -> None:
    network, truth = make_network(seed_of("refine"), images=3, points=12, model="opencv", visibility=1.0)
    width, height = truth.cameras[0].size_px
    (tmp_path / "images" / "sub").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "outside.png"), np.zeros((height, width), np.uint8))
    (tmp_path / "images" / "link.png").symlink_to(tmp_path / "outside.png")
    network = replace(network, images=(name.format(tmp_path), *network.images[1:]))
    with pytest.raises(SurveyFileError, match=r"images: photograph '.*' of the model is outside this folder"):
        refine_model(network, truth, tmp_path / "images")


@pytest.mark.parametrize(
    ("name", "text", "form", "match"),
    [
        ("a.txt", "9000000 2 2\n0 0 1 1\n", "bal", r"number of cameras is '9000000', needed .* to 100000"),
        ("a.txt", "9000 2000000 2\n0 0 1 1\n", "bal", r"these numbers need at least 6081014"),
        ("a.txt", "1 1 1\n" + "1 " * 6_000_000, "bal", r"line 2: more than 10000000 characters"),
        (
            "a.txt",
            "2 10 0 0\n1 0 0 0 0 0 0\n2 0 0 0 0 0 0\n11000000\n",
            "bundle-csharp",
            r"image points, no",
        ),
        (
            "a.txt",
            "2 10 0 0\na\u202eb 0 0 0 0 0 0\n",
            "bundle-csharp",
            r"photograph is 'a\\u202eb'",
        ),
    ],
)
def test_sizes_and_names_in_text_files_are_checked_before_use(
    tmp_path: Path, name: str, text: str, form: str, match: str
) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    begun = time.process_time()
    with pytest.raises(SurveyFileError, match=match):
        read_any(tmp_path / name, form)
    assert time.process_time() - begun < SECONDS


def test_one_row_over_very_many_lines_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text('id,"' + "a\n,\n" * 2_000_000 + '"\n', encoding="utf-8")
    begun = time.process_time()
    for read in (read_header, lambda path: read_table(path, ("id",), ("X",))):
        with pytest.raises(SurveyFileError, match=r"more than 10000 characters, not a CSV table"):
            read(tmp_path / "a.csv")
    assert time.process_time() - begun < 1


def test_what_colmap_says_of_a_file_is_cut_and_plain() -> None:
    """It repeats what the file holds."""
    assert (
        reason_of(RuntimeError("Unknown value: \u202e" + "M" * 10_000))
        == "Unknown value: \\u202e" + "M" * 184 + "..."
    )


def test_names_and_counts_of_a_model_are_checked(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("model"), images=3, points=8, model="opencv")
    write_model(tmp_path / "a", replace(network, images=("a\u202eb.jpg", *network.images[1:])), truth)
    (tmp_path / "a" / "kolinear.json").unlink()
    with pytest.raises(SurveyFileError, match=r"name of image 1 is 'a\\u202eb\.jpg', needed plain text"):
        read_model(tmp_path / "a")
    write_model(tmp_path / "b", network, truth, text=True)
    path = tmp_path / "b" / "cameras.txt"
    path.write_text(f"# Number of cameras: {'9' * 5000}\n" + path.read_text())
    read_model(tmp_path / "b")
    side = tmp_path / "b" / "kolinear.json"
    side.write_text(side.read_text().replace('"1": "', '"1": "\u2066'))
    with pytest.raises(SurveyFileError, match=r"kolinear.json: images.1 is '\\u2066.*, needed plain text"):
        read_model(tmp_path / "b")


def test_a_pipe_is_no_file_of_any_format(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(SurveyFileError, match=r"pipe: not a file"):
        read_any(tmp_path / "pipe")


def write_survey(folder: Path, images: list[str], datum: str = "") -> Path:
    rows = "".join(f"{name},p{j},{100 + 7 * j},{100 + j * j}\n" for name in images for j in range(4))
    (folder / "obs.csv").write_text("image,point,x_px,y_px\n" + rows)
    camera = 'name = "c"\nsize_px = [2000, 1500]\npixel_mm = [0.005, 0.005]\nc_mm = 10.0\n'
    survey = (
        f'[survey]\nname = "a"\nunit = "m"\n[[camera]]\n{camera}[observations]\nfile = "obs.csv"\n{datum}'
    )
    (folder / "survey.toml").write_text(survey)
    return folder / "survey.toml"


def test_very_many_photographs_are_refused(tmp_path: Path) -> None:
    path = write_survey(tmp_path, [f"i{k}" for k in range(20_001)])
    begun = time.process_time()
    with pytest.raises(
        SurveyFileError, match=r"obs\.csv: 20001 photographs, at most 20000 are adjusted together"
    ):
        measure_given(read_survey(path))
    assert time.process_time() - begun < SECONDS


@pytest.mark.parametrize("pixel", ["[0.005, 5e9]", "[5e9, 0.005]", "[2000.0, 2000.0]", "[1e-9, 2e-8]"])
def test_pixels_that_no_sensor_has_are_refused(tmp_path: Path, pixel: str) -> None:
    """The orientation of photographs with such pixels tried all it could, 0.7 s a pair."""
    path = write_survey(tmp_path, ["i1", "i2"])
    path.write_text(path.read_text().replace("[0.005, 0.005]", pixel))
    with pytest.raises(SurveyFileError, match=r"camera c: a pixel of .* mm, expected sides of at most 1000"):
        measure_given(read_survey(path))


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (("control", "bars"), {"control"}),
        (("exterior", "bars"), {"centres"}),
        (("small control", "exterior"), {"control", "centres"}),
    ],
)
def test_lengths_of_different_units_contradict_one_another(
    given: tuple[str, ...], named: set[str], tmp_path: Path
) -> None:
    """Of those that hold the datum; such an adjustment took minutes, or did not converge."""
    network, truth = make_network(seed_of("units"), images=8, points=40)
    seen, xyz, camera = network.image_points, truth.points, truth.cameras[0]
    rows = zip(seen.image, seen.point, seen.xy, strict=True)
    points = "".join(f"{network.images[i]},{network.points[j]},{x},{y}\n" for i, j, (x, y) in rows)
    more = '[datum]\nkind = "control"\n'
    if given[0].endswith("control"):
        scale = 1000 if given[0] == "control" else 1
        given_control = ((network.points[j], *scale * xyz[j], *[scale * 1e-3] * 3) for j in range(8))
        control = "".join(",".join(map(str, row)) + "\n" for row in given_control)
        (tmp_path / "control.csv").write_text("id,X,Y,Z,sX,sY,sZ\n" + control)
        more += '[control]\nfile = "control.csv"\n'
    if "exterior" in given:
        centres = zip(network.images, 1000 * truth.position, strict=True)
        exterior = "".join(f"{name},{','.join(map(str, X))},1,1,1\n" for name, X in centres)
        (tmp_path / "exterior.csv").write_text("image,X,Y,Z,sX,sY,sZ\n" + exterior)
        more += '[exterior]\nfile = "exterior.csv"\n'
    if "bars" in given:
        more += "".join(
            f'[[scale_bar]]\nfrom = "{network.points[j]}"\nto = "{network.points[j + 1]}"\n'
            f"length = {np.linalg.norm(xyz[j] - xyz[j + 1])}\nsigma = 0.001\n"
            for j in range(10, 14)
        )
    path = write_survey(tmp_path, [], more)
    (tmp_path / "obs.csv").write_text("image,point,x_px,y_px\n" + points)
    text = path.read_text().replace("10.0", f"{camera.value('c')}")
    path.write_text(text.replace("[2000, 1500]", str(list(camera.size_px))))
    verdict = findings_of(run_survey(read_survey(path))).verdict
    first = verdict.remarks[0]
    assert verdict.level == "bad" and first.kind == "scale_contradicted"
    assert named == set(first.names("given"))
    assert (first.number("agreeing") == 4) == ("bars" in given)
    assert first.number("unit_factor") == 1000


def test_what_is_refused_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "survey.toml").write_text(SURVEY.format("*.jpg"))
    with pytest.raises(KolinearError) as refused:
        find_photographs(read_survey(tmp_path / "survey.toml"))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["points.csv", "covariance.npz", "colmap"])
def test_a_result_with_a_link_that_leaves_it_is_not_read(name: str, tmp_path: Path) -> None:
    result, other = tmp_path / "result", tmp_path / "other"
    write_tables(result, one_bench())
    (result / name).unlink(missing_ok=True)
    other.mkdir()
    (other / "points.csv").write_text("id,X,Y,Z\n1,0,0,0\n", encoding="utf-8")
    (result / name).symlink_to(other / "points.csv" if "." in name else other)
    for read in (read_result, read_any, read_comparable):
        with pytest.raises(SurveyFileError, match="link that leaves its folder"):
            read(result)
    (result / name).unlink()
    (result / "again.csv").symlink_to(result / "images.csv")  # which stays inside
    if name != "points.csv":
        assert len(read_result(result).points) > 0


def test_a_model_or_plan_with_a_link_that_leaves_it_is_not_read(tmp_path: Path) -> None:
    network, estimate = make_network(seed_of("links"), images=3, points=8, model="opencv")
    write_model(tmp_path / "model", network, estimate)
    (tmp_path / "model" / "cameras.bin").rename(tmp_path / "cameras.bin")
    (tmp_path / "model" / "cameras.bin").symlink_to(tmp_path / "cameras.bin")
    (tmp_path / "plan").mkdir()
    (tmp_path / "plan.json").write_text("{}", encoding="utf-8")
    (tmp_path / "plan" / "plan.json").symlink_to(tmp_path / "plan.json")
    for read, place in ((read_model, "model"), (read_plan, "plan")):
        with pytest.raises(SurveyFileError, match="link that leaves its folder"):
            read(tmp_path / place)
