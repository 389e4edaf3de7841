"""Matching: find and measure the same points in several photographs, by texture or among unlabelled targets.

- `match_points`: begin here; it finds points of one photograph in another, by correlation and least squares.
- `match_ncc`: normalised cross-correlation in a search window; `match_lsm`: least squares matching.
- `find_tie_points` (from `natural_points`): points of natural texture in many photographs.
- `foerstner_points`: corners and centres of circles in the texture.
- `match_targets`: unlabelled targets in many oriented photographs.
- `epipolar_paths`: the lines, curved by distortion, along which a point can lie in another photograph.
- `radiometry_of`, `histogram`, `equalise_histogram`, `match_brightness`, `fit_radiometry`: mean, contrast and
  histogram of photographs, and how to adapt the brightness of one to another.
- `resample`: intensities between pixels.
- `MatchSettings`, `LsmSettings`, `NccLimits`, `TrackSettings`, `TargetLimits`: options of these functions.

    >>> import numpy as np
    >>> from sfm.matching import match_ncc
    >>> left = np.random.default_rng(1).integers(0, 255, (120, 120)).astype(np.uint8)
    >>> right = np.roll(left, (2, 5), axis=(0, 1))  # 2 px down, 5 px to the right
    >>> match_ncc(left, right, [[60, 60]], [[60, 60]], search_px=41).xy.round(1)
    array([[65., 62.]])
"""

from __future__ import annotations

from sfm.runtime.public_names import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])
