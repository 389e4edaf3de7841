"""Marks of other programs, in and out."""

from __future__ import annotations

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


def write(project: MarkedProject, marking: Marking, path: Path, before: Path | None = None) -> None:
    network = network_of_marks(project, marking).network
    write_marks_of_others(path, network, empty_estimate(network, project.cameras), ground_control=before)


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
    with pytest.raises(OutputError, match=r"not as '\.txt'"):
        write(project, marking, tmp_path / "marks.txt")
    with pytest.raises(SurveyFileError, match=r"unknown ending '\.doc'"):
        read(project, tmp_path / "marks.doc")
    path.write_text(GCP_LIST.replace("i0", "k0").replace("i1", "k1"), encoding="utf-8")
    with pytest.raises(SurveyFileError, match="of 4 image points none is in these photographs"):
        read(project, path)
