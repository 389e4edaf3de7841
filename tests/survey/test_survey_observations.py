"""Survey observations from tables: distances, heights, coordinate differences, zeniths, antennas."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.variance_components import by_kind
from sfm.adjustment.solve import adjust
from sfm.judgement.given import free_network
from sfm.judgement.given.tables import Contradiction, Table, as_judged
from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import FloatArray, IntArray, rotation_from_vector
from sfm.model.errors import SurveyFileError
from sfm.model.estimate import Estimate, values_of
from sfm.model.network import ExteriorObservations, InteriorObservations, Network, ObjectPoints, ScaleBars
from sfm.model.observations import planes_and_lines
from sfm.model.observations.kind import PHOTOGRAPH, Group, RowKind, TableKind, inverse_of_determined
from sfm.model.observations.planes_and_lines import Lines, PlumbLines
from sfm.model.observations.point_pairs import HeightDifferences, HorizontalDirections, OffsetDistances
from sfm.model.observations.pose import MountObservations
from sfm.model.observations.rigid_frames import RigidFrames
from sfm.model.observations.tables import TABLES
from sfm.model.remarks.remark import of_kind
from sfm.model.similarity import Similarity
from sfm.pipeline import run_survey
from sfm.products.planning.prediction import simulate_network
from sfm.report.output import write_result
from sfm.report.survey_report import text_report
from sfm.survey.inputs.survey import read_survey
from sfm.survey.observation_tables import read_observation_table
from tests.findings import findings_of
from tests.rigs import make_rig
from tests.survey.test_rigs import written
from tests.synthetic import make_network, seed_of

H = 1e-4  # step of differences, m and rad
FIVE_POINTS = ((-2 * H, 1 / (12 * H)), (-H, -8 / (12 * H)), (H, 8 / (12 * H)), (2 * H, -1 / (12 * H)))
SIGMA = {"zenith angle": 1e-4, "horizontal direction": 1e-4}  # rad; of lengths 0.1 mm


def observed(kind: str, truth: Estimate, rng: np.random.Generator, count: int = 12) -> TableKind:
    """Return observations of a kind with noise."""
    of, n = TABLES[kind], len(truth.points)
    if issubclass(of, Group):
        return group_of(of, truth, rng, SIGMA.get(kind, 1e-4))
    assert issubclass(of, RowKind)
    d, sigma = len(of.components), SIGMA.get(kind, 1e-4)
    pairs = np.array([14 + rng.choice(n - 14, 2, replace=False) for _ in range(count)])
    indices: tuple[IntArray, ...] = (pairs[:, 0], pairs[:, 1])
    lever = np.zeros((count, 0))
    if of.texts_of == PHOTOGRAPH:
        m = len(truth.position)
        indices, count = (np.arange(m), (np.arange(m) + 3) % m)[: len(of.texts)], m
        lever = rng.uniform(-0.2, 0.2, (count, len(of.numbers)))
    empty = of.of_table(indices, np.hstack([lever, np.zeros((count, d))]), np.full((count, d), sigma))
    return empty.simulated(values_of(truth), rng)


def group_of(of: type[Group], truth: Estimate, rng: np.random.Generator, sigma: float) -> Group:
    """Return observations of seven points, or of a station and six, with noise."""
    point = 14 + rng.choice(len(truth.points) - 14, 7, replace=False)
    rows, c = 7 - (of is HorizontalDirections), len(of.components)
    if issubclass(of, Lines):
        point = np.arange(7) + 7 * (of is PlumbLines)
        return of.of_group("group", point[:, None], np.zeros((7, 0)), np.full((7, 1), sigma), {})
    if of is OffsetDistances:
        ends = rng.permutation(np.stack([point, np.roll(point, 2)], axis=1))
        length = np.linalg.norm(truth.points[ends[:, 0]] - truth.points[ends[:, 1]], axis=1)[:, None]
        tape = of.of_group("tape", ends, length + 0.123, np.full((rows, 1), sigma), {})
        return tape.simulated(values_of(truth), rng)
    name = str(point[0] + 1) if of is HorizontalDirections else "group"
    empty = of(name, point, np.zeros((rows, c)), np.full((rows, c), sigma))
    if of is RigidFrames:
        R = rotation_from_vector(rng.normal(0, 1, 3))
        empty = replace(empty, value=(truth.points[point] - rng.normal(0, 1, 3)) @ R)
    return empty.simulated(values_of(truth), rng)


def network_of(name: str, kinds: tuple[str, ...] = tuple(TABLES)) -> tuple[Network, Estimate]:
    rng = seed_of(name)
    at = np.linspace(-0.5, 0.5, 7)[:, None]
    line, plumb = at * [0.6, 0.5, -0.4] + [0.1, 0.2, 0.1], at * [0.0, 0.0, 1.0] + [0.2, -0.3, 0.0]
    figure = np.concatenate([line, plumb]) + 1e-4 * rng.standard_normal((14, 3))
    network, truth = make_network(rng, images=8, points=34, free=(), figure=figure)
    return network.with_given(further=tuple(observed(kind, truth, rng) for kind in kinds)), truth


@pytest.mark.parametrize("kind", list(TABLES))
def test_derivatives_are_those_of_differences(kind: str) -> None:
    """Of v'Pv for groups, whose own parameters are fitted anew; else of every value."""
    network, truth = network_of("derivatives", (kind,))
    (one,) = network.further
    weight = np.linalg.inv(one.covariances())

    def seen(values: Estimate) -> FloatArray:
        l = one.linearise(values_of(values)).difference
        return np.einsum("na,nab,nb->n", l, weight, l) / 2 if isinstance(one, Group) else l

    linear = one.linearise(values_of(truth))
    derivatives = [J[0] for J in linear.J]
    if isinstance(one, Group):
        of_vPv = linear.difference[0] @ weight[0]
        derivatives = [np.atleast_2d(of_vPv @ np.atleast_2d(J)) for J in derivatives]
    largest = max(np.abs(by).max() for by in derivatives)
    for (of, at), by in zip(one.blocks(), derivatives, strict=True):
        for axis in range(by.shape[1]):
            slope = 0.0
            for step, factor in FIVE_POINTS:
                points, position, rotation = truth.points.copy(), truth.position.copy(), truth.rotation.copy()
                if of == PHOTOGRAPH and axis >= 3:
                    rotation[at[0]] = rotation[at[0]] @ rotation_from_vector(step * np.eye(3)[axis - 3])
                else:
                    (position if of == PHOTOGRAPH else points)[at[0], axis] += step
                moved = replace(truth, points=points, position=position, rotation=rotation)
                slope = slope + factor * seen(moved)[0]
            assert slope == pytest.approx(by[:, axis], abs=1e-8 * largest)


