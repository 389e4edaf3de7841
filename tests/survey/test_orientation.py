"""What photographs a survey starts from, which it refuses, and what it says where it cannot start."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.judgement.survey_result import SurveyResult
from sfm.model.conventions import angles_from_rotation
from sfm.model.errors import GeometryError, SurveyFileError
from sfm.model.remarks.remark import Remark, kinds_of, remark
from sfm.pipeline import run_survey
from sfm.survey.inputs.survey import read_survey
from sfm.survey.measuring.measured_store import MeasuredStore
from tests.surveys import write_observed_survey, write_photograph_survey
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def survey_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_photograph_survey(tmp_path_factory.mktemp("start") / "survey", "start")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> MeasuredStore:
    return MeasuredStore(tmp_path_factory.mktemp("targets"))


@pytest.fixture(scope="module")
def plain(survey_file: Path, store: MeasuredStore) -> SurveyResult:
    return run_survey(read_survey(survey_file), store=store)


def changed(survey_file: Path, folder: Path, *, add: str = "", **replaced: str) -> Path:
    """Copy a survey with lines added and settings replaced; return the folder."""
    shutil.copytree(survey_file.parent, folder, dirs_exist_ok=True)
    text = (folder / "survey.toml").read_text(encoding="utf-8")
    for key, value in replaced.items():
        before, after = text.split(f"{key} = ", 1)
        text = f"{before}{key} = {value}\n{after.split(chr(10), 1)[1]}"
    (folder / "survey.toml").write_text(text + add, encoding="utf-8")
    return folder


def write_exterior(path: Path, names: tuple[str, ...], position: np.ndarray, rotation: np.ndarray) -> None:
    rows = ["image,X,Y,Z,omega_deg,phi_deg,kappa_deg"]
    for name, X0, R in zip(names, position, rotation, strict=True):
        values = [*X0, *np.degrees(angles_from_rotation(R))]
        rows.append(",".join([name, *(repr(float(v)) for v in values)]))
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def copy_of(same: str) -> Remark:
    return remark("copies", original="photo 2 again.png", same=same)


@pytest.mark.parametrize(("more", "same"), [(b"", "files"), (b"\0", "pictures")])
def test_copies_of_a_photograph_are_no_observations(
    plain: SurveyResult, survey_file: Path, store: MeasuredStore, tmp_path: Path, more: bytes, same: str
) -> None:
    folder = changed(survey_file, tmp_path / "copies")
    (folder / "photo 2 again.png").write_bytes((folder / "photo 2.png").read_bytes() + more)
    result = run_survey(read_survey(folder / "survey.toml"), store=store)
    assert [(f.image, f.reason) for f in result.failed] == [("photo 2.png", copy_of(same))]
    assert result.images_total == 6 and result.failed[0].is_copy
    assert result.adjustment.redundancy == plain.adjustment.redundancy


def test_a_mirrored_photograph_does_not_get_in(
    plain: SurveyResult, survey_file: Path, store: MeasuredStore, tmp_path: Path
) -> None:
    folder = changed(survey_file, tmp_path / "mirrored")
    picture = cv2.imread(str(folder / "photo 3.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(folder / "strange.png"), cv2.flip(picture, 1))
    result = run_survey(read_survey(folder / "survey.toml"), store=store)
    assert [f.image for f in result.failed] == ["strange.png"]
    assert result.adjustment.network.points == plain.adjustment.network.points
    assert result.adjustment.redundancy == plain.adjustment.redundancy
    assert result.adjustment.sigma0_px == pytest.approx(plain.adjustment.sigma0_px, rel=1e-6)


def test_unreadable_files_are_named_once_with_their_reason(
    survey_file: Path, store: MeasuredStore, tmp_path: Path
) -> None:
    folder = changed(survey_file, tmp_path / "unreadable")
    (folder / "photo 1.png").write_bytes(b"")
    whole = (folder / "photo 2.png").read_bytes()
    (folder / "photo 2.png").write_bytes(whole[: len(whole) // 2])
    for keep in (store, None):
        result = run_survey(read_survey(folder / "survey.toml"), store=keep)
        assert [f.image for f in result.failed] == ["photo 1.png", "photo 2.png"]
        assert result.failed[0].reason.names("reason") == ("the file is empty",)
        assert result.failed[1].reason.names("reason")[0].startswith("the file is truncated")
        assert result.images_total == 4 and "4 of 4 photographs oriented" in result.verdict.headline
    for number in (3, 4, 5):
        (folder / f"photo {number}.png").write_bytes(b"")
    with pytest.raises(GeometryError, match=r": 1 readable .*photo 1.png: Not readable: the file is empty"):
        run_survey(read_survey(folder / "survey.toml"), store=store)


@pytest.mark.sweep(0, 3)
@pytest.mark.parametrize(
    ("replaced", "found"),
    [
        ({"codes": '"none"'}, r"0 codes read in 0 of them; .*codes = 'none', polarity = 'dark'"),
        ({"codes": '"arcs"'}, r"codes read in \d+ of them; .*codes = 'arcs'"),
        (
            {"codes": '"ring20"'},
            r"codes = 'ring20', .*; in photo \d\.png codes = 'ring14' reads \d\d? codes$",
        ),
        (
            {"polarity": '"bright"'},
            r"polarity = 'bright' .*; in photo \d\.png polarity = 'dark' reads \d\d? codes$",
        ),
    ],
)
def test_without_codes_the_settings_are_named(
    survey_file: Path, store: MeasuredStore, tmp_path: Path, replaced: dict[str, str], found: str
) -> None:
    folder = changed(survey_file, tmp_path / "codes", **replaced)
    with pytest.raises(GeometryError, match="no two photographs have 4 coded targets in common") as error:
        run_survey(read_survey(folder / "survey.toml"), store=store)
    assert error.match(r"\d+ targets found in 6 photographs, ") and error.match(found)


def test_photographs_start_from_approximate_values(
    plain: SurveyResult, survey_file: Path, store: MeasuredStore, tmp_path: Path
) -> None:
    """The result lies where the approximate values say, here 1000 units away from where it would be."""
    values, network = plain.adjustment.estimate, plain.adjustment.network
    add = '[approximate]\nimages = "images.csv"\n'
    folder = changed(survey_file, tmp_path / "given", add=add)
    write_exterior(folder / "images.csv", network.images, values.position + 1000.0, values.rotation)
    result = run_survey(read_survey(folder / "survey.toml"), store=store)
    assert kinds_of(result.remarks) == kinds_of(plain.remarks) and result.failed == ()
    np.testing.assert_allclose(result.adjustment.estimate.points, values.points + 1000.0, atol=0.05)


def test_approximate_values_of_no_photograph_are_refused(
    plain: SurveyResult, survey_file: Path, store: MeasuredStore, tmp_path: Path
) -> None:
    folder = changed(survey_file, tmp_path / "named", add='[approximate]\nimages = "images.csv"\n')
    values = plain.adjustment.estimate
    write_exterior(folder / "images.csv", ("photo 9.png",), values.position[:1], values.rotation[:1])
    with pytest.raises(SurveyFileError, match=r"line 2: image 'photo 9.png' is no photograph of the survey"):
        run_survey(read_survey(folder / "survey.toml"), store=store)


@pytest.mark.parametrize("how", ["one photograph", "all wrong"])
def test_useless_approximate_values_are_put_aside(how: str, tmp_path: Path) -> None:
    path = write_observed_survey(tmp_path / "s", "useless", images=8, points=30)
    network, truth = make_network(seed_of("useless"), images=8, points=30, free=("c",))
    before = run_survey(read_survey(path))
    names, position, rotation = network.images, truth.position, truth.rotation
    if how == "one photograph":
        names, position, rotation = names[:1], position[:1], rotation[:1]
    else:
        position, rotation = np.roll(position, 1, axis=0), np.roll(rotation, 3, axis=0)
    write_exterior(path.parent / "images.csv", names, position, rotation)
    with path.open("a", encoding="utf-8") as file:
        file.write('[approximate]\nimages = "images.csv"\n')
    result = run_survey(read_survey(path))
    assert result.failed == ()
    assert result.adjustment.redundancy == before.adjustment.redundancy
    assert "approximate_unused" in kinds_of(result.remarks)


def test_a_failure_names_the_approximate_values(tmp_path: Path) -> None:
    path = write_observed_survey(tmp_path / "s", "fails", images=2, points=20)
    table = path.parent / "image_points.csv"
    lines = table.read_text(encoding="utf-8").splitlines()
    table.write_text("\n".join([line for line in lines if ",1," not in line][:4]) + "\n", encoding="utf-8")
    network, truth = make_network(seed_of("fails"), images=2, points=20, free=("c",))
    write_exterior(path.parent / "images.csv", network.images[:1], truth.position[:1], truth.rotation[:1])
    with path.open("a", encoding="utf-8") as file:
        file.write('[approximate]\nimages = "images.csv"\n')
    with pytest.raises(GeometryError, match=r"correct or complete \[approximate\], or leave it out"):
        run_survey(read_survey(path))


def test_free_datum_keeps_control_with_approximate_images(tmp_path: Path) -> None:
    path = write_observed_survey(tmp_path / "s", "kept", images=8, points=30)
    network, truth = make_network(seed_of("kept"), images=8, points=30, free=("c",))
    write_exterior(path.parent / "images.csv", network.images, truth.position, truth.rotation)
    rows = [f"{network.points[j]},{','.join(repr(float(v)) for v in truth.points[j])}" for j in range(5)]
    (path.parent / "control.csv").write_text("\n".join(["id,X,Y,Z", *rows]) + "\n", encoding="utf-8")
    with path.open("a", encoding="utf-8") as file:
        file.write('[control]\nfile = "control.csv"\n[approximate]\nimages = "images.csv"\n')
    result = run_survey(read_survey(path))
    assert set(network.points[:5]) <= set(result.adjustment.network.points)
    assert result.control_check is not None and len(result.control_check.points) == 5
