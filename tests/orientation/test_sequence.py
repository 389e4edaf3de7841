"""Orientation of whole networks from image points alone."""

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.model.camera import Camera, camera_from_values, pixel_from_tangents
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ObjectPoints
from sfm.model.remarks.remark import kinds_of
from sfm.model.similarity import fit_similarity
from sfm.orientation.incremental import sequence
from sfm.orientation.incremental.sequence import OrientSettings, orient
from sfm.survey.orientation import refine as refine_network
from tests.places import SHARED
from tests.synthetic import make_network, perturb, seed_of

CAMCAL = SHARED / "data/camcal/camcal-pmexport.txt"


def refine(network, estimate):
    return adjust(network, estimate, datum=Datum("free"), reject="none", covariance=False).estimate


def unknown(truth, *, c=0.0, distortion=True, rng=None):
    """What is known before: cameras with a start value of c, and perhaps no distortion."""
    start = perturb(truth, rng or np.random.default_rng(0), c=c, distortion=distortion)
    return replace(
        start,
        position=np.full_like(truth.position, np.nan),
        rotation=np.full_like(truth.rotation, np.nan),
        points=np.full_like(truth.points, np.nan),
    )


def misfit(result, truth):
    """Largest errors of position and point after a similarity, object radius 1."""
    known = result.estimate.determined
    similarity = fit_similarity(result.estimate.points[known], truth.points[known])
    moved = similarity.apply_estimate(result.estimate)
    ok = result.estimate.oriented
    return (
        np.linalg.norm(moved.position[ok] - truth.position[ok], axis=1).max(),
        np.linalg.norm(moved.points[known] - truth.points[known], axis=1).max(),
    )


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize("planar", [False, True], ids=["spatial", "planar"])
@pytest.mark.parametrize("model", ["brown", "opencv"])
def test_calibrated_cameras(model, planar):
    network, truth = make_network(
        seed_of(f"calibrated {model} {planar}"),
        planar=planar,
        model=model,
        visibility=0.6,
        noise_px=0.1,
        free=(),
    )
    result = orient(network, unknown(truth))
    assert result.failures == () and result.estimate.determined.all() and result.fits.all()
    position, point = misfit(result, truth)
    # 0.1 px at c = 2000 px and 4 m is 0.2 mm; one photograph after another lets it grow some times
    assert position < 0.02 and point < 0.005
    assert result.rms_px < 0.3


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize("planar", [False, True], ids=["spatial", "planar"])
@pytest.mark.parametrize("c", [-0.05, 0.05])
def test_unknown_lens(c, planar):
    network, truth = make_network(seed_of(f"lens {c} {planar}"), images=16, points=50, planar=planar)
    result = orient(network, unknown(truth, c=c, distortion=False), refine=refine)
    assert result.failures == () and result.fits.all()
    assert result.rms_px < 0.12
    position, point = misfit(result, truth)
    assert position < 0.02 and point < 0.002
    assert result.estimate.cameras[0].value("c") == pytest.approx(10.0, abs=0.05)
    assert (result.estimate.cameras[0].free == truth.cameras[0].free).all()


def test_four_coplanar_points_in_each_photograph():
    network, truth = make_network(seed_of("four points"), images=21, points=4, planar=True, noise_px=0.05)
    corners = np.array([[-0.7, 0.7, 0], [0.7, 0.7, 0], [-0.7, -0.7, 0], [0.7, -0.7, 0]])
    network, truth = _seen_anew(network, replace(truth, points=corners))
    result = orient(network, unknown(truth, c=0.02, distortion=False), refine=refine)
    assert result.failures == () and result.kind == "planar" and result.rms_px < 0.2
    sides = np.linalg.norm(
        result.estimate.points[[0, 1, 3, 2]] - result.estimate.points[[1, 3, 2, 0]], axis=1
    )
    np.testing.assert_allclose(sides / sides.mean(), 1, atol=0.01)


