"""Trial for the kind of targets: rings, tags, boards, plates of dots and concentric tags, in this order.

A few photographs of the folder are measured with each family of codes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby
from pathlib import Path

import numpy as np

from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.model.display import counted, listed
from sfm.model.errors import GeometryError, PhotographError
from sfm.photographs.masks import Masks
from sfm.photographs.reading import read_photograph
from sfm.products.drafting.ringed_dots import Ringed, ringed_dots
from sfm.runtime.progress import SILENT, Progress
from sfm.survey.inputs.settings import TargetSettings
from sfm.survey.inputs.sources import TARGETS
from sfm.survey.measuring.measured_store import MeasuredStore
from sfm.survey.measuring.targets import measure_photograph
from sfm.targets.codes.boards import find_crossings, read_april_tags, reduce_photograph
from sfm.targets.codes.concentric import WIDTHS as CONCENTRIC
from sfm.targets.codes.concentric import read_resolved
from sfm.targets.codes.dot_plates import find_lattice
from sfm.targets.codes.plate_search import (
    KALIBR_TAGS,
    MANY_DOTS,
    SEARCHED_PX,
    Part,
    checkerboard_of_parts,
    lattice_size,
    part_of_checkerboard,
    search_april_grids,
    search_charuco,
    search_checkerboard,
    search_dots,
    shows_a_lattice,
)
from sfm.targets.codes.plates import PlateFamily, code_family, group_plates
from sfm.targets.codes.rings import NECKLACES, RING_NAMES, RINGS, CodeFamily, RingCodes, RingReader
from sfm.targets.codes.tags import (
    LARGEST_DICTIONARIES,
    MIRRORED,
    TagFamily,
    corner_name,
    read_dictionaries,
    smallest_dictionary,
    tag_family,
)
from sfm.targets.detect import Targets, find_targets
from sfm.targets.measure import shape_from_axes
from sfm.targets.outlines import as_bytes, scale_of

TRIED, PLATES_TRIED = 3, 8  # photographs that are tried, spread over the folder
MIN_READABLE = 2  # photographs
MIN_CODES = 2  # of a family in one picture; chance seldom reads so many
LOOK_PX = 900  # longer side of the pictures for a first look
# Longer side of the picture in which few small circles are searched, and their smallest diameter in it. In
# 24 million px of texture this takes 1 to 2 s a photograph, at full size 5 to 15 s.
FEW_PX, FEW_DIAMETER_PX, MANY_DIAMETER_PX = 1800, 6.0, 4.0
# Pixels of a photograph over pixels of such a picture beyond which a first look saves time.
MIN_PIXEL_RATIO = 3.0
Tags = dict[str, tuple[IntArray, FloatArray]]  # of a photograph, by dictionary, see `read_dictionaries`
NO_TAGS = np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2))
MIN_TARGETS = 12  # circles in a photograph; chance seldom finds so many


NO_MASKS = Masks()


@dataclass(frozen=True)
class _Files:
    """Photographs of the folder, without what their masks hide."""

    folder: Path | None
    masks: Masks
    store: MeasuredStore | None

    def name(self, path: Path) -> str:
        return path.name if self.folder is None else path.relative_to(self.folder).as_posix()

    def read(self, path: Path) -> AnyArray:
        return self.masks.cover(self.name(path), read_photograph(path))

    def measure(self, path: Path, family: str) -> Targets:
        codes, name = code_family(family), self.name(path)
        return measure_photograph(path, TargetSettings(), codes, self.store, name=name, masks=self.masks)[0]


@dataclass(frozen=True)
class TargetTrial:
    """Targets that a few photographs show."""

    codes: str  # family of codes, "none" without codes
    polarity: str  # dark, bright or auto
    repeated: tuple[str, ...]  # names of coded targets in two photographs or more, the most frequent first
    counts: tuple[tuple[str, int], ...]  # (family, codes in two photographs or more), the best first
    circles: float  # median number of circular targets in a photograph
    blur_px: float  # median standard deviation of their edges, px; NaN without targets
    photographs: tuple[str, ...]  # photographs that were tried
    fewest: int = 0  # codes in the photograph that has fewest
    plates: tuple[PlateFamily, ...] = ()  # calibration plates; the others are seen with the first
    left_out: tuple[tuple[PlateFamily, str], ...] = ()  # (plate that cannot be used with the first, reason)
    unreadable: tuple[tuple[str, str], ...] = ()  # (photograph that could not be decoded, reason)
    lattice: tuple[int, int] | None = None  # most rows and columns of circles, if they are no known plate
    ringed: tuple[Ringed, ...] = ()  # photographs most of whose dots have rings that no family reads

    @property
    def plate(self) -> PlateFamily | None:
        """The first calibration plate."""
        return self.plates[0] if self.plates else None


def try_targets(
    paths: Sequence[Path],
    *,
    folder: Path | None = None,
    masks: Masks = NO_MASKS,
    store: MeasuredStore | None = None,
    progress: Progress = SILENT,
) -> TargetTrial:
    """Return the targets that photographs show.

    A family is accepted if two photographs have codes of it in common: a wrong family reads a code now and
    then, but not the same one twice. A plate is accepted if two photographs show it whole.

    Args:
        paths: photographs in their order; those that cannot be decoded are skipped.
        folder: folder to which their names are relative; only the names of the files if not given.
        masks: what is black in them is ignored.
        store: stores the measurements, so that the survey need not repeat them.
        progress: receives every photograph and family.

    Raises:
        GeometryError: fewer than two of them can be decoded, or their tags are mirrored.
    """
    progress.stage("trial", TRIED + 5)
    files = _Files(folder, masks, store)
    tried, photographs, unreadable = _read_spread(paths, files, progress)
    seen = _Seen(files, tried, photographs, unreadable)
    if min(photograph.size for photograph in photographs) > MIN_PIXEL_RATIO * LOOK_PX**2:
        looks = [_look(grey) for grey in seen.greys.values()]
        board = checkerboard_of_parts(list(seen.greys.values()), [look.board for look in looks])
        if not any(look.shows_targets for look in looks) and board is None:
            circles = float(np.median([look.circles for look in looks]))
            return TargetTrial("none", "auto", (), (), circles, np.nan, seen.names, unreadable=unreadable)
        seen.tags, _ = _shared_family([look.tags for look in looks])
    readers = list(map(_ring_reader, seen.photographs, seen.plain))
    seen.counts = _repeated_rings(readers, RINGS)
    if all(len(codes) < TARGETS.fewest for codes in seen.counts.values()):
        seen.counts |= _repeated_rings(readers, NECKLACES)  # no parity: they also read rings of others
    progress.advance("rings")
    if not seen.is_coded:
        refused = {name for name, _ in unreadable}
        spread = (paths[k] for k in _spread_evenly(len(paths), PLATES_TRIED))
        more = [path for path in spread if files.name(path) not in refused]
        _try_tags_and_boards(seen, more, progress)
        _try_dots(seen, [path for path in more if path not in tried])
        progress.advance("plates of dots")
        _try_concentric_tags(seen)
        progress.advance("concentric tags")
    return _decided(seen)


@dataclass
class _Seen:
    """What the trials have found in the photographs so far."""

    files: _Files
    paths: list[Path]
    photographs: list[AnyArray]
    unreadable: tuple[tuple[str, str], ...]
    tags: str = ""  # dictionary that a first look found
    counts: dict[str, tuple[int, ...]] = field(default_factory=dict)  # repeated codes of each family
    measured: list[Targets] = field(default_factory=list)  # with the best family; empty: as `plain`
    plates: tuple[PlateFamily, ...] = ()
    left_out: tuple[tuple[PlateFamily, str], ...] = ()
    ringed: tuple[Ringed, ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the photographs."""
        return tuple(map(self.files.name, self.paths))

    @cached_property
    def greys(self) -> dict[Path, AnyArray]:
        """Intensities of the photographs as bytes."""
        return dict(zip(self.paths, map(_as_bytes, self.photographs), strict=True))

    @cached_property
    def plain(self) -> list[Targets]:
        """Targets measured without a family, or with the tags of the first look."""
        return self.measure(self.tags or "none")  # with tags: not measured twice

    @property
    def best(self) -> str:
        """Family with most repeated codes."""
        return max(self.counts, key=lambda family: len(self.counts[family]))

    @property
    def is_coded(self) -> bool:
        """Whether the best family has as many repeated codes as orient a photograph."""
        return len(self.counts[self.best]) >= TARGETS.fewest

    def measure(self, family: str) -> list[Targets]:
        """Return the targets of the photographs, with codes of a family."""
        return [self.files.measure(path, family) for path in self.paths]


