"""Mounts of a rig, with their precision and epipolar distances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sfm
from sfm.adjustment.result import Adjustment
from sfm.model.camera import tangents_from_pixel
from sfm.model.conventions import FloatArray, rotation_from_angles
from sfm.report.rig_mounts import rigs_of
from tests.rigs import make_rig
from tests.synthetic import seed_of


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


def test_a_mount_is_in_degrees_and_moments_have_two_photographs() -> None:
    network, truth = make_rig(seed_of("two moments"), moments=6)
    assert network.moment is not None
    apart = np.where(np.arange(12) == 5, 77, network.moment)  # one photograph by itself
    a = sfm.adjust(replace(network, moment=apart), truth, reject="none")
    (rig,) = rigs_of(a, planned=True)
    (mount,) = rig.mounts
    assert rig.moments == 5 and mount.camera == "camera 2" and rig.reference == "camera 1"
    R = rotation_from_angles(*np.radians(mount.rotation_deg))
    np.testing.assert_allclose(R, a.estimate.mounts.rotation[1])  # type: ignore[union-attr]
    np.testing.assert_allclose(
        mount.rotation_sigma_deg, np.degrees(np.sqrt(np.diagonal(a.covariance.mounts[1])[3:]))
    )
    np.testing.assert_allclose(mount.position_sigma, np.sqrt(np.diagonal(a.covariance.mounts[1])[:3]))
    names = [(name, is_length) for name, _, _, is_length in mount.values]
    assert names == [
        *(("base", True), ("X", True), ("Y", True), ("Z", True)),
        *(("omega", False), ("phi", False), ("kappa", False)),
    ]


def test_rejected_image_points_have_no_epipolar_distance() -> None:
    network, truth = make_rig(seed_of("epipolar"), moments=6)
    a = sfm.adjust(network, truth, reject="none")
    everywhere = rigs_of(a)[0].mounts[0].epipolar
    out = a.network.image_points.point < 5
    some = rigs_of(replace(a, rejected=out))[0].mounts[0].epipolar
    assert everywhere is not None and some is not None and len(some.px) < len(everywhere.px)
    none = rigs_of(replace(a, rejected=np.ones_like(out)))[0].mounts[0].epipolar
    assert none is not None and len(none.px) == 0 and np.isnan(none.rms_px)
