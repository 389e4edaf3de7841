"""Comparison of two adjusters on one network, with a camera that both can estimate.

Two adjusters are compared on what both can do: the accepted image points with equal weights, no control and
no scale bars, and one functional model, which for a survey in `brown` is `full_opencv`. Cameras that share
single parameters get one each, for adjusters that know no such sharing.

With all twelve parameters free, full_opencv is near to singular: a factor common to the numerator and
the denominator of its radial term changes nothing, and COLMAP frees the distortion as a whole or not at
all. Where the image points cannot separate k1-k3 from k4-k6, the distortion is therefore held at the survey's
result in both adjusters, and the comparison reports it.

Whether the other adjuster's camera fits the image points better than that of the survey is tested too: COLMAP
frees fx and fy, the principal point and the distortion in groups. Two adjusters can agree on a camera
that has more free than the survey's; that they agree then proves nothing about the survey.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, Protocol

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.hypotheses.hypotheses import contradicted_parameters
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.camera import Camera
from sfm.comparison.camera_conversion import Conversion, convert_camera, corresponding_free
from sfm.comparison.solutions import ROUNDING_PX, Comparison, compare
from sfm.conventions import BoolArray, FloatArray
from sfm.display import counted, program_name
from sfm.distortion.models import Role
from sfm.distributions import chi2_isf, f_isf
from sfm.errors import GeometryError
from sfm.network import Estimate, ImagePoints, Network
from sfm.reduced_network import reduce_network, supported
from sfm.runtime.progress import report_step

MIN_RAYS, MIN_POINTS = 2, 3  # photographs that determine a point, points that determine a photograph
# The weak directions of full_opencv take more steps than a survey. That k1 to k6 have grown a thousandfold
# does not show whether they converge: of 32 random networks that had not after 40 steps, 25 did by 200.
MAX_ITERATIONS = 200
ALPHA = 0.05  # of the chi-square test whether the image points distinguish two solutions, with 1 freedom
Outcome = Literal["agrees", "fits alike", "differs"]
CAMERA_ALPHA = 0.001  # probability of the F-test where both cameras fit alike
MIN_RMS_RATIO = 1.1  # times; below it the difference is not seen in the coordinates


@dataclass(frozen=True)
class BetterFit:
    """A camera with more free parameters that fits the image points significantly better."""

    own_rms_px: float  # per coordinate, the survey's camera, equal weights, px
    rms_px: float  # the camera of the comparison, px
    free: tuple[str, ...]  # what of the survey's cameras is held and should be free: "b1", clearest first

    @property
    def times(self) -> float:
        """How many times smaller the residuals are."""
        return self.own_rms_px / self.rms_px if self.rms_px > 0 else np.inf


@dataclass(frozen=True)
class AdjusterComparison:
    """Two adjusters on the same network, model, weights and start values."""

    backend: str  # the other adjuster
    model: str  # functional model of both
    conversions: tuple[Conversion, ...]  # of each camera from the survey's model; misfit 0 if it is the same
    freed: tuple[str, ...]  # cameras with more free parameters than the survey's, in words
    held: tuple[str, ...]  # why the distortion was held at the survey's result; empty if it was free
    network: Network  # accepted image points with unit weights, as both had them
    adjustment: Adjustment  # the in-house one in that model
    backend_iterations: int  # steps of the other adjuster
    backend_converged: bool
    comparison: Comparison
    backend_points: (
        FloatArray | None
    )  # the other's covariances of the points with photographs and cameras held
    # (conditional), scaled by our sigma0, object unit^2, (n, 3, 3); None where it has none
    unshared: tuple[str, ...] = ()  # what cameras share in the survey and was held at its result, in words
    better: BetterFit | None = None  # than the camera of the survey, where the compared one has more free
    stopped_early: bool = False  # whether going on from the other's solution leads to the in-house one

    @property
    def agree(self) -> bool:
        """Whether both found the same optimum, though the other adjuster may have stopped short of it."""
        if not self.adjustment.converged:
            return False
        return self.stopped_early or (self.comparison.agree and self.backend_converged)

    @property
    def gap(self) -> float:
        """Difference of v'Pv of the two, in variances of an image coordinate."""
        a, b = self.comparison.cost
        sigma = max(self.adjustment.sigma0 * self.adjustment.sigma_px, ROUNDING_PX)
        return 2 * abs(b - a) / sigma**2

    @property
    def outcome(self) -> Outcome:
        """Whether they agree, fit alike (the image points do not distinguish them), or differ."""
        if self.agree:
            return "agrees"
        return "fits alike" if self.gap <= chi2_isf(ALPHA, 1) else "differs"


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
        """Whether it reports that it has converged."""

    @property
    def seconds(self) -> float:
        """Time of the adjustment alone, s."""

    @property
    def point_covariance(self) -> FloatArray | None:
        """Of the points, photographs and cameras held, for image coordinates of 1 px; None without."""


