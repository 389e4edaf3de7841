"""JSON files read as untrusted: their size bounded, their content checked against a model before use."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    StrictStr,
    StringConstraints,
    ValidationError,
)

from sfm.errors import SurveyFileError
from sfm.files.plain_text import MAX_NAME, SHOWN, as_plain, is_plain

MAX_JSON_BYTES = 100_000_000  # names of four million points, for which reading takes 2 GB
MAX_SIDE_PX = 1_000_000  # of a photograph; no sensor and no scan is larger
MAX_PIXEL_MM = 1e3  # of a pixel; COLMAP's models without a size have 1 mm


def _plain(text: str) -> str:
    if not is_plain(text):
        raise ValueError("plain text without control or invisible characters")
    return text


Text = Annotated[StrictStr, StringConstraints(max_length=MAX_NAME), AfterValidator(_plain)]
Name = Annotated[Text, StringConstraints(min_length=1)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX, strict=True)]
Pixel = Annotated[FiniteFloat, Field(gt=0, le=MAX_PIXEL_MM, strict=True)]


class Content(BaseModel):
    """The part of a file that is read; the rest is ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True)


ContentT = TypeVar("ContentT", bound=Content)


def read_json(path: Path, content: type[ContentT], what: str) -> ContentT:
    """Read a file.

    Args:
        path: the file.
        content: what must be in it.
        what: the file is, for the message.

    Raises:
        SurveyFileError: unreadable, too large, no JSON, or something in it is not what it must be.
    """
    try:
        size = path.stat().st_size
        if size > MAX_JSON_BYTES:
            raise SurveyFileError(f"{path}: {size} bytes, at most {MAX_JSON_BYTES} are read")
        return content.model_validate_json(path.read_bytes())
    except OSError as error:
        raise SurveyFileError(f"{path}: cannot be read ({error.strerror})") from error
    except ValidationError as error:
        raise SurveyFileError(_first_error(path, error, what)) from error


def _first_error(path: Path, error: ValidationError, what: str) -> str:
    """Say the first thing that is wrong: where, what was found, what is needed."""
    first = error.errors(include_url=False)[0]
    message = " ".join(first["msg"].split())
    if first["type"] == "json_invalid":
        line = re.search(r" at line (\d+) column \d+$", message)
        number, reason = (line[1], message[: line.start()]) if line else ("1", message)
        return f"{path}, line {number}: not {what} ({as_plain(reason)})"
    place = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in first["loc"]).lstrip(".")
    place = as_plain(place[:MAX_NAME])
    if first["type"] == "missing":
        return f"{path}: {place} is missing, which {what} needs"
    found = " ".join(as_plain(repr(first["input"])[: SHOWN + 1]).split())
    found = found if len(found) <= SHOWN else found[:SHOWN] + "..."
    needed = message.removeprefix("Input should be ").removeprefix("Value error, ")
    return f"{path}: {place or 'the content'} is {found}, needed {needed}"
