"""Points, lines and circles as DXF (R2018) for CAD programs, by ezdxf, with a layer for each group.

Source: Autodesk, DXF Reference (2018); ezdxf 1.4 documentation.
"""

from __future__ import annotations

import configparser
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sfm.files.whole_files import whole_file
from sfm.model.conventions import FloatArray
from sfm.model.errors import OutputError

LAYER_CHARACTERS = 255  # maximum length of a name
TEXT_HEIGHT = 0.01  # of the size of the drawing
COLOURS = 7  # of AutoCAD's index, used in turn
POINT_STYLE = 3  # $PDMODE: a diagonal cross
INSUNITS = {"in": 1, "ft": 2, "mm": 4, "cm": 5, "m": 6, "km": 7, "nm": 12, "um": 13, "µm": 13, "dm": 14}
UNITLESS = 0


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
    unit: str = "",
    lines: Sequence[DxfLine] = (),
    circles: Sequence[DxfCircle] = (),
    texts: Sequence[tuple[str, str, FloatArray]] = (),
) -> None:
    """Write a drawing.

    Args:
        path: path of the file.
        names: names of the points.
        xyz: coordinates of the points, object unit, (n, 3).
        layers: layer of each point.
        unit: name of the object unit; a unit that DXF does not know makes a drawing without unit.
        lines: lines to draw.
        circles: circles to draw.
        texts: layer, text and position of further texts.

    Raises:
        OutputError: the file cannot be written.
    """
    ezdxf = _load_ezdxf()
    drawing = ezdxf.new("R2018", units=INSUNITS.get(unit, UNITLESS))
    space = drawing.modelspace()
    ends = [end for line in lines for end in (line.start, line.end)]
    places = np.vstack([xyz, *ends, *(circle.centre for circle in circles)])
    size = float(np.linalg.norm(np.ptp(places, axis=0))) if len(places) > 1 else 1.0
    height = TEXT_HEIGHT * (size or 1.0)
    if len(places):
        low, high = places.min(axis=0).tolist(), places.max(axis=0).tolist()
        space.reset_extents(low, high)
        drawing.header["$EXTMIN"], drawing.header["$EXTMAX"] = low, high
    drawing.header["$PDMODE"], drawing.header["$PDSIZE"] = POINT_STYLE, height / 2

    def on(layer: str) -> dict[str, Any]:
        name = re.sub(r"[\x00-\x1f<>/\\\":;?*=|`',]", "_", layer)[:LAYER_CHARACTERS] or "0"
        if name not in drawing.layers:
            drawing.layers.add(name, color=7 - len(drawing.layers) % COLOURS)
        return {"layer": name}

    def add_text(text: str, layer: str, at: FloatArray, height: float) -> None:
        line = "".join(c if c.isprintable() else " " for c in text)
        space.add_text(line, height=height, dxfattribs=on(layer) | {"insert": at.tolist()})

    for name, at, layer in zip(names, xyz, layers, strict=True):
        space.add_point(at.tolist(), dxfattribs=on(layer))
        add_text(name, layer, at + 0.6 * height, height)
    for line in lines:
        space.add_line(line.start.tolist(), line.end.tolist(), dxfattribs=on(line.layer))
    for circle in circles:
        own = ezdxf.math.OCS(circle.normal.tolist())  # axes of the entity, by the arbitrary axis algorithm
        centre = own.from_wcs(circle.centre.tolist())
        extrusion = {"extrusion": own.uz}
        space.add_circle(centre, circle.radius, dxfattribs=on(circle.layer) | extrusion)
    for layer, text, at in texts:
        add_text(text, layer, at, 1.5 * height)
    with whole_file(path) as part, part.open("w", encoding=drawing.output_encoding, newline="\n") as file:
        drawing.write(file)


def _load_ezdxf() -> Any:
    """Return ezdxf with its own defaults: it reads ezdxf.ini of the current folder, which may be foreign.

    Raises:
        OutputError: such a file is damaged.
    """
    try:
        import ezdxf
        import ezdxf.math
        from ezdxf._options import options  # typed there
    except (configparser.Error, SystemExit) as error:
        reason = " ".join(str(error).split())[:100]
        raise OutputError(f"ezdxf.ini: ezdxf cannot read its settings ({reason}); rename the file") from error
    options.reset()  # type: ignore[no-untyped-call]
    options.write_fixed_meta_data_for_testing = True  # equal drawings are equal files
    return ezdxf
