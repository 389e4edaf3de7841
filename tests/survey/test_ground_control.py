"""Ground control with its image points, as other programs write it."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.library.surveys import write_result
from sfm.model.camera import project
from sfm.model.errors import SurveyFileError
from sfm.model.remarks.remark import of_kind
from sfm.photographs.exif import LocalSystem
from sfm.pipeline import run_survey
from sfm.survey.inputs.survey import read_survey
from tests.surveys import SIZE_PX, camera, code_centres, stations, write_photograph_survey
from tests.synthetic import seed_of

ORIGIN = np.array([391_000.0, 5_820_000.0, 30.0])  # UTM, m
PLACES = {
    "north": (-150.0, 60.0, 0.0),
    "south": (140.0, -60.0, 0.0),
    "east": (150.0, 60.0, 0.0),
    "west": (-140.0, -70.0, 0.0),
    "top": (0.0, 0.0, 60.0),
    "flat": (0.0, 85.0, 0.0),
    "checked": (0.0, -85.0, 0.0),
}  # mm


def lines_of(names: tuple[str, ...] = tuple(PLACES)) -> list[str]:
    """Return the lines of image points, with a noise of 0.2 px; the height of one point is unknown."""
    position, rotation = stations(6)
    noise = seed_of("ground control")
    lines = []
    for name in names:
        X, Y, Z = (ORIGIN + np.array(PLACES[name]) / 1000).tolist()
        for i in range(6):
            exact = project(camera(), position[i], rotation[i], np.array([PLACES[name]]))[0]
            x, y = (exact + 0.2 * noise.standard_normal(2)).tolist()
            height = "NaN" if name == "flat" else Z
            lines.append(f"{X:.6f} {Y:.6f} {height} {x} {y} photo_{i + 1}.png {name}")
    return lines


def survey_with(folder: Path, file: str, text: str, more: str = "") -> Path:
    """Write a survey of photographs with control from a file; return the survey file."""
    path = write_photograph_survey(folder, folder.name)
    for photograph in folder.glob("*.png"):
        photograph.rename(photograph.with_name(photograph.name.replace(" ", "_")))
    (folder / file).write_text(text, "utf-8")
    control = f'[control]\nfile = "{file}"\nsigma = [1e-4, 1e-4]\n{more}'
    path.write_text(path.read_text("utf-8").replace('unit = "mm"', 'unit = "m"') + control, "utf-8")
    return path


def test_a_list_of_ground_control_places_the_survey(tmp_path: Path) -> None:
    text = "\n".join(["WGS84 UTM 33N", "# by hand", *lines_of()])
    path = survey_with(
        tmp_path / "list", "gcp_list.txt", text, 'check = ["checked"]\n[datum]\nkind = "control"\n'
    )
    survey = read_survey(path)
    assert survey.control is not None and np.isnan(survey.control.xyz[5, 2])
    assert survey.control.sigma[5].tolist() == [1e-4, 1e-4, np.inf]
    result = run_survey(survey)
    a = result.adjustment
    assert [source.name for source in a.network.sources] == ["targets", "given"]
    assert result.verdict.level != "bad"
    for code, xyz in code_centres().items():
        j = a.network.points.index(str(code))
        assert np.abs(a.estimate.points[j] - ORIGIN - xyz / 1000).max() < 5e-4
    (check,) = result.check_points
    assert check.point == "checked" and "checked" in a.network.points
    given = [a.network.points[j] for j in a.network.control.point.tolist()]
    assert "checked" not in given and "top" in given


def test_ground_control_by_latitude_and_longitude_is_local(tmp_path: Path) -> None:
    """A point without altitude, and one without a position, which has only a name."""
    position, rotation = stations(6)
    points = []
    for k, (name, xyz) in enumerate(PLACES.items()):
        seen = [project(camera(), position[i], rotation[i], np.array([xyz]))[0] for i in range(6)]
        where = {"latitude": 52.5 + 1e-6 * k, "longitude": 13.4 + 1e-6 * k * k, "altitude": 30.0}
        if name == "flat":
            del where["altitude"]
        observations = [
            {"shot_id": f"photo_{i + 1}.png", "projection": ((xy - [319.5, 239.5]) / 640).tolist()}
            for i, xy in enumerate(seen)
        ]
        points.append({"id": name, "observations": observations, "more": 1})
        if name != "top":
            points[-1]["position"] = where
    path = survey_with(tmp_path / "json", "ground_control_points.json", json.dumps({"points": points}))
    survey = read_survey(path)
    assert survey.control is not None and survey.control.names == tuple(n for n in PLACES if n != "top")
    system = LocalSystem(52.5, 13.4)
    east, north, _ = system.coordinates([52.500006], [13.400036], [30.0])[0]
    difference = survey.control.xyz[5] - survey.control.xyz[0]
    assert difference[:2] == pytest.approx([east, north], abs=1e-6)
    assert np.isnan(survey.control.xyz[4, 2])
    network = run_survey(survey).network
    rows = network.image_points.point == network.points.index("top")
    image = network.images.index("photo_1.png")
    exact = project(camera(), position[0], rotation[0], np.array([PLACES["top"]]))[0]
    assert network.image_points.xy[rows & (network.image_points.image == image)][0] == pytest.approx(exact)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:2056\n", "line 1: projection 'EPSG:2056'"),
        ("WGS84\n1 2 3 4 5\n", "line 2: 5 fields"),
        ("WGS84\n1 2 three 4 5 a.png\n", "line 2: found 'three', expected a number"),
        ("WGS84\n1 NaN 3 4 5 a.png\n", "line 2: found NaN"),
        ("WGS84\n1 2 3 4 5 a.png p\n1 2 4 4 5 b.png p\n", "line 3: point 'p' has other coordinates"),
        ("WGS84\n13.4 97.5 3 4 5 a.png\n", "line 2: latitude 97.5, needed -90 to 90 degrees"),
        ("\n  # by hand\nEPSG:4326\n190 52.5 3 4 5 a.png\n", "line 4: longitude 190, needed -180 to 180"),
        ("WGS84\n1 2_0 3 4 5 a.png\n", "line 2: found '2_0', expected a number"),
        ("WGS84 UTM 33N\n\n1 2 1e300 4 5 a.png\n", r"gcp_list.txt, line 3: column Z contains 1e\+300"),
        ("WGS84 UTM 33N\n1 2 3 4 5 a.png p\n1 2 3 4 5 \x00 p\n", "gcp_list.txt, line 3: image contains"),
        ("WGS84\n", "no point of the file has coordinates"),
        ("WGS84 UTM 33N\n1 2 3 4 5 a.png p\n", "no point 'q', which control.check names"),
    ],
)
def test_wrong_ground_control_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = survey_with(tmp_path / "wrong", "gcp_list.txt", text, 'check = ["q"]\n')
    with pytest.raises(SurveyFileError, match=message) as refused:
        read_survey(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"latitude": 95, "longitude": 13}, "ground_control_points.json, point 'p': latitude 95"),
        ({"latitude": 52, "longitude": float("nan")}, "point 'p': longitude nan"),
    ],
)
def test_degrees_that_cannot_be_are_refused(tmp_path: Path, content: dict[str, float], message: str) -> None:
    points = {"points": [{"id": "p", "position": content}]}
    path = survey_with(tmp_path / "degrees", "ground_control_points.json", json.dumps(points))
    with pytest.raises(SurveyFileError, match=message):
        read_survey(path)


def test_control_that_no_image_point_shows_is_named(tmp_path: Path) -> None:
    """Under masks, or in one photograph: of the datum and of the checks, none is lost without a word."""
    one_ray = [line for line in lines_of() if not line.endswith("east") or "photo_1.png" in line]
    more = 'check = ["checked"]\n[datum]\nkind = "control"\n'
    path = survey_with(tmp_path / "hidden", "gcp_list.txt", "\n".join(["WGS84 UTM 33N", *one_ray]), more)
    path.write_text(path.read_text("utf-8").replace('unit = "m"', 'unit = "m"\nmasks = "masks"'), "utf-8")
    (path.parent / "masks").mkdir()
    position, rotation = stations(6)
    for i in range(6):
        mask = np.full(SIZE_PX[::-1], 255, np.uint8)
        for name in ("top", "checked"):
            x, y = project(camera(), position[i], rotation[i], np.array([PLACES[name]]))[0]
            cv2.circle(mask, (round(x), round(y)), 8, 0, -1)
        cv2.imwrite(str(path.parent / "masks" / f"photo_{i + 1}.png.png"), mask)
    result = run_survey(read_survey(path))
    (said,) = [
        one for one in of_kind(result.verdict.remarks, "names_missing") if "control" in one.names("of")
    ]
    assert set(said.names("names")) == {"top", "checked", "east"} and result.verdict.level == "fair"


def test_control_that_is_all_check_points_is_no_datum(tmp_path: Path) -> None:
    """In a free datum they may check the lengths of a survey with bars."""
    text = "\n".join(["WGS84 UTM 33N", *lines_of()])
    all_checks, datum = f"check = {json.dumps(list(PLACES))}\n", '[datum]\nkind = "control"\n'
    path = survey_with(tmp_path / "all", "gcp_list.txt", text, all_checks + datum)
    with pytest.raises(SurveyFileError, match="all 7 control points are check points, and datum kind"):
        read_survey(path)
    for name, more in (("some", f'check = ["top", "flat"]\n{datum}'), ("free", all_checks)):
        assert read_survey(survey_with(tmp_path / name, "gcp_list.txt", text, more)).control is not None


@pytest.mark.parametrize("checked", [True, False])
def test_a_control_point_with_one_ray_is_named_once(tmp_path: Path, checked: bool) -> None:
    lines = [line for line in lines_of() if not line.endswith("checked") or "photo_2" in line]
    more = ('check = ["checked"]\n' if checked else "") + '[datum]\nkind = "control"\n'
    path = survey_with(tmp_path / "once", "gcp_list.txt", "\n".join(["WGS84 UTM 33N", *lines]), more)
    result = run_survey(read_survey(path))
    (said,) = [one for one in result.verdict.remarks if "checked" in one.text]
    kind, level = ("points_not_determined", "good") if checked else ("names_missing", "fair")
    assert said.kind == kind and result.verdict.level == level
    assert ("check point that checks nothing" in said.text) == checked
    assert not len(result.check_points) or checked


@pytest.mark.parametrize("flat", [2, 3])
def test_points_without_heights_give_a_free_network_no_scale(tmp_path: Path, flat: int) -> None:
    lines = [line.split() for line in lines_of(("north", "south", "east")[:flat])]
    text = "\n".join(["WGS84 UTM 33N", *(" ".join([*one[:2], "NaN", *one[3:]]) for one in lines)])
    result = run_survey(read_survey(survey_with(tmp_path / "list", "gcp_list.txt", text)))
    (said,) = (one for one in result.verdict.remarks if one.kind == "scale_undefined")
    assert not result.has_scale and said.number("control") == 0


@pytest.mark.parametrize("control", [1, 2])
def test_too_little_control_for_a_scale_is_stated(tmp_path: Path, control: int) -> None:
    check = json.dumps(["north", "south", "east", "west", "checked", "flat"][control - 1 :])
    text = "\n".join(["WGS84 UTM 33N", *lines_of()])
    result = run_survey(
        read_survey(survey_with(tmp_path / "few", "gcp_list.txt", text, f"check = {check}\n"))
    )
    said = [one for one in result.verdict.remarks if one.kind == "scale_undefined"]
    assert [one.number("control") for one in said] == [1] * (control == 1)


def test_exchanged_coordinates_are_refused_before_measuring(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "sfm.survey.target_network.measure_photographs", lambda *a, **k: pytest.fail("measured")
    )
    rows = [line.split() for line in lines_of()]
    lines = [" ".join([*row[:3], row[4], row[3], *row[5:]]) for row in rows]
    path = survey_with(tmp_path / "exchanged", "gcp_list.txt", "\n".join(["WGS84 UTM 33N", *lines]))
    with pytest.raises(SurveyFileError, match=r"gcp_list.txt, line \d+: .* with x and y exchanged"):
        run_survey(read_survey(path))


def test_check_points_are_compared_in_every_datum(tmp_path: Path) -> None:
    text = "\n".join(["WGS84 UTM 33N", *lines_of()])
    more = 'check = ["checked"]\n'
    for kind in ("control", "free"):
        path = survey_with(tmp_path / kind, "gcp_list.txt", text, f'{more}[datum]\nkind = "{kind}"\n')
        write_result(run_survey(read_survey(path)), tmp_path / kind / "out")
        with (tmp_path / kind / "out" / "control_points.csv").open(encoding="utf-8") as table:
            rows = [row for row in csv.DictReader(table) if row["point"] == "checked"]
        assert [(row["use"], row["coordinate"]) for row in rows] == [("check", axis) for axis in "XYZ"]
        difference = np.array([float(row["difference"]) for row in rows])
        assert np.abs(difference).max() < 5e-4
        sigma = np.array([float(row["sigma_posterior"]) for row in rows])
        assert (np.abs(difference) < 5 * np.hypot(sigma, 1e-4)).all()


def test_names_of_photographs_may_have_spaces_and_points_none(tmp_path: Path) -> None:
    """A point without a name is where its coordinates are, whatever their digits."""
    lines = [
        "WGS84 UTM 33N",
        "1.0 2.00 NaN 4 5 photo  1.JPG",
        "1 2 nan 6 7 photo 2.jpeg  ",
        "1 3 3 4 5 photo 1.JPG corner extra",
        "1 4 3 4 5 raw.dng wall",
        "1 5 3 4 5 photo.jpg.copy",
    ]
    path = survey_with(tmp_path / "names", "gcp_list.txt", "\n".join(lines))
    survey = read_survey(path)
    (table,) = survey.observations  # type: ignore[misc]
    assert table.image == ("photo  1.JPG", "photo 2.jpeg", "photo 1.JPG", "raw.dng", "photo.jpg.copy")
    assert table.point == ("gcp 1", "gcp 1", "corner", "wall", "gcp 2")
    assert survey.control is not None and survey.control.names == ("gcp 1", "corner", "wall", "gcp 2")
