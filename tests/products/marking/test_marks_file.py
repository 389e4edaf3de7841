"""The marks file: what is written is read back, and what is wrong is named in one line."""

from __future__ import annotations

import multiprocessing
import random
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from sfm.model.errors import SurveyFileError
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.marks_file import (
    COLUMNS,
    KINDS,
    Mark,
    Marking,
    StatedPoint,
    image_points_of,
    read_marks,
    write_marks,
)

HEAD = "# kolinear marks 1\n# survey: hall\n" + ",".join(COLUMNS) + "\n"
ROW = "a.jpg,P1,1.5,2.5,0.01,0.001,0.02,target,measured,accepted,2026-01-02T03:04:05Z\n"


def marking_of(count: int = 7) -> Marking:
    marking = Marking("hall, no. 1", hashes={"a, b.jpg": "00ff", "c.jpg": "1234"})
    for k in range(count):
        kind = KINDS[k % len(KINDS)]
        mark = Mark(
            "a, b.jpg",
            f"=P{k}",
            k / 3,
            1e5 / 7,
            0.1 + k,
            0.01,
            0.2,
            kind,
            "measured",
            when="2026-01-01T00:00:00Z",
        )
        marking = marking.with_mark(mark)
    refused = Mark("c.jpg", "P1", 1.0, 2.0, 1.0, 0.0, 1.0, "hand", "hand", when="2026-01-01T00:00:00Z")
    marking = marking.with_refused(refused)
    control = {"1, 2": StatedPoint((0.1, 0.2, 1 / 3), (0.0, 0.0, 0.01))}
    bars = {("a", "b"): ScaleBar("a", "b", 1 / 3, 0.01)}
    return Marking(marking.survey, marking.marks, marking.refused, control, bars, marking.hashes)


def test_what_is_written_is_read_back_and_written_identical(tmp_path: Path) -> None:
    path, again = tmp_path / "marks.csv", tmp_path / "again.csv"
    write_marks(path, marking_of())
    assert read_marks(path) == marking_of()
    write_marks(again, read_marks(path))
    assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize("name", ["+1", "=A1", "@a", "-b", "'+1", "a;=b", 'say "x"', "a: b"])
def test_names_that_spreadsheets_would_compute_are_read_back(tmp_path: Path, name: str) -> None:
    mark = Mark(f"{name}.jpg", name, 1.0, 2.0, 1.0, 0.0, 1.0, "hand", "hand", when="t")
    marking = Marking(
        "hall",
        {mark.key: mark},
        control={name: StatedPoint((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))},
        bars={(name, "b"): ScaleBar(name, "b", 1.0, 0.01), ("b", name): ScaleBar("b", name, 2.0, 0.01)},
        hashes={mark.photograph: "00ff"},
    )
    write_marks(tmp_path / "marks.csv", marking)
    assert read_marks(tmp_path / "marks.csv") == marking


def test_a_file_without_marks_is_read(tmp_path: Path) -> None:
    write_marks(tmp_path / "marks.csv", Marking("hall"))
    read = read_marks(tmp_path / "marks.csv")
    assert read == Marking("hall")
    assert image_points_of(read, tmp_path / "marks.csv", 0.1) is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("photograph,point\na,b\n", "not a marks file"),
        (HEAD + ROW.replace("target", "circle"), "line 4: column kind contains 'circle'"),
        (HEAD + ROW.replace("accepted", "proposed"), "line 4: column state contains 'proposed'"),
        (HEAD + ROW + ROW, "line 5: point 'P1' in 'a.jpg' is marked already"),
        (HEAD + ROW.replace("0.001", "0.1"), "line 4: column sxy_px2 contains 0.1"),
        (HEAD + ROW.replace("0.01,", "-1,"), "line 4: column sxx_px2 contains -1"),
        (HEAD + ROW.replace("1.5", "nan"), "line 4: column x_px contains 'nan'"),
        ("# kolinear marks 1\n# control: A,1,2\n" + HEAD.split("\n", 1)[1], "line 2: needed"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "marks.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SurveyFileError) as refused:
        read_marks(path)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_sigma_of_a_survey_is_added_to_measured_marks_only(tmp_path: Path) -> None:
    by_hand = Mark("a.jpg", "P1", 1.0, 2.0, 4.0, 0.0, 4.0, "hand", "hand")
    measured = Mark("a.jpg", "P2", 1.0, 2.0, 0.01, 0.005, 0.01, "target")
    given = image_points_of(Marking("s").with_mark(by_hand).with_mark(measured), tmp_path, 0.1)
    assert given is not None and given.sigma is not None and given.covariance is not None
    np.testing.assert_allclose(given.sigma**2, [[4.0, 4.0], [0.02, 0.02]])
    np.testing.assert_allclose(given.covariance, [0.0, 0.005])


def _keep_marking(path: Path, count: int) -> None:
    """Mark one point after the other until the process is killed."""
    marking = Marking("hall")
    for k in range(count):
        marking = marking.with_mark(
            Mark("a.jpg", f"P{k}", float(k), 0.0, 1.0, 0.0, 1.0, "hand", "hand", when="t")
        )
        write_marks(path, marking)
        (path.parent / "count").write_text(str(k + 1))  # what the page was told


def test_a_crash_at_any_moment_loses_at_most_the_mark_that_is_being_written(tmp_path: Path) -> None:
    chance, fork = random.Random(0), multiprocessing.get_context("fork")
    for trial in range(20):
        folder = tmp_path / str(trial)
        folder.mkdir()
        process = fork.Process(target=_keep_marking, args=(folder / "marks.csv", 10_000))
        process.start()
        while not (folder / "count").exists():
            time.sleep(0.001)
        time.sleep(chance.uniform(0.0, 0.05))
        assert process.pid is not None
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
        told = int((folder / "count").read_text() or 0)
        kept = read_marks(folder / "marks.csv")
        assert len(kept.marks) in (told, told + 1) or not told
        assert [mark.x for mark in kept.marks.values()] == list(range(len(kept.marks)))
