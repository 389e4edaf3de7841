"""Tables of a result, covariances and rigs: read as they were written; folders of killed runs."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.content import KINDS, Content
from adapters.formats.registry import read_content, write_content
from adapters.formats.result_tables import read_result
from sfm.adjustment.solve import adjust
from sfm.files.covariance_file import NAME, read_covariance, write_covariance
from sfm.files.result_tables import CONTROL_POINTS, IMAGE_POINTS, POINTS, ResultTable, write_rigs
from sfm.files.user_cache import PREFIX, scratch_folder
from sfm.model.errors import SurveyFileError
from sfm.model.solution import Solution, points_kept_together
from sfm.pipeline import run_survey
from sfm.survey.inputs.survey import read_survey
from tests.rigs import make_rig
from tests.synthetic import make_network, seed_of

NAMES = ("a", "b", "c", "d", "e")


def matrix(points: int = 5) -> np.ndarray:
    A = seed_of("covariance file").standard_normal((3 * points, 3 * points))
    return np.asarray(1e-8 * A @ A.T)


def sigma_of(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diagonal(covariance)).reshape(-1, 3)


def test_goes_round_to_the_last_bit(tmp_path: Path) -> None:
    covariance = matrix()
    write_covariance(tmp_path, covariance, NAMES, None)
    again, points = read_covariance(tmp_path, NAMES, sigma_of(covariance))
    assert again is not None and points is None
    np.testing.assert_array_equal(np.triu(again), np.triu(covariance))
    np.testing.assert_array_equal(again, again.T)
    assert read_covariance(tmp_path / "elsewhere", NAMES, sigma_of(covariance)) == (None, None)


def test_of_a_sample_of_the_points(tmp_path: Path) -> None:
    covariance = matrix(3)
    sigma = np.ones((5, 3))
    sigma[[0, 2, 3]] = sigma_of(covariance)
    write_covariance(tmp_path, covariance, NAMES, np.array([0, 2, 3]))
    again, points = read_covariance(tmp_path, NAMES, sigma)
    assert again is not None and points is not None and list(points) == [0, 2, 3]
    np.testing.assert_array_equal(np.triu(again), np.triu(covariance))
    with pytest.raises(SurveyFileError, match=r"line 3: point 'c' is not in points\.csv"):
        read_covariance(tmp_path, ("a", "b", "x", "d", "e"), sigma)


def test_named_points_are_kept_first() -> None:
    assert list(points_kept_together(NAMES)) == [0, 1, 2, 3, 4]
    names = tuple(f"u{k:05d}" if k % 100 else f"code {k}" for k in range(10_000))
    kept = points_kept_together(names)
    assert len(kept) == 500 and (np.diff(kept) > 0).all()
    assert set(range(0, 10_000, 100)) <= set(kept.tolist())


def test_of_another_table_or_damaged_is_refused(tmp_path: Path) -> None:
    covariance = matrix()
    sigma = sigma_of(covariance)
    write_covariance(tmp_path, covariance, NAMES, None)
    with pytest.raises(SurveyFileError, match=r"expected 752 for the 4 points"):
        read_covariance(tmp_path, NAMES[:4], sigma[:4])
    with pytest.raises(SurveyFileError, match=r"are not those of points\.csv"):
        read_covariance(tmp_path, NAMES, 1.01 * sigma)
    data = (tmp_path / NAME).read_bytes()
    (tmp_path / NAME).write_bytes(b"\x00" * 128 + data[128:])
    with pytest.raises(SurveyFileError, match="not an array"):
        read_covariance(tmp_path, NAMES, sigma)
    (tmp_path / NAME).write_bytes(data.replace(b"<f8", b"<i8"))
    with pytest.raises(SurveyFileError, match="finite numbers of 8 bytes"):
        read_covariance(tmp_path, NAMES, sigma)


OWNERS = ("image 1", "image 2"), ("A", "=B")
XY = np.array([[0.1, 2.0], [1 / 3, 4.0]])


def test_groups_that_are_not_known_are_left_out_and_read_as_unknown(tmp_path: Path) -> None:
    IMAGE_POINTS.write(tmp_path, OWNERS, XY, None, None, None, None, None)
    table = IMAGE_POINTS.read(tmp_path)
    assert table.texts == OWNERS and (table.part(("x_px", "y_px")) == XY).all()
    assert np.isnan(table.part(("sx_px", "cxy_px2", "rejected"))).all()
    sigma = np.array([[0.1, np.nan], [0.3, 0.4]])
    IMAGE_POINTS.write(tmp_path, OWNERS, XY, sigma, [None, 0.01], XY, [0, 1], ["a", "b"])
    table = IMAGE_POINTS.read(tmp_path)
    np.testing.assert_array_equal(table.part(("sx_px", "sy_px")), sigma)
    assert np.isnan(table.part(("cxy_px2",))[0, 0]) and table.part(("cxy_px2",))[1, 0] == 0.01
    assert table.part(("rejected",)).ravel().tolist() == [0, 1]
    assert np.isnan(table.part(("vx_px",))).all()  # of the residuals nothing is read


def test_a_covariance_without_its_standard_deviations_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / IMAGE_POINTS.file).write_text("image,point,x_px,y_px,cxy_px2\na,b,1,2,3\n")
    assert np.isnan(IMAGE_POINTS.read(tmp_path).part(("cxy_px2",))).all()


def test_columns_that_may_be_empty_must_be_there(tmp_path: Path) -> None:
    (tmp_path / CONTROL_POINTS.file).write_text("use,point,coordinate,given,sigma_prior\ncheck,1,X,,\n")
    assert np.isnan(CONTROL_POINTS.read(tmp_path).values).all()
    (tmp_path / CONTROL_POINTS.file).write_text("use,point,coordinate,given\ncheck,1,X,2\n")
    with pytest.raises(SurveyFileError, match="no column sigma_prior"):
        CONTROL_POINTS.read(tmp_path)


def test_an_empty_table_has_its_header(tmp_path: Path) -> None:
    POINTS.write(tmp_path, (), np.zeros((0, 3)), np.zeros((0, 3)), [])
    assert (tmp_path / POINTS.file).read_text() == ",".join(POINTS.names_of()) + "\n"


def test_values_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="2 columns of values for 3"):
        POINTS.write(tmp_path, ("A", "B"), XY, None, None)
    with pytest.raises(ValueError, match="expected one of name, label, number"):
        ResultTable("points", "names: id")


RUN = """
import time
from sfm.files.user_cache import scratch_folder
with scratch_folder() as folder:
    (folder / "set-aside").write_text("x")
    print(folder, flush=True)
    time.sleep(60)
