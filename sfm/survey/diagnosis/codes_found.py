"""Codes and calibration plates that photographs do not show, or show only in part.

If too few codes were read, this module lists the candidates found and settings that read more codes. It
reports plates that were not found, sides of a plate that no photograph shows, and plates without points in
the result.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.model.display import agreeing, counted, listed
from sfm.model.errors import PhotographError
from sfm.model.remarks.remark import Remark, remark
from sfm.orientation.image_rays import PLANAR_POINTS
from sfm.orientation.incremental.sequence import MIN_POINTS
from sfm.photographs.reading import read_photograph
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.survey.inputs.survey import Survey
from sfm.targets.codes.dot_plates import MIN_DOTS
from sfm.targets.codes.plate_search import part_of_checkerboard
from sfm.targets.codes.plates import Family, PlateFamily, TargetFamily, plates_of, points_of_plates
from sfm.targets.codes.rings import RINGS
from sfm.targets.codes.tags import CORNERS, DICTIONARIES, find_tags, tag_family
from sfm.targets.detect import Targets, find_targets
from sfm.targets.outlines import Flag, as_bytes, scale_of

MIN_VIEWS = 2  # photographs that show where a missing side of a plate should be
MIN_TAGS = (
    2  # of a family in a photograph that are not read by chance; a dictionary may be part of a larger one
)
# Smallest readable diameter of the dot of a ring, in px and in standard deviations of its edges. Of rendered
# rings with 12 to 20 cells, all 49 are read from 6 px on at 0.75 px, and from 8 or 9 px on at 1.25 px.
MIN_DOT_PX, MIN_DOT_SIGMAS = 6.0, 7.0
POLARITIES = ("dark", "bright")


def missing_plates(family: TargetFamily | None, photographs: MeasuredPhotographs) -> tuple[Remark, ...]:
    """Return the remarks on photographs in which a plate was not found; none if all photographs show it.

    Args:
        family: codes of the survey.
        photographs: have the points of the plate as their codes.
    """
    remarks, plates = [], plates_of(family)
    named_targets = list(zip(photographs.names, photographs.targets, strict=True))
    nothing = [(name, targets) for name, targets in named_targets if not (targets.code >= 0).any()]
    for plate in plates:
        is_seen = any(
            ((targets.code >= plate.first_point) & (targets.code <= plate.last_point)).any()
            for _, targets in named_targets
        )
        # photographs without any plate are listed with the first plate; a plate in none of them lists all
        without = (nothing if plate is plates[0] else []) if is_seen else named_targets
        dots = {
            name: int((targets.rejected_flag == Flag.NOT_ON_PLATE.value).sum()) for name, targets in without
        }
        strange = [name for name in dots if dots[name] >= MIN_DOTS]
        missing = [name for name in dots if dots[name] < MIN_DOTS]
        size = f"{plate.rows} x {plate.columns}"
        if plate.name == "checkerboard":
            path_of = dict(zip(photographs.names, photographs.paths, strict=True))
            for other, showing in _other_boards({name: path_of[name] for name in missing}, plate).items():
                missing = [name for name in missing if name not in showing]
                remarks.append(
                    remark("plate_not_found", plate=plate.name, photographs=showing, size=size, other=other)
                )
        if missing:
            kind = "board_not_found" if plate.dictionary else "plate_not_found"
            remarks.append(remark(kind, plate=plate.name, photographs=missing, size=size))
        if strange:
            many = round(statistics.median(dots[name] for name in strange))
            remarks.append(
                remark("plate_not_found", plate=plate.name, photographs=strange, dots=many, size=size)
            )
    return tuple(remarks)


def _other_boards(paths: dict[str, Path], plate: PlateFamily) -> dict[str, list[str]]:
    """Return the sizes of other whole checkerboards, and the photographs that show them."""
    showing: dict[str, list[str]] = {}
    for name, path in paths.items():
        try:
            photograph = read_photograph(path)
        except (PhotographError, OSError):
            continue  # it was there when it was measured
        part = part_of_checkerboard(as_bytes(photograph, scale_of(photograph)))
        if part is not None and not any(part[1]) and sorted(part[0]) != sorted((plate.rows, plate.columns)):
            showing.setdefault(f"{min(part[0])} x {max(part[0])}", []).append(name)
    return showing


def sides_not_found(family: TargetFamily | None, photographs: MeasuredPhotographs) -> tuple[Remark, ...]:
    """Return the remarks on outer rows and columns of plates that no photograph shows where they should be.

    They are either hidden or not on the plate, for example if the numbers of its tags start at another tag. A
    homography from the seen points of the plate predicts their position.

    Args:
        family: codes of the survey.
        photographs: have the points of the plate as their codes.
    """
    remarks = []
    for plate in plates_of(family):
        codes = [targets.code - plate.first_point for targets in photographs.targets]
        on = [(code >= 0) & (code < plate.count) for code in codes]
        seen = np.zeros(plate.count, dtype=bool)
        for code, on_plate in zip(codes, on, strict=True):
            seen[code[on_plate]] = True
        step = 2 if plate.name == "aprilgrid" else 1  # rows of corners of a tag
        number = np.arange(plate.count).reshape(plate.rows, plate.columns)
        lost = {}  # the innermost of the outer rows and columns of each side without any seen point
        for name, lines in (("row", number), ("column", number.T)):
            for end, inwards in (("first", lines), ("last", lines[::-1])):
                count = int(seen[inwards].any(axis=1).argmax())
                if count >= step:
                    side = f"{end} {name}" if count == 1 else f"{end} {count} {name}s"
                    lost[side] = _Line(inwards[count - step], inwards[count])
        views = dict.fromkeys(lost, 0)
        for k, (code, on_plate) in enumerate(zip(codes, on, strict=True)):
            size = photographs.cameras[photographs.camera[k]].size_px
            for side in _in_view(plate, lost, code[on_plate], photographs.targets[k].xy[on_plate], size):
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
    """A row or column of a plate that is not seen, and its neighbour that is seen."""

    outer: IntArray  # points of the missing line
    neighbour: IntArray  # points of its neighbour


def _in_view(
    plate: PlateFamily, sides: Mapping[str, _Line], code: IntArray, xy: FloatArray, size_px: tuple[int, int]
) -> Iterator[str]:
    """Yield the sides whose position is inside a photograph that shows half of their neighbours."""
    if len(code) < PLANAR_POINTS or not sides:
        return
    plane = plate.plane(1.0)[:, :2]
    H, _ = cv2.findHomography(plane[code], xy, 0)
    if H is None:
        return
    for side, (outer, neighbour) in sides.items():
        is_seen = np.isin(neighbour, code)
        beyond = 2 * plane[outer] - plane[neighbour]  # the margin of the plate
        at = cv2.perspectiveTransform(np.concatenate([plane[outer], beyond])[None], H)[0]
        inside = ((at >= 0) & (at < size_px)).all(axis=1).reshape(2, -1).all(axis=0)
        if 2 * (is_seen & inside).sum() >= len(outer):
            yield side


def plates_not_in_result(family: TargetFamily | None, code: IntArray) -> tuple[Remark, ...]:
    """Return the remarks on plates without any point in the result.

    Args:
        family: codes of the survey.
        code: code of each point of the result, -1 without a code, (n,).
    """
    return tuple(
        remark("plate_not_in_result", codes=plate.name, size=f"{plate.rows} x {plate.columns}")
        for plate, points in zip(plates_of(family), points_of_plates(family, code), strict=True)
        if not len(points)
    )


def describe_codes(survey: Survey, photographs: MeasuredPhotographs) -> str:
    """Describe the targets and codes found where more are needed, and the settings that matter."""
    if plates := missing_plates(survey.family, photographs):
        return _as_error_text(*plates)
    targets = [len(of_photograph) for of_photograph in photographs.targets]
    codes = [int((of_photograph.code >= 0).sum()) for of_photograph in photographs.targets]
    with_codes = sum(count > 0 for count in codes)
    settings = survey.targets
    of_each = (f"{name}: {count}" for name, count in zip(photographs.names, codes, strict=True))
    codes_read = f" ({listed(of_each, most=10)})" if with_codes else ""
    size = ""
    small = sum(int((seen.rejected_flag == Flag.TOO_SMALL).sum()) for seen in photographs.targets)
    if too_small := small_codes(photographs.targets):
        size = f"; {_as_error_text(*too_small)}"
    elif small >= MIN_POINTS * len(photographs.targets):
        size = (
            f"; {counted(small, 'candidate')} {agreeing(small, 'is|are')} smaller than min_diameter_px = "
            f"{settings.min_diameter_px:g}; codes "
            f"are read from dots of {MIN_DOT_PX:g} px on in sharp photographs"
        )
    return (
        f"no two photographs have {MIN_POINTS} coded targets in common, which their orientation needs: "
        f"{counted(sum(targets), 'target')} found in {counted(len(targets), 'photograph')}, "
        f"{counted(sum(codes), 'code')} read in "
        f"{with_codes} of them{codes_read}; check in [targets] "
        f"codes = '{settings.codes}', "
        f"polarity = '{settings.polarity}' and min_diameter_px = {settings.min_diameter_px:g}"
        f"{size}{_other_settings(survey, photographs)}"
    )


def small_codes(targets: Sequence[Targets]) -> tuple[Remark, ...]:
    """Return a remark that codes are too small to read, with the size needed; none if enough are read.

    Args:
        targets: targets of each photograph.
    """
    every = [of_photograph for of_photograph in targets if len(of_photograph)]
    if not every:
        return ()
    unreadable = np.concatenate([(of_photograph.flag & Flag.CODE_UNREADABLE) != 0 for of_photograph in every])
    diameter = 2 * np.concatenate([of_photograph.semi_axes[:, 1] for of_photograph in every])
    blur = np.concatenate([of_photograph.blur for of_photograph in every])
    coded = sum(int((of_photograph.code >= 0).sum()) for of_photograph in every)
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


def _as_error_text(said: Remark) -> str:
    """Return a remark as part of an error message."""
    return f"{said.text.rstrip('.')}: {said.remedy.rstrip('.')}"


def _other_settings(survey: Survey, photographs: MeasuredPhotographs) -> str:
    """Name the other rings or the polarity that read more codes, if any do.

    They are tried on the photograph with most codes, or if none has codes, with most targets.
    """
    settings = survey.targets
    read = [len(np.unique(targets.code[targets.code >= 0])) for targets in photographs.targets]
    order = [(count, len(targets)) for count, targets in zip(read, photographs.targets, strict=True)]
    fullest = max(range(len(order)), key=order.__getitem__)
    photograph = read_photograph(photographs.paths[fullest], channel=settings.channel)
    known = settings.codes in (*RINGS, "none")
    families = RINGS if known else ()
    polarities = [polarity for polarity in POLARITIES if settings.polarity in (polarity, "auto")]
    others = [polarity for polarity in POLARITIES if polarity not in polarities]
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
        targets = find_targets(
            photograph,
            polarity=polarity,
            codes=family if family is not None else "none",
            min_diameter_px=settings.min_diameter_px,
        )
        count = len(np.unique(targets.code[targets.code >= 0]))
        if count >= MIN_POINTS and count > best:
            best, differ = count, []
            if polarity != settings.polarity:
                differ.append(f"polarity = '{polarity}'")
            if family != settings.codes and isinstance(family, str):
                differ.append(f"codes = '{family}'")
            words = f"; in {photographs.names[fullest]} {' and '.join(differ)} reads {counted(count, 'code')}"
    return words or _tag_family_shown(photograph, photographs.names[fullest], settings.codes)


def _tag_family_shown(photograph: AnyArray, name: str, codes: str) -> str:
    """Name the family of square tags that a photograph shows, if any."""
    best, words = MIN_TAGS - 1, ""
    for family in DICTIONARIES:
        if family == codes:
            continue
        tags = find_tags(photograph, tag_family(family), polarity="auto", scale=scale_of(photograph))
        count = len(np.unique(tags.code // len(CORNERS)))
        if count > best:
            best, words = count, f"; {name} shows {count} square tags: codes = '{family}' reads them"
    return words
