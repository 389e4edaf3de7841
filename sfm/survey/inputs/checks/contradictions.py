"""Checks for settings that are valid one by one but contradict each other."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

from sfm.display import counted, listed
from sfm.distortion.brown import BALANCED, BALANCED_MODEL, from_balanced
from sfm.distortion.models import MODELS
from sfm.errors import GeometryError, SurveyFileError
from sfm.survey.inputs.calibration import (
    plate_control,
    refuse_contradicting_plates,
    refuse_free_points_without_turn,
)
from sfm.survey.inputs.given import KnownPoints
from sfm.survey.inputs.settings import (
    LARGEST,
    MAX_GLOBS,
    MAX_LENGTH_PER_SIGMA,
    SMALLEST,
    CameraSettings,
    ExteriorSettings,
    PointSettings,
    RigSettings,
    TargetSettings,
)
from sfm.survey.inputs.sources import declared, reads_photographs
from sfm.targets.codes.concentric import WIDTHS
from sfm.targets.codes.plates import FAMILIES, PLATES, TAGGED, is_table
from sfm.targets.codes.tags import DICTIONARIES

if TYPE_CHECKING:
    from sfm.survey.inputs.survey import Survey
    from sfm.survey.inputs.survey_file import SurveyFile

MAX_REPEATS = 3  # in the expression for a moment: searching a name of 255 characters takes 255^3 steps
CALIBRATION_KEYS = {"calibration", "calibration_use"}


def refuse_contradictions(survey: Survey | SurveyFile) -> None:
    """Raise SurveyFileError if settings of a survey contradict each other."""
    where = survey.source
    from_photographs = reads_photographs(survey)
    if survey.start_points is not None and not any(row.source.names_last for row in declared(survey)):
        raise SurveyFileError(
            f"{where}: [approximate] points are start values of targets, and tie points differ in every "
            "run; with [tie_points] give start values of the photographs, [approximate] images"
        )
    names = [camera.name for camera in survey.cameras]
    for name in names:
        if names.count(name) > 1:
            raise SurveyFileError(f"{where}: two cameras are named '{name}'")
    for camera in survey.cameras:
        _refuse_contradictions_of_camera(camera, f"{where}: camera {camera.name}")
        if camera.images is None and (from_photographs or len(survey.cameras) > 1):
            raise SurveyFileError(
                f"{where}: camera {camera.name}: images is missing, the glob of its photographs is needed"
            )
    _refuse_contradictions_of_rigs(survey.rigs, survey.cameras, where)
    for rig in survey.rigs:
        if rig.moment == "exif" and not from_photographs:
            raise SurveyFileError(
                f"{where}: rig {rig.name}: moment = 'exif' needs photographs, [observations] have none; "
                "name the moments by an expression, 'order' or a table"
            )
    globs = sum(len(camera.images or ()) for camera in survey.cameras)
    if globs > MAX_GLOBS:
        raise SurveyFileError(f"{where}: {globs} globs of photographs, at most {MAX_GLOBS} are searched")
    if survey.compare.baseline != "none" and not from_photographs:
        raise SurveyFileError(
            f"{where}: compare.baseline = '{survey.compare.baseline}' needs photographs, the survey has "
            "[observations]; leave it out"
        )
    if survey.datum.kind == "control" and survey.datum.points:
        raise SurveyFileError(
            f"{where}: datum.points are for kind 'free' or 'minimal', in kind 'control' the control carries "
            "the datum"
        )
    refuse_contradicting_plates(survey.targets, where)
    refuse_free_points_without_turn(survey.targets, survey.datum.kind, where)
    plate = plate_control(survey.targets)
    if plate is not None and survey.control is not None and not isinstance(survey.control, KnownPoints):
        raise SurveyFileError(f"{where}: [control] is given, but the calibration plate is the control")
    _refuse_contradicting_exterior(survey)
    observed = survey.exterior is not None or survey.exif_sigma_m is not None
    known = survey.control is not None or observed or plate is not None
    if survey.datum.kind == "control" and not known:
        raise SurveyFileError(
            f"{where}: datum kind 'control' needs [control] with the file of known points, or [exterior]"
        )
    given = survey.control if isinstance(survey.control, KnownPoints) else None
    if survey.datum.kind == "control" and given is not None and given.only_checks and not observed:
        raise SurveyFileError(
            f"{where}: all {counted(len(given.names), 'control point')} are check points, and datum kind "
            "'control' needs some that are not"
        )
    for bar in survey.scale_bars:
        if bar.start == bar.end:
            raise SurveyFileError(f"{where}: scale_bar from '{bar.start}' to the same point")
        if bar.length > MAX_LENGTH_PER_SIGMA * bar.sigma:
            raise SurveyFileError(
                f"{where}: scale_bar {bar.start} - {bar.end}: length {bar.length:g} is more than a million "
                f"times its sigma {bar.sigma:g}; are both in {survey.unit}?"
            )
    _refuse_contradicting_points(survey.marks, where)
    _refuse_contradicting_sizes(survey.targets, where, survey.unit)
    if is_table(survey.targets.codes) and not Path(survey.codes).is_file():
        raise SurveyFileError(
            f"{where}: targets.codes = '{survey.targets.codes}' is neither one of "
            f"{', '.join((*FAMILIES, *PLATES))} nor a table file in {survey.folder}"
        )


def _refuse_contradicting_points(points: Sequence[PointSettings], where: str) -> None:
    """Raise SurveyFileError if a point is named twice in a photograph, or two points at one place."""
    for first, second in combinations(points, 2):
        if first.image != second.image:
            continue
        if first.name == second.name:
            raise SurveyFileError(
                f"{where}: point '{first.name}' is named twice in {first.image}, needed once"
            )
        distance = math.hypot(first.x_px - second.x_px, first.y_px - second.y_px)
        if distance <= max(first.sigma_px, second.sigma_px):
            raise SurveyFileError(
                f"{where}: points '{first.name}' and '{second.name}' are {distance:.3g} px apart in "
                f"{first.image}, which is no more than sigma_px; needed one name for one place"
            )


def _refuse_contradicting_exterior(survey: Survey | SurveyFile) -> None:
    """Raise SurveyFileError unless exterior orientation is observed in exactly one way."""
    table = survey.exterior.file if isinstance(survey.exterior, ExteriorSettings) else survey.exterior
    if survey.exterior is not None and (table is None) == (survey.exif_sigma_m is None):
        found = "neither is" if table is None else "both are"
        raise SurveyFileError(
            f"{survey.source}: [exterior]: file and exif_sigma_m, {found} given, one is needed"
        )
    if survey.exif_sigma_m is not None and not reads_photographs(survey):
        raise SurveyFileError(
            f"{survey.source}: exterior.exif_sigma_m needs photographs, the survey has [observations]; "
            "give exterior.file"
        )


def _refuse_contradicting_sizes(targets: TargetSettings, where: str, unit: str) -> None:
    """Raise SurveyFileError if sizes of tags or rings contradict the codes or each other."""
    if targets.tag_size is not None and targets.codes not in (*DICTIONARIES, *TAGGED):
        raise SurveyFileError(
            f"{where}: targets.tag_size is the size of tags, codes = '{targets.codes}' has none; "
            f"tags are {', '.join(list(DICTIONARIES)[:4])} ..."
        )
    if targets.ring_radii is not None:
        inner, outer = targets.ring_radii
        if targets.codes in ("none", *DICTIONARIES, *WIDTHS, *PLATES):
            raise SurveyFileError(
                f"{where}: targets.ring_radii belong to rings, codes = '{targets.codes}' has none"
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


def _refuse_contradictions_of_balanced(camera: CameraSettings, at: str) -> None:
    """Raise SurveyFileError if a camera in AICON's form is incomplete or has other values too."""
    given = dict(camera.balanced)
    if camera.model != BALANCED_MODEL:
        raise SurveyFileError(f"{at}: balanced is given, model {camera.model}, expected {BALANCED_MODEL}")
    for parameter in given:
        if parameter not in BALANCED:
            raise SurveyFileError(
                f"{at}: balanced has no parameter '{parameter}', expected one of {', '.join(BALANCED)}"
            )
    for parameter in ("c", "R0"):
        if parameter not in given:
            raise SurveyFileError(f"{at}: balanced.{parameter} is missing")
    if not SMALLEST <= abs(given["c"]) <= LARGEST or not 0 <= given["R0"] <= LARGEST:
        raise SurveyFileError(
            f"{at}: balanced.c = {given['c']:g} mm and R0 = {given['R0']:g} mm, expected c other than 0 and "
            "R0 of 0 or more"
        )
    for name, both in (("fixed", camera.fixed), ("start", camera.start), ("c_mm", camera.c_mm)):
        if both:
            raise SurveyFileError(f"{at}: balanced and {name} are given, expected one of them")
    try:
        from_balanced(camera.balanced)
    except GeometryError as error:
        raise SurveyFileError(f"{at}: balanced: {error}") from error


