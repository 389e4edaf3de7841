"""An unforeseen error is one line and exit code 70, in every command and in a batch; never 1."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import cv2
import pytest

from sfm.cli.app import COMMANDS
from sfm.model.errors import KolinearError
from sfm.products.batch.run import run_batch
from sfm.report.output import read_log
from sfm.runtime import compiling
from sfm.runtime.faults import error_in_words, is_fault, working_on
from tests.commands import command_of, kolinear
from tests.engines import ALONE, HERE, PLOTLESS, Notes
from tests.places import ROOT
from tests.surveys import write_observed_survey, write_photograph_survey

POINTS = """point,X,Y,Z,x_mm,y_mm
1,-1,-1,0,-10,-10
2,1,-1,0,10,-10
3,1,1,0,10,10
4,-1,1,0,-10,10
5,0,0.5,0.5,0,6.667
6,0.5,0,0.5,6.667,0
"""


def line_of(words: str) -> tuple[str, ...]:
    """Return a command with 1 for each of its required arguments."""
    line = words.split()
    for parameter in command_of(words).params:
        if parameter.required:
            line += ["1"] if parameter.param_type_name == "argument" else [parameter.opts[0], "1"]
    return tuple(line)


@pytest.fixture(autouse=True)
def compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "when_compiling", lambda _: nullcontext())


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, list[str]]:
    """Run the command and return its exit code and the lines on stderr."""
    return kolinear(*arguments), capsys.readouterr().err.splitlines()


def raising(error: Exception) -> Callable[..., NoReturn]:
    def fail(*_: Any, **__: Any) -> NoReturn:
        raise type(error)(*error.args)

    return fail


@pytest.mark.parametrize("words", [command.words for command in COMMANDS])
def test_what_nobody_has_foreseen_is_one_line_with_its_traceback_in_a_file(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    for name, module in list(sys.modules.items()):
        if name.startswith("sfm.cli.") and hasattr(module, "loading"):
            monkeypatch.setattr(module, "loading", raising(ValueError("new\nline \x1b[31m")))
    code, lines = run(capsys, *line_of(words))
    (path,) = tmp_path.iterdir()
    assert code == 70
    told = "kolinear: a fault of Kolinear: ValueError: new line  [31m (test_exit_codes.py, line "
    assert len(lines) == 1 and lines[0].startswith(told)
    assert lines[0].endswith(f"; its traceback is in {path}")
    text = path.read_text(encoding="utf-8")
    assert "Traceback (most recent call last)" in text and "ValueError: new\nline" in text
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_traceback_that_cannot_be_kept_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tempfile.tempdir", "/nowhere")
    monkeypatch.setattr("sfm.cli.commands.compare.loading", raising(KeyError("x")))
    code, (line,) = run(capsys, "compare", "a", "b")
    assert code == 70 and line.endswith("; its traceback cannot be written")


@pytest.mark.parametrize("error", [MemoryError("Unable to allocate 64.0 PiB"), MemoryError()])
def test_memory_that_is_not_enough_says_for_which_photograph(
    error: MemoryError, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    survey = write_photograph_survey(tmp_path / "survey", "huge", photographs=2)
    monkeypatch.setattr("sfm.survey.measuring.targets.find_targets", raising(error))
    code, (line,) = run(capsys, "run", survey, "--out", tmp_path / "out", "--jobs", 1)
    own = f" ({error})" if str(error) else ""
    assert line == f"kolinear: not enough memory for photograph photo 1.png, stage targets, {survey}{own}"
    assert code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["survey"]


def test_memory_that_is_not_enough_says_for_which_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("adapters.formats.registry.read_comparable", raising(MemoryError()))
    code, lines = run(capsys, "compare", "a result", "b")
    assert (code, lines) == (2, ["kolinear: not enough memory for a result"])


def test_memory_that_opencv_does_not_get_is_no_fault() -> None:
    refused = cv2.error("OpenCV(5) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate")
    refused.code = -4
    with pytest.raises(cv2.error) as caught, working_on("photograph a"):
        raise refused
    assert error_in_words(caught.value).startswith("not enough memory for photograph a (OpenCV")


@pytest.mark.parametrize(
    "refused",
    [
        ImportError("libavcodec.so: failed to map segment from shared object"),
        ImportError("libopenblas.so: cannot allocate memory in static TLS block"),
        RuntimeError("can't start new thread"),
    ],
)
def test_libraries_and_threads_without_memory_are_no_fault(refused: Exception) -> None:
    assert error_in_words(refused) == f"not enough memory ({refused})" and not is_fault(refused)
    with pytest.raises(RuntimeError) as caught:
        try:
            raise refused
        finally:
            raise RuntimeError("cannot join thread before it is started")
    assert not is_fault(caught.value)
    assert is_fault(ImportError("no module named x")) and is_fault(RuntimeError("x"))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of address space")
def test_a_limit_of_memory_ends_in_one_line() -> None:
    limited = f"ulimit -v 600000; exec {sys.executable} -m sfm.cli adjust nowhere.toml"
    done = subprocess.run(["sh", "-c", limited], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 2 and done.stderr.splitlines()[-1].startswith("kolinear: not enough memory")


def test_errors_of_kolinear_are_reported_as_they_are() -> None:
    with pytest.raises(KolinearError) as caught, working_on("photograph a"):
        raise KolinearError("what was needed")
    assert error_in_words(caught.value) == "what was needed" and not hasattr(caught.value, "__notes__")


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize(
    "place",
    [
        "survey.sources.targets.measure_photograph",
        "products.batch.run.read_survey",
        "products.batch.run.fingerprint",
    ],
)
def test_a_fault_in_one_survey_of_a_batch_fails_it_alone(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Wherever it comes up: with a photograph, before the survey is sent to a worker."""
    first = write_photograph_survey(tmp_path / "faulty", "faulty", photographs=2)
    second = write_observed_survey(tmp_path / "sound", "sound")

    def fails(real: Callable[..., Any]) -> Callable[..., Any]:
        def maybe(what: Any, *more: Any, **named: Any) -> Any:
            if "faulty" in str(getattr(what, "path", what)):
                raise ZeroDivisionError("nobody thought of it")
            return real(what, *more, **named)

        return maybe

    module, name = f"sfm.{place}".rsplit(".", 1)
    faulty = fails(getattr(import_module(module), name))
    monkeypatch.setattr(f"{module}.{name}", faulty)
    if name == "measure_photograph":  # as the survey itself does, once more
        monkeypatch.setattr("sfm.survey.measuring.targets.measure_photograph", faulty)
    out = tmp_path / "out"
    code, _ = run(capsys, "batch", first, second, "--out", out)
    assert code == 70
    assert (out / "sound" / "report.html").exists() and not (out / "faulty").exists()
    (log,) = (out / "logs").iterdir()
    last = read_log(log)[-1]
    assert last["event"] == "failed" and "ZeroDivisionError: nobody thought of it\n" in last["trace"]
    rows = run_batch([first, second], out, HERE, ALONE, Notes())
    assert [row.status for row in rows] == ["failed", "done"] and rows[0].fault and not rows[1].fault
    assert "a fault of Kolinear: ZeroDivisionError: nobody thought of it (test_exit" in rows[0].reason
    assert rows[0].reason.endswith(f"; its traceback is in logs/{log.name}")