def network_of_all() -> tuple[Network, Estimate]:
    """Return a rig of two cameras with observations of every kind, tables and others, and its truth."""
    rng = seed_of("all kinds")
    at = np.linspace(-0.5, 0.5, 7)[:, None]
    line, plumb = at * [0.6, 0.5, -0.4] + [0.1, 0.2, 0.1], at * [0.0, 0.0, 1.0] + [0.2, -0.3, 0.0]
    network, truth = make_rig(
        rng, moments=5, points=34, free=("c", "K1"), figure=np.concatenate([line, plumb])
    )
    assert truth.mounts is not None
    C = np.array([[1.0, 0.3, 0.0], [0.3, 1.0, -0.2], [0.0, -0.2, 1.0]]) * 1e-8
    pose = np.diag([1e-3] * 3 + [1e-4] * 3) ** 2
    first = np.arange(3)
    mount = MountObservations(np.array([1]), np.zeros((1, 3)), np.zeros((1, 3)), pose[None])
    correlated = np.array([[1.0, 0.5], [0.5, 1.0]])
    interior = InteriorObservations(
        np.array([0, 0]), np.array([0, 3]), np.zeros(2), np.array([1e-3, 1e-5]), correlated
    )
    return network.with_given(
        ObjectPoints(first + 20, np.zeros((3, 3)), np.tile(C, (3, 1, 1))),
        ExteriorObservations(first, np.zeros((3, 3)), np.zeros((3, 3)), np.tile(pose, (3, 1, 1))),
        interior,
        ScaleBars(first + 14, first + 25, np.ones(3), np.full(3, 1e-4)),
        further=(*(observed(kind, truth, rng) for kind in TABLES), mount),
    ), truth


@pytest.mark.parametrize("datum", [pytest.param("free", marks=pytest.mark.slow), "control"])
def test_all_kinds_at_once_have_the_scatter_that_is_stated(datum: str) -> None:
    """25 draws, rig included: chi-square of a point and of the mount, v'Pv; redundancy numbers add up."""
    network, truth = network_of_all()
    points, mount, vPv, redundancy, constants = 0.0, 0.0, [], 0, []
    (tape,) = (kind for kind in network.further if isinstance(kind, OffsetDistances))
    (true_constant,) = tape.own_parameters(values_of(truth)).value
    rng = seed_of(f"scatter {datum}")
    for _ in range(25):
        drawn, true = simulate_network(network, truth, rng)
        a = adjust(drawn, true, reject="none", datum=Datum(datum))
        assert a.converged and a.defect == a.expected_defect == 0
        kinds = by_kind(a)
        assert set(kinds.names[1:]) >= {kind.name for kind in TABLES.values()} | {"mounts", "scale bars"}
        assert kinds.redundancy.sum() == pytest.approx(a.redundancy, abs=1e-3)
        dX = a.estimate.points[3] - true.points[3]
        points += dX @ np.linalg.solve(a.cofactors.points[3], dX)
        assert a.estimate.mounts is not None and true.mounts is not None
        dm = a.estimate.mounts.position[1] - true.mounts.position[1]
        mount += dm @ np.linalg.solve(a.cofactors.mounts[1][:3, :3], dm)
        vPv.append(a.vPv)
        (constant,) = a.group_parameters
        ((sigma,),) = np.sqrt(constant.covariance) / a.sigma0
        constants.append((constant.value[0] - true_constant) / sigma)
        redundancy = a.redundancy
    for chi2 in (points, mount):
        assert stats.chi2.ppf(0.001, 75) < chi2 < stats.chi2.ppf(0.999, 75)
    assert stats.kstest(vPv, stats.chi2(redundancy).cdf).pvalue > 0.001
    assert stats.kstest(constants, "norm").pvalue > 0.001
    assert 0.6 < np.std(constants) < 1.4


def test_without_errors_every_kind_has_the_values_of_the_truth() -> None:
    network, truth = simulate_network(*network_of_all())
    a = adjust(network, truth, reject="none", datum="control")
    assert a.vPv == pytest.approx(0.0, abs=1e-10)


def test_every_observation_has_a_name_and_a_unit_of_each_component() -> None:
    network, truth = network_of_all()
    for kind in network.observations:
        assert len(kind.names(network, truth)) == len(kind)
        units = np.array(kind.units(truth, "mm"))
        assert units.shape == np.diagonal(kind.covariances(), axis1=1, axis2=2).shape
        assert kind is not network.control or (units == "mm").all()
        if isinstance(kind, Group):
            several = len(kind.components) > 1
            parts = [label.split()[-1] in kind.components for label in kind.labels(network)]
            assert parts == [several] * units.shape[1]


def test_heights_level_a_survey_and_distances_scale_it(tmp_path: Path) -> None:
    """From a free network in any attitude; an unknown point is named, and a gross error shows."""
    network, truth = network_of("levelled", ("height difference", "distance"))
    rows = {}
    for kind, one in zip(("height difference", "distance"), network.further, strict=True):
        cells = [
            f"{network.points[i]},{network.points[j]},{float(value)!r},1e-4"
            for i, j, (value,) in zip(one.start, one.end, one.value, strict=True)  # type: ignore[attr-defined]
        ]
        rows[kind] = [",".join(("from", "to", *TABLES[kind].columns())), *cells]
    rows["distance"].append("1,elsewhere,1.0,1e-4")
    lines = ""
    for name, table in rows.items():
        file = f"{name.split()[0]}.csv"
        (tmp_path / file).write_text("\n".join(table), "utf-8")
        lines += f'[[survey_observations]]\nkind = "{name}"\nfile = "{file}"\n\n'
    result = run_survey(read_survey(written(tmp_path, network, truth, lines)))
    a = result.adjustment
    assert a.converged and a.expected_defect == 4 and a.has_scale
    order = [network.points.index(name) for name in a.network.points]
    Z, known = a.estimate.points[:, 2], truth.points[order, 2]
    assert Z - Z.mean() == pytest.approx(known - known.mean(), abs=1e-3)
    found = findings_of(result)
    (said,) = [one for one in found.verdict.remarks if one.kind == "names_missing"]
    assert said.names("names") == ("1 - elsewhere",)
    assert len(a.network.scale_bars) == 12
    write_result(found, tmp_path / "out")
    stored = json.loads((tmp_path / "out" / "summary.json").read_text("utf-8"))["further_observations"]
    assert {name: len(values) for name, values in stored.items()} == {"height difference": 12}


