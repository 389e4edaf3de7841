"""Tags of 10 to 23 px: found as OpenCV finds them, no wrong id, corners at their precision."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from sfm.model.conventions import AnyArray, FloatArray, IntArray
from sfm.targets.codes.tags import DICTIONARIES, _widening, find_tags, tag_family, tag_modules
from sfm.targets.detect import find_targets
from sfm.targets.fits.whole_tag import _model, fit_whole_tags
from sfm.targets.outlines import Flag
from tests.synthetic import seed_of

TILE, ACROSS, FINE, TEXTURE = 64, 6, 12, 16
BLUR_PX, NOISE = 0.7, 2.0


def turned(angle: float) -> FloatArray:
    """Return the matrix that turns rows by an angle."""
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def photographed(name: str, seed: int, longest: float = 23.0) -> tuple[AnyArray, IntArray, FloatArray]:
    """Return a photograph of 36 tags with one clear module about each, their ids and corners (36, 4, 2)."""
    rng, modules = np.random.default_rng(seed), tag_family(name).modules
    count = ACROSS**2
    picture = np.empty((ACROSS * TILE, ACROSS * TILE), np.float32)
    number, corners = rng.integers(0, 30, count), np.empty((count, 4, 2))
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    for k in range(count):
        tilt, axis, turn = rng.uniform(0, np.radians(50)), *rng.uniform(0, 2 * np.pi, 2)
        side, centre = rng.uniform(10, longest), TILE / 2 + rng.uniform(-2, 2, 2)

        def project(places: FloatArray) -> FloatArray:
            X, Y = (places @ turned(turn)).T  # noqa: B023
            seen = np.column_stack([X, Y * np.cos(tilt)]) / (1 + Y * np.sin(tilt) / 20)[:, None]  # noqa: B023
            return side * seen @ turned(axis) + centre  # noqa: B023

        dark, light = rng.uniform(10, 50), rng.uniform(170, 240)
        printed = np.pad(~tag_modules(tag_family(name), int(number[k])), 1, constant_values=True)
        texture = np.kron(printed * (light - dark) + dark, np.ones((TEXTURE, TEXTURE))).astype(np.float32)
        whole = TEXTURE * (modules + 2)
        H = cv2.getPerspectiveTransform(
            (whole * (square + 0.5) - 0.5).astype(np.float32),
            (FINE * (project(square * (modules + 2) / modules) + 0.5) - 0.5).astype(np.float32),
        )
        fine = np.full((FINE * TILE, FINE * TILE), rng.uniform(90, 160), np.float32)
        cv2.warpPerspective(texture, H, fine.shape[::-1], dst=fine, borderMode=cv2.BORDER_TRANSPARENT)
        soft = cv2.GaussianBlur(fine, (0, 0), FINE * np.sqrt(BLUR_PX**2 - 1 / 12))
        i, j = divmod(k, ACROSS)
        tile = cv2.resize(soft, (TILE, TILE), interpolation=cv2.INTER_AREA)
        picture[i * TILE : (i + 1) * TILE, j * TILE : (j + 1) * TILE] = tile
        corners[k] = project(square) + np.array([j, i]) * TILE
    picture += NOISE * rng.standard_normal(picture.shape, dtype=np.float32)
    return np.rint(picture).clip(0, 255).astype(np.uint8), number, corners


@pytest.mark.sweep(1)
@pytest.mark.parametrize(
    "name", ["apriltag36h11", "aruco4x4_50", pytest.param("aruco5x5_250", marks=pytest.mark.slow)]
)
def test_as_many_as_opencv_are_found_and_measured_better(name: str) -> None:
    picture, number, corners = photographed(name, 3)
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARIES[name]))
    )
    theirs = detector.detectMarkers(picture)[1]
    targets = find_targets(picture, polarity="dark", codes=name)
    of_tag = targets.code >= 0
    xy, code, covariance = targets.xy[of_tag], targets.code[of_tag], targets.covariance[of_tag]
    k = (xy[:, 1] // TILE * ACROSS + xy[:, 0] // TILE).astype(int)
    assert (code // 4 == number[k]).all()
    error = xy - corners[k, code % 4]
    ratio = np.sqrt(np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error).mean() / 2)
    print(name, len(np.unique(k)), len(theirs), np.sqrt((error**2).mean()), ratio)
    assert len(np.unique(k)) >= len(theirs) > 18
    assert np.sqrt((error**2).mean()) < 0.06  # px; 0.4 by OpenCV's refinement
    assert 0.8 < ratio < 1.2  # no tag has less than its pixels say, some have more by chance


def test_a_wrong_id_is_not_confirmed() -> None:
    name = "aruco4x4_50"
    picture, number, corners = photographed(name, 3)
    family = tag_family(name)
    m = family.modules
    square = np.array([[0, 0], [m, 0], [m, m], [0, m]], dtype=np.float32)
    H = np.array([cv2.getPerspectiveTransform(one.astype(np.float32), square) for one in corners])
    grey = picture.astype(np.float32)
    misfit = []
    for shift in (0, 1):
        clear = np.array([~tag_modules(family, int(one) + shift) for one in number])
        fits = fit_whole_tags(grey, corners, H, clear, 255.0, NOISE)
        failed = fits.flag != 0
        misfit.append(np.where(failed, np.inf, fits.noise / np.maximum(np.abs(fits.theta[..., 5]), 1e-9)))
    assert misfit[0].max() < 0.05 < 0.1 < misfit[1].min()


def test_a_tag_that_the_border_cuts_is_refused() -> None:
    m = tag_family("aruco4x4_50").modules
    quad = np.array([[[0.0, 5], [12, 5], [12, 17], [0, 17]]])
    square = np.array([[0, 0], [m, 0], [m, m], [0, m]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(quad[0].astype(np.float32), square)[None]
    clear = ~tag_modules(tag_family("aruco4x4_50"), 3)[None]
    fits = fit_whole_tags(np.full((30, 30), 90, np.float32), quad, H, clear, 255.0, NOISE)
    assert (fits.flag == Flag.CUT_BY_BORDER).all() and np.isnan(fits.noise).all()


def shaded(name: str, half: float) -> AnyArray:
    """Return a tag of this half side on paper, px, in a light that falls by 30 % over it, uint8."""
    modules = np.pad(~tag_modules(tag_family(name), 17), 1, constant_values=True)
    side = round(2 * half * len(modules) / (len(modules) - 2))
    fine = np.kron(np.where(modules, 200.0, 40.0), np.ones((48, 48)))
    tag = cv2.resize(fine, (side, side), interpolation=cv2.INTER_AREA)
    picture = np.pad(tag, 40, constant_values=200.0)
    light = 1 + 0.3 * (np.arange(len(picture)) - len(picture) / 2) / (2 * half)
    noisy = cv2.GaussianBlur(picture * light, (0, 0), 0.8) + seed_of(f"shaded {half}").normal(
        0, 2, picture.shape
    )
    return np.rint(noisy).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("half", [10.0, 15.0, 40.0, 120.0])
@pytest.mark.parametrize("name", ["apriltag36h11", "aruco4x4_1000"])
def test_codes_are_confirmed_in_uneven_light(name: str, half: float) -> None:
    tags = find_tags(shaded(name, half), tag_family(name), polarity="dark", scale=255.0)
    assert len(tags.quads) == 1 and tags.code.tolist() == [68, 69, 70, 71]


Light = Callable[[FloatArray, FloatArray], FloatArray]


def shadow(left: float, offset: float, angle: float) -> Light:
    """Return a shadow that leaves a part of the light beyond an edge, in sides of the tag and degrees."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return lambda x, y: np.where(x * c + y * s > offset, left, 1.0)


