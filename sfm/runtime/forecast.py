"""Time and memory of a survey: those of earlier runs, scaled to this one, and what is left of the time.

The last runs of the user are kept. Where there are none that are alike, those of `TYPICAL` stand in, and the
stages that are finished tell how much faster or slower this computer is.
"""

from __future__ import annotations

import json
import math
from collections.abc import Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

from sfm.files.user_cache import make_user_folder, user_folder
from sfm.files.whole_files import whole_file
from sfm.model.errors import KolinearError, OutputError
from sfm.runtime.memory import within_bytes

KEPT_RUNS = 200
OTHERS_APART = math.log(8.0)  # a run of the user is preferred to a typical one eight times nearer in size
# Relative standard deviation of an expected time, and by how many parts the finished ones misstate how far a
# stage is, as others are in work: runs of one kind and two threads (estimates).
EXPECTED_SIGMA, PARTS_SIGMA = 0.3, 0.7
LARGEST = 1e6  # of photographs, of 10^6 pixels and of seconds, which no survey reaches
EXPECTED_WEIGHT = 0.25  # of the expected times, as a share of all stages: runs of fountain-P11 and fox10
STORED_SHARE = 0.2  # of its expected time, below which a stage read what an earlier run measured
# How the time of a stage grows with photographs, with the pixels of each, and with given image points, which
# take the place of photographs. Tie points, windows and the pictures of the report are limited in number, but
# sought in all pixels. Of given points, by audits of camcal and fountain-P11.
GROWTH = {
    "photographs": (1.0, 1.0, 0.0),
    "targets": (1.0, 1.0, 0.0),
    "tie points": (1.0, 0.5, 0.0),
    "matching": (1.0, 0.5, 0.0),
    "report": (1.0, 0.5, 0.15),
    "adjustment": (1.0, 0.0, 0.6),
    "comparison": (1.0, 0.0, 0.6),
}
OTHER_GROWTH = (1.0, 0.0, 0.6)
# Memory of the program itself, 10^6 bytes, and how that of a survey grows beyond it, as above: of 60 to 250
# rendered photographs (0.8 to 0.9), and of 12,500 to 650,000 given image points.
PROGRAM_MB = 360.0
MEMORY_GROWTH = (0.85, 0.4, 1.0)
SHARE_WITHOUT_REPORT = 0.6  # of memory: 0.64 and 0.54 for rendered blocks of 250 and 1,000 photographs
# Relative standard deviation of expected memory, and what is added by each factor of e between the sizes of
# the survey and of the run that it is scaled from: the errors, 1 to 12 % near in size, and 1 to 18 % a factor
# of e beyond (docs/validation.md, "Time and memory said beforehand").
MEMORY_SIGMA, MEMORY_SIGMA_BY_DISTANCE = 0.1, 0.1
MEMORY_SIGMAS = 2.0  # below the expected memory, at which a survey is refused that does not fit even so
OTHER_REMEDY = "end other programs, use a larger computer, or take fewer photographs or smaller ones"
LONG_SECONDS = 60.0  # of a survey whose time and memory are said before it begins
MEASURED = ("photographs", "targets", "tie points")  # stages that measure several photographs at a time


@dataclass(frozen=True)
class Work:
    """What the time of a survey depends on."""

    sources: tuple[str, ...]  # of image points
    photographs: int
    megapixels: float = 0.0  # of a photograph; 0 where none is read
    image_points: int = 0  # that are given; 0 where all are measured

    def distance(self, other: Work) -> float:
        """Return how unlike two surveys are; infinite for other sources."""
        if set(self.sources) != set(other.sources):
            return math.inf
        numbers = (
            (self.photographs, other.photographs),
            (self.megapixels, other.megapixels),
            (self.image_points, other.image_points),
        )
        if any((number > 0) != (of_other > 0) for number, of_other in numbers[1:]):
            return math.inf
        return sum(
            abs(math.log(number / of_other)) for number, of_other in numbers if number > 0 and of_other > 0
        )


