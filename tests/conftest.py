"""What all tests share: where the public reference data are, if they are."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the public reference data; the test is skipped where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("the public reference data ../shared/data are absent")
    return SHARED
