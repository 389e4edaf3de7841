"""A survey folder made by a stranger: no command writes through its links, or removes what is not ours."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from contextlib import nullcontext, redirect_stderr, redirect_stdout
from dataclasses import fields, replace
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import sfm.cli
import sfm.products.rendering.render
from adapters.colmap.camera_models import write_model
from adapters.colmap.database import read_database, write_database
from adapters.formats.cameras.registry import write_cameras
from adapters.formats.registry import FORMATS
from adapters.formats.result_tables import write_tables
from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.cli import app
from sfm.files.open_folders import locked
from sfm.files.whole_files import remove_leftovers, whole_file, whole_folder
from sfm.matching.tracks.interest import natural_points
from sfm.model.camera import camera_from_values
from sfm.model.camera_file import CameraFile
from sfm.model.errors import OutputError
from sfm.model.solution import Solution
from sfm.photographs.exif import Metadata, read_metadata
from sfm.products.batch.run import run_batch
from sfm.report.output import SurveyLog, folder_name, read_log
from sfm.runtime.compiling import COMPILING, sources_of
from sfm.survey.measuring.measured_store import TARGETS, TEXTURE, MeasuredStore
from sfm.targets.detect import Targets, find_targets
from tests import commands
from tests.engines import ALONE, HERE, Notes
from tests.places import ROOT
from tests.surveys import pictures, write_observed_survey, write_photograph_survey
from tests.synthetic import make_network, seed_of

OWN = "the user's own text\n"
SHELL = "x$(touch owned)"  # as the name of a survey: a line that a shell would run
pytestmark = pytest.mark.usefixtures("in_process")
Command = tuple[Callable[[Path], tuple[object, ...]], tuple[str, ...]]


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """The user's own folder, which nothing may change."""
    folder = tmp_path / "home"
    (folder / "below" / "result").mkdir(parents=True)
    for name in (".profile", "below/thesis.txt", "below/result/points.csv"):
        (folder / name).write_text(OWN, encoding="utf-8")
    return folder


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def kolinear(*arguments: object) -> int:
    if arguments[0] == "render":
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sys.argv", list(map(str, arguments)))
            return sfm.products.rendering.render.main()
    return commands.kolinear(*arguments)


def observed(folder: Path) -> Path:
    return write_observed_survey(folder / "s", "s")


def model(folder: Path) -> Path:
    network, estimate = make_network(seed_of("model"), model="opencv", images=4, points=20)
    write_model(folder / "model", network, estimate)
    return folder / "model"


def results(folder: Path) -> tuple[Path, Path]:
    """Tables of two results of one object."""
    for seed in (1, 2):
        network, truth = make_network(seed_of("results"), images=4, points=8, noise_px=0.0)
        seen = network.image_points
        noise = np.random.default_rng(seed).normal(0, 0.1, seen.xy.shape)
        network = replace(network, image_points=replace(seen, xy=seen.xy + noise))
        a = adjust(network, truth, datum=Datum("free"), reject="none")
        joint = marginal_of(a).joint(np.zeros(0, dtype=np.int64), np.arange(8))
        found = Solution(
            *("r", network, a.estimate, a.covariance.points, None, None, a.redundancy, "m", joint, "free")
        )
        write_tables(folder / f"r{seed}", found)
    return folder / "r1", folder / "r2"


def photographs(folder: Path) -> tuple[Path, Path]:
    for k in (0, 1):
        cv2.imwrite(str(folder / f"{k}.png"), np.rint(pictures()[0]).astype(np.uint8))
    return folder / "0.png", folder / "1.png"


def lenses(folder: Path) -> tuple[Path, Path]:
    """Two files of a camera with photographs of the size of those above."""
    height, width = pictures()[0].shape
    camera = camera_from_values("left", "opencv", (width, height), (0.01, 0.01), c_mm=10.0)
    for name in ("1.cameramodel", "2.cameramodel"):
        write_cameras(folder / name, "mrcal-camera", CameraFile(name, (camera,), (None,)))
    return folder / "1.cameramodel", folder / "2.cameramodel"


