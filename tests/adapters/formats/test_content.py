"""Round trips of random surveys through every format: what is lost is what is named, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.content import KINDS, Content, losses
from adapters.formats.registry import FORMATS, format_named, read_content, write_content
from sfm.adjustment.result import Adjustment
from sfm.adjustment.solve import adjust
from sfm.cli.commands.convert import convert
from sfm.model.camera import Camera
from sfm.model.distortion.models import Role
from sfm.model.errors import SurveyFileError
from sfm.model.network import (
    ExteriorObservations,
    ImagePoints,
    InteriorObservations,
    ObjectPoints,
    ScaleBars,
)
from sfm.model.solution import Solution
from sfm.pipeline import run_survey
from sfm.survey.inputs.survey import read_survey
from tests.rigs import make_rig
from tests.synthetic import make_network, seed_of

READABLE = tuple(form.name for form in FORMATS if form.readable and form.writable)
SEVERAL = tuple(name for name in READABLE if not name.startswith("bundle-"))  # of more than one camera
MODEL_OF = {"bal": "radial", "photomodeler": "brown_dbat", "metashape": "opencv", "sba": "opencv"}
MODEL_OF |= {"opensfm": "opencv", "nerfstudio": "opencv", "alicevision": "opencv", "bundler": "radial"}
MODEL_OF |= {"nvm": "brown", "openmvg": "brown_forward", "micmac": "brown_forward"}
MODEL_OF |= {"aicon": "brown_forward", "realitycapture": "brown_forward"}
STATED = ("bundle-csharp", "aicon")  # whose files want standard deviations of image points
IMAGES, POINTS = 5, 12


def chance(rng: np.random.Generator) -> bool:
    return bool(rng.random() < 0.6)


def covariances(rng: np.random.Generator, count: int, size: int, *, diagonal: bool = False) -> np.ndarray:
    A = 0.01 * rng.standard_normal((count, size, size))
    C = A @ A.transpose(0, 2, 1) + 1e-6 * np.eye(size)
    return C * np.eye(size) if diagonal else C


def model_of(form: str) -> str:
    return MODEL_OF.get(form, "brown" if form.startswith("bundle") else "full_opencv")


def lens_of(form: str, camera: Camera) -> Camera:
    """A camera without what a format cannot hold of its model."""
    focal = camera.plays(*[role for role in Role if "FOCAL" in role.name])
    centre = {"cx": 999.5, "cy": 749.5}
    names, values = camera.names, camera.parameters
    if form in ("sba", "bundle-matlab", "bundle-csharp"):
        rows = zip(names, values, focal, strict=True)
        values = np.array([value if kept else centre.get(name, 0.0) for name, value, kept in rows])
    if form == "photomodeler":
        values = np.where(np.isin(names, ["b1", "b2"]), 0.0, values)
    if form in ("nvm", "openmvg", "aicon", "realitycapture"):
        values = np.where(np.isin(names, format_named(form).lacks), 0.0, values)
    return camera.with_parameters(values)


def survey(form: str, rng: np.random.Generator) -> Content:
    """A random survey whose camera and image points a format can hold, and of all else a random part."""
    network, truth = make_network(rng, images=IMAGES, points=POINTS, model=model_of(form), cameras=1)
    camera = lens_of(form, truth.cameras[0])
    camera = replace(camera, free=camera.free & (rng.random() < 0.5))
    if form == "photomodeler" and chance(rng):  # a calibration project
        camera = replace(camera, free=np.array([name != "b2" for name in camera.names]))
    truth = replace(truth, cameras=(camera,))
    images = tuple(f"image{i + 1}.jpg" for i in range(IMAGES))
    seen = network.image_points
    if chance(rng) or form in STATED:
        C = covariances(rng, len(seen), 2, diagonal=chance(rng))
        seen = replace(seen, covariance=C, stated=np.ones(len(seen), dtype=bool))
    else:
        seen = replace(
            seen, covariance=np.tile(np.eye(2), (len(seen), 1, 1)), stated=np.zeros(len(seen), dtype=bool)
        )
    chosen = rng.permutation(POINTS)
    network = replace(network, images=images, image_points=seen)
    if chance(rng):
        C = covariances(rng, 4, 3, diagonal=chance(rng))
        if chance(rng):
            C[0] = np.diag([1e-4, np.inf, 1e-4])
        C[1] *= rng.integers(0, 2)  # fixed
        network = network.with_given(ObjectPoints(chosen[:4], truth.points[chosen[:4]] + 0.01, C))
    if chance(rng):
        length, sigma = rng.uniform(0.5, 2, 2), rng.uniform(1e-4, 1e-3, 2)
        network = network.with_given(ScaleBars(chosen[4:6], chosen[6:8], length, sigma))
    if chance(rng):
        C = covariances(rng, 2, 6, diagonal=chance(rng))
        if chance(rng):
            C[:, 3:, 3:] = np.diag([np.inf] * 3)
            C[:, :3, 3:] = C[:, 3:, :3] = 0.0
        angles = rng.uniform(-1, 1, (2, 3))
        exterior = ExteriorObservations(np.array([1, 3]), truth.position[[1, 3]], angles, C)
        network = network.with_given(exterior)
    if camera.free.any() and chance(rng):
        own = np.flatnonzero(camera.free)[:2]
        R = np.array([[1, 0.3], [0.3, 1]]) if chance(rng) and len(own) == 2 else None
        found = InteriorObservations(
            np.zeros(len(own), dtype=np.int64), own, camera.parameters[own] + 1e-3, np.full(len(own), 1e-2), R
        )
        network = network.with_given(found)
    joint = covariances(rng, 1, 3 * POINTS)[0] if chance(rng) else None
    marginal = covariances(rng, POINTS, 3, diagonal=True) if chance(rng) else None
    if joint is not None:
        blocks = joint.reshape(POINTS, 3, POINTS, 3)[np.arange(POINTS), :, np.arange(POINTS)]
        marginal = blocks * np.eye(3)
    exterior_covariance = covariances(rng, IMAGES, 6) if chance(rng) else None
    position = None if exterior_covariance is None else exterior_covariance[:, :3, :3] * np.eye(3)
    sigma = np.where(camera.free, 0.01, np.nan)
    count = int(camera.free.sum())
    known = bool(count) and chance(rng)
    result = Solution(
        *("survey", network, truth, marginal, position),
        interior_sigma=(sigma,) if known else None,
        redundancy=int(rng.integers(10, 99)) if chance(rng) else None,
        unit=str(rng.choice(["", "mm", "m"])),
        covariance=joint,
        datum=str(rng.choice(["", "free", "control"])),
        exterior_covariance=exterior_covariance,
        interior_covariance=tuple(covariances(rng, 1, count)) if known else (),
    )
    checks = ObjectPoints(chosen[8:10], truth.points[chosen[8:10]], covariances(rng, 2, 3, diagonal=True))
    bad = ImagePoints(
        *(np.array([0, 1]), chosen[10:12], rng.uniform(0, 1000, (2, 2))),
        *(np.tile(np.eye(2), (2, 1, 1)), np.zeros(2, dtype=bool)),
    )
    drop = (seen.image[:, None] * POINTS + seen.point[:, None] == bad.image * POINTS + bad.point).any(axis=1)
    with_bad = chance(rng) and form != "bundle-csharp"
    if with_bad:
        network = replace(network, image_points=seen.select(~drop))
    return Content(
        replace(result, network=network),
        **({"rejected": bad} if with_bad else {}),
        **({"checks": checks} if chance(rng) else {}),
        sigma0=float(rng.uniform(0.5, 2)) if chance(rng) else None,
    )


def run_of(content: Content, folder: Path) -> Adjustment:
    write_content(folder, "tables", content)
    return run_survey(read_survey(folder / "survey.toml")).adjustment


@pytest.mark.parametrize("unit", ["mm", "nm"])
def test_tables_are_a_survey_with_all_that_was_given(unit: str, tmp_path: Path) -> None:
    """Written, adjusted as they are, and in the unit that was known: nothing that took part is missing."""
    network, truth = make_network(seed_of("whole survey"), images=6, points=20, free=("c", "x0", "y0", "K1"))
    sigma = np.tile(np.eye(3) * 1e-8, (4, 1, 1))
    exterior = np.diag([1e-6] * 3 + [np.inf] * 3)
    network = network.with_given(
        ObjectPoints(np.arange(4), truth.points[:4], sigma),
        ExteriorObservations(np.array([0]), truth.position[[0]], np.zeros((1, 3)), exterior[None]),
        InteriorObservations(np.array([0]), np.array([0]), truth.cameras[0].parameters[:1], np.array([1e-3])),
        ScaleBars(
            np.array([5]),
            np.array([6]),
            np.linalg.norm(truth.points[[5]] - truth.points[[6]], axis=1),
            np.array([1e-4]),
        ),
    )
    checks = ObjectPoints(np.array([8, 9]), truth.points[8:10], sigma[:2])
    content = Content(Solution("whole", network, truth, unit=unit, datum="control"), checks=checks)
    a = run_of(content, tmp_path / "out")
    survey = read_survey(tmp_path / "out" / "survey.toml")
    assert (survey.unit, survey.datum.kind) == (unit, "control")
    assert survey.control is not None and survey.control.check is not None and survey.control.check.sum() == 6
    b = adjust(network, truth, datum="control", reject="none")
    assert (len(a.network.scale_bars), len(a.network.exterior), len(a.network.interior)) == (1, 1, 1)
    assert a.redundancy == b.redundancy
    np.testing.assert_allclose(a.estimate.points, b.estimate.points, atol=1e-5)  # other weights


def test_cameras_of_single_photographs_share_what_they_shared(tmp_path: Path) -> None:
    """One with c of every photograph: not as many free cameras as there are photographs."""
    network, truth = make_network(seed_of("own c"), images=6, points=25, cameras=6, free=("c", "K1"))
    names = truth.cameras[0].names
    shared = tuple("" if name == "c" else "lens" for name in names)
    cameras = tuple(
        replace(camera, name=f"lens {image}", shared=shared)
        for camera, image in zip(truth.cameras, network.images, strict=True)
    )
    truth = replace(truth, cameras=cameras)
    a = run_of(Content(Solution("own", network, truth, datum="free")), tmp_path / "out")
    b = adjust(network, truth, reject="none")
    assert a.redundancy == b.redundancy == 2 * len(network.image_points) - 6 * 6 - 3 * 25 - 6 - 1 + 7
    assert [camera.name for camera in a.estimate.cameras] == [camera.name for camera in cameras]
    again = read_content(tmp_path / "out")
    assert [camera.shared for camera in again.result.estimate.cameras] == [shared] * 6


def test_rejected_points_come_back_as_rejected_and_are_found_again(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("rejected"), images=6, points=20, free=())
    xy = network.image_points.xy.copy()
    xy[7] += 30.0
    a = adjust(replace(network, image_points=replace(network.image_points, xy=xy)), truth, reject="tau")
    assert np.flatnonzero(a.rejected).tolist() == [7]
    seen = a.network.image_points
    content = Content(
        Solution("r", replace(network, image_points=seen.select(~a.rejected)), a.estimate),
        rejected=seen.select(a.rejected),
    )
    again = run_of(content, tmp_path / "out")
    assert again.rejected.sum() == 1 and again.redundancy == a.redundancy
    assert len(read_content(tmp_path / "out").rejected) == 1


def test_what_has_no_coordinates_is_named_where_it_goes(tmp_path: Path) -> None:
    content = survey("tables", seed_of("unplaced"))
    result = content.result
    position, points = result.estimate.position.copy(), result.estimate.points.copy()
    position[2], points[4] = np.nan, np.nan
    estimate = replace(result.estimate, position=position, points=points)
    content = replace(content, result=replace(result, estimate=estimate))
    for form in ("tables", "colmap-text"):
        named = {kind.name: count for kind, count in losses(content, format_named(form).keeps)}
        assert named["unplaced"] == 2
        write_content(tmp_path / form, form, content)
        again = read_content(tmp_path / form).result
        assert (len(again.network.images), len(again.network.points)) == (IMAGES - 1, POINTS - 1)
    C = read_content(tmp_path / "tables").result.exterior_covariance
    assert (C is None) == (content.result.exterior_covariance is None)


def test_convert_names_each_kind_that_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    network, truth = make_network(seed_of("named"), images=5, points=12, model="opencv")
    bar = ScaleBars(np.array([0]), np.array([1]), np.array([1.0]), np.array([1e-4]))
    network = network.with_control(["1", "2"], truth.points[:2]).with_given(bar)
    content = Content(Solution("x", network, truth, unit="mm", datum="free", redundancy=7))
    write_content(tmp_path / "in", "tables", content)
    convert(tmp_path / "in", tmp_path / "out.xml")
    lost = losses(content, format_named("metashape").keeps)
    told = capsys.readouterr().out.splitlines()[-3:]
    assert len(lost) >= 5 and all(line.startswith(f"{tmp_path / 'out.xml'}: ") for line in told)
    assert all(any(f"{count} {kind.words}" in line for line in told) for kind, count in lost)
    convert(tmp_path / "in", tmp_path / "again.xml", verbose=True)
    told = [line for line in capsys.readouterr().out.splitlines() if "left out" in line]
    assert len(told) == len(lost)
    convert(tmp_path / "in", tmp_path / "same", to_format="tables")
    assert "left out" not in capsys.readouterr().out
    assert (tmp_path / "same" / "given.csv").read_text() == (tmp_path / "in" / "given.csv").read_text()
    # another model of the camera: what was estimated of the former one goes, and is named
    seen = replace(content.result, interior_sigma=(np.where(truth.cameras[0].free, 0.1, np.nan),))
    write_content(tmp_path / "sigma", "tables", replace(content, result=seen))
    convert(tmp_path / "sigma", tmp_path / "pm", to_format="photomodeler")
    assert "standard deviations of interior parameters left out" in capsys.readouterr().out


def in_order_of(before: Content, after: Content) -> Content:
    """The survey as it was read, with its points in the order in which they were written."""
    names, read = before.result.network.points, after.result.network.points
    if names == read or set(names) != set(read):
        return after
    of_read = np.array([names.index(name) for name in read])
    network, estimate = after.result.network, after.result.estimate
    seen, control = network.image_points, network.control
    network = replace(
        network.with_given(control.renumbered(of_read)),
        points=names,
        image_points=replace(seen, point=of_read[seen.point]),
    )
    estimate = replace(estimate, points=estimate.points[np.argsort(of_read)])
    return replace(after, result=replace(after.result, network=network, estimate=estimate))


@pytest.mark.parametrize("form", READABLE)
def test_what_is_lost_is_what_is_named(form: str, tmp_path: Path) -> None:
    for trial in range(12):
        content = survey(form, seed_of(f"content {form} {trial}"))
        assert_lost_as_named(content, form, tmp_path / f"{trial}")


def rig_survey(form: str, rng: np.random.Generator) -> Content:
    """A random survey of two to four cameras on a rig, some with held mounts, the last perhaps on no rig."""
    count = int(rng.integers(2, 5))
    network, truth = make_rig(rng, cameras=count, moments=4, points=POINTS)
    shared = make_network(rng, images=2, points=4, model=model_of(form), cameras=1)[1].cameras[0]
    cameras = tuple(replace(lens_of(form, shared), name=f"camera{k + 1}") for k in range(count))
    assert truth.mounts is not None and network.moment is not None
    mounts, alone = truth.mounts, np.full(count, False)
    if count > 2 and chance(rng):  # the last camera is on no rig
        alone[-1] = True
    names = tuple("" if off else "rig" for off in alone)
    free = mounts.free & ~alone[:, None]
    if chance(rng):
        free[1] = False
    position = np.where(alone[:, None], 0.0, mounts.position)
    rotation = np.where(alone[:, None, None], np.eye(3), mounts.rotation)
    moment = np.where(alone[network.camera], 4 + np.arange(len(network.camera)), network.moment)
    seen, images = network.image_points, tuple(f"image{i + 10}.jpg" for i in range(len(network.images)))
    seen = replace(
        seen, covariance=np.tile(np.eye(2), (len(seen), 1, 1)), stated=np.zeros(len(seen), dtype=bool)
    )
    if form in STATED:
        seen = replace(seen, stated=np.ones(len(seen), dtype=bool))
    network = replace(network, images=images, image_points=seen, moment=moment)
    truth = replace(
        truth,
        cameras=cameras,
        mounts=replace(mounts, position=position, rotation=rotation, free=free, rig=names),
    )
    return Content(Solution("survey", network, truth))


@pytest.mark.parametrize("form", SEVERAL)
def test_rigs_come_back_or_are_named(form: str, tmp_path: Path) -> None:
    for trial in range(6):
        content = rig_survey(form, seed_of(f"rig content {form} {trial}"))
        assert_lost_as_named(content, form, tmp_path / f"{trial}")


def assert_lost_as_named(content: Content, form: str, path: Path) -> None:
    """Write and read a survey, and compare all its numbers but those of the kinds that are named as lost."""
    write_content(path, form, content)
    again = in_order_of(content, read_content(path, form))
    named = {kind.name for kind, _ in losses(content, format_named(form).held(content))}
    for kind in KINDS:
        if kind.name == "unplaced" and "object points" in named:
            continue
        before, after = kind.rows(content), kind.rows(again)
        if kind.name in named:
            same = before.shape == after.shape and np.allclose(before, after, equal_nan=True)
            assert not same or kind.name == "free", kind.name
        elif kind.name != "free" or len(before):
            assert before.shape == after.shape, (kind.name, path.name)
            np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-12, err_msg=kind.name)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(path.read_bytes()[:50]),
        lambda path: path.write_text("no arrays"),
        lambda path: np.savez(path, image_names=np.array(["other"]), exterior=np.zeros((1, 6, 6))),
        lambda path: np.savez(path, exterior=np.array([{"a": 1}], dtype=object)),
    ],
)
def test_damaged_covariances_are_refused(damage: Callable[[Path], None], tmp_path: Path) -> None:
    network, truth = make_network(seed_of("damaged"), images=IMAGES, points=POINTS)
    C = covariances(seed_of("damaged C"), IMAGES, 6)
    write_content(tmp_path / "t", "tables", Content(Solution("x", network, truth, exterior_covariance=C)))
    again = read_content(tmp_path / "t")
    np.testing.assert_array_equal(again.result.exterior_covariance, C)
    damage(tmp_path / "t" / "covariances.npz")
    with pytest.raises(SurveyFileError, match=r"covariances\.npz"):
        read_content(tmp_path / "t")
