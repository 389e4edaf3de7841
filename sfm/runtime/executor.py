"""Interfaces of what distributes work over processes and computers: an engine of batches, a keeper of blocks.

A piece of work of a batch has parts, which run in parallel anywhere, and a whole, which is called with the
results of the parts. Functions get an additional keyword `send`, with which they report during their work.

The blocks of one large adjustment need their data again in every step. A keeper keeps the results of calls
where they were computed, and gives them to later calls there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

T = TypeVar("T")
Send = Callable[[dict[str, Any]], None]  # accepts only plain values: text, numbers, lists


@dataclass(frozen=True)
class Call:
    """A function and its arguments; both are sent to other processes."""

    function: Callable[..., Any]  # a function of a module, not a lambda
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Work:
    """One piece of work."""

    key: str  # unique for every piece of a run
    parts: tuple[Call, ...]
    whole: Call  # gets the list of the parts' results as its last argument


@dataclass(frozen=True)
class Sent:
    """A running function sent a message."""

    key: str
    message: dict[str, Any]


@dataclass(frozen=True)
class Done:
    """The whole of a piece of work returned."""

    key: str
    value: Any


@dataclass(frozen=True)
class Lost:
    """Workers died repeatedly on a piece of work or beside it, or it raised an unforeseen error."""

    key: str
    reason: str  # one line


@dataclass(frozen=True)
class WorkerLost:
    """A worker process was lost; what it was doing is done again by others."""

    worker: str  # its address


Event = Sent | Done | Lost | WorkerLost


class Engine(Protocol):
    """Runs work in other processes."""

    @property
    def workers(self) -> int:
        """Number of calls that run at a time."""

    @property
    def call_bytes(self) -> float:
        """Memory that a call may take, bytes; infinite where it is not limited."""

    def run(self, works: Iterable[Work], *, at_a_time: int) -> Iterator[Event]:
        """Run all work and yield the events; more of `works` is taken when there is room.

        A KolinearError of a called function is raised here. If the iterator is closed, work that has not
        begun is dropped.

        Args:
            works: pieces of work.
            at_a_time: number of pieces in progress at a time.

        Raises:
            BackendError: no worker is left.
        """


class Keeper(Protocol):
    """Runs calls in other processes, and keeps results there."""

    @property
    def workers(self) -> int:
        """Number of calls that run at a time."""

    def keep(self, calls: Iterable[Call]) -> list[Any]:
        """Start calls and return where their results are kept, in order.

        What is returned can be an argument of later calls, which get the result and run where it is. A result
        that is lost with its worker is computed again. It is dropped with the last reference to it.

        Args:
            calls: functions without side effects, and their arguments.
        """

    def each(self, calls: Iterable[Call]) -> Iterator[tuple[int, Any]]:
        """Yield the number and the result of each call, as they end.

        Raises:
            BackendError: the processes are gone, or died repeatedly.
        """

    def fetch(self, calls: Iterable[Call]) -> list[Any]:
        """Return the results of calls, in order.

        Raises:
            BackendError: the processes are gone, or died repeatedly.
        """


def itself(value: T) -> T:
    """Return a value: a call that brings it to other processes."""
    return value


class KeptHere:
    """Keeper that computes everything in this process, one call after the other."""

    workers = 1

    def keep(self, calls: Iterable[Call]) -> list[Any]:
        """Return the results of calls, see `Keeper.keep`."""
        return [call.function(*call.arguments) for call in calls]

    def each(self, calls: Iterable[Call]) -> Iterator[tuple[int, Any]]:
        """Yield the results of calls, see `Keeper.each`."""
        for number, call in enumerate(calls):
            yield number, call.function(*call.arguments)

    def fetch(self, calls: Iterable[Call]) -> list[Any]:
        """Return the results of calls, see `Keeper.fetch`."""
        return self.keep(calls)


@dataclass
class Largest:
    """How the largest network was adjusted while blocks were wanted."""

    image_points: int = 0
    line: str = ""

    def note(self, image_points: int, line: str) -> None:
        """Note how a network is adjusted, unless a larger one was before.

        Args:
            image_points: their number in the network.
            line: how it is adjusted, for the user.
        """
        if image_points >= self.image_points:
            self.image_points, self.line = image_points, line


@dataclass(frozen=True)
class Blocking:
    """How large networks are adjusted in blocks."""

    keeper: Keeper
    blocks: int | None = None  # number of blocks of every network; None: one a thread, where that saves time
    largest: Largest = field(default_factory=Largest)


_blocking: ContextVar[Blocking | None] = ContextVar("blocking", default=None)


def current_blocking() -> Blocking | None:
    """Return how networks are adjusted in blocks; None if they are adjusted in one piece."""
    return _blocking.get()


def other_processes() -> Keeper | None:
    """Return the keeper of several other processes; None if this process works alone."""
    blocking = current_blocking()
    return None if blocking is None or blocking.keeper.workers < 2 else blocking.keeper


@contextmanager
def in_blocks(blocking: Blocking) -> Iterator[None]:
    """Adjust networks in blocks, in the processes of a keeper."""
    token = _blocking.set(blocking)
    try:
        yield
    finally:
        _blocking.reset(token)
