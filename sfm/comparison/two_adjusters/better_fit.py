"""Whether the other adjuster's camera fits the image points better than that of the survey, and what to free.

COLMAP frees fx and fy, the principal point and the distortion in groups. Two adjusters can agree on a camera
that has more free than the survey's; that they agree then proves nothing about the survey.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.hypotheses.hypotheses import contradicted_parameters
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.camera import Camera
from sfm.comparison.camera_conversion import corresponding_free
from sfm.distributions import f_isf
from sfm.network import Estimate, Network

ALPHA = 0.001  # probability of the F-test where both cameras fit alike
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
    start = replace(compared.estimate, cameras=own_cameras)
    freer = _adjusted(network, start, survey.sigma_px, covariance=False)
    freed = freer.redundancy - compared.redundancy
    if not freer.converged or freed <= 0 or compared.redundancy <= 0:
        return None
    F = (freer.vPv - compared.vPv) / freed / compared.sigma0**2 if compared.sigma0 > 0 else np.inf
    found = BetterFit(freer.rms_px, compared.rms_px, more)
    if f_isf(ALPHA, freed, compared.redundancy) > F or found.times < MIN_RMS_RATIO:
        return None
    tested = contradicted_parameters(_adjusted(network, freer.estimate, survey.sigma_px, covariance=True))
    clear = tuple(dict.fromkeys(name for _, name in tested if name in more))
    return replace(found, free=clear or more)


def _held_there(cameras: tuple[Camera, ...], compared: tuple[Camera, ...]) -> tuple[str, ...]:
    """Return the parameters that the survey holds fixed and the comparison has free under another name."""
    names: dict[str, None] = {}
    for ours, theirs in zip(cameras, compared, strict=True):
        free = corresponding_free(theirs, ours.model) & ~ours.free
        names |= dict.fromkeys(name for name, on in zip(ours.names, free, strict=True) if on)
    return tuple(names)


def _adjusted(network: Network, start: Estimate, sigma_px: float, *, covariance: bool) -> Adjustment:
    return adjust(
        network, start, datum=Datum("free"), sigma_px=sigma_px, reject="none", covariance=covariance
    )
