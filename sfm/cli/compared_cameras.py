"""The work of `kolinear compare` for cameras: which two, from which files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from adapters.formats.cameras.registry import NAMES, camera_format_of, read_cameras
from sfm.comparison.camera_difference import CameraDifference, compare_cameras
from sfm.model.camera_file import CameraFile
from sfm.model.errors import GeometryError


def compared_as_cameras(path: Path, name: str | None) -> bool:
    """Return whether a path is a file of cameras, and no result.

    Args:
        path: file or folder.
        name: name of its format; None detects it.
    """
    return name in NAMES if name is not None else path.is_file() and camera_format_of(path) is not None


def difference_of_files(
    a: Path,
    b: Path,
    a_format: str | None,
    b_format: str | None,
    *,
    camera: str | None,
    distance: float,
) -> CameraDifference:
    """Return the difference of a camera of each of two files or results.

    Args:
        a: file or result.
        b: file or result.
        a_format: name of the format of a; None detects it.
        b_format: name of the format of b; None detects it.
        camera: name of the camera in both, or NAME=NAME; None for the only one.
        distance: of the points whose images are compared; infinite for directions.

    Raises:
        KolinearError: a file cannot be read, or the cameras cannot be compared.
    """
    first, second = read_cameras(a, a_format), read_cameras(b, b_format)
    left, _, right = ("", "", "") if camera is None else camera.partition("=")
    of_first = left if right else _name(first, left, second)
    of_second = right or _name(second, left, first)
    chosen = [first.only(of_first), second.only(of_second)]
    if a.resolve() == b.resolve() and chosen[0].cameras[0].name == chosen[1].cameras[0].name:
        raise GeometryError(
            f"{a}: camera {chosen[0].cameras[0].name} would be compared with itself, needed another file or "
            "--camera A=B"
        )
    seen = tuple(file.image_points(file.cameras[0].name) for file in chosen)
    labels = [f"{file.cameras[0].name} of {path.name}" for file, path in zip(chosen, (a, b), strict=True)]
    if labels[0] == labels[1]:
        labels = [f"{file.cameras[0].name} of {path}" for file, path in zip(chosen, (a, b), strict=True)]
    cameras = [replace(file.cameras[0], name=label) for file, label in zip(chosen, labels, strict=True)]
    return compare_cameras(
        cameras[0],
        cameras[1],
        covariance=(chosen[0].covariance[0], chosen[1].covariance[0]),
        seen_px=(seen[0], seen[1]),
        distance=distance,
        independent=a.resolve() != b.resolve() and not _image_points(first) & _image_points(second),
    )


def _image_points(file: CameraFile) -> set[tuple[str, float, float]]:
    """Return the image points of a result by photograph and pixel, px; those of a file are not known."""
    if file.solution is None:
        return set()
    network = file.solution.network
    seen = network.image_points
    names = [network.images[k] for k in seen.image.tolist()]
    return {(name, x, y) for name, (x, y) in zip(names, seen.xy.tolist(), strict=True)}


def _name(file: CameraFile, wanted: str, other: CameraFile) -> str | None:
    """Return the camera to compare: the wanted one, the only one, or the one named like the only other one.

    Args:
        file: cameras to choose from.
        wanted: name that was asked for; empty for none.
        other: the cameras to compare with.
    """
    if len(file.cameras) == 1:
        return None
    shared = [camera.name for camera in file.cameras if camera.name == other.cameras[0].name]
    return wanted or (shared[0] if shared and len(other.cameras) == 1 else None)
