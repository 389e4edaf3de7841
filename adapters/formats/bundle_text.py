"""The text files of two bundle adjustment programs of a thesis, read and written.

MATLAB program, three files (those of cameras and points are modelled on the files of the sba package):

    cameras   id omega phi kappa XL YL ZL             a photograph per line, deg
    points    X Y Z frames (frame x y)*               a point per line; frames from 0, mm in the image frame
    sigmas    frames (frame sx sy)*                   a line for each line of points, mm

C# program, one file:

    photographs c x0 y0                               mm
    id omega phi kappa XL YL ZL                       per photograph
    points
    id X Y Z (x y)*                                   per point, one pair for every photograph
    id (sx sy)*                                       per point

The MATLAB program asks for c, x0, y0 (mm); a folder of its files has them in interior.txt.

Both use angles in degrees with M = R_kappa R_phi R_omega, like Kolinear. Neither has distortion, pixels or
the size of the photographs: coordinates in mm become pixels of a nominal size.

Source: the thesis "Bundle adjustment for close-range photogrammetry" (fly-over bridge pier), sec. 4.2.1 and
app. B for the C# file, app. C for the MATLAB files.
"""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import NamedTuple

import numpy as np

from adapters.reading.text_lines import MAX_IMAGE_POINTS, MAX_PHOTOGRAPHS, Lines, write_lines
from sfm.files.plain_text import shorten
from sfm.model.camera import camera_from_values
from sfm.model.conventions import (
    FloatArray,
    IntArray,
    angles_from_rotation,
    image_from_pixel,
    pixel_from_image,
    rotation_from_angles,
)
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, rows_of

INTERIOR = "interior.txt"
OF_SIGMAS = "re"  # end of the name of their file in the thesis
PIXEL_MM = 0.005  # nominal size of a pixel, since the files state none
BORDER = 1.1  # sensor over the extent of the image points


class _Stated(NamedTuple):
    """What the files of both programs state."""

    interior: tuple[float, float, float]  # c, x0, y0, mm
    images: list[str]
    exterior: list[list[float]]  # omega, phi, kappa (deg), XL, YL, ZL of each photograph
    points: tuple[str, ...]
    xyz: array[float]  # of the points
    image: IntArray | array[int]  # photograph of each image point
    point: IntArray | array[int]  # point of each image point
    xy_mm: array[float]
    sigma_mm: array[float] | None


def read_bundle_matlab(
    cameras: Path,
    points: Path,
    sigmas: Path | None = None,
    *,
    c_mm: float,
    x0_mm: float = 0.0,
    y0_mm: float = 0.0,
) -> tuple[Network, Estimate]:
    """Read the files of the MATLAB program as a network and its start values; points are named from 1.

    Args:
        cameras: file of the photographs.
        points: file of the object points and their image points.
        sigmas: file of the standard deviations; without it they are one pixel.
        c_mm: principal distance, which the program asks for, mm.
        x0_mm: x of the principal point, mm.
        y0_mm: y of the principal point, mm.

    Raises:
        SurveyFileError: with file and line number.
    """
    text = Lines.of(cameras)
    names, exterior = _exterior(text, None)
    m = len(names)
    text = Lines.of(points)
    image, point, xy, xyz = array("q"), array("q"), array("d"), array("d")
    ends = array("q", [0])  # number of image points up to and including each point
    while (words := text.row()) is not None:
        if len(words) < 4:
            raise text.error(f"{len(words)} words, a point is X Y Z frames (frame x y)...")
        xyz.extend(text.number_of(word) for word in words[:3])
        frames, values = _frames(text, words[3:], m)
        image.extend(frames)
        point.extend([len(ends) - 1] * len(frames))
        xy.extend(values)
        ends.append(len(image))
        text.refuse_more(len(image) + len(ends), MAX_IMAGE_POINTS, "points and image points")
    if not xyz:
        raise text.error("no points")
    sigma = None
    if sigmas is not None:
        text, sigma = Lines.of(sigmas), array("d")
        for j in range(len(ends) - 1):
            frames = image[ends[j] : ends[j + 1]].tolist()
            given, values = _frames(text, text.due_row(f"sigmas of point {j + 1}"), m)
            if given != frames:
                raise text.error(
                    f"frames {given!s:.100}, the point on line {j + 1} of {points} has {frames!s:.100}"
                )
            sigma.extend(_positive(text, values))
        text.end()
    labels = tuple(f"{j + 1}" for j in range(len(ends) - 1))
    return _network(
        _Stated((c_mm, x0_mm, y0_mm), names, exterior, labels, xyz, image, point, xy_mm=xy, sigma_mm=sigma)
    )


