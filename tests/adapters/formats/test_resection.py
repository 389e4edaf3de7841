"""Resections as poses: what `resect --json` prints is read, compared and refused where it is damaged."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.registry import format_of, read_comparable, read_content, write_content
from sfm.model.conventions import angles_from_rotation
from sfm.model.errors import OutputError, SurveyFileError
from tests.commands import kolinear
from tests.places import DATASETS

LAB = DATASETS / "lab2"


@pytest.fixture
def pose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    kolinear(
        *("resect", LAB / "photograph_9.csv", "--camera", LAB / "lab2_camera.csv", "--opposite-signs"),
        *("--photograph", "9.jpg", "--json"),
    )
    path = tmp_path / "pose.json"
    path.write_text(capsys.readouterr().out, "utf-8")
    return path


def test_the_pose_and_its_covariance_are_read(pose: Path) -> None:
    printed = json.loads(pose.read_text("utf-8"))
    best = printed["solutions"][0]
    assert format_of(pose).name == "resection"
    result = read_content(pose).result
    network, estimate = result.network, result.estimate
    assert network.images == ("9.jpg",)
    np.testing.assert_allclose(estimate.position[0], [best[name] for name in ("X0", "Y0", "Z0")])
    angles = np.degrees(angles_from_rotation(estimate.rotation[0]))
    np.testing.assert_allclose(angles, [best[name] for name in ("omega_deg", "phi_deg", "kappa_deg")])
    unit = np.array([1, 1, 1, *[np.pi / 180] * 3])
    expected = np.array(printed["dispersion"]) * np.outer(unit, unit)
    np.testing.assert_allclose(network.exterior.covariance[0], expected, rtol=1e-9)


def test_two_resections_are_compared(pose: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = json.loads(pose.read_text("utf-8"))
    printed["solutions"][0]["X0"] += 0.25
    other = tmp_path / "other.json"
    other.write_text(json.dumps(printed), "utf-8")
    code = kolinear("compare", pose, other, "--align", "none", "--out", tmp_path / "out")
    told = capsys.readouterr().out
    assert code == 0 and "0 common points, 1 common photograph; not aligned" in told
    assert "largest difference of a photograph: 0.250 object units of" in told and " and 0 deg" in told
    assert (tmp_path / "out" / "comparison.html").is_file()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"solutions": []}, "solutions is empty: the resection found no pose"),
        ({"photograph": None}, "photograph"),
        ({"dispersion": [1, 2]}, "dispersion"),
        ({"dispersion": (-np.eye(6)).tolist()}, "dispersion is no covariance: the variances"),
        ({"dispersion": (np.eye(6) + np.eye(6, k=1)).tolist()}, "dispersion is no covariance, which is"),
        ({"dispersion": (3 * np.ones((6, 6)) - 2.5 * np.eye(6)).tolist()}, "dispersion is no covariance"),
    ],
)
def test_damaged_files_are_refused_in_one_line(pose: Path, change: dict[str, object], message: str) -> None:
    pose.write_text(json.dumps(json.loads(pose.read_text("utf-8")) | change), "utf-8")
    with pytest.raises(SurveyFileError, match=message):
        read_comparable(pose, "resection")


def test_nothing_is_written_as_one(pose: Path, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="format resection can only be read"):
        write_content(tmp_path / "new.json", "resection", read_content(pose))
    assert not (tmp_path / "new.json").exists()


def test_a_mirrored_rotation_is_refused(pose: Path) -> None:
    printed = json.loads(pose.read_text("utf-8"))
    printed["solutions"][0]["M"][0] = [-x for x in printed["solutions"][0]["M"][0]]
    pose.write_text(json.dumps(printed), "utf-8")
    with pytest.raises(SurveyFileError, match="M is no rotation"):
        read_comparable(pose)
