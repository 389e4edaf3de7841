"""Comparison of two adjusters on one network, with a camera model that both can estimate.

Both adjusters get a problem that both can solve: the accepted image points with equal weights, without
control or scale bars, and with one functional model. For a survey in `brown` this model is `opencv` where two
radial coefficients are enough, else `full_opencv`. If cameras share only some of their parameters, the shared
parameters are held, since COLMAP cannot share single parameters.

With all twelve parameters free, full_opencv is nearly singular: a common factor of the numerator and the
denominator of its radial term changes nothing. COLMAP frees the distortion as a whole or not at all. If the
image points cannot separate k1-k3 from k4-k6, the distortion is therefore held at the survey's result in both
adjusters, and the comparison reports this.

COLMAP frees fx and fy, the principal point, and the distortion as groups. Two adjusters can therefore agree
on a camera with more free parameters than the survey's camera has. Their agreement then proves nothing about
the survey. For this reason the comparison also tests whether that camera fits the image points better.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, Protocol

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.comparison.camera_conversion import Conversion, convert_camera, corresponding_free
from sfm.comparison.solutions import ROUNDING_PX, Comparison, compare
from sfm.judgement.hypotheses.hypotheses import contradicted_parameters
from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.display import counted, program_name
from sfm.model.distortion.models import OF_COLMAP, Role
from sfm.model.distributions import FALSE_ALARM, LEVEL, chi2_isf, f_isf
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.reduced_network import reduce_network, select_supported
from sfm.runtime.progress import report_step

MIN_RAYS, MIN_POINTS = 2, 3  # photographs that determine a point, points that determine a photograph
# The weak directions of full_opencv need more steps than a survey. Even if k1 to k6 have grown a
# thousandfold, they may still converge: of 32 random networks that had not converged after 40 steps, 25 did
# so by step 200.
MAX_ITERATIONS = 200
OPENCV_RADIAL = 2  # coefficients
# Misfit of a model, over the standard deviation of an image coordinate, up to which it is that of the survey:
# it adds half a per cent to residuals.
MAX_MISFIT = 0.1
Outcome = Literal["agrees", "fits alike", "differs"]
MIN_RMS_RATIO = 1.1  # of residuals; a smaller ratio has no visible effect on the coordinates


@dataclass(frozen=True)
class BetterFit:
    """A camera with more free parameters that fits the image points significantly better."""

    own_rms_px: float  # per coordinate with the survey's camera and equal weights, px
    rms_px: float  # per coordinate with the camera of the comparison, px
    free: tuple[str, ...]  # held parameters of the survey's cameras that should be free, the clearest first

    @property
    def times(self) -> float:
        """RMS residual with the camera of the survey over that with the camera of the comparison."""
        return self.own_rms_px / self.rms_px if self.rms_px > 0 else np.inf


@dataclass(frozen=True)
class AdjusterComparison:
    """Results of two adjusters with the same network, model, weights and start values."""

    backend: str  # the other adjuster
    model: str  # functional model of both
    conversions: tuple[Conversion, ...]  # of each camera from the survey's model; misfit 0 for the same model
    freed: tuple[str, ...]  # text on cameras with more free parameters than in the survey
    held: tuple[str, ...]  # why the distortion was held at the survey's result; empty if it was free
    network: Network  # accepted image points with equal weights, as given to both
    adjustment: Adjustment  # the in-house adjustment in this model
    backend_iterations: int  # steps of the other adjuster
    backend_converged: bool
    comparison: Comparison
    # the other adjuster's covariances of the points with photographs and cameras held (conditional), scaled
    # by our sigma0, object unit^2, (n, 3, 3); None if it has none
    backend_points: FloatArray | None
    unshared: tuple[str, ...] = ()  # text on parameters that cameras share in the survey, held at its result
    better: BetterFit | None = None  # if the compared camera has more free parameters and fits better
    stopped_early: bool = False  # whether continuing from the other solution leads to the in-house one

    @property
    def agree(self) -> bool:
        """Whether both found the same optimum, even if the other adjuster stopped before it."""
        if not self.adjustment.converged:
            return False
        return self.stopped_early or (self.comparison.agree and self.backend_converged)

    @property
    def gap(self) -> float:
        """Difference of v'Pv of the two solutions, in variances of an image coordinate."""
        a, b = self.comparison.cost
        sigma = max(self.adjustment.sigma0 * self.adjustment.sigma_px, ROUNDING_PX)
        return 2 * abs(b - a) / sigma**2

    @property
    def outcome(self) -> Outcome:
        """Whether they agree, fit alike (image points do not distinguish them), or differ."""
        if self.agree:
            return "agrees"
        return "fits alike" if self.gap <= chi2_isf(FALSE_ALARM, 1) else "differs"


