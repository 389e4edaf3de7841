"""Renders photographs of a textured surface of three roughnesses, with the true orientation.

    python -m benchmarks.textured_scenes smooth 20 build/smooth20

The surface is a square of 2.4 m with hills and ripples. The ripples are absent, 4 mm high and 0.15 m long, or
8 mm high and 0.08 m long. The camera moves around the surface on a dome at several elevations; every other
photograph is rotated by 90 degrees. Every pixel is the mean of rays over its area, blurred and with noise, as
in datasets/textured.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from datasets.textured import render
from sfm.model.camera import Camera, camera_from_values, tangents_from_pixel
from sfm.model.conventions import AnyArray, FloatArray
from sfm.runtime.compiling import compiled

RIPPLES = {"smooth": (0.0, 1.0), "medium": (0.004, 0.15), "rough": (0.008, 0.08)}  # height and length, m
SIZE_PX = (1024, 768)
PIXEL_MM = 0.006
C_MM = 8.0
DISTANCE_M = 1.7
ELEVATIONS_DEG = (48.0, 58.0, 70.0)
MARCH, BISECT = 40, 12  # steps along a ray through the slab around the surface; bisections in a step
SLAB_M = 0.2  # half the height of that slab
SURVEY = """[survey]
name = "{name}"
unit = "m"

[[camera]]
name = "lens"
images = "surface_*.png"
pixel_mm = [{pixel}, {pixel}]
c_mm = 8.2
model = "opencv"
free = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"]

[targets]
codes = "none"

[tie_points]

[adjust]
sigma_px = 0.02
"""


@dataclass(frozen=True)
class TexturedScene:
    """A surface and the orientation of its photographs."""

    roughness: str  # smooth | medium | rough
    position: FloatArray  # projection centres, m, (m, 3)
    rotation: FloatArray  # (m, 3, 3)
    camera: Camera


def textured_scene(roughness: str, photographs: int, finer: int = 1) -> TexturedScene:
    """Return the scene with its true orientation; pixels are `finer` times smaller than usual."""
    position, rotation = [], []
    for i in range(photographs):
        azimuth = 2 * np.pi * i / photographs * (1 if photographs < 40 else 2)
        elevation = np.radians(ELEVATIONS_DEG[i % 3])
        outward = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        x = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        roll = np.radians(90 * (i // 2 % 2))
        right = np.cos(roll) * x + np.sin(roll) * np.cross(outward, x)
        position.append((DISTANCE_M + 0.08 * (i % 4)) * outward)
        rotation.append(np.column_stack([right, np.cross(outward, right), outward]))
    centre = (("cx", 515.0 * finer), ("cy", 380.0 * finer))
    values = (("k1", -0.05), ("k2", 0.02), ("p1", 2e-4), ("p2", -1e-4), *centre)
    size, pixel = (SIZE_PX[0] * finer, SIZE_PX[1] * finer), PIXEL_MM / finer
    camera = camera_from_values("lens", "opencv", size, (pixel, pixel), c_mm=C_MM, values=values)
    return TexturedScene(roughness, np.array(position), np.array(rotation), camera)


@compiled
def _height(tall: float, long: float, x: float, y: float) -> float:
    """Return the height of the hills of datasets/textured with ripples of a given height and length, m."""
    hills = np.sin(1.7 * x + 0.4) * np.cos(1.4 * y) + 0.2 * np.sin(2.1 * (x - y))
    k = 2 * np.pi / long
    ripples = tall * np.sin(k * x + np.sin(1.3 * k * y)) * np.cos(0.8 * k * y) if tall > 0 else 0.0
    return float(render.HILL_M * hills + ripples)


@compiled
def _gap(tall: float, long: float, centre: FloatArray, d: FloatArray, t: float) -> float:
    """Return the height of a point on a ray above the surface, m."""
    return float(centre[2] + t * d[2] - _height(tall, long, centre[0] + t * d[0], centre[1] + t * d[1]))


@compiled
def _first_meeting(
    tall: float, long: float, centre: FloatArray, rays: FloatArray, length: FloatArray
) -> None:
    """Fill the distance along each ray to its first intersection with the surface, by steps and bisection."""
    for k in range(len(rays)):
        d = rays[k]
        first, last = (SLAB_M - centre[2]) / d[2], (-SLAB_M - centre[2]) / d[2]
        above, below = first, last
        for step in range(1, MARCH + 1):
            t = first + (last - first) * step / MARCH
            if _gap(tall, long, centre, d, t) < 0:
                below = t
                break
            above = t
        for _ in range(BISECT):
            middle = (above + below) / 2
            if _gap(tall, long, centre, d, middle) < 0:
                below = middle
            else:
                above = middle
        length[k] = (above + below) / 2


@compiled
def _nearby_meeting(
    tall: float, long: float, centre: FloatArray, rays: FloatArray, length: FloatArray
) -> None:
    """Improve the distance along each ray to the surface by Newton's method from nearby."""
    for k in range(len(rays)):
        t = length[k]
        for _ in range(3):
            gap = _gap(tall, long, centre, rays[k], t)
            slope = (_gap(tall, long, centre, rays[k], t + 1e-5) - gap) / 1e-5
            step = gap / (slope if abs(slope) > 0.05 else -0.05)
            t -= min(max(step, -0.01), 0.01)
        length[k] = t


