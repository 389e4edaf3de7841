"""The survey file (TOML): what it may say, read and checked."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PrivateAttr, ValidationError

from sfm.distortion.models import MODELS
from sfm.errors import SurveyFileError
from sfm.targets.codes import FAMILIES as RING_FAMILIES
from sfm.targets.tags import TAG_FAMILIES

FAMILIES = (*RING_FAMILIES, *TAG_FAMILIES)

MAX_SURVEY_BYTES = 1_000_000  # a survey file is written by people; anything larger is another file


def _pairs(value: Any) -> Any:
    """Turn a TOML table into (key, value) pairs, so that no dictionary goes beyond this module."""
    return tuple(value.items()) if isinstance(value, dict) else value


def _not_empty(value: str) -> str:
    if not value.strip():
        raise ValueError("found an empty text")
    return value


# Beyond these no length, sigma or parameter makes sense in any unit, and their squares or inverses overflow.
SMALLEST, LARGEST = 1e-9, 1e12
MAX_SIDE_PX = 1_000_000
MAX_LENGTH_PER_SIGMA = 1e6  # no scale bar is calibrated to better than a millionth of its length
Length = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]
Name = Annotated[str, BeforeValidator(lambda v: _not_empty(v) if isinstance(v, str) else v)]
TwoLengths = Annotated[tuple[Length, Length], Field(strict=False)]
Side = Annotated[int, Field(gt=0, le=MAX_SIDE_PX)]
TwoCounts = Annotated[tuple[Side, Side], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]
Values = Annotated[
    tuple[Annotated[tuple[str, Annotated[float, Field(ge=-LARGEST, le=LARGEST)]], Field(strict=False)], ...],
    Field(strict=False),
    BeforeValidator(_pairs),
]


class Section(BaseModel):
    """A table of the survey file: types as written, no unknown keys, no NaN or infinity."""

    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=False
    )


class Head(Section):
    """[survey]: what the survey is called."""

    name: Name
    unit: Name  # object unit, for people and reports


class CameraSettings(Section):
    """[[camera]]: one camera, its photographs and what is known of its interior orientation."""

    name: Name
    images: Name | None = None  # glob of its photographs; may be left out with [observations] and one camera
    size_px: TwoCounts | None = None  # else from the photographs, px
    pixel_mm: TwoLengths | None = None  # width and height of a pixel, else from sensor_mm or EXIF, mm
    sensor_mm: TwoLengths | None = None  # width and height of the sensor, mm
    c_mm: Length | None = None  # start value of the principal distance, else the EXIF focal length, mm
    model: Literal[tuple(MODELS)] = "brown"  # type: ignore[valid-type]
    free: Names = ()  # parameters to be adjusted; none = a calibrated camera
    fixed: Values = ()  # (parameter, value) of what is not free, in the model's units


class TargetSettings(Section):
    """[targets]: what circular targets look like in the photographs."""

    polarity: Literal["dark", "bright", "auto"] = "auto"
    channel: Literal["luminance", "red", "green", "blue"] = "luminance"  # of colour photographs
    codes: Name = "none"  # a code family, or a table file relative to the survey file
    min_diameter_px: Length = 6.0
    eccentricity: bool = True  # whether to correct it
    diameter: Length | None = None  # of all targets, object unit; else of each from its ellipses
    diameters: Name | None = None  # a table id,diameter of single targets, before the one of all
    tag_size: Length | None = None  # side of the black square of all tags, object unit
    tag_sigma: Length | None = None  # its standard deviation, common to all tags of a print, object unit


class TiePointSettings(Section):
    """[tie_points]: natural texture in place of targets."""

    detector: Literal["foerstner", "sift"] = "foerstner"
    window_px: Annotated[int, Field(ge=7, le=101)] = 15  # odd side of the matched windows
    max_features: Annotated[int, Field(ge=100)] = 4000  # of each photograph


class DatumSettings(Section):
    """[datum]: what position, orientation and scale of the result rest on."""

    kind: Literal["free", "minimal", "control"] = "free"


class ControlSettings(Section):
    """[control]: known object points."""

    file: Name  # id,X,Y,Z[,sX,sY,sZ]


class ScaleBarSettings(Section):
    """[[scale_bar]]: a measured distance between two object points."""

    start: Name = Field(alias="from")
    end: Name = Field(alias="to")
    length: Length  # object unit
    sigma: Length  # object unit


class ObservationSettings(Section):
    """[observations]: measured image points in place of photographs."""

    file: Name  # image,point,x_px,y_px[,sx_px,sy_px] or image,point,x_mm,y_mm[,sx_mm,sy_mm]


class ApproximateSettings(Section):
    """[approximate]: start values of exterior orientation and object points."""

    images: Name | None = None  # image,X,Y,Z,omega_deg,phi_deg,kappa_deg
    points: Name | None = None  # point,X,Y,Z


class AdjustSettings(Section):
    """[adjust]: the stochastic model."""

    sigma_px: Length = 0.1  # a priori standard deviation of an image coordinate, px
    reject: Literal["tau", "huber", "none"] | None = None  # else tau, and none where [observations] are given


class CompareSettings(Section):
    """[compare]: the other adjuster on the survey's network, the other pipeline on its photographs."""

    backend: Literal["colmap", "none"] = "colmap"
    baseline: Literal["mapper", "none"] = "none"