@pytest.mark.parametrize("kinds", [("height difference", "antenna position"), ("zenith angle",)])
def test_start_values_in_any_attitude_come_to_the_observations(kinds: tuple[str, ...]) -> None:
    """Angles from Z give no scale and no azimuth, only which way is up."""
    from sfm.survey.placing import place_on_observations

    network, truth = network_of("attitude", kinds)
    for vector in ([2.0, -1.0, 0.5], *seed_of("attitudes").normal(0.0, 2.0, (12, 3))):
        turned = Similarity(0.3, rotation_from_vector(np.array(vector)), np.array([5.0, 1.0, 2.0]))
        placed = place_on_observations(network, turned.apply_estimate(truth))
        if "antenna position" in kinds:
            assert placed.points == pytest.approx(truth.points, abs=1e-3)
        up, known = (X[:, 2] - X[:, 2].mean() for X in (placed.points, truth.points))
        assert up / up.std() == pytest.approx(known / known.std(), abs=1e-2)
    assert place_on_observations(network.with_given(further=()), truth) is truth


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("from,to,length,slength\n1,1,1.0,1e-3\n", "distance from 1 to itself"),
        ("from,to,length,slength\n1,2,1.0,0\n", "more than 0, the standard deviation"),
        ("from,to,length\n1,2,1.0\n", "no column slength"),
    ],
)
def test_wrong_tables_are_refused(text: str, said: str, tmp_path: Path) -> None:
    network, truth = make_network(seed_of("tables"), images=3, points=12, free=())
    (tmp_path / "tape.csv").write_text(text, "utf-8")
    lines = '[[survey_observations]]\nkind = "distance"\nfile = "tape.csv"\n'
    with pytest.raises(SurveyFileError, match=said):
        read_survey(written(tmp_path, network, truth, lines))


def test_a_wrong_antenna_position_leaves_and_its_photograph_stays(tmp_path: Path) -> None:
    """1 m off, of eight; and a group of too few points is named."""
    network, truth = network_of("gross", ("antenna position",))
    (one,) = network.further
    value, sigma = one.position.copy(), one.sigma  # type: ignore[attr-defined]
    value[3, 0] += 1.0
    cells = [
        ",".join(map(repr, [network.images[i], *lever, *X, *s])).replace("'", "")
        for i, lever, X, s in zip(one.image, one.lever.tolist(), value.tolist(), sigma.tolist(), strict=True)  # type: ignore[attr-defined]
    ]
    of = TABLES["antenna position"]
    (tmp_path / "gnss.csv").write_text("\n".join([",".join((*of.texts, *of.columns())), *cells]), "utf-8")
    (tmp_path / "plane.csv").write_text("group,point,offset,soffset\nwall,1,0,1e-4\nwall,2,0,1e-4\n", "utf-8")
    lines = "".join(
        f'[[survey_observations]]\nkind = "{kind}"\nfile = "{file}"\n\n'
        for kind, file in (("antenna position", "gnss.csv"), ("plane", "plane.csv"))
    )
    result = run_survey(read_survey(written(tmp_path, network, truth, lines + '[adjust]\nreject = "tau"\n')))
    assert len(result.adjustment.network.images) == 8
    remarks = {said.kind: said for said in findings_of(result).verdict.remarks}
    assert remarks["observations_wrong"].names("observations") == (f"antenna position {network.images[3]}",)
    assert remarks["names_missing"].names("names") == ("plane wall",)


def test_planes_are_met_on_either_side_of_large_offsets() -> None:
    rng = seed_of("sides")
    for size in (1e-3, 2e-2, 0.4):
        for _ in range(20):
            X = np.hstack([rng.uniform(-1, 1, (9, 2)), np.zeros((9, 1))])
            offset = rng.uniform(-size, size, (9, 1))
            X[:, 2:] = offset
            R = np.linalg.qr(rng.normal(0, 1, (3, 3)))[0]
            plane = TABLES["plane"]("p", np.arange(9), offset, np.full((9, 1), 1e-4))  # type: ignore[call-arg]
            assert plane.fit(X @ R.T).difference == pytest.approx(0.0, abs=1e-9)  # type: ignore[attr-defined]


@pytest.mark.parametrize(("line", "own"), [(False, 6), (True, 5)])
def test_frames_have_as_many_parameters_wherever_they_are(line: bool, own: int) -> None:
    """A bar has five. Frames may be small, and coordinates of their system large."""
    rng = seed_of("frame")
    for away, size in ((0.0, 1.0), (1e4, 1.0), (5e6, 1.0), (0.0, 1e-4)):
        local = size * rng.uniform(-0.5, 0.5, (5, 3)) * ([1, 0, 0] if line else [1, 1, 1])
        noise = 1e-4 * size * rng.standard_normal((5, 3))
        X = local @ np.linalg.qr(rng.normal(0, 1, (3, 3)))[0].T + noise
        frame = RigidFrames("bar", np.arange(5), local + away, np.full((5, 3), 1e-4))
        H = frame.fit(X).H.reshape(15, 6)
        assert np.linalg.matrix_rank(H / ([1.0] * 3 + [size] * 3), tol=1e-6) == own
        assert np.abs(frame.fit(X).difference).max() < 1e-3 * size