def coordinates(folder: Path, *, moved: float = 0.0) -> Path:
    """A table of points with measured, calibrated and object coordinates, seen from a place 10 away."""
    path, lines = folder / f"points {moved:g}.csv", ["point,mark,x,y,x_mm,y_mm,X,Y,Z"]
    for k, (X, Y, Z) in enumerate(seed_of("orient").uniform(-3, 3, (9, 3)).tolist()):
        x, y = 50 * (X - moved) / (10 - Z), 50 * Y / (10 - Z)
        lines.append(",".join(map(str, (k, k, x, y, x, y, X, Y, Z))))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def flat(folder: Path) -> Path:
    """Control points of a plane in a photograph."""
    path = folder / "flat.csv"
    path.write_text("point,x_px,y_px,X,Y\na,10,90,0,0\nb,90,90,8,0\nc,90,10,8,8\nd,10,10,0,8\n")
    return path


def scene(folder: Path) -> Path:
    """A scene file of a single photograph, small and dark."""
    path = folder / "scene.toml"
    path.write_text(
        '[scene]\nphotographs = "p{}.jpg"\n'
        '[camera]\nmodel = "brown"\nsize_px = [64, 48]\npixel_mm = [0.1, 0.1]\nc_mm = 8.0\n'
        '[[face]]\nname = "wall"\ncentre = [0, 0, 0]\na = [1, 0, 0]\nb = [0, 1, 0]\nsize = [10, 10]\n'
        "reflectance = 0.5\n"
        "[[station]]\nposition = [0, 0, 20]\nlook_at = [0, 0, 0]\n",
        encoding="utf-8",
    )
    return path


def marks_of_others(folder: Path) -> Path:
    path = folder / "gcp_list.txt"
    path.write_text("WGS84 UTM 32N\n0 0 0 10 10 0.png a\n0 0 0 12 10 1.png a\n", encoding="utf-8")
    return path


def lengths(folder: Path) -> Path:
    path = folder / "lengths.csv"
    path.write_text("line,from,to,length,sigma\n1,1,2,1,0.001\n", encoding="utf-8")
    return path


def plan(folder: Path) -> Path:
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        assert commands.kolinear("plan", "network", "plate:1000,700", *PLANNED, "--out", folder / "plan") == 0
    return folder / "plan"


