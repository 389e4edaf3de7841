"""Times what users wait for in one run, beside its rivals and an older checkout: `make bench`.

    python -m benchmarks.table [--quick] [--data FOLDER] [--before CHECKOUT] [--repeat N]

Rows of surveys are whole commands, from `kolinear run` to the report: processor time of all processes, and
wall time; nothing is measured before. Their rival is COLMAP on the same photographs: extraction, exhaustive
matching, incremental mapping with one camera. Rows of overlap and adjustments are warm calls; their rivals
are the search by COLMAP's vocabulary tree, without its training, and the best-tuned Ceres of pycolmap. FOLDER
has real photographs, a folder each: retro-panel, camcal, fountain ... CHECKOUT is another checkout with an
environment of its own, whose command is run in turn. Times are medians of N runs.

The table is printed, and kept in benchmarks/results.md with the commit and the machine. Only the ratios
within one run are meaningful, on a machine that does nothing else. A row that has become slower by 5 % is a
defect.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from itertools import chain
from pathlib import Path

from benchmarks.adjustment import CASES, SOLVERS, reconstruction, run_adjust, timed, timed_ceres
from benchmarks.overlap import ask_colmap, take_photographs
from benchmarks.textured_scenes import render_scene
from sfm.matching.tracks.overlap import compare_photographs
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.runtime.threads import own_threads

ROOT = Path(__file__).parent.parent
KEPT = Path(__file__).with_name("results.md")
WORK = ROOT / "build"
SURVEYS = ("retro-panel", "camcal")  # of targets; the survey files are in datasets/
TEXTURES = ("fountain", "entry", "castle", "herzjesu", "fox10")
QUICK = ("20 / 100", "60 / 500")  # ends of the names of adjustments
OVERLAPPING = (100, 400)  # photographs among which those that overlap are searched
HEADS = ("work", "s", "wall s", "before, s", "rival, s", "before / now", "rival / now")
COLMAP = (
    "import sys; from pathlib import Path; from adapters.colmap.mapper import map_photographs; "
    "folder = Path(sys.argv[1]); "
    "names = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in ('.png', '.jpg')); "
    "map_photographs(folder, (tuple(names),))"
)


@dataclass(frozen=True)
class Row:
    """A row of the table; NaN where there is nothing."""

    work: str
    seconds: float  # of the processor
    wall: float = float("nan")
    before: float = float("nan")  # of the older checkout
    rival: float = float("nan")

    def cells(self) -> list[str]:
        """Return the cells of the row."""
        ratios = [self.before / self.seconds, self.rival / self.seconds]
        numbers = [self.seconds, self.wall, self.before, self.rival]
        return [
            self.work,
            *(_shown(number, 3) for number in numbers),
            *(_shown(ratio, 2) for ratio in ratios),
        ]


def main() -> None:
    """Print the table, and keep it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--quick", action="store_true", help="a minute, for a first look")
    parser.add_argument("--data", type=Path, help="folder of real photographs, a folder each")
    parser.add_argument("--before", type=Path, help="older checkout with an environment")
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    repeat = 1 if options.quick else options.repeat
    lines = [_line(HEADS), _line(["---", *["--:"] * (len(HEADS) - 1)])]
    print(*lines, sep="\n", flush=True)
    surveys = _surveys(options.data, options.before, repeat, quick=options.quick)
    calls = chain(_overlaps(repeat, quick=options.quick), _adjustments(repeat, quick=options.quick))
    for row in (*_printed(surveys, lines), *_printed(calls, lines)):
        if row.seconds > 1.05 * row.before:
            print(f"slower than before: {row.work}")
    about = f"{_commit()}, {datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} cores, {_processor()}"
    about += f", load {os.getloadavg()[2]:.1f}, medians of {repeat}"
    KEPT.write_text(
        f"# Timings\n\n{about}. See `benchmarks/table.py`.\n\n" + "\n".join(lines) + "\n", "utf-8"
    )


def _printed(rows: Iterator[Row], lines: list[str]) -> Iterator[Row]:
    """Yield the rows, printed as they come."""
    for row in rows:
        lines.append(_line(row.cells()))
        print(lines[-1], flush=True)
        yield row


def _surveys(data: Path | None, before: Path | None, repeat: int, *, quick: bool) -> Iterator[Row]:
    """Yield the rows of commands."""
    demo = WORK / "demo"
    if not demo.is_dir():
        scene = ROOT / "datasets/demo/scene.toml"
        _run([sys.executable, "-m", "sfm.products.rendering.render", str(scene), str(demo)])
    survey = ["run", str(ROOT / "datasets/demo/survey.toml"), "--images", str(demo)]
    yield _survey("targets: demo, 12 photographs", survey, before, repeat)
    if data is not None:
        for name in SURVEYS:
            images = next(
                (data / name / part for part in ("images", "") if (data / name / part).is_dir()), None
            )
            if images is not None:
                survey = ["run", str(ROOT / "datasets" / name / "survey.toml"), "--images", str(images)]
                yield _survey(f"targets: {name}", survey, before, repeat)
    if not quick:
        folder = WORK / "textured_scenes" / "medium12x2"
        if not folder.is_dir():
            render_scene(folder, "medium", 12, 2)
        yield _survey("texture: rendered, 12 photographs", ["run", str(folder)], before, repeat, rival=folder)
    if data is not None and not quick:
        for name in TEXTURES:
            images = next((place for place in (data / name, data / "texture" / name) if place.is_dir()), None)
            if images is not None:
                yield _survey(f"texture: {name}", ["run", str(images)], before, repeat, rival=images)


