"""The covariance of all points: the same back, and nothing that belongs to another table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.errors import SurveyFileError
from sfm.files.covariance_file import NAME, points_kept_together, read_covariance, write_covariance
from tests.synthetic import seed_of

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
    with pytest.raises(SurveyFileError, match="is no array"):
        read_covariance(tmp_path, NAMES, sigma)
    (tmp_path / NAME).write_bytes(data.replace(b"<f8", b"<i8"))
    with pytest.raises(SurveyFileError, match="finite numbers of 8 bytes"):
        read_covariance(tmp_path, NAMES, sigma)
