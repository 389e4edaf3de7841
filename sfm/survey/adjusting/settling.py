"""Repeated adjustment of a survey, until no more points or photographs are removed.

After each adjustment, points with too few accepted rays and photographs with too few accepted points are
removed, and the rest is adjusted again. If other observations take part, the image points are weighted by
their variance component.

With long lenses all rays of a photograph are nearly parallel. Principal distance, distance of the photographs
and depth of the object can then hardly be distinguished. Gauss-Newton moves slowly along a bent valley, and
the object reversed in depth is another minimum. With the cameras held at their start values there is no such
valley. If an adjustment does not converge, it is repeated with held cameras, and from that solution with free
cameras.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 13.3.6 (affine cameras, reversal).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.variance_components import IMAGE_POINTS, estimate_components
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.judgement.model_choice import Choice, choose
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.distortion.models import Role
from sfm.model.distributions import chi2_isf
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.observations.kind import is_observed
from sfm.model.reduced_network import merge_estimate, reduce_network, select_determined
from sfm.model.remarks.remark import Remark, remark
from sfm.model.similarity import reverse_depth
from sfm.orientation.image_rays import ray_angles
from sfm.survey.diagnosis.photograph_cameras import PhotographCameras, find_photograph_cameras
from sfm.survey.inputs.cameras import without_idle_cameras
from sfm.survey.inputs.settings import DatumSettings
from sfm.survey.inputs.survey import Survey

MIN_DATUM_POINTS = 3  # that fix position, attitude and scale
MAX_ITERATIONS = 50  # of an adjustment from the usual start values
MANY_ITERATIONS = 300  # of a second adjustment from nearer values: steps along a flat valley are short
# Parameters that are held if it does not converge with all: x0, y0 look like a rotation, c like another
# distance.
HELD_ONE_AFTER_ANOTHER = ((), (Role.X0, Role.Y0), (Role.X0, Role.Y0, Role.FOCAL))
CARRYING_DEG = 2.0  # a point carries no free datum if the largest angle between its rays is smaller
DAMPED_ITERATIONS, UNDAMPED_ITERATIONS = 50, 300  # with the cameras held; a step costs little
START_TOLERANCE = 1e-3  # |A dx| / |v| that is close enough for start values
MOTIONS = 7  # of a network whose position, attitude and scale the datum fixes


@dataclass(frozen=True)
class Task:
    """An adjustment to perform, with its settings."""

    survey: Survey
    network: Network
    needed: IntArray  # rays that each point needs to stay, (n,)
    least: IntArray  # image points that each photograph needs to stay, (m,)
    suspected: tuple[str, ...] = ()  # photographs matched only with a per-photograph camera
    # Factor of the stated standard deviations of the image points. If these are far too large, control and
    # bars bend the network by more than its noise, and their points look like gross errors.
    factor: float = 1.0

    @property
    def datum(self) -> Datum:
        """The kind of datum that the survey states."""
        return Datum(self.survey.datum.kind)

    @property
    def in_free_datum(self) -> Task:
        """The task in a free datum if its datum is control, else unchanged."""
        if self.survey.datum.kind != "control":
            return self
        return replace(self, survey=replace(self.survey, datum=DatumSettings(kind="free")))


@dataclass(frozen=True)
class StableAdjustment:
    """An adjustment after which no point or photograph is removed."""

    task: Task
    adjustment: Adjustment  # without covariance
    images: BoolArray  # photographs in the adjustment, (m,)
    points: BoolArray  # points in the adjustment, (n,)
    accepted: BoolArray  # image points of the whole network, (k,)
    iterations: int  # of all adjustments
    rays: IntArray  # accepted rays of each point, for removed points at their removal, (n,)
    start_sigma0: float  # at the start values
    held: tuple[Remark, ...]  # on parameters that were held to make it converge
    per_photograph: PhotographCameras | None = None  # or photographs left out; None without any

    def after(self, before: StableAdjustment) -> StableAdjustment:
        """Return this adjustment as the continuation of an earlier one."""
        return replace(
            self,
            iterations=before.iterations + self.iterations,
            start_sigma0=before.start_sigma0,
            per_photograph=self.per_photograph or before.per_photograph,
        )

    @property
    def whole(self) -> Estimate:
        """Adjusted values among those of all photographs and points; NaN elsewhere."""
        return merge_estimate(self.estimate, self.images, self.points)

    @property
    def part(self) -> Network:
        """The network that was adjusted."""
        return self.adjustment.network

    @property
    def estimate(self) -> Estimate:
        """Adjusted values of the part."""
        return self.adjustment.estimate

    @property
    def rejected(self) -> BoolArray:
        """Image points of the part that were rejected."""
        return self.adjustment.rejected


def settle(task: Task, estimate: Estimate, accepted: BoolArray | None = None) -> StableAdjustment:
    """Adjust until no more points or photographs are removed.

    Args:
        task: the adjustment to perform.
        estimate: approximate values.
        accepted: image points that an earlier adjustment accepted, (k,); the others return if they pass the
            test.
    """
    network, iterations, start_sigma0 = task.network, 0, np.nan
    held: tuple[Remark, ...] = ()
    rays = network.rays()
    everything = np.ones(len(network.image_points), dtype=bool)
    accepted = everything if accepted is None else accepted
    wrong: BoolArray | None = None
    images, points = select_determined(network, estimate, everything, task.needed, task.least)
    while True:
        part, start = reduce_network(network, estimate, images, points, np.ones_like(accepted))
        refuse_too_few_observations(part, start, task.datum.kind)
        used = images[network.image_points.image] & points[network.image_points.point]
        adjustment = _adjust_with_snooping(task, part, start, covariance=False, rejected=~accepted[used])
        start_sigma0 = start_sigma0 if iterations else adjustment.start_sigma0
        iterations += adjustment.iterations
        if not adjustment.converged:
            adjustment, held = _readjust_until_converged(task, part, start, adjustment)
            iterations += adjustment.iterations
        estimate = merge_estimate(adjustment.estimate, images, points)
        accepted = accepted_image_points(network, adjustment, images, points)
        if wrong is None:  # once only: errors of windows are not quite normal, each round would find more
            wrong = np.zeros(len(points), dtype=bool)
            if task.survey.reject != "none":
                wrong[points] = _wrong_windows(adjustment)
        accepted &= ~wrong[network.image_points.point]
        now = np.bincount(network.image_points.point[accepted], minlength=len(points))
        rays = np.where(points, now, rays)
        left_images, left_points = select_determined(network, estimate, accepted, task.needed, task.least)
        if (left_images == images).all() and (left_points == points).all():
            return StableAdjustment(
                task, adjustment, images, points, accepted, iterations, rays, start_sigma0, held
            )
        images, points = left_images, left_points


def settle_by_photograph(
    task: Task, estimate: Estimate, accepted: BoolArray | None = None
) -> StableAdjustment:
    """Adjust, then again with per-photograph cameras where these fit, and without misfitting photographs.

    Args:
        task: the adjustment to perform; without outlier tests there is only one adjustment.
        estimate: approximate values; photographs and points removed from the first adjustment start from
            these again.
        accepted: image points that an earlier adjustment accepted, (k,), as in `settle`.
    """
    settled = settle(task, estimate, accepted)
    if task.survey.reject == "none" or task.network.moment is not None:  # a camera on a rig has one mount
        return settled

    def settle_changed(changed: PhotographCameras) -> StableAdjustment:
        values, again = changed.estimate, ~changed.estimate.oriented & ~changed.without
        start = replace(
            values,
            position=np.where(again[:, None], estimate.position, values.position),
            rotation=np.where(again[:, None, None], estimate.rotation, values.rotation),
            points=np.where(values.determined[:, None], values.points, estimate.points),
        )
        resettled = settle(replace(task, network=changed.network), start)
        return replace(
            resettled, per_photograph=changed, iterations=settled.iterations + resettled.iterations
        )

    def changed_cameras(settled: StableAdjustment) -> Iterator[PhotographCameras]:
        changed = find_photograph_cameras(
            task.network,
            settled.whole,
            settled.accepted,
            oriented=estimate.oriented,
            suspected=task.suspected,
            false_alarm=task.survey.adjust.false_alarm,
        )
        if changed is not None:
            yield changed

    return choose(settled, (Choice(changed_cameras),), settle_changed)


def adjust_finally(task: Task, part: Network, estimate: Estimate, rejected: BoolArray) -> Adjustment:
    """Return the final adjustment with its covariance.

    If other observations take part, the image points are weighted by their variance component, unless the
    survey states that all weights are fixed.

    Args:
        task: the adjustment to perform.
        part: the network to adjust.
        estimate: start values.
        rejected: image points that are rejected at the start, (k,).
    """
    part, estimate = without_idle_cameras(part, estimate, count=len(task.survey.cameras))

    def adjust_part(factor: FloatArray) -> Adjustment:
        return _adjust_with_snooping(task, part, estimate, covariance=True, factor=factor, rejected=rejected)

    outer = (part.control, part.exterior) if task.datum.kind == "control" else ()
    weighted = any(is_observed(np.einsum("nii->ni", given.covariance)).any() for given in outer)
    others = len(part.scale_bars) or len(part.interior) or len(part.further) or weighted
    if (others or len(part.sources) > 1) and task.survey.adjust.weights == "components":
        return _adjust_with_components(adjust_part, part, task.factor)
    return adjust_part(np.ones(len(part.image_points)))


def _readjust_until_converged(
    task: Task, part: Network, start: Estimate, ended: Adjustment
) -> tuple[Adjustment, tuple[Remark, ...]]:
    """Return the adjustment from nearer start values, and remarks on parameters held to make it converge.

    If it does not converge from there either, the result is `ended`.
    """
    datum = on_points(task, part, start)
    nearer = nearer_start(part, start, ended.estimate, datum)
    if nearer is None:
        return ended, ()
    held = HELD_ONE_AFTER_ANOTHER[: None if not len(part.interior) else 1]

    def adjust_holding(roles: tuple[Role, ...]) -> Adjustment:
        cameras = tuple(
            replace(camera, free=camera.free & ~camera.plays(*roles)) for camera in nearer.cameras
        )
        return _adjust_with_snooping(
            task,
            part,
            replace(nearer, cameras=cameras),
            covariance=False,
            method="gauss-newton",
            max_iterations=MANY_ITERATIONS,
        )

    first_converged = Choice[tuple[Role, ...], Adjustment](
        lambda _: held, lambda _, after: float(after.converged), suffices=lambda _: True
    )
    adjustment = choose(ended, (first_converged,), adjust_holding)
    if adjustment is ended:
        return ended, ()
    return adjustment, held_to_converge(nearer.cameras, adjustment.estimate.cameras)


def _adjust_with_snooping(
    task: Task,
    network: Network,
    estimate: Estimate,
    *,
    covariance: bool,
    factor: FloatArray | None = None,
    rejected: BoolArray | None = None,
    method: str = "levenberg-marquardt",
    max_iterations: int = MAX_ITERATIONS,
) -> Adjustment:
    """Adjust with data snooping; the level of the survey is divided among all image coordinates."""
    return adjust(
        network,
        estimate,
        datum=on_points(task, network, estimate),
        reject=task.survey.reject,
        false_alarm=task.survey.adjust.false_alarm,
        rejected=rejected,
        covariance=covariance,
        options=AdjustmentOptions(
            sigma_px=task.survey.adjust.sigma_px,
            image_sigma_factor=task.factor if factor is None else factor,
            method=method,
            max_iterations=max_iterations,
        ),
    )


def on_points(task: Task, network: Network, estimate: Estimate) -> Datum:
    """Return the datum on the points that the survey names, else on all points without very small ray angles.

    Args:
        task: states the datum.
        network: the network to adjust.
        estimate: approximate values.

    Raises:
        GeometryError: fewer than three of the named points are in the network.
    """
    datum, named = task.datum, task.survey.datum.points
    if not named and datum.kind == "control":
        return datum
    if not named:
        angles = ray_angles(network, estimate, np.ones(len(network.image_points), dtype=bool))
        return replace(datum, points=datum_carriers(angles, CARRYING_DEG))
    on = np.isin(network.points, named)
    if on.sum() < MIN_DATUM_POINTS:
        raise GeometryError(
            f"{on.sum()} of the {len(named)} datum.points are in the network, at least "
            f"{MIN_DATUM_POINTS} are needed"
        )
    return replace(datum, points=on)


def _adjust_with_components(
    adjust_part: Callable[[FloatArray], Adjustment], part: Network, start: float
) -> Adjustment:
    """Return the adjustment with the image points of each source weighted by their variance component.

    Lengths and control keep their stated standard deviations. Without the component, sigma0 a posteriori,
    which the image points determine, would scale these too. The component is estimated from the image points
    that the last adjustment accepts.

    Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.2.4.
    """
    present, group = np.unique(part.source, return_inverse=True)
    names = (IMAGE_POINTS,) if len(present) == 1 else tuple(part.sources[k].name for k in present)
    final, _, settled = estimate_components(adjust_part, group, names, start=start)
    if not settled:
        unsettled = remark("rejection_not_converging", groups=names)
        final = replace(final, remarks=(*final.remarks, unsettled))
    return final


def _wrong_windows(adjustment: Adjustment) -> BoolArray:
    """Return which points have residuals that are together larger than chance explains, (n,).

    A window of texture that is slightly wrong in several photographs passes the tests of its single rays.
    Points with lasting names, and those of control or scale bars, stay, so that people can examine them.
    """
    network, used = adjustment.network, ~adjustment.rejected
    seen, v, n = network.image_points.select(used), adjustment.residuals[used], len(network.points)
    P = np.linalg.inv(adjustment.image_covariance[used])
    vPv = np.bincount(seen.point, np.einsum("ka,kab,kb->k", v, P, v), minlength=n)
    redundancy = 2 * np.bincount(seen.point, minlength=n) - 3  # with cameras held: slightly too cautious
    limit = chi2_isf(adjustment.levels.of_each(n), np.maximum(redundancy, 1))
    large = ~network.named & (redundancy > 1) & (vPv > adjustment.sigma0**2 * limit)
    bars = network.scale_bars
    large[np.concatenate([network.control.point, bars.start, bars.end])] = False
    return np.asarray(large)


def accepted_image_points(
    network: Network, adjustment: Adjustment, images: BoolArray, points: BoolArray
) -> BoolArray:
    """Return which image points of the whole network the adjustment of its part accepted, (k,).

    Args:
        network: the whole network.
        adjustment: of its part.
        images: photographs of the part, (m,).
        points: points of the part, (n,).
    """
    seen = network.image_points
    part = images[seen.image] & points[seen.point]
    accepted = part.copy()
    accepted[part] = ~adjustment.rejected
    return accepted


def nearer_start(network: Network, start: Estimate, ended: Estimate, datum: Datum) -> Estimate | None:
    """Return start values from an adjustment with all cameras held; of both depths, that with smaller v'Pv.

    Args:
        network: the network to adjust.
        start: start values from which its adjustment did not converge.
        ended: values at which that adjustment ended.
        datum: datum of the adjustment.

    Returns:
        The start values, with the cameras as in `start`; None if no adjustment converges.
    """
    candidates = _start_candidates(network, start, ended, datum)
    attempts = [_adjust_with_cameras_held(network, candidate, datum) for candidate in candidates]
    converged = [adjustment for adjustment in attempts if adjustment is not None]
    best = min(converged, key=lambda adjustment: adjustment.vPv, default=None)
    return None if best is None else replace(best.estimate, cameras=start.cameras)


def held_to_converge(before: tuple[Camera, ...], after: tuple[Camera, ...]) -> tuple[Remark, ...]:
    """Return a remark for each camera with parameters that were free before and are held now."""
    names: dict[str, tuple[str, ...]] = {}
    for camera, held in zip(before, after, strict=True):
        lost = np.flatnonzero(camera.free & ~held.free)
        if len(lost):
            names[camera.owner_of(int(lost[0]))] = tuple(camera.names[s] for s in lost)
    return tuple(
        remark("held_to_converge", camera=camera, parameters=parameters)
        for camera, parameters in names.items()
    )


def _start_candidates(network: Network, start: Estimate, ended: Estimate, datum: Datum) -> Iterator[Estimate]:
    """Yield the ended adjustment scaled to c of the start, and the start; each also reversed in depth.

    The distance of each photograph is scaled as c of its camera.
    """
    pairs = zip(start.cameras, ended.cameras, strict=True)
    factor = np.array([before.c_px / after.c_px for before, after in pairs])[network.camera]
    back = start
    if (factor > 0).all():
        centre = ended.points.mean(axis=0)
        position = centre + factor[:, None] * (ended.position - centre)
        back = replace(ended, cameras=start.cameras, position=position)
    for values in (back, start):
        yield values
        if datum.kind != "control":
            yield reverse_depth(values)


def _adjust_with_cameras_held(network: Network, start: Estimate, datum: Datum) -> Adjustment | None:
    """Return the adjustment with all cameras held, damped at first; None if it does not converge."""
    values = replace(
        start, cameras=tuple(replace(camera, free=np.zeros_like(camera.free)) for camera in start.cameras)
    )
    for method, steps in (("levenberg-marquardt", DAMPED_ITERATIONS), ("gauss-newton", UNDAMPED_ITERATIONS)):
        try:
            a = adjust(
                network,
                values,
                datum=datum,
                reject="none",
                covariance=False,
                options=AdjustmentOptions(method=method, max_iterations=steps, tolerance=START_TOLERANCE),
            )
        except GeometryError:
            return None
        if a.rejected.any() or not np.isfinite(a.vPv):
            return None
        if a.converged:
            return a
        values = a.estimate
    return None


def refuse_too_few_observations(network: Network, estimate: Estimate, datum: str) -> None:
    """Raise GeometryError if a network has no redundancy, since nothing could be checked.

    Args:
        network: the part to adjust.
        estimate: its cameras state the free parameters.
        datum: kind of datum; control and observed exterior orientation only count if it is `control`.
    """
    m, n, k = len(network.images), len(network.points), len(network.image_points)
    interior = len(
        {
            (camera.group_of(int(s)) or a, int(s))
            for a, camera in enumerate(estimate.cameras)
            if (network.camera == a).any()
            for s in np.flatnonzero(camera.free)
        }
    )
    if datum == "control":
        outer = network.control.covariance, network.exterior.covariance
        variances = [np.einsum("nii->ni", covariance) for covariance in outer]
        known = sum(int(((variance == 0) | is_observed(variance)).sum()) for variance in variances)
    else:
        known = MOTIONS
    given = len(network.scale_bars) + int((network.interior.sigma > 0).sum())
    observations, unknowns = 2 * k + given + known, 6 * m + 3 * n + interior
    if observations > unknowns:
        return
    free = f", {interior} of them free camera parameters" if interior else ""
    advice = (
        "; free fewer parameters, or add photographs and points"
        if interior
        else "; add photographs or points"
    )
    raise GeometryError(
        f"{counted(n, 'common point')} in {counted(m, 'photograph')}: {counted(observations, 'observation')} "
        f"and datum conditions for {counted(unknowns, 'unknown')}{free}, more are needed{advice}"
    )


def datum_carriers(angles_deg: np.ndarray, least_deg: float) -> BoolArray | None:
    """Return the points that carry a free datum, (n,), or None for all.

    A distant point with a small ray angle would be a long and soft lever on the position, attitude and scale
    of all other points.

    Args:
        angles_deg: largest angle between two rays of each point, NaN with fewer than two rays, deg, (n,).
        least_deg: smallest angle of a point that carries the datum, deg.
    """
    weak = angles_deg < least_deg
    return None if not weak.any() or 2 * weak.sum() > len(weak) else np.asarray(~weak)
