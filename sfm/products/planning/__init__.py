"""Planning: the design of a network before anything is photographed.

- `compute_target_size`: the size of targets.
- `shape_object`, `object_of_points`, `object_of_mesh`: the object.
- `arrangement`, then `predict_network`: stations of textbooks, and the precision of photographs from them.
- `design_network`: stations that give the wanted precision; `further_photographs`: additions to a survey.
- `sight_of`, `depth_of_field`, `hidden_points` (by the `box_tree` of a mesh), `centre_covariance`: which
point is seen from which station, and how precisely.
- `calibratability`, `choose_coded`: whether the camera can be calibrated, and which targets must be coded.

    >>> from sfm.products.planning import compute_target_size
    >>> size = compute_target_size(p=10, w_mm=36.0, d=3000.0, c_mm=28.0, n=6000)
    >>> round(size.diameter, 2), round(size.ring, 2)  # mm, as the distance
    (6.43, 19.29)
"""

from __future__ import annotations

from sfm.runtime.public_names import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])

MIN_PIXELS = 7.0
"""across a target, as in document 000; targets can be measured from 3 px on"""
