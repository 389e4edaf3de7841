"""Remarks where too few codes were read: candidates found, and settings that read more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.conventions import AnyArray
from sfm.display import agreeing, counted, listed
from sfm.orientation.incremental.sequence import MIN_POINTS
from sfm.photographs.reading import read_photograph
from sfm.remarks.remark import Remark, remark
from sfm.survey.diagnosis.missing_plates import missing_plates
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.survey.inputs.survey import Survey
from sfm.targets.codes.families import Family
from sfm.targets.codes.rings import RINGS
from sfm.targets.codes.tags import CORNERS, DICTIONARIES, find_tags, tag_family
from sfm.targets.detect import Targets, find_targets
from sfm.targets.flags import Flag
from sfm.targets.outlines import scale_of

MIN_TAGS = 2  # of a family in a photograph that are no chance; a dictionary may be part of a larger one
# Least diameter of the dot of a ring that is read, px and standard deviations of its edges (rendered rings of
# 12 to 20 cells: all of 49 are read from 6 px on at 0.75 px, from 8 or 9 px on at 1.25 px).
MIN_DOT_PX, MIN_DOT_SIGMAS = 6.0, 7.0
POLARITIES = ("dark", "bright")


def words_of_codes(survey: Survey, photographs: MeasuredPhotographs) -> str:
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
        f"{_words_of_size(survey, photographs)}{_other_settings(survey, photographs)}"
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


def _words_of_size(survey: Survey, photographs: MeasuredPhotographs) -> str:
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
