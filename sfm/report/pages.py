"""Pages beside the survey report: one HTML file with all it shows, and its tables, whole or not at all."""

from __future__ import annotations

import csv
import io
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sfm.errors import OutputError

DPI = 110


def page(kind: str, title: str, verdict: str, level: str, sections: Sequence[tuple[str, str]]) -> str:
    """Return an HTML page in the style of the survey report.

    Args:
        kind: what sort of page it is.
        title: its heading.
        verdict: the one sentence on top.
        level: good | fair | bad, the colour of the verdict.
        sections: heading and HTML of each part.
    """
    style = files("sfm.report").joinpath("report.css").read_text(encoding="utf-8")
    body = "".join(f"<section><h2>{escape(name)}</h2>{text}</section>" for name, text in sections)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)} - Kolinear</title><style>{style}</style></head><body>"
        f"<header><p class=kind>{escape(kind)}</p><h1>{escape(title)}</h1>"
        f'<div class="banner {level}"><strong>{escape(verdict)}</strong></div></header>'
        f"<main>{body}</main></body></html>\n"
    )


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV, numbers with the digits that give them back, unknown ones empty."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([_cell(value) for value in row] for row in rows)
    return buffer.getvalue()


def png(figure: Figure) -> bytes:
    """Return a picture as PNG."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def write_files(out: Path, contents: Sequence[tuple[str, str]], *, main: str) -> Path:
    """Write text files into a folder that is new, empty or holds the same files, whole or not at all.

    Args:
        out: the folder.
        contents: name and text of each file.
        main: name of the file to return.

    Returns:
        Path of the main file.

    Raises:
        OutputError: the folder holds something else or cannot be written.
    """
    refuse_other_files(out, [name for name, _ in contents])
    part = None
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".part", dir=out.parent))
        part.chmod(0o755)  # mkdtemp makes it for the owner alone
        for name, text in contents:
            (part / name).write_text(text, encoding="utf-8")
        if out.exists():
            shutil.rmtree(out)
        part.rename(out)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror or error})") from error
    finally:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)
    return out / main


def refuse_other_files(out: Path, names: Sequence[str]) -> None:
    """Refuse a folder that holds anything but files of these names, before work is done for it.

    Raises:
        OutputError: the folder holds something else, or is none.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: a file is in the way, --out needs a folder")
    foreign = sorted({path.name for path in out.iterdir()} - set(names)) if out.exists() else []
    if foreign:
        raise OutputError(f"{out}: the folder holds '{foreign[0]}'; --out needs a new or empty folder")


def _cell(value: object) -> str:
    if isinstance(value, float | np.floating):
        return repr(float(value)) if np.isfinite(value) else ""
    return str(value)
