"""Tables as untrusted input: bounded size, strict numbers, names, units, unknown images."""

from __future__ import annotations

import os
import tracemalloc
from pathlib import Path

import pytest

from sfm.errors import SurveyFileError
from sfm.files import csv_tables
from sfm.survey.inputs.given import read_control, read_exterior, read_image_points
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.start import measurements_from_observations
from sfm.survey.inputs.survey import read_survey
from tests.surveys import write_observed_survey, write_photograph_survey

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
    with pytest.raises(SurveyFileError, match=r"line 3: column sY contains 5e-07, needed at least a"):
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
        measurements_from_observations(read_survey(path))


@pytest.mark.parametrize("name", ["../outside.csv", "/etc/hostname", "link.csv", "a/../../outside.csv"])
def test_tables_outside_the_folder_are_refused_unless_allowed(tmp_path: Path, name: str) -> None:
    path = write_observed_survey(tmp_path / "s", "s")
    (path.parent / "image_points.csv").rename(tmp_path / "outside.csv")
    (path.parent / "link.csv").symlink_to(tmp_path / "outside.csv")
    (path.parent / "a").mkdir()
    text = path.read_text(encoding="utf-8").replace('"image_points.csv"', f'"{name}"')
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"leaves the survey's folder; --allow-outside allows"):
        measurements_from_observations(read_survey(path))
    if name != "/etc/hostname":
        measured = measurements_from_observations(read_survey(path, allow_outside=True))
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
