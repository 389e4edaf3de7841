"""Dask as the engine of batches and the keeper of blocks: a cluster on this computer, or a running scheduler.

Source: dask.distributed, Client futures API (https://distributed.dask.org/en/stable/client.html).
"""

from __future__ import annotations

import asyncio
import gc
import logging
import math
import queue
import signal
import sys
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, fields, is_dataclass
from importlib import import_module
from itertools import count
from multiprocessing import resource_tracker
from threading import Lock
from typing import Any

import dask
import dask.system
import distributed.system
import numpy as np
from dask.distributed import (
    Client,
    Future,
    KilledWorker,
    LocalCluster,
    Worker,
    WorkerPlugin,
    get_worker,
)
from distributed.core import rpc
from distributed.security import Security
from threadpoolctl import threadpool_limits

from sfm.files.user_cache import scratch_folder
from sfm.model.errors import BackendError, KolinearError
from sfm.runtime.executor import Call, Done, Event, Lost, Sent, Work, WorkerLost

# Worker deaths that Dask allows a call: one may be bad luck, and the call is tried on another worker.
ALLOWED_FAILURES = 1
WORKER_BYTES = 3 << 29  # 1.5 GiB, which a photograph of 100 megapixels may need
CONNECT_SECONDS = 5.0
NOBODY_SECONDS = 60.0  # without any worker before a run gives up; starting a new one takes about 3 s
LOOK_SECONDS = 2.0
CLOSE_SECONDS = 5.0
EVERYTHING = "all"  # topic of what happens to workers
BATCH_AGAIN, ADJUSTMENT_AGAIN = "run again with --resume", "run again, the result will be the same"
DIED = "worker processes died, out of memory or by a fault in a library"
# Numerical libraries read these thread limits when a process starts.
ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMBA_NUM_THREADS",
        "OPENCV_FOR_THREADS_NUM",
    ),
    "1",
)
# Records that Dask keeps for its dashboard, which is not shown here. Call stacks are sampled 100 times a
# second in each worker and kept for 1000 s, which took 1.1 MiB a survey. Its logs grow for the first hundreds
# of surveys.
NO_DIARY = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.low-level-log-length": 100,
    "distributed.admin.system-monitor.log-length": 60,
}
# Web pages, which would show the computed data to anybody on this computer.
NO_PAGES: dict[str, list[str]] = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}


def fitting_workers(needed_bytes: float = 0.0) -> int:
    """Return how many workers the available cores and memory of this computer allow.

    Args:
        needed_bytes: memory of the largest call, bytes; `WORKER_BYTES` at least are taken for it.
    """
    memory = int(distributed.system.MEMORY_LIMIT // max(WORKER_BYTES, needed_bytes))
    return max(1, min(dask.system.CPU_COUNT, memory))


@contextmanager
def local_engine(workers: int) -> Iterator[DaskEngine]:
    """Start worker processes on this computer, each with one thread.

    Anybody who reaches a Dask scheduler or worker can run programs in it, and everybody on this computer
    reaches 127.0.0.1. The processes therefore use TLS with the key of this run, which exists only in their
    memory. Data that workers spill to disk goes to a folder of this user alone.

    Args:
        workers: number of workers; each is stopped if it exceeds an equal share of the computer's memory.

    Raises:
        BackendError: they do not start.
    """
    _silence()
    settings = {
        "distributed.scheduler.allowed-failures": ALLOWED_FAILURES,
        "distributed.scheduler.work-stealing": True,
        **NO_DIARY,
        **NO_PAGES,
        "distributed.nanny.pre-spawn-environ": {
            **ONE_THREAD,
            "MALLOC_TRIM_THRESHOLD_": "65536",
            "MALLOC_ARENA_MAX": "2",
        },
        "distributed.comm.timeouts.connect": "60s",  # new workers compile and import on a busy computer
        "distributed.deploy.lost-worker-timeout": "1h",  # a worker that takes long to restart is kept, too
    }
    with dask.config.set(settings), ExitStack() as stack:
        scratch = stack.enter_context(scratch_folder())
        with _interrupt_held_back():  # a Ctrl-C is delivered when all of this has started and can be ended
            try:
                cluster = LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=distributed.system.MEMORY_LIMIT // max(workers, 1),
                    host="127.0.0.1",
                    dashboard_address="127.0.0.1:0",  # None opens a server on a fixed port to the world
                    scheduler_kwargs={"dashboard": False},
                    silence_logs=logging.CRITICAL,
                    security=Security.temporary(),
                    local_directory=str(scratch),
                )
            except (ImportError, OSError, RuntimeError, TimeoutError) as error:
                raise BackendError(
                    f"{workers} worker processes cannot be started: {_line(error).rstrip('.')}; "
                    'a script must start them under if __name__ == "__main__":'
                ) from error
            stack.callback(_close, cluster)
            stack.enter_context(cluster)
            client = stack.enter_context(Client(cluster))
            client.register_plugin(_LocalWorker())
            # it would still list its pages, even if it does not show them
            client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.http_server.stop())
        yield stack.enter_context(_engine_of(client))


