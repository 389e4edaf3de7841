"""Synthetic networks with known truth, seeded by the caller; object unit m.

`make_network` builds a convergent network around an object of radius 1 m, `perturb` spoils its truth
as start values would be, `seed_of` turns a test's name into a seed.
"""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.model.camera import Camera, camera_from_values, project
from sfm.model.conventions import BoolArray, FloatArray, rotation_from_vector
from sfm.model.distortion.models import COLMAP, MODELS, SPLINED, Role
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.solution import Solution

SIZE_PX = (2000, 1500)
PIXEL_MM = (0.005, 0.005)
C_MM = 10.0
DISTORTION = {
    "brown": (
        ("x0", 0.03),
        ("y0", -0.02),
        ("K1", 8e-4),
        ("K2", -4e-6),
        ("P1", 3e-5),
        ("P2", -2e-5),
        ("b1", 2e-4),
    ),
    "brown_forward": (("x0", 0.03), ("y0", -0.02), ("K1", -8e-4), ("K2", 4e-6), ("P1", 3e-5), ("P2", -2e-5)),
    "opencv": (("k1", -0.08), ("k2", 0.04), ("p1", 3e-4), ("p2", -2e-4), ("cx", 1005.0), ("cy", 745.0)),
    "full_opencv": (("k1", -0.08), ("k2", 0.04), ("p1", 3e-4), ("p2", -2e-4), ("k4", 0.01), ("cx", 1005.0)),
}  # a lens with up to 40 px of distortion in the corners
DISTORTION["brown_forward_affine"] = (*DISTORTION["brown_forward"], ("b1", 2e-4), ("b2", -1e-4))
for _corrections in ("brown_affine", "brown_dbat", "brown_affine_dbat"):
    DISTORTION[_corrections] = DISTORTION["brown"]
_MILD = (("k1", -0.08), ("k2", 0.04), ("cx", 1005.0), ("cy", 745.0))
DISTORTION |= {
    "simple_pinhole": (("cx", 1005.0),),
    "pinhole": (("cx", 1005.0),),
    "simple_radial": (("k", -0.08), ("cx", 1005.0)),
    "radial": _MILD,
    "simple_fisheye": (("cx", 1005.0),),
    "fisheye": (("cx", 1005.0),),
    "simple_radial_fisheye": (("k", -0.08), ("cx", 1005.0)),
    "radial_fisheye": _MILD,
    "opencv_fisheye": (*_MILD, ("k3", 0.006), ("k4", -0.001)),
    "fov": (("omega", 0.9), ("cx", 1005.0)),
    "simple_division": (("k", -0.2), ("cx", 1005.0)),
    "division": (("k", -0.2), ("cx", 1005.0)),
    "eucm": (("alpha", 0.6), ("beta", 1.1), ("cx", 1005.0)),
    "thin_prism_fisheye": (
        *(*_MILD, ("p1", 3e-4), ("p2", -2e-4), ("k3", 0.006), ("k4", -0.001)),
        *(("sx1", 1e-3), ("sy1", -5e-4)),
    ),
    "rad_tan_thin_prism_fisheye": (
        *(
            ("k0", -0.08),
            ("k1", 0.04),
            ("k2", 6e-3),
            ("k3", -1e-3),
            ("k4", 1e-4),
            ("k5", 1e-5),
            ("cx", 1005.0),
        ),
        *(("p0", 3e-4), ("p1", -2e-4), ("s0", 1e-3), ("s1", 2e-3), ("s2", -5e-4), ("s3", 1e-3)),
    ),
}
for splined in SPLINED:
    surface = splined.names_of(Role.SURFACE)
    steep = 30.0 * len(surface) ** -1.5  # third derivatives of the same size on every grid
    DISTORTION[splined.name] = (
        *(("cx", 1005.0), ("a_max", 0.55), ("b_max", 0.4)),
        *((name, 0.1 * steep * (7 * k % 11 - 5)) for k, name in enumerate(surface)),
    )