READER_GONE = "import sys; sys.argv[0] = 'kolinear'; from sfm.cli import main; main()"


def without_reader(*arguments: object, stdout: bool = True, stderr: bool = False) -> tuple[int, str, str]:
    """Run the command with outputs that no one reads any more."""
    reader, writer = os.pipe()
    os.close(reader)
    run = subprocess.run(
        [sys.executable, "-c", PLOTLESS if arguments[0] == "adjust" else READER_GONE, *map(str, arguments)],
        cwd=ROOT,
        stdout=writer if stdout else subprocess.PIPE,
        stderr=writer if stderr else subprocess.PIPE,
        text=True,
        timeout=300,
        check=False,
    )
    os.close(writer)
    return run.returncode, run.stdout or "", run.stderr or ""


def test_a_reader_that_ends_early_is_no_error(tmp_path: Path) -> None:
    survey = write_observed_survey(tmp_path / "survey", "unread")
    points = tmp_path / "points.csv"
    points.write_text(POINTS, encoding="utf-8")
    for arguments in (
        ("--help",),
        ("resect", points, "--c", 20),
        ("adjust", survey, "--out", tmp_path / "out"),
    ):
        assert without_reader(*arguments) == (141, "", ""), arguments
    assert (tmp_path / "out" / "report.html").exists()


def test_a_reader_of_errors_that_ends_early_changes_nothing(tmp_path: Path) -> None:
    code, told, _ = without_reader("compare", tmp_path, tmp_path, stdout=False, stderr=True)
    assert (code, told) == (2, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has a disk that is always full")
def test_a_full_disk_under_the_output_is_one_line() -> None:
    with Path("/dev/full").open("w") as full:
        run = subprocess.run(
            [sys.executable, "-c", READER_GONE, "--help"],
            cwd=ROOT,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=300,
            check=False,
        )
    assert (run.returncode, run.stderr) == (2, "kolinear: No space left on device\n")
