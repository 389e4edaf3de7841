"""Surveys before plates: their sizes, standard deviations and places, what is reported, what calibrates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.adjustment.datum import Datum
from sfm.adjustment.quality.consistency import consistency_of
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.judgement.hypotheses.hypotheses import judge_alternatives
from sfm.judgement.verdict import ray_remarks
from sfm.model.camera import camera_from_values
from sfm.model.estimate import Estimate
from sfm.model.network import ObjectPoints
from sfm.model.remarks.remark import Remark, kinds_of, of_kind
from sfm.products.rendering.render import corner_rays, render_photograph
from sfm.products.rendering.scene import Optics
from sfm.survey.adjusting.solution_remarks import datum_remarks, missing_control, remarks_on_uncalibrated
from sfm.survey.diagnosis.codes_found import missing_plates
from sfm.survey.inputs.calibration import plate_control
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.survey.inputs.survey import Survey, read_survey
from sfm.targets.codes.plates import BOARDS, TAGGED, PlateFamily
from sfm.targets.detect import find_targets
from tests.findings import findings_of
from tests.plates import SURVEY, camera, plate_scene, stations
from tests.survey.seen_plates import FREE, SIGMA_PX, Plates, about, plates_survey, run_plates
from tests.surveys import survey_of
from tests.synthetic import make_network, perturb, seed_of

TOO_LARGE = "pitch = 12.024"  # of 12; the tags are 9 mm, so that the plate is 0.16 % too large


def remark_on_sizes(folder: Path, count: int, wrong: int, lines: tuple[str, ...] = ()) -> Remark:
    """Return what is reported of plates of which one is stated too large."""
    rng, plates = seed_of(f"sizes {count} {wrong}"), Plates.side_by_side(count)
    pitch = tuple(TOO_LARGE if k == wrong else "" for k in range(count))
    survey = plates_survey(folder, count, pitch)
    result = run_plates(survey, plates, about(plates, rng, 8), rng)
    (found,) = (one for one in findings_of(result).verdict.remarks if one.severity != "note")
    return found


def test_of_two_plates_either_may_be_wrong(tmp_path: Path) -> None:
    found = remark_on_sizes(tmp_path, 2, 1)
    assert (found.kind, found.names("given")) == ("plate_sizes_contradict", ("plate 1", "plate 2"))
    assert found.number("off") == pytest.approx(0.16, abs=0.08)
    assert "pitch" in found.remedy and "plate_sigma" in found.remedy


def test_of_three_plates_the_others_identify_one(tmp_path: Path) -> None:
    """Before, both diagonals of each plate were lengths of their own, and none was identified."""
    found = remark_on_sizes(tmp_path, 3, 1)
    assert (found.kind, found.names("plate")) == ("scale_left_out", ("plate 2",))
    assert found.number("off") == pytest.approx(0.16, abs=0.06)


def test_the_plate_that_is_control_is_not_left_out(tmp_path: Path) -> None:
    found = remark_on_sizes(tmp_path, 3, 0)
    assert (found.kind, found.names("given")) == ("plate_sizes_contradict", ("plate 1",))
    assert found.names("others") == ("plate 2", "plate 3")


@pytest.mark.parametrize(("count", "more"), [(2, ("calibrated_from_few",)), (3, ())])
def test_no_camera_is_calibrated_from_the_front(tmp_path: Path, count: int, more: tuple[str, ...]) -> None:
    """Before, c was held 1 mm wrong and the survey worked."""
    rng, plates = seed_of("from the front"), Plates.side_by_side(1)
    result = run_plates(
        plates_survey(tmp_path, 1, free="", c_mm=8.88), plates, about(plates, rng, count, 0.0, 250.0), rng
    )
    findings = findings_of(result)
    found, *others = (one for one in findings.verdict.remarks if one.severity != "note")
    assert kinds_of(others) == more
    assert (found.kind, found.severity, findings.calibrated) == ("calibration_failed", "error", ())
    assert found.number("held") == result.adjustment.estimate.cameras[0].parameters[0]


def test_projection_uncertainty_is_not_that_of_a_guess(tmp_path: Path) -> None:
    rng, plates = seed_of("a guess"), Plates.side_by_side(2)
    survey = plates_survey(tmp_path, 2, free=FREE.replace('"c", ', ""), c_mm=8.137)
    result = run_plates(survey, plates, about(plates, rng, 4), rng)
    estimate = result.adjustment.estimate
    assert len(findings_of(result).calibrated) == 1 and remarks_on_uncalibrated(survey, estimate) == ()
    asked = plates_survey(tmp_path, 2)
    told = remarks_on_uncalibrated(asked, estimate)
    assert kinds_of(told) == ("calibration_failed",)
    assert findings_of(replace(result, stage_remarks=(*result.stage_remarks, *told))).calibrated == ()
    free = replace(
        estimate, cameras=tuple(replace(one, free=np.ones_like(one.free)) for one in estimate.cameras)
    )
    assert remarks_on_uncalibrated(asked, free) == ()


def test_a_camera_is_known_by_its_whole_name(tmp_path: Path) -> None:
    """Before, of "cam" and "cam 2" both were reported where the second was held."""
    survey = plates_survey(tmp_path, 1)
    first = replace(camera(), name="cam", free=np.ones(10, dtype=bool))
    second = replace(first, name="cam 2 a.png", free=np.zeros(10, dtype=bool))
    both = tuple(survey.cameras[0].model_copy(update={"name": name}) for name in ("cam", "cam 2"))
    survey = replace(survey, cameras=both)
    nothing = np.zeros((0, 3))
    estimate = Estimate((first, second), nothing, np.zeros((0, 3, 3)), nothing)
    (found,) = remarks_on_uncalibrated(survey, estimate)
    assert found.names("camera") == ("cam 2",)


@pytest.mark.parametrize(
    ("slip_mm", "kind"),
    [pytest.param(3.0, "object_deformed", marks=pytest.mark.slow), (60.0, "plate_elsewhere")],
)
def test_a_plate_that_slipped_far_is_named(tmp_path: Path, slip_mm: float, kind: str) -> None:
    """Before, photographs were mirrored pictures by 3 mm, and 48 codes each at several places by 20 mm."""
    rng, plates = seed_of(f"slipped {slip_mm}"), Plates.side_by_side(2)
    slip = np.array([slip_mm, 0.2 * slip_mm, 0.0])
    survey, poses = plates_survey(tmp_path, 2), about(plates, rng, 8)
    result = run_plates(survey, plates, poses, rng, slipped=(6, 7), slip=slip)
    told = findings_of(result).verdict.remarks
    (found,) = of_kind(told, kind)
    others = {"photograph_mirrored", "codes_at_several_places", "points_moved"}
    assert not others & {one.kind for one in told} | others & {one.reason.kind for one in result.failed}
    assert found.names("photographs") == ("6.png", "7.png")
    if kind == "plate_elsewhere":
        assert {int(name) for name in found.names("points")} == set(range(80, 128))


RUNS = 2


def test_a_plate_better_than_stated_costs_no_image_points(tmp_path: Path) -> None:
    """Before, in most runs: residuals of control were in the sigma0 that image points are tested by."""
    plates, rejected, doubtful, sigma = Plates.side_by_side(1), 0, 0, list[float]()
    survey = plates_survey(tmp_path, 1, ("plate_sigma = 0.02",))
    for k in range(RUNS):
        rng = seed_of(f"better than stated {k}")
        a = run_plates(survey, plates, about(plates, rng, 4, distance=170.0), rng).adjustment
        found = consistency_of(a)
        rejected += bool(a.rejected.any())
        doubtful += bool(found.doubtful or found.large)
        sigma.append(a.image_sigma0 * a.sigma0_px / a.sigma0)
        assert a.sigma0 < 0.97 * a.image_sigma0
    print(f"rejected in {rejected}, doubtful in {doubtful} of {RUNS}; {np.mean(sigma):.4f} px")
    assert rejected + doubtful <= 1
    assert np.mean(sigma) == pytest.approx(SIGMA_PX, rel=0.05)


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
    network = replace(network, image_points=replace(seen, xy=centre + turn * (seen.xy - centre))).with_given(
        ObjectPoints(np.arange(60), truth.points, np.tile(sigma**2 * np.eye(3), (60, 1, 1)))
    )
    return adjust(network, perturb(truth, rng), datum=Datum("control"), reject="none")


@pytest.mark.parametrize("sigma", [0.0, 1e-5])
def test_known_coordinates_check_two_rays(sigma: float) -> None:
    on_control = adjusted(2, sigma=sigma)
    assert kinds_of(ray_remarks(on_control)) == ("rays_tested",)
    free = replace(on_control, datum="free")
    assert kinds_of(ray_remarks(free)) == ("rays_tested", "third_ray_missing")
    network = on_control.network
    known = network.control
    some = network.with_given(ObjectPoints(known.point[:40], known.xyz[:40], known.covariance[:40]))
    two = ray_remarks(replace(on_control, network=some))
    assert kinds_of(two) == ("rays_tested", "third_ray_missing") and two[1].number("two") == 20


def test_points_of_a_plate_may_be_out_of_view(tmp_path: Path) -> None:
    survey = plate_survey(tmp_path)
    plate = plate_control(survey.targets)
    assert plate is not None
    network, truth = make_network(seed_of("in view"), images=4, points=20)
    network = replace(network, points=plate.names[:20])
    assert missing_control(survey, network, ()) == ()
    given = survey_of(network, truth, control=plate, datum={"kind": "control"})
    missing = missing_control(given, network, ())
    (said,) = datum_remarks(given, network, missing, has_scale=True)
    assert said.kind == "names_missing" and said.names("names") == missing == plate.names[20:]


def test_an_assumed_pitch_is_a_note_of_the_result(tmp_path: Path) -> None:
    network, _ = make_network(seed_of("pitch"), images=4, points=20)
    assert datum_remarks(plate_survey(tmp_path), network, (), has_scale=True) == ()
    (note,) = datum_remarks(plate_survey(tmp_path, "pitch_assumed = true"), network, (), has_scale=True)
    assert (note.kind, note.severity) == ("plate_pitch_assumed", "note")
    assert note.numbers["pitch"].value == 8.0 and note.numbers["pitch"].unit == "mm"


def test_of_given_points_the_camera_shifts() -> None:
    """Coordinates that are given do not, nor does it matter what image points alone leave untested."""
    for sigma in (0.0, 1e-4):
        judged = judge_alternatives(adjusted(8, sigma=sigma, other=1.01))
        assert judged.causes and all(one.names("of") == ("cameras",) for one in judged.causes)
        weak = ("constancy_weakly_tested", "held_weakly_tested")
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


def test_photographs_of_another_board_are_named_with_its_size(tmp_path: Path) -> None:
    """A smaller board beside the stated one; a photograph without any board is listed by itself."""
    lens = camera()
    paths = []
    for size in ((6, 9), (5, 8), None):
        shown = np.full((600, 800), 128, np.uint8)
        if size is not None:
            board = PlateFamily("checkerboard", *size)
            scene, rays = plate_scene(board), corner_rays(lens)
            optics = Optics(blur_px=0.8, exposure=0.9, noise=0.01, oversampling=3)
            rng = seed_of(f"another board {size}")
            position, rotation = (of_all[0] for of_all in stations(rng, 1, board))
            shown, _ = render_photograph(scene, lens, position, rotation, optics=optics, rng=rng, rays=rays)
        paths.append(tmp_path / f"{len(paths)}.png")
        cv2.imwrite(str(paths[-1]), shown)
    stated = PlateFamily("checkerboard", 6, 9)
    targets = tuple(
        find_targets(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), polarity="dark", codes=stated)
        for path in paths
    )
    names = tuple(path.name for path in paths)
    seen = MeasuredPhotographs(names, tuple(paths), np.zeros(3, dtype=np.int64), (lens,), targets, ())
    other, nothing = missing_plates(stated, seen)
    assert other.names("photographs") == ("1.png",) and other.names("other") == ("5 x 8",)
    assert "It shows a checkerboard of 5 x 8." in other.text
    assert nothing.names("photographs") == ("2.png",) and not nothing.names("other")
    assert "shows a checkerboard" not in nothing.text
