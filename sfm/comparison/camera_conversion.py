"""Conversion of a camera from one distortion model to another, and image points without distortion.

`brown` corrects the measured point, and the other models distort the ideal point, so no conversion is exact.
The parameters of the target model are fitted to the rays of the source model over a grid of pixels, and the
remaining misfit is stated. Principal distance and principal point take part in the fit. The rays are not
rotated.

For programs without distortion models, `undistort` corrects the image points. It moves them to the position
at which a camera without distortion and with square pixels sees the same rays. Only the raw coordinates are
lost, and the original camera restores them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sfm.model.camera import (
    Camera,
    camera_from_values,
    pixel_from_tangents,
    pixel_jacobian,
    residuals_of_rays,
    tangents_from_pixel,
)
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.display import counted
from sfm.model.distortion.models import CONVERTIBLE, MODELS, Role
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, rows_of

PINHOLE = (Role.FOCAL, Role.X0, Role.Y0)  # parts of a camera without distortion
GRID_STEPS = 32  # fit points along the longer side: four per period of a misfit that varies as r^9 at most
FIT_TOLERANCE = 1e-15  # relative; the fit is small, so it runs to the limit of double precision
_OF_ONE = {"f": "fx", "k": "k1"}  # for models with a single focal length or radial coefficient


# Part of the effect of a denominator's coefficients by which they are drawn to 0. A fraction has a common
# factor of numerator and denominator to spare, and its zero inside a photograph would be a place without a
# pixel. On lenses of 5 to 35 % at the corner, 1e-5 left such zeros, and 1e-3 trebled the misfit of camcal's.
DRAWN = 1e-4


@dataclass(frozen=True)
class Conversion:
    """A camera in another model, and the misfit of that model."""

    camera: Camera  # in the target model; parameters corresponding to free ones are free
    source_model: str  # model converted from
    rms_px: float  # root mean square misfit per coordinate over the region, px
    max_px: float  # longest misfit vector over the region, px


def convert_camera(
    camera: Camera,
    model: str,
    *,
    region_px: FloatArray | None = None,
    held: tuple[str, ...] = (),
    square: bool = False,
) -> Conversion:
    """Return the camera in another model, fitted over the photograph or a region of it.

    Args:
        camera: interior orientation to convert.
        model: a name in sfm.model.distortion.models.CONVERTIBLE.
        region_px: x_min, y_min, x_max, y_max of the region of the fit, px, (4,); the whole photograph if not
            given.
        held: parameters of the model that must be 0; others compensate as far as possible. If b1 is held,
            affinity becomes the ratio of the sides of a pixel.
        square: whether pixels of a model in mm must be square; then held affinity is part of the misfit.

    Raises:
        SurveyFileError: unknown model.
        GeometryError: the distortion of the camera cannot be inverted over the region.

    Source: start values by series reversal, Luhmann et al., Close-Range Photogrammetry and 3D Imaging
    (2020), sec. 3.3; the fit is by least squares.
    """
    if model == camera.model and not needs_less(camera, held, square=square):
        return Conversion(camera, model, 0.0, 0.0)
    if model not in CONVERTIBLE:
        raise SurveyFileError(
            f"camera {camera.name}: model '{model}', expected one of {', '.join(CONVERTIBLE)}"
        )
    # pixels spread evenly over the region, including its border
    width, height = camera.size_px
    region = np.array([-0.5, -0.5, width - 0.5, height - 0.5]) if region_px is None else region_px
    extent = region[2:] - region[:2]
    steps = np.maximum(np.rint(GRID_STEPS * extent / extent.max()).astype(int), 8) + 1
    x = np.linspace(region[0], region[2], steps[0])
    y = np.linspace(region[1], region[3], steps[1])
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    uv = tangents_from_pixel(camera, xy)
    if not np.isfinite(uv).all():
        raise GeometryError(
            f"camera {camera.name}: its {camera.model} distortion cannot be inverted at "
            f"{(~np.isfinite(uv[:, 0])).sum()} of {len(uv)} places of the photograph"
        )
    if square and camera.in_mm:
        sx, sy = camera.pixel_mm
        start = start_values(camera, model)
        across = start.plays(Role.X0) & start.in_mm
        start = start.with_parameters(np.where(across, sy / sx, 1.0) * start.parameters)
        start = replace(start, pixel_mm=np.array([sy, sy]))
    else:
        start = start_values(_affinity_in_pixels(camera) if "b1" in held and not square else camera, model)
    fitted = np.array([name not in held for name in start.names])
    start = start.with_parameters(np.where(fitted, start.parameters, 0.0))
    from scipy.optimize import least_squares  # importing takes half a second, and most commands never need it

    def rows(p: FloatArray) -> tuple[FloatArray, FloatArray]:
        residuals, jacobian = residuals_of_rays(start.index, start.linear_frame, _padded(p, fitted), xy, uv)
        return residuals.ravel(), jacobian.reshape(2 * len(xy), -1)[:, fitted]

    effect_px = np.linalg.norm(rows(start.parameters[fitted])[1], axis=0)
    drawn = np.diag(DRAWN * effect_px)[start.plays(Role.DENOMINATOR)[fitted]]
    # Parameters are scaled by their effect in px, so that the tolerance has the same meaning for all.
    fit = least_squares(
        lambda p: np.concatenate([rows(p)[0], drawn @ p]),
        start.parameters[fitted],
        jac=lambda p: np.concatenate([rows(p)[1], drawn]),
        method="lm",
        x_scale="jac",
        ftol=FIT_TOLERANCE,
        xtol=FIT_TOLERANCE,
        gtol=FIT_TOLERANCE,
        max_nfev=1000,
    )
    free = corresponding_free(camera, model) & fitted
    converted = replace(start.with_parameters(_padded(fit.x, fitted)), free=free)
    misfit = pixel_from_tangents(converted, uv) - xy
    if not np.isfinite(misfit).all():
        raise GeometryError(
            f"camera {camera.name}: model {model} folds over inside the photograph when fitted to "
            f"{camera.model}"
        )
    return Conversion(
        converted,
        camera.model,
        float(np.sqrt((misfit**2).mean())),
        float(np.sqrt((misfit**2).sum(axis=1).max())),
    )


def convert_cameras(
    estimate: Estimate, models: tuple[str, ...], *, held: tuple[str, ...] = (), square: bool = False
) -> tuple[Estimate, tuple[Conversion, ...]]:
    """Return the estimate with every camera in one of the given models, and the conversions.

    A camera in one of these models whose held parameters are 0 stays as it is. Any other camera is converted
    into the first model.

    Args:
        estimate: a solution.
        models: accepted models, the best first.
        held: parameters of these models that must be 0.
        square: whether pixels must be square, see `convert_camera`.
    """
    conversions = tuple(
        convert_camera(
            camera,
            camera.model
            if camera.model in models and not needs_less(camera, held, square=square)
            else models[0],
            held=held,
            square=square,
        )
        for camera in estimate.cameras
    )
    return replace(estimate, cameras=tuple(conversion.camera for conversion in conversions)), conversions


def needs_less(camera: Camera, held: tuple[str, ...], *, square: bool = False) -> bool:
    """Return whether a camera has a held parameter other than 0, or pixels that are not square.

    Models of wide-angle lenses have other parameters by the same names.
    """
    if square and camera.in_mm and np.ptp(camera.pixel_mm):
        return True
    return not camera.wide_angle and any(camera.value(name) != 0 for name in held if name in camera.names)


def _affinity_in_pixels(camera: Camera) -> Camera:
    """Return the camera with its affinity expressed as the ratio of the sides of a pixel.

    The result is exact for `brown` without shear, whose affinity applies to the measured point, and for the
    opencv models, whose parameters are in px. For other models it is an approximation.
    """
    sx, sy = camera.pixel_mm
    if not camera.in_mm:
        fx, fy = camera.parameters[camera.plays(Role.FOCAL)][[0, -1]]
        return replace(camera, pixel_mm=np.array([sy * fy / fx, sy]))
    b1 = _affinity(camera)
    stretch = 1 + b1 if MODELS[camera.model].corrects else 1 / (1 + b1)
    p = np.where(camera.plays(Role.AFFINITY), 0.0, camera.parameters)
    folded = camera.with_parameters(np.where(camera.plays(Role.X0), stretch * p, p))
    return replace(folded, pixel_mm=np.array([sx * stretch, sy]))


def _affinity(camera: Camera) -> float:
    """Return b1 of a camera in mm, 0 if its model has no affinity."""
    return float(camera.parameters[camera.plays(Role.AFFINITY)].sum())


def _padded(p: FloatArray, fitted: BoolArray) -> FloatArray:
    """Return all parameters of a model, with 0 for those that are not fitted."""
    values = np.zeros(len(fitted))
    values[fitted] = p
    return values


def start_values(camera: Camera, model: str) -> Camera:
    """Return the camera in another model from the first terms of the reversed series.

    Between `brown` and the opencv models they are p1 = c P2, p2 = -c P1, k1 = -c^2 K1, k2 = c^4 (3 K1^2 -
    K2), k3 = c^6 (8 K1 K2 - 12 K1^3 - K3), and correspondingly in the other direction. Between other models
    distortion starts at 0, or at the same values if the parameters are the same.
    """
    pixel = (float(camera.pixel_mm[0]), float(camera.pixel_mm[1]))
    backward = MODELS[camera.model].corrects
    to_opencv = not MODELS[model].in_mm
    centre = (np.asarray(camera.size_px) - 1) / 2
    values: dict[str, float] = {}
    if camera.in_mm:
        c, x0, y0 = (camera.value(name) for name in ("c", "x0", "y0"))
        b1 = _affinity(camera)
        if to_opencv:
            # brown multiplies the measured x by 1 + b1, brown_forward the ideal one
            fx = c / pixel[0] * (1 - b1 if backward else 1 + b1)
            values |= {"fx": fx, "fy": c / pixel[1]}
            values |= {"cx": centre[0] + x0 / pixel[0], "cy": centre[1] - y0 / pixel[1]}
        else:
            values |= {"x0": x0, "y0": y0, "b1": b1 if backward == MODELS[model].corrects else -b1}
        if MODELS[model].names == camera.names:
            values |= dict(zip(camera.names, camera.parameters.tolist(), strict=True))
        if backward and to_opencv:
            k1, k2, k3 = _reversed_series(*(camera.value(f"K{i}") * c ** (2 * i) for i in (1, 2, 3)))
            values |= {"k1": k1, "k2": k2, "p1": c * camera.value("P2"), "p2": -c * camera.value("P1")}
            values |= {"k3": k3}
    else:
        fx, fy = camera.parameters[camera.plays(Role.FOCAL)][[0, -1]]
        c = fy * pixel[1]
        same = camera.model in CONVERTIBLE  # other models have coefficients of another kind
        if to_opencv:
            values |= (
                _as_full_opencv(camera) if same else {"cx": camera.value("cx"), "cy": camera.value("cy")}
            )
            values |= {"fx": fx, "fy": fy}
        else:
            stretch = fx * pixel[0] / c
            values |= {"x0": (camera.value("cx") - centre[0]) * pixel[0]}
            values |= {"y0": -(camera.value("cy") - centre[1]) * pixel[1]}
            values |= {"b1": 1 - stretch if MODELS[model].corrects else stretch - 1}
        if MODELS[model].corrects and same:
            opencv = _as_full_opencv(camera)
            # the first three series coefficients of the rational radial term
            k1, k2, k3, d1, d2, d3 = (opencv[f"k{i}"] for i in range(1, 7))
            s1 = k1 - d1
            s2 = k2 - d2 - d1 * s1
            K = _reversed_series(s1, s2, k3 - d3 - d2 * s1 - d1 * s2)
            values |= {f"K{i}": K[i - 1] / c ** (2 * i) for i in (1, 2, 3)}
            values |= {"P1": -opencv["p2"] / c, "P2": opencv["p1"] / c}
    if to_opencv:
        values |= {"f": (values["fx"] + values["fy"]) / 2, "k": values.get("k1", 0.0)}
    known = tuple((name, values[name]) for name in MODELS[model].names if name in values)
    return camera_from_values(camera.name, model, camera.size_px, pixel, c_mm=c, values=known)


def corresponding_free(camera: Camera, model: str) -> BoolArray:
    """Return the parameters of another model that correspond to the free parameters of the camera, (n,).

    A parameter is free if a parameter of the same role is free in the camera. A free K1 frees every radial
    term, since the inverse of a truncated series is not truncated. If a model has two focal lengths in place
    of one focal length and an affinity, each of these corresponds to both.
    """
    source, target = MODELS[camera.model], MODELS[model]
    free = {
        parameter.role for parameter, is_free in zip(source.parameters, camera.free, strict=True) if is_free
    }
    radial = {Role.RADIAL, Role.DENOMINATOR}
    corresponding = []
    for parameter in target.parameters:
        role, counterparts = parameter.role, {parameter.role}
        if role in radial:
            counterparts = radial
        elif role is Role.FOCAL and not target.names_of(Role.AFFINITY):
            counterparts = {Role.FOCAL, Role.AFFINITY}
        elif role is Role.AFFINITY and not source.names_of(Role.AFFINITY):
            counterparts = {Role.FOCAL}
        corresponding.append(bool(free & counterparts))
    return np.array(corresponding)


def _reversed_series(a: float, b: float, c: float) -> tuple[float, float, float]:
    """Return the coefficients of the inverse of r (1 + a r^2 + b r^4 + c r^6) to the same order."""
    return -a, 3 * a**2 - b, 8 * a * b - 12 * a**3 - c


def _as_full_opencv(camera: Camera) -> dict[str, float]:
    """Return the parameters of full_opencv, 0 for those that the camera's model does not have."""
    values = {_OF_ONE.get(name, name): camera.value(name) for name in camera.names}
    return dict.fromkeys(MODELS["full_opencv"].names, 0.0) | values


