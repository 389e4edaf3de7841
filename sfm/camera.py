"""Camera: interior orientation and the four distortion models, each with its Jacobian.

A model is one compiled function `model(frame, p, x, y, u, v, r, Ju, Jp)`. From the tangents (u, v) of
the ray in the image frame (u = -U/W, v = -V/W, y up) and the measured pixel (x, y) it fills

    r  (2,)     computed minus measured, px, pixel frame (y down)
    Ju (2, 2)   d r / d (u, v)
    Jp (2, n)   d r / d p in the order of the model's parameter names

`brown` corrects the measured point (the way of photogrammetry since Brown 1971), the others distort
the ideal point; in both cases r vanishes at the true parameters. To add a model: write its function,
give it a line in `MODELS` and a branch in `observe`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

from sfm.conventions import BoolArray, FloatArray
from sfm.errors import SurveyFileError

MAX_PARAMETERS = 12
FIXED_POINT_STEPS = 100
PIXEL_TOLERANCE = 1e-11


@dataclass(frozen=True)
class Model:
    """What the parameters of a distortion model are called and measured in."""

    name: str
    names: tuple[str, ...]  # parameters in the order of the vector
    units: tuple[str, ...]  # unit of each parameter
    index: int  # number by which the compiled `observe` knows the model


_BROWN_UNITS = ("mm", "mm", "mm", "mm^-2", "mm^-4", "mm^-6")
BROWN = Model(
    "brown",
    ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "b1", "b2"),
    (*_BROWN_UNITS, "mm^-1", "mm^-1", "1", "1"),
    0,
)
BROWN_FORWARD = Model(
    "brown_forward",
    ("c", "x0", "y0", "K1", "K2", "K3", "K4", "P1", "P2", "b1", "b2"),
    (*_BROWN_UNITS, "mm^-8", "mm^-1", "mm^-1", "1", "1"),
    1,
)
OPENCV = Model(
    "opencv",
    ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    ("px", "px", "px", "px", "1", "1", "1", "1"),
    2,
)
FULL_OPENCV = Model(
    "full_opencv",
    ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    ("px", "px", "px", "px", "1", "1", "1", "1", "1", "1", "1", "1"),
    3,
)
MODELS = {model.name: model for model in (BROWN, BROWN_FORWARD, OPENCV, FULL_OPENCV)}


@dataclass(frozen=True)
class Camera:
    """Interior orientation of one camera, shared by the photographs taken with it."""

    name: str
    model: str  # brown | brown_forward | opencv | full_opencv
    size_px: tuple[int, int]  # width and height of its photographs, px
    pixel_mm: FloatArray  # width and height of a pixel, mm, (2,)
    parameters: FloatArray  # in the order of MODELS[model].names and in its units, (n,)
    free: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))  # to be adjusted, (n,)

    def __post_init__(self) -> None:
        n = len(self.names)
        if len(self.parameters) != n:
            raise SurveyFileError(
                f"camera {self.name}: {len(self.parameters)} parameters, model {self.model} has {n}"
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

    @property
    def index(self) -> int:
        """Number by which compiled code knows the model."""
        return MODELS[self.model].index

    @property
    def frame(self) -> FloatArray:
        """Centre of the photograph (px) and pixel size (mm) as compiled code takes them, (4,)."""
        width, height = self.size_px
        return np.array([(width - 1) / 2, (height - 1) / 2, self.pixel_mm[0], self.pixel_mm[1]])

    @property
    def c_px(self) -> float:
        """Principal distance in px (mean of both directions)."""
        if self.model.startswith("brown"):
            return float(self.parameters[0] / np.mean(self.pixel_mm))
        return float(np.mean(self.parameters[:2]))

    def value(self, name: str) -> float:
        """Value of one parameter in its unit; KeyError if the model has none of that name."""
        if name not in self.names:
            raise KeyError(name)
        return float(self.parameters[self.names.index(name)])

    def with_parameters(self, parameters: FloatArray) -> Camera:
        """Return the same camera with other parameter values, shape (n,)."""
        return replace(self, parameters=np.array(parameters, dtype=float))


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
    """Return a camera from its principal distance and whatever other parameters are known.

    Args:
        name: what people call the camera.
        model: one of MODELS.
        size_px: width and height of its photographs, px.
        pixel_mm: width and height of a pixel, mm.
        c_mm: principal distance, mm; for opencv models it gives fx and fy.
        free: names of the parameters that are to be adjusted.
        values: (name, value) of parameters in the model's units; all others are 0, and the principal
            point of opencv models is the centre of the photograph.

    Raises:
        SurveyFileError: unknown model or parameter name.
    """
    if model not in MODELS:
        raise SurveyFileError(f"camera {name}: model '{model}' is none of {', '.join(MODELS)}")
    names = MODELS[model].names
    for given in (*free, *(key for key, _ in values)):
        if given not in names:
            raise SurveyFileError(
                f"camera {name}: model {model} has no parameter '{given}', it has {', '.join(names)}"
            )
    p = dict.fromkeys(names, 0.0)
    if model.startswith("brown"):
        p["c"] = c_mm
    else:
        p["fx"], p["fy"] = c_mm / pixel_mm[0], c_mm / pixel_mm[1]
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


def tangents_from_pixel(camera: Camera, xy_px: FloatArray) -> FloatArray:
    """Return the tangents (u, v) of the rays through pixels, distortion removed.

    Args:
        camera: interior orientation.
        xy_px: pixel coordinates, shape (k, 2), px.

    Returns:
        u = -U/W and v = -V/W (image axes, y up), shape (k, 2); NaN where the model cannot be inverted.
    """
    xy = np.ascontiguousarray(xy_px, dtype=float).reshape(-1, 2)
    return _tangents(camera.index, camera.frame, camera.parameters, xy)


def pixel_from_tangents(camera: Camera, uv: FloatArray) -> FloatArray:
    """Return the pixel coordinates at which rays with tangents (u, v) are seen.

    Args:
        camera: interior orientation.
        uv: u = -U/W and v = -V/W (image axes, y up), shape (k, 2).

    Returns:
        Pixel coordinates, shape (k, 2), px; NaN where the distortion folds over.
    """
    rays = np.ascontiguousarray(uv, dtype=float).reshape(-1, 2)
    return _pixels(camera.index, camera.frame, camera.parameters, rays)


def project(camera: Camera, position: FloatArray, rotation: FloatArray, points: FloatArray) -> FloatArray:
    """Return pixel coordinates of object points by the collinearity equations.

    Args:
        camera: interior orientation.
        position: projection centre X0, shape (3,), object unit.
        rotation: R, image to object axes, shape (3, 3).
        points: object points, shape (n, 3), object unit.

    Returns:
        Pixel coordinates, shape (n, 2), px; NaN for points behind the camera.

    Source: Kraus (2007), eq. 5.1-1.
    """
    UVW = (np.asarray(points, dtype=float) - position) @ rotation
    in_front = UVW[:, 2] < 0
    W = np.where(in_front, UVW[:, 2], np.nan)
    return pixel_from_tangents(camera, -UVW[:, :2] / W[:, None])


def pixel_jacobian(camera: Camera, xy_px: FloatArray) -> FloatArray:
    """Return d (x, y) / d (u, v), how pixels move with the tangents of their rays.

    Args:
        camera: interior orientation.
        xy_px: pixel coordinates, shape (k, 2), px.

    Returns:
        Derivatives, shape (k, 2, 2), px; the inverse of central differences over two pixels.
    """
    columns = []
    for step in np.eye(2):
        ahead = tangents_from_pixel(camera, xy_px + step)
        columns.append((ahead - tangents_from_pixel(camera, xy_px - step)) / 2)
    return np.linalg.inv(np.stack(columns, axis=-1))


@njit(cache=True, inline="always", error_model="numpy")
def brown(frame, p, x, y, u, v, r, Ju, Jp):  # type: ignore[no-untyped-def]
    """Corrections of the measured point: c, x0, y0, K1-K3, P1, P2, affinity b1, shear b2.

    Source: Brown (1971), Photogramm. Eng. 37(8); signs as PhotoModeler and DBAT:
    xb = (1 + b1)(x - x0) + b2 (y - y0), yb = y - y0, r2 = xb^2 + yb^2,
    xc = xb (1 + K1 r2 + K2 r4 + K3 r6) + P1 (r2 + 2 xb^2) + 2 P2 xb yb, yc likewise; xc = c u.
    """
    sx, sy = frame[2], frame[3]
    c, x0, y0, K1, K2, K3, P1, P2, b1, b2 = p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9]
    xm = (x - frame[0]) * sx - x0
    yb = -(y - frame[1]) * sy - y0
    xb = (1.0 + b1) * xm + b2 * yb
    r2 = xb * xb + yb * yb
    r4 = r2 * r2
    r6 = r4 * r2
    radial = 1.0 + K1 * r2 + K2 * r4 + K3 * r6
    slope = 2.0 * (K1 + 2.0 * K2 * r2 + 3.0 * K3 * r4)  # d radial = slope (xb dxb + yb dyb)
    xc = xb * radial + P1 * (r2 + 2.0 * xb * xb) + 2.0 * P2 * xb * yb
    yc = yb * radial + P2 * (r2 + 2.0 * yb * yb) + 2.0 * P1 * xb * yb
    # d (xc, yc) / d (xb, yb)
    xx = radial + slope * xb * xb + 6.0 * P1 * xb + 2.0 * P2 * yb
    xy = slope * xb * yb + 2.0 * P1 * yb + 2.0 * P2 * xb
    yy = radial + slope * yb * yb + 6.0 * P2 * yb + 2.0 * P1 * xb
    fx, fy = 1.0 / sx, -1.0 / sy  # mm, y up -> px, y down
    r[0] = fx * (c * u - xc)
    r[1] = fy * (c * v - yc)
    Ju[0, 0] = fx * c
    Ju[0, 1] = 0.0
    Ju[1, 0] = 0.0
    Ju[1, 1] = fy * c
    Jp[0, 0] = fx * u
    Jp[1, 0] = fy * v
    Jp[0, 1] = fx * xx * (1.0 + b1)
    Jp[1, 1] = fy * xy * (1.0 + b1)
    Jp[0, 2] = fx * (xx * b2 + xy)
    Jp[1, 2] = fy * (xy * b2 + yy)
    Jp[0, 3] = -fx * xb * r2
    Jp[1, 3] = -fy * yb * r2
    Jp[0, 4] = -fx * xb * r4
    Jp[1, 4] = -fy * yb * r4
    Jp[0, 5] = -fx * xb * r6
    Jp[1, 5] = -fy * yb * r6
    Jp[0, 6] = -fx * (r2 + 2.0 * xb * xb)
    Jp[1, 6] = -fy * 2.0 * xb * yb
    Jp[0, 7] = -fx * 2.0 * xb * yb
    Jp[1, 7] = -fy * (r2 + 2.0 * yb * yb)
    Jp[0, 8] = -fx * xx * xm
    Jp[1, 8] = -fy * xy * xm
    Jp[0, 9] = -fx * xx * yb
    Jp[1, 9] = -fy * xy * yb


@njit(cache=True, inline="always", error_model="numpy")
def brown_forward(frame, p, x, y, u, v, r, Ju, Jp):  # type: ignore[no-untyped-def]
    """Distortion of the ideal point in mm: c, x0, y0, K1-K4, P1, P2, affinity b1, shear b2.

    Source: Agisoft Metashape manual, app. D, frame camera (there in units of c), and AICON; in mm
    X = c u, Y = c v, r2 = X^2 + Y^2, x = x0 + X (1 + K1 r2 + ... + K4 r8) + P1 (r2 + 2 X^2)
    + 2 P2 X Y + b1 X + b2 Y, y = y0 + Y (1 + ...) + P2 (r2 + 2 Y^2) + 2 P1 X Y.
    """
    sx, sy = frame[2], frame[3]
    c, x0, y0, K1, K2, K3, K4 = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    P1, P2, b1, b2 = p[7], p[8], p[9], p[10]
    X, Y = c * u, c * v
    r2 = X * X + Y * Y
    r4 = r2 * r2
    r6 = r4 * r2
    r8 = r4 * r4
    radial = 1.0 + K1 * r2 + K2 * r4 + K3 * r6 + K4 * r8
    slope = 2.0 * (K1 + 2.0 * K2 * r2 + 3.0 * K3 * r4 + 4.0 * K4 * r6)
    xd = x0 + X * radial + P1 * (r2 + 2.0 * X * X) + 2.0 * P2 * X * Y + b1 * X + b2 * Y
    yd = y0 + Y * radial + P2 * (r2 + 2.0 * Y * Y) + 2.0 * P1 * X * Y
    xX = radial + slope * X * X + 6.0 * P1 * X + 2.0 * P2 * Y + b1
    xY = slope * X * Y + 2.0 * P1 * Y + 2.0 * P2 * X + b2
    yX = slope * X * Y + 2.0 * P1 * Y + 2.0 * P2 * X
    yY = radial + slope * Y * Y + 6.0 * P2 * Y + 2.0 * P1 * X
    fx, fy = 1.0 / sx, -1.0 / sy
    r[0] = fx * xd + frame[0] - x
    r[1] = fy * yd + frame[1] - y
    Ju[0, 0] = fx * xX * c
    Ju[0, 1] = fx * xY * c
    Ju[1, 0] = fy * yX * c
    Ju[1, 1] = fy * yY * c
    Jp[0, 0] = fx * (xX * u + xY * v)
    Jp[1, 0] = fy * (yX * u + yY * v)
    Jp[0, 1] = fx
    Jp[1, 1] = 0.0
    Jp[0, 2] = 0.0
    Jp[1, 2] = fy
    Jp[0, 3] = fx * X * r2
    Jp[1, 3] = fy * Y * r2
    Jp[0, 4] = fx * X * r4
    Jp[1, 4] = fy * Y * r4
    Jp[0, 5] = fx * X * r6
    Jp[1, 5] = fy * Y * r6
    Jp[0, 6] = fx * X * r8
    Jp[1, 6] = fy * Y * r8
    Jp[0, 7] = fx * (r2 + 2.0 * X * X)
    Jp[1, 7] = fy * 2.0 * X * Y
    Jp[0, 8] = fx * 2.0 * X * Y
    Jp[1, 8] = fy * (r2 + 2.0 * Y * Y)
    Jp[0, 9] = fx * X
    Jp[1, 9] = 0.0
    Jp[0, 10] = fx * Y
    Jp[1, 10] = 0.0


@njit(cache=True, inline="always", error_model="numpy")
def opencv(frame, p, x, y, u, v, r, Ju, Jp):  # type: ignore[no-untyped-def]
    """Distortion of the ideal point in units of the focal length: fx, fy, cx, cy, k1, k2, p1, p2.

    Source: OpenCV calib3d and COLMAP, camera model OPENCV; there y is down, so a = u, b = -v.
    cx, cy count from the centre of the top-left pixel here, from its corner in COLMAP.
    """
    a, b = u, -v
    fx, fy, k1, k2, p1, p2 = p[0], p[1], p[4], p[5], p[6], p[7]
    r2 = a * a + b * b
    radial = 1.0 + k1 * r2 + k2 * r2 * r2
    slope = 2.0 * (k1 + 2.0 * k2 * r2)
    ad = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
    bd = b * radial + 2.0 * p2 * a * b + p1 * (r2 + 2.0 * b * b)
    _pinhole(p, x, y, a, b, ad, bd, radial, slope, p1, p2, r, Ju, Jp)
    Jp[0, 4] = fx * a * r2
    Jp[1, 4] = fy * b * r2
    Jp[0, 5] = fx * a * r2 * r2
    Jp[1, 5] = fy * b * r2 * r2
    _tangential(fx, fy, a, b, r2, Jp)


@njit(cache=True, inline="always", error_model="numpy")
def full_opencv(frame, p, x, y, u, v, r, Ju, Jp):  # type: ignore[no-untyped-def]
    """As `opencv` with the rational radial term (1 + k1 r2 + k2 r4 + k3 r6)/(1 + k4 r2 + k5 r4 + k6 r6).

    Source: OpenCV calib3d and COLMAP, camera model FULL_OPENCV (parameters in the same order).
    """
    a, b = u, -v
    fx, fy, p1, p2 = p[0], p[1], p[6], p[7]
    r2 = a * a + b * b
    r4 = r2 * r2
    r6 = r4 * r2
    top = 1.0 + p[4] * r2 + p[5] * r4 + p[8] * r6
    below = 1.0 / (1.0 + p[9] * r2 + p[10] * r4 + p[11] * r6)
    radial = top * below
    dtop = p[4] + 2.0 * p[5] * r2 + 3.0 * p[8] * r4
    dbottom = p[9] + 2.0 * p[10] * r2 + 3.0 * p[11] * r4
    slope = 2.0 * below * (dtop - radial * dbottom)
    ad = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
    bd = b * radial + 2.0 * p2 * a * b + p1 * (r2 + 2.0 * b * b)
    _pinhole(p, x, y, a, b, ad, bd, radial, slope, p1, p2, r, Ju, Jp)
    power = r2 * below
    for j in range(3):
        numerator = 4 + j if j < 2 else 8
        Jp[0, numerator] = fx * a * power
        Jp[1, numerator] = fy * b * power
        Jp[0, 9 + j] = -fx * a * power * radial
        Jp[1, 9 + j] = -fy * b * power * radial
        power *= r2
    _tangential(fx, fy, a, b, r2, Jp)


@njit(cache=True, inline="always", error_model="numpy")
def _pinhole(p, x, y, a, b, ad, bd, radial, slope, p1, p2, r, Ju, Jp):  # type: ignore[no-untyped-def]
    """The part common to both OpenCV models: residual, d/d(u, v), d/d(fx, fy, cx, cy)."""
    fx, fy = p[0], p[1]
    r[0] = fx * ad + p[2] - x
    r[1] = fy * bd + p[3] - y
    cross = slope * a * b + 2.0 * p1 * a + 2.0 * p2 * b
    Ju[0, 0] = fx * (radial + slope * a * a + 2.0 * p1 * b + 6.0 * p2 * a)
    Ju[0, 1] = -fx * cross
    Ju[1, 0] = fy * cross
    Ju[1, 1] = -fy * (radial + slope * b * b + 2.0 * p2 * a + 6.0 * p1 * b)
    Jp[0, 0] = ad
    Jp[1, 0] = 0.0
    Jp[0, 1] = 0.0
    Jp[1, 1] = bd
    Jp[0, 2] = 1.0
    Jp[1, 2] = 0.0
    Jp[0, 3] = 0.0
    Jp[1, 3] = 1.0


@njit(cache=True, inline="always", error_model="numpy")
def _tangential(fx, fy, a, b, r2, Jp):  # type: ignore[no-untyped-def]
    """d r / d (p1, p2), common to both OpenCV models."""
    Jp[0, 6] = fx * 2.0 * a * b
    Jp[1, 6] = fy * (r2 + 2.0 * b * b)
    Jp[0, 7] = fx * (r2 + 2.0 * a * a)
    Jp[1, 7] = fy * 2.0 * a * b


@njit(cache=True, inline="always", error_model="numpy")
def observe(model, frame, p, x, y, u, v, r, Ju, Jp):  # type: ignore[no-untyped-def]
    """Fill r, Ju and Jp by the model of that number (Model.index)."""
    if model == 0:
        brown(frame, p, x, y, u, v, r, Ju, Jp)
    elif model == 1:
        brown_forward(frame, p, x, y, u, v, r, Ju, Jp)
    elif model == 2:
        opencv(frame, p, x, y, u, v, r, Ju, Jp)
    else:
        full_opencv(frame, p, x, y, u, v, r, Ju, Jp)


@njit(cache=True, error_model="numpy")
def _tangents(model, frame, p, xy):  # type: ignore[no-untyped-def]
    """Newton's method on r(u, v) = 0; exact after one step for `brown`, where r is linear in u, v."""
    r, Ju, Jp = np.empty(2), np.empty((2, 2)), np.empty((2, MAX_PARAMETERS))
    uv = np.empty_like(xy)
    for i in range(len(xy)):
        u, v = 0.0, 0.0
        solved = False
        for _ in range(FIXED_POINT_STEPS):
            observe(model, frame, p, xy[i, 0], xy[i, 1], u, v, r, Ju, Jp)
            det = Ju[0, 0] * Ju[1, 1] - Ju[0, 1] * Ju[1, 0]
            du = (Ju[1, 1] * r[0] - Ju[0, 1] * r[1]) / det
            dv = (Ju[0, 0] * r[1] - Ju[1, 0] * r[0]) / det
            u -= du
            v -= dv
            if abs(du) + abs(dv) < 1e-15 * (1.0 + abs(u) + abs(v)) or abs(r[0]) + abs(r[1]) < PIXEL_TOLERANCE:
                solved = True
                break
        uv[i, 0] = u if solved else np.nan
        uv[i, 1] = v if solved else np.nan
    return uv


@njit(cache=True, error_model="numpy")
def _pixels(model, frame, p, uv):  # type: ignore[no-untyped-def]
    """Fixed point x <- x + r(x): r is computed minus measured, so distortion gradients contract it."""
    r, Ju, Jp = np.empty(2), np.empty((2, 2)), np.empty((2, MAX_PARAMETERS))
    xy = np.empty_like(uv)
    for i in range(len(uv)):
        x, y = frame[0], frame[1]
        solved = False
        for _ in range(FIXED_POINT_STEPS):
            observe(model, frame, p, x, y, uv[i, 0], uv[i, 1], r, Ju, Jp)
            x += r[0]
            y += r[1]
            if abs(r[0]) + abs(r[1]) < PIXEL_TOLERANCE:
                solved = True
                break
        xy[i, 0] = x if solved else np.nan
        xy[i, 1] = y if solved else np.nan
    return xy
