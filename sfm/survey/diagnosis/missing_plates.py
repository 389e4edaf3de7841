"""Photographs in which the calibration plate of a survey was not found, and what a person can do."""

from __future__ import annotations

from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.targets.codes.families import TargetFamily
from sfm.targets.codes.plates import PlateFamily

MAX_NAMES = 5  # photographs in a line


def words_of_missing_plates(family: TargetFamily | None, photographs: MeasuredPhotographs) -> str:
    """Say in which photographs a plate was not found, and why that may be; empty where it is in all.

    Args:
        family: codes of the survey.
        photographs: with the points of the plate as their codes.
    """
    if not isinstance(family, PlateFamily):
        return ""
    found = zip(photographs.names, photographs.targets, strict=True)
    without = [name for name, targets in found if not (targets.code >= 0).any()]
    if not without:
        return ""
    shown = ", ".join(without[:MAX_NAMES]) + (
        f" and {len(without) - MAX_NAMES} more" * (len(without) > MAX_NAMES)
    )
    size = f"{family.rows} x {family.columns}"
    if family.name == "charuco":
        why = f"none of its {size} crossings was found: another dictionary, tag_size, rows or columns?"
    elif family.name == "checkerboard":
        why = f"all of its {size} crossings (not squares) must be seen, with a white rim around the board"
    elif family.marks:
        dots = sorted(targets.rejected_xy.shape[0] + len(targets) for targets in photographs.targets)
        why = (
            f"its marks must be seen, and nothing among the {size} dots may look like another mark "
            f"({dots[len(dots) // 2]} candidates in a photograph, median)"
        )
    else:
        why = f"all of its {size} dots must be seen, as it has no marks"
    return f"the calibration plate was not found in {len(without)} photograph(s), {shown}: {why}"
