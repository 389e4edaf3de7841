"""Textbook methods that a survey does not need, for study and comparison.

- Resection of one photograph: `resect_p4p`, `resect_rampal`, `resect_zeng_wang`, `resect_church`,
  `resect_dlt`, `resect_unknown_noise`. All take the measured rays and the points, `(tangents, points)`,
  followed by a start if they need one. The DLT also determines the camera, and takes image coordinates in mm
  instead of rays. `resect` and `resect_by_all` select a method by name.
- Steps of the resection: `distance_quartic` and its `positive_roots`, `trilaterate` with `direction_test`,
  `pope_hinsken`. `cylinder_distance` states how well three points determine the position.
- Pairs: `orient_dependent`, `orient_independent` with the five classical parameters, whose model
  `intersect_pair` computes, `orient_direct` onto control in one step, `make_normal_images`.
- Scanned and aerial photographs: `orient_fiducials`, `photo_from_pixel`, `pixel_from_photo`.
  `correct_photo_coordinates` applies `radial_from_table`, `refraction_coefficient` and
  `curvature_displacement`; `distort_photo_coordinates` reverses them. `compute_photo_coordinates` simulates a
  photograph.
- Matching: `match_along_line`, `match_pyramid`.
- Adjustment: `adjust_separately`, which adjusts points and photographs in turn.

Each docstring names its source.

    >>> import numpy as np
    >>> from sfm.orientation import tangents_of
    >>> from sfm.textbook import resect_church, resect_zeng_wang
    >>> points = np.array([[0.0, 0, 0], [4, 0, 1], [4, 3, 0], [0, 3, 1]])
    >>> tangents = tangents_of([2, 1, 10], np.eye(3), points)
    >>> resect_zeng_wang(tangents, points)[0].position.round(6)
    array([ 2.,  1., 10.])
    >>> resect_church(tangents, points, [1, 1, 8]).position.round(6)
    array([ 2.,  1., 10.])
"""

from __future__ import annotations

from sfm.runtime.public_names import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])
