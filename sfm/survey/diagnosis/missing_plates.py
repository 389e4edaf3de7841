"""Photographs in which the calibration plate of a survey was not found, and what a person can do."""

from __future__ import annotations

from sfm.remarks.remark import Remark, remark
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.targets.codes.families import TargetFamily
from sfm.targets.codes.plates import PlateFamily


def missing_plates(family: TargetFamily | None, photographs: MeasuredPhotographs) -> tuple[Remark, ...]:
    """Return the remark on the photographs in which a plate was not found; none where it is in all.

    Args:
        family: codes of the survey.
        photographs: with the points of the plate as their codes.
    """
    if not isinstance(family, PlateFamily):
        return ()
    found = zip(photographs.names, photographs.targets, strict=True)
    without = [name for name, targets in found if not (targets.code >= 0).any()]
    kind = "board_not_found" if family.name in ("charuco", "checkerboard") else "plate_not_found"
    size = f"{family.rows} x {family.columns}"
    return (remark(kind, photographs=without, size=size),) if without else ()
