"""Survey observations beside photographs: distances, levelling, angles, antenna positions, from tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.display import listed
from sfm.errors import SurveyFileError
from sfm.files.csv_tables import CsvTable, read_table
from sfm.network import Network
from sfm.observations import TABLES
from sfm.observations.groups import Group
from sfm.observations.kind import TableKind
from sfm.remarks.remark import Remark, remark

if TYPE_CHECKING:
    from sfm.survey.inputs.survey import Survey


@dataclass(frozen=True)
class ObservationTable:
    """A table of observations of one kind."""

    kind: str  # as in the survey file
    value: FloatArray  # values without and with standard deviation, object unit or rad, (n, q + d)
    sigma: FloatArray  # object unit or rad, (n, d)
    table: CsvTable  # with the names of points or photographs

    @property
    def of(self) -> type[TableKind]:
        """The kind of observation."""
        return TABLES[self.kind]

    def name(self, row: int) -> str:
        """Return what an observation is called: "distance 12 - 15"."""
        return f"{self.kind} {' - '.join(column[row] for column in self.table.texts)}"


def read_observation_table(kind: str, path: Path, source: str) -> ObservationTable:
    """Read a table of observations: names, values, standard deviations.

    Args:
        kind: as in the survey file.
        path: the table.
        source: the survey file, for messages.

    Raises:
        SurveyFileError: an unknown kind, an unreadable table, wrong columns, or a standard deviation that is
            not positive; an observation between a point and itself.
    """
    if kind not in TABLES:
        raise SurveyFileError(f"{source}: kind = '{kind}', needed one of {listed(list(TABLES))}")
    of = TABLES[kind]
    columns = of.columns()
    table = read_table(path, of.texts, columns)
    d = min(len(of.components), len(columns))  # of lines one standard deviation for both offsets
    sigma = table.values[:, -d:]
    table.refuse(sigma, ~(sigma > 0), columns[-d:], "more than 0, the standard deviation")
    if len(of.texts) > 1:
        for row, names in enumerate(zip(*table.texts, strict=True)):
            if len(set(names)) < len(names):
                raise SurveyFileError(
                    f"{table.place(row)}: {kind} from {names[0]} to itself, needed two points"
                )
    unit = np.pi / 180 if of.in_degrees else 1.0
    value = table.values[:, :-d].copy()
    value[:, len(of.numbers) :] *= unit
    return ObservationTable(kind, value, unit * sigma, table)


def with_tables(survey: Survey, network: Network) -> Network:
    """Return the network with the observations of a survey's tables whose points or photographs it has."""
    added = []
    for one in survey.tables:
        known = np.logical_and.reduce(_known(one, network))
        if not known.any():
            continue
        rows = np.flatnonzero(known)
        number = {name: k for k, name in enumerate(_names(one, network))}
        if issubclass(one.of, Group):
            added += _groups(one, rows, number)
            continue
        indices = tuple(
            np.array([number[column[row]] for row in rows], dtype=np.int64) for column in one.table.texts
        )
        added.append(one.of.of_table(indices, one.value[rows], one.sigma[rows]))
    return replace(network, observations=(*network.observations, *added)) if added else network


def _groups(one: ObservationTable, rows: IntArray, number: Mapping[str, int]) -> list[TableKind]:
    """Return the groups of a table that have enough points in a network, of rows with a point in it."""
    names, points = one.table.texts
    found: list[TableKind] = []
    for name in dict.fromkeys(names[row] for row in rows):
        own = np.array([row for row in rows if names[row] == name], dtype=np.int64)
        point = np.array([number[points[row]] for row in own], dtype=np.int64)
        assert issubclass(one.of, Group)
        group = one.of.of_group(name, point, one.value[own], one.sigma[own], number)
        if len(group):
            found.append(group)
    return found


def unused_observations(survey: Survey, network: Network) -> tuple[Remark, ...]:
    """Return the remark on observations whose points or photographs are not in a network."""
    unused = [
        one.name(int(row))
        for one in survey.tables
        for row in np.flatnonzero(~np.logical_and.reduce(_known(one, network)))
    ]
    return (remark("observations_unused", observations=unused),) if unused else ()


def _names(one: ObservationTable, network: Network) -> tuple[str, ...]:
    """Return the names that the columns of a table are of."""
    return network.images if one.of.texts == ("image",) else network.points


def _known(one: ObservationTable, network: Network) -> list[BoolArray]:
    """Return which names of each column are in a network, (n,) each."""
    names = set(_names(one, network))
    columns = one.table.texts[1:] if one.of.texts[0] == "group" else one.table.texts
    return [np.array([name in names for name in column], dtype=bool) for column in columns]
