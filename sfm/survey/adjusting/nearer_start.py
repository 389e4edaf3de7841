"""Start values nearer to the minimum of a network whose adjustment does not converge.

With long lenses all rays of a photograph are nearly parallel: principal distance, distance of the photographs
and depth of the object can hardly be distinguished, Gauss-Newton creeps along a bent valley, and the object
turned inside out in depth is a minimum of its own. With the cameras held at their start values there is no
such valley; from where that ends the cameras are freed.

Source: Foerstner and Wrobel (2016), Photogrammetric Computer Vision, sec. 13.3.6 (affine cameras, reversal).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.other_solutions import scaled
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.camera import Camera
from sfm.depth_reversal import reverse_depth
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.remarks.remark import Remark, remark

DAMPED_ITERATIONS, UNDAMPED_ITERATIONS = 50, 300  # with the cameras held, where a step is cheap
NEAR = 1e-3  # |A dx| / |v| that is near enough for a start


def nearer_start(network: Network, start: Estimate, ended: Estimate, datum: Datum) -> Estimate | None:
    """Return start values by an adjustment with all cameras held, of the smaller v'Pv of both depths.

    Args:
        network: what is adjusted.
        start: start values from which its adjustment did not converge.
        ended: where that adjustment ended.
        datum: of the adjustment.

    Returns:
        The cameras as in the start values; None where nothing converges.
    """
    found = [one for one in (_held(network, one, datum) for one in _candidates(start, ended, datum)) if one]
    if not found:
        return None
    best = min(found, key=lambda one: one.vPv)
    return replace(best.estimate, cameras=start.cameras)


def held_to_converge(before: tuple[Camera, ...], after: tuple[Camera, ...]) -> tuple[Remark, ...]:
    """Return a remark for each camera of which parameters were held that were free before."""
    names: dict[str, tuple[str, ...]] = {}
    for one, held in zip(before, after, strict=True):
        lost = np.flatnonzero(one.free & ~held.free)
        if len(lost):
            names[one.owner_of(int(lost[0]))] = tuple(one.names[s] for s in lost)
    return tuple(
        remark("held_to_converge", camera=camera, parameters=parameters)
        for camera, parameters in names.items()
    )


def _candidates(start: Estimate, ended: Estimate, datum: Datum) -> Iterator[Estimate]:
    """Yield where the adjustment ended, brought back to c of the start, and the start; each reflected too."""
    factor = start.cameras[0].c_px / ended.cameras[0].c_px
    back = replace(scaled(ended, factor), cameras=start.cameras) if factor > 0 else start
    for one in (back, start):
        yield one
        if datum.kind != "control":
            yield reverse_depth(one)


def _held(network: Network, start: Estimate, datum: Datum) -> Adjustment | None:
    """Return the adjustment with all cameras held, at first damped; None if it does not converge."""
    values = replace(
        start, cameras=tuple(replace(one, free=np.zeros_like(one.free)) for one in start.cameras)
    )
    for method, steps in (("levenberg-marquardt", DAMPED_ITERATIONS), ("gauss-newton", UNDAMPED_ITERATIONS)):
        try:
            a = adjust(
                network,
                values,
                datum=datum,
                reject="none",
                method=method,
                max_iterations=steps,
                tolerance=NEAR,
                covariance=False,
            )
        except GeometryError:
            return None
        if a.rejected.any() or not np.isfinite(a.vPv):
            return None
        if a.converged:
            return a
        values = a.estimate
    return None
