"""Whether adjusted principal distances are near the given ones, and whether held ones are contradicted.

Few photographs of a flat object let the principal distance run away along with the distance from it, to a
false minimum with a small standard deviation; nothing but its start value tells.
"""

from __future__ import annotations

import numpy as np

from sfm.network import Estimate
from sfm.result import Explanation
from sfm.survey.inputs.survey import Survey

FAR = 0.2  # relative change of c; focusing from infinity to 1 : 5 changes it by as much


def far_principal_distances(survey: Survey, estimate: Estimate) -> tuple[str, ...]:
    """Return a line for each adjusted principal distance that lies far from the one that the survey gives.

    Args:
        survey: whose cameras state `c_mm`; those by EXIF data are not looked at.
        estimate: adjusted cameras.
    """
    given = {one.name: one.c_mm for one in survey.cameras if one.c_mm is not None}
    lines = []
    for camera in estimate.cameras:
        start = given.get(camera.name)
        if start is None or not camera.free[0]:
            continue
        found = camera.c_px * float(np.mean(camera.pixel_mm))
        if abs(found / start - 1) > FAR:
            lines.append(
                f"camera {camera.name}: c was adjusted from {start:g} to {found:.4g} mm, by "
                f"{100 * (found / start - 1):+.0f} %: a wrong start value, or a network that does not "
                "determine it; give c from a calibration or add photographs from other distances"
            )
    return tuple(lines)


def contradicted(held: tuple[str, ...], explanations: tuple[Explanation, ...]) -> tuple[str, ...]:
    """Return a line where the residuals have a cause and c had to be held at a value that nobody measured."""
    if not held or not explanations or not explanations[0].explains:
        return ()
    return (
        f"c of camera {', '.join(held)}: it had to be held at its start value, and the residuals say that "
        "something does not fit; give a calibrated camera, or add photographs at larger angles",
    )
