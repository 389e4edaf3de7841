"""The command line as a person meets it: a survey that works, and one clear line for all that does not."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from sfm.cli import app, process
from sfm.products.rendering.render import write_photographs
from sfm.products.rendering.scene_file import read_scene
from sfm.report.output import write_result
from sfm.runtime import compiling
from tests.commands import kolinear, refused
from tests.engines import PLOTLESS
from tests.places import ROOT
from tests.surveys import write_observed_survey
from tests.tables import rows_of

SLOW = pytest.mark.slow
SURVEY = """\
[survey]
name = "Plättchen 1"
unit = "mm"
[[camera]]
name = "kamera"
images = "*.jpg"
pixel_mm = [0.01, 0.01]
c_mm = 10.2
free = ["c", "x0", "y0", "K1"]
[targets]
polarity = "dark"
codes = "ring14"
[[scale_bar]]
from = "1"
to = "8"
length = 150.0
sigma = 0.01
[adjust]
sigma_px = 0.03
[compare]
backend = "{backend}"
"""
SCENE = """\
[scene]
photographs = "bild é {{:d}}.jpg"
codes = "ring14"
seed = 1
[camera]
model = "brown"
size_px = [800, 600]
pixel_mm = [0.01, 0.01]
c_mm = 10.0
[camera.values]
x0 = 0.05
K1 = 4e-4
[optics]
noise = 0.005
[[face]]
name = "plate"
centre = [0.0, 0.0, 0.0]
a = [1.0, 0.0, 0.0]
b = [0.0, 1.0, 0.0]
size = [220.0, 160.0]
reflectance = 0.8
[[face.grid]]
first = [-75.0, -60.0]
step = [30.0, 30.0]
count = [6, 5]
radius = 3.0
reflectance = 0.05
codes = [1, 0, 2, 0, 0, 8, 0, 9, 0, 3, 0, 0, 0, 0, -1, -1, 0, 4, 5, 0, -1, -1, 10, 0, 0, 6, 0, 0, 0, 7]
[[face]]
name = "step"
centre = [15.0, 15.0, 30.0]
a = [1.0, 0.0, 0.0]
b = [0.0, 1.0, 0.0]
size = [46.0, 46.0]
reflectance = 0.8
[[face.grid]]
first = [-13.0, -13.0]
step = [26.0, 26.0]
count = [2, 2]
radius = 3.0
reflectance = 0.05
codes = [0, 11, 0, 0]
{stations}
"""


@pytest.fixture(autouse=True)
def compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiling is not reported, whether or not this is the first run after a change."""
    monkeypatch.setattr(compiling, "when_compiling", lambda _: nullcontext())


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of six rendered photographs of a plate with a step, and the truth."""
    folder = tmp_path_factory.mktemp("photographs")
    stations = ""
    for k in range(6):
        x, y = 260 * np.cos(k * np.pi / 3), 260 * np.sin(k * np.pi / 3)
        stations += (
            f"[[station]]\nposition = [{x:.3f}, {y:.3f}, 330.0]\n"
            f"look_at = [0.0, 0.0, 0.0]\nroll_deg = {70.0 * k}\n"
        )
    scene = folder / "scene.toml"
    scene.write_text(SCENE.format(stations=stations), encoding="utf-8")
    write_photographs(read_scene(scene), folder)
    return folder


@pytest.fixture
def survey(tmp_path: Path, photographs: Path) -> Path:
    """A survey file beside copies of the photographs, without comparison."""
    for path in photographs.glob("*.jpg"):
        shutil.copy(path, tmp_path)
    path = tmp_path / "survey.toml"
    path.write_text(SURVEY.format(backend="none"), encoding="utf-8")
    return path


def coded_points(path: Path) -> dict[int, np.ndarray]:
    """Return the coordinates of the coded points of a table by code."""
    return {
        int(row["code"]): np.array([float(row[c]) for c in "XYZ"])
        for row in rows_of(path)
        if row["code"] not in ("", "-1")
    }


def test_a_survey_from_photographs_to_report(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, photographs: Path, plots: None
) -> None:
    path = tmp_path / "survey.toml"
    path.write_text(SURVEY.format(backend="colmap"), encoding="utf-8")
    out = tmp_path / "result 1"
    code = kolinear("run", path, "--images", photographs, "--out", out, "--jobs", 2, "-v")
    shown = capsys.readouterr()
    assert code == 0, shown.err
    assert shown.err == ""
    assert "6 of 6 photographs oriented" in shown.out
    assert "sigma0" in shown.out and " px" in shown.out
    assert f"Report: {out / 'report.html'}" in shown.out
    assert "bild é 1.jpg" in shown.out
    text = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert text["survey"] == "Plättchen 1"
    assert text["points"]["coded"] == 11
    assert text["points"]["total"] == 30
    assert text["comparison"]["agree"] is True
    assert text["converged"] is True
    assert (out / "overlays" / "bild é 1.jpg").is_file()
    assert list((out / "colmap").iterdir()) and len(list((out / "plots").glob("*.png"))) == 6

    place = coded_points(photographs / "truth_points.csv")
    found = coded_points(out / "points.csv")
    assert place.keys() == found.keys()
    codes = sorted(place)
    a = np.array([[np.linalg.norm(place[i] - place[j]) for i in codes] for j in codes])
    b = np.array([[np.linalg.norm(found[i] - found[j]) for i in codes] for j in codes])
    # The bar is good to 0.01 mm in 150 mm; 0.02 px in a picture of 0.4 mm a pixel are 0.01 mm.
    np.testing.assert_allclose(a, b, atol=0.06)


def test_a_second_run_replaces_the_first_and_nothing_else(
    capsys: pytest.CaptureFixture[str], survey: Path
) -> None:
    out = survey.parent / "out"
    out.mkdir()
    (out / "thesis.doc").touch()
    line = refused(capsys, "run", survey, "--out", out)
    assert "contains 'thesis.doc'" in line
    assert list(out.iterdir()) == [out / "thesis.doc"]


def test_photographs_that_cannot_be_read_do_not_stop_the_others(
    capsys: pytest.CaptureFixture[str], survey: Path
) -> None:
    whole = (survey.parent / "bild é 1.jpg").read_bytes()
    (survey.parent / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    (survey.parent / "text.jpg").write_text("no photograph", encoding="utf-8")
    out = survey.parent / "out"
    assert kolinear("run", survey, "--out", out) == 0
    shown = capsys.readouterr()
    assert "6 of 6 photographs oriented" in shown.out
    assert "cut.jpg: Not readable: the file is truncated" in shown.out
    text = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert [failed["image"] for failed in text["images"]["failed"]] == ["cut.jpg", "text.jpg"]
    assert text["images"]["total"] == 6
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "cut.jpg" in page and "truncated" in page


def test_fewer_than_two_orientable_photographs(capsys: pytest.CaptureFixture[str], survey: Path) -> None:
    for k in range(2, 7):
        (survey.parent / f"bild é {k}.jpg").unlink()
    out = survey.parent / "out"
    assert "1 readable photograph" in refused(capsys, "run", survey, "--out", out)
    blank = np.full((600, 800), 200, dtype=np.uint8)
    for k in range(2, 5):
        cv2.imencode(".jpg", blank)[1].tofile(survey.parent / f"blank {k}.jpg")
    assert not out.exists()
    assert kolinear("run", survey, "--out", out) == 1
    assert "no two photographs have 4 coded targets in common" in capsys.readouterr().out
    assert (out / "report.html").is_file()


def test_wrong_survey_files(capsys: pytest.CaptureFixture[str], survey: Path) -> None:
    survey.write_text(survey.read_text(encoding="utf-8").replace("unit =", "units =", 1), encoding="utf-8")
    assert "survey.toml, line 3: unknown key 'units' in [survey]" in refused(capsys, "run", survey)


def test_no_survey_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert "none.toml: neither a survey file nor a folder" in refused(capsys, "run", "none.toml")


def test_what_is_no_folder_is_said_and_the_nearest_name_is_offered(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "one.jpg").touch()
    for command in ("run", "init"):
        assert f"mean {tmp_path / 'photos'}?" in refused(capsys, command, tmp_path / "fotos")
        assert "mean" not in refused(capsys, command, tmp_path / "else.where")
    assert "is a file" in refused(capsys, "init", tmp_path / "one.jpg")
    assert "is a photograph" in refused(capsys, "run", tmp_path / "one.jpg")


def test_run_and_adjust_know_their_surveys(capsys: pytest.CaptureFixture[str], survey: Path) -> None:
    assert "kolinear run" in refused(capsys, "adjust", survey)
    text = survey.read_text(encoding="utf-8") + '[observations]\nfile = "image_points.csv"\n'
    survey.write_text(text, encoding="utf-8")
    assert "kolinear adjust" in refused(capsys, "run", survey)
    (survey.parent / "image_points.csv").write_text(
        "image,point,x_px,y_px\nphoto 1.png,1,5,5\n", encoding="utf-8"
    )
    line = refused(capsys, "adjust", survey)
    assert "kamera: size_px = [width, height] is needed" in line


def test_usage_errors_are_one_line_with_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, "run")
    assert line == "kolinear: Missing argument 'SURVEY.toml|PHOTOS|VIDEO' (see kolinear run --help)"
    assert "--jobs" in refused(capsys, "run", "a.toml", "--jobs", "0")
    assert "No such command 'fly'" in refused(capsys, "fly")
    assert "No such option: --bogus" in refused(capsys, "run", "a.toml", "--bogus")


def test_no_command_says_how_to_begin(capsys: pytest.CaptureFixture[str]) -> None:
    assert kolinear() == 2
    told = capsys.readouterr().err
    assert "kolinear run PHOTOS" in told and "kolinear --help" in told and len(told.splitlines()) < 12
    assert max(map(len, told.splitlines())) <= 80
    assert kolinear("run", "--help") == 0
    assert "Exit code 0" in capsys.readouterr().out


def test_a_result_that_cannot_be_depended_on_has_exit_code_1(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    survey = write_observed_survey(tmp_path / "s", "broken")
    good = tmp_path / "good"
    assert kolinear("adjust", survey, "--out", good, "-v") == 0
    shown = capsys.readouterr().out
    assert "global test" in shown and "including the report" in shown
    text = survey.read_text(encoding="utf-8").replace('free = ["c"]', "free = []")
    survey.write_text(text.replace("c_mm = 10.0", "c_mm = 11.0"), encoding="utf-8")
    bad = tmp_path / "bad"
    assert kolinear("adjust", survey, "--out", bad) == 1
    shown = capsys.readouterr()
    assert "The survey has no dependable result." in shown.out and shown.err == ""
    assert "Sigma0 is" in shown.out
    text = json.loads((bad / "summary.json").read_text(encoding="utf-8"))
    assert text["verdict"]["level"] == "bad"
    assert (bad / "report.html").is_file()


def test_the_time_counts_the_report(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    survey = write_observed_survey(tmp_path / "s", "time")

    def slow(*arguments: object, **options: object) -> Path:
        time.sleep(1.5)
        return write_result(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr("sfm.report.output.write_result", slow)
    assert kolinear("adjust", survey, "--out", tmp_path / "out") == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("time"))
    stages = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))["seconds"]
    assert float(line.split()[1]) > sum(stages.values()) + 1.4


def test_compiling_is_reported_when_it_happens_and_only_then(tmp_path: Path) -> None:
    text = "from numba import njit\n@njit(cache=True)\ndef f(x):\n    return x\n"
    (tmp_path / "kernel.py").write_text(text, encoding="utf-8")
    code = (
        "import importlib.util, sys\n"
        "from sfm.cli.process import loading, stopped_once\n"
        "spec = importlib.util.spec_from_file_location('sfm.kernel', 'kernel.py')\n"
        "kernel = sys.modules['sfm.kernel'] = importlib.util.module_from_spec(spec)\n"
        "with stopped_once():\n"
        "    with loading():\n"
        "        spec.loader.exec_module(kernel)\n"
        "    kernel.f(1.0); kernel.f(1)\n"
    )
    for told in (1, 0):
        run = subprocess.run(
            [sys.executable, "-c", code],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=True,
        )
        assert run.stderr.count("python -m sfm.cli.warm_up") == run.stderr.count("\n") == told


def test_ctrl_c_is_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], survey: Path
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sfm.pipeline.run_survey", interrupt)
    assert kolinear("run", survey, "--out", survey.parent / "out") == 130
    assert "Traceback" not in capsys.readouterr().err
    assert not (survey.parent / "out").exists()


def test_adjust_runs_on_the_tables_of_a_result(capsys: pytest.CaptureFixture[str], survey: Path) -> None:
    out = survey.parent / "out"
    assert kolinear("run", survey, "--out", out) == 0
    text = survey.read_text(encoding="utf-8").replace("pixel_mm", "size_px = [800, 600]\npixel_mm")
    text += f'[observations]\nfile = "{out.name}/image_points.csv"\n'
    text += f'[approximate]\nimages = "{out.name}/images.csv"\npoints = "{out.name}/points.csv"\n'
    survey.write_text(text, encoding="utf-8")
    again = survey.parent / "again"
    capsys.readouterr()
    assert kolinear("adjust", survey, "--out", again) == 0, capsys.readouterr().err
    first = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    second = json.loads((again / "summary.json").read_text(encoding="utf-8"))
    c = [text["cameras"][0]["parameters"]["c"] for text in (first, second)]
    assert abs(c[0]["value"] - c[1]["value"]) < 3 * c[0]["sigma"]


def test_the_version_is_printed() -> None:
    found = CliRunner().invoke(app.app, ["--version"])
    assert found.exit_code == 0 and found.output.startswith(f"kolinear {version('kolinear')}, Python 3.")


def test_help_explains_every_command_and_option() -> None:
    shown = subprocess.run(
        [sys.executable, "-c", "from sfm.cli import main; main()", "--help"],
        env={**os.environ, "COLUMNS": "80"},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    listed = shown[shown.index("Measure:") :]
    assert "..." not in listed
    for row in app.COMMANDS:
        section = listed[listed.index(f"{row.task}:") :].partition("\n\n")[0]
        assert f"\n  {row.words.partition(' ')[0]} " in section, row.words
    for command in app.app.registered_commands:
        assert command.callback is not None and command.callback.__doc__


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_shell_completes_commands_and_options(shell: str) -> None:
    def ask(words: str, instruction: str) -> str:
        typed = (
            {"_TYPER_COMPLETE_ARGS": words} if shell == "zsh" else {"COMP_WORDS": words, "COMP_CWORD": "1"}
        )
        run = subprocess.run(
            [sys.executable, "-c", "from sfm.cli import main; main()"],
            env={**os.environ, "_KOLINEAR_COMPLETE": f"{instruction}_{shell}", **typed},
            capture_output=True,
            text=True,
            check=False,
        )
        assert not run.stderr
        return run.stdout

    assert "calibrate" in ask("kolinear cal", "complete")
    assert "kolinear" in ask("", "source")


def test_messages_stay_on_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert f"{tmp_path}/a b [31m c.toml: " in refused(capsys, "run", tmp_path / "a\nb\x1b[31m\tc.toml")


def test_a_name_that_the_terminal_cannot_show_is_no_fault(tmp_path: Path) -> None:
    survey = write_observed_survey(tmp_path / "s", "\u6e2c\u91cf")
    out = tmp_path / "\u6e2c"
    run = subprocess.run(
        [sys.executable, "-c", PLOTLESS, "adjust", str(survey), "--out", str(out)],
        cwd=ROOT,
        env={**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"},
        capture_output=True,
        timeout=300,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert b"\\u6e2c" in run.stdout.splitlines()[-1]


def test_nothing_that_takes_time_is_imported_for_the_help() -> None:
    code = (
        "import sys; sys.argv[1:] = ['--help']\n"
        "import sfm.cli\n"
        "assert {'typer', 'importlib.metadata'}.isdisjoint(sys.modules), 'imported outside of main'\n"
        "try: sfm.cli.main()\n"
        "finally: print(*sys.modules, file=sys.stderr)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    heavy = {"numpy", "scipy", "numba", "cv2", "matplotlib", "dask", "pydantic", "pycolmap"}
    assert heavy.isdisjoint(run.stderr.split())


@pytest.mark.parametrize("seconds", [0.15, pytest.param(0.4, marks=SLOW), 0.8, pytest.param(1.2, marks=SLOW)])
def test_ctrl_c_while_modules_are_imported_is_one_line(tmp_path: Path, seconds: float) -> None:
    running = subprocess.Popen(
        [sys.executable, "-c", "print(1, flush=True); from sfm.cli import main; main()", "batch", tmp_path],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert running.stdout is not None
    running.stdout.readline()
    time.sleep(seconds)
    running.send_signal(signal.SIGINT)
    running.send_signal(signal.SIGINT)  # as timeout does
    errors = running.communicate(timeout=60)[1]
    if running.returncode != 2:  # on a fast computer it has found by now that there are no surveys
        assert running.returncode == 130, errors
        assert errors == f"{process.INTERRUPTED_TEXT}\n"


@pytest.mark.parametrize(
    "asked",
    [
        {"_KOLINEAR_COMPLETE": "complete_bash", "COMP_WORDS": "kolinear ge", "COMP_CWORD": "1"},
        {"_KOLINEAR_COMPLETE": "complete_zsh", "_TYPER_COMPLETE_ARGS": "kolinear ge"},
    ],
)
def test_shells_complete_commands(asked: dict[str, str]) -> None:
    """What the scripts of `--install-completion` ask the program at the tab key."""
    asks = "import sys; sys.argv[0] = 'kolinear'; from sfm.cli import main; main()"
    told = subprocess.run(
        [sys.executable, "-c", asks], env=os.environ | asked, capture_output=True, text=True, timeout=60
    )
    assert "georeference" in told.stdout and "refine" not in told.stdout
