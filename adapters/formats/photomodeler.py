"""PhotoModeler's text export of a project: camera, exterior orientation, control, points, image points.

Blocks follow one another, each closed by an empty line:

    title
    tolerance  most_iterations  [width_px height_px]
    nine default standard deviations
    c xp yp xs ys K1 K2 K3 P1 P2               of the default camera (mm)
    its standard deviations
    per photograph (n = its number from 0)
        n file name
        n X Y Z kappa phi omega                (object unit, deg)
        n standard deviations
        [n] covariances of the position        (may be empty)
        n c xp yp xs ys K1 K2 K3 P1 P2         (mm)
        n standard deviations
    control points:  id X Y Z sX sY sZ
    object points:   id X Y Z sX sY sZ
    image points:    n id x y sx sy            (px)
    features, and which photograph shows them  (not read)

Pixel coordinates count from the corner of the top-left pixel, 0.5 px more than Kolinear's; the principal
point (xp, yp) from the same corner in mm, right and down; xs, ys is the size of the sensor.

Source: the format as read by loadpm.m of DBAT (Borlin and Grussenmeyer), checked on its camcal data.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adapters.reading.text_lines import MAX_BLOCK_LINES, MAX_PHOTOGRAPHS, Lines, write_lines
from sfm.camera import Camera, camera_from_values
from sfm.conventions import FloatArray, angles_from_rotation, rotation_from_angles
from sfm.errors import OutputError, SurveyFileError
from sfm.files.json_files import MAX_SIDE_PX
from sfm.files.plain_text import shown
from sfm.network import Estimate, ImagePoints, Network, ObjectPoints

HALF_PIXEL = 0.5  # PhotoModeler's pixel coordinates minus ours, px
INNER = 10  # c xp yp xs ys K1 K2 K3 P1 P2
FREE = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1")  # what a calibration adjusts


def read_photomodeler(
    path: Path, *, control: Path | None = None, size_px: tuple[int, int] | None = None
) -> tuple[Network, Estimate]:
    """Read a PhotoModeler text export as a network and its start values.

    Photographs with the same interior orientation share a camera, in model `brown` with everything but
    the shear free. The covariance of an image point is that of the file, 1 px^2 where it gives none. An image
    point that is repeated stands once; one with two positions stands with both, for whoever adjusts it.

    Args:
        path: the export.
        control: text file with lines id,label,X,Y,Z[,sX,sY,sZ] (# starts a comment; no sigma = fixed) that
            takes the place of the control points of the export.
        size_px: width and height of the photographs where the export does not give them.

    Raises:
        SurveyFileError: what is wrong, with file and line number.
    """
    text = Lines.of(path)
    text.line()  # title
    header = text.numbers(2, 4)
    if len(header) == 4:
        words = text.current.split()
        width, height = (text.whole_of(word, 1, MAX_SIDE_PX, "the size in px") for word in words[2:])
        size_px = (width, height)
    if size_px is None:
        raise text.error("no size of the photographs in this line, give size_px")
    text.numbers(9, 9)
    default = text.numbers(INNER, INNER)
    text.numbers(INNER, INNER)
    names: list[str] = []
    outer: list[FloatArray] = []
    inner: list[FloatArray] = []
    while True:
        line = text.line()
        if not line.strip():
            break
        number, _, name = line.strip().partition(" ")
        if number != str(len(names)) or not name.strip():
            raise text.error(
                f"'{shown(line.strip())}' where photograph {len(names)} and its file were expected"
            )
        text.refuse_more(len(names) + 1, MAX_PHOTOGRAPHS, "photographs")
        file = name.strip().replace("\\", "/").rsplit("/", 1)[-1]
        names.append(text.name_of(file, "the file of a photograph"))
        outer.append(text.numbers(7, 7, photograph=number)[1:])
        text.numbers(7, 7, photograph=number)
        text.numbers(0, 4)
        inner.append(text.numbers(INNER + 1, INNER + 1, photograph=number)[1:])
        text.numbers(INNER + 1, INNER + 1, photograph=number)
    control_rows = text.block(7)
    object_rows = text.block(7)
    mark_rows = text.block(6)
    if control is not None:
        control_rows = _read_control(control)
    known: dict[str, FloatArray] = {}
    controls = {key for _, key, _ in control_rows}
    for where, key, row in (*object_rows, *control_rows):
        if key in known and key not in controls:
            raise SurveyFileError(f"{where}: point {key} is a duplicate")
        known.setdefault(key, row[:3])
    points = list(known)
    index = {key: j for j, key in enumerate(points)}
    image, point, xy, covariance, stated = [], [], [], [], []
    measured: set[tuple[int, str, float, float]] = set()
    for where, key, row in mark_rows:
        photograph, point_name = int(key), f"{row[0]:.0f}"
        if not 0 <= photograph < len(names):
            raise SurveyFileError(f"{where}: photograph {key}, there are 0 to {len(names) - 1}")
        if (photograph, point_name, *row[1:3].tolist()) in measured:  # the same row again
            continue
        measured.add((photograph, point_name, *row[1:3].tolist()))
        if point_name not in index:
            index[point_name] = len(points)
            points.append(point_name)
        image.append(photograph)
        point.append(index[point_name])
        xy.append(row[1:3] - HALF_PIXEL)
        stated.append(bool((row[3:5] > 0).all()))
        covariance.append(np.diag(np.where(row[3:5] > 0, row[3:5], 1.0) ** 2))
    cameras, camera_index = _cameras(np.array(inner).reshape(-1, INNER), default, size_px)
    exterior = np.array(outer).reshape(-1, 6)
    kappa, phi, omega = np.deg2rad(exterior[:, 3:]).T
    rotation = [rotation_from_angles(o, p, k) for o, p, k in zip(omega, phi, kappa, strict=True)]
    xyz = np.full((len(points), 3), np.nan)
    xyz[: len(known)] = np.array(list(known.values())).reshape(-1, 3)
    network = Network(
        tuple(names),
        camera_index,
        tuple(points),
        ImagePoints(
            np.array(image, dtype=np.int64),
            np.array(point, dtype=np.int64),
            np.array(xy).reshape(-1, 2),
            np.array(covariance).reshape(-1, 2, 2),
            np.array(stated, dtype=bool),
        ),
        ObjectPoints(
            np.array([index[key] for _, key, _ in control_rows], dtype=np.int64),
            np.array([row[:3] for _, _, row in control_rows]).reshape(-1, 3),
            np.array([np.diag(row[3:6] ** 2) for _, _, row in control_rows]).reshape(-1, 3, 3),
        ),
    )
    return network, Estimate(cameras, exterior[:, :3].copy(), np.array(rotation).reshape(-1, 3, 3), xyz)


def _cameras(
    inner: FloatArray, default: FloatArray, size_px: tuple[int, int]
) -> tuple[tuple[Camera, ...], np.ndarray]:
    """One camera per interior orientation that occurs, and which photograph has which."""
    kinds, index = np.unique(inner, axis=0, return_inverse=True)
    cameras = []
    for k, values in enumerate(kinds):
        # Photographs repeat the default camera with fewer digits: three of c, xp and yp.
        if np.allclose(values, default, rtol=0, atol=0.5e-3 + 1e-9):
            values = default
        c, xp, yp, xs, ys = values[:5]
        if not (c > 0 and xs > 0 and ys > 0):
            raise SurveyFileError(f"camera {k}: c {c:g} mm, sensor {xs:g} x {ys:g} mm, all must be positive")
        pixel = (float(xs / size_px[0]), float(ys / size_px[1]))
        given = [
            ("x0", xp - xs / 2),
            ("y0", ys / 2 - yp),
            *zip(("K1", "K2", "K3", "P1", "P2"), values[5:], strict=True),
        ]
        name = "camera" if len(kinds) == 1 else f"camera{k + 1}"
        cameras.append(
            camera_from_values(
                name,
                "brown",
                size_px,
                pixel,
                c_mm=float(c),
                free=FREE,
                values=tuple((n, float(v)) for n, v in given),
            )
        )
    return tuple(cameras), index.astype(np.int64).reshape(-1)


def _read_control(path: Path) -> list[tuple[str, str, FloatArray]]:
    """Rows of a control file as (where, id, X Y Z sX sY sZ)."""
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
    """Write a network and its solution as a PhotoModeler text export, with the digits of double precision.

    PhotoModeler numbers its points: names that are whole numbers are kept, any other is refused.
    Photographs without orientation are refused, points without coordinates have image points only.

    Raises:
        OutputError: what the export cannot hold, or the file cannot be written.
    """
    for camera in estimate.cameras:
        if camera.model != "brown" or camera.value("b1") or camera.value("b2"):
            raise OutputError(
                f"camera {camera.name}: PhotoModeler cannot hold model {camera.model} with affinity; "
                "convert it to brown with b1 in the pixel size"
            )
    sizes = {camera.size_px for camera in estimate.cameras}
    if len(sizes) > 1:
        raise OutputError("photographs of different sizes: the export gives one for all")
    if not estimate.oriented.all():
        i = int(np.argmin(estimate.oriented))
        raise OutputError(f"photograph {network.images[i]} has no orientation, the export wants one")
    for name in network.points:
        if not name.isdecimal() or str(int(name)) != name:
            raise OutputError(f"point '{name}': PhotoModeler numbers its points")
    width, height = sizes.pop()
    inner = [_text(*_inner(camera)) for camera in estimate.cameras]
    none = _text(*[0.0] * INNER)
    lines = [title.replace("\n", " "), f" 0.0005 20 {width} {height}", _text(*[1.0] * 9), inner[0], none]
    angles = np.rad2deg(angles_from_rotation(estimate.rotation))[:, ::-1]
    for i, name in enumerate(network.images):
        lines += [
            f"{i} {name}",
            f"{i} {_text(*estimate.position[i], *angles[i])}",
            f"{i} {_text(*[0.0] * 6)}",
            "",
            f"{i} {inner[network.camera[i]]}",
            f"{i} {none}",
        ]
    lines.append("")
    control = network.control
    for j, xyz, C in zip(control.point, control.xyz, control.covariance, strict=True):
        lines.append(f"{network.points[j]} {_text(*xyz, *np.sqrt(np.diagonal(C)))}")
    lines.append("")
    lines += [
        f"{network.points[j]} {_text(*estimate.points[j], 0.0, 0.0, 0.0)}"
        for j in np.flatnonzero(estimate.determined)
    ]
    lines.append("")
    seen = network.image_points
    sigma = np.sqrt(np.diagonal(seen.covariance, axis1=1, axis2=2))
    lines += [
        f"{i} {network.points[j]} {_text(*(xy + HALF_PIXEL), *s)}"
        for i, j, xy, s in zip(seen.image, seen.point, seen.xy, sigma, strict=True)
    ]
    write_lines(path, [*lines, "", ""])


def _inner(camera: Camera) -> list[float]:
    """Return c xp yp xs ys K1 K2 K3 P1 P2 of a camera."""
    xs, ys = np.array(camera.size_px) * camera.pixel_mm
    c, x0, y0, *distortion = camera.parameters[:8]
    return [c, xs / 2 + x0, ys / 2 - y0, xs, ys, *distortion]


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)
