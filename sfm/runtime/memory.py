"""Memory of this process, its limit, and what of it is left, from what the system states.

Source: Linux manual pages proc_meminfo(5), proc_pid_status(5), cgroups(7), getrlimit(2); the kernel's
documentation of control groups (memory.stat).
"""

from __future__ import annotations

import math
import os
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]
MOST_FILES = 30_000  # that may be open, where the system does not limit them: it maps twice as many
MEMINFO, STATUS = Path("/proc/meminfo"), Path("/proc/self/status")
GROUPS, OF_PROCESS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
# Files of a control group, version 2 and version 1: its limit, above which its processes are ended, what it
# uses, and the parts of this that are copies of files, which the system drops where memory is wanted.
FILES = {
    "memory.max": ("memory.current", ("inactive_file", "active_file")),
    "memory.limit_in_bytes": ("memory.usage_in_bytes", ("total_inactive_file", "total_active_file")),
}


def peak_bytes() -> float:
    """Return the largest memory of this process so far, bytes; 0 where the system does not state it."""
    stated = _numbers_in(STATUS)
    if "VmHWM:" in stated:  # that of getrusage is also what the process had that started this one
        return stated["VmHWM:"] * 1024
    if resource is None or sys.platform != "darwin":
        return 0.0
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


@cache
def open_files() -> int:
    """Return how many files this process may have open; the limit is raised to what the system allows."""
    if resource is None:
        return MOST_FILES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_FILES)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return MOST_FILES if soft == resource.RLIM_INFINITY else soft
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    except (ValueError, OSError):
        return soft
    return wanted


def limit_bytes() -> float:
    """Return the memory that this process may have at most, bytes; infinite where it is unknown."""
    known = math.inf
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        known = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    if resource is not None:  # ulimit -v
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            known = min(known, float(limit))
    return min([known, *_limits().values()])


def within_bytes() -> float:
    """Return what this process may have altogether: its memory and what is left, with swap, bytes.

    Where the system does not state what is left, it is `limit_bytes`.
    """
    known = _numbers_in(MEMINFO)
    own = _numbers_in(STATUS).get("VmRSS:", 0.0) * 1024
    left = [limit - _used_of(file) for file, limit in _limits().items()]
    if "MemAvailable:" in known:
        left.append((known["MemAvailable:"] + known.get("SwapFree:", 0.0)) * 1024)
    return min(limit_bytes(), own + max(min(left), 0.0)) if left else limit_bytes()


def _limits() -> dict[Path, float]:
    """Return the limits of the control groups of this process, bytes, by their files."""
    folders = {GROUPS, GROUPS / "memory"}
    with suppress(OSError, ValueError):
        for line in OF_PROCESS.read_text("ascii").splitlines():
            _, controllers, place = line.split(":", 2)
            if controllers in ("", "memory"):
                own = GROUPS / controllers / place.lstrip("/")
                folders |= {own, *own.parents} - set(GROUPS.parents)
    limits = {}
    for file in (folder / most for folder in folders for most in FILES):
        with suppress(OSError, ValueError):  # "max" is no limit
            limits[file] = float(file.read_text("ascii"))
    return limits


def _used_of(limit: Path) -> float:
    """Return what a control group uses, bytes, by the file of its limit; nothing where it is not stated."""
    used, copies = FILES[limit.name]
    stated = _numbers_in(limit.with_name("memory.stat"))
    with suppress(OSError, ValueError):
        whole = float(limit.with_name(used).read_text("ascii"))
        return whole - sum(stated.get(name, 0.0) for name in copies)
    return 0.0


def _numbers_in(file: Path) -> dict[str, float]:
    """Return the numbers behind the first words of the lines of a file; none if it cannot be read."""
    numbers = {}
    with suppress(OSError, UnicodeDecodeError):
        for line in file.read_text("utf-8").splitlines():
            words = line.split()
            if len(words) > 1 and words[1].isdecimal():
                numbers[words[0]] = float(words[1])
    return numbers