def compare_adjusters(
    adjustment: Adjustment,
    backend: Callable[[Network, Estimate], BackendAdjustment],
    *,
    name: str = "colmap",
    model: str | None = None,
) -> AdjusterComparison:
    """Run the in-house adjuster and another one on the accepted image points of a survey.

    Both start from the survey's result with its cameras converted, all image coordinates have the same
    weight, and the datum is free.

    Args:
        adjustment: of the survey.
        backend: the other adjuster, a function of network and start values.
        name: of the backend.
        model: functional model of both; that of the survey if COLMAP has it, else full_opencv.

    Raises:
        GeometryError: nothing is left to compare.
        BackendError: the backend refuses.
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
            "denominator of "
            "the rational distortion cancelling",
        )
    while True:
        if held:
            start = replace(start, cameras=tuple(distortion_held(camera) for camera in start.cameras))
            ours = _adjusted(network, start, adjustment.sigma_px)
        report_step(f"adjusting with {program_name(name)}")
        theirs = backend(network, start)
        found = compare(
            ours.estimate, theirs.estimate, network, covariance=ours.covariance, names=("kolinear", name)
        )
        if not ours.converged or (found.agree and theirs.converged):
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
        found,
        None if conditional is None else (ours.sigma0 * ours.sigma_px) ** 2 * conditional,
        unshared,
        better_fit(adjustment, network, ours),
        stopped_early,
    )


def _adjusted(network: Network, start: Estimate, sigma_px: float) -> Adjustment:
    return adjust(
        network, start, datum=Datum("free"), sigma_px=sigma_px, reject="none", max_iterations=MAX_ITERATIONS
    )


def without_sharing(cameras: tuple[Camera, ...]) -> tuple[tuple[Camera, ...], tuple[str, ...]]:
    """Return the cameras unshared, with what they share held fixed at its value, and what that is, in words.

    COLMAP shares all parameters of a camera among its photographs or none. Parameters that several cameras
    share in part, such as one distortion for photographs that differ in c, can only be held at the survey's
    result.

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

    Left are photographs that are oriented and show three points, points in two photographs, and accepted
    image points, each with the covariance sigma_px^2 I. Parameters of a group that COLMAP frees as a
    whole (focal lengths, principal point, distortion) are all free if one of them is, and in all cameras
    that are not fixed.

    Raises:
        GeometryError: fewer than two photographs with accepted image points.
    """
    estimate = adjustment.estimate
    cameras = estimate.cameras
    if model is None:
        one = {camera.model for camera in cameras}
        model = one.pop() if len(one) == 1 and not cameras[0].in_mm else "full_opencv"
    conversions = tuple(convert_camera(camera, model) for camera in cameras)
    converted = tuple(conversion.camera for conversion in conversions)
    grouped = grouped_free(converted)
    freed = tuple(
        f"{camera.name}: " + ", ".join(np.array(camera.names)[now.free & ~camera.free])
        for camera, now in zip(converted, grouped, strict=True)
        if (now.free & ~camera.free).any()
    )
    accepted = ~adjustment.rejected
    images, points = supported(
        adjustment.network, estimate, accepted, min_points=MIN_POINTS, min_rays=MIN_RAYS
    )
    if images.sum() < 2:
        raise GeometryError("comparison: fewer than two photographs with accepted image points are left")
    network, start = reduce_network(
        adjustment.network, replace(estimate, cameras=grouped), images, points, accepted
    )
    seen = network.image_points
    unit = np.tile(np.eye(2) * adjustment.sigma_px**2, (len(seen), 1, 1))
    # Nothing but image points: no control, scale bars or other observations.
    network = Network(
        network.images,
        network.camera,
        network.points,
        ImagePoints(seen.image, seen.point, seen.xy, unit),
        moment=network.moment,
    )
    return network, start, conversions, freed


def grouped_free(cameras: tuple[Camera, ...]) -> tuple[Camera, ...]:
    """Return cameras whose free parameters are whole groups, the same in all that are not fixed."""
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
    """Return by how much the camera of the comparison fits better; None where it does not.

    Args:
        survey: adjustment of the survey, with its cameras.
        network: image points with equal weights, as both adjusters had them.
        compared: the in-house adjustment of that network with the cameras of the comparison.
    """
    own_cameras = survey.estimate.cameras
    more = _held_there(own_cameras, compared.estimate.cameras)
    if not more or not compared.converged:
        return None
    adjusted = partial(adjust, network, datum=Datum("free"), sigma_px=survey.sigma_px, reject="none")
    freer = adjusted(replace(compared.estimate, cameras=own_cameras), covariance=False)
    freed = freer.redundancy - compared.redundancy
    if not freer.converged or freed <= 0 or compared.redundancy <= 0:
        return None
    F = (freer.vPv - compared.vPv) / freed / compared.sigma0**2 if compared.sigma0 > 0 else np.inf
    found = BetterFit(freer.rms_px, compared.rms_px, more)
    if f_isf(CAMERA_ALPHA, freed, compared.redundancy) > F or found.times < MIN_RMS_RATIO:
        return None
    tested = contradicted_parameters(adjusted(freer.estimate, covariance=True))
    clear = tuple(dict.fromkeys(name for _, name in tested if name in more))
    return replace(found, free=clear or more)


def _held_there(cameras: tuple[Camera, ...], compared: tuple[Camera, ...]) -> tuple[str, ...]:
    """Return the parameters that the survey holds fixed and the comparison has free under another name."""
    names: dict[str, None] = {}
    for ours, theirs in zip(cameras, compared, strict=True):
        free = corresponding_free(theirs, ours.model) & ~ours.free
        names |= dict.fromkeys(name for name, on in zip(ours.names, free, strict=True) if on)
    return tuple(names)
