"""Rays, intersection angles, coverage and residuals of points: cases solved by hand, and DBAT's report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.photomodeler import read_photomodeler
from sfm.adjustment.datum import Datum
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.survey_result import SurveyResult
from sfm.model.network import ObjectPoints
from sfm.orientation.image_rays import ray_angles
from sfm.report.network_geometry import Geometry, geometry_of, hull_area
from sfm.report.pages import WIDTH, html_of
from sfm.report.survey_quality import MAX_BINS, points_by_rays
from sfm.report.survey_report import text_report
from sfm.report.tables.csv_files import write_tables
from sfm.report.tables.summary import summary
from sfm.survey.inputs.given_values import read_exterior, read_points
from tests.findings import findings_of
from tests.places import SHARED
from tests.synthetic import SIZE_PX, make_network, seed_of
from tests.tables import rows_of

CAMCAL = SHARED / "data" / "camcal"


def adjusted(name: str, **options: float) -> Adjustment:
    network, truth = make_network(seed_of(name), images=6, points=20, free=(), **options)  # type: ignore[arg-type]
    return adjust(network, truth, datum=Datum("free"), reject="none")


def result_of(a: Adjustment) -> SurveyResult:
    return SurveyResult(
        "geometry", "m", len(a.network.images), (), a, np.full(len(a.network.points), -1), None
    )


@pytest.mark.skipif(not CAMCAL.is_dir(), reason="needs ../shared/data/camcal")
def test_camcal_has_the_geometry_that_dbat_reports() -> None:
    network, start = read_photomodeler(CAMCAL / "camcal-pmexport.txt", control=CAMCAL / "camcal-fixed.txt")
    start = replace(start, cameras=tuple(replace(one, model="brown_dbat") for one in start.cameras))
    a = adjust(network, start, datum=Datum("control"), reject="none")
    found, names = geometry_of(a), a.network.points
    control = np.isin(np.arange(len(names)), network.control.point)
    assert found.histogram() == ((16, 1), (17, 1), (18, 2), (19, 3), (20, 5), (21, 88))
    assert round(float(found.rays[~control].mean()), 1) == 20.7
    angle = found.angle_deg
    assert [names[j] for j in np.argsort(angle)[:3]] == ["90", "8", "92"]
    assert np.round(np.sort(angle)[:3], 2).tolist() == [79.61, 81.00, 81.15]
    assert round(float(angle[~control].mean()), 1) == 86.5
    assert np.round([angle[control].min(), angle[control].max()], 1).tolist() == [83.4, 85.8]
    (camera,) = found.coverage
    hull = 100 * np.array([camera.hull.min(), camera.hull.max(), camera.hull.mean(), camera.hull_of_all])
    assert np.round(hull).tolist() == [31, 62, 46, 87]
    point, image = np.sqrt(2) * found.point_rms_px, np.sqrt(2) * found.image_rms_px  # DBAT's are of vectors
    assert (names[int(point.argmin())], names[int(point.argmax())]) == ("65", "1004")
    assert np.round([point.min(), point.max()], 3).tolist() == [0.095, 0.553]
    assert (int(image.argmin()) + 1, int(image.argmax()) + 1) == (4, 11)
    assert np.round([image.min(), image.max()], 3).tolist() == [0.153, 0.281]


def test_angles_by_hand() -> None:
    a = adjusted("angles")
    position, points = a.estimate.position.copy(), a.estimate.points.copy()
    points[0] = 0.0
    position[0], position[1] = [1, 0, 0], [0, 2, 0]  # at right angles
    position[2] = [-3, 0, 0]  # head on to the first
    seen = a.network.image_points

    def angle_seen_by(*images: int) -> float:
        rejected = (seen.point == 0) & ~np.isin(seen.image, images)
        estimate = replace(a.estimate, position=position, points=points)
        return float(ray_angles(a.network, estimate, ~rejected)[0])

    assert angle_seen_by(0, 1) == pytest.approx(90)
    assert angle_seen_by(0, 2) == pytest.approx(0, abs=1e-6)
    assert angle_seen_by(0, 1, 2) == pytest.approx(90)
    assert np.isnan(angle_seen_by(0))


@pytest.mark.parametrize(
    ("points", "area"),
    [
        ([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5]], 1.0),
        ([[0, 0], [0.5, 0], [0, 0.5]], 0.125),
        ([[0, 0], [1, 1], [2, 2], [3, 3]], 0.0),
        ([[0, 0], [0, 0], [0, 0]], 0.0),
        ([[0, 0], [1, 1]], 0.0),
    ],
)
def test_area_of_a_convex_hull(points: list[list[float]], area: float) -> None:
    assert hull_area(np.array(points, dtype=float)) == pytest.approx(area)


def test_rejected_image_points_do_not_count() -> None:
    a = adjusted("rejected")
    rejected = a.network.image_points.point == 3
    rejected[np.flatnonzero(rejected)[:2]] = False
    before, after = geometry_of(a), geometry_of(replace(a, rejected=rejected))
    assert (before.rays[3], after.rays[3]) == (6, 2)
    v = a.residuals[(a.network.image_points.point == 3) & ~rejected]
    assert after.point_rms_px[3] == pytest.approx(float(np.sqrt((v**2).mean())))
    keep = np.arange(20) != 3
    np.testing.assert_array_equal(before.angle_deg[keep], after.angle_deg[keep])


def test_coverage_is_that_of_the_whole_photograph() -> None:
    a = adjusted("coverage")
    seen = a.network.image_points
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (np.array(SIZE_PX) - 1)
    xy = seen.xy.copy()
    xy[np.flatnonzero(seen.image == 2)[:4]] = corners
    found = geometry_of(replace(a, network=replace(a.network, image_points=replace(seen, xy=xy))))
    whole = float(np.prod((np.array(SIZE_PX) - 1) / np.array(SIZE_PX)))
    assert found.hull[2] == pytest.approx(whole)
    assert found.coverage[0].hull_of_all == pytest.approx(whole)
    assert found.coverage[0].radius[2] == pytest.approx(1, abs=1e-3)
    assert (np.delete(found.hull, 2) < 0.9).all()


def test_points_with_one_ray_each_have_no_angle() -> None:
    network, truth = make_network(seed_of("one ray each"), images=2, points=20, free=())
    control = ObjectPoints(np.arange(20), truth.points, np.zeros((20, 3, 3)))
    seen = network.image_points
    network = replace(network, image_points=seen.select(seen.point % 2 == seen.image)).with_given(control)
    result = result_of(adjust(network, truth, datum=Datum("control"), reject="none"))
    assert np.isnan(geometry_of(result.adjustment).angle_deg).all()
    assert "intersection angle  not known\n" in text_report(findings_of(result))
    assert summary(findings_of(result))["geometry"]["intersection_angle_deg"]["max"] is None
    assert "not known" in html_of(findings_of(result))


def test_many_numbers_of_rays_are_reported_in_ranges() -> None:
    rays = np.repeat(np.arange(2, 60), np.arange(2, 60))
    none = np.zeros(0)
    found = Geometry(rays, none, none, none, none, (), rays)
    bins = points_by_rays(found)
    assert len(bins) <= MAX_BINS
    assert sum(n for _, n in bins) == len(rays)
    assert bins[0] == ("2-6", 2 + 3 + 4 + 5 + 6)


def test_weak_points_are_named_and_all_reports_agree(tmp_path: Path) -> None:
    a = adjusted("weak")
    points = a.estimate.points.copy()
    points[4] = [0, 0, 500.0]  # so far away that its rays are nearly parallel
    result = result_of(replace(a, estimate=replace(a.estimate, points=points)))
    found = geometry_of(result.adjustment)
    assert [a.network.points[j] for j in found.weak] == ["5"]
    text, page, told = (
        text_report(findings_of(result)),
        html_of(findings_of(result)),
        summary(findings_of(result))["geometry"],
    )
    words = f"below 10 deg: 1 point: 5 ({found.angle_deg[4]:.1f})"
    assert words in " ".join(text.split()) and words in page
    assert all(len(line) <= WIDTH for line in text.splitlines())
    assert told["weak_points"] == ["5"]
    assert told["points_by_rays"] == {"6": 20}
    assert told["point_rms_px"]["max"] == pytest.approx(float(found.point_rms_px.max()))
    write_tables(findings_of(result), tmp_path)
    rows = rows_of(tmp_path / "points.csv")
    assert [float(row["angle_deg"]) for row in rows] == found.angle_deg.tolist()
    assert [float(row["rms_px"]) for row in rows] == found.point_rms_px.tolist()
    assert [float(row["coverage"]) for row in rows_of(tmp_path / "images.csv")] == found.hull.tolist()
    assert len(read_points(tmp_path / "points.csv").names) == 20  # welcome as [approximate]
    assert len(read_exterior(tmp_path / "images.csv").names) == 6