@dataclass(frozen=True)
class Run:
    """A finished survey, and the time of its stages in their order."""

    work: Work
    seconds: dict[str, float]
    memory_mb: float = 0.0  # its peak, 10^6 bytes; 0 where it is not known

    def memory_scaled_to(self, work: Work) -> float:
        """Return the peak of the memory of another survey of these sources, 10^6 bytes."""
        return PROGRAM_MB + max(self.memory_mb - PROGRAM_MB, 0.0) * self._grown(work, *MEMORY_GROWTH)

    def _grown(self, work: Work, by_number: float, by_size: float, by_points: float) -> float:
        """Return by what a need of this run grows to that of another, by its exponents."""
        if work.image_points and self.work.image_points:
            return float((work.image_points / self.work.image_points) ** by_points)
        of_number = max(1, work.photographs) / max(1, self.work.photographs)
        of_size = work.megapixels / self.work.megapixels if self.work.megapixels else 1.0
        return float(of_number**by_number * of_size**by_size)

    def scaled_to(self, work: Work) -> dict[str, float]:
        """Return the time that each stage would take for another survey of these sources, s."""
        return {
            stage: seconds * self._grown(work, *GROWTH.get(stage, OTHER_GROWTH))
            for stage, seconds in self.seconds.items()
        }


def _typical(work: Work, stages: str, *seconds: float, memory_mb: float) -> Run:
    return Run(work, dict(zip(stages.split(", "), seconds, strict=True)), memory_mb)


_TARGETS = "targets, orientation, matching, adjustment, comparison, report"
_GIVEN = "orientation, adjustment, comparison, report"
_ALONE = "orientation, adjustment, report"  # not compared
_TEXTURE = "tie points, orientation, matching, adjustment, comparison, report"
# Two cores of 2.5 GHz, 2026-11: camcal, stereo-chessboard, the demo, fountain-P11 in two sizes, rendered
# blocks, a sheet of targets on texture, and the image points of stereo10, camcal, fountain-P11 and of a dense
# and a flown network. In the first two, whose photographs are real, causes of errors are found and tried.
TYPICAL = (
    _typical(Work(("targets",), 21, 3.87), _TARGETS, 3.5, 0.2, 0.4, 7.6, 0.7, 1.6, memory_mb=493),
    _typical(Work(("targets",), 28, 0.31), _TARGETS, 1.2, 0.1, 0.3, 6.6, 0.4, 1.2, memory_mb=481),
    _typical(Work(("targets",), 12, 1.92), _TARGETS, 4.3, 0.4, 0.3, 0.3, 0.4, 1.2, memory_mb=453),
    _typical(Work(("texture",), 11, 1.57), _TEXTURE, 3.2, 1.7, 8.8, 8.4, 1.9, 5.9, memory_mb=811),
    _typical(Work(("texture",), 11, 6.29), _TEXTURE, 7.0, 2.0, 12.0, 8.0, 2.0, 6.0, memory_mb=1057),
    _typical(Work(("texture",), 60, 0.31), _TEXTURE, 11.0, 3.0, 11.0, 14.0, 7.0, 6.0, memory_mb=879),
    _typical(Work(("texture",), 250, 0.31), _TEXTURE, 46.0, 7.0, 43.0, 34.0, 31.0, 23.0, memory_mb=2206),
    _typical(
        Work(("targets", "texture"), 30, 0.31),
        "photographs, targets, tie points, orientation, matching, adjustment, comparison, report",
        *(6.1, 0.1, 4.6, 1.9, 9.2, 3.7, 1.0, 4.0),
        memory_mb=700,
    ),
    _typical(Work(("given",), 2, 0.0, 20), _GIVEN, 0.1, 0.1, 0.1, 0.6, memory_mb=368),
    _typical(Work(("given",), 21, 0.0, 2049), _GIVEN, 0.2, 2.9, 0.4, 1.6, memory_mb=400),
    _typical(Work(("given",), 11, 0.0, 30331), _GIVEN, 0.5, 15.0, 2.0, 2.4, memory_mb=480),
    _typical(Work(("given",), 500, 0.0, 49819), _ALONE, 7.6, 10.7, 2.6, memory_mb=745),
    _typical(Work(("given",), 1000, 0.0, 646330), _ALONE, 4.2, 34.2, 13.3, memory_mb=1406),
)


