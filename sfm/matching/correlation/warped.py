"""Correlation of a template with a window of the other photograph that is turned and scaled beforehand."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from sfm.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.display import counted
from sfm.errors import GeometryError
from sfm.matching.correlation.ncc import NccMatches, least_deviations, matches_of, template_corners
from sfm.matching.correlation.peak import NOT_COMPARED, OUTPUTS, read_peak
from sfm.matching.radiometry import grey_of, odd_window


def match_ncc_warped(
    left: AnyArray,
    right: AnyArray,
    xy_left: FloatArray,
    xy_right: FloatArray,
    linear: FloatArray,
    *,
    reach_px: IntArray,
    template_px: int = 19,
    min_correlation: float = 0.5,
    max_second: float = 1.0,
) -> NccMatches:
    """Look for templates in windows of the right photograph that are resampled by an affine map each.

    Args:
        left: photograph, (H, W), 8 or 16 bit or float, grey or colour.
        right: the other photograph.
        xy_left: points in the left photograph, px, (k, 2).
        xy_right: where they are expected in the right one, px, (k, 2).
        linear: right px per left px around each point, (k, 2, 2).
        reach_px: how far from there they may be along a row and a column, left px, (k,).
        template_px: odd side of the template.
        min_correlation: smallest r of a match.
        max_second: largest ratio of the second-best r to the best.

    Returns:
        One result for each point, places and covariances in the right photograph.

    Raises:
        GeometryError: an even template, no reach, or points that do not go in threes with place and map.

    Source: as `match_ncc`; the window is resampled by bilinear interpolation.
    """
    side = odd_window("NCC template", template_px)
    a, b = np.asarray(xy_left, dtype=float).reshape(-1, 2), np.asarray(xy_right, dtype=float).reshape(-1, 2)
    A = np.asarray(linear, dtype=float)
    if (reach_px < 1).any():
        raise GeometryError(f"NCC: a reach of {reach_px.min()} px, needed at least 1 px")
    if len(a) != len(b) or A.shape != (len(a), 2, 2):
        raise GeometryError(
            f"NCC: {counted(len(a), 'point')} in the left photograph, {counted(len(b), 'place')} in the "
            "right and maps of shape "
            f"{A.shape}, needed one of each for every point"
        )
    grey_left, grey_right = grey_of(left), grey_of(right)
    least = least_deviations(left, right)
    half = side // 2
    out = np.zeros((len(a), OUTPUTS))
    corners = template_corners(a, half, grey_left.shape)
    usable = (corners[:, 0] >= 0) & np.isfinite(b).all(axis=1) & np.isfinite(A).all(axis=(1, 2))
    fraction = a - np.rint(a)
    for k in range(len(a)):
        reach = int(reach_px[k])
        inside = _inside(A[k], b[k], fraction[k], half, reach, grey_right.shape) if usable[k] else None
        if inside is None or not inside.any():
            out[k] = NOT_COMPARED
            continue
        x, y = corners[k].tolist()
        first = b[k] - A[k] @ (fraction[k] + half + reach)  # where the window's first pixel comes from
        window = cv2.warpAffine(
            grey_right,
            np.column_stack([A[k], first]),
            (side + 2 * reach, side + 2 * reach),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        template = np.ascontiguousarray(grey_left[y : y + side, x : x + side])  # as windows are
        surface = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
        allowed = np.where(inside, surface, np.float32(-1.0))
        read_peak(template, window, allowed, surface, least, min_correlation, max_second, out[k])
    around = np.repeat(-(half + reach_px)[:, None], 2, axis=1)  # of the windows, as seen from their middles
    matches = matches_of(out, around, np.zeros_like(a), half)
    return replace(
        matches,
        xy=b + np.einsum("kij,kj->ki", A, matches.xy),
        peak=b + np.einsum("kij,kj->ki", A, matches.peak),
        covariance=A @ matches.covariance @ A.transpose(0, 2, 1),
    )


def _inside(
    A: FloatArray, b: FloatArray, fraction: FloatArray, half: int, reach: int, shape: tuple[int, ...]
) -> BoolArray:
    """Return at which places of the window the whole template is inside the right photograph, (n, n)."""
    at = np.arange(-reach, reach + 1.0)
    x, y = at[None, :] - fraction[0], at[:, None] - fraction[1]
    inside = np.ones((len(at), len(at)), dtype=bool)
    for row in (-half, half):
        for col in (-half, half):
            u = A[0, 0] * (x + col) + A[0, 1] * (y + row) + b[0]
            v = A[1, 0] * (x + col) + A[1, 1] * (y + row) + b[1]
            inside &= (u >= 0) & (v >= 0) & (u <= shape[1] - 1) & (v <= shape[0] - 1)
    return inside
