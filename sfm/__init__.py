"""Kolinear: close-range photogrammetry from photographs to coordinates with their covariance.

    >>> import sfm
    >>> "adjust" in dir(sfm)
    True

`run_survey` runs a whole survey. Image points measured elsewhere go through `Network`, `orient` and `adjust`.
Large networks are adjusted on a cluster within `helmert_blocks`.
The methods underneath are in packages, each with a list of its public names and an example:

- `targets`, `matching`: measurement in photographs.
- `orientation`, `adjustment`: photographs and points from image points, with covariance and tests.
- `observations`: observations other than image points, also of one's own.
- `geometry`, `comparison`, `epochs`: shapes and tolerances, two results of one object, movements.
- `planning`: the precision that a network will reach, before anything is photographed.
- `textbook`: methods of the literature that a survey does not need.
- `camera`, `conventions`: cameras and their distortion, frames and rotations.

    >>> sfm.textbook.resect_church.__name__
    'resect_church'

Every name is listed in `__init__.pyi` and is imported when it is first used.
"""

from __future__ import annotations

from sfm.runtime.installation import refuse_mixed_installation
from sfm.runtime.public_names import public_names

refuse_mixed_installation()

_public, __dir__, __all__ = public_names(__name__, __path__[0])


def __getattr__(name: str) -> object:
    """Return a public name, or the version of the installation."""
    if name == "__version__":
        from importlib.metadata import version

        return version("kolinear")
    return _public(name)
