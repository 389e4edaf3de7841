"""What survey observations and mounts are judged beside: the given values of the datum, and the bars."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.judgement.given import free_network
from sfm.judgement.given import judge as given
from sfm.judgement.given.free_network import FreeNetwork
from sfm.judgement.given.groups import GivenSettings
from sfm.judgement.given.judge import JudgedGiven, judge_given
from sfm.judgement.given.mounts import judge_mount_scales
from sfm.judgement.given.tables import Contradiction, Table
from sfm.model.conventions import angles_from_rotation, rotation_from_vector
from sfm.model.estimate import Estimate, values_of
from sfm.model.network import ExteriorObservations, Network, ScaleBars
from sfm.model.observations.kind import MOUNT, PHOTOGRAPH, POINT
from sfm.model.observations.point_pairs import HeightDifferences
from sfm.model.observations.pose import MountObservations
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import Similarity, fit_similarity
from tests.rigs import make_rig
from tests.synthetic import make_network, observed_anew, seed_of

UNCHANGED = Similarity(1.0, np.eye(3), np.zeros(3))


@pytest.fixture(scope="module")
def made() -> tuple[Network, Estimate, FreeNetwork]:
    """Photographs with control, two bars and heights, without errors and in the frame of the object."""
    network, truth = make_network(seed_of("beside"), images=6, points=20)
    network = observed_anew(network, truth, 0.0, seed_of("beside"))
    free = FreeNetwork(adjust(network, truth, datum=Datum("free"), reject="none"))
    X = truth.points
    start, end = np.arange(5), np.arange(5) + 8
    heights = HeightDifferences(start, end, (X[end, 2] - X[start, 2])[:, None], np.full((5, 1), 1e-3))
    length = np.linalg.norm(X[[10, 11]] - X[[16, 17]], axis=1)
    bars = ScaleBars(np.array([10, 11]), np.array([16, 17]), length, np.full(2, 1e-3))
    network = network.with_control(network.points[:8], X[:8], 1e-3)
    return network.with_given(bars, further=(heights,)), truth, free


def judged(
    network: Network, free: FreeNetwork | None, kind: Literal["free", "control"], **parts: Any
) -> JudgedGiven:
    settings = GivenSettings(Datum(kind), "m")
    return judge_given(network, free, settings, place=lambda _: UNCHANGED, **parts)


@pytest.mark.parametrize("kind", ["free", "control"])
def test_tables_are_judged_beside_the_values_that_carry_the_datum(
    kind: Literal["free", "control"],
    made: tuple[Network, Estimate, FreeNetwork],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In a free datum control places the network afterwards, and bars scale it in any."""
    network, truth, free = made
    variance = np.tile(np.diag([1e-6] * 3 + [np.inf] * 3), (2, 1, 1))
    centres = ExteriorObservations(np.arange(2), truth.position[:2], np.zeros((2, 3)), variance)
    beside: list[tuple[Network, Any]] = []
    monkeypatch.setattr(
        given, "judge_tables", lambda tables, part, _, place, level: beside.append((part, place)) or ()
    )
    found = judged(network.with_given(centres), free, kind)
    ((part, place),) = beside
    in_control = kind == "control"
    assert (len(part.control), len(part.exterior), len(part.scale_bars)) == (
        (8, 2, 2) if in_control else (0, 0, 2)
    )
    assert [len(one) for one in part.further] == [5]
    assert (place(part) is UNCHANGED) != in_control  # which control has decided before
    assert not found.others_contradict and found.network.further == network.further


def test_observations_without_a_datum_of_control_are_not_judged(
    made: tuple[Network, Estimate, FreeNetwork],
) -> None:
    network, _, free = made
    assert "given_not_judged" not in kinds_of(judged(network, free, "control").remarks)
    none = judged(network, None, "control")
    assert [one.names("of") for one in none.remarks] == [("bars", "control"), ("observations",)]
    assert none.checks_handedness  # control in space connects the parts, whatever its precision
    flat = network.with_control(network.points[:8], network.control.xyz * [1, 1, 0], 1e-3)
    assert not judged(flat, None, "control").checks_handedness
    assert not judged(network, None, "free").checks_handedness
    alone = network.with_given(further=())
    assert [one.names("of") for one in judged(alone, None, "control").remarks] == [("bars", "control")]
    without = judge_given(network, free, GivenSettings(Datum("free"), "m"))
    assert [one.names("of") for one in without.remarks] == [("observations",)]


