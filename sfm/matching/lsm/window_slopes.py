"""Slopes of windows: one change of the plane of a window for all photographs in which it is matched.

In oriented photographs, the position and the two slopes of its plane are all that is unknown of the warp of a
window. A slope that is assumed instead moves the depth of the window by the same in all photographs, which no
residual shows. A slope that each match estimates for itself costs precision. Here windows are shifted only,
on the plane of the object points around them. Residuals of all photographs then estimate one slope, to which
the plane contributes with its covariance. A plane that photographs contradict contributes nothing.

The noise of the template is common to all matches of a window. It is that of a distortion of the reference
photograph, an unknown of its own with this variance.

Source: Gruen and Baltsavias (1988), Photogramm. Eng. Remote Sens. 54(5), for windows in several photographs
with common geometric constraints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm.matching.lsm.two_photo import LinearParts
from sfm.model.conventions import BoolArray, FloatArray, IntArray

# Relative to intensities: of those in single precision. No difference of intensities is known better.
ROUNDING = float(np.finfo(np.float32).eps)
# Share of the trace of a spread below which a direction is left out. Rounding leaves up to 1.1e-6, of either
# sign, where photographs without noise show stripes.
LEAST_SHARE = 1e-5


@dataclass(frozen=True)
class ShiftedWindows:
    """Windows of a reference photograph, matched in another photograph by a shift."""

    window: IntArray  # of n, (k,)
    warp: FloatArray  # linear part, px in the other photograph per px in the reference, (k, 2, 2)
    parallax: FloatArray  # shift in the reference for a relative change of inverse depth by 1, px, (k, 2)
    linear: LinearParts  # k

    def select(self, rows: BoolArray) -> ShiftedWindows:
        """Return the selected windows."""
        return ShiftedWindows(
            self.window[rows], self.warp[rows], self.parallax[rows], self.linear.select(rows)
        )

    def linear_per_slope(self) -> FloatArray:
        """Return the derivatives of the linear parts xx, xy, yx, yy by the slope, px, (k, 4, 2)."""
        return np.asarray(np.einsum("ka,bc->kabc", self.parallax, np.eye(2)).reshape(-1, 4, 2))

    def shift_per_slope(self) -> FloatArray:
        """Return by how much a slope moves the match in the other photograph, px^2, (k, 2, 2)."""
        return np.asarray(self.warp @ self.linear.shift @ self.linear_per_slope())


@dataclass(frozen=True)
class SlopeEquations:
    """Normal equations of the changes s of the slopes of n windows: N s = right."""

    N: FloatArray  # px^2, (n, 2, 2); 0 without matches or texture
    right: FloatArray  # px, (n, 2)


@dataclass(frozen=True)
class Slopes:
    """Changes of the slopes of windows."""

    slope: FloatArray  # 1 / px, (n, 2)
    covariance: FloatArray  # 1 / px^2, (n, 2, 2)


def estimate_slopes(
    equations: SlopeEquations, of_planes: FloatArray, unknown: FloatArray, changed: FloatArray
) -> Slopes:
    """Return the slopes from matches and planes.

    A plane is left out if the matches are more likely with a slope that is not known at all.

    Args:
        equations: those of the matches.
        of_planes: covariance of the slopes of the planes, 1 / px^2, NaN where unknown, (n, 2, 2).
        unknown: that of slopes that may be any, 1 / px^2, (2, 2).
        changed: slopes of the windows that were matched, relative to the planes, 1 / px, (n, 2).
    """
    right = equations.right + np.einsum("nab,nb->na", equations.N, changed)
    of_planes = np.where(np.isfinite(of_planes), of_planes, unknown)
    with_plane, likely = _posterior(equations.N, right, of_planes)
    without, likely_without = _posterior(equations.N, right, np.broadcast_to(unknown, of_planes.shape))
    Q = np.where((likely_without > likely)[:, None, None], without, with_plane)
    return Slopes(np.einsum("nab,nb->na", Q, right), Q)


def _posterior(N: FloatArray, right: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of slopes with a normal prior around 0, and twice their log likelihood."""
    I_SN = np.eye(2) + prior @ N
    Q = np.linalg.solve(I_SN, prior)
    Q = (Q + Q.transpose(0, 2, 1)) / 2
    return Q, np.einsum("na,nab,nb->n", right, Q, right) - np.log(np.linalg.det(I_SN))


def slope_equations(matches: Sequence[ShiftedWindows], n: int) -> SlopeEquations:
    """Return the normal equations of the changes of the slopes of n windows from all their matches.

    Template and other photograph contribute half of the noise of a match each. The derivatives and the spread
    of a score depend on the template alone, up to the noise that is subtracted. Their means are used.
    """
    count, half = np.zeros(n), np.zeros(n)
    C, V = np.zeros((n, 4, 4)), np.zeros((n, 4, 4))
    for match in matches:
        count[match.window] += 1
        half[match.window] += _half_variance(match)
        C[match.window] += match.linear.derivative
        V[match.window] += match.linear.spread
    matched = count > 0
    number = np.maximum(count, 1.0)
    C, V = C / number[:, None, None], V / number[:, None, None]
    V[~matched] = np.eye(4)
    CV, CVC = _informative(C, V)
    N, right = np.zeros((n, 2, 2)), np.zeros((n, 2))
    sum_A, sum_score, weights = np.zeros((n, 4, 2)), np.zeros((n, 4)), number / np.where(matched, half, 1.0)
    for match in matches:
        w, A = match.window, match.linear_per_slope()
        weight = 1 / _half_variance(match)
        AT = weight[:, None, None] * A.transpose(0, 2, 1)
        N[w] += AT @ CVC[w] @ A
        right[w] += np.einsum("kba,kac,kc->kb", AT, CV[w], match.linear.score)
        sum_A[w] += weight[:, None, None] * A
        sum_score[w] += weight[:, None] * match.linear.score
        weights[w] += weight
    # elimination of the distortion of the template
    AT = sum_A.transpose(0, 2, 1) / weights[:, None, None]
    N -= AT @ CVC @ sum_A
    right -= np.einsum("nba,nac,nc->nb", AT, CV, sum_score)
    return SlopeEquations(N, right)


def _half_variance(match: ShiftedWindows) -> FloatArray:
    """Return half of the variances of differences of intensities, (k,)."""
    texture = np.einsum("kaa->k", match.linear.spread)
    return np.asarray(np.maximum(match.linear.variance, ROUNDING**2 * texture) / 2)


def _informative(C: FloatArray, V: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return C V^-1 and C V^-1 C without the directions that show nothing, (n, 4, 4) each.

    In these, noise exceeds the texture, or there is hardly any texture.

    Args:
        C: derivatives of the score of the linear part, without the mean contribution of noise.
        V: spread of the score.
    """
    values, vectors = np.linalg.eigh(V)
    shown = values > LEAST_SHARE * np.einsum("naa->n", V)[:, None]
    scale = np.sqrt(np.where(shown, values, 1.0))
    L = vectors * np.where(shown, scale, 0.0)[:, None, :]
    back = np.where(shown, 1 / scale, 0.0)[:, :, None] * vectors.transpose(0, 2, 1)
    size, axes = np.linalg.eigh(back @ C @ back.transpose(0, 2, 1))
    root = L @ axes @ (np.maximum(size, 0.0)[:, :, None] * axes.transpose(0, 2, 1))
    return root @ back, root @ root.transpose(0, 2, 1)
