"""The covariance of all points: the same back, and nothing that belongs to another table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.errors import SurveyFileError
from sfm.files.covariance_file import NAME, read_covariance, write_covariance
from tests.synthetic import seed_of


def matrix(points: int = 5) -> np.ndarray:
    A = seed_of("covariance file").standard_normal((3 * points, 3 * points))
    return np.asarray(1e-8 * A @ A.T)


def sigma_of(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diagonal(covariance)).reshape(-1, 3)


def test_goes_round_to_the_last_bit(tmp_path: Path) -> None:
    covariance = matrix()
    write_covariance(tmp_path, covariance)
    again = read_covariance(tmp_path, sigma_of(covariance))
    assert again is not None
    np.testing.assert_array_equal(np.triu(again), np.triu(covariance))
    np.testing.assert_array_equal(again, again.T)
    assert read_covariance(tmp_path / "elsewhere", sigma_of(covariance)) is None


def test_of_another_table_or_damaged_is_refused(tmp_path: Path) -> None:
    covariance = matrix()
    sigma = sigma_of(covariance)
    write_covariance(tmp_path, covariance)
    with pytest.raises(SurveyFileError, match=r"expected 752 for the 4 points"):
        read_covariance(tmp_path, sigma[:4])
    with pytest.raises(SurveyFileError, match=r"are not those of points\.csv"):
        read_covariance(tmp_path, 1.01 * sigma)
    data = (tmp_path / NAME).read_bytes()
    (tmp_path / NAME).write_bytes(b"\x00" * 128 + data[128:])
    with pytest.raises(SurveyFileError, match="is no array"):
        read_covariance(tmp_path, sigma)
    (tmp_path / NAME).write_bytes(data.replace(b"<f8", b"<i8"))
    with pytest.raises(SurveyFileError, match="finite numbers of 8 bytes"):
        read_covariance(tmp_path, sigma)