@pytest.mark.parametrize(("wrong", "whole"), [((0, 1, 2, 3, 4), True), ((2,), False), ((), False)])
def test_wrong_observations_leave_the_network(
    wrong: tuple[int, ...], whole: bool, made: tuple[Network, Estimate, FreeNetwork]
) -> None:
    """Named by their ends; a whole table by its kind, and the control stays."""
    network, _, free = made
    heights = network.further[0]
    assert isinstance(heights, HeightDifferences)
    off = np.where(np.isin(np.arange(5), wrong), [0.3, -0.2, 0.25, 0.4, -0.3], 0.0)[:, None]
    spoiled = network.with_given(further=(replace(heights, value=heights.value + off),))
    found = judged(spoiled, free, "control")
    kinds = ("kind_wrong",) if whole else ("observations_wrong",) if wrong else ()
    assert kinds_of(found.remarks) == ("given_weakly_checked", *kinds)  # the bars
    assert found.others_contradict == bool(wrong)
    assert [len(one) for one in found.network.further] == ([] if whole else [5 - len(wrong)])
    assert len(found.network.control) == 8 and len(found.network.scale_bars) == 2


@pytest.mark.parametrize(("bars", "kinds", "judged_again"), [(1, 2, True), (1, 1, False), (2, 2, False)])
def test_the_one_scale_of_bars_that_several_kinds_contradict_is_open(
    bars: int,
    kinds: int,
    judged_again: bool,
    made: tuple[Network, Estimate, FreeNetwork],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Then the bar is judged as a table of distances beside them, and may be what is wrong."""
    network, _, free = made
    network = network.with_given(network.scale_bars.select(np.arange(bars)))
    wrong = tuple(Contradiction(f"kind {k}", whole=True) for k in range(kinds))
    asked: list[list[Table]] = []

    def judge(tables: list[Table], part: Network, *_: Any) -> tuple[Contradiction, ...]:
        asked.append(list(tables))
        if len(asked) == 1:
            return wrong
        assert len(part.scale_bars) == 0
        return (Contradiction("distances", tuple((tables[-1].number, k) for k in range(bars)), whole=True),)

    monkeypatch.setattr(given, "judge_tables", judge)
    found = judged(network, free, "free")
    assert len(asked) == 1 + judged_again
    if judged_again:
        assert [one.kind.name for one in asked[1]] == ["height differences", "distances"]
        assert asked[1][-1].number == 1
        assert len(found.network.scale_bars) == 0
    else:
        assert len(found.network.scale_bars) == bars


@pytest.mark.parametrize(
    ("control", "centres", "kind"),
    [(False, False, "control"), (True, False, "control"), (False, True, "control"), (True, True, "free")],
)
def test_the_datum_stays_while_one_kind_of_given_points_is_used(
    control: bool, centres: bool, kind: str, made: tuple[Network, Estimate, FreeNetwork]
) -> None:
    """Those that are mirrored are not; without any the datum is free."""
    network, truth, free = made
    mirror = np.array([1.0, 1.0, -1.0])
    xyz = truth.points[:12] * (mirror if control else 1.0)
    position = truth.position * (mirror if centres else 1.0)
    variance = np.tile(np.diag([1e-6] * 3 + [np.inf] * 3), (6, 1, 1))
    exterior = ExteriorObservations(np.arange(6), position, np.zeros((6, 3)), variance)
    network = network.with_control(network.points[:12], xyz, 1e-3).with_given(exterior)
    found = judged(network.with_given(ScaleBars(), further=()), free, "control")
    assert found.datum.kind == kind
    assert [len(found.network.control), len(found.network.exterior)] == [
        0 if control else 12,
        0 if centres else 6,
    ]
    assert (found.placing is None) == (control and centres) and found.checks_handedness
    of = [one.names("of")[0] for one in found.remarks if one.kind == "given_mirrored"]
    assert of == [name for name, wrong in (("control", control), ("centres", centres)) if wrong]


@pytest.mark.parametrize("size", [0.5, 4.0])
def test_motions_of_unknowns_are_those_of_a_similarity(size: float) -> None:
    """A rotation turns image axes with the network, and a scale lengthens the bases of rigs."""
    _, truth = make_rig(seed_of("motions"), moments=3)
    assert truth.mounts is not None
    values, centre = values_of(truth), np.array([1.0, -2.0, 0.5])
    found = free_network._motions(values, truth, centre, size)
    np.testing.assert_allclose(found[PHOTOGRAPH][:, 3:, 3:6] * size, values.M)
    assert not found[PHOTOGRAPH][:, 3:, [0, 1, 2, 6]].any()
    np.testing.assert_allclose(found[PHOTOGRAPH][:, :3, 6] * size, values.position - centre)
    np.testing.assert_allclose(found[POINT][:, :, 6] * size, values.points - centre)
    bases = np.where(truth.mounts.free[:, :3], values.mount_position, 0.0)
    np.testing.assert_allclose(found[MOUNT][:, :3, 6] * size, bases)
    assert not found[MOUNT][:, 3:].any() and not found[MOUNT][:, :, :6].any() and bases.any()


def test_a_mount_without_a_base_has_no_scale_to_judge() -> None:
    """Nor is one judged where the cameras are on no rig: both are used as they are given."""
    network, truth = make_rig(seed_of("no base"), moments=4, cameras=3, points=20)
    assert truth.mounts is not None
    free = FreeNetwork(adjust(network, truth, datum=Datum("free"), reject="none"))
    rotation = np.swapaxes(truth.mounts.rotation, 1, 2)[1:]
    angles = np.array([angles_from_rotation(R) for R in rotation], dtype=float)
    covariance = np.tile(1e-8 * np.eye(6), (2, 1, 1))
    for bases in (truth.mounts.position[1:], truth.mounts.position[1:] * [[1.0], [0.0]]):
        mounts = MountObservations(np.array([1, 2]), bases, angles, covariance)
        reference = free.reference_of([mounts])
        assert reference is not None
        found, said = judge_mount_scales(mounts, network, reference, lambda _: UNCHANGED, 1e-3)
        assert found is mounts and said == ()
    long = mounts.with_values(np.hstack([truth.mounts.position[1:] * [[1.0], [1.5]], angles]))
    found, said = judge_mount_scales(long, network, reference, lambda _: UNCHANGED, 1e-3)
    assert kinds_of(said) == ("scale_contradicted",) and len(found) == 0


@pytest.mark.parametrize("scale", [0.1, 8.0])
def test_mounts_are_compared_in_the_frame_of_the_object_whatever_that_of_the_network(scale: float) -> None:
    """What is left of their covariance beside the seven motions, and their differences, are the same."""
    network, truth = make_rig(seed_of("frame of mounts"), moments=4, cameras=3, points=20)
    frame = Similarity(scale, rotation_from_vector(np.array([0.2, -0.4, 0.7])), np.array([3.0, 1.0, -2.0]))
    assert truth.mounts is not None
    angles = np.array(
        [angles_from_rotation(np.swapaxes(truth.mounts.rotation, 1, 2)[k]) for k in (1, 2)], dtype=float
    )
    covariance = np.tile(np.diag([1e-8] * 3 + [1e-8] * 3), (2, 1, 1))
    mounts = MountObservations(np.array([1, 2]), truth.mounts.position[1:], angles, covariance)
    models = []
    for placing in (UNCHANGED, frame):
        start = placing.inverse().apply_estimate(truth)
        free = FreeNetwork(adjust(network, start, datum=Datum("free"), reject="none"))
        reference = free.reference_of([mounts])
        assert reference is not None
        to_object = fit_similarity(free.adjustment.estimate.points, truth.points)
        models.append(reference.differences([mounts], to_object)[0])
    one, other = models
    np.testing.assert_allclose(
        other.precision, one.precision, rtol=1e-4, atol=1e-5 * abs(one.precision).max()
    )
    assert other.kept().chi2 == pytest.approx(one.kept().chi2, rel=1e-3)
