"""Targets in a photograph: detected, measured with covariance and decoded.

- `find_targets`: start here; it returns all targets of a photograph as `Targets`.
- `measure_edge_ellipses`: the ellipse through the edges of each target, with its covariance.

This package knows nothing of cameras, surveys or files. `outlines` finds candidates, `measure` fits them
(models in `fits/`), and `codes/` reads rings, square tags and plates.

    >>> import numpy as np
    >>> from sfm.targets import find_targets
    >>> y, x = np.mgrid[:60, :80]
    >>> disc = np.clip(12.5 - np.hypot(x - 40.3, y - 29.8), 0, 1)
    >>> find_targets((200 - 160 * disc).astype(np.uint8)).xy.round(1)  # px
    array([[40.3, 29.8]])
"""

from __future__ import annotations

from sfm.runtime.public_names import public_names

__getattr__, __dir__, __all__ = public_names(__name__, __path__[0])
