"""Calibrated cameras: their parameters, and the mounts of a rig with their precision."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sfm
from sfm.adjustment.result import Adjustment
from sfm.camera import tangents_from_pixel
from sfm.conventions import FloatArray
from sfm.estimate import Estimate
from sfm.judgement.calibrated_cameras import interior_parameters, rigs_of
from sfm.judgement.checks import precision_of
from tests.rigs import make_rig
from tests.synthetic import make_network, seed_of


def test_parameters_that_are_adjusted_or_held_at_a_value_are_listed_once() -> None:
    network, truth = make_network(seed_of("parameters"), images=6, points=30, free=("c",))
    camera = truth.cameras[0]
    p = np.zeros(len(camera.names))
    p[[camera.names.index("c"), camera.names.index("K1")]] = camera.parameters[camera.names.index("c")], 1e-4
    cameras = (camera.with_parameters(p),)
    a = sfm.adjust(network, Estimate(cameras, truth.position, truth.rotation, truth.points), reject="none")
    listed = interior_parameters(a)
    assert [parameter.name for parameter in listed] == ["c", "K1"]
    assert [parameter.photographs for parameter in listed] == [6, 6]
    assert listed[0].sigma > 0 and not listed[1].sigma > 0


def distances_by_points(a: Adjustment) -> FloatArray:
    """Return the distances from the images of two points on the ray of the first camera, px."""
    seen, found, (left, right) = a.network.image_points, [], a.estimate.cameras
    mount, R = a.estimate.mounts.position[1], a.estimate.mounts.rotation[1]  # type: ignore[union-attr]
    for i in range(0, len(a.network.images), 2):
        rows = [np.flatnonzero((seen.image == i + side) & ~a.rejected) for side in (0, 1)]
        for j in np.intersect1d(*(seen.point[row] for row in rows)):
            k, l = (int(row[seen.point[row] == j][0]) for row in rows)
            ray = np.append(tangents_from_pixel(left, seen.xy[k][None])[0], -1.0)
            ends = np.array([3.0, 30.0])[:, None] * ray - mount
            near, far = (ends @ R)[:, :2] / -(ends @ R)[:, 2:]
            along, to = far - near, tangents_from_pixel(right, seen.xy[l][None])[0] - near
            cross = along[0] * to[1] - along[1] * to[0]
            found.append(abs(cross) / np.linalg.norm(along) * right.c_px)
    return np.array(found)


def test_the_base_of_a_rig_has_its_precision_and_epipolar_distances_that_of_two_image_points() -> None:
    network, truth = make_rig(seed_of("mounts"), moments=8)
    a = sfm.adjust(network, truth, reject="none")
    (rig,) = rigs_of(a)
    (mount,) = rig.mounts
    assert rig.moments == 8 and mount.base == pytest.approx(np.linalg.norm(mount.position))
    step = 1e-6 * np.eye(3)
    change = np.linalg.norm(mount.position + step, axis=1) - np.linalg.norm(mount.position - step, axis=1)
    gradient = change / 2e-6
    expected = np.sqrt(gradient @ a.covariance.mounts[1][:3, :3] @ gradient)
    assert mount.base_sigma == pytest.approx(expected, rel=1e-4)
    assert mount.epipolar is not None
    assert mount.epipolar.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.15)
    np.testing.assert_allclose(np.sort(np.abs(mount.epipolar.px)), np.sort(distances_by_points(a)), rtol=1e-6)
    assert [row.epipolar for row in rigs_of(a, planned=True)[0].mounts] == [None]
    assert rigs_of(replace(a, network=replace(a.network, moment=None))) == ()


def test_the_precision_of_angles_is_stated_in_degrees() -> None:
    network, truth = make_network(seed_of("degrees"), images=6, points=30)
    precision = precision_of(sfm.adjust(network, truth, reject="none"))
    np.testing.assert_allclose(precision.exterior_deg[:, 3:], np.degrees(precision.exterior[:, 3:]))
    np.testing.assert_allclose(precision.exterior_deg[:, :3], precision.exterior[:, :3])