"""


def test_a_killed_run_leaves_nothing_after_the_next_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    runs = [subprocess.Popen([sys.executable, "-c", RUN], stdout=subprocess.PIPE, text=True) for _ in "12"]
    try:
        killed, working = (Path(run.stdout.readline().strip()) for run in runs if run.stdout)
        runs[0].send_signal(signal.SIGKILL)
        runs[0].wait()
        assert (killed / "set-aside").exists()
        (tmp_path / f"{PREFIX}new").mkdir()  # a run that has no lock yet
        (tmp_path / f"{PREFIX}link").symlink_to(tmp_path / "elsewhere")
        with scratch_folder() as own:
            assert not killed.parent.exists() and (working / "set-aside").exists()
            assert own.is_dir() and own.parent.stat().st_mode & 0o077 == 0
        assert not own.parent.exists()
        assert (tmp_path / f"{PREFIX}new").exists() and (tmp_path / f"{PREFIX}link").is_symlink()
    finally:
        for run in runs:
            run.kill()
            run.communicate()


@pytest.fixture(scope="module")
def solved() -> Solution:
    """Two cameras on a rig, free interior orientation, one photograph without partner."""
    network, truth = make_rig(seed_of("rig tables"), moments=6, points=25, free=("c", "K1"))
    assert network.moment is not None
    moment = np.where(np.arange(12) == 5, 6, network.moment)
    network = replace(network, moment=moment)
    assert truth.mounts is not None
    found: Solution = adjust(network, truth, reject="none").solution
    return found


def test_rigs_come_back_from_tables(solved: Solution, tmp_path: Path) -> None:
    solved.write(tmp_path / "t")
    again = read_content(tmp_path / "t")
    before, after = solved.estimate.mounts, again.result.estimate.mounts
    assert before is not None and after is not None
    assert after.rig == before.rig and (after.free == before.free).all()
    np.testing.assert_allclose(after.position, before.position, rtol=0, atol=1e-15)
    np.testing.assert_allclose(after.rotation, before.rotation, rtol=0, atol=1e-14)
    assert again.result.network.moment is not None
    assert again.result.network.moment.tolist() == [0, 0, 1, 1, 2, 3, 4, 4, 5, 5, 6, 6]
    np.testing.assert_array_equal(again.result.rig_covariance, solved.rig_covariance)
    write_content(tmp_path / "again", "tables", again)
    twice = read_content(tmp_path / "again")
    for kind in KINDS:
        np.testing.assert_allclose(kind.rows(twice), kind.rows(again), rtol=1e-12, err_msg=kind.name)


def test_the_covariance_of_mounts_is_joint_with_interior_orientation(solved: Solution) -> None:
    """Marginals are its blocks; c of the cameras and the base go together."""
    Q, free = solved.rig_covariance, len(solved.interior_covariance[0])
    assert Q is not None and free == 2 and len(Q) == 4 + 12 == len(solved.rig_parameters)
    assert solved.rig_parameters[:3] == ("camera 1 c", "camera 1 K1", "camera 2 c")
    assert solved.rig_parameters[-6:] == tuple(
        f"camera 2 {x}" for x in ("X", "Y", "Z", "omega", "phi", "kappa")
    )
    np.testing.assert_allclose(Q[:2, :2], solved.interior_covariance[0], rtol=1e-9)
    np.testing.assert_allclose(Q[2:4, 2:4], solved.interior_covariance[1], rtol=1e-9)
    assert not Q[4:10].any() and np.linalg.eigvalsh(Q[10:, 10:]).min() > 0
    sigma = np.sqrt(np.diag(Q))
    rho = Q[[0, 2]][:, 10:] / (sigma[[0, 2]][:, None] * sigma[10:])
    assert 0.1 < np.abs(rho).max() < 1


def test_single_photographs_have_no_rig_tables(tmp_path: Path) -> None:
    network, truth = make_network(seed_of("no rig"), images=3, points=8)
    write_rigs(tmp_path, Solution("x", network, truth))
    Solution("x", network, truth).write(tmp_path / "t")
    assert not list(tmp_path.glob("**/mo*.csv")) and read_result(tmp_path / "t").network.moment is None


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        (
            "mounts.csv",
            "camera 2,",
            "camera 3,",
            "mounts.csv, line 3: camera 'camera 3' is not in cameras.csv",
        ),
        ("mounts.csv", "camera 2,rig,", "camera 2,other,", "mounts.csv: rig 'rig' has one camera, needed"),
        ("mounts.csv", "camera 1,rig,0.0", "camera 1,rig,0.1", "rig 'rig' has no reference camera"),
        (
            "moments.csv",
            "moment 2 camera 1,2",
            "moment 2 camera 1,1",
            "photographs moment 1 camera 1 of camera",
        ),
        (
            "moments.csv",
            "moment 2 camera 1,2\n",
            "",
            "photograph moment 2 camera 1 of camera camera 1, which is on a rig, is missing",
        ),
        ("moments.csv", "moment 2 camera 1", "x", "moments.csv: image 'x' is not in images.csv"),
    ],
)
def test_damaged_rig_tables_are_refused(
    file: str, old: str, new: str, said: str, solved: Solution, tmp_path: Path
) -> None:
    solved.write(tmp_path / "t")
    text = (tmp_path / "t" / file).read_text("utf-8")
    assert old in text
    (tmp_path / "t" / file).write_text(text.replace(old, new), "utf-8")
    with pytest.raises(SurveyFileError, match=said) as refused:
        read_result(tmp_path / "t")
    assert "\n" not in str(refused.value)


def test_covariance_of_other_rigs_is_refused(solved: Solution, tmp_path: Path) -> None:
    solved.write(tmp_path / "t")
    path = tmp_path / "t" / "covariances.npz"
    with np.load(path) as arrays:
        found = dict(arrays)
    np.savez(path, **(found | {"rigs": found["rigs"][1:, 1:]}))
    with pytest.raises(SurveyFileError, match="its photographs or cameras are not those"):
        read_result(tmp_path / "t")


@pytest.mark.parametrize("held", [False, True])
def test_tables_with_rigs_are_a_survey_with_rigs(held: bool, tmp_path: Path) -> None:
    """Adjusted as they are: the same redundancy, and mounts free or held as they were."""
    network, truth = make_rig(seed_of("rig survey"), cameras=3, moments=6, points=20)
    assert truth.mounts is not None
    free = truth.mounts.free.copy()
    free[2] = not held
    truth = replace(truth, mounts=replace(truth.mounts, free=free))
    write_content(tmp_path / "t", "tables", Content(Solution("t", network, truth, unit="m", datum="free")))
    a = run_survey(read_survey(tmp_path / "t" / "survey.toml")).adjustment
    b = adjust(network, truth, reject="none")
    assert a.estimate.mounts is not None and truth.mounts is not None and a.redundancy == b.redundancy
    assert a.unknown_counts == b.unknown_counts
    assert (a.estimate.mounts.free == free).all()
    if held:
        np.testing.assert_allclose(a.estimate.mounts.position[2], truth.mounts.position[2], atol=1e-12)
    text = (tmp_path / "t" / "moments.csv").read_text("utf-8")
    (tmp_path / "t" / "moments.csv").write_text(text.replace("moment 3 camera 2,", "other,"), "utf-8")
    with pytest.raises(SurveyFileError, match="has no moment of photograph 'moment 3 camera 2'"):
        run_survey(read_survey(tmp_path / "t" / "survey.toml"))
