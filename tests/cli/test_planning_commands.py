"""`kolinear plan network`: what it writes, and bad input in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.result_tables import write_tables
from sfm.model.solution import Solution
from tests.commands import kolinear
from tests.places import ROOT
from tests.surveys import write_observed_survey
from tests.synthetic import make_network, seed_of
from tests.tables import rows_of

CAMERA = ("--camera", "full-frame-24", "--c-mm", "28")
LENS = (*CAMERA, "--sigma-px", "0.05")


def plan(*arguments: object, command: str = "network") -> int:
    return kolinear("plan", command, *arguments)


def test_a_plan_is_written_with_page_tables_and_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "plan"
    given = ("plate:1000,700", *CAMERA, "--points", 30, "--target-diameter", 10, "--out", out)
    assert plan(*given, "--stations", "ring:6", "--sigma", "0.05") == 0
    printed = capsys.readouterr().out
    assert "rule of Fraser: sigma = q S sigma_image / sqrt(k): q 0." in printed
    found = json.loads((out / "plan.json").read_text(encoding="utf-8"))
    assert found["verdict"] == "good" and found["headline"] == printed.splitlines()[0]
    assert found["reached"] and found["determined"] == 30 and found["fraser"]["k"] == 1
    points = rows_of(out / "points.csv")
    sigma = np.array([[float(row[k]) for k in ("sX", "sY", "sZ")] for row in points])
    assert np.sqrt((sigma**2).mean()) == pytest.approx(found["sigma_rms"])
    coded = {row["id"] for row in points if row["coded"] == "1"}
    seen: dict[str, int] = {}
    for row in rows_of(out / "image_points.csv"):
        seen[row["image"]] = seen.get(row["image"], 0) + (row["point"] in coded)
    assert min(seen.values()) >= 5
    assert [row["coded"] for row in rows_of(out / "shots.csv")] == [str(seen[f"S{k}"]) for k in range(1, 7)]
    assert {row["roll_deg"] for row in rows_of(out / "shots.csv")} == {"0.0", "90.0"}
    page = (out / "plan.html").read_text(encoding="utf-8")
    assert "viewer-data" in page and "azimuth [deg]" in page and "plate:1000,700" in page
    # its exterior orientation is what --stations reads, and a plan of the points gives the same again
    again = tmp_path / "again"
    given = (
        out / "points.csv",
        *CAMERA,
        "--target-diameter",
        10,
        "--stations",
        out / "exterior.csv",
        "--out",
        again,
    )
    assert plan(*given) == 0
    other = json.loads((again / "plan.json").read_text(encoding="utf-8"))
    assert other["sigma_rms"] == pytest.approx(found["sigma_rms"], rel=1e-6)


def test_what_is_not_determined_comes_first_and_without_precision(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("wall:4000,2000", *LENS, "--points", 60, "--stations", "strips:3x3", "--sigma", "10")
    assert plan(*given, "--out", tmp_path / "plan") == 1  # the verdict is bad
    printed = capsys.readouterr().out
    found = json.loads((tmp_path / "plan" / "plan.json").read_text(encoding="utf-8"))
    assert found["verdict"] == "bad" and found["remarks"][0]["kind"] == "plan_undetermined"
    assert "sigma of points, without those not determined: " in printed
    kinds_found = {one["kind"] for one in found["remarks"]}
    assert "plan_does_not_calibrate" not in kinds_found  # nothing is calibrated by what is not determined
    unknown = found["remarks"][0]
    assert len(unknown["subjects"]["unknown"]) == 1 and unknown["numbers"]["more"]["value"] >= 1


def test_the_first_command_of_the_guide_prints_what_it_shows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    guide = (ROOT / "docs/planning.md").read_text(encoding="utf-8")
    words = next(line for line in guide.splitlines() if line.startswith("kolinear plan network")).split()[3:]
    assert plan(*words, "--out", tmp_path / "plan") == 0
    found = json.loads((tmp_path / "plan" / "plan.json").read_text(encoding="utf-8"))
    assert found["verdict"] == "good"
    shown = guide.partition("```text\n")[2].partition("```")[0]
    printed = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert printed[: shown.count("\n")] == shown.splitlines()


def assumed(out: Path) -> set[str]:
    found = json.loads((out / "plan.json").read_text(encoding="utf-8"))["remarks"]
    return {name for one in found if one["kind"] == "plan_assumes" for name in one["subjects"]["assumed"]}


def kinds(out: Path) -> set[str]:
    found = json.loads((out / "plan.json").read_text(encoding="utf-8"))
    return {one["kind"] for one in found["remarks"]}


def test_a_plan_has_one_focus_and_says_what_it_takes_as_known(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "plan"
    Path(tmp_path / "points.csv").write_text(
        "id,X,Y,Z,nX,nY,nZ\na,0,0,0,0,0,1\nb,90,0,9,,,\nc,0,70,0,0,0,1\nd,80,75,0,0,0,1\n"
        "e,40,30,20,0,0,1\nf,20,60,4,0,0,1\ng,70,20,2,0,0,1\n"
    )
    given = (tmp_path / "points.csv", *LENS, "--free", "none", "--stations", "ring:6", "--out", out)
    assert plan(*given) == 0
    capsys.readouterr()
    assert {"no surface", "no normals", "known scale"} <= assumed(out)
    assert len({row["focus"] for row in rows_of(out / "shots.csv")}) == 1
    assert (
        plan(*given, *("--f-number", 22, "--focus", 150, "--confusion-um", 200), "--scale-bar", "a,d,0.01")
        == 0
    )
    assert "known scale" not in assumed(out) and "no depth of field" not in assumed(out)
    assert {row["focus"] for row in rows_of(out / "shots.csv")} == {"150.0"}
    # what has no normal cannot be painted
    assert plan(out, "--out", tmp_path / "simulation", command="simulate") == 2
    assert "point 'b' has no normal" in capsys.readouterr().err


BAD = [
    (("box:1,1", *LENS, "--stations", "ring:6"), "object: box of 1, 1, expected 3 positive sizes LX,LY,LZ"),
    (
        ("ball:1", *LENS, "--stations", "ring:6"),
        "expected points (.csv), a mesh (.stl, .ply, .obj, .3mf) or one of box",
    ),
    (
        ("plate:1,1", "--camera", "full-frame-24", "--sigma-px", "1", "--stations", "ring:6"),
        "no focal length",
    ),
    (
        ("plate:1,1", "--camera", "brownie", "--c-mm", "5", "--sigma-px", "1", "--stations", "ring:6"),
        "one of full-frame-24",
    ),
    (("plate:1,1", *LENS), "expected --stations, or a wanted precision"),
    (("plate:1,1", *CAMERA, "--stations", "ring:6"), "expected --sigma-px or --target-diameter"),
    (
        ("plate:1,1", *LENS, "--stations", "ring:6", "--f-number", "8"),
        "needs both --f-number and --focus",
    ),
    (
        ("plate:1,1", *LENS, "--stations", "ring:6", "--free", "c,K9"),
        "--free K9: camera full-frame-24 (brown) has c, x0",
    ),
    (("plate:1,1", *LENS, "--stations", "ring:6", "--scale-bar", "1,2"), "expected FROM,TO,SIGMA"),
    (("plate:1,1", *LENS, "--stations", "ring:6", "--unit", "parsec"), "--unit parsec: expected one of km"),
    (
        ("plate:1000,1000", *LENS, "--sigma", "1", "--space", "0,1,2"),
        "expected 6 numbers separated by commas",
    ),
    (("plate:1000,1000", *LENS, "--sigma", "1", "--space=-9,9,-9,9,-9000,-100"), "the object faces away"),
    (("plate:1000,1000", *LENS, "--sigma", "1", "--space", "5e4,6e4,5e4,6e4,5e4,6e4"), "no room within"),
    (
        ("plate:1000,1000", *LENS, "--stations", "ring:6", "--f-number", "2", "--focus", "10"),
        "focus at 10 mm",
    ),
    (
        ("plate:1000,1000", *LENS, "--stations", "ring:6", "--max-incidence-deg", "1"),
        "0 of 6 photographs show",
    ),
    (("holes.stl", *LENS, "--stations", "ring:6"), "3 edges of one triangle only"),
    (("mixed.stl", *LENS, "--stations", "ring:6"), "at 3 edges neighbouring triangles run in opposite"),
    (("line.csv", *LENS, "--stations", "ring:6"), "4 points on one line"),
    (("zero.csv", *LENS, "--stations", "ring:6"), "point c has a normal of length 0"),
    (("plate:1000,1000", *LENS, "--sigma", "1", "--floor", "nan"), "floor at nan"),
    (("no.csv", *LENS, "--stations", "ring:6"), "no.csv"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[message[:24] for _, message in BAD])
def test_bad_input_is_one_line(
    arguments: tuple[str, ...],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    facets = [(0, 2, 1), (0, 1, 3), (0, 3, 2)]  # a tetrahedron without its last side
    for name, sides in (
        ("holes", facets),
        ("mixed", [*facets, (1, 3, 2)]),
    ):  # and with it the wrong way round
        text = "".join(
            "facet normal 0 0 0\nouter loop\n"
            + "".join(f"vertex {corners[k][0]} {corners[k][1]} {corners[k][2]}\n" for k in f)
            + "endloop\nendfacet\n"
            for f in sides
        )
        Path(f"{name}.stl").write_text(f"solid {name}\n{text}endsolid {name}\n")
    Path("line.csv").write_text("id,X,Y,Z\na,0,0,0\nb,1,0,0\nc,2,0,0\nd,3,0,0\n")
    Path("zero.csv").write_text("id,X,Y,Z,nX,nY,nZ\na,0,0,0,,,\nb,1,0,0,0,0,1\nc,0,1,0,0,0,0\n")
    assert plan(*arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and message in lines[0]
    assert not Path("out").exists()


def test_the_camera_of_a_survey_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    survey = write_observed_survey(tmp_path / "s", "plan")
    given = ("dish:2,0.4", "--unit", "m", "--camera", survey, "--sigma-px", "0.1", "--points", 20)
    assert plan(*given, "--stations", "hemisphere:8", "--out", tmp_path / "plan") == 0
    camera = json.loads((tmp_path / "plan" / "plan.json").read_text(encoding="utf-8"))["cameras"][0]
    assert camera["name"] == "synthetic" and camera["free"] == ["c"] and camera["parameters"]["K1"] == 8e-4
    text = survey.read_text(encoding="utf-8").replace("c_mm = 10.0\n", "")
    survey.write_text(text, encoding="utf-8")
    assert plan(*given, "--stations", "hemisphere:8") == 2
    assert "camera synthetic has no focal length, expected c_mm or --c-mm" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "said"),
    [("simulate", "nowhere/plan.json: cannot be read"), ("more", "nowhere: not the folder of a result")],
)
def test_a_folder_that_is_none_is_one_line(
    command: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert plan("nowhere", command=command) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and said in lines[0]
    assert not Path("out").exists()


def test_more_photographs_for_a_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A result of the tables of a network; what its report says is how to ask for this."""
    network, truth = make_network(seed_of("more"), images=5, points=25, free=())
    write_tables(tmp_path / "five", Solution("five", network, truth, unit="m", redundancy=40))
    out = tmp_path / "more"
    assert plan(tmp_path / "five", "--photographs", 2, "--out", out, command="more") == 0
    printed = capsys.readouterr().out
    assert "2 more photographs: sigma of the worst point from" in printed and "\n  new 2  " in printed
    points = rows_of(out / "points.csv")
    assert all(float(row["sigma_with_more"]) < float(row["sigma"]) for row in points)
