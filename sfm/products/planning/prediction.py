"""Prediction of a planned network: its covariance, requirements on it, and simulated observations.

Fraser's rule for the precision of points is

    sigma = q S sigma_image / sqrt(k)

with the mean scale number S, k photographs from each station, and the factor q, which describes the strength
of the network.

Requirements on a network are a standard deviation of points or lengths, or a detectable displacement. A
displacement between two such surveys is detectable in its worst direction if its length, over the standard
deviation of the difference, reaches the noncentrality of the test of three coordinates.

Source: Fraser (1984), "Network design considerations for non-topographic photogrammetry", Photogramm. Eng.
Remote Sens. 50(8); Luhmann et al., Close-Range Photogrammetry (2020), sec. 7.3; Baarda (1968), sec. 4 (power
of a test); Niemeier (2008), Ausgleichungsrechnung, ch. 9.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from sfm.adjustment.covariance import marginal_of
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import predict
from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera, project
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.distributions import LEVEL, POWER
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate, values_of
from sfm.model.network import ImagePoints, Network, ScaleBars, index_of, rows_of
from sfm.model.observations.kind import Group
from sfm.model.similarity import similarity_motions
from sfm.orientation.image_rays import ray_angles
from sfm.products.epochs.displacements import detectable_shift
from sfm.products.planning.planned_object import PlannedObject
from sfm.products.planning.stations import Stations
from sfm.products.planning.visibility import Seeing, Sight, sight_of

MIN_RAYS = 3  # of a point: with two rays a gross error cannot be located
MIN_POINTS = 4  # points that a photograph must show to be oriented
MAX_OFF_SIGMAS = 5.0  # largest misfit of planned points to their observations, such as a line, in sigmas
MAX_JOINT = 1000  # points with a joint covariance; if there are more, evenly spread ones are used


@dataclass(frozen=True)
class ScaleBarPlan:
    """A scale bar between two points of the object."""

    start: str
    end: str
    sigma: float  # of its length, object unit


@dataclass(frozen=True)
class Prediction:
    """Prediction for photographs of an object from stations."""

    planned: PlannedObject
    stations: Stations
    sight: Sight
    adjustment: Adjustment  # of the points in two or more usable photographs, for sigma0 = 1
    point: IntArray  # index of each point of the object in this network, -1 = not in it, (n,)
    photograph: IntArray  # index of each photograph in this network, -1 = not in it, (m,)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The camera, or the cameras of a rig."""
        return self.adjustment.estimate.cameras

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of each point, object unit^2; infinite variances if undetermined, (n, 3, 3)."""
        out = np.tile(np.diag(np.full(3, np.inf)), (len(self.point), 1, 1))
        of_point = self.adjustment.covariance.points[self.point]
        known = (self.point >= 0) & (np.trace(of_point, axis1=1, axis2=2) > 0)
        out[known] = of_point[known]
        return out

    @cached_property
    def sigma(self) -> FloatArray:
        """RMS sigma of the three coordinates of each point, object unit; infinite if undetermined, (n,)."""
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 3))

    @cached_property
    def largest_sigma(self) -> FloatArray:
        """Sigma of each point in its worst direction, object unit; infinite if undetermined, (n,)."""
        out = np.full(len(self.point), np.inf)
        known = np.isfinite(self.sigma)
        out[known] = np.sqrt(np.linalg.eigvalsh(self.covariance[known])[:, -1])
        return out

    @cached_property
    def determined(self) -> BoolArray:
        """Which points are determined, (n,)."""
        return np.isfinite(self.sigma)

    @cached_property
    def rays(self) -> IntArray:
        """Number of usable photographs that show each point, (n,)."""
        return np.asarray(self.sight.seen[self.photograph >= 0].sum(axis=0))

    @cached_property
    def angle_deg(self) -> FloatArray:
        """Largest angle between two rays of each point, deg; NaN with fewer than two, (n,)."""
        a = self.adjustment
        angle = ray_angles(a.network, a.estimate, np.ones(len(a.network.image_points), dtype=bool))
        return np.where(self.point >= 0, angle[self.point], np.nan)

    @property
    def rms_sigma(self) -> float:
        """RMS sigma of a coordinate over all determined points, object unit."""
        return float(np.sqrt((self.sigma[self.determined] ** 2).mean()))

    @cached_property
    def sigma_px(self) -> float:
        """Median sigma of an image coordinate, px."""
        C = self.adjustment.network.image_points.covariance
        return float(np.median(np.sqrt(np.trace(C, axis1=1, axis2=2) / 2)))

    @cached_property
    def scale_number(self) -> float:
        """Mean scale number S over all rays: depth over principal distance, object unit per px."""
        seen = self.sight.seen
        m, n = np.nonzero(seen)
        away = self.planned.xyz[n] - self.stations.position[m]
        depth = -(away * self.stations.rotation[m, :, 2]).sum(axis=1)
        c_px = np.array([camera.c_px for camera in self.cameras])
        return float(depth.mean() / c_px[self.stations.camera[m]].mean())

    @property
    def photographs_per_station(self) -> float:
        """K of Fraser's rule: number of photographs over number of projection centres."""
        return len(self.stations) / self.stations.places

    @property
    def q(self) -> float:
        """Fraser's design factor: q = sigma sqrt(k) / (S sigma_image)."""
        k = self.photographs_per_station
        return self.rms_sigma * float(np.sqrt(k)) / (self.scale_number * self.sigma_px)

    @cached_property
    def motion_variance(self) -> FloatArray:
        """Variance of a coordinate of each point by position, attitude and scale of the whole, (n, 3).

        In object unit^2; 0 for motions that are datum, as with inner constraints.
        """
        a = self.adjustment
        sample = spread_evenly(self.point[self.determined])
        Q = marginal_of(a).joint(np.zeros(0, dtype=np.int64), sample)
        X = a.estimate.points[sample]
        centre, size = X.mean(axis=0), float(np.ptp(X, axis=0).max())
        to_motions = np.linalg.pinv(similarity_motions(X, centre=centre, size=size).reshape(-1, 7))
        C = to_motions @ Q @ to_motions.T
        J = similarity_motions(self.planned.xyz, centre=centre, size=size)
        parts = (slice(0, 3), slice(3, 6), slice(6, 7))
        by = [np.einsum("jia,ab,jib->j", J[:, :, on], C[on, on], J[:, :, on]) / 3 for on in parts]
        return np.stack(by, axis=1)

    @cached_property
    def length_sigma(self) -> float:
        """Largest sigma of a length between two of at most MAX_JOINT determined points, object unit."""
        a = self.adjustment
        sample = spread_evenly(self.point[self.determined])
        Q = marginal_of(a).joint(np.zeros(0, dtype=np.int64), sample)
        return largest_length_sigma(a.estimate.points[sample], Q)


