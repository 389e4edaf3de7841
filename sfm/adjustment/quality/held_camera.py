"""Test of the interior parameters that an adjustment held: would freeing one lower v'Pv and move points?

The multiplier test: at the optimum one Newton step with the parameter freed lowers v'Pv by T = g'N^-1 g,
which over sigma0^2 is F distributed with 1 and r - 1 degrees of freedom where the value that was held is
right. A calibration that no longer holds bends the network without a trace in its standard deviations.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 4.6.4 (systematic errors).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.engine.iterate import newton_step, problem_of
from sfm.adjustment.engine.local_frame import local_of
from sfm.adjustment.engine.observed_unknowns import weighted_of
from sfm.adjustment.engine.unknowns import unknowns_of
from sfm.adjustment.result import Adjustment
from sfm.camera import Camera
from sfm.distortion.models import Role
from sfm.distributions import f_isf

ALPHA = 0.001  # probability with which right values are suspected, of all parameters together
MOVED = 1.0  # standard deviations by which the points must move (root mean square) for it to matter
MAX_TESTED = 24  # parameters that are freed one by one, a solution of the normal equations each
SMALLEST = 1e-3  # of v'Pv that may be left, over sigma0^2: residuals of exact observations are rounding


@dataclass(frozen=True)
class HeldParameter:
    """An interior parameter that was held at a value that the photographs contradict."""

    camera: str  # or the group of cameras that share it
    parameter: str
    value: float  # at which it was held
    change: float  # to what the photographs say, first step
    unit: str
    t: float  # change over its standard deviation, sign of the change
    moved: float  # by how much points would move, over their standard deviations with it freed, RMS


def held_parameters(
    adjustment: Adjustment, *, alpha: float = ALPHA, min_moved: float = MOVED
) -> tuple[HeldParameter, ...]:
    """Return the held interior parameters that the image points contradict, the clearest first.

    Args:
        adjustment: the adjustment, with its covariance.
        alpha: probability of naming any where all values are right.
        min_moved: standard deviations by which freeing it must move the points (root mean square).

    Returns:
        Those whose freeing would lower v'Pv significantly and move points by more than that;
        none where the redundancy is too small, or weights come from the residuals.
    """
    a = adjustment
    held = _held(a.estimate.cameras, set(a.network.camera.tolist()))
    if not held or a.reweighted or a.redundancy < 2 or not a.converged or not np.isfinite(a.sigma0):
        return ()
    found = []
    limit = float(f_isf(alpha / len(held), 1, a.redundancy - 1))
    if len(held) > 1:  # all at once first: seldom is there more to do
        whole = _freed(a, held)
        if whole is not None and whole[0] < limit:
            return ()
    for one in held[:MAX_TESTED]:
        tested = _freed(a, (one,))
        if tested is None:
            continue
        reduction, moved, change = tested
        # with sigma0 of the adjustment with the parameter freed
        share = (a.redundancy - 1) / max(a.redundancy - reduction, SMALLEST)
        f, moved = reduction * share, moved * float(np.sqrt(share))
        if f > limit and moved > min_moved:
            camera = next(c for c in a.estimate.cameras if (c.group_of(one[1]) or c.name) == one[0])
            found.append(
                HeldParameter(
                    one[0],
                    camera.names[one[1]],
                    float(camera.parameters[one[1]]),
                    change,
                    camera.units[one[1]],
                    float(np.copysign(np.sqrt(f), change)),
                    moved,
                )
            )
    return tuple(sorted(found, key=lambda parameter: -abs(parameter.t)))


def _held(cameras: tuple[Camera, ...], used: set[int]) -> tuple[tuple[str, int], ...]:
    """Return (camera or group, index) of each held parameter of the cameras that took part."""
    seen: dict[tuple[str, int], None] = {}
    for number, camera in enumerate(cameras):
        # the denominator of a fraction says the same as its numerator
        for s in np.flatnonzero(~camera.free & ~camera.plays(Role.DENOMINATOR)) if number in used else ():
            seen[camera.group_of(int(s)) or camera.name, int(s)] = None
    return tuple(seen)


def _freed(a: Adjustment, parameters: tuple[tuple[str, int], ...]) -> tuple[float, float, float] | None:
    """Return v'Pv saved over sigma0^2, root mean square move of the points, and change of the first one.

    None where the parameters cannot be determined.
    """
    cameras = tuple(_with_free(camera, parameters) for camera in a.estimate.cameras)
    datum = Datum(a.datum, a.datum_points).resolve(a.network)
    local = local_of(a.network, replace(a.estimate, cameras=cameras), datum)
    use_control = a.datum == "control"
    layout, state = unknowns_of(
        local.network, local.estimate, use_control=use_control, image_sigma_factor=a.image_sigma_factor
    )
    weighted = weighted_of(local.network, layout, use_control=use_control)
    problem = problem_of(layout, weighted, local.datum)
    weight = np.take(a.weights, layout.order) * layout.active
    step = newton_step(problem, state, weight)
    if step is None or step.motions.further:
        return None
    covariance = a.covariance.points if local.order is None else a.covariance.points[local.order]
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    known = sigma > 0
    moved = float(np.sqrt(((step.points[known] / sigma[known]) ** 2).mean())) if known.any() else 0.0
    owner, s = parameters[0]
    number = next(
        c for c, camera in enumerate(cameras)
        if (camera.group_of(s) or camera.name) == owner and s in layout.interior_free[c]
    )  # fmt: skip
    column = layout.interior_column[number][list(layout.interior_free[number]).index(s)]
    return step.predicted / a.sigma0**2, moved, float(step.reduced[column])


def _with_free(camera: Camera, parameters: tuple[tuple[str, int], ...]) -> Camera:
    """Return the camera with those of the parameters freed that are its own or its group's."""
    free = camera.free.copy()
    for owner, s in parameters:
        if (camera.group_of(s) or camera.name) == owner and s < len(free):
            free[s] = True
    return replace(camera, free=free)
