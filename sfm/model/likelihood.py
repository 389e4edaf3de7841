"""The likelihood of image points, by which choices of a model, a camera or a start value are decided.

Image points that fit are normal with their covariance. Misfits are uniform over the photograph that they are
in. Each parameter that one of two models adds has a price, and so has each alternative that was tried.

Source: Rissanen (1978), Automatica 14 (misfits); Patterson and Thompson (1971), Biometrika 58 (redundancy in
place of the number of coordinates); Kass and Raftery (1995), J. Am. Stat. Assoc. 90 (the number of
observations in the price); Foerstner and Wrobel (2016), sec. 4.7 (mixture of good and bad).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.model.camera import Camera
from sfm.model.conventions import BoolArray, FloatArray
from sfm.model.network import Network

ROUNDING = float(np.finfo(float).eps)  # of an image coordinate, as a share of its photograph


def log_likelihood(
    squares: float,
    fits: BoolArray,
    areas: FloatArray,
    *,
    redundancy: float | None = None,
    sigma_px: float | None = None,
    share: FloatArray | float = 1.0,
) -> float:
    """Return ln of the likelihood of image points.

    Args:
        squares: sum of squared residuals of the image points that fit, weighted as in the adjustment, px^2.
        fits: which image points fit, (k,).
        areas: area of the photograph of each image point, px^2, (k,).
        redundancy: of an adjustment; without redundancy every network fits, and only misfits count. If not
            given, every coordinate of an image point that fits counts.
        sigma_px: known standard deviation of an image coordinate, px; estimated from the squares if not
            given, but not below rounding.
        share: what each image point counts, see `Network.share`, (k,).
    """
    of_each = np.broadcast_to(share, fits.shape)
    misfits = float((of_each * np.log(areas))[~fits].sum())
    count = 2 * float(of_each[fits].sum()) if redundancy is None else redundancy
    if count <= 0:
        return -misfits
    least = ROUNDING**2 * float(areas.max())
    variance = max(squares / count, least) if sigma_px is None else sigma_px**2
    exponent = count if sigma_px is None else squares / variance
    return float(-(count * np.log(2 * np.pi * variance) + exponent) / 2 - misfits)


def areas_of_photographs(network: Network, cameras: Sequence[Camera]) -> FloatArray:
    """Return the area of the photograph of each image point, px^2, (k,).

    Args:
        network: has the image points.
        cameras: its cameras.
    """
    sizes = np.array([float(np.prod(camera.size_px)) for camera in cameras])
    return np.asarray(sizes[network.camera[network.image_points.image]])


def price_of(parameters: int, observed: int, search: float = 0.0) -> float:
    """Return the gain of ln likelihood that further parameters must exceed.

    Args:
        parameters: number of further parameters.
        observed: number of image points that they move.
        search: ln of the number of alternatives from which this one was chosen.
    """
    return float(parameters / 2 * np.log(2 * max(observed, 2)) + search)