def highlight(x0: float, y0: float, radius: float) -> Light:
    """Return a soft highlight of 60 grey values on paper of 200."""
    return lambda x, y: 1 + 0.3 * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * radius**2))


def lit(name: str, side: int, angle: float, light: Light) -> tuple[AnyArray, FloatArray]:
    """Return a photograph of tag 17 and of two more beside it in even light, and its corners."""
    modules = tag_family(name).modules
    n, fine_of = int(side * 2.2) + 24, 4
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    turned_square = side * square @ turned(np.radians(angle))
    whole, px = TEXTURE * (modules + 2), fine_of * n
    y, x = ((np.mgrid[:px, :px] + 0.5) / fine_of - n / 2) / side
    pictures = []
    for number, falls in ((17, light), (18, None), (19, None)):
        printed = np.pad(~tag_modules(tag_family(name), number), 1, constant_values=True)
        texture = np.kron(np.where(printed, 200, 40), np.ones((TEXTURE, TEXTURE))).astype(np.float32)
        H = cv2.getPerspectiveTransform(
            (whole * (square + 0.5) - 0.5).astype(np.float32),
            (fine_of * (turned_square * (modules + 2) / modules + n / 2) - 0.5).astype(np.float32),
        )
        fine = np.full((px, px), 200.0, np.float32)
        cv2.warpPerspective(texture, H, (px, px), dst=fine, borderMode=cv2.BORDER_TRANSPARENT)
        if falls is not None:
            fine = (fine * falls(x, y)).astype(np.float32)
        soft = cv2.GaussianBlur(fine, (0, 0), fine_of * np.sqrt(0.8**2 - 1 / 12))
        pictures.append(cv2.resize(soft, (n, n), interpolation=cv2.INTER_AREA))
    picture = np.hstack(pictures)
    picture = picture + NOISE * seed_of(f"{name} {side} {angle}").standard_normal(picture.shape)
    return np.rint(picture).clip(0, 255).astype(np.uint8), turned_square + n / 2 - 0.5


