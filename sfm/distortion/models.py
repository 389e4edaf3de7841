"""The distortion models: which there are, what their parameters are called, and one way to all of them.

A model is one compiled function `model(frame, p, x, y, u, v, residual, Ju, Jp)`. It is given

    frame (5,)      centre of the photograph, px, width and height of a pixel, mm, and 1 if residuals are to
                    be those of the measured point, 0 if of the corrected one
    p     (n,)      parameters in the order of the model's names
    x, y            measured pixel
    u, v            tangents of the ray in the image frame (u = -U/W, v = -V/W, y up)

and fills

    residual (2,)   computed minus measured, px, pixel frame (y down)
    Ju (2, 2)       its derivatives by u and v
    Jp (2, n)       its derivatives by the parameters

The models of photogrammetry correct the measured point, those of computer vision distort the ideal
one; in both cases the residual vanishes at the true parameters and is one of the measured point, but for
the models named after DBAT, whose residuals lie in the corrected plane. To add a model: write its function in
a module beside `brown` and give it a row in `ALL`; adjustment, resection, conversion, survey file and reports
follow from that row, and the tests of derivatives and inverse run over it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numba import njit

from sfm.distortion.brown import brown, brown_affine
from sfm.distortion.forward import brown_forward
from sfm.distortion.opencv import full_opencv, opencv


@dataclass(frozen=True)
class Model:
    """A distortion model and what its parameters are called and measured in."""

    name: str
    """as survey files and `Camera.model` have it"""
    function: Callable[..., None]
    """residual and Jacobian, compiled"""
    parameters: str
    """names of the parameters in the order of the vector, separated by blanks"""
    units: str
    """their units, in the same order"""
    corrects: bool = False
    """whether it corrects the measured point; else it distorts the ideal one"""
    corrected_plane: bool = False
    """whether residuals are those of the corrected point instead of the measured one"""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in the order of the vector."""
        return tuple(self.parameters.split())

    @property
    def in_mm(self) -> bool:
        """Whether c, x0, y0 are in mm on the sensor; else there are focal lengths in px."""
        return "c" in self.names


_BROWN = ("c x0 y0 K1 K2 K3 P1 P2 b1 b2", "mm mm mm mm^-2 mm^-4 mm^-6 mm^-1 mm^-1 1 1")
ALL = (
    Model("brown", brown, *_BROWN, corrects=True),
    Model(
        "brown_forward",
        brown_forward,
        "c x0 y0 K1 K2 K3 K4 P1 P2 b1 b2",
        "mm mm mm mm^-2 mm^-4 mm^-6 mm^-8 mm^-1 mm^-1 1 1",
    ),
    Model("opencv", opencv, "fx fy cx cy k1 k2 p1 p2", "px px px px 1 1 1 1"),
    Model("full_opencv", full_opencv, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", "px px px px 1 1 1 1 1 1 1 1"),
    Model("brown_affine", brown_affine, *_BROWN, corrects=True),
    Model("brown_dbat", brown, *_BROWN, corrects=True, corrected_plane=True),
    Model("brown_affine_dbat", brown_affine, *_BROWN, corrects=True, corrected_plane=True),
)
MODELS = {model.name: model for model in ALL}
MAX_PARAMETERS = max(len(model.names) for model in ALL)


def number_of(model: str) -> int:
    """Return the number by which compiled code knows a model: its row in `ALL`."""
    return list(MODELS).index(model)


def one_of(models: tuple[Model, ...]) -> Callable[..., None]:
    """Return one compiled function of all: observe(number, frame, p, x, y, u, v, residual, Ju, Jp).

    Its source, a branch for each model, is written here, because the compiler inlines the models only from
    plain branches on their names; a chain of closures over them makes an adjustment a third slower. It has no
    file to be cached with, so that it is compiled into its callers.
    """
    arguments = "frame, p, x, y, u, v, residual, Ju, Jp"
    lines = [f"def observe(number, {arguments}):"]
    names: dict[str, Any] = {}
    numbers: dict[Callable[..., None], list[int]] = {}
    for number, model in enumerate(models):
        numbers.setdefault(model.function, []).append(number)
    for function, own in numbers.items():
        name = models[own[0]].name
        names[name] = function
        test = " or ".join(f"number == {number}" for number in own)
        lines.append(f"    {'elif' if len(lines) > 1 else 'if'} {test}: {name}({arguments})")
    exec("\n".join(lines), names)
    compiled: Callable[..., None] = njit(inline="always", error_model="numpy")(names["observe"])
    return compiled


observe = one_of(ALL)
