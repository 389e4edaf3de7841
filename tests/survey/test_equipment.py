"""Bars and frames of an equipment file, corrected for temperature."""

from __future__ import annotations

import json
from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest

import sfm
from sfm.model.errors import SurveyFileError
from sfm.pipeline import run_survey
from sfm.survey.inputs.survey import Survey, read_survey
from tests.survey.test_rigs import written
from tests.synthetic import make_network, seed_of

EQUIPMENT = """\
unit = "mm"
[[bar]]
name = "steel"
points = ["1", "2"]
calibrated = 2025-03-01
length = 1000.0
sigma = 0.004
expansion = 11.5
[[bar]]
name = "carbon"
calibrated = 2025-03-01
temperature = 22.0
length = 800.0
sigma = 0.003
expansion = -0.5
expansion_sigma = 0.2
[[frame]]
name = "cross"
file = "cross.csv"
calibrated = 2024-11-30
expansion = 11.5
"""
CROSS = "point,X,Y,Z,sX,sY,sZ\n3,0,0,0,0.01,0.01,0.01\n4,300,0,0,0.01,0.01,0.01\n5,0,200,0,0.01,0.01,0.01\n"
USED = """\
[[equipment]]
name = "steel"
[[equipment]]
name = "carbon"
points = ["7", "8"]
[[equipment]]
name = "cross"
[[equipment]]
name = "cross"
points = ["11", "12", "13"]
"""
HEAD = 'unit = "m"\nequipment = "equipment.toml"\ntemperature = 30.0\ntemperature_sigma = 0.5\n'


def survey_of(folder: Path, *, used: str = USED, head: str = HEAD, equipment: str = EQUIPMENT) -> Path:
    network, truth = make_network(seed_of("equipment"), images=6, points=20, free=())
    path = written(folder, network, truth, used)
    path.write_text(path.read_text("utf-8").replace('unit = "m"\n', head), "utf-8")
    (folder / "equipment.toml").write_text(equipment, "utf-8")
    (folder / "cross.csv").write_text(CROSS, "utf-8")
    return path


def test_lengths_are_those_at_the_temperature_of_the_survey(tmp_path: Path) -> None:
    """By hand: four items, so that the error of temperature counts twice in each."""
    survey = read_survey(survey_of(tmp_path))
    steel, carbon = survey.scale_bars
    assert (steel.start, steel.end, carbon.start, carbon.end) == ("1", "2", "7", "8")
    assert steel.length == pytest.approx(1.000115, abs=1e-12)
    assert steel.sigma == pytest.approx(np.hypot(4e-6, 1.000115 * 11.5e-6 * 0.5 * 2), rel=1e-6)
    assert carbon.length == pytest.approx(0.8 * (1 - 0.5e-6 * 8), abs=1e-12)
    assert carbon.sigma == pytest.approx(0.8 * np.sqrt((3e-6 / 0.8) ** 2 + 0.5e-6**2 + 1.6e-6**2), rel=1e-5)
    first, second = survey.tables
    assert first.table.texts == (("cross",) * 3, ("3", "4", "5"))
    assert second.table.texts == (("cross 2",) * 3, ("11", "12", "13"))
    assert first.value[1] == pytest.approx([0.3 * 1.000115, 0, 0], abs=1e-12)
    # 200 of 300 mm from the mean; six coordinates, four items; two places of one calibration
    common = 0.2 * 1.000115 * 11.5e-6 * 0.5 * 2 * np.sqrt(6)
    assert first.sigma[1, 0] == pytest.approx(np.hypot(np.sqrt(2) * 1e-5, common), rel=1e-6)
    assert first.sigma[1, 2] == pytest.approx(np.sqrt(2) * 1e-5)


def placements(name: str, points: range) -> str:
    return "".join(
        f'[[equipment]]\nname = "{name}"\npoints = ["{j}", "{j + 1}"]\n'
        for j in range(points.start, points.stop, 2)
    )


def sigma_of_scale(survey: Survey) -> float:
    """Relative, of all bars together."""
    return float(1 / np.sqrt(sum((bar.length / bar.sigma) ** 2 for bar in survey.scale_bars)))


@pytest.mark.parametrize(
    ("sigma", "expansion_sigma", "temperature_sigma", "expected"),
    [(0.05, 0.0, 1e-6, 5e-5), (1e-6, 4.0, 1e-6, 40e-6), (1e-6, 0.0, 0.5, 11.5e-6 * 0.5)],
)
def test_an_error_that_placements_have_in_common_is_that_of_their_scale(
    sigma: float, expansion_sigma: float, temperature_sigma: float, expected: float, tmp_path: Path
) -> None:
    """Ten placements of one bar know the scale no better than its calibration, expansion or temperature."""
    values = f"sigma = {sigma}\nexpansion = 11.5\nexpansion_sigma = {expansion_sigma}"
    equipment = EQUIPMENT.replace("sigma = 0.004\nexpansion = 11.5", values)
    head = HEAD.replace("sigma = 0.5", f"sigma = {temperature_sigma}")
    rows = placements("steel", range(1, 21))
    survey = read_survey(survey_of(tmp_path, used=rows, equipment=equipment, head=head))
    assert sigma_of_scale(survey) == pytest.approx(expected, rel=1e-3)