def undistort(network: Network, estimate: Estimate, models: tuple[str, ...]) -> tuple[Network, Estimate]:
    """Return image points without distortion, and the ideal cameras that see them.

    The rays are the same except for rounding. The covariances of image points are propagated.

    Args:
        network: has the measured image points.
        estimate: has the cameras that they were measured with.
        models: allowed models of the ideal cameras, with all distortion 0; brown or opencv must be one of
            them.

    Raises:
        GeometryError: a distortion cannot be inverted at a measured point.
    """
    seen = network.image_points
    xy, covariance = seen.xy.copy(), seen.covariance.copy()
    ideal = tuple(ideal_camera(camera, models) for camera in estimate.cameras)
    of_camera = rows_of(network.camera[seen.image], len(estimate.cameras))
    for k, (camera, rows) in enumerate(zip(estimate.cameras, of_camera, strict=True)):
        if not len(rows):
            continue
        uv = tangents_from_pixel(camera, seen.xy[rows])
        lost = ~np.isfinite(uv).all(axis=1)
        if lost.any():
            row = rows[np.argmax(lost)]
            raise GeometryError(
                f"camera {camera.name}: its distortion cannot be inverted at "
                f"{counted(int(lost.sum()), 'image point')}, "
                f"the first is point {network.points[seen.point[row]]} in {network.images[seen.image[row]]}"
            )
        xy[rows] = pixel_from_tangents(ideal[k], uv)
        before = pixel_jacobian(camera, seen.xy[rows])
        G = pixel_jacobian(ideal[k], xy[rows]) @ np.linalg.inv(before)
        carried = G @ seen.covariance[rows] @ np.swapaxes(G, 1, 2)
        covariance[rows] = (carried + np.swapaxes(carried, 1, 2)) / 2  # symmetric to the last bit
    return (
        replace(network, image_points=replace(seen, xy=xy, covariance=covariance)),
        replace(estimate, cameras=ideal),
    )


def ideal_camera(camera: Camera, models: tuple[str, ...]) -> Camera:
    """Return the camera without distortion: with its principal distance and point, and square pixels."""
    sx, sy = (float(side) for side in camera.pixel_mm)
    centre = (np.asarray(camera.size_px) - 1) / 2
    if camera.in_mm:
        c = camera.value("c")
        principal = centre + np.array([camera.value("x0") / sx, -camera.value("y0") / sy])
    else:
        c = float(camera.parameters[camera.plays(Role.FOCAL)][-1]) * sy
        principal = np.array([camera.value("cx"), camera.value("cy")])
    model = "brown" if "opencv" not in models or (camera.in_mm and "brown" in models) else "opencv"
    x0, y0 = (principal - centre) * (sy, -sy)
    values = (("x0", x0), ("y0", y0)) if model == "brown" else (("cx", principal[0]), ("cy", principal[1]))
    ideal = camera_from_values(
        camera.name,
        model,
        camera.size_px,
        (sy, sy),
        c_mm=c,
        values=tuple((name, float(value)) for name, value in values),
    )
    return replace(ideal, free=corresponding_free(camera, model) & ideal.plays(*PINHOLE))
