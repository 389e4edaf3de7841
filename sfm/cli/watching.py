"""The work of `--watch`: a folder is run again whenever photographs are added to it."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from sfm.cli.process import FAILED
from sfm.model.display import counted, listed
from sfm.model.errors import KolinearError

if TYPE_CHECKING:
    from sfm.judgement.survey_result import SurveyResult

POLL_S = 1.0  # between two looks at the folder; a file that did not change in between is complete
State = dict[Path, tuple[int, int]]  # size and time of change of each photograph


@dataclass
class WatchedSurvey:
    """What a command makes of a folder of photographs, in one run or in several while it is watched."""

    is_watched: bool = False
    until: float = 0.0  # uncertainty at which watching ends
    result: SurveyResult | None = None  # of the last run; None if there was none
    drafted: bool = False  # whether the survey file of this run was drafted just now
    own: dict[Path, bytes] = field(default_factory=dict)  # files drafted here, the survey file first
    is_dependable: bool = False  # the last result

    def so_far(self) -> Iterator[str]:
        """Yield what is known so far, and what to photograph next; nothing of a survey that plans nothing."""
        yield from ()

    def uncertainty(self) -> float:
        """Return the uncertainty that is compared with `until`; NaN, which none reaches, if not known."""
        return math.nan

    def begin(self) -> bool:
        """Prepare a run; return whether its survey file was drafted here before, and stays.

        A draft whose result was not dependable is of photographs that did not suffice; it is removed, unless
        somebody changed it.
        """
        file = next(iter(self.own), None)
        if file is not None and (not file.exists() or not (self.is_dependable or self._is_changed(file))):
            for path in self.own:
                if path.exists() and not self._is_changed(path):
                    path.unlink()
            self.own.clear()
        self.result, self.is_dependable, self.drafted = None, False, False
        return bool(self.own)

    def note_drafted(self, written: tuple[Path, ...]) -> None:
        """Note the files that were drafted for this run, the survey file first."""
        self.drafted = bool(written)
        if written:
            self.own = {path: path.read_bytes() for path in written}

    def _is_changed(self, path: Path) -> bool:
        return path.read_bytes() != self.own[path]


def run_or_watch(photographs: Path, run: Callable[[], None], product: WatchedSurvey) -> None:
    """Run a survey once, or whenever photographs are added if it is watched; see `watch`."""
    if product.is_watched:
        watch(photographs, run, product)
    elif product.until:
        raise KolinearError(f"--until {product.until:g} is for --watch")
    else:
        run()


def watch(photographs: Path, run: Callable[[], None], product: WatchedSurvey) -> None:
    """Run a folder again whenever photographs are added, until the wanted uncertainty is reached or Ctrl-C.

    Args:
        photographs: the folder.
        run: runs it once.
        product: what is made of it.

    Raises:
        KolinearError: there is no such folder, or it has videos in place of photographs.
        SystemExit: with the exit code of the last round, if it is stopped before.
    """
    if not photographs.is_dir():
        raise KolinearError(f"{photographs}: --watch needs a folder of photographs")
    from sfm.products.drafting.frames_folder import videos_of

    if videos_of(photographs):
        raise KolinearError(f"{photographs}: --watch needs a folder of photographs, this one has videos")
    print(f"Watching {photographs}; Ctrl-C ends it", file=sys.stderr)
    code: str | int | None = FAILED  # until a round succeeds
    waiting: tuple[str, ...] = ()  # photographs of rounds that gave no result
    try:
        for new in arrivals(photographs):
            waiting = tuple(dict.fromkeys((*waiting, *new)))
            try:
                run()
                code = 0
            except KolinearError as error:
                code = FAILED
                print(f"not yet: {error}", flush=True)
                continue
            except SystemExit as end:
                code = end.code
            new = tuple(name for name in waiting if (photographs / name).exists())
            for line in _brought(new, product):
                print(line, flush=True)
            if product.result is not None:
                waiting = ()
            if product.is_dependable and product.uncertainty() <= product.until:
                return
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
    if code:
        raise SystemExit(code)


def arrivals(folder: Path) -> Iterator[tuple[str, ...]]:
    """Yield the names of photographs that were added to a folder or changed, once all are complete."""
    from sfm.photographs.reading import SUFFIXES

    used, before = State(), State()
    while True:
        now = State()
        for path in sorted(folder.iterdir()):
            with suppress(FileNotFoundError):  # it may be removed meanwhile
                if path.suffix.lower() in SUFFIXES and path.is_file():
                    stat = path.stat()
                    now[path] = stat.st_size, stat.st_mtime_ns
        new = tuple(path.name for path, state in now.items() if used.get(path) != state)
        if new and now == before:
            used = now
            yield new
        before = now
        time.sleep(POLL_S)


def _brought(new: tuple[str, ...], product: WatchedSurvey) -> Iterator[str]:
    """Yield what new photographs brought, and what is known so far."""
    if product.result is None:
        yield f"{counted(len(new), 'new photograph')}: {listed(new)}"
        return
    network = product.result.network
    accepted = ~product.result.adjustment.rejected
    reasons = {failed.image: failed.reason for failed in product.result.failed}
    for name in new:
        if name in network.images:
            rows = network.image_points.image == network.images.index(name)
            yield f"{name}: used, {counted(int((rows & accepted).sum()), 'image point')}"
        elif name in reasons:
            yield f"{name}: not used. {reasons[name].text}"
        else:
            yield f"{name}: not used. The survey file does not name it; remove that file to draft it anew"
    yield from product.so_far()
