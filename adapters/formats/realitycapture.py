"""Poses and cameras of RealityCapture and RealityScan ("Internal/External camera parameters", .csv).

    #name,x,y,alt,heading,pitch,roll[,f,px,py[,k1,k2,k3,k4,t1,t2]]

f is for a larger side of 36 mm; px and py are parts of the larger side from the middle of the photograph, x
right, y down. Later versions name them f_35mm, px_norm and py_norm. With a = x / z, b = y / z, r2 = a2 + b2

    x' = a (1 + k1 r2 + k2 r4 + k3 r6 + k4 r8) + t1 (r2 + 2 a2) + 2 t2 a b,   y' with t1, t2 exchanged

This is `brown_forward`. The file has neither the sizes of the photographs nor points.

Source: nerfstudio (realitycapture_utils) for angles, f, px and py; AliceVision (importKnownPoses) for t1 and
t2, which nerfstudio exchanges.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adapters.formats.cameras.lens_terms import forward_camera
from adapters.formats.content import Content, select_placed
from adapters.formats.stated_model import (
    NOMINAL_MM,
    NOMINAL_PX,
    StatedModel,
    content_of,
    heading_from_rotation,
    rotation_from_heading,
    unstated_camera,
)
from adapters.reading.text_lines import Lines
from sfm.files.plain_text import csv_text
from sfm.files.whole_files import whole_file

SIDE_MM = 36.0  # of the larger side
POSE = ("name", "x", "y", "alt", "heading", "pitch", "roll")
PLANE = ("f", "px", "py")
LENS = ("k1", "k2", "k3", "k4", "t1", "t2")
HEAD = f"#{','.join(POSE)}"  # by which a file is recognised


def read_realitycapture(path: Path) -> Content:
    """Read the photographs with their poses and cameras; photographs of equal values share a camera.

    Raises:
        SurveyFileError: with file and line number.
    """
    text = Lines.of(path)
    stated = StatedModel(path, text=text)
    header = [
        name.strip().lstrip("#").removesuffix("_35mm").removesuffix("_norm")
        for name in text.line().split(",")
    ]
    for name in POSE:
        if name not in header:
            raise text.error(f"no column {name}, needed {HEAD}")
    cameras: dict[tuple[float, ...], int] = {}
    while (line := text.maybe_line()) is not None:
        if not line.strip():
            continue
        cells = text.cells()
        if len(cells) != len(header):
            raise text.error(f"{len(cells)} columns, the header has {len(header)}")
        row = dict(zip(header, cells, strict=True))
        x, y, z, *angles = (text.number_of(row[name].strip()) for name in POSE[1:])
        lens = tuple(text.number_of(row[name].strip()) for name in (*PLANE, *LENS) if name in row)
        if lens not in cameras:
            cameras[lens] = len(cameras)
            if "f" not in row:
                stated.cameras.append(unstated_camera(stated))
            else:
                of_row = {name: text.number_of(row[name].strip()) for name in (*PLANE, *LENS) if name in row}
                if not of_row["f"] > 0:
                    raise text.error(f"f {of_row['f']:g} mm, it must be positive")
                c = of_row["f"]
                k1, k2, k3, k4, t1, t2 = (of_row.get(term, 0.0) for term in LENS)
                plane = (c, SIDE_MM * of_row.get("px", 0.0), -SIDE_MM * of_row.get("py", 0.0))
                terms = (k1 / c**2, k2 / c**4, k3 / c**6, k4 / c**8, t1 / c, -t2 / c, 0.0, 0.0)
                pixel_mm = (NOMINAL_MM, NOMINAL_MM)  # the larger side is 36 mm
                stated.cameras.append(
                    forward_camera(f"camera {len(cameras)}", NOMINAL_PX, pixel_mm, plane, terms)
                )
        name = row["name"].strip()
        stated.add_image(name, cameras[lens], np.array([x, y, z]), rotation_from_heading(*angles))
    stated.text = None
    if "f" in header:
        stated.notes.append("sizes of photographs are not stated: 3600 px stand for the larger side of 36 mm")
    return content_of(stated)


def write_realitycapture(path: Path, content: Content) -> None:
    """Write the photographs that have an orientation.

    Args:
        path: new file.
        content: cameras in model brown_forward with square pixels, without b1 and b2.

    Raises:
        OutputError: the file cannot be written.
    """
    result = select_placed(content).result
    network, estimate = result.network, result.estimate
    lenses = []
    for camera in estimate.cameras:
        side, c = max(camera.size_px) * camera.pixel_mm[0], camera.value("c")
        plane = (SIDE_MM * c / side, camera.value("x0") / side, -camera.value("y0") / side)
        radial = [camera.value(f"K{k}") * c ** (2 * k) for k in (1, 2, 3, 4)]
        lenses.append(np.array([*plane, *radial, camera.value("P1") * c, -camera.value("P2") * c]).tolist())
    angles = heading_from_rotation(estimate.rotation).tolist()
    rows = [
        (name, *position, *angle, *lenses[a])
        for name, position, angle, a in zip(
            network.images, estimate.position.tolist(), angles, network.camera.tolist(), strict=True
        )
    ]
    with whole_file(path) as part:
        part.write_text("#" + csv_text((*POSE, *PLANE, *LENS), rows), encoding="utf-8", newline="")
