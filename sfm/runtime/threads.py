"""Threads and processor cores of the process, limited to where they help.

numpy and scipy each bring a BLAS pool, whose threads spin while they wait. On two cores, 100 photographs took
464 ms with two threads and 219 ms with one, and a symmetric product of 6000 x 1208 took 160 against 129 ms.
Both pools are therefore given one thread. Where two threads help, the work is always divided into the same
two parts, so the results are equal to the last bit for any number of threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import TypeVar

from threadpoolctl import LibController, ThreadpoolController, threadpool_limits

S = TypeVar("S")
T = TypeVar("T")
_second: ContextVar[ThreadPoolExecutor | None] = ContextVar("second", default=None)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit BLAS to one thread: photographs are processed in parallel, and BLAS pools would compete."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


@contextmanager
def own_threads(threads: int | None = None) -> Iterator[None]:
    """Limit both BLAS pools to one thread, and restore their numbers of threads afterwards.

    If more threads are available, `at_once` can meanwhile use a second one, also within nested calls.

    Args:
        threads: number of threads available; by default the number that the pools had.
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


def at_once(first: Callable[[], T], other: Callable[[], T]) -> tuple[T, T]:
    """Return the results of two functions; they run at the same time if a second thread is available."""
    second = _second.get()
    if second is None:
        return first(), other()
    running = second.submit(other)
    try:
        result = first()
    finally:
        running.exception()  # wait for its end, even if the first failed
    return result, running.result()


def in_threads(function: Callable[[S], T], items: Sequence[S], threads: int) -> Iterator[T]:
    """Yield the result of a function for each item, in order, with up to `threads` of them at a time.

    It is faster only if the function spends its time in compiled code.
    """
    if threads < 2 or len(items) < 2:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(function, items)


@cache
def _pools() -> tuple[LibController, ...]:
    """Return the loaded BLAS libraries; they are looked up once, because this takes milliseconds."""
    return tuple(pool for pool in ThreadpoolController().lib_controllers if pool.user_api == "blas")


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
