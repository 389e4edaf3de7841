"""Photographs that are lost: groups, with what would connect them; those from one place."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import sfm
from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, Source, empty_estimate
from sfm.model.reduced_network import reduce_network
from sfm.model.remarks.remark import remark
from sfm.orientation.incremental.sequence import Orientation
from sfm.survey.diagnosis import lost_photographs
from sfm.survey.diagnosis.lost_photographs import (
    MIN_PARALLAX,
    explain_lost_photographs,
    lost_groups,
    refuse_no_base,
    try_other_principal_distances,
)
from sfm.survey.inputs.survey import Survey
from tests.findings import findings_of
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

IMAGES, POINTS = 10, 40


def split_network() -> tuple[Network, Estimate]:
    """Return photographs of which the last four see other points than the first six, but for two."""
    network, truth = make_network(seed_of("two halves"), images=IMAGES, points=POINTS)
    seen = network.image_points
    own = np.where(seen.image < 6, seen.point < 22, seen.point >= 20)
    return replace(network, image_points=seen.select(own)), truth


def partly(truth: Estimate, oriented: BoolArray) -> Estimate:
    position, rotation = truth.position.copy(), truth.rotation.copy()
    position[~oriented], rotation[~oriented] = np.nan, np.nan
    return replace(truth, position=position, rotation=rotation)


def orientation(network: Network, estimate: Estimate) -> Orientation:
    failures = tuple(
        (network.images[i], remark("photograph_with_few_points", seen=0, needed=4))
        for i in np.flatnonzero(~estimate.oriented)
    )
    fits = estimate.oriented[network.image_points.image]
    return Orientation(estimate, failures, (), None, "given", fits, 0.1, np.full(1, 4.0))


def test_groups_that_are_not_connected_are_reported_with_what_would_connect_them() -> None:
    network, truth = split_network()
    estimate = partly(truth, np.arange(IMAGES) < 6)
    (group,) = lost_groups(network, estimate)
    assert group.images.tolist() == [6, 7, 8, 9] and not group.connected
    assert [network.points[j] for j in group.shared] == ["21", "22"]
    found = explain_lost_photographs(network, orientation(network, estimate))
    (lost,) = found.remarks
    assert lost.kind == "not_connected" and lost.number("oriented") == 6 and lost.number("needed") == 4
    assert lost.names("photographs") == ("image 7", "image 8", "image 9", "image 10")
    assert lost.names("shared") == ("21", "22") and lost.names("points") and lost.names("others")
    assert found.failures[0] == ("image 7", remark("photograph_with_few_points", seen=2, needed=4))


def test_points_of_one_oriented_photograph_connect_nothing() -> None:
    """They have no coordinates, unless these were given."""
    network, truth = split_network()
    seen = network.image_points
    kept = seen.select((seen.point < 10) | (seen.point >= 20) | (seen.image == 5))
    others = np.repeat([6, 7, 8, 9], 10)
    k = len(kept) + len(others)
    shown = ImagePoints(
        np.concatenate([kept.image, others]),
        np.concatenate([kept.point, np.tile(np.arange(10, 20), 4)]),
        np.zeros((k, 2)),
        np.tile(np.eye(2), (k, 1, 1)),
    )
    network, oriented = replace(network, image_points=shown), np.arange(IMAGES) < 6
    estimate = partly(truth, oriented)
    points = estimate.points.copy()
    points[10:20] = np.nan
    (group,) = lost_groups(network, replace(estimate, points=points))
    assert not group.connected and group.shared.tolist() == [20, 21]
    (group,) = lost_groups(network, estimate)
    assert group.connected
    unnamed = replace(network, sources=(Source("texture", names_last=False),))
    told = explain_lost_photographs(unnamed, orientation(network, replace(estimate, points=points)))
    assert not told.remarks[0].names("shared") and not told.remarks[0].names("others")


@pytest.mark.parametrize("shown", [0, 3, 4])
def test_a_photograph_with_fewer_points_than_it_needs_is_no_group(shown: int) -> None:
    network, truth = make_network(seed_of("empty"), images=IMAGES, points=POINTS)
    seen = network.image_points
    own = np.flatnonzero(seen.image == 0)[:shown]
    kept = np.isin(np.arange(len(seen)), own) | (seen.image > 0) & ~np.isin(seen.point, seen.point[own])
    network = replace(network, image_points=seen.select(kept))
    before = orientation(network, partly(truth, np.arange(IMAGES) > 0))
    found = explain_lost_photographs(network, before)
    if shown < 4:
        assert found is before
    else:
        assert [one.kind for one in found.remarks] == ["not_connected"]


def test_photographs_that_are_connected_are_no_group_of_their_own() -> None:
    network, truth = make_network(seed_of("connected"), images=IMAGES, points=POINTS)
    estimate = partly(truth, np.arange(IMAGES) < 6)
    assert all(group.connected for group in lost_groups(network, estimate))
    found = orientation(network, estimate)
    assert explain_lost_photographs(network, found) is found


@pytest.mark.parametrize("free", [True, False])
def test_a_principal_distance_that_loses_photographs_is_reported(free: bool) -> None:
    network, truth = make_network(seed_of("lost by c"), images=IMAGES, points=POINTS)
    camera = truth.cameras[0]
    given = camera_from_values(
        "a", "brown", camera.size_px, (0.005, 0.005), c_mm=7.0, free=("c",) if free else ()
    )
    start = empty_estimate(network, (given,))
    few = orientation(network, replace(partly(truth, np.arange(IMAGES) < 3), cameras=(given,)))

    def orient_from(_: Network, values: Estimate) -> Orientation:
        if values.cameras[0].value("c") < 9:
            raise GeometryError("none")
        return orientation(network, truth)

    found, remarks = try_other_principal_distances(network, start, few, orient_from)
    (wrong,) = remarks
    assert wrong.kind == "c_looks_wrong" and wrong.names("camera") == ("a",)
    numbers = [wrong.number(name) for name in ("given", "better", "oriented", "total", "before")]
    assert numbers == pytest.approx([7, 10, 10, 10, 3])
    assert found is not None and found.estimate.oriented.sum() == (10 if free else 3)


@pytest.mark.parametrize(("oriented", "better"), [(5, False), (6, False), (7, True)])
def test_another_c_orients_the_larger_part_of_what_was_lost(oriented: int, better: bool) -> None:
    network, truth = make_network(seed_of("lost by c"), images=IMAGES, points=POINTS)
    few = orientation(network, partly(truth, np.arange(IMAGES) < 3))
    more = orientation(network, partly(truth, np.arange(IMAGES) < oriented))
    remarks = try_other_principal_distances(network, truth, few, lambda *_: more)[1]
    assert bool(remarks) == better
    alone = orientation(network, partly(truth, np.arange(IMAGES) < IMAGES - 1))
    whole = orientation(network, truth)
    assert try_other_principal_distances(network, truth, alone, lambda *_: whole) == (alone, ())


def test_principal_distances_of_a_crop_factor_an_extender_and_zooms_are_tried() -> None:
    network, truth = make_network(seed_of("lost by c"), images=IMAGES, points=POINTS)
    few = orientation(network, partly(truth, np.arange(IMAGES) < 3))
    tried = []

    def refuse(_: Network, values: Estimate) -> Orientation:
        tried.append(values.cameras[0].value("c") / truth.cameras[0].value("c"))
        raise GeometryError("none")

    assert try_other_principal_distances(network, truth, few, refuse) == (few, ())
    assert tried == pytest.approx([1.4, 0.7, 2.0, 0.5])


@pytest.mark.parametrize(("times", "better"), [(1.0, True), (5.0, True), (60.0, False), (1e9, False)])
def test_another_c_is_likelier_for_all_image_points(times: float, better: bool) -> None:
    """More photographs at residuals of 6 px are no better than some at 0.1 px, those of 0.5 px are."""
    network, truth = make_network(seed_of("lost by c"), images=IMAGES, points=POINTS)
    few = orientation(network, partly(truth, np.arange(IMAGES) < 5))
    more = orientation(network, partly(truth, np.arange(IMAGES) < 8))
    more = replace(more, rms_px=times * few.rms_px)
    remarks = try_other_principal_distances(network, truth, few, lambda *_: more)[1]
    assert bool(remarks) == better


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
@pytest.mark.parametrize(("lost", "better"), [(0, True), (1, False)])
def test_misfits_lie_anywhere_in_the_photograph_they_are_in(
    lost: int, better: bool, order: tuple[int, int]
) -> None:
    """Residuals of 30 px are better than misfits in a photograph of 6000 x 4500 px, not of 600 x 450 px.

    The order of the cameras makes no difference.
    """
    network, truth = make_network(seed_of("lost by c"), images=IMAGES, points=POINTS)
    sizes = ((6000, 4500), (600, 450))
    cameras = [
        camera_from_values(name, "brown", size, (0.004, 0.004), c_mm=20.0, free=("c",))
        for name, size in zip("AB", sizes, strict=True)
    ]
    of_photograph = np.where(np.arange(IMAGES) < 3, 1 - lost, lost)
    network = replace(network, camera=np.array(order)[of_photograph])
    truth = replace(truth, cameras=tuple(cameras[k] for k in order))
    few = orientation(network, partly(truth, np.arange(IMAGES) < 3))
    more = replace(orientation(network, truth), rms_px=30.0)
    assert bool(try_other_principal_distances(network, truth, few, lambda *_: more)[1]) == better


def test_no_other_c_is_tried_for_mirrored_pictures() -> None:
    network, truth = make_network(seed_of("lost by c"), images=IMAGES, points=POINTS)
    few = orientation(network, partly(truth, np.arange(IMAGES) < 5))
    mirrored = tuple((image, remark("photograph_mirrored", turned=(0.1, "px"))) for image, _ in few.failures)
    few = replace(few, failures=mirrored)
    assert try_other_principal_distances(network, truth, few, _none) == (few, ())


@pytest.mark.parametrize(
    ("free", "times", "tried"), [(True, 4.0, True), (True, 2.0, False), (False, 4.0, False)]
)
def test_residuals_far_above_their_sigmas_are_tried_with_cameras_held(
    free: bool, times: float, tried: bool
) -> None:
    """A network that runs into a false minimum while its camera is learnt: all is oriented, and wrong."""
    network, truth = make_network(seed_of("false minimum"), images=IMAGES, points=POINTS, noise_px=0.1)
    camera = replace(truth.cameras[0], free=truth.cameras[0].free & free)
    start = empty_estimate(network, (camera,))
    wrong = replace(orientation(network, replace(truth, cameras=(camera,))), rms_px=times * 0.1)
    factors = []

    def orient_from(_: Network, values: Estimate) -> Orientation:
        factors.append(values.cameras[0].value("c") / camera.value("c"))
        assert not values.cameras[0].free.any()
        if factors[-1] > 0.8:
            return wrong
        return replace(orientation(network, replace(truth, cameras=values.cameras)), rms_px=0.1)

    found, remarks = try_other_principal_distances(network, start, wrong, orient_from)
    assert remarks == () and found is not None
    assert factors == (pytest.approx([1.0, 1.4, 0.7]) if tried else [])
    assert found.rms_px == (0.1 if tried else wrong.rms_px)
    assert (found.estimate.cameras[0].free == camera.free).all()


@pytest.mark.parametrize(
    ("noise_px", "fitting", "tried"), [(0.4, 1.0, False), (0.1, 1.0, True), (0.4, 0.8, True)]
)
def test_no_other_camera_is_tried_where_pairs_alone_fit_no_better(
    noise_px: float, fitting: float, tried: bool
) -> None:
    """Image points of a video may be worse than stated; no principal distance changes that."""
    network, truth = make_network(seed_of("pairs"), images=IMAGES, points=2 * POINTS, noise_px=noise_px)
    covariance = np.broadcast_to(0.1**2 * np.eye(2), network.image_points.covariance.shape)
    network = replace(network, image_points=replace(network.image_points, covariance=covariance))
    present = replace(orientation(network, truth), rms_px=0.35)
    k = len(present.fits)
    present = replace(present, fits=present.fits & (seed_of("fitting").permutation(k) < fitting * k))
    factors = []

    def orient_from(_: Network, values: Estimate) -> Orientation:
        factors.append(values.cameras[0].value("c"))
        return present

    start = empty_estimate(network, truth.cameras)
    assert try_other_principal_distances(network, start, present, orient_from) == (present, ())
    assert bool(factors) == tried


@pytest.mark.parametrize("better", [True, False])
def test_many_photographs_get_another_camera_only_if_a_part_of_them_does(
    monkeypatch: pytest.MonkeyPatch, better: bool
) -> None:
    """Five of ten photographs are tried first; if none of five cameras fits them, the ten are not tried."""
    monkeypatch.setattr(lost_photographs, "TRIED_FIRST", 5)
    network, truth = make_network(seed_of("false minimum"), images=IMAGES, points=POINTS, noise_px=0.1)
    camera = replace(truth.cameras[0], free=np.ones_like(truth.cameras[0].free))
    p = camera.parameters.copy()
    p[camera.parts[0]] *= 1.02
    wrong = replace(truth, cameras=(camera.with_parameters(p),))
    present = replace(orientation(network, wrong), rms_px=5.0)
    tried = []

    def orient_from(part: Network, values: Estimate) -> Orientation:
        tried.append(len(part.images))
        if not better:
            raise GeometryError("none")
        images, points = np.isin(network.images, part.images), np.isin(network.points, part.points)
        every = np.ones(len(network.image_points), dtype=bool)
        right = reduce_network(network, replace(truth, cameras=values.cameras), images, points, every)[1]
        return orientation(part, right)

    start = empty_estimate(network, (camera,))
    found, remarks = try_other_principal_distances(network, start, present, orient_from)
    assert remarks == () and tried == ([5, IMAGES] if better else [5] * 5)
    assert found is not None and found.rms_px == (0.1 if better else 5.0)


@pytest.mark.parametrize("cameras", [1, 2])
def test_a_part_that_fits_excludes_other_c_of_its_own_cameras_only(
    monkeypatch: pytest.MonkeyPatch, cameras: int
) -> None:
    """Five photographs that fit are best connected; the others, with a wrong c, may be of another camera."""
    monkeypatch.setattr(lost_photographs, "TRIED_FIRST", 5)
    network, truth = make_network(seed_of("part that fits"), images=IMAGES, points=POINTS, noise_px=0.1)
    seen, wrong = network.image_points, np.arange(IMAGES) >= 5
    best = np.where(wrong[seen.image], seen.point % 4 > 0, True)  # fewer points in photographs of the wrong c
    network = replace(network, image_points=seen.select(best), camera=wrong * (cameras - 1))
    camera = replace(truth.cameras[0], free=np.ones_like(truth.cameras[0].free))
    p = camera.parameters.copy()
    p[camera.parts[0]] *= 1.02
    of_camera = (camera, replace(camera.with_parameters(p), name="B"))[:cameras]
    present = replace(orientation(network, replace(truth, cameras=of_camera)), rms_px=5.0)
    tried = []

    def orient_from(part: Network, values: Estimate) -> Orientation:
        tried.append(len(part.images))
        raise GeometryError("none")

    try_other_principal_distances(network, empty_estimate(network, of_camera), present, orient_from)
    assert tried == ([] if cameras == 1 else [IMAGES] * 5)


def _none(*_: object) -> Orientation:
    raise AssertionError("tried")


def test_where_half_of_the_photographs_are_mirrored_c_is_right() -> None:
    network, truth = make_network(seed_of("half mirrored"), images=IMAGES, points=POINTS)
    seen = network.image_points
    turned = np.where(
        seen.image[:, None] >= 5, (truth.cameras[0].size_px[0] - 1, 0) + seen.xy * (-1, 1), seen.xy
    )
    network = replace(network, image_points=replace(seen, xy=turned))
    result = sfm.run_survey(survey_of(network, truth, free=("c",)), compare_with="none")
    verdict = findings_of(result).verdict
    kinds = {one.kind for one in verdict.remarks}
    assert "c_looks_wrong" not in kinds and kinds & {"photograph_mirrored", "photograph_of_mirror_image"}
    assert len(result.failed) == 5
    assert {one.reason.kind for one in result.failed} <= {"photograph_mirrored", "photograph_of_mirror_image"}


def test_a_survey_that_lost_the_larger_part_is_no_dependable_one() -> None:
    network, truth = split_network()
    seen = network.image_points
    network = replace(network, image_points=seen.select((seen.image < 4) | (seen.image >= 6)))
    survey: Survey = survey_of(network, truth, free=())
    result = sfm.run_survey(survey, compare_with="none")
    lost = result.images_total - len(result.adjustment.network.images)
    assert 0 < lost <= result.images_total / 2
    whole = replace(result, images_total=2 * len(result.adjustment.network.images) + 1)
    verdict = findings_of(whole).verdict
    assert verdict.level == "bad"
    assert verdict.remarks[0].kind == "photographs_missing" and verdict.remarks[0].severity == "error"


SIGMA_PX, C_PX, SIZE_PX = 0.1, 600.0, (640, 480)
STATIONS, TIE_POINTS, DISTANCE = 6, 300, 5.0


def turned(
    base_px: float, *, frontal: bool = False, distant: float = 0.0, stations: int = STATIONS
) -> tuple[Network, Estimate]:
    """Return photographs side by side, the image points of each moved by so many px against the last.

    Args:
        base_px: parallax of neighbours at the middle distance.
        frontal: a wall from the front; else an object in space, and the camera turns.
        distant: part of the points a hundred times as far away.
        stations: number of photographs.
    """
    rng = seed_of("no base")
    lens = () if frontal else (("K1", -2e-4),)
    camera = camera_from_values(
        "a", "brown", SIZE_PX, (0.01, 0.01), c_mm=C_PX * 0.01, values=lens, free=("c",)
    )
    step = base_px * DISTANCE / C_PX
    position = np.column_stack([step * np.arange(stations), np.zeros((stations, 2))])
    angle = np.zeros(stations) if frontal else np.linspace(-0.3, 0.3, stations)
    depth = np.full(TIE_POINTS, DISTANCE) if frontal else rng.uniform(0.7, 3.0, TIE_POINTS) * DISTANCE
    depth = np.where(np.arange(TIE_POINTS) < distant * TIE_POINTS, 100 * DISTANCE, depth)
    spread = rng.uniform(-0.7, 0.7, (TIE_POINTS, 2))
    points = np.column_stack([spread * depth[:, None], -depth])
    names, places, xy = [], [], []
    for i in range(stations):
        at = project(camera, position[i], _about_y(angle[i]), points)
        for j in np.flatnonzero((at > 0).all(axis=1) & (at < np.array(SIZE_PX)).all(axis=1)):
            names.append(f"image {i}")
            places.append(str(j))
            xy.append(at[j] + SIGMA_PX * rng.standard_normal(2))
    network = Network.from_arrays(names, places, np.array(xy), sigma_px=SIGMA_PX)
    given = camera_from_values("a", "brown", SIZE_PX, (0.01, 0.01), c_mm=1.3 * C_PX * 0.01, free=("c",))
    rotation = np.tile(np.eye(3), (stations, 1, 1))
    return network, Estimate((given,), position, rotation, np.zeros((len(network.points), 3)))


def _about_y(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


@pytest.mark.parametrize("parallax", [0.0, 0.5])
def test_photographs_from_one_place_are_refused_with_their_parallax(parallax: float) -> None:
    network, start = turned(parallax * MIN_PARALLAX * SIGMA_PX)
    with pytest.raises(
        GeometryError, match="no base: the 6 photographs were taken from one position"
    ) as told:
        refuse_no_base(network, start.cameras)
    assert "mask the background" not in str(told.value)


def test_of_many_photographs_a_few_pairs_show_a_base_and_all_show_that_there_is_none() -> None:
    network, start = turned(0.0, stations=50)
    with pytest.raises(GeometryError, match="no base: the 50 photographs were taken from one position"):
        refuse_no_base(network, start.cameras)
    network, start = turned(2.0 * MIN_PARALLAX * SIGMA_PX, stations=50)
    rows: list[int] = []
    measured = lost_photographs._least_parallax

    def counted(*given: Any) -> FloatArray | None:
        rows.append(len(given[2]))
        return measured(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lost_photographs, "_least_parallax", counted)
        refuse_no_base(network, start.cameras)
    assert len(rows) == 1 and rows[0] < 49


def test_photographs_without_any_motion_may_show_an_object_that_turns() -> None:
    network, start = turned(0.0, frontal=True)
    with pytest.raises(GeometryError, match=r"no base: .* mask the background"):
        refuse_no_base(network, start.cameras)


@pytest.mark.parametrize(
    ("base_px", "options"),
    [
        *((parallax * MIN_PARALLAX * SIGMA_PX, {}) for parallax in (12.0, 60.0)),
        *((parallax_px, {"frontal": True}) for parallax_px in (30.0, 90.0)),
        (60.0 * MIN_PARALLAX * SIGMA_PX, {"distant": 0.75}),
    ],
)
def test_a_base_of_some_pixels_is_one(base_px: float, options: dict[str, Any]) -> None:
    """Also before a wall from the front, and of a near object before distant hills."""
    network, start = turned(base_px, **options)
    refuse_no_base(network, start.cameras)


def test_one_photograph_from_another_place_gives_a_base() -> None:
    network, start = turned(0.0)
    moved, _ = turned(60.0)
    last = network.image_points.image == STATIONS - 1
    names = {(int(i), network.points[j]): k for k, (i, j) in enumerate(_rows(network))}
    other = {(int(i), moved.points[j]): k for k, (i, j) in enumerate(_rows(moved))}
    xy = network.image_points.xy.copy()
    both = [(k, other[key]) for key, k in names.items() if last[k] and key in other]
    assert len(both) > 20
    keep = ~last
    for k, there in both:
        xy[k], keep[k] = moved.image_points.xy[there], True
    seen = replace(network.image_points, xy=xy).select(keep)
    refuse_no_base(replace(network, image_points=seen), start.cameras)


def _rows(network: Network) -> list[tuple[int, int]]:
    seen = network.image_points
    return list(zip(seen.image.tolist(), seen.point.tolist(), strict=True))


def test_few_points_in_common_say_nothing() -> None:
    network, start = turned(0.0)
    few = network.image_points.point < 10
    refuse_no_base(replace(network, image_points=network.image_points.select(few)), start.cameras)
