"""PhotoModeler's text export of a project: camera, exterior orientation, control, points, image points.

Blocks follow one another, and each ends with an empty line:

    title
    tolerance  most_iterations  [width_px height_px]
    nine default standard deviations           the first of a point marked by hand (px)
    c xp yp xs ys K1 K2 K3 P1 P2               of the default camera (mm)
    its standard deviations
    per photograph (n = its number from 0)
        n file name
        n X Y Z kappa phi omega                (object unit, deg)
        n standard deviations
        [n] covariances of the position        (may be empty)
        n c xp yp xs ys K1 K2 K3 P1 P2         (mm)
        n standard deviations
    control points:  id X Y Z sX sY sZ         (a negative s: held fixed)
    object points:   id X Y Z sX sY sZ         (adjusted)
    image points:    n id x y sx sy            (px)
    features, and which photograph shows them  (not read)

Control points that were adjusted appear in both blocks with their adjusted coordinates and standard
deviations; the file does not contain their observed values. The standard deviations of cameras are the
program's defaults, whether it adjusted the camera or not. Only the title of a calibration project says that
it did.

Pixel coordinates count from the corner of the top-left pixel, 0.5 px more than Kolinear's. The principal
point (xp, yp) counts from the same corner in mm, right and down; xs, ys is the size of the sensor.

Source: the format as read by loadpm.m of DBAT and its use in prague2016_pm.m (Borlin and Grussenmeyer),
checked on its camcal and Strasbourg data.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from adapters.formats.content import Content
from adapters.reading.text_lines import MAX_BLOCK_LINES, MAX_PHOTOGRAPHS, Lines, write_lines
from sfm.files.plain_text import MAX_SIDE_PX, shorten
from sfm.model.camera import Camera, camera_from_values
from sfm.model.conventions import FloatArray, angles_from_rotation, rotation_from_angles
from sfm.model.display import counted
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ObjectPoints
from sfm.model.solution import UNCODED, Solution

MODELS = ("brown", "brown_dbat")  # permitted camera models; they differ in what is minimised
HALF_PIXEL = 0.5  # PhotoModeler's pixel coordinates minus Kolinear's, px
INNER = 10  # c xp yp xs ys K1 K2 K3 P1 P2
FREE = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1")  # adjusted by a calibration project
ROUNDING = 1e-12  # of the ratio of two equal sides
CALIBRATION = "calibration project"  # in the title of a project that adjusts its camera

Row = tuple[str, str, FloatArray]  # of a block: file and line, key, numbers


def read_photomodeler(
    path: Path, *, control: Path | None = None, size_px: tuple[int, int] | None = None
) -> tuple[Network, Estimate]:
    """Read a PhotoModeler text export as a network and its start values; see `read_export`."""
    result = read_export(path, control=control, size_px=size_px).result
    return result.network, result.estimate


def read_export(
    path: Path, *, control: Path | None = None, size_px: tuple[int, int] | None = None
) -> Content:
    """Read everything in a PhotoModeler text export.

    Photographs with the same interior orientation share a camera, in model `brown_dbat` with the affinity of
    its pixels. The camera is held, except in a calibration project, where everything but the shear is free.
    Control with a negative or zero standard deviation is fixed. Adjusted control is not an observation
    and becomes an object point. An image point with a standard deviation of 0 (a "smart" point) has that of a
    point marked by hand, with which the program adjusts it; if all are 0, none is stated. A repeated image
    point is read once; one with two positions is read with both, for the adjustment to decide.

    Args:
        path: the export.
        control: text file with lines id,label,X,Y,Z[,sX,sY,sZ] (# starts a comment; no sigma = fixed) that
            replaces the control points of the export.
        size_px: width and height of the photographs if the export does not state them.

    Raises:
        SurveyFileError: with file and line number.
    """
    text = Lines.of(path)
    calibrates = CALIBRATION in text.line().lower()
    header = text.numbers(2, 4)
    if len(header) == 4:
        words = text.current.split()
        width, height = (text.whole_of(word, 1, MAX_SIDE_PX, "the size in px") for word in words[2:])
        size_px = (width, height)
    if size_px is None:
        raise text.error("no size of the photographs in this line, give size_px")
    by_hand_px = float(text.numbers(9, 9)[0])
    by_hand_px = by_hand_px if by_hand_px > 0 else 1.0
    default = text.numbers(INNER, INNER)
    text.numbers(INNER, INNER)
    photographs = _read_photographs(text)
    control_rows, object_rows, mark_rows = text.block(7), text.block(7), text.block(6)
    adjusted = {(key, *row.tolist()) for _, key, row in object_rows if (row[3:] > 0).all()}
    if control is not None:
        control_rows, adjusted = _read_control(control), set()
    known = _coordinates(object_rows, control_rows)
    points, image_points = _image_points(mark_rows, len(photographs.names), tuple(known), by_hand_px)
    index = {name: j for j, name in enumerate(points)}
    observed = [(key, row) for _, key, row in control_rows if (key, *row.tolist()) not in adjusted]
    lost = len(control_rows) - len(observed)
    free = FREE if calibrates else ()
    cameras, camera_index = _cameras(photographs.inner, default, size_px, free)
    exterior = photographs.exterior
    kappa, phi, omega = np.deg2rad(exterior[:, 3:]).T
    rotation = [rotation_from_angles(o, p, k) for o, p, k in zip(omega, phi, kappa, strict=True)]
    xyz = np.full((len(points), 3), np.nan)
    xyz[: len(known)] = np.array(list(known.values())).reshape(-1, 3)
    control_points = ObjectPoints(
        np.array([index[key] for key, _ in observed], dtype=np.int64),
        np.array([row[:3] for _, row in observed]).reshape(-1, 3),
        np.array([np.diag(np.maximum(row[3:6], 0.0) ** 2) for _, row in observed]).reshape(-1, 3, 3),
    )
    network = Network(photographs.names, camera_index, points, image_points, observations=(control_points,))
    point_sigma = np.full((len(points), 3), np.nan)
    for _, key, row in object_rows:
        point_sigma[index[key]] = np.where(row[3:] > 0, row[3:], np.nan)
    held = "adjusted in a calibration project" if calibrates else "held, as its title names no calibration"
    notes = [f"camera: {held}; free in the survey file says otherwise"]
    if lost:
        notes.append(
            f"{counted(lost, 'control point')} adjusted by PhotoModeler: the export does not say what was "
            "observed, --control FILE does"
        )
    estimate = Estimate(cameras, exterior[:, :3].copy(), np.array(rotation).reshape(-1, 3, 3), xyz)
    result = Solution(
        path.name,
        network,
        estimate,
        point_covariance=_covariance_of(point_sigma),
        position_covariance=_covariance_of(photographs.position_sigma),
    )
    return Content(result, notes=tuple(notes))


class _Photographs(NamedTuple):
    """The photographs of an export."""

    names: tuple[str, ...]
    exterior: FloatArray  # X Y Z kappa phi omega, degrees, (m, 6)
    position_sigma: FloatArray  # (m, 3)
    inner: FloatArray  # c xp yp xs ys K1 K2 K3 P1 P2, (m, 10)


def _read_photographs(text: Lines) -> _Photographs:
    """Read the photographs and the empty line after them."""
    names: list[str] = []
    exterior, position_sigma, inner = [], [], []
    while (line := text.line()).strip():
        number, _, name = line.strip().partition(" ")
        if number != str(len(names)) or not name.strip():
            raise text.error(
                f"'{shorten(line.strip())}' where photograph {len(names)} and its file were expected"
            )
        text.refuse_more(len(names) + 1, MAX_PHOTOGRAPHS, "photographs")
        file = name.strip().replace("\\", "/").rsplit("/", 1)[-1]
        names.append(text.name_of(file, "the file of a photograph"))
        exterior.append(text.numbers(7, 7, photograph=number)[1:])
        position_sigma.append(text.numbers(7, 7, photograph=number)[1:4])
        text.numbers(0, 4)
        inner.append(text.numbers(INNER + 1, INNER + 1, photograph=number)[1:])
        text.numbers(INNER + 1, INNER + 1, photograph=number)
    return _Photographs(
        tuple(names),
        np.array(exterior).reshape(-1, 6),
        np.array(position_sigma).reshape(-1, 3),
        np.array(inner).reshape(-1, INNER),
    )


def _coordinates(object_rows: list[Row], control_rows: list[Row]) -> dict[str, FloatArray]:
    """Return coordinates by the name of the point: adjusted ones, and else those of control."""
    known: dict[str, FloatArray] = {}
    controls = {key for _, key, _ in control_rows}
    for where, key, row in (*object_rows, *control_rows):
        if key in known and key not in controls:
            raise SurveyFileError(f"{where}: point {key} is a duplicate")
        known.setdefault(key, row[:3])
    return known


def _image_points(
    mark_rows: list[Row], photographs: int, known: tuple[str, ...], by_hand_px: float
) -> tuple[tuple[str, ...], ImagePoints]:
    """Return the names of the points, first those with coordinates, and the image points."""
    index = {name: j for j, name in enumerate(known)}
    marks: dict[tuple[int, str, float, float], FloatArray] = {}  # without rows that are repeated
    for where, key, row in mark_rows:
        photograph, name = int(key), f"{row[0]:.0f}"
        if not 0 <= photograph < photographs:
            raise SurveyFileError(f"{where}: photograph {key}, expected 0 to {photographs - 1}")
        index.setdefault(name, len(index))
        marks.setdefault((photograph, name, float(row[1]), float(row[2])), row)
    table = np.array(list(marks.values())).reshape(-1, 5)
    sigma = np.where(table[:, 3:] > 0, table[:, 3:], by_hand_px)
    stated = (table[:, 3:] > 0).all(axis=1)
    image_points = ImagePoints(
        np.array([photograph for photograph, *_ in marks], dtype=np.int64),
        np.array([index[name] for _, name, *_ in marks], dtype=np.int64),
        table[:, 1:3] - HALF_PIXEL,
        np.eye(2) * sigma[:, None, :] ** 2,
        np.full(len(marks), stated.any()),
    )
    return tuple(index), image_points


def _covariance_of(sigma: FloatArray) -> FloatArray | None:
    """Return diagonal covariances (n, 3, 3) from standard deviations (n, 3); None if none is positive."""
    sigma = np.where(sigma > 0, sigma, np.nan)
    return np.eye(3) * sigma[:, None, :] ** 2 if np.isfinite(sigma).any() else None


def _cameras(
    inner: FloatArray, default: FloatArray, size_px: tuple[int, int], free: tuple[str, ...]
) -> tuple[tuple[Camera, ...], np.ndarray]:
    """Return a camera for each different interior orientation, and the camera index of each photograph."""
    kinds, index = np.unique(inner, axis=0, return_inverse=True)
    cameras = []
    for k, values in enumerate(kinds):
        # Photographs repeat the default camera with fewer digits: c, xp and yp have three.
        if np.allclose(values, default, rtol=0, atol=0.5e-3 + 1e-9):
            values = default
        c, xp, yp, xs, ys = values[:5]
        if not (c > 0 and xs > 0 and ys > 0):
            raise SurveyFileError(f"camera {k}: c {c:g} mm, sensor {xs:g} x {ys:g} mm, all must be positive")
        side = float(ys / size_px[1])
        stretch = float(xs / size_px[0]) / side  # as DBAT: square pixels of this height, and an affinity
        stretch = 1.0 if abs(stretch - 1) < ROUNDING else stretch
        given = {"x0": (xp - xs / 2) / stretch, "y0": ys / 2 - yp, "b1": stretch - 1}
        given |= zip(("K1", "K2", "K3", "P1", "P2"), values[5:], strict=True)
        cameras.append(
            camera_from_values(
                "camera" if len(kinds) == 1 else f"camera{k + 1}",
                "brown_dbat",
                size_px,
                (side, side),
                c_mm=float(c),
                free=free,
                values=tuple((name, float(value)) for name, value in given.items()),
            )
        )
    return tuple(cameras), index.astype(np.int64).reshape(-1)


def _read_control(path: Path) -> list[tuple[str, str, FloatArray]]:
    """Return the rows of a control file as (where, id, X Y Z sX sY sZ)."""
    rows: list[tuple[str, str, FloatArray]] = []
    text = Lines.of(path)
    while (line := text.maybe_line()) is not None:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        text.refuse_more(len(rows) + 1, MAX_BLOCK_LINES, "control points")
        parts = [part.strip() for part in line.split(",")]
        if len(parts) not in (5, 8):
            raise text.error(f"{len(parts)} fields, needed id,label,X,Y,Z or id,label,X,Y,Z,sX,sY,sZ")
        values = [text.number_of(part) for part in parts[2:]]
        rows.append((text.where, text.name_of(parts[0], "id"), np.array([*values, 0.0, 0.0, 0.0][:6])))
    return rows


def write_photomodeler(path: Path, network: Network, estimate: Estimate, *, title: str = "Kolinear") -> None:
    """Write a network and its solution; see `write_export`."""
    write_export(path, Content(Solution(title, network, estimate)))


def write_export(path: Path, content: Content) -> None:
    """Write a survey as a PhotoModeler text export, with the digits of double precision.

    It is a calibration project if a parameter of a camera is free. PhotoModeler numbers its points: names
    that are whole numbers are kept, uncoded points get other numbers, and any other name is refused.
    Photographs without orientation are refused; points without coordinates have only image points.

    Raises:
        OutputError: the export cannot store the survey, or the file cannot be written.
    """
    result = content.result
    network, estimate, title = result.network, result.estimate, result.name
    for camera in estimate.cameras:
        if camera.model not in MODELS or camera.value("b1") or camera.value("b2"):
            raise OutputError(
                f"camera {camera.name}: PhotoModeler cannot store model {camera.model} with affinity; "
                "convert it to brown with b1 in the pixel size"
            )
    sizes = {camera.size_px for camera in estimate.cameras}
    if len(sizes) > 1:
        raise OutputError("photographs of different sizes: the export gives one for all")
    if not estimate.oriented.all():
        i = int(np.argmin(estimate.oriented))
        raise OutputError(f"photograph {network.images[i]} has no orientation, the export requires one")
    names = _numbered(network.points)
    if any(camera.free.any() for camera in estimate.cameras):
        title = f"{title} {CALIBRATION.title()}"
    width, height = sizes.pop()
    inner = []
    for camera in estimate.cameras:  # c xp yp xs ys K1 K2 K3 P1 P2
        xs, ys = np.array(camera.size_px) * camera.pixel_mm
        c, x0, y0, *distortion = camera.parameters[:8]
        inner.append(_text(c, xs / 2 + x0, ys / 2 - y0, xs, ys, *distortion))
    none = _text(*[0.0] * INNER)
    lines = [title.replace("\n", " "), f" 0.0005 20 {width} {height}", _text(*[1.0] * 9), inner[0], none]
    angles = np.rad2deg(angles_from_rotation(estimate.rotation))[:, ::-1]
    position_sigma = _sigma_of(result.position_covariance, len(network.images))
    point_sigma = _sigma_of(result.point_covariance, len(network.points))
    for i, name in enumerate(network.images):
        lines += [
            f"{i} {name}",
            f"{i} {_text(*estimate.position[i], *angles[i])}",
            f"{i} {_text(*position_sigma[i], 0.0, 0.0, 0.0)}",
            "",
            f"{i} {inner[network.camera[i]]}",
            f"{i} {none}",
        ]
    lines.append("")
    control = network.control.complete
    for j, xyz, C in zip(control.point, control.xyz, control.covariance, strict=True):
        lines.append(f"{names[j]} {_text(*xyz, *np.sqrt(np.diagonal(C)))}")
    lines.append("")
    lines += [
        f"{names[j]} {_text(*estimate.points[j], *point_sigma[j])}"
        for j in np.flatnonzero(estimate.determined)
    ]
    lines.append("")
    seen = network.image_points
    sigma = np.nan_to_num(seen.stated_sigma)
    lines += [
        f"{i} {names[j]} {_text(*(xy + HALF_PIXEL), *s)}"
        for i, j, xy, s in zip(seen.image, seen.point, seen.xy, sigma, strict=True)
    ]
    write_lines(path, [*lines, "", ""])


def _numbered(points: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of points that are numbers, and higher numbers for uncoded points."""
    for name in points:
        if not UNCODED.fullmatch(name) and (not name.isdecimal() or str(int(name)) != name):
            raise OutputError(f"point '{name}': PhotoModeler numbers its points")
    first = max((int(name) for name in points if name.isdecimal()), default=0) + 1
    numbers = iter(range(first, first + len(points)))
    return tuple(name if name.isdecimal() else str(next(numbers)) for name in points)


def _sigma_of(covariance: FloatArray | None, count: int) -> FloatArray:
    """Return standard deviations, 0 if not known, (count, 3)."""
    if covariance is None:
        return np.zeros((count, 3))
    return np.nan_to_num(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)
