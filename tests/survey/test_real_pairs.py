"""Random pairs of real photographs, resampled ones, two cameras under one name: the table of real_pairs."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.places import SHARED
from tests.survey.real_pairs import PAIRS, one_camera, pairs_of, resampled

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (SHARED / "data" / "camcal").is_dir(), reason="../shared/data is absent"),
]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder in which the targets of each photograph are kept."""
    return tmp_path_factory.mktemp("store")


def test_pairs_with_a_calibration_are_oriented(store: Path) -> None:
    """With start values only (24 mm, no distortion) the camera is told as what does not fit."""
    found = list(pairs_of("retro-panel", store))
    print(*(one.line() for one in found), sep="\n")
    calibrated = [one for one in found if one.name.endswith("*")]
    assert len(calibrated) == PAIRS
    assert all(one.points > 15 and one.difference < 1e-3 for one in calibrated)
    # with start values every one is wrong: one by 60 of its standard deviations with sigma0 3 times as stated
    assert all(
        one.level == "bad" and "camera" in one.reason.lower() for one in found if one not in calibrated
    )


def test_pairs_of_four_codes_are_refused_with_the_count(store: Path) -> None:
    """The dots of the sheet have no codes, which takes three photographs."""
    found = list(pairs_of("camcal", store))
    assert len(found) == 2 * PAIRS
    assert all("4 common points in 2 photographs" in one.reason for one in found)


def test_resampled_photographs_are_named_and_harm_nothing(store: Path, tmp_path: Path) -> None:
    found = resampled(store, tmp_path)
    print(found.line())
    assert found.failed == () and found.points == 100 and found.over_sigma < 1.0
    assert found.level == "fair" and found.reason.startswith("The camera changes between photographs")


def test_two_cameras_under_one_name_are_no_good_survey(store: Path) -> None:
    """Coordinates are then off by 1.7 stated standard deviations (RMS) from those with two cameras."""
    found = one_camera(store)
    print(found.line())
    assert found.level == "fair" and found.reason.startswith("The camera changes between photographs")
    assert "Standard deviations are too small, by a factor of 1." in found.reason
