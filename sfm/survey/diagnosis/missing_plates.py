"""Calibration plates that were not found in photographs, or are not in the result, and what to do."""

from __future__ import annotations

import statistics

from sfm.conventions import IntArray
from sfm.remarks.remark import Remark, remark
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.targets.codes.dot_plates import MIN_DOTS
from sfm.targets.codes.families import TargetFamily
from sfm.targets.codes.plates import plates_of, points_of_plates
from sfm.targets.flags import Flag

NOT_FOUND = {  # kinds of remarks by the codes of a board; that on dots of any grid is another
    "checkerboard": "checkerboard_not_found",
    "charuco": "charuco_not_found",
    "aprilgrid": "aprilgrid_not_found",
}


def missing_plates(family: TargetFamily | None, photographs: MeasuredPhotographs) -> tuple[Remark, ...]:
    """Return the remarks on photographs in which a plate was not found; none where it is in all.

    Args:
        family: codes of the survey.
        photographs: with the points of the plate as their codes.
    """
    remarks, plates = [], plates_of(family)
    found = list(zip(photographs.names, photographs.targets, strict=True))
    nothing = [one for one in found if not (one[1].code >= 0).any()]
    for plate in plates:
        is_seen = any(
            ((targets.code >= plate.first_point) & (targets.code <= plate.last_point)).any()
            for _, targets in found
        )
        # photographs in which no plate is found are named with the first; a plate that none shows, with all
        without = (nothing if plate is plates[0] else []) if is_seen else found
        dots = {
            name: int((targets.rejected_flag == Flag.NOT_ON_PLATE.value).sum()) for name, targets in without
        }
        strange = [name for name in dots if dots[name] >= MIN_DOTS]
        missing = [name for name in dots if dots[name] < MIN_DOTS]
        size = f"{plate.rows} x {plate.columns}"
        if missing:
            kind = NOT_FOUND.get(plate.name, "plate_not_found")
            remarks.append(remark(kind, photographs=missing, size=size))
        if strange:
            many = round(statistics.median(dots[name] for name in strange))
            remarks.append(remark("plate_not_recognised", photographs=strange, dots=many, size=size))
    return tuple(remarks)


def plates_not_in_result(family: TargetFamily | None, code: IntArray) -> tuple[Remark, ...]:
    """Return the remarks on plates beside another one of which the result has no point.

    Args:
        family: codes of the survey.
        code: of each point of the result, -1 without one, (n,).
    """
    return tuple(
        remark("plate_not_in_result", codes=plate.name, size=f"{plate.rows} x {plate.columns}")
        for plate, points in zip(plates_of(family), points_of_plates(family, code), strict=True)
        if not len(points)
    )
