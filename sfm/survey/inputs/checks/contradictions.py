"""Checks for settings that are valid one by one but contradict each other."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Protocol

from sfm.files.globs import name_of_glob
from sfm.model.display import counted, listed
from sfm.model.distortion.brown import BALANCED, BALANCED_MODEL, from_balanced
from sfm.model.distortion.models import MODELS, Role
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.survey.inputs.calibration import (
    plate_control,
    refuse_contradicting_plates,
    refuse_free_points_without_turn,
)
from sfm.survey.inputs.given_values import KnownPoints, ScaleBar
from sfm.survey.inputs.settings import (
    LARGEST,
    MAX_GLOBS,
    MAX_LENGTH_PER_SIGMA,
    SMALLEST,
    CameraSettings,
    CompareSettings,
    DatumSettings,
    ExteriorSettings,
    PointSettings,
    RigSettings,
    ScaleBarSettings,
    TargetSettings,
)
from sfm.survey.inputs.sources import declared, reads_photographs
from sfm.targets.codes.concentric import WIDTHS
from sfm.targets.codes.plates import FAMILIES, PLATES, TAGGED, is_table
from sfm.targets.codes.tags import DICTIONARIES

MAX_REPEATS = 3  # in the expression for a moment: searching a name of 255 characters takes 255^3 steps
CALIBRATION_KEYS = {"calibration", "calibration_use"}
VALUES = ("fixed", "weighted", "start")  # keys that give parameters values
EXCLUSIVE = (  # keys of which a parameter is in one only
    ("free", "fixed"),
    ("weighted", "free"),
    ("weighted", "fixed"),
    ("per_photograph", "per_group"),
)


class Described(Protocol):
    """What a survey and its file both state."""

    @property
    def source(self) -> str:
        """Name in messages."""

    @property
    def folder(self) -> Path:
        """Folder of the globs of photographs."""

    @property
    def unit(self) -> str:
        """Object unit."""

    @property
    def cameras(self) -> tuple[CameraSettings, ...]:
        """Cameras."""

    @property
    def rigs(self) -> tuple[RigSettings, ...]:
        """Rigs of cameras."""

    @property
    def targets(self) -> TargetSettings:
        """Targets."""

    @property
    def codes(self) -> str:
        """Code family, or the path of the table file."""

    @property
    def datum(self) -> DatumSettings:
        """Datum."""

    @property
    def compare(self) -> CompareSettings:
        """Other programs."""

    @property
    def control(self) -> object:
        """Control points, or the settings of their file; None without control."""

    @property
    def exterior(self) -> object:
        """Observed exterior orientation, or the settings of its file; None without it."""

    @property
    def exif_sigma_m(self) -> tuple[float, float] | None:
        """Standard deviations of positions in EXIF data, m; None if these are not used."""

    @property
    def scale_bars(self) -> Sequence[ScaleBar | ScaleBarSettings]:
        """Scale bars."""

    @property
    def marks(self) -> tuple[PointSettings, ...]:
        """Natural points that a person names."""

    @property
    def start_points(self) -> object:
        """Start values of points, or their file; None without them."""


def refuse_contradictions(survey: Described) -> None:
    """Raise SurveyFileError with the first contradiction of the settings of a survey."""
    for of_subject in (
        _of_cameras,
        _of_rigs,
        _of_photographs,
        _of_datum,
        _of_scale_bars,
        _of_points,
        _of_targets,
    ):
        for contradiction in of_subject(survey):
            raise SurveyFileError(f"{survey.source}: {contradiction}")


def _of_cameras(survey: Described) -> Iterator[str]:
    names = Counter(camera.name for camera in survey.cameras)
    for name, times in names.items():
        if times > 1:
            yield f"two cameras are named '{name}'"
    needs_images = reads_photographs(survey) or len(survey.cameras) > 1
    for camera in survey.cameras:
        for of_settings in (
            _of_balanced, _of_parameters, _of_calibration, _of_values
        ):  # fmt: skip
            for contradiction in of_settings(camera):
                yield f"camera {camera.name}: {contradiction}"
        if camera.images is None and needs_images:
            yield f"camera {camera.name}: images is missing, the glob of its photographs is needed"


def _of_balanced(camera: CameraSettings) -> Iterator[str]:
    """Yield what is incomplete in a camera in AICON's form, and which other values it has too."""
    if not camera.balanced:
        return
    given = dict(camera.balanced)
    if camera.model != BALANCED_MODEL:
        yield f"balanced is given, model {camera.model}, expected {BALANCED_MODEL}"
    for parameter in given:
        if parameter not in BALANCED:
            yield f"balanced has no parameter '{parameter}', expected one of {', '.join(BALANCED)}"
    for parameter in ("c", "R0"):
        if parameter not in given:
            yield f"balanced.{parameter} is missing"
    if not SMALLEST <= abs(given["c"]) <= LARGEST or not 0 <= given["R0"] <= LARGEST:
        yield (
            f"balanced.c = {given['c']:g} mm and R0 = {given['R0']:g} mm, expected c other than 0 and R0 of "
            "0 or more"
        )
    for name, other in (("fixed", camera.fixed), ("start", camera.start), ("c_mm", camera.c_mm)):
        if other:
            yield f"balanced and {name} are given, expected one of them"
    try:
        from_balanced(camera.balanced)
    except GeometryError as error:
        yield f"balanced: {error}"


