"""Comparison of solutions: two adjusters on one network, a survey with a baseline, two results of one object.

- `compare_results`: begin here; aligns two results by names and tests them.
- `compare_cameras`: two calibrations in px over the format, with their standard deviations.
- `compare`: compares two solutions of one network, as in `sfm.compare` and the report.
- `find_stable_points`, `robust_weights`: find points that did not move between two epochs.

`two_adjusters` gives two adjusters the same problem: equal weights, and cameras in one distortion model.

    >>> import numpy as np
    >>> from sfm.comparison import robust_weights
    >>> shift = np.tile(np.eye(3), (5, 1))  # the datum of five points leaves their position open
    >>> moved = np.array([[0.0, 0.1, 0], [0.1, 0, 0], [0, 0, 0.1], [0, 0, 0], [3, 0, 0]])
    >>> robust_weights(moved, shift, np.ones(5, dtype=bool)).round(2)  # the last moved
    array([0.57, 0.97, 0.57, 1.  , 0.02])
"""

from __future__ import annotations

from sfm.runtime.public_names import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])
