"""What a survey says of its cameras: sensor sizes, start values of c, long lenses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import sfm
from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.other_solutions import scale_estimate
from sfm.adjustment.solve import AdjustmentOptions, adjust
from sfm.model.camera import camera_from_values
from sfm.model.errors import SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.remarks.remark import of_kind
from sfm.model.similarity import reverse_depth
from sfm.pipeline import run_survey
from sfm.survey.adjusting.settling import held_to_converge, nearer_start
from sfm.survey.adjusting.solution_remarks import remarks_on_pixel_sides, remarks_on_principal_distances
from sfm.survey.inputs.survey import CameraSetup
from tests.findings import findings_of
from tests.survey.weak_networks import _measured, _stations
from tests.surveys import survey_of
from tests.synthetic import PIXEL_MM, SIZE_PX, make_network, seed_of


def test_all_that_is_missing_of_all_cameras_is_said_before_anything_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a1", "a2", "b1", "b2"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((40, 60), 200, dtype=np.uint8))
    monkeypatch.setattr("sfm.pipeline.measure_sources", lambda *a, **k: pytest.fail("measured"))
    cameras = [
        CameraSetup(name="a", images="a*.png"),
        CameraSetup(name="b", images="b*.png", sensor_mm=(36, 24)),
    ]
    survey = sfm.Survey(name="s", cameras=cameras, folder=tmp_path)
    with pytest.raises(
        SurveyFileError,
        match=r"values that are needed: camera a: pixel_mm or sensor_mm and c_mm; camera b: c_mm$",
    ):
        sfm.run_survey(survey, compare_with="none")


@pytest.mark.parametrize(
    ("settings", "pixel", "free", "told"),
    [
        ({"sensor_mm": (23.7, 15.6)}, (23.7 / 6000, 15.6 / 4000), ("c",), True),
        ({"sensor_mm": (23.7, 15.6)}, (23.7 / 6000, 15.6 / 4000), ("c", "b1"), False),
        ({"sensor_mm": (23.5, 15.6)}, (23.5 / 6000, 15.6 / 4000), ("c",), False),
        ({}, (0.0040, 0.0041), ("c",), True),
        ({"pixel_mm": (0.0040, 0.0041)}, (0.0040, 0.0041), ("c",), False),  # stated: as on a line scanner
    ],
)
def test_nominal_sensor_sizes_that_make_odd_pixels_are_reported(
    settings: dict[str, tuple[float, float]], pixel: tuple[float, float], free: tuple[str, ...], told: bool
) -> None:
    camera = CameraSetup(name="a", images="*.png", free=free, **settings)
    remarks = remarks_on_pixel_sides([camera], [camera_from_values("a", "brown", (60, 40), pixel, c_mm=50.0)])
    assert [one.kind for one in remarks] == (["pixels_not_square"] if told else [])


@pytest.mark.parametrize("model", ["brown", "opencv"])
def test_c_far_from_its_start_value_is_reported(model: str) -> None:
    _, truth = make_network(seed_of("far c"), images=3, points=12, model=model)
    name = replace(truth.cameras[0], name="synthetic")
    estimate = replace(truth, cameras=(name,))
    network, brown = make_network(seed_of("far c"), images=3, points=12)
    survey = survey_of(network, brown)  # says c_mm = 10
    assert remarks_on_principal_distances(survey, estimate, [0.01]) == ()
    p = name.parameters.copy()
    p[: 1 if name.in_mm else 2] *= 0.22
    for factor, told in ((0.85, False), (1.15, False), (0.75, True), (1.35, True)):
        near = name.with_parameters(np.where(name.parts[0], factor * name.parameters, name.parameters))
        remarks = remarks_on_principal_distances(survey, replace(estimate, cameras=(near,)), [0.01])
        assert len(remarks) == told
    far = replace(estimate, cameras=(name.with_parameters(p),))
    c = abs(far.cameras[0].parameters[0])
    for share, severity in ((4.9e-4, "note"), (5.1e-4, "warning"), (np.nan, "warning")):
        (one,) = remarks_on_principal_distances(survey, far, [share * c])
        assert one.severity == severity
    assert one.kind == "c_far_from_given" and one.names("camera") == ("synthetic",)
    assert [one.number(name) for name in ("given", "found", "change")] == pytest.approx([10, 2.2, -78])
    held = replace(estimate, cameras=(replace(far.cameras[0], free=name.free & False),))
    (one,) = remarks_on_principal_distances(survey, held, [0.01])
    assert one.kind == "c_held_elsewhere" and one.severity == "error"
    assert [one.number(name) for name in ("given", "found")] == pytest.approx([10, 2.2])


def test_a_wrong_start_value_of_c_is_a_note_where_the_network_determines_c() -> None:
    network, truth = make_network(seed_of("wrongly given"), images=8, points=40)
    camera = truth.cameras[0]
    p = camera.parameters.copy()
    p[0] *= 1.4
    free = ("c", "x0", "y0", "K1", "K2", "P1", "P2")
    wrong = replace(truth, cameras=(camera.with_parameters(p),))
    result = run_survey(survey_of(network, wrong, free=free, start=truth))
    assert result.estimate.cameras[0].value("c") == pytest.approx(10.0, rel=1e-2)
    (far,) = of_kind(result.remarks, "c_far_from_given")
    assert far.number("given") == pytest.approx(14) and far.number("change") < -20
    assert far.severity == "note" and findings_of(result).verdict.level == "good"


C_MM = 400.0


@pytest.mark.parametrize("free", [(), ("c",)], ids=["held", "free"])
def test_a_long_lens_converges(free: tuple[str, ...]) -> None:
    """Six photographs within 25 degrees. Before, 100 iterations ended at 10 and 110 times the noise."""
    rng = seed_of("long 1")
    camera = camera_from_values("synthetic", "brown", SIZE_PX, PIXEL_MM, c_mm=C_MM, free=free)
    xyz = rng.uniform(-1, 1, (30, 3)) * (1, 1, 0.3)
    position, rotation = _stations(rng, 6, 25.0, True, C_MM)
    network = _measured(rng, camera, position, rotation, xyz, 0.1, 0.9)
    truth = Estimate((camera,), position, rotation, xyz)
    result = run_survey(survey_of(network, truth, free=free, adjust={"sigma_px": 0.1}))
    a = result.adjustment
    assert a.converged and a.sigma0_px == pytest.approx(0.1, rel=0.1)
    if free:
        assert abs(a.estimate.cameras[0].value("c") - C_MM) < 3 * a.interior_sigma(0)[0]
    assert findings_of(result).verdict.level == "good"

    # from the other depth and another c: back at the c of the start, and of the right depth
    datum = Datum("free")
    start = replace(a.estimate, cameras=truth.cameras)
    found = nearer_start(a.network, start, reverse_depth(scale_estimate(start, 1.3)), datum)
    assert found is not None and found.cameras == truth.cameras
    again = adjust(
        a.network, found, datum=datum, reject="none", options=AdjustmentOptions(method="gauss-newton")
    )
    assert again.sigma0_px == pytest.approx(a.sigma0_px, rel=1e-6)


def test_what_is_held_is_reported() -> None:
    camera = camera_from_values("A", "brown", SIZE_PX, PIXEL_MM, c_mm=C_MM, free=("c", "x0", "y0"))
    held = replace(camera, free=camera.free & ~np.isin(camera.names, ["x0", "y0"]))
    (one,) = held_to_converge((camera, camera), (held, held))
    assert one.kind == "held_to_converge" and one.names("camera") == ("A",)
    assert one.names("parameters") == ("x0", "y0")
    assert held_to_converge((camera,), (camera,)) == ()
