"""Resection whose noise is unknown: document 003 by the command; wrong points and sigma of many poses."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from sfm import cli
from sfm.model.conventions import FloatArray, rotation_from_angles
from sfm.orientation.resection.ransac import RobustResection
from sfm.textbook.resection.unknown_noise import resect_unknown_noise
from tests.places import ROOT
from tests.synthetic import seed_of

LAB2 = ROOT / "datasets" / "lab2"


@pytest.mark.parametrize(
    ("image", "position", "angles"),
    [
        (9, (1.8896867, 3.0358662, 3.7350004), (-19.1841784, -4.3449776, 2.0501490)),
        (10, (1.6804833, 2.1658782, 3.5085583), (-0.4149385, -4.9369395, 92.4769822)),
        (14, (1.0095213, 2.5331665, 2.8063507), (-8.9397591, -17.0517497, 91.1811604)),
        (18, (2.1016108, 1.1946515, 3.6995847), (13.3667930, 1.4654585, 90.2308179)),
    ],
)
def test_the_command_alone_agrees_with_document_003(
    image: int,
    position: tuple[float, ...],
    angles: tuple[float, ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Before: 11 of 25 points of photograph 9 were rejected, and X0 was 17 mm off."""
    points, camera = LAB2 / f"photograph_{image}.csv", LAB2 / "lab2_camera.csv"
    command = ("kolinear", "resect", points, "--camera", camera, "--opposite-signs", "--json")
    monkeypatch.setattr(sys, "argv", [str(word) for word in command])
    cli.main()
    found = json.loads(capsys.readouterr().out)
    assert found["rejected"] == []
    one = found["solutions"][0]
    assert [one[name] for name in ("X0", "Y0", "Z0")] == pytest.approx(position, abs=6e-8)
    assert [one[f"{name}_deg"] for name in ("omega", "phi", "kappa")] == pytest.approx(angles, abs=1.1e-7)


def resected(
    rng: np.random.Generator, n: int, wrong: int, noise: float
) -> tuple[RobustResection, FloatArray]:
    """Return what is found from n points, the first of which are wrong, and the true position."""
    points = rng.uniform(-1, 1, (n, 3)) * (1, 1, 0.4)
    R = rotation_from_angles(*rng.uniform(-0.2, 0.2, 3))
    position = R @ (0.0, 0.0, 3.0)
    U, V, W = ((points - position) @ R).T
    uv = np.column_stack([-U / W, -V / W])
    measured = uv + noise * rng.standard_normal(uv.shape)
    measured[:wrong] = rng.uniform(uv.min(axis=0), uv.max(axis=0), (wrong, 2))
    return resect_unknown_noise(measured, points), position


@pytest.mark.sweep(0, 4, 8)
@pytest.mark.parametrize("noise", [1e-6, 1e-4, 3e-3])
@pytest.mark.parametrize(("n", "wrong"), [(8, 0), (12, 3), (40, 20)])
def test_whatever_the_noise_wrong_points_are_rejected_and_sigma_is_true(
    n: int, wrong: int, noise: float
) -> None:
    rng = seed_of(f"noise {n} {wrong} {noise}")
    squares, kept, lost = [], 0, 0
    for _ in range(60):
        found, position = resected(rng, n, wrong, noise)
        assert found.found
        kept += int(found.inliers[:wrong].sum())
        lost += int((~found.inliers[wrong:]).sum())
        error = found.position - position
        squares.append(error @ np.linalg.solve(found.covariance[:3, :3], error) / 3)
    assert kept <= 0.01 * 60 * wrong and lost <= 1
    assert 0.5 < np.median(squares) < 1.3  # 0.79 of chi-square with three, known to 0.1


def test_random_points_have_no_pose() -> None:
    rng = seed_of("random")
    found = resect_unknown_noise(rng.uniform(-1, 1, (12, 2)), rng.uniform(-1, 1, (12, 3)))
    assert not found.found and found.reason
    few = resect_unknown_noise(np.zeros((3, 2)), rng.uniform(-1, 1, (3, 3)))
    assert not few.found and "3 points" in few.reason
