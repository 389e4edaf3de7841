"""The code families by name: what a survey file, a sheet or `find_targets` can ask for.

A family of rings with a table in a file needs that file only. One that follows the rule of
`ring_patterns` is a row in `rings.RINGS`, one of all necklaces in `rings.NECKLACES`, a dictionary of square
tags a row in `tags.DICTIONARIES`, concentric rings a row in `concentric.WIDTHS`. Another kind of code is a
module beside these with a type for its families, a row below, and its reading in `sfm.targets.detect`, behind
that of rings (numbers for measured dots) or of tags (points that it defines).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

from sfm.errors import SurveyFileError
from sfm.targets.codes.concentric import WIDTHS, ConcentricFamily, concentric_family
from sfm.targets.codes.plates import PLATES, PlateFamily, PlateGroup
from sfm.targets.codes.rings import RING_NAMES, CodeFamily, read_code_table, ring_family
from sfm.targets.codes.tags import DICTIONARIES, TagFamily, tag_family

Family = CodeFamily | TagFamily | ConcentricFamily
TargetFamily = Family | PlateFamily | PlateGroup  # a plate has no name that describes all of it
FAMILIES: dict[str, Callable[[], Family | None]] = {
    **{name: partial(ring_family, name) for name in RING_NAMES},
    "none": lambda: None,
    **{name: partial(tag_family, name) for name in DICTIONARIES},
    **{name: partial(concentric_family, name) for name in WIDTHS},
}


def is_table(codes: str) -> bool:
    """Return whether what a survey states as its codes is the path of a table and no name."""
    return codes not in FAMILIES and codes not in PLATES


def code_family(codes: str | Family) -> Family | None:
    """Return the code family of a name or of a table file; None for "none".

    Args:
        codes: a name in FAMILIES, the path of a table file, or a family, which is returned as it is.

    Returns:
        The family, or None where targets are not coded.

    Raises:
        SurveyFileError: neither a known family nor a readable table.
    """
    if not isinstance(codes, str):
        return codes
    if codes in PLATES:
        raise SurveyFileError(f"codes {codes!r}, a plate with its rows and columns is needed (PlateFamily)")
    if codes in FAMILIES:
        return FAMILIES[codes]()
    if not os.path.exists(codes):
        raise SurveyFileError(f"codes: {codes!r} is neither one of {', '.join(FAMILIES)} nor a table file")
    return read_code_table(Path(codes))
