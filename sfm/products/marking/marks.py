"""The marks of a session: every change is written to the marks file at once, and can be undone.

A lock keeps a second server from the file. A change is saved before it counts: if the file cannot be written,
nothing has changed.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from sfm.files.open_folders import locked, refuse_links
from sfm.files.whole_files import remove_leftovers
from sfm.model.errors import FolderInUseError, OutputError, SurveyFileError
from sfm.products.marking.project import MarkedProject, refuse_other_survey
from sfm.survey.inputs.marks_file import Marking, read_marks, write_marks


@dataclass(frozen=True)
class Change:
    """A change of the marks, which can be undone."""

    number: int
    what: str  # as the page names it
    page: str  # the page that made it; empty if none did


class SavedMarks:
    """The marks of a survey in their file, with all earlier states of this session."""

    def __init__(self, path: Path, project: MarkedProject) -> None:
        """Read the marks file, or begin a new one.

        Args:
            path: the marks file; its folder is made if it does not exist.
            project: the survey that is marked.

        Raises:
            SurveyFileError: the file is not a marks file, or of another survey.
            FolderInUseError: another server has the file.
        """
        refuse_links(path)
        self.path = path
        self._held = ExitStack()
        try:
            self._held.enter_context(locked(path.parent / f".{path.name}.lock"))
        except FolderInUseError as error:
            raise FolderInUseError(f"{path}: another 'kolinear mark' has this file open ({error})") from None
        try:
            remove_leftovers(path)
            name = project.survey.name
            self.now = read_marks(path) if path.exists() else Marking(name)
            refuse_other_survey(self.now.survey, name, path)
            self._written = _content(path)
        except SurveyFileError as error:
            self.close()
            raise SurveyFileError(f"{error}; it is left alone") from error
        except BaseException:
            self.close()
            raise
        self._numbers = count(1)
        self._before: list[tuple[Change, Marking]] = []  # changes, and the states before them
        self._undone: list[tuple[Change, Marking]] = []  # undone changes, and the states after them

    def change(self, marking: Marking, what: str, page: str) -> None:
        """Save a new state.

        Args:
            marking: the new state.
            what: what was done, as the page names it.
            page: the page that did it; empty if none did.

        Raises:
            OutputError: the file cannot be written, or another program has changed it; the state is what it
                was.
            SurveyFileError: a mark is not one that is read again.
        """
        self._write(marking)
        self._before.append((Change(next(self._numbers), what, page), self.now))
        self._undone.clear()
        self.now = marking

    @property
    def last(self) -> Change | None:
        """The last change, which `undo` undoes."""
        return self._before[-1][0] if self._before else None

    @property
    def last_undone(self) -> Change | None:
        """The change that was undone last, which `redo` makes again."""
        return self._undone[-1][0] if self._undone else None

    def undo(self) -> None:
        """Return to the state before the last change."""
        self._step(self._before, self._undone)

    def redo(self) -> None:
        """Make the last undone change again."""
        self._step(self._undone, self._before)

    def _step(self, source: list[tuple[Change, Marking]], other: list[tuple[Change, Marking]]) -> None:
        change, marking = source[-1]
        self._write(marking)
        source.pop()
        other.append((change, self.now))
        self.now = marking

    def _write(self, marking: Marking) -> None:
        """Write the file, unless another program has changed it since."""
        there = _content(self.path)
        if there not in (None, self._written):
            raise OutputError(
                f"{self.path}: was changed by another program, and is left as it is; end this page and begin "
                "again"
            )
        write_marks(self.path, marking)
        self._written = _content(self.path)

    def close(self) -> None:
        """Give the file free."""
        self._held.close()


def _content(path: Path) -> bytes | None:
    """Return the content of a file; None if there is none."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise OutputError(f"{path}: {error.strerror}") from error
