"""Survey observations beside photographs: distances, levelling, angles, antenna positions, from tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfm.adjustment.result import Adjustment, ObservedResiduals
from sfm.conventions import BoolArray, FloatArray, IntArray
from sfm.display import listed
from sfm.distributions import normal_ppf
from sfm.errors import SurveyFileError
from sfm.files.csv_tables import CsvTable, read_table
from sfm.network import Estimate, Network
from sfm.observations import TABLES
from sfm.observations.groups import Group
from sfm.observations.kind import Kind, RowKind, TableKind
from sfm.remarks.remark import Remark, remark
from sfm.survey.inputs.given import ScaleBar

if TYPE_CHECKING:
    from sfm.survey.inputs.survey import Survey


DISTANCE = "distance"
MAX_WRONG = 1 / 3  # share of the observations of a kind that are wrong, beyond which none is believed
ALARM = 0.001  # probability with which right observations of tables lose one
MIN_REDUNDANCY = 0.01  # of an observation that is tested: others hardly check one below


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
    if issubclass(of, Group):  # a point counts once in a group; a station has one set of directions
        table.refuse_duplicates(tuple(zip(*table.texts, strict=True)), of.texts)
    elif len(of.texts) > 1:
        for row, names in enumerate(zip(*table.texts, strict=True)):
            if len(set(names)) < len(names):
                raise SurveyFileError(
                    f"{table.place(row)}: {kind} from {names[0]} to itself, needed two points"
                )
    unit = np.pi / 180 if of.in_degrees else 1.0
    value = table.values[:, :-d].copy()
    value[:, len(of.numbers) :] *= unit
    return ObservationTable(kind, value, unit * sigma, table)


def bars_of(table: ObservationTable) -> list[ScaleBar]:
    """Return the distances of a table as scale bars, which they are; none of other kinds."""
    if table.kind != DISTANCE:
        return []
    return [
        ScaleBar(start, end, float(length), float(sigma))
        for (start, end), (length,), (sigma,) in zip(
            zip(*table.table.texts, strict=True), table.value, table.sigma, strict=True
        )
    ]


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
        assert issubclass(one.of, RowKind)
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
    for one in survey.tables:
        if issubclass(one.of, Group):
            there = {kind.group for kind in network.observations if isinstance(kind, one.of) and len(kind)}
            unused += [
                f"{one.kind} {name}" for name in dict.fromkeys(one.table.texts[0]) if name not in there
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


@dataclass(frozen=True)
class Gross:
    """Observations of tables that contradict others."""

    names: tuple[str, ...] = ()  # as `name_of_observation` names them
    kinds: tuple[str, ...] = ()  # of which more than MAX_WRONG contradict: nothing shows which ones are right


def find_gross(network: Network, adjust_with: Callable[[Network], Adjustment]) -> Gross:
    """Return the observations of tables that contradict all others.

    Image points are not tested here: one wrong observation would have right ones rejected, which are weaker.
    The observation with the largest w leaves first, as long as more of its kind stay.

    Args:
        network: image points that are accepted, and observations.
        adjust_with: adjusts a network without rejecting anything.
    """
    out: dict[str, list[str]] = {}
    whole: list[str] = []
    total = Counter[str]()
    for kind in network.observations:
        total[kind.name] += len(kind)
    while network.observations:
        a = adjust_with(network)
        first = len(network.kinds) - len(network.observations)
        tests = [(w, one, row) for one in a.observed if one.index >= first for w, row in _largest(one)]
        w, one, row = max(tests, key=lambda test: test[0], default=(0.0, None, 0))
        count = sum(one.count for one in a.observed if one.index >= first)
        if one is None or not w > -normal_ppf(ALARM / (2 * count)):
            break
        kind = network.kinds[one.index]
        same = sum(len(other) for other in network.observations if type(other) is type(kind))
        if same < 3:
            break  # of two nothing shows which one is wrong; the remark on residuals names the larger one
        at = int(one.rows[row])
        names = out.setdefault(kind.name, [])
        names.append(name_of_observation(kind, at, network, a.estimate))
        others = list(network.observations)
        others[one.index - first] = kind.select(np.delete(np.arange(len(kind)), at))
        if len(names) > MAX_WRONG * total[kind.name]:
            whole.append(kind.name)
            others = [other for other in others if other.name != kind.name]
            del out[kind.name]
        network = replace(network, observations=tuple(other for other in others if len(other)))
    return Gross(tuple(name for names in out.values() for name in names), tuple(whole))


def _largest(one: ObservedResiduals) -> list[tuple[float, int]]:
    """Return the largest |w| of each observation that is checked, and its row."""
    w = np.where(one.redundancy_numbers > MIN_REDUNDANCY, np.abs(one.standardised), np.nan)
    return [(float(np.nanmax(own)), row) for row, own in enumerate(w) if np.isfinite(own).any()]


def name_of_observation(kind: Kind, row: int, network: Network, estimate: Estimate) -> str:
    """Return "height difference 12 - 15"."""
    return f"{kind.single} {kind.names(network, estimate)[row]}"


def without_observations(network: Network, estimate: Estimate, gross: Gross) -> Network:
    """Return the network without some observations and kinds of them."""
    kept = []
    for kind in network.observations:
        names = [name_of_observation(kind, row, network, estimate) for row in range(len(kind))]
        on = [kind.name not in gross.kinds and name not in gross.names for name in names]
        kept.append(kind.select(np.array(on, dtype=bool)))
    return replace(network, observations=tuple(kind for kind in kept if len(kind)))
