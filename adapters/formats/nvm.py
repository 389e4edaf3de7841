"""VisualSFM's N-View Match files, NVM_V3.

    NVM_V3
    number of photographs
    name f qw qx qy qz X0 Y0 Z0 r 0                                  per photograph
    number of points
    X Y Z R G B n (photograph feature x y)*                          per point

P = R (X - X0), with axes x right, y down, z forward. VisualSFM counts x and y from the principal point, px,
and corrects the measured point with one parameter: (x, y) (1 + r (x2 + y2) / f2) = f (P_x, P_y) / P_z. This
is `brown` with K1 = r / c2. COLMAP writes such files too, but counts from the corner of the photograph and
distorts the ideal point, (x, y) - middle = f p (1 - r |p|2) with p = (P_x, P_y) / P_z, which is
`simple_radial`. A file without a negative coordinate counts from the corner. Neither states the size of the
photographs.

Source: Wu, documentation of VisualSFM, "NVM file format"; COLMAP documentation, "Export".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from adapters.formats.content import Content, select_placed
from adapters.formats.stated_model import (
    StatedModel,
    content_of,
    from_vision_axes,
    nominal_size,
    numbers_of_slots,
    to_vision_axes,
)
from adapters.reading.text_lines import MAX_LINES, MAX_PHOTOGRAPHS, MAX_POINTS, Lines, write_lines
from sfm.files.plain_text import MAX_SIDE_PX, shorten
from sfm.model.camera import camera_from_values
from sfm.model.conventions import FloatArray, IntArray
from sfm.model.network import rows_of

HEADER = "NVM_V3"
BLANK = '"'  # in place of a blank in the name of a photograph
NUMBERS = 10  # behind the name of a photograph
HALF_PIXEL = 0.5  # coordinates of COLMAP minus Kolinear's, px


def read_nvm(path: Path) -> Content:
    """Read the first model of a file.

    Raises:
        SurveyFileError: with file and line number.
    """
    text = Lines.of(path)
    head = text.due_row("NVM_V3")
    if head[0] != HEADER:
        raise text.error(f"'{shorten(' '.join(head))}' at the start, needed {HEADER}")
    if len(head) > 1:
        fixed = [text.number_of(word) for word in head[2:]]
        if head[1] != "FixedK" or len(fixed) not in (4, 5) or fixed[0] != fixed[2]:
            raise text.error("a fixed calibration is read as FixedK fx cx fy cy with fx = fy")
    stated = StatedModel(path, text=text)
    m = _count(text, MAX_PHOTOGRAPHS, "photographs")
    lenses = []
    for i in range(m):
        line = _line(text, f"photograph {i + 1} of {m}")
        words = line.rsplit(maxsplit=NUMBERS)
        if len(words) != NUMBERS + 1:
            raise text.error(f"{len(words)} words, a photograph is name f qw qx qy qz X Y Z r 0")
        f, *q, x, y, z, r, _ = (text.number_of(word) for word in words[1:])
        if not f > 0 or not any(q):
            raise text.error(f"focal length {f:g} px and quaternion {q}, both must be more than 0")
        lenses.append((f, r))
        R = Rotation.from_quat(q, scalar_first=True).as_matrix()
        stated.add_image(words[0].strip().replace(BLANK, " "), i, np.array([x, y, z]), from_vision_axes(R))
    n = _count(text, min(MAX_POINTS, MAX_LINES), "points") if _more(text) else 0
    for j in range(n):
        words = _line(text, f"point {j + 1} of {n}").split()
        if len(words) < 7:
            raise text.error(f"{len(words)} words, a point is X Y Z R G B n (photograph feature x y)...")
        stated.add_point(f"u{j}", [text.number_of(word) for word in words[:3]])
        count = text.whole_of(words[6], 0, len(words), f"the number of image points of point {j}")
        if len(words) != 7 + 4 * count:
            raise text.error(f"{len(words) - 7} words after {count} image points, needed {4 * count}")
        for at in range(7, len(words), 4):
            i = text.index_of(words[at], m, "photograph")
            stated.add_image_point(i, j, text.number_of(words[at + 2]), text.number_of(words[at + 3]))
    if _more(text) and text.row() != ["0"]:
        stated.notes.append("only the first model is read, each model has its own datum")
    stated.text = None
    _place_cameras(stated, np.array(lenses).reshape(-1, 2))
    return content_of(stated)


def write_nvm(path: Path, content: Content) -> None:
    """Write what has coordinates, as VisualSFM does.

    Args:
        path: new file.
        content: cameras in model brown with c, x0, y0, K1 and square pixels.

    Raises:
        OutputError: the file cannot be written.
    """
    result = select_placed(content).result
    network, estimate = result.network, result.estimate
    lines = [HEADER, "", f"{len(network.images)}"]
    R = to_vision_axes(estimate.rotation)
    quaternions = Rotation.from_matrix(R).as_quat(scalar_first=True) if len(R) else np.zeros((0, 4))
    for name, a, q, position in zip(
        network.images, network.camera.tolist(), quaternions, estimate.position, strict=True
    ):
        camera = estimate.cameras[a]
        values = [camera.c_px, *q.tolist(), *position.tolist(), camera.value("K1") * camera.value("c") ** 2]
        lines.append(f"{name.replace(' ', BLANK)}\t{' '.join(repr(float(value)) for value in values)} 0")
    seen = network.image_points
    principal = np.array([camera.principal_point_px for camera in estimate.cameras]).reshape(-1, 2)
    xy = (seen.xy + HALF_PIXEL - principal[network.camera[seen.image]]).tolist()
    slot, image = numbers_of_slots(seen.image).tolist(), seen.image.tolist()
    lines += ["", f"{len(network.points)}"]
    for xyz, rows in zip(estimate.points.tolist(), rows_of(seen.point, len(network.points)), strict=True):
        views = [f"{image[r]} {slot[r]} {xy[r][0]!r} {xy[r][1]!r}" for r in rows.tolist()]
        lines.append(" ".join([*map(repr, xyz), "0 0 0", f"{len(rows)}", *views]))
    write_lines(path, [*lines, "", "0"])


def _place_cameras(stated: StatedModel, lenses: FloatArray) -> None:
    """Add the cameras of photographs with f and r, (m, 2), and count image points from the first pixel."""
    xy, image = np.array(stated.xy).reshape(-1, 2), np.array(stated.image, dtype=np.int64)
    if len(xy) and (xy >= 0).all():
        middle = _middles(stated, lenses, xy, image)
        stated.notes.append(
            "image points count from the corner of the photograph, as COLMAP writes them; its middle is "
            "where they fit the points"
        )
        for name, (f, r), (x, y) in zip(stated.images, lenses.tolist(), middle.tolist(), strict=True):
            size = (round(2 * x), round(2 * y))
            stated.cameras.append(
                camera_from_values(name, "simple_radial", size, (1.0, 1.0), c_mm=f, values=(("k", -r),))
            )
        xy = xy - HALF_PIXEL
    else:
        size = nominal_size(xy)
        for name, (f, r) in zip(stated.images, lenses.tolist(), strict=True):
            stated.cameras.append(
                camera_from_values(name, "brown", size, (1.0, 1.0), c_mm=f, values=(("K1", r / f**2),))
            )
        xy = xy + (np.array(size) - 1) / 2
    stated.xy = type(stated.xy)("d", xy.ravel().tolist())


def _middles(stated: StatedModel, lenses: FloatArray, xy: FloatArray, image: IntArray) -> FloatArray:
    """Return the middle of each photograph from its corner, where COLMAP holds the principal point, (m, 2).

    It is the median difference of measured and computed image points, in whole halves of a pixel.

    Raises:
        SurveyFileError: no photograph has its middle within the largest photographs.
    """
    position, rotation = np.array(stated.position), np.array(stated.rotation)
    X = np.array(stated.xyz).reshape(-1, 3)[np.array(stated.point, dtype=np.int64)]
    P = np.einsum("kab,kb->ka", to_vision_axes(rotation)[image], X - position[image])
    with np.errstate(all="ignore"):
        p = P[:, :2] / P[:, 2:]
        f, r = lenses[image, 0], lenses[image, 1]
        away = xy - p * (f * (1 - r * (p**2).sum(axis=1)))[:, None]
    usable = np.isfinite(away).all(axis=1) & (P[:, 2] > 0)
    if not usable.any():
        raise stated.error("no point is in front of a photograph, which the middle of photographs is from")
    away, image = away[usable], image[usable]
    every = np.median(away, axis=0)
    middle = np.array(
        [np.median(away[rows], axis=0) if len(rows) else every for rows in rows_of(image, len(stated.images))]
    )
    middle = np.round(2 * middle) / 2
    if not ((middle >= 0.5) & (2 * middle <= MAX_SIDE_PX)).all():
        raise stated.error("the middle of a photograph from its image points is not a place in a photograph")
    return middle


def _line(text: Lines, what: str) -> str:
    """Return the next line that is not empty."""
    while not (line := text.line()).strip():
        pass
    return line


def _count(text: Lines, most: int, what: str) -> int:
    return text.whole_of(_line(text, f"the number of {what}").strip(), 0, most, f"the number of {what}")


def _more(text: Lines) -> bool:
    """Return whether a line that is neither empty nor a comment follows, which is then the next one."""
    if text.row() is None:
        return False
    text.read_again()
    return True
