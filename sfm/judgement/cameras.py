"""Remarks on the cameras of a survey, and on photographs that are blurred."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sfm.adjustment.quality.consistency import Consistency, larger_than_the_others
from sfm.adjustment.quality.statistics import more_than_chance
from sfm.judgement.calibrated_cameras import CALIBRATION_FAILED, CalibratedCamera
from sfm.judgement.survey_result import PhotographTargets, SurveyResult
from sfm.model.conventions import FloatArray
from sfm.model.distortion.models import Role
from sfm.model.remarks.remark import Remark, remark, unless_note
from sfm.model.remarks.row import EXPECTED_SIGMAS, Quantity

DECENTRING_FRACTION = 0.02  # of the diagonal: decentring of a lens or sensor to be expected


def camera_remarks(result: SurveyResult, calibrated: tuple[CalibratedCamera, ...]) -> tuple[Remark, ...]:
    """Return the remarks on all cameras; on calibrated cameras, the remarks on how well they are known."""
    weak = _not_calibrated(result, calibrated) if calibrated else _poorly_determined(result)
    return (*weak, *_principal_points(result), *_pixels(result))


def _not_calibrated(result: SurveyResult, calibrated: tuple[CalibratedCamera, ...]) -> tuple[Remark, ...]:
    """Return remarks on calibrated cameras whose projection uncertainty is too large.

    If the camera is well known between the image points, the remark says that the margin of the photograph
    lacks image points.
    """
    sigma, remarks = result.adjustment.sigma0_px, list[Remark]()
    for camera in calibrated:
        rms = camera.projection_rms_px
        if np.isinf(rms):
            remarks.append(remark(CALIBRATION_FAILED, camera=camera.name))
            continue
        times = rms / sigma if sigma > 0 else None
        weak = remark("camera_not_calibrated", camera=camera.name, rms=(rms, "px"), times=times)
        if remark("camera_not_calibrated", rms=camera.observed_rms_px, times=times).severity == "note":
            numbers = {**weak.numbers, "observed": Quantity(camera.observed)}
            weak = replace(weak, kind="margin_not_calibrated", numbers=numbers)
        remarks += unless_note(weak)
    return tuple(remarks)


def _poorly_determined(result: SurveyResult) -> tuple[Remark, ...]:
    """Return remarks on principal distances that the photographs hardly determine, as with long lenses."""
    strong = {correlation.parameter: correlation.partners for correlation in result.orientation_correlations}
    of_owner: dict[str, tuple[Remark, ...]] = {}
    for number, camera in enumerate(result.adjustment.estimate.cameras):
        name, c = camera.names[0], float(camera.parameters[0])
        sigma = float(result.adjustment.interior_sigma(number)[0])
        owner = camera.owner_of(0)
        if np.isfinite(sigma):
            share, partners = sigma / abs(c), strong.get(f"{name} of camera {owner}")
            of_c = remark("c_hardly_determined", parameter=name, camera=owner, share=share, partners=partners)
            of_owner.setdefault(owner, unless_note(of_c))
    return tuple(of_c for remarks in of_owner.values() for of_c in remarks)


def _principal_points(result: SurveyResult) -> tuple[Remark, ...]:
    """Return remarks on implausible adjusted principal points, and on the format they are the centre of."""
    remarks: list[Remark] = []
    for number, camera in enumerate(result.adjustment.estimate.cameras):
        if not camera.free[camera.parts[1]].any():
            continue
        at, (width, height) = camera.principal_point_px, camera.size_px
        diagonal = float(np.hypot(width, height))
        away = float(np.hypot(at[0] - width / 2, at[1] - height / 2) / diagonal)
        sigmas = np.nan_to_num(result.adjustment.interior_sigma(number)[camera.parts[1]], nan=0.0)  # 0: held
        sigma_px = float(sigmas.max()) / (float(np.mean(camera.pixel_mm)) if camera.in_mm else 1.0)
        sigma = sigma_px / diagonal
        surely = away - EXPECTED_SIGMAS * sigma
        off_lenses = away / float(np.hypot(sigma, DECENTRING_FRACTION))
        off = remark(
            "principal_point_far",
            camera=camera.name,
            share=away,
            sigma=sigma,
            surely=surely,
            off_lenses=off_lenses if sigma > DECENTRING_FRACTION else None,
        )
        far = unless_note(off)
        remarks += far
        other = _format_around(at, width, height) if far else None
        if other is not None:
            remarks.append(
                remark("format_of_other_size", camera=camera.name, width=other[0], height=other[1])
            )
    return tuple(remarks)


def _pixels(result: SurveyResult) -> tuple[Remark, ...]:
    """Return remarks on adjusted affinity and shear of pixels that no sensor has."""
    remarks: list[Remark] = []
    for number, camera in enumerate(result.adjustment.estimate.cameras):
        sigma = dict(zip(camera.names, result.adjustment.interior_sigma(number).tolist(), strict=True))
        values = dict(zip(camera.names, camera.parameters.tolist(), strict=True))
        adjusted = camera.free & camera.plays(Role.AFFINITY, Role.SHEAR)
        shares = {
            name: values[name]
            for name, is_adjusted in zip(camera.names, adjusted, strict=True)
            if is_adjusted and abs(values[name]) > EXPECTED_SIGMAS * sigma[name]
        }
        if camera.free[camera.parts[0]].sum() == 2:  # a focal length for each direction
            first, second = np.flatnonzero(camera.parts[0])
            ratio = camera.parameters[second] / camera.parameters[first]
            ratio *= camera.pixel_mm[1] / camera.pixel_mm[0]
            of_ratio = np.hypot(*(sigma[camera.names[k]] / camera.parameters[k] for k in (first, second)))
            if abs(ratio - 1) > EXPECTED_SIGMAS * of_ratio:
                shares[f"{camera.names[second]} / {camera.names[first]} - 1"] = float(ratio) - 1
        for name, value in shares.items():
            remarks += unless_note(
                remark("pixels_distorted", camera=camera.name, parameter=name, share=abs(value))
            )
    return tuple(remarks)


def _format_around(at: FloatArray, width: int, height: int) -> tuple[int, int] | None:
    """Return the format centred at a position: sides exchanged, doubled or halved; None without one."""
    formats = [(height, width), *((round(s * width), round(s * height)) for s in (0.5, 2.0))]
    for size_px in formats:
        if np.linalg.norm(at - np.array(size_px) / 2) < DECENTRING_FRACTION * np.hypot(*size_px):
            return size_px
    return None


def edges_of(photographs: Sequence[PhotographTargets]) -> dict[str, float]:
    """Return the median blur of target edges, one sigma, px, by photograph; none where none is known."""
    median_blur = {}
    for photograph in photographs:
        blur = np.zeros(0) if photograph.blur is None else photograph.blur[np.isfinite(photograph.blur)]
        if len(blur):
            median_blur[photograph.image] = float(np.median(blur))
    return median_blur


def sharpness_remarks(
    result: SurveyResult, edges: Mapping[str, float], consistency: Consistency
) -> tuple[Remark, ...]:
    """Return remarks on blurred photographs if blur explains large residuals, few points or absence.

    Photographs are compared within their camera, since lens, pixels and format, and with them the edges,
    differ between cameras.
    """
    a = result.adjustment
    m, n = len(a.network.images), len(a.network.points)
    unseen = n - np.bincount(a.network.image_points.image[~a.rejected], minlength=m)
    level = a.levels.family
    few = np.flatnonzero(more_than_chance(unseen, np.full(m, n), level))
    suspected = {photograph.image for photograph in result.failed} | {a.network.images[i] for i in few}
    if consistency.uneven is not None:
        suspected.add(consistency.uneven.worst)
    cameras: dict[str, list[str]] = {}
    for photograph in result.photographs:
        if photograph.image in edges:
            cameras.setdefault(photograph.camera, []).append(photograph.image)
    remarks = []
    for camera, names in cameras.items():
        blur = np.array([edges[name] for name in names])
        large = larger_than_the_others(np.log(blur), level=level / len(cameras))
        blurred = [
            name for name, is_large in zip(names, large, strict=True) if is_large and name in suspected
        ]
        if blurred:
            remarks.append(
                remark(
                    "photographs_blurred",
                    photographs=blurred,
                    blur=(max(edges[name] for name in blurred), "px"),
                    camera=camera if len(cameras) > 1 else None,
                    others=(float(np.median(blur[~large])), "px"),
                )
            )
    return tuple(remarks)
