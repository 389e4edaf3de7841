"""Interface of the solvers of the reduced normal equations, and the memory they may use.

The reduced normal matrix S of orientations and kept points is factored once for each step; its factor
solves for the step and, at the optimum, gives the elements of S^-1 that covariances are made of.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from sfm.adjustment.datum import Motions
from sfm.adjustment.engine.accumulate import Blocks
from sfm.adjustment.engine.normals import Equations
from sfm.conventions import FloatArray
from sfm.errors import GeometryError


@dataclass(frozen=True)
class Inverse:
    """Elements of S^-1, in the units of the unknowns, 0 where they are fixed."""

    exterior: FloatArray  # of X0, w of each pose, (poses, 6, 6)
    mixed: FloatArray  # of poses by border unknowns, (6 poses, i + 3 s)
    border: FloatArray  # of interior unknowns, mounts and kept points, (i + 3 s, i + 3 s)
    core: FloatArray  # Y'S^-1 Y of each object point, (n, 3, 3)
    YQ: FloatArray  # Y'S^-1 of the object point by the pose of each image point, (k, 3, 6)
    YQ_border: FloatArray  # Y'S^-1 of each object point by the border, (n, 3, i + 3 s)


class Factor(Protocol):
    """The factored reduced normal matrix, its null space held."""

    @property
    def further(self) -> FloatArray:
        """Null vectors that the datum does not explain, scaled, orthonormal, (reduced, e)."""

    def solve(self, right: FloatArray) -> FloatArray:
        """Return a solution of S x = right for one or several right sides, (reduced,) or (reduced, r)."""

    def inverse(self, blocks: Blocks, *, cross: bool) -> Inverse:
        """Return the elements of the inverse.

        Args:
            blocks: of the undamped normal equations.
            cross: whether Y'S^-1 is wanted; empty otherwise.
        """


class Solver(Protocol):
    """A way to store and factor the reduced normal matrix of one network."""

    @property
    def has_coarse(self) -> bool:
        """Whether a step on the way takes less time in single precision."""

    @property
    def bytes(self) -> float:
        """Memory of the factor and its inverse at the peak, results apart; a second thread takes 0.05 GB."""

    def factor(
        self, equations: Equations, motions: Motions, *, damped: bool = False, coarse: bool = False
    ) -> Factor | None:
        """Return the factored reduced normal equations; None if they are not positive definite.

        Args:
            equations: normal equations with object points eliminated.
            motions: null vectors that the datum explains.
            damped: whether the equations carry damping, so that no further null vectors are sought.
            coarse: whether single precision will do, for a step on the way; None if that is too weak.
        """


try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]
SHARE = 0.75  # of the memory; the network, its blocks and other programs need some beside them
UNKNOWN = 8e9  # bytes where the system does not state what it has
# Limits of containers, in bytes, of control groups of version 2 and 1: beyond it processes are ended
LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def available_bytes() -> float:
    """Return how much memory normal equations may take."""
    known = UNKNOWN
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        known = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for file in LIMITS:
        try:
            known = min(known, float(file.read_text(encoding="ascii")))
        except (OSError, ValueError):  # there is no such file, or it contains "max"
            continue
    if resource is not None:  # ulimit -v
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            known = min(known, float(limit))
    return SHARE * known


def refuse_what_does_not_fit(size: float, unknowns: str, *, limit: float) -> None:
    """Refuse normal equations that need more memory than there is.

    Args:
        size: bytes that they, their factor and its inverse take.
        unknowns: which unknowns need them, in words.
        limit: what they may take, bytes, see `available_bytes`.

    Raises:
        GeometryError: it is more than that.
    """
    if size > limit:
        raise GeometryError(
            f"adjustment: {unknowns} need {size / 1e9:.0f} GB when they are factored and inverted, at most "
            f"{limit / 1e9:.0f} GB are taken"
        )
