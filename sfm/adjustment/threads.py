"""Threads of the linear algebra during an adjustment, set on purpose and put back afterwards.

numpy and scipy bring a BLAS pool each; two pools that both spin on few cores cost 3 to 10 times what
they gain. The products and factorisations of an adjustment all go through scipy, so numpy's pool gets
one thread, and scipy's all of its own only for matrices large enough to share.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import LibController, ThreadpoolController

LARGE = 400  # reduced unknowns from which sharing a product between threads pays


@contextmanager
def blas_threads(reduced: int) -> Iterator[None]:
    """Set the threads of both BLAS pools for a system of so many reduced unknowns, then restore them."""
    before = [(pool, pool.num_threads) for pool in _pools()]
    try:
        for pool, threads in before:
            shared = reduced >= LARGE and "scipy" in (pool.filepath or "")
            pool.set_num_threads(threads if shared else 1)
        yield
    finally:
        for pool, threads in before:
            pool.set_num_threads(threads)


@cache
def _pools() -> tuple[LibController, ...]:
    """The BLAS libraries that are loaded; looked up once, because looking takes milliseconds."""
    return tuple(pool for pool in ThreadpoolController().lib_controllers if pool.user_api == "blas")
