"""HTML pages, all of one house, and folders of a page and its tables, whole or not at all."""

from __future__ import annotations

import io
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sfm.files.folder_lock import locked
from sfm.files.whole_files import remove_leftovers, whole_folder
from sfm.report.content_policy import content_policy

DPI = 110


def page(
    kind: str,
    title: str,
    verdict: str,
    level: str,
    sections: Sequence[tuple[str, str]],
    *,
    remarks: Sequence[str] = (),
    tiles: Sequence[tuple[str, str, str]] = (),
    anchors: Sequence[str] = (),
) -> str:
    """Return an HTML page with everything that it shows inside it.

    Args:
        kind: what sort of page it is.
        title: its heading.
        verdict: the one sentence on top.
        level: good | fair | bad, the colour of the verdict.
        sections: heading and HTML of each part.
        remarks: what to look at, below the verdict.
        tiles: name, value and note of the figures that are asked for first.
        anchors: names of the sections, for a line of links to them; none leaves it out.
    """
    style = files("sfm.report").joinpath("report.css").read_text(encoding="utf-8")
    ids = [f' id="{escape(key)}"' for key in anchors] or [""] * len(sections)
    body = "".join(
        f"<section{key}><h2>{escape(name)}</h2>{text}</section>"
        for key, (name, text) in zip(ids, sections, strict=True)
    )
    links = "".join(
        f'<a href="#{escape(key)}">{escape(name)}</a>'
        for key, (name, _) in zip(anchors, sections, strict=False)
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{content_policy([style])}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)} - Kolinear</title><style>{style}</style></head><body>"
        f"<header><p class=kind>{escape(kind)}</p><h1>{escape(title)}</h1>"
        f"{_banner(verdict, level, remarks)}{_tiles(tiles)}</header>"
        f"{f'<nav>{links}</nav>' if links else ''}<main>{body}</main></body></html>\n"
    )


def _banner(verdict: str, level: str, remarks: Sequence[str]) -> str:
    lines = "".join(f"<li>{escape(line)}</li>" for line in remarks)
    return (
        f'<div class="banner {level}"><strong>{escape(verdict)}</strong>'
        + (f"<ul>{lines}</ul>" if lines else "")
        + "</div>"
    )


def _tiles(tiles: Sequence[tuple[str, str, str]]) -> str:
    if not tiles:
        return ""
    shown = "".join(
        f"<div><span>{escape(name)}</span><b>{escape(value)}</b><small>{escape(note)}</small></div>"
        for name, value, note in tiles
    )
    return f"<div class=tiles>{shown}</div>"


def png(figure: Figure) -> bytes:
    """Return a picture as PNG."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def write_files(out: Path, contents: Sequence[tuple[str, str]], *, main: str) -> Path:
    """Write text files into a folder that is new, empty or an unchanged earlier one, whole or not at all.

    Args:
        out: the folder.
        contents: name and text of each file.
        main: name of the file to return.

    Returns:
        Path of the main file.

    Raises:
        OutputError: the folder holds something else or cannot be written, or another run is writing it.
    """
    with locked(out.parent / f".{out.name}.lock", out):
        remove_leftovers(out)
        with whole_folder(out, "the result", replaceable=True) as folder:
            for name, text in contents:
                (folder / name).write_text(text, encoding="utf-8", newline="")
    return out / main
