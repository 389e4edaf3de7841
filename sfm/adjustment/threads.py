"""Threads of the linear algebra during an adjustment, set on purpose and put back afterwards.

numpy and scipy bring a BLAS pool each, whose threads spin while they wait. On two cores 100 photographs took
464 ms with two threads and 219 ms with one, and a symmetric product of 6000 x 1208 took 160 against 129 ms:
both pools get one thread.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import LibController, ThreadpoolController


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold both BLAS pools to one thread, then give them back what they had."""
    before = [(pool, pool.num_threads) for pool in _pools()]
    try:
        for pool, _ in before:
            pool.set_num_threads(1)
        yield
    finally:
        for pool, threads in before:
            pool.set_num_threads(threads)


@cache
def _pools() -> tuple[LibController, ...]:
    """The BLAS libraries that are loaded; looked up once, because looking takes milliseconds."""
    return tuple(pool for pool in ThreadpoolController().lib_controllers if pool.user_api == "blas")
