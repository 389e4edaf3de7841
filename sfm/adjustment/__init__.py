"""Bundle adjustment with self-calibration.

- `adjust`: start here; it turns a network and start values into an `Adjustment` with covariance and tests.
- `predict`: the covariance of a planned network.
- `Datum`, `change_datum`: the definition of position, attitude and scale.
- `marginal_of`: joint covariances of points.
- `w_test`, `tau_test`: tests for gross errors in image coordinates.
- `estimate_error_correlation`, `with_error_correlation`, `with_neighbours`: errors that neighbouring image
  points have in common.

The computation is in `engine`, the assessment of quality in `quality`.

    >>> import numpy as np
    >>> import sfm
    >>> lens = sfm.camera_from_values("lens", "brown", (4000, 3000), (0.006, 0.006), c_mm=24.0)
    >>> points = np.random.default_rng(1).uniform(-1, 1, (12, 3))
    >>> centres = np.array([[-2.0, 0, 8], [2, 0, 8], [0, 2, 8], [0, -2, 8]])
    >>> xy = np.vstack([sfm.project(lens, centre, np.eye(3), points) for centre in centres])
    >>> network = sfm.Network.from_arrays(np.repeat(list("abcd"), 12), np.tile(range(12), 4).astype(str), xy)
    >>> start = sfm.orient(network, [lens]).estimate
    >>> adjustment = sfm.adjustment.adjust(network, start)
    >>> adjustment.converged, adjustment.redundancy  # 96 coordinates, 60 unknowns, 7 of the datum
    (True, 43)
"""

from __future__ import annotations

from sfm.runtime.public_names import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])