def _survey(
    work: str, arguments: list[str], before: Path | None, repeat: int, *, rival: Path | None = None
) -> Row:
    """Return the row of a command of this checkout and of another one, in turn, and of COLMAP."""
    checkouts = [ROOT] if before is None else [ROOT, before.resolve()]
    commands = [str(Path(sys.executable).with_name("kolinear"))]
    commands += [str(checkout / ".venv/bin/kolinear") for checkout in checkouts[1:]]
    times: list[list[tuple[float, float]]] = [[] for _ in checkouts]
    rivals = []
    for number in range(repeat + 1):  # the first run compiles and fills caches
        for command, of_checkout in zip(commands, times, strict=True):
            with tempfile.TemporaryDirectory() as folder:
                photographs = Path(folder) / "photographs"
                own = list(arguments)
                if rival is not None:  # a draft is written beside a result, not beside the photographs
                    shutil.copytree(rival, photographs, ignore=shutil.ignore_patterns("*.toml", "*.csv"))
                    own[1] = str(photographs)
                out = Path(folder) / "result"
                timed_run = _run(
                    [command, *own, "--out", str(out)], Path(folder), cache=Path(folder) / "cache"
                )
                if number:
                    of_checkout.append(timed_run)
        if rival is not None and number:
            rivals.append(_run([sys.executable, "-c", COLMAP, str(rival)])[0])
    seconds, wall = (statistics.median(column) for column in zip(*times[0], strict=True))
    return Row(
        work,
        seconds,
        wall,
        statistics.median(run[0] for run in times[1]) if len(times) > 1 else float("nan"),
        statistics.median(rivals) if rivals else float("nan"),
    )


def _overlaps(repeat: int, *, quick: bool) -> Iterator[Row]:
    """Yield the rows of the search of photographs that overlap."""
    for m in OVERLAPPING[:1] if quick else OVERLAPPING:
        features = take_photographs(m, WORK / "overlap" / f"{m}.npz").features
        with own_threads(1):
            seconds, _ = timed(partial(compare_photographs, features), repeat, time.process_time)
        yield Row(f"overlap: {m} photographs", seconds, rival=ask_colmap(features)[1])


def _adjustments(repeat: int, *, quick: bool) -> Iterator[Row]:
    """Yield the rows of adjustments, without and with the covariance."""
    for case in CASES:
        if case.group != "small" or (quick and not case.name.endswith(QUICK)):
            continue
        network, start = case.made()
        scene = reconstruction(network, start)
        for covariance in (False, True):
            solve = _solved(network, start, covariance=covariance)
            ours, _ = timed(solve, max(repeat, 3), time.perf_counter)
            tuned = [(solver, threads) for solver in SOLVERS for threads in (1, 2)]
            rival = min(
                timed_ceres(scene, how, 1, time.perf_counter, covariance=covariance)[0] for how in tuned
            )
            words = " with covariance" if covariance else ""
            yield Row(f"adjustment: {case.name}{words}", ours, ours, rival=rival)


def _solved(network: Network, start: Estimate, *, covariance: bool) -> Callable[[], float]:
    """Return the adjustment of a network as a call without arguments."""
    return lambda: run_adjust(network, start, covariance=covariance)


def _run(command: list[str], cwd: Path = ROOT, *, cache: Path | None = None) -> tuple[float, float]:
    """Run a command, and return its processor time, s, with all its processes, and its wall time, s.

    cache: folder of what earlier commands have measured; that of the user if not given.
    """
    environment = dict(os.environ) if cache is None else {**os.environ, "XDG_CACHE_HOME": str(cache)}
    begun = time.perf_counter()
    with subprocess.Popen(
        command, cwd=cwd, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        message = process.stderr.read() if process.stderr is not None else b""
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(command)}: {message.decode(errors='replace')[-500:]}")
    return used.ru_utime + used.ru_stime, time.perf_counter() - begun


def _commit() -> str:
    """Return the commit of this checkout, and whether it was changed."""
    words = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=8"]
    try:
        return "commit " + subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "no commit"


def _processor() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def _shown(number: float, digits: int) -> str:
    """Return a number with its significant digits; nothing for NaN."""
    return "" if number != number else f"{number:.{digits}g}"


def _line(cells: list[str] | tuple[str, ...]) -> str:
    """Return a row of a table of Markdown."""
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