class Survey(Section):
    """A survey as its file describes it."""

    head: Head = Field(alias="survey")
    cameras: Annotated[tuple[CameraSettings, ...], Field(strict=False, min_length=1, alias="camera")]
    targets: TargetSettings = TargetSettings()
    tie_points: TiePointSettings | None = None
    datum: DatumSettings = DatumSettings()
    control: ControlSettings | None = None
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
    try:
        if path.exists() and not path.is_file():  # reading a pipe would never end
            raise SurveyFileError(f"{path}: not a file, a survey file (TOML) is needed")
        if path.stat().st_size > MAX_SURVEY_BYTES:
            raise SurveyFileError(
                f"{path}: {path.stat().st_size} bytes, a survey file has at most {MAX_SURVEY_BYTES}"
            )
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise SurveyFileError(f"{path}: the survey file cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise SurveyFileError(f"{path}: not a text file in UTF-8 (byte {error.start})") from error
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # ValueError: a whole number of thousands of digits
        raise SurveyFileError(f"{path}: not a TOML file: {error}") from error
    try:
        survey = Survey.model_validate(table)
    except ValidationError as error:
        raise SurveyFileError(_one_line(path, text, error)) from error
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
        at = f"{where}: camera {camera.name}"
        known = MODELS[camera.model].names
        for parameter in (*camera.free, *(key for key, _ in camera.fixed)):
            if parameter not in known:
                raise SurveyFileError(
                    f"{at}: model {camera.model} has no parameter '{parameter}', it has {', '.join(known)}"
                )
        for parameter in camera.free:
            if camera.free.count(parameter) > 1:
                raise SurveyFileError(
                    f"{at}: parameter '{parameter}' stands {camera.free.count(parameter)} "
                    "times in free, once is needed"
                )
        for parameter, _ in camera.fixed:
            if parameter in camera.free:
                raise SurveyFileError(f"{at}: parameter '{parameter}' is both free and fixed")
        if camera.pixel_mm is not None and camera.sensor_mm is not None:
            raise SurveyFileError(f"{at}: pixel_mm and sensor_mm are both given, one is needed")
        if camera.c_mm is not None and "c" in dict(camera.fixed):
            raise SurveyFileError(f"{at}: c_mm and fixed.c are both given, one is needed")
        if camera.images is None and (survey.observations is None or len(survey.cameras) > 1):
            raise SurveyFileError(f"{at}: images is missing, the glob of its photographs is needed")
    if survey.compare.baseline != "none" and survey.observations is not None:
        raise SurveyFileError(
            f"{where}: compare.baseline = '{survey.compare.baseline}' needs photographs, the survey has "
            "[observations]; leave it out"
        )
    if survey.datum.kind == "control" and survey.control is None:
        raise SurveyFileError(f"{where}: datum kind 'control' needs [control] with the file of known points")
    for bar in survey.scale_bars:
        if bar.start == bar.end:
            raise SurveyFileError(f"{where}: scale_bar from '{bar.start}' to the same point")
        if bar.length > MAX_LENGTH_PER_SIGMA * bar.sigma:
            raise SurveyFileError(
                f"{where}: scale_bar {bar.start} - {bar.end}: length {bar.length:g} is more than a million "
                f"times its sigma {bar.sigma:g}; are both in {survey.unit}?"
            )
    _refuse_contradicting_tags(survey.targets, where)
    if survey.targets.codes not in FAMILIES and not survey.beside(survey.targets.codes).is_file():
        raise SurveyFileError(
            f"{where}: targets.codes = '{survey.targets.codes}' is neither one of {', '.join(FAMILIES)} "
            f"nor a table file in {survey.path.parent}"
        )


def _refuse_contradicting_tags(targets: TargetSettings, where: str) -> None:
    """Raise SurveyFileError where the size of tags is given without tags, or its sigma without the size."""
    if targets.tag_size is not None and targets.codes not in TAG_FAMILIES:
        raise SurveyFileError(
            f"{where}: targets.tag_size is the size of tags, codes = '{targets.codes}' has none; "
            f"tags are {', '.join(TAG_FAMILIES[:4])} ..."
        )
    if targets.tag_sigma is not None:
        if targets.tag_size is None:
            raise SurveyFileError(f"{where}: targets.tag_sigma needs targets.tag_size")
        if targets.tag_size > MAX_LENGTH_PER_SIGMA * targets.tag_sigma:
            raise SurveyFileError(
                f"{where}: targets.tag_size {targets.tag_size:g} is more than a million times its sigma "
                f"{targets.tag_sigma:g}; are both in the object unit?"
            )


_NEEDED = (
    ("string_type", "a text in quotes"),
    ("float_type", "a number"),
    ("int_type", "a whole number"),
    ("int_from_float", "a whole number"),
    ("bool_type", "true or false"),
    ("tuple_type", "a list in square brackets"),
    ("finite_number", "a finite number"),
    ("model_type", "a table"),
)


def _one_line(path: Path, text: str, error: ValidationError) -> str:
    """Return the first error of pydantic as one line with file, line, key, found and needed.

    Unknown keys come first: a misspelt key is unknown, and missing under its right name.
    """
    errors = error.errors(include_url=False)
    first = next((one for one in errors if one["type"] == "extra_forbidden"), errors[0])
    location = first["loc"]
    kind, context = first["type"], first.get("ctx", {})
    line = _line_of(text, location)
    where = f"{path}, line {line}: " if line else f"{path}: "
    key = _key(location)
    if kind == "extra_forbidden":
        table = _key(location[:-1])
        inside = f"[{table}]" if table else "the survey file"
        return f"{where}unknown key '{location[-1]}' in {inside}, known are {_known(location[:-1])}"
    if kind == "missing":
        return f"{where}{key} is missing"
    if kind == "tuple_type" and len(location) == 1 and isinstance(first["input"], dict):
        return f"{where}found [{key}], needed [[{key}]] in double brackets, since there may be several"
    needed = dict(_NEEDED).get(kind)
    if kind == "literal_error":
        needed = f"one of {context['expected']}"
    elif kind == "greater_than":
        needed = f"more than {context['gt']:g}"
    elif kind == "greater_than_equal":
        least = context["ge"]
        needed = "more than 0" if least > 0 >= first["input"] else f"at least {least:g}"
    elif kind == "less_than_equal":
        needed = f"at most {context['le']:g}"
    elif kind == "too_long":
        needed = f"{context['max_length']} values"
    elif kind == "too_short":
        needed = f"at least {context['min_length']}"
    if needed is None:
        return f"{where}{key}: {first['msg'][0].lower()}{first['msg'][1:]}"
    return f"{where}{key}: found {_found(first['input'])}, needed {needed}"


def _found(value: Any) -> str:
    """Show a value as it stands in a TOML file, shortened."""
    shown = str(value).lower() if isinstance(value, bool) else repr(value)
    return shown if len(shown) <= 60 else shown[:57] + "..."


def _key(location: tuple[str | int, ...]) -> str:
    """Write a location as a person would: camera 2 pixel_mm, value 1."""
    words: list[str] = []
    for part in location:
        if isinstance(part, int):
            words[-1:] = [f"{words[-1]} {part + 1}"] if words else [str(part + 1)]
        else:
            words.append(part)
    return ".".join(words)


def _known(location: tuple[str | int, ...]) -> str:
    """Return the keys that the table at a location may have."""
    sections: dict[str, type[Section]] = {
        "survey": Head,
        "camera": CameraSettings,
        "targets": TargetSettings,
        "tie_points": TiePointSettings,
        "datum": DatumSettings,
        "control": ControlSettings,
        "scale_bar": ScaleBarSettings,
        "observations": ObservationSettings,
        "approximate": ApproximateSettings,
        "adjust": AdjustSettings,
        "compare": CompareSettings,
    }
    section = sections[str(location[0])] if location else Survey
    return ", ".join(field.alias or name for name, field in section.model_fields.items())


def _line_of(text: str, location: tuple[str | int, ...]) -> int | None:
    """Return the line of the survey file on which the key of a location stands, None if not found."""
    keys = [str(part) for part in location if isinstance(part, str)]
    number = next((part for part in location if isinstance(part, int)), 0)
    count: dict[str, int] = {}
    table, last = "", None
    for k, line in enumerate(text.splitlines(), 1):
        header = re.match(r"\s*\[\[?\s*([\w.\- ]+?)\s*\]\]?", line)
        if header:
            table = header[1]
            count[table] = count.get(table, -1) + 1
            if table == ".".join(keys) and count[table] == number:
                return k
            if table == keys[0] and count[table] == number:
                last = k
            continue
        key = re.match(r"\s*([\w\-.]+|\"[^\"]*\"|'[^']*')\s*=", line)
        if key and count.get(keys[0], number) == number:
            full = ".".join(filter(None, (table, key[1].strip("\"'"))))
            if full == ".".join(keys):
                return k
    return last
