"""Drafted survey files: their photographs are found from anywhere, and by no file of a stranger."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

import sfm
from sfm.model.errors import SurveyFileError
from sfm.products.drafting.draft import names_of_folder
from tests.commands import kolinear, refused
from tests.surveys import write_photograph_survey
from tests.tables import rows_of

BATCH = "from sfm.cli import main; main()"


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six photographs without a survey file."""
    photographs = tmp_path_factory.mktemp("drafts") / "rendered"
    write_photograph_survey(photographs, "drafts").unlink()
    return photographs


@pytest.fixture
def started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder of the commands."""
    (tmp_path / "at").mkdir()
    monkeypatch.chdir(tmp_path / "at")
    return tmp_path / "at"


def oriented(result: Path) -> int:
    return len(rows_of(result / "images.csv"))


def test_a_draft_is_run_from_anywhere(
    rendered: Path, started: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also edited, by batch and in Python; umlauts, spaces and quotes; folders that nobody can write."""
    photographs = started / 'Höhle "7" süd' / "Fotos 1"
    shutil.copytree(rendered, photographs)
    photographs.chmod(0o555)
    try:
        assert kolinear("init", photographs, "--out", "drafts/höhle.toml") == 0
        assert capsys.readouterr().out == "Run it: kolinear run drafts/höhle.toml\n".replace(
            "drafts/höhle.toml", "'drafts/höhle.toml'"
        )
        file = started / "drafts" / "höhle.toml"
        assert tomllib.loads(file.read_text("utf-8"))["survey"]["photographs"] == '../Höhle "7" süd/Fotos 1'
        file.write_text(file.read_text("utf-8").replace('kind = "free"', 'kind = "minimal"'), "utf-8")
        (started / "elsewhere").mkdir()
        monkeypatch.chdir(started / "elsewhere")
        assert kolinear("run", "../drafts/höhle.toml") == 0
        assert oriented(Path("out/Fotos_1")) == 6
        assert kolinear("batch", "../drafts", "--jobs", 1) == 0
        assert oriented(Path("out/batch/Fotos_1")) == 6
        assert kolinear("mark", file, "--export", "none.json") == 0
        assert len(sfm.run_survey(file, compare_with="none").adjustment.network.images) == 6
    finally:
        photographs.chmod(0o755)


