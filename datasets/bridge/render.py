"""Renders a bridge deck with 40 coded targets in three epochs, with 0, 0.15 and 0.4 mm of sag at mid-span.

    python datasets/bridge/render.py build/bridge
    cd build/bridge && kolinear epochs first.toml second.toml third.toml

The model stands in a hall. Its deck lies between two abutments that do not move, with two scale bars beside
it. Every target is on a separate plate, which moves down with the deck. The photographs of each epoch are
taken from new stations, hand-held, with one camera. Lengths are in mm.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from sfm.model.camera import Camera, camera_from_values
from sfm.model.conventions import FloatArray
from sfm.products.rendering.render import write_photographs
from sfm.products.rendering.scene import CircularTargets, Faces, Light, Optics, Scene, coded_ring, join_marks
from sfm.products.rendering.scene_file import Staging
from sfm.targets.codes.plates import code_family

EPOCHS = {"first": 0.0, "second": 0.15, "third": 0.4}  # sag at mid-span, mm
PHOTOGRAPHS = 12  # per epoch
HALF_SPAN = 900.0
COLUMNS, ROWS = np.linspace(-HALF_SPAN, HALF_SPAN, 7), (-180.0, -60.0, 60.0, 180.0)  # X and Y on the deck
ABUTMENT = ((-1060.0, 60.0), (1060.0, 60.0))  # X and Z
BARS = (((-600.0, -420.0), (600.0, -420.0)), ((-500.0, 420.0), (500.0, 420.0)))  # ends, on the ground
GROUND = -250.0
BAR_READINGS = (1200.008, 999.995)
BAR_SIGMA = 0.01
PLATE, RADIUS = 90.0, 12.0  # side of a plate, radius of a dot
FAMILY = "ring14"
SIZE_PX, PIXEL_MM, C_MM = (1600, 1200), (0.005, 0.005), 8.11
LENS = (("x0", 0.03), ("y0", -0.02), ("K1", 1.4e-3), ("K2", -2e-5), ("P1", 4e-5), ("P2", -3e-5))
DISTANCE = 3150.0
SEED = 40


def sag(x: FloatArray, middle: float) -> FloatArray:
    """Return the sag of a deck that is clamped at both ends and evenly loaded, mm, positive downwards."""
    return np.asarray(np.where(np.abs(x) < HALF_SPAN, middle * (1 - (x / HALF_SPAN) ** 2) ** 2, 0.0))


def object_points(middle: float = 0.0) -> FloatArray:
    """Return the targets: 28 on the deck, 12 on the abutments and 4 at the ends of the bars, mm, (44, 3)."""
    deck = np.array([(x, y, 0.0) for x in COLUMNS for y in ROWS])
    deck[:, 2] -= sag(deck[:, 0], middle)
    abutments = [(x, y, z) for x, z in ABUTMENT for y in (-150.0, 0.0, 150.0)]
    abutments += [(x, y, z + 110.0) for x, z in ABUTMENT for y in (-75.0, 75.0)]
    abutments += [(x, 0.0, z + 220.0) for x, z in ABUTMENT]
    bars = [(*end, GROUND + 10.0) for bar in BARS for end in bar]
    return np.vstack([deck, abutments, bars])


def codes() -> tuple[int, ...]:
    """Return the numbers of the targets, (44,)."""
    return tuple(range(10, 10 + 11 * len(object_points()), 11))


def camera() -> Camera:
    """Return the camera of all epochs."""
    return camera_from_values("lens", "brown", SIZE_PX, PIXEL_MM, c_mm=C_MM, values=LENS)


def stations(rng: np.random.Generator, photographs: int = PHOTOGRAPHS) -> tuple[FloatArray, FloatArray]:
    """Return projection centres (m, 3) and rotations (m, 3, 3): hand-held around the bridge, some rolled."""
    position, rotation = [], []
    for i in range(photographs):
        azimuth = 2 * np.pi * i / photographs + rng.uniform(-0.1, 0.1)
        lift = np.radians(40 if i % 2 else 65) + rng.uniform(-0.05, 0.05)
        z = np.array([np.cos(lift) * np.cos(azimuth), np.cos(lift) * np.sin(azimuth), np.sin(lift)])
        x = np.cross([0.0, 0.0, 1.0], z)
        x /= np.linalg.norm(x)
        turn = np.pi / 2 * (i // 2 % 4) + rng.uniform(-0.1, 0.1)
        right = np.cos(turn) * x + np.sin(turn) * np.cross(z, x)
        position.append(DISTANCE * z + rng.uniform(-40, 40, 3))
        rotation.append(np.column_stack([right, np.cross(z, right), z]))
    return np.array(position), np.array(rotation)


def staging(epoch: str) -> Staging:
    """Return the objects and stations of an epoch."""
    family = code_family(FAMILY)
    assert family is not None
    xyz, numbers = object_points(EPOCHS[epoch]), codes()
    n = len(xyz)
    slabs = np.array([(0.0, 0.0, -16.0), (-1060.0, 0.0, 40.0), (1060.0, 0.0, 40.0), (0.0, 0.0, GROUND)])
    sizes = np.array([(1980.0, 460.0), (120.0, 460.0), (120.0, 460.0), (3600.0, 2000.0)])
    axes = np.tile(np.eye(3)[:2], (n + len(slabs), 1, 1))
    plate = np.full((n, 2), PLATE)
    faces = Faces(
        np.vstack([xyz, slabs]),
        axes,
        np.vstack([plate, sizes]) / 2,
        np.concatenate([np.full(n, 0.85), [0.5, 0.4, 0.4, 0.2]]),
        np.concatenate([np.zeros(n), np.full(len(slabs), 0.04)]),
        np.full(n + len(slabs), 9.0),
    )
    nowhere = np.zeros(2)
    marks = [
        coded_ring(k, nowhere, RADIUS, number, family, 0.05, turn=0.7 * k) for k, number in enumerate(numbers)
    ]
    targets = CircularTargets(np.arange(n), np.zeros((n, 2)), np.full(n, RADIUS), np.array(numbers))
    seed = SEED + list(EPOCHS).index(epoch)
    positions, rotations = stations(np.random.default_rng(seed))
    return Staging(
        Scene(faces, join_marks(marks), targets, Light(np.array([900.0, -700.0, 3000.0]), 3000.0, 0.3), 0.05),
        camera(),
        positions,
        rotations,
        Optics(blur_px=0.7, vignetting=0.2, exposure=0.9, noise=0.01, shot_noise=0.012),
        tuple(f"{epoch}_{i + 1:02d}.jpg" for i in range(PHOTOGRAPHS)),
        96,
        seed,
    )


def survey_text(epoch: str) -> str:
    """Return the survey file of an epoch."""
    numbers = codes()[-4:]
    bars = "".join(
        f'\n[[scale_bar]]\nfrom = "{a}"\nto = "{b}"\nlength = {reading}\nsigma = {BAR_SIGMA}\n'
        for (a, b), reading in zip((numbers[:2], numbers[2:]), BAR_READINGS, strict=True)
    )
    return f"""# The bridge deck, {epoch} epoch: photographs and this file by datasets/bridge/render.py
[survey]
name = "{epoch}"
unit = "mm"

[[camera]]
name = "lens"
images = "{epoch}/*.jpg"
size_px = [{SIZE_PX[0]}, {SIZE_PX[1]}]
pixel_mm = [{PIXEL_MM[0]}, {PIXEL_MM[1]}]
c_mm = 8.0
model = "brown"
free = ["c", "x0", "y0", "K1", "K2", "P1", "P2"]

[targets]
codes = "{FAMILY}"
{bars}
[adjust]
sigma_px = 0.02
"""


def render(folder: Path) -> None:
    """Write the photographs of all epochs with the true values, and one survey file for each epoch."""
    for epoch in EPOCHS:
        write_photographs(staging(epoch), folder / epoch)
        (folder / f"{epoch}.toml").write_text(survey_text(epoch), encoding="utf-8")


if __name__ == "__main__":
    render(Path(sys.argv[1] if len(sys.argv) > 1 else "build/bridge"))