def _try_tags_and_boards(seen: _Seen, more: Sequence[Path], progress: Progress) -> None:
    """Search boards, and the dictionary of tags that photographs have in common.

    Tags on a checkerboard show that it is a ChArUco board.
    """
    tried = list(seen.greys.values())
    others = [_as_bytes(seen.files.read(path)) for path in more if path not in seen.greys]
    seen.plates = search_april_grids(tried, others)  # first, since modules of tags may look like squares
    if seen.plates:
        return
    plate = search_checkerboard([*tried, *others])
    seen.plates = () if plate is None else (plate,)
    progress.advance("boards")
    read = [read_dictionaries(photograph) for photograph in tried]
    if any(read):
        read += [read_dictionaries(photograph) for photograph in others]
    progress.advance("tags")
    family, largest = _shared_family(read)
    _refuse_mirrored(read)
    if not family:
        if not seen.plates:
            flipped = [read_april_tags(np.ascontiguousarray(grey[:, ::-1]), KALIBR_TAGS) for grey in tried]
            _refuse_mirrored([{KALIBR_TAGS + MIRRORED: tags} for tags in flipped])
        return
    tags = [read_tags.get(largest, NO_TAGS) for read_tags in read]
    charuco = search_charuco([*tried, *others], family, tags)
    if charuco is not None:
        seen.plates = (charuco,)
    if not seen.plates:
        seen.measured = seen.plain if family == seen.tags else seen.measure(family)
        seen.counts[family] = _repeated_codes([targets.code for targets in seen.measured])