def _silence() -> None:
    """Keep Dask's messages and tracebacks out of the terminal; some of its loggers have separate levels."""
    for name in ("distributed", *logging.root.manager.loggerDict):
        if name.split(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)


def _close(cluster: LocalCluster) -> None:
    """Close a cluster that was not closed normally."""
    with suppress(Exception):
        cluster.close(timeout=CLOSE_SECONDS)


@contextmanager
def _interrupt_held_back() -> Iterator[None]:
    """Block Ctrl-C, which reaches all processes of a terminal, here and in processes started meanwhile.

    Threads and processes started inside never receive it: the process that starts the workers ends them.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows, where the plug-in ignores the signal instead
        yield
        return
    resource_tracker.ensure_running()  # starts with the first process, and would unblock Ctrl-C
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def remote_engine(address: str, option: str) -> AbstractContextManager[DaskEngine]:
    """Use a running scheduler, which must have Kolinear, with workers that have it and the same folders.

    Args:
        address: such as tcp://192.168.1.5:8786. Anybody who reaches a scheduler can run programs on its
            workers, so it belongs in a trusted network. For tls:// Dask's configuration names the
            certificates.
        option: what the user calls the address, for messages.

    Raises:
        BackendError: no scheduler answers, or a certificate cannot be read; this is checked before anything
            else starts.
    """
    _silence()
    security = Security()
    try:
        credentials = security.get_connection_args("client")
    except OSError as error:  # of a missing file, or of one that is no certificate; neither names it
        named = {file: None for file in security.get_tls_config_for_role("client").values() if file}
        raise BackendError(
            f"{option} {address}: a certificate of Dask's configuration cannot be read: "
            f"{', '.join(named)} ({_line(error)})"
        ) from error
    try:
        # A Client that cannot connect keeps trying, and reports it half a minute later. The thread of a
        # notebook already runs an event loop, so the question has a thread of its own.
        with ThreadPoolExecutor(max_workers=1) as thread:
            thread.submit(asyncio.run, _ask(address, credentials)).result()
    except TimeoutError as error:
        raise BackendError(
            f"{option} {address}: no Dask scheduler answers within {CONNECT_SECONDS:.0f} s"
        ) from error
    # RuntimeError: the address is without encryption, and Dask's configuration requires it
    except (OSError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise BackendError(f"{option} {address}: no Dask scheduler answers ({_line(error)})") from error
    return _connected(address, option)


async def _ask(address: str, credentials: dict[str, Any]) -> None:
    """Ask the server at an address whether it is a scheduler; ValueError if not."""
    async with (
        asyncio.timeout(CONNECT_SECONDS),
        rpc(address, timeout=CONNECT_SECONDS, connection_args=credentials) as server,
    ):
        kind = (await server.identity())["type"]
    if kind != "Scheduler":
        raise ValueError(f"it is a {kind}")


@contextmanager
def _connected(address: str, option: str) -> Iterator[DaskEngine]:
    try:
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TypeError, TimeoutError) as error:
        raise BackendError(f"{option} {address}: no Dask scheduler answers ({_line(error)})") from error
    with client:
        try:  # it reads the work that it hands out, and Dask's error about that has several lines
            client.run_on_scheduler(import_module, __name__)
            for answer in client.run(import_module, __name__, on_error="return").values():
                if isinstance(answer, ImportError):  # a worker would end by it, without a word
                    raise answer
        except ImportError as error:
            raise BackendError(
                f"{option} {address}: scheduler and workers of a cluster need Kolinear: {_line(error)}"
            ) from error
        with _engine_of(client) as engine:
            yield engine


@contextmanager
def _engine_of(client: Client) -> Iterator[DaskEngine]:
    """Return the engine of a cluster, which learns of the workers that are lost."""
    engine = DaskEngine(client)

    def note(event: tuple[float, dict[str, Any]]) -> None:
        if event[1].get("action") == "remove-worker" and not event[1]["expected"]:
            engine.losses.put(str(event[1]["worker"]))

    client.subscribe_topic(EVERYTHING, note)
    try:
        yield engine
    finally:
        with suppress(Exception):  # a scheduler that is gone cannot be asked
            client.unsubscribe_topic(EVERYTHING)


class _LocalWorker(WorkerPlugin):
    """Makes workers ignore Ctrl-C where signals cannot be blocked, and stops their web pages."""

    name = "kolinear-local-worker"

    def setup(self, worker: Worker) -> None:
        """Run in every worker that starts, including the replacement of one that died."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        worker.http_server.stop()


