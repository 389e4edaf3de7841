"""Remarks on the solution of a survey: on its datum, missing points, cameras and scale.

With few photographs of a flat object, the principal distance may run away together with the object distance,
to a false minimum with a small standard deviation. Only a comparison with its start value shows this.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from sfm.adjustment.result import Adjustment
from sfm.judgement.survey_result import LeftOutPoint
from sfm.model.camera import Camera, base_name
from sfm.model.conventions import BoolArray, IntArray
from sfm.model.distortion.models import MODELS
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.model.observations.kind import Group
from sfm.model.observations.pose import MountObservations
from sfm.model.remarks.remark import Remark, remark, together
from sfm.survey.inputs.calibration import is_plate_control, plate_control, plate_family
from sfm.survey.inputs.settings import CameraSettings
from sfm.survey.inputs.survey import Survey
from sfm.survey.observation_tables import unused_observations
from sfm.survey.placing import mounts_give_scale, scale_sigma

WEAK_SCALE = 0.01  # a scale with a larger relative standard deviation is reported
# Relative change of c by focusing from infinity to 1 : 5: c = f (1 + 1/5), thin lens.
MAX_C_CHANGE = 0.2
# Relative difference of the sides of a pixel; no camera sensor has such a difference.
MIN_SIDE_DIFFERENCE = 0.005


def remarks_on_solution(
    survey: Survey, left_out: tuple[LeftOutPoint, ...], network: Network, adjustment: Adjustment
) -> tuple[Remark, ...]:
    """Return the remarks on a solution that a person must know beside the numbers.

    Args:
        survey: settings of the survey.
        left_out: measured points that are not in the result.
        network: all measured points.
        adjustment: the final adjustment.
    """
    sigma_of_c = [float(adjustment.interior_sigma(k)[0]) for k in range(len(adjustment.estimate.cameras))]
    missing = missing_control(survey, adjustment.network, left_out)
    absent = [name for name in survey.datum.points if name not in set(adjustment.network.points)]
    no_datum = (remark("names_missing", of="datum", names=absent),) if absent else ()
    return (
        *adjustment.remarks,
        *remarks_on_left_out(
            tuple(point for point in left_out if point.point not in missing),
            network,
            {point.point for point in survey.check_points},
        ),
        *no_datum,
        *remarks_on_principal_distances(survey, adjustment.estimate, sigma_of_c),
        *remarks_on_pixel_sides(survey.cameras, adjustment.estimate.cameras),
        *datum_remarks(survey, adjustment.network, missing, has_scale=adjustment.has_scale),
        *unused_observations(survey.tables, survey.copied, adjustment.network),
        *weak_scale(adjustment),
        *scale_alone(adjustment),
    )


def posed_by_rigs(adjustment: Adjustment, needed: IntArray) -> tuple[Remark, ...]:
    """Return the note on photographs that have a pose by their rig alone.

    Args:
        adjustment: the final adjustment.
        needed: image points that determine and check the pose of each photograph without its rig, (m,).
    """
    network = adjustment.network
    if network.moment is None:
        return ()
    of_accepted = network.image_points.image[~adjustment.rejected]
    accepted = np.bincount(of_accepted, minlength=len(network.images))
    together = np.bincount(network.moment)[network.moment] > 1
    few = np.flatnonzero(together & (accepted < needed))
    if not len(few):
        return ()
    fewest = few[np.argmax((needed - accepted)[few])]
    names = [network.images[i] for i in few]
    return (
        remark(
            "photographs_posed_by_rig",
            photographs=names,
            accepted=int(accepted[fewest]),
            needed=int(needed[fewest]),
        ),
    )


def windows_elsewhere(network: Network, remarks: Sequence[Remark]) -> tuple[Remark, ...]:
    """Return the remarks; windows on texture did not move, but are matched at other positions.

    Named points may be among them, but are not most of them. All that are matched elsewhere are one remark,
    as a person does the same with each. A single window that is seen at two positions is left out: it has no
    name that a person could correct.
    """
    texture, windows = network.automatic_points, network.windows

    def are_windows(names: tuple[str, ...]) -> bool:
        return windows.issuperset(names) and 2 * len(texture.intersection(names)) > len(names)

    elsewhere = [
        said for said in remarks if said.kind == "points_moved" and are_windows(said.names("points"))
    ]
    joined = replace(together(elsewhere), kind="windows_elsewhere") if elsewhere else None
    return tuple(
        joined if joined is not None and said is elsewhere[0] else said
        for said in remarks
        if not any(said is other for other in elsewhere[1:])
        and (said.kind != "two_places" or said.names("point")[0] not in texture)
    )


def handedness_unchecked(network: Network, *, checked: bool) -> tuple[Remark, ...]:
    """Return the note that given image points would also fit the mirror image of the object.

    The mirror image of an object in mirrored photographs has the same residuals as the object.

    Args:
        network: knows the sources of its image points.
        checked: whether given values exclude the mirror image.
    """
    if checked or not all(source.is_exact for source in network.sources):
        return ()
    return (remark("handedness_unchecked"),)


def weak_scale(a: Adjustment) -> tuple[Remark, ...]:
    """Return the remark on a scale that only survey observations give, with low precision."""
    network = a.network
    given = a.datum == "control" or len(network.scale_bars) or len(network.control.complete) >= 2
    if given or mounts_give_scale(network, a.estimate) or not network.further or not a.has_scale:
        return ()
    sigma = scale_sigma(network, a.estimate)
    names = list(dict.fromkeys(kind.name for kind in network.further))
    return (remark("scale_weak", observations=names, sigma=(100 * sigma, "%")),) if sigma > WEAK_SCALE else ()


def scale_alone(a: Adjustment) -> tuple[Remark, ...]:
    """Return the note on a scale that rests on one mount or one table; bars and control have theirs."""
    network, mounts = a.network, a.estimate.mounts
    if a.datum == "control" or len(network.scale_bars) or len(network.control.complete) >= 2:
        return ()
    sources = []
    for kind in network.further:
        if isinstance(kind, MountObservations):
            sources += [f"the mount of {name}" for name in kind.names(network, a.estimate)]
        elif np.isfinite(scale_sigma(network.with_given(further=(kind,)), a.estimate)):
            name = f"{kind.single} {kind.group}" if isinstance(kind, Group) else kind.name
            sources.append(f"the {name}")
    if mounts is not None:
        held = mounts.position.any(axis=1) & ~mounts.free.any(axis=1)
        sources += [f"the mount of {a.estimate.cameras[k].name}" for k in np.flatnonzero(held)]
    return (remark("scale_unchecked", given=sources[0]),) if len(sources) == 1 else ()


def datum_remarks(
    survey: Survey, network: Network, missing: Collection[str], *, has_scale: bool
) -> tuple[Remark, ...]:
    """Return remarks on control and scale bars that were not measured, and on a missing or assumed scale.

    Args:
        survey: states control, scale bars and targets.
        network: network of the result.
        missing: names of control that is not in the result.
        has_scale: whether anything gives the network a scale.
    """
    remarks, known = [], set(network.points)
    if missing:
        remarks.append(remark("names_missing", of="control", names=missing))
    if survey.targets.pitch_assumed and survey.targets.pitch is not None:
        remarks.append(remark("plate_pitch_assumed", pitch=(survey.targets.pitch, survey.unit)))
    bars = [f"{bar.start} - {bar.end}" for bar in survey.scale_bars if not {bar.start, bar.end} <= known]
    if bars:
        remarks.append(remark("names_missing", of="bars", names=bars))
    if not has_scale:
        seen = None if survey.control is None else len(network.control.complete)
        remarks.append(remark("scale_undefined", unit=survey.unit, control=seen, needed=2))
    return tuple(remarks)


def missing_control(survey: Survey, network: Network, left_out: tuple[LeftOutPoint, ...]) -> tuple[str, ...]:
    """Return the names of control that is not in the result, and has no remark of its own.

    Points of a plate may be out of view, so not all of them are expected in the result. Those that
    contradict, and check points, are named where they are left out.

    Args:
        survey: states control.
        network: network of the result.
        left_out: measured points that are not in the result.
    """
    if survey.control is None or is_plate_control(survey.control, plate_control(survey.targets)):
        return ()
    checks = {check.point for check in survey.check_points}
    named = {point.point for point in left_out if point.point in checks or point.reason.severity != "note"}
    return tuple(name for name in survey.control.names if name not in named.union(network.points))


def left_out_points(
    network: Network,
    in_result: tuple[str, ...],
    *,
    reasons: tuple[tuple[str, Remark], ...],
    accepted_rays: IntArray,
    needed: IntArray,
) -> tuple[LeftOutPoint, ...]:
    """Return the measured points that are not in a result, each with the reason.

    Args:
        network: all measured points.
        in_result: names of the points of the result.
        reasons: (name, reason) of points for which the orientation found no coordinates.
        accepted_rays: accepted rays of each point at its removal, (n,).
        needed: rays that each point needs, (n,).
    """
    known, rays = dict(reasons), network.rays()
    kept = set(in_result)
    out = []
    for j, name in enumerate(network.points):
        if name in kept or not rays[j]:
            continue
        if rays[j] < needed[j]:
            reason = remark("points_not_determined", rays=int(rays[j]), needed=int(needed[j]))
        elif name in known:
            reason = known[name]
        elif accepted_rays[j] >= needed[j]:
            reason = remark("points_not_determined", measured=int(rays[j]), least=int(needed[j]))
        else:
            reason = remark(
                "points_contradicted",
                accepted=int(accepted_rays[j]),
                measured=int(rays[j]),
                needed=int(needed[j]),
            )
        out.append(LeftOutPoint(name, int(rays[j]), reason))
    return tuple(out)


def unused_image_points(network: Network, images: BoolArray, points: BoolArray) -> int:
    """Return the number of image points outside the photographs, (m,), and points, (n,), of the result."""
    seen = network.image_points
    return int((~(images[seen.image] & points[seen.point])).sum())


def remarks_on_left_out(
    left_out: tuple[LeftOutPoint, ...], network: Network, checks: Collection[str] = ()
) -> tuple[Remark, ...]:
    """Return the remarks on points that are not in the result: contradicted, or only not determined.

    Args:
        left_out: measured points that are not in the result, with the reason.
        network: all measured points. A person can correct those that keep their names; those of natural
            texture are a test.
        checks: names of check points.
    """
    texture = network.automatic_points
    automatic = [point for point in left_out if point.point in texture]
    listed = [point for point in left_out if point.point not in texture]
    groups = {
        "points_contradicted": [point.point for point in listed if point.reason.severity != "note"],
        "points_not_determined": [point.point for point in listed if point.reason.severity == "note"],
    }
    measured = len(network.points)
    remarks = []
    if automatic:
        remarks.append(remark("points_left_out", points=len(automatic), measured=measured))
    for kind, names in groups.items():
        if names:
            of_checks = [name for name in names if name in checks] or None
            remarks.append(remark(kind, points=names, measured=measured, checks=of_checks))
    return tuple(remarks)


def remarks_on_principal_distances(
    survey: Survey, estimate: Estimate, sigma: Sequence[float]
) -> tuple[Remark, ...]:
    """Return a remark for each principal distance that is far from the one that the survey states.

    A principal distance held at such a value was found by trial, and nothing has tested it.

    Args:
        survey: its cameras state `c_mm`. Cameras with c from EXIF data are not judged, nor cameras that
            photograph a plate of known coordinates, since the plate fixes the distance.
        estimate: has the adjusted cameras.
        sigma: standard deviation of the principal distance of each camera, in its unit.
    """
    if _is_calibration(survey):
        return ()
    given = {camera.name: camera.c_mm for camera in survey.cameras if camera.c_mm is not None}
    assumed = {camera.name for camera in survey.cameras if camera.c_assumed}
    remarks = []
    for camera, s in zip(estimate.cameras, sigma, strict=True):
        start = given.get(camera.name)
        if start is None:
            continue
        c_mm = camera.c_px * float(np.mean(camera.pixel_mm))
        if abs(c_mm / start - 1) <= MAX_C_CHANGE:
            continue
        if not camera.free[0]:
            held = remark("c_held_elsewhere", camera=camera.name, given=(start, "mm"), found=(c_mm, "mm"))
            remarks.append(held)
        elif camera.name not in assumed:
            remarks.append(
                remark(
                    "c_far_from_given",
                    camera=camera.name,
                    given=(start, "mm"),
                    found=(c_mm, "mm"),
                    change=(100 * (c_mm / start - 1), "%"),
                    share=s / abs(float(camera.parameters[0])),
                )
            )
    return tuple(remarks)


def remarks_on_held_c(held: tuple[str, ...], causes: tuple[Remark, ...]) -> tuple[Remark, ...]:
    """Return a remark if the residuals have a cause and c was held at a value that was not measured.

    Args:
        held: names of the cameras whose c was held.
        causes: remarks on causes of the residuals.
    """
    if not held or all(cause.severity == "note" for cause in causes):
        return ()
    return (remark("c_held_contradicted", cameras=held),)


def remarks_on_uncalibrated(survey: Survey, estimate: Estimate) -> tuple[Remark, ...]:
    """Return a remark for each camera that a plate should calibrate, but whose c was held in the end.

    Args:
        survey: may state the free parameters of its cameras.
        estimate: has the adjusted cameras; a per-photograph camera has the name of its camera followed by
            that of the photograph.
    """
    if not _is_calibration(survey):
        return ()
    remarks, names = [], [camera.name for camera in survey.cameras]
    for settings in survey.cameras:
        name = MODELS[settings.model].names[0]
        cameras = [camera for camera in estimate.cameras if base_name(camera.name, names) == settings.name]
        held = next((camera for camera in cameras if not camera.free[0]), None)
        if name in settings.may_be_free and held is not None:
            value = held.c_px * float(np.mean(held.pixel_mm))
            remarks.append(remark("calibration_failed", camera=settings.name, held=(value, "mm")))
    return tuple(remarks)


def _is_calibration(survey: Survey) -> bool:
    """Return whether the points of a survey are on a plate of known coordinates."""
    return plate_family(survey.targets) is not None and survey.datum.kind == "control"


def remarks_on_pixel_sides(
    settings: Sequence[CameraSettings], cameras: Sequence[Camera]
) -> tuple[Remark, ...]:
    """Return a remark on each camera whose nominal sensor size implies pixels that are not square.

    Args:
        settings: cameras of the survey. A stated pixel size is not judged, nor a camera with b1, or fx and
            fy, among its free parameters: there the photographs determine the ratio.
        cameras: cameras of the solution; a per-photograph camera has the name of its camera followed by that
            of the photograph.
    """
    names = [stated.name for stated in settings]
    first = {base_name(camera.name, names): camera for camera in reversed(cameras)}
    remarks = []
    for stated in settings:
        known = "b1" in stated.adjusted or {"fx", "fy"} <= set(stated.adjusted)
        if stated.name not in first or stated.pixel_mm is not None or known:
            continue
        width, height = first[stated.name].pixel_mm.tolist()
        ratio = width / height - 1
        if abs(ratio) >= MIN_SIDE_DIFFERENCE:
            remarks.append(
                remark(
                    "pixels_not_square",
                    camera=stated.name,
                    where="sensor_mm" if stated.sensor_mm is not None else "EXIF data",
                    width=(1000 * width, "µm"),
                    height=(1000 * height, "µm"),
                    off=(100 * abs(ratio), "%"),
                    side=((width * height) ** 0.5, "mm"),
                )
            )
    return tuple(remarks)
