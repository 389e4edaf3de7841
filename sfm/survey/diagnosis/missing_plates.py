"""Photographs in which the calibration plate of a survey was not found, and what to do."""

from __future__ import annotations

import statistics

from sfm.remarks.remark import Remark, remark
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.targets.codes.dot_plates import MIN_DOTS
from sfm.targets.codes.families import TargetFamily
from sfm.targets.codes.plates import BOARDS, PlateFamily
from sfm.targets.flags import Flag


def missing_plates(family: TargetFamily | None, photographs: MeasuredPhotographs) -> tuple[Remark, ...]:
    """Return the remarks on photographs in which a plate was not found; none where it is in all.

    Args:
        family: codes of the survey.
        photographs: with the points of the plate as their codes.
    """
    if not isinstance(family, PlateFamily):
        return ()
    found = zip(photographs.names, photographs.targets, strict=True)
    without = [(name, targets) for name, targets in found if not (targets.code >= 0).any()]
    dots = {name: int((targets.rejected_flag == Flag.NOT_ON_PLATE.value).sum()) for name, targets in without}
    strange = [name for name in dots if dots[name] >= MIN_DOTS]
    missing = [name for name in dots if dots[name] < MIN_DOTS]
    size = f"{family.rows} x {family.columns}"
    kind = "board_not_found" if family.name in BOARDS else "plate_not_found"
    remarks = [remark(kind, photographs=missing, size=size)] if missing else []
    if strange:
        many = round(statistics.median(dots[name] for name in strange))
        remarks.append(remark("plate_not_recognised", photographs=strange, dots=many, size=size))
    return tuple(remarks)
