"""Resections as poses: what `resect --json` prints is read, compared and refused where it is damaged."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.registry import format_of, read_comparable, read_content, write_content
from sfm.comparison.significance import compare_results
from sfm.model.conventions import angles_from_rotation
from sfm.model.errors import OutputError, SurveyFileError
from sfm.model.solution import Solution
from tests.commands import kolinear
from tests.places import DATASETS
from tests.synthetic import make_network, seed_of

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
    np.testing.assert_allclose(result.exterior_covariance, expected[None], rtol=1e-9)
    assert result.redundancy == printed["redundancy"] > 0


@pytest.mark.parametrize(("off", "code"), [(0.1, 0), (1.0, 1)])  # X0 and phi are correlated
def test_two_resections_are_compared_and_tested(
    pose: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], off: float, code: int
) -> None:
    printed = json.loads(pose.read_text("utf-8"))
    sigma = np.sqrt(2.0 * printed["dispersion"][0][0])  # of the difference
    printed["solutions"][0]["X0"] += off * sigma
    other, out = tmp_path / "other.json", tmp_path / "out"
    other.write_text(json.dumps(printed), "utf-8")
    assert kolinear("compare", pose, other, "--out", out) == code
    told = capsys.readouterr().out
    assert "0 common points, 1 common photograph; not aligned, as no points are common" in told
    assert f"{off:+.2f}" in told and " and 0 deg" in told
    assert ("The exterior orientation of 9.jpg differs significantly" in told) == bool(code)
    written = json.loads((out / "comparison.json").read_text("utf-8"))
    (tested,) = written["exterior_orientation"]
    np.testing.assert_allclose(tested["difference"], [off * sigma, 0, 0, 0, 0, 0], atol=1e-9)
    assert tested["sigma"][0] == pytest.approx(sigma)
    # only X0 differs: its weight in the inverse of twice the covariance of one
    weight = np.linalg.inv(2.0 * np.array(printed["dispersion"]))[0, 0]
    assert tested["statistic"] == pytest.approx((off * sigma) ** 2 * weight / 6)
    assert (tested["statistic"] > tested["critical"]) == bool(code) == written["changed"]
    told = (out / "comparison.html").read_text("utf-8")
    assert f"6 and {printed['redundancy']} degrees of freedom" in told


def test_an_alignment_that_is_asked_for_is_not_replaced(
    pose: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert kolinear("compare", pose, pose, "--align", "points", "--out", tmp_path / "out") == 2
    assert "0 points in common, alignment needs 3" in capsys.readouterr().err


def test_results_of_all_methods_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kolinear("resect", LAB / "photograph_9.csv", "--c", "152.67", "--method", "all", "--json")
    path = tmp_path / "all.json"
    path.write_text(capsys.readouterr().out, "utf-8")
    assert kolinear("compare", path, path) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1 and "all.json: has the results of all methods; expected those of one" in told[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"solutions": []}, "solutions is empty: the resection found no pose"),
        ({"photograph": None}, "photograph"),
        ({"dispersion": [1, 2]}, "dispersion"),
        ({"dispersion": (-np.eye(6)).tolist()}, "dispersion is no covariance: the variances"),
        ({"dispersion": (np.eye(6) + np.eye(6, k=1)).tolist()}, "dispersion is no covariance, which is"),
        ({"redundancy": 0}, "redundancy is 0, expected a whole number from 1"),
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


def test_a_pose_is_tested_against_a_result_with_points(pose: Path, tmp_path: Path) -> None:
    """In one coordinate system; a result in a free datum has another."""
    resected = read_comparable(pose)
    network, truth = make_network(seed_of("pose"), images=4, points=20)
    covariance = np.repeat(resected.exterior_covariance, 4, axis=0)  # type: ignore[arg-type]
    position = np.vstack([resected.estimate.position, truth.position[1:]])
    rotation = np.concatenate([resected.estimate.rotation, truth.rotation[1:]])
    survey = Solution(
        "survey",
        replace(network, images=("9.jpg", *network.images[1:])),
        replace(truth, position=position, rotation=rotation),
        exterior_covariance=covariance,
        datum="control",
    )
    compared = compare_results(survey, resected)
    assert compared.alignment == "none" and compared.images == ("9.jpg",) and not compared.points
    assert compared.poses is not None and compared.changed is False
    assert compared.poses.statistic == pytest.approx([0.0])
    free = compare_results(replace(survey, datum="free"), resected)
    assert free.poses is None and free.changed is None and free.untested is not None
