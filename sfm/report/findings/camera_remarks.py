"""Remarks on the cameras of a survey: held at wrong values, hardly determined, where no lens has them."""

from __future__ import annotations

import numpy as np

from sfm.adjustment.quality.held_camera import HeldParameter
from sfm.remarks.remark import Remark, remark, unless_note
from sfm.result import SurveyResult
from sfm.survey.inputs.settings import FREED_FIRST


def camera_remarks(result: SurveyResult, held: tuple[HeldParameter, ...]) -> tuple[Remark, ...]:
    """Return the remarks on all cameras.

    Args:
        result: of a survey.
        held: interior parameters held at values that the photographs contradict, the clearest first.
    """
    return (*_contradicted(result, held), *_hardly_determined(result), *_principal_points(result))


def _contradicted(result: SurveyResult, held: tuple[HeldParameter, ...]) -> tuple[Remark, ...]:
    """Return the clearest of the parameters that were held, since those that go with it follow."""
    if not held:
        return ()
    worst = held[0]
    unit = "" if worst.unit == "1" else worst.unit
    return (
        remark(
            "parameter_contradicted",
            parameter=worst.parameter,
            camera=worst.camera,
            value=(worst.value, unit),
            found=(worst.value + worst.change, unit),
            t=abs(worst.t),
            moved=worst.moved,
            free=free_line(result, held),
        ),
    )


def free_line(result: SurveyResult, held: tuple[HeldParameter, ...]) -> str:
    """Return what to write into the survey file so that the camera fits: the usual ones, those named."""
    cameras = result.adjustment.estimate.cameras
    own = (one for one in cameras if held and held[0].camera in (one.name, *one.shared))
    camera = next(own, cameras[0])
    named = {one.parameter for one in held}
    free = {name for name, on in zip(camera.names, camera.free, strict=True) if on}
    written = [f'"{name}"' for name in camera.names if name in {*free, *named, *FREED_FIRST}]
    return f"free = [{', '.join(written)}] for camera {camera.name}"


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
