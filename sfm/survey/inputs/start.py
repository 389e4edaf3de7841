"""What a survey starts from: its photographs, cameras, and the network of given observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm.camera import Camera
from sfm.conventions import FloatArray, IntArray, pixel_from_image
from sfm.errors import SurveyFileError
from sfm.files.globs import find_files
from sfm.files.plain_text import as_plain, is_plain
from sfm.network import Estimate, ImagePoints, Network, ObjectPoints, ScaleBars
from sfm.survey.inputs.cameras import camera_of_image, start_cameras
from sfm.survey.inputs.interior import refuse_ungrouped
from sfm.survey.inputs.survey_file import Survey, inside
from sfm.survey.inputs.tables import (
    ExteriorTable,
    ImagePointTable,
    ObservedExteriorTable,
    read_control,
    read_exterior,
    read_image_points,
    read_observed_exterior,
    read_points,
)

MAX_PHOTOGRAPHS = 5000  # tables of all pairs of them are kept, 100 MB each


@dataclass(frozen=True)
class PhotographList:
    """The photographs of a survey in order of camera and name."""

    names: tuple[str, ...]  # file names, by which tables and reports know them, (m,)
    paths: tuple[Path, ...]  # (m,)
    camera: IntArray  # index into Survey.cameras, (m,)
    folder: Path  # that the names are relative to

    def by_camera(self) -> tuple[tuple[str, ...], ...]:
        """Return the names of the photographs of each camera that has some."""
        return tuple(
            tuple(name for name, k in zip(self.names, self.camera, strict=True) if k == one)
            for one in np.unique(self.camera)
        )

    def __len__(self) -> int:
        return len(self.names)


def find_photographs(survey: Survey, *, images_dir: Path | None = None) -> PhotographList:
    """Return the photographs that the globs of the cameras name.

    Args:
        survey: a survey with photographs.
        images_dir: folder of the photographs in place of the survey file's own.

    Raises:
        SurveyFileError: no such folder, a camera without photographs, a photograph of two cameras, of no
            group where its camera has groups, or with a name that is no plain text; observed exterior
            orientation that cannot be used.
    """
    folder = Path(images_dir) if images_dir is not None else survey.path.parent
    if not folder.is_dir():
        raise SurveyFileError(f"{folder}: no such folder; photographs of survey {survey.name} were needed")

    def inner(path: Path) -> None:
        name = path.relative_to(folder).as_posix()
        inside(folder, name, str(survey.path), allow_outside=survey.allow_outside)

    owner: list[tuple[str, Path, int]] = []
    for index, camera in enumerate(survey.cameras):
        pattern = camera.images or ""
        try:
            found = find_files(folder, pattern, enter=inner)
        except ValueError as error:
            raise SurveyFileError(
                f"{survey.path}: camera {camera.name}: images = '{pattern}' is no glob relative to {folder}"
            ) from error
        if not survey.allow_outside:
            for path in found:
                inner(path)
        if not found:
            raise SurveyFileError(
                f"no photographs found: camera {camera.name} needs '{pattern}' in {folder}, {_holds(folder)}"
            )
        for name in (path.relative_to(folder).as_posix() for path in found):
            if not is_plain(name):
                raise SurveyFileError(
                    f"{survey.path}: the name of photograph '{as_plain(name)}' is no plain text; rename the "
                    "file"
                )
        owner += [(path.relative_to(folder).as_posix(), path, index) for path in found]
    seen: dict[str, int] = {}
    for name, _, index in owner:
        if name in seen:
            first, second = survey.cameras[seen[name]].name, survey.cameras[index].name
            raise SurveyFileError(
                f"{survey.path}: photograph '{name}' matches the globs of cameras {first} and {second}"
            )
        seen[name] = index
    names, paths, cameras = zip(*owner, strict=True)
    refuse_many(survey.path, names)
    refuse_ungrouped(survey, names, cameras)
    observed_exterior(survey, names)  # refused before the photographs are measured
    return PhotographList(names, paths, np.array(cameras, dtype=np.int64), folder)


def network_from_observations(survey: Survey) -> tuple[Network, Estimate]:
    """Return the network and start values of a survey that gives [observations].

    Photographs and points are counted in the order in which the observations name them first. The control
    is part of the network in every datum; the adjustment uses it only where the datum is `control`.

    Args:
        survey: a survey with [observations]; [approximate] and fixed control fill the estimate, everything
            else in it is NaN.

    Raises:
        SurveyFileError: a table is unreadable, or the cameras' start values are incomplete.
    """
    if survey.observations is None:
        raise SurveyFileError(f"{survey.path}: [observations] with a file of image points is needed")
    cameras = start_cameras(survey)
    where = survey.beside(survey.observations.file)
    table = read_image_points(where)
    images, image = _numbered(table.image)
    refuse_many(where, images)
    points, point = _numbered(table.point)
    owner = np.array([camera_of_image(survey, name) for name in images], dtype=np.int64)
    refuse_ungrouped(survey, images, owner)
    xy, covariance = _in_pixels(
        table.xy, table.sigma, table.unit, cameras, owner[image], survey.adjust.sigma_px
    )
    _refuse_far_outside(where, table, xy, cameras, owner[image])
    observed_exterior(survey, images)  # refused before anything is computed
    control, _ = control_points(survey, points)
    bars, _ = scale_bars(survey, points)
    network = Network(
        images, owner, points, ImagePoints(image, point, xy, covariance), control=control, scale_bars=bars
    )
    return network, approximate_values(survey, network, cameras, images)


def refuse_many(where: Path, images: Sequence[str]) -> None:
    """Raise SurveyFileError if there are more photographs than one adjustment has room for."""
    if len(images) > MAX_PHOTOGRAPHS:
        raise SurveyFileError(
            f"{where}: {len(images)} photographs, at most {MAX_PHOTOGRAPHS} are adjusted together"
        )


def control_points(survey: Survey, points: tuple[str, ...]) -> tuple[ObjectPoints, tuple[str, ...]]:
    """Return the control among the points of a network.

    Args:
        survey: names the table of control, or none.
        points: names of the object points.

    Returns:
        The control, and the names of control points that were not measured.
    """
    if survey.control is None:
        return ObjectPoints(), ()
    table = read_control(survey.beside(survey.control.file))
    index = {name: k for k, name in enumerate(points)}
    known = np.array([name in index for name in table.names], dtype=bool)
    covariance = np.zeros((len(table.names), 3, 3))
    covariance[:, range(3), range(3)] = table.sigma**2
    return (
        ObjectPoints(
            np.array([index[name] for name in table.names if name in index], dtype=np.int64),
            table.xyz[known],
            covariance[known],
        ),
        tuple(name for name in table.names if name not in index),
    )


def observed_exterior(survey: Survey, images: Sequence[str]) -> ObservedExteriorTable | None:
    """Return the observed exterior orientations that a survey names, None if it names none.

    Args:
        survey: names the table.
        images: all photographs of the survey, also those that could not be read.

    Raises:
        SurveyFileError: the table cannot be used, or names a photograph that is none of the survey's.
    """
    if survey.exterior is None:
        return None
    path = survey.beside(survey.exterior.file)
    table = read_observed_exterior(path)
    _refuse_unknown(table, path, survey, images, "column image:")
    return table


def _refuse_unknown(
    table: ExteriorTable | ObservedExteriorTable,
    path: Path,
    survey: Survey,
    images: Sequence[str],
    what: str,
) -> None:
    """Raise SurveyFileError if a table names a photograph that is none of the survey's."""
    known = set(images)
    for name, line in zip(table.names, table.line.tolist(), strict=True):
        if name not in known:
            lacks = "has no observations" if survey.observations else "is no photograph of the survey"
            raise SurveyFileError(
                f"{path}, line {line}: {what} '{name}' {lacks}; correct the name or remove it"
            )


