"""Which photograph of a survey a text means, and what is given for photographs that are not in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.errors import SurveyFileError
from sfm.model.remarks.remark import of_kind
from sfm.pipeline import run_survey
from sfm.survey.inputs.given_values import KnownPoints, Observations, StartOrientations
from sfm.survey.inputs.measurements import find_photographs
from sfm.survey.inputs.photograph_names import NamedPhotographs, name_photographs
from sfm.survey.inputs.settings import PointSettings
from sfm.survey.inputs.survey import CameraSetup, Survey, read_survey
from tests.survey.test_ground_control import lines_of, survey_with
from tests.survey.test_sources import CORNERS, write, write_given

FILES = ("one/a.png", "one/b.png", "two/b.png", "two/C.png", "two/c.png", "D.png")


def survey_of(folder: Path, texts: list[str]) -> Survey:
    """Return a survey of empty files with an image point in each photograph that a text means."""
    for name in FILES:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()
    return Survey(
        name="names",
        cameras=(CameraSetup(name="c", images=["*.png", "*/*.png"]),),
        observations=(Observations.from_arrays(texts, ["p"] * len(texts), np.zeros((len(texts), 2))),),
        folder=folder,
    )


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("one/a.png", "one/a.png"),
        ("a.png", "one/a.png"),
        ("./D.png", "D.png"),
        ("two/../one/./a.png", "one/a.png"),
        ("one\\b.png", "one/b.png"),
        ("{folder}/two/b.png", "two/b.png"),
        ("d.PNG", "D.png"),
        ("A.png", "one/a.png"),
        ("c.png", "two/c.png"),
        ("b.png", None),  # two photographs have this name
        ("TWO/C.PNG", None),  # two photographs differ from it in case alone
        ("../first/a.png", None),  # of an earlier epoch
        ("e.png", None),
    ],
)
def test_a_text_means_one_photograph(tmp_path: Path, text: str, name: str | None) -> None:
    text = text.format(folder=tmp_path)
    survey = survey_of(tmp_path, ["D.png", text])
    named = name_photographs(survey, find_photographs(survey))
    (table,) = named.survey.observations  # type: ignore[misc]
    assert table.image == ("D.png", name or text)[: len(table)]
    assert bool(named.remarks) == (name is None)


def test_a_photograph_without_a_file_that_does_not_fit_is_missed_for_that(tmp_path: Path) -> None:
    """Its image points are all that was handed over; what is wrong with them is the reason."""
    rng = np.random.default_rng(1)
    places = {f"more {k}": (20.0 * k, -75.0, 0.0) for k in range(5)}
    path = write(tmp_path, '[[observations]]\nfile = "corners.csv"\nsigma_px = 0.2\n')
    table = tmp_path / "corners.csv"
    write_given(table, {**CORNERS, **places})
    head, *rows = [row.split(",") for row in table.read_text("utf-8").splitlines()]
    for i in (4, 5, 6):
        (tmp_path / f"photo {i}.png").unlink()
        of_photograph = [k for k, row in enumerate(rows) if row[0] == f"photo {i}.png"]
        exchanged = [rows[k][2:] for k in rng.permutation(of_photograph)]
        for k, xy in zip(of_photograph, exchanged, strict=True):
            rows[k] = [*rows[k][:2], *xy]
    table.write_text("\n".join(",".join(row) for row in (head, *rows)) + "\n", "utf-8")
    result = run_survey(read_survey(path))
    (failed,) = result.failed
    assert failed.reason.kind != "photographs_without_file" and failed.is_counted
    assert result.images_total == 6 and of_kind(result.verdict.remarks, "photographs_missing")


def test_a_mark_and_a_start_value_name_photographs_too(tmp_path: Path) -> None:
    survey = survey_of(tmp_path, ["a.png"])
    mark = PointSettings(name="p", image="./D.png", x_px=1.0, y_px=2.0)
    start = StartOrientations.from_arrays(["a.png"], np.zeros((1, 3)), np.zeros((1, 3)))
    survey = replace(survey, marks=(mark,), start_orientations=start)
    named = name_photographs(survey, find_photographs(survey)).survey
    assert [one.image for one in named.marks] == ["D.png"]
    assert named.start_orientations is not None and named.start_orientations.names == ("one/a.png",)
    twice = StartOrientations.from_arrays(["a.png", "one/a.png"], np.zeros((2, 3)), np.zeros((2, 3)))
    survey = replace(survey, start_orientations=twice)
    with pytest.raises(SurveyFileError, match=r"row 2: image 'one/a.png' is on row 1 already"):
        name_photographs(survey, find_photographs(survey))


def test_moments_of_a_rig_name_photographs_too(tmp_path: Path) -> None:
    survey = replace(survey_of(tmp_path, ["a.png"]), moments={"a.png": "1", "./D.png": "1", "two/b.png": "2"})
    named = name_photographs(survey, find_photographs(survey)).survey
    assert named.moments == {"one/a.png": "1", "D.png": "1", "two/b.png": "2"}
    survey = replace(survey, moments={"a.png": "1", "one/a.png": "2"})
    with pytest.raises(SurveyFileError, match=r"'one/a.png' has the moments '1' and '2', needed one"):
        name_photographs(survey, find_photographs(survey))


@pytest.mark.parametrize(
    ("image", "x", "message"),
    [
        ("first.tif", 3.0, "neither a photograph of the survey nor a file of an earlier epoch"),
        ("first.bmp", 8.0, r"point 'p' is at 8, 2 px, outside first.bmp of 8 x 6 px"),
        ("first.bmp", 7.0, None),
        ("../first.bmp", 7.0, "leaves the survey's folder"),
    ],
)
def test_the_place_of_an_earlier_epoch_is_checked_before_measuring(
    tmp_path: Path, image: str, x: float, message: str | None
) -> None:
    survey = replace(survey_of(tmp_path, ["a.png"]), allow_outside=False)
    cv2.imwrite(str(tmp_path / "first.bmp"), np.zeros((6, 8), np.uint8))
    survey = replace(survey, marks=(PointSettings(name="p", image=image, x_px=x, y_px=2.0),))
    files = find_photographs(survey)
    if message is None:
        assert name_photographs(survey, files).survey.marks == survey.marks
        return
    with pytest.raises(SurveyFileError, match=message):
        name_photographs(survey, files)


def test_ground_control_of_a_whole_flight_serves_a_part_of_it(tmp_path: Path) -> None:
    """Six photographs of many; a point is marked only in others, which would match the glob or not."""
    lines = lines_of()
    others = [line.replace("photo_", "IMG_") for line in lines if line.endswith(("top", "east"))]
    others += [line.replace("photo_", "photo_9") for line in lines if line.endswith(("west", "north"))]
    far = [line.replace("photo_", "IMG_").replace(" 58", " 57") for line in lines if line.endswith("flat")]
    far = [line.replace("flat", "far") for line in far]
    results = []
    for name, more in (("part", []), ("flight", [*others, *far])):
        text = "\n".join(["WGS84 UTM 33N", *lines, *more])
        path = survey_with(tmp_path / name / "same", "gcp_list.txt", text, '[datum]\nkind = "control"\n')
        results.append(run_survey(read_survey(path)))
    part, flight = results
    assert (flight.adjustment.estimate.points == part.adjustment.estimate.points).all()
    assert flight.verdict.level == part.verdict.level == "good"
    (said,) = flight.verdict.remarks
    assert said.kind == "photographs_without_file" and len(said.subjects["photographs"]) == 12
    assert "; far is marked in no other" in said.text
    assert flight.images_total == 6 and flight.failed == ()


def test_control_that_is_marked_nowhere_here_is_left_out_unless_it_is_measured(tmp_path: Path) -> None:
    xyz, check = np.eye(3), np.array([[True] * 3, [False] * 3, [False] * 3])
    control = replace(KnownPoints.from_arrays(["a", "b", "c"], xyz), check=check)
    survey = replace(survey_of(tmp_path, ["a.png"]), control=control)
    for unmarked, measured, kept in (
        ("", "", "abc"),
        ("b", "ac", "ac"),
        ("ab", "b", "bc"),
        ("abc", "", "abc"),  # nothing would be left
        ("bc", "a", "abc"),  # a check point alone
    ):
        named = NamedPhotographs(survey, frozenset(unmarked))
        left = named.without_unmarked(survey, tuple(measured)).control
        assert left is not None and left.names == tuple(kept)
        assert left.check is not None and left.check.any(axis=1).tolist() == [name == "a" for name in kept]


def test_ground_control_of_other_photographs_is_refused_before_measuring(tmp_path: Path) -> None:
    text = "\n".join(["WGS84 UTM 33N", *(line.replace("photo_", "IMG_") for line in lines_of())])
    path = survey_with(tmp_path / "other", "gcp_list.txt", text)
    survey = read_survey(path)
    with pytest.raises(SurveyFileError, match=r"none of its photographs \(IMG_1.png and 5 more\) is among"):
        name_photographs(survey, find_photographs(survey))


def test_a_table_brings_photographs_that_its_image_points_orient(tmp_path: Path) -> None:
    """Of three photographs without a file one is oriented, one shows a point, and one has no camera."""
    write_given(tmp_path / "corners.csv", CORNERS | {f"more {k}": (20.0 * k, -75.0, 0.0) for k in range(5)})
    path = write(tmp_path, '[[observations]]\nfile = "corners.csv"\nsigma_px = 0.2\n')
    table = tmp_path / "corners.csv"
    rows = table.read_text("utf-8").splitlines()
    more = [row.replace("photo 1", "photo 8") for row in rows if row.startswith("photo 1.png,corner a,")]
    more += [row.replace("photo 1.png", "other.jpg") for row in rows if row.startswith("photo 1.png")]
    (tmp_path / "photo 6.png").unlink()
    table.write_text("\n".join([*rows, *more]) + "\n", "utf-8")
    result = run_survey(read_survey(path))
    assert result.verdict.level == "good"
    assert "photo 6.png" in result.network.images and result.images_total == 6
    assert [one.image for one in result.failed] == ["photo 8.png"]
    (said,) = of_kind(result.verdict.remarks, "photographs_without_file")
    assert len(said.subjects["photographs"]) == 3
    assert not of_kind(result.verdict.remarks, "photographs_missing")
