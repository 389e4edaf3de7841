"""A real browser for tests of pages: Debian's chromium driven by playwright, without a graphics card."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

ARGUMENTS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-sandbox",
    # the processor puts pages together itself: by the card that swiftshader computes it takes twice as long
    "--disable-gpu-compositing",
    "--disable-gpu-rasterization",
]
WAIT_MS = 60_000  # for a page on a busy machine
MISSING = "no chromium or no playwright here: pages are not tried in a real browser"


@contextmanager
def chromium() -> Iterator[Any]:
    """Give a running browser; the test is skipped where there is none."""
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        path = None
    if path is None:
        pytest.skip(MISSING)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=ARGUMENTS)
        yield browser
        browser.close()


class Tab:
    """A page in the browser, with everything that it complained of and asked for."""

    def __init__(
        self, browser: Any, page: Path | str, *, width: int = 1300, height: int = 900, **context: Any
    ) -> None:
        self.context = browser.new_context(viewport={"width": width, "height": height}, **context)
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", self._hear)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.set_default_timeout(WAIT_MS)
        self.page.goto(page if isinstance(page, str) else page.as_uri())

    def _hear(self, message: Any) -> None:
        # tests read the pixels of the page's pictures, and without a card so does the browser itself
        own = "willReadFrequently" in message.text or "GPU stall due to ReadPixels" in message.text
        if message.type in ("error", "warning") and not own:
            self.complaints.append(message.text)

    def ready(self) -> Any:
        """Wait until the viewer is there, and return the page."""
        self.page.wait_for_selector("#explore[data-ready]")
        return self.page

    def until(self, expression: str, argument: object = None) -> None:
        """Wait until a JavaScript function returns something; the page's policy lets no text be evaluated."""
        end = time.monotonic() + WAIT_MS / 1000
        while not self.page.evaluate(expression, argument):
            assert time.monotonic() < end, f"waited in vain for {expression}"
            self.page.wait_for_timeout(30)

    def close(self) -> None:
        self.context.close()
