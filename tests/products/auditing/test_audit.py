"""Models of other programs, judged by their own image points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.colmap.adjuster import load_pycolmap
from adapters.formats.content import Content
from adapters.formats.registry import read_comparable, write_any, write_content
from sfm.adjustment.quality.correlations import OrientationCorrelation
from sfm.files.globs import name_of_model
from sfm.model.camera import pixel_from_rays
from sfm.model.conventions import FloatArray
from sfm.model.errors import GeometryError
from sfm.model.estimate import Estimate
from sfm.model.network import ImagePoints, Network
from sfm.model.observations.control_and_bars import ObjectPoints
from sfm.model.similarity import fit_similarity
from sfm.model.solution import Solution
from sfm.pipeline import run_survey
from sfm.products.auditing.audit import Audit, audit_of, stated_of, survey_of_model
from sfm.products.auditing.prepared import prepared_model
from sfm.report.pages import html_of, page_of
from sfm.runtime.forecast import RunHistory
from sfm.survey.inputs.exterior_table import ObservedExterior
from sfm.survey.inputs.given_values import ScaleBar
from sfm.survey.inputs.settings import AdjustSettings, RigSettings
from sfm.survey.inputs.survey import CameraSetup, Survey
from tests import commands
from tests.products.calibration.boards import SIGMA_PX
from tests.products.calibration.fisheyes import fisheye_board
from tests.rigs import make_rig
from tests.synthetic import make_network, seed_of

NOISE_PX = 0.3


def network_of(name: str, **how: int) -> tuple[Network, Estimate]:
    return make_network(seed_of(name), images=8, points=40, noise_px=NOISE_PX, model="opencv", free=(), **how)


def model_of(network: Network, truth: Estimate, *, off: float = 0.0) -> Solution:
    """Return a model as another program leaves it: points off by a part of the object, nothing stated."""
    points = truth.points + off * seed_of("left off").standard_normal(truth.points.shape)
    seen = replace(network.image_points, stated=np.zeros(len(network.image_points), dtype=bool))
    return Solution("model", replace(network, image_points=seen), replace(truth, points=points))


def audited(model: Solution, **how: object) -> Audit:
    stated = stated_of(model)
    return audit_of(model, stated, run_survey(survey_of_model(model, stated, **how)[0]))  # type: ignore[arg-type]


def test_what_colmap_states_of_its_model_is_on_the_page(tmp_path: Path) -> None:
    """Its mean reprojection error is a mean over points of means over their image points."""
    network, truth = make_network(
        seed_of("stated"), images=8, points=40, noise_px=NOISE_PX, model="opencv", visibility=0.6
    )
    write_any(tmp_path / "model", "colmap", network, truth)
    theirs = load_pycolmap().Reconstruction(str(tmp_path / "model"))
    theirs.update_point_3d_errors()
    stated = stated_of(read_comparable(tmp_path / "model"))
    assert stated.mean_of_points_px == pytest.approx(theirs.compute_mean_reprojection_error(), abs=1e-9)
    assert abs(stated.mean_of_points_px - stated.mean_length_px) > 1e-3  # as rays of points differ in number


def test_a_model_is_adjusted_to_what_its_image_points_tell() -> None:
    """Points of a model left far from its optimum are off by the stated standard deviations afterwards."""
    network, truth = network_of("audited")
    audit = audited(model_of(network, truth, off=0.002))
    a = audit.result.adjustment
    assert audit.result.verdict.level == "good" and not a.rejected.any()
    assert a.sigma0_px == pytest.approx(NOISE_PX, rel=0.1)
    assert audit.stated.rms_px > 2 * a.rms_px
    error = fit_similarity(a.estimate.points, truth.points).apply(a.estimate.points) - truth.points
    sigma = np.sqrt(np.trace(a.covariance.points, axis1=1, axis2=2).mean() / 3)
    assert np.sqrt((error**2).mean()) == pytest.approx(sigma, rel=0.4)
    points, photographs = audit.moved
    assert points.over_sigma > 5 and points.rms == pytest.approx(0.002, rel=0.3)
    assert photographs.kind == "photographs" and photographs.name in network.images


def test_a_model_at_its_optimum_does_not_move() -> None:
    network, truth = network_of("settled")
    first = audited(model_of(network, truth)).result.adjustment
    again = audited(model_of(network, first.estimate))
    assert again.stated.rms_px == pytest.approx(again.result.adjustment.rms_px, rel=1e-4)
    assert all(moved.over_sigma < 0.05 for moved in again.moved)


def test_gross_errors_of_a_model_are_named() -> None:
    network, truth = network_of("wrong matches")
    seen = network.image_points
    xy = seen.xy.copy()
    wrong = [5, 60, 111]
    xy[wrong] += (15.0, -9.0)
    a = audited(model_of(replace(network, image_points=replace(seen, xy=xy)), truth)).result.adjustment
    images, points = a.network.images, a.network.points
    rejected = a.network.image_points.select(a.rejected)
    assert {(images[i], points[j]) for i, j in zip(rejected.image, rejected.point, strict=True)} == {
        (network.images[seen.image[k]], network.points[seen.point[k]]) for k in wrong
    }


@pytest.mark.parametrize("named", [True, False])
def test_matches_without_names_are_natural_points(named: bool) -> None:
    """Points moved from a photograph on; without lasting names they are tracks of two spots of the object."""
    network, truth = make_network(
        seed_of("tracks"), images=10, points=120, noise_px=NOISE_PX, model="opencv", free=()
    )
    seen = network.image_points
    later = np.flatnonzero((seen.image >= 5) & np.isin(seen.point, (3, 30)))
    elsewhere = replace(truth, points=truth.points + 0.01)
    moved = np.array([pixel_of(elsewhere, network, k) - pixel_of(truth, network, k) for k in later])
    xy = seen.xy.copy()
    xy[later] += moved
    twice = np.flatnonzero(seen.image == 2)[:1]  # two key points of one photograph in a track
    again = replace(seen.select(twice), xy=xy[twice] + 40.0)
    network = replace(network, image_points=ImagePoints.joined([replace(seen, xy=xy), again]))
    model = replace(of_each_photograph(network, truth), points_named=named)
    stated = stated_of(model)
    audit = audit_of(model, stated, run_survey(survey_of_model(model, stated)[0]))
    kinds = [said.kind for said in audit.result.verdict.remarks]
    assert ("image_points_contradicting" in kinds) == named and "camera_per_photograph" not in kinds
    assert kinds.count("points_moved") == named and kinds.count("windows_elsewhere") == (not named), kinds
    (left_out,) = [
        point for point in audit.result.left_out if point.reason.kind == "image_points_contradicting"
    ]
    assert left_out.image_points == 2


def pixel_of(estimate: Estimate, network: Network, k: int) -> FloatArray:
    """Where the camera of an image point images its object point, px, (2,)."""
    i, j = network.image_points.image[k], network.image_points.point[k]
    ray = (estimate.points[j] - estimate.position[i]) @ estimate.rotation[i]
    return np.asarray(pixel_from_rays(estimate.cameras[network.camera[i]], ray[None])[0])


def test_a_survey_gives_scale_to_a_model() -> None:
    network, truth = network_of("scaled")
    model = model_of(network, replace(truth, points=2.5 * truth.points, position=2.5 * truth.position))
    length = float(np.linalg.norm(truth.points[0] - truth.points[1]))
    first, second = network.points[:2]
    camera = CameraSetup(name="any", images="*.jpg", c_mm=8.0)
    bar = ScaleBar(first, second, length, 1e-4)
    given = Survey(name="bar", unit="mm", cameras=(camera,), scale_bars=(bar,))
    a = audited(model, given=given).result.adjustment
    placing = fit_similarity(a.estimate.points, truth.points)
    assert placing.scale == pytest.approx(1.0, abs=1e-3)
    stated = stated_of(model)
    assert survey_of_model(model, stated, given=given)[0].adjust.sigma_px == stated.sigma_px
    own = replace(given, adjust=AdjustSettings(sigma_px=0.2, reject="none"))
    adjust = survey_of_model(model, stated, given=own)[0].adjust
    assert (adjust.sigma_px, adjust.reject) == (0.2, "none")


def test_the_precision_of_image_points_follows_from_residuals_and_redundancy() -> None:
    """Few image points a point: residuals of the optimum are far smaller than the noise."""
    network, truth = make_network(seed_of("few rays"), images=3, points=300, noise_px=NOISE_PX, free=())
    settled = audited(model_of(network, truth)).result.adjustment
    stated = stated_of(model_of(settled.network, settled.estimate))
    assert stated.rms_px < 0.8 * NOISE_PX
    assert stated.sigma_px == pytest.approx(NOISE_PX, rel=0.15)


def test_standard_deviations_depend_on_the_datum() -> None:
    """Holding three points makes those of the others larger; the shape is known equally well."""
    network, truth = network_of("gauge")
    (_, *inner), (_, *held) = audited(model_of(network, truth)).gauge
    assert held[0] > 1.2 * inner[0] and held[1] > inner[1]


def test_parameters_are_held_and_named() -> None:
    network, truth = network_of("held")
    model = model_of(network, truth)
    audit = audited(model, fixed=("cx", "cy"))
    camera = audit.result.adjustment.estimate.cameras[0]
    assert not camera.free[camera.parts[1]].any() and camera.free[camera.parts[0]].all()
    text = page_of(audit, report="report.html").text
    assert "change / sigma" in text and "cx" not in text
    with pytest.raises(GeometryError, match="parameter 'cz' is to be held"):
        survey_of_model(model, stated_of(model), fixed=("cz",))


def test_correlations_with_orientations_are_words() -> None:
    network, truth = network_of("words")
    audit = audited(model_of(network, truth))
    strong = OrientationCorrelation("c of camera a", 0.99, "Z0", network.images[0], (("Z0", 1),))
    shown = replace(audit, result=replace(audit.result, orientation_correlations=(strong,)))
    assert f"photographs: c of camera a with {strong.partners}." in html_of(shown, report="r")


def test_cameras_are_told_by_their_photographs_whatever_their_names() -> None:
    network, truth = network_of("cameras", cameras=2)
    names = tuple(f"left [{i}].jpg" if k == 0 else f"right*{i}.jpg" for i, k in enumerate(network.camera))
    audit = audited(model_of(replace(network, images=names), truth))
    a = audit.result.adjustment
    assert [a.estimate.cameras[k].name for k in a.network.camera] == [
        truth.cameras[k].name for k in network.camera
    ]


def test_photographs_keep_their_order_where_image_points_are_listed_by_point() -> None:
    """Points that moved are sought in the order of the photographs, of which the first may see few points."""
    network, truth = network_of("by point")
    seen = network.image_points
    late = seen.select(np.lexsort((-seen.image, seen.point)))
    a = audited(model_of(replace(network, image_points=late), truth)).result.adjustment
    assert a.network.images == network.images


def test_rigs_of_a_model_are_kept() -> None:
    """The mount is adjusted from all moments."""
    network, truth = make_rig(seed_of("kept rig"), moments=6, points=60, noise_px=NOISE_PX)
    model = model_of(network, truth)
    survey, notes = survey_of_model(model, stated_of(model))
    assert not notes and [rig.cameras for rig in survey.rigs] == [("camera 1", "camera 2")]
    audit = audited(model, fixed=("c", "x0", "y0"))
    a, true = audit.result.adjustment, truth.mounts
    mounts = a.estimate.mounts
    assert mounts is not None and true is not None and audit.result.verdict.level == "good"
    assert a.unknown_counts[0] == 6 * 6 + 6  # poses of six moments and one mount
    scale = fit_similarity(a.estimate.points, truth.points).scale
    np.testing.assert_allclose(scale * mounts.position[1], true.position[1], atol=2e-3)


def test_mounts_that_a_model_holds_stay_held() -> None:
    network, truth = make_rig(seed_of("held mounts"), moments=5, points=60)
    true = truth.mounts
    assert true is not None
    held = replace(true, free=np.zeros_like(true.free))
    model = replace(model_of(network, replace(truth, mounts=held)), unit="m")
    mounts = audited(model).result.adjustment.estimate.mounts
    assert mounts is not None and not mounts.free.any()
    np.testing.assert_allclose(mounts.position, true.position, atol=1e-12)
    np.testing.assert_allclose(mounts.rotation, true.rotation, atol=1e-12)


def test_rigs_of_a_survey_file_join_photographs_of_a_model() -> None:
    network, truth = make_rig(seed_of("given rig"), moments=6, points=60, noise_px=NOISE_PX)
    model = model_of(replace(network, moment=None), replace(truth, mounts=None))
    cameras = [CameraSetup(name=f"eye {k}", images=f"*camera {k}", c_mm=8.0) for k in (1, 2)]
    rig = RigSettings(name="pair", cameras=("eye 1", "eye 2"), moment="moment ([0-9]+)")
    given = Survey(name="rig", unit="m", cameras=cameras, rigs=(rig,))
    survey, notes = survey_of_model(model, stated_of(model), given=given)
    assert not notes and [camera.name for camera in survey.cameras] == ["eye 1", "eye 2"]
    assert audited(model, given=given).result.adjustment.unknown_counts[0] == 6 * 6 + 6
    timed = rig.model_copy(update={"moment": "exif"})
    _, notes = survey_of_model(model, stated_of(model), given=replace(given, rigs=(timed,)))
    assert notes == ("not used of the survey file: rig pair (its moments are in EXIF data of photographs)",)


def test_a_camera_that_a_survey_file_states_takes_the_place_of_the_models() -> None:
    """A calibrated camera in another lens model is held, and shown beside no value of the model."""
    network, truth = network_of("calibrated", cameras=2)
    model = model_of(network, truth)
    first = [network.images[i] for i in np.flatnonzero(network.camera == 0)]
    f, size = 1600.0, truth.cameras[0].size_px
    stated = CameraSetup(name="D3", images=first, pixel_mm=(0.005, 0.005), c_mm=f * 0.005, free=[])
    audit = audited(model, given=Survey(name="given", unit="m", cameras=(stated,)))
    other, camera = audit.result.adjustment.estimate.cameras
    assert (camera.name, camera.model, camera.size_px) == ("D3", "brown", size)
    assert camera.value("c") == f * 0.005 and not camera.free.any()
    assert other.name == truth.cameras[1].name and other.free.any()
    text = page_of(audit, report="report.html").text
    assert "D3" not in text.split("Held at")[0] and other.name in text
    own = CameraSetup(name="D3", images=first, free=["fx"], model="opencv")
    survey, _ = survey_of_model(model, stated_of(model), given=Survey(name="g", unit="m", cameras=(own,)))
    assert survey.cameras[-1].start == (("fx", truth.cameras[0].value("fx")),)


def test_what_of_a_survey_file_is_not_used_is_said() -> None:
    network, truth = network_of("not used", cameras=2)
    model = model_of(network, truth)
    cameras = (
        CameraSetup(name="all", images=list(network.images), c_mm=8.0),
        CameraSetup(name="none", images="*.tif", c_mm=8.0),
    )
    exterior = ObservedExterior.from_arrays([network.images[2], "lost"], truth.position[[2, 3]], 1e-3)
    given = Survey(
        name="given",
        unit="m",
        cameras=cameras,
        rigs=(RigSettings(name="pair", cameras=("all", "none"), moment="order"),),
        targets={"codes": "ring14"},
        exterior=exterior,
    )
    survey, notes = survey_of_model(model, stated_of(model), given=given)
    assert survey.exterior is not None and survey.exterior.names == (network.images[2],)
    assert notes == (
        "not used of the survey file: camera all (its photographs are of 2 cameras of the model), camera "
        "none (no photograph of the model is its own), rig pair (no photographs of camera all, none alone), "
        "1 row of [exterior] (no photograph of the model), [targets]",
    )


def test_image_points_that_the_camera_of_a_model_does_not_see_are_counted() -> None:
    network, truth = network_of("turned away")
    rotation = truth.rotation.copy()
    rotation[2] = rotation[2] @ np.diag([-1.0, 1.0, -1.0])
    model = model_of(network, replace(truth, rotation=rotation))
    of_turned = int((network.image_points.image == 2).sum())
    stated = stated_of(model)
    assert stated.unseen == of_turned > 0
    assert stated.rms_px == pytest.approx(NOISE_PX, rel=0.2)
    right = audited(model_of(network, truth))
    assert "Left out of the model's residuals" not in html_of(right, report="report.html")
    page = html_of(replace(right, stated=stated), report="report.html")
    assert f"Left out of the model&#39;s residuals: {of_turned} image points" in page


def test_a_fisheye_states_residuals_beyond_90_degrees() -> None:
    board = fisheye_board(seed_of("audited fisheye"))
    stated = stated_of(model_of(board.noisy(seed_of("noise of a fisheye")), board.truth))
    assert stated.unseen == 0 and len(stated.residuals) == len(board.network.image_points)
    assert stated.rms_px == pytest.approx(SIGMA_PX, rel=0.1)


def test_correlated_control_of_a_model_is_kept() -> None:
    network, truth = network_of("control")
    C = np.array([[4.0, 1.0, -0.5], [1.0, 3.0, 0.2], [-0.5, 0.2, 5.0]]) * 1e-6
    control = ObjectPoints(np.arange(4), truth.points[:4], np.tile(C, (4, 1, 1)))
    model = model_of(network.with_given(control), truth)
    survey, _ = survey_of_model(model, stated_of(model))
    assert survey.control is not None
    np.testing.assert_allclose(survey.control.covariance, control.covariance, rtol=1e-12)


def test_poses_alone_are_refused() -> None:
    network, truth = network_of("poses")
    unseen = replace(truth, points=np.full_like(truth.points, np.nan))
    with pytest.raises(GeometryError, match="0 points with coordinates"):
        stated_of(model_of(network, unseen))


def test_points_that_a_model_leaves_out_are_intersected() -> None:
    """MicMac stores orientations and image points, and coordinates of control alone."""
    network, truth = network_of("left out")
    points = truth.points.copy()
    points[5:] = np.nan
    unplaced = model_of(network, replace(truth, points=points))
    model, notes = prepared_model(unplaced, one_camera=False)
    assert notes == (
        "the model has no coordinates of 35 points, which were intersected from its photographs",
    )
    np.testing.assert_array_equal(model.estimate.points[:5], truth.points[:5])
    np.testing.assert_allclose(model.estimate.points, truth.points, atol=0.01)
    assert audited(model).result.verdict.level == "good"


def test_poses_without_image_points_say_what_is_missing() -> None:
    network, truth = network_of("nothing seen")
    none = np.zeros(len(network.image_points), dtype=bool)
    alone = replace(network, image_points=network.image_points.select(none))
    model, notes = prepared_model(model_of(alone, truth), one_camera=False)
    assert not notes
    with pytest.raises(GeometryError, match="has 8 oriented photographs, 0 image points and 40 points with"):
        stated_of(model)


def as_program_reads(truth: Estimate, *, p1: float = 0.0) -> Estimate:
    """Return cameras as they come from a format with one principal distance and k1."""
    values = {"fy": "fx"}
    cameras = []
    for camera in truth.cameras:
        of = dict(zip(camera.names, camera.parameters.tolist(), strict=True))
        of |= {new: of[old] for new, old in values.items()} | {"k2": 0.0, "p1": p1, "p2": 0.0}
        cameras.append(camera.with_parameters(np.array([of[name] for name in camera.names])))
    return replace(truth, cameras=tuple(cameras))


def test_a_camera_with_one_principal_distance_keeps_one() -> None:
    network, truth = network_of("one focal", cameras=2)
    model, _ = prepared_model(model_of(network, as_program_reads(truth)), one_camera=False)
    assert [camera.model for camera in model.estimate.cameras] == ["simple_radial"] * 2
    assert model.estimate.cameras[0].value("f") == as_program_reads(truth).cameras[0].value("fx")
    ray = np.array([[0.2, -0.1, -1.0]])
    for camera, before in zip(model.estimate.cameras, as_program_reads(truth).cameras, strict=True):
        np.testing.assert_allclose(pixel_from_rays(camera, ray), pixel_from_rays(before, ray), rtol=1e-14)
    model, _ = prepared_model(model_of(network, as_program_reads(truth, p1=1e-4)), one_camera=False)
    assert [camera.model for camera in model.estimate.cameras] == ["opencv"] * 2


def of_each_photograph(network: Network, truth: Estimate, spread: float = 0.0) -> Solution:
    """Return a model with a camera for each photograph, whose principal distances differ by a part."""
    (camera,) = truth.cameras
    lengths = np.isin(camera.names, ("fx", "fy"))
    factor = 1.0 + spread * np.linspace(-1, 1, len(network.images))
    cameras = tuple(
        replace(
            camera,
            name=f"{i}",
            parameters=np.where(lengths, f * camera.parameters, camera.parameters),
        )
        for i, f in enumerate(factor)
    )
    single = replace(network, camera=np.arange(len(network.images)))
    return model_of(single, replace(truth, cameras=cameras))


def test_cameras_that_could_be_one_are_named_and_joined() -> None:
    """A camera for each photograph, as programs make them without EXIF."""
    network, truth = network_of("a camera each")
    model = of_each_photograph(network, truth)
    audit = audited(model)
    (like,) = audit.like
    assert len(like.names) == 8 and like.statistic < like.limit and "could be one" in f"{like}"
    assert "--one-camera joins" in html_of(audit, report="report.html")
    joined, notes = prepared_model(of_each_photograph(network, truth, 0.01), one_camera=True)
    assert notes == ("8 cameras joined into 1, as --one-camera asks",)
    (camera,) = joined.estimate.cameras
    assert camera.value("fx") == pytest.approx(truth.cameras[0].value("fx"), rel=1e-12)
    shared = audited(joined)
    assert not shared.like and len(shared.result.adjustment.estimate.cameras) == 1
    sigma = [np.sqrt(np.diagonal(C))[0] for C in audit.result.adjustment.covariance.interior]
    assert np.sqrt(np.diagonal(shared.result.adjustment.covariance.interior[0]))[0] < 0.5 * np.median(sigma)
    with pytest.raises(GeometryError, match="1 camera, of which no two have the same size"):
        prepared_model(joined, one_camera=True)


def test_cameras_that_differ_are_not_called_one() -> None:
    """A zoom of 2 % from the first photographs to the others."""
    network, truth = network_of("two zooms", cameras=2)
    first, second = truth.cameras
    zoomed = np.where(np.isin(first.names, ("fx", "fy")), 1.02 * first.parameters, first.parameters)
    rays = np.einsum(
        "ki,kij->kj",
        (truth.points[network.image_points.point] - truth.position[network.image_points.image]),
        truth.rotation[network.image_points.image],
    )
    cameras = (first, replace(first, name=second.name, parameters=zoomed))
    xy = network.image_points.xy.copy()
    for k, camera in enumerate(cameras):
        rows = network.camera[network.image_points.image] == k
        xy[rows] = pixel_from_rays(camera, rays[rows])
    xy += NOISE_PX * seed_of("zoom noise").standard_normal(xy.shape)
    seen = replace(network.image_points, xy=xy)
    audit = audited(model_of(replace(network, image_points=seen), replace(truth, cameras=cameras)))
    (like,) = audit.like
    assert like.statistic > like.limit and "differ more than one camera would" in f"{like}"


def test_an_audit_states_its_time_to_the_end_and_keeps_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sfm.runtime import progress_bar

    stated, finish = [], progress_bar.DrawnProgress.finished

    def finished(drawn: progress_bar.DrawnProgress) -> dict[str, float]:
        stated.append(drawn.countdown)
        return finish(drawn)

    monkeypatch.setattr(progress_bar.DrawnProgress, "finished", finished)
    network, truth = network_of("time to the end")
    write_content(tmp_path / "model", "colmap", Content(Solution("model", network, truth)))
    for _ in range(2):
        assert commands.kolinear("audit", tmp_path / "model", "--out", tmp_path / "out", "--overwrite") == 0
    first, second = (countdown for k, countdown in enumerate(stated) if k % 2)
    assert {"adjustment", "report"} <= first.expected.keys() and "comparison" not in first.expected
    assert second.expected == pytest.approx(first.taken)  # the last run is the most alike
    work = RunHistory.of_user().read()[-1].work
    assert work.image_points == len(network.image_points) and work.sources == ("given",)


def test_the_command_writes_page_and_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    network, truth = network_of("command")
    write_content(tmp_path / "model", "opensfm", Content(model_of(network, truth, off=0.001)))
    out = tmp_path / "audit"
    assert commands.kolinear("audit", tmp_path / "model", "--out", out) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("The image points determine this model: RMS")
    assert "What the adjustment moved" in printed and "What was tested?" not in printed
    page = (out / "audit.html").read_text(encoding="utf-8")
    assert "Are the cameras determined?" in page and (out / "report.html").is_file()
    rows = (out / "audit_cameras.csv").read_text(encoding="utf-8").splitlines()
    assert rows[0].startswith("camera,parameter,stated,adjusted,sigma") and len(rows) > 4
    write_content(tmp_path / "poses.json", "nerfstudio", Content(model_of(network, truth)))
    assert commands.kolinear("audit", tmp_path / "poses.json", "--out", tmp_path / "none") == 2
    assert "poses, cameras or points alone" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_models_that_programs_number_have_the_name_of_their_project(tmp_path: Path) -> None:
    assert name_of_model(tmp_path / "bridge" / "sparse" / "0") == "bridge/sparse/0"
    assert name_of_model(tmp_path / "bridge" / "12") == "bridge/12"
    assert name_of_model(tmp_path / "bridge") == "bridge"
    assert name_of_model(Path("/0")) == "0"


def test_what_of_a_model_takes_no_part_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    network, truth = network_of("rejected")
    seen, points = network.image_points, list(network.points)
    content = Content(model_of(replace(network, image_points=seen.select(np.arange(len(seen)) > 1)), truth))
    write_content(tmp_path / "model", "tables", replace(content, rejected=seen.select(np.arange(2))))
    assert commands.kolinear("audit", tmp_path / "model", "--out", tmp_path / "audit") == 0
    words = "ot used of the model: 2 rejected image points"
    assert words in capsys.readouterr().out
    assert words in (tmp_path / "audit" / "audit.html").read_text(encoding="utf-8")
    nvm = [
        "NVM_V3", "", "1", "a.jpg 1000 1 0 0 0 0 0 0 0 0", "", f"{len(points)}",
        *(f"{x} {y} {5 + z} 0 0 0 2 0 0 {1000 * x / (5 + z)} {1000 * y / (5 + z)} 0 1 1 1"
          for x, y, z in truth.points.tolist()), "", "0",
    ]  # fmt: skip
    (tmp_path / "twice.nvm").write_text("\n".join(nvm) + "\n", encoding="utf-8")
    assert commands.kolinear("audit", tmp_path / "twice.nvm", "--out", tmp_path / "twice") in (0, 1)


def test_a_result_of_another_model_is_replaced_only_if_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network, truth = network_of("first of two")
    for folder in ("a", "b"):
        write_content(tmp_path / folder / "0", "opensfm", Content(model_of(network, truth)))
    out = tmp_path / "out"
    assert commands.kolinear("audit", tmp_path / "a" / "0", "--out", out) == 0
    assert commands.kolinear("audit", tmp_path / "a" / "0", "--out", out) == 0, "the same model again"
    capsys.readouterr()
    assert "--overwrite replaces" in commands.refused(capsys, "audit", tmp_path / "b" / "0", "--out", out)
    assert commands.kolinear("audit", tmp_path / "b" / "0", "--out", out, "--overwrite") == 0


def test_photographs_and_points_without_image_points_take_no_part() -> None:
    network, truth = network_of("without image points")
    seen = network.image_points
    part = seen.select((seen.image != 3) & (seen.point != 7))
    audit = audited(model_of(replace(network, image_points=part), truth))
    a = audit.result.adjustment
    assert set(network.images) - set(a.network.images) == {network.images[3]}
    assert set(network.points) - set(a.network.points) == {network.points[7]}
    assert (audit.stated.photographs, audit.stated.points) == (8, 40)


def test_a_model_that_cannot_be_adjusted_ends_in_a_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One photograph with three image points."""
    network, truth = network_of("three image points")
    first = np.flatnonzero(network.image_points.image == 0)[:3]
    alone = replace(network, image_points=network.image_points.select(first))
    write_content(tmp_path / "model", "opensfm", Content(model_of(alone, truth)))
    assert commands.kolinear("audit", tmp_path / "model", "--out", tmp_path / "out") == 1
    assert "Report:" in capsys.readouterr().out and (tmp_path / "out" / "report.html").is_file()
