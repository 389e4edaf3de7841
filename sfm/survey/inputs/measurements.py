"""The photographs of a survey and their measurements: targets, texture or given image points."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfm.files.globs import find_files, why_no_folder
from sfm.files.open_folders import is_home_file, path_inside
from sfm.files.plain_text import as_plain, is_plain
from sfm.judgement.survey_result import FailedImage, LeftOutPoint, PhotographTargets
from sfm.model.camera import Camera
from sfm.model.conventions import IntArray
from sfm.model.display import counted
from sfm.model.errors import PhotographError, SurveyFileError
from sfm.model.network import Network
from sfm.model.remarks.remark import Remark, remark
from sfm.photographs.exif import Metadata, read_metadata
from sfm.photographs.masks import Masks
from sfm.runtime.forecast import Work
from sfm.survey.inputs.cameras import refuse_ungrouped
from sfm.survey.inputs.settings import MAX_PHOTOGRAPHS, CameraSettings
from sfm.survey.inputs.sources import declared, given_tables
from sfm.survey.inputs.survey_file import SurveyFile
from sfm.targets.codes.tags import CORNERS
from sfm.targets.detect import Targets

if TYPE_CHECKING:
    from sfm.survey.inputs.survey import Survey


@dataclass(frozen=True)
class PhotographList:
    """The photographs of a survey in order of camera and name."""

    names: tuple[str, ...]  # file names relative to the folder, used in tables and reports, (m,)
    paths: tuple[Path, ...]  # (m,)
    camera: IntArray  # index of the camera, (m,)
    folder: Path  # base folder of the names

    def path_of(self) -> dict[str, Path]:
        """Return the paths of the photographs, by their names."""
        return dict(zip(self.names, self.paths, strict=True))

    def metadata_of(self, k: int) -> Metadata | None:
        """Return the metadata of a photograph; None if it cannot be read, which is reported at measuring."""
        try:
            return read_metadata(self.paths[k])
        except PhotographError:
            return None

    def by_camera(self) -> tuple[tuple[str, ...], ...]:
        """Return the names of the photographs of each camera that has any."""
        return tuple(
            tuple(name for name, k in zip(self.names, self.camera, strict=True) if k == camera)
            for camera in np.unique(self.camera)
        )

    def __len__(self) -> int:
        return len(self.names)


def work_of(survey: Survey, files: PhotographList) -> Work:
    """Return what the time of a survey depends on.

    Args:
        survey: the survey.
        files: its photographs; none if it measures nothing.
    """
    metadata = files.metadata_of(0) if len(files) else None
    tables = given_tables(survey)
    images = {image for table in tables for image in table.image}
    return Work(
        tuple(row.source.name for row in declared(survey)),
        len(files) or len(images),
        0.0 if metadata is None else metadata.size_px[0] * metadata.size_px[1] / 1e6,
        0 if len(files) else sum(len(table.image) for table in tables),
    )


NO_PHOTOGRAPHS = PhotographList((), (), np.zeros(0, dtype=np.int64), Path())


@dataclass(frozen=True)
class MeasuredPhotographs:
    """The readable photographs of a survey with their targets, and those that could not be read."""

    names: tuple[str, ...]  # (m,)
    paths: tuple[Path, ...]  # (m,)
    camera: IntArray  # index into cameras, (m,)
    cameras: tuple[Camera, ...]  # they have start values of the interior orientation
    targets: tuple[Targets, ...]  # (m,)
    failed: tuple[FailedImage, ...]  # photographs that could not be read
    stored: tuple[bool, ...] = ()  # whether the targets were measured in an earlier run, (m,) or empty

    def overlays(self) -> tuple[PhotographTargets, ...]:
        """Return the overlay of each photograph in the report."""
        return tuple(
            PhotographTargets(
                name,
                path,
                targets.xy,
                targets.semi_axes,
                targets.angle,
                targets.rejected_xy,
                targets.rejected_flag,
                targets.flag,
                stored,
                targets.blur,
                self.cameras[camera].name,
            )
            for name, path, targets, stored, camera in zip(
                self.names,
                self.paths,
                self.targets,
                self.stored or (False,) * len(self.names),
                self.camera,
                strict=True,
            )
        )


@dataclass(frozen=True)
class Naming:
    """The object point of every measured target."""

    names: tuple[str, ...]  # of the object points: code number, tag and corner, or u and a number, (n,)
    code: IntArray  # code number of each point, of a corner as in TagCorners, -1 = uncoded, (n,)
    point: tuple[IntArray, ...]  # for each photograph, the point of each target or UNNAMED, (k_i,)
    corners: bool = False  # whether the coded points are corners of tags

    def codes(self, network: Network) -> IntArray:
        """Return the code number or tag of each point of a network, -1 if uncoded, (n,)."""
        per_code = len(CORNERS) if self.corners else 1
        code = dict(zip(self.names, self.code // per_code, strict=True))
        return np.array([code.get(name, -1) for name in network.points], dtype=np.int64)


NO_NAMES = Naming((), np.zeros(0, dtype=np.int64), ())  # without targets


@dataclass(frozen=True)
class Measurements:
    """The named image points of a survey, and their sources."""

    network: Network  # image points with their covariance; control and scale bars among the points
    cameras: tuple[Camera, ...]  # they have start values of the interior orientation
    images: tuple[str, ...]  # all photographs of the survey, including unreadable ones
    min_rays: IntArray  # photographs that each point needs, (n,)
    failed: tuple[FailedImage, ...] = ()  # photographs that could not be read
    overlays: tuple[PhotographTargets, ...] = ()  # drawn into each photograph of the report
    files: PhotographList | None = None  # None with observations
    photographs: MeasuredPhotographs | None = None  # with all targets, coded or not; None without targets
    naming: Naming = NO_NAMES  # of these targets
    remarks: tuple[Remark, ...] = ()  # on the given and measured values
    left_out: tuple[LeftOutPoint, ...] = ()  # image points that contradict one another
    parts: tuple[Measurements, ...] = ()  # of each source; empty with one source

    def not_in_result(self, image: str, reason: Remark) -> FailedImage:
        """Return a photograph that is not in the result; one without a file is not missed for few points.

        Args:
            image: name of the photograph.
            reason: what a photograph with a file lacks.
        """
        has_file = self.files is None or image in self.files.names
        if not has_file and reason.kind in ("photograph_with_few_points", "not_connected"):
            reason = remark("photographs_without_file", photographs=[image])
        return FailedImage(image, reason)


def remarks_on_contradicting(left_out: Sequence[LeftOutPoint], network: Network) -> tuple[Remark, ...]:
    """Return the one remark on image points that contradict one another, whatever found them.

    Args:
        left_out: image points that are not used, each with its reason.
        network: that of the survey. Where no point keeps its name in later runs, nobody can correct one.
    """
    if not network.named.any():
        return ()
    kind = "image_points_contradicting"
    names = [point.point for point in left_out if point.reason.kind == kind]
    return (remark(kind, image_points=names),) if names else ()


def find_photographs(survey: Survey | SurveyFile, *, images_dir: Path | None = None) -> PhotographList:
    """Return the photographs that match the globs of the cameras, without the masks of others beside them.

    Args:
        survey: a survey with photographs, or its file.
        images_dir: folder of the photographs in place of the one that the survey states. Photographs in this
            folder may be links to files in the user's home folder.

    Raises:
        SurveyFileError: no such folder, or one that the survey may not name, a camera without photographs, a
            photograph of two cameras, a photograph in no group although its camera has groups, or a name with
            control or invisible characters.
    """
    folder = folder_of_photographs(survey, images_dir=images_dir)
    home = survey.folder if images_dir is None and folder.is_relative_to(survey.folder) else folder
    if not folder.is_dir():
        raise SurveyFileError(
            f"{folder}: {why_no_folder(folder)}; needed the folder of the photographs of survey {survey.name}"
        )

    def refuse_outside(path: Path) -> None:
        if images_dir is not None and is_home_file(path):
            return
        name = path.relative_to(home).as_posix()
        path_inside(home, name, survey.source, allow_outside=survey.allow_outside)

    def matching(camera: str, glob: str) -> list[Path]:
        try:
            files = find_files(folder, glob, enter=refuse_outside)
        except ValueError as error:
            raise SurveyFileError(
                f"{survey.source}: camera {camera}: images = '{glob}' is not a glob relative to {folder}"
            ) from error
        if not files:
            others = sorted(path.name for path in folder.iterdir() if path.is_file())
            has = f"{counted(len(others), 'file')} such as '{others[0]}'" if others else "no files"
            raise SurveyFileError(
                f"no photographs found: camera {camera} needs '{glob}' in {folder}, which has {has} "
                "(--images names another folder)"
            )
        return files

    owner: list[tuple[str, Path, int]] = []
    for index, camera in enumerate(survey.cameras):
        matched = sorted({path for glob in camera.images or () for path in matching(camera.name, glob)})
        if not survey.allow_outside:
            for path in matched:
                refuse_outside(path)
        for name in (path.relative_to(folder).as_posix() for path in matched):
            if not is_plain(name):
                raise SurveyFileError(
                    f"{survey.source}: the name of photograph '{as_plain(name)}' has control or invisible "
                    "characters; rename the file"
                )
        owner += [(path.relative_to(folder).as_posix(), path, index) for path in matched]
    masks = masks_of(survey, images_dir=images_dir).beside([name for name, _, _ in owner])
    owner = [(name, path, index) for name, path, index in owner if path.resolve() not in masks]
    names, paths, cameras = zip(*owner, strict=True)
    _refuse_two_cameras(survey, names, cameras)
    refuse_many(survey.source, names)
    refuse_ungrouped(survey.cameras, names, cameras, survey.source)
    return PhotographList(names, paths, np.array(cameras, dtype=np.int64), folder)


def folder_of_photographs(survey: Survey | SurveyFile, *, images_dir: Path | None = None) -> Path:
    """Return the base folder of the globs of photographs.

    Args:
        survey: a survey with photographs, or its file.
        images_dir: folder of the photographs in place of the one that the survey states.

    Raises:
        SurveyFileError: the survey states a folder outside its own, which no one named for it.
    """
    if images_dir is not None:
        return Path(images_dir)
    if survey.photographs is None:
        return survey.folder
    folder = path_inside(survey.folder, survey.photographs, survey.source, allow_outside=True)
    if not (survey.allow_outside or folder.resolve().is_relative_to(survey.folder.resolve())):
        raise SurveyFileError(
            f"{survey.source}: photographs = {survey.photographs!r:.100} leaves the survey's folder; name it "
            "once by kolinear run with --images, or use --allow-outside for survey files that you trust"
        )
    return folder


def masks_of(survey: Survey | SurveyFile, *, images_dir: Path | None = None) -> Masks:
    """Return the masks of a survey: those in the folder of the photographs, else beside the survey file.

    Args:
        survey: a survey with photographs, or its file.
        images_dir: folder of the photographs in place of the one that the survey states.

    Raises:
        SurveyFileError: as `folder_of_photographs`.
    """
    folder = survey.masks
    elsewhere = images_dir is not None or survey.photographs is not None
    if folder is not None and elsewhere and folder.is_relative_to(survey.folder):
        among = folder_of_photographs(survey, images_dir=images_dir) / folder.relative_to(survey.folder)
        folder = among if among.is_dir() else folder
    return Masks(folder)


def _refuse_two_cameras(survey: Survey | SurveyFile, names: Sequence[str], cameras: Sequence[int]) -> None:
    """Raise SurveyFileError if a photograph matches the globs of two cameras."""
    seen: dict[str, int] = {}
    for name, index in zip(names, cameras, strict=True):
        if name in seen:
            first, second = survey.cameras[seen[name]].name, survey.cameras[index].name
            raise SurveyFileError(
                f"{survey.source}: photograph '{name}' matches the globs of cameras {first} and {second}"
            )
        seen[name] = index


def refuse_many(where: str, images: Sequence[str]) -> None:
    """Raise SurveyFileError if there are more photographs than one adjustment can take.

    Args:
        where: name of the survey or table in the error message.
        images: names of the photographs.
    """
    if len(images) > MAX_PHOTOGRAPHS:
        raise SurveyFileError(
            f"{where}: {counted(len(images), 'photograph')}, at most {MAX_PHOTOGRAPHS} are adjusted together"
        )


def readable_photographs(photographs: PhotographList) -> tuple[IntArray, tuple[Metadata, ...]]:
    """Return the indices of the photographs whose metadata can be read, and these."""
    metadata = {}
    for k, path in enumerate(photographs.paths):
        with suppress(PhotographError, OSError):  # the others are reported when they are measured
            metadata[k] = read_metadata(path)
    return np.array(list(metadata), dtype=np.int64), tuple(metadata.values())


def refuse_incomplete_cameras(
    settings: Sequence[CameraSettings], source: str, photographs: PhotographList
) -> None:
    """Raise SurveyFileError if nothing gives the pixel size or principal distance of a camera.

    Args:
        settings: cameras of the survey.
        source: name of the survey in error messages.
        photographs: their EXIF data may give missing values.
    """
    lines = []
    for number, camera in enumerate(settings):
        said = {name for name, _ in (*camera.fixed, *camera.start, *camera.weighted, *camera.balanced)}
        wanted = []  # (key of the survey file, attribute of `Metadata`)
        if camera.pixel_mm is None and camera.sensor_mm is None:
            wanted.append(("pixel_mm or sensor_mm", "pixel_mm"))
        if camera.c_mm is None and not said & {"c", "fx", "f"}:
            wanted.append(("c_mm", "focal_mm"))
        metadata = []
        for k in np.flatnonzero(photographs.camera == number) if wanted else ():
            with suppress(PhotographError, OSError):  # the others are reported when they are measured
                metadata.append(read_metadata(photographs.paths[k]))
        missing = [
            key for key, attribute in wanted if metadata and not any(getattr(m, attribute) for m in metadata)
        ]
        if missing:
            lines.append(f"camera {camera.name}: {' and '.join(missing)}")
    if lines:
        raise SurveyFileError(
            f"{source}: EXIF data of the photographs lack values that are needed: {'; '.join(lines)}"
        )
