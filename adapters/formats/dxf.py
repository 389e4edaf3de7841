r"""Points, lines and circles as DXF for CAD programs, with names as text and a layer for each group.

The files use the text form of release 12, which every program reads.

Source: Autodesk, DXF Reference (release 12), group codes of POINT, LINE, CIRCLE and TEXT; characters beyond
ASCII as \U+XXXX; arbitrary axis algorithm.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adapters.reading.text_lines import write_lines
from sfm.model.conventions import FloatArray

LAYER_CHARACTERS = 31  # maximum length of a name in release 12
TEXT_HEIGHT = 0.01  # of the size of the drawing
COLOURS = 7  # of AutoCAD's index, used in turn


@dataclass(frozen=True)
class DxfLine:
    """A straight line."""

    layer: str
    start: FloatArray  # (3,)
    end: FloatArray  # (3,)


@dataclass(frozen=True)
class DxfCircle:
    """A circle in space."""

    layer: str
    centre: FloatArray  # (3,)
    normal: FloatArray  # (3,)
    radius: float


def write_dxf(
    path: Path,
    names: Sequence[str],
    xyz: FloatArray,
    layers: Sequence[str],
    *,
    lines: Sequence[DxfLine] = (),
    circles: Sequence[DxfCircle] = (),
    texts: Sequence[tuple[str, str, FloatArray]] = (),
) -> None:
    """Write a drawing.

    Args:
        path: path of the file.
        names: names of the points.
        xyz: coordinates of the points, (n, 3).
        layers: layer of each point.
        lines: lines to draw.
        circles: circles to draw.
        texts: layer, text and position of further texts.

    Raises:
        OutputError: the file cannot be written.
    """
    centres = [circle.centre[None] for circle in circles]
    places = np.vstack([xyz, *centres, *(line.start[None] for line in lines)])
    size = float(np.linalg.norm(np.ptp(places, axis=0))) if len(places) > 1 else 1.0
    height = TEXT_HEIGHT * (size or 1.0)
    drawn = [line.layer for line in lines] + [circle.layer for circle in circles]
    drawn += [layer for layer, _, _ in texts]
    used = dict.fromkeys(_layer(name) for name in ("0", *layers, *drawn))
    out: list[str] = []

    def put(*pairs: tuple[int, object]) -> None:
        for code, value in pairs:
            out.extend((f"{code:3d}", f"{value:.12g}" if isinstance(value, float) else str(value)))

    def place(first: int, at: FloatArray) -> tuple[tuple[int, object], ...]:
        return tuple((first + 10 * k, float(at[k])) for k in range(3))

    low, high = (places.min(axis=0), places.max(axis=0)) if len(places) else (np.zeros(3), np.ones(3))
    put((0, "SECTION"), (2, "HEADER"), (9, "$ACADVER"), (1, "AC1009"))
    put((9, "$EXTMIN"), *place(10, low), (9, "$EXTMAX"), *place(10, high))
    put((9, "$PDMODE"), (70, 3), (9, "$PDSIZE"), (40, height / 2), (0, "ENDSEC"))
    put((0, "SECTION"), (2, "TABLES"), (0, "TABLE"), (2, "LAYER"), (70, len(used)))
    for k, name in enumerate(used):
        put((0, "LAYER"), (2, name), (70, 0), (62, 7 - k % COLOURS), (6, "CONTINUOUS"))
    put((0, "ENDTAB"), (0, "ENDSEC"), (0, "SECTION"), (2, "ENTITIES"))
    for name, at, layer in zip(names, xyz, layers, strict=True):
        put((0, "POINT"), (8, _layer(layer)), *place(10, at))
        put((0, "TEXT"), (8, _layer(layer)), *place(10, at + 0.6 * height), (40, height), (1, _text(name)))
    for line in lines:
        put((0, "LINE"), (8, _layer(line.layer)), *place(10, line.start), *place(11, line.end))
    for circle in circles:
        n = circle.normal / np.linalg.norm(circle.normal)
        # in the axes of the entity, by the arbitrary axis algorithm
        x = np.cross([0.0, 1.0, 0.0] if np.abs(n[:2]).max() < 1 / 64 else [0.0, 0.0, 1.0], n)
        x /= np.linalg.norm(x)
        centre = np.stack([x, np.cross(n, x), n], axis=1).T @ circle.centre
        put((0, "CIRCLE"), (8, _layer(circle.layer)), *place(10, centre), (40, float(circle.radius)))
        put(*place(210, n))
    for layer, text, at in texts:
        put((0, "TEXT"), (8, _layer(layer)), *place(10, at), (40, 1.5 * height), (1, _text(text)))
    put((0, "ENDSEC"), (0, "EOF"))
    write_lines(path, out)


def _layer(name: str) -> str:
    """Return a name in the form that release 12 allows for layers."""
    return re.sub(r"[^A-Za-z0-9$_-]", "_", name)[:LAYER_CHARACTERS] or "0"


def _text(text: str) -> str:
    """Return a text with non-ASCII characters as escapes."""
    return "".join(c if 32 <= ord(c) < 127 else f"\\U+{ord(c):04X}" for c in text)