@checked_arguments()
def predict_network(
    planned: PlannedObject,
    camera: Camera | Sequence[Camera],
    stations: Stations,
    seeing: Seeing,
    *,
    bars: Sequence[ScaleBarPlan] = (),
    given: Callable[[Network], Network] | None = None,
    sight: Sight | None = None,
) -> Prediction:
    """Predict the precision of photographs from stations, adjusted with the free parameters of the camera.

    The datum is free, with inner constraints on all points. Bars, if any, give the scale.

    Args:
        planned: the object.
        camera: interior orientation and its free parameters; for a rig, all its cameras.
        stations: stations of the photographs, and their rig.
        seeing: limits and precision of image points.
        bars: scale bars.
        given: returns the network with observations of further kinds, whose values do not matter.
        sight: visibility from these stations, if already known.

    Raises:
        GeometryError: no photograph or point can be determined, for example with all photographs from one
            position; a camera of a rig sees nothing; a bar has an unknown point; or points are off a line
            that is observed.

    Source: Grafarend (1974), Boll. Geod. Sci. Affini 33 (zero- and first-order design); Fraser (1984).
    """
    cameras = (camera,) if isinstance(camera, Camera) else tuple(camera)
    if sight is None:
        # in all photographs, each with its camera
        of_camera = rows_of(stations.camera, len(cameras))
        parts = [
            sight_of(planned, lens, stations.position[taken], stations.rotation[taken], seeing)
            for lens, taken in zip(cameras, of_camera, strict=True)
        ]
        order = np.argsort(np.concatenate(of_camera))
        each = ([getattr(part, field.name) for part in parts] for field in fields(Sight))
        joined = (np.concatenate(column)[order] for column in each)
        sight = Sight(*joined)
    photographs, points = select_usable(sight.seen, stations.taken_at)
    if len(photographs) < 2 or not len(points):
        raise GeometryError(
            f"plan: {len(photographs)} of {len(stations)} photographs show {MIN_POINTS} or more points that "
            "two of them share, needed 2 photographs: see distance, incidence and depth of field"
        )
    blind = np.setdiff1d(stations.camera, stations.camera[photographs])
    if len(blind):
        raise GeometryError(
            f"plan: camera {cameras[blind[0]].name} shows no points that another photograph shows; see the "
            "angles of its mount"
        )
    place = np.full(len(planned.names), -1, dtype=np.int64)
    place[points] = np.arange(len(points))
    i, j = np.nonzero(sight.seen[np.ix_(photographs, points)])
    rows, columns = photographs[i], points[j]
    names = tuple(planned.names[k] for k in points)
    seen = ImagePoints(i, j, sight.xy[rows, columns], sight.covariance[rows, columns])
    network = Network(
        tuple(stations.names[k] for k in photographs),
        stations.camera[photographs],
        names,
        seen,
        observations=(_scale_bars(planned, place, bars),),
        moment=None if stations.taken_at is None else stations.taken_at[photographs],
    )
    estimate = Estimate(
        cameras,
        stations.position[photographs],
        stations.rotation[photographs],
        planned.xyz[points],
        stations.rig,
    )
    if given is not None:
        network, _ = simulate_network(given(network), estimate)
        _refuse_contradictions(network, estimate)
    photograph = np.full(len(stations), -1, dtype=np.int64)
    photograph[photographs] = np.arange(len(photographs))
    prediction = Prediction(planned, stations, sight, predict(network, estimate), place, photograph)
    if not prediction.determined.any():
        raise GeometryError(
            f"plan: {counted(len(photographs), 'photograph')} determine none of the points, needed "
            "stations in different"
            f" places, there are {stations.of(photographs).places}"
        )
    return prediction


