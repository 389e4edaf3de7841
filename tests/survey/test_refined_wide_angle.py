"""`kolinear refine` with wide-angle cameras: photographs of a room, from within it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from adapters.colmap.camera_models import write_model
from adapters.colmap.reconstruction import colmap_parameters
from sfm.cli.commands.refine import refine
from sfm.model.camera import Camera, project, tangents_from_pixel
from sfm.model.conventions import FloatArray, rotation_from_vector
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from tests.synthetic import seed_of
from tests.tables import rows_of

pycolmap = pytest.importorskip("pycolmap")

SIZE = (400, 320)
HALF = np.array([1.0, 0.8, 0.7])  # of the room, m
TEXEL_M = 0.0025
REMAP_ROWS = 30000
FINE = 3  # samples of a pixel along each side
NOISE_PX = 0.3
# 120 degrees from left to right
PARAMETERS = {
    "opencv_fisheye": (190.0, 191.0, 201.0, 158.0, 0.03, -0.01, 0.002, -0.0004),
    "simple_division": (170.0, 201.0, 158.0, -0.2),
    "thin_prism_fisheye": (
        *(190.0, 191.0, 201.0, 158.0, 0.03, -0.01, 1e-3, -2e-3, 0.002, -0.0004),
        *(2e-3, -1e-3),
    ),
}
# Over the 15 px of usual windows a lens of so short a focal length bends what is straight
WINDOW_PX = 9


def _stations() -> tuple[FloatArray, FloatArray]:
    """Return projection centres and rotations: all look down, a little aside, rolled."""
    rng = seed_of("stations in the room")
    position, rotation = [], []
    for k, (x, y) in enumerate([(-0.4, -0.3), (0.4, -0.3), (-0.4, 0.3), (0.4, 0.3), (0.0, 0.0), (0.1, 0.2)]):
        position.append([x, y, 0.25 + 0.1 * (k % 3)])
        turn = np.array([0.35 * np.sign(y) if k < 4 else 0.0, -0.3 * np.sign(x) if k < 4 else 0.0, 0.0])
        rolled = np.array([0.0, 0.0, k * np.pi / 2])
        rotation.append(rotation_from_vector(turn + rng.normal(0, 0.05, 3)) @ rotation_from_vector(rolled))
    return np.array(position), np.array(rotation)


def _walls(X0: FloatArray, rays: FloatArray) -> FloatArray:
    """Return where rays from within the room meet its walls, (k, 3)."""
    with np.errstate(divide="ignore"):
        t = np.where(rays > 0, (HALF - X0) / rays, (-HALF - X0) / rays)
    return np.asarray(X0 + t.min(axis=1, keepdims=True) * rays)


def _light(at: FloatArray, skin: FloatArray) -> FloatArray:
    """Return how light the walls are, every wall with a part of its own of one texture."""
    wall = np.abs(at / HALF).argmax(axis=1)
    side = at[np.arange(len(at)), wall] > 0
    u, v = (np.take_along_axis(at, ((wall + k) % 3)[:, None], axis=1)[:, 0] for k in (1, 2))
    column = (u / TEXEL_M + 450 + 900 * wall).astype(np.float32).reshape(-1, 1)
    row = (v / TEXEL_M + 450 + 900 * side).astype(np.float32).reshape(-1, 1)
    rows = range(0, len(row), REMAP_ROWS)  # OpenCV takes pictures of up to 32767 rows
    parts = [
        cv2.remap(skin, column[k : k + REMAP_ROWS], row[k : k + REMAP_ROWS], cv2.INTER_LINEAR) for k in rows
    ]
    return np.concatenate(parts)[:, 0]


def _photographs(truth: Estimate) -> list[Any]:
    rng = seed_of("walls")
    skin = cv2.GaussianBlur(rng.uniform(0, 1, (1800, 2700)).astype(np.float32), (0, 0), 2.0)
    skin = np.clip(0.5 + 4 * (skin - 0.5), 0, 1)
    offset = (np.arange(FINE) + 0.5) / FINE - 0.5
    x = (np.arange(SIZE[0])[:, None] + offset).ravel()
    y = (np.arange(SIZE[1])[:, None] + offset).ravel()
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    uv = np.nan_to_num(tangents_from_pixel(truth.cameras[0], xy))  # corners may lie beyond 90 degrees
    pictures = []
    for X0, R in zip(truth.position, truth.rotation, strict=True):
        at = _walls(X0, np.column_stack([uv, -np.ones(len(uv))]) @ R.T)
        fine = _light(at, skin).reshape(SIZE[1], FINE, SIZE[0], FINE).mean(axis=(1, 3))
        noise = rng.normal(0, 1.0, fine.shape)
        pictures.append(np.rint(np.clip(40 + 170 * fine + noise, 0, 255)).astype(np.uint8))
    return pictures


def _room(folder: Path, lens: Camera) -> None:
    """Write photographs and a model whose camera, orientation and points are off."""
    rng = seed_of(f"room of {lens.model}")
    position, rotation = _stations()
    x, y = np.meshgrid(np.arange(20, SIZE[0] - 19, 24.0), np.arange(20, SIZE[1] - 19, 24.0))
    uv = tangents_from_pixel(lens, np.column_stack([x.ravel(), y.ravel()]))
    rays = [np.column_stack([uv, -np.ones(len(uv))]) @ rotation[i].T for i in (0, 3)]
    points = np.concatenate([_walls(position[i], d) for i, d in zip((0, 3), rays, strict=True)])
    truth = Estimate((lens,), position, rotation, points)
    (folder / "photographs").mkdir()
    image, point, xy = [], [], []
    for i, picture in enumerate(_photographs(truth)):
        cv2.imwrite(str(folder / "photographs" / f"{i}.png"), picture)
        seen = project(lens, position[i], rotation[i], points)
        inside = np.flatnonzero(((seen > 12) & (seen < np.array(SIZE) - 13)).all(axis=1))
        image += [i] * len(inside)
        point += inside.tolist()
        xy.append(seen[inside] + rng.normal(0, NOISE_PX, (len(inside), 2)))
    network = Network(
        tuple(f"{i}.png" for i in range(len(position))),
        np.zeros(len(position), dtype=np.int64),
        tuple(str(j) for j in range(len(points))),
        ImagePoints(
            np.array(image), np.array(point), np.concatenate(xy), np.tile(np.eye(2), (len(image), 1, 1))
        ),
    )
    off = lens.parameters * (1 + 0.002 * rng.uniform(-1, 1, len(lens.parameters)))
    start = Estimate(
        (lens.with_parameters(off),),
        position + rng.normal(0, 0.001, position.shape),
        rotation,
        points + rng.normal(0, 0.001, points.shape),
    )
    write_model(folder / "model", network, start)


def _of_cameras(out: Path, column: str) -> FloatArray:
    return np.array([float(row[column] or "nan") for row in rows_of(out / "sigma_cameras.csv")])


@pytest.mark.slow
@pytest.mark.parametrize(
    "model",
    [pytest.param("opencv_fisheye", marks=pytest.mark.slow), "simple_division", "thin_prism_fisheye"],
)
def test_a_wide_angle_camera_is_calibrated_within_its_standard_deviations(
    tmp_path: Path, model: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lens, out = Camera("lens", model, SIZE, np.ones(2), np.array(PARAMETERS[model])), tmp_path / "out"
    _room(tmp_path, lens)
    refine(tmp_path / "model", tmp_path / "photographs", out=out, window=WINDOW_PX)
    sigma0 = re.search(r"sigma0 +([\d.]+) px", capsys.readouterr().out)
    assert sigma0 and 0.005 < float(sigma0[1]) < 0.015  # px, of a noise of 1 of 255 grey values
    after = pycolmap.Reconstruction(str(out)).camera(1)
    assert after.model_name == model.upper()
    assert after.params == pytest.approx(_of_cameras(out, "after"))
    assert (np.abs(after.params - colmap_parameters(lens)) < 3 * _of_cameras(out, "sigma")).all()


def test_key_points_far_off_the_axis_are_left_out_and_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lens = Camera("lens", "simple_fisheye", SIZE, np.ones(2), np.array([150.0, 199.5, 159.5]))
    _room(tmp_path, lens)
    before = pycolmap.Reconstruction(str(tmp_path / "model"))
    beyond = sum(
        np.arccos((R := image.cam_from_world() * before.point3D(one.point3D_id).xyz)[2] / np.linalg.norm(R))
        > np.radians(85)
        for image in before.images.values()
        for one in image.points2D
    )
    refine(tmp_path / "model", tmp_path / "photographs", out=tmp_path / "out", window=WINDOW_PX)
    assert beyond > 3
    assert f"{beyond} behind the photograph or more than 85 degrees off the axis" in capsys.readouterr().out