PLANNED = (
    "--camera",
    "full-frame-24",
    "--c-mm",
    28,
    "--sigma-px",
    0.05,
    "--stations",
    "ring:5",
    "--points",
    12,
)
COMMANDS: dict[str, Command] = {
    "adjust": (lambda f: ("adjust", observed(f)), ("out", "out/s", "out/.s.lock")),
    "calibrate": (lambda f: ("calibrate", observed(f)), ("out", "out/s", "out/.s.lock")),
    "run": (
        lambda f: ("run", write_photograph_survey(f / "s", "s", photographs=3)),
        ("out", "out/s", "out/.s.lock"),
    ),
    "batch": (
        lambda f: ("batch", observed(f), "--jobs", 1),
        (
            *("out", "out/batch", "out/batch/.lock", "out/batch/.s.lock", "out/batch/s", "out/batch/logs"),
            *(
                "out/batch/logs/s.jsonl",
                "out/batch/index.html",
                "out/batch/batch.json",
                "out/batch/batch.csv",
            ),
            "out/batch/manifest.json",
        ),
    ),
    "targets": (lambda f: ("targets", "--out", "new/a.pdf", "--ids", "1"), ("new", "new/a.pdf")),
    "match": (
        lambda f: (
            "match",
            *photographs(f),
            "--point",
            "100,100",
            "--out",
            "new/a.csv",
            "--picture",
            "new/a.png",
        ),
        ("new", "new/a.csv", "new/a.png"),
    ),
    "orient fiducials": (
        lambda f: ("orient", "fiducials", coordinates(f), "--points", coordinates(f), "--out", "new/a.csv"),
        ("new", "new/a.csv"),
    ),
    "orient correct": (
        lambda f: ("orient", "correct", coordinates(f), "--c", 50, "--out", "new/a.csv"),
        ("new", "new/a.csv"),
    ),
    "orient pair": (
        lambda f: (
            "orient",
            "pair",
            coordinates(f),
            coordinates(f, moved=1.0),
            "--c",
            50,
            "--out",
            "new/a.csv",
        ),
        ("new", "new/a.csv"),
    ),
    "orient absolute": (
        lambda f: ("orient", "absolute", coordinates(f), coordinates(f), "--out", "new/a.csv"),
        ("new", "new/a.csv"),
    ),
    "georeference": (
        lambda f: ("georeference", photographs(f)[0], flat(f), "--out", "new/a.png"),
        ("new", "new/a.png", "new/a.pgw"),
    ),
    "audit": (lambda f: ("audit", model(f)), ("out", "out/model_audit", "out/.model_audit.lock")),
    "compare": (
        lambda f: ("compare", model(f), f / "model"),
        ("out", "out/comparison", "out/.comparison.lock"),
    ),
    "compare cameras": (
        lambda f: ("compare", *lenses(f)),
        ("out", "out/comparison", "out/.comparison.lock"),
    ),
    "undistort": (
        lambda f: ("undistort", lenses(f)[0], photographs(f)[0]),
        ("out", "out/undistorted", "out/.undistorted.lock"),
    ),
    "epochs": (
        lambda f: ("epochs", *results(f)),
        ("out", "out/epochs", "out/.epochs.lock"),
    ),
    "plan network": (
        lambda f: ("plan", "network", "plate:1000,700", *PLANNED),
        ("out", "out/plan", "out/.plan.lock"),
    ),
    "plan simulate": (lambda f: ("plan", "simulate", plan(f)), ("out", "out/simulation")),
    "plan more": (lambda f: ("plan", "more", results(f)[0]), ("out", "out/more")),
    "measure": (lambda f: ("measure", results(f)[0]), ("out", "out/measurement")),
    "accept": (
        lambda f: ("accept", results(f)[0], lengths(f), "--limit-a", 1),
        ("out", "out/acceptance"),
    ),
    "refine": (lambda f: ("refine", model(f), "--images", f, "--out", "new/a"), ("new", "new/a")),
    "render": (
        lambda f: ("render", scene(f), "new/a"),
        ("new", "new/a", "new/a/p1.jpg", "new/a/truth_points.csv", "new/a/manifest.json"),
    ),
    "init": (
        lambda f: ("init", photographs(f)[0].parent, "--out", "new/a.toml"),
        ("new", "new/a.toml"),
    ),
    "init beside the photographs": (lambda f: ("init", photographs(f)[0].parent), ("survey.toml",)),
    "run of a folder": (
        lambda f: ("run", photographs(f)[0].parent, "--out", "new/out/s"),
        ("new",),
    ),
    "mark": (
        lambda f: (
            *("mark", photographs(f)[0].parent, "--import", marks_of_others(f)),
            *("--out", "new/marks.csv", "--export", "new/a.xml"),
        ),
        ("new", "new/marks.csv", "new/a.xml"),
    ),
    "view": (lambda f: ("view", model(f), "--no-open", "--out", "new/a.html"), ("new", "new/a.html")),
    "view beside the model": (lambda f: ("view", model(f), "--no-open"), ("model.html",)),
    "convert to a file": (lambda f: ("convert", model(f), "new/a.xml"), ("new", "new/a.xml")),
    "convert to a database": (lambda f: ("convert", model(f), "new/a.db"), ("new", "new/a.db")),
    "convert to a camera": (
        lambda f: ("convert", lenses(f)[0], "new/a.yaml", "--to", "ros-camera"),
        ("new", "new/a.yaml"),
    ),
    "convert to a folder": (lambda f: ("convert", model(f), "new/a"), ("new", "new/a")),
}