def test_heights_near_nothing_give_no_scale(tmp_path: Path) -> None:
    """Twelve differences of 0.1 mm, known to 0.1 mm."""
    network, truth = network_of("no scale", ())
    pairs = np.array([seed_of(f"pair {k}").choice(np.arange(14, 34), 2, replace=False) for k in range(12)])
    dZ = 1e-4 * seed_of("flat").standard_normal(12)
    rows = [f"{i + 1},{j + 1},{float(v)!r},1e-4" for (i, j), v in zip(pairs.tolist(), dZ, strict=True)]
    (tmp_path / "heights.csv").write_text("\n".join(["from,to,dZ,sdZ", *rows]), "utf-8")
    lines = '[[survey_observations]]\nkind = "height difference"\nfile = "heights.csv"\n\n'
    flat = replace(truth, points=truth.points * [1, 1, 0])
    network, flat = make_network(seed_of("no scale"), images=8, points=34, free=(), figure=flat.points)
    verdict = findings_of(run_survey(read_survey(written(tmp_path, network, flat, lines)))).verdict
    assert verdict.level == "bad" and verdict.remarks[0].kind == "scale_weak"


def table_of(folder: Path, network: Network, kinds: dict[str, list[TableKind]]) -> str:
    """Write tables of observations into a folder, and return what a survey file says of them."""
    lines = ""
    for word, ones in kinds.items():
        of = TABLES[word]
        for n, one in enumerate(ones):
            names = network.images if of.texts_of == PHOTOGRAPH else network.points
            factor, texts = one.in_tables(), list[tuple[str, ...]]()
            if isinstance(one, OffsetDistances):
                texts = [(one.group, *(names[one.point[k]] for k in ends)) for ends in one.ends]
            elif isinstance(one, HorizontalDirections):
                texts = [(names[one.point[0]], names[j]) for j in one.point[1:]]
            elif isinstance(one, Group):
                texts = [(one.group, names[j]) for j in one.point]
            else:
                pairs = zip(one.start, one.end, strict=True)  # type: ignore[attr-defined]
                texts = [(names[i], names[j]) for i, j in pairs]
            value, sigma = factor * one.value, factor * one.sigma  # type: ignore[attr-defined]
            rows = [
                ",".join([*text, *map(repr, [*v, *s])])
                for text, v, s in zip(texts, value.tolist(), sigma.tolist(), strict=True)
            ]
            path = folder / f"{word.replace(' ', '_')}_{n}.csv"
            path.write_text("\n".join([",".join((*of.texts, *of.columns())), *rows]), "utf-8")
            lines += f'[[survey_observations]]\nkind = "{word}"\nfile = "{path.name}"\n\n'
    return lines


def run_with(
    folder: Path, network: Network, truth: Estimate, kinds: dict[str, list[TableKind]]
) -> SurveyResult:
    """Return the result of a survey with tables of observations."""
    return run_survey(read_survey(written(folder, network, truth, table_of(folder, network, kinds))))


def reported(folder: Path, result: SurveyResult) -> Any:
    """Return the summary of a result, written with its report."""
    write_result(findings_of(result), folder / "out")
    return json.loads((folder / "out" / "summary.json").read_text("utf-8"))


@pytest.mark.sweep(1, 4, 5)
@pytest.mark.parametrize(
    ("kind", "mistake", "open_with_heights"),  # seen from below, heights and these are both the other way
    [
        ("zenith angle", "elevation", False),
        ("zenith angle", "exchanged", True),
        ("coordinate difference", "exchanged", False),
        ("relative orientation", "exchanged", False),
        ("horizontal direction", "counter-clockwise", True),
        ("rigid frame", "mirrored", False),
    ],
)
def test_a_mistake_in_a_whole_table_is_named(
    kind: str, mistake: str, open_with_heights: bool, tmp_path: Path
) -> None:
    network, truth = network_of(f"mistake {kind}", (kind, "height difference", "distance"))
    right, heights, tape = network.further
    given = {kind: [right.mistakes()[mistake]], "height difference": [heights], "distance": [tape]}
    remarks = run_with(tmp_path, network, truth, given).remarks  # type: ignore[arg-type]
    said = [one for one in remarks if one.kind in ("kind_wrong", "observations_wrong")]
    found = {(one.kind, one.names("of"), one.names("mistake")) for one in said}
    both = {("kind_wrong", ("height differences",), ("exchanged",))} if open_with_heights else set()
    assert found == {("kind_wrong", (TABLES[kind].name,), (mistake,))} | both
    assert all("agree if" in one.text for one in said)
    assert {one.severity for one in said if one.kind == "kind_wrong"} == {"warning"}  # it does no harm


@pytest.mark.parametrize(("level", "readings"), [(False, ("exchanged", "mirrored")), (True, ("mirrored",))])
def test_left_handed_differences_have_two_readings_unless_heights_decide(
    level: bool, readings: tuple[str, ...], tmp_path: Path
) -> None:
    network, truth = network_of("left-handed", ("coordinate difference", "height difference", "rigid frame"))
    right, heights, frame = network.further
    swapped = right.with_values(right.values * [1.0, -1.0, 1.0])  # as X and Y exchanged, and a rotation by Z
    given = {"coordinate difference": [swapped], "rigid frame": [frame]}
    given |= {"height difference": [heights]} if level else {}
    remarks = run_with(tmp_path, network, truth, given).remarks  # type: ignore[arg-type]
    said = {one.names("of"): one for one in remarks if one.kind == "kind_wrong"}
    assert said[("coordinate differences",)].names("mistake") == readings
    assert (", or if " in said[("coordinate differences",)].text) is not level


@pytest.mark.parametrize(
    ("mistake", "lengths", "angles"),
    [
        ("thousandfold", 1e-3, 1.0),
        ("thousandth", 1e3, 1.0),
        ("feet", 0.3048, 1.0),
        ("gon", 1.0, 0.9),
        ("radians", 1.0, 180 / np.pi),
    ],
)
def test_other_units_are_of_lengths_or_of_angles(mistake: str, lengths: float, angles: float) -> None:
    (right,) = network_of("units", ("relative orientation",))[0].further
    assert isinstance(right, TableKind)
    found = right.mistakes()[mistake]
    factors = np.array([lengths] * 3 + [angles] * 3)
    np.testing.assert_allclose(found.values, factors * right.values)
    np.testing.assert_allclose(found.sigma, factors * right.sigma)


