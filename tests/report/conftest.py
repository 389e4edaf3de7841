"""The browser is started once for the tests of a file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser import chromium


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A running browser; the test is skipped where there is none."""
    with chromium() as running:
        yield running