@dataclass(frozen=True)
class Forecast:
    """Time and memory that a survey is expected to take."""

    seconds: dict[str, float]  # of each stage, in their order, s; empty where no run was alike
    memory_mb: float = 0.0  # its peak, 10^6 bytes; 0 where no run was alike
    distance: float = 0.0  # from the run that the memory is scaled from, see Work.distance

    @property
    def least_memory_mb(self) -> float:
        """Lower bound of the memory, 10^6 bytes; the farther below, the less the run was alike."""
        sigma = math.hypot(MEMORY_SIGMA, MEMORY_SIGMA_BY_DISTANCE * self.distance)
        return self.memory_mb * math.exp(-MEMORY_SIGMAS * sigma)

    def refuse(self, *, there_bytes: float | None = None, remedy: str = OTHER_REMEDY) -> None:
        """Refuse a survey that needs more memory than there is, even by the lower bound.

        Args:
            there_bytes: memory that there is for it, bytes; None: for this process.
            remedy: what can be done.

        Raises:
            KolinearError: it does not fit.
        """
        there = (within_bytes() if there_bytes is None else there_bytes) / 1e6
        if self.least_memory_mb > there:
            raise KolinearError(
                f"the survey needs about {self.memory_mb / 1000:.1f} GB of memory, at least "
                f"{self.least_memory_mb / 1000:.1f} GB, and {there / 1000:.1f} GB are there for it: {remedy}"
            )

    def announced(self) -> str:
        """Return one sentence on the time and memory of a long survey; empty for others."""
        there = within_bytes() / 1e6
        needs = f"{self.memory_mb / 1000:.1f} GB of memory"
        whole, short = sum(self.seconds.values()), self.memory_mb > there
        if whole < LONG_SECONDS and not short:
            return ""
        parts = ", ".join(f"{stage} {duration(took)}" for stage, took in self.seconds.items() if took >= 1)
        said = [f"{duration(whole)} ({parts})", *([needs] if self.memory_mb else [])]
        lacking = f", of which {there / 1000:.1f} GB are there" if short else ""
        return f"expected: {' and '.join(said)}{lacking}"


def forecast(work: Work, runs: Sequence[Run], *, without: Container[str] = ()) -> Forecast:
    """Return the expected time and memory of a survey.

    Args:
        work: of the survey.
        runs: earlier runs of the user, the last one last.
        without: stages that it does not have.
    """
    nearest, measured = _nearest(work, runs), _nearest(work, [run for run in runs if run.memory_mb > 0])
    if nearest is None:
        return Forecast({})
    seconds = {stage: took for stage, took in nearest.scaled_to(work).items() if stage not in without}
    if measured is None:
        return Forecast(seconds)
    memory_mb = measured.memory_scaled_to(work) * (SHARE_WITHOUT_REPORT if "report" in without else 1.0)
    return Forecast(seconds, memory_mb, measured.work.distance(work))


