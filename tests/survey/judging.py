"""What surveys say of themselves: right ones, with gross errors, with planted faults, with faults of no row.

    python -m tests.survey.judging [FIRST] [GROUP ...]

runs surveys from scratch on the networks of `tests.survey.faults` and `tests.survey.equipped` from number
FIRST on, groups right, ordinary, faults, rowless, equipped, and prints for each kind how often it is called
bad or fair, and which is named. A result is wrong where a coordinate is more than 5 of its standard
deviations from the truth. Its fault can be detected where a test that knew it would find it with 80 %
probability at the level 0.001: where v'Pv of the same survey without noise, in which the fault is all that
is left, exceeds Baarda's 17.07. It is found surely where a test of as many unknowns as it has, one among a
thousand that share that level, finds it with 99.9 %: below, chance decides whether anything is said. Mistakes
of equipment are large: all count as found surely, and the right cause is a remark of the right kind that
names what is wrong.
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import stats

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import FloatArray
from sfm.model.errors import KolinearError
from sfm.model.network import Network
from sfm.model.remarks.catalogue import given_values, hypotheses
from sfm.model.remarks.remark import of_kind
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.survey.inputs.survey import read_survey
from tests.findings import findings_of
from tests.survey.equipped import EQUIPPED, equipped
from tests.survey.faults import FAULTS, RIGHT, ROWLESS, Planted, planted
from tests.surveys import survey_of

COLUMNS = (
    "wrong, detectable, named first, untold (surely found, of them untold); "
    "wrong and not named first, said unchecked; false"
)
WRONG = 5.0  # standard deviations, of the worst coordinate
DETECTABLE = 17.07  # noncentrality that one test at the level 0.001 finds with 80 %; Baarda (1968)
SURE_LEVEL, SURE_POWER = 1e-6, 0.999
UNCHECKED = {
    *("constancy_weakly_tested", "held_weakly_tested"),
    "calibrated_from_few",
    *("assumptions_untested", "photographs_untested"),
}
OF_GIVEN = {row.name for row in given_values.ROWS}
CAUSES = {row.name for row in hypotheses.ROWS} - UNCHECKED - {"photographs_differ"} | {
    "camera_per_photograph"
}
ALIKE = {  # kinds that say the same of a fault
    "two_places": "points_moved",
    "camera_drift": "other_camera",
    "camera_per_photograph": "other_camera",
}
GROUPS = {
    "right": ([kind for kind in RIGHT if kind != "nothing"], 40),
    "ordinary": (["nothing"], 200),
    "faults": (list(FAULTS), 15),
    "rowless": (list(ROWLESS), 10),
    "equipped": (list(EQUIPPED), 20),
}


@dataclass(frozen=True)
class Outcome:
    """What came of one survey."""

    kind: str
    number: int
    cause: str  # that was planted
    level: str  # good, fair, bad; none where the survey ended without a result
    over_sigma: float  # of the worst coordinate
    detectable: bool
    sure: bool  # whether it is found surely
    named: tuple[str, ...]  # causes, in the order of the verdict, notes included
    first: str  # kind of the first remark that is no note
    unchecked: bool = False  # whether it says that an assumption is hardly checked
    as_well: tuple[str, ...] = ()  # causes that it says cannot be told apart from those that are named

    @property
    def is_wrong(self) -> bool:
        """Whether the result is wrong by more than WRONG."""
        return self.over_sigma > WRONG

    @property
    def is_right_cause(self) -> bool:
        """Whether the first cause named is the one that was planted."""
        return bool(self.named) and _class(self.named[0]) == _class(self.cause)

    @property
    def is_false(self) -> bool:
        """Whether a cause is named and the planted one neither first nor as one that cannot be told apart."""
        classes = {_class(kind) for kind in self.as_well}
        return bool(self.named) and not self.is_right_cause and _class(self.cause) not in classes


def _class(kind: str) -> str:
    return ALIKE.get(kind, kind)


def outcome_of(kind: str, number: int) -> Outcome:
    """Run the survey of a planted network from scratch and compare it with the truth."""
    one = planted(kind, number)
    free = tuple(
        name for name, on in zip(one.start.cameras[0].names, one.start.cameras[0].free, strict=True) if on
    )
    try:
        result = run_survey(survey_of(one.network, one.start, free=free, adjust={"reject": "tau"}))
    except KolinearError as error:
        return Outcome(kind, number, one.cause, "none", np.nan, True, True, (), str(error))
    verdict = findings_of(result).verdict
    named = tuple(remark.kind for remark in verdict.remarks if remark.kind in CAUSES)
    serious = [remark.kind for remark in verdict.remarks if remark.severity != "note"]
    return Outcome(
        *(kind, number, one.cause, verdict.level),
        *(_over_sigma(result, one.network, one.states), *_detectable(one)),
        *(named, serious[0] if serious else ""),
        any(one.kind in UNCHECKED for one in (*verdict.remarks, *verdict.tests)),
        tuple(kind for one in verdict.remarks if one.kind in CAUSES for kind in one.names("instead")),
    )


def equipped_outcome_of(kind: str, number: int) -> Outcome:
    """Run the survey of equipment of a kind and a number from its files and compare it with the truth.

    The cause counts as named if a remark of one of the right kinds names what is wrong.
    """
    with tempfile.TemporaryDirectory() as folder:
        path, scene = equipped(kind, number, Path(folder))
        cause = next(iter(scene.causes), "")
        try:
            result = run_survey(read_survey(path))
        except KolinearError as error:
            return Outcome(kind, number, cause, "none", np.nan, True, True, (), str(error))
    verdict = findings_of(result).verdict
    serious = [one for one in verdict.remarks if one.severity != "note"]
    named = []
    for one in (one for one in verdict.remarks if one.kind in CAUSES | OF_GIVEN and one.severity != "note"):
        right = one.kind in scene.causes and any(name in one.text for name in scene.names or ("",))
        named.append(cause if right else one.kind)
    network, scaled = scene.network, not of_kind(result.remarks, "scale_undefined")
    over = _over_sigma(result, network, (scene.truth.points,), scaled=scaled)
    first = serious[0].kind if serious else ""
    return Outcome(kind, number, cause, verdict.level, over, True, True, tuple(named), first)


def _over_sigma(
    result: SurveyResult, network: Network, states: Iterable[FloatArray], *, scaled: bool = False
) -> float:
    """Return the largest error of a coordinate in its standard deviations, by the nearest state.

    Args:
        result: result of the survey.
        network: has the names of the points.
        states: true object points, (n, 3) each.
        scaled: whether the survey gives the scale.
    """
    a = result.adjustment
    index = [network.points.index(name) for name in a.network.points]
    worst = []
    for state in states:
        placing = fit_similarity(a.estimate.points, state[index])
        if scaled:
            centre = a.estimate.points.mean(axis=0)
            shift = state[index].mean(axis=0) - placing.rotation @ centre
            placing = replace(placing, scale=1.0, translation=shift)
        error = placing.apply(a.estimate.points) - state[index]
        of_axes = placing.rotation @ a.covariance.points @ placing.rotation.T
        sigma = placing.scale * np.sqrt(np.diagonal(of_axes, axis1=1, axis2=2))
        worst.append(float((np.abs(error) / sigma).max()))
    return min(worst)


def _detectable(one: Planted) -> tuple[bool, bool]:
    """Return whether the fault shows in the image points, by its v'Pv without noise, and surely."""
    try:
        found = adjust(one.exact, one.start, datum=Datum("free"), reject="none")
    except KolinearError:
        return True, True
    if not found.converged:
        return True, True
    critical = stats.chi2.isf(SURE_LEVEL, one.unknowns)
    power = stats.ncx2.sf(critical, one.unknowns, found.vPv) if found.vPv > 0 else SURE_LEVEL
    return found.vPv > DETECTABLE, bool(power > SURE_POWER)