def scale_bars(survey: Survey, points: tuple[str, ...]) -> tuple[ScaleBars, tuple[str, ...]]:
    """Return the scale bars between points of a network, and in words those whose ends were not measured."""
    index = {name: k for k, name in enumerate(points)}
    bars = [bar for bar in survey.scale_bars if bar.start in index and bar.end in index]
    missing = tuple(
        f"{bar.start} - {bar.end}"
        for bar in survey.scale_bars
        if bar.start not in index or bar.end not in index
    )
    return (
        ScaleBars(
            np.array([index[bar.start] for bar in bars], dtype=np.int64),
            np.array([index[bar.end] for bar in bars], dtype=np.int64),
            np.array([bar.length for bar in bars], dtype=float),
            np.array([bar.sigma for bar in bars], dtype=float),
        ),
        missing,
    )


def _numbered(names: tuple[str, ...]) -> tuple[tuple[str, ...], IntArray]:
    """Return the different names in order of first appearance and the number of each entry."""
    number: dict[str, int] = {}
    index = np.array([number.setdefault(name, len(number)) for name in names], dtype=np.int64)
    return tuple(number), index


def _in_pixels(
    xy: FloatArray,
    sigma: FloatArray | None,
    unit: str,
    cameras: tuple[Camera, ...],
    camera: IntArray,
    sigma_px: float,
) -> tuple[FloatArray, FloatArray]:
    """Return positions (k, 2) in px and their covariance (k, 2, 2) in px^2 of rows in px or mm."""
    xy_px = xy.copy()
    s = np.full(xy.shape, sigma_px) if sigma is None else sigma.copy()
    if unit == "mm":
        for index, own in enumerate(cameras):
            rows = camera == index
            xy_px[rows] = pixel_from_image(xy[rows], own.size_px, own.pixel_mm)
            if sigma is not None:
                s[rows] = sigma[rows] / own.pixel_mm
    covariance = np.zeros((len(xy), 2, 2))
    covariance[:, range(2), range(2)] = s**2
    return xy_px, covariance


