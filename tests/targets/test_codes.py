"""Tables of ring codes and the reading of codes from drawn rings."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.errors import SurveyFileError
from sfm.targets.codes import rings
from sfm.targets.codes.plates import FAMILIES, code_family
from sfm.targets.codes.rings import (
    UNCODED,
    UNREADABLE,
    CodeFamily,
    read_code_table,
    read_codes,
    ring_family,
    ring_patterns,
    smallest_rotation,
)
from sfm.targets.measure import shape_from_axes
from tests.places import SHARED
from tests.synthetic import seed_of

PUBLISHED = SHARED / "data" / "retro-panel"
SUPER = 5


def draw(
    family: CodeFamily, bits: list[tuple[float, float]], affine: FloatArray, size: int = 120
) -> AnyArray:
    """Draw a dot of radius 1 and ring sectors (from, to, degrees clockwise) through an affine map in px."""
    y, x = (np.mgrid[: size * SUPER, : size * SUPER] + 0.5) / SUPER - 0.5
    centre = (size - 1) / 2
    u, v = np.einsum("ij,jkl->ikl", np.linalg.inv(affine), np.stack([x - centre, y - centre]))
    rho, angle = np.hypot(u, v), np.degrees(np.arctan2(v, u)) % 360
    inside = rho < 1
    ring = (rho > family.inner) & (rho < family.outer)
    for start, end in bits:
        inside |= ring & ((angle - start) % 360 < end - start)
    coverage = cv2.resize(inside.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(coverage, (0, 0), 0.7)


def sectors(pattern: int, cells: int, turn: float) -> list[tuple[float, float]]:
    """Return the sectors of the set cells, most significant bit first and clockwise, turned by an angle."""
    cell = 360 / cells
    return [(k * cell + turn, (k + 1) * cell + turn) for k in range(cells) if pattern >> (cells - 1 - k) & 1]


def read(picture: AnyArray, family: CodeFamily, affine: FloatArray, dark: float, bright: float) -> int:
    """Read one code of a picture with the true outline of the dot."""
    a, s, _ = np.linalg.svd(affine)
    shape = shape_from_axes(s[None], np.arctan2(a[1, 0], a[0, 0])[None])
    centre = np.full((1, 2), (picture.shape[0] - 1) / 2)
    scaled = np.round(dark + (bright - dark) * picture).clip(0, 255).astype(np.uint8)
    code, *_ = read_codes(scaled, centre, shape, np.array([[dark, bright - dark]]), family)
    return int(code[0])


@pytest.mark.parametrize(
    ("cells", "count", "first", "last"),
    [(12, 147, 65, 2015), (14, 516, 129, 8127), (20, 24793, 1025, 523775)],
)
def test_tables_have_the_published_size_and_ends(cells: int, count: int, first: int, last: int) -> None:
    pattern = ring_patterns(cells)
    assert (len(pattern), pattern[0], pattern[-1]) == (count, first, last)
    assert (np.diff(pattern) > 0).all()


@pytest.mark.parametrize("cells", [12, 14])
def test_tables_follow_the_rule(cells: int) -> None:
    def belongs(value: int) -> bool:
        turns = [((value << k) | (value >> (cells - k))) & ((1 << cells) - 1) for k in range(cells)]
        opposite = any(value >> k & 1 and value >> (k + cells // 2) & 1 for k in range(cells // 2))
        return value == min(turns) and value.bit_count() % 2 == 0 and opposite and value != (1 << cells) - 1

    assert ring_patterns(cells).tolist() == [v for v in range(1 << cells) if belongs(v)]


@pytest.mark.skipif(not PUBLISHED.exists(), reason="../shared/data is absent")
@pytest.mark.parametrize("cells", [12, 14, 20])
def test_tables_equal_the_published_ones(cells: int) -> None:
    table = np.loadtxt(PUBLISHED / f"{cells}bit_lookup.txt", dtype=int)
    table = table[table[:, 1] > 0]  # the 20 bit file ends with a dummy row
    family = code_family(f"ring{cells}")
    assert family is not None
    np.testing.assert_array_equal(np.column_stack([family.number, family.pattern]), table)
    read_back = read_code_table(PUBLISHED / f"{cells}bit_lookup.txt")
    assert read_back.cells == cells
    np.testing.assert_array_equal(read_back.pattern, family.pattern)


def test_smallest_rotation_ignores_the_start() -> None:
    value = np.array([0b00101101, 0b01011010, 0b10110100, 0b01101001])
    assert set(smallest_rotation(value, 8).tolist()) == {0b00101101}


@pytest.mark.parametrize(("cells", "count"), [(8, 34), (10, 106), (12, 350)])
def test_necklaces_are_all_rings_but_the_empty_and_the_full_one(cells: int, count: int) -> None:
    """Counts by Burnside's lemma, two left out."""
    family = code_family(f"necklace{cells}")
    assert isinstance(family, CodeFamily)
    assert len(family.pattern) == count and family.number.tolist() == list(range(1, count + 1))
    turns = {smallest_rotation(np.array([p << 1 & ((1 << cells) - 1) | p >> (cells - 1)]), cells)[0]
             for p in family.pattern.tolist()}  # fmt: skip
    assert turns == set(family.pattern.tolist())