def _seen_anew(network, truth):
    from sfm.model.camera import project

    seen = network.image_points
    xy = np.concatenate(
        [
            project(truth.cameras[0], truth.position[i], truth.rotation[i], truth.points)
            for i in range(len(network.images))
        ]
    )
    m, n = len(network.images), len(truth.points)
    image, point = np.repeat(np.arange(m), n), np.tile(np.arange(n), m)
    covariance = np.tile(seen.covariance[0], (m * n, 1, 1))
    return replace(network, image_points=ImagePoints(image, point, xy, covariance)), truth


def test_points_that_move_between_photographs_are_put_aside():
    rng = seed_of("probe")
    network, truth = make_network(rng, images=8, points=45, planar=True, visibility=0.8, cameras=2)
    # three points on a probe that stands elsewhere in every photograph
    seen = network.image_points
    m, n = len(network.images), len(network.points)
    image, point = np.repeat(np.arange(m), 3), np.tile(n + np.arange(3), m)
    xy = rng.uniform(400, 1100, (3 * m, 2))
    network = replace(
        network,
        points=(*network.points, "p1", "p2", "p3"),
        image_points=ImagePoints(
            np.concatenate([seen.image, image]),
            np.concatenate([seen.point, point]),
            np.concatenate([seen.xy, xy]),
            np.concatenate([seen.covariance, np.tile(seen.covariance[0], (3 * m, 1, 1))]),
        ),
    )
    start = unknown(truth, c=0.03, distortion=False)
    start = replace(start, points=np.full((n + 3, 3), np.nan))
    result = orient(network, start, refine=refine)
    assert result.failures == ()
    assert result.fits[: len(seen)].all() and result.rms_px < 0.15
    assert not result.fits[len(seen) :].any()
    assert result.estimate.determined.tolist() == [True] * n + [False] * 3


def test_photographs_that_cannot_be_oriented_are_named():
    network, truth = make_network(seed_of("failures"), images=8, points=40, free=())
    seen = network.image_points
    own = np.flatnonzero(seen.image == 2)
    keep = np.ones(len(seen), dtype=bool)
    keep[own[3:]] = False  # photograph 3 keeps three points
    keep[seen.image == 5] = False  # photograph 6 none
    xy = seen.xy.copy()
    wrong = seen.image == 6  # photograph 7 sees something else
    xy[wrong] = seed_of("something else").uniform(0, 1400, (int(wrong.sum()), 2))
    network = replace(network, image_points=replace(seen, xy=xy).select(keep))
    result = orient(network, unknown(truth), settings=OrientSettings(start_tolerance=0.005))
    reasons = dict(result.failures)
    assert list(reasons) == ["image 3", "image 6", "image 7"]
    assert [reason.kind for reason in reasons.values()] == [
        *2 * ("photograph_with_few_points",),
        "photograph_with_few_fitting",
    ]
    few, none, other = reasons.values()
    assert [(one.number("seen"), one.number("needed")) for one in (few, none)] == [(3, 4), (0, 4)]
    assert other.number("fitting") < other.number("needed") <= other.number("points")
    assert result.estimate.oriented.tolist() == [True, True, False, True, True, False, False, True]


def test_start_from_control():
    network, truth = make_network(seed_of("control"), images=8, points=40, visibility=0.7, free=())
    ids = np.array([0, 5, 11, 17, 23, 31])
    shifted = truth.points + np.array([1000.0, 2000.0, 50.0])
    control = ObjectPoints(ids, shifted[ids], np.zeros((6, 3, 3)))
    result = orient(network.with_given(control), unknown(truth))
    assert result.kind == "control" and result.pair is None and result.failures == ()
    np.testing.assert_allclose(result.estimate.points, shifted, atol=0.01)
    np.testing.assert_array_equal(result.estimate.points[ids], shifted[ids])


