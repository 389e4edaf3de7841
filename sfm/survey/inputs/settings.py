"""The sections of the survey file: their keys, types and bounds, and one-line error messages.

The comment on each key is its description in the reference of the survey file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from sfm.files.plain_text import MAX_NAME, as_plain, is_plain
from sfm.model.display import counted, listed
from sfm.model.distortion.models import MODELS
from sfm.model.distributions import FALSE_ALARM, Levels
from sfm.model.observations.tables import TABLES

MAX_SHOWN = 60  # characters of a key
MAX_LISTED = 10  # keys listed in one message
FEW = 3  # a list of at most so many values has a fixed length
# What is needed by the kind of error of pydantic, with the numbers in its context.
_NEEDED = {
    "string_type": "a text in quotes",
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "date_type": "a date without quotes, such as 2026-03-01",
    "tuple_type": "a list in square brackets",
    "finite_number": "a finite number",
    "model_type": "a table",
    "literal_error": "one of {expected}",
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than_equal": "at most {le:g}",
}


def _pairs(value: Any) -> Any:
    """Turn a TOML table into (key, value) pairs, so that no dictionary leaves this module."""
    return tuple(value.items()) if isinstance(value, dict) else value


def _odd(value: int) -> int:
    if value % 2 == 0:
        raise ValueError(f"found {value}, needed an odd number")
    return value


def _plain(value: str) -> str:
    if not value.strip():
        raise ValueError("found an empty text")
    if len(value) > MAX_NAME or not is_plain(value):
        shown = as_plain(value[:40])
        raise ValueError(f"found '{shown}', needed plain text on one line, at most {MAX_NAME} characters")
    return value


# Lengths, sigmas and parameters beyond these bounds make no sense in any unit: their squares or inverses
# overflow.
SMALLEST, LARGEST = 1e-9, 1e12
MIN_SIGMA = 1e-30  # of a distortion parameter, mm^-8
MAX_SIDE_PX = 1_000_000
MAX_CORRELATIONS = 200  # of the parameters of one camera
MAX_PHOTOGRAPHS = 20_000  # a table with one byte for each pair takes 400 MB
MAX_GROUPS = 1000  # each is tried on every photograph
MAX_TABLES = 100  # of survey observations
MAX_RIGS, MAX_PATTERN = 100, 200  # rigs, and characters of the expression that finds a moment
# Parameters that are adjusted if a survey states none, as far as its photographs determine them.
FREED_FIRST = ("c", "x0", "y0", "K1", "K2", "fx", "fy", "f", "cx", "cy", "k1", "k2", "k")
MAX_GLOBS = 1000  # with wildcards, of the photographs of all cameras: each is tried on every photograph
MAX_LENGTH_PER_SIGMA = 1e6  # no calibration of a scale bar is better than a millionth of its length
Length = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]
Probability = Annotated[float, Field(ge=1e-9, le=0.5)]
Temperature = Annotated[float, Field(ge=-100, le=200)]
Name = Annotated[str, BeforeValidator(lambda v: _plain(v) if isinstance(v, str) else v)]
Unit = Annotated[
    Literal["km", "m", "dm", "cm", "mm", "um", "µm", "nm", "in", "ft"],
    BeforeValidator(lambda v: _plain(v) if isinstance(v, str) else v),
]
NAMES_A_FILE = "names a file"  # metadata of keys whose text is a path relative to the survey file
File = Annotated[Name, NAMES_A_FILE]
FileOrNone = Annotated[Name | None, NAMES_A_FILE]
TwoLengths = Annotated[tuple[Length, Length], Field(strict=False)]
Side = Annotated[int, Field(gt=0, le=MAX_SIDE_PX)]
TwoCounts = Annotated[tuple[Side, Side], Field(strict=False)]
Names = Annotated[tuple[Name, ...], Field(strict=False)]
Globs = Annotated[
    tuple[Name, ...],
    Field(strict=False, min_length=1, max_length=MAX_PHOTOGRAPHS),
    BeforeValidator(lambda v: (v,) if isinstance(v, str) else v),
]
Value = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Values = Annotated[
    tuple[Annotated[tuple[Name, Value], Field(strict=False)], ...],
    Field(strict=False),
    BeforeValidator(_pairs),
]
Sigma = Annotated[float, Field(ge=MIN_SIGMA, le=LARGEST)]
ValueAndSigma = Annotated[tuple[Value, Sigma], Field(strict=False)]
Observed = Annotated[
    tuple[Annotated[tuple[Name, ValueAndSigma], Field(strict=False)], ...],
    Field(strict=False),
    BeforeValidator(_pairs),
]
TagNumber = Annotated[int, Field(ge=0, le=100_000)]
PlateSide = Annotated[int, Field(ge=2, le=500)]
Marks = Annotated[
    tuple[Annotated[tuple[int, int], Field(strict=False)], ...], Field(strict=False, max_length=1000)
]
Correlation = Annotated[float, Field(ge=-1, le=1)]
Correlations = Annotated[
    tuple[Annotated[tuple[Name, Name, Correlation], Field(strict=False)], ...],
    Field(strict=False, max_length=MAX_CORRELATIONS),
]


class Section(BaseModel):
    """A table of the survey file: types as written, no unknown keys, no NaN or infinity."""

    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=False
    )

    def files(self) -> Iterator[str]:
        """Yield the paths of the files that this table and those in it name, as they are written."""
        for key, field in type(self).model_fields.items():
            value = getattr(self, key)
            for section in value if isinstance(value, tuple) else (value,):
                if isinstance(section, Section):
                    yield from section.files()
            if NAMES_A_FILE in field.metadata and value is not None:
                yield value


class Head(Section):
    """[survey]: name and unit of the survey, and its equipment."""

    name: Name  # of the survey, in the report and its file names
    unit: Unit  # of the object coordinates
    equipment: FileOrNone = None  # equipment file with the bars and frames of [[equipment]]
    temperature: Temperature | None = None  # of the equipment during the survey, deg C
    temperature_sigma: Length = 1.0  # standard deviation of temperature, K
    photographs: Name | None = None  # folder of the photographs, relative to the survey file; else its own
    masks: Name | None = None  # folder of masks NAME.png of photographs; what is black in them is ignored


class CameraSettings(Section):
    """[[camera]]: one camera, its photographs and its interior orientation."""

    name: Name  # name of the camera; unique in the survey
    images: Globs | None = None  # globs or names of photographs; optional with [observations], one camera
    size_px: TwoCounts | None = None  # width and height of its photographs, else read from them, px
    pixel_mm: TwoLengths | None = None  # width and height of a pixel, else from sensor_mm or EXIF, mm
    sensor_mm: TwoLengths | None = None  # width and height of the sensor, mm
    c_mm: Length | None = None  # start value of the principal distance, else the EXIF focal length, mm
    c_assumed: bool = False  # whether c_mm or pixel_mm is assumed and not known
    # distortion model: it corrects the measured point, or distorts the ideal point
    model: Literal[tuple(MODELS)] = "brown"  # type: ignore[valid-type]
    free: Names = ()  # free parameters; [] for a calibrated camera; if missing, the photographs decide
    fixed: Values = ()  # values of parameters that are not free, in the model's units; else 0
    start: Values = ()  # start values of free parameters, in the model's units; else 0
    balanced: Values = ()  # values in AICON's form with R0, in place of fixed and start
    weighted: Observed = ()  # parameters adjusted as observations, with value and standard deviation
    correlations: Correlations = ()  # of weighted parameters; 0 if not given
    calibration: Name | None = None  # folder of an earlier result, relative to the survey file
    calibration_use: Literal["fixed", "weighted"] = "fixed"  # held, or an observation with its covariance
    per_photograph: Names = ()  # adjusted parameters with a value for each photograph
    per_group: Names = ()  # adjusted parameters with a value for each group of photographs
    groups: Annotated[Names, Field(max_length=MAX_GROUPS)] = ()  # globs of these groups of photographs

    @property
    def adjusted(self) -> tuple[str, ...]:
        """Parameters that are adjusted, observed or not."""
        return (*self.free, *(name for name, _ in self.weighted))

    @property
    def states_free(self) -> bool:
        """Whether the survey states the free parameters, perhaps none; else the photographs decide."""
        varying = self.per_photograph or self.per_group
        return bool(
            "free" in self.model_fields_set or self.fixed or self.balanced or self.weighted or varying
        )

    @property
    def states_model(self) -> bool:
        """Whether the survey states the model, or parameters of a model; else the photographs decide."""
        return bool("model" in self.model_fields_set or self.states_free or self.start or self.calibration)

    @property
    def may_be_free(self) -> tuple[str, ...]:
        """Parameters that are adjusted without an observation, or may be if the survey states none."""
        if self.states_free:
            return self.free
        return tuple(name for name in MODELS[self.model].names if name in FREED_FIRST)


class PlateSettings(Section):
    """[[plate]]: another calibration plate, fixed to the plate of [targets]; its points follow in number."""

    codes: Name  # a plate or board of another kind, or with other tags, than the plate of [targets]
    rows: PlateSide | None = None  # rows of dots of a plate, or of crossings inside a board
    columns: PlateSide | None = None  # columns of dots of a plate, or of crossings inside a board
    pitch: Length | None = None  # distance of neighbouring dots or crossings, object unit
    marks: Marks = ()  # [row, column], from 0, of the dots that are larger or rings
    plate_sigma: Length | None = None  # standard deviation of its coordinates, else exact, object unit
    dictionary: Name | None = None  # tags of a ChArUco board or AprilGrid, whose side is tag_size
    tag_size: Length | None = None  # side of the black square of all tags, object unit
    first_tag: TagNumber = 0  # number of the first tag of the board


class TargetSettings(PlateSettings):
    """[targets]: appearance and codes of the targets in the photographs, and the plate that they are on."""

    polarity: Literal["dark", "bright", "auto"] = "auto"  # targets darker or brighter than their surroundings
    channel: Literal["luminance", "red", "green", "blue"] = (
        "luminance"  # measured channel of colour photographs
    )
    tone: Literal["linear", "srgb"] = "linear"  # tone curve of the photographs, inverted before measuring
    codes: Name = "none"  # a code family, or a table file relative to the survey file
    # inner and outer radius of the ring, in radii of the dot; else those of the code family
    ring_radii: TwoLengths | None = None
    min_diameter_px: Length = 6.0  # diameter of the smallest target to measure, px
    eccentricity: bool = True  # whether to correct the eccentricity of the ellipses
    diameter: Length | None = None  # of all targets, object unit; else from the ellipses of each target
    diameters: FileOrNone = None  # a table id,diameter of single targets, which replaces diameter
    tag_sigma: Length | None = None  # standard deviation of tag_size, common to all tags, object unit
    pitch_assumed: bool = False  # whether the pitch is assumed and not measured


class TiePointSettings(Section):
    """[tie_points]: natural texture, alone or beside coded targets."""

    detector: Literal["foerstner", "sift"] = "foerstner"  # detector of the interest points
    window_px: Annotated[int, Field(ge=7, le=101), AfterValidator(_odd)] = 15  # odd side of windows
    max_features: Annotated[int, Field(ge=100, le=20_000)] = 2000  # in each photograph, spread over it
    max_points: Annotated[int, Field(ge=100, le=100_000)] = (
        6000  # in each photograph, spread over its texture
    )
    pairs: FileOrNone = None  # a table image,other of the only pairs of photographs that are matched


class DatumSettings(Section):
    """[datum]: definition of position, orientation and scale of the result."""

    # inner constraints, seven held coordinates, or control
    kind: Literal["free", "minimal", "control"] = "free"
    points: Names = ()  # object points that carry a free or minimal datum; all if none are named


class RigSettings(Section):
    """[[rig]]: cameras mounted on one frame, whose photographs of one moment move together."""

    name: Name  # name of the rig; unique in the survey
    cameras: Names  # names of its cameras; the first is the reference
    # "order": photographs of each camera in the order of their names; "exif": by the times in their EXIF
    # data; a table image,moment (.csv); else a regular expression with one group, which finds the moment in
    # the names of photographs
    moment: Annotated[Name, Field(max_length=MAX_PATTERN)]
    # globs of the photographs of blocks of time, between which the mounts changed but not the cameras
    blocks: Annotated[Names, Field(max_length=MAX_GROUPS)] = ()
    tolerance_s: Annotated[float, Field(ge=0, le=86_400)] = 1.0  # difference of EXIF times of one moment, s
    # camera,X,Y,Z,sX,sY,sZ,omega_deg,phi_deg,kappa_deg,somega_deg,sphi_deg,skappa_deg in the image axes of
    # the reference camera; sigma 0 = held fixed
    mounts: FileOrNone = None

    @property
    def named(self) -> bool:
        """Whether a table or EXIF data list the photographs with their moments."""
        return self.moment == "exif" or self.table is not None

    @property
    def table(self) -> str | None:
        """The table that names the moments, or None."""
        return self.moment if self.moment.endswith(".csv") and "(" not in self.moment else None

    def files(self) -> Iterator[str]:
        """Yield the paths of the tables of its mounts and moments, as they are written."""
        yield from super().files()
        if self.table is not None:
            yield self.table


class ControlSettings(Section):
    """[control]: known object points."""

    file: File  # id,X,Y,Z[,sX,sY,sZ], or gcp_list.txt or ground_control_points.json with image points
    sigma: TwoLengths | None = None  # of X and Y, and of Z, where the file states none; else they are fixed
    check: Names = ()  # points that are not adjusted but check the result


class ExteriorSettings(Section):
    """[exterior]: exterior orientation observed by satellite positioning, a tracker or known stations."""

    # image,X,Y,Z[,sX,sY,sZ][,omega_deg,phi_deg,kappa_deg[,somega_deg,sphi_deg,skappa_deg]]
    file: FileOrNone = None
    # in place of file: standard deviations of positions in EXIF data, in the plane and of the height
    exif_sigma_m: TwoLengths | None = None  # for photographs that state none, m


class ScaleBarSettings(Section):
    """[[scale_bar]]: a measured distance between two object points."""

    start: Name = Field(alias="from")  # name of the point at one end
    end: Name = Field(alias="to")  # name of the point at the other end
    length: Length  # between the two points, object unit
    sigma: Length  # standard deviation of the length, object unit


class EquipmentSettings(Section):
    """[[equipment]]: a bar or frame of the equipment file, once for each place where it was photographed."""

    name: Name  # its name in the equipment file
    points: Names = ()  # its points in this survey, in the order of the equipment file; else named as there


class ObservationSettings(Section):
    """[observations]: measured image points in place of photographs; [[observations]]: beside them."""

    file: File  # image,point,x_px,y_px[,sx_px,sy_px] or image,point,x_mm,y_mm[,sx_mm,sy_mm]
    sigma_px: Length | None = None  # standard deviation of rows that state none; else that of [adjust]


class MarksSettings(Section):
    """[marks]: image points that a person measured with kolinear mark, beside everything else."""

    file: File  # the marks file, with the control and scale bars that the person states


class PointSettings(Section):
    """[[point]]: a natural point that a person names in a photograph, and that is measured in all others."""

    name: Name  # of the point, in this and later surveys
    image: Name  # photograph in which it is named; the first of a point has its template
    x_px: Value  # column of the place in the photograph, px
    y_px: Value  # row, px
    sigma_px: Length = 1.0  # standard deviation of pointing, px


class ObservationTableSettings(Section):
    """[[survey_observations]]: a table of observations beside photographs, such as tape, level or GNSS."""

    # distance, height difference, plane, ...: see docs/how-to/scale-and-control.md for kinds and columns
    kind: Literal[tuple(TABLES)]  # type: ignore[valid-type]
    file: File  # a table with the columns of its kind


class ApproximateSettings(Section):
    """[approximate]: start values of exterior orientation, object points and interior orientation."""

    images: FileOrNone = None  # image,X,Y,Z,omega_deg,phi_deg,kappa_deg
    points: FileOrNone = None  # point,X,Y,Z
    cameras: FileOrNone = None  # camera,parameter,value


class AdjustSettings(Section):
    """[adjust]: the stochastic model."""

    sigma_px: Length = 0.1  # a priori standard deviation of an image coordinate, px
    reject: Literal["tau", "huber", "tukey", "none"] | None = None  # else tau; none with [observations]
    weights: Literal["components", "stated"] = "components"  # of image points beside other observations
    # probability that a right survey is called wrong: its share is the level of each test
    false_alarm: Probability = FALSE_ALARM

    @property
    def levels(self) -> Levels:
        """Levels of all tests of the survey."""
        return Levels(self.false_alarm)


class CompareSettings(Section):
    """[compare]: comparison with another adjuster and another pipeline."""

    backend: Literal["colmap", "none"] = "colmap"  # other adjuster of the same image points, if installed
    baseline: Literal["mapper", "none"] = "none"  # other pipeline for the same photographs: COLMAP's mapper


def first_error(path: Path | str, text: str, error: ValidationError, section: type[Section]) -> str:
    """Return the first error of pydantic as one line with file, line, key, found and needed value.

    Unknown keys come first: a misspelt key is unknown, and missing under its correct name.

    Args:
        path: the survey file, or another beginning of the message.
        text: content of the file; empty for settings from Python.
        error: the error of pydantic.
        section: the section of the whole file, which declares the known keys.
    """
    errors = error.errors(include_url=False)
    first = next((fault for fault in errors if fault["type"] == "extra_forbidden"), errors[0])
    location = first["loc"]
    kind, context = first["type"], first.get("ctx", {})
    line = _line_of(text, location)
    where = f"{path}, line {line}: " if line else f"{path}: "
    key = _key(location)
    if kind == "extra_forbidden":
        table = _key(location[:-1])
        inside = f"[{table}]" if table else "the file" if text else "it"
        known = _known_keys(location[:-1], section)
        return f"{where}unknown key '{_key(location[-1:])}' in {inside}, known are {known}"
    if kind == "missing" and isinstance(location[-1], int) and isinstance(first["input"], list | tuple):
        shown = _found(list(first["input"]))
        return f"{where}{_key(location[:-1])}: found {shown}, needed {counted(location[-1] + 1, 'value')}"
    if kind == "missing":
        every = [_key(fault["loc"]) for fault in errors if fault["type"] == "missing"]
        return f"{where}{listed(every, most=MAX_LISTED)} {'is' if len(every) == 1 else 'are'} missing"
    if kind == "tuple_type" and len(location) == 1 and isinstance(first["input"], dict):
        return f"{where}found [{key}], needed [[{key}]] in double brackets, since there may be several"
    if kind == "greater_than_equal" and context["ge"] > 0 >= first["input"]:
        needed = "more than 0"
    elif kind == "too_long":
        most = counted(context["max_length"], "value")
        needed = most if context["max_length"] <= FEW else f"at most {most}"
    elif kind == "too_short":
        needed = f"at least {context['min_length']}"
    elif kind in _NEEDED:
        needed = _NEEDED[kind].format(**context)
    else:
        said = first["msg"].removeprefix("Value error, ")
        return f"{where}{key}: {said[0].lower()}{said[1:]}"
    return f"{where}{key}: found {_found(first['input'])}, needed {needed}"


def _found(value: Any) -> str:
    """Return a value as written in a TOML file, shortened."""
    shown = str(value).lower() if isinstance(value, bool) else repr(value)
    return shown if len(shown) <= 60 else shown[:57] + "..."


def _key(location: tuple[str | int, ...]) -> str:
    """Return a location for people, such as "camera 2.pixel_mm 1"."""
    words: list[str] = []
    for part in location:
        if isinstance(part, int):
            words[-1:] = [f"{words[-1]} {part + 1}"] if words else [str(part + 1)]
        else:
            words.append(as_plain(part[:MAX_SHOWN]))
    return ".".join(words)


def _known_keys(location: tuple[str | int, ...], section: type[Section]) -> str:
    """Return the keys that the table at a location may have."""
    for key in (part for part in location if isinstance(part, str)):
        fields = {field.alias or name: field for name, field in section.model_fields.items()}
        section = _section_in(fields[key].annotation) or section
    return ", ".join(field.alias or name for name, field in section.model_fields.items())


def _section_in(annotation: Any) -> type[Section] | None:
    """Return the section in the type of a field, alone or in a list, or None."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return annotation
    return next(filter(None, (_section_in(part) for part in get_args(annotation))), None)


def _line_of(text: str, location: tuple[str | int, ...]) -> int | None:
    """Return the line number of a location's key in the survey file, or None."""
    keys = [str(part) for part in location if isinstance(part, str)]
    # An index after the table counts tables in double brackets; a later index counts values of a key.
    number = location[1] if len(location) > 1 and isinstance(location[1], int) else 0
    count: dict[str, int] = {}
    table, last = "", None
    for k, line in enumerate(text.splitlines(), 1):
        header = re.match(r"\s*\[\[?([\w.\- \t]+)\]", line)  # not two parts that can match the same blanks
        if header:
            table = header[1].strip()
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
