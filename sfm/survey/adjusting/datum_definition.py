"""Scale and place of a survey by its scale bars and control."""

from __future__ import annotations

from sfm.network import Network
from sfm.remarks.remark import Remark, remark
from sfm.survey.inputs.plate import is_plate_control, plate_control
from sfm.survey.inputs.survey import Survey


def datum_remarks(survey: Survey, network: Network, *, has_scale: bool) -> tuple[Remark, ...]:
    """Return remarks on control and scale bars that were not measured, and on a missing or assumed scale.

    Points of a plate may be out of view: nobody expects all of them in the result.
    """
    remarks, known = [], set(network.points)
    plate = is_plate_control(survey.control, plate_control(survey.targets))
    control = [name for name in survey.control.names if name not in known] if survey.control else []
    if control and not plate:
        remarks.append(remark("control_missing", points=control))
    if survey.targets.pitch_assumed and survey.targets.pitch is not None:
        remarks.append(remark("plate_pitch_assumed", pitch=(survey.targets.pitch, survey.unit)))
    bars = [f"{bar.start} - {bar.end}" for bar in survey.scale_bars if not {bar.start, bar.end} <= known]
    if bars:
        remarks.append(remark("scale_bars_missing", bars=bars))
    if not has_scale:
        remarks.append(remark("scale_undefined", unit=survey.unit))
    return tuple(remarks)
