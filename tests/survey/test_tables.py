"""Tables as untrusted input: size, numbers, names, units; image points given more than once."""

from __future__ import annotations

import os
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapters.formats.photomodeler import read_photomodeler, write_photomodeler
from adapters.formats.result_tables import write_tables
from sfm.files import csv_tables
from sfm.model.errors import SurveyFileError
from sfm.model.network import ImagePoints, Network
from sfm.model.remarks.remark import of_kind
from sfm.model.solution import Solution
from sfm.pipeline import run_survey
from sfm.report.tables.csv_files import write_tables as write_result_tables
from sfm.survey.inputs.given_values import read_control, read_exterior, read_image_points
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.survey import read_survey
from sfm.survey.sources.given import measure_given
from sfm.survey.sources.repeated import merge_repeated
from tests.findings import findings_of
from tests.surveys import survey_of, write_observed_survey, write_photograph_survey
from tests.synthetic import make_network, seed_of
from tests.tables import rows_of

HEADER = "image,point,x_px,y_px\n"


def table(folder: Path, text: str | bytes) -> Path:
    path = folder / "table.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    ("row", "match"),
    [
        ("1,a,1_0,2", r"line 2: column x_px contains '1_0', a finite number"),
        ("1,a,٣,2", r"line 2: column x_px contains '٣', a finite number"),
        ("1,a,-inf,2", r"line 2: column x_px contains '-inf', a finite number"),
        ("1,a,1,Infinity", r"line 2: column y_px contains 'Infinity', a finite number"),
        ("1,a,1e13,2", r"line 2: column x_px contains 1e13, needed a number of at most 1e\+12"),
        ("1,a\x07,1,2", r"line 2: column point contains 'a\\x07'"),
        (f"{'n' * 501},a,1,2", r"line 2: column image contains 'n+.*at most 500 characters"),
        (f"{',' * 10_001}", r"line 2: more than 10000 characters"),
        (f'1,"{"a" * 9000}\n{"b" * 9000}', r"line 3: .*column|line \d: "),
    ],
)
def test_rows_are_refused_with_line_and_column(tmp_path: Path, row: str, match: str) -> None:
    with pytest.raises(SurveyFileError, match=match):
        read_image_points(table(tmp_path, HEADER + row + "\n"))


def test_numbers_are_read_as_programs_write_them(tmp_path: Path) -> None:
    found = read_image_points(table(tmp_path, HEADER + "1,a, +1.5e1 ,-.25\n\n 1 ,b,1E0,2.\n"))
    assert found.xy.tolist() == [[15.0, -0.25], [1.0, 2.0]]
    assert found.image == ("1", "1")
    assert found.table.line.tolist() == [2, 4]


def test_large_tables_are_refused_before_memory_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    huge = tmp_path / "huge.csv"
    with huge.open("wb") as file:
        file.write(HEADER.encode())
        file.truncate(10_000_000_000)  # 10^9 lines; a sparse file takes no room
    one_line = table(tmp_path, HEADER.encode() + b"," * 3_000_000)
    tracemalloc.start()
    with pytest.raises(SurveyFileError, match="at most 2000000000 are read"):
        read_image_points(huge)
    with pytest.raises(SurveyFileError, match="line 2: more than 10000 characters"):
        read_image_points(one_line)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000
    monkeypatch.setattr(csv_tables, "MAX_ROWS", 10)
    rows = "".join(f"1,p{k},1,2\n" for k in range(11))
    with pytest.raises(SurveyFileError, match="line 12: more than 10 rows"):
        read_image_points(table(tmp_path, HEADER + rows))
    with pytest.raises(SurveyFileError, match="more than 20 lines"):
        read_image_points(table(tmp_path, HEADER + "\n" * 30))


def test_tables_that_are_no_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name in ("pipe", "."):
        with pytest.raises(SurveyFileError, match="not a file, a CSV table is needed"):
            read_control(tmp_path / name)
    with pytest.raises(SurveyFileError, match=r"null byte|null character"):
        read_control(tmp_path / "a\0b")
    with pytest.raises(SurveyFileError, match="not a file, a survey file"):
        read_survey(tmp_path / "pipe")


def test_control_in_another_unit_than_its_sigmas_is_refused(tmp_path: Path) -> None:
    text = "id,X,Y,Z,sX,sY,sZ\na,0,0,0,0.01,0.01,0\nb,1000,0,0,0.01,0.0000005,0\n"
    with pytest.raises(SurveyFileError, match=r"line 3: column sY contains 5e-07, needed at least 0.001,"):
        read_control(table(tmp_path, text))
    assert len(read_control(table(tmp_path, text.replace("0.0000005", "0.005"))).names) == 2


