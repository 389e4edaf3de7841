"""The page for marking as a person uses it: with its server, by clicks and keys in a browser."""

from __future__ import annotations

import csv
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sfm.products.marking.project import MarkedProject, project_of_survey
from sfm.products.marking.server import MarkingServer
from sfm.products.marking.session import MarkingSession
from sfm.survey.inputs.survey import read_survey
from tests.browser import Tab

NO_DEFECT = (
    "status of 422",  # the browser reports what the server refuses, as the page does
    "loaded before reset",  # OpenSeadragon, of tiles of a photograph that was left meanwhile
)

PLACE = """([pane, x, y]) => {
  const shown = document.getElementById('marking').page.panes[pane]
  const box = shown.view.getBoundingClientRect()
  const [left, top] = shown.frame().at([x, y])
  return [box.left + left, box.top + top]
}"""
STATE = "() => document.getElementById('marking').page.model.state"
PAGE = "document.getElementById('marking').page"


@contextmanager
def served(project: MarkedProject | Path, marks: Path) -> Iterator[MarkingServer]:
    """Serve the page of a project or of a survey file, in a thread."""
    if isinstance(project, Path):
        project = project_of_survey(read_survey(project), survey_file=project)
    session = MarkingSession(project, marks)
    server = MarkingServer(session)
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        session.close()
        server.stop()
        thread.join(20)


@dataclass
class Marking:
    """An open page, with what a person does there."""

    tab: Tab
    pressed: int = 0  # clicks and keys

    @property
    def page(self) -> Any:
        return self.tab.page

    @property
    def state(self) -> Any:
        return self.page.evaluate(STATE)

    def ready(self) -> Marking:
        self.page.wait_for_selector(".m-view[data-ready]")
        self.tab.until(f"() => {PAGE}.panes.every((pane) => pane.ready)")
        return self

    def click(self, pane: int, place: Sequence[float], **options: Any) -> None:
        self.pressed += 1
        self.page.mouse.click(*self.page.evaluate(PLACE, [pane, *map(float, place)]), **options)
        self.settled()

    def key(self, key: str) -> None:
        self.pressed += 1
        self.page.keyboard.press(key)
        self.settled()

    def settled(self) -> None:
        """Wait until the program has answered what was asked."""
        self.tab.until(f"() => {PAGE}.server.idle")

    @property
    def images(self) -> list[int]:
        """The photographs in the panes."""
        return list(self.page.evaluate(f"() => {PAGE}.panes.map((pane) => pane.image)"))

    @property
    def chosen(self) -> str:
        """The chosen point."""
        return str(self.page.evaluate(f"() => {PAGE}.model.chosen"))

    def next_point(self, pane: int) -> Any:
        """Return the point that a click in a pane measures, as told beside the pointer; None: a new one."""
        return self.page.evaluate(f"(pane) => {PAGE}.model.pointFor({PAGE}.panes[pane].image)", pane)

    def proposals_of(self, point: str) -> list[Any]:
        return [proposal for proposal in self.state["proposals"] if proposal["point"] == point]

    def said(self) -> str:
        return str(self.page.locator("#m-said").inner_text())

    def close(self) -> None:
        complaints = [text for text in self.tab.complaints if not any(known in text for known in NO_DEFECT)]
        assert not complaints, complaints
        self.tab.close()


def open_page(browser: Any, server: MarkingServer, **options: Any) -> Marking:
    return Marking(Tab(browser, server.address.url, **options)).ready()


@dataclass(frozen=True)
class Targets:
    """The targets of a rendered scene."""

    places: Mapping[str, Mapping[str, tuple[float, float]]]  # of each photograph: target to place, px
    xyz: Mapping[str, tuple[float, float, float]]  # object unit

    def seen_everywhere(self) -> list[str]:
        """Return the uncoded targets that every photograph shows."""
        shown = [set(places) for places in self.places.values()]
        return sorted(name for name in set.intersection(*shown) if name.startswith("t"))


def targets_of(folder: Path) -> Targets:
    """Read the truth beside rendered photographs."""
    places: dict[str, dict[str, tuple[float, float]]] = {}
    with (folder / "truth_image_points.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            places.setdefault(row["image"], {})[row["target"]] = (float(row["x_px"]), float(row["y_px"]))
    with (folder / "truth_points.csv").open(encoding="utf-8") as file:
        xyz = {
            row["name"]: (float(row["X"]), float(row["Y"]), float(row["Z"])) for row in csv.DictReader(file)
        }
    return Targets(places, xyz)


def mark_everything(
    marking: Marking, targets: Targets, pair: Sequence[str], more: Sequence[str]
) -> dict[str, str]:
    """Mark from nothing, six photographs side by side, until all are oriented and all is accepted.

    Args:
        marking: the page, with two photographs side by side and no marks.
        targets: where a person sees the targets.
        pair: the targets that orient the first two photographs and then the others.
        more: further targets, clicked once each: the others are proposed.

    Returns:
        The target of each point.
    """
    names = {photograph["index"]: photograph["name"] for photograph in marking.state["photographs"]}
    target_of: dict[str, str] = {}

    def click(pane: int, target: str) -> None:
        marking.click(pane, targets.places[names[marking.images[pane]]][target])
        target_of.setdefault(marking.chosen, target)

    for key in ("l", "l"):  # 4, then 6 side by side
        marking.key(key)
    marking.ready()
    for target in pair:
        for pane in (0, 1):
            click(pane, target)
    for pane in range(2, 6):
        orient(marking, pane, target_of, click)
    marking.key("PageDown")
    marking.ready()
    for pane in range(6):
        orient(marking, pane, target_of, click)
    for target in more:
        click(0, target)
        for pane in range(1, 6):
            if marking.proposals_of(marking.chosen):
                break
            click(pane, target)
    marking.key("Shift+Enter")
    return target_of


def orient(marking: Marking, pane: int, target_of: Mapping[str, str], click: Any) -> None:
    """Click in a photograph, always on the point that the page names, until it is oriented."""
    image = marking.images[pane]
    for _ in range(6):
        if marking.state["photographs"][image]["oriented"]:
            return
        click(pane, target_of[marking.next_point(pane)])
    raise AssertionError(f"photograph {image} is not oriented after six marks")