def test_every_command_that_writes_is_here() -> None:
    """Each command of the app with an option --out."""
    for row in app.COMMANDS:
        writes = any("--out" in parameter.opts for parameter in commands.command_of(row.words).params)
        listed = any(f"{name} ".startswith(f"{row.words} ") for name in COMMANDS)
        assert listed or not writes, row.words


@pytest.mark.parametrize("name", [".numba_config.yaml", "matplotlibrc"])
@pytest.mark.parametrize("command", ["adjust", "batch", "render"])
def test_settings_of_libraries_in_the_current_folder_are_refused(
    command: str,
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """numba takes compiled functions from the folder that its settings name, and they are pickles."""
    monkeypatch.chdir(tmp_path)
    arguments = COMMANDS[command][0](tmp_path)
    (tmp_path / name).symlink_to("nowhere")
    before = sorted(tmp_path.rglob("*"))
    assert kolinear(*arguments) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and f"contains '{name}', which would decide" in told
    assert sorted(tmp_path.rglob("*")) == before


def test_nothing_that_takes_settings_is_imported_before_the_folder_is_looked_at(tmp_path: Path) -> None:
    (tmp_path / ".numba_config.yaml").write_text("opt: no number\n")
    script = "import sys; from sfm.cli import main; sys.argv[1:] = ['doctor']; main()"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert run.returncode == 2
    assert run.stderr.startswith("kolinear: the current folder, ")


@pytest.mark.parametrize("place", ["new/out", "new/out/s.toml"])
def test_no_drafted_survey_is_read_or_written_through_a_link(
    place: str,
    home: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = COMMANDS["run of a folder"][0](tmp_path)
    (tmp_path / place).parent.mkdir(parents=True)
    (tmp_path / place).symlink_to(home if place == "new/out" else write_observed_survey(home / "x", "x"))
    before = content(home)
    assert kolinear(*arguments) == 2
    assert "is a link to" in capsys.readouterr().err and content(home) == before


def test_a_link_to_a_result_or_its_pictures_leads_no_page_out_of_the_folder(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The page stands beside the link, and shows no photographs from elsewhere."""
    result = model(home).rename(home / "below" / "model")
    photographs(home)
    before = content(home)
    given = tmp_path / "given"
    given.mkdir()
    (given / "model").symlink_to(result)
    assert kolinear("view", given / "model", "--no-open") == 0
    assert content(home) == before and (given / "model.html").is_file()
    seen: list[Path] = []
    monkeypatch.setattr("sfm.report.view_page.photographs_in", lambda folder, _: seen.append(folder) or {})
    shutil.copytree(result, given / "other")
    (given / "other" / "pictures").symlink_to(home)
    assert kolinear("view", given / "other", "--no-open") == 0
    assert seen == []
    capsys.readouterr()


def test_what_photographs_say_of_themselves_is_no_line_of_a_drafted_survey(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = tmp_path / "given"
    given.mkdir()
    photographs(given)
    (given / "2.png").symlink_to(photographs(home)[0])
    evil = "X\n[control]\nfile = 'x'\n\x1b[2J"

    def metadata(path: Path, real: Any = read_metadata) -> Metadata:
        return replace(real(path), make=evil, model=evil, focal_mm=24.0)

    monkeypatch.setattr("sfm.products.drafting.draft.read_metadata", metadata)
    monkeypatch.setattr("sfm.library.surveys.sensor_widths", lambda *_: lambda *_: 36.0)
    assert kolinear("init", given) == 0
    told = capsys.readouterr()
    assert "\x1b" not in told.err and "left out: 2.png: a link out of the folder" in told.err
    text = (given / "survey.toml").read_text(encoding="utf-8")
    assert "control" not in tomllib.loads(text) and "\x1b" not in text


def test_no_process_imports_modules_of_the_current_folder(tmp_path: Path) -> None:
    """Those of multiprocessing are started with `python -c`, which looks there first."""
    (tmp_path / "multiprocessing.py").write_text(f"open({str(tmp_path / 'owned')!r}, 'w').close()\n")
    script = tmp_path / "elsewhere" / "start.py"
    script.parent.mkdir()
    script.write_text(
        "from multiprocessing import get_context\n"
        "import sfm.cli.app\n"
        "def begin():\n"
        "    print('begun', flush=True)\n"
        "def app(**_):\n"
        "    one = get_context('spawn').Process(target=begin)\n"
        "    one.start(); one.join()\n"
        "if __name__ == '__main__':\n"
        "    sfm.cli.app.commands = lambda: app\n"
        "    sfm.cli.main()\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    environment["PYTHONPATH"] = str(ROOT)
    command = [sys.executable, str(script)]
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert run.stdout.splitlines()[-1] == "begun", run.stderr
    assert not (tmp_path / "owned").exists()


@pytest.mark.parametrize("dangling", [False, True])
@pytest.mark.parametrize(
    ("command", "place"), [(name, place) for name, (_, places) in COMMANDS.items() for place in places]
)
def test_no_command_writes_through_a_link(
    command: str,
    place: str,
    dangling: bool,
    home: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "given"
    folder.mkdir()
    monkeypatch.chdir(folder)
    arguments = COMMANDS[command][0](folder)
    is_file = "." in Path(place).name
    link = folder / place
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(home / "absent" if dangling else home / ".profile" if is_file else home / "below")
    before, names = content(home), sorted(home.rglob("*"))
    of_one_survey = place == "out/batch/s"  # which fails, the batch goes on
    assert kolinear(*arguments) == (1 if of_one_survey else 2)
    told = capsys.readouterr()
    said = told.out if of_one_survey else told.err
    refused = ("is a link to", "exists already", "already is a file", "of this name already", "exists a")
    assert link.name in said and any(words in said for words in refused), told
    lines = [line for line in told.err.splitlines() if COMPILING not in line]
    assert of_one_survey or (len(lines) == 1 and told.out == "")
    assert content(home) == before and sorted(home.rglob("*")) == names
    assert link.is_symlink()  # left alone


SHARED = ("out", "new", "out/batch", "out/batch/logs")  # folders that may hold other files, too
LATER = (("render", "new/a", "folder"), ("refine", "new", "file"))  # beside it; photographs come before it
NAMED = (
    "exists already",
    "cannot be",
    "contains '",
    "left alone",
    "exists",
    "has this name",
    "is a folder",
)


@pytest.mark.parametrize(
    ("command", "place", "kind"),
    [
        (name, place, kind)
        for name, (_, places) in COMMANDS.items()
        for place in places
        for kind in ("file", "folder")
        if (kind == "file" or place not in SHARED) and (name, place, kind) not in LATER
    ],
)
def test_no_command_writes_over_files_of_the_user(
    command: str,
    place: str,
    kind: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A file, or a folder with one in it, stands where the command line says or where a command writes."""
    folder = tmp_path / "given"
    folder.mkdir()
    monkeypatch.chdir(folder)
    arguments = COMMANDS[command][0](folder)
    mine = folder / place / "mine.txt" if kind == "folder" else folder / place
    mine.parent.mkdir(parents=True, exist_ok=True)
    mine.write_text(OWN)
    number = kolinear(*arguments)
    assert mine.read_text() == OWN
    told = capsys.readouterr()
    of_one_survey = place == "out/batch/s"  # which fails, the batch goes on
    assert number == (1 if of_one_survey else 2)
    said = told.out if of_one_survey else told.err
    assert Path(place).name in said and any(words in said for words in NAMED), told
    lines = [line for line in told.err.splitlines() if COMPILING not in line]
    assert of_one_survey or (len(lines) == 1 and told.out == "")
    left = [path for path in (folder / place).parent.iterdir() if path.name.endswith((".part", ".old"))]
    assert left == []


@pytest.mark.parametrize("form", [form.name for form in FORMATS])
def test_no_format_is_written_over_a_file_of_the_user(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given, mine = model(tmp_path), tmp_path / "mine.txt"
    mine.write_text(OWN)
    for target in (mine, given):
        assert kolinear("convert", given, target, "--to", form) == 2
        assert f"{target}: already exists and is left alone" in capsys.readouterr().err
    assert mine.read_text() == OWN


def test_photographs_that_were_rendered_are_replaced_and_no_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "survey.toml").write_text(OWN)
    for _ in range(2):
        assert kolinear("render", scene(tmp_path), out) == 0
    before = content(out)
    (out / "p1.jpg").write_text(OWN)
    assert kolinear("render", scene(tmp_path), out) == 2
    assert "contains 'p1.jpg', changed since Kolinear wrote it; " in capsys.readouterr().err
    assert content(out) == {**before, "p1.jpg": OWN.encode()}
    assert (out / "survey.toml").read_text() == OWN


@pytest.mark.parametrize("kind", ["link", "second name", "text"])
def test_a_log_that_came_with_the_folder_is_not_appended_to(kind: str, home: Path, tmp_path: Path) -> None:
    survey = write_observed_survey(tmp_path / "given", "s")
    survey.write_text(survey.read_text().replace('name = "s"', f'name = "{SHELL}"\nunknown = 1'))
    log = tmp_path / "given" / "out" / "logs" / f"{folder_name('given')}.jsonl"
    log.parent.mkdir(parents=True)
    if kind == "link":
        log.symlink_to(home / ".profile")
    elif kind == "second name":
        os.link(home / ".profile", log)
    else:
        log.write_text(OWN)
    with pytest.raises(OutputError, match=r"given\.jsonl: "):
        run_batch([survey], tmp_path / "given" / "out", HERE, ALONE, Notes())
    with pytest.raises(OutputError, match=r"given\.jsonl: "), SurveyLog(log, append=True):
        pass
    assert (home / ".profile").read_text() == OWN
    assert log.read_text() == OWN


@pytest.mark.parametrize("kind", ["second name", "text", "pipe"])
def test_a_lock_that_came_with_the_folder_is_not_written(kind: str, home: Path, tmp_path: Path) -> None:
    lock = tmp_path / ".s.lock"
    if kind == "second name":
        os.link(home / ".profile", lock)
    elif kind == "text":
        lock.write_text(OWN)
    else:
        os.mkfifo(lock)
    with pytest.raises(OutputError, match=r"\.s\.lock: is (not a regular|not a lock of)"), locked(lock):
        pass
    assert (home / ".profile").read_text() == OWN
    assert kind != "text" or lock.read_text() == OWN


@pytest.mark.parametrize("whole", [whole_file, whole_folder])
def test_names_that_are_known_before_are_not_used(
    whole: Callable[..., object], home: Path, tmp_path: Path
) -> None:
    """Links at what killed runs leave are neither followed nor taken for a result."""
    given = tmp_path / "given"
    given.mkdir()
    for ending in ("old", "part"):
        (given / f".s.abcdefgh.{ending}").symlink_to(home / "below")
    (given / ".s.mp4.part").mkdir()
    (given / ".s.ijklmnop.old").mkdir()
    (given / ".s.ijklmnop.old" / "result").symlink_to(home / "below")
    before = content(home)
    remove_leftovers(given / "s")
    assert content(home) == before
    assert not os.path.lexists(given / "s")
    assert (given / ".s.mp4.part").is_dir()
    (given / "s").symlink_to(home / ("below" if whole is whole_folder else ".profile"))
    with pytest.raises(OutputError, match="nothing is written through links"), whole(given / "s"):  # type: ignore[attr-defined]
        raise AssertionError
    assert content(home) == before


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a survey and its result."""
    folder = tmp_path_factory.mktemp("adjusted")
    survey = write_observed_survey(folder / "s", "s", backend="colmap")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sfm.report.figures.plot_process.plot_process", lambda _: nullcontext())
        patch.setattr("sfm.report.output.draw_plots", lambda _: [])
        assert kolinear("adjust", survey, "--out", folder / "out") == 0
    return folder


@pytest.fixture
def result(adjusted: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A survey and the folder of its result."""
    shutil.copytree(adjusted, tmp_path, dirs_exist_ok=True)
    return tmp_path / "s" / "survey.toml", tmp_path / "out"


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("plots/mine.png", "contains 'plots/mine.png'; "),
        ("overlays/notes/mine.jpg", "contains 'overlays/notes/mine.jpg'; "),
        ("colmap/project.ini", "contains 'colmap/project.ini'; "),
        ("points.csv", "contains 'points.csv', changed since Kolinear wrote it; "),
        ("report.html", "contains 'report.html', changed since Kolinear wrote it; "),
        ("manifest.json", "contains 'cameras.csv'; 'colmap/cameras.bin'; "),
        ("link", "contains 'link'; "),
    ],
)
def test_files_of_the_user_in_a_result_are_kept_and_named(
    name: str, told: str, result: tuple[Path, Path], home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    survey, out = result
    capsys.readouterr()
    path = out / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if name == "link":
        path.symlink_to(home / "below")
    else:
        path.write_text(OWN)
    before = content(out)
    assert kolinear("adjust", survey, "--out", out) == 2
    err = capsys.readouterr().err
    assert told in err and err.count("\n") == 1, err
    assert content(out) == before


def test_an_unchanged_result_is_replaced_though_a_system_has_left_its_files(
    result: tuple[Path, Path],
) -> None:
    survey, out = result
    manifest = json.loads((out / "manifest.json").read_text())["files"]
    assert manifest.keys() == content(out).keys() - {"manifest.json"}
    (out / "plots" / ".DS_Store").touch()
    (out / "points.ply").unlink()
    assert kolinear("adjust", survey, "--out", out) == 0
    assert (out / "points.ply").is_file()


def test_a_result_folder_of_a_stranger_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has all names of a result, and a user's file has one of them."""
    survey, out = observed(tmp_path), tmp_path / "out"
    (out / "plots").mkdir(parents=True)
    summary = {"survey": "s", "images": {}, "points": {}, "observations": {}}
    (out / "summary.json").write_text(json.dumps(summary))
    (out / "plots" / "holiday.png").write_text(OWN)
    assert kolinear("adjust", survey, "--out", out) == 2
    assert "contains 'plots/holiday.png'; 'summary.json'; " in capsys.readouterr().err
    assert (out / "plots" / "holiday.png").read_text() == OWN


@pytest.mark.sweep(0, 2)
@pytest.mark.parametrize("name", ["index.html", "batch.csv", "batch.json", "manifest.json"])
def test_pages_of_a_batch_that_a_person_has_changed_are_kept(name: str, tmp_path: Path) -> None:
    survey, out = observed(tmp_path), tmp_path / "out"
    for _ in range(2):
        run_batch([survey], out, HERE, ALONE, Notes())
    (out / name).write_text(OWN)
    told = (
        "'index.html' and 1 more; which"
        if name == "manifest.json"
        else f"'{name}', changed since Kolinear wrote it"
    )
    with pytest.raises(OutputError, match=told):
        run_batch([survey], out, HERE, ALONE, Notes())
    assert (out / name).read_text() == OWN


def test_targets_that_came_with_the_folder_are_not_believed(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All centres are stretched by 2 %, in a store where the program once kept its own."""
    survey = write_photograph_survey(tmp_path / "given" / "s", "s")
    monkeypatch.chdir(tmp_path / "given")
    out = tmp_path / "given" / "out" / "s"
    assert kolinear("run", survey) == 0
    true = (out / "points.csv").read_bytes()
    assert read_log(out / "log.jsonl")[-1]["stored_photographs"] == []
    kept = tmp_path / "given" / "out" / ".kolinear" / "targets"
    if not kept.is_dir():
        shutil.copytree(cache / "kolinear" / "measured", kept)
        shutil.rmtree(cache / "kolinear")
    for entry in kept.rglob("*.npz"):
        with np.load(entry) as found:
            arrays = {f.name: found[f.name] for f in fields(Targets)}
        arrays["xy"] = (arrays["xy"] - 300) * 1.02 + 300
        np.savez(entry, **arrays)
    assert kolinear("run", survey) == 0
    assert (out / "points.csv").read_bytes() == true
    assert kolinear("run", survey) == 0  # now from the user's own
    stored = read_log(out / "log.jsonl")[-1]["stored_photographs"]
    assert stored == [f"photo {k}.png" for k in range(1, 7)]
    assert (cache / "kolinear" / "measured").stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("fault", ["mode", "owner", "link"])
def test_a_store_that_others_can_write_is_refused(
    fault: str, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = cache / "kolinear" / "measured"
    folder.parent.mkdir()
    if fault == "link":
        (tmp_path / "other").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "other")
    else:
        folder.mkdir(mode=0o700)
    assert fault == "link" or MeasuredStore.of_user().folder == folder
    if fault == "mode":
        folder.chmod(0o770)
    elif fault == "owner":
        monkeypatch.setattr("os.geteuid", lambda: 12345)
    with pytest.raises(OutputError, match="measured points are kept here, but others may write here"):
        MeasuredStore.of_user()


def test_an_entry_that_is_too_large_to_be_read_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, found = MeasuredStore(tmp_path / "measured"), natural_points(np.zeros((64, 64), np.uint8))
    store.save("ab", found)
    assert store.load("ab", TEXTURE) is not None
    monkeypatch.setattr("sfm.survey.measuring.measured_store.MAX_ENTRY_BYTES", 100)
    store.save("cd", found)
    assert [path.name for path in (tmp_path / "measured").rglob("*.npz")] == ["ab.npz"]
    assert store.load("ab", TEXTURE) is None


def test_what_is_measured_is_known_by_what_measures() -> None:
    targets, texture = (sources_of(*kind.measuring).keys() for kind in (TARGETS, TEXTURE))
    assert {"sfm.photographs.reading", "sfm.targets.measure", "sfm.targets.codes.rings"} <= targets
    assert {"sfm.photographs.reading", "sfm.matching.tracks.features", "sfm.matching.radiometry"} <= texture
    elsewhere = ("sfm.products.printing", "sfm.products.rendering", "sfm.survey", "sfm.adjustment")
    assert not [name for name in targets | texture if name.startswith(elsewhere)]


def test_targets_travel_between_workers_that_have_no_common_store(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache.chmod(0o500)
    (cache / "kolinear").touch()  # root could write otherwise
    measured: list[int] = []
    monkeypatch.setattr(
        "sfm.survey.measuring.targets.find_targets",
        lambda *given, **options: measured.append(1) or find_targets(*given, **options),
    )
    survey = write_photograph_survey(tmp_path / "s", "s")
    (row,) = run_batch([survey], tmp_path / "out", HERE, ALONE, Notes())
    assert row.status == "done" and len(measured) == 6


def test_reading_a_database_writes_nothing_beside_it(tmp_path: Path) -> None:
    network, estimate = make_network(seed_of("database"), model="opencv", images=3, points=20)
    path = tmp_path / "a.db"
    write_database(path, network, estimate.cameras)
    before, when = content(tmp_path), path.stat().st_mtime_ns
    tmp_path.chmod(0o500)
    assert len(read_database(path)[0].images) == 3
    assert content(tmp_path) == before and path.stat().st_mtime_ns == when
    tmp_path.chmod(0o700)
