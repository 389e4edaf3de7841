"""Threads, processor cores and freed memory of the process, set on purpose.

numpy and scipy bring a BLAS pool each, whose threads spin while they wait. On two cores 100 photographs took
464 ms with two threads and 219 ms with one, and a symmetric product of 6000 x 1208 took 160 against 129 ms:
both pools get one thread. Where two threads help, the work is cut into the same two parts whatever their
number, so that the results are the same to the last bit.

Memory that has been freed: given back to the system after a stage, kept between the steps of one.

The C library keeps freed memory for the next request of a like size, in each thread by itself: what one has
freed no other one takes. After photographs have been worked on in several threads that is most of it: 0.7 of
1.1 GB with 25 photographs of 6 megapixels. Of arrays of some MB it keeps nothing at first, and the system
clears them anew at every step: a fifth of the time of 60 photographs.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import TypeVar

from threadpoolctl import LibController, ThreadpoolController

ARENA_MAX = -8  # M_ARENA_MAX in malloc.h
LARGEST_KEPT = 31 << 20  # bytes; glibc's limit is 32 MiB, M_MMAP_THRESHOLD in mallopt(3)
S = TypeVar("S")
T = TypeVar("T")
_second: ContextVar[ThreadPoolExecutor | None] = ContextVar("second", default=None)


@contextmanager
def own_threads(threads: int | None = None) -> Iterator[None]:
    """Hold both BLAS pools to one thread, then give them back what they had.

    Where there are more, a second thread is at hand meanwhile for `at_once`, also within an inner one.

    Args:
        threads: how many there are; as many as the pools had, if not given.
    """
    before = [(pool, pool.num_threads) for pool in _pools()]
    there = max((number for _, number in before), default=1) if threads is None else threads
    token = None
    try:
        for pool, _ in before:
            pool.set_num_threads(1)
        if there > 1 and _second.get() is None:
            token = _second.set(ThreadPoolExecutor(1))
        yield
    finally:
        if token is not None:
            second = _second.get()
            _second.reset(token)
            if second is not None:
                second.shutdown()
        for pool, number in before:
            pool.set_num_threads(number)


def at_once(one: Callable[[], T], other: Callable[[], T]) -> tuple[T, T]:
    """Return what two functions return; they run at the same time where a second thread is at hand."""
    second = _second.get()
    if second is None:
        return one(), other()
    running = second.submit(other)
    try:
        result = one()
    finally:
        running.exception()  # ended, whatever became of the first
    return result, running.result()


def in_threads(function: Callable[[S], T], items: Sequence[S], threads: int) -> Iterator[T]:
    """Yield what a function returns for each item, in their order, so many worked on at a time.

    It gains where the function spends its time in compiled code.
    """
    if threads < 2 or len(items) < 2:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(function, items)


@cache
def _pools() -> tuple[LibController, ...]:
    """The BLAS libraries that are loaded; looked up once, because looking takes milliseconds."""
    return tuple(pool for pool in ThreadpoolController().lib_controllers if pool.user_api == "blas")


def cores() -> int:
    """Return how many processor cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def give_back_memory() -> None:
    """Give freed memory back where the C library can be asked to (glibc)."""
    trim = _asked("malloc_trim")
    if trim is not None:
        trim(0)


@cache
def share_freed_memory() -> None:
    """Have threads that begin from now on share one pool of freed memory, where glibc can be asked to."""
    option = _asked("mallopt")
    if option is not None:
        option(ARENA_MAX, 1)


@cache
def keep_freed_memory() -> None:
    """Have the C library keep what is freed at the end of its memory, up to twice `LARGEST_KEPT`.

    glibc decides so by the largest block that has been freed, up to that limit; this one is never written to
    and takes no memory. The first photograph that is freed has the same effect. Where the environment sets
    MALLOC_TRIM_THRESHOLD_, as for the workers of a batch, that applies.
    """
    bytes(LARGEST_KEPT)


@cache
def _asked(function: str) -> Callable[..., int] | None:
    """Return a function of the C library, None where it has no such function."""
    if sys.platform != "linux":
        return None
    found: Callable[..., int] | None = getattr(ctypes.CDLL(None), function, None)
    return found
