"""BAL: one focal length, its own cost met by an independent solver, written back, points without names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from adapters.formats.registry import read_any, read_comparable, write_any
from sfm.adjustment.solve import adjust
from sfm.cli.commands.solvers import convert
from sfm.comparison.camera_conversion import convert_camera
from sfm.comparison.significance import compare_results
from sfm.solution import Solution
from tests.synthetic import make_network, seed_of

CAMERAS, POINTS = 5, 14


def projected(values: np.ndarray, image: np.ndarray, point: np.ndarray) -> np.ndarray:
    """BAL's own model from its page: p = -P / P_z, p' = f (1 + k1 |p|^2 + k2 |p|^4) p."""
    cameras, xyz = values[: 9 * CAMERAS].reshape(-1, 9)[image], values[9 * CAMERAS :].reshape(-1, 3)[point]
    P = Rotation.from_rotvec(cameras[:, :3]).apply(xyz) + cameras[:, 3:6]
    p = -P[:, :2] / P[:, 2:]
    r2 = (p**2).sum(axis=1)
    return (cameras[:, 6] * (1 + cameras[:, 7] * r2 + cameras[:, 8] * r2**2))[:, None] * p


def problem(path: Path, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Write a problem by hand whose photographs have other f, k1, k2 each; noise of 0.5 px."""
    rng = seed_of(name)
    xyz = rng.uniform(-1, 1, (POINTS, 3))
    cameras = []
    for i in range(CAMERAS):
        turn = Rotation.from_euler("xyz", [0.3 * np.cos(i), 2 * np.pi * i / CAMERAS, 0.7 * i])
        cameras.append([*turn.as_rotvec(), *rng.uniform(-0.1, 0.1, 2), -5, 900 + 40 * i, -0.1, 0.02])
    image, point = (index.ravel() for index in np.indices((CAMERAS, POINTS)))
    values = np.array([*np.ravel(cameras), *xyz.ravel()])
    xy = projected(values, image, point) + 0.5 * rng.standard_normal((len(image), 2))
    start = values + 1e-3 * rng.standard_normal(len(values)) * np.maximum(1, np.abs(values))
    rows = [f"{i} {j} {float(x)!r} {float(y)!r}" for i, j, (x, y) in zip(image, point, xy, strict=True)]
    path.write_text(
        "\n".join([f"{CAMERAS} {POINTS} {len(image)}", *rows, *(repr(float(v)) for v in start)]) + "\n"
    )
    return start, image, point, xy


@pytest.mark.parametrize("name", ["bal 1", "bal 2"])
def test_adjustment_reaches_the_cost_of_an_independent_solver(name: str, tmp_path: Path) -> None:
    start, image, point, xy = problem(tmp_path / "problem.txt", name)

    def residuals(values: np.ndarray) -> np.ndarray:
        return np.asarray((projected(values, image, point) - xy).ravel())

    best = least_squares(residuals, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    network, estimate = read_any(tmp_path / "problem.txt")
    a = adjust(network, estimate, reject="none")
    cost = 0.5 * float((a.residuals**2).sum())
    assert cost == pytest.approx(best.cost, rel=1e-9)
    assert a.redundancy == 2 * len(image) - 9 * CAMERAS - 3 * POINTS + 7
    # written back, it is the same minimum of BAL's model
    write_any(tmp_path / "solved.txt", "bal", a.network, a.estimate)
    lines = (tmp_path / "solved.txt").read_text().split("\n")
    solved = np.array([float(line) for line in lines[1 + len(image) :] if line])
    assert 0.5 * float((residuals(solved) ** 2).sum()) == pytest.approx(best.cost, rel=1e-8)


def test_numbers_are_no_names_and_what_coincides_is_paired_by_place(tmp_path: Path) -> None:
    """The points of a result, numbered by BAL in another order, and back in tables."""
    network, truth = make_network(seed_of("bal names"), images=5, points=30, model="radial")
    order = seed_of("bal order").permutation(30)
    named = replace(network, points=tuple(str(j) for j in order))
    write_any(tmp_path / "problem.txt", "bal", named, truth)
    convert(tmp_path / "problem.txt", tmp_path / "tables")
    found = compare_results(Solution("own", named, truth), read_comparable(tmp_path / "tables"))
    assert len(found.points) == 30 and found.pairing.points_by_name == 0
    assert np.abs(found.point_difference).max() < 1e-9


@pytest.mark.parametrize("model", ["simple_pinhole", "pinhole", "simple_radial", "radial"])
def test_models_with_one_focal_length_are_converted_both_ways(model: str) -> None:
    _, truth = make_network(seed_of("one focal length"), images=2, points=8, model=model)
    for general in ("opencv", "full_opencv", "brown_forward"):
        there = convert_camera(truth.cameras[0], general)
        back = convert_camera(there.camera, model)
        assert max(there.max_px, back.max_px) < 1e-8
        np.testing.assert_allclose(back.camera.parameters, truth.cameras[0].parameters, rtol=1e-8)
    assert convert_camera(convert_camera(truth.cameras[0], "brown").camera, model).max_px < 0.1
