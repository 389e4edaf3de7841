"""Counters: the white inside of letters such as o, e and 8, which looks like a target on their stroke.

The background of a counter is a closed stroke, behind which the paper begins again, and next to a letter
there are others. A target in a dark rim of its own is not like that: its rim is thinner than half its radius,
or the surroundings of the rim are free. Nor is a dot in the ring of a code, which always has clear cells.
"""

from __future__ import annotations

import math

import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray
from sfm.kernels.options import compiled
from sfm.kernels.sampling import bilinear
from sfm.targets.edge_rays import RAYS

# Share of the rays on which a stroke ends, and on which something else begins behind it. No ring of up to 20
# cells is set on so much of the circumference: even parity leaves at least two of them clear.
CLOSED, CROWDED = 0.95, 0.08
# Least median and largest width of the stroke, radii of the counter; rims of the retro-panel have up to 0.46.
LEAST_STROKE, LARGEST_STROKE = 0.5, 1.75
# So far behind a stroke its neighbours are looked for, radii; what is so many contrasts bright is glare.
NEIGHBOURS, GLARE = 2.0, 1.5
_STEP_PX, _RISE_PX = 0.5, 3.0


@compiled
def find_counters(image: AnyArray, xy: FloatArray, shape: FloatArray, levels: FloatArray) -> BoolArray:
    """Return which candidates are counters of letters, (k,).

    Args:
        image: intensities, shape (H, W).
        xy: centres, px, shape (k, 2).
        shape: (p, q, r) of S, 1/px, shape (k, 3).
        levels: intensity of the background and its step to the target, shape (k, 2).
    """
    counter = np.zeros(len(xy), np.bool_)
    for k in range(len(xy)):
        p, q, r = shape[k]
        det = p * r - q * q
        closed, wide, crowded = 0, 0, 0
        for i in range(RAYS):
            c, s = math.cos(2 * math.pi * i / RAYS), math.sin(2 * math.pi * i / RAYS)
            ex, ey = (r * c - q * s) / det, (p * s - q * c) / det
            R = math.hypot(ex, ey)
            width, behind = _stroke(image, xy[k], ex / R, ey / R, R, levels[k])
            closed += width <= LARGEST_STROKE * R
            wide += LEAST_STROKE * R <= width <= LARGEST_STROKE * R
            crowded += behind
        counter[k] = closed >= CLOSED * RAYS and wide >= RAYS // 2 and crowded >= CROWDED * RAYS
    return counter


@compiled
def _stroke(
    image: AnyArray, xy: FloatArray, ux: float, uy: float, R: float, levels: FloatArray
) -> tuple[float, bool]:
    """Return the width of the background on a ray, px, inf where it does not end, and if more is behind."""
    h, w = image.shape
    left, width, highest, t = -1.0, math.inf, 0.0, 0.0
    while t < (LARGEST_STROKE + 1) * R + 1 if width == math.inf else t < left + width + NEIGHBOURS * R:
        x, y = xy[0] + (R + t) * ux, xy[1] + (R + t) * uy
        if x < 0 or y < 0 or x >= w - 1 or y >= h - 1:
            break
        level = (bilinear(image, x, y) - levels[0]) / levels[1]
        if left < 0:
            if level < 0.5:
                left = t
        elif width == math.inf:
            if level > 0.5:
                width = t - left
        else:
            if t < left + width + _RISE_PX:
                highest = max(highest, level)
            if level < 0.5:
                return (math.inf if highest >= GLARE else width), True
        t += _STEP_PX
    return (math.inf if highest >= GLARE else width), False
