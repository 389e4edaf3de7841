"""Search for the calibration plate in photographs, when it is only known that they show one.

A plate is accepted if two photographs show one of the same size completely. A checkerboard is also accepted
if one photograph shows it completely and another shows at least half of it, cut by the border. Larger dots or
rings are marks if both photographs have them in the same positions.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np

from sfm.model.conventions import AnyArray, BoolArray, FloatArray, IntArray
from sfm.model.errors import GeometryError
from sfm.targets.codes.boards import (
    MIN_CROSSINGS,
    REDUCED_PX,
    board_ends,
    charuco_patterns,
    find_crossings,
    find_filled_board,
    name_corners,
    read_april_tags,
    reduce_photograph,
)
from sfm.targets.codes.dot_plates import Lattice, find_lattice, placements, rings_among, size_of_marks
from sfm.targets.codes.plates import GRIDS, MAX_OFF_PLACE, PlateFamily, quarter_turn, refuse_unusable_plate

# Dots or crossings along a side, and dots of a plate. Of 6000 simulated photographs of 12 to 80 dots at
# random, 101 have a lattice that fills a plate of 12 to 19 dots, and 3 a larger one. In a plane to
# MAX_OFF_PLACE, as the dots of a real plate are, 2 of the 101 are left.
MIN_SIDE, MIN_DOTS_OF_PLATE, MANY_DOTS = 3, 12, 20
MIN_FILLED_FRACTION = 0.8  # of the positions of a plate must contain dots
# A dot is a mark if it is this many standard deviations larger than its surroundings in two photographs.
MARK_SIGMAS = 5.0
# Maximum side of the reduced photographs in which boards are searched, px.
SEARCHED_PX = 1600
SMALLEST = (3, 3)  # board that OpenCV is asked to find, or any larger one
# Where rings around dots are searched, in radii of the dot: known codes have theirs from 2.0 to 4.3. Largest
# part of the circumference that is set where there is no ring, and the least that a ring has set and clear.
RING_RADII, RING_ANGLES = np.arange(1.3, 6.05, 0.1), 120
CLEAR_SHARE, ARC_SHARE, CLEAR_OF_DOT = 0.02, 0.05, 1.3
KALIBR_TAGS = "apriltag36h11"
MIN_TAGS_OF_BOARD = 4  # tags needed for the homography from a photograph to a board
MAX_SQUARES = 40  # along a side of a ChArUco board
# Number of crossings in rows and columns, and in which of these directions the border cuts the board.
Part = tuple[tuple[int, int], tuple[bool, bool]]
_LARGER = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER


def search_checkerboard(photographs: Sequence[AnyArray]) -> PlateFamily | None:
    """Return the checkerboard in photographs (uint8), with the longer side as columns; None without one.

    Source: Duda and Frese (2018), in OpenCV, for boards of any size.
    """
    return checkerboard_of_parts(
        photographs, [part_of_checkerboard(photograph) for photograph in photographs]
    )


def checkerboard_of_parts(
    photographs: Sequence[AnyArray], parts: Sequence[Part | None]
) -> PlateFamily | None:
    """Return the checkerboard that photographs (uint8) show in parts; None without one.

    Args:
        photographs: intensities, uint8, each (H, W).
        parts: part in each photograph, from `part_of_checkerboard`.
    """
    seen = [part for part in parts if part is not None]
    uncut = Counter((min(size), max(size)) for size, is_cut in seen if not any(is_cut))
    for (rows, columns), times in uncut.most_common():
        plate = PlateFamily("checkerboard", rows, columns)
        showing = sum(_is_part(*part, plate) for part in seen)
        if showing > 1 and plate.count >= MIN_CROSSINGS and _named(photographs, plate, times):
            return plate
    return None


def part_of_checkerboard(grey: AnyArray) -> Part | None:
    """Return the number of crossings in rows and columns, and in which of them the border cuts the board.

    OpenCV's finder takes ten times as long as the lattice of saddles. It is asked where these fill no board
    that ends on all sides.

    Args:
        grey: photograph, uint8, (H, W).
    """
    lattice: Lattice | None = None
    for largest_px in (REDUCED_PX, SEARCHED_PX):
        small, scale = reduce_photograph(grey, largest_px)
        lattice = find_filled_board(small)
        if lattice is not None:
            place = lattice.place - lattice.place.min(axis=0)
            ends = board_ends(lattice.xy, place, small.shape)
            if all(ends[0]) and all(ends[1]):
                return _size_of(place), (False, False)
        if scale == 1.0:
            break
    is_found, corners, meta = cv2.findChessboardCornersSBWithMeta(small, SMALLEST, _LARGER)
    size, xy = (0, 0), np.zeros((0, 2))
    if is_found and meta is not None:
        size, xy = meta.shape[:2], np.asarray(corners, dtype=float).reshape(-1, 2)
    place = np.stack(np.divmod(np.arange(len(xy)), max(size[1], 1)), axis=1)
    if lattice is not None and len(lattice.xy) > len(xy):  # OpenCV's ends where a wide-angle lens bends it
        xy, place = lattice.xy, lattice.place - lattice.place.min(axis=0)
        size = _size_of(place)
    if min(size) < MIN_SIDE:
        return None
    ends = board_ends(xy, place, small.shape)
    return size, (not all(ends[0]), not all(ends[1]))


def _size_of(place: IntArray) -> tuple[int, int]:
    """Return the number of rows and columns of places that begin at 0."""
    rows, columns = (place.max(axis=0) + 1).tolist()
    return int(rows), int(columns)


def _is_part(size: tuple[int, int], is_cut: tuple[bool, bool], plate: PlateFamily) -> bool:
    """Return whether crossings of this size, cut in these directions, are at least half of a board."""
    if size[0] * size[1] < max(plate.count / 2, MIN_CROSSINGS):
        return False
    return any(
        all(
            n == of_board or (cut and n < of_board)
            for n, of_board, cut in zip(size, sides, is_cut, strict=True)
        )
        for sides in ((plate.rows, plate.columns), (plate.columns, plate.rows))
    )


def search_charuco(
    photographs: Sequence[AnyArray], dictionary: str, tags: Sequence[tuple[IntArray, FloatArray]]
) -> PlateFamily | None:
    """Return the ChArUco board in photographs; None if their tags are not on one.

    Args:
        photographs: intensities, uint8, each (H, W).
        dictionary: dictionary of the tags, a name in tags.DICTIONARIES.
        tags: numbers (t,) and corners (t, 4, 2), px, of the tags in each photograph.
    """
    last = max((int(number.max()) for number, _ in tags if len(number)), default=0)
    for across in range(2, MAX_SQUARES):
        down = next((n for n in range(2, MAX_SQUARES) if across * n // 2 > last), None)
        if down is None:
            continue
        middles = [
            np.array(board.getObjPoints())[:, :, :2].mean(axis=1)
            for board in charuco_patterns(PlateFamily("charuco", down - 1, across - 1, (), dictionary, 0.5))
        ]
        shares = max(
            (
                [share for number, quads in tags if (share := _tag_share(number, quads, middle))]
                for middle in middles
            ),
            key=len,
        )
        if len(shares) < 2:
            continue
        share = round(float(np.median(shares)), 3)
        plate = PlateFamily("charuco", down - 1, across - 1, (), dictionary, share)
        if min(plate.rows, plate.columns) > 1 and _named(photographs, plate):
            return plate
    return None


def search_april_grids(tried: Sequence[AnyArray], others: Sequence[AnyArray] = ()) -> tuple[PlateFamily, ...]:
    """Return the AprilGrids in photographs (uint8) with tags of Kalibr's family, by their numbers.

    The other photographs are read if one of the tried ones has tags. A further grid, with higher numbers, is
    accepted if a photograph shows it together with one of the earlier grids.
    """
    seen = [read_april_tags(grey, KALIBR_TAGS) for grey in tried]
    if not any(len(number) >= MIN_TAGS_OF_BOARD for number, _ in seen):
        return ()
    photographs = [*tried, *others]
    seen += [read_april_tags(grey, KALIBR_TAGS) for grey in others]
    grids, shown = list[PlateFamily](), list[set[int]]()
    while (grid := _april_grid(photographs, seen)) is not None:
        of_grid = [(number >= grid.first_tag) & (number <= grid.last_tag) for number, _ in seen]
        showing = {k for k, on in enumerate(of_grid) if on.sum() >= MIN_TAGS_OF_BOARD}
        if not grids or any(showing & earlier for earlier in shown):
            grids.append(grid)
            shown.append(showing)
        seen = [(number[~on], quads[~on]) for (number, quads), on in zip(seen, of_grid, strict=True)]
    return tuple(grids)


def _april_grid(
    photographs: Sequence[AnyArray], seen: Sequence[tuple[IntArray, FloatArray]]
) -> PlateFamily | None:
    """Return the grid with the lowest tag numbers in photographs; None without one."""
    numbers = np.unique(np.concatenate([number for number, _ in seen]))
    if not len(numbers):
        return None
    first = int(numbers[0])
    last = int(numbers[-1]) - first
    sizes = [(last // n + 1, n) for n in range(2, last + 1)]  # the whole range, or with other grids after it
    sizes += sorted(
        ((m, n) for n in range(2, last) for m in range(2, last // n + 1)), key=lambda size: -size[0] * size[1]
    )
    for down, across in sizes:
        in_last_row = (numbers - first) // across == down - 1
        if not in_last_row.any():
            continue
        row, column = np.divmod(np.arange(across * down), across)
        middle = np.stack([column, -row], axis=1).astype(float)
        parts = [
            (number[in_grid] - first, quads[in_grid])
            for number, quads in seen
            for in_grid in [number < first + down * across]
        ]
        shares = [share for number, quads in parts if (share := _tag_share(number, quads, middle))]
        if len(shares) < 2:
            continue
        share = round(float(np.median(shares)), 3)
        plate = PlateFamily("aprilgrid", 2 * down, 2 * across, (), KALIBR_TAGS, share, first)
        named = [name_corners(number, quads, plate) for number, quads in seen]
        squares = [
            _shows_squares(grey, xy, code, plate) for grey, (xy, code) in zip(photographs, named, strict=True)
        ]
        if sum(squares) > 1:
            return plate
    return None


def _shows_squares(grey: AnyArray, xy: FloatArray, code: IntArray, plate: PlateFamily) -> bool:
    """Return whether the squares between corners of tags are as dark as the border of the tags."""
    if len(code) < 4 * MIN_TAGS_OF_BOARD:
        return False
    H, _ = cv2.findHomography(plate.plane(1.0)[code, :2], xy, cv2.LMEDS)
    if H is None:
        return False
    gap, corner = 1 - plate.tag_share, plate.plane(1.0)[code[code // plate.columns % 2 + code % 2 == 0], :2]
    # upper right of the corner; between this tag and the next one; inside the border of the tag
    places = (
        (-gap / 2, gap / 2),
        (-gap / 2, -plate.tag_share / 2),
        (plate.tag_share / 16, -plate.tag_share / 2),
    )
    at = [cv2.perspectiveTransform((corner + place)[None], H)[0] for place in places]
    inside = [np.rint(points).astype(int).clip(0, np.array(grey.shape[::-1]) - 1) for points in at]
    square, white, black = (float(np.median(grey[points[:, 1], points[:, 0]])) for points in inside)
    return square < (white + black) / 2 < white


def search_dots(
    photographs: Sequence[tuple[FloatArray, FloatArray, IntArray]],
) -> PlateFamily | None:
    """Return the plate of dots that photographs show completely; None without one.

    Args:
        photographs: for each, the centres of its circles, px, (k, 2), their mean radii, px, (k,), and their
            polarities, (k,).
    """
    seen: dict[tuple[str, int, int], list[tuple[IntArray, FloatArray]]] = {}
    for xy, radius, polarity in photographs:
        is_ring = rings_among(polarity)
        lattice = _plate_lattice(xy, ~is_ring)
        if lattice is None:
            continue
        size = size_of_marks(lattice, radius, is_ring)
        for name in GRIDS:
            complete = [
                (plate, place)
                for place in placements(lattice, PlateFamily(name, 1, 1))
                if (plate := _whole_plate(name, place)) is not None
            ]
            if complete and _apart(complete[0][0], complete[0][1], lattice.xy) == name:
                plate, place = min(complete, key=lambda option: option[0].rows > option[0].columns)
                seen.setdefault((name, plate.rows, plate.columns), []).append((place, size))
    for (name, rows, columns), shown in sorted(seen.items(), key=lambda entry: -len(entry[1])):
        if len(shown) > 1:
            return _with_marks(PlateFamily(name, rows, columns), shown)
    return None


def lattice_size(xy: FloatArray) -> tuple[int, int] | None:
    """Return the rows and columns of the lattice of circles, px, (k, 2); None if there is none of a plate."""
    lattice = _plate_lattice(xy, np.ones(len(xy), dtype=bool))
    if lattice is None:
        return None
    rows, columns = sorted((np.ptp(lattice.place, axis=0) + 1).tolist())
    return rows, columns


def has_interrupted_ring(grey: AnyArray, xy: FloatArray, shape: FloatArray, levels: FloatArray) -> BoolArray:
    """Return which dots have arcs of their own colour around them, as coded targets do, (k,).

    On ellipses similar to the dot's, some part of the circumference has the level of the dot, and farther in
    and farther out none has. Neighbouring dots are left out.

    Args:
        grey: photograph, uint8, (H, W).
        xy: centres, px, (k, 2).
        shape: (p, q, r) that turn image vectors into radii of the dot, 1/px, (k, 3).
        levels: intensity of the background and its step to the dot, (k, 2).
    """
    if len(xy) == 0:
        return np.zeros(0, dtype=bool)
    p, q, r = shape.T[:, :, None]
    t = 2 * np.pi * np.arange(RING_ANGLES) / RING_ANGLES
    det = p * r - q * q
    ex, ey = (r * np.cos(t) - q * np.sin(t)) / det, (p * np.sin(t) - q * np.cos(t)) / det
    x = (xy[:, :1, None] + RING_RADII[:, None] * ex[:, None]).astype(np.float32)
    y = (xy[:, 1:, None] + RING_RADII[:, None] * ey[:, None]).astype(np.float32)
    flat = (len(xy) * len(RING_RADII), RING_ANGLES)
    value = cv2.remap(grey, x.reshape(flat), y.reshape(flat), cv2.INTER_LINEAR).reshape(x.shape)
    on = (value - levels[:, :1, None]) / levels[:, 1:, None] > 0.5
    share = on.mean(axis=2)  # of the circumference, (k, radii)
    radius = np.sqrt(1 / np.abs(det[:, 0]))
    apart = np.hypot(*(xy[:, None] - xy).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    reach = (apart - CLEAR_OF_DOT * radius).min(axis=1) / radius  # up to the next dot
    free = reach[:, None] >= RING_RADII
    clear = (share <= CLEAR_SHARE) & free
    behind_gap = np.maximum.accumulate(clear, axis=1)
    arcs = (share >= ARC_SHARE) & (share <= 1 - ARC_SHARE) & free & behind_gap
    behind_arcs = np.maximum.accumulate(arcs, axis=1)
    return np.asarray((clear & behind_arcs).any(axis=1))


def shows_a_lattice(xy: FloatArray) -> bool:
    """Return whether most circles of a photograph (px, (k, 2)) are in rows and columns."""
    lattice = _plate_lattice(xy, np.ones(len(xy), dtype=bool))
    return lattice is not None and len(lattice.rows) > len(xy) / 2


def _plate_lattice(xy: FloatArray, is_dot: BoolArray) -> Lattice | None:
    """Return the lattice of circles that may be a plate; one of few dots must be in a plane."""
    lattice = find_lattice(xy, is_dot)
    if lattice is None or len(lattice.rows) < MIN_DOTS_OF_PLATE:
        return None
    if len(lattice.rows) < MANY_DOTS:
        place = lattice.place.astype(float)
        H, _ = cv2.findHomography(lattice.xy, place)
        if H is None:
            return None
        off = np.hypot(*(cv2.perspectiveTransform(lattice.xy[None], H)[0] - place).T)
        if off.max() > MAX_OFF_PLACE:
            return None
    return lattice


def _named(photographs: Sequence[AnyArray], plate: PlateFamily, needed: int = 2) -> bool:
    """Return whether enough photographs, at most two, show at least half of the crossings of a board."""
    count = 0
    for grey in photographs:
        # the noise does not affect which crossings are found
        saddles, _ = find_crossings(grey, plate, scale=255.0, noise=1.0)
        count += len(saddles.xy) >= max(plate.count / 2, MIN_CROSSINGS / 2)
        if count >= min(needed, 2):
            return True
    return False


def _tag_share(number: IntArray, quads: FloatArray, middle: FloatArray) -> float | None:
    """Return the side of tags in squares, if the tags fit their positions on a board with these centres."""
    if len(number) < MIN_TAGS_OF_BOARD:
        return None
    H, _ = cv2.findHomography(quads.mean(axis=1), middle[number])
    if H is None:
        return None
    placed = cv2.perspectiveTransform(quads.reshape(1, -1, 2), H).reshape(-1, 4, 2)
    if np.hypot(*(placed.mean(axis=1) - middle[number]).T).max() > MAX_OFF_PLACE:
        return None
    share = float(np.median(np.linalg.norm(placed - np.roll(placed, 1, axis=1), axis=2)))
    return share if 0 < share < 1 else None


def _whole_plate(name: str, place: IntArray) -> PlateFamily | None:
    """Return the plate that dots at rows and columns fill; None if they do not fill one."""
    place = place - place.min(axis=0)
    rows, steps = (int(n) for n in place.max(axis=0) + 1)
    shifted = PlateFamily(name, rows, 1).is_shifted
    plate = PlateFamily(name, rows, steps // 2 if shifted else steps)
    if min(plate.rows, plate.columns) < MIN_SIDE or len(place) < MIN_FILLED_FRACTION * plate.count:
        return None
    if shifted and (steps % 2 or ((place[:, 0] + place[:, 1]) % 2).any()):
        return None
    return plate


def _apart(plate: PlateFamily, place: IntArray, xy: FloatArray) -> str:
    """Return the arrangement whose row distance is nearest to that in a photograph."""
    if not plate.is_shifted:
        return plate.name
    place = place - place.mean(axis=0)
    step = np.linalg.lstsq(place, xy - xy.mean(axis=0), rcond=None)[0]
    apart = float(np.hypot(*step[0]) / np.hypot(*step[1]) / 2)
    shifted = {name: grid.apart for name, grid in GRIDS.items() if grid.shift}
    return min(shifted, key=lambda name: abs(np.log(apart / shifted[name])))


def _with_marks(plate: PlateFamily, placed: Sequence[tuple[IntArray, FloatArray]]) -> PlateFamily:
    """Return a plate with marks at the dots that are larger in two photographs, if they define its turn."""
    tables = []
    for place, size in placed:
        place = place - place.min(axis=0)
        table = np.full(place.max(axis=0) + 1, -np.inf)
        table[place[:, 0], place[:, 1]] = size
        tables.append(table)
    best: tuple[float, PlateFamily] = (0.0, plate)
    for first, second in itertools.combinations(tables, 2):
        for turn in range(4):
            turned = quarter_turn(np.argwhere(np.isfinite(second)), turn)
            low = turned.min(axis=0)
            if tuple(np.ptp(turned, axis=0) + 1) != first.shape:
                continue
            other = np.full(first.shape, -np.inf)
            other[tuple((turned - low).T)] = second[np.isfinite(second)]
            smaller = np.minimum(first, other)
            row, step = np.nonzero(smaller > MARK_SIGMAS)
            column = step // 2 if plate.is_shifted else step
            marks = tuple(zip(row.tolist(), column.tolist(), strict=True))
            marked = PlateFamily(plate.name, plate.rows, plate.columns, marks)
            try:
                refuse_unusable_plate(marked)
            except GeometryError:
                continue
            best = max(best, (float(smaller[row, step].sum()), marked), key=lambda option: option[0])
    return best[1]
