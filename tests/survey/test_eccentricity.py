"""Surveys of large oblique targets: object points biased without the correction, unbiased with it."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

import sfm.pipeline as pipeline
from sfm.judgement.survey_result import SurveyResult
from sfm.model.camera import Camera, camera_from_values, project
from sfm.model.conventions import FloatArray
from sfm.model.errors import SurveyFileError
from sfm.model.remarks.remark import of_kind
from sfm.model.similarity import fit_similarity
from sfm.survey.inputs.given_values import read_diameters
from sfm.survey.inputs.measurements import MeasuredPhotographs
from sfm.survey.inputs.survey import read_survey
from sfm.targets.detect import Targets
from tests.outlines import moments_of_area

C_PX, DISTANCE_MM, TILT = 4000.0, 600.0, np.radians(60)
CAMERA: Camera = camera_from_values("c", "brown", (4000, 3000), (0.005, 0.005), c_mm=20.0, free=("c",))
LARGE_MM, SMALL_MM = 60 * DISTANCE_MM / C_PX, 8 * DISTANCE_MM / C_PX  # diameters: 60 and 8 px
NOISE_PX = 0.01  # of centres and semi-axes

SURVEY = """\
[survey]
name = "large"
unit = "mm"
[[camera]]
name = "c"
images = "*.png"
free = ["c"]
[targets]
codes = "ring14"
{targets}
[adjust]
sigma_px = 0.01
[compare]
backend = "none"
"""


def places() -> tuple[FloatArray, FloatArray]:
    """Return the centres of level targets at different heights, (40, 3), and their diameters, (40,), mm."""
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(np.linspace(-160, 160, 8), np.linspace(-120, 120, 5))
    centres = np.column_stack([x.ravel(), y.ravel(), rng.uniform(-25, 25, x.size)])
    return centres, np.where(np.arange(x.size) % 3 == 0, LARGE_MM, SMALL_MM)


def stations() -> tuple[FloatArray, FloatArray]:
    """Return eight cameras that see level targets at 60 degrees, rolled by turns."""
    azimuth = 2 * np.pi * np.arange(8) / 8
    z = np.column_stack([np.sin(TILT) * np.cos(azimuth), np.sin(TILT) * np.sin(azimuth), np.full(8, 0.5)])
    rotations = []
    for i in range(8):
        x = np.array([-np.sin(azimuth[i]), np.cos(azimuth[i]), 0.0])
        y, roll = np.cross(z[i], x), np.pi / 2 * (i % 4)
        turned = np.cos(roll) * x + np.sin(roll) * y
        rotations.append(np.column_stack([turned, np.cross(z[i], turned), z[i]]))
    return DISTANCE_MM * z, np.array(rotations)


def ellipse_of(outline: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return centre, semi-axes and angle of a closed outline by its moments of area."""
    centre, second = moments_of_area(outline)
    value, axes = np.linalg.eigh(second)
    return centre, 2 * np.sqrt(value[::-1]), float(np.arctan2(axes[1, 1], axes[0, 1]))


@lru_cache
def photographs(seed: int) -> MeasuredPhotographs:
    """Return what eight photographs of perfect circles show: exact ellipses and a little noise."""
    rng = np.random.default_rng(seed)
    centres, diameter = places()
    positions, rotations = stations()
    t = 2 * np.pi * np.arange(720) / 720
    circle = np.column_stack([np.cos(t), np.sin(t), np.zeros(720)])
    k = len(centres)
    found = []
    for X0, R in zip(positions, rotations, strict=True):
        seen = [
            ellipse_of(project(CAMERA, X0, R, X + d / 2 * circle))
            for X, d in zip(centres, diameter, strict=True)
        ]
        xy, axes, angle = (np.array(column) for column in zip(*seen, strict=True))
        assert 2 * axes[diameter == LARGE_MM, 0] == pytest.approx(60, rel=0.5)
        one, none = np.ones(k), np.zeros((0, 2))
        found.append(
            Targets(
                xy=xy + NOISE_PX * rng.standard_normal((k, 2)),
                covariance=np.tile(1e-8 * np.eye(2), (k, 1, 1)),  # the survey's sigma_px is all there is
                axes_covariance=np.tile(NOISE_PX**2 * np.eye(3), (k, 1, 1)),
                edge_covariance=np.tile(np.eye(3), (k, 1, 1)),
                semi_axes=axes + NOISE_PX * rng.standard_normal((k, 2)),
                angle=angle,
                code=np.arange(1, k + 1),
                confidence=one,
                polarity=-np.ones(k, dtype=np.int64),
                contrast=-100 * one,
                background=200 * one,
                blur=0.7 * one,
                noise=one,
                flag=np.zeros(k, dtype=np.int64),
                rejected_xy=none,
                rejected_flag=np.zeros(0, dtype=np.int64),
            )
        )  # fmt: skip
    names = tuple(f"{i}.png" for i in range(8))
    paths = tuple(Path(name) for name in names)
    return MeasuredPhotographs(names, paths, np.zeros(8, dtype=np.int64), (CAMERA,), tuple(found), ())


def surveyed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, targets: str, seed: int = 1) -> SurveyResult:
    """Run all stages of a survey behind the measurement."""
    (tmp_path / "survey.toml").write_text(SURVEY.format(targets=targets), encoding="utf-8")
    measured = photographs(seed)
    for name in measured.names:
        (tmp_path / name).touch()
    monkeypatch.setattr("sfm.survey.target_network.measure_photographs", lambda *given, **more: measured)
    return pipeline.run_survey(read_survey(tmp_path / "survey.toml"))