def test_scale_bar_in_another_unit_than_its_sigma_is_refused(tmp_path: Path) -> None:
    path = write_observed_survey(tmp_path / "s", "s")
    bar = '[[scale_bar]]\nfrom = "1"\nto = "2"\nlength = 1000.0\nsigma = {}\n'
    text = path.read_text(encoding="utf-8")
    path.write_text(text + bar.format(0.0001), encoding="utf-8")
    with pytest.raises(SurveyFileError, match="scale_bar 1 - 2: length 1000 is more than a million times"):
        read_survey(path)
    path.write_text(text + bar.format(0.01), encoding="utf-8")
    read_survey(path)


def test_unknown_images_of_start_values_are_refused(tmp_path: Path) -> None:
    path = write_observed_survey(tmp_path / "s", "s")
    start = "image,X,Y,Z,omega_deg,phi_deg,kappa_deg\nimage 1,0,0,4,0,0,0\nimage 99,0,0,4,0,0,0\n"
    (path.parent / "start.csv").write_text(start, encoding="utf-8")
    text = path.read_text(encoding="utf-8")
    path.write_text(text + '[approximate]\nimages = "start.csv"\n', encoding="utf-8")
    assert len(read_exterior(path.parent / "start.csv").names) == 2
    with pytest.raises(SurveyFileError, match=r"start\.csv, line 3: image 'image 99' has no observations"):
        measure_given(read_survey(path))


@pytest.mark.parametrize("name", ["../outside.csv", "/etc/hostname", "link.csv", "a/../../outside.csv"])
def test_tables_outside_the_folder_are_refused_unless_allowed(tmp_path: Path, name: str) -> None:
    path = write_observed_survey(tmp_path / "s", "s")
    (path.parent / "image_points.csv").rename(tmp_path / "outside.csv")
    (path.parent / "link.csv").symlink_to(tmp_path / "outside.csv")
    (path.parent / "a").mkdir()
    text = path.read_text(encoding="utf-8").replace('"image_points.csv"', f'"{name}"')
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"leaves the survey's folder; --allow-outside allows"):
        measure_given(read_survey(path))
    if name != "/etc/hostname":
        measured = measure_given(read_survey(path, allow_outside=True))
        assert len(measured.images) == 6


@pytest.mark.parametrize("glob", ["../other/*.png", "link/*.png", "*.PNG"])
def test_photographs_outside_the_folder_are_refused_unless_allowed(tmp_path: Path, glob: str) -> None:
    path = write_photograph_survey(tmp_path / "s", "s", photographs=1)
    other = write_photograph_survey(tmp_path / "other", "other", photographs=2).parent
    (path.parent / "link").symlink_to(other)
    (path.parent / "x.PNG").symlink_to(other / "photo 1.png")
    path.write_text(path.read_text(encoding="utf-8").replace("*.png", glob), encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"leaves the survey's folder; --allow-outside allows"):
        find_photographs(read_survey(path))
    assert len(find_photographs(read_survey(path, allow_outside=True))) in (1, 2)


def _repeated(network: Network, rows: list[int], offsets_px: list[float]) -> Network:
    """The network with some image points again, moved by so much in x."""
    seen = network.image_points
    again = seen.select(np.array(rows))
    moved = again.xy + np.array(offsets_px)[:, None] * (1, 0)
    both = ImagePoints(
        np.concatenate([seen.image, again.image]),
        np.concatenate([seen.point, again.point]),
        np.concatenate([seen.xy, moved]),
        np.concatenate([seen.covariance, again.covariance]),
    )
    return replace(network, image_points=both)


def test_repeated_image_points_do_not_refuse_a_survey() -> None:
    network, truth = make_network(seed_of("repeated"), images=6, points=20)
    result = run_survey(survey_of(_repeated(network, [3, 20, 40], [0.0, 0.15, 5.0]), truth))
    rows, (image, point) = len(network.image_points), (network.image_points.image, network.image_points.point)
    assert len(result.adjustment.rejected) == rows - 1 and result.unused_image_points == 2
    names = [f"{network.points[point[k]]} in {network.images[image[k]]}" for k in (3, 20, 40)]
    (identical,) = of_kind(result.remarks, "rows_identical")
    (averaged,) = of_kind(result.tests, "image_points_averaged")
    (contradicting,) = of_kind(result.remarks, "image_points_contradicting")
    assert names[0] in str(identical.names("rows"))
    assert averaged.names("image_points") == (names[1],)
    assert contradicting.names("image_points") == (names[2],)
    (left,) = result.left_out
    assert (
        left.point == f"{network.points[point[40]]} in {network.images[image[40]]}" and left.image_points == 2
    )


