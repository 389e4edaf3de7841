"""Rigs of results in tables: mounts, moments and their covariance, there and back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapters.formats.content import KINDS, Content
from adapters.formats.registry import read_content, write_content
from adapters.formats.result_tables import read_result
from sfm.adjustment.solve import adjust
from sfm.errors import SurveyFileError
from sfm.files.result_tables import write_rigs
from sfm.pipeline import run_survey
from sfm.solution import Solution
from sfm.survey.inputs.survey import read_survey
from tests.rigs import make_rig
from tests.synthetic import make_network, seed_of


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
            "photograph moment 2 camera 1 of camera camera 1 is missing",
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
    with pytest.raises(SurveyFileError, match="covariances of other photographs or cameras"):
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
