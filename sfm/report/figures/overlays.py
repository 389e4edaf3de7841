"""Overlays: photographs with their targets and residuals, and pictures of matched patches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from sfm.adjustment.result import Adjustment
from sfm.judgement.survey_result import PhotographTargets
from sfm.matching.conjugate_patches import ConjugatePoints
from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.model.display import in_words
from sfm.model.errors import PhotographError
from sfm.model.network import Network
from sfm.photographs.reading import read_photograph
from sfm.runtime.progress import SILENT, Progress
from sfm.runtime.sampling import resample
from sfm.targets.outlines import Flag

PANEL = 168  # minimum side of a patch in the picture, px
ZOOM = 8  # minimum side of one of its pixels in the picture, px
GAP = 4  # between the patches, px
MAX_PICTURES = 25  # points in one picture
LINE = 20  # height of a line of text, px
LETTER = 9  # maximum width of a letter, px
MAX_LETTERS = 160  # in a line; names may be long
MAX_SIDE_PX = 2400  # longer photographs are drawn smaller
THUMBNAIL_SIDE_PX = 720
JPEG_QUALITY = 82
ARROW_PX = 22.0  # length in the picture of a residual that equals the RMS
# image points of a photograph; beyond this they are drawn as dots, and only names that last are written
MAX_NAMED_POINTS = 300
CROWDED_ARROW_PX = 8.0  # the same length in crowded photographs, to keep the vectors apart
DOT_PX = 2  # radius of such a dot
LABEL_SIZE = 0.5  # of OpenCV's Hershey font
SAME_PX = 0.5  # maximum distance from a target to its image point, which re-measurement may have moved
SHIFT = 4  # fractional bits of the coordinates that OpenCV takes
# Colours in OpenCV's order blue, green, red.
USED, DROPPED, UNUSED, ARROW, INK, PAPER = (
    (110, 255, 110),
    (70, 70, 255),
    (200, 160, 40),
    (0, 200, 255),
    (30, 30, 30),
    (245, 245, 245),
)
REASON_COLOURS = (
    (Flag.CUT_BY_BORDER, (255, 90, 200)),
    (Flag.TOO_SMALL, (170, 170, 170)),
    (Flag.TOO_LARGE, (120, 120, 120)),
    (Flag.TOO_OBLIQUE, (255, 200, 90)),
    (Flag.NOT_ELLIPTIC, (200, 120, 120)),
    (Flag.LOW_CONTRAST, (210, 210, 120)),
    (Flag.UNEVEN_EDGE, (60, 140, 255)),
    (Flag.POOR_FIT, (60, 80, 200)),
    (Flag.BLURRED, (160, 200, 160)),
    (Flag.NO_CONVERGENCE, (150, 60, 150)),
    (Flag.DUPLICATE, (200, 200, 60)),
    (Flag.PART_OF_CODE, (230, 150, 230)),
    (Flag.LOBED, (90, 200, 250)),
    (Flag.THIN_BACKGROUND, (40, 110, 40)),
    (Flag.NOT_ON_PLATE, (110, 60, 20)),
)
# Remarks on measured targets, drawn as a second outline.
REMARK_COLOURS = (
    (Flag.FLARE, (0, 160, 255)),
    (Flag.HALO, (255, 255, 120)),
    (Flag.SATURATED, (180, 180, 255)),
    (Flag.DAMAGED, (150, 255, 210)),
)


@dataclass(frozen=True)
class Overlay:
    """One drawn photograph."""

    image: str  # name of the photograph
    file_name: str  # of the overlay in its folder
    jpeg: bytes  # the overlay
    thumbnail: bytes  # a small one, JPEG


def draw_overlays(
    photographs: Sequence[PhotographTargets],
    solved: Adjustment | Network,
    *,
    jobs: int = 1,
    progress: Progress = SILENT,
) -> tuple[Overlay, ...]:
    """Draw the overlays of all readable photographs of a survey.

    Args:
        photographs: the photographs with their targets; they are read again from their files.
        solved: the adjustment of the image points, or the image points of a survey without adjustment.
        jobs: photographs drawn at the same time.
        progress: called for every photograph.

    Returns:
        The overlays in the order of the photographs, without photographs that can no longer be read.
    """
    factor = arrow_factor(solved) if isinstance(solved, Adjustment) else None
    names = overlay_names(tuple(photograph.image for photograph in photographs))

    def draw(index: int) -> Overlay | None:
        photograph = photographs[index]
        try:
            picture = draw_photograph(photograph, solved, factor)
        except PhotographError:
            return None
        legend = _legend(picture.shape[1], factor, photograph)
        return Overlay(
            photograph.image,
            names[index],
            jpeg_of(np.vstack([picture, legend]), JPEG_QUALITY),
            jpeg_of(fitted_picture(picture, THUMBNAIL_SIDE_PX), JPEG_QUALITY),
        )

    drawn = []
    with ThreadPoolExecutor(max_workers=max(1, jobs)) as pool:
        for overlay in pool.map(draw, range(len(photographs))):
            if overlay is not None:
                drawn.append(overlay)
                progress.advance(overlay.image)
    return tuple(drawn)


def draw_photograph(
    photograph: PhotographTargets, solved: Adjustment | Network, factor: float | None
) -> AnyArray:
    """Draw the overlay of one photograph.

    Args:
        photograph: the photograph with its targets.
        solved: gives ids of its image points, and an adjustment also their residuals and rejections.
        factor: magnification of the residual vectors; None draws none.

    Returns:
        Picture in the channel order blue, green, red, uint8, shape (H, W, 3).

    Raises:
        PhotographError: the file can no longer be read.
    """
    grey = read_photograph(photograph.path)
    if grey.dtype == np.uint16:
        grey = (grey >> 8).astype(np.uint8)
    scale = min(1.0, MAX_SIDE_PX / max(grey.shape))
    picture = cv2.cvtColor(fitted_picture(grey, MAX_SIDE_PX), cv2.COLOR_GRAY2BGR)

    adjustment = solved if isinstance(solved, Adjustment) else None
    network = solved.network if isinstance(solved, Adjustment) else solved
    rows = network.rows_by_photograph.get(photograph.image, np.zeros(0, dtype=np.int64))
    seen, points = network.image_points.xy[rows], network.image_points.point[rows]
    rejected = np.zeros(len(rows), dtype=bool) if adjustment is None else adjustment.rejected[rows]
    colour = [DROPPED if dropped else USED for dropped in rejected]
    owner = nearest_image_points(photograph.xy, seen)
    colour_of_target = [UNUSED if row < 0 else colour[row] for row in owner]
    crowded = len(photograph.xy) > MAX_NAMED_POINTS
    if crowded:
        # lines of zero length and the thickness of a dot, all of one colour at once
        at = np.repeat(_drawn(photograph.xy, scale)[:, None], 2, axis=1)
        for shade in dict.fromkeys(colour_of_target):
            dots = at[[c == shade for c in colour_of_target]]
            cv2.polylines(picture, list(dots), False, shade, 2 * DOT_PX, cv2.LINE_AA, SHIFT)
    else:
        _outlines(picture, photograph, colour_of_target, scale)
    _crosses(picture, photograph.rejected_xy, photograph.rejected_flag, scale)
    if adjustment is not None and factor is not None:
        # The vector points from the measured to the adjusted position: v = computed - measured.
        ends = seen + factor / scale * adjustment.residuals[rows]
        finite = np.isfinite(ends).all(axis=1)  # a rejected point behind the camera has no residual
        lines = np.stack([_drawn(seen[finite], scale), _drawn(ends[finite], scale)], axis=1)
        cv2.polylines(picture, list(lines), False, ARROW, 1 if crowded else 2, cv2.LINE_AA, SHIFT)
    # a crowd is of natural texture, whose numbers mean nothing; what has a name is still found by it
    labelled = network.named[points] if crowded else np.ones(len(rows), dtype=bool)
    if labelled.sum() <= MAX_NAMED_POINTS:
        for k in np.flatnonzero(labelled).tolist():
            _label(picture, network.points[points[k]], seen[k], scale, colour[k])
    return picture


def arrow_factor(adjustment: Adjustment) -> float:
    """Return the magnification of residual vectors: 1, 2 or 5 times a power of ten."""
    rms, network = adjustment.rms_px, adjustment.network
    if not np.isfinite(rms) or rms <= 0:
        return 1.0
    crowded = len(network.image_points) > MAX_NAMED_POINTS * len(network.images)
    longest = (CROWDED_ARROW_PX if crowded else ARROW_PX) / rms
    power = 10.0 ** np.floor(np.log10(longest))
    return float(max(step * power for step in (1, 2, 5) if step * power <= longest))


def overlay_names(images: tuple[str, ...]) -> tuple[str, ...]:
    """Return a file name for the overlay of each photograph; names differ even without regard to case."""
    names: list[str] = []
    taken: set[str] = set()
    for image in images:
        base = image.replace("/", "_").replace("\\", "_")
        stem = base.rsplit(".", 1)[0] or base
        name, number = f"{stem}.jpg", 2
        while name.lower() in taken:
            name, number = f"{stem}_{number}.jpg", number + 1
        taken.add(name.lower())
        names.append(name)
    return tuple(names)


def nearest_image_points(xy: FloatArray, measured: FloatArray) -> IntArray:
    """Return the index of the image point that each target became, -1 for none, shape (k,).

    Args:
        xy: centres of the targets, px, (k, 2).
        measured: image points of the photograph, px, (n, 2).
    """
    if not len(xy) or not len(measured):
        return np.full(len(xy), -1, dtype=np.int64)
    distance, nearest = cKDTree(measured).query(xy, distance_upper_bound=SAME_PX)
    return np.where(np.isfinite(distance), nearest, -1)


def _remarks(photograph: PhotographTargets) -> IntArray:
    """Return the remark flags of the measured targets, 0 if they were not kept, shape (k,)."""
    return np.zeros(len(photograph.xy), np.int64) if photograph.flag is None else photograph.flag


def _drawn(xy: FloatArray, scale: float) -> AnyArray:
    """Return positions with SHIFT fractional bits, as OpenCV takes them, scaled about the pixel corner."""
    return np.round(((xy + 0.5) * scale - 0.5) * (1 << SHIFT)).clip(-(2**28), 2**28).astype(np.int32)


def _outlines(
    picture: AnyArray, photograph: PhotographTargets, colour: list[tuple[int, int, int]], scale: float
) -> None:
    """Draw the outlines of targets, each with one further outline around it per remark."""
    remarks = _remarks(photograph)
    for k, at in enumerate(_drawn(photograph.xy, scale).tolist()):
        colours = [colour[k], *(second for remark, second in REMARK_COLOURS if remarks[k] & remark.value)]
        for n, one_colour in enumerate(colours, start=1):
            semi = photograph.semi_axes[k] * scale + 2 * n
            axes = np.round(semi * (1 << SHIFT)).astype(int).tolist()
            degrees = float(np.degrees(photograph.angle[k]))
            cv2.ellipse(picture, at, axes, degrees, 0, 360, one_colour, 1, cv2.LINE_AA, SHIFT)


def _crosses(picture: AnyArray, xy: FloatArray, flag: IntArray, scale: float) -> None:
    """Draw rejected candidates, all of one flag at once; a photograph may have thousands."""
    at = _drawn(xy, scale)
    for value in np.unique(flag).tolist():
        colour = next((colour for reason, colour in REASON_COLOURS if value & reason.value), INK)
        arm = (2 if value & Flag.TOO_SMALL.value else 4) << SHIFT
        strokes = np.array([[[-arm, -arm], [arm, arm]], [[-arm, arm], [arm, -arm]]], dtype=np.int32)
        lines = (at[flag == value][:, None, None] + strokes).reshape(-1, 2, 2)
        cv2.polylines(picture, list(lines), False, colour, 1, cv2.LINE_AA, SHIFT)


def _label(picture: AnyArray, name: str, xy: FloatArray, scale: float, colour: tuple[int, ...]) -> None:
    x, y = _drawn(xy, scale).tolist()
    at = (x >> SHIFT) + 5, (y >> SHIFT) - 5
    text = name.encode("ascii", "replace").decode()
    for shade, thickness in ((INK, 3), (colour, 1)):
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, LABEL_SIZE, shade, thickness, cv2.LINE_AA)


def _legend(width: int, factor: float | None, photograph: PhotographTargets) -> AnyArray:
    """Return the strip below the photograph that explains the colours and the scale of the vectors."""
    entries: list[tuple[str, tuple[int, int, int]]] = [
        ("accepted", USED),
        ("rejected in the adjustment", DROPPED),
        ("measured, not part of the result", UNUSED),
    ]
    if factor is None:
        entries = [("image point", USED), ("measured, not an image point", UNUSED)]
    else:
        entries.append((f"residual, {factor:g} times as long", ARROW))
    entries += [
        (f"x {in_words(Flag, reason)}", colour)
        for reason, colour in REASON_COLOURS
        if (photograph.rejected_flag & reason.value).any()
    ]
    entries += [
        (f"o {in_words(Flag, remark)}", colour)
        for remark, colour in REMARK_COLOURS
        if (_remarks(photograph) & remark.value).any()
    ]
    size, row_height = 0.5, 24
    rows: list[list[tuple[str, tuple[int, int, int], int]]] = [[]]
    x = 10
    for text, colour in entries:
        needed = 26 + cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0] + 18
        if x + needed > width and rows[-1]:
            rows.append([])
            x = 10
        rows[-1].append((text, colour, x))
        x += needed
    strip = np.full((row_height * len(rows) + 8, width, 3), PAPER, dtype=np.uint8)
    for k, row in enumerate(rows):
        y = 8 + k * row_height
        for text, colour, x in row:
            cv2.rectangle(strip, (x, y), (x + 16, y + 12), colour, -1)
            cv2.putText(strip, text, (x + 22, y + 11), cv2.FONT_HERSHEY_SIMPLEX, size, INK, 1, cv2.LINE_AA)
    return strip


def fitted_picture(picture: AnyArray, side: int) -> AnyArray:
    """Return a picture whose longer side is at most `side` px, averaged over blocks of pixels."""
    height, width = picture.shape[:2]
    scale = side / max(height, width)
    if scale >= 1:
        return picture
    size = round(width * scale), round(height * scale)
    # OpenCV averages whole blocks about ten times as fast as fractions of pixels.
    blocks = [k for k in range(2, int(1 / scale) + 1) if width % k == height % k == 0]
    if blocks:
        by_blocks = width // blocks[-1], height // blocks[-1]
        picture = cv2.resize(picture, by_blocks, interpolation=cv2.INTER_AREA)
    few = max(picture.shape[:2]) < 2 * side  # source pixels per pixel, so that four neighbours suffice
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR if few else cv2.INTER_AREA))


def jpeg_of(picture: AnyArray, quality: int) -> bytes:
    """Return a picture as JPEG with a quality from 1 to 100."""
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(data.tobytes())


def draw_patches(
    names: tuple[str, ...], left: AnyArray, right: AnyArray, matches: ConjugatePoints, template_px: int
) -> AnyArray:
    """Return a picture with template, matched patch and difference of each point in a row.

    The matched patch is converted to the template's intensities. The name and r are written above each row.
    A point that was not matched has the reason there, and only its template if that lies inside the
    photograph. The difference is mid-grey at zero and saturates at a quarter of the range of the template.
    A last line is added if not all points are drawn.
    """
    zoom = max(ZOOM, math.ceil(PANEL / template_px))
    drawn = min(len(matches), MAX_PICTURES)
    lines = []
    for k in range(drawn):
        r = float(matches.correlation[k])
        line = f"{names[k]}  r {r:.4f}" if math.isfinite(r) else names[k]
        line += f"  not matched: {matches.reason[k]}" if matches.reason[k] else ""
        lines.append(line[:MAX_LETTERS].encode("ascii", "replace").decode())  # that OpenCV can draw
    last = f"the first {drawn} of {len(matches)} points" if drawn < len(matches) else ""
    width = max(3 * zoom * template_px + 2 * GAP, LETTER * max(len(line) for line in [*lines, last]))
    rows = []
    for k, line in enumerate(lines):
        rows.append(_text(line, width))
        panels = _panels(left, right, matches, k, template_px, zoom)
        rows += [np.pad(row, ((0, 0), (0, width - row.shape[1])), constant_values=255) for row in panels]
    return np.vstack([*rows, _text(last, width)] if last else rows)


def _panels(
    left: AnyArray, right: AnyArray, matches: ConjugatePoints, k: int, template_px: int, zoom: int
) -> list[AnyArray]:
    """Return the patches of one point side by side; none if its template is outside the photograph."""
    half = template_px // 2
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    template = resample(left, matches.left[k] + np.stack([u, v], axis=-1), interpolation="bilinear")
    if not np.isfinite(template).any():
        return []
    low, high = np.nanmin(template), np.nanmax(template)
    scale = 255.0 / max(high - low, 1e-6)
    panels = [(template - low) * scale]
    if matches.good[k]:
        H = matches.warp[k]
        w = H[2, 0] * u + H[2, 1] * v + H[2, 2]
        place = np.stack([(H[i, 0] * u + H[i, 1] * v + H[i, 2]) / w for i in range(2)], axis=-1)
        patch = (resample(right, place, interpolation="bilinear") - matches.offset[k]) / matches.gain[k]
        panels += [(patch - low) * scale, 128 + 4 * (patch - template) * scale]
    row = []
    for panel in panels:
        grey = np.nan_to_num(panel).clip(0, 255).astype(np.uint8)
        big = cv2.resize(grey, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
        row += [big, np.full((len(big), GAP), 255, np.uint8)]
    return [np.hstack(row[:-1])]


def _text(line: str, width: int) -> AnyArray:
    """Return a picture of a line of text, black on white."""
    row = np.full((LINE, width), 255, np.uint8)
    cv2.putText(row, line, (2, LINE - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.45, 0, 1, cv2.LINE_AA)
    return row
