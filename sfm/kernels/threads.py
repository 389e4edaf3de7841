"""Threads and processor cores of the process, used on purpose.

numpy and scipy bring a BLAS pool each, whose threads spin while they wait. On two cores 100 photographs took
464 ms with two threads and 219 ms with one, and a symmetric product of 6000 x 1208 took 160 against 129 ms:
both pools get one thread. Where two threads help, the work is cut into the same two parts whatever their
number, so that the results are the same to the last bit.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import TypeVar

from threadpoolctl import LibController, ThreadpoolController

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
