"""Bundler's bundle.out of version 0.3, with its list of photographs.

    # Bundle file v0.3
    cameras points
    f k1 k2, R (three lines), t         per photograph; all 0 where it has no orientation
    X Y Z / colour / n (camera key x y)*    per point, a line each

    list.txt    a line for each photograph, its name first

P = R X + t, p = -P / P_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p, in px, with the origin in the middle of the
photograph, x right, y up. The camera looks along -z like Kolinear's, R is Kolinear's M, and p are its
tangents. The sizes of the photographs are not stated.

Source: Snavely, Bundler v0.4 User's Manual, sec. "Output format and scene representation".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adapters.formats.content import Content, select_placed
from adapters.formats.stated_model import StatedModel, content_of, file_in, nominal_size, numbers_of_slots
from adapters.reading.text_lines import MAX_PHOTOGRAPHS, MAX_POINTS, Lines, write_lines
from sfm.model.camera import camera_from_values
from sfm.model.display import counted
from sfm.model.distortion.models import Role
from sfm.model.network import rows_of

BUNDLE, LIST = "bundle.out", "list.txt"
PLACES = (BUNDLE, f"bundle/{BUNDLE}")  # in its folder, and in the folder in which Bundler ran
HEADER = "# Bundle file v0.3"
CAMERA_VALUES = 15


def read_bundler(path: Path) -> Content:
    """Read a bundle; photographs without orientation are left out and noted.

    Args:
        path: bundle.out, or its folder. The names of photographs are in list.txt there or one folder above.

    Raises:
        SurveyFileError: with file and line number.
    """
    file = file_in(path, *PLACES) or path
    text = Lines.of(file)
    head = text.due_row("the numbers of cameras and points")
    if len(head) != 2:
        raise text.error(f"{len(head)} words, needed the numbers of cameras and points")
    m = text.whole_of(head[0], 0, MAX_PHOTOGRAPHS, "the number of cameras")
    n = text.whole_of(head[1], 0, MAX_POINTS, "the number of points")
    if 2 * (CAMERA_VALUES * m + 7 * n) > text.size + 1:  # a digit and what separates it
        raise text.error(f"{text.size} bytes in the file, too few for {m} cameras and {n} points")
    names = _names(file, m)
    stated = StatedModel(file, images_named=names is not None, text=text)
    index: dict[int, int] = {}
    lenses: list[tuple[float, float, float]] = []
    for i in range(m):
        rows = []
        for what, count in (("f k1 k2", 3), *[("a row of R", 3)] * 3, ("t", 3)):
            words = text.due_row(f"{what} of camera {i}")
            if len(words) != count:
                raise text.error(f"{len(words)} words, {what} of camera {i} are {count} numbers")
            rows.append([text.number_of(word) for word in words])
        (f, k1, k2), *R_rows, t = rows
        if f == 0:
            continue
        if f < 0:
            raise text.error(f"focal length {f:g} px of camera {i}, it must be positive")
        index[i] = len(index)
        lenses.append((f, k1, k2))
        M = np.array(R_rows)
        stated.add_image(names[i] if names else f"{i}", index[i], -M.T @ np.array(t), M.T)
    _read_points(text, stated, n, m, index)
    text.end()
    stated.text = None
    size = nominal_size(np.array(stated.xy).reshape(-1, 2))
    middle = (np.array(size) - 1) / 2
    xy = np.array(stated.xy).reshape(-1, 2) * (1, -1) + middle
    stated.xy = type(stated.xy)("d", xy.ravel().tolist())
    stated.cameras = [
        camera_from_values(name, "radial", size, (1.0, 1.0), c_mm=f, values=(("k1", k1), ("k2", k2)))
        for name, (f, k1, k2) in zip(stated.images, lenses, strict=True)
    ]
    if len(index) < m:
        stated.notes.append(f"{counted(m - len(index), 'photograph')} without orientation left out")
    return content_of(stated)


def write_bundler(folder: Path, content: Content) -> None:
    """Write what has coordinates as bundle.out and list.txt.

    Args:
        folder: new or empty.
        content: cameras in model radial, or opencv with one focal length, k1 and k2.

    Raises:
        OutputError: the folder cannot be written.
    """
    result = select_placed(content).result
    network, estimate = result.network, result.estimate
    lines = [HEADER, f"{len(network.images)} {len(network.points)}"]
    M = np.swapaxes(estimate.rotation, 1, 2)
    for a, R, position in zip(network.camera.tolist(), M, estimate.position, strict=True):
        camera = estimate.cameras[a]
        f = float(camera.parameters[camera.plays(Role.FOCAL)][0])
        rows = ([f, camera.value("k1"), camera.value("k2")], *R.tolist(), (-R @ position).tolist())
        lines += [" ".join(map(repr, row)) for row in rows]
    seen = network.image_points
    principal = np.array([[c.value("cx"), c.value("cy")] for c in estimate.cameras]).reshape(-1, 2)
    xy = ((seen.xy - principal[network.camera[seen.image]]) * (1, -1)).tolist()
    slot, image = numbers_of_slots(seen.image).tolist(), seen.image.tolist()
    for xyz, of in zip(estimate.points.tolist(), rows_of(seen.point, len(network.points)), strict=True):
        views = [f"{image[r]} {slot[r]} {xy[r][0]!r} {xy[r][1]!r}" for r in of.tolist()]
        lines += [" ".join(map(repr, xyz)), "0 0 0", " ".join([f"{len(of)}", *views])]
    folder.mkdir(parents=True, exist_ok=True)
    write_lines(folder / BUNDLE, lines)
    write_lines(folder / LIST, list(network.images))


def _names(file: Path, m: int) -> list[str] | None:
    """Return the names of the photographs in list.txt; None without such a list of as many."""
    for folder in (file.parent, file.parent.parent):
        path = file_in(folder, LIST)
        if path is not None:
            text, names = Lines.of(path), []
            while (line := text.maybe_line()) is not None:
                if not line.strip():
                    continue
                # a focal length from EXIF may follow the name, behind a 0
                name, *rest = line.rstrip().rsplit(" ", 2)
                numbers = len(rest) == 2 and rest[0] == "0" and rest[1].replace(".", "", 1).isdecimal()
                names.append(name if numbers else line.strip())
                text.refuse_more(len(names), MAX_PHOTOGRAPHS, "photographs")
            if len(names) == m:
                return names
    return None


def _read_points(text: Lines, stated: StatedModel, n: int, m: int, index: dict[int, int]) -> None:
    """Add the points and their image points, px from the middle with y up."""
    for j in range(n):
        words = text.due_row(f"X Y Z of point {j}")
        if len(words) != 3:
            raise text.error(f"{len(words)} words, point {j} has X Y Z")
        stated.add_point(f"u{j}", [text.number_of(word) for word in words])
        if len(text.due_row(f"the colour of point {j}")) != 3:
            raise text.error(f"the colour of point {j} has three numbers")
        words = text.due_row(f"the views of point {j}")
        count = text.whole_of(words[0], 0, m, f"the number of views of point {j}")
        if len(words) != 1 + 4 * count:
            raise text.error(f"{len(words) - 1} words after {count} views, needed {4 * count}")
        for at in range(1, len(words), 4):
            i = text.index_of(words[at], m, "camera")
            if i not in index:
                raise text.error(f"camera {i} sees point {j}, but has no orientation")
            stated.add_image_point(index[i], j, text.number_of(words[at + 2]), text.number_of(words[at + 3]))