def test_three_control_points_give_the_frame():
    network, truth = make_network(seed_of("three control"), images=8, points=40, free=())
    ids = np.array([3, 8, 30])
    control = ObjectPoints(ids, 2 * truth.points[ids] + 5.0, np.zeros((3, 3, 3)))
    result = orient(network.with_given(control), unknown(truth))
    assert result.pair is not None
    np.testing.assert_allclose(result.estimate.points, 2 * truth.points + 5.0, atol=0.02)


def test_start_from_given_values():
    network, truth = make_network(seed_of("given"), images=8, points=40, free=())
    position, rotation = np.full_like(truth.position, np.nan), np.full_like(truth.rotation, np.nan)
    position[:2], rotation[:2] = truth.position[:2], truth.rotation[:2]
    start = replace(unknown(truth), position=position, rotation=rotation)
    result = orient(network, start)
    assert result.kind == "given" and result.failures == ()
    np.testing.assert_allclose(result.estimate.points, truth.points, atol=0.02)


def test_control_without_coordinates_is_intersected():
    network, truth = make_network(seed_of("free control"), images=8, points=40, free=())
    ids = np.array([0, 5, 11, 17])
    control = ObjectPoints(ids, 3 * truth.points[ids] + 10.0, np.zeros((4, 3, 3)))  # of another frame
    start = replace(unknown(truth), position=truth.position, rotation=truth.rotation)
    result = orient(network.with_given(control), start)
    assert result.kind == "given" and result.remarks == ()
    assert result.estimate.determined.all() and result.fits.all()


@pytest.mark.parametrize("what", ["one photograph", "wrong photographs", "wrong points"])
def test_given_values_of_no_use_are_put_aside(what):
    network, truth = make_network(seed_of("no use"), images=8, points=40, visibility=0.8, free=())
    start = unknown(truth)
    position, rotation, points = start.position.copy(), start.rotation.copy(), start.points.copy()
    if what == "one photograph":
        position[0], rotation[0] = truth.position[0], truth.rotation[0]
    elif what == "wrong photographs":
        position, rotation = np.roll(truth.position, 1, axis=0), np.roll(truth.rotation, 3, axis=0)
    else:
        points[:12] = seed_of("wrong points").uniform(-1, 1, (12, 3))
    start = replace(start, position=position, rotation=rotation, points=points)
    result = orient(network, start)
    assert result.failures == () and result.fits.all()
    assert kinds_of(result.remarks) == ("approximate_unused",)
    position_error, point_error = misfit(result, truth)
    assert position_error < 0.02 and point_error < 0.005


def test_a_photograph_that_fits_four_points_only_is_let_go():
    network, truth = make_network(seed_of("stranger"), images=8, points=40, free=())
    seen = network.image_points
    own = np.flatnonzero(seen.image == 4)
    point, xy = seen.point.copy(), seen.xy.copy()
    n, strange = len(network.points), own[4:24]
    point[strange] = n + np.arange(len(strange))  # names that no other photograph knows
    keep = np.ones(len(seen), dtype=bool)
    keep[own[24:]] = False
    names = (*network.points, *(f"strange {k}" for k in range(len(strange))))
    moved = replace(seen, point=point, xy=xy).select(keep)
    start = replace(unknown(truth), points=np.full((len(names), 3), np.nan))
    result = orient(replace(network, points=names, image_points=moved), start)
    (failure,) = result.failures
    assert failure[0] == network.images[4]
    assert failure[1].kind == "photograph_contradicting" and failure[1].number("confirmed") == 4


