"""Entries of the protocol against what they are computed from in another way."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.correlations import orientation_correlations
from sfm.adjustment.solve import adjust
from sfm.model.camera import project
from sfm.model.conventions import FloatArray
from sfm.model.estimate import Estimate
from sfm.model.network import Network
from sfm.pipeline import run_survey
from sfm.report.findings import Findings
from sfm.report.phrases import fixed
from sfm.report.survey_report import text_report
from sfm.report.tables.csv_files import write_tables
from sfm.survey.inputs.given_values import KnownPoints
from tests.findings import findings_of
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of
from tests.tables import rows_of


@pytest.fixture(scope="module")
def found() -> Findings:
    """Eight photographs with control, two gross errors and a lens of known distortion."""
    rng = seed_of("protocol")
    network, truth = make_network(rng, images=8, points=30)
    xy = network.image_points.xy.copy()
    xy[[5, 40]] += (20.0, -15.0)
    network = replace(network, image_points=replace(network.image_points, xy=xy))
    noisy = truth.points[:5] + 1e-4 * rng.standard_normal((5, 3))
    control = KnownPoints.from_arrays([str(k + 1) for k in range(5)], noisy, 1e-4)
    free = ("c", "x0", "y0", "K1", "K2")
    given = {"control": control, "datum": {"kind": "control"}, "adjust": {"reject": "tau"}}
    survey = survey_of(network, truth, free=free, **given)
    return findings_of(run_survey(survey))


def test_residuals_by_photograph_and_point_are_those_of_the_image_points(found: Findings) -> None:
    a = found.result.adjustment
    one = next(row for row in found.protocol.residuals if row[1] == "image 3")
    own = (a.network.image_points.image == a.network.image_index("image 3")) & ~a.rejected
    v = a.residuals[own]
    np.testing.assert_allclose(one[4:6], np.sqrt((v**2).mean(axis=0)))
    np.testing.assert_allclose(one[6:8], np.abs(v).max(axis=0))
    assert sum(row[3] for row in found.protocol.residuals) == 2 * a.rejected.sum()


def test_rejected_rays_stand_in_the_text_report(found: Findings) -> None:
    a, text = found.result.adjustment, text_report(found)
    seen = a.network.image_points
    for k in np.flatnonzero(a.rejected)[:3]:
        assert re.search(rf"\n  {a.network.images[seen.image[k]]} +{a.network.points[seen.point[k]]} ", text)
    assert "where |tau| exceeds" in " ".join(text.split())


def test_the_text_report_has_correlations_and_names_the_tables(found: Findings, tmp_path: Path) -> None:
    text = " ".join(text_report(found).split())
    write_tables(found, tmp_path)
    listed = re.search(r"Tables \(\.csv\): ([^.]*)\.", text)
    assert listed and sorted(listed[1].split(", ")) == sorted(one.stem for one in tmp_path.glob("*.csv"))
    assert "one standard deviation, a posteriori" in text
    s = found.statistics
    within = [pair for pair in s.correlations if pair not in s.camera_correlations]
    assert within and f"{100 * within[0].value:+.1f}" in text


def test_control_has_its_standard_deviation_before_and_after(found: Findings) -> None:
    rows = found.protocol.control
    assert len(rows) == 15 and {row.use for row in rows} == {"control"}
    assert all(row.prior == pytest.approx(1e-4) and row.posterior < row.prior for row in rows)


def test_check_points_have_difference_and_test() -> None:
    rng = seed_of("protocol check")
    network, truth = make_network(rng, images=8, points=30)
    noisy = truth.points[:5] + 1e-4 * rng.standard_normal((5, 3))
    control = KnownPoints.from_arrays([str(k + 1) for k in range(5)], noisy, 1e-4)
    rows = findings_of(run_survey(survey_of(network, truth, control=control))).protocol.control
    assert len(rows) == 15 and {row.use for row in rows} == {"check"}
    assert all(abs(row.test) < 5 for row in rows)
    assert all(row.adjusted - row.given == pytest.approx(row.difference) for row in rows)


def test_the_field_of_view_and_the_distortion_are_those_of_the_lens(found: Findings) -> None:
    (lens,) = found.protocol.lenses
    # 10 mm by 7.5 mm at c = 10 mm, 32 px of distortion in the corners
    assert lens.field_of_view_deg[0] == pytest.approx(53.1, abs=2.0)
    assert 10 < lens.largest_px < 60


def test_radial_parameters_are_tested_together() -> None:
    network, truth = make_network(seed_of("cumulative"), images=8, points=40)
    found = adjust(network, truth, datum=Datum("free"))
    from sfm.report.protocol import _cumulative

    tests = {one.parameters: one for one in _cumulative(found)}
    assert set(tests) == {"K1, K2", "K2"}
    assert tests["K1, K2"].probability < 1e-6


def test_the_files_hold_all_covariances(found: Findings, tmp_path: Path) -> None:
    write_tables(found, tmp_path)
    a = found.result.adjustment
    with np.load(tmp_path / "covariances.npz") as stored:
        np.testing.assert_array_equal(stored["points"], a.covariance.points)
        np.testing.assert_array_equal(stored["interior_0"], a.covariance.interior[0])
    rows = rows_of(tmp_path / "point_covariances.csv")
    assert float(rows[2]["X_Z"]) == a.covariance.points[2, 0, 2]
    pairs = rows_of(tmp_path / "interior_correlations.csv")
    assert len(pairs) == 10 and all(-1 <= float(pair["correlation"]) <= 1 for pair in pairs)


def test_correlations_with_every_photograph_are_a_table(found: Findings, tmp_path: Path) -> None:
    write_tables(found, tmp_path)
    rows = rows_of(tmp_path / "exterior_correlations.csv")
    a = found.result.adjustment
    assert len(rows) == 5 * 8 and {row["camera"] for row in rows} == {"synthetic"}
    assert [row["image"] for row in rows[:8]] == list(a.network.images)
    size = max(abs(float(row[part])) for row in rows for part in ("X0", "Y0", "Z0", "omega", "phi", "kappa"))
    (strongest, *_) = orientation_correlations(a, limit=0.0)
    assert size == pytest.approx(abs(strongest.largest), rel=1e-9) and size < 1


def test_the_first_and_the_last_error_are_reported() -> None:
    """Points 5 mm off at the start, some 10 px in the photographs of 0.1 px."""
    rng = seed_of("first error")
    network, truth = make_network(rng, images=8, points=30, free=())
    start = replace(truth, points=truth.points + 5e-3 * rng.standard_normal(truth.points.shape))
    a = adjust(network, start, datum=Datum("free"), reject="none")
    v = residuals_of(network, start) / 0.1
    assert a.start_sigma0 == pytest.approx(np.sqrt((v**2).sum() / a.redundancy), rel=1e-9)
    assert a.start_sigma0 > 20 * a.sigma0
    found = findings_of(run_survey(survey_of(network, truth, free=(), start=start)))
    a = found.result.adjustment
    assert a.start_sigma0 >= a.sigma0 * (1 - 1e-12)  # after the orientation
    assert "at the start of the adjustment" in text_report(found)


def residuals_of(network: Network, estimate: Estimate) -> FloatArray:
    seen = network.image_points
    xy = [
        project(estimate.cameras[0], estimate.position[i], estimate.rotation[i], estimate.points[[j]])[0]
        for i, j in zip(seen.image, seen.point, strict=True)
    ]
    return np.array(xy) - seen.xy


def test_a_number_that_is_not_known_is_not_written() -> None:
    written = [fixed(value, 1) for value in (2.04, -0.01, float("nan"), float("inf"))]
    assert written == ["2.0", "0.0", "not known", "not known"]