class BackendAdjustment(Protocol):
    """Result that another adjuster must return."""

    @property
    def estimate(self) -> Estimate:
        """The solution."""

    @property
    def iterations(self) -> int:
        """Steps taken."""

    @property
    def converged(self) -> bool:
        """Whether it reports convergence."""

    @property
    def seconds(self) -> float:
        """Time of the adjustment alone, s."""

    @property
    def point_covariance(self) -> FloatArray | None:
        """Covariance of the points with photographs and cameras held, for a sigma of 1 px; None without."""


def compare_adjusters(
    adjustment: Adjustment,
    backend: Callable[[Network, Estimate], BackendAdjustment],
    *,
    name: str = "colmap",
    model: str | None = None,
) -> AdjusterComparison:
    """Run the in-house adjuster and another one on the accepted image points of a survey.

    Both start from the survey's result with its cameras converted. All image coordinates have the same
    weight, and the datum is free.

    Args:
        adjustment: adjustment of the survey.
        backend: the other adjuster, a function of network and start values.
        name: name of the backend.
        model: functional model of both; if not given, as for `common_problem`.

    Raises:
        GeometryError: nothing is left to compare.
        BackendError: the backend fails.
    """
    cameras, unshared = without_sharing(adjustment.estimate.cameras)
    adjustment = replace(adjustment, estimate=replace(adjustment.estimate, cameras=cameras))
    network, start, conversions, freed = common_problem(adjustment, model=model)
    rational = bool(start.cameras[0].plays(Role.DENOMINATOR).any())
    report_step(f"adjusting with {program_name('kolinear')}")
    ours = _adjusted(network, start, adjustment.sigma_px)
    held: tuple[str, ...] = ()
    if rational and (ours.undetermined or not ours.converged):
        held = ours.undetermined or (
            f"k1 to k6 still grow together after {counted(ours.iterations, 'iteration')}, numerator and "
            "denominator of the rational distortion cancelling",
        )
    while True:
        if held:
            start = replace(start, cameras=tuple(distortion_held(camera) for camera in start.cameras))
            ours = _adjusted(network, start, adjustment.sigma_px)
        report_step(f"adjusting with {program_name(name)}")
        theirs = backend(network, start)
        comparison = compare(
            ours.estimate, theirs.estimate, network, covariance=ours.covariance, names=("kolinear", name)
        )
        if not ours.converged or (comparison.agree and theirs.converged):
            stopped_early = False
            break
        further = _adjusted(network, theirs.estimate, adjustment.sigma_px)
        ended = compare(ours.estimate, further.estimate, network, covariance=ours.covariance)
        stopped_early = further.converged and ended.agree
        if stopped_early or held or not rational:
            break
        held = further.undetermined or (
            "k1 to k6 end in different minima, numerator and denominator of the rational distortion "
            "nearly cancelling",
        )
    conditional = theirs.point_covariance
    return AdjusterComparison(
        name,
        start.cameras[0].model,
        conversions,
        freed,
        held,
        network,
        ours,
        theirs.iterations,
        theirs.converged,
        comparison,
        None if conditional is None else (ours.sigma0 * ours.sigma_px) ** 2 * conditional,
        unshared,
        better_fit(adjustment, network, ours),
        stopped_early,
    )


def _adjusted(network: Network, start: Estimate, sigma_px: float) -> Adjustment:
    return adjust(
        network,
        start,
        datum=Datum("free"),
        reject="none",
        options=AdjustmentOptions(sigma_px=sigma_px, max_iterations=MAX_ITERATIONS),
    )


def without_sharing(cameras: tuple[Camera, ...]) -> tuple[tuple[Camera, ...], tuple[str, ...]]:
    """Return the cameras with shared parameters held, and a text on these parameters.

    COLMAP shares either all parameters of a camera among its photographs, or none. If several cameras share
    only some parameters, such as one distortion for photographs that differ in c, these can only be held at
    the survey's result.

    Args:
        cameras: interior orientations, some parameters of which may be shared.
    """
    groups = [[camera.group_of(s) for s in range(len(camera.names))] for camera in cameras]
    members = Counter(group for of_camera in groups for group in set(of_camera) if group)
    alone: list[Camera] = []
    held: dict[str, tuple[str, ...]] = dict.fromkeys(members, ())
    for camera, of_camera in zip(cameras, groups, strict=True):
        shared = np.array([members[group] > 1 for group in of_camera]) & camera.free
        for s in np.flatnonzero(shared):
            held[of_camera[s]] = tuple(dict.fromkeys((*held[of_camera[s]], camera.names[s])))
        alone.append(replace(camera, free=camera.free & ~shared, shared=()))
    words = tuple(
        f"{', '.join(names)} of {group}, shared by {counted(members[group], 'camera')}"
        for group, names in held.items()
        if names
    )
    return tuple(alone), words


