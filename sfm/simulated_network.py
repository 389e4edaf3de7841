"""A network as it would be measured: image points and observations of every kind from true values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.arguments import checked_arguments
from sfm.camera import project
from sfm.network import Estimate, Network, rows_of, values_of


@checked_arguments()
def simulate_network(
    network: Network, truth: Estimate, rng: np.random.Generator | None = None
) -> tuple[Network, Estimate]:
    """Return a network with the values that a truth gives, and the truth.

    Args:
        network: gives what is measured, and how precisely; its values do not matter, but for coordinates
            of rigid frames and offsets, which are near what they will be.
        truth: true values of all unknowns.
        rng: source of the errors, normally distributed with the covariances stated; no errors if None.

    Returns:
        The network, and the truth; its points on lines are moved onto the line and off it by the errors that
        the observations state, unless there are none.
    """
    if rng is not None:
        for kind in network.kinds:
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
            control=network.control.simulated(values, rng),
            scale_bars=network.scale_bars.simulated(values, rng),
            exterior=network.exterior.simulated(values, rng),
            interior=network.interior.simulated(values, rng),
            observations=tuple(kind.simulated(values, rng) for kind in network.observations),
        ),
        truth,
    )
