"""Adjustment of large networks in Helmert blocks, on a cluster or in processes of this computer.

Dask is imported by the function that needs it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

from sfm.model.arguments import checked_arguments
from sfm.model.errors import INSTALL_DASK, KolinearError, MissingLibraryError
from sfm.runtime.executor import Blocking, KeptHere, in_blocks

WITHIN_PYTHON = "helmert_blocks: cluster"


@checked_arguments()
def helmert_blocks(
    blocks: int | None = None, *, cluster: str | None = None, workers: int | None = None
) -> AbstractContextManager[None]:
    """Adjust large networks in Helmert blocks within a `with` statement.

    Estimates and covariances are those of the adjustment in one piece, to rounding. The blocks are computed
    by the workers of a Dask cluster, or in processes of this computer, or in this one if neither is given.
    With workers, a line on standard error says at the end how the largest network was adjusted, and why if
    not in blocks.

    Args:
        blocks: number of blocks of every network that can be cut; one for each thread of the workers if not
            given, and only of networks so large that blocks save time.
        cluster: address of a Dask scheduler, such as tcp://192.168.1.5:8786, whose workers have Kolinear.
        workers: number of worker processes on this computer, each with one thread. Processes are started anew
            and import the script that called, so the script must start them under
            `if __name__ == "__main__":`.

    Raises:
        KolinearError: no argument, both a cluster and workers, or a number below 1.
        MissingLibraryError: Dask is not installed.
        BackendError: the scheduler does not answer, or the processes do not start.

    Example:
        >>> import sfm
        >>> with sfm.helmert_blocks(2):
        ...     sfm.adjust(result.network, result.estimate).converged
        True

    Source: Helmert (1880); Wolf (1978), The Helmert block method, its origin and development.
    """
    if blocks is None and cluster is None and workers is None:
        raise KolinearError("helmert_blocks: neither blocks, cluster nor workers")
    if cluster is not None and workers is not None:
        raise KolinearError("helmert_blocks: workers are processes on this computer; a cluster has its own")
    for name, number in (("blocks", blocks), ("workers", workers)):
        if number is not None and number < 1:
            raise KolinearError(f"helmert_blocks: {name} {number}, expected at least 1")
    if cluster is None and workers is None:
        return in_blocks(Blocking(KeptHere(), blocks))
    return blocks_on_dask(blocks, cluster, workers)


@contextmanager
def blocks_on_dask(
    blocks: int | None, cluster: str | None, workers: int | None, *, option: str = WITHIN_PYTHON
) -> Iterator[None]:
    """Adjust in blocks in the workers of a cluster, or in processes of this computer.

    Args:
        blocks: see `helmert_blocks`.
        cluster: see `helmert_blocks`.
        workers: see `helmert_blocks`.
        option: what the user calls the address of the cluster, for messages.

    Raises:
        MissingLibraryError: Dask is not installed.
        BackendError: the scheduler does not answer, or the processes do not start.
    """
    try:
        from adapters import dask_cluster as dask
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("dask", "distributed"):
            raise
        raise MissingLibraryError(f"Helmert blocks: Dask is not installed: {INSTALL_DASK}") from None
    engine = dask.local_engine(workers or 1) if cluster is None else dask.remote_engine(cluster, option)
    with engine as keeper:
        blocking = Blocking(keeper, blocks)
        with in_blocks(blocking):
            yield
        if blocking.largest.line:
            keeper.say(blocking.largest.line)
