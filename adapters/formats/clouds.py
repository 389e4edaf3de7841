"""What files of point clouds have in common: errors of their libraries, and checks of what is read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from adapters.reading.text_lines import MAX_POINTS
from sfm.files.csv_tables import MAX_NUMBER
from sfm.model.conventions import FloatArray
from sfm.model.errors import SurveyFileError


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Turn any error of a library into a line on the file; libraries document no set for damaged files.

    Args:
        path: the file.
        kind: name of its format, for the message.

    Raises:
        SurveyFileError: the block failed.
    """
    try:
        yield
    except SurveyFileError:
        raise
    except Exception as error:
        raise SurveyFileError(f"{path}: no readable {kind} file ({reason_of(error)})") from error


def refuse_large(path: Path, count: int) -> None:
    """Refuse a file that states too many points, before they are read.

    Raises:
        SurveyFileError: there are too many.
    """
    if count > MAX_POINTS:
        raise SurveyFileError(f"{path}: more than {MAX_POINTS} points, no more are read")


def refuse_unusable(path: Path, xyz: FloatArray) -> None:
    """Refuse a file without points, or with a coordinate that is no reasonable number.

    Args:
        path: the file.
        xyz: coordinates, (n, 3).

    Raises:
        SurveyFileError: it is such a file.
    """
    if not len(xyz):
        raise SurveyFileError(f"{path}: no points are in it")
    if not (np.abs(xyz) <= MAX_NUMBER).all():
        raise SurveyFileError(f"{path}: a coordinate is not a finite number of at most {MAX_NUMBER:g}")


def reason_of(error: Exception) -> str:
    """Return the first line of an error of a library."""
    return " ".join(str(error).split("\n")[0].split())[:100] or type(error).__name__
