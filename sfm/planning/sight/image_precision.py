"""Precision of a target in a photograph from its size, contrast, blur and noise.

An edge blurred by a Gaussian of standard deviation s contains, per length, the information
A^2 / (2 s sqrt(pi)) / noise^2 on a shift across it. Summed round an ellipse that is the Cramer-Rao bound of
its centre, which the measurement of targets reaches within some 5 % where the background is even.

    information = A^2 / (2 s sqrt(pi) noise^2) * integral of n n' dl
    circle of radius R: sigma^2 = 2 s noise^2 / (sqrt(pi) R A^2)

Source: Cramer-Rao bound; Foerstner and Wrobel (2016), sec. 4.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import FloatArray
from sfm.errors import GeometryError

STEPS = 24  # round an ellipse; the integrand is smooth and periodic


@dataclass(frozen=True)
class TargetImage:
    """How well targets stand out in the photographs."""

    contrast: float = 120.0  # step of intensity between target and surroundings
    noise: float = 2.0  # standard deviation of an intensity, same scale
    blur_px: float = 0.8  # standard deviation of the edge, the box of a pixel included

    def __post_init__(self) -> None:
        for name, value in (("contrast", self.contrast), ("noise", self.noise), ("blur", self.blur_px)):
            if not (math.isfinite(value) and value > 0):
                raise GeometryError(f"target: {name} is {value:g}, needed more than 0")


@checked_arguments(axes="k 2 2")
def centre_covariance(axes: FloatArray, target: TargetImage) -> FloatArray:
    """Return the covariance of the centres of ellipses, px^2, (k, 2, 2).

    Args:
        axes: J of each ellipse: its outline is J (cos t, sin t)', px, (k, 2, 2).
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
