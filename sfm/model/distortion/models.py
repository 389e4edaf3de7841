"""The distortion models: a table of them with their parameters, and one function for all.

A model is a compiled function `model(frame, p, x, y, u, v, residual, Ju, Jp)`. Its inputs are

    frame (7,)      [0:2] centre of the photograph, px; [2:4] width and height of a pixel, mm
                    models in mm: [4] is 1 if residuals are those of the measured point, 0 if those of the
                    corrected one; [5] is 1 if affinity and shear act on the distorted point, 0 if on the
                    ideal one
                    models in px: [4] is the number of focal lengths, [5] the number of parameters after the
                    principal point
                    [6] is 1 if u, v are stereographic, 0 if they are tangents; for the callers of models
    p     (n,)      parameters in the order of the model's names
    x, y            measured pixel
    u, v            coordinates of the ray (U, V, W) in the image frame, y up, as the row of the model states.
                    Tangents are u = -U/W, v = -V/W, and end before 90 degrees from the axis.
                    Stereographic ones are u = 2 U/(L - W), v = 2 V/(L - W) with the length L of the ray, so
                    that sqrt(u^2 + v^2) = 2 tan(theta/2), and end before 180 degrees. Near the axis both are
                    equal.

and its outputs are

    residual (2,)   computed minus measured, px, pixel frame (y down)
    Ju (2, 2)       its derivatives by u and v
    Jp (2, n)       its derivatives by the parameters

Models of photogrammetry correct the measured point, and models of computer vision distort the ideal point. In
both cases the residual vanishes at the true parameters. It belongs to the measured point, except in the
models named after DBAT, whose residuals lie in the corrected plane.

To add a model, write its function in a module beside `brown` and add a row to a table below. Adjustment,
resection, conversion, survey file and reports follow from that row and from the role of each parameter in it.
The tests of derivatives and inverse cover it as well.

`brown_forward` is defined here: distortion of the ideal point in mm, with affinity and shear of the ideal or
of the distorted point. Its signs are those of PhotoModeler and DBAT.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

from sfm.model.conventions import FloatArray
from sfm.model.distortion.brown import brown, brown_affine
from sfm.model.distortion.opencv import full_opencv, opencv, rad_tan_thin_prism_fisheye, thin_prism_fisheye
from sfm.model.distortion.radial import division, eucm, fisheye, fov, radial
from sfm.model.distortion.splined import KNOTS, splined
from sfm.runtime.compiling import inlined, kernel


@inlined
def brown_forward(
    frame: FloatArray, p: FloatArray, x: float, y: float, u: float, v: float,
    residual: FloatArray, Ju: FloatArray, Jp: FloatArray,
) -> None:  # fmt: skip
    """Distortion of the ideal point in mm: c, x0, y0, K1-K4, P1, P2, affinity b1, shear b2.

    X = c u, Y = c v, r2 = X^2 + Y^2, xd = X (1 + K1 r2 + ... + K4 r8) + P1 (r2 + 2 X^2) + 2 P2 X Y,
    yd = Y (1 + ...) + P2 (r2 + 2 Y^2) + 2 P1 X Y, y = y0 + yd, and x = x0 + xd + b1 X + b2 Y or, where
    frame[5] is 1, x = x0 + xd + b1 xd + b2 yd.

    Source: AICON 3D Studio, and Luhmann et al., Close-Range Photogrammetry and 3D Imaging (2020), sec. 3.3,
    for affinity and shear of the ideal point; Zhang (2000), IEEE Trans. PAMI 22(11), whose skew is c b2, and
    the Agisoft Metashape manual, app. D, frame camera (there in units of c), for those of the distorted one.
    """
    sx, sy, on = frame[2], frame[3], frame[5]
    c, x0, y0, K1, K2, K3, K4 = p[0], p[1], p[2], p[3], p[4], p[5], p[6]
    P1, P2, b1, b2 = p[7], p[8], p[9], p[10]
    X, Y = c * u, c * v
    r2 = X * X + Y * Y
    r4 = r2 * r2
    r6 = r4 * r2
    r8 = r4 * r4
    radial = 1.0 + K1 * r2 + K2 * r4 + K3 * r6 + K4 * r8
    slope = 2.0 * (K1 + 2.0 * K2 * r2 + 3.0 * K3 * r4 + 4.0 * K4 * r6)
    P1x, P1y, P2y = r2 + 2.0 * X * X, 2.0 * X * Y, r2 + 2.0 * Y * Y  # P2x = P1y
    xd = X * radial + P1 * P1x + P2 * P1y
    yd = Y * radial + P2 * P2y + P1 * P1y
    dxx = radial + slope * X * X + 6.0 * P1 * X + 2.0 * P2 * Y
    dxy = slope * X * Y + 2.0 * P1 * Y + 2.0 * P2 * X  # = dyx
    dyy = radial + slope * Y * Y + 6.0 * P2 * Y + 2.0 * P1 * X
    # affinity and shear act on X and Y, or on xd and yd
    off = 1.0 - on
    xa, ya = off * X + on * xd, off * Y + on * yd
    a, s = 1.0 + on * b1, on * b2  # factors of the distortion
    fx, fy = 1.0 / sx, -1.0 / sy
    xX = a * dxx + s * dxy + off * b1
    xY = a * dxy + s * dyy + off * b2
    residual[0] = fx * (x0 + xd + b1 * xa + b2 * ya) + frame[0] - x
    residual[1] = fy * (y0 + yd) + frame[1] - y
    Ju[0, 0] = fx * xX * c
    Ju[0, 1] = fx * xY * c
    Ju[1, 0] = fy * dxy * c
    Ju[1, 1] = fy * dyy * c
    Jp[0, 0] = fx * (xX * u + xY * v)
    Jp[1, 0] = fy * (dxy * u + dyy * v)
    Jp[0, 1] = fx
    Jp[1, 1] = 0.0
    Jp[0, 2] = 0.0
    Jp[1, 2] = fy
    Kx, Ky = fx * (a * X + s * Y), fy * Y
    Jp[0, 3] = Kx * r2
    Jp[1, 3] = Ky * r2
    Jp[0, 4] = Kx * r4
    Jp[1, 4] = Ky * r4
    Jp[0, 5] = Kx * r6
    Jp[1, 5] = Ky * r6
    Jp[0, 6] = Kx * r8
    Jp[1, 6] = Ky * r8
    Jp[0, 7] = fx * (a * P1x + s * P1y)
    Jp[1, 7] = fy * P1y
    Jp[0, 8] = fx * (a * P1y + s * P2y)
    Jp[1, 8] = fy * P2y
    Jp[0, 9] = fx * xa
    Jp[1, 9] = 0.0
    Jp[0, 10] = fx * ya
    Jp[1, 10] = 0.0


class Role(Enum):
    """The role of a parameter; parameters of two models correspond if they have the same role."""

    FOCAL = "principal distance or focal length"
    X0 = "principal point, to the right"
    Y0 = "principal point, up or down"
    RADIAL = "radial distortion"
    DENOMINATOR = "radial distortion, in the denominator of a fraction"
    DECENTRING = "decentring distortion"
    PRISM = "thin prism distortion"
    AFFINITY = "ratio of the scales along x and y"
    SHEAR = "angle between the axes"
    RANGE = "range of a surface of distortion"
    SURFACE = "coefficient of a surface of distortion"


class Parameter(NamedTuple):
    """A parameter of interior orientation."""

    name: str
    unit: str
    role: Role

    @property
    def has_null_hypothesis(self) -> bool:
        """Whether the parameter could be 0: not a focal length, nor a position in px."""
        return self.role is not Role.FOCAL and not (self.role in (Role.X0, Role.Y0) and self.unit == "px")


@dataclass(frozen=True)
class Model:
    """A distortion model and its parameters."""

    name: str
    """as in survey files and `Camera.model`"""
    function: Callable[..., None]
    """residual and Jacobian, compiled"""
    parameters: tuple[Parameter, ...]
    """in the order of the vector"""
    corrects: bool = False
    """whether it corrects the measured point; otherwise it distorts the ideal one"""
    corrected_plane: bool = False
    """whether residuals are those of the corrected point instead of the measured one"""
    distorted_affinity: bool = False
    """whether affinity and shear act on the distorted point instead of the ideal one"""
    stereographic: bool = False
    """whether it takes stereographic coordinates of rays, so that they reach beyond 90 degrees from the axis;
    otherwise their tangents"""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of the vector."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the parameters in the same order."""
        return tuple(parameter.unit for parameter in self.parameters)

    def names_of(self, *roles: Role) -> tuple[str, ...]:
        """Return the names of the parameters with any of these roles, in the order of the vector."""
        return tuple(parameter.name for parameter in self.parameters if parameter.role in roles)

    @property
    def in_mm(self) -> bool:
        """Whether c, x0, y0 are in mm on the sensor; otherwise there are focal lengths in px."""
        return "c" in self.names

    @property
    def variant(self) -> tuple[float, float]:
        """Values that distinguish the models of one function, frame[4] and frame[5] of compiled code."""
        if self.in_mm:
            return float(self.corrects and not self.corrected_plane), float(self.distorted_affinity)
        focal = len(self.names_of(Role.FOCAL))
        return float(focal), float(len(self.names) - focal - 2)


