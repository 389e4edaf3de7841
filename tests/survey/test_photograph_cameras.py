"""Photographs that do not fit: zoomed ones get per-photograph cameras, strange ones are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.camera import project, tangents_from_pixel
from sfm.distortion.models import Role
from sfm.network import Estimate, Network
from sfm.orientation.resection.ransac import resect_robust
from sfm.pipeline import run_survey
from sfm.remarks.remark import of_kind
from sfm.report.findings.survey_remarks import findings_of
from sfm.survey.correspondences import restore_strayed
from sfm.survey.diagnosis.photograph_cameras import SCALES, TOLERANCE
from sfm.survey.inputs.settings import AdjustSettings
from tests.survey.faults import planted
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of

TAU = AdjustSettings(reject="tau")


def with_zoom(name: str, factors: dict[int, float], *, images: int = 10) -> tuple[Network, Estimate]:
    """Return a network of which some photographs were taken with another c."""
    network, truth = make_network(seed_of(name), images=images, points=60, free=("c",))
    seen, rng = network.image_points, seed_of(f"{name} noise")
    xy = seen.xy.copy()
    for i, factor in factors.items():
        p = truth.cameras[0].parameters.copy()
        p[0] *= factor
        rows = np.flatnonzero(seen.image == i)
        camera = truth.cameras[0].with_parameters(p)
        xy[rows] = project(camera, truth.position[i], truth.rotation[i], truth.points[seen.point[rows]])
        xy[rows] += 0.1 * rng.standard_normal((len(rows), 2))
    return replace(network, image_points=replace(seen, xy=xy)), truth


@pytest.mark.parametrize("factor", [pytest.param(0.95, marks=pytest.mark.slow), 0.98, 1.1])
def test_a_zoomed_photograph_gets_its_own_c(factor: float) -> None:
    network, truth = with_zoom(f"zoomed {factor}", {7: factor})
    result = run_survey(survey_of(network, truth, adjust=TAU))
    a = result.adjustment
    assert result.failed == () and a.rejected.sum() <= 3
    # the other photographs' precision, as if the zoom were known
    assert a.sigma0_px == pytest.approx(0.1, rel=0.1)
    own = {camera.name: camera for camera in a.estimate.cameras}
    assert own["synthetic image 8"].value("c") == pytest.approx(factor * 10.0, rel=2e-3)
    assert own["synthetic"].value("c") == pytest.approx(10.0, rel=2e-3)
    (found,) = of_kind(result.remarks, "camera_per_photograph")
    assert found.names("photograph") == ("image 8",) and found.names("parameters")[0] == "c"
    assert found.number("change") == pytest.approx(100 * (factor - 1), abs=0.3)
    assert findings_of(result).verdict.level == "fair"


@pytest.mark.parametrize(("share", "left_out"), [(0.65, True), (0.4, False)])
def test_a_photograph_of_another_state_is_left_out(share: float, left_out: bool) -> None:
    """The larger part of the points lies elsewhere in one photograph: no c explains that."""
    network, truth = with_zoom("moved", {})
    seen, rng = network.image_points, seed_of("moved elsewhere")
    rows = np.flatnonzero(seen.image == 4)
    moved = rows[rng.permutation(len(rows))[: int(share * len(rows))]]
    xy = seen.xy.copy()
    xy[moved] += rng.uniform(10, 40, (len(moved), 2))
    network = replace(network, image_points=replace(seen, xy=xy))
    result = run_survey(survey_of(network, truth, adjust=TAU))
    assert [one.image for one in result.failed] == (["image 5"] if left_out else [])
    kinds = ("photograph_not_explained", "photograph_contradicting")
    assert all(one.reason.kind in kinds for one in result.failed)
    assert not of_kind(result.remarks, "camera_per_photograph")
    assert result.adjustment.sigma0_px == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("number", [215, 219])
def test_a_photograph_with_the_names_of_other_points_is_left_out(number: int) -> None:
    """A per-photograph camera left residuals of 200 px, and was believed; c was -106 %."""
    one = planted("names shifted", number)
    camera = one.start.cameras[0]
    free = tuple(name for name, on in zip(camera.names, camera.free, strict=True) if on)
    result = run_survey(survey_of(one.network, one.start, free=free, adjust=TAU))
    assert len(result.failed) == 1 and result.adjustment.sigma0_px == pytest.approx(0.1, rel=0.1)
    assert result.failed[0].reason.kind in ("photograph_not_explained", "photograph_with_few_fitting")
    assert not of_kind(result.remarks, "camera_per_photograph")


@pytest.mark.parametrize(
    ("kind", "cause"),
    [
        pytest.param("held b1", "held_parameter", marks=pytest.mark.slow),
        ("autofocus", "camera_varies"),
    ],
)
def test_what_all_photographs_share_is_no_camera_of_one(kind: str, cause: str) -> None:
    """A photograph lost points, and another c explained them; what explains all photographs is likelier."""
    one = planted(kind, {"held b1": 7002, "autofocus": 7013}[kind])
    camera = one.start.cameras[0]
    free = tuple(name for name, on in zip(camera.names, camera.free, strict=True) if on)
    result = run_survey(survey_of(one.network, one.start, free=free, adjust=TAU))
    assert len(result.adjustment.estimate.cameras) == 1
    assert not of_kind(result.remarks, "camera_per_photograph")
    assert of_kind(result.remarks, cause)


def test_the_tolerance_is_that_of_half_a_step_of_c() -> None:
    largest = []
    for name in ("first", "second", "third"):
        network, truth = make_network(seed_of(f"tolerance {name}"), images=8, points=60)
        seen, camera = network.image_points, truth.cameras[0]
        assert SCALES[1] / SCALES[0] == pytest.approx(1.05, abs=1e-3)
        wrong = camera.with_parameters(np.where(camera.plays(Role.FOCAL), 1.025, 1.0) * camera.parameters)
        for i in range(8):
            rows = np.flatnonzero(seen.image == i)
            uv = tangents_from_pixel(wrong, seen.xy[rows])
            found = resect_robust(uv, truth.points[seen.point[rows]], tolerance=1.0)
            lengths = np.linalg.norm(found.residuals, axis=1) * wrong.c_px
            largest.append(float(lengths.max()) / max(camera.size_px))
    assert TOLERANCE / 2 < max(largest) < TOLERANCE


def test_photographs_that_fit_keep_their_camera() -> None:
    network, truth = with_zoom("fits", {})
    result = run_survey(survey_of(network, truth, adjust=TAU))
    assert len(result.adjustment.estimate.cameras) == 1 and result.failed == ()
    assert not of_kind(result.remarks, "camera_per_photograph")


def test_a_photograph_that_the_adjustment_loses_stays_where_it_was() -> None:
    """A zoom of 3 % was moved out of sight of its points, or 1e140 mm away, and left out without a reason."""
    network, truth = make_network(seed_of("out of sight"), images=4, points=12)
    adjusted = adjust(network, truth, datum=Datum("free"), reject="none")
    for off in (np.nan, 7000.0):
        residuals = adjusted.residuals.copy()
        residuals[network.image_points.image == 2] = off
        lost, all_of_them = replace(adjusted, residuals=residuals), np.ones(12, dtype=bool)
        kept = restore_strayed(truth, lost, all_of_them[:4], all_of_them, tolerance_px=2.0)
        assert np.array_equal(kept.position[2], truth.position[2])
        assert np.array_equal(kept.position[[0, 1, 3]], adjusted.estimate.position[[0, 1, 3]])
        assert kept.oriented.all()
