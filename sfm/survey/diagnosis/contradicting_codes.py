"""Codes read at several positions of the object: photographs of another object, or single moved targets.

If two objects carry the same sheet of codes, it orients the photographs of both. Every other code that the
two have in common is then at two positions. Photographs are grouped by the positions at which they show these
contested codes. Photographs that disagree with the largest group are removed. Codes that are still contested
are reported.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from sfm.model.remarks.remark import Remark, remark
from sfm.survey.inputs.measurements import MeasuredPhotographs, Naming
from sfm.survey.target_network import UNNAMED
from sfm.targets.codes.plates import PlateFamily, TargetFamily, plates_of
from sfm.targets.codes.tags import CORNERS

MIN_ELSEWHERE = 3  # contradicting codes that show another object; one or two are moved or misread
SHARE_ELSEWHERE = 0.1  # the same as a share of the codes that the photograph shows


@dataclass(frozen=True)
class ContestedCodes:
    """Codes that photographs show at different positions."""

    places: dict[int, dict[int, frozenset[int]]]
    """points at which each contested code is read, by code and photograph; UNNAMED if no ray meets its ray"""
    left_out: dict[int, Remark]
    """photographs that show another object, with the reason"""
    main: dict[int, int]
    """point at which the largest group shows a code, by code; missing if the group does not show it"""
    elsewhere: dict[int, frozenset[int]]
    """codes that a photograph shows at other points than the largest group, by photograph"""


def find_contested_codes(
    photographs: MeasuredPhotographs, naming: Naming, family: TargetFamily | None
) -> ContestedCodes:
    """Return the codes that are read at several positions, and the photographs that show another object.

    Args:
        photographs: all measured targets.
        naming: point of each target in the adjusted network.
        family: codes of the survey; points of a plate have no codes, but are named like them.
    """
    by_code, shown = _points_by_code(photographs, naming)
    contested = {code: places for code, places in by_code.items() if _is_contested(code, places, naming)}
    groups = _groups(contested)
    largest = groups[0] if groups else frozenset()
    accepted = _points_of_group(contested, largest)
    elsewhere: dict[int, set[int]] = {}
    for code, places in contested.items():
        for image, at in places.items():
            if accepted[code] and not at & accepted[code]:
                elsewhere.setdefault(image, set()).add(_number(code, naming))
    foreign = {
        image: codes
        for image, codes in elsewhere.items()
        if len(codes) >= max(MIN_ELSEWHERE, SHARE_ELSEWHERE * shown[image])
    }
    left_out = {}
    for image, codes in foreign.items():
        group = next(group for group in groups if image in group)
        others = [photographs.names[k] for k in sorted(group & foreign.keys() - {image})]
        if plates_of(family):  # perhaps another part of a plate
            reason = remark(
                "plate_points_apart", points=list(map(str, sorted(codes))), agreeing=others or None
            )
        else:
            reason = remark(
                "photograph_of_second_object", codes=list(map(str, sorted(codes))), agreeing=others or None
            )
        left_out[image] = reason
    main = {}
    for code, places in contested.items():
        times = Counter(k for image, at in places.items() if image in largest for k in at if k != UNNAMED)
        if times:
            main[code] = min((-count, k) for k, count in times.items())[1]
    away = {image: frozenset(codes) for image, codes in elsewhere.items()}
    return ContestedCodes(contested, left_out, main, away)


def plates_elsewhere(
    contested: ContestedCodes, photographs: MeasuredPhotographs, family: TargetFamily | None
) -> dict[PlateFamily, frozenset[int]]:
    """Return plates that were moved relative to the others, with the photographs that show them elsewhere.

    A photograph shows a plate elsewhere if it shows most of the plate's points elsewhere.

    Args:
        contested: codes that are read at several positions.
        photographs: all measured targets.
        family: codes of the survey.
    """
    moved: dict[PlateFamily, frozenset[int]] = {}
    plates = plates_of(family)
    for plate in plates if len(plates) > 1 else ():
        of_plate = _points_of(plate)
        images = frozenset(
            image
            for image, codes in contested.elsewhere.items()
            if 2 * len(codes.intersection(of_plate))
            > np.isin(photographs.targets[image].code, of_plate).sum()
        )
        if images:
            moved[plate] = images
    return moved


def remarks_on_contested(
    contested: ContestedCodes,
    photographs: MeasuredPhotographs,
    naming: Naming,
    moved: Mapping[PlateFamily, frozenset[int]],
    family: TargetFamily | None,
) -> tuple[Remark, ...]:
    """Return the remarks on plates that moved or do not fit, and on other codes at several positions."""

    def names_of(images: Collection[int]) -> list[str]:
        return [photographs.names[i] for i in sorted(images)]

    remarks = []
    of_moved: set[int] = set()
    for plate, images in moved.items():
        points_of_plate = _points_of(plate)
        of_moved.update(points_of_plate)
        remarks.append(
            remark("plate_elsewhere", photographs=names_of(images), points=list(map(str, points_of_plate)))
        )
    of_plates = set[int]().union(*map(_points_of, plates_of(family)))
    apart = sorted((contested.places.keys() & of_plates) - of_moved)
    if apart:
        showing = set[int]().union(*(contested.places[code] for code in apart))
        remarks.append(
            remark("plate_points_apart", points=list(map(str, apart)), photographs=names_of(showing))
        )
    codes = sorted(contested.places.keys() - of_plates)
    away: set[int] = set()
    points: set[str] = set()
    for code in codes:
        places, main = contested.places[code], contested.main.get(code, UNNAMED)
        elsewhere = {image for image, at in places.items() if main not in at or len(at) > 1}
        away |= elsewhere or places.keys()
        if main != UNNAMED:
            points |= {naming.names[k] for i in elsewhere for k in places[i] if k not in (main, UNNAMED)}
    if codes:
        remarks.append(
            remark(
                "codes_at_several_places",
                codes=[str(_number(code, naming)) for code in codes],
                photographs=names_of(away),
                points=sorted(points) or None,
            )
        )
    return tuple(remarks)


def _points_of(plate: PlateFamily) -> range:
    return range(plate.first_point, plate.last_point + 1)


def _points_by_code(
    photographs: MeasuredPhotographs, naming: Naming
) -> tuple[dict[int, dict[int, frozenset[int]]], Counter[int]]:
    """Return the points of each code, by code and photograph, and the number of codes of each photograph."""
    by_code: dict[int, dict[int, frozenset[int]]] = {}
    shown: Counter[int] = Counter()
    for image, (targets, point) in enumerate(zip(photographs.targets, naming.point, strict=True)):
        if not (point != UNNAMED).any():
            continue  # not oriented
        coded = targets.code >= 0
        numbers = {_number(code, naming) for code in targets.code[coded].tolist()}
        shown[image] = len(numbers)
        for code, place in zip(targets.code[coded].tolist(), point[coded].tolist(), strict=True):
            before = by_code.setdefault(code, {}).get(image, frozenset())
            by_code[code][image] = before | {place}
    return by_code, shown


def _is_contested(code: int, places: dict[int, frozenset[int]], naming: Naming) -> bool:
    """Return whether several photographs show a code, but not all at the point of its name."""
    every = frozenset[int]().union(*places.values())
    return len(places) > 1 and {int(naming.code[k]) if k != UNNAMED else UNNAMED for k in every} != {code}


def _groups(contested: dict[int, dict[int, frozenset[int]]]) -> list[frozenset[int]]:
    """Group the photographs that agree on the positions of the contested codes, the largest group first.

    Within a group a code may have several positions, for example if a photograph shows two targets of one
    number. A photograph joins a group if it agrees on more codes than it contradicts.
    """
    of_image: dict[int, dict[int, frozenset[int]]] = {}
    for code, places in contested.items():
        for image, at in places.items():
            of_image.setdefault(image, {})[code] = at
    left = set(of_image)
    groups = []
    while left:
        seed = max(left, key=lambda image: (len(of_image[image]), -image))
        group = frozenset({seed})
        for _ in left:
            accepted = _points_of_group(contested, group)
            agreeing = {seed}
            for image in left:
                same = sum(bool(at & accepted[code]) for code, at in of_image[image].items())
                against = sum(
                    bool(accepted[code]) and not at & accepted[code] for code, at in of_image[image].items()
                )
                if same > against:
                    agreeing.add(image)
            if agreeing == group:
                break
            group = frozenset(agreeing)
        groups.append(group)
        left -= group
    return sorted(groups, key=lambda group: (-len(group), min(group)))


def _points_of_group(
    contested: dict[int, dict[int, frozenset[int]]], group: frozenset[int]
) -> dict[int, frozenset[int]]:
    """Return the points at which the photographs of a group show each contested code."""
    return {
        code: frozenset[int]().union(*(at for image, at in places.items() if image in group)) - {UNNAMED}
        for code, places in contested.items()
    }


def _number(code: int, naming: Naming) -> int:
    """Return the number of a code, or the tag of a corner."""
    return code // len(CORNERS) if naming.corners else code
