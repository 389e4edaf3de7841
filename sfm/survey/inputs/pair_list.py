"""The list of the pairs of photographs in which natural points are matched, where a survey gives one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sfm.files.csv_tables import CsvTable, array_table, read_table
from sfm.model.errors import SurveyFileError

COLUMNS = ("image", "other")


@dataclass(frozen=True)
class PairList:
    """Pairs of photographs; none is that of a photograph with itself, and none is there twice.

    Example:
        >>> import sfm
        >>> sfm.PairList.from_arrays(["a.jpg", "b.jpg"], ["b.jpg", "c.jpg"]).names
        (('a.jpg', 'b.jpg'), ('b.jpg', 'c.jpg'))
    """

    names: tuple[tuple[str, str], ...]  # of both photographs of each pair, (p,)
    table: CsvTable  # their table, for error messages

    @classmethod
    def from_arrays(cls, image: Sequence[str], other: Sequence[str]) -> PairList:
        """Return the list of p pairs.

        Args:
            image: name of a photograph of each pair, (p,).
            other: name of the other one, (p,).

        Raises:
            SurveyFileError: other numbers of names, or see `read_pairs`.
        """
        return _list_of(array_table("pairs", {"image": image, "other": other}, {}))


def read_pairs(path: Path) -> PairList:
    """Read a table image,other of pairs of photographs.

    Raises:
        SurveyFileError: the file is unreadable or has wrong columns, or a pair is there twice, in either
            order, or has the same photograph twice.
    """
    return _list_of(read_table(path, COLUMNS, ()))


def _list_of(table: CsvTable) -> PairList:
    """Return the pairs of a table; raise SurveyFileError if one is there twice or is of one photograph."""
    pairs = tuple((image, other) for image, other in zip(*table.texts, strict=True))
    for k, (image, other) in enumerate(pairs):
        if image == other:
            raise SurveyFileError(f"{table.place(k)}: image '{image}' twice, a pair has two photographs")
    table.refuse_duplicates(tuple(tuple(sorted(pair)) for pair in pairs), COLUMNS)
    return PairList(pairs, table)
