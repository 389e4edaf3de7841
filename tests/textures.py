"""Textures with known values and gradients everywhere, and pairs of photographs of them with known warps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.model.conventions import FloatArray

WAVES = 160
MEAN, CONTRAST = 128.0, 40.0
TOGETHER = 512  # points whose waves stay in the cache of a processor
TILE = 41  # side of the square of each patch in the photographs, px
REACH = TILE // 2


@dataclass(frozen=True)
class Texture:
    """A sum of cosine waves with random directions: band-limited, and known between the pixels."""

    k: FloatArray  # wave vectors, rad/px, (w, 2)
    phase: FloatArray  # rad, (w,)

    def value(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Intensity at (x, y)."""
        at = np.stack([x, y], axis=-1)
        points, total = at.reshape(-1, 2), np.empty(at.shape[:-1])
        for k in range(0, len(points), TOGETHER):
            waves = points[k : k + TOGETHER] @ self.k.T
            waves += self.phase
            total.reshape(-1)[k : k + TOGETHER] = np.cos(waves, out=waves).sum(axis=-1)
        return np.asarray(MEAN + CONTRAST * np.sqrt(2 / WAVES) * total)

    def gradient(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the intensity along x and y."""
        s = -CONTRAST * np.sqrt(2 / WAVES) * np.sin(self._argument(x, y))
        return s @ self.k[:, 0], s @ self.k[:, 1]

    def _argument(self, x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(np.stack([x, y], axis=-1) @ self.k.T + self.phase)


def random_texture(rng: np.random.Generator, grain_px: float) -> Texture:
    """A texture whose spectrum is that of noise under a Gaussian of `grain_px`, nothing above 2.4 rad/px."""
    k = rng.normal(size=(WAVES, 2)) / grain_px
    k *= np.minimum(1, 2.4 / np.linalg.norm(k, axis=1))[:, None]
    return Texture(k, rng.uniform(0, 2 * np.pi, WAVES))


@dataclass(frozen=True)
class Pairs:
    """Two photographs, tile by tile of textures warped from left to right, without noise."""

    left: FloatArray
    right: FloatArray
    centre: FloatArray  # of each tile, px, (k, 2)
    shift: FloatArray  # of the patch at the centre, from left to right, px, (k, 2)
    linear: FloatArray  # A of right = shift + A left, (k, 2, 2)
    gain: FloatArray  # right intensities per left one, (k,)
    bound: FloatArray  # Cramer-Rao bound of the shift for noise 1 in both photographs, px^2, (k, 2, 2)


def affine_pairs(
    seed: int,
    count: int,
    *,
    grain_px: float = 2.0,
    half: int = 10,
    distortion: float = 0.08,
    gains: bool = True,
) -> Pairs:
    """Return patches warped by random affinities and changed in brightness and contrast."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1].astype(float)
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    left, right, shift, linear, gain, bound = [], [], [], [], [], []
    for _ in range(count):
        texture = random_texture(rng, grain_px)
        A, d = np.eye(2) + rng.uniform(-distortion, distortion, (2, 2)), rng.uniform(-0.5, 0.5, 2)
        b, a = (rng.uniform(0.8, 1.2), rng.uniform(-15, 15)) if gains else (1.0, 0.0)
        back = np.linalg.inv(A)
        du, dv = u - d[0], v - d[1]
        left.append(texture.value(u, v))
        seen = texture.value(back[0, 0] * du + back[0, 1] * dv, back[1, 0] * du + back[1, 1] * dv)
        right.append(MEAN + b * (seen - MEAN) + a)
        gx, gy = texture.gradient(x, y)
        one = np.ones_like(x)
        J = np.stack([gx, gy, gx * x, gx * y, gy * x, gy * y, one, texture.value(x, y)]).reshape(8, -1)
        # the difference right - b left has the variance 1 + b^2 where each photograph has 1
        C = np.linalg.inv(J @ J.T)[:2, :2] * (1 + b * b) / (b * b)
        shift.append(d)
        linear.append(A)
        gain.append(b)
        bound.append(A @ C @ A.T)
    across = int(np.ceil(np.sqrt(count)))
    centre = np.array(
        [[REACH + TILE * (i % across), REACH + TILE * (i // across)] for i in range(count)], float
    )
    return Pairs(
        _tiled(left, across), _tiled(right, across), centre, np.array(shift), np.array(linear),
        np.array(gain), np.array(bound),
    )  # fmt: skip


def _tiled(tiles: list[FloatArray], across: int) -> FloatArray:
    rows = -(-len(tiles) // across)
    out = np.full((rows * TILE, across * TILE), MEAN)
    for i, tile in enumerate(tiles):
        r, c = divmod(i, across)
        out[r * TILE : (r + 1) * TILE, c * TILE : (c + 1) * TILE] = tile
    return out


def with_noise(photograph: FloatArray, sigma: float, seed: int) -> FloatArray:
    """Add white noise."""
    return np.asarray(photograph + np.random.default_rng(seed).normal(0, sigma, photograph.shape), np.float32)


def natural_texture(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """A photograph whose amplitudes fall with the frequency, as those of natural scenes do, (H, W)."""
    width, height = size_px
    f = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None, :])
    f[0, 0] = np.inf
    grey = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(height, width))) / f, (height, width))
    return np.asarray(MEAN + CONTRAST * (grey - grey.mean()) / grey.std())
