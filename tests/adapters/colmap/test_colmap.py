"""COLMAP adapter: pixel origin, axes, what is free, models written and read, the adjuster."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from adapters.colmap import adjuster as colmap
from adapters.colmap.adjuster import adjust_with_colmap, covariance_with_colmap
from adapters.colmap.camera_models import read_model, write_model
from adapters.colmap.mapper import map_photographs
from sfm.adjustment.datum import Datum
from sfm.adjustment.solve import adjust
from sfm.comparison.solutions import reprojection
from sfm.model.camera import camera_from_values
from sfm.model.conventions import angles_from_rotation, rotation_from_angles, skew
from sfm.model.errors import BackendError, OutputError, SurveyFileError
from sfm.model.estimate import Estimate
from sfm.model.network import Network, ObjectPoints
from sfm.pipeline import run_survey
from sfm.survey.assembly import OtherPrograms
from sfm.survey.inputs.survey import read_survey
from tests.places import ROOT
from tests.synthetic import make_network, perturb, seed_of

MODELS = ("opencv", "full_opencv", "opencv_fisheye", "eucm", "rad_tan_thin_prism_fisheye")


def scene(model: str = "opencv", *, cameras: int = 1, noise_px: float = 0.1) -> tuple[Network, Estimate]:
    return make_network(
        seed_of(f"colmap {model} {cameras}"),
        images=8,
        points=40,
        model=model,
        cameras=cameras,
        noise_px=noise_px,
    )


def rms(network: Network, estimate: Estimate) -> float:
    v = reprojection(network, estimate)
    assert len(v) == len(network.image_points)
    return float(np.sqrt((v**2).mean()))


@pytest.mark.parametrize("model", MODELS)
def test_colmap_projects_to_our_pixels_plus_a_half(model: str, tmp_path: Path) -> None:
    network, truth = scene(model, noise_px=0.0)
    write_model(tmp_path / "model", network, truth)
    read = pycolmap.Reconstruction(tmp_path / "model")
    image = read.image(1)
    assert image.name == network.images[0]
    for k in range(image.num_points2D()):
        point = image.points2D[k]
        computed = image.project_point(read.point3D(point.point3D_id).xyz)
        np.testing.assert_allclose(computed, point.xy, atol=1e-9)
        np.testing.assert_allclose(point.xy, network.image_points.xy[k] + 0.5, atol=1e-12)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_model_round_trip_to_the_last_digit(model: str, text: bool, tmp_path: Path) -> None:
    network, truth = scene(model, cameras=2)
    names = ("täst 1.jpg", *network.images[1:])
    network = replace(network, images=names)
    write_model(tmp_path / "a b", network, truth, text=text)
    again, estimate = read_model(tmp_path / "a b")
    assert again.images == names
    assert again.points == network.points
    assert [c.name for c in estimate.cameras] == [c.name for c in truth.cameras]
    np.testing.assert_array_equal(again.camera, network.camera)
    np.testing.assert_array_equal(again.image_points.image, network.image_points.image)
    np.testing.assert_array_equal(again.image_points.point, network.image_points.point)
    # Half a pixel more and less costs the last bit of 2000 px; rotations go through a quaternion.
    np.testing.assert_allclose(again.image_points.xy, network.image_points.xy, atol=1e-12)
    np.testing.assert_array_equal(estimate.points, truth.points)
    np.testing.assert_allclose(estimate.rotation, truth.rotation, atol=1e-15)
    np.testing.assert_allclose(estimate.position, truth.position, atol=1e-14)
    for a, b in zip(estimate.cameras, truth.cameras, strict=True):
        np.testing.assert_allclose(a.parameters, b.parameters, rtol=1e-15, atol=1e-12)
        np.testing.assert_array_equal(a.free, b.free)
        np.testing.assert_array_equal(a.pixel_mm, b.pixel_mm)
        assert (a.model, a.size_px) == (b.model, b.size_px)


def test_written_model_has_the_reprojection_rms_in_colmap(tmp_path: Path) -> None:
    network, truth = scene()
    write_model(tmp_path, network, truth)
    read = pycolmap.Reconstruction(tmp_path)
    squares = [
        (image.project_point(read.point3D(p.point3D_id).xyz) - p.xy) ** 2
        for image in read.images.values()
        for p in image.points2D
    ]
    assert np.sqrt(np.mean(squares)) == pytest.approx(rms(network, truth), abs=1e-9)
    errors = [np.sqrt(s.sum()) for s in squares]
    assert read.compute_mean_reprojection_error() == pytest.approx(np.mean(errors), abs=1e-9)


def test_rejected_image_points_are_keypoints_without_a_point(tmp_path: Path) -> None:
    network, truth = scene()
    rejected = np.zeros(len(network.image_points), dtype=bool)
    rejected[3] = True
    write_model(tmp_path, network, truth, rejected=rejected)
    read = pycolmap.Reconstruction(tmp_path)
    i = int(network.image_points.image[3]) + 1
    assert not read.image(i).points2D[3].has_point3D()
    assert len(read_model(tmp_path)[0].image_points) == len(network.image_points) - 1


def test_photographs_without_orientation_are_left_out(tmp_path: Path) -> None:
    network, truth = scene()
    position = truth.position.copy()
    position[2] = np.nan
    write_model(tmp_path, network, replace(truth, position=position))
    again, _ = read_model(tmp_path)
    assert again.images == network.images[:2] + network.images[3:]


@pytest.mark.parametrize("gauge", ["two_cameras", "free"])
@pytest.mark.parametrize("cameras", [1, 2])
def test_noise_free_network_is_solved_exactly(gauge: str, cameras: int) -> None:
    network, truth = scene(cameras=cameras, noise_px=0.0)
    start = perturb(truth, seed_of("colmap start"), c=0.01)
    found = adjust_with_colmap(network, start, gauge=gauge)
    assert found.converged
    assert found.rms_px < 1e-9
    for a, b in zip(found.estimate.cameras, truth.cameras, strict=True):
        np.testing.assert_allclose(a.parameters, b.parameters, rtol=1e-8, atol=1e-8)


def test_gauge_leaves_the_optimum_alone() -> None:
    network, truth = scene()
    start = perturb(truth, seed_of("colmap gauge"))
    a = adjust_with_colmap(network, start, gauge="two_cameras")
    b = adjust_with_colmap(network, start, gauge="free")
    assert a.cost == pytest.approx(b.cost, rel=1e-12)
    np.testing.assert_allclose(a.residuals, b.residuals, atol=1e-8)  # px; how near Ceres gets varies by CPU
    assert a.rms_px == pytest.approx(rms(network, a.estimate), abs=1e-12)
    np.testing.assert_allclose(
        a.estimate.position[0], start.position[0], atol=1e-12
    )  # what two_cameras holds
    assert np.abs(b.estimate.position[0] - start.position[0]).max() > 1e-6


def test_control_is_held() -> None:
    network, truth = scene()
    control = ObjectPoints(np.arange(4), truth.points[:4], np.zeros((4, 3, 3)))
    start = perturb(truth, seed_of("colmap control"))
    start.points[:4] = truth.points[:4]
    found = adjust_with_colmap(network.with_given(control), start, gauge="control")
    np.testing.assert_array_equal(found.estimate.points[:4], truth.points[:4])
    assert np.abs(found.estimate.points - truth.points).max() < 0.01
    weighted = replace(control, covariance=np.tile(np.eye(3) * 1e-6, (4, 1, 1)))
    with pytest.raises(BackendError, match="control with standard deviations"):
        adjust_with_colmap(network.with_given(weighted), start, gauge="control")


def test_covariance_of_poses_is_that_of_colmap_in_the_same_gauge() -> None:
    """COLMAP's is of delta and t for R' = exp(2 delta) R, x_camera = R X + t, with five points held."""
    network, truth = scene()
    network = network.with_given(ObjectPoints(np.arange(5), truth.points[:5], np.zeros((5, 3, 3))))
    a = adjust(network, truth, datum=Datum("control"), reject="none")
    backend = colmap.load_pycolmap()
    free = colmap.colmap_free(a.estimate.cameras)
    options = colmap.ceres_options(backend, free, len(network.images), 1, 1)
    model = colmap.reconstruction(backend, network, a.estimate)
    config = colmap.adjustment_config(backend, network, a.estimate, "control")
    adjuster = backend.create_default_ceres_bundle_adjuster(options, config, model)
    wanted = backend.BACovarianceOptions()
    wanted.damping = 0.0
    covariances = backend.estimate_ba_covariance(wanted, model, adjuster)
    step = 1e-6
    for i, ours in enumerate(a.covariance.exterior / (a.sigma0 * a.sigma_px) ** 2):
        pose = model.image(i + 1).cam_from_world()
        R, t = pose.rotation.matrix(), pose.translation
        to_ours = np.zeros((6, 6))  # dX0 = -R'dt - 2 R'[t] delta; turn in the object system -2 R'delta
        to_ours[:3, 3:], to_ours[:3, :3], to_ours[3:, :3] = -R.T, -2 * R.T @ skew(t), -2 * R.T
        angles = angles_from_rotation(a.estimate.rotation[i])
        of_angles = np.eye(6)  # turn in the object system by each angle, from central differences
        for k, shift in enumerate(step * np.eye(3)):
            turned = rotation_from_angles(*(angles + shift)) @ rotation_from_angles(*(angles - shift)).T
            of_angles[3:, 3 + k] = Rotation.from_matrix(turned).as_rotvec() / (2 * step)
        theirs = to_ours @ np.array(covariances.get_cam_cov_from_world(i + 1)) @ to_ours.T
        ours = of_angles @ ours @ of_angles.T
        sigma = np.sqrt(np.diagonal(theirs))
        np.testing.assert_allclose(ours / np.outer(sigma, sigma), theirs / np.outer(sigma, sigma), atol=1e-6)


def test_principal_point_is_free_only_when_asked() -> None:
    network, truth = scene(noise_px=0.0)
    camera = truth.cameras[0]
    held = np.array([name not in ("cx", "cy") for name in camera.names])
    shifted = camera.parameters + 2.0 * ~held
    start = replace(truth, cameras=(replace(camera.with_parameters(shifted), free=held),))
    found = adjust_with_colmap(network, start)
    np.testing.assert_allclose(found.estimate.cameras[0].parameters[~held], shifted[~held], atol=1e-12)
    freed = adjust_with_colmap(network, replace(start, cameras=(camera.with_parameters(shifted),)))
    np.testing.assert_allclose(freed.estimate.cameras[0].parameters, camera.parameters, atol=1e-6)
    assert found.rms_px > 1e-3 > 1e3 * freed.rms_px  # so that holding it made a difference


def test_fixed_cameras_stay_and_partly_free_groups_are_refused() -> None:
    network, truth = scene(cameras=2)
    first, second = truth.cameras
    fixed = replace(first, free=np.zeros(8, dtype=bool))
    found = adjust_with_colmap(network, replace(truth, cameras=(fixed, second)))
    np.testing.assert_allclose(found.estimate.cameras[0].parameters, first.parameters, atol=1e-12)
    assert np.abs(found.estimate.cameras[1].parameters - second.parameters).max() > 1e-6
    part = replace(first, free=np.array([1, 1, 1, 1, 1, 0, 1, 1], dtype=bool))
    with pytest.raises(BackendError, match="camera 1: its distortion is partly free"):
        adjust_with_colmap(network, replace(truth, cameras=(part, second)))
    other = replace(first, free=np.array([1, 1, 0, 0, 0, 0, 0, 0], dtype=bool))
    with pytest.raises(BackendError, match="different free parameters"):
        adjust_with_colmap(network, replace(truth, cameras=(other, second)))


def test_nothing_reaches_the_terminal(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    network, truth = scene()
    adjust_with_colmap(network, truth)
    (tmp_path / "cameras.bin").write_bytes(b"not a model")
    with pytest.raises(SurveyFileError):
        read_model(tmp_path)
    out = capfd.readouterr()
    assert (out.out, out.err) == ("", "")


def test_refusals_name_what_was_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network, truth = scene()
    brown = camera_from_values("nikon", "brown", (2000, 1500), (0.005, 0.005), c_mm=10.0)
    with pytest.raises(BackendError, match="camera nikon: COLMAP has no model brown"):
        write_model(tmp_path, network, replace(truth, cameras=(brown,)))
    with pytest.raises(BackendError, match="gauge 'inner', expected one of"):
        adjust_with_colmap(network, truth, gauge="inner")
    with pytest.raises(SurveyFileError, match="no COLMAP model"):
        read_model(tmp_path / "nothing")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_model(tmp_path / "file" / "model", network, truth)
    monkeypatch.setattr(colmap, "NEEDED_VERSION", (9, 9))
    with pytest.raises(BackendError, match=r"pycolmap 4\.\d.* is installed, 9\.9 is needed"):
        read_model(tmp_path)


def test_photographs_have_rigs_and_frames_of_their_own(tmp_path: Path) -> None:
    network, truth = scene(cameras=2)
    write_model(tmp_path, network, truth)
    read = pycolmap.Reconstruction(tmp_path)
    assert (read.num_rigs(), read.num_frames(), read.num_reg_images()) == (2, 8, 8)
    for i, image in read.images.items():
        assert image.frame_id == i
        assert read.frame(image.frame_id).rig_id == image.camera_id


def test_colmaps_covariance_of_points_is_conditional() -> None:
    network, truth = scene()
    adjustment = adjust(network, truth, datum=Datum("free"), reject="none")
    found = covariance_with_colmap(network, adjustment.estimate)
    assert found is not None
    variance = (adjustment.sigma0 * adjustment.sigma_px) ** 2
    limiting, interior = adjustment.covariance.points_limiting, adjustment.covariance.interior[0]
    np.testing.assert_allclose(found.points * variance, limiting, rtol=1e-6, atol=1e-6 * limiting.max())
    np.testing.assert_allclose(found.interior[0] * variance, interior, rtol=1e-5, atol=1e-5 * interior.max())
    # Held cameras against cameras with an orientation to be determined, in a datum on four of the points
    carrying = np.zeros(len(network.points), dtype=bool)
    carrying[:4] = True
    local = adjust(network, truth, datum=Datum("free", carrying), reject="none")
    ratio = np.trace(local.covariance.points[4:], axis1=1, axis2=2) / np.trace(limiting[4:], axis1=1, axis2=2)
    assert ratio.min() > 1.1


def test_points_behind_a_camera_are_not_called_a_success() -> None:
    """Ceres gives them no residual: without this the cost would seem to be lower."""
    network, truth = scene()
    points = truth.points.copy()
    points[0] = truth.position[0] + 5 * truth.rotation[0][:, 2]  # behind the first photograph
    found = adjust_with_colmap(network, replace(truth, points=points), max_iterations=0, polish=False)
    assert not found.converged
    assert "behind their camera" in found.message
    assert np.isnan(found.cost)


DATA = ROOT.parent / "shared" / "data"
PHOTOGRAPHS = DATA / "retro-panel" / "images"


def test_photographs_without_texture_give_no_model(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name in ("a.png", "b c.png"):
        cv2.imwrite(str(tmp_path / name), np.full((120, 160), 128, dtype=np.uint8))
    with pytest.raises(BackendError, match="COLMAP's mapper found no model"):
        map_photographs(tmp_path, (("a.png", "b c.png"),), threads=1)
    out = capfd.readouterr()
    assert (out.out, out.err) == ("", "")


@pytest.mark.slow
@pytest.mark.skipif(
    not PHOTOGRAPHS.is_dir(), reason="photographs of retro-panel are not beside the repository"
)
@pytest.mark.parametrize("at_once", [False, True])
def test_retro_panel_is_oriented_by_colmaps_own_pipeline(at_once: bool) -> None:
    names = sorted(path.name for path in PHOTOGRAPHS.glob("*.tif"))
    cameras = tuple(tuple(n for n in names if n.startswith(key)) for key in ("043", "671"))
    found = map_photographs(PHOTOGRAPHS, cameras, at_once=at_once)
    assert found.total == 8
    assert len(found.network.images) == 8
    assert 0.1 < found.rms_px < 0.5  # 0.31 px when written
    assert len(found.estimate.cameras) == 2


@pytest.mark.slow
@pytest.mark.skipif(
    not (DATA / "camcal").is_dir(), reason="photographs of camcal are not beside the repository"
)
def test_camcal_beside_colmaps_own_pipeline() -> None:
    """All photographs get oriented by texture too, but the targets lie several times their sigma away."""
    survey = read_survey(ROOT / "datasets" / "camcal" / "survey.toml")
    result = run_survey(
        survey,
        images_dir=DATA / "camcal" / "images",
        jobs=2,
        others=OtherPrograms(adjust_with_colmap, map_photographs),
    )
    found = result.baseline
    assert result.comparison is not None and result.comparison.agree
    assert found is not None and found.photographs == (21, 21) and found.targets == 100
    assert found.rms_px[0] < 0.14 < 0.4 < found.rms_px[1] < 0.8  # 0.114 and 0.600 px when written
    assert 50e-6 < found.point_rms < 600e-6  # 255 micrometres when written