def write_bundle_matlab(
    cameras: Path, points: Path, sigmas: Path | None, network: Network, estimate: Estimate
) -> None:
    """Write a network as the files of the MATLAB program; names of points are lost.

    Args:
        cameras: file of the photographs.
        points: file of the object points and their image points.
        sigmas: file of the standard deviations; None if none are stated.
        network: the measured network.
        estimate: complete.

    Raises:
        OutputError: the files cannot store the network, or they cannot be written.
    """
    xy, sigma = _millimetres(network, estimate)
    lines = ["# id omega phi kappa XL YL ZL (deg)", *_exterior_lines(network, estimate)]
    write_lines(cameras, lines)
    seen = network.image_points
    point_lines, sigma_lines = [], []
    for j, rows in enumerate(rows_of(seen.point, len(network.points))):
        rows = rows[np.argsort(seen.image[rows], kind="stable")]
        frames = [f"{seen.image[r]} {_text(*xy[r])}" for r in rows]
        point_lines.append(" ".join([_text(*estimate.points[j]), f"{len(rows)}", *frames]))
        frames = [f"{seen.image[r]} {_text(*sigma[r])}" for r in rows]
        sigma_lines.append(" ".join([f"{len(rows)}", *frames]))
    write_lines(points, point_lines)
    if sigmas is not None:
        write_lines(sigmas, sigma_lines)


def read_bundle_matlab_folder(folder: Path) -> tuple[Network, Estimate]:
    """Read the files of the MATLAB program in a folder; see `matlab_files`.

    Raises:
        SurveyFileError: what is missing or wrong, with file and line number.
    """
    cameras, points, sigmas, interior = matlab_files(folder)
    text = Lines.of(interior)
    words = text.due_row("c x0 y0 (mm)")
    if len(words) != 3:
        raise text.error(f"{len(words)} words, needed 3: c x0 y0 (mm)")
    c, x0, y0 = map(text.number_of, words)
    if not c > 0:
        raise text.error(f"c is {c:g} mm, it must be positive")
    text.end()
    return read_bundle_matlab(cameras, points, sigmas, c_mm=c, x0_mm=x0, y0_mm=y0)


def matlab_files(folder: Path) -> tuple[Path, Path, Path | None, Path]:
    """Return the files of cameras, points, standard deviations (None if missing) and interior orientation.

    They are cams.txt, pts.txt, sigmas.txt and interior.txt. Alternatively the first three have the names in
    the thesis, which contain the numbers of photographs and points: utara1_2.txt, utara1_8.txt and
    utara1_8re.txt.

    Raises:
        SurveyFileError: one is missing.
    """
    cameras, points, sigmas = (folder / name for name in ("cams.txt", "pts.txt", "sigmas.txt"))
    sigma_files = sorted(folder.glob(f"*_*{OF_SIGMAS}.txt"))
    if not cameras.is_file() and len(sigma_files) == 1:
        (sigmas,) = sigma_files
        points = sigmas.with_name(f"{sigmas.stem.removesuffix(OF_SIGMAS)}.txt")
        others = sorted(set(folder.glob(f"{points.stem.rpartition('_')[0]}_*.txt")) - {points, sigmas})
        cameras = others[0] if len(others) == 1 else cameras
    due = (cameras, points, folder / INTERIOR)
    missing = [file.name for file in due if not file.is_file()]
    if missing:
        raise SurveyFileError(
            f"{folder}: {' and '.join(missing)} missing; the MATLAB program has cams.txt, pts.txt, "
            f"{INTERIOR} (c x0 y0, mm) and optionally sigmas.txt; or as in the thesis NAME_2.txt, "
            "NAME_8.txt and NAME_8re.txt"
        )
    return cameras, points, sigmas if sigmas.is_file() else None, folder / INTERIOR


def write_bundle_matlab_folder(folder: Path, network: Network, estimate: Estimate) -> None:
    """Write cams.txt, pts.txt, interior.txt and, if standard deviations are stated, sigmas.txt.

    Raises:
        OutputError: the files cannot store the network, or they cannot be written.
    """
    _millimetres(network, estimate)  # refuses a network that cannot be stored before a folder is made
    folder.mkdir(parents=True, exist_ok=True)
    cameras, points = folder / "cams.txt", folder / "pts.txt"
    stated = np.isfinite(network.image_points.stated_sigma).any()
    sigmas = folder / "sigmas.txt" if stated else None
    write_bundle_matlab(cameras, points, sigmas, network, estimate)
    camera = estimate.cameras[0]
    interior = _text(camera.value("c"), camera.value("x0"), camera.value("y0"))
    write_lines(folder / INTERIOR, ["# c x0 y0 (mm), which the program asks for", interior])