def test_points_outside_the_network_do_not_speak_against_a_photograph():
    """A photograph at the edge of a survey sees more that is its own than it has in common."""
    network, truth = make_network(seed_of("edge"), images=8, points=40, free=())
    seen = network.image_points
    own = np.flatnonzero(seen.image == 4)
    inner = own[np.argsort(np.linalg.norm(seen.xy[own] - seen.xy[own].mean(0), axis=1))]
    shared = np.zeros(len(network.points), dtype=bool)
    shared[seen.point[inner[:14]]] = True
    alone = (seen.image == 4) & ~shared[seen.point]
    point = seen.point.copy()
    n = len(network.points)
    point[alone] = n + np.arange(alone.sum())
    names = (*network.points, *(f"alone {k}" for k in range(int(alone.sum()))))
    keep = shared[seen.point] | alone
    assert alone.sum() > shared.sum()
    start = replace(unknown(truth), points=np.full((len(names), 3), np.nan))
    moved = replace(seen, point=point).select(keep)
    result = orient(replace(network, points=names, image_points=moved), start)
    assert result.failures == ()


def test_refusals():
    network, truth = make_network(seed_of("refused"), images=4, points=20, free=())
    few = network.image_points.point < 3
    with pytest.raises(GeometryError, match="no two of the 4 photographs have 4 points in common"):
        orient(replace(network, image_points=network.image_points.select(few)), unknown(truth))
    # a second photograph from the same standpoint gives no base
    same = np.isin(network.image_points.image, [0])
    one = network.image_points.select(same)
    twice = ImagePoints(
        np.concatenate([one.image, one.image + 1]),
        np.tile(one.point, 2),
        np.tile(one.xy, (2, 1)),
        np.tile(one.covariance, (2, 1, 1)),
    )
    with pytest.raises(GeometryError, match="no pair of photographs has a base"):
        orient(replace(network, image_points=twice), unknown(truth))


@pytest.mark.skipif(not CAMCAL.exists(), reason="../shared/data/camcal is not here")
@pytest.mark.parametrize(
    "c", [6.95, pytest.param(7.3, marks=pytest.mark.slow), pytest.param(7.8, marks=pytest.mark.slow)]
)
def test_camcal_from_its_four_coded_targets(c):
    rows = [line.split() for line in CAMCAL.read_text().splitlines()]
    marks = [row for row in rows if len(row) == 6 and row[1] in ("1001", "1002", "1003", "1004")]
    names = ("1001", "1002", "1003", "1004")
    image = np.array([int(row[0]) for row in marks])
    point = np.array([names.index(row[1]) for row in marks])
    xy = np.array([[float(v) for v in row[2:4]] for row in marks]) - 0.5
    m = 21
    camera = camera_from_values(
        "olympus",
        "brown",
        (2272, 1704),
        (7.25301 / 2272, 5.43764 / 1704),
        c_mm=c,
        free=("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1"),
    )
    network = Network(
        tuple(f"P82500{21 + k}" for k in range(m)),
        np.zeros(m, dtype=np.int64),
        names,
        ImagePoints(image, point, xy, np.tile(0.01 * np.eye(2), (len(xy), 1, 1))),
    )
    nan = Estimate((camera,), np.full((m, 3), np.nan), np.full((m, 3, 3), np.nan), np.full((4, 3), np.nan))
    result = orient(network, nan, refine=refine)
    assert result.failures == () and result.fits.all() and result.rms_px < 0.15
    assert result.estimate.cameras[0].value("c") == pytest.approx(7.457, abs=0.02)
    P = result.estimate.points
    sides = np.linalg.norm(P[[0, 1, 3, 2]] - P[[1, 3, 2, 0]], axis=1)
    np.testing.assert_allclose(sides / sides.mean(), 1, atol=1e-3)


