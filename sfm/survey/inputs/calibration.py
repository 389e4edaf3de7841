"""Interior orientation from an earlier result, and the calibration plate of a survey.

The interior orientation is read from these files of the result:

    summary.json                model, size and pixel of each camera
    cameras.csv                 camera,parameter,value,sigma of each parameter; without sigma it was held
    interior_correlations.csv   camera,first,second,correlation of the adjusted parameters

As an observation it has the full covariance of its parameters. A calibration and a survey adjusted one after
the other then give the same result as both adjusted together, provided that they share nothing else.

The points of a calibration plate are the control of a survey. Contradicting or incomplete plates are refused.

Source: Mikhail, Bethel and McGlone, Modern Photogrammetry (2001), sec. 5.6 (a priori parameter constraints).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from sfm.files.csv_tables import read_table
from sfm.files.plain_text import Content, Name, Pixel, Side, read_json
from sfm.model.camera import Camera
from sfm.model.distortion.models import MODELS
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.survey.inputs.given_values import KnownPoints
from sfm.survey.inputs.settings import CameraSettings, PlateSettings, TargetSettings
from sfm.targets.codes.plates import (
    GRIDS,
    PLATES,
    TAGGED,
    PlateFamily,
    PlateGroup,
    group_plates,
    refuse_unusable_plate,
)
from sfm.targets.codes.tags import DICTIONARIES, tag_family

PLATE_KEYS = ("rows", "columns", "pitch", "pitch_assumed", "marks", "plate_sigma", "dictionary", "first_tag")
MIN_SIDE = 3  # rows or columns of a checkerboard that OpenCV finds
TABLES = ("summary.json", "cameras.csv", "interior_correlations.csv")


@dataclass(frozen=True)
class Calibration:
    """The interior orientation of one camera of a result."""

    name: str
    model: str
    size_px: tuple[int, int]
    pixel_mm: tuple[float, float]
    values: dict[str, float]  # of all parameters of the model, in its units
    sigma: dict[str, float] = field(default_factory=dict)  # of the adjusted parameters
    correlations: tuple[tuple[str, str, float], ...] = ()  # of pairs of adjusted parameters

    @classmethod
    def of_camera(cls, camera: Camera) -> Calibration:
        """Return the interior orientation of a camera, without standard deviations."""
        sides = (float(camera.pixel_mm[0]), float(camera.pixel_mm[1]))
        values = dict(zip(camera.names, camera.parameters.tolist(), strict=True))
        return cls(camera.name, camera.model, camera.size_px, sides, values)


class _Camera(Content):
    """A camera in the summary of a result."""

    name: Name
    model: Literal[tuple(MODELS)]  # type: ignore[valid-type]
    size_px: tuple[Side, Side]
    pixel_mm: tuple[Pixel, Pixel]


class _Summary(Content):
    """The part of summary.json that is read."""

    cameras: Annotated[tuple[_Camera, ...], Field(min_length=1)]


def read_calibrations(folder: Path) -> tuple[Calibration, ...]:
    """Read the interior orientations from the folder of a result.

    Raises:
        SurveyFileError: something is missing or wrong; the message has file and line number.
    """
    summary = read_json(folder / "summary.json", _Summary, "the summary of a result")
    table = read_table(
        folder / "cameras.csv", ("camera", "parameter"), ("value", "sigma"), ignored=None, blank=("sigma",)
    )
    keys = tuple(zip(*table.texts, strict=True))
    table.refuse_duplicates(keys, ("camera", "parameter"))
    sigma = table.values[:, 1:2]
    table.refuse(sigma, sigma < 0, ("sigma",), "0 or more, or nothing")
    rows = dict(zip(keys, table.values.tolist(), strict=True))
    path = folder / "interior_correlations.csv"
    correlations: dict[str, list[tuple[str, str, float]]] = {}
    adjusted_of = Counter(camera for (camera, _), (_, s) in rows.items() if np.isfinite(s) and s > 0)
    if path.is_file() and max(adjusted_of.values(), default=0) > 1:
        pairs = read_table(path, ("camera", "first", "second"), ("correlation",), blank=("correlation",))
        rho = pairs.values[:, :1]
        pairs.refuse(rho, np.abs(rho) > 1, ("correlation",), "from -1 to 1")
        for camera, first, second, value in zip(*pairs.texts, rho[:, 0].tolist(), strict=True):
            correlations.setdefault(camera, []).append((first, second, value))
    calibrations = []
    for stated in summary.cameras:
        missing = [name for name in MODELS[stated.model].names if (stated.name, name) not in rows]
        if missing:
            raise SurveyFileError(
                f"{table.path}: camera {stated.name} has no {', '.join(missing)}, model {stated.model} needs "
                "it"
            )
        of_camera = {name: rows[stated.name, name] for name in MODELS[stated.model].names}
        adjusted = {name: s for name, (_, s) in of_camera.items() if np.isfinite(s) and s > 0}
        calibrations.append(
            Calibration(
                stated.name,
                stated.model,
                stated.size_px,
                stated.pixel_mm,
                {name: value for name, (value, _) in of_camera.items()},
                adjusted,
                tuple(
                    (p, q, value)
                    for p, q, value in correlations.get(stated.name, ())
                    if p in adjusted and q in adjusted and np.isfinite(value)
                ),
            )
        )
    return tuple(calibrations)


def apply_calibration(
    settings: CameraSettings,
    calibrations: tuple[Calibration, ...],
    where: str,
    source: str,
    *,
    weighted: bool = False,
) -> CameraSettings:
    """Return the settings of one camera, held at a calibration or with the calibration as an observation.

    The camera takes the calibration of its name, or the only calibration if there is just one.

    Args:
        settings: settings of the camera; only its name, photographs and size are used.
        calibrations: cameras of an earlier result.
        where: name of the survey in error messages.
        source: name of the earlier result in error messages.
        weighted: whether the camera is adjusted, with the calibration and its covariance as an observation;
            else it is held.

    Raises:
        SurveyFileError: several calibrations but none of the camera's name, photographs of another size, or
            no standard deviations for an observation.
    """
    named = [calibration for calibration in calibrations if calibration.name == settings.name]
    if not named and len(calibrations) > 1:
        raise SurveyFileError(
            f"{where}: camera {settings.name} is not in {source}, expected one of "
            f"{', '.join(calibration.name for calibration in calibrations)}"
        )
    calibration = (named or list(calibrations))[0]
    if settings.size_px is not None and settings.size_px != calibration.size_px:
        raise SurveyFileError(
            f"{where}: camera {settings.name} has {settings.size_px[0]} x {settings.size_px[1]} px, "
            f"{calibration.name} of {source} {calibration.size_px[0]} x {calibration.size_px[1]} px"
        )
    if weighted and not calibration.sigma:
        raise SurveyFileError(
            f"{where}: {source} has no standard deviations of camera {calibration.name}, so it can be "
            "held but not weighted"
        )
    observed = calibration.sigma if weighted else {}
    return CameraSettings(
        name=settings.name,
        images=settings.images,
        size_px=calibration.size_px,
        pixel_mm=calibration.pixel_mm,
        model=calibration.model,
        free=(),
        fixed=tuple((name, value) for name, value in calibration.values.items() if name not in observed),
        weighted=tuple((name, (calibration.values[name], sigma)) for name, sigma in observed.items()),
        correlations=calibration.correlations if weighted else (),
    )


def plate_family(targets: PlateSettings) -> PlateFamily | None:
    """Return the plate of the targets; None if they are not on a plate."""
    if targets.codes not in PLATES or targets.rows is None or targets.columns is None:
        return None
    share = 0.0
    if targets.tag_size is not None and targets.pitch is not None:
        share = targets.tag_size / targets.pitch
    return PlateFamily(
        targets.codes,
        targets.rows,
        targets.columns,
        targets.marks,
        targets.dictionary or "",
        share,
        targets.first_tag,
    )


def plate_control(targets: TargetSettings) -> KnownPoints | None:
    """Return the points of the plate as control, on a plane grid; None without a plate.

    The origin is the first point. X runs along the rows, Y up the columns, and Z towards the camera.
    """
    plate = plate_family(targets)
    if plate is None or targets.pitch is None:
        return None
    xyz = plate.plane(targets.pitch)
    names = tuple(str(k) for k in range(plate.count))
    return KnownPoints(names, xyz, np.full_like(xyz, targets.plate_sigma or 0.0))


def plate_group(targets: TargetSettings, others: Sequence[PlateSettings]) -> PlateGroup:
    """Return the plates of a survey, the plate of the targets first.

    Raises:
        GeometryError: they cannot be used side by side, see `group_plates`.
    """
    plates = [plate_family(targets), *(plate_family(other) for other in others)]
    return group_plates([plate for plate in plates if plate is not None])


def refuse_contradicting_groups(targets: TargetSettings, others: Sequence[PlateSettings], where: str) -> None:
    """Raise SurveyFileError if further plates are incomplete, or if plates cannot be distinguished."""
    if not others:
        return
    if targets.codes not in PLATES:
        raise SurveyFileError(
            f"{where}: plate is given, targets.codes = '{targets.codes}'; needed the first plate in [targets]"
        )
    for k, other in enumerate(others, 2):
        if other.codes not in PLATES:
            raise SurveyFileError(
                f"{where}: plate {k}: codes = '{other.codes}' is not a plate; plates are {', '.join(PLATES)}"
            )
        refuse_contradicting_plates(other, f"{where}: plate {k}")
    try:
        plate_group(targets, others)
    except GeometryError as error:
        raise SurveyFileError(f"{where}: plates: {error}") from error


def is_plate_control(control: KnownPoints | None, plate: KnownPoints | None) -> bool:
    """Return whether the control consists of the points of the plate."""
    if control is None or plate is None or control.names != plate.names:
        return False
    return bool(np.array_equal(control.xyz, plate.xyz) and np.array_equal(control.sigma, plate.sigma))


def refuse_contradicting_plates(targets: PlateSettings, where: str) -> None:
    """Raise SurveyFileError if the settings of a plate are incomplete, or are given without a plate."""
    given = [name for name in PLATE_KEYS if name in targets.model_fields_set]
    if targets.codes not in PLATES:
        if given:
            raise SurveyFileError(
                f"{where}: targets.{given[0]} belongs to a calibration plate, codes = '{targets.codes}' "
                f"is not one; plates are {', '.join(PLATES)}"
            )
        return
    for name in ("rows", "columns", "pitch"):
        if getattr(targets, name) is None:
            raise SurveyFileError(f"{where}: targets.{name} is missing, codes = '{targets.codes}' needs it")
    plate = plate_family(targets)
    assert plate is not None
    if targets.codes in TAGGED:
        _refuse_contradicting_tags(targets, plate, where)
    else:
        for name in ("dictionary", "first_tag"):
            if name in targets.model_fields_set:
                raise SurveyFileError(
                    f"{where}: targets.{name} belongs to codes = 'charuco' or 'aprilgrid', found "
                    f"'{targets.codes}'"
                )
    if targets.codes not in GRIDS and targets.marks:
        raise SurveyFileError(f"{where}: targets.marks belong to {', '.join(GRIDS)}, found '{targets.codes}'")
    if targets.codes == "checkerboard" and min(plate.rows, plate.columns) < MIN_SIDE:
        raise SurveyFileError(
            f"{where}: a checkerboard of {plate.rows} x {plate.columns} crossings, at least {MIN_SIDE} x "
            f"{MIN_SIDE} are needed (rows and columns count crossings inside the board, not squares)"
        )
    try:
        refuse_unusable_plate(plate)
    except GeometryError as error:
        raise SurveyFileError(f"{where}: targets.marks: {error}") from error


def _refuse_contradicting_tags(targets: PlateSettings, plate: PlateFamily, where: str) -> None:
    """Raise SurveyFileError if the tags of a board are unknown, too many or of an impossible size."""
    if targets.dictionary not in DICTIONARIES:
        raise SurveyFileError(
            f"{where}: targets.dictionary = '{targets.dictionary or ''}', codes = '{targets.codes}' needs "
            f"one of {', '.join(DICTIONARIES)}"
        )
    if not 0 < plate.tag_share < 1:
        raise SurveyFileError(
            f"{where}: targets.tag_size is the side of the tags of a ChArUco board or AprilGrid, needed "
            "between 0 and the pitch"
        )
    if plate.last_tag >= tag_family(plate.dictionary).count:
        raise SurveyFileError(
            f"{where}: the board has tags {plate.first_tag} to {plate.last_tag}, dictionary "
            f"'{plate.dictionary}' has 0 to {tag_family(plate.dictionary).count - 1}"
        )
    if targets.codes == "aprilgrid" and (plate.rows % 2 or plate.columns % 2):
        raise SurveyFileError(
            f"{where}: an AprilGrid of {plate.rows} x {plate.columns} corners, even numbers are needed (rows "
            "and columns count corners, two for each tag)"
        )


def refuse_free_points_without_turn(targets: TargetSettings, datum: str, where: str) -> None:
    """Raise SurveyFileError if the points of a plate have free coordinates but no unique identity."""
    plate = plate_family(targets)
    if plate is None or datum == "control" or not plate.is_ambiguous:
        return
    turned = 360 // (1 + len(plate.turns))
    raise SurveyFileError(
        f"{where}: a plate that looks alike turned by {turned} degrees has no identified points; needed "
        "[datum] kind = 'control', which takes the plate as flat and true, or a plate with marks"
    )
