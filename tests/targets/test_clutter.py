"""Bars, print and parts of codes: what resembles a target and is none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sfm.model.camera import camera_from_values
from sfm.model.conventions import AnyArray, FloatArray, rotation_from_angles
from sfm.products.rendering.render import render_photograph
from sfm.products.rendering.scene import CircularTargets, Faces, Optics, Scene, coded_ring, discs, join_marks
from sfm.targets.codes.plates import code_family
from sfm.targets.codes.ring_cells import ROWS
from sfm.targets.codes.rings import CodeFamily
from sfm.targets.detect import find_targets
from sfm.targets.outlines import count_flags

SUPER, NOISE, BLUR = 4, 3.5, 0.75
WIDTH, HEIGHT = 1000, 700
PAPER, INK = 200.0, 50.0
# Semi-axes of bars, px: strokes of letters as large print shows them, and squares.
BARS = ((21, 3.6), (10, 2.2), (5, 2.4), (14, 5), (8, 6), (6, 6), (30, 8))


def exposed(ink: AnyArray, rng: np.random.Generator) -> AnyArray:
    """Return a photograph of what is drawn on a finer raster with 255 for ink."""
    soft = cv2.GaussianBlur(ink.astype(np.float32) / 255, (0, 0), BLUR * SUPER)
    size = (ink.shape[1] // SUPER, ink.shape[0] // SUPER)
    share = cv2.resize(soft, size, interpolation=cv2.INTER_AREA)
    picture = PAPER + (INK - PAPER) * share + rng.normal(0, NOISE, share.shape)
    return np.rint(picture).clip(0, 255).astype(np.uint8)


def test_bars_are_no_targets() -> None:
    rng = np.random.default_rng(1)
    ink = np.zeros((HEIGHT * SUPER, WIDTH * SUPER), np.uint8)
    count = 0
    for y in range(40, HEIGHT - 40, 80):
        for x in range(40, WIDTH - 40, 80):
            half = np.array(BARS[rng.integers(len(BARS))]) * rng.uniform(0.8, 1.2, 2)
            centre = SUPER * (np.array([x, y]) + rng.uniform(-3, 3, 2))
            box = cv2.boxPoints((tuple(centre), tuple(2 * SUPER * half), rng.uniform(0, 180)))
            cv2.fillPoly(ink, [np.rint(box).astype(np.int32)], 255)
            count += 1
    found = find_targets(exposed(ink, rng), min_diameter_px=4)
    assert len(found) == 0
    assert dict(count_flags(found.rejected_flag))["lobed"] > count / 3


@pytest.mark.parametrize(
    "codes",
    ["arcs", *(pytest.param(one, marks=pytest.mark.slow) for one in ("ring12", "ring14", "ring20"))],
)
def test_no_code_is_read_from_print(codes: str) -> None:
    rng = np.random.default_rng(2)
    ink = np.zeros((HEIGHT * SUPER, WIDTH * SUPER), np.uint8)
    letters = np.array(list("abdegopqO0689BDPQRci.,:;m"))
    for y in range(30, HEIGHT - 10, 34):
        x = 10
        while x < WIDTH - 60:
            size, font = rng.uniform(0.35, 1.3), int(rng.choice([0, 2, 3, 4, 5, 6, 7]))
            stroke, word = max(1, round(rng.uniform(1, 4) * size)), "".join(rng.choice(letters, 5))
            cv2.putText(ink, word, (x * SUPER, y * SUPER), font, size * SUPER, 255, stroke * SUPER)
            x += int(1.05 * cv2.getTextSize(word, font, size, stroke)[0][0]) + 8
    found = find_targets(exposed(ink, rng), codes=codes, min_diameter_px=4)
    assert len(found.rejected_xy) > 500
    assert (found.code < 0).all()


def test_counters_of_letters_are_no_targets_and_free_rings_are() -> None:
    """Letters of a geometric face: o is a ring, and b, d, p and q have a stem beside it."""
    rng = np.random.default_rng(4)
    ink = np.zeros((HEIGHT * SUPER, WIDTH * SUPER), np.uint8)
    for y in range(40, 400, 38):
        for x in range(40, WIDTH - 40, 30):
            letter = rng.choice(list("obdpq"))
            cv2.circle(ink, (x * SUPER, y * SUPER), 8 * SUPER, 255, 4 * SUPER)
            if letter != "o":
                stem = (x + (8 if letter in "dq" else -8)) * SUPER
                end = (y + (18 if letter in "pq" else -18)) * SUPER
                cv2.line(ink, (stem, y * SUPER), (stem, end), 255, 4 * SUPER)
    rings = [(100, 560), (300, 560), (500, 560)]
    for x, y in rings:  # a white dot on a black disc stands for itself
        cv2.circle(ink, (x * SUPER, y * SUPER), 16 * SUPER, 255, -1)
        cv2.circle(ink, (x * SUPER, y * SUPER), 9 * SUPER, 0, -1)
    for codes in ("none", "ring14"):
        found = find_targets(exposed(ink, rng), polarity="bright", codes=codes, min_diameter_px=4)
        assert len(found) == len(rings)
        assert np.abs(np.sort(found.xy[:, 0]) - [x for x, _ in rings]).max() < 0.6
        assert dict(count_flags(found.rejected_flag))["thin_background"] > 200


def labels(outline: str, rim: float, ratio: float, turn_deg: float) -> tuple[AnyArray, FloatArray]:
    """Return a photograph of white dots of 20 px on dark labels in rows, and their centres, px.

    Args:
        outline: round, square or oblong.
        rim: width of the label around the dot, in radii.
        ratio: of the axes of the dots, as a tilt of the whole sheet shows them.
        turn_deg: direction of the tilt.
    """
    turn, radius = np.radians(turn_deg), 10.0
    c, s = np.cos(turn), np.sin(turn)
    A = np.array([[c, -s], [s, c]]) @ np.diag([1.0, ratio]) @ np.array([[c, s], [-s, c]])
    half = radius * (1 + rim) * np.array([1.5 if outline == "oblong" else 1.0, 1.0])
    across, down = np.meshgrid(np.arange(8) - 3.5, np.arange(5) - 2.0)
    places = np.column_stack([across.ravel(), down.ravel()]) * (2 * half + 0.8 * radius)
    circle = np.exp(2j * np.pi * np.arange(180) / 180)
    disc = radius * np.column_stack([circle.real, circle.imag])
    box = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    ink = np.zeros((HEIGHT * SUPER, WIDTH * SUPER), np.uint8)
    middle = np.array([WIDTH, HEIGHT]) / 2
    for place in places:
        for shape, value in ((disc * (1 + rim) if outline == "round" else box, 255), (disc, 0)):
            corners = ((place + shape) @ A.T + middle + 0.5) * SUPER - 0.5
            cv2.fillPoly(ink, [np.rint(16 * corners).astype(np.int32)], value, cv2.LINE_8, 4)
    return exposed(ink, np.random.default_rng(5)), places @ A.T + middle


@pytest.mark.sweep(0, 5, 10)
@pytest.mark.parametrize("rim", [0.5, 0.9])
@pytest.mark.parametrize(("ratio", "turn_deg"), [(1.0, 0), (0.5, 25)])
@pytest.mark.parametrize("outline", ["round", "square", "oblong"])
def test_dots_on_labels_beside_others_are_targets(
    outline: str, rim: float, ratio: float, turn_deg: float
) -> None:
    photograph, centres = labels(outline, rim, ratio, turn_deg)
    found = find_targets(photograph, polarity="bright")
    distance = np.hypot(*(centres[:, None] - found.xy).transpose(2, 0, 1)).min(axis=1)
    assert (distance < 0.3).sum() >= 38
    assert len(found) <= 40


def test_an_arc_does_not_take_the_dot_away() -> None:
    """Three arcs about a dot, seen so that an arc looks like an ellipse."""
    family = code_family("arcs")
    assert family is not None
    places = np.array([(-24.0, -15), (23, -14), (-23, 15), (22, 16)])
    marks = [
        coded_ring(0, at, 2.4, n, family, 0.05, turn=0.3 * n)
        for at, n in zip(places, (1, 2, 3, 4), strict=True)
    ]
    sheet = Faces(
        np.zeros((1, 3)), np.array([[[1.0, 0, 0], [0, 1, 0]]]), np.array([[40.0, 30.0]]), np.array([0.8]),
        np.zeros(1), np.ones(1),
    )  # fmt: skip
    targets = CircularTargets(np.zeros(4, dtype=int), places, np.full(4, 2.4), np.arange(1, 5))
    scene = Scene(sheet, join_marks(marks), targets, background=0.8)
    camera = camera_from_values("test", "brown", (320, 240), (0.01, 0.01), c_mm=4.0)
    R = rotation_from_angles(np.radians(20), np.radians(10), np.radians(70))
    photograph, truth = render_photograph(
        scene, camera, R @ [0.0, 0.0, 180.0], R, optics=Optics(noise=0.005), rng=np.random.default_rng(1)
    )
    found = find_targets(photograph, codes=family, min_diameter_px=5)
    assert sorted(found.code.tolist()) == [1, 2, 3, 4]
    assert np.hypot(*(found.xy[np.argsort(found.code)] - truth.outline_centre).T).max() < 0.05


def perforated(radius: float, pitch: float, rows_apart: float) -> AnyArray:
    """Return a photograph of a plate with round holes, in px; every other row is moved if rows are closer."""
    ink = np.zeros((320 * SUPER, 420 * SUPER), np.uint8)
    for row, y in enumerate(np.arange(pitch, 300, pitch * rows_apart)):
        for x in np.arange(pitch + (row % 2 * pitch / 2 if rows_apart < 1 else 0), 400, pitch):
            centre = (round(16 * SUPER * x), round(16 * SUPER * y))
            cv2.circle(ink, centre, round(16 * SUPER * radius), 255, -1, cv2.LINE_AA, 4)
    return exposed(ink, np.random.default_rng(6))


def keys() -> AnyArray:
    """Return a photograph of round keys with letters on them."""
    ink = np.zeros((320 * SUPER, 420 * SUPER), np.uint8)
    letter = np.random.default_rng(7)
    for row, y in enumerate(np.arange(24, 300, 22)):
        for x in np.arange(24 + row % 4 * 5, 400, 22):
            cv2.ellipse(ink, (x * SUPER, y * SUPER), (9 * SUPER, 8 * SUPER), 0, 0, 360, 255, -1)
            at, size = ((x - 3) * SUPER, (y + 3) * SUPER), 0.25 * SUPER
            cv2.putText(ink, str(letter.choice(list("oQebd8"))), at, 0, size, 0, 3)
    return exposed(ink, np.random.default_rng(6))


@pytest.mark.sweep(0, 3, 6, 9)
@pytest.mark.parametrize("rows_apart", [1.0, 0.866])
@pytest.mark.parametrize(("radius", "pitch"), [(5, 2.4), (5, 3.0), (5, 3.6), (8, 2.8), (8, 3.3)])
def test_holes_are_refused_without_a_search(
    radius: float, pitch: float, rows_apart: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, searched = search(perforated(radius, radius * pitch, rows_apart), monkeypatch)
    assert found > 80
    assert searched < found / 4


def test_keys_are_refused_without_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    found, searched = search(keys(), monkeypatch)
    assert found > 80
    assert searched < found / 4


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize("pitch", [3.0, 3.5])
@pytest.mark.parametrize("square", [False, True])
def test_large_keys_at_the_radii_of_a_ring_are_refused_without_a_search(
    square: bool, pitch: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neighbours begin where a ring does, but go on behind it."""
    ink, half = np.zeros((440 * SUPER, 640 * SUPER), np.uint8), 14
    letter = np.random.default_rng(8)
    for row, y in enumerate(np.arange(2 * half, 440 - half, half * pitch)):
        for x in np.arange(2 * half + row % 4 * half / 2, 640 - half, half * pitch):
            left, top, size = int((x - half) * SUPER), int((y - half) * SUPER), 2 * half * SUPER
            if square:
                cv2.rectangle(ink, (left, top, size, size), 255, -1)
            else:
                middle = (left + half * SUPER, top + half * SUPER)
                cv2.ellipse(ink, middle, (half * SUPER, round(0.9 * half * SUPER)), 0, 0, 360, 255, -1)
            corner = (left + round(0.55 * half * SUPER), top + round(1.4 * half * SUPER))
            cv2.putText(ink, str(letter.choice(list("oQebd80"))), corner, 0, 0.4 * SUPER, 0, 2 * SUPER)
    found, searched = search(exposed(ink, np.random.default_rng(6)), monkeypatch, polarity="auto")
    assert found > 20
    assert searched < found / 10


