"""Square tags: corners at their precision, no wrong id, a whole survey, sheets that are read back."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.model.camera import Camera, camera_from_values, project
from sfm.model.conventions import AnyArray, BoolArray, FloatArray
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.similarity import fit_similarity
from sfm.photographs.reading import linearise_srgb
from sfm.pipeline import run_survey
from sfm.products.printing.sheet import lay_out_sheet
from sfm.products.rendering.render import render_photograph, render_photographs
from sfm.products.rendering.scene import (
    CircularTargets,
    Faces,
    Marks,
    Optics,
    Scene,
    discs,
    join_marks,
    rectangles,
    square_tag,
)
from sfm.survey.inputs.survey import read_survey
from sfm.targets.codes.tags import (
    DICTIONARIES,
    LARGEST_DICTIONARIES,
    corner_name,
    find_tags,
    read_dictionaries,
    tag_family,
    tag_modules,
)
from sfm.targets.detect import find_targets
from sfm.targets.outlines import Flag
from tests.surveys import C_MM, PIXEL_MM, SIZE_PX, stations
from tests.synthetic import seed_of

SLOW = pytest.mark.slow
LOW, HIGH = 0.08, 0.8
NO_TARGETS = CircularTargets(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0, np.int64))
# Corners a to d of a square of half length 1, y up.
SQUARE = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


def turned(turn: float) -> FloatArray:
    """Return the corners a to d of a square of half length 1 that is turned, (4, 2)."""
    c, s = np.cos(turn), np.sin(turn)
    return SQUARE @ np.array([[c, s], [-s, c]])


def plates(size: list[tuple[float, float]], height: list[float], value: float) -> Faces:
    """Return level plates of one reflectance."""
    k = len(size)
    centre = np.column_stack([np.zeros((k, 2)), height])
    return Faces(
        centre,
        np.tile(np.eye(3)[:2], (k, 1, 1)),
        np.array(size) / 2,
        np.full(k, value),
        np.zeros(k),
        np.ones(k),
    )


def oblique_camera(tilt: float, azimuth: float, distance: float) -> tuple[FloatArray, FloatArray]:
    """Return position and rotation of a camera that looks at the origin."""
    z = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    x = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return distance * z, np.stack([x, np.cross(z, x), z], axis=1)


def photographed(
    name: str,
    number: int,
    half: float,
    tilt: float,
    rng: np.random.Generator,
    *,
    inverted: bool = False,
    touched: bool = False,
    blur_px: tuple[float, float] = (0.6, 0.9),
    noise: float = 2 / 255,
) -> tuple[AnyArray, FloatArray]:
    """Return a photograph of one tag, 1 px per unit at the origin, and its corners.

    With `touched` black squares touch the corners, as on the boards for calibration.
    """
    family = tag_family(name)
    assert family is not None
    low, high = (HIGH, LOW) if inverted else (LOW, HIGH)
    turn = rng.uniform(0, 2 * np.pi)
    tag = square_tag(0, np.zeros(2), half, number, family, low, high, turn=turn)
    if touched:
        module = 2 * half / family.modules
        squares = (half + module) * turned(turn)
        tag = join_marks(
            [tag, rectangles(0, squares, np.full((4, 2), module), np.full(4, turn), np.full(4, low))]
        )
    scene = Scene(plates([(12 * half, 12 * half)], [0.0], high), tag, NO_TARGETS)
    camera = camera_from_values("one", "brown", (320, 320), (0.01, 0.01), c_mm=10.0)
    position, rotation = oblique_camera(tilt, rng.uniform(0, 2 * np.pi), 1000.0)
    optics = Optics(blur_px=rng.uniform(*blur_px), exposure=0.9, noise=noise)
    picture, _ = render_photograph(scene, camera, position, rotation, optics=optics, rng=rng)
    corners = np.column_stack([half * turned(turn), np.zeros(4)])
    return picture, project(camera, position, rotation, corners)


@pytest.mark.sweep(1)
@pytest.mark.parametrize(
    ("half", "inverted"), [(30.0, False), (45.0, True), pytest.param(60.0, False, marks=SLOW)]
)
def test_corners_are_as_good_as_their_covariance_says(half: float, inverted: bool) -> None:
    rng = np.random.default_rng(4)
    squares, errors, expected = [], [], 0
    polarity = "bright" if inverted else "dark"
    for k in range(20):
        picture, truth = photographed(
            "apriltag36h11", 3 + k, half, np.radians(rng.uniform(0, 60)), rng, inverted=inverted
        )
        found = find_targets(picture, polarity=polarity, codes="apriltag36h11")
        corner = (found.flag & Flag.CORNER) != 0
        assert set(found.code[corner] // 4) <= {3 + k}
        assert not (found.code[~corner] >= 0).any()
        error = found.xy[corner] - truth[found.code[corner] % 4]
        covariance = found.covariance[corner]
        squares += list(np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error) / 2)
        errors += list(error)
        expected += 4
    assert len(errors) > 0.9 * expected
    assert np.sqrt(np.mean(np.square(errors))) < 0.025
    # 150 coordinates: the mean normalised square is known to 12 %; obliqueness and pixel area add a little
    assert np.mean(squares) == pytest.approx(1.0, abs=0.4)


def sharpened(picture: AnyArray, amount: float, mask_px: float) -> AnyArray:
    """Return the picture after unsharp masking."""
    wide = cv2.GaussianBlur(picture.astype(float), (0, 0), mask_px)
    return np.clip(np.rint(picture + amount * (picture - wide)), 0, 255).astype(np.uint8)


@pytest.mark.sweep(1, 4)
@pytest.mark.parametrize(
    ("half", "blur_px", "mask_px", "touched"),
    [
        ((20, 45), (0.6, 0.9), 0.0, False),
        ((18, 21), (0.6, 0.9), 0.0, False),
        ((22, 45), (1.2, 1.5), 0.0, False),
        ((20, 45), (0.6, 0.9), 1.0, False),
        ((20, 45), (0.6, 0.9), 2.0, False),
        ((20, 45), (0.6, 0.9), 0.0, True),
    ],
    ids=["plain", "small", "blurred", "sharpened", "sharpened by 2 px", "touched by squares"],
)
def test_corners_have_no_bias_along_the_diagonals(
    half: tuple[int, int], blur_px: tuple[float, float], mask_px: float, touched: bool
) -> None:
    """What shifts edges moves all corners of a tag outwards, and the scale of the survey with them."""
    rng = np.random.default_rng(21)
    outwards = []
    for k in range(8):
        picture, truth = photographed(
            "apriltag36h11",
            40 + k,
            rng.uniform(*half),
            np.radians(rng.uniform(0, 30)),
            rng,
            touched=touched,
            blur_px=blur_px,
            noise=0.3 / 255,
        )
        picture = sharpened(picture, 0.8, mask_px) if mask_px else picture
        found = find_targets(picture, polarity="dark", codes="apriltag36h11")
        corner = (found.flag & Flag.CORNER) != 0
        at = truth[found.code[corner] % 4]
        away = at - truth.mean(axis=0)
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        outwards += np.sum((found.xy[corner] - at) * away, axis=1).tolist()
    print(
        f"half side {half}, blur {blur_px} px, mask {mask_px:g} px, touched {touched}: outwards "
        f"{np.mean(outwards):+.4f} px, RMS {np.sqrt(np.mean(np.square(outwards))):.4f} px"
    )
    assert len(outwards) >= 28
    # 3e-3 px is 0.01 % of the half diagonal of a tag 42 px wide
    assert abs(np.mean(outwards)) < 3e-3 + 3 * np.std(outwards) / np.sqrt(len(outwards))
    assert np.sqrt(np.mean(np.square(outwards))) < 0.02


@pytest.mark.parametrize("curve", ["gamma 2.2", "srgb"])
def test_a_tone_curve_that_is_taken_back_leaves_the_corners(curve: str) -> None:
    """Inwards by 0.4 px as stored; a gamma of 2.2 is not quite the curve of sRGB."""
    rng = np.random.default_rng(5)
    stored, linear = [], []
    for k in range(3):
        picture, truth = photographed(
            "apriltag36h11",
            40 + k,
            30.0,
            np.radians(rng.uniform(0, 30)),
            rng,
            blur_px=(0.8, 0.8),
            noise=0.3 / 255,
        )
        light = picture / 255.0
        srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        signal = srgb if curve == "srgb" else light ** (1 / 2.2)
        coded = np.rint(255 * signal).astype(np.uint8)
        for one, into in ((coded, stored), (linearise_srgb(coded), linear)):
            found = find_targets(one, polarity="dark", codes="apriltag36h11")
            corner = (found.flag & Flag.CORNER) != 0
            at = truth[found.code[corner] % 4]
            away = at - truth.mean(axis=0)
            away /= np.linalg.norm(away, axis=1, keepdims=True)
            into += np.sum((found.xy[corner] - at) * away, axis=1).tolist()
    print(f"{curve}: outwards {np.mean(stored):.3f} px as stored, {np.mean(linear):.3f} px taken back")
    assert len(linear) == 12 and abs(np.mean(stored)) > 0.2
    assert abs(np.mean(linear)) < (0.02 if curve == "srgb" else 0.05)


@pytest.mark.parametrize("name", DICTIONARIES)
def test_every_family_is_read(name: str) -> None:
    family = tag_family(name)
    assert family is not None
    rng = np.random.default_rng(7)
    number = int(rng.integers(family.count))
    picture, truth = photographed(name, number, 60.0, 0.5, rng)
    found = find_targets(picture, polarity="dark", codes=name)
    assert found.code.tolist() == [4 * number + k for k in range(4)]
    assert np.abs(found.xy - truth).max() < 0.1
    with pytest.raises(GeometryError, match=f"family {name} has 0 to {family.count - 1}"):
        square_tag(0, np.zeros(2), 1.0, family.count, family, 0.0, 1.0)


def test_a_covered_corner_is_refused_and_the_others_are_kept() -> None:
    rng = np.random.default_rng(3)
    picture, truth = photographed("apriltag36h11", 11, 60.0, 0.3, rng)
    # a grey thread over one of the two edges of the corner a, outside the code
    along, out = truth[1] - truth[0], truth[0] - truth[3]
    ends = [truth[0] + t * along / 120 + 2 * out / 120 for t in (3, 12)]
    cv2.line(picture, *(tuple(np.rint(end).astype(int).tolist()) for end in ends), 120, 4)
    found = find_targets(picture, polarity="dark", codes="apriltag36h11")
    assert found.code.tolist() == [45, 46, 47]
    near = np.linalg.norm(found.rejected_xy - truth[0], axis=1) < 4
    assert (found.rejected_flag[near] & (Flag.POOR_FIT | Flag.NO_CONVERGENCE | Flag.BLURRED)).any()


def test_dots_on_a_tag_are_part_of_it() -> None:
    rng = np.random.default_rng(5)
    # dots as large as a module inside the tag, one outside
    picture, truth = photographed("aruco4x4_50", 17, 60.0, 0.2, rng)
    outside = truth.mean(axis=0) + 1.6 * (truth[0] - truth.mean(axis=0))
    cv2.circle(picture, tuple(np.rint(outside).astype(int).tolist()), 8, 20, -1, cv2.LINE_AA)
    found = find_targets(cv2.GaussianBlur(picture, (0, 0), 0.6), polarity="auto", codes="aruco4x4_50")
    uncoded = found.code < 0
    assert np.linalg.norm(found.xy[uncoded] - outside, axis=1).max() < 1
    assert uncoded.sum() == 1
    assert (~uncoded).sum() == 4


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FloatArray, dict[str, FloatArray]]:
    """Render six photographs of tags of 30 mm and some dots; return their folder and the truth."""
    folder = tmp_path_factory.mktemp("tags")
    family = tag_family("apriltag36h11")
    assert family is not None
    faces = plates([(420.0, 320.0), (130.0, 110.0)], [0.0, 60.0], 0.8)
    places = [(0, x, y) for x in (-165.0, -105.0, 105.0, 165.0) for y in (-115.0, 0.0, 115.0)]
    places += [(1, x, y) for x in (-35.0, 35.0) for y in (-28.0, 28.0)]
    marks: list[Marks] = []
    truth = {}
    for k, (face, x, y) in enumerate(places):
        at = np.array([x, y])
        marks.append(square_tag(face, at, 15.0, 7 * k, family, LOW, 0.8, turn=0.4 * k))
        for corner, xy in zip("abcd", at + 15 * turned(0.4 * k), strict=True):
            truth[f"{7 * k}{corner}"] = np.array([*xy, 60.0 * face])
    dots = np.array([[-35.0, -120], [0, -120], [35, -120], [-35, 120], [0, 120], [35, 120]])
    marks.append(discs(0, dots, 6.0, LOW))
    camera: Camera = camera_from_values("small", "brown", SIZE_PX, (PIXEL_MM, PIXEL_MM), c_mm=C_MM)
    positions, rotations = stations(6)
    optics = Optics(blur_px=0.7, exposure=0.9, noise=2 / 255)
    scene = Scene(faces, join_marks(marks), NO_TARGETS)
    pictures, _ = render_photographs(scene, camera, positions, rotations, optics=optics, seed=2)
    for i, picture in enumerate(pictures, 1):
        cv2.imwrite(str(folder / f"{i}.png"), picture)
    return folder, np.column_stack([dots, np.zeros(len(dots))]), truth


SURVEY = """\
[survey]
name = "tags"
unit = "mm"
[[camera]]
name = "small"
images = "*.png"
pixel_mm = [0.01, 0.01]
c_mm = 8.1
free = ["c", "x0", "y0"]
[targets]
polarity = "dark"
codes = "apriltag36h11"
tag_size = 30.0
tag_sigma = 0.01
[adjust]
sigma_px = 0.02
[compare]
backend = "none"
"""


def test_a_survey_from_tags(surveyed: tuple[Path, FloatArray, dict[str, FloatArray]]) -> None:
    folder, dots, truth = surveyed
    (folder / "survey.toml").write_text(SURVEY, encoding="utf-8")
    result = run_survey(read_survey(folder / "survey.toml"))
    adjustment = result.adjustment
    names = adjustment.network.points
    assert len(adjustment.network.images) == 6
    assert {name for name in names if not name.startswith("u")} == truth.keys()
    assert sum(name.startswith("u") for name in names) == len(dots)
    assert set(result.code[[name.startswith("21") for name in names]]) == {21}
    assert result.has_scale
    coded = np.array([not name.startswith("u") for name in names])
    given = np.array([truth[name] for name in names if name in truth])
    placed = fit_similarity(adjustment.estimate.points[coded], given)
    # the sides of the tags tell the scale: 0.01 in 30 mm, one standard deviation
    assert placed.scale == pytest.approx(1.0, abs=3 * 0.01 / 30)
    shape = fit_similarity(adjustment.estimate.points[coded], given)
    error = shape.apply(adjustment.estimate.points[coded]) - given
    assert np.sqrt((error**2).mean()) < 0.03  # 1 px is 0.77 mm, a corner 0.02 px in six photographs
    uncoded = shape.apply(adjustment.estimate.points[~coded])
    nearest = np.linalg.norm(uncoded[:, None] - dots[None], axis=2).min(axis=1)
    assert nearest.max() < 0.05
    assert 0.5 < adjustment.sigma0_px / 0.02 < 2


def test_sizes_that_do_not_go_with_the_codes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    for old, new, message in (
        ('codes = "apriltag36h11"', 'codes = "ring14"', "codes = 'ring14' has none"),
        ("tag_size = 30.0\n", "", "tag_sigma needs targets.tag_size"),
        ("tag_sigma = 0.01", "tag_sigma = 1e-7", "more than a million times its sigma"),
        ("tag_sigma = 0.01", "ring_radii = [2, 3]", "belong to rings"),
        (
            'codes = "apriltag36h11"\ntag_size = 30.0\ntag_sigma = 0.01',
            'codes = "ring14"\nring_radii = [3, 2]',
            "needed more than 1 radius",
        ),
        (
            'codes = "apriltag36h11"\ntag_size = 30.0\ntag_sigma = 0.01',
            'codes = "ring14"\nring_radii = [2.0]',
            r"line \d+: targets\.ring_radii: found \[2\.0\], needed 2 values",
        ),
    ):
        path.write_text(SURVEY.replace(old, new), encoding="utf-8")
        with pytest.raises(SurveyFileError, match=message):
            read_survey(path)


@pytest.mark.sweep(0)
@pytest.mark.parametrize(("name", "dark"), [("apriltag25h9", True), ("aruco6x6_250", False)])
def test_a_photographed_sheet_gives_its_ids(name: str, dark: bool) -> None:
    sheet = lay_out_sheet(name, np.arange(12), diameter_mm=40.0, dark=dark)
    width, height = sheet.size_mm
    page = sheet.pages[0]
    marks = page.marks
    ink, paper = (0.05, 0.9) if dark else (0.9, 0.05)
    on_paper = Marks(
        marks.face,
        marks.kind,
        marks.centre - (width / 2, height / 2),
        marks.shape,
        np.where(marks.value > 0, ink, paper),
    )
    scene = Scene(plates([(width, height)], [0.0], paper), on_paper, NO_TARGETS)
    camera = camera_from_values("one", "brown", (900, 900), (0.01, 0.01), c_mm=9.0)
    position, rotation = oblique_camera(0.4, 0.7, 400.0)
    optics = Optics(exposure=0.9, noise=0.008)
    picture, _ = render_photograph(
        scene, camera, position, rotation, optics=optics, rng=np.random.default_rng(1)
    )
    found = find_targets(picture, polarity="dark" if dark else "bright", codes=name)
    assert found.code.tolist() == list(range(4 * 12))
    corners = page.centre[:, None] - (width / 2, height / 2) + 20 * SQUARE
    flat = np.column_stack([corners.reshape(-1, 2), np.zeros(48)])
    error = found.xy - project(camera, position, rotation, flat)
    assert np.abs(error).max() < 0.1


@pytest.mark.sweep(1)
@pytest.mark.parametrize(
    "name",
    [
        *("apriltag16h5", "aruco4x4_1000"),  # of the fewest modules
        *(pytest.param(name, marks=SLOW) for name in ("apriltag36h11", "aruco_original")),
    ],
)
def test_no_tag_is_read_from_print_and_boxes(name: str) -> None:
    rng = np.random.default_rng(9)
    picture = np.full((700, 1000), 210, np.uint8)
    letters = list("abdegopqO0689BDPQRci#@%&HE")
    for y in range(20, 700, 30):
        size, stroke = float(rng.uniform(0.4, 1.2)), int(rng.integers(1, 4))
        cv2.putText(picture, "".join(rng.choice(letters, 80)), (5, y), 0, size, 30, stroke, cv2.LINE_AA)
    for _ in range(60):
        (x, y), (w, h) = rng.integers(0, (950, 650)), rng.integers(20, 120, 2)
        picture[y : y + h, x : x + w] = rng.integers(0, 255)
    found = find_targets(cv2.GaussianBlur(picture, (0, 0), 0.8), polarity="auto", codes=name)
    assert (found.code < 0).all()


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("name", LARGEST_DICTIONARIES)
def test_tags_of_all_dictionaries_are_read_together(name: str, inverted: bool) -> None:
    family, rng = tag_family(name), np.random.default_rng(seed_of(name))
    numbers = rng.choice(family.count, 4, replace=False)
    picture, first = np.full((300, 1000), 220, np.uint8), {}
    for k, number in enumerate(numbers):
        tag = np.where(np.kron(tag_modules(family, int(number)), np.ones((16, 16))) > 0, 30, 220)
        tag = np.rot90(tag, -k)  # clockwise
        left = 60 + 240 * k
        picture[60 : 60 + len(tag), left : left + len(tag)] = tag
        far = len(tag) - 1
        first[int(number)] = np.array([left, 60]) + [(0, 0), (far, 0), (far, far), (0, far)][k]
    picture = cv2.GaussianBlur(picture, (0, 0), 1.0)
    read = read_dictionaries(255 - picture if inverted else picture)
    assert name in read
    corners = {int(number): quad[0] for number, quad in zip(*read[name], strict=True)}
    for number, corner in first.items():
        np.testing.assert_allclose(corners[number], corner, atol=2.5)
    assert sum(len(number) for number, _ in read.values()) <= 5, "a code of another may agree by chance"


def test_squares_of_a_board_are_no_tags() -> None:
    squares = np.where(np.indices((9, 12)).sum(axis=0) % 2, 30, 220).astype(np.uint8)
    board = cv2.copyMakeBorder(
        np.kron(squares, np.ones((50, 50), np.uint8)), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=220
    )
    assert not read_dictionaries(cv2.GaussianBlur(board, (0, 0), 1.0))


def test_names_of_corners() -> None:
    assert [corner_name(28 + k) for k in range(4)] == ["7a", "7b", "7c", "7d"]


def printed(black: BoolArray, side_px: int, rng: np.random.Generator) -> AnyArray:
    """Return a photograph of a tag with its clear margin."""
    levels = np.kron(np.where(np.pad(black, 1), 40.0, 200.0), np.ones((32, 32)))
    side = round(side_px * (len(black) + 2) / len(black))
    tag = cv2.resize(levels, (side, side), interpolation=cv2.INTER_AREA)
    photograph = cv2.GaussianBlur(np.pad(tag, 40, constant_values=200.0), (0, 0), 0.8)
    return np.rint(photograph + rng.normal(0, 2, photograph.shape)).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("name", "side_px"),
    [
        *(("apriltag16h5", 20), ("apriltag36h11", 60)),
        *(pytest.param(name, 20, marks=SLOW) for name in ("apriltag36h11", "aruco6x6_250")),
        *(pytest.param(name, 60, marks=SLOW) for name in ("apriltag16h5", "aruco6x6_250")),
    ],
)
def test_a_wrong_module_is_not_taken_for_light(name: str, side_px: int) -> None:
    """Before, up to 8 of 12 tags with one wrong module were confirmed."""
    family, rng = tag_family(name), seed_of(f"wrong module {name} {side_px}")
    for _ in range(6):
        black = tag_modules(family, int(rng.integers(0, 29))).copy()
        assert len(find_tags(printed(black, side_px, rng), family, polarity="dark", scale=255.0).code)
        row, column = rng.integers(1, len(black) - 1, 2)
        black[row, column] ^= True
        assert not len(find_tags(printed(black, side_px, rng), family, polarity="dark", scale=255.0).code)