def duration(seconds: float) -> str:
    """Return a rough time in words."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def _nearest(work: Work, runs: Sequence[Run]) -> Run | None:
    """Return the run whose work is nearest, of the user if there is a choice; None where none is alike."""
    apart = [(run.work.distance(work), -k, run) for k, run in enumerate(runs)]
    apart += [(run.work.distance(work) + OTHERS_APART, 1, run) for run in TYPICAL]
    distance, _, nearest = min(apart, key=lambda row: row[:2])
    return nearest if math.isfinite(distance) else None


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
                    given = int(row["image_points"])
                    pixels = float(row["megapixels"])
                    work = Work(tuple(map(str, row["sources"])), int(row["photographs"]), pixels, given)
                    seconds = {str(stage): float(took) for stage, took in row["seconds"].items()}
                    memory = float(row.get("memory_mb", 0.0))  # runs of earlier versions do not state it
                    numbers = (work.photographs, pixels, given / LARGEST, memory, *seconds.values())
                    in_range = all(0 <= number <= LARGEST for number in numbers)
                    if in_range and work.photographs and not 0 < work.megapixels < 1 / LARGEST:
                        runs.append(Run(work, seconds, memory))
        return runs

    def add(self, run: Run) -> None:
        """Keep a run, and forget the oldest beyond `KEPT_RUNS`; without room on the disk it is not kept."""
        if not self.is_kept:
            return
        kept = [*self.read()[1 - KEPT_RUNS :], run]
        lines = [
            json.dumps(asdict(each.work) | {"seconds": each.seconds, "memory_mb": each.memory_mb})
            for each in kept
        ]
        with suppress(OSError, OutputError):
            make_user_folder(self.path.parent)
            with whole_file(self.path, replaces=True) as part:
                part.write_text("".join(f"{line}\n" for line in lines), "utf-8")


def slowness(compared: Sequence[tuple[float, float]], whole: float = 0.0) -> float:
    """Return how much longer stages take than expected: the geometric mean, weighted by the expected times.

    A stage that found much more to do than usual, such as causes to try, says little of the others. So do
    stages that are a small part of the whole: the expectation has the weight of a quarter of it.

    Args:
        compared: time that each stage took, and the expected one, s.
        whole: expected time of all stages, s.
    """
    rows = [(took, expected) for took, expected in compared if took > 0 and expected > 0]
    of_all = sum(expected for _, expected in rows)
    if not of_all:
        return 1.0
    gained = sum(expected * math.log(took / expected) for took, expected in rows)
    return math.exp(gained / (of_all + EXPECTED_WEIGHT * whole))


@dataclass
class Countdown:
    """What is left of a survey, by the expected times of its stages and by those that it has taken."""

    expected: dict[str, float] = field(default_factory=dict)  # of all stages, s
    taken: dict[str, float] = field(default_factory=dict)  # of finished stages, s

    def finish(self, stage: str, seconds: float) -> None:
        """Note the time that a stage took, s; that of a stage that comes again is added."""
        self.taken[stage] = self.taken.get(stage, 0.0) + seconds

    def counted(self, stage: str, elapsed: float, done: int, parts: int) -> float | None:
        """Return the time of the present stage by its finished parts, s; None without any."""
        if not done:
            return None
        weight = 1 / (1 + (PARTS_SIGMA / (EXPECTED_SIGMA * done)) ** 2)
        return weight * elapsed * parts / done + (1 - weight) * self.expected.get(stage, 0.0)

    def compared(self, stage: str = "", counted: float | None = None) -> list[tuple[float, float]]:
        """Return the times of stages and the expected ones, s, without those read from an earlier run.

        Args:
            stage: the present stage.
            counted: its time by its parts, s.
        """
        known = self.taken | ({stage: counted} if counted is not None else {})
        return [
            (took, self.expected[name])
            for name, took in known.items()
            if took > STORED_SHARE * self.expected.get(name, math.inf)
        ]

    def left(
        self,
        stage: str,
        elapsed: float,
        done: int = 0,
        parts: int = 0,
        *,
        slower: float | None = None,
        at_least: float = 0.0,
    ) -> float | None:
        """Return the time left of all stages, s; None where nothing is expected of them.

        Args:
            stage: the present stage.
            elapsed: time since it began, s.
            done: number of its parts that are finished; 0 if it counts only a part of its work.
            parts: number of all its parts.
            slower: how much longer stages take than expected; None for those of this survey.
            at_least: time left of the stage's present work, s.
        """
        if not self.expected:
            return None
        counted = self.counted(stage, elapsed, done, parts)
        if slower is None:
            slower = slowness(self.compared(stage, counted), sum(self.expected.values()))
        of_stage = counted if counted is not None else slower * self.expected.get(stage, 0.0)
        later = sum(s for name, s in self.expected.items() if name != stage and name not in self.taken)
        return max(at_least, of_stage - elapsed) + slower * later


@dataclass
class _Surveyed:
    """A survey of a batch in progress."""

    countdown: Countdown
    stage: str = ""
    elapsed: float = 0.0  # time that the parts of the stage took together, s
    begun: float | None = None  # when the stage began, s of a clock; None while its parts are counted
    done: int = 0  # parts
    parts: int = 0
    stored: bool = False  # whether a part was measured in an earlier run


class BatchCountdown:
    """What is left of a batch: countdowns of its surveys, in computing time, over the number of workers.

    The surveys that the batch has finished count among the earlier runs for those to come.
    """

    def __init__(
        self, works: Mapping[str, Work | None], runs: Sequence[Run], *, workers: int, threads: int
    ) -> None:
        """Begin.

        Args:
            works: what the time of each survey depends on; None where it is not known.
            runs: earlier runs of the user, the last one last.
            workers: number of calls of the batch that run at a time.
            threads: that measured the photographs of an earlier run; a survey of a batch has one.
        """
        self._works = dict(works)  # of surveys that are not finished
        self._runs = list(runs)
        self._workers, self._threads = workers, threads
        self._begun: dict[str, _Surveyed] = {}

    def _expected(self, name: str) -> dict[str, float]:
        work = self._works.get(name)
        if work is None:
            return {}
        seconds = forecast(work, self._runs).seconds
        return {stage: s * (self._threads if stage in MEASURED else 1) for stage, s in seconds.items()}

    def _surveyed(self, name: str) -> _Surveyed:
        if name not in self._begun:
            self._begun[name] = _Surveyed(Countdown(self._expected(name)))
        return self._begun[name]

    def measured(self, name: str, seconds: float, parts: int, *, stored: bool) -> None:
        """Note a photograph of a survey, the time that it took, s, and the number of all its photographs."""
        survey = self._surveyed(name)
        survey.stage = next((stage for stage in survey.countdown.expected if stage in MEASURED), MEASURED[0])
        survey.elapsed, survey.done, survey.parts = survey.elapsed + seconds, survey.done + 1, parts
        survey.stored |= stored

    def begin(self, name: str, stage: str, now: float, last: float | None = None) -> None:
        """Note that a stage of a survey begins, and the time that the one before took, s, if known."""
        survey = self._surveyed(name)
        if survey.begun is None:
            if survey.done:
                survey.countdown.finish(survey.stage, survey.elapsed)
        elif survey.stage != stage:
            survey.countdown.finish(survey.stage, now - survey.begun if last is None else last)
        survey.stage, survey.begun, survey.done, survey.elapsed = stage, now, 0, 0.0

    def finish(self, name: str, seconds: float, *, dependable: bool) -> None:
        """Note the end of a survey, and its computing time, s, if it has a result."""
        work, survey = self._works.pop(name, None), self._begun.pop(name, None)
        if survey is None or work is None or not dependable:
            return
        taken = survey.countdown.taken
        survey.countdown.finish(survey.stage, max(0.0, seconds - sum(taken.values())))
        if not survey.stored:
            as_run = {stage: s / (self._threads if stage in MEASURED else 1) for stage, s in taken.items()}
            self._runs.append(Run(work, as_run))
            for other, begun in self._begun.items():
                begun.countdown.expected = self._expected(other)

    def left(self, now: float) -> float | None:
        """Return the time to the end of the batch, s; None where nothing is expected of its surveys.

        Args:
            now: time of the clock of `begin`, s.
        """
        present, compared = [], list[tuple[float, float]]()
        for name in self._works:
            survey = self._begun.get(name)
            if survey is None:
                survey = _Surveyed(Countdown(self._expected(name)))
            elapsed = survey.elapsed if survey.begun is None else now - survey.begun
            counted = survey.countdown.counted(survey.stage, elapsed, survey.done, survey.parts)
            compared += survey.countdown.compared(survey.stage, counted)
            present.append((survey, elapsed))
        slower = slowness(compared)
        times = [
            survey.countdown.left(survey.stage, elapsed, survey.done, survey.parts, slower=slower)
            for survey, elapsed in present
        ]
        known = [seconds for seconds in times if seconds is not None]
        if not known:
            return None
        unknown = len(times) - len(known)  # as long as the others
        of_all = sum(known) * (1 + unknown / len(known))
        return max(of_all / self._workers, max(known))
