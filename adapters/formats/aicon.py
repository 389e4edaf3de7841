"""Files of AICON 3D Studio in a folder, which JAG3D's bundle adjustment (JAiCov) reads.

    *.ior     cameras, five lines each: number, -, -c, x0, y0, A1, A2, r0 / A3 / B1, B2 / C1, C2 /
              width and height of the sensor, mm, and px
    *.eor     photographs: number, camera, X0, Y0, Z0, omega, phi, kappa (rad), rotation, active, state
    *.phc     image points: photograph, point, x, y, sx, sy, vx, vy (mm), method, active, -
    *.obc     points: number, X, Y, Z, sX, sY, sZ, rays, active, new, datum
    *.scale   scale bars: number, "name", two points, length, sigma, active

Image points are in mm from the centre of the sensor, x right, y up. With X = c u, Y = c v, r2 = X2 + Y2

    x = x0 + X (1 + A1 (r2 - r02) + A2 (r4 - r04) + A3 (r6 - r06)) + B1 (r2 + 2 X2) + 2 B2 X Y + C1 X + C2 Y
    y = y0 + Y (1 + ...) + B2 (r2 + 2 Y2) + 2 B1 X Y

which is `brown_forward`, whose principal distance takes the terms of r0. Photographs are numbered. Standard
deviations of 0 are not known. Image points that are not active are read as rejected.

Source: Luhmann, Close-Range Photogrammetry and 3D Imaging (2020), sec. 3.3; JAiCov (GPL), whose readers name
the columns. The residuals of its example agree with these formulas to the printed digits, 5e-6 mm.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from adapters.formats.cameras.lens_terms import forward_camera
from adapters.formats.content import Content, select_placed
from adapters.formats.stated_model import StatedModel, content_of
from adapters.reading.text_lines import Lines, write_lines
from sfm.files.plain_text import MAX_PIXEL_MM, MAX_SIDE_PX, shorten
from sfm.model.conventions import FloatArray, angles_from_rotation, rotation_from_angles
from sfm.model.errors import OutputError, SurveyFileError

ENDINGS = ("ior", "eor", "obc", "phc", "scale")
PLACES = tuple(f"*.{ending}" for ending in ENDINGS)
NAME = "survey"  # of the files, without ending
WORD = re.compile(r'[^\s"#]+')  # a name that is one column


def read_aicon(folder: Path) -> Content:
    """Read the files of a folder, each of which may be missing.

    Raises:
        SurveyFileError: with file and line number.
    """
    stated = StatedModel(folder, points_named=True, images_named=False)
    files = {ending: sorted(folder.glob(f"*.{ending}")) for ending in ENDINGS} if folder.is_dir() else {}
    if not folder.is_dir() and folder.suffix.lower().lstrip(".") in ENDINGS:
        files = {ending: [folder] if folder.suffix.lower() == f".{ending}" else [] for ending in ENDINGS}
    cameras: dict[int, int] = {}
    images: dict[int, int] = {}
    points: dict[str, int] = {}
    readers = {"ior": _read_camera, "eor": _read_photograph, "obc": _read_point, "phc": _read_image_point}
    for ending, paths in files.items():
        for path in paths:
            if not path.resolve().is_relative_to(folder.resolve()):
                raise SurveyFileError(
                    f"{path}: a link that leaves its folder; the file itself is needed there"
                )
            stated.text = text = Lines.of(path)
            while (words := text.row()) is not None:
                if ending == "scale":
                    _read_bar(text, stated, points)
                else:
                    readers[ending](text, words, stated, (cameras, images, points))
    stated.text = None
    return content_of(stated)


def write_aicon(folder: Path, content: Content) -> None:
    """Write what has coordinates.

    Args:
        folder: new or empty.
        content: cameras in model brown_forward without K4.

    Raises:
        OutputError: a name of a point is not one word, or the folder cannot be written.
    """
    placed = select_placed(content)
    result = placed.result
    network, estimate = result.network, result.estimate
    for name in network.points:
        if WORD.fullmatch(name) is None:
            raise OutputError(
                f"{folder}: point '{shorten(name)}' of format aicon, needed a name without spaces"
            )
    folder.mkdir(parents=True, exist_ok=True)
    cameras = []
    for k, camera in enumerate(estimate.cameras, 1):
        p = {name: camera.value(name) for name in camera.names}
        size = np.array(camera.size_px)
        width, height = (size * camera.pixel_mm).tolist()
        cameras += [
            f"{k} -999 {-p['c']!r} {p['x0']!r} {p['y0']!r} {p['K1']!r} {p['K2']!r} 0.0",
            f"{p['K3']!r}",
            f"{p['P1']!r} {p['P2']!r}",
            f"{p['b1']!r} {p['b2']!r}",
            f"{width!r} {height!r} {size[0]} {size[1]}",
        ]
    angles = angles_from_rotation(estimate.rotation)
    poses = [
        f"{i + 1} {network.camera[i] + 1} {_text(estimate.position[i])} {_text(angles[i])} 0 1 3"
        for i in range(len(network.images))
    ]
    C = result.point_covariance
    sigma = np.zeros_like(estimate.points) if C is None else np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    rays = np.bincount(network.image_points.point, minlength=len(network.points))
    points = [
        f"{name} {_text(xyz)} {_text(np.nan_to_num(s))} {count} 1 1 0"
        for name, xyz, s, count in zip(network.points, estimate.points, sigma, rays.tolist(), strict=True)
    ]
    seen = []
    for measured, active in ((network.image_points, 1), (placed.rejected, 0)):
        spread = np.sqrt(np.diagonal(measured.covariance, axis1=1, axis2=2))
        for i, j, xy, s in zip(measured.image, measured.point, measured.xy, spread, strict=True):
            camera = estimate.cameras[network.camera[i]]
            mm = (xy - (np.array(camera.size_px) - 1) / 2) * camera.pixel_mm * (1, -1)
            line = f"{i + 1} {network.points[j]} {_text(mm)} {_text(s * camera.pixel_mm)}"
            seen.append(f"{line} 0 0 1 {active} 1")
    given = network.scale_bars
    ends = zip(given.start.tolist(), given.end.tolist(), strict=True)
    lengths = np.column_stack([given.length, given.sigma])
    bars = [
        f'{k} "bar" {network.points[a]} {network.points[b]} {_text(lengths[k])} 1'
        for k, (a, b) in enumerate(ends)
    ]
    for ending, lines in zip(ENDINGS, (cameras, poses, points, seen, bars), strict=True):
        if lines:
            write_lines(folder / f"{NAME}.{ending}", lines)


Index = tuple[
    dict[int, int], dict[int, int], dict[str, int]
]  # cameras, photographs and points by their number


def _numbers(text: Lines, words: list[str], fewest: int, what: str) -> list[float]:
    if len(words) < fewest:
        raise text.error(f"{len(words)} words, {what} are {fewest} numbers")
    return [text.number_of(word) for word in words[:fewest]]


def _read_camera(text: Lines, words: list[str], stated: StatedModel, index: Index) -> None:
    """Add the camera that begins in this line."""
    number, _, c, x0, y0, A1, A2, r0 = _numbers(text, words, 8, "the first line of a camera")
    (A3,) = _numbers(text, text.due_row("A3"), 1, "A3")
    B1, B2 = _numbers(text, text.due_row("B1 and B2"), 2, "B1 and B2")
    C1, C2 = _numbers(text, text.due_row("C1 and C2"), 2, "C1 and C2")
    width, height, *px = _numbers(text, text.due_row("the size of the sensor"), 4, "the sizes of the sensor")
    if not all(1 <= side <= MAX_SIDE_PX and side == int(side) for side in px):
        raise text.error(f"{px[0]:g} x {px[1]:g} px, needed whole numbers from 1 to {MAX_SIDE_PX}")
    size = int(px[0]), int(px[1])
    pixel = width / size[0], height / size[1]
    if not all(0 < side <= MAX_PIXEL_MM for side in pixel):
        raise text.error(f"pixels of {pixel[0]:g} x {pixel[1]:g} mm, needed 0 to {MAX_PIXEL_MM:g}")
    scale = 1 - A1 * r0**2 - A2 * r0**4 - A3 * r0**6
    if not (c < 0 < scale):
        raise text.error(
            f"principal distance {c:g} mm and r0 {r0:g} mm, needed a negative distance, r0 in the format"
        )
    index[0][int(number)] = len(stated.cameras)
    terms = (A1, A2, A3, 0.0, B1, B2, C1, C2)
    stated.cameras.append(
        forward_camera(f"camera {number:.0f}", size, pixel, (-c, x0, y0), terms, scale=scale)
    )


def _read_photograph(text: Lines, words: list[str], stated: StatedModel, index: Index) -> None:
    """Add a photograph; one without orientation has no coordinates."""
    values = _numbers(text, words, 11, "a photograph")
    number, camera = (int(value) for value in values[:2])
    if camera not in index[0]:
        raise text.error(f"camera {camera} of photograph {number} is not in a file .ior")
    if values[8] != 0:
        raise text.error(f"rotation of kind {values[8]:g} is not read, 0 is (omega, phi, kappa)")
    if number in index[1]:
        raise text.error(f"photograph {number} is a duplicate")
    index[1][number] = len(stated.images)
    oriented = values[9] != 0 and values[10] != 1
    R = rotation_from_angles(*values[5:8])
    stated.add_image(
        f"{number}", index[0][camera], *((np.array(values[2:5]), R) if oriented else (None, None))
    )


def _read_point(text: Lines, words: list[str], stated: StatedModel, index: Index) -> None:
    """Add a point that is active; standard deviations of 0 are not known."""
    name = text.name_of(words[0], "the name of a point")
    values = _numbers(text, words[1:], 3, f"X Y Z of point {shorten(name)}")
    sigma = _numbers(text, words[4:], 3, "sX sY sZ") if len(words) >= 7 else [0.0] * 3
    if len(words) >= 9 and text.number_of(words[8]) == 0:
        return
    if name in index[2]:
        raise text.error(f"point {shorten(name)} is a duplicate")
    index[2][name] = stated.add_point(name, values)
    stated.point_sigma.extend(s if s > 0 else np.nan for s in sigma)


def _read_image_point(text: Lines, words: list[str], stated: StatedModel, index: Index) -> None:
    """Add an image point of a photograph and a point that were read."""
    if len(words) < 11:
        raise text.error(f"{len(words)} words, an image point has 11")
    number = text.whole_of(words[0], 0, 10**9, "the number of a photograph")
    i, j = index[1].get(number), index[2].get(words[1])
    if i is None or j is None:
        return  # of a photograph or point that takes no part
    x, y, sx, sy = (text.number_of(word) for word in words[2:6])
    camera = stated.cameras[stated.camera[i]]
    if not (sx > 0 and sy > 0):
        raise text.error(f"standard deviations {sx:g} and {sy:g} mm, needed positive numbers")
    with np.errstate(over="ignore"):  # of pixels that are no pixels; refused below
        xy = np.array([x, -y]) / camera.pixel_mm + (np.array(camera.size_px) - 1) / 2
        sigma = np.array([sx, sy]) / camera.pixel_mm
    stated.add_image_point(i, j, *xy.tolist())
    if not (sigma <= MAX_SIDE_PX).all():
        raise text.error(f"standard deviations of {sigma.max():g} px, needed {MAX_SIDE_PX} at most")
    stated.xy_sigma.extend(sigma.tolist())
    stated.used.append(text.number_of(words[9]) != 0)


def _read_bar(text: Lines, stated: StatedModel, points: dict[str, int]) -> None:
    """Add a scale bar that is active."""
    words = text.current.rpartition('"')[2].split()
    if len(words) < 5:
        raise text.error(f"{len(words)} words after the name of a scale bar, needed 5")
    if text.number_of(words[4]) == 0:
        return
    for name in words[:2]:
        if name not in points:
            raise text.error(f"point {shorten(name)} of a scale bar is not in a file .obc")
    length, sigma = text.number_of(words[2]), text.number_of(words[3])
    if not (length > 0 and sigma > 0):
        raise text.error(f"length {length:g} and sigma {sigma:g} of a scale bar, needed positive numbers")
    stated.bars.append((points[words[0]], points[words[1]], length, sigma))


def _text(values: FloatArray) -> str:
    return " ".join(repr(value) for value in values.tolist())