def _refuse_mirrored(read: Sequence[Tags]) -> None:
    """Refuse photographs whose tags are read in a mirror only.

    Raises:
        GeometryError: two of them show as many of these tags as orient a photograph.
    """
    for name in LARGEST_DICTIONARIES:
        numbers = [np.unique(tags.get(name + MIRRORED, NO_TAGS)[0]).tolist() for tags in read]
        repeated = _repeated_codes([np.array(codes, dtype=np.int64) for codes in numbers])
        if len(repeated) >= TARGETS.fewest:
            raise GeometryError(
                f"the photographs show {len(repeated)} tags of {name} as in a mirror; print the board or the "
                "tags anew, not mirrored, or use the original photographs if a program mirrored them"
            )


def _try_dots(seen: _Seen, others: Sequence[Path]) -> None:
    """Search a plate of dots beside the boards, unless tags are read."""
    if seen.is_coded and not seen.plates:
        return
    seen.ringed = tuple(map(ringed_dots, seen.names, seen.greys.values(), seen.plain))
    if any(dots.are_most for dots in seen.ringed):
        return

    def circles(targets: Targets) -> tuple[FloatArray, FloatArray, IntArray]:
        circle = targets.is_circle
        return targets.xy[circle], np.sqrt(targets.semi_axes[circle].prod(axis=1)), targets.polarity[circle]

    shown = [circles(targets) for targets in seen.plain]
    if any(shows_a_lattice(xy) for xy, _, _ in shown):
        shown += [circles(seen.files.measure(path, "none")) for path in others]
    plate = search_dots(shown)
    if plate is None:
        return
    pictures = zip(seen.greys.values(), seen.plain, strict=True)
    if not seen.plates:
        seen.plates = (plate,)
    elif any(_shows_both(grey, targets, seen.plates[0], plate) for grey, targets in pictures):
        seen.plates, seen.left_out = _side_by_side((*seen.plates, plate))
    else:
        seen.left_out = ((plate, "no photograph tried shows it with the first plate"),)