@pytest.mark.parametrize("wrong", [True, False])
def test_angles_in_radians_are_named_and_degrees_are_not(wrong: bool, tmp_path: Path) -> None:
    """As a script writes them into a column of degrees, with their standard deviations."""
    network, truth = network_of("radians", ("horizontal direction", "height difference", "distance"))
    directions, heights, tape = network.further
    assert isinstance(directions, TableKind)
    if wrong:
        directions = directions.with_values(np.radians(directions.values))
        directions = directions.with_sigma(np.radians(directions.sigma))
    given = {"horizontal direction": [directions], "height difference": [heights], "distance": [tape]}
    remarks = run_with(tmp_path, network, truth, given).remarks  # type: ignore[arg-type]
    said = [(one.kind, one.names("mistake")) for one in remarks if one.kind.endswith("_wrong")]
    assert said == ([("kind_wrong", ("radians",))] if wrong else [])


@pytest.mark.parametrize("offset", [0.0, 0.2])
def test_points_that_are_not_on_their_plane_are_in_no_other_unit(offset: float, tmp_path: Path) -> None:
    """A standard deviation a thousand times larger would make any points agree with their plane."""
    network, truth = network_of(f"off {offset}", ("distance",))
    points, value = np.arange(14, 20), np.full((6, 1), offset)
    plane = planes_and_lines.Planes("wall", points, value, np.full((6, 1), 1e-3))
    given = {"plane": [plane], "distance": list(network.further)}
    remarks = run_with(tmp_path, network, truth, given).remarks  # type: ignore[arg-type]
    (found,) = [one for one in remarks if one.kind == "kind_wrong"]
    assert found.names("of") == ("planes",) and not found.names("mistake")
    assert "observations_unused" not in {one.kind for one in remarks}  # its points are in the result
    assert found.severity == "warning" and found.number("rest") > 100  # the image points agree


def test_of_two_verticals_that_contradict_one_another_neither_is_right_alone(tmp_path: Path) -> None:
    """Axes and heights in a free datum: each agrees without the other, and nothing else decides."""
    network, truth = network_of("two verticals", ("coordinate difference", "height difference"))
    axes, heights = network.further
    assert isinstance(heights, HeightDifferences)
    slope = 0.1 * (truth.points[heights.end, 0] - truth.points[heights.start, 0])
    tilted = replace(heights, value=heights.value + slope[:, None])
    given = {"coordinate difference": [axes], "height difference": [tilted]}
    said = of_kind(run_with(tmp_path, network, truth, given).remarks, "kind_wrong")  # type: ignore[arg-type]
    assert {one.names("of") for one in said} == {("coordinate differences",), ("height differences",)}
    assert {one.severity for one in said} == {"error"}


def test_of_rows_of_the_same_points_only_the_wrong_one_is_left_out(tmp_path: Path) -> None:
    network, truth = network_of("same points twice", ("height difference", "distance"))
    heights, tape = network.further
    assert isinstance(heights, HeightDifferences)
    twice = [*range(len(heights)), 2]
    value = heights.value[twice].copy()
    value[-1] += 0.3
    again = replace(heights.select(np.array(twice)), value=value)
    result = run_with(tmp_path, network, truth, {"height difference": [again], "distance": [tape]})
    (said,) = of_kind(result.remarks, "observations_wrong")
    assert said.names("observations") == (f"height difference {heights.names(network, truth)[2]}",)
    (kept,) = [one for one in result.network.further if isinstance(one, HeightDifferences)]
    assert len(kept) == len(heights)


def test_factors_of_several_rounds_multiply() -> None:
    network, truth = network_of("rounds", ("height difference", "distance"))
    tables = [
        Table(kind, k, np.arange(len(kind.parts(network, truth)))) for k, kind in enumerate(network.further)
    ]
    rounds = [Contradiction("height differences", factor=factor) for factor in (2.0, 3.0)]
    heights, tape = (table.kind for table in as_judged(tables, rounds))
    before, of_tape = network.further
    assert isinstance(heights, TableKind) and isinstance(before, TableKind) and tape is of_tape
    np.testing.assert_allclose(heights.sigma, 6 * before.sigma)