def _refuse_contradictions_of_camera(camera: CameraSettings, at: str) -> None:
    """Raise SurveyFileError if the settings of a camera contradict each other."""
    known = MODELS[camera.model].names
    if camera.balanced:
        _refuse_contradictions_of_balanced(camera, at)
    fixed, weighted, start = dict(camera.fixed), dict(camera.weighted), dict(camera.start)
    varying = (*camera.per_photograph, *camera.per_group)
    for parameter in (*camera.free, *fixed, *weighted, *start, *varying):
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
                    f"{at}: parameter '{parameter}' occurs {names.count(parameter)} times in {key}, once is "
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
    for first, second, _ in camera.correlations:
        if first == second or first not in weighted or second not in weighted:
            raise SurveyFileError(
                f"{at}: correlation of {first} and {second}, expected two weighted parameters"
            )
    if camera.correlations and varying:
        raise SurveyFileError(
            f"{at}: correlations go with one value for all photographs, not with per_photograph"
        )
    if camera.calibration is not None:
        for key in sorted(camera.model_fields_set - {"name", "images", "size_px", *CALIBRATION_KEYS}):
            raise SurveyFileError(
                f"{at}: {key} and calibration are both given; a calibration sets all parameters"
            )
    elif camera.calibration_use != "fixed":
        raise SurveyFileError(f"{at}: calibration_use is given, calibration is needed with it")
    for parameter in start:
        if parameter not in camera.may_be_free:
            raise SurveyFileError(f"{at}: start.{parameter} is given, but '{parameter}' is not in free")
    for parameter in varying:
        if parameter not in camera.adjusted:
            key = "per_photograph" if parameter in camera.per_photograph else "per_group"
            raise SurveyFileError(
                f"{at}: parameter '{parameter}' is in {key} but is not adjusted, needed in free or weighted"
            )
    if bool(camera.per_group) != bool(camera.groups):
        missing, given = ("groups", "per_group") if camera.per_group else ("per_group", "groups")
        raise SurveyFileError(f"{at}: {given} is given, {missing} is needed with it")
    if camera.pixel_mm is not None and camera.sensor_mm is not None:
        raise SurveyFileError(f"{at}: pixel_mm and sensor_mm are both given, one is needed")
    for key, values in (("fixed", fixed), ("weighted", weighted), ("start", start)):
        if camera.c_mm is not None and "c" in values:
            raise SurveyFileError(f"{at}: c_mm and {key}.c are both given, one is needed")


