"""Observations other than image points, and the base classes of observations of one's own.

- `Network.with_observations`: begin here; adds observations of any kind to a network.
- `HeightDifferences`, `Distances`, `ZenithAngles`, `Planes`, `RigidFrames` ...: the kinds of survey tables.
- `PointPairs`, `RowKind`, `Group`, `Kind`: base classes, from the most convenient to the most general.

An observation of one's own is a class with its names, and what it computes with its derivatives. Its
residuals, redundancy numbers, tests and variance component follow:

    >>> import numpy as np
    >>> import sfm
    >>> from sfm.model.observations import PointPairs
    >>> class Slopes(PointPairs):
    ...     "Slopes between two points, dZ over their distance."
    ...     name, single, components = "slopes", "slope", ("slope",)
    ...     @classmethod
    ...     def computed(cls, d):
    ...         length = np.linalg.norm(d, axis=1, keepdims=True)
    ...         slope = d[:, 2:] / length
    ...         return slope, ((np.array([0, 0, 1]) - slope * d / length) / length)[:, None]
    >>> # first: `.solution` of the result of run_survey, adjust or read_result
    >>> start, end = [first.network.point_index(name) for name in "123"], [3, 4, 5]
    >>> levelled = Slopes(np.array(start), np.array(end), np.zeros((3, 1)), np.full((3, 1), 1e-3))
    >>> network = first.network.with_observations(levelled)
    >>> found = sfm.adjust(network, first.estimate)
    >>> [f"{kind.name}: {len(kind)}" for kind in found.network.further]
    ['slopes: 3']
    >>> float(found.observed[-1].redundancy_numbers.max()) < 1  # the last kind of the network
    True
"""

from __future__ import annotations

from sfm.runtime.public_names import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])
