"""Change of the mounts of a rig between two epochs: T = d' (Q_1 + Q_2)^-1 d over its degrees of freedom.

Values given alike to both epochs, as a scale bar, make the true variance of d smaller than Q_1 + Q_2: the
test then finds less, and does not find what is not there.

Source: Niemeier (2008), Ausgleichungsrechnung, sec. 12.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.comparison.point_tests import known_scale
from sfm.comparison.stable_points import critical_value
from sfm.conventions import FloatArray, angles_from_rotation
from sfm.solution import Solution


@dataclass(frozen=True)
class MountChange:
    """A camera on its rig in two epochs."""

    camera: str
    difference: FloatArray  # second minus first: X, Y, Z (object unit of the first; NaN where not both epochs
    # have a scale), omega, phi, kappa (rad), (6,)
    sigma: FloatArray  # (6,)
    statistic: float  # T
    critical: float

    @property
    def changed(self) -> bool:
        """Whether the camera was moved on its rig."""
        return self.statistic > self.critical


def mount_changes(
    first: Solution, second: Solution, *, alpha: float, redundancy: int | None
) -> tuple[MountChange, ...]:
    """Test the mounts that two epochs have adjusted, all of them together at one level.

    Args:
        first: an epoch.
        second: a later one.
        alpha: level of the tests of all mounts.
        redundancy: of both; None if their variances are known.
    """
    scale = known_scale(first, second)
    ours, theirs = _mounts(first, 1.0), _mounts(second, scale or 1.0)
    common = [name for name in ours if name in theirs]
    tested = np.arange(6) if scale is not None else np.arange(3, 6)
    found = []
    for name in common:
        (a, Q_a), (b, Q_b) = ours[name], theirs[name]
        d, Q = b - a, Q_a + Q_b
        d[3:] = (d[3:] + np.pi) % (2 * np.pi) - np.pi
        sigma = np.sqrt(np.diagonal(Q))
        if scale is None:
            d[:3] = sigma[:3] = np.nan
        part = Q[np.ix_(tested, tested)]
        statistic = float(d[tested] @ np.linalg.solve(part, d[tested])) / len(tested)
        critical = critical_value(alpha / len(common), len(tested), redundancy)
        found.append(MountChange(name, d, sigma, statistic, critical))
    return tuple(found)


def _mounts(result: Solution, scale: float) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return values and covariance of the mounts of a result that were adjusted, by camera."""
    mounts, Q = result.estimate.mounts, result.mount_covariance
    if mounts is None or Q is None:
        return {}
    unit = np.repeat([scale, 1.0], 3)
    values = unit * np.hstack([mounts.position, angles_from_rotation(mounts.rotation)])
    Q = unit[:, None] * Q * unit
    on = mounts.free.any(axis=1) & np.isfinite(Q).all(axis=(1, 2))
    on &= (np.diagonal(Q, axis1=1, axis2=2) > 0).all(axis=1)
    return {result.estimate.cameras[a].name: (values[a], Q[a]) for a in np.flatnonzero(on)}