def _of_parameters(camera: CameraSettings) -> Iterator[str]:
    known = MODELS[camera.model].names
    stated = {
        key: tuple(dict(getattr(camera, key)) if key in VALUES else getattr(camera, key))
        for key in ("free", *VALUES, "per_photograph", "per_group")
    }
    for parameter in (name for names in stated.values() for name in names):
        if parameter not in known:
            yield f"model {camera.model} has no parameter '{parameter}', it has {', '.join(known)}"
    for key in ("free", "per_photograph", "per_group"):
        for parameter in stated[key]:
            times = stated[key].count(parameter)
            if times > 1:
                yield f"parameter '{parameter}' occurs {times} times in {key}, once is needed"
    for first, second in EXCLUSIVE:
        for parameter in sorted(set(stated[first]) & set(stated[second])):
            yield f"parameter '{parameter}' is both {first} and {second}"


def _of_calibration(camera: CameraSettings) -> Iterator[str]:
    """Yield what contradicts a calibration, and what is missing of its values without one."""
    known = {*dict(camera.fixed), *dict(camera.weighted)}
    surface = MODELS[camera.model].names_of(Role.RANGE, Role.SURFACE)  # no survey determines it by itself
    missing = [name for name in surface if name not in known]
    if missing and camera.calibration is None:
        yield (
            f"model {camera.model} needs the values of {counted(len(surface), 'parameter')} of its surface, "
            f"{len(missing)} are missing; give the folder of a calibration with them, calibration = FOLDER"
        )
    weighted = dict(camera.weighted)
    for first, second, _ in camera.correlations:
        if first == second or first not in weighted or second not in weighted:
            yield f"correlation of {first} and {second}, expected two weighted parameters"
    if camera.correlations and (camera.per_photograph or camera.per_group):
        yield "correlations go with one value for all photographs, not with per_photograph"
    if camera.calibration is None:
        if camera.calibration_use != "fixed":
            yield "calibration_use is given, calibration is needed with it"
        return
    for key in sorted(camera.model_fields_set - {"name", "images", "size_px", *CALIBRATION_KEYS}):
        yield f"{key} and calibration are both given; a calibration sets all parameters"


def _of_values(camera: CameraSettings) -> Iterator[str]:
    for parameter in dict(camera.start):
        if parameter not in camera.may_be_free:
            yield f"start.{parameter} is given, but '{parameter}' is not in free"
    for key in ("per_photograph", "per_group"):
        for parameter in getattr(camera, key):
            if parameter not in camera.adjusted:
                yield (f"parameter '{parameter}' is in {key} but is not adjusted, needed in free or weighted")
    if bool(camera.per_group) != bool(camera.groups):
        missing, given = ("groups", "per_group") if camera.per_group else ("per_group", "groups")
        yield f"{given} is given, {missing} is needed with it"
    if camera.pixel_mm is not None and camera.sensor_mm is not None:
        yield "pixel_mm and sensor_mm are both given, one is needed"
    for key in VALUES:
        if camera.c_mm is not None and "c" in dict(getattr(camera, key)):
            yield f"c_mm and {key}.c are both given, one is needed"


