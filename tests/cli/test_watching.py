"""`--watch`: photographs are added to a folder while it is watched."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.cli import watching
from sfm.cli.watching import WatchedSurvey, arrivals
from sfm.model.errors import KolinearError
from tests.commands import kolinear, refused
from tests.plates import BOARD, plate_pictures
from tests.surveys import pictures
from tests.synthetic import seed_of

Step = Callable[[], object]


@pytest.fixture
def events(monkeypatch: pytest.MonkeyPatch) -> list[Step]:
    """What happens while the folder is watched, one thing in each pause; afterwards Ctrl-C is pressed."""
    steps: list[Step] = []

    def sleep(_: float) -> None:
        if not steps:
            raise KeyboardInterrupt
        steps.pop(0)()

    monkeypatch.setattr(watching.time, "sleep", sleep)
    return steps


@pytest.fixture
def photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in the current one."""
    monkeypatch.chdir(tmp_path)
    folder = Path("photos")
    folder.mkdir()
    return folder


def nothing() -> None:
    """Let a pause go by."""


def adds(folder: Path, source: Path, *numbers: int) -> list[Step]:
    """Return the pauses in which photographs come into a folder, and are complete."""

    def add() -> None:
        for path in sorted(source.iterdir())[numbers[0] : numbers[-1] + 1]:
            shutil.copy(path, folder)

    return [add, nothing]


