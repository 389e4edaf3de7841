"""Assumptions of large networks, which are tested in parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sfm
from sfm.adjustment.result import Adjustment
from sfm.judgement.hypotheses import hypotheses
from sfm.judgement.hypotheses.alternatives import is_significant
from sfm.judgement.hypotheses.columns import interior_columns
from sfm.judgement.hypotheses.hypotheses import contradicted_parameters, find_causes, judge_alternatives
from sfm.judgement.hypotheses.parts import SharedEvidence, SharedParameter, of_all_parts, parts_of
from sfm.judgement.hypotheses.score import Reduced, reduce_adjustment
from sfm.model.camera import project
from sfm.model.conventions import BoolArray
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.reduced_network import reduce_network
from sfm.model.remarks.remark import remark
from tests.synthetic import make_network, seed_of

PHOTOGRAPHS = 24
MOVED = np.array([0.0008, 0.0, 0.0004])  # more would be gross errors of single image points


@pytest.fixture
def in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks of more than 15 photographs are large, and tested in parts of 12."""
    monkeypatch.setattr(hypotheses, "MAX_PHOTOGRAPHS", 15)
    monkeypatch.setattr(hypotheses, "PART_PHOTOGRAPHS", 12)


def network_of(name: str, free: tuple[str, ...] = ("c", "x0", "y0")) -> tuple[Network, Estimate]:
    return make_network(seed_of(name), images=PHOTOGRAPHS, points=50, visibility=0.8, free=free)


def free_adjustment(network: Network, start: Estimate) -> Adjustment:
    return sfm.adjust(network, start, datum="free", reject="tau")


def along_a_line(m: int, each: int, step: int) -> Network:
    """Photographs in a random order, which each show so many points of a line, `step` after the last ones."""
    place = seed_of("along a line").permutation(m)
    point = (step * place[:, None] + np.arange(each)).ravel()
    image = np.repeat(np.arange(m), each)
    seen = ImagePoints(image, point, np.zeros((len(image), 2)), np.tile(np.eye(2), (len(image), 1, 1)))
    names = tuple(map(str, range(int(point.max()) + 1)))
    return Network(tuple(f"{k}" for k in place), np.zeros(m, dtype=np.int64), names, seen)


def test_a_part_has_photographs_that_show_the_same_points() -> None:
    network = along_a_line(100, 40, 10)
    parts = parts_of(network, np.ones(len(network.image_points), dtype=bool), 30)
    assert len(parts) == 4 and (np.sum(parts, axis=0) == 1).all()
    place = np.array(network.images, dtype=int)
    for part in parts:
        assert 15 <= part.sum() <= 30
        assert np.ptp(place[part]) + 1 == part.sum(), "a part of the line without gaps"


def test_parts_of_a_closed_ring_are_connected() -> None:
    """Around a building: each part is one arc."""
    line = along_a_line(100, 40, 10)
    count = 1000
    names = tuple(map(str, range(count)))
    seen = replace(line.image_points, point=line.image_points.point % count)
    network = replace(line, points=names, image_points=seen)
    place = np.array(network.images, dtype=int)
    parts = parts_of(network, np.ones(len(seen), dtype=bool), 30)
    assert (np.sum(parts, axis=0) == 1).all() and max(part.sum() for part in parts) <= 30
    for part in parts:
        gaps = np.diff(np.sort(place[part]), append=np.sort(place[part])[0] + 100) > 1
        assert gaps.sum() == 1, "an arc without gaps"


def test_unconnected_photographs_are_parts_of_their_own() -> None:
    line = along_a_line(40, 40, 10)
    seen = line.image_points
    place = np.array(line.images, dtype=int)
    far = (place >= 20)[seen.image]
    split = replace(line, points=(*line.points, *(f"b{k}" for k in line.points)))
    split = replace(split, image_points=replace(seen, point=seen.point + len(line.points) * far))
    parts = parts_of(split, np.ones(len(seen), dtype=bool), 100)
    assert sorted(tuple(np.sort(place[part])) for part in parts) == [tuple(range(20)), tuple(range(20, 40))]


