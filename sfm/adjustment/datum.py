"""Datum: what decides position, attitude and scale of a network, on which object points.

Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 4.4.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm.conventions import BoolArray, IntArray
from sfm.errors import GeometryError
from sfm.network import Network

KINDS = ("free", "minimal", "control")


class ResolvedDatum(NamedTuple):
    """A datum on the points of one network."""

    kind: str  # free | minimal | control
    points: BoolArray | None  # which object points carry it, all if None, (n,)


@dataclass(frozen=True)
class Datum:
    """How position, attitude and scale of the network are decided.

    free: inner constraints on object points, control is ignored; minimal: as many fixed coordinates as
    needed; control: the network's control points, fixed or weighted. Scale bars, observed exterior and
    interior orientation take part in every kind, and the datum adds only what they leave open.

    Example:
        >>> import sfm
        >>> sfm.Datum("minimal", points=["501", "502", "503"]).points
        ['501', '502', '503']
    """

    kind: str = "free"  # free | minimal | control
    points: BoolArray | IntArray | Sequence[str] | Sequence[int] | None = None
    # object points that carry the datum: names, indices, or a mask (n,); all if None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise GeometryError(f"datum: kind '{self.kind}', expected one of {', '.join(KINDS)}")

    def resolve(self, network: Network) -> ResolvedDatum:
        """Return the datum with its points as a mask.

        Args:
            network: whose points are named.

        Raises:
            GeometryError: a point that is not in the network, or no point.
        """
        if self.points is None:
            return ResolvedDatum(self.kind, None)
        n = len(network.points)
        given = np.asarray([self.points] if isinstance(self.points, str) else self.points)
        if given.dtype == np.bool_:
            if given.shape != (n,):
                raise GeometryError(
                    f"datum: a mask of shape {given.shape}, expected ({n},), one for each point"
                )
            return ResolvedDatum(self.kind, given)
        if given.ndim != 1 or not len(given):
            raise GeometryError(f"datum: points of shape {given.shape}, expected names or indices of points")
        if given.dtype.kind == "U":
            place = {name: j for j, name in enumerate(network.points)}
            unknown = [name for name in given.tolist() if name not in place]
            index = np.array([place.get(name, -1) for name in given.tolist()], dtype=np.int64)
        elif given.dtype.kind in "iu":
            unknown = [str(j) for j in given if not 0 <= j < n]
            index = given
        else:
            raise GeometryError(f"datum: points of type {given.dtype}, expected names, indices or a mask")
        if unknown:
            raise GeometryError(f"datum: point {unknown[0]} is not in the network of {n} points")
        mask = np.zeros(n, dtype=bool)
        mask[index] = True
        return ResolvedDatum(self.kind, mask)