def _refuse_contradictions(network: Network, estimate: Estimate) -> None:
    """Refuse observations without values, such as lines, that the planned points contradict."""
    for kind in (kind for kind in network.further if isinstance(kind, Group) and len(kind)):
        off = np.abs(kind.linearise(values_of(estimate)).difference.ravel())
        beyond = off / kind.sigma.ravel()
        worst = int(beyond.argmax())
        if beyond[worst] > MAX_OFF_SIGMAS:
            at = kind.rows(network)[worst // kind.sigma.shape[1]]
            raise GeometryError(
                f"plan: {kind.single} {kind.group}: point {at} is {off[worst]:.4g} off it, in the unit of "
                f"the object, with sigma {kind.sigma.ravel()[worst]:.4g}; needed points on it, within "
                f"{MAX_OFF_SIGMAS:g} sigma"
            )


def select_usable(seen: BoolArray, moment: IntArray | None = None) -> tuple[IntArray, IntArray]:
    """Return the indices of photographs that can be oriented, and of points that two of them show.

    Args:
        seen: which photograph shows which point, (m, n).
        moment: moments of photographs of a rig, which are oriented together, (m,); None for single
            photographs.
    """
    photographs = np.ones(len(seen), dtype=bool)
    together = np.arange(len(seen)) if moment is None else moment
    while True:
        points = seen[photographs].sum(axis=0) >= 2
        shown = np.zeros((int(together.max()) + 1, int(points.sum())), dtype=bool)
        np.logical_or.at(shown, together[photographs], seen[np.ix_(photographs, points)])
        left = photographs & (shown.sum(axis=1)[together] >= MIN_POINTS) & seen[:, points].any(axis=1)
        if (left == photographs).all():
            return np.flatnonzero(photographs), np.flatnonzero(points)
        photographs = left


def spread_evenly(rows: IntArray) -> IntArray:
    """Return at most MAX_JOINT rows, evenly spread."""
    n = len(rows)
    return rows[np.unique(np.linspace(0, n - 1, min(n, MAX_JOINT)).astype(np.int64))]


def largest_length_sigma(xyz: FloatArray, covariance: FloatArray) -> float:
    """Return the largest standard deviation of a length between any two points, object unit.

    Args:
        xyz: coordinates, object unit, (n, 3).
        covariance: joint covariance of all coordinates, object unit^2, (3 n, 3 n).
    """
    n = len(xyz)
    Q = covariance.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
    blocks = Q[np.arange(n), np.arange(n)]
    largest = 0.0
    for i in range(n - 1):
        u = xyz[i + 1 :] - xyz[i]
        length = np.linalg.norm(u, axis=1)
        u = u[length > 0] / length[length > 0, None]
        cross = Q[i, i + 1 :][length > 0]
        of_difference = blocks[i] + blocks[i + 1 :][length > 0] - cross - cross.transpose(0, 2, 1)
        variance = np.einsum("ja,jab,jb->j", u, of_difference, u)
        largest = max(largest, float(variance.max(initial=0.0)))
    return float(np.sqrt(largest))


def _scale_bars(planned: PlannedObject, place: IntArray, bars: Sequence[ScaleBarPlan]) -> ScaleBars:
    planned_bars: list[tuple[int, int, float, float]] = []
    for bar in bars:
        i, j = (index_of(planned.names, name, "point of a scale bar") for name in (bar.start, bar.end))
        if i == j or not (np.isfinite(bar.sigma) and bar.sigma > 0):
            raise GeometryError(
                f"scale bar {bar.start} - {bar.end}: sigma {bar.sigma:g}, needed two points and a "
                "sigma above 0"
            )
        if place[i] >= 0 and place[j] >= 0:
            length = float(np.linalg.norm(planned.xyz[i] - planned.xyz[j]))
            planned_bars.append((int(place[i]), int(place[j]), length, bar.sigma))
    if not planned_bars:
        return ScaleBars()
    rows = np.array(planned_bars)
    return ScaleBars(rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2], rows[:, 3])


