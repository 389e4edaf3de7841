"""The marks of a session: every change is written to the marks file at once, and can be undone.

A lock keeps a second server from the file. A change is saved before it counts: if the file cannot be written,
nothing has changed.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from sfm.files.open_folders import locked, refuse_links
from sfm.files.whole_files import remove_leftovers
from sfm.model.errors import FolderInUseError, OutputError, SurveyFileError
from sfm.products.marking.project import MarkedProject, refuse_other_survey
from sfm.survey.inputs.marks_file import Marking, read_marks, write_marks


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
            self.now = self._read() if path.exists() else Marking(name)
            refuse_other_survey(self.now.survey, name, path)
            self._written = _content(path)
        except BaseException:
            self.close()
            raise
        self._undone: list[Marking] = []
        self._before: list[Marking] = []

    def _read(self) -> Marking:
        """Return what is in the file."""
        try:
            return read_marks(self.path)
        except SurveyFileError as error:
            raise SurveyFileError(f"{error}; it is left alone") from error

    def change(self, marking: Marking) -> None:
        """Save a new state.

        Raises:
            OutputError: the file cannot be written, or another program has changed it; the state is what it
                was.
            SurveyFileError: a mark is not one that is read again.
        """
        self._write(marking)
        self._before.append(self.now)
        self._undone.clear()
        self.now = marking

    @property
    def can_undo(self) -> bool:
        """Whether there is a change to undo."""
        return bool(self._before)

    @property
    def can_redo(self) -> bool:
        """Whether there is an undone change."""
        return bool(self._undone)

    def undo(self) -> bool:
        """Return to the state before the last change; return whether there was one."""
        return self._step(self._before, self._undone)

    def redo(self) -> bool:
        """Make the last undone change again; return whether there was one."""
        return self._step(self._undone, self._before)

    def _step(self, source: list[Marking], other: list[Marking]) -> bool:
        if not source:
            return False
        self._write(source[-1])
        other.append(self.now)
        self.now = source.pop()
        return True

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