FREE = {
    "brown": ("c", "x0", "y0", "K1", "K2", "P1", "P2"),
    "brown_forward": ("c", "x0", "y0", "K1", "K2", "P1", "P2"),
    "opencv": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "full_opencv": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
FREE["brown_dbat"] = FREE["brown"]
FREE["brown_forward_affine"] = (*FREE["brown_forward"], "b1", "b2")
FREE["brown_affine"] = FREE["brown_affine_dbat"] = (*FREE["brown"], "b1")
FREE |= {model.name: model.names for model in COLMAP}
FREE |= {splined.name: ("fx", "fy", "cx", "cy") for splined in SPLINED}


def seed_of(name: str) -> np.random.Generator:
    """Return a random generator that depends on the name only."""
    return np.random.default_rng(zlib.crc32(name.encode()))


def make_network(
    rng: np.random.Generator,
    *,
    images: int = 12,
    points: int = 60,
    planar: bool = False,
    visibility: float = 1.0,
    noise_px: float = 0.1,
    model: str = "brown",
    cameras: int = 1,
    free: tuple[str, ...] | None = None,
    figure: FloatArray | None = None,
) -> tuple[Network, Estimate]:
    """Return a convergent network with noisy image points, and its truth.

    Args:
        rng: source of all randomness.
        images, points: how many photographs and object points.
        planar: all points in the plane Z = 0, photographed from above; else in a ball, from all round.
        visibility: part of the points measured in each photograph (at least 3 rays and 8 points stay).
        noise_px: standard deviation of an image coordinate, also its a priori sigma (0.1 px if 0), px.
        model: distortion model of all cameras.
        cameras: number of cameras, taking turns.
        free: parameters to adjust; FREE[model] if not given, () for calibrated cameras.
        figure: the first object points, (n, 3).
    """
    free = FREE[model] if free is None else free
    made = tuple(_camera(f"camera {a + 1}", model, free, scale=1 + 0.02 * a) for a in range(cameras))
    xyz = rng.uniform(-0.7, 0.7, (points, 3)) * np.array([1, 1, 0 if planar else 1])
    if figure is not None:
        xyz[: len(figure)] = figure
    position, rotation = _stations(rng, images, planar=planar)
    truth = Estimate(made, position, rotation, xyz)
    camera = np.arange(images, dtype=np.int64) % cameras

    seen = _visible(rng, images, points, visibility)
    rows = []
    for i in range(images):
        xy = project(made[camera[i]], position[i], rotation[i], xyz)
        inside = np.isfinite(xy).all(1) & (xy > 0).all(1) & (xy < np.array(SIZE_PX) - 1).all(1)
        j = np.flatnonzero(seen[i] & inside)
        rows.append((np.full(len(j), i), j, xy[j]))
    image = np.concatenate([row[0] for row in rows])
    point = np.concatenate([row[1] for row in rows])
    xy = np.concatenate([row[2] for row in rows])
    sigma = noise_px if noise_px > 0 else 0.1
    network = Network(
        images=tuple(f"image {i + 1}" for i in range(images)),
        camera=camera,
        points=tuple(str(j + 1) for j in range(points)),
        image_points=ImagePoints(
            image,
            point,
            xy + noise_px * rng.standard_normal(xy.shape),
            np.tile(sigma**2 * np.eye(2), (len(xy), 1, 1)),
        ),
    )
    return network, truth


def perturb(
    estimate: Estimate,
    rng: np.random.Generator,
    *,
    position: float = 0.01,
    angle_deg: float = 1.0,
    points: float = 0.01,
    c: float = 0.0,
    distortion: bool = True,
) -> Estimate:
    """Return the estimate spoiled as start values would be.

    Args:
        estimate: the truth.
        rng: source of randomness.
        position, points: length of the errors over the distance of the camera from the centre.
        angle_deg: angle of the errors of rotation, deg.
        c: relative error of the principal distance (all cameras alike).
        distortion: whether the distortion and principal point are kept (else start at 0 and the centre).
    """
    distance = np.linalg.norm(estimate.position, axis=1, keepdims=True)
    m, n = len(estimate.position), len(estimate.points)
    spin = rotation_from_vector(np.radians(angle_deg) * _directions(rng, m))
    return replace(
        estimate,
        cameras=tuple(_spoiled(camera, 1 + c, distortion) for camera in estimate.cameras),
        position=estimate.position + position * distance * _directions(rng, m),
        rotation=estimate.rotation @ spin,
        points=estimate.points + points * distance.mean() * _directions(rng, n),
    )


def observed_anew(network: Network, truth: Estimate, noise_px: float, rng: np.random.Generator) -> Network:
    """Return a network with its image points where a scene has them, and normal noise, px."""
    seen = network.image_points
    xy = np.array(seen.xy)
    for i in range(len(network.images)):
        rows = seen.image == i
        camera = truth.cameras[network.camera[i]]
        xy[rows] = project(camera, truth.position[i], truth.rotation[i], truth.points[seen.point[rows]])
    return replace(network, image_points=replace(seen, xy=xy + noise_px * rng.standard_normal(xy.shape)))


def stored_of(name: str, a: Adjustment) -> Solution:
    """Return an adjustment in metres as a result, with the covariance of all points together."""
    return replace(a.solution, name=name, unit="m").with_joint_covariance


def _camera(name: str, model: str, free: tuple[str, ...], *, scale: float) -> Camera:
    return camera_from_values(
        name, model, SIZE_PX, PIXEL_MM, c_mm=C_MM * scale, free=free, values=DISTORTION[model]
    )


def _stations(rng: np.random.Generator, images: int, *, planar: bool) -> tuple[FloatArray, FloatArray]:
    """Stations on a dome (planar) or sphere about the origin, looking at it, rolled by turns of 90 deg."""
    position = np.empty((images, 3))
    rotation = np.empty((images, 3, 3))
    for i in range(images):
        azimuth = 2 * np.pi * (i + rng.uniform(-0.3, 0.3)) / images
        low, high = (0.6, 1.35) if planar else (-1.1, 1.1)
        elevation = rng.uniform(low, high)
        direction = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        position[i] = rng.uniform(3.6, 4.4) * direction
        aim = 0.1 * rng.uniform(-1, 1, 3) * (1, 1, 0) - position[i]
        z = -aim / np.linalg.norm(aim)  # the camera looks along -z
        x = np.cross([0.0, 0.0, 1.0], z)
        x /= np.linalg.norm(x)
        roll = rotation_from_vector(np.array([0, 0, np.pi / 2 * (i % 4) + rng.uniform(-0.2, 0.2)]))
        rotation[i] = np.stack([x, np.cross(z, x), z], axis=1) @ roll
    return position, rotation


def _visible(rng: np.random.Generator, images: int, points: int, visibility: float) -> BoolArray:
    seen: BoolArray = rng.random((images, points)) < visibility
    for i in range(images):
        seen[i, rng.permutation(points)[: max(0, min(8, points) - seen[i].sum())]] = True
    for j in range(points):
        missing = min(3, images) - int(seen[:, j].sum())
        if missing > 0:
            seen[rng.permutation(np.flatnonzero(~seen[:, j]))[:missing], j] = True
    return seen


def _directions(rng: np.random.Generator, count: int) -> FloatArray:
    v = rng.standard_normal((count, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def _spoiled(camera: Camera, scale: float, distortion: bool) -> Camera:
    p = camera.parameters.copy()
    lengths = int(camera.parts[0].sum())
    p[:lengths] *= scale
    if not distortion:
        fresh = camera_from_values(
            camera.name, camera.model, camera.size_px, (camera.pixel_mm[0], camera.pixel_mm[1]), c_mm=1.0
        )
        loose = np.array([k >= lengths for k in range(len(MODELS[camera.model].names))]) & camera.free
        p[loose] = fresh.parameters[loose]
    return camera.with_parameters(p)


def add_narrow_points(
    network: Network, truth: Estimate, rng: np.random.Generator, count: int, *, noise_px: float = 0.1
) -> tuple[Network, Estimate]:
    """Return a network with a photograph beside its first one, and points that only these two see.

    The two stand 0.05 m apart at 4 m, so that the rays of those points, w1, w2 ..., meet at 0.7 degrees.
    """
    camera, m, n = truth.cameras[0], len(network.images), len(network.points)
    position = np.vstack([truth.position, truth.position[0] + 0.05 * truth.rotation[0][:, 0]])
    rotation = np.concatenate([truth.rotation, truth.rotation[:1]])
    far = rng.uniform(-0.6, 0.6, (count, 3))
    all_points = np.vstack([truth.points, far])
    seen = network.image_points
    image, point, xy = [seen.image], [seen.point], [seen.xy]
    for i, own in ((m, np.arange(n)), (0, n + np.arange(count)), (m, n + np.arange(count))):
        found = project(camera, position[i], rotation[i], all_points[own])
        inside = np.isfinite(found).all(1) & (found > 0).all(1) & (found < np.array(SIZE_PX) - 1).all(1)
        image.append(np.full(int(inside.sum()), i))
        point.append(own[inside])
        xy.append(found[inside] + noise_px * rng.standard_normal((int(inside.sum()), 2)))
    measured = np.concatenate(xy)
    network = Network(
        (*network.images, "beside"),
        np.append(network.camera, network.camera[0]),
        (*network.points, *(f"w{k + 1}" for k in range(count))),
        ImagePoints(
            np.concatenate(image),
            np.concatenate(point),
            measured,
            np.tile(noise_px**2 * np.eye(2), (len(measured), 1, 1)),
        ),
    )
    return network, Estimate(truth.cameras, position, rotation, all_points)
