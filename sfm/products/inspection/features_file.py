"""The features file (TOML) of `kolinear measure`: groups, shapes, alignment, functions and tolerances."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationError

from sfm.files.open_folders import path_inside
from sfm.files.plain_text import read_toml
from sfm.model.errors import SurveyFileError
from sfm.products.geometry.shapes.kinds import KINDS
from sfm.survey.inputs.settings import LARGEST, Length, Name, Section, Value, first_error

MAX_ENTRIES = 10_000  # of one kind


def _entries(kind: str) -> Any:
    return Field(strict=False, max_length=MAX_ENTRIES, alias=kind)


Patterns = Annotated[
    tuple[Name, ...],
    Field(strict=False, min_length=1, max_length=MAX_ENTRIES),
    BeforeValidator(lambda value: (value,) if isinstance(value, str) else value),
]
Numbers = Annotated[tuple[Value, ...], Field(strict=False, min_length=3, max_length=3)]
NotNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Coverage = Annotated[float, Field(ge=1, le=10)]
Weights = Literal["network", "equal"]


class GroupSettings(Section):
    """[[group]]: points by names, patterns or ranges of numbers."""

    name: Name
    points: Patterns


class HiddenPointSettings(Section):
    """[[hidden_point]]: a point behind two targets of a probe."""

    name: Name
    start: Name = Field(alias="from")  # the farther target
    end: Name = Field(alias="to")  # the nearer target
    distance: Length  # from the nearer target to the hidden point, object unit
    sigma: NotNegative = 0.0  # of the distance, object unit


class HeldSettings(Section):
    """hold = {...} of a shape: parameters that are held fixed."""

    point: Numbers | None = None
    centre: Numbers | None = None
    apex: Numbers | None = None
    vertex: Numbers | None = None
    direction: Numbers | None = None
    radius: Length | None = None
    diameter: Length | None = None
    semi_major: Length | None = None
    semi_minor: Length | None = None
    half_angle_deg: Annotated[float, Field(gt=0, lt=90)] | None = None
    major_radius: Length | None = None
    minor_radius: Length | None = None
    focal_length: Length | None = None


class ShapeSettings(Section):
    """[[shape]]: a best-fit shape."""

    name: Name
    kind: Literal[tuple(KINDS)]  # type: ignore[valid-type]
    points: Patterns
    weights: Weights | None = None  # else the weights of [measure]
    robust: bool = False
    hold: HeldSettings = HeldSettings()
    offset: NotNegative = 0.0  # of the targets from the surface, along its normal, object unit
    side: Name = "cameras"  # side of the targets: that of the cameras, or of the point of this name


class AlignmentSettings(Section):
    """[alignment]: the system of the coordinates and directions."""

    method: Literal["3-2-1", "features", "points"]
    plane: Patterns | None = None  # 3-2-1: three points of Z = 0
    line: Patterns | None = None  # 3-2-1: two points of Y = 0
    origin: Name | None = None  # 3-2-1: point of X = 0; features: point or shape at the origin
    z_axis: Name | None = None  # features: shape whose direction becomes Z; a plane lies at Z = 0
    x_axis: Patterns | None = None  # features: shape whose direction becomes X, or two points or shapes
    nominal: Name | None = None  # points: table id,X,Y,Z[,sX,sY,sZ]
    points: Patterns | None = None  # points: points to use; all points of the table if not given
    scale: bool = False  # points: whether the scale is fitted
    robust: bool = False  # points: whether points that others contradict are left out
    weights: Weights | None = None  # points: else the weights of [measure]


class DistanceSettings(Section):
    """[[distance]]: between points, or from a point to a plane or an axis."""

    name: Name
    start: Name = Field(alias="from")  # point or shape
    end: Name = Field(alias="to")  # point or shape


class AngleSettings(Section):
    """[[angle]]: at a point between two others, or between the directions of two shapes."""

    name: Name
    between: Annotated[tuple[Name, Name], Field(strict=False)]  # points, or shapes
    at: Name | None = None  # the vertex, for points


class HeightSettings(Section):
    """[[height]]: of points above a plane."""

    name: Name
    above: Name  # shape of kind plane
    points: Patterns


class ToleranceSettings(Section):
    """[[tolerance]]: limits of deviations from a shape, nominal points or a mesh."""

    name: Name
    shape: Name | None = None
    nominal: Name | None = None  # table id,X,Y,Z[,sX,sY,sZ]
    mesh: Name | None = None  # .stl, .ply, .obj or .3mf
    points: Patterns | None = None  # points to judge; required for a mesh, else all of the shape or table
    lower: Value | None = None  # object unit; -upper if not given
    upper: Annotated[float, Field(gt=-LARGEST, le=LARGEST)]
    offset: Value = 0.0  # mesh: of the targets from the surface, along its normal, object unit
    coverage: Coverage | None = None  # k of the uncertainty U = k sigma; else the coverage of [measure]


class MeasureSettings(Section):
    """[measure]: settings for all features."""

    weights: Weights = "network"
    coverage: Coverage = 2.0


class FeaturesFile(Section):
    """Content of a features file; its tables and meshes are not read yet."""

    measure: MeasureSettings = MeasureSettings()
    groups: Annotated[tuple[GroupSettings, ...], _entries("group")] = ()
    hidden_points: Annotated[tuple[HiddenPointSettings, ...], _entries("hidden_point")] = ()
    shapes: Annotated[tuple[ShapeSettings, ...], _entries("shape")] = ()
    alignment: AlignmentSettings | None = None
    distances: Annotated[tuple[DistanceSettings, ...], _entries("distance")] = ()
    angles: Annotated[tuple[AngleSettings, ...], _entries("angle")] = ()
    heights: Annotated[tuple[HeightSettings, ...], _entries("height")] = ()
    tolerances: Annotated[tuple[ToleranceSettings, ...], _entries("tolerance")] = ()

    def tables(self) -> tuple[str, ...]:
        """Return the names of the tables of nominal points."""
        named = [self.alignment.nominal if self.alignment else None]
        named += [tolerance.nominal for tolerance in self.tolerances]
        return tuple(dict.fromkeys(name for name in named if name is not None))

    def meshes(self) -> tuple[str, ...]:
        """Return the names of the meshes."""
        return tuple(
            dict.fromkeys(tolerance.mesh for tolerance in self.tolerances if tolerance.mesh is not None)
        )


NEEDED = {
    "3-2-1": ("plane", "line", "origin"),
    "features": ("z_axis", "x_axis", "origin"),
    "points": ("nominal",),
}


def read_features_file(path: Path, *, allow_outside: bool = False) -> tuple[FeaturesFile, dict[str, Path]]:
    """Read and check a features file.

    Args:
        path: the TOML file; the paths in it are relative to it.
        allow_outside: whether these paths may lead out of its folder.

    Returns:
        Its settings, and the paths of its tables and meshes by name.

    Raises:
        SurveyFileError: the file is unreadable or not TOML, or has an unknown key, a wrong type, or a
            contradiction. The message states the file, the key, the value found and the value needed.
    """
    path = Path(path)
    text, table = read_toml(path, "a features file")
    try:
        features = FeaturesFile.model_validate(table)
    except ValidationError as error:
        raise SurveyFileError(first_error(path, text, error, FeaturesFile)) from error
    _refuse_contradictions(path, features)
    paths = {
        name: path_inside(path.parent, name, str(path), allow_outside=allow_outside)
        for name in (*features.tables(), *features.meshes())
    }
    return features, paths


def _refuse_contradictions(path: Path, features: FeaturesFile) -> None:
    kinds: tuple[tuple[str, tuple[GroupSettings | ShapeSettings | ToleranceSettings, ...]], ...]
    kinds = (("group", features.groups), ("shape", features.shapes), ("tolerance", features.tolerances))
    for kind, entries in kinds:
        seen: set[str] = set()
        for entry in entries:
            if entry.name in seen:
                raise SurveyFileError(f"{path}: {kind} '{entry.name}' is a duplicate")
            seen.add(entry.name)
    alignment = features.alignment
    if alignment is not None:
        for key in NEEDED[alignment.method]:
            if getattr(alignment, key) is None:
                raise SurveyFileError(f'{path}: alignment: method "{alignment.method}" needs {key}')
    for tolerance in features.tolerances:
        given = [key for key in ("shape", "nominal", "mesh") if getattr(tolerance, key) is not None]
        if len(given) != 1:
            stated = " and ".join(given) or "none"
            raise SurveyFileError(
                f"{path}: tolerance {tolerance.name}: found {stated}, needed one of shape, nominal and mesh"
            )
        if tolerance.mesh is not None and tolerance.points is None:
            raise SurveyFileError(f"{path}: tolerance {tolerance.name}: a mesh needs the points to be judged")
        lower = -tolerance.upper if tolerance.lower is None else tolerance.lower
        if not lower < tolerance.upper:
            raise SurveyFileError(
                f"{path}: tolerance {tolerance.name}: lower limit {lower:g}, upper {tolerance.upper:g}, "
                "needed lower below upper"
            )
