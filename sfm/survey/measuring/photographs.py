"""Working through the photographs of a survey, side by side, whatever single ones of them are like."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from sfm.display import counted, listed
from sfm.errors import GeometryError, PhotographError
from sfm.remarks.remark import remark
from sfm.result import FailedImage
from sfm.runtime.faults import working_on
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.inputs.photograph_list import PhotographList
from sfm.survey.measuring.measured_store import content_hash

T = TypeVar("T")
MIN_PHOTOGRAPHS = 2
MAX_TOLD = 5  # photographs that a message names


def each_photograph(
    photographs: PhotographList,
    work: Callable[[Path], T],
    *,
    picture: Callable[[T], bytes] | None = None,
    jobs: int = 1,
    progress: Progress = SILENT,
) -> tuple[dict[int, T], tuple[FailedImage, ...]]:
    """Do something with every photograph, and return what came of each that could be read.

    One that cannot be read does not stop the others; it is named with the reason, as is one whose file is a
    copy of another.

    Args:
        photographs: the files.
        work: what is done with a file; PhotographError gives the reason why it cannot be read.
        picture: what identifies the picture in its result, as a copy that was saved again
            has other bytes; empty where nothing does.
        jobs: how many photographs are worked on at a time.
        progress: informed of every photograph.

    Returns:
        The results of the photographs by their number, and those without, in their order.

    Raises:
        GeometryError: fewer than two readable photographs.
    """
    found: dict[int, T] = {}
    failed: dict[int, FailedImage] = {}
    originals = []
    for k, (name, first) in enumerate(zip(photographs.names, find_copies(photographs), strict=True)):
        if first == k:
            originals.append(k)
        else:
            original = photographs.names[first]
            failed[k] = FailedImage(name, remark("copy_of_file", original=original))
            progress.advance(name)

    def work_on(k: int) -> T:
        with working_on(f"photograph {photographs.names[k]}"):
            return work(photographs.paths[k])

    with ThreadPoolExecutor(max_workers=max(1, jobs)) as pool:
        running = {pool.submit(work_on, k): k for k in originals}
        try:
            for done in as_completed(running):
                k = running[done]
                try:
                    found[k] = done.result()
                except PhotographError as error:
                    reason = why_failed(error, photographs.paths[k])
                    failed[k] = FailedImage(
                        photographs.names[k], remark("photograph_unreadable", reason=reason)
                    )
                progress.advance(photographs.names[k])
        except BaseException:  # Ctrl-C among them: no one waits for photographs that are not begun
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    pictures: dict[bytes, int] = {}
    for k in sorted(found):
        shown = b"" if picture is None else picture(found[k])
        first = pictures.setdefault(shown, k) if shown else k
        if first != k:
            original = photographs.names[first]
            failed[k] = FailedImage(photographs.names[k], remark("copy_of_picture", original=original))
            del found[k]
    in_order = tuple(failed[k] for k in sorted(failed))
    if len(found) < MIN_PHOTOGRAPHS:
        raise GeometryError(
            f"{counted(len(found), 'readable photograph')}, "
            f"at least {MIN_PHOTOGRAPHS} are needed{in_brackets(in_order)}"
        )
    return found, in_order


def find_copies(photographs: PhotographList) -> tuple[int, ...]:
    """Return for every photograph the first one whose file has the same bytes, itself where there is none.

    A copy is no second observation: it would only make the result look more precise than it is.
    """
    first = list(range(len(photographs)))
    seen: dict[tuple[int, str], int] = {}
    sizes = [path.stat().st_size if path.is_file() else 0 for path in photographs.paths]
    number = Counter(sizes)
    for k, path in enumerate(photographs.paths):
        if sizes[k] and number[sizes[k]] > 1:
            with suppress(PhotographError):  # a file that cannot be read is reported where it is measured
                first[k] = seen.setdefault((sizes[k], content_hash(path)), k)
    return tuple(first)


def why_failed(error: PhotographError, path: Path) -> str:
    """Return why a photograph cannot be read, without its name, which is beside the reason."""
    return str(error).removeprefix(f"{path.name}: ")


def in_brackets(failed: Sequence[FailedImage]) -> str:
    """Return which photographs could not be read and why, the first of many, to follow a message."""
    if not failed:
        return ""
    named = (f"{one.image}: {one.reason.text.rstrip('.')}" for one in failed)
    return f" ({listed(named, most=MAX_TOLD, separator='; ')})"