def _castle(seed: int, images: int, points: int, gross: float, arc_deg: float) -> tuple[Network, Estimate]:
    """Four walls photographed from around them, with many wrong matches."""
    rng = np.random.default_rng(seed)
    values = (("K1", -1e-3), ("K2", 5e-6))
    lens = camera_from_values(
        "lens",
        "brown",
        (2000, 1500),
        (0.005, 0.005),
        c_mm=10.0,
        free=("c", "x0", "y0", "K1", "K2"),
        values=values,
    )
    side = rng.integers(0, 4, points)
    along, height, depth = (
        rng.uniform(-10, 10, points),
        rng.uniform(0, 8, points),
        10 + rng.uniform(0, 1.5, points),
    )
    outward = np.array([[0.0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, 0, 0]])[side]
    xyz = (
        depth[:, None] * outward
        + along[:, None] * np.abs(outward[:, [1, 0, 2]])
        + height[:, None] * [0, 0, 1]
    )
    angle = np.radians(np.linspace(0, arc_deg, images) + rng.normal(0, 3, images))
    radius = rng.uniform(24, 34, images)
    position = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(1, 4, images)])
    aim = np.array([0.0, 0.0, 4.0]) + rng.normal(0, 1, (images, 3))
    rotation = np.empty((images, 3, 3))
    rows, xy = [], []
    for i, X0 in enumerate(position):
        z = X0 - aim[i]
        z /= np.linalg.norm(z)
        x = np.cross([0.0, 0, 1], z) / np.linalg.norm(np.cross([0.0, 0, 1], z))
        rotation[i] = np.column_stack([x, np.cross(z, x), z])
        of_camera = (xyz - X0) @ rotation[i]
        at = pixel_from_tangents(lens, of_camera[:, :2] / -of_camera[:, 2:])
        facing = np.einsum("ni,ni->n", (X0 - xyz) / np.linalg.norm(X0 - xyz, axis=1)[:, None], outward) > 0.25
        shown = facing & (of_camera[:, 2] < 0) & ((at > 0) & (at < (2000, 1500))).all(axis=1)
        seen = np.flatnonzero(shown & (rng.uniform(size=points) < 0.5))
        rows.append(np.column_stack([np.full(len(seen), i), seen]))
        xy.append(at[seen] + rng.normal(0, 0.5, (len(seen), 2)))
    image, point = np.concatenate(rows).T
    places = np.concatenate(xy)
    wrong = rng.uniform(size=len(places)) < gross
    places[wrong] = rng.uniform(0, 1, (wrong.sum(), 2)) * (2000, 1500)
    twice = np.bincount(point, minlength=points)[point] >= 2
    kept, number = np.unique(point[twice], return_inverse=True)
    covariance = np.tile(0.25 * np.eye(2), (int(twice.sum()), 1, 1))
    network = Network(
        tuple(f"{i}.jpg" for i in range(images)),
        np.zeros(images, dtype=np.int64),
        tuple(str(j) for j in kept),
        ImagePoints(image[twice], number, places[twice], covariance),
    )
    return network, Estimate((lens,), position, rotation, xyz[kept])


def _start_of(truth: Estimate) -> Camera:
    parameters = np.zeros(len(truth.cameras[0].parameters))
    parameters[0] = 1.1 * truth.cameras[0].parameters[0]
    return truth.cameras[0].with_parameters(parameters)


def test_a_dropped_photograph_does_not_make_the_network_grow_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """It grew three times, 2.1 s for 0.6 s, and ended where it had been."""
    grown = []
    grow = sequence._grow
    monkeypatch.setattr(sequence, "_grow", lambda *given: (grown.append(1), grow(*given))[1])
    network, truth = _castle(14, images=9, points=350, gross=0.25, arc_deg=90)
    found = orient(network, [_start_of(truth)], refine=refine_network)
    assert len(found.failures) <= 1 and len(grown) == 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_photographs_dropped_early_return_to_the_settled_network(seed: int) -> None:
    """Of those dropped beside 20 % wrong matches the settled network supports some: of seed 0 all 19 stay."""
    network, truth = _castle(seed, images=19, points=400, gross=0.2, arc_deg=250)
    found = orient(network, [_start_of(truth)], refine=refine_network).estimate
    known = found.determined
    placed = fit_similarity(found.points[known], truth.points[known]).apply_estimate(found)
    off = np.linalg.norm(placed.position - truth.position, axis=1)
    assert np.nanmax(off) < 1.0 and (seed or found.oriented.all())
