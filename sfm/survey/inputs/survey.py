"""A survey: its settings and all given values, from a survey file or from Python."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from sfm.adjustment.datum import Datum
from sfm.files.plain_text import as_plain
from sfm.files.result_tables import read_moments
from sfm.judgement.survey_result import CheckPoint, PlacedEquipment
from sfm.model.arguments import checked_arguments
from sfm.model.display import counted
from sfm.model.errors import SurveyFileError
from sfm.model.observations.pose import MountObservations
from sfm.survey.inputs.calibration import (
    Calibration,
    apply_calibration,
    is_plate_control,
    plate_control,
    plate_family,
    plate_group,
    read_calibrations,
    refuse_contradicting_groups,
    refuse_contradicting_plates,
)
from sfm.survey.inputs.checks.contradictions import refuse_contradictions
from sfm.survey.inputs.equipment import GivenEquipment, given_by, read_equipment
from sfm.survey.inputs.exterior_table import ObservedExterior, mount_observations, read_observed_exterior
from sfm.survey.inputs.given_values import (
    Diameters,
    KnownPoints,
    Observations,
    ScaleBar,
    StartCameras,
    StartOrientations,
    read_diameters,
    read_exterior,
    read_image_points,
    read_points,
    read_start_cameras,
)
from sfm.survey.inputs.ground_control import GroundControl, read_ground_control
from sfm.survey.inputs.marks_file import Mark, Marking, image_points_of, read_marks
from sfm.survey.inputs.pair_list import PairList, read_pairs
from sfm.survey.inputs.settings import (
    AdjustSettings,
    CameraSettings,
    CompareSettings,
    DatumSettings,
    ExteriorSettings,
    Head,
    ObservationSettings,
    PlateSettings,
    PointSettings,
    RigSettings,
    Section,
    TargetSettings,
    TiePointSettings,
    first_error,
)
from sfm.survey.inputs.sources import descriptions, reads_photographs
from sfm.survey.inputs.survey_file import SurveyFile, read_survey_file
from sfm.survey.observation_tables import DISTANCE, ObservationTable, bars_of, read_observation_table
from sfm.targets.codes.plates import TargetFamily, code_family, is_table
from sfm.targets.codes.rings import CodeFamily

T = TypeVar("T")
S = TypeVar("S", bound=Section)


class CameraSetup(CameraSettings):
    """One camera of a survey from Python; the arguments are the keys of [[camera]] in a survey file.

    Example:
        >>> import sfm
        >>> sfm.CameraSetup(name="olympus", images="P*.JPG", c_mm=7.3, free=["c", "x0", "y0", "K1"]).free
        ('c', 'x0', 'y0', 'K1')
    """

    def __init__(self, **settings: Any) -> None:
        try:
            super().__init__(**_plain(settings))
        except ValidationError as error:
            where = f"camera {settings.get('name', '')}".strip()
            raise SurveyFileError(first_error(where, "", error, CameraSettings)) from None


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Survey:
    """A survey: photographs to measure and adjust, and all values known beforehand.

    Given image points may replace the photographs, or stand beside them. Settings may be dictionaries with
    the keys of the survey file, such as `targets={"codes": "ring14"}`.

    Example:
        >>> import sfm
        >>> camera = sfm.CameraSetup(name="olympus", images="P*.JPG", c_mm=7.3, free=["c", "K1"])
        >>> bar = sfm.ScaleBar("506", "507", 1389.688, 0.010)
        >>> sfm.Survey(name="hall", unit="mm", cameras=[camera], scale_bars=[bar])
        <Survey hall: 1 camera, targets of codes none, 1 scale bar, datum free>
    """

    name: str
    cameras: tuple[CameraSettings, ...]  # usually `CameraSetup`
    unit: str = "m"  # object unit, for people and reports
    targets: TargetSettings = field(default_factory=TargetSettings)
    plates: tuple[PlateSettings, ...] = ()  # calibration plates besides the plate of the targets
    tie_points: TiePointSettings | None = None  # natural texture, beside targets if these have codes
    pairs: PairList | None = None  # the only pairs in which it is matched; else those that overlap
    datum: DatumSettings = field(default_factory=DatumSettings)  # or a `Datum` with points by name
    adjust: AdjustSettings = field(default_factory=AdjustSettings)  # the stochastic model
    compare: CompareSettings = field(default_factory=CompareSettings)  # other programs to compare with
    control: KnownPoints | None = None
    exterior: ObservedExterior | None = None
    exif_sigma_m: tuple[float, float] | None = None  # positions in EXIF data instead, see [exterior]
    rigs: tuple[RigSettings, ...] = ()  # cameras that are mounted on one frame
    mounts: tuple[ObservedExterior, ...] = ()  # given mounts of cameras of rigs, by their names
    moments: Mapping[str, str] = field(default_factory=dict)  # moments of photographs from tables
    other_moments: Mapping[str, str] = field(default_factory=dict)  # by a second offset of EXIF clocks
    scale_bars: tuple[ScaleBar, ...] = ()
    tables: tuple[ObservationTable, ...] = ()  # of survey observations: tape, level, GNSS
    copied: tuple[str, ...] = ()  # observations that a table has more than once
    equipment: tuple[PlacedEquipment, ...] = ()  # equipment of the scale bars and tables, for the report
    # measured image points: one table in place of photographs, or tables beside them
    observations: Observations | tuple[Observations, ...] | None = None
    marks: tuple[PointSettings, ...] = ()  # natural points that a person names in photographs
    refused: tuple[Mark, ...] = ()  # image points that a person refused, which take no part
    marked_hashes: Mapping[str, str] = field(default_factory=dict)  # of photographs, when they were marked
    diameters: Diameters | None = None  # of single targets
    start_orientations: StartOrientations | None = None
    start_points: KnownPoints | None = None
    start_cameras: StartCameras | None = None
    masks: Path | None = None  # folder of masks NAME.png, of which black parts are ignored
    folder: Path = Path()  # folder of the survey file, and of the globs of photographs
    photographs: str | None = None  # other folder of these globs, relative to it
    allow_outside: bool = True  # whether photographs may be outside the folder
    source: str = ""  # name of the survey in error messages; else its name

    def __post_init__(self) -> None:
        """Convert arguments from Python into settings, and refuse contradictions."""
        where = self.source or as_plain(f"survey {self.name}")
        head = _section(Head, {"name": self.name, "unit": self.unit}, where)
        cameras = tuple(_section(CameraSettings, camera, f"{where}: camera") for camera in self.cameras)
        if not cameras:
            raise SurveyFileError(f"{where}: no cameras, at least one is needed")
        object.__setattr__(self, "targets", _section(TargetSettings, self.targets, f"{where}: targets"))
        if not reads_photographs(self):  # given image points are adjusted with the stated camera
            said = [
                camera if camera.states_free else camera.model_copy(update={"free": ()}) for camera in cameras
            ]
            cameras = tuple(said)
        datum: object = self.datum
        if isinstance(self.observations, list):
            object.__setattr__(self, "observations", tuple(self.observations))
        if isinstance(datum, Datum):
            datum = {"kind": datum.kind, "points": () if datum.points is None else datum.points}
        values = {
            "name": head.name,
            "unit": head.unit,
            "source": where,
            "cameras": cameras,
            "scale_bars": (*self.scale_bars, *self._distances()),
            "copied": tuple(
                dict.fromkeys((*self.copied, *(n for table in self.tables for n in table.copies)))
            ),
            "tables": tuple(table for table in self.tables if table.kind != DISTANCE),
            "folder": Path(self.folder),
            "masks": None if self.masks is None else Path(self.masks),
            "datum": _section(DatumSettings, datum, f"{where}: datum"),
            "rigs": tuple(_section(RigSettings, rig, f"{where}: rig") for rig in self.rigs),
            "plates": tuple(_section(PlateSettings, plate, f"{where}: plate") for plate in self.plates),
            "marks": tuple(_section(PointSettings, mark, f"{where}: point") for mark in self.marks),
            "adjust": _section(AdjustSettings, self.adjust, f"{where}: adjust"),
            "compare": _section(CompareSettings, self.compare, f"{where}: compare"),
        }
        if self.exif_sigma_m is not None:
            given = {"exif_sigma_m": self.exif_sigma_m}
            values["exif_sigma_m"] = _section(ExteriorSettings, given, f"{where}: exterior").exif_sigma_m
        texture = self.tie_points
        if texture is not None:
            values["tie_points"] = _section(TiePointSettings, texture, f"{where}: tie_points")
        for name, value in values.items():
            object.__setattr__(self, name, value)
        self._place_plate(where)
        refuse_contradictions(self)

    def _distances(self) -> Iterator[ScaleBar]:
        """Yield the bars of tables of distances, which are numbered."""
        number = max((bar.table for bar in self.scale_bars), default=0)
        for table in self.tables:
            number += table.kind == DISTANCE
            yield from bars_of(table, number)

    def _place_plate(self, where: str) -> None:
        """Use the points of a calibration plate as control, and as start values if there are none."""
        refuse_contradicting_plates(self.targets, where)
        refuse_contradicting_groups(self.targets, self.plates, where)
        plate = plate_control(self.targets)
        if plate is None:
            return
        if self.control is not None and not is_plate_control(self.control, plate):
            raise SurveyFileError(f"{where}: control is given, but the calibration plate is the control")
        object.__setattr__(self, "control", plate)
        if self.start_points is None:
            object.__setattr__(self, "start_points", plate)

    @property
    def reject(self) -> str:
        """Treatment of gross errors; the default is "tau", and "none" for given observations."""
        return self.adjust.reject or ("tau" if reads_photographs(self) else "none")

    @property
    def texture(self) -> TiePointSettings:
        """Settings of natural texture; those of a survey that states none if it has none."""
        texture = self.tie_points
        return TiePointSettings() if texture is None else texture

    @property
    def codes(self) -> str:
        """Code family, or the path of the table file."""
        codes = self.targets.codes
        return codes if not is_table(codes) else str(self.folder / codes)

    @cached_property
    def family(self) -> TargetFamily | None:
        """Codes of the targets, None without codes; a table is read once.

        Raises:
            SurveyFileError: the code table is unreadable.
        """
        return survey_family(self.targets, self.codes, self.plates)

    @cached_property
    def check_points(self) -> tuple[CheckPoint, ...]:
        """The points of the control with coordinates that take no part, but check the result."""
        control = self.control
        if control is None or control.check is None:
            return ()
        return tuple(
            CheckPoint(control.names[k], np.where(control.check[k], control.xyz[k], np.nan), control.sigma[k])
            for k in np.flatnonzero(control.check.any(axis=1))
        )

    @cached_property
    def given_mounts(self) -> MountObservations:
        """Known mounts of cameras of rigs, held fixed or observed.

        Raises:
            SurveyFileError: a table gives an incomplete mount, or the mount of a camera on no rig.
        """
        return mount_observations(self.mounts, self.rigs, [camera.name for camera in self.cameras])

    def __repr__(self) -> str:
        count = len(self.cameras)
        what = [counted(count, "camera")]
        what += descriptions(self)
        if self.control is not None:
            what.append(counted(len(self.control.names), "control point"))
        if self.rigs:
            what.append(counted(len(self.rigs), "rig"))
        if self.scale_bars:
            what.append(counted(len(self.scale_bars), "scale bar"))
        return f"<Survey {self.name}: {', '.join(what)}, datum {self.datum.kind}>"


@checked_arguments()
def read_survey(path: str | Path, *, allow_outside: bool = False) -> Survey:
    """Read a survey file and the tables that it names, each once.

    Args:
        path: the TOML file; the paths in it are relative to it.
        allow_outside: whether these paths may lead out of its folder; do not allow it for files of strangers.

    Raises:
        SurveyFileError: the file or a table is unreadable, has an unknown key or column, a wrong type, or
            settings that contradict one another. The message states the file, the position, the value found
            and the value needed.

    Example:
        >>> import sfm
        >>> sfm.read_survey("datasets/demo/survey.toml")
        <Survey demo: 1 camera, targets of codes ring14, 2 scale bars, datum free>
    """
    return survey_of_file(read_survey_file(Path(path), allow_outside=allow_outside))


def survey_of_file(file: SurveyFile) -> Survey:
    """Return the survey that a survey file describes, with all its tables, each read once.

    Raises:
        SurveyFileError: a table is unreadable.
    """

    def read(reader: Callable[[Path], T], name: str | None) -> T | None:
        return None if name is None else reader(file.beside(name))

    equipment = _given_by_equipment(file)
    marking = _marking_of(file)
    control = (
        read_ground_control(file.beside(file.control.file), file.control, file.unit) if file.control else None
    )
    bars = tuple(ScaleBar(bar.start, bar.end, bar.length, bar.sigma) for bar in file.scale_bars)
    bars += equipment.bars
    if marking is not None:  # a person states bars in the marks file in place of the same ones
        stated = {frozenset(ends) for ends in marking.bars}
        kept = (bar for bar in bars if frozenset((bar.start, bar.end)) not in stated)
        bars = (*kept, *marking.bars.values())
    return Survey(
        name=file.name,
        unit=file.unit,
        cameras=tuple(_calibrated_as_named(camera, file) for camera in file.cameras),
        targets=file.targets,
        plates=file.plates,
        tie_points=file.tie_points,
        pairs=read(read_pairs, file.texture.pairs),
        datum=file.datum,
        adjust=file.adjust,
        compare=file.compare,
        control=_with_stated(None if control is None else control.points, marking),
        exterior=read(read_observed_exterior, file.exterior.file if file.exterior else None),
        exif_sigma_m=file.exif_sigma_m,
        rigs=file.rigs,
        mounts=tuple(
            read_observed_exterior(file.beside(rig.mounts), of="camera")
            for rig in file.rigs
            if rig.mounts is not None
        ),
        moments={
            image: moment
            for name in dict.fromkeys(rig.table for rig in file.rigs if rig.table is not None)
            for image, moment in read_moments(file.beside(name))
        },
        tables=tuple(
            read_observation_table(table.kind, file.beside(table.file), file.source)
            for table in file.observation_tables
        )
        + equipment.frames,
        equipment=equipment.placed,
        scale_bars=bars,
        observations=_given_image_points(file, control, marking),
        marks=file.marks,
        refused=() if marking is None else marking.left_out,
        marked_hashes={} if marking is None else marking.hashes,
        diameters=read(read_diameters, file.targets.diameters),
        masks=file.masks,
        start_orientations=read(read_exterior, file.approximate.images),
        start_points=read(read_points, file.approximate.points),
        start_cameras=read(read_start_cameras, file.approximate.cameras),
        folder=file.folder,
        photographs=file.photographs,
        allow_outside=file.allow_outside,
        source=file.source,
    )


def _marking_of(file: SurveyFile) -> Marking | None:
    """Return the marks that a survey file names.

    Raises:
        SurveyFileError: the marks file is unreadable, or has the marks of another survey.
    """
    if file.marked is None:
        return None
    path = file.beside(file.marked.file)
    marking = read_marks(path)
    if marking.survey not in ("", file.name):
        raise SurveyFileError(
            f"{path}: has the marks of survey '{marking.survey}', but {file.source} is '{file.name}'"
        )
    return marking


def _with_stated(control: KnownPoints | None, marking: Marking | None) -> KnownPoints | None:
    """Return the control with the coordinates that a person states in the marks file, which come first."""
    stated = None if marking is None else marking.known_points()
    if control is None or stated is None:
        return control or stated
    kept = control.select(~np.isin(control.names, stated.names))
    n = len(stated.names)
    return KnownPoints(
        (*kept.names, *stated.names),
        np.vstack([kept.xyz, stated.xyz]),
        np.vstack([kept.sigma, stated.sigma]),
        None if kept.covariances is None else np.vstack([kept.covariances, np.zeros((n, 3))]),
        None if kept.check is None else np.vstack([kept.check, np.zeros((n, 3), dtype=bool)]),
    )


def _given_image_points(
    file: SurveyFile, control: GroundControl | None, marking: Marking | None
) -> Observations | tuple[Observations, ...] | None:
    """Return the image points that a survey file gives, in place of photographs or beside them.

    Raises:
        SurveyFileError: a table is unreadable, or control with image points contradicts other settings.
    """
    if control is not None and control.is_geographic and file.exif_sigma_m is not None:
        raise SurveyFileError(
            f"{file.source}: control by latitude and longitude and exterior.exif_sigma_m have different "
            "origins, needed one of them"
        )
    tables = tuple(
        replace(read_image_points(file.beside(table.file)), sigma_px=table.sigma_px)
        for table in (file.image_points, *file.more_image_points)
        if table is not None
    )
    if marking is not None and file.marked is not None:
        if file.image_points is not None:
            raise SurveyFileError(
                f"{file.source}: [observations] stands in place of photographs, and [marks] beside them; "
                "write [[observations]]"
            )
        of_marks = image_points_of(marking, file.beside(file.marked.file), file.adjust.sigma_px)
        tables += () if of_marks is None else (of_marks,)
    if control is not None and control.image_points is not None:
        if isinstance(file.observations, ObservationSettings):
            raise SurveyFileError(
                f"{file.source}: [observations] stands in place of photographs, and the control has image "
                "points beside them; write [[observations]]"
            )
        return (*tables, control.image_points)
    return tables if isinstance(file.observations, tuple) else next(iter(tables), None)


def _given_by_equipment(file: SurveyFile) -> GivenEquipment:
    """Return the scale bars and frames of the equipment that a survey file names.

    Raises:
        SurveyFileError: equipment without an equipment file, or as in `read_equipment` and `given_by`.
    """
    if file.head.equipment is None:
        if file.equipment:
            raise SurveyFileError(
                f"{file.source}: [[equipment]] needs survey.equipment, the file that describes it"
            )
        return GivenEquipment()
    return given_by(
        read_equipment(file.beside(file.head.equipment), allow_outside=file.allow_outside),
        file.equipment,
        file.source,
        file.unit,
        file.head.temperature,
        file.head.temperature_sigma,
    )


def with_calibration(
    survey: Survey, calibrations: tuple[Calibration, ...], source: str, *, weighted: bool = False
) -> Survey:
    """Return the survey with each camera held at a calibration, or with the calibration as an observation.

    Args:
        survey: its cameras take the calibration of their name, or the only one, see `apply_calibration`.
        calibrations: cameras of an earlier result.
        source: name of the earlier result in error messages.
        weighted: whether the cameras are adjusted, with the calibration and its covariance as an observation;
            else they are held.

    Raises:
        SurveyFileError: as in `apply_calibration`.
    """
    cameras = (
        apply_calibration(camera, calibrations, survey.source, source, weighted=weighted)
        for camera in survey.cameras
    )
    return replace(survey, cameras=tuple(cameras))


def _calibrated_as_named(camera: CameraSettings, file: SurveyFile) -> CameraSettings:
    """Return the settings of a camera with the calibration that they name, if any."""
    if camera.calibration is None:
        return camera
    folder = file.beside(camera.calibration)
    weighted = camera.calibration_use == "weighted"
    return apply_calibration(
        camera, read_calibrations(folder), file.source, camera.calibration, weighted=weighted
    )


def survey_family(
    targets: TargetSettings, codes: str, plates: Sequence[PlateSettings] = ()
) -> TargetFamily | None:
    """Return the codes of a survey, with its stated radii of rings; None without codes.

    Args:
        targets: settings of the targets.
        codes: name of the family, or path of the table.
        plates: further plates beside that of the targets.

    Raises:
        SurveyFileError: the code table is unreadable.
    """
    if plates:
        return plate_group(targets, plates)
    plate = plate_family(targets)
    if plate is not None:
        return plate
    family = code_family(codes)
    if targets.ring_radii is not None and isinstance(family, CodeFamily):
        return replace(family, inner=targets.ring_radii[0], outer=targets.ring_radii[1])
    return family


def _section(kind: type[S], value: object, where: str) -> S:
    """Return settings unchanged, or from a dictionary with the keys of the survey file."""
    if isinstance(value, kind):
        return value
    if not isinstance(value, Mapping):
        raise SurveyFileError(f"{where}: found {value!r:.60}, needed settings as in the survey file")
    try:
        return kind.model_validate(_plain(value))
    except ValidationError as error:
        raise SurveyFileError(first_error(where, "", error, kind)) from None


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with Python lists and numbers in place of numpy's."""
    return {key: value.tolist() if hasattr(value, "tolist") else value for key, value in settings.items()}
