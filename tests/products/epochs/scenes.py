"""Epochs of a made-up object, adjusted from their image points."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.conventions import FloatArray
from sfm.model.distortion.models import Role
from sfm.model.estimate import Estimate
from sfm.model.network import InteriorObservations, Network
from sfm.products.epochs.differences import Epoch
from tests.synthetic import make_network, observed_anew, seed_of, stored_of

IMAGES, POINTS, NOISE_PX = 14, 60, 0.1
BARS = (("1", "31"), ("12", "50"))
BAR_SIGMA = 2e-4
CALIBRATION_SIGMA_PX = 0.05


@cache
def scene() -> tuple[Network, Estimate]:
    return make_network(seed_of("epochs"), images=IMAGES, points=POINTS, model="opencv", noise_px=0.0)


def epoch(
    seed: int,
    shift: FloatArray | None = None,
    *,
    bar_errors: FloatArray | None = None,
    given: float = 0.0,
    datum: str = "free",
    longer: float = 0.0,
    calibration: FloatArray | None = None,
) -> Epoch:
    """Return one epoch.

    Args:
        seed: of its noise.
        shift: of the points from the first epoch, object unit, (n, 3).
        bar_errors: of the lengths as stated, object unit, (2,); of its own if None.
        given: added to the stated lengths, object unit, so that they are others.
        datum: of the adjustment.
        longer: added to the focal lengths of its camera, px.
        calibration: its focal lengths as a certificate states them, within CALIBRATION_SIGMA_PX, (2,).
    """
    network, truth = scene()
    rng = np.random.default_rng(seed)
    now = truth if shift is None else replace(truth, points=truth.points + shift)
    lens = now.cameras[0]
    lens = lens.with_parameters(lens.parameters + longer * lens.plays(Role.FOCAL))
    now = replace(now, cameras=(lens,))
    network = observed_anew(network, now, NOISE_PX, rng)
    errors = BAR_SIGMA * rng.standard_normal(2) if bar_errors is None else bar_errors
    for (a, b), error in zip(BARS, errors.tolist(), strict=True):
        length = float(np.linalg.norm(now.points[int(a) - 1] - now.points[int(b) - 1]))
        network = network.with_scale_bar(a, b, length + error + given, BAR_SIGMA)
    interior: tuple[tuple[str, str, float, float], ...] = ()
    if calibration is not None:
        rows = np.flatnonzero(lens.plays(Role.FOCAL))
        network = network.with_given(
            InteriorObservations(
                np.zeros(2, dtype=np.int64), rows, calibration, np.full(2, CALIBRATION_SIGMA_PX)
            )
        )
        interior = tuple(
            (lens.name, lens.names[k], value, CALIBRATION_SIGMA_PX)
            for k, value in zip(rows.tolist(), calibration.tolist(), strict=True)
        )
    kind = Datum(datum, points=["1", "2", "3"] if datum == "minimal" else None)
    a = adjust(network, now, datum=kind, reject="none", options=AdjustmentOptions(sigma_px=NOISE_PX))
    name = f"epoch {seed}"
    return Epoch(
        name,
        stored_of(name, a),
        network.scale_bars,
        interior=interior,
        sigma0=a.sigma0,
        sigma0_px=a.sigma0_px,
    )
