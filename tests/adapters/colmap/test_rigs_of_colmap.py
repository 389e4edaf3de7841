"""Rigs in COLMAP's adjuster: the same optimum as ours, free and held mounts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapters.colmap.adjuster import adjust_with_colmap
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.comparison.camera_conversion import convert_camera
from tests.rigs import make_rig
from tests.synthetic import seed_of


@pytest.mark.parametrize(("cameras", "held"), [(2, False), (4, False), (8, False), (2, True)])
def test_rigs_have_the_same_optimum(cameras: int, held: bool) -> None:
    network, truth = make_rig(seed_of(f"rig of {cameras}"), cameras=cameras, moments=5)
    assert truth.mounts is not None
    converted = tuple(convert_camera(camera, "full_opencv").camera for camera in truth.cameras)
    free = truth.mounts.free & (not held)
    start = replace(truth, cameras=converted, mounts=replace(truth.mounts, free=free))
    ours = adjust(network, start, reject="none", options=AdjustmentOptions(tolerance=1e-9))
    theirs = adjust_with_colmap(network, start)
    assert theirs.converged and theirs.rms_px == pytest.approx(ours.rms_px, abs=1e-11)
    a, b = ours.estimate.mounts, theirs.estimate.mounts
    assert a is not None and b is not None
    assert b.rotation == pytest.approx(a.rotation, abs=1e-9)
    scale = np.linalg.norm(a.position[1]) / np.linalg.norm(b.position[1])
    if held:
        assert scale == pytest.approx(1.0, abs=1e-12)
    assert scale * b.position == pytest.approx(a.position, abs=1e-9)