def study(names: Iterable[str], first: int, processes: int = 2) -> list[Outcome]:
    """Run the groups and print their tables."""
    every = []
    with ProcessPoolExecutor(processes) as pool:
        for name in names:
            kinds, count = GROUPS[name]
            print(f"{name}: kind, surveys, bad, fair, good, none; {COLUMNS}")
            found = []
            for kind in kinds:
                numbers = range(first, first + count)
                of = equipped_outcome_of if kind in EQUIPPED else outcome_of
                some = list(pool.map(of, [kind] * count, numbers))
                found += some
                print(f"  {kind:20} {_row(some)}", flush=True)
                for one in some:
                    if line := _conspicuous(one):
                        print(f"      {line}", flush=True)
            print(f"  {'all':20} {_row(found)}", flush=True)
            every += found
    return every


def _row(some: list[Outcome]) -> str:
    levels = Counter(one.level for one in some)
    wrong = [one for one in some if one.is_wrong and one.cause]
    seen = [one for one in wrong if one.detectable]
    right = sum(one.is_right_cause for one in seen)
    untold = [one for one in seen if not one.named and not one.first]
    sure = sum(one.sure for one in seen), sum(one.sure for one in untold)
    others = [one for one in wrong if not one.is_right_cause]
    said = sum(one.unchecked or bool(one.first) for one in others)
    false = sum(one.is_false for one in some)
    found = f"{len(wrong):3} {len(seen):3} {right:3} {len(untold):3} ({sure[0]}, {sure[1]})"
    counts = " ".join(f"{levels[level]:3}" for level in ("bad", "fair", "good", "none"))
    believed = sum(one.is_wrong and one.level == "good" for one in some)
    return (
        f"{len(some):3}  {counts}   {found}   {len(others):3} {said:3}   {false:3}, "
        f"wrong and called good {believed}"
    )


def _conspicuous(one: Outcome) -> str:
    """Return a line on a survey that is not judged as it should be; empty where it is."""
    missed = one.is_wrong and one.cause and one.detectable and not one.is_right_cause
    bad = not one.cause and one.level in ("bad", "none")
    if not (one.is_false or missed or bad or (one.is_wrong and one.level == "good")):
        return ""
    return (
        f"{one.number}: {one.level}, {one.over_sigma:.1f} sigma, {one.named}, or {one.as_well}, "
        f"first {one.first}, unchecked {one.unchecked}"
    )


if __name__ == "__main__":
    study(sys.argv[2:] or GROUPS, int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
