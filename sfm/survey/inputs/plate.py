"""The calibration plate of a survey: its family, and its points as control and start values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.errors import GeometryError, SurveyFileError
from sfm.survey.inputs.given import KnownPoints
from sfm.survey.inputs.settings import PlateSettings, TargetSettings
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

OF_PLATES = (
    *("rows", "columns", "pitch", "pitch_assumed", "marks", "plate_sigma", "dictionary", "first_tag"),
)
MIN_SIDE = 3  # rows or columns of a checkerboard that OpenCV finds


def plate_family(targets: PlateSettings) -> PlateFamily | None:
    """Return the plate that the targets are on; None where they are on none."""
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
    """Return the points of the plate, flat and in their grid, as control; None without a plate.

    The origin is the first point, X along the rows, Y up the columns, Z towards the camera.
    """
    plate = plate_family(targets)
    if plate is None or targets.pitch is None:
        return None
    xyz = plate.plane(targets.pitch)
    names = tuple(str(k) for k in range(plate.count))
    return KnownPoints(names, xyz, np.full_like(xyz, targets.plate_sigma or 0.0))


def plate_group(targets: TargetSettings, others: Sequence[PlateSettings]) -> PlateGroup:
    """Return the plates of a survey, that of the targets first.

    Raises:
        GeometryError: they cannot be used side by side, see `group_plates`.
    """
    plates = [plate_family(targets), *(plate_family(one) for one in others)]
    return group_plates([plate for plate in plates if plate is not None])


def refuse_contradicting_groups(targets: TargetSettings, others: Sequence[PlateSettings], where: str) -> None:
    """Raise SurveyFileError where plates beside another are incomplete, or cannot be distinguished."""
    if not others:
        return
    if targets.codes not in PLATES:
        raise SurveyFileError(
            f"{where}: plate beside targets of codes = '{targets.codes}', needed a first plate in [targets]"
        )
    for k, one in enumerate(others, 2):
        if one.codes not in PLATES:
            raise SurveyFileError(
                f"{where}: plate {k}: codes = '{one.codes}' is no plate; plates are {', '.join(PLATES)}"
            )
        refuse_contradicting_plates(one, f"{where}: plate {k}")
    try:
        plate_group(targets, others)
    except GeometryError as error:
        raise SurveyFileError(f"{where}: plates: {error}") from error


def is_plate_control(control: KnownPoints | None, plate: KnownPoints | None) -> bool:
    """Return whether the control is that of the plate."""
    if control is None or plate is None or control.names != plate.names:
        return False
    return bool(np.array_equal(control.xyz, plate.xyz) and np.array_equal(control.sigma, plate.sigma))


def refuse_contradicting_plates(targets: PlateSettings, where: str) -> None:
    """Raise SurveyFileError where the description of a plate is incomplete, or belongs to none."""
    given = [name for name in OF_PLATES if name in targets.model_fields_set]
    if targets.codes not in PLATES:
        if given:
            raise SurveyFileError(
                f"{where}: targets.{given[0]} is of a calibration plate, codes = '{targets.codes}' is none; "
                f"plates are {', '.join(PLATES)}"
            )
        return
    for name in ("rows", "columns", "pitch"):
        if getattr(targets, name) is None:
            raise SurveyFileError(f"{where}: targets.{name} is missing, codes = '{targets.codes}' needs it")
    plate = plate_family(targets)
    assert plate is not None
    board = targets.codes in TAGGED
    if board and targets.dictionary not in DICTIONARIES:
        raise SurveyFileError(
            f"{where}: targets.dictionary = '{targets.dictionary or ''}', codes = '{targets.codes}' needs "
            f"one of {', '.join(DICTIONARIES)}"
        )
    if board and not 0 < plate.tag_share < 1:
        raise SurveyFileError(
            f"{where}: targets.tag_size is the side of the tags of a ChArUco board or AprilGrid, needed "
            "between 0 and the pitch"
        )
    if board and plate.last_tag >= tag_family(plate.dictionary).count:
        raise SurveyFileError(
            f"{where}: the board has tags {plate.first_tag} to {plate.last_tag}, dictionary "
            f"'{plate.dictionary}' has 0 to {tag_family(plate.dictionary).count - 1}"
        )
    if targets.codes == "aprilgrid" and (plate.rows % 2 or plate.columns % 2):
        raise SurveyFileError(
            f"{where}: an AprilGrid of {plate.rows} x {plate.columns} corners, even numbers are needed (rows "
            "and columns count corners, two for each tag)"
        )
    for name in ("dictionary", "first_tag"):
        if not board and name in targets.model_fields_set:
            raise SurveyFileError(
                f"{where}: targets.{name} is of codes = 'charuco' and 'aprilgrid', found '{targets.codes}'"
            )
    if targets.codes not in GRIDS and targets.marks:
        raise SurveyFileError(f"{where}: targets.marks are of {', '.join(GRIDS)}, found '{targets.codes}'")
    if targets.codes == "checkerboard" and min(plate.rows, plate.columns) < MIN_SIDE:
        raise SurveyFileError(
            f"{where}: a checkerboard of {plate.rows} x {plate.columns} crossings, at least {MIN_SIDE} x "
            f"{MIN_SIDE} are needed (rows and columns count crossings inside the board, not squares)"
        )
    try:
        refuse_unusable_plate(plate)
    except GeometryError as error:
        raise SurveyFileError(f"{where}: targets.marks: {error}") from error


def refuse_free_points_without_turn(targets: TargetSettings, datum: str, where: str) -> None:
    """Raise SurveyFileError where each point has separate coordinates, and its identity cannot be known."""
    plate = plate_family(targets)
    if plate is None or datum == "control" or not plate.is_ambiguous:
        return
    turned = 360 // (1 + len(plate.turns))
    raise SurveyFileError(
        f"{where}: a plate that looks alike turned by {turned} degrees has no identified points; needed "
        "[datum] kind = 'control', which takes the plate as flat and true, or a plate with marks"
    )
