"""Memory of this process, its limit, and what of it is left, from what the system states.

Source: Linux manual pages proc_meminfo(5), cgroups(7), getrlimit(2).
"""

from __future__ import annotations

import math
import os
import sys
from contextlib import suppress
from pathlib import Path

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]
MEMINFO = Path("/proc/meminfo")
# Memory limits of containers, in bytes (control groups of versions 2 and 1), above which processes are ended,
# and what is used of each.
LIMITS = (
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (
        Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
        Path("/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ),
)


def peak_bytes() -> float:
    """Return the largest memory of this process so far, bytes; 0 where the system does not state it."""
    if resource is None:
        return 0.0
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * unit


def limit_bytes() -> float:
    """Return the memory that this process may have at most, bytes; infinite where it is unknown."""
    known = math.inf
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        known = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    if resource is not None:  # ulimit -v
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            known = min(known, float(limit))
    return min([known, *(_number_in(limit) for limit, _ in LIMITS)])


def left_bytes() -> float:
    """Return the memory that this process can still take, with swap, bytes; its limit if not known."""
    left = limit_bytes()
    with suppress(OSError, ValueError, KeyError, IndexError):
        rows = (line.split() for line in MEMINFO.read_text("ascii").splitlines())
        kib = {row[0]: int(row[1]) for row in rows}
        left = min(left, (kib["MemAvailable:"] + kib["SwapFree:"]) * 1024.0)
    for limit, used in LIMITS:
        if math.isfinite(_number_in(limit)) and math.isfinite(_number_in(used)):
            left = min(left, max(_number_in(limit) - _number_in(used), 0.0))
    return left


def _number_in(file: Path) -> float:
    """Return the number in a file; infinite if it does not exist, or contains "max"."""
    try:
        return float(file.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return math.inf
