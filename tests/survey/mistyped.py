"""Surveys with scale bars, control and centres mistyped in many ways, and right ones, each with its truth.

A case changes what a right survey gives; `study` runs it on several networks from scratch and shows how wrong
the results are and what was said. Object unit m, stated standard deviations 0.1 to 0.3 mm.

    python -m tests.survey.mistyped [NETWORKS [RIGHT]]    networks of each case, right surveys
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import FloatArray
from sfm.model.errors import KolinearError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import fit_similarity
from sfm.pipeline import run_survey
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given_values import KnownPoints, ScaleBar
from tests.findings import findings_of
from tests.surveys import survey_of
from tests.synthetic import SIZE_PX, make_network, seed_of

SIGMA = 2e-4  # of a coordinate of control and of the length of a bar, m
WRONG = 5.0  # standard deviations (root mean square over the coordinates)
NEVER_FOUND = ("bars in inches", "bars in millimetres", "the only bar 10 %")  # nothing contradicts them
PYRAMID = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0], [0, 0, 0.4]])
BOX = np.stack(np.meshgrid((-0.5, 0.5), (-0.4, 0.4), (-0.3, 0.3), indexing="ij"), axis=-1).reshape(8, 3)


@dataclass
class Given:
    """What a survey gives beside its image points; a case changes it."""

    rng: np.random.Generator
    truth: Estimate
    lengths: FloatArray  # of bars, (b,)
    ends: list[tuple[int, int]]
    names: list[int]  # of control
    xyz: FloatArray  # (n, 3)
    sigma: float = SIGMA  # stated of control
    datum: str = "control"
    exact: bool = False  # whether control is fixed
    centres: FloatArray | None = None  # observed projection centres
    upwards: bool = False  # whether y of the image points is


@dataclass(frozen=True)
class Outcome:
    """What a survey gave."""

    case: str
    level: str  # good, fair or bad; refused where there is no result
    over_sigma: float  # error of the coordinates over their standard deviations, root mean square
    kinds: tuple[str, ...]  # of the remarks, notes left out

    @property
    def is_wrong_and_good(self) -> bool:
        """Whether nobody is told that the result is wrong."""
        return self.level in ("good", "fair") and self.over_sigma > WRONG


def given_of(rng: np.random.Generator, truth: Estimate, bars: int, control: int) -> Given:
    """Return right bars and control with errors of their stated standard deviations."""
    order = rng.permutation(len(truth.points)).tolist()
    ends = [(order.pop(), order.pop()) for _ in range(bars)]
    lengths = np.array([np.linalg.norm(truth.points[i] - truth.points[j]) for i, j in ends])
    names = order[:control]
    return Given(
        rng,
        truth,
        lengths + SIGMA * rng.standard_normal(bars),
        ends,
        names,
        truth.points[names] + SIGMA * rng.standard_normal((control, 3)),
        datum="control" if control else "free",
    )


def _bar(factor: float, more: float = 0.0) -> Callable[[Given], None]:
    def change(given: Given) -> None:
        given.lengths[0] = factor * given.lengths[0] + more

    return change


def _all_bars(factor: float) -> Callable[[Given], None]:
    def change(given: Given) -> None:
        given.lengths *= factor

    return change


def _digits(given: Given) -> None:
    """Exchange the second and third digit behind the point."""
    text = f"{given.lengths[0]:.6f}"
    k = text.index(".")
    swapped = text[: k + 2] + text[k + 3] + text[k + 2] + text[k + 4 :]
    if swapped == text:
        swapped = text[: k + 2] + str((int(text[k + 2]) + 5) % 10) + text[k + 3 :]
    given.lengths[0] = float(swapped)


def _ends(given: Given) -> None:
    given.ends[0] = (given.ends[0][0], next(j for j in range(30) if j not in given.ends[0]))


def _off(distance: float) -> Callable[[Given], None]:
    def change(given: Given) -> None:
        given.xyz[0, given.rng.integers(3)] += distance

    return change


def _off_in_plane(given: Given) -> None:
    given.xyz[0] += 2e-3 * (given.xyz[0] - given.xyz[1]) / np.linalg.norm(given.xyz[0] - given.xyz[1])


def _times(factor: float) -> Callable[[Given], None]:
    def change(given: Given) -> None:
        given.xyz, given.sigma = factor * given.xyz, factor * given.sigma

    return change


def _axes(*axes: int, sign: tuple[float, float, float] = (1, 1, 1)) -> Callable[[Given], None]:
    def change(given: Given) -> None:
        given.xyz = given.xyz[:, list(axes)] * sign

    return change


def _axes_of_one(given: Given) -> None:
    given.xyz[0] = given.xyz[0, [1, 0, 2]]


def _names(given: Given) -> None:
    given.names[0], given.names[1] = given.names[1], given.names[0]


def _order(*order: int) -> Callable[[Given], None]:
    def change(given: Given) -> None:
        given.names = [given.names[k] for k in order]

    return change


def _too_precise(given: Given) -> None:
    given.xyz += 9.95 * SIGMA * given.rng.standard_normal(given.xyz.shape)


def _some_off(count: int) -> Callable[[Given], None]:
    def change(given: Given) -> None:
        given.xyz[:count] += 0.3 * given.rng.standard_normal((count, 3))

    return change


def _axes_of_four(given: Given) -> None:
    given.xyz[:4] = given.xyz[:4, [1, 0, 2]]


def _next_row(given: Given) -> None:
    """Give each point the coordinates in the next row, the last those of a point that is not in the list."""
    other = next(j for j in range(30) if j not in given.names)
    given.xyz = np.concatenate([given.xyz[1:], given.truth.points[[other]]])


def _turned_rows(count: int, *, exact: bool = False) -> Callable[[Given], None]:
    def change(given: Given) -> None:
        given.xyz[:count] = np.roll(given.xyz[:count], 1, axis=0)
        given.exact = exact

    return change


def _two_bars(given: Given) -> None:
    given.lengths[:2] *= (1.1, 0.75)


def _upwards(given: Given) -> None:
    given.upwards = True


def _centres(change: Callable[[FloatArray], FloatArray]) -> Callable[[Given], None]:
    def both(given: Given) -> None:
        centres = given.truth.position
        given.centres = change(centres + SIGMA * given.rng.standard_normal(centres.shape))
        given.datum = "control"

    return both


def _upwards_with_centres(given: Given) -> None:
    _centres(np.copy)(given)
    given.upwards = True


def _only_checks(change: Callable[[Given], None]) -> Callable[[Given], None]:
    def both(given: Given) -> None:
        given.datum = "free"
        change(given)

    return both


def _turned(radians: float) -> Callable[[FloatArray], FloatArray]:
    c, s = np.cos(radians), np.sin(radians)
    return lambda X: X @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


# name, bars, control points, what is changed
CASES: tuple[tuple[str, int, int, Callable[[Given], None]], ...] = (
    ("the only bar 10 %", 1, 0, _bar(1.1)),
    ("one of two bars 10 %", 2, 0, _bar(1.1)),
    ("one of two bars 300 for 400", 2, 0, _bar(0.75)),
    ("one of two bars / 10", 2, 0, _bar(0.1)),
    ("one of two bars x 10", 2, 0, _bar(10.0)),
    ("one of two bars 1 %", 2, 0, _bar(1.01)),
    ("one of two bars 24 sigma", 2, 0, _bar(1.0, 24 * SIGMA)),
    ("one of two bars, digits", 2, 0, _digits),
    ("one of two bars, inches", 2, 0, _bar(1 / 25.4)),
    ("one of two bars, wrong end", 2, 0, _ends),
    ("one of three bars, digits", 3, 0, _digits),
    ("one of three bars x 1000", 3, 0, _bar(1000.0)),
    ("one of three bars 24 sigma", 3, 0, _bar(1.0, 24 * SIGMA)),
    ("one of three bars, wrong end", 3, 0, _ends),
    ("bars in kilometres", 2, 0, _all_bars(1e-3)),
    ("bars in millimetres", 2, 0, _all_bars(1e3)),
    ("bars in inches", 2, 0, _all_bars(1 / 0.0254)),
    ("control 2 mm", 0, 8, _off(2e-3)),
    ("control 6 sigma", 0, 8, _off(6 * SIGMA)),
    ("control 50 sigma", 0, 8, _off(50 * SIGMA)),
    ("one of four control, 50 sigma", 0, 4, _off(50 * SIGMA)),
    ("one of three control, 2 mm", 0, 3, _off_in_plane),
    ("control mirrored", 0, 8, _axes(0, 1, 2, sign=(1, 1, -1))),
    ("control, X and Y exchanged", 0, 8, _axes(1, 0, 2)),
    ("one control point, X and Y", 0, 8, _axes_of_one),
    ("two names exchanged", 0, 8, _names),
    ("two names of a pyramid", 0, 5, _names),
    ("opposite names of a pyramid", 0, 5, _order(2, 1, 0, 3, 4)),
    ("one point of a pyramid", 0, 5, _off(50 * SIGMA)),
    ("two names of a box", 0, 8, _names),
    ("left and right names of a box", 0, 8, _order(4, 5, 6, 7, 0, 1, 2, 3)),
    ("control in kilometres", 0, 6, _times(1e-3)),
    ("control in millimetres, bars not", 2, 6, _times(1e3)),
    ("control 1 %, two bars", 2, 6, _times(1.01)),
    ("control, one bar 1 %", 1, 6, _bar(1.01)),
    ("control, one of two bars 1 %", 2, 6, _bar(1.01)),
    ("twenty points too precise, bars", 2, 20, _too_precise),
    ("checking control 50 sigma", 2, 6, _only_checks(_off(50 * SIGMA))),
    ("checking control mirrored", 1, 6, _only_checks(_axes(1, 0, 2))),
    ("two of three bars", 3, 0, _two_bars),
    ("four control, X and Y exchanged", 0, 4, _axes(1, 0, 2)),
    ("five control, X and Y exchanged", 0, 5, _axes(1, 0, 2)),
    ("four of eight control, X and Y", 0, 8, _axes_of_four),
    ("three of eight control", 0, 8, _some_off(3)),
    ("four of ten control", 0, 10, _some_off(4)),
    ("four of eight control", 0, 8, _some_off(4)),
    ("control shifted by a row", 0, 8, _next_row),
    ("control turned by a row", 0, 8, _turned_rows(8)),
    ("fixed control turned by a row", 0, 8, _turned_rows(8, exact=True)),
    ("checking fixed control turned", 1, 8, _only_checks(_turned_rows(8, exact=True))),
    ("three names of eight turned", 0, 8, _turned_rows(3)),
    ("y upwards, four control", 0, 4, _upwards),
    ("y upwards, eight control", 2, 8, _only_checks(_upwards)),
    ("y upwards, centres", 0, 0, _upwards_with_centres),
    ("centres, X and Y exchanged", 0, 0, _centres(lambda X: X[:, [1, 0, 2]])),
    ("centres turned by a row", 0, 0, _centres(lambda X: np.roll(X, 1, axis=0))),
    ("centres 2 mm off, control", 0, 6, _centres(lambda X: X + np.array([2e-3, 0, 0]))),
    ("centres 100 m off, control, bars", 2, 6, _centres(lambda X: X + np.array([100, 0, 0]))),
    ("centres turned, control", 0, 6, _centres(_turned(0.01))),
    ("centres turned, two control", 0, 2, _centres(_turned(0.01))),
    ("centres 1 %, control, bars", 2, 6, _centres(lambda X: 1.01 * X)),
)
RIGHT = ((1, 0), (2, 0), (3, 0), (6, 0), (0, 3), (0, 4), (0, 8), (0, 20), (1, 4), (2, 6), (3, 20))


def scene(name: str, figure: FloatArray | None = None) -> tuple[Network, Estimate]:
    """Return the network of this name, the first points of which are those of a figure."""
    return make_network(seed_of(name), images=8, points=30, visibility=0.8, figure=figure)


def outcome_of(case: str, network: Network, given: Given) -> Outcome:
    """Run a survey from scratch and hold its result against the truth."""
    parts: dict[str, object] = {"datum": {"kind": given.datum}}
    if given.upwards:
        seen = network.image_points
        xy = seen.xy * (1, -1) + (0, SIZE_PX[1] - 1)
        network = replace(network, image_points=replace(seen, xy=xy))
    if given.centres is not None:
        parts["exterior"] = ObservedExterior.from_arrays(network.images, given.centres, SIGMA)
    if given.ends:
        parts["scale_bars"] = tuple(
            ScaleBar(str(i + 1), str(j + 1), float(length), max(SIGMA, 1e-4 * float(length)))
            for (i, j), length in zip(given.ends, given.lengths, strict=True)
        )
    if given.names:
        names = [str(j + 1) for j in given.names]
        parts["control"] = KnownPoints.from_arrays(names, given.xyz, 0.0 if given.exact else given.sigma)
    try:
        result = run_survey(survey_of(network, given.truth, **parts))
    except KolinearError:
        return Outcome(case, "refused", np.nan, ())
    found = findings_of(result)
    said = [one for one in found.verdict.remarks if one.severity != "note"]
    return Outcome(case, found.verdict.level, _error(result, network, given.truth), kinds_of(said))


def _error(result: SurveyResult, network: Network, truth: Estimate) -> float:
    """Return the error of the coordinates over their standard deviations, a free frame fitted."""
    a = result.adjustment
    X = truth.points[[network.point_index(name) for name in result.network.points]]
    found = a.estimate.points
    if a.datum != "control":
        found = fit_similarity(found, X, scale=1.0).apply(found)
    sigma = np.sqrt(np.trace(a.covariance.points, axis1=1, axis2=2).mean() / 3)
    return float(np.sqrt(((found - X) ** 2).mean()) / sigma)


def mistyped(case: str, number: int) -> Outcome:
    """Return what a survey of a case gave, on the network of this number."""
    bars, control, change = next(one[1:] for one in CASES if one[0] == case)
    figure = next((xyz for word, xyz in (("pyramid", PYRAMID), ("box", BOX)) if case.endswith(word)), None)
    network, truth = scene(f"mistyped {number}", figure)
    rng = seed_of(f"mistyped {case} {number}")
    given = given_of(rng, truth, bars, control)
    if figure is not None:
        given.names = list(range(control))
        given.xyz = figure + SIGMA * rng.standard_normal(figure.shape)
    change(given)
    return outcome_of(case, network, given)


def right(number: int) -> Outcome:
    """Return what a right survey of this number gave."""
    bars, control = RIGHT[number % len(RIGHT)]
    network, truth = scene(f"right {number}")
    given = given_of(seed_of(f"right given {number}"), truth, bars, control)
    if control and number % 2:
        given.datum = "free"
    elif control and number % 4:
        _centres(np.copy)(given)
    return outcome_of(f"{bars} bars, {control} control points, {given.datum}", network, given)


def study(cases: Iterable[str], networks: int, rights: int) -> list[Outcome]:
    """Return the outcomes of mistyped surveys and then of right ones, and print a table."""
    every: list[Outcome] = []
    for case in cases:
        found = [mistyped(case, k) for k in range(networks)]
        every += found
        levels = Counter(one.level for one in found)
        said = Counter(kind for one in found for kind in dict.fromkeys(one.kinds))
        worst = max((one.over_sigma for one in found if one.level in ("good", "fair")), default=np.nan)
        wrong = sum(one.is_wrong_and_good for one in found)
        print(f"{case:34s} {dict(levels)!s:28s} believed: {worst:8.2f} sigma {wrong:2d} wrong  {dict(said)}")
        sys.stdout.flush()
    good = [right(k) for k in range(rights)]
    for one in good:
        if one.level != "good":
            print(f"right: {one}")
    print(f"right surveys: {dict(Counter(one.level for one in good))}")
    return every + good


if __name__ == "__main__":
    numbers = [int(text) for text in sys.argv[1:]]
    study([one[0] for one in CASES], *(numbers + [6, 200][len(numbers) :]))