def common_problem(
    adjustment: Adjustment, *, model: str | None = None
) -> tuple[Network, Estimate, tuple[Conversion, ...], tuple[str, ...]]:
    """Return the network, start values, conversions and changes of free parameters of a comparison.

    The network has oriented photographs with three points, points in two photographs, and accepted image
    points, each with the covariance sigma_px^2 I. COLMAP frees focal lengths, principal point and distortion
    as groups. If one parameter of a group is free, the whole group is free in all cameras that are not fixed.

    Args:
        adjustment: adjustment of the survey.
        model: functional model; if not given, that of the survey if COLMAP has it, else opencv if its cameras
            are as good with two radial coefficients, else full_opencv.

    Raises:
        GeometryError: fewer than two photographs with accepted image points.
    """
    estimate = adjustment.estimate
    cameras = estimate.cameras
    conversions = _converted(cameras, adjustment.sigma0_px, model)
    converted = tuple(conversion.camera for conversion in conversions)
    grouped = grouped_free(converted)
    freed = tuple(
        f"{camera.name}: " + ", ".join(np.array(camera.names)[now.free & ~camera.free])
        for camera, now in zip(converted, grouped, strict=True)
        if (now.free & ~camera.free).any()
    )
    accepted = ~adjustment.rejected
    images, points = select_supported(
        adjustment.network, estimate, accepted, min_points=MIN_POINTS, min_rays=MIN_RAYS
    )
    if images.sum() < 2:
        raise GeometryError("comparison: fewer than two photographs with accepted image points are left")
    network, start = reduce_network(
        adjustment.network, replace(estimate, cameras=grouped), images, points, accepted
    )
    seen = network.image_points
    unit = np.tile(np.eye(2) * adjustment.sigma_px**2, (len(seen), 1, 1))
    # Only image points: no control, scale bars or other observations.
    network = Network(
        network.images,
        network.camera,
        network.points,
        ImagePoints(seen.image, seen.point, seen.xy, unit),
        moment=network.moment,
    )
    return network, start, conversions, freed


def _converted(cameras: tuple[Camera, ...], sigma_px: float, model: str | None) -> tuple[Conversion, ...]:
    """Return the cameras in one model: the given one, or the plainest that COLMAP has and that fits them."""
    models = {camera.model for camera in cameras}
    if model is None and len(models) == 1 and models <= OF_COLMAP:
        model = models.pop()
    if model is not None:
        return tuple(convert_camera(camera, model) for camera in cameras)
    if all((camera.free & camera.plays(Role.RADIAL)).sum() <= OPENCV_RADIAL for camera in cameras):
        plain = list[Conversion]()
        with suppress(GeometryError):  # it folds over inside a photograph
            for camera in cameras:
                plain.append(convert_camera(camera, "opencv"))
                if plain[-1].max_px > MAX_MISFIT * sigma_px:
                    break
            else:
                return tuple(plain)
    return tuple(convert_camera(camera, "full_opencv") for camera in cameras)


def grouped_free(cameras: tuple[Camera, ...]) -> tuple[Camera, ...]:
    """Return the cameras with whole groups of free parameters, the same in all cameras that are not fixed."""
    free = [any(camera.free[camera.parts[g]].any() for camera in cameras) for g in range(3)]
    out = []
    for camera in cameras:
        flags: BoolArray = np.zeros(len(camera.names), dtype=bool)
        if camera.free.any():
            for group, is_free in zip(camera.parts, free, strict=True):
                flags[group] = is_free
        out.append(replace(camera, free=flags))
    return tuple(out)


def distortion_held(camera: Camera) -> Camera:
    """Return a camera with its distortion fixed."""
    return replace(camera, free=camera.free & ~camera.parts[2])


def better_fit(survey: Adjustment, network: Network, compared: Adjustment) -> BetterFit | None:
    """Return how much better the camera of the comparison fits; None if it does not fit better.

    Args:
        survey: adjustment of the survey, with its cameras.
        network: image points with equal weights, as given to both adjusters.
        compared: in-house adjustment of this network with the cameras of the comparison.
    """
    own_cameras = survey.estimate.cameras
    names: dict[str, None] = {}  # parameters held in the survey whose counterparts are free here
    for ours, theirs in zip(own_cameras, compared.estimate.cameras, strict=True):
        free = corresponding_free(theirs, ours.model) & ~ours.free
        names |= dict.fromkeys(name for name, on in zip(ours.names, free, strict=True) if on)
    more = tuple(names)
    if not more or not compared.converged:
        return None
    adjusted = partial(
        adjust,
        network,
        datum=Datum("free"),
        reject="none",
        options=AdjustmentOptions(sigma_px=survey.sigma_px),
    )
    freer = adjusted(replace(compared.estimate, cameras=own_cameras), covariance=False)
    freed = freer.redundancy - compared.redundancy
    if not freer.converged or freed <= 0 or compared.redundancy <= 0:
        return None
    F = (freer.vPv - compared.vPv) / freed / compared.sigma0**2 if compared.sigma0 > 0 else np.inf
    fit = BetterFit(freer.rms_px, compared.rms_px, more)
    if f_isf(LEVEL, freed, compared.redundancy) > F or fit.times < MIN_RMS_RATIO:
        return None
    tested = contradicted_parameters(adjusted(freer.estimate, covariance=True))
    clear = tuple(dict.fromkeys(name for _, name in tested if name in more))
    return replace(fit, free=clear or more)
