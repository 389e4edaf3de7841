"""Interface of an engine, which distributes the work of a batch over processes and computers.

A piece of work has parts, which run in parallel anywhere, and a whole, which is called with the results of
the parts. Functions get an additional keyword `send`, with which they report during their work.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

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


Event = Sent | Done | Lost


class Engine(Protocol):
    """Runs work in other processes."""

    @property
    def workers(self) -> int:
        """Number of calls that run at a time."""

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
