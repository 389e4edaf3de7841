"""Fuzz all readers: no traceback, no crash, no case over 10 s, no process over 1 GiB.

python -m tests.fuzz.run [--count 20000] [--seed 1] [--kinds surveys tables ...]

Every kind runs in a separate process, so that a crash of a library or a hang is seen and reported like any
other fault, with the case that repeats it: --kinds KIND --seed S --only CASE.

Seconds are those of computing, which other work on the machine does not change.
"""

from __future__ import annotations

import argparse
import queue
import random
import resource
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

from sfm.model.errors import KolinearError

LIMIT_SECONDS = 10.0
HANG_SECONDS = 600.0  # of the clock, after which a case is ended; a busy computer compiles kernels for long
START_SECONDS = 1200.0  # imports and the first compilation of kernels
LIMIT_MIB = 1024
SHARES = {
    **{"surveys": 0.2, "tables": 0.18, "photographs": 0.24, "models": 0.13, "results": 0.14, "codes": 0.03},
    **{"cameras": 0.05, "folders": 0.04, "rows": 0.04},
}


def main() -> int:
    """Run the fuzzer; the exit code is 1 if anything was found."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--count", type=int, default=20_000)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--kinds", nargs="*", default=list(SHARES), choices=list(SHARES))
    options.add_argument("--only", type=int)
    options.add_argument("--child", nargs=2, type=int, help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.child is not None:
        run_cases(given.kinds[0], given.seed, *given.child)
        return 0
    if given.only is not None:
        run_cases(given.kinds[0], given.seed, given.only, given.only + 1)
        return 0
    whole = sum(SHARES[kind] for kind in given.kinds)
    found = 0
    for kind in given.kinds:
        count = round(given.count * SHARES[kind] / whole)
        found += watch(kind, given.seed, count)
    print(f"{found} faults")
    return 1 if found else 0


def run_cases(kind: str, seed: int, first: int, last: int) -> None:
    """Run cases and print a line for each: its number and what went wrong."""
    from tests.fuzz.cases import make_seeds, mutated, run_case

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seeds = [one for one in make_seeds(folder) if one.kind == kind]
        for one in seeds:  # good files first: kernels are compiled here, not within the time of a case
            with suppress(KolinearError):
                one.read(folder, _Always())
        for number in range(first, last):
            rng = random.Random(f"{kind} {seed} {number}")
            seed_file = rng.choice(seeds)
            data = mutated(seed_file, rng)
            begun = time.process_time()
            fault = run_case(seed_file, data, folder, rng)
            seconds = time.process_time() - begun
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
            print(f"{number}\t{seconds:.2f}\t{peak}\t{fault}", flush=True)


class _Always(random.Random):
    """Chance that never spares the long way."""

    def random(self) -> float:
        return 0.0


def watch(kind: str, seed: int, count: int) -> int:
    """Run a kind in processes that are watched; return the number of faults."""
    first, faults, peak, slowest = 0, 0, 0, 0.0
    begun = time.monotonic()
    while first < count:
        command = [sys.executable, "-m", "tests.fuzz.run", "--kinds", kind, "--seed", str(seed)]
        process = subprocess.Popen(
            [*command, "--child", str(first), str(count)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        )
        lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        threading.Thread(target=_pump, args=(process, lines), daemon=True).start()
        threading.Thread(target=process.stderr.read, daemon=True).start()  # type: ignore[union-attr]
        started = False
        while True:
            limit = HANG_SECONDS if started else START_SECONDS
            try:
                line = lines.get(timeout=limit)
            except queue.Empty:
                process.kill()
                print(f"{kind} {first}: more than {limit:.0f} s of the clock")
                faults, first = faults + 1, first + 1
                break
            if line is None:
                if first < count:
                    print(f"{kind} {first}: the process died, exit code {process.wait()}")
                    faults, first = faults + 1, first + 1
                break
            started = True
            number, took, mib, fault = line.rstrip("\n").split("\t", 3)
            first, slowest = int(number) + 1, max(slowest, float(took))
            over = int(mib) > LIMIT_MIB >= peak
            peak = max(peak, int(mib))
            if fault or over or float(took) > LIMIT_SECONDS:
                faults += 1
                print(f"{kind} {number}: {took} s, {mib} MiB, {fault}", flush=True)
        process.wait()
    seconds = time.monotonic() - begun
    print(f"{kind}: {count} cases, {faults} faults, {seconds:.0f} s, slowest {slowest:.1f} s, {peak} MiB")
    return faults


def _pump(process: subprocess.Popen[str], lines: queue.SimpleQueue[str | None]) -> None:
    for line in process.stdout or ():
        lines.put(line)
    lines.put(None)


if __name__ == "__main__":
    sys.exit(main())
