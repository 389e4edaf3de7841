"""AICON's form of a camera, with R0: what it means, and that it comes back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.adjustment.result import Adjustment
from sfm.model.camera import camera_from_values, pixel_from_tangents
from sfm.model.distortion.brown import BALANCED, brown_by_balanced, from_balanced, to_balanced
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.pipeline import run_survey
from sfm.report.tables.csv_files import write_tables
from sfm.survey.inputs.survey import CameraSetup, Survey
from tests.findings import findings_of
from tests.surveys import survey_of
from tests.synthetic import make_network, seed_of
from tests.tables import rows_of

SIZE_PX, PIXEL_MM = (6000, 4000), (0.006, 0.006)
# a 24 mm lens on 36 x 24 mm with 2 % of distortion in the corners
AICON = (
    *(("c", 24.3871), ("x0", 0.1134), ("y0", -0.0821), ("A1", -1.1e-4), ("A2", 1.6e-7), ("A3", -4e-11)),
    *(("R0", 14.4), ("B1", 1.2e-5), ("B2", -7e-6), ("C1", 1.3e-4), ("C2", -6e-5)),
)


def test_the_balanced_polynomial_is_that_of_the_book() -> None:
    """Image coordinates written out with A1 (r2 - R0^2), not by way of K1."""
    camera = camera_from_values(
        "a", "brown_forward", SIZE_PX, PIXEL_MM, c_mm=1.0, values=from_balanced(AICON)
    )
    p = dict(AICON)
    rng = seed_of("balanced")
    uv = rng.uniform((-0.7, -0.45), (0.7, 0.45), (50, 2))
    X, Y = (p["c"] * uv).T
    r2, R2 = X**2 + Y**2, p["R0"] ** 2
    radial = p["A1"] * (r2 - R2) + p["A2"] * (r2**2 - R2**2) + p["A3"] * (r2**3 - R2**3)
    x = (
        p["x0"]
        + X * (1 + radial)
        + p["B1"] * (r2 + 2 * X**2)
        + 2 * p["B2"] * X * Y
        + p["C1"] * X
        + p["C2"] * Y
    )
    y = p["y0"] + Y * (1 + radial) + p["B2"] * (r2 + 2 * Y**2) + 2 * p["B1"] * X * Y
    expected = np.stack([x / 0.006 + 2999.5, 1999.5 - y / 0.006], axis=1)
    np.testing.assert_allclose(pixel_from_tangents(camera, uv), expected, atol=1e-8)


def test_it_comes_back_with_c_and_all_coefficients() -> None:
    there = from_balanced(AICON)
    again = to_balanced(there, 14.4)
    assert tuple(name for name, _ in again) == BALANCED
    np.testing.assert_allclose([v for _, v in again], [v for _, v in AICON], rtol=1e-13)
    other = to_balanced(there, 9.0)  # another R0: another c, the same camera
    assert dict(other)["c"] != pytest.approx(24.3871, rel=1e-4)
    np.testing.assert_allclose([v for _, v in from_balanced(other)], [v for _, v in there], rtol=1e-13)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((("c", 24.0), ("A1", 0.01), ("R0", 14.4)), "a scale of -1.07"),
        ((("K4", 1e-9),), "A1, A2 and A3 only"),
    ],
)
def test_what_has_no_such_form_is_refused(values: tuple[tuple[str, float], ...], message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        if values[0][0] == "c":
            from_balanced(values)
        else:
            to_balanced(values, 10.0)


def _survey(balanced: tuple[tuple[str, float], ...], **settings: object) -> Survey:
    network, truth = make_network(seed_of("balanced survey"), images=6, points=20, model="brown_forward")
    plain = survey_of(network, truth, free=())
    one = plain.cameras[0]
    given = {"size_px": one.size_px, "pixel_mm": one.pixel_mm, "model": "brown_forward", **settings}
    cameras = (CameraSetup(name="synthetic", balanced=balanced, **given),)
    return Survey(name="balanced", cameras=cameras, observations=plain.observations)


def test_a_survey_takes_and_gives_it(tmp_path: Path) -> None:
    """Held at AICON's values the tables give the same again; free, those adjusted, with the same R0."""
    _, truth = make_network(seed_of("balanced survey"), images=6, points=20, model="brown_forward")
    camera = truth.cameras[0]
    given = to_balanced(tuple(zip(camera.names, camera.parameters.tolist(), strict=True)), 4.0)
    negative = (("c", -given[0][1]), *given[1:])  # as AICON writes it
    for free in ((), ("c", "K1")):
        result = run_survey(_survey(negative, free=free))
        assert result.adjustment.converged and result.adjustment.sigma0_px == pytest.approx(0.1, rel=0.2)
        write_tables(findings_of(result), tmp_path)
        table = rows_of(tmp_path / "cameras_balanced.csv")
        rows = [(row["parameter"], float(row["value"])) for row in table]
        sigma = {row["parameter"]: row["sigma"] for row in table}
        if free:
            assert dict(rows)["R0"] == 4.0 and dict(rows)["c"] == pytest.approx(negative[0][1], rel=1e-3)
            assert not sigma["R0"] and not sigma["x0"]
            assert float(sigma["c"]) > 0 and float(sigma["A1"]) > 0
            np.testing.assert_allclose(float(sigma["c"]), sampled_sigma(result.adjustment, 4.0), rtol=0.05)
        else:
            np.testing.assert_allclose([v for _, v in rows], [v for _, v in negative], rtol=1e-12)
            assert set(sigma.values()) == {""}


