"""Survey observations beside photographs: distances, levelling, angles and antenna positions from tables.

Tables are read into observations of a network. `sfm.judgement.given.tables` judges them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sfm.files.csv_tables import CsvTable, array_table, read_table
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.display import listed
from sfm.model.errors import SurveyFileError
from sfm.model.network import Network
from sfm.model.observations.kind import PHOTOGRAPH, POINT, Group, RowKind, TableKind
from sfm.model.observations.rigid_frames import RigidFrames
from sfm.model.observations.tables import TABLES
from sfm.model.remarks.remark import Remark, remark
from sfm.survey.inputs.exterior_table import MIN_COS_PHI
from sfm.survey.inputs.given_values import AXES, ScaleBar, refuse_tiny_sigmas

DISTANCE = "distance"


@dataclass(frozen=True)
class ObservationTable:
    """A table of survey observations of one kind.

    Example:
        >>> import sfm
        >>> tape = sfm.ObservationTable.from_arrays(
        ...     "distance", [["1", "2"], ["2", "3"]], [[4.031], [2.718]], [[0.001], [0.001]]
        ... )
        >>> tape.name(0), tape.sigma.shape
        ('distance 1 - 2', (2, 1))
    """

    kind: str  # as in the survey file
    value: FloatArray  # q values without and d with standard deviation, object unit or rad, (n, q + d)
    sigma: FloatArray  # object unit or rad, (n, d)
    table: CsvTable  # has the names of points or photographs
    copies: tuple[str, ...] = ()  # names of observations that the table has more than once; each counts once

    @classmethod
    def from_arrays(
        cls,
        kind: str,
        names: Sequence[Sequence[str]],
        values: npt.ArrayLike,
        sigma: npt.ArrayLike,
    ) -> ObservationTable:
        """Return the table of observations from arrays, in the columns and units of its file.

        Args:
            kind: kind as written in the survey file, such as "distance" or "height difference".
            names: names in the columns of points or photographs, one row for each observation, (n, t).
            values: columns of values, object unit or deg, (n, q).
            sigma: columns of standard deviations, object unit or deg, (n, d).

        Raises:
            SurveyFileError: an unknown kind, another number of rows or columns, a number that is not finite,
                or what `read_observation_table` refuses.
        """
        of = _kind_of(kind, "survey observations")
        columns = of.columns()
        numbers = np.hstack([np.atleast_2d(np.asarray(part, dtype=float)) for part in (values, sigma)])
        texts = list(zip(*names, strict=True))
        if numbers.shape[1:] != (len(columns),) or len(texts) != len(of.texts):
            raise SurveyFileError(
                f"{kind}: {len(texts)} columns of names and {numbers.shape[-1]} of numbers, needed "
                f"{listed([*of.texts, *columns])}"
            )
        named = dict(zip(of.texts, texts, strict=True))
        return observation_table(kind, array_table(kind, named, dict(zip(columns, numbers.T, strict=True))))

    @property
    def of(self) -> type[TableKind]:
        """The kind of observation."""
        return TABLES[self.kind]

    @property
    def named(self) -> tuple[tuple[str, ...], ...]:
        """The columns with names of points or photographs, without the column of labels."""
        return self.table.texts[issubclass(self.of, Group) and self.of.labelled :]

    def points(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Yield the name and the points of each observation."""
        if self.of.texts_of == POINT:
            for row, points in enumerate(zip(*self.named, strict=True)):
                yield self.name(row), points

    def name(self, row: int) -> str:
        """Return the name of an observation, such as "distance 12 - 15"."""
        return f"{self.kind} {' - '.join(column[row] for column in self.table.texts)}"


def read_observation_table(kind: str, path: Path, source: str) -> ObservationTable:
    """Read a table of observations: names, values, standard deviations.

    Args:
        kind: kind as written in the survey file.
        path: file of the table.
        source: the survey file, for error messages.

    Raises:
        SurveyFileError: an unknown kind, an unreadable table, wrong columns, a standard deviation that is not
            positive, or an observation between a point and itself.

    Returns:
        The observations; rows with equal names and numbers are one observation, not repeated measurements.
    """
    of = _kind_of(kind, source)
    table = read_table(path, of.texts, of.columns())
    copies = table.copies
    once = observation_table(kind, table.select(~copies))
    copied = dict.fromkeys(zip(*table.select(copies).texts, strict=True))
    return replace(once, copies=tuple(f"{kind} {' - '.join(names)}" for names in copied))


def _kind_of(kind: str, source: str) -> type[TableKind]:
    """Return a kind by its name in the survey file; SurveyFileError if there is none."""
    if kind not in TABLES:
        raise SurveyFileError(f"{source}: kind = '{kind}', needed one of {listed(list(TABLES))}")
    return TABLES[kind]


