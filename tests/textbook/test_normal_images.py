"""Normal images: conjugate points in one row, parallax c b / depth, intensities where they belong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.model.camera import project
from sfm.model.conventions import rotation_from_vector
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.textbook.pair import make_normal_images
from tests.synthetic import make_network, seed_of


def pair(base: tuple[float, float, float] = (0.5, 0.1, 0.05)) -> tuple[Network, Estimate]:
    """Two photographs with lens distortion from above, turned by some degrees each."""
    rng = seed_of("normal images")
    network, truth = make_network(rng, images=3, points=60, planar=False, cameras=2)
    position = np.array([[0.0, 0.0, 3.0], np.add([0.0, 0.0, 3.0], base), [9.0, 9.0, 9.0]])
    rotation = np.array([rotation_from_vector(w) for w in rng.normal(0, 0.06, (3, 3))])
    return network, replace(truth, position=position, rotation=rotation)


def test_conjugate_points_are_in_one_row_and_their_parallax_gives_the_depth() -> None:
    network, truth = pair()
    normal = make_normal_images(network, truth, network.images[0], network.images[1])
    rows = []
    for side in range(2):
        camera = truth.cameras[network.camera[side]]
        xy = project(camera, truth.position[side], truth.rotation[side], truth.points)
        rows.append(normal.normal_xy(side, xy))
        np.testing.assert_allclose(normal.photograph_xy(side, rows[side]), xy, atol=1e-7)
        ideal = project(normal.cameras[side], truth.position[side], normal.rotation, truth.points)
        np.testing.assert_allclose(rows[side], ideal, atol=1e-7)
    np.testing.assert_allclose(rows[0][:, 1], rows[1][:, 1], atol=1e-7)
    depth = -((truth.points - truth.position[0]) @ normal.rotation)[:, 2]
    b = np.linalg.norm(truth.position[1] - truth.position[0])
    shift = normal.cameras[0].principal_point_px - normal.cameras[1].principal_point_px
    parallax = rows[0][:, 0] - rows[1][:, 0] - shift[0]
    np.testing.assert_allclose(parallax, normal.cameras[0].c_px * b / depth, rtol=1e-9)


def test_the_format_holds_both_photographs_and_no_more() -> None:
    network, truth = pair()
    normal = make_normal_images(network, truth, network.images[0], network.images[1])
    corners = []
    for side, camera in enumerate(normal.source.cameras):
        width, height = np.array(camera.size_px) - 1
        x, y = np.meshgrid(np.linspace(0, width, 60), np.linspace(0, height, 60))
        corners.append(normal.normal_xy(side, np.column_stack([x.ravel(), y.ravel()])))
    size = np.array(normal.cameras[0].size_px)
    assert normal.cameras[1].size_px == normal.cameras[0].size_px
    for part in corners:
        assert (part > -1.0).all() and (part < size).all()
        assert abs(part[:, 0].min()) < 1.0
    assert max(part[:, 0].max() for part in corners) > size[0] - 2.5
    assert min(part[:, 1].min() for part in corners) < 1.0
    assert max(part[:, 1].max() for part in corners) > size[1] - 2.5


def test_intensities_come_from_where_the_photograph_shows_them() -> None:
    network, truth = pair()
    normal = make_normal_images(network, truth, network.images[1], network.images[0])
    assert normal.images == network.images[:2]  # the left one first, however they are given
    width, height = normal.source.cameras[0].size_px
    y, x = np.mgrid[:height, :width]
    photograph = np.rint(100 + 40 * np.sin(x / 40.0) + 40 * np.cos(y / 55.0)).astype(np.uint8)
    image = normal.resample(0, photograph)
    assert image.shape == normal.cameras[0].size_px[::-1]
    some = seed_of("places").uniform(0.3, 0.7, (200, 2)) * normal.cameras[0].size_px
    places = np.rint(some)
    at = normal.photograph_xy(0, places)
    expected = 100 + 40 * np.sin(at[:, 0] / 40.0) + 40 * np.cos(at[:, 1] / 55.0)
    found = image[places[:, 1].astype(int), places[:, 0].astype(int)]
    assert np.abs(found - expected).max() < 1.5
    assert np.isnan(image[0, 0]) or np.isnan(image[-1, -1])


@pytest.mark.parametrize("base", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.8), (0.1, 0.0, 0.4)])
def test_pairs_without_a_base_across_the_rays_are_refused(base: tuple[float, float, float]) -> None:
    network, truth = pair(base)
    with pytest.raises(GeometryError, match="normal images"):
        make_normal_images(network, truth, network.images[0], network.images[1])


def test_photographs_without_orientation_are_refused() -> None:
    network, truth = pair()
    position = truth.position.copy()
    position[1] = np.nan
    with pytest.raises(GeometryError, match="not oriented"):
        make_normal_images(network, replace(truth, position=position), network.images[0], network.images[1])
