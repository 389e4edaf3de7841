"""The engine without processes, for tests, and adjusters that travel to workers."""

from __future__ import annotations

import os
import signal
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NoReturn

from sfm.cli.commands.batch import InProcess
from sfm.judgement.survey_result import SurveyResult
from sfm.products.batch.job import Comparers, SurveyRow
from sfm.runtime.executor import Send
from sfm.runtime.forecast import Work as Extent
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.survey import Survey

# The command line in a process that draws no plots, which take as long as a survey, for tests that see none
PLOTLESS = (
    "import sys; sys.argv[0] = 'kolinear'\n"
    "from contextlib import nullcontext\n"
    "import sfm.report.figures.plot_process as drawing\n"
    "drawing.draw_plots, drawing.plot_process = (lambda _: ()), (lambda _: nullcontext())\n"
    "from sfm.cli import main; main()"
)
KILLER = "killer"  # a survey of this name kills whoever works on it


HERE = nullcontext(InProcess())


class Notes:
    """Looks on and remembers."""

    def __init__(self) -> None:
        self.names: Sequence[str] = ()
        self.messages: list[tuple[str, dict[str, Any]]] = []
        self.finished_rows: list[tuple[SurveyRow, bool]] = []
        self.remarks: list[str] = []

    def planned(self, works: Mapping[str, Extent | None], workers: int) -> None:
        self.names = tuple(works)

    def received(self, name: str, message: dict[str, Any]) -> None:
        self.messages.append((name, message))

    def finished(self, name: str, row: SurveyRow, *, kept: bool) -> None:
        self.finished_rows.append((row, kept))

    def remark(self, text: str) -> None:
        self.remarks.append(text)


def no_others(survey: Survey) -> OtherPrograms:
    """Compare with nobody, and kill the worker where the survey asks for it."""
    if survey.name == KILLER:
        os.kill(os.getpid(), signal.SIGKILL)
    return OtherPrograms()


def raise_unforeseen(*parts: object, send: Send) -> NoReturn:
    raise ZeroDivisionError("nobody thought of it")


def return_nothing(parts: object, *, send: Send) -> None:
    return None


def no_writer(result: SurveyResult) -> None:
    return None


ALONE = Comparers(no_others, no_writer)


def points_of(out: Path) -> dict[str, bytes]:
    """Return the bytes of points.csv of every survey of a batch."""
    return {path.parent.name: path.read_bytes() for path in sorted(out.glob("*/points.csv"))}
