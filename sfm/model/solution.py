"""Solution: a solved network with its points by name and their covariance, from Kolinear or other programs.

The results of `adjust` and `run_survey` have it as `.solution`, and `read_result` returns it. Comparison,
shapes, measurement, epochs and file formats accept it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray, IntArray, angles_from_rotation
from sfm.model.display import counted, html_table, text_table
from sfm.model.errors import BackendError, GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, index_of
from sfm.model.remarks.verdict import Verdict

if TYPE_CHECKING:
    import pandas

MAX_POINTS = 1000  # of a stored matrix, which then takes 36 MB
MAX_WORK = 5_000_000  # points times points of the sample: the time of their matrix grows with this product
SEED = 1
UNCODED = re.compile(r"u\d+")  # new names in every run of points without a name
SHOWN = 10  # points in a printed table
HEADER = ("point", "X", "Y", "Z", "sX", "sY", "sZ", "rays")
NO_SCALE = "network units"
"""unit of lengths in a network whose scale is undefined"""
OBJECT_UNITS = "object units"
"""unit of lengths in a network whose unit is not stated"""
CONTROL_COVARIANCE = "control covariance"  # kind of a row of given.csv
MOUNT = ("X", "Y", "Z", "omega", "phi", "kappa")  # pose of a camera in the axes of its rig
MEASURED = "measured"
"""entry in targets.csv for a measured target, in place of a reason for rejection"""


@dataclass(frozen=True)
class SeenTargets:
    """Measured targets and rejected candidates in the photographs of a result."""

    image: IntArray  # index of the photograph in the network of the result, (k,)
    xy: FloatArray  # centres, px, (k, 2)
    ellipse: FloatArray  # semi-axes, larger first, px; angle from x towards y, rad; NaN if rejected, (k, 3)
    reason: tuple[str, ...]  # reason for rejection, in words; empty if measured, (k,)

    @property
    def measured(self) -> BoolArray:
        """Which were measured, (k,)."""
        return np.array([not words for words in self.reason], dtype=bool)


@dataclass(frozen=True)
class OrientedImage:
    """Exterior orientation of one photograph."""

    name: str
    position: FloatArray  # projection centre X0, object unit, (3,)
    rotation: FloatArray  # R, image to object axes, (3, 3)
    covariance: FloatArray  # X0, Y0, Z0 (object unit), omega, phi, kappa (rad); NaN where unknown, (6, 6)

    @property
    def angles(self) -> FloatArray:
        """Omega, phi, kappa, rad, (3,)."""
        return angles_from_rotation(self.rotation)

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of X0, Y0, Z0 (object unit) and omega, phi, kappa (rad), (6,)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))


JointCovariance = Callable[[IntArray, IntArray], FloatArray]
"""Returns the joint covariance of X Y Z of points (p,) and X0 Y0 Z0 omega phi kappa of photographs (m,), by
their indices, in object units and rad, (3 p + 6 m, 3 p + 6 m)."""


@dataclass(frozen=True, repr=False, eq=False)
class Solution:
    """A network with its solution: Kolinear's, COLMAP's or another program's.

    Example:
        >>> import sfm
        >>> solution = sfm.adjust(result.network, result.estimate).solution
        >>> solution.point("1").xyz.shape, solution.covariance_of(["1", "2"], ["image 1"]).shape
        ((3,), (12, 12))
    """

    name: str  # name of the result
    network: Network
    estimate: Estimate
    point_covariance: FloatArray | None = None  # marginal, object unit^2, (n, 3, 3)
    position_covariance: FloatArray | None = None  # projection centres, object unit^2, (m, 3, 3)
    interior_sigma: tuple[FloatArray, ...] | None = None  # one per parameter, NaN where fixed
    redundancy: int | None = None  # redundancy of the adjustment, for the degrees of freedom of tests
    unit: str = ""  # name of the unit of lengths; empty where unknown
    covariance: FloatArray | None = None  # joint, of all coordinates of points, object unit^2, (3k, 3k)
    datum: str = ""  # free | minimal | control; empty where unknown
    points_named: bool = True  # whether the names of points identify them, or are mere numbers
    images_named: bool = True  # likewise for photographs
    covariance_points: IntArray | None = None  # indices of the points of `covariance`; all if None, (k,)
    exterior_covariance: FloatArray | None = None  # X0, Y0, Z0, omega, phi, kappa, unit and rad, (m, 6, 6)
    interior_covariance: tuple[FloatArray, ...] = ()  # free parameters of each camera, (f, f)
    # joint, of the free parameters of all cameras, then X, Y, Z, omega, phi, kappa of each mount, unit and
    # rad, (s, s)
    rig_covariance: FloatArray | None = None
    joint: JointCovariance | None = None  # joint covariance of an adjustment in memory; otherwise None
    # verdict, or a function that judges when it is asked for; None if it was not judged
    judged: Verdict | Callable[[], Verdict | None] | None = None
    sigma0: float = 1.0  # of unit weight: the covariances are its square times those of the stated weights

    @cached_property
    def verdict(self) -> Verdict | None:
        """Level, headline, all remarks and tests; None if it was not judged."""
        return self.judged() if callable(self.judged) else self.judged

    @property
    def has_scale(self) -> bool:
        """Whether lengths are in a known unit, from scale bars or control."""
        return self.unit not in ("", NO_SCALE)

    @property
    def mount_covariance(self) -> FloatArray | None:
        """Covariance of X, Y, Z, omega, phi, kappa of each camera in its rig, (a, 6, 6)."""
        Q = self.rig_covariance
        return None if Q is None else mount_blocks(Q, len(Q) - 6 * len(self.estimate.cameras))

    @property
    def rig_parameters(self) -> tuple[str, ...]:
        """Names of the camera and parameter of each row of `rig_covariance`, (s,)."""
        cameras = self.estimate.cameras
        interior = [
            f"{camera.name} {name}"
            for camera, Q in zip(cameras, self.interior_covariance, strict=False)
            for name in np.array(camera.names)[camera.free][: len(Q)]
        ]
        return (*interior, *(f"{camera.name} {name}" for camera in cameras for name in MOUNT))

    @property
    def solution(self) -> Solution:
        """The solution itself: results of adjustments and surveys have the same attribute."""
        return self

    @cached_property
    def with_joint_covariance(self) -> Solution:
        """The solution with the joint covariance of all points, or of a sample if there are many.

        Where this covariance is unknown, it is the unchanged solution.
        """
        if self.covariance is not None or self.joint is None:
            return self
        names = points_kept_together(self.network.points)
        try:
            # a copy, so that the normal equations, the largest part of it, are freed with the copy
            covariance = copy(self.joint)(names, np.zeros(0, dtype=np.int64))
        except GeometryError:  # normal equations that cannot be solved give no covariance at all
            return self
        if not np.isfinite(covariance).all():
            return self
        every = len(names) == len(self.network.points)
        return replace(self, covariance=covariance, covariance_points=None if every else names)

    def covariance_of(self, points: Sequence[str] = (), images: Sequence[str] = ()) -> FloatArray:
        """Return the joint covariance of some points and photographs, given by name.

        Args:
            points: names of p points.
            images: names of m photographs.

        Returns:
            Covariance of X Y Z of each point, then of X0, Y0, Z0, omega, phi, kappa of each photograph, in
            object units and rad, (3 p + 6 m, 3 p + 6 m).

        Raises:
            UnknownNameError: no point or photograph has that name.
            GeometryError: the covariance is unknown, for example between points of another program's result.
        """
        rows = np.array([self.network.point_index(name) for name in points], dtype=np.int64)
        photographs = np.array([self.network.image_index(name) for name in images], dtype=np.int64)
        if self.joint is not None:
            return self.joint(rows, photographs)
        if not len(photographs) and self.covariance is not None:
            kept = self.covariance_rows(rows)
            if (kept >= 0).all():
                columns = (3 * kept[:, None] + np.arange(3)).ravel()
                return np.asarray(self.covariance[np.ix_(columns, columns)])
        if len(rows) == 1 and not len(photographs) and self.point_covariance is not None:
            return np.asarray(self.point_covariance[rows[0]])
        if len(photographs) == 1 and not len(rows) and self.exterior_covariance is not None:
            return np.asarray(self.exterior_covariance[photographs[0]])
        raise GeometryError(
            f"result {self.name}: the joint covariance of these points and photographs is not in it; "
            "adjust the network with sfm.adjust"
        )

    def covariance_rows(self, points: IntArray) -> IntArray:
        """Return the position of points among the points of `covariance`, -1 for points that it lacks.

        Args:
            points: indices of points, (k,).
        """
        if self.covariance_points is None:
            return points
        row = np.full(len(self.network.points), -1, dtype=np.int64)
        row[self.covariance_points] = np.arange(len(self.covariance_points))
        return np.asarray(row[points])

    @property
    def points(self) -> PointTable:
        """The object points, by name."""
        n = len(self.network.points)
        covariance = self.point_covariance
        if covariance is None:
            covariance = np.full((n, 3, 3), np.nan)
        return PointTable(
            self.network.points, self.estimate.points, covariance, self.network.rays(), self.unit
        )

    def point(self, name: str | int) -> Point:
        """Return an object point by its name; the name of a coded target is its number.

        Raises:
            UnknownNameError: no point has that name.
        """
        point: Point = self.points[str(name)]
        return point

    def write(self, folder: str | Path) -> Path:
        """Write the tables of the solution into a folder, whole or not at all; return points.csv.

        Raises:
            OutputError: the folder cannot be written.
        """
        import sfm  # file formats are in a layer above this one, so they are called by their public name

        path: Path = sfm.write_result(self, folder)
        return path

    def image(self, name: str) -> OrientedImage:
        """Return the exterior orientation of a photograph; UnknownNameError if no such photograph exists."""
        i = self.network.image_index(name)
        covariance = np.full((6, 6), np.nan)
        if self.exterior_covariance is not None:
            covariance = self.exterior_covariance[i]
        elif self.position_covariance is not None:
            covariance[:3, :3] = self.position_covariance[i]
        return OrientedImage(name, self.estimate.position[i], self.estimate.rotation[i], covariance)

    def camera(self, name: str) -> Camera:
        """Return a camera; UnknownNameError if no camera has that name."""
        cameras = self.estimate.cameras
        return cameras[index_of([camera.name for camera in cameras], name, "camera")]

    def _rows(self) -> list[tuple[str, str]]:
        known = self.point_covariance is not None
        rows = [
            ("photographs", str(len(self.network.images))),
            ("points", f"{len(self.network.points)}{', with' if known else ', without'} standard deviations"),
            ("image points", str(len(self.network.image_points))),
            ("cameras", ", ".join(f"{c.name} ({c.model})" for c in self.estimate.cameras)),
        ]
        if self.verdict is None:
            return rows
        return [*rows, ("verdict", self.verdict.summary)]

    def __repr__(self) -> str:
        return text_table(f"Result {self.name}", ("", ""), self._rows())

    def _repr_html_(self) -> str:
        return html_table(f"Result {self.name}", ("", ""), self._rows())


def points_kept_together(names: tuple[str, ...]) -> IntArray:
    """Return the points whose joint covariance is stored, in rising order: all, or a sample of over 1000.

    Points with real names come first, since other results have them too. The others are drawn at random, so
    that they are distributed like all points.

    Args:
        names: names of all points.
    """
    n = len(names)
    if n <= MAX_POINTS:
        return np.arange(n)
    named = np.array([UNCODED.fullmatch(name) is None for name in names])
    order = np.random.default_rng(SEED).permutation(n)
    order = np.concatenate([order[named[order]], order[~named[order]]])
    return np.sort(order[: min(MAX_POINTS, MAX_WORK // n)])


def mount_blocks(covariance: FloatArray, first: int) -> FloatArray:
    """Return the block of each mount in a joint covariance; mounts begin at row `first`, (a, 6, 6)."""
    rows = first + np.arange(len(covariance) - first if len(covariance) else 0).reshape(-1, 6)
    return np.asarray(covariance[rows[:, :, None], rows[:, None]])


class Solved(Protocol):
    """What `run_survey`, `adjust` or `read_result` returns."""

    @property
    def solution(self) -> Solution:
        """The solution."""


def solution_of(result: Any, what: str) -> Solution:
    """Return the solution of the result of an adjustment, a survey or a file.

    Args:
        result: a Solution, or an object with a Solution as `.solution`.
        what: name of the calling function, for the message.

    Raises:
        GeometryError: the object has no solution.
    """
    solution = getattr(result, "solution", None)
    if not isinstance(solution, Solution):
        raise GeometryError(
            f"{what}: {type(result).__name__}, expected what run_survey, adjust or read_result returned"
        )
    return solution


@dataclass(frozen=True)
class Point:
    """One object point."""

    name: str
    xyz: FloatArray  # object unit, (3,)
    covariance: FloatArray  # object unit^2; NaN where unknown, (3, 3)

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of X, Y, Z, object unit, (3,)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))

    def __repr__(self) -> str:
        values = ", ".join(f"{axis} {x:.6g}" for axis, x in zip("XYZ", self.xyz, strict=True))
        return f"<Point {self.name}: {values}, sigma {', '.join(f'{s:.2g}' for s in self.sigma)}>"


@dataclass(frozen=True, repr=False, eq=False)
class PointTable(Sequence[Point]):
    """Object points in order; each can be accessed by its name or its index."""

    names: tuple[str, ...]  # (n,)
    xyz: FloatArray  # object unit, (n, 3)
    covariance: FloatArray  # object unit^2; NaN where unknown, (n, 3, 3)
    rays: IntArray  # number of photographs in which each point was measured, (n,)
    unit: str = ""  # name of the unit of lengths

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of X, Y, Z, object unit, (n, 3)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)))

    def index(self, name: object, start: int = 0, stop: int | None = None) -> int:
        """Return the index of a point.

        Raises:
            UnknownNameError: no point has that name.
        """
        return index_of(self.names, name, "point")

    def __len__(self) -> int:
        return len(self.names)

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[Point]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, key: Any) -> Any:
        """Return the point of a name or index, or the points of a slice, mask or list of names or indices."""
        if isinstance(key, str):
            key = self.index(key)
        if isinstance(key, int | np.integer):
            return Point(self.names[key], self.xyz[key], self.covariance[key])
        if not isinstance(key, slice | np.ndarray):
            key = [self.index(label) if isinstance(label, str) else label for label in key]
        rows = np.arange(len(self))[key]
        names = tuple(self.names[k] for k in rows)
        return PointTable(names, self.xyz[rows], self.covariance[rows], self.rays[rows], self.unit)

    def to_pandas(self) -> pandas.DataFrame:
        """Return the points as a data frame indexed by their names.

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
