"""Columns of alternatives on values done by hand; that they are derivatives is tested with the hypotheses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.comparison.solutions import reprojection
from sfm.judgement.hypotheses import columns
from sfm.judgement.hypotheses.columns import columns_of, interior_columns, object_fields, rigid_motions
from sfm.model.camera import project
from sfm.model.conventions import rotation_from_vector
from sfm.model.distortion.models import Role
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def a() -> Adjustment:
    network, truth = make_network(seed_of("columns by hand"), images=4, points=10, cameras=2, free=("c",))
    return adjust(network, truth, datum=Datum("free"), reject="none")


def test_camera_columns_by_hand(a: Adjustment) -> None:
    seen, estimate = a.network.image_points, a.estimate
    by_camera = columns_of(a).freedoms[:, :, 1:9]
    for k, (i, j) in enumerate(zip(seen.image, seen.point, strict=True)):
        camera = estimate.cameras[a.network.camera[i]]
        U, V, W = estimate.rotation[i].T @ (estimate.points[j] - estimate.position[i])
        x, y = np.array([-U, -V]) / W * camera.c_px / (max(camera.size_px) / 2)
        r2 = x * x + y * y
        across = [1, 0, x * r2, x * r2**2, r2 + 2 * x**2, 2 * x * y, x, y]
        down = [0, 1, y * r2, y * r2**2, 2 * x * y, r2 + 2 * y**2, 0, 0]
        np.testing.assert_allclose(by_camera[k], [across, -np.array(down)], atol=1e-12)


def test_fields_of_the_object_by_hand() -> None:
    points = np.array([[2.0, 1, 1], [-1, 1, 1], [0.5, 4, 1], [0.5, -2, 1], [np.nan, 0, 0]])
    fields, size = object_fields(points)
    strain, bending = fields[:, :, :5], fields[:, :, 5:]
    assert size == pytest.approx(np.sqrt((2 * 2.25 + 2 * 9) / 4))
    x, y, z = 1.5 / size, 0.0, 0.0
    assert strain[0].T.tolist() == pytest.approx(
        size * np.array([[x, -y, 0], [x, y, -2 * z], [y, x, 0], [z, 0, x], [0, z, y]])
    )
    np.testing.assert_allclose(strain[2].T[:3], [[0, -3, 0], [0, 3, 0], [3, 0, 0]])
    products = np.array([x * x, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(bending[0], size * np.einsum("t,cd->ctd", products, np.eye(3)).reshape(3, 18))
    one = np.array([[1.0, 2, 3], [-1, -2, -3]])
    fields, size = object_fields(one)
    strain, bending = fields[:, :, :5], fields[:, :, 5:]
    x, y, z = one[0] / size
    np.testing.assert_allclose(
        strain[0].T / size, [[x, -y, 0], [x, y, -2 * z], [y, x, 0], [z, 0, x], [0, z, y]]
    )
    products = np.array([x * x, y * y, z * z, x * y, x * z, y * z])
    np.testing.assert_allclose(bending[0] / size, np.einsum("t,cd->ctd", products, np.eye(3)).reshape(3, 18))
    assert not object_fields(points)[0][4].any()


def test_motions_of_a_body_move_its_points_by_one() -> None:
    """The rotation about z moves each point across its arm; the fourth point is not on the body."""
    points = np.array([[5.0, 1, 2], [1, 1, 2], [3, 3, 2], [9, 9, 9], [3, -1, 2]])
    motions = rigid_motions(points, np.array([0, 1, 2, 4]))
    np.testing.assert_allclose(motions[:, :, :3], np.tile(np.eye(3), (5, 1, 1)))
    np.testing.assert_allclose(motions[:, :, 5], [[0, 1, 0], [0, -1, 0], [-1, 0, 0], [-4, 3, 0], [1, 0, 0]])


def test_motions_of_several_bodies_are_those_of_each() -> None:
    """A point without coordinates is in none of them."""
    points = seed_of("several bodies").standard_normal((9, 3))
    points[8] = np.nan
    bodies = np.array([np.isin(np.arange(9), members) for members in ((0, 1, 2), (2, 4, 5, 7))])
    for body, motions in zip(bodies, rigid_motions(points, bodies), strict=True):
        np.testing.assert_allclose(motions, rigid_motions(points, body), rtol=1e-12, atol=1e-12)


def test_columns_are_differences(a: Adjustment) -> None:
    found, estimate, h = columns_of(a), a.estimate, 1e-6
    assert found.usable.all()
    for c, axis in enumerate(np.eye(3)):
        turned = estimate.rotation @ rotation_from_vector(h * axis)
        for own, changed in (
            (found.exterior[:, :, c], replace(estimate, position=estimate.position + h * axis)),
            (found.exterior[:, :, 3 + c], replace(estimate, rotation=turned)),
            (found.point[:, :, c], replace(estimate, points=estimate.points + h * axis)),
        ):
            right = (reprojection(a.network, changed) - reprojection(a.network, estimate)) / h
            np.testing.assert_allclose(own, right, rtol=2e-3, atol=0.5)
    unit = np.array([1.0, -2.0])[a.network.camera[a.network.image_points.image]]
    for index in (0, 1):
        camera = estimate.cameras[index]
        for s in range(len(camera.names)):
            own, _, (step,) = interior_columns(a, [(index, s)])
            cameras = list(estimate.cameras)
            p = camera.parameters.copy()
            p[s] += 0.01 * step
            cameras[index] = camera.with_parameters(p)
            right = (
                reprojection(a.network, replace(estimate, cameras=tuple(cameras)))
                - reprojection(a.network, estimate)
            ) / 0.01
            own = own[:, :, 0]
            np.testing.assert_allclose(own, right, rtol=5e-3, atol=5e-3)
            assert not own[unit == (-2.0 if index == 0 else 1.0)].any()


def test_a_point_behind_a_photograph_has_no_columns(a: Adjustment) -> None:
    points = a.estimate.points.copy()
    points[3] = 3 * a.estimate.position[0]
    points[4] = np.nan
    found = columns_of(replace(a, estimate=replace(a.estimate, points=points)))
    seen = a.network.image_points
    assert not found.usable[(seen.image == 0) & (seen.point == 3)].any()
    assert not found.usable[seen.point == 4].any()
    assert found.usable[(seen.point != 3) & (seen.point != 4)].all()
    for part in (found.exterior, found.point, found.freedoms):
        assert not part[~found.usable].any() and np.isfinite(part).all()


def test_the_largest_effect_of_an_interior_parameter_is_a_pixel(a: Adjustment) -> None:
    for index, camera in enumerate(a.estimate.cameras):
        for s, name in enumerate(camera.names):
            own, keys, (unit,) = interior_columns(a, [(index, s)])
            assert np.abs(own).max() == pytest.approx(1.0), name
            assert unit > 0 and keys == [(camera.owner_of(s), name)]


def test_an_unused_camera_has_no_effect(a: Adjustment) -> None:
    network = replace(a.network, camera=np.zeros_like(a.network.camera))
    own, _, (unit,) = interior_columns(replace(a, network=network), [(1, 0)])
    assert not own.any() and unit > 0


def test_the_edge_of_the_longer_side_is_the_unit_of_the_camera_columns(a: Adjustment) -> None:
    found = columns_of(a)
    seen, estimate = a.network.image_points, a.estimate
    for row in (0, 7, 30):
        i = seen.image[row]
        U, V, W = estimate.rotation[i].T @ (estimate.points[seen.point[row]] - estimate.position[i])
        c_px = estimate.cameras[a.network.camera[i]].c_px
        assert found.freedoms[row, 0, 7] == pytest.approx(-U / W * c_px / 1000)
        assert found.freedoms[row, 1, 3] == pytest.approx(
            V / W * c_px / 1000 * (U**2 + V**2) / W**2 * (c_px / 1000) ** 2
        )


@pytest.mark.parametrize("model", ["brown", "opencv"])
def test_c_moves_image_points_as_its_camera_does(model: str) -> None:
    """Distortion included, that of the place where the ray is then; with two focal lengths, of both."""
    network, truth = make_network(seed_of("c moves"), images=4, points=10, model=model, free=())
    found = columns_of(adjust(network, truth, datum=Datum("free"), reject="none"))
    camera, focal = truth.cameras[0], truth.cameras[0].plays(Role.FOCAL)
    longer = camera.with_parameters(camera.parameters * np.where(focal, 1 + 1e-6, 1.0))
    seen = network.image_points
    for i in range(4):
        rows = seen.image == i
        at, away = (
            project(one, truth.position[i], truth.rotation[i], truth.points[seen.point[rows]])
            for one in (camera, longer)
        )
        np.testing.assert_allclose(found.freedoms[rows, :, 0], (away - at) / 1e-6 / 1000, atol=1e-3)


def test_every_freedom_of_a_photograph_has_one_place() -> None:
    places = columns.CAMERA_PLACES + columns.STRAIN_PLACES + columns.BENDING_PLACES
    assert places == tuple(range(len(columns.CAMERA) + columns.STRAIN + columns.BENDING))
    assert (len(columns.CAMERA), columns.STRAIN, columns.BENDING) == (9, 5, 18)