@pytest.mark.parametrize("wrong", [False, True])
def test_of_a_long_table_some_rows_are_judged_and_all_follow(
    wrong: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(free_network, "MAX_PLACES", 10)
    network, truth = network_of("long table", ("coordinate difference", "height difference"))
    heights, (start, end) = network.further[1], np.triu_indices(12, 1)
    dZ = (truth.points[end, 2] - truth.points[start, 2])[:, None]
    long = HeightDifferences(start, end, (-1 if wrong else 1) * dZ, np.full((len(dZ), 1), 1e-3))
    given = {"coordinate difference": [network.further[0]], "height difference": [long]}
    result = run_with(tmp_path, network, truth, given)  # type: ignore[arg-type]
    kept = [one for one in result.network.further if isinstance(one, type(heights))]
    assert [len(one) for one in kept] == ([] if wrong else [66])
    said = of_kind(result.remarks, "kind_wrong")
    assert [one.names("mistake") for one in said] == ([("exchanged",)] if wrong else [])


def test_angles_that_cannot_be_distinguished_are_refused(tmp_path: Path) -> None:
    path, of = tmp_path / "relative.csv", TABLES["relative orientation"]
    columns = ",".join((*of.texts, *of.columns()))
    path.write_text(f"{columns}\na,b,1,0,0,10,90,0,1,1,1,1,1,1\n", "utf-8")
    with pytest.raises(SurveyFileError, match="omega and kappa cannot be distinguished"):
        read_observation_table("relative orientation", path, "survey.toml")


def test_a_single_wrong_observation_leaves_its_group(tmp_path: Path) -> None:
    """One direction to another target, one height between exchanged points, a set of a second set-up."""
    network, truth = network_of("single", ("horizontal direction", "height difference", "distance"))
    first, heights, tape = network.further
    assert isinstance(first, HorizontalDirections) and isinstance(heights, HeightDifferences)
    value, dZ = first.value.copy(), heights.value.copy()
    value[2] += 0.01
    dZ[4] *= -1
    second = replace(first, value=first.value + 0.4)
    given = {
        "horizontal direction": [replace(first, value=value), second],
        "height difference": [replace(heights, value=dZ)],
        "distance": [tape],
    }
    result = run_with(tmp_path, network, truth, given)  # type: ignore[arg-type]
    target, ends = network.points[first.point[3]], heights.names(network, truth)[4]
    wrong = {
        one.names("observations"): one.names("mistake")
        for one in result.remarks
        if one.kind == "observations_wrong"
    }
    assert wrong == {
        (f"horizontal direction {network.points[first.point[0]]}: {target}",): (),
        (f"height difference {ends}",): ("exchanged",),
    }
    assert len(reported(tmp_path, result)["further_observations"]["horizontal direction"]) == 5 + 6
    sets = [kind for kind in result.network.further if isinstance(kind, HorizontalDirections)]
    assert [len(one.value) for one in sets] == [5, 6]
    assert sets[1].group == f"{sets[0].group} (2)"


@pytest.mark.parametrize(("stated", "constant"), [(0.1, 0.1), (None, 0.0)])
def test_the_constant_of_simulated_distances_is_that_of_the_table(
    stated: float | None, constant: float
) -> None:
    """Zeros, of a plan, state none."""
    _, truth = network_of("planned constant", ())
    ends, X = np.array([[0, 1], [1, 2], [2, 3]]), truth.points
    length = np.linalg.norm(X[ends[:, 1]] - X[ends[:, 0]], axis=1)[:, None]
    value = np.zeros((3, 1)) if stated is None else length + stated
    one = OffsetDistances("tape", np.arange(4), value, np.full((3, 1), 1e-3), ends)
    np.testing.assert_allclose(one.simulated(values_of(truth)).value, length + constant, atol=1e-12)


def test_distances_with_a_constant_give_the_scale_whatever_it_is(tmp_path: Path) -> None:
    """A constant of 0.1 m; one distance that is misread leaves."""
    network, truth = network_of("constant", ("distance with additive constant",))
    (one,) = network.further
    assert isinstance(one, OffsetDistances)
    value = one.value + 0.1
    value[3] += 0.05
    given = {"distance with additive constant": [replace(one, value=value)]}
    result = run_with(tmp_path, network, truth, given)  # type: ignore[arg-type]
    assert result.adjustment.has_scale
    stored = reported(tmp_path, result)
    (constant,) = stored["group_parameters"]
    assert (constant["group"], constant["names"], constant["unit"]) == ("tape", ["additive constant"], "m")
    (true,) = one.own_parameters(values_of(truth)).value + 0.1
    assert abs(constant["values"][0] - true) < 5 * np.sqrt(constant["covariance"][0][0]) < 5e-3
    assert "additive constant" in (tmp_path / "out" / "report.html").read_text("utf-8")
    (kept,) = result.network.further
    assert len(kept.value) == 6
    (said,) = of_kind(result.tests, "scale_unchecked")
    assert said.names("given") == ("the distances with additive constant tape",)
    order = [network.points.index(name) for name in result.network.points]
    sizes = [np.linalg.norm(X - X.mean(axis=0)) for X in (result.estimate.points, truth.points[order])]
    assert sizes[0] / sizes[1] == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("kind", list(TABLES))
def test_the_how_to_lists_the_columns_of_every_kind(kind: str) -> None:
    of = TABLES[kind]
    text = (Path(__file__).parents[2] / "docs" / "how-to" / "scale-and-control.md").read_text("utf-8")
    (row,) = [line for line in text.splitlines() if line.startswith("|") and f"`{kind}`" in line]
    assert f"| {','.join((*of.texts, *of.columns()))} |" in row


@pytest.mark.parametrize("line", [False, True])
def test_a_frame_alone_gives_the_scale_and_leaves_position_and_attitude_open(line: bool) -> None:
    """With its errors: they turn with the network, and a bar may turn about itself."""
    network, truth = network_of("frame alone", ())
    rng = seed_of("one frame")
    local = truth.points[14:21] + 1e-4 * rng.standard_normal((7, 3))
    if line:
        local = np.linspace(-0.5, 0.5, 7)[:, None] * [np.sqrt(0.77), 0, 0]
    frame = RigidFrames("frame", np.arange(7) + 14 * (not line), local, np.full((7, 3), 1e-4))
    a = adjust(network.with_given(further=(frame,)), truth, reject="none", datum=Datum("free"))
    assert a.defect == a.expected_defect == 6 and not a.undetermined
    assert np.sqrt(np.trace(a.covariance.points, axis1=1, axis2=2)).max() < 3e-4


def with_tip(network: Network, truth: Estimate, local: FloatArray) -> tuple[Network, FloatArray]:
    """Return the network with a tip in its frame, known to 0.1 mm, and where the tip is."""
    (frame,) = (kind for kind in network.further if isinstance(kind, RigidFrames))
    tipped = replace(frame, hidden=("tip",), hidden_value=local, hidden_sigma=np.full((1, 3), 1e-4))
    others = tuple(kind for kind in network.further if kind is not frame)
    return network.with_given(further=(*others, tipped)), tipped.own_parameters(values_of(truth)).value


@pytest.mark.slow
def test_a_tip_that_no_photograph_shows_has_the_covariance_that_is_stated() -> None:
    """Chi-square of 100 draws, 0.3 m from the frame."""
    rng, sums = seed_of("tip"), []
    network, truth = network_of("tip", ("antenna position", "rigid frame"))
    network, tip = with_tip(*simulate_network(network, truth), np.array([[0.3, 0.2, -0.1]]))
    for _ in range(100):
        drawn, true = simulate_network(network, truth, rng)
        (frame,) = (kind for kind in drawn.observations if isinstance(kind, RigidFrames))
        wrong = replace(frame, hidden_value=frame.hidden_value + 1e-4 * rng.standard_normal((1, 3)))
        others = tuple(kind for kind in drawn.observations if kind is not frame)
        a = adjust(replace(drawn, observations=(*others, wrong)), true, reject="none", datum="free")
        (found,) = a.group_parameters
        assert found.names == ("tip X", "tip Y", "tip Z")
        error = found.value - tip
        sums.append(error @ np.linalg.solve(found.covariance / a.sigma0**2, error))
    assert stats.kstest(sums, stats.chi2(3).cdf).pvalue > 0.001


def test_a_tip_follows_the_points_of_its_frame() -> None:
    """Its derivatives by them, far from the origin of the object and of the frame."""
    rng = seed_of("tip follows")
    local, tip = rng.uniform(-0.5, 0.5, (5, 3)) + np.array([3.0, -2.0, 4.0]), np.array([[3.3, -1.5, 4.2]])
    R = rotation_from_vector(np.array([0.4, -0.7, 1.1]))
    X = local @ R.T + [7.0, 5.0, -6.0] + 1e-5 * rng.standard_normal((5, 3))
    frame = RigidFrames(
        "probe", np.arange(5), local, np.full((5, 3), 1e-4), ("tip",), tip, np.full((1, 3), 1e-4)
    )
    _, truth = make_network(seed_of("tip follows"), images=3, points=5, free=())

    def tip_of(points: FloatArray) -> FloatArray:
        return frame.own_parameters(values_of(replace(truth, points=points))).value

    found = frame.own_parameters(values_of(replace(truth, points=X))).J
    expected = np.zeros((3, 5, 3))
    for p, axis in np.ndindex(5, 3):
        step = np.zeros((5, 3))
        step[p, axis] = 1e-6
        expected[:, p, axis] = (tip_of(X + step) - tip_of(X - step)) / 2e-6
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_a_tip_beside_a_bar_is_not_determined(tmp_path: Path) -> None:
    """And no row of it is called unused; on the line of the bar it is determined."""
    network, truth = network_of("bar", ("distance",))
    offset = np.array([0.1, 0.2, 0.3])
    bar = np.array([[k * 0.1, 0.0, 0.0] for k in range(3)])
    at = 20 + np.arange(3)
    points = truth.points.copy()
    points[at] = bar + offset
    network, truth = make_network(seed_of("bar"), images=8, points=34, free=(), figure=points)
    (tape,) = network_of("bar", ("distance",))[0].further
    tape = tape.simulated(values_of(truth))
    rows = [
        f"probe,{network.points[j]},{x},0,0,1e-4,1e-4,1e-4"
        for j, (x, _, _) in zip(at, bar.tolist(), strict=True)
    ]
    rows += ["probe,beside,0.3,0.1,0,1e-4,1e-4,1e-4", "probe,tip,0.4,0,0,1e-4,1e-4,1e-4"]
    columns = TABLES["rigid frame"]
    header = ",".join((*columns.texts, *columns.columns()))
    (tmp_path / "probe.csv").write_text("\n".join([header, *rows]), "utf-8")
    lines = table_of(tmp_path, network, {"distance": [tape]})
    lines += '[[survey_observations]]\nkind = "rigid frame"\nfile = "probe.csv"\n\n'
    result = run_survey(read_survey(written(tmp_path, network, truth, lines)))
    assert "names_missing" not in {one.kind for one in result.remarks}
    (computed,) = [one for one in result.tests if one.kind == "frame_points_computed"]
    assert computed.names("points") == ("probe beside", "probe tip")
    (found,) = result.adjustment.group_parameters
    sigma = np.sqrt(np.diagonal(found.covariance))
    assert np.isinf(sigma[:3]).any() and (sigma[3:] < 1e-3).all()
    order = [result.network.points.index(network.points[j]) for j in at]
    X = result.estimate.points[order]
    assert found.value[3:] == pytest.approx(X[0] + 4 * (X[2] - X[0]) / 2, abs=2e-3)
    assert "not determined" in text_report(findings_of(result))


@pytest.mark.parametrize("others", [(), ("tip", "end")])
def test_a_frame_with_one_point_in_the_photographs_is_said(others: tuple[str, ...], tmp_path: Path) -> None:
    network, truth = make_network(seed_of("frame of one point"), images=6, points=20, free=())
    names = (network.points[15], *others)
    rows = [f"F,{name},{k},0,0,1e-4,1e-4,1e-4" for k, name in enumerate(names)]
    (tmp_path / "frame.csv").write_text("\n".join(["group,point,X,Y,Z,sX,sY,sZ", *rows]), "utf-8")
    lines = '[[survey_observations]]\nkind = "rigid frame"\nfile = "frame.csv"\n\n'
    result = run_survey(read_survey(written(tmp_path, network, truth, lines)))
    (unused,) = (one for one in result.remarks if one.kind == "names_missing")
    assert "rigid frame F" in unused.names("names") and "a rigid frame 2" in unused.cause
    assert len(unused.names("names")) == 1 + len(others)


def test_differences_of_directions_have_no_mean() -> None:
    """Their orientation takes it, however much they differ."""
    rng = seed_of("directions")
    X, value = rng.uniform(-1, 1, (7, 3)), rng.uniform(0, 2 * np.pi, (6, 1))
    directions = HorizontalDirections("station", np.arange(7), value, rng.uniform(1e-4, 3e-4, (6, 1)))
    l, w = directions.fit(X).difference[:, 0], directions.weights
    assert np.abs(l).max() > 0.5 and abs((w * l).sum() / w.sum()) < 1e-12
    orientation = np.arctan2(*(X[1:, :2] - X[0, :2]).T) - value[:, 0] - l
    np.testing.assert_allclose(np.exp(1j * orientation), np.exp(1j * orientation[0]), atol=1e-12)


def test_a_plane_is_that_of_the_weights() -> None:
    rng = seed_of("weights of a plane")
    X = rng.normal(size=(8, 3)) * [1.0, 1.0, 0.1]
    w = rng.uniform(0.01, 10.0, 8)
    away = X - w @ X / w.sum()
    values, vectors = np.linalg.eigh((away * w[:, None]).T @ away)
    normal = planes_and_lines._normal(X, w)
    assert abs(normal @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-12)
    assert (w * (away @ normal) ** 2).sum() == pytest.approx(values[0])


def test_the_inverse_is_over_what_is_determined() -> None:
    """However different the units; parameters that nothing determines are left out."""
    A = seed_of("determined").normal(size=(9, 4)) * [1.0, 1e4, 1e-4, 1.0]
    N = A.T @ A
    np.testing.assert_allclose(inverse_of_determined(N) @ N, np.eye(4), atol=1e-6)
    N[3, :] = N[:, 3] = 0.0
    found = inverse_of_determined(N)
    assert not found[3].any()
    np.testing.assert_allclose(found[:3, :3] @ N[:3, :3], np.eye(3), atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "columns", "row", "refused"),
    [
        ("horizontal direction", "station,point,direction_deg,sdirection_deg", "a,b,10.0,0.001", True),
        ("plane", "group,point,offset,soffset", "floor,b,0.0,0.001", True),
        ("distance with additive constant", "instrument,from,to,length,slength", "i,a,b,1.0,0.001", False),
        ("distance", "from,to,length,slength", "a,b,1.0,0.001", False),
    ],
)
def test_a_point_is_once_in_a_group_and_a_distance_as_often_as_measured(
    kind: str, columns: str, row: str, refused: bool, tmp_path: Path
) -> None:
    path = tmp_path / "table.csv"
    again = row.replace(".0,", ".1,")  # measured again
    path.write_text("\n".join((columns, row, again)) + "\n", encoding="utf-8")
    if refused:
        with pytest.raises(SurveyFileError, match="on line 2 already"):
            read_observation_table(kind, path, "survey.toml")
    else:
        assert len(read_observation_table(kind, path, "survey.toml").value) == 2


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize("kind", ["height difference", "distance", "zenith angle", "antenna position"])
def test_copied_rows_count_once(kind: str, tmp_path: Path) -> None:
    """A copied table made its observations count twice, and their precision 1.4 times too good."""
    network, truth = network_of("copies", (kind,))
    (one,) = network.further
    names = network.images if TABLES[kind].texts_of == PHOTOGRAPH else network.points
    sigma = np.sqrt(np.einsum("nii->ni", one.covariances()))
    ends = [one.image] if hasattr(one, "image") else [one.start, one.end]  # type: ignore[attr-defined]
    factor = TABLES[kind].in_tables()
    lever = one.lever if hasattr(one, "lever") else np.zeros((len(sigma), 0))
    cells = np.hstack([lever, factor * one.values, factor * sigma]).tolist()
    rows = [
        ",".join((*(names[k] for k in of_row), *(repr(cell) for cell in row)))
        for of_row, row in zip(zip(*ends, strict=True), cells, strict=True)
    ]
    header = ",".join((*TABLES[kind].texts, *TABLES[kind].columns()))
    found = []
    for copies in (1, 3):
        folder = tmp_path / str(copies)
        folder.mkdir()
        (folder / "t.csv").write_text("\n".join([header, *(copies * rows)]), encoding="utf-8")
        text = f'[[survey_observations]]\nkind = "{kind}"\nfile = "t.csv"\n\n'
        found.append(run_survey(read_survey(written(folder, network, truth, text))))
    first, second = (result.adjustment for result in found)
    assert first.redundancy == second.redundancy
    np.testing.assert_array_equal(first.estimate.points, second.estimate.points)
    said = [one for one in found[1].remarks if one.kind == "rows_identical"]
    assert len(said[0].names("rows")) == len(set(zip(*(end.tolist() for end in ends), strict=True)))
    assert not [one for one in found[0].remarks if one.kind == "rows_identical"]


