"""Folders of plates and boards: found by a trial of targets, and the camera as it truly is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.model.camera import camera_from_values, project
from sfm.model.conventions import AnyArray, FloatArray
from sfm.model.network import ObjectPoints, rows_of
from sfm.pipeline import run_survey
from sfm.products.drafting.draft import draft_survey
from sfm.products.drafting.target_trial import _side_by_side, try_targets
from sfm.survey.inputs.calibration import plate_family
from sfm.survey.inputs.survey import read_survey
from sfm.targets.codes.concentric import concentric_family
from sfm.targets.codes.plate_search import search_april_grids, search_checkerboard
from sfm.targets.codes.plates import TAGGED, PlateFamily
from sfm.targets.codes.tags import opencv_dictionary
from sfm.targets.detect import find_targets
from tests.findings import findings_of
from tests.plates import GRID, PITCH, PIXEL_MM, TRUTH, camera, plate_pictures, stations
from tests.synthetic import seed_of
from tests.targets.concentric_tags import draw_tag
from tests.targets.shapes import PAPER
from tests.targets.test_april_grids import drawn, photographed

PLATES = {
    "checkerboard, odd": (PlateFamily("checkerboard", 8, 11), 4.6),
    "checkerboard, even": (PlateFamily("checkerboard", 7, 9), 4.6),
    "ChArUco": (PlateFamily("charuco", 7, 10, (), "aruco5x5_50", 0.72), 4.6),
    "grid with marks": (GRID, 4.6),
    "grid with marks 1.08 times larger": (GRID, 3.24),
    "grid without marks": (PlateFamily("grid", 8, 10), 4.6),
    "asymmetric": (PlateFamily("asymmetric-grid", 13, 5), 4.6),
    "AprilGrid": (PlateFamily("aprilgrid", 8, 12, (), "apriltag36h11", 0.769), 4.6),
    "AprilGrid from tag 40": (PlateFamily("aprilgrid", 10, 10, (), "apriltag36h11", 0.7, 40), 4.6),
    "hexagonal": (PlateFamily("hexagonal-grid", 9, 9), 4.6),
}


QUICK = ("AprilGrid",)


@pytest.mark.parametrize(
    "kind", [kind if kind in QUICK else pytest.param(kind, marks=pytest.mark.slow) for kind in PLATES]
)
def test_a_folder_of_a_plate_calibrates_the_camera(kind: str, tmp_path: Path) -> None:
    plate, mark = PLATES[kind]
    for k, picture in enumerate(plate_pictures(plate, seed_of(f"folder of {kind}"), 8, mark=mark)):
        cv2.imwrite(str(tmp_path / f"photo {k}.png"), picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    draft = draft_survey(tmp_path, pitch=PITCH)
    file = tmp_path / "survey.toml"
    file.write_text(draft.text.replace('backend = "colmap"', 'backend = "none"'))
    survey = read_survey(file)
    assert survey.targets.codes == plate.name
    found_size, size = (survey.targets.rows, survey.targets.columns), (plate.rows, plate.columns)
    assert found_size == size or (sorted(found_size) == sorted(size) and plate.name != "aprilgrid")
    assert len(survey.targets.marks) == len(plate.marks)
    if plate.name in TAGGED:
        assert survey.targets.first_tag == plate.first_tag
        assert survey.targets.dictionary == plate.dictionary
        assert survey.targets.tag_size == pytest.approx(plate.tag_share * PITCH, rel=0.05)
    result = run_survey(survey)
    assert len(result.failed) <= 1  # some show a part of it
    adjustment, family = result.adjustment, plate_family(survey.targets)
    assert family is not None
    (found,) = adjustment.estimate.cameras
    covariance = adjustment.covariance.interior[0]
    free = [name for name, is_free in zip(found.names, found.free, strict=True) if is_free]
    for name in ("c", "x0", "y0"):
        sigma = covariance[free.index(name), free.index(name)] ** 0.5
        error = found.value(name) - TRUTH[name] * found.pixel_mm[0] / PIXEL_MM
        assert abs(error) < 4.5 * sigma, name
    assert findings_of(result).verdict.level != "bad"
    ratio = errors_over_stated(adjustment, plate, f"folder of {kind}", survey.adjust.sigma_px)
    print(f"{kind}: errors of image points {ratio:.2f} of the stated ones")
    assert 0.8 < ratio < 1.3
    off = beside_opencv(adjustment, family.plane(PITCH).astype(np.float32))
    print(f"{kind}: largest difference from OpenCV {off.max():.1e} sigma")
    assert off.max() < 0.1


def errors_over_stated(found: Adjustment, plate: PlateFamily, seed: str, sigma_px: float) -> float:
    """Return the RMS of the errors of accepted image points over those that the photographs state."""
    points = found.network.image_points.select(~found.rejected)
    position, rotation = stations(seed_of(seed), 8, plate)
    squares = []
    for k, name in enumerate(found.network.images):
        own = points.select(points.image == k)
        n = int(Path(name).stem.split()[1])
        xy = project(camera(), position[n], rotation[n], plate.plane(PITCH))
        apart = own.xy[:, None] - xy[None]  # plates that look alike turned may be named in another turn
        off = apart[np.arange(len(apart)), np.hypot(*np.moveaxis(apart, 2, 0)).argmin(axis=1)]
        stated = own.covariance - sigma_px**2 * np.eye(2)
        squares.append(np.einsum("ki,kij,kj->k", off, np.linalg.inv(stated), off) / 2)
    return float(np.sqrt(np.concatenate(squares).mean()))


def beside_opencv(found: Adjustment, plane: FloatArray) -> FloatArray:
    """Return differences from OpenCV's calibration on the accepted image points, over sigmas, (8,).

    Args:
        found: calibration from a plate.
        plane: the points of the plate, mm, (n, 3), float32.

    Both adjust fx, fy, cx, cy, k1, k2, p1, p2 and all orientations, with equal weights.
    """
    points = found.network.image_points.select(~found.rejected)
    xy, X = points.xy.astype(np.float32), plane[[int(name) for name in found.network.points]]
    rows = [one for one in rows_of(points.image, len(found.network.images)) if len(one)]
    camera = found.estimate.cameras[0]
    rms, K, distortion, *_ = cv2.calibrateCamera(
        [X[points.point[one]] for one in rows],
        [xy[one][:, None] for one in rows],
        camera.size_px,
        None,
        None,
        flags=cv2.CALIB_FIX_K3,
        criteria=(3, 1000, 1e-15),
    )  # type: ignore[call-overload]
    free = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    c_px = camera.parameters[0] / camera.pixel_mm[0]
    start = camera_from_values("plate", "opencv", camera.size_px, (1.0, 1.0), c_mm=c_px, free=free)
    network = replace(
        found.network,
        image_points=replace(
            points, xy=xy.astype(float), covariance=np.tile(0.01 * np.eye(2), (len(xy), 1, 1))
        ),
    ).with_given(ObjectPoints(np.arange(len(X)), X.astype(float), np.zeros((len(X), 3, 3))))
    estimate = replace(found.estimate, cameras=(start,), points=X.astype(float))
    mine = adjust(network, estimate, datum=Datum("control"), reject="none")
    values = np.array([mine.estimate.cameras[0].value(name) for name in free])
    theirs = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion.ravel()[:4]])
    sigma = mine.interior_sigma(0)[[start.names.index(name) for name in free]]
    assert np.sqrt((mine.residuals**2).sum() / len(xy)) == pytest.approx(rms, rel=1e-4)
    return np.abs(values - theirs) / sigma


CHARUCO = PlateFamily("charuco", 7, 5, (), "aruco4x4_50", 0.74)
EMPTY = np.full((520, 640), 128, dtype=np.uint8)
SQUARE_PX = 52


def charuco_photograph(name: str, *, is_older: bool = False) -> AnyArray:
    """Return an oblique photograph of OpenCV's drawing of a board."""
    board = cv2.aruco.CharucoBoard(
        (CHARUCO.columns + 1, CHARUCO.rows + 1), 1.0, CHARUCO.tag_share, opencv_dictionary(CHARUCO.dictionary)
    )
    board.setLegacyPattern(is_older)
    size = SQUARE_PX * (CHARUCO.columns + 1), SQUARE_PX * (CHARUCO.rows + 1)
    sheet = cv2.copyMakeBorder(board.generateImage(size), 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=[255])
    rng = seed_of(name)
    turn = cv2.getRotationMatrix2D((186, 238), rng.uniform(-20, 20), 0.9)
    turn[:, 2] += 134, 22
    H = np.vstack([turn, [*rng.uniform(-2e-4, 2e-4, 2), 1.0]])
    seen = cv2.warpPerspective(sheet, H, (640, 520), flags=cv2.INTER_AREA, borderValue=[200])
    noisy = cv2.GaussianBlur(seen.astype(float), (0, 0), 0.8) * 0.8 + 20 + 2 * rng.standard_normal(seen.shape)
    return np.rint(noisy).clip(0, 255).astype(np.uint8)


