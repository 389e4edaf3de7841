"""Visibility of points from stations, precision of targets in photographs, depth of field and target sizes.

A photograph shows a point unless it is outside the format, too oblique, hidden by the surface, not sharp, or
too small.

The precision of a target follows from its size, contrast, blur and noise. An edge of contrast A, blurred by a
Gaussian of standard deviation s, contains per unit of length the information A^2 / (2 s sqrt(pi)) / noise^2
on a shift across it. The sum round an ellipse gives the Cramer-Rao bound of its centre. The measurement of
targets reaches this bound within about 5 % if the background is uniform.

    information = A^2 / (2 s sqrt(pi) noise^2) * integral of n n' dl
    circle of radius R: sigma^2 = 2 s noise^2 / (sqrt(pi) R A^2)

Source: Mason (1997), "Heuristic reasoning strategy for automated sensor placement", Photogramm. Eng. Remote
Sens. 63(9) (constraints of format, incidence, occlusion, depth of field and resolution); Luhmann et al.,
Close-Range Photogrammetry (2020), sec. 3.1.1.3; with the hyperfocal distance H = f^2 / (N c) + f, near s (H -
f) / (H + s - 2 f) and far s (H - f) / (H - s); Cramer-Rao bound; Foerstner and Wrobel (2016), sec. 4.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from sfm.model.arguments import checked_arguments
from sfm.model.camera import Camera, pixel_jacobian, project
from sfm.model.conventions import AnyArray, BoolArray, FloatArray
from sfm.model.errors import GeometryError
from sfm.products.planning.planned_object import PlannedObject, hidden_points

STEEPEST_DEG = 75.0  # beyond this tilt a target is not recognised
STEPS = 24  # of the integral round an ellipse; the integrand is smooth and periodic


@dataclass(frozen=True)
class TargetImage:
    """Appearance of targets in photographs."""

    contrast: float = 120.0  # step of intensity between target and surroundings
    noise: float = 2.0  # standard deviation of an intensity, same scale
    blur_px: float = 0.8  # standard deviation of the edge, including the box of a pixel

    def __post_init__(self) -> None:
        for name, value in (("contrast", self.contrast), ("noise", self.noise), ("blur", self.blur_px)):
            if not (math.isfinite(value) and value > 0):
                raise GeometryError(f"target: {name} is {value:g}, needed more than 0")


@dataclass(frozen=True)
class DepthOfField:
    """Distances along the optical axis between which points are sharp."""

    near: float
    far: float  # infinite beyond the hyperfocal distance
    focus: float  # distance in focus


MAX_INCIDENCE_DEG = 60.0  # of a ray to the normal; beyond it targets are measured badly or not at all
MIN_DIAMETER_PX = 5.0  # shorter axis of the smallest target that is measured
BORDER_PX = 2.0  # between a target and the edge of the photograph


class Visibility(IntEnum):
    """Whether a photograph shows a point, or why it does not."""

    SEEN = 0
    OUTSIDE = 1  # the photograph or behind the camera
    OBLIQUE = 2  # the angle of its ray to the normal is too large
    HIDDEN = 3  # by the surface
    UNSHARP = 4  # outside the depth of field
    SMALL = 5  # its target is too few pixels across


WORDS = {
    Visibility.OUTSIDE: "outside the photograph",
    Visibility.OBLIQUE: "too oblique",
    Visibility.HIDDEN: "hidden by the surface",
    Visibility.UNSHARP: "not sharp",
    Visibility.SMALL: "too few pixels",
}


@dataclass(frozen=True)
class Seeing:
    """Limits that decide whether a point is seen, and how precisely."""

    max_incidence_deg: float = MAX_INCIDENCE_DEG
    diameter: float | None = None  # of a target, object unit; None = every target has `sigma_px`
    min_diameter_px: float = MIN_DIAMETER_PX
    depth: DepthOfField | None = None  # object unit; None = everything is sharp
    sigma_px: float | None = None  # of an image coordinate; None = computed from diameter and `target`
    target: TargetImage = field(default_factory=TargetImage)

    def __post_init__(self) -> None:
        if self.diameter is None and self.sigma_px is None:
            raise GeometryError(
                "plan: neither a standard deviation of image coordinates nor a diameter of targets"
            )
        for name, value in (("diameter of targets", self.diameter), ("sigma_px", self.sigma_px)):
            if value is not None and not (np.isfinite(value) and value > 0):
                raise GeometryError(f"plan: {name} is {value:g}, needed more than 0")
        if not 0 < self.max_incidence_deg <= 90:
            raise GeometryError(f"plan: incidence up to {self.max_incidence_deg:g} deg, needed 0 to 90 deg")


@dataclass(frozen=True)
class Sight:
    """The n points in m photographs: their visibility, and image points with covariance."""

    visibility: AnyArray  # values of `Visibility`, (m, n)
    xy: FloatArray  # image points, px; NaN behind the camera, (m, n, 2)
    covariance: FloatArray  # of an image point, px^2; NaN if it is not seen, (m, n, 2, 2)
    diameter_px: (
        FloatArray  # shorter axis of the target; NaN if its size is unknown or it is not seen, (m, n)
    )

    @property
    def seen(self) -> BoolArray:
        """Which photograph shows which point, (m, n)."""
        return np.asarray(self.visibility == Visibility.SEEN)

    def of(self, photographs: AnyArray) -> Sight:
        """Return the visibility in the selected photographs."""
        return replace(
            self,
            visibility=self.visibility[photographs],
            xy=self.xy[photographs],
            covariance=self.covariance[photographs],
            diameter_px=self.diameter_px[photographs],
        )


@checked_arguments(position="m 3", rotation="m 3 3")
def sight_of(
    planned: PlannedObject, camera: Camera, position: FloatArray, rotation: FloatArray, seeing: Seeing
) -> Sight:
    """Return the visibility of points in photographs from stations.

    A point without a normal has no incidence, and counts as a target that faces the camera.

    Args:
        planned: points, normals and surface.
        camera: interior orientation.
        position: projection centres, object unit, (m, 3).
        rotation: R, image to object axes, (m, 3, 3).
        seeing: limits, and the appearance of targets.

    Source: Mason (1997), Photogramm. Eng. Remote Sens. 63(9).
    """
    m, n = len(position), len(planned.xyz)
    visibility = np.empty((m, n), dtype=np.uint8)
    xy, covariance = np.empty((m, n, 2)), np.empty((m, n, 2, 2))
    diameter = np.empty((m, n))
    hidden: dict[bytes, BoolArray] = {}  # or turned away
    for i in range(m):
        key = position[i].tobytes()  # photographs of one station that differ in their roll
        if key not in hidden:
            away = planned.normals * (position[i] - planned.xyz)
            turned = away.sum(axis=1) <= 0  # NaN for an unknown normal: not turned away
            if planned.tree is not None:
                turned |= hidden_points(planned.tree, position[i], planned.xyz)
            hidden[key] = turned
        visibility[i], xy[i], covariance[i], diameter[i] = _photograph(
            planned, camera, position[i], rotation[i], seeing, hidden[key]
        )
    return Sight(visibility, xy, covariance, diameter)


def _photograph(
    planned: PlannedObject,
    camera: Camera,
    position: FloatArray,
    rotation: FloatArray,
    seeing: Seeing,
    hidden: BoolArray,
) -> tuple[AnyArray, FloatArray, FloatArray, FloatArray]:
    n = len(planned.xyz)
    UVW = (planned.xyz - position) @ rotation
    depth = -UVW[:, 2]
    xy = project(camera, position, rotation, planned.xyz)
    width, height = camera.size_px
    border = BORDER_PX
    within = (xy > border).all(axis=1) & (xy < (width - 1 - border, height - 1 - border)).all(axis=1)
    inside = np.asarray(within)
    visibility = np.where(inside, Visibility.SEEN, Visibility.OUTSIDE).astype(np.uint8)
    ray = position - planned.xyz
    ray /= np.maximum(
        np.linalg.norm(ray, axis=1, keepdims=True), 1e-300
    )  # a station at a point does not see it
    cosine = (planned.normals * ray).sum(axis=1)
    oblique = cosine < np.cos(np.radians(seeing.max_incidence_deg))
    visibility[inside & oblique] = Visibility.OBLIQUE
    visibility[inside & hidden & ~(oblique & (cosine > 0))] = Visibility.HIDDEN
    visibility[inside & (cosine <= 0)] = Visibility.OBLIQUE
    if seeing.depth is not None:
        sharp = (depth >= seeing.depth.near) & (depth <= seeing.depth.far)
        visibility[(visibility == Visibility.SEEN) & ~sharp] = Visibility.UNSHARP
    covariance, shorter = np.full((n, 2, 2), np.nan), np.full(n, np.nan)
    used = np.flatnonzero(visibility == Visibility.SEEN)
    if seeing.diameter is not None and len(used):
        axes = _outlines(planned, camera, rotation, seeing.diameter, used, UVW[used], xy[used], ray[used])
        shorter[used] = 2 * np.linalg.svd(axes, compute_uv=False)[:, 1]
        covariance[used] = centre_covariance(axes, seeing.target)
        visibility[used[shorter[used] < seeing.min_diameter_px]] = Visibility.SMALL
    if seeing.sigma_px is not None:
        covariance[used] = seeing.sigma_px**2 * np.eye(2)
    covariance[visibility != Visibility.SEEN] = np.nan
    return visibility, xy, covariance, shorter


def _outlines(
    planned: PlannedObject,
    camera: Camera,
    rotation: FloatArray,
    diameter: float,
    used: AnyArray,
    UVW: FloatArray,
    xy: FloatArray,
    ray: FloatArray,
) -> FloatArray:
    """Return J of the images of circular targets to first order, px, (k, 2, 2), see `centre_covariance`."""
    normal = planned.normals[used]
    normal = np.where(np.isnan(normal), ray, normal)
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    a = np.cross(helper, normal)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(normal, a)
    U, V, W = UVW.T
    zero = np.zeros(len(U))
    of_tangents = np.stack(  # of u = -U / W and v = -V / W
        [np.stack([-1 / W, zero, U / W**2], axis=1), np.stack([zero, -1 / W, V / W**2], axis=1)], axis=1
    )
    plane = np.stack([a, b], axis=2)
    return np.asarray(pixel_jacobian(camera, xy) @ of_tangents @ rotation.T @ plane * diameter / 2)


@dataclass(frozen=True)
class Lens:
    """A lens and its setting; lengths in mm."""

    f_number: float  # focal length over the diameter of the aperture
    focus_mm: float  # distance of the plane in focus from the projection centre
    confusion_mm: float  # diameter of the circle of confusion that still counts as sharp


@checked_arguments()
def depth_of_field(lens: Lens, f_mm: float) -> DepthOfField:
    """Return the distances between which a lens is sharp, mm.

    Args:
        lens: the lens and its setting.
        f_mm: focal length, mm.

    Raises:
        GeometryError: a number that is not positive, or a focus within the focal length.

    Source: Luhmann et al., Close-Range Photogrammetry (2020), sec. 3.1.1.3.
    """
    for name, value in (
        ("f-number", lens.f_number),
        ("focus distance", lens.focus_mm),
        ("circle of confusion", lens.confusion_mm),
        ("focal length", f_mm),
    ):
        if not (math.isfinite(value) and value > 0):
            raise GeometryError(f"depth of field: {name} is {value:g}, needed more than 0")
    s = lens.focus_mm
    if s <= f_mm:
        raise GeometryError(
            f"depth of field: focus at {s:g} mm, needed farther than the focal length {f_mm:g} mm"
        )
    H = f_mm**2 / (lens.f_number * lens.confusion_mm) + f_mm
    return DepthOfField(
        s * (H - f_mm) / (H + s - 2 * f_mm), s * (H - f_mm) / (H - s) if s < H else math.inf, s
    )


def best_focus(near: float, far: float) -> float:
    """Return the focus distance with equal sharpness at the nearest and farthest point: 2 n f / (n + f)."""
    return 2 * near * far / (near + far)


@checked_arguments(axes="k 2 2")
def centre_covariance(axes: FloatArray, target: TargetImage) -> FloatArray:
    """Return the covariance of the centres of ellipses, px^2, (k, 2, 2).

    Args:
        axes: J of each ellipse, whose outline is J (cos t, sin t)', px, (k, 2, 2).
        target: contrast, noise and blur.

    Source: Cramer-Rao bound of a blurred edge, summed round the outline.
    """
    t = 2 * np.pi * np.arange(STEPS) / STEPS
    along = axes @ np.stack([-np.sin(t), np.cos(t)])  # (k, 2, steps)
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)
    length = np.linalg.norm(along, axis=1)
    turned = np.einsum("kat,kbt,kt->kab", across, across, 1 / np.maximum(length, 1e-300)) * (t[1] - t[0])
    factor = target.contrast**2 / (2 * target.blur_px * math.sqrt(math.pi) * target.noise**2)
    return np.asarray(np.linalg.inv(factor * turned))


@dataclass(frozen=True)
class TargetSize:
    """Size of targets for a camera and a distance."""

    diameter: float  # of the dot, unit of the distance
    ring: float  # outer diameter of a coded ring around it, unit of the distance
    pixel: float  # side of a pixel at the object, unit of the distance


@checked_arguments()
def compute_target_size(
    *, p: float, w_mm: float, d: float, c_mm: float, n: int, tilt_deg: float = 0.0, ring_per_dot: float = 3.0
) -> TargetSize:
    """Return the size of a target that is p pixels across: r = p w d / (c n).

    The image of an oblique target is shorter in one direction by the cosine of the tilt. Its diameter is
    enlarged accordingly, so that it is p pixels across even in this direction.

    Args:
        p: least number of pixels across the target.
        w_mm: width of the sensor, mm.
        d: farthest distance of the camera from the object, in any unit.
        c_mm: principal distance (focal length), mm.
        n: pixels along the width of the photograph.
        tilt_deg: largest angle between the ray and the normal of a target, deg.
        ring_per_dot: outer diameter of the code's ring in diameters of the dot.

    Raises:
        GeometryError: a number that is not positive, or a tilt at which targets are not recognised.

    Source: document 000, eq. 2.88 (manual of PhotoModeler), there r = p fw d / (f pw).
    """
    given = {"pixels": p, "sensor width": w_mm, "distance": d, "principal distance": c_mm, "photograph": n}
    for name, value in given.items():
        if not (math.isfinite(value) and value > 0):
            raise GeometryError(f"target size: {name} is {value:g}, needed more than 0")
    if not 0 <= tilt_deg <= STEEPEST_DEG:
        raise GeometryError(f"target size: tilt is {tilt_deg:g} deg, needed 0 to {STEEPEST_DEG:g} deg")
    pixel = w_mm * d / (c_mm * n)
    diameter = p * pixel / math.cos(math.radians(tilt_deg))
    return TargetSize(diameter, ring_per_dot * diameter, pixel)