def _to_standard_error(line: str) -> None:
    print(line, file=sys.stderr)


@dataclass(frozen=True)
class DaskEngine:
    """Runs work in the processes of a Dask cluster, and keeps results there."""

    client: Client
    losses: queue.SimpleQueue[str] = field(default_factory=queue.SimpleQueue)  # workers that were lost
    say: Callable[[str], None] = _to_standard_error  # receives a line for each worker lost by a keeper

    @property
    def workers(self) -> int:
        """Number of calls that run at a time, at least 1 while workers are still starting."""
        threads: dict[str, int] = self.client.nthreads()
        return max(1, sum(threads.values()))

    @property
    def call_bytes(self) -> float:
        """Memory of the largest worker, bytes, beyond which it is ended; infinite if unlimited or unknown."""
        try:
            workers = self.client.scheduler_info(n_workers=-1)["workers"].values()
        except OSError:  # the scheduler is gone, which the run will state
            return math.inf
        limits = [float(worker.get("memory_limit") or math.inf) for worker in workers]
        return max(limits, default=math.inf)

    def run(self, works: Iterable[Work], *, at_a_time: int) -> Iterator[Event]:
        """Run all work and yield its events, see sfm.runtime.threads.Engine.

        Raises:
            BackendError: the scheduler or all workers are gone, or the workers lack Kolinear.
            KolinearError: an error raised by a called function.
        """
        events: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        run = f"kolinear-{uuid.uuid4().hex}"
        running: dict[str, list[Future[Any]]] = {}  # the future of the whole work comes first
        left, turn = iter(works), count()

        def start(work: Work) -> None:
            futures = self._submit(work, run, priority=-next(turn))
            running[work.key] = futures
            futures[0].add_done_callback(lambda _, key=work.key: events.put(("done", key)))

        self.client.subscribe_topic(run, lambda event: events.put(("sent", event[1])))
        someone = time.monotonic()
        try:
            while True:
                while len(running) < at_a_time and (work := next(left, None)) is not None:
                    start(work)
                for worker in self._lost_workers():
                    yield WorkerLost(worker)
                if not running:
                    return
                try:
                    kind, what = events.get(timeout=LOOK_SECONDS)
                    someone = time.monotonic()
                except queue.Empty:
                    someone = self._last_seen(someone, BATCH_AGAIN)
                    continue
                if kind == "sent":
                    yield Sent(what["key"], what["message"])
                else:
                    yield _event(what, running.pop(what)[0])
        finally:
            with suppress(Exception):  # a scheduler that is gone cannot be asked to stop
                self.client.cancel([future for futures in running.values() for future in futures], force=True)
                self.client.unsubscribe_topic(run)

    def _submit(self, work: Work, run: str, *, priority: int) -> list[Future[Any]]:
        """Submit the parts of a piece of work and then the whole, which comes first in the list.

        Keys do not contain the name of the work: the scheduler remembers the text before the digits forever.
        """

        def submit(call: Call, name: str, *more: Any) -> Future[Any]:
            return self.client.submit(
                _call,
                call,
                *more,
                topic=run,
                work=work.key,
                key=f"{name}-{uuid.uuid4().hex}",
                priority=priority,
                pure=False,
            )

        parts = [submit(part, "part") for part in work.parts]
        return [submit(work.whole, "whole", parts), *parts]

    def keep(self, calls: Iterable[Call]) -> list[Future[Any]]:
        """Start calls and return where their results are kept, see sfm.runtime.executor.Keeper."""
        return self._start(_kept, calls)

    def _start(self, way: Callable[..., Any], calls: Iterable[Call]) -> list[Future[Any]]:
        """Submit calls that are made in some way.

        Dask gives those that take nothing kept to one idle worker after the other, and lets all others follow
        their data. A preferred worker cannot be stated: if all have died, Dask waits for that one forever.
        """
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": f"{sys.maxsize}B"}):
            return [
                self.client.submit(
                    way, call.function, *call.arguments, key=f"block-{uuid.uuid4().hex}", pure=False
                )
                for call in calls
            ]

    def each(self, calls: Iterable[Call]) -> Iterator[tuple[int, Any]]:
        """Yield the number and the result of each call as they end, see sfm.runtime.executor.Keeper.

        Raises:
            BackendError: the scheduler or all workers are gone, workers died repeatedly, or lack Kolinear.
            KolinearError: an error raised by a called function.
        """
        with _in_words():
            futures = self._start(_in_one_thread, calls)
            for number in self._as_they_end(futures):
                result = futures[number].result()
                futures[number].release()  # its worker need not hold it any longer
                yield number, result

    def fetch(self, calls: Iterable[Call]) -> list[Any]:
        """Return the results of calls in their order, see sfm.runtime.executor.Keeper.

        Raises:
            BackendError: see `each`.
            KolinearError: see `each`.
        """
        with _in_words():
            futures = self._start(_in_one_thread, calls)
            for _ in self._as_they_end(futures):
                pass
            return list(self.client.gather(futures))

    def _as_they_end(self, futures: list[Future[Any]]) -> Iterator[int]:
        """Yield the numbers of futures as they end, and say which workers are lost meanwhile."""
        done: queue.SimpleQueue[int] = queue.SimpleQueue()
        for number, future in enumerate(futures):
            future.add_done_callback(lambda _, number=number: done.put(number))
        someone, left = time.monotonic(), len(futures)
        while left:
            # not Dask's `wait`: its TimeoutError keeps what the calls took until Python finds the cycle
            try:
                number = done.get(timeout=LOOK_SECONDS)
            except queue.Empty:
                someone = self._last_seen(someone, ADJUSTMENT_AGAIN)
            else:
                someone, left = time.monotonic(), left - 1
                yield number
            for worker in self._lost_workers():
                self.say(f"worker {worker} was lost; the others do its work again")

    def _lost_workers(self) -> Iterator[str]:
        """Yield the workers that were lost since the last look."""
        with suppress(queue.Empty):
            while True:
                yield self.losses.get_nowait()

    def _last_seen(self, someone: float, again: str) -> float:
        """Return when a worker was last seen at work; raise BackendError if that is too long ago."""
        try:
            if self.client.status not in ("running", "connecting"):
                raise BackendError(f"the Dask scheduler is gone; {again}")
            workers = self.client.scheduler_info(n_workers=-1)["workers"]
            busy = {address for address, keys in self.client.processing().items() if keys}
        except OSError as error:
            raise BackendError(f"the Dask scheduler is gone; {again}") from error
        # one that is paused keeps its work, but does not begin it
        if any(address in busy and worker["status"] == "running" for address, worker in workers.items()):
            return time.monotonic()
        if time.monotonic() - someone > NOBODY_SECONDS:
            if not workers:
                raise BackendError(f"the Dask scheduler has had no worker for {NOBODY_SECONDS:.0f} s")
            raise BackendError(
                f"no worker of the cluster has worked for {NOBODY_SECONDS:.0f} s: their memory is full, and "
                "nothing more can be moved to their disks"
            )
        return someone