@pytest.mark.parametrize("orientation", [0.0, np.pi / 2, np.pi, -np.pi / 2, 4.0])
def test_directions_may_be_counted_from_anywhere(orientation: float) -> None:
    rng = seed_of("orientation")
    X = rng.uniform(-1, 1, (9, 3))
    away = X[1:, :2] - X[0, :2]
    value = np.arctan2(away[:, 0], away[:, 1]) - orientation + 1e-5 * rng.standard_normal(8)
    directions = HorizontalDirections("station", np.arange(9), value[:, None], np.full((8, 1), 1e-5))
    assert np.abs(directions.fit(X).difference).max() < 1e-4


@pytest.mark.parametrize("kind", TABLES)
def test_a_standard_deviation_that_no_measurement_has_is_refused(kind: str, tmp_path: Path) -> None:
    of = TABLES[kind]
    names = [["s", "a"], ["s", "b"], ["s", "c"]]
    if len(of.texts) == 3:
        names = [["s", "a", "b"], ["s", "b", "c"], ["s", "c", "a"]]
    if "group" not in of.texts and "from" in of.texts and len(of.texts) == 2 and not issubclass(of, Group):
        names = [["a", "b"], ["b", "c"], ["c", "a"]]
    if len(of.texts) == 1:
        names = [["a"], ["b"], ["c"]]
    columns = of.columns()
    d = min(len(of.components), len(columns))
    for sigma, refused in (("1e-3", False), ("1e-300", True), ("1e-10", True)):
        rows = [
            [*texts, *(f"{k + 1.5}" for _ in columns[:-d]), *([sigma] * d)] for k, texts in enumerate(names)
        ]
        file = tmp_path / "t.csv"
        file.write_text("\n".join(",".join(row) for row in [[*of.texts, *columns], *rows]) + "\n", "utf-8")
        if refused:
            with pytest.raises(SurveyFileError, match=r"needed at least .*values and sigmas in one unit"):
                read_observation_table(kind, file, "survey.toml")
        else:
            read_observation_table(kind, file, "survey.toml")


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_a_plumb_line_through_points_that_are_apart_ends_no_adjustment(seed: int) -> None:
    """In one of 14 networks a point ran away until its square overflowed, and the inverse was singular."""
    network, truth = make_network(seed_of(f"plumb {seed}"), images=12, points=50)
    given = np.arange(6)
    control = ObjectPoints(given, truth.points[given], np.tile(1e-8 * np.eye(3), (6, 1, 1)))
    line = PlumbLines("v", np.array([20, 21]), np.zeros((2, 2)), np.full((2, 2), 2e-4))
    free = np.isin(truth.cameras[0].names, ("c", "x0", "y0", "K1", "K2", "P1", "P2", "b1", "b2"))
    start = replace(truth, cameras=(replace(truth.cameras[0], free=free),))
    observed = network.with_given(control, further=(line,))
    adjust(observed, start, datum=Datum("control"), reject="tau")
