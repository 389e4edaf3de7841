"""Whether kernels are being compiled, which takes a minute that a person wants to know of.

Numba itself reports when it begins to compile, and reports nothing when it takes a form that it has kept.

Source: numba, developer manual, "Notes on the event API", event numba:compile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core.event import Event, Listener, install_listener

COMPILING = (
    "kernels are compiled first, a minute or more, once (ahead of it: python -m sfm.warm_up, which takes "
    "the common ones)"
)


@contextmanager
def when_compiling(send: Callable[[], None]) -> Iterator[None]:
    """Call `send` when the first kernel of this program is compiled, in any thread of this process."""
    with install_listener("numba:compile", _First(send)):
        yield


class _First(Listener):
    """Hears of every kernel, reports the first."""

    def __init__(self, send: Callable[[], None]) -> None:
        self._send: Callable[[], None] | None = send

    def on_start(self, event: Event) -> None:
        """A function is compiled; those of numba and other libraries do not count."""
        module = event.data["dispatcher"].py_func.__module__ or ""  # none for what numba itself writes
        if self._send is not None and module.startswith("sfm."):
            send, self._send = self._send, None
            send()

    def on_end(self, event: Event) -> None:
        """The end is not reported."""
