"""Random networks like those of close-range surveys, with truth and start values.

One generator draws everything: arrangement of the photographs, object, visibility, noise, lens, free
parameters and datum. The object has a radius of 1 object unit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.model.camera import Camera, camera_from_values, project
from sfm.model.conventions import BoolArray, FloatArray, rotation_from_vector
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network, ObjectPoints

MODELS = ("opencv", "full_opencv")  # models that COLMAP also has
ARRANGEMENTS = ("ring", "hemisphere", "strip", "close pairs")
IMAGES = (4, 60)
POINTS = (20, 2000)
VISIBILITY = (0.3, 1.0)
NOISE_PX = (0.02, 1.0)
SIZE_PX = (3000, 2000)
PIXEL_MM = (0.006, 0.006)
C_MM = 18.0  # a field of 53 x 37 deg
DISTANCE = 4.5  # of the cameras from the object, which then fills the photograph
MIN_RAYS = 3  # photographs that show every point; two for networks of pairs
MIN_POINTS = 12  # points that every photograph shows
STRIP_POINTS = 12  # least number of points per photograph of a strip, since each photograph shows few of them
CONTROL_POINTS = 6
SELF_CALIBRATING = ("ring", "hemisphere")  # convergent and rolled: they determine the interior orientation
SELF_CALIBRATION_IMAGES = 8  # photographs of each camera that are needed to free it
START_POSITION = 0.01  # error of start values of projection centres and points, over the distance
START_ANGLE_DEG = 1.0
# Few rays connect a strip: inconsistent errors of neighbours bend it as a whole, and from distant start
# values every adjuster ends beside the optimum. In practice its start values come from relative orientation.
STRIP_START = 0.2
START_FOCAL = 0.02  # relative error of free focal lengths at the start


@dataclass(frozen=True)
class Plan:
    """Random choices of one network."""

    arrangement: str  # ring | hemisphere | strip | close pairs
    images: int  # photographs
    points: int  # requested object points; those with too few rays are left out
    planar: bool  # whether the object is flat
    visibility: float  # share of the points that a photograph shows
    noise_px: float  # standard deviation of an image coordinate, px
    model: str  # opencv | full_opencv
    cameras: int  # number of cameras, which alternate
    interior: str  # fixed | focal and principal point | all
    datum: str  # free | control


@dataclass(frozen=True)
class RandomNetwork:
    """A network with its truth, and the start values for adjusters."""

    plan: Plan
    network: Network
    truth: Estimate
    start: Estimate


def random_network(rng: np.random.Generator) -> RandomNetwork:
    """Return a random network of 4-60 photographs and 20-2000 points.

    Interior orientation is free only in arrangements that determine it. The distortion of `full_opencv` is
    never free: no network separates its numerator and denominator, which are both smooth.

    Args:
        rng: source of all randomness.
    """
    plan = _draw(rng)
    cameras = tuple(_camera(rng, plan, a) for a in range(plan.cameras))
    xyz = _object(rng, plan)
    position, rotation = _stations(rng, plan)
    camera = np.arange(plan.images, dtype=np.int64) % plan.cameras
    truth = Estimate(cameras, position, rotation, xyz)
    seen = _visible(rng, plan, truth, camera)
    kept = np.flatnonzero(seen.sum(axis=0) >= _min_rays(plan))
    truth = replace(truth, points=xyz[kept])
    image, point = np.nonzero(seen[:, kept])
    xy = np.empty((len(image), 2))
    for i in range(plan.images):
        rows = image == i
        xy[rows] = project(cameras[camera[i]], position[i], rotation[i], truth.points[point[rows]])
    xy += plan.noise_px * rng.standard_normal(xy.shape)
    control = ObjectPoints()
    if plan.datum == "control":
        chosen = np.sort(_spread(truth.points, CONTROL_POINTS))
        control = ObjectPoints(chosen, truth.points[chosen], np.zeros((len(chosen), 3, 3)))
    network = Network(
        tuple(f"{i + 1}" for i in range(plan.images)),
        camera,
        tuple(f"{j + 1}" for j in kept),
        ImagePoints(
            image.astype(np.int64),
            point.astype(np.int64),
            xy,
            np.tile(plan.noise_px**2 * np.eye(2), (len(xy), 1, 1)),
        ),
        observations=(control,),
    )
    error = STRIP_START if plan.arrangement == "strip" else 1.0
    return RandomNetwork(plan, network, truth, _start(rng, truth, control, error))


def _draw(rng: np.random.Generator) -> Plan:
    arrangement = str(rng.choice(ARRANGEMENTS))
    images = _log_uniform(rng, *IMAGES)
    if arrangement == "close pairs":
        images += images % 2
    cameras = int(rng.choice([1, 1, 2, 3]))
    model = str(rng.choice(MODELS))
    may_calibrate = arrangement in SELF_CALIBRATING and images >= SELF_CALIBRATION_IMAGES * cameras
    interior = "fixed"
    if may_calibrate and rng.random() < 0.7:
        interior = "all" if model == "opencv" else "focal and principal point"
    points = _log_uniform(rng, *POINTS)
    if arrangement == "strip":
        points = max(points, STRIP_POINTS * images)
    return Plan(
        arrangement,
        images,
        points,
        bool(rng.random() < 0.4),
        float(rng.uniform(*VISIBILITY)),
        float(np.exp(rng.uniform(*np.log(NOISE_PX)))),
        model,
        cameras if images >= 2 * cameras else 1,
        interior,
        str(rng.choice(["free", "free", "control"])),
    )


def _log_uniform(rng: np.random.Generator, low: int, high: int) -> int:
    return round(float(np.exp(rng.uniform(np.log(low), np.log(high)))))


def _camera(rng: np.random.Generator, plan: Plan, number: int) -> Camera:
    """Return a lens with up to about 50 px of distortion in the corners."""
    values = [
        ("cx", (SIZE_PX[0] - 1) / 2 + rng.uniform(-20, 20)),
        ("cy", (SIZE_PX[1] - 1) / 2 + rng.uniform(-20, 20)),
        ("k1", rng.uniform(-0.12, 0.08)),
        ("k2", rng.uniform(-0.05, 0.05)),
        ("p1", rng.uniform(-4e-4, 4e-4)),
        ("p2", rng.uniform(-4e-4, 4e-4)),
    ]
    if plan.model == "full_opencv":
        values += [(name, rng.uniform(-0.03, 0.03)) for name in ("k3", "k4", "k5", "k6")]
    free = {
        "fixed": (),
        "focal and principal point": ("fx", "fy", "cx", "cy"),
        "all": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    }[plan.interior]
    c_mm = C_MM * (1 + rng.uniform(-0.05, 0.05))
    return camera_from_values(
        f"camera {number + 1}", plan.model, SIZE_PX, PIXEL_MM, c_mm=c_mm, free=free, values=tuple(values)
    )


def _object(rng: np.random.Generator, plan: Plan) -> FloatArray:
    """Return points in a disc or a ball; those of a strip are in a rectangle or box along the strip."""
    if plan.arrangement == "strip":
        length = 0.7 * (plan.images - 1) + 1.6  # covered by the photographs
        xyz = rng.uniform(-1, 1, (plan.points, 3)) * [length / 2, 1.0, 0.3]
    else:
        xyz = rng.standard_normal((plan.points, 3))
        radius = rng.random(plan.points) ** (1 / 3)
        xyz *= (radius / np.linalg.norm(xyz, axis=1))[:, None]
    return xyz * [1, 1, 0 if plan.planar else 1]


def _stations(rng: np.random.Generator, plan: Plan) -> tuple[FloatArray, FloatArray]:
    """Return projection centres and rotations; the cameras look at the object or, in strips, down."""
    m = plan.images
    azimuth = 2 * np.pi * (np.arange(m) + rng.uniform(-0.3, 0.3, m)) / m
    distance = DISTANCE * rng.uniform(0.9, 1.2, m)
    lowest = 35.0 if plan.planar else 5.0
    roll = np.pi / 2 * rng.integers(0, 4, m) + rng.uniform(-0.2, 0.2, m)
    aim = 0.1 * rng.uniform(-1, 1, (m, 3)) * [1, 1, 0]
    if plan.arrangement == "strip":
        x = 0.7 * (np.arange(m) - (m - 1) / 2)
        position = np.stack([x, np.zeros(m), np.full(m, DISTANCE)], axis=1)
        position += 0.05 * rng.standard_normal((m, 3))
        aim = position * [1, 1, 0] + 0.2 * rng.standard_normal((m, 3)) * [1, 1, 0]
        roll = rng.uniform(-0.1, 0.1, m) + np.pi * (np.arange(m) % 2)
        return position, _rotations_towards(position, aim, roll)
    if plan.arrangement == "ring":
        elevation = np.deg2rad(np.full(m, rng.uniform(max(lowest, 30.0), 60.0)) + rng.uniform(-5, 5, m))
    elif plan.arrangement == "hemisphere":
        elevation = np.arcsin(rng.uniform(np.sin(np.deg2rad(lowest)), 1.0, m))
    else:  # pairs with a base of a tenth of the distance
        azimuth = np.repeat(azimuth[: m // 2] * 2, 2) + np.tile([-0.05, 0.05], m // 2)
        elevation = np.repeat(np.deg2rad(rng.uniform(40, 65, m // 2)), 2)
        distance = np.repeat(distance[: m // 2], 2)
        roll = np.repeat(roll[: m // 2], 2)
        aim = np.repeat(aim[: m // 2], 2, axis=0)
    direction = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    position = distance[:, None] * direction
    return position, _rotations_towards(position, aim, roll)


def _rotations_towards(position: FloatArray, aim: FloatArray, roll: FloatArray) -> FloatArray:
    """Return rotations whose -z axis points from position to aim, turned about it by the roll."""
    z = position - aim
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    # For a vertical axis, x is along X, since the cross product with Z would vanish.
    x = np.where(np.abs(z[:, 2:]) > 0.999, [[1.0, 0.0, 0.0]], np.cross([0.0, 0.0, 1.0], z))
    x -= (x * z).sum(axis=1, keepdims=True) * z
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R = np.stack([x, np.cross(z, x), z], axis=2)
    return R @ rotation_from_vector(np.stack([np.zeros_like(roll), np.zeros_like(roll), roll], axis=1))


def _min_rays(plan: Plan) -> int:
    return 2 if plan.images < 6 or plan.arrangement == "close pairs" else MIN_RAYS


def _visible(rng: np.random.Generator, plan: Plan, truth: Estimate, camera: np.ndarray) -> BoolArray:
    """Return which photograph shows which point, (m, n): inside its borders, and drawn or needed."""
    inside = np.empty((plan.images, len(truth.points)), dtype=bool)
    for i in range(plan.images):
        xy = project(truth.cameras[camera[i]], truth.position[i], truth.rotation[i], truth.points)
        inside[i] = ((xy > 0) & (xy < np.array(SIZE_PX) - 1)).all(axis=1)
    order = np.where(inside, rng.random(inside.shape), 2.0)
    seen = order < plan.visibility
    # Each photograph and each point gets enough rays, so that none is undetermined.
    nearest = np.argsort(order, axis=1)[:, :MIN_POINTS]
    np.put_along_axis(seen, nearest, True, axis=1)
    nearest = np.argsort(order, axis=0)[: _min_rays(plan)]
    np.put_along_axis(seen, nearest, True, axis=0)
    return seen & inside


def _spread(points: FloatArray, count: int) -> np.ndarray:
    """Return indices of points far from one another: each is the farthest from those chosen before."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    while len(chosen) < min(count, len(points)):
        gap = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(gap)))
    return np.array(chosen, dtype=np.int64)


def _start(rng: np.random.Generator, truth: Estimate, control: ObjectPoints, error: float) -> Estimate:
    """Return start values: unknowns with errors, free distortion 0."""
    m, n = len(truth.position), len(truth.points)
    points = truth.points + error * START_POSITION * rng.standard_normal((n, 3))
    points[control.point] = control.xyz
    cameras = []
    for camera in truth.cameras:
        p = camera.parameters.copy()
        p[:2] *= np.where(camera.free[:2], 1 + START_FOCAL * rng.uniform(-1, 1), 1.0)
        centre = (np.array(SIZE_PX) - 1) / 2
        p[2:4] = np.where(camera.free[2:4], centre, p[2:4])
        p[4:] = np.where(camera.free[4:], 0.0, p[4:])
        cameras.append(camera.with_parameters(p))
    spin = error * np.deg2rad(START_ANGLE_DEG) * rng.standard_normal((m, 3)) / np.sqrt(3)
    return Estimate(
        tuple(cameras),
        truth.position + error * START_POSITION * DISTANCE * rng.standard_normal((m, 3)) / np.sqrt(3),
        truth.rotation @ rotation_from_vector(spin),
        points,
    )