def test_errors_of_calibration_of_two_items_are_not_in_common(tmp_path: Path) -> None:
    """Two bars with one error each, at five places each: the mean is better by sqrt(2)."""
    equipment = EQUIPMENT.replace('name = "carbon"', 'name = "other"').replace("800.0", "1000.0")
    equipment = equipment.replace("0.003", "0.004").replace("temperature = 22.0\n", "")
    rows = placements("steel", range(1, 11)) + placements("other", range(11, 21))
    head = HEAD.replace("30.0", "20.0").replace("sigma = 0.5", "sigma = 1e-6")
    survey = read_survey(survey_of(tmp_path, used=rows, equipment=equipment, head=head))
    assert sigma_of_scale(survey) == pytest.approx(4e-6 / np.sqrt(2), rel=1e-3)


def test_a_survey_is_scaled_by_its_equipment(tmp_path: Path) -> None:
    path = survey_of(tmp_path, used='[[equipment]]\nname = "steel"\n')
    a = run_survey(read_survey(path)).adjustment
    i, j = (a.network.point_index(name) for name in ("1", "2"))
    assert a.expected_defect == 6
    assert np.linalg.norm(a.estimate.points[j] - a.estimate.points[i]) == pytest.approx(1.000115, abs=1e-9)


def test_report_and_summary_trace_the_scale_to_its_equipment(tmp_path: Path) -> None:
    result = sfm.run_survey(survey_of(tmp_path), compare_with="none")
    result.write(tmp_path / "out")
    steel, carbon, cross, again = json.loads((tmp_path / "out" / "summary.json").read_text("utf-8"))[
        "equipment"
    ]
    assert (steel["name"], steel["given_as"], steel["calibrated"]) == (
        "steel",
        "scale bar 1 - 2",
        "2025-03-01",
    )
    assert (carbon["calibration_temperature"], carbon["expansion"]) == (22.0, -0.5)
    assert (carbon["expansion_sigma"], carbon["temperature"], carbon["temperature_sigma"]) == (0.2, 30.0, 0.5)
    assert carbon["correction"] == pytest.approx(-4.0) and steel["correction"] == pytest.approx(115.0)
    assert (cross["given_as"], again["given_as"]) == ("rigid frame cross", "rigid frame cross 2")
    for page in ("report.txt", "report.html"):
        text = (tmp_path / "out" / page).read_text("utf-8")
        assert "surveyed at" in text and "rigid frame cross 2" in text and "2024-11-30" in text


TOMORROW = date.today() + timedelta(days=1)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"used": '[[equipment]]\nname = "brass"\n'}, "unknown equipment 'brass', equipment.toml has steel"),
        ({"head": 'unit = "m"\nequipment = "equipment.toml"\n'}, "needs survey.temperature"),
        ({"head": 'unit = "m"\n'}, "needs survey.equipment"),
        ({"used": '[[equipment]]\nname = "carbon"\n'}, "'carbon': points = none, needed 2"),
        ({"used": '[[equipment]]\nname = "cross"\npoints = ["1", "2"]\n'}, "needed 3 different names"),
        (
            {"used": '[[equipment]]\nname = "steel"\n' + placements("steel", range(1, 3))},
            "'steel' is given twice on the points 1, 2, needed",
        ),
        (
            {"used": '[[equipment]]\nname = "cross"\n' * 2},
            "'cross' is given twice on the points 3, 4, 5, needed",
        ),
        ({"equipment": EQUIPMENT.replace("2025-03-01", str(TOMORROW), 1)}, f"calibrated = {TOMORROW}, which"),
        ({"equipment": EQUIPMENT.replace("11.5", "1.15e-5", 1)}, "needed in 1e-6 per K, such as 11.5"),
        ({"equipment": EQUIPMENT.replace('unit = "mm"', "")}, "equipment.toml: unit is missing"),
        ({"equipment": EQUIPMENT.replace("carbon", "steel")}, "'steel' occurs twice"),
        ({"equipment": EQUIPMENT.replace("cross.csv", "../cross.csv")}, "leaves the survey's folder"),
        ({"equipment": EQUIPMENT.replace("2025-03-01", '"1 March"', 1)}, "needed a date without quotes"),
    ],
)
def test_wrong_equipment_is_one_line(change: dict[str, str], said: str, tmp_path: Path) -> None:
    with pytest.raises(SurveyFileError) as error:
        read_survey(survey_of(tmp_path, **change))
    assert said in str(error.value) and "\n" not in str(error.value)