def read_bundle_csharp(path: Path) -> tuple[Network, Estimate]:
    """Read the file of the C# program as a network and its start values.

    The program reads only two photographs; this function accepts more.

    Args:
        path: the file.

    Raises:
        SurveyFileError: with file and line number.
    """
    text = Lines.of(path)
    words = text.due_row("photographs, c, x0 and y0")
    if len(words) != 4:
        raise text.error(f"{len(words)} words, needed the number of photographs, c, x0 and y0")
    m = text.count_of(words[0], "photographs", MAX_PHOTOGRAPHS)
    c, x0, y0 = (text.number_of(word) for word in words[1:])
    if not c > 0:
        raise text.error(f"c = {c:g} mm, it must be positive")
    names, exterior = _exterior(text, m)
    words = text.due_row("the number of points")
    if len(words) != 1:
        raise text.error(f"{len(words)} words, needed the number of points")
    n = text.count_of(words[0], "points")
    text.refuse_more(m * n, MAX_IMAGE_POINTS, "image points")
    labels: list[str] = []
    known: set[str] = set()
    xyz, xy, sigma = array("d"), array("d"), array("d")
    for _ in range(n):
        words = text.due_row(f"point {len(labels) + 1} of {n}")
        if len(words) != 4 + 2 * m:
            raise text.error(f"{len(words)} words, needed id X Y Z and x y of {m} photographs")
        if words[0] in known:
            raise text.error(f"point {shorten(words[0])} is a duplicate")
        known.add(text.name_of(words[0], "the id of a point"))
        labels.append(words[0])
        values = [text.number_of(word) for word in words[1:]]
        xyz.extend(values[:3])
        xy.extend(values[3:])
    words = text.due_row("the sigmas of the first point")
    if len(words) == 1:  # the program's reader allows their number before them
        words = text.due_row("the sigmas of the first point")
    for j, label in enumerate(labels):
        if j:
            words = text.due_row(f"the sigmas of point {label}")
        if len(words) != 1 + 2 * m or words[0] != label:
            raise text.error(f"'{shorten(' '.join(words))}' where {label} and {2 * m} sigmas were expected")
        values = [text.number_of(word) for word in words[1:]]
        sigma.extend(_positive(text, values))
    text.end()
    image, point = np.tile(np.arange(m), n), np.repeat(np.arange(n), m)
    return _network(
        _Stated((c, x0, y0), names, exterior, tuple(labels), xyz, image, point, xy_mm=xy, sigma_mm=sigma)
    )


def write_bundle_csharp(path: Path, network: Network, estimate: Estimate) -> None:
    """Write a network as the file of the C# program, which requires every point in every photograph.

    Raises:
        OutputError: the file cannot store the network, or cannot be written.
    """
    xy, sigma = _millimetres(network, estimate)
    seen = network.image_points
    m, n = len(network.images), len(network.points)
    row = np.full((n, m), -1)
    row[seen.point, seen.image] = np.arange(len(seen))
    if (row < 0).any():
        j, i = np.argwhere(row < 0)[0]
        raise OutputError(
            f"{path}: point {network.points[j]} is not measured in {network.images[i]}; the file requires "
            "every point in every photograph"
        )
    camera = estimate.cameras[0]
    lines = [
        _text(m, camera.value("c"), camera.value("x0"), camera.value("y0")),
        *_exterior_lines(network, estimate),
    ]
    lines.append(f"{n}")
    for j, name in enumerate(network.points):
        lines.append(" ".join([_word(name), _text(*estimate.points[j], *xy[row[j]].ravel())]))
    for j, name in enumerate(network.points):
        lines.append(" ".join([_word(name), _text(*sigma[row[j]].ravel())]))
    write_lines(path, lines)