def test_photographs_of_a_moment_stay_together() -> None:
    network = along_a_line(60, 40, 10)
    place = np.array(network.images, dtype=int)
    parts = parts_of(replace(network, moment=place // 3), np.ones(len(network.image_points), bool), 12)
    assert (np.sum(parts, axis=0) == 1).all()
    of = np.argmax(parts, axis=0)
    assert all(len(np.unique(of[place // 3 == moment])) == 1 for moment in range(20))
    assert max(part.sum() for part in parts) <= 12


@pytest.mark.usefixtures("in_parts")
def test_of_a_right_network_every_part_is_tested() -> None:
    network, truth = network_of("right in parts")
    judged = judge_alternatives(free_adjustment(network, truth))
    assert not judged.causes
    (said,) = judged.unchecked
    assert said.kind == "assumptions_tested" and sorted(said.names("photographs")) == sorted(network.images)
    assert said.number("parts") == 2 and said.number("most") == 12
    assert "in 2 parts of at most 12" in said.text


@pytest.mark.usefixtures("in_parts")
def test_a_wrong_lens_is_one_remark_of_all_parts() -> None:
    network, truth = network_of("wrong lens in parts")
    (camera,) = truth.cameras
    values = camera.parameters * np.where(np.array(camera.names) == "K1", 0.7, 1.0)
    start = replace(truth, cameras=(camera.with_parameters(values),))
    (said,) = judge_alternatives(free_adjustment(network, start)).causes
    assert said.kind == "held_parameter" and "K1" in said.names("parameters")


def slightly_wrong_lens(share: float) -> Adjustment:
    """Photographs of 48 stations whose K1 is held at a value that is wrong by so much."""
    network, truth = make_network(
        seed_of("shared 0"), images=48, points=60, visibility=0.5, free=("c", "x0", "y0")
    )
    (camera,) = truth.cameras
    values = camera.parameters * np.where(np.array(camera.names) == "K1", 1 - share, 1.0)
    return free_adjustment(network, replace(truth, cameras=(camera.with_parameters(values),)))


def together(parts: list[Reduced]) -> list[SharedParameter]:
    evidence = SharedEvidence()
    for part in parts:
        evidence.add(part)
    return evidence.together(parts[0].adjustment.levels.family)


def shared_parameter(parts: list[Reduced], name: str) -> SharedParameter:
    every = together(parts)
    cameras = parts[0].adjustment.estimate.cameras
    return next(x for x in every for a, s in x.joint.parameters[:1] if cameras[a].names[s] == name)


def reduced_parts(a: Adjustment) -> list[Reduced]:
    solved = hypotheses._free_parts(a, parts_of(a.network, ~a.rejected, 12))
    return [reduce_adjustment(part) for part in solved if part is not None]


@pytest.mark.usefixtures("in_parts")
def test_evidence_of_the_parts_together_is_that_of_the_network_but_for_its_links() -> None:
    a = slightly_wrong_lens(0.1)
    parts = reduced_parts(a)
    k1, whole, each = (shared_parameter(some, "K1") for some in (parts, [reduce_adjustment(a)], parts[:1]))
    assert len(parts) == 4 and 2 * each.joint.gain.value < k1.joint.gain.value < whole.joint.gain.value
    # points that two parts show, the datum and free parameters are estimated in each
    assert k1.joint.gain.value > 0.6 * whole.joint.gain.value
    sigma = abs(k1.change) / k1.joint.gain.value**0.5
    assert abs(k1.change - whole.change) < 2 * sigma
    camera = a.estimate.cameras[0]
    wanted = camera.parameters[camera.names.index("K1")] * (1 / 0.9 - 1)
    assert abs(k1.change - wanted) < 3 * sigma
    assert k1.joint.redundancy == sum(part.redundancy for part in parts)


@pytest.mark.usefixtures("in_parts")
def test_parts_whose_points_reach_differently_far_state_a_parameter_in_its_unit() -> None:
    """The unit of a column is the change whose largest effect is 1 px, which differs from part to part."""
    a = slightly_wrong_lens(0.3)
    whole, inner = a.network, reduced_parts(a)
    half = np.array(a.estimate.cameras[0].size_px) / 2
    from_middle = np.linalg.norm(whole.image_points.xy - half, axis=1)
    near = from_middle < np.quantile(from_middle, 0.6)
    within = adjusted_image_points(a, near)
    mixed = [reduce_adjustment(within), *inner[:1]]
    k1 = shared_parameter(mixed, "K1")
    units = [
        interior_columns(part.adjustment, test.own.parameters)[2][0]
        for part, test in zip(mixed, k1.of_parts, strict=True)
    ]
    assert units[0] > 1.5 * units[1]
    change = [unit * test.own.gain.beta[0] for unit, test in zip(units, k1.of_parts, strict=True)]
    information = [test.own.gain.value / c**2 for c, test in zip(change, k1.of_parts, strict=True)]
    assert k1.change == pytest.approx(np.average(change, weights=information))
    assert min(change) <= k1.change <= max(change)
    for part, test in zip(mixed, k1.of_parts, strict=True):
        step = test.own.whitened(part)[:, :, 0] * (k1.change / test.unit)
        np.testing.assert_allclose(test.scores(k1.change), part.scores(step, step), atol=1e-9)


def adjusted_image_points(a: Adjustment, kept: BoolArray) -> Adjustment:
    seen = a.network.image_points
    points = np.bincount(seen.point[kept], minlength=len(a.network.points)) > 2
    images = np.bincount(seen.image[kept], minlength=len(a.network.images)) > 6
    part, start = reduce_network(a.network, a.estimate, images, points, kept)
    return free_adjustment(part, start)


@pytest.mark.usefixtures("in_parts")
def test_parts_that_contradict_each_other_share_no_parameter() -> None:
    """Half of the parts demand more distortion and the others less, as if each flight were focused anew."""
    network, truth = make_network(
        seed_of("shared 0"), images=48, points=60, visibility=0.5, free=("c", "x0", "y0")
    )
    (camera,) = truth.cameras
    k1 = np.array(camera.names) == "K1"
    seen = network.image_points
    xy = seen.xy.copy()
    parts = parts_of(network, np.ones(len(seen), dtype=bool), 12)
    for p, images in enumerate(parts):
        other = camera.with_parameters(camera.parameters * np.where(k1, 1.5 if p % 2 else 0.9, 1.0))
        for i in np.flatnonzero(images):
            rows = np.flatnonzero(seen.image == i)
            pose = truth.position[i], truth.rotation[i], truth.points[seen.point[rows]]
            xy[rows] += project(other, *pose) - project(camera, *pose)
    a = free_adjustment(replace(network, image_points=replace(seen, xy=xy)), truth)
    solved = [reduce_adjustment(part) for part in hypotheses._free_parts(a, parts) if part is not None]
    shared = shared_parameter(solved, "K1")
    assert shared.joint.gain.value > 20, "the parts do not cancel each other"
    assert shared.joint.spread.redundancy == len(parts) - 1 and shared.joint.spread.factor > 10
    assert not is_significant(shared.joint, len(together(solved)), a.levels.family)


@pytest.mark.usefixtures("in_parts")
def test_cameras_of_a_group_in_different_parts_share_a_parameter() -> None:
    network, truth = make_network(
        seed_of("shared 0"), images=48, points=60, visibility=0.5, free=("c", "x0", "y0")
    )
    parts = parts_of(network, np.ones(len(network.image_points), dtype=bool), 12)
    (camera,) = truth.cameras
    group = tuple("lens" if name.startswith(("K", "P")) else "" for name in camera.names)
    both = tuple(replace(camera, name=name, shared=group) for name in ("left", "right"))
    two = replace(network, camera=(np.argmax(parts, axis=0) % 2).astype(np.int64))
    a = free_adjustment(two, replace(truth, cameras=both))
    solved = [reduce_adjustment(part) for part in hypotheses._free_parts(a, parts) if part is not None]
    shared = shared_parameter(solved, "K1")
    assert len(shared.of_parts) == len(solved) and {a for a, _ in shared.joint.parameters} == {0, 1}


@pytest.mark.usefixtures("in_parts")
def test_a_lens_that_no_part_names_alone_is_named_by_all_together() -> None:
    a = slightly_wrong_lens(0.08)
    for part in hypotheses._free_parts(a, parts_of(a.network, ~a.rejected, 12)):
        assert part is not None and not find_causes(part)
    (said,) = judge_alternatives(a).causes
    assert said.kind == "held_parameter" and said.number("shift") > 1
    (parameter,) = said.names("parameters")
    camera = a.estimate.cameras[0]
    held = camera.parameters[camera.names.index(parameter)]
    fitting = held + shared_parameter(reduced_parts(a), parameter).change
    assert said.number("value") == held and said.number("instead_of") == pytest.approx(fitting, rel=0.02)
    assert judge_alternatives(slightly_wrong_lens(0.0)).causes == ()


@pytest.mark.usefixtures("in_parts")
def test_parameters_that_a_large_network_demands_are_found_in_its_parts() -> None:
    assert contradicted_parameters(slightly_wrong_lens(0.1))[0] == ("camera 1", "K1")
    assert contradicted_parameters(slightly_wrong_lens(0.0)) == ()


@pytest.mark.usefixtures("in_parts")
def test_points_that_moved_are_named_by_their_part() -> None:
    network, truth = network_of("moved in parts", free=())
    seen = network.image_points
    moved, later = np.isin(seen.point, (4, 9, 17)), seen.image >= PHOTOGRAPHS // 2
    xy = seen.xy.copy()
    for k in np.flatnonzero(moved & later):
        i, points = seen.image[k], truth.points[[seen.point[k]]]
        pose = truth.cameras[0], truth.position[i], truth.rotation[i]
        xy[k] += (project(*pose, points + MOVED) - project(*pose, points))[0]
    judged = judge_alternatives(free_adjustment(replace(network, image_points=replace(seen, xy=xy)), truth))
    named = {name for said in judged.causes if said.kind == "points_moved" for name in said.names("points")}
    assert named == {network.points[j] for j in (4, 9, 17)}


@pytest.mark.usefixtures("in_parts")
def test_photographs_of_parts_without_a_solution_are_not_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = network_of("half in parts")
    solved = hypotheses.adjust_image_points
    count = iter(range(9))

    def first_only(*given: object, **how: object) -> Adjustment | None:
        return solved(*given, **how) if next(count) == 0 else None  # type: ignore[arg-type]

    a = free_adjustment(network, truth)
    monkeypatch.setattr(hypotheses, "adjust_image_points", first_only)
    tested, untested = judge_alternatives(a).unchecked
    assert untested.kind == "photographs_untested"
    both = (*tested.names("photographs"), *untested.names("photographs"))
    assert sorted(both) == sorted(network.images) and len(untested.names("photographs")) == 12


def test_remarks_of_parts_are_joined_where_they_claim_the_same() -> None:
    here = remark("points_moved", points=("1", "2"), shift=3.0, distance=0.1, **{"from": "image 5"})
    there = remark("points_moved", points=("2", "9"), shift=5.0, distance=0.2, **{"from": "image 5"})
    later = remark("points_moved", points=("4",), shift=9.0, distance=0.9, **{"from": "image 50"})
    joined, single = of_all_parts((here, there, later))
    assert joined.names("points") == ("1", "2", "9") and joined.number("distance") == 0.2
    assert single == later
    down, up = (remark("camera_drift", camera="a", change=(c, "%"), shift=3.0) for c in (-3.0, 0.2))
    assert of_all_parts((down, up)) == (down, up)


def test_remarks_on_different_parameters_stay_apart() -> None:
    one = remark("held_parameter", parameters=("K1",), camera="a", shift=3.0)
    other = remark("held_parameter", parameters=("K2",), camera="a", shift=5.0)
    assert of_all_parts((one, other)) == (one, other)
