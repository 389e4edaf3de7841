"""Orientation: from measured image points to approximate values of photographs and object points.

- `orient`: start here; it orients a whole network from its image points alone.
- `resect_robust`: one photograph on known points, some of which may be wrong. `resect_fischler_bolles` needs
  three points (by the roots of `leg_quartic`; `choose_by_line` selects the true solution).
  `resect_least_squares` starts from an approximate orientation and gives the covariance. `expected_trials` is
  the number of samples.
- `relative_orientations`: two photographs from conjugate rays alone, for any scene; `refine_coplanarity`
  adjusts them.
- `intersect`: object points from the rays of oriented photographs.
- `orient_absolute`: a model onto control.
- `OrientSettings`, `RayLimits`: the options of `orient` and `intersect`.

Rays are tangents u = -U/W, v = -V/W; `sfm.model.camera.tangents_from_pixel` computes them from pixels. Other
methods for resection, pairs and scanned photographs are in `sfm.textbook`.

    >>> import numpy as np
    >>> from sfm.orientation import resect_robust, tangents_of
    >>> points = np.array([[0.0, 0, 0], [4, 0, 1], [4, 3, 0], [0, 3, 1], [2, 1, 2]])
    >>> tangents = tangents_of([2, 1, 10], np.eye(3), points)  # of a camera above them that looks down
    >>> tangents[4] += 0.1  # a gross error
    >>> found = resect_robust(tangents, points, tolerance=0.001)
    >>> found.position.round(6), found.inliers
    (array([ 2.,  1., 10.]), array([ True,  True,  True,  True, False]))
"""

from __future__ import annotations

from sfm.runtime.public_names import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])
