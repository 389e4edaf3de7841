"""Choice of free interior parameters where the survey states none: those that its network determines.

A lens that is held at nominal values bends the network. Parameters that a network does not determine cost
precision and may lead to a false minimum. Candidates are c, x0, y0, K1 and K2, and on calibration plates also
P1, P2 and b1, which otherwise bias c and the principal point. The worst determined parameter
is held, one after the other, until the network determines all the others better than they are known of any
camera. Then the test of held parameters frees others that the image points demand. Three photographs fit many
values of c, each with another shape of the object. For three photographs c is therefore an observation, with
the precision of a focal length from EXIF data.

Source: Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 7.3.2 (self-calibration).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.judgement.hypotheses.hypotheses import contradicted_parameters
from sfm.model.camera import KNOWN_WITHOUT, Camera, corner_shift
from sfm.model.conventions import BoolArray
from sfm.model.distortion.models import MODELS, Role
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, without_given
from sfm.model.reduced_network import reduce_network, select_supported
from sfm.model.remarks.remark import Remark, remark
from sfm.survey.inputs.calibration import plate_family
from sfm.survey.inputs.cameras import split_cameras
from sfm.survey.inputs.settings import CameraSettings
from sfm.survey.inputs.survey import Survey

MIN_PHOTOGRAPHS = 3  # in a free network; a pair determines almost no parameter of a camera
FEWEST_PHOTOGRAPHS = {"control": 1}  # by the kind of datum, where it is not MIN_PHOTOGRAPHS
MIN_DETERMINING_C = 4  # photographs of a free network that determine c
# Relative sigma of c from EXIF data. Focusing from infinity to 1 : 5 changes c by twice as much, c = f (1 +
# 1/5).
C_SIGMA = 0.1
RATIO_SIGMA = 1e-3  # sigma of the ratio of two focal lengths, which is the ratio of the sides of a pixel
MIN_RAYS, MIN_IMAGE_POINTS = 2, 4  # needed by a point, and by a photograph, to take part in the decision
ROUNDS = 3  # of the test of held parameters
# Order of holding if precision does not decide; the others follow from the last of the model to the first.
FIRST_HELD = ("K2", "k2", "y0", "x0", "cy", "cx")
OF_PLATES = (Role.DECENTRING, Role.AFFINITY)  # roles of further candidates on calibration plates

Chosen = list[set[str] | None]  # free parameters of each camera; None where the survey states them


@dataclass(frozen=True)
class FreeParameters:
    """Free parameters of the cameras of a survey."""

    cameras: tuple[CameraSettings, ...]  # each states its free parameters, and whether c is observed
    estimate: Estimate  # with the same parameters free in its cameras; observed ones keep their values
    remarks: tuple[Remark, ...]  # on each camera whose free parameters the survey does not state
    accepted: BoolArray | None = None  # image points that the last adjustment accepted, (k,)


def choose_free_parameters(
    survey: Survey, network: Network, estimate: Estimate, *, datum: str = "free", extend: bool = True
) -> FreeParameters:
    """Choose the interior parameters to adjust for every camera of a survey.

    Args:
        survey: may state the free parameters of its cameras.
        network: has one camera for each camera of the survey, in the same order.
        estimate: start values; photographs and points without them take no part in the decision.
        datum: kind of datum; control takes part where photographs by themselves do not determine c.
        extend: whether parameters beyond the candidates are tried.

    Returns:
        The settings with the free parameters of each camera, and the estimate. Both are unchanged if the
        survey states the free parameters of every camera.
    """
    silent = [a for a, camera in enumerate(survey.cameras) if not camera.states_free]
    if not silent:
        return FreeParameters(survey.cameras, estimate, ())
    names: Chosen = [None] * len(survey.cameras)
    on_plates = plate_family(survey.targets) is not None
    for a in silent:
        of_plates = MODELS[survey.cameras[a].model].names_of(*OF_PLATES) if on_plates else ()
        names[a] = {*survey.cameras[a].may_be_free, *of_plates}
    estimate = _with_free(estimate, names)
    everything = np.ones(len(network.image_points), dtype=bool)
    images, points = select_supported(
        network, estimate, everything, min_points=MIN_IMAGE_POINTS,
        min_rays=np.full(len(network.points), MIN_RAYS),
    )  # fmt: skip
    settings = list(survey.cameras)
    determined: list[Chosen] = []
    accepted: BoolArray | None = None
    if images.sum() >= FEWEST_PHOTOGRAPHS.get(datum, MIN_PHOTOGRAPHS):
        part, start = reduce_network(network, estimate, images, points, everything)
        trials = []
        if images.sum() >= MIN_DETERMINING_C:  # control may be wrong, and hide what the image points demand
            trials = [(without_given(part), "free")]
        elif datum != "control":
            observed = sorted(set(silent) & set(part.camera.tolist()))
            for a in observed:
                settings[a] = _with_observed_c(settings[a], start.cameras[a])
            of_part = [
                stated if a in observed else CameraSettings(name=stated.name)  # stays as it was
                for a, stated in enumerate(settings)
            ]
            part, start = split_cameras(of_part, without_given(part), start)
            trials = [(part, "free")]
        if datum == "control":
            trials.append((part, datum))
        alarm = survey.adjust.false_alarm
        for tried, kind in trials:
            chosen_names, adjusted = _determined_parameters(tried, start, names, kind, alarm, extend=extend)
            determined.append(chosen_names)
            if adjusted is not None and kind == "free":
                accepted = everything.copy()
                rows = images[network.image_points.image] & points[network.image_points.point]
                accepted[rows] = ~adjusted.rejected
            if _has_each_c(start, names, determined[-1]):
                break
        else:
            del determined[1:]  # control does not determine each c either
    for a in silent:
        chosen = (determined[-1][a] if determined else None) or set()
        free = chosen.difference(dict(settings[a].weighted))
        in_order = tuple(name for name in MODELS[settings[a].model].names if name in free)
        names[a] = free
        settings[a] = settings[a].model_copy(update={"free": in_order})
    remarks = [
        said
        for a in silent
        for said in _remarks(settings[a], estimate.cameras[a].units, int(images[network.camera == a].sum()))
    ]
    return FreeParameters(tuple(settings), _with_free(estimate, names), tuple(remarks), accepted)


def _with_observed_c(settings: CameraSettings, camera: Camera) -> CameraSettings:
    """Return the settings with c, or the focal lengths, as observations.

    The observed value is that of the survey file, else the start value, which EXIF data give.
    """
    start_mm = camera.c_px * float(np.mean(camera.pixel_mm))
    c = camera.parameters * ((settings.c_mm or start_mm) / start_mm)
    focal = np.flatnonzero(camera.plays(Role.FOCAL))
    rho = 1 - (RATIO_SIGMA / C_SIGMA) ** 2 / 2
    return settings.model_copy(
        update={
            "c_mm": None,  # the observed value gives it
            "weighted": tuple((camera.names[s], (float(c[s]), C_SIGMA * abs(float(c[s])))) for s in focal),
            "correlations": tuple((camera.names[focal[0]], camera.names[s], rho) for s in focal[1:]),
        }
    )


def _has_each_c(start: Estimate, asked: Chosen, chosen: Chosen) -> bool:
    """Return whether c is free for each camera whose c was a candidate."""
    c = [camera.names[0] for camera in start.cameras]
    each = zip(c, asked, chosen, strict=True)
    return all(name in (free or ()) for name, may, free in each if name in (may or ()))


def _determined_parameters(
    part: Network, start: Estimate, names: Chosen, datum: str, false_alarm: float, *, extend: bool
) -> tuple[Chosen, Adjustment | None]:
    """Return the candidates that a network determines, with others that its image points demand.

    The last adjustment is returned too.
    """
    names, adjusted = _hold_undetermined(part, start, names, datum, false_alarm)
    index = {camera.name: a for a, camera in enumerate(start.cameras) if names[a]}
    for _ in range(ROUNDS if extend else 0):
        demanded = () if adjusted is None else contradicted_parameters(adjusted)
        wider = list(names)
        for camera, parameter in demanded:
            if camera in index:
                wider[index[camera]] = (wider[index[camera]] or set()) | {parameter}
        if adjusted is None or wider == names:
            break
        tried, adjusted = _hold_undetermined(
            part, adjusted.estimate, wider, datum, false_alarm, adjusted.rejected
        )
        if adjusted is None or tried == names:
            break
        names = tried
    return names, adjusted


def _hold_undetermined(
    part: Network,
    start: Estimate,
    names: Chosen,
    datum: str,
    false_alarm: float,
    rejected: BoolArray | None = None,
) -> tuple[Chosen, Adjustment | None]:
    """Hold the worst parameters one by one until all others are determined; also the last adjustment.

    Observed parameters are never held: they take part with the precision of their values. Each adjustment
    begins without the image points that the one before rejected.
    """
    observed = set(zip(part.interior.camera.tolist(), part.interior.parameter.tolist(), strict=True))
    while any(names):
        adjusted = _adjust_or_none(part, _with_free(start, names), datum, false_alarm, rejected)
        rejected = rejected if adjusted is None else adjusted.rejected
        worst, reach = None, KNOWN_WITHOUT
        for a, chosen in enumerate(names):
            index = start.cameras[a].names.index
            free = [name for name in chosen or () if (a, index(name)) not in observed]
            first = [name for name in FIRST_HELD if name in free]
            for name in first + sorted(set(free).difference(first), key=index, reverse=True):
                now = np.inf
                if adjusted is not None:  # the shift by one sigma, in half diagonals
                    sigma = float(adjusted.interior_sigma(a)[index(name)])
                    now = corner_shift(adjusted.estimate.cameras[a], index(name), sigma)
                if now > reach:
                    worst, reach = (a, name), now
        if worst is None:
            return names, adjusted
        names = [
            None if chosen is None else chosen - {worst[1]} if a == worst[0] else chosen
            for a, chosen in enumerate(names)
        ]
    return names, None


def _adjust_or_none(
    part: Network, start: Estimate, datum: str, false_alarm: float, rejected: BoolArray | None
) -> Adjustment | None:
    """Adjust the free parameters; None if the adjustment fails or does not determine everything.

    What the start values leave open drifts through hundreds of steps, until the rank defect ends it.
    """
    if _is_open(part, start, datum):
        return None
    try:
        adjustment = adjust(
            part,
            start,
            datum=Datum(datum),
            false_alarm=false_alarm,
            rejected=rejected,
            options=AdjustmentOptions(redundancy_numbers=False),
        )
    except (GeometryError, np.linalg.LinAlgError):
        return None
    # points with rejected rays add to the rank defect, which is none of the cameras
    rays = np.bincount(part.image_points.point[~adjustment.rejected], minlength=len(part.points))
    known = np.zeros(len(part.points), dtype=np.int64)  # coordinates, from control
    if adjustment.datum == "control":
        variance = np.diagonal(part.control.covariance, axis1=1, axis2=2)
        np.maximum.at(known, part.control.point, np.isfinite(variance).sum(axis=1))
    left = np.where(rays == 0, 3, np.where(rays == 1, 1, 0))
    allowed = adjustment.expected_defect + int(np.maximum(left - known, 0).sum())
    return adjustment if adjustment.converged and adjustment.defect <= allowed else None


def _is_open(part: Network, start: Estimate, datum: str) -> bool:
    """Return whether free parameters of the cameras add to the rank defect at the start values."""
    defects = []
    for values in (start, _with_free(start, [set() for _ in start.cameras])):
        try:
            begun = adjust(
                part,
                values,
                datum=Datum(datum),
                reject="none",
                covariance=False,
                options=AdjustmentOptions(max_iterations=0),
            )
        except (GeometryError, np.linalg.LinAlgError):
            return False  # damped steps may lead to equations that can be solved
        defects.append(begun.defect)
    return defects[0] > defects[1]


def _with_free(estimate: Estimate, names: Chosen) -> Estimate:
    """Return the estimate with the chosen parameters free; other cameras stay as they are."""
    cameras = tuple(
        camera
        if chosen is None
        else replace(camera, free=np.array([name in chosen for name in camera.names]))
        for camera, chosen in zip(estimate.cameras, names, strict=True)
    )
    return replace(estimate, cameras=cameras)


def _remarks(settings: CameraSettings, units: tuple[str, ...], photographs: int) -> list[Remark]:
    """Return the remarks on the parameters chosen for a camera."""
    remarks = []
    for name, (value, sigma) in settings.weighted[:1]:
        unit = units[MODELS[settings.model].names.index(name)]
        observed = remark(
            "parameters_chosen",
            camera=settings.name,
            weighted=name,
            photographs=photographs,
            given=(value, unit),
            sigma=(sigma, unit),
        )
        remarks.append(observed)
    if settings.free:
        freed = settings.free
        remarks.append(
            remark("parameters_chosen", camera=settings.name, parameters=freed, photographs=photographs)
        )
    return remarks or [remark("interior_held", camera=settings.name, photographs=photographs)]
