"""Renders the textured survey: eight photographs of a hilly surface without targets, with known true values.

    python datasets/textured/render.py build/textured

Every pixel is the mean of the texture where its rays meet the surface, blurred and with noise.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from sfm.model.camera import Camera, camera_from_values, tangents_from_pixel
from sfm.model.conventions import AnyArray, FloatArray

SIZE_PX = (1000, 800)
PIXEL_MM = (0.006, 0.006)
C_MM = 8.0
LENS = (("k1", -0.05), ("k2", 0.02), ("p1", 2e-4), ("p2", -1e-4), ("cx", 503.0), ("cy", 397.0))
PHOTOGRAPHS = 8
HILL_M = 0.12  # height of the waves of the surface
DISTANCE_M = 1.6
ELEVATION_DEG = 62.0
SAMPLES = 2  # rays along each side of a pixel
BLUR_PX = 0.6
NOISE = 1.5  # standard deviation of an intensity, of 256 levels
TEXEL_M = 0.0006  # about half a pixel in the photographs
TEXTURE_M = 2.4  # side of the textured square
OCTAVES = 6  # octaves of the texture, each half as coarse as the one before
SEED = 20


def camera() -> Camera:
    """Return the camera of all photographs."""
    return camera_from_values("lens", "opencv", SIZE_PX, PIXEL_MM, c_mm=C_MM, values=LENS)


def stations() -> tuple[FloatArray, FloatArray]:
    """Return projection centres (m, 3) and rotations (m, 3, 3) of a ring around the surface, some upright."""
    position, rotation = [], []
    for i in range(PHOTOGRAPHS):
        azimuth = 2 * np.pi * i / PHOTOGRAPHS
        elevation = np.radians(ELEVATION_DEG + (8 if i % 2 else -4))
        outward = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        x = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        roll = np.radians(90 * (i // 2 % 2))
        right = np.cos(roll) * x + np.sin(roll) * np.cross(outward, x)
        position.append((DISTANCE_M + 0.1 * (i % 3)) * outward)
        rotation.append(np.column_stack([right, np.cross(outward, right), outward]))
    return np.array(position), np.array(rotation)


def height(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of the surface, m."""
    return np.asarray(HILL_M * (np.sin(1.7 * x + 0.4) * np.cos(1.4 * y) + 0.2 * np.sin(2.1 * (x - y))))


def surface_points(position: FloatArray, directions: FloatArray) -> FloatArray:
    """Intersect rays from one point with the surface, (k, 3), by the secant method on the height above it."""
    z = directions[:, 2]
    t = -position[2] / z
    before = t * (1 - 0.05)
    gap = position[2] + before * z - height(*(position[:2] + before[:, None] * directions[:, :2]).T)
    for _ in range(12):
        now = position[2] + t * z - height(*(position[:2] + t[:, None] * directions[:, :2]).T)
        change = now - gap
        step = np.where(np.abs(change) > 1e-15, now * (t - before) / np.where(change == 0, 1, change), 0.0)
        before, gap, t = t, now, t - step
        if np.abs(step).max() < 1e-10:
            break
    return np.asarray(position + t[:, None] * directions)


def texture(
    seed: int = SEED, size_m: tuple[float, float] = (TEXTURE_M, TEXTURE_M), texel_m: float = TEXEL_M
) -> AnyArray:
    """Return the reflectance over a rectangle, a mixture of fine and coarse grain, float32."""
    rng = np.random.default_rng(seed)
    wide, high = (round(side / texel_m) for side in size_m)
    total = np.zeros((high, wide), dtype=np.float32)
    for octave in range(OCTAVES):
        cells = (high // (4 * 2**octave) + 3, wide // (4 * 2**octave) + 3)
        grid = rng.standard_normal(cells).astype(np.float32)
        total += cv2.resize(grid, (wide, high), interpolation=cv2.INTER_CUBIC) * 1.25**octave
    total = (total - total.mean()) / total.std()
    return np.asarray(np.clip(0.45 + 0.17 * total, 0.02, 0.98), dtype=np.float32)


def intensities(index: int, skin: AnyArray) -> AnyArray:
    """Return one photograph without noise, float32, 0 to 255."""
    width, height_px = SIZE_PX
    position, rotation = (part[index] for part in stations())
    lens = camera()
    offsets = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    light = np.zeros((height_px, width), dtype=np.float32)
    for dy in offsets:
        for dx in offsets:
            y, x = np.mgrid[0:height_px, 0:width]
            uv = tangents_from_pixel(lens, np.column_stack([x.ravel() + dx, y.ravel() + dy]))
            rays = np.column_stack([uv, -np.ones(len(uv))]) @ rotation.T
            at = surface_points(position, rays)[:, :2] / TEXEL_M + len(skin) / 2
            at = at.astype(np.float32).reshape(height_px, width, 2)
            light += cv2.remap(skin, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=0.45)
    light = cv2.GaussianBlur(light / SAMPLES**2, (0, 0), BLUR_PX)
    # the exposure differs slightly between photographs
    return np.asarray(255 * light * (0.85 + 0.04 * (index % 4)))


def photograph(index: int, light: AnyArray) -> AnyArray:
    """Return one photograph with noise from its intensities, uint8."""
    noise = np.random.default_rng((SEED, index)).normal(0, NOISE, light.shape)
    return np.rint(np.clip(light + noise, 0, 255)).astype(np.uint8)


def surface_at(index: int, xy: FloatArray) -> FloatArray:
    """Return the surface points (k, 3) at pixel positions (k, 2) of a photograph."""
    position, rotation = (part[index] for part in stations())
    uv = tangents_from_pixel(camera(), xy)
    return surface_points(position, np.column_stack([uv, -np.ones(len(uv))]) @ rotation.T)


def render(folder: Path) -> None:
    """Write the photographs and a copy of the survey file beside this module."""
    folder.mkdir(parents=True, exist_ok=True)
    skin = texture()
    for index in range(PHOTOGRAPHS):
        cv2.imwrite(str(folder / f"surface_{index + 1}.png"), photograph(index, intensities(index, skin)))
    survey = (Path(__file__).parent / "survey.toml").read_text(encoding="utf-8")
    (folder / "survey.toml").write_text(survey, encoding="utf-8")


if __name__ == "__main__":
    render(Path(sys.argv[1] if len(sys.argv) > 1 else "build/textured"))