def test_the_mean_of_two_has_the_weight_of_both() -> None:
    network, _ = make_network(seed_of("mean"), images=4, points=10)
    merged = merge_repeated(_repeated(network, [5], [0.2]).image_points)
    seen = network.image_points
    assert merged.averaged == ((int(seen.image[5]), int(seen.point[5])),)
    np.testing.assert_allclose(merged.image_points.xy[5], seen.xy[5] + (0.1, 0))
    np.testing.assert_allclose(merged.image_points.covariance[5], seen.covariance[5] / 2)
    assert len(merged.image_points) == len(seen)


def test_chance_is_no_contradiction() -> None:
    rng = seed_of("chance")
    n, sigma = 4000, 0.3
    twice = ImagePoints(
        np.zeros(2 * n, dtype=np.int64),
        np.tile(np.arange(n), 2),
        sigma * rng.standard_normal((2 * n, 2)),
        np.tile(sigma**2 * np.eye(2), (2 * n, 1, 1)),
    )
    merged = merge_repeated(twice)
    assert len(merged.dropped) <= 12  # 4 expected at 0.1 %
    assert merged.dropped_rows == 2 * len(merged.dropped)


def test_a_photomodeler_export_with_repeated_points_is_read(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("export"), images=4, points=12, model="brown")
    plain = replace(truth, cameras=(truth.cameras[0].with_parameters(_without_affinity(truth.cameras[0])),))
    write_photomodeler(tmp_path / "a.txt", _repeated(network, [2, 7], [0.0, 3.0]), plain)
    read, _ = read_photomodeler(tmp_path / "a.txt")
    assert (
        len(read.image_points) == len(network.image_points) + 1
    )  # the contradicting one stays for judgement


def _without_affinity(camera: object) -> np.ndarray:
    names, p = camera.names, camera.parameters.copy()  # type: ignore[attr-defined]
    for name in ("b1", "b2"):
        p[names.index(name)] = 0.0
    return np.asarray(p)


def test_no_sigma_is_invented_in_the_tables(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("no sigma"), images=5, points=15)
    seen = network.image_points
    unknown = replace(network, image_points=replace(seen, stated=np.zeros(len(seen), dtype=bool)))
    write_tables(tmp_path / "tables", Solution("x", unknown, truth))
    header = (tmp_path / "tables" / "image_points.csv").read_text("utf-8").splitlines()[0]
    assert header == "image,point,x_px,y_px"
    assert read_image_points(tmp_path / "tables" / "image_points.csv").sigma is None
    # and a result of image points without sigmas leaves the cells empty, so that another sigma_px holds
    result = run_survey(survey_of(network, truth, adjust={"sigma_px": 0.25}))
    (tmp_path / "result").mkdir()
    write_result_tables(findings_of(result), tmp_path / "result")
    assert all(
        row["sx_px"] == row["sy_px"] == "" for row in rows_of(tmp_path / "result" / "image_points.csv")
    )
    again = replace(survey_of(network, truth), observations=read_image_points(file_of(tmp_path)))
    assert run_survey(again).adjustment.stated_px == pytest.approx(0.1)


def file_of(folder: Path) -> Path:
    return folder / "result" / "image_points.csv"


def test_stated_sigmas_come_back(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("sigma"), images=5, points=15, noise_px=0.2)
    result = run_survey(survey_of(network, truth, sigma=True))
    write_result_tables(findings_of(result), tmp_path)
    found = read_image_points(tmp_path / "image_points.csv")
    assert found.sigma is not None
    np.testing.assert_allclose(found.sigma, 0.2)


def test_repeated_image_points_are_looked_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    network, _ = make_network(seed_of("many repeated"), images=3, points=200)
    seen = _repeated(network, list(range(500)), [0.0] * 500).image_points
    looked = 0

    def counted(values: np.ndarray, real: Any = np.flatnonzero) -> np.ndarray:
        nonlocal looked
        looked += len(values)
        return real(values)

    monkeypatch.setattr(np, "flatnonzero", counted)
    assert len(merge_repeated(seen).same) == 500
    assert looked <= len(seen)  # not once for each of them