def _refuse_contradictions_of_rigs(
    rigs: Sequence[RigSettings], cameras: Sequence[CameraSettings], where: str
) -> None:
    """Raise SurveyFileError for rigs with unknown or shared cameras, or with contradicting settings."""
    known = {camera.name: camera for camera in cameras}
    owner: dict[str, str] = {}
    for rig in rigs:
        here = f"{where}: rig {rig.name}"
        if len(rig.cameras) < 2:
            raise SurveyFileError(f"{here}: {counted(len(rig.cameras), 'camera')}, at least 2 are needed")
        for name in rig.cameras:
            if name not in known:
                some = listed(sorted(known), most=10)
                raise SurveyFileError(f"{here}: no camera is named '{name}'; cameras are {some}")
            if name in owner:
                raise SurveyFileError(
                    f"{here}: camera {name} is already on rig {owner[name]}, needed one rig"
                )
            owner[name] = rig.name
        if rig.blocks and rig.mounts is not None:
            raise SurveyFileError(
                f"{here}: mounts and blocks are both given, needed one: blocks find their own mounts"
            )
        if "tolerance_s" in rig.model_fields_set and rig.moment != "exif":
            raise SurveyFileError(
                f"{here}: tolerance_s is given, moment = \"exif\" is needed with it; moment is '{rig.moment}'"
            )
        if rig.moment != "order" and not rig.named:
            _refuse_pattern(rig.moment, here)
    for camera in cameras if rigs else ():
        if camera.per_photograph or camera.groups:
            raise SurveyFileError(
                f"{where}: camera {camera.name} has parameters of single photographs or groups; needed one "
                "interior orientation for each camera of a survey with rigs"
            )
    if len({rig.name for rig in rigs}) < len(rigs):
        raise SurveyFileError(f"{where}: two rigs have the same name")


def _refuse_pattern(pattern: str, where: str) -> None:
    """Raise SurveyFileError unless an expression has exactly one group and is fast on any name."""
    try:
        groups = re.compile(pattern).groups
    except (re.error, OverflowError, RecursionError) as error:
        raise SurveyFileError(f"{where}: moment = '{pattern}' is not a regular expression: {error}") from None
    if groups != 1:
        raise SurveyFileError(
            f"{where}: moment = '{pattern}' has {counted(groups, 'group')}, needed 1, such as "
            "'left_([0-9]+)', or moment = 'order'"
        )
    bare = re.sub(r"\\.|\[[^\]]*\]", "x", pattern)  # without escaped characters and character sets
    if len(re.findall(r"[*+{]", bare)) > MAX_REPEATS or re.search(r"\)[*+{]", bare):
        raise SurveyFileError(
            f"{where}: moment = '{pattern}' repeats more than {MAX_REPEATS} parts, or a group, which could "
            "take forever; needed a plain expression such as 'left_([0-9]+)'"
        )