def _try_concentric_tags(seen: _Seen) -> None:
    if seen.plates or seen.is_coded:
        return
    rings = [read_resolved(photograph) for photograph in seen.photographs]
    seen.counts |= {family: _repeated_codes([read[family] for read in rings]) for family in CONCENTRIC}
    if seen.is_coded:
        seen.measured = seen.measure(seen.best)


def _decided(seen: _Seen) -> TargetTrial:
    """Return what the trials have found: codes, else plates, else what is like them."""
    best, counts = seen.best, seen.counts
    coded = seen.is_coded and not seen.plates
    measured = seen.measure(best) if coded and best in RING_NAMES else seen.measured or seen.plain
    unknown = not coded and not seen.plates
    name_of = corner_name if isinstance(code_family(best), TagFamily) else str
    blur = np.concatenate([targets.blur for targets in measured])
    return TargetTrial(
        best if coded else seen.plates[0].name if seen.plates else "none",
        _polarity(measured) if coded else "auto",
        tuple(map(name_of, counts[best])) if coded else (),
        tuple(sorted(((family, len(codes)) for family, codes in counts.items()), key=lambda row: -row[1])),
        float(np.median([targets.is_circle.sum() for targets in measured])),
        float(np.median(blur)) if len(blur) else float("nan"),
        seen.names,
        min(int((targets.code >= 0).sum()) for targets in measured) if coded else 0,
        seen.plates,
        seen.left_out,
        seen.unreadable,
        _largest_lattice(seen.plain) if unknown else None,
        tuple(dots for dots in seen.ringed if dots.are_most) if unknown else (),
    )


def _shows_both(grey: AnyArray, targets: Targets, board: PlateFamily, dots: PlateFamily) -> bool:
    """Return whether a photograph shows a board and most of a plate of dots."""
    lattice = find_lattice(targets.xy, np.ones(len(targets.xy), dtype=bool))
    if lattice is None or len(lattice.rows) < dots.count / 2:
        return False
    crossings, _ = find_crossings(grey, board, scale=255.0, noise=1.0)
    return len(crossings.xy) >= board.count / 2


def _side_by_side(
    plates: tuple[PlateFamily, ...],
) -> tuple[tuple[PlateFamily, ...], tuple[tuple[PlateFamily, str], ...]]:
    """Return the plates that one survey can use together, and the others with the reason.

    A plate that does not look alike when turned comes first.
    """
    used, left_out = list[PlateFamily](), list[tuple[PlateFamily, str]]()
    for plate in sorted(plates, key=lambda plate: plate.is_ambiguous):
        try:
            group_plates([*used, plate] if used else [])
        except GeometryError as error:
            left_out.append((plate, str(error)))
        else:
            used.append(plate)
    return tuple(used), tuple(left_out)


def _ring_reader(photograph: AnyArray, targets: Targets) -> RingReader:
    """Return a reader of rings around the measured circles of a photograph."""
    circle = targets.is_circle
    levels = np.column_stack([targets.background, targets.contrast])[circle]
    shape = shape_from_axes(targets.semi_axes[circle], targets.angle[circle])
    return RingReader(photograph, targets.xy[circle], shape, levels, blur_px=targets.blur[circle])