@pytest.mark.parametrize("name", ["ring14", "necklace10"])
def test_a_mirrored_family_reads_the_mirrored_ring(name: str) -> None:
    family, mirrored = code_family(name), code_family(f"{name}-mirrored")
    assert isinstance(family, CodeFamily) and isinstance(mirrored, CodeFamily)
    affine = 12.0 * np.eye(2)
    for k in seed_of(name).integers(len(family.pattern), size=5):
        picture = draw(family, sectors(int(family.pattern[k]), family.cells, 10), affine)
        assert read(picture, family, affine, 20, 200) == family.number[k]
        assert read(picture[:, ::-1], mirrored, affine, 20, 200) == family.number[k]


@pytest.mark.sweep(0, 2, 4)
@pytest.mark.parametrize("name", ["ring12", "ring14", "ring20"])
@pytest.mark.parametrize(("dark", "bright"), [(20.0, 200.0), (210.0, 40.0)])
def test_rings_are_read_at_any_rotation_and_tilt(name: str, dark: float, bright: float) -> None:
    family = code_family(name)
    assert family is not None
    rng = np.random.default_rng(20)
    for _ in range(12):
        k = rng.integers(len(family.pattern))
        tilt, turn = rng.uniform(0, np.radians(60)), rng.uniform(0, np.pi)
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        affine = 12 * rotation @ np.diag([1, np.cos(tilt)])
        picture = draw(family, sectors(int(family.pattern[k]), family.cells, rng.uniform(0, 360)), affine)
        assert read(picture, family, affine, dark, bright) == family.number[k]


def test_a_mirrored_ring_is_another_code() -> None:
    family = code_family("ring14")
    assert family is not None
    mirrored = [smallest_rotation(np.array([int(f"{p:014b}"[::-1], 2)]), 14)[0] for p in family.pattern]
    k = int(np.flatnonzero(np.array(mirrored) != family.pattern)[0])
    affine = 12.0 * np.eye(2)
    picture = draw(family, sectors(int(family.pattern[k]), 14, 10), affine)
    assert read(picture, family, affine, 20, 200) == family.number[k]
    assert read(picture[:, ::-1], family, affine, 20, 200) != family.number[k]


def test_a_dot_without_a_ring_is_uncoded() -> None:
    affine = 12.0 * np.eye(2)
    for name in ("arcs", "ring14"):
        family = code_family(name)
        assert family is not None
        assert read(draw(family, [], affine), family, affine, 20, 200) == UNCODED


def test_a_shadow_across_the_ring_does_no_harm() -> None:
    family = code_family("ring14")
    assert family is not None
    affine = 12.0 * np.eye(2)
    picture = draw(family, sectors(int(family.pattern[77]), 14, 33), affine)
    shade = np.linspace(0.5, 1.3, picture.shape[1])[None, :]
    assert read(picture * shade, family, affine, 10, 160) == 78


@pytest.mark.parametrize("damage", ["half cell", "smeared", "gap"])
def test_damaged_rings_are_rejected(damage: str) -> None:
    family = code_family("ring14")
    assert family is not None
    affine = 12.0 * np.eye(2)
    bits = sectors(int(family.pattern[100]), 14, 0)
    cell = 360 / 14
    if damage == "half cell":  # one more cell is half set
        clear = next(k for k in range(14) if not int(family.pattern[100]) >> (13 - k) & 1)
        bits.append(((clear + 0.25) * cell, (clear + 0.75) * cell))
        picture = draw(family, bits, affine)
    else:
        picture = draw(family, bits, affine)
        y, x = np.mgrid[: len(picture), : len(picture)] - (len(picture) - 1) / 2
        if damage == "smeared":
            picture = np.where((x > 30) & (abs(y) < 12), 0.55, picture)
        else:
            picture = np.where(abs(np.hypot(x, y) - 21) < 4, 1.0, picture)
    assert read(picture, family, affine, 20, 200) == UNREADABLE