def observation_table(kind: str, table: CsvTable) -> ObservationTable:
    """Return the observations of a table that has the columns of their kind.

    Raises:
        SurveyFileError: a standard deviation that is not positive; an observation between a point and itself.
    """
    of = TABLES[kind]
    columns = of.columns()
    d = min(len(of.components), len(columns))  # lines have one standard deviation for both offsets
    sigma = table.values[:, -d:]
    table.refuse(sigma, ~(sigma > 0), columns[-d:], "more than 0, the standard deviation")
    # length, or extent of the positions, that each standard deviation belongs to, (n, d)
    size = table.values[:, len(of.numbers) : -d]
    if not size.shape[1]:
        size = np.zeros((len(size), d))  # offsets of 0
    else:
        extent = np.broadcast_to(np.ptp(size, axis=0).max(), size.shape) if of.components == AXES else size
        size = np.where(np.isin(of.components, of.angles), 0.0, extent)
    refuse_tiny_sigmas(table, sigma, columns[-d:], size)
    if "length" in of.components:
        table.refuse(table.values[:, :1], table.values[:, :1] <= 0, columns[:1], "more than 0, a length")
    if issubclass(of, Group) and len(of.texts) == 2:  # a second set of directions is another table
        table.refuse_duplicates(tuple(zip(*table.texts, strict=True)), of.texts)
    ends = [column for name, column in zip(of.texts, table.texts, strict=True) if name in ("from", "to")]
    for row, names in enumerate(zip(*ends, strict=True) if ends else ()):
        if len(set(names)) < len(names):
            raise SurveyFileError(f"{table.place(row)}: {kind} from {names[0]} to itself, needed two")
    if "phi" in of.angles:
        k = columns.index("phi_deg")
        locked = np.abs(np.cos(np.radians(table.values[:, k : k + 1]))) < MIN_COS_PHI
        needed = "another than +-90, where omega and kappa cannot be distinguished"
        table.refuse(table.values[:, k : k + 1], locked, ("phi_deg",), needed)
    to_rad = 1 / of.in_tables()
    value = table.values[:, :-d].copy()
    q = len(of.numbers)
    value[:, q:] *= to_rad[: value.shape[1] - q]
    return ObservationTable(kind, value, to_rad[:d] * sigma, table)


def bars_of(table: ObservationTable, number: int) -> list[ScaleBar]:
    """Return the distances of a table as scale bars with its number; none if the table has another kind."""
    if table.kind != DISTANCE:
        return []
    return [
        ScaleBar(start, end, float(length), float(sigma), number)
        for (start, end), (length,), (sigma,) in zip(
            zip(*table.table.texts, strict=True), table.value, table.sigma, strict=True
        )
    ]


def with_tables(tables: Sequence[ObservationTable], network: Network) -> Network:
    """Return the network with those observations of tables whose points or photographs it contains."""
    added: list[TableKind] = []
    for table, labels in zip(tables, _labels(tables), strict=True):
        known = _known(table, network)
        rows = np.flatnonzero(known)
        number = {name: k for k, name in enumerate(_names(table, network))}
        named = table.named
        indices = [np.array([number[column[row]] for row in rows], dtype=np.int64) for column in named]
        if issubclass(table.of, Group):
            for group, label in labels.items():
                of_group = np.array([name == group for name in table.table.texts[0]], dtype=bool)
                usable = of_group & known
                if usable.any():
                    points = np.stack(indices[-(len(table.of.texts) - 1) :], axis=1)[of_group[rows]]
                    value, sigma = table.value[usable], table.sigma[usable]
                    made = table.of.of_group(group, points, value, sigma, number)
                    if isinstance(made, RigidFrames):
                        rest = np.flatnonzero(of_group & ~known)
                        made = replace(
                            made,
                            hidden=tuple(table.table.texts[1][row] for row in rest),
                            hidden_value=table.value[rest],
                            hidden_sigma=table.sigma[rest],
                        )
                    added.append(replace(made, group=label))
        elif len(rows):
            assert issubclass(table.of, RowKind)
            added.append(table.of.of_table(tuple(indices), table.value[rows], table.sigma[rows]))
    added = [kind for kind in added if len(kind)]
    return network.with_given(further=(*network.further, *added)) if added else network


def _labels(tables: Sequence[ObservationTable]) -> list[dict[str, str]]:
    """Return the labels of the groups of each table: "S1", and "S1 (2)" if a second table has the name."""
    count, all_labels = Counter[tuple[str, str]](), []
    for table in tables:
        labels = {}
        for name in dict.fromkeys(table.table.texts[0]) if issubclass(table.of, Group) else ():
            count[table.kind, name] += 1
            before = count[table.kind, name] > 1
            labels[name] = f"{name} ({count[table.kind, name]})" if before else name
        all_labels.append(labels)
    return all_labels


def unused_observations(
    tables: Sequence[ObservationTable], copied: tuple[str, ...], network: Network
) -> tuple[Remark, ...]:
    """Return the remarks on observations of tables that are not used: without their points, or copies."""
    frames = [kind for kind in network.further if isinstance(kind, RigidFrames) and len(kind)]
    hidden = {(kind.group, name) for kind in frames for name in kind.hidden}
    unused: list[str] = []
    for table, labels in zip(tables, _labels(tables), strict=True):
        for row in np.flatnonzero(~_known(table, network)):
            names = tuple(column[row] for column in table.table.texts)
            if (labels.get(names[0]), *names[1:]) not in hidden:
                unused.append(table.name(int(row)))
    usable = with_tables(tables, network.with_given(further=())).further
    for table, labels in zip(tables, _labels(tables), strict=True):
        there = {kind.group for kind in usable if isinstance(kind, Group) and type(kind) is table.of}
        unused += [f"{table.kind} {label}" for label in labels.values() if label not in there]
    computed = [f"{kind.group} {name}" for kind in frames for name in kind.hidden]
    remarks = []
    if unused:
        remarks.append(remark("names_missing", of="observations", names=unused))
    if copied:
        remarks.append(remark("rows_identical", rows=copied))
    if computed:
        remarks.append(remark("frame_points_computed", points=computed))
    return tuple(remarks)


def _names(table: ObservationTable, network: Network) -> tuple[str, ...]:
    """Return the names of photographs or points that a table refers to."""
    return network.images if table.of.texts_of == PHOTOGRAPH else network.points


def _known(table: ObservationTable, network: Network) -> BoolArray:
    """Return which observations of a table have all their points or photographs in a network, (n,)."""
    names = set(_names(table, network))
    known: BoolArray = np.array([[name in names for name in column] for column in table.named], dtype=bool)
    return np.asarray(known.all(axis=0))
