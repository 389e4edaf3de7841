"""Whether a network has more observations than unknowns, in one line where it has not."""

from __future__ import annotations

import numpy as np

from sfm.display import counted
from sfm.errors import GeometryError
from sfm.network import Estimate, Network
from sfm.observations.kind import is_observed

MOTIONS = 7  # of a network whose position, attitude and scale the datum fixes


def refuse_too_few_observations(network: Network, estimate: Estimate, datum: str) -> None:
    """Raise GeometryError if a network has no redundancy, so that nothing could be checked or judged.

    Args:
        network: the part that is to be adjusted.
        estimate: its cameras say what is free.
        datum: kind of datum; control and observed exterior orientation count in that of control.
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
        known = sum(int(((one == 0) | is_observed(one)).sum()) for one in variances)
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
        "and datum conditions for "
        f"{counted(unknowns, 'unknown')}{free}, more are needed{advice}"
    )