def _exterior(text: Lines, count: int | None) -> tuple[list[str], list[list[float]]]:
    """Return ids and omega, phi, kappa (deg), XL, YL, ZL of `count` photographs, or of all if None."""
    names: list[str] = []
    known: set[str] = set()
    exterior = []
    while count is None or len(names) < count:
        words = text.row() if count is None else text.due_row(f"photograph {len(names) + 1} of {count}")
        if words is None:
            break
        if len(words) != 7:
            raise text.error(f"{len(words)} words, a photograph is id omega phi kappa XL YL ZL")
        if words[0] in known:
            raise text.error(f"photograph {shorten(words[0])} is a duplicate")
        known.add(text.name_of(words[0], "the id of a photograph"))
        text.refuse_more(len(known), MAX_PHOTOGRAPHS, "photographs")
        names.append(words[0])
        exterior.append([text.number_of(word) for word in words[1:]])
    if not names:
        raise text.error("no photographs")
    return names, exterior


def _frames(text: Lines, words: list[str], m: int) -> tuple[list[int], list[float]]:
    """Return the frames and all pairs of numbers of "count (frame a b)*"."""
    count = text.count_of(words[0], "frames")
    if len(words) != 1 + 3 * count:
        raise text.error(f"{len(words) - 1} words after {count} frames, needed {3 * count}")
    frames = [text.index_of(words[1 + 3 * k], m, "frame") for k in range(count)]
    if len(set(frames)) < count:
        raise text.error("a frame is a duplicate")
    return frames, [text.number_of(word) for k in range(count) for word in words[2 + 3 * k : 4 + 3 * k]]


def _positive(text: Lines, values: list[float]) -> list[float]:
    if min(values) <= 0:
        raise text.error(f"standard deviation {min(values):g} mm, it must be positive")
    return values


def _network(stated: _Stated) -> tuple[Network, Estimate]:
    """Return what is stated as a network and its start values, with pixels of a nominal size."""
    xy = np.array(stated.xy_mm).reshape(-1, 2)
    pixel = np.array([PIXEL_MM, PIXEL_MM])
    width, height = 2 * np.ceil(BORDER * np.abs(xy).max(axis=0) / pixel).astype(int)
    size = (int(width), int(height))
    sigma_mm = stated.sigma_mm
    sigma = np.tile(pixel, (len(xy), 1)) if sigma_mm is None else np.array(sigma_mm).reshape(-1, 2)
    c, x0, y0 = stated.interior
    camera = camera_from_values(
        "camera", "brown", size, (PIXEL_MM, PIXEL_MM), c_mm=c, values=(("x0", x0), ("y0", y0))
    )
    exterior = np.array(stated.exterior)
    network = Network(
        tuple(stated.images),
        np.zeros(len(stated.images), dtype=np.int64),
        stated.points,
        ImagePoints(
            np.array(stated.image, dtype=np.int64),
            np.array(stated.point, dtype=np.int64),
            pixel_from_image(xy, size, pixel),
            np.eye(2) * (sigma / pixel)[:, None, :] ** 2,
            None if sigma_mm is not None else np.zeros(len(xy), dtype=bool),
        ),
    )
    rotation = np.array([rotation_from_angles(*np.deg2rad(row[:3])) for row in exterior])
    return network, Estimate((camera,), exterior[:, 3:].copy(), rotation, np.array(stated.xyz).reshape(-1, 3))


def _millimetres(network: Network, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return image points and their sigmas in mm; refuse a network that the files cannot store."""
    if len(estimate.cameras) != 1 or estimate.cameras[0].model != "brown":
        raise OutputError("the files of the bundle programs have one camera, in model brown")
    camera = estimate.cameras[0]
    if camera.parameters[3:].any():
        raise OutputError(f"camera {camera.name}: the files of the bundle programs cannot store distortion")
    if not (estimate.oriented.all() and estimate.determined.all()):
        raise OutputError("the files of the bundle programs need start values of all photographs and points")
    seen = network.image_points
    sigma = np.sqrt(np.diagonal(seen.covariance, axis1=1, axis2=2)) * camera.pixel_mm
    return image_from_pixel(seen.xy, camera.size_px, camera.pixel_mm), sigma


def _exterior_lines(network: Network, estimate: Estimate) -> list[str]:
    angles = np.rad2deg(angles_from_rotation(estimate.rotation))
    return [
        f"{_word(name)} {_text(*angles[i], *estimate.position[i])}" for i, name in enumerate(network.images)
    ]


def _word(name: str) -> str:
    if not name or name.split() != [name] or "#" in name:
        raise OutputError(f"'{name}': names in the files of the bundle programs are single words without #")
    return name


def _text(*values: float) -> str:
    """Write numbers with twelve digits, so that mm converted to pixels and back are unchanged."""
    return " ".join(f"{value:.12g}" for value in values)
