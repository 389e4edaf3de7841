"""Rendered videos of coded targets, encoded by PyAV as cameras and telephones do."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sfm.model.camera import Camera
from sfm.model.conventions import AnyArray, FloatArray
from sfm.products.rendering.render import render_photographs
from sfm.products.rendering.scene import Optics
from tests.surveys import camera, plates
from tests.synthetic import seed_of

CLOCK = 90_000  # ticks a second
OPTIONS = {
    "libx264": {"crf": "16", "g": "12", "bf": "0", "preset": "veryfast", "threads": "1"},
    "libx265": {"x265-params": "log-level=none:pools=1:crf=16:bframes=0:keyint=12"},
    "mpeg4": {"qscale": "2", "g": "12"},
}


def path_around(turns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions and rotations of a camera that is carried around the plates, after turns (rad).

    It rises and sinks, comes nearer, and is turned from level to upright and back.
    """
    radius, height = 330 + 60 * np.sin(turns), 520 + 130 * np.sin(2 * turns)
    position = np.stack([radius * np.cos(turns), radius * np.sin(turns), height], axis=1)
    z = position / np.linalg.norm(position, axis=1)[:, None]
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x, axis=1)[:, None]
    roll = np.pi / 4 * (1 - np.cos(turns))[:, None]
    y = np.cross(z, x)
    turned = np.cos(roll) * x + np.sin(roll) * y, np.cos(roll) * y - np.sin(roll) * x
    return position, np.stack([*turned, z], axis=2)


def rendered(turns: FloatArray, *, of: Camera | None = None) -> list[AnyArray]:
    """Return frames of a camera that is carried around the plates, (H, W), uint8."""
    optics = Optics(blur_px=0.7, exposure=0.9, noise=0.008)
    frames, _ = render_photographs(plates(), of or camera(), *path_around(turns), optics=optics, seed=1)
    return list(frames)


def orbit(angles: FloatArray, *, seed: str = "orbit", side_px: int = 480) -> list[AnyArray]:
    """Return frames of a flat texture, around whose normal a camera is carried, (H, W), uint8."""
    rng = seed_of(seed)
    texture = cv2.GaussianBlur(rng.standard_normal((900, 900)), (0, 0), 3.0)
    texture = np.clip(128 + 45 * texture / texture.std(), 0, 255).astype(np.uint8)
    K = np.array([[1.2 * side_px, 0, side_px / 2], [0, 1.2 * side_px, 3 * side_px / 8], [0, 0, 1]])
    plane = np.array([[2 / 900, 0, -1], [0, 2 / 900, -1], [0, 0, 1]])  # texture to object, sides of 2
    frames = []
    for angle in angles:
        centre = 2.2 * np.array([np.cos(angle), np.sin(angle), 1.0]) / np.sqrt(2)
        z = -centre / np.linalg.norm(centre)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        H = K @ np.column_stack([R[:, 0], R[:, 1], -R @ centre]) @ plane
        frame = cv2.warpPerspective(texture, H, (side_px, 3 * side_px // 4), borderValue=128)
        noisy = frame + rng.normal(0, 2, frame.shape)
        frames.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return frames


def write_video(
    path: Path,
    frames: Sequence[AnyArray],
    *,
    rate: int = 25,
    times_s: Sequence[float] | None = None,
    rotation: int = 0,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    metadata: dict[str, str] | None = None,
    colours: dict[str, int] | None = None,
) -> Path:
    """Write a video; times_s are those of the frames, else regular ones."""
    import av

    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"} if metadata else {}) as container:
        container.metadata.update(metadata or {})
        stream: Any = container.add_stream(codec, rate=rate)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixels
        clock = rate if codec == "mpeg4" else CLOCK
        stream.codec_context.time_base = Fraction(1, clock)
        stream.options = OPTIONS.get(codec, {})
        for name, value in (colours or {}).items():
            setattr(stream.codec_context, name, value)
        if rotation:
            stream.set_display_rotation(rotation)
        for k, picture in enumerate(frames):
            rgb = picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)
            frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
            frame.pts = round(clock * (k / rate if times_s is None else times_s[k]))
            frame.time_base = Fraction(1, clock)
            for name, value in (colours or {}).items():
                setattr(frame, name, value)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path
