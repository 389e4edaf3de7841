"""Marks of other programs, in and out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.cli.other_marks import read_marks_of_others, write_marks_of_others
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.network import empty_estimate
from sfm.products.marking.following import network_of_marks
from sfm.products.marking.project import MarkedProject, project_of_folder
from sfm.survey.inputs.marks_file import Marking
from tests.products.marking.photographs import write_photographs

GCP_LIST = """WGS84 UTM 32N
500000 5400000 100 12.5 20.25 i0.png wall
500000 5400000 100 30.5 40 i1.png wall
500010 5400000 101 100 200 i1.png
500010 5400000 101 1 2 elsewhere.png
"""


@pytest.fixture
def project(tmp_path: Path) -> MarkedProject:
    folder = tmp_path / "photographs"
    folder.mkdir()
    write_photographs(folder, np.random.default_rng(1))
    return project_of_folder(folder)


def read(project: MarkedProject, path: Path) -> Marking:
    return read_marks_of_others(path, project.photographs.names, project.sizes, "m")


def write(project: MarkedProject, marking: Marking, path: Path, before: Path | None = None) -> int:
    network = network_of_marks(project, marking).network
    estimate = empty_estimate(network, project.cameras)
    return write_marks_of_others(path, network, estimate, ground_control=before)


def places(marking: Marking) -> dict[tuple[str, str], tuple[float, float]]:
    return {key: (mark.x, mark.y) for key, mark in marking.marks.items()}


def test_gcp_list_is_read_with_its_control(project: MarkedProject, tmp_path: Path) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(GCP_LIST, encoding="utf-8")
    marking = read(project, path)
    assert places(marking)["i0.png", "wall"] == (12.5, 20.25)
    assert len(marking.marks) == 3
    assert marking.control["wall"].xyz == (500000.0, 5400000.0, 100.0)
    assert {mark.by for mark in marking.marks.values()} == {"hand"}


@pytest.mark.parametrize("ending", ["json", "xml", "db"])
def test_what_is_written_is_read_back(project: MarkedProject, tmp_path: Path, ending: str) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(GCP_LIST, encoding="utf-8")
    marking = read(project, path)
    write(project, marking, tmp_path / f"marks.{ending}")
    back = read(project, tmp_path / f"marks.{ending}")
    names = places(marking) if ending != "db" else {}
    for key, xy in names.items():
        assert places(back)[key] == pytest.approx(xy, abs=1e-9)
    assert np.allclose(sorted(places(back).values())[-1], (30.5, 40.0) if ending == "db" else (100.0, 200.0))


def test_gcp_list_is_written_back_with_what_was_marked_anew(project: MarkedProject, tmp_path: Path) -> None:
    path, back = tmp_path / "gcp_list.txt", tmp_path / "back.txt"
    path.write_text("# flight 3\n" + GCP_LIST, encoding="utf-8")
    marking = read(project, path)
    assert write(project, marking, back, path) == 3
    assert back.read_bytes() == path.read_bytes()
    moved = replace(marking.marks["i0.png", "wall"], x=13.25)
    marking = marking.with_mark(moved).without([("i1.png", "wall")])
    marking = marking.with_mark(replace(moved, photograph="i2.png", x=7.0))
    marking = marking.with_mark(replace(moved, photograph="i0.png", point="gcp 1", x=300.0))
    marking = marking.with_mark(replace(moved, photograph="i0.png", point="bolt", x=9.0))
    again = tmp_path / "again.txt"
    assert write(project, marking, again, path) == 4  # a bolt without coordinates is no ground control
    assert again.read_text("utf-8").splitlines() == [
        "# flight 3",
        "WGS84 UTM 32N",
        "500000 5400000 100 13.2500 20.2500 i0.png wall",
        "500010 5400000 101 100 200 i1.png",
        "500010 5400000 101 1 2 elsewhere.png",
        "500000 5400000 100 7.0000 20.2500 i2.png wall",
        "500010 5400000 101 300.0000 20.2500 i0.png",
    ]
    assert places(read(project, again)) == {
        key: (mark.x, mark.y) for key, mark in marking.marks.items() if key[1] != "bolt"
    }


def test_marks_of_photographs_of_another_size_are_not_taken(project: MarkedProject, tmp_path: Path) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(GCP_LIST.replace("100 200", "9000 200"), encoding="utf-8")
    with pytest.raises(SurveyFileError, match=r"'gcp 1' in i1\.png is at 9000\.0, 200\.0 px, outside"):
        read(project, path)


def test_the_control_of_berlin_is_written_back_identical(tmp_path: Path, shared_data: Path) -> None:
    berlin = shared_data / "texture" / "berlin"
    project = project_of_folder(berlin / "images")
    given = berlin / "ground_control_points.json"
    marking = read(project, given)
    assert len(marking.marks) == 5
    write(project, marking, tmp_path / "back.json", given)
    assert (tmp_path / "back.json").read_bytes() == given.read_bytes()


def test_nothing_is_replaced_and_wrong_files_are_named(project: MarkedProject, tmp_path: Path) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(GCP_LIST, encoding="utf-8")
    marking = read(project, path)
    (tmp_path / "marks.json").write_text("mine", encoding="utf-8")
    with pytest.raises(OutputError, match="exists already"):
        write(project, marking, tmp_path / "marks.json")
    with pytest.raises(OutputError, match=r"not as '\.csv'"):
        write(project, marking, tmp_path / "marks.csv")
    with pytest.raises(OutputError, match="--import names the file"):
        write(project, marking, tmp_path / "marks.txt")
    with pytest.raises(SurveyFileError, match=r"unknown ending '\.doc'"):
        read(project, tmp_path / "marks.doc")
    path.write_text(GCP_LIST.replace("i0", "k0").replace("i1", "k1"), encoding="utf-8")
    with pytest.raises(SurveyFileError, match="of 4 image points none is in these photographs"):
        read(project, path)
