"""Codes and calibration plates that photographs do not show, or only in part.

Too few codes were read: candidates that were found, and settings that read more. A plate was not found, a
side of it is in no photograph, or none of its points is in the result.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.display import agreeing, counted, listed
from sfm.orientation.image_rays import PLANAR_POINTS
from sfm.orientation.incremental.sequence import MIN_POINTS
from sfm.photographs.reading import read_photograph
from sfm.remarks.remark import Remark, remark
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.survey.inputs.survey import Survey
from sfm.targets.codes.dot_plates import MIN_DOTS
from sfm.targets.codes.plates import Family, PlateFamily, TargetFamily, plates_of, points_of_plates
from sfm.targets.codes.rings import RINGS
from sfm.targets.codes.tags import CORNERS, DICTIONARIES, find_tags, tag_family
from sfm.targets.detect import Targets, find_targets
from sfm.targets.outlines import Flag, scale_of

MIN_VIEWS = 2  # photographs that show the place of a side of a plate that none of them has
NOT_FOUND = {  # kinds of remarks by the codes of a board; that on dots of any grid is another
    "checkerboard": "checkerboard_not_found",
    "charuco": "charuco_not_found",
    "aprilgrid": "aprilgrid_not_found",
}
MIN_TAGS = 2  # of a family in a photograph that are no chance; a dictionary may be part of a larger one
# Least diameter of the dot of a ring that is read, px and standard deviations of its edges (rendered rings of
# 12 to 20 cells: all of 49 are read from 6 px on at 0.75 px, from 8 or 9 px on at 1.25 px).
MIN_DOT_PX, MIN_DOT_SIGMAS = 6.0, 7.0
POLARITIES = ("dark", "bright")


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


def describe_codes(survey: Survey, photographs: MeasuredPhotographs) -> str:
    """Say how many targets and codes were found where more codes were needed, and what decides on that."""
    if plates := missing_plates(survey.family, photographs):
        return _in_error(*plates)
    targets = [len(found) for found in photographs.targets]
    codes = [int((found.code >= 0).sum()) for found in photographs.targets]
    with_codes = sum(count > 0 for count in codes)
    settings = survey.targets
    return (
        f"no two photographs have {MIN_POINTS} coded targets in common, which their orientation needs: "
        f"{counted(sum(targets), 'target')} found in {counted(len(targets), 'photograph')}, "
        f"{counted(sum(codes), 'code')} read in "
        f"{with_codes} of them{_by_photograph(photographs, codes)}; check in [targets] "
        f"codes = '{settings.codes}', "
        f"polarity = '{settings.polarity}' and min_diameter_px = {settings.min_diameter_px:g}"
        f"{_describe_size(survey, photographs)}{_other_settings(survey, photographs)}"
    )


def small_codes(targets: Sequence[Targets]) -> tuple[Remark, ...]:
    """Return the remark that codes are too small to read, with the size that would do.

    None where enough are read.

    Args:
        targets: of each photograph.
    """
    every = [found for found in targets if len(found)]
    if not every:
        return ()
    unreadable = np.concatenate([(found.flag & Flag.CODE_UNREADABLE) != 0 for found in every])
    diameter = 2 * np.concatenate([found.semi_axes[:, 1] for found in every])
    blur = np.concatenate([found.blur for found in every])
    coded = sum(int((found.code >= 0).sum()) for found in every)
    small = unreadable & (diameter < np.maximum(MIN_DOT_PX, MIN_DOT_SIGMAS * blur))
    if small.sum() < max(MIN_POINTS, coded):
        return ()
    now, soft = float(np.median(diameter[small])), float(np.median(blur[small]))
    needed = max(MIN_DOT_PX, MIN_DOT_SIGMAS * soft)
    return (
        remark(
            "codes_too_small",
            targets=int(small.sum()),
            dot=(now, "px"),
            blur=(soft, "px"),
            needed=(needed, "px"),
        ),
    )


def _in_error(one: Remark) -> str:
    """Return a remark as a part of the message of an error."""
    return f"{one.text.rstrip('.')}: {one.remedy.rstrip('.')}"


def _describe_size(survey: Survey, photographs: MeasuredPhotographs) -> str:
    """Say that codes are too small to read, or that candidates are below the least diameter, if so."""
    if small := small_codes(photographs.targets):
        return f"; {_in_error(*small)}"
    count = sum(int((found.rejected_flag == Flag.TOO_SMALL).sum()) for found in photographs.targets)
    if count < MIN_POINTS * len(photographs.targets):
        return ""
    return (
        f"; {counted(count, 'candidate')} {agreeing(count, 'is|are')} smaller than min_diameter_px = "
        f"{survey.targets.min_diameter_px:g}; codes "
        f"are read from dots of {MIN_DOT_PX:g} px on in sharp photographs"
    )


def _by_photograph(photographs: MeasuredPhotographs, codes: list[int]) -> str:
    """Say how many codes were read in each of the first photographs, if any were."""
    if not any(codes):
        return ""
    shown = (f"{name}: {count}" for name, count in zip(photographs.names, codes, strict=True))
    return f" ({listed(shown, most=10)})"


def _other_settings(survey: Survey, photographs: MeasuredPhotographs) -> str:
    """Say which other rings or arcs, or which polarity, read more codes, if any do.

    In the photograph with most codes, or, where none has any, with most targets.
    """
    settings = survey.targets
    read = [len(np.unique(found.code[found.code >= 0])) for found in photographs.targets]
    order = [(count, len(found)) for count, found in zip(read, photographs.targets, strict=True)]
    fullest = max(range(len(order)), key=order.__getitem__)
    photograph = read_photograph(photographs.paths[fullest], channel=settings.channel)
    known = settings.codes in (*RINGS, "none")
    families = RINGS if known else ()
    polarities = [one for one in POLARITIES if settings.polarity in (one, "auto")]
    others = [one for one in POLARITIES if one not in polarities]
    tried: list[tuple[str | Family | None, str]]
    tried = [(family, settings.polarity) for family in families if family != settings.codes]
    tried += [
        (family, polarity)
        for polarity in others
        for family in dict.fromkeys((survey.family if not known else settings.codes, *families))
        if family != "none"
    ]
    best, words = read[fullest], ""
    for family, polarity in tried:
        found = find_targets(
            photograph,
            polarity=polarity,
            codes=family if family is not None else "none",
            min_diameter_px=settings.min_diameter_px,
        )
        count = len(np.unique(found.code[found.code >= 0]))
        if count >= MIN_POINTS and count > best:
            best, differ = count, []
            if polarity != settings.polarity:
                differ.append(f"polarity = '{polarity}'")
            if family != settings.codes and isinstance(family, str):
                differ.append(f"codes = '{family}'")
            words = f"; in {photographs.names[fullest]} {' and '.join(differ)} reads {counted(count, 'code')}"
    return words or _tags(photograph, photographs.names[fullest], settings.codes)


def _tags(photograph: AnyArray, name: str, codes: str) -> str:
    """Say which family of square tags a photograph shows, if any."""
    best, words = MIN_TAGS - 1, ""
    for family in DICTIONARIES:
        if family == codes:
            continue
        tags = find_tags(photograph, tag_family(family), polarity="auto", scale=scale_of(photograph))
        count = len(np.unique(tags.code // len(CORNERS)))
        if count > best:
            best, words = count, f"; {name} shows {count} square tags: codes = '{family}' reads them"
    return words
