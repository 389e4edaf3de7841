"""Epochs of rigs: mounts beside points."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.model.conventions import rotation_from_vector
from sfm.model.errors import GeometryError
from sfm.products.epochs.differences import Epoch, epoch_differences, mount_changes
from sfm.products.epochs.series import analyse_epochs, verdict_of_epochs
from sfm.products.planning.prediction import simulate_network
from sfm.report.pages import write_page
from tests.rigs import make_rig
from tests.survey.test_survey_observations import observed
from tests.synthetic import seed_of, stored_of

KINDS = ("height difference", "plane", "coordinate difference")


def epoch(
    name: str,
    bump: float = 0.0,
    *,
    held: bool = False,
    kinds: tuple[str, ...] = KINDS,
    free: tuple[str, ...] = (),
) -> Epoch:
    """Return an epoch of a rig with survey observations, whose second camera is turned by a bump, rad."""
    network, truth = make_rig(seed_of("epochs"), moments=6, points=30, free=free)
    observations = tuple(observed(kind, truth, seed_of(kind)) for kind in kinds)
    assert truth.mounts is not None
    turned = truth.mounts.rotation.copy()
    turned[1] = turned[1] @ rotation_from_vector(np.array([bump, 0.0, 0.0]))
    free = truth.mounts.free & (not held)
    truth = replace(truth, mounts=replace(truth.mounts, rotation=turned, free=free))
    rotation = truth.rotation.copy()
    rotation[1::2] = rotation[::2] @ turned[1]
    truth = replace(truth, rotation=rotation)
    drawn, truth = simulate_network(network.with_given(further=observations), truth, seed_of(name))
    a = adjust(drawn, truth, reject="none", datum=Datum("free"))
    return Epoch(name, stored_of(name, a), sigma0=a.sigma0, sigma0_px=a.sigma0_px)


def test_a_camera_that_was_moved_on_its_rig_is_named_beside_the_points(tmp_path: Path) -> None:
    found = analyse_epochs([epoch("one"), epoch("two"), epoch("three", 3e-3)])
    assert not any(pair.displacements.moved.any() for pair in found.pairs)
    verdict = verdict_of_epochs(found)
    said = [one for one in verdict.remarks if one.kind == "mount_changed"]
    assert [(one.names("first"), one.names("second")) for one in said] == [
        (("one",), ("three",)),
        (("two",), ("three",)),
    ]
    write_page(found, tmp_path / "out")
    pairs = json.loads((tmp_path / "out" / "epochs.json").read_text("utf-8"))["pairs"]
    assert [pair["mounts"][0]["changed"] for pair in pairs] == [False, True, True]
    assert "Mounts of rigs" in (tmp_path / "out" / "epochs.html").read_text("utf-8")


def test_mounts_that_stayed_pass_as_often_as_the_level_says() -> None:
    """T times 6 of 16 pairs is chi-square: mean 6, standard deviation of the mean 0.87."""
    T = []
    for k in range(16):
        first, second = epoch(f"first {k}").result, epoch(f"second {k}").result
        (one,) = mount_changes(first, second, alpha=0.05, redundancy=None)
        T.append(6 * one.statistic)
    assert np.mean(T) == pytest.approx(6.0, abs=4 * 0.87)


def test_without_a_scale_rotations_alone_are_tested() -> None:
    first, second = (replace(epoch(name).result, unit="") for name in ("a", "b"))
    (one,) = mount_changes(first, second, alpha=0.05, redundancy=None)
    assert np.isnan(one.difference[:3]).all() and np.isfinite(one.difference[3:]).all()
    assert one.critical == pytest.approx(7.815 / 3, rel=1e-3)


def test_held_mounts_are_named_as_held_interior_orientation_is() -> None:
    alike = epoch_differences(epoch("c", held=True), epoch("d", held=True))
    apart = epoch_differences(epoch("c", held=True), epoch("d"))
    assert "camera 2" in alike.held_alike and "camera 2" in apart.held_apart


def test_epochs_of_rigs_are_adjusted_together_and_those_with_observations_refused() -> None:
    """Results do not keep what tables of survey observations gave."""
    alone = [epoch(name, kinds=(), free=("c",)) for name in ("e", "f")]
    found = analyse_epochs(alone, together=True)
    assert {camera.name for camera in found.cameras} == {"camera 1", "camera 2"}
    assert all(camera.same for camera in found.cameras) and not found.changed
    read = []
    for one in (epoch(name, free=("c",)) for name in ("e", "f")):
        network = one.result.network.with_given(further=())
        read.append(replace(one, result=replace(one.result, network=network)))
    with pytest.raises(GeometryError, match="survey observations, mounts"):
        analyse_epochs(read, together=True)
