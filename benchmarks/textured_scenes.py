"""Renders photographs of a textured surface of three roughnesses, with the true orientation.

    python -m benchmarks.textured_scenes smooth 20 build/smooth20
    python -m benchmarks.textured_scenes medium 1000 build/block1000 --layout block --finer 0.625

The surface has hills and ripples. The ripples are absent, 4 mm high and 0.15 m long, or 8 mm high and 0.08 m
long. On a dome, the camera moves around a square of 2.4 m at several elevations, and every photograph shows
most of it. In a block, the photographs look at the nodes of a grid, tilted by 20 degrees in turn in four
directions, and the surface is as large as their number asks for: a point inside is in about 15 of them. Every
other photograph is rotated by 90 degrees. Every pixel is the mean of rays over its area, blurred and with
noise, as in datasets/textured.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from datasets.textured import render
from sfm.model.camera import Camera, camera_from_values, tangents_from_pixel
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.runtime.compiling import compiled

RIPPLES = {"smooth": (0.0, 1.0), "medium": (0.004, 0.15), "rough": (0.008, 0.08)}  # height and length, m
SIZE_PX = (1024, 768)
PIXEL_MM = 0.006
C_MM = 8.0
DISTANCE_M = 1.7
ELEVATIONS_DEG = (48.0, 58.0, 70.0)
MARCH, BISECT = 40, 12  # steps along a ray through the slab around the surface; bisections in a step
SLAB_M = 0.2  # half the height of that slab
COARSE = 8  # pixels between the rays of a block that are followed from outside; the others start between them
NODES_M = (0.36, 0.28)  # between the nodes of a block, along and across its rows
TILT_DEG = 20.0  # of the photographs of a block
OVERLAP_M = 0.9  # photographs that look at points nearer to each other share 14 to 36 % of what they show
LAYOUTS = ("dome", "block")
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
    layout: str = "dome"  # dome | block


def textured_scene(
    roughness: str, photographs: int, finer: float = 1.0, layout: str = "dome"
) -> TexturedScene:
    """Return the scene with its true orientation; pixels are `finer` times smaller than usual."""
    towards, outward = _dome(photographs) if layout == "dome" else _block(photographs)
    position, rotation = [], []
    for i in range(photographs):
        x = np.cross([0.0, 0.0, 1.0], outward[i])
        x /= np.linalg.norm(x)
        roll = np.radians(90 * (i // 2 % 2))
        right = np.cos(roll) * x + np.sin(roll) * np.cross(outward[i], x)
        position.append(towards[i] + (DISTANCE_M + 0.08 * (i % 4)) * outward[i])
        rotation.append(np.column_stack([right, np.cross(outward[i], right), outward[i]]))
    centre = (("cx", 515.0 * finer), ("cy", 380.0 * finer))
    values = (("k1", -0.05), ("k2", 0.02), ("p1", 2e-4), ("p2", -1e-4), *centre)
    size, pixel = (round(SIZE_PX[0] * finer), round(SIZE_PX[1] * finer)), PIXEL_MM / finer
    camera = camera_from_values("lens", "opencv", size, (pixel, pixel), c_mm=C_MM, values=values)
    return TexturedScene(roughness, np.array(position), np.array(rotation), camera, layout)


def _dome(photographs: int) -> tuple[FloatArray, FloatArray]:
    """Return the points that photographs around a surface look at and the directions from there, (m, 3)."""
    i = np.arange(photographs)
    azimuth = 2 * np.pi * i / photographs * (1 if photographs < 40 else 2)
    elevation = np.radians(ELEVATIONS_DEG)[i % 3]
    level = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)[:, None]
    return np.zeros((photographs, 3)), np.column_stack([level, np.sin(elevation)])


def _block(photographs: int) -> tuple[FloatArray, FloatArray]:
    """Return the nodes that photographs of a block look at and the directions from there, (m, 3)."""
    rows = max(round(np.sqrt(photographs / 1.6)), 1)
    row, column = np.divmod(np.arange(photographs), -(-photographs // rows))
    nodes = np.column_stack([column * NODES_M[0], row * NODES_M[1], np.zeros(photographs)])
    azimuth, tilt = np.pi / 2 * ((column + 2 * row) % 4) + np.pi / 4, np.radians(TILT_DEG)
    level = np.column_stack([np.cos(azimuth), np.sin(azimuth)]) * np.sin(tilt)
    middle = (nodes.max(axis=0) + nodes.min(axis=0)) / 2
    return nodes - middle, np.column_stack([level, np.full(photographs, np.cos(tilt))])


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


def scene_texture(scene: TexturedScene) -> tuple[AnyArray, float]:
    """Return the reflectance of the surface with the origin in its middle, and the side of a texel, m."""
    if scene.layout == "dome":
        return render.texture(), render.TEXEL_M
    reach = np.abs(scene.position[:, :2]).max(axis=0) + DISTANCE_M
    texel = render.TEXEL_M * scene.camera.pixel_mm[0] / PIXEL_MM
    return render.texture(size_m=(2 * float(reach[0]), 2 * float(reach[1])), texel_m=texel), texel


def intensities(
    scene: TexturedScene, index: int, skin: AnyArray, texel_m: float = render.TEXEL_M
) -> AnyArray:
    """Return one photograph without noise, float32, 0 to 255."""
    width, rows = scene.camera.size_px
    centre, (tall, long) = scene.position[index], RIPPLES[scene.roughness]
    coarse = COARSE if scene.layout == "block" else 1
    start = np.empty((rows // coarse) * (width // coarse))
    _first_meeting(tall, long, centre, _rays(scene, index, ((coarse - 1) / 2,) * 2, coarse), start)
    start = cv2.resize(
        start.reshape(rows // coarse, -1), (width, rows), interpolation=cv2.INTER_LINEAR
    ).ravel()
    light = np.zeros((rows, width), dtype=np.float32)
    for dx, dy in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        d, t = _rays(scene, index, (dx, dy)), start.copy()
        _nearby_meeting(tall, long, centre, d, t)
        at = (centre + t[:, None] * d)[:, :2] / texel_m + np.array(skin.shape[1::-1]) / 2
        at = at.astype(np.float32).reshape(rows, width, 2)
        light += cv2.remap(skin, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=0.45)
    light = cv2.GaussianBlur(light / 4, (0, 0), render.BLUR_PX)
    return np.asarray(255 * light * (0.85 + 0.04 * (index % 4)))


def _rays(scene: TexturedScene, index: int, offset: tuple[float, float], step: int = 1) -> FloatArray:
    """Return rays through every `step`-th pixel of a photograph, an offset from its centre, (k, 3)."""
    x, y = np.meshgrid(*(np.arange(size // step) * step for size in scene.camera.size_px))
    uv = tangents_from_pixel(scene.camera, np.column_stack([x.ravel(), y.ravel()]).astype(float) + offset)
    return np.ascontiguousarray(np.column_stack([uv, -np.ones(len(uv))]) @ scene.rotation[index].T)


def surface_at(scene: TexturedScene, index: int, xy: FloatArray) -> FloatArray:
    """Return the surface points (k, 3), m, at pixel positions (k, 2) of a photograph."""
    centre, (tall, long) = scene.position[index], RIPPLES[scene.roughness]
    uv = tangents_from_pixel(scene.camera, xy)
    d = np.ascontiguousarray(np.column_stack([uv, -np.ones(len(uv))]) @ scene.rotation[index].T)
    length = np.empty(len(d))
    _first_meeting(tall, long, centre, d, length)
    return np.asarray(centre + length[:, None] * d)


def overlapping(scene: TexturedScene) -> IntArray:
    """Return the pairs of photographs that look at points less than OVERLAP_M apart, (k, 2)."""
    outward = scene.rotation[:, :, 2]
    seen = scene.position - outward * (scene.position[:, 2] / outward[:, 2])[:, None]
    return cKDTree(seen[:, :2]).query_pairs(OVERLAP_M, output_type="ndarray")


def render_scene(
    folder: Path, roughness: str, photographs: int, finer: float = 1.0, layout: str = "dome"
) -> TexturedScene:
    """Write the photographs and a survey file; return the scene."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = textured_scene(roughness, photographs, finer, layout)
    skin, texel = scene_texture(scene)
    for index in range(photographs):
        noise = np.random.default_rng((render.SEED, index)).normal(
            0, render.NOISE, scene.camera.size_px[::-1]
        )
        light = intensities(scene, index, skin, texel)
        picture = np.rint(np.clip(light + noise, 0, 255)).astype(np.uint8)
        cv2.imwrite(str(folder / photograph_name(index)), picture)
    (folder / "survey.toml").write_text(
        SURVEY.format(name=folder.name, pixel=PIXEL_MM / finer), encoding="utf-8"
    )
    return scene


def photograph_name(index: int) -> str:
    """Return the file name of a photograph of a scene."""
    return f"surface_{index + 1:03d}.png"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("roughness", choices=list(RIPPLES))
    parser.add_argument("photographs", type=int)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--layout", choices=LAYOUTS, default="dome")
    parser.add_argument("--finer", type=float, default=1.0, help="pixels along each of 1024 x 768")
    arguments = parser.parse_args()
    render_scene(
        arguments.folder, arguments.roughness, arguments.photographs, arguments.finer, arguments.layout
    )
