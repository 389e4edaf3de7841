"""The survey file (TOML): reading and checking.

`sfm.survey.inputs.settings` declares its sections.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, get_origin

from pydantic import Field, PrivateAttr, ValidationError

from sfm.files.open_folders import path_inside
from sfm.files.plain_text import as_plain, is_plain, read_toml
from sfm.model.errors import SurveyFileError
from sfm.photographs.exif import conversion_of
from sfm.photographs.reading import SUFFIXES
from sfm.survey.inputs.calibration import TABLES
from sfm.survey.inputs.checks.contradictions import refuse_contradictions
from sfm.survey.inputs.equipment import read_equipment
from sfm.survey.inputs.settings import (
    MAX_PHOTOGRAPHS,
    MAX_RIGS,
    MAX_TABLES,
    AdjustSettings,
    ApproximateSettings,
    CameraSettings,
    CompareSettings,
    ControlSettings,
    DatumSettings,
    EquipmentSettings,
    ExteriorSettings,
    Head,
    MarksSettings,
    ObservationSettings,
    ObservationTableSettings,
    PlateSettings,
    PointSettings,
    RigSettings,
    ScaleBarSettings,
    Section,
    TargetSettings,
    TiePointSettings,
    first_error,
)
from sfm.targets.codes.plates import is_table

BESIDE = "[[observations]]"  # key of tables of image points beside photographs


class SurveyFile(Section):
    """Content of a survey file; its tables are not read yet."""

    head: Head = Field(alias="survey")
    cameras: Annotated[
        tuple[CameraSettings, ...],
        Field(strict=False, min_length=1, max_length=MAX_PHOTOGRAPHS, alias="camera"),
    ]
    targets: TargetSettings = TargetSettings()
    plates: Annotated[tuple[PlateSettings, ...], Field(strict=False, alias="plate")] = ()
    tie_points: TiePointSettings | None = None
    datum: DatumSettings = DatumSettings()
    control: ControlSettings | None = None
    exterior: ExteriorSettings | None = None
    rigs: Annotated[tuple[RigSettings, ...], Field(strict=False, max_length=MAX_RIGS, alias="rig")] = ()
    scale_bars: Annotated[tuple[ScaleBarSettings, ...], Field(strict=False, alias="scale_bar")] = ()
    equipment: Annotated[tuple[EquipmentSettings, ...], Field(strict=False, max_length=MAX_TABLES)] = ()
    image_points: ObservationSettings | None = Field(None, alias="observations")  # in place of photographs
    more_image_points: Annotated[  # beside them
        tuple[ObservationSettings, ...], Field(strict=False, max_length=MAX_TABLES, alias=BESIDE)
    ] = ()
    marked: MarksSettings | None = Field(None, alias="marks")
    marks: Annotated[tuple[PointSettings, ...], Field(strict=False, alias="point")] = ()
    observation_tables: Annotated[
        tuple[ObservationTableSettings, ...],
        Field(strict=False, max_length=MAX_TABLES, alias="survey_observations"),
    ] = ()
    approximate: ApproximateSettings = ApproximateSettings()
    adjust: AdjustSettings = AdjustSettings()
    compare: CompareSettings = CompareSettings()
    _path: Path = PrivateAttr(default=Path("survey.toml"))
    _allow_outside: bool = PrivateAttr(default=False)
    _masks: Path | None = PrivateAttr(default=None)

    @property
    def path(self) -> Path:
        """The survey file."""
        return self._path

    @property
    def name(self) -> str:
        """Name of the survey."""
        return self.head.name

    @property
    def unit(self) -> str:
        """Object unit."""
        return self.head.unit

    @property
    def source(self) -> str:
        """Name of the survey in error messages."""
        return str(self._path)

    @property
    def folder(self) -> Path:
        """Folder of the survey file, and of the photographs unless `photographs` states another."""
        return self._path.parent

    @property
    def photographs(self) -> str | None:
        """Folder of the photographs as stated, relative to the survey file; None if it has its own."""
        return self.head.photographs

    @property
    def texture(self) -> TiePointSettings:
        """Settings of natural texture; those of a survey that states none if it has none."""
        stated = self.tie_points
        return TiePointSettings() if stated is None else stated

    @property
    def codes(self) -> str:
        """Code family, or the path of the table file."""
        codes = self.targets.codes
        return codes if not is_table(codes) else str(self.beside(codes))

    @property
    def observations(self) -> ObservationSettings | tuple[ObservationSettings, ...] | None:
        """Tables of image points: one in place of photographs, or several beside them."""
        marked = () if self.marked is None else (ObservationSettings(file=self.marked.file),)
        return self.image_points or (*self.more_image_points, *marked) or None

    @property
    def start_points(self) -> str | None:
        """Table of approximate object points."""
        return self.approximate.points

    @property
    def exif_sigma_m(self) -> tuple[float, float] | None:
        """Standard deviations of EXIF positions, m, if these are observed."""
        return self.exterior.exif_sigma_m if self.exterior else None

    @property
    def allow_outside(self) -> bool:
        """Whether the survey may name files outside its folder."""
        return self._allow_outside

    @property
    def masks(self) -> Path | None:
        """Folder of the masks; None without any."""
        if self._masks is not None:
            return self._masks
        return None if self.head.masks is None else self.beside(self.head.masks)

    def with_masks(self, folder: Path | None) -> SurveyFile:
        """Return this survey file with the folder where its masks were found.

        Args:
            folder: folder of the masks; None without any.
        """
        found = self.model_copy()
        found._masks = folder
        return found

    def beside(self, name: str) -> Path:
        """Return the path of a file from its name relative to the survey file.

        Raises:
            SurveyFileError: the path leaves the survey's folder; only the person who runs the survey can
                allow that.
        """
        return path_inside(self._path.parent, name, str(self._path), allow_outside=self._allow_outside)

    def tables(self) -> tuple[Path, ...]:
        """Return the paths of all tables of the survey.

        Raises:
            SurveyFileError: a path leaves the survey's folder.
        """
        names = list(self.files())
        if is_table(self.targets.codes):
            names.append(self.targets.codes)
        if self.head.equipment is not None:
            path = self.beside(self.head.equipment)
            equipment = read_equipment(path, allow_outside=self._allow_outside)
            folder = Path(self.head.equipment).parent
            names += [str(folder / frame.file) for frame in equipment.content.frames]
        for camera in self.cameras:
            if camera.calibration is not None:
                names += [f"{camera.calibration}/{name}" for name in TABLES]
        return tuple(self.beside(name) for name in names)


def read_survey_file(path: Path, *, allow_outside: bool = False) -> SurveyFile:
    """Read and check a survey file, without the tables that it names.

    Args:
        path: the TOML file; the paths in it are relative to it.
        allow_outside: whether these paths may lead out of its folder; do not allow it for files of strangers.

    Raises:
        SurveyFileError: the file is unreadable or not TOML, or has an unknown key, a wrong type, or settings
            that contradict one another. The message states the file, the key, the value found and the value
            needed.
    """
    path = Path(path)
    if not is_plain(str(path)):
        raise SurveyFileError(
            f"{as_plain(str(path))}: the path has control or invisible characters; rename the file or folder"
        )
    if path.suffix.lower() in SUFFIXES:
        raise SurveyFileError(f"{path}: is a photograph, not a survey file; give its folder")
    if unread := conversion_of(path):
        raise SurveyFileError(f"{path}: is no survey file but {unread}")
    fields = SurveyFile.model_fields.items()
    repeated = {field.alias or name for name, field in fields if get_origin(field.annotation) is tuple}
    text, table = read_toml(path, "a survey file", repeated=repeated)
    if isinstance(table.get("observations"), list):
        table[BESIDE] = table.pop("observations")
    try:
        survey = SurveyFile.model_validate(table)
    except ValidationError as error:
        raise SurveyFileError(first_error(path, text, error, SurveyFile)) from error
    survey._path, survey._allow_outside = path, allow_outside
    refuse_contradictions(survey)
    return survey
