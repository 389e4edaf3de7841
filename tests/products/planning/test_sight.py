"""What a photograph of a plan shows, in cases that can be computed by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sfm.model.camera import camera_from_values, project
from sfm.model.errors import GeometryError
from sfm.products.geometry.tolerance import Mesh
from sfm.products.planning.planned_object import (
    box_tree,
    hidden_points,
    object_of_mesh,
    object_of_points,
    open_edges,
    shape_object,
)
from sfm.products.planning.stations import aim_camera
from sfm.products.planning.visibility import (
    DepthOfField,
    Lens,
    Seeing,
    TargetImage,
    Visibility,
    best_focus,
    centre_covariance,
    depth_of_field,
    sight_of,
)
from tests.synthetic import seed_of
from tests.targets.test_bound import CONTRAST, NOISE, coverage

CAMERA = camera_from_values("c", "brown", (2000, 1500), (0.005, 0.005), c_mm=10.0)


def test_a_square_hides_what_lies_in_its_shadow() -> None:
    # a square of half width 1 at Z = 1 under a camera at Z = 3 throws a shadow of half width 1.5 on Z = 0
    square = Mesh(
        np.array([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    x = np.array([0.0, 1.0, 1.49, 1.51, 2.0, 1.49])
    y = np.array([0.0, 1.0, -1.49, 0.0, -1.0, 1.51])
    points = np.column_stack([x, y, np.zeros(6)])
    hidden = hidden_points(box_tree(square), np.array([0.0, 0.0, 3.0]), points)
    assert hidden.tolist() == [True, True, True, False, False, False]
    # from below the square, and for points on it, nothing is hidden
    assert not hidden_points(box_tree(square), np.array([0.0, 0.0, 0.9]), points).any()
    on_it = np.array([[0.2, 0.3, 1.0], [-1.0, 1.0, 1.0]])
    assert not hidden_points(box_tree(square), np.array([0.0, 0.0, 3.0]), on_it).any()


def test_the_tree_of_boxes_finds_what_every_triangle_finds() -> None:
    rng = seed_of("tree")
    corners = rng.normal(size=(300, 1, 3)) + 0.3 * rng.normal(size=(300, 3, 3))
    mesh = Mesh(corners.reshape(-1, 3), np.arange(900).reshape(-1, 3))
    points, position = rng.normal(size=(400, 3)), np.array([4.0, 1.0, 2.0])
    hidden = hidden_points(box_tree(mesh), position, points)
    d = position - points  # solve a + u e + v f = p + t d for every pair
    A = np.stack(
        np.broadcast_arrays(
            (corners[:, 1] - corners[:, 0])[None], (corners[:, 2] - corners[:, 0])[None], -d[:, None]
        ),
        axis=-1,
    )
    u, v, t = np.moveaxis(
        np.linalg.solve(A, (points[:, None] - corners[None, :, 0])[..., None])[..., 0], -1, 0
    )
    truth = ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-3) & (t < 1)).any(axis=1)
    assert 0.1 < truth.mean() < 0.9
    assert (hidden == truth).mean() > 0.99  # those that begin within the tolerance may differ


def test_a_box_shows_three_sides_and_its_bottom_never() -> None:
    box = shape_object("box", (1.0, 1.0, 1.0), 300)
    seen = sight_of(
        box, CAMERA, np.array([[3.0, 3.0, 3.5]]), aim_camera(np.array([-3.0, -3, -3]))[None], WIDE
    )
    faces = box.normals @ np.array([1.0, 1.0, 1.0]) > 0.5
    assert (seen.visibility[0] == Visibility.SEEN).tolist() == faces.tolist()
    assert box.normals[:, 2].min() > -0.5


WIDE = Seeing(sigma_px=0.1, max_incidence_deg=89.0)


def test_incidence_format_and_unknown_normals() -> None:
    angle = np.radians([0.0, 59.0, 61.0, 89.0, 91.0])
    normals = np.column_stack([np.sin(angle), np.zeros(5), np.cos(angle)])
    xyz = np.array([[0.0, 0, 0], [0, 0.1, 0], [0.1, 0, 0], [0.1, 0.1, 0], [-0.1, 0, 0]])
    planned = object_of_points(tuple("abcde"), xyz, normals)
    above, down = np.array([[0.0, 0.0, 10.0]]), aim_camera(np.array([0.0, 0, -1]))[None]
    why = sight_of(planned, CAMERA, above, down, Seeing(sigma_px=0.1)).visibility[0]
    assert [Visibility(w) for w in why] == [
        Visibility.SEEN,
        Visibility.SEEN,
        Visibility.OBLIQUE,
        Visibility.OBLIQUE,
        Visibility.OBLIQUE,
    ]
    unknown = replace(planned, normals=np.full((5, 3), np.nan))
    assert (
        sight_of(unknown, CAMERA, above, down, Seeing(sigma_px=0.1)).visibility[0] == Visibility.SEEN
    ).all()
    # the photograph is 10 mm wide at c = 10 mm: at a distance of 10 it ends 5 from the axis
    wide = object_of_points(("in", "out", "behind"), np.array([[4.9, 0, 0], [5.1, 0, 0], [0, 0, 20.0]]), None)
    why = sight_of(wide, CAMERA, above, down, Seeing(sigma_px=0.1)).visibility[0]
    assert [Visibility(w) for w in why] == [Visibility.SEEN, Visibility.OUTSIDE, Visibility.OUTSIDE]


def test_depth_of_field_by_the_rays_of_the_lens() -> None:
    f, N, s, c = 24.0, 8.0, 1000.0, 0.012
    found = depth_of_field(Lens(N, s, c), f)
    for distance in (found.near, found.far):  # thin lens: circle of a point when focused at s
        image, focused = f * distance / (distance - f), f * s / (s - f)
        assert abs(image - focused) / image * f / N == pytest.approx(c, rel=1e-9)
    H = f * f / (N * c) + f
    assert depth_of_field(Lens(N, H, c), f).far == math.inf
    assert depth_of_field(Lens(N, H, c), f).near == pytest.approx(H / 2, rel=0.01)
    assert best_focus(800.0, 1200.0) == pytest.approx(960.0)
    planned = object_of_points(tuple("abc"), np.array([[0.0, 0, 0], [0.1, 0, 0.2], [0, 0.1, -0.2]]), None)
    seeing = Seeing(sigma_px=0.1, depth=DepthOfField(0.9, 1.1, 1.0))
    why = sight_of(
        planned, CAMERA, np.array([[0.0, 0, 1]]), aim_camera(np.array([0.0, 0, -1]))[None], seeing
    ).visibility[0]
    assert [Visibility(w) for w in why] == [Visibility.SEEN, Visibility.UNSHARP, Visibility.UNSHARP]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (Lens(0.0, 100.0, 0.01), "f-number is 0"),
        (Lens(8.0, 20.0, 0.01), "focus at 20 mm, needed farther than the focal length 24 mm"),
    ],
)
def test_impossible_lenses_are_refused(wrong: Lens, message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        depth_of_field(wrong, 24.0)


@pytest.mark.parametrize(("a", "b", "angle"), [(5.0, 5.0, 0.0), (8.0, 4.0, 0.6)])
def test_the_precision_of_a_target_is_the_bound_of_its_picture(a: float, b: float, angle: float) -> None:
    blur = 0.8
    h, size, at = 0.05, 41, 20.3
    dx = coverage(at + h, at, a, b, angle, blur, size) - coverage(at - h, at, a, b, angle, blur, size)
    dy = coverage(at, at + h, a, b, angle, blur, size) - coverage(at, at - h, a, b, angle, blur, size)
    J = CONTRAST / (2 * h) * np.stack([dx.ravel(), dy.ravel()]).astype(float)
    bound = np.linalg.inv(J @ J.T) * NOISE**2
    turned = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    edge = math.hypot(blur, 12**-0.5)  # the picture is blurred before pixels average it
    found = centre_covariance((turned @ np.diag([a, b]))[None], TargetImage(CONTRAST, NOISE, edge))[0]
    assert np.abs(found - bound).max() < 0.03 * np.trace(bound)


def test_the_outline_of_a_target_is_that_of_its_projection() -> None:
    normal = np.array([0.3, -0.5, 1.0]) / np.linalg.norm([0.3, -0.5, 1.0])
    planned = object_of_points(
        tuple("abc"), np.array([[0.1, 0.2, 0], [0, 0, 0.1], [0.2, 0, 0]]), np.tile(normal, (3, 1))
    )
    position, rotation = np.array([0.3, -0.4, 2.0]), aim_camera(np.array([-0.1, 0.2, -1.0]), 0.7)
    found = sight_of(planned, CAMERA, position[None], rotation[None], Seeing(diameter=0.02))
    a = np.cross(normal, [1.0, 0, 0])
    a /= np.linalg.norm(a)
    t = np.linspace(0, 2 * np.pi, 721)
    rim = planned.xyz[0] + 0.01 * (np.cos(t)[:, None] * a + np.sin(t)[:, None] * np.cross(normal, a))
    xy = project(CAMERA, position, rotation, rim)
    assert 2 * np.linalg.norm(xy - found.xy[0, 0], axis=1).min() == pytest.approx(
        found.diameter_px[0, 0], rel=0.01
    )
    small = sight_of(planned, CAMERA, position[None], rotation[None], Seeing(diameter=0.002))
    assert (small.visibility[0] == Visibility.SMALL).all() and np.isnan(small.covariance).all()


def test_meshes_with_holes_are_refused_unless_open() -> None:
    box = shape_object("box", (1.0, 1.0, 1.0), 20).mesh
    assert box is not None and open_edges(box) == 0
    holed = replace(box, triangles=box.triangles[1:])
    assert open_edges(holed) == 3
    with pytest.raises(GeometryError, match=r"mesh: 3 edges of one triangle only: .*--open-mesh"):
        object_of_mesh(holed, 20)
    assert len(object_of_mesh(holed, 20, open_surface=True).names) == 20
    inside_out = object_of_mesh(replace(box, triangles=box.triangles[:, ::-1]), 50)
    assert (
        (inside_out.xyz - 0.5) * (0, 0, 1) + inside_out.xyz * (1, 1, 0) @ np.eye(3) * inside_out.normals
    ).sum() > 0


def test_far_rays_that_a_distortion_folds_back_into_the_format_are_not_seen() -> None:
    values = (("k1", -0.2),)
    camera = camera_from_values("o", "opencv", (6000, 4000), (1.0, 1.0), c_mm=3000.0, values=values)
    xyz = np.array([[0.0, 0, 0], [0.5, 0.2, 0], [2.0, 0, 0], [2.5, 0, 0]])
    there, R = np.array([0.0, 0, 1]), np.eye(3)
    xy = project(camera, there, R, xyz)
    assert ((xy[:2] > 0) & (xy[:2] < (5999, 3999))).all() and np.isnan(xy[2:]).all()
    planned = object_of_points(("a", "b", "c", "d"), xyz, np.tile([0.0, 0, 1], (4, 1)))
    sight = sight_of(planned, camera, there[None], R[None], Seeing(sigma_px=0.1, max_incidence_deg=80.0))
    assert sight.seen[0].tolist() == [True, True, False, False]
