"""Remarks on the cameras of a survey: hardly determined, where no lens has them."""

from __future__ import annotations

import numpy as np

from sfm.remarks.remark import Remark, remark, unless_note
from sfm.result import SurveyResult


def camera_remarks(result: SurveyResult) -> tuple[Remark, ...]:
    """Return the remarks on all cameras."""
    return (*_hardly_determined(result), *_principal_points(result))


def _hardly_determined(result: SurveyResult) -> tuple[Remark, ...]:
    """Return principal distances that the photographs hardly determine, as those of long lenses."""
    strong = {one.parameter: one.partners for one in result.orientation_correlations}
    found: dict[str, tuple[Remark, ...]] = {}
    for number, camera in enumerate(result.adjustment.estimate.cameras):
        name, c = camera.names[0], float(camera.parameters[0])
        sigma = float(result.adjustment.interior_sigma(number)[0])
        owner = camera.group_of(0) or camera.name
        if np.isfinite(sigma):
            partners = strong.get(f"{name} of camera {owner}")
            one = remark(
                "c_hardly_determined", parameter=name, camera=owner, share=sigma / abs(c), partners=partners
            )
            found.setdefault(owner, unless_note(one))
    return tuple(one for remarks in found.values() for one in remarks)


def _principal_points(result: SurveyResult) -> tuple[Remark, ...]:
    """Return adjusted principal points that lie where no lens has them."""
    remarks: list[Remark] = []
    for camera in result.adjustment.estimate.cameras:
        names = ("x0", "y0") if camera.in_mm else ("cx", "cy")
        x, y = (camera.value(name) for name in names)
        size = np.array(camera.size_px) * (camera.pixel_mm if camera.in_mm else 1.0)
        if not camera.in_mm:
            x, y = x - (camera.size_px[0] - 1) / 2, y - (camera.size_px[1] - 1) / 2
        away = float(np.hypot(x, y) / np.linalg.norm(size))
        if camera.free[[camera.names.index(name) for name in names]].any():
            remarks += unless_note(remark("principal_point_far", camera=camera.name, share=away))
    return tuple(remarks)
