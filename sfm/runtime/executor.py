"""Engine: what a batch needs of whoever spreads its work over processes and computers.

A piece of work has parts, which run side by side anywhere, and a whole, which is called with what the parts
returned. Functions are called with a further keyword `send`, with which they report while they work.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

Send = Callable[[dict[str, Any]], None]  # takes plain values only: text, numbers, lists


@dataclass(frozen=True)
class Call:
    """A function and what it is called with; both travel to other processes."""

    function: Callable[..., Any]  # of a module, not a lambda
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Work:
    """One piece of work."""

    key: str  # different for every piece of a run
    parts: tuple[Call, ...]
    whole: Call  # is given the list of the parts' results as last argument


@dataclass(frozen=True)
class Sent:
    """A function at work sent a message."""

    key: str
    message: dict[str, Any]


@dataclass(frozen=True)
class Done:
    """The whole of a piece of work returned."""

    key: str
    value: Any


@dataclass(frozen=True)
class Lost:
    """Workers died, again and again, on a piece of work or beside it, or it raised an unforeseen error."""

    key: str
    reason: str  # one line


Event = Sent | Done | Lost


class Engine(Protocol):
    """Runs work in other processes."""

    @property
    def workers(self) -> int:
        """How many calls run at a time."""

    def run(self, works: Iterable[Work], *, at_a_time: int) -> Iterator[Event]:
        """Run all work and yield what happens; `works` is drawn from as there is room for more.

        A KolinearError of a called function is raised here. If the iterator is closed, what has not begun is
        dropped.

        Raises:
            BackendError: no worker is left.
        """