def _parameters(role: Role, names: str, *units: str) -> tuple[Parameter, ...]:
    """Return the parameters of one role, from blank-separated names and their units, or one unit for all."""
    each = names.split()
    return tuple(
        Parameter(name, unit, role)
        for name, unit in zip(each, units if len(units) > 1 else units * len(each), strict=True)
    )


_CENTRE_MM = (
    *_parameters(Role.FOCAL, "c", "mm"),
    *_parameters(Role.X0, "x0", "mm"),
    *_parameters(Role.Y0, "y0", "mm"),
)
_PLANE_MM = (
    *_parameters(Role.DECENTRING, "P1 P2", "mm^-1"),
    *_parameters(Role.AFFINITY, "b1", "1"),
    *_parameters(Role.SHEAR, "b2", "1"),
)
_RADIAL_MM = _parameters(Role.RADIAL, "K1 K2 K3", "mm^-2", "mm^-4", "mm^-6")
_BROWN = (*_CENTRE_MM, *_RADIAL_MM, *_PLANE_MM)
_FORWARD = (*_CENTRE_MM, *_RADIAL_MM, *_parameters(Role.RADIAL, "K4", "mm^-8"), *_PLANE_MM)
_CENTRE_PX = (*_parameters(Role.X0, "cx", "px"), *_parameters(Role.Y0, "cy", "px"))
_ONE = (*_parameters(Role.FOCAL, "f", "px"), *_CENTRE_PX)
_TWO = (*_parameters(Role.FOCAL, "fx fy", "px"), *_CENTRE_PX)
_K, _K1_K2, _K3_K4 = (_parameters(Role.RADIAL, names, "1") for names in ("k", "k1 k2", "k3 k4"))
_P1_P2 = _parameters(Role.DECENTRING, "p1 p2", "1")
_ALPHA_BETA = (*_parameters(Role.RADIAL, "alpha", "1"), *_parameters(Role.DENOMINATOR, "beta", "1"))
_OPENCV = (*_TWO, *_K1_K2, *_P1_P2)
_FRACTION = (*_parameters(Role.RADIAL, "k3", "1"), *_parameters(Role.DENOMINATOR, "k4 k5 k6", "1"))
# models for any lens that maps approximately by tangents
GENERAL = (
    Model("brown", brown, _BROWN, corrects=True),
    Model("brown_forward", brown_forward, _FORWARD),
    Model("opencv", opencv, _OPENCV),
    Model("full_opencv", full_opencv, (*_OPENCV, *_FRACTION)),
    Model("brown_affine", brown_affine, _BROWN, corrects=True),
    Model("brown_dbat", brown, _BROWN, corrects=True, corrected_plane=True),
    Model("brown_affine_dbat", brown_affine, _BROWN, corrects=True, corrected_plane=True),
    Model("brown_forward_affine", brown_forward, _FORWARD, distorted_affinity=True),
)
# other models of COLMAP, by its names in lower case; here those with some of the parameters of `opencv`
PERSPECTIVE = (
    Model("simple_pinhole", radial, _ONE),
    Model("pinhole", radial, _TWO),
    Model("simple_radial", radial, (*_ONE, *_K)),
    Model("radial", radial, (*_ONE, *_K1_K2)),
)
# models for lenses that map approximately by angles instead of tangents
WIDE_ANGLE = (
    Model("simple_fisheye", fisheye, _ONE, stereographic=True),
    Model("fisheye", fisheye, _TWO, stereographic=True),
    Model("simple_radial_fisheye", fisheye, (*_ONE, *_K), stereographic=True),
    Model("radial_fisheye", fisheye, (*_ONE, *_K1_K2), stereographic=True),
    Model("opencv_fisheye", fisheye, (*_TWO, *_K1_K2, *_K3_K4), stereographic=True),
    Model("fov", fov, (*_TWO, *_parameters(Role.RADIAL, "omega", "rad"))),
    Model("simple_division", division, (*_ONE, *_K), stereographic=True),
    Model("division", division, (*_TWO, *_K), stereographic=True),
    Model("eucm", eucm, (*_TWO, *_ALPHA_BETA), stereographic=True),
    Model(
        "thin_prism_fisheye",
        thin_prism_fisheye,
        (*_OPENCV, *_K3_K4, *_parameters(Role.PRISM, "sx1 sy1", "1")),
        stereographic=True,
    ),
    Model(
        "rad_tan_thin_prism_fisheye",
        rad_tan_thin_prism_fisheye,
        (
            *_TWO,
            *_parameters(Role.RADIAL, "k0 k1 k2 k3 k4 k5", "1"),
            *_parameters(Role.DECENTRING, "p0 p1", "1"),
            *_parameters(Role.PRISM, "s0 s1 s2 s3", "1"),
        ),
        stereographic=True,
    ),
)
COLMAP = (*PERSPECTIVE, *WIDE_ANGLE)