LIGHTS = {
    **{f"{left} {offset} {angle}": (angle, shadow(left, offset, edge))
       for left in (0.8, 0.7, 0.6)
       for offset, edge, angle in ((-0.3, 30, 0), (0.0, 0, 12), (0.25, 200, 0), (0.4, 77, 70))},
    **{f"highlight {x} {y} {r}": (12, highlight(x, y, r))
       for x, y, r in ((0, 0, 0.15), (0.3, 0.2, 0.25), (-0.5, 0.5, 0.4), (0, 0.1, 0.7))},
}  # fmt: skip


@pytest.mark.sweep(0, 1)
@pytest.mark.parametrize(
    ("name", "side"),
    [
        *(("apriltag36h11", 15), ("aruco4x4_1000", 20), ("apriltag36h11", 30), ("aruco4x4_1000", 60)),
        *(pytest.param("aruco4x4_1000", side, marks=pytest.mark.slow) for side in (15, 30)),
        *(pytest.param("apriltag36h11", side, marks=pytest.mark.slow) for side in (20, 60)),
    ],
)
def test_tags_are_read_as_by_opencv_under_shadows_and_highlights(name: str, side: int) -> None:
    """Errors over stated standard deviations: 6 to 8 where small tags are fitted as if light were even.

    And 1.6 to 1.8 at 15 and 20 px where the pixels of a module, which shadows change together, count singly.
    """
    family, errors = tag_family(name), []
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARIES[name]))
    )
    for angle, light in list(LIGHTS.values())[:: 3 if side == 60 else 2]:  # whose pixels are most of all
        picture, corners = lit(name, side, angle, light)
        theirs = detector.detectMarkers(picture)[1]
        tags = find_tags(picture, family, polarity="dark", scale=255.0)
        numbers = set((tags.code // 4).tolist())
        assert set(np.ravel(theirs if theirs is not None else []).tolist()) <= numbers <= {17, 18, 19}
        ours = tags.code // 4 == 17
        off = tags.xy[ours] - corners[tags.code[ours] % 4]
        errors += np.einsum("ki,kij,kj->k", off, np.linalg.inv(tags.covariance[ours]), off).tolist()
    ratio = np.sqrt(np.mean(errors) / 2)
    print(name, side, len(errors), ratio)
    assert 0.65 < ratio < (1.6 if side == 30 else 1.3)


def test_uneven_print_is_read() -> None:
    """Modules differ by 7 % of the step, as those of a poor printer."""
    name, side_px = "aruco4x4_1000", 30
    modules = np.pad(~tag_modules(tag_family(name), 17), 1, constant_values=True)
    printed = np.where(modules, 200, 40) + 0.07 * 160 * seed_of("print").standard_normal(modules.shape)
    picture = cv2.GaussianBlur(
        np.pad(np.kron(printed, np.ones((side_px, side_px))), 40, constant_values=200.0), (0, 0), 0.8
    )
    picture = picture + seed_of("noise").standard_normal(picture.shape)
    tags = find_tags(np.rint(picture).astype(np.uint8), tag_family(name), polarity="dark", scale=255.0)
    assert tags.code.tolist() == [68, 69, 70, 71]


def test_undisturbed_corners_are_not_widened() -> None:
    noise = np.array([1.0, 1.1, 0.95, 1.2, 1.0, 1.05, 2.4, 5.0])
    widening = _widening(noise)
    assert (widening[:6] == 1).all() and 10 < widening[6] < widening[7] < 17
    assert len(_widening(np.zeros(0))) == 0 and (_widening(np.zeros(3)) == 1).all()


@pytest.mark.parametrize("side", [40, 80, 160, 300])
def test_a_dark_plate_with_a_coded_ring_is_no_tag(side: int) -> None:
    """OpenCV reads a tag; the plate shows a dot and the arcs of its code."""
    plate = np.full((300, 300), 40, np.uint8)
    cv2.circle(plate, (161, 146), 42, 225, -1)
    for outline in (
        [(40, 145), (54, 86), (96, 48), (124, 78), (99, 101), (87, 145)],
        [(196, 81), (219, 48), (264, 88), (232, 108)],
    ):
        cv2.fillPoly(plate, [np.array(outline)], 225)
    picture = np.full((side + 60, side + 60), 190, np.uint8)
    picture[30 : 30 + side, 30 : 30 + side] = cv2.resize(plate, (side, side), interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    read = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)[1]
    assert read is not None and len(read) == 1
    tags = find_tags(picture, tag_family("aruco4x4_1000"), polarity="auto", scale=255.0)
    assert len(tags.xy) == 0 and len(tags.quads) == 0 and len(tags.rejected_xy) == 4


@pytest.mark.sweep(1)
@pytest.mark.parametrize("seed", [100, 211, *(pytest.param(k, marks=pytest.mark.slow) for k in (103, 229))])
def test_letters_are_no_small_tags(seed: int) -> None:
    """Uneven light explains letters of 5 x 8 px (211, 229) as a tag whose modules are hardly resolved."""
    rng = np.random.default_rng(seed)
    picture = np.full((700, 1000), 210, np.uint8)
    for y in range(20, 700, 30):
        size, stroke = float(rng.uniform(0.4, 1.2)), int(rng.integers(1, 4))
        text = "".join(rng.choice(list("abdegopqO0689BDPQRci#@%&HE"), 80))
        cv2.putText(picture, text, (5, y), 0, size, 30, stroke, cv2.LINE_AA)
    tags = find_tags(
        cv2.GaussianBlur(picture, (0, 0), 0.8), tag_family("aruco4x4_1000"), polarity="auto", scale=255.0
    )
    assert len(tags.xy) == 0 and len(tags.quads) == 0 and len(tags.rejected_xy) > 0


@pytest.mark.parametrize("shear", [0.0, 1.6])
def test_the_model_is_the_sum_of_the_modules_and_its_derivatives_are_those_of_differences(
    shear: float,
) -> None:
    """Of a tag without perspective, whose blur is the same everywhere; sheared, it is along a direction."""
    rng = seed_of("model of a tag")
    black = rng.random((6, 6)) < 0.5
    P = np.column_stack([rng.uniform(-0.6, 0.6, (60, 2)), np.ones(60)])  # some of them beside it
    theta = np.array([7.0, shear, 3.0, -shear / 2, 5.0, 3.2, 0.0, 0.0, 0.0, 0.0, 0.06])
    share, D = _model(theta, P, black)
    A = theta[[0, 1, 3, 4]].reshape(2, 2)
    at = P[:, :2] @ A.T + theta[[2, 5]]
    fine = (np.arange(6 * 40) + 0.5) / 40
    away = np.stack(np.meshgrid(fine, fine), axis=-1)[None] - at[:, None, None]  # rows are v
    inverse = np.linalg.inv(0.06**2 * A @ A.T)
    density = np.exp(-0.5 * np.einsum("nvua,ab,nvub->nvu", away, inverse, away))
    density *= np.sqrt(np.linalg.det(inverse)) / (2 * np.pi) / 40**2
    exact = (density * np.kron(black, np.ones((40, 40)))).sum(axis=(1, 2))
    np.testing.assert_allclose(share, exact, atol=1e-3)  # of the grid and of five nodes
    for unknown, column, step in ((2, 2, 1e-5), (5, 5, 1e-5), (10, 8, 1e-7)):  # u, v and the blur
        ends = [_model(theta + sign * step * (np.arange(11) == unknown), P, black)[0] for sign in (1, -1)]
        np.testing.assert_allclose(D[:, column], (ends[0] - ends[1]) / (2 * step), atol=1e-6)
    for row in (0, 3):
        np.testing.assert_allclose(D[:, row : row + 2], D[:, [row + 2]] * P[:, :2], atol=1e-12)