def _read_rings(family: str, reader: RingReader, *, as_seen: bool = True) -> RingCodes:
    """Return the codes of the circles of a photograph in a family of rings, see `RingReader.read`."""
    rings = code_family(family)
    assert isinstance(rings, CodeFamily)
    return reader.read(rings, as_seen=as_seen)


def _repeated_rings(readers: Sequence[RingReader], families: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
    """Return the repeated codes of families of rings that photographs show.

    Rings are first read with the radii of each family. With the radii that the photographs show they are read
    in the families with the number of cells that was then found, and in all if there was none: a search in a
    wrong number of cells finds nothing and takes longest.
    """

    def read(alike: Sequence[str], *, as_seen: bool) -> tuple[int, int]:
        """Read families alike in cells; return the most repeated codes, and rings that are then unread."""
        most, unread = 0, 0
        for family in alike:
            rings = [_read_rings(family, reader, as_seen=as_seen) for reader in readers]
            counts[family] = _repeated_codes([photograph.code for photograph in rings])
            if len(counts[family]) > most:
                most = len(counts[family])
                unread = sum(int((photograph.ringed & (photograph.code < 0)).sum()) for photograph in rings)
        return most, unread

    counts: dict[str, tuple[int, ...]] = {}
    cells = families.__getitem__
    likely, groups = list[list[str]](), list[list[str]]()
    for number, members in groupby(sorted(families, key=cells), key=cells):
        groups.append(list(members))
        most, unread = read(groups[-1], as_seen=False)
        if most >= TARGETS.fewest:
            likely.append(groups[-1])
            if number and most > unread:  # arcs have few numbers
                break  # fewer rings are left for families of other numbers of cells
    for alike in likely or groups:
        most, unread = read(alike, as_seen=True)
        if cells(alike[0]) and most >= max(TARGETS.fewest, unread + 1):
            break
    return counts


def _largest_lattice(photographs: Sequence[Targets]) -> tuple[int, int] | None:
    """Return the rows and columns of the largest lattice of circles; None without one of a plate's size."""
    sizes = [
        size for targets in photographs if (size := lattice_size(targets.xy[targets.is_circle])) is not None
    ]
    return max(sizes, key=lambda size: size[0] * size[1], default=None)


def _shared_family(read: Sequence[Tags]) -> tuple[str, str]:
    """Return the dictionary with most tags that two photographs have, and the largest one that contains it.

    Where two dictionaries read as many tags, the smaller one is right: chance reads fewer of its tags.
    """
    repeated = {}
    for family in LARGEST_DICTIONARIES:
        numbers = [np.unique(tags.get(family, NO_TAGS)[0]) for tags in read]
        number, times = np.unique(np.concatenate(numbers), return_counts=True)
        repeated[family] = number[times > 1]
    largest = max(repeated, key=lambda name: (len(repeated[name]), -tag_family(name).count))
    if not len(repeated[largest]):
        return "", ""
    return smallest_dictionary(largest, repeated[largest]), largest


def _as_bytes(photograph: AnyArray) -> AnyArray:
    """Return the intensities of a photograph as bytes."""
    return as_bytes(photograph, scale_of(photograph))


def _spread_evenly(count: int, tried: int) -> list[int]:
    """Return `tried` indices spread evenly over `count`."""
    return sorted({round(i * (count - 1) / max(tried - 1, 1)) for i in range(tried)})


@dataclass(frozen=True)
class _Look:
    """Result of the first look at a photograph."""

    shows_targets: bool  # codes, plates, or many circles
    circles: int
    tags: Tags = field(default_factory=dict)
    board: Part | None = None  # part of a checkerboard; not searched for if there are targets


def _look(grey: AnyArray) -> _Look:
    """Look for targets where they are found fast: in two reduced pictures, and in the full-size middle.

    The reduced picture shows large targets, and the middle some of many small ones. Few small targets may be
    anywhere: tags are read in the whole photograph, circles in the less reduced picture. There chance finds
    circles too, and only codes or a lattice of them count.
    """
    height, width = grey.shape
    top, left = max(height - LOOK_PX, 0) // 2, max(width - LOOK_PX, 0) // 2
    small, middle = reduce_photograph(grey, LOOK_PX)[0], grey[top : top + LOOK_PX, left : left + LOOK_PX]
    reduced, middle = reduce_photograph(grey, FEW_PX)[0], np.ascontiguousarray(middle)
    many = [find_targets(picture, min_diameter_px=MANY_DIAMETER_PX) for picture in (small, middle)]
    circles = max(map(len, many))
    if any(map(_shows_rings, (small, middle), many)):  # read faster than tags of a whole photograph
        return _Look(True, circles)
    for picture in (grey, small):  # OpenCV may see the edges of large or blurred ones in the small one only
        tags = read_dictionaries(picture)
        if any(len(number) >= MIN_CODES for number, _ in tags.values()):
            return _Look(True, 0, tags)
    if circles >= MIN_TARGETS:
        return _Look(True, circles, tags)
    few = find_targets(reduced, min_diameter_px=FEW_DIAMETER_PX)
    circles = max(circles, len(few))
    if (
        shows_a_lattice(few.xy)
        or _shows_rings(reduced, few)
        or any(any(map(len, read_resolved(picture).values())) for picture in (small, middle, reduced))
    ):
        return _Look(True, circles, tags)
    part = part_of_checkerboard(grey)
    board = part is not None and part[0][0] * part[0][1] >= MANY_DOTS
    searched, _ = reduce_photograph(grey, SEARCHED_PX)
    return _Look(board or len(read_april_tags(searched, KALIBR_TAGS)[0]) >= MIN_CODES, circles, tags, part)


def _shows_rings(picture: AnyArray, targets: Targets) -> bool:
    """Return whether a picture shows codes of a family of rings."""
    reader = _ring_reader(picture, targets)
    return any((_read_rings(family, reader).code >= 0).sum() >= MIN_CODES for family in (*RINGS, *NECKLACES))


def _read_spread(
    paths: Sequence[Path], files: _Files, progress: Progress
) -> tuple[list[Path], list[AnyArray], tuple[tuple[str, str], ...]]:
    """Return photographs spread over the folder, their pixels, and the undecodable ones with the reason."""
    tried: dict[int, AnyArray] = {}
    refused: dict[int, tuple[str, str]] = {}
    for place in _spread_evenly(len(paths), TRIED):
        for k in sorted(range(len(paths)), key=lambda k: abs(k - place)):
            if k in tried or k in refused:
                continue
            try:
                tried[k] = files.read(paths[k])
            except PhotographError as error:
                refused[k] = files.name(paths[k]), str(error).removeprefix(f"{paths[k].name}: ")
                continue
            progress.advance(files.name(paths[k]))
            break
    if len(tried) < MIN_READABLE:
        why = listed((f"{name}: {reason}" for name, reason in refused.values()), separator="; ")
        raise GeometryError(
            f"{counted(len(tried), 'readable photograph')}, at least {MIN_READABLE} are needed ({why})"
        )
    return [paths[k] for k in sorted(tried)], [tried[k] for k in sorted(tried)], tuple(refused.values())


def _repeated_codes(photographs: Sequence[IntArray]) -> tuple[int, ...]:
    """Return the codes that occur exactly once in each of at least two photographs, most frequent first."""
    seen = Counter[int]()
    for read in photographs:
        codes, times = np.unique(read[read >= 0], return_counts=True)
        seen.update(codes[times == 1].tolist())
    return tuple(code for code, times in seen.most_common() if times > 1)


def _polarity(photographs: Sequence[Targets]) -> str:
    """Return the polarity of the coded targets, "auto" if there are both."""
    polarities = {int(p) for targets in photographs for p in targets.polarity[targets.code >= 0]}
    return {-1: "dark", 1: "bright"}[polarities.pop()] if len(polarities) == 1 else "auto"