def _splined(knots: int) -> Model:
    """Return the model with a surface of knots x knots coefficients."""
    grid = [f"{j}_{i}" for j in range(knots) for i in range(knots)]
    return Model(
        f"splined_{knots}",
        splined,
        (
            *_TWO,
            *_parameters(Role.RANGE, "a_max b_max", "1"),
            *_parameters(Role.SURFACE, " ".join(f"A{place}" for place in grid), "1"),
            *_parameters(Role.SURFACE, " ".join(f"B{place}" for place in grid), "1"),
        ),
        stereographic=True,
    )


# models for lenses that no other describes; fitted to the image points of another model
SPLINED = tuple(_splined(knots) for knots in KNOTS)
ALL = (*GENERAL, *COLMAP, *SPLINED)
MODELS = {model.name: model for model in ALL}
OF_COLMAP = frozenset(("opencv", "full_opencv", *(model.name for model in COLMAP)))  # models that it has
GENERAL_MODELS = tuple(model.name for model in GENERAL)
CONVERTIBLE = (*GENERAL_MODELS, *(model.name for model in PERSPECTIVE))  # with coefficients of one kind
MAX_PARAMETERS = max(len(model.names) for model in ALL)


def number_of(model: str) -> int:
    """Return the number of a model in compiled code: its row in `ALL`."""
    return list(MODELS).index(model)


