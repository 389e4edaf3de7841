"""Photographs of plates and boards in a folder, and nothing else: found, and the camera as it truly is.

Image points are as good as stated, by their truth. The adjustment alone is that of OpenCV.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.camera import camera_from_values, project
from sfm.conventions import FloatArray
from sfm.network import ObjectPoints, rows_of
from sfm.pipeline import run_survey
from sfm.report.findings.survey_remarks import findings_of
from sfm.survey.drafting.draft import draft_survey
from sfm.survey.inputs.calibration import plate_family
from sfm.survey.inputs.survey import read_survey
from sfm.targets.codes.plates import TAGGED, PlateFamily
from tests.plates import GRID, PITCH, PIXEL_MM, TRUTH, camera, plate_pictures, stations
from tests.synthetic import seed_of

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


QUICK = ("grid with marks 1.08 times larger", "hexagonal", "checkerboard, even", "AprilGrid")


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
        control=ObjectPoints(np.arange(len(X)), X.astype(float), np.zeros((len(X), 3, 3))),
    )
    estimate = replace(found.estimate, cameras=(start,), points=X.astype(float))
    mine = adjust(network, estimate, datum=Datum("control"), reject="none")
    values = np.array([mine.estimate.cameras[0].value(name) for name in free])
    theirs = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *distortion.ravel()[:4]])
    sigma = mine.interior_sigma(0)[[start.names.index(name) for name in free]]
    assert np.sqrt((mine.residuals**2).sum() / len(xy)) == pytest.approx(rms, rel=1e-4)
    return np.abs(values - theirs) / sigma