@pytest.mark.parametrize("arcs", [1, 2, 3, 4])
def test_arcs_are_counted(arcs: int) -> None:
    family = code_family("arcs")
    assert family is not None
    span = {1: 180, 2: 75, 3: 45, 4: 45}[arcs]
    affine = np.array([[12.0, 2.0], [-1.0, 7.0]])
    bits = [(k * 360 / arcs + 20, k * 360 / arcs + 20 + span) for k in range(arcs)]
    assert read(draw(family, bits, affine), family, affine, 200, 30) == arcs
    assert read(draw(family, [(0, 360)], affine), family, affine, 200, 30) == UNREADABLE


def test_tables_are_read_from_files(tmp_path: Path) -> None:
    path = tmp_path / "my table.txt"
    path.write_text("# cells 14\n7 135\n\n3 129\n")
    family = code_family(str(path))
    assert family is not None
    assert (family.cells, family.number.tolist(), family.pattern.tolist()) == (14, [3, 7], [129, 135])
    affine = 12.0 * np.eye(2)
    assert read(draw(family, sectors(135, 14, 5), affine), family, affine, 20, 200) == 7


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 129\nx 3\n", "line 2: found 'x 3'"),
        ("", "no codes found"),
        ("# cells 14\n1 258\n", "258 is not the smallest rotation"),
    ],
)
def test_wrong_tables_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(SurveyFileError, match=message):
        code_family(str(tmp_path / "t.txt"))


def test_every_name_of_the_registry_is_a_family() -> None:
    for name in FAMILIES:
        family = code_family(name)
        assert family is None if name == "none" else family is not None and family.name == name
        assert code_family(family if family is not None else "none") is family


def test_an_unknown_family_is_refused() -> None:
    with pytest.raises(SurveyFileError, match="'ring13' is neither one of arcs, ring12"):
        code_family("ring13")


def test_published_radii_and_limits_of_rings() -> None:
    """Of AICON's rings and PhotoModeler's arcs; 20 cells are the most that are published."""
    assert (rings.RING_INNER, rings.RING_OUTER) == (2.0, 3.0)
    assert (rings.ARCS_INNER, rings.ARCS_OUTER) == (2.4, 4.3)
    assert rings.MAX_CELLS == 32 and rings.MAX_TABLE_BYTES == 10_000_000
    ring, arcs = ring_family("ring12"), ring_family("arcs")
    assert (ring.cells, ring.inner, ring.outer) == (12, 2.0, 3.0)
    assert (arcs.cells, arcs.inner, arcs.outer, len(arcs.number)) == (0, 2.4, 4.3, 0)


def test_a_mirrored_family_has_the_numbers_of_the_plain_one() -> None:
    plain, mirrored = ring_family("ring12"), ring_family("ring12-mirrored")
    assert plain.number.tolist() == list(range(1, 148)) and mirrored.name == "ring12-mirrored"
    assert (np.diff(mirrored.pattern) > 0).all()
    for number, pattern in zip(mirrored.number.tolist(), mirrored.pattern.tolist(), strict=True):
        back = int(f"{plain.pattern[number - 1]:012b}"[::-1], 2)
        assert smallest_rotation(np.array([back]), 12)[0] == pattern
    assert rings.mirrored_patterns(np.array([0b0011, 0b0100, 0b1110]), 4).tolist() == [0b1100, 0b0010, 0b0111]
    assert rings.necklaces(4).tolist() == [1, 3, 5, 7]
    assert ring_patterns(4).tolist() == [5]


def table(tmp_path: Path, text: str) -> CodeFamily:
    path = tmp_path / "t.txt"
    path.write_text(text)
    return read_code_table(path)


