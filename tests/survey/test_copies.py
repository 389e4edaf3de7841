"""Copies of photographs count once, whatever they were saved as; exposures from one place count each."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.adjustment.solve import adjust
from sfm.errors import GeometryError
from sfm.pipeline import run_survey
from sfm.result import SurveyResult
from sfm.survey.inputs.checks.copies import (
    MIN_CORRELATION,
    SAME_PLACE,
    find_copies,
    without_copies,
)
from sfm.survey.inputs.start import measurements_from_observations
from sfm.survey.inputs.survey import read_survey
from tests.surveys import survey_of, write_photograph_survey
from tests.synthetic import make_network, seed_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs with the noise of real ones: compression adds less."""
    made = write_photograph_survey(tmp_path_factory.mktemp("copies") / "s", "copies").parent
    rng = seed_of("noise of copies")
    for path in sorted(made.glob("*.png")):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        noisy = np.rint(grey + 8.0 * rng.standard_normal(grey.shape))
        cv2.imwrite(str(path), np.clip(noisy, 0, 255).astype(np.uint8))
    return made


@pytest.fixture(scope="module")
def plain(folder: Path) -> SurveyResult:
    return run_survey(read_survey(folder / "survey.toml"))


@pytest.mark.parametrize("quality", [75, pytest.param(95, marks=pytest.mark.slow)])
def test_photographs_saved_again_as_jpeg_count_once(
    plain: SurveyResult, folder: Path, quality: int, tmp_path: Path
) -> None:
    shutil.copytree(folder, tmp_path / "s")
    for path in sorted((tmp_path / "s").glob("*.png")):
        _, data = cv2.imencode(".jpg", cv2.imread(str(path)), [cv2.IMWRITE_JPEG_QUALITY, quality])
        cv2.imwrite(str(path.with_name(f"{path.stem}_again.png")), cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))
    result = run_survey(read_survey(tmp_path / "s" / "survey.toml"))
    assert result.images_total == 6 and len(result.failed) == 6
    assert [one.reason.names("original")[0] for one in result.failed] == sorted(plain.network.images)
    assert result.adjustment.redundancy == plain.adjustment.redundancy
    assert np.allclose(result.adjustment.covariance.points, plain.adjustment.covariance.points, rtol=1e-6)


def test_exposures_from_one_place_count_each(folder: Path, tmp_path: Path) -> None:
    other = write_photograph_survey(tmp_path / "other", "second exposures").parent
    shutil.copytree(folder, tmp_path / "s")
    for path in other.glob("*.png"):
        shutil.copy(path, tmp_path / "s" / f"{path.stem}_second.png")
    result = run_survey(read_survey(tmp_path / "s" / "survey.toml"))
    assert result.images_total == 12 and result.failed == ()


@pytest.mark.parametrize("rho", [0.5 * MIN_CORRELATION, 0.5 + 0.5 * MIN_CORRELATION])
def test_photographs_whose_errors_correlate(rho: float) -> None:
    """As of given image points; the correlation that is found is that of the errors."""
    network, truth = make_network(seed_of("correlated"), images=8, points=60, noise_px=0.1)
    seen = network.image_points
    exact, _ = make_network(seed_of("correlated"), images=8, points=60, noise_px=0.0)
    rng = seed_of("correlated errors")
    order = np.arange(8)
    order[5] = 2
    position, rotation = truth.position[order], truth.rotation[order]
    xy = exact.image_points.xy.copy()
    third, sixth = (np.flatnonzero(seen.image == k) for k in (2, 5))
    assert (seen.point[third] == seen.point[sixth]).all()
    xy[sixth] = xy[third]
    noise = 0.1 * rng.standard_normal(xy.shape)
    noise[sixth] = rho * noise[third] + np.sqrt(1 - rho**2) * noise[sixth]
    both = replace(network, image_points=replace(seen, xy=xy + noise))
    start = replace(truth, position=position, rotation=rotation)
    found = find_copies(adjust(both, start, sigma_px=0.1))
    if rho < MIN_CORRELATION:
        assert found == {}
    else:
        assert found["image 6"][0] == "image 3" and abs(found["image 6"][1] - rho) < 0.1
        result = run_survey(survey_of(both, start, start=start))
        assert [(one.image, *one.reason.names("original")) for one in result.failed] == [
            ("image 6", "image 3")
        ]
    assert SAME_PLACE == 1e-3


def test_photographs_of_one_place_are_named_as_such() -> None:
    """A fixed camera and a fixed board: what is seen differs by far less than residuals."""
    network, truth = make_network(seed_of("still"), images=3, points=60, noise_px=0.1)
    measured = measurements_from_observations(survey_of(network, truth))
    copies = {"image 2": ("image 1", 0.99), "image 3": ("image 1", 0.98)}
    assert len(without_copies(measured, {"image 2": copies["image 2"]}).network.images) == 2
    with pytest.raises(GeometryError, match="2 of 3 photographs show"):
        without_copies(measured, copies)
