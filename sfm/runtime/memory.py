"""Memory of this process and what the system can still give it, from what the kernel states.

Source: Linux manual pages proc_meminfo(5), cgroups(7).
"""

from __future__ import annotations

import math
import sys
from contextlib import suppress
from pathlib import Path

MEMINFO, CGROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup")


def peak_mb() -> float:
    """Return the largest memory of this process so far, 10^6 bytes; 0 where the system does not state it."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return 0.0
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def available_mb() -> float:
    """Return the memory that this process can still take, with swap, 10^6 bytes; infinite where unknown."""
    return min(_of_system(), _of_group())


def _of_system() -> float:
    with suppress(OSError, ValueError, KeyError, IndexError):
        rows = (line.split() for line in MEMINFO.read_text("ascii").splitlines())
        kib = {row[0]: int(row[1]) for row in rows}
        return (kib["MemAvailable:"] + kib["SwapFree:"]) * 1024 / 1e6
    return math.inf


def _of_group() -> float:
    """Return what the group of processes, such as a container, leaves of its limit."""
    with suppress(OSError, ValueError):
        limit, used = (int((CGROUP / name).read_text("ascii")) for name in ("memory.max", "memory.current"))
        return max(limit - used, 0) / 1e6
    return math.inf