def test_the_cells_of_a_table_are_stated_or_those_of_its_largest_pattern(tmp_path: Path) -> None:
    assert table(tmp_path, "7 5\n8 3\n9 0\n").cells == 4  # a row with pattern 0 is no code
    found = table(tmp_path, "# a comment of words\n# cells 2\n1 1\n")
    assert (found.cells, found.number.tolist(), found.pattern.tolist()) == (2, [1], [1])
    assert (found.name, found.inner, found.outer) == ("t.txt", 2.0, 3.0)
    assert table(tmp_path, "# cells 32\n1 1\n").cells == 32
    assert table(tmp_path, "# cells many\n1 3\n").cells == 3
    assert table(tmp_path, f"1 {2**31 - 1}\n").cells == 32


@pytest.mark.parametrize(
    "text",
    [
        "# cells 1\n1 1\n",
        "# cells 33\n1 1\n",
        f"1 {2**32}\n",
        "1 2 3\n",
        "1\n",
        "-1 3\n",
        f"1 {10**19}\n",
        "1 ³\n",
    ],
)
def test_tables_that_are_none_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(SurveyFileError, match=r"t\.txt"):
        table(tmp_path, text)


def test_a_table_is_a_file_of_ten_megabytes_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SurveyFileError, match="not a readable table"):
        read_code_table(tmp_path)
    monkeypatch.setattr(rings, "MAX_TABLE_BYTES", 4)
    assert table(tmp_path, "1 3\n").number.tolist() == [1]
    with pytest.raises(SurveyFileError, match="not a readable table"):
        table(tmp_path, "1 3\n\n")


def test_numbers_have_eighteen_digits_at_most() -> None:
    assert rings._is_number("9" * 18) and not rings._is_number("9" * 19)
    assert not rings._is_number("٣") and not rings._is_number("1.0")


@pytest.mark.parametrize("step", [0.7, 1.4])
@pytest.mark.parametrize(("share", "read"), [(0.09, True), (0.11, False)])
def test_a_clear_cell_is_as_the_background_to_a_tenth_of_the_step(
    step: float, share: float, read: bool
) -> None:
    family = code_family("ring14")
    assert isinstance(family, rings.CodeFamily)
    bits = (int(family.pattern[5]) >> np.arange(13, -1, -1)) & 1
    found = np.zeros((7, 14))
    found[:3] = step * bits
    found[:3, np.flatnonzero(bits == 0)[0]] = share * step
    code, _ = rings._read_cells(found, family, 0.0)
    assert code == (family.number[5] if read else rings.UNREADABLE)


def test_shading_across_a_ring_is_a_plane_with_a_prior() -> None:
    """By 40 % to one side it is read; of the same levels in another order none is."""
    family = code_family("ring12")
    assert isinstance(family, rings.CodeFamily)
    bits = ((71 >> np.arange(11, -1, -1)) & 1).astype(bool)
    shaded = 1 + 0.4 * np.cos(2 * np.pi * (np.flatnonzero(bits) - 8) / 12)
    found = np.zeros((7, 12))
    found[:3, bits] = shaded
    assert rings._read_cells(found, family, 0.0)[0] == family.number[family.pattern.tolist().index(71)]
    found[:3, bits] = np.sort(shaded)[[0, 3, 1, 2]]
    assert rings._read_cells(found, family, 0.0)[0] == rings.UNREADABLE


@pytest.mark.parametrize(("around", "read"), [(0.12, True), (0.0, False)])
def test_glare_across_a_ring_is_no_cell(around: float, read: bool) -> None:
    """A clear cell as bright as the ring before and behind it."""
    family = code_family("ring14")
    assert isinstance(family, rings.CodeFamily)
    bits = (int(family.pattern[5]) >> np.arange(13, -1, -1)) & 1
    found = np.zeros((7, 14))
    found[:3] = bits
    clear = np.flatnonzero(bits == 0)[0]
    found[:3, clear], found[4:6, clear] = 0.12, around
    assert bool(rings._read_cells(found, family, 0.0)[0] == family.number[5]) is read


def test_the_border_of_a_label_is_on_four_sides_with_free_corners() -> None:
    border = np.tile([0.0, 0.6, 0.7], 4)
    assert rings._find_border(border, 1.0).tolist() == [False, True, True] * 4
    assert not rings._find_border(border[:11], 1.0).any()  # no multiple of four
    assert not rings._find_border(border + 0.3, 1.0).any()  # no free corner
    border[1] = 0.0
    assert rings._find_border(border, 1.0).tolist() != [False, True, True] * 4  # one side is free
