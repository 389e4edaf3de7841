"""An engine without processes: one call after the other, here, where no library for more is installed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from threadpoolctl import threadpool_limits

from sfm.errors import KolinearError, one_line
from sfm.runtime.executor import Call, Done, Event, Lost, Told, Work


class InProcess:
    """Runs one piece of work after the other in this process, see sfm.runtime.executor.Engine.

    What a call tells is passed on when it has returned.
    """

    workers = 1

    def run(self, works: Iterable[Work], *, at_a_time: int) -> Iterator[Event]:
        """Run all work and yield what happens; one call at a time, whatever is asked for.

        Raises:
            KolinearError: what a called function raised.
        """
        for work in works:
            try:
                parts = []
                for part in work.parts:
                    value, said = _called(part)
                    yield from (Told(work.key, message) for message in said)
                    parts.append(value)
                value, said = _called(work.whole, parts)
            except KolinearError:
                raise
            except Exception as error:
                yield Lost(work.key, f"it failed: {type(error).__name__}: {one_line(error)}")
                continue
            yield from (Told(work.key, message) for message in said)
            yield Done(work.key, value)


@contextmanager
def in_process_engine() -> Iterator[InProcess]:
    """Give an engine that works in this process."""
    yield InProcess()


def _called(call: Call, *more: Any) -> tuple[Any, list[dict[str, Any]]]:
    """Return what a call returns and what it has told.

    BLAS is held to one thread as in a worker: sums of several threads differ in the last bit.
    """
    said: list[dict[str, Any]] = []
    with threadpool_limits(limits=1):
        return call.function(*call.arguments, *more, tell=said.append), said