def _refuse_far_outside(
    path: Path, table: ImagePointTable, xy_px: FloatArray, cameras: tuple[Camera, ...], camera: IntArray
) -> None:
    """Refuse image points farther outside their photograph than it is large: their unit is another."""
    size = np.array([own.size_px for own in cameras])[camera]
    for k in np.flatnonzero(((xy_px < -size) | (xy_px > 2 * size)).any(axis=1))[:1]:
        x, y = table.xy[k]
        raise SurveyFileError(
            f"{path}, line {table.line[k]}: image point {x:g}, {y:g} {table.unit} is far outside its "
            f"photograph of {size[k, 0]} x {size[k, 1]} px; the unit is another, or the size of camera "
            f"{cameras[camera[k]].name}"
        )


def approximate_values(
    survey: Survey, network: Network, cameras: tuple[Camera, ...], images: tuple[str, ...]
) -> Estimate:
    """Return start values from [approximate] and the control; NaN for what nothing is said about.

    Args:
        survey: names the tables, and whether the control holds.
        network: photographs and points that get their values by name.
        cameras: with their start values.
        images: all photographs of the survey, also those that could not be read.

    Raises:
        SurveyFileError: a table is unreadable or names a photograph that is none of the survey's.
    """
    m, n = len(network.images), len(network.points)
    position, rotation = np.full((m, 3), np.nan), np.full((m, 3, 3), np.nan)
    points = np.full((n, 3), np.nan)
    if survey.approximate.images is not None:
        path = survey.beside(survey.approximate.images)
        exterior = read_exterior(path)
        _refuse_unknown(exterior, path, survey, images, "image")
        row = {name: k for k, name in enumerate(exterior.names)}
        for i, name in enumerate(network.images):
            if name in row:
                position[i], rotation[i] = exterior.position[row[name]], exterior.rotation[row[name]]
    if survey.approximate.points is not None:
        table = read_points(survey.beside(survey.approximate.points))
        row = {name: k for k, name in enumerate(table.names)}
        for j, name in enumerate(network.points):
            if name in row:
                points[j] = table.xyz[row[name]]
    if survey.datum.kind == "control":
        points[network.control.point] = network.control.xyz
    return Estimate(cameras, position, rotation, points)


def _holds(folder: Path) -> str:
    """Say in a few words which files a folder holds."""
    files = sorted(path.name for path in folder.iterdir() if path.is_file())
    if not files:
        return "which holds no files (--images names another folder)"
    return f"which holds {len(files)} files such as '{files[0]}' (--images names another folder)"