@contextmanager
def _in_words() -> Iterator[None]:
    """Raise the errors of Dask as `BackendError`, in one line."""
    try:
        yield
    except CancelledError as error:
        raise BackendError(
            f"the Dask scheduler is gone or has dropped the work; {ADJUSTMENT_AGAIN}"
        ) from error
    except KilledWorker as error:
        raise BackendError(f"{DIED}, at a part of the survey; use more workers, or more memory") from error
    except ImportError as error:
        raise BackendError(f"the workers of the cluster lack what Kolinear needs: {_line(error)}") from error


def _call(call: Call, parts: list[Any] | None = None, *, topic: str, work: str) -> Any:
    """Run a call in a worker, with its libraries limited to one thread each."""
    worker = get_worker()

    def send(message: dict[str, Any]) -> None:
        worker.log_event(topic, {"key": work, "message": message})

    more = () if parts is None else (parts,)
    try:
        with _HELD:
            return call.function(*call.arguments, *more, send=send)
    finally:
        if parts is not None:
            gc.collect()  # figures are full of reference cycles, which Python collects late: 1 MiB a survey


def _in_one_thread(function: Callable[..., Any], *arguments: Any) -> Any:
    """Run a call of a keeper in a worker, with its libraries limited to one thread each."""
    with _HELD:
        return function(
            *(argument.value if isinstance(argument, _Kept) else argument for argument in arguments)
        )


