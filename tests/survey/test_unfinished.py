"""A survey whose stage cannot go on ends in a report of how far it came, not in one line."""

from __future__ import annotations

import csv
import json
import pickle
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import sfm
from sfm.model.errors import GeometryError
from sfm.products.batch.job import SurveyRow
from sfm.products.batch.run import run_batch
from sfm.products.batch.table import outcome_of
from sfm.report.output import read_log
from tests.commands import kolinear, refused
from tests.engines import ALONE, HERE, Notes
from tests.surveys import write_observed_survey, write_photograph_survey
from tests.synthetic import seed_of

Rows = list[list[str]]
IMAGES = tuple(f"image {k}" for k in range(1, 7))


def one_point(rows: Rows) -> Rows:
    return [row for row in rows if row[1] == rows[0][1]]


def nothing_shared(rows: Rows) -> Rows:
    return [[image, f"{image}: {point}", *xy] for image, point, *xy in rows]


def anywhere(rows: Rows) -> Rows:
    xy = seed_of("anywhere").uniform((0, 0), (2000, 1500), (len(rows), 2)).tolist()
    return [[image, point, *map(str, place)] for (image, point, *_), place in zip(rows, xy, strict=True)]


def unchanged(rows: Rows) -> Rows:
    return rows


STOPPED: dict[str, tuple[Callable[[Rows], Rows], str, str, str]] = {
    # change of the image points, addition to the survey file, stage that stops, the line
    "one point": (one_point, "", "orientation", "have 4 points in common"),
    "nothing shared": (nothing_shared, "", "orientation", "have 4 points in common"),
    "anywhere": (anywhere, "", "orientation", "photographs could be oriented"),
    "datum": (unchanged, '[datum]\npoints = ["1", "2", "none"]\n', "adjustment", "2 of the 3 datum.points"),
}


def survey_of(folder: Path, kind: str) -> Path:
    """Write a survey of image points that stops; return its file."""
    change, more, _, _ = STOPPED[kind]
    path = write_observed_survey(folder, kind, points=40)
    table = path.parent / "image_points.csv"
    with table.open(newline="") as file:
        head, *rows = csv.reader(file)
    with table.open("w", newline="") as file:
        csv.writer(file).writerows([head, *change(rows)])
    path.write_text(path.read_text() + more)
    return path


@pytest.mark.parametrize("kind", STOPPED)
def test_a_stage_that_cannot_go_on_ends_in_a_report(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, _, stage, line = STOPPED[kind]
    survey, out = survey_of(tmp_path / "s", kind), tmp_path / "out"
    assert kolinear("adjust", survey, "--out", out) == 1
    shown = capsys.readouterr()
    assert shown.err == "" and line in shown.out and f"Report: {out / 'report.html'}" in shown.out
    summary = json.loads((out / "summary.json").read_text())
    assert summary["verdict"]["level"] == "bad" and summary["stopped_in"] == stage
    headline = summary["verdict"]["headline"]
    assert line in headline and shown.out.startswith(headline)
    page, text = (out / "report.html").read_text(), " ".join((out / "report.txt").read_text().split())
    assert headline in page and headline in text
    assert all(image in page and image in text for image in IMAGES)
    with (out / "photographs.csv").open(newline="") as file:
        photographs = list(csv.DictReader(file))
    assert [one["image"] for one in photographs] == list(IMAGES)
    said = {one["orientation"] for one in photographs}
    reasons = {
        "one point": {"not oriented"},
        "nothing shared": {"none of its points is in another photograph"},
        "datum": {"oriented"},
    }
    assert said == reasons.get(kind, said)
    assert kind != "anywhere" or all("are needed" in one or "contradict" in one for one in said)
    log = read_log(out / "log.jsonl")
    assert log[0]["event"] == "start" and log[-1]["verdict"] == "bad" and line in log[-1]["reason"]
    assert sorted(one.name for one in tmp_path.iterdir() if one.name[0] != ".") == ["out", "s"]


def test_photographs_of_a_survey_that_stops_are_drawn_with_their_targets(tmp_path: Path) -> None:
    survey, out = write_photograph_survey(tmp_path / "s", "stops", photographs=3), tmp_path / "out"
    for path in survey.parent.glob("*.png"):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        grey[:, 200:] = np.median(grey)
        cv2.imwrite(str(path), grey)
    (survey.parent / "photo 3.png").write_bytes(b"none")
    assert kolinear("run", survey, "--out", out) == 1
    assert sorted(path.name for path in (out / "overlays").iterdir()) == ["photo 1.jpg", "photo 2.jpg"]
    with (out / "photographs.csv").open(newline="") as file:
        rows = {one["image"]: one for one in csv.DictReader(file)}
    assert all(int(rows[f"photo {k}.png"]["targets"]) > 0 for k in (1, 2))
    assert "read" in rows["photo 3.png"]["orientation"]
    assert "2 of 2 measured" in (out / "report.txt").read_text()


def test_python_gets_the_error_with_what_was_reached(tmp_path: Path) -> None:
    with pytest.raises(GeometryError, match=r"datum\.points") as caught:
        sfm.run_survey(survey_of(tmp_path / "s", "datum"))
    error = caught.value
    reached = getattr(error, "reached", None)
    assert reached is not None and reached.oriented is not None and reached.oriented.sum() == 6
    assert [one.stage for one in reached.seconds] == ["orientation", "matching"]
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error) and again.reached.reason == reached.reason


