"""Tables of every page in a real browser: sorted, filtered and copied; plain tables without a script."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sfm.comparison.significance import compare_results
from sfm.model.solution import Solution
from sfm.report.pages import write_page
from tests.browser import Tab
from tests.synthetic import make_network, seed_of

EVIL = "=<img src=https://example.org/x onerror=document.title='broken'>"
SHIFTED = ".scroll:has(th:has-text('dX [m]')) table"


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    network, truth = make_network(seed_of("tables"), model="opencv", images=5, points=20)
    network = replace(network, points=(EVIL, *network.points[1:]))
    shift = np.zeros((20, 3))
    shift[:, 0] = np.arange(20) ** 2 * 1e-4 * (-1.0) ** np.arange(20)
    other = replace(truth, points=truth.points + shift)
    a, b = Solution("a", network, truth, unit="m"), Solution("b", network, other, unit="m")
    found = compare_results(a, b, align="none")
    return write_page(found, tmp_path_factory.mktemp("page") / "out", xyz=truth.points)


def cells(page: Any, column: int) -> list[str]:
    """Return the shown texts of a column, the first being 0."""
    rows = page.locator(f"{SHIFTED} tbody tr:not([hidden])")
    shown: list[str] = rows.evaluate_all(
        "(rows, k) => rows.map((row) => row.cells[k].textContent.trim())", column
    )
    return shown


def test_tables_are_sorted_filtered_and_copied(browser: Any, page_file: Path) -> None:
    tab = Tab(browser, page_file)
    page = tab.page
    page.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
    page.locator(f"{SHIFTED} .sort").nth(1).click()
    found = [float(text) for text in cells(page, 1)]
    assert found == sorted(found) and found[0] < 0 < found[-1] and len(found) == 20
    page.locator(f"{SHIFTED} .sort").nth(1).click()
    assert [float(text) for text in cells(page, 1)] == found[::-1]
    tools = page.locator(".tools:below(summary)").first
    tools.get_by_label("filter rows").fill("onerror")
    assert cells(page, 0) == [EVIL] and "1 of 20 rows" in tools.inner_text()
    page.evaluate(
        "Object.defineProperty(navigator, 'clipboard',"
        " { value: { writeText: (text) => { window.copied = text } } })"
    )
    tools.get_by_role("button", name="copy as CSV").click()
    tab.until("() => window.copied")
    head, row = page.evaluate("window.copied").splitlines()
    assert head.startswith("point,dX [m],dY [m]") and row.startswith(f"'{EVIL},")
    assert page.title() == "b minus a - Kolinear" and tab.complaints == []
    page.set_viewport_size({"width": 400, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth") <= 400
    page.set_viewport_size({"width": 688, "height": 900})  # of a page of A4 within its margins
    page.emulate_media(media="print")
    assert page.evaluate("document.documentElement.scrollWidth") <= 688
    assert not page.locator(".tools").first.is_visible()
    tab.close()


def test_without_a_script_they_are_plain_tables(browser: Any, page_file: Path) -> None:
    tab = Tab(browser, page_file, java_script_enabled=False)
    assert tab.page.locator(".tools, .sort").count() == 0
    assert tab.page.locator(f"{SHIFTED} tbody tr").count() == 20
    tab.close()
