"""Networks with one planted fault each, with their truth: what a survey must find out about itself.

`planted(kind, number)` depends on its arguments only. Object unit m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sfm.model.camera import project
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from tests.synthetic import PIXEL_MM, SIZE_PX, make_network, seed_of

NOISE_PX = 0.1


@dataclass(frozen=True)
class Planted:
    """A network with a fault."""

    network: Network
    start: Estimate  # the truth without the fault, whose cameras say what is free
    states: tuple[FloatArray, ...]  # object points of each state of the object, (n, 3)
    cause: str  # kind of the remark that is right; empty where no alternative is
    exact: Network  # the same without noise
    unknowns: int  # of the fault, for who knows which it is


@dataclass
class _Scene:
    """What is changed before image points are projected: each photograph has a camera and an object."""

    rng: np.random.Generator
    network: Network
    truth: Estimate
    values: list[FloatArray]  # interior orientation of each photograph
    points: FloatArray  # object points in each photograph, (m, n, 3)
    names: FloatArray  # measured point of each image point, (k,)
    extra: FloatArray  # what comes on top of each image point, px, (k, 2)
    noise_px: float = NOISE_PX
    unknowns: int = 1  # of what is planted

    @property
    def m(self) -> int:
        return len(self.network.images)

    @property
    def n(self) -> int:
        return len(self.network.points)

    def change(self, photographs: object, name: str, *, factor: float = 1.0, by: float = 0.0) -> None:
        """Change an interior parameter in some photographs."""
        camera = self.truth.cameras[0]
        for i in np.atleast_1d(np.asarray(photographs)).tolist():
            s = camera.names.index(name)
            self.values[i][s] = self.values[i][s] * factor + by

    def measured(self, *, exact: bool = False) -> Network:
        """Return the network with its image points; exact ones are without noise."""
        seen, camera = self.network.image_points, self.truth.cameras[0]
        xy = np.empty_like(seen.xy)
        for i in range(self.m):
            rows = np.flatnonzero(seen.image == i)
            one = camera.with_parameters(self.values[i])
            X = self.points[i][self.names[rows].astype(int)]
            xy[rows] = project(one, self.truth.position[i], self.truth.rotation[i], X)
        xy += self.extra
        if not exact:
            xy += self.noise_px * self.rng.standard_normal(xy.shape)
        inside = np.isfinite(xy).all(axis=1) & (xy > -0.5).all(axis=1) & (xy < np.array(SIZE_PX) - 0.5).all(1)
        covariance = np.tile(self.noise_px**2 * np.eye(2), (len(xy), 1, 1))
        rows_ = ImagePoints(seen.image, seen.point, xy, covariance)
        return replace(self.network, image_points=rows_.select(inside))


FREES = (("c", "x0", "y0", "K1"), ("c", "x0", "y0", "K1", "K2"), ("c", "x0", "y0", "K1", "K2", "P1", "P2"))


def scene_of(kind: str, number: int) -> _Scene:
    """Return a random network without a fault."""
    rng = seed_of(f"planted {kind} {number}")
    network, truth = make_network(
        rng,
        images=int(rng.integers(8, 25)),
        points=int(rng.integers(25, 90)),
        planar=bool(rng.random() < 0.35),
        visibility=float(rng.uniform(0.6, 1.0)),
        noise_px=NOISE_PX,
        free=FREES[int(rng.integers(len(FREES)))],
    )
    seen = network.image_points
    return _Scene(
        rng,
        network,
        truth,
        [truth.cameras[0].parameters.copy() for _ in network.images],
        np.tile(truth.points, (len(network.images), 1, 1)),
        seen.point.astype(float),
        np.zeros_like(seen.xy),
    )


def _split(scene: _Scene) -> FloatArray:
    """Return the photographs from a random place in the sequence on."""
    return np.arange(int(scene.rng.integers(3, scene.m - 2)), scene.m)


def _group(scene: _Scene) -> FloatArray:
    """Return some photographs, three at least and fewer than half."""
    count = int(scene.rng.integers(3, max(4, scene.m // 2)))
    return np.sort(scene.rng.choice(scene.m, count, replace=False))


def _size(scene: _Scene, low: float, high: float) -> float:
    """Return a random size with a sign, evenly spread in its logarithm."""
    value = np.exp(scene.rng.uniform(np.log(low), np.log(high)))
    return float(value * scene.rng.choice([-1.0, 1.0]))


def _nothing(scene: _Scene) -> str:
    return ""


def _one_zoomed(scene: _Scene) -> str:
    scene.change(scene.rng.integers(scene.m), "c", factor=1 + _size(scene, 3e-3, 1e-1))
    return "other_camera"


def _group_zoomed(scene: _Scene) -> str:
    scene.change(_group(scene), "c", factor=1 + _size(scene, 2e-3, 3e-2))
    return "other_camera"


def _zoomed_from(scene: _Scene) -> str:
    scene.change(_split(scene), "c", factor=1 + _size(scene, 2e-3, 3e-2))
    return "other_camera"


def _second_body(scene: _Scene) -> str:
    group = _group(scene)
    scene.change(group, "c", factor=1 + _size(scene, 2e-3, 3e-2))
    scene.change(group, "x0", by=_size(scene, 3, 40) * PIXEL_MM[0])
    scene.change(group, "K1", factor=1 + _size(scene, 0.05, 0.5))
    return "other_camera"


def _alternating(scene: _Scene) -> str:
    scene.change(np.arange(1, scene.m, 2), "y0", by=_size(scene, 2, 30) * PIXEL_MM[0])
    return "other_camera"


def _centre_of_one(scene: _Scene) -> str:
    scene.change(scene.rng.integers(scene.m), "x0", by=_size(scene, 5, 60) * PIXEL_MM[0])
    return "other_camera"


def _drift(scene: _Scene) -> str:
    total = _size(scene, 3e-3, 5e-2)
    for i in range(scene.m):
        scene.change(i, "c", factor=1 + total * i / (scene.m - 1))
    return "camera_drift"


def _stabiliser(scene: _Scene) -> str:
    """A stabiliser that moves the principal point in every photograph."""
    size = abs(_size(scene, 1, 10)) * PIXEL_MM[0]
    scene.unknowns = 2 * scene.m
    for i in range(scene.m):
        for name in ("x0", "y0"):
            scene.change(i, name, by=size * scene.rng.standard_normal())
    return "camera_varies"


def _autofocus(scene: _Scene) -> str:
    size = abs(_size(scene, 1e-3, 1e-2))
    scene.unknowns = scene.m
    for i in range(scene.m):
        scene.change(i, "c", factor=1 + size * scene.rng.standard_normal())
    return "camera_varies"


def _strained(scene: _Scene, photographs: FloatArray, factor: FloatArray, shape: FloatArray) -> None:
    centre = scene.truth.points.mean(axis=0)
    for i, share in zip(photographs, factor, strict=True):
        scene.points[i] = centre + (scene.points[i] - centre) @ (np.eye(3) + share * shape)


def _growth(scene: _Scene) -> str:
    photographs, axis = _split(scene), int(scene.rng.integers(2))
    shape = np.zeros((3, 3))
    shape[axis, axis] = _size(scene, 5e-4, 5e-3)
    _strained(scene, photographs, np.ones(len(photographs)), shape)
    return "object_deformed"


def _sheared(scene: _Scene) -> str:
    photographs = _split(scene)
    shape = np.zeros((3, 3))
    shape[0, 1] = shape[1, 0] = _size(scene, 5e-4, 5e-3)
    _strained(scene, photographs, np.ones(len(photographs)), shape)
    return "object_deformed"


def _growing(scene: _Scene) -> str:
    shape = np.zeros((3, 3))
    shape[0, 0] = _size(scene, 2e-3, 2e-2)
    _strained(scene, np.arange(scene.m), np.arange(scene.m) / (scene.m - 1), shape)
    return "object_deformed"


def _bent(scene: _Scene) -> str:
    amount = _size(scene, 1e-3, 1e-2)
    for i in _split(scene):
        x, y = scene.points[i][:, 0].copy(), scene.points[i][:, 1].copy()
        scene.points[i][:, 2] += amount * (x**2 + 0.3 * x * y)
    return "object_deformed"


def _some_moved(scene: _Scene) -> str:
    count = max(2, round(0.1 * scene.n))
    moved = scene.rng.choice(scene.n, count, replace=False)
    by = scene.rng.standard_normal((count, 3)) * abs(_size(scene, 2e-4, 4e-3))
    scene.unknowns = by.size
    for i in _split(scene):
        scene.points[i][moved] += by
    return "points_moved"


def _one_moved(scene: _Scene) -> str:
    j = int(scene.rng.integers(scene.n))
    by = scene.rng.standard_normal(3) * abs(_size(scene, 5e-4, 2e-2))
    scene.unknowns = by.size
    for i in _split(scene):
        scene.points[i][j] += by
    return "points_moved"


def _half_moved(scene: _Scene) -> str:
    moved = scene.rng.choice(scene.n, scene.n // 3, replace=False)
    by = np.array([1.0, 0.5, 0.2]) * _size(scene, 3e-4, 3e-3)
    scene.unknowns = 3 * len(moved)
    for i in _split(scene):
        scene.points[i][moved] += by
    return "points_moved"


def _held(name: str, low: float, high: float, *, relative: bool = False) -> Callable[[_Scene], str]:
    def plant(scene: _Scene) -> str:
        size = _size(scene, low, high)
        scene.change(
            np.arange(scene.m), name, factor=1 + size if relative else 1.0, by=0 if relative else size
        )
        camera = scene.truth.cameras[0]
        free = camera.free.copy()
        free[camera.names.index(name)] = False
        scene.truth = replace(scene.truth, cameras=(replace(camera, free=free),))
        return "held_parameter"

    return plant


def _names_exchanged(scene: _Scene) -> str:
    """Exchange two names in fewer than half of the photographs of each point, or the others were wrong."""
    image, point = scene.network.image_points.image, scene.network.image_points.point
    sees = np.zeros((scene.m, scene.n), dtype=bool)
    sees[image, point] = True
    rays = sees.sum(axis=0)
    p, q = scene.rng.choice(np.flatnonzero(rays >= np.sort(rays)[-max(2, scene.n // 2)]), 2, replace=False)
    both = np.flatnonzero(sees[:, p] & sees[:, q])
    most = (min(rays[p], rays[q]) - 1) // 2
    photographs = scene.rng.choice(both, min(max(2, scene.m // 4), most, len(both)), replace=False)
    on = np.isin(image, photographs)
    scene.names[on & (point == p)], scene.names[on & (point == q)] = q, p
    return "names_exchanged"


def _second_place(scene: _Scene) -> str:
    j = int(scene.rng.integers(scene.n))
    elsewhere = scene.truth.points[j] + 0.2 * scene.rng.standard_normal(3)
    for i in scene.rng.choice(scene.m, max(3, scene.m // 4), replace=False):
        scene.points[i][j] = elsewhere
    return "two_places"


def _names_shifted(scene: _Scene) -> str:
    """The list of one photograph slipped by a row: each image point has the name of the next."""
    image = scene.network.image_points.image
    rows = np.flatnonzero(image == scene.rng.integers(scene.m))
    scene.names[rows] = np.roll(scene.names[rows], 1)
    return ""


def _gross(share: float, size_px: float) -> Callable[[_Scene], str]:
    """Return what displaces a share of the image points, which is no fault of the survey."""

    def plant(scene: _Scene) -> str:
        k = len(scene.extra)
        rows = scene.rng.choice(k, max(1, round(share * k)), replace=False)
        angle = scene.rng.uniform(0, 2 * np.pi, len(rows))
        scene.extra[rows] = size_px * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return ""

    return plant


def _exchanged(share: float) -> Callable[[_Scene], str]:
    """Return what exchanges the names of image points within photographs here and there."""

    def plant(scene: _Scene) -> str:
        image = scene.network.image_points.image
        for _ in range(max(1, round(share * len(image) / 2))):
            i = int(scene.rng.integers(scene.m))
            one, other = scene.rng.choice(np.flatnonzero(image == i), 2, replace=False)
            scene.names[[one, other]] = scene.names[[other, one]]
        return ""

    return plant


def _correlated(size_px: float) -> Callable[[_Scene], str]:
    """Return what displaces image points smoothly, another field in each photograph."""

    def plant(scene: _Scene) -> str:
        seen = scene.network.image_points
        for i in range(scene.m):
            rows = seen.image == i
            xy = seen.xy[rows] / 300.0
            for axis in range(2):
                wave = scene.rng.standard_normal((6, 2)), scene.rng.uniform(0, 2 * np.pi, 6)
                field = np.cos(xy @ wave[0].T + wave[1]).sum(axis=1) / np.sqrt(3)
                scene.extra[rows, axis] = size_px * field
        return ""

    return plant


def _rolling(scene: _Scene) -> str:
    """Rolling shutter with a hand that shakes: each photograph sheared as by a camera of its own."""
    seen = scene.network.image_points
    for i in range(scene.m):
        rows = seen.image == i
        speed = 0.3 * scene.rng.standard_normal(2) / SIZE_PX[1]
        scene.extra[rows] += (seen.xy[rows, 1:] - SIZE_PX[1] / 2) * speed
    return "rolling_shutter"


def _heavy(scene: _Scene) -> str:
    """Errors with long tails."""
    scene.extra[:] = NOISE_PX * scene.rng.standard_t(3, scene.extra.shape)
    return ""


def _noisy_photographs(scene: _Scene) -> str:
    seen = scene.network.image_points
    on = np.isin(seen.image, scene.rng.choice(scene.m, 3, replace=False))
    scene.extra[on] = 4 * NOISE_PX * scene.rng.standard_normal((int(on.sum()), 2))
    return ""


def _eccentric(scene: _Scene) -> str:
    """Eccentricity of large targets: away from the centre of the photograph, by the angle of sight."""
    seen = scene.network.image_points
    centre = np.array(SIZE_PX) / 2
    scene.extra[:] = (
        0.15 * (seen.xy - centre) / centre * scene.rng.uniform(0.5, 1.0, (scene.n, 1))[seen.point]
    )
    return ""


def _vibration(scene: _Scene) -> str:
    """A point that swings: elsewhere in every photograph."""
    j = int(scene.rng.integers(scene.n))
    for i in range(scene.m):
        scene.points[i][j] += 3e-4 * scene.rng.standard_normal(3)
    return ""


def _breathing(scene: _Scene) -> str:
    """The object swings as a whole, by another bending in every photograph."""
    for i in range(scene.m):
        amount = 2e-4 * scene.rng.standard_normal()
        scene.points[i][:, 2] += amount * scene.points[i][:, 0] ** 2
    return ""


def _tilted_pixels(scene: _Scene) -> str:
    """A pattern of the sensor, with a period of 200 px."""
    seen = scene.network.image_points
    scene.extra[:, 0] = 0.08 * np.sin(2 * np.pi * seen.xy[:, 0] / 200)
    return ""


FAULTS: dict[str, Callable[[_Scene], str]] = {
    "one zoomed": _one_zoomed,
    "group zoomed": _group_zoomed,
    "zoomed from": _zoomed_from,
    "second body": _second_body,
    "alternating": _alternating,
    "centre of one": _centre_of_one,
    "drift": _drift,
    "stabiliser": _stabiliser,
    "autofocus": _autofocus,
    "growth": _growth,
    "sheared": _sheared,
    "growing": _growing,
    "bent": _bent,
    "some moved": _some_moved,
    "one moved": _one_moved,
    "third moved": _half_moved,
    "held c": _held("c", 3e-3, 5e-2, relative=True),
    "held K1": _held("K1", 1e-4, 3e-3),
    "held x0": _held("x0", 2e-2, 0.3),
    "held b1": _held("b1", 5e-4, 5e-2),
    "names exchanged": _names_exchanged,
    "second place": _second_place,
}
RIGHT: dict[str, Callable[[_Scene], str]] = {
    "nothing": _nothing,
    "names 0.3 %": _exchanged(0.003),
    "names 3 %": _exchanged(0.03),
    "50 px in 0.3 %": _gross(0.003, 50.0),
    "50 px in 1 %": _gross(0.01, 50.0),
    "50 px in 5 %": _gross(0.05, 50.0),
    "50 px in 10 %": _gross(0.10, 50.0),
    "5 px in 5 %": _gross(0.05, 5.0),
}
ROWLESS: dict[str, Callable[[_Scene], str]] = {
    "correlated 0.05 px": _correlated(0.05),
    "correlated 0.1 px": _correlated(0.1),
    "rolling shutter": _rolling,
    "long tails": _heavy,
    "noisy photographs": _noisy_photographs,
    "eccentric": _eccentric,
    "vibration": _vibration,
    "breathing": _breathing,
    "pattern": _tilted_pixels,
    "correlated 0.02 px": _correlated(0.02),
    "names shifted": _names_shifted,
}
EVERY = FAULTS | RIGHT | ROWLESS


def planted(kind: str, number: int) -> Planted:
    """Return the network of a kind and a number."""
    scene = scene_of(kind, number)
    cause = EVERY[kind](scene)
    states = tuple(np.unique(scene.points, axis=0))
    exact = scene.measured(exact=True)
    return Planted(scene.measured(), scene.truth, states, cause, exact, scene.unknowns)
