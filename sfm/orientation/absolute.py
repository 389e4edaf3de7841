"""Absolute orientation: a model brought onto control by a similarity of seven parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm.arguments import checked_arguments
from sfm.conventions import FloatArray, skew
from sfm.similarity import Similarity, fit_similarity

PARAMETERS = 7


@dataclass(frozen=True)
class AbsoluteOrientation:
    """Seven parameters that bring a model into the frame of the control points."""

    similarity: Similarity  # control_from_model
    residuals: FloatArray  # v = transformed - control, control unit, (n, 3)
    sigma0: float  # a posteriori standard deviation of unit weight, control unit; NaN without redundancy
    redundancy: int  # 3 n - 7
    covariance: FloatArray  # of scale, three small turns about control axes (rad) and the shift, (7, 7)


@checked_arguments(model="n 3", control="n 3", weights="n")
def orient_absolute(
    model: FloatArray, control: FloatArray, *, weights: FloatArray | None = None
) -> AbsoluteOrientation:
    """Return the 7-parameter similarity that brings model points onto control points.

    Args:
        model: points in the model, shape (n, 3), model unit, n >= 3.
        control: the same points in the control frame, shape (n, 3), control unit.
        weights: weight of each point, shape (n,); 1 if not given.

    Returns:
        The closed-form solution, which is the least-squares one, with its covariance: of the scale, of w in
        exp([w]x) R, and of the translation of the model's centre of gravity.

    Raises:
        GeometryError: fewer than three points, or all on a line.

    Source: document 004, "absolute orientation"; Horn (1987) for the closed form (sfm/similarity.py), Kraus
    (2007), sec. 4.4.3, for the differential equations.
    """
    model, control = np.asarray(model, dtype=float), np.asarray(control, dtype=float)
    similarity = fit_similarity(model, control, weights=weights)
    n = len(model)
    P = np.ones(n) if weights is None else np.asarray(weights, dtype=float)
    moved = similarity.apply(model)
    v = moved - control
    # at the weighted centre: d = (moved - centre) dm / m + w x (moved - centre) + dt
    arm = moved - (P @ moved) / P.sum()
    A = np.zeros((n, 3, PARAMETERS))
    A[:, :, 0] = arm / similarity.scale
    A[:, :, 1:4] = -skew(arm)
    A[:, :, 4:] = np.eye(3)
    N = np.einsum("nia,n,nib->ab", A, P, A)
    redundancy = 3 * n - PARAMETERS
    sigma0 = float(np.sqrt(np.sum(P * np.sum(v**2, axis=1)) / redundancy)) if redundancy > 0 else np.nan
    covariance = sigma0**2 * np.linalg.inv(N)
    return AbsoluteOrientation(similarity, v, sigma0, redundancy, np.asarray(covariance))
