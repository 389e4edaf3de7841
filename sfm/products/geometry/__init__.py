"""Geometry from coordinates: distances and angles, best-fit shapes, alignment, tolerances.

- `MeasuredPoints`: input of all functions; `measured_points` extracts it from a solution.
- `fit_shape`: start here; line, plane, circle, ellipse, sphere, cylinder, cone, torus, paraboloid.
- `point_function`, and from it `distance`, `angle_at`, `height`, `distance_from_axis`, `angle_of_directions`,
  `coordinates_in`: functions of coordinates with their covariance.
- `align_321`, `align_features`, `align_points`: the coordinate system of a part.
- `Tolerance`, `deviations_from_points`, `deviations_from_mesh`, `deviations_from_shape`, `decide`: conformity
  with tolerances.
- `with_hidden_point`: a point at the end of a rod with two targets.

Every quantity keeps its derivatives by the coordinates of the points. So its covariance, and the joint
covariance of any quantities, follow from the covariance of the network.

    >>> import numpy as np
    >>> from sfm.products.geometry import MeasuredPoints, distance, fit_shape, point_function
    >>> corners = np.array([[0.0, 0, 5], [3, 0, 5], [3, 4, 5], [0, 4, 5]])
    >>> points = MeasuredPoints(tuple("abcd"), corners, np.tile(0.01**2 * np.eye(3), (4, 1, 1)))
    >>> distance(point_function(points, "a"), point_function(points, "c")).value
    array([5.])
    >>> fit_shape(points, "plane").deviation.round(6)
    array([0., 0., 0., 0.])
"""

from __future__ import annotations

from sfm.runtime.public_names import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])