@pytest.fixture(scope="module")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boards")
    for k, picture in enumerate(plate_pictures(BOARD, seed_of("watched"), 9)):
        cv2.imwrite(str(folder / f"{k}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return folder


@pytest.fixture
def targets(tmp_path: Path) -> Path:
    """Photographs of coded targets, which come from here."""
    folder = tmp_path / "camera"
    folder.mkdir()
    for k, picture in enumerate(pictures()):
        cv2.imwrite(str(folder / f"{k}.png"), picture)
    return folder


def test_a_camera_is_calibrated_until_it_is_known(
    photos: Path, boards: Path, events: list[Step], capsys: pytest.CaptureFixture[str]
) -> None:
    """Each photograph is reported, the camera becomes better known, and the wanted uncertainty ends it."""
    black = np.zeros((600, 800), np.uint8)

    def empty() -> None:
        cv2.imwrite("photos/z.png", black)

    events += [
        *adds(photos, boards, 0, 3),
        empty,
        nothing,
        *adds(photos, boards, 4, 8),
        nothing,
    ]
    assert kolinear("calibrate", "photos", "--watch", "--until", 0.08, "--pitch", 12) == 0
    shown = capsys.readouterr().out
    assert [f"{k}.png: used" in shown for k in range(9)] == [True] * 9
    assert "z.png: not used. " in shown
    lines = [line.partition(": worst corner ")[2] for line in shown.splitlines() if "px, wanted" in line]
    corners = [float(line.split()[0]) for line in lines]
    assert len(corners) == 3 and corners[-1] <= 0.08 < corners[0]
    assert "  next: object at " in shown and "worst corner then" in shown
    assert len(events) == 1  # what would have come later was not waited for
    assert Path("out/photos/calibration.html").is_file()


def test_too_few_photographs_are_waited_for(
    photos: Path, boards: Path, events: list[Step], capsys: pytest.CaptureFixture[str]
) -> None:
    """The draft of two photographs, which give no camera, is replaced; Ctrl-C ends with the last code."""
    few, one = adds(photos, boards, 1, 1), adds(photos, boards, 0, 0)
    events += [*one, *few, *adds(photos, boards, 2, 5)]
    assert kolinear("calibrate", "photos", "--watch", "--pitch", 12) == 0
    shown = capsys.readouterr()
    assert "not yet: photos: 1 photograph of one camera" in shown.out
    assert "5.png: used, " in shown.out and "stopped" in shown.err
    assert shown.err.count("Survey file: ") == 2


def test_a_survey_says_which_photographs_are_next(
    photos: Path, targets: Path, events: list[Step], capsys: pytest.CaptureFixture[str]
) -> None:
    count = len(pictures())
    events += [
        *adds(photos, targets, 0, count - 2),
        *adds(photos, targets, count - 1, count - 1),
    ]
    assert kolinear("run", "photos", "--watch") == 0
    shown = capsys.readouterr().out
    assert f"{count - 1}.png: used, " in shown
    worst = [line for line in shown.splitlines() if line.startswith("next ")]
    assert len(worst) == 2 and shown.count("weakest points: ") == 2
    assert " from where " in shown and "azimuth" in shown


def test_a_camera_of_targets_without_scale_has_no_mm(
    photos: Path, targets: Path, events: list[Step], capsys: pytest.CaptureFixture[str]
) -> None:
    events += adds(photos, targets, 0, len(pictures()) - 1)
    assert kolinear("calibrate", "photos", "--watch") == 0
    following = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  next: ")]
    assert len(following) == 1 and "network units; worst corner then" in following[0]


def test_a_survey_file_that_exists_is_never_removed(photos: Path, boards: Path, events: list[Step]) -> None:
    own = Path("photos/survey.toml")
    own.write_text("[survey]\nname = 'mine'\n", "utf-8")
    events += [*adds(photos, boards, 0, 1), *adds(photos, boards, 2, 3)]
    assert kolinear("calibrate", "photos", "--watch") != 0
    assert own.read_text("utf-8") == "[survey]\nname = 'mine'\n"


def test_a_draft_that_somebody_changed_is_never_removed(
    photos: Path, boards: Path, events: list[Step], capsys: pytest.CaptureFixture[str]
) -> None:
    """Two photographs give no camera; the draft that is changed then is run with the next ones."""
    draft = Path("out/photos.toml")

    def change() -> None:
        draft.write_text(draft.read_text("utf-8") + "# mine\n", "utf-8")

    events += [*adds(photos, boards, 0, 1), change, *adds(photos, boards, 2, 5)]
    kolinear("calibrate", "photos", "--watch", "--pitch", 12)
    assert draft.read_text("utf-8").endswith("# mine\n")
    shown = capsys.readouterr()
    assert shown.err.count("Survey file: ") == 1 and "5.png: used, " in shown.out


def test_what_is_drafted_here_is_removed_with_its_picture(tmp_path: Path) -> None:
    """A draft is replaced whole, but for what was changed; that of a dependable result stays."""
    file, picture, rounds = tmp_path / "a.toml", tmp_path / "a-rings.png", WatchedSurvey()

    def draft() -> None:
        for path in (file, picture):
            path.write_bytes(b"drafted")
        rounds.note_drafted((file, picture))

    draft()
    assert not rounds.begin() and not file.exists() and not picture.exists()
    draft()
    rounds.is_dependable = True
    assert rounds.begin() and file.exists() and picture.exists()
    file.unlink()  # by the user, to draft it anew
    assert not rounds.begin() and not picture.exists()
    draft()
    file.write_bytes(b"mine")
    assert rounds.begin() and file.read_bytes() == b"mine"


def test_photographs_of_rounds_without_a_result_are_reported_later(
    tmp_path: Path, events: list[Step], capsys: pytest.CaptureFixture[str]
) -> None:
    """Also one that was removed meanwhile is not called unused."""
    rounds, failed = WatchedSurvey(), [KolinearError("too few")]

    def run() -> None:
        if failed:
            raise failed.pop()

    events += [
        lambda: [(tmp_path / f"{name}.png").touch() for name in "ab"],
        nothing,
        lambda: [(tmp_path / "a.png").unlink(), (tmp_path / "c.png").touch()],
        nothing,
    ]
    watching.watch(tmp_path, run, rounds)
    assert "2 new photographs: b.png, c.png" in capsys.readouterr().out


def test_a_photograph_that_is_still_written_is_waited_for(tmp_path: Path, events: list[Step]) -> None:
    path = tmp_path / "a.jpg"
    events += [lambda: path.write_bytes(b"12"), lambda: path.write_bytes(b"1234"), nothing, nothing]
    seen = arrivals(tmp_path)
    assert next(seen) == ("a.jpg",) and len(events) == 1
    with pytest.raises(KeyboardInterrupt):
        next(seen)


def test_bad_input_gets_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--watch needs a folder" in refused(capsys, "run", tmp_path / "a.toml", "--watch")
    (tmp_path / "a.mp4").touch()
    assert "this one has videos" in refused(capsys, "run", tmp_path, "--watch")
    assert "--until 3 is for --watch" in refused(capsys, "run", tmp_path, "--until", 3)
    assert "--until" in refused(capsys, "run", tmp_path, "--watch", "--until", -1)
    assert "--until 3 is for --watch" in refused(capsys, "calibrate", tmp_path, "--until", 3)