def normalised(result: SurveyResult) -> tuple[FloatArray, FloatArray]:
    """Return the errors in Z of large targets on the frame of the small ones over their sigma, and of all."""
    centres, diameter = places()
    a = result.adjustment
    rows = np.array([int(name) - 1 for name in a.network.points])
    truth, small = centres[rows], diameter[rows] == SMALL_MM
    placed = fit_similarity(a.estimate.points[small], truth[small])
    error = (placed.apply(a.estimate.points) - truth)[:, 2]
    up = placed.rotation[2]
    sigma = placed.scale * np.sqrt(np.einsum("i,nij,j->n", up, a.covariance.points, up))
    return (error / sigma)[~small], error[~small]


def test_large_oblique_targets_are_biased_without_the_correction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without, error = normalised(surveyed(tmp_path, monkeypatch, "eccentricity = false"))
    assert np.abs(without).min() > 3
    # r^2 c sin cos / d^2 is 0.1 px of eccentricity, all seen from above: 0.017 mm in height
    assert np.abs(error.mean()) == pytest.approx(0.017, abs=0.003)


@pytest.mark.parametrize(
    ("known", "seeds"), [("nothing", (1, 2)), ("table", (1, 2)), ("table and one for all", (1,))]
)
def test_they_are_unbiased_with_the_correction(
    known: str, seeds: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, diameter = places()
    targets = ""
    if known != "nothing":
        named = range(1, len(diameter) + 1)
        rows = [(k, d) for k, d in zip(named, diameter, strict=True) if known == "table" or d == LARGE_MM]
        table = "id,diameter\n" + "".join(f"{k},{d}\n" for k, d in rows)
        (tmp_path / "diameters.csv").write_text(table, encoding="utf-8")
        targets = 'diameters = "diameters.csv"'
        targets += f"\ndiameter = {SMALL_MM}" if known != "table" else ""
    squares, means = [], []
    for seed in seeds:
        result = surveyed(tmp_path, monkeypatch, targets, seed)
        ratio, _ = normalised(result)
        squares += list(ratio**2)
        means.append(ratio.mean() * np.sqrt(len(ratio)))
        assert result.eccentricity is not None
        assert 0.1 < result.eccentricity.largest_px < 0.3  # the nearest targets show 90 px
        assert 0 < result.eccentricity.sigma_px < 0.01
        assert 0.8 < result.adjustment.sigma0 < 1.2
    # 14 large targets in each survey; the frame of the small ones adds a little to each sigma
    assert np.abs(means).max() < 3.5
    assert np.mean(squares) == pytest.approx(1.0, abs=4 * np.sqrt(2 / len(squares)))


DIAMETERS = ("diameters_differ", "names_missing")


def test_stated_diameters_are_compared_with_the_ellipses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    centres, _ = places()
    length = float(np.linalg.norm(centres[39] - centres[0]))
    bar = f'\n[[scale_bar]]\nfrom = "1"\nto = "40"\nlength = {length}\nsigma = 0.01'
    right = surveyed(tmp_path, monkeypatch, f"diameter = {1.05 * SMALL_MM}{bar}")  # two thirds are small
    assert of_kind(right.remarks, *DIAMETERS) == ()
    wrong = surveyed(tmp_path, monkeypatch, f"diameter = 12.0{bar}")
    (found,) = of_kind(wrong.remarks, *DIAMETERS)
    assert found.kind == "diameters_differ" and found.number("differing") == 40
    assert (found.number("stated"), found.number("found")) == pytest.approx((12.0, 1.2), rel=0.02)
    table = f"id,diameter\n1,{LARGE_MM}\n2,{2 * SMALL_MM}\n3,{1.05 * SMALL_MM}\n"
    (tmp_path / "d.csv").write_text(table + "".join(f"{k},3\n" for k in range(901, 913)), encoding="utf-8")
    several = surveyed(tmp_path, monkeypatch, f'diameters = "d.csv"{bar}')
    unknown, differ = of_kind(several.remarks, *DIAMETERS)
    assert unknown.kind == "names_missing"
    assert unknown.names("names") == tuple(str(k) for k in range(901, 913))
    assert differ.kind == "diameters_differ" and differ.names("target") == ("2",)
    numbers = [differ.number(name) for name in ("stated", "found", "differing", "total")]
    assert numbers == pytest.approx([2.4, 1.2, 1, 3], rel=0.02)
    only = surveyed(tmp_path, monkeypatch, 'diameters = "d.csv"')  # no scale to compare with
    assert [one.kind for one in of_kind(only.remarks, *DIAMETERS)] == ["names_missing"]


def test_table_of_diameters(tmp_path: Path) -> None:
    path = tmp_path / "d.csv"
    path.write_text("id,diameter\n7,12.5\nu001,3\n", encoding="utf-8")
    found = read_diameters(path)
    names, diameter = found.names, found.diameter
    assert names == ("7", "u001")
    assert diameter.tolist() == [12.5, 3.0]
    for text, message in (
        ("id,diameter\n7,-1\n", "column diameter contains -1, needed more than 0"),
        ("id,diameter\n7,1\n7,2\n", "7"),
        ("id,size\n7,1\n", "diameter"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(SurveyFileError, match=message):
            read_diameters(path)