@pytest.mark.usefixtures("in_process")
def test_a_strangers_file_names_no_folder(
    rendered: Path, started: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor does one's own after the folder became a link; --images names it once."""
    assert kolinear("init", rendered, "--out", "drafts/own.toml") == 0
    text = Path("drafts/own.toml").read_text("utf-8")
    Path("unpacked").mkdir()
    for name, stated in (("relative", "../private"), ("absolute", str(rendered)), ("link", "inside")):
        foreign = Path("unpacked") / f"{name}.toml"
        own = tomllib.loads(text)["survey"]["photographs"]
        foreign.write_text(text.replace(f'photographs = "{own}"', f'photographs = "{stated}"'), "utf-8")
        assert stated in foreign.read_text("utf-8")
    shutil.copytree(rendered, "private")
    Path("unpacked/inside").symlink_to(rendered)
    for name in ("relative", "absolute", "link"):
        foreign = Path("unpacked") / f"{name}.toml"
        for command in (("run", foreign), ("mark", foreign, "--export", "none.json")):
            capsys.readouterr()
            assert kolinear(*command) == 2
            assert "leaves the survey's folder; name it once" in capsys.readouterr().err
        with pytest.raises(SurveyFileError, match="leaves the survey's folder"):
            sfm.run_survey(foreign, compare_with="none")
        assert kolinear("batch", foreign, "--out", f"out/{name}") == 1
        assert "leaves the survey's folder" in capsys.readouterr().out
    assert kolinear("run", "unpacked/relative.toml", "--images", rendered) == 0  # not the stated one
    assert kolinear("run", "unpacked/relative.toml") == 2
    assert kolinear("run", "unpacked/absolute.toml", "--allow-outside", "--out", "out/allowed") == 0
    assert kolinear("run", "unpacked/absolute.toml", "--out", "out/allowed") == 2
    named = ("run", "unpacked/relative.toml", "--out", "out/named")
    assert kolinear(*named, "--images", "private") == 0
    assert kolinear(*named) == 0
    shutil.rmtree("private")
    Path("private").symlink_to(rendered)
    assert kolinear(*named) == 2, "the folder that was named is now another"


def test_after_a_move_the_folder_is_named_again(
    rendered: Path, started: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(rendered, "all/photos")
    monkeypatch.chdir("all")
    assert kolinear("run", "photos") == 0
    monkeypatch.chdir(started)
    Path("all").rename("moved")
    monkeypatch.chdir("moved")
    capsys.readouterr()
    assert kolinear("run", "out/photos.toml") == 2
    assert "name it once" in capsys.readouterr().err
    assert kolinear("run", "photos") == 0, "which names it, and runs the survey file as it is"
    assert "Running out/photos.toml, which exists" in capsys.readouterr().err
    assert kolinear("run", "out/photos.toml") == 0


def test_a_folder_in_that_of_the_survey_file_needs_no_name(rendered: Path, started: Path) -> None:
    """It is safe: whoever gave the survey file gave the photographs; links inside stay allowed."""
    shutil.copytree(rendered, "project/data/photos")
    (Path("project") / "more").mkdir()
    Path("project/data/photos/photo 6.png").rename("project/more/6.png")
    Path("project/data/photos/photo 6.png").symlink_to("../../more/6.png")
    assert kolinear("init", "project/data/photos", "--out", "project/drawn.toml") == 0
    shutil.copytree("project", "copied", symlinks=True)
    assert kolinear("run", "copied/drawn.toml") == 0
    assert oriented(Path("out/photos")) == 6
    Path("copied/data/photos/photo 6.png").unlink()
    Path("copied/data/photos/photo 6.png").symlink_to(rendered / "photo 6.png")
    assert kolinear("run", "copied/drawn.toml") == 2


def test_folders_of_one_name_do_not_collide(
    rendered: Path, started: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("tower/images", "bridge/images", "a/photos", "b/photos"):
        shutil.copytree(rendered, folder)
    told = []
    for folder in ("tower/images", "bridge/images", "a/photos", "b/photos", "b/photos", "a/photos"):
        assert kolinear("run", folder) == 0
        told.append("which exists" in capsys.readouterr().err)
    assert told == [False] * 4 + [True] * 2
    drafts = [*Path("out").glob("*.toml")]
    surveys = {draft.stem: tomllib.loads(draft.read_text("utf-8"))["survey"] for draft in drafts}
    assert {name: survey["name"] for name, survey in surveys.items()} == {
        "tower": "tower",
        "bridge": "bridge",
        "photos": "photos",
        "b_photos": "b photos",
    }
    assert surveys["b_photos"]["photographs"] == "../b/photos"
    assert kolinear("run", "out/b_photos.toml") == 0, "into the result folder of its own name"
    assert [*names_of_folder(Path("/x/Images"))][:2] == ["x", "x Images"]
    assert next(names_of_folder(Path("/images"))) == "images" and next(names_of_folder(Path("/"))) == "survey"


def test_a_batch_drafts_and_runs_folders_and_goes_on_after_a_kill(
    rendered: Path, started: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One folder has no survey in it: its row says why, and the others go on."""
    for folder in ("a/images", "b/images", "photos"):
        shutil.copytree(rendered, folder)
    Path("single").mkdir()
    shutil.copy(rendered / "photo 1.png", "single")
    given = ("batch", "a/images", "b/images", "photos", "single", "--jobs", "1")
    with subprocess.Popen([sys.executable, "-c", BATCH, *given], stderr=subprocess.DEVNULL) as batch:
        for _ in range(1200):
            if Path("out/batch/a/report.html").is_file() or batch.poll() is not None:
                break
            time.sleep(0.05)
        assert batch.poll() is None
        os.kill(batch.pid, signal.SIGKILL)
    first = {path.name: path.stat().st_mtime_ns for path in Path("out/batch").glob("*.toml")}
    assert set(first) == {"a.toml", "b.toml", "photos.toml"}
    finished = {path.parent.name: path.stat().st_mtime_ns for path in Path("out/batch").glob("*/report.html")}
    assert "a" in finished
    for _ in range(100):  # until workers have noticed
        if kolinear(*given, "--resume") == 1:
            break
        time.sleep(0.2)
    said = capsys.readouterr()
    assert "4 surveys, 3 done, 1 failed" in said.out and "at least 2 are needed" in said.out
    assert "Running out/batch/b.toml, which exists" in said.err
    for name in ("a", "b", "photos"):
        assert oriented(Path("out/batch") / name) == 6
        report = (Path("out/batch") / name / "report.html").stat().st_mtime_ns
        assert report == finished.get(name, report)
    assert {path.name: path.stat().st_mtime_ns for path in Path("out/batch").glob("*.toml")} == first


@pytest.mark.usefixtures("in_process")
def test_masks_of_a_draft_are_found_beside_its_photographs(rendered: Path, started: Path) -> None:
    import cv2
    import numpy as np

    shutil.copytree(rendered, "photos")
    Path("photos/masks").mkdir()
    for photograph in Path("photos").glob("*.png"):
        mask = np.full(cv2.imread(str(photograph), 0).shape, 255, np.uint8)
        mask[:, : mask.shape[1] // 3] = 0
        cv2.imwrite(f"photos/masks/{photograph.name}.png", mask)
    assert kolinear("init", "photos", "--out", "drafts/photos.toml") == 0
    assert kolinear("run", "drafts/photos.toml") in (0, 1)
    assert kolinear("batch", "drafts/photos.toml", "--jobs", 1) in (0, 1)
    single, batched = (rows_of(Path(f) / "image_points.csv") for f in ("out/photos", "out/batch/photos"))
    assert single == batched and min(float(row["x_px"]) for row in single) > 200


@pytest.mark.usefixtures("in_process")
def test_a_video_that_cannot_be_read_is_refused_in_one_line(
    rendered: Path, started: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By every command that takes photographs; beside photographs it does not matter."""
    Path("clips").mkdir()
    for name in ("Flug über Köln.MP4", "v.avi"):
        Path("clips", name).write_bytes(bytes(1_244_590))
    for command, words in (
        ("run", "not a video that can be read"),
        ("init", "not a video that can be read"),
        ("mark", "a video; kolinear init 'clips/Flug über Köln.MP4'"),
        ("adjust", "a video; kolinear init 'clips/Flug über Köln.MP4'"),
    ):
        for given in (
            ("clips/Flug über Köln.MP4", "clips") if command != "adjust" else ("clips/Flug über Köln.MP4",)
        ):
            said = refused(capsys, command, given)
            assert words in said and "1000000" not in said
    assert kolinear("batch", "clips/v.avi") == 1
    assert "not a video that can be read" in capsys.readouterr().out
    shutil.copytree(rendered, "photos")
    shutil.copy("clips/v.avi", "photos/v.avi")
    assert kolinear("init", "photos") == 0
