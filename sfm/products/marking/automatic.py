"""Everything else found automatically: the survey run with its marks, in a process of its own, to a report.

The survey file gets the table [marks] if it has none. For a folder of photographs it is drafted first.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sfm.files.open_folders import path_inside
from sfm.files.plain_text import read_toml
from sfm.files.whole_files import whole_file
from sfm.model.errors import KolinearError, SurveyFileError
from sfm.report.output import folder_name, path_from
from sfm.survey.inputs.survey import read_survey

KOLINEAR = (sys.executable, "-m", "sfm.cli")
STAGE = re.compile(r"[A-Za-z].*")
LONGEST = 300  # characters of a line that the page shows


@dataclass(frozen=True)
class Run:
    """A run of the survey with everything that can be found automatically."""

    state: str  # running | done | failed
    stage: str = ""
    report: str | None = None  # path of the report
    sentence: str = ""


class AutomaticRun:
    """A run of a survey with its marks."""

    def __init__(self, survey_file: Path | None, photographs: Path, marks: Path, name: str) -> None:
        """Take what is run.

        Args:
            survey_file: the survey file; None to draft one for the photographs.
            photographs: their folder.
            marks: the marks file.
            name: name of the survey.
        """
        self._file, self._photographs, self._marks = survey_file, photographs, marks
        self._out = Path("out") / folder_name(name)
        self._process: subprocess.Popen[str] | None = None
        self._stopped = False

    def run(self, tell: Callable[[Run], None], *, control: bool) -> None:
        """Run it, and tell how far it is.

        Args:
            tell: receives every change.
            control: whether control is stated, which a drafted survey then uses as its datum.
        """
        try:
            file = self._file
            if file is None:
                file = self._out.parent / f"{self._out.name}.toml"
                if not file.exists():
                    tell(Run("running", "drafting the survey file"))
                    status, last = self._call(["init", str(self._photographs), "--out", str(file)], tell)
                    if status:
                        tell(Run("failed", sentence=last))
                        return
                    if control:  # is its datum
                        text = file.read_text(encoding="utf-8")
                        with whole_file(file, replaces=True) as part:
                            part.write_text(text.replace('kind = "free"', 'kind = "control"', 1), "utf-8")
            name_marks(file, self._marks)
            tell(Run("running", "running the survey"))
            images = ["--images", str(self._photographs)]
            status, last = self._call(["run", str(file), *images, "--out", str(self._out)], tell)
        except (OSError, KolinearError) as error:
            tell(Run("failed", sentence=str(error)))
            return
        except Exception as error:  # else the page would wait for ever
            tell(Run("failed", sentence=f"{type(error).__name__}: {error}"))
            return
        report = self._out / "report.html"
        shown = str(report.resolve()) if report.is_file() and not self._stopped else None
        # 1: the result is not dependable, and the report says why
        tell(Run("done" if status in (0, 1) and shown else "failed", report=shown, sentence=last))

    def stop(self) -> None:
        """End the run."""
        self._stopped = True
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()

    def _call(self, arguments: Sequence[str], tell: Callable[[Run], None]) -> tuple[int, str]:
        """Run a command; return its exit code, and the first line of its result or its error."""
        if self._stopped:
            return -1, "stopped"
        with subprocess.Popen(
            [*KOLINEAR, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
        ) as self._process:
            lines = []
            for line in self._process.stdout or ():
                said = line.rsplit("\r", 1)[-1].strip()[:LONGEST]
                if STAGE.match(said):
                    lines.append(said)
                    tell(Run("running", said))
        status = self._process.returncode
        result = next((said for said in lines if said.startswith(("The survey", "kolinear"))), "")
        return status, result or (lines[-1] if lines else f"exit code {status}")


def name_marks(survey_file: Path, marks: Path) -> None:
    """Let a survey file name its marks file, unless it does.

    Args:
        survey_file: the survey file, to which a table is appended.
        marks: the marks file.

    Raises:
        SurveyFileError: it names another marks file, cannot name any, or the marks file is outside its
            folder; the survey file is what it was.
        OutputError: it cannot be written.
    """
    text, table = read_toml(survey_file, "a survey file")
    named = table.get("marks")
    path = path_from(survey_file.parent, marks)
    if isinstance(named, dict):
        if (survey_file.parent / str(named.get("file"))).resolve() != marks.resolve():
            raise SurveyFileError(f"{survey_file}: names the marks file '{named.get('file')}', not {marks}")
        return
    path_inside(survey_file.parent, path, str(survey_file))
    before = survey_file.read_bytes()
    line = "\r\n" if b"\r\n" in before else "\n"
    more = "" if text.endswith("\n") else line
    quoted = path.replace("\\", "/").replace('"', '\\"')
    with whole_file(survey_file, replaces=True) as part:
        part.write_bytes(before + f'{more}{line}[marks]{line}file = "{quoted}"{line}'.encode())
    try:
        read_survey(survey_file)
    except SurveyFileError:  # such as one with [observations] in place of photographs
        with whole_file(survey_file, replaces=True) as part:
            part.write_bytes(before)
        raise
