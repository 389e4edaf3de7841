"""Calibration: how well a camera is known, where it is, and what would improve it.

- `calibrate`: begin here; what the result of a survey says about its cameras, `kolinear calibrate`.
- `projection_uncertainty`: where a camera images points at any distance, and how precisely.
- `cross_validate`: cameras of halves of the photographs, and whether chance explains their difference.
- `compare_models`: which parameters of its model the photographs bear.
- `spline_camera`: a camera with a surface of distortion, for a lens that no parametric model describes.
- `next_poses`: the photographs that would help most.

    >>> import numpy as np, sfm
    >>> from sfm.products.calibration import projection_uncertainty
    >>> # first: `.solution` of the result of run_survey, adjust or read_result
    >>> known = projection_uncertainty(sfm.adjust(first.network, first.estimate))
    >>> middle = known.camera.frame[None, :2]
    >>> known.sigma_at(middle, np.inf).shape, bool(known.sigma_at(middle, np.inf)[0] < 1.0)
    ((1,), True)
"""

from __future__ import annotations

from sfm.runtime.public_names import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])