def _of_rigs(survey: Described) -> Iterator[str]:
    known = {camera.name for camera in survey.cameras}
    owner: dict[str, str] = {}
    for rig in survey.rigs:
        if len(rig.cameras) < 2:
            yield f"rig {rig.name}: {counted(len(rig.cameras), 'camera')}, at least 2 are needed"
        for name in rig.cameras:
            if name not in known:
                yield (
                    f"rig {rig.name}: no camera is named '{name}'; cameras are "
                    f"{listed(sorted(known), most=10)}"
                )
            if name in owner:
                yield f"rig {rig.name}: camera {name} is already on rig {owner[name]}, needed one rig"
            owner[name] = rig.name
        for contradiction in _of_rig(rig, from_photographs=reads_photographs(survey)):
            yield f"rig {rig.name}: {contradiction}"
    for camera in survey.cameras if survey.rigs else ():
        if camera.per_photograph or camera.groups:
            yield (
                f"camera {camera.name} has parameters of single photographs or groups; needed one interior "
                "orientation for each camera of a survey with rigs"
            )
    if len({rig.name for rig in survey.rigs}) < len(survey.rigs):
        yield "two rigs have the same name"


def _of_rig(rig: RigSettings, *, from_photographs: bool) -> Iterator[str]:
    if rig.blocks and rig.mounts is not None:
        yield "mounts and blocks are both given, needed one: blocks find their own mounts"
    if "tolerance_s" in rig.model_fields_set and rig.moment != "exif":
        yield f"tolerance_s is given, moment = \"exif\" is needed with it; moment is '{rig.moment}'"
    if rig.moment != "order" and not rig.named:
        yield from _of_pattern(rig.moment)
    if rig.moment == "exif" and not from_photographs:
        yield (
            "moment = 'exif' needs photographs, [observations] have none; name the moments by an expression, "
            "'order' or a table"
        )


def _of_pattern(pattern: str) -> Iterator[str]:
    """Yield why an expression has not exactly one group, or may not be fast on any name."""
    try:
        groups = re.compile(pattern).groups
    except (re.error, OverflowError, RecursionError) as error:
        yield f"moment = '{pattern}' is not a regular expression: {error}"
        return
    if groups != 1:
        yield (
            f"moment = '{pattern}' has {counted(groups, 'group')}, needed 1, such as 'left_([0-9]+)', or "
            "moment = 'order'"
        )
    bare = re.sub(r"\\.|\[[^\]]*\]", "x", pattern)  # without escaped characters and character sets
    if len(re.findall(r"[*+{]", bare)) > MAX_REPEATS or re.search(r"\)[*+{]", bare):
        yield (
            f"moment = '{pattern}' repeats more than {MAX_REPEATS} parts, or a group, which could take "
            "forever; needed a plain expression such as 'left_([0-9]+)'"
        )


def _of_photographs(survey: Described) -> Iterator[str]:
    patterns = (pattern for camera in survey.cameras for pattern in camera.images or ())
    globs = sum(name_of_glob(pattern) is None for pattern in patterns)
    if globs > MAX_GLOBS:
        yield f"{globs} globs of photographs with wildcards, at most {MAX_GLOBS} are searched"
    if survey.compare.baseline != "none" and not reads_photographs(survey):
        yield (
            f"compare.baseline = '{survey.compare.baseline}' needs photographs, the survey has "
            "[observations]; leave it out"
        )
    if survey.start_points is not None and not any(row.source.names_last for row in declared(survey)):
        yield (
            "[approximate] points are start values of targets, and tie points differ in every run; with "
            "[tie_points] give start values of the photographs, [approximate] images"
        )