def intensities(scene: TexturedScene, index: int, skin: AnyArray) -> AnyArray:
    """Return one photograph without noise, float32, 0 to 255."""
    width, rows = scene.camera.size_px
    centre, (tall, long) = scene.position[index], RIPPLES[scene.roughness]
    y, x = np.mgrid[0:rows, 0:width]
    grid = np.column_stack([x.ravel(), y.ravel()]).astype(float)

    def rays(offset: tuple[float, float]) -> FloatArray:
        uv = tangents_from_pixel(scene.camera, grid + offset)
        return np.ascontiguousarray(np.column_stack([uv, -np.ones(len(uv))]) @ scene.rotation[index].T)

    middle = np.empty(len(grid))
    _first_meeting(tall, long, centre, rays((0.0, 0.0)), middle)
    light = np.zeros((rows, width), dtype=np.float32)
    for offset in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        d, t = rays(offset), middle.copy()
        _nearby_meeting(tall, long, centre, d, t)
        at = (centre + t[:, None] * d)[:, :2] / render.TEXEL_M + len(skin) / 2
        at = at.astype(np.float32).reshape(rows, width, 2)
        light += cv2.remap(skin, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=0.45)
    light = cv2.GaussianBlur(light / 4, (0, 0), render.BLUR_PX)
    return np.asarray(255 * light * (0.85 + 0.04 * (index % 4)))


def surface_at(scene: TexturedScene, index: int, xy: FloatArray) -> FloatArray:
    """Return the surface points (k, 3), m, at pixel positions (k, 2) of a photograph."""
    centre, (tall, long) = scene.position[index], RIPPLES[scene.roughness]
    uv = tangents_from_pixel(scene.camera, xy)
    d = np.ascontiguousarray(np.column_stack([uv, -np.ones(len(uv))]) @ scene.rotation[index].T)
    length = np.empty(len(d))
    _first_meeting(tall, long, centre, d, length)
    return np.asarray(centre + length[:, None] * d)


def render_scene(folder: Path, roughness: str, photographs: int, finer: int = 1) -> TexturedScene:
    """Write the photographs and a survey file; return the scene."""
    folder.mkdir(parents=True, exist_ok=True)
    scene, skin = textured_scene(roughness, photographs, finer), render.texture()
    for index in range(photographs):
        noise = np.random.default_rng((render.SEED, index)).normal(
            0, render.NOISE, scene.camera.size_px[::-1]
        )
        picture = np.rint(np.clip(intensities(scene, index, skin) + noise, 0, 255)).astype(np.uint8)
        cv2.imwrite(str(folder / f"surface_{index + 1:03d}.png"), picture)
    (folder / "survey.toml").write_text(
        SURVEY.format(name=folder.name, pixel=PIXEL_MM / finer), encoding="utf-8"
    )
    return scene


if __name__ == "__main__":
    render_scene(Path(sys.argv[3]), sys.argv[1], int(sys.argv[2]))
