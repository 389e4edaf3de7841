"""Inputs of the planning commands: object, cameras, stations, scale bars, and a planned survey.

Source: sizes of sensors and photographs as stated by the makers; Nikon D60 as in document 000, sec. 2.5.1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sfm.model.display import counted, listed
from sfm.model.errors import GeometryError, SurveyFileError

if TYPE_CHECKING:
    from sfm.model.camera import Camera
    from sfm.model.estimate import Mounts
    from sfm.model.network import Network
    from sfm.products.planning.planned_object import PlannedObject
    from sfm.products.planning.prediction import ScaleBarPlan
    from sfm.products.planning.stations import Stations
    from sfm.survey.inputs.settings import CameraSettings
    from sfm.survey.inputs.survey import Survey
    from sfm.survey.observation_tables import ObservationTable

SENSORS = {
    "full-frame-24": ((6000, 4000), (36.0, 24.0)),
    "full-frame-45": ((8192, 5464), (36.0, 24.0)),
    "full-frame-61": ((9504, 6336), (35.7, 23.8)),
    "aps-c-24": ((6000, 4000), (23.5, 15.6)),
    "four-thirds-20": ((5184, 3888), (17.3, 13.0)),
    "one-inch-20": ((5472, 3648), (13.2, 8.8)),
    "machine-vision-5": ((2448, 2048), (8.446, 7.066)),
    "machine-vision-12": ((4096, 3000), (14.131, 10.35)),
    "nikon-d60": ((3872, 2592), (23.6, 15.8)),
}
"""Width and height of the photographs, px, and of the sensor, mm."""
NORMALS = ("nX", "nY", "nZ")


def object_of(text: str, count: int, *, open_mesh: bool) -> PlannedObject:
    """Return the object of a plan: points of a CSV file, a mesh, or a shape with given sizes.

    Args:
        text: path, or a shape such as box:2,1,0.5.
        count: number of points on a mesh or a shape.
        open_mesh: whether a mesh may have edges that belong to one triangle only.

    Raises:
        KolinearError: the message states what was found and what was expected.
    """
    from adapters.formats.mesh import ENDINGS, read_mesh
    from sfm.products.geometry.tolerance import Mesh
    from sfm.products.planning.planned_object import SHAPES, object_of_mesh, object_of_points, shape_object

    kind, colon, sizes = text.partition(":")
    if colon and kind in SHAPES:
        return shape_object(kind, parse_numbers("OBJECT", sizes), count)
    path = Path(text)
    if path.suffix.lower() in ENDINGS:
        vertices, triangles = read_mesh(path)
        return object_of_mesh(Mesh(vertices, triangles), count, open_surface=open_mesh)
    if path.suffix.lower() != ".csv":
        shapes = ", ".join(f"{kind}:{','.join(sizes)}" for kind, sizes in SHAPES.items())
        raise SurveyFileError(
            f"{text}: expected points (.csv), a mesh ({', '.join(ENDINGS)}) or one of {shapes}"
        )
    from sfm.files.csv_tables import read_table

    table = read_table(
        path, ("id",), ("X", "Y", "Z"), NORMALS, aliases=(("point", "id"),), ignored=None, blank=NORMALS
    )
    normals = table.values[:, 3:] if table.values.shape[1] > 3 else None
    return object_of_points(table.keys("id"), table.values[:, :3].copy(), normals)


def camera_of(text: str, name: str | None, c_mm: float | None, free: str | None) -> Camera:
    """Return the camera of a plan: a listed camera, a camera of a survey file, or a calibrated camera.

    Args:
        text: name of a listed camera, survey file, or result folder.
        name: camera name, if there are several cameras.
        c_mm: principal distance that replaces the stored one, mm.
        free: parameters to adjust, separated by commas, or "none"; if None, those of the camera.

    Raises:
        KolinearError: the message states what was found and what was expected.
    """
    import numpy as np

    path = Path(text)
    if path.is_dir():
        from adapters.formats.result_tables import read_result

        cameras = read_result(path).estimate.cameras
        names = [camera.name for camera in cameras]
        if name is None and len(cameras) > 1:
            raise SurveyFileError(
                f"{text}: has {counted(len(cameras), 'camera')} ({', '.join(names)[:80]}), choose one with "
                "--camera-name"
            )
        named = [camera for camera in cameras if name in (None, camera.name)]
        if not named:
            raise SurveyFileError(f"--camera-name {name}: {text} has {', '.join(names)[:80]}")
        camera = named[0]
    elif path.suffix.lower() == ".toml":
        camera = _camera_of_survey(path, name, c_mm)
    else:
        camera = listed_camera(text, c_mm)
    if c_mm is not None:
        if not camera.in_mm:
            raise SurveyFileError(
                f"--c-mm {c_mm:g}: camera {camera.name} ({camera.model}) has its principal distance in px"
            )
        if not (math.isfinite(c_mm) and c_mm > 0):
            raise SurveyFileError(f"--c-mm {c_mm:g}: expected more than 0")
        parameters = camera.parameters.copy()
        parameters[0] = c_mm
        camera = camera.with_parameters(parameters)
    if free is None:
        return camera
    wanted = [] if free.strip() in ("", "none") else [parameter.strip() for parameter in free.split(",")]
    unknown = [parameter for parameter in wanted if parameter not in camera.names]
    if unknown:
        raise SurveyFileError(
            f"--free {unknown[0]:.40}: camera {camera.name} ({camera.model}) has {', '.join(camera.names)}"
        )
    return replace(camera, free=np.array([parameter in wanted for parameter in camera.names]))


def stations_of(text: str, planned: PlannedObject, camera: Camera) -> Stations:
    """Return the given stations: exterior orientations of a CSV file, or an arrangement such as ring:12.

    Args:
        text: path, or name of an arrangement.
        planned: the object.
        camera: camera of the arrangement.

    Raises:
        KolinearError: the message states what was found and what was expected.
    """
    import numpy as np

    from sfm.files.csv_tables import read_table
    from sfm.model.conventions import rotation_from_angles
    from sfm.products.planning.stations import Stations, arrangement

    path = Path(text)
    if path.suffix.lower() != ".csv":
        return arrangement(text, planned, camera)
    angles = ("omega_deg", "phi_deg", "kappa_deg")
    table = read_table(path, ("image",), ("X", "Y", "Z", *angles), ignored=None)
    rotation = np.array([rotation_from_angles(*np.radians(row)) for row in table.values[:, 3:]])
    return Stations(table.keys("image"), table.values[:, :3].copy(), rotation)


def bars_of(texts: list[str] | None) -> tuple[ScaleBarPlan, ...]:
    """Return the scale bars of texts FROM,TO,SIGMA."""
    from sfm.products.planning.prediction import ScaleBarPlan

    bars = []
    for text in texts or ():
        parts = [part.strip() for part in text.split(",")]
        if len(parts) != 3:
            raise SurveyFileError(f"--scale-bar {text:.60}: expected FROM,TO,SIGMA")
        bars.append(ScaleBarPlan(parts[0], parts[1], parse_numbers("--scale-bar", parts[2], 1)[0]))
    return tuple(bars)


def parse_numbers(what: str, text: str, count: int | None = None) -> tuple[float, ...]:
    """Return the numbers of a text, which are separated by commas.

    Args:
        what: name of the option or argument, for messages.
        text: the numbers.
        count: expected count; None for any.

    Raises:
        SurveyFileError: there are more or fewer numbers than expected, or a value is not a finite number.
    """
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if not numbers or not all(map(math.isfinite, numbers)) or (count is not None and len(numbers) != count):
        wanted = "numbers" if count is None else counted(count, "number")
        raise SurveyFileError(f"{what} {text:.60}: expected {wanted} separated by commas")
    return numbers


def _camera_of_survey(path: Path, name: str | None, c_mm: float | None) -> Camera:
    from sfm.survey.inputs.survey import read_survey

    setups = read_survey(path).cameras
    named = [camera for camera in setups if name in (None, camera.name)]
    if len(named) != 1:
        names = ", ".join(camera.name for camera in setups)
        raise SurveyFileError(f"{path}: has cameras {names:.80}, choose one with --camera-name")
    return _camera_of_settings(path, named[0], c_mm)


def _camera_of_settings(path: Path, settings: CameraSettings, c_mm: float | None = None) -> Camera:
    from sfm.model.camera import camera_from_values

    c = c_mm if c_mm is not None else settings.c_mm
    if c is None:
        raise SurveyFileError(f"{path}: camera {settings.name} has no focal length, expected c_mm or --c-mm")
    pixel = settings.pixel_mm
    if pixel is None and settings.sensor_mm is not None and settings.size_px is not None:
        pixel = (settings.sensor_mm[0] / settings.size_px[0], settings.sensor_mm[1] / settings.size_px[1])
    if settings.size_px is None or pixel is None:
        raise SurveyFileError(
            f"{path}: camera {settings.name} needs size_px and pixel_mm, as a plan has no photographs that "
            "state them"
        )
    return camera_from_values(
        settings.name,
        settings.model,
        settings.size_px,
        pixel,
        c_mm=c,
        free=settings.may_be_free,
        values=(*settings.fixed, *settings.start),
    )


@dataclass(frozen=True)
class PlannedSetup:
    """Cameras and rig of a plan, and the observations in addition to image points."""

    cameras: tuple[Camera, ...]
    rig: Mounts | None = None
    bars: tuple[ScaleBarPlan, ...] = ()
    given: Callable[[Network], Network] | None = None
    survey: Survey | None = None

    @property
    def reference(self) -> Camera:
        """The only camera, or the reference camera of a rig, to which stations refer."""
        return self.cameras[0 if self.rig is None else int(self.rig.at_reference.argmax())]

    def photographs(self, stations: Stations) -> Stations:
        """Return the photographs that all cameras take at the stations.

        Raises:
            SurveyFileError: an observation refers to a photograph that is not among them.
        """
        if self.rig is not None:
            stations = stations.with_rig(self.rig, self.cameras)
        for table in self._tables_of_photographs():
            missing = [name for column in table.named for name in column if name not in stations.names]
            if missing:
                raise SurveyFileError(
                    f"{table.table.path}: photograph '{missing[0]}' is not in the plan; it has "
                    f"{listed(stations.names, most=4)}"
                )
        return stations

    def refuse_to_design(self) -> None:
        """Refuse to design stations where they must be given.

        Raises:
            SurveyFileError: the plan has a rig or observations of photographs.
        """
        if self.rig is not None or self._tables_of_photographs():
            raise SurveyFileError("plan: a rig or observations of photographs need --stations")

    def _tables_of_photographs(self) -> list[ObservationTable]:
        from sfm.model.observations.kind import PHOTOGRAPH

        tables = () if self.survey is None else self.survey.tables
        return [table for table in tables if table.of.texts_of == PHOTOGRAPH]


def survey_plan(path: Path, planned: PlannedObject, unit: str, *, free_mounts: bool) -> PlannedSetup:
    """Return the cameras, rig, scale bars and observations of a planned survey.

    Args:
        path: survey file.
        planned: the object.
        unit: unit of lengths of the plan.
        free_mounts: whether mounts are estimated; the given mounts then only state where they are planned.

    Raises:
        SurveyFileError: the survey has another unit of lengths, not all cameras form one rig, or an
            observation refers to points that the object does not have.
    """
    import numpy as np

    from sfm.products.planning.prediction import ScaleBarPlan
    from sfm.survey.inputs.start import with_given_mounts
    from sfm.survey.inputs.survey import read_survey
    from sfm.survey.observation_tables import with_tables
    from sfm.survey.rigs import planned_mounts

    survey = read_survey(path)
    if survey.unit != unit:
        raise SurveyFileError(f"{path}: has unit '{survey.unit}', but the plan has '{unit}'; see --unit")
    cameras = tuple(_camera_of_settings(path, camera) for camera in survey.cameras)
    rig = None if len(cameras) == 1 and not survey.rigs else planned_mounts(survey)
    if rig is not None and free_mounts:
        rig = replace(rig, free=np.tile(~rig.at_reference[:, None], (1, 6)))
    known = set(planned.names)
    ends = [(f"scale bar {bar.start} - {bar.end}", (bar.start, bar.end)) for bar in survey.scale_bars]
    for what, points in (*ends, *(row for table in survey.tables for row in table.points())):
        missing = [point for point in points if point not in known]
        if missing:
            raise SurveyFileError(f"{path}: {what}: point '{missing[0]}' is not in the object of the plan")

    def given(network: Network) -> Network:
        network = with_tables(survey.tables, network)
        return network if rig is None or free_mounts else with_given_mounts(survey.given_mounts, network)

    bars = tuple(ScaleBarPlan(bar.start, bar.end, bar.sigma) for bar in survey.scale_bars)
    return PlannedSetup(cameras, rig, bars, given, survey)


FREE = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2")
"""Parameters that a self-calibrating adjustment usually determines."""


def listed_camera(name: str, c_mm: float | None) -> Camera:
    """Return a listed camera with a distortion-free lens, whose interior orientation is adjusted.

    Args:
        name: key of SENSORS.
        c_mm: principal distance, mm.

    Raises:
        GeometryError: the name is not listed, or there is no principal distance.
    """
    from sfm.model.camera import camera_from_values

    if name not in SENSORS:
        raise GeometryError(
            f"camera '{name:.60}': expected a survey file, a result folder or one of {', '.join(SENSORS)}"
        )
    if c_mm is None:
        raise GeometryError(f"camera {name}: no focal length, expected --c-mm")
    size, sensor = SENSORS[name]
    pixel = (sensor[0] / size[0], sensor[1] / size[1])
    return camera_from_values(name, "brown", size, pixel, c_mm=c_mm, free=FREE)
