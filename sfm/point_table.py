"""Object points by name, with their covariance: what a result gives to whoever goes on computing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sfm.conventions import FloatArray, IntArray
from sfm.display import counted, html_table, text_table
from sfm.errors import BackendError
from sfm.network import index_of

if TYPE_CHECKING:
    import pandas

SHOWN = 10  # points in a representation
HEADER = ("point", "X", "Y", "Z", "sX", "sY", "sZ", "rays")


@dataclass(frozen=True)
class Point:
    """One object point."""

    name: str
    xyz: FloatArray  # object unit, (3,)
    covariance: FloatArray  # object unit^2; NaN where not known, (3, 3)

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of X, Y, Z, object unit, (3,)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))

    def __repr__(self) -> str:
        values = ", ".join(f"{axis} {x:.6g}" for axis, x in zip("XYZ", self.xyz, strict=True))
        return f"<Point {self.name}: {values}, sigma {', '.join(f'{s:.2g}' for s in self.sigma)}>"


@dataclass(frozen=True, repr=False, eq=False)
class PointTable(Sequence[Point]):
    """Object points in order, each reached by its name or its number."""

    names: tuple[str, ...]  # (n,)
    xyz: FloatArray  # object unit, (n, 3)
    covariance: FloatArray  # object unit^2; NaN where not known, (n, 3, 3)
    rays: IntArray  # photographs that each point was measured in, (n,)
    unit: str = ""  # of lengths, as people call it

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of X, Y, Z, object unit, (n, 3)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)))

    def index(self, name: object, start: int = 0, stop: int | None = None) -> int:
        """Return the number of a point.

        Raises:
            UnknownNameError: there is no point of that name.
        """
        return index_of(self.names, name, "point")

    def __len__(self) -> int:
        return len(self.names)

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[Point]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, key: Any) -> Any:
        """Return a point by its name or number, or the points of a slice, a mask, or a list of either."""
        if isinstance(key, str):
            key = self.index(key)
        if isinstance(key, int | np.integer):
            return Point(self.names[key], self.xyz[key], self.covariance[key])
        if not isinstance(key, slice | np.ndarray):
            key = [self.index(one) if isinstance(one, str) else one for one in key]
        rows = np.arange(len(self))[key]
        names = tuple(self.names[k] for k in rows)
        return PointTable(names, self.xyz[rows], self.covariance[rows], self.rays[rows], self.unit)

    def to_pandas(self) -> pandas.DataFrame:
        """Return the points as a data frame with the names as its index.

        Raises:
            BackendError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError as error:
            raise BackendError("to_pandas needs pandas: pip install pandas") from error
        columns = np.hstack([self.xyz, self.sigma])
        frame = pandas.DataFrame(columns, index=list(self.names), columns=["X", "Y", "Z", "sX", "sY", "sZ"])
        frame.index.name = "point"
        frame["rays"] = self.rays
        return frame

    def _rows(self) -> list[tuple[str, ...]]:
        shown = range(min(len(self), SHOWN))
        values = np.hstack([self.xyz, self.sigma])
        return [(self.names[k], *(f"{v:.6g}" for v in values[k]), str(self.rays[k])) for k in shown]

    @property
    def _title(self) -> str:
        more = f", the first {SHOWN}" if len(self) > SHOWN else ""
        return f"{counted(len(self), 'point')}{f', {self.unit}' if self.unit else ''}{more}"

    def __repr__(self) -> str:
        return text_table(self._title, HEADER, self._rows())

    def _repr_html_(self) -> str:
        return html_table(self._title, HEADER, self._rows())
