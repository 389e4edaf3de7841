"""The survey file (TOML): read and checked; what its sections may say is in `sfm.survey.inputs.settings`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field, PrivateAttr, ValidationError

from sfm.distortion.models import MODELS
from sfm.errors import SurveyFileError
from sfm.files.plain_text import as_plain, is_plain
from sfm.files.toml_files import read_toml
from sfm.survey.inputs.settings import (
    MAX_CAMERAS,
    MAX_LENGTH_PER_SIGMA,
    AdjustSettings,
    ApproximateSettings,
    CameraSettings,
    CompareSettings,
    ControlSettings,
    DatumSettings,
    ExteriorSettings,
    Head,
    ObservationSettings,
    ScaleBarSettings,
    Section,
    TargetSettings,
    TiePointSettings,
)
from sfm.survey.inputs.settings_errors import first_error
from sfm.targets.codes.families import FAMILIES
from sfm.targets.codes.tags import DICTIONARIES


class Survey(Section):
    """A survey as its file describes it."""

    head: Head = Field(alias="survey")
    cameras: Annotated[
        tuple[CameraSettings, ...], Field(strict=False, min_length=1, max_length=MAX_CAMERAS, alias="camera")
    ]
    targets: TargetSettings = TargetSettings()
    tie_points: TiePointSettings | None = None
    datum: DatumSettings = DatumSettings()
    control: ControlSettings | None = None
    exterior: ExteriorSettings | None = None
    scale_bars: Annotated[tuple[ScaleBarSettings, ...], Field(strict=False, alias="scale_bar")] = ()
    observations: ObservationSettings | None = None
    approximate: ApproximateSettings = ApproximateSettings()
    adjust: AdjustSettings = AdjustSettings()
    compare: CompareSettings = CompareSettings()
    _path: Path = PrivateAttr(default=Path("survey.toml"))
    _allow_outside: bool = PrivateAttr(default=False)

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
    def reject(self) -> str:
        """How outliers are treated; given observations are adjusted as they are unless the file says so."""
        return self.adjust.reject or ("tau" if self.observations is None else "none")

    @property
    def codes(self) -> str:
        """Code family, or the path of the table file."""
        codes = self.targets.codes
        return codes if codes in FAMILIES else str(self.beside(codes))

    @property
    def allow_outside(self) -> bool:
        """Whether the survey may name files outside its own folder."""
        return self._allow_outside

    def beside(self, name: str) -> Path:
        """Return the path of a file that is named relative to the survey file.

        Raises:
            SurveyFileError: it leaves the survey's folder, which only the person who runs it can allow.
        """
        return inside(self._path.parent, name, str(self._path), allow_outside=self._allow_outside)

    def tables(self) -> tuple[Path, ...]:
        """Return the paths of all tables that the survey names.

        Raises:
            SurveyFileError: one of them leaves the survey's folder.
        """
        names = [
            self.control.file if self.control else None,
            self.exterior.file if self.exterior else None,
            self.observations.file if self.observations else None,
            self.approximate.images,
            self.approximate.points,
            None if self.targets.codes in FAMILIES else self.targets.codes,
            self.targets.diameters,
        ]
        return tuple(self.beside(name) for name in names if name is not None)


def inside(folder: Path, name: str, where: str, *, allow_outside: bool = False) -> Path:
    """Return the path of a file in a folder, links followed.

    Args:
        folder: the folder.
        name: a path relative to it.
        where: the file that names it, for the error.
        allow_outside: whether it may leave the folder.

    Raises:
        SurveyFileError: the path leaves the folder, or is none.
    """
    try:
        path = folder / name
        path.is_file()  # raises where a name is too long for the disk
        left = not path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError) as error:  # a circle of links, a null byte
        raise SurveyFileError(f"{where}: {name!r:.100} is no path of a file") from error
    if left and not allow_outside:
        raise SurveyFileError(
            f"{where}: {name!r:.100} leaves the survey's folder; --allow-outside allows that, "
            "for survey files that you trust"
        )
    return path


def read_survey(path: Path, *, allow_outside: bool = False) -> Survey:
    """Read and check a survey file.

    Args:
        path: the TOML file; every path in it is relative to it.
        allow_outside: whether these paths may lead out of its folder; a file from a stranger should not.

    Raises:
        SurveyFileError: unreadable, no TOML, an unknown key, a wrong type, or settings that contradict one
            another; the line names the file, the key, what was found and what was needed.
    """
    path = Path(path)
    if not is_plain(str(path)):
        raise SurveyFileError(f"{as_plain(str(path))}: the path is no plain text; rename the file or folder")
    text, table = read_toml(path, "a survey file")
    try:
        survey = Survey.model_validate(table)
    except ValidationError as error:
        raise SurveyFileError(first_error(path, text, error, Survey)) from error
    survey._path, survey._allow_outside = path, allow_outside
    _refuse_contradictions(survey)
    return survey


def _refuse_contradictions(survey: Survey) -> None:
    """Raise SurveyFileError where settings that are fine one by one do not go together."""
    where = str(survey.path)
    if survey.tie_points is not None:
        if survey.targets.codes != "none":
            raise SurveyFileError(
                f"{where}: [tie_points] take the place of targets, codes = '{survey.targets.codes}' asks for "
                "targets; needed codes = 'none', or no [tie_points]"
            )
        if survey.tie_points.window_px % 2 == 0:
            raise SurveyFileError(
                f"{where}: tie_points.window_px = {survey.tie_points.window_px}, needed an odd number"
            )
    names = [camera.name for camera in survey.cameras]
    for name in names:
        if names.count(name) > 1:
            raise SurveyFileError(f"{where}: two cameras are named '{name}'")
    for camera in survey.cameras:
        _refuse_contradictions_of_camera(camera, f"{where}: camera {camera.name}")
        if camera.images is None and (survey.observations is None or len(survey.cameras) > 1):
            raise SurveyFileError(
                f"{where}: camera {camera.name}: images is missing, the glob of its photographs is needed"
            )
    if survey.compare.baseline != "none" and survey.observations is not None:
        raise SurveyFileError(
            f"{where}: compare.baseline = '{survey.compare.baseline}' needs photographs, the survey has "
            "[observations]; leave it out"
        )
    if survey.datum.kind == "control" and survey.datum.points:
        raise SurveyFileError(
            f"{where}: datum.points are for kind 'free' or 'minimal', in kind 'control' the control carries "
            "the datum"
        )
    if survey.datum.kind == "control" and survey.control is None and survey.exterior is None:
        raise SurveyFileError(
            f"{where}: datum kind 'control' needs [control] with the file of known points, or [exterior]"
        )
    for bar in survey.scale_bars:
        if bar.start == bar.end:
            raise SurveyFileError(f"{where}: scale_bar from '{bar.start}' to the same point")
        if bar.length > MAX_LENGTH_PER_SIGMA * bar.sigma:
            raise SurveyFileError(
                f"{where}: scale_bar {bar.start} - {bar.end}: length {bar.length:g} is more than a million "
                f"times its sigma {bar.sigma:g}; are both in {survey.unit}?"
            )
    _refuse_contradicting_sizes(survey.targets, where, survey.unit)
    if survey.targets.codes not in FAMILIES and not survey.beside(survey.targets.codes).is_file():
        raise SurveyFileError(
            f"{where}: targets.codes = '{survey.targets.codes}' is neither one of {', '.join(FAMILIES)} "
            f"nor a table file in {survey.path.parent}"
        )


def _refuse_contradicting_sizes(targets: TargetSettings, where: str, unit: str) -> None:
    """Raise SurveyFileError where sizes of tags or rings do not go with the codes or with one another."""
    if targets.tag_size is not None and targets.codes not in DICTIONARIES:
        raise SurveyFileError(
            f"{where}: targets.tag_size is the size of tags, codes = '{targets.codes}' has none; "
            f"tags are {', '.join(list(DICTIONARIES)[:4])} ..."
        )
    if targets.ring_radii is not None:
        inner, outer = targets.ring_radii
        if targets.codes == "none" or targets.codes in DICTIONARIES:
            raise SurveyFileError(
                f"{where}: targets.ring_radii are of rings, codes = '{targets.codes}' has none"
            )
        if not 1 < inner < outer:
            raise SurveyFileError(
                f"{where}: targets.ring_radii = [{inner:g}, {outer:g}], needed more than 1 radius of the dot "
                "and the second larger"
            )
    if targets.tag_sigma is not None:
        if targets.tag_size is None:
            raise SurveyFileError(f"{where}: targets.tag_sigma needs targets.tag_size")
        if targets.tag_size > MAX_LENGTH_PER_SIGMA * targets.tag_sigma:
            raise SurveyFileError(
                f"{where}: targets.tag_size {targets.tag_size:g} is more than a million times its sigma "
                f"{targets.tag_sigma:g}; are both in {unit}?"
            )


def _refuse_contradictions_of_camera(camera: CameraSettings, at: str) -> None:
    """Raise SurveyFileError where the settings of a camera do not go together."""
    known = MODELS[camera.model].names
    fixed, weighted = dict(camera.fixed), dict(camera.weighted)
    varying = (*camera.per_photograph, *camera.per_group)
    for parameter in (*camera.free, *fixed, *weighted, *varying):
        if parameter not in known:
            raise SurveyFileError(
                f"{at}: model {camera.model} has no parameter '{parameter}', it has {', '.join(known)}"
            )
    for key, names in (
        ("free", camera.free),
        ("per_photograph", camera.per_photograph),
        ("per_group", camera.per_group),
    ):
        for parameter in names:
            if names.count(parameter) > 1:
                raise SurveyFileError(
                    f"{at}: parameter '{parameter}' stands {names.count(parameter)} times in {key}, once is "
                    "needed"
                )
    for one, other, both in (
        ("free", "fixed", set(camera.free) & set(fixed)),
        ("weighted", "free", set(weighted) & set(camera.free)),
        ("weighted", "fixed", set(weighted) & set(fixed)),
        ("per_photograph", "per_group", set(camera.per_photograph) & set(camera.per_group)),
    ):
        for parameter in sorted(both):
            raise SurveyFileError(f"{at}: parameter '{parameter}' is both {one} and {other}")
    for parameter in varying:
        if parameter not in camera.adjusted:
            key = "per_photograph" if parameter in camera.per_photograph else "per_group"
            raise SurveyFileError(
                f"{at}: parameter '{parameter}' stands in {key} but is not adjusted, it is needed in free or "
                "weighted"
            )
    if bool(camera.per_group) != bool(camera.groups):
        missing, given = ("groups", "per_group") if camera.per_group else ("per_group", "groups")
        raise SurveyFileError(f"{at}: {given} is given, {missing} is needed with it")
    if camera.pixel_mm is not None and camera.sensor_mm is not None:
        raise SurveyFileError(f"{at}: pixel_mm and sensor_mm are both given, one is needed")
    for key, values in (("fixed", fixed), ("weighted", weighted)):
        if camera.c_mm is not None and "c" in values:
            raise SurveyFileError(f"{at}: c_mm and {key}.c are both given, one is needed")