def test_an_empty_first_photograph_does_not_hide_an_april_grid() -> None:
    grid = PlateFamily("aprilgrid", 6, 8, (), "apriltag36h11", 0.8, 17)
    shown = [photographed(drawn(grid), f"trial {k}") for k in range(2)]
    (plate,) = search_april_grids([EMPTY, shown[0]], shown[1:])
    assert (plate.rows, plate.columns, plate.first_tag) == (6, 8, 17)


@pytest.mark.slow
@pytest.mark.parametrize("is_older", [False, True])
def test_charuco_boards_of_both_patterns_are_found_behind_an_empty_photograph(
    is_older: bool, tmp_path: Path
) -> None:
    for k in range(5):
        shown = EMPTY if k == 0 else charuco_photograph(f"trial {k}", is_older=is_older)
        cv2.imwrite(str(tmp_path / f"{k}.png"), shown)
    plate = try_targets(sorted(tmp_path.glob("*.png"))).plate
    assert plate is not None
    assert (plate.name, plate.rows, plate.columns, plate.dictionary) == ("charuco", 7, 5, "aruco4x4_50")


def test_crossings_of_both_patterns_have_the_same_numbers() -> None:
    newer, older = (
        find_targets(charuco_photograph("pattern", is_older=one), codes=CHARUCO) for one in (False, True)
    )
    assert len(newer) == len(older) == CHARUCO.count
    off = newer.xy[np.argsort(newer.code)] - older.xy[np.argsort(older.code)]
    assert np.abs(off).max() < 0.5