@pytest.mark.slow
def test_python_gets_the_photographs_that_could_not_be_oriented(tmp_path: Path) -> None:
    with pytest.raises(GeometryError) as caught_too:
        sfm.run_survey(survey_of(tmp_path / "t", "anywhere"))
    failed = getattr(caught_too.value, "reached").failed  # noqa: B009
    assert {one.image for one in failed} == set(IMAGES)
    assert pickle.loads(pickle.dumps(caught_too.value.__cause__)).args == caught_too.value.__cause__.args


def test_such_a_report_replaces_a_result_and_is_replaced_by_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    survey, out = survey_of(tmp_path / "s", "datum"), tmp_path / "out"
    whole = survey.read_text()
    for text, code in ((whole, 1), (whole.split("[datum]")[0], 0), (whole, 1)):
        survey.write_text(text)
        assert kolinear("adjust", survey, "--out", out) == code
        assert (out / "points.csv").exists() == (code == 0)
    (out / "mine.txt").touch()
    capsys.readouterr()
    assert "mine.txt" in refused(capsys, "adjust", survey, "--out", out)


def test_a_report_of_an_unfinished_survey_is_no_result_to_compare(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert kolinear("adjust", survey_of(tmp_path / "s", "nothing shared"), "--out", out) == 1
    capsys.readouterr()
    assert str(out) in refused(capsys, "compare", out, out)


def test_bad_input_is_still_one_line_without_a_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    survey = write_observed_survey(tmp_path / "s", "bad input")
    survey.write_text(survey.read_text() + '[datum]\nkind = "control"\n')
    assert "needs [control]" in refused(capsys, "adjust", survey, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_batch_links_the_report_and_keeps_it(tmp_path: Path) -> None:
    files = [survey_of(tmp_path / "s", "nothing shared"), write_observed_survey(tmp_path / "t", "good")]
    out = tmp_path / "out"
    rows = run_batch(files, out, HERE, ALONE, Notes())
    bad, good = rows
    assert (bad.status, bad.verdict, bad.succeeded) == ("done", "bad", False) and good.succeeded
    assert "have 4 points in common" in bad.reason and outcome_of(bad) == f"bad: {bad.reason}"
    assert (bad.photographs, bad.photographs_total) == (0, 6)
    page = (out / "index.html").read_text()
    assert '<a href="nothing_shared/report.html">' in page and "1 of 2 surveys has" in page
    totals = json.loads((out / "batch.json").read_text())["totals"]
    assert totals["not dependable"] == 1 and totals["failed"] == 0
    assert not (out / "logs" / f"{bad.folder}.jsonl").exists()
    kept: list[SurveyRow] = list(run_batch(files, out, HERE, ALONE, Notes(), resume=True))
    assert kept == list(rows)
