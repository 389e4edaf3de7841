"""How long a survey takes: the stages of earlier runs, scaled to this one, and what of them is left.

The last runs of the user are kept. Where there are none that are alike, those of `TYPICAL` stand in, and the
stages that are finished tell how much faster or slower this computer is.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from sfm.files.user_cache import make_user_folder, user_folder
from sfm.files.whole_files import whole_file
from sfm.model.errors import OutputError

KEPT_RUNS = 200
OTHERS_APART = math.log(8.0)  # a run of the user is preferred to a typical one eight times nearer in size
# Relative standard deviation of an expected time, and by how many parts the finished ones misstate how far a
# stage is, as others are in work: runs of one kind and two threads (estimates).
EXPECTED_SIGMA, PARTS_SIGMA = 0.3, 0.7
LARGEST = 1e6  # of photographs, of 10^6 pixels and of seconds, which no survey reaches
STORED_SHARE = 0.2  # of its expected time, below which a stage read what an earlier run measured
# How the time of a stage grows with photographs, and with the pixels of each. Tie points, windows and the
# pictures of the report are limited in number, but sought in all pixels.
GROWTH = {
    "photographs": (1.0, 1.0),
    "targets": (1.0, 1.0),
    "tie points": (1.0, 0.5),
    "matching": (1.0, 0.5),
    "report": (0.7, 0.5),
    "adjustment": (1.2, 0.0),
    "comparison": (1.2, 0.0),
}
OTHER_GROWTH = (1.0, 0.0)


@dataclass(frozen=True)
class Work:
    """What the time of a survey depends on."""

    sources: tuple[str, ...]  # of image points
    photographs: int
    megapixels: float = 0.0  # of a photograph; 0 where none is read

    def distance(self, other: Work) -> float:
        """Return how unlike two surveys are; infinite for other sources."""
        if set(self.sources) != set(other.sources) or (self.megapixels > 0) != (other.megapixels > 0):
            return math.inf
        of_size = abs(math.log(self.megapixels / other.megapixels)) if self.megapixels else 0.0
        return of_size + abs(math.log(max(1, self.photographs) / max(1, other.photographs)))


@dataclass(frozen=True)
class Run:
    """A finished survey, and the time of its stages in their order."""

    work: Work
    seconds: dict[str, float]

    def scaled_to(self, work: Work) -> dict[str, float]:
        """Return the time that each stage would take for another survey of these sources, s."""
        of_number = max(1, work.photographs) / max(1, self.work.photographs)
        of_size = work.megapixels / self.work.megapixels if self.work.megapixels else 1.0
        scaled = {}
        for stage, seconds in self.seconds.items():
            by_number, by_size = GROWTH.get(stage, OTHER_GROWTH)
            scaled[stage] = seconds * of_number**by_number * of_size**by_size
        return scaled


def _typical(
    sources: tuple[str, ...], photographs: int, megapixels: float, stages: str, *seconds: float
) -> Run:
    work = Work(sources, photographs, megapixels)
    return Run(work, dict(zip(stages.split(", "), seconds, strict=True)))


_TARGETS = "targets, orientation, matching, adjustment, comparison, report"
_TEXTURE = "tie points, orientation, matching, adjustment, comparison, report"
# Two cores of 2.5 GHz, 2026-11: camcal, the demo, fountain-P11, a sheet of targets on texture, and the image
# points of stereo10.
TYPICAL = (
    _typical(("targets",), 21, 3.87, _TARGETS, 3.5, 0.2, 0.4, 7.6, 0.7, 1.6),
    _typical(("targets",), 12, 1.92, _TARGETS, 4.3, 0.4, 0.3, 0.3, 0.4, 1.2),
    _typical(("texture",), 11, 6.29, _TEXTURE, 7.0, 2.0, 12.0, 8.0, 2.0, 6.0),
    _typical(
        ("targets", "texture"),
        30,
        0.31,
        "photographs, targets, tie points, orientation, matching, adjustment, comparison, report",
        *(6.1, 0.1, 4.6, 1.9, 9.2, 3.7, 1.0, 4.0),
    ),
    _typical(("given",), 10, 0.0, "orientation, adjustment, comparison, report", 0.4, 0.1, 0.1, 0.6),
)


def expected_seconds(work: Work, runs: Sequence[Run]) -> dict[str, float]:
    """Return the expected time of each stage of a survey, in their order, s; empty where none was alike.

    Args:
        work: of the survey.
        runs: earlier runs of the user, the last one last.
    """
    apart = [(run.work.distance(work), -k, run) for k, run in enumerate(runs)]
    apart += [(run.work.distance(work) + OTHERS_APART, 1, run) for run in TYPICAL]
    distance, _, nearest = min(apart, key=lambda row: row[:2])
    return nearest.scaled_to(work) if math.isfinite(distance) else {}


class RunHistory:
    """The last runs of a user, one line of a file each; lines that are damaged are passed over."""

    def __init__(self, path: Path, *, is_kept: bool = True) -> None:
        self.path = path
        self.is_kept = is_kept  # else nothing is read or written

    @classmethod
    def of_user(cls) -> RunHistory:
        """Return the history in the user's cache folder (XDG_CACHE_HOME).

        Where other users can write into the folder, nothing is read or kept, and the survey goes on.
        """
        try:
            return cls(user_folder("runs", "times of runs") / "runs.jsonl")
        except OutputError:
            return cls(Path(), is_kept=False)

    def read(self) -> list[Run]:
        """Return the runs, the last one last."""
        runs = list[Run]()
        if not self.is_kept:
            return runs
        with suppress(OSError, UnicodeDecodeError):
            for line in self.path.read_text("utf-8").splitlines()[-KEPT_RUNS:]:
                with suppress(ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
                    row = json.loads(line)
                    work = Work(tuple(map(str, row["sources"])), int(row["photographs"]), row["megapixels"])
                    seconds = {str(stage): float(took) for stage, took in row["seconds"].items()}
                    numbers = (work.photographs, work.megapixels, *seconds.values())
                    in_range = all(0 <= number <= LARGEST for number in numbers)
                    if in_range and work.photographs and not 0 < work.megapixels < 1 / LARGEST:
                        runs.append(Run(work, seconds))
        return runs

    def add(self, run: Run) -> None:
        """Keep a run, and forget the oldest beyond `KEPT_RUNS`; without room on the disk it is not kept."""
        if not self.is_kept:
            return
        kept = [*self.read()[1 - KEPT_RUNS :], run]
        lines = [json.dumps(asdict(each.work) | {"seconds": each.seconds}) for each in kept]
        with suppress(OSError, OutputError):
            make_user_folder(self.path.parent)
            with whole_file(self.path, replaces=True) as part:
                part.write_text("".join(f"{line}\n" for line in lines), "utf-8")


@dataclass
class Countdown:
    """What is left of a survey, by the expected times of its stages and by those that it has taken."""

    expected: dict[str, float] = field(default_factory=dict)  # of all stages, s
    taken: dict[str, float] = field(default_factory=dict)  # of finished stages, s

    def finish(self, stage: str, seconds: float) -> None:
        """Note the time that a stage took, s; that of a stage that comes again is added."""
        self.taken[stage] = self.taken.get(stage, 0.0) + seconds

    def left(self, stage: str, elapsed: float, done: int = 0, parts: int = 0) -> float | None:
        """Return the time left of all stages, s; None where nothing is expected of them.

        Args:
            stage: the present stage.
            elapsed: time since it began, s.
            done: number of its parts that are finished; 0 if it counts only a part of its work.
            parts: number of all its parts.
        """
        if not self.expected:
            return None
        counted = None
        if done:
            weight = 1 / (1 + (PARTS_SIGMA / (EXPECTED_SIGMA * done)) ** 2)
            counted = weight * elapsed * parts / done + (1 - weight) * self.expected.get(stage, 0.0)
        known = self.taken | ({stage: counted} if counted is not None else {})
        compared = [
            (took, self.expected[name])
            for name, took in known.items()
            if took > STORED_SHARE * self.expected.get(name, math.inf)
        ]
        of_compared = sum(of for _, of in compared)  # 0 where a coarse clock measured nothing
        slower = sum(took for took, _ in compared) / of_compared if of_compared > 0 else 1.0
        of_stage = counted if counted is not None else slower * self.expected.get(stage, 0.0)
        later = sum(s for name, s in self.expected.items() if name != stage and name not in self.taken)
        return max(0.0, of_stage - elapsed) + slower * later
