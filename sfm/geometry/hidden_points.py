"""Hidden points: on the line of two targets of a probe, at a known distance behind the second.

Source: Luhmann et al. (2020), Close-Range Photogrammetry and 3D Imaging, sec. 6.6 (hidden-point devices).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfm.arguments import checked_arguments
from sfm.errors import GeometryError
from sfm.geometry.functions import difference, joined, point_function
from sfm.geometry.measured import MeasuredPoints, coordinates_of


@checked_arguments()
def with_hidden_point(
    points: MeasuredPoints, name: str, start: str, end: str, distance: float, sigma: float = 0.0
) -> MeasuredPoints:
    """Return the points with a hidden one behind two targets.

    Args:
        points: of a result.
        name: of the new point.
        start: name of the first target.
        end: name of the second, nearer to the hidden point.
        distance: from the second target on, away from the first, object unit.
        sigma: its standard deviation, object unit.

    Raises:
        UnknownNameError: a target is not there.
        GeometryError: the name is taken, or both targets are in one place.

    Source: Luhmann et al. (2020), sec. 6.6.
    """
    if name in points.names:
        raise GeometryError(f"hidden point {name}: there is a point of that name already")
    a, b = point_function(points, start), point_function(points, end)
    d = difference(a, b)
    length = float(np.linalg.norm(d.value))
    if not length > 0:
        raise GeometryError(f"hidden point {name}: targets {start} and {end} are in one place")
    u = d.value / length
    along = distance * (np.eye(3) - np.outer(u, u)) / length
    found = joined([b, d]).times(np.hstack([np.eye(3), along]), b.value + distance * u)
    of_hidden = sigma**2 * np.outer(u, u) + points.covariance_between([found])
    Q = points.covariance
    if Q is not None and Q.ndim == 3:
        Q = np.concatenate([Q, of_hidden[None]])
    elif Q is not None:
        cross = found.jacobian @ Q[coordinates_of(found.points)]
        Q = np.block([[Q, cross.T], [cross, of_hidden]])
    sample, known = points.sample, points.sample_covariance
    if sample is not None and known is not None and points.correlated_among(found.points):
        place = np.full(len(points.names), -1)
        place[sample] = np.arange(len(sample))
        cross = found.jacobian @ known[coordinates_of(place[found.points])]
        known = np.block([[known, cross.T], [cross, of_hidden]])
        sample = np.append(sample, len(points.names))
    return replace(
        points,
        names=(*points.names, name),
        xyz=np.vstack([points.xyz, found.value]),
        covariance=Q,
        sample=sample,
        sample_covariance=known,
    )