def test_a_checkerboard_that_is_whole_in_one_photograph_is_found_where_another_cuts_it() -> None:
    squares = np.add.outer(np.arange(8), np.arange(11)) % 2
    board = np.where(squares, 220, 30).astype(np.uint8).repeat(40, 0).repeat(40, 1)
    whole = cv2.GaussianBlur(np.pad(board, 60, constant_values=220), (0, 0), 1.0)
    plate = search_checkerboard([whole, whole[:, 160:480]])  # cut on both sides, 7 by 7 crossings
    assert plate is not None and (plate.rows, plate.columns) == (7, 10)
    for other in (EMPTY, whole[:, 160:340], whole[200:360, 160:480]):  # none, and less than half of it
        assert search_checkerboard([whole, other]) is None
    shorter = np.pad(board[:, :320], 60, constant_values=220)
    assert search_checkerboard([whole, cv2.GaussianBlur(shorter, (0, 0), 1.0)]) is None  # another board


@pytest.mark.sweep(1)
@pytest.mark.parametrize("family", ["cctag3", "cctag4"])
def test_concentric_tags_are_recognised_by_the_codes_that_photographs_share(
    family: str, tmp_path: Path
) -> None:
    """By their rings where these are resolved; the two families have other widths."""
    rng, numbers = seed_of(f"trial {family}"), (3, 10, 17, 24, 31)
    for k in range(2):
        picture = np.full((400, 600), PAPER, dtype=np.uint8)
        for place, number in enumerate(numbers):
            tag = draw_tag(
                concentric_family(family), number, 45.0, tilt_deg=20.0, blur=0.8, noise=1.0, rng=rng
            )
            row, column = divmod(place, 3)
            side = tag.image.shape[0]
            picture[200 * row : 200 * row + side, 200 * column : 200 * column + side] = tag.image
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture)
    trial = try_targets(sorted(tmp_path.iterdir()))
    assert (trial.codes, trial.polarity) == (family, "dark")
    assert sorted(map(int, trial.repeated)) == list(numbers)


def test_a_plate_that_looks_alike_when_turned_is_not_used_beside_another() -> None:
    marks = ((3, 3), (3, 5), (4, 7), (5, 4))
    dots, board = PlateFamily("grid", 9, 11, marks), PlateFamily("checkerboard", 7, 10)
    assert _side_by_side((board, dots)) == ((board, dots), ())
    for alike in (PlateFamily("checkerboard", 7, 9), PlateFamily("grid", 9, 11)):
        assert alike.is_ambiguous
        one, other = (alike, dots) if alike.name == "checkerboard" else (board, alike)
        used, left_out = _side_by_side((one, other))
        assert used == ((dots,) if alike is one else (board,))
        assert [plate for plate, _ in left_out] == [alike]