@checked_arguments()
def simulate_network(
    network: Network, truth: Estimate, rng: np.random.Generator | None = None
) -> tuple[Network, Estimate]:
    """Return a network with simulated observations, and the truth.

    Args:
        network: states the observations and their precision. Its values do not matter, except for coordinates
            of rigid frames and offsets, which must be approximate.
        truth: true values of all unknowns.
        rng: source of the errors, normally distributed with the stated covariances; no errors if None.

    Returns:
        The network, and the truth. With errors, its points on lines are first moved onto the line, and then
        off it by the stated errors.
    """
    if rng is not None:
        for kind in network.observations:
            truth = replace(truth, points=kind.displaced(values_of(truth), rng))
    seen = network.image_points
    xy = np.empty(seen.xy.shape)
    for i, rows in enumerate(rows_of(seen.image, len(network.images))):
        camera = truth.cameras[network.camera[i]]
        xy[rows] = project(camera, truth.position[i], truth.rotation[i], truth.points[seen.point[rows]])
    if rng is not None:
        root = np.linalg.cholesky(seen.covariance)
        xy += np.einsum("kab,kb->ka", root, rng.standard_normal(xy.shape))
    values = values_of(truth)
    return (
        replace(
            network,
            image_points=replace(seen, xy=xy),
            observations=tuple(kind.simulated(values, rng) for kind in network.observations),
        ),
        truth,
    )


@dataclass(frozen=True)
class WantedPrecision:
    """Requirements on a network, None if there is none; lengths in the object unit."""

    sigma: float | None = None  # of every point, RMS of its coordinates
    length_sigma: float | None = None  # of every length between two points
    displacement: float | None = None  # of any point between two surveys, detectable with POWER

    def __post_init__(self) -> None:
        for name, value in (
            ("sigma", self.sigma),
            ("sigma of lengths", self.length_sigma),
            ("displacement", self.displacement),
        ):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise GeometryError(f"plan: wanted {name} is {value:g}, needed more than 0")

    @property
    def anything(self) -> bool:
        """Whether there is any requirement."""
        return any(x is not None for x in (self.sigma, self.length_sigma, self.displacement))

    def point_variance(self, planned: PlannedObject) -> FloatArray:
        """Return the approximate variance of a coordinate that suffices at each point, object unit^2, (n,).

        Args:
            planned: the object.
        """
        sigma = [math.inf]
        if self.sigma is not None:
            sigma.append(self.sigma)
        if self.length_sigma is not None:
            sigma.append(self.length_sigma / math.sqrt(2))
        if self.displacement is not None:
            sigma.append(self.displacement / displacement_per_sigma())
        return np.full(len(planned.names), min(sigma) ** 2)


def displacement_per_sigma() -> float:
    """Return the length of a detectable displacement between two surveys, over sigma of one survey."""
    return math.sqrt(2) * detectable_shift(LEVEL, POWER, 3, None)


def found_displacement(prediction: Prediction) -> FloatArray:
    """Return the detectable displacement of each point between two surveys, object unit, (n,)."""
    return prediction.largest_sigma * displacement_per_sigma()


def short_of(prediction: Prediction, wanted: WantedPrecision, points: BoolArray) -> float:
    """Return the largest ratio of predicted to wanted values; 1 or less if all requirements are met.

    It is infinite if a point has fewer than MIN_RAYS, or if the network leaves something undetermined.

    Args:
        prediction: prediction of a network.
        wanted: requirements on the network.
        points: points that count, (n,).
    """
    if not points.any():
        raise GeometryError(f"plan: no point can be seen from {MIN_RAYS} stations")
    complete = prediction.determined[points].all() and (prediction.rays[points] >= MIN_RAYS).all()
    short = [0.0 if complete and not prediction.adjustment.undetermined else math.inf]
    if wanted.sigma is not None:
        short.append(float(prediction.sigma[points].max()) / wanted.sigma)
    if wanted.length_sigma is not None and math.isfinite(short[0]):
        short.append(prediction.length_sigma / wanted.length_sigma)
    if wanted.displacement is not None:
        short.append(float(found_displacement(prediction)[points].max()) / wanted.displacement)
    return max(short)
