"""The picture of `kolinear match`: template, matched patch and difference of each point."""

from __future__ import annotations

import math

import cv2
import numpy as np

from sfm.conventions import AnyArray
from sfm.kernels.sampling import resample
from sfm.matching.conjugate_patches import ConjugatePoints

PANEL = 168  # least side of a patch in the picture, px
ZOOM = 8  # least side of one of its pixels, px
GAP = 4  # between the patches, px
MAX_PICTURES = 25  # points in one picture
LINE = 20  # height of a line of text, px
LETTER = 9  # width of a letter at most, px
MAX_LETTERS = 160  # of a line; names may be long


def draw_patches(
    names: tuple[str, ...], left: AnyArray, right: AnyArray, found: ConjugatePoints, template_px: int
) -> AnyArray:
    """Return template, matched patch (in the template's intensities) and difference, a row for each point.

    Above each row stand the name and r; of points that were not matched, the reason and the template, if it
    lies inside. The difference is grey where there is none and saturates at a quarter of the scale of the
    template. The last line states if not all points are drawn.
    """
    zoom = max(ZOOM, math.ceil(PANEL / template_px))
    drawn = min(len(found), MAX_PICTURES)
    lines = [_caption(names[k], found, k) for k in range(drawn)]
    last = f"the first {drawn} of {len(found)} points" if drawn < len(found) else ""
    width = max(3 * zoom * template_px + 2 * GAP, LETTER * max(len(line) for line in [*lines, last]))
    rows = []
    for k, line in enumerate(lines):
        rows += [
            _text(line, width),
            *(_widened(row, width) for row in _panels(left, right, found, k, template_px, zoom)),
        ]
    return np.vstack([*rows, _text(last, width)] if last else rows)


def _panels(
    left: AnyArray, right: AnyArray, found: ConjugatePoints, k: int, template_px: int, zoom: int
) -> list[AnyArray]:
    """Return the patches of one point beside each other; none if its template is outside."""
    half = template_px // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    template = resample(left, found.left[k] + np.stack([u, v], axis=-1), interpolation="bilinear")
    if not np.isfinite(template).any():
        return []
    low, high = np.nanmin(template), np.nanmax(template)
    scale = 255.0 / max(high - low, 1e-6)
    panels = [(template - low) * scale]
    if found.good[k]:
        H = found.warp[k]
        w = H[2, 0] * u + H[2, 1] * v + H[2, 2]
        place = np.stack([(H[i, 0] * u + H[i, 1] * v + H[i, 2]) / w for i in range(2)], axis=-1)
        patch = (resample(right, place, interpolation="bilinear") - found.offset[k]) / found.gain[k]
        panels += [(patch - low) * scale, 128 + 4 * (patch - template) * scale]
    row = []
    for panel in panels:
        grey = np.nan_to_num(panel).clip(0, 255).astype(np.uint8)
        big = cv2.resize(grey, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
        row += [big, np.full((len(big), GAP), 255, np.uint8)]
    return [np.hstack(row[:-1])]


def _caption(name: str, found: ConjugatePoints, k: int) -> str:
    """Return name, r and reason in the letters that OpenCV can draw."""
    r = float(found.correlation[k])
    what = f"{name}  r {r:.4f}" if math.isfinite(r) else name
    line = f"{what}  not matched: {found.reason[k]}" if found.reason[k] else what
    return line[:MAX_LETTERS].encode("ascii", "replace").decode()


def _text(line: str, width: int) -> AnyArray:
    """Return a line of text, black on white."""
    row = np.full((LINE, width), 255, np.uint8)
    cv2.putText(row, line, (2, LINE - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.45, 0, 1, cv2.LINE_AA)
    return row


def _widened(row: AnyArray, width: int) -> AnyArray:
    """Return a row with white to its right."""
    return np.pad(row, ((0, 0), (0, width - row.shape[1])), constant_values=255)