def _of_datum(survey: Described) -> Iterator[str]:
    """Yield what contradicts in the datum and in what carries it: plate, exterior orientation, control."""
    if survey.datum.kind == "control" and survey.datum.points:
        yield "datum.points are for kind 'free' or 'minimal', in kind 'control' the control carries the datum"
    refuse_contradicting_plates(survey.targets, survey.source)
    refuse_free_points_without_turn(survey.targets, survey.datum.kind, survey.source)
    plate = plate_control(survey.targets)
    given = survey.control if isinstance(survey.control, KnownPoints) else None
    if plate is not None and survey.control is not None and given is None:
        yield "[control] is given, but the calibration plate is the control"
    table = survey.exterior.file if isinstance(survey.exterior, ExteriorSettings) else survey.exterior
    if survey.exterior is not None and (table is None) == (survey.exif_sigma_m is None):
        said = "neither is" if table is None else "both are"
        yield f"[exterior]: file and exif_sigma_m, {said} given, one is needed"
    if survey.exif_sigma_m is not None and not reads_photographs(survey):
        yield "exterior.exif_sigma_m needs photographs, the survey has [observations]; give exterior.file"
    # the marks file of a survey file may state control
    if survey.datum.kind != "control" or getattr(survey, "marked", None) is not None:
        return
    observed = survey.exterior is not None or survey.exif_sigma_m is not None
    if not (survey.control is not None or observed or plate is not None):
        yield "datum kind 'control' needs [control] with the file of known points, or [exterior]"
    if given is not None and given.only_checks and not observed:
        yield (
            f"all {counted(len(given.names), 'control point')} are check points, and datum kind 'control' "
            "needs some that are not"
        )


def _of_scale_bars(survey: Described) -> Iterator[str]:
    for bar in survey.scale_bars:
        if bar.start == bar.end:
            yield f"scale_bar from '{bar.start}' to the same point"
        if bar.length > MAX_LENGTH_PER_SIGMA * bar.sigma:
            yield (
                f"scale_bar {bar.start} - {bar.end}: length {bar.length:g} is more than a million times its "
                f"sigma {bar.sigma:g}; are both in {survey.unit}?"
            )


def _of_points(survey: Described) -> Iterator[str]:
    """Yield points that a person names in a photograph more than once, or in one place by two names."""
    for first, second in combinations(survey.marks, 2):
        if first.image != second.image:
            continue
        if first.name == second.name:
            yield f"point '{first.name}' is named twice in {first.image}, needed once"
        distance = math.hypot(first.x_px - second.x_px, first.y_px - second.y_px)
        if distance <= max(first.sigma_px, second.sigma_px):
            yield (
                f"points '{first.name}' and '{second.name}' are {distance:.3g} px apart in "
                f"{first.image}, which is no more than sigma_px; needed one name for one place"
            )


def _of_targets(survey: Described) -> Iterator[str]:
    """Yield sizes of tags or rings that contradict the codes or each other, and codes that are not known."""
    targets = survey.targets
    if targets.tag_size is not None and targets.codes not in (*DICTIONARIES, *TAGGED):
        yield (
            f"targets.tag_size is the size of tags, codes = '{targets.codes}' has none; tags are "
            f"{', '.join(list(DICTIONARIES)[:4])} ..."
        )
    if targets.ring_radii is not None:
        inner, outer = targets.ring_radii
        if targets.codes in ("none", *DICTIONARIES, *WIDTHS, *PLATES):
            yield f"targets.ring_radii belong to rings, codes = '{targets.codes}' has none"
        if not 1 < inner < outer:
            yield (
                f"targets.ring_radii = [{inner:g}, {outer:g}], needed more than 1 radius of the dot and the "
                "second larger"
            )
    if targets.tag_sigma is not None:
        if targets.tag_size is None:
            yield "targets.tag_sigma needs targets.tag_size"
        elif targets.tag_size > MAX_LENGTH_PER_SIGMA * targets.tag_sigma:
            yield (
                f"targets.tag_size {targets.tag_size:g} is more than a million times its sigma "
                f"{targets.tag_sigma:g}; are both in {survey.unit}?"
            )
    if is_table(targets.codes) and not Path(survey.codes).is_file():
        yield (
            f"targets.codes = '{targets.codes}' is neither one of "
            f"{', '.join((*FAMILIES, *PLATES))} nor a table file in {survey.folder}"
        )