def one_of(models: tuple[Model, ...]) -> Callable[..., None]:
    """Return one function for all, to be compiled: observe(number, frame, p, x, y, u, v, residual, Ju, Jp).

    Its source, with a branch for each model, is written here, because the compiler inlines the models only
    from plain branches on their names. A chain of closures over them makes an adjustment a third slower. The
    function is compiled once and called. Compiling it into each caller took three times as long, and an
    adjustment was no faster. This file is given as the file of its source, so that the compiled code is kept
    like other kernels.
    """
    arguments = "frame, p, x, y, u, v, residual, Ju, Jp"
    lines = [f"def observe(number, {arguments}):"]
    names: dict[str, Any] = {"__name__": __name__}
    numbers: dict[Callable[..., None], list[int]] = {}
    for number, model in enumerate(models):
        numbers.setdefault(model.function, []).append(number)
    for function, numbers_of in numbers.items():
        name = models[numbers_of[0]].name
        names[name] = function
        test = " or ".join(f"number == {number}" for number in numbers_of)
        lines.append(f"    {'elif' if len(lines) > 1 else 'if'} {test}: {name}({arguments})")
    exec(compile("\n".join(lines), __file__, "exec"), names)
    function_of_all: Callable[..., None] = names["observe"]
    return function_of_all


observe = kernel(one_of(ALL))
