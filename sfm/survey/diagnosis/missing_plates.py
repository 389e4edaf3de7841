"""Calibration plates that photographs do not show, or only in part, or that are not in the result."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import cv2
import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.orientation.homography import PLANAR_POINTS
from sfm.remarks.remark import Remark, remark
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.targets.codes.dot_plates import MIN_DOTS
from sfm.targets.codes.families import TargetFamily
from sfm.targets.codes.plates import PlateFamily, plates_of, points_of_plates
from sfm.targets.flags import Flag

MIN_VIEWS = 2  # photographs that show the place of a side of a plate that none of them has
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


def sides_not_found(family: TargetFamily | None, photographs: MeasuredPhotographs) -> tuple[Remark, ...]:
    """Return the remarks on outer rows and columns of plates that no photograph shows where they should be.

    They are not on the plate, as with tags that are numbered from another one, or hidden. The place is that
    by the homography from the points of the plate that are seen.

    Args:
        family: codes of the survey.
        photographs: with the points of the plate as their codes.
    """
    remarks = []
    for plate in plates_of(family):
        codes = [targets.code - plate.first_point for targets in photographs.targets]
        on = [(code >= 0) & (code < plate.count) for code in codes]
        seen = np.zeros(plate.count, dtype=bool)
        for code, some in zip(codes, on, strict=True):
            seen[code[some]] = True
        lost = _missing_sides(plate, seen)
        views = dict.fromkeys(lost, 0)
        for k, (code, some) in enumerate(zip(codes, on, strict=True)):
            size = photographs.cameras[photographs.camera[k]].size_px
            for side in _in_view(plate, lost, code[some], photographs.targets[k].xy[some], size):
                views[side] += 1
        sides = [side for side, count in views.items() if count >= MIN_VIEWS]
        if sides:
            count = max(views[side] for side in sides)
            size = f"{plate.rows} x {plate.columns}"
            remarks.append(
                remark("plate_side_not_found", sides=sides, codes=plate.name, size=size, views=count)
            )
    return tuple(remarks)


class _Line(NamedTuple):
    """A row or column of a plate that is not seen, beside one that is."""

    outer: IntArray  # its points
    beside: IntArray  # those of the one that is seen


def _missing_sides(plate: PlateFamily, seen: BoolArray) -> dict[str, _Line]:
    """Return the outer rows and columns of which no point is seen, (n,), the innermost of each side."""
    step = 2 if plate.name == "aprilgrid" else 1  # lines of corners that a tag has
    number = np.arange(plate.count).reshape(plate.rows, plate.columns)
    found = {}
    for name, lines in (("row", number), ("column", number.T)):
        for end, inwards in (("first", lines), ("last", lines[::-1])):
            count = int(seen[inwards].any(axis=1).argmax())
            if count >= step:
                side = f"{end} {name}" if count == 1 else f"{end} {count} {name}s"
                found[side] = _Line(inwards[count - step], inwards[count])
    return found


def _in_view(
    plate: PlateFamily, sides: Mapping[str, _Line], code: IntArray, xy: FloatArray, size_px: tuple[int, int]
) -> Iterator[str]:
    """Yield the sides whose place is in a photograph, and half of whose neighbours were found in it."""
    if len(code) < PLANAR_POINTS or not sides:
        return
    plane = plate.plane(1.0)[:, :2]
    H, _ = cv2.findHomography(plane[code], xy, 0)
    if H is None:
        return
    for side, (outer, beside) in sides.items():
        found = np.isin(beside, code)
        beyond = 2 * plane[outer] - plane[beside]  # with the margin of the plate
        at = cv2.perspectiveTransform(np.concatenate([plane[outer], beyond])[None], H)[0]
        inside = ((at >= 0) & (at < size_px)).all(axis=1).reshape(2, -1).all(axis=0)
        if 2 * (found & inside).sum() >= len(outer):
            yield side


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
