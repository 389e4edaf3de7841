"""Remarks on a survey whose control is a plate: they do not speak of control that a person gave."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.hypotheses.hypotheses import judge_alternatives
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.camera import camera_from_values
from sfm.network import ObjectPoints
from sfm.remarks.remark import kinds_of, of_kind
from sfm.report.findings.survey_remarks import ray_remarks
from sfm.survey.adjusting.solution_remarks import datum_remarks
from sfm.survey.diagnosis.codes_found import missing_plates
from sfm.survey.inputs.calibration import plate_control
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.targets.codes.plates import BOARDS, TAGGED, PlateFamily
from sfm.targets.detect import find_targets
from tests.plates import SURVEY
from tests.surveys import survey_of
from tests.synthetic import make_network, perturb, seed_of


def plate_survey(folder: Path, line: str = "", datum: str = "control") -> Survey:
    """Return a survey of a plate of 5 x 6 dots, with one line more in [targets]."""
    text = SURVEY.format(
        name="plate", polarity="dark", pixel=0.01, codes="grid", rows=5, columns=6,
        pitch=f"8.0\n{line}", marks=[[1, 1], [1, 3], [2, 1]], datum=datum,
    )  # fmt: skip
    path = folder / "survey.toml"
    path.write_text(text, encoding="utf-8")
    return read_survey(path)


def adjusted(images: int, *, sigma: float = 0.0, other: float = 1.0) -> Adjustment:
    """Return the adjustment of a flat network whose points are all control.

    Args:
        images: photographs.
        sigma: standard deviation of the control, m; 0 holds it fixed.
        other: c of every other photograph over that of the camera.
    """
    rng = seed_of("plate remarks")
    network, truth = make_network(rng, images=images, points=60, planar=True, free=("c", "x0", "y0"))
    seen, (camera,) = network.image_points, truth.cameras
    centre = camera.frame[:2]
    turn = np.where(seen.image % 2 == 1, other, 1.0)[:, None]
    network = replace(
        network,
        image_points=replace(seen, xy=centre + turn * (seen.xy - centre)),
        control=ObjectPoints(np.arange(60), truth.points, np.tile(sigma**2 * np.eye(3), (60, 1, 1))),
    )
    return adjust(network, perturb(truth, rng), datum=Datum("control"), reject="none")


@pytest.mark.parametrize("sigma", [0.0, 1e-5])
def test_known_coordinates_check_two_rays(sigma: float) -> None:
    on_control = adjusted(2, sigma=sigma)
    assert ray_remarks(on_control) == ()
    free = replace(on_control, datum="free")
    assert kinds_of(ray_remarks(free)) == ("two_photographs", "two_rays")
    network = on_control.network
    known = network.control
    some = replace(network, control=ObjectPoints(known.point[:40], known.xyz[:40], known.covariance[:40]))
    two = ray_remarks(replace(on_control, network=some))
    assert kinds_of(two) == ("two_photographs", "two_rays") and two[1].number("two") == 20


def test_points_of_a_plate_may_be_out_of_view(tmp_path: Path) -> None:
    survey = plate_survey(tmp_path)
    plate = plate_control(survey.targets)
    assert plate is not None
    network, truth = make_network(seed_of("in view"), images=4, points=20)
    network = replace(network, points=plate.names[:20])
    assert datum_remarks(survey, network, has_scale=True) == ()
    given = survey_of(network, truth, control=plate, datum={"kind": "control"})
    (missing,) = datum_remarks(given, network, has_scale=True)
    assert missing.kind == "control_missing" and missing.names("points") == plate.names[20:]


def test_an_assumed_pitch_is_a_note_of_the_result(tmp_path: Path) -> None:
    network, _ = make_network(seed_of("pitch"), images=4, points=20)
    assert datum_remarks(plate_survey(tmp_path), network, has_scale=True) == ()
    (note,) = datum_remarks(plate_survey(tmp_path, "pitch_assumed = true"), network, has_scale=True)
    assert (note.kind, note.severity) == ("plate_pitch_assumed", "note")
    assert note.numbers["pitch"].value == 8.0 and note.numbers["pitch"].unit == "mm"


def test_of_given_points_the_camera_shifts() -> None:
    """Coordinates that are given do not, nor does it matter what image points alone leave untested."""
    for sigma in (0.0, 1e-4):
        judged = judge_alternatives(adjusted(8, sigma=sigma, other=1.01))
        assert judged.causes and all(one.names("of") == ("cameras",) for one in judged.causes)
        weak = ("camera_weakly_tested", "shape_weakly_tested", "held_weakly_tested")
        assert not of_kind(judged.unchecked, *weak)


@pytest.mark.parametrize("codes", [*BOARDS, "grid"])
def test_a_board_that_is_not_found_is_sought_by_the_keys_that_it_has(codes: str) -> None:
    """The remedy names no key that a survey file of this board refuses."""
    nothing = find_targets(np.full((40, 50), 128, np.uint8), polarity="dark")
    camera = camera_from_values("A", "brown", (50, 40), (0.01, 0.01), c_mm=1.0)
    lost = MeasuredPhotographs(("a",), (Path("a"),), np.zeros(1, dtype=np.int64), (camera,), (nothing,), ())
    board = PlateFamily(codes, 6, 8, (), "aruco4x4_50" if codes in TAGGED else "", 0.5)
    (one,) = missing_plates(board, lost)
    assert one.names("photographs") == ("a",) and one.names("size") == ("6 x 8",)
    words = {word.strip(".,") for word in one.remedy.split()}
    assert {"rows", "columns"} <= words or codes == "grid"
    assert ({"dictionary", "tag_size", "first_tag"} <= words) == (codes in TAGGED)
    assert codes in TAGGED or not {"dictionary", "tag_size", "first_tag"} & words
