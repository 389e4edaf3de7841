"""Memory that the normal equations may use, of this computer, its container, or the process."""

from __future__ import annotations

import os
from pathlib import Path

from sfm.errors import GeometryError

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