def search(picture: AnyArray, monkeypatch: pytest.MonkeyPatch, polarity: str = "dark") -> tuple[int, int]:
    """Return the number of dots, and of those around which the cells of a ring are searched (13 ms each)."""
    searched = 0

    def count(image: AnyArray, xy: FloatArray, *rest: object) -> FloatArray:
        nonlocal searched
        searched += len(xy)
        return np.full((len(xy), ROWS, 14), np.nan)

    monkeypatch.setattr("sfm.targets.codes.rings.fit_cells", count)
    found = find_targets(picture, codes="ring14", polarity=polarity, min_diameter_px=5)
    return len(found), searched


def test_codes_among_holes_are_read() -> None:
    """A sheet of coded rings that lies on a perforated plate."""
    family = code_family("ring14")
    assert isinstance(family, CodeFamily)
    across, down = np.meshgrid(np.arange(12), np.arange(9))
    places = 3.0 * np.column_stack([across.ravel() - 5.5, down.ravel() - 4.0])
    holes = places[(np.abs(places) > [8.0, 7.0]).any(axis=1)]
    rings = np.array([(-3.7, 0.0), (3.7, 0.0)])
    marks = [discs(0, holes, 1.0, 0.08)]
    marks += [coded_ring(0, at, 1.0, n, family, 0.08, turn=n) for at, n in zip(rings, (20, 40), strict=True)]
    sheet = Faces(
        np.zeros((1, 3)), np.array([[[1.0, 0, 0], [0, 1, 0]]]), np.array([[19.0, 15.0]]), np.array([0.85]),
        np.zeros(1), np.ones(1),
    )  # fmt: skip
    numbers = np.append(np.zeros(len(holes), int), [20, 40])
    targets = CircularTargets(
        np.zeros(len(numbers), int), np.concatenate([holes, rings]), np.ones(len(numbers)), numbers
    )
    camera = camera_from_values("test", "brown", (720, 560), (0.01, 0.01), c_mm=9.0)
    R = rotation_from_angles(np.radians(15), np.radians(5), np.radians(15))
    photograph, _ = render_photograph(
        Scene(sheet, join_marks(marks), targets, background=0.4), camera, R @ [0.0, 0.0, 52.0], R,
        optics=Optics(noise=0.01), rng=np.random.default_rng(3),
    )  # fmt: skip
    found = find_targets(photograph, codes=family, polarity="dark")
    assert len(found) > 60
    assert sorted(found.code[found.code >= 0].tolist()) == [20, 40]
