"""Whether adjusted principal distances are near the given ones, and what held ones are worth.

Few photographs of a flat object let the principal distance run away along with the distance from it, to a
false minimum with a small standard deviation; nothing but its start value tells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.camera import base_name
from sfm.distortion.models import MODELS
from sfm.network import Estimate
from sfm.remarks.remark import Remark, remark
from sfm.survey.inputs.plate import plate_family
from sfm.survey.inputs.survey import Survey

FAR = 0.2  # relative change of c, as focusing from infinity to 1 : 5 makes it: c = f (1 + 1/5), thin lens


def far_principal_distances(survey: Survey, estimate: Estimate, sigma: Sequence[float]) -> tuple[Remark, ...]:
    """Return a remark for each principal distance that lies far from the one that the survey gives.

    One that was held there has been found by trial, and nothing has tested it.

    Args:
        survey: whose cameras state `c_mm`; those by EXIF data are not looked at, nor those that photograph a
            plate of known coordinates: no distance runs away from it.
        estimate: adjusted cameras.
        sigma: standard deviation of the principal distance of each, in its unit.
    """
    if _calibrates(survey):
        return ()
    given = {one.name: one.c_mm for one in survey.cameras if one.c_mm is not None}
    remarks = []
    for camera, s in zip(estimate.cameras, sigma, strict=True):
        start = given.get(camera.name)
        if start is None:
            continue
        found = camera.c_px * float(np.mean(camera.pixel_mm))
        if abs(found / start - 1) <= FAR:
            continue
        if not camera.free[0]:
            held = remark("c_held_elsewhere", camera=camera.name, given=(start, "mm"), found=(found, "mm"))
            remarks.append(held)
        else:
            remarks.append(
                remark(
                    "c_far_from_given",
                    camera=camera.name,
                    given=(start, "mm"),
                    found=(found, "mm"),
                    change=(100 * (found / start - 1), "%"),
                    share=s / abs(float(camera.parameters[0])),
                )
            )
    return tuple(remarks)


def contradicted(held: tuple[str, ...], causes: tuple[Remark, ...]) -> tuple[Remark, ...]:
    """Return a remark where the residuals have a cause and c was held at a value that nobody measured."""
    if not held or not causes:
        return ()
    return (remark("c_held_contradicted", cameras=held),)


def not_calibrated(survey: Survey, estimate: Estimate) -> tuple[Remark, ...]:
    """Return a remark for each camera that photographs of a plate should calibrate, with c held after all.

    Args:
        survey: says what is free of its cameras, or leaves it to the photographs.
        estimate: adjusted cameras; those of single photographs are named by these behind that of the survey.
    """
    if not _calibrates(survey):
        return ()
    remarks, names = [], [one.name for one in survey.cameras]
    for one in survey.cameras:
        name = MODELS[one.model].names[0]
        own = [camera for camera in estimate.cameras if base_name(camera.name, names) == one.name]
        held = next((camera for camera in own if not camera.free[0]), None)
        if name in one.may_be_free and held is not None:
            value = held.c_px * float(np.mean(held.pixel_mm))
            remarks.append(remark("calibration_failed", camera=one.name, held=(value, "mm")))
    return tuple(remarks)


def _calibrates(survey: Survey) -> bool:
    """Return whether the points of a survey are those of a plate of known coordinates."""
    return plate_family(survey.targets) is not None and survey.datum.kind == "control"
