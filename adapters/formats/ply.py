"""Object points read from a PLY point cloud in text form; `sfm.files.ply` writes it.

Vertices have x, y, z and, where they are known, the standard deviations sx, sy, sz; names of points follow
as comments "name <id>", one for each vertex in order, which other programs pass over.

Source: Turk (1994), The PLY polygon file format, Stanford.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adapters.reading.text_lines import Lines
from sfm.conventions import FloatArray
from sfm.files.csv_tables import MAX_ROWS
from sfm.files.plain_text import shown
from sfm.files.ply import SIGMAS

NUMBER_TYPES = {
    *("char", "uchar", "short", "ushort", "int", "uint", "float", "double"),
    *("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"),
}
MAX_COLUMNS = 100


def read_ply(path: Path) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Read the vertices of a PLY file in text form.

    Returns:
        Names (from 1 where the file has none), coordinates (n, 3), and standard deviations (n, 3), NaN where
        the file has none.

    Raises:
        SurveyFileError: what is wrong, with file and line number; also for binary files.
    """
    text = Lines.of(path)
    if (text.maybe_line() or "").strip() != "ply":
        text.number = 1
        raise text.error("not a PLY file: the first line must be 'ply'")
    names: list[str] = []
    columns: list[str] = []
    count = None
    element = ""
    while (words := text.line().split())[:1] != ["end_header"]:
        if words[:1] == ["format"] and words[1:2] != ["ascii"]:
            raise text.error(f"format {shown(' '.join(words[1:]))}, only ascii can be read")
        if words[:2] == ["comment", "name"]:
            names.append(text.name_of(" ".join(words[2:]), "the name of a point"))
            text.refuse_more(len(names), MAX_ROWS, "names")
        elif words[:1] == ["element"]:
            if len(words) != 3:
                raise text.error("an element is 'element NAME COUNT'")
            element = words[1]
            if element == "vertex":
                count = text.count_of(words[2], "vertices", MAX_ROWS)
            elif count is None:
                raise text.error(f"element {shown(element)} before the vertices")
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in NUMBER_TYPES:
                raise text.error(f"'{shown(' '.join(words))}', needed 'property TYPE NAME'")
            columns.append(words[2])
            text.refuse_more(len(columns), MAX_COLUMNS, "properties")
    if count is None or not {"x", "y", "z"} <= set(columns):
        raise text.error("the header has no vertices with x, y and z")
    if names and len(names) != count:
        raise text.error(f"{len(names)} names for {count} vertices")
    if 2 * count * len(columns) > text.size:
        raise text.error(f"{count} vertices of {len(columns)} numbers do not fit in {text.size} bytes")
    table = np.empty((count, len(columns)))
    for j in range(count):
        words = text.due_row(f"vertex {j} of {count}")
        if len(words) != len(columns):
            raise text.error(f"{len(words)} words, a vertex has {len(columns)}")
        table[j] = [text.number_of(word) for word in words]
    xyz = table[:, [columns.index(axis) for axis in "xyz"]]
    sigma = np.full((count, 3), np.nan)
    if set(SIGMAS) <= set(columns):
        sigma = table[:, [columns.index(name) for name in SIGMAS]]
    return tuple(names) or tuple(f"{j + 1}" for j in range(count)), xyz, sigma
