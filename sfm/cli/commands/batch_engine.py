"""Who does the work of a batch: Dask on this computer or elsewhere, or this process where it is missing."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from types import ModuleType

from sfm.errors import MissingLibraryError
from sfm.runtime.executor import Engine
from sfm.runtime.in_process import in_process_engine

INSTALL_DASK = "pip install 'dask[distributed]' cryptography, the extra kolinear[cluster]"


def batch_engine(
    busy: Callable[[], int], *, jobs: int | None, cluster: str | None, tell: Callable[[str], None]
) -> AbstractContextManager[Engine]:
    """Return the engine of a batch.

    Args:
        busy: returns how many calls can run at a time at most; more workers would wait for nothing.
        jobs: workers on this computer; as many as it bears if not given.
        cluster: address of a Dask scheduler in place of them.
        tell: is told in one line that surveys run one after the other, and why.

    Raises:
        MissingLibraryError: a scheduler is asked for, and Dask is not installed.
        BackendError: no scheduler answers at the address.
    """
    dask = _dask_cluster()
    if dask is None:
        if cluster is not None:
            raise MissingLibraryError(f"--cluster {cluster}: Dask is not installed: {INSTALL_DASK}")
        tell(f"Dask is not installed: surveys run one after the other in this process; {INSTALL_DASK}")
        return in_process_engine()
    engine: AbstractContextManager[Engine]
    if cluster is not None:
        engine = dask.remote_engine(cluster)
    else:
        engine = dask.local_engine(min(jobs or dask.fitting_workers(), busy()))
    return engine


def _dask_cluster() -> ModuleType | None:
    """Return the module that uses Dask, None where Dask is not installed."""
    try:
        from adapters import dask_cluster
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in ("dask", "distributed"):
            raise
        return None
    return dask_cluster