def sampled_sigma(a: Adjustment, R0: float) -> float:
    """Return the standard deviation of the balanced c, from sampled parameters."""
    (camera,) = a.estimate.cameras
    rng, own = seed_of("sampled"), camera.parameters[camera.free]
    found = []
    for values in rng.multivariate_normal(own, a.covariance.interior[0], 4000):
        drawn = camera.parameters.copy()
        drawn[camera.free] = values
        found.append(to_balanced(tuple(zip(camera.names, drawn.tolist(), strict=True)), R0)[0][1])
    return float(np.std(found))


def test_derivatives_of_the_balanced_form_are_those_of_its_formulas() -> None:
    sizes = (10.0, 0.1, -0.1, 1e-4, -1e-6, 1e-9, 4.0, 1e-4, -1e-4, 2e-4, 1e-4)
    values = tuple(zip(BALANCED, sizes, strict=True))
    J = brown_by_balanced(values)
    varied = [k for k, name in enumerate(BALANCED) if name != "R0"]
    for column, k in enumerate(varied):
        step = 1e-4 * abs(sizes[k])
        ends = []
        for sign in (1, -1):
            moved = tuple((n, v + sign * step * (i == k)) for i, (n, v) in enumerate(values))
            ends.append(np.array([v for _, v in from_balanced(moved)]))
        numeric = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(J[:, column], numeric, rtol=1e-6, atol=1e-9 * np.abs(numeric).max())


@pytest.mark.parametrize(
    ("balanced", "settings", "message"),
    [
        ((("c", 10.0),), {"free": ()}, r"balanced\.R0 is missing"),
        ((("c", 10.0), ("R0", 4.0), ("K1", 1.0)), {"free": ()}, "balanced has no parameter 'K1'"),
        ((("c", 0.0), ("R0", 4.0)), {"free": ()}, "expected c other than 0"),
        ((("c", 10.0), ("R0", 4.0)), {"free": (), "c_mm": 10.0}, "balanced and c_mm are given"),
        ((("c", 10.0), ("R0", 4.0)), {"free": (), "model": "brown"}, "expected brown_forward"),
        ((("c", 10.0), ("R0", 40.0), ("A1", 1.0)), {"free": ()}, "a scale of -1599"),
    ],
)
def test_contradicting_settings_are_refused(
    balanced: tuple[tuple[str, float], ...], settings: dict[str, object], message: str
) -> None:
    with pytest.raises(SurveyFileError, match=message):
        _survey(balanced, **settings)
