"""The sources of image points that a survey may state; several may stand side by side.

A source is a row here and a module of `sfm.survey.sources` of the same name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

from sfm.model.display import counted
from sfm.model.network import Source
from sfm.survey.inputs.given_values import Observations

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

S = TypeVar("S", bound="DataclassInstance")
# Image points of a photograph. Matches of a repeated pattern are wrong together, and few of them may fit.
MIN_TIE_POINTS = 15
TARGETS = Source("targets", noun="the targets")
GIVEN = Source("given", noun="the given image points", is_exact=True, points="given")
# tracks of another program: its points are matched, and numbered anew by every run
MATCHES = replace(GIVEN, noun="the matches", names_last=False, is_matched=True)
MARKS = Source("marks", noun="the named points", is_matched=True, points="named")
TEXTURE = Source(
    "texture",
    noun="the natural texture",
    names_last=False,
    fewest=MIN_TIE_POINTS,
    has_common_errors=True,
    is_matched=True,
    points="of natural texture",
)


@dataclass(frozen=True)
class Declared:
    """A source as surveys state it."""

    source: Source
    table: str  # attribute of surveys with the settings of its table in the survey file
    section: str  # how the survey file writes this table
    describe: Callable[[Any], str]  # the settings of the table in a few words
    stage: str = ""  # stage of the pipeline that measures it in photographs; empty if nothing is measured
    is_stated: Callable[[Any], bool] = lambda settings: settings is not None
    is_alone: Callable[[Any], bool] = lambda settings: False  # whether it leaves no place for others
    is_listed: bool = False  # whether its first image points are listed in files, whose faults show at once


ROWS = (  # in the order of their points in a network; the first is that of a survey that states none
    Declared(
        TARGETS,
        "targets",
        "[targets]",
        lambda targets: f"targets of codes {targets.codes}",
        "targets",
        lambda targets: targets.codes != "none",
    ),
    Declared(
        GIVEN,
        "observations",
        "[observations]",
        lambda given: counted(sum(map(len, tables_of(given))), "image point"),
        is_stated=lambda given: bool(tables_of(given)),
        is_alone=lambda given: not isinstance(given, tuple),  # one table, in place of photographs
        is_listed=True,
    ),
    Declared(
        MARKS,
        "marks",
        "[[point]]",
        lambda marks: counted(len({mark.name for mark in marks}), "named point"),
        "named points",
        is_stated=bool,
        is_listed=True,
    ),
    Declared(TEXTURE, "tie_points", "[tie_points]", lambda _: "tie points of natural texture", "tie points"),
)


def declared(survey: Any) -> tuple[Declared, ...]:
    """Return the sources of the image points of a survey or its file."""
    stated = tuple(row for row in ROWS if row.is_stated(getattr(survey, row.table)))
    alone = tuple(row for row in stated if row.is_alone(getattr(survey, row.table)))
    without_photographs = not alone and not any(row.stage for row in stated)
    if not stated or (without_photographs and all(camera.images for camera in survey.cameras)):
        stated = (ROWS[0], *stated)  # image points beside photographs orient them for targets without codes
    return alone[:1] or stated


def stated_sources(survey: Any) -> tuple[Source, ...]:
    """Return what the adjustment must know of the sources of the image points of a survey."""
    of_matches = any(not table.names_last for table in given_tables(survey))
    return tuple(MATCHES if of_matches and row.source is GIVEN else row.source for row in declared(survey))


def tables_of(given: Any) -> tuple[Any, ...]:
    """Return the tables of given image points of a survey: those beside photographs, or the one alone."""
    if given is None:
        return ()
    return given if isinstance(given, tuple) else (given,)


def given_tables(survey: object) -> tuple[Observations, ...]:
    """Return all tables of image points that a survey gives."""
    return tuple(table for tables in _given_by_field(survey).values() for table in tables)


def with_each_table(survey: S, change: Callable[[Observations], Observations]) -> S:
    """Return a survey whose tables of image points are changed, each by itself."""
    changed = {name: tuple(map(change, tables)) for name, tables in _given_by_field(survey).items()}
    values: dict[str, Any] = {
        name: tables if isinstance(getattr(survey, name), tuple) else tables[0]
        for name, tables in changed.items()
    }
    return replace(survey, **values) if values else survey


def _given_by_field(survey: object) -> dict[str, tuple[Observations, ...]]:
    """Return the tables of image points of a survey by its fields, which have one or several."""
    stated = {row.table: tables_of(getattr(survey, row.table)) for row in ROWS}
    return {
        name: tables
        for name, tables in stated.items()
        if tables and all(isinstance(table, Observations) for table in tables)
    }


def descriptions(survey: object) -> list[str]:
    """Return the sources of a survey in a few words each."""
    return [row.describe(getattr(survey, row.table)) for row in declared(survey)]


def reads_photographs(survey: object) -> bool:
    """Return whether a survey measures photographs, or has given image points alone."""
    return any(row.stage for row in declared(survey))