def _kept(function: Callable[..., Any], *arguments: Any) -> _Kept:
    """Run a call of a keeper in a worker, whose result stays there."""
    return _Kept(_in_one_thread(function, *arguments))


@dataclass(frozen=True)
class _Kept:
    """A result that stays in its worker, with its size: Dask takes that of a dataclass for some bytes.

    It would let another worker copy the result to compute on it, and never move it to the disk.
    """

    value: Any

    def __sizeof__(self) -> int:
        """Return the bytes of all arrays in the value."""
        return _bytes_of(self.value)


def _bytes_of(value: Any) -> int:
    """Return the bytes of the arrays in a value and in its fields and elements."""
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if is_dataclass(value):
        return sum(_bytes_of(getattr(value, one.name)) for one in fields(value))
    if isinstance(value, tuple | list):
        return sum(map(_bytes_of, value))
    return sys.getsizeof(value)


class _OneThread:
    """Limits BLAS and OpenCV to one thread, including in workers that were started elsewhere.

    Such workers may have several threads; the last running call restores the limits of the libraries.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._calls = 0
        self._limits: threadpool_limits | None = None

    def __enter__(self) -> None:
        import cv2

        with self._lock:
            cv2.setNumThreads(1)
            self._calls += 1
            if self._limits is None:
                self._limits = threadpool_limits(limits=1)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._calls -= 1
            if not self._calls and self._limits is not None:
                self._limits.restore_original_limits()
                self._limits = None


_HELD = _OneThread()  # limits of this process


def _event(key: str, future: Future[Any]) -> Event:
    """Return how a piece of work ended, or raise an error that ends all work.

    A result lost with its worker before it arrives here is computed again, and may then fail.
    """
    try:
        return Done(key, future.result())
    except CancelledError as error:
        raise BackendError(f"the Dask scheduler is gone or has dropped the work; {BATCH_AGAIN}") from error
    except KilledWorker:
        return Lost(key, DIED)
    except KolinearError:
        raise
    except ImportError as error:
        raise BackendError(f"the workers of the cluster lack what Kolinear needs: {_line(error)}") from error
    except Exception as error:
        return Lost(key, f"it failed in its worker: {type(error).__name__}: {_line(error)}")


def _line(error: BaseException | None) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
