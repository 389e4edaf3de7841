"""Camera: interior orientation, and the transformation between pixels and rays.

The distortion models are in `sfm.model.distortion`; a camera has the parameter values of one model.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.display import counted
from sfm.model.distortion.models import MAX_PARAMETERS, MODELS, WIDE_ANGLE, Role, number_of, observe
from sfm.model.errors import SurveyFileError
from sfm.runtime.compiling import compiled, inlined, kernel

STEPS, HALVINGS = 100, 20  # of Newton's method, and of one of its steps
PIXEL_TOLERANCE = 1e-10
EDGE_PIXELS = 9  # of each edge of a photograph, whose rays show its field of view
# Factor of the angle of the field of view: with decentring, the widest ray of an edge is not at its corners,
# and lies between those that are computed.
FIELD_MARGIN = 1.05
PLACES = 16  # between the axis and a ray at which the distortion is tested for a fold
# Directions in which the range without a fold is found once for many points, the radius where the search
# begins in half diagonals of the photograph, its next radius as a part of the one before, and the part of the
# common radius that is free of folds in all directions in between. It costs as much as the tests of so many
# points; DIRECTIONS times PLACES residuals, where a point without it takes some twenty.
DIRECTIONS, WIDEST, NARROWER, CERTAIN = 16, 1.25, 0.75, 0.9
# Width of a ring, as a part of its radius, that is no fold: a zero of the denominator of `full_opencv` that
# the numerator cancels, as it nearly does in many fits (a ring of 1e-5 of the radius in one to a mild lens).
RING = 1e-3
CURVATURE_STEP = 1e-3  # tangents, one or a few pixels
# In coordinates of a ray; the error of Newton's method after such a step is its square, or rounding.
STEP_TOLERANCE = 1e-11
# Fraction of the half diagonal, at the corner of the photograph, by which nominal focal lengths, sensors and
# lenses differ from true ones. A parameter that the network determines worse is better held fixed.
KNOWN_WITHOUT = 0.01
INWARDS = np.linspace(0.0, 0.9, 451)  # from a place at the border to the middle of the format, in parts
DIAGONAL_PLACES = 26  # from the corner to the middle of a wide-angle photograph; one of them has a ray


@dataclass(frozen=True)
class Camera:
    """Interior orientation of one camera, shared by the photographs taken with it."""

    name: str
    """name of the camera"""
    model: str
    """name of the distortion model in `sfm.model.distortion.models.MODELS`"""
    size_px: tuple[int, int]
    """width and height of its photographs, px"""
    pixel_mm: FloatArray
    """width and height of a pixel, mm, shape (2,)"""
    parameters: FloatArray
    """interior orientation in the order and units of the model, see `names` and `units`, shape (n,)"""
    free: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    """which parameters are to be adjusted; none by default, shape (n,)"""
    shared: tuple[str, ...] = ()
    """group of cameras that share the value of each parameter, such as photographs of one camera that differ
    in c only; "" = not shared, () = none shared, length n"""

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(self.parameters) != n:
            raise SurveyFileError(
                f"camera {self.name}: {counted(len(self.parameters), 'parameter')}, model "
                f"{self.model} has {n}"
            )
        if len(self.shared) not in (0, n):
            raise SurveyFileError(
                f"camera {self.name}: {counted(len(self.shared), 'group')} of {n} parameters"
            )
        if len(self.free) == 0:
            object.__setattr__(self, "free", np.zeros(n, dtype=bool))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return MODELS[self.model].names

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the parameters, in order."""
        return MODELS[self.model].units

    def plays(self, *roles: Role) -> BoolArray:
        """Return which parameters have one of the roles, such as radial distortion, (n,)."""
        return np.array([parameter.role in roles for parameter in MODELS[self.model].parameters])

    @property
    def parts(self) -> tuple[BoolArray, BoolArray, BoolArray]:
        """Which parameters are focal lengths, principal point and distortion, (n,) each."""
        focal, principal = self.plays(Role.FOCAL), self.plays(Role.X0, Role.Y0)
        return focal, principal, ~(focal | principal)

    @property
    def in_mm(self) -> bool:
        """Whether c and the principal point are in mm on the sensor; otherwise focal lengths are in px."""
        return MODELS[self.model].in_mm

    @cached_property
    def field_angle(self) -> float:
        """Largest angle between the axis and the rays of the edges of a photograph, up to pi / 2, rad."""
        tangents = np.linalg.norm(tangents_from_pixel(self, border_pixels(self, EDGE_PIXELS)), axis=1)
        return float(np.arctan(np.where(np.isfinite(tangents), tangents, np.inf)).max())

    @property
    def wide_angle(self) -> bool:
        """Whether equal angles, rather than equal tangents, have about equal lengths in its photographs."""
        return MODELS[self.model] in WIDE_ANGLE

    @property
    def index(self) -> int:
        """Number of the model in compiled code."""
        return number_of(self.model)

    @property
    def frame(self) -> FloatArray:
        """Centre (px), pixel size (mm), variant of the model, plane of its rays, for compiled code, (7,)."""
        (width, height), model = self.size_px, MODELS[self.model]
        centre = (width - 1) / 2, (height - 1) / 2
        return np.array([*centre, *self.pixel_mm, *model.variant, float(model.stereographic)])

    @property
    def linear_frame(self) -> FloatArray:
        """`frame` with residuals in the corrected plane; there correction models are linear in the ray."""
        frame = self.frame
        if MODELS[self.model].corrects:
            frame[4] = 0.0
        return frame

    @property
    def c_px(self) -> float:
        """Principal distance in px (mean of both directions)."""
        focal = float(np.mean(self.parameters[self.plays(Role.FOCAL)]))
        return focal / float(np.mean(self.pixel_mm)) if self.in_mm else focal

    @property
    def principal_point_px(self) -> FloatArray:
        """Principal point from the upper left corner of the photograph, px, (2,)."""
        x, y = self.parameters[self.plays(Role.X0)][0], self.parameters[self.plays(Role.Y0)][0]
        if not self.in_mm:
            return np.array([x + 0.5, y + 0.5])
        width, height = self.size_px
        return np.array([width / 2 + x / self.pixel_mm[0], height / 2 - y / self.pixel_mm[1]])

    def value(self, name: str) -> float:
        """Return the value of a parameter in its unit; KeyError if the model has no such parameter."""
        if name not in self.names:
            raise KeyError(name)
        return float(self.parameters[self.names.index(name)])

    def group_of(self, parameter: int) -> str:
        """Return the group of cameras that share a parameter, given by its index; "" if it is not shared."""
        return self.shared[parameter] if self.shared else ""

    def owner_of(self, parameter: int) -> str:
        """Return the owner of a parameter, given by its index: the group that shares it, or this camera."""
        return self.group_of(parameter) or self.name

    @property
    def shared_name(self) -> str:
        """Name of the group that shares parameters with this camera; its name if nothing is shared."""
        return next(filter(None, self.shared), self.name)

    def reduced(self, shrink: int) -> Camera:
        """Return the camera of the photographs reduced by averaging squares of `shrink` x `shrink` pixels.

        Incomplete squares at the right and lower borders are cut off.
        """
        width, height = (side // shrink for side in self.size_px)
        cut = (np.array(self.size_px) - shrink * np.array([width, height])) / 2 * self.pixel_mm
        parameters = self.parameters.copy()
        if self.in_mm:  # counted from the centre of the photograph, which the cut moves
            parameters[self.plays(Role.X0)] += cut[0]
            parameters[self.plays(Role.Y0)] -= cut[1]
        else:  # models in px count the principal point from the centre of the first pixel
            parameters[self.plays(Role.FOCAL)] /= shrink
            centre = self.plays(Role.X0, Role.Y0)
            parameters[centre] = (parameters[centre] + 0.5) / shrink - 0.5
        return replace(self, size_px=(width, height), pixel_mm=shrink * self.pixel_mm, parameters=parameters)

    def with_parameters(self, parameters: FloatArray) -> Camera:
        """Return the same camera with other parameter values, shape (n,)."""
        return replace(self, parameters=np.array(parameters, dtype=float))


@checked_arguments()
def camera_from_values(
    name: str,
    model: str,
    size_px: tuple[int, int],
    pixel_mm: tuple[float, float],
    *,
    c_mm: float,
    free: tuple[str, ...] = (),
    values: tuple[tuple[str, float], ...] = (),
) -> Camera:
    """Return a camera from its principal distance and other known parameters.

    Args:
        name: name of the camera.
        model: name of the distortion model, one of MODELS.
        size_px: width and height of its photographs, px.
        pixel_mm: width and height of a pixel, mm.
        c_mm: principal distance, mm; for models in px it gives f, or fx and fy.
        free: names of the parameters to adjust.
        values: (name, value) of known parameters in the units of the model. All others are 0; for models in
            px the principal point is the centre of the photograph.

    Raises:
        SurveyFileError: unknown model or parameter name, or sizes that are not positive.

    Example:
        >>> camera = camera_from_values("D3", "brown", (6000, 4000), (0.004, 0.004), c_mm=20.0, free=("c",))
        >>> camera.c_px, camera.names[:4]
        (5000.0, ('c', 'x0', 'y0', 'K1'))
    """
    if model not in MODELS:
        raise SurveyFileError(f"camera {name}: model '{model}', expected one of {', '.join(MODELS)}")
    size, pixel = np.asarray(size_px, dtype=float), np.asarray(pixel_mm, dtype=float)
    for what, value, count in (("size_px", size, 2), ("pixel_mm", pixel, 2), ("c_mm", np.asarray([c_mm]), 1)):
        if value.shape != (count,) or not (np.isfinite(value) & (value > 0)).all():
            raise SurveyFileError(
                f"camera {name}: {what} {value.tolist()}, expected {counted(count, 'positive number')}"
            )
    names = MODELS[model].names
    free = (free,) if isinstance(free, str) else free
    for given in (*free, *(key for key, _ in values)):
        if given not in names:
            raise SurveyFileError(
                f"camera {name}: model {model} has no parameter '{given}', it has {', '.join(names)}"
            )
    p = dict.fromkeys(names, 0.0)
    if MODELS[model].in_mm:
        p["c"] = c_mm
    else:
        f = c_mm / pixel[0], c_mm / pixel[1]
        focal = MODELS[model].names_of(Role.FOCAL)
        p |= dict(zip(focal, f if len(focal) > 1 else (sum(f) / 2,), strict=True))
        p["cx"], p["cy"] = (size_px[0] - 1) / 2, (size_px[1] - 1) / 2
    p.update(values)
    return Camera(
        name,
        model,
        size_px,
        np.array(pixel_mm, dtype=float),
        np.array([p[key] for key in names]),
        np.array([key in free for key in names]),
    )


def camera_families(cameras: tuple[Camera, ...], camera: IntArray) -> tuple[tuple[str, ...], IntArray]:
    """Return the families of cameras that share parameters, such as the photographs of one zoom lens.

    A camera that shares nothing is a family by itself. Any other family takes the name of the group with the
    most photographs.

    Args:
        cameras: interior orientations.
        camera: index of the camera of each photograph, shape (m,).

    Returns:
        Names of the families, and the family of each camera, shape (a,).
    """
    used = np.bincount(camera, minlength=len(cameras)).tolist()
    owners = [sorted({camera.owner_of(s) for s in range(len(camera.names))}) for camera in cameras]
    photographs: Counter[str] = Counter()
    for of_family, count in zip(owners, used, strict=True):
        photographs.update(dict.fromkeys(of_family, count))
    names = [max(of_family, key=lambda owner: photographs[owner]) for of_family in owners]
    # in files of other programs two cameras with nothing in common may have the same name
    keys = [
        (name, -1 if camera.shared else a)
        for a, (name, camera) in enumerate(zip(names, cameras, strict=True))
    ]
    families = list(dict.fromkeys(keys))
    return tuple(name for name, _ in families), np.array(
        [families.index(key) for key in keys], dtype=np.int64
    )


def base_name(name: str, names: Iterable[str]) -> str:
    """Return which of the names a camera name begins with; a photograph may follow. Return "" if none.

    If several fit, the longest is returned.
    """
    return max((shorter for shorter in names if f"{name} ".startswith(f"{shorter} ")), key=len, default="")


def tangents_from_pixel(camera: Camera, xy_px: FloatArray) -> FloatArray:
    """Return the tangents (u, v) of the rays through pixels, distortion removed.

    Args:
        camera: interior orientation.
        xy_px: pixel coordinates, shape (k, 2), px.

    Returns:
        u = -U/W and v = -V/W (image axes, y up), shape (k, 2); NaN where no ray within the monotone range of
        a model that distorts the ideal point has the pixel, and where the ray is 90 degrees or more from the
        axis (`rays_from_pixel` returns it). Models that correct the measured point give a ray to every pixel.

    Source: collinearity, Kraus (2007), sec. 4.2.1; the distortion model of the camera
    (`sfm.model.distortion`).
    """
    uv = _rays_in_plane(camera, xy_px)
    if not MODELS[camera.model].stereographic:
        return uv
    W = 1.0 - (uv * uv).sum(axis=1) / 4.0
    return np.asarray(uv / np.where(W > 0, W, np.nan)[:, None])


def pixel_from_tangents(camera: Camera, uv: FloatArray) -> FloatArray:
    """Return the pixel coordinates of rays with tangents (u, v).

    Args:
        camera: interior orientation.
        uv: u = -U/W and v = -V/W (image axes, y up), shape (k, 2).

    Returns:
        Pixel coordinates, shape (k, 2), px; NaN beyond the monotone range, where the distortion folds over.
    """
    tangents = np.ascontiguousarray(uv, dtype=float).reshape(-1, 2)
    if MODELS[camera.model].stereographic:
        length = np.sqrt(1.0 + (tangents * tangents).sum(axis=1))
        tangents = tangents * (2.0 / (1.0 + length))[:, None]
    return _pixel_in_plane(camera, tangents)


def rays_from_pixel(camera: Camera, xy_px: FloatArray) -> FloatArray:
    """Return the rays through pixels, distortion removed, at any angle to the axis that the model reaches.

    Args:
        camera: interior orientation.
        xy_px: pixel coordinates, shape (k, 2), px.

    Returns:
        Directions (U, V, W) in the image frame, shape (k, 3): (u, v, -1) of models of tangents, of length 1
        of stereographic ones. NaN without a ray, as of `tangents_from_pixel`.
    """
    uv = _rays_in_plane(camera, xy_px)
    if not MODELS[camera.model].stereographic:
        return np.column_stack([uv, -np.ones(len(uv))])
    r2 = (uv * uv).sum(axis=1) / 4.0
    return np.asarray(np.column_stack([uv, r2 - 1.0]) / (1.0 + r2)[:, None])


def pixel_from_rays(camera: Camera, rays: FloatArray) -> FloatArray:
    """Return the pixel coordinates of rays.

    Args:
        camera: interior orientation.
        rays: directions (U, V, W) of any length in the image frame, shape (k, 3).

    Returns:
        Pixel coordinates, shape (k, 2), px; NaN beyond the monotone range, where the distortion folds over,
        and for rays 90 degrees or more from the axis, which only stereographic models reach.
    """
    return _pixel_in_plane(camera, plane_from_rays(camera, rays))


def plane_from_rays(camera: Camera, rays: FloatArray) -> FloatArray:
    """Return the coordinates u, v of rays that a camera's model takes (`sfm.model.distortion.models`).

    Args:
        camera: interior orientation.
        rays: directions (U, V, W) of any length in the image frame, shape (k, 3).

    Returns:
        Tangents or stereographic coordinates, shape (k, 2); NaN for rays that have none.
    """
    directions = np.asarray(rays, dtype=float).reshape(-1, 3)
    W = directions[:, 2]
    if not MODELS[camera.model].stereographic:
        return np.asarray(-directions[:, :2] / np.where(W < 0, W, np.nan)[:, None])
    depth = np.sqrt((directions * directions).sum(axis=1)) - W
    return np.asarray(2.0 * directions[:, :2] / np.where(depth > 0, depth, np.nan)[:, None])


def border_pixels(camera: Camera, per_side: int) -> FloatArray:
    """Return pixels along the border of a photograph, the upper, lower, left and right side, (4 per_side, 2).

    Args:
        camera: the camera of the photograph.
        per_side: number of pixels of each side, with both of its corners.
    """
    width, height = camera.size_px
    along, zeros, ones = np.linspace(0.0, 1.0, per_side), np.zeros(per_side), np.ones(per_side)
    sides = ((along, zeros), (along, ones), (zeros, along), (ones, along))
    return np.vstack([np.column_stack(side) for side in sides]) * (width - 1, height - 1)


def within_reach(camera: Camera, xy_px: FloatArray, seen_px: FloatArray) -> BoolArray:
    """Return which pixels have a ray that photographs of the camera may have.

    Beyond 90 degrees from the axis, the image circle of a lens ends somewhere. Image points tell how far it
    reaches at least.

    Args:
        camera: interior orientation.
        xy_px: pixel coordinates, shape (k, 2), px.
        seen_px: image points, shape (n, 2), px.

    Returns:
        Which pixels have a ray less than 90 degrees from the axis, or no farther from it than that of an
        image point, (k,).
    """

    def towards_back(places: FloatArray) -> FloatArray:
        rays = rays_from_pixel(camera, places)
        return np.asarray(rays[:, 2] / np.linalg.norm(rays, axis=1))

    backwards = towards_back(xy_px)
    if not (backwards > 0).any():
        return backwards <= 0
    return np.asarray(backwards <= max(0.0, np.nanmax(towards_back(seen_px), initial=0.0)))


def outermost_reached(camera: Camera, ends_px: FloatArray, seen_px: FloatArray) -> FloatArray:
    """Return the places nearest to the border of the format that photographs of the camera may show.

    Args:
        camera: interior orientation.
        ends_px: places at the border, px, (n, 2).
        seen_px: image points, px, (k, 2); see `within_reach`.

    Returns:
        The outermost place within reach on each line from an end to the middle of the format, px, (n, 2); the
        end if there is none.
    """
    middle = (np.array(camera.size_px) - 1) / 2
    lines = ends_px[:, None] + INWARDS[:, None] * (middle - ends_px)[:, None]
    reached = within_reach(camera, lines.reshape(-1, 2), seen_px).reshape(lines.shape[:2])
    return np.asarray(lines[np.arange(len(lines)), reached.argmax(axis=1)])


def angle_between(first: FloatArray, second: FloatArray) -> float:
    """Return the angle of view between two rays of a camera on opposite sides of its axis, rad.

    Args:
        first: direction (U, V, W) in the image frame, (3,).
        second: the other one, (3,).

    Returns:
        The angle across the axis, which exceeds 180 degrees where both rays together are farther from it; NaN
        without a ray.
    """
    a, b = first / np.linalg.norm(first), second / np.linalg.norm(second)
    angle = float(np.arccos(np.clip(a @ b, -1.0, 1.0)))
    return 2 * np.pi - angle if np.arccos(-a[2]) + np.arccos(-b[2]) > np.pi else angle


def _rays_in_plane(camera: Camera, xy_px: FloatArray) -> FloatArray:
    """Return the coordinates u, v of the rays through pixels that the camera's model takes, (k, 2)."""
    xy = np.ascontiguousarray(xy_px, dtype=float).reshape(-1, 2)
    corrects = MODELS[camera.model].corrects
    return _rays(camera.index, camera.linear_frame, camera.parameters, corrects, xy)


def _pixel_in_plane(camera: Camera, uv: FloatArray) -> FloatArray:
    """Return the pixels of rays from the coordinates u, v that the camera's model takes, (k, 2)."""
    corrects = MODELS[camera.model].corrects
    return _pixels(camera.index, camera.linear_frame, camera.parameters, corrects, np.ascontiguousarray(uv))


def parameter_jacobian(camera: Camera, rays: FloatArray) -> FloatArray:
    """Return d (x, y) / d (parameters), the change of the pixel coordinates of rays with each parameter.

    Args:
        camera: interior orientation of n parameters.
        rays: directions (U, V, W) of any length in the image frame, shape (k, 3); or their tangents u = -U/W
            and v = -V/W, shape (k, 2).

    Returns:
        Derivatives, shape (k, 2, n), px per unit of the parameter; NaN where the distortion folds over.
    """
    rays = np.asarray(rays, dtype=float)
    if rays.shape[1] == 2:
        rays = np.column_stack([rays, -np.ones(len(rays))])
    uv = plane_from_rays(camera, rays)
    xy, frame = _pixel_in_plane(camera, uv), camera.linear_frame
    Jp = residuals_of_rays(camera.index, frame, camera.parameters, xy, uv)[1]
    if not MODELS[camera.model].corrects:
        return np.asarray(np.where(np.isfinite(xy)[:, :, None], Jp, np.nan))
    # of correction models, the residual stays 0 if the measured point moves; it does against x0 and y0
    by_x, by_y = -Jp[:, :, 1:2] * frame[2], Jp[:, :, 2:3] * frame[3]
    det = by_x[:, :1] * by_y[:, 1:] - by_y[:, :1] * by_x[:, 1:]
    x = by_y[:, :1] * Jp[:, 1:] - by_y[:, 1:] * Jp[:, :1]
    y = by_x[:, 1:] * Jp[:, :1] - by_x[:, :1] * Jp[:, 1:]
    return np.asarray(np.concatenate([x, y], axis=1) / det)


def ray_directions(uv: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return directions of rays in object axes, shape (k, 3), one unit long along the camera axis.

    Args:
        uv: tangents u = -U/W and v = -V/W, shape (k, 2).
        rotation: R, image to object axes, shape (3, 3).

    Source: collinearity, Kraus (2007), sec. 4.2.1.
    """
    return np.asarray(np.column_stack([uv, -np.ones(len(uv))]) @ rotation.T)


@checked_arguments(position="3", rotation="3 3", points="n 3")
def project(camera: Camera, position: FloatArray, rotation: FloatArray, points: FloatArray) -> FloatArray:
    """Return pixel coordinates of object points by the collinearity equations.

    Args:
        camera: interior orientation.
        position: projection centre X0, shape (3,), object unit.
        rotation: R, image to object axes, shape (3, 3).
        points: object points, shape (n, 3), object unit.

    Returns:
        Pixel coordinates, shape (n, 2), px; NaN for points that the camera does not see: behind it, if its
        model takes tangents.

    Example:
        >>> camera = camera_from_values("D3", "brown", (6000, 4000), (0.004, 0.004), c_mm=20.0)
        >>> project(camera, np.array([0.0, 0.0, 2.0]), np.eye(3), np.array([[0.1, 0.2, 0.0]]))
        array([[3249.5, 1499.5]])

    Source: Kraus (2007), eq. 5.1-1.
    """
    return pixel_from_rays(camera, (np.asarray(points, dtype=float) - position) @ rotation)


def in_field(
    camera: Camera, position: FloatArray, rotation: FloatArray, points: FloatArray, reach_px: float = 0.0
) -> BoolArray:
    """Return which object points are in the field of view of a photograph, (n,); no other can be shown in it.

    To project what is far outside may take long.

    Args:
        camera: interior orientation.
        position: projection centre X0, shape (3,), object unit.
        rotation: R, image to object axes, shape (3, 3).
        points: object points, shape (n, 3), object unit; those that are not finite are seen nowhere.
        reach_px: how far the field reaches beyond the edges of the photograph, px.
    """
    rays = (points - position) @ rotation
    off_axis = np.arctan2(np.linalg.norm(rays[:, :2], axis=1), -rays[:, 2])
    field = camera.field_angle  # up to a right angle, and lenses that reach it may reach beyond
    widest = np.pi if field >= np.pi / 2 else FIELD_MARGIN * field + reach_px / camera.c_px
    return np.asarray(off_axis <= widest)


def pixel_jacobian(camera: Camera, xy_px: FloatArray) -> FloatArray:
    """Return d (x, y) / d (u, v), the change of pixel coordinates with the tangents of the rays.

    Args:
        camera: interior orientation.
        xy_px: pixel coordinates, shape (k, 2), px.

    Returns:
        Derivatives, shape (k, 2, 2), px, from the inverse of central differences over two pixels; NaN 90
        degrees or more from the axis, where `ray_jacobian` has them.
    """
    by_plane = _jacobian_in_plane(camera, xy_px)
    if not MODELS[camera.model].stereographic:
        return by_plane
    uv = tangents_from_pixel(camera, xy_px)
    rays = np.column_stack([uv, -np.ones(len(uv))])
    return np.asarray(by_plane @ _plane_by_rays(camera, rays)[:, :, :2])


def ray_jacobian(camera: Camera, xy_px: FloatArray, rays: FloatArray) -> FloatArray:
    """Return d (x, y) / d (U, V, W), the change of pixel coordinates with their rays.

    Args:
        camera: interior orientation.
        xy_px: pixel coordinates, shape (k, 2), px.
        rays: the directions that they show, of any length, in the image frame, shape (k, 3).

    Returns:
        Derivatives, shape (k, 2, 3), px over the unit of the rays; NaN without a ray.
    """
    return np.asarray(_jacobian_in_plane(camera, xy_px) @ _plane_by_rays(camera, rays))


def _jacobian_in_plane(camera: Camera, xy_px: FloatArray) -> FloatArray:
    """Return the derivatives of pixels by the coordinates u, v that the camera's model takes, (k, 2, 2)."""
    columns = []
    for step in np.eye(2):
        ahead = _rays_in_plane(camera, xy_px + step)
        columns.append((ahead - _rays_in_plane(camera, xy_px - step)) / 2)
    return np.asarray(np.linalg.inv(np.stack(columns, axis=-1)))


def _plane_by_rays(camera: Camera, rays: FloatArray) -> FloatArray:
    """Return the derivatives of the coordinates u, v that a camera's model takes by rays, (k, 2, 3)."""
    uv, eye = plane_from_rays(camera, rays), np.eye(2)
    if not MODELS[camera.model].stereographic:
        by = np.concatenate([np.tile(eye, (len(uv), 1, 1)), uv[:, :, None]], axis=2)
        return np.asarray(by / -rays[:, 2, None, None])
    length = np.linalg.norm(rays, axis=1)
    # u = 2 U / D with D = L - W, and dL is the unit vector along the ray
    D = length - rays[:, 2]
    by_D = rays / length[:, None] - (0.0, 0.0, 1.0)
    flat = np.concatenate([np.tile(2.0 * eye, (len(uv), 1, 1)), np.zeros((len(uv), 2, 1))], axis=2)
    return np.asarray((flat - uv[:, :, None] * by_D[:, None, :]) / D[:, None, None])


def pixel_curvature(camera: Camera, uv: FloatArray, turned: FloatArray | None = None) -> FloatArray:
    """Return d^2 (x, y) / d (u, v)^2: how much distortion bends lines that are straight in the tangents.

    Args:
        camera: interior orientation.
        uv: tangents of rays, shape (k, 2).
        turned: axes in which they are tangents, as rotations into the image frame, shape (k, 3, 3); the image
            frame if not given.

    Returns:
        Second derivatives [:, i, a, b] of pixel coordinate i, shape (k, 2, 2, 2), px, from differences over
        CURVATURE_STEP. They are NaN where the distortion folds over.
    """
    u, v = CURVATURE_STEP * np.eye(2)

    def seen(tangents: FloatArray) -> FloatArray:
        if turned is None:
            return pixel_from_tangents(camera, tangents)
        rays = np.column_stack([tangents, -np.ones(len(tangents))])
        return pixel_from_rays(camera, np.einsum("kij,kj->ki", turned, rays))

    def mixed(a: FloatArray, b: FloatArray) -> FloatArray:
        ends = (a + b, a - b, b - a, -a - b)
        one, two, three, four = (seen(uv + step) for step in ends)
        return np.asarray((one - two - three + four) / (4 * CURVATURE_STEP**2))

    uv_part = mixed(u, v)
    rows = [[mixed(u, u), uv_part], [uv_part, mixed(v, v)]]
    return np.asarray(np.moveaxis(np.array(rows), (2, 3), (0, 1)))


@compiled
def _rays(model: int, frame: FloatArray, p: FloatArray, corrects: bool, xy: FloatArray) -> FloatArray:
    """Return the rays of pixels; correction models are linear in tangents, so that one step is exact."""
    residual, J, Jp, at = np.empty(2), np.empty((2, 2)), np.empty((2, MAX_PARAMETERS)), np.empty(2)
    uv = np.empty_like(xy)
    clear = 0.0
    if not corrects:
        clear = _clear_radius(model, frame, p, corrects, len(xy), np.empty(2), residual, J, Jp, at)
    for i in range(len(xy)):
        if corrects:
            at[0] = at[1] = 0.0
            observe(model, frame, p, xy[i, 0], xy[i, 1], 0.0, 0.0, residual, J, Jp)
            _newton_step(residual, J, at)
        else:
            _solve(model, frame, p, False, xy[i], clear, residual, J, Jp, at)
        uv[i] = at
    return uv


@compiled
def _pixels(model: int, frame: FloatArray, p: FloatArray, corrects: bool, uv: FloatArray) -> FloatArray:
    """Return the pixels of rays; models that distort the ideal point give them directly."""
    residual, J, Jp, at = np.empty(2), np.empty((2, 2)), np.empty((2, MAX_PARAMETERS)), np.empty(2)
    xy = np.empty_like(uv)
    clear = _clear_radius(model, frame, p, corrects, len(uv), np.empty(2), residual, J, Jp, at)
    for i in range(len(uv)):
        if corrects:
            _solve(model, frame, p, True, uv[i], clear, residual, J, Jp, at)
        elif np.hypot(uv[i, 0], uv[i, 1]) < clear or _is_monotone(
            model, frame, p, uv[i], residual, J, Jp, at
        ):
            at[0], at[1] = frame[0], frame[1]
            for _ in range(2):  # the second step removes the rounding of large coordinates
                observe(model, frame, p, at[0], at[1], uv[i, 0], uv[i, 1], residual, J, Jp)
                at += residual
        else:
            at[:] = np.nan
        xy[i] = at
    return xy


@compiled
def residuals_of_rays(
    model: int, frame: FloatArray, p: FloatArray, xy: FloatArray, uv: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals, (k, 2), and their derivatives by the parameters, (k, 2, n), at pixels and rays.

    Args:
        model: index of the distortion model.
        frame: linear frame of the camera.
        p: its parameters, (n,).
        xy: pixel coordinates, px, (k, 2).
        uv: coordinates of the rays in the plane of the model, (k, 2); see `plane_from_rays`.
    """
    residual, J, Jp = np.empty(2), np.empty((2, 2)), np.zeros((2, MAX_PARAMETERS))
    residuals = np.empty((len(xy), 2))
    jacobian = np.empty((len(xy), 2, len(p)))
    for i in range(len(xy)):
        observe(model, frame, p, xy[i, 0], xy[i, 1], uv[i, 0], uv[i, 1], residual, J, Jp)
        residuals[i] = residual
        jacobian[i] = Jp[:, : len(p)]
    return residuals, jacobian


@kernel
def _clear_radius(
    model: int, frame: FloatArray, p: FloatArray, corrects: bool, count: int,
    known: FloatArray, residual: FloatArray, J: FloatArray, Jp: FloatArray, at: FloatArray,
) -> float:  # fmt: skip
    """Return a distance of the unknown from the axis within which the model is monotone in all directions.

    It is 0 for so few points that testing each of them takes less time.
    """
    if count <= DIRECTIONS:
        return 0.0
    x_axis, y_axis = _axis(frame, p, corrects)
    known[0] = known[1] = 0.0  # the range does not depend on it
    _linearise(model, frame, p, corrects, known, x_axis, y_axis, residual, J, Jp)
    axis = J[0, 0], J[0, 1], J[1, 0], J[1, 1]
    per_unknown = 1.0 if corrects else np.sqrt(abs(axis[0] * axis[3] - axis[1] * axis[2]))
    narrowest = np.hypot(frame[0], frame[1]) / per_unknown / PLACES
    radius = PLACES * WIDEST * narrowest
    for k in range(DIRECTIONS):
        t = 2.0 * np.pi * k / DIRECTIONS
        at[0], at[1] = x_axis + radius * np.cos(t), y_axis + radius * np.sin(t)
        while not _stays_monotone(
            model, frame, p, corrects, known, axis, x_axis, y_axis, at, residual, J, Jp
        ):
            radius *= NARROWER
            if not radius > narrowest:
                return 0.0
            at[0], at[1] = x_axis + radius * np.cos(t), y_axis + radius * np.sin(t)
    return float(CERTAIN * radius)


@kernel
def _solve(
    model: int, frame: FloatArray, p: FloatArray, corrects: bool, known: FloatArray, clear: float,
    residual: FloatArray, J: FloatArray, Jp: FloatArray, at: FloatArray,
) -> None:  # fmt: skip
    """Find the pixel of a known ray (correction models), or the ray of a known pixel, in `at`.

    Newton's method begins on the axis. Its steps are halved until they stay within the monotone range and
    reduce the residual, so that it finds the only solution there; NaN if there is none. Within the clear
    radius around the axis the model is known to be monotone.
    """
    x_axis, y_axis = _axis(frame, p, corrects)
    at[0], at[1] = x_axis, y_axis
    _linearise(model, frame, p, corrects, known, x_axis, y_axis, residual, J, Jp)
    axis = J[0, 0], J[0, 1], J[1, 0], J[1, 1]
    for _ in range(STEPS):
        length = np.hypot(residual[0], residual[1])
        before_x, before_y = at[0], at[1]
        total = abs(residual[0]) + abs(residual[1])
        _newton_step(residual, J, at)
        dx, dy = at[0] - before_x, at[1] - before_y
        near = STEP_TOLERANCE * (1.0 + abs(at[0]) + abs(at[1]))
        if abs(dx) + abs(dy) < near or total < PIXEL_TOLERANCE:
            return
        accepted = False
        for _ in range(HALVINGS):
            at[0], at[1] = before_x + dx, before_y + dy
            if np.hypot(at[0] - x_axis, at[1] - y_axis) < clear:
                _linearise(model, frame, p, corrects, known, at[0], at[1], residual, J, Jp)
                accepted = True
            else:
                accepted = _stays_monotone(
                    model, frame, p, corrects, known, axis, before_x, before_y, at, residual, J, Jp
                )
            accepted = accepted and np.hypot(residual[0], residual[1]) < length
            if accepted:
                break
            dx, dy = dx / 2.0, dy / 2.0
        if not accepted:
            break
    at[0] = at[1] = np.nan


@kernel
def _is_monotone(
    model: int, frame: FloatArray, p: FloatArray, uv: FloatArray,
    residual: FloatArray, J: FloatArray, Jp: FloatArray, at: FloatArray,
) -> bool:  # fmt: skip
    """Return whether the distortion of the ideal point is monotone from the axis to the ray (u, v)."""
    _linearise(model, frame, p, False, frame, 0.0, 0.0, residual, J, Jp)
    axis = J[0, 0], J[0, 1], J[1, 0], J[1, 1]
    left = np.hypot(uv[0], uv[1])
    x, y, reached = 0.0, 0.0, 0.0
    while reached < left:  # in steps that double, since rays near 90 or 180 degrees have large coordinates
        reached = min(2.0 * reached + 1.0, left)
        at[0], at[1] = uv[0] * (reached / left), uv[1] * (reached / left)
        if not _stays_monotone(model, frame, p, False, frame, axis, x, y, at, residual, J, Jp):
            return False
        x, y = at[0], at[1]
    return bool(left < np.inf)


@kernel
def _stays_monotone(
    model: int, frame: FloatArray, p: FloatArray, corrects: bool, known: FloatArray,
    axis: tuple[float, float, float, float], x: float, y: float, at: FloatArray,
    residual: FloatArray, J: FloatArray, Jp: FloatArray,
) -> bool:  # fmt: skip
    """Return whether the model is monotone from (x, y) to `at`; fill its residual and derivatives there.

    It advances from place to place, and its derivatives keep the orientation that they have on the axis.
    """
    x_axis, y_axis = _axis(frame, p, corrects)
    dx, dy = at[0] - x, at[1] - y
    part = np.hypot(dx, dy) / np.hypot(at[0] - x_axis, at[1] - y_axis)
    # without a bound a step back to the axis would be checked at any number of places
    places = 1 + int(PLACES * min(part, 1.0))
    xx, xy, yx, yy = axis
    ahead_x, ahead_y = xx * dx + xy * dy, yx * dx + yy * dy
    if places > 1:  # in a shorter step the advance may be less than rounding
        _linearise(model, frame, p, corrects, known, x, y, residual, J, Jp)
    for k in range(1, places + 1):
        before = residual[0] * ahead_x + residual[1] * ahead_y
        f = k / places
        _linearise(model, frame, p, corrects, known, x + f * dx, y + f * dy, residual, J, Jp)
        if k < places and not _has_orientation(J, axis):
            f -= RING * f
            _linearise(model, frame, p, corrects, known, x + f * dx, y + f * dy, residual, J, Jp)
        advances = places == 1 or residual[0] * ahead_x + residual[1] * ahead_y > before
        if not (advances and _has_orientation(J, axis)):
            return False
    return True


@inlined
def _has_orientation(J: FloatArray, axis: tuple[float, float, float, float]) -> bool:
    """Return whether the inverse derivatives on the axis, times J, have positive determinant and trace."""
    xx, xy, yx, yy = axis
    orientation = xx * yy - xy * yx
    determinant = (J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]) / orientation
    trace = (yy * J[0, 0] - xy * J[1, 0] - yx * J[0, 1] + xx * J[1, 1]) / orientation
    return bool(determinant > 0.0 and trace > 0.0)


@kernel
def _linearise(
    model: int, frame: FloatArray, p: FloatArray, corrects: bool, known: FloatArray, x: float, y: float,
    residual: FloatArray, J: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Fill the residual of the unknown (x, y) with the known, and its derivatives by the unknown.

    Correction models move with the measured point as they do, with the opposite sign, with the principal
    point, which is their second and third parameter.
    """
    if corrects:
        observe(model, frame, p, x, y, known[0], known[1], residual, J, Jp)
        for k in range(2):
            J[k, 0], J[k, 1] = -Jp[k, 1] * frame[2], Jp[k, 2] * frame[3]
    else:
        observe(model, frame, p, known[0], known[1], x, y, residual, J, Jp)


@inlined
def _axis(frame: FloatArray, p: FloatArray, corrects: bool) -> tuple[float, float]:
    """Return the unknown on the axis: the principal point (px) of correction models, else a ray at 0."""
    if corrects:
        return frame[0] + p[1] / frame[2], frame[1] - p[2] / frame[3]
    return 0.0, 0.0


@inlined
def _newton_step(residual: FloatArray, J: FloatArray, at: FloatArray) -> None:
    """Move `at` by a step of Newton's method."""
    det = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
    at[0] -= (J[1, 1] * residual[0] - J[0, 1] * residual[1]) / det
    at[1] -= (J[0, 0] * residual[1] - J[1, 0] * residual[0]) / det


def corner_shift(camera: Camera, s: int, sigma: float) -> float:
    """Return how far a change of parameter s by sigma moves the corner, as a fraction of the half diagonal.

    The corner of a wide-angle photograph may lie farther from the axis than any ray reaches. Then the
    farthest position on the diagonal that has a ray takes its place.
    """
    if not np.isfinite(sigma):
        return np.inf
    inwards = np.linspace(0.0, 0.5, DIAGONAL_PLACES) if camera.wide_angle else np.zeros(1)
    places = inwards[:, None] * (np.array(camera.size_px) - 1)
    p = camera.parameters.copy()
    p[s] += sigma
    moved = pixel_from_rays(camera.with_parameters(p), rays_from_pixel(camera, places)) - places
    reach = 2 * np.hypot(*moved.T) / float(np.hypot(*camera.size_px))
    known = np.isfinite(reach)
    return float(reach[known.argmax()]) if known.any() else np.inf
